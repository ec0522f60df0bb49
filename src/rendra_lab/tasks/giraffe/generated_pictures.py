"""Pictures of generated worlds of objects: unposed for training, with their truth for scores."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor

from rendra_lab.data.announced import announced
from rendra_lab.data.kept_tensors import Tensors, fingerprint, kept_or_made
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Range, check_numbers
from rendra_lab.synthesis.object_pictures import ObjectPictures, ObjectWorld
from rendra_lab.tasks.giraffe.picture_data import PictureData, PictureSplits
from rendra_lab.tasks.giraffe.records import PictureBatch, PictureTruth

_SPLITS = ("train", "val", "test")
_BLOCK = 250  # pictures of a file

_Side = Annotated[int, Range(8, 1024)]


class GeneratedPictures(PictureData):
    """Pictures that nobody has seen before.

    A picture belongs to one split alone, and stays what it is when there are more or fewer of the others.

    Args:
        world: makes the pictures.
        image_size: S, side of square pictures, pixels.
        counts: pictures in training, validation and test.
        cache: folder of pictures; null makes them every time.
        pictures_seed: of the pictures.
        **loading: settings of `SampleData`.

    Raises:
        UserError: an impossible setting.
    """

    def __init__(
        self,
        world: ObjectWorld,
        image_size: _Side = 64,
        counts: Sequence[int] = (6000, 500, 2000),
        cache: str | Path | None = None,
        pictures_seed: Count = 0,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        check_numbers("data", _Side, image_size=image_size)
        check_numbers("data", Count, pictures_seed=pictures_seed)
        if len(counts) != 3 or not all(isinstance(count, int) and count >= 0 for count in counts) or counts[0] < 1:
            raise UserError(
                f"data.counts are three: pictures in training (at least 1), validation and test; got {list(counts)}"
            )
        self.world = world
        self.image_size = image_size
        self.counts = dict(zip(_SPLITS, counts, strict=True))
        self.cache = None if cache is None else Path(cache)
        self.pictures_seed = pictures_seed

    def prepare_data(self) -> None:
        """Lightning's hook, in one process of each machine: makes what the cache lacks."""
        if self.cache is not None:
            self.setup("fit")

    def load(self) -> PictureSplits:
        """All pictures, made or from the cache."""
        keys = [(split, first) for split in _SPLITS for first in range(0, self.counts[split], _BLOCK)]
        made = announced((self._block(*key) for key in keys), len(keys), f"blocks of {_BLOCK} generated pictures")
        blocks = dict(zip(keys, made, strict=True))
        return PictureSplits(
            **{split: KnownPictures([blocks[key] for key in keys if key[0] == split]) for split in _SPLITS}
        )

    def picture_seed(self, split: str, index: int) -> int:
        """Of a picture, by its number within its split; no other picture has it."""
        key = [self.pictures_seed, _SPLITS.index(split), index]
        return int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> np.uint64(1))

    def _block(self, split: str, first: int) -> ObjectPictures:
        count = min(_BLOCK, self.counts[split] - first)
        seeds = [self.picture_seed(split, first + i) for i in range(count)]

        def make() -> Tensors:
            made = self.world.pictures(seeds, self.image_size)
            return {name: getattr(made, name) for name in ObjectPictures.names()}

        if self.cache is None:
            return ObjectPictures(**make())
        name = f"{split}_{self.pictures_seed}_{first:06d}_{count}.safetensors"
        kept = kept_or_made(self.cache / f"pictures_{self._fingerprint()}" / name, "pictures", make)
        return ObjectPictures(**kept)

    def _fingerprint(self) -> str:
        """16 hexadecimal digits that stand for everything but the seeds that determines pictures."""
        made_by = (type(self.world).__qualname__, self.world.settings(), self.image_size)
        return fingerprint(made_by)


class KnownPictures:
    """Pictures by their numbers, with their truth, as batches of one.

    Args:
        blocks: of pictures of one size with as many objects at most; none is no pictures.
    """

    def __init__(self, blocks: Sequence[ObjectPictures]) -> None:
        self.blocks = blocks
        self._ends = np.cumsum([len(block.rgb) for block in blocks])

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def __getitem__(self, index: int) -> PictureBatch:
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} pictures, asked for number {index}")
        number = int(np.searchsorted(self._ends, index, side="right"))
        block = self.blocks[number]
        row = [index - int(self._ends[number]) + len(block.rgb)]
        masks = masks_of(block.owners[row], block.kind.shape[1])
        truth = PictureTruth(masks, boxes_around(masks), block.heading[row], block.kind[row])
        return PictureBatch(block.rgb[row] / 255, truth)


def masks_of(owners: Tensor, most: int) -> Tensor:
    """Pixels of each object (B, M, S, S).

    Args:
        owners: (B, S, S) which of them a pixel shows, from 1; 0: none.
        most: M.
    """
    return owners[:, None] == torch.arange(1, most + 1, device=owners.device)[:, None, None]


def boxes_around(masks: Tensor) -> Tensor:
    """The smallest x0, y0, x1, y1 (B, M, 4), pixels, that hold masks (B, M, S, S); 0 around nothing."""
    spans = []
    for seen in (masks.any(2), masks.any(3)):  # of columns, and of rows
        number = torch.arange(seen.shape[-1], device=masks.device)
        first = torch.where(seen, number, seen.shape[-1]).amin(-1)
        spans.append(torch.stack([first, torch.where(seen, number + 1, 0).amax(-1)], dim=-1))
    boxes = torch.stack(spans, dim=-1).flatten(2)  # x0, y0, x1, y1
    return (boxes * masks.any(3).any(2)[..., None]).float()
