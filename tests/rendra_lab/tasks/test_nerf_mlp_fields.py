"""The networks of the book and of the original, against their published sizes and their formulas written out."""

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import nn
from torch.nn import functional as F

from rendra.renderer import EmissionAbsorptionRaymarcher, ImplicitRenderer, RayBundle
from rendra_lab import losses
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import Rays
from rendra_lab.tasks.nerf.mlp_fields import MLPBook, MLPOriginal
from rendra_lab.tasks.nerf.samplers import StratifiedRenderer

FIELDS = [MLPBook, MLPOriginal]
NEAR, FAR = 0.1, 3.0


def unit(*shape: int) -> torch.Tensor:
    """Directions that are of length 1 to the last digit: high frequencies turn a last digit into anything."""
    directions = torch.randn(4 * shape[0], *shape[1:], 3)
    for _ in range(4):
        directions = F.normalize(directions, dim=-1)
    settled = (F.normalize(directions, dim=-1) == directions).flatten(1).all(1)
    return directions[settled][: shape[0]]


def inputs(count: int = 50, samples: int = 1) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    return 2 * torch.rand(count * samples, 3) - 1, unit(count), 0.1 * torch.rand(count * samples)


def gradients(module: nn.Module) -> dict[str, torch.Tensor]:
    return {name: parameter.grad for name, parameter in module.named_parameters() if parameter.grad is not None}


@pytest.mark.parametrize(
    ("field", "count"),
    [(MLPBook(), 317_188), (MLPOriginal(), 595_844), (MLPOriginal(width=64, depth=4, skip=2), 27_876)],
)
def test_networks_have_their_published_size(field: nn.Module, count: int) -> None:
    assert sum(parameter.numel() for parameter in field.parameters()) == count


@pytest.mark.parametrize("make", FIELDS)
def test_samples_have_opacity_and_light(make: type) -> None:
    field, (points, directions, steps) = make(width=32), inputs()
    alpha, rgb = field(points, directions, steps)
    assert alpha.shape == (50,)
    assert rgb.shape == (50, 3)
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert ((rgb >= 0) & (rgb <= 1)).all()
    assert_close(field.opacity(points, steps), alpha)


