"""
Batches of point clouds with different numbers of points.

Letters: N clouds, P points of the largest one, sum P of all together, C feature channels.
List: one tensor a cloud. Padded: (N, P, 3), filled up with 0. Packed: all rows in one tensor.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from rendra.structures.pointcloud_input import features_from, normals_from, points_from
from rendra.structures.ragged import Lengths, Ragged, batch_indices, consecutive_parts, each_repeated


class Pointclouds:
    """
    N point clouds with, optionally, a normal and C features for each point.

    Change points with `offset`, `scale` or `update_padded`, not in place: forms that were asked for are kept.
    Points that are leaves requiring grad may be changed by an optimiser; nothing derived from them is kept.

    Attributes:
        device: where all tensors lie.
        equisized: all clouds have as many points as each other.
        valid: (N,) bool, which clouds have a point.
    """

    def __init__(
        self,
        points: Sequence[Tensor] | Tensor,
        normals: Sequence[Tensor | None] | Tensor | None = None,
        features: Sequence[Tensor | None] | Tensor | None = None,
    ) -> None:
        """
        Take points, and what belongs to them, as lists or padded.

        Args:
            points: N tensors (P_i, 3), or one (N, P, 3) of clouds with P points each.
            normals: N tensors (P_i, 3), or one (N, P, 3). None may stand for a cloud without points.
            features: N tensors (P_i, C), or one (N, P, C), of any type.

        Raises:
            ValueError: forms, shapes, devices or numbers do not fit together.
        """
        rows = points_from(points)
        self._set(rows, normals_from(normals, rows), features_from(features, rows))

    def _set(self, points: Ragged, normals: Ragged | None, features: Ragged | None) -> None:
        self._points = points
        self._normals = normals
        self._features = features

    def _replaced(self, points: Ragged, normals: Ragged | None, features: Ragged | None) -> "Pointclouds":
        """Clouds of this class from parts that are known to fit."""
        new = self.__class__.__new__(self.__class__)
        new._set(points, normals, features)
        return new

    def _each(self, fn: Callable[[Ragged], Ragged]) -> "Pointclouds":
        """The clouds after `fn` of points, normals and features alike."""
        normals = None if self._normals is None else fn(self._normals)
        features = None if self._features is None else fn(self._features)
        return self._replaced(fn(self._points), normals, features)

    @property
    def device(self) -> torch.device:
        """Where all tensors lie."""
        return self._points.lengths.device

    @property
    def equisized(self) -> bool:
        """All clouds have as many points as each other."""
        return len(set(self._points.lengths.sizes)) == 1

    @property
    def valid(self) -> Tensor:
        """Which clouds have a point. (N,) bool"""
        return self._points.lengths.counts > 0

    def __len__(self) -> int:
        """The number of clouds N."""
        return len(self._points)

    def __getitem__(self, index: int | slice | list[int] | Tensor) -> "Pointclouds":
        """
        Pick clouds by an int, a slice, a list of ints, or a 1-D tensor of integers or booleans.

        Raises:
            IndexError: another kind of index, or one out of range.
        """
        picked = batch_indices(index, len(self))
        return self._each(lambda rows: rows.select(picked))

    def isempty(self) -> bool:
        """Whether no cloud has a point."""
        return self._points.lengths.total == 0

    # -- points, normals, features

    def points_list(self) -> list[Tensor]:
        """Points of each cloud. N of (P_i, 3)"""
        return self._points.items()

    def points_padded(self) -> Tensor:
        """Points, filled up with 0. (N, P, 3)"""
        return self._points.padded()

    def points_packed(self) -> Tensor:
        """Points of all clouds. (sum P, 3)"""
        return self._points.packed()

    def normals_list(self) -> list[Tensor] | None:
        """Normals of each cloud, N of (P_i, 3), or None."""
        return None if self._normals is None else self._normals.items()

    def normals_padded(self) -> Tensor | None:
        """Normals filled up with 0, (N, P, 3), or None."""
        return None if self._normals is None else self._normals.padded()

    def normals_packed(self) -> Tensor | None:
        """Normals of all clouds, (sum P, 3), or None."""
        return None if self._normals is None else self._normals.packed()

    def features_list(self) -> list[Tensor] | None:
        """Features of each cloud, N of (P_i, C), or None."""
        return None if self._features is None else self._features.items()

    def features_padded(self) -> Tensor | None:
        """Features filled up with 0, (N, P, C), or None."""
        return None if self._features is None else self._features.padded()

    def features_packed(self) -> Tensor | None:
        """Features of all clouds, (sum P, C), or None."""
        return None if self._features is None else self._features.packed()

    def num_points_per_cloud(self) -> Tensor:
        """Number of points of each cloud. (N,)"""
        return self._points.lengths.counts

    def packed_to_cloud_idx(self) -> Tensor:
        """The cloud of each packed point. (sum P,)"""
        return self._points.lengths.item_idx

    def cloud_to_packed_first_idx(self) -> Tensor:
        """The packed index of each cloud's first point. (N,)"""
        return self._points.lengths.first_idx

    def padded_to_packed_idx(self) -> Tensor:
        """Which row of `points_padded().view(-1, 3)` each packed point is. (sum P,)"""
        return self._points.lengths.padded_idx

    def get_cloud(self, index: int) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """
        Points (P_i, 3), normals (P_i, 3) and features (P_i, C) of one cloud; None for what it lacks.

        Raises:
            ValueError: `index` is not an integer in [0, N).
        """
        if not isinstance(index, int):
            raise ValueError(f"Cloud index must be an integer, got {type(index)}")
        if not 0 <= index < len(self):
            raise ValueError(f"Cloud index must be in the range [0, {len(self)}), got {index}")
        normals, features = self.normals_list(), self.features_list()
        return (
            self.points_list()[index],
            None if normals is None else normals[index],
            None if features is None else features[index],
        )

    def get_bounding_boxes(self) -> Tensor:
        """Smallest and largest coordinates of each cloud; (inf, -inf) without points. (N, 3, 2)"""
        return self._points.bounds()

    def inside_box(self, box: Tensor) -> Tensor:
        """
        Which points lie in an axis-aligned box, its faces included.

        Args:
            box: (2, 3), smallest and largest coordinates, or (N, 2, 3) with a box for each cloud.

        Returns:
            (sum P,) bool.

        Raises:
            ValueError: another shape, or a box whose smallest coordinates are larger than its largest.
        """
        boxes = box[None] if box.ndim == 2 else box
        if boxes.ndim != 3 or boxes.shape[1:] != (2, 3):
            raise ValueError(f"Input box must be of shape (2, 3) or (N, 2, 3), got {tuple(box.shape)}")
        if len(boxes) not in (1, len(self)):
            raise ValueError(f"Input box is incompatible with a batch of {len(self)} clouds: got {len(boxes)} boxes")
        if (boxes[:, 0] > boxes[:, 1]).any():
            raise ValueError("Input box is invalid: min values larger than max values.")
        low, high = (boxes if len(boxes) == 1 else boxes[self.packed_to_cloud_idx()]).unbind(1)
        points = self.points_packed()
        return ((points >= low) & (points <= high)).all(1)

    # -- copies

    def clone(self) -> "Pointclouds":
        """A copy with memory of its own, still part of the autograd graph."""
        return self._each(lambda rows: rows.apply(torch.clone))

    def detach(self) -> "Pointclouds":
        """The same values, cut from the autograd graph; shares memory."""
        return self._each(lambda rows: rows.apply(torch.detach))

    def to(self, device: torch.device | str, copy: bool = False) -> "Pointclouds":
        """The clouds on `device`: themselves if they are there already and `copy` is False."""
        target = torch.empty(0, device=device).device  # "cuda" names the current CUDA device
        if target == self.device:
            return self.clone() if copy else self
        return self._each(lambda rows: rows.apply(lambda t: t.to(target)))

    def cpu(self) -> "Pointclouds":
        """The clouds on the CPU."""
        return self.to("cpu")

    def cuda(self) -> "Pointclouds":
        """The clouds on the current CUDA device."""
        return self.to("cuda")

    # -- moving points

    def offset_(self, offsets_packed: Tensor) -> "Pointclouds":
        """Add offsets to the points of this object; see `offset`."""
        self._points = self.offset(offsets_packed)._points
        return self

    def offset(self, offsets_packed: Tensor) -> "Pointclouds":
        """
        Clouds with moved points, and the same normals and features.

        Args:
            offsets_packed: (sum P, 3), or (3,) for all.

        Raises:
            ValueError: another shape.
        """
        points = self.points_packed()
        if offsets_packed.shape not in (points.shape, (3,)):
            raise ValueError(
                f"Offsets must have dimension (all_p, 3) = {tuple(points.shape)} or (3,), "
                f"got {tuple(offsets_packed.shape)}"
            )
        moved = Ragged(self._points.lengths, packed=points + offsets_packed)
        return self._replaced(moved, self._normals, self._features)

    def scale_(self, scale: float | Tensor) -> "Pointclouds":
        """Scale the points of this object; see `scale`."""
        self._points = self.scale(scale)._points
        return self

    def scale(self, scale: float | Tensor) -> "Pointclouds":
        """
        Clouds with points scaled about the origin, and the same normals and features.

        Args:
            scale: a number, or (N,) one for each cloud.

        Raises:
            ValueError: another shape.
        """
        return self._replaced(self._points.scaled(scale), self._normals, self._features)

    def update_padded(
        self,
        new_points_padded: Tensor,
        new_normals_padded: Tensor | None = None,
        new_features_padded: Tensor | None = None,
    ) -> "Pointclouds":
        """
        Clouds with as many points as these, and other values; what lies in the padding is ignored.

        Args:
            new_points_padded: (N, P, 3) as `points_padded()`.
            new_normals_padded: (N, P, 3); None keeps the normals.
            new_features_padded: (N, P, C), with the present C if there are features; None keeps them.

        Raises:
            ValueError: another shape.
        """
        width = None if self._features is None else self._features.packed().shape[1]
        points = self._updated("points", new_points_padded, 3, self._points)
        normals = self._updated("normals", new_normals_padded, 3, self._normals)
        features = self._updated("features", new_features_padded, width, self._features)
        assert points is not None
        return self._replaced(points, normals, features)

    def _updated(self, name: str, padded: Tensor | None, width: int | None, old: Ragged | None) -> Ragged | None:
        if padded is None:
            return old
        lengths = self._points.lengths
        size = (len(lengths), lengths.padded_size)
        if padded.ndim != 3 or padded.shape[:2] != size:
            raise ValueError(
                f"new {name} must have the same batch dimension and number of points, {(*size, width or 'C')}; "
                f"got {tuple(padded.shape)}"
            )
        if width is not None and padded.shape[2] != width:
            raise ValueError(f"new {name} must have the same dimension, {width}; got {padded.shape[2]}")
        return Ragged.from_padded(lengths, padded)

    # -- other batches of the same clouds

    def extend(self, N: int) -> "Pointclouds":
        """
        Every cloud N times in a row, with gradients to this one.

        Raises:
            ValueError: N is not a positive integer.
        """
        repeated = each_repeated(len(self), N)
        return self._each(lambda rows: rows.select(repeated))

    def split(self, split_sizes: list[int]) -> list["Pointclouds"]:
        """
        Cut the batch into consecutive batches of the given sizes.

        Raises:
            ValueError: `split_sizes` is not a list of integers that sum to N.
        """
        return [self[part] for part in consecutive_parts(split_sizes, len(self), "clouds")]

    def subsample(self, max_points: int | Sequence[int]) -> "Pointclouds":
        """
        Clouds of at most `max_points` points, drawn without replacement by torch's generator of their device.

        Args:
            max_points: one number for all clouds, or one for each.

        Returns:
            These clouds themselves if all are small enough. A cloud that is keeps its order.

        Raises:
            ValueError: not one number for each cloud, or a negative one.
        """
        sizes = self._points.lengths.sizes
        limits = [max_points] * len(self) if isinstance(max_points, int) else [int(limit) for limit in max_points]
        if len(limits) != len(self):
            raise ValueError(f"wrong number of max_points supplied: {len(limits)} for {len(self)} clouds")
        if min(limits, default=0) < 0:
            raise ValueError(f"max_points must not be negative, got {max_points}")
        if all(size <= limit for size, limit in zip(sizes, limits, strict=True)):
            return self
        kept = [_drawn(size, limit, self.device) for size, limit in zip(sizes, limits, strict=True)]
        rows = torch.cat([drawn + start for drawn, start in zip(kept, self.cloud_to_packed_first_idx(), strict=True)])
        lengths = Lengths([len(drawn) for drawn in kept], self.device)
        return self._each(lambda ragged: Ragged(lengths, packed=ragged.packed().index_select(0, rows)))

    def estimate_normals(
        self,
        neighborhood_size: int = 50,
        disambiguate_directions: bool = True,
        assign_to_self: bool = False,
    ) -> Tensor:
        """
        Normals from the covariance of each point's neighbours; see `rendra.ops.estimate_pointcloud_normals`.

        Args:
            neighborhood_size: how many nearest points, the point itself among them, span the surface.
            disambiguate_directions: turn each normal to the side where most neighbours lie.
            assign_to_self: also make them the normals of these clouds.

        Returns:
            (N, P, 3), 0 in the padding.

        Raises:
            ValueError: a cloud has fewer points than `neighborhood_size`.
        """
        from rendra.ops.points_normals import estimate_pointcloud_normals  # a layer above, which needs this class

        normals = estimate_pointcloud_normals(self, neighborhood_size, disambiguate_directions)
        if assign_to_self:
            self._normals = Ragged.from_padded(self._points.lengths, normals)
        return normals


