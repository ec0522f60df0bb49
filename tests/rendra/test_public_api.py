"""The names, module paths and signatures that scripts written for PyTorch3D 0.7.9 rely on: the rendering side."""

import importlib
import inspect
from typing import Any

import pytest
import torch

from rendra.io.obj_io import Faces, Properties

NAMES = {
    "rendra.common.datatypes": "Device get_device make_device",
    "rendra.transforms": """
        Rotate RotateAxisAngle Scale Transform3d Translate acos_linear_extrapolation axis_angle_to_matrix
        axis_angle_to_quaternion euler_angles_to_matrix matrix_to_axis_angle matrix_to_euler_angles
        matrix_to_quaternion matrix_to_rotation_6d quaternion_apply quaternion_invert quaternion_multiply
        quaternion_raw_multiply quaternion_to_axis_angle quaternion_to_matrix random_quaternions random_rotation
        random_rotations rotation_6d_to_matrix se3_exp_map se3_log_map so3_exp_map so3_exponential_map so3_log_map
        so3_relative_angle so3_rotation_angle standardize_quaternion""",
    "rendra.transforms.math": "acos_linear_extrapolation",
    "rendra.transforms.rotation_conversions": "euler_angles_to_matrix matrix_to_quaternion rotation_6d_to_matrix",
    "rendra.transforms.se3": "se3_exp_map se3_log_map",
    "rendra.transforms.so3": """
        hat hat_inv so3_exp_map so3_exponential_map so3_log_map so3_relative_angle so3_rotation_angle""",
    "rendra.transforms.transform3d": "Rotate RotateAxisAngle Scale Transform3d Translate",
    "rendra.structures": """
        Meshes Pointclouds Volumes join_meshes_as_batch join_meshes_as_scene join_pointclouds_as_batch
        join_pointclouds_as_scene list_to_packed list_to_padded packed_to_list padded_to_list""",
    "rendra.structures.meshes": "Meshes join_meshes_as_batch join_meshes_as_scene",
    "rendra.structures.pointclouds": "Pointclouds join_pointclouds_as_batch join_pointclouds_as_scene",
    "rendra.structures.utils": "list_to_packed list_to_padded packed_to_list padded_to_list padded_to_packed",
    "rendra.structures.volumes": "VolumeLocator Volumes",
    "rendra.io": "IO load_obj load_objs_as_meshes load_ply save_obj save_ply",
    "rendra.io.experimental_gltf_io": "MeshGlbFormat",
    "rendra.io.mtl_io": "load_mtl make_mesh_texture_atlas",
    "rendra.io.obj_io": "MeshObjFormat load_obj load_objs_as_meshes save_obj",
    "rendra.io.off_io": "MeshOffFormat",
    "rendra.io.pluggable": "IO",
    "rendra.io.pluggable_formats": "MeshFormatInterpreter PointcloudFormatInterpreter",
    "rendra.io.ply_io": "MeshPlyFormat PointcloudPlyFormat load_ply save_ply",
    "rendra.ops": """
        add_pointclouds_to_volumes add_points_features_to_volume_densities_features
        GraphConv SubdivideMeshes ball_query box3d_overlap convert_pointclouds_to_tensor
        corresponding_cameras_alignment corresponding_points_alignment cot_laplacian cubify efficient_pnp
        estimate_pointcloud_local_coord_frames
        estimate_pointcloud_normals eyes get_point_covariances interpolate_face_attributes is_pointclouds
        iterative_closest_point knn_gather knn_points laplacian marching_cubes mesh_face_areas_normals
        norm_laplacian packed_to_padded padded_to_packed sample_farthest_points sample_points_from_meshes
        taubin_smoothing vert_align wmean""",
    "rendra.ops.cubify": "cubify",
    "rendra.ops.graph_conv": "GraphConv gather_scatter",
    "rendra.ops.ball_query": "ball_query",
    "rendra.ops.knn": "knn_gather knn_points",
    "rendra.ops.interp_face_attrs": "interpolate_face_attributes",
    "rendra.ops.iou_box3d": "box3d_overlap",
    "rendra.ops.laplacian_matrices": "cot_laplacian laplacian norm_laplacian",
    "rendra.ops.marching_cubes": "marching_cubes marching_cubes_naive",
    "rendra.ops.mesh_face_areas_normals": "mesh_face_areas_normals",
    "rendra.ops.mesh_filtering": "taubin_smoothing",
    "rendra.ops.packed_to_padded": "packed_to_padded padded_to_packed",
    "rendra.ops.perspective_n_points": "EpnpSolution efficient_pnp",
    "rendra.ops.points_alignment": """
        ICPSolution SimilarityTransform corresponding_points_alignment iterative_closest_point""",
    "rendra.ops.points_normals": "estimate_pointcloud_local_coord_frames estimate_pointcloud_normals",
    "rendra.ops.points_to_volumes": """
        add_pointclouds_to_volumes add_points_features_to_volume_densities_features""",
    "rendra.ops.sample_farthest_points": "sample_farthest_points sample_farthest_points_naive",
    "rendra.ops.sample_points_from_meshes": "sample_points_from_meshes",
    "rendra.ops.subdivide_meshes": "SubdivideMeshes",
    "rendra.ops.utils": """
        convert_pointclouds_to_tensor eyes get_point_covariances is_pointclouds masked_gather wmean""",
    "rendra.ops.vert_align": "vert_align",
    "rendra.loss": """
        chamfer_distance mesh_edge_loss mesh_laplacian_smoothing mesh_normal_consistency point_mesh_edge_distance
        point_mesh_face_distance""",
    "rendra.loss.chamfer": "chamfer_distance",
    "rendra.loss.mesh_edge_loss": "mesh_edge_loss",
    "rendra.loss.mesh_laplacian_smoothing": "mesh_laplacian_smoothing",
    "rendra.loss.mesh_normal_consistency": "mesh_normal_consistency",
    "rendra.loss.point_mesh_distance": """
        edge_point_distance face_point_distance point_edge_distance point_face_distance point_mesh_edge_distance
        point_mesh_face_distance""",
    "rendra.utils": "cameras_from_opencv_projection checkerboard ico_sphere opencv_from_cameras_projection torus",
    "rendra.utils.checkerboard": "checkerboard",
    "rendra.ops.cameras_alignment": "corresponding_cameras_alignment",
    "rendra.utils.camera_conversions": "cameras_from_opencv_projection opencv_from_cameras_projection",
    "rendra.utils.ico_sphere": "ico_sphere",
    "rendra.utils.torus": "torus",
    "rendra.vis": "get_camera_wireframe plot_batch_individually plot_scene",
    "rendra.vis.plotly_vis": "AxisArgs Lighting get_camera_wireframe plot_batch_individually plot_scene",
    "rendra.vis.texture_vis": "texturesuv_image_PIL texturesuv_image_matplotlib",
    "rendra.renderer": """
        AmbientLights BlendParams DirectionalLights FishEyeCameras FoVOrthographicCameras FoVPerspectiveCameras
        HardDepthShader HardFlatShader HardGouraudShader HardPhongShader Materials MeshRasterizer MeshRenderer
        MeshRendererWithFragments OpenGLOrthographicCameras OpenGLPerspectiveCameras OrthographicCameras
        PerspectiveCameras PointLights RasterizationSettings SfMOrthographicCameras SfMPerspectiveCameras
        SoftDepthShader SoftGouraudShader SoftPhongShader SoftSilhouetteShader SplatterPhongShader TensorProperties
        TexturesAtlas TexturesUV TexturesVertex VolumeRenderer VolumeSampler camera_position_from_spherical_angles
        convert_to_tensors_and_broadcast diffuse get_world_to_view_transform gouraud_shading hard_rgb_blend
        look_at_rotation look_at_view_transform ndc_grid_sample ndc_to_grid_sample_coords phong_shading
        rasterize_meshes rotate_on_spot sigmoid_alpha_blend softmax_rgb_blend specular
        AbsorptionOnlyRaymarcher EmissionAbsorptionRaymarcher HarmonicEmbedding ImplicitRenderer
        GridRaysampler HeterogeneousRayBundle MonteCarloRaysampler MultinomialRaysampler NDCGridRaysampler
        NDCMultinomialRaysampler RayBundle ray_bundle_to_ray_points ray_bundle_variables_to_ray_points
        AlphaCompositor NormWeightedCompositor PointsRasterizationSettings PointsRasterizer PointsRenderer
        alpha_composite norm_weighted_sum rasterize_points weighted_sum""",
    "rendra.renderer.blending": "BlendParams hard_rgb_blend sigmoid_alpha_blend softmax_rgb_blend",
    "rendra.renderer.camera_utils": "camera_to_eye_at_up join_cameras_as_batch rotate_on_spot",
    "rendra.renderer.cameras": """
        CamerasBase FoVOrthographicCameras FoVPerspectiveCameras OrthographicCameras PerspectiveCameras
        camera_position_from_spherical_angles get_ndc_to_screen_transform get_screen_to_ndc_transform
        get_world_to_view_transform look_at_rotation look_at_view_transform try_get_projection_transform""",
    "rendra.renderer.fisheyecameras": "FishEyeCameras",
    "rendra.ops.sample_pdf": "sample_pdf",
    "rendra.renderer.implicit": """
        AbsorptionOnlyRaymarcher EmissionAbsorptionRaymarcher HarmonicEmbedding ImplicitRenderer VolumeRenderer
        VolumeSampler GridRaysampler HeterogeneousRayBundle MonteCarloRaysampler MultinomialRaysampler
        NDCGridRaysampler NDCMultinomialRaysampler RayBundle ray_bundle_to_ray_points
        ray_bundle_variables_to_ray_points""",
    "rendra.renderer.implicit.harmonic_embedding": "HarmonicEmbedding",
    "rendra.renderer.implicit.raymarching": (
        "AbsorptionOnlyRaymarcher EmissionAbsorptionRaymarcher opacity_from_density"
    ),
    "rendra.renderer.implicit.raysampling": """
        GridRaysampler HeterogeneousRayBundle MonteCarloRaysampler MultinomialRaysampler NDCGridRaysampler
        NDCMultinomialRaysampler RayBundle ray_bundle_to_ray_points ray_bundle_variables_to_ray_points""",
    "rendra.renderer.implicit.sample_pdf": "sample_pdf sample_pdf_python",
    "rendra.renderer.implicit.utils": """
        HeterogeneousRayBundle RayBundle ray_bundle_to_ray_points ray_bundle_variables_to_ray_points""",
    "rendra.renderer.lighting": "AmbientLights DirectionalLights PointLights diffuse specular",
    "rendra.renderer.materials": "Materials",
    "rendra.renderer.splatter_blend": "SplatterBlender",
    "rendra.renderer.utils": """
        TensorAccessor TensorProperties convert_to_tensors_and_broadcast format_tensor ndc_grid_sample
        ndc_to_grid_sample_coords parse_image_size""",
    "rendra.renderer.implicit.renderer": "ImplicitRenderer VolumeRenderer VolumeSampler",
    "rendra.renderer.mesh": """
        HardPhongShader MeshRasterizer MeshRenderer RasterizationSettings SoftPhongShader SoftSilhouetteShader
        TexturesAtlas TexturesUV TexturesVertex gouraud_shading phong_shading rasterize_meshes""",
    "rendra.renderer.mesh.clip": """
        ClipFrustum ClippedFaces clip_faces convert_clipped_rasterization_to_original_faces""",
    "rendra.renderer.mesh.rasterize_meshes": "non_square_ndc_range pix_to_non_square_ndc rasterize_meshes",
    "rendra.renderer.mesh.rasterizer": "Fragments MeshRasterizer RasterizationSettings",
    "rendra.renderer.mesh.renderer": "MeshRenderer MeshRendererWithFragments",
    "rendra.renderer.mesh.shader": """
        HardDepthShader HardFlatShader HardGouraudShader HardPhongShader ShaderBase SoftDepthShader
        SoftGouraudShader SoftPhongShader SoftSilhouetteShader SplatterPhongShader""",
    "rendra.renderer.mesh.shading": "flat_shading gouraud_shading phong_shading",
    "rendra.renderer.mesh.textures": "TexturesAtlas TexturesBase TexturesUV TexturesVertex",
    "rendra.renderer.compositing": "alpha_composite norm_weighted_sum weighted_sum",
    "rendra.renderer.points": """
        AlphaCompositor NormWeightedCompositor PointFragments PointsRasterizationSettings PointsRasterizer
        PointsRenderer rasterize_points""",
    "rendra.renderer.points.compositor": "AlphaCompositor NormWeightedCompositor",
    "rendra.renderer.points.rasterize_points": "rasterize_points",
    "rendra.renderer.points.rasterizer": "PointFragments PointsRasterizationSettings PointsRasterizer",
    "rendra.renderer.points.renderer": "PointsRenderer",
    "rendra.renderer.mesh.utils": "Rectangle PackedRectangle PackedRectangles pack_rectangles pack_unique_rectangles",
}

