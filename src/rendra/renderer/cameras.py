"""Cameras: world to view to NDC to screen, and back.

Frames (N cameras, P points, row vectors; a batch of 1 broadcasts):
    view    x_view = x_world R + T; +X left, +Y up, +Z into the scene.
    NDC     same axes; the short side of the image spans [-1, 1], the long side [-u, u] with u = long / short.
    screen  pixels; +X right, +Y down, the origin at the upper-left CORNER of the upper-left pixel, whose
    centre is therefore (0.5, 0.5). x_screen = W/2 - s x_ndc, y_screen = H/2 - s y_ndc with s = min(H, W) / 2.
`K` (N, 4, 4) acts on column vectors, [x, y, z, 1] in view space to homogeneous NDC (or the camera's own
units).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.renderer.camera_base import DEFAULT_R as _R
from rendra.renderer.camera_base import DEFAULT_T as _T
from rendra.renderer.camera_base import (
    CamerasBase,
    get_ndc_to_screen_transform,
    get_screen_to_ndc_transform,
    get_world_to_view_transform,
    image_size_wh,
    scale_and_shift,
    try_get_projection_transform,
)
from rendra.renderer.utils import convert_to_tensors_and_broadcast, format_tensor
from rendra.transforms import Transform3d
from rendra.transforms.se3 import affine_matrix

__all__ = [
    "CamerasBase",
    "FoVOrthographicCameras",
    "FoVPerspectiveCameras",
    "OpenGLOrthographicCameras",
    "OpenGLPerspectiveCameras",
    "OrthographicCameras",
    "PerspectiveCameras",
    "SfMOrthographicCameras",
    "SfMPerspectiveCameras",
    "camera_position_from_spherical_angles",
    "get_ndc_to_screen_transform",
    "get_screen_to_ndc_transform",
    "get_world_to_view_transform",
    "look_at_rotation",
    "look_at_view_transform",
    "try_get_projection_transform",
]


class _MatrixCameras(CamerasBase):
    """Cameras whose projection is a matrix: the hole is `_calibration`, everything else follows from it."""

    K: Tensor | None  # (N, 4, 4)

    def _calibration(self, **kwargs: Any) -> Tensor:
        """K (N, 4, 4) of the camera's parameters."""
        raise NotImplementedError

    def get_projection_transform(self, **kwargs: Any) -> Transform3d:
        """The transform from view to projected space, by `K` if there is one, else by the parameters.

        Raises:
            ValueError: if `K` is not (N, 4, 4).
        """
        return Transform3d(matrix=self._projection(**kwargs).transpose(1, 2))

    def _projection(self, **kwargs: Any) -> Tensor:
        """K (N, 4, 4), given or made."""
        K = kwargs.get("K", self.K)
        if K is None:
            return self._calibration(**kwargs)
        if K.dim() != 3 or K.shape[1:] != (4, 4) or K.shape[0] not in (1, self._N):
            raise ValueError(f"Expected K to have shape of ({self._N}, 4, 4); got {tuple(K.shape)}")
        return K

    def _unproject(
        self, xy_depth: Tensor, world: bool, from_ndc: bool = False, scaled_depth: bool = False, **kwargs: Any
    ) -> Tensor:
        """World or view points of (x, y, depth), (P, 3) or (N, P, 3); see the public methods."""
        K = self._projection(**kwargs).to(xy_depth.dtype)
        batch = xy_depth if xy_depth.dim() == 3 else xy_depth[None]
        xy, z = batch[..., :2], batch[..., 2:]
        if scaled_depth:  # invert z' = (K22 z + K23) / (K32 z + K33)
            z = (K[:, None, 2:3, 3] - z * K[:, None, 3:, 3]) / (z * K[:, None, 3:, 2] - K[:, None, 2:3, 2])
        if from_ndc and not self.in_ndc():
            scale, shift = self._pixels_to_ndc(K, **kwargs)
            xy = (xy - shift[:, None]) / scale[:, None]
        view = _perspective_rays(K, xy, z) if self.is_perspective() else _parallel_rays(K, xy, z)
        if world:
            view = self.get_world_to_view_transform(**kwargs).inverse().transform_points(view)
        return view[0] if xy_depth.dim() == 2 and view.shape[0] == 1 else view

    def _pixels_to_ndc(self, K: Tensor, **kwargs: Any) -> tuple[Tensor, Tensor]:
        """Scale and shift (N, 2) from a screen camera's projected x, y to NDC: ndc = scale x + shift.

        The projection q = f x/z + p has x to the left but p counted from the image's left side, so the pixel
        is p - f x/z = 2p - q.
        """
        size = image_size_wh(self, kwargs.get("image_size", self.get_image_size())).to(K.dtype)
        principal = K[:, :2, 2 if self.is_perspective() else 3]
        scale = 2.0 / size.amin(-1, keepdim=True)
        return scale.expand(-1, 2), scale * (0.5 * size - 2.0 * principal)


