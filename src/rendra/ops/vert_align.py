"""Features of an image at the places where vertices are seen."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F


def vert_align(
    feats: Tensor | Sequence[Tensor],
    verts: Any,
    return_packed: bool = False,
    interp_mode: str = "bilinear",
    padding_mode: str = "zeros",
    align_corners: bool = True,
) -> Tensor:
    """Read feature maps at the x and y of vertices or points (Wang et al., "Pixel2Mesh", ECCV 2018).

    Args:
        feats: maps (N, C, H, W), or several of them, which may differ in C, H and W.
        verts: (N, V, 3) or (N, V, 2), or `Meshes` or `Pointclouds` of N. x runs from -1 at the left of a map
            to 1 at its right, y from -1 at its top to 1 at its bottom.
        return_packed: without what fills up the smaller shapes of the batch.
        interp_mode, padding_mode, align_corners: as in `torch.nn.functional.grid_sample`. With `align_corners`
            -1 and 1 are the centres of the outermost pixels, else their outer edges.

    Returns:
        (N, V, sum of C), or (sum V, sum of C) if packed. Differentiable with respect to both.

    Raises:
        ValueError: `verts` is something else, a shape is not as above, or the batches differ in N.
    """
    positions, rows = _positions(verts)
    maps: list[Any] = list(feats) if isinstance(feats, (list, tuple)) else [feats]
    if not maps:
        raise ValueError("feats must hold at least one map, got an empty list")
    grid = positions[:, None, :, :2]  # (N, 1, V, 2)
    for each in maps:
        _check_map(each, len(positions))
    sampled = [_sample(each, grid, interp_mode, padding_mode, align_corners) for each in maps]
    aligned = torch.cat(sampled, dim=1).transpose(1, 2)  # (N, V, C)
    if not return_packed:
        return aligned
    packed = aligned.flatten(0, 1)
    return packed if rows is None else packed.index_select(0, rows)


def _positions(verts: Any) -> tuple[Tensor, Tensor | None]:
    """Padded positions (N, V, 3), and which of their rows are no padding; None means all."""
    if isinstance(verts, Tensor):
        if verts.ndim != 3 or verts.shape[2] not in (2, 3):
            raise ValueError(
                f"verts tensor should be 3 dimensional, (N, V, 3) or (N, V, 2); got {tuple(verts.shape)}"
            )
        return verts, None
    if hasattr(verts, "verts_padded"):
        return verts.verts_padded(), verts.verts_padded_to_packed_idx()
    if hasattr(verts, "points_padded"):
        return verts.points_padded(), verts.padded_to_packed_idx()
    raise ValueError(f"verts must be a tensor, Meshes or Pointclouds; got {type(verts)}")


def _check_map(each: Any, batch_size: int) -> None:
    if not isinstance(each, Tensor) or each.ndim != 4:
        shown = tuple(each.shape) if isinstance(each, Tensor) else type(each)
        raise ValueError(f"feats must be 4 dimensional tensors, (N, C, H, W); got {shown}")
    if len(each) != batch_size:
        raise ValueError(f"inconsistent batch dimension: verts have {batch_size}, feats {len(each)}")


def _sample(each: Tensor, grid: Tensor, interp_mode: str, padding_mode: str, align_corners: bool) -> Tensor:
    """One map read at the grid. (N, C, V)"""
    if len(each) == 0 or grid.shape[2] == 0:  # grid_sample refuses these; their gradient is zero, not missing
        return each.sum((2, 3))[..., None].expand(-1, -1, grid.shape[2])
    sampled = F.grid_sample(
        each, grid.to(each.dtype), mode=interp_mode, padding_mode=padding_mode, align_corners=align_corners
    )
    return sampled[:, :, 0]
