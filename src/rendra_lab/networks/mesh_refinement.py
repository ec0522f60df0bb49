"""Stages that move the vertices of a mesh to where the features of a picture say that the surface is.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 3.1 (mesh refinement branch): vertex
alignment, graph convolution, vertex refinement.
Letters: N meshes, V and E vertices and edges of all of them (packed), P vertices of the largest (padded), L maps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.ops import GraphConv, SubdivideMeshes, vert_align
from rendra.structures import Meshes
from rendra_lab.settings import Positive

Placed = Callable[[Tensor], Tensor]
"""Padded vertices (N, P, 3) to where the maps show them: x and y in [-1, 1] right and down, z as the frame has it."""


class RefinementStage(nn.Module):
    """One mesh, its positions and what the stage before knew of its vertices, to the next mesh.

    Features of the maps at each vertex are narrowed to `width`; graph convolutions take them with the position and
    the features of the stage before; every vertex moves by tanh of a linear layer, which begins at zero.

    Args:
        in_channels: of all maps together.
        width: features of a vertex.
        convs: how many graph convolutions, at least one.
        is_first: no stage was before.
        padding_mode, align_corners: of `vert_align`.
    """

    def __init__(
        self,
        in_channels: Positive,
        width: Positive = 128,
        convs: Positive = 3,
        is_first: bool = False,
        padding_mode: Literal["zeros", "border"] = "zeros",
        align_corners: bool = True,
    ) -> None:
        super().__init__()
        self.padding_mode = padding_mode
        self.align_corners = align_corners
        self.bottleneck = nn.Linear(in_channels, width)
        begin = width + 3 + (0 if is_first else width)
        widths = [begin] + [width + 3] * (convs - 1)
        self.convs = nn.ModuleList(GraphConv(before, width) for before in widths)
        self.offset = nn.Linear(width + 3, 3)
        nn.init.normal_(self.bottleneck.weight, std=0.01)
        nn.init.zeros_(self.bottleneck.bias)
        nn.init.zeros_(self.offset.weight)
        nn.init.zeros_(self.offset.bias)

    def forward(
        self,
        meshes: Meshes,
        maps: Sequence[Float[Tensor, "N _ _ _"]],
        before: Float[Tensor, "V D"] | None = None,
        placed: Placed | None = None,
    ) -> tuple[Meshes, Float[Tensor, "V D"]]:
        """The moved meshes, and features of their vertices for the stage after.

        Args:
            meshes: N.
            maps: of N pictures or regions.
            before: features from the stage before.
            placed: where the maps show vertices; None: they are in the frame of the maps already.
        """
        verts = meshes.verts_padded()
        places = verts if placed is None else placed(verts)
        packed = places.flatten(0, 1).index_select(0, meshes.verts_padded_to_packed_idx())
        seen = F.relu(self._seen(meshes, maps, places))
        features = torch.cat([seen, packed] if before is None else [seen, packed, before], dim=1)
        neighbours = meshes.topology.neighbours(features.dtype)
        for conv in self.convs:
            features = torch.cat([F.relu(conv.over(features, neighbours)), packed], dim=1)  # type: ignore[operator]
        moved = meshes.offset_verts(torch.tanh(self.offset(features)))
        return moved, features[:, : self.offset.in_features - 3]

    def _seen(self, meshes: Meshes, maps: Sequence[Tensor], places: Tensor) -> Tensor:
        """The narrowed features of the maps at the vertices: (V, D).

        Reading a map between its cells is linear, and so is narrowing: maps have fewer cells than meshes have
        vertices, so that they are narrowed first. The paper's head then takes a twentieth of the work.
        """
        sizes = [each.shape[1] for each in maps]
        weights = self.bottleneck.weight.split(sizes, dim=1)
        narrow = [F.conv2d(each, w[:, :, None, None]) for each, w in zip(maps, weights, strict=True)]
        narrow = _put_together(narrow) if self.align_corners else narrow
        read = vert_align(narrow, places, padding_mode=self.padding_mode, align_corners=self.align_corners)
        packed = read.flatten(0, 1).index_select(0, meshes.verts_padded_to_packed_idx())
        return packed.unflatten(1, (len(narrow), -1)).sum(1) + self.bottleneck.bias


def _put_together(maps: Sequence[Tensor]) -> list[Tensor]:
    """Fewer maps of the same sum: those whose cells are cells of the finest map too are added to it.

    With their outermost cells in one place, what lies between the cells of a coarse map is a bilinear function that
    the finest map holds exactly.
    """
    finest = max(maps, key=lambda each: each.shape[2] * each.shape[3])
    size = finest.shape[2:]
    total, others = finest, []
    for each in maps:
        if each is finest:
            continue
        pairs = zip(each.shape[2:], size, strict=True)
        if finest.numel() and all(few > 1 and (many - 1) % (few - 1) == 0 for few, many in pairs):
            total = total + F.interpolate(each, size, mode="bilinear", align_corners=True)
        else:
            others.append(each)
    return [total, *others]


class MeshRefinement(nn.Module):
    """Several stages, each with weights of its own.

    The paper's: 1.846 M weights with the 3840 channels of a ResNet-50 (ShapeNet), 0.470 M with 256 (Pix3D).

    Args:
        in_channels: of all maps together.
        width: features of a vertex.
        stages: how many.
        convs: graph convolutions of each.
        subdivide: between stages every face is cut into four ("Pixel2Mesh+").
        padding_mode: what a vertex outside of the maps reads: nothing ("zeros", the paper's for pictures) or the
            nearest cell ("border", for regions).
        align_corners: -1 and 1 are the centres of the outermost cells (the paper's), or their outer edges.
    """

    def __init__(
        self,
        in_channels: Positive,
        width: Positive = 128,
        stages: Positive = 3,
        convs: Positive = 3,
        subdivide: bool = False,
        padding_mode: Literal["zeros", "border"] = "zeros",
        align_corners: bool = True,
    ) -> None:
        super().__init__()
        self.in_channels = in_channels
        self.stages = nn.ModuleList(
            RefinementStage(in_channels, width, convs, number == 0, padding_mode, align_corners)
            for number in range(stages)
        )
        self.subdivide = SubdivideMeshes() if subdivide else None

    def forward(
        self, meshes: Meshes, maps: Sequence[Float[Tensor, "N _ _ _"]], placed: Placed | None = None
    ) -> tuple[Meshes, ...]:
        """The meshes after each stage; without vertices nothing happens to them.

        Args:
            meshes: N meshes to begin with, in whatever frame: offsets are in its units.
            maps: feature maps of N pictures or regions, with `in_channels` in all.
            placed: where the maps show vertices, as in `Frustums.from_camera`; None: vertices are in the frame of
                the maps already.

        Raises:
            ValueError: another number of channels.
        """
        channels = sum(each.shape[1] for each in maps)
        if channels != self.in_channels:
            raise ValueError(f"this refinement reads {self.in_channels} channels, the maps have {channels}")
        found: list[Meshes] = []
        before = None
        for stage in self.stages:
            if found and self.subdivide is not None:
                meshes, before = self.subdivide(meshes, before)
            meshes, before = stage(meshes, maps, before, placed)
            found.append(meshes)
        return tuple(found)
