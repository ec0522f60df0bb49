"""Radiance fields that are one network: the book's, and the original NeRF's.

Letters: M points, Q rays, C width of the network.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.checkpoint import checkpoint

from rendra.kernels.composite import alphas_of
from rendra_lab.errors import UserError
from rendra_lab.settings import Amount, Count, Positive
from rendra_lab.tasks.nerf.fields import RadianceField


class MLPField(RadianceField):
    """A network from a point to matter and features, and one from features and direction to light.

    The first colour layer is linear in what it is told of the direction; that half of it is done once a ray.

    Args:
        chunk: points at a time. With gradients the network's values are then made again in the backward pass:
            memory for one chunk, a third more work.
    """

    def __init__(self, chunk: int) -> None:
        super().__init__()
        if chunk < 1:
            raise UserError(f"field.chunk must be at least 1, got {chunk}")
        self.chunk = chunk

    @abstractmethod
    def _matter(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Of points (M, 3): matter (M,) as `_alpha` takes it, and features (M, C)."""

    @abstractmethod
    def _aim(self, directions: Tensor) -> Tensor:
        """What directions (Q, 3) add to the first colour layer."""

    @abstractmethod
    def _light(self, features: Tensor, aim: Tensor) -> Tensor:
        """The light (M, 3) of features (M, C), against rays with `_aim` of each point."""

    @abstractmethod
    def _alpha(self, matter: Tensor, steps: Tensor) -> Tensor:
        """Opacities (M,) of samples of matter (M,) with lengths (M,)."""

    def forward(
        self, points: Tensor, directions: Tensor, steps: Tensor, ray_index: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Opacity and light: see `RadianceField`."""
        if ray_index is None:
            matter, rgb = self._in_chunks(lambda at, along: self._sample(at, self._aim(along)), points, directions)
        else:
            aim = self._aim(directions)
            matter, rgb = self._in_chunks(
                lambda at, ray: self._sample(at, aim.index_select(0, ray)), points, ray_index
            )
        return self._alpha(matter, steps), rgb

    def opacity(self, points: Tensor, steps: Tensor) -> Tensor:
        """The opacities alone: see `RadianceField`."""
        (matter,) = self._in_chunks(lambda at: self._matter(at)[:1], points)
        return self._alpha(matter, steps)

    def _sample(self, points: Tensor, aim: Tensor) -> tuple[Tensor, Tensor]:
        matter, features = self._matter(points)
        return matter, self._light(features, aim)

    def _in_chunks(self, network: Callable[..., tuple[Tensor, ...]], *inputs: Tensor) -> tuple[Tensor, ...]:
        """The network's outputs, its inputs (M, ...) taken a chunk at a time."""
        if len(inputs[0]) <= self.chunk:
            return network(*inputs)
        chunks = zip(*(rows.split(self.chunk) for rows in inputs), strict=True)
        if torch.is_grad_enabled():
            again: dict[str, Any] = {"use_reentrant": False, "preserve_rng_state": False}
            parts = [checkpoint(network, *chunk, **again) for chunk in chunks]
        else:
            parts = [network(*chunk) for chunk in chunks]
        return tuple(torch.cat(column) for column in zip(*parts, strict=True))


class MLPBook(MLPField):
    """The book's network. Its matter is the opacity of a sample, however long: no density.

    More samples along a ray are therefore another scene: render with as many as in training.
    Points and directions enter as sines, then cosines, at 0.1 * 2^i radians per unit, without the point itself. In
    float32 neighbouring arguments of the upper half of 60 frequencies (i >= 29) differ by more than 2 pi: those
    features are noise, the same for the same point, as they are in the book.

    Args:
        width: C.
        frequencies: of the embedding.
        chunk: see `MLPField`.
    """

    is_density = False
    frequencies: Tensor

    def __init__(self, width: Positive = 256, frequencies: Count = 60, chunk: int = 1 << 15) -> None:
        super().__init__(chunk)
        self.register_buffer("frequencies", 0.1 * 2.0 ** torch.arange(frequencies), persistent=False)
        waves = 2 * 3 * frequencies
        self.trunk = nn.Sequential(nn.Linear(waves, width), _softplus(), nn.Linear(width, width), _softplus())
        self.density = nn.Linear(width, 1)
        nn.init.constant_(self.density.bias, -1.5)  # thin matter at first: light reaches every sample
        self.color = nn.Linear(width + waves, width)
        self.rgb = nn.Linear(width, 3)

    def _matter(self, points: Tensor) -> tuple[Tensor, Tensor]:
        features = self.trunk(self._waves(points))
        return F.softplus(self.density(features)[:, 0], beta=10), features

    def _aim(self, directions: Tensor) -> Tensor:
        width = self.trunk[-2].out_features
        return F.linear(self._waves(directions), self.color.weight[:, width:], self.color.bias)

    def _light(self, features: Tensor, aim: Tensor) -> Tensor:
        hidden = F.linear(features, self.color.weight[:, : features.shape[1]]) + aim
        return self.rgb(F.softplus(hidden, beta=10)).sigmoid()

    def _alpha(self, matter: Tensor, steps: Tensor) -> Tensor:
        return -torch.expm1(-matter)

    def _waves(self, x: Tensor) -> Tensor:
        angles = (x[..., None] * self.frequencies).flatten(-2)
        return torch.cat([angles.sin(), angles.cos()], dim=-1)


class MLPOriginal(MLPField):
    """The network of Mildenhall et al., "NeRF", ECCV 2020, Fig. 7. Its matter is a density.

    As in their code the encoding begins with the input itself and its frequencies are 2^i, without pi. The density
    starts thin and above 0 everywhere: a ReLU that is 0 everywhere never learns, and theirs is with some seeds.

    Args:
        width: C; the last colour layer has half of it.
        depth: layers before the density.
        skip: index of the layer after which the encoded point enters again; None: it does not.
        frequencies: of points.
        direction_frequencies: of directions.
        noise_std: of noise added to the density in training, before its ReLU; against floating haze.
        normalize: map the longest side of the box to [-1, 1], as the paper does; density is then per half of that
            side. False takes world coordinates, as their code does.
        chunk: see `MLPField`.
    """

    def __init__(
        self,
        width: Positive = 256,
        depth: Positive = 8,
        skip: int | None = 4,
        frequencies: Count = 10,
        direction_frequencies: Count = 4,
        noise_std: Amount = 0.0,
        normalize: bool = True,
        chunk: int = 1 << 15,
    ) -> None:
        super().__init__(chunk)
        if skip is not None and not 0 <= skip < depth - 1:
            raise UserError(f"field.skip must be null or the index of a layer before the last of {depth}, got {skip}")
        self.width, self.skip = width, skip
        self.frequencies, self.direction_frequencies = frequencies, direction_frequencies
        self.noise_std, self.normalize = noise_std, normalize
        encoded = 3 + 6 * frequencies
        inputs = [encoded] + [width + encoded * (skip is not None and i == skip + 1) for i in range(1, depth)]
        self.trunk = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.density = nn.Linear(width, 1)
        self.features = nn.Linear(width, width)
        self.color = nn.Linear(width + 3 + 6 * direction_frequencies, width // 2)
        self.rgb = nn.Linear(width // 2, 3)
        nn.init.constant_(self.density.bias, 0.1)  # more than the weights differ by at first

    def _matter(self, points: Tensor) -> tuple[Tensor, Tensor]:
        at = (points - self.box.mean(0)) / self._unit() if self.normalize else points
        encoded = hidden = _encoded(at, self.frequencies)
        for i, layer in enumerate(self.trunk):
            hidden = layer(hidden).relu()
            if i == self.skip:
                hidden = torch.cat([encoded, hidden], dim=1)
        return self.density(hidden)[:, 0], self.features(hidden)

    def _aim(self, directions: Tensor) -> Tensor:
        encoded = _encoded(directions, self.direction_frequencies)
        return F.linear(encoded, self.color.weight[:, self.width :], self.color.bias)

    def _light(self, features: Tensor, aim: Tensor) -> Tensor:
        hidden = F.linear(features, self.color.weight[:, : self.width]) + aim
        return self.rgb(hidden.relu()).sigmoid()

    def _alpha(self, matter: Tensor, steps: Tensor) -> Tensor:
        if self.training and self.noise_std > 0:
            matter = matter + self.noise_std * torch.randn_like(matter)
        lengths = steps / self._unit() if self.normalize else steps
        return alphas_of(matter.relu(), lengths)

    def _unit(self) -> Tensor:
        """Half of the longest side of the box."""
        return (self.box[1] - self.box[0]).amax() / 2


def _softplus() -> nn.Softplus:
    return nn.Softplus(beta=10.0)


def _encoded(x: Tensor, frequencies: int) -> Tensor:
    """(M, 3 + 6 L): x, then sin and cos of 2^i x for each i."""
    angles = x[:, None] * 2.0 ** torch.arange(frequencies, device=x.device, dtype=x.dtype)[:, None]  # (M, L, 3)
    waves = torch.stack([angles.sin(), angles.cos()], dim=2)  # (M, L, 2, 3)
    return torch.cat([x, waves.flatten(1)], dim=1)
