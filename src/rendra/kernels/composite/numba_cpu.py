"""Compositing of samples along rays on the CPU: the fast twin of `reference.py`, and its derivative.

A ray owns its samples and belongs to one thread. Transmittance is carried in float64, on purpose: factors so close
to 1 that float32 rounds them all the same way would bend it. See README.md for the recurrences.
"""

import numpy as np
from numba import prange

from rendra.kernels.geometry import ONE, ZERO, exponential
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_RAYS_AT_ONCE = 64
_NOTHING = 1e-30  # transmittance that counts as none, before float32 loses its digits and its speed
_THIN = np.float32(0.5)  # optical thickness below which the opacity is summed as a series
_I2, _I3, _I4, _I5, _I6, _I7, _I8, _I9 = (np.float32(1.0 / k) for k in range(2, 10))
_NONE = np.empty(0, np.float32)


Packed = tuple[np.ndarray, np.ndarray | None, np.ndarray, np.ndarray]
"""Values (M,), deltas (M,) where the values are densities, features (M, C), positions (M,)."""


def forward(packed: Packed, ray_first: np.ndarray, stop_below: float, outputs: tuple[np.ndarray, ...]) -> None:
    """Write features (R, C), opacity (R,), depth (R,) and weights (M,)."""
    samples, by_density, stop = _arguments(packed, stop_below)
    _composite(*samples, ray_first, by_density, stop, num_threads(), *outputs)


def backward(
    packed: Packed,
    ray_first: np.ndarray,
    weights: np.ndarray,
    stop_below: float,
    upstream: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None],
    grads: tuple[np.ndarray, ...],
) -> None:
    """Write the gradients of values (M,), deltas, features (M, C) and positions; some may be empty: not asked for."""
    samples, by_density, stop = _arguments(packed, stop_below)
    grad_weights = _NONE if upstream[3] is None else upstream[3]
    _differentiate(samples, weights, ray_first, by_density, stop, num_threads(), (*upstream[:3], grad_weights), grads)


def _arguments(packed: Packed, stop_below: float) -> tuple[tuple[np.ndarray, ...], bool, float]:
    values, deltas, features, positions = packed
    if deltas is None:
        return (values, _NONE, features, positions), False, stop_below
    return (values, deltas, features, positions), True, max(stop_below, _NOTHING)


@scalar_kernel
def opacity_of(x):
    """1 - exp(-x) in float32, to 2e-7 relative also where x is tiny."""
    series = x * (ONE - _I2 * x * (ONE - _I3 * x * (ONE - _I4 * x * (ONE - _I5 * x * (ONE - _I6 * x * (
        ONE - _I7 * x * (ONE - _I8 * x * (ONE - _I9 * x))))))))  # fmt: skip
    return series if abs(x) < _THIN else ONE - exponential(-x)


@scalar_kernel
def _past(clear, alpha):
    """Transmittance behind a sample."""
    clear *= 1.0 - np.float64(alpha)
    return clear if abs(clear) > _NOTHING else 0.0


@scalar_kernel
def _weigh(values, deltas, by_density, stop, first, end, weights):
    """Weights of one ray's samples, and its opacity."""
    thickness, clear, before = 0.0, 1.0, ONE
    for m in range(first, end):
        if before < stop:
            weights[m:end] = ZERO
            break
        if by_density:
            x = values[m] * deltas[m]
            weights[m] = before * opacity_of(x)
            thickness += np.float64(x)
            before = exponential(-np.float32(thickness))
        else:
            weights[m] = before * values[m]
            clear = _past(clear, values[m])
            before = np.float32(clear)
    return opacity_of(np.float32(thickness)) if by_density else np.float32(1.0 - clear)


@parallel_kernel
def _composite(
    values, deltas, features, positions, ray_first, by_density, stop, workers, out, opacity, depth, weights
):
    num_rays, channels = out.shape
    for worker in prange(workers):
        for block in range(worker, (num_rays + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE, workers):
            for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, num_rays)):
                first, end = ray_first[r], ray_first[r + 1]
                opacity[r] = _weigh(values, deltas, by_density, stop, first, end, weights)
                distance = ZERO
                for m in range(first, end):
                    distance += weights[m] * positions[m]
                depth[r] = distance
                if channels == 3:
                    red, green, blue = ZERO, ZERO, ZERO
                    for m in range(first, end):
                        red += weights[m] * features[m, 0]
                        green += weights[m] * features[m, 1]
                        blue += weights[m] * features[m, 2]
                    out[r, 0], out[r, 1], out[r, 2] = red, green, blue
                    continue
                for c in range(channels):
                    out[r, c] = ZERO
                for m in range(first, end):
                    for c in range(channels):
                        out[r, c] += weights[m] * features[m, c]


