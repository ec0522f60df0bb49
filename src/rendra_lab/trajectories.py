"""Ways of a camera through a scene: once round it, in a spiral before it, or as a file says.

Each way is a `PosedImages` without pixels: what `RayCaster.blank_view` takes. Poses are this library's:
x_view = x_world @ R + T, and in view +X is left, +Y up, +Z forwards.
Letters: N cameras of a way, K keyframes of a file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rendra.renderer.cameras import look_at_rotation
from rendra.transforms import axis_angle_to_matrix, matrix_to_axis_angle
from rendra_lab.data.posed_images import NUM_DISTORTION, PosedImages
from rendra_lab.data.ray_views import Scene, within_box
from rendra_lab.errors import UserError

Size = int | tuple[int, int] | None

WAYS = ("auto", "orbit", "spiral")

_STEEPEST_DEG = 85.0
_SAME_WAY = 0.9  # length of the mean of the viewing directions from which on a scene counts as forward-facing
_PARALLEL = 1e-3  # share of the smallest eigenvalue below which optical axes have no common point
_MOST_CAMERAS = 100_000
_FPS = 20.0


def trajectory(
    name: str, scene: Scene, frames: int | None = None, size: Size = None, elevation_deg: float | None = None
) -> PosedImages:
    """A way by its name.

    Args:
        name: orbit, spiral, auto (a spiral where the training cameras all look the same way, else an orbit), or
            the path of a JSON file, see `from_file`.
        scene: the scene.
        frames: number of cameras N; None: 60, or what the file says.
        size: (height, width) in pixels, or of the shorter side alone; None: that of the first training image, or
            what the file says.
        elevation_deg: of an orbit.

    Raises:
        UserError: an unknown name, a broken file, or numbers that cannot be.
    """
    if frames is not None and not 1 <= frames <= _MOST_CAMERAS:
        raise UserError(f"frames must be a number from 1 to {_MOST_CAMERAS}, got {frames}")
    if name.endswith(".json"):
        return from_file(name, scene, frames, size)
    if name not in WAYS:
        raise UserError(f"trajectory must be {', '.join(WAYS)} or a .json file, got {name!r}")
    if name == "spiral" or (name == "auto" and is_forward_facing(scene)):
        return spiral(scene, frames or 60, size)
    return orbit(scene, frames or 60, size, elevation_deg)


def orbit(
    scene: Scene,
    frames: int = 60,
    size: Size = None,
    elevation_deg: float | None = None,
    radius: float | None = None,
) -> PosedImages:
    """Once round what the training cameras look at, in equal steps, counter-clockwise seen from above.

    It begins on the side of the first training camera. The renderings of NeRF's synthetic scenes are
    `orbit(scene, 40, elevation_deg=30, radius=4)`, where the original says phi = -30.

    Args:
        scene: the scene.
        frames: number of cameras N.
        size: see `trajectory`.
        elevation_deg: of the cameras above the horizontal plane, in (-90, 90); None: the median of training.
        radius: distance from the centre; None: the median of the training cameras.

    Raises:
        UserError: an elevation or radius that cannot be.
    """
    if elevation_deg is not None and not -90 < elevation_deg < 90:
        raise UserError(f"elevation_deg must lie between -90 and 90, got {elevation_deg}")
    if radius is not None and not radius > 0:
        raise UserError(f"radius must be positive, got {radius}")
    up, centre = upward(scene), point_of_interest(scene)
    offsets = scene.train.positions.double() - centre
    distances = offsets.norm(dim=1)
    height = torch.rad2deg((offsets @ up / distances.clamp_min(1e-12)).clamp(-1, 1).asin()).median()
    steepness = height.clamp(-_STEEPEST_DEG, _STEEPEST_DEG) if elevation_deg is None else torch.tensor(elevation_deg)
    elevation = torch.deg2rad(steepness.double())
    front = _across(offsets[0], up)
    angle = torch.arange(frames, dtype=torch.float64)[:, None] * (2 * math.pi / frames)
    ring = angle.cos() * front + angle.sin() * torch.linalg.cross(up, front)
    distance = distances.median() if radius is None else radius
    positions = centre + distance * (elevation.cos() * ring + elevation.sin() * up)
    return _looking_at(scene, positions, centre, up, size)


def spiral(scene: Scene, frames: int = 60, size: Size = None, turns: int = 2) -> PosedImages:
    """Turns about the mean training camera, looking at one point before it: for forward-facing scenes.

    The radii are the 90th percentiles of the cameras' offsets along the axes of the mean camera, and the way
    moves forwards and back once in two turns. Source: Mildenhall et al., "Local Light Field Fusion", 2019.

    Args:
        scene: the scene.
        frames: number of cameras N.
        size: see `trajectory`.
        turns: how often round.
    """
    views = scene.train
    positions, R = views.positions.double(), views.R.double()
    middle, forward, up = positions.mean(0), _unit(R[:, :, 2].mean(0)), upward(scene)
    axes = look_at_rotation(middle[None], at=(middle + forward)[None], up=up[None], device=middle.device)[0]
    radii = ((positions - middle) @ axes).abs().quantile(0.9, dim=0)
    angle = torch.arange(frames, dtype=torch.float64) * (2 * math.pi * turns / frames)
    offsets = torch.stack([angle.cos(), angle.sin(), (angle / 2).sin()], dim=1) * radii
    target = middle + _focus_distance(scene, middle, forward) * forward
    return _looking_at(scene, middle + offsets @ axes.T, target, up, size)


def is_forward_facing(scene: Scene) -> bool:
    """Whether all training cameras look about the same way."""
    return bool(scene.train.R[:, :, 2].mean(0).norm() > _SAME_WAY)


def upward(scene: Scene) -> Tensor:
    """The upward direction (3,), float64 of length 1: the scene's own, or what the training cameras say.

    Cameras held level have their sides at right angles to it, wherever they look; where their sides leave that
    open, as those of parallel cameras do, or contradict each other, it is the mean of the cameras' own.
    """
    if scene.up is not None:
        return _unit(torch.tensor(scene.up, dtype=torch.float64))
    R = scene.train.R.double()
    mean = R[:, :, 1].mean(0)
    shares, directions = torch.linalg.eigh(R[:, :, 0].T @ R[:, :, 0] / len(R))
    if float(shares[0]) < 0.01 and float(shares[1]) > 0.1:
        level = directions[:, 0]
        return _unit(level if float(level @ mean) >= 0 else -level)
    return _unit(mean) if float(mean.norm()) > 1e-6 else mean.new_tensor([0.0, 1.0, 0.0])


def point_of_interest(scene: Scene) -> Tensor:
    """What the training cameras look at, (3,) float64: the point nearest to all optical axes.

    The middle of the scene's box where the axes have no common point, or have it behind the cameras.
    """
    positions, forward = scene.train.positions.double(), scene.train.R[:, :, 2].double()
    aside = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None]  # (N, 3, 3)
    total = aside.sum(0)
    if float(torch.linalg.eigvalsh(total)[0]) > _PARALLEL * len(positions):
        nearest = torch.linalg.solve(total, (aside @ positions[:, :, None]).sum(0))[:, 0]
        if float(((nearest - positions) * forward).sum(1).median()) > 0:
            return nearest
    return scene.box.double().mean(0)


def from_file(path: str | Path, scene: Scene, frames: int | None = None, size: Size = None) -> PosedImages:
    """The way that a JSON file describes by keyframes.

    Ours: `{"keyframes": [...], "fps": 20, "closed": false, "width": 320, "height": 240}`, all but the keyframes
    optional. A keyframe has either `camera_to_world`, 4 x 4 numbers in OpenGL's axes (+X right, +Y up, looking
    along -Z), or `R` and `T` in this library's; perhaps `fov`, the degrees from the lower edge of the picture to
    the upper one (else the lens of the training images); and perhaps `seconds` since the keyframe before (else
    1; of the first keyframe: from the last one back to it, where the way is closed).
    The camera moves through the keyframes on a Catmull-Rom spline and turns between two of them evenly about one
    axis.

    A `camera_path` of nerfstudio's viewer is understood too: one camera an entry, in the coordinates of its file.

    Args:
        path: of the file.
        scene: gives the lens where the file does not.
        frames: number of cameras N, evenly in time; None: what the file says.
        size: see `trajectory`.

    Raises:
        UserError: the file is not there or malformed; names file and keyframe.
    """
    keys, tree = _read(Path(path))
    if frames is None:
        frames = len(keys.times) if "camera_path" in tree else 1 + round(float(keys.times[-1]) * keys.fps)
    if not 1 <= frames <= _MOST_CAMERAS:
        raise UserError(f"{path}: asks for {frames} cameras; at most {_MOST_CAMERAS} are made")
    share = torch.arange(frames, dtype=torch.float64) / max(1, frames if keys.closed else frames - 1)
    R, position, fov = keys.at(share * keys.times[-1])
    intrinsics, sizes = _lens(scene.train, keys.size if size is None else size, frames)
    focal = sizes[:, 0] / (2 * torch.deg2rad(fov / 2).tan())
    intrinsics[:, :2] = torch.where(fov.isnan(), intrinsics[:, 0], focal.float())[:, None]
    return _unseen(R, position, intrinsics, sizes)


def rate_of(name: str) -> float:
    """Frames a second at which a way is played: what its file says, else 20."""
    return _read(Path(name))[0].fps if name.endswith(".json") else _FPS


@dataclass(frozen=True)
class _Keyframes:
    """Cameras at certain times."""

    times: Tensor  # (K,) seconds, growing from 0
    R: Tensor  # (K, 3, 3)
    position: Tensor  # (K, 3)
    fov: Tensor  # (K,) degrees, NaN: the lens of the scene
    fps: float
    closed: bool
    size: tuple[int, int] | None

    def at(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """R (N, 3, 3), position (N, 3) and field of view (N,) at times (N,)."""
        count = len(self.times)
        if count == 1:
            index = torch.zeros(len(times), dtype=torch.int64)
            return self.R[index], self.position[index], self.fov[index]
        left = (torch.searchsorted(self.times, times, right=True) - 1).clamp(0, count - 2)
        span = self.times[left + 1] - self.times[left]
        u = ((times - self.times[left]) / span)[:, None]
        turn = matrix_to_axis_angle(self.R[left].mT @ self.R[left + 1])
        R = self.R[left] @ axis_angle_to_matrix(u * turn)
        fov = self.fov[left].lerp(self.fov[left + 1], u[:, 0])
        return R, self._spline(left, u, span[:, None]), fov

    def _spline(self, left: Tensor, u: Tensor, span: Tensor) -> Tensor:
        """Cubic Hermite segments whose tangents are the slopes between the two neighbours of a keyframe."""
        index = torch.arange(len(self.times))
        before, after = (index - 1).clamp_min(0), (index + 1).clamp(max=len(index) - 1)
        rise, run = self.position[after] - self.position[before], self.times[after] - self.times[before]
        if self.closed:  # first and last keyframe are the same
            rise[[0, -1]] = self.position[1] - self.position[-2]
            run[[0, -1]] = self.times[1] + self.times[-1] - self.times[-2]
        tangent = rise / run[:, None]
        a, b = self.position[left], self.position[left + 1]
        bend_a, bend_b = span * tangent[left] - (b - a), (b - a) - span * tangent[left + 1]
        return a.lerp(b, u) + u * (1 - u) * ((1 - u) * bend_a + u * bend_b)


def _read(path: Path) -> tuple[_Keyframes, Mapping[str, Any]]:
    try:
        tree = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(f"trajectory: cannot read {path}: {error}") from None
    name = "camera_path" if isinstance(tree, dict) and "camera_path" in tree else "keyframes"
    entries = tree.get(name) if isinstance(tree, dict) else None
    if not isinstance(entries, list) or not 1 <= len(entries) <= _MOST_CAMERAS:
        raise UserError(f"{path}: needs 'keyframes', a list of cameras, or nerfstudio's 'camera_path'")
    if tree.get("camera_type", "perspective") != "perspective":
        raise UserError(f"{path}: camera_type {tree['camera_type']!r} is not supported, only perspective")
    cameras = [_keyframe(entry, f"{path}: {name}[{index}]") for index, entry in enumerate(entries)]
    closed = tree.get("closed", False) is True
    waits = [seconds for *_, seconds in cameras[1:]]
    if closed:
        waits.append(cameras[0][-1])
        cameras.append(cameras[0])
    R, position, fov, _ = zip(*cameras, strict=True)
    keys = _Keyframes(
        times=torch.tensor([0.0, *waits], dtype=torch.float64).cumsum(0),
        R=torch.stack(R),
        position=torch.stack(position),
        fov=torch.tensor(fov, dtype=torch.float64),
        fps=_number(tree, "fps", _FPS, 1e-3, 1e3, str(path)),
        closed=closed,
        size=_size_in(tree, path),
    )
    return keys, tree


def _keyframe(entry: Any, where: str) -> tuple[Tensor, Tensor, float, float]:
    """R, position, field of view and seconds since the keyframe before."""
    if not isinstance(entry, dict):
        raise UserError(f"{where} is not an object")
    if "camera_to_world" in entry:
        matrix = _numbers(entry, "camera_to_world", (4, 4), where)
        R = matrix[:3, :3] * matrix.new_tensor([-1.0, 1.0, -1.0])  # OpenGL's right and back are our left and front
        position = matrix[:3, 3]
    elif "R" in entry and "T" in entry:
        R = _numbers(entry, "R", (3, 3), where)
        position = -R @ _numbers(entry, "T", (3,), where)
    else:
        raise UserError(f"{where} needs camera_to_world (4 x 4, OpenGL axes), or R (3 x 3) and T (3)")
    lengthened = float((R.T @ R - torch.eye(3, dtype=R.dtype)).abs().max())
    if lengthened > 1e-2 or float(torch.linalg.det(R)) < 0:
        raise UserError(f"{where}: the pose is no rotation: its axes must be of length 1, orthogonal, right-handed")
    fov = _number(entry, "fov", math.nan, 1e-2, 179.0, where)
    return R, position, fov, _number(entry, "seconds", 1.0, 1e-3, 1e5, where)


def _numbers(entry: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> Tensor:
    try:
        values = torch.tensor(entry[key], dtype=torch.float64).reshape(shape)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        values = torch.tensor(math.nan)
    if not bool(values.isfinite().all()):
        raise UserError(f"{where}.{key} must be {' x '.join(map(str, shape))} finite numbers")
    return values


def _number(entry: Mapping[str, Any], key: str, default: float, lowest: float, highest: float, where: str) -> float:
    value = entry.get(key)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not lowest <= value <= highest:
        raise UserError(f"{where}.{key} must be a number from {lowest:g} to {highest:g}, got {value!r}")
    return float(value)


def _size_in(tree: Mapping[str, Any], path: Path) -> tuple[int, int] | None:
    names = ("render_height", "render_width") if "camera_path" in tree else ("height", "width")
    if tree.get(names[0]) is None or tree.get(names[1]) is None:
        return None
    height, width = (_number(tree, name, 0.0, 1, 8192, str(path)) for name in names)
    return round(height), round(width)


def _looking_at(scene: Scene, positions: Tensor, target: Tensor, up: Tensor, size: Size) -> PosedImages:
    R = look_at_rotation(positions, at=target[None], up=up[None], device=positions.device)
    return _unseen(R, positions, *_lens(scene.train, size, len(positions)))


def _unseen(R: Tensor, positions: Tensor, intrinsics: Tensor, sizes: Tensor) -> PosedImages:
    """Cameras that have taken no images."""
    count = len(R)
    return PosedImages(
        labels=tuple(f"frame {index}" for index in range(count)),
        pixels=torch.zeros(0, 4, dtype=torch.uint8),
        sizes=sizes,
        intrinsics=intrinsics,
        distortion=torch.zeros(count, NUM_DISTORTION),
        fisheye=torch.zeros(count, dtype=torch.bool),
        R=R.float(),
        T=-(positions[:, None] @ R)[:, 0].float(),
        has_alpha=False,
    )


def _lens(views: PosedImages, size: Size, count: int) -> tuple[Tensor, Tensor]:
    """Intrinsics (N, 4) and sizes (N, 2): the first image's field of view over its short side, at another size."""
    first = views.sizes[0].tolist()
    if isinstance(size, int):
        scale = size / min(first)
        size = (max(1, round(first[0] * scale)), max(1, round(first[1] * scale)))
    height, width = size or first
    if not (1 <= height <= 8192 and 1 <= width <= 8192):
        raise UserError(f"size, width and height must be whole pixels from 1 to 8192, got {width} x {height}")
    fx, fy = (views.intrinsics[0, :2] * (min(height, width) / min(first))).tolist()
    intrinsics = torch.tensor([[fx, fy, width / 2, height / 2]])
    return intrinsics.repeat(count, 1), torch.tensor([[height, width]]).repeat(count, 1)


def _focus_distance(scene: Scene, position: Tensor, forward: Tensor) -> Tensor:
    """Where to look at: three quarters of the way from the nearest to the farthest, in inverse distance."""
    if scene.depth_range is None:
        enter, leave = within_box(position[None], forward[None], scene.box.double())
        reach = torch.stack([enter[0], leave[0]])
        reach = reach if float(leave - enter) > 0 else (point_of_interest(scene) - position).norm().expand(2)
    else:
        reach = position.new_tensor(scene.depth_range)
    near = torch.maximum(reach[0], 0.05 * reach[1])
    return 1 / (0.25 / near + 0.75 / reach[1])


def _across(direction: Tensor, up: Tensor) -> Tensor:
    """The part of a direction (3,) that is orthogonal to `up`, at length 1; any such where there is none."""
    rest = direction - (direction @ up) * up
    if float(rest.norm()) < 1e-6 * float(direction.norm()) + 1e-12:
        rest = torch.eye(3, dtype=up.dtype)[int(up.abs().argmin())]
        rest = rest - (rest @ up) * up
    return _unit(rest)


def _unit(vector: Tensor) -> Tensor:
    return vector / vector.norm().clamp_min(1e-12)
