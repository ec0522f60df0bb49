import numpy as np
import pytest

from rendra_lab.synthesis.atlas import Atlas, cover, paint, unwrap
from rendra_lab.synthesis.signed_distance import extract_surface, relax


def ring(points: np.ndarray) -> np.ndarray:
    """A torus: its upper chart surrounds a hole, its inner side hides behind its outer one."""
    around = np.linalg.norm(points[..., [0, 2]], axis=-1) - 0.8
    return np.hypot(around, points[..., 1]) - 0.3


@pytest.fixture(scope="module")
def torus() -> tuple[np.ndarray, np.ndarray]:
    axes = [np.arange(-1.25, 1.26, 0.08), np.arange(-0.5, 0.51, 0.08), np.arange(-1.25, 1.26, 0.08)]
    verts, faces = extract_surface(ring, axes)
    return relax(verts, faces, ring, 3), faces


def crowded_texels(atlas: Atlas, size: int) -> int:
    texels, _, weights = cover(atlas, size)
    return int((np.bincount(texels[(weights > 1e-6).all(1)]) > 1).sum())


def test_charts_do_not_overlap_and_stay_in_the_image(torus: tuple[np.ndarray, np.ndarray]) -> None:
    atlas = unwrap(*torus, texture_size=256)
    assert atlas.uvs.min() >= 0
    assert atlas.uvs.max() <= 1
    assert crowded_texels(atlas, 256) == 0
    assert crowded_texels(atlas, 1024) == 0


def test_charts_keep_their_distance(torus: tuple[np.ndarray, np.ndarray]) -> None:
    atlas = unwrap(*torus, texture_size=256)
    texels, face, _ = cover(atlas, 256)
    chart = np.full(256 * 256, -1)
    chart[texels] = atlas.charts[face]
    chart = chart.reshape(256, 256)
    for a, b in [(chart[:, 1:], chart[:, :-1]), (chart[1:], chart[:-1])]:
        assert not ((a != b) & (a >= 0) & (b >= 0)).any()


def test_charts_are_not_mirrored(torus: tuple[np.ndarray, np.ndarray]) -> None:
    atlas = unwrap(*torus, texture_size=256)
    a, b, c = (atlas.uvs[atlas.faces_uvs[:, k]] for k in range(3))
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    assert (area > 0).all()


def test_density_gives_a_group_more_texels(torus: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = torus
    groups = (verts[faces].mean(1)[:, 0] > 0).astype(int)
    atlas = unwrap(verts, faces, 256, groups, density=np.array([1.0, 2.0]))
    counts = np.bincount(groups[cover(atlas, 256)[1]])
    assert counts[1] / counts[0] == pytest.approx(4, rel=0.1)


def test_cover_partitions_a_square() -> None:
    uvs = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    atlas = Atlas(uvs, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int))
    texels, face, weights = cover(atlas, 9)
    assert set(texels) == set(range(81))
    assert len(texels) == 81 + 9  # the diagonal belongs to both
    np.testing.assert_allclose(weights.sum(1), 1)
    places = np.einsum("nk,nkd->nd", weights, uvs[atlas.faces_uvs[face]])
    np.testing.assert_allclose(places, np.stack([texels % 9, 8 - texels // 9], 1) / 8, atol=1e-12)


def test_paint_puts_the_surface_point_under_each_texel(torus: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = torus
    atlas = unwrap(verts, faces, 256)
    image = paint(atlas, verts, faces, 256, lambda p: p / 4 + 0.5, background=np.zeros(3))
    pixels = np.rint((atlas.uvs * (1, -1) + (0, 1)) * 255).astype(int)
    corner_colours = image[pixels[:, 1], pixels[:, 0]]
    vertex = np.empty(len(atlas.uvs), int)
    vertex[atlas.faces_uvs] = faces
    assert np.abs(corner_colours - (verts[vertex] / 4 + 0.5)).max() < 0.02  # half a texel


def test_an_image_too_small_for_its_charts_is_refused(torus: tuple[np.ndarray, np.ndarray]) -> None:
    verts, faces = torus
    centres = verts[faces].mean(1)
    sectors = (np.arctan2(centres[:, 2], centres[:, 0]) * 3 + 10).astype(int)
    with pytest.raises(ValueError, match="texture of 32 texels is too small"):
        unwrap(verts, faces, texture_size=32, groups=sectors)
