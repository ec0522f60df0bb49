"""Generated furniture of nine classes, a piece a picture, as R2N2's pictures of ShapeNet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.data.announced import announced
from rendra_lab.data.kept_tensors import Tensors, fingerprint, kept_or_made
from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, Range, check_numbers
from rendra_lab.shape_records import ShapeBatch
from rendra_lab.synthesis.furniture import CLASSES
from rendra_lab.synthesis.single_furniture import DEPTH_RANGE, EDITION, FurnitureStudio, FurnitureViews
from rendra_lab.synthesis.solid_shapes import SolidShape
from rendra_lab.tasks.voxmesh.shape_data import ShapeData, ShapeSplits

_SPLITS = ("train", "val", "test")

_Views = Annotated[int, Range(1, 64)]
_Cells = Annotated[int, Range(4, 256)]


class FurnitureSingle(ShapeData):
    """Pieces of furniture that nobody has seen before, each from some sides.

    A piece belongs to one split alone, and stays what it is when there are more or fewer of the others. Classes take
    turns.

    Args:
        image_size: side of square pictures, pixels.
        counts: pieces in training, validation and test.
        views: pictures of a training piece.
        eval_views: of a piece of validation and test.
        points: on each surface in a batch; training draws them anew among four times as many.
        voxels: cells along each side of the grids in the axes of pieces.
        cache: folder of pictures and shapes; null makes them every time.
        models_seed: of the pieces.
        **loading: see `ShapeData`.

    Raises:
        UserError: an impossible setting.
    """

    classes = CLASSES

    def __init__(
        self,
        image_size: Annotated[int, Range(16, 1024)] = 137,
        counts: Sequence[int] = (600, 45, 90),
        views: _Views = 4,
        eval_views: _Views = 2,
        points: Positive = 1000,
        voxels: _Cells = 64,
        cache: str | Path | None = None,
        models_seed: Count = 0,
        **loading: Any,
    ) -> None:
        super().__init__(**loading)
        check_numbers("data", Annotated[int, Range(16, 1024)], image_size=image_size)
        check_numbers("data", _Views, views=views, eval_views=eval_views)
        check_numbers("data", Annotated[int, Range(1, 100_000)], points=points)
        check_numbers("data", _Cells, voxels=voxels)
        check_numbers("data", Count, models_seed=models_seed)
        if len(counts) != 3 or not all(isinstance(count, int) and count >= 0 for count in counts) or counts[0] < 1:
            raise UserError(
                f"data.counts are three: pieces in training (at least 1), validation and test; got {list(counts)}"
            )
        self.counts = dict(zip(_SPLITS, counts, strict=True))
        self.views = {"train": views, "val": eval_views, "test": eval_views}
        self.points = points
        self.cache = None if cache is None else Path(cache)
        self.models_seed = models_seed
        self.studio = FurnitureStudio((image_size, image_size), voxels, 4 * points)

    def prepare_data(self) -> None:
        """Lightning's hook, in one process of each machine: makes what the cache lacks."""
        if self.cache is not None:
            self.setup("fit")

    def load(self) -> ShapeSplits:
        """All pieces, made or from the cache."""
        keys = [(split, index) for split in _SPLITS for index in range(self.counts[split])]
        pieces = announced((self._views(*key) for key in keys), len(keys), "generated furniture")
        by_key = dict(zip(keys, pieces, strict=True))
        self.studio.clear()
        parts = {split: [by_key[split, index] for index in range(self.counts[split])] for split in _SPLITS}
        return ShapeSplits(
            train=PiecePictures(parts["train"], self._names("train"), self.points, fresh=True),
            val=PiecePictures(parts["val"], self._names("val"), self.points, fresh=False),
            test=PiecePictures(parts["test"], self._names("test"), self.points, fresh=False),
        )

    def model_seed(self, split: str, index: int) -> int:
        """Of a piece, by its number within its split; no other piece has it."""
        key = [self.models_seed, _SPLITS.index(split), index]
        return int(np.random.SeedSequence(key).generate_state(1, np.uint64)[0] >> np.uint64(1))

    def _names(self, split: str) -> list[str]:
        return [f"{_kind(index)}_{split}_{index:04d}" for index in range(self.counts[split])]

    def _views(self, split: str, index: int) -> KeptPiece:
        seed, count = self.model_seed(split, index), self.views[split]

        def make() -> Tensors:
            return KeptPiece.packed(self.studio.views(seed, _kind(index), count))

        if self.cache is None:
            return KeptPiece(make())
        path = self.cache / f"furniture_{self._fingerprint(count)}" / f"{_kind(index)}_{seed:016x}.safetensors"
        return KeptPiece(kept_or_made(path, "pictures of furniture", make))

    def _fingerprint(self, count: int) -> str:
        """16 hexadecimal digits that stand for all but the seed and the class that determines a piece's pictures."""
        studio = self.studio
        return fingerprint(EDITION, studio.size, studio.cells, studio.points, count)


