"""Where fits begin: bodies that are projected are found again, from all sides and with parts missing."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rendra.body import SMPL
from rendra.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from rendra_lab.tasks.smplify.camera_start import CameraStart
from rendra_lab.tasks.smplify.markers import MarkerSet
from rendra_lab.tasks.smplify.records import LSP_JOINTS, PeopleBatch
from rendra_lab.tasks.smplify.task import picture_markers, project

_FOCAL = 600.0


@pytest.fixture(scope="module")
def rest() -> Tensor:
    body = SMPL.free(low=True)
    return MarkerSet(body, picture_markers(body))(torch.zeros(1, 85)).points[0]


def seen(rest: Tensor, turns: Tensor, place: Tensor) -> PeopleBatch:
    """Bodies at rest, turned (B, 3, 3) into the camera's axes, at places (B, 3)."""
    count = len(turns)
    focal, center = torch.full((count,), _FOCAL), torch.full((count, 2), 128.0)
    joints_px = project(rest @ turns.transpose(1, 2) + place[:, None], focal, center)
    names = tuple(str(index) for index in range(count))
    ones, size = torch.ones(count, 14), torch.full((count, 2), 256.0)
    return PeopleBatch(joints_px, ones, size, focal, center, ones, names)


def without(batch: PeopleBatch, *names: str) -> PeopleBatch:
    """Those joints were not found, and no number stands there."""
    confidence, joints_px = batch.confidence.clone(), batch.joints_px.clone()
    for name in names:
        confidence[:, LSP_JOINTS.index(name)] = 0
        joints_px[:, LSP_JOINTS.index(name)] = 0
    return replace(batch, confidence=confidence, joints_px=joints_px)


def standing(heading_deg: float = 0.0, roll_deg: float = 0.0) -> Tensor:
    """The turn (1, 3, 3) of who stands before the camera and looks at it, then turns and rolls."""
    angles = torch.tensor([[0.0, 0.0, roll_deg], [180.0, 0.0, 0.0], [0.0, heading_deg, 0.0]]) * math.pi / 180
    roll, stand, heading = axis_angle_to_matrix(angles)
    return (roll @ stand @ heading)[None]


def apart_deg(turn: Tensor, heading: Tensor) -> float:
    rest_of_turn = axis_angle_to_matrix(heading) @ turn.transpose(1, 2)
    return math.degrees(float(matrix_to_axis_angle(rest_of_turn).norm(dim=1).max()))


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, -40.0])
@pytest.mark.parametrize("depth", [3.0, 8.0])
def test_a_body_is_placed_where_it_stands(rest: Tensor, heading_deg: float, depth: float) -> None:
    place = torch.tensor([[0.3, -0.2, depth]])
    batch = seen(rest, standing(heading_deg), place)
    heading, found, _ = CameraStart()(batch, rest)
    assert float(found[0, 2]) == pytest.approx(depth, rel=0.1)
    assert float((found - place)[0, :2].abs().max()) < 0.1
    assert apart_deg(standing(), heading) < 2  # in perspective
    again = project(rest @ axis_angle_to_matrix(heading).transpose(1, 2) + found[:, None], batch.focal_px,
                    batch.center_px)  # fmt: skip
    assert float((again - batch.joints_px).norm(dim=-1).mean() / batch.height_px) < 0.25


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, -90.0, 180.0, 35.0])
@pytest.mark.parametrize("back", [False, True])
def test_people_lie_hang_and_show_their_backs(rest: Tensor, roll_deg: float, back: bool) -> None:
    turn = standing(180.0 if back else 0.0, roll_deg)
    heading, place, is_open = CameraStart()(seen(rest, turn, torch.tensor([[0.0, 0.0, 5.0]])), rest)
    assert apart_deg(turn, heading) < 1
    assert float(place[0, 2]) == pytest.approx(5, rel=0.1)
    assert not bool(is_open[0])


@pytest.mark.parametrize("side_deg", [90.0, -90.0, 87.0])
def test_who_is_seen_from_the_side_may_look_either_way(rest: Tensor, side_deg: float) -> None:
    _, place, is_open = CameraStart()(seen(rest, standing(side_deg), torch.tensor([[0.0, 0.0, 5.0]])), rest)
    assert bool(is_open[0])
    assert float(place[0, 2]) == pytest.approx(5, rel=0.1)


def test_the_threshold_is_in_pixels_of_the_papers_pictures(rest: Tensor) -> None:
    batch = seen(rest, standing(75.0), torch.tensor([[0.0, 0.0, 5.0]]))
    shoulders = (batch.joints_px[:, 8] - batch.joints_px[:, 9]).norm(dim=1) * 300 / batch.height_px
    for narrow_px in (float(shoulders) - 0.5, float(shoulders) + 0.5):
        is_open = CameraStart(narrow_px)(batch, rest)[2]
        assert bool(is_open[0]) == (narrow_px > float(shoulders))


@pytest.mark.parametrize(
    "missing",
    [
        ("left_shoulder",),
        ("right_hip",),
        ("left_hip", "right_hip"),
        ("left_shoulder", "right_hip"),
        ("left_shoulder", "right_shoulder", "left_hip", "right_hip"),
    ],
)
def test_parts_of_the_torso_may_be_missing(rest: Tensor, missing: tuple[str, ...]) -> None:
    batch = without(seen(rest, standing(), torch.tensor([[0.2, 0.1, 5.0]])), *missing)
    heading, place, is_open = CameraStart()(batch, rest)
    assert float(place[0, 2]) == pytest.approx(5, rel=0.2)
    assert apart_deg(standing(), heading) < 1
    assert bool(is_open[0]) == any("shoulder" in name for name in missing)


def test_one_joint_alone_says_where_but_not_how_far(rest: Tensor) -> None:
    batch = seen(rest, standing(), torch.tensor([[0.0, 0.0, 5.0]]))
    batch = without(batch, *(name for name in LSP_JOINTS if name != "left_wrist"))
    for found in CameraStart()(batch, rest):
        assert bool(found.isfinite().all())


def test_nobody_begins_nowhere(rest: Tensor) -> None:
    heading, place, is_open = CameraStart()(seen(rest, torch.zeros(0, 3, 3), torch.zeros(0, 3)), rest)
    assert heading.shape == place.shape == (0, 3)
    assert is_open.shape == (0,)


def test_flipped_is_half_a_turn_about_the_bodys_own_axis() -> None:
    turn = standing(20.0, 30.0)
    flipped = axis_angle_to_matrix(CameraStart.flipped(matrix_to_axis_angle(turn)))
    torch.testing.assert_close(flipped[..., 1], turn[..., 1], atol=1e-5, rtol=0)  # upright as before
    torch.testing.assert_close(flipped[..., 2], -turn[..., 2], atol=1e-5, rtol=0)  # looks the other way
    again = axis_angle_to_matrix(CameraStart.flipped(CameraStart.flipped(matrix_to_axis_angle(turn))))
    torch.testing.assert_close(again, turn, atol=1e-4, rtol=0)
