"""Texture atlases: unfold a closed mesh into flat charts on one square image, and paint that image.

A chart is a connected patch of triangles that look roughly along the same coordinate axis; it is projected
along that axis, scaled, and packed with the others. The image is painted by asking a colour function about
the point of the surface that lies under each texel, so neighbouring charts agree where they meet.

Texel (row r, column c) of an S x S image has u = c / (S - 1), v = 1 - r / (S - 1): the centres of the corner
texels are the corners of the unit square, as in `TexturesUV(align_corners=True)`.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rendra_lab.synthesis.remeshing import face_normals
from rendra_lab.synthesis.signed_distance import Array

# The two coordinates that are left when a chart looks along +x, -x, +y, -y, +z, -z, and their signs: chosen
# so that a chart is seen from outside, not mirrored, and upright where it has an upright.
AXES = np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]
RIGHTS = np.array([[0, 0, -1], [0, 0, 1], [1, 0, 0], [1, 0, 0], [1, 0, 0], [-1, 0, 0]], float)
SMALL_CHART = 24  # faces; smaller ones are given to a neighbour where that does not squeeze them too much
STEEPEST = 0.12  # cosine between a face and the axis of the chart that takes it over


@dataclass(frozen=True)
class Atlas:
    """Where the corners of every triangle lie on the texture.

    Attributes:
        uvs: (U, 2) in [0, 1], origin at the lower left.
        faces_uvs: (F, 3) rows of `uvs`.
        charts: (F,) number of each face's chart.
    """

    uvs: Array
    faces_uvs: Array
    charts: Array


def unwrap(
    verts: Array, faces: Array, texture_size: int, groups: Array | None = None, density: Array | None = None
) -> Atlas:
    """Cut a mesh into charts without overlaps and pack them into the unit square.

    Args:
        verts: (V, 3).
        faces: (F, 3), consistently oriented.
        texture_size: S; charts keep a distance of three texels of an image of this size.
        groups: (F,) integers; a chart never spans two groups.
        density: one factor per group: how much resolution it gets, 1 without it.

    Returns:
        The atlas.

    Raises:
        ValueError: the image is too small for the number of charts.
    """
    groups = np.zeros(len(faces), np.int64) if groups is None else np.asarray(groups, np.int64)
    factor = np.ones(groups.max() + 1) if density is None else np.asarray(density, float)
    directions = _choose_directions(verts, faces, groups)
    extra = np.zeros(len(faces), np.int64)
    for attempt in range(1, 9):
        charts = _components(faces, (extra * 6 + directions) * (groups.max() + 1) + groups)
        atlas = _lay_out(verts, faces, charts, directions, factor[groups], texture_size)
        hidden = _hidden_faces(atlas, verts, faces, directions, texture_size)
        if not len(hidden):
            return atlas
        extra[hidden] = attempt  # a chart that folds over itself loses its lower layer
    raise ValueError("the mesh cannot be cut into charts that do not overlap")


def cover(atlas: Atlas, texture_size: int) -> tuple[Array, Array, Array]:
    """Which triangle lies on which texel.

    Returns:
        Flat texel numbers (N,), faces (N,) and barycentric coordinates (N, 3), one row for each triangle that
        holds a texel's centre. Centres on an edge may appear once for either side.
    """
    pixels = (atlas.uvs * (1, -1) + (0, 1)) * (texture_size - 1)  # column, row
    corners = pixels[atlas.faces_uvs]
    low = np.maximum(np.ceil(corners.min(1) - 1e-9), 0).astype(np.int64)
    high = np.minimum(np.floor(corners.max(1) + 1e-9), texture_size - 1).astype(np.int64)
    columns, rows = np.maximum(high - low + 1, 0).T
    counts = columns * rows
    face = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    column = low[face, 0] + place % np.maximum(columns[face], 1)
    row = low[face, 1] + place // np.maximum(columns[face], 1)
    weights = _barycentric(np.stack([column, row], 1), corners[face])
    inside = (weights > -1e-9).all(1)
    return (row * texture_size + column)[inside], face[inside], weights[inside]


def paint(
    atlas: Atlas,
    verts: Array,
    faces: Array,
    texture_size: int,
    colour: Callable[[Array], Array],
    background: Array,
) -> Array:
    """Draw the texture of an atlas.

    Args:
        atlas: of the mesh.
        verts: (V, 3).
        faces: (F, 3).
        texture_size: S.
        colour: maps points of the surface (N, 3) to colours (N, 3) in [0, 1].
        background: (3,), the colour far from every chart.

    Returns:
        The image (S, S, 3), float32. Charts run on by four texels over their border, so that bilinear
        sampling and small mip maps never meet the background.
    """
    texels, face, weights = cover(atlas, texture_size)
    points = np.full((texture_size**2, 3), np.nan)
    points[texels] = np.einsum("nk,nkd->nd", weights, verts[faces[face]])
    covered = ~np.isnan(points[:, 0]).reshape(texture_size, texture_size)
    distance, nearest = distance_transform_edt(~covered, return_indices=True)
    near = distance <= 4
    source = nearest[0][near] * texture_size + nearest[1][near]
    image = np.empty((texture_size, texture_size, 3), np.float32)
    image[:] = background
    image[near] = colour(points[source])
    return image


def _choose_directions(verts: Array, faces: Array, groups: Array) -> Array:
    """The axis (F,), a row of AXES, along which each face is projected.

    Its dominant one, but with ragged borders and small islands smoothed away.
    """
    score = face_normals(verts, faces) @ AXES.T
    neighbours = _face_neighbours(faces)
    alike = groups[neighbours] == groups[:, None]
    directions = score.argmax(1)
    for _ in range(6):
        votes = np.stack([((directions[neighbours] == k) & alike).sum(1) for k in range(6)], 1)
        directions = np.where(score > 0.35, score + 0.25 * votes, score).argmax(1)
    for _ in range(6):
        charts = _components(faces, directions * (groups.max() + 1) + groups)
        size = np.bincount(charts)[charts]
        votes = np.zeros((len(size), 6))
        for corner in range(3):
            other = neighbours[:, corner]
            useful = alike[:, corner] & (size[other] > size)
            np.add.at(votes, (charts[useful], directions[other[useful]]), 1)
        wish = votes[charts]
        wish[np.minimum.reduceat(score[np.argsort(charts, kind="stable")], _starts(charts))[charts] < STEEPEST] = 0
        moves = (size < SMALL_CHART) & (wish.max(1) > 0)
        directions = np.where(moves, wish.argmax(1), directions)
    return directions


def _starts(charts: Array) -> Array:
    """Where each chart begins when faces are sorted by chart."""
    counts = np.bincount(charts)
    return np.cumsum(counts) - counts


def _face_neighbours(faces: Array) -> Array:
    """The three faces (F, 3) across the edges of each face of a closed mesh."""
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    order = np.lexsort(ends.T)
    pairs = order.reshape(-1, 2)
    other = np.empty(len(ends), np.int64)
    other[pairs[:, 0]], other[pairs[:, 1]] = pairs[:, 1], pairs[:, 0]
    return (other % len(faces)).reshape(3, -1).T


def _components(faces: Array, labels: Array) -> Array:
    """Numbers (F,) of the connected patches of equal label."""
    neighbours = _face_neighbours(faces)
    rows = np.repeat(np.arange(len(faces)), 3)
    columns = neighbours.ravel()
    same = labels[rows] == labels[columns]
    graph = coo_matrix((np.ones(same.sum()), (rows[same], columns[same])), shape=(len(faces), len(faces)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _lay_out(
    verts: Array, faces: Array, charts: Array, directions: Array, density: Array, texture_size: int
) -> Atlas:
    """Project every chart along its axis and pack the bounding rectangles as large as they fit."""
    keys = charts[:, None] * len(verts) + faces
    corners, faces_uvs = np.unique(keys, return_inverse=True)
    faces_uvs = faces_uvs.reshape(-1, 3)
    chart, vertex = corners // len(verts), corners % len(verts)
    first = np.unique(charts, return_index=True)[1]
    right = RIGHTS[directions[first]]
    up = np.cross(AXES[directions[first]], right)
    flat = np.stack([(verts[vertex] * right[chart]).sum(1), (verts[vertex] * up[chart]).sum(1)], 1)
    flat *= density[first][chart, None]
    low, high = (np.full((len(first), 2), value) for value in (np.inf, -np.inf))
    np.minimum.at(low, chart, flat)
    np.maximum.at(high, chart, flat)
    flat -= low[chart]
    lying = (high - low)[:, 0] < (high - low)[:, 1]  # rows fill better with rectangles that lie down
    turned = lying[chart]
    flat[turned] = np.stack([flat[turned][:, 1], (high - low)[chart[turned], 0] - flat[turned][:, 0]], 1)
    extent = np.where(lying[:, None], (high - low)[:, ::-1], high - low)
    scale, places = _pack(extent, texture_size)
    uvs = (flat * scale + places[chart]) / (texture_size - 1)
    return Atlas(np.clip(uvs, 0, 1), faces_uvs, charts)


def _pack(extent: Array, texture_size: int, gap: float = 3.0) -> tuple[float, Array]:
    """The largest scale in texels per unit at which rectangles (C, 2) fit, by bisection, and their places."""
    low, high = 0.0, (texture_size - 1) / extent.max()
    order = np.argsort(-extent[:, 1], kind="stable")
    side = texture_size - 1 - gap
    best = None
    for _ in range(24):
        scale = (low + high) / 2
        places, height = _shelves(extent[order] * scale + gap, side)
        if height <= side:
            low, best = scale, places
        else:
            high = scale
    if best is None or low * extent.max() < 8:
        raise ValueError(f"a texture of {texture_size} texels is too small for {len(extent)} charts")
    result = np.empty_like(extent)
    result[order] = best + gap
    return low, result


def _shelves(extent: Array, side: float) -> tuple[Array, float]:
    """First-fit packing of rectangles, sorted by falling height, into rows of width `side`.

    Returns:
        Lower left corners (C, 2) and the height used.
    """
    shelves: list[list[float]] = []  # filled width, bottom
    places = np.empty_like(extent)
    top = 0.0
    for number, (width, height) in enumerate(extent):
        if width > side:
            return places, np.inf
        shelf = next((shelf for shelf in shelves if shelf[0] + width <= side), None)
        if shelf is None:
            shelf = [0.0, top]
            shelves.append(shelf)
            top += height
        places[number] = shelf
        shelf[0] += width
    return places, top


def _hidden_faces(atlas: Atlas, verts: Array, faces: Array, directions: Array, texture_size: int) -> Array:
    """Faces that share texels with another face of the atlas which lies further out along its axis."""
    texels, face, weights = cover(atlas, texture_size)
    strict = (weights > 1e-6).all(1)
    texels, face = texels[strict], face[strict]
    crowded = np.bincount(texels, minlength=texture_size**2)[texels] > 1
    if not crowded.any():
        return np.empty(0, np.int64)
    texels, face = texels[crowded], face[crowded]
    depth = (verts[faces[face]].mean(1) * AXES[directions[face]]).sum(1)
    outermost = np.full(texture_size**2, -np.inf)
    np.maximum.at(outermost, texels, depth)
    return np.unique(face[depth < outermost[texels]])


def _barycentric(points: Array, triangles: Array) -> Array:
    """Weights (N, 3) of points (N, 2) in triangles (N, 3, 2); all -1 in a triangle without area."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    area = _cross(b - a, c - a)
    safe = np.where(np.abs(area) > 1e-12, area, 1)
    first, second = _cross(b - points, c - points) / safe, _cross(c - points, a - points) / safe
    weights = np.stack([first, second, 1 - first - second], 1)
    return np.where(np.abs(area)[:, None] > 1e-12, weights, -1.0)


def _cross(a: Array, b: Array) -> Array:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
