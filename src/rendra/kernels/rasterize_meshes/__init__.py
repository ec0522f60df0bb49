"""Triangles to fragments: which faces each pixel sees, how deep, where on the face, how far from its edges."""

import torch
from torch import Tensor

from rendra.kernels.rasterize_meshes import numba_cpu, reference
from rendra.kernels.validation import check_faces, check_raster, neighbor_array

__all__ = ["rasterize_meshes"]


def rasterize_meshes(
    face_verts: Tensor,
    mesh_to_face_first_idx: Tensor,
    num_faces_per_mesh: Tensor,
    clipped_faces_neighbor_idx: Tensor | None,
    image_size: tuple[int, int],
    blur_radius: float,
    faces_per_pixel: int,
    perspective_correct: bool,
    clip_barycentric_coords: bool,
    cull_backfaces: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The `faces_per_pixel` nearest faces of every pixel; `reference.py` states each rule.

    Differentiable with respect to `face_verts` through depth, barycentrics and distances; not through visibility.
    Exact for any number of faces a pixel and any image size; the same on any number of threads.

    Args:
        face_verts: (F, 3, 3) corners of the packed faces: x, y in NDC, z the depth in view space.
        mesh_to_face_first_idx: (N,) index of the first face of each mesh.
        num_faces_per_mesh: (N,) number of faces of each mesh.
        clipped_faces_neighbor_idx: (F,) the other half of a face that was clipped in two, -1 if none; or None.
        image_size: (H, W) in pixels.
        blur_radius: squared NDC distance up to which a face colours pixels outside it.
        faces_per_pixel: K, without an upper limit.
        perspective_correct: whether barycentrics are those on the surface in space.
        clip_barycentric_coords: whether barycentrics outside the face are clipped to it.
        cull_backfaces: whether faces seen from behind (clockwise) are left out.

    Returns:
        pix_to_face (N, H, W, K) int64, index of the packed face; zbuf (N, H, W, K), depth; bary_coords
        (N, H, W, K, 3); dists (N, H, W, K), squared NDC distance to the nearest edge, negative inside. All are -1
        where a pixel has fewer than K hits.

    Raises:
        ValueError: a shape, size, radius or index that cannot be.
    """
    check_faces(face_verts, mesh_to_face_first_idx, num_faces_per_mesh, clipped_faces_neighbor_idx)
    check_raster(image_size, blur_radius)
    if faces_per_pixel < 1:
        raise ValueError(f"faces_per_pixel must be at least 1, got {faces_per_pixel}")
    if face_verts.device.type != "cpu" or face_verts.dtype != torch.float32:
        return reference.rasterize_meshes(
            face_verts, mesh_to_face_first_idx, num_faces_per_mesh, clipped_faces_neighbor_idx, image_size,
            blur_radius, faces_per_pixel, perspective_correct, clip_barycentric_coords, cull_backfaces,
        )  # fmt: skip
    return _rasterize_on_cpu(
        face_verts, mesh_to_face_first_idx, num_faces_per_mesh, clipped_faces_neighbor_idx, *image_size,
        float(blur_radius), faces_per_pixel, perspective_correct, clip_barycentric_coords, cull_backfaces,
    )  # fmt: skip


@torch.library.custom_op("rendra::rasterize_meshes", mutates_args=(), device_types="cpu")
def _rasterize_on_cpu(
    face_verts: Tensor,
    first_face: Tensor,
    num_faces: Tensor,
    neighbor: Tensor | None,
    height: int,
    width: int,
    blur_radius: float,
    layers: int,
    perspective: bool,
    clip: bool,
    cull: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    outputs = _outputs(face_verts, first_face, height, width, layers)
    numba_cpu.forward(
        face_verts.contiguous().numpy(),
        first_face.numpy(),
        num_faces.numpy(),
        neighbor_array(neighbor, len(face_verts)),
        (height, width),
        blur_radius,
        layers,
        (perspective, clip, cull),
        (outputs[0].numpy(), outputs[1].numpy(), outputs[2].numpy(), outputs[3].numpy()),
    )
    return outputs


@_rasterize_on_cpu.register_fake
def _(face_verts, first_face, num_faces, neighbor, height, width, blur_radius, layers, perspective, clip, cull):  # type: ignore[no-untyped-def]
    return _outputs(face_verts, first_face, height, width, layers)


def _outputs(
    face_verts: Tensor, first_face: Tensor, height: int, width: int, layers: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Uninitialised results: the kernel writes each element once."""
    shape = (len(first_face), height, width, layers)
    return (
        face_verts.new_empty(shape, dtype=torch.int64),
        face_verts.new_empty(shape),
        face_verts.new_empty((*shape, 3)),
        face_verts.new_empty(shape),
    )


@torch.library.custom_op("rendra::rasterize_meshes_backward", mutates_args=(), device_types="cpu")
def _gradient_on_cpu(
    face_verts: Tensor,
    pix_to_face: Tensor,
    perspective: bool,
    clip: bool,
    grad_zbuf: Tensor | None,
    grad_bary: Tensor | None,
    grad_dists: Tensor | None,
) -> Tensor:
    grads = [None if grad is None else grad.contiguous().numpy() for grad in (grad_zbuf, grad_bary, grad_dists)]
    grad = numba_cpu.backward(
        face_verts.contiguous().numpy(), pix_to_face.numpy(), (perspective, clip), (grads[0], grads[1], grads[2])
    )
    return torch.from_numpy(grad)


@_gradient_on_cpu.register_fake
def _(face_verts, pix_to_face, perspective, clip, grad_zbuf, grad_bary, grad_dists):  # type: ignore[no-untyped-def]
    return torch.empty_like(face_verts, memory_format=torch.contiguous_format)


def _remember(ctx, inputs, output) -> None:  # type: ignore[no-untyped-def]
    ctx.save_for_backward(inputs[0], output[0])
    ctx.flags = inputs[8:10]
    ctx.mark_non_differentiable(output[0])
    ctx.set_materialize_grads(False)


def _gradient(ctx, _, *grads):  # type: ignore[no-untyped-def]
    return _gradient_on_cpu(*ctx.saved_tensors, *ctx.flags, *grads), *[None] * 10


_rasterize_on_cpu.register_autograd(_gradient, setup_context=_remember)
