"""Fisheye cameras with radial, tangential and thin-prism distortion.

The model of Project Aria's FisheyeRadTanThinPrism, after Kannala & Brandt, "A Generic Camera Model and Calibration
Method for Conventional, Wide-Angle, and Fish-Eye Lenses", PAMI 2006. For a view point at angle theta from the axis
    a = theta (x, y) / |(x, y)|                                            the angle vector
    d = a (1 + sum_i k_i theta^(2i)), i = 1 ... 6                          radial
    u = d + 2 (d · p) d + |d|² p + (s0 |d|² + s1 |d|⁴, s2 |d|² + s3 |d|⁴)  tangential and thin prism
    projected = focal_length u + principal_point
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.renderer.camera_base import DEFAULT_R, DEFAULT_T, CamerasBase

_NEWTON_STEPS = 10  # converges quadratically; real lenses need four or five


class FishEyeCameras(CamerasBase):
    """Fisheye cameras; what they project to is NDC, so focal length and principal point are in NDC.

    The angle is measured by atan2, so points behind the image plane (theta > 90 degrees) are projected too.

    Args:
        focal_length: (N, 1) or (N, 2).
        principal_point: (N, 2).
        radial_params: k, (N, 6).
        tangential_params: p, (N, 2).
        thin_prism_params: s, (N, 4).
        R: rotation (N, 3, 3), x_view = x_world R + T.
        T: translation (N, 3).
        world_coordinates: points to project are in the world; False: they are in view space already, and R and T
            are not used.
        use_radial: apply k.
        use_tangential: apply p.
        use_thin_prism: apply s.
        device: where the tensors go.
        image_size: (N, 2) as (H, W) in pixels, for `transform_points_screen`.
    """

    _FIELDS = (
        "focal_length",
        "principal_point",
        "radial_params",
        "tangential_params",
        "thin_prism_params",
        "R",
        "T",
        "world_coordinates",
        "use_radial",
        "use_tangential",
        "use_thin_prism",
        "image_size",
    )
    _SHARED_FIELDS = ("world_coordinates", "use_radial", "use_tangential", "use_thin_prism")
    focal_length: Tensor
    principal_point: Tensor
    radial_params: Tensor
    tangential_params: Tensor
    thin_prism_params: Tensor
    world_coordinates: bool
    use_radial: bool
    use_tangential: bool
    use_thin_prism: bool

    def __init__(
        self,
        focal_length: Any = ((1.0,),),
        principal_point: Any = ((0.0, 0.0),),
        radial_params: Any = ((0.0, 0.0, 0.0, 0.0, 0.0, 0.0),),
        tangential_params: Any = ((0.0, 0.0),),
        thin_prism_params: Any = ((0.0, 0.0, 0.0, 0.0),),
        R: Tensor = DEFAULT_R,
        T: Tensor = DEFAULT_T,
        world_coordinates: bool = False,
        use_radial: bool = True,
        use_tangential: bool = True,
        use_thin_prism: bool = True,
        device: Device = "cpu",
        image_size: Any = None,
    ) -> None:
        super().__init__(
            device=device,
            focal_length=focal_length,
            principal_point=principal_point,
            radial_params=radial_params,
            tangential_params=tangential_params,
            thin_prism_params=thin_prism_params,
            R=R,
            T=T,
            world_coordinates=world_coordinates,
            image_size=image_size,
            use_radial=use_radial,
            use_tangential=use_tangential,
            use_thin_prism=use_thin_prism,
        )
        if self.focal_length.dim() == 1:
            self.focal_length = self.focal_length[:, None]
        for name, last in (("radial_params", 6), ("tangential_params", 2), ("thin_prism_params", 4)):
            if getattr(self, name).shape[1:] != (last,):
                shape = tuple(getattr(self, name).shape)
                raise ValueError(f"Expected {name} of shape (N, {last}); got {shape}")

    def is_perspective(self) -> bool:
        """False: straight lines are bent, so nothing may be interpolated in perspective."""
        return False

    def in_ndc(self) -> bool:
        """True."""
        return True

    def transform_points(self, points: Tensor, eps: float | None = None, **kwargs: Any) -> Tensor:
        """Points to NDC.

        Args:
            points: (P, 3) or (N, P, 3), in the world or in view space as `world_coordinates` says.
            eps: not needed, ignored: nothing is divided by depth.
            **kwargs: R and T, used instead of the stored ones and kept.

        Returns:
            (N, P, 3), or (P, 3) for points of that shape and one camera: x, y, and view-space z.
        """
        if self.world_coordinates:
            view = self.get_world_to_view_transform(**kwargs).transform_points(points)
        else:
            view = points
        batch = view if view.dim() == 3 else view[None]
        distorted = self._distort(_angle_vector(batch))
        xy = self._rows("focal_length", batch) * distorted + self._rows("principal_point", batch)
        out = torch.cat((xy, batch[..., 2:].expand(*xy.shape[:2], 1)), dim=-1)
        return out[0] if points.dim() == 2 and out.shape[0] == 1 else out

    def unproject_points(
        self,
        xy_depth: Tensor,
        world_coordinates: bool = True,
        scaled_depth_input: bool = False,
        **kwargs: Any,
    ) -> Tensor:
        """Points of NDC positions and depths: the inverse of `transform_points`, by Newton's method.

        Gradients are those of the implicit function, exact whatever the number of steps.

        Args:
            xy_depth: (P, 3) or (N, P, 3): x, y in NDC, view-space z.
            world_coordinates: False returns view points even from a camera of world coordinates.
            scaled_depth_input: not meaningful here, must be False.
            **kwargs: R and T, used instead of the stored ones and kept.

        Returns:
            The points, shaped as by `transform_points`.

        Raises:
            ValueError: if `scaled_depth_input`.
        """
        if scaled_depth_input:
            raise ValueError("Fisheye cameras have no scaled depth; scaled_depth_input must be False")
        batch = xy_depth if xy_depth.dim() == 3 else xy_depth[None]
        target = (batch[..., :2] - self._rows("principal_point", batch)) / self._rows("focal_length", batch)
        slope = _tangent_vector(self._undistort(target))
        view = torch.cat((slope * batch[..., 2:], batch[..., 2:].expand(*slope.shape[:2], 1)), dim=-1)
        if world_coordinates and self.world_coordinates:
            view = self.get_world_to_view_transform(**kwargs).inverse().transform_points(view)
        return view[0] if xy_depth.dim() == 2 and view.shape[0] == 1 else view

    def _rows(self, name: str, like: Tensor) -> Tensor:
        """A parameter (N, C) as (N, 1, C) in the dtype of the points."""
        return getattr(self, name)[:, None].to(like.dtype)

    def _distort(self, angle: Tensor) -> Tensor:
        """Distorted u (N, P, 2) of angle vectors (N, P, 2)."""
        d = angle * self._stretch(angle)[0] if self.use_radial else angle
        out, t = d, d.square().sum(-1, keepdim=True)
        if self.use_tangential:
            p = self._rows("tangential_params", d)
            out = out + 2.0 * (d * p).sum(-1, keepdim=True) * d + t * p
        if self.use_thin_prism:
            s = self._rows("thin_prism_params", d)
            out = out + t * (s[..., 0::2] + t * s[..., 1::2])
        return out

    def _jacobian(self, angle: Tensor) -> Tensor:
        """du/da (N, P, 2, 2) at angle vectors (N, P, 2)."""
        eye = torch.eye(2, dtype=angle.dtype, device=angle.device)
        d, radial = angle, eye
        if self.use_radial:
            g, slope = self._stretch(angle)
            d = angle * g
            radial = g[..., None] * eye + 2.0 * slope[..., None] * angle[..., :, None] * angle[..., None, :]
        t, bend = d.square().sum(-1, keepdim=True), eye
        if self.use_tangential:
            p = self._rows("tangential_params", d)
            cross = d[..., :, None] * p[..., None, :]
            bend = bend + 2.0 * ((d * p).sum(-1)[..., None, None] * eye + cross + cross.transpose(-1, -2))
        if self.use_thin_prism:
            s = self._rows("thin_prism_params", d)
            bend = bend + ((2.0 * s[..., 0::2] + 4.0 * t * s[..., 1::2])[..., :, None] * d[..., None, :])
        return bend @ radial

    def _stretch(self, angle: Tensor) -> tuple[Tensor, Tensor]:
        """The factor g = 1 + sum_i k_i t^i and dg/dt, (N, P, 1) each, with t = theta²."""
        t = angle.square().sum(-1, keepdim=True)
        value, slope = torch.zeros_like(t), torch.zeros_like(t)
        for k in reversed(self._rows("radial_params", angle).split(1, dim=-1)):  # Horner, and its derivative
            slope = slope * t + value
            value = value * t + k
        return 1.0 + t * value, value + t * slope

    def _undistort(self, target: Tensor) -> Tensor:
        """The angle vectors (N, P, 2) whose `_distort` is `target`."""
        with torch.no_grad():
            angle = target
            for _ in range(_NEWTON_STEPS):
                angle = angle - _solve_2x2(self._jacobian(angle), self._distort(angle) - target)
            jacobian = self._jacobian(angle)
        # the residual is 0 by now: this last step only carries the implicit function's gradient
        return angle - _solve_2x2(jacobian, self._distort(angle) - target)


def _angle_vector(points: Tensor) -> Tensor:
    """Angle vectors theta (x, y) / |(x, y)| (..., 2) of view points (..., 3), with theta = atan2(|(x, y)|, z)."""
    xy, z = points[..., :2], points[..., 2:]
    squared = xy.square().sum(-1, keepdim=True)
    near = (squared < 1e-6 * z.square()) & (z > 0)  # on the axis: the ratio's series
    radius = torch.where(near, 1.0, squared).clamp(min=torch.finfo(xy.dtype).tiny).sqrt()
    depth = torch.where(near, z, 1.0)
    t = torch.where(near, squared, 0.0) / depth.square()
    return xy * torch.where(near, (1.0 + t * (-1 / 3 + t / 5)) / depth, torch.atan2(radius, z) / radius)


def _tangent_vector(angle: Tensor) -> Tensor:
    """tan(theta) a / theta = (x, y) / z (..., 2) of angle vectors a (..., 2) of length theta."""
    squared = angle.square().sum(-1, keepdim=True)
    near = squared < 1e-6
    theta = torch.where(near, 1.0, squared).sqrt()
    return angle * torch.where(near, 1.0 + squared * (1 / 3 + squared * (2 / 15)), theta.tan() / theta)


def _solve_2x2(matrix: Tensor, right: Tensor) -> Tensor:
    """Solutions (..., 2) of systems (..., 2, 2) by Cramer's rule."""
    (a, b), (c, d) = (row.unbind(-1) for row in matrix.unbind(-2))
    x, y = right.unbind(-1)
    return torch.stack((d * x - b * y, a * y - c * x), dim=-1) / (a * d - b * c)[..., None]
