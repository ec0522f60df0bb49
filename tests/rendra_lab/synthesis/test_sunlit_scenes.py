"""A place of a few rectangles, whose pictures are known in closed form."""

import numpy as np
import pytest
import torch

from rendra_lab.synthesis.painted_faces import PaintedFaces, box, flat, quads, tube, wall
from rendra_lab.synthesis.sunlit_scenes import ContactShade, Daylight, SunlitScene

OPEN = ContactShade(np.ones((4, 4), np.float32), (-1.0, -1.0), 0.5)
K = torch.tensor([[20.0, 0, 16], [0, 30.0, 12], [0, 0, 1]])
SIZE = (24, 32)
RED, PLAIN = 0, 1


def textures() -> torch.Tensor:
    both = torch.ones(2, 4, 4, 4)
    both[RED, ..., :] = torch.tensor([0.8, 0.2, 0.1, 0.0])  # untinted
    return both


def daylight(sun: float) -> Daylight:
    light, none = (0.5,) * 3, (0.0,) * 3
    dome = torch.zeros(3, 8, 8)
    dome[2] = 0.25
    return Daylight((0.0, 0.6, -0.8), (sun,) * 3, light, light, none, 1e9, dome)


def taken(*parts: PaintedFaces, sun: float = 0.0) -> tuple[torch.Tensor, torch.Tensor]:
    scene = SunlitScene(PaintedFaces.joined(parts), textures(), daylight(sun), OPEN)
    return scene.take(K, torch.eye(4), SIZE)


def poster(
    z: float, texture: int, half: float = 50.0, tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> PaintedFaces:
    corners = [(-half, half, z), (half, half, z), (half, -half, z), (-half, -half, z)]
    return quads([corners], [(0, 0), (1, 0), (1, 1), (0, 1)], texture, tint)


def test_depth_is_that_of_the_nearest_surface_and_infinite_in_the_sky() -> None:
    _, depth = taken(poster(6.0, RED, 1.0), poster(9.0, RED, 1.2))
    assert depth.shape == (1, *SIZE)
    assert float(depth[0, 12, 16]) == pytest.approx(6.0, abs=1e-5)
    assert torch.isinf(depth[0, 0, 0])
    finite = depth[torch.isfinite(depth)]
    assert set(finite.round(decimals=3).tolist()) <= {6.0, 9.0}
    # 2 m at 6 m with 20 and 30 px: 6.67 and 10 pixels
    assert int(((depth - 6).abs() < 1e-3).sum()) == 6 * 10


def test_no_ray_slips_between_two_triangles() -> None:
    wide = torch.tensor([[16.0, 0, 16], [0, 16.0, 16], [0, 0, 1]])
    scene = SunlitScene(poster(4.0, RED, 8.0), textures(), daylight(0.0), OPEN)
    _, depth = scene.take(wide, torch.eye(4), (32, 32))  # the diagonal runs through the middles of pixels
    assert bool(torch.isfinite(depth).all())


def test_the_floor_has_the_depth_of_its_plane() -> None:
    floor = flat((-50, 50), -1.5, (0.1, 90), RED, (1.0, 1.0))
    _, depth = taken(floor)
    rows = torch.arange(13, 24)
    torch.testing.assert_close(depth[0, 13:, 3], 1.5 * 30 / (rows + 0.5 - 12), rtol=1e-4, atol=1e-4)


def test_colours_are_texture_tint_and_light() -> None:
    rgb, _ = taken(poster(6.0, RED, tint=(0.0, 0.0, 1.0)))
    expected = torch.tensor([0.8, 0.2, 0.1]) * 0.5**0.5 * 255  # light 0.5 on squares of colours
    assert (rgb[:, 2, 20].float() - expected).abs().max() <= 1
    tinted, _ = taken(poster(6.0, PLAIN, tint=(0.4, 0.6, 0.2)))
    assert (tinted[:, 2, 20].float() - torch.tensor([0.4, 0.6, 0.2]) * 0.5**0.5 * 255).abs().max() <= 1
    empty, _ = taken(poster(-5.0, RED))
    assert empty[:, 2, 2].tolist() == [0, 0, 128]  # the sky's square root of a quarter


def test_the_sun_shines_on_what_faces_it_and_not_through_walls() -> None:
    lit, _ = taken(poster(6.0, PLAIN, tint=(0.5, 0.5, 0.5)), sun=0.5)
    assert abs(int(lit[0, 3, 3]) - round((0.25 * (0.5 + 0.8 * 0.5)) ** 0.5 * 255)) <= 1
    behind = poster(-3.0, RED, 50.0)  # between the sun, behind the camera, and the poster
    shaded, _ = taken(poster(6.0, PLAIN, tint=(0.5, 0.5, 0.5)), behind, sun=0.5)
    middle = int(shaded[0, 3, 16])  # high enough above the ground for all of the sky's light
    assert abs(middle - round((0.25 * 0.5) ** 0.5 * 255)) <= 1


def test_solids_are_closed_and_stand_where_they_are_put() -> None:
    cube = box((-1, -1, 4), (1, 1, 6), RED, floor=True)
    turned = cube.placed((0.0, 0.0, 0.0), turn=np.pi / 2)
    np.testing.assert_allclose(turned.corners.reshape(-1, 3).min(0), [4, -1, -1], atol=1e-5)  # z becomes x
    edges: dict[tuple, int] = {}
    for corner in cube.corners.round(5).tolist():
        for a, b in ((0, 1), (1, 2), (2, 0)):
            key = tuple(sorted((tuple(corner[a]), tuple(corner[b]))))
            edges[key] = edges.get(key, 0) + 1
    assert set(edges.values()) == {2}
    pipe = tube((0, 0, 0), (0, 3, 0), (0.5, 0.5), RED, sides=8)
    np.testing.assert_allclose(np.hypot(pipe.corners[..., 0], pipe.corners[..., 2]), 0.5, rtol=1e-5)
    assert wall((0, 0), (0, 4), (0, 2), RED, (2.0, 2.0)).uv.reshape(-1, 2).max(0).tolist() == [2.0, 1.0]
