"""What is good and what is wrong about a triangle mesh: measures for metrics, faults for reports.

Every function takes a batch of meshes and treats it as one: numbers are over all of it, vertex and face numbers
count the packed tensors. Nothing is differentiable. Faces that name a vertex twice have no place in the topology
and are left out of it; `degenerate_faces` finds them.
Geometry is computed in float64; lengths, areas and volumes are in units of the vertices.
Letters: V vertices, F faces, E edges; half-edge k of a face lies opposite to its vertex k.
"""

from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from rendra.ops import knn_points
from rendra.structures.meshes import Meshes

_FLAT = 1e-6  # a face whose height is this small beside its longest side has no area
_NUMBERED = np.int64


@torch.no_grad()
def mean_dihedral_deg(mesh: Meshes) -> Tensor:
    """The mean angle between the normals of adjacent faces, in degrees: 0 for a plane, 180 where all folds back.

    Over all edges with exactly two faces: mean of atan2(|n0 x n1|, n0 . n1). Normals of faces that are wound
    against each other are turned first, so that the angle tells of the shape and not of the winding. Faces
    without area do not count.

    Returns:
        (), NaN where no two faces are adjacent.
    """
    sides = HalfEdges.of(mesh)
    normals = _crosses(mesh)
    first, second = normals[sides.pairs[:, 0]], normals[sides.pairs[:, 1]]
    second = torch.where(sides.pairs_disagree[:, None], -second, second)
    sine = torch.linalg.vector_norm(torch.linalg.cross(first, second), dim=1)
    angles = torch.atan2(sine, (first * second).sum(1))
    flat = degenerate_faces(mesh)
    return angles[~flat[sides.pairs].any(1)].rad2deg().mean().to(mesh.verts_packed().dtype)


@torch.no_grad()
def edge_length_spread(mesh: Meshes) -> Tensor:
    """Standard deviation of the edges' lengths over their mean; every edge once: 0 where all are equally long.

    Returns:
        (), NaN for a mesh without edges or with all vertices in one point.
    """
    lengths = edge_lengths(mesh)
    mean = lengths.mean()
    return ((lengths - mean).square().mean().sqrt() / mean).to(mesh.verts_packed().dtype)


@torch.no_grad()
def edge_lengths(mesh: Meshes) -> Tensor:
    """The length of every edge, in the order of `edges_packed()`. (E,) float64"""
    ends = mesh.verts_packed().double()[mesh.edges_packed()]
    return torch.linalg.vector_norm(ends[:, 1] - ends[:, 0], dim=1)


@torch.no_grad()
def surface_area(mesh: Meshes) -> float:
    """The sum of the faces' areas."""
    return float(torch.linalg.vector_norm(_crosses(mesh), dim=1).sum() / 2)


@torch.no_grad()
def signed_volume(mesh: Meshes) -> float:
    """The volume inside closed surfaces, negative where they are inside out: sum of v0 . (v1 x v2) / 6.

    It means something only where `is_watertight`.
    """
    return float(_volumes(mesh).sum())


@torch.no_grad()
def degenerate_faces(mesh: Meshes) -> Tensor:
    """Which faces have no area: the height over their longest side is below a millionth of it. (F,) bool"""
    corners = mesh.verts_packed().double()[mesh.faces_packed()]
    longest = (corners - corners.roll(1, dims=1)).square().sum(2).amax(1)
    return ~(torch.linalg.vector_norm(_crosses(mesh), dim=1) > _FLAT * longest)


@torch.no_grad()
def duplicate_faces(mesh: Meshes) -> Tensor:
    """Which faces join the same three vertices as an earlier face, in whatever order. (F,) bool"""
    return _repeats(mesh.faces_packed().sort(dim=1).values)


@torch.no_grad()
def duplicate_verts(mesh: Meshes) -> Tensor:
    """Which vertices lie exactly where an earlier one lies. (V,) bool"""
    return repeated_points(mesh.verts_packed())


