"""Photographs with cameras: their pixels, and rays against pinholes, this library's cameras and the lens formulas."""

import math

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401
from numbered_views import SIZES, numbered, posed
from torch import Tensor

from rendra.renderer import FoVPerspectiveCameras, PerspectiveCameras
from rendra.renderer.cameras import look_at_view_transform
from rendra_lab.data.posed_images import NUM_DISTORTION, PosedImages, distorted, undistorted

LENSES = {
    "radial": ([-0.2, 0.05, 0.0, 0.0, 0.01], False),
    "tangential": ([0.0, 0.0, 0.01, -0.02], False),
    "rational": ([0.1, 0.02, 0.003, -0.001, 0.01, 0.05, -0.02, 0.004], False),
    "fisheye": ([-0.04, 0.01, -0.003, 0.001], True),
    "ideal fisheye": ([], True),
}


def lens_of(name: str, count: int) -> dict[str, Tensor]:
    coefficients, fisheye = LENSES[name]
    padded = torch.tensor([*coefficients, *[0.0] * (NUM_DISTORTION - len(coefficients))])
    return {"distortion": padded.repeat(count, 1), "fisheye": torch.full((count,), fisheye)}


def test_images_of_any_size_come_back_as_they_were_put_in() -> None:
    images = posed()
    assert len(images) == 3
    assert images.first_pixel.tolist() == [0, 24, 39, 43]
    assert images.has_alpha
    for index, image in enumerate(numbered(SIZES)):
        assert torch.equal(images.image(index), image.float() / 255)


def test_images_without_alpha_are_opaque_and_say_so() -> None:
    images = posed(channels=3)
    assert not images.has_alpha
    assert (images.pixels[:, 3] == 255).all()
    both = PosedImages.gather(
        "ab", [numbered([(2, 2)], 3)[0], numbered([(2, 2)])[0]], images.intrinsics[:2], images.R[:2], images.T[:2]
    )
    assert both.has_alpha
    assert (both.image(0)[..., 3] == 1).all()


@pytest.mark.parametrize("order", [[2, 0], [1], [0, 0, 1], []])
def test_a_selection_is_the_same_images_in_its_order(order: list[int]) -> None:
    images = posed(**lens_of("rational", 3))
    chosen = images.select(order)
    assert chosen.labels == tuple(f"{index}.png" for index in order)
    assert len(chosen.pixels) == int(chosen.first_pixel[-1])
    for place, index in enumerate(order):
        assert torch.equal(chosen.image(place), images.image(index))
        xy = torch.rand(5, 2) * 4
        for found, expected in zip(
            chosen.rays(torch.full((5,), place), xy), images.rays(torch.full((5,), index), xy), strict=True
        ):
            assert torch.equal(found, expected)


def test_there_may_be_no_images() -> None:
    none = posed([])
    assert len(none) == 0
    assert none.first_pixel.tolist() == [0]
    assert none.positions.shape == (0, 3)
    origins, directions = none.rays(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 2))
    assert origins.shape == directions.shape == (0, 3)


