"""Meshes in NDC to fragments or to a soft silhouette: clipping, the kernel, and the way back."""

from collections.abc import Sequence

from torch import Tensor

from rendra.kernels.rasterize_meshes import rasterize_meshes as _rasterize_kernel
from rendra.kernels.soft_silhouette import soft_silhouette as _silhouette_kernel
from rendra.renderer.mesh.clip import (
    ClipFrustum,
    ClippedFaces,
    clip_faces,
    convert_clipped_rasterization_to_original_faces,
)
from rendra.renderer.utils import parse_image_size
from rendra.structures.meshes import Meshes


def rasterize_meshes(
    meshes: Meshes,
    image_size: int | Sequence[int] = 256,
    blur_radius: float = 0.0,
    faces_per_pixel: int = 8,
    bin_size: int | None = None,
    max_faces_per_bin: int | None = None,
    perspective_correct: bool = False,
    clip_barycentric_coords: bool = False,
    cull_backfaces: bool = False,
    z_clip_value: float | None = None,
    cull_to_frustum: bool = False,
    *,
    verts_divided_by_depth: bool | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Find the faces that each pixel sees.

    Differentiable with respect to the vertices through depths, barycentrics and distances.

    Args:
        meshes: batch of N, vertices with x and y in NDC (+X left, +Y up, short image side in [-1, 1]) and z the
            view depth.
        image_size: side of a square image, or (H, W), in pixels.
        blur_radius: squared NDC distance up to which a face reaches pixels outside it.
        faces_per_pixel: K, the nearest faces that are kept for each pixel; any number.
        bin_size, max_faces_per_bin: accepted for compatibility and ignored; the binning here is exact, no bin
            overflows.
        perspective_correct: give barycentrics on the surface in space instead of those on the image.
        clip_barycentric_coords: clip barycentrics to the face, for pixels that only blur_radius brings in.
        cull_backfaces: leave out faces whose corners run clockwise in the image.
        z_clip_value: cut faces at this view depth and drop what is nearer; None cuts nothing.
        cull_to_frustum: drop faces that lie wholly outside the image before they are rasterised.
        verts_divided_by_depth: whether the vertices come from a perspective camera, which decides where a cut at
            `z_clip_value` falls; None takes `perspective_correct`.

    Returns:
        pix_to_face (N, H, W, K) int64, index of the packed face, nearest first; zbuf (N, H, W, K), view depth;
        barycentrics (N, H, W, K, 3); dists (N, H, W, K), squared NDC distance to the nearest edge, negative
        inside. Empty slots hold -1.

    Raises:
        ValueError: sizes, radius or number of faces that cannot be.
    """
    size = parse_image_size(image_size)
    divided = perspective_correct if verts_divided_by_depth is None else verts_divided_by_depth
    clipped = _prepare(meshes, size, blur_radius, divided, z_clip_value, cull_to_frustum)
    pix_to_face, zbuf, bary, dists = _rasterize_kernel(
        *_kernel_faces(clipped),
        size,
        blur_radius,
        faces_per_pixel,
        perspective_correct,
        clip_barycentric_coords,
        cull_backfaces,
    )
    pix_to_face, bary = convert_clipped_rasterization_to_original_faces(pix_to_face, bary, clipped)
    return pix_to_face, zbuf, bary, dists


def rasterize_silhouette(
    meshes: Meshes,
    image_size: int | Sequence[int] = 256,
    blur_radius: float = 0.0,
    sigma: float = 1e-4,
    cull_backfaces: bool = False,
    z_clip_value: float | None = None,
    cull_to_frustum: bool = False,
    *,
    verts_divided_by_depth: bool = False,
) -> Tensor:
    """Alpha of `sigmoid_alpha_blend` over all faces of a pixel, however many, without storing fragments.

    Args:
        meshes: as in `rasterize_meshes`, and so are all arguments but these:
        sigma: width of the edge, in squared NDC.

    Returns:
        alpha (N, H, W) in [0, 1].

    Raises:
        ValueError: sizes, radius or sigma that cannot be.
    """
    size = parse_image_size(image_size)
    clipped = _prepare(meshes, size, blur_radius, verts_divided_by_depth, z_clip_value, cull_to_frustum)
    return _silhouette_kernel(*_kernel_faces(clipped), size, blur_radius, sigma, cull_backfaces)


def non_square_ndc_range(S1: int, S2: int) -> float:
    """How much of NDC the side of S1 pixels spans, beside a side of S2: 2 if it is the shorter one."""
    return 2.0 * S1 / min(S1, S2)


def pix_to_non_square_ndc(i: int | Tensor, S1: int, S2: int) -> float | Tensor:
    """NDC of the centre of pixel i along a side of S1 pixels, beside a side of S2.

    Pixels count with the axis here, from its negative end; columns and rows of images count against it.
    """
    return non_square_ndc_range(S1, S2) * ((2 * i + 1) / S1 - 1) / 2


def _prepare(
    meshes: Meshes,
    image_size: tuple[int, int],
    blur_radius: float,
    verts_divided_by_depth: bool,
    z_clip_value: float | None,
    cull_to_frustum: bool,
) -> ClippedFaces:
    """The packed faces of a batch, clipped and culled, as both kernels take them."""
    face_verts = meshes.verts_packed().index_select(0, meshes.faces_packed().reshape(-1)).view(-1, 3, 3)
    first, count = meshes.mesh_to_faces_packed_first_idx(), meshes.num_faces_per_mesh()
    if z_clip_value is None and not cull_to_frustum:
        return ClippedFaces(face_verts, first, count)
    reach = blur_radius**0.5  # a face this far outside still colours pixels
    half_height, half_width = (side / min(image_size) + reach for side in image_size)
    frustum = ClipFrustum(
        left=-half_width,
        right=half_width,
        top=-half_height,
        bottom=half_height,
        perspective_correct=verts_divided_by_depth,
        cull=cull_to_frustum,
        z_clip_value=z_clip_value,
    )
    return clip_faces(face_verts, first, count, frustum)


def _kernel_faces(clipped: ClippedFaces) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    return (
        clipped.face_verts,
        clipped.mesh_to_face_first_idx,
        clipped.num_faces_per_mesh,
        clipped.clipped_faces_neighbor_idx,
    )
