"""Converters: the pixels of each convention's own formula, and round trips, on awkward cameras."""

import math

import pytest
import torch
from assertions import assert_close
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from rendra.renderer.camera_conversions import (
    cameras_from_colmap,
    cameras_from_opencv,
    cameras_from_opengl,
    colmap_from_cameras,
    opencv_from_cameras,
    opengl_from_cameras,
)
from rendra.renderer.cameras import FoVPerspectiveCameras, OrthographicCameras, PerspectiveCameras
from rendra.transforms import matrix_to_quaternion, random_rotations
from rendra.utils.camera_conversions import cameras_from_opencv_projection, opencv_from_cameras_projection

number = st.floats(-1.0, 1.0)
cases = st.tuples(
    st.integers(0, 10**6), st.integers(1, 3000), st.integers(1, 3000), st.floats(5, 5000), number, number
)


def opencv(seed: int, n: int, h: int, w: int, focal: float, dx: float, dy: float) -> dict[str, Tensor]:
    """Random poses with an off-centre principal point and pixels that are not square."""
    torch.manual_seed(seed)
    matrix = torch.zeros(n, 3, 3, dtype=torch.float64)
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 2, 2] = focal, 1.1 * focal, 1
    matrix[:, 0, 2], matrix[:, 1, 2] = w / 2 * (1 + dx), h / 2 * (1 + dy)
    return {
        "R": random_rotations(n, dtype=torch.float64),
        "tvec": torch.randn(n, 3, dtype=torch.float64),
        "camera_matrix": matrix,
        "image_size": torch.tensor([[h, w]]).expand(n, 2),
    }


def world_before(R: Tensor, tvec: Tensor) -> tuple[Tensor, Tensor]:
    """Points (N, 5, 3) before OpenCV cameras: in the world, and in the cameras."""
    camera = torch.randn(len(R), 5, 3, dtype=torch.float64)
    camera[..., 2] = camera[..., 2].abs() + 0.5
    return (camera - tvec[:, None]) @ R, camera


@settings(max_examples=25, deadline=None)
@given(cases, st.booleans())
def test_opencv_pixels_agree_and_come_back(case: tuple, in_ndc: bool) -> None:
    seed, h, w, focal, dx, dy = case
    given_ = opencv(seed, 2, h, w, focal, dx, dy)
    cameras = cameras_from_opencv(**given_, in_ndc=in_ndc)
    world, camera = world_before(given_["R"], given_["tvec"])
    pixels = camera @ given_["camera_matrix"].mT
    pixels = pixels[..., :2] / pixels[..., 2:]
    assert_close(cameras.transform_points_screen(world)[..., :2], pixels, atol=1e-6, rtol=1e-8)
    for actual, expected in zip(opencv_from_cameras(cameras), given_.values(), strict=True):
        assert_close(actual, expected, atol=1e-8, rtol=1e-8)


@settings(max_examples=25, deadline=None)
@given(cases, st.booleans())
def test_opengl_pixels_agree_and_come_back(case: tuple, in_ndc: bool) -> None:
    seed, h, w, focal, dx, dy = case
    torch.manual_seed(seed)
    matrix = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    matrix[:, :3, :3], matrix[:, :3, 3] = random_rotations(2), torch.randn(2, 3)
    focal_px = torch.tensor([[focal, 0.9 * focal]], dtype=torch.float64).expand(2, 2)
    centre = torch.tensor([[w / 2 * (1 + dx), h / 2 * (1 + dy)]], dtype=torch.float64).expand(2, 2)
    cameras = cameras_from_opengl(matrix, (h, w), focal_length_px=focal_px, principal_point_px=centre, in_ndc=in_ndc)
    local = torch.randn(2, 5, 3, dtype=torch.float64)
    local[..., 2] = -local[..., 2].abs() - 0.5  # OpenGL looks along -z
    world = local @ matrix[:, :3, :3].mT + matrix[:, None, :3, 3]
    u = centre[:, None, 0] + focal * local[..., 0] / -local[..., 2]
    v = centre[:, None, 1] - 0.9 * focal * local[..., 1] / -local[..., 2]
    tolerance = {"atol": 1e-4 * max(1.0, focal / 100), "rtol": 1e-5}  # the random poses above are float32
    assert_close(cameras.transform_points_screen(world)[..., :2], torch.stack((u, v), -1), **tolerance)
    back = opengl_from_cameras(cameras)
    assert_close(back.camera_to_world, matrix, atol=1e-5)
    assert_close(back.focal_length_px, focal_px, rtol=1e-8)
    assert_close(back.principal_point_px, centre, atol=1e-8, rtol=1e-8)
    assert_close(back.image_size, torch.tensor([[h, w]]).expand(2, 2))


