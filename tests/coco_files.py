"""Tiny folders of COCO's layout, written by hand: what the reader's tests read and break."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pycocotools import mask as coco_tools

SIZE = (12, 16)


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (*SIZE, 3), np.uint8)


def blob(number: int) -> np.ndarray:
    """A mask with holes."""
    return np.random.default_rng(number).random(SIZE) < 0.6


def file_of(numbers: list[int], folder_name: str = "") -> dict[str, Any]:
    """Pictures with a polygon (chair), runs (dog), runs as text (chair) and a crowd each."""
    annotations = []
    for number in numbers:
        mask = blob(number)
        flat = mask.T.reshape(-1)
        edges = np.flatnonzero(np.diff(flat, prepend=~flat[0], append=~flat[-1]))
        counts = [0] * bool(flat[0]) + np.diff(edges).tolist()
        text = coco_tools.encode(np.asfortranarray(mask.astype(np.uint8)))
        shapes = [
            (17, [[2.0, 3.0, 9.0, 3.0, 9.0, 8.0, 2.0, 8.0]], 0),
            (3, {"size": list(SIZE), "counts": counts}, 0),
            (17, {"size": list(SIZE), "counts": text["counts"].decode()}, 0),
            (17, {"size": list(SIZE), "counts": counts}, 1),
        ]
        annotations += [
            {
                "id": 10 * number + i,
                "image_id": number,
                "category_id": category,
                "segmentation": segmentation,
                "bbox": [2, 3, 7, 5],
                "area": 35,
                "iscrowd": crowd,
            }
            for i, (category, segmentation, crowd) in enumerate(shapes)
        ]
    images = [
        {"id": n, "file_name": f"{folder_name}{n:012d}.png", "width": SIZE[1], "height": SIZE[0]} for n in numbers
    ]
    categories = [{"id": 17, "name": "chair", "supercategory": "furniture"}, {"id": 3, "name": "dog"}]
    return {"images": images, "annotations": annotations, "categories": categories}


def coco_folder(folder: Path, parts: dict[str, list[int]] | None = None) -> Path:
    (folder / "annotations").mkdir(parents=True)
    for part, numbers in (parts or {"train2017": [1, 2, 3], "val2017": [4]}).items():
        (folder / part).mkdir()
        for number in numbers:
            Image.fromarray(picture(number)).save(folder / part / f"{number:012d}.png")
        (folder / "annotations" / f"instances_{part}.json").write_text(json.dumps(file_of(numbers)))
    return folder
