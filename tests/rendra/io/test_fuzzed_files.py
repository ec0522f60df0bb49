"""Every reader, fed with damaged files: a sound result or the documented error, soon, and in bounded memory.

The fast tests take a few hundred examples; the slow one takes `RENDRA_FUZZ_EXAMPLES` (10,000) of every format.
"""

import io
import os
from collections import Counter
from collections.abc import Callable

import pytest
import torch
from file_limits import within_limits
from file_mutations import damaged, edits
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_files import (
    Asset,
    colored_obj_asset,
    glb_asset,
    gltf_asset,
    image_bytes,
    obj_asset,
    off_asset,
    ply_asset,
    stl_asset,
    xyz_asset,
)

from rendra.io import IO, MeshFormatError, load_obj, load_ply
from rendra.io.mtl_io import load_mtl
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes

LONGEST_MESSAGE = 600
QUICK_EXAMPLES = 60
SLOW_EXAMPLES = int(os.environ.get("RENDRA_FUZZ_EXAMPLES", "10000"))
CALM = list(HealthCheck)


class Storage:
    """A path manager over a few files in memory."""

    def __init__(self, files: dict[str, bytes]) -> None:
        self._files = files

    def open(self, path: str, mode: str = "r") -> io.BytesIO:
        assert mode == "rb"
        name = os.path.normpath(path)
        if name not in self._files:
            raise FileNotFoundError(path)
        return io.BytesIO(self._files[name])


# What a reader may return


def demand_finite(*tensors: torch.Tensor | None) -> None:
    assert all(bool(torch.isfinite(each).all()) for each in tensors if each is not None)


def demand_indices(index: torch.Tensor, count: int, least: int = 0) -> None:
    assert index.dtype == torch.int64
    assert not index.numel() or least <= int(index.min()) <= int(index.max()) < count


def check_obj(asset: Asset) -> None:
    verts, faces, properties = load_obj(asset.name, path_manager=Storage(asset.files))
    demand_finite(verts, properties.normals, properties.verts_uvs)
    demand_indices(faces.verts_idx, len(verts))
    demand_indices(faces.normals_idx, 0 if properties.normals is None else len(properties.normals), -1)
    demand_indices(faces.textures_idx, 0 if properties.verts_uvs is None else len(properties.verts_uvs), -1)
    assert faces.verts_idx.shape == faces.normals_idx.shape == faces.textures_idx.shape == (len(faces[3]), 3)
    demand_finite(*(value for color in (properties.material_colors or {}).values() for value in color.values()))
    demand_images(properties.texture_images or {})


def demand_images(images: dict[str, torch.Tensor]) -> None:
    for image in images.values():
        assert image.dim() == 3
        assert image.shape[2] == 3
        assert 0.0 <= float(image.min()) <= float(image.max()) <= 1.0


def check_mtl(asset: Asset) -> None:
    colors, images = load_mtl(
        io.BytesIO(asset.files["mesh.mtl"]), material_names=["paint"], data_dir="", path_manager=Storage(asset.files)
    )
    demand_finite(*(value for color in colors.values() for value in color.values()))
    demand_images(images)


def check_ply(asset: Asset) -> None:
    verts, faces = load_ply(asset.name, path_manager=Storage(asset.files))
    demand_finite(verts)
    assert faces.shape == (len(faces), 3)
    demand_indices(faces, len(verts))


def check_mesh(asset: Asset) -> None:
    mesh = IO(path_manager=Storage(asset.files)).load_mesh(asset.name)
    assert isinstance(mesh, Meshes)
    assert len(mesh) == 1
    verts, faces = mesh.get_mesh_verts_faces(0)
    demand_finite(verts)
    demand_indices(faces, len(verts))
    demand_textures(mesh, len(verts), len(faces))


def demand_textures(mesh: Meshes, num_verts: int, num_faces: int) -> None:
    textures = mesh.textures
    if isinstance(textures, TexturesUV):
        demand_images({"map": textures.maps_padded()[0][..., :3]})
        demand_finite(textures.verts_uvs_list()[0])
        assert textures.faces_uvs_list()[0].shape == (num_faces, 3)
        demand_indices(textures.faces_uvs_list()[0], len(textures.verts_uvs_list()[0]))
    elif isinstance(textures, TexturesVertex):
        assert len(textures.verts_features_list()[0]) == num_verts
    elif isinstance(textures, TexturesAtlas):
        assert len(textures.atlas_list()[0]) == num_faces
    else:
        assert textures is None


