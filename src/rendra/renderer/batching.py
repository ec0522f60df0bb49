"""Sparse image data moved together, and values that belong to whole images.

Most slots of a rasterised image are empty. A `Compaction` lists the filled entries of a batch, so that the
work between reading and writing the image is done on these alone.

Notation: N images, L entries in each, M entries marked in all, S marked entries in the fullest image.
"""

import torch
from torch import Tensor


class Compaction:
    """The marked entries of an (N, L) batch as rows, image after image, and the way back."""

    def __init__(self, mask: Tensor) -> None:
        """List the entries where the (N, L) mask is True."""
        self.num_images, self.num_entries = mask.shape
        self.index = mask.reshape(-1).nonzero()[:, 0]  # (M,)
        self.counts = mask.sum(1)  # (N,)

    @property
    def _is_complete(self) -> bool:
        return len(self.index) == self.num_images * self.num_entries

    def take(self, values: Tensor) -> Tensor:
        """Pick the marked entries of (N, L, ...): (M, ...)."""
        rows = values.reshape(self.num_images * self.num_entries, *values.shape[2:])
        return rows if self._is_complete else rows.index_select(0, self.index)

    def put(self, rows: Tensor, fill: Tensor | float = 0.0) -> Tensor:
        """Write rows (M, ...) to their entries: (N, L, ...); the others hold `fill`, broadcast to that shape."""
        shape = (self.num_images, self.num_entries, *rows.shape[1:])
        if self._is_complete:
            return rows.reshape(shape)
        if isinstance(fill, Tensor):
            base = fill.to(rows).expand(shape).reshape(-1, *rows.shape[1:]).contiguous()
        else:
            base = rows.new_full((self.num_images * self.num_entries, *rows.shape[1:]), fill)
        return base.index_copy(0, self.index, rows).view(shape)


def ragged(counts: Tensor) -> Compaction:
    """The compaction between flat rows (M, ...) and the same rows padded image by image (N, S, ...).

    `put` pads, `take` removes the padding; row n of the padded form holds `counts[n]` rows.
    """
    longest = int(counts.max()) if len(counts) else 0
    return Compaction(torch.arange(longest, device=counts.device) < counts[:, None])


def per_image(values: Tensor, ndim: int) -> Tensor:
    """Shape (N, C) values as (N, 1, ..., C), and (N,) as (N, 1, ...), to broadcast against `ndim` dimensions.

    Values that have so many dimensions already come back as they are.
    """
    missing = ndim - values.ndim
    return values.reshape(values.shape[0], *(1,) * missing, *values.shape[1:]) if missing > 0 else values
