"""The report of a test: a model that copies scores what copying scores, and every file is there."""

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from assertions import assert_close
from lightning.pytorch import LightningModule, Trainer
from PIL import Image
from torch import nn

from rendra_lab import metrics
from rendra_lab.base_task import BaseTask
from rendra_lab.errors import UserError
from rendra_lab.networks import efficientnet_lite
from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.tasks.synsin import pair_table, scores
from rendra_lab.tasks.synsin.baselines import baselines
from rendra_lab.tasks.synsin.generated_pairs import GeneratedPairs
from rendra_lab.tasks.synsin.pair_data import PairData, PairSplits, joined
from rendra_lab.tasks.synsin.pair_table import formatted, means_of, numbers_of, results
from rendra_lab.tasks.synsin.records import PairBatch, PairTruth, ViewPrediction
from rendra_lab.tasks.synsin.report import PairReport
from rendra_lab.tasks.synsin.scores import depth_term, view_term

_SIDE, _FOCAL, _WALL = 24, 20.0, 5.0


def wall_pair(seed: int, columns: int = 2, visible: str = "some") -> PairBatch:
    """A batch of one: a wall of noise that moves by whole pixels to the right."""
    generator = torch.Generator().manual_seed(seed)
    picture = torch.rand(1, 3, _SIDE, _SIDE, generator=generator)
    target = torch.roll(picture, columns, 3)
    target[..., :columns] = torch.rand(1, 3, _SIDE, columns, generator=generator)
    lens = torch.tensor([[[_FOCAL, 0, _SIDE / 2], [0, _FOCAL, _SIDE / 2], [0, 0, 1]]])
    move = torch.eye(4)[None].clone()
    move[0, 0, 3] = columns * _WALL / _FOCAL
    depth = torch.full((1, 1, _SIDE, _SIDE), _WALL)
    depth[..., :2, :] = torch.inf
    seen = torch.zeros_like(depth, dtype=torch.bool)
    seen[..., columns:] = True
    seen = {"some": seen, "all": torch.ones_like(seen), "none": torch.zeros_like(seen)}[visible]
    return PairBatch(picture, target, lens, lens, move, PairTruth(depth, depth, seen))


class Walls(PairData):
    """Five such pairs, one of which is visible altogether and one not at all."""

    def __init__(self, with_truth: bool = True, **parts: Any) -> None:
        super().__init__(batch_size=2, **parts)
        self.with_truth = with_truth

    def load(self) -> PairSplits:
        pairs = [wall_pair(seed, visible=word) for seed, word in enumerate(("some", "all", "none", "some", "some"))]
        if not self.with_truth:
            pairs = [replace(pair, truth=None) for pair in pairs]
        return PairSplits(train=pairs, val=pairs, test=pairs)

    def typical_depth(self) -> float | None:
        return 4.0 if self.with_truth else None


class Copier(BaseTask[PairBatch, ViewPrediction]):
    """Its new view is the old one, its depth rises from row to row."""

    def __init__(self, **parts: Any) -> None:
        super().__init__(**parts)
        self.gain = nn.Parameter(torch.ones(()))

    def predict(self, batch: PairBatch) -> ViewPrediction:
        depth = torch.linspace(1, 2, _SIDE)[:, None].expand(len(batch.input), 1, _SIDE, _SIDE)
        return ViewPrediction(batch.input * self.gain, depth, batch.input, torch.ones_like(depth))


def scored(task: LightningModule, data: PairData, callbacks: Sequence[Any]) -> dict[str, float]:
    silent = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = Trainer(accelerator="cpu", callbacks=[*callbacks], enable_model_summary=False, **silent)
    trainer.test(task, datamodule=data, verbose=False)
    return {name: float(value) for name, value in trainer.callback_metrics.items()}


def terms() -> dict[str, Any]:
    regions = {f"psnr_{region}": view_term("psnr", region) for region in ("visible", "invisible")}
    return {"psnr": view_term("psnr"), "ssim": view_term("ssim"), **regions, "depth_abs_rel": depth_term("abs_rel")}


@pytest.fixture
def without_features(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scores, "has_weights", lambda: False)


@pytest.fixture
def report(tmp_path: Path) -> PairReport:
    return PairReport(str(tmp_path / "exports"), pictures=3, on_sheet=2)


