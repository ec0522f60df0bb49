"""Fields of grids: units, directions, and that they can learn from the first step."""

from functools import partial

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.networks.encodings import HashGrid, SphericalHarmonics, TriPlane
from rendra_lab.tasks.nerf.grid_fields import GridField, _TruncatedExp, perceptron

ENCODINGS = {
    "hash": partial(HashGrid, levels=3, features=2, log2_table_size=8, coarsest=4, finest=16),
    "product": partial(TriPlane, (4, 8), features=3),
    "sum": partial(TriPlane, (4, 8), features=3, combine="sum"),
    "concat": partial(TriPlane, (4,), features=3, combine="concat"),
}


def field(encoding: str = "hash", sees: bool = True, **settings: object) -> GridField:
    directions = SphericalHarmonics(2) if sees else None
    return GridField(ENCODINGS[encoding](), directions, width=16, **settings)


def learned(encoding: str = "hash", **settings: object) -> GridField:
    """A field with something in it."""
    made = field(encoding, **settings)
    with torch.no_grad():
        for parameter in made.encoding.parameters():
            parameter.normal_()
    return made


def inputs(count: int = 60) -> tuple[Tensor, Tensor, Tensor]:
    return 2 * torch.rand(count, 3) - 1, F.normalize(torch.randn(count, 3), dim=1), 0.1 * torch.rand(count) + 0.01


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("sees", [True, False])
def test_everything_learns_from_the_first_step(encoding: str, sees: bool) -> None:
    """A table near nothing before layers without a bias could leave all gradients at nothing."""
    for seed in range(5):
        torch.manual_seed(seed)
        made = field(encoding, sees)
        alpha, rgb = made(*inputs(400))
        loss = (alpha - 0.5).square().mean() + (rgb - torch.tensor([0.1, 0.6, 0.9])).square().mean()
        loss.backward()
        for name, parameter in made.named_parameters():
            assert_finite(parameter.grad)
            assert float(parameter.grad.abs().max()) > 1e-9, name


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_few_steps_make_a_difference(encoding: str) -> None:
    """Matter in one half, nothing in the other; red here, blue there."""
    made = field(encoding)
    optimizer = torch.optim.Adam(made.parameters(), lr=0.02, eps=1e-15)
    points, directions, _ = inputs(500)
    steps, side = torch.full((500,), 0.2), (points[:, 0] > 0).float()
    color = torch.stack([side, torch.zeros(500), 1 - side], dim=1)
    for _ in range(100):
        alpha, rgb = made(points, directions, steps)
        loss = (alpha - side).square().mean() + (rgb - color).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 0.05  # 0.7 of a grey field


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_samples_have_opacity_and_light(encoding: str) -> None:
    made, (points, directions, steps) = learned(encoding), inputs()
    alpha, rgb = made(points, directions, steps)
    assert alpha.shape == (60,)
    assert rgb.shape == (60, 3)
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert ((rgb >= 0) & (rgb <= 1)).all()
    assert_close(made.opacity(points, steps), alpha)
    assert alpha.std() > 1e-3
    assert made.is_density


@pytest.mark.parametrize("count", [0, 1])
def test_few_samples(count: int) -> None:
    made = field()
    alpha, rgb = made(*inputs(count))
    (alpha.sum() + rgb.sum()).backward()
    assert rgb.shape == (count, 3)
    assert_finite(made.encoding.table.grad)


def test_samples_in_a_row_let_through_the_product() -> None:
    made, (points, _, steps) = learned(), inputs()
    assert_close(1 - made.opacity(points, 3 * steps), (1 - made.opacity(points, steps)) ** 3, atol=1e-5)
    assert_close(made.opacity(points, torch.zeros(60)), torch.zeros(60))


@pytest.mark.parametrize("scale", [0.01, 30.0])
def test_the_unit_of_length_does_not_matter(scale: float) -> None:
    """A box, its points and its steps in millimetres are the same picture as in metres."""
    small, (points, directions, steps) = learned(), inputs()
    large = learned()
    large.load_state_dict(small.state_dict())
    shift = torch.tensor([5.0, -2.0, 1.0]) * scale
    large.place(small.box * scale + shift)
    for found, expected in zip(
        large(points * scale + shift, directions, steps * scale), small(points, directions, steps), strict=True
    ):
        assert_close(found, expected, atol=2e-3)


