"""RealEstate10K's texts: the right cameras, SynSin's choice of pairs, lists, complaints that name file and line."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pair_files import SIZE, picture, realestate_folder, realestate_row

from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.frames import Film
from rendra_lab.tasks.synsin.realestate import FarEnough, FilmText, RealEstate10K

WHERE = Path("frames")


def made(folder: Path, **how: Any) -> RealEstate10K:
    data = RealEstate10K(folder, image_size=list(SIZE), **{"batch_size": 2, "val_pairs": 6, "test_pairs": 6, **how})
    data.setup("fit")
    return data


def names_of(pairs: Any) -> set[str]:
    return {frame.path.parent.name for pair in pairs for frame in pair}


def test_pictures_intrinsics_and_motion(tmp_path: Path) -> None:
    data = made(realestate_folder(tmp_path))
    first, second = (int(frame.path.stem) // 1000 for frame in data.splits.test.pairs[0])
    pair = data.splits.test[0]
    torch.testing.assert_close(pair.input[0], torch.from_numpy(picture(300 + first)).permute(2, 0, 1) / 255)
    torch.testing.assert_close(pair.target[0], torch.from_numpy(picture(300 + second)).permute(2, 0, 1) / 255)
    expected = torch.tensor([[0.5 * 12, 0, 0.45 * 12], [0, 0.9 * 6, 0.55 * 6], [0, 0, 1]])
    torch.testing.assert_close(pair.intrinsics[0], expected)
    motion = torch.eye(4)
    motion[0, 3] = -0.05 * (second - first)
    torch.testing.assert_close(pair.input_to_target[0], motion)


def test_films_are_divided_by_name(tmp_path: Path) -> None:
    realestate_folder(tmp_path, {f"train/{name}": 2 for name in "abcdefg"} | {"test/z": 2})
    data = made(tmp_path, pairs_per_film=3)
    assert len(data.splits.train) == 15
    train = [data.splits.train.choice.draw(index, np.random.default_rng(0)) for index in range(15)]
    assert names_of(train) == set("bcdeg")
    assert names_of(data.splits.val.pairs) == {"a", "f"}
    assert len(data.splits.val) == 6
    assert names_of(data.splits.test.pairs) == {"z"}
    assert [len(batch.input) for batch in data.train_dataloader()] == [2] * 7


def test_without_test_films_validation_is_the_test(tmp_path: Path) -> None:
    data = made(realestate_folder(tmp_path, {"train/a": 2, "train/b": 2}), val_pairs=3)
    assert names_of(data.splits.test.pairs) == {"a"}
    assert data.splits.test.pairs == data.splits.val.pairs


def test_frames_without_split_folders_and_of_other_suffixes(tmp_path: Path) -> None:
    realestate_folder(tmp_path, suffix=".jpg")
    for folder in [*(tmp_path / "frames").glob("*/*")]:
        folder.rename(tmp_path / "frames" / folder.name)
    assert made(tmp_path).splits.val[0].input.shape == (1, 3, *SIZE)


def test_synsins_own_lists_of_films(tmp_path: Path) -> None:
    realestate_folder(tmp_path)
    for split, names in (("train", "ab"), ("test", "d")):
        for name in names:
            (tmp_path / split / f"{name}.txt").rename(tmp_path / "frames" / split / f"{name}.txt")
        (tmp_path / "frames" / split / "video_loc.txt").write_text("\n".join(names) + "\n")
    data = made(tmp_path)
    assert names_of(data.splits.val.pairs) == {"a"}
    assert names_of([data.splits.train.choice.draw(0, np.random.default_rng(0))]) == {"b"}


def film_of(positions: list[float], turns_deg: list[float]) -> Film:
    matrices = np.tile(np.eye(4), (len(positions), 1, 1))
    for matrix, position, turn in zip(matrices, positions, np.radians(turns_deg), strict=True):
        matrix[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        matrix[:3, 3] = -matrix[:3, :3] @ [position, 0, 0]
    return Film(
        [Path(str(i)) for i in range(len(positions))], [""] * len(positions), np.ones((len(positions), 4)), matrices
    )


def partners(film: Film, first: int, **how: Any) -> set[int]:
    return {FarEnough(**how).partner(film, first, np.random.default_rng(seed)) for seed in range(300)}


def test_far_partners_are_preferred_where_there_are_enough() -> None:
    still = film_of([0.0] * 10, [0.0] * 10)
    assert partners(still, 5) == set(range(10)) - {5}
    moving = film_of([0.06 * i for i in range(10)], [0.0] * 10)
    assert partners(moving, 0) == {3, 4, 5, 6, 7, 8, 9}
    turning = film_of([0.0] * 10, [2.0 * i for i in range(10)])
    assert partners(turning, 9) == {0, 1, 2, 3, 4, 5, 6}
    assert partners(turning, 9, reach=2) == {7, 8}  # near ones where nothing else is


def test_a_list_of_test_pairs(tmp_path: Path) -> None:
    realestate_folder(tmp_path)
    poses = [" ".join(realestate_row(number).split()[7:]) for number in range(3)]
    rows = [
        f"d 0 1000 128 200 120 130 {poses[0]} {poses[1]}",
        f"d 1000 1000 128 200 120 130 {poses[1]} {poses[1]}",
        f"d 2000 0 128 200 120 130 {poses[2]} {poses[0]}",
        f"d 1000 0 128 200 120 130 {poses[1]} {poses[0]}",
    ]
    file = tmp_path / "list.txt"
    file.write_text("\n".join(rows))
    test = made(tmp_path, test_list=file).splits.test
    assert [tuple(frame.path.stem for frame in pair) for pair in test.pairs] == [
        ("0", "1000"),
        ("1000", "1000"),
        ("2000", "0"),
        ("1000", "0"),
    ]
    pair = test[0]
    torch.testing.assert_close(pair.intrinsics[0, 0], torch.tensor([6.0, 0, 120 / 256 * 12]))
    torch.testing.assert_close(pair.intrinsics[0, 1], torch.tensor([0, 200 / 256 * 6, 130 / 256 * 6]))
    assert float(pair.input_to_target[0, 0, 3]) == pytest.approx(-0.05)
    (tmp_path / "frames" / "test" / "d" / "2000.png").unlink()
    with pytest.raises(UserError, match=r"list\.txt, line 3: there is no picture .*2000\.png.*skip_missing"):
        made(tmp_path, test_list=file)
    # the line that shares the target goes too, so that pairs 2k and 2k + 1 still belong together
    assert len(made(tmp_path, test_list=file, skip_missing=True).splits.test) == 2
    (tmp_path / "frames" / "test" / "d" / "0.png").unlink()
    with pytest.raises(UserError, match=r"list\.txt: no pair has both of its pictures"):
        made(tmp_path, test_list=file, skip_missing=True)


def test_missing_frames_are_passed_over_if_that_is_asked_for(tmp_path: Path) -> None:
    realestate_folder(tmp_path, {f"train/{name}": 4 for name in "abcd"} | {"test/z": 2})
    (tmp_path / "frames" / "train" / "b" / "1000.png").unlink()
    for path in (tmp_path / "frames" / "train" / "c").iterdir():
        path.unlink()
    for path in (tmp_path / "frames" / "train" / "d").iterdir():
        path.unlink()
    (tmp_path / "frames" / "train" / "d").rmdir()
    with pytest.raises(UserError, match=r"d\.txt: there is no folder .*d of its frames; data.skip_missing=true"):
        made(tmp_path)
    data = made(tmp_path, skip_missing=True)
    assert len(data.splits.train) == 2
    drawn = [data.splits.train.choice.draw(i, np.random.default_rng(s)) for i in range(2) for s in range(20)]
    assert names_of(drawn) <= {"a", "b"}  # after the empty film comes the next one
    assert {frame.path.stem for pair in drawn[:20] for frame in pair} == {"0", "2000", "3000"}
    only = FilmText(tmp_path / "train" / "c.txt", tmp_path / "frames" / "train" / "c", skip_missing=True)
    data.splits.train.choice.films = [only]
    with pytest.raises(UserError, match="none of 1 texts has two frames whose pictures are there"):
        data.splits.train.choice.draw(0, np.random.default_rng(0))


def text_of(*rows: str) -> str:
    return "\n".join(["https://film.example/a", *rows])


ROW = realestate_row(0)
BROKEN: dict[str, tuple[str, str]] = {
    "empty": ("", r"a\.txt is empty; expected an address and lines of cameras"),
    "no address": (ROW, r"a\.txt, line 1 has 19 words; expected the film's address alone"),
    "a frame alone": (text_of(ROW), r"a\.txt has 1 frame; expected two at least"),
    "no frames": (text_of(), r"a\.txt has 0 frame"),
    "18 numbers": (text_of(ROW, ROW.rsplit(" ", 1)[0]), r"a\.txt, line 3 has 18 of them; expected .* 19 numbers"),
    "no time": (
        text_of(ROW.replace("0 ", "x ", 1)),
        r"a\.txt, line 2 begins with 'x'; expected a time in microseconds",
    ),
    "NaN": (text_of(ROW.replace("0.9", "nan")), r"a\.txt, line 2: number 3 is 'nan'; expected .* finite"),
    "bad pose": (text_of(ROW.replace("1.0", "1.1")), r"a\.txt, line 2: the pose is no rotation"),
    "no picture": (text_of(ROW, realestate_row(9)), r"a\.txt, line 3: there is no picture .*9000\.png or \.jpg"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_broken_texts_are_named(tmp_path: Path, name: str) -> None:
    text, message = BROKEN[name]
    (realestate_folder(tmp_path) / "train" / "a.txt").write_text(text)
    with pytest.raises(UserError, match=message):
        made(tmp_path)


BROKEN_LISTS: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "short": (lambda words: words[:-1], r"list\.txt, line 1 has 30 words; expected 31: a film, the times"),
    "NaN": (lambda words: [*words[:3], "inf", *words[4:]], r"list\.txt, line 1: number 1 is 'inf'"),
    "pose": (lambda words: [*words[:7], "3", *words[8:]], r"list\.txt, line 1: the pose is no rotation"),
    "film": (lambda words: ["q", *words[1:]], r"list\.txt, line 1: there is no folder .*q of frames"),
    "frame": (lambda words: ["d", "77", *words[2:]], r"list\.txt, line 1: there is no picture .*77\.png"),
    "empty": (lambda words: [], r"list\.txt is empty; expected lines of a film"),
}


@pytest.mark.parametrize("name", BROKEN_LISTS)
def test_broken_lists_are_named(tmp_path: Path, name: str) -> None:
    change, message = BROKEN_LISTS[name]
    pose = ROW.split()[7:]
    words = ["d", "0", "1000", "128", "200", "128", "128", *pose, *pose]
    (realestate_folder(tmp_path) / "list.txt").write_text(" ".join(change(words)) + "\n")
    with pytest.raises(UserError, match=message):
        made(tmp_path, test_list=tmp_path / "list.txt")


def test_folders_that_hold_no_films(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=re.escape(f"data.path={tmp_path / 'no'} is no folder")):
        made(tmp_path / "no")
    with pytest.raises(UserError, match=r"there is no film for train: expected .*train/\*\.txt, and frames of each"):
        made(tmp_path)
    realestate_folder(tmp_path, {"train/a": 2})
    with pytest.raises(UserError, match="train has 1 film; one to train on and one to hold out are needed"):
        made(tmp_path)
    with pytest.raises(UserError, match=r"data\.hold_out must be 2 or more"):
        made(tmp_path, hold_out=1)
