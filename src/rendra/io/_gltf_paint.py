"""One texture for all parts of a glTF scene."""

import warnings
from collections import Counter
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rendra.io._bulk_text import Positions
from rendra.io._gltf_asset import Floats
from rendra.io._gltf_materials import MIRROR, REPEAT, Material, Pictures, Texture
from rendra.io._gltf_parts import Part
from rendra.io._images import MAX_TEXTURE_PIXELS
from rendra.io.errors import MeshFormatError
from rendra.renderer.mesh.texture_packing import Sampling, pack_maps
from rendra.renderer.mesh.textures import TexturesBase, TexturesUV, TexturesVertex
from rendra.renderer.mesh.utils import pack_rectangles


def paint(parts: list[Part], pictures: Pictures, name: str) -> TexturesBase | None:
    """The texture of the mesh that joins all parts; None where the file has no colour at all.

    Without images it is `TexturesVertex`. With one image that all parts read in the same way it is that image,
    else an image into which all are packed, and a patch of plain colour for every part that has none.

    Args:
        parts: of the scene.
        pictures: its images.
        name: what warnings call the file.
    """
    images = [_picture(part, pictures, name) for part in parts]
    if not any(image is not None for image in images):
        return _vertex_colors(parts)
    if any(image is not None and part.colors is not None for part, image in zip(parts, images, strict=True)):
        warnings.warn(f"{name}: vertex colours of textured parts are not kept", stacklevel=6)
    return _uv_texture(parts, images, name)


def _picture(part: Part, pictures: Pictures, name: str) -> Tensor | None:
    """The image of a part that has faces, an image and texture coordinates."""
    texture = part.material.texture
    if texture is None or not len(part.faces):
        return None
    if part.uvs is None:
        warnings.warn(f"{name}: a part has a texture, but no texture coordinates; it is left plain", stacklevel=7)
        return None
    image = pictures[texture.image]
    if image is None:
        warnings.warn(f"{name}: the file of image {texture.image} does not exist", stacklevel=7)
    return image


def _vertex_colors(parts: list[Part]) -> TexturesVertex | None:
    if not any(part.colors is not None or part.material.factor is not None for part in parts):
        return None
    return TexturesVertex([torch.from_numpy(np.concatenate([_colors(part) for part in parts]))])


def _colors(part: Part) -> Floats:
    """(V, 3) vertex colours times the material's factor, white where there is neither."""
    colors = np.ones_like(part.verts) if part.colors is None else part.colors
    factor = part.material.factor
    return colors if factor is None else (colors * np.array(factor, dtype=np.float32)).astype(np.float32)


@dataclass(frozen=True)
class _Patch:
    """An image, and where the corners of one part lie in it."""

    image: Tensor
    uvs: Floats
    faces_uvs: Positions


def _uv_texture(parts: list[Part], images: list[Tensor | None], name: str) -> TexturesUV:
    textures = [part.material.texture for part, image in zip(parts, images, strict=True) if image is not None]
    sampling = _sampling([each for each in textures if each is not None])
    patches = _patches(parts, images, name)
    if len({id(patch.image) for patch in patches}) == 1:
        image, uvs = patches[0].image, [patch.uvs for patch in patches]
    else:
        image, uvs = _packed(patches, sampling, name)
    starts = np.cumsum([0, *map(len, uvs)])
    corners = [patch.faces_uvs + start for patch, start in zip(patches, starts, strict=False)]
    return TexturesUV(
        maps=image[None],
        faces_uvs=[torch.from_numpy(np.concatenate(corners))],
        verts_uvs=[torch.from_numpy(np.concatenate(uvs))],
        padding_mode=sampling.padding_mode,
        sampling_mode=sampling.mode,
    )


def _patches(parts: list[Part], images: list[Tensor | None], name: str) -> list[_Patch]:
    """What each part with faces reads; parts of one image and one factor share it."""
    tinted: dict[tuple[int, tuple[float, ...] | None], Tensor] = {}
    uses = {(id(image), part.material.factor) for part, image in zip(parts, images, strict=True)}
    tints = Counter(image for image, _ in uses)
    patches, pixels = [], 0
    for part, image in zip(parts, images, strict=True):
        if image is None:
            patches += [_plain_patch(part, name)] * bool(len(part.faces))
            continue
        key = (id(image), part.material.factor)
        if key not in tinted:
            pixels += image.shape[0] * image.shape[1]
            if pixels > MAX_TEXTURE_PIXELS:
                limit = f"at most {MAX_TEXTURE_PIXELS:,} pixels, or include_textures=False"
                raise MeshFormatError(
                    "the images, in all their tints, are too large", name, None, f"{pixels:,}", limit
                )
            tinted[key] = _tinted(image, part.material, in_place=tints[id(image)] == 1)
        patches.append(_Patch(tinted[key], *_unrolled(part, name)))
    return patches


