"""Occupancy grids to the surface of their voxels: quads cut in two, vertices merged."""

import torch
from torch import Tensor

from rendra.kernels.cubify import numba_cpu, reference

__all__ = ["cubify"]


def cubify(
    voxels: Tensor, thresh: float, x: Tensor, y: Tensor, z: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """The faces between voxels that are kept, `voxels >= thresh`, and others; `reference.py` states each rule.

    Outside the grid nothing is kept, and neither is a NaN. The surface is closed and looks outwards. Not
    differentiable; the same on any number of threads.

    Args:
        voxels: (N, D, H, W) floats.
        thresh: least value of a voxel that is kept.
        x: (W + 1,) where the planes between voxels lie along W, in the type of `voxels`.
        y: (H + 1,) the same along H.
        z: (D + 1,) the same along D.

    Returns:
        verts (sum V, 3), their (x, y, z); faces (sum F, 3) int64, counting the vertices of their own grid;
        voxel_of_quad (sum F / 2,) int64, index into `voxels.flatten()` of the voxel that faces 2i and 2i + 1 bound;
        num_verts (N,) and num_faces (N,) int64.

    Raises:
        ValueError: a shape, type or device that cannot be.
    """
    if voxels.ndim != 4 or not voxels.is_floating_point():
        raise ValueError(f"voxels must be floats of shape (N, D, H, W), got {voxels.dtype} of {tuple(voxels.shape)}")
    for name, planes, size in zip("zyx", (z, y, x), voxels.shape[1:], strict=True):
        if planes.shape != (size + 1,) or planes.dtype != voxels.dtype or planes.device != voxels.device:
            raise ValueError(
                f"{name} must be {voxels.dtype} of shape ({size + 1},) on {voxels.device}, got {planes.dtype} of "
                f"{tuple(planes.shape)} on {planes.device}"
            )
    if voxels.device.type != "cpu" or voxels.dtype != torch.float32:
        return reference.cubify(voxels, thresh, x, y, z)
    return _cubify_on_cpu(voxels.detach(), float(thresh), x, y, z)


@torch.library.custom_op("rendra::cubify", mutates_args=(), device_types="cpu")
def _cubify_on_cpu(
    voxels: Tensor, thresh: float, x: Tensor, y: Tensor, z: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    planes = [axis.contiguous().numpy() for axis in (x, y, z)]
    results = numba_cpu.forward(voxels.contiguous().numpy(), thresh, *planes)
    verts, faces, voxel_of_quad, num_verts, num_faces = map(torch.from_numpy, results)
    return verts, faces, voxel_of_quad, num_verts, num_faces


@_cubify_on_cpu.register_fake
def _(voxels, thresh, x, y, z):  # type: ignore[no-untyped-def]
    size = torch.library.get_ctx().new_dynamic_size
    num_verts, num_quads = size(), size()
    counts = voxels.new_empty((len(voxels),), dtype=torch.int64)
    return (
        voxels.new_empty((num_verts, 3)),
        voxels.new_empty((2 * num_quads, 3), dtype=torch.int64),
        voxels.new_empty((num_quads,), dtype=torch.int64),
        counts,
        torch.empty_like(counts),
    )
