"""Non-maximum suppression: of boxes that overlap much the surest stays. Also: the surest of each picture.

float32 boxes on the CPU take compiled loops, all others rounds over tables of pairs; both do the same arithmetic and
keep the same boxes.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from numba import prange
from torch import Tensor

from rendra.kernels.parallel import parallel_kernel
from rendra_lab.detection.boxes import areas, overlap_areas

_MOST_PAIRS = 2**25  # looked at in one go, off the compiled path
_ZERO = np.float32(0)


def kept_boxes(
    boxes: Float[Tensor, "M 4"], scores: Float[Tensor, " M"], groups: Int[Tensor, " M"], threshold: float
) -> Int[Tensor, " K"]:
    """Greedy suppression within groups: a box goes if a surer one that stays overlaps it by more than `threshold`.

    Args:
        boxes: in pixels.
        scores: the higher the surer; ties: the first given.
        groups: boxes of different groups (pictures, classes, levels: any int64) leave each other alone.
        threshold: intersection over union, in [0, 1].

    Returns:
        Indices of the boxes that stay, the surest first whatever their group. Not differentiable.

    Raises:
        ValueError: shapes that do not belong together, or a threshold out of range.
    """
    if boxes.ndim != 2 or boxes.shape[1] != 4 or not boxes.shape[:1] == scores.shape == groups.shape:
        shapes = ", ".join(str(tuple(tensor.shape)) for tensor in (boxes, scores, groups))
        raise ValueError(f"boxes, scores and groups must be (M, 4), (M,) and (M,), got {shapes}")
    if not 0 <= threshold <= 1:
        raise ValueError(f"threshold must be an intersection over union in [0, 1], got {threshold}")
    order = _by_group_and_score(scores.detach(), groups)
    first = _first_of_groups(groups[order])
    run = _is_kept_on_cpu if boxes.device.type == "cpu" and boxes.dtype == torch.float32 else _is_kept_in_rounds
    kept = order[run(boxes.detach()[order], first, threshold)].sort().values
    return kept[scores.detach()[kept].sort(descending=True, stable=True).indices]


def surest_of_each(scores: Float[Tensor, " M"], groups: Int[Tensor, " M"], count: int) -> Int[Tensor, " K"]:
    """Indices of the `count` highest scores of each group, or all: the lowest group first, the surest of it first."""
    order = _by_group_and_score(scores.detach(), groups)
    first = _first_of_groups(groups[order])
    sizes = first.diff()
    rank = torch.arange(len(order), device=order.device) - first[:-1].repeat_interleave(sizes)
    return order[rank < count]


def _by_group_and_score(scores: Tensor, groups: Tensor) -> Tensor:
    """Indices that sort by group and in it from high to low, the first given first."""
    by_score = scores.sort(descending=True, stable=True).indices
    return by_score[groups[by_score].sort(stable=True).indices]


def _first_of_groups(groups: Tensor) -> Tensor:
    """Where each group begins in sorted ones, and their number at the end: (G + 1,)."""
    sizes = groups.unique_consecutive(return_counts=True)[1]
    return torch.cat([sizes.new_zeros(1), sizes.cumsum(0)])


def _is_kept_on_cpu(boxes: Tensor, first: Tensor, threshold: float) -> Tensor:
    gone = np.zeros(len(boxes), np.int32)
    x0, y0, x1, y1 = boxes.T.contiguous().numpy()
    if len(boxes):
        _suppress(x0, y0, x1, y1, areas(boxes).numpy(), first.numpy(), np.float32(threshold), gone)
    return torch.from_numpy(gone) == 0


@parallel_kernel
def _suppress(
    x0: np.ndarray, y0: np.ndarray, x1: np.ndarray, y1: np.ndarray,
    area: np.ndarray, first: np.ndarray, threshold: np.float32, gone: np.ndarray,
) -> None:  # fmt: skip
    """Mark what goes; threads own groups. Flat loops over slices of what is left of a group: they vectorise."""
    for group in prange(len(first) - 1):
        end = first[group + 1]
        for i in range(first[group], end):
            if gone[i]:
                continue
            left, top, right, bottom, own = x0[i], y0[i], x1[i], y1[i], area[i]
            lefts, tops, rights, bottoms = x0[i + 1 : end], y0[i + 1 : end], x1[i + 1 : end], y1[i + 1 : end]
            rest, marks = area[i + 1 : end], gone[i + 1 : end]
            for j in range(end - i - 1):
                width = min(rights[j], right) - max(lefts[j], left)
                height = min(bottoms[j], bottom) - max(tops[j], top)
                shared = max(width, _ZERO) * max(height, _ZERO)
                marks[j] |= np.int32(shared > threshold * (own + rest[j] - shared))


def _is_kept_in_rounds(boxes: Tensor, first: Tensor, threshold: float) -> Tensor:
    """The same by tables of pairs of each group, groups filled up with boxes of no area, some groups at a time."""
    sizes = first.diff()
    group = torch.arange(len(sizes), device=boxes.device).repeat_interleave(sizes)
    place = torch.arange(len(boxes), device=boxes.device) - first[:-1].repeat_interleave(sizes)
    most = int(sizes.max()) if len(sizes) else 0
    padded = boxes.new_zeros((len(sizes), most, 4))
    padded[group, place] = boxes
    chunks = padded.split(max(1, _MOST_PAIRS // max(1, most**2)))
    kept = torch.cat([_greedy(chunk, threshold) for chunk in chunks])
    return kept[group, place]


def _greedy(boxes: Tensor, threshold: float) -> Tensor:
    """Which boxes (G, K, 4), surest first, stay (G, K).

    A box stays if no earlier one that stays overlaps it. Rounds of that rule, begun anyhow, settle the n-th box in
    the n-th round at the latest and mostly all of them in a few; what changes no more is the greedy answer.
    """
    shared, own = overlap_areas(boxes, boxes), areas(boxes)
    beats = (shared > threshold * (own[:, :, None] + own[:, None, :] - shared)).triu(1)
    kept = torch.ones(boxes.shape[:2], dtype=torch.bool, device=boxes.device)
    while True:
        now = ~(beats & kept[:, :, None]).any(1)
        if torch.equal(now, kept):
            return kept
        kept = now
