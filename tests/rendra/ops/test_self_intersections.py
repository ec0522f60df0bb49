"""Surfaces that pass through themselves, and those that only touch."""

import pytest
import torch
from far_device import far

from rendra.io import load_obj
from rendra.kernels.self_intersections import crossing_pairs, reference
from rendra.ops import self_intersections
from rendra.structures import Meshes, join_meshes_as_scene
from rendra.utils import ico_sphere, torus

__all__ = ["far"]

TETRAHEDRON = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
CORNERS = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def surface(*tris):
    corners = torch.tensor(tris, dtype=torch.float32)
    return Meshes([corners.view(-1, 3)], [torch.arange(3 * len(corners)).view(-1, 3)])


def sheet(bend, size=24):
    """A strip in the plane (x, y), bent along x into the curve that `bend` gives."""
    s, y = torch.meshgrid(torch.linspace(0, 1, size), torch.linspace(0, 1, 6), indexing="ij")
    x, z = bend(s)
    index = torch.arange(size * 6).view(size, 6)
    a, b, c, d = (corner.reshape(-1) for corner in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    faces = torch.cat([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)])
    return Meshes([torch.stack([x, y, z], -1).view(-1, 3)], [faces])


def pierces(a, b):
    """Whether an edge of one triangle passes through the inside of the other, by signed volumes. (M,)"""

    def volume(p, q, r, s):
        return torch.linalg.det(torch.stack([q - p, r - p, s - p], 1)).sign()

    found = torch.zeros(len(a), dtype=torch.bool)
    for t, other in ((a, b), (b, a)):
        x, y, z = t.unbind(1)
        for k in range(3):
            p, q = other[:, k], other[:, (k + 1) % 3]
            through = (volume(p, q, x, y) == volume(p, q, y, z)) & (volume(p, q, y, z) == volume(p, q, z, x))
            found |= through & (volume(x, y, z, p) * volume(x, y, z, q) < 0) & (volume(p, q, x, y) != 0)
    return found


