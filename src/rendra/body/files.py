"""Body models in files: SMPL's layout of arrays, read and written, and the built-in free body."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rendra.body.restricted_pickle import PickleRefused, numbers, read_pickle
from rendra.body.skinning import check_parents
from rendra.body.smpl import BodyParts, check_parts

_MOST_BYTES = 2**30  # of the arrays that are read; SMPL-X's have 0.3 GB
_MOST_EXPANSION = 100  # of a packed array beyond _SMALL_BYTES: real numbers pack by two, zeros by a thousand
_SMALL_BYTES = 2**26
_MOST_HEADER = 10_000  # bytes, of an array in an .npz
_SHAPES_OF = {400: 300}  # directions of a file: how many of them are shapes; the rest are expressions
_SHAPES_OF_SMPLX = {**_SHAPES_OF, 20: 10}
_SMPLX_JOINTS = 55
_NEEDED = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
_READ = (*_NEEDED, "posedirs")
_ROOT = 2**32 - 1  # how SMPL's files say that a joint has no parent
SMPL_HEAD_TOP = 411
"""SMPL's vertex at the top of the head (Bogo et al., "Keep it SMPL", 2016)."""
_SMPL_VERTS = 6890


class BodyFormatError(ValueError):
    """A file that holds no body model; says which file, and what is wrong with it."""


def read_parts(path: str | Path, num_betas: int | None = None) -> BodyParts:
    """The parts of a body model in SMPL's layout: `.npz`, or the authors' `.pkl` of Python 2 with chumpy arrays.

    Read are v_template, shapedirs, J_regressor, weights, kintree_table, f, and posedirs where there are any; of 400
    shape directions (and of the 20 of small SMPL-X files) the first 300 (10) are shapes, the rest expressions, which
    are left out. Rows of J_regressor beyond the joints are left out too.

    Args:
        path: of the file.
        num_betas: take the first ones; None takes all.

    Raises:
        FileNotFoundError: no such file.
        BodyFormatError: a missing key, arrays that do not fit each other, numbers that are not finite, or a pickle
            that names anything but arrays.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no body model {path}{' (it is a folder)' if path.is_dir() else ''}")
    try:
        arrays = _read_arrays(path)
        missing = [key for key in _NEEDED if key not in arrays]
        if missing:
            there = ", ".join(sorted(map(str, arrays))) or "nothing"
            raise ValueError(f"it lacks {', '.join(missing)}; it has {there if len(there) < 400 else 'other keys'}")
        parts = _parts(arrays, num_betas)
        check_parts(parts)
    except PickleRefused as error:
        raise BodyFormatError(str(error)) from None
    except (ValueError, TypeError, IndexError, OSError, EOFError, OverflowError, MemoryError) as error:
        words = str(error)
        raise BodyFormatError(words if words.startswith(str(path)) else f"{path}: {words}") from error
    return parts


def write_parts(path: str | Path, parts: BodyParts) -> None:
    """Writes a body model as `.npz` in SMPL's layout, which `read_parts` and the programs of others read."""
    arrays = {
        "v_template": parts.v_template,
        "shapedirs": parts.shapedirs,
        "J_regressor": parts.J_regressor.to_dense() if parts.J_regressor.is_sparse else parts.J_regressor,
        "weights": parts.weights,
        "f": parts.faces.to(torch.int64),
    }
    if parts.posedirs is not None:
        arrays["posedirs"] = parts.posedirs
    numbers = {name: value.detach().cpu().numpy() for name, value in arrays.items()}
    parents = np.array([_ROOT, *parts.parents[1:]], np.int64)
    numbers["kintree_table"] = np.stack([parents, np.arange(len(parents))])
    with Path(path).open("wb") as file:
        np.savez_compressed(file, **numbers)  # type: ignore[arg-type]


def read_free_parts(low: bool = False) -> BodyParts:
    """The parts of the built-in body; see `SMPL.free`. Baked by tools/free_body; see NOTICE.md beside it."""
    with (files("rendra.body") / "data" / ("free_low.npz" if low else "free.npz")).open("rb") as file:
        baked = dict(np.load(file, allow_pickle=False))
    template = torch.from_numpy(baked["v_template"] * baked["v_template_scale"])
    num_verts, num_joints = len(template), len(baked["parents"])
    weights = torch.zeros(num_verts, num_joints)
    weights.scatter_(
        1, torch.from_numpy(baked["weights_joint"].astype(np.int64)), torch.from_numpy(baked["weights"]).float()
    )
    regressor = torch.zeros(num_joints, num_verts)
    regressor.scatter_(
        1, torch.from_numpy(baked["J_regressor_vertex"].astype(np.int64)), torch.from_numpy(baked["J_regressor"])
    )
    return BodyParts(
        v_template=template,
        shapedirs=torch.from_numpy(baked["shapedirs"] * baked["shapedirs_scale"]),
        faces=torch.from_numpy(baked["f"].astype(np.int64)),
        J_regressor=regressor,
        weights=weights / weights.sum(1, keepdim=True),
        parents=tuple(baked["parents"].tolist()),
        joint_names=tuple(map(str, baked["joint_names"])),
    )


