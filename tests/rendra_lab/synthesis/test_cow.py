import numpy as np
import pytest

from rendra_lab.synthesis.atlas import Atlas, cover
from rendra_lab.synthesis.cow import BREEDS, CoatParameters, CowParameters, TexturedMesh, build_cow, make_cow
from rendra_lab.synthesis.cow_anatomy import Anatomy
from rendra_lab.synthesis.remeshing import unique_edges
from rendra_lab.synthesis.signed_distance import signed_volume

SMALL = {"texture_size": 256, "num_faces": 3000}


@pytest.fixture(scope="module")
def cow() -> TexturedMesh:
    return build_cow()


def number_of_pieces(faces: np.ndarray) -> int:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    edges = unique_edges(faces).T
    count = faces.max() + 1
    return connected_components(coo_matrix((np.ones(edges.shape[1]), edges), shape=(count, count)))[0]


def assert_sound(cow: TexturedMesh) -> None:
    directed = np.concatenate([cow.faces[:, [0, 1]], cow.faces[:, [1, 2]], cow.faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed), "two faces run along an edge the same way"
    assert len(unique_edges(cow.faces)) * 2 == len(directed), "an edge without exactly two faces"
    assert number_of_pieces(cow.faces) == 1
    assert len(cow.verts) - len(unique_edges(cow.faces)) + len(cow.faces) == 2
    assert signed_volume(cow.verts, cow.faces) > 0.1
    assert cow.verts_uvs.min() >= 0
    assert cow.verts_uvs.max() <= 1
    size = len(cow.texture)
    texels, _, weights = cover(Atlas(cow.verts_uvs.astype(float), cow.faces_uvs, np.zeros(0)), size)
    assert (np.bincount(texels[(weights > 1e-3).all(1)]) <= 1).all(), "charts overlap"


def test_is_closed_manifold_outward_and_unwrapped_without_overlaps(cow: TexturedMesh) -> None:
    assert_sound(cow)
    assert 9000 < len(cow.faces) < 10_000


def test_triangles_are_well_shaped(cow: TexturedMesh) -> None:
    corners = cow.verts[cow.faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    quality = 4 * np.sqrt(3) * areas / (edges**2).sum(1)  # 1 for an equilateral triangle
    assert quality.min() > 0.1
    assert np.median(quality) > 0.85


def test_stands_centred_and_looks_towards_negative_z(cow: TexturedMesh) -> None:
    low, high = cow.verts.min(0), cow.verts.max(0)
    np.testing.assert_allclose(low + high, 0, atol=1e-5)
    assert (high - low).max() == pytest.approx(1.8, abs=1e-5)
    top = cow.verts[cow.verts[:, 1] > 0.3]
    assert top[:, 2].mean() < -0.3, "horns, ears and head belong to negative z"
    soles = cow.verts[cow.verts[:, 1] < low[1] + 0.02]
    assert soles[:, 2].max() - soles[:, 2].min() > 0.6
    assert (soles[:, 0] > 0.05).any()
    assert (soles[:, 0] < -0.05).any()


def test_texture_shows_patches_muzzle_and_eyes(cow: TexturedMesh) -> None:
    texels, face, _ = cover(Atlas(cow.verts_uvs.astype(float), cow.faces_uvs, np.zeros(0)), 512)
    assert len(texels) > 0.3 * 512**2, "the charts leave most of the image empty"
    colour = cow.texture.reshape(-1, 3)[texels]
    assert ((cow.texture >= 0) & (cow.texture <= 1)).all()
    light = (colour.min(1) > 0.8).mean()
    dark = (colour.max(1) < 0.3).mean()
    pink = ((colour[:, 0] - colour[:, 1] > 0.2) & (colour[:, 0] > 0.8)).mean()
    assert light > 0.2
    assert dark > 0.2
    assert pink > 0.04
    eyes = cow.verts[cow.faces[face[colour.min(1) > 0.999]]].mean(1)  # only their lights are pure white
    assert (eyes[:, 0] > 0).any()
    assert (eyes[:, 0] < 0).any()
    assert (eyes[:, 2] < -0.5).all()


def test_texture_has_no_seams(cow: TexturedMesh) -> None:
    size = len(cow.texture)
    edge_colours: dict[tuple[int, int], list[np.ndarray]] = {}
    a, b = cow.faces, np.roll(cow.faces, -1, axis=1)
    middles = (cow.verts_uvs[cow.faces_uvs] + cow.verts_uvs[np.roll(cow.faces_uvs, -1, axis=1)]) / 2
    pixels = (middles * (1, -1) + (0, 1)) * (size - 1)
    low = np.clip(np.floor(pixels).astype(int), 0, size - 2)
    column, row = np.moveaxis(low, -1, 0)
    x, y = np.moveaxis((pixels - low)[..., None], 2, 0)
    image = cow.texture
    colours = (1 - y) * ((1 - x) * image[row, column] + x * image[row, column + 1]) + y * (
        (1 - x) * image[row + 1, column] + x * image[row + 1, column + 1]
    )
    for start, end, colour in zip(a.ravel(), b.ravel(), colours.reshape(-1, 3), strict=True):
        edge_colours.setdefault((min(start, end), max(start, end)), []).append(colour)
    jump = np.array([np.abs(one - other).max() for one, other in edge_colours.values()])
    assert np.quantile(jump, 0.99) < 0.1
    assert jump.mean() < 0.005


def test_equal_arguments_give_equal_cows() -> None:
    one, two = build_cow(seed=3, **SMALL), build_cow(seed=3, **SMALL)
    for name in ("verts", "faces", "verts_uvs", "faces_uvs", "texture"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


def test_the_seed_moves_the_patches_and_nothing_else() -> None:
    one, two = build_cow(seed=0, **SMALL), build_cow(seed=1, **SMALL)
    np.testing.assert_array_equal(one.verts, two.verts)
    assert np.abs(one.texture - two.texture).mean() > 0.02


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_animals_are_sound(seed: int) -> None:
    cow = build_cow(seed, build=CowParameters.random(seed), coat=CoatParameters.random(seed), **SMALL)
    assert_sound(cow)
    assert len(cow.faces) <= 3000


@pytest.mark.parametrize(
    "build",
    [
        CowParameters(horn_length=0, ear_length=0.7, head=0.7, girth=1.4, head_pitch_deg=-25, tail_swing=-1),
        CowParameters(head=1.4, body_length=0.7, girth=0.7, leg_length=1.4, leg_thickness=1.4, head_pitch_deg=35),
        CowParameters(head=1.4, body_length=1.4, leg_length=0.7, leg_thickness=0.7, horn_length=1.6, ear_length=1.4),
    ],
)
def test_extreme_builds_are_sound(build: CowParameters) -> None:
    assert_sound(build_cow(build=build, texture_size=512, num_faces=4000))


def test_coverage_is_the_share_of_patches() -> None:
    def dark_share(coverage: float) -> float:
        cow = build_cow(coat=CoatParameters(coverage=coverage, blaze=False), **SMALL)
        texels = cover(Atlas(cow.verts_uvs.astype(float), cow.faces_uvs, np.zeros(0)), 256)[0]
        return float((cow.texture.reshape(-1, 3)[texels].max(1) < 0.3).mean())

    assert dark_share(0.1) < dark_share(0.4) < dark_share(0.8)


def test_every_breed_has_its_own_coat() -> None:
    coats = {CoatParameters.of_breed(breed) for breed in BREEDS}
    assert len(coats) == len(BREEDS)
    with pytest.raises(ValueError, match="unknown breed 'zebra'; there are holstein"):
        CoatParameters.of_breed("zebra")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: build_cow(texture_size=64), "texture_size must lie from 128 to 8192, got 64"),
        (lambda: build_cow(num_faces=100), "num_faces must lie from 2000 to 60000, got 100"),
        (lambda: build_cow(size=0), "size must be positive"),
        (lambda: CowParameters(head=3), r"CowParameters.head must lie in \[0.7, 1.4\], got 3"),
        (lambda: CoatParameters(coverage=2), r"coverage must lie in \[0, 0.9\], got 2"),
        (lambda: CoatParameters(patch=(2, 0, 0)), r"CoatParameters.patch must be three numbers"),
        (lambda: CoatParameters(patch_size=0), "patch_size must lie in"),
    ],
)
def test_mistakes_are_named(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_fewest_and_many_faces() -> None:
    assert len(build_cow(num_faces=2000, texture_size=256).faces) <= 2000
    verts, faces = Anatomy(CowParameters()).mesh(20_000)
    assert 19_990 < len(faces) <= 20_000
    assert np.isfinite(verts).all()


def test_make_cow_gives_a_textured_batch_of_one() -> None:
    meshes = make_cow(**SMALL)
    plain = build_cow(**SMALL)
    assert len(meshes) == 1
    np.testing.assert_array_equal(meshes.verts_packed().numpy(), plain.verts)
    np.testing.assert_array_equal(meshes.faces_packed().numpy(), plain.faces)
    np.testing.assert_array_equal(meshes.textures.maps_padded()[0].numpy(), plain.texture)
