"""VoxMesh: its frames, its guards, its heads, and that it learns."""

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from box_pictures import SIDE, box_pictures
from far_device import Far, far  # noqa: F401
from torch import nn

from rendra_lab.networks.mesh_refinement import MeshRefinement
from rendra_lab.networks.residual_backbone import ResidualBackbone
from rendra_lab.networks.voxel_head import VoxelHead
from rendra_lab.shape_losses import stage_chamfer, stage_edges, stage_normals, voxel_cross_entropy
from rendra_lab.tasks.voxmesh.baselines import MeanShapes
from rendra_lab.tasks.voxmesh.starts import SphereStart, VoxelStart
from rendra_lab.tasks.voxmesh.task import VoxMesh, whole_frustums
from rendra_lab.terms import LossTerm

SIZES = [(0.3, 0.2, 0.2), (0.15, 0.3, 0.3), (0.25, 0.25, 0.1)]
WIDTHS = (4, 4, 8, 8)


def losses(*names: str) -> dict[str, LossTerm]:
    every = {
        "voxels": LossTerm(voxel_cross_entropy, 1.0, "voxels", None),
        "chamfer": LossTerm(partial(stage_chamfer, samples=100), 1.0, "refined", None),
        "normals": LossTerm(partial(stage_normals, samples=100), 0.1, "refined", None),
        "edges": LossTerm(stage_edges, 0.05, "refined", None),
    }
    return {name: every[name] for name in names or every}


def voxel_start(warmup_steps: int = 0) -> VoxelStart:
    return VoxelStart(VoxelHead([8, 8], side=8, width=8, convs=1), warmup_steps=warmup_steps)


def task(start: Any = None, refines: bool = True, names: tuple[str, ...] = (), **settings: Any) -> VoxMesh:
    torch.manual_seed(0)
    backbone = ResidualBackbone((1, 1, 1, 1), WIDTHS, "basic", "group")
    refinement = MeshRefinement(sum(WIDTHS), width=6, subdivide=settings.pop("subdivide", False)) if refines else None
    return VoxMesh(
        backbone, voxel_start() if start is None else start, refinement, losses=losses(*names),
        optimizer=partial(torch.optim.Adam, lr=1e-2), **settings,
    )  # fmt: skip


def test_losses_and_gradients_of_an_untrained_network_are_finite() -> None:
    model, batch = task(), box_pictures(SIZES)
    total, terms = model.objective(model.predict(batch), batch)
    assert set(terms) == {"voxels", "chamfer", "normals", "edges"}
    total.backward()
    assert all(bool(parameter.grad.isfinite().all()) for parameter in model.parameters())
    assert float(model.backbone.conv1.weight.grad.abs().sum()) > 0


def test_voxels_alone_are_learned_in_the_first_steps() -> None:
    model, batch = task(voxel_start(warmup_steps=2)), box_pictures(SIZES)
    prediction = model.predict(batch)
    assert prediction.meshes.num_verts_per_mesh().tolist() == [4] * 3
    total, terms = model.objective(prediction, batch)
    assert float(terms["voxels"].detach()) > 0
    assert all(float(terms[name].detach()) == 0 for name in ("chamfer", "normals", "edges"))
    total.backward()
    assert all(parameter.grad is not None for parameter in model.parameters())
    model.eval()
    assert min(model.predict(batch).meshes.num_verts_per_mesh().tolist()) > 4


def test_starts_lie_in_the_frustum_and_stages_in_the_axes_of_the_camera() -> None:
    model, batch = task().eval(), box_pictures(SIZES)
    prediction = model.predict(batch)
    assert prediction.voxels is None
    assert prediction.refined is None
    verts = prediction.starts.verts_padded()
    torch.testing.assert_close(verts[..., 2].amin(1), torch.full((3,), 1.0))  # undecided: every voxel is kept
    torch.testing.assert_close(verts[..., 2].amax(1), torch.full((3,), 4.0))
    seen = verts @ batch.intrinsics.mT
    pixels = seen[..., :2] / seen[..., 2:]
    torch.testing.assert_close(pixels.amax(1), torch.full((3, 2), float(SIDE)))
    torch.testing.assert_close(prediction.meshes.verts_packed(), prediction.starts.verts_packed())