class _FoVCameras(_MatrixCameras):
    """Cameras that are described by their viewing volume, in NDC."""

    def in_ndc(self) -> bool:
        """True."""
        return True

    def unproject_points(
        self, xy_depth: Tensor, world_coordinates: bool = True, scaled_depth_input: bool = False, **kwargs: Any
    ) -> Tensor:
        """Points of NDC positions and depths.

        Args:
            xy_depth: (P, 3) or (N, P, 3): x and y in NDC, and depth.
            world_coordinates: return world points; False: view points.
            scaled_depth_input: depth is the projected one, in [0, 1] from near to far; False: view-space z.
            **kwargs: fields to replace.

        Returns:
            The points, shaped as by `transform_points`.
        """
        kwargs.pop("from_ndc", None)  # these cameras know nothing else
        return self._unproject(xy_depth, world_coordinates, scaled_depth=scaled_depth_input, **kwargs)


class FoVPerspectiveCameras(_FoVCameras):
    """Pinhole cameras described by a field of view; projected depth is 0 at znear and 1 at zfar.

    Args:
        znear: near plane, (N,) or number.
        zfar: far plane.
        aspect_ratio: width over height of a PIXEL's footprint; the image's own ratio is accounted for by NDC.
        fov: the angle that the image's short side spans.
        degrees: fov's unit; False: radians.
        R: rotation (N, 3, 3), x_view = x_world R + T.
        T: translation (N, 3).
        K: (N, 4, 4), used instead of the numbers above.
        device: where the tensors go.
    """

    _FIELDS = ("K", "znear", "zfar", "aspect_ratio", "fov", "R", "T", "degrees")
    _SHARED_FIELDS = ("degrees",)

    def __init__(
        self,
        znear: Any = 1.0,
        zfar: Any = 100.0,
        aspect_ratio: Any = 1.0,
        fov: Any = 60.0,
        degrees: bool = True,
        R: Tensor = _R,
        T: Tensor = _T,
        K: Tensor | None = None,
        device: Device = "cpu",
    ) -> None:
        super().__init__(device=device, znear=znear, zfar=zfar, aspect_ratio=aspect_ratio, fov=fov, R=R, T=T, K=K)
        self.degrees = degrees

    def compute_projection_matrix(self, znear: Any, zfar: Any, fov: Any, aspect_ratio: Any, degrees: bool) -> Tensor:
        """K (N, 4, 4) of numbers or (N,) tensors: x' = s x/aspect, y' = s y, z' = f (z - n)/(f - n), w = z.

        s = 1 / tan(fov / 2).
        """
        near, far, fov, aspect = _columns(self, znear, zfar, fov, aspect_ratio)
        sy = torch.tan(fov * (math.pi / 360.0 if degrees else 0.5)).reciprocal()
        sx = sy / aspect
        depth = far / (far - near)
        zero, one = torch.zeros_like(sy), torch.ones_like(sy)
        entries = (sx, zero, zero, zero, zero, sy, zero, zero, zero, zero, depth, -depth * near, zero, zero)
        return torch.stack((*entries, one, zero), dim=-1).view(-1, 4, 4)

    def _calibration(self, **kwargs: Any) -> Tensor:
        names = ("znear", "zfar", "fov", "aspect_ratio", "degrees")
        return self.compute_projection_matrix(*(kwargs.get(name, getattr(self, name)) for name in names))

    def is_perspective(self) -> bool:
        """True."""
        return True


