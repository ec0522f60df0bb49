"""The renderer that skips empty cells: what it sees of known matter, and what it learns about space."""

import dataclasses
import math

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from numbered_views import posed
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.renderer import PointLights, TexturesVertex
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.data.ray_views import Scene, within_box
from rendra_lab.data.rendered_scenes import RenderedScene
from rendra_lab.data.scene_box import carve
from rendra_lab.errors import UserError
from rendra_lab.networks.encodings import HashGrid, SphericalHarmonics
from rendra_lab.networks.radiance import Rays
from rendra_lab.tasks.nerf.fields import RadianceField
from rendra_lab.tasks.nerf.grid_fields import GridField
from rendra_lab.tasks.nerf.mlp_fields import MLPBook
from rendra_lab.tasks.nerf.occupancy import OccupancyRenderer

BOX = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


class Fog(RadianceField):
    """The same density everywhere; its light is the direction's."""

    def __init__(self, density: float = 1.0) -> None:
        super().__init__()
        self.density = nn.Parameter(torch.tensor(density))
        self.asked = 0

    def density_at(self, points: Tensor) -> Tensor:
        return self.density.expand(len(points))

    def forward(
        self, points: Tensor, directions: Tensor, steps: Tensor, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        assert ray_index is not None
        self.asked += len(points)
        return self.opacity(points, steps), directions.index_select(0, ray_index) / 2 + 0.5

    def opacity(self, points: Tensor, steps: Tensor) -> Tensor:
        return -torch.expm1(-self.density_at(points) * steps)


class Cloud(Fog):
    """A soft ball of matter, which a test may move."""

    def __init__(self, density: float = 4.0, centre: tuple = (0.0, 0.0, 0.0), radius: float = 0.5) -> None:
        super().__init__(density)
        self.centre, self.radius = torch.tensor(centre), radius

    def density_at(self, points: Tensor) -> Tensor:
        apart = (points - self.centre.to(points)).square().sum(1) / self.radius**2
        return self.density * (-2 * apart).exp()


class Ball(Cloud):
    """A hard one."""

    def density_at(self, points: Tensor) -> Tensor:
        return self.density * ((points - self.centre).norm(dim=1) < self.radius)


def opaque_scene() -> Scene:
    """Photographs without alpha: anything may be anywhere."""
    images = posed([(4, 6)], channels=3)
    return Scene(images, images.select([]), images.select([]), BOX)


PLANK = dataclasses.replace(opaque_scene(), box=torch.tensor([[0.0] * 3, [4.0, 2.0, 1.0]]))


def renderer(field: RadianceField, scene: Scene | None = None, **settings: object) -> OccupancyRenderer:
    made = OccupancyRenderer(field, **{"cells": 16, "steps_across": 64, **settings})
    made.place(scene or opaque_scene())
    return made.eval()


def through(count: int = 30, reach: float = 0.6) -> Rays:
    origins = F.normalize(torch.randn(count, 3), dim=1) * 4
    directions = F.normalize((torch.rand(count, 3) - 0.5) * 2 * reach - origins, dim=1)
    return Rays(origins, directions, *within_box(origins, directions, BOX))


def length(rays: Rays) -> Tensor:
    return rays.farthest - rays.nearest


def integral(field: Cloud, rays: Rays, samples: int = 4000) -> tuple[Tensor, Tensor, Tensor]:
    """Light, opacity and depth by the midpoint rule, from the formulas: (Q, 3), (Q,), (Q,)."""
    shares = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples
    at = rays.nearest[:, None] + shares * length(rays)[:, None]
    points = rays.origins[:, None] + at[..., None] * rays.directions[:, None]
    matter = field.density_at(points.reshape(-1, 3)).reshape(at.shape).double() * length(rays)[:, None] / samples
    before = (-(matter.cumsum(1) - matter)).exp()
    weights = before * -torch.expm1(-matter)
    opacity = weights.sum(1)
    return opacity[:, None] * (rays.directions / 2 + 0.5), opacity, (weights * at).sum(1)


# what rays see


@pytest.mark.parametrize("density", [0.3, 2.0])
def test_fog_stops_light_as_the_law_says(density: float) -> None:
    """Beer and Lambert; a sample at either end may lie outside, and light below `stop_below` is dropped."""
    rays, sample = through(), 2.0 / 64
    seen = renderer(Fog(density))(rays)
    assert_close(seen.opacity, -torch.expm1(-density * length(rays)), atol=density * sample / 2 + 1e-3)
    assert_close(seen.rgb, seen.opacity[:, None] * (rays.directions / 2 + 0.5), atol=1e-5)
    whole = renderer(Fog(density), jitter=True).train()
    mean = torch.stack([whole(rays).opacity.detach() for _ in range(100)]).mean(0)
    assert_close(mean, -torch.expm1(-density * length(rays)), atol=density * sample / 4 + 1e-3)


def test_finer_samples_come_nearer_to_the_integral() -> None:
    field, rays = Cloud(), through()
    expected = integral(field, rays)
    errors = []
    for steps in (16, 64, 256):
        seen = renderer(field, steps_across=steps, stop_below=0.0)(rays)
        found = (seen.rgb, seen.opacity, seen.depth)
        errors.append(max(float((a - b).detach().abs().max()) for a, b in zip(found, expected, strict=True)))
    assert errors[0] < 0.1
    assert errors[1] < errors[0] / 2
    assert errors[2] < min(errors[1] / 2, 2e-3)


@pytest.mark.parametrize("looks_first", [True, False])
def test_empty_cells_and_hidden_samples_cost_nothing_and_change_nothing(looks_first: bool) -> None:
    field, rays = Ball(60.0), through()
    blind = renderer(field, stop_below=0.0)
    seen = blind(rays)
    all_samples, field.asked = field.asked, 0
    made = renderer(field, looks_first=looks_first, empty_from=0)
    for step in range(16, 320, 16):
        made.refresh(step)
    again = made(rays)
    assert field.asked < all_samples / (4 if looks_first else 3)
    for name in ("rgb", "opacity"):
        assert_close(getattr(again, name), getattr(seen, name), atol=1e-2)  # hidden: by the mean of a cell
    assert_close(again.depth, seen.depth, atol=4e-2)


def test_gradients_are_those_of_the_law() -> None:
    """d/d density of 1 - exp(-density length)."""
    field, rays = Fog(0.7), through()
    exact = (length(rays) * (-0.7 * length(rays)).exp()).sum()
    renderer(field, stop_below=0.0)(rays).opacity.sum().backward()
    assert_close(field.density.grad, exact, rtol=0.02)


def test_jitter_is_for_training() -> None:
    made, rays = renderer(Cloud()), through()
    assert torch.equal(made(rays).rgb, made(rays).rgb)
    assert not torch.equal(made.train()(rays).rgb, made(rays).rgb)
    still = renderer(Cloud(), jitter=False).train()
    assert torch.equal(still(rays).rgb, still(rays).rgb)


@pytest.mark.parametrize("at_once", [1, 7, 1000])
def test_pieces_change_nothing(at_once: int) -> None:
    field, rays = Cloud(), through()
    whole = renderer(field).render(rays)
    with torch.no_grad():
        assert_close(renderer(field, rays_at_once=at_once)(rays).rgb, whole.rgb)


@pytest.mark.parametrize("at_once", [1, 37, 10**6])
def test_a_field_is_asked_piece_by_piece(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few rays can have many samples: memory is bounded by theirs."""
    made, rays = renderer(Cloud()), through(5)
    whole = made.render(rays)
    asked = made.field.asked
    monkeypatch.setattr("rendra_lab.tasks.nerf.occupancy._POINTS_AT_ONCE", at_once)
    most: list[int] = []
    monkeypatch.setattr(Cloud, "forward", lambda self, *what: most.append(len(what[0])) or Fog.forward(self, *what))
    with torch.no_grad():
        seen = made(rays)
    assert made.field.asked == 2 * asked
    assert max(most) <= at_once
    for name in ("rgb", "opacity", "depth"):
        assert_close(getattr(seen, name), getattr(whole, name))


@pytest.mark.parametrize("grad", [True, False])
@pytest.mark.parametrize("looks_first", [True, False])
def test_where_there_is_nothing_nothing_is_seen(grad: bool, looks_first: bool) -> None:
    encoding = HashGrid(2, 2, 6, 4, 8)
    made = renderer(GridField(encoding, SphericalHarmonics(2), width=8), looks_first=looks_first)
    rays = through(6)
    short = Rays(rays.origins, rays.directions, rays.nearest, rays.nearest)
    with torch.set_grad_enabled(grad):
        assert made(through(0)).rgb.shape == (0, 3)
        assert_close(made(short).opacity, torch.zeros(6))
        mixed = Rays(rays.origins, rays.directions, rays.nearest, torch.where(torch.arange(6) < 3, 0, rays.farthest))
        seen, whole = made(mixed), made(rays)
        assert_close(seen.rgb[:3], torch.zeros(3, 3))
        assert_close(seen.rgb[3:], whole.rgb[3:])
        made.occupied.zero_()
        made.solid.zero_()
        seen = made(rays)
        for name in ("rgb", "opacity", "depth"):
            assert_close(getattr(seen, name), torch.zeros_like(getattr(seen, name)))
    if grad:
        (seen.rgb.sum() + seen.opacity.sum()).backward()
        assert all(parameter.grad is None or not parameter.grad.any() for parameter in made.parameters())


def test_rays_end_where_they_say() -> None:
    made, rays = renderer(Fog(), stop_below=0.0), through()
    shares = torch.rand(len(rays.nearest))
    ends = Rays(rays.origins, rays.directions, rays.nearest, rays.nearest + shares * length(rays))
    assert_close(made(ends).opacity, -torch.expm1(-length(ends)), atol=0.02)


# what it learns about space


def refreshed(made: OccupancyRenderer, first: int, looks: int) -> None:
    for look in range(looks):
        made.refresh(first + look * made.refresh_every)


def middles(made: OccupancyRenderer) -> Tensor:
    """Of cells: (D, H, W, 3)."""
    low, high = made.field.box
    shares = [(torch.arange(size) + 0.5) / size for size in made.occupied.shape]
    return low + torch.stack(torch.meshgrid(*shares, indexing="ij"), dim=-1).flip(-1) * (high - low)


def assert_holds(made: OccupancyRenderer, ball: Ball) -> None:
    """All of the ball, and nothing that is two cells away from it."""
    apart = (middles(made) - ball.centre).norm(dim=-1) - ball.radius
    cell = float((made.field.box[1] - made.field.box[0]).amax()) / made.cells
    assert made.occupied[apart < 0].all()  # also those of which a look at one point saw none of it
    assert not made.occupied[apart > 3 * math.sqrt(3) * cell].any()


def test_space_is_full_until_it_may_be_empty() -> None:
    made = renderer(Ball(50.0), empty_from=64)
    refreshed(made, 0, 4)  # steps 0, 16, 32, 48
    assert made.occupied.all()
    made.refresh(64)
    assert not made.occupied.all()
    assert_holds(made, made.field)


def test_a_finished_scene_is_shown_without_the_neighbours_of_its_cells() -> None:
    made = renderer(Ball(50.0), empty_from=0)
    refreshed(made, 0, 4)
    assert made.solid.any()
    assert (made.solid <= made.occupied).all()
    assert not torch.equal(made.solid, made.occupied)
    made.solid.zero_()
    assert made.train()(through(6)).opacity.any()
    assert not made.eval()(through(6)).opacity.any()


def test_cells_are_looked_at_now_and_then() -> None:
    made = renderer(Ball(50.0), empty_from=0)
    for step in (0, 1, 15, 17, 31):
        made.refresh(step)
    assert made.occupied.all()
    made.refresh(32)
    assert not made.occupied.all()


def test_moving_matter_is_followed() -> None:
    made = renderer(Ball(50.0, (-0.4, 0.0, 0.0), 0.3), empty_from=0, decay=0.5)
    refreshed(made, 16, 3)
    assert_holds(made, made.field)
    made.field.centre = torch.tensor([0.4, 0.2, 0.1])
    made.refresh(160)
    both = middles(made)
    assert made.occupied[(both - made.field.centre).norm(dim=-1) < 0.15].all()
    assert made.occupied[(both + torch.tensor([0.4, 0.0, 0.0])).norm(dim=-1) < 0.15].all()  # remembered for a while
    refreshed(made, 176, 12)
    assert_holds(made, made.field)


def test_cells_lie_where_their_matter_is() -> None:
    """In a box whose sides differ."""
    made = renderer(Ball(50.0, (3.2, 0.6, 0.5), 0.4), PLANK, cells=32, empty_from=0)
    refreshed(made, 16, 3)
    assert_holds(made, made.field)


def test_thin_matter_counts_as_nothing() -> None:
    """A sample is 2 / 64 long."""
    for opacity, stays in ((0.009, False), (0.011, True)):
        made = renderer(Fog(-math.log1p(-opacity) * 32), empty_from=0, empty_below=0.01)
        made.refresh(16)
        assert bool(made.occupied.all()) == stays == bool(made.occupied.any())


@pytest.fixture(scope="module")
def silhouettes() -> Scene:
    sphere = ico_sphere(2)
    verts = sphere.verts_packed() * 0.6
    mesh = Meshes([verts], [sphere.faces_packed()], TexturesVertex([torch.ones_like(verts)]))
    made = RenderedScene(mesh, PointLights(location=[[0, 0, -3.0]]), image_size=24, counts=(12, 0, 0), antialias=1)
    return made.load()


def test_nothing_is_ever_outside_the_hull(silhouettes: Scene) -> None:
    made = renderer(Fog(50.0), silhouettes, cells=24)
    expected = carve(silhouettes.train, silhouettes.box, tuple(made.hull.shape))
    assert torch.equal(made.hull, expected)
    assert torch.equal(made.occupied, expected)
    assert 0.2 < float(made.hull.float().mean()) < 0.95
    refreshed(made, 16, 12)
    assert torch.equal(made.occupied, expected)
    assert not made.largest[~made.hull].any()


def test_points_are_looked_at_where_cells_are_not_empty(silhouettes: Scene) -> None:
    made = renderer(Fog(), silhouettes, cells=24)
    low, high = silhouettes.box
    cells = torch.stack(torch.meshgrid(*[torch.arange(size) for size in made.hull.shape], indexing="ij"), dim=-1)
    size = torch.tensor(made.hull.shape).flip(0)
    points = low + (cells.flip(-1).reshape(-1, 3) + torch.rand(cells.numel() // 3, 3)) / size * (high - low)
    assert torch.equal(made.looks_at(points), made.hull.flatten())
    assert not made.looks_at(high[None] + 0.1).any()


def test_cells_are_about_cubes() -> None:
    made = renderer(Fog(), PLANK)
    assert made.occupied.shape == made.usual.shape == (4, 8, 16)
    assert_close(made.field.box, PLANK.box)
    assert made.step_length == pytest.approx(4 / 64)


def test_a_scene_is_laid_out_once() -> None:
    made = renderer(Ball(50.0), empty_from=0)
    made.refresh(16)
    before = made.occupied.clone()
    made.place(opaque_scene())
    assert torch.equal(made.occupied, before)


def test_a_checkpoint_brings_its_own_sizes() -> None:
    made, rays = renderer(Ball(50.0), empty_from=0), through()
    refreshed(made, 16, 3)
    other = OccupancyRenderer(Ball(1.0), cells=16, steps_across=64).eval()
    other.load_state_dict(made.state_dict())
    assert bool(other.is_placed)
    assert torch.equal(other.occupied, made.occupied)
    assert torch.equal(other(rays).rgb, made(rays).rgb)
    other.refresh(80)
    assert not torch.equal(other.largest, made.largest)  # a copy


# what it refuses


def test_opacities_that_ignore_lengths_are_refused_with_a_remedy() -> None:
    with pytest.raises(UserError, match=r"needs a field of densities.*MLPBook.*take sampler=stratified"):
        OccupancyRenderer(MLPBook(width=8))


@pytest.mark.parametrize("wrong", ["cells", "steps_across", "refresh_every", "rays_at_once"])
def test_numbers_below_one_are_refused(wrong: str) -> None:
    with pytest.raises(ValueError, match=rf"sampler\.{wrong} must be a whole number of at least 1, got 0"):
        OccupancyRenderer(Fog(), **{wrong: 0})


@pytest.mark.parametrize("wrong", ["empty_below", "decay", "stop_below"])
@pytest.mark.parametrize("value", [-0.1, 1.5, math.nan])
def test_shares_lie_between_zero_and_one(wrong: str, value: float) -> None:
    with pytest.raises(UserError, match=rf"sampler\.{wrong} must be a number from 0 to 1, got {value}"):
        OccupancyRenderer(Fog(), **{wrong: value})


@pytest.mark.parametrize("looks_first", [True, False])
def test_rays_are_followed_where_they_lie(far, looks_first: bool) -> None:  # noqa: F811
    made = OccupancyRenderer(Cloud(), cells=4, steps_across=8, empty_from=0, looks_first=looks_first)
    for module in made.modules():
        for name, buffer in module._buffers.items():
            module._buffers[name] = buffer.to(far)
        for name, parameter in module._parameters.items():
            module._parameters[name] = nn.Parameter(parameter.detach().to(far))
    made.place(opaque_scene())
    made.refresh(16)
    rays = Rays(*(getattr(through(5), name).to(far) for name in Rays.names()))
    seen = made(rays)
    (seen.rgb.sum() + seen.opacity.sum()).backward()
    assert isinstance(made.field.density.grad, Far)
    assert isinstance(made.occupied, Far)
    assert isinstance(made.looks_at(torch.zeros(2, 3).to(far)), Far)
    assert_finite(made.field.density.grad)
