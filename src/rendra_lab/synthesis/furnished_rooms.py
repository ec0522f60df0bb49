"""Photographs of generated rooms in which it is known which furniture is seen where.

A photograph is taken from a place where a wanted piece is seen whole, at a useful size, and from which nothing else
is half seen: what is in view is either large and free enough to be annotated or hardly there.
Rooms and cameras: as of `rendra_lab.synthesis.rooms`. Letters: N annotated objects, H x W pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from rendra.structures import Meshes
from rendra_lab.records import TensorRecord
from rendra_lab.synthesis.furniture import CLASSES, NAMES
from rendra_lab.synthesis.furniture_models import parsed_model_id
from rendra_lab.synthesis.rooms import Room, build_room, has_clearance, look
from rendra_lab.synthesis.rooms_furnishing import Stock
from rendra_lab.synthesis.rooms_shell import Placed
from rendra_lab.synthesis.rooms_staging import stage
from rendra_lab.synthesis.solids import Floats
from rendra_lab.synthesis.surface_pictures import faces_seen, picture_views

EDITION = 1  # of the photographs; another one makes all cached ones anew
NOBODY = 255  # in maps of whom a pixel belongs to

_MOST_OBJECTS = 4
_HFOV_DEG = (50.0, 75.0)
_FILLED = (0.5, 1.0)  # share of the picture's height that the sphere about the wanted piece spans
_EYES = 192  # places that are tried for one picture, before what is seen from them is looked at
_VIEWS = 10  # of them that are looked at
_ROOMS = 8  # that are tried for the wanted classes; afterwards anything will do
_EYE_ABOVE_M, _EYE_BELOW_M = 0.45, 0.25  # from floor and ceiling
_COARSE = 2  # pixels of a picture a pixel of the view that is judged
# standard deviation, radians, of the directions from which things with a back are seen; others: 1.2
_TURN = {"bed": 0.7, "bookcase": 0.5, "desk": 0.7, "sofa": 0.6, "wardrobe": 0.5}
_RNG = np.random.Generator

# What is annotated: shares of the picture's pixels and of its short side, of the object's silhouette that nothing
# hides, and of its corners that are in the picture. What has less of one of these must be fainter than `_FAINT`.
_AREA, _LENGTH, _FREE, _INSIDE = 0.005, 0.15, 0.3, 0.4
_FAINT = 0.0015
_WANTED_FREE, _WANTED_INSIDE = 0.55, 0.93


@dataclass(frozen=True)
class RoomPhoto(TensorRecord):
    """A photograph and the N objects that are annotated in it."""

    rgb: UInt8[Tensor, "3 H W"]
    owner: UInt8[Tensor, "H W"]  # number of the object that is seen at the middle of each pixel, or NOBODY
    intrinsics: Float[Tensor, "3 3"]
    models: Int[Tensor, "N 2"]  # rows of furniture.NAMES, and numbers of the collection's models
    labels: Int[Tensor, " N"]  # rows of furniture.CLASSES
    model_to_camera: Float[Tensor, "N 4 4"]  # columns; x right, y down, z forwards
    free: Float[Tensor, " N"]  # share of each silhouette within the picture that nothing hides
    inside: Float[Tensor, " N"]  # share of each object's corners that lie in the picture


@dataclass(frozen=True)
class _Subject:
    """A piece in a room."""

    row: int  # of what is placed
    placed: Placed
    points: Floats  # (C, 3) its corners in the room

    @property
    def kind(self) -> str:
        assert self.placed.piece is not None
        return self.placed.piece.kind


@dataclass(frozen=True)
class _Sight:
    """A piece that is seen well enough to be annotated."""

    subject: _Subject
    free: float
    inside: float


@dataclass(frozen=True)
class _Camera:
    intrinsics: Tensor  # (3, 3)
    pose: Tensor  # world to camera (4, 4)
    size: tuple[int, int]

    def coarse(self) -> _Camera:
        """The same with fewer pixels."""
        size = (max(1, self.size[0] // _COARSE), max(1, self.size[1] // _COARSE))
        scale = torch.tensor([size[1] / self.size[1], size[0] / self.size[0], 1.0])
        return _Camera(scale[:, None] * self.intrinsics, self.pose, size)


def room_photos(seed: int, wanted: Sequence[str], stock: Stock, size: tuple[int, int]) -> list[RoomPhoto]:
    """Photographs of one room, one for each wanted class; a class that finds no place there has a room of its own.

    Args:
        seed: of everything.
        wanted: names of furniture.CLASSES.
        stock: gives the furniture; its pieces name models of a collection.
        size: H and W.
    """
    taken: dict[int, RoomPhoto] = {}
    attempt = 0
    while lacking := [number for number in range(len(wanted)) if number not in taken]:
        kinds = [wanted[number] for number in lacking]
        studio = _Studio(build_room(_seed(seed, attempt), partial(stage, wanted=kinds, stock=stock)))
        rng = np.random.default_rng([seed, attempt, 3])
        for number, kind in zip(lacking, kinds, strict=True):
            photo = studio.photograph(kind if attempt < _ROOMS else None, rng, size)
            if photo is not None:
                taken[number] = photo
        attempt += 1
    return [taken[number] for number in range(len(wanted))]


def _seed(seed: int, attempt: int) -> int:
    return int(np.random.SeedSequence([seed, attempt]).generate_state(1, np.uint64)[0] >> np.uint64(1))


class _Studio:
    """A room with a photographer in it."""

    def __init__(self, room: Room) -> None:
        self.room = room
        self.mesh = Meshes([room.surfaces.verts], [room.surfaces.faces])
        self.subjects = [
            _Subject(row, one, np.concatenate([solid.points for solid in one.in_room()]))
            for row, one in enumerate(room.placed)
            if one.piece is not None
        ]
        self.alone = {
            subject.row: Meshes([room.surfaces.verts], [room.surfaces.faces[room.owners == subject.row]])
            for subject in self.subjects
        }
        self.taken: set[int] = set()  # rows of pieces that have had their picture

    def photograph(self, kind: str | None, rng: _RNG, size: tuple[int, int]) -> RoomPhoto | None:
        """A picture of some piece of a class, or of any; None where there is no good one."""
        subjects = [one for one in self.subjects if kind in (None, one.kind) and one.row not in self.taken]
        for index in rng.permutation(len(subjects)):
            for camera in self._cameras(subjects[index], rng, size):
                if self._judge(subjects[index], camera.coarse()) is None:
                    continue
                if (judged := self._judge(subjects[index], camera)) is not None:
                    self.taken.add(subjects[index].row)
                    return self._expose(camera, *judged)
        return None

    def _cameras(self, subject: _Subject, rng: _RNG, size: tuple[int, int]) -> Iterator[_Camera]:
        """Cameras at free places that look at a piece."""
        low, high = subject.points.min(0), subject.points.max(0)
        middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        focal = size[1] / 2 / math.tan(math.radians(rng.uniform(*_HFOV_DEG)) / 2)
        eyes = self._eyes(subject, middle, 2 * radius * focal / size[0], rng)
        for eye in eyes[has_clearance(self.room, eyes)][:_VIEWS]:
            x, y, z = middle + radius * rng.normal(0, 0.15, 3) - eye
            pose = look(eye, math.atan2(x, z), math.atan2(y, math.hypot(x, z)), rng.normal(0, 0.02))
            matrix = torch.tensor([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]])
            yield _Camera(matrix, pose, size)

    def _eyes(self, subject: _Subject, middle: Floats, span: float, rng: _RNG) -> Floats:
        """Places (E, 3) about a piece, mostly before it; at a distance of `span` it fills the picture."""
        around = subject.placed.yaw + _TURN.get(subject.kind, 1.2) * rng.normal(0, 1.0, _EYES)
        is_small = span < 1.2 or middle[1] < 0.3
        up = np.radians(rng.uniform(15, 60, _EYES) if is_small else rng.uniform(0, 35, _EYES))
        distance = span / rng.uniform(*_FILLED, _EYES)
        level = distance * np.cos(up)
        height = middle[1] + distance * np.sin(up)
        height = np.clip(height, _EYE_ABOVE_M, self.room.extent[1] - _EYE_BELOW_M)
        eyes = np.stack([middle[0] + level * np.sin(around), height, middle[2] + level * np.cos(around)], 1)
        return eyes.astype(np.float32)

    def _judge(self, wanted: _Subject, camera: _Camera) -> tuple[Tensor, list[_Sight]] | None:
        """Rows (H, W) of what is placed that pixels show, -1 for others, and the pieces that are seen well.

        None where the wanted one is not seen very well, where there are too many, or one that is half seen.
        """
        face, _ = faces_seen(self.mesh, camera.intrinsics, camera.pose, camera.size)
        owner = torch.where(face >= 0, self.room.owners[face.clamp_min(0)], -1)
        counts = torch.bincount(owner.flatten() + 1, minlength=len(self.room.placed) + 1)[1:].tolist()
        if counts[wanted.row] < _AREA * owner.numel():
            return None
        first = self._sight(wanted, owner == wanted.row, camera)
        if first is None or first.free < _WANTED_FREE or first.inside < _WANTED_INSIDE:
            return None
        sights: list[_Sight] = []
        for subject in self.subjects:
            if counts[subject.row] < max(1, _FAINT * owner.numel()):
                continue
            sight = first if subject is wanted else self._sight(subject, owner == subject.row, camera)
            if sight is None or len(sights) == _MOST_OBJECTS:
                return None
            sights.append(sight)
        return owner, sights

    def _sight(self, subject: _Subject, seen: Tensor, camera: _Camera) -> _Sight | None:
        """How a piece is seen where pixels (H, W) show it; None: not well enough."""
        rows, columns = seen.nonzero().unbind(1)
        length = max(int(line.max() - line.min()) + 1 for line in (rows, columns))
        if len(rows) < _AREA * seen.numel() or length < _LENGTH * min(camera.size):
            return None
        points = torch.from_numpy(subject.points) @ camera.pose[:3, :3].mT + camera.pose[:3, 3]
        flat = points @ camera.intrinsics.mT
        pixels = flat[:, :2] / flat[:, 2:].clamp_min(1e-6)
        limits = torch.tensor([camera.size[1], camera.size[0]])
        inside = float((((pixels >= 0) & (pixels <= limits)).all(1) & (points[:, 2] > 0)).float().mean())
        if inside < _INSIDE:
            return None
        alone, _ = faces_seen(self.alone[subject.row], camera.intrinsics, camera.pose, camera.size)
        free = len(rows) / max(1, int((alone >= 0).sum()))
        return None if free < _FREE else _Sight(subject, free, inside)

    def _expose(self, camera: _Camera, owner: Tensor, sights: Sequence[_Sight]) -> RoomPhoto:
        views = picture_views(
            self.room.surfaces, self.room.pictures, camera.intrinsics[None], camera.pose[None], camera.size
        )
        numbers = torch.full((len(self.room.placed) + 1,), NOBODY, dtype=torch.uint8)
        pieces = []
        for number, sight in enumerate(sights):
            numbers[sight.subject.row + 1] = number
            piece = sight.subject.placed.piece
            assert piece is not None
            pieces.append(piece)
        models = [parsed_model_id(piece.model) for piece in pieces]
        to_room = np.stack([sight.subject.placed.to_room() for sight in sights])
        return RoomPhoto(
            rgb=views.rgb[0],
            owner=numbers[owner + 1],
            intrinsics=camera.intrinsics,
            models=torch.tensor([(NAMES.index(name), number) for name, number in models]),
            labels=torch.tensor([CLASSES.index(piece.kind) for piece in pieces]),
            model_to_camera=camera.pose @ torch.from_numpy(to_room),
            free=torch.tensor([sight.free for sight in sights]),
            inside=torch.tensor([sight.inside for sight in sights]),
        )