class FoVOrthographicCameras(_FoVCameras):
    """Parallel-projection cameras described by a box in view space; depth is 0 at znear and 1 at zfar.

    Args:
        znear: near plane, (N,) or number.
        zfar: far plane.
        max_y: the box's bounds in view space, which map to -1 and 1 in NDC.
        min_y: see max_y.
        max_x: see max_y.
        min_x: see max_y.
        scale_xyz: (N, 3), further factors of the axes.
        R: rotation (N, 3, 3), x_view = x_world R + T.
        T: translation (N, 3).
        K: (N, 4, 4), used instead of the numbers above.
        device: where the tensors go.
    """

    _FIELDS = ("K", "znear", "zfar", "R", "T", "max_y", "min_y", "max_x", "min_x", "scale_xyz")

    def __init__(
        self,
        znear: Any = 1.0,
        zfar: Any = 100.0,
        max_y: Any = 1.0,
        min_y: Any = -1.0,
        max_x: Any = 1.0,
        min_x: Any = -1.0,
        scale_xyz: Any = ((1.0, 1.0, 1.0),),
        R: Tensor = _R,
        T: Tensor = _T,
        K: Tensor | None = None,
        device: Device = "cpu",
    ) -> None:
        box = {"max_y": max_y, "min_y": min_y, "max_x": max_x, "min_x": min_x, "scale_xyz": scale_xyz}
        super().__init__(device=device, znear=znear, zfar=zfar, R=R, T=T, K=K, **box)

    def compute_projection_matrix(
        self, znear: Any, zfar: Any, max_x: Any, min_x: Any, max_y: Any, min_y: Any, scale_xyz: Any
    ) -> Tensor:
        """K (N, 4, 4) of numbers or tensors: the box to [-1, 1]² x [0, 1].

        As PyTorch3D has it, `scale_xyz` multiplies the factors and leaves the shifts alone.
        """
        near, far, right, left, top, bottom, scale = _columns(
            self, znear, zfar, max_x, min_x, max_y, min_y, scale_xyz
        )
        factor = torch.stack((2.0 / (right - left), 2.0 / (top - bottom), 1.0 / (far - near)), dim=-1)
        middle = torch.stack((0.5 * (right + left), 0.5 * (top + bottom), near), dim=-1)
        return affine_matrix(torch.diag_embed(factor * scale), -factor * middle).transpose(1, 2)

    def _calibration(self, **kwargs: Any) -> Tensor:
        names = ("znear", "zfar", "max_x", "min_x", "max_y", "min_y", "scale_xyz")
        return self.compute_projection_matrix(*(kwargs.get(name, getattr(self, name)) for name in names))

    def is_perspective(self) -> bool:
        """False."""
        return False