@torch.no_grad()
def repeated_points(points: Tensor) -> Tensor:
    """Which of (P, D) points lie exactly where an earlier one lies; NaN is equal to nothing. (P,) bool"""
    return _repeats(points + 0.0) & ~points.isnan().any(1)  # -0.0 is 0.0


@torch.no_grad()
def nearest_distances(points: Tensor) -> Tensor:
    """The distance of each of (P, 3) points from the nearest other one. (P,), none for fewer than two points"""
    if len(points) < 2:
        return points.new_zeros(0)
    return knn_points(points[None], points[None], K=2).dists[0, :, 1].sqrt()


@torch.no_grad()
def unreferenced_verts(mesh: Meshes) -> Tensor:
    """Which vertices no face names. (V,) bool"""
    used = torch.zeros(len(mesh.verts_packed()), dtype=torch.bool, device=mesh.device)
    used[mesh.faces_packed().reshape(-1)] = True
    return ~used


@torch.no_grad()
def boundary_edges(mesh: Meshes) -> Tensor:
    """The edges with a face on one side only, as pairs of vertices. (B, 2)"""
    sides = HalfEdges.of(mesh)
    return mesh.edges_packed()[sides.counts == 1]


@torch.no_grad()
def non_manifold_edges(mesh: Meshes) -> Tensor:
    """The edges where three or more faces meet, as pairs of vertices. (K, 2)"""
    return mesh.edges_packed()[HalfEdges.of(mesh).counts > 2]


@torch.no_grad()
def non_manifold_verts(mesh: Meshes) -> Tensor:
    """The vertices whose faces form more than one fan, such as the tip where two cones meet. (K,)

    The ends of non-manifold edges are not among them for that alone.
    """
    sides = HalfEdges.of(mesh)
    owner = mesh.faces_packed()[sides.sound].reshape(-1)
    owner_of_fan = torch.full((3 * len(mesh.faces_packed()),), -1, device=mesh.device)
    owner_of_fan[sides.fans[_spread(sides.sound)]] = owner
    fans_of = torch.bincount(owner_of_fan[owner_of_fan >= 0], minlength=len(mesh.verts_packed()))
    return (fans_of > 1).nonzero()[:, 0]


@torch.no_grad()
def boundary_loops(mesh: Meshes) -> Tensor:
    """Which hole each of the `boundary_edges` belongs to, counted from 0. (B,)

    A boundary follows the faces through a vertex: patches that touch there have one each, two holes that touch
    there are one.
    """
    sides = HalfEdges.of(mesh)
    half = sides.order[(sides.counts == 1)[sides.edge_of_sorted]]
    start, end = sides.corners(half)
    fan = sides.fans
    labels = _components(int(fan.amax()) + 1 if len(fan) else 0, fan[start], fan[end])
    return torch.unique(labels[fan[start]], return_inverse=True)[1]


@torch.no_grad()
def components(mesh: Meshes) -> Tensor:
    """Which component each face belongs to, counted from 0 by size, the largest first. (F,)

    Faces hang together that share a vertex.
    """
    low, high = mesh.edges_packed().unbind(1)
    labels = _components(len(mesh.verts_packed()), low, high)[mesh.faces_packed()[:, 0]]
    _, labels, sizes = torch.unique(labels, return_inverse=True, return_counts=True)
    return sizes.argsort(descending=True, stable=True).argsort()[labels]


@torch.no_grad()
def euler_characteristic(mesh: Meshes) -> int:
    """V - E + F, of the vertices that faces use."""
    used = int((~unreferenced_verts(mesh)).sum())
    return used - len(mesh.edges_packed()) + len(mesh.faces_packed())


@torch.no_grad()
def genus(mesh: Meshes) -> int | None:
    """The number of handles, C - (V - E + F) / 2 with C components; None unless closed, manifold and oriented."""
    if not is_watertight(mesh) or len(non_manifold_verts(mesh)):
        return None
    return len(components(mesh).unique()) - euler_characteristic(mesh) // 2


