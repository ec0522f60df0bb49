"""Batches of cameras, and the world seen from one: eye, target, up, and turning on the spot."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from rendra.renderer.camera_base import CamerasBase
from rendra.transforms import Transform3d


def camera_to_eye_at_up(world_to_view_transform: Transform3d) -> tuple[Tensor, Tensor, Tensor]:
    """The arguments of `look_at_view_transform` that give these cameras.

    Args:
        world_to_view_transform: N rigid motions, as by `cameras.get_world_to_view_transform()`.

    Returns:
        eye, at and up, each (N, 3) in the world; `at` is one unit ahead of the eye, `up` has length 1.
    """
    view_to_world = world_to_view_transform.inverse().get_matrix()
    eye = view_to_world[:, 3, :3]
    return eye, eye + view_to_world[:, 2, :3], view_to_world[:, 1, :3]


def rotate_on_spot(R: Tensor, T: Tensor, rotation: Tensor) -> tuple[Tensor, Tensor]:
    """R (N, 3, 3) and T (N, 3) of cameras turned about their own centres.

    Args:
        R: (N, 3, 3) or (3, 3) as the cameras have it.
        T: (N, 3) or (3,).
        rotation: (N, 3, 3) or (3, 3), in the camera's own axes and for row vectors: what was seen in direction d
            (view space) before is seen in direction d · rotationᵀ afterwards.

    Raises:
        ValueError: for other shapes.
    """
    R, rotation = (matrix[None] if matrix.dim() == 2 else matrix for matrix in (R, rotation))
    T = T[None] if T.dim() == 1 else T
    for name, tensor, shape in (("R", R, (3, 3)), ("T", T, (3,)), ("rotation", rotation, (3, 3))):
        if tensor.dim() != 1 + len(shape) or tuple(tensor.shape[1:]) != shape:
            raise ValueError(f"Invalid {name}: expected (N, {str(shape)[1:-1]}); got {tuple(tensor.shape)}")
    turn = rotation.transpose(1, 2)
    # the centre -T Rᵀ stays: with R' = R turn, T' = T Rᵀ R turn
    return R @ turn, (T[:, None] @ turn)[:, 0]


def join_cameras_as_batch(cameras_list: Sequence[CamerasBase]) -> Any:
    """One batch of all cameras, in order.

    Args:
        cameras_list: cameras of one class on one device, of any batch sizes.

    Raises:
        ValueError: if the list is empty or holds something else; if classes, devices, or values that a batch
            shares (such as `in_ndc`) differ; if only some have an optional field (such as K or image_size).
    """
    if not cameras_list or not all(isinstance(camera, CamerasBase) for camera in cameras_list):
        raise ValueError("cameras in cameras_list must inherit from CamerasBase, and be one or more")
    first = cameras_list[0]
    if not all(type(camera) is type(first) for camera in cameras_list):
        names = sorted({type(camera).__name__ for camera in cameras_list})
        raise ValueError(f"all cameras must be of the same type; got {names}")
    if not all(camera.device == first.device for camera in cameras_list):
        raise ValueError("all cameras in the batch must be on the same device")
    fields = {name.lstrip("_"): _join_field(cameras_list, name) for name in first._FIELDS}
    return type(first)(**fields, device=first.device)


def _join_field(cameras_list: Sequence[CamerasBase], name: str) -> Any:
    """The joined value of one field."""
    values = [getattr(camera, name) for camera in cameras_list]
    if name in cameras_list[0]._SHARED_FIELDS:
        if any(value != values[0] for value in values):
            raise ValueError(f"Attribute {name} is not constant across inputs: {values}")
        return values[0]
    given = [value for value in values if value is not None]
    if given and len(given) < len(values):
        raise ValueError(f"Attribute {name} is given for some cameras and missing for others")
    return torch.cat(given, dim=0) if given else None