def check_cloud(asset: Asset) -> None:
    cloud = IO(path_manager=Storage(asset.files)).load_pointcloud(asset.name)
    points = cloud.points_list()[0]
    assert points.shape == (len(points), 3)
    demand_finite(points)
    for per_point in (cloud.normals_list(), cloud.features_list()):
        assert per_point is None or len(per_point[0]) == len(points)


# Reader, asset, and which of its files is damaged

IMAGES = (
    ("PNG", "RGB"), ("PNG", "P"), ("PNG", "I;16"), ("JPEG", "RGB"), ("JPEG", "CMYK"), ("BMP", "RGB"), ("TGA", "RGB"),
    ("TIFF", "RGB"), ("WEBP", "RGB"), ("GIF", "P"), ("PPM", "RGB"),
)  # fmt: skip
ENCODINGS = ("ascii", "binary_little_endian", "binary_big_endian")
CASES: dict[str, tuple[Callable[[Asset], None], Asset, str]] = {
    "load_obj": (check_obj, obj_asset(), "mesh.obj"),
    "load_obj, library": (check_obj, obj_asset(), "mesh.mtl"),
    "load_mtl": (check_mtl, obj_asset(), "mesh.mtl"),
    **{
        f"load_mtl, {kind} {mode}": (
            check_mtl,
            obj_asset().replaced("paint.png", image_bytes(kind, mode=mode)),
            "paint.png",
        )
        for kind, mode in IMAGES
    },
    "load_mesh obj": (check_mesh, obj_asset(), "mesh.obj"),
    "load_mesh obj, coloured": (check_mesh, colored_obj_asset(), "mesh.obj"),
}
for _encoding in ENCODINGS:
    CASES[f"load_ply {_encoding}"] = (check_ply, ply_asset(_encoding), "mesh.ply")
    CASES[f"load_mesh ply {_encoding}"] = (check_mesh, ply_asset(_encoding), "mesh.ply")
for _asset, _label in (
    (glb_asset(True), "textured"), (glb_asset(False), "coloured"), (off_asset(True), "coloured"),
    (off_asset(False), "plain"), (stl_asset(True), "binary"), (stl_asset(False), "text"), (gltf_asset(), "in parts"),
):  # fmt: skip
    CASES[f"load_mesh {_asset.name} {_label}"] = (check_mesh, _asset, _asset.name)
CASES["load_mesh gltf, its buffer"] = (check_mesh, gltf_asset(), "mesh.bin")
for _asset, _label in (
    (xyz_asset(3), "points"), (xyz_asset(6), "normals"), (ply_asset("ascii", False), "ascii"),
    (ply_asset("binary_little_endian", False), "binary"),
):  # fmt: skip
    CASES[f"load_pointcloud {_asset.name} {_label}"] = (check_cloud, _asset, _asset.name)


def outcome(case: str, data: bytes) -> str:
    """ "read" or "refused"; anything else that a reader does is an error here."""
    check, asset, name = CASES[case]
    try:
        with within_limits():
            check(asset.replaced(name, data))
    except MeshFormatError as error:
        if len(str(error)) > LONGEST_MESSAGE:
            raise AssertionError(f"a message of {len(str(error))} characters") from error
        return "refused"
    return "read"


@pytest.mark.parametrize("case", CASES)
def test_the_undamaged_file_is_read(case):
    _, asset, name = CASES[case]
    assert outcome(case, asset.files[name]) == "read"


@pytest.mark.parametrize("case", CASES)
def test_damaged_files(case):
    fuzz(case, QUICK_EXAMPLES)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_many_damaged_files(case):
    counts = fuzz(case, SLOW_EXAMPLES)
    print(f"{case}: {dict(counts)}")
    assert min(counts["read"], counts["refused"]) > SLOW_EXAMPLES // 100, "the damage is too heavy, or too light"


def fuzz(case: str, examples: int) -> Counter[str]:
    """How the reader took so many damaged files, and as many again of random bytes per ten of those."""
    counts: Counter[str] = Counter()
    _, asset, name = CASES[case]
    limits = settings(
        max_examples=examples, deadline=None, suppress_health_check=CALM, derandomize=True, database=None
    )

    @limits
    @given(edits)
    def damage(steps: list) -> None:
        counts[outcome(case, damaged(asset.files[name], steps))] += 1

    @settings(limits, max_examples=max(examples // 10, 1))
    @given(st.binary(max_size=200), st.integers(0, 60))
    def noise(tail: bytes, kept: int) -> None:
        counts[outcome(case, asset.files[name][:kept] + tail)] += 1

    damage()
    noise()
    return counts
