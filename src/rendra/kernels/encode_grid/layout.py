"""How the levels of a multi-resolution grid grow, and where they lie in one table. Plain numbers."""

import math
from collections.abc import Sequence
from functools import lru_cache

__all__ = ["grid_offsets", "grid_resolutions"]

_MOST_CELLS = 2**20  # along an axis: float32 then leaves three bits for the place inside a cell
_MOST_NUMBERS = 2**32  # of a table: kernels count them with 32 bits


def grid_resolutions(coarsest: int, finest: int, levels: int) -> tuple[int, ...]:
    """Cells along an axis of each level: N_l = floor(N_min b^l), b = (N_max / N_min)^(1 / (L - 1)).

    Mueller et al., "Instant neural graphics primitives", SIGGRAPH 2022, Eq. 2 and 3. One level has `coarsest` cells.

    Raises:
        ValueError: no level, or coarsest and finest not in 1 <= coarsest <= finest <= 2^20.
    """
    if levels < 1:
        raise ValueError(f"a grid needs at least one level, got levels={levels}")
    if not 1 <= coarsest <= finest <= _MOST_CELLS:
        raise ValueError(f"expected 1 <= coarsest <= finest <= {_MOST_CELLS}, got {coarsest} and {finest}")
    growth = math.log(finest / coarsest) / max(1, levels - 1)
    # the finest level is N_max itself, not one less by rounding
    return tuple(math.floor(coarsest * math.exp(level * growth) * (1 + 1e-12)) for level in range(levels))


def grid_offsets(resolutions: Sequence[int], log2_table_size: int | None = None) -> tuple[int, ...]:
    """First row of each level in a common table, and the number of all rows: L + 1 numbers.

    A level has a row for each of its (N + 1)^3 vertices, but never more than 2^log2_table_size; None: all are dense.

    Raises:
        ValueError: a resolution or table size that cannot be.
    """
    if log2_table_size is not None and not 0 <= log2_table_size <= 30:
        raise ValueError(f"log2_table_size must be in 0..30, got {log2_table_size}")
    offsets = [0]
    for resolution in resolutions:
        if not 1 <= resolution <= _MOST_CELLS:
            raise ValueError(f"resolutions must be in 1..{_MOST_CELLS} cells, got {tuple(resolutions)}")
        vertices = (resolution + 1) ** 3
        offsets.append(offsets[-1] + (vertices if log2_table_size is None else min(vertices, 2**log2_table_size)))
    return tuple(offsets)


@lru_cache(maxsize=256)
def check_layout(resolutions: tuple[int, ...], offsets: tuple[int, ...], rows: int, features: int) -> None:
    """Refuse levels that do not fill a table of (rows, features).

    Raises:
        ValueError: naming the level, what it was and what was expected.
    """
    if not resolutions or len(offsets) != len(resolutions) + 1:
        raise ValueError(
            f"offsets must hold one number more than the {len(resolutions)} resolutions (at least one), "
            f"got {len(offsets)}"
        )
    if offsets[0] != 0 or offsets[-1] != rows:
        raise ValueError(f"offsets must run from 0 to the table's {rows} rows, got {offsets}")
    if rows * features >= _MOST_NUMBERS:
        raise ValueError(f"a table holds fewer than 2^32 numbers, got {rows} x {features}")
    for level, resolution in enumerate(resolutions):
        if not 1 <= resolution <= _MOST_CELLS:
            raise ValueError(f"resolutions must be in 1..{_MOST_CELLS} cells, got {resolution} at level {level}")
        size = offsets[level + 1] - offsets[level]
        if size < 1 or (size < (resolution + 1) ** 3 and size & (size - 1)):
            raise ValueError(
                f"level {level} has {size} rows: expected all {(resolution + 1) ** 3} vertices of its {resolution} "
                "cells an axis, or a power of two to hash them into"
            )
