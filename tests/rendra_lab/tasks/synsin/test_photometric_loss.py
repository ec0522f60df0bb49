"""The loss that reads depth from a second picture: least at the truth, and where it must not look."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.photometric_loss import PhotometricLoss

SIZE, FOCAL, DEPTH = 64, 64.0, 4.0


def wall(shift_px: float) -> Tensor:
    """A painted wall, seen after a step to the left that moves it by so many pixels to the right."""
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    x = x - shift_px
    waves = [torch.sin(x / 5 + y / 9), torch.sin(x / 7 - y / 4), torch.cos(x / 11) * torch.sin(y / 6)]
    return (0.5 + 0.4 * torch.stack(waves))[None]


def geometry(step_m: float) -> dict[str, Tensor]:
    intrinsics = torch.tensor([[[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]]])
    moved = torch.eye(4)[None].clone()
    moved[:, 0, 3] = step_m
    return {"intrinsics": intrinsics, "target_intrinsics": intrinsics, "input_to_target": moved}


def at(depth: float, loss: PhotometricLoss, step_m: float = 0.25) -> float:
    pair = {"target": wall(step_m * FOCAL / DEPTH), "input": wall(0), **geometry(step_m)}
    return float(loss(torch.full((1, 1, SIZE, SIZE), depth), **pair))


@pytest.mark.parametrize("levels", [(0,), (1, 2), (0, 1, 2, 3)])
def test_the_true_depth_costs_least(levels: tuple[int, ...]) -> None:
    loss = PhotometricLoss(levels)
    errors = {depth: at(depth, loss) for depth in (2.0, 3.0, 3.6, DEPTH, 4.4, 6.0, 12.0)}
    assert min(errors, key=errors.__getitem__) == DEPTH
    assert errors[3.0] > errors[3.6]
    assert errors[6.0] > errors[4.4]


def test_depth_is_learned_from_the_pair_alone() -> None:
    loss = PhotometricLoss()
    pair = {"target": wall(4.0), "input": wall(0), **geometry(0.25)}
    nearness = torch.full((1, 1, SIZE, SIZE), 1 / 9.0, requires_grad=True)
    optimizer = torch.optim.Adam([nearness], lr=0.01)
    for _ in range(60):
        optimizer.zero_grad()
        loss(1 / nearness, **pair).backward()
        optimizer.step()
    inner = 1 / nearness.detach()[..., 8:-8, 8:-8]
    assert abs(float(inner.median()) - DEPTH) < 0.2


def test_what_leaves_the_view_does_not_count() -> None:
    loss = PhotometricLoss((0,), smoothness=0.0)
    pair = {"target": wall(0), "input": wall(0), **geometry(1e4)}
    depth = torch.full((1, 1, SIZE, SIZE), 4.0, requires_grad=True)
    value = loss(depth, **pair)
    value.backward()
    assert float(value.detach()) == 0
    assert depth.grad is not None
    assert not bool(depth.grad.any())


def test_rough_depth_costs_where_the_picture_is_smooth() -> None:
    loss = PhotometricLoss((0,), smoothness=1.0)
    grey = torch.full((1, 3, SIZE, SIZE), 0.5)
    pair = {"target": grey, "input": grey, **geometry(0.1)}
    steps = 4.0 + (torch.arange(SIZE) // 8 % 2).float().expand(1, 1, SIZE, SIZE)
    assert float(loss(torch.full_like(steps, 4.0), **pair)) < 1e-6 < 1e-3 < float(loss(steps, **pair))


@pytest.mark.parametrize("settings", [{"levels": ()}, {"levels": (-1,)}, {"alpha": 1.5}, {"smoothness": -1.0}])
def test_settings_that_cannot_be_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(UserError):
        PhotometricLoss(**settings)  # type: ignore[arg-type]
