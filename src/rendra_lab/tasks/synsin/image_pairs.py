"""Pairs of any posed pictures: folders of COLMAP, nerfstudio, instant-ngp, LLFF, and of NeRF's synthetic scenes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rendra_lab.data.colmap import ColmapViews
from rendra_lab.data.folder_views import Capture, FolderViews
from rendra_lab.data.llff import LlffViews
from rendra_lab.data.nerf_blender import NerfBlenderViews
from rendra_lab.data.photographs import Photograph
from rendra_lab.data.transforms import TransformsViews
from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Fraction, Positive, check_numbers
from rendra_lab.tasks.synsin.frames import Film
from rendra_lab.tasks.synsin.pair_folders import FoundPairs, NearFrames, Nearness, PairFolders, fixed_pairs

_SIGNS: Mapping[str, tuple[str, ...]] = {
    "transforms": ("transforms.json",),
    "nerf_blender": ("transforms_train.json",),
    "llff": ("poses_bounds.npy",),
    "colmap": ("sparse", "cameras.bin", "cameras.txt"),
}
"""What tells the formats apart, in the order in which they are looked for."""

_READERS: Mapping[str, Callable[..., FolderViews]] = {
    "transforms": TransformsViews,
    "nerf_blender": NerfBlenderViews,
    "llff": partial(LlffViews, recentre=False, bound_factor=None),  # poses as they stand in the file
    "colmap": ColmapViews,
}

_FLIP = np.array([-1.0, -1.0, 1.0])  # our views' +X left and +Y up to x right and y down


class ImagePairs(PairFolders):
    """Frames of a place and others near them, by their order or by their cameras; masks are not followed.

    Where the format divides views, that holds. Else the last frames of each folder, in the order of their names, are
    held out, for validation and test alike: a whole stretch, which is never seen in training.

    Args:
        path: a folder, or a list of them.
        format: transforms, nerf_blender, llff, colmap; auto goes by the files that are there.
        hold_out: share of the frames that are held out where the format does not say which.
        max_offset: frames that input and target lie apart at most, in the order of their names; None: any number.
        max_turn_deg: degrees that one camera is turned against the other at most; None: any.
        max_move: units of the poses that they stand apart at most; None: any.
        allow_outside: read files outside the folder if it names them.
        **pairs: see PairFolders.

    Raises:
        UserError: settings that cannot be.
    """

    def __init__(
        self,
        path: str | Path | Sequence[str],
        format: str = "auto",
        hold_out: Fraction = 0.2,
        max_offset: Positive | None = 5,
        max_turn_deg: Amount | None = None,
        max_move: Amount | None = None,
        allow_outside: bool = False,
        **pairs: Any,
    ) -> None:
        super().__init__(**pairs)
        if format != "auto" and format not in _SIGNS:
            raise UserError(f"data.format must be one of auto, {', '.join(_SIGNS)}, got {format!r}")
        check_numbers("data", Fraction, hold_out=hold_out)
        check_numbers("data", Positive | None, max_offset=max_offset)
        check_numbers("data", Amount | None, max_turn_deg=max_turn_deg, max_move=max_move)
        self.paths = [Path(path)] if isinstance(path, str | Path) else [Path(one) for one in path]
        self.format = format
        self.hold_out = hold_out
        self.nearness = Nearness(max_offset, max_turn_deg, max_move)
        self.allow_outside = allow_outside

    def find(self) -> FoundPairs:
        """The cameras of all folders."""
        if not self.paths:
            raise UserError("data.path is empty; expected a folder, or a list of them")
        divided = [self._films(path) for path in self.paths]
        train, val, test = (
            self._choice(split, [films[split] for films in divided]) for split in ("train", "val", "test")
        )
        return FoundPairs(
            train, fixed_pairs(val, self.val_pairs, self.seed), fixed_pairs(test, self.test_pairs, self.seed + 1)
        )

    def _choice(self, split: str, films: Sequence[Film]) -> NearFrames:
        choice = NearFrames(films, self.nearness)
        if len(choice) == 0:
            raise UserError(
                f"{', '.join(map(str, self.paths))}: none of the {sum(map(len, films))} frames for {split} has a "
                f"partner within {self.nearness or 'reach'}"
            )
        return choice

    def _films(self, path: Path) -> dict[str, Film]:
        capture = self._capture(path)
        if not capture.is_interleaved:
            return {split: _film(getattr(capture, split)) for split in ("train", "val", "test")}
        photographs = sorted([*capture.train, *capture.test], key=_by_name)
        held = round(self.hold_out * len(photographs))
        if held < 2 or len(photographs) - held < 2:
            raise UserError(
                f"{path} has {len(photographs)} photographs, and data.hold_out={self.hold_out:g} keeps {held} of "
                "them from training; expected two at least on either side"
            )
        rest = _film(photographs[-held:])
        return {"train": _film(photographs[:-held]), "val": rest, "test": rest}

    def _capture(self, path: Path) -> Capture:
        if not path.is_dir():
            raise UserError(f"data.path={path} is no folder")
        format = self.format if self.format != "auto" else _format_of(path)
        return _READERS[format](path, allow_outside=self.allow_outside).read()


def _format_of(path: Path) -> str:
    for format, signs in _SIGNS.items():
        if any((path / sign).exists() for sign in signs):
            return format
    known = ", ".join(sign for several in _SIGNS.values() for sign in several)
    raise UserError(f"{path} holds none of {known}: where are its cameras?")


def _film(photographs: Sequence[Photograph]) -> Film:
    photographs = sorted(photographs, key=_by_name)
    matrices = np.tile(np.eye(4), (len(photographs), 1, 1))
    for matrix, photograph in zip(matrices, photographs, strict=True):
        matrix[:3, :3] = _FLIP[:, None] * photograph.R.double().numpy().T
        matrix[:3, 3] = _FLIP * photograph.T.double().numpy()
    return Film(
        paths=[photograph.path for photograph in photographs],
        places=[photograph.where for photograph in photographs],
        intrinsics=np.array([photograph.intrinsics for photograph in photographs]).reshape(-1, 4),
        world_to_camera=matrices,
        distortion=np.array([photograph.distortion for photograph in photographs]).reshape(-1, 8),
        fisheye=np.array([photograph.fisheye for photograph in photographs], bool),
    )


def _by_name(photograph: Photograph) -> list[tuple[int, str]]:
    """Orders names as people do: r_2 before r_10."""
    parts = re.split(r"(\d+)", str(photograph.path))
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
