"""The procedural cow in plain arrays: from its build and its coat to a textured mesh. NumPy only."""

from dataclasses import dataclass

import numpy as np

from rendra_lab.synthesis.atlas import paint, unwrap
from rendra_lab.synthesis.cow_anatomy import Anatomy, CowParameters
from rendra_lab.synthesis.cow_coat import Coat, CoatParameters
from rendra_lab.synthesis.signed_distance import Array

HEAD_DENSITY = 1.7  # the face is looked at most: it gets this many times the texels per length


@dataclass(frozen=True)
class TexturedMesh:
    """One textured mesh in plain arrays.

    Attributes:
        verts: (V, 3) float32.
        faces: (F, 3) int64, counter-clockwise seen from outside.
        verts_uvs: (U, 2) float32 in [0, 1], origin at the lower left of the image.
        faces_uvs: (F, 3) int64 rows of `verts_uvs`.
        texture: (S, S, 3) float32 sRGB in [0, 1], first row at the top.
    """

    verts: Array
    faces: Array
    verts_uvs: Array
    faces_uvs: Array
    texture: Array


def build_cow(
    seed: int = 0,
    texture_size: int = 512,
    num_faces: int = 9600,
    size: float = 1.8,
    build: CowParameters | None = None,
    coat: CoatParameters | None = None,
) -> TexturedMesh:
    """A cow in plain arrays; takes under a second.

    Args:
        seed: of the pattern of the patches. Equal arguments give equal cows.
        texture_size: side of the square texture in texels, at least 128.
        num_faces: how many triangles to use at most, from 2,000 to 60,000.
        size: longest side of the bounding box, which is centred on the origin.
        build: the proportions; the standard animal without it.
        coat: the colours; black on white without it.

    Returns:
        A closed, manifold, outward oriented mesh of one piece, and its texture.

    Raises:
        ValueError: an argument lies outside its range.
    """
    _check_range("texture_size", texture_size, 128, 8192)
    _check_range("num_faces", num_faces, 2000, 60000)
    if not size > 0:
        raise ValueError(f"size must be positive, got {size!r}")
    anatomy = Anatomy(build or CowParameters())
    verts, faces = anatomy.mesh(num_faces)
    centres = verts[faces].mean(1)
    groups, density = _part_groups(anatomy, centres)
    atlas = unwrap(verts, faces, texture_size, groups, density)
    coat = coat or CoatParameters()
    skin = Coat(anatomy, coat, seed, surface=centres[:: max(1, len(centres) // 4000)])
    texture = paint(atlas, verts, faces, texture_size, skin, background=np.asarray(coat.base))
    low, high = verts.min(0), verts.max(0)
    placed = (verts - (low + high) / 2) * (size / (high - low).max())
    return TexturedMesh(
        placed.astype(np.float32),
        faces,
        atlas.uvs.astype(np.float32),
        atlas.faces_uvs,
        np.clip(texture, 0, 1),
    )


def _part_groups(anatomy: Anatomy, points: Array) -> tuple[Array, Array]:
    """Which part (N,) each point belongs to, left and right apart, and the texel density of each group."""
    parts = anatomy.parts()
    nearest = np.stack([distance(points) for distance in parts.values()]).argmin(0)
    paired = np.array([name in ("legs", "ears", "horns") for name in parts])
    density = np.array([HEAD_DENSITY if name == "head" else 1.0 for name in parts])
    groups = 2 * nearest + (paired[nearest] & (points[:, 0] < 0))
    return groups, np.repeat(density, 2)


def _check_range(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ValueError(f"{name} must lie from {low} to {high}, got {value!r}")
