"""Folders with a transforms.json of nerfstudio or instant-ngp: one camera for all frames, or one for each.

Source: nerfstudio's documentation, "Data conventions", and instant-ngp's NeRF dataset tips. Poses are OpenGL's.
nerfstudio's `applied_transform` says how it has turned the world; poses are taken as they stand in the file.
"""

from __future__ import annotations

import math
from collections import ChainMap
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import torch

from rendra_lab.data.folder_views import Capture, FolderViews, demand_unique
from rendra_lab.data.json_fields import Fields, read_json
from rendra_lab.data.photographs import Photograph, demand_size, image_size, poses_from_opengl
from rendra_lab.errors import UserError

_TERMS = {
    "SIMPLE_PINHOLE": (),
    "PINHOLE": (),
    "OPENCV": ("k1", "k2", "p1", "p2", "k3"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
}
"""Camera models and their coefficients, in the order of `PosedImages.distortion`."""

_ALL_TERMS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")


class TransformsViews(FolderViews):
    """A scene of a transforms.json; see FolderViews for the arguments.

    A mask of a frame (`mask_path`) becomes its alpha. Frames are taken in the order of their names. If the file has
    no train_filenames, val_filenames and test_filenames, every `hold_out`th frame is held out.
    """

    def read(self) -> Capture:
        """The cameras and the names of the photographs."""
        file = self.path / "transforms.json"
        tree = read_json(file)
        root = Fields(tree, str(file))
        if "applied_transform" in root:
            root.pose("applied_transform")
        frames = [
            Fields(ChainMap(frame, tree), f"{file}, frame {i}") for i, frame in enumerate(root.objects("frames"))
        ]
        named = {frame.where: frame.text("file_path") for frame in frames}
        frames.sort(key=lambda frame: named[frame.where])
        paths = [self.inside(named[frame.where], frame.where) for frame in frames]
        places = [frame.where for frame in frames]
        demand_unique(paths, places)
        R, T = poses_from_opengl(torch.stack([frame.pose("transform_matrix") for frame in frames]), places)
        photographs = [self._photograph(*one) for one in zip(frames, paths, R, T, strict=True)]
        return self._capture(root, photographs, [named[place] for place in places])

    def _capture(self, root: Fields, photographs: list[Photograph], names: list[str]) -> Capture:
        up = (0.0, 0.0, 1.0)
        lists = {split: f"{split}_filenames" for split in ("train", "val", "test") if f"{split}_filenames" in root}
        if not lists:
            train, held = self.divided(photographs)
            remark = f"every {self.hold_out}th frame is held out"
            return Capture(train, held, held, up=up, remark=remark, is_interleaved=True)
        by_name = {_tidy(name): photograph for name, photograph in zip(names, photographs, strict=True)}
        chosen = {split: _named(root, key, by_name) for split, key in lists.items()}
        both = next((split for split in ("val", "test") if chosen.get(split)), None)
        if not chosen.get("train") or both is None:
            raise UserError(
                f"{root.where}: train_filenames needs val_filenames or test_filenames beside it, none empty"
            )
        trained = {id(photograph) for photograph in chosen["train"]}
        for split in ("val", "test"):
            twice = [p for p in chosen.get(split, ()) if id(p) in trained]
            if twice:
                raise UserError(f"{root.where}: {twice[0].path.name} is in train_filenames and in {split}_filenames")
        val, test = chosen.get("val") or chosen[both], chosen.get("test") or chosen[both]
        return Capture(chosen["train"], val, test, up=up)

    def _photograph(self, frame: Fields, path: Path, R: torch.Tensor, T: torch.Tensor) -> Photograph:
        size = image_size(path, frame.where)
        if "w" in frame or "h" in frame:
            demand_size(path, frame.where, size, (frame.pixels("h"), frame.pixels("w")))
        model = _model(frame)
        mask = self.inside(frame.text("mask_path"), frame.where) if "mask_path" in frame else None
        coefficients = [frame.number(term, 0.0) for term in _TERMS[model]]
        distortion = (*coefficients, *(0.0,) * (8 - len(coefficients)))
        fisheye = model == "OPENCV_FISHEYE"
        return Photograph(path, frame.where, size, _pinhole(frame, size, model), R, T, distortion, fisheye, mask)


def _model(frame: Fields) -> str:
    """The camera model, which holds every coefficient that is not zero."""
    model = frame.text("camera_model") if "camera_model" in frame else "OPENCV"
    if frame.flag("is_fisheye"):
        model = "OPENCV_FISHEYE"
    if model not in _TERMS:
        raise frame.complaint("camera_model", f"one of {', '.join(_TERMS)}")
    for term in _ALL_TERMS:
        if term not in _TERMS[model] and frame.number(term, 0.0) != 0:
            raise UserError(
                f"{frame.where}: {term!r} is {frame.tree[term]!r}, which camera model {model} has not here"
            )
    return model


def _pinhole(frame: Fields, size: tuple[int, int], model: str) -> tuple[float, float, float, float]:
    """Focal lengths and principal point; one of the focal lengths stands for the other where that is missing."""
    height, width = size
    focal_x = _focal(frame, "fl_x", "camera_angle_x", width)
    focal_y = None if model == "SIMPLE_PINHOLE" else _focal(frame, "fl_y", "camera_angle_y", height)
    if focal_x is None and focal_y is None:
        raise frame.complaint("fl_x", "a focal length in pixels, or camera_angle_x in radians")
    focal_x, focal_y = focal_x or focal_y or 0.0, focal_y or focal_x or 0.0
    return focal_x, focal_y, frame.number("cx", 0.5 * width), frame.number("cy", 0.5 * height)


def _focal(frame: Fields, length: str, angle: str, side: int) -> float | None:
    if length in frame:
        return frame.positive(length)
    return 0.5 * side / math.tan(0.5 * frame.angle(angle)) if angle in frame else None


def _named(root: Fields, key: str, by_name: dict[PurePosixPath, Photograph]) -> Sequence[Photograph]:
    """The photographs of a list of file names."""
    names = [_tidy(name) for name in root.texts(key)]
    unknown = [str(name) for name in names if name not in by_name]
    if unknown:
        raise UserError(f"{root.where}: {key!r} names {unknown[0]!r}, which no frame has")
    if len(set(names)) < len(names):
        raise UserError(f"{root.where}: {key!r} names a file twice")
    return [by_name[name] for name in sorted(names)]


def _tidy(name: str) -> PurePosixPath:
    return PurePosixPath(name.replace("\\", "/"))
