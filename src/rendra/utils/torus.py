"""The torus as a grid of quadrilaterals, each cut in two."""

from math import pi

import torch

from rendra.structures.meshes import Meshes


def torus(r: float, R: float, sides: int, rings: int, device: torch.device | str | None = None) -> Meshes:
    """A torus around the z axis, its faces looking outwards.

    Args:
        r: radius of the tube.
        R: distance from the centre of the torus to the centre of the tube.
        sides: points around the tube.
        rings: cross-sections along the tube.
        device: CPU if None.

    Returns:
        One mesh of rings * sides vertices, ring by ring, and twice as many faces, float32.

    Raises:
        ValueError: a radius is not positive, or there are fewer than three sides or rings.
    """
    if r <= 0 or R <= 0:
        raise ValueError(f"r and R must be positive, got {r} and {R}")
    if sides < 3 or rings < 3:
        raise ValueError(f"a torus needs at least 3 sides and 3 rings, got {sides} and {rings}")
    phi = torch.arange(rings, device=device)[:, None] * (2 * pi / rings)  # along the tube
    theta = torch.arange(sides, device=device) * (2 * pi / sides)  # around the tube
    distance = R + r * theta.cos()
    height = (r * theta.sin()).expand(rings, sides)
    verts = torch.stack([distance * phi.cos(), distance * phi.sin(), height], dim=-1)
    here = torch.arange(rings * sides, device=device).view(rings, sides)
    next_ring, next_side = here.roll(-1, 0), here.roll(-1, 1)
    opposite = next_ring.roll(-1, 1)
    halves = torch.stack([here, next_ring, opposite, here, opposite, next_side], dim=-1)
    return Meshes([verts.view(-1, 3)], [halves.view(-1, 3)])
