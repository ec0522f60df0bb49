"""Cameras moved by a known similarity are brought back."""

import pytest
import torch
from assertions import assert_close

from rendra.ops import corresponding_cameras_alignment
from rendra.renderer import PerspectiveCameras
from rendra.transforms import random_rotations


def moved_pair(count: int, scale: float) -> tuple[PerspectiveCameras, PerspectiveCameras]:
    """Cameras, and the same in a world where x is at scale x R + T."""
    torch.manual_seed(0)
    src = PerspectiveCameras(R=random_rotations(count), T=torch.randn(count, 3), focal_length=2.0)
    R, T = random_rotations(1)[0], torch.randn(3)
    turned = R.T @ src.R
    return src, PerspectiveCameras(R=turned, T=scale * src.T - T @ turned, focal_length=3.0)


@pytest.mark.parametrize("mode", ["extrinsics", "centers"])
@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_similarity_is_undone(mode, scale):
    src, tgt = moved_pair(6, scale)
    before = src.R.clone(), src.T.clone()
    aligned = corresponding_cameras_alignment(src, tgt, estimate_scale=scale != 1.0, mode=mode)
    assert_close(aligned.R, tgt.R, atol=2e-5)
    assert_close(aligned.T, tgt.T, atol=5e-5)
    assert_close(aligned.get_camera_center(), tgt.get_camera_center(), atol=5e-5)
    assert (aligned.focal_length == 2.0).all()
    assert torch.equal(src.R, before[0])
    assert torch.equal(src.T, before[1])


def test_orientations_decide_where_centres_cannot():
    src, tgt = moved_pair(1, 1.0)
    aligned = corresponding_cameras_alignment(src, tgt)
    assert_close(aligned.R, tgt.R, atol=2e-5)
    assert_close(aligned.T, tgt.T, atol=2e-5)


def test_what_does_not_fit():
    src, tgt = moved_pair(3, 1.0)
    with pytest.raises(ValueError, match="same number of cameras, got 3 and 2"):
        corresponding_cameras_alignment(src, tgt[[0, 1]])
    with pytest.raises(ValueError, match="mode has to be one of"):
        corresponding_cameras_alignment(src, tgt, mode="center")
