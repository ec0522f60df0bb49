"""Traced solids: silhouettes are those of geometry, light falls off and is kept away as it should be."""

import math
from dataclasses import replace

import numpy as np
import pytest

from rendra_lab.synthesis.clevr_like import camera_at
from rendra_lab.synthesis.traced_solids import (
    BALL,
    CUBE,
    CYLINDER,
    Stage,
    shown_shares,
    solid,
    to_linear,
    to_srgb,
    trace,
)

RED = (0.5, 0.1, 0.1)
LAMPS = np.array([[0.0, 3.0, 2.5], [2.8, -1.6, 2.3], [-1.8, 0.8, 3.5]])


def stage(v: float = 0.3, **changes: object) -> Stage:
    grey = (0.4, 0.4, 0.4)
    return replace(Stage(camera_at(v), 28.0, grey, grey, LAMPS, (10.0, 0.0, 0.0), 0.3), **changes)  # type: ignore[arg-type]


def row(shape: int, half: float = 0.2, x: float = 0, y: float = 0, turn: float = 0, metal: bool = False):
    return solid(shape, (x, y), half, turn, RED, metal)


def seen_points(v: float, points: np.ndarray, side: int) -> np.ndarray:
    """Where points of the world appear: column and row, pixels."""
    inverse = np.linalg.inv(camera_at(v))
    x, y, z = inverse[:3, :3] @ points.T + inverse[:3, 3:]
    focal = side / 2 / math.tan(math.radians(14))
    return np.stack([side / 2 - focal * x / z, side / 2 + focal * y / z], 1)


def test_a_ball_takes_the_share_of_the_picture_that_its_cone_of_sight_does() -> None:
    eye = camera_at(0.3)[:3, 3]
    middle = np.array([0, 0, 0.2])
    distance = np.linalg.norm(eye - middle)
    axis = (middle - eye) / distance @ -camera_at(0.3)[:3, 2]  # cosine between the line of sight and the ball
    # a cone of half-angle a about a line at angle b cuts a plane at distance 1 in an ellipse
    a, b = math.asin(0.2 / distance), math.acos(axis)
    ellipse = math.pi * math.sin(a) ** 2 * math.cos(a) / (math.cos(b) ** 2 - math.sin(a) ** 2) ** 1.5
    expected = ellipse / (2 * math.tan(math.radians(14))) ** 2
    share = shown_shares(row(BALL)[None], stage(), 300)
    assert share == pytest.approx([expected], rel=3e-3)


@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_a_cube_is_seen_within_the_hull_of_its_corners(turn: float) -> None:
    from scipy.spatial import ConvexHull

    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, 2)], float)
    cos, sin = math.cos(turn), math.sin(turn)
    corners = 0.2 * signs @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + [0.1, -0.2, 0]
    area = ConvexHull(seen_points(0.3, corners, 300)).volume / 300**2
    cube = solid(CUBE, (0.1, -0.2), 0.2, turn, RED, False)
    assert shown_shares(cube[None], stage(), 300) == pytest.approx([area], rel=5e-3)


def test_a_cylinder_seen_from_above_is_a_disc_and_from_the_side_a_square() -> None:
    focal = 1 / (2 * math.tan(math.radians(14)))
    above = shown_shares(row(CYLINDER, 0.1)[None], stage(1e-6), 300)
    assert above == pytest.approx([math.pi * (0.1 * focal / (2.732 - 0.2)) ** 2], rel=1e-2)
    beside = shown_shares(row(CYLINDER, 0.1)[None], stage(0.5), 300)  # the nearest line is at the front
    assert beside == pytest.approx([(0.2 * focal / (2.732 - 0.1)) * (0.2 * focal / 2.732)], rel=3e-2)


