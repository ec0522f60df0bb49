"""The base of all cameras: what follows once a projection is known, and the step between NDC and pixels.

The frames are those of `rendra.renderer.cameras`, which holds the cameras themselves.
"""

from __future__ import annotations

from numbers import Integral
from typing import Any, ClassVar, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.renderer.utils import TensorProperties
from rendra.transforms import Rigid, Transform3d
from rendra.transforms.se3 import affine_matrix

DEFAULT_R = torch.eye(3)[None]  # (1, 3, 3)
DEFAULT_T = torch.zeros(1, 3)

_Index: TypeAlias = int | list[int] | slice | Tensor


class CamerasBase(TensorProperties):
    """What every camera can do, once a subclass says how view space is projected.

    A camera whose projection is a 4x4 matrix defines `get_projection_transform` and `unproject_points`; one
    whose projection is not overrides `transform_points` instead of the former. Constructors take the names in
    `_FIELDS` (without a leading underscore) as keywords; `_SHARED_FIELDS` are one value for the whole batch.

    All methods take the camera's fields as keyword arguments, which then replace the stored ones for this
    call. R and T given so are also kept, since a renderer's shader asks the camera again after its
    rasteriser.
    """

    _FIELDS: ClassVar[tuple[str, ...]] = ()
    _SHARED_FIELDS: ClassVar[tuple[str, ...]] = ()
    R: Tensor  # (N, 3, 3)
    T: Tensor  # (N, 3)

    def __init__(self, device: Device = "cpu", **kwargs: Any) -> None:
        super().__init__(device=device, **kwargs)
        for name, default in (("R", DEFAULT_R), ("T", DEFAULT_T)):
            if kwargs.get(name) is default:  # `cameras.T += 1` must not move every other camera
                setattr(self, name, getattr(self, name).clone())

    def get_projection_transform(self, **kwargs: Any) -> Transform3d:
        """The transform from view space to the camera's projected space, if it has the form of a matrix."""
        raise NotImplementedError(f"{type(self).__name__} has no projection matrix")

    def unproject_points(self, xy_depth: Tensor, **kwargs: Any) -> Tensor:
        """Points in space of projected points with depth: the inverse of `transform_points`."""
        raise NotImplementedError(f"{type(self).__name__} cannot unproject")

    def is_perspective(self) -> bool:
        """Whether depth is divided by; the rasteriser then interpolates perspective-correctly."""
        raise NotImplementedError(f"{type(self).__name__} does not say whether it is perspective")

    def in_ndc(self) -> bool:
        """Whether the projected space is NDC; else it is in pixels, see `get_ndc_camera_transform`."""
        raise NotImplementedError(f"{type(self).__name__} does not say whether it is in NDC")

    def get_znear(self) -> Any:
        """The near plane's depth (N,), or None where the camera has none."""
        return getattr(self, "znear", None)

    def get_image_size(self) -> Any:
        """The image size (N, 2) as (H, W) in pixels, or None where the camera has none."""
        return getattr(self, "image_size", None)

    def get_world_to_view_transform(self, **kwargs: Any) -> Transform3d:
        """The transform x R + T from world to view space. R (N, 3, 3) and T (N, 3) may be given, and are kept."""
        return get_world_to_view_transform(*self._pose(**kwargs))

    def get_camera_center(self, **kwargs: Any) -> Tensor:
        """The cameras' positions in the world (N, 3), -T Rᵀ."""
        R, T = self._pose(**kwargs)
        return -(T[:, None] @ R.transpose(1, 2))[:, 0]

    def get_full_projection_transform(self, **kwargs: Any) -> Transform3d:
        """The transform from world to projected space, which is NDC only if `in_ndc` says so."""
        view = self.get_world_to_view_transform(**kwargs)
        return view.compose(self.get_projection_transform(**kwargs))

    def transform_points(self, points: Tensor, eps: float | None = None, **kwargs: Any) -> Tensor:
        """World points to projected space.

        Args:
            points: (P, 3) or (N, P, 3).
            eps: if given, the divisor's absolute value is clamped to at least this, its sign kept.
            **kwargs: fields to replace.

        Returns:
            (N, P, 3), or (P, 3) for points of that shape and one camera: x, y and the projected depth.
        """
        return self.get_full_projection_transform(**kwargs).transform_points(points, eps=eps)

    def get_ndc_camera_transform(self, **kwargs: Any) -> Transform3d:
        """The transform from projected space to NDC: the identity where `in_ndc`, by the image size elsewhere."""
        return Transform3d(device=self.device, dtype=self.R.dtype)

    def transform_points_ndc(self, points: Tensor, eps: float | None = None, **kwargs: Any) -> Tensor:
        """World points to NDC; arguments and shapes as `transform_points`, and `image_size` if not stored."""
        if self.in_ndc():
            return self.transform_points(points, eps, **kwargs)
        full = self.get_full_projection_transform(**kwargs)
        return full.compose(self.get_ndc_camera_transform(**kwargs)).transform_points(points, eps=eps)

    def transform_points_screen(
        self, points: Tensor, eps: float | None = None, with_xyflip: bool = True, **kwargs: Any
    ) -> Tensor:
        """World points to pixels, the centre of the upper-left pixel being (0.5, 0.5); depth as projected.

        Args:
            points: (P, 3) or (N, P, 3).
            eps: as in `transform_points`.
            with_xyflip: False keeps +X left and +Y up: minus the flipped coordinates.
            **kwargs: fields to replace; `image_size` ((H, W),) if the camera has none.

        Raises:
            ValueError: if there is no image size.
        """
        ndc = self.transform_points_ndc(points, eps, **kwargs)
        size = kwargs.get("image_size", self.get_image_size())
        to_screen = get_ndc_to_screen_transform(self, with_xyflip=with_xyflip, image_size=size)
        return to_screen.transform_points(ndc, eps=eps)

    def clone(self) -> Any:  # type: ignore[override]
        """A copy with tensors of its own; gradients flow through it."""
        return super().clone(type(self)(device=self.device))

    def __getitem__(self, index: _Index) -> Any:
        """The chosen cameras, by integer, list, slice, or tensor of integers or booleans, as a new batch.

        Raises:
            IndexError: if an index is out of bounds.
            ValueError: for another type, or a boolean tensor of another length.
        """
        chosen = self._check_index(index)
        fields: dict[str, Any] = {}
        for name in self._FIELDS:
            value: Any = getattr(self, name, None)
            batched = isinstance(value, Tensor) and name not in self._SHARED_FIELDS
            fields[name.lstrip("_")] = value[chosen] if batched else value
        return type(self)(**fields, device=self.device)

    def _check_index(self, index: _Index) -> list[int] | slice | Tensor:
        """The index in a form that keeps the batch dimension, checked against N."""
        n = len(self)
        if isinstance(index, slice):
            return index
        if isinstance(index, Tensor) and index.dtype == torch.bool:
            if index.shape != (n,):
                raise ValueError(f"Boolean index of shape {tuple(index.shape)} does not match cameras: {n}")
            return index
        if isinstance(index, Tensor) and not index.is_floating_point() and index.dim() <= 1:
            index, values = index.reshape(-1), index.reshape(-1).tolist()
        elif isinstance(index, Integral):
            index = values = [int(index)]
        elif isinstance(index, list) and all(isinstance(i, Integral) for i in index):
            values = index
        else:
            expected = "int, list of int, slice, or tensor of bool or integers"
            raise ValueError(f"Invalid index type, expected {expected}; got {type(index)}")
        if any(not -n <= i < n for i in values):
            raise IndexError(f"Index {values} is out of bounds for {n} cameras")
        return index

    def _pose(self, **kwargs: Any) -> tuple[Tensor, Tensor]:
        """R and T, from `kwargs` if given there and then kept. Kept plainly: a parameter stays its owner's."""
        for name in ("R", "T"):
            if name in kwargs:
                self.__dict__[name] = kwargs[name]
        return self.R, self.T


