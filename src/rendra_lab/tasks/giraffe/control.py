"""Programs of controls as files: films, sheets, and for every scene a strip of frames with masks and alpha maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from rendra_lab import visualization
from rendra_lab.errors import UserError
from rendra_lab.settings import Size
from rendra_lab.tasks.giraffe import edits
from rendra_lab.tasks.giraffe.disentanglement import object_mask
from rendra_lab.tasks.giraffe.programs import PROGRAMS, Frames, Order, Stage
from rendra_lab.tasks.giraffe.records import Scenes
from rendra_lab.tasks.giraffe.sample_grids import share_images
from rendra_lab.tasks.giraffe.scene_maker import SceneMaker
from rendra_lab.visualization import Picture

STRIP = 6
"""Frames of a strip."""

_SMALL = 9  # scenes of the small film
_LEAST_PX = 64  # height of a picture on a strip with masks


@dataclass(frozen=True)
class Layers:
    """What stands behind the pictures of a strip: K frames of B scenes, each an image (S, S) or (S, S, 3)."""

    objects: Float[Tensor, "K B S S 3"]  # whose share a pixel is: a colour an object, grey the background
    mask: Float[Tensor, "K B S S"]  # pixels that change when the object of the order is taken away
    alpha: Float[Tensor, "K B S S"]  # of the object alone
    background: Float[Tensor, "K B S S"]  # alpha of the background alone


def programs_named(name: str) -> list[str]:
    """One program by its name, or `all` of them; UserError for another name."""
    if name == "all":
        return list(PROGRAMS)
    if name not in PROGRAMS:
        raise UserError(f"program must be all or one of {', '.join(PROGRAMS)}; got {name}")
    return [name]


@torch.no_grad()
def play(
    maker: SceneMaker,
    program: str,
    order: Order,
    folder: Path,
    endings: Sequence[str] = ("gif",),
    fps: Size = 30.0,
    threshold: Size = 0.1,
) -> list[Path]:
    """Makes the pictures of a program and writes them.

    Into `folder` go PROGRAM.gif, all scenes side by side, PROGRAM_sm.gif, the first nine, PROGRAM.png, six frames of
    each scene in rows; and of each scene 0000_PROGRAM.png, its strip, and 0000_PROGRAM_masks.png, with whose pixels
    are whose, the mask of the object, and the alpha maps of the object and of the background. Films of paths that
    do not close go back the way they came.

    Args:
        maker: the generator.
        program: a name in `PROGRAMS`.
        order: what is to be made.
        folder: of the files.
        endings: of films, gif or mp4.
        fps: frames a second.
        threshold: of a change that shows the object, of a range of 1.

    Returns:
        The films and the sheet; not the strips.

    Raises:
        UserError: scenes have no such object.
    """
    played = PROGRAMS[program](Stage.of(maker, order))
    frames = _rendered(maker, played)
    chosen = played.spread(STRIP)
    strips = [
        visualization.tile([_picture(frames[i, scene]) for i in chosen], STRIP) for scene in range(order.samples)
    ]
    layers = _layers(maker, [played.scenes[i] for i in chosen], order.object, threshold)
    for scene, strip in enumerate(strips):
        visualization.save_picture(folder / f"{scene:04d}_{program}.png", strip)
        drawn = _with_layers(frames[chosen, scene], layers, scene)
        visualization.save_picture(folder / f"{scene:04d}_{program}_masks.png", drawn)
    written = [visualization.save_picture(folder / f"{program}.png", visualization.tile(strips, columns=1))]
    for name, count in ((program, order.samples), (f"{program}_sm", _SMALL)):
        film = [visualization.tile([_picture(rgb) for rgb in frame[:count]]) for frame in frames]
        film += [] if played.closed else film[-2:0:-1]
        films = [folder / f"{name}.{ending}" for ending in endings]
        written += [visualization.save_animation(each, film, fps, hold_s=0) for each in films]
    return written


def _rendered(maker: SceneMaker, played: Frames) -> UInt8[Tensor, "K B 3 S S"]:
    """Pictures on the CPU, a quarter of the memory that they are made in."""
    return torch.stack([maker(scenes).rgb.mul(255).round().to("cpu", torch.uint8) for scenes in played.scenes])


def _layers(maker: SceneMaker, frames: Sequence[Scenes], index: int, threshold: float) -> Layers:
    objects, masks, alphas, backgrounds = [], [], [], []
    for scenes in frames:
        made = maker(scenes)
        side = made.rgb.shape[-1]
        alone = F.interpolate(maker.alpha_maps(scenes), (side, side)).clamp(0, 1)
        objects.append(share_images(made.shares, side))
        masks.append(object_mask(made.rgb, maker(edits.without(scenes, index)).rgb, threshold).float())
        alphas.append(alone[:, index] * scenes.boxes.exists[:, index, None, None])
        backgrounds.append(alone[:, -1])
    return Layers(*(torch.stack(each).cpu() for each in (objects, masks, alphas, backgrounds)))


def _with_layers(rgb: UInt8[Tensor, "K 3 S S"], layers: Layers, scene: int) -> Picture:
    """The strip of a scene above those of its layers."""
    rows = {"pictures": [_picture(each) for each in rgb]}
    for name, title in (
        ("objects", "share of each object"),
        ("mask", "what the object changes"),
        ("alpha", "the object alone"),
        ("background", "the background alone"),
    ):
        rows[title] = [visualization.to_picture(each) for each in getattr(layers, name)[:, scene]]
    height = max(_LEAST_PX, rgb.shape[-1])
    lines = [
        visualization.tile([visualization.resize(picture, height) for picture in pictures], STRIP)
        for pictures in rows.values()
    ]
    named = [visualization.caption(line, title) for title, line in zip(rows, lines, strict=True)]
    return visualization.tile(named, columns=1)


def _picture(rgb: UInt8[Tensor, "3 S S"]) -> Picture:
    return rgb.movedim(0, -1).numpy()
