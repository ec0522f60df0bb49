"""Measures and faults of meshes whose faults are known by construction."""

import math

import pytest
import torch
from far_device import far  # noqa: F401

from rendra.structures.meshes import Meshes, join_meshes_as_batch, join_meshes_as_scene
from rendra.utils import ico_sphere, torus
from rendra_lab import mesh_quality as quality
from rendra_lab.data.meshes import make_cube

# counter-clockwise from outside; corner i at the bits of i
_CUBE_FACES = [
    *([0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4]),
    *([2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5], [3, 7, 5]),
]


def cube(side: float = 1.0, at: float = 0.0, keep: slice = slice(None)) -> Meshes:
    """A box of eight vertices; `keep` picks faces."""
    verts = [[float(i & 1), float(i >> 1 & 1), float(i >> 2)] for i in range(8)]
    return Meshes([side * torch.tensor(verts) + at], [torch.tensor(_CUBE_FACES)[keep]])


def with_faces(mesh: Meshes, faces: torch.Tensor) -> Meshes:
    return Meshes([mesh.verts_packed()], [faces])


def tetrahedra(*corners: list[int]) -> Meshes:
    """Tetrahedra among points on a moment curve, so that none is flat; outward faces."""
    points = torch.tensor([[float(t), float(t**2), float(t**3)] for t in range(-3, 5)])
    faces = []
    for a, b, c, d in corners:
        if torch.linalg.det(torch.stack([points[b] - points[a], points[c] - points[a], points[d] - points[a]])) < 0:
            c, d = d, c
        faces += [[a, c, b], [a, b, d], [b, c, d], [a, d, c]]
    return Meshes([points], [torch.tensor(faces)])


def test_a_cube_has_no_faults() -> None:
    mesh = cube(side=2.0)
    assert quality.is_watertight(mesh)
    assert quality.signed_volume(mesh) == pytest.approx(8)
    assert quality.surface_area(mesh) == pytest.approx(24)
    assert quality.euler_characteristic(mesh) == 2
    assert quality.genus(mesh) == 0
    # 12 edges bend by 90 degrees, 6 diagonals lie flat
    assert float(quality.mean_dihedral_deg(mesh)) == pytest.approx(60)
    assert not quality.degenerate_faces(mesh).any()
    assert not quality.duplicate_faces(mesh).any()
    assert not quality.duplicate_verts(mesh).any()
    assert not quality.unreferenced_verts(mesh).any()
    assert not quality.flipped_faces(mesh).any()
    assert not quality.inward_faces(mesh).any()
    assert not quality.wrong_normals(mesh).any()
    for edges in (quality.boundary_edges, quality.non_manifold_edges, quality.inconsistent_edges):
        assert edges(mesh).shape == (0, 2)
    assert quality.non_manifold_verts(mesh).shape == (0,)
    assert quality.boundary_loops(mesh).shape == (0,)
    assert (quality.components(mesh) == 0).all()


def test_the_spread_of_a_cubes_edges() -> None:
    lengths = torch.tensor([1.0] * 12 + [math.sqrt(2)] * 6)
    expected = lengths.std(correction=0) / lengths.mean()
    torch.testing.assert_close(quality.edge_length_spread(cube()), expected)
    torch.testing.assert_close(quality.edge_length_spread(cube(side=7.0, at=3.0)), expected)


def test_regular_solids_have_equal_edges_and_known_angles() -> None:
    verts = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    solid = Meshes([verts], [torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])])
    assert float(quality.edge_length_spread(solid)) == pytest.approx(0, abs=1e-6)
    assert float(quality.mean_dihedral_deg(solid)) == pytest.approx(180 - math.degrees(math.acos(1 / 3)))
    assert float(quality.edge_length_spread(ico_sphere(0))) == pytest.approx(0, abs=1e-6)
    assert float(quality.mean_dihedral_deg(ico_sphere(0))) == pytest.approx(41.8103, abs=1e-3)


def test_angles_do_not_depend_on_winding_and_fall_with_refinement() -> None:
    sphere = ico_sphere(2)
    faces = sphere.faces_packed().clone()
    faces[::3] = faces[::3].flip(1)
    torch.testing.assert_close(
        quality.mean_dihedral_deg(with_faces(sphere, faces)), quality.mean_dihedral_deg(sphere)
    )
    ratio = quality.mean_dihedral_deg(sphere) / quality.mean_dihedral_deg(ico_sphere(3))
    assert float(ratio) == pytest.approx(2, rel=0.05)


def test_a_sheet_folded_onto_itself_bends_by_180_degrees() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 1, 0]])
    assert float(quality.mean_dihedral_deg(Meshes([verts], [torch.tensor([[0, 1, 2], [1, 0, 3]])]))) == 180


def test_a_missing_side_is_one_hole() -> None:
    mesh = cube(keep=slice(2, None))
    edges = quality.boundary_edges(mesh)
    assert sorted(map(tuple, edges.tolist())) == [(0, 1), (0, 2), (1, 3), (2, 3)]
    assert quality.boundary_loops(mesh).tolist() == [0, 0, 0, 0]
    assert not quality.is_watertight(mesh)
    assert quality.genus(mesh) is None


