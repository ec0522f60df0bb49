"""Three Platonic solids of our own, as triangle meshes."""

from __future__ import annotations

from itertools import product
from typing import cast

import numpy as np
import torch
from scipy.spatial import ConvexHull

from rendra.ops import SubdivideMeshes
from rendra.structures import Meshes

_GOLDEN = (1 + 5**0.5) / 2
_CUBE = list(product((-1.0, 1.0), repeat=3))


def cube() -> Meshes:
    """The cube from -1 to 1: 8 corners, 12 triangles."""
    return _hull(np.array(_CUBE))


def octahedron() -> Meshes:
    """6 corners on the axes, as far from the middle as the cube's; 8 triangles."""
    return _hull(np.concatenate([np.eye(3), -np.eye(3)]) * 3**0.5)


def dodecahedron() -> Meshes:
    """The corners of the cube and 12 more on the same sphere; 12 pentagons of 3 triangles each."""
    roofs = [(0.0, a / _GOLDEN, b * _GOLDEN) for a, b in product((-1.0, 1.0), repeat=2)]
    return _hull(np.array(_CUBE + [np.roll(corner, shift) for corner in roofs for shift in range(3)]))


SOLIDS = {"cube": cube, "octahedron": octahedron, "dodecahedron": dodecahedron}


def subdivided(mesh: Meshes, num_verts: int) -> Meshes:
    """The same surface, every triangle cut into four until there are at least `num_verts` vertices."""
    subdivide = SubdivideMeshes()
    while len(mesh.verts_packed()) < num_verts:
        mesh = cast(Meshes, subdivide(mesh))
    return mesh


def _hull(corners: np.ndarray) -> Meshes:
    """The convex hull of corners (V, 3) round the origin, all of which are its vertices; normals point outwards."""
    faces = ConvexHull(corners).simplices
    a, b, c = corners[faces].transpose(1, 0, 2)
    is_inside_out = (np.cross(b - a, c - a) * a).sum(1) < 0
    faces[is_inside_out] = faces[is_inside_out][:, ::-1]
    return Meshes([torch.tensor(corners, dtype=torch.float32)], [torch.tensor(faces, dtype=torch.int64)])
