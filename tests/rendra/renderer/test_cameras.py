"""Cameras: anchors of PyTorch3D 0.7.9, closed forms, round trips, overriding, indexing, gradients."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import Tensor

from rendra.renderer import cameras as c
from rendra.transforms import Transform3d, random_rotations


def pose(n: int = 3, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    return {"R": random_rotations(n, dtype=dtype), "T": torch.randn(n, 3, dtype=dtype) + torch.tensor([0, 0, 4])}


def made(name: str, n: int = 3) -> c.CamerasBase:
    """A batch of n different cameras."""
    number = torch.linspace(1, 1.4, n, dtype=torch.float64)
    focal, centre = torch.stack((number, 1.3 * number), -1), torch.stack((0.1 * number, -0.2 * number), -1)
    size = torch.tensor([[128, 256], [300, 200], [64, 64]])[:n]
    box = {"max_x": number, "min_x": -2 * number, "max_y": 3.0, "min_y": -0.5}
    K = torch.tensor([[1.2, 0.1, 0.2, 0.3], [0.0, 1.5, -0.1, 0.2], [0.1, 0, 1.3, 0.4], [0, 0, 1, 0]]).double()
    pixels = {"in_ndc": False, "image_size": size}
    builders: dict[str, Callable[[], c.CamerasBase]] = {
        "fov": lambda: c.FoVPerspectiveCameras(0.5 * number, 20, 1.2, 50 * number, **pose(n)),
        "fov_radians": lambda: c.FoVPerspectiveCameras(fov=number, degrees=False, **pose(n)),
        "fov_K": lambda: c.FoVPerspectiveCameras(K=K.expand(n, 4, 4), **pose(n)),
        "fov_ortho": lambda: c.FoVOrthographicCameras(0.5, 9.0, scale_xyz=((1, 2, 3),), **box, **pose(n)),
        "perspective": lambda: c.PerspectiveCameras(focal, centre, image_size=size, **pose(n)),
        "perspective_px": lambda: c.PerspectiveCameras(90 * focal, 70 + 30 * centre, **pixels, **pose(n)),
        "ortho": lambda: c.OrthographicCameras(number, centre, **pose(n)),
        "ortho_px": lambda: c.OrthographicCameras(90 * focal, 70 + 30 * centre, **pixels, **pose(n)),
    }
    return builders[name]()


NAMES = ["fov", "fov_radians", "fov_K", "fov_ortho", "perspective", "perspective_px", "ortho", "ortho_px"]


def in_front(cameras: c.CamerasBase, p: int = 7) -> Tensor:
    """World points (N, P, 3) between 1 and 5 units before the cameras."""
    view = torch.randn(len(cameras), p, 3, dtype=torch.float64)
    view[..., 2] = 1 + 4 * torch.rand(len(cameras), p)
    return cameras.get_world_to_view_transform().inverse().transform_points(view)


def test_anchors() -> None:
    R, T = c.look_at_view_transform(2.7, 30, 40)
    assert_close(T, [[0, 0, 2.7]], atol=1e-6)
    assert_close(c.FoVPerspectiveCameras(R=R, T=T).get_camera_center(), [[1.5030, 1.3500, 1.7912]], atol=5e-5)
    matrix = c.FoVPerspectiveCameras().get_projection_transform().get_matrix()
    rows = [[1.7321, 0, 0, 0], [0, 1.7321, 0, 0], [0, 0, 1.0101, 1], [0, 0, -1.0101, 0]]
    assert_close(matrix, [rows], atol=5e-5)
    camera = c.PerspectiveCameras(300, ((100, 60),), in_ndc=False, image_size=((128, 256),))
    point = torch.tensor([[0.1, 0.2, 2]])
    assert_close(camera.transform_points_ndc(point), [[0.671875, 0.53125, 0.5]])
    assert_close(camera.transform_points_screen(point), [[85.0, 30, 0.5]])
    assert_close(camera.transform_points(point), [[115.0, 90, 0.5]])


def test_the_chain_is_view_then_projection() -> None:
    for name in NAMES:
        cameras = made(name)
        points = in_front(cameras)
        view = cameras.get_world_to_view_transform().transform_points(points)
        assert_close(view, points @ cameras.R + cameras.T[:, None])
        projected = cameras.get_projection_transform().transform_points(view)
        assert_close(cameras.transform_points(points), projected)
        assert_close(cameras.get_full_projection_transform().transform_points(points), projected)
        ndc = cameras.get_ndc_camera_transform().transform_points(projected)
        assert_close(cameras.transform_points_ndc(points), ndc)


def test_projections_by_hand() -> None:
    x, y, z = torch.tensor([0.3, -0.4, 2.5]).unbind()
    point = torch.stack((x, y, z))[None]
    s = 1 / math.tan(math.radians(20))
    out = c.FoVPerspectiveCameras(0.5, 10, 1.5, 40).transform_points(point)
    assert_close(out, [[s * x / 1.5 / z, s * y / z, 10 / 9.5 * (z - 0.5) / z]])
    out = c.FoVOrthographicCameras(0.5, 10, 3, -1, 2, -2, ((1, 1, 2),)).transform_points(point)
    assert_close(out, [[x / 2, (y - 1) / 2, (2 * z - 0.5) / 9.5]])  # the scale is the factor's, not the shift's
    out = c.PerspectiveCameras(((2.0, 3.0),), ((0.1, 0.2),)).transform_points(point)
    assert_close(out, [[2 * x / z + 0.1, 3 * y / z + 0.2, 1 / z]])
    out = c.OrthographicCameras(((2.0, 3.0),), ((0.1, 0.2),)).transform_points(point)
    assert_close(out, [[2 * x + 0.1, 3 * y + 0.2, z]])


def test_fov_planes_map_to_zero_and_one() -> None:
    points = torch.tensor([[0.0, 0, 0.5], [0, 0, 20.0]])
    for cameras in (c.FoVPerspectiveCameras(0.5, 20.0), c.FoVOrthographicCameras(0.5, 20.0)):
        assert_close(cameras.transform_points(points)[:, 2], [0.0, 1.0])
        assert_close(cameras.get_znear(), [0.5])


@pytest.mark.parametrize("name", NAMES)
def test_unprojecting_undoes_projecting(name: str) -> None:
    cameras = made(name)
    points = in_front(cameras)
    view = cameras.get_world_to_view_transform().transform_points(points)
    projected = cameras.transform_points(points)
    xy_depth = torch.cat((projected[..., :2], view[..., 2:]), dim=-1)
    assert_close(cameras.unproject_points(xy_depth), points, atol=1e-9)
    assert_close(cameras.unproject_points(xy_depth, world_coordinates=False), view, atol=1e-9)
    ndc = torch.cat((cameras.transform_points_ndc(points)[..., :2], view[..., 2:]), dim=-1)
    assert_close(cameras.unproject_points(ndc, from_ndc=True), points, atol=1e-9)
    one = cameras[1]
    assert one.unproject_points(xy_depth[1]).shape == (7, 3)
    assert cameras.unproject_points(xy_depth[1]).shape == (3, 7, 3)
    if name.startswith("fov_ortho") or name in ("fov", "fov_radians"):
        assert_close(cameras.unproject_points(projected, scaled_depth_input=True), points, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_screen_and_ndc(name: str) -> None:
    cameras = made(name)
    points = in_front(cameras)
    size = torch.tensor([[128, 256], [300, 200], [64, 64]])
    h, w = size[:, None, 0], size[:, None, 1]
    ndc, screen = cameras.transform_points_ndc(points), cameras.transform_points_screen(points, image_size=size)
    s = torch.minimum(h, w) / 2
    assert_close(screen[..., 0], w / 2 - s * ndc[..., 0], rtol=1e-6)
    assert_close(screen[..., 1], h / 2 - s * ndc[..., 1], rtol=1e-6)
    assert_close(screen[..., 2], ndc[..., 2])
    plain = cameras.transform_points_screen(points, with_xyflip=False, image_size=size)
    assert_close(plain[..., :2], -screen[..., :2])
    for flip in (False, True):
        forth = c.get_ndc_to_screen_transform(cameras, flip, image_size=size)
        back = c.get_screen_to_ndc_transform(cameras, flip, image_size=size)
        assert_close(forth.compose(back).get_matrix(), torch.eye(4).expand(3, 4, 4))


def test_the_corners_of_ndc_are_the_corners_of_the_image() -> None:
    corner = torch.tensor([[2.0, 1.0, 0.5], [-2.0, -1.0, 0.5]])  # 2:1, so x reaches 2
    to_screen = c.get_ndc_to_screen_transform(c.PerspectiveCameras(), with_xyflip=True, image_size=(100, 200))
    assert_close(to_screen.transform_points(corner), [[0, 0, 0.5], [200, 100, 0.5]])


def test_pixels_and_ndc_describe_one_camera() -> None:
    px = made("perspective_px")
    h, w = px.image_size.unbind(-1)
    s = torch.minimum(h, w)[:, None] / 2
    centre = -(px.principal_point - torch.stack((w, h), -1) / 2) / s
    ndc = c.PerspectiveCameras(px.focal_length / s, centre, px.R, px.T, image_size=px.image_size)
    points = in_front(px)
    assert_close(ndc.transform_points_ndc(points), px.transform_points_ndc(points))
    assert_close(ndc.transform_points_screen(points), px.transform_points_screen(points))


@pytest.mark.parametrize("name", NAMES)
def test_the_centre_is_where_the_view_is_zero(name: str) -> None:
    cameras = made(name)
    centre = cameras.get_camera_center()
    view = cameras.get_world_to_view_transform().transform_points(centre[:, None])
    assert_close(view, torch.zeros(3, 1, 3), atol=1e-12)


def test_what_a_class_is() -> None:
    facts = {n: (made(n).is_perspective(), made(n).in_ndc(), made(n).get_znear() is not None) for n in NAMES}
    for name, (perspective, in_ndc, znear) in facts.items():
        assert perspective == ("ortho" not in name)
        assert in_ndc == (not name.endswith("_px"))
        assert znear == name.startswith("fov")


def test_fields_given_at_a_call_override() -> None:
    new = pose(3)
    for name in NAMES:
        cameras, other = made(name), made(name)
        points = in_front(cameras)
        other.R, other.T = new["R"], new["T"]
        expected = other.transform_points(points)
        assert_close(cameras.transform_points(points, **new), expected)
        # a shader asks for the centre after the rasteriser was given the pose
        assert_close(cameras.get_camera_center(), other.get_camera_center())
    point = torch.tensor([[0.1, 0.2, 2.0]])
    fov = c.FoVPerspectiveCameras()
    for kwargs in ({"fov": 30.0}, {"znear": 0.1, "zfar": 5}, {"aspect_ratio": 2.0}, {"degrees": False, "fov": 1}):
        expected = c.FoVPerspectiveCameras(**kwargs).transform_points(point)  # type: ignore[arg-type]
        assert_close(fov.transform_points(point, **kwargs), expected)
    focal = {"focal_length": torch.tensor([[2.0, 3.0]]), "principal_point": torch.tensor([[0.1, 0.3]])}
    expected = c.PerspectiveCameras(**focal).transform_points(point)
    assert_close(c.PerspectiveCameras().transform_points(point, **focal), expected)
    assert_close(c.PerspectiveCameras().transform_points(point, focal_length=2), [[0.1, 0.2, 0.5]])
    K = torch.diag(torch.tensor([2.0, 2, 1, 1]))[None]
    assert_close(fov.transform_points(point, K=K), [[0.2, 0.4, 2.0]])


def test_one_camera_takes_a_batch_of_poses() -> None:
    cameras, points = c.FoVPerspectiveCameras(), torch.randn(5, 3)
    out = cameras.transform_points(points, **pose(4, torch.float32))
    assert out.shape == (4, 5, 3)
    assert cameras.get_camera_center().shape == (4, 3)
    assert c.FoVPerspectiveCameras().transform_points(points, T=torch.ones(2, 3)).shape == (2, 5, 3)


def test_a_parameter_given_as_pose_stays_its_owners() -> None:
    cameras = c.FoVPerspectiveCameras()
    T = torch.nn.Parameter(torch.tensor([[0.0, 0, 3]]))
    for _ in range(2):
        cameras.transform_points(torch.zeros(1, 3), T=T).sum().backward()
        cameras.transform_points(torch.zeros(1, 3), T=T.detach())
    assert not list(cameras.parameters())
    assert_finite(T.grad)


INDICES: list[tuple[Any, list[int]]] = [
    (1, [1]),
    (-1, [2]),
    ([2, 0], [2, 0]),
    (slice(1, 3), [1, 2]),
    (torch.tensor([0, 2]), [0, 2]),
    (torch.tensor(1), [1]),
    (torch.tensor([True, False, True]), [0, 2]),
    ([], []),
    (torch.zeros(3, dtype=torch.bool), []),
]


@pytest.mark.parametrize(("index", "expected"), INDICES)
@pytest.mark.parametrize("name", NAMES)
def test_indexing_chooses_cameras(name: str, index: Any, expected: list[int]) -> None:
    cameras = made(name)
    points = in_front(cameras)
    chosen = cameras[index]
    assert type(chosen) is type(cameras)
    assert len(chosen) == len(expected)
    assert chosen.in_ndc() == cameras.in_ndc()
    assert_close(chosen.transform_points(points[expected]), cameras.transform_points(points)[expected])


def test_indexing_refuses() -> None:
    cameras = made("fov")
    for index in (3, -4, [0, 5], torch.tensor([3])):
        with pytest.raises(IndexError, match="out of bounds"):
            cameras[index]
    with pytest.raises(ValueError, match="Boolean index of shape"):
        cameras[torch.tensor([True, False])]
    for index in ("a", 1.0, [0.5], torch.tensor([0.5])):
        with pytest.raises(ValueError, match="Invalid index type"):
            cameras[index]


@pytest.mark.parametrize("name", NAMES)
def test_a_clone_is_equal_and_separate(name: str) -> None:
    cameras = made(name)
    points = in_front(cameras)
    expected = cameras.transform_points(points)
    copy = cameras.clone()
    assert len(copy) == 3
    cameras.T += 1
    assert_close(copy.transform_points(points), expected)
    assert copy.to("cpu") is copy


def test_default_poses_are_not_shared() -> None:
    first, second = c.PerspectiveCameras(), c.PerspectiveCameras()
    first.T += 1
    first.R *= 2
    assert_close(second.T, torch.zeros(1, 3))
    assert_close(c.FoVPerspectiveCameras().R, torch.eye(3)[None])


@pytest.mark.parametrize("name", NAMES)
def test_gradients_reach_the_pose(name: str) -> None:
    cameras = made(name)
    points = in_front(cameras, 3)
    R, T = cameras.R.clone().requires_grad_(), cameras.T.clone().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda R, T: cameras.transform_points_ndc(points, R=R, T=T), (R, T), fast_mode=True
    )
    xy_depth = (torch.rand(3, 4, 3, dtype=torch.float64) + 0.5).requires_grad_()
    unproject = lambda x, R, T: cameras.unproject_points(x, R=R, T=T)  # noqa: E731
    assert torch.autograd.gradcheck(unproject, (xy_depth, R, T), fast_mode=True)


def test_gradients_reach_the_lens() -> None:
    points = torch.tensor([[0.1, 0.2, 2.0], [-0.4, 0.1, 3.0]], dtype=torch.float64)
    lens = torch.tensor([50.0, 1.2, 0.7, 30.0], dtype=torch.float64, requires_grad=True)

    def fov(lens: Tensor) -> Tensor:
        return c.FoVPerspectiveCameras(lens[2:3], lens[3:], lens[1:2], lens[:1]).transform_points(points)

    def focal(lens: Tensor) -> Tensor:
        size = ((40, 60),)
        kwargs = {"principal_point": lens[None, 2:], "in_ndc": False, "image_size": size}
        return c.PerspectiveCameras(lens[None, :2], **kwargs).transform_points_screen(points)

    assert torch.autograd.gradcheck(fov, (lens,))
    assert torch.autograd.gradcheck(focal, (lens,))


def test_look_at_looks_at() -> None:
    eye, at, up = torch.randn(3, 20, 3, dtype=torch.float64)
    R, T = c.look_at_view_transform(eye=eye, at=at, up=up)
    assert_close(R @ R.mT, torch.eye(3).expand(20, 3, 3), atol=1e-12)
    assert_close(torch.linalg.det(R), torch.ones(20))
    camera = c.PerspectiveCameras(R=R, T=T)
    assert_close(camera.get_camera_center(), eye)
    view = camera.get_world_to_view_transform().transform_points(torch.stack((at, at + up), 1))
    assert_close(view[:, 0, :2], torch.zeros(20, 2), atol=1e-12)
    assert (view[:, 0, 2] > 0).all()
    assert_close(view[:, 1, 0], torch.zeros(20), atol=1e-12)  # up stays in the image's vertical plane
    assert (view[:, 1, 1] > 0).all()


def test_spherical_angles() -> None:
    position = c.camera_position_from_spherical_angles(2.0, torch.tensor([0.0, 0, 90]), torch.tensor([0.0, 90, 0]))
    assert_close(position, [[0, 0, 2], [2, 0, 0], [0, 2, 0]], atol=1e-6)
    radians = c.camera_position_from_spherical_angles(2.0, 0.0, math.pi / 2, degrees=False)
    assert_close(radians, position[1:2], atol=1e-6)
    _, T = c.look_at_view_transform(3, 10, torch.arange(5.0), at=((1.0, 2, 3),))
    assert T.shape == (5, 3)
    R, T = c.look_at_view_transform(3, 10, 20, at=((1.0, 2, 3),))
    assert_close((torch.tensor([[1.0, 2, 3]]) @ R[0] + T), [[0, 0, 3]], atol=1e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_looking_along_up_gives_a_rotation_with_finite_gradients(sign: float) -> None:
    eye = torch.tensor([[0.0, sign * 3, 0]], requires_grad=True)
    R, T = c.look_at_view_transform(eye=eye)
    assert_close(R @ R.mT, torch.eye(3)[None])
    assert_close(torch.linalg.det(R), [1.0])
    (R.sum() + T.sum()).backward()
    assert_finite(eye.grad)
    R, _ = c.look_at_view_transform(2.0, sign * 90, 30)
    assert_close(R @ R.mT, torch.eye(3)[None], atol=1e-5)


def test_look_at_is_differentiable() -> None:
    eye = torch.tensor([[3.0, 6.9, 2.5]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(c.look_at_rotation, (eye,))


def test_float32_and_float64_meet() -> None:
    cameras = c.FoVPerspectiveCameras(**pose(2))
    assert cameras.transform_points(torch.zeros(3, 3)).dtype == torch.float32
    assert cameras.transform_points(torch.zeros(3, 3).double()).dtype == torch.float64


def test_empty_batches_and_points() -> None:
    empty = c.PerspectiveCameras(R=torch.zeros(0, 3, 3), T=torch.zeros(0, 3))
    assert len(empty) == 0
    assert empty.isempty()
    assert empty.transform_points(torch.zeros(4, 3)).shape == (0, 4, 3)
    assert empty.get_camera_center().shape == (0, 3)
    assert made("fov").transform_points(torch.zeros(0, 3)).shape == (3, 0, 3)
    assert made("fov").unproject_points(torch.zeros(3, 0, 3)).shape == (3, 0, 3)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (c.OpenGLPerspectiveCameras, c.FoVPerspectiveCameras),
        (c.OpenGLOrthographicCameras, c.FoVOrthographicCameras),
        (c.SfMPerspectiveCameras, c.PerspectiveCameras),
        (c.SfMOrthographicCameras, c.OrthographicCameras),
    ],
)
def test_the_old_names_still_work(old: Any, new: Any) -> None:
    with pytest.warns(PendingDeprecationWarning, match=new.__name__):
        cameras = old(T=torch.ones(1, 3))
    assert type(cameras) is new
    point = torch.tensor([[0.1, 0.2, 2.0]])
    assert_close(cameras.transform_points(point), new(T=torch.ones(1, 3)).transform_points(point))


def test_a_camera_without_a_matrix_has_no_projection_transform() -> None:
    assert c.try_get_projection_transform(c.CamerasBase(), {}) is None
    assert isinstance(c.try_get_projection_transform(made("fov"), {}), Transform3d)
    for call in (lambda b: b.unproject_points(None), lambda b: b.is_perspective(), lambda b: b.in_ndc()):
        with pytest.raises(NotImplementedError, match="CamerasBase"):
            call(c.CamerasBase())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: c.PerspectiveCameras(in_ndc=False), "image_size"),
        (lambda: c.PerspectiveCameras(image_size=((0, 5),)), "invalid values"),
        (lambda: c.FoVPerspectiveCameras(R=torch.zeros(2, 3, 3), T=torch.zeros(3, 3)), "non-broadcastable"),
        (lambda: c.get_world_to_view_transform(torch.zeros(3, 3), torch.zeros(1, 3)), "Expected R"),
        (lambda: c.get_world_to_view_transform(torch.zeros(1, 3, 3), torch.zeros(3)), "Expected T"),
        (lambda: c.get_world_to_view_transform(torch.zeros(2, 3, 3), torch.zeros(3, 3)), "same batch"),
        (lambda: c.FoVPerspectiveCameras(K=torch.eye(3)[None]).get_projection_transform(), "Expected K"),
        (lambda: c.FoVPerspectiveCameras().transform_points_screen(torch.zeros(1, 3)), "image_size="),
        (lambda: c.get_ndc_to_screen_transform(made("fov"), image_size=(1, 2, 3)), "Expected image_size"),
        (lambda: c.get_ndc_to_screen_transform(made("fov"), image_size=(0, 2)), "invalid values"),
    ],
)
def test_wrong_input_is_refused(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
