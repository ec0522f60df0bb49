"""Tiny folders of ShapeNet and 3D-R2N2, written by hand: what the reader's tests read and break."""

import itertools
import json
from pathlib import Path

import numpy as np
from PIL import Image
from pix3d_files import is_in_step, picture, step_mesh

SIDE = 21
CELLS = 16
SHIFT = np.array([0.5, 0.45, 0.25])
"""The middle of the step, which ShapeNet has in the origin."""
CAMERAS = [(336.5, 25.9, 0, 0.65, 25), (20.25, -3.5, 0, 0.9, 25), (180, 30, 0, 0.8, 25)]


def runs(grid: np.ndarray) -> bytes:
    """Values and counts of a flat grid of bools."""
    edges = np.flatnonzero(np.diff(grid.astype(np.int8), prepend=2, append=2))
    pairs = [
        (int(grid[start]), min(255, end - first))
        for start, end in itertools.pairwise(edges)
        for first in range(start, end, 255)
    ]
    return b"".join(bytes(pair) for pair in pairs)


def binvox() -> bytes:
    """The step's cells over the cube about it, x slowest and y fastest."""
    ticks = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    x, z, y = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    grid = is_in_step(np.stack([x, y, z], -1) + SHIFT).reshape(-1)
    header = f"#binvox 1\ndim {CELLS} {CELLS} {CELLS}\ntranslate -0.5 -.5 -5e-1\nscale 1\ndata\n"
    return header.encode() + runs(grid)


def write_model(folder: Path, shape_id: str, number: int) -> None:
    mesh, cells = folder / "ShapeNetCore.v1" / shape_id, folder / "ShapeNetCore.v1.binvox" / shape_id
    pictures = folder / "ShapeNetRendering" / shape_id / "rendering"
    for each in (mesh, cells, pictures):
        each.mkdir(parents=True)
    verts, quads = step_mesh()
    lines = [f"v {x} {y} {z}" for x, y, z in verts - SHIFT] + ["f " + " ".join(str(i + 1) for i in q) for q in quads]
    (mesh / "model.obj").write_text("\n".join(lines) + "\n")
    (cells / "model.binvox").write_bytes(binvox())
    (pictures / "rendering_metadata.txt").write_text("".join(f"{' '.join(map(str, one))}\n" for one in CAMERAS))
    for view in range(len(CAMERAS)):
        rgba = np.dstack([picture(10 * number + view, (SIDE, SIDE)), np.zeros((SIDE, SIDE), np.uint8)])
        Image.fromarray(rgba).save(pictures / f"{view:02d}.png")


def shapenet_folder(folder: Path) -> Path:
    """Chairs and a plane, of three views each."""
    division = {
        "train": {"03001627": {"aa": [0, 2], "bb": [1]}, "02691156": ["cc"]},
        "val": {"03001627": {"dd": [0, 1, 2]}},
        "test": {"03001627": {"ee": [0, 1, 2], "ff": [2]}},
    }
    for number, shape_id in enumerate(
        ("03001627/aa", "03001627/bb", "02691156/cc", "03001627/dd", "03001627/ee", "03001627/ff")
    ):
        write_model(folder, shape_id, number)
    (folder / "pix2mesh_splits_val05.json").write_text(json.dumps(division))
    return folder