def _drawn(size: int, limit: int, device: torch.device) -> Tensor:
    """Which of `size` points stay: all in their order, or `limit` at random."""
    return torch.arange(size, device=device) if size <= limit else torch.randperm(size, device=device)[:limit]


def join_pointclouds_as_batch(pointclouds: Sequence[Pointclouds]) -> Pointclouds:
    """
    One batch of all clouds of several batches, in order.

    Args:
        pointclouds: batches on one device that all have, or all lack, normals, and so with features.

    Raises:
        ValueError: not a list of `Pointclouds`, different devices, or only some have normals or features.
    """
    if isinstance(pointclouds, Pointclouds) or not pointclouds:
        raise ValueError(
            "Wrong first argument to join_pointclouds_as_batch: expected a non-empty list of Pointclouds"
        )
    if not all(isinstance(clouds, Pointclouds) for clouds in pointclouds):
        raise ValueError("Wrong first argument to join_pointclouds_as_batch: expected a list of Pointclouds only")
    devices = sorted({str(clouds.device) for clouds in pointclouds})
    if len(devices) > 1:
        raise ValueError(f"Pointclouds must all be on the same device, got {devices}")
    # what has no points lacks nothing: it has no say in whether normals and features exist
    filled = [clouds for clouds in pointclouds if not clouds.isempty()] or list(pointclouds)
    points = _joined([clouds._points for clouds in pointclouds])
    normals = _joined_rows("normals", [c._normals for c in filled], points.lengths)
    features = _joined_rows("features", [c._features for c in filled], points.lengths)
    return pointclouds[0]._replaced(points, normals, features)


