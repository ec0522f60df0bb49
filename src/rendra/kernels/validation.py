"""What every kernel over packed faces demands of its input, checked once, in the caller's words."""

import numpy as np
import torch
from torch import Tensor


def check_faces(face_verts: Tensor, first_face: Tensor, num_faces: Tensor, neighbor: Tensor | None) -> None:
    """Shapes, types and devices of packed faces.

    Raises:
        ValueError: naming the argument, what it was and what was expected.
    """
    if face_verts.ndim != 3 or face_verts.shape[1:] != (3, 3) or not face_verts.is_floating_point():
        raise ValueError(
            f"face_verts must be floats of shape (F, 3, 3), got {face_verts.dtype} of {tuple(face_verts.shape)}"
        )
    if first_face.shape != num_faces.shape or first_face.ndim != 1:
        raise ValueError(
            "mesh_to_face_first_idx and num_faces_per_mesh must both have shape (N,), got "
            f"{tuple(first_face.shape)} and {tuple(num_faces.shape)}"
        )
    if neighbor is not None and neighbor.shape != face_verts.shape[:1]:
        raise ValueError(
            f"clipped_faces_neighbor_idx must have shape ({len(face_verts)},), got {tuple(neighbor.shape)}"
        )
    for name, index in (
        ("mesh_to_face_first_idx", first_face),
        ("num_faces_per_mesh", num_faces),
        ("clipped_faces_neighbor_idx", neighbor),
    ):
        if index is not None and (index.dtype != torch.int64 or index.device != face_verts.device):
            raise ValueError(f"{name} must be int64 on {face_verts.device}, got {index.dtype} on {index.device}")
    if not _ranges_are_inside(first_face, num_faces, len(face_verts)):
        raise ValueError(f"mesh_to_face_first_idx + num_faces_per_mesh leaves the {len(face_verts)} faces given")


def _ranges_are_inside(first_face: Tensor, num_faces: Tensor, total: int) -> bool:
    """Whether all ranges lie in [0, total); on the CPU only: elsewhere torch itself checks on gathering."""
    if first_face.device.type != "cpu" or not len(first_face):
        return True
    return bool(((first_face >= 0) & (num_faces >= 0) & (first_face + num_faces <= total)).all())


def check_points(points: Tensor, radius: Tensor, first_point: Tensor, num_points: Tensor) -> None:
    """Shapes, types, devices and ranges of packed points with a radius each; ranges on the CPU only.

    Raises:
        ValueError: naming the argument, what it was and what was expected.
    """
    if points.ndim != 2 or points.shape[1] != 3 or not points.is_floating_point():
        raise ValueError(f"points must be floats of shape (P, 3), got {points.dtype} of {tuple(points.shape)}")
    if radius.shape != points.shape[:1] or radius.dtype != points.dtype or radius.device != points.device:
        raise ValueError(
            f"radius must be {points.dtype} of shape ({len(points)},) on {points.device}, like the points, got "
            f"{radius.dtype} of {tuple(radius.shape)} on {radius.device}"
        )
    if radius.device.type == "cpu" and not bool((radius >= 0).all()):
        raise ValueError("radius must be zero or positive (NDC distance), got a negative number or NaN")
    if first_point.shape != num_points.shape or first_point.ndim != 1:
        raise ValueError(
            "cloud_to_packed_first_idx and num_points_per_cloud must both have shape (N,), got "
            f"{tuple(first_point.shape)} and {tuple(num_points.shape)}"
        )
    for name, index in (("cloud_to_packed_first_idx", first_point), ("num_points_per_cloud", num_points)):
        if index.dtype != torch.int64 or index.device != points.device:
            raise ValueError(f"{name} must be int64 on {points.device}, got {index.dtype} on {index.device}")
    if not _ranges_are_inside(first_point, num_points, len(points)):
        raise ValueError(f"cloud_to_packed_first_idx + num_points_per_cloud leaves the {len(points)} points given")


def check_image_size(image_size: tuple[int, int]) -> None:
    """Size of the image.

    Raises:
        ValueError: it is empty.
    """
    height, width = image_size
    if height < 1 or width < 1:
        raise ValueError(f"image_size must be (height, width) of at least one pixel, got {tuple(image_size)}")


def check_raster(image_size: tuple[int, int], blur_radius: float) -> None:
    """Size of the image and reach of a face.

    Raises:
        ValueError: naming the argument, what it was and what was expected.
    """
    check_image_size(image_size)
    if not blur_radius >= 0:
        raise ValueError(f"blur_radius must be zero or positive (squared NDC distance), got {blur_radius}")


def neighbor_array(neighbor: Tensor | None, num_faces: int) -> np.ndarray:
    """The clipped halves' partners as kernels read them: (F,) int64, -1 where there is none."""
    return np.full(num_faces, -1) if neighbor is None else neighbor.contiguous().numpy()


def check_ray_first(ray_first: Tensor, packed: Tensor) -> None:
    """Indices (R + 1,) of the first of each ray's samples, and their number at the end, for packed (M, ...) samples.

    The numbers themselves are checked on the CPU only.

    Raises:
        ValueError: saying what was given and what was expected.
    """
    if ray_first.ndim != 1 or not len(ray_first) or ray_first.dtype != torch.int64:
        raise ValueError(
            f"ray_first must be int64 of shape (R + 1,), got {ray_first.dtype} of {tuple(ray_first.shape)}"
        )
    if ray_first.device != packed.device:
        raise ValueError(f"ray_first must be on {packed.device}, like the samples, got {ray_first.device}")
    if ray_first.device.type != "cpu":
        return
    if ray_first[0] != 0 or ray_first[-1] != len(packed) or not bool((ray_first[1:] >= ray_first[:-1]).all()):
        raise ValueError(f"ray_first must start at 0, never fall and end at the number of samples, {len(packed)}")
