import numpy as np
import pytest

from rendra_lab.synthesis.remeshing import collapse_edges, face_normals, unique_edges
from rendra_lab.synthesis.signed_distance import (
    ellipsoid,
    extract_surface,
    graded_axis,
    relax,
    signed_volume,
    smooth_difference,
    smooth_union,
    tapered_capsule,
    tube,
    value_and_gradient,
)


def sphere(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points, axis=-1) - 1


def grid(step: float = 0.1) -> list[np.ndarray]:
    return [np.arange(-1.3, 1.31, step)] * 3


def edge_counts(faces: np.ndarray) -> np.ndarray:
    ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(ends, axis=0, return_counts=True)[1]


def test_ellipsoid_is_the_exact_distance_of_a_sphere() -> None:
    points = np.random.default_rng(0).normal(size=(50, 3))
    expected = np.linalg.norm(points - (1, 2, 3), axis=1) - 0.5
    np.testing.assert_allclose(ellipsoid(points, (1, 2, 3), (0.5, 0.5, 0.5)), expected, atol=1e-12)


def test_ellipsoid_vanishes_on_its_surface_with_slope_one() -> None:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    axes = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    radii = np.array([1.0, 0.5, 0.2])
    value, slope = value_and_gradient(
        lambda p: ellipsoid(p, (0, 1, 0), radii, axes), directions * radii @ axes + (0, 1, 0), step=1e-4
    )
    np.testing.assert_allclose(value, 0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(slope, axis=1), 1, atol=1e-3)


def test_capsules_and_tubes_agree_where_the_tube_is_straight() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    path = np.linspace([0, 0, 0], [0, 0, 3], 4)
    straight = tapered_capsule(points, path[0], path[-1], 0.3, 0.1)
    np.testing.assert_allclose(tube(points, path, (0.3, 0.1)), straight, atol=0.02)
    beside = tapered_capsule(np.array([[2.0, 0, 1.5]]), path[0], path[-1], 0.3, 0.1)
    np.testing.assert_allclose(beside, 2 - 0.2)


def test_smooth_union_is_symmetric_below_the_minimum_and_equal_to_it_far_from_the_seam() -> None:
    a, b = np.random.default_rng(0).normal(size=(2, 500))
    union = smooth_union(0.2, a, b)
    np.testing.assert_allclose(union, smooth_union(0.2, b, a))
    assert (union <= np.minimum(a, b) + 1e-12).all()
    assert (union >= np.minimum(a, b) - 0.05 - 1e-12).all()
    apart = np.abs(a - b) > 0.2
    np.testing.assert_allclose(union[apart], np.minimum(a, b)[apart])
    np.testing.assert_allclose(smooth_difference(1e-9, a, b), np.maximum(a, -b), atol=1e-8)


def test_graded_axis_follows_the_spacing() -> None:
    axis = graded_axis(-1, 1, lambda x: np.where(x < 0, 0.1, 0.02))
    assert axis[0] == -1
    assert axis[-1] == 1
    np.testing.assert_allclose(np.diff(axis[axis < -0.2]), 0.1, rtol=0.05)
    np.testing.assert_allclose(np.diff(axis[axis > 0.2]), 0.02, rtol=0.05)


def test_surface_of_a_sphere_is_closed_outward_and_of_the_right_volume() -> None:
    verts, faces = extract_surface(sphere, grid())
    verts = relax(verts, faces, sphere, rounds=5)
    assert (edge_counts(faces) == 2).all()
    assert len(verts) - len(edge_counts(faces)) + len(faces) == 2
    np.testing.assert_allclose(np.linalg.norm(verts, axis=1), 1, atol=1e-4)
    assert signed_volume(verts, faces) == pytest.approx(4 / 3 * np.pi, rel=0.01)
    assert ((face_normals(verts, faces) * verts[faces].mean(1)).sum(1) > 0.9).all()


@pytest.mark.parametrize("shift", [5.0, 0.5])
def test_surface_that_is_not_in_the_grid_is_refused(shift: float) -> None:
    with pytest.raises(ValueError, match="empty or reaches the border"):
        extract_surface(lambda p: sphere(p - np.float32(shift)), grid())


@pytest.mark.parametrize("num_faces", [2000, 800, 200])
def test_collapse_keeps_a_sphere_closed_manifold_and_round(num_faces: int) -> None:
    verts, faces = extract_surface(sphere, grid(0.07))
    verts, faces = collapse_edges(relax(verts, faces, sphere, 1), faces, num_faces)
    assert num_faces - 2 < len(faces) <= num_faces
    assert (edge_counts(faces) == 2).all()
    assert len(verts) - len(unique_edges(faces)) + len(faces) == 2
    assert faces.max() == len(verts) - 1
    assert ((face_normals(verts, faces) * verts[faces].mean(1)).sum(1) > 0.5).all()
    assert signed_volume(verts, faces) == pytest.approx(4 / 3 * np.pi, rel=0.1)


def test_collapse_leaves_more_triangles_where_the_surface_bends() -> None:
    def pill(points: np.ndarray) -> np.ndarray:
        return ellipsoid(points, (0, 0, 0), (1.1, 0.25, 1.1))

    verts, faces = extract_surface(pill, grid(0.06))
    verts, faces = collapse_edges(relax(verts, faces, pill, 1), faces, 1500)
    corners = verts[faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    rim = np.linalg.norm(corners.mean(1)[:, [0, 2]], axis=1) > 0.95
    assert np.median(areas[rim]) < 0.6 * np.median(areas[~rim])


def test_a_tetrahedron_cannot_be_reduced() -> None:
    verts = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    with pytest.raises(ValueError, match="cannot be reduced to 2 faces"):
        collapse_edges(verts, faces, 2)
