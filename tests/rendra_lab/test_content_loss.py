"""The content loss: laws, scale, networks, and what it leaves untouched."""

from pathlib import Path

import pytest
import torch
from assertions import assert_close
from skimage import data

from rendra_lab import content_loss
from rendra_lab.content_loss import ContentLoss
from rendra_lab.errors import UserError
from rendra_lab.networks import efficientnet_lite
from rendra_lab.networks.feature_pyramids import RandomPyramid
from rendra_lab.terms import LossTerm

NETWORKS = [
    pytest.param(
        "lite0", marks=pytest.mark.skipif(not efficientnet_lite.has_weights(), reason="needs the extra [features]")
    ),
    "random",
]


def photo() -> torch.Tensor:
    return torch.from_numpy(data.chelsea()[:64, 100:164]).movedim(-1, 0)[None].float() / 255


@pytest.mark.parametrize("network", NETWORKS)
def test_equal_pictures_cost_nothing_and_worse_ones_more(network: str) -> None:
    loss, target = ContentLoss(network), photo()  # type: ignore[arg-type]
    assert float(loss(target, target)) == 0
    noise = torch.randn_like(target)
    costs = [float(loss((target + amount * noise).clamp(0, 1), target)) for amount in (0.02, 0.1, 0.4)]
    assert 0 < costs[0] < costs[1] < costs[2] < 6


@pytest.mark.parametrize("network", NETWORKS)
def test_gradients_reach_the_prediction_alone_and_lower_the_loss(network: str) -> None:
    loss, target = ContentLoss(network), photo().requires_grad_()  # type: ignore[arg-type]
    prediction = (photo() + 0.1 * torch.randn(1, 3, 64, 64)).clamp(0, 1).requires_grad_()
    value = loss(prediction, target)
    value.backward()
    assert target.grad is None
    assert prediction.grad is not None
    assert bool(prediction.grad.isfinite().all())
    step = 1e-4 * prediction.grad / prediction.grad.norm()
    assert float(loss((prediction - step).detach(), target)) < float(value.detach())


def test_the_sum_is_that_of_the_formula() -> None:
    weights, pyramid = (0.5, 0.25, 2.0), RandomPyramid()
    prediction, target = torch.rand(2, 3, 16, 16), torch.rand(2, 3, 16, 16)
    levels = zip(weights, pyramid.levels(prediction, 3), pyramid.levels(target, 3), strict=True)
    expected = sum(weight * (seen - true).abs().mean() / true.abs().mean() for weight, seen, true in levels)
    assert_close(ContentLoss("random", weights=weights)(prediction, target), expected, rtol=1e-6)
    both = ContentLoss("random", weights=(1.0,))(prediction.double(), target.double())
    assert both.dtype == torch.float64


def test_it_is_in_no_checkpoint_and_trains_nothing() -> None:
    term = LossTerm(ContentLoss("random"), 10.0, "rgb", "target")
    assert not term.state_dict()
    assert not list(term.parameters())


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"network=vgg19 takes path=FILE"):
        ContentLoss("vgg19")
    with pytest.raises(UserError, match="nothing else does"):
        ContentLoss("random", path="x.pth")
    with pytest.raises(UserError, match="no file"):
        ContentLoss("vgg19", path=str(tmp_path / "x.pth"))
    with pytest.raises(UserError, match="weights for 1 to 5 levels, got 6"):
        ContentLoss("random", weights=[1.0] * 6)
    with pytest.raises(ValueError, match=r"of one shape, got \(1, 3, 8, 8\) and \(1, 3, 8, 9\)"):
        ContentLoss("random")(torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 9))


def test_without_the_extra_random_weights_stand_in_and_say_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(content_loss.efficientnet_lite, "has_weights", lambda: False)
    assert ContentLoss().name == "random"
    assert "random weights" in capsys.readouterr().out
