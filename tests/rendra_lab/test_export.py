"""scripts/export.py: a finished scene becomes files, and mistakes are one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rendra_lab_toy import save_config

from rendra.io import IO
from rendra_lab.experiment import run

Compose = Callable[..., Any]
Program = Callable[..., tuple[int, str, str]]
EXPORT = "scripts/export.py"


@pytest.fixture
def block(compose: Compose, tmp_path: Path) -> Path:
    """The folder of a run whose scene is as good as its start: a block of stone."""
    folder = tmp_path / "outputs" / "volume" / "run"
    small = ["data.counts=[2,1,1]", "data.image_size=12", "data.cache=null", "data.rays_per_step=8"]
    small += [
        "volume=book",
        "volume.voxels=8",
        "volume.samples=16",
        "+volume.start=6.0",
        "module.refine_at=[]",
        "trainer.max_steps=1",
    ]
    cfg = compose(folder, "task=volume", *small, "callbacks.turntable=null", "callbacks.surface=null", "logger=csv")
    save_config(cfg)
    run(cfg)
    return folder


def test_a_finished_scene_becomes_files(block: Path, program: Program, tmp_path: Path) -> None:
    code, said, bad = program(EXPORT, f"run={block}", "resolution=16", "formats=[ply]", "color=null")
    assert (code, bad) == (0, "")
    assert "closed, 1 piece" in said
    assert "chamfer-L1 to the true mesh" in said
    assert sorted(path.name for path in (block / "exports").glob("mesh*")) == ["mesh_16.ply", "mesh_16_views.png"]
    code, said, _ = program(EXPORT, f"run={block}", "resolution=16", "output=some/where/block.GLB")
    assert code == 0
    assert len(IO().load_mesh(tmp_path / "some" / "where" / "block.glb").faces_packed()) > 100
    assert sorted(path.name for path in tmp_path.iterdir()) == ["outputs", "some"]  # no folder of its own


def test_a_task_without_a_scene_is_named(compose: Compose, program: Program, tmp_path: Path) -> None:
    folder = tmp_path / "outputs" / "toy" / "run"
    cfg = compose(folder, "task=toy", "trainer.max_steps=1", "logger=csv")
    save_config(cfg)
    run(cfg)
    code, _, said = program(EXPORT, f"run={folder}")
    assert (code, said) == (2, f"export.py: {folder} has no radiance field: its task is ToyTask\n")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "say run=FOLDER, the folder of a finished run"),
        (["rnu=x"], "there is no setting 'rnu'; did you mean run"),
        (["run=nowhere"], "nowhere is not the folder of a run"),
        (["run=x", "resolution=fine"], "resolution must be a whole number, got 'fine'"),
        (["run=x", "resolution=0"], "resolution must be a whole number of at least 1, got 0"),
        (["run=x", "keep=2"], "keep must be a number from 0 to 1, got 2"),
        (["run=x", "output=cow.doc"], "output must end in .obj, .ply, .glb, or in nothing for all, got cow.doc"),
        (["run=x", "formats=[doc]"], "formats must be some of obj, ply, glb, got doc"),
        (["run=x", "color=blue"], "color must be vertex, texture or null, got 'blue'"),
    ],
)
def test_mistakes_are_one_line(arguments: list[str], words: str, program: Program) -> None:
    code, _, said = program(EXPORT, *arguments)
    assert code == 2
    assert said.startswith(f"export.py: {words}")
    assert len(said.splitlines()) == 1
