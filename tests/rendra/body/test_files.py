"""Body models in files: written and read again, and what is wrong with a file is said."""

import dataclasses
import io
import pickle
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch
from bodies import parts

from rendra.body import SMPL, BodyFormatError, BodyParts, read_free_parts, read_parts, write_parts
from rendra.body.files import SMPL_HEAD_TOP


def _arrays(made: BodyParts, root: int = 2**32 - 1) -> dict[str, Any]:
    """The layout of SMPL's files."""
    count = len(made.parents)
    return {
        "v_template": made.v_template.numpy(),
        "shapedirs": made.shapedirs.numpy(),
        "J_regressor": made.J_regressor.numpy(),
        "weights": made.weights.numpy(),
        "kintree_table": np.array([[root, *made.parents[1:]], range(count)], np.int64),
        "f": made.faces.numpy().astype(np.uint32),
        **({} if made.posedirs is None else {"posedirs": made.posedirs.numpy()}),
    }


def _npz(path: Path, **arrays: Any) -> Path:
    np.savez_compressed(path, **arrays)
    return path


def _assert_same(got: BodyParts, expected: BodyParts) -> None:
    for field in dataclasses.fields(BodyParts):
        mine, other = getattr(got, field.name), getattr(expected, field.name)
        if isinstance(other, torch.Tensor):
            torch.testing.assert_close(mine, other.to(mine.dtype), rtol=0, atol=1e-6)
        elif field.name in ("parents", "joint_names"):
            assert mine == other


@pytest.mark.parametrize("pose_blends", [True, False])
def test_round_trip(tmp_path: Path, pose_blends: bool) -> None:
    made = parts(pose_blends=pose_blends)
    for each in (made, dataclasses.replace(made, J_regressor=made.J_regressor.to_sparse())):
        write_parts(tmp_path / "body.npz", each)
        _assert_same(read_parts(tmp_path / "body.npz"), made)
    betas, pose = torch.randn(2, 10), torch.randn(2, 24, 3)
    torch.testing.assert_close(SMPL.load(tmp_path / "body.npz")(betas, pose).verts, SMPL(made)(betas, pose).verts)


@pytest.mark.parametrize("root", [2**32 - 1, -1, 2**64 - 1])
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_how_files_say_root(tmp_path: Path, root: int, suffix: str) -> None:
    made = parts()
    arrays = _arrays(made, -1)
    if root > 0:
        arrays["kintree_table"] = arrays["kintree_table"].astype(np.uint32 if root < 2**33 else np.uint64)
    path = tmp_path / f"body{suffix}"
    path.write_bytes(pickle.dumps(arrays, 2)) if suffix == ".pkl" else _npz(path, **arrays)
    _assert_same(read_parts(path), made)


def test_joints_named_by_other_numbers(tmp_path: Path) -> None:
    made = parts(joints=6)
    table = np.array([[-1, *[10 * parent for parent in made.parents[1:]]], [10 * joint for joint in range(6)]])
    _assert_same(read_parts(_npz(tmp_path / "body.npz", **{**_arrays(made), "kintree_table": table})), made)


