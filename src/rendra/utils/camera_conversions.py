"""PyTorch3D's two converters between OpenCV's camera parameters and `PerspectiveCameras`.

`rendra.renderer.camera_conversions` has the same and more: the pixel convention as an argument, OpenGL, Blender,
COLMAP.
"""

from torch import Tensor

from rendra.renderer.camera_conversions import cameras_from_opencv, opencv_from_cameras
from rendra.renderer.cameras import PerspectiveCameras


def cameras_from_opencv_projection(
    R: Tensor, tvec: Tensor, camera_matrix: Tensor, image_size: Tensor
) -> PerspectiveCameras:
    """Cameras, in NDC, of OpenCV's parameters.

    Args:
        R: rotation (N, 3, 3) from world to camera, for column vectors.
        tvec: translation (N, 3).
        camera_matrix: (N, 3, 3), in pixels from the upper-left corner of the image.
        image_size: (N, 2) as (H, W).

    Raises:
        ValueError: for other shapes, skew, or an R that is no rotation.
    """
    return cameras_from_opencv(R, tvec, camera_matrix, image_size)


def opencv_from_cameras_projection(cameras: PerspectiveCameras, image_size: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """R (N, 3, 3), tvec (N, 3) and camera_matrix (N, 3, 3) of cameras; inverse of the above.

    Args:
        cameras: `PerspectiveCameras` or `FoVPerspectiveCameras`.
        image_size: (N, 2) as (H, W).

    Raises:
        ValueError: for other cameras, or a K that is no pinhole's.
    """
    return opencv_from_cameras(cameras, image_size)[:3]
