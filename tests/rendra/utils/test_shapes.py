import pytest
import torch
from assertions import assert_close

from rendra.utils import ico_sphere, torus


@pytest.mark.parametrize("level", [0, 1, 2, 4])
def test_sphere_has_unit_radius_and_known_counts(level: int) -> None:
    sphere = ico_sphere(level)
    assert sphere.verts_packed().shape == (10 * 4**level + 2, 3)
    assert sphere.faces_packed().shape == (20 * 4**level, 3)
    assert_close(sphere.verts_packed().norm(dim=1), torch.ones(10 * 4**level + 2))
    centers = sphere.verts_packed()[sphere.faces_packed()].mean(1)
    assert ((sphere.faces_normals_packed() * centers).sum(1) > 0.7).all()


def test_icosahedron_is_regular() -> None:
    sphere = ico_sphere()
    a, b = sphere.verts_packed()[sphere.edges_packed()].unbind(1)
    assert_close((a - b).norm(dim=1), torch.full((30,), 1.1056**0.5), atol=1e-4)


def test_torus_lies_on_its_surface_and_looks_outwards() -> None:
    ring = torus(0.3, 1.2, 7, 11)
    x, y, z = ring.verts_packed().unbind(1)
    assert_close((torch.hypot(x, y) - 1.2) ** 2 + z**2, torch.full((77,), 0.09))
    assert ring.faces_packed().shape == (154, 3)
    centers = ring.verts_packed()[ring.faces_packed()].mean(1)
    spine = torch.nn.functional.normalize(centers * torch.tensor([1.0, 1, 0]), dim=1) * 1.2
    assert ((ring.faces_normals_packed() * (centers - spine)).sum(1) > 0).all()


def test_wrong_sizes_are_named() -> None:
    with pytest.raises(ValueError, match="level must be an integer"):
        ico_sphere(-1)
    with pytest.raises(ValueError, match="at least 3 sides"):
        torus(0.1, 1.0, 2, 5)
    with pytest.raises(ValueError, match="must be positive"):
        torus(0.0, 1.0, 5, 5)
