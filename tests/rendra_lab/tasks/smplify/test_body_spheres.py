"""Balls that fill a body: capsules that are known are found again, and the free body's are where its limbs are."""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch
from torch import Tensor

from rendra.body import SMPL, SMPL_JOINTS, BodyParts, read_free_parts
from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify import body_spheres
from rendra_lab.tasks.smplify.body_spheres import CAPSULE_PAIRS, PARTS, Balls, BodySpheres, limb_depths
from rendra_lab.tasks.smplify.markers import MarkerSet


@cache
def free() -> tuple[SMPL, BodySpheres, MarkerSet]:
    body = SMPL.free(low=True)
    spheres = BodySpheres(body)
    return body, spheres, MarkerSet(body, spheres.markers)


def balls_of(turns: dict[str, tuple[float, float, float]], betas: Tensor | None = None) -> Balls:
    body, spheres, markers = free()
    x = torch.zeros(1, 85)
    for joint, turn in turns.items():
        place = 3 * body.joint_index(joint)
        x[0, place : place + 3] = torch.tensor(turn)
    if betas is not None:
        x[0, 72:82] = betas
    return spheres.balls(markers(x).points, x[:, 72:82])


def made_of_capsules() -> tuple[SMPL, dict[str, tuple[Tensor, Tensor, float]]]:
    """A body of capsules with ends where `_fit_capsule` does not begin; beta 0 thickens them, beta 1 moves them."""
    parts = read_free_parts(True)
    model = SMPL(parts)
    known, verts, dirs, owners = {}, [], [], []
    angle = torch.arange(16) * (math.tau / 16)
    for part in body_spheres._PARTS:
        bone = model.joint_index(part.bone)
        begin = model.joint_template[bone]
        tip = begin + torch.tensor([0.2, 0.0, 0.0])
        if part.tip is not None:
            tip = model.joint_template[model.joint_index(part.tip)]
        elif part.name == "head":
            tip = model.v_template[model.head_top]
        axis = tip - begin
        length = float(axis.norm())
        axis = axis / length
        side = torch.linalg.cross(axis, torch.tensor([0.3, 0.5, 0.8]))
        side = side / side.norm()
        radius, shift = 0.3 * length, 0.05 * length * side
        ring = angle.cos()[:, None] * side + angle.sin()[:, None] * torch.linalg.cross(axis, side)
        tube = [(begin + share * (tip - begin), ring) for share in torch.linspace(0, 1, 9).tolist()]
        slopes = torch.tensor([0.4, 0.8, 1.2, 1.5])
        caps = [
            (end, t.cos() * ring + sign * t.sin() * axis) for t in slopes for end, sign in ((begin, -1), (tip, 1))
        ]
        for place, out in tube + caps:
            verts.append(place + shift + radius * out)
            dirs.append(torch.stack([0.01 * out, torch.tensor([0.01, 0.02, -0.03]).expand_as(out)], dim=2))
            owners += [bone] * len(out)
        known[part.name] = (begin + shift, tip + shift, radius)
    weights = torch.nn.functional.one_hot(torch.tensor(owners), 24).float()
    regressor = torch.zeros(24, len(owners))
    body = SMPL(BodyParts(torch.cat(verts), torch.cat(dirs), torch.zeros(0, 3, dtype=torch.int64), regressor, weights,
                          parts.parents, None, SMPL_JOINTS))  # fmt: skip
    body.joint_template = model.joint_template
    body.joint_shapedirs = torch.tensor([0.0, 1.0]) * torch.tensor([0.01, 0.02, -0.03])[:, None].expand(24, 3, 2)
    return body, known


def test_known_capsules_are_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    body, known = made_of_capsules()
    monkeypatch.setattr(body_spheres, "_STIFFNESS", 1e-6)
    for part in body_spheres._PARTS:
        if part.name == "head":  # begins at a vertex that this body has elsewhere
            continue
        numbers = body_spheres._fit_capsule(body, part).float()
        begin, end, radius = known[part.name]
        expected = torch.cat([begin, end, torch.tensor([radius])])
        torch.testing.assert_close(numbers[:, 0], expected, atol=2e-3, rtol=0)
        torch.testing.assert_close(numbers[:, 1], torch.tensor([0.0] * 6 + [0.01]), atol=5e-4, rtol=0)
        torch.testing.assert_close(numbers[:, 2], torch.tensor([0.01, 0.02, -0.03] * 2 + [0.0]), atol=5e-4, rtol=0)


def test_the_twenty_parts_and_their_pairs() -> None:
    _, spheres, _ = free()
    assert len(PARTS) == 20
    assert len(set(map(frozenset, CAPSULE_PAIRS))) == 23
    assert {name for pair in CAPSULE_PAIRS for name in pair} <= set(PARTS)
    assert sorted(set(spheres.parts)) == list(range(20))
    assert list(spheres.parts) == sorted(spheres.parts)


