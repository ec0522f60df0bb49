"""What can be done to a scene made of objects, each as a sequence of scenes: the programs of `scripts/control.py`.

The controls of the paper's figures, and their names in the book. B scenes go through a program side by side. A path
goes as far as training did; where that never varied what is asked for, as far as is said at the program.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import torch
from torch import Tensor

from rendra_lab.errors import UserError
from rendra_lab.settings import Count, Positive, Range, Size
from rendra_lab.tasks.giraffe import edits
from rendra_lab.tasks.giraffe.records import Boxes, Codes, Scenes
from rendra_lab.tasks.giraffe.scene_maker import Reach, SceneMaker

_TILT_DEG = 10.0  # of a camera that training never tilted
_CANDIDATES = 32  # places among which an added object takes the one with most room
_SPREAD = 0.7  # of the half frame, where objects are added


@dataclass(frozen=True)
class Order:
    """What is to be made.

    Attributes:
        samples: scenes.
        steps: frames of a path; twice as many of a full turn or a circle; of an interpolation, between two anchors.
        seed: of the scenes, and of what programs draw.
        temperature: latent codes are multiplied by this: the less, the more usual the pictures.
        object: which object moves or changes.
        anchors: codes that an interpolation passes through; it ends where it began.
        add_up_to: objects in the end, where they are added.
    """

    samples: Positive = 15
    steps: Annotated[int, Range(2)] = 32
    seed: Count = 0
    temperature: Size = 0.65
    object: Count = 0
    anchors: Annotated[int, Range(2)] = 6
    add_up_to: Positive = 5


@dataclass(frozen=True)
class Frames:
    """What becomes of scenes under a program.

    Attributes:
        scenes: one after another, each a batch of B.
        closed: the last one comes before the first again, so that a film may go round.
    """

    scenes: list[Scenes]
    closed: bool

    def spread(self, count: int) -> list[int]:
        """The numbers of some frames, evenly spread; the last frame is among them where the path is open."""
        total = len(self.scenes)
        if self.closed:
            return [step * total // count for step in range(count)]
        return [round(step * (total - 1) / max(1, count - 1)) for step in range(count)]


@dataclass(frozen=True)
class Stage:
    """What a program begins with.

    Attributes:
        scenes: in which the object of the order exists.
        reach: of the world that the generator learned.
        order: what is to be made.
        draw: so many other scenes, for their codes and boxes.
    """

    scenes: Scenes
    reach: Reach
    order: Order
    draw: Callable[[int], Scenes]

    @classmethod
    def of(cls, maker: SceneMaker, order: Order) -> Stage:
        """The scenes that a seed stands for, the same ones for every program.

        Raises:
            UserError: scenes have no such object.
        """
        source = torch.Generator().manual_seed(order.seed)

        def draw(count: int) -> Scenes:
            return maker.sample(count, source, order.temperature)

        scenes = draw(order.samples)
        must_have(scenes, order.object)
        return cls(edits.present(scenes, order.object), Reach.of(maker), order, draw)


def must_have(scenes: Scenes, index: int) -> None:
    """UserError where scenes have no object of that number."""
    most = scenes.boxes.exists.shape[1]
    if index >= most:
        raise UserError(f"object must be below {most}, the number of objects of a scene, got {index}")


def rotation_object(stage: Stage) -> Frames:
    """The object turns once round, or through the angles that training turned objects to."""
    index, steps = stage.order.object, stage.order.steps
    if stage.reach.is_full_turn:
        angles = [math.tau * step / (2 * steps) for step in range(2 * steps)]
        return Frames([edits.turned(stage.scenes, index, angle) for angle in angles], closed=True)
    least, most = (math.tau * turn for turn in stage.reach.turns)
    return Frames([edits.heading(stage.scenes, index, angle) for angle in _evenly(least, most, steps)], closed=False)


def translation_object_depth(stage: Stage) -> Frames:
    """The object comes along the ground towards the camera."""
    return _translation(stage, edits.backwards(stage.scenes))


def translation_object_horizontal(stage: Stage) -> Frames:
    """The object goes from left to right."""
    return _translation(stage, edits.rightwards(stage.scenes))


def translation_circle(stage: Stage) -> Frames:
    """The object goes round the middle of where objects lie, as far out as they lie, and keeps its heading."""
    index, steps = stage.order.object, stage.order.steps
    right, back = edits.rightwards(stage.scenes), edits.backwards(stage.scenes)
    ways = [(direction, *_extent(stage, direction)) for direction in (right, back)]
    frames = []
    for step in range(2 * steps):
        angle, scenes = math.pi * step / steps, stage.scenes
        for (direction, middle, half), share in zip(ways, (math.cos(angle), math.sin(angle)), strict=True):
            scenes = edits.placed_along(scenes, index, direction, middle + share * half)
        frames.append(scenes)
    return Frames(frames, closed=True)


def camera_elevation(stage: Stage) -> Frames:
    """The camera comes down from the highest to the lowest place that training gave it; else through 20 degrees."""
    least, most = stage.reach.polar
    back = stage.scenes.cameras.camera_to_world[:, :3, 3]
    polar = (back[:, 2] / back.norm(dim=-1)).clamp(-1, 1).acos()
    if most > least:
        ends = least - polar, most - polar
    else:
        ends = torch.full_like(polar, -math.radians(_TILT_DEG)), torch.full_like(polar, math.radians(_TILT_DEG))
    shares = _evenly(0.0, 1.0, stage.order.steps)
    return Frames([edits.tilted(stage.scenes, torch.lerp(*ends, share)) for share in shares], closed=False)


def interpolate_shape(stage: Stage) -> Frames:
    """The object takes the shapes of others."""
    index = stage.order.object
    codes = _anchors(stage, lambda scenes: scenes.codes.shape[:, index])
    return Frames([edits.with_codes(stage.scenes, index, shape=code) for code in codes], closed=True)


def interpolate_app(stage: Stage) -> Frames:
    """The object takes the looks of others."""
    index = stage.order.object
    codes = _anchors(stage, lambda scenes: scenes.codes.appearance[:, index])
    return Frames([edits.with_codes(stage.scenes, index, appearance=code) for code in codes], closed=True)


def interpolate_bg_app(stage: Stage) -> Frames:
    """The background takes the looks of others."""
    codes = _anchors(stage, lambda scenes: scenes.codes.background_appearance)
    return Frames([edits.with_background(stage.scenes, appearance=code) for code in codes], closed=True)


def add_objects(stage: Stage) -> Frames:
    """From the background alone to as many objects as are asked for, which may be more than training ever showed.

    An object is put where it has most room, among places drawn from all that the camera sees of the ground.
    """
    crowd = _crowd(stage)
    total = stage.order.add_up_to
    each = max(1, round(stage.order.steps / (total + 1)))
    frames = []
    for count in range(total + 1):
        exists = (torch.arange(total, device=crowd.boxes.exists.device) < count).expand_as(crowd.boxes.exists)
        frames += [replace(crowd, boxes=replace(crowd.boxes, exists=exists.clone()))] * each
    return Frames(frames, closed=False)


PROGRAMS: dict[str, Callable[[Stage], Frames]] = {
    program.__name__: program
    for program in (
        rotation_object,
        translation_object_depth,
        translation_object_horizontal,
        interpolate_app,
        interpolate_shape,
        interpolate_bg_app,
        camera_elevation,
        translation_circle,
        add_objects,
    )
}
"""By the names that `program=` takes."""


def _translation(stage: Stage, direction: Tensor) -> Frames:
    index = stage.order.object
    middle, half = _extent(stage, direction)
    shares = _evenly(-1.0, 1.0, stage.order.steps)
    frames = [edits.placed_along(stage.scenes, index, direction, middle + share * half) for share in shares]
    return Frames(frames, closed=False)


def _extent(stage: Stage, direction: Tensor) -> tuple[Tensor, Tensor]:
    """Where the object goes along directions: as training did; else to half of its longest side on either hand."""
    middle, half = stage.reach.along(direction)
    own = stage.scenes.boxes.scale[:, stage.order.object].amax(-1)
    return middle, torch.where(half > 1e-6, half, own)


def _anchors(stage: Stage, code: Callable[[Scenes], Tensor]) -> list[Tensor]:
    """Codes on the way from a scene's own through drawn ones and back."""
    count = stage.order.anchors
    anchors = [code(stage.scenes), *(code(stage.draw(stage.scenes.batch_size)) for _ in range(count - 1))]
    return [
        edits.slerp(anchor, following, step / stage.order.steps)
        for anchor, following in zip(anchors, [*anchors[1:], anchors[0]], strict=True)
        for step in range(stage.order.steps)
    ]


