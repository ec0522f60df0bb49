"""Distance to a surface, and the point of it that is nearest."""

import pytest
import torch
from assertions import assert_close
from far_device import far

from rendra.ops import distance_to_surface
from rendra.structures import Meshes
from rendra.utils import ico_sphere

__all__ = ["far"]

SQUARE = Meshes(
    [torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]])],
    [torch.tensor([[0, 1, 2], [0, 2, 3]])],
)


def test_a_square_in_space():
    points = torch.tensor([[0.75, 0.25, -2.0], [0.25, 0.75, 3.0], [0.5, 0.5, 1.0], [4.0, 5.0, 0.0]])
    found = distance_to_surface(points, SQUARE)
    assert_close(found.distance, torch.tensor([2.0, 3.0, 1.0, 5.0]), rtol=1e-6)
    assert found.face.tolist() == [0, 1, 0, 0]  # on the diagonal and at its end the lower one
    assert_close(found.point, torch.tensor([[0.75, 0.25, 0], [0.25, 0.75, 0], [0.5, 0.5, 0], [1, 1, 0]]), atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_nearest_point_is_at_that_distance_and_on_that_face(dtype):
    sphere = ico_sphere(3)
    mesh = Meshes([sphere.verts_packed().to(dtype)], [sphere.faces_packed()])
    points = 2 * torch.randn(300, 3, dtype=dtype)
    found = distance_to_surface(points, mesh)
    assert_close((points - found.point).norm(dim=1), found.distance, atol=1e-6)
    assert_close(found.distance, (points.norm(dim=1) - 1).abs(), atol=0.01)
    again = distance_to_surface(found.point, mesh)
    assert again.distance.max() < 1e-6
    assert not found.distance.requires_grad


def test_bad_input_is_named():
    with pytest.raises(ValueError, match=r"one mesh with faces, got 2 with \[2, 2\] faces"):
        distance_to_surface(torch.zeros(1, 3), SQUARE.extend(2))
    with pytest.raises(ValueError, match=r"one mesh with faces, got 1 with \[0\] faces"):
        distance_to_surface(torch.zeros(1, 3), Meshes([torch.zeros(3, 3)], [torch.zeros(0, 3, dtype=torch.int64)]))
    with pytest.raises(ValueError, match=r"points must be floats of shape \(P, 3\)"):
        distance_to_surface(torch.zeros(1, 2), SQUARE)


def test_another_device_gets_the_same(far):
    points = torch.randn(20, 3)
    here, there = distance_to_surface(points, SQUARE), distance_to_surface(points.to(far), SQUARE.to(far))
    for a, b in zip(here, there, strict=True):
        assert_close(b.held, a, atol=1e-6)
