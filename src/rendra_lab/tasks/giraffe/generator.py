"""Pictures of scenes that are made of objects.

Niemeyer and Geiger, "GIRAFFE: Representing Scenes as Compositional Generative Neural Feature Fields", CVPR 2021.
Letters: B pictures, N objects of a scene, P = V V rays of a picture, L pieces of rays, C features.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.settings import Amount
from rendra_lab.tasks.giraffe.box_sampler import BoxSampler, rotation_about_z
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler, Rays
from rendra_lab.tasks.giraffe.feature_fields import FeatureField, FieldValues, Stretches
from rendra_lab.tasks.giraffe.neural_renderer import NeuralRenderer
from rendra_lab.tasks.giraffe.ray_sampling import OwnRays, Pieces, Samples, Sampling, into_boxes
from rendra_lab.tasks.giraffe.records import Codes, MadePictures, Scenes

_AT_ONCE = 16  # samples of the background, before somebody looks what is left to see
_NOTHING = 1e-7  # light that is none beside all of it
_FEW, _MANY = 1024, 1 << 16  # rays at a time: their features fit into a cache, or keep a GPU busy


class CodeSizes(NamedTuple):
    """How many numbers latent codes have, those of shape as those of appearance."""

    object: int  # Z
    background: int  # Zb


class Generator(nn.Module):
    """Objects and a background as feature fields, composed, looked at by few rays, and painted.

    All objects share one field and differ by their codes; each field is evaluated in its own space.

    Args:
        object_field, background_field: with as many features each as the renderer takes.
        renderer: paints.
        sampling: where rays are looked at.
        boxes: draws where objects are.
        cameras: draws who looks, and casts rays.
        density_noise, background_density_noise: standard deviation of what is added to densities, before the ReLU
            and before boxes end, where `forward` is given noise; published: 1.

    Raises:
        UserError: networks that do not fit each other.
    """

    def __init__(
        self,
        object_field: FeatureField,
        background_field: FeatureField,
        renderer: NeuralRenderer,
        sampling: Sampling,
        boxes: BoxSampler,
        cameras: CameraSampler,
        density_noise: Amount = 1.0,
        background_density_noise: Amount = 1.0,
    ) -> None:
        super().__init__()
        made = object_field.features, background_field.features
        if set(made) != {renderer.features}:
            raise UserError(
                f"the renderer takes {renderer.features} features, but the fields of objects and background make "
                f"{made[0]} and {made[1]}"
            )
        self.object_field = object_field
        self.background_field = background_field
        self.renderer = renderer
        self.sampling = sampling
        self.boxes = boxes
        self.cameras = cameras
        self.density_noise, self.background_density_noise = density_noise, background_density_noise

    @property
    def picture_side(self) -> int:
        """S."""
        return self.renderer.picture_side

    @property
    def feature_side(self) -> int:
        """V."""
        return self.renderer.feature_side

    @property
    def objects(self) -> int:
        """N."""
        return self.boxes.objects

    @property
    def code_sizes(self) -> CodeSizes:
        """Z and Zb."""
        return CodeSizes(self.object_field.code, self.background_field.code)

    def sample(self, count: int, generator: torch.Generator, temperature: float = 1.0) -> Scenes:
        """B = `count` scenes as training sees them, on this network's device.

        Args:
            count: scenes.
            generator: of all that is random; drawn from on its own device.
            temperature: standard deviation of the codes; published pictures: 0.65.
        """
        like = self.object_field.out.weight
        Z, Zb = self.code_sizes
        shapes = (count, self.objects, Z), (count, self.objects, Z), (count, Zb), (count, Zb)
        codes = [temperature * torch.randn(shape, generator=generator, device=generator.device) for shape in shapes]
        boxes = self.boxes.sample(count, generator)
        cameras = self.cameras.sample(count, generator)
        boxes = replace(
            boxes.to(like.device),
            **{name: getattr(boxes, name).to(like) for name in ("scale", "translation", "rotation")},
        )
        return Scenes(Codes(*codes).to(like), boxes, cameras.to(like))

    def forward(self, scenes: Scenes, noise: torch.Generator | None = None) -> MadePictures:
        """Pictures, and the shares of things in them.

        Args:
            scenes: what to show.
            noise: draws noise of densities and depths, as in training; None: neither. What is drawn for whom hangs on
                whether gradients are wanted.
        """
        parts = []
        for part in self._parts(scenes):
            features, shares = self._look(part, noise)
            parts.append((self.renderer(features), shares))
        pictures, shares = (torch.cat(each) for each in zip(*parts, strict=True))
        return MadePictures(pictures, shares)

    def feature_image(self, scenes: Scenes) -> Float[Tensor, "B C V V"]:
        """What the neural renderer is given."""
        return torch.cat([self._look(part, None)[0] for part in self._parts(scenes)])

    def alpha_maps(self, scenes: Scenes) -> Float[Tensor, "B T V V"]:
        """Opacity of each object, and last of the background, as if it were alone in the world; a wall is opaque."""
        rays, own = self._rays(scenes)
        samples = self.sampling.samples(rays, own, scenes.boxes.exists, None)
        objects = self._objects(scenes, own, samples.objects, None)
        background = self._background(scenes, rays, samples.background, None)
        nobody = torch.zeros_like(objects.density)
        walled = self.sampling.weights(samples, nobody, background.density)[1].sum(1)
        return self._maps(samples, self.sampling.alone(samples.objects, objects.density), walled, scenes)

    def _parts(self, scenes: Scenes) -> list[Scenes]:
        """As many at once as near memory holds without gradients, which need all at once."""
        if torch.is_grad_enabled() or scenes.batch_size < 2:
            return [scenes]
        size = max((_FEW if scenes.codes.shape.device.type == "cpu" else _MANY) // self.feature_side**2, 1)
        return [scenes.rows(slice(first, first + size)) for first in range(0, scenes.batch_size, size)]

    def _look(self, scenes: Scenes, noise: torch.Generator | None) -> tuple[Tensor, Tensor]:
        """The feature image, and the shares of things in it."""
        rays, own = self._rays(scenes)
        samples = self.sampling.samples(rays, own, scenes.boxes.exists, noise)
        objects = self._objects(scenes, own, samples.objects, noise)
        if torch.is_grad_enabled():
            background = self._background(scenes, rays, samples.background, noise)
            of_objects, of_background = self.sampling.weights(samples, objects.density, background.density)
            far = _summed(background.hidden, of_background)
        else:
            of_objects, far = self._in_steps(scenes, rays, samples, objects.density, noise)
        near = _summed(objects.hidden, of_objects)
        features = self.background_field.to_features(*far)
        features = features.index_add(0, samples.objects.ray, self.object_field.to_features(*near))
        shape = scenes.batch_size, self.feature_side, self.feature_side, features.shape[1]
        image = features.view(shape).permute(0, 3, 1, 2).contiguous()
        return image, self._maps(samples, near[1], far[1], scenes)

    def _rays(self, scenes: Scenes) -> tuple[Rays, OwnRays]:
        self._check(scenes)
        rays = self.cameras.rays(scenes.cameras, self.feature_side)
        return rays, into_boxes(rays, scenes.boxes, self.sampling.padding)

    def _objects(self, scenes: Scenes, own: OwnRays, at: Pieces, noise: torch.Generator | None) -> FieldValues:
        """Densities that count, and hidden features, of objects."""
        pixels = own.directions.shape[1]
        directions = own.directions.flatten(0, 1).index_select(0, at.thing * pixels + at.ray % pixels)
        origins = own.origins.index_select(0, at.thing)
        codes = scenes.codes.shape.flatten(0, 1), scenes.codes.appearance.flatten(0, 1)
        raw = self.object_field(Stretches(at.thing, origins, directions, at.depths, at.inside), *codes)
        return _evaluated(raw, self.object_field.density_scale, at, self.density_noise, noise)

    def _background(self, scenes: Scenes, rays: Rays, at: Pieces, noise: torch.Generator | None) -> FieldValues:
        """The same of the background, which turns about z."""
        turn = rotation_about_z(scenes.cameras.background_turn)
        origins = (turn @ rays.origins[..., None]).squeeze(-1).index_select(0, at.thing)
        directions = (rays.directions @ turn.mT).flatten(0, 1).index_select(0, at.ray)
        codes = scenes.codes.background_shape, scenes.codes.background_appearance
        raw = self.background_field(Stretches(at.thing, origins, directions, at.depths, at.inside), *codes)
        return _evaluated(raw, self.background_field.density_scale, at, self.background_density_noise, noise)

    def _in_steps(
        self, scenes: Scenes, rays: Rays, samples: Samples, objects: Tensor, noise: torch.Generator | None
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """The background from near to far, as long as something is left to see of it.

        Returns:
            the weights of the objects' samples, and the background's sums as of `_summed`.
        """
        far = samples.background
        density, sums = torch.zeros_like(far.depths), []
        for first in range(0, far.depths.shape[1], _AT_ONCE):
            these = slice(first, first + _AT_ONCE)
            left = self.sampling.clear(samples, objects, density)[:, these] > _NOTHING
            piece = Pieces(far.ray, far.thing, far.depths[:, these], far.lengths[:, these], left, far.slot[:, these])
            background = self._background(scenes, rays, piece, noise)
            density[:, these] = background.density
            weights = self.sampling.weights(samples, objects, density)
            sums.append(_summed(background.hidden, weights[1][:, these]))
        hidden, shares = (torch.stack(each).sum(0) for each in zip(*sums, strict=True))
        return weights[0], (hidden, shares)

    def _maps(self, samples: Samples, objects: Tensor, background: Tensor, scenes: Scenes) -> Tensor:
        """Numbers of pieces (L,) and of rays (R,) as images (B, N + 1, V, V)."""
        things, side = scenes.boxes.exists.numel(), self.feature_side
        pixels = side * side
        flat = samples.objects.thing * pixels + samples.objects.ray % pixels
        of_objects = objects.new_zeros(things * pixels).index_add(0, flat, objects)
        batch, number = scenes.boxes.exists.shape
        return torch.cat([of_objects.view(batch, number, side, side), background.view(batch, 1, side, side)], 1)

    def _check(self, scenes: Scenes) -> None:
        codes, (Z, Zb) = scenes.codes, self.code_sizes
        if codes.shape.shape[2] != Z or codes.background_shape.shape[1] != Zb:
            raise ValueError(
                f"this generator takes codes of {Z} numbers for objects and {Zb} for the background, got "
                f"{codes.shape.shape[2]} and {codes.background_shape.shape[1]}"
            )


def _summed(hidden: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Hidden features (L, H) of pieces, their samples weighted, and the weights' sums (L,)."""
    return torch.einsum("lkh,lk->lh", hidden, weights), weights.sum(1)


def _evaluated(
    raw: FieldValues, density_scale: float, at: Pieces, deviation: float, noise: torch.Generator | None
) -> FieldValues:
    """Densities that count, of those that a field gives."""
    density = raw.density
    if noise is not None and deviation > 0:
        drawn = torch.randn(density.shape, generator=noise, device=noise.device)
        density = density + deviation * drawn.to(density)
    return FieldValues(density_scale * F.relu(density) * at.inside, raw.hidden)
