"""Overlap of boxes: closed forms, symmetries, Monte Carlo, boxes that touch, checks."""

import math

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.ops import box3d_overlap
from rendra.ops import iou_box3d as module
from rendra.transforms import random_rotations

UNIT = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])


def _boxes(number: int, spread: float = 0.4) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Corners, and centre, rotation and size they come from."""
    centre, size = torch.randn(number, 3).double() * spread, torch.rand(number, 3).double() + 0.3
    rotation = random_rotations(number, dtype=torch.float64)
    return ((UNIT - 0.5) * size[:, None]) @ rotation + centre[:, None], centre, rotation, size


def test_boxes_along_the_axes() -> None:
    low1, low2 = torch.rand(30, 3).double(), torch.rand(20, 3).double()
    high1, high2 = low1 + torch.rand(30, 3) + 0.1, low2 + torch.rand(20, 3) + 0.1
    vol, iou = box3d_overlap(
        UNIT * (high1 - low1)[:, None] + low1[:, None], UNIT * (high2 - low2)[:, None] + low2[:, None]
    )
    shared = torch.minimum(high1[:, None], high2) - torch.maximum(low1[:, None], low2)
    expected = shared.clamp(min=0).prod(-1)
    assert_close(vol, expected, atol=1e-12)
    union = (high1 - low1).prod(-1)[:, None] + (high2 - low2).prod(-1) - expected
    assert_close(iou, expected / union, atol=1e-12)
    assert 0 < (vol > 0).sum() < vol.numel()


def test_a_cube_turned_by_an_eighth_leaves_an_octagonal_prism() -> None:
    c = math.cos(math.pi / 4)
    turn = torch.tensor([[c, c, 0], [-c, c, 0], [0, 0, 1]])
    vol, _ = box3d_overlap((UNIT - 0.5)[None], ((UNIT - 0.5) @ turn)[None])
    assert_close(vol, [[2 * (math.sqrt(2) - 1)]])


def test_a_corner_cut_off_is_a_tetrahedron() -> None:
    """A large box with one side in the plane x + y + z = 1/2 keeps a corner of volume (1/2)^3 / 6."""
    normal = torch.ones(3) / math.sqrt(3)
    across = torch.tensor([1.0, -1, 0]) / math.sqrt(2)
    frame = torch.stack([across, torch.linalg.cross(normal, across), normal])
    box = ((UNIT - torch.tensor([0.5, 0.5, 1])) * 20) @ frame + 0.5 / 3
    assert_close(box3d_overlap(UNIT[None], box[None])[0], [[1 / 48]])


def test_symmetric_and_blind_to_motion() -> None:
    (first, *_), (second, *_) = _boxes(12), _boxes(15)
    vol, iou = box3d_overlap(first, second)
    assert ((iou >= 0) & (iou <= 1)).all()
    for mine, theirs in zip((vol, iou), box3d_overlap(second, first), strict=True):
        assert_close(mine, theirs.T, atol=1e-12)
    turn = random_rotations(1, dtype=torch.float64)[0]
    moved, _ = box3d_overlap(first @ turn + 5, second @ turn + 5)
    assert_close(moved, vol, atol=1e-9)
    mirror = torch.tensor([1.0, 1, -1], dtype=torch.float64)
    assert_close(box3d_overlap(first * mirror, second * mirror)[0], vol, atol=1e-12)
    assert_close(box3d_overlap(2 * first, 2 * second)[0], 8 * vol, atol=1e-12)


def test_monte_carlo() -> None:
    (first, *_), (second, centre, rotation, size) = _boxes(4), _boxes(5)
    sides = first[:, [1, 3, 4]] - first[:, :1]
    inside = torch.rand(40000, 3).double() @ sides + first[:, :1]  # (4, samples, 3)
    own = ((inside[:, None] - centre[:, None]) @ rotation.mT).abs() <= size[:, None] / 2
    share = own.all(-1).double().mean(-1)
    expected = share * torch.linalg.det(sides).abs()[:, None]
    assert_close(box3d_overlap(first, second)[0], expected, atol=0.01)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_box_with_itself_at_any_angle(dtype: torch.dtype) -> None:
    boxes, _, _, size = _boxes(40)
    vol, iou = box3d_overlap(boxes.to(dtype), boxes.to(dtype))
    assert vol.dtype == iou.dtype == dtype
    assert_close(vol.diagonal(), size.prod(1), atol=1e-6)
    assert_close(iou.diagonal(), torch.ones(40), atol=1e-6)


@pytest.mark.parametrize("jitter", [0.0, 1e-16, 1e-9, 1e-7])
def test_nearly_common_planes_lose_nothing(jitter: float) -> None:
    """Boxes that share planes up to rounding: halves, quarters and neighbours of a turned box."""
    turn = random_rotations(50, dtype=torch.float64)
    parts = torch.stack([UNIT, UNIT * torch.tensor([0.5, 1, 1]), UNIT * 0.5 + 0.5, UNIT + torch.tensor([1.0, 0, 0])])
    for rotation in turn:
        boxes = parts.double() @ rotation
        boxes = boxes + jitter * torch.randn_like(boxes)
        vol, _ = box3d_overlap((UNIT.double() @ rotation)[None], boxes)
        assert_close(vol, [[1.0, 0.5, 0.125, 0]], atol=1e-5)


def test_boxes_need_not_be_rectangular() -> None:
    shear = torch.tensor([[1.0, 0, 0], [0.5, 1, 0], [0, 0, 1]])
    frustum = UNIT.clone()
    frustum[4:, :2] = 0.25 + 0.5 * frustum[4:, :2]
    vol, _ = box3d_overlap(torch.stack([UNIT @ shear, frustum]), torch.stack([UNIT @ shear, frustum, 4 * UNIT - 1]))
    assert_close(vol[:, 2], [1.0, 7 / 12])
    assert_close(vol.diagonal(), [1.0, 7 / 12])


def test_nothing_to_compare_and_many(monkeypatch: pytest.MonkeyPatch) -> None:
    assert box3d_overlap(torch.zeros(0, 8, 3), UNIT[None])[0].shape == (0, 1)
    assert box3d_overlap(UNIT[None], torch.zeros(0, 8, 3))[1].shape == (1, 0)
    boxes, *_ = _boxes(9)
    whole = box3d_overlap(boxes, boxes[:5])
    monkeypatch.setattr(module, "_PAIRS_AT_ONCE", 12)
    assert_close(box3d_overlap(boxes, boxes[:5])[0], whole[0], atol=1e-14)


def test_results_lie_where_the_boxes_lie(far) -> None:  # noqa: F811
    boxes, *_ = _boxes(3)
    vol, iou = box3d_overlap(boxes.to(far), boxes.to(far))
    assert isinstance(vol, Far)
    assert_close(iou.cpu(), box3d_overlap(boxes, boxes)[1])


def test_bad_boxes_are_named() -> None:
    good, bent, flat, broken = (UNIT.clone() for _ in range(4))
    bent[6] += 0.1
    flat[:, 2] = 0
    broken[3, 1] = float("nan")
    with pytest.raises(ValueError, match=r"Each box in the batch must be of shape \(8, 3\), got boxes1 of \(8, 3\)"):
        box3d_overlap(good, good[None])
    with pytest.raises(ValueError, match=r"boxes2\[1\]: Plane vertices are not coplanar"):
        box3d_overlap(good[None], torch.stack([good, bent]))
    with pytest.raises(ValueError, match=r"boxes1\[0\]: Planes have zero areas"):
        box3d_overlap(flat[None], good[None])
    with pytest.raises(ValueError, match=r"boxes1\[0\]: has a corner that is not finite"):
        box3d_overlap(broken[None], good[None])
    box3d_overlap(good[None], bent[None], eps=0.2)
