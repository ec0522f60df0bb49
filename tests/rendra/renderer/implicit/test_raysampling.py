"""Rays: where they start and go, which are drawn, and what lies along them."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.renderer import (
    FishEyeCameras,
    FoVOrthographicCameras,
    FoVPerspectiveCameras,
    GridRaysampler,
    HeterogeneousRayBundle,
    MonteCarloRaysampler,
    MultinomialRaysampler,
    NDCGridRaysampler,
    NDCMultinomialRaysampler,
    OrthographicCameras,
    PerspectiveCameras,
    RayBundle,
    look_at_view_transform,
    ray_bundle_to_ray_points,
    ray_bundle_variables_to_ray_points,
)


def posed(kind=FoVPerspectiveCameras, n=3, dtype=torch.float32, device="cpu", **fields):
    R, T = look_at_view_transform(2.7, torch.arange(n) * 10.0, torch.arange(n) * 40.0)
    return kind(R=R.to(device, dtype), T=T.to(device, dtype), device=device, **fields)


def ndc_sampler(width=4, height=2, points=3, **options):
    sizes = {
        "image_width": width,
        "image_height": height,
        "n_pts_per_ray": points,
        "min_depth": 0.5,
        "max_depth": 3.0,
    }
    return NDCMultinomialRaysampler(**(sizes | options))


def monte_carlo(rays=5, points=3, **options):
    return MonteCarloRaysampler(-1.0, 1.0, -0.5, 0.5, rays, points, 0.1, 3.0, **options)


def tensors(bundle):
    return bundle.origins, bundle.directions, bundle.lengths, bundle.xys


# -- the whole grid


def test_rays_of_a_wide_image() -> None:
    bundle = ndc_sampler()(FoVPerspectiveCameras())
    assert_close(bundle.xys[0, 0], [[1.5, 0.5], [0.5, 0.5], [-0.5, 0.5], [-1.5, 0.5]])
    assert_close(bundle.directions[0, 0, 0], [0.75**0.5, 12**-0.5, 1.0])  # 1.5 and 0.5 over sqrt(3)
    assert_close(bundle.origins, torch.zeros(1, 2, 4, 3), atol=1e-6)
    assert_close(bundle.lengths, torch.tensor([0.5, 1.75, 3.0]).expand(1, 2, 4, 3))


@pytest.mark.parametrize(("width", "height"), [(4, 2), (2, 5), (3, 3), (1, 1), (1, 4)])
@pytest.mark.parametrize(
    ("kind", "fields"),
    [
        (FoVPerspectiveCameras, {"fov": 40.0}),
        (FoVOrthographicCameras, {"max_y": 1.5}),
        (PerspectiveCameras, {"focal_length": 1.3, "principal_point": ((0.1, -0.2),)}),
        (OrthographicCameras, {"focal_length": 0.7}),
        (
            PerspectiveCameras,
            {"focal_length": 9.0, "principal_point": ((1.5, 2.0),), "in_ndc": False, "image_size": 1},
        ),
        (FishEyeCameras, {"focal_length": 4.0, "world_coordinates": True}),
    ],
)
def test_points_along_rays_project_to_where_the_rays_were_cast_from(kind, fields, width, height) -> None:
    if "image_size" in fields:
        fields = fields | {"image_size": ((height, width),)}
    cameras = posed(kind, **fields)
    bundle = ndc_sampler(width, height)(cameras)
    points = ray_bundle_to_ray_points(bundle)
    assert points.shape == (3, height, width, 3, 3)
    projected = cameras.transform_points_ndc(points.flatten(1, -2))[..., :2].view(3, height, width, 3, 2)
    assert_close(projected, bundle.xys[..., None, :].expand_as(projected), atol=1e-4)
    view = cameras.get_world_to_view_transform().transform_points(points.flatten(1, -2))
    assert_close(view[..., 2].reshape(bundle.lengths.shape), bundle.lengths, atol=1e-4)  # lengths are depths


@pytest.mark.parametrize(("width", "height"), [(4, 2), (2, 5)])
def test_rays_go_through_pixel_centres(width, height) -> None:
    cameras = posed()
    points = ray_bundle_to_ray_points(ndc_sampler(width, height)(cameras))
    screen = cameras.transform_points_screen(points.flatten(1, -2), image_size=((height, width),))[..., :2]
    x, y = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    centres = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    assert_close(screen.view(3, height, width, 3, 2), centres[:, :, None].expand(3, height, width, 3, 2), atol=1e-4)


def test_perspective_rays_start_at_the_camera() -> None:
    cameras = posed()
    bundle = ndc_sampler(unit_directions=True)(cameras)
    assert_close(bundle.origins, cameras.get_camera_center()[:, None, None].expand(3, 2, 4, 3), atol=1e-5)
    assert_close(bundle.directions.norm(dim=-1), torch.ones(3, 2, 4))


def test_a_grid_runs_from_its_minima_with_both_ends() -> None:
    sampler = MultinomialRaysampler(
        min_x=-1.0, max_x=1.0, min_y=0.2, max_y=0.6, image_width=5, image_height=3, n_pts_per_ray=2, min_depth=1.0,
        max_depth=2.0,
    )  # fmt: skip
    xys = sampler(FoVPerspectiveCameras()).xys[0]
    assert_close(xys[1, :, 0], [-1.0, -0.5, 0.0, 0.5, 1.0])
    assert_close(xys[:, 2, 1], [0.2, 0.4, 0.6])


def test_bundles_can_be_cut_into_lists_of_rays() -> None:
    bundle = ndc_sampler()(posed())
    assert isinstance(bundle, RayBundle)
    assert [each.view(-1, each.shape[-1]).shape[0] for each in bundle] == [24] * 4


def test_former_names_are_the_same_rays() -> None:
    cameras = posed()
    with pytest.warns(PendingDeprecationWarning, match="NDCMultinomialRaysampler"):
        former = NDCGridRaysampler(4, 2, 3, 0.5, 3.0)
    with pytest.warns(PendingDeprecationWarning, match="MultinomialRaysampler"):
        grid = GridRaysampler(1.5, -1.5, 0.5, -0.5, 4, 2, 3, 0.5, 3.0)
    for sampler in (former, grid):
        for given, expected in zip(sampler(cameras), ndc_sampler()(cameras), strict=True):
            assert_close(given, expected)


def test_settings_of_a_call_replace_those_of_the_sampler() -> None:
    sampler = ndc_sampler()
    bundle = sampler(posed(), min_depth=1.0, max_depth=2.0, n_pts_per_ray=5, volumetric_function=None)
    assert_close(bundle.lengths[1, 1, 1], [1.0, 1.25, 1.5, 1.75, 2.0])
    assert sampler(posed(), n_rays_per_image=3).xys.shape == (3, 3, 1, 2)
    assert sampler(posed(), n_pts_per_ray=0).lengths.shape == (3, 2, 4, 0)
    assert_close(sampler(posed(), n_pts_per_ray=1).lengths, torch.full((3, 2, 4, 1), 0.5))
    assert sampler(posed()).lengths.shape == (3, 2, 4, 3)


def test_every_camera_may_have_depths_of_its_own() -> None:
    near = torch.tensor([1.0, 2.0, 3.0])
    bundle = ndc_sampler(min_depth=near, max_depth=near + 1)(posed())
    assert_close(bundle.lengths[:, 1, 2], [[1.0, 1.5, 2.0], [2.0, 2.5, 3.0], [3.0, 3.5, 4.0]])
    drawn = ndc_sampler(min_depth=near, max_depth=near + 1, n_rays_total=40)(posed())
    owners = drawn.camera_ids.repeat_interleave(drawn.camera_counts)
    assert_close(drawn.lengths[:, 0, 0, 0], near[owners])
    with pytest.raises(ValueError, match="one for each of the 3 cameras; got 2"):
        ndc_sampler(min_depth=near[:2])(posed())


# -- chance


def test_stratified_samples_fill_their_strata() -> None:
    even = ndc_sampler(points=6)(posed()).lengths
    middles = 0.5 * (even[..., 1:] + even[..., :-1])
    lower, upper = torch.cat((even[..., :1], middles), -1), torch.cat((middles, even[..., -1:]), -1)
    torch.manual_seed(0)
    moved = ndc_sampler(50, 40, points=6, stratified_sampling=True)(posed()).lengths
    assert ((moved >= lower[:, :1, :1]) & (moved <= upper[:, :1, :1])).all()
    share = (moved - lower[:, :1, :1]) / (upper - lower)[:, :1, :1]
    assert_close(share.mean((0, 1, 2)), torch.full((6,), 0.5), atol=0.02)
    assert_close(share.var((0, 1, 2)), torch.full((6,), 1 / 12), atol=0.005)
    plain = ndc_sampler(points=6, stratified_sampling=True)(posed(), stratified_sampling=False)
    assert_close(plain.lengths, even)


def test_a_choice_holds_different_pixels_while_they_last() -> None:
    cameras, whole = posed(), ndc_sampler()(posed())
    torch.manual_seed(0)
    for count in (1, 5, 8):
        bundle = ndc_sampler(n_rays_per_image=count)(cameras)
        assert bundle.directions.shape == (3, count, 1, 3)
        same = (bundle.xys[:, :, 0, None] == whole.xys.flatten(1, 2)[:, None]).all(-1)  # (3, count, 8)
        assert same.sum(2).eq(1).all()
        assert same.sum(1).max() == 1
        row = same.int().argmax(2)[..., None].expand(-1, -1, 3)
        assert_close(bundle.directions[:, :, 0], whole.directions.flatten(1, 2).gather(1, row))
    assert ndc_sampler(n_rays_per_image=20)(cameras).xys.shape == (3, 20, 1, 2)


def test_pixels_are_drawn_in_proportion_to_the_mask() -> None:
    torch.manual_seed(0)
    mask = torch.tensor([[0.0, 1.0, 3.0], [0.0, 0.0, 4.0]]).expand(2000, 2, 3)
    sampler, cameras = ndc_sampler(3, 2, n_rays_per_image=1), FoVPerspectiveCameras(R=torch.eye(3).expand(2000, 3, 3))
    xys = sampler(cameras, mask=mask).xys[:, 0, 0]
    centres = ndc_sampler(3, 2)(FoVPerspectiveCameras()).xys.flatten(0, 2)
    share = (xys[:, None] == centres).all(-1).float().mean(0)
    assert_close(share, mask[0].flatten() / 8, atol=0.04)
    assert share[[0, 3, 4]].eq(0).all()


def test_masks_without_a_number_give_as_many_rays_as_the_smallest_has() -> None:
    mask = torch.zeros(3, 2, 4, dtype=torch.bool)
    mask[0, 0], mask[1, 1, 2:], mask[2] = True, True, True
    bundle = ndc_sampler()(posed(), mask=mask)
    assert bundle.xys.shape == (3, 2, 1, 2)
    assert bundle.xys[0, :, 0, 1].eq(0.5).all()
    assert bundle.xys[1, :, 0].sort(0).values.tolist() == [[-1.5, -0.5], [-0.5, -0.5]]
    repeated = ndc_sampler()(posed(), mask=mask, n_rays_per_image=7).xys[:, :, 0]
    assert repeated[0, :, 1].eq(0.5).all()  # 7 of 4 pixels: some of them twice
    assert len(repeated[2].unique(dim=0)) == 7
    assert len(ndc_sampler()(posed(), mask=mask, n_rays_per_image=30).xys[2].unique(dim=0)) <= 8


@pytest.mark.parametrize("kind", ["multinomial", "monte_carlo"])
def test_rays_in_all_are_those_of_their_cameras(kind) -> None:
    torch.manual_seed(0)
    cameras = posed(n=5)
    sampler = ndc_sampler(n_rays_total=300) if kind == "multinomial" else monte_carlo(None, n_rays_total=300)
    bundle = sampler(cameras)
    middle = (1, 1) if kind == "multinomial" else (1,)
    assert isinstance(bundle, HeterogeneousRayBundle)
    assert [each.shape for each in tensors(bundle)] == [(300, *middle, width) for width in (3, 3, 3, 2)]
    assert bundle.camera_counts.sum() == 300
    assert bundle.camera_counts.min() > 30
    owners = bundle.camera_ids.repeat_interleave(bundle.camera_counts)
    points = ray_bundle_to_ray_points(bundle).flatten(1, -2)
    for camera in range(5):
        mine = owners == camera
        seen = cameras[camera].transform_points_ndc(points[mine].flatten(0, 1))[..., :2].reshape(-1, 3, 2)
        assert_close(seen, bundle.xys[mine].reshape(-1, 1, 2).expand_as(seen), atol=1e-4)


def test_rays_in_all_heed_the_mask() -> None:
    mask = torch.zeros(3, 2, 4)
    mask[:, 1, 2] = 1.0
    bundle = ndc_sampler()(posed(), mask=mask, n_rays_total=10)
    assert_close(bundle.xys, torch.tensor([-0.5, -0.5]).expand(10, 1, 1, 2))


def test_monte_carlo_fills_its_rectangle() -> None:
    bundle = monte_carlo()(FoVPerspectiveCameras())
    assert [tuple(each.shape) for each in bundle] == [(1, 5, 3), (1, 5, 3), (1, 5, 3), (1, 5, 2)]
    torch.manual_seed(0)
    xys = monte_carlo(4000, unit_directions=True)(posed()).xys
    low, high = torch.tensor([-1.0, -0.5]), torch.tensor([1.0, 0.5])
    assert ((xys >= low) & (xys <= high)).all()
    share = (xys - low) / (high - low)
    assert_close(share.mean((0, 1)), [0.5, 0.5], atol=0.02)
    assert_close(share.flatten(0, 1).T.cov(), torch.eye(2) / 12, atol=0.01)


@pytest.mark.parametrize(
    "make",
    [
        lambda: ndc_sampler(stratified_sampling=True),
        lambda: ndc_sampler(n_rays_per_image=3),
        lambda: ndc_sampler(n_rays_total=6),
        lambda: monte_carlo(stratified_sampling=True),
    ],
)
def test_a_seed_decides(make) -> None:
    drawn = []
    for seed in (3, 3, 4):
        torch.manual_seed(seed)
        drawn.append(torch.cat([each.flatten() for each in tensors(make()(posed()))]))
    assert torch.equal(drawn[0], drawn[1])
    assert drawn[0].shape != drawn[2].shape or not torch.equal(drawn[0], drawn[2])


# -- tensors: none, precise, elsewhere, differentiable


def test_no_camera_has_no_rays() -> None:
    cameras = FoVPerspectiveCameras(R=torch.eye(3)[None], T=torch.zeros(1, 3))[[]]
    assert ndc_sampler()(cameras).directions.shape == (0, 2, 4, 3)
    assert ndc_sampler(n_rays_per_image=3)(cameras).lengths.shape == (0, 3, 1, 3)
    assert monte_carlo()(cameras).xys.shape == (0, 5, 2)
    with pytest.raises(ValueError, match="from 0 cameras"):
        ndc_sampler(n_rays_total=3)(cameras)


def test_rays_follow_the_pose_of_their_cameras() -> None:
    cameras = posed(n=2, dtype=torch.float64)

    def points(R, T):
        return ray_bundle_to_ray_points(ndc_sampler(2, 3, unit_directions=True)(FoVPerspectiveCameras(R=R, T=T)))

    assert points(cameras.R, cameras.T).dtype == torch.float64
    assert torch.autograd.gradcheck(points, (cameras.R.requires_grad_(), cameras.T.requires_grad_()))


def test_points_are_differentiable_with_respect_to_all() -> None:
    shapes = ((2, 4, 3), (2, 4, 3), (2, 4, 5))
    given = [torch.randn(shape, dtype=torch.float64, requires_grad=True) for shape in shapes]
    assert torch.autograd.gradcheck(ray_bundle_variables_to_ray_points, given)


def test_rays_stay_where_the_cameras_are(far) -> None:  # noqa: F811
    cameras = posed(device=far)
    mask = torch.ones(3, 2, 4, device=far)
    bundles = [
        ndc_sampler(stratified_sampling=True)(cameras), ndc_sampler(n_rays_per_image=3)(cameras, mask=mask),
        ndc_sampler(n_rays_per_image=10)(cameras, mask=mask), ndc_sampler(n_rays_total=9)(cameras, mask=mask),
        ndc_sampler(min_depth=torch.ones(3, device=far))(cameras), monte_carlo()(cameras),
        monte_carlo(None, n_rays_total=7)(cameras),
    ]  # fmt: skip
    assert all(isinstance(each, Far) for bundle in bundles for each in tensors(bundle))
    assert_close(ray_bundle_to_ray_points(ndc_sampler()(cameras)).cpu(),
                 ray_bundle_to_ray_points(ndc_sampler()(posed())))  # fmt: skip


# -- complaints


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_rays_per_image": 3, "n_rays_total": 4}, "cannot both be given.*=3.*=4"),
        ({"n_rays_per_image": 0}, "n_rays_per_image must be at least 1, got 0"),
        ({"n_rays_total": -1}, "n_rays_total must be at least 1, got -1"),
        ({"n_pts_per_ray": -2}, "n_pts_per_ray must be at least 0, got -2"),
        ({"image_width": 0}, "image_width and image_height must be at least 1, got 0, 2"),
    ],
)
def test_impossible_samplers_are_refused(options, message) -> None:
    with pytest.raises(ValueError, match=message):
        ndc_sampler(**options)


def test_a_call_can_be_impossible_too() -> None:
    with pytest.raises(ValueError, match="cannot both be given"):
        ndc_sampler(n_rays_total=4)(posed(), n_rays_per_image=3)
    with pytest.raises(ValueError, match="must be given"):
        monte_carlo(None)
    with pytest.raises(ValueError, match="cannot both be given"):
        monte_carlo(5, n_rays_total=6)


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (torch.ones(3, 4, 2), r"\(3, 2, 4\), got \(3, 4, 2\)"),
        (-torch.ones(3, 2, 4), "not negative"),
        (torch.full((3, 2, 4), math.nan), "finite"),
        (torch.ones(3, 2, 4) * torch.tensor([1.0, 0.0, 1.0])[:, None, None], "0 everywhere for camera 1"),
    ],
)
def test_impossible_masks_are_refused(mask, message) -> None:
    with pytest.raises(ValueError, match=message):
        ndc_sampler()(posed(), mask=mask)


def test_gradients_of_unit_directions_are_finite() -> None:
    cameras = posed()
    cameras.T = cameras.T.clone().requires_grad_()
    ndc_sampler(unit_directions=True, stratified_sampling=True)(cameras).directions.square().sum().backward()
    assert_finite(cameras.T.grad)
