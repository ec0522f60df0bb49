"""Laws of one batch of meshes: its three forms agree, closed forms hold, derivatives are right."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import Tensor

from rendra.structures import Meshes
from rendra.utils import ico_sphere, torus

SQUARE_VERTS = torch.tensor([[0.0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
SQUARE_FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def random_meshes(sizes: list[tuple[int, int]], dtype: torch.dtype = torch.float32) -> Meshes:
    verts = [torch.randn(v, 3, dtype=dtype) for v, _ in sizes]
    faces = [torch.stack([torch.randperm(v)[:3] for _ in range(f)]) if f else torch.zeros(0, 3) for v, f in sizes]
    return Meshes(verts, faces)


@pytest.fixture(params=[[(5, 4)], [(4, 3), (7, 9), (3, 1)], [(4, 2), (6, 0), (0, 0), (5, 3)], []], ids=str)
def meshes(request: pytest.FixtureRequest) -> Meshes:
    return random_meshes(request.param)


def unpadded(padded: Tensor, counts: Tensor) -> list[Tensor]:
    return [row[:n] for row, n in zip(padded, counts.tolist(), strict=True)]


@pytest.mark.parametrize("rows", ["verts", "verts_normals", "faces_normals"])
def test_list_padded_and_packed_agree(meshes: Meshes, rows: str) -> None:
    counts = meshes.num_faces_per_mesh() if rows.startswith("faces") else meshes.num_verts_per_mesh()
    as_list = getattr(meshes, f"{rows}_list")()
    packed, padded = getattr(meshes, f"{rows}_packed")(), getattr(meshes, f"{rows}_padded")()
    assert [len(item) for item in as_list] == counts.tolist()
    assert_close(torch.cat([torch.zeros(0, 3), *as_list]), packed, atol=0)
    assert_close(torch.cat([torch.zeros(0, 3), *unpadded(padded, counts)]), packed, atol=0)
    assert padded.abs().sum().item() == pytest.approx(packed.abs().sum().item())  # the rest is 0


def test_faces_agree(meshes: Meshes) -> None:
    first, counts = meshes.mesh_to_verts_packed_first_idx(), meshes.num_faces_per_mesh()
    shifted = [faces + start for faces, start in zip(meshes.faces_list(), first, strict=True)]
    assert torch.equal(torch.cat([torch.zeros(0, 3, dtype=torch.int64), *shifted]), meshes.faces_packed())
    padded = meshes.faces_padded()
    assert all(map(torch.equal, unpadded(padded, counts), meshes.faces_list()))
    assert (padded == -1).sum() == 3 * (padded.shape[0] * padded.shape[1] - counts.sum())
    assert torch.equal(meshes.valid, counts > 0)


def test_index_tensors_agree(meshes: Meshes) -> None:
    for counts, first, owner in (
        (
            meshes.num_verts_per_mesh(),
            meshes.mesh_to_verts_packed_first_idx(),
            meshes.verts_packed_to_mesh_idx(),
        ),
        (
            meshes.num_faces_per_mesh(),
            meshes.mesh_to_faces_packed_first_idx(),
            meshes.faces_packed_to_mesh_idx(),
        ),
        (
            meshes.num_edges_per_mesh(),
            meshes.mesh_to_edges_packed_first_idx(),
            meshes.edges_packed_to_mesh_idx(),
        ),
    ):
        assert torch.equal(owner, torch.arange(len(meshes)).repeat_interleave(counts))
        assert torch.equal(first, counts.cumsum(0) - counts)
    rows = meshes.verts_padded().reshape(-1, 3)
    assert torch.equal(rows[meshes.verts_padded_to_packed_idx()], meshes.verts_packed())


def test_padded_and_list_construction_agree() -> None:
    from_list = random_meshes([(5, 4), (5, 2)])
    padded = torch.full((2, 6, 3), -1)
    padded[:, :4] = from_list.faces_padded()
    from_padded = Meshes(from_list.verts_padded(), padded)
    assert torch.equal(from_padded.faces_packed(), from_list.faces_packed())
    assert torch.equal(from_padded.verts_packed(), from_list.verts_packed())
    assert from_padded.faces_padded().shape == (2, 6, 3)
    assert [len(f) for f in from_padded.faces_list()] == [4, 2]


def test_every_edge_is_listed_once_and_every_face_finds_its_own(meshes: Meshes) -> None:
    edges, faces = meshes.edges_packed(), meshes.faces_packed()
    pairs = {tuple(sorted(p)) for f in faces.tolist() for p in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0]))}
    assert [tuple(e) for e in edges.tolist()] == sorted(pairs)
    sides = torch.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], dim=1).sort(dim=2).values
    assert torch.equal(edges[meshes.faces_packed_to_edges_packed()], sides)


@pytest.mark.parametrize("level", [0, 1, 3])
def test_euler_characteristic(level: int) -> None:
    for mesh, expected in ((ico_sphere(level), 2), (torus(0.3, 1, 5 + level, 7), 0)):
        assert len(mesh.verts_packed()) - len(mesh.edges_packed()) + len(mesh.faces_packed()) == expected


def test_laplacian_annihilates_constants_and_pulls_to_the_neighbours_mean(meshes: Meshes) -> None:
    dense = meshes.laplacian_packed().to_dense()
    assert_close(dense.diagonal(), -torch.ones(len(dense)))
    used = torch.zeros(len(dense), dtype=torch.bool)
    used[meshes.edges_packed().reshape(-1)] = True
    assert_close(dense.sum(1)[used], torch.zeros(int(used.sum())))
    for v in used.nonzero()[:, 0].tolist():
        around = meshes.edges_packed()[(meshes.edges_packed() == v).any(1)].sum(1) - v
        assert_close(dense[v, around], torch.full((len(around),), 1 / len(around)))


def test_laplacian_of_the_icosahedron() -> None:
    sphere = ico_sphere(0)
    lengths = torch.sparse.mm(sphere.laplacian_packed(), sphere.verts_packed()).norm(dim=1)
    assert_close(lengths.mean(), torch.tensor(0.5528), atol=1e-4)


def test_areas_and_normals_of_a_rectangle() -> None:
    mesh = Meshes([SQUARE_VERTS], [SQUARE_FACES])
    assert_close(mesh.faces_areas_packed(), [1.0, 1.0])
    assert_close(mesh.faces_normals_packed(), [[0.0, 0, 1]] * 2)
    assert_close(mesh.verts_normals_packed(), [[0.0, 0, 1]] * 4)


def test_areas_and_normals_of_sphere_and_torus() -> None:
    sphere, ring = ico_sphere(4), torus(0.25, 1.0, 64, 96)
    assert sphere.faces_areas_packed().sum().item() == pytest.approx(4 * math.pi, rel=2e-3)
    assert ring.faces_areas_packed().sum().item() == pytest.approx(4 * math.pi**2 * 0.25, rel=2e-3)
    assert_close(sphere.verts_normals_packed(), sphere.verts_packed(), atol=2e-2)
    volume = torch.linalg.det(sphere.verts_packed()[sphere.faces_packed()]).sum() / 6
    assert volume.item() == pytest.approx(4 / 3 * math.pi, rel=5e-3)  # positive: the faces look outwards


def test_vertex_normals_weigh_faces_by_area() -> None:
    verts = torch.tensor([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1]])
    mesh = Meshes([verts], [torch.tensor([[0, 1, 2], [0, 2, 3]])])  # areas 1.5 along z, 0.5 along x
    assert_close(mesh.verts_normals_packed()[0], torch.tensor([1.0, 0, 3]) / math.sqrt(10))


def test_degenerate_faces_have_no_normal_and_finite_gradients() -> None:
    verts = torch.zeros(3, 3, requires_grad=True)
    mesh = Meshes([verts], [torch.tensor([[0, 1, 2]])])
    assert (mesh.faces_normals_packed() == 0).all()
    total = mesh.faces_areas_packed().sum() + mesh.faces_normals_packed().sum() + mesh.verts_normals_packed().sum()
    total.backward()
    assert_finite(verts.grad)


@pytest.mark.parametrize(
    "method", ["faces_areas_packed", "faces_normals_packed", "verts_normals_packed", "get_bounding_boxes"]
)
def test_derivatives(method: str) -> None:
    sphere = ico_sphere(0)
    start = Meshes([sphere.verts_packed().double(), SQUARE_VERTS.double()], [sphere.faces_packed(), SQUARE_FACES])
    offsets = (0.2 * torch.rand(16, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: getattr(start.offset_verts(x), method)(), offsets)


def test_bounding_boxes(meshes: Meshes) -> None:
    for box, verts in zip(meshes.get_bounding_boxes(), meshes.verts_list(), strict=True):
        if len(verts):
            assert_close(box, torch.stack([verts.amin(0), verts.amax(0)], dim=1), atol=0)
        else:
            assert (box[:, 0] > box[:, 1]).all()


def test_double_precision_is_kept() -> None:
    mesh = random_meshes([(4, 3), (5, 2)], torch.float64)
    values = [mesh.verts_padded(), mesh.verts_normals_packed(), mesh.faces_areas_packed(), mesh.laplacian_packed()]
    assert {v.dtype for v in values} == {torch.float64}
    assert mesh.offset_verts(torch.ones(3, dtype=torch.float64)).verts_packed().dtype == torch.float64


def test_a_leaf_changed_by_an_optimiser_is_seen_at_once() -> None:
    verts = SQUARE_VERTS.clone().requires_grad_()
    mesh = Meshes([verts, SQUARE_VERTS], [SQUARE_FACES] * 2)
    for _ in range(2):  # a second backward pass needs a graph of its own
        mesh.faces_areas_packed().sum().backward()
        mesh.verts_normals_packed().sum().backward()
        with torch.no_grad():
            verts.mul_(2)
    assert_close(mesh.faces_areas_packed().detach(), [16.0, 16, 1, 1])


def test_given_normals_are_kept() -> None:
    normals = [torch.randn(4, 3), torch.randn(3, 3)]
    mesh = Meshes([SQUARE_VERTS, SQUARE_VERTS[:3]], [SQUARE_FACES, SQUARE_FACES[:1]], verts_normals=normals)
    assert mesh.has_verts_normals()
    assert torch.equal(mesh.verts_normals_packed(), torch.cat(normals))
    assert torch.equal(mesh[1].verts_normals_packed(), normals[1])
    assert torch.equal(mesh.extend(2).verts_normals_list()[3], normals[1])
    assert torch.equal(mesh.offset_verts(torch.ones(3)).verts_normals_packed(), torch.cat(normals))
    assert not mesh.offset_verts(torch.rand(7, 3)).has_verts_normals()
    padded = Meshes(SQUARE_VERTS[None], SQUARE_FACES[None], verts_normals=normals[0][None])
    assert torch.equal(padded.verts_normals_list()[0], normals[0])
    bare = Meshes([SQUARE_VERTS], [SQUARE_FACES])
    assert not bare.has_verts_normals()
    bare.verts_normals_packed()
    assert bare.has_verts_normals()
    assert mesh.has_given_normals
    assert not bare.has_given_normals


def test_rows_with_padding_are_dropped_from_lists() -> None:
    faces = torch.tensor([[0, 1, 2], [-1, -1, -1], [0, 2, 3], [-1, 0, 1]])
    assert torch.equal(Meshes([SQUARE_VERTS], [faces]).faces_packed(), SQUARE_FACES)


@pytest.mark.parametrize(
    ("verts", "faces", "normals", "message"),
    [
        (SQUARE_VERTS, [SQUARE_FACES], None, "either a list or a tensor"),
        ([SQUARE_VERTS], [SQUARE_FACES] * 2, None, "one entry for each mesh, got 1 and 2"),
        ([SQUARE_VERTS[:, :2]], [SQUARE_FACES], None, r"verts\[0\] must have shape \(n, 3\), got \(4, 2\)"),
        ([SQUARE_VERTS], ["x"], None, r"faces\[0\] must be a tensor"),
        ([SQUARE_VERTS] * 2, [SQUARE_FACES, SQUARE_FACES + 1], None, r"faces\[1\] refers to vertex 4"),
        ([SQUARE_VERTS], [SQUARE_FACES - 2], None, r"faces\[0\] refers to vertex -2"),
        (SQUARE_VERTS[None], SQUARE_FACES, None, r"shape \(N, V, 3\) and \(N, F, 3\)"),
        (SQUARE_VERTS[None].expand(2, -1, -1), SQUARE_FACES[None], None, "same batch size, got 2 and 1"),
        (SQUARE_VERTS[None], SQUARE_FACES[None] + 1, None, "refers to vertex 4"),
        (SQUARE_VERTS[None], torch.tensor([[[-1, -1, -1], [0, 1, 2]]]), None, "must be at the end"),
        ([SQUARE_VERTS], [SQUARE_FACES], [SQUARE_VERTS[:2]], "one row for each vertex"),
        ([SQUARE_VERTS], [SQUARE_FACES], SQUARE_VERTS, "shape of the padded vertices"),
        ([SQUARE_VERTS], [SQUARE_FACES], "x", "must be a list or a tensor"),
        ([SQUARE_VERTS], [SQUARE_FACES.to("meta")], None, "on same device, got"),
    ],
)
def test_wrong_input_is_named(verts: object, faces: object, normals: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Meshes(verts, faces, verts_normals=normals)
