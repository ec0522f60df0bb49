"""Barycentric interpolation of what the corners of a face carry.

Notation: N images, K layers a pixel, F packed faces, D channels, M slots that hold a face.
"""

from typing import Any

import torch
from torch import Tensor


def interpolate_face_attributes(pix_to_face: Tensor, barycentric_coords: Tensor, face_attributes: Tensor) -> Tensor:
    """Attribute of the surface point behind every slot of a rasterised image: `sum_i w_i a_i`.

    Differentiable with respect to the barycentric coordinates and the attributes. The cost follows the
    number of slots that hold a face, not the size of the image.

    Args:
        pix_to_face: (N, H, W, K) int64, index of a packed face; negative where the slot is empty.
        barycentric_coords: (N, H, W, K, 3), one weight per corner.
        face_attributes: (F, 3, D), an attribute per corner of each face.

    Returns:
        (N, H, W, K, D); zero in empty slots.

    Raises:
        ValueError: shapes that do not fit together.
    """
    _check_shapes(pix_to_face, barycentric_coords, face_attributes)
    dtype = torch.promote_types(barycentric_coords.dtype, face_attributes.dtype)
    weights = barycentric_coords.reshape(-1, 3).to(dtype)
    attributes = face_attributes.to(dtype)
    faces = pix_to_face.reshape(-1)
    filled = (faces >= 0).nonzero()[:, 0]
    out_shape = (*pix_to_face.shape, attributes.shape[2])
    if len(filled) == len(faces):
        return _WeightedCorners.apply(faces, weights, attributes).view(out_shape)
    values = _WeightedCorners.apply(faces.index_select(0, filled), weights.index_select(0, filled), attributes)
    return values.new_zeros(len(faces), attributes.shape[2]).index_copy(0, filled, values).view(out_shape)


def _check_shapes(pix_to_face: Tensor, barycentric_coords: Tensor, face_attributes: Tensor) -> None:
    if face_attributes.ndim != 3 or face_attributes.shape[1] != 3:
        raise ValueError(f"face_attributes must be (F, 3, D); got {tuple(face_attributes.shape)}")
    if barycentric_coords.shape != (*pix_to_face.shape, 3):
        raise ValueError(
            "barycentric_coords must be (N, H, W, K, 3) for a pix_to_face of (N, H, W, K); "
            f"got {tuple(barycentric_coords.shape)} for {tuple(pix_to_face.shape)}"
        )


class _WeightedCorners(torch.autograd.Function):
    """`out[m] = sum_i weights[m, i] attributes[faces[m], i]`, without the (M, 3, D) temporary.

    `embedding_bag` is five times faster than gather and multiply; its own backward pass is slow and not
    differentiable, so it is written here in operations that are both.
    """

    @staticmethod
    def forward(ctx: Any, faces: Tensor, weights: Tensor, attributes: Tensor) -> Tensor:
        ctx.save_for_backward(faces, weights, attributes)
        num_channels = attributes.shape[2]
        if faces.numel() == 0 or num_channels == 0:
            return weights.new_zeros(len(faces), num_channels)
        corners = 3 * faces[:, None] + torch.arange(3, device=faces.device)
        return torch.nn.functional.embedding_bag(
            corners, attributes.reshape(-1, num_channels), per_sample_weights=weights, mode="sum"
        )

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[None, Tensor | None, Tensor | None]:
        faces, weights, attributes = ctx.saved_tensors
        grad = grads[0]  # (M, D)
        grad_weights = grad_attributes = None
        # batched products: ten times faster than multiplying and summing
        if ctx.needs_input_grad[1]:
            grad_weights = (attributes.index_select(0, faces) @ grad[..., None])[..., 0]
        if ctx.needs_input_grad[2]:
            shares = weights[..., None] @ grad[:, None]
            grad_attributes = torch.zeros_like(attributes).index_add(0, faces, shares)
        return None, grad_weights, grad_attributes
