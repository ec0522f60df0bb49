"""A generator of scenes that is what it should be: an object is a disc where its box is seen, and nothing else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.tasks.giraffe.box_sampler import BoxSampler
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler
from rendra_lab.tasks.giraffe.records import Codes, MadePictures, Scenes

SIDE, CODE = 64, 4


class Discs:
    """Discs have the colours of codes, are flatter the greater the first number of the shape, and darker behind.

    Args:
        faults: what it does wrong: `glow` (the background brightens as the first object turns), `stuck` (objects are
            seen in the middle, wherever they are), `blind` (objects are not seen).
        objects: N.
        turns, reach: of the boxes, whose middles lie within -reach and reach.
        device: of the scenes.
    """

    def __init__(
        self,
        *faults: str,
        objects: int = 1,
        turns: Sequence[float] = (0.0, 1.0),
        reach: float = 0.2,
        device: Any = "cpu",
    ) -> None:
        self.faults = faults
        self.device = device
        self.boxes = BoxSampler(
            objects=objects,
            scale=((0.15, 0.15, 0.15), (0.2, 0.2, 0.2)),
            translation=((-reach, -reach, 0.0), (reach, reach, 0.0)),
            turns=(turns[0], turns[1]),
        )
        self.cameras = CameraSampler(fov_deg=20.0, polar=(0.33, 0.45))

    def sample(self, count: int, generator: torch.Generator, temperature: float = 1.0) -> Scenes:
        objects = self.boxes.objects
        shapes = (count, objects, CODE), (count, objects, CODE), (count, CODE), (count, CODE)
        codes = Codes(*(temperature * torch.randn(shape, generator=generator) for shape in shapes))
        boxes, cameras = self.boxes.sample(count, generator), self.cameras.sample(count, generator)
        return Scenes(codes, boxes, cameras).to(self.device)

    def __call__(self, scenes: Scenes) -> MadePictures:
        cover = self._cover(scenes)
        angle = torch.atan2(scenes.boxes.rotation[:, :, 1, 0], scenes.boxes.rotation[:, :, 0, 0])
        colors = 0.2 + 0.3 * torch.sigmoid(4 * scenes.codes.appearance[..., :3])
        colors = colors * (0.75 + 0.25 * angle.cos())[..., None]
        behind = 0.6 + 0.4 * torch.sigmoid(4 * scenes.codes.background_appearance[:, :3])
        if "glow" in self.faults:
            behind = behind * (0.8 + 0.2 * angle[:, :1].cos())
        rgb = behind[:, :, None, None].expand(-1, 3, SIDE, SIDE)
        left = torch.ones_like(rgb[:, :1])
        for number in range(cover.shape[1]):
            own = cover[:, number, None]
            rgb = own * colors[:, number, :, None, None] + (1 - own) * rgb
            left = left * (1 - own)
        return MadePictures(rgb, F.avg_pool2d(torch.cat([cover, left], 1), 4))

    def alpha_maps(self, scenes: Scenes) -> Tensor:
        cover = self._cover(scenes)
        return F.avg_pool2d(torch.cat([cover, torch.ones_like(cover[:, :1])], 1), 4)

    def _cover(self, scenes: Scenes) -> Tensor:
        """(B, N, S, S), 1 where a disc is."""
        pose, boxes = scenes.cameras.camera_to_world, scenes.boxes
        seen = (boxes.translation - pose[:, None, :3, 3]) @ pose[:, :3, :3]
        half = -seen[..., 2:] * math.tan(math.radians(10.0))
        middle = seen[..., :2] / half * half.new_tensor([1.0, -1.0])
        if "stuck" in self.faults:
            middle = torch.zeros_like(middle)
        flat = 1 + 0.3 * torch.tanh(scenes.codes.shape[..., 0])
        radius = boxes.scale[..., 0] / half[..., 0]
        ticks = (2 * torch.arange(SIDE, device=half.device) + 1) / SIDE - 1
        across = (ticks - middle[..., 0, None])[..., None, :] / radius[..., None, None]
        down = (ticks - middle[..., 1, None])[..., None] / (radius / flat)[..., None, None]
        exists = boxes.exists & ("blind" not in self.faults)
        return ((across.square() + down.square() < 1) & exists[..., None, None]).float()
