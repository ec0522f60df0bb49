"""
Surface normals and principal directions of point clouds, from the covariance of each point's neighbours.

Source: Tombari, Salti, Di Stefano, "Unique Signatures of Histograms for Local Surface Description", ECCV 2010,
Section 3 (its axes x, y, z are the third, second and first column here).
Letters: N clouds, P points of the largest one, K neighbours.
"""

import torch
from torch import Tensor

from rendra.ops.matrix_factors import symmetric_eigen
from rendra.ops.utils import convert_pointclouds_to_tensor, get_point_covariances, wmean
from rendra.structures.pointclouds import Pointclouds


def estimate_pointcloud_normals(
    pointclouds: Tensor | Pointclouds,
    neighborhood_size: int = 50,
    disambiguate_directions: bool = True,
    *,
    use_symeig_workaround: bool = True,
) -> Tensor:
    """
    The direction in which each point's neighbours spread least.

    Args:
        pointclouds: N clouds, or (N, P, 3).
        neighborhood_size: K, how many nearest points span the surface, the point itself included.
        disambiguate_directions: turn each normal to the side where most neighbours lie, so that those of points
            beside each other agree: inwards on a sphere.
        use_symeig_workaround: accepted for compatibility; there is one way, with finite gradients.

    Returns:
        (N, P, 3) unit normals, 0 in the padding.

    Raises:
        ValueError: a cloud that is not empty has fewer points than `neighborhood_size`, or points that are not
            three-dimensional.
    """
    _, vectors, offsets = _principal_directions(pointclouds, neighborhood_size)
    normals = vectors[..., 0]
    return _turned(normals, offsets) if disambiguate_directions else normals


def estimate_pointcloud_local_coord_frames(
    pointclouds: Tensor | Pointclouds,
    neighborhood_size: int = 50,
    disambiguate_directions: bool = True,
    *,
    use_symeig_workaround: bool = True,
) -> tuple[Tensor, Tensor]:
    """
    How far each point's neighbours spread, and along which axes.

    Args:
        pointclouds: N clouds, or (N, P, 3).
        neighborhood_size: K, how many nearest points span the surface, the point itself included.
        disambiguate_directions: turn the first and the last axis to the side where most neighbours lie, and take
            their cross product, first times last, for the one between.
        use_symeig_workaround: accepted for compatibility; there is one way, with finite gradients.

    Returns:
        Curvatures (N, P, 3), ascending: the neighbours' variances along the axes, in squared units of the
        points; and the unit axes in the columns of (N, P, 3, 3), the normal first. Both 0 in the padding.

    Raises:
        ValueError: see `estimate_pointcloud_normals`.
    """
    curvatures, vectors, offsets = _principal_directions(pointclouds, neighborhood_size)
    if disambiguate_directions:
        normal, main = (_turned(vectors[..., axis], offsets) for axis in (0, 2))
        vectors = torch.stack([normal, torch.linalg.cross(normal, main), main], -1)
    return curvatures, vectors


def _principal_directions(pointclouds: Tensor | Pointclouds, neighborhood_size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Variances (N, P, 3), axes in columns (N, P, 3, 3), and neighbours seen from their point (N, P, K, 3)."""
    points, counts = convert_pointclouds_to_tensor(pointclouds)
    if points.shape[2] != 3:
        raise ValueError(f"The pointclouds argument has to be of shape (minibatch, N, 3), got {tuple(points.shape)}")
    if neighborhood_size < 1 or ((counts > 0) & (counts < neighborhood_size)).any():
        raise ValueError(
            "The neighborhood_size argument has to be at least 1 and at most the size of each of the point clouds, "
            f"{counts.tolist()}; got {neighborhood_size}"
        )
    if points.numel() == 0:
        return points, points[..., None].expand(*points.shape, 3), points[:, :, None]
    real = torch.arange(points.shape[1], device=points.device) < counts[:, None]  # (N, P)
    centred = points - wmean(points, real.to(points.dtype)).detach()  # far from the origin, squares lose digits
    covariances, neighbors = get_point_covariances(centred, counts, neighborhood_size)
    curvatures, vectors = symmetric_eigen(covariances)
    offsets = neighbors - centred[:, :, None]
    return curvatures, vectors.masked_fill(~real[..., None, None], 0), offsets


def _turned(axes: Tensor, offsets: Tensor) -> Tensor:
    """The axes (N, P, 3), reversed where more neighbours lie behind the point than before it (Sec. 3, Eq. 4)."""
    ahead = (offsets @ axes[..., None]).detach()[..., 0].sign().sum(-1, keepdim=True)
    return torch.where(ahead < 0, -axes, axes)
