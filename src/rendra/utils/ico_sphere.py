"""The unit sphere as a subdivided icosahedron."""

import torch

from rendra.ops.subdivide_meshes import SubdivideMeshes
from rendra.structures.meshes import Meshes

_GOLDEN = (1 + 5**0.5) / 2
# The corners of three golden rectangles, each in one coordinate plane.
_VERTS = [
    *[(x, y, 0.0) for y in (_GOLDEN, -_GOLDEN) for x in (-1.0, 1.0)],
    *[(0.0, y, z) for z in (_GOLDEN, -_GOLDEN) for y in (-1.0, 1.0)],
    *[(x, 0.0, z) for x in (_GOLDEN, -_GOLDEN) for z in (-1.0, 1.0)],
]
_FACES = [
    *[(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11)],  # around vertex 0
    *[(1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8)],
    *[(3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9)],  # around vertex 3, opposite to 0
    *[(4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)],
]


def ico_sphere(level: int = 0, device: torch.device | str | None = None) -> Meshes:
    """A sphere of radius 1 about the origin, its faces looking outwards.

    Args:
        level: how often the icosahedron is subdivided and pushed out to the sphere again.
        device: CPU if None.

    Returns:
        One mesh of 10 * 4^level + 2 vertices and 20 * 4^level faces, float32.

    Raises:
        ValueError: `level` is not an integer >= 0.
    """
    if not isinstance(level, int) or level < 0:
        raise ValueError(f"level must be an integer >= 0, got {level!r}")
    verts = torch.nn.functional.normalize(torch.tensor(_VERTS, dtype=torch.float32, device=device), dim=1)
    sphere = Meshes([verts], [torch.tensor(_FACES, device=device)])
    subdivide = SubdivideMeshes()
    for _ in range(level):
        finer = subdivide(sphere)
        sphere = finer.update_padded(torch.nn.functional.normalize(finer.verts_padded(), dim=2))
    return sphere
