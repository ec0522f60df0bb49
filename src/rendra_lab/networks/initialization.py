"""How weights begin."""

from __future__ import annotations

from torch import nn


def he_init(layer: nn.Linear | nn.Conv2d, slope: float = 0.0, summands: int = 1) -> None:
    """Weights such that deep layers vary as much with the input as the first ones, and biases of 0.

    He et al., "Delving Deep into Rectifiers", ICCV 2015, Eq. 10 and 15. PyTorch's own weights have a sixth of this
    variance: behind a few layers with ReLUs they begin with nearly the same output for every input.

    Args:
        layer: its weights are drawn from PyTorch's global generator.
        slope: of the leaky ReLU through which the output goes; 0 for a ReLU, 1 for none.
        summands: layers whose outputs are added before that, this one among them.
    """
    nn.init.kaiming_normal_(layer.weight, slope)
    layer.weight.data /= summands**0.5
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
