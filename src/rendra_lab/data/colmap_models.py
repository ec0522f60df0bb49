"""Sparse models of COLMAP, text and binary: cameras, poses of images, points.

Source: COLMAP's documentation, "Output Format" and "Camera Models". Numbers are little-endian. Counts are held
against the size of the file before anything is allocated.
"""

from __future__ import annotations

import itertools
import math
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra_lab.errors import UserError

_MOST_BYTES = 2 << 30
_LONGEST_NAME = 4096
_MODELS = {0: "SIMPLE_PINHOLE", 1: "PINHOLE", 2: "SIMPLE_RADIAL", 3: "RADIAL", 4: "OPENCV", 5: "OPENCV_FISHEYE"}
_MODELS |= {6: "FULL_OPENCV", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE"}
_NUM_PARAMS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5}
_NUM_PARAMS |= {"OPENCV": 8, "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12}
_ONE_FOCAL = {"SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"}


@dataclass(frozen=True)
class ColmapCamera:
    """One lens."""

    where: str
    size: tuple[int, int]  # height, width
    pinhole: tuple[float, float, float, float]  # fx fy cx cy
    distortion: tuple[float, ...]  # as PosedImages has it
    fisheye: bool


@dataclass(frozen=True)
class ColmapImage:
    """One pose."""

    where: str
    name: str
    camera: int
    qvec: tuple[float, ...]  # w x y z of world to camera
    tvec: tuple[float, ...]


def read_model(folder: Path) -> tuple[dict[int, ColmapCamera], list[ColmapImage], Tensor]:
    """Cameras by their ids, images in the order of their names, points (P, 3) float64.

    Binary files go before text, as in COLMAP; a model without points has none.

    Raises:
        UserError: a missing file, or whatever is wrong with one and where.
    """
    cameras = _read(folder, "cameras", _binary_cameras, _text_cameras)
    images = _read(folder, "images", _binary_images, _text_images)
    points = _read(folder, "points3D", _binary_points, _text_points, missing=[])
    by_id: dict[int, ColmapCamera] = {}
    for number, camera in cameras:
        if number in by_id:
            raise UserError(f"{camera.where}: camera {number} stands there a second time")
        by_id[number] = camera
    if not images:
        raise UserError(f"{folder} has no image")
    images = sorted(images, key=lambda image: image.name)
    for before, image in itertools.pairwise(images):
        if before.name == image.name:
            raise UserError(f"{image.where}: image {image.name!r} stands there a second time")
    for image in images:
        if image.camera not in by_id:
            raise UserError(f"{image.where}: image {image.name!r} has camera {image.camera}, which does not exist")
    return by_id, images, torch.tensor(points, dtype=torch.float64).reshape(-1, 3)


def _read(
    folder: Path,
    name: str,
    binary: Callable[[_Bytes], list[Any]],
    text: Callable[[Path, Iterator[tuple[int, str]]], list[Any]],
    missing: list[Any] | None = None,
) -> list[Any]:
    for path in (folder / f"{name}.bin", folder / f"{name}.txt"):
        if not path.is_file():
            continue
        if path.stat().st_size > _MOST_BYTES:
            raise UserError(f"{path} has {path.stat().st_size:,} bytes; at most {_MOST_BYTES:,} are read")
        if path.suffix == ".bin":
            return binary(_Bytes(path))
        return text(path, _lines(path))
    if missing is not None:
        return missing
    raise UserError(f"there is no file {folder / name}.bin, and no {name}.txt")


class _Bytes:
    """A binary file, read record by record."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.place = 0

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        """The next numbers."""
        record = struct.Struct("<" + layout)
        if self.place + record.size > len(self.data):
            raise UserError(f"{self.path} ends within {what}, at byte {len(self.data):,}")
        values = record.unpack_from(self.data, self.place)
        self.place += record.size
        return values

    def count(self, least: int, what: str) -> int:
        """A number of records of at least `least` bytes, which must find room in the rest of the file."""
        (number,) = self.take("Q", f"the number of {what}")
        self.demand(number * least, f"{number:,} {what}")
        return number

    def demand(self, size: int, what: str) -> None:
        """Refuse what does not fit into the rest of the file."""
        rest = len(self.data) - self.place
        if size > rest:
            raise UserError(f"{self.path} declares {what}, but only {rest:,} bytes are left at byte {self.place:,}")

    def skip(self, size: int, what: str) -> None:
        """Pass over records."""
        self.demand(size, what)
        self.place += size

    def name(self, what: str) -> str:
        """A text that ends with a zero."""
        end = self.data.find(b"\0", self.place, self.place + _LONGEST_NAME)
        if end < 0:
            raise UserError(f"{self.path}: the name of {what} has no end")
        raw, self.place = self.data[self.place : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise UserError(f"{self.path}: the name of {what} is no UTF-8: {raw[:60]!r}") from error


def _binary_cameras(source: _Bytes) -> list[tuple[int, ColmapCamera]]:
    cameras = []
    for index in range(source.count(24, "cameras")):
        what = f"camera {index + 1}"
        number, model, width, height = source.take("IiQQ", what)
        where = f"{source.path}, {what}"
        name = _known(_MODELS.get(model, f"number {model}"), where)
        params = source.take(f"{_NUM_PARAMS[name]}d", what)
        cameras.append((number, _camera(where, name, width, height, params)))
    return cameras


def _binary_images(source: _Bytes) -> list[ColmapImage]:
    images = []
    for index in range(source.count(73, "images")):
        what = f"image {index + 1}"
        values = source.take("I7dI", what)
        name = source.name(what)
        images.append(_image(f"{source.path}, {what}", name, values[8], values[1:8]))
        number = source.count(24, f"points of {what}")
        source.skip(24 * number, f"points of {what}")
    return images


def _binary_points(source: _Bytes) -> list[tuple[float, ...]]:
    points = []
    for index in range(source.count(51, "points")):
        what = f"point {index + 1}"
        _, x, y, z = source.take("Q3d", what)
        source.skip(11, what)
        source.skip(8 * source.count(8, f"observations of {what}"), what)
        points.append(_point(f"{source.path}, {what}", (x, y, z)))
    return points


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Numbered lines without comments, from the first one that is not empty."""
    started = False
    with path.open("rb") as handle:
        for number, raw in enumerate(handle, 1):
            try:
                line = raw.decode().strip()
            except UnicodeDecodeError as error:
                raise UserError(f"{path}, line {number}: no UTF-8: {raw[:60]!r}") from error
            started = started or bool(line and not line.startswith("#"))
            if started and not line.startswith("#"):
                yield number, line


def _text_cameras(path: Path, lines: Iterator[tuple[int, str]]) -> list[tuple[int, ColmapCamera]]:
    cameras = []
    for number, line in lines:
        if not line:
            continue
        where = f"{path}, line {number}"
        words = line.split()
        if len(words) < 4:
            raise UserError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS, found {line[:80]!r}")
        name = _known(words[1], where)
        width, height = (_whole(word, where) for word in words[2:4])
        params = tuple(_number(word, where) for word in words[4:])
        if len(params) != _NUM_PARAMS[name]:
            raise UserError(f"{where}: camera model {name} has {_NUM_PARAMS[name]} parameters, found {len(params)}")
        cameras.append((_whole(words[0], where), _camera(where, name, width, height, params)))
    return cameras


def _text_images(path: Path, lines: Iterator[tuple[int, str]]) -> list[ColmapImage]:
    """Every second line holds points, and may be empty."""
    images = []
    for number, line in lines:
        if not line:
            continue
        where = f"{path}, line {number}"
        words = line.split(maxsplit=9)
        if len(words) < 10:
            raise UserError(f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, found {line[:80]!r}")
        pose = tuple(_number(word, where) for word in words[1:8])
        images.append(_image(where, words[9], _whole(words[8], where), pose))
        next(lines, None)
    return images


def _text_points(path: Path, lines: Iterator[tuple[int, str]]) -> list[tuple[float, ...]]:
    points = []
    for number, line in lines:
        words = line.split(maxsplit=4)
        if not words:
            continue
        where = f"{path}, line {number}"
        if len(words) < 4:
            raise UserError(f"{where}: expected POINT3D_ID X Y Z, found {line[:80]!r}")
        points.append(_point(where, tuple(_number(word, where) for word in words[1:4])))
    return points


def _camera(where: str, model: str, width: int, height: int, params: tuple[float, ...]) -> ColmapCamera:
    if not (0 < width <= 1 << 20 and 0 < height <= 1 << 20):
        raise UserError(f"{where}: a size of {width} x {height} pixels")
    _demand_finite(params, where, "parameters")
    focal = 1 if model in _ONE_FOCAL else 2
    if min(params[:focal]) <= 0:
        raise UserError(f"{where}: focal length {min(params[:focal])}; expected a number above zero")
    pinhole = (params[0], params[focal - 1], params[focal], params[focal + 1])
    lens = params[focal + 2 :]
    return ColmapCamera(
        where, (height, width), pinhole, (*lens, *(0.0,) * (8 - len(lens))), model == "OPENCV_FISHEYE"
    )


def _image(where: str, name: str, camera: int, pose: tuple[float, ...]) -> ColmapImage:
    _demand_finite(pose, where, "numbers of the pose")
    length = math.hypot(*pose[:4])
    if abs(length - 1) > 1e-2:
        raise UserError(f"{where}: the quaternion of {name!r} has length {length:.4g}; expected 1")
    if not name:
        raise UserError(f"{where}: an image without a name")
    return ColmapImage(where, name, camera, pose[:4], pose[4:])


def _point(where: str, xyz: tuple[float, ...]) -> tuple[float, ...]:
    _demand_finite(xyz, where, "coordinates")
    return xyz


def _known(model: str, where: str) -> str:
    if model not in _NUM_PARAMS:
        raise UserError(f"{where}: camera model {model} is not read; known are {', '.join(_NUM_PARAMS)}")
    return model


def _demand_finite(values: tuple[float, ...], where: str, what: str) -> None:
    if not all(map(math.isfinite, values)):
        raise UserError(f"{where}: {what} that are not finite: {' '.join(map(str, values))}")


def _number(word: str, where: str) -> float:
    try:
        return float(word)
    except ValueError as error:
        raise UserError(f"{where}: expected a number, found {word[:60]!r}") from error


def _whole(word: str, where: str) -> int:
    try:
        return int(word)
    except ValueError as error:
        raise UserError(f"{where}: expected a whole number, found {word[:60]!r}") from error
