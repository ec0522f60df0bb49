"""Losses of voxels and stages: closed forms, meshes that do not count, and gradients."""

from dataclasses import replace

import pytest
import torch
from far_device import Far, far  # noqa: F401

from rendra.loss import mesh_edge_loss
from rendra.ops import sample_points_from_meshes
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.detection.records import CellVerdicts, MeshVerdicts
from rendra_lab.shape_losses import stage_chamfer, stage_edges, stage_normals, voxel_cross_entropy


def verdicts(offsets: tuple[float, ...] = (0.0, 2.0), count: int = 2) -> MeshVerdicts:
    """Unit spheres beside their truth, whose stages are moved along x."""
    sphere = ico_sphere(3).extend(count)
    points, normals = sample_points_from_meshes(sphere, 2000, return_normals=True)
    stages = tuple(sphere.offset_verts(torch.tensor([offset, 0.0, 0.0])) for offset in offsets)
    return MeshVerdicts(stages, points, normals, torch.ones(count, dtype=torch.bool))


def test_voxels_of_undecided_logits_cost_a_bit() -> None:
    cells = CellVerdicts(torch.zeros(2, 3, 3, 3), (torch.rand(2, 3, 3, 3) > 0.5).float())
    torch.testing.assert_close(voxel_cross_entropy(cells), torch.tensor(2.0).log())
    none = CellVerdicts(torch.zeros(0, 3, 3, 3, requires_grad=True), torch.zeros(0, 3, 3, 3))
    assert float(voxel_cross_entropy(none).detach()) == 0


def test_right_meshes_cost_nothing_and_far_ones_their_squared_distance() -> None:
    assert float(stage_chamfer(verdicts((0.0,)), 2000)) < 0.01
    assert float(stage_normals(verdicts((0.0,)), 2000)) < 0.02
    # every point of a sphere of radius 1 sees the other, d away, along x: about (d - 1)^2 each way
    assert float(stage_chamfer(verdicts((100.0,)), 500)) == pytest.approx(2 * 99**2, rel=0.03)


def test_stages_are_averaged_or_summed() -> None:
    both = verdicts((0.0, 3.0))
    for loss in (stage_chamfer, stage_normals, stage_edges):
        torch.manual_seed(1)
        mean = loss(both)
        torch.manual_seed(1)
        torch.testing.assert_close(loss(both, over_stages="sum"), 2 * mean)
    torch.testing.assert_close(stage_edges(both), mesh_edge_loss(ico_sphere(3)))
    with pytest.raises(ValueError, match="mean or sum, got 'median'"):
        stage_edges(both, over_stages="median")


@pytest.mark.parametrize("loss", [stage_chamfer, stage_normals, stage_edges])
def test_meshes_that_do_not_count_teach_nothing(loss) -> None:
    sphere = ico_sphere(2)
    verts = torch.stack([sphere.verts_packed(), 50 + 9 * sphere.verts_packed()]).requires_grad_()
    stage = Meshes(verts, sphere.faces_packed().expand(2, -1, -1))
    half = replace(verdicts((0.0,)), stages=(stage,), is_valid=torch.tensor([True, False]))
    value = loss(half)
    assert float(value.detach()) < 0.5
    value.backward()
    assert float(verts.grad[0].abs().sum()) > 0
    assert float(verts.grad[1].abs().sum()) == 0
    nobody = loss(replace(half, is_valid=torch.zeros(2, dtype=torch.bool)))
    assert float(nobody.detach()) == 0
    nobody.backward()


def test_no_mesh_costs_nothing() -> None:
    none = torch.zeros(0, 5, 3)
    empty = MeshVerdicts((Meshes([], []),), none, none, torch.zeros(0, dtype=torch.bool))
    assert all(float(loss(empty).detach()) == 0 for loss in (stage_chamfer, stage_normals, stage_edges))


def test_devices(far) -> None:  # noqa: F811
    there = verdicts((0.1,)).to(far)
    for loss in (stage_chamfer, stage_normals):
        assert isinstance(loss(there, 50), Far)
    assert isinstance(stage_edges(there), Far)
