"""Folders of posed images, read here by the formats' public definitions alone."""

import functools
import json
import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from rendra.renderer import AmbientLights, TexturesVertex
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.data import scene_folders
from rendra_lab.data.ray_views import Scene
from rendra_lab.data.rendered_scenes import RenderedScene
from rendra_lab.data.scene_folders import write_scene
from rendra_lab.errors import UserError

FORMATS = ("nerf_blender", "transforms", "colmap", "llff")
PLACE = np.array([0.5, 0.35, -0.4])  # of a black ball, the only thing there is
LENS = (-0.25, 0.06, 0.004, -0.003)


def black_ball(radius: float = 0.08) -> Meshes:
    sphere = ico_sphere(2)
    verts = sphere.verts_packed() * radius + torch.tensor(PLACE).float()
    return Meshes([verts], [sphere.faces_packed()], TexturesVertex([torch.zeros_like(verts)]))


@functools.cache
def made(**settings: Any) -> Scene:
    usual: dict[str, Any] = {"image_size": [40, 48], "counts": (5, 1, 2), "antialias": 6}
    return RenderedScene(black_ball(), AmbientLights(), **(usual | settings)).load()


def shown_at(path: Path) -> np.ndarray:
    """The middle of the ball in an image, in pixels from the upper left corner."""
    with Image.open(path) as image:
        pixels = np.asarray(image, np.float64)
    weight = pixels[..., 3] if pixels.shape[2] == 4 else 255 - pixels[..., 0]
    y, x = np.mgrid[: weight.shape[0], : weight.shape[1]] + 0.5
    return np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()


def mode_and_size(path: Path) -> tuple[str, tuple[int, int]]:
    with Image.open(path) as image:
        return image.mode, image.size


def through_opengl(
    pose: list[list[float]], point: np.ndarray, focal: float, centre: tuple[float, float]
) -> np.ndarray:
    x, y, z, _ = np.linalg.inv(np.array(pose)) @ [*point, 1.0]
    return np.array([centre[0] + focal * x / -z, centre[1] - focal * y / -z])


def z_up(point: np.ndarray) -> np.ndarray:
    return np.array([point[0], -point[2], point[1]])


def test_nerf_blender_folders_say_where_things_are(tmp_path: Path) -> None:
    folder = write_scene(made(), tmp_path / "scene", "nerf_blender")
    for split, count in (("train", 5), ("val", 1), ("test", 2)):
        record = json.loads((folder / f"transforms_{split}.json").read_text())
        assert len(record["frames"]) == count
        focal = 0.5 * 48 / math.tan(0.5 * record["camera_angle_x"])
        for frame in record["frames"]:
            path = folder / f"{frame['file_path']}.png"
            assert mode_and_size(path) == ("RGBA", (48, 40))
            expected = through_opengl(frame["transform_matrix"], z_up(PLACE), focal, (24, 20))
            np.testing.assert_allclose(shown_at(path), expected, atol=0.1)


def test_transforms_folders_say_where_things_are(tmp_path: Path) -> None:
    folder = write_scene(made(), tmp_path / "scene", "transforms")
    record = json.loads((folder / "transforms.json").read_text())
    assert record["camera_model"] == "OPENCV"
    assert (record["w"], record["h"]) == (48, 40)
    assert [len(record[f"{split}_filenames"]) for split in ("train", "val", "test")] == [5, 1, 2]
    listed = [name for split in ("train", "val", "test") for name in record[f"{split}_filenames"]]
    assert listed == [frame["file_path"] for frame in record["frames"]]
    for frame in record["frames"]:
        centre = (record["cx"], record["cy"])
        expected = through_opengl(frame["transform_matrix"], z_up(PLACE), record["fl_x"], centre)
        np.testing.assert_allclose(shown_at(folder / frame["file_path"]), expected, atol=0.1)


