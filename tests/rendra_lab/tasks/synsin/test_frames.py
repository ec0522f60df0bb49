"""Pictures are brought to one size without aliases, and every pixel still looks where its intrinsics say."""

import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from rendra_lab.data.posed_images import undistorted
from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.frames import Film, Frame, PictureReader

PINHOLE = np.array([90.0, 80.0, 52.0, 33.0])
SIZE = (60, 110)  # height, width
REACH = 1.2  # the largest slope that a picture below can tell


def slopes(pinhole: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W, 2): how far to the right and down each pixel's ray goes on its way of 1 forwards."""
    rows, columns = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5, indexing="ij")
    return (np.stack([columns, rows], -1) - pinhole[2:]) / pinhole[:2]


def painted(slope: np.ndarray) -> np.ndarray:
    """A picture whose red and green tell where a pixel looks."""
    levels = ((slope / REACH + 1) * 127.5).round().astype(np.uint8)
    return np.concatenate([levels, np.zeros_like(levels[..., :1])], -1)


def told(rgb: torch.Tensor) -> np.ndarray:
    return (rgb[0, :2].permute(1, 2, 0).double().numpy() * 2 - 1) * REACH


def frame_of(path: Path, picture: np.ndarray, pinhole: np.ndarray = PINHOLE, **how: object) -> Frame:
    Image.fromarray(picture).save(path)
    return Frame(path, f"{path.name}, line 1", pinhole, np.eye(4), **how)


def rays_of(intrinsics: torch.Tensor, size: tuple[int, int]) -> np.ndarray:
    K = intrinsics[0].double().numpy()
    return slopes(np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), size)


@pytest.mark.parametrize("size", [(60, 110), (32, 32), (17, 40), (64, 20), (90, 150)])
@pytest.mark.parametrize("fit", ["squeeze", "crop"])
def test_every_pixel_looks_where_its_intrinsics_say(tmp_path: Path, size: tuple[int, int], fit: str) -> None:
    frame = frame_of(tmp_path / "a.png", painted(slopes(PINHOLE, SIZE)))
    pair = PictureReader(size, fit).pair(frame, frame)
    inner = (slice(2, -2), slice(2, -2))  # at its border a mean covers less
    np.testing.assert_allclose(told(pair.input)[inner], rays_of(pair.intrinsics, size)[inner], atol=REACH / 120)
    torch.testing.assert_close(pair.input_to_target, torch.eye(4)[None])


def test_crop_keeps_the_shape_of_pixels_and_squeeze_the_whole_picture(tmp_path: Path) -> None:
    frame = frame_of(tmp_path / "a.png", painted(slopes(PINHOLE, SIZE)))
    cropped = PictureReader((30, 30), "crop").pair(frame, frame).intrinsics[0]
    torch.testing.assert_close(cropped, torch.tensor([[45.0, 0, 13.5], [0, 40.0, 16.5], [0, 0, 1]]))
    squeezed = PictureReader((30, 30), "squeeze").pair(frame, frame).intrinsics[0]
    torch.testing.assert_close(squeezed[0], torch.tensor([90.0 * 30 / 110, 0, 52.0 * 30 / 110]))
    torch.testing.assert_close(squeezed[1], torch.tensor([0, 40.0, 16.5]))


def test_intrinsics_in_parts_of_the_sides(tmp_path: Path) -> None:
    picture = painted(slopes(PINHOLE, SIZE))
    parts = PINHOLE / [110, 60, 110, 60]
    reader = PictureReader((32, 48))
    first, second = frame_of(tmp_path / "a.png", picture), frame_of(tmp_path / "b.png", picture, parts, in_parts=True)
    pair = reader.pair(first, second)
    torch.testing.assert_close(pair.intrinsics, pair.target_intrinsics)


@pytest.mark.parametrize("fisheye", [False, True])
def test_lenses_are_straightened(tmp_path: Path, fisheye: bool) -> None:
    lens = np.array([-0.15, 0.02, 0.004, -0.003, 0, 0, 0, 0]) if not fisheye else np.array([0.05, 0.01] + [0.0] * 6)
    bent = torch.from_numpy(slopes(PINHOLE, SIZE)).reshape(-1, 2)
    many = torch.from_numpy(lens).expand(len(bent), -1)
    straight = undistorted(bent, many, torch.full((len(bent),), fisheye)).reshape(*SIZE, 2).numpy()
    frame = frame_of(tmp_path / "a.png", painted(straight.clip(-REACH, REACH)), distortion=lens, fisheye=fisheye)
    pair = PictureReader((40, 50)).pair(frame, frame)
    inner = (slice(6, -6), slice(8, -8))
    rays = rays_of(pair.intrinsics, (40, 50))
    np.testing.assert_allclose(told(pair.input)[inner], rays[inner], atol=REACH / 80)
    bare = PictureReader((40, 50)).pair(*[frame_of(tmp_path / "a.png", painted(straight.clip(-REACH, REACH)))] * 2)
    assert np.abs(told(bare.input)[inner] - rays[inner]).max() > REACH / 60


