"""What colour the procedural cow has at each point of its surface.

Colours are sRGB in [0, 1]. Everything is a function of the point in the cow's own frame, never of the
texture, so the picture has no seams.
"""

from dataclasses import dataclass

import numpy as np

from rendra_lab.synthesis.cow_anatomy import EYE_AXES, EYE_CENTRE, HORN_PATH, Anatomy
from rendra_lab.synthesis.signed_distance import Array, ellipsoid, smooth_difference, smooth_union

Colour = tuple[float, float, float]
SOFT = 0.007  # half-width of the transition between two colours, in the cow's units

BREEDS: dict[str, tuple[Colour, Colour]] = {
    "holstein": ((0.97, 0.945, 0.90), (0.16, 0.13, 0.12)),
    "ayrshire": ((0.975, 0.94, 0.88), (0.52, 0.25, 0.12)),
    "guernsey": ((0.98, 0.95, 0.90), (0.80, 0.53, 0.28)),
    "chocolate": ((0.955, 0.90, 0.81), (0.32, 0.185, 0.115)),
    "grey": ((0.95, 0.945, 0.935), (0.46, 0.47, 0.50)),
}


@dataclass(frozen=True)
class CoatParameters:
    """How the cow is painted.

    Attributes:
        base: colour of the hair.
        patch: colour of the patches, the ears and the tuft.
        muzzle: colour of nose and udder.
        horn: colour of the horns; their tips are darker.
        hoof: colour of the hooves.
        coverage: share of the body in patches, from 0 to 0.9.
        patch_size: how large one patch is, in cow heights: 0.1 is freckled, 0.6 is bold.
        blaze: whether the face stays light between the eyes.
    """

    base: Colour = BREEDS["holstein"][0]
    patch: Colour = BREEDS["holstein"][1]
    muzzle: Colour = (0.96, 0.66, 0.62)
    horn: Colour = (0.90, 0.80, 0.62)
    hoof: Colour = (0.27, 0.22, 0.20)
    coverage: float = 0.42
    patch_size: float = 0.36
    blaze: bool = True

    def __post_init__(self) -> None:
        for name in ("base", "patch", "muzzle", "horn", "hoof"):
            colour = np.asarray(getattr(self, name), float)
            if colour.shape != (3,) or colour.min() < 0 or colour.max() > 1:
                raise ValueError(
                    f"CoatParameters.{name} must be three numbers in [0, 1], got {getattr(self, name)!r}"
                )
        if not 0 <= self.coverage <= 0.9:
            raise ValueError(f"CoatParameters.coverage must lie in [0, 0.9], got {self.coverage!r}")
        if not 0.05 <= self.patch_size <= 2:
            raise ValueError(f"CoatParameters.patch_size must lie in [0.05, 2], got {self.patch_size!r}")

    @classmethod
    def of_breed(cls, breed: str) -> "CoatParameters":
        """The usual coat of a breed, one of BREEDS."""
        if breed not in BREEDS:
            raise ValueError(f"unknown breed {breed!r}; there are {', '.join(BREEDS)}")
        base, patch = BREEDS[breed]
        return cls(base=base, patch=patch)

    @classmethod
    def random(cls, seed: int) -> "CoatParameters":
        """A plausible coat, different for every seed."""
        rng = np.random.default_rng(seed)
        base, patch = BREEDS[str(rng.choice(list(BREEDS)))]

        def vary(colour: Colour, spread: float) -> Colour:
            shift = rng.uniform(-spread, spread) + rng.uniform(-0.012, 0.012, 3)
            red, green, blue = np.clip(np.array(colour) + shift, 0, 1).tolist()
            return red, green, blue

        return cls(
            base=vary(base, 0.02),
            patch=vary(patch, 0.05),
            muzzle=vary((0.95, 0.66, 0.62), 0.04),
            coverage=float(rng.uniform(0.25, 0.6)),
            patch_size=float(rng.uniform(0.26, 0.5)),
            blaze=bool(rng.random() < 0.7),
        )


