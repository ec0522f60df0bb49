"""The smallest tasks that use everything: a colour fitted to an image, and a ball fitted to its views."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from omegaconf import OmegaConf
from torch import Tensor, nn

from rendra.renderer.cameras import look_at_rotation
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures.meshes import Meshes
from rendra_lab.base_task import Task
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import RayBatch, RayCaster, Scene, SceneViews
from rendra_lab.data.repeated import Repeated
from rendra_lab.losses import SquaredError
from rendra_lab.networks.radiance import RadiancePrediction, view_panels
from rendra_lab.records import TensorRecord
from rendra_lab.terms import LossTerm


@dataclass(frozen=True)
class ToyBatch(TensorRecord):
    rgb: Float[Tensor, "B H W 3"]
    silhouette: Float[Tensor, "B H W"]


@dataclass(frozen=True)
class ToyPrediction(TensorRecord):
    rgb: Float[Tensor, "B H W 3"]
    silhouette: Float[Tensor, "B H W"]


class ToyTask(Task[ToyBatch, ToyPrediction]):
    """One colour and one coverage for the whole image."""

    def __init__(self, start: float = 0.1, fail_at: int | None = None, **parts: Any) -> None:
        super().__init__(**parts)
        self.color = nn.Parameter(torch.full((3,), start))
        self.coverage = nn.Parameter(torch.tensor(start))
        self.fail_at = fail_at

    def predict(self, batch: ToyBatch) -> ToyPrediction:
        if self.fail_at is not None and self.training and self.global_step == self.fail_at:
            raise RuntimeError("the toy broke as told")
        return ToyPrediction(
            self.color * torch.ones_like(batch.rgb), self.coverage * torch.ones_like(batch.silhouette)
        )

    def panels(self, prediction: ToyPrediction, batch: ToyBatch) -> dict[str, Tensor]:
        return {"target": batch.rgb[0], "prediction": prediction.rgb[0]}

    def meshes(self, prediction: ToyPrediction, batch: ToyBatch) -> dict[str, Meshes]:
        verts = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        colors = TexturesVertex([self.color.clamp(0, 1).expand(3, 3)])
        return {"triangle": Meshes([verts], [torch.tensor([[0, 1, 2]])], textures=colors)}


class ToyData(LightningDataModule):
    """One image, repeated."""

    is_divisible = True  # all processes see the same

    def __init__(self, steps: int = 1000, size_px: int = 16) -> None:
        super().__init__()
        self.steps = steps
        self.size_px = size_px

    def setup(self, stage: str) -> None:
        rgb = torch.tensor([0.8, 0.4, 0.2]).expand(1, self.size_px, self.size_px, 3)
        self.batch = ToyBatch(rgb.contiguous(), torch.full((1, self.size_px, self.size_px), 0.9))

    def train_dataloader(self) -> Repeated[ToyBatch]:
        return Repeated(self.batch, self.steps)

    def val_dataloader(self) -> Repeated[ToyBatch]:
        return Repeated(self.batch)

    def test_dataloader(self) -> Repeated[ToyBatch]:
        return Repeated(self.batch)


class SphereTask(Task[RayBatch, RadiancePrediction]):
    """A hard ball at the origin, coloured by its normals; its radius is learned."""

    def __init__(self, radius: float = 0.6, **parts: Any) -> None:
        super().__init__(**parts)
        self.radius = nn.Parameter(torch.tensor(radius))

    def predict(self, batch: RayBatch) -> RadiancePrediction:
        along = -(batch.origins * batch.directions).sum(-1)
        inside = self.radius**2 - (batch.origins.square().sum(-1) - along**2)
        edge = torch.sigmoid(inside / 0.01)
        depth = along - inside.clamp_min(1e-9).sqrt()
        color = 0.5 + 0.5 * (batch.origins + depth[..., None] * batch.directions) / self.radius
        opacity = edge.mean(-1)
        rgb = (edge[..., None] * color).mean(-2) + (1 - opacity)[..., None] * batch.background
        return RadiancePrediction(rgb, opacity, (edge * depth).sum(-1) / edge.sum(-1).clamp_min(1e-6))

    def panels(self, prediction: RadiancePrediction, batch: RayBatch) -> dict[str, Tensor]:
        return view_panels(prediction, batch)


class SphereViews(SceneViews):
    """Views of that ball from all around, +y up."""

    def load(self) -> Scene:
        angle = torch.arange(9) * (2 * torch.pi / 9)
        positions = torch.stack([angle.cos() * 2, torch.ones(9), angle.sin() * 2], dim=1)
        R = look_at_rotation(positions)
        T = -(positions[:, None] @ R)[:, 0]
        lens = torch.tensor([[40.0, 40.0, 16.0, 12.0]]).repeat(9, 1)
        blank = PosedImages.gather([""] * 9, [torch.zeros(24, 32, 3, dtype=torch.uint8)] * 9, lens, R, T)
        box = torch.tensor([[-1.0] * 3, [1.0] * 3])
        ball = SphereTask(losses={"rgb": LossTerm(SquaredError())}, optimizer=torch.optim.SGD)
        caster = RayCaster(box, None)
        images = [(ball.observe(caster.blank_view(blank, i)).rgb[0] * 255).round().byte() for i in range(9)]
        views = PosedImages.gather([f"view_{i}.png" for i in range(9)], images, lens, R, T)
        return Scene(views.select(range(6)), views.select([6]), views.select([7, 8]), box)


def save_config(cfg: Any) -> None:
    """What Hydra does before a run."""
    path = Path(cfg.run_dir) / ".hydra" / "config.yaml"
    path.parent.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(cfg, path)
