"""The grid of the task `volume`: closed forms of even matter, finer levels, empty space and checkpoints."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from numbered_views import posed
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.data.ray_views import Scene, within_box
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import Rays
from rendra_lab.tasks.volume.book import BookVolume
from rendra_lab.tasks.volume.grid import VolumeGrid, _SlabVariation

CUBE = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
PLANK = ((0.0, 0.0, 0.0), (4.0, 2.0, 1.0))


def scene(box: tuple = CUBE) -> Scene:
    """Opaque photographs: they say nothing about where matter is."""
    images = posed([(4, 6)], channels=3)
    return Scene(images, images.select([]), images.select([]), torch.tensor(box))


def placed(box: tuple = CUBE, voxels: tuple[int, ...] = (16,), **settings: object) -> VolumeGrid:
    volume = VolumeGrid(voxels, **settings)
    volume.place(scene(box))
    return volume


def raw(density: float) -> float:
    """What softplus turns into a density."""
    return math.log(math.expm1(density))


def even(density: float, **settings: object) -> VolumeGrid:
    """A volume with the same density and a known colour everywhere."""
    volume = placed(**settings)
    volume.grid.data[..., 0] = raw(density)
    volume.grid.data[..., 1:] = torch.tensor([0.2, 0.5, 0.9]).logit()
    return volume


def through(count: int = 40, box: tuple = CUBE) -> Rays:
    """Rays through the middle of a box from all around."""
    corners = torch.tensor(box)
    middle, size = corners.mean(0), corners[1] - corners[0]
    targets = middle + (torch.rand(count, 3) - 0.5) * size * 0.6
    origins = middle + F.normalize(torch.randn(count, 3), dim=1) * 4 * float(size.amax())
    directions = F.normalize(targets - origins, dim=1)
    return Rays(origins, directions, *within_box(origins, directions, corners))


def states(volume: VolumeGrid) -> dict[str, Tensor]:
    return {name: tensor.clone() for name, tensor in volume.state_dict().items()}


# where it lies


def test_voxels_are_about_cubes() -> None:
    volume = placed(PLANK, (8, 16))
    assert [tuple(grid.shape) for grid in volume.grids] == [(1, 2, 4, 8, 4), (1, 4, 8, 16, 4)]
    assert volume.occupied.shape == (16, 32, 64)
    assert bool(volume.is_placed)
    assert int(volume.level) == 0


def test_before_training_it_is_even_and_grey() -> None:
    volume = placed(start_density=0.3)
    density, rgb = volume.read(torch.rand(20, 3) - 0.5)
    assert_close(density, torch.full((20,), 0.3))
    assert_close(rgb, torch.full((20, 3), 0.5))


def test_corners_of_the_box_are_centres_of_voxels() -> None:
    volume = placed(PLANK, (8,))
    volume.grid.data[0, 1, 2, 5, 0] = 3.0
    place = torch.tensor([[5 / 7 * 4, 2 / 3 * 2, 1.0]]) * (1 - 1e-6)
    assert_close(volume.read(place)[0], F.softplus(torch.tensor([3.0])), atol=1e-3)
    assert volume.read(torch.tensor([[-0.01, 1.0, 0.5], [2.0, 2.01, 0.5]]))[0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize("wrong", [(), (1,), (16, 8)])
def test_levels_that_cannot_be_are_refused(wrong: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"volume\.voxels are numbers of voxels, at least 2, rising"):
        VolumeGrid(wrong)


@pytest.mark.parametrize("wrong", [{"steps_per_voxel": 0.0}, {"start_density": 0.0}])
def test_steps_and_densities_are_above_nothing(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="above 0"):
        VolumeGrid((8,), **wrong)


@pytest.mark.parametrize("made", [lambda **how: VolumeGrid((8,), **how), lambda **how: BookVolume(8, **how)])
def test_rays_are_rendered_one_at_a_time_or_more(made: Callable[..., nn.Module]) -> None:
    with pytest.raises(UserError, match=r"volume\.rays_at_once must be a whole number of at least 1, got 0"):
        made(rays_at_once=0)


@pytest.mark.parametrize("wrong", [{"empty_below": -0.1}, {"stop_below": 1.5}, {"stop_below": float("nan")}])
def test_shares_lie_between_zero_and_one(wrong: dict[str, float]) -> None:
    (name,) = wrong
    with pytest.raises(UserError, match=rf"volume\.{name} must be a number from 0 to 1, got"):
        VolumeGrid((8,), **wrong)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"voxels": 1}, r"volume\.voxels must be a whole number of at least 2, got 1"),
        ({"samples": 1}, r"volume\.samples must be a whole number of at least 2, got 1"),
        ({"side": 0.0}, r"volume\.side must be a number above 0, got 0"),
        ({"depth_range": (3.0, 0.1)}, r"volume\.depth_range is two ascending distances.*got \[3\.0, 0\.1\]"),
        ({"depth_range": (0.1,)}, r"volume\.depth_range is two ascending distances"),
    ],
)
def test_a_book_volume_that_cannot_be_is_refused(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        BookVolume(**wrong)


# what rays see


@pytest.mark.parametrize("box", [CUBE, PLANK])
@pytest.mark.parametrize("voxels", [16, 64])
def test_even_matter_stops_light_as_the_law_says(box: tuple, voxels: int) -> None:
    """Beer and Lambert, up to one sample at the ends."""
    volume, rays = even(0.02, box=box, voxels=(voxels,), stop_below=0.0), through(box=box)
    size = torch.tensor(box)[1].sub(torch.tensor(box)[0]).amax()
    rate = 0.02 * 100 / size  # per unit of length
    length = rays.farthest - rays.nearest
    seen = volume.eval()(rays)
    sample = float(rate) * float(size) / (voxels - 1) / 2
    assert_close(seen.opacity, -torch.expm1(-rate * length), atol=sample)
    assert_close(seen.rgb, seen.opacity[:, None] * torch.tensor([0.2, 0.5, 0.9]))
    within = 1 / rate - (length + 1 / rate) * (-rate * length).exp()  # integral of t rate exp(-rate t)
    depth = within + rays.nearest * -torch.expm1(-rate * length)
    assert_close(seen.depth, depth, atol=sample * float(rays.farthest.amax()))


def test_a_ball_is_opaque_and_round() -> None:
    volume = placed(voxels=(48,), stop_below=0.0)
    z, y, x = torch.meshgrid(*[torch.linspace(-1, 1, 48)] * 3, indexing="ij")
    radius = (x**2 + y**2 + z**2).sqrt()
    volume.grid.data[0, ..., 0] = (0.6 - radius) * 400  # softplus: zero outside, steep inside
    height = torch.tensor([0.0, 0.3, 0.5, 0.56, 0.66, 0.9])
    origins = torch.stack([height, torch.zeros(6), torch.full((6,), -3.0)], dim=1)
    directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(6, 3)
    seen = volume(Rays(origins, directions, *within_box(origins, directions, volume.box)))
    assert_close(seen.opacity, [1.0, 1.0, 1.0, 1.0, 0.0, 0.0], atol=2e-3)
    assert_close(seen.depth[:3], 3 - (0.36 - height[:3].square()).sqrt(), atol=0.04)


@pytest.mark.parametrize("at_once", [1, 7, 1000])
def test_pieces_change_nothing(at_once: int) -> None:
    rays, volume = through(), even(0.02).eval()
    whole = volume.render(rays)
    volume.rays_at_once = at_once
    with torch.no_grad():
        assert_close(volume(rays).rgb, whole.rgb)


@pytest.mark.parametrize("grad", [True, False])
def test_no_rays_and_rays_beside_the_box(grad: bool) -> None:
    volume = even(0.02)
    with torch.set_grad_enabled(grad):
        assert volume(through(0)).rgb.shape == (0, 3)
        origins = torch.tensor([[2.0, 0.0, -3.0], [-2.0, 0.0, -3.0], [0.0, 0.0, 3.0]])
        directions = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
        seen = volume(Rays(origins, directions, *within_box(origins, directions, volume.box)))
    assert_close(seen.opacity, torch.zeros(3))
    assert_finite(seen.depth)


def test_nothing_is_seen_beyond_the_ends_of_rays() -> None:
    volume, rays = even(0.02, voxels=(64,)).eval(), through(30)
    length = torch.rand(30) * (rays.farthest - rays.nearest)
    length[:5] = 0
    ends = Rays(rays.origins, rays.directions, rays.nearest, rays.nearest + length)
    assert_close(volume(ends).opacity, -torch.expm1(-length), atol=0.02)  # 0.02 * 100 / 2 per unit of length


def test_jitter_is_for_training() -> None:
    volume, rays = even(0.02), through()
    volume.eval()
    assert torch.equal(volume(rays).opacity, volume(rays).opacity)
    volume.train()
    assert not torch.equal(volume(rays).opacity, volume(rays).opacity)
    with torch.no_grad():
        assert torch.equal(volume(rays).opacity, volume(rays).opacity)
        mean = torch.stack([volume.render(rays, jitter=True).opacity for _ in range(200)]).mean(0)
    assert_close(mean, volume.eval()(rays).opacity, atol=0.01)


def test_every_voxel_on_a_ray_learns() -> None:
    volume = even(0.02, voxels=(8,))
    seen = volume(through(400))
    (seen.rgb.sum() + seen.opacity.sum()).backward()
    assert_finite(volume.grid.grad)
    middle = volume.grid.grad[0, 2:-2, 2:-2, 2:-2]
    assert (middle != 0).all()


def test_matter_of_twice_the_thickness_lets_through_the_square() -> None:
    volume = even(0.05)
    points = torch.rand(9, 3) - 0.5
    once, twice = volume.opacity(points, 0.1), volume.opacity(points, 0.2)
    assert_close(1 - twice, (1 - once).square())
    assert_close(once, torch.full((9,), -math.expm1(-0.05 * 0.1 / 0.02)))  # a unit is a hundredth of the box


# levels


def fill(volume: VolumeGrid, function: object) -> None:
    axes = [torch.linspace(-1, 1, size) for size in volume.grid.shape[1:4]]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    for channel in range(4):
        volume.grid.data[0, ..., channel] = function(x, y, z, channel)


def test_finer_voxels_hold_the_same_linear_field_exactly() -> None:
    volume = placed(voxels=(6, 9, 20))
    fill(volume, lambda x, y, z, channel: 1.5 * x - 0.7 * y + 0.4 * z + channel)
    points = torch.rand(200, 3) * 1.98 - 0.99
    before = volume.read(points)
    for level in (1, 2):
        volume.refine_to(level)
        assert int(volume.level) == level
        assert volume.grid is volume.grids[level]
        for found, expected in zip(volume.read(points), before, strict=True):
            assert_close(found, expected, atol=1e-4)


def test_a_level_may_be_left_out() -> None:
    volume = placed(voxels=(6, 9, 20))
    fill(volume, lambda x, y, z, channel: x + y + z)
    points = torch.rand(50, 3) - 0.5
    before = volume.read(points)[0]
    volume.refine_to(2)
    assert_close(volume.read(points)[0], before, atol=1e-4)


def test_smooth_fields_change_by_less_than_they_bend() -> None:
    """Linear interpolation is off by h^2 / 8 times the second derivatives: here 3 * 4 * (2 / 15)^2 / 8, twice."""
    volume = placed(voxels=(16, 40))
    fill(volume, lambda x, y, z, channel: (2 * x).sin() + (2 * y).cos() + (2 * z).sin())
    points = torch.rand(300, 3) * 1.9 - 0.95
    before = volume.read(points)[0]
    volume.refine_to(1)
    change = (volume.read(points)[0] - before).detach().abs().max()
    assert 1e-5 < float(change) < 2 * 3 * 4 * (2 / 15) ** 2 / 8


def test_samples_are_as_dense_as_the_voxels_of_the_level() -> None:
    volume = placed(voxels=(11, 21), steps_per_voxel=4.0)
    assert volume._step() == pytest.approx(2 / 10 / 4)
    volume.refine_to(1)
    assert volume._step() == pytest.approx(2 / 20 / 4)


# empty space


@pytest.mark.parametrize("voxels", [5, 16, 48, 64, 100])
@pytest.mark.parametrize("box", [CUBE, PLANK])
def test_cells_with_matter_are_never_emptied(voxels: int, box: tuple) -> None:
    volume = placed(box, (voxels,), empty_below=0.01)
    flat = volume.grid.data.view(-1, 4)
    flat[:, 0] = -20.0
    flat[torch.randint(len(flat), (5,)), 0] = 20.0
    corners, size = torch.tensor(box), torch.tensor(volume.grid.shape[3:0:-1])
    spikes = (volume.grid.data[0, ..., 0] > 0).nonzero().flip(1)
    shares = (spikes[:, None] + 2 * torch.rand(len(spikes), 2000, 3) - 1) / (size - 1)  # the voxels about them
    points = corners[0] + shares.clamp(0.001, 0.999).reshape(-1, 3) * (corners[1] - corners[0])
    before = volume.opacity(points, volume._step())
    volume.look_for_space()
    assert_close(volume.opacity(points, volume._step())[before > 0.01], before[before > 0.01])
    assert (before > 0.01).any()
    if voxels >= 16:
        assert 0 < float(volume.occupied.float().mean()) < 0.5


@pytest.mark.parametrize(("opacity", "stays"), [(0.009, False), (0.011, True)])
def test_cells_are_empty_whose_samples_stop_less_than_was_said(opacity: float, stays: bool) -> None:
    """A sample is 2 / 15 / 2 long, and a unit 2 / 100."""
    volume = even(-math.log1p(-opacity) * (2 / 100) / (2 / 15 / 2), voxels=(16,), empty_below=0.01)
    volume.look_for_space()
    assert bool(volume.occupied.all()) == stays == bool(volume.occupied.any())


def test_cells_stay_empty_and_rays_pass_through_them() -> None:
    volume = placed(voxels=(32,))
    volume.grid.data[..., 0] = -20.0
    volume.look_for_space()
    assert not volume.occupied.any()
    volume.grid.data[..., 0] = 5.0
    volume.look_for_space()
    assert not volume.occupied.any()
    seen = volume(through())
    assert_close(seen.opacity, torch.zeros(40))
    seen.rgb.sum().backward()
    assert_close(volume.grid.grad, torch.zeros_like(volume.grid))
    assert_close(volume.opacity(torch.zeros(1, 3), 1.0), [0.0])


# roughness


def plain_variation(grid: Tensor, first: int, thick: int) -> Tensor:
    slab = grid[0, first : first + thick]
    x, y, z = (slab[:, :, 1:] - slab[:, :, :-1], slab[:, 1:] - slab[:, :-1], slab[1:] - slab[:-1])
    return x.square().mean() + y.square().mean() + z.square().mean()


@pytest.mark.parametrize(("first", "thick"), [(0, 6), (2, 3), (4, 2)])
def test_roughness_is_the_mean_square_of_differences(first: int, thick: int) -> None:
    grid = torch.randn(1, 6, 3, 5, 2, dtype=torch.float64, requires_grad=True)
    found = _SlabVariation.apply(grid, first, thick)
    expected = plain_variation(grid, first, thick)
    assert_close(found, expected)
    gradients = [torch.autograd.grad(3 * value, grid)[0] for value in (found, expected)]
    assert_close(*gradients, atol=1e-12)
    assert torch.autograd.gradcheck(lambda volume: _SlabVariation.apply(volume, first, thick), grid)


def test_all_slabs_together_are_the_whole_volume() -> None:
    volume = placed(PLANK, (16,))
    volume.grid.data.normal_()
    assert_close(volume.roughness(share=1.0), plain_variation(volume.grid, 0, 4))
    many = torch.stack([volume.roughness(share=0.5) for _ in range(400)]).detach()
    kinds = [float(plain_variation(volume.grid.detach(), first, 2)) for first in range(3)]
    assert {round(value, 3) for value in many.tolist()} == {round(value, 3) for value in kinds}


def test_even_volumes_are_not_rough() -> None:
    assert float(even(0.3).roughness().detach()) == 0.0


# checkpoints


def test_a_checkpoint_brings_its_own_sizes() -> None:
    volume = placed(PLANK, (8, 12), stop_below=0.0)
    volume.refine_to(1)
    volume.grid.data.normal_()
    volume.look_for_space()
    other = VolumeGrid((8, 12), stop_below=0.0)
    parameters = list(other.parameters())
    other.load_state_dict(volume.state_dict())
    assert all(a is b for a, b in zip(parameters, other.parameters(), strict=True))  # an optimizer holds them
    assert bool(other.is_placed)
    for name, tensor in volume.state_dict().items():
        assert torch.equal(other.state_dict()[name], tensor)
    rays = through(box=PLANK)
    assert torch.equal(other.eval()(rays).rgb, volume.eval()(rays).rgb)


def test_what_is_loaded_is_a_copy() -> None:
    volume, other = even(0.1), VolumeGrid((16,))
    before = states(volume)
    other.load_state_dict(volume.state_dict())
    with torch.no_grad():
        other.grid.add_(1)
        other.occupied.zero_()
    for name, tensor in before.items():
        assert torch.equal(volume.state_dict()[name], tensor)


def test_rays_are_followed_where_the_volume_lies(far) -> None:  # noqa: F811
    volume, rays = placed(voxels=(5, 8)), through(6)
    for name, buffer in volume._buffers.items():
        volume._buffers[name] = buffer.to(far)
    volume.grids = nn.ParameterList(nn.Parameter(grid.detach().to(far)) for grid in volume.grids)
    volume.refine_to(1)
    volume.look_for_space()
    seen = volume(Rays(*(getattr(rays, name).to(far) for name in Rays.names())))
    (seen.rgb.sum() + volume.roughness()).backward()
    assert isinstance(volume.grid.grad, Far)
    assert isinstance(volume.opacity(torch.zeros(2, 3).to(far), 0.1), Far)
    volume.place(scene())
    assert isinstance(volume.occupied, Far)
    assert isinstance(volume.grids[0].data, Far)
