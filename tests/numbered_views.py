"""Images whose pixels say where they are, and cameras around the origin that took them."""

import torch
from torch import Tensor

from rendra.renderer.cameras import look_at_view_transform
from rendra_lab.data.posed_images import PosedImages

SIZES = [(4, 6), (5, 3), (2, 2)]


def numbered(sizes: list[tuple[int, int]], channels: int = 4) -> list[Tensor]:
    """Images whose red is the row, whose green is the column, whose blue is the image."""
    images = []
    for index, (height, width) in enumerate(sizes):
        rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
        shown = [rows, columns, torch.full_like(rows, index), rows + 100][:channels]
        images.append(torch.stack(shown, dim=-1).to(torch.uint8))
    return images


def posed(sizes: list[tuple[int, int]] = SIZES, channels: int = 4, **lens: Tensor) -> PosedImages:
    count = len(sizes)
    R, T = look_at_view_transform(dist=3.0, elev=20.0, azim=torch.arange(count) * 70.0 + 10.0)
    intrinsics = torch.tensor([[7.0, 8.0, 2.5, 1.5]]).repeat(count, 1)
    labels = [f"{index}.png" for index in range(count)]
    return PosedImages.gather(labels, numbered(sizes, channels), intrinsics, R[:count], T[:count], **lens)
