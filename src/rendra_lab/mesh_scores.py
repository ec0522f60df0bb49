"""How near rebuilt surfaces are to the true ones: the protocols of "Mesh R-CNN", and their metrics.

Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019, arXiv:1906.02739, Sec. 4.1. Points and normals are drawn evenly
from both surfaces; every point is compared with the nearest one of the other surface.
Letters: N pairs of surfaces, T thresholds. Predicted and true meshes of a pair are in the same frame and unit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import cosine_similarity

from rendra.ops import knn_points, sample_points_from_meshes
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.errors import UserError
from rendra_lab.latest_answers import remembered
from rendra_lab.metrics import MeanOverImages, Scores
from rendra_lab.records import TensorRecord
from rendra_lab.settings import Positive, Size
from rendra_lab.shape_records import Shapes
from rendra_lab.terms import MetricTerm

Measure = Literal["chamfer", "normal", "signed_normal", "precision", "recall", "f1"]
ProtocolName = Literal["scaled", "p2m"]

_WITH_THRESHOLD = ("precision", "recall", "f1")


@dataclass(frozen=True)
class Protocol:
    """How two surfaces are made comparable.

    Attributes:
        longest_side: both are scaled until the longest side of the true mesh's bounding box is this; None: they stay.
        factor: both are multiplied by this besides.
        thresholds: distances, after scaling, below which a point counts as hit.
    """

    longest_side: float | None
    factor: float
    thresholds: tuple[float, ...]


PROTOCOLS: dict[ProtocolName, Protocol] = {
    "scaled": Protocol(longest_side=10.0, factor=1.0, thresholds=(0.1, 0.2, 0.3, 0.4, 0.5)),
    # that of "Pixel2Mesh": 1e-4 and 2e-4 are squared distances there
    "p2m": Protocol(longest_side=None, factor=0.57, thresholds=(0.01, 0.014142)),
}
"""By name: `scaled` is the paper's own, `p2m` that of its predecessors."""


@dataclass(frozen=True)
class SurfaceScores(TensorRecord):
    """What each of N predicted surfaces scores."""

    chamfer: Float[Tensor, " N"]  # mean squared distances there and back, summed; after scaling
    normal: Float[Tensor, " N"]  # mean |cos| between normals of neighbours, of both ways; in [0, 1]
    signed_normal: Float[Tensor, " N"]  # the same of cos: inside-out surfaces are punished; in [-1, 1]
    precision: Float[Tensor, "N T"]  # percent of the predicted points with a true one nearer than the threshold
    recall: Float[Tensor, "N T"]  # percent of the true points with a predicted one nearer than that
    f1: Float[Tensor, "N T"]  # the harmonic mean of both, percent


@torch.no_grad()
def score_surfaces(
    predicted: Meshes, truth: Meshes, protocol: Protocol = PROTOCOLS["scaled"], samples: Positive = 10_000
) -> SurfaceScores:
    """The scores of N predicted meshes, each beside the true one of the same number.

    The points are the same at every call, whatever else is in the batch. A predicted mesh without faces is replaced
    by a sphere of radius 1 about the origin, as published.

    Args:
        predicted: N meshes.
        truth: N meshes, each with faces.
        protocol: the scale of the comparison.
        samples: points on each surface.

    Raises:
        ValueError: different numbers of meshes, a true mesh without faces or extent, vertices that are not finite.
    """
    _check(predicted, truth)
    rows = [_score(*pair, protocol, samples) for pair in zip(_each(predicted), _each(truth), strict=True)]
    empty = (0, len(protocol.thresholds))
    if not rows:
        none = predicted.verts_packed().new_zeros(0)
        return SurfaceScores(none, none, none, *(none.reshape(empty) for _ in range(3)))
    return SurfaceScores(**{name: torch.stack([row[name] for row in rows]) for name in SurfaceScores.names()})


def true_meshes(shapes: Shapes) -> Meshes:
    """The N true meshes of shapes, in the camera's axes."""
    return Meshes(list(shapes.verts), list(shapes.faces))


def mesh_term(
    measure: Measure,
    threshold: Size | None = None,
    protocol: ProtocolName = "scaled",
    prediction: str = "meshes",
    target: str = "shapes",
    stage: int = -1,
    samples: Positive = 10_000,
) -> MetricTerm:
    """The mean of one measure over all objects, as a metric of a task that predicts a mesh for each.

    Several such terms with the same field, stage, protocol and samples share their work.

    Args:
        measure: a field of `SurfaceScores`.
        threshold: of precision, recall and f1; one of the protocol's.
        protocol: scaled or p2m.
        prediction: the field with the predicted meshes in the camera's axes: a `Meshes`, or a sequence of such, one
            for each stage of refinement.
        target: the field with the true `Shapes`.
        stage: of a sequence; -1 is the last.
        samples: points on each surface.

    Raises:
        UserError: a measure without its threshold, or one that the protocol does not have.
    """
    score = partial(
        mesh_measure,
        measure=measure,
        column=_column(measure, threshold, protocol),
        protocol=protocol,
        stage=stage,
        samples=samples,
    )
    return MetricTerm(MeanOverImages(score), prediction=prediction, target=target)


