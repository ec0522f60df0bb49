"""What pixels show out of what their rays saw."""

from types import SimpleNamespace

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401
from lightning.pytorch import LightningModule
from numbered_views import posed

from rendra_lab.data.ray_views import RayBatch, RayCaster
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import RadiancePrediction, Rays, RaysSeen, mean_over_rays, scene_of, view_panels

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def batch(side: int = 2, background: str = "random", count: int = 7) -> RayBatch:
    chosen = torch.randint(43, (count,))
    return RayCaster(BOX, None, background, side).pixels(posed(), chosen, torch.Generator().manual_seed(0))


def view(side: int = 1) -> RayBatch:
    return RayCaster(BOX, None, "white", side).view(posed([(12, 16)]), 0)


def seen(batch: RayBatch, coarse: bool = False) -> RaysSeen:
    count = batch.nearest.numel()
    opacity = torch.rand(count)
    first = (torch.rand(count, 3), torch.rand(count)) if coarse else (None, None)
    return RaysSeen(opacity[:, None] * torch.rand(count, 3), opacity, opacity * 3.0, *first)


def test_a_pixel_is_the_mean_of_its_rays_over_the_background() -> None:
    pixels = batch()
    rays = seen(pixels, coarse=True)
    shown = mean_over_rays(rays, pixels)
    for index in range(7):
        mine = slice(4 * index, 4 * index + 4)
        opacity = rays.opacity[mine].mean()
        assert_close(shown.opacity[index], opacity)
        assert_close(shown.rgb[index], rays.rgb[mine].mean(0) + (1 - opacity) * pixels.background[index])
        left = 1 - rays.opacity_coarse[mine].mean()
        assert_close(shown.rgb_coarse[index], rays.rgb_coarse[mine].mean(0) + left * pixels.background[index])


def test_depth_is_the_mean_of_the_light_that_is_stopped() -> None:
    pixels = batch()
    assert_close(mean_over_rays(seen(pixels), pixels).depth, torch.full((7,), 3.0))
    nothing = RaysSeen(torch.zeros(28, 3), torch.zeros(28), torch.zeros(28))
    shown = mean_over_rays(nothing, pixels)
    assert_close(shown.depth, torch.zeros(7))
    assert_close(shown.rgb, pixels.background)
    assert shown.rgb_coarse is None


def test_whole_views_are_pixels_too() -> None:
    whole = view(side=2)
    rays = seen(whole)
    shown = mean_over_rays(rays, whole)
    assert shown.rgb.shape == (1, 12, 16, 3)
    assert_close(shown.opacity[0, 1, 2], rays.opacity[4 * 18 : 4 * 19].mean())


def test_rays_lie_in_the_order_of_their_pixels() -> None:
    whole = view(side=2)
    rays = Rays.of(whole)
    assert rays.origins.shape == (12 * 16 * 4, 3)
    assert_close(rays.directions[4 * 18 + 3], whole.directions[0, 1, 2, 3])
    piece = rays.slice(5, 9)
    for name in Rays.names():
        assert torch.equal(getattr(piece, name), getattr(rays, name)[5:9])
    assert len(rays.slice(0, 0).nearest) == 0


@pytest.mark.parametrize("coarse", [True, False])
def test_pieces_are_joined_in_order(coarse: bool) -> None:
    parts = [seen(batch(), coarse), seen(batch(count=0), coarse), seen(batch(count=2), coarse)]
    whole = RaysSeen.join(parts)
    assert_close(whole.depth, torch.cat([part.depth for part in parts]))
    assert (whole.rgb_coarse is not None) == coarse


def test_views_are_shown_and_single_pixels_are_not() -> None:
    whole, pixels = view(), batch()
    panels = view_panels(mean_over_rays(seen(whole), whole), whole)
    assert list(panels) == ["target", "rendering", "error x 4", "depth", "normals"]
    for panel in panels.values():
        assert panel.shape[-3:-1] == (12, 16)
        assert float(panel.min()) >= 0
        assert float(panel.max()) <= 1
    assert view_panels(mean_over_rays(seen(pixels), pixels), pixels) == {}


def test_the_error_is_shown_four_times_as_large() -> None:
    whole = view()
    flat = torch.zeros(1, 12, 16)
    prediction = RadiancePrediction(whole.rgb + 0.1, flat, flat)
    assert_close(view_panels(prediction, whole)["error x 4"], torch.full((1, 12, 16, 1), 0.4), atol=1e-5)
    prediction = RadiancePrediction(whole.rgb + 0.5, flat, flat)
    assert_close(view_panels(prediction, whole)["error x 4"], torch.ones(1, 12, 16, 1))


def test_views_are_shown_where_they_lie(far) -> None:  # noqa: F811
    whole = view(side=2)
    rays, whole = seen(whole).to(far), whole.to(far)
    shown = mean_over_rays(rays, whole)
    assert all(isinstance(getattr(shown, name), Far) for name in ("rgb", "opacity", "depth"))
    assert all(isinstance(panel, Far) for panel in view_panels(shown, whole).values())


def test_data_of_another_kind_is_refused() -> None:
    task = LightningModule()
    task._trainer = SimpleNamespace(datamodule=object())
    with pytest.raises(UserError, match=r"posed views of one scene, and object has none: take data=cow_views"):
        scene_of(task)
