"""Every task and every experiment composes, builds and makes one step. Removing one removes its test."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from scene_files import blender_folder, colmap_folder, llff_folder, transforms_folder

from rendra_lab.experiment import run

CONF = Path(__file__).parents[2] / "conf"

# a step of these, their films and their meshes take a laptop minutes
_SMALL_VIEWS = ("data.image_size=16", "data.counts=[4,1,1]", "data.antialias=1", "data.rays_per_step=12")
_SMALL_SCENE = (*_SMALL_VIEWS, "callbacks.turntable.frames=2", "callbacks.surface.resolution=12")
_TINY = (*_SMALL_SCENE, "field.width=16")
_OF_VOLUMES = {
    "book": ("volume.voxels=8", "volume.samples=6", "module.refine_at=[]"),
    "grid": ("volume.voxels=[6,8]", "module.refine_at=[1]"),
}
_FEW_PEOPLE = (
    "data.count=3",
    "data.image_size=64",
    "data.cache=null",
    "module.shown=1",
    "callbacks.people.pictures=1",
)
_FEW_PAIRS = (
    "data.image_size=64",
    "data.counts=[1,1,1]",
    "data.views_per_scene=2",
    "data.batch_size=2",
    "data.cache=null",
    "callbacks.pairs.pictures=1",
)
_FEW_ROOMS = (
    "data.counts=[2,1,1]",
    "data.models_per_name=1",
    "data.batch_size=2",
    "data.cache=null",
    "callbacks.detections.pictures=1",
)
_FEW_SHAPES = (
    "data.counts=[2,1,1]",
    "data.views=1",
    "data.eval_views=1",
    "data.image_size=33",
    "data.batch_size=2",
    "data.cache=null",
    "data.voxels=16",
    "callbacks.shapes.pictures=1",
    "callbacks.shapes.samples=500",
)
_FEW_PICTURES = (
    "data.counts=[2,2,2]",
    "data.batch_size=2",
    "data.cache=null",
    "callbacks.images.every_n_steps=0",
    "callbacks.animation=null",
    "callbacks.controls.scenes=2",
    "callbacks.controls.turns=2",
    "+module.grid.samples=2",
)
_OF_TASKS = {
    "giraffe": _FEW_PICTURES,
    "mask_rcnn": _FEW_ROOMS,
    "mesh_rcnn": _FEW_ROOMS,
    "nerf": _SMALL_SCENE,
    "volume": (*_SMALL_SCENE, *_OF_VOLUMES["grid"]),
    "smplify": _FEW_PEOPLE,
    "synsin": _FEW_PAIRS,
    "voxmesh": _FEW_SHAPES,
}
_OF_FIELDS = {
    "hash_grid": ("field.encoding.log2_table_size=8", "field.width=8"),
    "tri_plane": ("field.encoding.resolutions=[4,8]", "field.width=8"),
    "mlp_book": ("field.width=8",),
    "mlp_original": ("field.width=8",),
}
_OF_SAMPLERS = {
    "hierarchical": ("sampler.coarse_samples=6", "sampler.fine_samples=6", "loss=[rgb,rgb_coarse,opacity]"),
    "occupancy": ("sampler.cells=8", "sampler.steps_across=8"),
    "stratified": ("sampler.samples=6",),
}
SMALLER = {
    "giraffe_paper_256": (*_FEW_PICTURES, "callbacks.controls=null"),
    "mesh_rcnn_voxel_only": _FEW_ROOMS,
    "synsin_paper": (*_FEW_PAIRS, "network.depth.levels=6", "renderer.points_per_pixel=8"),
    "volume_book": (*_SMALL_SCENE, *_OF_VOLUMES["book"]),
    "nerf_book": (*_TINY, "sampler.samples=4"),
    "nerf_book_laptop": (*_TINY, "sampler.samples=4"),
    "nerf_original": (*_TINY, "sampler.fine_samples=4"),
    "nerf_original_laptop": (*_TINY, "sampler.fine_samples=4"),
}


def names(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def one_step(compose: Callable[..., Any], folder: Path, *overrides: str) -> dict[str, Any]:
    run(compose(folder, *overrides, "debug=fast", "trainer.max_steps=1"))
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.parametrize("task", names("task"))
def test_every_task_makes_a_step(task: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    record = one_step(compose, tmp_path / task / "run", f"task={task}", *_OF_TASKS.get(task, ()))
    assert record["steps"] >= 1
    assert record["metrics"]


@pytest.mark.parametrize("field", names("field"))
def test_every_field_makes_a_step(field: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    settings = ("task=nerf", f"field={field}", "sampler=stratified", *_SMALL_SCENE)
    record = one_step(
        compose, tmp_path / "nerf" / "run", *settings, *_OF_FIELDS.get(field, ()), *_OF_SAMPLERS["stratified"]
    )
    assert record["metrics"]["test/psnr"] > 5


@pytest.mark.parametrize("sampler", names("sampler"))
@pytest.mark.parametrize("field", ["mlp_original", "tri_plane"])
def test_every_sampler_makes_a_step(field: str, sampler: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    settings = ("task=nerf", f"sampler={sampler}", f"field={field}", *_SMALL_SCENE)
    record = one_step(
        compose, tmp_path / "nerf" / "run", *settings, *_OF_SAMPLERS.get(sampler, ()), *_OF_FIELDS.get(field, ())
    )
    assert record["metrics"]["test/psnr"] > 5


@pytest.mark.parametrize("volume", names("volume"))
def test_every_volume_makes_steps_at_all_of_its_levels(
    volume: str, compose: Callable[..., Any], tmp_path: Path
) -> None:
    settings = (*_SMALL_SCENE, *_OF_VOLUMES.get(volume, ()), "debug=fast", "trainer.max_steps=3")
    folder = tmp_path / "volume" / "run"
    run(compose(folder, "task=volume", f"volume={volume}", *settings))
    assert json.loads((folder / "metrics.json").read_text())["steps"] == 3
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]
    assert int(state["volume.level"]) == (1 if volume == "grid" else 0)


@pytest.mark.parametrize(
    ("task", "data", "make"),
    [
        ("nerf", "nerf_blender", blender_folder),
        ("volume", "transforms", transforms_folder),
        ("nerf", "colmap", partial(colmap_folder, binary=True)),
        ("volume", "llff", llff_folder),
        ("nerf", "llff ndc", llff_folder),
    ],
)
def test_every_folder_of_a_scene_is_read_and_fitted(
    task: str, data: str, make: Callable[[Path], Path], compose: Callable[..., Any], tmp_path: Path
) -> None:
    name, *bent = data.split()
    made = {"data.image_size", "data.counts", "data.antialias", "callbacks.turntable.frames"}
    settings = [word for word in _OF_TASKS[task] if word.partition("=")[0] not in made]
    settings += [f"data.{word}=true" for word in bent]
    settings += ["metric.ssim=null", "callbacks.turntable.frames=0"]  # 6 x 8 pixels are too few for its windows
    path = make(tmp_path / "scene")
    record = one_step(
        compose, tmp_path / task / "run", f"task={task}", f"data={name}", f"data.path={path}", *settings
    )
    assert record["steps"] == 1
    assert record["metrics"]["test/psnr"] > 3


@pytest.mark.parametrize("scene_report", names("scene_report"))
@pytest.mark.parametrize("task", sorted(set(names("task")) & {"nerf", "volume"}))
def test_every_report_of_a_scene_stands_alone(
    task: str, scene_report: str, compose: Callable[..., Any], tmp_path: Path
) -> None:
    left = {"default": "turntable.frames=2", "surface": "surface.resolution=12"}
    settings = [word for word in _OF_TASKS[task] if not word.startswith("callbacks.")]
    settings += ["task=" + task, f"scene_report@callbacks=[{scene_report}]", f"callbacks.{left[scene_report]}"]
    record = one_step(compose, tmp_path / task / "run", *settings)
    assert record["steps"] == 1
    made = {path.name for path in (tmp_path / task / "run").rglob("*") if path.is_file()}
    assert ("views.csv" in made) == (scene_report == "default")


@pytest.mark.parametrize("experiment", names("experiment"))
def test_every_experiment_makes_a_step_and_says_how(
    experiment: str, compose: Callable[..., Any], tmp_path: Path
) -> None:
    lines = (CONF / "experiment" / f"{experiment}.yaml").read_text().splitlines()
    assert lines[0] == "# @package _global_"
    assert f"python train.py experiment={experiment}" in lines[1]
    few = {
        "giraffe": _FEW_PICTURES,
        "smplify": _FEW_PEOPLE,
        "synsin": _FEW_PAIRS,
        "voxmesh": _FEW_SHAPES,
    }.get(experiment.partition("_")[0], ())
    settings = (f"experiment={experiment}", *SMALLER.get(experiment, few))
    assert one_step(compose, tmp_path / "experiment" / "run", *settings)["steps"] >= 1


@pytest.mark.parametrize("group", ["optimizer", "scheduler", "trainer", "logger", "callbacks", "debug"])
def test_every_choice_of_the_shared_groups_composes(group: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    for name in names(group):
        assert compose(tmp_path / "toy" / "run", "task=toy", f"{group}={name}") is not None


def test_configurations_are_sentences() -> None:
    long = {path.name: count for path in CONF.rglob("*.yaml") if (count := len(path.read_text().splitlines())) > 60}
    assert not long
