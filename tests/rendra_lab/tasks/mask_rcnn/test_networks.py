"""Mask R-CNN's networks as configured: published sizes, and every part in the small one."""

from pathlib import Path
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from painted_photos import painted_photos
from torch import nn

from rendra_lab.tasks.mask_rcnn.task import MaskRCNN
from rendra_lab.terms import LossTerm

CONF = Path(__file__).parents[4] / "conf"


def sizes(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def network(size: str, *overrides: str) -> Any:
    with initialize_config_dir(str(CONF / "network" / f"{size}_of"), version_base="1.3"):
        cfg = compose("mask_rcnn", overrides=list(overrides))
    return instantiate(cfg, _convert_="all")["detector"]


def losses() -> dict[str, LossTerm]:
    names = ("anchor_objectness", "anchor_boxes", "region_classes", "region_boxes", "masks")
    with initialize_config_dir(str(CONF / "loss"), version_base="1.3"):
        return {name: instantiate(compose(name), _convert_="all")[name] for name in names}


def test_the_published_size() -> None:
    with torch.device("meta"):
        detector = network("paper", "classes=90", "detector.backbone.norm=frozen")
    # torchvision's maskrcnn_resnet50_fpn has a box of the background and a mask of it besides: 4 + 4096, 1 + 256
    assert sizes(detector) == 44_401_393 - 4_100 - 257
    assert detector.proposals.anchors.sizes_px == (32.0, 64.0, 128.0, 256.0, 512.0)
    assert detector.heads["masks"].side == 28


def test_without_a_file_the_published_network_has_group_norm() -> None:
    with torch.device("meta"):
        detector = network("paper")
    assert isinstance(detector.backbone.bn1, nn.GroupNorm)
    assert detector.box.classes == 9


def test_the_small_one_has_every_part() -> None:
    with torch.device("meta"):
        detector, published = network("small", "detector.backbone.weights=random"), network("paper")
    assert sizes(detector) == 3_857_350
    assert {type(part).__name__ for part in published.modules()} - {"_Bottleneck", "ResidualBackbone"} <= {
        type(part).__name__ for part in detector.modules()
    }


def make_task(**parts: Any) -> MaskRCNN:
    return MaskRCNN(network("small"), losses=losses(), optimizer=torch.optim.SGD, **parts)


@pytest.mark.parametrize("boxes", [[[(4, 4, 60, 60, 1)], []], [[], []]])
def test_the_objective_is_finite_from_the_first_step(boxes: list[Any]) -> None:
    task, batch = make_task(), painted_photos(boxes)
    total, terms = task.objective(task.predict(batch), batch)
    total.backward()
    assert bool(total.isfinite())
    assert set(terms) == set(losses())
    assert float(total.detach()) == pytest.approx(sum(float(value.detach()) for value in terms.values()))


def test_what_is_observed_is_detections() -> None:
    task, batch = make_task(), painted_photos([[(4, 4, 60, 60, 1)]])
    prediction = task.observe(batch)
    assert prediction.detections is not None
    assert prediction.boxes is None
    assert task.training
    assert {name: picture.shape for name, picture in task.show(batch).items()} == {
        "found": (1, 64, 96, 3), "annotated": (1, 64, 96, 3)
    }  # fmt: skip
    assert task.panels(task.predict(batch), batch) == {}