@settings(max_examples=25, deadline=None)
@given(cases, st.sampled_from(["SIMPLE_PINHOLE", "PINHOLE"]))
def test_colmap_pixels_agree_and_come_back(case: tuple, model: str) -> None:
    seed, h, w, focal, dx, dy = case
    plain = opencv(seed, 2, h, w, focal, dx, dy)
    world, camera = world_before(plain["R"], plain["tvec"])
    centre = plain["camera_matrix"][:, :2, 2]
    f = plain["camera_matrix"].diagonal(dim1=1, dim2=2)[:, : 1 if model == "SIMPLE_PINHOLE" else 2]
    qvec = matrix_to_quaternion(plain["R"])
    params = torch.cat((f, centre), -1)
    cameras = cameras_from_colmap(-2 * qvec, plain["tvec"], model, params, (h, w))
    pixels = camera[..., :2] / camera[..., 2:] * f[:, None] + centre[:, None]
    assert_close(cameras.transform_points_screen(world)[..., :2], pixels, atol=1e-6, rtol=1e-8)
    back = colmap_from_cameras(cameras)
    assert back.model == "PINHOLE"
    assert_close(back.qvec, qvec, atol=1e-10)
    assert_close(back.tvec, plain["tvec"])
    assert_close(back.params, torch.cat((f.expand(-1, 2), centre), -1), atol=1e-8, rtol=1e-8)


def test_opencv_counts_from_the_first_pixels_centre_on_request() -> None:
    plain = opencv(1, 1, 30, 40, 50.0, 0.1, 0.2)
    corner, centre = cameras_from_opencv(**plain), cameras_from_opencv(**plain, first_pixel_center=0.0)
    world, _ = world_before(plain["R"], plain["tvec"])
    shift = (centre.transform_points_screen(world) - corner.transform_points_screen(world))[..., :2]
    assert_close(shift, torch.full((5, 2), 0.5).expand_as(shift))
    back = opencv_from_cameras(centre, first_pixel_center=0.0)
    assert_close(back.camera_matrix, plain["camera_matrix"])


def test_the_three_conventions_describe_one_camera() -> None:
    plain = opencv(2, 3, 30, 40, 50.0, 0.1, 0.2)
    cameras = cameras_from_opencv(**plain)
    world, _ = world_before(plain["R"], plain["tvec"])
    expected = cameras.transform_points_screen(world)
    gl = opengl_from_cameras(cameras)
    again = cameras_from_opengl(
        gl.camera_to_world,
        gl.image_size,
        focal_length_px=gl.focal_length_px,
        principal_point_px=gl.principal_point_px,
    )
    assert_close(again.transform_points_screen(world), expected)
    assert_close(cameras_from_colmap(*colmap_from_cameras(cameras)).transform_points_screen(world), expected)


def test_a_blender_camera_by_hand() -> None:
    # at (0, -5, 0), upright in a Z-up world, looking along +Y: Blender's rotation of 90 degrees about X
    matrix = torch.tensor([[1.0, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 0], [0, 0, 0, 1]])
    cameras = cameras_from_opengl(matrix, (60, 80), fov_x_deg=90)
    pixels = cameras.transform_points_screen(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 0, 1], [5, 0, 0]]))
    assert_close(pixels[:, :2], [[40.0, 30], [48, 30], [40, 22], [80, 30]], atol=1e-4)
    assert_close(cameras.get_camera_center(), [[0.0, -5, 0]])


