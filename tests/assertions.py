"""Comparisons that several tests share."""

import torch
from torch import Tensor


def assert_close(actual: Tensor, expected: Tensor | list, atol: float = 1e-5, rtol: float = 1e-5) -> None:
    """`torch.testing.assert_close` that takes plain lists and ignores the dtype."""
    expected = torch.as_tensor(expected, dtype=actual.dtype, device=actual.device)
    torch.testing.assert_close(actual, expected, atol=atol, rtol=rtol)


def assert_finite(tensor: Tensor | None) -> None:
    """The tensor exists and holds neither NaN nor infinity."""
    assert tensor is not None
    assert torch.isfinite(tensor).all(), f"{(~torch.isfinite(tensor)).sum()} of {tensor.numel()} are not finite"
