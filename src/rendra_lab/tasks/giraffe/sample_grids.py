"""The same few scenes in the course of a training: what becomes of them, whose pixels are whose, and some turned.

Shapes and letters: as of `records`.
"""

from __future__ import annotations

import colorsys
import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.random_state import stream
from rendra_lab.settings import Amount, Count, Positive
from rendra_lab.tasks.giraffe.edits import turned
from rendra_lab.tasks.giraffe.generator import Generator
from rendra_lab.tasks.giraffe.records import Scenes

_BACKGROUND = (0.25, 0.25, 0.25)


class SampleGrid:
    """Draws scenes that stay the same from the first step to the last.

    Args:
        samples: scenes that are drawn.
        turned: of these, how many are drawn with their first object turned.
        headings: of each, evenly over the full turn, the drawn one first.
        temperature: standard deviation of the latent codes: below 1, more usual things are drawn. Published: 0.65.
        seed: of the scenes.
    """

    def __init__(
        self,
        samples: Positive = 16,
        turned: Count = 4,
        headings: Positive = 6,
        temperature: Amount = 0.65,
        seed: Count = 0,
    ) -> None:
        self.samples = samples
        self.turned = min(turned, samples)
        self.headings = headings
        self.temperature = temperature
        self.seed = seed

    @torch.no_grad()
    def drawn(self, generator: Generator) -> dict[str, Tensor]:
        """What a generator makes of the scenes, as images, sRGB in [0, 1].

        Returns:
            `samples` (B, S, S, 3); `objects` (B, S, S, 3), the share of each object in the pixels, in a colour of its
            own, and that of the background in dark grey; and `turned` (turned * S, headings * S, 3), a row a scene,
            where there are objects.
        """
        scenes = generator.sample(self.samples, stream(self.seed), self.temperature)
        made = generator(scenes)
        images = {"samples": made.rgb.movedim(1, -1), "objects": share_images(made.shares, made.rgb.shape[-1])}
        if self.turned and generator.objects:
            images["turned"] = self._turned(generator, scenes)
        return images

    def _turned(self, generator: Generator, scenes: Scenes) -> Tensor:
        """One image of scenes below each other, their headings side by side."""
        few = scenes.rows(slice(self.turned))
        angles = [2 * math.pi * number / self.headings for number in range(self.headings)]
        views = [generator(turned(few, 0, angle)).rgb for angle in angles]
        return torch.cat(views, dim=-1).movedim(1, -1).flatten(0, 1)


def share_images(shares: Float[Tensor, "B T V V"], side: int) -> Float[Tensor, "B S S 3"]:
    """Shares in colours: each object has one of its own, the background is dark grey, what nobody has is black.

    Args:
        shares: of T things: objects, and last the background.
        side: S, pixels.
    """
    objects = shares.shape[1] - 1
    hues = [colorsys.hsv_to_rgb(number / max(objects, 1), 0.75, 1.0) for number in range(objects)]
    colors = shares.new_tensor([*hues, _BACKGROUND])
    images = torch.einsum("bnhw,nc->bchw", shares, colors)
    return F.interpolate(images, (side, side)).movedim(1, -1).clamp(0, 1)
