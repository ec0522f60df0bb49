"""Pictures of functions of space, and who is called with what."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.renderer import (
    AbsorptionOnlyRaymarcher,
    EmissionAbsorptionRaymarcher,
    FoVPerspectiveCameras,
    ImplicitRenderer,
    MonteCarloRaysampler,
    NDCMultinomialRaysampler,
    look_at_view_transform,
    ray_bundle_to_ray_points,
)

SIZES = {"image_width": 24, "image_height": 16, "n_pts_per_ray": 60, "min_depth": 1.0, "max_depth": 4.5}


def ball(radius):
    def field(ray_bundle, **_):
        points = ray_bundle_to_ray_points(ray_bundle)
        inside = torch.sigmoid((radius - points.norm(dim=-1, keepdim=True)) * 100)
        return inside, points.sign().clamp(min=0)

    return field


def views(device="cpu"):
    R, T = look_at_view_transform(2.7, torch.tensor([0.0, 20.0]), torch.tensor([0.0, 70.0]))
    return FoVPerspectiveCameras(R=R.to(device), T=T.to(device), device=device)


def test_a_ball_is_a_disc() -> None:
    renderer = ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), EmissionAbsorptionRaymarcher())
    images, bundle = renderer(views(), ball(0.8))
    assert images.shape == (2, 16, 24, 4)
    slope = torch.sqrt(torch.tensor(2.7**2 - 0.8**2)) / 0.8  # the ball's outline: a cone around the axis
    radius = bundle.xys.norm(dim=-1) * slope / 3**0.5  # 1 at the outline
    assert images[..., 3][radius < 0.9].min() > 0.99
    assert images[..., 3][radius > 1.1].max() < 0.2
    assert images[0, 8, 15, 0] > 0.9 > 0.1 > images[0, 8, 8, 0]  # from +z, world x goes to the right


def test_a_silhouette_needs_no_colour() -> None:
    renderer = ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), AbsorptionOnlyRaymarcher())
    images, _ = renderer(cameras=views(), volumetric_function=ball(0.8))
    full, _ = ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), EmissionAbsorptionRaymarcher())(views(), ball(0.8))
    assert_close(images, full[..., 3:])


def test_rays_drawn_over_all_views_are_a_batch() -> None:
    sampler = MonteCarloRaysampler(-1.0, 1.0, -1.0, 1.0, None, 20, 1.0, 4.0, n_rays_total=30)
    images, bundle = ImplicitRenderer(sampler, EmissionAbsorptionRaymarcher())(views(), ball(0.8))
    assert images.shape == (30, 1, 4)
    assert bundle.camera_counts.sum() == 30


def test_everyone_is_given_what_there_is() -> None:
    calls = {}
    cameras, field = views(), ball(0.5)
    true_bundle = NDCMultinomialRaysampler(**SIZES)(cameras)

    def sampler(**given):
        calls["sampler"] = given
        return true_bundle

    def marcher(**given):
        calls["marcher"] = given
        return given["rays_densities"]

    def function(**given):
        calls["function"] = given
        return field(**given)

    images, bundle = ImplicitRenderer(sampler, marcher)(cameras, function, extra=7)
    assert bundle is true_bundle
    assert images.shape == (2, 16, 24, 60, 1)
    assert set(calls["sampler"]) == {"cameras", "volumetric_function", "extra"}
    assert set(calls["function"]) == {"cameras", "ray_bundle", "extra"}
    assert set(calls["marcher"]) == {"rays_densities", "rays_features", "ray_bundle", "extra"}


def test_settings_of_a_call_reach_the_sampler() -> None:
    renderer = ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), EmissionAbsorptionRaymarcher())
    images, bundle = renderer(views(), ball(0.8), n_rays_per_image=6, n_pts_per_ray=9)
    assert images.shape == (2, 6, 1, 4)
    assert bundle.lengths.shape == (2, 6, 1, 9)


def test_gradients_reach_the_function() -> None:
    radius = torch.tensor(0.8, requires_grad=True)
    renderer = ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), EmissionAbsorptionRaymarcher())
    renderer(views(), ball(radius))[0][..., 3].sum().backward()
    assert_finite(radius.grad)
    assert radius.grad > 0


def test_a_picture_is_made_where_the_cameras_are(far) -> None:  # noqa: F811
    renderer = ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), EmissionAbsorptionRaymarcher())
    images, _ = renderer(views(far), ball(0.8))
    assert isinstance(images, Far)
    assert_close(images.cpu(), renderer(views(), ball(0.8))[0], atol=1e-4)


def test_parts_have_to_be_callable() -> None:
    with pytest.raises(ValueError, match="raysampler has to be callable, got int"):
        ImplicitRenderer(3, EmissionAbsorptionRaymarcher())
    with pytest.raises(ValueError, match="raymarcher has to be callable, got NoneType"):
        ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), None)
    renderer = ImplicitRenderer(NDCMultinomialRaysampler(**SIZES), EmissionAbsorptionRaymarcher())
    with pytest.raises(ValueError, match="volumetric_function has to be callable, got Tensor"):
        renderer(views(), torch.zeros(3))
