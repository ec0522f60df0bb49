"""The body of the procedural cow: which solids it is made of, and where its features lie.

Frame: x to the cow's left seen by the reader (the cow is symmetric but for its tail), y up, the head looks
towards -z. Units are arbitrary; `make_cow` centres and scales the result. Paired parts are modelled at x > 0
and evaluated at mirrored points.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rendra_lab.synthesis.remeshing import collapse_edges
from rendra_lab.synthesis.signed_distance import (
    Array,
    ellipsoid,
    extract_surface,
    graded_axis,
    relax,
    smooth_difference,
    smooth_union,
    tapered_capsule,
    tube,
)

HEAD_SIZE = 1.14  # the animal is a toy: its head is larger than nature's
EYE_CENTRE, EYE_RADII = (0.132, 0.048, -0.212), (0.036, 0.066, 0.086)
EYE_AXES = np.array([[0.514, 0.133, -0.847], [0.855, 0.0, 0.519], [-0.069, 0.991, 0.114]])  # out, aside, up
NOSTRIL_CENTRE, NOSTRIL_RADII = (0.098, -0.102, -0.425), (0.036, 0.027, 0.05)
HORN_PATH = np.array([[0.11, 0.16, 0.03], [0.20, 0.24, 0.03], [0.235, 0.34, 0.01], [0.17, 0.40, -0.02]])
EAR_CENTRE, EAR_RADII = (0.335, 0.075, 0.045), (0.155, 0.088, 0.05)
EAR_AXES = np.array([[0.972, -0.165, 0.165], [0.195, 0.962, -0.19], [-0.128, 0.217, 0.968]])  # out, up, back


@dataclass(frozen=True)
class CowParameters:
    """The build of a cow. Every number but the last two is a factor on the standard animal.

    Attributes:
        head: size of the head.
        body_length: distance from the shoulders to the hips.
        girth: thickness of the barrel.
        leg_length: height of the belly above the ground.
        leg_thickness: of all four legs.
        horn_length: of the horns; 0 leaves them out.
        ear_length: of the ears.
        head_pitch_deg: how far the head is bowed, in degrees, from -25 to 35.
        tail_swing: where the tail hangs, from -1 (right) to 1 (left).
    """

    head: float = 1.0
    body_length: float = 1.0
    girth: float = 1.0
    leg_length: float = 1.0
    leg_thickness: float = 1.0
    horn_length: float = 1.0
    ear_length: float = 1.0
    head_pitch_deg: float = 4.0
    tail_swing: float = 0.5

    def __post_init__(self) -> None:
        bounds = dict.fromkeys(("head", "body_length", "girth", "leg_length", "leg_thickness"), (0.7, 1.4))
        bounds |= {"horn_length": (0.0, 1.6), "ear_length": (0.7, 1.4)}
        bounds |= {"head_pitch_deg": (-25.0, 35.0), "tail_swing": (-1.0, 1.0)}
        for name, (low, high) in bounds.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"CowParameters.{name} must lie in [{low:g}, {high:g}], got {value!r}")

    @classmethod
    def random(cls, seed: int) -> "CowParameters":
        """A plausible animal, different for every seed."""
        rng = np.random.default_rng(seed)
        factors = ("head", "body_length", "girth", "leg_length", "leg_thickness", "horn_length", "ear_length")
        build = {name: float(rng.uniform(0.85, 1.18)) for name in factors}
        return cls(**build, head_pitch_deg=rng.uniform(-8, 16), tail_swing=rng.uniform(-1, 1))


@dataclass(frozen=True)
class Anatomy:
    """The solids of one cow, as functions of points (N, 3) in its own frame."""

    build: CowParameters

    @property
    def ground(self) -> float:
        """The height y of the soles."""
        return -0.30 - 0.40 * self.build.leg_length

    @property
    def hip(self) -> float:
        """The position z of the hind legs."""
        return 0.58 * self.build.body_length

    @property
    def head_frame(self) -> tuple[Array, Array]:
        """The pivot (3,) of the head, and its axes as rows (3, 3)."""
        pitch = np.radians(self.build.head_pitch_deg)
        cos, sin = np.cos(pitch), np.sin(pitch)
        pivot = np.array([0, 0.33 + 0.08 * self.build.head, -0.28 - 0.11 * self.build.head])
        return pivot, np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])

    def to_head(self, points: Array) -> Array:
        """Points in the head's frame, where the standard head has its size and its pivot is the origin."""
        pivot, axes = self.head_frame
        return (points - pivot.astype(points.dtype)) @ axes.T.astype(points.dtype) / self.head_size

    @property
    def head_size(self) -> float:
        """Size of the head in the cow's frame for one unit in the head's."""
        return HEAD_SIZE * self.build.head

    def distance(self, points: Array) -> Array:
        """Signed distance (N,) to the whole cow."""
        parts = {name: part(points) for name, part in self.parts().items()}
        trunk = smooth_union(0.16, parts["body"], parts["neck"])
        trunk = smooth_union(0.10, trunk, parts["legs"])
        trunk = smooth_union(0.07, trunk, parts["udder"])
        trunk = smooth_union(0.05, trunk, parts["tail"])
        whole = smooth_union(0.10, trunk, parts["head"])
        whole = smooth_union(0.05, whole, parts["ears"])
        return smooth_union(0.03, whole, parts["horns"]) if self.build.horn_length > 0 else whole

    def parts(self) -> dict[str, Callable[[Array], Array]]:
        """The distance function of every part, by name."""
        parts = {
            "body": self.body,
            "neck": self.neck,
            "legs": self.legs,
            "udder": self.udder,
            "tail": self.tail,
            "head": self.head,
            "ears": self.ears,
        }
        return parts | ({"horns": self.horns} if self.build.horn_length > 0 else {})

    def body(self, points: Array) -> Array:
        """The barrel: chest, belly and hips."""
        girth, hip = self.build.girth, self.hip
        chest = ellipsoid(points, (0, -0.01, 0.02), (0.305 * girth, 0.345 * girth, 0.30))
        belly = ellipsoid(points, (0, -0.06, hip / 2), (0.36 * girth, 0.325 * girth, 0.20 + hip / 2))
        rump = ellipsoid(points, (0, 0.02, hip), (0.325 * girth, 0.32 * girth, 0.29))
        spine = tapered_capsule(points, (0, 0.06, 0.0), (0, 0.075, hip), 0.26 * girth, 0.25 * girth)
        return smooth_union(0.12, chest, belly, rump, spine)

    def neck(self, points: Array) -> Array:
        """From the shoulders up into the head."""
        pivot, _ = self.head_frame
        return tapered_capsule(points, (0, 0.08, -0.02), pivot + np.array([0, -0.08, 0.06]), 0.24, 0.185)

    def legs(self, points: Array) -> Array:
        """Four sturdy legs with a hoof each, flat on the ground."""
        mirrored, ground, thick = _mirrored(points), self.ground, self.build.leg_thickness
        spread = 0.205 * self.build.girth
        legs = []
        for z, knee in ((-0.03, -0.008), (self.hip + 0.03, 0.035)):
            top, ankle = (spread, -0.10, z), (spread, ground + 0.13, z + knee)
            shank = tapered_capsule(mirrored, top, ankle, 0.155 * thick, 0.092 * thick)
            foot = (spread, ground + 0.04, z + knee - 0.012)
            hoof = tapered_capsule(mirrored, ankle, foot, 0.09 * thick, 0.118 * thick)
            legs.append(smooth_union(0.03, shank, hoof))
        return -smooth_union(0.05, -np.minimum(*legs), points[..., 1] - self.ground)

    def udder(self, points: Array) -> Array:
        """A round bag with four teats, between the hind legs."""
        z = self.hip - 0.13
        bottom = -0.06 - 0.325 * self.build.girth
        bag = ellipsoid(points, (0, bottom - 0.02, z), (0.165, 0.115, 0.175))
        mirrored = _mirrored(points)
        teats = [
            tapered_capsule(mirrored, (0.065, bottom - 0.09, z + dz), (0.07, bottom - 0.165, z + dz), 0.032, 0.024)
            for dz in (-0.07, 0.06)
        ]
        return smooth_union(0.03, bag, np.minimum(*teats))

    def tail_path(self) -> Array:
        """Control points (4, 3) of the tail's curve, and of the tuft that continues it."""
        root, swing = self.hip + 0.22, 0.10 * self.build.tail_swing
        path = [[0, 0.21, 0], [0.2, 0.24, 0.24], [0.7, -0.03, 0.115], [1.2, -0.22, 0.155]]
        return np.array([[swing * x, y, root + z] for x, y, z in path])

    def tail(self, points: Array) -> Array:
        """A hanging tail with a tuft at its end."""
        rope = tube(points, self.tail_path(), (0.062, 0.045, 0.037, 0.034, 0.032))
        return smooth_union(0.04, rope, self.tuft(points))

    def tuft(self, points: Array) -> Array:
        """The brush at the tail's end: a drop."""
        *_, before, end = self.tail_path()
        down = (end - before) / np.linalg.norm(end - before)
        wide, tip = end + 0.085 * down, end + 0.19 * down
        upper = tapered_capsule(points, end, wide, 0.034, 0.068)
        return smooth_union(0.02, upper, tapered_capsule(points, wide, tip, 0.068, 0.024))

    def head(self, points: Array) -> Array:
        """Skull, bridge of the nose, broad muzzle with nostrils, chin, eyes and forelock."""
        local = self.to_head(points)
        mirrored = _mirrored(local)
        skull = ellipsoid(local, (0, 0, 0), (0.25, 0.235, 0.245))
        bridge = tapered_capsule(local, (0, 0.0, -0.08), (0, -0.12, -0.25), 0.19, 0.15)
        face = smooth_union(0.09, skull, bridge)
        face = smooth_union(0.06, face, self.muzzle(points) / self.head_size)
        face = smooth_union(0.025, face, ellipsoid(mirrored, EYE_CENTRE, EYE_RADII, EYE_AXES))
        face = smooth_union(0.025, face, self.forelock(points) / self.head_size)
        return smooth_difference(0.02, face * self.head_size, self.nostrils(points))

    def forelock(self, points: Array) -> Array:
        """The curls between the horns."""
        local = self.to_head(points)
        curls = [
            ((-0.05, 0.205, -0.09), (-0.066, 0.150, -0.205)),
            ((0.05, 0.205, -0.09), (0.066, 0.150, -0.205)),
        ]
        curls.append(((0, 0.215, -0.09), (0, 0.130, -0.222)))
        locks = [tapered_capsule(local, root, tip, 0.055, 0.024) for root, tip in curls]
        crown = ellipsoid(local, (0, 0.215, -0.03), (0.095, 0.05, 0.09))
        return smooth_union(0.02, crown, *locks) * self.head_size

    def nostrils(self, points: Array) -> Array:
        """The two hollows of the nose."""
        return ellipsoid(_mirrored(self.to_head(points)), NOSTRIL_CENTRE, NOSTRIL_RADII) * self.head_size

    def muzzle(self, points: Array) -> Array:
        """Nose, lips and chin: what is pink of the face."""
        local = self.to_head(points)
        nose = ellipsoid(local, (0, -0.135, -0.275), (0.215, 0.14, 0.155))
        chin = ellipsoid(local, (0, -0.225, -0.245), (0.145, 0.085, 0.14))
        return smooth_union(0.03, nose, chin) * self.head_size

    def ears(self, points: Array) -> Array:
        """Two leaves, hollow in front."""
        mirrored = _mirrored(self.to_head(points))
        length = self.build.ear_length
        centre = np.array(EAR_CENTRE) + 0.13 * (length - 1) * EAR_AXES[0]
        radii = np.array(EAR_RADII) * (length, 1, 1)
        leaf = ellipsoid(mirrored, centre, radii, EAR_AXES)
        root = tapered_capsule(mirrored, (0.19, 0.08, 0.03), centre, 0.055, 0.045)
        return smooth_difference(0.03, smooth_union(0.04, leaf, root), self._ear_hollow(mirrored)) * self.head_size

    def inner_ear(self, points: Array) -> Array:
        """The hollow of the ears."""
        return self._ear_hollow(_mirrored(self.to_head(points))) * self.head_size

    def _ear_hollow(self, mirrored: Array) -> Array:
        length = self.build.ear_length
        centre = np.array(EAR_CENTRE) + (0.13 * (length - 1) + 0.02) * EAR_AXES[0] - 0.052 * EAR_AXES[2]
        return ellipsoid(mirrored, centre, (0.112 * length, 0.056, 0.042), EAR_AXES)

    def horns(self, points: Array) -> Array:
        """Two short horns, bent inwards at their tips."""
        mirrored = _mirrored(self.to_head(points))
        path = HORN_PATH[0] + (HORN_PATH - HORN_PATH[0]) * self.build.horn_length
        return tube(mirrored, path, (0.063, 0.056, 0.044, 0.03)) * self.head_size

    def mesh(self, num_faces: int) -> tuple[Array, Array]:
        """The cow's surface.

        Args:
            num_faces: how many triangles to use at most; more of them go where the surface bends.

        Returns:
            Vertices (V, 3) and outward faces (F, 3): closed, manifold and of one piece.
        """
        spacing = 0.031 * (9600 / num_faces) ** 0.5
        verts, faces = extract_surface(self.distance, self._axes(spacing))
        verts = relax(verts, faces, self.distance, rounds=1)
        verts, faces = collapse_edges(verts, faces, num_faces)
        return relax(verts, faces, self.distance, rounds=4), faces

    def _axes(self, spacing: float) -> list[Array]:
        """Grid planes round the cow: steps of `spacing` on the body and 0.6 of it on the head."""
        margin, head, pivot = 2.5 * spacing, self.head_size, self.head_frame[0]
        width = max(0.40 * self.build.girth, (0.5 + 0.3 * (self.build.ear_length - 1)) * head)
        top = pivot[1] + (0.27 + 0.27 * self.build.horn_length) * head
        front, back = pivot[2] - 0.52 * head, self.hip + 0.50

        def finer(edge: float, sign: int) -> Callable[[Array], Array]:
            return lambda x: spacing * (1 - 0.4 / (1 + np.exp(-sign * (x - edge) / 0.04)))

        return [
            graded_axis(-width - margin, width + margin, lambda x: np.full_like(x, 0.85 * spacing)),
            graded_axis(self.ground - margin, top + margin, finer(0.18, 1)),
            graded_axis(front - margin, back + margin, finer(-0.08, -1)),
        ]


def _mirrored(points: Array) -> Array:
    """Points folded to x >= 0; rounded at the plane so that blends across it stay smooth."""
    folded = points.copy()
    folded[..., 0] = np.sqrt(points[..., 0] ** 2 + 4e-4)
    return folded
