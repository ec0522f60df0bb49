"""Solids as signed distances, blended into soft shapes and turned into triangle meshes.

A distance field maps points (N, 3) to (N,), negative inside. Ellipsoids and tapered capsules are first-order
approximations of the distance: exact on the surface, which is all that a mesh needs. NumPy only.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.sparse import coo_matrix, diags
from skimage.measure import marching_cubes

Array = np.ndarray
Vector = Sequence[float] | Array  # (3,)
DistanceField = Callable[[Array], Array]  # (N, 3) -> (N,)


def ellipsoid(points: Array, centre: Vector, radii: Vector, axes: Array | None = None) -> Array:
    """Distance to an ellipsoid, first order around its surface.

    With p scaled to the unit sphere by the radii, k0 = |p / r| and k1 = |p / r^2|, the distance is
    k0 (k0 - 1) / k1: the implicit function divided by its own slope.

    Args:
        points: (N, 3).
        centre: of the ellipsoid.
        radii: along the three axes.
        axes: (3, 3), rows are the unit axes that the radii belong to; the coordinate axes without it.

    Returns:
        (N,), negative inside.
    """
    local = points - np.asarray(centre, points.dtype)
    if axes is not None:
        local = local @ np.asarray(axes, points.dtype).T
    scaled = local / np.asarray(radii, points.dtype)
    radius = _length(scaled)
    slope = _length(scaled / np.asarray(radii, points.dtype))
    return radius * (radius - 1) / np.maximum(slope, 1e-6)


def tapered_capsule(points: Array, start: Vector, end: Vector, start_radius: float, end_radius: float) -> Array:
    """Distance (N,) to a rod from `start` to `end` whose radius runs linearly between two values."""
    origin, axis = np.asarray(start, points.dtype), np.subtract(end, start).astype(points.dtype)
    offset = points - origin
    along = np.clip(offset @ (axis / (axis @ axis)), 0, 1)
    radius = points.dtype.type(start_radius) + points.dtype.type(end_radius - start_radius) * along
    return _length(offset - along[..., None] * axis) - radius


def tube(points: Array, path: Array, radii: Sequence[float], pieces: int = 10) -> Array:
    """Distance (N,) to a bent rod: a cubic Bezier curve with control points `path` (4, 3).

    Its radius runs through `radii` at equal steps of the curve's parameter.
    """
    t = np.linspace(0, 1, pieces + 1)[:, None]
    weights = np.concatenate([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
    corners = weights @ np.asarray(path)
    thickness = np.interp(t[:, 0], np.linspace(0, 1, len(radii)), radii)
    spans = zip(corners[:-1], corners[1:], thickness[:-1], thickness[1:], strict=True)
    return np.minimum.reduce([tapered_capsule(points, *span) for span in spans])


def smooth_union(blend: float, *distances: Array) -> Array:
    """The union of solids, filleted where they meet.

    The quadratic smooth minimum min(a, b) - max(k - |a - b|, 0)^2 / 4k, from left to right; `blend` is k, the
    difference of distances below which two solids flow into each other.
    """
    merged = distances[0]
    for distance in distances[1:]:
        overlap = np.maximum(blend - np.abs(merged - distance), 0)
        merged = np.minimum(merged, distance) - overlap**2 / (4 * blend)
    return merged


def smooth_difference(blend: float, solid: Array, tool: Array) -> Array:
    """What is left of `solid` after `tool` is carved out of it, with a rounded rim."""
    return -smooth_union(blend, -solid, tool)


def graded_axis(low: float, high: float, spacing: DistanceField) -> Array:
    """Grid coordinates from `low` to `high` whose steps follow `spacing(coordinate)`, a positive function."""
    fine = np.linspace(low, high, 1024)
    density = 1 / spacing(fine)
    count = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2) * (fine[1] - fine[0])])
    return np.interp(np.linspace(0, count[-1], int(np.ceil(count[-1])) + 1), count, fine)


def extract_surface(distance: DistanceField, axes: Sequence[Array]) -> tuple[Array, Array]:
    """The zero level of a distance field as a closed triangle mesh: marching cubes on a rectilinear grid.

    The field is evaluated on every third grid plane first, and everywhere only near the surface.

    Args:
        distance: the field, positive on the whole border of the grid.
        axes: three rising coordinate arrays, the grid's planes.

    Returns:
        Vertices (V, 3) float64 and faces (F, 3) int64, counter-clockwise seen from outside.

    Raises:
        ValueError: the surface is empty or leaves the grid.
    """
    volume = _sample_near_surface(distance, axes)
    if volume.min() >= 0 or (volume < 0).sum() != (volume[1:-1, 1:-1, 1:-1] < 0).sum():
        raise ValueError("the surface is empty or reaches the border of the grid: give axes that enclose it")
    volume[volume == 0] = 1e-6  # a level through a grid point would give triangles without area
    indices, faces, _, _ = marching_cubes(volume, 0.0)
    verts = np.stack([np.interp(indices[:, k], np.arange(len(axis)), axis) for k, axis in enumerate(axes)], 1)
    faces = faces.astype(np.int64)
    return verts, faces if signed_volume(verts, faces) > 0 else faces[:, ::-1].copy()


def relax(verts: Array, faces: Array, distance: DistanceField, rounds: int) -> Array:
    """Even out the triangles of a surface without leaving it.

    Every round moves each vertex (V, 3) along the surface half-way to its neighbours' mean, then by one
    Newton step back onto the zero level of `distance`. The slivers of marching cubes open.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    links = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(verts), len(verts))).tocsr()
    links = links + links.T
    mean = diags(1 / np.maximum(np.asarray(links.sum(1)).ravel(), 1)) @ links
    for _ in range(rounds):
        value, slope = value_and_gradient(distance, verts)
        steepness = np.linalg.norm(slope, axis=1, keepdims=True)
        normals = slope / np.maximum(steepness, 1e-9)
        pull = mean @ verts - verts
        along = pull - (pull * normals).sum(1, keepdims=True) * normals
        verts = verts + 0.5 * along - value[:, None] / np.maximum(steepness, 0.3) * normals
    return verts


