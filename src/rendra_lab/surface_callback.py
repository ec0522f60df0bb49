"""The mesh that a fitted scene leaves behind."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lightning.pytorch import Callback, LightningModule, Trainer

from rendra_lab import report
from rendra_lab.callbacks import add_mesh, writers
from rendra_lab.data.ray_views import SceneViews
from rendra_lab.mesh_export import SurfaceSettings, export_surface
from rendra_lab.metrics import surface_chamfer_l1
from rendra_lab.networks.radiance import RadianceScene
from rendra_lab.random_state import untouched
from rendra_lab.settings import Positive


class SurfaceExporter(Callback):
    """Extracts the mesh of a fitted scene when its test ends, with the weights that were tested.

    Leaves the mesh in each format and a picture of it from three sides; where the data knows the true mesh it logs
    `test/mesh_chamfer_l1` (`rendra_lab.metrics.surface_chamfer_l1`). TensorBoard shows both. A field without a
    surface is said to have none, and nothing is written.

    Args:
        folder: of the files.
        resolution, level, color, keep, smoothing, num_faces, texture_size, formats: of `SurfaceSettings`.

    Raises:
        UserError: a colour or a format that there is not.
    """

    def __init__(
        self,
        folder: str,
        resolution: Positive = 128,
        level: float | None = None,
        color: str | None = "vertex",
        keep: float = 0.01,
        smoothing: int = 5,
        num_faces: int | None = None,
        texture_size: Positive = 1024,
        formats: Sequence[str] = ("obj", "ply", "glb"),
    ) -> None:
        self.folder = Path(folder)
        self.settings = SurfaceSettings(
            resolution, level, color, keep, smoothing, num_faces, texture_size, tuple(formats)
        )

    def on_test_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Extracts, writes, measures and shows."""
        data = trainer.datamodule  # type: ignore[attr-defined]
        if not (trainer.is_global_zero and isinstance(data, SceneViews) and isinstance(pl_module, RadianceScene)):
            return
        with untouched():
            written = export_surface(pl_module, self.settings, self.folder / "mesh", data.scene.up)
        report.say(str(written))
        if not written.files:
            return
        if data.scene.truth is not None:
            distance = surface_chamfer_l1(written.mesh, data.scene.truth.to(written.mesh.device))
            pl_module.log("test/mesh_chamfer_l1", distance, rank_zero_only=True)
        for writer in writers(trainer):
            add_mesh(writer, "surface", written.mesh, trainer.global_step)
