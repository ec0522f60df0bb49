"""KITTI's odometry folders: the right cameras, pairs a few frames apart, and complaints that name file and line."""

import json
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pair_files import P2, SIZE, kitti_folder, picture, pose

from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.kitti import KittiPairs, read_calibration, read_sequence
from rendra_lab.tasks.synsin.pair_folders import DrawnPairs


def made(folder: Path, **how: Any) -> KittiPairs:
    data = KittiPairs(folder, image_size=list(SIZE), **{"batch_size": 2, **how})
    data.setup("fit")
    return data


def frames_of(pairs: Any) -> list[tuple[str, str]]:
    return [tuple("/".join(frame.path.parts[-3:]) for frame in pair) for pair in pairs]


def test_a_point_lands_where_the_projection_matrices_say(tmp_path: Path) -> None:
    film = read_sequence(kitti_folder(tmp_path), "00")
    points = np.random.default_rng(0).uniform([-2, -1, 8], [2, 1, 20], (9, 3))
    homogeneous = np.concatenate([points, np.ones((9, 1))], 1)
    projection = np.array(P2.split(), float).reshape(3, 4)
    for number in range(4):
        expected = homogeneous @ np.linalg.inv(pose(number)).T @ projection.T
        expected = expected[:, :2] / expected[:, 2:] + 0.5  # KITTI counts from the middle of the first pixel
        fx, fy, cx, cy = film.intrinsics[number]
        x, y, z = (homogeneous @ film.world_to_camera[number].T)[:, :3].T
        np.testing.assert_allclose(np.stack([fx * x / z + cx, fy * y / z + cy], 1), expected, atol=1e-10)


def test_pictures_and_their_relative_motion(tmp_path: Path) -> None:
    data = made(kitti_folder(tmp_path), test_pairs=2)
    pair = data.splits.test[0]
    first, second = (frame.path for frame in data.splits.test.pairs[0])
    for rgb, path in ((pair.input, first), (pair.target, second)):
        expected = torch.from_numpy(picture(900 + int(path.stem))).permute(2, 0, 1)[None] / 255
        torch.testing.assert_close(rgb, expected)
    offset = np.eye(4)
    offset[:3, 3] = read_calibration(tmp_path / "sequences" / "09" / "calib.txt", 2)[1]
    moved = offset @ np.linalg.inv(pose(int(second.stem))) @ pose(int(first.stem)) @ np.linalg.inv(offset)
    torch.testing.assert_close(pair.input_to_target[0], torch.from_numpy(moved).float())
    torch.testing.assert_close(pair.intrinsics, pair.target_intrinsics)
    assert pair.intrinsics[0].tolist() == [[7, 0, 6], [0, 8, 4], [0, 0, 1]]


def test_partners_are_near_and_drawn_from_the_samples_own_stream(tmp_path: Path) -> None:
    data = made(kitti_folder(tmp_path, {"00": 9, "01": 1, "08": 2, "10": 2}), max_offset=2)
    train = data.splits.train
    assert isinstance(train, DrawnPairs)
    assert len(train) == 9  # a frame alone has no partner
    offsets = set()
    for index in range(9):
        for seed in range(20):
            first, second = train.choice.draw(index, np.random.default_rng(seed))
            assert (first.path.stem, first.path.parts[-3]) == (f"{index:06d}", "00")
            offsets.add(int(second.path.stem) - index)
    assert offsets == {-2, -1, 1, 2}
    torch.manual_seed(3)
    one = train[4]
    torch.manual_seed(3)
    torch.testing.assert_close(one.target, train[4].target, rtol=0, atol=0)


def test_batches(tmp_path: Path) -> None:
    data = made(kitti_folder(tmp_path))
    assert data.is_divisible
    batches = list(data.train_dataloader())
    assert [len(batch.input) for batch in batches] == [2, 2]
    assert batches[0].input.shape == (2, 3, *SIZE)
    assert batches[0].truth is None
    assert sum(len(batch.input) for batch in data.test_dataloader()) == 3


def test_a_resumed_epoch_draws_what_the_whole_one_drew(tmp_path: Path) -> None:
    kitti_folder(tmp_path, {"00": 8, "08": 2, "09": 2})
    whole = list(made(tmp_path, seed=5).train_dataloader())
    first, rest = made(tmp_path, seed=5).train_dataloader(), made(tmp_path, seed=5).train_dataloader()
    torch.rand(7)  # a fit draws too
    beginning = iter(first)
    batches = [next(beginning)]
    rest.load_state_dict(first.state_dict())
    batches += list(rest)
    assert len(batches) == len(whole) == 4
    for one, other in zip(batches, whole, strict=True):
        torch.testing.assert_close(one.target, other.target, rtol=0, atol=0)
        torch.testing.assert_close(one.input_to_target, other.input_to_target, rtol=0, atol=0)


