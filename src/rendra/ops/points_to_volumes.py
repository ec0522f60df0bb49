"""
Point clouds added to voxel grids: every point votes for the voxels around it, with its features.

Letters: N clouds and volumes, P points, C feature channels, D H W voxels. Coordinates are xyz, sizes of grids zyx.
"""

from itertools import product

import torch
from torch import Tensor

from rendra.structures.pointclouds import Pointclouds
from rendra.structures.volumes import Volumes, local_extent

_MODES = ("nearest", "trilinear")


def add_pointclouds_to_volumes(
    pointclouds: Pointclouds,
    initial_volumes: Volumes,
    mode: str = "trilinear",
    min_weight: float = 1e-4,
    rescale_features: bool = True,
) -> Volumes:
    """Add each cloud, given in world coordinates, to the volume of the same index.

    Args:
        pointclouds: N clouds with features.
        initial_volumes: N volumes with one density channel; without features they start from 0.
        mode, min_weight, rescale_features: see `add_points_features_to_volume_densities_features`.

    Returns:
        New volumes of the same sizes and places. Differentiable with respect to points ("trilinear"), features,
        and initial densities and features.

    Raises:
        ValueError: the batches differ in size, clouds with points lack features, channels do not fit, or an
            unknown mode.
    """
    if len(initial_volumes) != len(pointclouds):
        raise ValueError(
            "'initial_volumes' and 'pointclouds' have to have the same batch size; "
            f"got {len(initial_volumes)} and {len(pointclouds)}"
        )
    points = pointclouds.points_padded()
    counts = pointclouds.num_points_per_cloud()
    densities, features = add_points_features_to_volume_densities_features(
        points_3d=initial_volumes.world_to_local_coords(points),
        points_features=_features_of(pointclouds, initial_volumes),
        volume_densities=initial_volumes.densities(),
        volume_features=initial_volumes.features(),
        mode=mode,
        min_weight=min_weight,
        mask=torch.arange(points.shape[1], device=points.device) < counts[:, None],
        grid_sizes=initial_volumes.get_grid_sizes(),
        rescale_features=rescale_features,
        align_corners=initial_volumes.get_align_corners(),
    )
    return initial_volumes.update_padded(densities, features)


def _features_of(pointclouds: Pointclouds, volumes: Volumes) -> Tensor:
    """Padded features (N, P, C); clouds without points need none where the volumes tell their number."""
    features, grids = pointclouds.features_padded(), volumes.features()
    if features is not None:
        return features
    if grids is None or not pointclouds.isempty():
        raise ValueError("'pointclouds' have to have their 'features' defined.")
    return grids.new_zeros(len(pointclouds), 0, grids.shape[1])


def add_points_features_to_volume_densities_features(
    points_3d: Tensor,
    points_features: Tensor,
    volume_densities: Tensor,
    volume_features: Tensor | None,
    mode: str = "trilinear",
    min_weight: float = 1e-4,
    mask: Tensor | None = None,
    grid_sizes: Tensor | None = None,
    rescale_features: bool = True,
    align_corners: bool = True,
) -> tuple[Tensor, Tensor]:
    """Add points in local coordinates to grids.

    With "trilinear" a point gives weights w, which sum to 1, to the 8 voxels around it; with "nearest" 1 to one.
    What would go to voxels outside the grid is lost, as are points that are not finite. A voxel then has

        density = its density + sum w,    features = (its features + sum w f) / max(density, least)

    where least is `min_weight` for "trilinear" and 1 for "nearest".

    Args:
        points_3d: (N, P, 3), -1 to 1 within the grid; see `Volumes`.
        points_features: (N, P, C).
        volume_densities: (N, 1, D, H, W).
        volume_features: (N, C, D, H, W); None starts from 0.
        mode: "trilinear" or "nearest".
        min_weight: keeps voxels that hardly got a vote from large features.
        mask: (N, P), which points to add; None means all.
        grid_sizes: (N, 3), the own depth, height and width of each grid; None means D, H and W.
        rescale_features: False leaves the division out.
        align_corners: whether -1 and 1 are the centres of the outermost voxels, or their outer faces.

    Returns:
        New densities (N, 1, D, H, W) and features (N, C, D, H, W).

    Raises:
        ValueError: an unknown mode, or shapes that do not fit together.
    """
    if mode not in _MODES:
        raise ValueError(f"No such interpolation mode {mode!r}; there are {', '.join(_MODES)}")
    _check_points(points_3d, points_features, volume_densities, mask)
    _check_grids(points_features, volume_densities, volume_features, grid_sizes)
    resolution = points_3d.new_tensor(volume_densities.shape[2:])
    sizes = resolution.expand(len(points_3d), 3) if grid_sizes is None else grid_sizes.to(points_3d.dtype)
    wanted = points_3d.isfinite().all(2)
    if mask is not None:
        wanted = wanted & (mask != 0)
    points = points_3d.where(wanted[..., None], 0)
    sizes = sizes.flip(1)[:, None]  # (N, 1, 3), xyz as the points
    places = (points * local_extent(sizes, align_corners) + sizes - 1) / 2
    rows = torch.cat([torch.ones_like(points_features[..., :1]), points_features], dim=2).to(volume_densities.dtype)
    votes = _votes(places, wanted, rows, sizes, volume_densities, mode)
    densities, features = volume_densities + votes[:, :1], votes[:, 1:]
    if volume_features is not None:
        features = volume_features + features
    if rescale_features:
        features = features / densities.clamp(min=min_weight if mode == "trilinear" else 1.0)
    return densities, features