def mesh_measure(
    meshes: Meshes | Sequence[Meshes],
    shapes: Shapes,
    *,
    measure: Measure,
    column: int | None,
    protocol: ProtocolName = "scaled",
    stage: int = -1,
    samples: Positive = 10_000,
) -> Scores:
    """What each of N predicted meshes scores by one measure; `column` is the number of its threshold."""
    chosen = meshes if isinstance(meshes, Meshes) else meshes[stage]
    found = getattr(scores_of(chosen, shapes, protocol, samples), measure)
    values = found if column is None else found[:, column]
    return Scores(values, torch.ones_like(values, dtype=torch.bool))


@remembered()
def scores_of(meshes: Meshes, shapes: Shapes, protocol: ProtocolName, samples: int) -> SurfaceScores:
    """`score_surfaces` of predicted meshes beside the true ones, both in the camera's axes."""
    return score_surfaces(meshes, true_meshes(shapes), PROTOCOLS[protocol], samples)


def _column(measure: Measure, threshold: float | None, protocol: ProtocolName) -> int | None:
    thresholds = PROTOCOLS[protocol].thresholds
    if measure not in _WITH_THRESHOLD:
        if threshold is not None:
            named = f"those with one are {', '.join(_WITH_THRESHOLD)}"
            raise UserError(f"the measure {measure} has no threshold, got {threshold}; {named}")
        return None
    if threshold not in thresholds:
        known = ", ".join(map(str, thresholds))
        raise UserError(f"{measure} by the protocol {protocol} has the thresholds {known}, got {threshold}")
    return thresholds.index(threshold)


def _check(predicted: Meshes, truth: Meshes) -> None:
    if len(predicted) != len(truth):
        raise ValueError(f"there must be a true mesh for each predicted one, got {len(truth)} for {len(predicted)}")
    if len(truth) and not bool((truth.num_faces_per_mesh() > 0).all()):
        without = (truth.num_faces_per_mesh() == 0).nonzero()[0].item()
        raise ValueError(f"the true mesh {without} of {len(truth)} has no faces: nothing can be compared with it")


def _each(meshes: Meshes) -> list[Meshes]:
    return [Meshes([verts], [faces]) for verts, faces in zip(meshes.verts_list(), meshes.faces_list(), strict=True)]


def _score(predicted: Meshes, truth: Meshes, protocol: Protocol, samples: int) -> dict[str, Tensor]:
    """The fields of `SurfaceScores` for one pair."""
    if not len(predicted.faces_packed()):
        predicted = ico_sphere(3, predicted.device)
    scale = _scale(truth, protocol)
    generator = torch.Generator(truth.device).manual_seed(0)
    points, normals = _drawn(predicted, scale, samples, generator)
    true_points, true_normals = _drawn(truth, scale, samples, generator)
    there, back = knn_points(points, true_points), knn_points(true_points, points)
    cosines = [
        cosine_similarity(normals[0], true_normals[0].index_select(0, there.idx.reshape(-1)), dim=-1),
        cosine_similarity(true_normals[0], normals[0].index_select(0, back.idx.reshape(-1)), dim=-1),
    ]
    limits = points.new_tensor(protocol.thresholds).square()
    precision, recall = (100 * (way.dists[0] < limits).to(points).mean(0) for way in (there, back))
    return {
        "chamfer": there.dists.mean() + back.dists.mean(),
        "normal": (cosines[0].abs().mean() + cosines[1].abs().mean()) / 2,
        "signed_normal": (cosines[0].mean() + cosines[1].mean()) / 2,
        "precision": precision,
        "recall": recall,
        "f1": 2 * precision * recall / (precision + recall + 1e-8),
    }


def _scale(truth: Meshes, protocol: Protocol) -> float:
    if protocol.longest_side is None:
        return protocol.factor
    low, high = truth.verts_packed().aminmax(dim=0)
    longest = float((high - low).amax())
    if not longest > 0:
        raise ValueError("a true mesh has no extent: all its vertices are at one place")
    return protocol.factor * protocol.longest_side / longest


def _drawn(mesh: Meshes, scale: float, samples: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Scaled points and their normals (1, S, 3)."""
    points, normals = sample_points_from_meshes(mesh, samples, return_normals=True, generator=generator)
    return points * scale, normals
