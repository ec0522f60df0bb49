"""Normals of rendered depth: planes are exact, spheres near, edges and holes harmless."""

import pytest
import torch
from assertions import assert_close
from torch import Tensor

from rendra_lab.normal_maps import normals_from_depth, view_axes
from rendra_lab.visualization import depth_image, depth_limits, normal_image, viridis

SIZE = (24, 31)


def directions(turn: Tensor | None = None) -> Tensor:
    """Rays of a camera that looks along -z with +y up, (H, W, 3), float64; `turn` (3, 3) turns it."""
    rows, columns = (torch.arange(side, dtype=torch.float64) + 0.5 - side / 2 for side in SIZE)
    y, x = torch.meshgrid(-rows / 30, columns / 30, indexing="ij")
    rays = torch.stack([x, y, -torch.ones_like(x)], -1)
    rays = rays / rays.norm(dim=-1, keepdim=True)
    return rays if turn is None else rays @ turn.T


def plane_depth(rays: Tensor, normal: Tensor, distance: float) -> Tensor:
    """Of the plane x . n = -distance seen from the origin."""
    return -distance / (rays @ normal)


def sphere_depth(rays: Tensor, centre: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    along = rays @ centre
    inside = along**2 - centre @ centre + radius**2
    return along - inside.clamp_min(0).sqrt(), (inside > 0).double()


def unit(*xyz: float) -> Tensor:
    vector = torch.tensor(xyz, dtype=torch.float64)
    return vector / vector.norm()


@pytest.mark.parametrize("normal", [unit(0, 0, 1), unit(1, 2, 3), unit(-3, 0.5, 2)])
@pytest.mark.parametrize("axes", ["camera", "world"])
def test_a_plane_has_its_normal_everywhere(normal: Tensor, axes: str) -> None:
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
    turn = turn * torch.linalg.det(turn)
    depth = plane_depth(directions(), normal, 2.0)
    found = normals_from_depth(directions(turn), depth, torch.ones(SIZE), axes)
    expected = normal if axes == "camera" else turn @ normal
    assert_close(found, expected.expand(*SIZE, 3), atol=1e-7)


def test_single_precision_is_enough() -> None:
    depth = plane_depth(directions(), unit(1, 2, 3), 2.0)
    found = normals_from_depth(directions().float(), depth.float(), torch.ones(SIZE))
    assert_close(found, unit(1, 2, 3).expand(*SIZE, 3), atol=2e-3)


def test_a_sphere_has_radial_normals_and_nothing_beside_it() -> None:
    rays, centre = directions(), torch.tensor([0.1, -0.1, -3.0], dtype=torch.float64)
    depth, opacity = sphere_depth(rays, centre, 0.8)
    found = normals_from_depth(rays, depth, opacity)
    expected = (rays * depth[..., None] - centre) / 0.8
    assert (found[opacity == 0] == 0).all()
    facing = (opacity > 0) & (-(expected * rays).sum(-1) > 0.5)
    assert facing.sum() > 50
    off = torch.rad2deg((found * expected).sum(-1).clamp(-1, 1).acos())
    assert off[facing].max() < 8
    assert off[facing].median() < 4
    assert_close(found[opacity > 0].norm(dim=-1), torch.ones(int(opacity.sum())))
    assert ((found * rays).sum(-1)[opacity > 0] < 0).all()


def test_an_edge_between_two_planes_stays_sharp() -> None:
    """A wall before another one: no normal says that they hang together."""
    left, right = unit(0.3, 0, 1), unit(-0.3, 0.2, 1)
    rays = directions()
    depth = torch.where(torch.arange(SIZE[1]) < 15, plane_depth(rays, left, 2.0), plane_depth(rays, right, 3.0))
    found = normals_from_depth(rays, depth, torch.ones(SIZE))
    assert_close(found[:, :15], left.expand(SIZE[0], 15, 3), atol=5e-3)
    assert_close(found[:, 15:], right.expand(SIZE[0], 16, 3), atol=5e-3)


def test_noise_is_averaged() -> None:
    noise = torch.randn(SIZE, generator=torch.Generator().manual_seed(0)).double()
    depth = plane_depth(directions(), unit(0, 0, 1), 2.0) + 2e-3 * noise
    found = normals_from_depth(directions(), depth, torch.ones(SIZE))
    tilt = torch.rad2deg(found[..., 2].acos())
    assert tilt.median() < 2
    assert tilt.median() > 0


def test_nothing_seen_and_strips_of_pixels_give_no_normals() -> None:
    assert (normals_from_depth(directions(), torch.zeros(SIZE), torch.zeros(SIZE)) == 0).all()
    assert (normals_from_depth(directions()[:1], torch.ones(1, SIZE[1]), torch.ones(1, SIZE[1])) == 0).all()
    column = normals_from_depth(directions()[:, :1], torch.ones(SIZE[0], 1), torch.ones(SIZE[0], 1))
    assert (column == 0).all()
    with pytest.raises(ValueError, match="camera or world"):
        normals_from_depth(directions(), torch.ones(SIZE), torch.ones(SIZE), "view")


def test_the_axes_of_a_view_follow_from_its_rays() -> None:
    assert_close(view_axes(directions()), [[1, 0, 0], [0, 1, 0], [0, 0, -1]], atol=1e-12)


def test_viridis_begins_violet_ends_yellow_and_grows_lighter() -> None:
    colors = viridis(torch.linspace(0, 1, 65))
    assert_close(colors[[0, -1]] * 255, [[68, 1, 84], [253, 231, 37]])
    luminance = colors @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (luminance.diff() > 0).all()
    assert_close(viridis(torch.tensor([-1.0, 2.0])), colors[[0, -1]])


def test_depth_is_coloured_between_its_percentiles_and_white_where_nothing_is() -> None:
    depth = torch.linspace(1, 2, 1000).reshape(20, 50)
    depth[0, 0] = 900.0
    opacity = torch.ones(20, 50)
    opacity[-1, -1] = 0
    near, far = depth_limits(depth, opacity)
    assert 1 < near < 1.02
    assert 1.98 < far < 2.01
    image = depth_image(depth, opacity)
    assert_close(image[-1, -1], [1, 1, 1])
    assert_close(image[0, 1] * 255, [253, 231, 37], atol=0.5)
    assert_close(image[0, 0] * 255, [68, 1, 84])
    assert_close(depth_image(torch.full((1, 1), 5.0), torch.ones(1, 1), (5.0, 6.0))[0, 0] * 255, [253, 231, 37])
    assert depth_image(torch.zeros(2, 2), torch.zeros(2, 2)).min() == 1
    assert depth_image(torch.ones(2, 2), torch.ones(2, 2)).isfinite().all()


def test_normals_are_shown_in_the_usual_colours() -> None:
    shown = normal_image(torch.tensor([[[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]]))
    assert_close(shown, [[[0.5, 0.5, 1], [0, 0.5, 0.5], [1, 1, 1]]])
