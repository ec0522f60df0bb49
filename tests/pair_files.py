"""Tiny folders of KITTI and RealEstate10K, written by hand: what the readers' tests read and break."""

from pathlib import Path

import numpy as np
from PIL import Image

P2 = "7.0 0 5.5 1.4 0 8.0 3.5 0.4 0 0 1 0.005"
"""fx 7, fy 8, cx and cy of pixels that count from 0, and a camera that stands beside camera 0."""
SIZE = (6, 12)  # height, width


def picture(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    """Noise of its own."""
    return np.random.default_rng(number).integers(0, 256, (*size, 3), np.uint8)


def pose(number: int) -> np.ndarray:
    """(4, 4): forwards by a metre a frame, and a degree round the vertical."""
    angle = np.radians(number)
    matrix = np.eye(4)
    matrix[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    matrix[:3, 3] = [0.1 * number, 0, number]
    return matrix


def row(matrix: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in matrix[:3].ravel())


def kitti_folder(folder: Path, counts: dict[str, int] | None = None) -> Path:
    """Sequences of some frames each."""
    (folder / "poses").mkdir(parents=True)
    for name, count in (counts or {"00": 4, "08": 3, "09": 3}).items():
        pictures = folder / "sequences" / name / "image_2"
        pictures.mkdir(parents=True)
        for number in range(count):
            Image.fromarray(picture(100 * int(name) + number)).save(pictures / f"{number:06d}.png")
        calibration = f"P0: 7 0 5.5 0 0 8 3.5 0 0 0 1 0\nP2: {P2}\n"
        (folder / "sequences" / name / "calib.txt").write_text(calibration)
        poses = "".join(f"{row(pose(number))}\n" for number in range(count))
        (folder / "poses" / f"{name}.txt").write_text(poses)
    return folder


def realestate_row(number: int, shift: float = 0.05) -> str:
    """A frame's line; its camera moves by `shift` a frame."""
    matrix = np.eye(4)
    matrix[0, 3] = -shift * number
    return f"{1000 * number} 0.5 0.9 0.45 0.55 0 0 {row(matrix)}"


def realestate_folder(folder: Path, films: dict[str, int] | None = None, suffix: str = ".png") -> Path:
    """Films such as train/a: 3, of so many frames."""
    for index, (name, count) in enumerate((films or {"train/a": 3, "train/b": 4, "train/c": 2, "test/d": 3}).items()):
        pictures = folder / "frames" / name
        pictures.mkdir(parents=True)
        for number in range(count):
            Image.fromarray(picture(100 * index + number)).save(pictures / f"{1000 * number}{suffix}")
        text = folder / f"{name}.txt"
        text.parent.mkdir(parents=True, exist_ok=True)
        rows = "".join(f"{realestate_row(number)}\n" for number in range(count))
        text.write_text(f"https://film.example/{name}\n\n{rows}")
    return folder