def _sampling(textures: list[Texture]) -> Sampling:
    """What all parts agree on, else the default."""
    mirrored = all(texture.wraps == (MIRROR, MIRROR) for texture in textures)
    nearest = all(texture.nearest for texture in textures)
    return Sampling("reflection" if mirrored else "border", True, "nearest" if nearest else "bilinear")


def _tinted(image: Tensor, material: Material, in_place: bool) -> Tensor:
    if material.factor is None or material.factor == (1.0, 1.0, 1.0):
        return image
    factor = torch.tensor(material.factor, dtype=image.dtype)
    return image.mul_(factor) if in_place else image * factor


def _plain_patch(part: Part, name: str) -> _Patch:
    """Nine texels of one colour; colours that differ from vertex to vertex are averaged."""
    colors = _colors(part)
    mean = colors.mean(axis=0)
    if (colors != colors[:1]).any():
        warnings.warn(f"{name}: vertex colours beside textures are not kept, but their mean", stacklevel=7)
    image = torch.from_numpy(mean.astype(np.float32)).expand(3, 3, 3).contiguous()
    return _Patch(image, np.full((1, 2), 0.5, dtype=np.float32), np.zeros_like(part.faces))


def _unrolled(part: Part, name: str) -> tuple[Floats, Positions]:
    """Texture coordinates of a repeated image, each face moved as a whole to where the image itself lies."""
    uvs, faces, texture = part.uvs, part.faces_uvs, part.material.texture
    assert uvs is not None  # this part has an image
    assert texture is not None
    repeats = np.array([wrap == REPEAT for wrap in texture.wraps])
    corners = uvs[faces]  # (F, 3, 2)
    outside = ((corners < 0.0) | (corners > 1.0)).any(axis=1) & repeats
    if not outside.any():
        return uvs, faces
    tiles = np.where(outside, np.floor(corners.min(axis=1)), 0.0)  # (F, 2)
    rows, shifts, index = _distinct(faces.ravel(), np.repeat(tiles, 3, axis=0))
    moved = (uvs[rows] - shifts).astype(np.float32)
    index = index.reshape(-1, 3)
    crossing = int(((moved[index] > 1.0).any(axis=1) & repeats).any(axis=1).sum())
    if crossing:
        why = "cross the border of a repeated texture, which is continued with its last texels instead"
        warnings.warn(f"{name}: {crossing} faces {why}", stacklevel=7)
    return moved, index


def _distinct(rows: Positions, tiles: Floats) -> tuple[Positions, Floats, Positions]:
    """The different pairs of a row (C,) and a tile (C, 2), in their order, and which of them each corner has."""
    order = np.lexsort((tiles[:, 1], tiles[:, 0], rows))
    rows, tiles = rows[order], tiles[order]
    first = np.ones(len(rows), dtype=bool)
    first[1:] = (rows[1:] != rows[:-1]) | (tiles[1:] != tiles[:-1]).any(axis=1)
    index = np.empty(len(rows), dtype=np.int64)
    index[order] = np.cumsum(first) - 1
    return rows[first], tiles[first], index


def _demand_room(images: list[Tensor], name: str) -> None:
    """Refuse images that take too much memory together with the one that they are copied into."""
    sizes = [(image.shape[1], image.shape[0]) for image in {id(image): image for image in images}.values()]
    width, height = pack_rectangles(sizes).total_size
    if width * height + sum(columns * rows for columns, rows in sizes) > MAX_TEXTURE_PIXELS:
        limit = f"half of {MAX_TEXTURE_PIXELS:,} pixels, or include_textures=False"
        raise MeshFormatError("the images side by side are too large", name, None, f"{width:,} x {height:,}", limit)


def _packed(patches: list[_Patch], sampling: Sampling, name: str) -> tuple[Tensor, list[Floats]]:
    """All images side by side, and each part's coordinates in it."""
    _demand_room([patch.image for patch in patches], name)
    inside = [patch.uvs.clip(0.0, 1.0) for patch in patches]
    if any(
        (patch.uvs[patch.faces_uvs] != uvs[patch.faces_uvs]).any() for patch, uvs in zip(patches, inside, strict=True)
    ):
        warnings.warn(f"{name}: texture coordinates outside of [0, 1] are clamped to share one image", stacklevel=7)
    coordinates = [torch.from_numpy(uvs) for uvs in inside]
    unpadded = [coordinates[0][:0]] * len(patches)  # as none lies outside
    packed = pack_maps([patch.image for patch in patches], unpadded, sampling)
    return packed.image, [packed.move(i, uvs).numpy() for i, uvs in enumerate(coordinates)]
