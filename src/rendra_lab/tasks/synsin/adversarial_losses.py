"""What generator and discriminator want of the discriminator's verdicts; each loss is a scalar.

Hinge losses: Lim & Ye, "Geometric GAN", 2017. Feature matching: Wang et al., "pix2pixHD", CVPR 2018, Eq. 4.
A discriminator of several scales counts each the same, whatever its resolution.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.tasks.synsin.records import Verdict


def hinge_generator(fake: Verdict) -> Tensor:
    """Minus the mean score of what the generator made, averaged over the scales."""
    return torch.stack([-layers[-1].mean() for layers in fake.scales]).mean()


def hinge_discriminator(fake: Verdict, real: Verdict) -> Tensor:
    """The means of max(0, 1 + score) of the made and of max(0, 1 - score) of the real, added; scales averaged."""
    pairs = zip(fake.scales, real.scales, strict=True)
    return torch.stack([F.relu(1 + made[-1]).mean() + F.relu(1 - true[-1]).mean() for made, true in pairs]).mean()


def feature_matching(fake: Verdict, real: Verdict) -> Tensor:
    """Mean |difference| of each layer but the scores, summed over layers, averaged over scales.

    SynSin weighs it 10. No gradient reaches the verdict on the real.
    """
    of_scales = []
    for made, true in zip(fake.scales, real.scales, strict=True):
        layers = zip(made[:-1], true[:-1], strict=True)
        of_scales.append(torch.stack([F.l1_loss(one, other.detach()) for one, other in layers]).sum())
    return torch.stack(of_scales).mean()
