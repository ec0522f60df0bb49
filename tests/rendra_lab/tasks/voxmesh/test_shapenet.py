"""ShapeNet's folders: cameras as Blender had them, cells where surfaces are, complaints that name file and line."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from pix3d_files import is_in_step, picture
from shapenet_files import CELLS, SHIFT, SIDE, shapenet_folder

from rendra_lab.errors import UserError
from rendra_lab.tasks.voxmesh.shapenet import DEPTH_RANGE, ShapeNet, model_to_camera, read_cameras


def made(folder: Path, **how: Any) -> ShapeNet:
    data = ShapeNet(folder, **{"image_px": SIDE, "points": 100, "voxels": CELLS, "batch_size": 2, **how})
    data.setup("fit")
    return data


def blenders_pose(azimuth_deg: float, elevation_deg: float, distance: float) -> np.ndarray:
    """By Blender's steps: a file with y up is imported, a camera is turned about its rig, and looks along its -z."""
    imported = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # y becomes z, z becomes -y
    ca, sa = np.cos(np.radians(-azimuth_deg)), np.sin(np.radians(-azimuth_deg))
    ce, se = np.cos(np.radians(-elevation_deg)), np.sin(np.radians(-elevation_deg))
    rig = np.array([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]]) @ np.array([[ce, 0, se], [0, 1, 0], [-se, 0, ce]])
    camera_axes = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])  # at +x of the rig, its x, y, z
    pose = np.eye(4)
    flip = np.diag([1, -1, -1])  # to OpenCV's axes
    pose[:3, :3] = flip @ camera_axes.T @ rig.T @ imported
    pose[:3, 3] = -flip @ camera_axes.T @ [distance, 0, 0]
    return pose


@pytest.mark.parametrize("camera", [(0.0, 0.0, 1.0), (336.5, 25.9, 1.1), (123.0, -40.0, 2.0), (-20.0, 89.0, 0.5)])
def test_cameras_stand_where_blender_had_them(camera: tuple[float, float, float]) -> None:
    pose = model_to_camera(*camera)
    np.testing.assert_allclose(pose, blenders_pose(*camera), atol=1e-12)
    np.testing.assert_allclose(pose @ [0, 0, 0, 1], [0, 0, camera[2], 1], atol=1e-12)
    assert (pose @ [0, 1, 0, 0])[1] < 0  # up is up
    np.testing.assert_allclose(np.linalg.det(pose[:3, :3]), 1)


def test_what_a_picture_comes_with(tmp_path: Path) -> None:
    batch = made(shapenet_folder(tmp_path)).splits.test[1]
    assert batch.shape_ids == ["03001627/ee"]
    torch.testing.assert_close(batch.rgb[0], torch.from_numpy(picture(41, (SIDE, SIDE))).permute(2, 0, 1) / 255)
    lens = 2.1875 * SIDE / 2
    torch.testing.assert_close(
        batch.intrinsics[0], torch.tensor([[lens, 0, SIDE / 2], [0, lens, SIDE / 2], [0, 0, 1]])
    )
    pose = model_to_camera(20.25, -3.5, 1.75 * 0.9)

    def own(points: np.ndarray) -> np.ndarray:
        return (points - pose[:3, 3]) @ pose[:3, :3] + SHIFT

    ticks = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    cube = np.stack([x, y, z, np.ones_like(x)], -1) @ batch.shapes.voxels_to_camera[0].double().numpy().T
    np.testing.assert_array_equal(batch.shapes.voxels[0].numpy(), is_in_step(own(cube[..., :3])))
    points = batch.shapes.points[0].double().numpy()
    assert is_in_step(own(points - 1e-3 * batch.shapes.normals[0].double().numpy())).all()
    assert bool((batch.depth_range[0, 0] < batch.shapes.points[..., 2]).all())
    assert bool((batch.depth_range[0, 1] > batch.shapes.points[..., 2]).all())
    np.testing.assert_allclose(batch.depth_range[0], DEPTH_RANGE)
    np.testing.assert_allclose([1.002002 - 0.2002002 / z for z in DEPTH_RANGE], [0.67, 0.92], atol=1e-6)


