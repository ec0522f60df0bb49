"""Body models in files: SMPL's layout of arrays, read and written, and the built-in free body."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rendra.body.restricted_pickle import PickleRefused, SparseMatrix, read_pickle
from rendra.body.skinning import check_parents
from rendra.body.smpl import BodyParts

_MOST_BYTES = 2**31  # of all arrays of a file
_NEEDED = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
_ROOT = 2**32 - 1  # how SMPL's files say that a joint has no parent
SMPL_HEAD_TOP = 411
"""SMPL's vertex at the top of the head (Bogo et al., "Keep it SMPL", 2016)."""
_SMPL_VERTS = 6890


class BodyFormatError(ValueError):
    """A file that holds no body model; says which file, and what is wrong with it."""


def read_parts(path: str | Path, num_betas: int | None = None) -> BodyParts:
    """The parts of a body model in SMPL's layout: `.npz`, or the authors' `.pkl` of Python 2 with chumpy arrays.

    Read are v_template, shapedirs, J_regressor, weights, kintree_table, f, and posedirs where there are any; of
    SMPL-X's 400 shape directions the first 300 are shapes, and the rest are expressions.

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
    arrays = _read_arrays(path)
    missing = [key for key in _NEEDED if key not in arrays]
    if missing:
        raise BodyFormatError(f"{path} lacks {', '.join(missing)}; it has {', '.join(sorted(map(str, arrays)))}")
    try:
        return _parts(arrays, num_betas)
    except (ValueError, TypeError, IndexError) as error:
        raise BodyFormatError(f"{path}: {error}") from error


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
    if path.suffix != ".npz":
        try:
            content = read_pickle(path)
        except PickleRefused as error:
            raise BodyFormatError(str(error)) from error
        except ValueError as error:
            raise BodyFormatError(str(error)) from error
        if not isinstance(content, Mapping):
            raise BodyFormatError(f"{path} holds a {type(content).__name__}, not the arrays of a body model")
        return content
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > _MOST_BYTES:
            raise BodyFormatError(f"{path} claims {size:,} bytes of arrays; at most {_MOST_BYTES:,} are read")
        with np.load(path, allow_pickle=False) as content:
            return {name: content[name] for name in content.files if name in (*_NEEDED, "posedirs")}
    except (zipfile.BadZipFile, OSError, ValueError, EOFError) as error:
        if isinstance(error, BodyFormatError):
            raise
        raise BodyFormatError(f"{path} cannot be read: {error}") from error


def _parts(arrays: Mapping[str, Any], num_betas: int | None) -> BodyParts:
    template = _floats(arrays["v_template"])
    shapedirs = _floats(arrays["shapedirs"])
    if shapedirs.ndim != 3:
        raise ValueError(f"shapedirs must be (V, 3, N), got {tuple(shapedirs.shape)}")
    available = 300 if shapedirs.shape[2] == 400 else shapedirs.shape[2]
    if num_betas is not None and not 1 <= num_betas <= available:
        raise ValueError(f"it has {available} betas, and {num_betas} were asked for")
    table = np.asarray(arrays["kintree_table"]).astype(np.int64)
    if table.ndim != 2 or len(table) != 2:
        raise ValueError(f"kintree_table must be (2, J), got {table.shape}")
    parents = check_parents([-1, *table[0, 1:].tolist()])
    posedirs = _floats(arrays["posedirs"]) if "posedirs" in arrays else None
    return BodyParts(
        v_template=template,
        shapedirs=shapedirs[..., : available if num_betas is None else num_betas],
        faces=torch.from_numpy(np.asarray(arrays["f"]).astype(np.int64)),
        J_regressor=_floats(arrays["J_regressor"])[: len(parents)],
        weights=_floats(arrays["weights"]),
        parents=parents,
        posedirs=posedirs,
        head_top=SMPL_HEAD_TOP if len(template) == _SMPL_VERTS else None,
    )


def _floats(value: Any) -> Tensor:
    array = value.to_dense() if isinstance(value, SparseMatrix) else np.asarray(value)
    if array.dtype == object:
        raise ValueError("an array of objects, where numbers are expected")
    return torch.from_numpy(np.ascontiguousarray(array, np.float32))
