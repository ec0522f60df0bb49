"""Photographs of one scene and the cameras that took them: what radiance fields are fitted to.

Image axes are OpenCV's: x to the right, y down, in pixels, the centre of the first pixel at (0.5, 0.5). Poses are
this library's: x_view = x_world @ R + T, and in view +X is left, +Y up, +Z forwards.
Letters: N images, P pixels of all of them together, Q points in images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from rendra_lab.networks.camera_pose import camera_centre
from rendra_lab.records import TensorRecord

NUM_DISTORTION = 8
"""Coefficients of a lens in OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6; of a fisheye lens k1 k2 k3 k4 0 0 0 0."""

_UNDISTORTION_STEPS = 10


@dataclass(frozen=True)
class PosedImages(TensorRecord):
    """N images of any sizes, the pixels of all in one tensor, row by row, image after image."""

    labels: tuple[str, ...]  # where each came from: a file, or what a person would call it
    pixels: UInt8[Tensor, "P 4"]  # sRGB and alpha, not premultiplied; alpha is 255 in images without
    sizes: Int[Tensor, "N 2"]  # height, width
    intrinsics: Float[Tensor, "N 4"]  # fx fy cx cy in pixels
    distortion: Float[Tensor, "N 8"]  # see NUM_DISTORTION; zeros where there is none
    fisheye: Bool[Tensor, " N"]  # equidistant lenses
    R: Float[Tensor, "N 3 3"]
    T: Float[Tensor, "N 3"]
    has_alpha: bool  # whether alpha means anything

    @classmethod
    def gather(
        cls,
        labels: Sequence[str],
        images: Sequence[Tensor],
        intrinsics: Tensor,
        R: Tensor,
        T: Tensor,
        distortion: Tensor | None = None,
        fisheye: Tensor | None = None,
    ) -> PosedImages:
        """Put single images, uint8 (H, W, 3) or (H, W, 4), and their cameras together."""
        has_alpha = any(image.shape[-1] == 4 for image in images)
        rows = [_with_alpha(image).reshape(-1, 4) for image in images]
        count = len(images)
        return cls(
            labels=tuple(labels),
            pixels=torch.cat(rows) if rows else torch.zeros(0, 4, dtype=torch.uint8),
            sizes=torch.tensor([image.shape[:2] for image in images], dtype=torch.int64).reshape(count, 2),
            intrinsics=intrinsics,
            distortion=torch.zeros(count, NUM_DISTORTION) if distortion is None else distortion,
            fisheye=torch.zeros(count, dtype=torch.bool) if fisheye is None else fisheye,
            R=R,
            T=T,
            has_alpha=has_alpha,
        )

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def positions(self) -> Tensor:
        """Where the cameras stood in the world: (N, 3)."""
        return camera_centre(self.R, self.T)

    @property
    def first_pixel(self) -> Tensor:
        """Where the pixels of each image begin, and where the last ones end: (N + 1,) int64."""
        counts = self.sizes.prod(1)
        return torch.cat([counts.new_zeros(1), counts.cumsum(0)])

    def image(self, index: int) -> Tensor:
        """One image, float (H, W, 4) in [0, 1]."""
        first, last = self.first_pixel[index : index + 2].tolist()
        return self.pixels[first:last].reshape(*self.sizes[index].tolist(), 4) / 255

    def select(self, indices: Sequence[int]) -> PosedImages:
        """Some of the images, in the order of `indices`."""
        index = torch.tensor(list(indices), dtype=torch.int64)
        bounds = self.first_pixel.tolist()
        rows = [self.pixels[bounds[i] : bounds[i + 1]] for i in index.tolist()]
        return PosedImages(
            labels=tuple(self.labels[i] for i in index.tolist()),
            pixels=torch.cat(rows) if rows else self.pixels[:0],
            sizes=self.sizes[index],
            intrinsics=self.intrinsics[index],
            distortion=self.distortion[index],
            fisheye=self.fisheye[index],
            R=self.R[index],
            T=self.T[index],
            has_alpha=self.has_alpha,
        )

    def rays(self, view: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
        """Rays through points of the images.

        Args:
            view: (Q,) int64, the image of each point.
            xy: (Q, 2) in pixels.

        Returns:
            Origins (Q, 3) and directions (Q, 3) of length 1, in the world.
        """
        focal, centre = self.intrinsics.index_select(0, view).split(2, dim=1)
        slope = (xy - centre) / focal
        if bool(self.distortion.any()) or bool(self.fisheye.any()):
            slope = undistorted(slope, self.distortion.index_select(0, view), self.fisheye.index_select(0, view))
        in_view = torch.cat([-slope, torch.ones_like(slope[:, :1])], dim=1)
        directions = torch.einsum("qj,qij->qi", in_view, self.R.index_select(0, view))
        return self.positions.index_select(0, view), torch.nn.functional.normalize(directions, dim=1)


def undistorted(slope: Tensor, distortion: Tensor, fisheye: Tensor) -> Tensor:
    """Where a lens without distortion would show points: the inverse of `distorted`, by fixed-point iteration.

    Args:
        slope: (Q, 2), points of the distorted image on the plane at depth 1.
        distortion: (Q, 8) coefficients of each point's lens.
        fisheye: (Q,) whether that is an equidistant lens.

    Returns:
        (Q, 2) on the plane at depth 1.
    """
    found = slope
    for _ in range(_UNDISTORTION_STEPS):
        radial, tangential = _brown_conrady(found, distortion)
        found = (slope - tangential) / radial
    if not bool(fisheye.any()):
        return found
    return torch.where(fisheye[:, None], _from_equidistant(slope, distortion[:, :4]), found)


def distorted(slope: Tensor, distortion: Tensor, fisheye: Tensor) -> Tensor:
    """Where a lens shows points of the plane at depth 1. Shapes as of `undistorted`.

    Source: OpenCV's documentation of camera calibration: Brown-Conrady with the rational radial term, and the
    fisheye model of Kannala and Brandt.
    """
    radial, tangential = _brown_conrady(slope, distortion)
    bent = slope * radial + tangential
    radius = slope.norm(dim=1, keepdim=True)
    angle = radius.atan()
    scale = angle * _angle_factor(angle, distortion[:, :4]) / radius.clamp_min(1e-12)
    return torch.where(fisheye[:, None], torch.where(radius > 1e-8, slope * scale, slope), bent)


def _brown_conrady(slope: Tensor, distortion: Tensor) -> tuple[Tensor, Tensor]:
    """The radial factor (Q, 1) and the tangential shift (Q, 2)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = distortion.unbind(1)
    x, y = slope.unbind(1)
    r2 = x.square() + y.square()
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    shift_x = 2 * p1 * x * y + p2 * (r2 + 2 * x.square())
    shift_y = p1 * (r2 + 2 * y.square()) + 2 * p2 * x * y
    return radial[:, None], torch.stack([shift_x, shift_y], dim=1)


def _from_equidistant(slope: Tensor, coefficients: Tensor) -> Tensor:
    radius = slope.norm(dim=1, keepdim=True)
    angle = radius
    for _ in range(_UNDISTORTION_STEPS):
        angle = radius / _angle_factor(angle, coefficients)
    return torch.where(radius > 1e-8, slope * angle.clamp(max=1.57).tan() / radius.clamp_min(1e-12), slope)


def _angle_factor(angle: Tensor, coefficients: Tensor) -> Tensor:
    """1 + k1 a^2 + k2 a^4 + k3 a^6 + k4 a^8: (Q, 1)."""
    squared = angle.square()
    k1, k2, k3, k4 = coefficients.split(1, dim=1)
    return 1 + squared * (k1 + squared * (k2 + squared * (k3 + squared * k4)))


def _with_alpha(image: Tensor) -> Tensor:
    if image.shape[-1] == 4:
        return image
    return torch.cat([image, torch.full_like(image[..., :1], 255)], dim=-1)
