"""Short scripts as users of PyTorch3D write them, with only the imports changed.

Each runs one piece of work from loading to result and checks the result, so that what scripts rely on between the
lines (defaults, shapes, keywords that override, attributes that are written to) keeps working.
"""

import copy
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn as nn
from assertions import assert_close, assert_finite

from rendra.io import IO, load_obj, load_objs_as_meshes, load_ply, save_obj, save_ply
from rendra.loss import chamfer_distance, mesh_edge_loss, mesh_laplacian_smoothing, mesh_normal_consistency
from rendra.ops import interpolate_face_attributes, sample_points_from_meshes
from rendra.renderer import (
    AlphaCompositor,
    AmbientLights,
    BlendParams,
    DirectionalLights,
    EmissionAbsorptionRaymarcher,
    FoVOrthographicCameras,
    FoVPerspectiveCameras,
    HardPhongShader,
    Materials,
    MeshRasterizer,
    MeshRenderer,
    MeshRendererWithFragments,
    NDCGridRaysampler,
    NormWeightedCompositor,
    OrthographicCameras,
    PerspectiveCameras,
    PointLights,
    PointsRasterizationSettings,
    PointsRasterizer,
    PointsRenderer,
    RasterizationSettings,
    SfMPerspectiveCameras,
    SoftPhongShader,
    SoftSilhouetteShader,
    TexturesUV,
    TexturesVertex,
    VolumeRenderer,
    VolumeSampler,
    compositing,
    hard_rgb_blend,
    look_at_rotation,
    look_at_view_transform,
    phong_shading,
)
from rendra.renderer.cameras import get_world_to_view_transform
from rendra.renderer.mesh.rasterize_meshes import pix_to_non_square_ndc
from rendra.renderer.mesh.shader import ShaderBase
from rendra.renderer.points import rasterize_points
from rendra.structures import Meshes, Pointclouds, Volumes, join_meshes_as_batch, join_meshes_as_scene
from rendra.transforms import (
    RotateAxisAngle,
    Transform3d,
    euler_angles_to_matrix,
    so3_exp_map,
    so3_log_map,
    so3_relative_angle,
)
from rendra.transforms.so3 import hat, hat_inv
from rendra.utils import ico_sphere

device = torch.device("cpu")


