"""Even and hierarchical samples, through fields whose pictures are known."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from torch import Tensor, nn
from torch.nn import functional as F

from rendra.renderer import EmissionAbsorptionRaymarcher
from rendra_lab.errors import UserError
from rendra_lab.losses import SquaredError
from rendra_lab.networks.radiance import Rays
from rendra_lab.tasks.nerf.fields import RadianceField
from rendra_lab.tasks.nerf.mlp_fields import MLPBook, MLPOriginal
from rendra_lab.tasks.nerf.samplers import HierarchicalRenderer, StratifiedRenderer, composite
from rendra_lab.tasks.nerf.task import NeRF
from rendra_lab.terms import LossTerm


class Fog(RadianceField):
    """Even density between two heights, its light the height; remembers where it was asked."""

    def __init__(self, density: float = 1.0, low: float = -math.inf, high: float = math.inf) -> None:
        super().__init__()
        self.density = nn.Parameter(torch.tensor(density))
        self.low, self.high = low, high
        self.asked: list[Tensor] = []

    def forward(
        self, points: Tensor, directions: Tensor, steps: Tensor, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        self.asked.append(points.detach())
        return self.opacity(points, steps), points[:, 2:].expand(-1, 3)

    def opacity(self, points: Tensor, steps: Tensor) -> Tensor:
        inside = (points[:, 2] > self.low) & (points[:, 2] < self.high)
        return -torch.expm1(-self.density * inside * steps)


def upward(count: int = 4, near: float = 0.5, end: float = 2.5) -> Rays:
    up = torch.tensor([0.0, 0.0, 1.0]).expand(count, 3)
    return Rays(torch.zeros(count, 3), up, torch.full((count,), near), torch.full((count,), end))


def both(**settings: object) -> list[nn.Module]:
    return [
        StratifiedRenderer(Fog(), samples=65, **settings),
        HierarchicalRenderer(Fog(), Fog(), coarse_samples=33, fine_samples=65, **settings),
    ]


@pytest.mark.parametrize("renderer", both())
@pytest.mark.parametrize("training", [True, False])
def test_fog_stops_light_as_the_law_says(renderer: nn.Module, training: bool) -> None:
    """Beer and Lambert: 1 - exp(-length); jitter leaves out up to half a sample at each end."""
    seen = renderer.train(training)(upward())
    spare = 2.0 / 32 if training else 1e-5
    for opacity in [seen.opacity] + ([] if seen.opacity_coarse is None else [seen.opacity_coarse]):
        assert_close(opacity, torch.full((4,), 1 - math.exp(-2.0)), atol=spare)
    assert_close(seen.rgb[:, 0], seen.depth, atol=1e-5)  # the light is the distance
    exact = 1.5 - 3.5 * math.exp(-2.0)  # integral of t exp(-(t - 0.5)) from 0.5 to 2.5
    assert_close(seen.depth, torch.full((4,), exact), atol=0.07)


@pytest.mark.parametrize("renderer", both())
def test_rays_without_length_see_nothing(renderer: nn.Module) -> None:
    rays = upward()
    gaps = Rays(rays.origins, rays.directions, rays.nearest, torch.tensor([2.5, 0.5, 0.1, 2.5]))
    seen, full = renderer.eval()(gaps), renderer(rays)
    for name in seen.names():
        value = getattr(seen, name)
        if value is not None:
            assert_close(value[[1, 2]], torch.zeros_like(value[[1, 2]]))
            assert_close(value[[0, 3]], getattr(full, name)[[0, 3]])


@pytest.mark.parametrize("make", [MLPBook, Fog])
@pytest.mark.parametrize("endless", [True, False])
def test_no_field_is_seen_where_there_is_nothing(make: type, endless: bool) -> None:
    """An opacity that ignores the length of a sample, and a last sample without an end."""
    rays = upward(3, near=0.5, end=0.5)
    seen = StratifiedRenderer(make(), samples=4, endless=endless)(rays)
    assert_close(seen.opacity, torch.zeros(3))
    (seen.rgb.sum() + seen.opacity.sum()).backward()


@pytest.mark.parametrize("renderer", both(jitter=False))
@pytest.mark.parametrize("count", [0, 1])
def test_few_rays(renderer: nn.Module, count: int) -> None:
    seen = renderer(upward(count))
    assert seen.rgb.shape == (count, 3)
    with torch.no_grad():
        assert renderer(upward(count)).depth.shape == (count,)


@pytest.mark.parametrize("at_once", [1, 3, 100])
def test_pieces_change_nothing(at_once: int) -> None:
    for whole, pieces in zip(both(), both(rays_at_once=at_once), strict=True):
        with torch.no_grad():
            assert_close(pieces.eval()(upward(7)).depth, whole.eval()(upward(7)).depth)


@pytest.mark.parametrize("disparity", [True, False])
def test_jitter_stays_in_its_bins(disparity: bool) -> None:
    renderer = StratifiedRenderer(Fog(), samples=6, disparity=disparity)
    even = renderer.eval().distances(upward(200), 6)
    drawn = renderer.train().distances(upward(200), 6)
    middles = (even[:, 1:] + even[:, :-1]) / 2
    assert (drawn >= torch.cat([even[:, :1], middles], dim=1)).all()
    assert (drawn <= torch.cat([middles, even[:, -1:]], dim=1)).all()
    assert drawn.std(0).min() > 0.01
    assert_close(even[:, [0, -1]], torch.tensor([[0.5, 2.5]]).expand(200, 2), atol=1e-6)
    spread = torch.diff(1 / even if disparity else even)
    assert_close(spread, spread[:, :1].expand_as(spread), atol=1e-5)


def test_disparity_begins_a_little_before_the_camera() -> None:
    distances = StratifiedRenderer(Fog(), disparity=True).eval().distances(upward(1, near=0.0, end=10.0), 5)
    assert_finite(distances)
    assert distances[0, 0] == pytest.approx(0.01)


def test_evaluation_is_not_random() -> None:
    for renderer in both():
        renderer.eval()
        assert_close(renderer(upward()).rgb, renderer(upward()).rgb)


def test_an_endless_last_sample_is_opaque_in_any_fog() -> None:
    seen = StratifiedRenderer(Fog(density=1e-3), samples=4, endless=True)(upward())
    assert_close(seen.opacity, torch.ones(4), atol=1e-6)


def test_the_second_look_goes_where_the_first_found_something() -> None:
    """A thin sheet between 1.4 and 1.6 of 0.5 to 2.5 gets most of the new samples."""
    fine = Fog(20.0, 1.4, 1.6)
    renderer = HierarchicalRenderer(fine, Fog(20.0, 1.4, 1.6), coarse_samples=41, fine_samples=100)
    renderer(upward(1))
    heights = fine.asked[0][:, 2]
    assert heights.shape == (141,)
    assert (heights.diff() >= 0).all()
    assert ((heights > 1.35) & (heights < 1.65)).sum() > 90
    even = Fog(20.0, 1.4, 1.6)
    StratifiedRenderer(even, samples=141)(upward(1))
    assert ((even.asked[0][:, 2] > 1.35) & (even.asked[0][:, 2] < 1.65)).sum() < 30


def test_each_look_teaches_its_own_field() -> None:
    for name in ("field", "coarse"):
        renderer = HierarchicalRenderer(Fog(), Fog(), coarse_samples=8, fine_samples=8)
        seen = renderer(upward())
        (seen.opacity if name == "field" else seen.opacity_coarse).sum().backward()
        taught = {key for key in ("field", "coarse") if getattr(renderer, key).density.grad is not None}
        assert taught == {name}


def test_both_fields_are_placed() -> None:
    renderer = HierarchicalRenderer(Fog(), Fog())
    for field in (renderer.field, renderer.coarse):
        field.place(torch.tensor([[0.0, 0.0, 0.0], [2.0, 2.0, 2.0]]))
        assert_close(field.box[1], torch.full((3,), 2.0))


def test_a_depth_range_stands_for_the_box() -> None:
    renderer = StratifiedRenderer(Fog(), samples=3, jitter=False, depth_range=[1.0, 3.0])
    renderer(upward(2, near=0.5, end=0.5))
    assert_close(renderer.field.asked[0][:, 2], torch.tensor([1.0, 2.0, 3.0, 1.0, 2.0, 3.0]))


@pytest.mark.parametrize("wrong", [[1.0], [3.0, 1.0], [-1.0, 1.0]])
def test_a_wrong_depth_range_is_refused(wrong: list[float]) -> None:
    with pytest.raises(UserError, match=r"sampler\.depth_range"):
        StratifiedRenderer(Fog(), depth_range=wrong)


def test_too_few_samples_are_refused() -> None:
    with pytest.raises(UserError, match=r"sampler\.samples must be a whole number of at least 2, got 1"):
        StratifiedRenderer(Fog(), samples=1)
    with pytest.raises(UserError, match=r"sampler\.coarse_samples"):
        HierarchicalRenderer(Fog(), Fog(), coarse_samples=2)


def test_compositing_is_the_raymarchers() -> None:
    alpha, rgb = torch.rand(5, 9, dtype=torch.float64), torch.rand(5, 9, 3, dtype=torch.float64)
    distances = torch.rand(5, 9, dtype=torch.float64).sort(1).values
    weights, seen = composite(alpha, rgb, distances)
    expected = EmissionAbsorptionRaymarcher()(alpha[..., None], torch.cat([rgb, distances[..., None]], dim=-1))
    assert_close(torch.cat([seen.rgb, seen.depth[:, None], seen.opacity[:, None]], dim=1), expected, atol=1e-9)
    assert_close(weights.sum(1), seen.opacity)


def test_gradients_through_opaque_samples_are_finite_and_right() -> None:
    alpha = torch.rand(3, 6, dtype=torch.float64)
    alpha[0, 2], alpha[1, 0] = 1.0, 0.0
    rgb, distances = torch.rand(3, 6, 3, dtype=torch.float64), torch.arange(6.0, dtype=torch.float64).expand(3, 6)
    inputs = (alpha.requires_grad_(), rgb.requires_grad_())
    assert torch.autograd.gradcheck(lambda a, c: composite(a, c, distances)[1].rgb, inputs)


def test_light_comes_from_the_direction_of_each_ray() -> None:
    class Aimed(Fog):
        def forward(
            self, points: Tensor, directions: Tensor, steps: Tensor, ray_index: Tensor | None = None
        ) -> tuple[Tensor, Tensor]:
            assert ray_index is not None
            return torch.ones(len(points)), directions[ray_index]

    directions = F.normalize(torch.randn(6, 3), dim=1)
    rays = Rays(torch.zeros(6, 3), directions, torch.zeros(6), torch.ones(6))
    assert_close(StratifiedRenderer(Aimed(), samples=4)(rays).rgb, directions, atol=1e-6)


@pytest.mark.parametrize("make", [MLPBook, MLPOriginal])
def test_rays_are_followed_where_they_lie(far, make: type) -> None:  # noqa: F811
    renderer = HierarchicalRenderer(make(width=8, chunk=20), make(width=8), coarse_samples=5, fine_samples=4)
    for module in renderer.modules():
        for name, buffer in module._buffers.items():
            module._buffers[name] = buffer.to(far)
        for name, parameter in module._parameters.items():
            module._parameters[name] = nn.Parameter(parameter.detach().to(far))
    rays = Rays(*(getattr(upward(), name).to(far) for name in Rays.names()))
    seen = renderer(rays)
    (seen.rgb.sum() + seen.rgb_coarse.sum()).backward()
    assert all(isinstance(parameter.grad, Far) for parameter in renderer.parameters())
    with torch.no_grad():
        assert isinstance(renderer.eval()(rays).depth, Far)


def test_a_coarse_field_wants_a_loss() -> None:
    renderer = HierarchicalRenderer(Fog(), Fog())
    loss = {"rgb": LossTerm(SquaredError())}
    with pytest.raises(UserError, match=r"loss=\[rgb,rgb_coarse,opacity\]"):
        NeRF(renderer, losses=loss, optimizer=torch.optim.Adam)
