"""Refinement has the paper's weights, begins where its meshes are, and reads maps where vertices are seen."""

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from rendra.ops import vert_align
from rendra.structures import Meshes, join_meshes_as_batch
from rendra.utils import ico_sphere
from rendra_lab.networks.mesh_refinement import MeshRefinement, RefinementStage


def weights(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def two_meshes(dtype: torch.dtype = torch.float32) -> Meshes:
    """Of different sizes."""
    first, second = ico_sphere(0), ico_sphere(1)
    verts = [0.5 * first.verts_packed().to(dtype), 0.8 * second.verts_packed().to(dtype)]
    return Meshes(verts, [first.faces_packed(), second.faces_packed()])


def shaken(refinement: MeshRefinement, size: float = 0.3) -> MeshRefinement:
    for parameter in refinement.parameters():
        nn.init.normal_(parameter, std=size)
    return refinement


@pytest.mark.parametrize(("channels", "millions"), [(3840, 1.846), (256, 0.470)])
def test_published_heads_have_the_published_weights(channels: int, millions: float) -> None:
    assert round(weights(MeshRefinement(channels)) / 1e6, 3) == millions


def test_untrained_stages_leave_meshes_where_they_are() -> None:
    meshes = two_meshes()
    for stage in MeshRefinement(5, width=4)(meshes, [torch.randn(2, 5, 6, 6)]):
        assert torch.equal(stage.verts_packed(), meshes.verts_packed())
        assert torch.equal(stage.faces_packed(), meshes.faces_packed())


@pytest.mark.parametrize("sizes", [(25, 13, 7, 4), (35, 18, 9, 5), (6, 5, 1, 2)])
def test_narrowed_maps_are_read_as_wide_ones_would_be(sizes: tuple[int, ...]) -> None:
    maps = [torch.randn(2, channels, size, size, dtype=torch.float64) for channels, size in enumerate(sizes, 1)]
    stage = RefinementStage(10, width=6, is_first=True).double()
    nn.init.normal_(stage.bottleneck.weight)
    meshes = two_meshes(torch.float64)
    expected = stage.bottleneck(vert_align(maps, meshes, return_packed=True))
    torch.testing.assert_close(stage._seen(meshes, maps, meshes.verts_padded()), expected)


def test_one_stage_is_its_formula() -> None:
    meshes, maps = two_meshes(torch.float64), [torch.randn(2, 3, 4, 4, dtype=torch.float64)]
    stage = shaken(MeshRefinement(3, width=4, stages=2, convs=2).double()).stages[1]
    before = torch.randn(len(meshes.verts_packed()), 4, dtype=torch.float64)
    moved, features = stage(meshes, maps, before, lambda verts: verts.flip(-1))
    places = meshes.verts_packed().flip(-1)
    seen = vert_align(maps, meshes.update_padded(meshes.verts_padded().flip(-1)), return_packed=True)
    x = torch.cat([F.relu(stage.bottleneck(seen)), places, before], 1)
    for conv in stage.convs:
        x = torch.cat([F.relu(conv(x, meshes.edges_packed())), places], 1)
    torch.testing.assert_close(features, x[:, :4])
    torch.testing.assert_close(moved.verts_packed(), meshes.verts_packed() + torch.tanh(stage.offset(x)))


def test_meshes_of_a_batch_know_nothing_of_each_other() -> None:
    meshes, maps = two_meshes(), [torch.randn(2, 3, 5, 5), torch.randn(2, 2, 3, 3)]
    refinement = shaken(MeshRefinement(5, width=4))
    together = refinement(meshes, maps)[-1].verts_list()
    for i in range(2):
        alone = refinement(meshes[i], [each[i : i + 1] for each in maps])[-1].verts_packed()
        torch.testing.assert_close(together[i], alone)


def test_subdivision_comes_between_stages() -> None:
    sphere = ico_sphere(2)
    stages = MeshRefinement(3, width=4, subdivide=True)(
        join_meshes_as_batch([sphere, sphere]), [torch.randn(2, 3, 5, 5)]
    )
    assert [stage.num_verts_per_mesh().tolist() for stage in stages] == [[162] * 2, [642] * 2, [2562] * 2]
    assert float(stages[-1].verts_packed().detach().norm(dim=1).max()) <= 1 + 1e-6


def test_gradients_of_maps_places_and_weights_are_those_of_finite_differences() -> None:
    meshes = two_meshes(torch.float64)[0]
    refinement = shaken(MeshRefinement(2, width=2, stages=2, convs=1).double(), 0.5)
    maps = torch.randn(1, 2, 4, 4, dtype=torch.float64, requires_grad=True)  # no vertex lies on a cell
    verts = meshes.verts_padded().clone().requires_grad_()

    def moved(maps: torch.Tensor, verts: torch.Tensor) -> torch.Tensor:
        return refinement(meshes.update_padded(verts), [maps], lambda each: each * 0.9)[-1].verts_packed()

    assert torch.autograd.gradcheck(moved, (maps, verts))


@pytest.mark.parametrize("count", [0, 1])
def test_no_mesh_and_no_vertices_are_no_error(count: int) -> None:
    nothing = [torch.zeros(0, 3)] * count, [torch.zeros(0, 3, dtype=torch.int64)] * count
    refinement = MeshRefinement(4, width=3)
    stages = refinement(Meshes(*nothing), [torch.randn(count, 4, 5, 5)])
    assert [len(stage) for stage in stages] == [count] * 3
    sum(stage.verts_packed().sum() for stage in stages).backward()
    assert all(parameter.grad is not None for parameter in refinement.parameters())


def test_other_channels_are_refused() -> None:
    with pytest.raises(ValueError, match="reads 5 channels, the maps have 4"):
        MeshRefinement(5, width=3)(two_meshes(), [torch.randn(2, 4, 5, 5)])
