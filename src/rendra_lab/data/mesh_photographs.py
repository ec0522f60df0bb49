"""Photographs of a mesh: anti-aliased RGBA images with exact cameras, through lenses with or without distortion.

Image axes and units as in `posed_images`. Colours are averaged as the shader gives them, in sRGB.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer import (
    BlendParams,
    HardPhongShader,
    MeshRasterizer,
    MeshRenderer,
    PerspectiveCameras,
    RasterizationSettings,
)
from rendra.structures import Meshes
from rendra_lab.data.posed_images import NUM_DISTORTION, undistorted
from rendra_lab.errors import UserError
from rendra_lab.records import TensorRecord

_SAMPLES_AT_ONCE = 1 << 20
_NEAREST = 1e-2  # depth at which faces are cut


@dataclass(frozen=True)
class Shots(TensorRecord):
    """Cameras of photographs that are to be taken; fields as in PosedImages."""

    labels: tuple[str, ...]
    sizes: Int[Tensor, "N 2"]  # height, width
    intrinsics: Float[Tensor, "N 4"]  # fx fy cx cy in pixels
    distortion: Float[Tensor, "N 8"]  # see posed_images.NUM_DISTORTION
    R: Float[Tensor, "N 3 3"]
    T: Float[Tensor, "N 3"]

    def __len__(self) -> int:
        return len(self.labels)

    @classmethod
    def alike(
        cls,
        labels: Sequence[str],
        R: Tensor,
        T: Tensor,
        size: tuple[int, int],
        fov_deg: float,
        distortion: Sequence[float] = (),
    ) -> Shots:
        """Shots of one size and one lens, whose axis meets the middle of the image.

        Args:
            labels: N names.
            R: (N, 3, 3).
            T: (N, 3).
            size: height and width in pixels.
            fov_deg: field of view of the short side, without distortion.
            distortion: up to eight coefficients in OpenCV's order, k1 k2 p1 p2 ...
        """
        if not 0 < fov_deg < 180:
            raise UserError(f"data.fov_deg must lie between 0 and 180 degrees, got {fov_deg}")
        if len(distortion) > NUM_DISTORTION:
            raise UserError(f"data.distortion has at most {NUM_DISTORTION} coefficients, got {len(distortion)}")
        if not all(map(math.isfinite, distortion)):
            raise UserError(f"data.distortion holds finite numbers, got {[*distortion]}")
        height, width = size
        focal = min(size) / 2 / float(torch.tensor(fov_deg / 2).deg2rad().tan())
        lens = [*distortion, *[0.0] * (NUM_DISTORTION - len(distortion))]
        count = len(labels)
        return cls(
            labels=tuple(labels),
            sizes=torch.tensor([[height, width]]).repeat(count, 1),
            intrinsics=torch.tensor([[focal, focal, width / 2, height / 2]]).repeat(count, 1),
            distortion=torch.tensor([lens], dtype=torch.float32).repeat(count, 1),
            R=R,
            T=T,
        )


class MeshPhotographer:
    """Takes photographs of one mesh.

    Args:
        mesh: a batch of one, with a texture.
        lights: of rendra.renderer.
        antialias: samples of a pixel along each of its sides.
    """

    def __init__(self, mesh: Meshes, lights: Any, antialias: int = 4) -> None:
        if len(mesh) != 1:
            raise ValueError(f"one mesh is photographed, got a batch of {len(mesh)}")
        if not (isinstance(antialias, int) and 1 <= antialias <= 16):
            raise UserError(f"data.antialias must be a whole number from 1 to 16, got {antialias!r}")
        self.mesh = mesh
        self.lights = lights.to(mesh.device)
        self.antialias = antialias
        self.shader = HardPhongShader(
            device=mesh.device, lights=self.lights, blend_params=BlendParams(background_color=(0.0, 0.0, 0.0))
        )

    @torch.no_grad()
    def take(self, shots: Shots) -> Iterator[Tensor]:
        """One photograph after the other, uint8 (H, W, 4) on the CPU: not premultiplied, alpha is the coverage."""
        for index in range(len(shots)):
            shot = _Shot(
                shots.R[index : index + 1],
                shots.T[index : index + 1],
                shots.intrinsics[index],
                shots.distortion[index : index + 1],
                (int(shots.sizes[index, 0]), int(shots.sizes[index, 1])),
            )
            yield _as_bytes(self._photograph(shot.to(self.mesh.device))).cpu()

    def _photograph(self, shot: _Shot) -> Tensor:
        """(H, W, 4) in [0, 1], premultiplied."""
        height, width = shot.size
        image = torch.zeros(height, width, 4, device=shot.R.device)
        top, left, bottom, right = self._outline(shot)
        rows = max(1, _SAMPLES_AT_ONCE // (self.antialias**2 * max(1, right - left)))
        for first in range(top, bottom if left < right else top, rows):
            last = min(first + rows, bottom)
            samples = self._through_lens(shot, first, left, last, right)
            image[first:last, left:right] = _average(samples, self.antialias)
        return image

    def _outline(self, shot: _Shot) -> tuple[int, int, int, int]:
        """Rows and columns that hold all of the mesh: top, left, bottom, right; all where that is not plain."""
        height, width = shot.size
        in_view = self.mesh.verts_packed() @ shot.R[0] + shot.T
        if bool(shot.distortion.any()) or float(in_view[:, 2].amin()) < 2 * _NEAREST:
            return 0, 0, height, width
        xy = shot.intrinsics[2:] - shot.intrinsics[:2] * in_view[:, :2] / in_view[:, 2:]
        low = (xy.amin(0).floor().clamp(-1, 1e6).long() - 1).clamp_min(0).tolist()
        high = (xy.amax(0).ceil().clamp(-1, 1e6).long() + 1).tolist()
        return min(low[1], height), min(low[0], width), max(0, min(high[1], height)), max(0, min(high[0], width))

    def _through_lens(self, shot: _Shot, top: int, left: int, bottom: int, right: int) -> Tensor:
        """Samples of rows top..bottom and columns left..right: (rows * a, columns * a, 4), premultiplied."""
        if not bool(shot.distortion.any()):
            return self._render(shot, top, left, bottom, right)
        xy = self._straightened(shot, top, left, bottom, right)
        low = xy.flatten(0, 1).amin(0).floor().long() - 1
        high = xy.flatten(0, 1).amax(0).ceil().long() + 1
        (west, north), (east, south) = low.tolist(), high.tolist()
        straight = self._render(shot, north, west, south, east)
        extent = xy.new_tensor([east - west, south - north])
        grid = 2 * (xy - low) / extent - 1
        return F.grid_sample(straight.movedim(-1, 0)[None], grid[None], align_corners=False)[0].movedim(0, -1)

    def _straightened(self, shot: _Shot, top: int, left: int, bottom: int, right: int) -> Tensor:
        """Where the samples of rows and columns would lie without distortion: (rows * a, columns * a, 2)."""
        fine = self.antialias
        y = (torch.arange(top * fine, bottom * fine, device=shot.R.device) + 0.5) / fine
        x = (torch.arange(left * fine, right * fine, device=shot.R.device) + 0.5) / fine
        xy = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        focal, centre = shot.intrinsics.split(2)
        slope = ((xy - centre) / focal).reshape(-1, 2)
        no_fisheye = torch.zeros(len(slope), dtype=torch.bool, device=slope.device)
        straight = undistorted(slope, shot.distortion.expand(len(slope), -1), no_fisheye)
        return (straight * focal + centre).reshape(xy.shape)

    def _render(self, shot: _Shot, top: int, left: int, bottom: int, right: int) -> Tensor:
        """Samples of a window of the image without distortion, which may reach beyond it."""
        fine = self.antialias
        size = ((bottom - top) * fine, (right - left) * fine)
        corner = shot.intrinsics.new_tensor([left, top])
        cameras = PerspectiveCameras(
            focal_length=fine * shot.intrinsics[None, :2],
            principal_point=fine * (shot.intrinsics[None, 2:] - corner),
            R=shot.R,
            T=shot.T,
            in_ndc=False,
            image_size=[size],
            device=shot.R.device,
        )
        rasterizer = MeshRasterizer(cameras, RasterizationSettings(size, z_clip_value=_NEAREST, cull_to_frustum=True))
        return MeshRenderer(rasterizer, self.shader)(self.mesh, cameras=cameras)[0].clamp(0, 1)


@dataclass(frozen=True)
class _Shot(TensorRecord):
    R: Float[Tensor, "1 3 3"]
    T: Float[Tensor, "1 3"]
    intrinsics: Float[Tensor, " 4"]
    distortion: Float[Tensor, "1 8"]
    size: tuple[int, int]


def _average(samples: Tensor, side: int) -> Tensor:
    return F.avg_pool2d(samples.movedim(-1, 0), side).movedim(0, -1)


def _as_bytes(image: Tensor) -> Tensor:
    """Premultiplied (H, W, 4) in [0, 1] as uint8, not premultiplied; black where nothing is."""
    alpha = image[..., 3:]
    colour = image[..., :3] / torch.where(alpha > 0, alpha, 1.0)
    return torch.cat([colour, alpha], dim=-1).mul(255).round().to(torch.uint8)
