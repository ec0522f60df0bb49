"""Squares of any pictures: found wherever they lie, upright, opaque, not aliased; broken ones are named."""

import logging
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rendra_lab.data.picture_files import read_upright, upright_size
from rendra_lab.data.square_pictures import Framing, PictureReader, find_pictures
from rendra_lab.errors import UserError


def picture(path: Path, pixels: np.ndarray, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, **options)
    return path


def flat(value: int, height: int = 8, width: int = 8) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def one(path: Path, framing: Framing) -> torch.Tensor:
    pixels = PictureReader([str(path)], framing).read(0)
    assert pixels is not None
    assert pixels.dtype == torch.uint8
    return pixels


def test_pictures_are_found_below_a_folder_by_a_pattern_and_in_a_list(tmp_path: Path) -> None:
    b = picture(tmp_path / "b.PNG", flat(1))
    a = picture(tmp_path / "deep" / "er" / "a.jpg", flat(2))
    gif = picture(tmp_path / "deep" / "c.gif", flat(3)[..., 0])
    picture(tmp_path / ".hidden" / "d.png", flat(4))
    picture(tmp_path / "._e.png", flat(5))
    (tmp_path / "notes.txt").write_text("no picture")
    assert find_pictures(tmp_path) == sorted(map(str, [a, b, gif]))
    assert find_pictures(str(tmp_path / "**" / "*.jpg")) == [str(a)]
    assert find_pictures(str(tmp_path / "d*")) == sorted(map(str, [a, gif]))
    assert find_pictures([str(tmp_path / "deep"), str(b), str(b)]) == sorted(map(str, [a, b, gif]))


@pytest.mark.skipif(os.name == "nt", reason="links need rights there")
def test_links_to_folders_are_followed_once(tmp_path: Path) -> None:
    real = picture(tmp_path / "elsewhere" / "a.png", flat(1))
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "link").symlink_to(real.parent)
    (real.parent / "round").symlink_to(real.parent)
    assert find_pictures(tmp_path / "set") == [str(tmp_path / "set" / "link" / "a.png")]