class KeptPiece:
    """A piece and its pictures, in little memory.

    Args:
        kept: what `packed` made.
    """

    def __init__(self, kept: Tensors) -> None:
        self.kept = kept

    @staticmethod
    def packed(piece: FurnitureViews) -> Tensors:
        """Coordinates in half of the bits, to a part in 2000 of half of the longest side, and a bit for each cell."""
        shape = piece.shape
        return {
            "rgb": piece.rgb,
            "intrinsics": piece.intrinsics,
            "own_to_camera": piece.own_to_camera,
            "label": piece.label,
            "points": shape.points.half(),
            "normals": shape.normals.half(),
            "bits": torch.from_numpy(np.packbits(shape.voxels.numpy().reshape(-1))),
            "side": torch.tensor(len(shape.voxels)),
            "verts": shape.verts,
            "faces": shape.faces.int(),
            "cube_to_own": shape.cube_to_own,
        }

    def __len__(self) -> int:
        """Pictures."""
        return len(self.kept["rgb"])

    def shape(self, rows: Tensor) -> SolidShape:
        """With some of the points that are kept."""
        kept, side = self.kept, int(self.kept["side"])
        cells = np.unpackbits(kept["bits"].numpy(), count=side**3).reshape(side, side, side)
        return SolidShape(
            points=kept["points"][rows].float(),
            normals=F.normalize(kept["normals"][rows].float(), dim=1),
            voxels=torch.from_numpy(cells.view(np.bool_)),
            verts=kept["verts"],
            faces=kept["faces"].long(),
            cube_to_own=kept["cube_to_own"],
        )


class PiecePictures:
    """Pictures of pieces, all of the first one first, each a batch of one.

    Args:
        pieces: with as many pictures each.
        names: of the pieces.
        points: on each surface.
        fresh: draw them anew whenever a picture is asked for; else the first ones.
    """

    def __init__(self, pieces: Sequence[KeptPiece], names: Sequence[str], points: int, fresh: bool) -> None:
        self.pieces = pieces
        self.names = names
        self.points = points
        self.fresh = fresh
        self.views = len(pieces[0]) if pieces else 1

    def __len__(self) -> int:
        return len(self.pieces) * self.views

    def __getitem__(self, index: int) -> ShapeBatch:
        if not 0 <= index < len(self):
            raise IndexError(f"there are {len(self)} pictures, asked for number {index}")
        number, view = divmod(index, self.views)
        piece = self.pieces[number]
        total = len(piece.kept["points"])
        rows = (torch.randperm(total) if self.fresh else torch.arange(total))[: self.points]
        return ShapeBatch(
            rgb=piece.kept["rgb"][[view]] / 255,
            intrinsics=piece.kept["intrinsics"][None],
            depth_range=torch.tensor([DEPTH_RANGE]),
            labels=piece.kept["label"][None],
            shapes=piece.shape(rows).seen(piece.kept["own_to_camera"][view]),
            shape_ids=[self.names[number]],
        )


def _kind(index: int) -> str:
    return CLASSES[index % len(CLASSES)]