_LIGHT = "ambient_color=((0.5, 0.5, 0.5),), diffuse_color=((0.3, 0.3, 0.3),), specular_color=((0.2, 0.2, 0.2),)"
_SHADER = "device='cpu', cameras=None, lights=None, materials=None, blend_params=None"

# "..." stands for a default that is a tensor, or, for the dtype of transforms, differs on purpose: there the
# tensors that are given keep theirs.
SIGNATURES = {
    "rendra.transforms": {
        "Transform3d": "dtype=torch.float32, device='cpu', matrix=None",
        "Transform3d.compose": "self, *others",
        "Transform3d.inverse": "self, invert_composed=False",
        "Transform3d.stack": "self, *others",
        "Transform3d.transform_points": "self, points, eps=None",
        "Transform3d.transform_normals": "self, normals",
        "Transform3d.get_se3_log": "self, eps=1e-4, cos_bound=1e-4",
        "Transform3d.to": "self, device, copy=False, dtype=None",
        "Translate": "x, y=None, z=None, dtype=..., device=None",
        "Scale": "x, y=None, z=None, dtype=..., device=None",
        "Rotate": "R, dtype=..., device=None, orthogonal_tol=1e-5",
        "RotateAxisAngle": "angle, axis='X', degrees=True, dtype=..., device=None",
        "acos_linear_extrapolation": "x, bounds=(-0.9999, 0.9999)",
        "axis_angle_to_matrix": "axis_angle, fast=False",
        "matrix_to_axis_angle": "matrix, fast=False",
        "euler_angles_to_matrix": "euler_angles, convention",
        "matrix_to_euler_angles": "matrix, convention",
        "quaternion_apply": "quaternion, point",
        "random_quaternions": "n, dtype=None, device=None",
        "random_rotations": "n, dtype=None, device=None",
        "random_rotation": "dtype=None, device=None",
        "rotation_6d_to_matrix": "d6",
        "se3_exp_map": "log_transform, eps=1e-4",
        "se3_log_map": "transform, eps=1e-4, cos_bound=1e-4",
        "so3_exp_map": "log_rot, eps=1e-4",
        "so3_log_map": "R, eps=1e-4, cos_bound=1e-4",
        "so3_relative_angle": "R1, R2, cos_angle=False, cos_bound=1e-4, eps=1e-4",
        "so3_rotation_angle": "R, eps=1e-4, cos_angle=False, cos_bound=1e-4",
    },
    "rendra.structures.meshes": {
        "Meshes": "verts, faces, textures=None, *, verts_normals=None",
        "Meshes.to": "self, device, copy=False",
        "Meshes.extend": "self, N",
        "Meshes.get_mesh_verts_faces": "self, index",
        "Meshes.offset_verts": "self, vert_offsets_packed",
        "Meshes.offset_verts_": "self, vert_offsets_packed",
        "Meshes.scale_verts": "self, scale",
        "Meshes.scale_verts_": "self, scale",
        "Meshes.update_padded": "self, new_verts_padded",
        "Meshes.split": "self, split_sizes",
        "Meshes.submeshes": "self, face_indices",
        "Meshes.sample_textures": "self, fragments",
        "join_meshes_as_batch": "meshes, include_textures=True",
        "join_meshes_as_scene": "meshes, include_textures=True",
    },
    "rendra.structures.pointclouds": {
        "Pointclouds": "points, normals=None, features=None",
        "Pointclouds.estimate_normals": """self, neighborhood_size=50, disambiguate_directions=True,
            assign_to_self=False""",
        "Pointclouds.extend": "self, N",
        "Pointclouds.get_cloud": "self, index",
        "Pointclouds.inside_box": "self, box",
        "Pointclouds.offset": "self, offsets_packed",
        "Pointclouds.offset_": "self, offsets_packed",
        "Pointclouds.scale": "self, scale",
        "Pointclouds.scale_": "self, scale",
        "Pointclouds.split": "self, split_sizes",
        "Pointclouds.subsample": "self, max_points",
        "Pointclouds.to": "self, device, copy=False",
        "Pointclouds.update_padded": "self, new_points_padded, new_normals_padded=None, new_features_padded=None",
        "join_pointclouds_as_batch": "pointclouds",
        "join_pointclouds_as_scene": "pointclouds",
    },
    "rendra.structures.volumes": {
        "Volumes": """densities, features=None, voxel_size=1.0, volume_translation=(0.0, 0.0, 0.0),
            align_corners=True""",
        "Volumes.to": "self, device, copy=False",
        "Volumes.update_padded": "self, new_densities, new_features=None",
        "Volumes.get_coord_grid": "self, world_coordinates=True",
        "Volumes.local_to_world_coords": "self, points_3d_local",
        "Volumes.world_to_local_coords": "self, points_3d_world",
        "VolumeLocator": """batch_size, grid_sizes, device, voxel_size=1.0, volume_translation=(0.0, 0.0, 0.0),
            align_corners=True""",
    },
    "rendra.structures.utils": {
        "list_to_padded": "x, pad_size=None, pad_value=0.0, equisized=False",
        "padded_to_list": "x, split_size=None",
        "list_to_packed": "x",
        "packed_to_list": "x, split_size",
        "padded_to_packed": "x, split_size=None, pad_value=None",
    },
    "rendra.io": {
        "load_obj": """f, load_textures=True, create_texture_atlas=False, texture_atlas_size=4,
            texture_wrap='repeat', device='cpu', path_manager=None""",
        "load_objs_as_meshes": """files, device=None, load_textures=True, create_texture_atlas=False,
            texture_atlas_size=4, texture_wrap='repeat', path_manager=None""",
        "save_obj": """f, verts, faces, decimal_places=None, path_manager=None, *, normals=None,
            faces_normals_idx=None, verts_uvs=None, faces_uvs=None, texture_map=None""",
        "load_ply": "f, *, path_manager=None",
        "save_ply": "f, verts, faces=None, verts_normals=None, ascii=False, decimal_places=None, path_manager=None",
        "IO": "include_default_formats=True, path_manager=None",
        "IO.load_mesh": "self, path, include_textures=True, device='cpu', **kwargs",
        "IO.save_mesh": "self, data, path, binary=None, include_textures=True, **kwargs",
        "IO.load_pointcloud": "self, path, device='cpu', **kwargs",
        "IO.save_pointcloud": "self, data, path, binary=None, **kwargs",
        "IO.register_meshes_format": "self, interpreter",
    },
    "rendra.io.mtl_io": {
        "load_mtl": "f, *, material_names, data_dir, device='cpu', path_manager=None",
        "make_mesh_texture_atlas": """material_properties, texture_images, face_material_names, faces_uvs,
            texture_size, texture_wrap""",
    },
    "rendra.ops": {
        "box3d_overlap": "boxes1, boxes2, eps=1e-4",
        "cubify": "voxels, thresh, *, feats=None, device=None, align='topleft'",
        "marching_cubes": "vol_batch, isolevel=None, return_local_coords=True",
        "sample_farthest_points": "points, lengths=None, K=50, random_start_point=False",
        "corresponding_points_alignment": """X, Y, weights=None, estimate_scale=False, allow_reflection=False,
            eps=1e-9""",
        "efficient_pnp": "x, y, weights=None, skip_quadratic_eq=False",
        "estimate_pointcloud_local_coord_frames": """pointclouds, neighborhood_size=50, disambiguate_directions=True,
            *, use_symeig_workaround=True""",
        "estimate_pointcloud_normals": """pointclouds, neighborhood_size=50, disambiguate_directions=True, *,
            use_symeig_workaround=True""",
        "eyes": "dim, N, device=None, dtype=torch.float32",
        "get_point_covariances": "points_padded, num_points_per_cloud, neighborhood_size",
        "iterative_closest_point": """X, Y, init_transform=None, max_iterations=100, relative_rmse_thr=1e-6,
            estimate_scale=False, allow_reflection=False, verbose=False""",
        "packed_to_padded": "inputs, first_idxs, max_size",
        "padded_to_packed": "inputs, first_idxs, num_inputs, max_size_dim=1",
        "wmean": "x, weight=None, dim=-2, keepdim=True, eps=1e-9",
        "interpolate_face_attributes": "pix_to_face, barycentric_coords, face_attributes",
        "SubdivideMeshes": "meshes=None",
        "SubdivideMeshes.forward": "self, meshes, feats=None",
        "GraphConv": "input_dim, output_dim, init='normal', directed=False",
        "GraphConv.forward": "self, verts, edges",
        "cot_laplacian": "verts, faces, eps=1e-12",
        "laplacian": "verts, edges",
        "mesh_face_areas_normals": "verts, faces",
        "norm_laplacian": "verts, edges, eps=1e-12",
        "sample_points_from_meshes": "meshes, num_samples=10000, return_normals=False, return_textures=False",
        "taubin_smoothing": "meshes, lambd=0.53, mu=-0.53, num_iter=10",
        "vert_align": """feats, verts, return_packed=False, interp_mode='bilinear', padding_mode='zeros',
            align_corners=True""",
    },
    "rendra.loss.chamfer": {
        "chamfer_distance": """x, y, x_lengths=None, y_lengths=None, x_normals=None, y_normals=None, weights=None,
            batch_reduction='mean', point_reduction='mean', norm=2, single_directional=False, abs_cosine=True""",
    },
    "rendra.ops.ball_query": {
        "ball_query": """p1, p2, lengths1=None, lengths2=None, K=500, radius=0.2, return_nn=True,
            skip_points_outside_cube=False""",
    },
    "rendra.ops.knn": {
        "knn_points": """p1, p2, lengths1=None, lengths2=None, norm=2, K=1, version=-1, return_nn=False,
            return_sorted=True""",
        "knn_gather": "x, idx, lengths=None",
    },
    "rendra.ops.points_to_volumes": {
        "add_pointclouds_to_volumes": """pointclouds, initial_volumes, mode='trilinear', min_weight=1e-4,
            rescale_features=True""",
        "add_points_features_to_volume_densities_features": """points_3d, points_features, volume_densities,
            volume_features, mode='trilinear', min_weight=1e-4, mask=None, grid_sizes=None, rescale_features=True,
            align_corners=True""",
    },
    "rendra.loss.mesh_edge_loss": {"mesh_edge_loss": "meshes, target_length=0.0"},
    "rendra.loss.mesh_laplacian_smoothing": {"mesh_laplacian_smoothing": "meshes, method='uniform'"},
    "rendra.loss.mesh_normal_consistency": {"mesh_normal_consistency": "meshes"},
    "rendra.loss.point_mesh_distance": {
        "point_mesh_face_distance": "meshes, pcls, min_triangle_area=5e-3",
        "point_mesh_edge_distance": "meshes, pcls",
        "point_face_distance": """points, points_first_idx, tris, tris_first_idx, max_points,
            min_triangle_area=5e-3""",
        "face_point_distance": """points, points_first_idx, tris, tris_first_idx, max_tris,
            min_triangle_area=5e-3""",
        "point_edge_distance": "points, points_first_idx, segms, segms_first_idx, max_points",
        "edge_point_distance": "points, points_first_idx, segms, segms_first_idx, max_segms",
    },
    "rendra.ops.cameras_alignment": {
        "corresponding_cameras_alignment": (
            "cameras_src, cameras_tgt, estimate_scale=True, mode='extrinsics', eps=1e-9"
        ),
    },
    "rendra.utils": {
        "checkerboard": "radius=4, color1=(0.0, 0.0, 0.0), color2=(1.0, 1.0, 1.0), device=None",
        "ico_sphere": "level=0, device=None",
        "torus": "r, R, sides, rings, device=None",
        "cameras_from_opencv_projection": "R, tvec, camera_matrix, image_size",
        "opencv_from_cameras_projection": "cameras, image_size",
    },
    "rendra.vis.plotly_vis": {
        "AxisArgs": """showgrid=False, zeroline=False, showline=False, ticks='', showticklabels=False,
            backgroundcolor='#fff', showaxeslabels=False""",
        "Lighting": """ambient=0.8, diffuse=1.0, fresnel=0.0, specular=0.0, roughness=0.5,
            facenormalsepsilon=1e-6, vertexnormalsepsilon=1e-12""",
        "get_camera_wireframe": "scale=0.3",
        "plot_scene": """plots, *, viewpoint_cameras=None, ncols=1, camera_scale=0.3, pointcloud_max_points=20000,
            pointcloud_marker_size=1, raybundle_max_rays=20000, raybundle_max_points_per_ray=1000,
            raybundle_ray_point_marker_size=1, raybundle_ray_line_width=1, **kwargs""",
        "plot_batch_individually": """batched_structs, *, viewpoint_cameras=None, ncols=1, extend_struct=True,
            subplot_titles=None, **kwargs""",
    },
    "rendra.vis.texture_vis": {
        "texturesuv_image_PIL": "texture, *, texture_index=0, radius=1, color='red', subsample=10000",
        "texturesuv_image_matplotlib": """texture, *, texture_index=0, radius=1, color=(1.0, 0.0, 0.0),
            subsample=10000, origin='upper'""",
    },
    "rendra.renderer": {
        "FoVPerspectiveCameras": """znear=1.0, zfar=100.0, aspect_ratio=1.0, fov=60.0, degrees=True, R=..., T=...,
            K=None, device='cpu'""",
        "FoVPerspectiveCameras.compute_projection_matrix": "self, znear, zfar, fov, aspect_ratio, degrees",
        "FoVPerspectiveCameras.unproject_points": """self, xy_depth, world_coordinates=True,
            scaled_depth_input=False, **kwargs""",
        "FoVOrthographicCameras": """znear=1.0, zfar=100.0, max_y=1.0, min_y=-1.0, max_x=1.0, min_x=-1.0,
            scale_xyz=((1.0, 1.0, 1.0),), R=..., T=..., K=None, device='cpu'""",
        "FoVOrthographicCameras.compute_projection_matrix": """self, znear, zfar, max_x, min_x, max_y, min_y,
            scale_xyz""",
        "PerspectiveCameras": """focal_length=1.0, principal_point=((0.0, 0.0),), R=..., T=..., K=None,
            device='cpu', in_ndc=True, image_size=None""",
        "PerspectiveCameras.unproject_points": "self, xy_depth, world_coordinates=True, from_ndc=False, **kwargs",
        "PerspectiveCameras.get_principal_point": "self, **kwargs",
        "OrthographicCameras": """focal_length=1.0, principal_point=((0.0, 0.0),), R=..., T=..., K=None,
            device='cpu', in_ndc=True, image_size=None""",
        "FishEyeCameras": """focal_length=..., principal_point=..., radial_params=..., tangential_params=...,
            thin_prism_params=..., R=..., T=..., world_coordinates=False, use_radial=True, use_tangential=True,
            use_thin_prism=True, device='cpu', image_size=None""",
        "CamerasBase.transform_points": "self, points, eps=None, **kwargs",
        "CamerasBase.transform_points_ndc": "self, points, eps=None, **kwargs",
        "CamerasBase.transform_points_screen": "self, points, eps=None, with_xyflip=True, **kwargs",
        "CamerasBase.get_camera_center": "self, **kwargs",
        "CamerasBase.get_world_to_view_transform": "self, **kwargs",
        "CamerasBase.get_full_projection_transform": "self, **kwargs",
        "CamerasBase.get_ndc_camera_transform": "self, **kwargs",
        "look_at_rotation": "camera_position, at=((0, 0, 0),), up=((0, 1, 0),), device='cpu'",
        "look_at_view_transform": """dist=1.0, elev=0.0, azim=0.0, degrees=True, eye=None, at=((0, 0, 0),),
            up=((0, 1, 0),), device='cpu'""",
        "camera_position_from_spherical_angles": "distance, elevation, azimuth, degrees=True, device='cpu'",
        "rotate_on_spot": "R, T, rotation",
        "PointLights": f"{_LIGHT}, location=((0, 1, 0),), device='cpu'",
        "DirectionalLights": f"{_LIGHT}, direction=((0, 1, 0),), device='cpu'",
        "AmbientLights": "*, ambient_color=None, device='cpu'",
        "PointLights.diffuse": "self, normals, points",
        "PointLights.specular": "self, normals, points, camera_position, shininess",
        "Materials": """ambient_color=((1.0, 1.0, 1.0),), diffuse_color=((1.0, 1.0, 1.0),),
            specular_color=((1.0, 1.0, 1.0),), shininess=64, device='cpu'""",
        "diffuse": "normals, color, direction",
        "specular": "points, normals, direction, color, camera_position, shininess",
        "BlendParams": "sigma=1e-4, gamma=1e-4, background_color=(1.0, 1.0, 1.0)",
        "hard_rgb_blend": "colors, fragments, blend_params",
        "sigmoid_alpha_blend": "colors, fragments, blend_params",
        "softmax_rgb_blend": "colors, fragments, blend_params, znear=1.0, zfar=100",
        "TexturesVertex": "verts_features",
        "TexturesVertex.faces_verts_textures_packed": "self, faces_packed=None",
        "TexturesAtlas": "atlas",
        "TexturesUV": """maps, faces_uvs, verts_uvs, *, maps_ids=None, padding_mode='border', align_corners=True,
            sampling_mode='bilinear'""",
        "TexturesUV.centers_for_image": "self, index",
        "TexturesUV.submeshes": "self, vertex_ids_list, faces_ids_list",
        "RasterizationSettings": """image_size=256, blur_radius=0.0, faces_per_pixel=1, bin_size=None,
            max_faces_opengl=10_000_000, max_faces_per_bin=None, perspective_correct=None,
            clip_barycentric_coords=None, cull_backfaces=False, z_clip_value=None, cull_to_frustum=False""",
        "MeshRasterizer": "cameras=None, raster_settings=None",
        "MeshRasterizer.transform": "self, meshes_world, **kwargs",
        "MeshRasterizer.forward": "self, meshes_world, **kwargs",
        "rasterize_meshes": """meshes, image_size=256, blur_radius=0.0, faces_per_pixel=8, bin_size=None,
            max_faces_per_bin=None, perspective_correct=False, clip_barycentric_coords=False, cull_backfaces=False,
            z_clip_value=None, cull_to_frustum=False""",
        "VolumeRenderer": "raysampler, raymarcher, sample_mode='bilinear'",
        "VolumeRenderer.forward": "self, cameras, volumes, **kwargs",
        "VolumeSampler": "volumes, sample_mode='bilinear', padding_mode='zeros'",
        "VolumeSampler.forward": "self, ray_bundle, **kwargs",
        "MeshRenderer": "rasterizer, shader",
        "MeshRenderer.forward": "self, meshes_world, **kwargs",
        "MeshRendererWithFragments": "rasterizer, shader",
        "HardPhongShader": _SHADER,
        "HardPhongShader.forward": "self, fragments, meshes, **kwargs",
        "SoftPhongShader": _SHADER,
        "HardGouraudShader": _SHADER,
        "SoftGouraudShader": _SHADER,
        "HardFlatShader": _SHADER,
        "HardDepthShader": _SHADER,
        "SoftDepthShader": _SHADER,
        "SplatterPhongShader": "**kwargs",
        "SoftSilhouetteShader": "blend_params=None",
        "SoftSilhouetteShader.forward": "self, fragments, meshes, **kwargs",
        "phong_shading": "meshes, fragments, lights, cameras, materials, texels",
        "gouraud_shading": "meshes, fragments, lights, cameras, materials",
        "ndc_grid_sample": "input, grid_ndc, *, align_corners=False, **grid_sample_kwargs",
        "ndc_to_grid_sample_coords": "xy_ndc, image_size_hw",
    },
    "rendra.ops.sample_pdf": {"sample_pdf": "bins, weights, n_samples, det=False, eps=1e-5"},
    "rendra.renderer.implicit.sample_pdf": {
        "sample_pdf": "bins, weights, n_samples, det=False, eps=1e-5",
        "sample_pdf_python": "bins, weights, N_samples, det=False, eps=1e-5",
    },
    "rendra.renderer.implicit.utils": {
        "RayBundle": "origins, directions, lengths, xys",
        "HeterogeneousRayBundle": "origins, directions, lengths, xys, camera_ids=None, camera_counts=None",
        "ray_bundle_to_ray_points": "ray_bundle",
        "ray_bundle_variables_to_ray_points": "rays_origins, rays_directions, rays_lengths",
    },
    "rendra.renderer.implicit.raysampling": {
        "MultinomialRaysampler": """*, min_x, max_x, min_y, max_y, image_width, image_height, n_pts_per_ray,
            min_depth, max_depth, n_rays_per_image=None, n_rays_total=None, unit_directions=False,
            stratified_sampling=False""",
        "MultinomialRaysampler.forward": """self, cameras, *, mask=None, min_depth=None, max_depth=None,
            n_rays_per_image=None, n_pts_per_ray=None, stratified_sampling=None, n_rays_total=None, **kwargs""",
        "NDCMultinomialRaysampler": """*, image_width, image_height, n_pts_per_ray, min_depth, max_depth,
            n_rays_per_image=None, n_rays_total=None, unit_directions=False, stratified_sampling=False""",
        "MonteCarloRaysampler": """min_x, max_x, min_y, max_y, n_rays_per_image, n_pts_per_ray, min_depth, max_depth,
            *, n_rays_total=None, unit_directions=False, stratified_sampling=False""",
        "MonteCarloRaysampler.forward": "self, cameras, *, stratified_sampling=None, **kwargs",
        "GridRaysampler": """min_x, max_x, min_y, max_y, image_width, image_height, n_pts_per_ray, min_depth,
            max_depth""",
        "NDCGridRaysampler": "image_width, image_height, n_pts_per_ray, min_depth, max_depth",
    },
    "rendra.renderer.implicit.raymarching": {
        "EmissionAbsorptionRaymarcher": "surface_thickness=1",
        "EmissionAbsorptionRaymarcher.forward": "self, rays_densities, rays_features, eps=1e-10, **kwargs",
        "AbsorptionOnlyRaymarcher.forward": "self, rays_densities, **kwargs",
    },
    "rendra.renderer.implicit.renderer": {
        "ImplicitRenderer": "raysampler, raymarcher",
        "ImplicitRenderer.forward": "self, cameras, volumetric_function, **kwargs",
    },
    "rendra.renderer.implicit.harmonic_embedding": {
        "HarmonicEmbedding": "n_harmonic_functions=6, omega_0=1.0, logspace=True, append_input=True",
        "HarmonicEmbedding.forward": "self, x, diag_cov=None, **kwargs",
        "HarmonicEmbedding.get_output_dim": "self, input_dims=3",
        "HarmonicEmbedding.get_output_dim_static": "input_dims, n_harmonic_functions, append_input",
    },
    "rendra.renderer.camera_utils": {
        "camera_to_eye_at_up": "world_to_view_transform",
        "join_cameras_as_batch": "cameras_list",
    },
    "rendra.renderer.cameras": {
        "get_ndc_to_screen_transform": "cameras, with_xyflip=False, image_size=None",
        "get_screen_to_ndc_transform": "cameras, with_xyflip=False, image_size=None",
        "try_get_projection_transform": "cameras, cameras_kwargs",
    },
    "rendra.renderer.mesh.rasterizer": {"Fragments": "pix_to_face, zbuf, bary_coords, dists"},
    "rendra.renderer.mesh.shading": {"flat_shading": "meshes, fragments, lights, cameras, materials, texels"},
    "rendra.renderer.compositing": {
        "alpha_composite": "pointsidx, alphas, pt_clds",
        "norm_weighted_sum": "pointsidx, alphas, pt_clds",
        "weighted_sum": "pointsidx, alphas, pt_clds",
    },
    "rendra.renderer.points": {
        "AlphaCompositor": "background_color=None",
        "AlphaCompositor.forward": "self, fragments, alphas, ptclds, **kwargs",
        "NormWeightedCompositor": "background_color=None",
        "NormWeightedCompositor.forward": "self, fragments, alphas, ptclds, **kwargs",
        "PointFragments": "idx, zbuf, dists",
        "PointsRasterizationSettings": """image_size=256, radius=0.01, points_per_pixel=8, bin_size=None,
            max_points_per_bin=None""",
        "PointsRasterizer": "cameras=None, raster_settings=None",
        "PointsRasterizer.transform": "self, point_clouds, **kwargs",
        "PointsRasterizer.forward": "self, point_clouds, **kwargs",
        "PointsRenderer": "rasterizer, compositor",
        "PointsRenderer.forward": "self, point_clouds, **kwargs",
        "rasterize_points": """pointclouds, image_size=256, radius=0.01, points_per_pixel=8, bin_size=None,
            max_points_per_bin=None""",
    },
}

