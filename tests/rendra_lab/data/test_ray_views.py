"""Pixels and their rays: which are drawn when, what they show, where they go, and going on in the middle."""

from typing import Any

import pytest
import torch
from assertions import assert_close
from numbered_views import numbered, posed
from torch import Tensor

from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import (
    RandomPixels,
    RayBatch,
    RayCaster,
    Scene,
    SceneViews,
    WholeViews,
    pixels_near_matter,
    within_box,
)
from rendra_lab.errors import UserError

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


class Given(SceneViews):
    """Views that are there already."""

    def __init__(self, images: PosedImages, **settings: Any) -> None:
        super().__init__(**settings)
        self.images = images

    def load(self) -> Scene:
        none = self.images.select([])
        return Scene(self.images, self.images.select([0]), none, BOX)


def batches(images: PosedImages, **settings: Any) -> RandomPixels:
    data = Given(images, **settings)
    data.setup("fit")
    return data.train_dataloader()


def places(batch: RayBatch, images: PosedImages, view: int = 0) -> Tensor:
    """Where rays pass through an image of pinholes: (R, K, 2) in pixels."""
    in_view = batch.directions @ images.R[view]
    slope = -in_view[..., :2] / in_view[..., 2:]
    return slope * images.intrinsics[view, :2] + images.intrinsics[view, 2:]


def spotted(height: int = 30, width: int = 40, spots: Any = ((5, 7),), count: int = 2) -> PosedImages:
    """Images that are transparent but for single pixels."""
    images = numbered([(height, width)] * count)
    for image in images:
        image[..., 3] = 0
        for row, column in spots:
            image[row, column, 3] = 255
    camera = posed([(height, width)] * count)
    return PosedImages.gather(camera.labels, images, camera.intrinsics, camera.R, camera.T)


def same(first: RayBatch, second: RayBatch) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in RayBatch.names())


# rays and the box


def test_rays_are_in_the_box_between_its_walls_and_nowhere_else() -> None:
    box = torch.tensor([[-1.0, -0.5, 0.0], [2.0, 0.7, 1.5]], dtype=torch.float64)
    origins = torch.randn(500, 3, dtype=torch.float64) * 2
    directions = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=1)
    enter, leave = within_box(origins, directions, box)
    assert (leave >= enter).all()
    assert (enter >= 0).all()
    hits = leave > enter
    assert 50 < int(hits.sum()) < 450
    distance = torch.linspace(0, 12, 400, dtype=torch.float64)[:, None]
    points = origins + distance[..., None] * directions
    inside = ((points > box[0]) & (points < box[1])).all(-1)
    assert torch.equal(inside & ~((distance >= enter) & (distance <= leave)), torch.zeros_like(inside))
    assert torch.equal(~inside & (distance > enter + 1e-9) & (distance < leave - 1e-9), torch.zeros_like(inside))


@pytest.mark.parametrize(
    ("origin", "direction", "expected"),
    [
        ((0.0, 0.0, -3.0), (0.0, 0.0, 1.0), (2.0, 4.0)),  # along an axis
        ((0.0, 0.0, -3.0), (-0.0, -0.0, 1.0), (2.0, 4.0)),
        ((0.5, 0.0, 0.5), (1.0, 0.0, 0.0), (0.0, 0.5)),  # from inside
        ((3.0, 0.0, 0.0), (1.0, 0.0, 0.0), None),  # away from it
        ((2.0, 0.0, -3.0), (0.0, 0.0, 1.0), None),  # beside it, on either side
        ((-2.0, 0.0, -3.0), (0.0, 0.0, 1.0), None),
        ((0.0, 3.0, -3.0), (0.0, 0.0, 1.0), None),
    ],
)
def test_rays_along_axes_from_inside_and_beside(origin: tuple, direction: tuple, expected: tuple | None) -> None:
    enter, leave = within_box(torch.tensor([[origin]]), torch.tensor([[direction]]), BOX)
    assert enter.shape == leave.shape == (1, 1)
    if expected is None:
        assert torch.equal(enter, leave)
        assert torch.isfinite(enter).all()
    else:
        assert_close(torch.cat([enter, leave])[:, 0], list(expected))