def _votes(places: Tensor, wanted: Tensor, rows: Tensor, sizes: Tensor, grids: Tensor, mode: str) -> Tensor:
    """Sum over points of weight times row, voxel by voxel.

    Args:
        places: (N, P, 3), in voxels from the centre of the first one.
        wanted: (N, P), which points count.
        rows: (N, P, K).
        sizes: (N, 1, 3), voxels along x, y and z.
        grids: (N, _, D, H, W), whose shape the result takes.
        mode: "trilinear" or "nearest".

    Returns:
        (N, K, D, H, W).
    """
    is_trilinear = mode == "trilinear"
    depth, height, width = grids.shape[2:]
    lost = len(places) * depth * height * width  # one more voxel, for what no grid takes
    spots = places.flatten(0, 1).T  # (3, N P): long rows are what runs fast
    limits = sizes.expand_as(places).flatten(0, 1).T
    values = rows.flatten(0, 1).T.contiguous()  # (K, N P)
    wanted = wanted.flatten()
    volume = torch.arange(len(places), device=places.device).repeat_interleave(places.shape[1])
    first = spots.floor() if is_trilinear else spots.round()
    share = torch.stack([1 - (spots - first), spots - first]).to(rows.dtype)
    total = rows.new_zeros(len(values), lost + 1)
    for dx, dy, dz in product((0, 1), repeat=3) if is_trilinear else [(0, 0, 0)]:
        voxel = torch.stack([first[0] + dx, first[1] + dy, first[2] + dz])
        inside = ((voxel >= 0) & (voxel < limits)).all(0) & wanted
        x, y, z = voxel.where(inside, 0).long()
        index = (((volume * depth + z) * height + y) * width + x).where(inside, lost)
        added = values * (share[dx, 0] * share[dy, 1] * share[dz, 2]) if is_trilinear else values
        total.scatter_add_(1, index.expand_as(added), added)
    voxels = total[:, :lost].reshape(len(values), len(places), depth, height, width)
    return voxels.transpose(0, 1).contiguous()


def _check_points(points: Tensor, features: Tensor, densities: Tensor, mask: Tensor | None) -> None:
    if points.ndim != 3 or points.shape[2] != 3:
        raise ValueError(f"points_3d must have shape (N, P, 3), got {tuple(points.shape)}")
    if features.ndim != 3 or features.shape[:2] != points.shape[:2]:
        raise ValueError(
            f"points_features must have shape (N, P, C) with N, P = {tuple(points.shape[:2])} as points_3d; "
            f"got {tuple(features.shape)}"
        )
    if densities.ndim != 5 or len(densities) != len(points) or densities.shape[1] != 1:
        raise ValueError(
            f"volume_densities must have shape ({len(points)}, 1, D, H, W), one channel; got {tuple(densities.shape)}"
        )
    if mask is not None and mask.shape != points.shape[:2]:
        raise ValueError(f"mask must have shape (N, P) = {tuple(points.shape[:2])}, got {tuple(mask.shape)}")


def _check_grids(features: Tensor, densities: Tensor, grids: Tensor | None, grid_sizes: Tensor | None) -> None:
    expected = (len(densities), features.shape[2], *densities.shape[2:])
    if grids is not None and grids.shape != expected:
        raise ValueError(
            "volume_features must have the points' number of channels and the densities' sizes, "
            f"{expected}; got {tuple(grids.shape)}"
        )
    if grid_sizes is not None and grid_sizes.shape != (len(densities), 3):
        raise ValueError(f"grid_sizes must have shape ({len(densities)}, 3), got {tuple(grid_sizes.shape)}")