@pytest.mark.usefixtures("without_features")
def test_a_report_leaves_pictures_numbers_and_a_table(
    report: PairReport, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = scored(Copier(metrics=terms()), Walls(), [report])
    for name in ("psnr", "ssim", "psnr_visible", "psnr_invisible"):
        assert found[f"test/copy_{name}"] == pytest.approx(found[f"test/{name}"], rel=1e-5)
    assert found["test/true_warp_psnr_visible"] > found["test/constant_warp_psnr_visible"]
    assert "test/model_psnr" not in found
    with (tmp_path / "exports" / "pairs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["pair"] for row in rows] == ["0", "1", "2", "3", "4"]
    assert [row["copy_psnr_visible"] == "" for row in rows] == [False, False, True, False, False]
    assert [row["copy_psnr_invisible"] == "" for row in rows] == [False, True, False, False, False]
    table = (tmp_path / "exports" / "results.md").read_text()
    assert table.startswith("# 5 new views\n")
    assert table in capsys.readouterr().out
    line = next(line for line in table.splitlines() if line.startswith("| psnr, visible"))
    expected = [
        f"{found[f'test/{name}_psnr_visible']:.2f}" for name in ("copy", "copy", "true_warp", "constant_warp")
    ]
    assert [cell.strip() for cell in line.strip("|").split("|")][1:] == expected
    assert "4 targets have visible pixels, 4 invisible ones" in table
    assert "The constant depth is 4 m." in table
    files = sorted(path.name for path in (tmp_path / "exports" / "pairs").iterdir())
    each = ["constant_warp", "depth", "input", "output", "target", "true_depth", "true_warp", "visible"]
    assert files == sorted(f"{pair:04d}{name}.png" for pair in (0, 1, 3) for name in ["", *(f"_{n}" for n in each)])
    with Image.open(tmp_path / "exports" / "pairs" / "0003_target.png") as image:
        assert_close(torch.from_numpy(np.array(image)) / 255, wall_pair(3).target[0].movedim(0, -1), atol=0.5 / 255)
    with Image.open(tmp_path / "images" / "pairs.png") as sheet:
        assert sheet.height > 2 * 128


@pytest.mark.usefixtures("without_features")
def test_without_a_truth_only_what_is_possible_is_compared(report: PairReport, tmp_path: Path) -> None:
    found = scored(Copier(metrics={"psnr": view_term("psnr")}), Walls(with_truth=False), [report])
    assert {name for name in found if "warp" in name or "visible" in name} == set()
    assert "test/copy_psnr" in found
    assert (tmp_path / "exports" / "pairs" / "0000_depth.png").is_file()
    given = PairReport(str(tmp_path / "given"), pictures=0, constant_depth=_WALL)
    found = scored(Copier(), Walls(with_truth=False), [given])
    assert found["test/constant_warp_psnr"] > found["test/copy_psnr"] + 3
    assert sorted(path.name for path in (tmp_path / "given").iterdir()) == ["pairs.csv", "results.md"]


def test_the_table_counts_pairs_that_have_something_to_score() -> None:
    rows = [{"model_psnr": 10.0, "visible": 1.0, "model_psnr_visible": 20.0}]
    rows += [{"model_psnr": 20.0, "visible": 0.0, "model_psnr_visible": None}]
    assert means_of(rows) == {"model_psnr": 15.0, "visible": 0.5, "model_psnr_visible": 20.0}
    assert means_of([]) == {}
    assert "| psnr, visible | 20.00 |" in results(rows, None)
    assert "invisible |" not in results(rows, None)
    assert [formatted("ssim", value) for value in (None, float("nan"), 0.5)] == ["-", "nan", "0.500"]


@pytest.mark.usefixtures("without_features")
def test_small_pictures_have_no_ssim_and_broken_ones_no_number() -> None:
    small = wall_pair(0)
    small = replace(small, input=small.input[..., :8, :8] * torch.nan, target=small.target[..., :8, :8], truth=None)
    prediction = ViewPrediction(small.input, small.input[:, :1], small.input, small.input[:, :1])
    (row,) = numbers_of({"model": small.input}, prediction, small)
    assert list(row) == ["model_psnr"]
    assert formatted("psnr", row["model_psnr"]) == "nan"


def test_regions_are_those_of_the_truth() -> None:
    batch = joined([wall_pair(0), wall_pair(1, visible="none"), wall_pair(2, visible="all")])
    channels_last = (batch.input.movedim(1, -1), batch.target.movedim(1, -1))
    for measure, score in (("psnr", metrics.psnr_of_each), ("ssim", metrics.ssim_of_each)):
        whole = scores.view_scores(batch.input, batch.target, measure=measure, region="whole")
        assert_close(whole.value, score(*channels_last).value)
        for region, counted in (("visible", [True, False, True]), ("invisible", [True, True, False])):
            found = scores.view_scores(batch.input, batch.target, truth=batch.truth, measure=measure, region=region)
            assert batch.truth is not None
            mask = batch.truth.visible[:, 0] == (region == "visible")
            rim_is_all = measure == "ssim" and region == "invisible"  # two columns: the middle of no window
            assert found.counted.tolist() == ([False, True, False] if rim_is_all else counted)
            assert_close(found.value[found.counted], score(*channels_last, mask).value[found.counted])


@pytest.mark.skipif(not efficientnet_lite.has_weights(), reason="needs the extra [features]")
def test_the_perceptual_distance_sees_its_region_alone() -> None:
    batch = joined([wall_pair(0), wall_pair(1, visible="none")])
    assert batch.truth is not None
    changed = torch.where(batch.truth.visible, batch.target, 1 - batch.target)
    options = {"truth": batch.truth, "measure": "perceptual_lite0"}
    visible = scores.view_scores(changed, batch.target, region="visible", **options)
    assert visible.counted.tolist() == [True, False]
    assert float(visible.value[0]) == 0
    invisible = scores.view_scores(changed, batch.target, region="invisible", **options)
    assert invisible.counted.all()
    assert float(invisible.value.min()) > 0.1
    assert_close(invisible.value[1], scores.view_scores(changed, batch.target, region="whole", **options).value[1])
    rows = numbers_of({"model": changed}, ViewPrediction(changed, *[batch.truth.depth] * 3), batch)
    assert rows[0]["model_perceptual_lite0_visible"] == 0
    assert "perceptual_lite0, visible" in pair_table.results(rows, None)


def test_terms_without_their_truth_say_how_to_leave_them_out() -> None:
    batch = replace(wall_pair(0), truth=None)
    prediction = Copier().predict(batch)
    for term, name in ((view_term("ssim", "visible"), "ssim_visible"), (depth_term("abs_rel"), "depth_abs_rel")):
        with pytest.raises(UserError, match=f"metric.{name}=null"):
            term(prediction, batch)


def test_the_perceptual_term_needs_its_extra(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scores, "has_weights", lambda: False)
    assert view_term("perceptual_lite0") is None
    assert view_term("perceptual_lite0", "visible") is None
    assert capsys.readouterr().out.count("rendra[features]") == 1
    assert scores.measures() == ["psnr", "ssim"]


def test_baselines_are_those_whose_depth_is_known() -> None:
    batch = wall_pair(0)
    assert list(baselines(batch, 3.0)) == ["copy", "true_warp", "constant_warp"]
    assert list(baselines(replace(batch, truth=None), None)) == ["copy"]


class Flats:
    """Places of one depth each, 3, 4, 5 ... metres, under a sky that fills three quarters of the pictures."""

    def __init__(self) -> None:
        self.made = 0

    def settings(self) -> tuple[object, ...]:
        return ()

    def views(self, seed: int, count: int, size: tuple[int, int]) -> PosedViews:
        depth = torch.full((count, 1, *size), torch.inf)
        depth[..., : size[0] // 4, :] = 3.0 + self.made
        self.made += 1
        lens = torch.eye(3).expand(count, 3, 3).contiguous()
        return PosedViews(
            torch.zeros(count, 3, *size, dtype=torch.uint8), depth, lens, torch.eye(4).repeat(count, 1, 1)
        )


def test_the_typical_depth_is_that_of_the_training_places_without_their_sky() -> None:
    assert GeneratedPairs(Flats(), image_size=8, counts=(3, 2, 2)).typical_depth() == 4.0
    skies = GeneratedPairs(Flats(), image_size=8, counts=(1, 0, 0))
    skies.setup("test")
    skies.splits.train.places[0].depth.fill_(torch.inf)  # type: ignore[attr-defined]
    assert skies.typical_depth() is None
