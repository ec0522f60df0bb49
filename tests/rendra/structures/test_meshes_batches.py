"""Laws of meshes made from meshes: indexing, copies, moving, extending, splitting, joining."""

import pytest
import torch
from assertions import assert_close

from rendra.renderer.mesh.textures import TexturesUV, TexturesVertex
from rendra.structures import Meshes, join_meshes_as_batch, join_meshes_as_scene
from rendra.utils import ico_sphere

SIZES = [(4, 3), (7, 9), (3, 1)]


def random_meshes(textured: bool = True) -> Meshes:
    verts = [torch.randn(v, 3) for v, _ in SIZES]
    faces = [torch.stack([torch.randperm(v)[:3] for _ in range(f)]) for v, f in SIZES]
    return Meshes(verts, faces, TexturesVertex([torch.rand(len(v), 2) for v in verts]) if textured else None)


@pytest.fixture
def meshes() -> Meshes:
    return random_meshes()


def assert_same(actual: Meshes, expected: Meshes) -> None:
    assert len(actual) == len(expected)
    for a, e in zip(actual.verts_list(), expected.verts_list(), strict=True):
        assert_close(a, e, atol=0)
    assert all(map(torch.equal, actual.faces_list(), expected.faces_list()))
    assert (actual.textures is None) == (expected.textures is None)
    if expected.textures is not None:
        features = actual.textures.verts_features_list(), expected.textures.verts_features_list()
        assert all(map(torch.equal, *features))


@pytest.mark.parametrize(
    ("index", "picked"),
    [
        (1, [1]),
        (-1, [2]),
        (slice(1, None), [1, 2]),
        (slice(None, None, 2), [0, 2]),
        ([2, 0, 2], [2, 0, 2]),
        ([], []),
        (torch.tensor([1, 0]), [1, 0]),
        (torch.tensor([True, False, True]), [0, 2]),
        (torch.tensor(2), [2]),
    ],
)
def test_indexing_picks_meshes(meshes: Meshes, index: object, picked: list[int]) -> None:
    chosen = meshes[index]
    assert len(chosen) == len(picked)
    assert all(torch.equal(v, meshes.verts_list()[i]) for v, i in zip(chosen.verts_list(), picked, strict=True))
    assert all(torch.equal(f, meshes.faces_list()[i]) for f, i in zip(chosen.faces_list(), picked, strict=True))
    assert len(chosen.textures) == len(picked)


@pytest.mark.parametrize("index", ["a", 1.5, torch.rand(2), 3, [0, 5], (0, 1), torch.tensor([True]), ["a"]])
def test_wrong_indices_raise(meshes: Meshes, index: object) -> None:
    with pytest.raises(IndexError):
        meshes[index]


def test_meshes_can_be_iterated(meshes: Meshes) -> None:
    assert [len(mesh.verts_packed()) for mesh in meshes] == [v for v, _ in SIZES]


def test_split_then_join_is_identity(meshes: Meshes) -> None:
    parts = meshes.split([1, 0, 2])
    assert [len(part) for part in parts] == [1, 0, 2]
    assert_same(join_meshes_as_batch(parts), meshes)
    with pytest.raises(ValueError, match="sum to the 3 meshes"):
        meshes.split([1])
    with pytest.raises(ValueError, match="list of integers"):
        meshes.split([1.5, 1.5])


def test_extend_repeats_each_mesh_in_a_row(meshes: Meshes) -> None:
    assert_same(meshes.extend(2), meshes[[0, 0, 1, 1, 2, 2]])
    assert meshes.extend(2)._topology is meshes.extend(2)._topology
    for wrong in (0, -1, 1.5):
        with pytest.raises(ValueError, match="N must be"):
            meshes.extend(wrong)


@pytest.mark.parametrize("count", [1, 3])
def test_extended_meshes_send_their_gradients_home(count: int) -> None:
    meshes = random_meshes()[:count]
    offsets = torch.zeros_like(meshes.verts_packed(), requires_grad=True)
    meshes.offset_verts(offsets).extend(5).verts_packed().sum().backward()
    assert (offsets.grad == 5).all()