def test_fields_of_view_are_those_of_the_sides() -> None:
    eye, size = torch.eye(4), (60, 80)
    wide = opengl_from_cameras(cameras_from_opengl(eye, size, fov_x_deg=70.0)).focal_length_px
    assert_close(2 * torch.atan(40 / wide[0, 0]), math.radians(70))
    tall = opengl_from_cameras(cameras_from_opengl(eye, size, fov_y_deg=torch.tensor([70.0]))).focal_length_px
    assert_close(2 * torch.atan(30 / tall[0, 1]), math.radians(70))
    fov = FoVPerspectiveCameras(fov=70.0)  # the short side is the height
    assert_close(opengl_from_cameras(fov, image_size=size).focal_length_px, tall)


def test_pytorch3ds_two_functions() -> None:
    plain = opencv(3, 2, 48, 64, 70.0, 0.1, -0.1)
    cameras = cameras_from_opencv_projection(**plain)
    assert cameras.in_ndc()
    s = 24
    assert_close(cameras.focal_length[0], [70 / s, 77 / s])
    assert_close(cameras.principal_point[0], [-(35.2 - 32) / s, -(21.6 - 24) / s])
    back = opencv_from_cameras_projection(cameras, plain["image_size"])
    for actual, expected in zip(back, plain.values(), strict=False):
        assert_close(actual, expected)


def test_gradients_pass_both_ways() -> None:
    plain = opencv(4, 1, 30, 40, 50.0, 0.1, 0.2)

    def round_trip(tvec: Tensor, focal: Tensor) -> Tensor:
        matrix = plain["camera_matrix"] * torch.stack((focal, focal, torch.ones_like(focal)))[:, None]
        cameras = cameras_from_opencv(plain["R"], tvec, matrix, (30, 40))
        back = opencv_from_cameras(cameras)
        return torch.cat((back.tvec.flatten(), back.camera_matrix.flatten(), cameras.focal_length.flatten()))

    leaves = (plain["tvec"].requires_grad_(), torch.tensor(1.2, dtype=torch.float64, requires_grad=True))
    assert torch.autograd.gradcheck(round_trip, leaves)


def test_what_a_pinhole_cannot_hold_is_refused() -> None:
    plain = opencv(5, 2, 30, 40, 50.0, 0.0, 0.0)
    skew = plain["camera_matrix"].clone()
    skew[1, 0, 1] = 1.0
    scaled = torch.eye(4).repeat(2, 1, 1)
    scaled[1, :3, :3] *= 2
    mirrored = torch.diag(torch.tensor([1.0, 1, -1, 1]))
    q, t = torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1, 3)
    K = torch.eye(4)[None]
    for make, message in (
        (lambda: cameras_from_opencv(**{**plain, "camera_matrix": skew}), "skew"),
        (lambda: cameras_from_opencv(**{**plain, "R": 2 * plain["R"]}), "R to be a rotation; number 0"),
        (lambda: cameras_from_opencv(**{**plain, "tvec": plain["tvec"][0]}), r"tvec of shape \(N, 3\)"),
        (lambda: cameras_from_opencv(**{**plain, "image_size": (1, 2, 3)}), "image_size"),
        (lambda: cameras_from_opengl(scaled, (3, 4), fov_x_deg=60), "number 1 scales"),
        (lambda: cameras_from_opengl(mirrored, (3, 4), fov_x_deg=60), "mirrors"),
        (lambda: cameras_from_opengl(torch.eye(4), (3, 4)), "exactly one of"),
        (lambda: cameras_from_opengl(torch.eye(4), (3, 4), fov_x_deg=1, fov_y_deg=1), "got 2"),
        (lambda: cameras_from_colmap(q, t, "SIMPLE_RADIAL", torch.ones(1, 4), (3, 4)), "SIMPLE_RADIAL.*undistort"),
        (lambda: cameras_from_colmap(q, t, "PINHOLE", torch.ones(1, 3), (3, 4)), "params of PINHOLE"),
        (lambda: cameras_from_colmap(0 * q, t, "PINHOLE", torch.ones(1, 4), (3, 4)), "zero quaternion"),
        (lambda: opencv_from_cameras(OrthographicCameras(), (3, 4)), "got OrthographicCameras"),
        (lambda: opencv_from_cameras(PerspectiveCameras()), "no image size"),
        (lambda: opencv_from_cameras(PerspectiveCameras(K=K), (3, 4)), "K is not of the form"),
    ):
        with pytest.raises(ValueError, match=message):
            make()
