"""XYZ point clouds: one point a line, as text.

Columns are `x y z`, with `nx ny nz` for a normal, `r g b` for a colour, or both in that order behind. A comment of
the kind `# x y z r g b` above the points says which; without one, nine columns are all three, and of six the last
three are normals if each has length 1 to within 1 % and some number is negative, else colours. Colours whose largest
number exceeds 1 are out of 255. Letters: P points.
"""

import re
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.io._bulk_text import Block, Lines
from rendra.io._rows import check_decimals, float_rows, format_rows
from rendra.io._source import FileLike, PathManager, Source, read_source, write_sink
from rendra.io.pluggable_formats import PointcloudFormatInterpreter, endswith, single_cloud
from rendra.structures import Pointclouds

_POINT, _NORMAL, _COLOR = ("x", "y", "z"), ("nx", "ny", "nz"), ("r", "g", "b")
_LAYOUTS = (_POINT, (*_POINT, *_NORMAL), (*_POINT, *_COLOR), (*_POINT, *_NORMAL, *_COLOR))
_KNOWN = " or ".join(f"'{' '.join(layout)}'" for layout in _LAYOUTS)


def parse_xyz(source: Source, columns: Sequence[str] | None = None) -> dict[str, np.ndarray]:
    """Read the bytes of an XYZ file.

    Args:
        source: the file.
        columns: names of the columns, such as ("x", "y", "z", "nx", "ny", "nz"); None to find out.

    Returns:
        Under "points", and where there are any under "normals" and "colors", (P, 3) float32.

    Raises:
        MeshFormatError: a line with another number of columns than the first, something that is no number, or a
            number that is not finite in single precision.
        ValueError: `columns` are none that are known.
    """
    if columns is not None and tuple(columns) not in _LAYOUTS:
        raise ValueError(f"columns is {' '.join(columns)!r}; expected {_KNOWN}")
    lines = Lines(source.name, source.data, continued=False)
    first = lines.chars[lines.firsts]
    block = lines.block(np.flatnonzero((first > 32) & (first != ord("#"))))
    table = _table(block)
    layout = _layout(lines, block, table, columns)
    if len(layout) != table.shape[1] and len(table):
        block.fail(0, f"{table.shape[1]} columns", f"{len(layout)}: {' '.join(layout)}")
    return _split(table, layout)


def _table(block: Block) -> np.ndarray:
    """(P, columns) float32; (0, 3) where the file is empty."""
    if not len(block.counts):
        return np.zeros((0, 3), dtype=np.float32)
    width = int(block.counts[0])
    if width not in (3, 6, 9):
        block.fail(0, f"{width} columns", "3, 6 or 9")
    other = block.counts != width
    if other.any():
        row = int(other.argmax())
        block.fail(row, f"{block.counts[row]} columns, where the lines above have {width}", f"{width} numbers")
    values = block.floats()
    with np.errstate(over="ignore"):
        single = values.astype(np.float32)
    if not np.isfinite(single).all():
        block.fail_token(int((~np.isfinite(single)).argmax()), "a number that is not finite in single precision")
    return single.reshape(-1, width)


def _layout(lines: Lines, block: Block, table: np.ndarray, columns: Sequence[str] | None) -> tuple[str, ...]:
    """The names of the columns."""
    if columns is not None:
        return tuple(columns)
    end = int(lines.starts[block.rows[0]]) if len(block.rows) else len(lines.data)
    for comment in re.findall(rb"^[ \t]*#[ \t]*(x[ \t]+y[ \t]+z\b[^\r\n]*)", lines.data[:end], re.MULTILINE):
        named = tuple(comment.decode("latin-1").split())
        if named in _LAYOUTS:
            return named
    return _guess(table)


def _guess(table: np.ndarray) -> tuple[str, ...]:
    """The names of columns that nobody names."""
    if table.shape[1] != 6:
        return _LAYOUTS[0] if table.shape[1] == 3 else _LAYOUTS[3]
    behind = table[:, 3:]
    unit = (np.abs(np.linalg.norm(behind, axis=1) - 1.0) <= 0.01).all()
    return _LAYOUTS[1] if unit and (behind < 0.0).any() else _LAYOUTS[2]


