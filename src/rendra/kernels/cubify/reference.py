"""Surface of the voxels that are kept, the specification: plain torch, any device, any float type, slow.

1. A voxel is kept if its value is at least `thresh`. A NaN is not, and nothing outside the grid is.
2. A quad stands on each side of a kept voxel behind which none is kept. Voxels come in the order of (grid, y, x, z),
   z fastest; the sides of one in the order -x, +x, -y, +y, -z, +z.
3. A quad's corners run counter-clockwise seen from outside, from the corners that `_SIDES` lists; (a, b, c, d) makes
   the triangles (a, b, c) and (a, c, d).
4. The vertices are the corners of the grid that some quad names, each once, in the order of (grid, y, x, z). Voxels
   that touch in an edge or a corner only therefore share vertices.
"""

import torch
from torch import Tensor
from torch.nn import functional as F

_VOXELS_AT_ONCE = 2**22
# (side, corner, axis): the steps along (y, x, z) from a voxel's first corner to those of the quad on each side
_SIDES = (
    ((0, 0, 0), (0, 0, 1), (1, 0, 1), (1, 0, 0)),  # -x
    ((0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 1, 1)),  # +x
    ((0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)),  # -y
    ((1, 0, 0), (1, 0, 1), (1, 1, 1), (1, 1, 0)),  # +y
    ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)),  # -z
    ((0, 0, 1), (0, 1, 1), (1, 1, 1), (1, 0, 1)),  # +z
)


def cubify(
    voxels: Tensor, thresh: float, x: Tensor, y: Tensor, z: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Vertices, faces, voxels and numbers; see the package's `cubify`."""
    n, depth, height, width = voxels.shape
    grids = [_surface(grid >= thresh) for grid in voxels]
    corners = torch.cat([corners for corners, _, _ in grids]) if n else x.new_empty((0, 3), dtype=torch.int64)
    faces = torch.cat([faces for _, faces, _ in grids]) if n else corners
    owners = [owner + i * depth * height * width for i, (_, _, owner) in enumerate(grids)]
    verts = torch.stack([x[corners[:, 1]], y[corners[:, 0]], z[corners[:, 2]]], dim=1)
    num_verts = torch.tensor([len(corners) for corners, _, _ in grids], dtype=torch.int64, device=voxels.device)
    num_faces = torch.tensor([len(faces) for _, faces, _ in grids], dtype=torch.int64, device=voxels.device)
    return verts, faces, torch.cat(owners) if n else corners[:, 0], num_verts, num_faces


def _surface(kept: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Corners (V, 3) as (y, x, z), faces (F, 3) and the voxel (F / 2,) behind each quad, of one grid (D, H, W)."""
    depth, height, width = kept.shape
    rows = max(1, _VOXELS_AT_ONCE // max(1, depth * width))
    padded = F.pad(kept.permute(1, 2, 0), (1, 1, 1, 1, 1, 1))  # (H + 2, W + 2, D + 2)
    bands = [_bare_sides(padded[first : first + rows + 2], first) for first in range(0, height, rows)]
    bare = torch.cat(bands) if bands else kept.new_empty((0, 4), dtype=torch.int64)
    place, side = bare[:, :3], bare[:, 3]
    quads = place[:, None] + torch.tensor(_SIDES, device=kept.device)[side]  # (Q, 4, 3)
    flat = (quads[..., 0] * (width + 1) + quads[..., 1]) * (depth + 1) + quads[..., 2]
    used, quad = torch.unique(flat, return_inverse=True)
    y, x, z = used // ((width + 1) * (depth + 1)), used // (depth + 1) % (width + 1), used % (depth + 1)
    faces = quad[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return torch.stack([y, x, z], dim=1), faces, (place[:, 2] * height + place[:, 0]) * width + place[:, 1]


def _bare_sides(padded: Tensor, first_row: int) -> Tensor:
    """(Q, 4): (y, x, z, side) of the quads in some rows, which come with one more row on either side."""
    height, width, depth = (size - 2 for size in padded.shape)
    center = slice(1, -1)
    kept = padded[center, center, center]
    behind = [
        padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width, 1 + dz : 1 + dz + depth]
        for dy, dx, dz in ((0, -1, 0), (0, 1, 0), (-1, 0, 0), (1, 0, 0), (0, 0, -1), (0, 0, 1))
    ]
    bare = torch.stack([kept & ~other for other in behind], dim=-1).nonzero()
    return bare + torch.tensor([first_row, 0, 0, 0], device=bare.device)
