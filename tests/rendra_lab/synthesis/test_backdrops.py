"""Places: what rays meet is where geometry says, noise fits on to itself, and all colours are colours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rendra_lab.synthesis.backdrops import Backdrop, draw_backdrop, linear, sights

EYE = torch.tensor([2.6, 0.0, 0.6])
FLOOR = -0.2


def rays(side: int = 24, tilt: float = 0.0) -> torch.Tensor:
    across = torch.linspace(-0.17, 0.17, side)
    z, y = torch.meshgrid(-across - 0.1 + tilt, across, indexing="ij")
    return torch.stack([-torch.ones_like(y), y, z], -1).reshape(-1, 3)


def place(seed: int = 0) -> Backdrop:
    return draw_backdrop(np.random.default_rng(seed))


def test_places_are_many_and_their_colours_are_colours() -> None:
    means = []
    for seed in range(60):
        seen = sights(place(seed), EYE, rays(), FLOOR)
        for colors in (seen.albedo, seen.glow):
            assert bool(colors.isfinite().all())
            assert 0 <= float(colors.min()) <= float(colors.max()) <= 1
        torch.testing.assert_close(seen.normal.norm(dim=1), torch.ones(len(rays())))
        assert bool(seen.on_ground.any())
        means.append(seen.albedo.mean(0))
    assert float(torch.stack(means).std(0).min()) > 0.08


def test_rays_meet_the_ground_and_the_wall() -> None:
    backdrop = replace(place(), distance=1.0, height=9.0, ragged=(0.0, 1.0), turn=0.0, seamless=0.0)
    seen = sights(backdrop, EYE, rays(), FLOOR)
    ground, wall = seen.place[seen.on_ground], seen.place[~seen.on_ground]
    assert len(ground)
    assert len(wall)
    torch.testing.assert_close(ground[:, 2], torch.full((len(ground),), FLOOR))
    assert float(ground[:, 0].min()) >= -1.0001
    torch.testing.assert_close(wall[:, 0], torch.full((len(wall),), -1.0))
    assert float(wall[:, 2].min()) >= FLOOR - 1e-5
    assert seen.normal[seen.on_ground].unique(dim=0).tolist() == [[0, 0, 1]]
    assert seen.normal[~seen.on_ground].unique(dim=0).tolist() == [[1, 0, 0]]


def test_a_sheet_of_paper_has_no_edge() -> None:
    backdrop = replace(place(), distance=1.0, height=9.0, seamless=1.0)
    assert sights(backdrop, EYE, rays(), FLOOR).normal.unique(dim=0).tolist() == [[0, 0, 1]]


def test_above_a_low_wall_is_sky_that_glows_by_itself() -> None:
    backdrop = replace(place(), height=0.0, ragged=(0.0, 1.0), clouds=0.0, sky=np.array([[0.8] * 3, [0.2, 0.4, 0.9]]))
    seen = sights(backdrop, EYE, rays(4, tilt=0.9), FLOOR)
    assert not bool(seen.on_ground.any())
    assert float(seen.albedo.max()) == 0
    torch.testing.assert_close(seen.glow, linear(backdrop.sky)[1].expand(16, 3))


def test_haze_takes_what_is_far_away() -> None:
    clear, hazy = (
        sights(replace(place(), distance=99.0, turn=0.0, haze=haze), EYE, rays(), FLOOR) for haze in (1e9, 0.5)
    )
    far = clear.on_ground & (clear.place[:, 0] < -3)
    assert bool(far.any())
    assert float((hazy.albedo[far] / clear.albedo[far]).max()) < 0.01
    assert float(hazy.glow[far].min()) > 0
    assert float(clear.glow[far].max()) < 1e-6


def test_noise_repeats_itself_after_its_period() -> None:
    backdrop = place()
    backdrop = replace(backdrop, grain_turn=0.0, height=0.0, ragged=(0.0, 1.0), haze=1e9)
    surface = replace(backdrop.ground, period=(0.5, 0.5), grain=0.0, boards=(np.inf, np.inf))
    backdrop = replace(backdrop, ground=surface)
    down = torch.tensor([-1.0, 0.1, -0.3])
    step = torch.tensor([-0.5, 0.0, 0.0]) / ((FLOOR - EYE[2]) / down[2])
    one, other, between = (sights(backdrop, EYE, (down + a * step)[None], FLOOR).albedo for a in (0, 1, 0.37))
    torch.testing.assert_close(one, other, atol=2e-3, rtol=0)
    assert float((one - between).abs().max()) > 5e-3


@pytest.mark.parametrize("axis", [0, 1])
def test_boards_have_dark_joints(axis: int) -> None:
    boards = (0.1, np.inf) if axis == 0 else (np.inf, 0.1)
    wall = replace(place().wall, contrast=0.0, grain=0.0, boards=boards, joint=0.5)
    backdrop = replace(
        place(), wall=wall, distance=1.0, height=9.0, ragged=(0.0, 1.0), turn=0.0, haze=1e9, seamless=0.0
    )
    fine = torch.linspace(0.0, 0.06, 200)
    way = torch.stack([-torch.ones(200), fine * (axis == 0), -0.05 + fine * (axis == 1)], 1)
    seen = sights(backdrop, EYE, way, FLOOR)
    bright = seen.albedo[:, 1] / seen.albedo[:, 1].max()
    assert float(bright.min()) < 0.65
    assert 0.6 < float((bright > 0.7).float().mean()) < 0.95