@pytest.mark.parametrize("distortion", [None, LENS])
def test_colmap_models_say_where_things_are(tmp_path: Path, distortion: tuple[float, ...] | None) -> None:
    folder = write_scene(made(distortion=distortion), tmp_path / "scene", "colmap")
    cameras, images, points = read_text_model(folder / "sparse" / "0")
    assert cameras == [(1, "OPENCV" if distortion else "PINHOLE", 48, 40, cameras[0][4])]
    assert len(images) == 8
    for image in images:
        x, y, z = rotation(image["qvec"]) @ PLACE + image["tvec"]
        expected = lens_of(cameras[0][4], x / z, y / z)
        np.testing.assert_allclose(shown_at(folder / "images" / image["name"]), expected, atol=0.1)
        for xy, point in zip(image["xy"], image["points"], strict=True):
            x, y, z = rotation(image["qvec"]) @ points[point]["xyz"] + image["tvec"]
            np.testing.assert_allclose(xy, lens_of(cameras[0][4], x / z, y / z), atol=1e-3)
    for number, point in points.items():
        assert len(point["track"]) >= 2
        assert abs(np.linalg.norm(point["xyz"] - PLACE) - 0.08) < 0.01
        assert all(images[image - 1]["points"][place] == number for image, place in point["track"])


def test_points_of_a_model_are_seen_by_no_camera_behind_them(tmp_path: Path) -> None:
    folder = write_scene(made(), tmp_path / "scene", "colmap")
    _, images, points = read_text_model(folder / "sparse" / "0")
    for image in images:
        centre = -rotation(image["qvec"]).T @ image["tvec"]
        outwards = [points[number]["xyz"] - PLACE for number in image["points"]]
        assert all(outward @ (centre - PLACE) > -0.05 for outward in outwards)


@pytest.mark.parametrize("distortion", [None, LENS, (*LENS, 0.01)])
def test_binary_models_say_what_text_models_say(tmp_path: Path, distortion: tuple[float, ...] | None) -> None:
    folder = write_scene(made(distortion=distortion), tmp_path / "scene", "colmap") / "sparse" / "0"
    as_text, as_binary = read_text_model(folder), read_binary_model(folder)
    assert as_text[0] == as_binary[0]
    assert repr(as_text[1]) == repr(as_binary[1])
    assert repr(as_text[2]) == repr(as_binary[2])
    assert as_text[2]


def test_llff_folders_say_where_things_are(tmp_path: Path) -> None:
    scene = made(views="forward", image_size=64)
    folder = write_scene(scene, tmp_path / "scene", "llff")
    table = np.load(folder / "poses_bounds.npy", allow_pickle=False)
    assert table.shape == (8, 17)
    for path, row in zip(sorted((folder / "images").iterdir()), table, strict=True):
        pose = row[:15].reshape(3, 5)
        height, width, focal = pose[:, 4]
        assert mode_and_size(path) == ("RGB", (width, height)) == ("RGB", (64, 64))
        down, right, back = pose[:, :3].T @ (PLACE - pose[:, 3])
        expected = [width / 2 + focal * right / -back, height / 2 + focal * down / -back]
        np.testing.assert_allclose(shown_at(path), expected, atol=0.1)
        assert row[15] < -back < row[16]
        assert row[16] - row[15] == pytest.approx(0.16, abs=0.01)


def test_lenses_that_differ_stand_with_their_frames(tmp_path: Path) -> None:
    scene = made()
    train = replace(scene.train, intrinsics=scene.train.intrinsics + torch.arange(5.0)[:, None] * torch.eye(4)[0])
    folder = write_scene(replace(scene, train=train), tmp_path / "scene", "transforms")
    record = json.loads((folder / "transforms.json").read_text())
    assert "fl_x" not in record
    assert "fl_y" in record
    assert [frame["fl_x"] for frame in record["frames"][:5]] == train.intrinsics[:, 0].tolist()


def test_a_principal_point_off_the_middle_is_kept_or_refused(tmp_path: Path) -> None:
    scene = made()
    scene = replace(scene, train=replace(scene.train, intrinsics=scene.train.intrinsics + torch.eye(4)[2]))
    record = json.loads((write_scene(scene, tmp_path / "kept", "transforms") / "transforms.json").read_text())
    assert record["frames"][0]["cx"] == 25
    cameras, _, _ = read_text_model(write_scene(scene, tmp_path / "too", "colmap") / "sparse" / "0")
    assert [camera[4][2] for camera in cameras] == [25, 24]
    for form in ("nerf_blender", "llff"):
        with pytest.raises(UserError, match="principal points off the middle"):
            write_scene(scene, tmp_path / "refused", form)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["kept", "too"]


