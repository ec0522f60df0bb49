"""Scenes with something in them replaced by hand: another pose of an object, another look, another camera.

Every function answers new scenes and leaves its own alone. B scenes, N objects; `index` says which of the N.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rendra.transforms import axis_angle_to_matrix
from rendra_lab.tasks.giraffe.box_sampler import rotation_about_z
from rendra_lab.tasks.giraffe.records import Scenes

_PARALLEL = 1e-4  # sine of the angle below which a great circle is a straight line to float32


def with_pose(
    scenes: Scenes,
    index: int,
    scale: Float[Tensor, "B 3"] | None = None,
    translation: Float[Tensor, "B 3"] | None = None,
    rotation: Float[Tensor, "B 3 3"] | None = None,
    exists: Bool[Tensor, " B"] | None = None,
) -> Scenes:
    """Another box for one object; what is None stays."""
    given = {"scale": scale, "translation": translation, "rotation": rotation, "exists": exists}
    boxes = scenes.boxes
    new = {name: _with_column(getattr(boxes, name), index, each) for name, each in given.items() if each is not None}
    return replace(scenes, boxes=replace(boxes, **new))


def with_codes(
    scenes: Scenes,
    index: int,
    shape: Float[Tensor, "B Z"] | None = None,
    appearance: Float[Tensor, "B Z"] | None = None,
) -> Scenes:
    """Other latent codes for one object; what is None stays."""
    given = {"shape": shape, "appearance": appearance}
    codes = scenes.codes
    new = {name: _with_column(getattr(codes, name), index, each) for name, each in given.items() if each is not None}
    return replace(scenes, codes=replace(codes, **new))


def with_background(
    scenes: Scenes,
    shape: Float[Tensor, "B Zb"] | None = None,
    appearance: Float[Tensor, "B Zb"] | None = None,
) -> Scenes:
    """Other latent codes for the background; what is None stays."""
    given = {"background_shape": shape, "background_appearance": appearance}
    return replace(
        scenes, codes=replace(scenes.codes, **{name: each for name, each in given.items() if each is not None})
    )


def present(scenes: Scenes, index: int) -> Scenes:
    """With that object in every scene."""
    return with_pose(scenes, index, exists=torch.ones_like(scenes.boxes.exists[:, index]))


def without(scenes: Scenes, index: int) -> Scenes:
    """With that object in none of them."""
    return with_pose(scenes, index, exists=torch.zeros_like(scenes.boxes.exists[:, index]))


def turned(scenes: Scenes, index: int, radians: float) -> Scenes:
    """One object turned about z from where it is, through any angle."""
    own = scenes.boxes.rotation[:, index]
    return with_pose(scenes, index, rotation=rotation_about_z(own.new_tensor(radians)) @ own)


def heading(scenes: Scenes, index: int, radians: float) -> Scenes:
    """One object turned to an angle about z, wherever it was."""
    turn = rotation_about_z(scenes.boxes.rotation.new_tensor(radians))
    return with_pose(scenes, index, rotation=turn.expand(scenes.batch_size, 3, 3))


def placed_along(
    scenes: Scenes, index: int, direction: Float[Tensor, "B 3"], coordinate: Float[Tensor, " B"]
) -> Scenes:
    """One object moved along a direction of unit length to where its coordinate along it is the given one."""
    here = scenes.boxes.translation[:, index]
    way = coordinate - (here * direction).sum(-1)
    return with_pose(scenes, index, translation=here + way[:, None] * direction)


def tilted(scenes: Scenes, radians: Float[Tensor, " B"]) -> Scenes:
    """Cameras moved about the world's middle, which they keep in view: down where the angle is positive."""
    pose = scenes.cameras.camera_to_world
    moved = torch.eye(4).to(pose).repeat(len(pose), 1, 1)
    moved[:, :3, :3] = axis_angle_to_matrix(rightwards(scenes) * radians[:, None])
    return replace(scenes, cameras=replace(scenes.cameras, camera_to_world=moved @ pose))


def rightwards(scenes: Scenes) -> Float[Tensor, "B 3"]:
    """Unit vectors of the world that cameras see point to the right."""
    right = scenes.cameras.camera_to_world[:, :3, 0]
    return right / right.norm(dim=-1, keepdim=True)


def backwards(scenes: Scenes) -> Float[Tensor, "B 3"]:
    """Unit vectors along the ground that point from the world's middle towards cameras.

    Where a camera stands above the middle, what it sees point down.
    """
    right = rightwards(scenes)
    up = torch.zeros_like(right)
    up[:, 2] = 1.0
    towards = torch.linalg.cross(right, up)
    return towards / towards.norm(dim=-1, keepdim=True)


def slerp(first: Float[Tensor, "B Z"], second: Float[Tensor, "B Z"], share: float) -> Float[Tensor, "B Z"]:
    """Codes between two: along the great circle, where a straight line would pass through codes that are too short.

    Shoemake, "Animating rotation with quaternion curves", SIGGRAPH 1985, of vectors whose lengths may differ.

    Args:
        first, second: the codes.
        share: of the way, 0 the first and 1 the second.
    """
    lengths = (first.norm(dim=-1) * second.norm(dim=-1)).clamp_min(1e-12)
    angle = ((first * second).sum(-1) / lengths).clamp(-1, 1).acos()[:, None]
    sine = angle.sin()
    circle = (((1 - share) * angle).sin() * first + (share * angle).sin() * second) / sine.clamp_min(_PARALLEL)
    return torch.where(sine > _PARALLEL, circle, (1 - share) * first + share * second)


def _with_column(whole: Tensor, index: int, value: Tensor) -> Tensor:
    whole = whole.clone()
    whole[:, index] = value
    return whole
