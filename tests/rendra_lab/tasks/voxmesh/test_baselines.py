"""Mean shapes: of equal objects they are the object, of different ones what most of them fill."""

import pytest
import torch
from box_pictures import box_pictures

from rendra_lab.mesh_scores import true_meshes
from rendra_lab.tasks.voxmesh.baselines import MeanShapes

WIDE, HIGH = (0.3, 0.2, 0.2), (0.15, 0.3, 0.3)


def test_the_mean_of_one_shape_placed_by_the_truth_is_the_shape() -> None:
    batch = box_pictures([WIDE, HIGH])
    mean = MeanShapes([batch]).posed(batch)
    torch.testing.assert_close(mean.get_bounding_boxes(), true_meshes(batch.shapes).get_bounding_boxes())


def test_the_mean_view_is_where_cameras_saw_the_class() -> None:
    batch = box_pictures([WIDE, HIGH])
    mean, truth = MeanShapes([batch], side=64).unposed(batch), true_meshes(batch.shapes)
    found, expected = mean.get_bounding_boxes(), truth.get_bounding_boxes()
    torch.testing.assert_close(found, expected, atol=0.15, rtol=0)


def test_a_mean_is_as_large_as_the_class_on_average() -> None:
    batch = box_pictures([WIDE] * 3)
    batch.shapes.voxels[0] = False
    batch.shapes.voxels[0, 3:5, 3:5, 3:5] = True  # 8 voxels among 64 and 64
    mean = MeanShapes([batch]).posed(batch)[0]
    lows, highs = mean.verts_packed().aminmax(dim=0)
    lengths = highs - lows
    torch.testing.assert_close(lengths, 2 * torch.tensor(WIDE))  # 45 of those 64 that two of three fill: no ties cut


def test_batches_add_up_and_unknown_classes_have_the_mean_of_all() -> None:
    first, second = box_pictures([WIDE]), box_pictures([WIDE, WIDE])
    both, one = MeanShapes([first, second]), MeanShapes([box_pictures([WIDE] * 3)])
    asked = box_pictures([HIGH])
    torch.testing.assert_close(both.posed(asked).verts_packed(), one.posed(asked).verts_packed())
    torch.testing.assert_close(both.unposed(asked).verts_packed(), one.unposed(asked).verts_packed())


def test_nothing_to_average_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one object"):
        MeanShapes([])