def signed_volume(verts: Array, faces: Array) -> float:
    """The enclosed volume of a closed mesh, positive when its faces look outwards."""
    a, b, c = (verts[faces[:, k]] for k in range(3))
    return float((a * np.cross(b, c)).sum() / 6)


def value_and_gradient(distance: DistanceField, points: Array, step: float = 2e-3) -> tuple[Array, Array]:
    """A field's values (N,) and gradients (N, 3), exact to second order, from four samples at each point."""
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])  # of a tetrahedron
    samples = distance((points[None] + step * corners[:, None]).reshape(-1, 3)).reshape(4, -1)
    return samples.mean(0), samples.T @ corners / (4 * step)


def _sample_near_surface(distance: DistanceField, axes: Sequence[Array], stride: int = 3) -> Array:
    """The field on the grid (X, Y, Z): exact near the zero level, of the right sign elsewhere."""
    coarse_axes = [np.append(axis[:-1:stride], axis[-1]) for axis in axes]
    coarse = distance(_grid(coarse_axes).reshape(-1, 3)).reshape([len(axis) for axis in coarse_axes])
    grid = _grid(axes)
    blends = [_interpolation(few, all_) for few, all_ in zip(coarse_axes, axes, strict=True)]
    volume = np.einsum("ai,bj,ck,ijk->abc", *blends, coarse, optimize=True)
    reach = stride * max(np.diff(axis).max() for axis in axes)
    near = np.abs(volume) < reach
    volume[near] = distance(grid[near])
    return volume


def _length(vectors: Array) -> Array:
    """`np.linalg.norm` over the last axis, several times faster for short vectors."""
    return np.sqrt(np.einsum("...k,...k->...", vectors, vectors))


def _interpolation(nodes: Array, queries: Array) -> Array:
    """The matrix (Q, N) of piecewise linear interpolation from `nodes` (N,) to `queries` (Q,)."""
    return np.stack([np.interp(queries, nodes, hat) for hat in np.eye(len(nodes))], axis=1).astype(np.float32)


def _grid(axes: Sequence[Array]) -> Array:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).astype(np.float32)
