"""Barycentric interpolation: against the plain formula, by finite differences, and on empty input."""

import pytest
import torch
from assertions import assert_close

from rendra.ops.interp_face_attrs import interpolate_face_attributes


def _scene(num_faces: int = 7, channels: int = 4, fill: float = 0.4, dtype: torch.dtype = torch.float64):
    faces = torch.randint(0, num_faces, (2, 3, 5, 4))
    faces[torch.rand(faces.shape) > fill] = -1
    bary = torch.rand(*faces.shape, 3, dtype=dtype)
    bary = bary / bary.sum(-1, keepdim=True)
    return faces, bary, torch.randn(num_faces, 3, channels, dtype=dtype)


def _plain(faces: torch.Tensor, bary: torch.Tensor, attributes: torch.Tensor) -> torch.Tensor:
    dense = (bary[..., None] * attributes[faces.clamp(min=0)]).sum(-2)
    return torch.where(faces[..., None] >= 0, dense, torch.zeros_like(dense))


@pytest.mark.parametrize("fill", [0.0, 0.4, 1.1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_is_the_weighted_sum_of_corners(fill: float, dtype: torch.dtype) -> None:
    faces, bary, attributes = _scene(fill=fill, dtype=dtype)
    result = interpolate_face_attributes(faces, bary, attributes)
    assert result.dtype == dtype
    assert_close(result, _plain(faces, bary, attributes), atol=1e-6)


def test_affine_functions_of_position_are_reproduced() -> None:
    faces, bary, corners = _scene(channels=3)
    matrix, shift = torch.randn(3, 2, dtype=torch.float64), torch.randn(2, dtype=torch.float64)
    points = interpolate_face_attributes(faces, bary, corners)
    mapped = interpolate_face_attributes(faces, bary, corners @ matrix + shift)
    filled = faces >= 0
    assert_close(mapped[filled], (points @ matrix + shift)[filled], atol=1e-12)


@pytest.mark.parametrize("fill", [0.4, 1.1])
def test_gradients_of_first_and_second_order(fill: float) -> None:
    faces, bary, attributes = _scene(num_faces=3, channels=2, fill=fill)
    faces, bary = faces[:1, :2, :2], bary[:1, :2, :2]
    inputs = (bary.requires_grad_(), attributes.requires_grad_())
    assert torch.autograd.gradcheck(lambda b, a: interpolate_face_attributes(faces, b, a), inputs)
    assert torch.autograd.gradgradcheck(lambda b, a: interpolate_face_attributes(faces, b, a), inputs)


def test_empty_slots_get_no_gradient() -> None:
    faces, bary, attributes = _scene()
    bary[faces < 0] = float("nan")
    bary.requires_grad_()
    interpolate_face_attributes(faces, bary, attributes).sum().backward()
    assert torch.isfinite(bary.grad).all()
    assert (bary.grad[faces < 0] == 0).all()


@pytest.mark.parametrize("shape", [(0, 4, 4, 2), (2, 0, 4, 2), (1, 3, 3, 0), (1, 3, 3, 2)])
def test_nothing_to_interpolate(shape: tuple[int, ...]) -> None:
    faces = torch.full(shape, -1)
    result = interpolate_face_attributes(faces, torch.zeros(*shape, 3), torch.zeros(0, 3, 5))
    assert result.shape == (*shape, 5)
    assert (result == 0).all()


def test_shapes_are_checked() -> None:
    faces, bary, attributes = _scene()
    with pytest.raises(ValueError, match=r"face_attributes must be \(F, 3, D\); got \(7, 4\)"):
        interpolate_face_attributes(faces, bary, attributes[:, 0])
    with pytest.raises(ValueError, match="barycentric_coords must be"):
        interpolate_face_attributes(faces, bary[:1], attributes)
