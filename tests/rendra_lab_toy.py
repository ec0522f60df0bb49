"""The smallest task that uses everything: a colour fitted to an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from lightning.pytorch import LightningDataModule
from torch import Tensor, nn

from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures.meshes import Meshes
from rendra_lab.base_task import Task
from rendra_lab.data.repeated import Repeated
from rendra_lab.records import TensorRecord


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
