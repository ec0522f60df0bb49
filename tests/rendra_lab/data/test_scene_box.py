"""The box of a scene holds the scene, hardly more where silhouettes say so, and what cameras look at elsewhere."""

import dataclasses
import math

import pytest
import torch

from rendra.renderer.cameras import look_at_view_transform
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import within_box
from rendra_lab.data.scene_box import box_of_frusta, carve, estimate_box, has_silhouettes
from rendra_lab.errors import UserError

CENTRE, RADIUS = torch.tensor([0.2, -0.1, 0.3]), 0.5


def ball_views(count=20, size=(48, 48), distance=2.7, k1=0.0, fisheye=False, elevations=None):
    """Views of a ball, from all around unless at given elevations."""
    number = torch.arange(count) + 0.5
    elevations = torch.rad2deg(torch.asin(1 - 2 * number / count)) if elevations is None else elevations
    R, T = look_at_view_transform(distance, elevations, number * 137.5)
    height, width = size
    focal = 0.5 * min(size) / math.tan(math.radians(30))
    intrinsics = torch.tensor([focal, focal, width / 2, height / 2]).expand(count, 4).contiguous()
    distortion = torch.zeros(count, 8)
    distortion[:, 0] = k1
    blank = [torch.zeros(height, width, 4, dtype=torch.uint8)] * count
    views = PosedImages.gather(
        [str(i) for i in range(count)], blank, intrinsics, R, T, distortion, torch.full((count,), fisheye)
    )
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    xy = torch.stack([x, y], dim=-1).reshape(-1, 2).repeat(count, 1)
    origins, directions = views.rays(torch.arange(count).repeat_interleave(height * width), xy)
    along = ((CENTRE - origins) * directions).sum(1)
    miss = (CENTRE - origins).square().sum(1) - along.square()
    views.pixels[:, 3] = (miss < RADIUS**2) * 255
    return views


def opaque(views):
    return dataclasses.replace(views, has_alpha=False)


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"k1": -0.1},
        {"k1": 0.08},
        {"fisheye": True, "k1": 0.02},
        {"size": (40, 64)},
        {"size": (300, 280), "count": 8},
        {"elevations": torch.zeros(20)},
    ],
)
def test_box_of_silhouettes_holds_the_ball_and_hardly_more(how):
    lowest, highest = estimate_box(ball_views(**how))
    assert (lowest < CENTRE - RADIUS).all()
    assert (highest > CENTRE + RADIUS).all()
    assert (highest - lowest < 2 * RADIUS * (1.9 if "elevations" in how else 1.45)).all()


@pytest.mark.parametrize("how", [{}, {"k1": -0.1}, {"count": 1}])
@pytest.mark.parametrize("resolution", [17, (9, 20, 13)])
def test_carving_never_takes_what_is_there(how, resolution):
    views = ball_views(**how)
    box = torch.tensor([[-0.9, -1.0, -0.8], [1.0, 0.9, 1.2]])
    left = carve(views, box, resolution)
    shape = (resolution,) * 3 if isinstance(resolution, int) else resolution
    assert left.shape == shape
    steps = [(torch.arange(n) + 0.5) / n for n in shape]
    zyx = torch.stack(torch.meshgrid(*steps, indexing="ij"), dim=-1)
    centres = torch.lerp(box[0], box[1], zyx.flip(-1))
    cell = ((box[1] - box[0]) / torch.tensor(shape[::-1])).norm()
    distance = (centres - CENTRE).norm(dim=-1)
    assert left[distance < RADIUS + cell / 2].all()
    if len(views) > 1:
        assert not left[distance > RADIUS + 4 * cell].any()


def test_a_silhouette_takes_nothing_outside_its_picture():
    views = ball_views(1)
    behind = views.positions[0] * 2
    assert carve(views, torch.stack([behind - 0.1, behind + 0.1]), 4).all()
    sideways = torch.stack([torch.full((3,), 50.0), torch.full((3,), 51.0)])
    assert carve(views, sideways, 4).all()


def test_cells_are_in_the_order_z_y_x():
    views = ball_views()
    left = carve(views, torch.tensor([[-2.0, -0.7, -0.3], [0.8, 0.6, 0.9]]), (8, 8, 28))
    assert left[4, 4, 22]  # the ball is at the far end of x
    assert not left[4, 4, 3]


def test_without_silhouettes_the_box_is_what_the_cameras_look_at():
    views = opaque(ball_views())
    assert not has_silhouettes(views)
    assert carve(views, torch.tensor([[-1.0] * 3, [1.0] * 3]), 3).all()
    expected = 2.7 * math.sin(math.radians(30))  # the ball in a cone of 60 degrees
    torch.testing.assert_close(estimate_box(views), torch.tensor([[-expected] * 3, [expected] * 3]))


def test_alpha_that_divides_nothing_is_no_silhouette():
    views = ball_views()
    for alpha in (0, 255):
        views.pixels[:, 3] = alpha
        assert not has_silhouettes(views)
        assert estimate_box(views)[1, 0] > 1


def test_silhouettes_with_nothing_in_common_fall_back_on_the_cameras(caplog):
    views = ball_views(12)
    masks = views.pixels[:, 3].view(12, 48, 48)
    masks.copy_(torch.stack([mask.roll(13 if i % 2 else -13, 0) for i, mask in enumerate(masks)]))
    box = estimate_box(views)
    assert "nothing in common" in caplog.text
    assert box[1, 0] > 1
    caplog.clear()
    assert carve(views, box, 16).all()  # an empty hull would never show anything
    assert "nothing in common" in caplog.text


def forward_facing(count=5):
    R, _ = look_at_view_transform(1.0, 0.0, torch.zeros(count))
    T = torch.zeros(count, 3)
    T[:, 0] = torch.linspace(-0.5, 0.5, count)
    intrinsics = torch.tensor([20.0, 20.0, 10.0, 8.0]).expand(count, 4).contiguous()
    return PosedImages.gather(["x"] * count, [torch.zeros(16, 20, 3, dtype=torch.uint8)] * count, intrinsics, R, T)


def test_forward_facing_cameras_see_their_frusta():
    views = forward_facing()
    box = estimate_box(views, (1.0, 4.0))
    torch.testing.assert_close(box, box_of_frusta(views, (1.0, 4.0)))
    xy = torch.rand(500, 2) * torch.tensor([20.0, 16.0])
    origins, directions = views.rays(torch.randint(5, (500,)), xy)
    nearest, farthest = within_box(origins, directions, box)
    assert (nearest <= 1.0 + 1e-4).all()
    assert (farthest >= 4.0 - 1e-4).all()


def test_parallel_cameras_without_a_depth_range_are_told_what_is_missing():
    with pytest.raises(UserError, match=r"data\.depth_range"):
        estimate_box(forward_facing())
    with pytest.raises(UserError, match="no images"):
        estimate_box(forward_facing().select([]))


def test_cameras_that_look_outwards_lie_within_their_box():
    views = opaque(ball_views())
    turn = torch.tensor([-1.0, 1.0, -1.0])
    R = views.R * turn
    outwards = dataclasses.replace(views, R=R, T=-(views.positions[:, None] @ R)[:, 0])
    torch.testing.assert_close(outwards.positions, views.positions)
    for depth_range, reach in ((None, 2.7), ((0.1, 3.0), 3.0)):
        lowest, highest = estimate_box(outwards, depth_range)
        assert (lowest < -reach).all()
        assert (highest > reach).all()