@pytest.mark.parametrize("form", ["nerf_blender", "llff"])
def test_lenses_are_refused_where_the_format_has_none(tmp_path: Path, form: str) -> None:
    with pytest.raises(UserError, match=f"format={form} cannot hold lenses with distortion"):
        write_scene(made(distortion=LENS), tmp_path / "scene", form)


def test_distortion_reaches_transforms(tmp_path: Path) -> None:
    scene = made(distortion=LENS)
    record = json.loads((write_scene(scene, tmp_path / "scene", "transforms") / "transforms.json").read_text())
    assert [record[key] for key in ("k1", "k2", "p1", "p2")] == pytest.approx(LENS)
    with pytest.raises(UserError, match="k4, k5 or k6"):
        write_scene(made(distortion=(*LENS, 0, 0.1)), tmp_path / "other", "transforms")


def test_fisheye_lenses_have_their_own_model(tmp_path: Path) -> None:
    scene = made()
    parts = {name: getattr(scene, name) for name in ("train", "val", "test")}
    bent = {name: replace(part, fisheye=torch.ones(len(part), dtype=torch.bool)) for name, part in parts.items()}
    record = json.loads(
        (write_scene(replace(scene, **bent), tmp_path / "a", "transforms") / "transforms.json").read_text()
    )
    assert record["camera_model"] == "OPENCV_FISHEYE"
    assert record["k4"] == 0
    assert "p1" not in record
    cameras, _, _ = read_text_model(write_scene(replace(scene, **bent), tmp_path / "b", "colmap") / "sparse" / "0")
    assert cameras[0][1] == "OPENCV_FISHEYE"
    with pytest.raises(UserError, match="some of the lenses are fisheye"):
        write_scene(replace(scene, train=bent["train"]), tmp_path / "c", "transforms")


def test_images_without_alpha_stay_without(tmp_path: Path) -> None:
    scene = made()
    scene = replace(scene, train=replace(scene.train, has_alpha=False))
    folder = write_scene(scene, tmp_path / "scene", "nerf_blender")
    assert mode_and_size(folder / "train" / "r_0.png") == ("RGB", (48, 40))


def test_a_scene_without_truth_has_no_points(tmp_path: Path) -> None:
    scene = replace(made(), truth=None)
    folder = write_scene(scene, tmp_path / "scene", "colmap")
    assert read_binary_model(folder / "sparse" / "0")[2] == {}
    write_scene(scene, tmp_path / "llff", "llff")


