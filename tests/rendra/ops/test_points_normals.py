"""Normals of planes, spheres and cylinders, which are known."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from torch import Tensor
from torch.nn import functional as F

from rendra.ops import estimate_pointcloud_local_coord_frames, estimate_pointcloud_normals
from rendra.structures import Pointclouds
from rendra.transforms import random_rotation


def sphere(n: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return F.normalize(torch.randn(n, 3, dtype=dtype), dim=1)


def plane(n: int, normal: Tensor) -> Tensor:
    points = torch.randn(n, 3, dtype=normal.dtype)
    return points - (points @ normal)[:, None] * normal


@pytest.mark.parametrize("offset", [0.0, 1000.0])
def test_a_plane_has_one_normal(offset: float) -> None:
    normal = F.normalize(torch.tensor([1.0, -2, 3]), dim=0)
    found = estimate_pointcloud_normals(plane(400, normal)[None] + offset, neighborhood_size=30)
    assert_close((found @ normal).abs(), torch.ones(1, 400), atol=1e-5 if offset == 0 else 1e-3)


def test_a_sphere_is_seen_from_inside() -> None:
    points = sphere(1500)
    found = estimate_pointcloud_normals(points[None], neighborhood_size=20)[0]
    assert_close(found.norm(dim=1), torch.ones(1500))
    assert ((found * -points).sum(1) > 0.95).all()
    free = estimate_pointcloud_normals(points[None], neighborhood_size=20, disambiguate_directions=False)[0]
    assert_close((free * found).sum(1).abs(), torch.ones(1500))


def test_a_cylinder_curves_around_its_axis() -> None:
    angle, height = 6.2832 * torch.rand(1500), 4 * torch.rand(1500)
    points = torch.stack([0.2 * angle.cos(), 0.2 * angle.sin(), height], 1)
    curvatures, frames = estimate_pointcloud_local_coord_frames(points[None], neighborhood_size=300)
    middle = (height > 1) & (height < 3)
    assert (frames[0, middle, 2, 2].abs() > 0.95).all()  # the widest axis is the cylinder's
    assert (curvatures.diff(dim=2) >= 0).all()


def test_frames_are_orthonormal_and_turn_with_their_cloud() -> None:
    points, turn = torch.randn(1, 200, 3, dtype=torch.float64), random_rotation(dtype=torch.float64)
    curvatures, frames = estimate_pointcloud_local_coord_frames(points, neighborhood_size=20)
    assert_close(frames.mT @ frames, torch.eye(3).expand_as(frames), atol=1e-10)
    assert_close(torch.linalg.cross(frames[..., 0], frames[..., 2]), frames[..., 1], atol=1e-10)
    turned_curvatures, turned = estimate_pointcloud_local_coord_frames(points @ turn, neighborhood_size=20)
    assert_close(turned_curvatures, curvatures, atol=1e-10)
    assert_close(turned, turn.T @ frames, atol=1e-8)
    normals = estimate_pointcloud_normals(points, neighborhood_size=20)
    assert_close(normals, frames[..., 0], atol=0)


def test_every_cloud_of_a_batch_is_its_own() -> None:
    clouds = Pointclouds([sphere(60), sphere(90) + 5, torch.zeros(0, 3)])
    together = estimate_pointcloud_normals(clouds, neighborhood_size=15)
    assert together.shape == (3, 90, 3)
    assert together[0, 60:].abs().max() == together[2].abs().max() == 0
    for i in (0, 1):
        alone = estimate_pointcloud_normals(clouds.points_list()[i][None], neighborhood_size=15)[0]
        assert_close(together[i, : len(alone)], alone, atol=1e-4)


def test_clouds_estimate_their_own_normals() -> None:
    clouds = Pointclouds([sphere(60), sphere(90)], features=[torch.ones(60, 1), torch.ones(90, 1)])
    normals = clouds.estimate_normals(neighborhood_size=15)
    assert clouds.normals_packed() is None
    assert torch.equal(clouds.estimate_normals(15, assign_to_self=True), normals)
    assert torch.equal(clouds.normals_padded(), normals)
    assert clouds.normals_packed().shape == (150, 3)


def test_derivatives_are_finite_on_symmetric_neighborhoods() -> None:
    grid = torch.cartesian_prod(torch.arange(5.0), torch.arange(5.0), torch.zeros(1))[None].requires_grad_()
    curvatures, frames = estimate_pointcloud_local_coord_frames(grid, neighborhood_size=9)
    (curvatures.sum() + (frames * torch.randn_like(frames)).sum()).backward()
    assert_finite(grid.grad)
    same = torch.zeros(1, 6, 3, requires_grad=True)
    estimate_pointcloud_normals(same, neighborhood_size=5).sum().backward()
    assert_finite(same.grad)


def test_derivatives() -> None:
    points = torch.randn(1, 12, 3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda p: estimate_pointcloud_local_coord_frames(p, neighborhood_size=6), points)


def test_nothing_in_nothing_out() -> None:
    assert estimate_pointcloud_normals(torch.zeros(2, 0, 3)).shape == (2, 0, 3)
    curvatures, frames = estimate_pointcloud_local_coord_frames(Pointclouds([]))
    assert curvatures.shape == (0, 0, 3)
    assert frames.shape == (0, 0, 3, 3)


def test_normals_stay_on_their_device(far) -> None:  # noqa: F811
    points = sphere(20).to(far)[None]
    assert isinstance(estimate_pointcloud_normals(points, neighborhood_size=5), Far)


@pytest.mark.parametrize("size", [0, 6])
def test_neighborhoods_must_fit_into_the_smallest_cloud(size: int) -> None:
    with pytest.raises(ValueError, match=rf"\[9, 5\]; got {size}"):
        estimate_pointcloud_normals(Pointclouds([sphere(9), sphere(5)]), neighborhood_size=size)
    with pytest.raises(ValueError, match=r"\(minibatch, N, 3\), got \(1, 9, 2\)"):
        estimate_pointcloud_normals(torch.ones(1, 9, 2), neighborhood_size=3)
