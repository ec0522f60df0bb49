"""From K coloured layers a pixel to one: hard, by silhouette, and by softmax over depth.

Liu et al., "Soft Rasterizer: A differentiable renderer for image-based 3D reasoning", ICCV 2019,
arXiv:1904.01786; equation numbers refer to it. A layer at signed squared distance d (NDC, negative inside)
covers its pixel with probability p = sigmoid(-d / sigma), Eq. 1.

Notation: N images, H x W pixels, K layers, C channels, P pixels that any face covers.
"""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor

from rendra.renderer.batching import Compaction

_EPS = 1e-10  # normalised depth and weight of the background


class BlendParams(NamedTuple):
    """How layers blend.

    sigma: width of an edge, in squared NDC: the coverage falls from 1 to 0 over a few sigma. > 0
    gamma: how sharply near layers win over far ones, in normalised depth; towards 0 the nearest alone. > 0
    background_color: (C,) colour where no face is.
    """

    sigma: float = 1e-4
    gamma: float = 1e-4
    background_color: Tensor | Sequence[float] = (1.0, 1.0, 1.0)


class Layers(Protocol):
    """What blending reads from the fragments of a rasteriser."""

    @property
    def pix_to_face(self) -> Tensor:
        """(N, H, W, K), negative where empty."""

    @property
    def zbuf(self) -> Tensor:
        """(N, H, W, K), view depth."""

    @property
    def dists(self) -> Tensor:
        """(N, H, W, K), signed squared NDC distance."""


def background_color(blend_params: BlendParams, like: Tensor) -> Tensor:
    """The background as a (C,) tensor beside colours `like` (..., C).

    Raises:
        ValueError: it has another number of channels than the colours.
    """
    color = torch.as_tensor(blend_params.background_color, dtype=like.dtype, device=like.device)
    if color.shape != like.shape[-1:]:
        raise ValueError(
            f"background_color must hold {like.shape[-1]} numbers, as the colours do; got shape {tuple(color.shape)}"
        )
    return color


def hard_rgb_blend(colors: Tensor, fragments: Layers, blend_params: BlendParams) -> Tensor:
    """The colour of the nearest layer, the background where there is none; alpha is 1 or 0.

    Args:
        colors: (N, H, W, K, C).
        fragments: of the same N, H, W, K.
        blend_params: its background is used.

    Returns:
        (N, H, W, C + 1).
    """
    covered = fragments.pix_to_face[..., :1] >= 0
    pixels = torch.where(covered, colors[..., 0, :], background_color(blend_params, colors))
    return torch.cat((pixels, covered.to(colors.dtype)), dim=-1)


def sigmoid_alpha_blend(colors: Tensor, fragments: Layers, blend_params: BlendParams) -> Tensor:
    """Alpha is the probability that any layer covers the pixel, 1 - prod_k (1 - p_k), Eq. 3.

    Args:
        colors: (N, H, W, K, C); those of the nearest layer are passed on, background included.
        fragments: of the same N, H, W, K.
        blend_params: its sigma is used.

    Returns:
        (N, H, W, C + 1).
    """
    mask, (dists,), covered = _covered(fragments.pix_to_face, fragments.dists)
    alpha = _union(_log_transparency(mask, dists, blend_params.sigma))
    alpha = covered.put(alpha).view(fragments.pix_to_face.shape[:-1])
    return torch.cat((colors[..., 0, :], alpha[..., None]), dim=-1)


def softmax_rgb_blend(
    colors: Tensor,
    fragments: Layers,
    blend_params: BlendParams,
    znear: float | Tensor = 1.0,
    zfar: float | Tensor = 100,
) -> Tensor:
    """Colours weighted by coverage and nearness, Eq. 2: w_k ~ p_k exp(z'_k / gamma), background at z' = 1e-10.

    z' = (zfar - z) / (zfar - znear) is 1 at the near plane and 0 at the far one.

    Args:
        colors: (N, H, W, K, C).
        fragments: of the same N, H, W, K.
        blend_params: sigma, gamma and background.
        znear, zfar: view depths of the planes, a number or (N,); those of the camera.

    Returns:
        (N, H, W, C + 1); alpha as in `sigmoid_alpha_blend`.
    """
    background = background_color(blend_params, colors)
    mask, (dists, zbuf, colors), covered = _covered(fragments.pix_to_face, fragments.dists, fragments.zbuf, colors)
    log_transparency = _log_transparency(mask, dists, blend_params.sigma)
    nearness = _nearness(zbuf, znear, zfar, covered)
    weights, rest = _softmax_weights(mask, dists, log_transparency, nearness, blend_params)
    blended = _weighted_mean(weights, colors, rest, background)
    pixels = torch.cat((blended, _union(log_transparency)[:, None]), dim=-1)
    image = covered.put(pixels, torch.cat((background, background.new_zeros(1))))
    return image.view(*fragments.pix_to_face.shape[:-1], pixels.shape[-1])


