"""Streets: different for each seed, the same for the same, and of one piece in all of their views."""

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.synthesis import street_parts
from rendra_lab.synthesis.painted_faces import PaintedFaces, quads
from rendra_lab.synthesis.posed_views import PosedViews, seen_by, to_other_view
from rendra_lab.synthesis.street_layout import build_street
from rendra_lab.synthesis.street_textures import NAMES, SIDE, RoadMarks, draw_textures
from rendra_lab.synthesis.streets import StreetWorld, kitti_intrinsics
from rendra_lab.synthesis.sunlit_scenes import ContactShade, Daylight, SunlitScene

SIZE = (96, 96)
OPEN = ContactShade(np.ones((2, 2), np.float32), (0.0, 0.0), 1.0)
GREY = (0.5, 0.5, 0.5)
DULL = Daylight((0.0, 1.0, 0.0), (0.0, 0.0, 0.0), GREY, GREY, GREY, 1e6, torch.ones(3, 2, 2))


@pytest.fixture(scope="module")
def streets() -> list[PosedViews]:
    return [StreetWorld().views(seed, 3, SIZE) for seed in (3, 8)]


def pair(views: PosedViews, first: int, second: int) -> tuple[torch.Tensor, ...]:
    """Depth, cameras and the way from the second view to the first."""
    to_first = views.world_to_camera[[first]] @ torch.linalg.inv(views.world_to_camera[[second]])
    return (
        views.depth[[second]],
        views.intrinsics[[second]],
        to_first,
        views.depth[[first]],
        views.intrinsics[[first]],
    )


def test_views_agree_with_each_other_through_depth_and_cameras(streets: list[PosedViews]) -> None:
    for views in streets:
        for first, second in ((0, 1), (1, 0), (2, 0)):
            depth, K, to_first, first_depth, first_K = pair(views, first, second)
            visible = seen_by(depth, K, to_first, first_depth, first_K)[0, 0]
            pixels, _ = to_other_view(depth, K, to_first, first_K)
            grid = 2 * pixels / SIZE[0] - 1
            there = F.grid_sample(views.rgb[[first]] / 255, grid, align_corners=False, padding_mode="border")
            error = (there[0] - views.rgb[second] / 255).abs().mean(0)
            copied = (views.rgb[first] / 255 - views.rgb[second] / 255).abs().mean(0)
            assert 0.4 < float(visible.float().mean()) < 0.99
            assert float(error[visible].mean()) < 0.06
            assert float(error[visible].mean()) < 0.55 * float(copied[visible].mean())
            assert float(error[visible].median()) < 0.03


def test_no_other_depth_agrees_as_well(streets: list[PosedViews]) -> None:
    def error(views: PosedViews, scale: float) -> float:
        depth, K, to_first, *_ = pair(views, 0, 1)
        pixels, _ = to_other_view(depth * scale, K, to_first, K)
        there = F.grid_sample(views.rgb[[0]] / 255, 2 * pixels / SIZE[0] - 1, align_corners=False)
        inside = ((pixels > 0) & (pixels < SIZE[0])).all(-1)[0]
        return float((there[0] - views.rgb[1] / 255).abs().mean(0)[inside].mean())

    for views in streets:
        assert error(views, 1.0) < min(error(views, 0.8), error(views, 1.25))


def test_the_same_seed_is_the_same_street_and_another_is_not(streets: list[PosedViews]) -> None:
    again = StreetWorld().views(3, 3, SIZE)
    for name in PosedViews.names():
        assert torch.equal(getattr(again, name), getattr(streets[0], name)), name
    assert float((streets[0].rgb.float() - streets[1].rgb.float()).abs().mean()) > 20
    state = torch.get_rng_state()
    StreetWorld().views(1, 2, (16, 16))
    assert torch.equal(state, torch.get_rng_state())


def test_frames_lie_within_the_offset_along_the_road(streets: list[PosedViews]) -> None:
    for views in streets:
        centres = -torch.einsum("vji,vj->vi", views.world_to_camera[:, :3, :3], views.world_to_camera[:, :3, 3])
        apart = (centres[:, None] - centres[None]).norm(dim=-1)[~torch.eye(3, dtype=torch.bool)]
        assert float(apart.min()) > 0.75
        assert float(apart.max()) < 5 * 1.2 + 0.5
        torch.testing.assert_close(centres[:, 1], torch.full((3,), -1.65), atol=0.05, rtol=0)
        turned = views.world_to_camera[:, :3, :3]
        torch.testing.assert_close(turned @ turned.mT, torch.eye(3).expand(3, 3, 3), atol=1e-5, rtol=0)