@torch.no_grad()
def is_watertight(mesh: Meshes) -> bool:
    """Whether the mesh has faces, and every edge has two, which run through it in opposite directions."""
    sides = HalfEdges.of(mesh)
    closed = bool(sides.sound.all()) and bool((sides.counts == 2).all())
    return closed and len(mesh.faces_packed()) > 0 and not bool(sides.pairs_disagree.any())


@torch.no_grad()
def inconsistent_edges(mesh: Meshes) -> Tensor:
    """The edges whose two faces are wound against each other, as pairs of vertices. (K, 2)"""
    sides = HalfEdges.of(mesh)
    return mesh.edges_packed()[sides.counts == 2][sides.pairs_disagree]


@torch.no_grad()
def flipped_faces(mesh: Meshes) -> Tensor:
    """Which faces are wound against most of the faces that they hang together with through edges. (F,) bool

    A patch that cannot be oriented, such as a Moebius strip, has no flipped faces.
    """
    sides, num_faces = HalfEdges.of(mesh), len(mesh.faces_packed())
    first, second = sides.pairs.unbind(1)
    turned = sides.pairs_disagree.long() * num_faces
    # every face twice, once as it is and once turned round; neighbours that agree are linked
    links = torch.cat([first, first + num_faces]), torch.cat([second + turned, second + (num_faces - turned)])
    as_is, reverse = _components(2 * num_faces, *links).view(2, num_faces)
    patch = torch.minimum(as_is, reverse)
    side = as_is > reverse
    balance = torch.zeros(2 * num_faces, dtype=torch.long, device=mesh.device)
    balance.index_add_(0, patch, 1 - 2 * side.long())
    # where half of the faces are on either side, the first face is right
    majority_turned = balance[patch] < 0
    return (side != majority_turned) & (as_is != reverse)


@torch.no_grad()
def inward_faces(mesh: Meshes) -> Tensor:
    """Which faces belong to a closed component that is inside out. (F,) bool

    A component is closed if all its edges have two faces that agree, and inside out if its signed volume is
    negative. A closed surface right inside another, which bounds a cavity, is inward by right and not counted.
    """
    faces, labels = mesh.faces_packed(), components(mesh)
    if not len(faces):
        return torch.zeros(0, dtype=torch.bool, device=mesh.device)
    closed = _closed_components(mesh, labels)
    volumes = torch.zeros(len(closed), dtype=torch.float64, device=mesh.device)
    volumes.index_add_(0, labels, _volumes(mesh))
    suspects = (closed & (volumes < 0)).nonzero()[:, 0]
    wrong = torch.zeros_like(closed)
    if len(suspects):
        wrong[suspects] = ~_enclosed(mesh, labels, closed, suspects)
    return wrong[labels]


@torch.no_grad()
def wrong_normals(mesh: Meshes) -> Tensor:
    """Which of the stored vertex normals point away from the mean normal of the vertex's faces. (V,) bool

    The mean is weighted by area; vertices without faces, and meshes that store no normals, have none wrong.
    """
    if not mesh.has_given_normals:
        return torch.zeros(len(mesh.verts_packed()), dtype=torch.bool, device=mesh.device)
    faces, crosses = mesh.faces_packed(), _crosses(mesh)
    mean = torch.zeros_like(mesh.verts_packed(), dtype=torch.float64)
    for corner in faces.unbind(1):
        mean.index_add_(0, corner, crosses)
    return (mean * mesh.verts_normals_packed().double()).sum(1) < 0


def merge_verts(mesh: Meshes) -> Meshes:
    """One mesh with vertices at exactly the same place made one; without textures and normals."""
    verts = mesh.verts_packed().detach() + 0.0
    order, repeats = _sorted_rows(verts)
    numbers = torch.empty_like(order)
    numbers[order] = (~repeats).cumsum(0) - 1
    kept = verts[order[~repeats]]
    return Meshes([kept], [numbers[mesh.faces_packed()]])


