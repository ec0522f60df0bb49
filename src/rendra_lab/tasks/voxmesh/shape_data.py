"""Pictures of single objects as batches: what generated furniture and ShapeNet have in common."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from rendra_lab.data.photo_data import joined_shapes
from rendra_lab.data.sample_data import SampleData, SampleSplits
from rendra_lab.shape_records import ShapeBatch

ShapeSplits = SampleSplits[ShapeBatch]  # that share no model


class ShapeData(SampleData[ShapeBatch]):
    """Pictures of one object each; subclasses say where they come from."""

    what = "pictures"
    classes: tuple[str, ...]  # by label: subclasses know them once they are set up

    @staticmethod
    def joined(batches: Sequence[ShapeBatch]) -> ShapeBatch:
        """See `joined`."""
        return joined(batches)


def joined(batches: Sequence[ShapeBatch]) -> ShapeBatch:
    """One batch of all pictures of some batches, whose pictures, points and grids have the same sizes.

    Raises:
        ValueError: no batches.
    """
    if not batches:
        raise ValueError("no pictures of shapes to join")

    def column(name: str) -> Tensor:
        return torch.cat([getattr(batch, name) for batch in batches])

    return ShapeBatch(
        rgb=column("rgb"),
        intrinsics=column("intrinsics"),
        depth_range=column("depth_range"),
        labels=column("labels"),
        shapes=joined_shapes([batch.shapes for batch in batches]),
        shape_ids=[name for batch in batches for name in batch.shape_ids],
    )