def test_voxels_are_compared_with_those_of_the_frustum() -> None:
    model, batch = task(), box_pictures(SIZES)
    voxels = model.predict(batch).voxels
    assert voxels is not None
    assert torch.equal(voxels.targets.bool(), whole_frustums(batch).voxels_of(batch.shapes, 8))
    assert bool(voxels.targets.flatten(1).any(1).all())


def test_vertices_read_maps_where_the_camera_sees_them() -> None:
    """A vertex outside of the picture reads nothing, so that what is painted does not move it."""
    model, batch = task(SphereStart(0, 0.5), names=("chamfer",)), box_pictures(SIZES)
    for parameter in model.refinement.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    frustums = whole_frustums(batch)
    starts = model.start([torch.zeros(3, 1, 1, 1)], 0).meshes
    aside = torch.tensor([3.0, 0.0, 0.0])
    for moved, changes in ((torch.zeros(3), True), (aside, False)):
        meshes = starts.offset_verts(moved)
        meshes = meshes.update_padded(frustums.to_camera(meshes.verts_padded()))
        maps = [torch.randn(3, sum(WIDTHS), 5, 5) for _ in range(2)]
        first, second = (model._refined(meshes, [each], frustums)[0].verts_packed() for each in maps)
        assert torch.allclose(first, second) is not changes


@pytest.mark.parametrize(
    ("start", "settings", "verts"),
    [
        (SphereStart(1), {}, 42),
        (SphereStart(1), {"subdivide": True}, 642),
        (None, {"refines": False, "names": ("voxels",)}, None),
    ],
)
def test_every_head_learns_something(start: Any, settings: dict[str, Any], verts: int | None) -> None:
    names = settings.pop("names", ("chamfer", "edges"))
    model, batch = task(start, names=names, **settings), box_pictures(SIZES)
    optimizer, first = model.configure_optimizers(), None
    for _ in range(8):
        prediction = model.predict(batch)
        total, _ = model.objective(prediction, batch)
        first = float(total.detach()) if first is None else first
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
    assert float(total.detach()) < 0.9 * first
    assert verts is None or prediction.meshes.num_verts_per_mesh().tolist() == [verts] * 3


def test_pictures_are_resized_for_the_network_alone() -> None:
    seen = []
    model, batch = task(side_px=65), box_pictures(SIZES)
    model.backbone.register_forward_pre_hook(lambda _, inputs: seen.append(tuple(inputs[0].shape)))
    model.predict(batch)
    wide = replace(batch, rgb=torch.rand(3, 3, SIDE, 2 * SIDE))
    model.predict(wide)
    assert seen == [(3, 3, 65, 65), (3, 3, 65, 130)]


def test_panels_and_meshes_show_the_truth_beside_the_answer() -> None:
    model, batch = task(), box_pictures(SIZES)
    panels = model.show(batch)
    assert list(panels) == ["input", "start", "mesh", "truth"]
    assert all(page.shape == (3, SIDE, SIDE, 3) for page in panels.values())
    covered = (panels["truth"] < 0.99).any(-1).float()
    painted = batch.rgb[:, 0]
    assert float((covered * painted).sum() / painted.sum()) > 0.9
    meshes = model.show_meshes(batch)
    assert set(meshes) == {"mesh", "start", "truth"}
    assert float(meshes["truth"].verts_packed()[:, 2].max()) < 0


def test_an_evaluation_leaves_no_trace() -> None:
    model, batch = task(), box_pictures(SIZES[:1])
    first, second = model.observe(batch), model.observe(batch)
    assert model.training
    assert torch.equal(first.meshes.verts_packed(), second.meshes.verts_packed())


@pytest.mark.parametrize("start", [None, SphereStart(1)])
def test_a_step_stays_where_its_batch_lies(far, start: Any) -> None:  # noqa: F811
    model, batch = task(start, names=("chamfer", "normals", "edges")), box_pictures(SIZES[:2])
    for module in model.modules():
        for name, buffer in module._buffers.items():
            module._buffers[name] = buffer.to(far)
        for name, parameter in module._parameters.items():
            if parameter is not None:
                module._parameters[name] = nn.Parameter(parameter.detach().to(far))
    prediction = model.predict(batch.to(far))
    model.objective(prediction, batch)[0].backward()
    assert isinstance(prediction.meshes.verts_packed(), Far)
    assert isinstance(model.backbone.conv1.weight.grad, Far)
    assert isinstance(MeanShapes([batch.to(far)]).posed(batch.to(far)).verts_packed(), Far)