class HalfEdges:
    """The sides of a mesh's faces, sorted by the edge that they lie on.

    Args:
        mesh: whose.
    """

    def __init__(self, mesh: Meshes) -> None:
        self._faces = mesh.faces_packed()
        self._num_edges = len(mesh.edges_packed())
        self._faces_to_edges = mesh.faces_packed_to_edges_packed()

    @staticmethod
    def of(mesh: Meshes) -> "HalfEdges":
        """Those of a mesh, sorted only once for all functions of this module."""
        if mesh not in _SORTED:
            _SORTED[mesh] = HalfEdges(mesh)
        return _SORTED[mesh]

    @cached_property
    def sound(self) -> Tensor:
        """Which faces name three different vertices. (F,) bool"""
        v0, v1, v2 = self._faces.unbind(1)
        return (v0 != v1) & (v1 != v2) & (v2 != v0)

    @cached_property
    def _edges(self) -> Tensor:
        """The edge of each half-edge; one too many for those of faces that are not sound. (3 F,)"""
        edges = self._faces_to_edges
        return torch.where(self.sound[:, None], edges, self._num_edges).reshape(-1)

    @cached_property
    def order(self) -> Tensor:
        """The half-edges 3 f + k of sound faces, sorted by edge, then by number."""
        order = self._edges.argsort(stable=True)
        return order[: 3 * int(self.sound.sum())]

    @cached_property
    def edge_of_sorted(self) -> Tensor:
        """The edge of each of `order`."""
        return self._edges[self.order]

    @cached_property
    def counts(self) -> Tensor:
        """How many sound faces each edge has. (E,)"""
        return torch.bincount(self.edge_of_sorted, minlength=self._num_edges)

    def corners(self, half: Tensor) -> tuple[Tensor, Tensor]:
        """The corners 3 f + k where half-edges start and end."""
        face, side = half.div(3, rounding_mode="floor"), half % 3
        return 3 * face + (side + 1) % 3, 3 * face + (side + 2) % 3

    @cached_property
    def _two(self) -> Tensor:
        """The two half-edges of each edge that has two. (P, 2)"""
        return self.order[(self.counts == 2)[self.edge_of_sorted]].view(-1, 2)

    @cached_property
    def pairs(self) -> Tensor:
        """The two faces of each edge that has two, in the order of the edges. (P, 2)"""
        return self._two.div(3, rounding_mode="floor")

    @cached_property
    def pairs_disagree(self) -> Tensor:
        """Whether the two faces run through their edge in the same direction. (P,) bool"""
        owner = self._faces.reshape(-1)
        starts = owner[self.corners(self._two)[0]]
        return starts[:, 0] == starts[:, 1]

    @cached_property
    def fans(self) -> Tensor:
        """A number for each corner 3 f + k; those of one fan of faces round a vertex have the same. (3 F,)"""
        owner = self._faces.reshape(-1)
        same = (self.edge_of_sorted[1:] == self.edge_of_sorted[:-1]).nonzero()[:, 0]
        start, end = self.corners(self.order)
        turned = (owner[start] > owner[end])[:, None]
        ends = torch.where(turned, torch.stack([end, start], 1), torch.stack([start, end], 1))  # low, high vertex
        return _components(len(owner), ends[same].reshape(-1), ends[same + 1].reshape(-1))


_SORTED: WeakKeyDictionary[Meshes, HalfEdges] = WeakKeyDictionary()


def _crosses(mesh: Meshes) -> Tensor:
    """(v1 - v0) x (v2 - v0) of each face. (F, 3) float64"""
    v0, v1, v2 = mesh.verts_packed().double()[mesh.faces_packed()].unbind(1)
    return torch.linalg.cross(v1 - v0, v2 - v0)


def _volumes(mesh: Meshes) -> Tensor:
    """Signed volumes between the faces and the mean vertex. (F,) float64"""
    verts = mesh.verts_packed().double()
    v0, v1, v2 = (verts - verts.mean(0))[mesh.faces_packed()].unbind(1)
    return (v0 * torch.linalg.cross(v1, v2)).sum(1) / 6


