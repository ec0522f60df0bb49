"""Laws of posed bodies, and a slow loop over the paper's formulas."""

import dataclasses
from typing import Any

import pytest
import torch
from bodies import parts
from far_device import far  # noqa: F401
from torch import Tensor
from torch.autograd import gradcheck

from rendra.body import SMPL, SMPL_JOINTS, SMPL_PARENTS, linear_blend_skinning, pose_skeleton, pose_to_matrices
from rendra.body.skinning import check_parents, pose_features
from rendra.kernels.skinning import skin_weights
from rendra.transforms import axis_angle_to_matrix, matrix_to_rotation_6d, random_rotations


@pytest.fixture(scope="module", params=["made", "free_low"])
def body(request: pytest.FixtureRequest) -> SMPL:
    """Bodies of float64."""
    return (SMPL(parts()) if request.param == "made" else SMPL.free(low=True)).double()


def _draw(body: SMPL, count: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    like: Any = {"dtype": body.v_template.dtype}
    generator = torch.Generator().manual_seed(7)
    return (
        torch.randn(count, body.num_betas, generator=generator, **like),
        0.5 * torch.randn(count, body.num_joints, 3, generator=generator, **like),
        torch.randn(count, 3, generator=generator, **like),
    )


def _by_loops(made: SMPL, betas: Tensor, pose: Tensor) -> tuple[Tensor, Tensor]:
    """One body, as Loper et al. write it: Eq. 2-4 and 8-10, a vertex and a joint after the other."""
    rotations = [axis_angle_to_matrix(each) for each in pose]
    shaped = made.v_template.clone()
    for n in range(len(betas)):
        shaped = shaped + betas[n] * made.shapedirs[:, :, n]
    rest = [sum(w * v for w, v in zip(row, shaped, strict=True)) for row in made.J_regressor]
    posed = shaped
    if made.posedirs is not None:
        features = [
            (rotations[k] - torch.eye(3))[r, c] for k in range(1, len(pose)) for r in range(3) for c in range(3)
        ]
        assert len(features) == 9 * (len(pose) - 1)
        for n, feature in enumerate(features):
            posed = posed + feature * made.posedirs[:, :, n]
    world = []
    for joint, parent in enumerate(made.parents):
        local = torch.eye(4, dtype=betas.dtype)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = rest[joint] - (rest[parent] if parent >= 0 else 0)
        world.append(world[parent] @ local if parent >= 0 else local)
    verts = torch.zeros_like(posed)
    for v in range(len(posed)):
        for joint, move in enumerate(world):
            back = posed[v] - rest[joint]
            verts[v] += made.weights[v, joint] * (move[:3, :3] @ back + move[:3, 3])
    return verts, torch.stack([move[:3, 3] for move in world])


@pytest.mark.parametrize(
    ("joints", "betas", "pose_blends"), [(24, 10, True), (24, 3, False), (16, 10, True), (1, 2, True)]
)
def test_the_formulas_of_the_paper(joints: int, betas: int, pose_blends: bool) -> None:
    made = SMPL(parts(12, joints, betas, pose_blends)).double()
    shapes, pose, _ = _draw(made, 2)
    got = made(shapes, pose)
    for b in range(2):
        verts, places = _by_loops(made, shapes[b], pose[b])
        # the regressed joints were rounded to float32
        torch.testing.assert_close(got.verts[b], verts, rtol=0, atol=2e-6)
        torch.testing.assert_close(got.joints[b], places, rtol=0, atol=2e-6)


def test_at_rest_a_body_is_its_shape(body: SMPL) -> None:
    betas, _, _ = _draw(body)
    got = body(betas)
    shaped = body.v_template + torch.einsum("bn,vcn->bvc", betas, body.shapedirs)
    torch.testing.assert_close(got.verts, shaped, rtol=0, atol=1e-6)  # weights are float32, of sum 1 within 1e-7
    torch.testing.assert_close(got.verts, body.rest_verts(betas), rtol=0, atol=1e-6)
    torch.testing.assert_close(got.joints, body.J_regressor @ shaped, rtol=0, atol=2e-6)
    torch.testing.assert_close(got.joints, body.rest_joints(betas))
    torch.testing.assert_close(got.rotations, torch.eye(3, dtype=torch.float64).expand_as(got.rotations))
    torch.testing.assert_close(body().verts[0], body.v_template, rtol=0, atol=1e-6)


def test_weights_have_the_sum_one(body: SMPL) -> None:
    torch.testing.assert_close(
        body.weights.sum(1), torch.ones(len(body.weights), dtype=torch.float64), atol=1e-6, rtol=0
    )
    assert (body.weights >= 0).all()


def test_the_first_rotation_turns_everything_about_the_pelvis(body: SMPL) -> None:
    betas, pose, _ = _draw(body)
    still = pose.clone()
    still[:, 0] = 0
    before, after, turn = body(betas, still), body(betas, pose), axis_angle_to_matrix(pose[:, 0])
    pelvis = before.joints[:, :1]
    torch.testing.assert_close(after.joints[:, :1], pelvis)
    for points, turned in ((before.verts, after.verts), (before.joints, after.joints)):
        torch.testing.assert_close(turned, (points - pelvis) @ turn.transpose(1, 2) + pelvis, rtol=0, atol=1e-6)
    torch.testing.assert_close(after.rotations, turn[:, None] @ before.rotations)


@pytest.mark.parametrize("name", ["left_elbow", "spine2", "head"])
def test_a_joint_moves_only_what_hangs_on_it(name: str) -> None:
    body = SMPL.free(low=True).double()
    betas, pose, _ = _draw(body, 1)
    turned = pose.clone()
    joint = body.joint_index(name)
    turned[:, joint] += torch.tensor([0.3, -0.5, 0.7])
    below = {joint}
    below |= {other for other in range(24) if _chain(other) & below}
    before, after = body(betas, pose), body(betas, turned)
    moved = (after.verts - before.verts).norm(dim=-1)[0] > 1e-9
    free = body.weights[:, sorted(below)].sum(1) == 0
    assert not moved[free].any()
    assert moved[body.weights[:, sorted(below - {joint})].sum(1) > 0.5].all()
    stay = [other for other in range(24) if other not in below or other == joint]
    torch.testing.assert_close(after.joints[:, stay], before.joints[:, stay])


def _chain(joint: int) -> set[int]:
    return set() if joint < 0 else {joint} | _chain(SMPL_PARENTS[joint])


def test_bones_keep_their_lengths(body: SMPL) -> None:
    betas, pose, translation = _draw(body)
    above = list(body.parents[1:])
    rest, posed = body.rest_joints(betas), body(betas, pose, translation).joints
    lengths = [(joints[:, 1:] - joints[:, above]).norm(dim=-1) for joints in (rest, posed)]
    torch.testing.assert_close(lengths[1], lengths[0])
    turns = body(betas, pose).rotations
    torch.testing.assert_close(turns @ turns.transpose(-1, -2), torch.eye(3, dtype=torch.float64).expand_as(turns))


def test_translation_moves_all(body: SMPL) -> None:
    betas, pose, translation = _draw(body)
    still, moved = body(betas, pose), body(betas, pose, translation)
    torch.testing.assert_close(moved.verts, still.verts + translation[:, None])
    torch.testing.assert_close(moved.joints, still.joints + translation[:, None])
    torch.testing.assert_close(moved.rotations, still.rotations)


def test_shapes_are_linear(body: SMPL) -> None:
    betas, _, _ = _draw(body, 2)
    mean = body().verts
    apart = body(betas).verts - mean
    torch.testing.assert_close(
        body(2 * betas[:1] - 3 * betas[1:]).verts - mean, 2 * apart[:1] - 3 * apart[1:], rtol=0, atol=1e-6
    )
    few = body(betas[:, :4]).verts
    rest = torch.cat([betas[:, :4], torch.zeros_like(betas[:, 4:])], dim=1)
    torch.testing.assert_close(few, body(rest).verts)


def test_fewer_betas_with_a_pose(body: SMPL) -> None:
    betas, pose, _ = _draw(body, 2)
    padded = torch.cat([betas[:, :4], torch.zeros_like(betas[:, 4:])], dim=1)
    torch.testing.assert_close(body(betas[:, :4], pose).verts, body(padded, pose).verts)


def test_all_ways_to_say_a_pose(body: SMPL) -> None:
    betas, pose, _ = _draw(body)
    expected = body(betas, pose).verts
    matrices = axis_angle_to_matrix(pose)
    for same in (pose.flatten(1), matrices, matrix_to_rotation_6d(matrices)):
        torch.testing.assert_close(body(betas, same).verts, expected)
    assert pose_to_matrices(matrices, body.num_joints) is matrices


def test_one_for_all(body: SMPL) -> None:
    betas, pose, translation = _draw(body)
    every = body(betas, pose, translation)
    for b in range(3):
        one = body(betas[b : b + 1], pose[b : b + 1], translation[b : b + 1])
        for mine, all_of_them in zip(one, every, strict=True):
            torch.testing.assert_close(mine[0], all_of_them[b])
    for given in (
        (betas[:1], pose, translation),
        (betas, pose[:1], translation),
        (betas, pose, translation[:1]),
        (betas[:1], pose[:1], translation),
        (None, pose, None),
        (betas, None, None),
        (None, None, translation),
    ):
        spread = [None if each is None else each.expand(3, *each.shape[1:]) for each in given]
        for mine, expected in zip(body(*given), body(*spread), strict=True):
            assert len(mine) == 3
            torch.testing.assert_close(mine, expected)


def test_no_bodies(body: SMPL) -> None:
    betas, pose, translation = _draw(body, 0)
    for given in ((betas, pose, translation), (betas, None, None), (None, pose, None), (None, None, translation)):
        got = body(*given)
        assert got.verts.shape == (0, len(body.v_template), 3)
        assert got.joints.shape == (0, body.num_joints, 3)
        assert got.rotations.shape == (0, body.num_joints, 3, 3)
    assert len(body.mesh(body(betas, pose))) == 0


@pytest.mark.parametrize("at_rest", [True, False])
def test_gradients(at_rest: bool) -> None:
    made = SMPL(parts(8, 6, 3)).double()
    betas, pose, translation = _draw(made, 2)
    inputs = [(0 * each if at_rest else each).requires_grad_() for each in (betas, pose, translation)]
    assert gradcheck(lambda *given: tuple(made(*given)), inputs)


def test_gradients_of_a_full_turn_are_finite() -> None:
    low = SMPL.free(low=True)
    for angle in (0.0, 1e-20, 1e-4, torch.pi, 2 * torch.pi):
        pose = torch.full((1, 24, 3), angle / 3**0.5, requires_grad=True)
        got = low(None, pose)
        (grad,) = torch.autograd.grad(got.verts.square().sum() + got.joints.sum(), pose)
        assert grad.isfinite().all()


def test_single_precision_equals_double() -> None:
    single, double = SMPL.free(low=True), SMPL.free(low=True).double()
    betas, pose, translation = (each.requires_grad_() for each in _draw(double, 4))
    halves = [each.detach().float().requires_grad_() for each in (betas, pose, translation)]
    upstream = torch.randn(4, len(single.v_template), 3)
    wide = double(betas, pose, translation).verts
    narrow = single(*halves).verts
    torch.testing.assert_close(narrow.double(), wide, rtol=0, atol=3e-6)
    expected = torch.autograd.grad(wide, (betas, pose, translation), upstream.double())
    for grad, exact in zip(torch.autograd.grad(narrow, halves, upstream), expected, strict=True):
        torch.testing.assert_close(grad.double(), exact, rtol=1e-4, atol=1e-4)


def test_pose_features_stand_row_by_row() -> None:
    rotations = random_rotations(24)[None]
    features = pose_features(rotations)
    assert features.shape == (1, 207)
    for k in range(1, 24):
        for r in range(3):
            for c in range(3):
                expected = rotations[0, k, r, c] - float(r == c)
                assert features[0, 9 * (k - 1) + 3 * r + c] == expected


def test_weights_as_a_matrix_have_a_gradient() -> None:
    made = parts(7, 5)
    rest, verts = torch.randn(2, 5, 3, dtype=torch.float64), torch.randn(2, 7, 3, dtype=torch.float64)
    skeleton = pose_skeleton(random_rotations(10, dtype=torch.float64).reshape(2, 5, 3, 3), rest, made.parents)
    torch.testing.assert_close(
        linear_blend_skinning(verts, skeleton, rest, made.weights),
        linear_blend_skinning(verts, skeleton, rest, skin_weights(made.weights)),
    )
    assert gradcheck(lambda w: linear_blend_skinning(verts, skeleton, rest, w), made.weights.requires_grad_())


def test_devices(far: torch.device) -> None:  # noqa: F811
    for made in (SMPL(parts()), SMPL.free(low=True)):
        betas, pose, translation = _draw(made, 2)
        here = made(betas, pose, translation)
        there = made.to(far)(betas.to(far), pose.to(far), translation.to(far))
        for mine, other in zip(here, there, strict=True):
            torch.testing.assert_close(mine, other.cpu(), rtol=1e-4, atol=1e-5)
        made.mesh(there)


def test_a_body_is_no_part_of_a_checkpoint() -> None:
    assert not SMPL(parts()).state_dict()


@pytest.mark.parametrize("low", [True, False])
def test_the_free_body(low: bool) -> None:
    body = SMPL.free(low)
    assert body.joint_names == SMPL_JOINTS
    assert body.parents == SMPL_PARENTS
    assert body.num_betas == 10
    assert body.v_template.shape == ((1229 if low else 13718), 3)
    height = body.v_template[:, 1].amax() - body.v_template[:, 1].amin()
    assert 1.6 < height < 1.85  # metres
    joints = dict(zip(body.joint_names, body.rest_joints(torch.zeros(1, 10))[0], strict=True))
    assert joints["left_wrist"][0] > 0.4  # the left arm along +x
    assert joints["right_wrist"][0] < -0.4
    assert abs(float(joints["left_wrist"][1] - joints["left_shoulder"][1])) < 0.1
    assert joints["head"][1] > joints["pelvis"][1] > joints["left_ankle"][1]
    assert joints["left_foot"][2] > joints["left_ankle"][2]  # looks along +z
    torch.testing.assert_close(joints["pelvis"], torch.zeros(3), atol=0.02, rtol=0)
    spread = body.shapedirs.square().sum(1).mean(0).sqrt()
    assert (spread > 1e-3).all()  # every beta shows
    mesh = body.mesh(body())
    assert mesh.faces_packed().unique().numel() == len(body.v_template)


def test_low_and_full_bodies_are_of_the_same_people() -> None:
    betas = torch.randn(4, 10)
    full, low = (SMPL.free(each)(betas).joints for each in (False, True))
    assert (full - low).norm(dim=-1).mean() < 0.01


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ((torch.zeros(1, 11), None, None), r"betas must be \(B, n\) with n at most 10, got \(1, 11\)"),
        ((torch.zeros(10), None, None), r"betas must be"),
        ((None, torch.zeros(2, 23, 3), None), r"a pose of 24 joints is .* got \(2, 23, 3\)"),
        ((None, None, torch.zeros(3)), r"translation must be \(B, 3\), got \(3,\)"),
        ((torch.zeros(2, 10), torch.zeros(3, 72), None), r"'betas': 2, 'pose': 3"),
        ((torch.zeros(2, 10).double(), None, None), r"betas must be torch.float32 on cpu.*got torch.float64"),
    ],
)
def test_calls_that_are_refused(given: Any, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SMPL.free(low=True)(*given)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"v_template": torch.zeros(30, 2)}, r"v_template must be \(30, 3\) for 30 vertices and 24 joints"),
        ({"v_template": torch.zeros(0, 3)}, "has vertices and joints, got 0 and 24"),
        ({"shapedirs": torch.zeros(30, 3)}, r"shapedirs must be \(30, 3, any\)"),
        ({"weights": torch.ones(30, 23)}, r"weights must be \(30, 24\)"),
        ({"weights": torch.ones(30, 24)}, r"sum 1; those of vertex 0 have 24"),
        ({"posedirs": torch.zeros(30, 3, 206)}, r"posedirs must be \(30, 3, 207\)"),
        ({"faces": torch.tensor([[0, 1, 30]])}, "faces must name vertices 0 to 29, got 0 to 30"),
        ({"J_regressor": torch.full((24, 30), torch.nan)}, "J_regressor holds numbers that are not finite"),
        ({"joint_names": ("a",)}, "joint_names must be 24, got 1"),
        ({"head_top": 30}, "head_top must be a vertex, 0 to 29"),
        ({"parents": (-1, *range(1, 24))}, "parent of joint 1 must be one of the joints before it, got 1"),
    ],
)
def test_parts_that_are_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        SMPL(dataclasses.replace(parts(), **change))


def test_other_refusals() -> None:
    with pytest.raises(ValueError, match="first joint must be the root"):
        check_parents([])
    with pytest.raises(ValueError, match="no joint 'tail'; it has: pelvis"):
        SMPL.free(low=True).joint_index("tail")
    with pytest.raises(ValueError, match="rotations and rest of 2 joints"):
        pose_skeleton(torch.zeros(1, 3, 3, 3), torch.zeros(1, 3, 3), (-1, 0))
