"""Feature fields: encodings, what depends on what, and points a few at a time."""

import math

import pytest
import torch
from assertions import assert_close

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe import feature_fields
from rendra_lab.tasks.giraffe.feature_fields import FeatureField, Stretches, octaves


def at(rows: int = 5, samples: int = 4, things: int = 3) -> Stretches:
    wanted = torch.arange(samples) < torch.randint(0, samples + 1, (rows, 1))
    return Stretches(
        torch.randint(things, (rows,)), torch.randn(rows, 3), torch.randn(rows, 3), torch.rand(rows, samples), wanted
    )


def small(**settings: object) -> FeatureField:
    return FeatureField(**{"features": 6, "hidden": 8, "layers": 5, "code": 4, "skips": [2], **settings})


def test_octaves_are_the_published_encoding() -> None:
    x = torch.randn(3, 7, dtype=torch.float64)
    expected = [wave(2.0**i * math.pi * x) for i in range(6) for wave in (torch.sin, torch.cos)]
    assert_close(octaves(x, 6), torch.cat(expected), atol=1e-11)
    assert_close(octaves(x.float(), 10)[-6:], torch.cat([f(512 * math.pi * x) for f in (torch.sin, torch.cos)]), 2e-3)


def test_the_published_sizes() -> None:
    def size(*args: int, **settings: object) -> int:
        return sum(each.numel() for each in FeatureField(*args, **settings).parameters())

    assert size(skips=[4]) == 266_241
    assert size(128, 64, 4, 128) == 47_041
    assert size(256, skips=[4]) == 282_753
    assert size(256, 64, 4, 128) == 55_361


@torch.no_grad()
def test_shape_alone_decides_the_density() -> None:
    field, points = small().double(), at()  # the same point, reached from two sides, differs by roundings
    points = Stretches(points.thing, *(each.double() for each in points[1:4]), torch.ones_like(points.wanted))
    shape, appearance, other_shape, other_appearance = torch.randn(4, 3, 4, dtype=torch.float64)
    usual = field(points, shape, appearance)
    painted = field(points, shape, other_appearance)
    other_way = points._replace(
        origins=points.origins + 2 * points.depths[:, :1] * points.directions,
        directions=-points.directions,
        depths=points.depths[:, :1],
        wanted=points.wanted[:, :1],
    )
    from_behind = field(other_way, shape, appearance)
    assert_close(painted.density, usual.density)
    assert_close(from_behind.density, usual.density[:, :1])
    assert float((painted.hidden - usual.hidden).abs().max()) > 1e-3
    assert float((from_behind.hidden - usual.hidden[:, :1]).abs().max()) > 1e-3
    assert float((field(points, other_shape, appearance).density - usual.density).abs().max()) > 1e-3


@torch.no_grad()
def test_views_have_no_length_and_may_be_downscaled_as_published() -> None:
    torch.manual_seed(0)
    field, points, codes = small(), at(), torch.randn(2, 3, 4)
    points = points._replace(wanted=torch.ones_like(points.wanted))
    longer = points._replace(directions=3 * points.directions, depths=points.depths / 3)
    assert_close(field(longer, *codes).hidden, field(points, *codes).hidden, 1e-4)
    quirky = small(views_downscaled=True)
    quirky.load_state_dict(field.state_dict())
    assert_close(quirky(points, *codes).density, field(points, *codes).density)
    assert float((quirky(points, *codes).hidden - field(points, *codes).hidden).abs().max()) > 1e-3


def test_without_gradients_a_few_points_at_a_time_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feature_fields, "_FEW", 8)
    field, points, codes = small().double(), at(9), torch.randn(2, 3, 4, dtype=torch.float64)
    points = Stretches(*(each.double() if each.is_floating_point() else each for each in points))
    usual = field(points, *codes)
    with torch.no_grad():
        few = field(points, *codes)
        nowhere = field(points._replace(wanted=torch.zeros_like(points.wanted)), *codes)
    assert_close(few.density[points.wanted], usual.density[points.wanted], 1e-12)
    assert_close(few.hidden[points.wanted], usual.hidden[points.wanted], 1e-12)
    assert float(nowhere.density.abs().max()) == 0


def test_the_last_layer_waits_for_the_sum() -> None:
    field = small()
    hidden, weights = torch.randn(2, 5, 8), torch.rand(2, 5)
    late = field.to_features((weights[..., None] * hidden).sum(1), weights.sum(1))
    assert_close(late, (weights[..., None] * field.out(hidden)).sum(1))


def test_gradients_in_float64_and_of_nothing() -> None:
    field, points = small().double(), at(3, 2)
    shape, appearance = torch.randn(2, 3, 4, dtype=torch.float64, requires_grad=True)
    points = Stretches(*(each.double() if each.is_floating_point() else each for each in points))
    assert torch.autograd.gradcheck(lambda *codes: field(points, *codes), (shape, appearance))
    nothing = Stretches(*(each[:0] for each in points))
    values = field(nothing, shape, appearance)
    assert values.hidden.shape == (0, 2, 8)
    values.hidden.sum().backward()
    with torch.no_grad():
        assert field(nothing, shape, appearance).density.shape == (0, 2)


def test_a_skip_behind_the_last_layer_is_none() -> None:
    assert small(skips=[4]).skips == ()
    with pytest.raises(UserError, match=r"among the layers 1 to 4, got \[5\]"):
        small(skips=[5])


@torch.no_grad()
def test_places_differ_from_the_start_and_hardly_as_published() -> None:
    spread = []
    for torch_init in (False, True):
        torch.manual_seed(0)
        field = FeatureField(16, 32, 6, 8, 4, 2, [3], torch_init=torch_init)
        spread.append(float(field(at(), torch.zeros(3, 8), torch.zeros(3, 8)).density.std()))
    assert spread[0] > 0.2
    assert spread[1] < 0.5 * spread[0]
