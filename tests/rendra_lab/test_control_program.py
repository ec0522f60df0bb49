"""`scripts/control.py` and `scripts/keep_in_zoo.py`, with a generator that has learned nothing."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hydra.utils import instantiate
from omegaconf import OmegaConf

from rendra_lab.weights_file import write_weights_file

QUICK = ("samples=2", "steps=2", "anchors=2")
SMALL = [
    *(
        f"network.generator.{part}_field.{name}"
        for part in ("object", "background")
        for name in ("hidden=8", "code=4")
    ),
    "network.generator.sampling.in_box=2",
]


@pytest.fixture
def run(compose: Callable[..., Any], tmp_path: Path) -> Path:
    """The folder of a run of task=giraffe that ended at once."""
    folder = tmp_path / "outputs" / "giraffe" / "now"
    cfg = compose(folder, "task=giraffe", "data=cow_photos", *SMALL)
    (folder / ".hydra").mkdir(parents=True)
    kept = OmegaConf.create({name: cfg[name] for name in ("module", "network", "world", "seed")})
    kept.module = {"_target_": cfg.module._target_, "generator": cfg.module.generator}
    OmegaConf.save(kept, folder / ".hydra" / "config.yaml")
    (folder / "metrics.json").write_text(json.dumps({"task": "giraffe", "overrides": ["task=giraffe"]}))
    weights = instantiate(cfg.network.generator, _convert_="all").state_dict()
    named = {f"averaged.{name}": value for name, value in weights.items()}
    write_weights_file(folder / "weights.safetensors", named, {"module": cfg.module._target_})
    return folder


def test_programs_of_a_run(run: Path, program: Callable[..., tuple[int, str, str]]) -> None:
    weights = f"weights={run / 'weights.safetensors'}"
    code, said, wrong = program("scripts/control.py", f"run={run}", weights, "program=add_objects", *QUICK)
    assert (code, wrong) == (0, "")
    assert "add_objects: add_objects.png, add_objects.gif" in said
    folder = run / "rendering" / "add_objects"
    assert (folder / "add_objects_sm.gif").is_file()
    assert (folder / "0001_add_objects_masks.png").is_file()
    assert said.splitlines()[-1].endswith("rendering")


def test_mistakes_are_one_line(run: Path, program: Callable[..., tuple[int, str, str]]) -> None:
    weights = f"weights={run / 'weights.safetensors'}"
    for arguments, words in (
        ((), "say run=FOLDER"),
        ((f"run={run}", "zoo=giraffe_cow"), "say run=FOLDER"),
        ((f"run={run}", "program=dance"), "program must be all or one of rotation_object"),
        ((f"run={run}", "steps=1"), "steps must be a whole number of at least 2, got 1"),
        ((f"run={run}", "object=1", weights, *QUICK), "object must be below 1"),
        (("zoo=elephant",), "the zoo keeps no 'elephant'"),
        ((f"run={run.parent}",), "is not the folder of a run"),
    ):
        code, _, wrong = program("scripts/control.py", *arguments)
        assert code == 2, arguments
        assert words in wrong
        assert wrong.count("\n") == 1


def test_what_is_kept_is_controlled(
    run: Path,
    program: Callable[..., tuple[int, str, str]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import importlib.util

    weights = str(run / "weights.safetensors")
    zoo = tmp_path / "zoo"
    code, said, wrong = program(
        "scripts/keep_in_zoo.py", str(run), "giraffe_cow", "--weights", weights, "--zoo", str(zoo)
    )
    assert (code, wrong) == (0, "")
    assert "# giraffe_cow" in said
    code, _, wrong = program(
        "scripts/keep_in_zoo.py", str(run), "giraffe_cow", "--weights", weights, "--zoo", str(zoo)
    )
    assert code == 2
    assert "keeps a giraffe_cow already" in wrong
    path = Path(__file__).parents[2] / "scripts" / "control.py"
    spec = importlib.util.spec_from_file_location("control_program", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(module, "ZOO", zoo)
    generator = module._generator(None, "last", "giraffe_cow")
    assert generator.picture_side == 64
    assert not generator.training
