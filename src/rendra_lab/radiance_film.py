"""A fitted scene seen along a way: predictions, and the frames made of them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from rendra_lab.base_task import BaseTask
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import RayBatch, RayCaster, SceneViews
from rendra_lab.errors import UserError
from rendra_lab.networks.radiance import RadiancePrediction, view_normals
from rendra_lab.visualization import Picture, depth_image, depth_limits, normal_image, to_picture

SHOWN = ("rgb", "depth", "normals")


def path_caster(data: SceneViews) -> RayCaster:
    """Makes rays as the data does, over one background for all frames: white, where training draws it at random."""
    background = "white" if data.background == "random" else data.background
    return RayCaster(data.scene.box, data.scene.depth_range, background, data.rays_per_pixel_side)


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


def _limits(depths: Sequence[Tensor], opacities: Sequence[Tensor]) -> tuple[float, float]:
    """Of all frames, by every fourth pixel."""
    every = 4
    some = [torch.cat([image.flatten()[::every] for image in images]) for images in (depths, opacities)]
    return depth_limits(some[0], some[1])