def get_world_to_view_transform(R: Tensor = DEFAULT_R, T: Tensor = DEFAULT_T) -> Transform3d:
    """The transform x R + T (row vectors) of rotations (N, 3, 3) and translations (N, 3).

    Raises:
        ValueError: for other shapes, or batches that are neither equal nor 1.
    """
    if R.dim() != 3 or R.shape[1:] != (3, 3):
        raise ValueError(f"Expected R to have shape (N, 3, 3); got {tuple(R.shape)}")
    if T.dim() != 2 or T.shape[1] != 3:
        raise ValueError(f"Expected T to have shape (N, 3); got {tuple(T.shape)}")
    if R.shape[0] != T.shape[0] and 1 not in (R.shape[0], T.shape[0]):
        raise ValueError(f"Expected R, T to have same batch dimension; got {R.shape[0]}, {T.shape[0]}")
    return Rigid(R, T)


def get_ndc_to_screen_transform(
    cameras: CamerasBase, with_xyflip: bool = False, image_size: Any = None
) -> Transform3d:
    """The transform from NDC to screen pixels; depth unchanged.

    Args:
        cameras: say the device.
        with_xyflip: turn +X right and +Y down, as pixels have it; False gives minus those coordinates.
        image_size: (H, W), ((H, W),) or (N, 2).

    Raises:
        ValueError: if the image size is missing or not of that form.
    """
    size = image_size_wh(cameras, image_size)
    scale = 0.5 * size.amin(-1, keepdim=True).expand(-1, 2)
    return scale_and_shift(-scale, 0.5 * size) if with_xyflip else scale_and_shift(scale, -0.5 * size)


