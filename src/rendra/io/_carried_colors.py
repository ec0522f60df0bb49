"""Colours of a mesh in the form that another file format can hold.

Letters: V verts, F faces, C corners of some faces, H W image, R side of one face's square of texels.
"""

import math
from types import SimpleNamespace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.io._images import MAX_TEXTURE_PIXELS
from rendra.io.obj_io import Faces, Properties
from rendra.renderer.mesh.texture_packing import Sampling, pack_maps
from rendra.renderer.mesh.textures import TexturesUV, TexturesVertex
from rendra.structures import Meshes

_PLAIN_TEXELS = 3  # on a side of a patch of one colour: its middle touches no neighbour


def colors_at_verts(mesh: Meshes) -> TexturesVertex:
    """The texture at every vertex of a mesh, the mean of what its faces show there; white where it has no face."""
    faces = mesh.faces_packed()
    corner = torch.eye(3, device=faces.device).repeat(len(faces), 1)
    fragments = SimpleNamespace(
        pix_to_face=torch.arange(len(faces), device=faces.device).repeat_interleave(3).reshape(1, -1, 1, 1),
        bary_coords=corner.reshape(1, -1, 1, 1, 3),
    )
    shown = mesh.sample_textures(fragments)[0, :, 0, 0] if len(faces) else corner  # (3 F, C)
    sums = shown.new_zeros(len(mesh.verts_packed()), shown.shape[1]).index_add(0, faces.reshape(-1), shown)
    counts = faces.reshape(-1).bincount(minlength=len(sums))[:, None]
    return TexturesVertex([torch.where(counts > 0, sums / counts.clamp(min=1), 1.0)])


def atlas_as_image(atlas: Tensor) -> TexturesUV:
    """An image of one texel for every face, whose corners all lie in the middle of it: flat colours stay exact.

    Args:
        atlas: (F, R, R, 3); of larger squares than one texel the mean is kept.

    Raises:
        ValueError: more faces than an image may have texels.
    """
    if len(atlas) > MAX_TEXTURE_PIXELS:
        raise ValueError(f"{len(atlas):,} face colours do not fit into an image of {MAX_TEXTURE_PIXELS:,} texels")
    side = max(2, math.ceil(math.sqrt(len(atlas))))
    image = atlas.new_ones(side * side, 3)
    image[: len(atlas)] = atlas.mean(dim=(1, 2))
    index = torch.arange(len(atlas), device=atlas.device)
    uvs = torch.stack([index % side, side - 1 - index // side], dim=1) / (side - 1)
    return TexturesUV(image.reshape(1, side, side, 3), [index[:, None].expand(-1, 3)], [uvs.to(atlas)])


class _Patch(NamedTuple):
    """An image, the faces that read it, and where their corners lie in it."""

    image: Tensor  # (H, W, 3)
    faces: Tensor  # (C,)
    uvs: Tensor  # (C, 3, 2)


def packed_materials(names: list[str], faces: Faces, properties: Properties) -> TexturesUV:
    """One image that holds the images and plain colours of all materials of an OBJ file.

    A face without image or texture coordinates takes the diffuse colour of its material, else white. A face that
    repeats an image is moved back into it as a whole; what then still lies outside takes the image's border.

    Args:
        names: of the materials, in the order of `faces.materials_idx`.
        faces, properties: as `load_obj` returns them; there is at least one face.
    """
    images, colors = properties.texture_images or {}, properties.material_colors or {}
    has_uvs = (faces.textures_idx >= 0).all(dim=1)
    patches: list[_Patch] = []
    for number in faces.materials_idx.unique().tolist():
        name = names[number] if number >= 0 else ""
        own = faces.materials_idx == number
        textured = own & has_uvs if name in images else torch.zeros_like(own)
        if textured.any() and properties.verts_uvs is not None:
            index = textured.nonzero()[:, 0]
            patches.append(_Patch(images[name], index, _inside(properties.verts_uvs[faces.textures_idx[index]])))
        if (index := (own & ~textured).nonzero()[:, 0]).numel():
            color = colors.get(name, {}).get("diffuse_color", own.new_ones(3, dtype=torch.float32))
            plain = color.clamp(0.0, 1.0).expand(_PLAIN_TEXELS, _PLAIN_TEXELS, 3).contiguous()
            patches.append(_Patch(plain, index, plain.new_full((len(index), 3, 2), 0.5)))
    return _joined(patches, len(faces.verts_idx))


def _inside(corners: Tensor) -> Tensor:
    """(C, 3, 2) coordinates in [0, 1]."""
    outside = ((corners < 0.0) | (corners > 1.0)).any(dim=1, keepdim=True)
    tile = torch.where(outside, corners.amin(dim=1, keepdim=True).floor(), 0.0)
    return (corners - tile).clamp(0.0, 1.0)


def _joined(patches: list[_Patch], num_faces: int) -> TexturesUV:
    sampling = Sampling("border", True, "bilinear")
    packed = pack_maps([patch.image for patch in patches], [patch.uvs.reshape(-1, 2) for patch in patches], sampling)
    corners = packed.image.new_zeros(num_faces, 3, 2)
    for i, patch in enumerate(patches):
        corners[patch.faces] = packed.move(i, patch.uvs)
    uvs, index = corners.reshape(-1, 2).unique(dim=0, return_inverse=True)
    return TexturesUV(packed.image[None], [index.reshape(-1, 3)], [uvs])


def normals_at_verts(num_verts: int, faces: Faces, normals: Tensor) -> Tensor | None:
    """(V, 3) unit normals of an OBJ file in which no vertex has two of them; else None.

    A vertex without face gets a zero normal.

    Args:
        num_verts: V.
        faces: as `load_obj` returns them.
        normals: (M, 3), as written.
    """
    verts, index = faces.verts_idx.reshape(-1), faces.normals_idx.reshape(-1)
    if not len(index) or bool((index < 0).any()):
        return None
    own = F.normalize(normals, dim=1)
    result = own.new_zeros(num_verts, 3)
    result[verts] = own[index]
    return result if torch.equal(result[verts], own[index]) else None