def _split(table: np.ndarray, layout: tuple[str, ...]) -> dict[str, np.ndarray]:
    parts = {"points": np.ascontiguousarray(table[:, :3])}
    if "nx" in layout:
        parts["normals"] = np.ascontiguousarray(table[:, 3:6]) if len(table) else table
    if "r" in layout:
        colors = np.ascontiguousarray(table[:, -3:])
        parts["colors"] = colors / np.float32(255.0) if len(colors) and colors.max() > 1.0 else colors
    return parts


class PointcloudXyzFormat(PointcloudFormatInterpreter):
    """XYZ files for `IO`; see the module for their columns."""

    def __init__(self) -> None:
        self.known_suffixes = (".xyz",)

    def read(
        self,
        path: FileLike,
        device: Device,
        path_manager: PathManager | None,
        columns: Sequence[str] | None = None,
        **kwargs: Any,
    ) -> Pointclouds | None:
        """Read a cloud, its normals, and its colours as features; None for any other suffix.

        Args:
            path: whose suffix chooses this format.
            device: where the tensors go.
            path_manager: interprets paths where given.
            columns: see `parse_xyz`.
            kwargs: ignored.

        Raises:
            MeshFormatError: the file is malformed.
            OSError: the path cannot be opened.
        """
        if not endswith(path, self.known_suffixes):
            return None
        parts = parse_xyz(read_source(path, path_manager), columns)
        held = {name: [torch.from_numpy(part).to(device)] for name, part in parts.items()}
        return Pointclouds(held["points"], normals=held.get("normals"), features=held.get("colors"))

    def save(
        self,
        data: Pointclouds,
        path: FileLike,
        path_manager: PathManager | None,
        binary: bool | None,
        decimal_places: int | None = None,
        **kwargs: Any,
    ) -> bool:
        """Write one cloud, its normals, and its features if they are three, as colours.

        Args:
            data, path, path_manager: see the base class.
            binary: must not be True.
            decimal_places: digits behind the point; None for as many as single precision needs to come back exactly.
            kwargs: ignored.

        Raises:
            ValueError: `binary` is True, the batch has not exactly one cloud, a number is not finite, or a colour
                lies outside of [0, 1].
            OSError: the file cannot be written; what stood there before is untouched.
        """
        if not endswith(path, self.known_suffixes):
            return False
        if binary:
            raise ValueError("XYZ is a text format: binary must be False or None")
        check_decimals(decimal_places)
        write_sink(path, _render(single_cloud(data), decimal_places), path_manager)
        return True


def _render(cloud: Pointclouds, decimal_places: int | None) -> bytes:
    """The whole file, with a comment that names the columns where they could be mistaken."""
    tables = [float_rows(cloud.points_list()[0], 3, "points", "num_points")]
    names: tuple[str, ...] = _POINT
    normals, features = cloud.normals_list(), cloud.features_list()
    if normals is not None:
        tables.append(float_rows(normals[0], 3, "normals", "num_points"))
        names += _NORMAL
    if features is not None and features[0].shape[-1] == 3:
        tables.append(_demand_colors(features[0]))
        names += _COLOR
    elif features is not None:
        warnings.warn(f"XYZ files hold RGB colours, not {features[0].shape[-1]} features; not saved", stacklevel=5)
    rows = np.concatenate(tables, axis=1)
    plain = len(rows) > 0 and _guess(rows) == names and (decimal_places is None or "nx" not in names)
    head = b"" if plain or len(names) == 3 else f"# {' '.join(names)}\n".encode()
    number = "%.9g" if decimal_places is None else f"%.{decimal_places}f"
    return head + format_rows(" ".join([number] * len(names)) + "\n", rows)


def _demand_colors(features: Tensor) -> np.ndarray:
    rows = float_rows(features, 3, "features", "num_points")
    if ((rows < 0.0) | (rows > 1.0)).any():
        raise ValueError(f"XYZ colours lie in [0, 1]; 'features' has {rows.min():g} to {rows.max():g}")
    return rows
