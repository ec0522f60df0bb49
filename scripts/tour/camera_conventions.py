"""One camera in four programs: `python scripts/tour/camera_conventions.py`.

Axes of the camera, all right-handed:
    here, PyTorch3D        x left,  y up,   z into the scene;  rows,    x_view = x_world R + T
    OpenCV, COLMAP         x right, y down, z into the scene;  columns, x_camera = R x_world + t
    OpenGL, Blender, NeRF  x right, y up,   z out of it;       columns, x_world = M (x_camera, 1)
A mixed-up convention gives pictures that are mirrored, upside down or empty, and no error. A converter gives none.
"""

import torch

from rendra.renderer import FoVPerspectiveCameras, look_at_view_transform
from rendra.renderer.camera_conversions import (
    cameras_from_colmap,
    cameras_from_opencv,
    cameras_from_opengl,
    colmap_from_cameras,
    opencv_from_cameras,
    opengl_from_cameras,
)

IMAGE_SIZE = (240, 320)  # height, width
POINT = torch.tensor([[0.3, 0.2, 0.1]])


def main() -> None:
    """Says where each program sees a point, and that it is the same pixel."""
    R, T = look_at_view_transform(dist=3.0, elev=20.0, azim=35.0)
    cameras = FoVPerspectiveCameras(R=R, T=T, fov=50.0)
    pixel = cameras.transform_points_screen(POINT, image_size=IMAGE_SIZE)[0, :2]
    print("here:   view", rounded(cameras.get_world_to_view_transform().transform_points(POINT)[0]), pixel_of(pixel))

    opencv = opencv_from_cameras(cameras, IMAGE_SIZE)
    x = opencv.R[0] @ POINT[0] + opencv.tvec[0]
    u = opencv.camera_matrix[0] @ x
    print("OpenCV: view", rounded(x), pixel_of(u[:2] / u[2]))
    print("        camera matrix", rounded(opencv.camera_matrix[0]))

    opengl = opengl_from_cameras(cameras, IMAGE_SIZE)
    x = (torch.linalg.inv(opengl.camera_to_world[0]) @ torch.cat([POINT[0], torch.ones(1)]))[:3]
    flipped = x[:2] / -x[2] * torch.tensor([1.0, -1.0])  # its y points up, rows count down
    u = opengl.focal_length_px[0] * flipped + opengl.principal_point_px[0]
    print("OpenGL: view", rounded(x), pixel_of(u))
    print("        the camera stands at", rounded(opengl.camera_to_world[0, :3, 3]))

    colmap = colmap_from_cameras(cameras, IMAGE_SIZE)
    print("COLMAP: quaternion", rounded(colmap.qvec[0]), colmap.model, rounded(colmap.params[0]))

    back = {
        "OpenCV": cameras_from_opencv(*opencv),
        "OpenGL": cameras_from_opengl(
            opengl.camera_to_world, opengl.image_size, focal_length_px=opengl.focal_length_px
        ),
        "COLMAP": cameras_from_colmap(*colmap),
    }
    for name, again in back.items():
        there = again.transform_points_screen(POINT, image_size=IMAGE_SIZE)[0, :2]
        print(f"back from {name}: the same pixel:", torch.allclose(there, pixel, atol=1e-2))

    # OpenCV's calibration counts pixels from the CENTRE of the first one, half a pixel further in
    calibrated = opencv_from_cameras(cameras, IMAGE_SIZE, first_pixel_center=0.0)
    print("middle of the picture as OpenCV's calibration has it:", rounded(calibrated.camera_matrix[0, :2, 2]))


def rounded(values: torch.Tensor) -> list:
    """Numbers with three digits behind the point."""
    return values.double().mul(1000).round().div(1000).add(0.0).tolist()


def pixel_of(place: torch.Tensor) -> str:
    """Column and row."""
    return f"-> pixel ({float(place[0]):.2f}, {float(place[1]):.2f})"


if __name__ == "__main__":
    main()
