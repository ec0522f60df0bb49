"""Scores of generative models as the named metrics of a task."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rendra_lab.generative.features import FeatureNetwork
from rendra_lab.generative.frechet import FrechetDistance
from rendra_lab.generative.kernel_distance import KernelDistance
from rendra_lab.generative.picture_sets import PictureSetDistance
from rendra_lab.terms import MetricTerm

Distance = Literal["frechet", "kernel"]

_DISTANCES: dict[Distance, type[PictureSetDistance]] = {"frechet": FrechetDistance, "kernel": KernelDistance}


def generative_term(
    distance: Distance,
    features: FeatureNetwork | None,
    cache: str | Path | None = None,
    prediction: str = "rgb",
    target: str | None = "rgb",
) -> MetricTerm | None:
    """The distance of all made pictures of an evaluation from all real ones; None without a network.

    Args:
        distance: frechet or kernel.
        features: the network that sees the pictures; None switches the term off.
        cache: folder in which what the network sees in real pictures is kept for later runs.
        prediction: the field of made pictures (B, 3, H, W).
        target: the batch's field of real ones; null where all come with `PictureSetDistance.reference`.
    """
    if features is None:
        return None
    return MetricTerm(_DISTANCES[distance](features, cache), prediction=prediction, target=target)