def test_pictures_have_detail_and_the_ground_no_holes(streets: list[PosedViews]) -> None:
    for views in streets:
        assert views.rgb.dtype == torch.uint8
        assert bool(torch.isfinite(views.depth[:, :, SIZE[0] // 2 + 6 :]).all())  # below the horizon
        assert float(views.depth.min()) > 0.5
        assert float(views.rgb.float().std(dim=(2, 3)).mean()) > 25
        steps = views.rgb.float().diff(dim=3).abs().mean()
        assert float(steps) > 4


def test_the_camera_drives_on_the_road_and_in_nothing() -> None:
    for seed in range(8):
        street = build_street(np.random.default_rng(seed), clear=8.0)
        corners = street.faces.corners
        x, y, z = corners.min(1), corners.max(1), corners.mean(1)
        reach = street.spare + 0.3
        near = (z[:, 2] > -1.2) & (corners[..., 2].max(1) < 8.0)
        in_lane = (x[:, 0] < street.lane + reach) & (y[:, 0] > street.lane - reach)
        above_road = (y[:, 1] > 0.2) & (x[:, 1] < 2.2)
        assert not (near & in_lane & above_road).any(), seed
        assert abs(street.lane) < street.marks.half_width - 1.0


def test_intrinsics_are_kittis() -> None:
    K = kitti_intrinsics((376, 1241))
    assert K[0, 0] == K[1, 1] == pytest.approx(718.856)
    squeezed = kitti_intrinsics((256, 256))
    assert float(squeezed[0, 0]) == pytest.approx(148.29, abs=0.01)
    assert float(squeezed[1, 1]) == pytest.approx(489.43, abs=0.01)


def test_textures_repeat_and_stay_in_range() -> None:
    drawn = draw_textures(np.random.default_rng(0), RoadMarks(4.0, (0.0,), (-3.0,)))
    assert drawn.shape == (len(NAMES), SIDE, SIDE, 4)
    assert 0 <= float(drawn.min()) <= float(drawn.max()) <= 1
    asphalt = drawn[NAMES.index("verge"), ..., 0]
    assert np.abs(asphalt[0] - asphalt[-1]).mean() < 2 * np.abs(np.diff(asphalt, axis=0)).mean()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_offset": 0}, "data.world.max_offset"),
        ({"step_m": (1.2, 0.8)}, "step_m must be"),
        ({"step_m": (1.0,)}, "step_m must be"),
    ],
)
def test_impossible_settings(settings: dict, message: str) -> None:
    with pytest.raises(UserError, match=message):
        StreetWorld(**settings)


def test_more_views_than_frames() -> None:
    with pytest.raises(UserError, match="leaves 3 frames to choose from; got 4 views"):
        StreetWorld(max_offset=2).views(0, 4, (16, 16))


def test_cars_have_no_gaps_in_their_sides() -> None:
    """Seen from behind and aside, nothing of what stands beyond shows through a car of each kind."""
    for number in range(len(street_parts._CAR_KINDS)):
        body = street_parts._car(number)
        beyond = quads([[(-9, 9, 15), (9, 9, 15), (9, -9, 15), (-9, -9, 15)]], [(0, 0)] * 4, 0)
        faces = PaintedFaces.joined([body.placed((0.5, -1.2, 6.5), 0.35), beyond])
        scene = SunlitScene(faces, torch.ones(64, 2, 2, 4), DULL, OPEN)
        _, depth = scene.take(torch.tensor([[300.0, 0, 128], [0, 300, 128], [0, 0, 1]]), torch.eye(4), (256, 256))
        nearness = 1 / depth[None]
        closed = -F.max_pool2d(-F.max_pool2d(nearness, 5, 1, 2), 5, 1, 2)
        slits = (closed > 1.1 * nearness)[0, 0, : 128 + 40]  # higher than the wheels
        assert int((depth < 14).sum()) > 8000
        assert int(slits.sum()) <= 6, number  # notches of the outline