def colored_sphere(level: int = 2, color: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Meshes:
    mesh = ico_sphere(level, device)
    verts_rgb = torch.ones_like(mesh.verts_packed())[None] * torch.tensor(color, device=device)
    mesh.textures = TexturesVertex(verts_features=verts_rgb)
    return mesh


def phong_renderer_of(size: int | tuple[int, int] = 48) -> MeshRenderer:
    R, T = look_at_view_transform(2.7, 0, 180)
    cameras = FoVPerspectiveCameras(device=device, R=R, T=T)
    raster_settings = RasterizationSettings(image_size=size, blur_radius=0.0, faces_per_pixel=1)
    lights = PointLights(device=device, location=[[0.0, 0.0, -3.0]])
    return MeshRenderer(
        rasterizer=MeshRasterizer(cameras=cameras, raster_settings=raster_settings),
        shader=HardPhongShader(device=device, cameras=cameras, lights=lights),
    )


# -- files, rotations and cameras


@pytest.mark.parametrize("kind", [PerspectiveCameras, OrthographicCameras])
def test_table_of_screen_cameras(shared_data: Path, kind: type) -> None:
    """The eight cameras of a table, whose image size and centre are written width first by mistake: the library
    reads (H, W) = (1024, 512), and what it prints follows."""
    verts, faces, properties = load_obj(shared_data / "cube" / "cube_texture.obj")
    assert faces.verts_idx.shape[1] == 3
    assert properties.verts_uvs.shape[1] == 2
    numbers = torch.arange(-4, 4).float()
    angles = torch.stack((5 * numbers, numbers, numbers), dim=1) * (np.pi / 180)
    R = euler_angles_to_matrix(angles, "ZYX")
    T = torch.stack((numbers, torch.zeros(8), torch.zeros(8)), dim=1)
    T[:, 2] += 5  # in front of the cube
    cameras = kind(
        focal_length=((1200, 300),) * 8,
        principal_point=((512, 256),) * 8,
        in_ndc=False,
        image_size=((1024, 512),) * 8,
        R=R,
        T=T,
        device=device,
    )
    view = cameras.get_world_to_view_transform().transform_points(verts)
    assert_close(view, verts @ R + T[:, None])
    projected = cameras.get_full_projection_transform().transform_points(verts)
    depth = view[..., 2:] if kind is PerspectiveCameras else 1.0
    expected = view[..., :2] / depth * torch.tensor([1200.0, 300.0]) + torch.tensor([512.0, 256.0])
    assert_close(projected[..., :2], expected, atol=1e-2)
    screen = cameras.transform_points_screen(verts)
    assert_close(screen[..., :2], 2 * torch.tensor([512.0, 256.0]) - expected, atol=1e-2)
    ndc = cameras.transform_points_ndc(verts)
    assert_close(ndc[..., :2], (torch.tensor([256.0, 512.0]) - screen[..., :2]) / 256, atol=1e-4)
    assert_close(cameras.get_camera_center(), -(T[:, None] @ R.transpose(1, 2))[:, 0])


def test_rotation_vectors_come_back() -> None:
    log_rot = torch.tensor([[0.1, 0.2, 0.3], [0.2, 0.3, 0.4], [0.3, 0.4, 0.5], [0.4, 0.5, 0.6]], device=device)
    log_rot_hat = hat(log_rot)
    assert_close(log_rot_hat, -log_rot_hat.transpose(1, 2))
    assert_close(hat_inv(log_rot_hat), log_rot)
    rotations = so3_exp_map(log_rot)
    assert_close(rotations, torch.linalg.matrix_exp(log_rot_hat))
    assert_close(so3_log_map(rotations), log_rot)


def test_chained_transforms_move_points_in_order() -> None:
    points = torch.rand(2, 5, 3)
    chain = Transform3d(device=device).scale(2.0).rotate_axis_angle(90, axis="Z").translate(1.0, 0.0, 0.0)
    moved = chain.transform_points(points)
    assert_close(moved[..., 0], 1 - 2 * points[..., 1])
    assert_close(chain.inverse().transform_points(moved), points)
    assert RotateAxisAngle(30.0).get_matrix().dtype == torch.float32
    assert RotateAxisAngle(torch.tensor(30.0).double()).get_matrix().dtype == torch.float64


def test_saving_what_is_being_optimised(tmp_path: Path) -> None:
    """Results of a fit still require grad when they are written."""
    mesh = ico_sphere(1, device)
    offsets = torch.full(mesh.verts_packed().shape, 0.1, device=device, requires_grad=True)
    final_verts, final_faces = mesh.offset_verts(offsets).get_mesh_verts_faces(0)
    final_verts = final_verts * 2.0 + 1.0
    save_obj(tmp_path / "final.obj", final_verts, final_faces)
    verts, faces, _ = load_obj(tmp_path / "final.obj")
    assert_close(verts, final_verts.detach(), atol=1e-5)
    assert torch.equal(faces.verts_idx, final_faces)
    save_ply(str(tmp_path / "final.ply"), verts=final_verts, faces=final_faces, ascii=True)
    assert_close(load_ply(str(tmp_path / "final.ply"))[0], final_verts.detach(), atol=1e-5)
    IO().save_mesh(colored_sphere(1, (0.5, 0.0, 1.0)), tmp_path / "colored.ply")
    colors = IO().load_mesh(tmp_path / "colored.ply", device=device).textures.verts_features_packed()
    assert_close(colors, [[0.5, 0.0, 1.0]] * 42, atol=1 / 255)


def test_mesh_is_centred_and_scaled_in_place(shared_data: Path) -> None:
    mesh = load_objs_as_meshes([str(shared_data / "cow" / "cow.obj")], device=device)
    assert mesh.textures.maps_padded().squeeze().cpu().numpy().shape[2] == 3
    verts = mesh.verts_packed()
    center = verts.mean(0)
    scale = max((verts - center).abs().max(0)[0])
    mesh.offset_verts_(-center)
    mesh.scale_verts_(1.0 / float(scale))
    assert_close(mesh.verts_packed().abs().max(), 1.0)
    assert_close(mesh.get_bounding_boxes()[0].abs().max(), 1.0)


# -- pictures


def test_six_lightings_of_the_cow(shared_data: Path) -> None:
    """Light in front, light behind, a side view of it, and highlights of two colours and of none."""
    mesh = load_objs_as_meshes([str(shared_data / "cow" / "cow.obj")], device=device)
    renderer = phong_renderer_of(64)
    front = renderer(mesh)
    assert front.shape == (1, 64, 64, 4)
    lights = PointLights(device=device)
    lights.location = torch.tensor([0.0, 0.0, +1.0], device=device)[None]
    back = renderer(mesh, lights=lights)
    R, T = look_at_view_transform(dist=2.7, elev=10, azim=-150)
    cameras = FoVPerspectiveCameras(device=device, R=R, T=T)
    lights.location = torch.tensor([[2.0, 2.0, -2.0]], device=device)

    def with_highlight(color: list[float], shininess: float) -> torch.Tensor:
        materials = Materials(device=device, specular_color=[color], shininess=shininess)
        return renderer(mesh, lights=lights, materials=materials, cameras=cameras)

    dark = renderer(mesh, lights=lights, cameras=cameras)
    green, red, blue = (
        with_highlight(*look) for look in (([0.0, 1.0, 0.0], 10.0), ([1.0, 0.0, 0.0], 20.0), ([0.0, 0.0, 1.0], 0.0))
    )
    none = with_highlight([0.0, 0.0, 0.0], 0.0)
    covered = front[..., 3] > 0
    assert torch.equal(covered, back[..., 3] > 0)
    assert front[covered][:, :3].mean() > back[covered][:, :3].mean() + 0.02
    assert (front[~covered] == torch.tensor([1.0, 1.0, 1.0, 0.0])).all()
    for image, channel in ((green, 1), (red, 0), (blue, 2)):
        gain = (image - none)[..., :3].sum((0, 1, 2))
        assert gain[channel] > 0.1
        assert gain.sum() - gain[channel] == pytest.approx(0.0, abs=1e-4)
    assert (dark[..., :3] - none[..., :3]).min() >= 0


def test_silhouette_and_phong_renderers_side_by_side(shared_data: Path) -> None:
    """The renderers of a pose fit, called with R, T and with cameras."""
    verts, faces_idx, _ = load_obj(shared_data / "teapot.obj")
    faces = faces_idx.verts_idx
    verts_rgb = torch.ones_like(verts)[None]  # (1, V, 3)
    textures = TexturesVertex(verts_features=verts_rgb.to(device))
    teapot_mesh = Meshes(verts=[verts.to(device)], faces=[faces.to(device)], textures=textures)
    cameras = FoVPerspectiveCameras(device=device)
    blend_params = BlendParams(sigma=1e-4, gamma=1e-4)
    raster_settings = RasterizationSettings(
        image_size=64, blur_radius=np.log(1.0 / 1e-4 - 1.0) * blend_params.sigma, faces_per_pixel=100
    )
    silhouette_renderer = MeshRenderer(
        rasterizer=MeshRasterizer(cameras=cameras, raster_settings=raster_settings),
        shader=SoftSilhouetteShader(blend_params=blend_params),
    )
    raster_settings = RasterizationSettings(image_size=64, blur_radius=0.0, faces_per_pixel=1)
    lights = PointLights(device=device, location=((2.0, 2.0, -2.0),))
    phong_renderer = MeshRenderer(
        rasterizer=MeshRasterizer(cameras=cameras, raster_settings=raster_settings),
        shader=HardPhongShader(device=device, cameras=cameras, lights=lights),
    )
    R, T = look_at_view_transform(3, 50.0, 0.0, device=device)
    silhouette = silhouette_renderer(meshes_world=teapot_mesh, R=R, T=T)
    image_ref = phong_renderer(meshes_world=teapot_mesh, R=R, T=T)
    silhouette = silhouette.cpu().numpy()
    image_ref = image_ref.cpu().numpy()
    assert silhouette.shape == image_ref.shape == (1, 64, 64, 4)
    solid, hard = silhouette[..., 3] > 0.5, image_ref[..., 3] > 0
    assert not (hard & ~solid).any()
    assert (solid & ~hard).mean() < 0.03  # the outermost pixels, which several faces reach
    mask = image_ref[..., :3].max(-1) != 1  # the way a reference mask is made
    assert (mask == (image_ref[..., 3] > 0)).mean() > 0.99
    given = phong_renderer(meshes_world=teapot_mesh, cameras=FoVPerspectiveCameras(R=R, T=T), lights=lights)
    assert_close(given, torch.from_numpy(image_ref))


class PoseModel(nn.Module):
    """A camera position to be found from a silhouette."""

    def __init__(self, meshes: Meshes, renderer: MeshRenderer, image_ref: np.ndarray) -> None:
        super().__init__()
        self.meshes = meshes
        self.device = meshes.device
        self.renderer = renderer
        self.register_buffer("image_ref", torch.from_numpy(image_ref))
        start = np.array([1.0, 2.3, 2.0], dtype=np.float32)
        self.camera_position = nn.Parameter(torch.from_numpy(start).to(meshes.device))

    def forward(self) -> tuple[torch.Tensor, torch.Tensor]:
        R = look_at_rotation(self.camera_position[None, :], device=self.device)  # (1, 3, 3)
        T = -torch.bmm(R.transpose(1, 2), self.camera_position[None, :, None])[:, :, 0]  # (1, 3)
        image = self.renderer(meshes_world=self.meshes.clone(), R=R, T=T)
        return torch.sum((image[..., 3] - self.image_ref) ** 2), image


def test_camera_position_is_fitted_to_a_silhouette() -> None:
    box = ico_sphere(2, device)
    box = box.update_padded(box.verts_padded() * torch.tensor([1.0, 0.3, 0.6]))
    blend_params = BlendParams(sigma=1e-4, gamma=1e-4)
    cameras = FoVPerspectiveCameras(device=device)
    raster_settings = RasterizationSettings(
        image_size=48, blur_radius=np.log(1.0 / 1e-4 - 1.0) * blend_params.sigma, faces_per_pixel=100
    )
    renderer = MeshRenderer(
        rasterizer=MeshRasterizer(cameras=cameras, raster_settings=raster_settings),
        shader=SoftSilhouetteShader(blend_params=blend_params),
    )
    R, T = look_at_view_transform(3, 50.0, 0.0, device=device)
    image_ref = (renderer(meshes_world=box, R=R, T=T)[..., 3] > 0.5).float().numpy()
    model = PoseModel(meshes=box, renderer=renderer, image_ref=image_ref).to(device)
    assert [name for name, _ in model.named_parameters()] == ["camera_position"]
    optimizer = torch.optim.Adam(model.parameters(), lr=0.05)
    losses = []
    for _ in range(30):
        optimizer.zero_grad()
        loss, _ = model()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.25 * losses[0]
    distance = model.camera_position.detach().norm()
    assert distance == pytest.approx(3.0, abs=0.15)


def test_twenty_views_in_one_call_and_one_by_one() -> None:
    num_views = 20
    elev = torch.linspace(0, 360, num_views)
    azim = torch.linspace(-180, 180, num_views)
    R, T = look_at_view_transform(dist=2.7, elev=elev, azim=azim)
    cameras = FoVPerspectiveCameras(device=device, R=R, T=T)
    camera = FoVPerspectiveCameras(device=device, R=R[None, 1, ...], T=T[None, 1, ...])
    lights = PointLights(device=device, location=[[0.0, 0.0, -3.0]])
    renderer = MeshRenderer(
        rasterizer=MeshRasterizer(cameras=camera, raster_settings=RasterizationSettings(image_size=32)),
        shader=SoftPhongShader(device=device, cameras=camera, lights=lights),
    )
    mesh = colored_sphere(1)
    mesh.textures = TexturesVertex(torch.rand(1, 42, 3))
    meshes = mesh.extend(num_views)
    target_images = renderer(meshes, cameras=cameras, lights=lights)
    target_rgb = [target_images[i, ..., :3] for i in range(num_views)]
    target_cameras = [
        FoVPerspectiveCameras(device=device, R=R[None, i, ...], T=T[None, i, ...]) for i in range(num_views)
    ]
    for i in (0, 1, 13):
        assert_close(renderer(mesh, cameras=target_cameras[i], lights=lights)[0, ..., :3], target_rgb[i])
        assert_close(renderer(mesh, cameras=cameras[i], lights=lights)[0, ..., :3], target_rgb[i])
    assert_close(renderer(mesh)[0, ..., :3], target_rgb[1])
    assert len(renderer(meshes, R=R, T=T, lights=lights)) == num_views


def test_parts_of_a_renderer_are_replaced_between_calls() -> None:
    renderer = phong_renderer_of(32)
    mesh = colored_sphere()
    first = renderer(mesh)
    renderer.rasterizer.raster_settings.image_size = (24, 40)
    renderer.rasterizer.raster_settings.faces_per_pixel = 1
    renderer.rasterizer.raster_settings.blur_radius = 0.0
    assert renderer(mesh).shape == (1, 24, 40, 4)
    renderer.rasterizer.raster_settings = RasterizationSettings(image_size=32)
    renderer.rasterizer.cameras = renderer.shader.cameras = FoVPerspectiveCameras(T=torch.tensor([[0.0, 0.0, 6.0]]))
    assert (renderer(mesh)[..., 3].sum() / first[..., 3].sum()) < 0.5
    assert_close(renderer.rasterizer.cameras.get_camera_center(), [[0.0, 0.0, -6.0]])
    renderer.shader.lights = AmbientLights(device=device)
    inside = renderer(mesh)
    assert_close(inside[inside[..., 3] > 0], torch.ones(int(inside[..., 3].sum()), 4))
    renderer.shader.blend_params = BlendParams(background_color=(0.0, 0.25, 0.5))
    assert_close(renderer(mesh)[0, 0, 0], [0.0, 0.25, 0.5, 0.0])
    again = copy.deepcopy(renderer).to(device)
    assert_close(again(mesh), renderer(mesh))


def test_lights_follow_the_camera_in_a_batch() -> None:
    """Lights written through an index, and a batch of them."""
    R, T = look_at_view_transform(2.7, 0, torch.tensor([0.0, 90.0, 180.0]))
    cameras = FoVPerspectiveCameras(R=R, T=T)
    lights = DirectionalLights(direction=torch.zeros(3, 3), specular_color=((0.0, 0.0, 0.0),))
    for i in range(3):
        lights[i].direction = cameras.get_camera_center()[i]
    renderer = phong_renderer_of(32)
    images = renderer(colored_sphere().extend(3), cameras=cameras, lights=lights)
    assert_close(images[:, 16, 16, 0], [0.8, 0.8, 0.8], atol=1e-2)


# -- fragments


def test_depth_map_unprojects_to_the_surface() -> None:
    R, T = look_at_view_transform(2.0, 25.0, 40.0)
    for cameras in (
        FoVPerspectiveCameras(R=R, T=T, fov=70.0),
        PerspectiveCameras(R=R, T=T, focal_length=1.4),
        PerspectiveCameras(
            R=R, T=T, focal_length=30.0, principal_point=((20.0, 15.0),), in_ndc=False, image_size=((30, 44),)
        ),
    ):
        rasterizer = MeshRasterizer(cameras=cameras, raster_settings=RasterizationSettings(image_size=(30, 44)))
        fragments = rasterizer(ico_sphere(4))
        depth = fragments.zbuf[0, ..., 0]
        y, x = torch.meshgrid(
            -torch.tensor([pix_to_non_square_ndc(i, 30, 44) for i in range(30)]),
            -torch.tensor([pix_to_non_square_ndc(i, 44, 30) for i in range(44)]),
            indexing="ij",
        )
        xy_depth = torch.stack((x, y, depth), dim=-1)[depth > 0]
        points = cameras.unproject_points(xy_depth, world_coordinates=True, from_ndc=True)
        assert len(points) > 100
        assert_close(points.norm(dim=-1), torch.ones(len(points)), atol=2e-3)
        screen = cameras.transform_points_screen(points, image_size=((30, 44),))
        rows, columns = (depth > 0).nonzero(as_tuple=True)
        assert_close(screen[:, :2], torch.stack((columns, rows), dim=1) + 0.5, atol=1e-3)


def test_fragments_index_faces_and_interpolate_attributes() -> None:
    renderer = MeshRendererWithFragments(
        rasterizer=phong_renderer_of((20, 32)).rasterizer,
        shader=phong_renderer_of().shader,
    )
    meshes = join_meshes_as_batch([colored_sphere(1), colored_sphere(2)])
    images, fragments = renderer(meshes)
    assert images.shape == (2, 20, 32, 4)
    assert fragments.pix_to_face.shape == (2, 20, 32, 1)
    assert fragments.bary_coords.shape == (2, 20, 32, 1, 3)
    assert fragments.pix_to_face[0].max() < 80 <= fragments.pix_to_face[1].max()
    corners = meshes.verts_packed()[meshes.faces_packed()]
    points = interpolate_face_attributes(fragments.pix_to_face, fragments.bary_coords, corners)
    seen = fragments.pix_to_face >= 0
    view = renderer.rasterizer.cameras.get_world_to_view_transform().transform_points(points[seen])
    assert_close(view[:, 2], fragments.zbuf[seen])
    without = replace(fragments, bary_coords=torch.ones_like(fragments.bary_coords))
    assert without.zbuf is fragments.zbuf
    normals = interpolate_face_attributes(
        fragments.pix_to_face,
        torch.ones_like(fragments.bary_coords),
        meshes.verts_normals_packed()[meshes.faces_packed()],
    )
    assert normals.shape == (2, 20, 32, 1, 3)


class TintShader(ShaderBase):
    """A user's shader from the library's pieces."""

    def forward(self, fragments, meshes, **kwargs):
        cameras = kwargs.get("cameras", self.cameras)
        texels = meshes.sample_textures(fragments)
        colors = phong_shading(
            meshes=meshes,
            fragments=fragments,
            texels=texels,
            lights=kwargs.get("lights", self.lights),
            cameras=cameras,
            materials=kwargs.get("materials", self.materials),
        )
        return hard_rgb_blend(colors * torch.tensor([1.0, 0.5, 0.0]), fragments, self.blend_params)


def test_shaders_of_users_see_what_ours_see() -> None:
    renderer = phong_renderer_of(32)
    mesh = colored_sphere()
    mesh.textures = TexturesVertex(torch.rand_like(mesh.verts_padded()))
    plain = renderer(mesh)
    renderer.shader = TintShader(device=device, cameras=renderer.shader.cameras, lights=renderer.shader.lights)
    tinted = renderer(mesh)
    inside = plain[..., 3] > 0
    assert_close(tinted[inside], plain[inside] * torch.tensor([1.0, 0.5, 0.0, 1.0]))
    assert torch.equal(tinted[~inside], plain[~inside])


# -- optimisation


def test_shape_and_color_are_fitted_to_views() -> None:
    """A sphere's vertices and colours are pulled towards an ellipsoid of another colour."""
    num_views = 3
    R, T = look_at_view_transform(2.7, 10.0, torch.tensor([0.0, 120.0, 240.0]))
    lights = AmbientLights(device=device)
    camera = FoVPerspectiveCameras(device=device, R=R[None, 1, ...], T=T[None, 1, ...])
    sigma = 1e-4
    raster_settings_soft = RasterizationSettings(
        image_size=32,
        blur_radius=np.log(1.0 / 1e-4 - 1.0) * sigma,
        faces_per_pixel=10,
        perspective_correct=False,
    )
    renderer = MeshRenderer(
        rasterizer=MeshRasterizer(cameras=camera, raster_settings=raster_settings_soft),
        shader=SoftPhongShader(device=device, cameras=camera, lights=lights),
    )
    target = colored_sphere(2, (0.9, 0.2, 0.4))
    target = target.update_padded(target.verts_padded() * torch.tensor([0.7, 1.0, 0.8]))
    cameras = FoVPerspectiveCameras(device=device, R=R, T=T)
    target_images = renderer(target.extend(num_views), cameras=cameras, lights=lights).detach()
    src_mesh = ico_sphere(2, device)
    deform_verts = torch.full(src_mesh.verts_packed().shape, 0.0, device=device, requires_grad=True)
    sphere_verts_rgb = torch.full([1, src_mesh.verts_packed().shape[0], 3], 0.5, device=device, requires_grad=True)
    optimizer = torch.optim.Adam([deform_verts, sphere_verts_rgb], lr=0.02)
    losses = []
    for step in range(24):
        optimizer.zero_grad()
        new_src_mesh = src_mesh.offset_verts(deform_verts)
        new_src_mesh.textures = TexturesVertex(verts_features=sphere_verts_rgb)
        j = step % num_views
        images_predicted = renderer(new_src_mesh, cameras=cameras[j], lights=lights)
        loss_silhouette = ((images_predicted[..., 3] - target_images[j, ..., 3]) ** 2).mean()
        loss_rgb = ((images_predicted[..., :3] - target_images[j, ..., :3]) ** 2).mean()
        (loss_rgb + loss_silhouette).backward()
        assert_finite(deform_verts.grad)
        assert_finite(sphere_verts_rgb.grad)
        optimizer.step()
        losses.append((loss_rgb + loss_silhouette).item())
    assert sum(losses[-3:]) < 0.35 * sum(losses[:3])


def test_texture_map_is_painted_by_an_image() -> None:
    """The map of a quadrilateral that fills the view takes on the colours of the picture."""
    verts = torch.tensor([[[1.0, -1.0, 0.0], [-1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [1.0, 1.0, 0.0]]])
    faces = torch.tensor([[[0, 1, 2], [0, 2, 3]]])
    verts_uvs = torch.tensor([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]])
    maps = torch.full((1, 8, 8, 3), 0.5, requires_grad=True)
    cameras = OrthographicCameras(T=torch.tensor([[0.0, 0.0, 2.0]]))
    renderer = MeshRenderer(
        rasterizer=MeshRasterizer(cameras=cameras, raster_settings=RasterizationSettings(image_size=8)),
        shader=SoftPhongShader(cameras=cameras, lights=AmbientLights(), blend_params=BlendParams(1e-6, 1e-6)),
    )
    picture = torch.rand(1, 8, 8, 3)
    optimizer = torch.optim.SGD([maps], lr=20.0)
    for _ in range(40):
        optimizer.zero_grad()
        textures = TexturesUV(maps=maps, faces_uvs=faces, verts_uvs=verts_uvs, align_corners=False)
        image = renderer(Meshes(verts=verts, faces=faces, textures=textures))
        ((image[..., :3] - picture) ** 2).mean().backward()
        optimizer.step()
    # pixels on the diagonal, where the two faces meet, blend with the background
    off = ~torch.eye(8, dtype=torch.bool).flip(0)
    assert_close(maps[0][off], picture[0][off], atol=1e-2)


def test_camera_pose_as_parameter_of_the_camera() -> None:
    """T of a camera object is itself the parameter."""
    R, T = look_at_view_transform(3.0, 0.0, 0.0)
    cameras = FoVPerspectiveCameras(R=R, T=T)
    mesh = ico_sphere(2)
    renderer = MeshRenderer(
        MeshRasterizer(cameras, RasterizationSettings(image_size=32, blur_radius=1e-3)), SoftSilhouetteShader()
    )
    goal = renderer(mesh)[..., 3].detach()
    cameras.T = nn.Parameter(T + torch.tensor([[0.3, -0.2, 0.0]]))
    optimizer = torch.optim.Adam(renderer.parameters(), lr=0.03)
    for _ in range(30):
        optimizer.zero_grad()
        ((renderer(mesh)[..., 3] - goal) ** 2).sum().backward()
        optimizer.step()
    assert_close(cameras.T, T, atol=0.06)


def test_relative_cameras_agree_with_absolute_ones() -> None:
    """The bookkeeping of a bundle adjustment: pairs of cameras, composed transforms, angles between rotations."""
    log_R, T = 0.5 * torch.randn(5, 3), torch.randn(5, 3)
    with pytest.warns(PendingDeprecationWarning, match="PerspectiveCameras"):
        cameras = SfMPerspectiveCameras(R=so3_exp_map(log_R), T=T)
    pairs = torch.tensor([[0, 1], [2, 4], [3, 0]])
    first, second = (cameras[pairs[:, i]].get_world_to_view_transform() for i in (0, 1))
    relative = first.inverse().compose(second)
    matrix = relative.get_matrix()
    R_relative, T_relative = matrix[:, :3, :3], matrix[:, 3, :3]
    composed = first.compose(get_world_to_view_transform(R_relative, T_relative)).get_matrix()
    assert_close(composed, second.get_matrix(), atol=1e-5)
    same = so3_relative_angle(composed[:, :3, :3], cameras.R[pairs[:, 1]], cos_angle=True)
    assert_close(same, torch.ones(3))


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_a_picture_taken_without_gradients_leaves_the_mesh_trainable(mode: type) -> None:
    """Validation looks at the very objects that training goes on with."""
    renderer = phong_renderer_of(32)
    base = join_meshes_as_batch([ico_sphere(2), ico_sphere(1)])

    def gradients(look_first: bool) -> list[torch.Tensor]:
        torch.manual_seed(0)
        offsets = torch.zeros_like(base.verts_packed()).requires_grad_()
        colors = [torch.rand(162, 3, requires_grad=True), torch.rand(42, 3, requires_grad=True)]
        mesh = base.offset_verts(offsets)
        mesh.textures = TexturesVertex(colors)
        if look_first:
            with mode():
                renderer.rasterizer(base)
                for each in (base, mesh):
                    each.verts_normals_padded(), each.faces_areas_packed(), each.laplacian_packed()
                    each.faces_packed_to_edges_packed(), each.extend(2)
                renderer(mesh)
        image = renderer(mesh).square().sum() + mesh.extend(2).verts_padded().square().sum()
        smooth = mesh.laplacian_packed().mm(mesh.verts_packed()).norm(dim=1).mean() + mesh.faces_areas_packed().std()
        edges = mesh.verts_packed()[mesh.edges_packed()].square().sum()
        return list(torch.autograd.grad(image + smooth + edges, [offsets, *colors]))

    looked = gradients(look_first=True)
    base = join_meshes_as_batch([ico_sphere(2), ico_sphere(1)])
    for before, without in zip(looked, gradients(look_first=False), strict=True):
        assert_close(before, without)


# -- bookkeeping of batches


def test_batches_are_sorted_out_again() -> None:
    sphere, small = colored_sphere(1, (1.0, 0.0, 0.0)), colored_sphere(0, (0.0, 1.0, 0.0))
    batch = join_meshes_as_batch([sphere, small])
    assert batch.num_verts_per_mesh().tolist() == [42, 12]
    assert batch.verts_padded().shape == (2, 42, 3)
    assert (batch.faces_padded()[1, 20:] == -1).all()
    assert torch.equal(batch.verts_packed_to_mesh_idx().bincount(), torch.tensor([42, 12]))
    scene = join_meshes_as_scene([sphere.offset_verts(torch.tensor([1.2, 0.0, 0.0])), small])
    assert len(scene) == 1
    image = phong_renderer_of(32)(scene, lights=AmbientLights())
    assert (image[..., 0] > 0.9).any()
    assert (image[..., 1] > 0.9).any()
    assert [len(part) for part in batch.split([1, 1])] == [1, 1]
    for index in (1, -1, [1], slice(1, 2), np.int64(1), torch.tensor([1]), torch.tensor([False, True])):
        assert torch.equal(batch[index].verts_packed(), small.verts_packed())
        assert len(FoVPerspectiveCameras(fov=(20.0, 30.0))[index]) == 1


@pytest.mark.parametrize(
    "thing", [colored_sphere(0), FoVPerspectiveCameras(fov=30.0), PointLights(), Materials(), BlendParams()]
)
def test_things_travel_to_workers_and_back(thing: object) -> None:
    """Data loaders pickle what they return."""
    returned = pickle.loads(pickle.dumps(thing))
    assert type(returned) is type(thing)
    if isinstance(thing, Meshes):
        assert torch.equal(returned.textures.verts_features_packed(), thing.textures.verts_features_packed())


# -- losses


def test_optimization_of_a_shift():
    """Chapter 2: how far three meshes were moved together, from noisy copies of them."""
    torch.manual_seed(0)
    mesh_source = join_meshes_as_batch([ico_sphere(1), ico_sphere(0).scale_verts(0.7), ico_sphere(0)])
    noise = 0.02 * torch.randn_like(mesh_source.verts_packed())
    mesh_target = mesh_source.offset_verts(torch.tensor([3.0, 4.0, 5.0]) + noise)
    motion = torch.zeros(3, requires_grad=True)
    optimizer = torch.optim.SGD([motion], lr=0.1, momentum=0.9)
    for _ in range(100):
        optimizer.zero_grad()
        moved = mesh_source.offset_verts(motion.expand(len(mesh_source.verts_packed()), 3))
        sample_trg = sample_points_from_meshes(mesh_target, 300)
        sample_src = sample_points_from_meshes(moved, 300)
        loss, _ = chamfer_distance(sample_trg, sample_src)
        loss.backward()
        optimizer.step()
    assert_close(motion.detach(), torch.tensor([3.0, 4.0, 5.0]), atol=0.1)


def test_deforming_a_sphere_to_a_cloud(tmp_path):
    """Chapter 3: four losses pull and smooth a sphere towards the vertices of a PLY file."""
    torch.manual_seed(0)
    target = ico_sphere(3).verts_packed() * torch.tensor([1.0, 0.6, 0.4]) + 5
    save_ply(tmp_path / "target.ply", target, torch.zeros(0, 3, dtype=torch.int64))
    verts, _ = load_ply(str(tmp_path / "target.ply"))
    center = verts.mean(0)
    verts = verts - center
    scale = max(verts.abs().max(0)[0])
    verts = (verts / scale)[None, :, :]
    src_mesh = ico_sphere(2, device)
    deform_verts = torch.full(src_mesh.verts_packed().shape, 0.0, device=device, requires_grad=True)
    optimizer = torch.optim.SGD([deform_verts], lr=1.0, momentum=0.9)
    history = []
    for _ in range(60):
        optimizer.zero_grad()
        new_src_mesh = src_mesh.offset_verts(deform_verts)
        sample_src = sample_points_from_meshes(new_src_mesh, verts.shape[1])
        loss_chamfer, _ = chamfer_distance(verts, sample_src)
        loss_edge = mesh_edge_loss(new_src_mesh)
        loss_normal = mesh_normal_consistency(new_src_mesh)
        loss_laplacian = mesh_laplacian_smoothing(new_src_mesh, method="uniform")
        loss = loss_chamfer * 1.0 + loss_edge * 1.0 + loss_normal * 0.01 + loss_laplacian * 0.1
        history.append(loss_chamfer.item())
        loss.backward()
        optimizer.step()
    assert history[-1] < 0.2 * history[0]
    final_verts, final_faces = new_src_mesh.get_mesh_verts_faces(0)
    final_verts = final_verts * scale + center
    save_ply(tmp_path / "deform1.ply", final_verts.detach(), final_faces, ascii=True)
    assert_close(load_ply(tmp_path / "deform1.ply")[0], final_verts.detach(), atol=1e-5)


# -- volumes


@pytest.mark.filterwarnings("ignore:NDCGridRaysampler is deprecated")
def test_understand_ray_sampling_volume_sampler_and_ray_marcher(tmp_path):
    """Chapter 5: three scripts that hand tensors to each other through files."""
    num_views = 10
    azimuth = torch.linspace(-180, 180, num_views)
    R, T = look_at_view_transform(dist=2.7, elev=0, azim=azimuth)
    cameras = FoVPerspectiveCameras(device=device, R=R, T=T)
    raysampler = NDCGridRaysampler(image_width=16, image_height=16, n_pts_per_ray=50, min_depth=0.1, max_depth=3.0)
    ray_bundle = raysampler(cameras)
    assert ray_bundle.origins.shape == ray_bundle.directions.shape == (10, 16, 16, 3)
    assert ray_bundle.lengths.shape == (10, 16, 16, 50)
    assert ray_bundle.xys.shape == (10, 16, 16, 2)
    torch.save({"ray_bundle": ray_bundle}, tmp_path / "ray_sampling.pt")

    ray_bundle = torch.load(tmp_path / "ray_sampling.pt", weights_only=False)["ray_bundle"]
    volumes = Volumes(
        densities=torch.zeros([num_views, 1, 16, 16, 16]),
        features=torch.zeros([num_views, 3, 16, 16, 16]),
        voxel_size=0.1,
    )
    volume_sampler = VolumeSampler(volumes=volumes, sample_mode="bilinear")
    rays_densities, rays_features = volume_sampler(ray_bundle)
    assert rays_densities.shape == (10, 16, 16, 50, 1)
    assert rays_features.shape == (10, 16, 16, 50, 3)
    torch.save({"rays_densities": rays_densities, "rays_features": rays_features}, tmp_path / "volume_sampling.pt")

    checkpoint = torch.load(tmp_path / "volume_sampling.pt")
    raymarcher = EmissionAbsorptionRaymarcher()
    image_features = raymarcher(
        rays_densities=checkpoint["rays_densities"], rays_features=checkpoint["rays_features"]
    )
    assert image_features.shape == (10, 16, 16, 4)
    assert image_features.abs().max() == 0


class VolumeModel(torch.nn.Module):
    """Chapter 5: log densities and log colours, rendered for a batch of cameras."""

    def __init__(self, renderer, volume_size=[16] * 3, voxel_size=3.0 / 16):
        super().__init__()
        self.log_densities = torch.nn.Parameter(-4.0 * torch.ones(1, *volume_size))
        self.log_colors = torch.nn.Parameter(torch.zeros(3, *volume_size))
        self._voxel_size = voxel_size
        self._renderer = renderer

    def forward(self, cameras):
        batch_size = cameras.R.shape[0]
        densities, colors = torch.sigmoid(self.log_densities), torch.sigmoid(self.log_colors)
        volumes = Volumes(
            densities=densities[None].expand(batch_size, *self.log_densities.shape),
            features=colors[None].expand(batch_size, *self.log_colors.shape),
            voxel_size=self._voxel_size,
        )
        return self._renderer(cameras=cameras, volumes=volumes)[0]


def huber(x, y, scaling=0.1):
    return ((1 + (x - y) ** 2 / scaling**2).clamp(1e-4).sqrt() - 1) * float(scaling)


@pytest.mark.filterwarnings("ignore:NDCGridRaysampler is deprecated")
def test_volume_render():
    """Chapter 5: a volume is fitted to pictures and silhouettes of a red ball."""
    torch.manual_seed(0)
    R, T = look_at_view_transform(dist=2.7, elev=0, azim=torch.linspace(-180, 180, 9)[:8])
    target_cameras = FoVPerspectiveCameras(device=device, R=R, T=T)
    x = torch.linspace(1 - 1 / 24, -1 + 1 / 24, 24)
    target_silhouettes = (x[:, None] ** 2 + x**2 < 0.4**2).float().expand(8, 24, 24)
    target_images = target_silhouettes[..., None] * torch.tensor([1.0, 0.2, 0.1])
    raysampler = NDCGridRaysampler(image_width=24, image_height=24, n_pts_per_ray=40, min_depth=0.1, max_depth=3.0)
    renderer = VolumeRenderer(raysampler=raysampler, raymarcher=EmissionAbsorptionRaymarcher())
    volume_model = VolumeModel(renderer).to(device)
    optimizer = torch.optim.Adam(volume_model.parameters(), lr=0.1)
    history = []
    for iteration in range(40):
        if iteration == 30:
            optimizer = torch.optim.Adam(volume_model.parameters(), lr=0.01)
        optimizer.zero_grad()
        batch_idx = torch.randperm(len(target_cameras))[:3]
        batch_cameras = FoVPerspectiveCameras(
            R=target_cameras.R[batch_idx],
            T=target_cameras.T[batch_idx],
            znear=target_cameras.znear[batch_idx],
            zfar=target_cameras.zfar[batch_idx],
            aspect_ratio=target_cameras.aspect_ratio[batch_idx],
            fov=target_cameras.fov[batch_idx],
            device=device,
        )
        rendered_images, rendered_silhouettes = volume_model(batch_cameras).split([3, 1], dim=-1)
        sil_err = huber(rendered_silhouettes[..., 0], target_silhouettes[batch_idx]).abs().mean()
        color_err = huber(rendered_images, target_images[batch_idx]).abs().mean()
        loss = color_err + sil_err
        loss.backward()
        optimizer.step()
        history.append(loss.item())
    assert history[-1] < 0.1 * history[0]
    R = so3_exp_map(torch.tensor([[0.0, 0.7, 0.0]]))
    turned = volume_model(FoVPerspectiveCameras(R=R, T=torch.tensor([[0.0, 0.0, 2.7]]), device=device))
    assert ((turned[0, ..., 3] > 0.5) == (target_silhouettes[0] > 0.5)).float().mean() > 0.97


def colored_ball(size: int = 4000) -> Pointclouds:
    verts = torch.nn.functional.normalize(torch.randn(size, 3), dim=1)
    return Pointclouds(points=[verts], features=[verts * 0.5 + 0.5])


@pytest.mark.parametrize("compositor", [AlphaCompositor, NormWeightedCompositor])
def test_colored_points_are_rendered(compositor: type) -> None:
    point_cloud = colored_ball()
    R, T = look_at_view_transform(20, 10, 0)
    cameras = FoVOrthographicCameras(R=R, T=T, znear=0.01)
    raster_settings = PointsRasterizationSettings(image_size=64, radius=0.08, points_per_pixel=4)
    rasterizer = PointsRasterizer(cameras=cameras, raster_settings=raster_settings)
    renderer = PointsRenderer(rasterizer=rasterizer, compositor=compositor(background_color=(0, 0, 1)))
    images = renderer(point_cloud)
    assert images.shape == (1, 64, 64, 3)
    assert_close(images[0, 0, 0], [0.0, 0.0, 1.0])
    nearest = cameras.get_camera_center()[0] / 20 * 0.5 + 0.5
    assert_close(images[0, 28:36, 28:36].mean((0, 1)), nearest, atol=0.1)


def test_features_are_splatted_by_hand() -> None:
    """How view synthesis by point clouds uses the parts: rasterise, weigh by distance, composite."""
    size, radius, tau = 32, 4.0 / 32 * 2.0, 1.0
    points = torch.rand(2, 500, 3) * 2 - torch.tensor([1.0, 1.0, -1.0])
    features = torch.rand(2, 500, 16, requires_grad=True)
    pts3d = Pointclouds(points=points, features=features)
    points_idx, _, dist = rasterize_points(pts3d, size, radius, 64)
    dist = dist / pow(radius, 2)
    alphas = (1 - dist.clamp(max=1, min=1e-3).pow(0.5)).pow(tau).permute(0, 3, 1, 2)
    src = pts3d.features_packed().permute(1, 0)
    for function in (compositing.alpha_composite, compositing.norm_weighted_sum, compositing.weighted_sum):
        splatted = function(points_idx.permute(0, 3, 1, 2).long(), alphas, src)
        assert splatted.shape == (2, 16, size, size)
        assert_finite(torch.autograd.grad(splatted.sum(), features, retain_graph=True)[0])