METHODS = {
    "rendra.transforms.Transform3d": """
        clone compose cpu cuda get_matrix get_se3_log inverse rotate rotate_axis_angle scale stack to
        transform_normals transform_points translate __getitem__ __len__""",
    "rendra.structures.Meshes": """
        clone cpu cuda detach edges_packed edges_packed_to_mesh_idx equisized extend faces_areas_packed faces_list
        faces_normals_list faces_normals_packed faces_normals_padded faces_packed faces_packed_to_edges_packed
        faces_packed_to_mesh_idx faces_padded get_bounding_boxes get_mesh_verts_faces has_verts_normals isempty
        laplacian_packed mesh_to_edges_packed_first_idx mesh_to_faces_packed_first_idx
        mesh_to_verts_packed_first_idx num_edges_per_mesh num_faces_per_mesh num_verts_per_mesh offset_verts
        offset_verts_ sample_textures scale_verts scale_verts_ split submeshes textures to update_padded valid
        verts_list verts_normals_list verts_normals_packed verts_normals_padded verts_packed
        verts_packed_to_mesh_idx verts_padded verts_padded_to_packed_idx __getitem__ __len__""",
    "rendra.structures.Pointclouds": """
        clone cloud_to_packed_first_idx cpu cuda detach device equisized estimate_normals extend features_list
        features_packed features_padded get_bounding_boxes get_cloud inside_box isempty normals_list normals_packed
        normals_padded num_points_per_cloud offset offset_ packed_to_cloud_idx padded_to_packed_idx points_list
        points_packed points_padded scale scale_ split subsample to update_padded valid __getitem__ __len__""",
    "rendra.structures.Volumes": """
        clone cpu cuda densities densities_list device features features_list get_align_corners get_coord_grid
        get_grid_sizes get_local_to_world_coords_transform get_world_to_local_coords_transform local_to_world_coords
        to update_padded world_to_local_coords __getitem__ __len__""",
    "rendra.structures.volumes.VolumeLocator": """
        clone get_coord_grid get_grid_sizes get_local_to_world_coords_transform get_world_to_local_coords_transform
        local_to_world_coords world_to_local_coords __getitem__""",
    "rendra.renderer.CamerasBase": """
        clone get_camera_center get_full_projection_transform get_image_size get_ndc_camera_transform
        get_projection_transform get_world_to_view_transform get_znear in_ndc is_perspective to transform_points
        transform_points_ndc transform_points_screen unproject_points __getitem__ __len__""",
    "rendra.renderer.TensorProperties": "clone gather_props isempty to __getitem__ __len__",
    "rendra.renderer.TexturesVertex": """
        clone detach extend faces_verts_textures_packed isempty join_batch join_scene sample_textures submeshes to
        verts_features_list verts_features_packed verts_features_padded __getitem__ __len__""",
    "rendra.renderer.TexturesUV": """
        centers_for_image clone detach extend faces_uvs_list faces_uvs_padded faces_verts_textures_packed join_batch
        join_scene maps_ids_list maps_ids_padded maps_list maps_padded sample_textures submeshes to verts_uvs_list
        verts_uvs_padded __getitem__ __len__""",
    "rendra.renderer.TexturesAtlas": """
        atlas_list atlas_packed atlas_padded clone detach extend faces_verts_textures_packed join_batch join_scene
        sample_textures submeshes to __getitem__ __len__""",
    "rendra.renderer.mesh.rasterizer.Fragments": "detach",
}


