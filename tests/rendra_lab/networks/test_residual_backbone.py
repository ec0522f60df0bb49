"""Residual backbones: published sizes and names, weights from files, and norms for every batch."""

from pathlib import Path

import pytest
import torch
from assertions import assert_close
from safetensors.torch import save_file
from torch import Tensor, nn

from rendra_lab.errors import UserError
from rendra_lab.networks.normalization import FrozenBatchNorm, norm_of
from rendra_lab.networks.residual_backbone import ResidualBackbone

_TINY = {"depths": (1, 2, 1, 1), "widths": (4, 6, 8, 10), "block": "basic"}


def sizes(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def weights_of(network: nn.Module) -> dict[str, Tensor]:
    return {name: torch.rand_like(value) + 0.1 for name, value in network.state_dict().items() if value.ndim}


def test_resnet50_has_the_published_size_names_and_resolutions() -> None:
    with torch.device("meta"):
        network = ResidualBackbone(norm="batch")
    assert sizes(network) == 25_557_032 - 2_049_000  # torchvision's resnet50 without its classifier
    names = network.state_dict()
    assert len(names) == 320 - 2
    assert names["layer1.0.downsample.0.weight"].shape == (256, 64, 1, 1)
    assert names["layer3.5.conv2.weight"].shape == (256, 256, 3, 3)
    assert "layer4.2.bn3.num_batches_tracked" in names
    strides = {name: module.stride[0] for name, module in network.named_modules() if isinstance(module, nn.Conv2d)}
    assert (strides["layer2.0.conv1"], strides["layer2.0.conv2"]) == (1, 2)
    assert network.channels == (256, 512, 1024, 2048)


def test_resnet18_is_one_of_them() -> None:
    with torch.device("meta"):
        network = ResidualBackbone((2, 2, 2, 2), block="basic", norm="batch")
    assert sizes(network) == 11_689_512 - 513_000
    assert "downsample.0.weight" not in dict(network.layer1.named_parameters())


@pytest.mark.parametrize(("height", "width"), [(137, 137), (64, 96), (33, 1)])
def test_maps_have_ceilings_of_halves(height: int, width: int) -> None:
    network = ResidualBackbone(**_TINY)
    maps = network(torch.rand(2, 3, height, width))
    assert [each.shape for each in maps] == [
        (2, channels, -(-height // stride), -(-width // stride))
        for channels, stride in zip(network.channels, network.strides, strict=True)
    ]


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
def test_weights_of_a_file_are_taken_by_name(suffix: str, tmp_path: Path) -> None:
    state = weights_of(ResidualBackbone(**_TINY, norm="batch"))
    path = tmp_path / f"weights{suffix}"
    more = {**state, "fc.weight": torch.zeros(3, 10), "fc.bias": torch.zeros(3)}
    save_file(more, path) if suffix == ".safetensors" else torch.save(more, path)
    read = ResidualBackbone(**_TINY, weights=path, frozen_stages=2)
    assert all(torch.equal(value, state[name]) for name, value in read.state_dict().items())
    own = ResidualBackbone(**_TINY, norm="batch", weights=path).eval()
    pictures = torch.rand(2, 3, 32, 32)
    for first, second in zip(read.train()(pictures), own(pictures), strict=True):
        assert_close(first, second, atol=1e-3, rtol=1e-4)
    learning = {name.partition(".")[0] for name, one in read.named_parameters() if one.requires_grad}
    assert learning == {"layer2", "layer3", "layer4"}
    assert all(one.requires_grad for one in own.parameters())


def test_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no file .*none\.pth with the weights of this residual network"):
        ResidualBackbone(**_TINY, weights=tmp_path / "none.pth")
    state = weights_of(ResidualBackbone(**_TINY, norm="batch"))
    torch.save({**state, "layer2.0.conv1.weight": torch.zeros(6, 4, 1, 1)}, tmp_path / "other.pth")
    with pytest.raises(
        UserError, match=r"layer2.0.conv1.weight must be numbers \(6, 4, 3, 3\), found \(6, 4, 1, 1\)"
    ):
        ResidualBackbone(**_TINY, weights=tmp_path / "other.pth")
    (tmp_path / "words.safetensors").write_text("these are no weights")
    with pytest.raises(UserError, match="cannot be read as weights of this residual network"):
        ResidualBackbone(**_TINY, weights=tmp_path / "words.safetensors")


def test_numbers_that_cannot_be_are_refused() -> None:
    with pytest.raises(UserError, match=r"four depths, four widths.*depths=\[1, 1\]"):
        ResidualBackbone((1, 1))


def test_frozen_stages_without_a_file_learn() -> None:
    assert all(one.requires_grad for one in ResidualBackbone(**_TINY, frozen_stages=3).parameters())


def test_blocks_begin_as_the_identity() -> None:
    network = ResidualBackbone(**_TINY, norm="group").double()
    second = network.layer2[1]
    x = torch.rand(2, 6, 5, 5, dtype=torch.float64)
    assert torch.equal(second(x), x)


def test_pictures_do_not_see_each_other_without_batch_norm() -> None:
    pictures = torch.rand(3, 3, 40, 40)
    for norm in ("group", "frozen"):
        network = ResidualBackbone(**_TINY, norm=norm)
        for together, alone in zip(network(pictures), network(pictures[1:2]), strict=True):
            assert_close(together[1:2], alone, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("channels", "groups"), [(256, 32), (64, 8), (24, 3), (10, 1), (96, 12), (2048, 32)])
def test_groups_have_eight_channels_or_more(channels: int, groups: int) -> None:
    norm = norm_of("group", channels)
    assert isinstance(norm, nn.GroupNorm)
    assert norm.num_groups == groups


def test_a_frozen_batch_norm_is_one_that_is_not_trained() -> None:
    frozen, norm = FrozenBatchNorm(5), nn.BatchNorm2d(5).eval()
    for value in norm.buffers():
        if value.ndim:
            value.copy_(torch.rand(5) + 0.5)
    frozen.load_state_dict({k: v for k, v in norm.state_dict().items() if v.ndim})
    x = torch.rand(2, 5, 3, 3)
    assert_close(frozen.train()(x), norm(x))
    assert not list(frozen.parameters())
