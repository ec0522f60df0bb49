"""People before a camera: wholly in the picture, from all sides, and drawn where their joints are."""

import numpy as np
import pytest
import torch

from rendra.body import SMPL
from rendra_lab.synthesis.backgrounds import draw_background
from rendra_lab.synthesis.people import LARGEST_BETA, Crowd, Painter, draw_crowd


@pytest.fixture(scope="module")
def body() -> SMPL:
    return SMPL.free(low=True)


@pytest.fixture(scope="module")
def crowd(body: SMPL) -> Crowd:
    return draw_crowd(body, 150, (120, 90), seed=2)


def projected(crowd: Crowd, points: torch.Tensor) -> torch.Tensor:
    return crowd.focal_px[:, None, None] * points[..., :2] / points[..., 2:] + crowd.center_px[:, None]


def test_everybody_is_wholly_in_the_picture_and_fills_it(crowd: Crowd) -> None:
    pixels = projected(crowd, crowd.verts)
    whole = torch.tensor([90.0, 120.0])
    assert bool((pixels > 0.04 * whole).all())
    assert bool((pixels < 0.96 * whole).all())
    share = ((pixels.amax(1) - pixels.amin(1)) / whole).amax(1)
    assert 0.59 < float(share.min()) < float(share.max()) < 0.87
    assert float(crowd.verts[..., 2].min()) > 0.3


def test_the_truth_makes_the_bodies_again(body: SMPL, crowd: Crowd) -> None:
    again = body(crowd.betas, crowd.pose, crowd.translation)
    torch.testing.assert_close(again.verts, crowd.verts, atol=2e-4, rtol=0)
    torch.testing.assert_close(again.joints, crowd.joints, atol=2e-4, rtol=0)
    assert float(crowd.betas.abs().max()) <= LARGEST_BETA
    assert 0.85 < float(crowd.betas.std()) < 1.05


def test_most_stand_upright_and_they_are_seen_from_all_sides(crowd: Crowd) -> None:
    head, pelvis = crowd.joints[:, 15], crowd.joints[:, 0]
    above = (pelvis - head)[:, 1] / (pelvis - head).norm(dim=1)  # y is down
    assert 0.6 < float((above > 0.7).float().mean()) < 0.95
    assert float((above < 0).float().mean()) > 0.01  # upside down
    left_to_right = (crowd.joints[:, 17] - crowd.joints[:, 16])[above > 0.7]
    facing = left_to_right[:, 0] < 0  # who looks at the camera has the left shoulder on the right of the picture
    assert 0.5 < float(facing.float().mean()) < 0.85


def test_focal_lengths_vary_and_centers_are_in_the_middle(crowd: Crowd) -> None:
    assert 100 < float(crowd.focal_px.min()) < 200
    assert 400 < float(crowd.focal_px.max()) < 600.1
    assert torch.equal(crowd.center_px, torch.tensor([[45.0, 60.0]]).expand(150, 2))


def test_no_people_and_the_same_people_again(body: SMPL) -> None:
    assert draw_crowd(body, 0, (64, 64)).verts.shape == (0, len(body.v_template), 3)
    one, same, other = (draw_crowd(body, 4, (64, 64), seed) for seed in (1, 1, 2))
    assert torch.equal(one.verts, same.verts)
    assert not torch.equal(one.verts, other.verts)


def test_a_picture_shows_the_person_where_the_joints_are(body: SMPL, crowd: Crowd) -> None:
    """The same every time, and what is drawn covers the pixels that the vertices are projected to."""
    painter = Painter(body)
    picture = painter.paint(crowd, 3)
    assert picture.shape == (120, 90, 3)
    assert picture.dtype == np.uint8
    assert np.array_equal(picture, painter.paint(crowd, 3))
    assert not np.array_equal(picture, painter.paint(crowd, 3, seed=5))
    seen = painter._renderer(crowd, 3, torch.Generator().manual_seed(0))
    from rendra.renderer import TexturesVertex
    from rendra.structures import Meshes

    mesh = Meshes([crowd.verts[3]], [body.faces], TexturesVertex([torch.ones_like(crowd.verts[3])]))
    alpha = seen(mesh)[0, ..., 3]
    rows, columns = (alpha > 0.5).nonzero().float().unbind(1)
    pixels = projected(crowd, crowd.verts)[3] * 2
    assert float(columns.min()) == pytest.approx(float(pixels[:, 0].min()), abs=1.5)
    assert float(columns.max()) == pytest.approx(float(pixels[:, 0].max()), abs=1.5)
    assert float(rows.min()) == pytest.approx(float(pixels[:, 1].min()), abs=1.5)
    assert float(rows.max()) == pytest.approx(float(pixels[:, 1].max()), abs=1.5)


def test_clothes_cover_a_body_in_several_colours(body: SMPL) -> None:
    wardrobe = Painter(body).wardrobe
    colors = wardrobe.dress(torch.Generator().manual_seed(1))
    assert colors.shape == (len(body.v_template), 3)
    assert 4 <= len(colors.unique(dim=0)) <= 6
    assert 0 < int(wardrobe.hair.sum()) < 0.3 * len(body.v_template)


@pytest.mark.parametrize("seed", range(8))
def test_backgrounds_are_pictures_that_vary(seed: int) -> None:
    picture = draw_background((40, 30), torch.Generator().manual_seed(seed))
    assert picture.shape == (40, 30, 3)
    assert 0 <= float(picture.min()) <= float(picture.max()) <= 1
    assert float(picture.std()) > 0.01


def test_a_body_of_other_joints_is_refused(body: SMPL) -> None:
    import types

    stranger = types.SimpleNamespace(joint_names=("root",), num_joints=1)
    with pytest.raises(ValueError, match="24 joints, got one of 1"):
        draw_crowd(stranger, 1, (64, 64))  # type: ignore[arg-type]
