"""KITTI's odometry sequences: a car's camera on its way, with the poses of all frames.

Geiger, Lenz, Urtasun, "Are we ready for Autonomous Driving?", CVPR 2012, and the readme of its odometry benchmark:
`sequences/XX/image_2/000000.png ...`, `sequences/XX/calib.txt`, `poses/XX.txt`. A line of poses is the upper three
rows of the matrix that takes the axes of camera 0 (grey, left) to the world, metres. P2 of calib.txt takes those of
camera 0, rectified, to pixels of camera 2 (colour, left): its last column holds how far the two stand apart.
Its pixels count from the middle of the first one; ours from its corner, half a pixel more.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from rendra_lab.data.json_fields import Fields, read_json
from rendra_lab.errors import UserError
from rendra_lab.settings import Positive, Range, check_numbers
from rendra_lab.tasks.synsin.frames import Film, pictures_by_name
from rendra_lab.tasks.synsin.number_lines import numbers, read_lines, rigid_motions
from rendra_lab.tasks.synsin.pair_folders import (
    FoundPairs,
    FramePair,
    NearFrames,
    Nearness,
    PairFolders,
    fixed_pairs,
)

DIVISION_FILE, LIST_FILE = "division.json", "test_pairs.txt"
FIRST_PIXEL = 0.5  # where our pixels have what is KITTI's zero
_STANDARD = {"train": [f"{i:02d}" for i in range(8)], "val": ["08"], "test": ["09", "10"]}
_LISTED = re.compile(r"(?P<sequence>\w+)_(?P<frame>\d+)")
_Camera = Annotated[int, Range(0, 3)]
_Names = Sequence[int | str]


class KittiPairs(PairFolders):
    """Frames of a drive and those a few frames before or behind.

    Args:
        path: the folder that holds `sequences` and `poses`.
        train, val, test: sequences, such as [0,1,2]; None takes what division.json in the folder says, or else 00 to
            07, 08, and 09 and 10, as far as they are there.
        max_offset: frames that input and target lie apart at most; SynSin has 5.
        test_list: file of test pairs, a line each: input and target as 09_001136 09_001137. What follows in a line,
            as in SynSin's own list, is not read. Its frames are kept from training. None takes test_pairs.txt of the
            folder where it is there, and else pairs of the test sequences.
        camera: 2 is the left one with colours, 3 the right one, 0 and 1 are grey.
        **pairs: see PairFolders.

    Raises:
        UserError: settings that cannot be.
    """

    def __init__(
        self,
        path: str | Path,
        train: _Names | None = None,
        val: _Names | None = None,
        test: _Names | None = None,
        max_offset: Positive = 5,
        test_list: str | Path | None = None,
        camera: _Camera = 2,
        **pairs: Any,
    ) -> None:
        super().__init__(**pairs)
        check_numbers("data", Positive, max_offset=max_offset)
        check_numbers("data", _Camera, camera=camera)
        self.path = Path(path)
        self.given = {"train": train, "val": val, "test": test}
        self.nearness = Nearness(max_offset)
        self.test_list = None if test_list is None else Path(test_list)
        self.camera = camera

    def find(self) -> FoundPairs:
        """The cameras of all sequences that are asked for."""
        for folder in (self.path, self.path / "sequences", self.path / "poses"):
            if not folder.is_dir():
                raise UserError(f"there is no folder {folder}; data.path is the one that holds sequences and poses")
        names = self._division()
        films: dict[str, Film] = {}
        listed = self._listed(films)
        for name in (name for part in names.values() for name in part):
            self._film(name, films)
        held = {(row.sequence, frame) for row in listed for frame in (row.first, row.second)}
        kept_away = {(names["train"].index(name), frame) for name, frame in held if name in names["train"]}
        train = NearFrames([films[name] for name in names["train"]], self.nearness, kept_away)
        if len(train) == 0:
            raise UserError(f"{self.path}: no two frames of the sequences {names['train']} are left to train on")
        val = self._held_out("val", names["val"], films, self.val_pairs)
        test = [row.pair(films) for row in listed]
        return FoundPairs(train, val, test or self._held_out("test", names["test"], films, self.test_pairs))

    def _held_out(self, split: str, names: Sequence[str], films: dict[str, Film], most: int) -> list[FramePair]:
        choice = NearFrames([films[name] for name in names], self.nearness)
        if len(choice) == 0:
            raise UserError(f"{self.path}: the sequences data.{split}={names} hold no pair of frames")
        return fixed_pairs(choice, most, self.seed + (split == "test"))

    def _division(self) -> dict[str, list[str]]:
        """The names of the sequences of each part."""
        parts = self._standard_division()
        for split, given in self.given.items():
            if given is not None:
                parts[split] = [f"{name:02d}" if isinstance(name, int) else name for name in given]
            missing = [name for name in parts[split] if not (self.path / "sequences" / name).is_dir()]
            if missing:
                raise UserError(
                    f"there is no folder {self.path / 'sequences' / missing[0]}, a sequence of data.{split}"
                )
            if not parts[split] and (split != "test" or self._list_file() is None):
                raise UserError(
                    f"{self.path / 'sequences'} has none of the sequences that are for {split}: say which are, "
                    f"as in data.{split}=[0,1]"
                )
        for split in ("val", "test"):
            twice = sorted(set(parts[split]) & set(parts["train"]))
            if twice:
                raise UserError(
                    f"sequence {twice[0]} is in data.train and in data.{split}; expected it in one of them"
                )
        return parts

    def _standard_division(self) -> dict[str, list[str]]:
        file = self.path / DIVISION_FILE
        if file.is_file():
            fields = Fields(read_json(file), str(file))
            return {split: fields.texts(split) for split in _STANDARD}
        present = {path.name for path in (self.path / "sequences").iterdir()}
        return {split: [name for name in names if name in present] for split, names in _STANDARD.items()}

    def _film(self, name: str, films: dict[str, Film]) -> Film:
        """A sequence, read once."""
        if name not in films:
            films[name] = read_sequence(self.path, name, self.camera)
        return films[name]

    def _list_file(self) -> Path | None:
        if self.test_list is not None:
            return self.test_list
        return self.path / LIST_FILE if (self.path / LIST_FILE).is_file() else None

    def _listed(self, films: dict[str, Film]) -> list[_Row]:
        file = self._list_file()
        if file is None:
            return []
        rows = [_row(words, where) for where, words in read_lines(file, "pairs such as 09_001136 09_001137")]
        for row in rows:
            if not (self.path / "sequences" / row.sequence).is_dir():
                raise UserError(f"{row.where}: there is no folder {self.path / 'sequences' / row.sequence}")
            count = len(self._film(row.sequence, films))
            if max(row.first, row.second) >= count:
                raise UserError(
                    f"{row.where} names frame {max(row.first, row.second)} of sequence {row.sequence}, "
                    f"which has {count}, counted from 0"
                )
        return rows


def read_sequence(path: Path, name: str, camera: int = 2) -> Film:
    """The cameras of one sequence, and where its pictures lie.

    Args:
        path: the folder that holds `sequences` and `poses`.
        name: of the sequence.
        camera: 0 to 3.

    Raises:
        UserError: a file that is missing or broken, frames without pose or the other way round.
    """
    poses = path / "poses" / f"{name}.txt"
    expected = "12 numbers, a pose's upper three rows"
    lines = read_lines(poses, f"lines of {expected}")
    places = [where for where, _ in lines]
    rows = np.array([numbers(words, 12, where, expected) for where, words in lines])
    camera_to_world = rigid_motions(rows, places)
    intrinsics, offset = read_calibration(path / "sequences" / name / "calib.txt", camera)
    own_axes = np.eye(4)
    own_axes[:3, 3] = offset
    return Film(
        paths=_pictures(path / "sequences" / name / f"image_{camera}", places),
        places=places,
        intrinsics=np.tile(intrinsics, (len(lines), 1)),
        world_to_camera=own_axes @ np.linalg.inv(camera_to_world),
    )


def read_calibration(path: Path, camera: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Of one camera: fx fy cx cy (4,) in our pixels, and the shift (3,) from camera 0's axes to its own, metres.

    Raises:
        UserError: no file, no such line in it, another count of numbers, or no camera's matrix.
    """
    key, expected = f"P{camera}", "12 numbers of a matrix of 3 x 4"
    lines = read_lines(path, f"a line '{key}:' with {expected}")
    found = {words[0].rstrip(":"): (where, words[1:]) for where, words in lines}
    if key not in found:
        raise UserError(f"{path}: {key!r} is missing; expected {expected}; it has {', '.join(found)}")
    where, words = found[key]
    where = f"{where}, {key!r}"
    matrix = np.array(numbers(words, 12, where, expected)).reshape(3, 4)
    left = matrix[:, :3]
    plain = [left[0, 1], left[1, 0], left[2, 0], left[2, 1], left[2, 2] - 1]
    if np.abs(plain).max() > 1e-6 or left[0, 0] <= 0 or left[1, 1] <= 0:
        raise UserError(f"{where} begins with {left.tolist()}; expected [[fx,0,cx],[0,fy,cy],[0,0,1]]")
    pinhole = np.array([left[0, 0], left[1, 1], left[0, 2] + FIRST_PIXEL, left[1, 2] + FIRST_PIXEL])
    return pinhole, np.linalg.solve(left, matrix[:, 3])


