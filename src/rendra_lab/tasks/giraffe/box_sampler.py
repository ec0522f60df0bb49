"""Where the objects of a scene are: drawn from ranges, or laid out as somebody measured.

Niemeyer and Geiger, "GIRAFFE", CVPR 2021, Sec. 3.1 and the ranges of its published code. A turn is 2 pi.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Positive
from rendra_lab.tasks.giraffe.records import Boxes

_Corner = Sequence[float]
_TRIES = 200  # draws of scenes before their boxes are said not to fit
_PLACES = 64  # drawn of a box, of which the first free one is taken
_LAYOUT = "coordinates"


class BoxSampler:
    """Draws sizes, places and turns of boxes, uniformly between two ends; objects may be told to keep apart.

    The published code looks only at sizes before the turn when it looks for collisions (`turned_extents` false), and
    draws a whole scene again where two of its boxes collide (`redraw: scene`) instead of the one that came last.

    Args:
        objects: N that a scene can have.
        scale: least and greatest half sides along the box's own axes.
        translation: least and greatest middle.
        turns: least and greatest angle about z.
        one_size: one number for the three sides, so that proportions are kept between the two ends.
        counts: how often a scene has 0, 1, .. N objects, in any unit; None: always N.
        plane: z of all middles, unless a layout says them; None: as drawn.
        spacing: two boxes are at least so far apart along x, y or z; None lets them overlap. Layouts are as measured.
        redraw: what is drawn again after a collision.
        turned_extents: boxes keep apart as they are turned.
        layouts: .npz file with `coordinates` (L, N, 3), middles of the boxes of L scenes; None draws them.
        layout_scale: what those are multiplied by; the published scale takes CLEVR's world to the model's.

    Raises:
        UserError: ranges, counts or a file that cannot be.
    """

    def __init__(
        self,
        objects: Positive = 1,
        scale: Sequence[_Corner] = ((0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
        translation: Sequence[_Corner] = ((-0.75, -0.75, 0.0), (0.75, 0.75, 0.0)),
        turns: Sequence[float] = (0.0, 1.0),
        one_size: bool = True,
        counts: Sequence[Amount] | None = None,
        plane: float | None = None,
        spacing: Amount | None = None,
        redraw: Literal["object", "scene"] = "object",
        turned_extents: bool = True,
        layouts: str | Path | None = None,
        layout_scale: float = 0.2378777237835723,
    ) -> None:
        if len(turns) != 2:
            raise UserError(f"boxes.turns must be two numbers, the least and the greatest, got {list(turns)}")
        if objects < 1:
            raise UserError(f"boxes.objects must be at least 1, got {objects}")
        self.objects = objects
        self.scale = _ends("scale", scale, least=0.0)
        self.translation = _ends("translation", translation)
        self.turns = float(turns[0]), float(turns[1])
        self.one_size = one_size
        self.counts = None if counts is None else _shares(counts, objects)
        self.plane = plane
        self.spacing = spacing
        if redraw not in ("object", "scene"):
            raise UserError(f"boxes.redraw must be object or scene, got {redraw!r}")
        self.redraw = redraw
        self.turned_extents = turned_extents
        self.layouts = None if layouts is None else layout_scale * _read_layouts(Path(layouts), objects)

    def sample(self, count: int, generator: torch.Generator) -> Boxes:
        """Boxes of B = `count` scenes, on the generator's device.

        Raises:
            UserError: boxes that keep apart do not fit into their ranges.
        """
        exists = self._exists(count, generator)
        boxes = self._draw(exists, generator)
        if self.spacing is None or self.objects == 1 or self.layouts is not None:
            return boxes
        return self._kept_apart(boxes, generator)

    def place(self, scale: Tensor, translation: Tensor, turns: Tensor) -> Boxes:
        """Boxes that all exist, at given parts of their ranges: 0 is the least, 1 the greatest of each.

        Args:
            scale: (B, N, 3).
            translation: (B, N, 3); z as any other, whatever `plane` says.
            turns: (B, N).
        """
        return Boxes(
            scale=_between(self.scale, scale),
            translation=_between(self.translation, translation),
            rotation=rotation_about_z(self._angles(turns)),
            exists=torch.ones(turns.shape, dtype=torch.bool, device=turns.device),
        )

    def collide(self, boxes: Boxes) -> Tensor:
        """Which two boxes that exist are nearer than `spacing` along each axis: bool (B, N, N), none with itself."""
        near = self._near(boxes, boxes)
        both = boxes.exists[:, :, None] & boxes.exists[:, None]
        return near & both & ~torch.eye(boxes.exists.shape[1], dtype=torch.bool, device=near.device)

    def _near(self, boxes: Boxes, others: Boxes) -> Tensor:
        """Which of N and M boxes of each scene are too near: bool (B, N, M)."""
        apart = (boxes.translation[:, :, None] - others.translation[:, None]).abs()
        reach = self._extents(boxes)[:, :, None] + self._extents(others)[:, None] + (self.spacing or 0.0)
        return (apart < reach).all(-1)

    def _extents(self, boxes: Boxes) -> Tensor:
        """Half of what boxes extend along x, y and z: (B, N, 3)."""
        return (boxes.rotation.mT.abs() @ boxes.scale[..., None]).squeeze(-1) if self.turned_extents else boxes.scale

    def _draw(self, exists: Tensor, generator: torch.Generator) -> Boxes:
        shape = exists.shape
        drawn = _uniform((*shape, 1 if self.one_size else 3), generator)
        scale = _between(self.scale, drawn.expand(*shape, 3))
        if self.layouts is None:
            translation = _between(self.translation, _uniform((*shape, 3), generator))
            if self.plane is not None:
                translation = torch.cat([translation[..., :2], torch.full_like(translation[..., 2:], self.plane)], -1)
        else:
            which = torch.randint(len(self.layouts), shape[:1], generator=generator, device=generator.device)
            translation = self.layouts.to(which.device).index_select(0, which)
        rotation = rotation_about_z(self._angles(_uniform(shape, generator)))
        return Boxes(scale, translation, rotation, exists)

    def _exists(self, count: int, generator: torch.Generator) -> Tensor:
        numbers = torch.arange(self.objects, device=generator.device).expand(count, -1)
        if self.counts is None:
            return torch.ones_like(numbers, dtype=torch.bool)
        shares = self.counts.to(generator.device)
        drawn = torch.multinomial(shares, max(count, 1), replacement=True, generator=generator)[:count]
        return numbers < drawn[:, None]

    def _kept_apart(self, boxes: Boxes, generator: torch.Generator) -> Boxes:
        for _ in range(_TRIES):
            clash = self.collide(boxes).flatten(1).any(1)
            if not bool(clash.any()):
                return boxes
            again = self._draw(boxes.exists, generator)
            if self.redraw == "object":
                again = self._placed_in_turn(again, generator)
            boxes = _replaced(boxes, again, clash[:, None].expand_as(boxes.exists))
        low, high = (end.tolist() for end in self.translation)
        raise UserError(
            f"{self.objects} boxes with half sides from {self.scale[0].tolist()} to {self.scale[1].tolist()} do not "
            f"fit {self.spacing:g} apart into boxes.translation from {low} to {high}: {int(clash.sum())} of "
            f"{len(clash)} scenes still collide after {_TRIES} draws"
        )

    def _placed_in_turn(self, boxes: Boxes, generator: torch.Generator) -> Boxes:
        """Each box in the first of many drawn places that is free of those before it; perhaps of none."""
        for number in range(1, self.objects):
            many = torch.ones((len(boxes.exists), _PLACES), dtype=torch.bool, device=boxes.exists.device)
            others = self._draw(many, generator)
            taken = (self._near(others, boxes) & boxes.exists[:, None])[..., :number].any(-1)
            first = taken.byte().argmin(1)  # the first 0
            rows = torch.arange(len(first), device=first.device)
            column = torch.arange(self.objects, device=first.device).expand_as(boxes.exists) == number
            chosen = Boxes(*(getattr(others, name)[rows, first][:, None] for name in Boxes.names()))
            boxes = _replaced(boxes, chosen, column)
        return boxes

    def _angles(self, parts: Tensor) -> Tensor:
        return 2 * math.pi * (self.turns[0] + parts * (self.turns[1] - self.turns[0]))


def rotation_about_z(radians: Tensor) -> Float[Tensor, "*any 3 3"]:
    """Matrices R that take x towards y by so much."""
    cos, sin = radians.cos(), radians.sin()
    zero, one = torch.zeros_like(cos), torch.ones_like(cos)
    return torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], -1).view(*radians.shape, 3, 3)


def _replaced(boxes: Boxes, others: Boxes, where: Tensor) -> Boxes:
    """The others' size, place and turn where (B, N) is true."""
    return Boxes(
        torch.where(where[..., None], others.scale, boxes.scale),
        torch.where(where[..., None], others.translation, boxes.translation),
        torch.where(where[..., None, None], others.rotation, boxes.rotation),
        boxes.exists,
    )


