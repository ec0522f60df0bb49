"""What GIRAFFE is given, what it makes pictures of, and what it answers.

Niemeyer and Geiger, "GIRAFFE: Representing Scenes as Compositional Generative Neural Feature Fields", CVPR 2021,
arXiv:2011.12100.

Letters: B pictures, N objects that a scene can have, Z and Zb latent dimensions of objects and of the background,
S x S pixels of a picture, V x V rays of its feature image.
Pictures are sRGB in [0, 1]. The world has x and y on the ground and z up; a camera looks along its own -z, y up, at
the world's middle. An object's own space is a cube of +-1 to which its box is scaled; lengths have no unit.
"""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from rendra_lab.records import TensorRecord


@dataclass(frozen=True)
class Codes(TensorRecord):
    """What things look like: latent codes, of a standard normal distribution."""

    shape: Float[Tensor, "B N Z"]
    appearance: Float[Tensor, "B N Z"]
    background_shape: Float[Tensor, "B Zb"]
    background_appearance: Float[Tensor, "B Zb"]


@dataclass(frozen=True)
class Boxes(TensorRecord):
    """Where objects are: a point p of the world is R (p - t) / s in an object's own space, element by element."""

    scale: Float[Tensor, "B N 3"]  # s, half of the box's sides
    translation: Float[Tensor, "B N 3"]  # t, the box's middle
    rotation: Float[Tensor, "B N 3 3"]  # R, about z
    exists: Bool[Tensor, "B N"]


@dataclass(frozen=True)
class Cameras(TensorRecord):
    """Who looks, and how the background is turned."""

    camera_to_world: Float[Tensor, "B 4 4"]  # columns: a point (x, y, z, 1) in the camera's axes to the world's
    background_turn: Float[Tensor, " B"]  # radians about z


@dataclass(frozen=True)
class Scenes(TensorRecord):
    """All that a picture is made of. Any of it can be replaced by hand: `dataclasses.replace`."""

    codes: Codes
    boxes: Boxes
    cameras: Cameras

    @property
    def batch_size(self) -> int:
        """B."""
        return len(self.codes.shape)

    def rows(self, numbers: slice | Tensor) -> Scenes:
        """Some of the scenes, by their numbers."""
        return self._map(lambda value: value[numbers], lambda value: isinstance(value, Tensor))


@dataclass(frozen=True)
class MadePictures(TensorRecord):
    """Pictures of scenes, and whose their pixels are."""

    rgb: Float[Tensor, "B 3 S S"]
    shares: Float[Tensor, "B T V V"]  # of T = N + 1 things, the background last, in the features of pixels; sum <= 1


@dataclass(frozen=True)
class PictureTruth(TensorRecord):
    """What only a generated world knows: for scores alone, never for training. Padded to the most objects."""

    masks: Bool[Tensor, "B M S S"]  # pixels that show an object
    boxes: Float[Tensor, "B M 4"]  # x0, y0, x1, y1 of that, pixels; 0 where there is no object
    heading: Float[Tensor, "B M"]  # radians about up, the object's front from +x towards +y; NaN: it has no front
    kind: Int[Tensor, "B M"]  # which coat or solid; -1 where there is no object


@dataclass(frozen=True)
class PictureBatch(TensorRecord):
    """Pictures of a collection, without poses, masks or labels; for evaluation perhaps with the truth."""

    rgb: Float[Tensor, "B 3 S S"]
    truth: PictureTruth | None = None