class _FocalCameras(_MatrixCameras):
    """Cameras that are described by focal length and principal point, in NDC or in pixels."""

    _FIELDS = ("K", "R", "T", "focal_length", "principal_point", "_in_ndc", "image_size")
    _SHARED_FIELDS = ("_in_ndc",)
    focal_length: Tensor  # (N, 2)
    principal_point: Tensor  # (N, 2)
    image_size: Tensor | None  # (N, 2)
    _in_ndc: bool

    def __init__(
        self,
        focal_length: Any = 1.0,
        principal_point: Any = ((0.0, 0.0),),
        R: Tensor = _R,
        T: Tensor = _T,
        K: Tensor | None = None,
        device: Device = "cpu",
        in_ndc: bool = True,
        image_size: Any = None,
    ) -> None:
        if image_size is None and not in_ndc:
            raise ValueError("image_size (H, W) must be given for cameras in screen space (in_ndc=False)")
        given = {"focal_length": focal_length, "principal_point": principal_point, "image_size": image_size}
        super().__init__(device=device, R=R, T=T, K=K, _in_ndc=in_ndc, **given)
        if self.image_size is not None and (self.image_size < 1).any():
            raise ValueError(f"image_size provided has invalid values: {self.image_size.tolist()}")
        if self.focal_length.dim() == 1:
            self.focal_length = self.focal_length[:, None]
        self.focal_length = self.focal_length.expand(-1, 2)

    def in_ndc(self) -> bool:
        """Whether focal length and principal point are in NDC; else in pixels."""
        return self._in_ndc

    def get_principal_point(self, **kwargs: Any) -> Tensor:
        """The principal point (N, 2) in the camera's units, read from K if there is one."""
        return self._projection(**kwargs)[:, :2, 2 if self.is_perspective() else 3]

    def get_ndc_camera_transform(self, **kwargs: Any) -> Transform3d:
        """The transform from projected space to NDC: the identity where `in_ndc`, by the image size
        elsewhere.

        Raises:
            ValueError: if there is no image size.
        """
        if self._in_ndc:
            return super().get_ndc_camera_transform(**kwargs)
        return scale_and_shift(*self._pixels_to_ndc(self._projection(**kwargs), **kwargs))

    def unproject_points(
        self, xy_depth: Tensor, world_coordinates: bool = True, from_ndc: bool = False, **kwargs: Any
    ) -> Tensor:
        """Points of projected positions and depths.

        Args:
            xy_depth: (P, 3) or (N, P, 3): x and y as by `transform_points`, and view-space z.
            world_coordinates: return world points; False: view points.
            from_ndc: x and y are in NDC, whatever the camera's own units.
            **kwargs: fields to replace.

        Returns:
            The points, shaped as by `transform_points`.
        """
        return self._unproject(xy_depth, world_coordinates, from_ndc=from_ndc, **kwargs)

    def _intrinsics(self, **kwargs: Any) -> tuple[Tensor, ...]:
        """fx, fy, px, py, 0 and 1, each (N,)."""
        focal = format_tensor(kwargs.get("focal_length", self.focal_length), device=self.device)
        principal = format_tensor(kwargs.get("principal_point", self.principal_point), device=self.device)
        focal = (focal if focal.dim() > 1 else focal[:, None]).expand(-1, 2)
        focal, principal = torch.broadcast_tensors(focal, principal)
        fx, fy = focal.unbind(-1)
        return fx, fy, *principal.unbind(-1), torch.zeros_like(fx), torch.ones_like(fx)


class PerspectiveCameras(_FocalCameras):
    """Pinhole cameras: x' = fx x/z + px, y' = fy y/z + py, and projected depth 1/z.

    In pixels (in_ndc=False) the focal length is fx, fy > 0 and the principal point is measured like screen
    points, from the upper-left corner; what `transform_points` then gives is in pixels with x to the left,
    mirrored at the principal point. Use `transform_points_screen` for pixels.

    Args:
        focal_length: number, (N,), (N, 1) or (N, 2), in NDC or pixels.
        principal_point: (N, 2), in NDC or pixels.
        R: rotation (N, 3, 3), x_view = x_world R + T.
        T: translation (N, 3).
        K: (N, 4, 4), used instead of focal length and principal point.
        device: where the tensors go.
        in_ndc: the unit of focal length, principal point and K; False: pixels.
        image_size: (N, 2) as (H, W) in pixels; needed if not in NDC, and for `transform_points_screen`.

    Raises:
        ValueError: if not in NDC and without an image size, or for a size below 1.
    """

    def _calibration(self, **kwargs: Any) -> Tensor:
        fx, fy, px, py, zero, one = self._intrinsics(**kwargs)
        entries = (fx, zero, px, zero, zero, fy, py, zero, zero, zero, zero, one, zero, zero, one, zero)
        return torch.stack(entries, dim=-1).view(-1, 4, 4)

    def is_perspective(self) -> bool:
        """True."""
        return True