BASE = ((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (0.0, 4.0, 0.0))


@pytest.mark.parametrize(
    ("other", "number"),
    [
        (((1.0, 1.0, -1.0), (1.0, 1.0, 1.0), (1.0, 2.0, 1.0)), 1),  # through the inside
        (((1.0, 1.0, 0.5), (1.0, 1.0, 1.0), (1.0, 2.0, 1.0)), 0),  # above
        (((1.0, 1.0, 0.0), (1.0, 1.0, 1.0), (1.0, 2.0, 1.0)), 0),  # a corner touches
        (((1.0, 1.0, 0.0), (1.0, 2.0, 0.0), (1.0, 2.0, 1.0)), 0),  # an edge touches
        (((1.0, 1.0, 0.0), (2.0, 1.0, 0.0), (1.0, 2.0, 0.0)), 0),  # in the plane
        (((4.0, 0.0, 0.0), (0.0, 4.0, 0.0), (1.0, 1.0, 3.0)), 0),  # a common edge
        (((4.0, 0.0, 0.0), (0.0, 4.0, 0.0), (1.0, 1.0, 0.0)), 0),  # a common edge, folded flat
        (((0.0, 0.0, 0.0), (2.0, 1.0, 1.0), (1.0, 2.0, -1.0)), 1),  # a common corner, and on through the inside
        (((0.0, 0.0, 0.0), (-2.0, -1.0, 1.0), (-1.0, -2.0, -1.0)), 0),  # a common corner, away
        (((-1.0, 2.0, 1.0), (1.0, 1.0, 0.0), (-1.0, 2.0, -1.0)), 1),  # a corner on the face, the rest around its edge
        (((9.0, 9.0, 1.0), (9.0, 9.0, -1.0), (9.0, 8.0, 0.0)), 0),  # both straddle, far apart
        (((1.0, 1.0, -1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0)), 0),  # no area
        (((1.0, 1.0, -1.0), (1.0, 1.0, 1.0), (float("nan"), 1.0, 1.0)), 0),
        (BASE, 0),  # a copy
    ],
)
def test_two_faces(other, number):
    for first, second in ((BASE, other), (other, BASE)):
        mesh = surface(first, second)
        expected = [[0, 1]] * number
        assert self_intersections(mesh).tolist() == expected
        assert self_intersections(Meshes([mesh.verts_packed().double()], [mesh.faces_packed()])).tolist() == expected


def test_crossing_tetrahedra():
    """The tip of one sticks out through the slanted face of the other: its three sides cross that face."""
    other = CORNERS * torch.tensor([0.1, 0.1, 2.0]) + torch.tensor([0.2, 0.2, 0.1])
    mesh = Meshes([torch.cat([CORNERS, other])], [torch.cat([TETRAHEDRON, TETRAHEDRON + 4])])
    assert self_intersections(mesh).tolist() == [[2, 5], [2, 6], [2, 7]]


def test_a_sheet_that_crosses_itself():
    angle = 1.5 * torch.pi
    flat = sheet(lambda s: (s, 0.2 * (7 * s).sin()))
    loop = sheet(lambda s: (s - 0.6 * (2 * angle * s).sin(), 0.6 * (2 * angle * s).cos()))
    loop = loop.offset_verts(1e-3 * torch.randn_like(loop.verts_packed()))  # rows of corners would touch in pairs
    folded = sheet(lambda s: ((s - 0.5).abs(), torch.zeros_like(s)))
    assert len(self_intersections(flat)) == 0
    assert len(self_intersections(folded)) == 0  # onto itself: it touches
    pairs = self_intersections(loop)
    assert len(pairs) > 5
    corners = loop.verts_packed()[loop.faces_packed()].double()
    i, j = torch.triu_indices(len(corners), len(corners), 1)
    share = (loop.faces_packed()[i][:, :, None] == loop.faces_packed()[j][:, None]).any(-1).any(-1)
    other = torch.stack([i, j], 1)[pierces(corners[i], corners[j]) & ~share]
    assert {*map(tuple, pairs.tolist())} == {*map(tuple, other.tolist())}


def test_spheres_and_tori_do_not_cross_themselves_but_each_other():
    sphere, ring = ico_sphere(3), torus(0.3, 1.0, 16, 24)
    assert len(self_intersections(sphere)) == 0
    assert len(self_intersections(ring)) == 0
    scene = join_meshes_as_scene([sphere, ring])
    pairs = self_intersections(scene)
    num_faces = len(sphere.faces_packed())
    assert len(pairs) > 50
    assert (pairs[:, 0] < num_faces).all()
    assert (pairs[:, 1] >= num_faces).all()


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_twins_agree_on_a_crumpled_sphere_of_any_size(scale):
    sphere = ico_sphere(3)
    verts = (sphere.verts_packed() + 0.06 * torch.randn(642, 3)) * scale
    tris = verts[sphere.faces_packed()]
    pairs = crossing_pairs(tris, 1e-6 * scale)
    assert len(pairs) > 100
    assert torch.equal(pairs, reference.crossing_pairs(tris, 1e-6 * scale))


def test_results_do_not_depend_on_threads():
    tris = torch.randn(2000, 1, 3) + 0.3 * torch.randn(2000, 3, 3)
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(crossing_pairs(tris, 1e-6))
    torch.set_num_threads(threads)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


@pytest.mark.parametrize("name", ["cow", "teapot"])
def test_real_meshes(shared_data, name):
    path = shared_data / "teapot.obj" if name == "teapot" else next((shared_data / "cow").rglob("*.obj"))
    verts, faces, _ = load_obj(path, load_textures=False)
    some = faces.verts_idx[::3] if name == "cow" else faces.verts_idx
    tris = verts[some]
    crumpled = tris + 0.01 * torch.randn(len(verts), 3)[some]
    for surface_of in (tris, crumpled):
        assert torch.equal(crossing_pairs(surface_of, 1e-6), reference.crossing_pairs(surface_of, 1e-6))
    assert len(crossing_pairs(crumpled, 1e-6)) > 0
    assert len(self_intersections(Meshes([verts], [faces.verts_idx]))) == 0


def test_nothing_crosses_nothing():
    assert self_intersections(Meshes([torch.zeros(3, 3)], [torch.zeros(0, 3, dtype=torch.int64)])).shape == (0, 2)
    assert self_intersections(Meshes([torch.full((3, 3), torch.nan)], [torch.tensor([[0, 1, 2]])])).shape == (0, 2)


def test_the_operator_is_well_registered():
    checks = ("test_schema", "test_autograd_registration", "test_faketensor")
    torch.library.opcheck(torch.ops.rendra.crossing_pairs.default, (torch.randn(30, 3, 3), 1e-6), test_utils=checks)


def test_bad_input_is_named():
    with pytest.raises(ValueError, match="looks at one mesh, got 2"):
        self_intersections(ico_sphere(0).extend(2))
    with pytest.raises(ValueError, match="between 0 and 1, got 0"):
        self_intersections(ico_sphere(0), tolerance=0)
    with pytest.raises(ValueError, match=r"tris must be floats of shape \(F, 3, 3\)"):
        crossing_pairs(torch.zeros(3, 3), 1e-6)


def test_another_device_gets_the_same(far):
    scene = join_meshes_as_scene([ico_sphere(1), ico_sphere(1).offset_verts(torch.tensor([0.5, 0.2, 0.1]))])
    pairs = self_intersections(scene)
    assert len(pairs) > 0
    assert torch.equal(self_intersections(scene.to(far)).held, pairs)
