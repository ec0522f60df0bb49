"""Phong's lighting: ambient, diffuse and specular terms, and the lights that cast them.

B. T. Phong, "Illumination for computer generated pictures", CACM 18(6), 1975. All points, normals and
directions are in world coordinates; a direction points from the surface towards the light. Colours are RGB.

Notation: N lights (one for each image, or one for all), P any further dimensions of the points.
"""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.renderer.batching import per_image
from rendra.renderer.utils import TensorProperties

_NORMALIZE_EPS = 1e-6
_AMBIENT = ((0.5, 0.5, 0.5),)
_DIFFUSE = ((0.3, 0.3, 0.3),)
_SPECULAR = ((0.2, 0.2, 0.2),)


def diffuse(normals: Tensor, color: Tensor, direction: Tensor) -> Tensor:
    """Lambert's cosine law, `color * max(n . l, 0)`; surfaces that face away get nothing.

    Args:
        normals: (N, ..., 3), of any length.
        color: (N, 3) or (1, 3), or of the shape of `normals`.
        direction: towards the light, of any length; (N, 3), (1, 3) or of the shape of `normals`.

    Returns:
        (N, ..., 3).
    """
    normals = F.normalize(normals, dim=-1, eps=_NORMALIZE_EPS)
    direction = F.normalize(per_image(direction, normals.ndim), dim=-1, eps=_NORMALIZE_EPS)
    cosine = torch.linalg.vecdot(normals, direction)
    return per_image(color, normals.ndim) * cosine.relu()[..., None]


def specular(
    points: Tensor,
    normals: Tensor,
    direction: Tensor,
    color: Tensor,
    camera_position: Tensor,
    shininess: Tensor,
) -> Tensor:
    """Phong's highlight, `color * max(v . r, 0)^shininess` where the light is in front of the surface.

    r = 2 (n . l) n - l is the mirrored light direction, v points from the surface to the camera.

    Args:
        points: (N, ..., 3) where on the surface.
        normals: (N, ..., 3), of any length.
        direction: towards the light, of any length; (N, 3), (1, 3) or of the shape of `normals`.
        color: (N, 3) or (1, 3), or of the shape of `normals`.
        camera_position: (N, 3) or (1, 3), or of the shape of `points`.
        shininess: (N,) or (1,), or (N, ...).

    Returns:
        (N, ..., 3).
    """
    ndim = normals.ndim
    normals = F.normalize(normals, dim=-1, eps=_NORMALIZE_EPS)
    direction = F.normalize(per_image(direction, ndim), dim=-1, eps=_NORMALIZE_EPS)
    cosine = torch.linalg.vecdot(normals, direction)[..., None]
    view = F.normalize(per_image(camera_position, ndim) - points, dim=-1, eps=_NORMALIZE_EPS)
    mirrored = 2 * cosine * normals - direction
    # the smallest float in place of zero: powers below one have no finite slope at zero
    alignment = torch.linalg.vecdot(view, mirrored).clamp(min=torch.finfo(points.dtype).tiny)
    highlight = alignment.pow(per_image(shininess, ndim - 1))[..., None]
    return per_image(color, ndim) * highlight * (cosine > 0)


class DirectionalLights(TensorProperties):
    """Light from infinitely far away: the same direction everywhere."""

    ambient_color: Tensor  # (N, 3)
    diffuse_color: Tensor  # (N, 3)
    specular_color: Tensor  # (N, 3)
    direction: Tensor  # (N, 3)

    def __init__(
        self,
        ambient_color: Tensor | Sequence = _AMBIENT,
        diffuse_color: Tensor | Sequence = _DIFFUSE,
        specular_color: Tensor | Sequence = _SPECULAR,
        direction: Tensor | Sequence = ((0, 1, 0),),
        device: Device = "cpu",
    ) -> None:
        """Broadcast all arguments to one batch.

        Args:
            ambient_color: (N, 3) light that reaches every surface alike.
            diffuse_color: (N, 3) light that is scattered.
            specular_color: (N, 3) light that is mirrored.
            direction: (N, 3) from the scene towards the light, in world coordinates.
            device: where the tensors live.

        Raises:
            ValueError: an argument whose last dimension is not 3.
        """
        super().__init__(
            device=device,
            ambient_color=ambient_color,
            diffuse_color=diffuse_color,
            specular_color=specular_color,
            direction=direction,
        )
        _check_triples(self, "ambient_color", "diffuse_color", "specular_color", "direction")

    def clone(self) -> "DirectionalLights":  # type: ignore[override]
        """A copy with its own tensors."""
        return super().clone(type(self)(device=self.device))

    def diffuse(self, normals: Tensor, points: Tensor | None = None) -> Tensor:
        """The diffuse term at normals (N, ..., 3); `points` play no part and are taken for uniformity."""
        return diffuse(normals, self.diffuse_color, self.direction)

    def specular(self, normals: Tensor, points: Tensor, camera_position: Tensor, shininess: Tensor) -> Tensor:
        """The specular term; arguments as of the function `specular`."""
        return specular(points, normals, self.direction, self.specular_color, camera_position, shininess)


