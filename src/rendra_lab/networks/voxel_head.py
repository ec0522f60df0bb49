"""From feature maps to a coarse solid of voxels, and from voxels to the mesh that is refined.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 3.1 (voxel branch, cubify).
Letters: N objects, C channels, V voxels along each side. Grids are [z, y, x] over a frustum (`rendra_lab.frustums`):
columns and rows of a map are x and y, and channels of the last layer are z.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.ops import cubify, taubin_smoothing
from rendra.structures import Meshes
from rendra_lab.settings import Count, Positive


class VoxelHead(nn.Module):
    """A column of voxel logits behind each cell of a map: `convs` x (conv 3x3, ReLU), deconv 2x2, ReLU, conv 1x1.

    Weights of the paper's heads: 6.764 M for 2048 channels and 48 voxels (ShapeNet), 2.629 M for 256 and 24 (Pix3D).

    Args:
        in_channels: C of the map; or of each of several maps, which are put together.
        side: V, even.
        width: channels of the layers between.
        convs: how many convolutions come first.
        align_corners: maps of another size than V / 2 are resized so that the centres of their outermost cells keep
            their places (True) or their outer edges do (False, the paper's).

    Raises:
        ValueError: an odd number of voxels.
    """

    def __init__(
        self,
        in_channels: Positive | Sequence[Positive],
        side: Positive = 48,
        width: Positive = 256,
        convs: Count = 4,
        align_corners: bool = False,
    ) -> None:
        super().__init__()
        if side % 2:
            raise ValueError(f"the side of a voxel grid must be even, got {side}")
        self.side = side
        self.align_corners = align_corners
        self.in_channels = [in_channels] if isinstance(in_channels, int) else list(in_channels)
        widths = [sum(self.in_channels)] + [width] * convs
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, padding=1), nn.ReLU()]
        self.layers = nn.Sequential(*layers, nn.ConvTranspose2d(widths[-1], width, 2, stride=2), nn.ReLU())
        self.last = nn.Conv2d(width, side, 1)
        for layer in self.layers:
            if isinstance(layer, (nn.Conv2d, nn.ConvTranspose2d)):
                nn.init.kaiming_normal_(layer.weight, mode="fan_out", nonlinearity="relu")  # "MSRA"
                nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
        nn.init.normal_(self.last.weight, std=0.001)
        nn.init.zeros_(self.last.bias)  # type: ignore[arg-type]

    def forward(
        self, features: Float[Tensor, "N C H W"] | Sequence[Float[Tensor, "N _ _ _"]]
    ) -> Float[Tensor, "N V V V"]:
        """Logits of being filled.

        Args:
            features: the map; or maps of several resolutions, of which the last ones are read, as many as
                `in_channels`.

        Raises:
            ValueError: maps of other channels.
        """
        maps = [features] if isinstance(features, Tensor) else list(features)[-len(self.in_channels) :]
        if [each.shape[1] for each in maps] != self.in_channels:
            raise ValueError(
                f"this voxel head reads maps of {self.in_channels} channels, got {[each.shape[1] for each in maps]}"
            )
        return self.last(self.layers(torch.cat([self._resized(each) for each in maps], dim=1)))

    def _resized(self, features: Tensor) -> Tensor:
        half = (self.side // 2, self.side // 2)
        if not len(features):
            return features.new_zeros(0, features.shape[1], *half)  # interpolation refuses these
        if features.shape[-2:] == half:
            return features
        return F.interpolate(features, half, mode="bilinear", align_corners=self.align_corners)


def cubified(
    logits: Float[Tensor, "N V V V"], threshold: float = 0.2, smoothing: int = 0
) -> tuple[Meshes, Bool[Tensor, " N"]]:
    """The surface of the voxels whose probability exceeds a threshold, over the cube [-1, 1]^3.

    Where no voxel does, the central cube of half the side stands in, so that there always is a mesh to refine.
    Not differentiable.

    Args:
        logits: of being filled.
        threshold: the probability.
        smoothing: rounds of Taubin's filter; 0, as published, leaves the steps of the cells as they are, which a
            refinement learns to even out in a hundred thousand steps, and not in a thousand.

    Returns:
        N closed meshes, and which of them come from voxels.
    """
    probability = torch.sigmoid(logits.detach())
    is_found = (probability > threshold).flatten(1).any(1)
    side = logits.shape[-1]
    center = slice(side // 4, max(side - side // 4, side // 4 + 1))
    cube = torch.zeros_like(probability[:1])
    cube[:, center, center, center] = 1
    filled = torch.where(is_found[:, None, None, None], probability, cube)
    meshes = cubify(filled, threshold, align="corner")
    return (taubin_smoothing(meshes, num_iter=smoothing) if smoothing else meshes), is_found


def central_tetrahedra(count: int, like: Tensor) -> Meshes:
    """`count` tetrahedra about the middle of the cube [-1, 1]^3: something to refine that costs nothing."""
    corners = [[0.5, 0.5, 0.5], [0.5, -0.5, -0.5], [-0.5, 0.5, -0.5], [-0.5, -0.5, 0.5]]
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]], device=like.device)
    verts = torch.tensor(corners, dtype=like.dtype, device=like.device)
    return Meshes(verts.expand(count, -1, -1), faces.expand(count, -1, -1))
