"""Voxels to meshes."""

import torch
from torch import Tensor

from rendra.kernels.cubify import cubify as surface_of_voxels
from rendra.structures.meshes import Meshes

_ALIGNMENTS = ("topleft", "corner", "center")


def cubify(
    voxels: Tensor,
    thresh: float,
    *,
    feats: Tensor | None = None,
    device: torch.device | str | None = None,
    align: str = "topleft",
) -> Meshes:
    """Turn every voxel of at least `thresh` into a box, drop the sides between two such boxes, merge vertices.

    Each mesh is closed and looks outwards. Vertices are sorted by (y, x, z), z fastest. Faces come voxel by voxel in
    the same order, for each voxel side by side in the order -x, +x, -y, +y, -z, +z, two triangles a side: (a, b, c)
    and (a, c, d) of the side's corners, counter-clockwise seen from outside. Not differentiable in `voxels`; a NaN
    counts as empty.

    Where voxel i of S along an axis lies (x along W, y along H, z along D), by `align`:

    - "topleft": from 2 i / (S - 1) - 1 to 2 (i + 1) / (S - 1) - 1, so that the last voxel reaches beyond 1;
    - "corner": from 2 i / S - 1 to 2 (i + 1) / S - 1; the grid fills [-1, 1];
    - "center": centred at 2 i / (S - 1) - 1; the first and the last centre lie at -1 and 1.

    With S = 1, "topleft" and "center" make the voxel 2 wide.

    Args:
        voxels: (N, D, H, W), usually probabilities of being occupied.
        thresh: least value of a voxel that is kept.
        feats: (N, C, D, H, W), what each voxel carries, usually a colour; for `align="center"` only. Faces show what
            their voxel carries. Differentiable.
        device: where the meshes are made; None for that of `voxels`.
        align: "topleft", "corner" or "center".

    Returns:
        N meshes, without faces where nothing is kept; with a `TexturesAtlas` of one texel a face if `feats` is given.

    Raises:
        ValueError: another shape or `align`, or `feats` with another `align` than "center".
    """
    _check(voxels, feats, align)
    device = voxels.device if device is None else torch.device(device)
    dtype = torch.float64 if voxels.dtype == torch.float64 else torch.float32
    voxels = voxels.detach().to(device, dtype)
    z, y, x = (_planes(size, align).to(device, dtype) for size in voxels.shape[1:])
    verts, faces, voxel_of_quad, num_verts, num_faces = surface_of_voxels(voxels, thresh, x, y, z)
    sizes = num_faces.tolist()
    meshes = Meshes(list(verts.split(num_verts.tolist())), list(faces.split(sizes)))
    if feats is not None:
        meshes.textures = _painted(feats.to(device), voxel_of_quad, sizes)
    return meshes


def _check(voxels: Tensor, feats: Tensor | None, align: str) -> None:
    if align not in _ALIGNMENTS:
        raise ValueError(f"align must be one of {', '.join(_ALIGNMENTS)}, got {align!r}")
    if voxels.ndim != 4:
        raise ValueError(f"voxels must have shape (N, D, H, W), got {tuple(voxels.shape)}")
    if feats is None:
        return
    if align != "center":
        raise ValueError(f"feats can be given with align='center' only, got align={align!r}")
    if feats.ndim != 5 or (feats.shape[0], *feats.shape[2:]) != tuple(voxels.shape):
        raise ValueError(
            f"feats must have shape (N, C, D, H, W) with the (N, D, H, W) = {tuple(voxels.shape)} of voxels, got "
            f"{tuple(feats.shape)}"
        )


def _planes(size: int, align: str) -> Tensor:
    """Where the planes between `size` voxels lie, in float64 on the CPU. (size + 1,)"""
    index = torch.arange(size + 1, dtype=torch.float64)
    if align == "corner":
        return 2 * index / max(size, 1) - 1
    step = 2 / max(size - 1, 1)
    return index * step - 1 - (step / 2 if align == "center" else 0)


def _painted(feats: Tensor, voxel_of_quad: Tensor, num_faces: list[int]) -> object:
    """One texel (1, 1, C) for each face."""
    from rendra.renderer.mesh.textures import TexturesAtlas  # lies above this layer; asked for only with feats

    texels = feats.movedim(1, -1).reshape(-1, feats.shape[1]).index_select(0, voxel_of_quad)
    atlas = texels.repeat_interleave(2, dim=0)[:, None, None]
    return TexturesAtlas(list(atlas.split(num_faces)))
