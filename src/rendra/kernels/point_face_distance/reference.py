"""Nearest faces and points, the specification: plain torch, any device, any float type, slow.

The squared distance of a point p to a triangle (a, b, c) is the least of
- the squared distances to its three edges, and
- the squared distance to its plane, if the area is at least `min_triangle_area` and the foot lies inside.

Rules on which the twins agree to the bit in float32, so that "the lower index wins" also decides at shared edges:
1. An edge is measured from its middle, which does not know the edge's direction. With m = (p - a) + (p - b) and
   e = b - a the foot is at s = m.e / e.e in [-1, 1], from a to b, and the squared distance is |m - s e|^2 / 4; where
   s is at an end it is |p - a|^2 or |p - b|^2. An edge of no length has s = 0.
2. On the plane, with n = (b - a) x (c - a): v = n.((p - a) x (c - a)) / n.n and w = n.((b - a) x (p - a)) / n.n.
3. Equal distances go to the lower index. What is not finite is nearest to nothing.
The nearest pair is found without a graph; its distance is then |sum_i w_i (p - v_i)|^2 with constant barycentric
weights w: they are where the distance is least, so that their own change adds nothing to its derivative.
"""

from collections.abc import Callable

import torch
from torch import Tensor

_PAIRS_AT_ONCE = 2**18
_TINY = 1e-37  # least square of a length or an area that is divided by


