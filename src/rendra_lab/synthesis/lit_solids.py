"""Solids of known materials, with the light that reaches their corners, as triangles that pictures are made of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from rendra_lab.synthesis.rooms_surfaces import SURFACES, TILE_M, linear_color
from rendra_lab.synthesis.solids import Floats, Solid
from rendra_lab.synthesis.surface_pictures import LitSurfaces

_DARKEST = 1e-4  # tint: what is lit is never quite black


def lit_surfaces(solids: Sequence[Solid], light: Floats) -> LitSurfaces:
    """The triangles of solids.

    Args:
        solids: at least one.
        light: (C, 3) that reaches their corners, one solid's after another's.

    Raises:
        ValueError: light for another number of corners.
    """
    counts = np.array([len(solid.points) for solid in solids])
    if len(light) != counts.sum():
        raise ValueError(f"solids have {counts.sum()} corners, got light for {len(light)}")
    offsets = np.cumsum(counts) - counts
    faces = torch.from_numpy(
        np.concatenate([solid.faces + first for solid, first in zip(solids, offsets, strict=True)])
    )
    per_face = np.repeat(np.arange(len(solids)), [len(solid.faces) for solid in solids])
    which = np.array([SURFACES.index(solid.surface) for solid in solids])[per_face]
    tiles = torch.from_numpy(np.array([TILE_M[name] for name in SURFACES], np.float32)[which])
    tint = torch.stack([linear_color(solid.color) for solid in solids]).clamp_min(_DARKEST)
    verts = torch.from_numpy(np.concatenate([solid.points for solid in solids]))
    places = torch.from_numpy(np.concatenate([solid.uvs for solid in solids]))[faces] / tiles[:, None, None]
    return LitSurfaces(
        verts=verts,
        faces=faces,
        places=places,
        light=torch.from_numpy(light)[faces],
        which=torch.from_numpy(which),
        tint=tint[torch.from_numpy(per_face)],
        scale=sides_a_unit(verts[faces], places),
    )


def sides_a_unit(corners: Tensor, places: Tensor) -> Tensor:
    """How many sides of their picture faces span a unit of length (F,), from their areas.

    Args:
        corners: (F, 3, 3).
        places: (F, 3, 2) of the corners, in sides of the picture.
    """
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = torch.linalg.cross(one, other).norm(dim=1)
    u, v = places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]
    return ((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).abs() / area.clamp_min(1e-9)).sqrt().clamp(1e-3, 1e3)
