"""RealEstate10K: films of houses, a text file each with the cameras of its frames.

Zhou et al., "Stereo Magnification", SIGGRAPH 2018, and the data set's own page. The first line of a text is the
film's address; each other one a frame: its time in microseconds, fx fy cx cy as parts of the picture's width and
height, two zeros, and the upper three rows of the matrix that takes the world's axes to the camera's. The films
themselves are not part of it: whoever has their frames names them after their times.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Positive, check_numbers
from rendra_lab.tasks.synsin.frames import Film, Frame, pictures_by_name
from rendra_lab.tasks.synsin.number_lines import numbers, read_lines, rigid_motions
from rendra_lab.tasks.synsin.pair_folders import FoundPairs, FramePair, PairChoice, PairFolders, fixed_pairs

log = logging.getLogger(__name__)

LIST_FILE = "test_pairs.txt"
LIST_SIDE = 256  # pixels a side of the pictures that a list's fx fy cx cy are of
_CANDIDATES = 30  # SynSin's: frames of which the partner is one
_ENOUGH = 5  # with more far candidates than these, near ones are left out
_ROW = "a time in microseconds, fx fy cx cy, 2 unused, 12 numbers of a pose: 19 numbers"
_LISTED = "a film, the times of input and target, fx fy cx cy in 256 x 256 pixels, 12 numbers of each pose"


@dataclass(frozen=True)
class FilmText:
    """A text and the folder of its frames, yet to be read."""

    text: Path
    folder: Path
    skip_missing: bool

    def read(self) -> Film:
        """The film's cameras.

        Raises:
            UserError: a broken text, a frame without picture unless those are passed over, or fewer than two frames.
        """
        lines = read_lines(self.text, "an address and lines of cameras")
        if len(lines[0][1]) > 1:
            raise UserError(f"{lines[0][0]} has {len(lines[0][1])} words; expected the film's address alone")
        rows = np.array([_numbers_of(words, where) for where, words in lines[1:]]).reshape(-1, 19)
        places, names = [where for where, _ in lines[1:]], [words[0] for _, words in lines[1:]]
        motions = rigid_motions(rows[:, 7:], places)
        paths = _pictures(self.folder, names, places, self.skip_missing)
        there = [index for index, path in enumerate(paths) if path is not None]
        return Film(
            paths=[path for path in paths if path is not None],
            places=[places[index] for index in there],
            intrinsics=rows[there, 1:5],
            world_to_camera=motions[there],
            in_parts=True,
        )


@dataclass(frozen=True)
class FarEnough:
    """SynSin's choice of a partner: some frames near in time, and of them those seen from elsewhere, if enough are.

    Attributes:
        reach: frames that the partner may lie apart.
        turn_deg, move: a candidate is far if it is turned or moved by more.
    """

    reach: int = 40
    turn_deg: float = 5.0
    move: float = 0.15

    def partner(self, film: Film, first: int, rng: np.random.Generator) -> int:
        """A partner of one frame, of a film of two at least."""
        near = np.arange(max(0, first - self.reach), min(len(film), first + self.reach + 1))
        candidates = rng.choice(near[near != first], _CANDIDATES)
        far = (film.turns_deg(first, candidates) > self.turn_deg) | (film.moves(first, candidates) > self.move)
        return int(rng.choice(candidates[far] if far.sum() > _ENOUGH else candidates))


class FilmPairs(PairChoice):
    """Any frame of a film and one near it; a film's text is read when its turn comes.

    Args:
        films: to choose from, one an index and beginning anew after the last.
        total: indices.
        far_enough: how partners are chosen.
    """

    def __init__(self, films: Sequence[FilmText], total: int, far_enough: FarEnough) -> None:
        self.films = films
        self.total = total
        self.far_enough = far_enough

    def __len__(self) -> int:
        return self.total

    def draw(self, index: int, rng: np.random.Generator) -> FramePair:
        """A pair of one film; of the next one that has two frames, where missing pictures are passed over."""
        film = self._film(index * len(self.films) // self.total)
        first = int(rng.integers(len(film)))
        return film.frame(first), film.frame(self.far_enough.partner(film, first, rng))

    def _film(self, number: int) -> Film:
        for step in range(len(self.films)):
            text = self.films[(number + step) % len(self.films)]
            film = text.read()
            if len(film) > 1:
                return film
            if not text.skip_missing:
                raise UserError(f"{text.text} has {len(film)} frame; expected two at least, which make a pair")
        raise UserError(f"none of {len(self.films)} texts has two frames whose pictures are there")


class RealEstate10K(PairFolders):
    """Frames of a film about a house and others of it, a second or so away.

    Texts lie in `train/*.txt` and `test/*.txt`, the pictures of one in `frames/train/ID` or `frames/ID`. Where
    `frames/train/video_loc.txt` lists films, as SynSin has it, they and the texts beside them are taken instead.
    Without `test`, the validation films are the test's.

    Args:
        path: the folder.
        pairs_per_film: samples of an epoch that come from each film.
        reach, turn_deg, move: see FarEnough; in the units of the poses.
        hold_out: every which training film, by name, is for validation; SynSin's too are a fifth.
        test_list: file of test pairs, a line each: film, times of input and target, fx fy cx cy in pixels of 256 x
            256, 12 numbers of either pose, as SynSin's. Two lines in succession there share their target: its
            `--take_every_other` counts the better score of the two, which are pairs 2k and 2k+1 here. A fifth of its
            pairs have the target itself as one input. None takes test_pairs.txt of the folder where it is there.
        skip_missing: pass over frames and films without pictures, instead of refusing them.
        **pairs: see PairFolders.

    Raises:
        UserError: settings that cannot be.
    """

    def __init__(
        self,
        path: str | Path,
        pairs_per_film: Positive = 1,
        reach: Positive = 40,
        turn_deg: Amount = 5.0,
        move: Amount = 0.15,
        hold_out: int = 5,
        test_list: str | Path | None = None,
        skip_missing: bool = False,
        **pairs: Any,
    ) -> None:
        super().__init__(**pairs)
        check_numbers("data", Positive, pairs_per_film=pairs_per_film, reach=reach)
        check_numbers("data", Amount, turn_deg=turn_deg, move=move)
        if hold_out < 2:
            raise UserError(f"data.hold_out must be 2 or more (5: every fifth film), got {hold_out}")
        self.path = Path(path)
        self.pairs_per_film = pairs_per_film
        self.far_enough = FarEnough(reach, turn_deg, move)
        self.hold_out = hold_out
        self.test_list = None if test_list is None else Path(test_list)
        self.skip_missing = skip_missing

    def find(self) -> FoundPairs:
        """The names of texts and folders; texts are read when their turn comes, but those of validation and test."""
        if not self.path.is_dir():
            raise UserError(f"data.path={self.path} is no folder")
        films = self._films("train")
        if len(films) < 2:
            raise UserError(
                f"{self.path / 'train'} has {len(films)} film; one to train on and one to hold out are needed"
            )
        train = [film for number, film in enumerate(films) if number % self.hold_out]
        val = self._fixed(films[:: self.hold_out], self.val_pairs, self.seed)
        return FoundPairs(self._choice(train, self.pairs_per_film), val, self._test() or val)

    def _test(self) -> list[FramePair]:
        file = self.test_list or (self.path / LIST_FILE)
        if self.test_list is not None or file.is_file():
            return self._listed(file)
        has_test = (self.path / "test").is_dir() or (self.path / "frames" / "test" / "video_loc.txt").is_file()
        return self._fixed(self._films("test"), self.test_pairs, self.seed + 1) if has_test else []

    def _choice(self, films: Sequence[FilmText], pairs_per_film: int) -> FilmPairs:
        return FilmPairs(films, pairs_per_film * len(films), self.far_enough)

    def _fixed(self, films: Sequence[FilmText], most: int, seed: int) -> list[FramePair]:
        """As many pairs as are asked for, of each film as many as of any other."""
        return fixed_pairs(self._choice(films, -(-most // len(films))), most, seed)

    def _films(self, split: str) -> list[FilmText]:
        frames = self.path / "frames" / split
        located = frames / "video_loc.txt"
        if located.is_file():
            names = [words[0] for _, words in read_lines(located, "the names of films")]
            films = [FilmText(frames / f"{name}.txt", frames / name, self.skip_missing) for name in names]
        else:
            texts = sorted((self.path / split).glob("*.txt"))
            films = [FilmText(text, self._folder(text.stem, split), self.skip_missing) for text in texts]
        there = [film for film in films if film.folder.is_dir()]
        if not films or not there:
            raise UserError(
                f"there is no film for {split}: expected {self.path / split / '*.txt'}, and frames of each in "
                f"{frames / 'ID'} or {self.path / 'frames' / 'ID'}"
            )
        if len(there) < len(films):
            missing = next(film for film in films if not film.folder.is_dir())
            if not self.skip_missing:
                raise UserError(
                    f"{missing.text}: there is no folder {missing.folder} of its frames; data.skip_missing=true "
                    "passes over such films"
                )
            log.info("%s of %s films have no frames", f"{len(films) - len(there):,}", f"{len(films):,}")
        return there

    def _folder(self, name: str, split: str) -> Path:
        of_split = self.path / "frames" / split / name
        return self.path / "frames" / name if not of_split.is_dir() else of_split

    def _listed(self, file: Path) -> list[FramePair]:
        """The pairs of a list; where a picture is missing, its two lines that share a target are passed over."""
        rows = [self._row(words, where) for where, words in read_lines(file, f"lines of {_LISTED}")]
        kept = [
            pair
            for begin in range(0, len(rows), 2)
            if all(row is not None for row in rows[begin : begin + 2])
            for pair in rows[begin : begin + 2]
        ]
        found = [pair for pair in kept if pair is not None]
        if not found:
            raise UserError(f"{file}: no pair has both of its pictures")
        return found

    def _row(self, words: Sequence[str], where: str) -> FramePair | None:
        if len(words) != 31:
            raise UserError(f"{where} has {len(words)} words; expected 31: {_LISTED}")
        rest = np.array(numbers(words[3:], 28, where, _LISTED))
        motions = rigid_motions(rest[4:].reshape(2, 12), [where, where])
        folder = self._folder(words[0], "test")
        if not folder.is_dir() and not self.skip_missing:
            raise UserError(f"{where}: there is no folder {folder} of frames")
        paths = _pictures(folder, words[1:3], [where, where], self.skip_missing)
        if paths[0] is None or paths[1] is None:
            return None
        intrinsics = rest[:4] / LIST_SIDE
        return (
            Frame(paths[0], where, intrinsics, motions[0], in_parts=True),
            Frame(paths[1], where, intrinsics, motions[1], in_parts=True),
        )


def _numbers_of(words: Sequence[str], where: str) -> list[float]:
    if not words[0].isdecimal():
        raise UserError(f"{where} begins with {words[0][:40]!r}; expected {_ROW}")
    return numbers(words, 19, where, _ROW)


def _pictures(folder: Path, names: Sequence[str], places: Sequence[str], skip_missing: bool) -> list[Path | None]:
    """The picture of each name, with whatever suffix; None for one that may be missing."""
    found = pictures_by_name(folder)
    for name, where in zip(names, places, strict=True):
        if name not in found and not skip_missing:
            raise UserError(
                f"{where}: there is no picture {folder / name}.png or .jpg; data.skip_missing=true passes over such "
                "frames"
            )
    return [found.get(name) for name in names]