class OrthographicCameras(_FocalCameras):
    """Parallel-projection cameras: x' = fx x + px, y' = fy y + py; depth stays view-space z.

    Arguments and errors as `PerspectiveCameras`; the focal length is NDC units (or pixels) per unit of the
    scene.
    """

    def _calibration(self, **kwargs: Any) -> Tensor:
        fx, fy, px, py, zero, one = self._intrinsics(**kwargs)
        entries = (fx, zero, zero, px, zero, fy, zero, py, zero, zero, one, zero, zero, zero, zero, one)
        return torch.stack(entries, dim=-1).view(-1, 4, 4)

    def is_perspective(self) -> bool:
        """False."""
        return False


def OpenGLPerspectiveCameras(
    znear: Any = 1.0,
    zfar: Any = 100.0,
    aspect_ratio: Any = 1.0,
    fov: Any = 60.0,
    degrees: bool = True,
    R: Tensor = _R,
    T: Tensor = _T,
    device: Device = "cpu",
) -> FoVPerspectiveCameras:
    """The old name of `FoVPerspectiveCameras`."""
    _warn_renamed("OpenGLPerspectiveCameras", "FoVPerspectiveCameras")
    return FoVPerspectiveCameras(znear, zfar, aspect_ratio, fov, degrees, R, T, device=device)


def OpenGLOrthographicCameras(
    znear: Any = 1.0,
    zfar: Any = 100.0,
    top: Any = 1.0,
    bottom: Any = -1.0,
    left: Any = -1.0,
    right: Any = 1.0,
    scale_xyz: Any = ((1.0, 1.0, 1.0),),
    R: Tensor = _R,
    T: Tensor = _T,
    device: Device = "cpu",
) -> FoVOrthographicCameras:
    """The old name of `FoVOrthographicCameras`."""
    _warn_renamed("OpenGLOrthographicCameras", "FoVOrthographicCameras")
    return FoVOrthographicCameras(znear, zfar, top, bottom, right, left, scale_xyz, R, T, device=device)


def SfMPerspectiveCameras(
    focal_length: Any = 1.0,
    principal_point: Any = ((0.0, 0.0),),
    R: Tensor = _R,
    T: Tensor = _T,
    device: Device = "cpu",
) -> PerspectiveCameras:
    """The old name of `PerspectiveCameras`."""
    _warn_renamed("SfMPerspectiveCameras", "PerspectiveCameras")
    return PerspectiveCameras(focal_length, principal_point, R, T, device=device)


def SfMOrthographicCameras(
    focal_length: Any = 1.0,
    principal_point: Any = ((0.0, 0.0),),
    R: Tensor = _R,
    T: Tensor = _T,
    device: Device = "cpu",
) -> OrthographicCameras:
    """The old name of `OrthographicCameras`."""
    _warn_renamed("SfMOrthographicCameras", "OrthographicCameras")
    return OrthographicCameras(focal_length, principal_point, R, T, device=device)


def camera_position_from_spherical_angles(
    distance: Any, elevation: Any, azimuth: Any, degrees: bool = True, device: Device = "cpu"
) -> Tensor:
    """Positions (N, 3) on spheres around the origin: d (cos e sin a, sin e, cos e cos a).

    Args:
        distance: number or (N,), as the others.
        elevation: angle above the xz plane.
        azimuth: angle from +Z towards +X.
        degrees: the angles' unit; False: radians.
        device: where the result lies.
    """
    d, e, a = convert_to_tensors_and_broadcast(distance, elevation, azimuth, device=device)
    if degrees:
        e, a = e * (math.pi / 180.0), a * (math.pi / 180.0)
    flat = d * e.cos()
    return torch.stack((flat * a.sin(), d * e.sin(), flat * a.cos()), dim=-1)


