"""The truth in the frames of regions, heads that learn it, losses that stay finite, and what the paper weighs."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from far_device import Far, far  # noqa: F401
from torch import Tensor

from rendra.utils import ico_sphere
from rendra_lab import shape_losses
from rendra_lab.detection.object_frames import depth_extents, depth_ranges, rebuilt_in_camera
from rendra_lab.detection.records import DepthVerdicts, Detections, Instances, MeshVerdicts, PhotoBatch
from rendra_lab.detection.regions import ObjectRegions
from rendra_lab.detection.roi_align import RoiAlign
from rendra_lab.errors import UserError
from rendra_lab.frustums import Frustums
from rendra_lab.networks.mesh_refinement import MeshRefinement
from rendra_lab.networks.voxel_head import VoxelHead
from rendra_lab.shape_records import Shapes
from rendra_lab.tasks.mesh_rcnn.depth_head import DepthHead, extents_of
from rendra_lab.tasks.mesh_rcnn.losses import depth_extent
from rendra_lab.tasks.mesh_rcnn.shape_heads import ShapeHeads
from rendra_lab.tasks.mesh_rcnn.shape_targets import shape_targets

LENS = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
BOXES = torch.tensor([[20.0, 12, 44, 36], [2.0, 2, 30, 30]])


def balls(*centers: tuple[float, float, float], radius: float = 0.4) -> Shapes:
    """Balls: 24 voxels a side over their bounding boxes."""
    sphere, count = ico_sphere(2), len(centers)
    middles = torch.tensor(centers)
    ticks = (torch.arange(24) + 0.5) / 12 - 1
    z, y, x = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
    filled = (x**2 + y**2 + z**2 < 1).expand(count, 24, 24, 24)
    placed = torch.eye(4).repeat(count, 1, 1)
    placed[:, :3, :3] *= radius
    placed[:, :3, 3] = middles
    unit = sphere.verts_packed()
    verts = radius * unit + middles[:, None]
    return Shapes(verts, unit.expand(count, -1, -1), filled, placed, tuple(verts), tuple(sphere.faces_list() * count))


def photos(shapes: Shapes | None, boxes: Tensor) -> PhotoBatch:
    """Two pictures, all objects in the first."""
    count = len(boxes)
    zeros = torch.zeros(count, dtype=torch.long)
    objects = Instances(zeros, boxes, zeros + 1, torch.zeros(count, 48, 64, dtype=torch.bool), shapes)
    sizes = torch.tensor([[48, 64], [48, 64]])
    return PhotoBatch(torch.zeros(2, 3, 48, 64), sizes, LENS.repeat(2, 1, 1), objects, ["a", "b"])


def regions(count: int) -> ObjectRegions:
    """About the first objects of the first picture."""
    zeros = torch.zeros(count, dtype=torch.long)
    return ObjectRegions(zeros, BOXES[:count], zeros + 1, torch.arange(count))


def heads(most_regions: int | None = None) -> ShapeHeads:
    torch.manual_seed(0)
    strides = (4, 8)
    return ShapeHeads(
        RoiAlign(3, strides), DepthHead(6, 2, side=3, width=8), RoiAlign(4, strides),
        VoxelHead(6, side=8, width=8, convs=1), RoiAlign(7, strides),
        MeshRefinement(6, width=8, stages=2, convs=1, padding_mode="border", align_corners=False),
        points=200, most_regions=most_regions,
    )  # fmt: skip


def stage_losses(verdicts: MeshVerdicts) -> Tensor:
    """As the task weighs them, with fewer points."""
    return (
        shape_losses.stage_chamfer(verdicts, 100, "sum")
        + 0.1 * shape_losses.stage_normals(verdicts, 100, "sum")
        + shape_losses.stage_edges(verdicts, "sum")
    )


def maps() -> list[Tensor]:
    torch.manual_seed(1)
    return [torch.randn(2, 6, 12, 16), torch.randn(2, 6, 6, 8)]


def test_the_paper_s_depth_head_has_its_weights() -> None:
    head = DepthHead(256, 9)
    assert sum(parameter.numel() for parameter in head.parameters()) == 13_904_905


def test_depths_are_those_of_the_class_and_bounded() -> None:
    head = DepthHead(2, 3, side=1, width=4, layers=1)
    torch.nn.init.constant_(head.last.weight, 0.0)
    head.last.bias.data = torch.tensor([0.0, 1.0, 1e4])
    values = head(torch.randn(3, 2, 1, 1), torch.tensor([1, 0, 2]))
    assert extents_of(values).tolist() == pytest.approx([math.e, 1.0, 62.5])
    assert head(torch.zeros(0, 2, 1, 1), torch.zeros(0, dtype=torch.long)).shape == (0,)


def test_targets_are_the_object_in_the_frame_of_its_region() -> None:
    shapes = balls((0.0, 0.0, 2.0), (-0.5, -0.3, 3.0))
    objects = torch.tensor([1, 0, 0])
    boxes = BOXES[[1, 0, 1]]
    truth = shape_targets(shapes, boxes, objects, LENS.repeat(3, 1, 1), side=8, points=50)
    ranges = depth_ranges(shapes.verts)[objects]
    frames = Frustums(boxes, ranges, LENS.repeat(3, 1, 1))
    torch.testing.assert_close(truth.log_extents.exp(), depth_extents(frames))
    assert ranges[1].tolist() == pytest.approx([1.6, 2.4], abs=1e-5)
    back = frames.to_camera(truth.points)
    centers = torch.tensor([[-0.5, -0.3, 3.0], [0.0, 0, 2], [0.0, 0, 2]])[:, None]
    torch.testing.assert_close((back - centers).norm(dim=-1), torch.full((3, 50), 0.4), rtol=0, atol=2e-3)
    assert bool(truth.is_near.all())
    assert truth.voxels.shape == (3, 8, 8, 8)
    assert bool(truth.voxels[1, 4, 4, 4])  # the ball fills the middle of its own region
    assert not bool(truth.voxels[1, 0, 0, 0])
    assert not bool(truth.voxels[2, :, :, 0].any())  # and lies in the right half of the other


def test_an_object_that_reaches_far_out_of_its_region_teaches_no_mesh() -> None:
    shapes = balls((0.0, 0.0, 2.0))
    truth = shape_targets(shapes, torch.tensor([[30.0, 22, 32, 24]]), torch.tensor([0]), LENS, side=4, points=50)
    assert not bool(truth.is_near.any())
    assert float(truth.points.abs().max()) == 0.0


def test_heads_learn_from_the_first_step_on() -> None:
    made, features = heads(), maps()
    for feature in features:
        feature.requires_grad_()
    batch = photos(balls((0.0, 0.0, 2.0), (-0.5, -0.3, 3.0)), BOXES)
    said = made.learn(features, regions(2), batch)
    assert said["voxels"].logits.shape == said["voxels"].targets.shape == (2, 8, 8, 8)
    assert len(said["meshes"].stages) == 2
    assert bool(said["meshes"].is_valid.all())
    loss = depth_extent(said["depths"]) + stage_losses(said["meshes"]) + said["voxels"].logits.square().sum()
    loss.backward()
    assert bool(loss.isfinite())
    learned = {name for name, weight in made.named_parameters() if weight.grad is not None}
    assert learned == {name for name, _ in made.named_parameters()}
    for feature in features:
        assert feature.grad is not None
        assert bool(feature.grad.isfinite().all())


def test_no_region_teaches_nothing_and_every_weight_knows() -> None:
    made = heads()
    said = made.learn(maps(), regions(0), photos(None, torch.zeros(0, 4)))
    assert not bool(said["meshes"].is_valid.any())
    loss = depth_extent(said["depths"]) + stage_losses(said["meshes"]) + said["voxels"].logits.sum()
    assert loss.item() == 0
    loss.backward()
    for name, weight in made.named_parameters():
        assert weight.grad is not None, name
        assert not bool(weight.grad.any()), name


def test_few_regions_are_drawn_from_many() -> None:
    said = heads(most_regions=1).learn(maps(), regions(2), photos(balls((0.0, 0.0, 2.0), (-0.5, -0.3, 3.0)), BOXES))
    assert len(said["depths"].values) == len(said["voxels"].logits) == len(said["meshes"].stages[0]) == 1


def test_objects_without_shapes_are_refused() -> None:
    with pytest.raises(UserError, match="'a' and those beside it have objects without shapes"):
        heads().learn(maps(), regions(2), photos(None, BOXES))


def test_found_objects_are_rebuilt_even_where_no_voxel_is() -> None:
    made = heads().eval()
    torch.nn.init.constant_(made.voxels.last.bias, -20.0)
    labels = torch.tensor([1, 0])
    found = Detections(torch.tensor([0, 1]), BOXES, labels, torch.ones(2))
    with torch.no_grad():
        rebuilt = made.describe(maps(), found)
        none = made.describe(maps(), Detections(labels[:0], BOXES[:0], labels[:0], torch.ones(0)))
    assert rebuilt.meshes is not None
    assert rebuilt.depth_extents is not None
    assert rebuilt.voxels is not None
    assert float(rebuilt.voxels.max()) < 1e-6
    assert rebuilt.meshes.num_faces_per_mesh().tolist() == [192, 192]  # 4 x 4 x 4 voxels
    torch.testing.assert_close(rebuilt.meshes.verts_packed().abs().amax(), torch.tensor(0.5))
    assert none.meshes is not None
    assert len(none.meshes) == 0


def test_voxels_alone_are_a_mesh_too() -> None:
    made, features = heads(), maps()
    made.meshes = None
    said = made.learn(features, regions(2), photos(balls((0.0, 0.0, 2.0), (-0.5, -0.3, 3.0)), BOXES))
    assert set(said) == {"depths", "voxels"}
    zeros = torch.zeros(2, dtype=torch.long)
    found = made.describe(features, Detections(zeros, BOXES, zeros, torch.ones(2)))
    assert found.meshes is not None
    assert found.meshes.num_verts_per_mesh().tolist() == [9**3 - 7**3] * 2  # an untrained head fills every voxel


def test_what_heads_learn_is_where_the_object_is() -> None:
    """Depth extent, voxels and mesh of a ball, learned and taken back to its camera."""
    made, features = heads(), maps()
    shapes = balls((0.0, 0.0, 2.0))
    box = torch.tensor([[19.5, 11.5, 44.5, 36.5]])  # as wide as the ball is seen
    zero = torch.zeros(1, dtype=torch.long)
    batch = photos(shapes, box)
    optimizer = torch.optim.Adam(made.parameters(), 0.01)
    for _ in range(50):
        said = made.learn(features, ObjectRegions(zero, box, zero + 1, zero), batch)
        cells = shape_losses.voxel_cross_entropy(said["voxels"])
        loss = depth_extent(said["depths"]) + 3 * cells + stage_losses(said["meshes"])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with torch.no_grad():
        found = made.describe(features, Detections(zero, box, zero + 1, torch.ones(1)))
    rebuilt = rebuilt_in_camera(found, LENS, torch.tensor([2.0])).verts_packed()
    radii = (rebuilt - torch.tensor([0.0, 0.0, 2.0])).norm(dim=1)
    assert found.depth_extents is not None
    assert found.depth_extents.item() == pytest.approx(0.8 / 2 * 60 / 25, rel=0.02)
    assert radii.mean().item() == pytest.approx(0.4, rel=0.08)
    assert radii.std().item() < 0.055  # of a cube: 0.08


def test_heads_stay_on_the_device_of_their_maps(far: Any) -> None:  # noqa: F811
    made, features = heads(), [each.to(far) for each in maps()]
    for module in made.modules():
        for name, weight in module._parameters.items():
            if weight is not None:
                module._parameters[name] = torch.nn.Parameter(weight.detach().to(far))
    batch = photos(balls((0.0, 0.0, 2.0), (-0.5, -0.3, 3.0)), BOXES).to(far)
    for count in (0, 2):
        said = made.learn(features, regions(count).to(far), batch)
        assert all(isinstance(each, Far) for each in (said["depths"].targets, said["voxels"].targets))
        assert isinstance(stage_losses(said["meshes"]), Far)
        zeros = torch.zeros(count, dtype=torch.long)
        found = made.describe(features, Detections(zeros, BOXES[:count], zeros, torch.ones(count)).to(far))
        assert isinstance(rebuilt_in_camera(found, LENS.to(far), torch.ones(count).to(far)).verts_packed(), Far)


def test_the_depth_loss_is_a_mean() -> None:
    errors = DepthVerdicts(torch.tensor([0.5, 3.0]), torch.tensor([0.0, 0.0]))
    assert depth_extent(errors).item() == pytest.approx((0.125 + 2.5) / 2)
