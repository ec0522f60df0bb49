"""Folders of COLMAP: photographs and a sparse model of their cameras and of points of the scene."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra.renderer.camera_conversions import cameras_from_colmap
from rendra_lab.data.colmap_models import ColmapCamera, ColmapImage, read_model
from rendra_lab.data.folder_views import Capture, FolderViews, folder_of_images
from rendra_lab.data.photographs import SUFFIXES, Photograph, demand_size, image_size
from rendra_lab.errors import UserError

_MOST_POINTS = 4096  # that the nearest depth is taken from
_NEARER = 0.5  # where rays begin, in parts of the depth that nearly all points lie beyond


class ColmapViews(FolderViews):
    """A scene that COLMAP has reconstructed; see FolderViews for the arguments. Every `hold_out`th image is held out.

    The model lies in `sparse/0`, `sparse` or the folder itself. The pictures of `images_4` are taken for shrink=4,
    and so on, where there is such a folder; else those of `images`.
    """

    @property
    def _factor(self) -> int:
        return folder_of_images(self.path, self.shrink)[1]

    def read(self) -> Capture:
        """The cameras and the names of the photographs."""
        cameras, images, points = read_model(self._model_folder())
        R, T = _poses(images)
        photographs = [
            self._photograph(image, cameras[image.camera], R[index], T[index]) for index, image in enumerate(images)
        ]
        train, held = self.divided(photographs)
        depth_range = _depths(points, R, T)
        x, y, z = F.normalize(R[:, :, 1].mean(0), dim=0).tolist()
        return Capture(train, held, held, points=points, depth_range=depth_range, up=(x, y, z), is_interleaved=True)

    def _model_folder(self) -> Path:
        folders = [self.path / "sparse" / "0", self.path / "sparse", self.path]
        for folder in folders:
            if (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file():
                return folder
        raise UserError(f"there is no cameras.bin or cameras.txt in {', '.join(map(str, folders))}")

    def _photograph(self, image: ColmapImage, camera: ColmapCamera, R: Tensor, T: Tensor) -> Photograph:
        folder, rest = folder_of_images(self.path, self.shrink)
        path = self._picture(folder, image)
        where = f"{image.where} ({image.name})"
        size = image_size(path, where)
        shrunk = 1 if rest == self.shrink else self.shrink
        expected = (round(camera.size[0] / shrunk), round(camera.size[1] / shrunk))
        demand_size(path, where, size, expected, slack=0 if shrunk == 1 else 1)
        down, across = size[0] / camera.size[0], size[1] / camera.size[1]
        fx, fy, cx, cy = camera.pinhole
        pinhole = (fx * across, fy * down, cx * across, cy * down)
        return Photograph(path, where, size, pinhole, R, T, camera.distortion, camera.fisheye)

    def _picture(self, folder: Path, image: ColmapImage) -> Path:
        """The file of an image; shrunk ones may have another suffix."""
        path = self.inside(f"{folder.name}/{image.name}", image.where)
        if path.is_file() or folder.name == "images":
            return path
        return next((p for suffix in SUFFIXES if (p := path.with_suffix(suffix)).is_file()), path)


def _poses(images: list[ColmapImage]) -> tuple[Tensor, Tensor]:
    """R (N, 3, 3) and T (N, 3) as this library has them, float64."""
    qvec = F.normalize(torch.tensor([image.qvec for image in images], dtype=torch.float64), dim=1)
    tvec = torch.tensor([image.tvec for image in images], dtype=torch.float64)
    plain = torch.ones(len(images), 4, dtype=torch.float64)  # lenses are kept apart
    cameras = cameras_from_colmap(qvec, tvec, "PINHOLE", plain, (1, 1), in_ndc=False)
    return cameras.R, cameras.T


def _depths(points: Tensor, R: Tensor, T: Tensor) -> tuple[float, float] | None:
    """Distances between which nearly all of the points lie, with room; None where there are too few points."""
    if len(points) < 10:
        return None
    some = points[:: max(1, len(points) // _MOST_POINTS)]
    distances = torch.cdist(some, -(T[:, None] @ R.mT)[:, 0])
    depths = torch.einsum("pi,ni->pn", some, R[:, :, 2]) + T[:, 2]
    seen = distances[depths > 0].sort().values
    if len(seen) == 0:
        return None
    return _NEARER * float(seen[len(seen) // 100]), 2 * float(seen[-1 - len(seen) // 100])
