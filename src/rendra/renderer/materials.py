"""What a surface does with light: the reflectances and shininess of the Phong model."""

from collections.abc import Sequence

import torch
from torch import Tensor

from rendra.common.datatypes import Device
from rendra.renderer.utils import TensorProperties

_WHITE = ((1.0, 1.0, 1.0),)


class Materials(TensorProperties):
    """Reflectance of the surfaces of a batch, one material for each mesh or one for all."""

    ambient_color: Tensor  # (N, 3)
    diffuse_color: Tensor  # (N, 3)
    specular_color: Tensor  # (N, 3)
    shininess: Tensor  # (N,)

    def __init__(
        self,
        ambient_color: Tensor | Sequence = _WHITE,
        diffuse_color: Tensor | Sequence = _WHITE,
        specular_color: Tensor | Sequence = _WHITE,
        shininess: Tensor | Sequence | float = 64,
        device: Device = "cpu",
    ) -> None:
        """Broadcast all arguments to one batch.

        Args:
            ambient_color: (N, 3) share of ambient light that is sent back, RGB.
            diffuse_color: (N, 3) share of diffuse light, multiplied by the texture.
            specular_color: (N, 3) share of light in the highlights, which no texture tints.
            shininess: (N,) exponent of the highlight; the larger, the smaller and sharper.
            device: where the tensors live.

        Raises:
            ValueError: a colour is not (N, 3), or shininess not (N,).
        """
        super().__init__(
            device=device,
            diffuse_color=diffuse_color,
            ambient_color=ambient_color,
            specular_color=specular_color,
            shininess=shininess,
        )
        for name in ("ambient_color", "diffuse_color", "specular_color"):
            value = getattr(self, name)
            if value.shape[-1] != 3:
                raise ValueError(f"Expected {name} to have shape (N, 3); got {tuple(value.shape)}")
        if self.shininess.shape != torch.Size([self._N]):
            raise ValueError(f"Expected shininess to have shape (N,); got {tuple(self.shininess.shape)}")

    def clone(self) -> "Materials":  # type: ignore[override]
        """A copy with its own tensors."""
        return super().clone(type(self)(device=self.device))