def _joined(batches: list[Ragged]) -> Ragged:
    return Ragged.from_list([item for rows in batches for item in rows.items()], batches[0].packed())


def _joined_rows(name: str, batches: list[Ragged | None], lengths: Lengths) -> Ragged | None:
    present = [rows for rows in batches if rows is not None]
    if not present:
        return None
    if len(present) < len(batches) and lengths.total > 0:
        raise ValueError(f"Pointclouds in the batch should either all have {name} or not, some have none")
    widths = sorted({rows.packed().shape[1] for rows in present})
    if len(widths) > 1:
        raise ValueError(f"Pointclouds must have the same number of {name} channels, got {widths}")
    return Ragged(lengths, packed=torch.cat([rows.packed() for rows in present]))


def join_pointclouds_as_scene(pointclouds: Pointclouds | Sequence[Pointclouds]) -> Pointclouds:
    """
    One cloud of all points of a batch, or of several.

    Args:
        pointclouds: a batch or a list of batches.

    Returns:
        A batch of one cloud, with normals and features if the input has them.

    Raises:
        ValueError: see `join_pointclouds_as_batch`.
    """
    batch = pointclouds if isinstance(pointclouds, Pointclouds) else join_pointclouds_as_batch(pointclouds)
    whole = Lengths([batch._points.lengths.total], batch.device)
    return batch._each(lambda rows: Ragged(whole, packed=rows.packed()))
