"""Laws of volumes as functions of space, and of their pictures."""

import pytest
import torch
import torch.nn.functional as F
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.kernels.march_volume import march_volume
from rendra.renderer import (
    AbsorptionOnlyRaymarcher,
    EmissionAbsorptionRaymarcher,
    FoVOrthographicCameras,
    FoVPerspectiveCameras,
    MonteCarloRaysampler,
    NDCMultinomialRaysampler,
    RayBundle,
    VolumeRenderer,
    VolumeSampler,
    look_at_view_transform,
    ray_bundle_to_ray_points,
)
from rendra.renderer.implicit.volume_march import march_in_one_pass
from rendra.structures import Volumes


def random_rays(batch: int, *shape: int, samples: int = 4, dtype: torch.dtype = torch.float32) -> RayBundle:
    origins, directions = (torch.randn(batch, *shape, 3, dtype=dtype) for _ in range(2))
    lengths = torch.rand(batch, *shape, samples, dtype=dtype).sort().values
    return RayBundle(origins, directions, lengths, origins[..., :2])


def ramps(volumes: Volumes) -> Volumes:
    """The same volumes with the world coordinates of each voxel as their features."""
    return volumes.update_padded(volumes.densities(), volumes.get_coord_grid().movedim(-1, 1))


@pytest.mark.parametrize("shape", [(7,), (3, 5), (2, 1, 3)], ids=str)
def test_a_ramp_gives_positions_back(shape) -> None:
    edges, offsets = torch.rand(2, 3) + 4, 0.1 * torch.randn(2, 3)  # large enough to hold all rays
    volumes = ramps(Volumes(torch.ones(2, 1, 4, 5, 6), voxel_size=edges, volume_translation=offsets))
    rays = random_rays(2, *shape)
    densities, features = VolumeSampler(volumes)(ray_bundle=rays, cameras=None)
    assert densities.shape == (2, *shape, 4, 1)
    assert_close(densities, torch.ones_like(densities))
    assert_close(features, ray_bundle_to_ray_points(rays), atol=1e-4)


