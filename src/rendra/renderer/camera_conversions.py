"""Pinhole cameras to and from the conventions of OpenCV, OpenGL and Blender, and COLMAP.

Camera axes (all right-handed), with their x, y, z:
    here                  left,  up,   into the scene;  row vectors, x_view = x_world R + T
    OpenCV, COLMAP        right, down, into the scene;  column vectors, x_camera = R x_world + t
    OpenGL, Blender, NeRF right, up,   out of it;       column vectors, x_world = C [x_camera, 1]
The world keeps its axes: a Blender scene with Z up has Z up here too.

Pixels: all focal lengths and principal points are in pixels from the upper-left CORNER of the image, where the
centre of the first pixel is (0.5, 0.5), as `transform_points_screen`, COLMAP and NeRF have it. A principal point
from OpenCV's calibration usually counts from the CENTRE of the first pixel; say so by `first_pixel_center=0.0`.
Image sizes are (H, W); they may differ within a batch of N.

Values and gradients pass in both directions. What a pinhole cannot hold (skew, distortion, a rotation that scales)
is refused, not dropped.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rendra.renderer.cameras import CamerasBase, PerspectiveCameras
from rendra.transforms import matrix_to_quaternion, quaternion_to_matrix

_COLMAP_MODELS = {"SIMPLE_PINHOLE": 3, "PINHOLE": 4}
_ORTHONORMAL_TOLERANCE = 1e-3


class OpenCVCameras(NamedTuple):
    """Cameras as OpenCV has them: u = fx x/z + cx of x_camera = R x_world + tvec."""

    R: Tensor  # (N, 3, 3), for column vectors
    tvec: Tensor  # (N, 3)
    camera_matrix: Tensor  # (N, 3, 3), [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
    image_size: Tensor  # (N, 2), (H, W)


class OpenGLCameras(NamedTuple):
    """Cameras as OpenGL, Blender and NeRF's transforms.json have them."""

    camera_to_world: Tensor  # (N, 4, 4), for column vectors
    focal_length_px: Tensor  # (N, 2), fx and fy
    principal_point_px: Tensor  # (N, 2), cx and cy from the upper-left corner
    image_size: Tensor  # (N, 2), (H, W)


class ColmapCameras(NamedTuple):
    """Cameras as COLMAP's images.txt and cameras.txt have them."""

    qvec: Tensor  # (N, 4), unit quaternion w, x, y, z of world to camera, w >= 0
    tvec: Tensor  # (N, 3)
    model: str  # "PINHOLE"
    params: Tensor  # (N, 4), fx, fy, cx, cy
    image_size: Tensor  # (N, 2), (H, W)


def cameras_from_opencv(
    R: Tensor,
    tvec: Tensor,
    camera_matrix: Tensor,
    image_size: Any,
    *,
    in_ndc: bool = True,
    first_pixel_center: float = 0.5,
) -> PerspectiveCameras:
    """Cameras of OpenCV's parameters.

    Args:
        R: rotation (N, 3, 3) from world to camera, for column vectors; `cv2.Rodrigues` of `rvec`.
        tvec: translation (N, 3).
        camera_matrix: (N, 3, 3), in pixels; without skew.
        image_size: (H, W) or (N, 2).
        in_ndc: the unit in which the result keeps its intrinsics; the images are the same.
        first_pixel_center: where the camera matrix has the centre of the first pixel: 0.5, or OpenCV's own 0.0.

    Raises:
        ValueError: for other shapes, skew, or an R that is no rotation.
    """
    _check_shape("camera_matrix", camera_matrix, 3, 3)
    _check_shape("tvec", tvec, 3)
    if (camera_matrix[:, 0, 1] != 0).any():
        raise ValueError("camera_matrix has skew (element [0, 1] is not 0), which no camera class here can hold")
    _check_rotation("R", R)
    focal = camera_matrix.diagonal(dim1=1, dim2=2)[:, :2]
    principal = camera_matrix[:, :2, 2] + (0.5 - first_pixel_center)
    flip = R.new_tensor([-1.0, -1.0, 1.0])
    return _pinhole(R.transpose(1, 2) * flip, tvec * flip, focal, principal, image_size, in_ndc)


def opencv_from_cameras(
    cameras: CamerasBase, image_size: Any = None, *, first_pixel_center: float = 0.5
) -> OpenCVCameras:
    """OpenCV's parameters of pinhole cameras; the inverse of `cameras_from_opencv`.

    Args:
        cameras: `PerspectiveCameras` or `FoVPerspectiveCameras`.
        image_size: (H, W) or (N, 2), if the cameras have none.
        first_pixel_center: where the camera matrix shall have the centre of the first pixel.

    Raises:
        ValueError: for other cameras, a K that is no pinhole's, or a missing image size.
    """
    focal, principal, size = _intrinsics_px(cameras, image_size)
    flip = cameras.R.new_tensor([-1.0, -1.0, 1.0])
    matrix = torch.diag_embed(torch.nn.functional.pad(focal, (0, 1), value=1.0))
    centre = torch.nn.functional.pad(principal + (first_pixel_center - 0.5), (0, 1))
    last = torch.tensor([0.0, 0.0, 1.0], dtype=focal.dtype, device=focal.device)
    matrix = matrix + centre[:, :, None] * last
    return OpenCVCameras((cameras.R * flip).transpose(1, 2), cameras.T * flip, matrix, size)