def test_workers_get_all_of_it(tmp_path: Path) -> None:
    train = pickle.loads(pickle.dumps(made(kitti_folder(tmp_path)).splits.train))
    assert train[0].input.shape == (1, 3, *SIZE)


def test_the_lists_follow_from_the_seed(tmp_path: Path) -> None:
    kitti_folder(tmp_path, {"00": 3, "08": 30, "09": 30})
    lists = [frames_of(made(tmp_path, seed=seed, val_pairs=10).splits.val.pairs) for seed in (0, 0, 1)]
    assert lists[0] == lists[1] != lists[2]
    assert [int(first[-10:-4]) for first, _ in lists[0]] == list(range(0, 30, 3))


def test_the_division_is_the_usual_one_or_what_is_said(tmp_path: Path) -> None:
    kitti_folder(tmp_path, {f"{i:02d}": 2 for i in (0, 3, 7, 8, 9, 10)})

    def sequences(**how: Any) -> list[set[str]]:
        splits = made(tmp_path, **how).splits
        drawn = [splits.train.choice.draw(i, np.random.default_rng(0)) for i in range(len(splits.train))]
        return [{a.path.parts[-3] for a, _ in pairs} for pairs in (drawn, splits.val.pairs, splits.test.pairs)]

    assert sequences() == [{"00", "03", "07"}, {"08"}, {"09", "10"}]
    assert sequences(train=[3, "08"], val=[0]) == [{"03", "08"}, {"00"}, {"09", "10"}]
    assert sequences(train=[8], val=[0], test=["10"]) == [{"08"}, {"00"}, {"10"}]
    (tmp_path / "division.json").write_text(json.dumps({"train": ["10"], "val": ["09"], "test": ["00"]}))
    assert sequences() == [{"10"}, {"09"}, {"00"}]


def test_a_list_of_test_pairs(tmp_path: Path) -> None:
    kitti_folder(tmp_path, {"00": 6, "08": 2, "09": 5})
    rest = " ".join(["0.1"] * 16)
    (tmp_path / "mine.txt").write_text(f"09_000004 09_000001 {rest}\n\n00_000002 00_000003\n")
    data = made(tmp_path, test_list=tmp_path / "mine.txt")
    assert frames_of(data.splits.test.pairs) == [
        ("09/image_2/000004.png", "09/image_2/000001.png"),
        ("00/image_2/000002.png", "00/image_2/000003.png"),
    ]
    drawn = [data.splits.train.choice.draw(i, np.random.default_rng(s)) for i in range(4) for s in range(9)]
    seen = {frame.path.stem for pair in drawn for frame in pair}
    assert len(data.splits.train) == 4
    assert seen == {"000000", "000001", "000004", "000005"}  # never one of the list
    (tmp_path / "test_pairs.txt").write_text("08_000000 08_000001\n")
    assert len(made(tmp_path).splits.test) == 1


def edit(name: str, old: str, new: str, count: int = 1) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, count))

    return change


def rewrite(name: str, text: str | bytes) -> Callable[[Path], None]:
    return lambda folder: (folder / name).write_bytes(text.encode() if isinstance(text, str) else text) and None


