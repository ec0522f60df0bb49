"""What scores of a set of made pictures have in common: two streams of feature vectors, and how many there were."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor
from torchmetrics import Metric

from rendra_lab.generative.feature_statistics import FeatureStatistics, reference_statistics
from rendra_lab.generative.features import FeatureNetwork

log = logging.getLogger(__name__)

Who = Literal["made", "real"]


class PictureSetDistance(Metric, ABC):
    """How far made pictures are from real ones, as sets: 0 where both are the same.

    Real pictures come with `reference`, once for all evaluations, or beside the made ones with `update`. Sums are
    float64, add up over batches and processes, and do not depend on how pictures are batched but for rounding.

    Args:
        features: the network that sees the pictures.
        cache: folder in which what the network sees in real pictures is kept by content, for later runs; None sees
            them anew in every run.
    """

    full_state_update = False
    made_count: Tensor
    real_count: Tensor

    def __init__(self, features: FeatureNetwork, cache: str | Path | None = None) -> None:
        super().__init__()
        self.features = features
        self.cache = None if cache is None else Path(cache)
        self.last = ""  # the newest value with its counts, in words
        self._known: FeatureStatistics | None = None
        self._has_warned = False
        for who in ("made", "real"):
            self.add_state(f"{who}_count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    @property
    @abstractmethod
    def name(self) -> str:
        """What it is called, the network included."""

    def reference(self, batches: Iterable[Any], field: str = "rgb") -> None:
        """Takes real pictures to compare with, until it gets others; `reset` leaves them. See `reference_statistics`.

        In a run of several processes each takes all of them.
        """
        self._known = reference_statistics(self.features, batches, field, self.cache)
        self._computed = None  # torchmetrics' memory of its last answer

    @property
    def has_reference(self) -> bool:
        """Whether real pictures need not come with `update`."""
        return self._known is not None

    @torch.no_grad()
    def update(self, made: Tensor, real: Tensor | None = None) -> None:
        """Adds pictures (B, 3, H, W), sRGB in [0, 1]; real ones are not looked at where there is a reference."""
        self._take("made", made)
        if self._known is None and real is not None:
            self._take("real", real)

    @torch.no_grad()
    def compute(self) -> Tensor:
        """The distance, a scalar; NaN with fewer than two pictures of either kind. Its counts are logged."""
        made, real = self.counts()
        value = self._distance() if min(made, real) > 1 else torch.nan
        self.last = (
            f"{self.name} {value:.4g}: {made:,} made pictures, {real:,} real ones, {self.features.width:,} features"
        )
        log.info(self.last)
        self._warn(min(made, real))
        return torch.tensor(value, device=self.device)

    def counts(self) -> tuple[int, int]:
        """How many made and how many real pictures there are."""
        return int(self.made_count), int(self.real_count) if self._known is None else self._known.count

    @abstractmethod
    def _add(self, who: Who, vectors: Tensor) -> None:
        """Adds feature vectors (B, D)."""

    @abstractmethod
    def _distance(self) -> float:
        """Of at least two pictures of each kind."""

    def _least(self) -> int:
        """Pictures of each kind below which the value means little."""
        return 2

    def _take(self, who: Who, pictures: Tensor) -> None:
        vectors = self.features(pictures, self.cache if who == "real" else None).to(self.device)
        setattr(self, f"{who}_count", getattr(self, f"{who}_count") + len(vectors))
        self._add(who, vectors)

    def _warn(self, count: int) -> None:
        if count < self._least() and not self._has_warned:
            self._has_warned = True
            log.warning(
                "%s of %d pictures means little: its %d features need at least %d, better ten times as many",
                self.name, count, self.features.width, self._least(),
            )  # fmt: skip


class CountedPictures(Metric):
    """How many pictures of either kind stand behind the scores of an evaluation: the smaller count of the two.

    Distances of sets shrink as the sets grow: their values mean something only beside this number.
    """

    full_state_update = False
    made: Tensor
    real: Tensor

    def __init__(self) -> None:
        super().__init__()
        for who in ("made", "real"):
            self.add_state(who, torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, made: Tensor, real: Tensor) -> None:
        """Adds the pictures of a batch, (B, ...) each."""
        self.made = self.made + len(made)
        self.real = self.real + len(real)

    def compute(self) -> Tensor:
        """The smaller count, a scalar."""
        return torch.minimum(self.made, self.real).float()
