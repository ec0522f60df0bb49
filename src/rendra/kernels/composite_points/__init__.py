"""Lists of points, nearest first, with an opacity each, to one feature vector a list: three ways to add them up.

Letters: Q lists (pixels), K slots in each, P points, C channels.
"""

import torch
from torch import Tensor

from rendra.kernels.composite_points import numba_cpu, reference

__all__ = ["MODES", "composite_points"]

MODES = reference.MODES


def composite_points(idx: Tensor, alphas: Tensor, features: Tensor, mode: str) -> Tensor:
    """Features (Q, C) of each list; `reference.py` states each mode.

    Differentiable in alphas and features, without dividing by 1 - alpha; the same on any number of threads.

    Args:
        idx: (Q, K) int64, which point stands in each slot; negative where none does.
        alphas: (Q, K) opacity of each slot; what stands in empty slots is ignored.
        features: (P, C).
        mode: alpha, sum or norm.

    Raises:
        ValueError: a shape, type, device, index or mode that cannot be.
    """
    _check(idx, alphas, features, mode)
    if features.device.type != "cpu" or features.dtype != torch.float32:
        return reference.composite_points(idx, alphas, features, mode)
    return _composite_on_cpu(idx, alphas, features, MODES.index(mode))


def _check(idx: Tensor, alphas: Tensor, features: Tensor, mode: str) -> None:
    if mode not in MODES:
        raise ValueError(f"mode must be one of {', '.join(MODES)}, got {mode}")
    if idx.ndim != 2 or idx.dtype != torch.int64:
        raise ValueError(f"idx must be int64 of shape (Q, K), got {idx.dtype} of {tuple(idx.shape)}")
    if features.ndim != 2 or not features.is_floating_point():
        raise ValueError(f"features must be floats of shape (P, C), got {features.dtype} of {tuple(features.shape)}")
    if alphas.shape != idx.shape or alphas.dtype != features.dtype:
        raise ValueError(
            f"alphas must be {features.dtype} of shape {tuple(idx.shape)}, like features and idx, got "
            f"{alphas.dtype} of {tuple(alphas.shape)}"
        )
    if not idx.device == alphas.device == features.device:
        raise ValueError(
            f"idx, alphas and features must be on one device, got {idx.device}, {alphas.device}, {features.device}"
        )
    if idx.device.type == "cpu" and idx.numel() and int(idx.max()) >= len(features):
        raise ValueError(f"idx names point {int(idx.max())}, but features are those of {len(features)} points")


@torch.library.custom_op("rendra::composite_points", mutates_args=(), device_types="cpu")
def _composite_on_cpu(idx: Tensor, alphas: Tensor, features: Tensor, mode: int) -> Tensor:
    out = features.new_empty((len(idx), features.shape[1]))
    numba_cpu.forward(
        idx.contiguous().numpy(), alphas.contiguous().numpy(), features.contiguous().numpy(), mode, out.numpy()
    )
    return out


@_composite_on_cpu.register_fake
def _(idx, alphas, features, mode):  # type: ignore[no-untyped-def]
    return features.new_empty((len(idx), features.shape[1]))


@torch.library.custom_op("rendra::composite_points_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    idx: Tensor, alphas: Tensor, features: Tensor, out: Tensor, grad_out: Tensor, mode: int
) -> tuple[Tensor, Tensor]:
    grad_alphas, grad_features = numba_cpu.backward(
        idx.contiguous().numpy(),
        alphas.contiguous().numpy(),
        features.contiguous().numpy(),
        out.numpy(),
        grad_out.contiguous().numpy(),
        mode,
    )
    return torch.from_numpy(grad_alphas), torch.from_numpy(grad_features)


@_gradient_on_cpu.register_fake
def _(idx, alphas, features, out, grad_out, mode):  # type: ignore[no-untyped-def]
    dense = torch.contiguous_format
    return torch.empty_like(alphas, memory_format=dense), torch.empty_like(features, memory_format=dense)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(*inputs[:3], output)
    ctx.mode = inputs[3]


def _gradient(ctx, grad_out):  # type: ignore[no-untyped-def]
    return None, *_gradient_on_cpu(*ctx.saved_tensors, grad_out, ctx.mode), None


_composite_on_cpu.register_autograd(_gradient, setup_context=_remember)
