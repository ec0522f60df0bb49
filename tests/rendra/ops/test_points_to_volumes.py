"""Laws of splatting: votes are neither lost nor gained, and land where grid_sample reads."""

import pytest
import torch
import torch.nn.functional as F
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.ops import add_pointclouds_to_volumes, add_points_features_to_volume_densities_features
from rendra.structures import Pointclouds, Volumes

MODES = ("nearest", "trilinear")
splat = add_points_features_to_volume_densities_features


def inner_points(count: int, batch: int = 2, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """Points within the centres of the outermost voxels of grids of 3 and more, for both conventions."""
    return 1.2 * torch.rand(batch, count, 3, dtype=dtype) - 0.6


def grids(batch: int = 2, channels: int = 1, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.zeros(batch, channels, 3, 4, 5, dtype=dtype)


@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_weights_and_features_are_conserved(mode: str, align_corners: bool) -> None:
    points, features = inner_points(50), torch.rand(2, 50, 4)
    densities, summed = splat(
        points, features, grids(), None, mode, rescale_features=False, align_corners=align_corners
    )
    assert_close(densities.sum((1, 2, 3, 4)), [50, 50])
    assert_close(summed.sum((2, 3, 4)), features.sum(1), atol=1e-4)
    assert (densities >= 0).all()


@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize(("mode", "read"), [("nearest", "nearest"), ("trilinear", "bilinear")])
def test_splatting_is_the_transpose_of_sampling(mode: str, read: str, align_corners: bool) -> None:
    """<splat f, g> = <f, sample g>, also at and beyond the border, where both pad with 0."""
    points, features = (3 * torch.rand(2, 200, 3, dtype=torch.float64) - 1.5), torch.rand(2, 200, 3).double()
    _, summed = splat(
        points, features, grids(dtype=torch.float64), None, mode, rescale_features=False, align_corners=align_corners
    )
    probe = torch.rand_like(summed)
    sampled = F.grid_sample(probe, points[:, None, None], mode=read, align_corners=align_corners)[:, :, 0, 0]
    assert_close((summed * probe).sum(), (sampled.transpose(1, 2) * features).sum(), rtol=1e-10)


@pytest.mark.parametrize("mode", MODES)
def test_a_point_at_a_centre_fills_one_voxel(mode: str) -> None:
    volumes = Volumes(grids(1), grids(1, 2), voxel_size=0.5, volume_translation=(1.0, 2.0, 3.0))
    place = volumes.get_coord_grid()[0, 2, 1, 3][None]
    filled = add_pointclouds_to_volumes(Pointclouds([place], features=[torch.tensor([[5.0, 7.0]])]), volumes, mode)
    expected = torch.zeros(3, 4, 5)
    expected[2, 1, 3] = 1
    assert_close(filled.densities()[0, 0], expected, atol=1e-5)
    assert_close(filled.features()[0, :, 2, 1, 3], [5, 7], atol=1e-4)


def test_equal_features_stay_equal() -> None:
    points = inner_points(30)
    densities, features = splat(points, torch.full((2, 30, 2), 3.0), grids(), None, "trilinear")
    votes = densities.expand_as(features)
    assert_close(features[votes > 1e-4], torch.full((int((votes > 1e-4).sum()),), 3.0), atol=1e-4)
    assert features[votes == 0].abs().sum() == 0
    densities, features = splat(points, torch.full((2, 30, 2), 3.0), grids(), None, "nearest")
    assert_close(features, 3.0 * (densities > 0).expand_as(features))


@pytest.mark.parametrize("mode", MODES)
def test_points_come_on_top_of_what_was_there(mode: str) -> None:
    points, features = inner_points(20), torch.rand(2, 20, 2)
    first, second = (points[:, :8], features[:, :8]), (points[:, 8:], features[:, 8:])
    densities, summed = splat(*first, grids(), grids(channels=2), mode, rescale_features=False)
    densities, averaged = splat(*second, densities, summed, mode)
    expected = splat(points, features, grids(), None, mode)
    assert_close(densities, expected[0])
    assert_close(averaged, expected[1])


def test_the_least_weight_bounds_what_few_votes_give() -> None:
    points = torch.tensor([[[1e-5 - 1, -1, -1]]])  # a weight of 2e-5 for the second voxel along x
    densities, features = splat(points, torch.ones(1, 1, 1), grids(1), None, min_weight=1e-3)
    assert densities[0, 0, 0, 0, 1].item() == pytest.approx(2e-5, rel=1e-2)
    assert features[0, 0, 0, 0, 1].item() == pytest.approx(2e-2, rel=1e-2)


@pytest.mark.parametrize("mode", MODES)
def test_masked_lost_and_broken_points_add_nothing(mode: str) -> None:
    points = torch.tensor([[[0.0, 0, 0], [9, 0, 0], [0, -1e30, 0], [torch.nan, 0, 0], [0, torch.inf, 0], [0, 0, 0]]])
    points.requires_grad_()
    mask = torch.tensor([[1, 1, 1, 1, 1, 0]])
    densities, features = splat(points, torch.ones(1, 6, 2), grids(1), None, mode, mask=mask)
    assert densities.sum().item() == pytest.approx(1)
    assert_finite(features)
    if mode == "trilinear":
        (densities.square().sum() + features.sum()).backward()
        assert_finite(points.grad)


@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("mode", MODES)
def test_a_batch_of_different_sizes(mode: str, align_corners: bool) -> None:
    sizes, counts = [(3, 4, 5), (5, 1, 2), (2, 2, 2)], [7, 0, 12]
    clouds = Pointclouds([torch.randn(n, 3) for n in counts], features=[torch.rand(n, 2) for n in counts])
    volumes = Volumes(
        [torch.rand(1, *s) for s in sizes], [torch.rand(2, *s) for s in sizes], voxel_size=torch.rand(3, 3) + 0.4,
        volume_translation=torch.rand(3, 3), align_corners=align_corners,
    )  # fmt: skip
    together = add_pointclouds_to_volumes(clouds, volumes, mode)
    assert together.get_grid_sizes().tolist() == [list(s) for s in sizes]
    for i in range(3):
        own = Volumes([volumes.densities_list()[i]], [volumes.features_list()[i]], align_corners=align_corners)
        own.locator = place_of(volumes, i)
        alone = add_pointclouds_to_volumes(clouds[i], own, mode)
        assert_close(together.densities_list()[i], alone.densities()[0])
        assert_close(together.features_list()[i], alone.features()[0])
    outside = together.densities().sum() - sum(d.sum() for d in together.densities_list())
    assert abs(outside.item()) < 1e-5  # nothing in the padding


def place_of(volumes: Volumes, i: int):
    """The place of one volume, without the padding that it has among others."""
    locator = volumes.locator[i]
    locator.resolution = locator.sizes[0]
    return locator


def test_gradients() -> None:
    points = inner_points(4, batch=1, dtype=torch.float64).requires_grad_()
    features = torch.rand(1, 4, 2, dtype=torch.float64, requires_grad=True)
    densities = torch.rand(1, 1, 3, 3, 3, dtype=torch.float64, requires_grad=True)
    initial = torch.rand(1, 2, 3, 3, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda *given: splat(*given, mask=torch.tensor([[1, 1, 0, 1]])), (points, features, densities, initial)
    )
    assert torch.autograd.gradcheck(
        lambda f, d, v: splat(points.detach(), f, d, v, "nearest"), (features, densities, initial)
    )


@pytest.mark.parametrize("mode", MODES)
def test_nothing_to_add(mode: str) -> None:
    volumes = Volumes(torch.rand(2, 1, 3, 3, 3) + 1, torch.rand(2, 2, 3, 3, 3))
    empty = Pointclouds([torch.zeros(0, 3)] * 2)
    same = add_pointclouds_to_volumes(empty, volumes, mode, rescale_features=False)
    assert torch.equal(same.densities(), volumes.densities())
    assert torch.equal(same.features(), volumes.features())
    none = splat(torch.zeros(0, 5, 3), torch.zeros(0, 5, 2), torch.zeros(0, 1, 3, 3, 3), None, mode)
    assert [tuple(t.shape) for t in none] == [(0, 1, 3, 3, 3), (0, 2, 3, 3, 3)]
    hollow = splat(inner_points(4), torch.rand(2, 4, 2), torch.zeros(2, 1, 0, 3, 3), None, mode)
    assert hollow[1].shape == (2, 2, 0, 3, 3)


def test_devices_are_kept(far) -> None:  # noqa: F811
    clouds = Pointclouds([torch.rand(5, 3), torch.rand(2, 3)], features=[torch.rand(5, 2), torch.rand(2, 2)]).to(far)
    volumes = Volumes(torch.zeros(2, 1, 3, 3, 3, device=far))
    for mode in MODES:
        added = add_pointclouds_to_volumes(clouds, volumes, mode)
        assert isinstance(added.densities(), Far)
        assert isinstance(added.features(), Far)


def test_wrong_input_is_named() -> None:
    clouds = Pointclouds(inner_points(4), features=torch.rand(2, 4, 2))
    volumes = Volumes(grids(), grids(channels=3))
    with pytest.raises(ValueError, match="same batch size; got 1 and 2"):
        add_pointclouds_to_volumes(clouds, volumes[0])
    with pytest.raises(ValueError, match="have to have their 'features' defined"):
        add_pointclouds_to_volumes(Pointclouds(inner_points(4)), volumes)
    with pytest.raises(ValueError, match="have to have their 'features' defined"):
        add_pointclouds_to_volumes(Pointclouds(torch.zeros(2, 0, 3)), Volumes(grids()))
    with pytest.raises(ValueError, match=r"volume_features .* \(2, 2, 3, 4, 5\); got \(2, 3, 3, 4, 5\)"):
        add_pointclouds_to_volumes(clouds, volumes)
    with pytest.raises(ValueError, match=r"volume_densities must have shape \(2, 1, D, H, W\)"):
        add_pointclouds_to_volumes(clouds, Volumes(grids(channels=2)))
    with pytest.raises(ValueError, match="No such interpolation mode 'cubic'; there are nearest, trilinear"):
        add_pointclouds_to_volumes(clouds, Volumes(grids()), mode="cubic")
    points, features = inner_points(4), torch.rand(2, 4, 2)
    with pytest.raises(ValueError, match=r"points_3d must have shape \(N, P, 3\), got \(2, 4, 2\)"):
        splat(features, features, grids(), None)
    with pytest.raises(ValueError, match=r"points_features must have shape .* got \(2, 3, 2\)"):
        splat(points, features[:, 1:], grids(), None)
    with pytest.raises(ValueError, match=r"mask must have shape \(N, P\) = \(2, 4\), got \(4,\)"):
        splat(points, features, grids(), None, mask=torch.ones(4))
    with pytest.raises(ValueError, match=r"grid_sizes must have shape \(2, 3\), got \(3,\)"):
        splat(points, features, grids(), None, grid_sizes=torch.tensor([3, 4, 5]))
