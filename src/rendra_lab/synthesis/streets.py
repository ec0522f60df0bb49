"""Streets that nobody has seen, driven through by a camera such as KITTI's.

Geiger, Lenz and Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012: pictures
of 1241 x 376 pixels, focal length 718.856 px, 1.65 m above the road, ten a second.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.settings import Positive, check_numbers
from rendra_lab.synthesis.posed_views import PosedViews
from rendra_lab.synthesis.street_layout import build_street
from rendra_lab.synthesis.street_textures import Rng, draw_textures
from rendra_lab.synthesis.sunlit_scenes import Daylight, SunlitScene

_EDITION = 3  # another one makes all cached pictures anew
_WIDTH, _HEIGHT = 1241.0, 376.0
_FOCAL, _CENTER = 718.856, (607.1928, 185.2157)  # px, of the sequences 00 to 02
_CAMERA_M = 1.65  # above the road
_DOME = (96, 256)  # height and width of the picture of the sky


class StreetWorld:
    """Streets, each with a drive along it; views are frames of the drive.

    Args:
        max_offset: two views are 1 to so many frames apart.
        step_m: least and most metres between two frames.

    Raises:
        UserError: an impossible setting.
    """

    def __init__(self, max_offset: Positive = 5, step_m: Sequence[float] = (0.8, 1.2)) -> None:
        check_numbers("data.world", Positive, max_offset=max_offset)
        if len(step_m) != 2 or not 0 < step_m[0] <= step_m[1] <= 5:
            raise UserError(
                f"data.world.step_m must be [least,most] metres, above 0 and at most 5, got {list(step_m)}"
            )
        self.max_offset = max_offset
        self.step_m = (float(step_m[0]), float(step_m[1]))

    def settings(self) -> tuple[object, ...]:
        """See `World`."""
        return (_EDITION, self.max_offset, self.step_m)

    @torch.no_grad()
    def views(self, seed: int, count: int, size: tuple[int, int]) -> PosedViews:
        """See `World`.

        Raises:
            UserError: more views than frames lie within `max_offset`.
        """
        if not 2 <= count <= self.max_offset + 1:
            raise UserError(
                f"data.world.max_offset={self.max_offset} leaves {self.max_offset + 1} frames to choose from; "
                f"got {count} views of a place (data.views_per_scene)"
            )
        rng = np.random.default_rng([seed, 20_061])
        frames = self._frames(rng, count)
        street = build_street(rng, clear=self.max_offset * self.step_m[1] + 2.0)
        scene = SunlitScene(
            street.faces, torch.from_numpy(draw_textures(rng, street.marks)), _daylight(rng), street.contact
        )
        poses = _drive(rng, frames, self.step_m, street.lane, street.spare)
        intrinsics = kitti_intrinsics(size)
        taken = [scene.take(intrinsics, pose, size) for pose in poses]
        return PosedViews(
            rgb=torch.stack([rgb for rgb, _ in taken]),
            depth=torch.stack([depth for _, depth in taken]),
            intrinsics=intrinsics.expand(count, 3, 3).clone(),
            world_to_camera=poses,
        )

    def _frames(self, rng: Rng, count: int) -> list[int]:
        """Numbers of frames in any order, the first two as far apart as any offset is likely to be."""
        offset = int(rng.integers(max(1, count - 1), self.max_offset + 1))
        between = rng.permutation(np.arange(1, offset))[: count - 2]
        return rng.permutation([0, offset, *between.tolist()]).tolist()


def kitti_intrinsics(size: tuple[int, int]) -> Tensor:
    """KITTI's (3, 3), in pixels of a picture of H x W that a whole one was squeezed into: unlike along x and y."""
    across, down = size[1] / _WIDTH, size[0] / _HEIGHT
    return torch.tensor([
        [_FOCAL * across, 0.0, (_CENTER[0] + 0.5) * across],  # KITTI counts from the middle of the first pixel
        [0.0, _FOCAL * down, (_CENTER[1] + 0.5) * down],
        [0.0, 0.0, 1.0],
    ])  # fmt: skip


