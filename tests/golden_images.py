"""Pictures that were looked at once and must stay as they are; `make golden` draws them anew."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

FOLDER = Path(__file__).parent / "golden"
STEP = 2 / 255  # differences up to here are rounding


def check_image(name: str, image: Tensor, allowance: int, update: bool = False, folder: Path = FOLDER) -> None:
    """Compare an image (H, W) or (H, W, 3) in [0, 1] with `<folder>/<name>.png`, or write that file.

    A pixel deviates if any of its channels differs by more than 2/255. Up to `allowance` pixels may: those of
    which the centre lies on an edge, so that the last bit of a coordinate decides.
    """
    assert torch.isfinite(image).all()
    assert image.amin() >= 0
    assert image.amax() <= 1
    path = folder / f"{name}.png"
    pixels = (image.detach().cpu() * 255).round().to(torch.uint8).numpy()
    if update:
        folder.mkdir(exist_ok=True)
        Image.fromarray(pixels).save(path, optimize=True)
        return
    assert path.is_file(), f"there is no {path}: run `make golden` and look at what it draws"
    with Image.open(path) as stored:
        expected = np.asarray(stored)
    assert pixels.shape == expected.shape, f"{name} is {pixels.shape}, the golden image {expected.shape}"
    deviating = _deviating(pixels, expected)
    assert deviating.sum() <= allowance, (
        f"{deviating.sum()} pixels of {name} deviate, {allowance} may; the first at "
        f"(row, column) {np.argwhere(deviating)[0].tolist()}"
    )


def _deviating(pixels: np.ndarray, expected: np.ndarray) -> np.ndarray:
    difference = np.abs(pixels.astype(np.int16) - expected.astype(np.int16)).reshape(*pixels.shape[:2], -1)
    return difference.max(-1) > round(STEP * 255)
