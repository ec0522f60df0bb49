"""Features of regions: what a feature pyramid holds behind each box, resampled to a small square of cells.

He et al., "Mask R-CNN", ICCV 2017, arXiv:1703.06870, section 3 (RoIAlign), with the half-pixel alignment of
Detectron2's `ROIAlignV2`: the value of cell (i, j) of a map stands at its middle, ((j + 1/2) stride,
(i + 1/2) stride) in pixels. Which level a region looks at: Lin et al., "Feature Pyramid Networks", CVPR 2017,
arXiv:1612.03144, equation 1.

Letters: B pictures, C channels, R regions, S cells along each side of the result, n samples along each side of
such a cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from rendra_lab.detection.weighted_rows import weighted_rows

_CANONICAL_STRIDE = 16  # of the level, the fourth, at which regions of the canonical side are looked up

_MOST_SAMPLES = 64  # along a side of a cell, however large a region is


class RoiAlign(nn.Module):
    """Mean of n x n bilinear samples in each of S x S cells of each region. Has no parameters.

    Args:
        side: S.
        strides: pixels between the cells of each level, finest first, powers of 2.
        samples: n; 0: as many as a cell of the result is wide (high) in cells of the map, rounded up,
            64 at most.
        canonical_px: regions of this side are looked up at stride 16, those of half of it at stride 8, and so on.
            224 is the published one, for pictures of some 800 pixels.

    Raises:
        ValueError: numbers that cannot be.
    """

    def __init__(
        self, side: int, strides: Sequence[int] = (4, 8, 16, 32), samples: int = 2, canonical_px: float = 224.0
    ) -> None:
        super().__init__()
        if side < 1 or samples < 0 or not strides or min(strides) < 1 or canonical_px <= 0:
            raise ValueError(
                "RoiAlign needs side of 1 or more, samples of 0 or more, strides of 1 or more and canonical_px above "
                f"0, got side={side}, samples={samples}, strides={tuple(strides)}, canonical_px={canonical_px}"
            )
        self.side, self.strides, self.samples, self.canonical_px = side, tuple(strides), samples, canonical_px

    def forward(
        self, features: Sequence[Float[Tensor, "B C _ _"]], boxes: Float[Tensor, "R 4"], picture: Int[Tensor, " R"]
    ) -> Float[Tensor, "R C S S"]:
        """Features behind boxes in pixels of their pictures. Gradients reach the features, not the boxes.

        Samples up to one cell outside of a map take what is at its edge, those farther away 0.

        Args:
            features: one map for each stride.
            boxes: in pixels.
            picture: which of the B pictures each is in.

        Raises:
            ValueError: not one map for each stride.
        """
        if len(features) != len(self.strides):
            raise ValueError(f"RoiAlign has strides {self.strides}, got {len(features)} feature maps")
        level = levels_of(boxes, self.strides, self.canonical_px)
        regions = _Regions.of(features, self.strides, boxes.detach(), picture, level)
        # rows of channels, all cells of all pictures of all levels one after the other
        table = torch.cat([feature.permute(0, 2, 3, 1).reshape(-1, feature.shape[1]) for feature in features])
        y, x = (regions.taps(axis, self.side, self.samples) for axis in (1, 0))
        bags = _even_bags(regions, y, x) if self.samples else _ragged_bags(regions, y, x)
        cells = weighted_rows(table, *bags)
        return cells.reshape(len(boxes), self.side, self.side, table.shape[1]).permute(0, 3, 1, 2).contiguous()


def levels_of(boxes: Float[Tensor, "R 4"], strides: Sequence[int], canonical_px: float = 224.0) -> Int[Tensor, " R"]:
    """Index into `strides` of the level that each box is looked up at; see `RoiAlign`."""
    sides = (boxes[:, 2:] - boxes[:, :2]).clamp_min(0).prod(1).sqrt()
    wanted = (sides * (_CANONICAL_STRIDE / canonical_px) + 1e-8).log2().floor()
    known = torch.tensor(strides, device=boxes.device).log2().to(wanted)
    return (wanted[:, None] >= known[1:]).sum(1)


@dataclass(frozen=True)
class _Taps:
    """Where the samples along one axis of R regions look: n samples of two cells each in each of S cells."""

    cells: Int[Tensor, "R S T"]  # of the map, T = 2 n; n of the region that has most
    weights: Float[Tensor, "R S T"]  # sum to at most 1 over T
    counts: Int[Tensor, " R"]  # how many of T are in use


@dataclass(frozen=True)
class _Regions:
    """Regions on their maps."""

    edges: Float[Tensor, "R 2 2"]  # low and high; x and y, in cells, the middle of the first cell at 0
    extents: Int[Tensor, "R 2"]  # width and height of the map
    first: Int[Tensor, " R"]  # row of the table that holds the first cell of the map

    @classmethod
    def of(
        cls, features: Sequence[Tensor], strides: Sequence[int], boxes: Tensor, picture: Tensor, level: Tensor
    ) -> _Regions:
        shapes = torch.tensor([feature.shape[:1] + feature.shape[2:] for feature in features], device=boxes.device)
        rows = shapes.prod(1)
        heights, widths = shapes[level, 1], shapes[level, 2]
        scale = boxes.new_tensor(strides)[level].reciprocal()
        first = (rows.cumsum(0) - rows)[level] + picture * heights * widths
        edges = (boxes * scale[:, None] - 0.5).reshape(-1, 2, 2)
        return cls(edges, torch.stack([widths, heights], dim=1), first)

    def taps(self, axis: int, side: int, samples: int) -> _Taps:
        """Of the axis: 0 x, 1 y."""
        low, high = self.edges[:, :, axis].unbind(1)
        extent = self.extents[:, axis, None, None]
        bin_size = (high - low) / side
        counts = torch.full_like(self.first, samples) if samples else _samples_across(bin_size)
        number = torch.arange(samples or (int(counts.max()) if len(counts) else 1), device=low.device)
        own = counts[:, None].to(low)
        places = torch.arange(side, device=low.device)[:, None] + ((number + 0.5) / own)[:, None, :]
        at = low[:, None, None] + places * bin_size[:, None, None]  # (R, S, n)
        is_in = (at >= -1) & (at <= extent) & (number < counts[:, None])[:, None]
        at = at.where(is_in, 0).clamp_min(0).minimum((extent - 1).to(at))  # no NaN of a box that has lost its way
        below = at.floor()
        whole = is_in / own[:, :, None]
        share = (at - below) * whole
        cells = torch.stack([below.long(), (below.long() + 1).minimum(extent - 1)], dim=-1)
        weights = torch.stack([whole - share, share], dim=-1)
        return _Taps(cells.flatten(2), weights.flatten(2), 2 * counts)


def _samples_across(bin_size: Tensor) -> Tensor:
    return bin_size.nan_to_num(1).ceil().clamp(1, _MOST_SAMPLES).long()


def _even_bags(regions: _Regions, y: _Taps, x: _Taps) -> tuple[Tensor, Tensor, Tensor]:
    """Rows of the table and weights, T T for each of the R S S cells; where those of each cell begin."""
    start = regions.first[:, None, None] + y.cells * regions.extents[:, 0, None, None]
    rows = start[:, :, None, :, None] + x.cells[:, None, :, None, :]  # (R, S, S, T, T)
    weights = y.weights[:, :, None, :, None] * x.weights[:, None, :, None, :]
    offsets = torch.arange(0, rows.numel(), rows.shape[3] * rows.shape[4], device=rows.device)
    return rows.flatten(), weights.flatten(), offsets


def _ragged_bags(regions: _Regions, y: _Taps, x: _Taps) -> tuple[Tensor, Tensor, Tensor]:
    """The same where the regions differ in their numbers of samples."""
    number, side, _ = y.cells.shape
    sizes = (y.counts * x.counts).repeat_interleave(side * side)
    offsets = sizes.cumsum(0) - sizes
    bag = torch.arange(len(sizes), device=sizes.device).repeat_interleave(sizes)
    rank = torch.arange(len(bag), device=sizes.device) - offsets[bag]
    region, cell = bag // (side * side), bag % (side * side)
    line = x.counts[region]
    at_y = ((region * side + cell // side) * y.cells.shape[2]) + rank // line
    at_x = ((region * side + cell % side) * x.cells.shape[2]) + rank % line
    rows = regions.first[region] + y.cells.flatten()[at_y] * regions.extents[:, 0][region] + x.cells.flatten()[at_x]
    return rows, y.weights.flatten()[at_y] * x.weights.flatten()[at_x], offsets