def _drive(rng: Rng, frames: list[int], step_m: tuple[float, float], lane: float, spare: float) -> Tensor:
    """From the world (y down) to the cameras of some frames: (V, 4, 4)."""
    step, first = rng.uniform(*step_m), rng.uniform(-1.0, 1.0)
    side, drift = rng.uniform(-0.7, 0.7) * spare, rng.uniform(-0.05, 0.05)
    yaw, turning = np.radians(rng.normal(0, 1.6)), np.radians(rng.normal(0, 0.35))
    pitch, roll, height = np.radians(rng.normal(0, 0.35)), np.radians(rng.normal(0, 0.25)), _CAMERA_M
    poses = []
    for frame in frames:
        shake = np.radians(rng.normal(0, 0.12, 3))
        axes = _turned(yaw + turning * frame + shake[0], pitch + shake[1], roll + shake[2])
        at = np.array([lane + side + drift * frame, -height + rng.normal(0, 0.01), first + step * frame])
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = axes, -axes @ at
        poses.append(pose)
    return torch.from_numpy(np.stack(poses)).float()


def _turned(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """The rotation (3, 3) from the world to a camera that looks right by yaw, up by pitch, and leans by roll."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(angle), np.sin(angle)) for angle in (yaw, pitch, roll))
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, sp], [0, -sp, cp]])
    about_z = np.array([[cr, sr, 0], [-sr, cr, 0], [0, 0, 1]])
    return about_z @ about_x @ about_y


def _daylight(rng: Rng) -> Daylight:
    """A sunny day in three of four, at some hour."""
    is_sunny = rng.random() < 0.75
    height, heading = np.radians(rng.uniform(25, 65)), rng.uniform(0, 2 * np.pi)
    to_sun = (np.cos(height) * np.sin(heading), np.sin(height), np.cos(height) * np.cos(heading))
    exposure = rng.uniform(0.85, 1.15)
    warm = rng.uniform(0.78, 1.0)
    zenith = np.array([0.3, 0.47, 0.82]) if is_sunny else np.array([0.62, 0.66, 0.72])
    horizon = np.array([0.78, 0.86, 0.96]) * rng.uniform(0.9, 1.0)
    zenith, horizon = zenith * rng.uniform(0.85, 1.1), horizon if is_sunny else 0.5 * horizon + 0.45
    sky = exposure * np.array((0.5, 0.6, 0.78) if is_sunny else (1.02, 1.04, 1.08))
    sun = exposure * 1.5 * np.array([1.0, (1 + warm) / 2, warm]) if is_sunny else np.zeros(3)
    return Daylight(
        to_sun=_triple(to_sun),
        sun=_triple(sun),
        sky=_triple(sky),
        ground=_triple(0.42 * sky + 0.09 * sun),
        haze=_triple(horizon**2),
        haze_m=float(np.exp(rng.uniform(np.log(250), np.log(1500)))),
        dome=_dome(rng, zenith, horizon, rng.uniform(0.0, 0.9) if is_sunny else rng.uniform(0.5, 1.0)),
    )


def _dome(rng: Rng, zenith: np.ndarray, horizon: np.ndarray, cover: float) -> Tensor:
    """The picture (3, h, w) of a sky with clouds, as light; they crowd towards the horizon."""
    height, width = _DOME
    up = 1 - (torch.arange(height) + 0.5) / height
    blue = torch.lerp(
        torch.tensor(horizon).float()[:, None], torch.tensor(zenith).float()[:, None], (1 - (-3 * up).exp())
    )
    clouds = torch.zeros(height, width)
    for octave in range(5):
        rows, columns = 4 * 2**octave, 5 * 2**octave
        coarse = torch.from_numpy(rng.standard_normal((1, 1, rows, columns), np.float32))
        clouds += F.interpolate(coarse, _DOME, mode="bicubic", align_corners=True)[0, 0] * 0.58**octave
    dense = ((clouds + 2 * (cover - 0.62)) * 1.1).clamp(0, 1)
    bright = 0.97 - 0.16 * (clouds.roll(-3, 0) * 0.5).clamp(0, 1)
    colour = bright * torch.tensor([1.0, 1.0, 1.02])[:, None, None]
    return torch.lerp(blue[:, :, None].expand(3, height, width), colour, 0.9 * dense).clamp(0, 1).square()


def _triple(values: object) -> tuple[float, float, float]:
    r, g, b = np.asarray(values, float).tolist()
    return r, g, b
