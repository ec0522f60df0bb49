"""Light in rooms: closed forms without blockers, shadows behind boxes, the same on any number of threads."""

import math

import numpy as np
import pytest
import torch

from rendra_lab.synthesis.baked_light import Blockers, Lights, bake, openness

UP = np.array([[0, 1, 0]], np.float32)
NOTHING = Blockers.of([])


def lamp(x: float, y: float, z: float) -> Lights:
    return Lights(np.array([[x, y, z]], np.float32), np.ones((1, 3), np.float32), np.zeros((1, 3), np.float32))


def standing(*box: float, yaw: float = 0.0, place: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Blockers:
    return Blockers.of([(np.array([box], np.float32), yaw, place)])


def test_a_lamp_lights_by_the_cosine_and_the_squared_distance() -> None:
    points = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0]], np.float32)
    light = bake(points, np.repeat(UP, 3, 0), lamp(0, 2, 0), NOTHING)
    assert light[0, 0] == pytest.approx(1 / (1.99**2 + 0.15), rel=1e-4)
    far = 9 + 1.99**2
    assert light[1, 0] == pytest.approx(1.99 / math.sqrt(far) / (far + 0.15), rel=1e-4)
    assert (light[2] == 0).all()  # from behind
    down = bake(np.array([[0, 4, 0]], np.float32), -UP, lamp(0, 2, 0), NOTHING)
    assert 0 < down[0, 0] < 0.5 * light[0, 0]  # a lamp has a shade


def test_a_window_lights_what_lies_before_it() -> None:
    window = Lights(np.array([[0, 1, 0]], np.float32), np.ones((1, 3), np.float32), np.array([[0, 0, 1]], np.float32))
    points = np.array([[0, 0, 1], [0, 0, -1]], np.float32)
    light = bake(points, np.repeat(UP, 2, 0), window, NOTHING)
    assert light[0, 0] > 0.1
    assert light[1, 0] == 0


@pytest.mark.parametrize("yaw", [0.0, 0.8])
def test_boxes_throw_shadows_but_not_on_what_is_within(yaw: float) -> None:
    place = (2.0, 0.0, 1.0)
    table = standing(-0.5, 0.7, -0.5, 0.5, 0.75, 0.5, yaw=yaw, place=place)
    points = np.array([[2, 0, 1], [4, 0, 1], [2, 0.8, 1], [2, 0.72, 1]], np.float32)
    light = bake(points, np.repeat(UP, 4, 0), lamp(2, 2.4, 1), table)
    assert light[0, 0] == 0
    assert (light[1:, 0] > 0).all()
    corner = np.array([[2 + 0.6, 0.72, 1]], np.float32)
    assert bool(table.hold(corner)[0]) == (yaw > 0.5)  # the turned table reaches farther along x
    assert bool(table.hold(corner, 0.15)[0])


def test_corners_of_a_room_and_what_stands_close_are_darker() -> None:
    room = (4.0, 2.6, 4.0)
    points = np.array([[2, 0, 2], [0.05, 0, 0.05], [0.05, 0, 2]], np.float32)
    share = openness(points, np.repeat(UP, 3, 0), 0, room, NOTHING)
    assert share[0] == pytest.approx(1)
    assert share[1] < share[2] < share[0]
    cupboard = standing(2.05, 0, 1, 3, 1, 3)
    beside = openness(points[:1], UP, 0, room, cupboard)
    assert beside[0] < 0.85
    below = np.array([[2.5, 0, 2]], np.float32)
    assert openness(below, UP, 1, room, cupboard)[0] == pytest.approx(0.3)
    assert openness(below, UP, 0, room, cupboard)[0] == pytest.approx(1)


def test_threads_change_nothing() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 4, (500, 3)).astype(np.float32)
    normals = rng.standard_normal((500, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    boxes = np.concatenate([low := rng.uniform(0, 3, (9, 3)), low + rng.uniform(0.1, 1, (9, 3))], 1)
    blockers = Blockers.of(
        [(boxes[:4].astype(np.float32), 0.3, (0, 0, 0)), (boxes[4:].astype(np.float32), 0, (0, 0, 0))]
    )
    results = []
    for threads in (1, 2):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        results.append(
            (bake(points, normals, lamp(2, 2, 2), blockers), openness(points, normals, 9, (4, 4, 4), blockers))
        )
        torch.set_num_threads(before)
    assert np.array_equal(results[0][0], results[1][0])
    assert np.array_equal(results[0][1], results[1][1])


def test_no_corners_and_no_lights() -> None:
    nothing = np.zeros((0, 3), np.float32)
    assert bake(nothing, nothing, lamp(0, 1, 0), NOTHING).shape == (0, 3)
    assert openness(nothing, nothing, 0, (1.0, 1.0, 1.0), NOTHING).shape == (0,)
    dark = bake(np.zeros((2, 3), np.float32), np.repeat(UP, 2, 0), Lights(nothing, nothing, nothing), NOTHING)
    assert (dark == 0).all()