def softmax_depth_blend(
    fragments: Layers, blend_params: BlendParams, znear: float | Tensor = 1.0, zfar: float | Tensor = 100
) -> Tensor:
    """View depth blended with the weights of `softmax_rgb_blend`; the background lies at `zfar`.

    Returns:
        (N, H, W, 1).
    """
    mask, (dists, zbuf), covered = _covered(fragments.pix_to_face, fragments.dists, fragments.zbuf)
    log_transparency = _log_transparency(mask, dists, blend_params.sigma)
    nearness = _nearness(zbuf, znear, zfar, covered)
    weights, rest = _softmax_weights(mask, dists, log_transparency, nearness, blend_params)
    far = torch.as_tensor(zfar, dtype=zbuf.dtype, device=zbuf.device).reshape(-1, 1, 1)
    far = far.expand(covered.num_images, covered.num_entries, 1)
    depth = _weighted_mean(weights, zbuf[..., None], rest, covered.take(far))
    return covered.put(depth, far).view(*fragments.pix_to_face.shape[:-1], 1)


def _covered(pix_to_face: Tensor, *layers: Tensor) -> tuple[Tensor, list[Tensor], Compaction]:
    """Bring (N, H, W, K, ...) layers to the pixels (P, K, ...) that hold a face, and the mask of their slots."""
    covered = Compaction((pix_to_face.amax(-1) >= 0).flatten(1))
    mask = covered.take(pix_to_face.flatten(1, 2)) >= 0
    return mask, [covered.take(layer.flatten(1, 2)) for layer in layers], covered


def _log_transparency(mask: Tensor, dists: Tensor, sigma: float) -> Tensor:
    """log(1 - p_k) as (P, K): a sum of these neither vanishes nor stops the gradient as a product would."""
    return F.logsigmoid(dists / sigma).masked_fill(~mask, 0.0)


def _union(log_transparency: Tensor) -> Tensor:
    """1 - prod_k (1 - p_k), as (P,)."""
    return -torch.expm1(log_transparency.sum(-1))


def _nearness(zbuf: Tensor, znear: float | Tensor, zfar: float | Tensor, covered: Compaction) -> Tensor:
    """Depths (P, K) as z', with planes that may differ from image to image."""
    near, far = (_plane(plane, zbuf, covered) for plane in (znear, zfar))
    return (far - zbuf) / (far - near)


def _plane(plane: float | Tensor, zbuf: Tensor, covered: Compaction) -> float | Tensor:
    if not isinstance(plane, Tensor):
        return plane
    plane = plane.to(zbuf).reshape(-1)
    return plane if len(plane) == 1 else torch.repeat_interleave(plane, covered.counts)[:, None]


def _softmax_weights(
    mask: Tensor, dists: Tensor, log_transparency: Tensor, nearness: Tensor, blend_params: BlendParams
) -> tuple[Tensor, Tensor]:
    """Weights (P, K) of the layers and (P, 1) of the background, relative to the nearest layer's."""
    nearness = nearness.masked_fill(~mask, 0.0)
    nearest = nearness.amax(-1, keepdim=True).clamp(min=_EPS)
    log_coverage = log_transparency - dists / blend_params.sigma  # log p = log(1 - p) - d / sigma
    log_weights = log_coverage + (nearness - nearest) / blend_params.gamma
    weights = log_weights.masked_fill(~mask, -torch.inf).exp()
    background = ((_EPS - nearest) / blend_params.gamma).exp().clamp(min=_EPS)
    return weights, background


def _weighted_mean(weights: Tensor, values: Tensor, rest: Tensor, background: Tensor) -> Tensor:
    """Mean (P, C) of values (P, K, C) and the background."""
    total = (weights[:, None] @ values)[:, 0] + rest * background
    return total / (weights.sum(-1, keepdim=True) + rest)
