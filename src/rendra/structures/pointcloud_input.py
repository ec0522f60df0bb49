"""What a caller may hand to `Pointclouds`, checked once and brought into one form."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rendra.structures.ragged import Lengths, Ragged


def points_from(points: Sequence[Tensor] | Tensor) -> Ragged:
    """
    The points of N clouds, from N tensors (P_i, 3) or one (N, P, 3).

    Raises:
        ValueError: neither of the two, or clouds on several devices.
    """
    if isinstance(points, Tensor):
        if points.ndim != 3 or points.shape[2] != 3:
            raise ValueError(f"Points tensor must have shape (N, P, 3), got {tuple(points.shape)}")
        return Ragged(Lengths([points.shape[1]] * len(points), points.device), padded=points)
    if not isinstance(points, (list, tuple)):
        raise ValueError(
            "Points must be either a list or a tensor with shape (batch_size, P, 3) where P is the maximum "
            f"number of points in a cloud; got {type(points)}"
        )
    items = [_cloud(cloud, i) for i, cloud in enumerate(points)]
    devices = {str(item.device) for item in items}
    if len(devices) > 1:
        raise ValueError(f"All points must be on the same device, got {sorted(devices)}")
    return Ragged.from_list(items, items[0] if items else torch.zeros(0, 3))


def _cloud(cloud: Tensor, i: int) -> Tensor:
    if not isinstance(cloud, Tensor):
        raise ValueError(f"points[{i}] must be a tensor of shape (P, 3), got {type(cloud)}")
    if len(cloud) == 0:
        return cloud.reshape(0, 3)
    if cloud.ndim != 2 or cloud.shape[1] != 3:
        raise ValueError(f"Clouds in list must be of shape (P, 3) or empty, got points[{i}] {tuple(cloud.shape)}")
    return cloud


def normals_from(normals: Sequence[Tensor | None] | Tensor | None, points: Ragged) -> Ragged | None:
    """
    One normal for each point; see `features_from`.

    Raises:
        ValueError: also where a normal has not three components.
    """
    rows = features_from(normals, points, "normals")
    if rows is not None and rows.packed().shape[1:] != (3,):
        raise ValueError(f"Normals are expected to be 3-dimensional, got {rows.packed().shape[1]} components")
    return rows


def features_from(
    features: Sequence[Tensor | None] | Tensor | None, points: Ragged, name: str = "features"
) -> Ragged | None:
    """
    One row for each point, from N tensors (P_i, C), where None stands for a cloud without points, or (N, P, C).

    Returns:
        None if None is given, or a list that holds nothing for clouds that hold nothing.

    Raises:
        ValueError: not one row for each point, several widths C, or another device than the points'.
    """
    if features is None:
        return None
    if isinstance(features, Tensor):
        return _from_padded(features, points, name)
    if not isinstance(features, (list, tuple)):
        raise ValueError(
            f"{name} must be either a list or a tensor with shape (batch_size, P, C) where P is the maximum "
            f"number of points in a cloud; got {type(features)}"
        )
    return _from_list(features, points, name)


def _from_padded(features: Tensor, points: Ragged, name: str) -> Ragged:
    lengths = points.lengths
    expected = (len(lengths), lengths.padded_size)
    if features.ndim != 3 or features.shape[:2] != expected:
        raise ValueError(
            f"{name} must have shape (N, P, C) with the points' N and P, {expected}; got {tuple(features.shape)}"
        )
    if features.device != lengths.device:
        raise ValueError(f"All points and {name} must be on the same device, got {lengths.device}, {features.device}")
    return Ragged.from_padded(lengths, features)


def _from_list(features: Sequence[Tensor | None], points: Ragged, name: str) -> Ragged | None:
    sizes = points.lengths.sizes
    if len(features) != len(sizes):
        raise ValueError(f"points and {name} must have the same length, got {len(sizes)} and {len(features)}")
    shaped = [f for f in features if isinstance(f, Tensor) and f.ndim == 2]
    if not shaped and points.lengths.total == 0:
        return None
    like = shaped[0] if shaped else points.packed()
    items = [_item(f, size, like, f"{name}[{i}]") for i, (f, size) in enumerate(zip(features, sizes, strict=True))]
    devices = {str(item.device) for item in items} | {str(points.lengths.device)}
    if len(devices) > 1:
        raise ValueError(f"All points and {name} must be on the same device, got {sorted(devices)}")
    widths = sorted({item.shape[1] for item in items})
    if len(widths) > 1:
        raise ValueError(f"The {name} of all clouds must have the same number of channels, got {widths}")
    return Ragged(points.lengths, items=items)


def _item(rows: Tensor | None, size: int, like: Tensor, name: str) -> Tensor:
    if size == 0 and (rows is None or rows.shape == (0,)):
        return like.new_zeros(0, like.shape[1])
    if not isinstance(rows, Tensor) or rows.ndim != 2:
        got = tuple(rows.shape) if isinstance(rows, Tensor) else type(rows)
        raise ValueError(f"{name} must be of shape (P, C), or empty for a cloud without points; got {got}")
    if len(rows) != size:
        raise ValueError(f"{name} has mismatched numbers of points and inputs: {size} points, {len(rows)} rows")
    return rows