@pytest.mark.parametrize("form", FORMATS)
def test_what_fails_leaves_nothing(tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    save, saved = scene_folders._save_png, []

    def fails_at_the_fourth(*arguments: Any) -> None:
        saved.append(1)
        if len(saved) == 4:
            raise OSError("no space left on device")
        save(*arguments)

    monkeypatch.setattr(scene_folders, "_save_png", fails_at_the_fourth)
    with pytest.raises(OSError, match="no space left"):
        write_scene(made(), tmp_path / "scene", form)
    assert not any(tmp_path.iterdir())


def test_a_folder_is_overwritten_only_if_that_is_asked_for(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    write_scene(made(), folder, "llff")
    with pytest.raises(UserError, match="is not empty: choose another folder, or overwrite=true"):
        write_scene(made(), folder, "colmap")
    write_scene(made(), folder, "colmap", overwrite=True)
    assert sorted(path.name for path in folder.iterdir()) == ["images", "sparse"]
    assert list(tmp_path.iterdir()) == [folder]
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(UserError, match=r"'thesis.tex', which no scene has"):
        write_scene(made(), folder, "colmap", overwrite=True)
    assert (folder / "thesis.tex").read_text() == "years of work"


def test_an_empty_folder_is_filled(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    assert (write_scene(made(), tmp_path / "scene", "transforms") / "transforms.json").is_file()


def test_what_cannot_be_is_said(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="format must be one of nerf_blender, transforms, colmap, llff, got 'obj'"):
        write_scene(made(), tmp_path / "scene", "obj")
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="is a file; a folder is written"):
        write_scene(made(), tmp_path / "file", "llff")


def test_the_program_writes_a_folder(program: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    command = ["mesh=ico_sphere", "data.image_size=16", "data.counts=[3,1,1]", "light=ambient", "output=foo"]
    code, out, err = program("scripts/generate_data.py", *command)
    assert code == 0, err
    assert "3 training, 1 validation and 1 test views" in out
    assert (tmp_path / "foo" / "transforms_train.json").is_file()
    code, _, err = program("scripts/generate_data.py", *command)
    assert code == 2
    assert "overwrite=true" in err


def rotation(qvec: np.ndarray) -> np.ndarray:
    w, x, y, z = qvec
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def lens_of(params: list[float], x: float, y: float) -> np.ndarray:
    fx, fy, cx, cy, k1, k2, p1, p2 = [*params, 0, 0, 0, 0][:8]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    bent = (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    return np.array([fx * bent[0] + cx, fy * bent[1] + cy])


def read_text_model(folder: Path) -> tuple[list[Any], list[dict[str, Any]], dict[int, dict[str, Any]]]:
    def rows(name: str) -> list[list[str]]:
        lines = (folder / name).read_text().splitlines()
        return [line.split() for line in lines if not line.startswith("#")]

    cameras = [(int(r[0]), r[1], int(r[2]), int(r[3]), [float(x) for x in r[4:]]) for r in rows("cameras.txt")]
    images, lines = [], rows("images.txt")
    for head, body in zip(lines[::2], lines[1::2], strict=True):
        xy = [[float(body[i]), float(body[i + 1])] for i in range(0, len(body), 3)]
        pose = np.array([float(x) for x in head[1:8]])
        images.append(an_image(int(head[0]), pose, int(head[8]), head[9], xy, [int(x) for x in body[2::3]]))
    points = {}
    for row in rows("points3D.txt"):
        track = [(int(row[i]), int(row[i + 1])) for i in range(8, len(row), 2)]
        points[int(row[0])] = a_point([float(x) for x in row[1:4]], [int(x) for x in row[4:7]], track)
    return cameras, images, points


def read_binary_model(folder: Path) -> tuple[list[Any], list[dict[str, Any]], dict[int, dict[str, Any]]]:
    models = {1: ("PINHOLE", 4), 4: ("OPENCV", 8), 5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12)}
    data, take = reader(folder / "cameras.bin")
    cameras = []
    for _ in range(take("<Q")[0]):
        number, model, width, height = take("<iiQQ")
        cameras.append((number, models[model][0], width, height, list(take(f"<{models[model][1]}d"))))
    assert not data[0]
    data, take = reader(folder / "images.bin")
    images = []
    for _ in range(take("<Q")[0]):
        number, *pose, camera = take("<i7di")
        name = bytearray()
        while (letter := take("<c")[0]) != b"\0":
            name += letter
        seen = [take("<ddq") for _ in range(take("<Q")[0])]
        xy, points_seen = [list(row[:2]) for row in seen], [row[2] for row in seen]
        images.append(an_image(number, np.array(pose), camera, name.decode(), xy, points_seen))
    assert not data[0]
    data, take = reader(folder / "points3D.bin")
    points = {}
    for _ in range(take("<Q")[0]):
        number, x, y, z, red, green, blue, _, length = take("<Q3d3BdQ")
        points[number] = a_point([x, y, z], [red, green, blue], [take("<ii") for _ in range(length)])
    assert not data[0]
    return cameras, images, points


def reader(path: Path) -> tuple[list[bytes], Callable[[str], tuple[Any, ...]]]:
    rest = [path.read_bytes()]

    def take(layout: str) -> tuple[Any, ...]:
        size = struct.calcsize(layout)
        values, rest[0] = struct.unpack(layout, rest[0][:size]), rest[0][size:]
        return values

    return rest, take


def an_image(number: int, pose: np.ndarray, camera: int, name: str, xy: Any, points: Any) -> dict[str, Any]:
    row = {"number": number, "qvec": pose[:4], "tvec": pose[4:], "camera": camera, "name": name}
    return row | {"xy": xy, "points": points}


def a_point(xyz: list[float], rgb: list[int], track: Any) -> dict[str, Any]:
    return {"xyz": np.array(xyz), "rgb": rgb, "track": track}