def test_a_row_of_balls_is_about_a_diameter_apart() -> None:
    def places(name: str, length: float, radius: float) -> list[float]:
        return body_spheres._places_along(name, torch.tensor([0.0, 0, 0, 0, length, 0, radius]))

    assert places("calf", 0.1, 0.1) == [0, 1]
    assert places("calf", 0.85, 0.1) == pytest.approx([0, 0.25, 0.5, 0.75, 1])
    assert places("left_thigh", 0.45, 0.1) == pytest.approx([0.5, 1])
    assert places("right_upper_arm", 0.45, 0.1) == pytest.approx([0.5])
    assert places("right_upper_arm", 0.3, 0.1) == pytest.approx([1.0])


def test_the_free_body_is_filled() -> None:
    """As thick as people are, the same on both sides, and its skin is about where the balls end."""
    body, spheres, _ = free()
    radii = {PARTS[part]: float(r) for part, r in zip(spheres.parts, spheres.radius_columns[:, 0], strict=True)}
    for left in (name for name in PARTS if name.startswith("left")):
        assert radii[left] == pytest.approx(radii[left.replace("left", "right")], abs=1e-3)
    for name, low, high in (("left_forearm", 0.025, 0.045), ("left_thigh", 0.06, 0.09), ("pelvis", 0.09, 0.14)):
        assert low < radii[name] < high
    balls = balls_of({})
    apart = torch.cdist(body.v_template, balls.middles[0]) - balls.radii[0]
    assert float(apart.amin(1).quantile(0.95)) < 0.05
    assert float((apart.amin(1) < -0.03).float().mean()) < 0.05


@pytest.mark.parametrize("beta", [0, 1, 2])
def test_balls_follow_the_shape(beta: int) -> None:
    """To first order: capsules fitted anew to another shape are nearly those that betas predict."""
    body, spheres, markers = free()
    betas = torch.zeros(1, 10)
    betas[0, beta] = 1.0
    parts = read_free_parts(True)
    other = BodySpheres(SMPL(replace(parts, v_template=parts.v_template + parts.shapedirs[..., beta])))
    x = torch.cat([torch.zeros(1, 72), betas, torch.zeros(1, 3)], dim=1)
    predicted = spheres.balls(markers(x).points, betas)
    fresh = {PARTS[part]: r for part, r in zip(other.parts, other.radius_columns[:, 0], strict=True)}
    expected = torch.stack([fresh[PARTS[part]] for part in spheres.parts])
    torch.testing.assert_close(predicted.radii[0], expected, atol=3e-3, rtol=0)
    first = [predicted.places(name)[-1] for name in PARTS]
    last = torch.stack([other.markers[other.parts.index(k + 1) - 1 if k < 19 else -1].rest for k in range(20)])
    torch.testing.assert_close(predicted.middles[0, first], last, atol=1.5e-2, rtol=0)


def test_radii_stay_positive_and_tell_betas_nothing() -> None:
    _, spheres, markers = free()
    betas = torch.full((2, 10), -100.0, requires_grad=True)
    balls = spheres.balls(markers(torch.zeros(2, 85)).points, betas)
    assert float(balls.radii.min()) > 0
    assert not balls.radii.requires_grad
    assert spheres.radii(betas[:, :3].double()).dtype == torch.float64


def test_arms_in_the_trunk_are_noticed() -> None:
    resting = {"left_shoulder": (0.0, 0.0, -1.3), "right_shoulder": (0.0, 0.0, 1.3)}
    assert not bool(body_spheres.limbs_inside_trunk(balls_of({})))
    assert not bool(body_spheres.limbs_inside_trunk(balls_of(resting)))
    through = {"left_shoulder": (0.0, -0.2, -0.9), "left_elbow": (0.0, 0.0, -1.6)}
    balls = balls_of(through)
    assert bool(body_spheres.limbs_inside_trunk(balls))
    depths = limb_depths(balls)[0]
    assert float(depths.max()) == float(torch.maximum(depths[0], depths[2])) > 0.03  # the left ones
    assert body_spheres.limbs_inside_trunk(Balls(balls.middles[:0], balls.radii[:0], balls.parts)).shape == (0,)


def test_depth_is_that_under_a_capsule() -> None:
    parts = tuple(PARTS.index(name) for name in ("pelvis", "pelvis", "left_hand"))
    middles = torch.tensor([[[-1.0, 0, 0], [1, 0, 0], [0.3, 0.4, 0]], [[-1.0, 0, 0], [1, 0, 0], [1.3, 0.4, 0]]])
    radii = torch.tensor([[1.0, 1.0, 0.1]]).expand(2, 3)
    balls = Balls(middles, radii, parts)
    depth = body_spheres._depth(balls, balls.places("left_hand"), balls.places("pelvis"))
    torch.testing.assert_close(depth, torch.tensor([0.6, 0.5]))


def test_a_body_without_a_hand_is_refused() -> None:
    parts = read_free_parts(True)
    weights = parts.weights.clone()
    hands = [SMPL_JOINTS.index(name) for name in ("left_wrist", "left_hand")]
    weights[:, SMPL_JOINTS.index("left_elbow")] += weights[:, hands].sum(1)
    weights[:, hands] = 0
    with pytest.raises(UserError, match="the left_hand moves 0 vertices; a capsule needs 4 or more"):
        BodySpheres(SMPL(replace(parts, weights=weights)))