@pytest.mark.parametrize("make", FIELDS)
def test_no_sample_is_no_trouble(make: type) -> None:
    field = make(width=8)
    alpha, rgb = field(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    assert alpha.shape == (0,)
    assert rgb.shape == (0, 3)
    assert field.opacity(torch.zeros(0, 3), torch.zeros(0)).shape == (0,)


@pytest.mark.parametrize("make", FIELDS)
@pytest.mark.parametrize("by_ray", [False, True])
def test_chunks_change_neither_values_nor_gradients(make: type, by_ray: bool) -> None:
    points, directions, steps = inputs(10, 7)
    ray_index = torch.arange(10).repeat_interleave(7)
    answers = []
    for chunk in (10_000, 16, 1):
        torch.manual_seed(1)
        field = make(width=16, chunk=chunk)
        along = (directions, steps, ray_index) if by_ray else (directions[ray_index], steps)
        alpha, rgb = field(points, *along)
        (alpha.sum() + rgb.square().sum()).backward()
        with torch.no_grad():
            assert_close(field(points, *along)[1], rgb.detach(), atol=1e-6)
        answers.append({"alpha": alpha.detach(), "rgb": rgb.detach(), **gradients(field)})
    for answer in answers[1:]:
        for name, value in answer.items():
            assert_close(value, answers[0][name], atol=1e-5)


@pytest.mark.parametrize("make", FIELDS)
def test_directions_once_a_ray_are_directions_of_each_point(make: type) -> None:
    field, (points, directions, steps) = make(width=16), inputs(10, 7)
    ray_index = torch.arange(10).repeat_interleave(7)
    for one, other in zip(
        field(points, directions, steps, ray_index), field(points, directions[ray_index], steps), strict=True
    ):
        assert_close(one, other, atol=1e-6)


@pytest.mark.parametrize("make", FIELDS)
@pytest.mark.parametrize("seed", range(5))
def test_no_field_is_dead_at_birth(make: type, seed: int) -> None:
    torch.manual_seed(seed)
    field, (points, directions, steps) = make(width=64), inputs(200)
    alpha, rgb = field(points, directions, steps)
    (alpha[:, None] * rgb).sum().backward()
    assert (alpha > 0).float().mean() > 0.1
    for name, gradient in gradients(field).items():
        assert_finite(gradient)
        assert gradient.abs().max() > 0, name


def test_the_books_matter_is_an_opacity_and_the_originals_a_density() -> None:
    points, _, steps = inputs()
    book, original = MLPBook(width=16), MLPOriginal(width=16)
    assert_close(book.opacity(points, steps), book.opacity(points, 2 * steps))
    once, twice = original.opacity(points, steps), original.opacity(points, 2 * steps)
    assert_close(1 - twice, (1 - once).square(), atol=1e-6)


def test_a_scene_looks_the_same_in_other_units() -> None:
    points, directions, steps = inputs()
    field = MLPOriginal(width=16)
    field.place(torch.tensor([[-1.0, -1.0, -0.5], [1.0, 1.0, 0.5]]))
    before = field(points, directions, steps)
    field.place(torch.tensor([[9.0, -1.0, 4.5], [29.0, 19.0, 14.5]]))
    middle = torch.tensor([19.0, 9.0, 9.5])
    for one, other in zip(before, field(10 * points + middle, directions, 10 * steps), strict=True):
        assert_close(one, other, atol=1e-3)


def test_noise_disturbs_training_alone() -> None:
    points, _, steps = inputs()
    field = MLPOriginal(width=16, noise_std=1.0)
    assert not torch.equal(field.opacity(points, steps), field.opacity(points, steps))
    field.eval()
    assert_close(field.opacity(points, steps), field.opacity(points, steps))


@pytest.mark.parametrize("skip", [-1, 3, 4])
def test_a_skip_leads_to_a_layer(skip: int) -> None:
    with pytest.raises(UserError, match=r"field\.skip.*of 4"):
        MLPOriginal(depth=4, skip=skip)


def test_the_original_is_its_formula() -> None:
    """Fig. 7 of the paper and the encoding of its code, point by point."""
    field = MLPOriginal(width=16, depth=3, skip=0, frequencies=2, direction_frequencies=1, normalize=False)
    point, direction, step = torch.rand(1, 3), unit(1), torch.tensor([0.3])
    x = torch.cat([point, point.sin(), point.cos(), (2 * point).sin(), (2 * point).cos()], dim=1)
    d = torch.cat([direction, direction.sin(), direction.cos()], dim=1)
    hidden = field.trunk[0](x).relu()
    hidden = field.trunk[1](torch.cat([x, hidden], dim=1)).relu()
    hidden = field.trunk[2](hidden).relu()
    color = field.color(torch.cat([field.features(hidden), d], dim=1)).relu()
    alpha, rgb = field(point, direction, step)
    assert_close(rgb, field.rgb(color).sigmoid(), atol=1e-6)
    assert_close(alpha, 1 - (-field.density(hidden)[:, 0].relu() * step).exp(), atol=1e-6)


class PlainBook(nn.Module):
    """The book's network as its fact sheet says it, a function of ray bundles: dense, nothing shared or hoisted."""

    def __init__(self, weights: MLPBook) -> None:
        super().__init__()
        self.first, self.second = nn.Linear(360, 256), nn.Linear(256, 256)
        self.density, self.color, self.rgb = nn.Linear(256, 1), nn.Linear(616, 256), nn.Linear(256, 3)
        pairs = {self.first: weights.trunk[0], self.second: weights.trunk[2]}
        for mine, theirs in {**pairs, self.density: weights.density, self.color: weights.color}.items():
            mine.load_state_dict(theirs.state_dict())
        self.rgb.load_state_dict(weights.rgb.state_dict())

    def forward(self, ray_bundle: RayBundle, **kwargs: object) -> tuple[torch.Tensor, torch.Tensor]:
        lengths = ray_bundle.lengths[..., None]
        points = ray_bundle.origins[..., None, :] + ray_bundle.directions[..., None, :] * lengths
        directions = F.normalize(ray_bundle.directions, dim=-1)[..., None, :].expand(points.shape)
        hidden = softplus(self.second(softplus(self.first(embedding(points)))))
        raw = softplus(self.density(hidden))
        color = softplus(self.color(torch.cat([hidden, embedding(directions)], dim=-1)))
        return 1 - torch.exp(-raw), torch.sigmoid(self.rgb(color))


def softplus(x: torch.Tensor) -> torch.Tensor:
    return F.softplus(x, beta=10.0)


def embedding(x: torch.Tensor) -> torch.Tensor:
    frequencies = 0.1 * 2.0 ** torch.arange(60)
    angles = (x[..., None] * frequencies).reshape(*x.shape[:-1], -1)
    return torch.cat([torch.sin(angles), torch.cos(angles)], dim=-1)


def book_huber(x: torch.Tensor, y: torch.Tensor, scale: float = 0.1) -> torch.Tensor:
    squared = (x - y) ** 2
    return ((1 + squared / scale**2).clamp(1e-4).sqrt() - 1) * scale


class BookPair:
    """Our book and the plain one, with the same weights, looking at a grey ball with the same rays."""

    def __init__(self, samples: int, density_bias: float | None = None) -> None:
        book = MLPBook(chunk=500)
        if density_bias is not None:
            nn.init.constant_(book.density.bias, density_bias)
        self.renderer = StratifiedRenderer(book, samples, jitter=False, depth_range=(NEAR, FAR))
        self.plain = PlainBook(book)

    def rays(self, count: int) -> Rays:
        eye, zero = torch.tensor([0.0, 0.0, -2.0]), torch.zeros(count)
        directions = F.normalize(unit(4 * count) * torch.tensor([0.3, 0.3, 0.0]) + torch.tensor([0.0, 0.0, 1.0]))
        for _ in range(4):
            directions = F.normalize(directions, dim=-1)
        settled = (F.normalize(directions, dim=-1) == directions).all(1)
        return Rays(eye.expand(count, 3), directions[settled][:count], zero, zero)

    def target(self, rays: Rays) -> tuple[torch.Tensor, torch.Tensor]:
        nearest = torch.linalg.cross(rays.origins, rays.directions).norm(dim=1)
        mask = (nearest < 0.5).float()  # half of the rays: a ball that few meet is never found
        return mask[:, None] * torch.tensor([0.8, 0.5, 0.2]), mask

    def ours(self, rays: Rays) -> torch.Tensor:
        rgb, mask = self.target(rays)
        seen = self.renderer(rays)
        return losses.pseudo_huber(seen.rgb, rgb) + losses.pseudo_huber(seen.opacity, mask)

    def plainly(self, rays: Rays) -> torch.Tensor:
        rgb, mask = self.target(rays)
        between = Rays(rays.origins, rays.directions, rays.nearest + NEAR, rays.farthest + FAR)
        lengths = self.renderer.distances(between, self.renderer.samples)
        bundle = RayBundle(rays.origins[None], rays.directions[None], lengths[None], torch.zeros(1, len(rgb), 2))
        render = ImplicitRenderer(lambda **_: bundle, EmissionAbsorptionRaymarcher())
        images, _ = render(cameras=None, volumetric_function=self.plain)
        seen, opacity = images[0].split([3, 1], dim=-1)
        return book_huber(seen, rgb).mean() + book_huber(opacity[:, 0], mask).mean()

    def curves(self, steps: int, rays: int) -> torch.Tensor:
        """The losses of both, (steps, 2)."""
        optimizers = [torch.optim.Adam(module.parameters(), lr=1e-3) for module in (self.renderer, self.plain)]
        curves = []
        for _ in range(steps):
            batch = self.rays(rays)
            values = [self.ours(batch), self.plainly(batch)]
            for optimizer, value in zip(optimizers, values, strict=True):
                optimizer.zero_grad()
                value.backward()
                optimizer.step()
            curves.append([float(value.detach()) for value in values])
        return torch.tensor(curves)


@pytest.mark.parametrize("density_bias", [None, 0.0])
def test_the_book_is_its_formula(density_bias: float | None) -> None:
    """As it begins, when all is transparent, and with a density that shows all else."""
    pair = BookPair(32, density_bias)
    rays = pair.rays(40)
    ours, plainly = pair.ours(rays), pair.plainly(rays)
    assert_close(ours.detach(), plainly.detach(), atol=1e-6)
    ours.backward()
    plainly.backward()
    field = gradients(pair.renderer.field)
    names = {"first": "trunk.0", "second": "trunk.2"}
    for name, gradient in gradients(pair.plain).items():
        layer, kind = name.split(".")
        assert_close(field[f"{names.get(layer, layer)}.{kind}"], gradient, atol=1e-5)


def test_the_book_learns_as_its_formula_does() -> None:
    curves = BookPair(16, density_bias=-0.3).curves(steps=12, rays=48)
    assert_close(curves[:, 0], curves[:, 1], atol=1e-4)
    assert curves.std() > 0.01


@pytest.mark.slow
def test_the_book_learns_as_its_formula_does_for_long() -> None:
    curves = BookPair(64).curves(steps=200, rays=64)
    ours, plainly = curves.reshape(10, 20, 2).mean(1).unbind(1)
    assert ((ours / plainly - 1).abs() < 0.1).all()
    assert ours[-1] < 0.5 * ours[0]