def test_what_stands_behind_alpha(tmp_path: Path) -> None:
    shapenet_folder(tmp_path)
    assert bool((made(tmp_path, background="white").splits.test[0].rgb == 1).all())
    assert bool((made(tmp_path, background="black").splits.test[0].rgb == 0).all())
    assert made(tmp_path, image_px=9).splits.test[0].rgb.shape == (1, 3, 9, 9)


def test_the_division_and_its_classes(tmp_path: Path) -> None:
    data = made(shapenet_folder(tmp_path))
    assert data.classes == ("plane", "chair")
    ids = [f"{one.shape_id}/{one.view}" for one in data.splits.train.renderings]
    assert sorted(ids) == [
        "02691156/cc/0", "02691156/cc/1", "02691156/cc/2", "03001627/aa/0", "03001627/aa/2", "03001627/bb/1",
    ]  # fmt: skip
    assert [len(data.splits.val), len(data.splits.test)] == [3, 4]
    chairs = made(tmp_path, categories=["chair"], val_pictures=2, test_pictures=3)
    assert chairs.classes == ("chair",)
    assert len(chairs.splits.train) == 3
    assert [one.view for one in chairs.splits.val.renderings] == [0, 1]
    assert [one.shape_id[-2:] for one in chairs.splits.test.renderings] == ["ee", "ee", "ee"]
    (tmp_path / "pix2mesh_splits_val05.json").rename(tmp_path / "ShapeNetRendering" / "pix2mesh_splits_val05.json")
    assert len(made(tmp_path).splits.train) == 6


def test_batches_and_workers(tmp_path: Path) -> None:
    data = made(shapenet_folder(tmp_path))
    assert data.is_divisible
    batches = list(data.train_dataloader())
    assert [len(batch.rgb) for batch in batches] == [2, 2, 2]
    test = pickle.loads(pickle.dumps(data.splits.test))
    assert torch.equal(test[0].shapes.points, data.splits.test[0].shapes.points)
    assert not torch.equal(data.splits.train[0].shapes.points, data.splits.train[0].shapes.points)


def test_without_cells_meshes_fill_them(tmp_path: Path) -> None:
    shapenet_folder(tmp_path)
    read, filled = (made(tmp_path, **how).splits.test[0].shapes for how in ({}, {"binvox": None}))
    torch.testing.assert_close(read.voxels_to_camera, filled.voxels_to_camera)
    assert bool(filled.voxels[read.voxels].all())


def _binvox(data: bytes) -> Callable[[Path], Any]:
    return lambda folder: (folder / "ShapeNetCore.v1.binvox" / "03001627" / "ee" / "model.binvox").write_bytes(data)


def _cameras(text: str) -> Callable[[Path], Any]:
    name = "rendering_metadata.txt"
    return lambda folder: (folder / "ShapeNetRendering" / "03001627" / "ee" / "rendering" / name).write_text(text)


def _wide(folder: Path) -> None:
    path = folder / "ShapeNetRendering" / "03001627" / "ee" / "rendering" / "00.png"
    Image.fromarray(picture(0, (8, 9))).save(path)


