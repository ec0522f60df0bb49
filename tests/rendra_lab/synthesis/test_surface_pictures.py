"""Pictures of lit triangles: upright, at their depth, as bright as their light says, nothing where nothing is."""

import pytest
import torch

from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.synthesis.surface_pictures import LitSurfaces, picture_views, toned
from rendra_lab.synthesis.texture_pyramid import TexturePyramid

K = torch.tensor([[[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]])
QUARTERS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.0, 1.0))  # upper and lower, left and right


def picture() -> torch.Tensor:
    colors = torch.tensor(QUARTERS).view(2, 2, 3)
    return colors.repeat_interleave(16, 0).repeat_interleave(16, 1)[None]


def shown(half: float, light: float = 1.0, tint: float = 1.0) -> PosedViews:
    """A square at z = 2 that fills the picture where half of its side is 1; the camera's y is down."""
    verts = torch.tensor([[-half, half, 2.0], [half, half, 2.0], [half, -half, 2.0], [-half, -half, 2.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    corners = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    surfaces = LitSurfaces(
        verts=verts,
        faces=faces,
        places=corners[faces],
        light=torch.full((2, 3, 3), light),
        which=torch.zeros(2, dtype=torch.int64),
        tint=torch.full((2, 3), tint),
        scale=torch.full((2,), 0.5 / half),
    )
    return picture_views(surfaces, TexturePyramid(picture()), K, torch.eye(4)[None], (32, 32))


def test_pictures_are_upright_and_depth_is_z() -> None:
    views = shown(1.0)
    for color, (row, column) in zip(QUARTERS, ((6, 6), (6, 25), (25, 6), (25, 25)), strict=True):
        expected = (toned(torch.tensor(color)) * 255).round().byte()
        assert torch.equal(views.rgb[0, :, row, column], expected)
    torch.testing.assert_close(views.depth, torch.full((1, 1, 32, 32), 2.0))


def test_nothing_is_black_and_infinitely_far() -> None:
    views = shown(0.5)
    assert bool((views.rgb[0, :, :7] == 0).all())
    assert bool(torch.isinf(views.depth[0, 0, :7]).all())
    assert int(torch.isfinite(views.depth).sum()) == 16 * 16


def test_light_and_tint_multiply_and_tones_rise_to_white() -> None:
    assert torch.equal(shown(1.0, 0.5).rgb, shown(1.0, 1.0, 0.5).rgb)
    tones = toned(torch.linspace(0, 8, 100))
    assert float(tones[0]) == 0
    assert float(tones[-1]) == pytest.approx(1)
    assert bool((tones.diff() >= 0).all())
