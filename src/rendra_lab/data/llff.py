"""Folders of forward-facing captures with poses_bounds.npy, as LLFF writes them.

Mildenhall et al., "Local Light Field Fusion", SIGGRAPH 2019, and the appendix C of "NeRF", ECCV 2020. A row is a
matrix (3, 5), whose columns are the camera's downward, right and backward axis, its position, and height, width and
focal length in pixels; then the nearest and the farthest depth of what it sees.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.data.folder_views import Capture, FolderViews, folder_of_images, pictures_in
from rendra_lab.data.npy_files import read_npy
from rendra_lab.data.photographs import (
    Photograph,
    demand_rotations,
    demand_size,
    image_size,
    poses_from_opengl,
)
from rendra_lab.errors import UserError

_NEARER = 0.9  # where rays begin, in parts of the nearest depth
_NO_DIRECTION = 1e-6  # length of a mean of directions that cancel each other
_BORDER = 5  # points along each side of an image that bound its rays


@dataclass(frozen=True)
class NdcWarp:
    """Rays of forward-facing cameras in normalised device coordinates: NeRF, appendix C.

    The camera that they are relative to stands at the origin and looks along -z, +x to its right and +y upwards. A
    ray begins on the near plane, where z is -1 in the result, and ends at infinity, where z is 1.
    """

    slope_x: float  # W / (2 f): the tangent of half the field of view
    slope_y: float
    near: float = 1.0

    def __call__(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Origins (Q, 3) on the near plane and unit directions (Q, 3); directions must have z below 0."""
        along = -(self.near + origins[:, 2:]) / directions[:, 2:]
        start = origins + along * directions
        scale = -1 / start.new_tensor([self.slope_x, self.slope_y])
        depth = start[:, 2:]
        ratio = start[:, :2] / depth
        bent = torch.cat([scale * ratio, 1 + 2 * self.near / depth], dim=1)
        turn = torch.cat([scale * (directions[:, :2] / directions[:, 2:] - ratio), -2 * self.near / depth], dim=1)
        return bent, F.normalize(turn, dim=1)


class LlffViews(FolderViews):
    """A scene in the format of LLFF; every `hold_out`th image is held out.

    The pictures of `images_4` are taken for shrink=4, and so on, where there is such a folder.

    Args:
        path: the folder.
        recentre: moves the mean of the cameras to the origin, looking along -z.
        bound_factor: the scene is scaled so that this share of its nearest depth is 1; null leaves it.
        spherify: for cameras all around: their common focus becomes the origin, their mean distance from it 1.
        ndc: bends rays to normalised device coordinates, for scenes that reach far.
        **folder: see FolderViews.
    """

    def __init__(
        self,
        path: str | Path,
        recentre: bool = True,
        bound_factor: float | None = 0.75,
        spherify: bool = False,
        ndc: bool = False,
        **folder: Any,
    ) -> None:
        super().__init__(path, **folder)
        if ndc and (spherify or not recentre):
            raise UserError("data.ndc=true is for forward-facing scenes: it needs recentre=true and spherify=false")
        if ndc and (self.box is not None or self.depth_range is not None):
            raise UserError("data.ndc=true sets box and depth_range itself: leave them out")
        if bound_factor is not None and not bound_factor > 0:
            raise UserError(f"data.bound_factor must be above 0, got {bound_factor}")
        self.recentre = recentre
        self.bound_factor = bound_factor
        self.spherify = spherify
        self.ndc = ndc

    @property
    def _factor(self) -> int:
        return folder_of_images(self.path, self.shrink)[1]

    def read(self) -> Capture:
        """The cameras and the names of the photographs."""
        file = self.path / "poses_bounds.npy"
        poses, hwf, bounds = _table(file)
        pictures = pictures_in(folder_of_images(self.path, self.shrink)[0])
        if len(pictures) != len(poses):
            raise UserError(
                f"{file} has {len(poses)} poses, but {pictures[0].parent if pictures else self.path} "
                f"has {len(pictures)} pictures"
            )
        poses, bounds = self._placed(poses, bounds)
        where = [f"{file}, row {row}" for row in range(len(poses))]
        R, T = poses_from_opengl(poses, where)
        photographs = [
            self._photograph(path, place, size, R[row], T[row])
            for row, (path, place, size) in enumerate(zip(pictures, where, hwf.tolist(), strict=True))
        ]
        train, held = self.divided(photographs)
        up = (0.0, 0.0, 1.0) if self.spherify else (0.0, 1.0, 0.0) if self.recentre else _mean_up(poses)
        depth_range = (_NEARER * float(bounds.min()), _reach(photographs) * float(bounds.max()))
        if self.ndc:
            warp = _ndc(photographs)
            return Capture(
                train, held, held, box=_box_of_ndc(photographs, warp), up=up, warp=warp, remark="rays in NDC"
            )
        return Capture(train, held, held, depth_range=depth_range, up=up, is_interleaved=True)

    def _placed(self, poses: Tensor, bounds: Tensor) -> tuple[Tensor, Tensor]:
        """Poses and bounds in the scene's own frame and unit."""
        scale = 1.0 if self.bound_factor is None else 1 / (self.bound_factor * float(bounds.min()))
        poses = _scaled(poses, scale)
        if self.recentre:
            poses = torch.linalg.inv(_mean_pose(poses)) @ poses
        if self.spherify:
            poses, more = _around_focus(poses, self.path)
            scale *= more
        return poses, bounds * scale

    def _photograph(self, path: Path, where: str, hwf: Sequence[float], R: Tensor, T: Tensor) -> Photograph:
        size = image_size(path, where)
        shrunk = self.shrink if self._factor == 1 else 1
        expected = (round(hwf[0] / shrunk), round(hwf[1] / shrunk))
        demand_size(path, where, size, expected, slack=0 if shrunk == 1 else 1)
        focal = (hwf[2] * size[1] / hwf[1], hwf[2] * size[0] / hwf[0])
        return Photograph(path, where, size, (*focal, 0.5 * size[1], 0.5 * size[0]), R, T)


