"""What is kept is what was trained; names, folders and files that cannot be are said in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf
from torch import nn

from rendra_lab import zoo
from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.generator import Generator
from rendra_lab.weights_file import write_weights_file

RECORD = {
    "status": "ok",
    "task": "toy",
    "overrides": ["task=toy", "data=dots", "output_root=/somewhere", "hydra.run.dir=/somewhere"],
    "seed": 3,
    "steps": 40,
    "metrics": {"train/loss": 1.0, "test/score": 0.25, "test/nothing": None},
    "device": "cpu",
    "seconds": {"fit": 90.0, "total": 100.0},
    "git_commit": "abc",
}
CONFIG = {
    "width": 4,
    "run_dir": "${hydra:runtime.output_dir}",
    "module": {
        "_target_": "rendra_lab_toy.Toy",
        "generator": {"_target_": "torch.nn.Linear", "in_features": "${width}", "out_features": 2},
        "words": {"of": "nothing"},
    },
}


def finished_run(folder: Path) -> tuple[Path, nn.Linear]:
    """The folder of a run, and what it trained."""
    (folder / ".hydra").mkdir(parents=True)
    OmegaConf.save(OmegaConf.create(CONFIG), folder / ".hydra" / "config.yaml")
    OmegaConf.save({"hydra": {"runtime": {"choices": {"data": "dots"}}}}, folder / ".hydra" / "hydra.yaml")
    (folder / "metrics.json").write_text(json.dumps(RECORD))
    trained = nn.Linear(4, 2)
    weights = {f"averaged.{name}": value for name, value in trained.state_dict().items()}
    write_weights_file(folder / "weights.safetensors", {**weights, "other.weight": torch.ones(1)}, {})
    return folder, trained


def kept(tmp_path: Path, **changes: Any) -> tuple[Path, nn.Linear]:
    run, trained = finished_run(tmp_path / "run")
    settings: dict[str, Any] = {"name": "dots", "weights": str(run / "weights.safetensors"), **changes}
    return zoo.keep(run, zoo=tmp_path / "zoo", **settings), trained


def test_what_is_kept_comes_back(tmp_path: Path) -> None:
    folder, trained = kept(tmp_path)
    assert sorted(path.name for path in folder.iterdir()) == ["card.md", "part.yaml", "weights.safetensors"]
    assert zoo.names(tmp_path / "zoo") == ["dots"]
    network = zoo.load("dots", tmp_path / "zoo")
    assert isinstance(network, nn.Linear)
    assert torch.equal(network.weight, trained.weight)
    assert not network.training
    assert not network.weight.requires_grad


def test_a_card_tells_data_command_time_and_scores(tmp_path: Path) -> None:
    folder, _ = kept(tmp_path)
    card = (folder / "card.md").read_text()
    for line in (
        "# dots",
        "- data: dots",
        "- parameters: 10",
        "- command: `python train.py task=toy data=dots`",  # and nothing of this machine
        "- seed: 3",
        "- time: 1.5 min on cpu",
        "| test/score |  0.25 |",
    ):
        assert line in card.splitlines(), card
    assert "somewhere" not in card
    assert "nothing" not in card
    assert "before it was tested" in zoo.card("dots", {"overrides": []}, {}, 1)


def test_names_that_cannot_be(tmp_path: Path) -> None:
    kept(tmp_path)
    with pytest.raises(UserError, match="the zoo keeps no 'dot'; did you mean dots"):
        zoo.load("dot", tmp_path / "zoo")
    with pytest.raises(UserError, match="keeps no 'cow'; there are: none"):
        zoo.load("cow", tmp_path / "nowhere")
    for name in ("../dots", "Dots", ""):
        with pytest.raises(UserError, match="small letters, digits and underscores"):
            zoo.keep(tmp_path / "run", name, tmp_path / "zoo")
    with pytest.raises(UserError, match=r"keeps a dots already: remove .*dots first"):
        zoo.keep(tmp_path / "run", "dots", tmp_path / "zoo")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"part": "raw"}, "has no part raw with weights; it has: averaged, other"),
        ({"key": "module.words"}, r"its task is Toy, whose configuration builds nothing at module\.words"),
        ({"part": "other"}, "other of .*run does not fit this configuration"),
    ],
)  # fmt: skip
def test_parts_that_are_not_there(tmp_path: Path, changes: dict[str, str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        kept(tmp_path, **changes)
    assert zoo.names(tmp_path / "zoo") == []


def test_large_networks_are_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zoo, "MOST_MB", 2e-5)
    with pytest.raises(UserError, match="MB of weights; the zoo keeps up to 2e-05 MB"):
        kept(tmp_path)


def break_weights(folder: Path) -> None:
    path = folder / "weights.safetensors"
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (break_weights, "is damaged: its tensors fail their checksum"),
        (lambda folder: (folder / "part.yaml").write_text("part: [1"), r"part\.yaml is damaged"),
        (lambda folder: (folder / "part.yaml").write_text("task: toy"), "does not say how the part is built"),
        (
            lambda folder: (folder / "part.yaml").write_text("part: {_target_: os.system, command: true}"),
            r"a configuration may not call 'os\.system'|is a checkpoint of torch\.nn\.Linear",
        ),
    ],
)
def test_what_is_damaged_or_hostile_is_refused(
    tmp_path: Path, damage: Callable[[Path], object], message: str
) -> None:
    folder, _ = kept(tmp_path)
    damage(folder)
    with pytest.raises(Exception, match=message) as refusal:
        zoo.load("dots", tmp_path / "zoo")
    assert isinstance(refusal.value, UserError)


def test_folders_that_are_no_runs(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"is not the folder of a run: it has no \.hydra/config\.yaml"):
        zoo.part_of_run(tmp_path, "averaged", "module.generator")
    run, _ = finished_run(tmp_path / "run")
    (run / "metrics.json").unlink()
    with pytest.raises(UserError, match="says nothing of its end"):
        zoo.keep(run, "dots", tmp_path / "zoo", weights=str(run / "weights.safetensors"))


def test_what_is_kept_beside_the_code_works() -> None:
    folder = Path(__file__).parents[2] / "zoo"
    assert "giraffe_cow" in zoo.names(folder)
    for name in zoo.names(folder):
        network = zoo.load(name, folder)
        assert f"parameters: {sum(each.numel() for each in network.parameters()):,}" in (
            folder / name / "card.md"
        ).read_text(encoding="utf-8")
    assert all((folder / name / "weights.safetensors").stat().st_size < 4e6 for name in zoo.names(folder))


@torch.no_grad()
def test_the_kept_cows_are_seen_before_their_meadows() -> None:
    cows = zoo.load("giraffe_cow", Path(__file__).parents[2] / "zoo")
    assert isinstance(cows, Generator)
    made = cows(cows.sample(16, torch.Generator().manual_seed(0), 0.65))
    share = made.shares[:, 0].mean((1, 2))
    assert 0.02 < float(share.min()) <= float(share.max()) < 0.2
    ground = made.rgb[:, :, -16:].mean((0, 2, 3))
    assert float(ground[1]) > float(ground[2])  # more green than blue