def remove(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


CALIB, POSES = "sequences/00/calib.txt", "poses/00.txt"
BROKEN: dict[str, tuple[Callable[[Path], None], str]] = {
    "no calib": (remove(CALIB), r"there is no file .*calib\.txt; expected a line 'P2:' with 12 numbers"),
    "calib without P2": (
        edit(CALIB, "P2", "P3"),
        r"calib\.txt: 'P2' is missing; expected 12 numbers .*it has P0, P3",
    ),
    "P2 of 11": (
        edit(CALIB, " 0.005", ""),
        r"calib\.txt, line 2, 'P2' has 11 of them; expected 12 numbers of a matrix",
    ),
    "P2 with a word": (edit(CALIB, "0.005", "x"), r"calib\.txt, line 2, 'P2': number 12 is 'x'; expected 12 numbers"),
    "P2 of no camera": (
        edit(CALIB, "P2: 7.0 0", "P2: 7.0 1"),
        r"'P2' begins with \[\[7.0, 1.0, 5.5\].*expected \[\[fx,0",
    ),
    "negative focal length": (edit(CALIB, "P2: 7.0", "P2: -7.0"), r"'P2' begins with \[\[-7.0"),
    "empty calib": (rewrite(CALIB, " \n"), r"calib\.txt is empty; expected a line 'P2:'"),
    "no poses": (remove(POSES), r"there is no file .*00\.txt; expected lines of 12 numbers"),
    "empty poses": (rewrite(POSES, ""), r"00\.txt is empty; expected lines of 12 numbers"),
    "poses are no text": (rewrite(POSES, b"\xff\xfe\x00"), r"00\.txt is no text: .* at byte 0"),
    "NaN pose": (edit(POSES, "1.0", "nan"), r"00\.txt, line 1: number 1 is 'nan'; expected 12 numbers.*finite"),
    "short pose": (rewrite(POSES, "1 0 0 0 0 1 0 0 0 0 1\n"), r"00\.txt, line 1 has 11 of them; expected 12 numbers"),
    "scaling pose": (rewrite(POSES, "2 0 0 0 0 1 0 0 0 0 1 0\n" * 4), r"00\.txt, line 1: the pose is no rotation"),
    "mirroring pose": (rewrite(POSES, "-1 0 0 0 0 1 0 0 0 0 1 0\n" * 4), r"00\.txt, line 1: the pose mirrors"),
    "missing frame": (
        remove("sequences/00/image_2/000002.png"),
        r"00\.txt, line 3: there is no picture .*000002\.png",
    ),
    "more frames": (
        rewrite(POSES, "1 0 0 0 0 1 0 0 0 0 1 0\n"),
        r"image_2 holds 4 pictures, but 1 poses are known",
    ),
    "list of words": (
        rewrite("test_pairs.txt", "a b\n"),
        r"test_pairs\.txt, line 1 begins with 'a b'; expected two frames",
    ),
    "list of one": (rewrite("test_pairs.txt", "00_1\n"), r"test_pairs\.txt, line 1 begins with '00_1'"),
    "list of two sequences": (
        rewrite("test_pairs.txt", "00_0 08_1\n"),
        r"line 1 pairs frames of two sequences, 00_0 and 08_1",
    ),
    "list beyond the end": (
        rewrite("test_pairs.txt", "\n00_0 00_4\n"),
        r"line 2 names frame 4 of sequence 00, which has 4",
    ),
    "list of unknown": (
        rewrite("test_pairs.txt", "77_0 77_1\n"),
        r"test_pairs\.txt, line 1: there is no folder .*77",
    ),
    "empty list": (rewrite("test_pairs.txt", ""), r"test_pairs\.txt is empty; expected pairs such as"),
    "division without test": (rewrite("division.json", '{"train": [], "val": []}'), r"'test' is missing"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_broken_is_named(tmp_path: Path, name: str) -> None:
    change, message = BROKEN[name]
    kitti_folder(tmp_path)
    change(tmp_path)
    with pytest.raises(UserError, match=message):
        made(tmp_path)


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"path": "nowhere"}, "there is no folder nowhere; data.path is the one that holds sequences and poses"),
        ({"camera": 3}, "there is no file|'P3' is missing; expected 12 numbers"),
        ({"camera": 4}, "data.camera must be a whole number from 0 to 3, got 4"),
        ({"train": [5]}, "there is no folder .*05, a sequence of data.train"),
        ({"train": ["08"]}, "sequence 08 is in data.train and in data.val; expected it in one of them"),
        ({"val": []}, "none of the sequences that are for val: say which are, as in data.val="),
        ({"max_offset": 0}, "data.max_offset must be a whole number of at least 1, got 0"),
        ({"test_list": "no.txt"}, "there is no file no.txt; expected pairs"),
        ({"val_pairs": 0}, "data.val_pairs must be"),
        ({"scale": 0.0}, "data.scale must be a number above 0"),
        ({"image_size": 0}, r"data.image_size must be one side or \[height,width\], 1 to 8192 pixels, got 0"),
        ({"image_size": [8, 8, 8]}, r"data.image_size must be .*, got \[8, 8, 8\]"),
        ({"truth_in_training": True}, "data.truth_in_training=true: nobody knows the depth"),
    ],
)
def test_settings_that_cannot_be(tmp_path: Path, how: dict[str, Any], message: str) -> None:
    kitti_folder(tmp_path)
    with pytest.raises(UserError, match=message):
        KittiPairs(**{"path": tmp_path, **how}).setup("fit")


def test_too_little_to_train_on(tmp_path: Path) -> None:
    kitti_folder(tmp_path, {"00": 1, "08": 2, "09": 2})
    with pytest.raises(UserError, match=re.escape("no two frames of the sequences ['00'] are left to train on")):
        made(tmp_path)
    kitti_folder(tmp_path / "other", {"00": 2, "08": 1, "09": 2})
    with pytest.raises(UserError, match=re.escape("the sequences data.val=['08'] hold no pair of frames")):
        made(tmp_path / "other")