def _table(file: Path) -> tuple[Tensor, Tensor, Tensor]:
    """OpenGL's poses (N, 4, 4), height, width and focal length (N, 3), and bounds (N, 2): float64."""
    table = torch.from_numpy(read_npy(file))
    if table.dim() != 2 or table.shape[1] != 17 or len(table) == 0:
        raise UserError(f"{file} holds {' x '.join(map(str, table.shape))} numbers; expected N x 17")
    where = [f"{file}, row {row}" for row in range(len(table))]
    for name, bad in {
        "numbers that are not finite": ~table.isfinite().all(1),
        "a height, width or focal length that is not above 0": (table[:, :15].view(-1, 3, 5)[:, :, 4] <= 0).any(1),
        "depths that are not 0 < near < far": ~((table[:, 15] > 0) & (table[:, 15] < table[:, 16])),
    }.items():
        if bool(bad.any()):
            raise UserError(f"{where[int(bad.nonzero()[0])]}: {name}: {table[bad][0].tolist()}")
    matrices = table[:, :15].view(-1, 3, 5)
    down, right, back, position, hwf = matrices.unbind(2)
    poses = torch.eye(4, dtype=table.dtype).repeat(len(table), 1, 1)
    poses[:, :3] = torch.stack([right, -down, back, position], dim=2)
    demand_rotations(poses[:, :3, :3], where)
    return poses, hwf, table[:, 15:]


def _scaled(poses: Tensor, scale: float) -> Tensor:
    poses = poses.clone()
    poses[:, :3, 3] *= scale
    return poses


def _mean_pose(poses: Tensor) -> Tensor:
    """A camera (4, 4) at the mean position, that looks along the mean axis."""
    axis, up = poses[:, :3, 2].mean(0), poses[:, :3, 1].mean(0)
    mean = _frame(poses[0, :3, 2] if float(axis.norm()) < _NO_DIRECTION else axis, up)
    mean[:3, 3] = poses[:, :3, 3].mean(0)
    return mean