def test_holes_that_touch_in_a_vertex_are_one_and_patches_that_do_have_their_own() -> None:
    sphere = ico_sphere(2)
    faces = sphere.faces_packed()
    around = (faces == faces[0, 0]).any(1).nonzero()[:, 0]  # the fan of a vertex
    apart = next(
        [int(a), int(b)] for a in around for b in around if len(set(faces[a].tolist()) & set(faces[b].tolist())) == 1
    )
    left = torch.ones(len(faces), dtype=torch.bool)
    left[apart] = False
    mesh = with_faces(sphere, faces[left])
    assert quality.boundary_loops(mesh).bincount().tolist() == [6]
    assert quality.non_manifold_verts(mesh).tolist() == [int(faces[0, 0])]
    patches = with_faces(sphere, faces[apart])
    assert quality.boundary_loops(patches).bincount().tolist() == [3, 3]


def test_an_open_cylinder_has_two_holes() -> None:
    tube = torus(1.0, 3.0, 8, 12)
    faces = tube.faces_packed()
    centre = tube.verts_packed()[faces].mean(1)
    mesh = with_faces(tube, faces[centre.abs()[:, :2].amin(1) > -1][centre[:, 0] > 0])
    assert len(quality.boundary_loops(mesh).unique()) == 2
    assert quality.euler_characteristic(mesh) == 0


@pytest.mark.parametrize(("mesh", "handles"), [(ico_sphere(1), 0), (torus(0.3, 1.0, 6, 9), 1)])
def test_handles(mesh: Meshes, handles: int) -> None:
    assert quality.genus(mesh) == handles
    twice = join_meshes_as_scene([mesh, mesh.offset_verts(torch.full_like(mesh.verts_packed(), 5.0))])
    assert quality.genus(twice) == 2 * handles
    assert quality.components(twice).bincount().tolist() == [len(mesh.faces_packed())] * 2


def test_tetrahedra_that_share_an_edge_or_a_vertex() -> None:
    edge = tetrahedra([0, 1, 2, 3], [0, 1, 4, 5])
    assert quality.non_manifold_edges(edge).tolist() == [[0, 1]]
    assert quality.non_manifold_verts(edge).tolist() == []
    assert quality.boundary_edges(edge).tolist() == []
    tip = tetrahedra([0, 1, 2, 3], [0, 4, 5, 6])
    assert quality.non_manifold_edges(tip).tolist() == []
    assert quality.non_manifold_verts(tip).tolist() == [0]
    assert quality.is_watertight(tip)
    assert quality.genus(tip) is None
    assert (quality.components(tip) == 0).all()


def test_flipped_faces_are_the_few() -> None:
    sphere = ico_sphere(1)
    faces = sphere.faces_packed().clone()
    chosen = torch.tensor([3, 17, 18, 40])
    faces[chosen] = faces[chosen].flip(1)
    mesh = with_faces(sphere, faces)
    assert quality.flipped_faces(mesh).nonzero()[:, 0].tolist() == chosen.tolist()
    assert len(quality.inconsistent_edges(mesh)) > 0
    assert not quality.inward_faces(mesh).any()  # not closed in the sense of orientation
    mirrored = with_faces(sphere, faces.flip(1))
    assert quality.flipped_faces(mirrored).nonzero()[:, 0].tolist() == chosen.tolist()


def test_a_moebius_strip_has_no_flipped_faces() -> None:
    n = 10
    angle = torch.arange(n) * 2 * torch.pi / n
    ring = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    offset = 0.3 * (angle / 2).cos()[:, None] * ring + 0.3 * torch.stack([0 * angle, 0 * angle, (angle / 2).sin()], 1)
    faces = []
    for i in range(n):
        a, b = i, n + i
        c, d = (i + 1, n + i + 1) if i < n - 1 else (n, 0)  # the twist
        faces += [[a, c, b], [c, d, b]]
    mesh = Meshes([torch.cat([ring + offset, ring - offset])], [torch.tensor(faces)])
    assert len(quality.inconsistent_edges(mesh)) > 0
    assert not quality.flipped_faces(mesh).any()
    assert len(quality.boundary_loops(mesh).unique()) == 1


def test_inside_out_components_but_not_cavities() -> None:
    outer = cube(side=3.0, at=-1.0)
    inner = with_faces(cube(side=0.5), cube().faces_packed().flip(1))
    aside = with_faces(cube(side=0.5, at=9.0), cube().faces_packed().flip(1))
    hollow = join_meshes_as_scene([outer, inner])
    assert not quality.inward_faces(hollow).any()
    assert quality.signed_volume(hollow) == pytest.approx(27 - 0.125)
    assert quality.inward_faces(join_meshes_as_scene([outer, aside])).tolist() == [False] * 12 + [True] * 12
    assert quality.inward_faces(inner).all()
    assert quality.signed_volume(inner) == pytest.approx(-0.125)
    solid_in_cavity = join_meshes_as_scene([outer, inner, cube(side=0.1, at=0.2)])
    assert not quality.inward_faces(solid_in_cavity).any()


