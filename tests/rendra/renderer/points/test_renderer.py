"""From clouds to images: weights, compositors, backgrounds, gradients."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.renderer import (
    AlphaCompositor,
    FoVPerspectiveCameras,
    NormWeightedCompositor,
    PointsRasterizationSettings,
    PointsRasterizer,
    PointsRenderer,
    alpha_composite,
    norm_weighted_sum,
)
from rendra.structures.pointclouds import Pointclouds

COMPOSITORS = pytest.mark.parametrize("compositor", [AlphaCompositor, NormWeightedCompositor])


def cloud(size: int = 60, channels: int = 3) -> Pointclouds:
    points = torch.rand(size, 3) * torch.tensor([2.0, 2.0, 1.0]) - torch.tensor([1.0, 1.0, -2.0])
    return Pointclouds([points], features=[torch.rand(size, channels)])


def renderer(compositor, radius=0.1, size=24, **settings) -> PointsRenderer:
    rasterizer = PointsRasterizer(FoVPerspectiveCameras(), PointsRasterizationSettings(size, radius, **settings))
    return PointsRenderer(rasterizer, compositor)


@pytest.mark.parametrize(
    ("compositor", "composite"), [(AlphaCompositor, alpha_composite), (NormWeightedCompositor, norm_weighted_sum)]
)
def test_points_weigh_by_their_distance(compositor, composite) -> None:
    draw, points = renderer(compositor(), size=(20, 30)), cloud()
    fragments = draw.rasterizer(points)
    idx, dists = (part.permute(0, 3, 1, 2) for part in (fragments.idx, fragments.dists))
    expected = composite(idx, 1 - dists / 0.1**2, points.features_packed().t())
    assert_close(draw(points), expected.permute(0, 2, 3, 1))


def test_one_point_is_a_paraboloid() -> None:
    """Opacity 1 at its centre, 0 at its rim; a mean shows its colour unchanged."""
    points = Pointclouds([torch.tensor([[0.0, 0.0, 2.0]])], features=[torch.tensor([[0.2, 0.7, 1.0]])])
    alpha = renderer(AlphaCompositor(), radius=0.5, size=21)(points)
    x = torch.arange(20, -21, -2) / 21
    squared = x**2 + x[:, None] ** 2
    weight = (1 - squared / 0.25).clamp(min=0)[None, ..., None]
    color = torch.tensor([0.2, 0.7, 1.0])
    assert_close(alpha, weight * color)
    mean = renderer(NormWeightedCompositor(), radius=0.5, size=21)(points)
    assert_close(mean, (weight > 0) * color)


@COMPOSITORS
def test_the_background_fills_pixels_without_points(compositor) -> None:
    points = cloud(8)
    plain, color = renderer(compositor())(points), torch.tensor([0.1, 0.5, 0.9])
    empty = renderer(compositor()).rasterizer(points).idx[..., :1] < 0
    expected = torch.where(empty, color, plain)
    assert empty.any()
    for given in ((0.1, 0.5, 0.9), [0.1, 0.5, 0.9], color):
        assert torch.equal(renderer(compositor(background_color=given))(points), expected)
        assert torch.equal(renderer(compositor())(points, background_color=given), expected)
    assert torch.equal(renderer(compositor(color))(points, background_color=None), plain)
    assert torch.equal(renderer(compositor(torch.tensor(0.5)))(points), torch.where(empty, 0.5, plain))


@COMPOSITORS
def test_three_colours_make_an_opaque_background_of_four_channels(compositor) -> None:
    points = cloud(8, channels=4)
    opaque = renderer(compositor((0.1, 0.5, 0.9)))(points)
    assert torch.equal(opaque, renderer(compositor((0.1, 0.5, 0.9, 1.0)))(points))
    assert not torch.equal(opaque, renderer(compositor((0.1, 0.5, 0.9, 0.0)))(points))


@COMPOSITORS
@pytest.mark.parametrize(
    ("color", "message"),
    [
        ((0.1, 0.2), "background_color has 2 channels, the images have 3"),
        ((0.1, 0.2, 0.3, 0.4), "background_color has 4 channels, the images have 3"),
        (torch.zeros(1, 3), r"Wrong shape of background_color.*\(1, 3\)"),
    ],
)
def test_wrong_backgrounds_are_named(compositor, color, message) -> None:
    with pytest.raises(ValueError, match=message):
        renderer(compositor(color))(cloud())


def test_features_are_demanded() -> None:
    with pytest.raises(ValueError, match="these point clouds have none"):
        renderer(AlphaCompositor())(Pointclouds([torch.rand(4, 3)]))


@COMPOSITORS
def test_a_radius_a_point_is_looked_up(compositor) -> None:
    points = cloud(30)
    one = renderer(compositor(), radius=0.1)(points)
    assert_close(renderer(compositor(), radius=torch.full((1, 30), 0.1))(points), one)
    halves = torch.cat((torch.full((15,), 0.1), torch.zeros(15)))
    first = Pointclouds([points.points_packed()[:15]], features=[points.features_packed()[:15]])
    assert_close(renderer(compositor(), radius=halves)(points), renderer(compositor(), radius=0.1)(first))


@COMPOSITORS
@pytest.mark.parametrize("radius", [0.1, torch.zeros(0)])
def test_empty_clouds_show_the_background(compositor, radius) -> None:
    points = Pointclouds([torch.zeros(0, 3)], features=[torch.zeros(0, 3)])
    image = renderer(compositor((0.1, 0.2, 0.3)), radius=radius, size=(4, 6))(points)
    assert torch.equal(image, torch.tensor([0.1, 0.2, 0.3]).expand(1, 4, 6, 3))


@COMPOSITORS
def test_clouds_of_a_batch_do_not_meet(compositor) -> None:
    points = [cloud(20), cloud(50)]
    both = Pointclouds(
        [each.points_packed() for each in points], features=[each.features_packed() for each in points]
    )
    draw = renderer(compositor())
    assert torch.equal(draw(both), torch.cat([draw(each) for each in points]))


@COMPOSITORS
def test_gradients_reach_points_features_and_radii(compositor) -> None:
    draw = renderer(compositor(), size=(6, 7), points_per_pixel=5)
    draw.rasterizer.cameras.R, draw.rasterizer.cameras.T = (
        draw.rasterizer.cameras.R.double(), draw.rasterizer.cameras.T.double(),
    )  # fmt: skip
    start = cloud(8)
    leaves = [
        start.points_packed().double().requires_grad_(), start.features_packed().double().requires_grad_(),
        torch.linspace(0.2, 0.6, 8, dtype=torch.float64).requires_grad_(),
    ]  # fmt: skip

    def image(points, features, radius):
        settings = PointsRasterizationSettings((6, 7), radius, 5)
        return draw(Pointclouds([points], features=[features]), raster_settings=settings)

    assert torch.autograd.gradcheck(image, leaves)


@COMPOSITORS
def test_gradients_are_finite_at_points_of_no_size(compositor) -> None:
    radius = torch.tensor([0.0, 0.3, 0.0]).requires_grad_()
    image = renderer(compositor(), radius=radius)(cloud(3))
    image.sum().backward()
    assert_finite(radius.grad)


def test_a_point_is_pulled_to_where_its_colour_is_wanted() -> None:
    """A descent of a few steps finds a point's place in the image again."""
    draw = renderer(AlphaCompositor(), radius=0.6, size=32)
    color, goal = [torch.ones(1, 3)], torch.tensor([[0.15, -0.1, 2.0]])
    target = draw(Pointclouds([goal], features=color))
    place = torch.tensor([[-0.1, 0.1, 2.0]], requires_grad=True)
    optimizer = torch.optim.Adam([place], lr=0.01)
    for _ in range(100):
        optimizer.zero_grad()
        (draw(Pointclouds([place], features=color)) - target).square().mean().backward()
        optimizer.step()
    assert_close(place.detach()[:, :2], goal[:, :2], atol=0.02)


@COMPOSITORS
def test_images_are_made_where_the_cloud_lies(far, compositor) -> None:  # noqa: F811
    points = cloud(20)
    expected = renderer(compositor((0.1, 0.2, 0.3)))(points)
    leaf = points.points_packed().to(far).requires_grad_()
    there = Pointclouds([leaf], features=[points.features_packed().to(far)])
    image = renderer(compositor((0.1, 0.2, 0.3))).to(far)(there)
    assert isinstance(image, Far)
    assert_close(image.detach().cpu(), expected)
    image.sum().backward()
    assert isinstance(leaf.grad, Far)
