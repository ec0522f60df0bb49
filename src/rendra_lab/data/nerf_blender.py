"""Folders of NeRF's synthetic scenes: transforms_{train,val,test}.json beside the pictures that Blender rendered.

Mildenhall et al., "NeRF", ECCV 2020. Poses are OpenGL's, the world's +Z is up, and the focal length is
W / (2 tan(camera_angle_x / 2)) pixels.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from rendra_lab.data.folder_views import Capture, FolderViews, demand_unique
from rendra_lab.data.json_fields import Fields, read_json
from rendra_lab.data.photographs import SUFFIXES, Photograph, image_size, poses_from_opengl
from rendra_lab.errors import UserError


class NerfBlenderViews(FolderViews):
    """A scene in the format of NeRF's synthetic ones.

    A missing validation set is the test set and the other way round; if both are missing, every `hold_out`th
    training view is held out for them.

    Args:
        path: the folder.
        half_size: the same as shrink=2, as the paper's smaller runs.
        test_skip: takes every which validation and test view; the original trains with 8.
        **folder: see FolderViews.
    """

    def __init__(self, path: str | Path, half_size: bool = False, test_skip: int = 1, **folder: Any) -> None:
        super().__init__(path, **folder)
        if not isinstance(test_skip, int) or test_skip < 1:
            raise UserError(f"data.test_skip must be 1 or more, got {test_skip!r}")
        self.half_size = half_size
        self.test_skip = test_skip

    @property
    def _factor(self) -> int:
        return self.shrink * (2 if self.half_size else 1)

    def read(self) -> Capture:
        """The cameras and the names of the photographs."""
        splits = {name: self._split(name) for name in ("train", "val", "test")}
        if splits["train"] is None:
            raise UserError(f"there is no file {self.path / 'transforms_train.json'}")
        train, val, test = splits["train"], splits["val"], splits["test"]
        up = (0.0, 0.0, 1.0)
        if val is None and test is None:
            train, held = self.divided(train)
            remark = f"no transforms_val.json and no transforms_test.json: every {self.hold_out}th view is held out"
            return Capture(train, held, held, up=up, remark=remark, is_interleaved=True)
        present = (val if test is None else test)[:: self.test_skip]  # type: ignore[index]
        if val is not None and test is not None:
            return Capture(train, val[:: self.test_skip], present, up=up)
        missing, other = ("val", "test") if val is None else ("test", "val")
        return Capture(
            train, present, present, up=up, remark=f"no transforms_{missing}.json: {other} views take its place"
        )

    def _split(self, name: str) -> list[Photograph] | None:
        file = self.path / f"transforms_{name}.json"
        if not file.exists():
            return None
        root = Fields(read_json(file), str(file))
        angle = root.angle("camera_angle_x")
        frames = [Fields(tree, f"{file}, frame {i}") for i, tree in enumerate(root.objects("frames"))]
        places = [frame.where for frame in frames]
        paths = [self._picture(frame) for frame in frames]
        demand_unique(paths, places)
        R, T = poses_from_opengl(torch.stack([frame.pose("transform_matrix") for frame in frames]), places)
        photographs = []
        for index, (path, place) in enumerate(zip(paths, places, strict=True)):
            height, width = image_size(path, place)
            focal = 0.5 * width / math.tan(0.5 * angle)
            pinhole = (focal, focal, 0.5 * width, 0.5 * height)
            photographs.append(Photograph(path, place, (height, width), pinhole, R[index], T[index]))
        return photographs

    def _picture(self, frame: Fields) -> Path:
        """The file of a frame, whose name may lack its suffix."""
        path = self.inside(frame.text("file_path"), frame.where)
        if path.is_file():
            return path
        for suffix in SUFFIXES:
            named = path.with_name(path.name + suffix)
            if named.is_file():
                return self.inside(frame.text("file_path") + suffix, frame.where)
        raise UserError(f"{frame.where}: there is no picture {path}, with or without {', '.join(SUFFIXES[:3])}")