def look_at_rotation(
    camera_position: Any, at: Any = ((0, 0, 0),), up: Any = ((0, 1, 0),), device: Device = "cpu"
) -> Tensor:
    """Rotations (N, 3, 3) of cameras that look from a position to a point.

    The columns are the camera's axes in the world: z towards `at`, x = up × z to the left, y = z × x. Where
    the view runs along `up`, some level x is taken instead, so the result is a rotation there too.

    Args:
        camera_position: (N, 3) or (1, 3), as the others; must differ from `at`.
        at: the point looked at.
        up: the direction that is up in the image.
        device: where the result lies.
    """
    position, at, up = convert_to_tensors_and_broadcast(camera_position, at, up, device=device)
    z = F.normalize(at - position, dim=-1, eps=1e-12)
    x = torch.linalg.cross(up.to(z.dtype), z)
    squared = x.square().sum(-1, keepdim=True)
    along = squared < 1e-20
    other = F.one_hot(z.abs().argmin(-1), 3).to(z.dtype)  # the world axis farthest from the view
    x = torch.where(along, torch.linalg.cross(other, z), x)
    x = F.normalize(x, dim=-1, eps=1e-12)
    return torch.stack((x, torch.linalg.cross(z, x), z), dim=-1)


def look_at_view_transform(
    dist: Any = 1.0,
    elev: Any = 0.0,
    azim: Any = 0.0,
    degrees: bool = True,
    eye: Any = None,
    at: Any = ((0, 0, 0),),
    up: Any = ((0, 1, 0),),
    device: Device = "cpu",
) -> tuple[Tensor, Tensor]:
    """R (N, 3, 3) and T (N, 3) of cameras that look at a point, for the cameras' arguments of these names.

    Args:
        dist: distance from `at`; number or (N,), as the angles.
        elev: angle above the xz plane.
        azim: angle from +Z towards +X.
        degrees: the angles' unit; False: radians.
        eye: positions (N, 3) in the world, used instead of the three numbers.
        at: points looked at, (N, 3) or (1, 3).
        up: directions that are up in the images, likewise.
        device: where the results lie.
    """
    if eye is None:
        offset = camera_position_from_spherical_angles(dist, elev, azim, degrees=degrees, device=device)
        at = format_tensor(at, device=device)
        eye = offset + at
    position, at, up = convert_to_tensors_and_broadcast(eye, at, up, device=device)
    R = look_at_rotation(position, at, up, device=device)
    return R, -(position[:, None].to(R.dtype) @ R)[:, 0]


def _perspective_rays(K: Tensor, xy: Tensor, z: Tensor) -> Tensor:
    """View points (N, P, 3) at depth z of projected x, y, for any K (N, 4, 4) whose w varies over space.

    With P the rows of x, y and w: P X + k = w (x, y, 1), so X = w P⁻¹(x, y, 1) - P⁻¹k, and z gives w.
    """
    rows = torch.cat((K[:, :2], K[:, 3:]), dim=1)
    inverse = torch.linalg.inv_ex(rows[..., :3])[0].transpose(1, 2)
    direction = F.pad(xy, (0, 1), value=1.0) @ inverse
    origin = rows[..., 3][:, None] @ inverse
    return direction * ((z + origin[..., 2:]) / direction[..., 2:]) - origin


def _parallel_rays(K: Tensor, xy: Tensor, z: Tensor) -> Tensor:
    """View points (N, P, 3) at depth z of projected x, y, for a K (N, 4, 4) of constant w."""
    inverse = torch.linalg.inv_ex(K[:, :2, :2])[0].transpose(1, 2)
    rest = xy * K[:, None, 3:, 3] - z * K[:, None, :2, 2] - K[:, None, :2, 3]
    return torch.cat((rest @ inverse, z.expand(*rest.shape[:2], 1)), dim=-1)


def _columns(cameras: CamerasBase, *values: Any) -> Sequence[Tensor]:
    """Numbers or tensors as tensors of one batch size on the camera's device, as precise as its pose."""
    made = convert_to_tensors_and_broadcast(*values, device=cameras.device)
    return [value.to(torch.promote_types(value.dtype, cameras.R.dtype)) for value in made]


def _warn_renamed(old: str, new: str) -> None:
    """The deprecation warning of the four old names, at the caller's caller."""
    warnings.warn(f"{old} is deprecated, use {new} instead.", PendingDeprecationWarning, stacklevel=3)
