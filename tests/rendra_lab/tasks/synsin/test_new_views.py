"""Motions as the book gives them, squares of photographs, and sequences fed back and from the first picture."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from PIL import Image
from torch import Tensor, nn

from rendra_lab.errors import UserError
from rendra_lab.losses import absolute_error
from rendra_lab.tasks.synsin.new_views import Motion, new_views, pinhole, read_square, save_views
from rendra_lab.tasks.synsin.splatting import PointSplatter
from rendra_lab.tasks.synsin.task import SynSin
from rendra_lab.terms import LossTerm

SIDE = 32


class Flat(nn.Module):
    """Everything is two metres away."""

    def forward(self, pictures: Tensor) -> Tensor:
        return torch.full_like(pictures[:, :1], 2.0)


@pytest.fixture
def task() -> SynSin:
    """Moves pixels, and paints nothing."""
    return SynSin(
        nn.Identity(), Flat(), PointSplatter("naive", radius_px=0.6), nn.Identity(),
        losses={"l1": LossTerm(absolute_error, target="target")}, optimizer=torch.optim.SGD,
    )  # fmt: skip


def test_axes_are_those_of_the_book() -> None:
    ahead = torch.tensor([0.0, 0.0, 2.0, 1.0])  # OpenCV's axes
    assert (Motion(tz=0.5).matrix() @ ahead).tolist() == [0.0, 0.0, 1.5, 1.0]  # nearer
    assert (Motion(tx=0.5, ty=0.25).matrix() @ ahead).tolist() == [0.5, -0.25, 2.0, 1.0]  # to the right and up
    turned = Motion(theta=-0.15).matrix() @ ahead  # x right, y up: R_y(-0.15) (0, 0, -2) = (2 sin 0.15, 0, ...)
    assert turned[:3].tolist() == pytest.approx([2 * math.sin(0.15), 0.0, 2 * math.cos(0.15)], abs=1e-6)
    raised = Motion(phi=-0.1).matrix() @ ahead  # R_x(-0.1) (0, 0, -2) = (0, -2 sin 0.1, ...): down
    assert raised[:3].tolist() == pytest.approx([0.0, 2 * math.sin(0.1), 2 * math.cos(0.1)], abs=1e-6)


def test_a_step_to_the_side_moves_the_picture(task: SynSin) -> None:
    picture = torch.rand(3, SIDE, SIDE)
    lens = pinhole(SIDE, 90.0)
    assert lens[0].tolist() == pytest.approx([SIDE / 2, 0, SIDE / 2])
    shift = 4 * 2.0 / (SIDE / 2)  # four pixels at two metres
    views = new_views(task, picture, lens, Motion(tx=shift), frames=3)
    for number in range(3):
        moved = 4 * (number + 1)
        for way in (views.fed_back, views.from_first):
            torch.testing.assert_close(way[number][:, :, moved:], picture[:, :, :-moved])
    assert views.depth.unique().tolist() == [2.0]


def test_squares_are_cut_from_the_middle(tmp_path: Path) -> None:
    photo = Image.new("RGB", (80, 40), (255, 0, 0))
    photo.paste((0, 255, 0), (20, 0, 60, 40))
    photo.save(tmp_path / "photo.png")
    assert read_square(tmp_path / "photo.png", 16).mean((1, 2)).tolist() == pytest.approx([0.0, 1.0, 0.0], abs=0.02)
    with pytest.raises(UserError, match=r"nothing\.png"):
        read_square(tmp_path / "nothing.png", 16)


def test_what_is_written(task: SynSin, tmp_path: Path) -> None:
    picture, lens = torch.rand(3, SIDE, SIDE), pinhole(SIDE, 60.0)
    written = save_views(new_views(task, picture, lens, Motion(tz=0.1)), tmp_path / "one")
    assert [path.name for path in written] == ["views.png", "view.png", "depth.png"]
    save_views(new_views(task, picture, lens, Motion(tz=0.1), frames=2), tmp_path / "two")
    for name in ("fed_back", "from_first"):
        assert sorted(path.name for path in (tmp_path / "two" / name).iterdir()) == ["000.png", "001.png", "002.png"]
        with Image.open(tmp_path / "two" / f"{name}.gif") as film:
            assert film.n_frames == 3  # type: ignore[attr-defined]
            assert film.info["duration"] == 1000


@pytest.mark.parametrize("frames", [0, 601])
def test_numbers_of_frames_that_cannot_be(task: SynSin, frames: int) -> None:
    with pytest.raises(UserError, match=f"frames must be from 1 to 600, got {frames}"):
        new_views(task, torch.rand(3, SIDE, SIDE), pinhole(SIDE, 60.0), Motion(), frames)


def test_motions_and_lenses_that_cannot_be() -> None:
    with pytest.raises(UserError, match="theta must be a finite number, got nan"):
        Motion(theta=math.nan)
    with pytest.raises(UserError, match="fov_deg must be between 1 and 170 degrees, got 180"):
        pinhole(SIDE, 180.0)