def test_degenerate_and_duplicate_faces() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [0.3, 1e-8, 0], [0.0, 0, 0], [5, 5, 5]])
    faces = torch.tensor([[0, 1, 2], [2, 1, 0], [1, 2, 0], [0, 1, 3], [0, 1, 4], [1, 1, 2], [0, 1, 5]])
    mesh = Meshes([verts], [faces])
    assert quality.degenerate_faces(mesh).tolist() == [False] * 3 + [True] * 4
    assert quality.degenerate_faces(mesh.scale_verts(1e-4)).tolist() == [False] * 3 + [True] * 4
    assert quality.duplicate_faces(mesh).tolist() == [False, True, True, False, False, False, False]
    assert quality.duplicate_verts(mesh).nonzero()[:, 0].tolist() == [5]
    assert quality.unreferenced_verts(mesh).nonzero()[:, 0].tolist() == [6]


def test_a_face_that_names_a_vertex_twice_is_no_part_of_the_topology() -> None:
    mesh = with_faces(cube(), torch.cat([cube().faces_packed(), torch.tensor([[0, 0, 1], [2, 2, 2]])]))
    assert quality.boundary_edges(mesh).shape == (0, 2)
    assert quality.non_manifold_edges(mesh).shape == (0, 2)
    assert quality.non_manifold_verts(mesh).shape == (0,)
    assert not quality.is_watertight(mesh)
    assert float(quality.mean_dihedral_deg(mesh)) == pytest.approx(60)


def test_repeated_points_know_nan_and_signed_zero() -> None:
    nan = math.nan
    points = torch.tensor([[0.0, 1, 2], [-0.0, 1, 2], [nan, 1, 2], [nan, 1, 2], [0.0, 1, 2]])
    assert quality.repeated_points(points).tolist() == [False, True, False, False, True]


def test_stored_normals() -> None:
    sphere = ico_sphere(1)
    normals = sphere.verts_packed().clone()
    normals[[2, 7]] *= -1
    mesh = Meshes([sphere.verts_packed()], [sphere.faces_packed()], verts_normals=[normals])
    assert quality.wrong_normals(mesh).nonzero()[:, 0].tolist() == [2, 7]


def test_merging_closes_a_cube_of_six_squares() -> None:
    squares = make_cube()
    assert len(quality.boundary_edges(squares)) == 24
    assert int(quality.duplicate_verts(squares).sum()) == 16
    merged = quality.merge_verts(squares)
    assert len(merged.verts_packed()) == 8
    assert quality.is_watertight(merged)
    assert quality.signed_volume(merged) == pytest.approx(8)


def test_a_batch_is_measured_as_one() -> None:
    batch = join_meshes_as_batch([cube(), ico_sphere(1)])
    assert quality.components(batch).bincount().tolist() == [80, 12]
    assert quality.surface_area(batch) == pytest.approx(6 + quality.surface_area(ico_sphere(1)))


@pytest.mark.parametrize("mesh", [Meshes([], []), Meshes([torch.zeros(0, 3)], [torch.zeros(0, 3, dtype=torch.long)])])
def test_nothing(mesh: Meshes) -> None:
    assert quality.mean_dihedral_deg(mesh).isnan()
    assert quality.edge_length_spread(mesh).isnan()
    assert quality.surface_area(mesh) == 0
    assert not quality.is_watertight(mesh)
    assert quality.genus(mesh) is None
    assert quality.euler_characteristic(mesh) == 0
    for find in (quality.flipped_faces, quality.inward_faces, quality.components, quality.boundary_loops):
        assert find(mesh).shape == (0,)
    assert quality.non_manifold_verts(mesh).shape == (0,)
    assert len(quality.merge_verts(mesh).faces_packed()) == 0


FUNCTIONS = (
    *("mean_dihedral_deg", "edge_length_spread", "edge_lengths", "degenerate_faces", "duplicate_faces"),
    *("duplicate_verts", "unreferenced_verts", "boundary_edges", "non_manifold_edges", "non_manifold_verts"),
    *("boundary_loops", "components", "inconsistent_edges", "flipped_faces", "inward_faces", "wrong_normals"),
)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_results_stay_on_the_device(far, name: str) -> None:  # noqa: F811
    inside_out = with_faces(cube(side=0.5, at=0.2), cube().faces_packed().flip(1))
    mesh = join_meshes_as_scene([cube(side=3.0, at=-1.0), inside_out, cube(at=5.0, keep=slice(2, None))])
    here = getattr(quality, name)(mesh)
    there = getattr(quality, name)(mesh.to(far))
    assert there.device == far
    torch.testing.assert_close(there.held, here)
    assert quality.signed_volume(quality.merge_verts(mesh.to(far))) == pytest.approx(quality.signed_volume(mesh))
