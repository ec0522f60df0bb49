"""The similarity of the world that brings one set of cameras onto another.

Letters: N cameras. Row vectors: a world point x is at x R + T before a camera, whose centre is -T R^T.
"""

from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from rendra.ops.matrix_factors import nearest_rotation
from rendra.ops.points_alignment import SimilarityTransform, corresponding_points_alignment


class _Cameras(Protocol):
    """What is asked of cameras: rotations (N, 3, 3) and translations (N, 3), their centres, and a copy."""

    R: Tensor
    T: Tensor

    def get_camera_center(self) -> Tensor: ...
    def clone(self) -> Any: ...


CamerasT = TypeVar("CamerasT", bound=_Cameras)


def corresponding_cameras_alignment(
    cameras_src: CamerasT,
    cameras_tgt: _Cameras,
    estimate_scale: bool = True,
    mode: str = "extrinsics",
    eps: float = 1e-9,
) -> CamerasT:
    """
    Turn, shift and scale the world of one set of cameras such that they stand where others stand.

    Args:
        cameras_src: N cameras to be moved, by one similarity for all.
        cameras_tgt: N cameras; camera i belongs to camera i of `cameras_src`.
        estimate_scale: also scale the world.
        mode: "extrinsics" turns by what the cameras' orientations agree on best, which also one camera, or several
            on a line, decide; "centers" by their centres alone (Umeyama).
        eps: the smallest variance of the centres to divide by.

    Returns:
        A copy of `cameras_src` with other R and T.

    Raises:
        ValueError: another mode, or different numbers of cameras.
    """
    if len(cameras_src.R) != len(cameras_tgt.R):
        raise ValueError(
            "cameras_src and cameras_tgt have to contain the same number of cameras, got "
            f"{len(cameras_src.R)} and {len(cameras_tgt.R)}"
        )
    centers = cameras_src.get_camera_center(), cameras_tgt.get_camera_center()  # (N, 3)
    if mode == "centers":
        world = corresponding_points_alignment(centers[0][None], centers[1][None], None, estimate_scale, False, eps)
    elif mode == "extrinsics":
        rotation, _ = nearest_rotation((cameras_src.R @ cameras_tgt.R.mT).sum(0, keepdim=True))
        world = _with_rotation(rotation, *centers, estimate_scale, eps)
    else:
        raise ValueError(f'mode has to be one of "centers" and "extrinsics", got {mode!r}')
    aligned: CamerasT = cameras_src.clone()
    aligned.R = world.R.mT @ cameras_src.R
    aligned.T = world.s[:, None] * cameras_src.T - (world.T[:, None] @ aligned.R)[:, 0]
    return aligned


def _with_rotation(rotation: Tensor, X: Tensor, Y: Tensor, estimate_scale: bool, eps: float) -> SimilarityTransform:
    """The shift and scale that, after the rotation (1, 3, 3), bring points X (N, 3) nearest to Y."""
    turned = X @ rotation[0]
    centred = turned - turned.mean(0)
    s = torch.ones_like(turned[:1, 0])
    if estimate_scale and len(X) > 1:
        s = ((centred * Y).sum() / centred.square().sum().clamp(min=eps)).clamp(min=eps).view(1)
    return SimilarityTransform(rotation, (Y.mean(0) - s * turned.mean(0))[None], s)
