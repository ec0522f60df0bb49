"""Triangles to fragments, the specification: plain torch, any device, any float type, slow.

For every pixel centre p and every face of its image (facts of PyTorch3D's public rasteriser, version 0.7.9):
1. A face is drawn unless a corner's depth is below 1e-8, its signed area is at most 1e-8 in size or not finite, or
   it faces away and `cull_backfaces` is set; and only for pixels in its bounding box grown by sqrt(blur_radius).
2. w_i = edge_i(p) / (area + 1e-8); perspective correction replaces w_i by w_i / z_i, normalised; p is inside where
   all three are positive; clipping then sets negative ones to zero and normalises (sum at least 1e-5).
3. The depth is sum_i w_i z_i; a negative one drops the hit.
4. The distance is the squared NDC distance to the nearest edge, negative inside. Outside hits need it below
   `blur_radius`. Of two halves of a clipped face only the nearer is kept (lower distance, then lower index).
5. The K hits of least depth are kept, nearest first; ties go to the lower face index.

The choice of hits carries no gradient; what is reported of them does, by autograd.
"""

import torch
from torch import Tensor

_EPS = 1e-8
_CLIP_EPS = 1e-5
_TINY = 1e-37  # an inside distance of zero keeps its sign
_PAIRS_AT_ONCE = 2**22  # (pixel, face) pairs held in memory: about 40 bytes each


