"""How weights begin."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from rendra_lab.networks.initialization import he_init


@torch.no_grad()
@pytest.mark.parametrize("slope", [0.0, 0.2, 1.0])
def test_ten_layers_deep_an_output_varies_as_the_input_does(slope: float) -> None:
    torch.manual_seed(0)
    x = torch.randn(512, 256)
    usual = x
    for _ in range(10):
        layer, twin = nn.Linear(256, 256), nn.Linear(256, 256)
        he_init(layer, slope)
        assert not layer.bias.any()
        x, usual = F.leaky_relu(layer(x), slope), F.leaky_relu(twin(usual), slope)
    assert 0.5 < float(x.square().mean()) < 2.0
    assert float(usual.var(0).mean()) < 1e-3


@torch.no_grad()
def test_what_is_added_varies_as_one_would() -> None:
    torch.manual_seed(0)
    x, layers = torch.randn(4, 8, 16, 16), [nn.Conv2d(8, 64, 3, padding=1, bias=False) for _ in range(3)]
    for layer in layers:
        he_init(layer, slope=1.0, summands=3)
    total = torch.stack([layer(x) for layer in layers]).sum(0)
    assert 0.8 < float(total[:, :, 1:-1, 1:-1].square().mean()) < 1.2