@pytest.mark.parametrize("padding_mode", ["zeros", "border", "reflection"])
@pytest.mark.parametrize("sample_mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("align_corners", [True, False])
def test_sampling_is_that_of_grid_sample(align_corners: bool, sample_mode: str, padding_mode: str) -> None:
    volumes = Volumes(torch.rand(2, 2, 3, 4, 5), torch.rand(2, 3, 3, 4, 5), 0.4, align_corners=align_corners)
    rays = random_rays(2, 30)
    places = volumes.world_to_local_coords(ray_bundle_to_ray_points(rays))[:, None]
    read = VolumeSampler(volumes, sample_mode, padding_mode)(rays)
    for grids, values in zip((volumes.densities(), volumes.features()), read, strict=True):
        expected = F.grid_sample(
            grids, places, mode=sample_mode, padding_mode=padding_mode, align_corners=align_corners
        )
        close = (values - expected[:, :, 0].movedim(1, -1)).abs() < 1e-4
        assert (~close).sum() <= (4 if sample_mode == "nearest" else 0)  # halfway between two voxels


@pytest.mark.parametrize("padding_mode", ["zeros", "border", "reflection"])
@pytest.mark.parametrize("align_corners", [True, False])
def test_a_batch_of_different_sizes(align_corners: bool, padding_mode: str) -> None:
    sizes = [(3, 4, 5), (5, 2, 2), (0, 1, 1)]
    densities, features = [torch.rand(1, *s) for s in sizes], [torch.rand(2, *s) for s in sizes]
    edges = torch.rand(3, 3) + 0.2
    volumes = Volumes(densities, features, edges, align_corners=align_corners)
    rays = random_rays(3, 20)
    together = VolumeSampler(volumes, padding_mode=padding_mode)(rays)
    for i in range(3):
        own = Volumes(densities[i][None], features[i][None], edges[i], align_corners=align_corners)
        alone = VolumeSampler(own, padding_mode=padding_mode)(RayBundle(*(part[i : i + 1] for part in rays)))
        assert all(map(torch.allclose, (each[i : i + 1] for each in together), alone))
    assert together[1][2].abs().sum() == 0


def test_volumes_without_features_have_none() -> None:
    densities, features = VolumeSampler(Volumes(torch.ones(1, 1, 2, 2, 2)))(random_rays(1, 3))
    assert densities.shape == (1, 3, 4, 1)
    assert features is None


def test_no_rays_and_no_volumes() -> None:
    volumes = Volumes(torch.ones(2, 1, 2, 2, 2), torch.ones(2, 3, 2, 2, 2))
    assert [tuple(t.shape) for t in VolumeSampler(volumes)(random_rays(2, 0))] == [(2, 0, 4, 1), (2, 0, 4, 3)]
    none = VolumeSampler(volumes[[]])(random_rays(0, 5))
    assert [tuple(t.shape) for t in none] == [(0, 5, 4, 1), (0, 5, 4, 3)]


def test_gradients_reach_voxels_rays_and_places() -> None:
    rays = random_rays(1, 2, dtype=torch.float64)
    leaves = [
        torch.rand(1, 1, 2, 3, 2), torch.rand(1, 2, 2, 3, 2), torch.rand(1, 3) + 1, torch.rand(1, 3),
        rays.origins, rays.directions, rays.lengths,
    ]  # fmt: skip

    def read(densities, features, edges, offsets, *ray_parts):
        return VolumeSampler(Volumes(densities, features, edges, offsets))(RayBundle(*ray_parts, rays.xys))

    assert torch.autograd.gradcheck(read, [leaf.double().requires_grad_() for leaf in leaves])


def looking(distance: float = 3.0, batch: int = 2) -> FoVPerspectiveCameras:
    R, T = look_at_view_transform(distance, 20.0, torch.linspace(0, 90, batch))
    return FoVPerspectiveCameras(R=R, T=T)


def sampler(size: int = 16, samples: int = 40) -> NDCMultinomialRaysampler:
    return NDCMultinomialRaysampler(
        image_width=size, image_height=size, n_pts_per_ray=samples, min_depth=1.0, max_depth=5.0
    )


def test_a_constant_slab_absorbs_what_its_samples_say() -> None:
    """Opacity 1 - prod (1 - d): d is constant between the outermost centres, and fades to 0 over a voxel beyond."""
    cameras = FoVOrthographicCameras(T=torch.tensor([[0.0, 0, 3]]))
    volumes = Volumes(torch.full((1, 1, 12, 12, 12), 0.1), torch.full((1, 3, 12, 12, 12), 0.7), 0.15)
    images, rays = VolumeRenderer(sampler(8), EmissionAbsorptionRaymarcher())(cameras=cameras, volumes=volumes)
    beyond = ray_bundle_to_ray_points(rays)[0, 3, 3, :, 2].abs() - 11 * 0.15 / 2
    inside = (1 - beyond / 0.15).clamp(0, 1)
    left = torch.cat([torch.ones(1), (1 - 0.1 * inside).cumprod(0)])
    center = images[0, 3:5, 3:5].reshape(4, 4)
    assert_close(center[:, 3], (1 - left[-1]).expand(4), atol=1e-5)
    assert_close(center[:, :3], (left[:-1] * 0.1 * inside * 0.7 * inside).sum().expand(4, 3), atol=1e-5)


def test_a_ball_is_seen_where_it_is() -> None:
    grid = Volumes(torch.zeros(1, 1, 25, 25, 25), voxel_size=0.1, volume_translation=(-0.3, 0.2, 0.1))
    places = grid.get_coord_grid() - torch.tensor([0.3, -0.2, -0.1])
    ball = 0.9 * (places.square().sum(-1) < 0.6**2)[:, None]
    volumes = grid.update_padded(ball, ball.expand(-1, 3, -1, -1, -1))
    cameras = looking()
    images, _ = VolumeRenderer(sampler(32), EmissionAbsorptionRaymarcher())(cameras, volumes[[0, 0]])
    assert images.shape == (2, 32, 32, 4)
    seen = cameras.transform_points_ndc(torch.tensor([[0.3, -0.2, -0.1]]))[..., 0, :2]
    centers = torch.linspace(1 - 1 / 32, -1 + 1 / 32, 32)
    weights = images[..., 3]
    mean_x = (weights * centers).sum((1, 2)) / weights.sum((1, 2))
    mean_y = (weights * centers[:, None]).sum((1, 2)) / weights.sum((1, 2))
    assert_close(torch.stack([mean_x, mean_y], 1), seen, atol=0.02)


def test_other_samplers_marchers_and_shared_grids() -> None:
    densities, features = torch.rand(1, 5, 5, 5, requires_grad=True), torch.rand(3, 5, 5, 5, requires_grad=True)
    volumes = Volumes(densities.expand(2, 1, 5, 5, 5), features.expand(2, 3, 5, 5, 5), 0.4)
    rays = MonteCarloRaysampler(-1, 1, -1, 1, n_rays_per_image=30, n_pts_per_ray=9, min_depth=1, max_depth=5)
    images, bundle = VolumeRenderer(rays, EmissionAbsorptionRaymarcher(), sample_mode="nearest")(looking(), volumes)
    assert images.shape == (2, 30, 4)
    images.sum().backward()
    assert_finite(densities.grad)
    assert_finite(features.grad)
    assert features.grad.abs().sum() > 0
    silhouettes, _ = VolumeRenderer(sampler(6), AbsorptionOnlyRaymarcher())(looking(), volumes)
    assert silhouettes.shape[:3] == (2, 6, 6)


# -- in one pass, and sample by sample


def in_both_ways(monkeypatch, cameras, volumes, leaves, marcher=None, rays=None, is_fast=True):
    """Images and gradients in one pass, and from samples; whether the first took one pass is checked."""
    marcher = EmissionAbsorptionRaymarcher() if marcher is None else marcher
    render = VolumeRenderer(sampler(16, 60) if rays is None else rays, marcher)
    taken, results = [], []

    def watched(*given):
        taken.append(march_in_one_pass(*given))
        return taken[-1]

    for march in (watched, lambda *_: None):
        monkeypatch.setattr("rendra.renderer.implicit.renderer.march_in_one_pass", march)
        images, _ = render(cameras, volumes())
        if not results:
            weights = torch.randn_like(images)
        results.append((images.detach(), *torch.autograd.grad((images * weights).sum(), leaves)))
    assert (taken[0] is not None) == is_fast
    return results


def assert_same(both) -> None:
    assert_close(both[0][0], both[1][0])
    for fast, slow in zip(both[0][1:], both[1][1:], strict=True):
        assert (fast - slow).norm() <= 2e-5 * slow.norm()


def leaves_of(*shape: int, features: int = 3) -> tuple[torch.Tensor, torch.Tensor]:
    torch.manual_seed(0)
    return torch.rand(1, *shape, requires_grad=True), torch.rand(features, *shape, requires_grad=True)


@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("distance", [0.1, 2.7], ids=["inside", "outside"])
@pytest.mark.parametrize("kind", [FoVPerspectiveCameras, FoVOrthographicCameras])
@pytest.mark.parametrize("features", [1, 3])
def test_one_pass_is_sampling_and_marching(monkeypatch, align_corners, distance, kind, features) -> None:
    densities, colours = leaves_of(7, 8, 9, features=features)
    cameras = looking(distance)

    def volumes() -> Volumes:
        return Volumes(
            (0.3 * densities)[None].expand(2, 1, 7, 8, 9), (2 * colours)[None].expand(2, features, 7, 8, 9),
            (0.3, 0.2, 0.1), (0.1, 0.2, 0.3), align_corners,
        )  # fmt: skip

    cameras = kind(R=cameras.R, T=cameras.T)
    assert_same(in_both_ways(monkeypatch, cameras, volumes, (densities, colours)))


@pytest.mark.parametrize("features", [True, False])
def test_one_pass_of_silhouettes(monkeypatch, features) -> None:
    densities, colours = leaves_of(5, 6, 7)
    own = colours.expand(2, 3, 5, 6, 7) if features else None
    both = in_both_ways(
        monkeypatch, looking(), lambda: Volumes((0.2 * densities).expand(2, 1, 5, 6, 7), own, 0.3), (densities,),
        AbsorptionOnlyRaymarcher(),
    )  # fmt: skip
    assert both[0][0].shape == (2, 16, 16, 1)
    assert_same(both)


def test_one_pass_of_different_sizes_and_places(monkeypatch) -> None:
    torch.manual_seed(0)
    sizes = [(3, 4, 5), (6, 2, 1)]
    leaves = [torch.rand(channels, *size, requires_grad=True) for channels in (1, 2) for size in sizes]

    def volumes() -> Volumes:
        return Volumes([0.3 * each for each in leaves[:2]], leaves[2:], torch.tensor([[0.5], [0.3]]))

    assert_same(in_both_ways(monkeypatch, looking(), volumes, leaves))


def test_one_pass_for_every_ray_sampler(monkeypatch) -> None:
    densities, colours = leaves_of(6, 6, 6)
    rays = RayBundle(
        *torch.randn(2, 2, 5, 3), torch.linspace(0, 4, 30).expand(2, 5, 30).clone(), torch.zeros(2, 5, 2)
    )
    uneven = rays._replace(lengths=rays.lengths.square())

    def volumes() -> Volumes:
        return Volumes((0.3 * densities).expand(2, 1, 6, 6, 6), colours.expand(2, 3, 6, 6, 6), 0.4)

    for bundle, is_fast in ((rays, True), (uneven, False)):
        both = in_both_ways(
            monkeypatch, looking(), volumes, (densities, colours), rays=lambda b=bundle, **_: b, is_fast=is_fast
        )
        assert_same(both)


@pytest.mark.parametrize(
    "change",
    [{"surface_thickness": 2}, {"dtype": torch.float64}, {"dense": 1.5}, {"camera": True}, {"channels": 2}],
    ids=str,
)
@pytest.mark.filterwarnings("ignore:rays_densities must lie")
def test_other_combinations_are_sampled(monkeypatch, change) -> None:
    dtype = change.get("dtype", torch.float32)
    densities, colours = (each.detach().to(dtype).requires_grad_() for each in leaves_of(4, 4, 4))
    cameras = looking()
    cameras = FoVPerspectiveCameras(R=cameras.R.to(dtype), T=cameras.T.to(dtype).requires_grad_("camera" in change))
    marcher = EmissionAbsorptionRaymarcher(change.get("surface_thickness", 1))
    own = torch.zeros(2, 40, 4, 4, 4, dtype=dtype) if "channels" in change else colours.expand(2, 3, 4, 4, 4)

    def volumes() -> Volumes:
        return Volumes((change.get("dense", 0.5) * densities).expand(2, 1, 4, 4, 4), own, 0.4)

    assert_same(in_both_ways(monkeypatch, cameras, volumes, (densities,), marcher, is_fast=False))


def test_densities_outside_of_their_range_are_warned_of() -> None:
    volumes = Volumes(torch.full((2, 1, 3, 3, 3), 1.5), torch.ones(2, 3, 3, 3, 3))
    with pytest.warns(UserWarning, match=r"rays_densities must lie in \[0, 1\]"):
        VolumeRenderer(sampler(), EmissionAbsorptionRaymarcher())(looking(), volumes)


def test_a_volume_shared_by_views_has_one_gradient_in_memory(monkeypatch) -> None:
    densities, colours = leaves_of(4, 4, 4)
    seen = []

    def spy(grid, *given):
        seen.append(len(grid))
        return march_volume(grid, *given)

    monkeypatch.setattr("rendra.renderer.implicit.volume_march.march_volume", spy)
    render = VolumeRenderer(sampler(4), EmissionAbsorptionRaymarcher())

    def shared() -> tuple[torch.Tensor, ...]:
        return tuple(each.sigmoid()[None].expand(2, -1, -1, -1, -1) for each in (densities, colours))

    render(looking(), Volumes(*shared()))[0].sum().backward()
    retained, features = shared()
    retained.retain_grad()
    render(looking(), Volumes(retained, features))[0].sum().backward()
    assert seen == [1, 2]
    assert retained.grad.shape == (2, 1, 4, 4, 4)
    assert_finite(densities.grad)


def test_pictures_stay_on_their_device(far) -> None:  # noqa: F811
    volumes = Volumes(torch.rand(2, 1, 3, 3, 3, device=far), torch.rand(2, 3, 3, 3, 3, device=far), 0.5)
    images, bundle = VolumeRenderer(sampler(4, 5), EmissionAbsorptionRaymarcher())(looking().to(far), volumes)
    assert isinstance(images, Far)
    assert isinstance(bundle.origins, Far)


def test_wrong_input_is_named() -> None:
    volumes = Volumes(torch.ones(2, 1, 2, 2, 2), torch.ones(2, 3, 2, 2, 2))
    with pytest.raises(ValueError, match="sample_mode must be one of bilinear, nearest; got 'cubic'"):
        VolumeSampler(volumes, "cubic")
    with pytest.raises(ValueError, match="sample_mode must be one of"):
        VolumeRenderer(sampler(), EmissionAbsorptionRaymarcher(), "cubic")
    with pytest.raises(ValueError, match="padding_mode must be one of zeros, border, reflection; got 'none'"):
        VolumeSampler(volumes, padding_mode="none")
    with pytest.raises(ValueError, match=r"instance of Volumes, got <class 'torch\.Tensor'>"):
        VolumeSampler(volumes.densities())
    with pytest.raises(ValueError, match="got 2 volumes and 1 batches of rays"):
        VolumeSampler(volumes)(random_rays(1, 5))
    with pytest.raises(ValueError, match="got 2 volumes and 3 batches of rays"):
        VolumeRenderer(sampler(), EmissionAbsorptionRaymarcher())(cameras=looking(batch=3), volumes=volumes)