def _crowd(stage: Stage) -> Scenes:
    """The scenes with objects all over them; the first is the object of the order, all stand at its height."""
    scenes, index, total = stage.scenes, stage.order.object, stage.order.add_up_to
    batch, boxes, codes = scenes.batch_size, scenes.boxes, scenes.codes
    others = [stage.draw(batch) for _ in range(total - 1)]

    def column(name: str, of: Callable[[Scenes], Boxes | Codes]) -> Tensor:
        first = getattr(of(scenes), name)[:, index]
        return torch.stack([first, *(getattr(of(other), name)[:, 0] for other in others)], 1)

    crowded = Boxes(
        scale=column("scale", lambda scenes: scenes.boxes),
        translation=_spread(stage, total),
        rotation=column("rotation", lambda scenes: scenes.boxes),
        exists=boxes.exists.new_ones(batch, total),
    )
    looks = {name: column(name, lambda scenes: scenes.codes) for name in ("shape", "appearance")}
    return replace(scenes, boxes=crowded, codes=replace(codes, **looks))


def _spread(stage: Stage, total: int) -> Tensor:
    """Places (B, total, 3), each the farthest from those before it among some that are drawn."""
    first = stage.scenes.boxes.translation[:, stage.order.object]
    right, back = edits.rightwards(stage.scenes), edits.backwards(stage.scenes)
    distance = stage.scenes.cameras.camera_to_world[:, :3, 3].norm(dim=-1)
    half = (_SPREAD * stage.reach.half_frame * distance)[:, None, None]
    source = torch.Generator().manual_seed(stage.order.seed)
    shape = (total - 1, len(first), _CANDIDATES)
    across, along = (2 * torch.rand(2, *shape, generator=source) - 1).to(first).unbind()
    height = torch.zeros_like(first)
    height[:, 2] = first[:, 2]
    places = first[:, None]
    for number in range(total - 1):
        offset = across[number][..., None] * right[:, None] + along[number][..., None] * back[:, None]
        candidates = height[:, None] + half * offset  # (B, C, 3)
        room = torch.cdist(candidates, places).amin(-1)
        best = room.argmax(1)[:, None, None].expand(-1, 1, 3)
        places = torch.cat([places, candidates.gather(1, best)], 1)
    return places


def _evenly(first: float, last: float, count: int) -> list[float]:
    return [first + (last - first) * step / (count - 1) for step in range(count)]
