"""TensorProperties, broadcasting, image sizes, and sampling at NDC points."""

import copy

import numpy as np
import pytest
import torch
from assertions import assert_close
from torch import nn

from rendra.renderer.utils import (
    TensorProperties,
    convert_to_tensors_and_broadcast,
    format_tensor,
    ndc_grid_sample,
    ndc_to_grid_sample_coords,
    parse_image_size,
)


class Lamp(TensorProperties):
    """The smallest class that has properties."""

    def __init__(self, power=1.0, place=((0.0, 0, 0),), name="lamp", device="cpu") -> None:
        super().__init__(device=device, power=power, place=place, name=name)

    def clone(self):  # type: ignore[override]
        return super().clone(Lamp(device=self.device))


def test_properties_share_one_batch_size() -> None:
    lamp = Lamp(power=np.array([1.0, 2, 3]), place=torch.ones(1, 3, dtype=torch.float64))
    assert len(lamp) == 3
    assert lamp.power.dtype == torch.float32
    assert lamp.place.shape == (3, 3)
    assert lamp.place.dtype == torch.float64
    assert lamp.name == "lamp"
    assert not lamp.isempty()
    assert Lamp(power=torch.zeros(0)).isempty()
    assert len(TensorProperties()) == 0


def test_elements_are_read_and_written_in_place() -> None:
    lamp = Lamp(power=[1.0, 2, 3])
    assert_close(lamp[1].power, torch.tensor(2.0))
    assert lamp[0].name == "lamp"
    lamp[1].power = 5.0
    lamp[0:2].place = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    assert_close(lamp.power, [1.0, 5, 3])
    assert_close(lamp.place, [[1.0, 2, 3], [4, 5, 6], [0, 0, 0]])
    lamp[2].place = (7, 8, 9)
    assert_close(lamp.place[2], [7.0, 8, 9])


def test_wrong_elements_are_refused() -> None:
    lamp = Lamp(power=[1.0, 2, 3])
    with pytest.raises(ValueError, match=r"Expected place of shape \(3,\); got \(2,\)"):
        lamp[1].place = (1.0, 2.0)
    with pytest.raises(ValueError, match=r"Expected power of shape \(\)"):
        lamp[1].power = [[1.0]]
    with pytest.raises(AttributeError, match="colour"):
        lamp[1].colour = 1.0
    with pytest.raises(AttributeError, match="to be a tensor"):
        lamp[1].name = "other"
    with pytest.raises(ValueError, match="int or slice"):
        lamp["a"]
    with pytest.raises(IndexError):
        lamp[3].power  # noqa: B018


def test_values_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match=r"non-broadcastable sizes \[2, 3\]"):
        Lamp(power=[1.0, 2], place=torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"power.*not broadcastable"):
        Lamp(power={})


def test_a_clone_is_separate_and_keeps_the_graph() -> None:
    power = torch.ones(2, requires_grad=True)
    lamp = Lamp(power=power)
    other = lamp.clone()
    assert len(other) == 2
    other.power.sum().backward()
    assert_close(power.grad, [1.0, 1])
    other[0].power = 9.0
    assert_close(lamp.power.detach(), [1.0, 1])
    lamp.power = nn.Parameter(torch.tensor([3.0, 4]))
    assert_close(lamp.clone().power.detach(), [3.0, 4])
    assert copy.deepcopy(Lamp()).name == "lamp"


def test_a_parent_module_takes_the_tensors_along() -> None:
    parent = nn.Module()
    parent.lamp = Lamp()
    parent.double()
    assert parent.lamp.power.dtype == torch.float64
    moved = Lamp().to("meta")
    assert moved.power.device == moved.device == torch.device("meta")


def test_gathering_repeats_by_index() -> None:
    lamp = Lamp(power=[1.0, 2, 3])
    assert lamp.gather_props(torch.tensor([2, 0, 0, 1])) is lamp
    assert_close(lamp.power, [3.0, 1, 1, 2])
    one = Lamp(power=2.0).gather_props(torch.tensor([0, 0]))
    assert one.power.shape == (1,)


def test_formats() -> None:
    assert format_tensor(3).shape == (1,)
    assert format_tensor(torch.tensor(3)).dtype == torch.int64
    assert format_tensor([1, 2], dtype=torch.float64).dtype == torch.float64
    a, b = convert_to_tensors_and_broadcast(1.0, torch.zeros(4, 2), dtype=torch.float64)
    assert a.shape == (4,)
    assert b.shape == (4, 2)
    a, b = convert_to_tensors_and_broadcast(1.0, torch.zeros(0, 2))
    assert a.shape == (0,)
    assert b.shape == (0, 2)


def test_image_sizes() -> None:
    assert parse_image_size(5) == (5, 5)
    assert parse_image_size([3, 4]) == parse_image_size((3, 4)) == (3, 4)
    for wrong, message in (((1, 2, 3), r"\(H, W\)"), ((0, 4), "greater than 0"), ((1.5, 2), "integers")):
        with pytest.raises(ValueError, match=message):
            parse_image_size(wrong)


@pytest.mark.parametrize("size", [(4, 4), (3, 8), (8, 3)])
def test_sampling_at_pixel_centres_gives_the_pixels(size: tuple[int, int]) -> None:
    h, w = size
    images = torch.rand(2, 5, h, w)
    short = min(h, w)
    x = (w / 2 - (torch.arange(w) + 0.5)) / (short / 2)
    y = (h / 2 - (torch.arange(h) + 0.5)) / (short / 2)
    grid = torch.stack((x.expand(h, w), y[:, None].expand(h, w)), dim=-1).expand(2, h, w, 2)
    assert_close(ndc_grid_sample(images, grid), images)
    assert ndc_grid_sample(images, grid[:, 0, 0], mode="nearest").shape == (2, 5)
    assert_close(ndc_to_grid_sample_coords(torch.tensor([w / short, h / short]), size), [-1.0, -1])


def test_sampling_refuses() -> None:
    images, grid = torch.zeros(2, 1, 4, 4), torch.zeros(2, 3, 2)
    with pytest.raises(ValueError, match="4-dimensional"):
        ndc_grid_sample(images[0], grid)
    with pytest.raises(ValueError, match="batch dimension"):
        ndc_grid_sample(images[:1], grid)
    with pytest.raises(ValueError, match="last dimension"):
        ndc_grid_sample(images, torch.zeros(2, 3, 3))
    for size in ((4,), (4, 0)):
        with pytest.raises(ValueError, match="positive integers"):
            ndc_to_grid_sample_coords(grid, size)