@pytest.mark.parametrize("sides", [(2.0, 2.0, 2.0), (1.0, 8.0, 3.0)])
@pytest.mark.parametrize("start", [0.5, 4.0])
def test_at_birth_a_way_through_the_box_is_as_dark_as_was_asked(sides: tuple, start: float) -> None:
    made = field(start_density=start)
    made.place(torch.tensor([[0.0] * 3, sides]))
    points = torch.rand(20, 3) * torch.tensor(sides)
    through = made.opacity(points, torch.full((20,), max(sides)))
    assert_close(through, -torch.expm1(-torch.full((20,), start)), rtol=0.01)


@pytest.mark.parametrize("sees", [True, False])
def test_directions_of_rays_are_those_of_their_samples(sees: bool) -> None:
    made = learned(sees=sees)
    points, directions, steps = inputs()
    ray_index = torch.randint(7, (60,))
    rays = made(points, directions[:7], steps, ray_index)
    for found, expected in zip(rays, made(points, directions[:7][ray_index], steps), strict=True):
        assert_close(found, expected)


def test_light_may_depend_on_directions_and_matter_not() -> None:
    points, directions, steps = inputs()
    for sees in (True, False):
        made = learned(sees=sees)
        (alpha, rgb), (again, turned) = (made(points, sign * directions, steps) for sign in (1, -1))
        assert torch.equal(alpha, again)
        assert torch.equal(rgb, turned) != sees


def test_what_is_very_dense_is_opaque_and_can_become_thin_again() -> None:
    raw = torch.tensor([-200.0, 0.0, 11.0, 12.0, 500.0], requires_grad=True)
    found = _TruncatedExp.apply(raw)
    assert_close(found, raw.detach().clamp(max=12.0).exp())
    found.sum().backward()
    assert_close(raw.grad, found.detach())
    within = torch.linspace(-3, 3, 9, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(_TruncatedExp.apply, within)


def test_perceptrons_end_without_a_bend() -> None:
    net = perceptron([4, 8, 8, 2])
    kinds = [type(layer) for layer in net]
    assert kinds == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert all(layer.bias is None for layer in net if isinstance(layer, nn.Linear))
    assert (net(torch.randn(50, 4)) < 0).any()
    assert_close(net(torch.zeros(1, 4)), torch.zeros(1, 2))


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_samples_are_asked_about_where_they_lie(far, encoding: str) -> None:  # noqa: F811
    made = field(encoding)
    for module in made.modules():
        for name, buffer in module._buffers.items():
            module._buffers[name] = buffer.to(far)
        for name, parameter in module._parameters.items():
            module._parameters[name] = None if parameter is None else nn.Parameter(parameter.detach().to(far))
    points, directions, steps = (tensor.to(far) for tensor in inputs(9))
    alpha, rgb = made(points, directions[:2], steps, torch.tensor([0, 1, 1, 0, 1, 0, 0, 0, 1], device=far))
    (alpha.sum() + rgb.sum()).backward()
    assert all(isinstance(parameter.grad, Far) for parameter in made.parameters())


@pytest.mark.parametrize(
    "wrong", [{"width": 0}, {"density_layers": -1}, {"color_layers": -1}, {"memory": -1}, {"start_density": 0.0}]
)
def test_fields_that_cannot_be_are_refused(wrong: dict[str, float]) -> None:
    ((name, value),) = wrong.items()
    with pytest.raises(UserError, match=rf"field\.{name} must be .*, got {value}"):
        GridField(HashGrid(2, 2, 6, 4, 8), **wrong)


def test_a_field_needs_a_light_that_depends_on_something() -> None:
    with pytest.raises(UserError, match=r"field\.memory is 0 and field\.directions null"):
        GridField(HashGrid(2, 2, 6, 4, 8), memory=0)
