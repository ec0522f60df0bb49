"""Pictures: what becomes of values, shapes and frames."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
import torch
from assertions import assert_close
from PIL import Image

from rendra_lab import visualization


def test_srgb_follows_the_standard_and_inverts() -> None:
    light = torch.linspace(0, 1, 101, dtype=torch.float64)
    assert_close(visualization.srgb_to_linear(visualization.linear_to_srgb(light)), light)
    assert_close(visualization.linear_to_srgb(torch.tensor([0.0, 0.002, 0.2140411, 1.0])), [0, 0.02584, 0.5, 1])
    black = torch.zeros(1, requires_grad=True)
    visualization.linear_to_srgb(black).sum().backward()
    assert_close(black.grad, [12.92])


def test_grey_alpha_and_broken_values_are_shown() -> None:
    assert visualization.to_picture(torch.full((2, 3), 0.5)).tolist() == [[[128] * 3] * 3] * 2
    clear = torch.cat([torch.zeros(1, 1, 3), torch.full((1, 1, 1), 0.25)], -1)
    assert visualization.to_picture(clear)[0, 0].tolist() == [191] * 3
    assert visualization.to_picture(torch.tensor([[[float("nan"), 0, 0]]]))[0, 0].tolist() == [255, 0, 255]
    assert visualization.to_picture(torch.tensor([[[2.0, -1.0, 0.0]]]))[0, 0].tolist() == [255, 0, 0]


@pytest.mark.parametrize("shape", [(3,), (2, 2, 2), (1, 1, 2, 2, 3)])
def test_other_shapes_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="an image is"):
        visualization.to_picture(torch.zeros(shape))


def test_a_batch_becomes_a_grid() -> None:
    assert visualization.to_picture(torch.zeros(3, 4, 5, 3)).shape == (4 * 2 + 6, 5 * 2 + 6, 3)
    with pytest.raises(ValueError, match="at least one picture"):
        visualization.tile([])


def test_rows_share_their_height_and_carry_captions() -> None:
    row = visualization.side_by_side({"wide": torch.zeros(8, 32, 3), "tall": torch.zeros(16, 4, 3)})
    assert row.shape[1] == 64 + 6 + 4
    assert row.shape[0] > 16
    assert (row[: row.shape[0] - 16, :64] < 128).any()  # ink above the picture
    with pytest.raises(ValueError, match="at least one picture"):
        visualization.captioned_row({})


def test_gifs_hold_every_frame_and_pause_at_the_end(tmp_path: Path) -> None:
    frames = [np.full((9, 7, 3), value, np.uint8) for value in (0, 100, 200)]
    path = visualization.save_animation(tmp_path / "new" / "fit.gif", frames, fps=10, hold_s=2)
    with Image.open(path) as image:
        assert image.n_frames == 3
        shades = []
        for index, value in enumerate((100, 100, 2000)):
            image.seek(index)
            assert image.info["duration"] == value
            shades.append(np.asarray(image.convert("RGB"))[0, 0, 0])
    assert np.abs(np.array(shades) - [0, 100, 200]).max() < 8


def test_gifs_play_as_fast_as_asked_and_keep_their_background(tmp_path: Path) -> None:
    frames = [np.full((32, 32, 3), 255, np.uint8) for _ in range(19)]
    rng = np.random.default_rng(0)
    for frame in frames:
        frame[10:20, 10:20] = rng.integers(0, 256, (10, 10, 3))
        frame[5:9] = rng.integers(248, 255, (4, 32, 1))
    with Image.open(visualization.save_animation(tmp_path / "film.gif", frames, fps=18, hold_s=0)) as image:
        lengths = []
        for index in range(19):
            image.seek(index)
            lengths.append(image.info["duration"])
            assert (np.asarray(image.convert("RGB"))[:5] == 255).all()
    assert sum(lengths[:18]) == 1000


def test_animations_need_frames_and_a_known_ending(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        visualization.save_animation(tmp_path / "fit.gif", [])
    with pytest.raises(ValueError, match=r"ends in .gif or .mp4"):
        visualization.save_animation(tmp_path / "fit.avi", [np.zeros((2, 2, 3), np.uint8)])


def test_videos_need_the_extra_and_say_so(tmp_path: Path) -> None:
    frames = [np.zeros((17, 33, 3), np.uint8)] * 3
    if importlib.util.find_spec("av") is None:
        with pytest.raises(ImportError, match=r"\[view\]"):
            visualization.save_animation(tmp_path / "fit.mp4", frames)
    else:
        assert visualization.save_animation(tmp_path / "fit.mp4", frames).stat().st_size > 0
