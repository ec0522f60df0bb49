"""Phong's lighting at surface points (Phong), at vertices (Gouraud) and at faces (flat).

Everything is in world coordinates. The colour of a point is (ambient + diffuse) * texel + specular.

Notation: N images, F packed faces, V packed vertices, K layers, C channels, M rows of any kind.
"""

from typing import Any

import torch
from torch import Tensor

from rendra.ops.interp_face_attrs import interpolate_face_attributes
from rendra.renderer.batching import Compaction, per_image, ragged
from rendra.renderer.materials import Materials
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures.meshes import Meshes


def phong_shading(
    meshes: Meshes, fragments: Any, lights: Any, cameras: Any, materials: Materials, texels: Tensor
) -> Tensor:
    """Light every surface point, with normals interpolated between the vertices.

    Args:
        meshes: batch of N in world coordinates.
        fragments: of these meshes; pix_to_face (N, H, W, K) and bary_coords (N, H, W, K, 3) are read.
        lights: one for each image, or one for all.
        cameras: one for each image, or one for all; highlights follow their centres.
        materials: one for each image, or one for all.
        texels: (N, H, W, K, C), colours of the texture at the same points.

    Returns:
        (N, H, W, K, C); zero in empty slots, which cost nothing.
    """
    slots, colors, _ = _phong_rows(meshes, fragments, lights, cameras, materials, texels)
    return slots.put(colors).view(*fragments.pix_to_face.shape, colors.shape[-1])


def phong_shading_with_points(
    meshes: Meshes, fragments: Any, lights: Any, cameras: Any, materials: Materials, texels: Tensor
) -> tuple[Tensor, Tensor]:
    """`phong_shading`, and the surface points themselves: (N, H, W, K, 3) in world coordinates, zero where empty."""
    slots, colors, points = _phong_rows(meshes, fragments, lights, cameras, materials, texels)
    shape = fragments.pix_to_face.shape
    return slots.put(colors).view(*shape, colors.shape[-1]), slots.put(points).view(*shape, 3)


def gouraud_shading(meshes: Meshes, fragments: Any, lights: Any, cameras: Any, materials: Materials) -> Tensor:
    """Light the vertices and interpolate their colours over the faces (H. Gouraud, 1971).

    Args:
        meshes: batch of N in world coordinates with TexturesVertex of C channels.
        fragments, lights, cameras, materials: as in `phong_shading`.

    Returns:
        (N, H, W, K, C); zero in empty slots.

    Raises:
        ValueError: the textures are not TexturesVertex.
    """
    if not isinstance(meshes.textures, TexturesVertex):
        raise ValueError(f"Mesh textures must be an instance of TexturesVertex; got {type(meshes.textures)}")
    tint, highlight = _light_rows(
        meshes.verts_packed(),
        meshes.verts_normals_packed(),
        meshes.num_verts_per_mesh(),
        lights,
        cameras,
        materials,
    )
    colors = meshes.textures.verts_features_packed() * tint + highlight
    corner_colors = _at_corners(colors, meshes)
    return interpolate_face_attributes(fragments.pix_to_face, fragments.bary_coords, corner_colors)


def flat_shading(
    meshes: Meshes, fragments: Any, lights: Any, cameras: Any, materials: Materials, texels: Tensor
) -> Tensor:
    """Light each face once, at its centre with its own normal.

    Arguments, result and cost as of `phong_shading`.
    """
    centres = _at_corners(meshes.verts_packed(), meshes).mean(1)
    counts = meshes.num_faces_per_mesh()
    tint, highlight = _light_rows(centres, meshes.faces_normals_packed(), counts, lights, cameras, materials)
    slots, faces = _filled_slots(fragments)
    colors = slots.take(texels.flatten(1, 3)) * tint[faces] + highlight[faces]
    return slots.put(colors).view(*fragments.pix_to_face.shape, colors.shape[-1])


def _phong_rows(
    meshes: Meshes, fragments: Any, lights: Any, cameras: Any, materials: Materials, texels: Tensor
) -> tuple[Compaction, Tensor, Tensor]:
    """Phong's colours (M, C) and the positions (M, 3) of the M filled slots, and which slots these are."""
    slots, faces = _filled_slots(fragments)
    bary = slots.take(fragments.bary_coords.flatten(1, 3))
    corners = _at_corners(torch.cat((meshes.verts_packed(), meshes.verts_normals_packed()), dim=1), meshes)
    points, normals = interpolate_face_attributes(faces, bary, corners).split(3, dim=-1)
    tint, highlight = _light_rows(points, normals, slots.counts, lights, cameras, materials)
    return slots, slots.take(texels.flatten(1, 3)) * tint + highlight, points


def _filled_slots(fragments: Any) -> tuple[Compaction, Tensor]:
    """The slots that hold a face, among (N, H * W * K), and their faces (M,)."""
    pix_to_face = fragments.pix_to_face.flatten(1)
    slots = Compaction(pix_to_face >= 0)
    return slots, slots.take(pix_to_face)


def _at_corners(values: Tensor, meshes: Meshes) -> Tensor:
    """Values (V, D) of packed vertices at the corners of the faces: (F, 3, D)."""
    return values.index_select(0, meshes.faces_packed().reshape(-1)).view(-1, 3, values.shape[1])


def _light_rows(
    points: Tensor, normals: Tensor, counts: Tensor, lights: Any, cameras: Any, materials: Materials
) -> tuple[Tensor, Tensor]:
    """Light M points, `counts` (N,) of them in each image, image after image.

    Returns:
        What multiplies the texture, ambient + diffuse, and what is added to it, specular; (M, C) or (1, C) each.
    """
    camera_position = cameras.get_camera_center()
    _check_batches(len(counts), lights=len(lights), materials=len(materials), cameras=len(camera_position))
    # what is the same for all images needs no padding to images
    is_shared = max(len(lights), len(materials), len(camera_position)) <= 1
    rows = None if is_shared else ragged(counts)
    points, normals = (x[None] if rows is None else rows.put(x) for x in (points, normals))
    diffuse = _reflected(materials.diffuse_color, lights.diffuse(normals=normals, points=points))
    ambient = _reflected(materials.ambient_color, per_image(lights.ambient_color, points.ndim))
    specular = _reflected(
        materials.specular_color,
        lights.specular(
            normals=normals,
            points=points,
            camera_position=camera_position,
            shininess=materials.shininess,
        ),
    )
    tint = ambient + diffuse
    return (tint[0], specular[0]) if rows is None else (rows.take(tint), rows.take(specular))


def _check_batches(num_meshes: int, **sizes: int) -> None:
    """Raises ValueError unless there is one light, material and camera for all meshes, or one for each."""
    if any(size not in (1, num_meshes) for size in sizes.values()):
        given = ", ".join(f"{size} {name}" for name, size in sizes.items())
        raise ValueError(
            f"Got {given} for {num_meshes} meshes: give one of each kind for all meshes, or one for each"
        )


def _reflected(reflectance: Tensor, light: Tensor) -> Tensor:
    """Light (N, ..., C) after a material (N, 3); light of other than three channels is no colour to filter."""
    return light * per_image(reflectance, light.ndim) if light.shape[-1] == 3 else light
