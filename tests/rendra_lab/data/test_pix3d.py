"""Pix3D's folders: objects where their outlines are, divisions that hold, and complaints that name file and field."""

import json
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
import torch
from PIL import Image
from pix3d_files import FOCAL_MM, SIZE, box_of, divide, is_in_step, picture, pix3d_folder, pose, seen_from

from rendra_lab.data.pix3d import Pix3D
from rendra_lab.detection.records import PhotoBatch
from rendra_lab.errors import UserError


def made(folder: Path, **how: Any) -> Pix3D:
    plain = {"shortest_px": None, "longest_px": None, "points": 200, "voxels": 20, "batch_size": 1, "flip": False}
    data = Pix3D(folder, **{**plain, **how})
    data.setup("fit")
    return data


def divided(folder: Path, count: int = 3, **how: Any) -> Path:
    pix3d_folder(folder, count, **how)
    divide(folder, {"train": list(range(1, count)), "test": [0]})
    return folder


def projected(batch: PhotoBatch, points: torch.Tensor) -> torch.Tensor:
    """Pixels (P, 2) of points in the camera's axes."""
    image = points @ batch.intrinsics[0].T
    return image[:, :2] / image[:, 2:]


@pytest.mark.parametrize("form", ["authors", "Mesh R-CNN"])
def test_what_the_files_say_is_what_is_shown(form: str, tmp_path: Path) -> None:
    pix3d_folder(tmp_path)
    if form == "authors":
        (data := Pix3D(tmp_path, shortest_px=None, longest_px=None, points=10, voxels=20)).setup("fit")
        photos = data.splits.train
        index = [photo.view.name for photo in photos.photos].index("img/chair/0001.png")
    else:
        divide(tmp_path, {"train": [0], "test": [1, 2]})
        photos, index = made(tmp_path).splits.test, 0
    batch = photos[index]
    height, width = SIZE
    focal = FOCAL_MM * width / 32
    torch.testing.assert_close(batch.rgb[0], torch.from_numpy(picture(1)).permute(2, 0, 1) / 255)
    assert batch.sizes.tolist() == [[height, width]]
    assert batch.intrinsics[0].tolist() == [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    seen = batch.instances
    assert torch.equal(seen.masks[0], torch.from_numpy(seen_from(1)))
    assert seen.boxes[0].tolist() == box_of(seen_from(1))
    assert (seen.labels.tolist(), seen.picture.tolist(), batch.picture_ids) == ([2], [0], ["img/chair/0001.png"])


@pytest.mark.parametrize("number", [0, 1, 2])
def test_the_model_stands_where_its_mask_is(number: int, tmp_path: Path) -> None:
    pix3d_folder(tmp_path)
    divide(tmp_path, {"train": [0], "test": [number]})
    batch = made(tmp_path, points=4000).splits.test[0]
    shapes, mask = batch.instances.shapes, seen_from(number)
    assert shapes is not None
    height, width = SIZE
    cell = projected(batch, shapes.points[0]).floor().long()
    hit = np.zeros((height, width), bool)
    hit[cell[:, 1], cell[:, 0]] = True
    assert (mask & ~hit).sum() <= 2  # pixels that no point falls in
    wide = np.pad(mask, 1)
    near = [wide[1 + y : 1 + y + height, 1 + x : 1 + x + width] for y in (-1, 0, 1) for x in (-1, 0, 1)]
    grown = np.any(near, axis=0)
    assert not (hit & ~grown).any()  # an edge passes through pixels whose middles it misses


def test_surface_and_cells_are_the_model_placed(tmp_path: Path) -> None:
    batch = made(divided(tmp_path)).splits.test[0]
    shapes = batch.instances.shapes
    assert shapes is not None
    R, t = pose(0)
    flip = np.diag([-1.0, -1, 1])

    def own(points: np.ndarray) -> np.ndarray:
        return (points @ flip - t) @ R

    ticks = (np.arange(20) + 0.5) / 10 - 1
    z, y, x = np.meshgrid(ticks, ticks, ticks, indexing="ij")
    cube = np.stack([x, y, z, np.ones_like(x)], -1) @ shapes.voxels_to_camera[0].double().numpy().T
    np.testing.assert_array_equal(shapes.voxels[0].numpy(), is_in_step(own(cube[..., :3])))
    points, normals = shapes.points[0].double().numpy(), shapes.normals[0].double().numpy()
    inner, outer = is_in_step(own(points - 1e-3 * normals)), is_in_step(own(points + 1e-3 * normals))
    assert inner.all()
    assert (~outer).mean() > 0.9  # but for where one box stands on the other
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    assert len(shapes.faces[0]) == 24  # quads became pairs
    faces = own(shapes.verts[0].double().numpy())
    np.testing.assert_allclose([faces.min(0), faces.max(0)], [[0, 0, 0], [1, 0.9, 0.5]], atol=1e-5)


def test_grids_with_empty_borders_lie_where_the_model_is(tmp_path: Path) -> None:
    divided(tmp_path)
    plain = made(tmp_path, voxels=20).splits.test[0].instances.shapes
    path = tmp_path / "model" / "chair" / "step0" / "voxel.mat"
    grid = scipy.io.loadmat(path)["voxel"]
    scipy.io.savemat(path, {"voxel": np.pad(grid, ((2, 4), (5, 1), (3, 3))).astype(bool)}, do_compression=True)
    moved = made(tmp_path, voxels=26).splits.test[0].instances.shapes
    assert plain is not None
    assert moved is not None
    for shapes in (plain, moved):
        assert int(shapes.voxels.sum()) == int(grid.sum())
    middles = [filled_middles(shapes.voxels[0], shapes.voxels_to_camera[0]) for shapes in (plain, moved)]
    torch.testing.assert_close(*middles, atol=1e-5, rtol=0)


def filled_middles(voxels: torch.Tensor, to_camera: torch.Tensor) -> torch.Tensor:
    place = (voxels.nonzero().flip(1) + 0.5) * (2 / len(voxels)) - 1
    return place @ to_camera[:3, :3].T + to_camera[:3, 3]


def test_where_the_grid_lies_may_be_said(tmp_path: Path) -> None:
    divided(tmp_path)
    file = tmp_path / "pix3d_s1_test.json"
    tree = json.loads(file.read_text())
    tree["annotations"][0]["voxel_cube"] = [0.5, 0.46, 0.25, 1.0]
    file.write_text(json.dumps(tree))
    said = made(tmp_path).splits.test[0].instances.shapes
    R, t = pose(0)
    assert said is not None
    expected = np.diag([-1.0, -1, 1]) @ (R @ [0.5, 0.46, 0.25] + t)
    np.testing.assert_allclose(said.voxels_to_camera[0, :3, 3], expected, atol=1e-6)
    tree["annotations"][0]["voxel_cube"] = [3.5, 0.46, 0.25, 1.0]
    file.write_text(json.dumps(tree))
    with pytest.raises(UserError, match=r"voxel.mat: its filled cells miss the surface of .*model.obj by 3"):
        _ = made(tmp_path).splits.test[0]


def test_without_a_file_of_cells_the_mesh_fills_them(tmp_path: Path) -> None:
    divided(tmp_path)
    file = tmp_path / "pix3d_s1_test.json"
    read = made(tmp_path).splits.test[0].instances.shapes
    tree = json.loads(file.read_text())
    del tree["annotations"][0]["voxel"]
    file.write_text(json.dumps(tree))
    filled = made(tmp_path).splits.test[0].instances.shapes
    assert read is not None
    assert filled is not None
    torch.testing.assert_close(filled.voxels_to_camera, read.voxels_to_camera)
    assert bool(filled.voxels[read.voxels].all())
    assert filled.voxels.sum() < 1.6 * read.voxels.sum()  # with the cells that the surface passes through


def test_objects_of_one_picture_come_together(tmp_path: Path) -> None:
    pix3d_folder(tmp_path)
    entries = json.loads((tmp_path / "pix3d.json").read_text())
    entries[1] |= {key: entries[0][key] for key in ("img",)}
    (tmp_path / "pix3d.json").write_text(json.dumps(entries))
    photos = [photo for part in made(tmp_path).lists().values() for photo in part]
    assert sorted(len(photo.objects) for photo in photos) == [1, 2]
    divide(tmp_path, {"train": [2], "test": [0, 1]})
    tree = json.loads((tmp_path / "pix3d_s1_test.json").read_text())
    tree["annotations"][1]["image_id"] = tree["annotations"][0]["image_id"]
    (tmp_path / "pix3d_s1_test.json").write_text(json.dumps(tree))
    batch = made(tmp_path).splits.test[0]
    assert batch.instances.boxes.tolist() == [box_of(seen_from(0)), box_of(seen_from(1))]
    assert batch.instances.shapes is not None
    assert len(batch.instances.shapes.points) == 2


def test_pictures_are_brought_to_a_size_with_all_that_belongs_to_them(tmp_path: Path) -> None:
    divided(tmp_path)
    large, small = (
        made(tmp_path, shortest_px=side, longest_px=wide).splits.test[0] for side, wide in ((48, None), (12, 14))
    )
    whole = made(tmp_path).splits.test[0]
    assert (large.rgb.shape, small.rgb.shape) == ((1, 3, 48, 64), (1, 3, 10, 14))
    torch.testing.assert_close(large.instances.boxes, 2 * whole.instances.boxes)
    torch.testing.assert_close(large.intrinsics[0, :2], 2 * whole.intrinsics[0, :2])
    across, down = 14 / 32, 10 / 24
    factors = torch.tensor([[across], [down]])
    torch.testing.assert_close(small.intrinsics[0, :2], whole.intrinsics[0, :2] * factors)
    assert abs(float(small.instances.masks.float().mean() - whole.instances.masks.float().mean())) < 0.03


def test_the_two_wrong_masks_are_left_out(tmp_path: Path) -> None:
    pix3d_folder(tmp_path, 3, "table")
    entries = json.loads((tmp_path / "pix3d.json").read_text())
    for name, number in (("img/table/0045.png", 0), ("img/table/1749.jpg", 1)):
        Image.fromarray(picture(number)).save(tmp_path / name)
        entries[number]["img"] = name
    (tmp_path / "pix3d.json").write_text(json.dumps(entries))
    names = [photo.view.name for part in made(tmp_path).lists().values() for photo in part]
    assert names == ["img/table/0002.png"]


def test_divisions_hold_whatever_the_order(tmp_path: Path) -> None:
    pix3d_folder(tmp_path, 24, models=8)
    for split in ("s1", "s2"):
        parts = made(tmp_path, split=split).lists()
        names = {part: {photo.view.name for photo in photos} for part, photos in parts.items()}
        assert sum(map(len, names.values())) == 24
        assert all(names.values())
        if split == "s2":
            models = [{each.model_name for photo in photos for each in photo.objects} for photos in parts.values()]
            assert len(set.union(*models)) == sum(map(len, models))
        entries = json.loads((tmp_path / "pix3d.json").read_text())
        (tmp_path / "pix3d.json").write_text(json.dumps(entries[::-1]))
        again = made(tmp_path, split=split).lists()
        assert {part: {photo.view.name for photo in photos} for part, photos in again.items()} == names


def test_a_division_may_have_a_part_for_validation(tmp_path: Path) -> None:
    pix3d_folder(tmp_path, 4)
    divide(tmp_path, {"train": [0], "val": [1, 2], "test": [3]})
    data = made(tmp_path)
    assert [len(part) for part in (data.splits.train, data.splits.val, data.splits.test)] == [1, 2, 1]


def test_points_are_drawn_anew_in_training_alone(tmp_path: Path) -> None:
    data = made(divided(tmp_path))

    def points(photos: Any) -> torch.Tensor:
        return photos[0].instances.shapes.points

    torch.manual_seed(0)
    assert torch.equal(points(data.splits.test), points(data.splits.test))
    one = points(data.splits.train)
    assert not torch.equal(one, points(data.splits.train))
    torch.manual_seed(0)
    assert torch.equal(one, points(data.splits.train))


def test_models_are_kept_in_a_folder(tmp_path: Path) -> None:
    divided(tmp_path / "set")
    cache = tmp_path / "cache"
    first = made(tmp_path / "set", cache=cache).splits.test[0].instances.shapes
    kept = list((cache / "models").iterdir())
    assert len(kept) == 1
    written = kept[0].stat().st_mtime_ns
    second = made(tmp_path / "set", cache=cache).splits.test[0].instances.shapes
    assert kept[0].stat().st_mtime_ns == written
    for name in ("points", "normals", "voxels", "voxels_to_camera"):
        assert torch.equal(getattr(first, name), getattr(second, name))
    made(tmp_path / "set", cache=cache, voxels=10).splits.test[0]
    assert len(list((cache / "models").iterdir())) == 2


def test_batches_and_workers(tmp_path: Path) -> None:
    pix3d_folder(tmp_path, 5)
    divide(tmp_path, {"train": [0, 1, 2, 3], "val": [4], "test": [4]})
    data = made(tmp_path, batch_size=2, flip=True, eval_batch_size=3)
    assert data.is_divisible
    assert data.classes[2] == "chair"
    batches = list(data.train_dataloader())
    assert [len(batch.rgb) for batch in batches] == [2, 2]
    assert batches[0].instances.picture.tolist() == [0, 1]
    again = pickle.loads(pickle.dumps(data.splits.test))[0]
    assert torch.equal(again.rgb, data.splits.test[0].rgb)


# (what is done to pix3d.json's first entry, what is said)
_BROKEN_FIELDS: list[tuple[dict[str, Any], str]] = [
    ({"category": "horse"}, r"pix3d.json, entry 0: 'category' is 'horse'; expected one of bed, bookcase"),
    ({"category": None}, "entry 0: 'category' is missing"),
    ({"img": "../outside.png"}, r"entry 0, 'img': .*outside.png'; expected a file within"),
    ({"mask": "mask/chair/9999.png"}, r"entry 0, 'mask': there is no file .*mask/chair/9999.png"),
    ({"model": "model/none.obj"}, r"entry 0, 'model': there is no file .*none.obj"),
    ({"voxel": "model/none.mat"}, r"entry 0, 'voxel': there is no file .*none.mat"),
    ({"img_size": [32]}, r"entry 0: 'img_size' is \[32\]; expected a list of width and height"),
    ({"img_size": [32, -1]}, r"entry 0, 'img_size': 'height' is -1; expected"),
    ({"bbox": [1, 2, 3]}, r"entry 0: 'bbox' is \[1, 2, 3\]; expected a list of 4"),
    ({"bbox": [9, 2, 3, 8]}, r"entry 0: the box \[9, 2, 3, 8\] holds nothing of a picture 32 px wide"),
    ({"bbox": [40, 2, 60, 8]}, "holds nothing"),
    ({"rot_mat": [[1, 0, 0], [0, 1, 0]]}, r"entry 0: 'rot_mat' is .*; expected a matrix of 3 x 3"),
    ({"rot_mat": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}, r"entry 0, 'rot_mat': the pose is no rotation"),
    ({"rot_mat": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}, r"entry 0, 'rot_mat': the pose mirrors"),
    ({"rot_mat": [[1, 0, 0], [0, 1, 0], [0, 0, "x"]]}, r"'rot_mat': 'row' is \[0, 0, 'x'\]"),
    ({"trans_mat": [0, 0, -1]}, r"entry 0: 'trans_mat' is \[0, 0, -1\]; expected a place before the camera"),
    ({"trans_mat": [0, 0, float("nan")]}, r"entry 0: 'trans_mat' is \[0, 0, nan\]"),
    ({"focal_length": 0}, "entry 0: 'focal_length' is 0; expected a number above zero"),
    ({"K": [20.0, 16.0]}, r"entry 0: 'K' is \[20.0, 16.0\]"),
    ({"K": [-20.0, 16.0, 12.0]}, r"entry 0: 'K' is .*; expected the focal length"),
    ({"voxel_cube": [0, 0, 0, -1]}, r"entry 0: 'voxel_cube' is \[0, 0, 0, -1\]"),
]


@pytest.mark.parametrize(("change", "said"), _BROKEN_FIELDS)
def test_broken_fields_are_named(change: dict[str, Any], said: str, tmp_path: Path) -> None:
    pix3d_folder(tmp_path, 1)
    (tmp_path / "outside.png").write_bytes(b"")
    entries = json.loads((tmp_path / "pix3d.json").read_text())
    (tmp_path / "pix3d.json").write_text(json.dumps([{**entries[0], **change}]))
    with pytest.raises(UserError, match=said):
        made(tmp_path)


def _damaged_mask(folder: Path) -> None:
    path = folder / "mask" / "chair" / "0000.png"
    path.write_bytes(path.read_bytes()[:60])


def _of_another_size(folder: Path) -> None:
    Image.fromarray(np.full((24, 30), 255, np.uint8)).save(folder / "mask" / "chair" / "0000.png")


def _dark(folder: Path) -> None:
    Image.fromarray(np.zeros(SIZE, np.uint8)).save(folder / "mask" / "chair" / "0000.png")


def _model(text: str) -> Callable[[Path], None]:
    return lambda folder: (folder / "model" / "chair" / "step0" / "model.obj").write_text(text) and None


def _voxels(**variables: Any) -> Callable[[Path], None]:
    return lambda folder: scipy.io.savemat(folder / "model" / "chair" / "step0" / "voxel.mat", variables)


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (_damaged_mask, r"entry 0: .*mask/chair/0000.png is not a picture that can be read"),
        (_of_another_size, r"entry 0: .*mask/chair/0000.png is 30 x 24 pixels large, its camera 32 x 24"),
        (_dark, r"entry 0: the mask .*mask/chair/0000.png is dark all over"),
        (_model("v 0 0 0\nv 1 0 0\nv 0 1 0\n"), r"model.obj: the mesh has 3 vertices and no faces"),
        (_model("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), r"model.obj: its 1 faces have no area"),
        (_model("v 0 0 0\nf 1 2 9\n"), r"model.obj.*is no model that can be read: .*line 2"),
        (_model("v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n"), r"model.obj.*is no model that can be read"),
        (_voxels(other=np.zeros(3)), r"voxel.mat: 'voxel' is missing; it holds 'other'"),
        (_voxels(voxel=np.ones((3, 4, 3))), r"voxel.mat: 'voxel' has the shape \(3, 4, 3\)"),
        (_voxels(voxel=np.full((3, 3, 3), 7)), "voxel.mat: 'voxel' holds 7; expected"),
        (_voxels(voxel=np.zeros((3, 3, 3))), "voxel.mat: none of its 27 cells is filled"),
        (_voxels(voxel="text"), "voxel.mat: 'voxel' is a char; expected"),
    ],
)
def test_broken_files_are_named(damage: Callable[[Path], None], said: str, tmp_path: Path) -> None:
    pix3d_folder(tmp_path, 1)
    damage(tmp_path)
    data = made(tmp_path)
    shown = [
        photo for part in (data.splits.train, data.splits.val, data.splits.test) for photo in [part] if len(part)
    ]
    with pytest.raises(UserError, match=said):
        _ = shown[0][0]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[", "pix3d.json is no JSON"),
        ("{}", "pix3d.json holds no list of objects"),
        ("[]", "pix3d.json holds no list of objects"),
        ("[3]", "pix3d.json holds no list of objects"),
        ("[" * 100_000, "pix3d.json is nested too deeply"),
    ],
)
def test_broken_lists_are_named(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "pix3d.json").write_text(text)
    with pytest.raises(UserError, match=said):
        made(tmp_path)


