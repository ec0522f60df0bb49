"""A generator that is what it should be gets the best of all numbers; each fault shows in the one that names it."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

import pytest
import torch
from assertions import assert_close
from far_device import far  # noqa: F401
from lightning.pytorch import LightningModule, Trainer
from PIL import Image
from scenes_of_discs import Discs

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.control_report import ControlReport
from rendra_lab.tasks.giraffe.control_table import results
from rendra_lab.tasks.giraffe.disentanglement import (
    Probe,
    Views,
    areas,
    centroids,
    changes,
    follows,
    means_of,
    measure,
    object_mask,
    overlap,
    widened,
)
from rendra_lab.tasks.giraffe.records import PictureBatch, PictureTruth

PROBE = Probe(scenes=5, turns=4, at_once=3)


def found(*faults: str) -> dict[str, float]:
    return means_of(measure(Discs(*faults), PROBE).rows)


def test_controls_that_do_what_they_say() -> None:
    means = found()
    assert means["seen"] == 1
    for control in ("turn", "move", "scale", "appearance", "shape"):
        assert means[f"{control}_background_change"] == pytest.approx(0, abs=1e-6), control
        assert means[f"{control}_object_change"] > 0.01, control
    assert means["move_correlation"] > 0.999
    assert means["move_slope"] == pytest.approx(1, abs=0.03)
    assert means["scale_correlation"] > 0.99
    assert means["scale_slope"] == pytest.approx(1, abs=0.08)  # pixels
    assert means["appearance_mask_iou"] > 0.98
    assert 0.5 < means["shape_mask_iou"] < 0.95
    assert means["background_object_change"] == pytest.approx(0, abs=1e-6)
    assert means["background_background_change"] > 0.05


def test_a_background_that_follows_the_object_is_seen() -> None:
    means = found("glow")
    assert means["turn_background_change"] > 0.05
    assert means["move_background_change"] == pytest.approx(0, abs=1e-6)


def test_an_object_that_does_not_follow_is_seen() -> None:
    means = found("stuck")
    assert means["move_correlation"] == 0
    assert means["move_slope"] == 0


def test_objects_that_are_not_seen_are_not_scored() -> None:
    findings = measure(Discs("blind"), PROBE)
    assert {row["seen"] for row in findings.rows} == {0.0}
    assert {row["turn_background_change"] for row in findings.rows} == {None}
    assert means_of(findings.rows) == {"seen": 0.0, "mask_share": 0.0}
    assert "in 0 of which the object is seen" in results(findings.rows, PROBE)
    assert means_of([]) == {}


def test_the_same_seed_gives_the_same_numbers_whatever_the_batch() -> None:
    assert measure(Discs(), PROBE).rows == measure(Discs(), PROBE).rows
    torch.manual_seed(0)
    before = torch.get_rng_state()
    measure(Discs(), Probe(scenes=1, turns=2))
    assert torch.equal(torch.get_rng_state(), before)
    with pytest.raises(UserError, match="object must be below 1"):
        measure(Discs(), Probe(scenes=1, object=1))


def test_scores_stay_on_the_device_of_the_scenes(far: Any) -> None:  # noqa: F811
    probe = Probe(scenes=2, turns=2)
    assert measure(Discs(device=far), probe).rows == measure(Discs(), probe).rows


def test_masks_and_their_places() -> None:
    masks = torch.zeros(2, 1, 8, 8, dtype=torch.bool)
    masks[0, 0, 2:4, 0:2] = True
    masks[1, 0, 2:4, 1:3] = True
    assert areas(masks).tolist() == [[4.0], [4.0]]
    assert centroids(masks).flatten().tolist() == pytest.approx([-0.75, -0.5])  # of a picture from -1 to 1
    assert overlap(masks).tolist() == pytest.approx([2 / 6])
    assert overlap(torch.zeros_like(masks)).tolist() == [0]
    assert areas(widened(masks, 1)).tolist() == [[12.0], [16.0]]  # cut where the picture ends
    assert centroids(torch.zeros_like(masks)).isnan().all()
    one = torch.zeros(3, 8, 8)
    other = one.clone()
    other[1, 4, 4] = 0.2
    assert object_mask(one, other, 0.1).sum() == 1
    assert object_mask(one, other, 0.3).sum() == 0


def test_changes_are_those_inside_and_outside() -> None:
    rgb = torch.zeros(2, 1, 3, 20, 20)
    masks = torch.zeros(2, 1, 20, 20, dtype=torch.bool)
    masks[:, :, :10] = True
    rgb[1, :, :, :10] = 0.5
    rgb[1, :, :, 10:] = 0.25
    both = changes(Views(rgb, masks))
    assert both["object"].item() == pytest.approx(0.5)
    assert both["background"].item() == pytest.approx(0.25)
    nowhere = changes(Views(rgb, torch.ones_like(masks)))
    assert math.isnan(nowhere["background"].item())


def test_following_a_command() -> None:
    command = torch.tensor([-1.0, 0.0, 1.0])
    answers = torch.tensor([[-2.0, 1.0, 5.0, torch.nan], [0.0, 0.0, 5.0, 0.0], [2.0, -1.0, 5.0, 1.0]])
    correlation, slope = follows(command, answers)
    assert_close(correlation, torch.tensor([1.0, -1.0, 0.0, 0.0], dtype=torch.float64))
    assert_close(slope, torch.tensor([2.0, -1.0, 0.0, 0.0], dtype=torch.float64))


class Made(LightningModule):
    """A task that keeps what is logged."""

    def __init__(self) -> None:
        super().__init__()
        self.logged: dict[str, float] = {}

    def log(self, name: str, value: Any, **_: Any) -> None:
        self.logged[name] = float(value)


@pytest.fixture
def trainer() -> Trainer:
    return Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)


def test_a_report_leaves_a_table_numbers_and_a_sheet(
    trainer: Trainer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    task = Made()
    task.averaged = Discs()
    report = ControlReport(str(tmp_path / "exports"), scenes=3, on_sheet=2, turns=8)
    masks = torch.zeros(2, 2, 8, 8, dtype=torch.bool)
    masks[0, 0, :4] = masks[1, 0, :2] = True
    kind = torch.tensor([[3, -1], [1, -1]])  # one object each
    truth = PictureTruth(masks, torch.zeros(2, 2, 4), torch.zeros(2, 2), kind)
    report.on_test_start(trainer, task)
    report.on_test_batch_end(trainer, task, None, PictureBatch(torch.rand(2, 3, 8, 8), truth), 0)
    report.on_test_batch_end(trainer, task, None, PictureBatch(torch.rand(2, 3, 8, 8)), 1)
    report.on_test_epoch_end(trainer, task)
    report.on_test_end(trainer, task)
    assert task.logged["test/true_mask_share"] == pytest.approx(3 / 8)
    assert task.logged["test/seen"] == 1
    assert task.logged["test/turn_background_change"] == pytest.approx(0, abs=1e-6)
    with (tmp_path / "exports" / "controls.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["scene"] for row in rows] == ["0", "1", "2"]
    text = (tmp_path / "exports" / "controls.md").read_text()
    assert text in capsys.readouterr().out
    assert text.startswith("# Controls of 3 scenes, in 3 of which the object is seen")
    assert "place: correlation 1.000, slope" in text
    assert "of the picture; a real one covers 37.50 %." in text
    with Image.open(tmp_path / "images" / "controls.png") as sheet:
        assert sheet.width > 2 * 5 * 64
        assert sheet.height > 3 * 2 * 64


def test_a_task_without_an_average_is_left_alone(trainer: Trainer, tmp_path: Path) -> None:
    report = ControlReport(str(tmp_path / "exports"))
    report.on_test_epoch_end(trainer, Made())
    report.on_test_end(trainer, Made())
    assert not (tmp_path / "exports").exists()