def test_offsets_move_vertices_and_share_the_topology(meshes: Meshes) -> None:
    edges, before = meshes.edges_packed(), meshes.verts_packed().clone()
    offsets = torch.randn_like(before)
    moved = meshes.offset_verts(offsets)
    assert_close(moved.verts_packed(), before + offsets)
    assert moved.edges_packed() is edges
    assert moved.textures is meshes.textures
    assert torch.equal(meshes.verts_packed(), before)
    fresh = Meshes(moved.verts_list(), moved.faces_list())
    assert_close(moved.verts_normals_packed(), fresh.verts_normals_packed())
    assert meshes.offset_verts_(torch.ones(3)) is meshes
    assert_close(meshes.verts_packed(), before + 1)
    with pytest.raises(ValueError, match=r"\(all_v, 3\) = \(14, 3\)"):
        meshes.offset_verts(torch.zeros(2, 3))


def test_moving_in_place_forgets_what_was_derived(meshes: Meshes) -> None:
    areas = meshes.faces_areas_packed()
    meshes.verts_padded()
    assert meshes.scale_verts_(3.0) is meshes
    assert_close(meshes.faces_areas_packed(), 9 * areas, atol=1e-4)
    assert_close(meshes.verts_padded()[0, :4], meshes.verts_list()[0], atol=0)


def test_scales_for_all_and_for_each(meshes: Meshes) -> None:
    packed = meshes.verts_packed()
    factors = torch.tensor([1.0, 2, -3])
    assert_close(meshes.scale_verts(2.0).verts_packed(), 2 * packed)
    assert_close(meshes.scale_verts(torch.tensor(2.0)).verts_packed(), 2 * packed)
    scaled = meshes.scale_verts(factors)
    assert_close(scaled.verts_packed(), packed * factors[meshes.verts_packed_to_mesh_idx(), None])
    with pytest.raises(ValueError, match=r"shape \(3,\), got \(2,\)"):
        meshes.scale_verts(torch.ones(2))


@pytest.mark.parametrize("count", [1, 3])
def test_update_padded_replaces_vertices(count: int) -> None:
    meshes = random_meshes()[:count]
    new = torch.randn_like(meshes.verts_padded()).requires_grad_()
    updated = meshes.update_padded(new)
    for verts, row in zip(updated.verts_list(), new, strict=True):
        assert torch.equal(verts, row[: len(verts)])
    updated.verts_packed().sum().backward()
    assert new.grad.sum() == 3 * len(meshes.verts_packed())
    assert updated.faces_packed() is meshes.faces_packed()
    with pytest.raises(ValueError, match="same batch dimension"):
        meshes.update_padded(new[:, :2])


def test_clones_own_their_memory(meshes: Meshes) -> None:
    copy = meshes.clone()
    assert_same(copy, meshes)
    copy.verts_list()[0].zero_()
    copy.faces_list()[0].zero_()
    assert meshes.verts_list()[0].abs().sum() > 0
    assert meshes.faces_list()[0].sum() > 0
    assert meshes.to("cpu") is meshes
    assert meshes.to("cpu", copy=True) is not meshes
    assert meshes.cpu() is meshes


def test_clone_keeps_the_graph_and_detach_cuts_it(meshes: Meshes) -> None:
    moved = meshes.offset_verts(torch.zeros(3, requires_grad=True))
    assert moved.clone().verts_packed().requires_grad
    assert not moved.detach().verts_packed().requires_grad


@pytest.mark.gpu
def test_meshes_move_between_devices(meshes: Meshes) -> None:
    there = meshes.cuda()
    assert there.device.type == "cuda"
    for tensor in (there.edges_packed(), there.verts_normals_padded(), there.textures.verts_features_packed()):
        assert tensor.device.type == "cuda"
    assert_same(there.extend(2)[::2].cpu(), meshes)