def cameras_from_opengl(
    camera_to_world: Tensor,
    image_size: Any,
    *,
    focal_length_px: Any = None,
    fov_x_deg: Any = None,
    fov_y_deg: Any = None,
    principal_point_px: Any = None,
    in_ndc: bool = True,
) -> PerspectiveCameras:
    """Cameras of OpenGL's, Blender's (`matrix_world`) or NeRF's (`transform_matrix`) parameters.

    Args:
        camera_to_world: (N, 4, 4) or (4, 4) for column vectors, a rotation and a translation.
        image_size: (H, W) or (N, 2).
        focal_length_px: number, (N,) or (N, 2); give this or one of the two angles.
        fov_x_deg: angle that the image's width spans; pixels are square. NeRF's camera_angle_x is this in radians.
        fov_y_deg: angle that its height spans; pixels are square.
        principal_point_px: (N, 2) from the upper-left corner; by default the middle of the image.
        in_ndc: the unit in which the result keeps its intrinsics; the images are the same.

    Raises:
        ValueError: for other shapes, a matrix that scales or mirrors, or not exactly one of focal length and angles.
    """
    matrix = camera_to_world if camera_to_world.dim() == 3 else camera_to_world[None]
    _check_shape("camera_to_world", matrix, 4, 4)
    _check_rotation("camera_to_world's rotation", matrix[:, :3, :3])
    size = _size(image_size, matrix)
    focal = _focal_px(matrix, size, focal_length_px, fov_x_deg, fov_y_deg)
    principal = 0.5 * size.flip(-1) if principal_point_px is None else _like(principal_point_px, matrix).view(-1, 2)
    R = matrix[:, :3, :3] * matrix.new_tensor([-1.0, 1.0, -1.0])
    T = -(matrix[:, None, :3, 3] @ R)[:, 0]
    return _pinhole(R, T, focal, principal, size, in_ndc)


def opengl_from_cameras(cameras: CamerasBase, image_size: Any = None) -> OpenGLCameras:
    """OpenGL's and Blender's parameters of pinhole cameras; the inverse of `cameras_from_opengl`.

    Arguments and errors as `opencv_from_cameras`. A field of view is 2 atan(size / (2 focal_length_px)).
    """
    focal, principal, size = _intrinsics_px(cameras, image_size)
    rotation = cameras.R * cameras.R.new_tensor([-1.0, 1.0, -1.0])
    upper = torch.cat((rotation, cameras.get_camera_center()[:, :, None]), dim=2)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=upper.dtype, device=upper.device)
    return OpenGLCameras(torch.cat((upper, last.expand(len(upper), 1, 4)), dim=1), focal, principal, size)


def cameras_from_colmap(
    qvec: Tensor, tvec: Tensor, model: str, params: Tensor, image_size: Any, *, in_ndc: bool = True
) -> PerspectiveCameras:
    """Cameras of COLMAP's parameters, for images that share a camera model.

    Args:
        qvec: quaternion (N, 4), w first, from world to camera, as in images.txt.
        tvec: translation (N, 3), likewise.
        model: "SIMPLE_PINHOLE" or "PINHOLE".
        params: (N, 3) f, cx, cy or (N, 4) fx, fy, cx, cy, as in cameras.txt.
        image_size: (H, W) or (N, 2); note that cameras.txt has the width first.
        in_ndc: the unit in which the result keeps its intrinsics; the images are the same.

    Raises:
        ValueError: for a model with distortion or an unknown one, a zero quaternion, or other shapes.
    """
    if model not in _COLMAP_MODELS:
        raise ValueError(
            f"COLMAP camera model {model!r} is not a pinhole; undistort the images first "
            "(`colmap image_undistorter`), which gives PINHOLE. Known models: SIMPLE_PINHOLE, PINHOLE"
        )
    _check_shape("qvec", qvec, 4)
    _check_shape("tvec", tvec, 3)
    _check_shape(f"params of {model}", params, _COLMAP_MODELS[model])
    if (qvec == 0).all(-1).any():
        raise ValueError("qvec holds a zero quaternion, which is no rotation")
    flip = qvec.new_tensor([-1.0, -1.0, 1.0])
    R = quaternion_to_matrix(qvec).transpose(1, 2) * flip
    focal = params[:, :-2].expand(-1, 2)
    return _pinhole(R, tvec * flip, focal, params[:, -2:], image_size, in_ndc)


