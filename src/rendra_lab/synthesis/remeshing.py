"""Fewer triangles where a surface is flat, many where it bends: edge collapse on closed meshes.

Collapses are chosen in rounds of edges so far apart that they cannot disturb each other, which turns the
usual priority queue into array operations. NumPy and SciPy only.
"""

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix

from rendra_lab.synthesis.signed_distance import Array

LARGEST_VALENCE = 9  # a fan of more triangles round one vertex shades badly
ROUNDS = 200  # far more than any reduction by a factor of ten takes
SMALLEST_TURN = 0.2  # cosine between a face before and after a collapse, below which the collapse is refused


def collapse_edges(verts: Array, faces: Array, num_faces: int) -> tuple[Array, Array]:
    """Merge vertices of a closed manifold mesh until at most `num_faces` triangles are left.

    Edges go first that are short for the curvature they lie in. A collapse that would change the topology
    (the link condition: the ends of an edge share exactly two neighbours), turn a face over or crowd a vertex
    is left out, so the result stays closed and manifold.

    Args:
        verts: (V, 3).
        faces: (F, 3), consistently oriented, every edge in exactly two faces.
        num_faces: the number to reach.

    Returns:
        Vertices (V', 3) and faces (F', 3).

    Raises:
        ValueError: the mesh cannot be reduced so far without folding over.
    """
    sizes = _feature_sizes(verts, faces)
    verts = verts.copy()
    for _ in range(ROUNDS):
        if len(faces) <= num_faces:
            break
        merged = _choose(verts, faces, sizes, limit=-(-(len(faces) - num_faces) // 2))
        kept, gone = merged.T
        verts[kept] = (verts[kept] + verts[gone]) / 2
        sizes[kept] = np.minimum(sizes[kept], sizes[gone])
        faces = _rename(faces, kept, gone)
    else:
        raise ValueError(f"the mesh cannot be reduced to {num_faces} faces: stuck at {len(faces)}")
    used, faces = np.unique(faces, return_inverse=True)
    return verts[used], faces.reshape(-1, 3)


def unique_edges(faces: Array) -> Array:
    """The undirected edges (E, 2) of a mesh, lower vertex first."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    codes = np.unique(ends[:, 0] * (faces.max() + 1) + ends[:, 1])
    return np.stack([codes // (faces.max() + 1), codes % (faces.max() + 1)], axis=1)


def face_normals(verts: Array, faces: Array) -> Array:
    """Unit normals (F, 3); zero for a triangle without area."""
    a, b, c = (verts[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)


def _feature_sizes(verts: Array, faces: Array) -> Array:
    """The edge length (V,) that each vertex asks for, up to a factor: shorter where the surface bends."""
    normals = np.zeros_like(verts)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals(verts, faces))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-20)
    a, b = unique_edges(faces).T
    bend = np.linalg.norm(normals[a] - normals[b], axis=1) / np.linalg.norm(verts[a] - verts[b], axis=1)
    curvature = np.zeros(len(verts))
    np.maximum.at(curvature, a, bend)
    np.maximum.at(curvature, b, bend)
    links = _adjacency(np.stack([a, b], 1), len(verts))
    for _ in range(3):
        curvature = (curvature + links @ curvature) / (1 + np.asarray(links.sum(1)).ravel())
    typical = np.median(curvature)
    return 1 / np.clip(curvature / typical, 0.7, 5.0) ** 0.7


def _choose(verts: Array, faces: Array, sizes: Array, limit: int) -> Array:
    """Collapses (C, 2), kept vertex first, that do not touch each other; the most useful `limit` of them.

    Ends of edges that would turn a face over ask for shorter edges from now on: `sizes` is changed.
    """
    edges = unique_edges(faces)
    a, b = edges.T
    links = _adjacency(edges, len(verts))
    valence = np.asarray(links.sum(1)).ravel()
    allowed = valence[a] + valence[b] - 4 <= LARGEST_VALENCE
    cost = np.linalg.norm(verts[a] - verts[b], axis=1) / np.minimum(sizes[a], sizes[b])
    candidates = np.flatnonzero(allowed & (cost <= np.quantile(cost[allowed], 0.45)))
    candidates = candidates[np.argsort(cost[candidates], kind="stable")]
    edges = edges[candidates]
    edges = edges[_keeps_topology(edges, links, valence)]
    edges = edges[_apart(edges, links)]
    edges = edges[_own_opposites(edges, links)][: max(2 * limit, 8)]
    sound = _keeps_orientation(edges, verts, faces)
    sizes[edges[~sound]] *= 0.7  # so that they do not stand in their neighbours' way for ever
    return edges[sound][:limit]


def _apart(edges: Array, links: csr_matrix) -> Array:
    """Mask of edges, given in order of merit, that come before every other edge with an end near theirs."""
    rank = np.full(links.shape[0], len(edges))
    order = np.arange(len(edges))
    np.minimum.at(rank, edges[:, 0], order)
    np.minimum.at(rank, edges[:, 1], order)
    near = rank.copy()
    rows = np.repeat(np.arange(links.shape[0]), np.diff(links.indptr))
    np.minimum.at(near, rows, rank[links.indices])
    return (near[edges[:, 0]] == order) & (near[edges[:, 1]] == order)


def _keeps_topology(edges: Array, links: csr_matrix, valence: Array) -> Array:
    """Mask of edges that fulfil the link condition and whose two opposite vertices can spare a face."""
    shared = links[edges[:, 0]].multiply(links[edges[:, 1]]).tocsr()
    rows = np.repeat(np.arange(len(edges)), np.diff(shared.indptr))
    poor = np.bincount(rows, valence[shared.indices] < 4, minlength=len(edges)) > 0
    return (np.diff(shared.indptr) == 2) & ~poor


def _own_opposites(edges: Array, links: csr_matrix) -> Array:
    """Mask of edges that come first among those that share one of their opposite vertices."""
    shared = links[edges[:, 0]].multiply(links[edges[:, 1]]).tocsr()
    rows = np.repeat(np.arange(len(edges)), np.diff(shared.indptr))
    first = np.full(links.shape[0], len(edges))
    np.minimum.at(first, shared.indices, rows)
    return np.bincount(rows, first[shared.indices] < rows, minlength=len(edges)) == 0


def _keeps_orientation(edges: Array, verts: Array, faces: Array) -> Array:
    """Mask of collapses after which no neighbouring face has turned far from where it looked before."""
    owner = np.full(len(verts), -1)
    owner[edges] = np.arange(len(edges))[:, None]
    moved = verts.copy()
    moved[edges] = verts[edges].mean(axis=1, keepdims=True)
    touched = np.flatnonzero((owner[faces] >= 0).any(1))
    owners = owner[faces[touched]]
    survives = (owners >= 0).sum(1) == 1  # two corners of one collapsed edge: the face vanishes
    touched, owners = touched[survives], owners[survives].max(1)
    turn = (face_normals(verts, faces[touched]) * face_normals(moved, faces[touched])).sum(1)
    return np.bincount(owners, turn < SMALLEST_TURN, minlength=len(edges)) == 0


def _rename(faces: Array, kept: Array, gone: Array) -> Array:
    """Faces after the vertices `gone` became `kept`, without those that lost their area."""
    names = np.arange(faces.max() + 1)
    names[gone] = kept
    faces = names[faces]
    flat = (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    return faces[~flat]


def _adjacency(edges: Array, count: int) -> csr_matrix:
    """The symmetric 0/1 matrix (V, V) of neighbouring vertices."""
    both = np.concatenate([edges, edges[:, ::-1]]).T
    return coo_matrix((np.ones(both.shape[1]), both), shape=(count, count)).tocsr()
