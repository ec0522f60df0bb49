"""Any pictures that somebody has, as squares of one size: found in folders, read when they are asked for.

Photographs stand upright as their EXIF data say; grey ones become grey colours, what is transparent lies over a grey;
of an animation the first picture counts. Letters: S x S pixels.
"""

from __future__ import annotations

import glob
import logging
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from rendra_lab.data.photographs import SUFFIXES
from rendra_lab.data.picture_files import upright
from rendra_lab.errors import UserError

log = logging.getLogger(__name__)

ENDINGS = (*SUFFIXES, ".gif")
_NAMED = 20  # broken pictures that are named one by one; more are only counted

OnBroken = Literal["stop", "skip"]


def find_pictures(path: str | Path | Sequence[str]) -> list[str]:
    """The paths of all pictures, by their endings, in alphabetical order; hidden files are none.

    Args:
        path: a folder with all that is in it, a pattern such as `photos/**/*.jpg`, a picture, or a list of these.

    Raises:
        UserError: nothing there, or no picture in it.
    """
    several = [str(path)] if isinstance(path, str | Path) else [str(one) for one in path]
    if not several:
        raise UserError("data.path is empty; expected a folder, a pattern such as photos/*.jpg, or a list of them")
    return sorted({found for one in several for found in _pictures_of(one)})


@dataclass(frozen=True)
class Framing:
    """Which square is taken of a picture, and how large it becomes.

    Pixels of the result are weighted means of all that they cover, so that nothing is aliased.

    Attributes:
        side: S.
        crop: pixels of the file along the square's sides, at most as many as it has; None: the largest square.
        at_random: where in the picture it lies is drawn from torch's global stream; else in the middle.
        behind: grey in [0, 1] behind what is transparent.
    """

    side: int
    crop: int | None = None
    at_random: bool = False
    behind: float = 1.0

    def framed(self, picture: Image.Image) -> Tensor:
        """Colours (3, S, S), uint8."""
        across = min(*picture.size, self.crop or max(picture.size))
        left, top = (round((length - across) * self._part()) for length in picture.size)
        square = self._opaque(picture.crop((left, top, left + across, top + across)))
        small = square.resize((self.side, self.side), Image.Resampling.BICUBIC)
        return torch.from_numpy(np.array(small)).permute(2, 0, 1).contiguous()

    def _part(self) -> float:
        return float(torch.rand(())) if self.at_random else 0.5

    def _opaque(self, picture: Image.Image) -> Image.Image:
        if "A" not in picture.getbands() and "transparency" not in picture.info:
            return picture.convert("RGB")
        grey = round(255 * self.behind)
        under = Image.new("RGBA", picture.size, (grey, grey, grey, 255))
        return Image.alpha_composite(under, picture.convert("RGBA")).convert("RGB")


class PictureReader:
    """Reads pictures one by one, and keeps the first of them in memory.

    A broken picture ends all, or is named in a warning and taken for none from then on, in all processes.

    Args:
        paths: of the pictures.
        framing: what becomes of them.
        on_broken: stop at a broken picture, or skip it.
        kept: how many stay in memory; none where squares are drawn at random. Copies of the reader begin with none.
        shared: other processes shall know which are broken.

    Raises:
        UserError: another `on_broken`.
    """

    def __init__(
        self,
        paths: Sequence[str],
        framing: Framing,
        on_broken: OnBroken = "stop",
        kept: int = 0,
        shared: bool = False,
    ) -> None:
        if on_broken not in ("stop", "skip"):
            raise UserError(f"data.on_broken must be stop or skip, got {on_broken!r}")
        self.paths = paths
        self.framing = framing
        self.on_broken = on_broken
        self.kept = 0 if framing.at_random else kept
        flags = torch.zeros(len(paths), dtype=torch.bool)
        self._is_broken = flags.share_memory_() if shared else flags
        self._shelf: dict[int, Tensor] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_shelf": {}}

    @property
    def broken(self) -> list[str]:
        """The paths of pictures that were skipped, in any process that shares this."""
        return [self.paths[i] for i in self._is_broken.nonzero()[:, 0].tolist()]

    def read(self, number: int) -> Tensor | None:
        """Colours (3, S, S), uint8, of a picture; None where it is broken and is to be skipped.

        Raises:
            UserError: a broken picture, where that is to stop all.
        """
        if number in self._shelf:
            return self._shelf[number]
        if bool(self._is_broken[number]):
            return None
        try:
            pixels = self.framing.framed(upright(Path(self.paths[number]), "data.path"))
        except UserError as error:
            if self.on_broken == "stop":
                raise UserError(f"{error}; data.on_broken=skip goes on without it") from error
            self._skip(number, error)
            return None
        if len(self._shelf) < self.kept:
            self._shelf[number] = pixels
        return pixels

    def _skip(self, number: int, error: UserError) -> None:
        self._is_broken[number] = True
        count = int(self._is_broken.sum())
        if count <= _NAMED:
            log.warning("skipped: %s", error)
        if count == _NAMED:
            log.warning("further pictures that are skipped are counted, not named")


def _pictures_of(path: str) -> list[str]:
    """The pictures of one folder, pattern or file."""
    if os.path.isdir(path):
        found, seen = [], 0
        for file in _files_below(path):
            seen += 1
            found += [file] if _is_picture(file) else []
        if not found:
            raise UserError(
                f"data.path={path} holds no picture: none of its {seen} files ends in one of {', '.join(ENDINGS)}"
            )
        return found
    if os.path.isfile(path):
        return [path]
    matching = glob.glob(path, recursive=True)
    found = [file for file in matching if _is_picture(file) and os.path.isfile(file)]
    found += [file for each in matching if os.path.isdir(each) for file in _files_below(each) if _is_picture(file)]
    if not found:
        raise UserError(
            f"data.path={path} is no folder and no picture"
            + (f", and none of the {len(matching)} files that match it is one" if glob.has_magic(path) else "")
        )
    return found


def _files_below(folder: str) -> Iterator[str]:
    """All files of a folder and of those in it; links to folders are followed, once each."""
    entered: set[str] = set()
    for here, folders, files in os.walk(folder, followlinks=True):
        home = os.path.realpath(here)
        if home in entered:
            folders.clear()
            continue
        entered.add(home)
        folders[:] = [name for name in folders if not name.startswith(".")]
        yield from (os.path.join(here, name) for name in files)


def _is_picture(path: str) -> bool:
    return path.lower().endswith(ENDINGS) and not os.path.basename(path).startswith(".")
