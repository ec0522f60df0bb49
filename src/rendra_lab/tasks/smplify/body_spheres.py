"""Balls that fill a body: twenty capsules that ride on its bones, each a row of balls.

Bogo et al., "Keep it SMPL: Automatic Estimation of 3D Human Pose and Shape from a Single Image", ECCV 2016, Sec. 3.2:
lengths and radii are linear in betas. Letters: N bodies, S balls, V vertices, B betas, L limbs. Metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from rendra.body import SMPL
from rendra_lab.errors import UserError
from rendra_lab.records import TensorRecord
from rendra_lab.tasks.smplify.markers import Marker

_STIFFNESS = 1e-2  # with which ends keep to where they began: an open tube does not say how long it is
_ROUNDS = 20
_LEAST_RADIUS = 0.3  # of the mean body's, for betas far from any adult's


@dataclass(frozen=True)
class _Part:
    """A capsule.

    Attributes:
        name: of the part.
        bone: joint that carries it.
        more: further joints whose vertices belong to it.
        tip: joint that its axis runs to; none: it lies across the body, or rises to the top of the head.
        is_tube: open at both ends, so that its axis runs from joint to joint.
    """

    name: str
    bone: str
    more: tuple[str, ...] = ()
    tip: str | None = None
    is_tube: bool = False


def _both_sides(name: str, bone: str, tip: str, is_tube: bool, more: tuple[str, ...] = ()) -> Iterable[_Part]:
    for side in ("left", "right"):
        others = tuple(f"{side}_{joint}" for joint in more)
        yield _Part(f"{side}_{name}", f"{side}_{bone}", others, f"{side}_{tip}", is_tube)


_PARTS = (
    _Part("pelvis", "pelvis"),
    *_both_sides("thigh", "hip", "knee", True),
    *_both_sides("calf", "knee", "ankle", True),
    *_both_sides("foot", "ankle", "foot", False, ("foot",)),
    _Part("spine", "spine1"),
    _Part("spine1", "spine2"),
    _Part("spine2", "spine3"),
    _Part("neck", "neck", (), "head", True),
    _Part("head", "head"),
    *_both_sides("shoulder", "collar", "shoulder", True),
    *_both_sides("upper_arm", "shoulder", "elbow", True),
    *_both_sides("forearm", "elbow", "wrist", True),
    *_both_sides("hand", "wrist", "hand", False, ("hand",)),
)
PARTS = tuple(part.name for part in _PARTS)
"""The capsules, in the order of their balls."""

TRUNK = ("pelvis", "spine", "spine1", "spine2")
REACHING = ("left_forearm", "right_forearm", "left_hand", "right_hand")
CAPSULE_PAIRS = (
    *((trunk, limb) for trunk in TRUNK for limb in REACHING),
    ("left_calf", "right_calf"),
    ("left_foot", "right_calf"),
    ("right_foot", "left_calf"),
    ("left_foot", "right_foot"),
    ("left_shoulder", "left_forearm"),
    ("right_shoulder", "right_forearm"),
    ("left_hand", "right_hand"),
)
"""What can pass through each other: neighbours that always overlap are not among them."""


@dataclass(frozen=True)
class Balls(TensorRecord):
    """The balls of posed bodies."""

    middles: Float[Tensor, "N S 3"]  # in the world
    radii: Float[Tensor, "N S"]
    parts: tuple[int, ...]  # (S,) which of `PARTS` each ball belongs to

    def places(self, part: str) -> list[int]:
        """The balls of a part, along its axis."""
        index = PARTS.index(part)
        return [place for place, owner in enumerate(self.parts) if owner == index]


class BodySpheres(nn.Module):
    """The balls of one body model, fitted to the vertices that each part's bones move.

    Args:
        body: with SMPL's 24 joints.

    Attributes:
        markers: the middles of the S balls, for a `MarkerSet`.
        parts: (S,) which of `PARTS` each belongs to.

    Raises:
        UserError: a part moves too few vertices to tell how thick it is.
    """

    radius_columns: Tensor  # (S, 1 + B)

    def __init__(self, body: SMPL) -> None:
        super().__init__()
        self.markers: list[Marker] = []
        parts: list[int] = []
        columns: list[Tensor] = []
        for index, part in enumerate(_PARTS):
            numbers = _fit_capsule(body, part).to(body.v_template.dtype)  # (7, 1 + B)
            bone = body.joint_index(part.bone)
            for share in _places_along(part.name, numbers[:, 0]):
                middle = (1 - share) * numbers[:3] + share * numbers[3:6]
                self.markers.append(Marker(bone, middle[:, 0], middle[:, 1:]))
                columns.append(numbers[6])
                parts.append(index)
        self.parts = tuple(parts)
        self.register_buffer("radius_columns", torch.stack(columns), False)

    def radii(self, betas: Tensor) -> Tensor:
        """Radii (N, S) of shapes (N, n), n at most B."""
        columns = self.radius_columns.to(betas.dtype)
        mean = columns[:, 0]
        return (mean + betas @ columns[:, 1 : 1 + betas.shape[1]].T).maximum(_LEAST_RADIUS * mean)

    def balls(self, middles: Tensor, betas: Tensor) -> Balls:
        """The balls about the markers (N, S, 3) of bodies of shapes (N, n); radii carry no derivatives.

        So a body becomes no thinner to make room for its own arm (Bogo et al., Sec. 3.2).
        """
        return Balls(middles, self.radii(betas.detach()), self.parts)


def _places_along(name: str, numbers: Tensor) -> list[float]:
    """Where the balls of a capsule (7,) sit on its axis, 0 to 1: its ends, and a diameter or so apart between them.

    What lies inside the trunk anyway is left out: the near end of a thigh, the ends of an upper arm.
    """
    length, radius = float((numbers[3:6] - numbers[:3]).norm()), float(numbers[6])
    inner = max(0, math.floor(length / (2 * radius) - 1))
    shares = torch.linspace(0, 1, inner + 2).tolist()
    if name.endswith("thigh"):
        return shares[1:]
    if name.endswith("upper_arm"):
        return shares[1:-1] or shares[-1:]
    return shares


def _fit_capsule(body: SMPL, part: _Part) -> Tensor:
    """Both ends of the axis and the radius (7, 1 + B), the mean body's and what each beta adds; float64.

    Least squares of the vertices' distances to the capsule's surface, weighted by the area about them; then of the
    same to first order in each beta.
    """
    owned = sum(body.weights[:, body.joint_index(joint)] for joint in (part.bone, *part.more))
    assert isinstance(owned, Tensor)
    others = body.weights.clone()
    others[:, [body.joint_index(joint) for joint in (part.bone, *part.more)]] = 0
    verts = (owned > others.amax(1)).nonzero()[:, 0]
    if len(verts) < 4:
        raise UserError(f"body: the {part.name} moves {len(verts)} vertices; a capsule needs 4 or more to be fitted")
    points = torch.cat([body.v_template[verts, :, None], body.shapedirs[verts]], dim=2).double()
    weights = _areas(body).index_select(0, verts)
    weights = weights / weights.sum()
    start = _start(body, part, points, weights)
    numbers = start[:, 0]
    stiff = _STIFFNESS * torch.eye(7, dtype=torch.float64, device=start.device)
    for _ in range(_ROUNDS):
        gap, slope, _ = _distances(points[..., 0], numbers)
        weighted = slope.T * weights
        numbers = numbers - torch.linalg.solve(
            weighted @ slope + stiff, weighted @ gap + stiff @ (numbers - start[:, 0])
        )
    _, slope, away = _distances(points[..., 0], numbers)
    weighted = slope.T * weights
    moved = torch.einsum("vc,vcb->vb", away, points[..., 1:])  # how much each beta moves the vertices outwards
    dirs = torch.linalg.solve(weighted @ slope + stiff, stiff @ start[:, 1:] - weighted @ moved)
    return torch.cat([numbers[:, None], dirs], dim=1)


def _distances(verts: Tensor, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """How far vertices (V, 3) are outside a capsule (V,), the derivatives (V, 7), and the way out (V, 3)."""
    begin, axis = numbers[:3], numbers[3:6] - numbers[:3]
    share = ((verts - begin) @ axis / axis.square().sum()).clamp(0, 1)[:, None]
    apart = verts - (begin + share * axis)
    distance = apart.norm(dim=1, keepdim=True)
    away = apart / distance.clamp_min(1e-9)
    slope = torch.cat([-(1 - share) * away, -share * away, -torch.ones_like(share)], dim=1)
    return distance[:, 0] - numbers[6], slope, away


def _start(body: SMPL, part: _Part, points: Tensor, weights: Tensor) -> Tensor:
    """A capsule (7, 1 + B) to begin with: from joint to joint, or about the middle of the vertices (V, 3, 1 + B)."""
    bone = _joint(body, part.bone)
    if part.tip is not None:
        tip = _joint(body, part.tip)
    elif part.name == "head":
        top = body.head_top
        tip = torch.cat([body.v_template[top, :, None], body.shapedirs[top]], dim=1).double()
    else:
        tip = bone + bone.new_tensor([[1.0], [0.0], [0.0]])  # across
    axis = nn.functional.normalize(tip[:, 0] - bone[:, 0], dim=0)
    middle = bone if part.is_tube else torch.einsum("v,vcb->cb", weights, points)
    arms = points[..., 0] - middle[:, 0]
    along = arms @ axis
    radius = (arms - along[:, None] * axis).norm(dim=1) @ weights
    thickness = torch.zeros_like(bone[:1])
    thickness[0, 0] = radius
    if part.is_tube:
        return torch.cat([bone, tip, thickness])
    reach = torch.zeros_like(bone)
    reach[:, 0] = axis * (along.abs().amax() - radius).clamp_min(0.2 * radius)
    return torch.cat([middle - reach, middle + reach, thickness])


def _joint(body: SMPL, name: str) -> Tensor:
    """(3, 1 + B) of a joint at rest."""
    index = body.joint_index(name)
    return torch.cat([body.joint_template[index, :, None], body.joint_shapedirs[index]], dim=1).double()


def _areas(body: SMPL) -> Tensor:
    """Area (V,) about each vertex of the mean body, so that finely meshed fingers and faces count no more."""
    corners = body.v_template.double().index_select(0, body.faces.reshape(-1)).reshape(-1, 3, 3)
    doubled = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    areas = corners.new_full((len(body.v_template),), 1e-12)
    return areas.index_add(0, body.faces.reshape(-1), (doubled / 6).repeat_interleave(3))


def limbs_inside_trunk(balls: Balls, tolerance: float = 0.01) -> Tensor:
    """Whether a forearm or hand of each body is inside its trunk: (N,) bool.

    Flesh that touches gives way, and capsules stand out where a trunk is flat: folded arms and hands on hips sink in
    up to their axes. Inside is whose axis is more than a centimetre under the trunk's surface. That is so of 0.3 % of
    generated natural poses on bodies of all shapes, for which they were not chosen; of 2.3 % if axes up to 2 cm
    outside counted too, 40 % of a forearm's radius sunk in; and of a third of arms that turn at random.

    Args:
        balls: of N bodies.
        tolerance: metres.
    """
    return (limb_depths(balls) > tolerance).any(1)


def limb_depths(balls: Balls) -> Tensor:
    """How deep the axis of each of `REACHING` lies under the surface of the trunk: (N, 4), negative outside.

    Trunk parts are the whole capsules, from their first ball to their last: between two balls nothing hides.
    """
    depths = []
    for limb in REACHING:
        of_parts = [_depth(balls, balls.places(limb), balls.places(trunk)) for trunk in TRUNK]
        depths.append(torch.stack(of_parts).amax(0))
    return torch.stack(depths, dim=1)


def _depth(balls: Balls, limb: list[int], trunk: list[int]) -> Tensor:
    """(N,) of the deepest ball of a limb in a capsule."""
    points, begin, end = balls.middles[:, limb], balls.middles[:, trunk[0], None], balls.middles[:, trunk[-1], None]
    axis = end - begin
    share = ((points - begin) * axis).sum(-1) / axis.square().sum(-1).clamp_min(1e-12)
    nearest = begin + share.clamp(0, 1)[..., None] * axis
    return (balls.radii[:, trunk[0], None] - (points - nearest).norm(dim=-1)).amax(1)
