"""Tiny folders of Pix3D, written by hand: what the reader's tests read and break.

The model is a step: no mirror and no turn makes it look the same.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import torch
from PIL import Image

from rendra.renderer import MeshRasterizer, PerspectiveCameras, RasterizationSettings
from rendra.structures import Meshes

SIZE = (24, 32)  # height, width
FOCAL_MM = 35.0
STEPS = (((0.0, 0.0, 0.0), (1.0, 0.3, 0.5)), ((0.0, 0.3, 0.0), (0.4, 0.9, 0.25)))
"""Boxes from one corner to the other: a low one, and a higher one on its left, in front."""


def step_mesh() -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and quads, seen counter-clockwise from outside."""
    verts, quads = [], []
    for low, high in STEPS:
        first = len(verts)
        verts += [
            [(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)
        ]
        sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
        quads += [[first + corner for corner in side] for side in sides]
    return np.array(verts), quads


def is_in_step(points: np.ndarray) -> np.ndarray:
    """Whether points (..., 3) lie in the model."""
    return np.any([((points > low) & (points < high)).all(-1) for low, high in STEPS], axis=0)


def pose(number: int) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3) and t (3,): turned differently each time."""
    a, b = 0.5 + 0.7 * number, 0.3 - 0.2 * number
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return about_x @ about_y, np.array([-0.1, -0.2, 2.6 + 0.1 * number])


def seen_from(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """The outline (H, W) as PyTorch3D's camera sees it, whose axes are those of Pix3D."""
    verts, quads = step_mesh()
    faces = torch.tensor([row for a, b, c, d in quads for row in ((a, b, c), (a, c, d))])
    R, t = pose(number)
    height, width = size
    focal = FOCAL_MM * width / 32
    cameras = PerspectiveCameras(
        focal_length=focal,
        principal_point=((width / 2, height / 2),),
        R=torch.tensor(R.T[None], dtype=torch.float32),  # row vectors
        T=torch.tensor(t[None], dtype=torch.float32),
        in_ndc=False,
        image_size=(size,),
    )
    rasterizer = MeshRasterizer(cameras, RasterizationSettings(image_size=size))
    fragments = rasterizer(Meshes([torch.tensor(verts, dtype=torch.float32)], [faces]))
    return fragments.pix_to_face[0, :, :, 0].numpy() >= 0


def picture(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Noise of its own."""
    return np.random.default_rng(number).integers(0, 256, (*size, 3), np.uint8)


def box_of(mask: np.ndarray) -> list[int]:
    """x0, y0, x1, y1 about what is true."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return [int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1]


def write_model(folder: Path, cells: int = 20, padding: int = 0) -> None:
    """model.obj of quads, and voxel.mat of cells whose middles lie in it, over the cube about it."""
    folder.mkdir(parents=True)
    verts, quads = step_mesh()
    lines = [f"v {x} {y} {z}" for x, y, z in verts] + ["f " + " ".join(str(i + 1) for i in quad) for quad in quads]
    (folder / "model.obj").write_text("\n".join(lines) + "\n")
    middle, ticks = (verts.max(0) + verts.min(0)) / 2, (np.arange(cells) + 0.5) / cells - 0.5
    x, against_z, y = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    grid = is_in_step(np.stack([x, y, -against_z], -1) + middle)
    scipy.io.savemat(folder / "voxel.mat", {"voxel": np.pad(grid, padding).astype(np.uint8)})


def entry(number: int, category: str = "chair", model: str = "step") -> dict[str, Any]:
    """What pix3d.json says of a picture of the model."""
    R, t = pose(number)
    return {
        "img": f"img/{category}/{number:04d}.png",
        "category": category,
        "img_size": [SIZE[1], SIZE[0]],
        "mask": f"mask/{category}/{number:04d}.png",
        "model": f"model/{category}/{model}/model.obj",
        "voxel": f"model/{category}/{model}/voxel.mat",
        "rot_mat": R.tolist(),
        "trans_mat": t.tolist(),
        "focal_length": FOCAL_MM,
        "bbox": box_of(seen_from(number)),
        "truncated": False,
        "occluded": False,
        "slightly_occluded": False,
        "2d_keypoints": [[[1.0, 2.0]]],
    }


def pix3d_folder(folder: Path, count: int = 3, category: str = "chair", models: int = 1) -> Path:
    """Pictures of one class, of several models."""
    entries = [entry(number, category, f"step{number % models}") for number in range(count)]
    for number in range(models):
        write_model(folder / "model" / category / f"step{number}")
    for kind in ("img", "mask"):
        (folder / kind / category).mkdir(parents=True)
    for number, one in enumerate(entries):
        Image.fromarray(picture(number)).save(folder / one["img"])
        Image.fromarray(seen_from(number).astype(np.uint8) * 255).save(folder / one["mask"])
    (folder / "pix3d.json").write_text(json.dumps(entries))
    return folder


def divide(folder: Path, parts: dict[str, list[int]], split: str = "s1") -> None:
    """Mesh R-CNN's files of a folder: the numbers of the pictures of each part."""
    entries = json.loads((folder / "pix3d.json").read_text())
    names = ("bed", "bookcase", "chair", "desk", "misc", "sofa", "table", "tool", "wardrobe")
    categories = [{"id": i + 1, "name": name} for i, name in enumerate(names)]
    for part, numbers in parts.items():
        images, annotations = [], []
        for number in numbers:
            one = entries[number]
            x0, y0, x1, y1 = one["bbox"]
            height, width = SIZE
            images.append({"id": 7 + number, "file_name": one["img"], "width": width, "height": height})
            annotations.append({
                "id": number,
                "image_id": 7 + number,
                "category_id": names.index(one["category"]) + 1,
                "bbox": [x0, y0, x1 - x0, y1 - y0],
                "segmentation": one["mask"],
                "K": [FOCAL_MM * width / 32, width / 2, height / 2],
                "iscrowd": 0,
                "area": 1,
                **{key: one[key] for key in ("model", "voxel", "rot_mat", "trans_mat")},
            })  # fmt: skip
        tree = {"images": images, "annotations": annotations, "categories": categories}
        (folder / f"pix3d_{split}_{part}.json").write_text(json.dumps(tree))
