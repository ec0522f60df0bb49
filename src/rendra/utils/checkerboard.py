"""A checkerboard to stand scenes on."""

import torch

from rendra.common.datatypes import Device
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures.meshes import Meshes

_CORNERS = ((0, 0), (1, 0), (1, 1), (0, 1))


def checkerboard(
    radius: int = 4,
    color1: tuple[float, ...] = (0.0, 0.0, 0.0),
    color2: tuple[float, ...] = (1.0, 1.0, 1.0),
    device: Device | None = None,
) -> Meshes:
    """Unit squares of two colours in the plane z = 0, around the origin.

    Args:
        radius: squares from the origin to each border; there are 4 radius^2.
        color1: of the square whose lower corner is the origin, and of every second one.
        color2: of the others.
        device: where the mesh is made; None for the CPU.

    Returns:
        One mesh that looks along +z, with four vertices and two faces a square and `TexturesVertex`.

    Raises:
        ValueError: the radius is less than 1.
    """
    if radius < 1:
        raise ValueError(f"radius must be at least 1, got {radius}")
    steps = torch.arange(-radius, radius, device=device)
    squares = torch.cartesian_prod(steps, steps)  # (S, 2) lower corners
    corners = squares[:, None] + torch.tensor(_CORNERS, device=device)
    verts = torch.nn.functional.pad(corners.reshape(-1, 2), (0, 1)).float()
    first = 4 * torch.arange(len(squares), device=device)[:, None, None]
    faces = (first + torch.tensor([[0, 1, 2], [0, 2, 3]], device=device)).reshape(-1, 3)
    colors = torch.tensor([color1, color2], dtype=torch.float32, device=device)[squares.sum(1) % 2]
    return Meshes([verts], [faces], TexturesVertex([colors.repeat_interleave(4, dim=0)]))
