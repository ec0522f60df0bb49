"""A fitted scene seen along a way: predictions, and the frames made of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

from rendra_lab.base_task import BaseTask
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import RayBatch, RayCaster, SceneViews
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import RadiancePrediction, view_normals
from rendra_lab.trajectories import Size, rate_of, trajectory
from rendra_lab.visualization import (
    Picture,
    can_write_mp4,
    captioned_row,
    depth_image,
    depth_limits,
    normal_image,
    save_animation,
    save_picture,
    to_picture,
)

SHOWN = ("rgb", "depth", "normals")


def path_caster(data: SceneViews) -> RayCaster:
    """Makes rays as the data does, over one background for all frames: white, where training draws it at random."""
    background = "white" if data.background == "random" else data.background
    scene = data.scene
    return RayCaster(scene.box, scene.depth_range, background, data.final_side, scene.warp)


def render_path(
    task: BaseTask[RayBatch, Any], caster: RayCaster, cameras: PosedImages
) -> Iterator[tuple[RayBatch, RadiancePrediction]]:
    """What each camera sees, one after the other: its rays and their prediction, both (1, H, W), no gradients.

    Args:
        task: a fitted scene.
        caster: makes the rays.
        cameras: which may have no pixels.
    """
    for index in range(len(cameras)):
        batch = caster.blank_view(cameras, index).to(task.device)
        yield batch, task.observe(batch)


def film(
    task: BaseTask[RayBatch, Any], caster: RayCaster, cameras: PosedImages, shown: Sequence[str] = SHOWN
) -> dict[str, list[Picture]]:
    """The frames of a way.

    The colours of depth mean the same in all frames.

    Args:
        task, caster, cameras: see `render_path`.
        shown: some of SHOWN.

    Returns:
        A list of pictures, one a camera, for each word of `shown`.

    Raises:
        UserError: another word, or no cameras.
    """
    if not shown or not set(shown) <= set(SHOWN):
        raise UserError(f"what is shown must be among {', '.join(SHOWN)}; got {', '.join(shown) or 'nothing'}")
    if not len(cameras):
        raise UserError("a film needs at least one frame")
    frames: dict[str, list[Picture]] = {name: [] for name in shown}
    depths: list[Tensor] = []
    opacities: list[Tensor] = []
    for batch, prediction in render_path(task, caster, cameras):
        if "rgb" in frames:
            frames["rgb"].append(to_picture(prediction.rgb[0]))
        if "normals" in frames:
            frames["normals"].append(to_picture(normal_image(view_normals(prediction, batch))))
        if "depth" in frames:
            depths.append(prediction.depth[0].cpu())
            opacities.append(prediction.opacity[0].cpu())
    if depths:
        limits = _limits(depths, opacities)
        frames["depth"] = [to_picture(depth_image(*seen, limits)) for seen in zip(depths, opacities, strict=True)]
    return frames


@dataclass(frozen=True)
class Shot:
    """The frames of a way through a scene, and what they took.

    Attributes:
        films: frames by word of SHOWN.
        size: height and width of a frame in pixels.
        seconds: of the rendering.
    """

    films: dict[str, list[Picture]]
    size: tuple[int, int]
    seconds: float

    @property
    def count(self) -> int:
        """Frames of each film."""
        return len(next(iter(self.films.values())))

    @property
    def frames_per_s(self) -> float:
        """How fast they were rendered."""
        return self.count / self.seconds

    def __str__(self) -> str:
        """One line for people."""
        height, width = self.size
        return f"{self.count} frames of {width}x{height} rendered in {self.seconds:.1f} s, {self.frames_per_s:.1f}/s"


def shoot(task: BaseTask[RayBatch, Any], data: SceneViews, cameras: PosedImages, shown: Sequence[str]) -> Shot:
    """Films a fitted scene from cameras, by the clock; see `film`."""
    begun = perf_counter()
    films = film(task, path_caster(data), cameras, shown)
    height, width = cameras.sizes[0].tolist()
    return Shot(films, (height, width), perf_counter() - begun)


@dataclass(frozen=True)
class FilmOrder:
    """What to film, and where to.

    Attributes:
        trajectory, frames, size, elevation_deg: see `rendra_lab.trajectories.trajectory`.
        what: one of SHOWN, or all of them side by side.
        fps: frames a second of a file; None: as the way's own file says, else 20.
        output: a .gif or .mp4 file; a folder that exists for a file that is named after what it shows; any other
            path without an ending for a folder of PNG files.

    Raises:
        UserError: a word or an ending that nothing stands for, or an MP4 without the extra [view].
    """

    output: Path
    trajectory: str = "auto"
    what: str = "rgb"
    frames: int | None = None
    size: Size = None
    elevation_deg: float | None = None
    fps: float | None = None

    def __post_init__(self) -> None:
        if self.what not in (*SHOWN, "all"):
            raise UserError(f"what must be {', '.join(SHOWN)} or all, got {self.what!r}")
        if self.fps is not None and not (isinstance(self.fps, int | float) and self.fps > 0):
            raise UserError(f"fps must be positive, got {self.fps!r}")
        if self.output.suffix not in ("", ".gif", ".mp4") and not self.output.is_dir():
            raise UserError(f"output must end in .gif or .mp4, or be a folder for PNG files; got {self.output}")
        if self.output.suffix == ".mp4" and not can_write_mp4():
            raise UserError("an MP4 needs a video encoder: pip install 'rendra[view]'; or choose output=NAME.gif")

    @property
    def shown(self) -> tuple[str, ...]:
        """Some of SHOWN."""
        return SHOWN if self.what == "all" else (self.what,)

    def file(self) -> Path:
        """Where the film goes: a file, or a folder for PNG files."""
        if not self.output.is_dir():
            return self.output
        return self.output / f"{self.what}.{'mp4' if can_write_mp4() else 'gif'}"


def render_run(task: Any, data: Any, order: FilmOrder) -> tuple[str, Path]:
    """Films what a finished run has fitted.

    Args:
        task: of the run, with its weights.
        data: of the run, set up.
        order: what to film.

    Returns:
        One line about it, and the file or folder.

    Raises:
        UserError: the run fitted no scene of rays, or the order cannot be carried out.
    """
    if not isinstance(data, SceneViews):
        raise UserError(f"run: {type(task).__name__} fits no scene that can be filmed; take a run of nerf or volume")
    cameras = trajectory(order.trajectory, data.scene, order.frames, order.size, order.elevation_deg)
    shot = shoot(task, data, cameras, order.shown)
    rows = [dict(zip(shot.films, row, strict=True)) for row in zip(*shot.films.values(), strict=True)]
    frames = [captioned_row(row) if len(row) > 1 else next(iter(row.values())) for row in rows]
    output = order.file()
    if output.suffix:
        save_animation(output, frames, rate_of(order.trajectory) if order.fps is None else order.fps, hold_s=0)
    else:
        for index, frame in enumerate(frames):
            save_picture(output / f"frame_{index:04d}.png", frame)
    return str(shot), output


def _limits(depths: Sequence[Tensor], opacities: Sequence[Tensor]) -> tuple[float, float]:
    """Of all frames, by every fourth pixel."""
    every = 4
    some = [torch.cat([image.flatten()[::every] for image in images]) for images in (depths, opacities)]
    return depth_limits(some[0], some[1])