class PointLights(TensorProperties):
    """Light from one point, without fall-off."""

    ambient_color: Tensor  # (N, 3)
    diffuse_color: Tensor  # (N, 3)
    specular_color: Tensor  # (N, 3)
    location: Tensor  # (N, 3)

    def __init__(
        self,
        ambient_color: Tensor | Sequence = _AMBIENT,
        diffuse_color: Tensor | Sequence = _DIFFUSE,
        specular_color: Tensor | Sequence = _SPECULAR,
        location: Tensor | Sequence = ((0, 1, 0),),
        device: Device = "cpu",
    ) -> None:
        """Broadcast all arguments to one batch.

        Args:
            ambient_color: (N, 3) light that reaches every surface alike.
            diffuse_color: (N, 3) light that is scattered.
            specular_color: (N, 3) light that is mirrored.
            location: (N, 3) of the light in world coordinates.
            device: where the tensors live.

        Raises:
            ValueError: an argument whose last dimension is not 3.
        """
        super().__init__(
            device=device,
            ambient_color=ambient_color,
            diffuse_color=diffuse_color,
            specular_color=specular_color,
            location=location,
        )
        _check_triples(self, "ambient_color", "diffuse_color", "specular_color", "location")

    def clone(self) -> "PointLights":  # type: ignore[override]
        """A copy with its own tensors."""
        return super().clone(type(self)(device=self.device))

    def reshape_location(self, points: Tensor) -> Tensor:
        """The locations, shaped (N, 1, ..., 3) to broadcast against points (N, ..., 3)."""
        return per_image(self.location, points.ndim)

    def diffuse(self, normals: Tensor, points: Tensor) -> Tensor:
        """The diffuse term at points (N, ..., 3) with normals (N, ..., 3)."""
        return diffuse(normals, self.diffuse_color, self.reshape_location(points) - points)

    def specular(self, normals: Tensor, points: Tensor, camera_position: Tensor, shininess: Tensor) -> Tensor:
        """The specular term; arguments as of the function `specular`."""
        direction = self.reshape_location(points) - points
        return specular(points, normals, direction, self.specular_color, camera_position, shininess)


class AmbientLights(TensorProperties):
    """Light without a direction: surfaces show their texture, unshaded."""

    ambient_color: Tensor  # (N, C)

    def __init__(self, *, ambient_color: Tensor | Sequence | None = None, device: Device = "cpu") -> None:
        """Take (N, C) colours, white when None; C other than 3 serves textures that are not colours."""
        super().__init__(device=device, ambient_color=((1.0, 1.0, 1.0),) if ambient_color is None else ambient_color)

    def clone(self) -> "AmbientLights":  # type: ignore[override]
        """A copy with its own tensors."""
        return super().clone(type(self)(device=self.device))

    def diffuse(self, normals: Tensor, points: Tensor) -> Tensor:
        """Zeros (N, ..., C)."""
        return self._zeros(points)

    def specular(self, normals: Tensor, points: Tensor, camera_position: Tensor, shininess: Tensor) -> Tensor:
        """Zeros (N, ..., C)."""
        return self._zeros(points)

    def _zeros(self, points: Tensor) -> Tensor:
        return points.new_zeros(*points.shape[:-1], self.ambient_color.shape[-1])


def _check_triples(lights: TensorProperties, *names: str) -> None:
    for name in names:
        value = getattr(lights, name)
        if value.shape[-1] != 3:
            raise ValueError(f"Expected {name} to have shape (N, 3); got {tuple(value.shape)}")
