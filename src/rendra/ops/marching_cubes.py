"""Surfaces of constant value in volumes."""

import numpy as np
import torch
from skimage import measure
from torch import Tensor

_EXPONENT = 20  # volumes are scaled by a power of two, so that the greatest distance from the level is about 2^20
_TINY = np.float32(2.0**-20)


def marching_cubes(
    vol_batch: Tensor, isolevel: float | None = None, return_local_coords: bool = True
) -> tuple[list[Tensor], list[Tensor]]:
    """Triangles along the surface on which a volume has the value `isolevel`; not differentiable.

    Inside is where the value is below `isolevel`, as in a signed distance: faces look towards higher values,
    counter-clockwise seen from there. For a density, higher inside, pass `-density` and `-isolevel`. The surface ends
    where the volume does; inside it has no holes, since faces share their vertices, also across ambiguous cubes.

    The work is done by scikit-image on the CPU, wherever the volume lies (Lewiner et al., "Efficient implementation
    of Marching Cubes' cases with topological guarantees", 2003); vertices are right to float32.

    Args:
        vol_batch: (N, D, H, W), N volumes of finite values.
        isolevel: the value on the surface; None for the mean of each volume's least and greatest.
        return_local_coords: whether the volume spans [-1, 1] along each axis, the centres of the first and the last
            voxel being its ends; otherwise [0, W - 1] x [0, H - 1] x [0, D - 1].

    Returns:
        N tensors (V_i, 3) of vertices, (x, y, z) along (W, H, D); and N tensors (F_i, 3) int64 of faces. Both have no
        rows where no surface passes. On the device of the volume; vertices in its type.

    Raises:
        ValueError: another shape, or a volume with a value that is not finite.
    """
    if vol_batch.ndim != 4:
        raise ValueError(f"vol_batch must have shape (N, D, H, W), got {tuple(vol_batch.shape)}")
    dtype = vol_batch.dtype if vol_batch.is_floating_point() else torch.float32
    all_verts, all_faces = [], []
    for n, volume in enumerate(vol_batch.detach().to("cpu", torch.float64).numpy()):
        if not np.isfinite(volume).all():
            raise ValueError(
                f"vol_batch[{n}] has {np.count_nonzero(~np.isfinite(volume))} values that are not finite"
            )
        verts, faces = _surface(volume, isolevel)
        if return_local_coords:
            verts = verts * (2 / np.maximum(np.array(volume.shape[::-1], np.float32) - 1, 1)) - 1
        all_verts.append(torch.from_numpy(verts).to(vol_batch.device, dtype))
        all_faces.append(torch.from_numpy(faces).to(vol_batch.device))
    return all_verts, all_faces


def marching_cubes_naive(
    vol_batch: Tensor, isolevel: float | None = None, return_local_coords: bool = True
) -> tuple[list[Tensor], list[Tensor]]:
    """The same as `marching_cubes`, under the name that PyTorch3D gives its version in plain Python."""
    return marching_cubes(vol_batch, isolevel, return_local_coords)


def _surface(volume: np.ndarray, isolevel: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) as (x, y, z) in voxels, and faces (F, 3) int64."""
    if min(volume.shape) < 2:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64)
    level = 0.5 * volume.min() + 0.5 * volume.max() if isolevel is None else isolevel
    above = volume - level
    if (above < 0).all() or (above >= 0).all():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int64)
    # scikit-image takes values below 1e-7 for zero, and tears the surface where it meets a value that is zero
    above = np.ldexp(above, _EXPONENT - np.frexp(np.abs(above).max())[1]).astype(np.float32)
    above[above == 0] = _TINY
    verts, faces, _, _ = measure.marching_cubes(above, 0.0, gradient_direction="ascent")
    return np.ascontiguousarray(verts[:, ::-1]), faces.astype(np.int64)