@dataclass(frozen=True)
class _Row:
    """A line of a list of pairs."""

    where: str
    sequence: str
    first: int
    second: int

    def pair(self, films: dict[str, Film]) -> FramePair:
        film = films[self.sequence]
        return film.frame(self.first), film.frame(self.second)


def _row(words: Sequence[str], where: str) -> _Row:
    found = [_LISTED.fullmatch(word) for word in words[:2]]
    if len(found) < 2 or found[0] is None or found[1] is None:
        raise UserError(
            f"{where} begins with {' '.join(words[:2])[:60]!r}; expected two frames such as 09_001136 09_001137"
        )
    if found[0]["sequence"] != found[1]["sequence"]:
        raise UserError(f"{where} pairs frames of two sequences, {found[0][0]} and {found[1][0]}; expected one")
    return _Row(where, found[0]["sequence"], int(found[0]["frame"]), int(found[1]["frame"]))


def _pictures(folder: Path, places: Sequence[str]) -> list[Path]:
    """The picture of each pose, by its number."""
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder} of pictures")
    found = pictures_by_name(folder)
    for number, where in enumerate(places):
        if f"{number:06d}" not in found:
            raise UserError(f"{where}: there is no picture {folder / f'{number:06d}.png'}, nor another of its name")
    if len(found) > len(places):
        raise UserError(f"{folder} holds {len(found)} pictures, but {len(places)} poses are known")
    return [found[f"{number:06d}"] for number in range(len(places))]