def test_depths_narrow_what_the_box_leaves() -> None:
    images = posed([(4, 6)])
    whole = RayCaster(BOX, None).view(images, 0)
    middle = RayCaster(BOX, (2.5, 3.0)).view(images, 0)
    assert_close(middle.nearest, torch.maximum(middle.nearest, whole.nearest.clamp_min(2.5)))
    assert (middle.farthest <= torch.maximum(whole.farthest.clamp_max(3.0), middle.nearest)).all()
    assert (middle.farthest >= middle.nearest).all()
    beyond = RayCaster(BOX, (20.0, 30.0)).view(images, 0)
    assert torch.equal(beyond.nearest, beyond.farthest)


def test_a_bent_space_is_what_the_rays_are_in() -> None:
    images = posed([(4, 6)])
    turned = RayCaster(BOX, None, side=2, warp=lambda origins, directions: (origins + 1, directions.flip(1)))
    straight, bent = RayCaster(BOX, None, side=2).view(images, 0), turned.view(images, 0)
    assert_close(bent.origins, straight.origins + 1)
    assert_close(bent.directions, straight.directions.flip(-1))


# pixels


def test_pixels_are_those_of_their_images() -> None:
    images = posed()
    caster = RayCaster(BOX, None, background="black")
    chosen = torch.tensor([0, 23, 24, 38, 39, 42, 29])
    batch = caster.pixels(images, chosen)
    rgba = images.pixels[chosen].float() / 255
    assert_close(batch.mask, rgba[:, 3])
    assert_close(batch.rgb, rgba[:, :3] * rgba[:, 3:])
    expected = {1: (3, 5, 0), 2: (0, 0, 1), 3: (4, 2, 1), 4: (0, 0, 2), 6: (1, 2, 1)}
    for index, (row, column, view) in expected.items():
        assert images.pixels[chosen[index], :3].tolist() == [row, column, view]
        assert_close(places(batch, images, view)[index, 0], [column + 0.5, row + 0.5], atol=1e-4)
        assert_close(batch.origins[index, 0], images.positions[view])


def test_a_view_is_its_pixels_in_rows() -> None:
    images = posed()
    view = RayCaster(BOX, None).view(images, 1)
    assert view.rgb.shape == (1, 5, 3, 3)
    assert view.origins.shape == (1, 5, 3, 1, 3)
    assert view.batch_size == 1
    flat = RayCaster(BOX, None).pixels(images, torch.arange(24, 39))
    for name in RayBatch.names():
        assert torch.equal(getattr(view, name).reshape(getattr(flat, name).shape), getattr(flat, name))


@pytest.mark.parametrize("side", [1, 2, 3])
def test_the_rays_of_a_pixel_divide_it(side: int) -> None:
    images = posed([(4, 6)])
    xy = places(RayCaster(BOX, None, side=side).view(images, 0), images)[0]  # (H, W, K, 2)
    rows, columns = torch.meshgrid(torch.arange(4.0), torch.arange(6.0), indexing="ij")
    corner = torch.stack([columns, rows], dim=-1)
    assert xy.shape == (4, 6, side**2, 2)
    assert_close(xy.mean(2), corner + 0.5, atol=1e-4)
    cells = ((xy - corner[:, :, None]) * side).floor()
    assert_close((xy - corner[:, :, None]) * side - cells, torch.full_like(xy, 0.5), atol=1e-3)
    assert len({tuple(cell) for cell in cells[1, 2].tolist()}) == side**2


@pytest.mark.parametrize("side", [1, 2])
def test_jitter_stays_in_its_part_of_the_pixel(side: int) -> None:
    images = posed([(4, 6)])
    caster, chosen = RayCaster(BOX, None, side=side), torch.arange(24).repeat(20)
    even = places(caster.pixels(images, chosen), images)
    drawn = places(caster.pixels(images, chosen, torch.Generator().manual_seed(1), jitter=True), images)
    apart = (drawn - even).abs()
    assert float(apart.max()) <= 0.5 / side + 1e-4
    assert float(apart.max()) > 0.48 / side
    assert_close((drawn - even).mean((0, 1)), torch.zeros(2), atol=0.05)
    still = caster.pixels(images, chosen, torch.Generator().manual_seed(1))
    assert torch.equal(places(still, images), even)


@pytest.mark.parametrize(("background", "value"), [("white", 1.0), ("black", 0.0)])
def test_backgrounds_lie_behind_what_is_transparent(background: str, value: float) -> None:
    images = spotted()
    view = RayCaster(BOX, None, background).view(images, 0)
    assert (view.background == value).all()
    assert (view.rgb[view.mask == 0] == value).all()
    assert_close(view.rgb[0, 5, 7], images.image(0)[5, 7, :3])
    assert (view.cut_out == 1).all()