def _sorted_rows(rows: Tensor) -> tuple[Tensor, Tensor]:
    """The numbers of the rows of a table in an order that keeps equal ones together, the first first. (R,)

    And which rows in that order equal the one before. (R,) bool
    """
    table = rows.cpu().numpy()
    order = np.lexsort(table.T) if len(table) else np.zeros(0, _NUMBERED)
    repeats = np.zeros(len(table), dtype=bool)
    repeats[1:] = (table[order[1:]] == table[order[:-1]]).all(1)
    return torch.from_numpy(order).to(rows.device), torch.from_numpy(repeats).to(rows.device)


def _repeats(rows: Tensor) -> Tensor:
    """Which rows are equal to an earlier one. (R,) bool"""
    order, repeats = _sorted_rows(rows)
    result = torch.empty_like(repeats)
    result[order] = repeats
    return result


def _components(num_nodes: int, source: Tensor, target: Tensor) -> Tensor:
    """The connected component of each node of an undirected graph. (num_nodes,)"""
    rows, columns = source.cpu().numpy(), target.cpu().numpy()
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(num_nodes, num_nodes))
    labels = connected_components(graph, directed=False)[1] if num_nodes else np.zeros(0)
    return torch.from_numpy(labels.astype(_NUMBERED)).to(source.device)


def _spread(mask: Tensor) -> Tensor:
    """A mask of faces as one of their corners. (3 F,)"""
    return mask[:, None].expand(-1, 3).reshape(-1)


def _closed_components(mesh: Meshes, labels: Tensor) -> Tensor:
    """Which components have two faces that agree at each edge. (C,) bool"""
    sides = HalfEdges.of(mesh)
    closed = torch.ones(int(labels.amax()) + 1, dtype=torch.bool, device=labels.device)
    bad_faces = sides.order.div(3, rounding_mode="floor")[(sides.counts != 2)[sides.edge_of_sorted]]
    closed[labels[bad_faces]] = False
    closed[labels[sides.pairs[sides.pairs_disagree].reshape(-1)]] = False
    closed[labels[~sides.sound]] = False
    return closed


def _enclosed(mesh: Meshes, labels: Tensor, closed: Tensor, inner: Tensor) -> Tensor:
    """Which of the `inner` components lie inside an odd number of other closed components. (len(inner),) bool"""
    corners = mesh.verts_packed().double()[mesh.faces_packed()]  # (F, 3, 3)
    low, high = _boxes(corners, labels, len(closed))
    result = torch.zeros(len(inner), dtype=torch.bool, device=inner.device)
    for i, own in enumerate(inner.tolist()):
        around = closed & (low < low[own]).all(1) & (high > high[own]).all(1)
        if around.any():
            point = corners[(labels == own).nonzero()[0, 0], 0]
            turns = _winding_numbers(corners, labels, around, point)
            result[i] = int(turns.round().abs().sum()) % 2 == 1
    return result


def _boxes(corners: Tensor, labels: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Smallest and largest coordinates of each component. (C, 3), (C, 3)"""
    index = labels[:, None].expand(-1, 3)
    low = corners.new_full((count, 3), torch.inf).scatter_reduce(0, index, corners.amin(1), "amin")
    high = corners.new_full((count, 3), -torch.inf).scatter_reduce(0, index, corners.amax(1), "amax")
    return low, high


def _winding_numbers(corners: Tensor, labels: Tensor, chosen: Tensor, point: Tensor) -> Tensor:
    """How often each chosen component winds round a point: solid angles of its faces over 4 pi. (C,)

    Van Oosterom & Strackee, "The Solid Angle of a Plane Triangle", 1983, Eq. 8.
    """
    faces = chosen[labels]
    a, b, c = (corners[faces] - point).unbind(1)
    la, lb, lc = (torch.linalg.vector_norm(side, dim=1) for side in (a, b, c))
    above = (a * torch.linalg.cross(b, c)).sum(1)
    below = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    turns = corners.new_zeros(len(chosen))
    return turns.index_add(0, labels[faces], torch.atan2(above, below) / (2 * torch.pi))
