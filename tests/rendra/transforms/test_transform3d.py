"""Transform3d: composition, inverses, broadcasting, dtypes, and refusals."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.transforms import (
    Rigid,
    Rotate,
    RotateAxisAngle,
    Scale,
    Transform3d,
    Translate,
    random_rotations,
    se3_exp_map,
    so3_exp_map,
)


def some_transforms(n: int = 3, dtype: torch.dtype = torch.float64) -> dict[str, Transform3d]:
    R, T = random_rotations(n, dtype=dtype), torch.randn(n, 3, dtype=dtype)
    scale = Scale(torch.rand(n, 3, dtype=dtype) + 0.5)
    return {
        "translate": Translate(T),
        "scale": scale,
        "rotate": Rotate(R),
        "rigid": Rigid(R, T),
        "axis": RotateAxisAngle(torch.randn(n, dtype=dtype), "y", degrees=False, dtype=dtype),
        "general": Transform3d(matrix=torch.eye(4, dtype=dtype) + 0.1 * torch.randn(n, 4, 4, dtype=dtype)),
        "composed": Rigid(R, T).compose(scale, Translate(T), Rotate(R)),
    }


@pytest.mark.parametrize("name", list(some_transforms()))
def test_the_inverse_undoes(name: str) -> None:
    transform = some_transforms()[name]
    eye = torch.eye(4).expand(3, 4, 4)
    for inverse in (transform.inverse(), transform.inverse(invert_composed=True)):
        assert_close(transform.compose(inverse).get_matrix(), eye, atol=1e-12)
        points = torch.randn(3, 5, 3, dtype=torch.float64)
        assert_close(inverse.transform_points(transform.transform_points(points)), points, atol=1e-10)


def test_anchors() -> None:
    assert_close(Transform3d().scale(2, 2, 1).transform_normals(torch.ones(1, 3)), [[0.5, 0.5, 1.0]])
    moved = Transform3d().translate(1, 0, 0).scale(2, 2, 2).transform_points(torch.zeros(1, 3))
    assert_close(moved, [[2.0, 0, 0]])


def test_compose_applies_left_to_right() -> None:
    transforms = some_transforms()
    a, b, c = transforms["translate"], transforms["rotate"], transforms["general"]
    points = torch.randn(3, 5, 3, dtype=torch.float64)
    expected = c.transform_points(b.transform_points(a.transform_points(points)))
    assert_close(a.compose(b, c).transform_points(points), expected)
    assert_close(a.compose(b).compose(c).get_matrix(), a.compose(b, c).get_matrix())
    chained = Transform3d(dtype=torch.float64).translate(1, 2, 3).rotate(b.get_matrix()[0, :3, :3]).scale(2)
    chained = chained.rotate_axis_angle(30, "Z")
    by_hand = (points[0] + torch.tensor([1.0, 2, 3])) @ b.get_matrix()[0, :3, :3] * 2
    by_hand = RotateAxisAngle(30, "Z").transform_points(by_hand)
    assert_close(chained.transform_points(points[0]), by_hand)


@pytest.mark.parametrize(("axis", "start", "end"), [("X", 1, 2), ("y", 2, 0), ("Z", 0, 1)])
def test_a_quarter_turn_is_counter_clockwise(axis: str, start: int, end: int) -> None:
    turned = RotateAxisAngle(90, axis).transform_points(torch.eye(3)[start : start + 1])
    assert turned.dtype == torch.float32
    assert_close(turned, torch.eye(3)[end : end + 1], atol=1e-7)
    radians = RotateAxisAngle(torch.tensor([math.pi / 2]), axis, degrees=False, dtype=torch.float32)
    assert_close(radians.get_matrix(), RotateAxisAngle(90.0, axis).get_matrix().float(), atol=1e-7)


def test_rows_hold_the_translation_and_rotate_multiplies_from_the_right() -> None:
    matrix = Translate(1, 2.5, torch.tensor([3.0, 4.0])).get_matrix()
    assert_close(matrix[:, 3], [[1, 2.5, 3, 1], [1, 2.5, 4, 1]])
    R = random_rotations(2)
    points = torch.randn(2, 4, 3)
    assert_close(Rotate(R).transform_points(points), points @ R)
    assert_close(Rigid(R[:1], torch.ones(2, 3)).transform_points(points), points @ R[:1] + 1)


def test_scale_takes_one_number_for_all_axes() -> None:
    assert_close(Scale(2.0).get_matrix(), torch.diag(torch.tensor([2.0, 2, 2, 1]))[None])
    assert len(Scale(torch.tensor([1.0, 2.0]))) == 2
    assert_close(Scale(1, torch.tensor([2.0, 3.0]), 4).get_matrix()[1].diagonal(), [1.0, 3, 4, 1])


def test_shapes_and_broadcasting() -> None:
    one, three = Translate(1, 2, 3), Translate(torch.randn(3, 3))
    assert one.transform_points(torch.zeros(5, 3)).shape == (5, 3)
    assert three.transform_points(torch.zeros(5, 3)).shape == (3, 5, 3)
    assert one.transform_points(torch.zeros(4, 5, 3)).shape == (4, 5, 3)
    assert one.transform_normals(torch.zeros(5, 3)).shape == (5, 3)
    assert three.transform_normals(torch.zeros(1, 5, 3)).shape == (3, 5, 3)
    assert one.transform_points(torch.zeros(0, 3)).shape == (0, 3)
    assert len(one.compose(three)) == len(three.compose(one)) == 3
    assert len(one.stack(three, one)) == 5
    assert Transform3d(matrix=torch.zeros(0, 4, 4)).transform_points(torch.zeros(5, 3)).shape == (0, 5, 3)


def test_indexing_keeps_a_batch() -> None:
    t = Translate(torch.arange(12.0).view(4, 3))
    matrix = t.get_matrix()
    assert_close(t[1].get_matrix(), matrix[1:2])
    assert_close(t[-1].get_matrix(), matrix[3:])
    assert_close(t[[2, 0]].get_matrix(), matrix[[2, 0]])
    assert_close(t[1:3].get_matrix(), matrix[1:3])
    assert_close(t[torch.tensor([True, False, False, True])].get_matrix(), matrix[[0, 3]])
    assert_close(t[torch.tensor([3, 1])].get_matrix(), matrix[[3, 1]])
    with pytest.raises(IndexError):
        t[4]


def test_normals_stay_perpendicular() -> None:
    transform = some_transforms()["composed"]
    normal, along = torch.randn(2, 3, 6, 3, dtype=torch.float64)
    along = torch.linalg.cross(normal, along)
    linear = transform.get_matrix()[:, :3, :3]
    dot = (transform.transform_normals(normal) * (along @ linear)).sum(-1)
    assert_close(dot, torch.zeros(3, 6), atol=1e-12)


def test_many_points_go_the_same_way_as_few() -> None:
    transform = some_transforms()["general"]
    points = torch.randn(20000, 3, dtype=torch.float64)
    few = torch.cat([transform.transform_points(part) for part in points.split(2000)], dim=1)
    assert_close(transform.transform_points(points), few, atol=0, rtol=1e-10)


def test_dividing_by_small_w_keeps_its_sign() -> None:
    matrix = torch.eye(4)
    matrix[2, 3], matrix[3, 3] = 1, 0  # w = z
    points = torch.tensor([[1.0, 2, 1e-9], [1, 2, -1e-9], [1, 2, 0], [1, 2, 4]], requires_grad=True)
    out = Transform3d(matrix=matrix).transform_points(points, eps=0.01)
    assert_close(out[:, :2], [[100, 200], [-100, -200], [100, 200], [0.25, 0.5]])
    out.sum().backward()
    assert_finite(points.grad)


def test_dtypes_meet() -> None:
    double = Translate(torch.ones(1, 3, dtype=torch.float64))
    assert double.transform_points(torch.zeros(2, 3)).dtype == torch.float32
    assert double.compose(Transform3d()).dtype == Transform3d().compose(double).dtype == torch.float64
    assert Translate(1, 2, 3, dtype=torch.float64).dtype == torch.float64
    assert Rotate(torch.eye(3, dtype=torch.float64)).dtype == torch.float64


def test_clone_and_to() -> None:
    t = some_transforms()["composed"]
    copy = t.clone()
    assert copy.get_matrix().data_ptr() != t.get_matrix().data_ptr()
    assert_close(copy.inverse().get_matrix(), t.inverse().get_matrix())
    assert t.to("cpu") is t
    assert t.to("cpu", copy=True) is not t
    single = t.to("cpu", dtype=torch.float32)
    assert single.dtype == single.inverse().dtype == torch.float32
    assert t.dtype == torch.float64
    assert single.cpu() is single


def test_the_logarithm_of_a_motion() -> None:
    log = torch.randn(4, 6, dtype=torch.float64)
    assert_close(Transform3d(matrix=se3_exp_map(log)).get_se3_log(), log, atol=1e-10)


def test_gradients_reach_every_parameter() -> None:
    log, shift = torch.randn(2, 2, 3, dtype=torch.float64).requires_grad_().unbind(0)
    points = torch.randn(2, 4, 3, dtype=torch.float64)

    def through(log: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        forth = Rotate(so3_exp_map(log)).translate(shift).scale(2.0)
        return forth.inverse().compose(Rigid(so3_exp_map(log), shift)).transform_points(points)

    leaves = (log.detach().requires_grad_(), shift.detach().requires_grad_())
    assert torch.autograd.gradcheck(through, leaves)


def test_a_matrix_that_is_no_rotation_warns_only_on_request(monkeypatch: pytest.MonkeyPatch) -> None:
    Rotate(2 * torch.eye(3))
    monkeypatch.setenv("RENDRA_CHECK_ROTATION_MATRICES", "1")
    Rotate(random_rotations(3))
    with pytest.warns(UserWarning, match="not a valid rotation matrix"):
        Rotate(2 * torch.eye(3))
    with pytest.warns(UserWarning, match="not a valid rotation matrix"):
        Rotate(-torch.eye(3))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Transform3d(matrix=torch.zeros(4)), "2- or a 3-dimensional"),
        (lambda: Transform3d(matrix=torch.zeros(3, 3)), r"\(4, 4\)"),
        (lambda: Translate(1), "x, y and z"),
        (lambda: Translate(torch.zeros(2, 2)), r"\(N, 3\).*Translate"),
        (lambda: Translate(torch.zeros(2), torch.zeros(3), 1), r"\(N,\)"),
        (lambda: Scale(1, 2), "x, y and z"),
        (lambda: Rotate(torch.zeros(4, 4)), "R must have shape"),
        (lambda: RotateAxisAngle(1.0, "W"), "'W'"),
        (lambda: RotateAxisAngle(torch.zeros(2, 2)), r"\(2, 2\)"),
        (lambda: Transform3d().compose(torch.eye(4)), "Only possible to compose"),
        (lambda: Translate(torch.zeros(2, 3)).compose(Translate(torch.zeros(3, 3))), "batch dim"),
        (lambda: Translate(torch.zeros(2, 3)).transform_points(torch.zeros(3, 1, 3)), "batch dim"),
        (lambda: Transform3d().transform_points(torch.zeros(3)), "Expected points"),
        (lambda: Transform3d().transform_normals(torch.zeros(1, 1, 1, 3)), "Expected normals"),
    ],
)
def test_wrong_input_is_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
