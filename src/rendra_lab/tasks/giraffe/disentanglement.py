"""Disentanglement in numbers: whether what is done to one object of a scene changes what it names, and nothing else.

All is measured in pictures alone, those of a generator; no truth is needed. An object's mask is where its picture
changes when the object is taken away, by more than a threshold in some colour. Background is what lies outside the
masks before and after, which are widened by a few pixels. Changes are means over pixels and colours, of a range of 1.

Letters: B scenes, K pictures of each under one control, the first one as it was; S x S pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from rendra_lab.settings import Count, Positive, Range, Size
from rendra_lab.tasks.giraffe import edits
from rendra_lab.tasks.giraffe.programs import must_have
from rendra_lab.tasks.giraffe.records import Scenes
from rendra_lab.tasks.giraffe.scene_maker import Reach, SceneMaker

Row = dict[str, float | None]  # of one scene; None where nothing could be measured

_SEEN = (0.005, 0.75)  # shares of the picture between which a mask can be an object's
_WIDENED = 0.05  # of the side, by which masks are widened
_QUARTER = 0.5  # of the frame, which spans 2
_RESIZED = 0.2  # by which objects become smaller and larger


@dataclass(frozen=True)
class Probe:
    """How much is measured, and how.

    Attributes:
        scenes: that are looked at.
        turns: headings, of a full turn.
        moves: places, of a way over a quarter of the frame.
        scales: sizes, from least to most.
        others: other codes, of each kind.
        object: which one is controlled.
        seed: of the scenes.
        temperature: of their codes.
        threshold: of a change that shows the object, of a range of 1.
        at_once: scenes of a batch.
        kept: scenes of the first batch whose pictures are kept.
    """

    scenes: Positive = 64
    turns: Annotated[int, Range(2)] = 12
    moves: Annotated[int, Range(2)] = 7
    scales: Annotated[int, Range(3)] = 5
    others: Positive = 3
    object: Count = 0
    seed: Count = 0
    temperature: Size = 0.65
    threshold: Size = 0.1
    at_once: Positive = 16
    kept: Count = 4


@dataclass(frozen=True)
class Views:
    """Pictures of B scenes under K settings of a control."""

    rgb: Float[Tensor, "K B 3 S S"]
    masks: Bool[Tensor, "K B S S"]  # where the object is

    def of(self, scenes: int) -> Views:
        """Of the first scenes alone, in memory of their own."""
        return Views(self.rgb[:, :scenes].clone(), self.masks[:, :scenes].clone())


@dataclass(frozen=True)
class Findings:
    """What was measured, and seen meanwhile."""

    rows: list[Row]
    views: dict[
        str, Views
    ]  # by control: turn, move, scale, appearance, shape, background; of the scenes that are kept


def measure(maker: SceneMaker, probe: Probe) -> Findings:
    """The numbers of every scene: see `numbers`; draws from its own seed alone.

    Raises:
        UserError: scenes have no such object.
    """
    source = torch.Generator().manual_seed(probe.seed)
    rows: list[Row] = []
    shown: dict[str, Views] = {}
    while len(rows) < probe.scenes:
        count = min(probe.at_once, probe.scenes - len(rows))
        scenes, *others = (maker.sample(count, source, probe.temperature) for _ in range(1 + probe.others))
        must_have(scenes, probe.object)
        views, commands = _controlled(maker, edits.present(scenes, probe.object), others, probe)
        rows += numbers(views, commands)
        shown = shown or {name: view.of(probe.kept) for name, view in views.items()}
    return Findings(rows, shown)


def numbers(views: dict[str, Views], commands: dict[str, Tensor]) -> list[Row]:
    """A row a scene.

    Args:
        views: by control.
        commands: what was asked for: `move`, where the object's middle should be seen, (K,), and `scale`, the area
            that its mask should have beside that of the first picture, (K,).

    Returns:
        `mask_share`: of the picture, and `seen`, whether that can be an object: 0 or 1. CONTROL_object_change and
        CONTROL_background_change for every control; move_correlation and move_slope of the mask's centroid with the
        command, scale_correlation and scale_slope of its area; appearance_mask_iou and shape_mask_iou with the mask
        before. A row of an object that is not seen has None in all of them.
    """
    first = views["turn"].masks[0].flatten(1).float().mean(1)
    seen = (first >= _SEEN[0]) & (first <= _SEEN[1])
    columns: dict[str, Tensor] = {}
    for name, view in views.items():
        columns |= {f"{name}_{where}_change": each for where, each in changes(view).items()}
    placed, sized = centroids(views["move"].masks), areas(views["scale"].masks)
    columns["move_correlation"], columns["move_slope"] = follows(commands["move"], placed)
    columns["scale_correlation"], columns["scale_slope"] = follows(commands["scale"], sized / sized[:1].clamp_min(1))
    for name in ("appearance", "shape"):
        columns[f"{name}_mask_iou"] = overlap(views[name].masks)
    rows: list[Row] = []
    for scene, (share, is_seen) in enumerate(zip(first.tolist(), seen.tolist(), strict=True)):
        found = {name: _plain(float(each[scene])) if is_seen else None for name, each in columns.items()}
        rows.append({"seen": float(is_seen), "mask_share": share, **found})
    return rows


def means_of(rows: list[Row]) -> dict[str, float]:
    """The mean of every number over the scenes that have it; numbers that no scene has are left out."""
    known = {name: [value for row in rows if (value := row[name]) is not None] for name in (rows[0] if rows else {})}
    return {name: sum(values) / len(values) for name, values in known.items() if values}


def object_mask(
    with_it: Float[Tensor, "... 3 S S"], without_it: Float[Tensor, "... 3 S S"], threshold: float
) -> Bool[Tensor, "... S S"]:
    """Pixels that change by more than a threshold in some colour when an object is taken away."""
    return (with_it - without_it).abs().amax(-3) > threshold


def changes(views: Views) -> dict[str, Float[Tensor, " B"]]:
    """How far K - 1 pictures are from the first: `object`, within its masks, and `background`, outside.

    NaN where there are no such pixels.
    """
    size = views.masks.shape[-1]
    moved = (views.rgb[1:] - views.rgb[:1]).abs().mean(2)  # (K-1, B, S, S)
    covered = views.masks[1:] | views.masks[:1]
    outside = ~widened(covered, max(1, round(_WIDENED * size)))
    return {"object": _mean_where(moved, covered), "background": _mean_where(moved, outside)}


def widened(masks: Bool[Tensor, "*L S S"], pixels: int) -> Bool[Tensor, "*L S S"]:
    """Masks and all that lies within so many pixels of them, along either axis."""
    flat = masks.reshape(-1, 1, *masks.shape[-2:]).float()
    return (F.max_pool2d(flat, 2 * pixels + 1, stride=1, padding=pixels) > 0).reshape(masks.shape)


def areas(masks: Bool[Tensor, "K B S S"]) -> Float[Tensor, "K B"]:
    """Pixels."""
    return masks.flatten(2).sum(-1).float()


def centroids(masks: Bool[Tensor, "K B S S"]) -> Float[Tensor, "K B"]:
    """How far right the middle of a mask lies, from -1 to 1 over the picture; NaN of an empty mask."""
    size = masks.shape[-1]
    across = (2 * torch.arange(size, device=masks.device) + 1) / size - 1
    return (masks.float() @ across).sum(-1) / areas(masks)


def overlap(masks: Bool[Tensor, "K B S S"]) -> Float[Tensor, " B"]:
    """Intersection over union with the first, mean over the others; 0 where both are empty."""
    both, either = (areas(each) for each in (masks[1:] & masks[:1], masks[1:] | masks[:1]))
    return (both / either.clamp_min(1)).mean(0)


def follows(
    command: Float[Tensor, " K"], answer: Float[Tensor, "K B"]
) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """Pearson's correlation of answers with a command, and their slope over it.

    Both are 0 of answers that are constant, or that are NaN somewhere: what vanishes does not follow.
    """
    asked = (command - command.mean()).double()[:, None]
    known = answer.isfinite().all(0)
    got = torch.where(known, answer, 0.0).double()
    got = got - got.mean(0)
    product, own = (asked * got).sum(0), asked.square().sum()
    spread = (own * got.square().sum(0)).sqrt()
    return torch.where(spread > 1e-12, product / spread.clamp_min(1e-12), 0.0), product / own.clamp_min(1e-12)


def _look(maker: SceneMaker, frames: list[Scenes], empty: Tensor, threshold: float) -> Views:
    """Pictures of frames, and masks: beside pictures without the object, (B, 3, S, S) or one for each frame."""
    pictures = torch.stack([maker(frame).rgb for frame in frames])
    return Views(pictures, object_mask(pictures, empty, threshold))


def _controlled(
    maker: SceneMaker, scenes: Scenes, others: list[Scenes], probe: Probe
) -> tuple[dict[str, Views], dict[str, Tensor]]:
    """Pictures of some scenes under every control, and what was commanded: see `numbers`."""
    index, reach = probe.object, Reach.of(maker)
    empty = maker(edits.without(scenes, index)).rgb
    codes = [other.codes for other in others]
    angles = [math.tau * step / probe.turns for step in range(1, probe.turns)]
    looks = [edits.with_codes(scenes, index, appearance=code.appearance[:, index]) for code in codes]
    shapes = [edits.with_codes(scenes, index, shape=code.shape[:, index]) for code in codes]
    behind = [scenes, *(edits.with_background(scenes, appearance=code.background_appearance) for code in codes)]
    emptied = torch.stack([maker(edits.without(frame, index)).rgb for frame in behind])
    places = torch.linspace(-_QUARTER / 2, _QUARTER / 2, probe.moves)
    sizes = torch.linspace(1 - _RESIZED, 1 + _RESIZED, probe.scales)
    frames = {
        "turn": [scenes, *(edits.turned(scenes, index, angle) for angle in angles)],
        "move": [_seen_at(scenes, index, place, reach) for place in places.tolist()],
        "scale": [_sized(scenes, index, size) for size in sizes.tolist()],
        "appearance": [scenes, *looks],
        "shape": [scenes, *shapes],
    }
    views = {name: _look(maker, each, empty, probe.threshold) for name, each in frames.items()}
    views["background"] = _look(maker, behind, emptied, probe.threshold)
    device = scenes.boxes.scale.device
    return views, {"move": places.to(device), "scale": (sizes / sizes[0]).square().to(device)}


def _seen_at(scenes: Scenes, index: int, place: float, reach: Reach) -> Scenes:
    """With the object's middle seen so far to the right of the picture's, as deep in it as it was."""
    pose = scenes.cameras.camera_to_world
    right, eye = edits.rightwards(scenes), pose[:, :3, 3]
    depth = ((eye - scenes.boxes.translation[:, index]) * pose[:, :3, 2]).sum(-1)
    half = reach.half_frame * depth * pose[:, :3, 0].norm(dim=-1)
    return edits.placed_along(scenes, index, right, (eye * right).sum(-1) + place * half)


def _sized(scenes: Scenes, index: int, factor: float) -> Scenes:
    return edits.with_pose(scenes, index, scale=factor * scenes.boxes.scale[:, index])


def _mean_where(values: Float[Tensor, "K B S S"], where: Bool[Tensor, "K B S S"]) -> Float[Tensor, " B"]:
    """Over all pictures that have such pixels; NaN where none has."""
    count = areas(where)
    means = torch.where(where, values, 0.0).flatten(2).sum(-1) / count
    return means.nanmean(0)


def _plain(value: float) -> float | None:
    return value if math.isfinite(value) else None
