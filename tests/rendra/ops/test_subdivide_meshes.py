import pytest
import torch
from assertions import assert_close

from rendra.ops.subdivide_meshes import SubdivideMeshes
from rendra.structures import Meshes
from rendra.utils import ico_sphere, torus


@pytest.fixture
def meshes() -> Meshes:
    shapes = [ico_sphere(0), torus(0.3, 1.0, 3, 5), Meshes([torch.rand(2, 3)], [torch.zeros(0, 3)]), ico_sphere(1)]
    return Meshes([m.verts_packed() for m in shapes], [m.faces_packed() for m in shapes])


def test_one_triangle_becomes_four_in_the_documented_order() -> None:
    verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    fine = SubdivideMeshes()(Meshes([verts], [torch.tensor([[0, 1, 2]])]))
    assert_close(fine.verts_packed()[3:], [[1.0, 0, 0], [0, 1, 0], [1, 1, 0]])  # edges 01, 02, 12
    assert fine.faces_packed().tolist() == [[0, 3, 4], [1, 5, 3], [2, 4, 5], [5, 4, 3]]


def test_shape_stays(meshes: Meshes) -> None:
    fine = SubdivideMeshes()(meshes)
    assert_close(
        fine.num_verts_per_mesh(),
        meshes.num_verts_per_mesh() + meshes.num_edges_per_mesh(),
    )
    assert torch.equal(fine.num_faces_per_mesh(), 4 * meshes.num_faces_per_mesh())
    coarse_area = meshes.faces_areas_packed().split(meshes.num_faces_per_mesh().tolist())
    fine_area = fine.faces_areas_packed().split(fine.num_faces_per_mesh().tolist())
    for before, after in zip(coarse_area, fine_area, strict=True):
        assert_close(after.view(4, -1).T, (before / 4)[:, None].expand(-1, 4), atol=1e-6)
    before, after = meshes[0].faces_normals_packed(), fine[0].faces_normals_packed()
    assert_close(after.view(4, -1, 3), before.expand(4, -1, -1))


def test_linear_features_stay_linear(meshes: Meshes) -> None:
    weights = torch.randn(3, 5)
    fine, feats = SubdivideMeshes()(meshes, meshes.verts_packed() @ weights)
    assert_close(feats, fine.verts_packed() @ weights)


def test_a_template_gives_the_same_and_takes_any_batch_size() -> None:
    template, batch = ico_sphere(1), ico_sphere(1).extend(3).scale_verts(torch.tensor([1.0, 2, 3]))
    feats = torch.rand(len(batch.verts_packed()), 2)
    fixed, fixed_feats = SubdivideMeshes(template)(batch, feats)
    free, free_feats = SubdivideMeshes()(batch, feats)
    assert_close(fixed.verts_packed(), free.verts_packed())
    assert torch.equal(fixed.faces_packed(), free.faces_packed())
    assert_close(fixed_feats, free_feats)
    with pytest.raises(ValueError, match="must have the 42 vertices and 80 faces"):
        SubdivideMeshes(template)(ico_sphere(0))


def test_gradients_reach_vertices_and_features() -> None:
    verts = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    feats = torch.rand(4, 2, dtype=torch.float64, requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])

    def subdivided(v: torch.Tensor, f: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        fine, fine_feats = SubdivideMeshes()(Meshes([v], [faces]), f)
        return fine.verts_packed(), fine_feats

    assert torch.autograd.gradcheck(subdivided, (verts, feats))


def test_features_must_fit(meshes: Meshes) -> None:
    with pytest.raises(ValueError, match=r"feats must have shape \(71, D\), got \(3, 2\)"):
        SubdivideMeshes()(meshes, torch.rand(3, 2))


def test_an_empty_batch_stays_empty() -> None:
    assert len(SubdivideMeshes()(Meshes([], []))) == 0