def get_screen_to_ndc_transform(
    cameras: CamerasBase, with_xyflip: bool = False, image_size: Any = None
) -> Transform3d:
    """The inverse of `get_ndc_to_screen_transform`, with its arguments."""
    size = image_size_wh(cameras, image_size)
    scale = 2.0 / size.amin(-1, keepdim=True).expand(-1, 2)
    return scale_and_shift(-scale if with_xyflip else scale, 0.5 * scale * size)


def try_get_projection_transform(cameras: CamerasBase, cameras_kwargs: dict[str, Any]) -> Transform3d | None:
    """The projection transform, or None if the camera's projection is not a matrix (fisheye)."""
    try:
        return cameras.get_projection_transform(**cameras_kwargs)
    except NotImplementedError:
        return None


def cameras_for_call(cameras: Any, kwargs: dict[str, Any], owner: str) -> Any:
    """The cameras of one call: those in `kwargs`, else `cameras`; at the pose R, T of `kwargs` where given.

    Raises:
        ValueError: there are none.
    """
    chosen = kwargs.get("cameras", cameras)
    if chosen is None:
        raise ValueError(f"Cameras must be specified either at initialization or in the forward pass of {owner}")
    pose = {name: kwargs[name] for name in ("R", "T") if name in kwargs}
    if pose:
        chosen.get_world_to_view_transform(**pose)  # cameras keep the pose that they are given
    return chosen


def ndc_and_view_depth(cameras: Any, points_world: Tensor, kwargs: dict[str, Any]) -> Tensor:
    """What rasterisers draw: x and y of points (N, P, 3) in NDC, and their depth in view space.

    Args:
        cameras: one, or N.
        points_world: (N, P, 3).
        kwargs: `eps` of the division by depth, and fields of the cameras for this call.
    """
    eps = kwargs.get("eps")
    points_view = cameras.get_world_to_view_transform(**kwargs).transform_points(points_world, eps=eps)
    to_ndc = cameras.get_ndc_camera_transform(**kwargs)
    projection = try_get_projection_transform(cameras, kwargs)
    if projection is not None:
        points_ndc = projection.compose(to_ndc).transform_points(points_view, eps=eps)
    else:  # a camera without a matrix projects from the world
        points_ndc = to_ndc.transform_points(cameras.transform_points(points_world, eps=eps), eps=eps)
    return torch.cat((points_ndc[..., :2], points_view[..., 2:]), dim=-1)


def scale_and_shift(scale: Tensor, shift: Tensor) -> Transform3d:
    """The transform of x and y alone by scale and shift (N, 2)."""
    diagonal = torch.diag_embed(F.pad(scale, (0, 1), value=1.0))
    return Transform3d(matrix=affine_matrix(diagonal, F.pad(shift, (0, 1))))


def image_size_wh(cameras: CamerasBase, image_size: Any) -> Tensor:
    """An image size (H, W), in any accepted form, as (N, 2) floating-point (W, H) on the camera's device."""
    if image_size is None:
        raise ValueError("For NDC to screen conversion, image_size=(height, width) needs to be specified.")
    size = torch.as_tensor(image_size, device=cameras.device)
    if size.dim() not in (1, 2) or size.shape[-1] != 2:
        raise ValueError(f"Expected image_size (height, width) or of shape (N, 2); got {tuple(size.shape)}")
    if not isinstance(image_size, Tensor) and (size < 1).any():
        raise ValueError(f"image_size provided has invalid values: {image_size}")
    return size.view(-1, 2).to(cameras.R.dtype).flip(-1)
