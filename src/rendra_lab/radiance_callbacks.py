"""What a fitted scene leaves behind besides its numbers: films of a way through it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from rendra_lab import report
from rendra_lab.base_task import BaseTask
from rendra_lab.data.ray_views import SceneViews
from rendra_lab.errors import UserError
from rendra_lab.loggers import TensorBoard
from rendra_lab.radiance_film import SHOWN, shoot
from rendra_lab.settings import Count, Size
from rendra_lab.trajectories import WAYS, trajectory
from rendra_lab.visualization import Picture, can_write_mp4, save_animation

_FILES = {"rgb": "turntable", "depth": "depth", "normals": "normals"}


class Turntable(Callback):
    """Shows a fitted scene from a way round it when the test ends.

    Leaves `turntable`, `depth` and `normals`, each as GIF, and as MP4 with the extra [view]; TensorBoard shows the
    GIFs. The seconds that the rendering took and the frames a second are printed and logged.

    Args:
        folder: of the files.
        trajectory: orbit, spiral, auto or the path of a JSON file, see `rendra_lab.trajectories`.
        frames: of the way; 0 writes no films.
        size: pixels of the shorter side; None: as the training images.
        elevation_deg: of an orbit above the horizontal plane; None: as the training cameras stand.
        fps: frames a second of the files.
        shown: which films: some of rgb, depth, normals.

    Raises:
        UserError: a word that nothing stands for.
    """

    def __init__(
        self,
        folder: str,
        trajectory: str = "auto",
        frames: Count = 60,
        size: int | None = None,
        elevation_deg: float | None = None,
        fps: Size = 20.0,
        shown: Sequence[str] = SHOWN,
    ) -> None:
        if trajectory not in WAYS and not trajectory.endswith(".json"):
            raise UserError(f"trajectory must be {', '.join(WAYS)} or a .json file, got {trajectory!r}")
        if not set(shown) <= set(SHOWN):
            raise UserError(f"shown must be some of {', '.join(SHOWN)}, got {', '.join(shown)}")
        self.folder = Path(folder)
        self.trajectory = trajectory
        self.frames = frames
        self.size = size
        self.elevation_deg = elevation_deg
        self.fps = fps
        self.shown = shown

    def on_test_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Renders and writes."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not (trainer.is_global_zero and self.frames and self.shown and isinstance(data, SceneViews)):
            return
        assert isinstance(pl_module, BaseTask)
        cameras = trajectory(self.trajectory, data.scene, self.frames, self.size, self.elevation_deg)
        shot = shoot(pl_module, data, cameras, self.shown)
        self._write(trainer, shot.films)
        files = ", ".join(f"{_FILES[name]}.gif" for name in shot.films)
        video = " and .mp4" if can_write_mp4() else "; no .mp4 without the extra [view]"
        report.say(f"{shot}: {files}{video}")
        for logger in trainer.loggers:
            figures = {"film/seconds": shot.seconds, "film/frames_per_s": shot.frames_per_s}
            logger.log_metrics(figures, trainer.global_step)

    def _write(self, trainer: Trainer, films: Mapping[str, Sequence[Picture]]) -> None:
        for name, frames in films.items():
            path = save_animation(self.folder / f"{_FILES[name]}.gif", frames, self.fps, hold_s=0)
            if can_write_mp4():
                save_animation(path.with_suffix(".mp4"), frames, self.fps, hold_s=0)
            for logger in trainer.loggers:
                if isinstance(logger, TensorBoard):
                    logger.log_gif(f"film/{_FILES[name]}", path, trainer.global_step)
