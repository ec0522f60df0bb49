"""Pictures of files, upright.

Detectors follow the EXIF data that turn a photograph, and so must what is drawn on it.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from rendra_lab.data.photographs import SUFFIXES, decode, image_size
from rendra_lab.errors import UserError

_ENDINGS = (*SUFFIXES, *(suffix.upper() for suffix in SUFFIXES))
_ORIENTATION = 0x0112
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


def upright_size(path: Path, where: str) -> tuple[int, int]:
    """Height and width as people look at the picture, without reading its pixels.

    Raises:
        UserError: no file, no picture, or a huge one; `where` names who asks.
    """
    height, width = image_size(path, where)
    return (width, height) if _orientation(path) >= 5 else (height, width)


def upright(path: Path, where: str) -> Image.Image:
    """The picture as people look at it; colours as `decode` has them.

    Raises:
        UserError: no file, no picture, a huge one, or one that ends too soon; `where` names who asks.
    """
    image_size(path, where)
    image = decode(path, where)
    turn = _TURNS.get(_orientation(path))
    return image if turn is None else image.transpose(turn)


def read_upright(path: Path, where: str) -> npt.NDArray[np.uint8]:
    """Colours (H, W, 3), sRGB, as people look at the picture.

    Raises:
        UserError: as `upright`.
    """
    return np.array(upright(path, where).convert("RGB"))


def find_picture(folder: Path, names: tuple[str, ...], where: str) -> Path | None:
    """The picture in a folder that has one of the names, with the suffix of a picture or without one.

    Raises:
        UserError: a name that leads out of the folder.
    """
    inside = os.path.abspath(folder)
    for name in names:
        if "\0" in name or os.path.commonpath([os.path.abspath(folder / name), inside]) != inside:
            raise UserError(
                f"{where}: the picture {name!r} lies outside {folder}: data.images=FOLDER says where it is"
            )
        endings = ("",) if Path(name).suffix.lower() in SUFFIXES else _ENDINGS
        for path in (folder / f"{name}{ending}" for ending in endings):
            if path.is_file():
                return path
    return None


def _orientation(path: Path) -> int:
    """How a picture is yet to be turned; Pillow itself turns TIFF files."""
    try:
        with Image.open(path) as image:
            return 1 if image.format == "TIFF" else int(image.getexif().get(_ORIENTATION, 1))
    except Exception:  # whatever the decoder says of the EXIF data, then they turn nothing
        return 1