def test_rays_of_a_pinhole_by_hand() -> None:
    """At (1, 2, -3), looking along +z with +Y up: +X is left, so pixels to the right go to -x, those below to -y."""
    images = PosedImages.gather(
        ["a"], [torch.zeros(4, 6, 3, dtype=torch.uint8)], torch.tensor([[2.0, 4.0, 3.0, 2.0]]), torch.eye(3)[None],
        torch.tensor([[-1.0, -2.0, 3.0]]),
    )  # fmt: skip
    assert_close(images.positions, [[1.0, 2.0, -3.0]])
    xy = torch.tensor([[3.0, 2.0], [5.0, 2.0], [3.0, 6.0], [1.0, 0.0]])
    origins, directions = images.rays(torch.zeros(4, dtype=torch.int64), xy)
    assert_close(origins, torch.tensor([[1.0, 2.0, -3.0]]).expand(4, 3))
    slopes = torch.tensor([[0.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [0.0, -1.0, 1.0], [1.0, 0.5, 1.0]])
    assert_close(directions, torch.nn.functional.normalize(slopes, dim=1))


def test_rays_are_seen_by_the_librarys_cameras_where_they_came_from() -> None:
    images = posed()
    view = torch.tensor([0, 0, 1, 1, 2])
    xy = torch.rand(5, 2) * torch.tensor([6.0, 4.0])
    origins, directions = images.rays(view, xy)
    assert_close(directions.norm(dim=1), torch.ones(5))
    cameras = PerspectiveCameras(
        focal_length=images.intrinsics[view, :2], principal_point=images.intrinsics[view, 2:], R=images.R[view],
        T=images.T[view], in_ndc=False, image_size=images.sizes[view],
    )  # fmt: skip
    assert_close(cameras.get_camera_center(), origins, atol=1e-5)
    for distance in (0.5, 4.0):
        seen = cameras.transform_points_screen((origins + distance * directions)[:, None])[:, 0]
        assert_close(seen[:, :2], xy, atol=1e-3)


def test_a_field_of_view_gives_the_focal_length() -> None:
    R, T = look_at_view_transform(2.5, 30.0, 40.0)
    focal = 8 / math.tan(math.radians(30))
    images = PosedImages.gather(
        ["a"], [torch.zeros(16, 16, 3, dtype=torch.uint8)], torch.tensor([[focal, focal, 8.0, 8.0]]), R, T
    )
    xy = torch.rand(20, 2) * 16
    origins, directions = images.rays(torch.zeros(20, dtype=torch.int64), xy)
    cameras = FoVPerspectiveCameras(R=R, T=T, fov=60.0)
    depth = torch.full((20, 1), 2.0)
    points = cameras.unproject_points(torch.cat([1 - xy / 8, depth], dim=1), world_coordinates=True)
    assert_close(torch.nn.functional.normalize(points - origins, dim=1), directions, atol=1e-5)


@pytest.mark.parametrize("name", LENSES)
def test_lenses_are_undone(name: str) -> None:
    slope = (torch.rand(200, 2, dtype=torch.float64) - 0.5) * 1.2
    slope[0] = 0
    lens = {key: value.double() if key == "distortion" else value for key, value in lens_of(name, 200).items()}
    bent = distorted(slope, **lens)
    assert (bent - slope).abs().max() > 1e-3
    assert_close(undistorted(bent, **lens), slope, atol=2e-6)


def test_lenses_by_hand() -> None:
    slope = torch.tensor([[0.3, -0.4]])  # r^2 = 0.25
    bent = distorted(slope, **lens_of("radial", 1))
    assert_close(bent, slope * (1 - 0.2 * 0.25 + 0.05 * 0.25**2 + 0.01 * 0.25**3))
    shift = torch.tensor([[2 * 0.01 * -0.12 - 0.02 * (0.25 + 0.18), 0.01 * (0.25 + 0.32) + 2 * -0.02 * -0.12]])
    assert_close(distorted(slope, **lens_of("tangential", 1)), slope + shift)
    ratio = (1 + 0.1 / 4 + 0.02 / 16 + 0.01 / 64) / (1 + 0.05 / 4 - 0.02 / 16 + 0.004 / 64)
    shift = torch.tensor([[2 * 0.003 * -0.12 - 0.001 * 0.43, 0.003 * 0.57 + 2 * -0.001 * -0.12]])
    assert_close(distorted(slope, **lens_of("rational", 1)), slope * ratio + shift)
    assert_close(distorted(slope, **lens_of("ideal fisheye", 1)), slope * math.atan(0.5) / 0.5)


def test_a_lens_without_coefficients_is_a_pinhole() -> None:
    slope = torch.randn(9, 2)
    straight = {"distortion": torch.zeros(9, NUM_DISTORTION), "fisheye": torch.zeros(9, dtype=torch.bool)}
    assert torch.equal(distorted(slope, **straight), slope)
    assert torch.equal(undistorted(slope, **straight), slope)


def test_every_image_has_its_own_lens() -> None:
    count = 3
    lens = lens_of("radial", count)
    lens["distortion"][1] = 0
    lens["fisheye"][1], lens["distortion"][2] = True, 0
    images, straight = posed(**lens), posed()
    view, xy = torch.arange(3), torch.tensor([[5.0, 4.0]]).repeat(3, 1)
    slope = (xy - images.intrinsics[:, 2:]) / images.intrinsics[:, :2]
    directions = images.rays(view, xy)[1]
    sharp = straight.rays(view, slope_to_xy(undistorted(slope, lens["distortion"], lens["fisheye"]), images))[1]
    assert_close(directions, sharp, atol=1e-6)
    assert torch.equal(directions[2], straight.rays(view, xy)[1][2])
    assert ((directions - straight.rays(view, xy)[1])[:2].norm(dim=1) > 1e-3).all()


def slope_to_xy(slope: Tensor, images: PosedImages) -> Tensor:
    return slope * images.intrinsics[:, :2] + images.intrinsics[:, 2:]


@pytest.mark.parametrize("name", ["rational", "fisheye"])
def test_rays_are_made_where_the_images_lie(far, name: str) -> None:  # noqa: F811
    images = posed(**lens_of(name, 3)).to(far)
    origins, directions = images.rays(torch.tensor([0, 2], device=far), torch.ones(2, 2).to(far))
    assert isinstance(origins, Far)
    assert isinstance(directions, Far)
    assert isinstance(images.image(1), Far)