def colmap_from_cameras(cameras: CamerasBase, image_size: Any = None) -> ColmapCameras:
    """COLMAP's parameters of pinhole cameras, model PINHOLE; the inverse of `cameras_from_colmap`.

    Arguments and errors as `opencv_from_cameras`.
    """
    R, tvec, matrix, size = opencv_from_cameras(cameras, image_size)
    focal = matrix.diagonal(dim1=1, dim2=2)[:, :2]
    params = torch.cat((focal, matrix[:, :2, 2]), dim=-1)
    return ColmapCameras(matrix_to_quaternion(R), tvec, "PINHOLE", params, size)


def _pinhole(
    R: Tensor, T: Tensor, focal: Tensor, principal: Tensor, image_size: Any, in_ndc: bool
) -> PerspectiveCameras:
    """Cameras of a pose as it is here and intrinsics in pixels, each (N, ·) or (1, ·)."""
    size = _size(image_size, R)
    if in_ndc:
        scale = 2.0 / size.amin(-1, keepdim=True)
        focal, principal = focal * scale, (0.5 * size.flip(-1) - principal) * scale
    return PerspectiveCameras(focal, principal, R=R, T=T, in_ndc=in_ndc, image_size=size, device=R.device)


def _intrinsics_px(cameras: CamerasBase, image_size: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Focal length, principal point and image size, (N, 2) each, of pinhole cameras."""
    try:
        perspective = cameras.is_perspective()
    except (AttributeError, NotImplementedError):
        perspective = False
    if not perspective:
        raise ValueError(f"Expected PerspectiveCameras or FoVPerspectiveCameras; got {type(cameras).__name__}")
    image_size = cameras.get_image_size() if image_size is None else image_size
    if image_size is None:
        raise ValueError("These cameras have no image size; give image_size=(height, width)")
    size = _size(image_size, cameras.R).expand(len(cameras), 2)
    K = cameras.get_projection_transform().get_matrix().transpose(1, 2)
    stray = torch.cat((K[:, 0, 1:2], K[:, 1, :1], K[:, :2, 3], K[:, 3, :2], K[:, 3, 3:], K[:, 3, 2:3] - 1.0), dim=1)
    if (stray.abs() > 1e-6 * K[:, :2, :2].abs().amax(dim=(1, 2))[:, None]).any():
        raise ValueError("K is not of the form [fx, 0, px, 0], [0, fy, py, 0], ..., [0, 0, 1, 0] of a pinhole")
    focal, principal = torch.stack((K[:, 0, 0], K[:, 1, 1]), dim=-1), K[:, :2, 2]
    if not cameras.in_ndc():
        return focal, principal, size
    scale = 0.5 * size.amin(-1, keepdim=True)
    return focal * scale, 0.5 * size.flip(-1) - principal * scale, size


def _focal_px(like: Tensor, size: Tensor, focal: Any, fov_x_deg: Any, fov_y_deg: Any) -> Tensor:
    """The focal length (N, 2) in pixels of whichever of the three is given."""
    given = [v for v in (focal, fov_x_deg, fov_y_deg) if v is not None]
    if len(given) != 1:
        raise ValueError(f"Give exactly one of focal_length_px, fov_x_deg and fov_y_deg; got {len(given)} of them")
    value = _like(given[0], like)
    value = value if value.dim() == 2 else value.reshape(-1, 1)
    if focal is None:
        side = size[:, 1:] if fov_y_deg is None else size[:, :1]
        value = 0.5 * side / torch.tan(value * (math.pi / 360.0))
    return value.expand(-1, 2)


def _like(value: Any, like: Tensor) -> Tensor:
    """A number, list or tensor as a tensor in the dtype and on the device of `like`."""
    return torch.as_tensor(value, dtype=like.dtype, device=like.device)


def _size(image_size: Any, like: Tensor) -> Tensor:
    """An image size (H, W) or (N, 2) as (N, 2)."""
    size = _like(image_size, like)
    if size.dim() not in (1, 2) or size.shape[-1] != 2:
        raise ValueError(f"Expected image_size (height, width) or of shape (N, 2); got {tuple(size.shape)}")
    return size.view(-1, 2)


def _check_shape(name: str, tensor: Tensor, *last: int) -> None:
    """Raises ValueError unless the tensor is (N, *last)."""
    if tensor.dim() != 1 + len(last) or tuple(tensor.shape[1:]) != last:
        expected = ", ".join(("N", *map(str, last)))
        raise ValueError(f"Expected {name} of shape ({expected}); got {tuple(tensor.shape)}")


def _check_rotation(name: str, matrix: Tensor) -> None:
    """Raises ValueError unless every matrix (N, 3, 3) is a rotation to within 1e-3."""
    _check_shape(name, matrix, 3, 3)
    eye = torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    off = (matrix @ matrix.transpose(1, 2) - eye).abs().amax(dim=(1, 2))
    wrong = (off > _ORTHONORMAL_TOLERANCE) | (torch.linalg.det(matrix) <= 0)
    if wrong.any():
        which = int(wrong.nonzero()[0])
        raise ValueError(f"Expected {name} to be a rotation; number {which} scales, shears or mirrors")