def test_no_picture_at_all_names_the_folder(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(UserError, match=f"data.path={tmp_path} holds no picture: none of its 1 files ends in"):
        find_pictures(tmp_path)
    with pytest.raises(UserError, match=r"nowhere is no folder and no picture$"):
        find_pictures(tmp_path / "nowhere")
    with pytest.raises(UserError, match="none of the 1 files that match it is one"):
        find_pictures(str(tmp_path / "*.txt"))
    with pytest.raises(UserError, match=r"data\.path is empty"):
        find_pictures([])


@pytest.mark.parametrize("ending", ["png", "jpg", "webp", "tif"])
@pytest.mark.parametrize(("turn", "bright"), [(1, (0, 1)), (3, (7, 6)), (6, (1, 7)), (8, (6, 0))])
def test_pictures_stand_upright(ending: str, turn: int, bright: tuple[int, int], tmp_path: Path) -> None:
    pixels = flat(0, 64, 64)
    pixels[:8, 8:16] = 255
    exif = Image.Exif()
    exif[0x0112] = turn
    seen = one(picture(tmp_path / f"a.{ending}", pixels, exif=exif), Framing(8))
    assert divmod(int(seen.sum(0).argmax()), 8) == bright
    wide = picture(tmp_path / f"wide.{ending}", flat(9, 16, 32), exif=exif)
    assert (
        upright_size(wide, "here") == ((16, 32) if turn in (1, 3) else (32, 16)) == read_upright(wide, "").shape[:2]
    )


def test_the_square_is_cut_from_the_middle_as_wide_as_asked_for(tmp_path: Path) -> None:
    pixels = flat(10, 40, 100)
    pixels[:, 30:70] = 100
    pixels[14:26, 44:56] = 200
    path = picture(tmp_path / "a.png", pixels)
    assert set(one(path, Framing(8, crop=8)).unique().tolist()) == {200}
    whole = one(path, Framing(10))
    assert whole[0, 0].tolist() == [100] * 10
    assert one(path, Framing(10, crop=1000)).equal(whole)


def test_squares_at_random_lie_anywhere_and_follow_from_torch_s_stream(tmp_path: Path) -> None:
    ramp = np.repeat(np.arange(200, dtype=np.uint8)[None, :, None].repeat(20, 0), 3, 2)
    path = picture(tmp_path / "a.png", ramp)
    framing = Framing(4, at_random=True)
    lefts = [int(one(path, framing)[0, 0, 0]) for _ in range(30)]
    assert max(lefts) - min(lefts) > 100
    torch.manual_seed(3)
    first = one(path, framing)
    torch.manual_seed(3)
    assert one(path, framing).equal(first)
    reader = PictureReader([str(path)], framing, kept=10)
    assert len({int(reader.read(0)[0, 0, 0]) for _ in range(10)}) > 1  # type: ignore[index]


def test_stripes_too_fine_to_be_seen_become_their_mean(tmp_path: Path) -> None:
    stripes = flat(0, 128, 128)
    stripes[:, ::2] = 255
    seen = one(picture(tmp_path / "a.png", stripes), Framing(16)).float()
    assert (seen - 127.5).abs()[:, :, 1:-1].max() < 1
    assert (seen - 127.5).abs().max() < 6  # at the rim a pixel covers fewer stripes


def test_grey_pictures_palettes_alpha_and_sixteen_bits(tmp_path: Path) -> None:
    grey = picture(tmp_path / "grey.png", flat(77)[..., 0])
    assert one(grey, Framing(8)).unique().tolist() == [77]
    deep = tmp_path / "deep.png"
    Image.fromarray(np.full((8, 8), 257 * 50, np.uint16)).save(deep)
    assert one(deep, Framing(8)).unique().tolist() == [50]
    clear = np.zeros((8, 8, 4), np.uint8)
    clear[..., 3] = 51  # a fifth
    path = picture(tmp_path / "clear.png", clear)
    assert one(path, Framing(8)).unique().tolist() == [204]
    assert one(path, Framing(8, behind=0.0)).unique().tolist() == [0]
    palette = Image.fromarray(flat(0)).quantize(2)
    palette.save(tmp_path / "palette.png", transparency=palette.getpixel((0, 0)))
    assert one(tmp_path / "palette.png", Framing(8)).unique().tolist() == [255]


@pytest.mark.parametrize("ending", ["gif", "png", "webp"])
def test_of_an_animation_the_first_picture_counts(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"a.{ending}"
    lossless = {"lossless": True} if ending == "webp" else {}
    Image.fromarray(flat(255)).save(path, save_all=True, append_images=[Image.fromarray(flat(0))], **lossless)
    assert one(path, Framing(8)).unique().tolist() == [255]


def test_a_broken_picture_stops_or_is_named_and_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), np.uint8)
    path = picture(tmp_path / "broken.jpg", noise)
    path.write_bytes(path.read_bytes()[:1000])
    paths = [str(path), str(tmp_path / "gone.png"), str(picture(tmp_path / "whole.png", noise))]
    with pytest.raises(UserError, match=r"broken.jpg is not a picture that can be read.*data.on_broken=skip"):
        PictureReader(paths, Framing(8)).read(0)
    reader = PictureReader(paths, Framing(8), on_broken="skip")
    with caplog.at_level(logging.WARNING):
        assert [reader.read(i) is None for i in (0, 1, 2, 0, 1)] == [True, True, False, True, True]
    assert reader.broken == paths[:2]
    assert [line.count("broken.jpg") for line in caplog.messages] == [1, 0]
    with pytest.raises(UserError, match=r"data\.on_broken must be stop or skip, got 'ignore'"):
        PictureReader(paths, Framing(8), on_broken="ignore")  # type: ignore[arg-type]


def test_many_broken_pictures_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    reader = PictureReader([str(tmp_path / f"{i}.png") for i in range(50)], Framing(8), on_broken="skip")
    with caplog.at_level(logging.WARNING):
        assert all(reader.read(i) is None for i in range(50))
    assert len(caplog.messages) == 21
    assert len(reader.broken) == 50


def test_what_is_kept_is_read_once_and_copies_begin_with_none(tmp_path: Path) -> None:
    paths = [picture(tmp_path / f"{i}.png", flat(i)) for i in range(3)]
    reader = PictureReader(list(map(str, paths)), Framing(8), kept=2)
    before = [reader.read(i) for i in range(3)]
    copy = pickle.loads(pickle.dumps(reader))
    for path in paths:
        picture(path, flat(200))
    values = [int(reader.read(i).max()) for i in range(3)]  # type: ignore[union-attr]
    assert values == [0, 1, 200]
    assert [int(copy.read(i).max()) for i in range(3)] == [200] * 3
    assert [int(each.max()) for each in before] == [0, 1, 2]  # type: ignore[union-attr]
