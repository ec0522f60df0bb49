"""Cows without and in their coats: their axes, what is linear in paints, and where patterns lie."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rendra_lab.synthesis.cow_anatomy import Anatomy, CowParameters
from rendra_lab.synthesis.cow_coat import Coat, CoatParameters
from rendra_lab.synthesis.cow_herd import COATS, Cow, build_cow, painted, stretched


@pytest.fixture(scope="module")
def cow() -> Cow:
    return build_cow(0, 2000)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_a_cow_fills_its_box_stands_upright_and_looks_along_x(cow: Cow) -> None:
    torch.testing.assert_close(cow.verts.amax(0), cow.half_sides)
    torch.testing.assert_close(cow.verts.amin(0), -cow.half_sides)
    assert cow.half_sides.tolist() == [1.0, pytest.approx(0.54, abs=0.02), pytest.approx(0.83, abs=0.02)]
    share = cow.paints.mean(2)
    muzzle, hoof = ((cow.verts * share[:, paint, None]).sum(0) / share[:, paint].sum() for paint in (2, 4))
    assert muzzle[0] > 0  # of nose and udder
    assert hoof[2] < -0.7
    torch.testing.assert_close(cow.normals.norm(dim=1), torch.ones(len(cow.verts)))
    corners = cow.verts[cow.faces]
    assert float(torch.linalg.det(corners).sum()) > 0  # faces look outwards
    assert float((cow.normals * cow.verts).sum(1).mean()) > 0.2


def test_left_is_y(cow: Cow) -> None:
    swung = build_cow(1, 2000)  # whose tail hangs to one side
    anatomy = Anatomy(CowParameters.random(1))
    points, _ = anatomy.mesh(2000)
    ratio = (points.max(0) - points.min(0)).max() / 2
    away = (swung.verts[:, 1] * ratio + torch.from_numpy(points[:, 0])).std()
    assert float(away) < 1e-5  # the anatomy has x to its right


def test_colours_are_linear_in_paints(cow: Cow) -> None:
    colors = rng(1).uniform(0, 1, (5, 3))
    base, patch, muzzle, horn, hoof = (tuple(color) for color in colors.tolist())
    anatomy = Anatomy(CowParameters())
    points, _ = anatomy.mesh(2000)
    direct = Coat(anatomy, CoatParameters(base, patch, muzzle, horn, hoof, coverage=0.0), 0, points)(points)
    mixed = cow.fixed + (cow.paints * torch.from_numpy(colors).float()).sum(1)
    torch.testing.assert_close(mixed, torch.from_numpy(direct), atol=1e-5, rtol=0)


def test_a_stretched_cow_still_fills_a_box_of_one(cow: Cow) -> None:
    other = stretched(cow, rng(2))
    assert float(other.half_sides.max()) == pytest.approx(1)
    torch.testing.assert_close(other.verts.amax(0), other.half_sides)
    torch.testing.assert_close(other.normals.norm(dim=1), torch.ones(len(cow.verts)))
    assert not torch.allclose(other.half_sides, cow.half_sides)


@pytest.mark.parametrize("coat", COATS)
def test_every_coat_is_of_its_own_colours(coat: str, cow: Cow) -> None:
    one, same, other = (painted(cow, coat, rng(seed)) for seed in (3, 3, 4))
    assert torch.equal(one.colors, same.colors)
    assert not torch.equal(one.colors, other.colors)
    assert 0 <= float(one.colors.min()) <= float(one.colors.max()) <= 1
    hair = cow.paints[:, :2, 0].sum(1) > 0.99
    first, second = one.hair
    along = (one.colors[hair] - first) @ (second - first) / (second - first).square().sum()
    torch.testing.assert_close(one.colors[hair], first + along[:, None] * (second - first), atol=0.02, rtol=0)


def in_second_color(cow: Cow, coat: str, where: torch.Tensor) -> float:
    """The mean share of the second colour in the hair somewhere, over some coats."""
    hair = where & (cow.paints[:, 0, 0] > 0.99)
    shares = []
    for seed in range(5):
        one = painted(cow, coat, rng(seed))
        way = one.hair[1] - one.hair[0]
        shares.append(((one.colors[hair] - one.hair[0]) @ way / way.square().sum()).mean())
    return float(torch.stack(shares).mean())


def test_patterns_lie_where_breeds_have_them(cow: Cow) -> None:
    x, _, z = cow.verts.T
    assert in_second_color(cow, "belted", (x + 0.15).abs() < 0.1) < 0.1
    assert in_second_color(cow, "belted", (x < -0.6) & (z > -0.3)) > 0.9
    assert in_second_color(cow, "white_faced", x > 0.75) < 0.1
    assert in_second_color(cow, "white_faced", (x < 0.3) & (z > 0)) > 0.9
    assert 0.25 < in_second_color(cow, "black_pied", x.abs() < 2) < 0.65
    assert in_second_color(cow, "white", x.abs() < 2) < 0.3