def _member(module: str, path: str) -> Any:
    """The object that a dotted path names inside a module."""
    found = importlib.import_module(module)
    for name in path.split("."):
        found = getattr(found, name)
    return found


@pytest.mark.parametrize("module", NAMES)
def test_names_stand_where_scripts_import_them_from(module: str) -> None:
    found = importlib.import_module(module)
    assert [name for name in NAMES[module].split() if not hasattr(found, name)] == []


@pytest.mark.parametrize("module", [m for m in NAMES if hasattr(importlib.import_module(m), "__all__")])
def test_star_imports_work(module: str) -> None:
    found = importlib.import_module(module)
    assert [name for name in found.__all__ if not hasattr(found, name)] == []


@pytest.mark.parametrize("owner", METHODS)
def test_classes_have_the_members_that_scripts_use(owner: str) -> None:
    found = _member(*owner.rsplit(".", 1))
    assert [name for name in METHODS[owner].split() if not hasattr(found, name)] == []


@pytest.mark.parametrize(("module", "path"), [(m, path) for m, table in SIGNATURES.items() for path in table])
def test_signatures_take_the_same_calls(module: str, path: str) -> None:
    """Same names, order, kinds and defaults; what is ours beside it is keyword-only and optional."""
    arguments = " ".join(SIGNATURES[module][path].split())
    documented = inspect.signature(eval(f"lambda {arguments}: 0", {"torch": torch}))
    ours = dict(inspect.signature(_member(module, path)).parameters)
    extra = [parameter for name, parameter in ours.items() if name not in documented.parameters]
    assert all(p.kind is p.KEYWORD_ONLY and p.default is not p.empty for p in extra), extra
    shared = [name for name in ours if name in documented.parameters]
    assert shared == list(documented.parameters)
    for name, parameter in documented.parameters.items():
        assert ours[name].kind == parameter.kind, name
        if parameter.default is ...:
            assert ours[name].default is not parameter.empty, name
        else:
            assert ours[name].default == parameter.default, name


def test_results_of_load_obj_keep_their_fields() -> None:
    assert Faces._fields == ("verts_idx", "normals_idx", "textures_idx", "materials_idx")
    assert Properties._fields == ("normals", "verts_uvs", "material_colors", "texture_images", "texture_atlas")
