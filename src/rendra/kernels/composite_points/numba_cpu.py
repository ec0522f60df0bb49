"""Compositing of lists of points on the CPU: the fast twin of `reference.py`.

Forward, and gradients of opacities: a list belongs to one thread. Gradients of features: each of a number of chunks
of lists, which depends on sizes alone, sums into a buffer of its own.
"""

import numpy as np
from numba import prange

from rendra.kernels.geometry import ONE, ZERO
from rendra.kernels.parallel import num_threads, parallel_kernel, scalar_kernel

_ALPHA, _NORM = 0, 2  # places in MODES; between them lies the plain sum
_NORM_EPS = np.float32(1e-4)
_LISTS_AT_ONCE = 64  # are dealt out to threads and chunks together
_CHUNKS = 8
_CHUNK_FLOATS = 2**24  # of all chunks together, but for the two that there always are


def forward(idx: np.ndarray, alphas: np.ndarray, features: np.ndarray, mode: int, out: np.ndarray) -> None:
    """Write the features (Q, C) of each list."""
    _compose(idx, alphas, features, mode, num_threads(), out)


@parallel_kernel
def _compose(idx, alphas, features, mode, workers, out):
    lists, layers = idx.shape
    channels = features.shape[1]
    for worker in prange(workers):
        weights = np.empty(layers, np.float32)
        for block in range(worker, (lists + _LISTS_AT_ONCE - 1) // _LISTS_AT_ONCE, workers):
            for q in range(block * _LISTS_AT_ONCE, min((block + 1) * _LISTS_AT_ONCE, lists)):
                _weigh(idx, alphas, q, mode, weights)
                for c in range(channels):
                    out[q, c] = ZERO
                for k in range(layers):
                    p = idx[q, k]
                    if p >= 0:
                        for c in range(channels):
                            out[q, c] += weights[k] * features[p, c]


@scalar_kernel
def _weigh(idx, alphas, q, mode, weights):
    """Weights of the slots of list q that hold a point; returns what the opacities were divided by."""
    total, clear = ZERO, ONE
    for k in range(idx.shape[1]):
        if idx[q, k] >= 0:
            weights[k] = alphas[q, k] * clear
            total += alphas[q, k]
            if mode == _ALPHA:
                clear *= ONE - alphas[q, k]
    total = max(total, _NORM_EPS) if mode == _NORM else ONE
    if mode == _NORM:
        for k in range(idx.shape[1]):
            weights[k] /= total
    return total


def backward(
    idx: np.ndarray, alphas: np.ndarray, features: np.ndarray, out: np.ndarray, grad_out: np.ndarray, mode: int
) -> tuple[np.ndarray, np.ndarray]:
    """Gradients of alphas (Q, K) and features (P, C)."""
    grad_alphas = np.empty_like(alphas)
    chunks = min(_CHUNKS, max(2, _CHUNK_FLOATS // max(1, features.size)))
    partial = np.zeros((chunks, *features.shape), np.float32)
    _differentiate(idx, alphas, features, out, grad_out, mode, num_threads(), grad_alphas, partial)
    return grad_alphas, partial.sum(axis=0)


@parallel_kernel
def _differentiate(idx, alphas, features, out, grad_out, mode, workers, grad_alphas, partial):
    lists, layers = idx.shape
    channels = features.shape[1]
    chunks = partial.shape[0]
    for worker in prange(workers):
        weights = np.empty(layers, np.float32)
        for chunk in range(worker, chunks, workers):
            for block in range(chunk, (lists + _LISTS_AT_ONCE - 1) // _LISTS_AT_ONCE, chunks):
                for q in range(block * _LISTS_AT_ONCE, min((block + 1) * _LISTS_AT_ONCE, lists)):
                    total = _weigh(idx, alphas, q, mode, weights)
                    for k in range(layers):
                        p = idx[q, k]
                        worth = ZERO
                        if p >= 0:
                            for c in range(channels):
                                worth += grad_out[q, c] * features[p, c]
                                partial[chunk, p, c] += weights[k] * grad_out[q, c]
                        grad_alphas[q, k] = worth
                    if mode == _ALPHA:
                        _slopes_of_over(idx, alphas, q, grad_alphas)
                    elif mode == _NORM:
                        _slopes_of_mean(idx, out, grad_out, q, total, grad_alphas)


@scalar_kernel
def _slopes_of_over(idx, alphas, q, grad_alphas):
    """From the worths of the slots of list q to gradients of their opacities, in place; the README derives it."""
    behind = ZERO
    for k in range(idx.shape[1] - 1, -1, -1):
        if idx[q, k] >= 0:
            worth = grad_alphas[q, k]
            grad_alphas[q, k] = worth - behind
            behind += alphas[q, k] * (worth - behind)
    clear = ONE
    for k in range(idx.shape[1]):
        if idx[q, k] >= 0:
            grad_alphas[q, k] *= clear
            clear *= ONE - alphas[q, k]


@scalar_kernel
def _slopes_of_mean(idx, out, grad_out, q, total, grad_alphas):
    """The same for opacities that were divided by their sum; a sum at its floor does not move."""
    mean = ZERO
    if total > _NORM_EPS:
        for c in range(grad_out.shape[1]):
            mean += grad_out[q, c] * out[q, c]
    for k in range(idx.shape[1]):
        if idx[q, k] >= 0:
            grad_alphas[q, k] = (grad_alphas[q, k] - mean) / total
