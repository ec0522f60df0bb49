"""Linear blend skinning: every vertex goes where the few joints that hold it would take it, on average.

Letters: B bodies, V vertices, J joints, K joints at most that hold one vertex.
Loper et al., "SMPL: A Skinned Multi-Person Linear Model", 2015, Eq. 2 and 3.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from rendra.kernels.skinning import numba_cpu, reference

__all__ = ["SkinWeights", "skin", "skin_weights"]


class SkinWeights(NamedTuple):
    """Which joints hold a vertex, and how much: the weights that are not zero.

    Attributes:
        joints: (V, K) int32; 0 where a vertex is held by fewer.
        weights: (V, K) the largest first, and 0 where a vertex is held by fewer.
    """

    joints: Tensor
    weights: Tensor


def skin_weights(dense: Tensor) -> SkinWeights:
    """The weights (V, J) of all joints without those that are zero; K is as many as some vertex needs, at least 1.

    Raises:
        ValueError: no matrix of floats.
    """
    if dense.ndim != 2 or not dense.is_floating_point() or not dense.shape[1]:
        raise ValueError(f"weights must be floats of shape (V, J), got {dense.dtype} of {tuple(dense.shape)}")
    most = max(1, int((dense != 0).sum(1).max())) if len(dense) else 1
    joints = dense.abs().topk(most, dim=1).indices
    weights = dense.gather(1, joints)
    return SkinWeights(torch.where(weights == 0, 0, joints).int().contiguous(), weights.contiguous())


def skin(verts: Tensor, moves: Tensor, weights: SkinWeights) -> Tensor:
    """Vertices moved by the weighted mean of their joints' transforms; the same on any number of threads.

    Differentiable in verts and moves: of float32 on the CPU once, else as often as you like.

    Args:
        verts: (B, V, 3) at rest.
        moves: (B, J, 3, 4) of each joint from rest to the world, x' = R x + s, with s the last column.
        weights: of a mesh; see `skin_weights`.

    Returns:
        (B, V, 3).

    Raises:
        ValueError: a shape, type, device or joint that cannot be.
    """
    _check(verts, moves, weights)
    if verts.device.type != "cpu" or verts.dtype != torch.float32:
        return reference.skin(verts, moves, *weights)
    return _skin_on_cpu(verts, moves.flatten(2), *weights)


def _check(verts: Tensor, moves: Tensor, weights: SkinWeights) -> None:
    joints, values = weights
    if verts.ndim != 3 or verts.shape[2] != 3 or not verts.is_floating_point():
        raise ValueError(f"verts must be floats of shape (B, V, 3), got {_words(verts)}")
    if moves.ndim != 4 or moves.shape[::2] != (len(verts), 3) or moves.shape[3] != 4 or not moves.shape[1]:
        raise ValueError(f"moves must have shape ({len(verts)}, J, 3, 4) for these bodies, got {_words(moves)}")
    if values.ndim != 2 or len(values) != verts.shape[1] or joints.shape != values.shape:
        raise ValueError(
            f"joints and weights must both have shape ({verts.shape[1]}, K) for these vertices, got {_words(joints)} "
            f"and {_words(values)}"
        )
    if joints.dtype != torch.int32:
        raise ValueError(f"joints must be int32, got {joints.dtype}")
    for name, tensor in (("moves", moves), ("weights", values)):
        if tensor.dtype != verts.dtype:
            raise ValueError(f"{name} must be {verts.dtype}, like verts, got {tensor.dtype}")
    for name, tensor in (("moves", moves), ("joints", joints), ("weights", values)):
        if tensor.device != verts.device:
            raise ValueError(f"{name} must be on {verts.device}, like verts, got {tensor.device}")
    if joints.device.type == "cpu" and joints.numel():
        low, high = (int(end) for end in joints.aminmax())
        if not 0 <= low <= high < moves.shape[1]:
            raise ValueError(f"joints must name joints 0 to {moves.shape[1] - 1}, got {low} to {high}")


def _words(tensor: Tensor) -> str:
    return f"{tuple(tensor.shape)} of {tensor.dtype}"


def _arrays(*tensors: Tensor) -> Any:
    return tuple(tensor.contiguous().numpy() for tensor in tensors)


@torch.library.custom_op("rendra::skin", mutates_args=(), device_types="cpu")
def _skin_on_cpu(verts: Tensor, moves: Tensor, joints: Tensor, weights: Tensor) -> Tensor:
    skinned = torch.empty_like(verts, memory_format=torch.contiguous_format)
    numba_cpu.forward(*_arrays(verts, moves, joints, weights, skinned))
    return skinned


@_skin_on_cpu.register_fake
def _(verts, moves, joints, weights):  # type: ignore[no-untyped-def]
    return torch.empty_like(verts, memory_format=torch.contiguous_format)


@torch.library.custom_op("rendra::skin_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    verts: Tensor, moves: Tensor, joints: Tensor, weights: Tensor, upstream: Tensor
) -> tuple[Tensor, Tensor]:
    grads = _empty_gradients(verts, moves)
    numba_cpu.backward(*_arrays(verts, moves, joints, weights, upstream, *grads))
    return grads


@_gradient_on_cpu.register_fake
def _(verts, moves, joints, weights, upstream):  # type: ignore[no-untyped-def]
    return _empty_gradients(verts, moves)


def _empty_gradients(verts: Tensor, moves: Tensor) -> tuple[Tensor, Tensor]:
    return (
        torch.empty_like(verts, memory_format=torch.contiguous_format),
        torch.empty_like(moves, memory_format=torch.contiguous_format),
    )


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(*inputs)


def _gradient(ctx, upstream):  # type: ignore[no-untyped-def]
    return *_gradient_on_cpu(*ctx.saved_tensors, upstream), None, None


_skin_on_cpu.register_autograd(_gradient, setup_context=_remember)
