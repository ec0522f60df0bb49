"""Folders of pictures: lazily read, mirrored, held out if asked for, and a broken one does what was said."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.image_folder import ImageFolder


def folder(path: Path, count: int, broken: tuple[int, ...] = ()) -> Path:
    """Pictures whose left half is black and whose right half says which one it is."""
    path.mkdir()
    for i in range(count):
        pixels = np.zeros((16, 16, 3), np.uint8)
        pixels[:, 8:] = 40 + 20 * i
        Image.fromarray(pixels).save(path / f"{i:02}.png")
        if i in broken:
            (path / f"{i:02}.png").write_bytes(b"\x89PNG\r\n\x1a\n nothing")
    return path


def data(path: Path, **settings: Any) -> ImageFolder:
    made = ImageFolder(path, **{"image_size": 8, "batch_size": 2, **settings})
    made.setup("fit")
    return made


def numbers(batches: Iterable[Any]) -> list[int]:
    """Which pictures they are."""
    return [(round(float(each.max()) * 255) - 40) // 20 for batch in batches for each in batch.rgb]


def test_training_sees_every_picture_and_mirrors_every_other(tmp_path: Path) -> None:
    made = data(folder(tmp_path / "set", 8))
    loader = made.train_dataloader()
    batches = [batch for _ in range(8) for batch in loader]
    assert sorted(numbers(batches[:4])) == list(range(8))
    mirrored = [bool(each[0, 0, 0] > each[0, 0, 7]) for batch in batches for each in batch.rgb]
    assert 16 < sum(mirrored) < 48
    plain = data(tmp_path / "set", flip=False)
    assert not any(bool(each[0, 0, 0] > each[0, 0, 7]) for batch in plain.train_dataloader() for each in batch.rgb)
    assert all(batch.truth is None for batch in batches)


def test_evaluation_is_the_same_each_time_and_draws_nothing_from_the_fit(tmp_path: Path) -> None:
    made = data(folder(tmp_path / "set", 8), random_crop=True, val_pictures=3, test_pictures=100)
    torch.manual_seed(5)
    first = [batch.rgb for batch in made.val_dataloader()]
    drawn = torch.rand(())
    torch.manual_seed(5)
    assert drawn == torch.rand(())
    again = [batch.rgb for batch in made.val_dataloader()]
    assert torch.equal(torch.cat(first), torch.cat(again))
    assert len(torch.cat(first)) == 3
    assert sorted(numbers(made.test_dataloader())) == list(range(8))


def test_what_is_held_out_is_never_trained_on(tmp_path: Path) -> None:
    made = data(folder(tmp_path / "set", 8), hold_out=0.25)
    train = numbers(made.train_dataloader())
    test = numbers(made.test_dataloader())
    assert sorted(train + test) == list(range(8))
    assert len(test) == 2
    with pytest.raises(UserError, match=r"data\.hold_out=1 leaves none of the 8 pictures"):
        data(tmp_path / "set", hold_out=1.0)
    with pytest.raises(UserError, match=r"data\.batch_size=9 is more than the 8 training pictures"):
        data(tmp_path / "set", batch_size=9).train_dataloader()


def test_a_broken_picture_is_named_and_the_run_stops_or_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    path = folder(tmp_path / "set", 6, broken=(2, 3))
    with pytest.raises(UserError, match=r"0[23].png is not a picture.*data.on_broken=skip goes on without it"):
        list(data(path).train_dataloader())
    made = data(path, on_broken="skip")
    seen = numbers(made.train_dataloader())
    assert len(seen) == 6  # a whole one stands in for each
    assert set(seen) == {0, 1, 4, 5}
    made.teardown("fit")
    list(made.test_dataloader())
    made.teardown("test")
    assert capsys.readouterr().out == "2 of 6 pictures could not be read and were skipped\n"
    assert "02.png" in caplog.text


def test_workers_and_the_run_share_what_they_know_of_broken_pictures(tmp_path: Path) -> None:
    path = folder(tmp_path / "set", 4)
    assert [data(path, num_workers=count).reader._is_broken.is_shared() for count in (0, 1)] == [False, True]


def test_a_folder_of_broken_pictures_alone_is_an_error(tmp_path: Path) -> None:
    made = data(folder(tmp_path / "set", 3, broken=(0, 1, 2)), on_broken="skip")
    with pytest.raises(UserError, match=r"none of the 3 pictures can be read; the first is .*00.png"):
        made.splits.train[0]
    with pytest.raises(IndexError, match="there are 3 pictures"):
        made.splits.train[3]


def test_giraffe_learns_from_a_folder_for_a_step(compose: Callable[..., Any], tmp_path: Path) -> None:
    from rendra_lab.experiment import run

    path = folder(tmp_path / "set", 4, broken=(1,))
    settings = ("task=giraffe", "data=image_folder", f"data.path={path}", "world=faces", "data.on_broken=skip")
    few = ("data.batch_size=2", "debug=fast", "trainer.max_steps=1", "optimized_metric=null")
    few += ("metric.fd_lite0=null", "metric.kid_lite0=null")
    few += ("callbacks.images.every_n_steps=0", "callbacks.animation=null", "callbacks.controls=null")
    run(compose(tmp_path / "giraffe" / "run", *settings, *few))
    assert json.loads((tmp_path / "giraffe" / "run" / "metrics.json").read_text())["steps"] == 1
