"""Folders of Pix3D, COCO and ShapeNet are what their tasks learn from: each makes a step, and is tested."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from coco_files import coco_folder
from pix3d_files import pix3d_folder
from shapenet_files import shapenet_folder

from rendra_lab.experiment import run

_DETECTED = ("data.shortest_px=64", "data.longest_px=96", "data.batch_size=1", "callbacks.detections.pictures=1")
_SHAPED = ("data.points=50", "data.voxels=12")


@pytest.mark.parametrize(
    ("task", "data", "make", "settings"),
    [
        ("mesh_rcnn", "pix3d", pix3d_folder, (*_DETECTED, *_SHAPED)),
        ("mask_rcnn", "coco", coco_folder, (*_DETECTED, "network.classes=2")),
        (
            "voxmesh",
            "shapenet",
            shapenet_folder,
            (*_SHAPED, "data.image_px=48", "data.batch_size=2", "callbacks.shapes.samples=500"),
        ),
    ],
)
def test_folders_are_learned_from(
    task: str,
    data: str,
    make: Callable[[Path], Path],
    settings: tuple[str, ...],
    compose: Callable[..., Any],
    tmp_path: Path,
) -> None:
    folder = tmp_path / task / "run"
    path = make(tmp_path / "set")
    named = (f"task={task}", f"data={data}", f"data.path={path}", "debug=fast", "trainer.max_steps=1")
    run(compose(folder, *named, *settings))
    record = json.loads((folder / "metrics.json").read_text())
    assert record["steps"] == 1
    assert record["metrics"]