@pytest.mark.parametrize("shape", [BALL, CYLINDER, CUBE])
def test_a_quarter_of_a_turn_changes_no_solid_and_any_turn_no_round_one(shape: int) -> None:
    turns = (0.3, 0.3 + math.pi / 2) if shape == CUBE else (0.3, 1.7)
    one, other = (trace(row(shape, turn=turn)[None], stage(), 24, 2)[0].astype(int) for turn in turns)
    assert np.abs(one - other).max() <= 1


def test_what_is_nearer_hides_what_is_behind_it() -> None:
    near, far = row(CUBE, 0.2, x=0.5), row(BALL, 0.1, x=-0.3)
    _, owners = trace(np.stack([far, near]), stage(0.5), 32, 2)
    assert set(np.unique(owners)) == {0, 2}
    _, owners = trace(np.stack([near, far]), stage(0.2), 32, 2)
    assert set(np.unique(owners)) == {0, 1, 2}


def test_a_shadow_lies_behind_a_solid_as_seen_from_the_lamp_and_is_soft() -> None:
    bare, _ = trace(np.zeros((0, 12), np.float32), stage(), 64, 3)
    scene, owners = trace(row(CYLINDER, 0.1)[None], stage(), 64, 3)
    loss = np.where(owners == 0, bare.astype(int).sum(0) - scene.astype(int).sum(0), 0)
    assert loss[:, :32].sum() > 5 * loss[:, 32:].sum()  # the lamp stands at +y, which is right
    assert loss.max() > 60
    edges = ((loss > 15) & (loss < 0.6 * loss.max())).sum()
    assert edges > 10  # neither in the light nor in the dark
    hard, _ = trace(row(CYLINDER, 0.1)[None], stage(lamp_side=0.0), 64, 3)
    assert hard.astype(int).sum() == pytest.approx(scene.astype(int).sum(), rel=0.01)


def test_light_weakens_with_the_square_of_the_distance() -> None:
    def lit(factor: float) -> float:
        lamps = np.array([[0.0, 1e-3, 30.0 * factor]] * 3)
        picture, _ = trace(np.zeros((0, 12), np.float32), stage(1e-6, lamps=lamps, powers=(400.0, 0, 0)), 3, 1)
        return float(to_linear(picture[:, 1, 1] / 255)[0])

    ambient = 0.4 * 0.18
    assert (lit(1) - ambient) / (lit(2) - ambient) == pytest.approx(4, rel=0.1)


def test_metal_mirrors_what_stands_before_it_and_rubber_does_not() -> None:
    green = solid(BALL, (0.45, 0.1), 0.1, 0, (0.02, 0.8, 0.02), False)
    grey = [solid(CUBE, (0.0, 0.0), 0.2, 0, (0.5, 0.5, 0.5), metal) for metal in (True, False)]

    def greenness(cube: np.ndarray) -> int:
        picture, owners = trace(np.stack([cube, green]), stage(0.45), 48, 1)
        return int(((picture[1].astype(int) - picture[0]) * (owners == 1)).max())

    assert greenness(grey[0]) > 40
    assert greenness(grey[1]) <= 2


def test_nothing_at_all_is_a_plane() -> None:
    picture, owners = trace(np.zeros((0, 12), np.float32), stage(), 16, 1)
    assert picture.shape == (3, 16, 16)
    assert not owners.any()
    assert shown_shares(np.zeros((0, 12), np.float32), stage(), 8).shape == (0,)
    assert picture.min() > 30


def test_srgb_there_and_back() -> None:
    levels = np.arange(256)
    assert (to_srgb(to_linear(levels / 255)) == levels).all()
    assert to_srgb(np.array([-1, 2], np.float32)).tolist() == [0, 255]
    assert to_linear(0.5) == pytest.approx(0.214041, abs=1e-6)


def test_what_is_no_solid_is_refused() -> None:
    with pytest.raises(ValueError, match="up to 254 rows"):
        trace(np.zeros((1, 3), np.float32), stage(), 8, 1)
    with pytest.raises(ValueError, match="at least one pixel and one sample"):
        trace(row(BALL)[None], stage(), 8, 0)