@scalar_kernel
def _transmit(values, deltas, by_density, stop, first, end, clears):
    """Transmittance before (of opacities) or behind (of densities) each sample of a ray; returns where it ends."""
    thickness, clear, before = 0.0, 1.0, ONE
    for m in range(first, end):
        if before < stop:
            clears[m:end] = ZERO
            return m
        if by_density:
            thickness += np.float64(values[m] * deltas[m])
            before = exponential(-np.float32(thickness))
            clears[m] = before
        else:
            clears[m] = before
            clear = _past(clear, values[m])
            before = np.float32(clear)
    return end


@scalar_kernel
def _worths(features, positions, grad_out, grad_opacity, grad_depth, grad_weights, r, first, end, worths):
    """How much the loss grows with the weight of each sample [first, end) of ray r."""
    if features.shape[1] == 3:
        red, green, blue = grad_out[r, 0], grad_out[r, 1], grad_out[r, 2]
        for m in range(first, end):
            worths[m - first] = red * features[m, 0] + green * features[m, 1] + blue * features[m, 2]
    else:
        for m in range(first, end):
            total = ZERO
            for c in range(features.shape[1]):
                total += features[m, c] * grad_out[r, c]
            worths[m - first] = total
    for m in range(first, end):
        worths[m - first] += grad_opacity[r] + grad_depth[r] * positions[m]
    if len(grad_weights):
        for m in range(first, end):
            worths[m - first] += grad_weights[m]


@scalar_kernel
def _slopes_of_alphas(alphas, first, end, worths, grads):
    """From the last sample to the first; `grads` holds their transmittance and gets their gradients."""
    behind = ZERO
    for m in range(end - 1, first - 1, -1):
        worth = worths[m - first]
        grads[m] *= worth - behind
        behind += alphas[m] * (worth - behind)


@scalar_kernel
def _slopes_of_densities(densities, deltas, first, end, worths, grads, grad_deltas):
    """The same; `grads` holds the transmittance behind each sample."""
    behind = ZERO
    for m in range(end - 1, first - 1, -1):
        worth = worths[m - first]
        slope = grads[m] * (worth - behind)
        grads[m] = slope * deltas[m]
        if len(grad_deltas):
            grad_deltas[m] = slope * densities[m]
        behind += opacity_of(densities[m] * deltas[m]) * (worth - behind)


@scalar_kernel
def _longest(ray_first):
    longest = 0
    for r in range(len(ray_first) - 1):
        longest = max(longest, ray_first[r + 1] - ray_first[r])
    return longest


@parallel_kernel
def _differentiate(samples, weights, ray_first, by_density, stop, workers, upstream, grads):
    values, deltas, features, positions = samples
    grad_out, grad_opacity, grad_depth, grad_weights = upstream
    grad_values, grad_deltas, grad_features, grad_positions = grads
    num_rays, channels = grad_out.shape
    longest = _longest(ray_first)
    for worker in prange(workers):
        worths = np.empty(longest, np.float32)
        for block in range(worker, (num_rays + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE, workers):
            for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, num_rays)):
                first, end = ray_first[r], ray_first[r + 1]
                last = _transmit(values, deltas, by_density, stop, first, end, grad_values)
                _worths(features, positions, grad_out, grad_opacity, grad_depth, grad_weights, r, first, last, worths)
                if by_density:
                    _slopes_of_densities(values, deltas, first, last, worths, grad_values, grad_deltas)
                else:
                    _slopes_of_alphas(values, first, last, worths, grad_values)
                for m in range(first, end):
                    for c in range(channels):
                        grad_features[m, c] = weights[m] * grad_out[r, c]
                if len(grad_deltas):
                    grad_deltas[last:end] = ZERO
                if len(grad_positions):
                    for m in range(first, end):
                        grad_positions[m] = weights[m] * grad_depth[r]


def visible(alphas: np.ndarray, ray_first: np.ndarray, threshold: float, mask: np.ndarray) -> None:
    """Write whether each sample (M,) is seen."""
    _see(alphas, ray_first, max(threshold, 0.0), num_threads(), mask)


@parallel_kernel
def _see(alphas, ray_first, threshold, workers, mask):
    num_rays = len(ray_first) - 1
    for worker in prange(workers):
        for block in range(worker, (num_rays + _RAYS_AT_ONCE - 1) // _RAYS_AT_ONCE, workers):
            for r in range(block * _RAYS_AT_ONCE, min((block + 1) * _RAYS_AT_ONCE, num_rays)):
                clear = 1.0
                for m in range(ray_first[r], ray_first[r + 1]):
                    mask[m] = clear >= threshold
                    clear = _past(clear, alphas[m])
