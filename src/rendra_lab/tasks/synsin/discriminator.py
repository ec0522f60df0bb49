"""Real or made up? Asked of patches of a picture, at several resolutions.

Isola et al., "Image-to-Image Translation with Conditional Adversarial Networks", CVPR 2017 (patches); Wang et al.,
"pix2pixHD", CVPR 2018 (scales, feature matching); sizes are those of SynSin's code.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import spectral_norm

from rendra_lab.settings import Positive
from rendra_lab.tasks.synsin.records import Verdict

_INIT_GAIN = 0.02  # Xavier's, of every convolution
_WIDEST = 8  # times the width of the first layer


class MultiScaleDiscriminator(nn.Module):
    """The same network with weights of its own for the picture, for the picture at half its size, and so on.

    Args:
        scales: how many.
        layers: of 4x4 convolutions before the scores; all but the last of them halve the resolution.
        base: channels of the first.
    """

    def __init__(self, scales: Positive = 2, layers: Positive = 4, base: Positive = 64) -> None:
        super().__init__()
        self.scales = nn.ModuleList(_PatchDiscriminator(layers, base) for _ in range(scales))

    def forward(self, pictures: Tensor) -> Verdict:
        """What every layer makes of pictures (B, 3, H, W), sRGB in [0, 1]; the last are scores (B, 1, h, w)."""
        x, verdicts = 2 * pictures - 1, []
        for number, network in enumerate(self.scales):
            if number:
                x = F.avg_pool2d(x, 3, stride=2, padding=1, count_include_pad=False)
            verdicts.append(network(x))
        return Verdict(tuple(verdicts))


class _PatchDiscriminator(nn.Module):
    """One scale: 4x4 convolutions; those between the first and the scores spectral- and instance-normalised."""

    def __init__(self, layers: int, base: int) -> None:
        super().__init__()
        widths = [base * min(2**number, _WIDEST) for number in range(layers)]
        steps: list[nn.Module] = [nn.Sequential(_conv(3, base, 2), nn.LeakyReLU(0.2))]
        for number in range(1, layers):
            stride = 1 if number == layers - 1 else 2
            conv = spectral_norm(_conv(widths[number - 1], widths[number], stride, bias=False))
            steps.append(nn.Sequential(conv, nn.InstanceNorm2d(widths[number]), nn.LeakyReLU(0.2)))
        steps.append(_conv(widths[-1], 1, 1))
        self.steps = nn.ModuleList(steps)

    def forward(self, x: Tensor) -> tuple[Tensor, ...]:
        outputs = []
        for step in self.steps:
            x = step(x)
            outputs.append(x)
        return tuple(outputs)


def _conv(channels_in: int, channels_out: int, stride: int, bias: bool = True) -> nn.Conv2d:
    conv = nn.Conv2d(channels_in, channels_out, 4, stride, padding=2, bias=bias)
    nn.init.xavier_normal_(conv.weight, _INIT_GAIN)
    if conv.bias is not None:
        torch.nn.init.zeros_(conv.bias)
    return conv