def test_nothing_is_aliased(tmp_path: Path) -> None:
    board = np.indices((64, 64)).sum(0) % 2 * 255
    frame = frame_of(tmp_path / "a.png", np.repeat(board[..., None], 3, -1).astype(np.uint8))
    rgb = PictureReader((16, 16)).pair(frame, frame).input
    assert (rgb - 0.5).abs().max() < 0.02


def test_a_picture_of_the_right_size_is_taken_as_it_is(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (12, 20, 3), np.uint8)
    frame = frame_of(tmp_path / "a.png", picture)
    pair = PictureReader((12, 20)).pair(frame, frame)
    torch.testing.assert_close(pair.target[0], torch.from_numpy(picture).permute(2, 0, 1) / 255, rtol=0, atol=0)
    assert pair.truth is None


def test_transparent_pictures_lie_over_white(tmp_path: Path) -> None:
    picture = np.zeros((8, 8, 4), np.uint8)
    picture[:4] = [200, 0, 0, 255]
    frame = frame_of(tmp_path / "a.png", picture)
    rgb = PictureReader((8, 8)).pair(frame, frame).input[0]
    torch.testing.assert_close(rgb[:, 0, 0], torch.tensor([200 / 255, 0, 0]))
    torch.testing.assert_close(rgb[:, 7, 7], torch.ones(3))


def test_motion_is_measured_in_metres(tmp_path: Path) -> None:
    there = np.eye(4)
    there[:3, 3] = [1, 2, 3]
    first = frame_of(tmp_path / "a.png", np.zeros((8, 8, 3), np.uint8))
    second = Frame(first.path, "", PINHOLE, there)
    moved = PictureReader((8, 8), scale=0.5).pair(first, second).input_to_target[0]
    torch.testing.assert_close(moved[:3, 3], torch.tensor([0.5, 1, 1.5]))
    back = PictureReader((8, 8)).pair(second, first).input_to_target[0]
    torch.testing.assert_close(back[:3, 3], -torch.tensor([1.0, 2, 3]))


def test_what_was_read_last_is_kept_and_not_sent_to_workers(tmp_path: Path) -> None:
    frames = [frame_of(tmp_path / f"{i}.png", np.full((8, 8, 3), i, np.uint8)) for i in range(3)]
    reader = PictureReader((8, 8), kept=2)
    reader.pair(frames[0], frames[1])
    for frame in frames[:2]:
        frame.path.unlink()
    assert float(reader.pair(frames[1], frames[0]).target.max()) == 0
    reader.pair(frames[0], frames[2])
    with pytest.raises(UserError, match=r"1\.png, line 1: there is no file"):
        reader.pair(frames[2], frames[1])
    assert not pickle.loads(pickle.dumps(reader))._shelf


def test_turns_and_moves_of_a_film() -> None:
    angle = np.radians(30)
    turned = np.eye(4)
    turned[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    moved = turned.copy()
    moved[:3, 3] = turned[:3, :3] @ [0, -3, -4]
    film = Film([Path("a")] * 3, [""] * 3, np.ones((3, 4)), np.stack([np.eye(4), turned, moved]))
    others = np.array([0, 1, 2])
    np.testing.assert_allclose(film.turns_deg(0, others), [0, 30, 30], atol=1e-6)
    np.testing.assert_allclose(film.moves(1, others), [0, 0, 5], atol=1e-12)


@pytest.mark.parametrize("pinhole", [[0.0, 1, 1, 1], [1, -1, 1, 1], [1, 1, np.nan, 1], [1e10, 1, 1, 1]])
def test_absurd_cameras_are_refused(tmp_path: Path, pinhole: list[float]) -> None:
    frame = frame_of(tmp_path / "a.png", np.zeros((8, 8, 3), np.uint8), np.array(pinhole, float))
    with pytest.raises(UserError, match=r"a\.png, line 1: fx fy cx cy are .*; expected finite numbers, fx and fy"):
        PictureReader((8, 8)).pair(frame, frame)


def test_pictures_that_cannot_be_read_are_named(tmp_path: Path) -> None:
    frame = frame_of(tmp_path / "a.png", np.random.default_rng(0).integers(0, 256, (32, 32, 3), np.uint8))
    frame.path.write_bytes(frame.path.read_bytes()[:999])
    with pytest.raises(UserError, match=r"a\.png, line 1: .*a\.png is not a picture that can be read"):
        PictureReader((8, 8)).pair(frame, frame)
    with pytest.raises(UserError, match=r"data\.fit must be one of squeeze, crop, got 'stretch'"):
        PictureReader((8, 8), "stretch")