def _frame(z: Tensor, y: Tensor) -> Tensor:
    """Axes (4, 4) with the direction z, and y as far as it is not along z; any other y where there is none."""
    z = F.normalize(z, dim=0)
    right = torch.linalg.cross(y, z)
    if float(right.norm()) < _NO_DIRECTION:
        right = torch.linalg.cross(torch.eye(3, dtype=z.dtype)[int(z.abs().argmin())], z)
    right = F.normalize(right, dim=0)
    frame = torch.eye(4, dtype=z.dtype)
    frame[:3, :3] = torch.stack([right, torch.linalg.cross(z, right), z], dim=1)
    return frame


def _mean_up(poses: Tensor) -> tuple[float, float, float]:
    x, y, z = F.normalize(poses[:, :3, 1].mean(0), dim=0).tolist()
    return x, y, z


def _around_focus(poses: Tensor, path: Path) -> tuple[Tensor, float]:
    """Poses about the point nearest to all axes, +z towards the cameras' side, mean distance 1; and the scale."""
    axes, positions = poses[:, :3, 2], poses[:, :3, 3]
    across = torch.eye(3, dtype=poses.dtype) - axes[:, :, None] * axes[:, None]
    if float(torch.linalg.eigvalsh(across.mean(0))[0]) < 1e-4:
        raise UserError(f"{path}: data.spherify=true needs cameras that look at one point; these are parallel")
    focus = torch.linalg.solve(across.mean(0), (across @ positions[:, :, None]).mean(0)[:, 0])
    up = (positions - focus).mean(0)
    if float(up.norm()) < 1e-3 * float((positions - focus).norm(dim=1).mean()):
        up = poses[:, :3, 1].mean(0)  # cameras on all sides: the direction that they hold upwards
    frame = _frame(up, poses[:, :3, 1].mean(0))
    frame[:3, 3] = focus
    poses = torch.linalg.inv(frame) @ poses
    scale = 1 / float(poses[:, :3, 3].square().sum(1).mean().sqrt())
    return _scaled(poses, scale), scale


def _reach(photographs: Sequence[Photograph]) -> float:
    """How much longer than deep the ray of an image's corner is."""
    slopes = [
        (0.5 * p.size[1] / p.intrinsics[0]) ** 2 + (0.5 * p.size[0] / p.intrinsics[1]) ** 2 for p in photographs
    ]
    return (1 + max(slopes)) ** 0.5


def _ndc(photographs: Sequence[Photograph]) -> NdcWarp:
    height, width = photographs[0].size
    focal_x, focal_y = photographs[0].intrinsics[:2]
    return NdcWarp(0.5 * width / focal_x, 0.5 * height / focal_y)


def _box_of_ndc(photographs: Sequence[Photograph], warp: NdcWarp) -> Tensor:
    """The box (2, 3) that all warped rays stay in: from the near plane to infinity."""
    ends = []
    for photograph in photographs:
        origins, directions = _border(photograph)
        if bool((directions[:, 2] > -0.05).any()) or float(origins[0, 2]) <= -warp.near:
            raise UserError(
                f"{photograph.where}: the camera does not look forwards over the near plane; data.ndc=true is for "
                "captures from one side"
            )
        start, turn = warp(origins, directions)
        ends += [start, start + turn * ((1 - start[:, 2:]) / turn[:, 2:])]
    points = torch.cat(ends).float()
    lowest, highest = points.amin(0), points.amax(0)
    margin = 1e-3 * (highest - lowest)
    margin[2] = 0  # rays begin on one of these walls and end on the other
    return torch.stack([lowest - margin, highest + margin])


def _border(photograph: Photograph) -> tuple[Tensor, Tensor]:
    """Rays through a lattice of points of an image: origins and unit directions (Q, 3)."""
    steps = torch.linspace(0, 1, _BORDER, dtype=torch.float64)
    xy = torch.cartesian_prod(steps * photograph.size[1], steps * photograph.size[0])
    focal, middle = xy.new_tensor(photograph.intrinsics).split(2)
    in_view = torch.cat([-(xy - middle) / focal, torch.ones_like(xy[:, :1])], dim=1)
    directions = F.normalize(in_view @ photograph.R.T, dim=1)
    return -(photograph.T @ photograph.R.T).expand_as(directions), directions
