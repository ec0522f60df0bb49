"""Shapes to start from or to stand on, and OpenCV's cameras."""

from rendra.utils.camera_conversions import cameras_from_opencv_projection, opencv_from_cameras_projection
from rendra.utils.checkerboard import checkerboard
from rendra.utils.ico_sphere import ico_sphere
from rendra.utils.torus import torus

__all__ = ["cameras_from_opencv_projection", "checkerboard", "ico_sphere", "opencv_from_cameras_projection", "torus"]