@pytest.mark.parametrize(
    ("joints", "directions", "betas"),
    [(24, 10, 10), (24, 300, 300), (52, 16, 16), (55, 400, 300), (55, 20, 10), (16, 10, 10)],
)
def test_the_family(tmp_path: Path, joints: int, directions: int, betas: int) -> None:
    """SMPL, SMPL-H, SMPL-X and MANO, with keys that they have beside."""
    made = parts(20, joints, directions)
    others = {
        "hands_componentsl": np.eye(45),
        "dynamic_lmk": np.zeros((2, 3)),
        "joint2num": np.array({"a": 1}, object),
    }
    regressor = np.concatenate([made.J_regressor.numpy(), np.ones((3, 20))])  # of more than the skeleton's joints
    path = _npz(tmp_path / "body.npz", **{**_arrays(made), **others, "J_regressor": regressor})
    body = SMPL.load(path)
    assert (body.num_joints, body.num_betas) == (joints, betas)
    assert body.posedirs is not None
    assert body.posedirs.shape == (20, 3, 9 * (joints - 1))
    pickled = tmp_path / "body.pkl"
    content = {**_arrays(made), "hands_componentsl": np.eye(45), "joint2num": {"a": 1}, "part": None}
    pickled.write_bytes(pickle.dumps({**content, "J_regressor": scipy.sparse.csc_matrix(regressor)}, 2))
    pose = torch.randn(1, joints, 3)
    torch.testing.assert_close(SMPL.load(pickled)(None, pose).verts, body(None, pose).verts)
    assert SMPL.load(path, num_betas=4).num_betas == 4
    with pytest.raises(BodyFormatError, match=f"it has {betas} betas, and {betas + 1} were asked for"):
        read_parts(path, betas + 1)