_HEADER = b"#binvox 1\ndim 2 2 2\ntranslate 0 0 0\nscale 1\ndata\n"


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_binvox(b"#binvox 2\n"), "model.binvox is no binvox file"),
        (_binvox(b"#binvox 1\ndim 2 2 2\n" + b"\n" * 10_000), "model.binvox is no binvox file"),
        (_binvox(_HEADER.replace(b"2 2 2", b"2 3 2") + b"\1\x0c"), "has 2 x 3 x 2 cells; expected a cube"),
        (_binvox(_HEADER.replace(b"2 2 2", b"9999 9999 9999")), "has 9999 x 9999 x 9999 cells; expected a cube"),
        (_binvox(_HEADER.replace(b"scale 1", b"scale 0") + b"\1\x08"), "scale 0; expected a cube of some size"),
        (_binvox(_HEADER + b"\1\x07"), "its runs are not of 2 x 2 x 2 values"),
        (_binvox(_HEADER + b"\1\x07\0"), "its runs are not of 2 x 2 x 2 values"),
        (_binvox(_HEADER + b"\2\x08"), "its runs are not of 2 x 2 x 2 values"),
        (_binvox(_HEADER + b"\0\x08"), "none of its 8 cells is filled"),
        (
            _binvox(_HEADER.replace(b"0 0 0", b"5 0 0") + b"\1\x08"),
            r"its filled cells miss the surface of .*model.obj",
        ),
        (_cameras("1 2 3 4\n"), r"rendering_metadata.txt, line 1 is '1 2 3 4'; expected azimuth"),
        (_cameras("1 2 3 4 x\n"), "line 1 is '1 2 3 4 x'"),
        (_cameras("1 2 0 nan 5\n"), "line 1 is '1 2 0 nan 5'"),
        (_cameras("1 90 0 1 25\n"), "line 1: elevation is 90 and distance 1; expected a camera that sees"),
        (_cameras("1 2 0 0 25\n"), "line 1: elevation is 2 and distance 0"),
        (_cameras("\n"), "rendering_metadata.txt is empty"),
        (_wide, "00.png is 9 x 8 pixels large; expected a square"),
    ],
)
def test_broken_files_are_named(damage: Callable[[Path], Any], said: str, tmp_path: Path) -> None:
    damage(shapenet_folder(tmp_path))
    data = made(tmp_path)
    with pytest.raises(UserError, match=said):
        _ = data.splits.test[0]


@pytest.mark.parametrize(
    ("part", "said"),
    [
        (None, "pix2mesh_splits_val05.json: 'test' is missing; expected an object of synsets"),
        ([], r"'test' is \[\]; expected an object of synsets"),
        ({"0300162": ["a"]}, "'test': '0300162' is none of 02691156"),
        ({"03001627": 3}, "'test', 03001627: expected an object of models"),
        ({"03001627": {"../aa": [0]}}, "'../aa' is no name of a model"),
        ({"03001627": {"ee": [-1]}}, r"03001627, ee: its pictures are \[-1\]; expected numbers from 0"),
        ({"03001627": {"ee": []}}, r"03001627, ee: its pictures are \[\]"),
        ({"03001627": ["gg"]}, r"there is no file .*03001627/gg/model.obj, but the division has 03001627/gg"),
    ],
)
def test_broken_divisions_are_named(part: Any, said: str, tmp_path: Path) -> None:
    file = shapenet_folder(tmp_path) / "pix2mesh_splits_val05.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "test": part}))
    with pytest.raises(UserError, match=said):
        made(tmp_path)


def test_pictures_that_no_camera_took_are_named(tmp_path: Path) -> None:
    file = shapenet_folder(tmp_path) / "pix2mesh_splits_val05.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), "test": {"03001627": {"ee": [7]}}}))
    with pytest.raises(UserError, match=r"rendering_metadata.txt has 3 lines, but the division has picture 7"):
        _ = made(tmp_path).splits.test[0]


def test_settings_and_folders_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"there is no pix2mesh_splits_val05.json in"):
        made(tmp_path)
    with pytest.raises(UserError, match=r"data.categories are of plane, bench, .*; got \['horse'\]"):
        ShapeNet(tmp_path, categories=["horse"])
    with pytest.raises(UserError, match=r"data.categories are of"):
        ShapeNet(tmp_path, categories=[])
    with pytest.raises(UserError, match=r"there is no file"):
        read_cameras(tmp_path / "none.txt")