class Coat:
    """The colour function of one cow."""

    def __init__(self, anatomy: Anatomy, parameters: CoatParameters, seed: int, surface: Array) -> None:
        """Draw the pattern.

        Args:
            anatomy: whose skin it is.
            parameters: the colours and the style.
            seed: of the patches.
            surface: (N, 3) points spread over the skin, by which the share of the patches is set.
        """
        self.anatomy, self.parameters = anatomy, parameters
        rng = np.random.default_rng(seed)
        # 64 plane waves of about one length: a random field whose level sets are patches of about one size
        waves = rng.normal(size=(64, 3))
        waves *= rng.normal(1.0, 0.22, (64, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
        self._waves = (waves * np.pi / parameters.patch_size).astype(np.float32)
        self._phases = rng.uniform(0, 2 * np.pi, 64).astype(np.float32)
        self._level = 0.0
        field = -self._pattern(surface) * np.pi / parameters.patch_size
        self._level = float(np.quantile(field, 1 - parameters.coverage))

    def __call__(self, points: Array) -> Array:
        """Colours (N, 3) of points (N, 3) on the skin, float32."""
        look, anatomy = self.parameters, self.anatomy
        head = anatomy.to_head(points)
        colour = np.broadcast_to(np.asarray(look.base, np.float32), points.shape).copy()
        _lay(colour, look.patch, _inside(self._patches(points, head)))
        self._paint_trunk(colour, points)
        self._paint_head(colour, points, head)
        self._paint_eyes(colour, head)
        return colour

    def _pattern(self, points: Array) -> Array:
        """Distance-like value (N,) of the random patches: negative inside, of slope one at their borders."""
        angles = points.astype(np.float32) @ self._waves.T + self._phases
        field = np.cos(angles).sum(1) / np.sqrt(len(self._phases) / 2)
        return (self._level - field) * self.parameters.patch_size / np.pi

    def _patches(self, points: Array, head: Array) -> Array:
        """Signed distance (N,) to all dark hair: the random patches, and what every cow of the herd has."""
        patches = self._pattern(points)
        wobble = 0.3 * np.clip(patches, -0.15, 0.15)
        round_eye = ellipsoid(_fold(head), EYE_CENTRE, (0.10, 0.15, 0.12))
        patches = smooth_union(0.08, patches, self.anatomy.ears(points) - 0.03, round_eye + wobble)
        socks = points[:, 1] - self.anatomy.ground - 0.36 - wobble
        patches = smooth_difference(0.06, patches, socks)
        if not self.parameters.blaze:
            return patches
        width = 0.068 + 0.9 * np.minimum(head[:, 1] - 0.05, 0) ** 2  # widens towards the nose
        blaze = np.maximum(np.abs(head[:, 0]) - width + 0.5 * wobble, head[:, 2] + 0.05)
        return smooth_difference(0.04, patches, blaze)

    def _paint_trunk(self, colour: Array, points: Array) -> None:
        look, anatomy = self.parameters, self.anatomy
        _lay(colour, look.muzzle, _inside(anatomy.udder(points) - 0.012, 0.02))
        sole = points[:, 1] - anatomy.ground
        _lay(colour, look.hoof, _inside(sole - 0.088))
        cleft = np.abs(_fold(points)[:, 0] - 0.205 * anatomy.build.girth)
        front = _hoof_front(points, anatomy)
        _lay(
            colour,
            tuple(0.45 * np.array(look.hoof)),
            _inside(cleft - 0.007, 0.004) * front * _inside(sole - 0.07),
        )
        _lay(colour, look.patch, _inside(anatomy.tuft(points) - 0.012, 0.01))

    def _paint_head(self, colour: Array, points: Array, head: Array) -> None:
        look, anatomy = self.parameters, self.anatomy
        folded = _fold(head)
        _lay(colour, look.patch, _inside(anatomy.forelock(points) - 0.010, 0.008))
        muzzle = np.asarray(look.muzzle)
        _lay(colour, look.muzzle, _inside(anatomy.muzzle(points) - 0.010, 0.009))
        _lay(colour, muzzle * (1.0, 0.84, 0.84), 0.8 * _inside(anatomy.inner_ear(points) - 0.012, 0.014))
        _lay(colour, muzzle * (0.50, 0.36, 0.36), _inside(anatomy.nostrils(points) - 0.006, 0.008))
        smile = np.abs(head[:, 1] + 0.232 - 1.7 * head[:, 0] ** 2) - 0.006
        in_front = _ramp(-0.25, -0.29, head[:, 2]) * _ramp(0.150, 0.135, folded[:, 0])
        _lay(colour, muzzle * (0.58, 0.42, 0.42), _inside(smile, 0.005) * in_front)
        if anatomy.build.horn_length > 0:
            height = np.clip((head[:, 1] - HORN_PATH[0, 1]) / (0.25 * anatomy.build.horn_length), 0, 1)[:, None]
            horn = np.asarray(look.horn) * (1 - 0.55 * height**2)
            _lay(colour, horn, _inside(anatomy.horns(points) - 0.016, 0.008))

    def _paint_eyes(self, colour: Array, head: Array) -> None:
        """Large and dark in a rim of white, each with a light in it that comes from one side for both."""
        local = (_fold(head) - EYE_CENTRE) @ EYE_AXES.T
        out, side, up = local.T
        facing = out > -0.05
        to_left = side * np.sign(head[:, 0])

        def disc(centre: tuple[float, float], radii: tuple[float, float], across: Array) -> Array:
            plane = np.stack([across, up, np.zeros_like(up)], 1)
            return np.where(facing, ellipsoid(plane, (*centre, 0), (*radii, 1.0)), 1.0)

        _lay(colour, (0.30, 0.20, 0.17), _inside(disc((0, 0), (0.069, 0.088), side), 0.004))
        _lay(colour, (0.99, 0.985, 0.97), _inside(disc((0, 0), (0.062, 0.081), side), 0.003))
        _lay(colour, (0.24, 0.12, 0.07), _inside(disc((-0.006, -0.003), (0.05, 0.068), side), 0.003))
        _lay(colour, (0.05, 0.035, 0.035), _inside(disc((-0.006, 0.002), (0.044, 0.061), side), 0.008))
        _lay(colour, (1.0, 1.0, 1.0), _inside(disc((0.016, 0.028), (0.016, 0.021), to_left), 0.003))
        _lay(colour, (1.0, 1.0, 1.0), 0.75 * _inside(disc((-0.018, -0.028), (0.008, 0.010), to_left), 0.003))


def _hoof_front(points: Array, anatomy: Anatomy) -> Array:
    """1 on the front half of the hooves, 0 elsewhere."""
    fore = points[:, 2] < anatomy.hip / 2
    centre = np.where(fore, -0.05, anatomy.hip + 0.053)
    return _ramp(-0.02, -0.05, points[:, 2] - centre)


def _lay(colour: Array, paint: Colour | Array, amount: Array) -> None:
    """Blend `paint`, (3,) or (N, 3), over `colour` (N, 3) in place by `amount` (N,)."""
    colour += amount[:, None].astype(np.float32) * (np.asarray(paint, np.float32) - colour)


def _inside(distance: Array, soft: float = SOFT) -> Array:
    """1 inside a solid, 0 outside, smooth over twice `soft`."""
    return _ramp(soft, -soft, distance)


def _ramp(start: float, end: float, value: Array) -> Array:
    """0 where `value` is beyond `start`, 1 beyond `end`, smooth between."""
    along = np.clip((value - start) / (end - start), 0, 1)
    return along * along * (3 - 2 * along)


def _fold(points: Array) -> Array:
    folded = points.copy()
    folded[:, 0] = np.abs(points[:, 0])
    return folded
