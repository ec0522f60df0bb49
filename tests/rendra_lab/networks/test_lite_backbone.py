"""A backbone that begins with what ImageNet taught, and goes on learning."""

import pytest
import torch
from torch import nn

from rendra_lab.errors import UserError
from rendra_lab.networks import efficientnet_lite
from rendra_lab.networks.efficientnet_lite import EfficientNetLite0
from rendra_lab.networks.lite_backbone import LiteBackbone


def norms(backbone: LiteBackbone) -> list[nn.BatchNorm2d]:
    return [part for part in backbone.modules() if isinstance(part, nn.BatchNorm2d)]


def test_it_sees_what_its_network_sees() -> None:
    pictures = torch.rand(2, 3, 50, 70)
    maps = LiteBackbone("lite0").train()(pictures)
    for found, wanted, channels in zip(
        maps, EfficientNetLite0.pretrained().levels(pictures)[1:], (24, 40, 112, 320), strict=True
    ):
        torch.testing.assert_close(found, wanted, atol=1e-4, rtol=1e-4)
        assert found.shape[1] == channels
    assert [each.shape[2:] for each in maps] == [(13, 18), (7, 9), (4, 5), (2, 3)]


def test_what_was_learned_stays_the_measure() -> None:
    backbone = LiteBackbone("lite0").train()
    before = [norm.running_mean.clone() for norm in norms(backbone)]
    sum(each.square().mean() for each in backbone(torch.rand(2, 3, 32, 32))).backward()
    assert all(torch.equal(norm.running_mean, mean) for norm, mean in zip(norms(backbone), before, strict=True))
    learning = {name for name, each in backbone.named_parameters() if each.grad is not None}
    assert len(learning) == sum(isinstance(part, nn.Conv2d) for part in backbone.modules())


def test_random_weights_learn_their_norms_too() -> None:
    backbone = LiteBackbone("random").train()
    sum(each.square().mean() for each in backbone(torch.rand(2, 3, 32, 32))).backward()
    assert all(each.grad is not None for each in backbone.parameters())
    assert float(norms(backbone)[0].running_mean.abs().max()) > 0
    LiteBackbone("lite0").load_state_dict(backbone.state_dict())


def test_without_the_extra_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(efficientnet_lite, "find_spec", lambda _: None)
    assert not LiteBackbone("installed").is_pretrained
    assert "rendra[features]" in capsys.readouterr().out
    with pytest.raises(UserError, match="features"):
        LiteBackbone("lite0")