def test_random_backgrounds_are_for_training() -> None:
    images = spotted()
    caster = RayCaster(BOX, None, "random")
    assert (caster.view(images, 0).background == 1).all()
    batch = caster.pixels(images, torch.arange(600), torch.Generator().manual_seed(2))
    assert_close(batch.rgb[batch.mask == 0], batch.background[batch.mask == 0])
    assert_close(batch.background.mean(0), torch.full((3,), 0.5), atol=0.06)
    assert len(batch.background.unique(dim=0)) > 590


def test_images_without_alpha_have_no_mask() -> None:
    view = RayCaster(BOX, None).view(posed([(4, 6)], channels=3), 0)
    assert (view.mask == 1).all()
    assert (view.cut_out == 0).all()


def test_a_camera_without_an_image_sees_the_background() -> None:
    images = posed()
    caster = RayCaster(BOX, None, "black", side=2)
    blank, view = caster.blank_view(images, 1), caster.view(images, 1)
    assert (blank.rgb == 0).all()
    assert (blank.mask == 0).all()
    assert torch.equal(blank.directions, view.directions)
    assert torch.equal(blank.farthest, view.farthest)


# choice


def test_the_rays_of_a_step_are_shared_out_by_schedule() -> None:
    loader = batches(posed(), rays_per_step=37, rays_per_pixel_side=[[0, 1], [2, 2], [4, 3]], steps=6)
    shapes = [tuple(batch.nearest.shape) for batch in loader]
    assert shapes == [(37, 1), (37, 1), (9, 4), (9, 4), (4, 9), (4, 9)]
    few = batches(posed(), rays_per_step=3, rays_per_pixel_side=2, steps=1)
    assert [tuple(batch.nearest.shape) for batch in few] == [(1, 4)]


def test_what_is_not_trained_on_gets_the_last_number_of_rays() -> None:
    data = Given(posed(), rays_per_pixel_side=[[0, 1], [50, 3]])
    data.setup("fit")
    assert data.final_side == 3
    (view,) = data.val_dataloader()
    assert view.nearest.shape == (1, 4, 6, 9)
    assert len(data.test_dataloader()) == len(list(data.test_dataloader())) == 0
    assert len(WholeViews(data.caster, data.scene.train)) == 3


def test_every_pixel_of_every_image_has_its_turn() -> None:
    """Images count alike, whatever their size."""
    images = posed()
    loader = batches(images, rays_per_step=3000, steps=3, background="black")
    origins = torch.cat([batch.origins[:, 0] for batch in loader])
    shares = [float((torch.cdist(origins, at[None]) < 1e-4).float().mean()) for at in images.positions]
    assert shares == pytest.approx([1 / 3] * 3, abs=0.03)
    seen = {tuple(value) for batch in loader for value in (batch.directions[:, 0] * 1e4).round().tolist()}
    assert len(seen) == 43


def test_pixels_near_matter_are_those_within_three_pixels() -> None:
    images = spotted(30, 40, [(5, 7), (0, 39)])
    near = pixels_near_matter(images)
    rows, columns = near[near < 1200] // 40, near[near < 1200] % 40
    expected = {(r, c) for r in range(2, 9) for c in range(4, 11)} | {(r, c) for r in range(4) for c in range(36, 40)}
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == expected
    assert len(near) == 2 * len(expected)
    assert len(pixels_near_matter(images.select([]))) == 0


@pytest.mark.parametrize(("focus", "share"), [(0.0, 0), (0.25, 50), (1.0, 200)])
def test_focus_is_the_share_of_pixels_near_matter(focus: float, share: int) -> None:
    images = spotted(60, 80, [(30, 40)])
    loader = batches(images, rays_per_step=200, focus=focus, steps=4)
    for step in range(4):
        chosen = loader._chosen(step, 200, torch.Generator().manual_seed(step))
        near = torch.isin(chosen, loader._near if focus else pixels_near_matter(images).long())
        assert near[:share].all()
        assert share <= int(near.sum()) <= share + 8  # 49 of 4800 pixels are near: 2 of the others at random


@pytest.mark.parametrize("settings", [{"views_per_step": 1}, {"alpha": False}])
def test_focus_means_nothing_without_alpha_or_all_views(settings: dict[str, Any]) -> None:
    images = spotted()
    if not settings.pop("alpha", True):
        images = posed([(30, 40)] * 2, channels=3)
    for focused, anywhere in zip(
        batches(images, focus=1.0, steps=2, **settings), batches(images, focus=0.0, steps=2, **settings), strict=True
    ):
        assert same(focused, anywhere)


