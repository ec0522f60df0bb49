"""Logs of a run that was cut off and went on in its own folder: every step once, nothing lost, one row of HPARAMS."""

from __future__ import annotations

import csv
import errno
import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.plugin_event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.data.provider import ListHyperparametersResult
from tensorboard.plugins.base_plugin import TBContext
from tensorboard.plugins.hparams import api_pb2, backend_context, list_session_groups
from tensorboard.util.tensor_util import make_ndarray

from rendra_lab.experiment import run
from rendra_lab.loggers import CsvTable, TensorBoard

Compose = Callable[..., Any]


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def shown(folder: Path) -> EventAccumulator:
    events = EventAccumulator(str(folder), {"tensors": 0})
    events.Reload()
    return events


def broken_and_resumed(compose: Compose, folder: Path) -> None:
    """A run that breaks at step 17, ten steps after its checkpoint was kept, and goes on in its folder."""
    settings = ("task=toy", "trainer.max_steps=24", "trainer.log_every_n_steps=1", "callbacks.images.every_n_steps=4")
    every = ("callbacks.checkpoint.every_n_train_steps=10", "callbacks.meshes.every_n_steps=4", "report=null")
    with pytest.raises(RuntimeError, match="broke as told"):
        run(compose(folder, *settings, *every, "+module.fail_at=17"))
    (folder / "checkpoints" / "last.ckpt").unlink()
    run(compose(folder, *settings, *every, f"ckpt_path={folder / 'checkpoints' / 'step_000010.ckpt'}"))


def test_a_run_that_goes_on_in_its_folder_has_every_point_once(compose: Compose, tmp_path: Path) -> None:
    folder = tmp_path / "toy" / "run"
    broken_and_resumed(compose, folder)
    rows = [row for row in rows_of(folder / "metrics.csv") if row["train/loss"]]
    assert [int(row["step"]) for row in rows] == list(range(24))
    events = shown(folder)
    assert [event.step for event in events.Tensors("train/loss")] == list(range(24))
    for shown_often in ("train/prediction", "triangle_VERTEX"):
        assert [event.step for event in events.Tensors(shown_often)] == [0, 4, 8, 12, 16, 20, 24]
    losses = [float(row["train/loss"]) for row in rows]
    assert losses == pytest.approx(
        [make_ndarray(event.tensor_proto).item() for event in events.Tensors("train/loss")]
    )
    record = json.loads((folder / "metrics.json").read_text())
    assert record["steps"] == 24
    assert record["resumed_from"] == str(folder / "checkpoints" / "step_000010.ckpt")


def session_groups(root: Path) -> list[Any]:
    """The rows of TensorBoard's HPARAMS tab over all runs below a folder."""
    multiplexer = EventMultiplexer()
    multiplexer.AddRunsFromDirectory(str(root))
    multiplexer.Reload()
    provider = MultiplexerDataProvider(multiplexer, str(root))
    context = backend_context.Context(TBContext(data_provider=provider, logdir=str(root)))
    asked = api_pb2.ListSessionGroupsRequest(
        start_index=0, slice_size=100, allowed_statuses=list(api_pb2.Status.values()), aggregation_type=1
    )
    hparams = context.hparams_metadata(RequestContext(), "")
    nothing_else = ListHyperparametersResult(hyperparameters=[], session_groups=[])
    experiment = context.experiment_from_metadata(RequestContext(), "", True, hparams, nothing_else)
    asked.aggregation_metric.CopyFrom(experiment.metric_infos[0].name)
    handler = list_session_groups.Handler(
        request_context=RequestContext(), backend_context=context, experiment_id="", request=asked
    )
    return list(handler.run().session_groups)


def test_one_table_of_all_runs(compose: Compose, tmp_path: Path) -> None:
    broken_and_resumed(compose, tmp_path / "toy" / "first")
    run(compose(tmp_path / "toy" / "second", "task=toy", "trainer.max_steps=8", "optimizer.lr=0.07", "report=null"))
    first, second = sorted(session_groups(tmp_path / "toy"), key=lambda group: group.name)
    assert [len(group.sessions) for group in (first, second)] == [1, 1]
    assert "(first)" in first.name
    assert "(second)" in second.name
    assert second.hparams["optimizer.lr"].number_value == 0.07
    for group, folder in ((first, "first"), (second, "second")):
        numbers = {value.name.tag: value.value for value in group.metric_values}
        final = json.loads((tmp_path / "toy" / folder / "metrics.json").read_text())["metrics"]
        assert numbers["test/psnr"] == pytest.approx(final["test/psnr"], rel=1e-6)


def test_a_table_without_its_last_line_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "metrics.csv"
    path.write_bytes(b"step,a,b\r\n0,1.0,2.0\r\n1,3.0,4.0\r\n2,5.0,6.")
    table = CsvTable(str(path))
    table.cut(7)
    table.log_metrics({"a": 9.0}, step=7)
    table.finalize("success")
    assert [row["step"] for row in rows_of(path)] == ["0", "1", "7"]


def test_what_follows_a_checkpoint_is_written_at_once(tmp_path: Path) -> None:
    table = CsvTable(str(tmp_path / "metrics.csv"))
    table.save()
    table.log_metrics({"a": 1.0}, step=99)
    assert [row["step"] for row in rows_of(tmp_path / "metrics.csv")] == ["99"]


def full_disk(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """From now on files of such a name take nothing."""
    before = Path.open

    def opened(path: Path, mode: str = "r", *args: Any, **kwargs: Any) -> Any:
        if name in path.name and set(mode) & set("awx"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return before(path, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", opened)


def test_a_full_disk_ends_the_events_not_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    logger = TensorBoard(str(tmp_path))
    logger.log_metrics({"a": 1.0}, step=0)
    logger.save()
    full_disk(monkeypatch, "tfevents")
    with caplog.at_level(logging.WARNING):
        for step in range(1, 200):
            logger.log_metrics({"a": 1.0}, step)
            logger.save()
        logger.close()
    assert caplog.text.count("the run goes on") == 1
    assert [event.step for event in shown(tmp_path).Tensors("a")] == [0]


def test_rows_wait_for_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    table = CsvTable(str(tmp_path / "metrics.csv"), flush_every_rows=1)
    table.log_metrics({"a": 1.0}, step=0)
    with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
        full_disk(patch, "metrics.csv")
        for step in range(1, 5):
            table.log_metrics({"a": 1.0}, step=step)
    assert caplog.text.count("takes no more rows") == 1
    table.finalize("success")
    assert [row["step"] for row in rows_of(tmp_path / "metrics.csv")] == ["0", "1", "2", "3", "4"]