def test_the_head_of_smpl(tmp_path: Path) -> None:
    made = parts(6890, 24, 2, pose_blends=False)
    assert read_parts(_npz(tmp_path / "body.npz", **_arrays(made))).head_top == SMPL_HEAD_TOP


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("weights", None, "it lacks weights; it has J_regressor, f, kintree_table"),
        ("v_template", np.full((30, 3), np.nan), "v_template holds numbers that are not finite"),
        ("v_template", np.full((30, 3), 1e300), "v_template holds numbers that are not finite"),
        ("v_template", np.zeros((0, 3)), "has vertices and joints, got 0 and 24"),
        ("weights", np.ones((30, 25)) / 25, r"weights must be \(30, 24\)"),
        ("shapedirs", np.zeros((30, 3)), r"shapedirs must be \(V, 3, N\), got \(30, 3\)"),
        ("shapedirs", np.full((30, 3, 2), "a"), "shapedirs is an array of <U1, where numbers"),
        ("shapedirs", np.zeros((30, 3, 2), complex), "c16|complex128, where numbers"),
        ("posedirs", np.zeros((30, 3, 206)), r"posedirs must be \(30, 3, 207\)"),
        ("J_regressor", np.zeros((23, 30)), r"J_regressor must be \(24, 30\)"),
        ("kintree_table", np.zeros((3, 24), int), r"kintree_table must be \(2, J\), got \(3, 24\)"),
        ("kintree_table", np.zeros((2, 24), int), "names a joint twice"),
        ("kintree_table", np.stack([np.zeros(24, int), np.arange(24)]), "must begin with the root"),
        ("kintree_table", np.stack([np.full(24, -1), np.arange(24)]), "names a parent that is no joint: -1"),
        ("kintree_table", np.stack([np.r_[-1, 2:25], np.arange(24)]), "parent that is no joint: 24"),
        ("kintree_table", np.stack([np.r_[-1, 2, 0:22], np.arange(24)]), "parent of joint 1 must be one of"),
        ("kintree_table", np.full((2, 24), np.nan), "kintree_table holds numbers that are not whole"),
        ("f", np.full((4, 3), 0.5), "f holds numbers that are not whole"),
        ("f", np.full((4, 3), 2**31), "faces must name vertices 0 to 29"),
        ("f", np.zeros((4, 4), int), r"faces must be \(any, 3\)"),
    ],
)  # fmt: skip
def test_files_that_hold_no_body(tmp_path: Path, key: str, value: Any, words: str) -> None:
    arrays = _arrays(parts())
    arrays[key] = value
    arrays = {name: array for name, array in arrays.items() if array is not None}
    _npz(tmp_path / "body.npz", **arrays)
    (tmp_path / "body.pkl").write_bytes(pickle.dumps(arrays, 2))
    for path in (tmp_path / "body.npz", tmp_path / "body.pkl"):
        with pytest.raises(BodyFormatError, match=words) as error:
            read_parts(path)
        assert str(error.value).startswith(str(path))
        assert "\n" not in str(error.value)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no body model .*missing\.npz"):
        read_parts(tmp_path / "missing.npz")
    with pytest.raises(FileNotFoundError, match="it is a folder"):
        read_parts(tmp_path)
    whole = _npz(tmp_path / "whole.npz", **_arrays(parts())).read_bytes()
    for name, content, words in (
        ("empty.npz", b"", "it is empty"),
        ("empty.pkl", b"", "it is empty"),
        ("noise.npz", b"noise" * 99, "no .npz, or damaged"),
        ("cut.npz", whole[: len(whole) // 2], "no .npz, or damaged"),
        ("noise.pkl", b"noise" * 99, "no pickle, or cut off"),
        ("list.pkl", pickle.dumps([1]), "it holds a list, not the arrays"),
        ("os.pkl", b"cos\nsystem\n.", r"was not read: it names os.system"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(BodyFormatError, match=words):
            read_parts(tmp_path / name)
    (tmp_path / "npz_by_another_name.dat").write_bytes(whole)
    read_parts(tmp_path / "npz_by_another_name.dat")


def test_damaged_bytes(tmp_path: Path) -> None:
    whole = bytearray(_npz(tmp_path / "whole.npz", **_arrays(parts(8, 3, 2))).read_bytes())
    rng = np.random.default_rng(0)
    for _ in range(60):
        noisy = bytearray(whole)
        for place in rng.integers(0, len(noisy), 3):
            noisy[place] = rng.integers(256)
        (tmp_path / "noisy.npz").write_bytes(noisy)
        try:
            read_parts(tmp_path / "noisy.npz")
        except BodyFormatError as error:
            assert "\n" not in str(error)  # noqa: PT017 - some noise does no harm


def test_objects_in_an_npz_are_not_unpickled(tmp_path: Path) -> None:
    arrays = {**_arrays(parts()), "weights": np.array([None, {}], object)}
    with pytest.raises(BodyFormatError, match=r"weights.npy is an array of objects"):
        read_parts(_npz(tmp_path / "body.npz", **arrays))


def _header(shape: tuple[int, ...]) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": shape})
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (_header((10**12,)) + bytes(80), "claims 8,000,000,000,000 bytes of numbers and has 80"),
        (_header((10**7, 10)) + bytes(10**8), "claims 100,000,1.. bytes in .*no body model packs 100 times"),
        (_header((2,)) + bytes(80), "claims 16 bytes of numbers and has 80"),
        (_header((-2, -5)) + bytes(80), "body.npz: "),
        (b"\x93NUMPY\x09\x00", "version"),
    ],
)
def test_bombs(tmp_path: Path, content: bytes, words: str) -> None:
    path = _npz(tmp_path / "body.npz", **{k: v for k, v in _arrays(parts()).items() if k != "shapedirs"})
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("shapedirs.npy", content)
    tracemalloc.start()
    try:
        with pytest.raises(BodyFormatError, match=words):
            read_parts(path)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_too_many_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rendra.body.files._MOST_BYTES", 1000)
    with pytest.raises(BodyFormatError, match="bytes of arrays; at most 1,000 are read"):
        read_parts(_npz(tmp_path / "body.npz", **_arrays(parts())))


def test_the_free_body_in_smpls_layout(tmp_path: Path) -> None:
    """Others can read what we ship."""
    made = read_free_parts(low=True)
    write_parts(tmp_path / "free.npz", made)
    body, again = SMPL(made), SMPL.load(tmp_path / "free.npz")
    betas, pose = torch.randn(2, 10), 0.3 * torch.randn(2, 24, 3)
    torch.testing.assert_close(again(betas, pose).verts, body(betas, pose).verts)
    with np.load(tmp_path / "free.npz") as content:
        assert content["kintree_table"][0, 0] == 2**32 - 1
