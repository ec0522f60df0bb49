"""From clouds in the world to fragments: cameras, radii in every form, and errors."""

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.renderer.cameras import (
    FoVOrthographicCameras,
    FoVPerspectiveCameras,
    OrthographicCameras,
    PerspectiveCameras,
    look_at_view_transform,
)
from rendra.renderer.fisheyecameras import FishEyeCameras
from rendra.renderer.points import PointFragments, PointsRasterizationSettings, PointsRasterizer, rasterize_points
from rendra.structures.pointclouds import Pointclouds

CAMERAS = [FoVPerspectiveCameras, FoVOrthographicCameras, PerspectiveCameras, OrthographicCameras, FishEyeCameras]


def clouds(*sizes: int) -> Pointclouds:
    return Pointclouds([torch.rand(size, 3) * 1.6 - 0.8 for size in sizes])


def seen(*sizes: int) -> Pointclouds:
    return clouds(*sizes).offset(torch.tensor([0.0, 0.0, 2.0]))


def assert_same(one, other) -> None:
    for a, b in zip(one, other, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("camera_class", CAMERAS)
def test_transform_gives_ndc_and_view_depth(camera_class) -> None:
    R, T = look_at_view_transform(3.0, 20.0, torch.tensor([10.0, 50.0]))
    cameras, batch = camera_class(R=R, T=T), clouds(9, 9)
    ndc = PointsRasterizer(cameras).transform(batch).points_padded()
    assert_close(ndc[..., :2], cameras.transform_points_ndc(batch.points_padded())[..., :2])
    view = cameras.get_world_to_view_transform().transform_points(batch.points_padded())
    assert_close(ndc[..., 2], view[..., 2])


def test_a_point_falls_on_its_pixel() -> None:
    """As `transform_points_screen` says, in an image that is not square."""
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    cameras, size, points = FoVPerspectiveCameras(R=R, T=T), (40, 70), clouds(30)
    fragments = PointsRasterizer(cameras, PointsRasterizationSettings(size, 0.02, 5))(points)
    screen = cameras.transform_points_screen(points.points_packed(), image_size=(size,))
    for p, (x, y, _) in enumerate(screen.tolist()):
        if 0 <= x < 70 and 0 <= y < 40:
            hit = fragments.idx[0, int(y), int(x)] == p
            distance = ((x - int(x) - 0.5) ** 2 + (y - int(y) - 0.5) ** 2) / 20**2
            assert hit.any() == (distance < 0.02**2)
            if hit.any():
                assert_close(fragments.dists[0, int(y), int(x)][hit], [distance], atol=1e-6)


def test_fragments_are_those_of_the_function() -> None:
    R, T = look_at_view_transform(3.0, 20.0, torch.tensor([10.0, 50.0, 90.0]))
    rasterizer = PointsRasterizer(FoVPerspectiveCameras(R=R, T=T), PointsRasterizationSettings((20, 30), 0.1, 4))
    batch = clouds(40, 0, 15)
    fragments = rasterizer(batch)
    assert isinstance(fragments, PointFragments)
    assert_same(fragments, rasterize_points(rasterizer.transform(batch), (20, 30), 0.1, 4))
    assert (fragments.idx[1] == -1).all()
    assert set(fragments.idx[2].unique().tolist()) <= {-1, *range(40, 55)}


def test_bin_sizes_change_nothing() -> None:
    batch = seen(200)
    assert_same(rasterize_points(batch, 32), rasterize_points(batch, 32, bin_size=8, max_points_per_bin=1))


def test_radii_come_in_every_form() -> None:
    batch = seen(5, 0, 3)
    each = torch.rand(8) * 0.3
    padded = torch.full((3, 5), float("nan"))
    padded[0], padded[2, :3] = each[:5], each[5:]
    expected = rasterize_points(batch, 24, each, 6)
    assert_same(rasterize_points(batch, 24, padded, 6), expected)
    assert_same(rasterize_points(batch, 24, [each[:5], each[5:5], each[5:]], 6), expected)
    assert_same(rasterize_points(batch, 24, padded.nan_to_num(0.0).tolist(), 6), expected)
    assert not torch.equal(rasterize_points(batch, 24, 0.1, 6)[0], expected[0])


@pytest.mark.parametrize(
    "radius", [0.1, torch.tensor(0.1), torch.tensor([0.1]), torch.full((2, 7), 0.1), (0.1,) * 10]
)
def test_equal_radii_are_one_radius(radius) -> None:
    batch = seen(7, 3)
    assert_same(rasterize_points(batch, 24, radius, 6), rasterize_points(batch, 24, torch.full((10,), 0.1), 6))


@pytest.mark.parametrize(
    ("radius", "message"),
    [
        (torch.zeros(3), r"shape \(2, 7\), one for each padded point, or \(10,\), one for each packed point"),
        (torch.zeros(7, 2), r"got shape \(7, 2\)"),
        ([torch.zeros(7), torch.zeros(4)], r"got tensors of shapes \[\(7,\), \(4,\)\]"),
        (-0.1, "radius must be zero or positive"),
    ],
)
def test_wrong_radii_are_named(radius, message) -> None:
    with pytest.raises(ValueError, match=message):
        rasterize_points(seen(7, 3), 24, radius)


@pytest.mark.parametrize("image_size", [(0, 4), -3, (4, 4, 4), (4.0, 4)])
def test_image_sizes_are_checked(image_size) -> None:
    with pytest.raises(ValueError, match=r"[Ii]mage size"):
        rasterize_points(seen(3), image_size)


def test_calls_may_replace_cameras_settings_and_pose() -> None:
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    batch, settings = clouds(30), PointsRasterizationSettings(16, 0.1)
    expected = PointsRasterizer(FoVPerspectiveCameras(R=R, T=T), settings)(batch)
    assert_same(
        PointsRasterizer()(batch, cameras=FoVPerspectiveCameras(R=R, T=T), raster_settings=settings), expected
    )
    assert_same(PointsRasterizer(FoVPerspectiveCameras(), settings)(batch, R=R, T=T), expected)


def test_cameras_are_demanded_and_counted() -> None:
    with pytest.raises(ValueError, match=r"Cameras must be specified .* PointsRasterizer"):
        PointsRasterizer()(clouds(3))
    R, T = look_at_view_transform(3.0, 20.0, torch.tensor([10.0, 20.0, 30.0]))
    with pytest.raises(ValueError, match=r"Wrong number \(3\) of cameras for 2 clouds"):
        PointsRasterizer(FoVPerspectiveCameras(R=R, T=T))(clouds(3, 3))


def test_points_behind_the_camera_are_not_seen() -> None:
    """Mirrored through the camera, a perspective projection puts them on the same pixel."""
    points = torch.tensor([[0.1, 0.2, -2.0], [-0.1, -0.2, 3.0]])
    fragments = PointsRasterizer(FoVPerspectiveCameras(), PointsRasterizationSettings(32, 0.2))(Pointclouds([points]))
    assert set(fragments.idx.unique().tolist()) == {-1, 1}


def test_depth_and_position_flow_back_to_the_world() -> None:
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    rasterizer = PointsRasterizer(
        FoVPerspectiveCameras(R=R, T=T).to("cpu"), PointsRasterizationSettings((6, 8), 0.5, 4)
    )
    points = (torch.rand(5, 3, dtype=torch.float64) - 0.5).requires_grad_()
    rasterizer.cameras.R, rasterizer.cameras.T = R.double(), T.double()
    assert torch.autograd.gradcheck(lambda p: rasterizer(Pointclouds([p]))[1:], (points,))


def test_a_batch_stays_on_its_device(far) -> None:  # noqa: F811
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    points = torch.rand(20, 3) - 0.5
    rasterizer = PointsRasterizer(FoVPerspectiveCameras(R=R, T=T), PointsRasterizationSettings(16, 0.1))
    expected = rasterizer(Pointclouds([points]))
    fragments = rasterizer.to(far)(Pointclouds([points.to(far)]))
    assert all(isinstance(part, Far) for part in fragments)
    assert torch.equal(fragments.idx.cpu(), expected.idx)
    assert_close(fragments.dists.cpu(), expected.dists)
