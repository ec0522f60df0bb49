"""Soft silhouette, the specification: plain torch, any device, any float type, slow.

Each face f that is kept at pixel p (inside, or with squared NDC distance d below `blur_radius`; which faces count is
rule 1 and rule 4 of the reference of `rasterize_meshes`, with clipped barycentrics, so that no depth is negative)
covers it with probability sigmoid(-d / sigma). The pixel is seen through all of them with

    survival = prod_f (1 - sigmoid(-d_f / sigma)) = prod_f sigmoid(d_f / sigma)        (Liu et al., ICCV 2019, Eq. 6)

The product is summed as logarithms, and each band of rows is recomputed in the backward pass, so that memory stays
bounded. This module is written without the reference of `rasterize_meshes`: each checks the other.
"""

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

_EPS = 1e-8
_PAIRS_AT_ONCE = 2**22


def soft_silhouette(
    face_verts: Tensor,
    mesh_to_face_first_idx: Tensor,
    num_faces_per_mesh: Tensor,
    clipped_faces_neighbor_idx: Tensor | None,
    image_size: tuple[int, int],
    blur_radius: float,
    sigma: float,
    cull_backfaces: bool,
) -> Tensor:
    """Survival (N, H, W), one minus alpha; see the package's `soft_silhouette` for the arguments."""
    height, width = image_size
    short = min(image_size)
    x = torch.arange(width - 1, -width, -2, dtype=face_verts.dtype, device=face_verts.device) / short
    y = torch.arange(height - 1, -height, -2, dtype=face_verts.dtype, device=face_verts.device) / short
    images = []
    for first, count in zip(mesh_to_face_first_idx.tolist(), num_faces_per_mesh.tolist(), strict=True):
        drawn = first + _drawn(face_verts[first : first + count].detach(), cull_backfaces)
        rows = max(1, _PAIRS_AT_ONCE // max(1, len(drawn) * width))
        bands = [
            checkpoint(
                _band, face_verts, drawn, clipped_faces_neighbor_idx, x, band, blur_radius, sigma,
                use_reentrant=False,
            )
            for band in y.split(rows)
        ]  # fmt: skip
        images.append(torch.cat(bands))
    return torch.stack(images) if images else face_verts.new_empty((0, height, width))


def _drawn(face_verts: Tensor, cull_backfaces: bool) -> Tensor:
    """Indices of the faces that are neither behind the camera, degenerate nor culled."""
    x, y, z = face_verts.unbind(-1)
    area = (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0]) - (y[:, 2] - y[:, 0]) * (x[:, 1] - x[:, 0])
    drawn = (z.amin(1) >= _EPS) & (area.abs() > _EPS) & area.isfinite()
    return (drawn & (area > 0) if cull_backfaces else drawn).nonzero().squeeze(1)


def _band(
    face_verts: Tensor, drawn: Tensor, neighbor: Tensor | None, x: Tensor, y: Tensor, blur_radius: float,
    sigma: float,
) -> Tensor:  # fmt: skip
    """Survival (rows, W) of a few rows."""
    margin = blur_radius**0.5
    low, high = (face_verts[drawn][..., 1].amin(1) - margin, face_verts[drawn][..., 1].amax(1) + margin)
    drawn = drawn[(high >= y.min()) & (low <= y.max())]
    pixels = torch.cartesian_prod(y, x).view(-1, 1, 2).flip(-1)  # (P, 1, 2)
    corners = face_verts[drawn][..., :2]  # (C, 3, 2)
    d, inside = _distance(pixels, corners)
    in_box = (pixels >= corners.amin(1) - margin) & (pixels <= corners.amax(1) + margin)
    kept = (inside | (d < blur_radius)) & in_box.all(-1)
    if neighbor is not None:
        other = neighbor[drawn]
        rival, _ = _distance(pixels, face_verts[other.clamp(min=0)][..., :2])
        kept &= (other < 0) | (d < rival) | ((d == rival) & (drawn < other))
    log_survival = torch.where(kept, F.logsigmoid(torch.where(kept, d, 0.0) / sigma), 0.0)
    return log_survival.sum(1).exp().view(len(y), len(x))


def _distance(pixels: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """Squared distance (P, C) to the nearest edge, negative inside, and which are inside."""
    squared, sides = [], []
    for i in range(3):
        a, b = corners[:, i], corners[:, (i + 1) % 3]
        ab, ap = b - a, pixels - a
        length = (ab**2).sum(-1)
        t = ((ap * ab).sum(-1) / torch.where(length > 0, length, 1.0)).clamp(0, 1)
        squared.append(((ap - t[..., None] * ab) ** 2).sum(-1))
        sides.append(ap[..., 0] * ab[:, 1] - ap[..., 1] * ab[:, 0])
    nearest = torch.stack(squared).amin(0)
    sides_at = torch.stack(sides)
    inside = (sides_at > 0).all(0) | (sides_at < 0).all(0)
    return torch.where(inside, -nearest, nearest), inside
