"""Many texture maps in one image, such that sampling gives the colours that it gave before.

Every map is copied into the image together with as many texels of its padding (border, zeros or reflection)
as its texture coordinates reach, so that interpolation never meets a neighbour's texels.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor

import torch
from torch import Tensor

from rendra.renderer.mesh.utils import pack_rectangles

_MAX_OVERHANG = 2  # how many widths of a map its coordinates may lie outside of it


@dataclass(frozen=True)
class Sampling:
    """How a map is read: the arguments of `torch.nn.functional.grid_sample` of these names."""

    padding_mode: str
    align_corners: bool
    mode: str

    def texels(self, uvs: Tensor, height: int, width: int) -> Tensor:
        """Where texture coordinates lie in an image, in texels from the centre of the top left one.

        Args:
            uvs: (..., 2), from 0 to 1, origin at the bottom left.
            height: of the image.
            width: of the image.

        Returns:
            (..., 2) as column and row.
        """
        u, v = uvs[..., 0], 1 - uvs[..., 1]
        if self.align_corners:
            return torch.stack([u * (width - 1), v * (height - 1)], dim=-1)
        return torch.stack([u * width - 0.5, v * height - 0.5], dim=-1)

    def uvs(self, texels: Tensor, height: int, width: int) -> Tensor:
        """The inverse of `texels`."""
        x, y = texels[..., 0], texels[..., 1]
        if self.align_corners:
            return torch.stack([x / max(width - 1, 1), 1 - y / max(height - 1, 1)], dim=-1)
        return torch.stack([(x + 0.5) / width, 1 - (y + 0.5) / height], dim=-1)


@dataclass(frozen=True)
class _Box:
    """Half-open ranges of texels, which may lie outside of the map that they refer to."""

    left: int
    right: int
    top: int
    bottom: int

    def __or__(self, other: "_Box") -> "_Box":
        return _Box(
            min(self.left, other.left),
            max(self.right, other.right),
            min(self.top, other.top),
            max(self.bottom, other.bottom),
        )


@dataclass(frozen=True)
class PackedMaps:
    """Maps side by side."""

    image: Tensor  # (H, W, C)
    sizes: list[tuple[int, int]]  # height and width of each map
    shifts: list[tuple[int, int]]  # column and row in the image of each map's top left texel
    sampling: Sampling

    def move(self, index: int, uvs: Tensor) -> Tensor:
        """Coordinates (..., 2) in one of the maps as coordinates in the image."""
        texels = self.sampling.texels(uvs, *self.sizes[index]) + uvs.new_tensor(self.shifts[index])
        return self.sampling.uvs(texels, *self.image.shape[:2])


def pack_maps(images: Sequence[Tensor], uvs: Sequence[Tensor], sampling: Sampling) -> PackedMaps:
    """Put maps side by side into one image. A map given more than once (the same object) is stored once.

    Args:
        images: N >= 1 maps (H_i, W_i, C).
        uvs: for each map the texture coordinates (V_i, 2) that it is read at, and between.
        sampling: how they are read, before and after.

    Raises:
        ValueError: numbers of channels differ, or coordinates lie further outside of [0, 1] than 2.
    """
    if len({image.shape[-1] for image in images}) > 1:
        raise ValueError(f"maps must have equal channels, got {[image.shape[-1] for image in images]}")
    distinct = {id(image): image for image in images}
    boxes: dict[int, _Box] = {}
    for image, own in zip(images, uvs, strict=True):
        box = _box_of(image, own, sampling)
        boxes[id(image)] = boxes.get(id(image), box) | box
    packed = pack_rectangles([(b.right - b.left, b.bottom - b.top) for b in boxes.values()])
    width, height = packed.total_size
    canvas = images[0].new_zeros(height, width, images[0].shape[-1])
    shifts = {}
    for (key, box), (column, row, *_) in zip(boxes.items(), packed.locations, strict=True):
        piece = _padded_map(distinct[key], box, sampling)
        canvas[row : row + piece.shape[0], column : column + piece.shape[1]] = piece
        shifts[key] = (column - box.left, row - box.top)
    sizes = [(image.shape[0], image.shape[1]) for image in images]
    return PackedMaps(canvas, sizes, [shifts[id(image)] for image in images], sampling)


def _box_of(image: Tensor, uvs: Tensor, sampling: Sampling) -> _Box:
    """The texels of an endlessly padded map that sampling at `uvs`, and between them, can touch."""
    height, width = image.shape[:2]
    if len(uvs) == 0:
        return _Box(0, width, 0, height)
    low, high = torch.aminmax(uvs.detach(), dim=0)
    if not (low >= -_MAX_OVERHANG).all() or not (high <= 1 + _MAX_OVERHANG).all():
        raise ValueError(
            f"texture coordinates must lie in [{-_MAX_OVERHANG}, {1 + _MAX_OVERHANG}] to share one image, "
            f"got {low.tolist()} to {high.tolist()}; keep the meshes as a batch instead"
        )
    (left, bottom), (right, top) = sampling.texels(torch.stack([low, high]), height, width).tolist()
    return _Box(min(0, floor(left)), max(width, ceil(right) + 1), min(0, floor(top)), max(height, ceil(bottom) + 1))


def _padded_map(image: Tensor, box: _Box, sampling: Sampling) -> Tensor:
    """The texels of `box`, those outside of the image by the padding mode."""
    if box == _Box(0, image.shape[1], 0, image.shape[0]):
        return image
    rows = torch.arange(box.top, box.bottom, device=image.device)
    columns = torch.arange(box.left, box.right, device=image.device)
    height, width = image.shape[:2]
    if sampling.padding_mode == "reflection":
        rows, columns = (_reflected(i, n, sampling.align_corners) for i, n in ((rows, height), (columns, width)))
    piece = image[rows.clamp(0, height - 1)][:, columns.clamp(0, width - 1)]
    if sampling.padding_mode == "zeros":
        inside_rows, inside_columns = (rows >= 0) & (rows < height), (columns >= 0) & (columns < width)
        piece = piece * (inside_rows[:, None] & inside_columns)[..., None]
    return piece


def _reflected(index: Tensor, size: int, align_corners: bool) -> Tensor:
    """Reflect about the outermost texels' centres, or about their outer edges."""
    period = max(2 * (size - 1), 1) if align_corners else 2 * size
    turned = index.remainder(period)
    return torch.minimum(turned, period - turned - (0 if align_corners else 1))
