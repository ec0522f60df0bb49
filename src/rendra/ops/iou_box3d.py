"""Intersection of boxes that stand in space at any angle.

A convex solid is kept as a soup of directed edges: each face's edges form a ring, and each edge lies in two faces,
once in either direction. Cutting such a soup with a plane needs no order: edges are shortened, in each face the gap
is closed from where its ring leaves the half-space to where it comes back, and the closing edges, turned around, are
the ring of the new face. Both copies of an edge are cut at the same numbers, to the bit, so that rings stay closed.

Letters: N and M boxes, P pairs of them, E edges of all pairs. A plane is (n, h): the points x with n.x = h, n outward
and of length one. Everything is computed in float64.
"""

from typing import NamedTuple

import torch
from torch import Tensor

_PAIRS_AT_ONCE = 2**12
# corners around each face; which way round they run does not matter, only that it is the same for all
_FACES = ((0, 1, 2, 3), (3, 2, 6, 7), (0, 4, 5, 1), (0, 3, 7, 4), (1, 5, 6, 2), (4, 7, 6, 5))


def box3d_overlap(boxes1: Tensor, boxes2: Tensor, eps: float = 1e-4) -> tuple[Tensor, Tensor]:
    """Volume of the intersection of each box of one list with each of another, and intersection over union.

    Exact for convex boxes with plane sides, rectangular or not. Not differentiable. Corners come in the order

        (0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)

    of the unit box, or of its mirror image.

    Args:
        boxes1: (N, 8, 3).
        boxes2: (M, 8, 3).
        eps: how far, in units of length, a corner may lie from the plane of its side; and the least area of a side.

    Returns:
        vol (N, M) and iou (N, M) in [0, 1].

    Raises:
        ValueError: another shape, a side that is not plane or has no area, or a corner that is not finite.
    """
    for name, boxes in (("boxes1", boxes1), ("boxes2", boxes2)):
        if boxes.ndim != 3 or boxes.shape[1:] != (8, 3):
            raise ValueError(f"Each box in the batch must be of shape (8, 3), got {name} of {tuple(boxes.shape)}")
    dtype = torch.promote_types(boxes1.dtype, boxes2.dtype)
    dtype = dtype if dtype.is_floating_point else torch.float32
    first, second = boxes1.detach().double(), boxes2.detach().double()
    for name, boxes in (("boxes1", first), ("boxes2", second)):
        _check_sides(name, boxes, eps)
    planes1, planes2 = _planes(first), _planes(second)
    common = first.new_zeros(len(first), len(second))
    rows = max(1, _PAIRS_AT_ONCE // max(1, len(second)))
    for begin in range(0, len(first), rows):
        some = slice(begin, begin + rows)
        a, b = _may_meet(first[some], planes1.of(some), second, planes2).nonzero(as_tuple=True)
        common[a + begin, b] = _common_volume(first[a + begin], second[b])
    union = _volume(first)[:, None] + _volume(second) - common
    return common.to(dtype), (common / union).clamp(0, 1).to(dtype)


class _Planes(NamedTuple):
    normal: Tensor  # (B, 6, 3)
    height: Tensor  # (B, 6)

    def of(self, boxes: slice) -> "_Planes":
        return _Planes(self.normal[boxes], self.height[boxes])


def _sides(boxes: Tensor) -> Tensor:
    """Corners of the six sides. (B, 6, 4, 3)"""
    return boxes[:, torch.tensor(_FACES, device=boxes.device)]


def _planes(boxes: Tensor) -> _Planes:
    """Planes through the middles of the sides, looking away from the middle of each box."""
    sides = _sides(boxes)
    normal = torch.linalg.cross(sides[:, :, 2] - sides[:, :, 0], sides[:, :, 3] - sides[:, :, 1])
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=torch.finfo(normal.dtype).tiny)
    middle = sides.mean(dim=2)
    away = (normal * (middle - boxes.mean(dim=1, keepdim=True))).sum(-1, keepdim=True)
    normal = torch.where(away < 0, -normal, normal)
    return _Planes(normal, (normal * middle).sum(-1))


def _check_sides(name: str, boxes: Tensor, eps: float) -> None:
    sides = _sides(boxes)
    area = 0.5 * torch.linalg.cross(sides[:, :, 2] - sides[:, :, 0], sides[:, :, 3] - sides[:, :, 1]).norm(dim=-1)
    planes = _planes(boxes)
    lift = ((sides * planes.normal[:, :, None]).sum(-1) - planes.height[..., None]).abs().amax(-1)
    # a NaN fails both comparisons
    for bad, complaint in (
        (~boxes.isfinite().all(-1).all(-1, keepdim=True), "has a corner that is not finite"),
        (~(area > eps), f"Planes have zero areas: a side is smaller than eps = {eps}"),
        (~(lift <= eps), f"Plane vertices are not coplanar: a side is bent by more than eps = {eps}"),
    ):
        if bad.any():
            raise ValueError(f"{name}[{int(bad.any(1).nonzero()[0])}]: {complaint}")