def test_nothing_but_background_is_no_reason_to_fail() -> None:
    (batch,) = batches(spotted(spots=()), focus=1.0, steps=1, rays_per_step=20)
    assert batch.rgb.shape == (20, 3)


def test_first_steps_see_the_middle_of_images() -> None:
    images = posed([(40, 60)], channels=3)
    loader = batches(images, rays_per_step=2000, precrop=0.5, precrop_steps=2, steps=3)
    first, second, third = (places(batch, images)[:, 0] for batch in loader)
    for xy in (first, second):
        assert (xy >= torch.tensor([15.0, 10.0])).all()
        assert (xy <= torch.tensor([45.0, 30.0])).all()
    assert (third.amin(0) < torch.tensor([2.0, 2.0])).all()
    assert (third.amax(0) > torch.tensor([58.0, 38.0])).all()


def test_cropped_steps_are_not_focused() -> None:
    images = spotted(40, 60, [(1, 1)], count=1)
    first, second = batches(images, rays_per_step=50, precrop=0.5, precrop_steps=1, focus=1.0, steps=2)
    assert (places(first, images)[:, 0] > 9).all()
    assert (places(second, images)[:, 0] < 6).all()


@pytest.mark.parametrize("count", [1, 2, 9])
def test_pixels_of_a_step_may_come_from_few_views(count: int) -> None:
    images = posed([(8, 8)] * 5, channels=3)
    seen = [len(batch.origins[:, 0].unique(dim=0)) for batch in batches(images, views_per_step=count, steps=4)]
    assert seen == [min(count, 5)] * 4


# going on


def test_steps_differ_and_follow_from_the_seed() -> None:
    settings = {"rays_per_step": 20, "steps": 3, "jitter": True, "background": "random"}
    first, again, other = (list(batches(spotted(), seed=seed, **settings)) for seed in (4, 4, 5))
    assert all(same(a, b) for a, b in zip(first, again, strict=True))
    assert not any(same(a, b) for a, b in zip(first, other, strict=True))
    assert not same(first[0], first[1])


def test_the_next_epoch_and_a_resumed_one_see_new_pixels() -> None:
    settings = {"rays_per_step": 20, "steps": 5, "jitter": True, "rays_per_pixel_side": [[0, 1], [2, 2]]}
    loader, longer = batches(posed(), **settings), batches(posed(), **{**settings, "steps": 15})
    whole = list(longer)
    assert len(whole) == len(longer) == 3 * len(loader) == 15
    assert all(same(a, b) for a, b in zip([*loader, *loader, *loader], whole, strict=True))
    for done in range(8):
        resumed = batches(posed(), **settings)
        resumed.load_state_dict({"given": done})
        assert all(same(a, b) for a, b in zip(resumed, whole[done : done + 5], strict=True))


def test_random_numbers_of_others_change_nothing() -> None:
    state = torch.get_rng_state()
    first = list(batches(posed(), steps=2, jitter=True))
    assert torch.equal(torch.get_rng_state(), state)
    torch.rand(5)
    assert all(same(a, b) for a, b in zip(first, batches(posed(), steps=2, jitter=True), strict=True))


def test_views_are_loaded_once() -> None:
    data = Given(posed())
    data.setup("fit")
    scene = data.scene
    data.setup("test")
    assert data.scene is scene


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"background": "green"}, r"data\.background must be one of white, black, random, got 'green'"),
        ({"rays_per_step": 0}, r"data\.rays_per_step must be a whole number of at least 1, got 0"),
        ({"views_per_step": 0}, r"data\.views_per_step"),
        ({"steps": 0}, r"data\.steps"),
        ({"precrop": 0.0}, r"data\.precrop must be a number above 0, at most 1, got 0\.0"),
        ({"precrop": 1.5}, r"data\.precrop"),
        ({"focus": -0.1}, r"data\.focus must be a number from 0 to 1"),
        ({"rays_per_pixel_side": 0}, r"data\.rays_per_pixel_side"),
        ({"rays_per_pixel_side": []}, r"data\.rays_per_pixel_side"),
        ({"rays_per_pixel_side": [[1, 1]]}, r"the first 0"),
        ({"rays_per_pixel_side": [[0, 1], [9, 2], [5, 3]]}, r"rising steps"),
    ],
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        Given(posed(), **wrong)
