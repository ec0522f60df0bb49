"""Backgrounds that nobody photographed: skies, rooms, noise and blobs, at random. Colours are sRGB in [0, 1]."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F


def draw_background(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """A picture (H, W, 3) of one of the kinds below, with noise; the generator makes all choices."""
    kinds = (_outdoors, _room, _noise, _room)
    picture = kinds[int(torch.randint(len(kinds), (1,), generator=generator))](size, generator)
    if float(torch.rand(1, generator=generator)) < 0.6:
        picture = _with_blobs(picture, generator)
    return (picture + 0.02 * torch.randn(picture.shape, generator=generator)).clamp(0, 1)


def smooth_noise(size: tuple[int, int], cells: int, channels: int, generator: torch.Generator) -> Tensor:
    """Random values (H, W, channels) about 0, of standard deviation near 1, smooth between so many cells a side."""
    coarse = torch.randn(1, channels, cells + 1, cells + 1, generator=generator)
    return F.interpolate(coarse, size, mode="bicubic", align_corners=True)[0].movedim(0, -1)


def _color(generator: torch.Generator, darkest: float = 0.1, brightest: float = 0.95) -> Tensor:
    """A colour (3,), rather grey than gaudy."""
    grey = darkest + (brightest - darkest) * torch.rand(1, generator=generator)
    return (grey + 0.07 * torch.randn(3, generator=generator)).clamp(darkest, brightest)


def _rows_columns(size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Places (H, 1) and (1, W) of pixels, 0 to 1 from the upper left."""
    return torch.linspace(0, 1, size[0])[:, None], torch.linspace(0, 1, size[1])[None]


def _octaves(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """Noise (H, W, 3) that halves in strength as its cells halve in size, less of it in colour."""
    picture = torch.zeros(*size, 3)
    for cells in (4, 8, 16, 32):
        noise = smooth_noise(size, cells, 4, generator) / cells
        picture += noise[..., :1] + 0.3 * noise[..., 1:]
    return picture


def _outdoors(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """A sky that pales towards a hilly horizon, over rough ground."""
    rows, _ = _rows_columns(size)
    horizon = 0.35 + 0.35 * torch.rand(1, generator=generator) + 0.04 * smooth_noise(size, 5, 1, generator)[:1, :, 0]
    sky, ground = _color(generator, 0.5) + torch.tensor([-0.1, 0.0, 0.15]), _color(generator, 0.2, 0.6)
    above = torch.lerp(sky, torch.ones(3), rows[..., None].expand(*size, 1))
    below = ground + 0.3 * _octaves(size, generator)
    return torch.where((rows < horizon)[..., None], above, below)


def _room(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """A wall, striped or plain, over a floor of tiles in perspective."""
    rows, columns = _rows_columns(size)
    edge = 0.5 + 0.35 * torch.rand(1, generator=generator)
    stripes = (columns * (4 + 12 * torch.rand(1, generator=generator))).floor() % 2
    contrast = 0.12 * torch.rand(1, generator=generator)
    wall = _color(generator) + (contrast * stripes)[..., None] - 0.15 * rows[..., None]
    depth = 0.3 / (rows - edge).clamp_min(1e-3)
    across = (columns - torch.rand(1, generator=generator)) * depth
    tiles = ((4 * depth).floor() + (4 * across).floor()) % 2
    fade = (1 / (1 + 0.15 * depth)) * 0.25 * torch.rand(1, generator=generator)  # no moire far away
    floor = _color(generator) + ((tiles - 0.5) * fade)[..., None]
    return torch.where((rows < edge)[..., None], wall, floor)


def _noise(size: tuple[int, int], generator: torch.Generator) -> Tensor:
    """Something out of focus and rough."""
    return _color(generator) + 0.9 * torch.rand(1, generator=generator) * _octaves(size, generator)


def _with_blobs(picture: Tensor, generator: torch.Generator) -> Tensor:
    """A few coloured ellipses and boxes in front of it."""
    rows, columns = _rows_columns((picture.shape[0], picture.shape[1]))
    for _ in range(int(torch.randint(2, 9, (1,), generator=generator))):
        y, x, tall, wide, boxy = torch.rand(5, generator=generator).tolist()
        power = 2.0 if boxy < 0.6 else 12.0
        far = ((rows - y) / (0.04 + 0.2 * tall)).abs() ** power + (
            (columns - x) / (0.04 + 0.15 * wide)
        ).abs() ** power
        picture = torch.lerp(picture, _color(generator), (far < 1).float()[..., None] * 0.9)
    return picture