def test_submeshes_keep_shape_and_texture(meshes: Meshes) -> None:
    chosen = [[torch.tensor([0, 2])], [], [torch.tensor([0]), torch.tensor([0])]]
    parts = meshes.submeshes(chosen)
    assert len(parts) == 3
    triangles = meshes.verts_list()[0][meshes.faces_list()[0][chosen[0][0]]]
    assert torch.equal(parts.verts_list()[0][parts.faces_list()[0]], triangles)
    corners = meshes.textures.verts_features_list()[0][meshes.faces_list()[0][chosen[0][0]]]
    assert torch.equal(parts.textures.verts_features_list()[0][parts.faces_list()[0]], corners)
    assert len(parts.verts_list()[1]) == 3
    with pytest.raises(ValueError, match="exactly one set of submeshes"):
        meshes.submeshes([])


def test_single_meshes_are_handed_out(meshes: Meshes) -> None:
    verts, faces = meshes.get_mesh_verts_faces(1)
    assert torch.equal(verts, meshes.verts_list()[1])
    assert torch.equal(faces, meshes.faces_list()[1])
    with pytest.raises(ValueError, match=r"range \[0, 3\)"):
        meshes.get_mesh_verts_faces(3)
    with pytest.raises(ValueError, match="must be an integer"):
        meshes.get_mesh_verts_faces("1")


def test_a_scene_holds_all_triangles(meshes: Meshes) -> None:
    scene = join_meshes_as_scene([meshes, meshes])
    assert len(scene) == 1
    triangles = meshes.verts_packed()[meshes.faces_packed()]
    assert_close(scene.verts_packed()[scene.faces_packed()], torch.cat([triangles, triangles]), atol=0)
    assert len(scene.textures.verts_features_packed()) == 28
    assert join_meshes_as_scene(meshes, include_textures=False).textures is None
    assert scene.equisized
    assert not meshes.equisized


def test_joining_refuses_what_does_not_fit(meshes: Meshes) -> None:
    plain = random_meshes(textured=False)
    with pytest.raises(ValueError, match="Wrong first argument"):
        join_meshes_as_batch(meshes)
    with pytest.raises(ValueError, match="Inconsistent textures"):
        join_meshes_as_batch([meshes, plain])
    assert join_meshes_as_batch([meshes, plain], include_textures=False).textures is None
    with pytest.raises(ValueError, match="same device"):
        join_meshes_as_batch([plain, plain.to("meta")])
    sphere = ico_sphere(0)
    sphere.textures = TexturesUV(torch.ones(1, 2, 2, 2), sphere.faces_padded(), torch.rand(1, 12, 2))
    with pytest.raises(ValueError, match="same type of texture"):
        join_meshes_as_batch([meshes, sphere])


def test_textures_must_fit(meshes: Meshes) -> None:
    with pytest.raises(ValueError, match="do not match the dimensions"):
        meshes.textures = TexturesVertex(torch.rand(3, 5, 2))
    with pytest.raises(ValueError, match="TexturesBase"):
        meshes.textures = torch.rand(3, 7, 2)
    with pytest.raises(ValueError, match=r"\[7, 4, 3\] rows, the meshes have \[4, 7, 3\]"):
        meshes.textures = TexturesVertex([torch.rand(n, 2) for n in (7, 4, 3)])
    with pytest.raises(ValueError, match="does not have textures"):
        random_meshes(textured=False).sample_textures(None)


def test_padded_textures_learn_what_is_padding(meshes: Meshes) -> None:
    meshes.textures = TexturesVertex(torch.rand(3, 7, 2))
    assert meshes.textures.verts_features_packed().shape == (14, 2)
    padded = TexturesVertex(meshes.textures.verts_features_padded())
    meshes[1].textures = padded[1]
    assert padded.verts_features_packed().shape == (21, 2)  # the caller's own object stays as it was


def test_empty_batches_survive_everything() -> None:
    for empty in (Meshes([], []), Meshes(torch.zeros(0, 5, 3), torch.zeros(0, 2, 3))):
        assert empty.isempty()
        assert len(empty[:].extend(2).clone().detach().offset_verts(torch.zeros(3)).scale_verts(2.0)) == 0
        assert len(empty.submeshes([])) == 0
        assert empty.split([]) == []
        assert join_meshes_as_scene(empty).isempty()
        assert empty.edges_packed().shape == (0, 2)
    hollow = Meshes([torch.rand(2, 3)], [torch.zeros(0, 3)])
    assert hollow.isempty()
    assert len(hollow.verts_packed()) == 2
