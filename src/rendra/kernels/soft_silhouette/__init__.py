"""Soft silhouette in one pass, without fragments: the coverage of each pixel by all faces near it."""

import torch
from torch import Tensor

from rendra.kernels.soft_silhouette import numba_cpu, reference
from rendra.kernels.validation import check_faces, check_raster, neighbor_array

__all__ = ["soft_silhouette"]


def soft_silhouette(
    face_verts: Tensor,
    mesh_to_face_first_idx: Tensor,
    num_faces_per_mesh: Tensor,
    clipped_faces_neighbor_idx: Tensor | None,
    image_size: tuple[int, int],
    blur_radius: float,
    sigma: float,
    cull_backfaces: bool,
) -> Tensor:
    """Alpha of a mesh's silhouette: 1 - prod_f (1 - sigmoid(-d_f / sigma)) over ALL faces near each pixel.

    What `sigmoid_alpha_blend` gives for fragments with clipped barycentrics and K without limit. Differentiable with
    respect to x and y of `face_verts`; the same on any number of threads.

    Args:
        face_verts: (F, 3, 3) corners of the packed faces: x, y in NDC, z the depth in view space.
        mesh_to_face_first_idx: (N,) index of the first face of each mesh.
        num_faces_per_mesh: (N,) number of faces of each mesh.
        clipped_faces_neighbor_idx: (F,) the other half of a face that was clipped in two, -1 if none; or None.
        image_size: (H, W) in pixels.
        blur_radius: squared NDC distance up to which a face covers pixels outside it.
        sigma: width of the edge, in squared NDC distance.
        cull_backfaces: whether faces seen from behind (clockwise) are left out.

    Returns:
        alpha (N, H, W) in [0, 1].

    Raises:
        ValueError: a shape, size, radius or index that cannot be.
    """
    check_faces(face_verts, mesh_to_face_first_idx, num_faces_per_mesh, clipped_faces_neighbor_idx)
    check_raster(image_size, blur_radius)
    if not sigma > 0:
        raise ValueError(f"sigma must be positive (squared NDC distance), got {sigma}")
    if face_verts.device.type != "cpu" or face_verts.dtype != torch.float32:
        survival = reference.soft_silhouette(
            face_verts, mesh_to_face_first_idx, num_faces_per_mesh, clipped_faces_neighbor_idx, image_size,
            blur_radius, sigma, cull_backfaces,
        )  # fmt: skip
    else:
        survival, _ = _survival_on_cpu(
            face_verts, mesh_to_face_first_idx, num_faces_per_mesh, clipped_faces_neighbor_idx, *image_size,
            float(blur_radius), float(sigma), cull_backfaces,
        )  # fmt: skip
    return 1 - survival


@torch.library.custom_op("rendra::soft_silhouette", mutates_args=(), device_types="cpu")
def _survival_on_cpu(
    face_verts: Tensor,
    first_face: Tensor,
    num_faces: Tensor,
    neighbor: Tensor | None,
    height: int,
    width: int,
    blur_radius: float,
    sigma: float,
    cull: bool,
) -> tuple[Tensor, Tensor]:
    survival = face_verts.new_empty((len(first_face), height, width))
    boxes = numba_cpu.forward(
        face_verts.contiguous().numpy(), first_face.numpy(), num_faces.numpy(),
        neighbor_array(neighbor, len(face_verts)), blur_radius, sigma, cull, survival.numpy(),
    )  # fmt: skip
    return survival, torch.from_numpy(boxes)


@_survival_on_cpu.register_fake
def _(face_verts, first_face, num_faces, neighbor, height, width, blur_radius, sigma, cull):  # type: ignore[no-untyped-def]
    survival = face_verts.new_empty((len(first_face), height, width))
    return survival, face_verts.new_empty((len(face_verts), 4), dtype=torch.int32)


@torch.library.custom_op("rendra::soft_silhouette_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    face_verts: Tensor,
    first_face: Tensor,
    num_faces: Tensor,
    neighbor: Tensor | None,
    boxes: Tensor,
    blur_radius: float,
    sigma: float,
    upstream: Tensor,
) -> Tensor:
    grad = numba_cpu.backward(
        face_verts.contiguous().numpy(), boxes.numpy(), first_face.numpy(), num_faces.numpy(),
        neighbor_array(neighbor, len(face_verts)), blur_radius, sigma, upstream.contiguous().numpy(),
    )  # fmt: skip
    return torch.from_numpy(grad)


@_gradient_on_cpu.register_fake
def _(face_verts, first_face, num_faces, neighbor, boxes, blur_radius, sigma, upstream):  # type: ignore[no-untyped-def]
    return torch.empty_like(face_verts, memory_format=torch.contiguous_format)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(*inputs[:4], *output)
    ctx.settings = inputs[6:8]
    ctx.mark_non_differentiable(output[1])


def _gradient(ctx, grad_survival, _):  # type: ignore[no-untyped-def]
    *faces, survival, boxes = ctx.saved_tensors
    return _gradient_on_cpu(*faces, boxes, *ctx.settings, grad_survival * survival), *[None] * 8


_survival_on_cpu.register_autograd(_gradient, setup_context=_remember)
