"""Triangles with textures and tints, and the solids that are built of them.

Places: x to the right, y up, z forwards, metres. Letters: F triangles, Q quads.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Color = tuple[float, float, float]

WHITE: Color = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class PaintedFaces:
    """F triangles, seen from both sides."""

    corners: Array  # (F, 3, 3)
    uv: Array  # (F, 3, 2), 1 is a whole texture
    texture: npt.NDArray[np.int64]  # (F,)
    tint: Array  # (F, 3), the colour of what the texture leaves to it
    light_normal: Array  # (F, 3), by which light falls on it; 0 takes the triangle's own

    def __len__(self) -> int:
        return len(self.corners)

    @staticmethod
    def joined(parts: Iterable[PaintedFaces]) -> PaintedFaces:
        """All of them, in this order."""
        some = list(parts)
        names = ("corners", "uv", "texture", "tint", "light_normal")
        return PaintedFaces(*(np.concatenate([getattr(part, name) for part in some]) for name in names))

    def placed(self, at: Sequence[float], turn: float = 0.0, scale: float = 1.0) -> PaintedFaces:
        """Scaled, turned about the vertical (radians, from z to x), and moved so that the origin comes to `at`."""
        c, s = np.cos(turn), np.sin(turn)
        matrix = np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]], np.float32)  # of rows
        moved = scale * (self.corners @ matrix) + np.asarray(at, np.float32)
        return replace(self, corners=moved.astype(np.float32), light_normal=self.light_normal @ matrix)

    def tinted(self, color: Color, where: int | None = None) -> PaintedFaces:
        """With this tint; only the triangles that are plain white so far, or those of one texture."""
        chosen = (self.tint == 1).all(1) if where is None else self.texture == where
        return replace(self, tint=np.where(chosen[:, None], np.asarray(color, np.float32), self.tint))


def triangles(
    corners: npt.ArrayLike, uv: npt.ArrayLike, texture: int, tint: Color = WHITE, light: npt.ArrayLike | None = None
) -> PaintedFaces:
    """Triangles (F, 3, 3) with texture coordinates (F, 3, 2), and directions (F, 3) by which they are lit."""
    places = np.asarray(corners, np.float32).reshape(-1, 3, 3)
    count = len(places)
    return PaintedFaces(
        places,
        np.broadcast_to(np.asarray(uv, np.float32), (count, 3, 2)).copy(),
        np.full(count, texture, np.int64),
        np.tile(np.asarray(tint, np.float32), (count, 1)),
        np.zeros((count, 3), np.float32) if light is None else np.asarray(light, np.float32).reshape(-1, 3),
    )


def quads(corners: npt.ArrayLike, uv: npt.ArrayLike, texture: int, tint: Color = WHITE) -> PaintedFaces:
    """Quads (Q, 4, 3), corners in turn, with texture coordinates (Q, 4, 2) or the same (4, 2) for all."""
    places = np.asarray(corners, np.float32).reshape(-1, 4, 3)
    where = np.broadcast_to(np.asarray(uv, np.float32), (len(places), 4, 2))
    halves = [[0, 1, 2], [0, 2, 3]]
    return triangles(places[:, halves].reshape(-1, 3, 3), where[:, halves].reshape(-1, 3, 2), texture, tint)


def flat(x: tuple[float, float], y: float, z: tuple[float, float], texture: int, tile: tuple[float, float],
         tint: Color = WHITE) -> PaintedFaces:  # fmt: skip
    """A horizontal rectangle; its texture lies still in the world, `tile` metres of x and z to a repetition."""
    corners = [(x[0], y, z[0]), (x[1], y, z[0]), (x[1], y, z[1]), (x[0], y, z[1])]
    return quads([corners], [(a / tile[0], c / tile[1]) for a, _, c in corners], texture, tint)


def wall(start: tuple[float, float], end: tuple[float, float], y: tuple[float, float], texture: int,
         tile: tuple[float, float], tint: Color = WHITE) -> PaintedFaces:  # fmt: skip
    """A vertical rectangle between two places (x, z); u begins at `start`, v at the upper edge, downwards."""
    (x0, z0), (x1, z1) = start, end
    u, v = float(np.hypot(x1 - x0, z1 - z0)) / tile[0], (y[1] - y[0]) / tile[1]
    corners = [(x0, y[1], z0), (x1, y[1], z1), (x1, y[0], z1), (x0, y[0], z0)]
    return quads([corners], [(0, 0), (u, 0), (u, v), (0, v)], texture, tint)


def box(low: Sequence[float], high: Sequence[float], texture: int, tile: float = 1.0, tint: Color = WHITE,
        floor: bool = False) -> PaintedFaces:  # fmt: skip
    """A box between two corners, without its lower side unless asked for."""
    (x0, y0, z0), (x1, y1, z1) = low, high
    around = ((x0, z0, x1, z0), (x1, z0, x1, z1), (x1, z1, x0, z1), (x0, z1, x0, z0))
    corners = [[(a, y1, b), (c, y1, d), (c, y0, d), (a, y0, b)] for a, b, c, d in around]
    corners += [[(x0, y, z0), (x1, y, z0), (x1, y, z1), (x0, y, z1)] for y in ([y0, y1] if floor else [y1])]
    wide, high_up, deep = ((end - start) / tile for start, end in zip(low, high, strict=True))
    uv = [[(0, 0), (across, 0), (across, down), (0, down)]
          for across, down in ((wide, high_up), (deep, high_up)) * 2 + ((wide, deep),) * (1 + floor)]  # fmt: skip
    return quads(corners, uv, texture, tint)


def tube(bottom: npt.ArrayLike, top: npt.ArrayLike, radii: tuple[float, float], texture: int,
         tint: Color = WHITE, sides: int = 6, tile: float = 1.0) -> PaintedFaces:  # fmt: skip
    """A cone's trunk between two places, without its ends."""
    low, high = np.asarray(bottom, np.float32), np.asarray(top, np.float32)
    along = (high - low) / np.linalg.norm(high - low)
    across: Array = np.cross(along, (0, 0, 1) if abs(along[2]) < 0.9 else (1, 0, 0))
    across = across / np.linalg.norm(across)
    other = np.cross(along, across)
    angle = 2 * np.pi * np.arange(sides + 1)[:, None] / sides
    ring = np.cos(angle) * across + np.sin(angle) * other
    lower, upper = low + radii[0] * ring, high + radii[1] * ring
    corners = np.stack([upper[:-1], upper[1:], lower[1:], lower[:-1]], 1)
    u = np.arange(sides + 1) / sides
    v = float(np.linalg.norm(high - low)) / tile
    ones = np.ones(sides)
    uv = np.stack(
        [
            np.stack(pair, -1)
            for pair in ((u[:-1], 0 * ones), (u[1:], 0 * ones), (u[1:], v * ones), (u[:-1], v * ones))
        ],
        1,
    )
    return quads(corners, uv, texture, tint)


def box_mapped(corners: Array, texture: int, tile: float, tint: Color = WHITE, light: Array | None = None
               ) -> PaintedFaces:  # fmt: skip
    """Triangles whose texture is laid on from the axis that they face most."""
    normal = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    axis = normal.argmax(1)
    first, second = np.array([2, 0, 0])[axis], np.array([1, 2, 1])[axis]
    rows = np.arange(len(corners))[:, None]
    columns = np.arange(3)[None]
    uv = np.stack([corners[rows, columns, first[:, None]], -corners[rows, columns, second[:, None]]], -1) / tile
    return triangles(corners, uv, texture, tint, light)