def _uniform(shape: Sequence[int], generator: torch.Generator) -> Tensor:
    return torch.rand(tuple(shape), generator=generator, device=generator.device)


def _between(ends: tuple[Tensor, Tensor], parts: Tensor) -> Tensor:
    low, high = (end.to(parts) for end in ends)
    return low + parts * (high - low)


def _ends(name: str, given: Sequence[_Corner], least: float = -math.inf) -> tuple[Tensor, Tensor]:
    low, high = (torch.tensor([float(number) for number in end]) for end in (given[0], given[-1]))
    is_pair = len(given) == 2 and low.shape == high.shape == (3,)
    if not is_pair or bool((low > high).any()) or bool((low <= least).any()):
        positive = "" if math.isinf(least) else " above 0"
        raise UserError(
            f"boxes.{name} must be two lists of x, y, z{positive}, the least and the greatest, got {given}"
        )
    return low, high


def _shares(counts: Sequence[float], objects: int) -> Tensor:
    shares = torch.tensor([float(number) for number in counts])
    if len(shares) != objects + 1 or bool((shares < 0).any()) or not 0 < float(shares.sum()) < math.inf:
        raise UserError(
            f"boxes.counts must say how often there are 0 to {objects} objects, {objects + 1} numbers of at least 0 "
            f"that are not all 0, got {list(counts)}"
        )
    return shares / shares.sum()


def _read_layouts(path: Path, objects: int) -> Tensor:
    try:
        with np.load(path, allow_pickle=False) as file:
            layouts = np.asarray(file[_LAYOUT])
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise UserError(f"boxes.layouts={path}: expected an .npz file with an array {_LAYOUT!r} ({error})") from error
    if layouts.ndim != 3 or layouts.shape[1:] != (objects, 3) or not len(layouts) or layouts.dtype.kind not in "fiu":
        raise UserError(
            f"boxes.layouts={path}: expected {_LAYOUT!r} of shape (L, {objects}, 3), the middles of the boxes of L "
            f"scenes, got {layouts.dtype} of {layouts.shape}"
        )
    if not np.isfinite(layouts).all():
        raise UserError(f"boxes.layouts={path}: {_LAYOUT!r} has numbers that are not finite")
    return torch.from_numpy(layouts.astype(np.float32))