def _may_meet(first: Tensor, planes1: _Planes, second: Tensor, planes2: _Planes) -> Tensor:
    """Which pairs no side of either box separates. (N, M)"""
    outside2 = _lowest(planes1, second) >= 0  # (N, M, 6)
    outside1 = _lowest(planes2, first) >= 0  # (M, N, 6)
    return ~(outside2.any(-1) | outside1.any(-1).T)


def _lowest(planes: _Planes, boxes: Tensor) -> Tensor:
    """How far the corners of each box at least lie outside each plane of others. (planes' boxes, boxes, 6)"""
    heights = planes.normal.reshape(-1, 3) @ boxes.reshape(-1, 3).T
    return heights.view(len(planes.height), 6, len(boxes), 8).amin(-1).transpose(1, 2) - planes.height[:, None]


class _Soup(NamedTuple):
    """Directed edges of P solids. Faces 0 to 5 are those of the first boxes, 6 to 11 those that were cut."""

    start: Tensor  # (E, 3)
    end: Tensor  # (E, 3)
    ring: Tensor  # (E,) 12 times the pair plus the face


def _common_volume(first: Tensor, second: Tensor) -> Tensor:
    """Volume (P,) of what each of P boxes has in common with its partner."""
    pairs = len(first)
    origin = first.mean(dim=1, keepdim=True)
    first, second = first - origin, second - origin
    planes = [torch.cat(parts, dim=1) for parts in zip(_planes(first), _planes(second), strict=True)]
    normal, height = planes[0].reshape(-1, 3), planes[1].reshape(-1)  # (12 P, 3), (12 P,)
    sides = _sides(first)
    ring = 12 * torch.arange(pairs, device=first.device)[:, None] + torch.arange(6, device=first.device)
    soup = _Soup(sides.reshape(-1, 3), sides.roll(-1, dims=2).reshape(-1, 3), ring.reshape(-1).repeat_interleave(4))
    for face in range(6, 12):
        soup = _cut(soup, face, normal, height)
    # the divergence theorem: a face of area A in the plane (n, h) adds h A / 3, and A is half the sum of n.(a x b)
    swept = _dot(normal[soup.ring], torch.linalg.cross(soup.start, soup.end)) * height[soup.ring] / 6
    return normal.new_zeros(pairs).index_add(0, soup.ring // 12, swept).abs()


def _cut(soup: _Soup, face: int, normal: Tensor, height: Tensor) -> _Soup:
    """What of each solid lies behind the plane of its face number `face`, which becomes a face of it."""
    plane = soup.ring // 12 * 12 + face
    outward, level = normal.index_select(0, plane), height.index_select(0, plane)
    start_lift, end_lift = _dot(soup.start, outward) - level, _dot(soup.end, outward) - level
    starts_inside, ends_inside = start_lift <= 0, end_lift <= 0
    kept = (starts_inside | ends_inside).nonzero()[:, 0]
    leaves, returns = (starts_inside & ~ends_inside).nonzero()[:, 0], (ends_inside & ~starts_inside).nonzero()[:, 0]
    # a ring leaves as often as it returns: sorted by ring, exits and entries meet
    leaves = leaves.index_select(0, soup.ring.index_select(0, leaves).argsort(stable=True))
    returns = returns.index_select(0, soup.ring.index_select(0, returns).argsort(stable=True))
    # seen from the end that is inside, so that both copies of an edge give the same point
    exits = _crossing(soup.start, soup.end, start_lift, end_lift, leaves)
    entries = _crossing(soup.end, soup.start, end_lift, start_lift, returns)
    ring = soup.ring.index_select(0, leaves)
    return _Soup(
        torch.cat([soup.start.index_copy(0, returns, entries).index_select(0, kept), exits, entries]),
        torch.cat([soup.end.index_copy(0, leaves, exits).index_select(0, kept), entries, exits]),
        torch.cat([soup.ring.index_select(0, kept), ring, ring // 12 * 12 + face]),
    )


def _crossing(inside: Tensor, outside: Tensor, below: Tensor, above: Tensor, rows: Tensor) -> Tensor:
    """Where some edges meet the plane that their ends lie `below` <= 0 and `above` > 0 of."""
    inside, outside, below, above = (part.index_select(0, rows) for part in (inside, outside, below, above))
    return inside + (below / (below - above))[:, None] * (outside - inside)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return (a * b).sum(-1)


def _volume(boxes: Tensor) -> Tensor:
    """Volume of each box, by the divergence theorem around its middle. (B,)"""
    boxes = boxes - boxes.mean(dim=1, keepdim=True)
    sides, (normal, height) = _sides(boxes), _planes(boxes)
    swept = torch.linalg.cross(sides, sides.roll(-1, dims=2), dim=-1).sum(dim=2)
    return ((normal * swept).sum(-1) * height).sum(-1).abs() / 6
