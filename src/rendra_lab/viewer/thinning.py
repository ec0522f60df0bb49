"""What is too large for a page in a size that is not. Letters: V verts, F faces, P points."""

import numpy as np

_STEPS = 12  # of the search for a cell: it halves an interval of its logarithm


def merged_neighbours(
    verts: np.ndarray, faces: np.ndarray, values: dict[str, np.ndarray], most: int
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """A mesh of at most `most` faces: the vertices of each cell of a grid become their mean.

    Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993. Robust against any
    connectivity; the grid is the finest, within a few percent, that suffices.

    Args:
        verts: (V, 3), finite.
        faces: (F, 3) rows of `verts`.
        values: by name, of the vertices (V, C).
        most: faces, at least 1.
    """
    low, side = verts.min(axis=0), float(np.ptp(verts, axis=0).max()) or 1.0
    fine, coarse = np.log(side / 4096.0), np.log(2.0 * side)
    best = np.zeros(len(verts), dtype=np.int64)  # one cell for all: no face is left
    for _ in range(_STEPS):
        middle = (fine + coarse) / 2.0
        cells = _cells(verts, low, float(np.exp(middle)))
        if len(_distinct(cells[faces])) > most:
            fine = middle
        else:
            coarse, best = middle, cells
    kept = _distinct(best[faces])
    counts = np.bincount(best)[:, None]
    merged = {name: _sums(array, best) / counts for name, array in values.items()}
    return (_sums(verts, best) / counts).astype(np.float32), kept, merged


def _cells(verts: np.ndarray, low: np.ndarray, cell: float) -> np.ndarray:
    """Which occupied cell every vertex lies in, (V,), from 0."""
    place = ((verts - low) / cell).astype(np.int64)
    return np.unique(place @ np.array([1, 1 << 20, 1 << 40]), return_inverse=True)[1].reshape(-1)


def _distinct(faces: np.ndarray) -> np.ndarray:
    """The faces (F, 3) that still have three corners."""
    a, b, c = faces.T
    return faces[(a != b) & (b != c) & (c != a)]


def _sums(values: np.ndarray, groups: np.ndarray) -> np.ndarray:
    return np.stack([np.bincount(groups, column) for column in values.T], axis=1)


def chosen_points(count: int, most: int) -> np.ndarray:
    """The numbers of `most` of `count` points in order, drawn evenly, always the same ones."""
    return np.sort(np.random.default_rng(0).choice(count, most, replace=False, shuffle=False))
