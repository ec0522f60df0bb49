"""Alike or not: distances of pictures, and what is said of them."""

from __future__ import annotations

import pytest
import torch

from rendra_lab.tasks.giraffe.mode_collapse import ModeCollapseWatcher, coarse, distances


def test_distances_of_copies_of_kinds_and_of_different_pictures() -> None:
    torch.manual_seed(0)
    different = coarse(torch.rand(32, 3, 32, 32))
    assert different.shape == (32, 3 * 16 * 16)
    pairs, nearest = distances(different)
    assert 0 < nearest < pairs
    assert max(distances(different[:1].expand(32, -1))) < 1e-4 * pairs
    two_kinds = different[:2].repeat(16, 1)
    assert distances(two_kinds)[0] == pytest.approx(pairs, rel=0.2)
    assert distances(two_kinds)[1] < 1e-3 * nearest


def test_noise_does_not_hide_that_pictures_are_alike() -> None:
    torch.manual_seed(0)
    real = torch.rand(16, 3, 4, 4).repeat_interleave(16, 2).repeat_interleave(16, 3)
    copies = real[:1] + 0.1 * torch.randn(16, 3, 64, 64)
    assert distances(coarse(copies))[0] < 0.2 * distances(coarse(real))[0]


def test_a_collapse_is_said_once_and_its_end_too(capsys: pytest.CaptureFixture[str]) -> None:
    watcher = ModeCollapseWatcher(from_step=100, share=0.25)
    watcher._judge(50, 0.1, 0.1)
    assert capsys.readouterr().out == ""
    watcher._judge(200, 0.9, 0.05)
    said = capsys.readouterr().out
    assert "step 200: mode collapse: two samples differ 0.90 times" in said
    assert "0.05 times" in said
    assert "adversary_loss.r1.weight" in said
    watcher._judge(300, 0.1, 0.05)
    watcher._judge(400, 0.9, 0.3)  # hardly better
    assert capsys.readouterr().out == ""
    again = ModeCollapseWatcher(from_step=100, share=0.25)
    again.load_state_dict(watcher.state_dict())
    again._judge(500, 0.9, 0.5)
    assert "step 500: the mode collapse of step 200 is over" in capsys.readouterr().out