def test_broken_divisions_are_named(tmp_path: Path) -> None:
    divided(tmp_path)
    file = tmp_path / "pix3d_s1_test.json"
    whole = json.loads(file.read_text())
    for key, number, field, value, said in (
        ("annotations", 0, "image_id", 99, r"pix3d_s1_test.json, annotation 0: 'image_id' is 99; expected the id of"),
        ("annotations", 0, "category_id", 99, "annotation 0: 'category_id' is 99"),
        ("annotations", 0, "segmentation", "mask/none.png", "annotation 0, 'segmentation': there is no file"),
        ("images", 0, "id", "x", "image 0: 'id' is 'x'; expected a whole number"),
        ("images", 0, "width", 0, "image 0: 'width' is 0"),
        ("categories", 0, "name", "horse", "category 0: 'name' is 'horse'"),
    ):
        tree = json.loads(json.dumps(whole))
        tree[key][number][field] = value
        file.write_text(json.dumps(tree))
        with pytest.raises(UserError, match=said):
            made(tmp_path)


def test_settings_and_folders_that_cannot_be(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=re.escape(f"there is no folder {tmp_path / 'none'}")):
        made(tmp_path / "none")
    with pytest.raises(UserError, match=r"has neither pix3d.json nor pix3d_s1_train.json"):
        made(tmp_path)
    with pytest.raises(UserError, match=r"data.split is s1 or s2; got 's3'"):
        Pix3D(tmp_path, "s3")  # type: ignore[arg-type]
    with pytest.raises(UserError, match=r"data.voxels=300 along a side"):
        Pix3D(tmp_path, voxels=300)
    with pytest.raises(UserError, match=r"data.shortest_px must be"):
        Pix3D(tmp_path, shortest_px=0)
