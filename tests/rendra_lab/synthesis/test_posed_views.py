"""What two views of one place have to do with each other."""

import torch

from rendra_lab.synthesis.posed_views import seen_by, to_other_view

SIZE = 12
K = torch.tensor([[[10.0, 0, 6], [0, 14.0, 6], [0, 0, 1]]])


def moved(x: float = 0.0, z: float = 0.0) -> torch.Tensor:
    pose = torch.eye(4)
    pose[0, 3], pose[2, 3] = x, z
    return pose[None]


def plane(z: float) -> torch.Tensor:
    return torch.full((1, 1, SIZE, SIZE), z)


def test_a_view_sees_itself_where_it_stands() -> None:
    depth = 1 + 5 * torch.rand(2, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
    pixels, z = to_other_view(depth, K.expand(2, 3, 3), torch.eye(4).expand(2, 4, 4), K.expand(2, 3, 3))
    torch.testing.assert_close(z, depth[:, 0])
    torch.testing.assert_close(pixels[0, 3, 5], torch.tensor([5.5, 3.5]))
    assert bool(seen_by(depth, K.expand(2, 3, 3), torch.eye(4).expand(2, 4, 4), depth, K.expand(2, 3, 3)).all())


def test_a_step_sideways_moves_pixels_by_the_focal_length_over_depth() -> None:
    pixels, _ = to_other_view(plane(4.0), K, moved(x=0.8), K)  # 10 * 0.8 / 4 = 2 pixels to the right
    torch.testing.assert_close(pixels[0, 0, :, 0], torch.arange(SIZE) + 2.5)
    visible = seen_by(plane(4.0), K, moved(x=0.8), plane(4.0), K)[0, 0]
    assert visible[:, : SIZE - 2].all()
    assert not visible[:, SIZE - 2 :].any()


def test_what_stands_before_something_hides_it() -> None:
    other = plane(4.0)
    other[..., 3:6, 4:8] = 2.0
    visible = seen_by(plane(4.0), K, moved(), other, K)[0, 0]
    assert int((~visible).sum()) == 12
    assert not visible[3:6, 4:8].any()


def test_a_steep_floor_is_seen_though_its_depth_changes_within_a_pixel() -> None:
    rays = (torch.arange(SIZE) + 0.5) / 14  # a floor 1 below a camera that looks level, its horizon at the upper edge
    floor = (1 / rays)[None, None, :, None].expand(1, 1, SIZE, SIZE).clone()
    level = K.clone()
    level[0, 1, 2] = 0.0
    visible = seen_by(floor, level, moved(z=-0.4), floor, level)[0, 0]
    pixels, z = to_other_view(floor, level, moved(z=-0.4), level)
    inside = ((pixels >= 0) & (pixels < SIZE)).all(-1)[0] & (z[0] > 0)
    torch.testing.assert_close(visible, inside)
    assert int(inside.sum()) > 60


def test_sky_is_seen_where_the_other_sees_sky_in_the_same_direction() -> None:
    sky = plane(torch.inf)
    assert bool(seen_by(sky, K, moved(x=100.0, z=3.0), sky, K).all())  # however far the camera moved
    assert not bool(seen_by(sky, K, moved(), plane(9.0), K).any())
    assert not bool(seen_by(plane(9.0), K, moved(), sky, K).any())


def test_what_is_behind_the_other_camera_is_not_seen() -> None:
    assert not bool(seen_by(plane(2.0), K, moved(z=-5.0), plane(2.0), K).any())


def test_no_views_at_all() -> None:
    none = torch.zeros(0, 1, SIZE, SIZE)
    assert seen_by(none, K[:0], torch.zeros(0, 4, 4), none, K[:0]).shape == (0, 1, SIZE, SIZE)