def _read_arrays(path: Path) -> Mapping[str, Any]:
    with path.open("rb") as file:
        magic = file.read(4)
    if not magic:
        raise ValueError("it is empty")
    if magic == b"PK\x03\x04" or path.suffix.lower() == ".npz":
        return _read_npz(path)
    content = read_pickle(path)
    if not isinstance(content, Mapping):
        raise ValueError(f"it holds a {type(content).__name__}, not the arrays of a body model")
    return content


def _read_npz(path: Path) -> dict[str, np.ndarray | None]:
    """The arrays that are read, and None for the other names."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            _check_sizes([members[key] for key in _READ if key in members])
            return {key: _read_array(archive, info) if key in _READ else None for key, info in members.items()}
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, SyntaxError) as error:
        raise ValueError(f"it is no .npz, or damaged: {error}") from error


def _check_sizes(members: list[zipfile.ZipInfo]) -> None:
    """Before anything is unpacked; `zipfile` then gives no more than a member claims."""
    claimed = sum(member.file_size for member in members)
    if claimed > _MOST_BYTES:
        raise ValueError(f"it claims {claimed:,} bytes of arrays; at most {_MOST_BYTES:,} are read")
    for member in members:
        if member.file_size > max(_SMALL_BYTES, _MOST_EXPANSION * member.compress_size):
            raise ValueError(
                f"{member.filename} claims {member.file_size:,} bytes in {member.compress_size:,}; "
                f"no body model packs {_MOST_EXPANSION} times"
            )


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """An array of the `.npy` format, whose header is believed only if it claims what the member holds."""
    name = member.filename
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"{name} is an array of version {version}")
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, by_column, dtype = read(file, max_header_size=_MOST_HEADER)
        if dtype.hasobject:
            raise ValueError(f"{name} is an array of objects, where numbers are expected")
        claimed, held = math.prod(shape) * dtype.itemsize, member.file_size - file.tell()
        if claimed != held:
            raise ValueError(f"{name} claims {claimed:,} bytes of numbers and has {held:,}")
        content = file.read(claimed)
    if len(content) != claimed:
        raise ValueError(f"{name} is cut off")
    if not claimed:
        return np.empty(shape, dtype)
    return np.frombuffer(content, dtype).reshape(shape, order="F" if by_column else "C")


def _parts(arrays: Mapping[str, Any], num_betas: int | None) -> BodyParts:
    parents = _parents(_whole("kintree_table", arrays))
    template = _floats("v_template", arrays)
    shapedirs = _floats("shapedirs", arrays)
    if shapedirs.ndim != 3:
        raise ValueError(f"shapedirs must be (V, 3, N), got {tuple(shapedirs.shape)}")
    shapes = _SHAPES_OF_SMPLX if len(parents) == _SMPLX_JOINTS else _SHAPES_OF
    available = shapes.get(shapedirs.shape[2], shapedirs.shape[2])
    if num_betas is not None and not 1 <= num_betas <= available:
        raise ValueError(f"it has {available} betas, and {num_betas} were asked for")
    return BodyParts(
        v_template=template,
        shapedirs=shapedirs[..., : available if num_betas is None else num_betas],
        faces=torch.from_numpy(_whole("f", arrays)),
        J_regressor=_floats("J_regressor", arrays)[: len(parents)],
        weights=_floats("weights", arrays),
        parents=parents,
        posedirs=_floats("posedirs", arrays) if "posedirs" in arrays else None,
        head_top=SMPL_HEAD_TOP if len(template) == _SMPL_VERTS else None,
    )


def _parents(table: np.ndarray) -> tuple[int, ...]:
    """Of a table (2, J) of each joint's parent and own number; the first joint's parent says that it has none."""
    if table.ndim != 2 or len(table) != 2 or not table.shape[1]:
        raise ValueError(f"kintree_table must be (2, J), got {table.shape}")
    above, own = table.tolist()
    places = {number: place for place, number in enumerate(own)}
    if len(places) != len(own):
        raise ValueError("kintree_table names a joint twice")
    if above[0] in places:
        raise ValueError(f"kintree_table must begin with the root, and its first joint has the parent {above[0]}")
    if unknown := [number for number in above[1:] if number not in places]:
        raise ValueError(f"kintree_table names a parent that is no joint: {unknown[0]}")
    return check_parents([-1, *(places[number] for number in above[1:])])


def _whole(name: str, arrays: Mapping[str, Any]) -> np.ndarray:
    """Whole numbers, int64."""
    array = _numbers(name, arrays)
    if array.dtype.kind == "f" and not (np.isfinite(array).all() and (array == np.round(array)).all()):
        raise ValueError(f"{name} holds numbers that are not whole")
    return np.array(array, np.int64, order="C")


def _floats(name: str, arrays: Mapping[str, Any]) -> Tensor:
    array = _numbers(name, arrays)
    with np.errstate(over="ignore"):  # numbers too large become infinite, and are refused with those that were
        single = np.array(array, np.float32, order="C")
    return torch.from_numpy(single)


def _numbers(name: str, arrays: Mapping[str, Any]) -> np.ndarray:
    try:
        return numbers(arrays[name])
    except ValueError as error:
        raise ValueError(f"{name} is {error}") from error