def nearest_face(
    points: Tensor, points_first_idx: Tensor, tris: Tensor, tris_first_idx: Tensor, min_triangle_area: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distance, face and weights for every point; see the package's `nearest_face`."""
    index, is_alone = _search(
        points.detach(), points_first_idx, tris.detach(), tris_first_idx,
        lambda p, f: _least(_candidates(p[:, None], f, min_triangle_area)),
    )  # fmt: skip
    return _measure(points, _rows(tris, index), index, is_alone, min_triangle_area)


def nearest_point(
    points: Tensor, points_first_idx: Tensor, tris: Tensor, tris_first_idx: Tensor, min_triangle_area: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Squared distance, point and weights for every face; see the package's `nearest_point`."""
    index, is_alone = _search(
        tris.detach(), tris_first_idx, points.detach(), points_first_idx,
        lambda f, p: _least(_candidates(p, f[:, None], min_triangle_area)),
    )  # fmt: skip
    return _measure(_rows(points, index), tris, index, is_alone, min_triangle_area)


def _search(
    queries: Tensor, queries_first: Tensor, targets: Tensor, targets_first: Tensor,
    distance: Callable[[Tensor, Tensor], Tensor],
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Index (Q,) of each query's nearest target in its own segment, -1 if none; and which have no target at all."""
    index = queries_first.new_full((len(queries),), -1)
    is_alone = torch.ones_like(index, dtype=torch.bool)
    query_ends = [*queries_first.tolist(), len(queries)][1:]
    target_ends = [*targets_first.tolist(), len(targets)][1:]
    segments = zip(queries_first.tolist(), query_ends, targets_first.tolist(), target_ends, strict=True)
    for query, query_end, target, target_end in segments:
        if target == target_end:
            continue
        is_alone[query:query_end] = False
        rows = max(1, _PAIRS_AT_ONCE // (target_end - target))
        for begin in range(query, query_end, rows):
            end = min(begin + rows, query_end)
            lowest = _lowest_index(distance(queries[begin:end], targets[target:target_end]))
            index[begin:end] = torch.where(lowest >= 0, lowest + target, lowest)
    return index, is_alone


def _lowest_index(squared: Tensor) -> Tensor:
    """The first column of the least value in each row of (Q, T), -1 where nothing is finite."""
    squared = torch.where(squared.isfinite(), squared, torch.inf)
    least = squared.amin(1, keepdim=True)
    columns = torch.arange(squared.shape[1], device=squared.device)
    first = torch.where(squared == least, columns, squared.shape[1]).amin(1)
    return torch.where(least.squeeze(1) < torch.inf, first, -1)


def _rows(values: Tensor, index: Tensor) -> Tensor:
    """Rows of `values`; zeros where the index is -1."""
    padded = torch.cat([values, values.new_zeros((1, *values.shape[1:]))])
    return padded.index_select(0, torch.where(index >= 0, index, len(values)))


def _measure(
    points: Tensor, tris: Tensor, index: Tensor, is_alone: Tensor, min_triangle_area: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Differentiable squared distances of the pairs found, their index, and the weights of the feet."""
    is_found = index >= 0
    points = torch.where(is_found[:, None], points, 0.0)
    tris = torch.where(is_found[:, None, None], tris, 0.0)
    weights = _weights(_candidates(points.detach(), tris.detach(), min_triangle_area))
    weights = torch.where(is_found[:, None], weights, 0.0)
    arm = (weights[..., None] * (points[:, None] - tris)).sum(1)
    none = torch.where(is_alone, 0.0, torch.nan).to(points)
    return torch.where(is_found, (arm**2).sum(1), none), index, weights


def _candidates(points: Tensor, tris: Tensor, min_triangle_area: float) -> list[tuple[Tensor, Tensor]]:
    """Squared distance (...) and place of the foot for edges ab, bc, ca (its s) and the plane (v and w)."""
    a, b, c = tris.unbind(-2)
    pa, pb, pc = points - a, points - b, points - c
    return [
        _edge(pa, pb, b - a), _edge(pb, pc, c - b), _edge(pc, pa, a - c),
        _plane(pa, b - a, c - a, min_triangle_area),
    ]  # fmt: skip


def _edge(pa: Tensor, pb: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """Rule 1: squared distance to the edge whose ends are at -pa and -pb, seen from the point, and s."""
    middle = pa + pb
    s = (_dot(middle, along) * _inverse(_dot(along, along))).clamp(-1, 1)
    arm = middle - s[..., None] * along
    inside = _dot(arm, arm) * 0.25
    return torch.where(s >= 1, _dot(pb, pb), torch.where(s <= -1, _dot(pa, pa), inside)), s


def _plane(pa: Tensor, ab: Tensor, ac: Tensor, min_triangle_area: float) -> tuple[Tensor, Tensor]:
    """Rule 2: squared distance to the plane, infinite where the foot is outside or the triangle too small."""
    normal = torch.stack(_cross(ab, ac), -1)
    square = _dot(normal, normal)
    inverse = _inverse(square)
    v = _dot(normal, torch.stack(_cross(pa, ac), -1)) * inverse
    w = _dot(normal, torch.stack(_cross(ab, pa), -1)) * inverse
    arm = pa - v[..., None] * ab - w[..., None] * ac
    counts = (v >= 0) & (w >= 0) & (v + w <= 1) & (square >= 4 * min_triangle_area**2)
    return torch.where(counts, _dot(arm, arm), torch.inf), torch.stack([v, w], -1)


def _least(candidates: list[tuple[Tensor, Tensor]]) -> Tensor:
    return torch.stack([squared for squared, _ in candidates]).amin(0)


def _weights(candidates: list[tuple[Tensor, Tensor]]) -> Tensor:
    """Barycentric weights (..., 3) of the nearest foot; equal distances go to the plane, then ab, bc, ca."""
    (ab, s_ab), (bc, s_bc), (ca, s_ca), (plane, vw) = candidates
    zero = torch.zeros_like(s_ab)
    (ab0, ab1), (bc0, bc1), (ca0, ca1) = (((1 - s) * 0.5, (1 + s) * 0.5) for s in (s_ab, s_bc, s_ca))
    weights = torch.stack([ca1, zero, ca0], -1)
    weights = torch.where((bc <= ca)[..., None], torch.stack([zero, bc0, bc1], -1), weights)
    weights = torch.where((ab <= torch.minimum(bc, ca))[..., None], torch.stack([ab0, ab1, zero], -1), weights)
    is_plane = plane <= torch.minimum(ab, torch.minimum(bc, ca))
    return torch.where(is_plane[..., None], torch.stack([1 - vw.sum(-1), *vw.unbind(-1)], -1), weights)


def _dot(x: Tensor, y: Tensor) -> Tensor:
    """Scalar product, summed in the order of the axes on every device."""
    return x[..., 0] * y[..., 0] + x[..., 1] * y[..., 1] + x[..., 2] * y[..., 2]


def _cross(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    (x0, x1, x2), (y0, y1, y2) = x.unbind(-1), y.unbind(-1)
    return x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0


def _inverse(square: Tensor) -> Tensor:
    """1 / square, finite where it vanishes: then what it multiplies is zero, or any foot will do."""
    return 1 / square.clamp(min=_TINY)