def rasterize_meshes(
    face_verts: Tensor,
    mesh_to_face_first_idx: Tensor,
    num_faces_per_mesh: Tensor,
    clipped_faces_neighbor_idx: Tensor | None,
    image_size: tuple[int, int],
    blur_radius: float,
    faces_per_pixel: int,
    perspective_correct: bool,
    clip_barycentric_coords: bool,
    cull_backfaces: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See the package's `rasterize_meshes`; same arguments, same meaning."""
    height, width = image_size
    pixels = pixel_centres(image_size, face_verts)  # (H, W, 2)
    with torch.no_grad():
        images = [
            _nearest_hits(
                face_verts, first, first + count, clipped_faces_neighbor_idx, pixels, blur_radius, faces_per_pixel,
                perspective_correct, clip_barycentric_coords, cull_backfaces,
            )
            for first, count in zip(mesh_to_face_first_idx.tolist(), num_faces_per_mesh.tolist(), strict=True)
        ]  # fmt: skip
    shape = (len(images), height, width, faces_per_pixel)
    pix_to_face = torch.stack(images).view(shape) if images else face_verts.new_empty(shape, dtype=torch.int64)

    hit = pix_to_face >= 0
    corners = face_verts[pix_to_face[hit]]  # (hits, 3, 3)
    centre = pixels[None, :, :, None].expand(*shape, 2)[hit]
    bary, depth, dists, _ = _measure(centre, corners, perspective_correct, clip_barycentric_coords)
    empty = face_verts.new_full(shape, -1.0)
    return (
        pix_to_face,
        empty.masked_scatter(hit, depth),
        empty[..., None].expand(*shape, 3).masked_scatter(hit[..., None], bary),
        empty.masked_scatter(hit, dists),
    )


def pixel_centres(image_size: tuple[int, int], like: Tensor) -> Tensor:
    """NDC (H, W, 2) of the pixel centres: +X left, +Y up, the short side spans [-1, 1]."""
    short = min(image_size)
    axes = [torch.arange(size - 1, -size, -2, dtype=like.dtype, device=like.device) / short for size in image_size]
    y, x = torch.meshgrid(*axes, indexing="ij")
    return torch.stack([x, y], dim=-1)


def drawn_faces(face_verts: Tensor, cull_backfaces: bool) -> Tensor:
    """Which faces (F,) are drawn at all: rule 1."""
    v0, v1, v2 = face_verts[..., :2].unbind(1)
    area = _edge(v2, v0, v1)
    drawn = (face_verts[..., 2].amin(1) >= _EPS) & (area.abs() > _EPS) & area.isfinite()
    return drawn & (area > 0) if cull_backfaces else drawn


def hit_pairs(
    centres: Tensor, face_verts: Tensor, candidates: Tensor, neighbor: Tensor | None, blur_radius: float,
    perspective_correct: bool, clip_barycentric_coords: bool,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Hits of pixels (P, 2) and candidate faces (C,): whether kept (P, C), depth (P, C), distance (P, C)."""
    corners = face_verts[candidates]
    pairs = centres[:, None], corners[None]
    _, depth, dists, inside = _measure(*pairs, perspective_correct, clip_barycentric_coords)
    margin = blur_radius**0.5
    low, high = corners[..., :2].amin(1) - margin, corners[..., :2].amax(1) + margin
    in_box = ((centres[:, None] >= low) & (centres[:, None] <= high)).all(-1)
    kept = in_box & (inside | (dists < blur_radius)) & (depth >= 0)
    if neighbor is not None:
        other = neighbor[candidates]
        rival = signed_distances(centres[:, None], face_verts[other.clamp(min=0)][None])
        kept &= (other < 0) | (dists < rival) | ((dists == rival) & (candidates < other))
    return kept, depth, dists


def signed_distances(p: Tensor, corners: Tensor) -> Tensor:
    """Squared distance of p (..., 2) to the nearest edge of corners (..., 3, 3), negative inside."""
    v0, v1, v2 = corners[..., :2].unbind(-2)
    edges = [_edge(p, v1, v2), _edge(p, v2, v0), _edge(p, v0, v1)]
    orientation = torch.where(_edge(v2, v0, v1) + _EPS > 0, 1.0, -1.0).to(p.dtype)
    inside = torch.stack([edge * orientation > 0 for edge in edges]).all(0)
    squared = torch.stack([_to_segment(p, v1, v2), _to_segment(p, v2, v0), _to_segment(p, v0, v1)]).amin(0)
    return torch.where(inside, -squared.clamp(min=_TINY), squared)


def _nearest_hits(
    face_verts: Tensor, first: int, end: int, neighbor: Tensor | None, pixels: Tensor, blur_radius: float,
    layers: int, perspective_correct: bool, clip: bool, cull: bool,
) -> Tensor:  # fmt: skip
    """Face indices (H, W, K) of one image, -1 where there are fewer hits; row bands bound the memory."""
    height, width, _ = pixels.shape
    faces = first + drawn_faces(face_verts[first:end], cull).nonzero().squeeze(1)
    result = torch.full((height, width, layers), -1, dtype=torch.int64, device=face_verts.device)
    for rows, candidates in row_bands(face_verts, faces, pixels, blur_radius):
        centres = pixels[rows].reshape(-1, 2)
        kept, depth, _ = hit_pairs(centres, face_verts, candidates, neighbor, blur_radius, perspective_correct, clip)
        # candidates ascend, and the sort is stable: ties go to the lower face index
        depth = torch.where(kept, depth, torch.inf)
        order = depth.argsort(dim=1, stable=True)[:, :layers]
        chosen = torch.where(kept.gather(1, order), candidates[order], -1)
        result[rows, :, : order.shape[1]] = chosen.view(-1, width, order.shape[1])
    return result


def row_bands(face_verts: Tensor, faces: Tensor, pixels: Tensor, blur_radius: float) -> list[tuple[slice, Tensor]]:
    """Bands of rows with the faces whose grown boxes touch them, each of bounded size."""
    height, width, _ = pixels.shape
    margin = blur_radius**0.5
    y = face_verts[faces][..., 1]
    low, high = y.amin(1) - margin, y.amax(1) + margin
    bands, todo = [], [(row, min(row + 16, height)) for row in range(0, height, 16)]
    while todo:
        top, bottom = todo.pop()
        candidates = faces[(high >= pixels[bottom - 1, 0, 1]) & (low <= pixels[top, 0, 1])]
        if len(candidates) * (bottom - top) * width > _PAIRS_AT_ONCE and bottom - top > 1:
            middle = (top + bottom) // 2
            todo += [(top, middle), (middle, bottom)]
        elif len(candidates):
            bands.append((slice(top, bottom), candidates))
    return bands


def _measure(
    p: Tensor, corners: Tensor, perspective_correct: bool, clip: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rules 2-4 at p (..., 2) for corners (..., 3, 3): barycentrics, depth, signed distance, inside."""
    v0, v1, v2 = corners[..., :2].unbind(-2)
    z0, z1, z2 = corners[..., 2].unbind(-1)
    area = _edge(v2, v0, v1) + _EPS
    w = torch.stack([_edge(p, v1, v2) / area, _edge(p, v2, v0) / area, _edge(p, v0, v1) / area], dim=-1)
    if perspective_correct:
        w0, w1, w2 = w.unbind(-1)
        w = torch.stack([w0 * z1 * z2, z0 * w1 * z2, z0 * z1 * w2], dim=-1)
        w = w / _sum3(w).clamp(min=_EPS)[..., None]
    dists = signed_distances(p, corners)
    if clip:
        w = w.clamp(min=0)
        w = w / _sum3(w).clamp(min=_CLIP_EPS)[..., None]
    depth = w[..., 0] * z0 + w[..., 1] * z1 + w[..., 2] * z2
    return w, depth, dists, dists < 0


def _sum3(x: Tensor) -> Tensor:
    """Sum of three terms from left to right, as a scalar kernel adds them."""
    return x[..., 0] + x[..., 1] + x[..., 2]


def _edge(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Twice the signed area of (a, b, p)."""
    return (p[..., 0] - a[..., 0]) * (b[..., 1] - a[..., 1]) - (p[..., 1] - a[..., 1]) * (b[..., 0] - a[..., 0])


def _to_segment(p: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Squared distance of p to the segment (a, b)."""
    ab = b - a
    square = (ab**2).sum(-1)
    along = ((p - a) * ab).sum(-1) / torch.where(square > 0, square, 1.0)
    return ((p - a - along.clamp(0, 1)[..., None] * ab) ** 2).sum(-1)
