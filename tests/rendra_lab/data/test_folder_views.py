"""Folders of other projects: rays against the formulas of their formats, and what is made of options."""

import json
import logging

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from scene_files import (
    FOCAL,
    SIZE,
    blender_folder,
    colmap_folder,
    llff_folder,
    pixels,
    ring,
    row,
    save,
    transforms_folder,
    write_json,
)

from rendra_lab.data.colmap import ColmapViews
from rendra_lab.data.llff import LlffViews, NdcWarp
from rendra_lab.data.nerf_blender import NerfBlenderViews
from rendra_lab.data.posed_images import distorted
from rendra_lab.data.ray_views import within_box
from rendra_lab.data.transforms import TransformsViews
from rendra_lab.errors import UserError

XY = torch.tensor([[0.5, 0.5], [7.5, 0.5], [2.25, 5.0], [4.0, 3.0]])


def rays_of(images, index):
    return images.rays(torch.full((len(XY),), index), XY)


def expected_rays(pose, focal=(FOCAL, FOCAL), centre=(SIZE[1] / 2, SIZE[0] / 2)):
    """NeRF, Sec. 4: ((i - cx) / f, -(j - cy) / f, -1), turned by the pose."""
    slope = (XY.double() - torch.tensor(centre)) / torch.tensor(focal)
    local = torch.stack([slope[:, 0], -slope[:, 1], -torch.ones(len(XY), dtype=torch.float64)], dim=1)
    directions = local @ torch.from_numpy(pose[:3, :3]).T
    origin = torch.from_numpy(pose[:3, 3]).expand(len(XY), 3)
    return origin.float(), torch.nn.functional.normalize(directions, dim=1).float()


def assert_same_rays(images, poses, **lens):
    assert len(images) == len(poses)
    for index, pose in enumerate(poses):
        for found, expected in zip(rays_of(images, index), expected_rays(pose, **lens), strict=True):
            torch.testing.assert_close(found, expected, rtol=0, atol=1e-5)


def shown(images, index):
    return (images.image(index) * 255).round().to(torch.uint8).numpy()


def test_nerf_blender_is_read_as_it_stands(tmp_path, caplog):
    with caplog.at_level(logging.INFO):
        scene = NerfBlenderViews(blender_folder(tmp_path)).load()
    poses = ring(9)
    assert_same_rays(scene.train, poses[:4])
    assert_same_rays(scene.val, poses[4:6])
    assert_same_rays(scene.test, poses[6:])
    np.testing.assert_array_equal(shown(scene.train, 3), pixels(3))
    np.testing.assert_array_equal(shown(scene.test, 0), pixels(6))
    assert scene.train.has_alpha
    assert scene.up == (0, 0, 1)
    assert scene.train.labels[1] == "r_1.png"
    assert "4 images to train on, 5 held out, 8 x 6 pixels, with alpha" in caplog.text


def test_half_of_the_size_is_the_mean_of_what_is_covered(tmp_path):
    scene = NerfBlenderViews(blender_folder(tmp_path), half_size=True).load()
    assert scene.train.sizes.tolist() == [[3, 4]] * 4
    full = torch.from_numpy(pixels(0)).double()
    blocks = full.view(3, 2, 4, 2, 4).movedim(2, 1).reshape(3, 4, 4, 4)
    alpha = blocks[..., 3].sum(2)
    colour = (blocks[..., :3] * blocks[..., 3:]).sum(2) / alpha.clamp_min(1)[..., None]
    small = torch.from_numpy(shown(scene.train, 0)).double()
    torch.testing.assert_close(small[..., 3], alpha / 4, rtol=0, atol=0.51)
    torch.testing.assert_close(small[..., :3], colour, rtol=0, atol=0.51)
    origins, directions = scene.train.rays(torch.zeros(len(XY), dtype=torch.int64), XY / 2)
    torch.testing.assert_close(directions, expected_rays(ring(9)[0])[1], rtol=0, atol=1e-5)


def test_sides_that_shrink_does_not_divide_keep_their_rays(tmp_path):
    scene = NerfBlenderViews(blender_folder(tmp_path), shrink=4).load()
    assert scene.train.sizes.tolist() == [[1, 2]] * 4
    _, directions = scene.train.rays(torch.zeros(len(XY), dtype=torch.int64), XY / 4)
    torch.testing.assert_close(directions, expected_rays(ring(9)[0])[1], rtol=0, atol=1e-5)


def test_every_other_test_view(tmp_path):
    scene = NerfBlenderViews(blender_folder(tmp_path), test_skip=2).load()
    assert (len(scene.train), len(scene.val), len(scene.test)) == (4, 1, 2)


@pytest.mark.parametrize(
    ("counts", "sizes", "said"),
    [
        ({"train": 3, "val": 2}, (3, 2, 2), "no transforms_test.json"),
        ({"train": 3, "test": 2}, (3, 2, 2), "no transforms_val.json"),
        ({"train": 10}, (8, 2, 2), "every 8th view is held out"),
    ],
)
def test_missing_divisions_are_made_up_and_said(tmp_path, caplog, counts, sizes, said):
    with caplog.at_level(logging.INFO):
        scene = NerfBlenderViews(blender_folder(tmp_path, counts)).load()
    assert (len(scene.train), len(scene.val), len(scene.test)) == sizes
    assert scene.val is scene.test  # one copy in memory
    assert said in caplog.text


def test_transforms_of_one_camera(tmp_path):
    scene = TransformsViews(transforms_folder(tmp_path, aabb_scale=4)).load()
    poses = ring(9)
    assert_same_rays(scene.train, poses[1:8], centre=(4.5, 2.5))
    assert_same_rays(scene.test, poses[[0, 8]], centre=(4.5, 2.5))
    np.testing.assert_array_equal(shown(scene.train, 0), pixels(1))


def edited(folder, change):
    path = folder / "transforms.json"
    tree = json.loads(path.read_text())
    change(tree)
    write_json(path, tree)
    return folder


def test_frames_may_have_their_own_cameras_sizes_masks_and_names(tmp_path):
    def change(tree):
        frame = tree["frames"][3]
        frame |= {"w": 10, "h": 5, "fl_x": 7.0, "fl_y": 6.0, "cx": 5.0, "cy": 2.0, "mask_path": "masks/3.png"}
        tree["frames"].reverse()
        tree["train_filenames"] = ["./images/003.png", "images/001.png"]
        tree["test_filenames"] = ["images/002.png"]
        tree["applied_transform"] = np.eye(4)[:3].tolist()

    folder = edited(transforms_folder(tmp_path), change)
    save(folder / "images" / "003.png", pixels(3, (5, 10), 3))
    mask = np.zeros((5, 10), np.uint8)
    mask[2] = 200
    save(folder / "masks" / "3.png", mask)
    scene = TransformsViews(folder).load()
    assert scene.train.labels == ("001.png", "003.png")
    assert scene.test.labels == scene.val.labels == ("002.png",)
    assert scene.train.sizes.tolist() == [[6, 8], [5, 10]]
    np.testing.assert_array_equal(shown(scene.train, 1)[..., 3], mask)
    poses = ring(9)
    assert_same_rays(scene.train.select([1]), poses[[3]], focal=(7.0, 6.0), centre=(5.0, 2.0))


@pytest.mark.parametrize(
    ("fields", "coefficients", "fisheye"),
    [
        ({"k1": -0.1, "k2": 0.02, "p1": 0.01, "p2": -0.02, "k3": 0.003}, [-0.1, 0.02, 0.01, -0.02, 0.003], False),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.02, "k3": 0.01, "k4": 0.001},
            [0.1, 0.02, 0.01, 0.001],
            True,
        ),
        ({"is_fisheye": True, "k1": 0.1}, [0.1], True),
    ],
)
def test_lenses_of_transforms(tmp_path, fields, coefficients, fisheye):
    scene = TransformsViews(transforms_folder(tmp_path, **fields)).load()
    _, directions = rays_of(scene.train, 0)
    in_view = directions @ scene.train.R[0]
    slope = -in_view[:, :2] / in_view[:, 2:]
    lens = torch.zeros(len(XY), 8)
    lens[:, : len(coefficients)] = torch.tensor(coefficients)
    back = distorted(slope, lens, torch.full((len(XY),), fisheye)) * FOCAL + torch.tensor([4.5, 2.5])
    torch.testing.assert_close(back, XY, rtol=0, atol=1e-3)


@pytest.mark.parametrize(
    ("change", "focal"),
    [
        ({"camera_angle_x": 2 * np.arctan(8 / 24)}, (12.0, 12.0)),
        ({"camera_angle_x": 2 * np.arctan(8 / 24), "camera_angle_y": 2 * np.arctan(6 / 20)}, (12.0, 10.0)),
        ({"fl_x": 5.0, "camera_model": "SIMPLE_PINHOLE", "fl_y": 9.0}, (5.0, 5.0)),
        ({"fl_y": 5.0, "camera_model": "PINHOLE"}, (5.0, 5.0)),
    ],
)
def test_focal_lengths_of_transforms(tmp_path, change, focal):
    def only(tree):
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            tree.pop(key)
        tree.update(change)

    scene = TransformsViews(edited(transforms_folder(tmp_path), only)).load()
    torch.testing.assert_close(scene.train.intrinsics[0], torch.tensor([*focal, 4.0, 3.0]))


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("model", "pinhole", "lens"),
    [
        ((0, "SIMPLE_PINHOLE", (9.0, 4.5, 2.5)), (9.0, 9.0, 4.5, 2.5), ()),
        ((1, "PINHOLE", (9.0, 10.0, 4.5, 2.5)), (9.0, 10.0, 4.5, 2.5), ()),
        ((2, "SIMPLE_RADIAL", (9.0, 4.5, 2.5, 0.1)), (9.0, 9.0, 4.5, 2.5), (0.1,)),
        ((3, "RADIAL", (9.0, 4.5, 2.5, 0.1, 0.2)), (9.0, 9.0, 4.5, 2.5), (0.1, 0.2)),
        ((4, "OPENCV", (9.0, 10.0, 4.5, 2.5, *range(4))), (9.0, 10.0, 4.5, 2.5), (0, 1, 2, 3)),
        ((5, "OPENCV_FISHEYE", (9.0, 10.0, 4.5, 2.5, 0.1, 0, 0, 0)), (9.0, 10.0, 4.5, 2.5), (0.1,)),
        ((6, "FULL_OPENCV", (9.0, 10.0, 4.5, 2.5, *range(8))), (9.0, 10.0, 4.5, 2.5), tuple(range(8))),
    ],
)
def test_colmap_models(tmp_path, binary, model, pinhole, lens):
    scene = ColmapViews(colmap_folder(tmp_path, binary, model=model), box=[[-1, -1, -1], [1, 1, 1]]).load()
    torch.testing.assert_close(scene.train.intrinsics, torch.tensor(pinhole).expand(7, 4))
    expected = torch.zeros(8)
    expected[: len(lens)] = torch.tensor(lens, dtype=torch.float32)
    torch.testing.assert_close(scene.train.distortion, expected.expand(7, 8))
    assert scene.train.fisheye.all() == (model[1] == "OPENCV_FISHEYE")


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_rays_pixels_box_and_up(tmp_path, binary):
    scene = ColmapViews(colmap_folder(tmp_path, binary)).load()
    poses = ring(9)
    assert_same_rays(scene.train, poses[1:8], focal=(FOCAL, 10.0), centre=(4.5, 2.5))
    assert_same_rays(scene.test, poses[[0, 8]], focal=(FOCAL, 10.0), centre=(4.5, 2.5))
    np.testing.assert_array_equal(shown(scene.train, 2)[..., :3], pixels(3, channels=3))
    assert not scene.train.has_alpha
    assert (scene.box[0] < -0.9).all()
    assert (scene.box[1] > 0.9).all()
    assert (scene.box.abs() < 1.4).all()
    np.testing.assert_allclose(scene.up, [0, 0, 1], atol=1e-6)
    near, far = scene.depth_range
    assert 0.5 < near < 2.5
    assert far > 5


@pytest.mark.parametrize("binary", [True, False])
def test_a_colmap_model_without_points_has_the_box_of_its_cameras(tmp_path, binary):
    folder = colmap_folder(tmp_path, binary)
    (folder / "sparse" / "0" / f"points3D.{'bin' if binary else 'txt'}").unlink()
    (folder / "sparse" / "0").rename(folder / "moved")
    (folder / "sparse").rmdir()
    (folder / "moved").rename(folder / "sparse")
    scene = ColmapViews(folder).load()
    assert scene.depth_range is None
    assert (scene.box.mean(0).abs() < 0.1).all()


def test_outliers_do_not_stretch_the_box(tmp_path):
    folder = colmap_folder(tmp_path, binary=False)
    points = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    points[:5] = 1e6
    lines = [f"{i} {x} {y} {z} 0 0 0 0\n" for i, (x, y, z) in enumerate(points.tolist())]
    (folder / "sparse" / "0" / "points3D.txt").write_text("".join(lines))
    assert (ColmapViews(folder).load().box.abs() < 1.4).all()


@pytest.mark.parametrize("reader", [ColmapViews, LlffViews])
def test_smaller_pictures_beside_the_full_ones(tmp_path, reader):
    folder = colmap_folder(tmp_path, binary=True) if reader is ColmapViews else llff_folder(tmp_path)
    small = reader(folder, shrink=2).load().train
    for path in (folder / "images").iterdir():
        save(folder / "images_2" / path.with_suffix(".png").name, np.full((3, 4, 3), 7, np.uint8))
    beside = reader(folder, shrink=2).load().train
    assert small.sizes.tolist() == beside.sizes.tolist() == [[3, 4]] * 7
    torch.testing.assert_close(small.intrinsics, beside.intrinsics)
    assert (beside.pixels[:, :3] == 7).all()
    assert not (small.pixels[:, :3] == 7).all()


def test_llff_without_moving_anything(tmp_path):
    scene = LlffViews(llff_folder(tmp_path), recentre=False, bound_factor=None).load()
    assert_same_rays(scene.train, row(9)[1:8])
    assert_same_rays(scene.test, row(9)[[0, 8]])
    assert scene.depth_range[0] == pytest.approx(1.8)
    assert scene.depth_range[1] >= 8.0


def test_llff_recentred_and_scaled(tmp_path):
    scene = LlffViews(llff_folder(tmp_path)).load()
    every = torch.cat([scene.train.positions, scene.test.positions])
    torch.testing.assert_close(every.mean(0), torch.zeros(3), rtol=0, atol=1e-6)
    axes = torch.cat([scene.train.R, scene.test.R])[:, :, 2].mean(0)
    torch.testing.assert_close(axes[:2], torch.zeros(2), rtol=0, atol=1e-6)
    assert axes[2] < -0.9
    assert scene.depth_range[0] == pytest.approx(0.9 / 0.75)
    before = torch.from_numpy(row(9)[:, :3, 3]).float()
    after = every[[7, *range(7), 8]]
    torch.testing.assert_close(torch.pdist(after), torch.pdist(before) / (0.75 * 2.0))
    _, directions = rays_of(scene.train, 0)
    _, others = rays_of(scene.train, 5)
    expected = (expected_rays(row(9)[1])[1] * expected_rays(row(9)[6])[1]).sum(1)
    torch.testing.assert_close((directions * others).sum(1), expected)


def test_llff_all_around(tmp_path):
    scene = LlffViews(llff_folder(tmp_path, ring(9)), spherify=True).load()
    every = torch.cat([scene.train.positions, scene.test.positions])
    assert every.square().sum(1).mean().sqrt() == pytest.approx(1.0, abs=1e-5)
    aside = torch.linalg.cross(every, torch.cat([scene.train.R, scene.test.R])[:, :, 2])
    assert aside.abs().max() < 1e-5  # all axes meet in the origin
    assert (every[:, 2] > 0).all()


def projected(points, slope_x, slope_y, near):
    """OpenGL's projection matrix with the far plane at infinity, and the division."""
    clip = torch.stack([points[:, 0] / slope_x, points[:, 1] / slope_y, -points[:, 2] - 2 * near], dim=1)
    return clip / -points[:, 2:]


def test_points_of_rays_lie_on_the_warped_rays():
    generator = torch.Generator().manual_seed(3)
    origins = 0.3 * torch.randn(50, 3, generator=generator, dtype=torch.float64)
    directions = torch.cat([0.4 * torch.randn(50, 2, generator=generator), -torch.ones(50, 1)], dim=1).double()
    directions = torch.nn.functional.normalize(directions, dim=1)
    warp = NdcWarp(0.7, 0.5, near=1.2)
    start, turn = warp(origins, directions)
    torch.testing.assert_close(start[:, 2], torch.full((50,), -1.0).double())
    torch.testing.assert_close(turn.norm(dim=1), torch.ones(50).double())
    before = -1.0
    for far in (3.0, 20.0, 1e5):
        there = projected(origins + far * directions, 0.7, 0.5, 1.2)
        along = ((there - start) * turn).sum(1, keepdim=True)
        torch.testing.assert_close(start + along * turn, there)
        assert (along > before).all()
        before = along
    assert ((there[:, 2] < 1) & (there[:, 2] > 0.999)).all()


def test_ndc_rays_run_from_wall_to_wall_of_their_box(tmp_path):
    data = LlffViews(llff_folder(tmp_path), ndc=True)
    data.setup("fit")
    assert data.scene.depth_range is None
    batch = data.caster.view(data.scene.test, 0)
    ends = batch.origins + batch.farthest[..., None] * batch.directions
    assert (batch.nearest < 1e-6).all()
    torch.testing.assert_close(batch.origins[..., 2], torch.full((1, *SIZE, 1), -1.0))
    torch.testing.assert_close(ends[..., 2], torch.full((1, *SIZE, 1), 1.0), rtol=0, atol=1e-4)
    inside = within_box(batch.origins.reshape(-1, 3), batch.directions.reshape(-1, 3), data.scene.box)
    assert (inside[1] > inside[0]).all()


def test_ndc_is_for_captures_from_one_side(tmp_path):
    poses = row(9)
    poses[4, :3, [0, 2]] *= -1  # looks back
    with pytest.raises(UserError, match=r"row 4: .*captures from one side"):
        LlffViews(llff_folder(tmp_path, poses), ndc=True).load()
    for options in ({"spherify": True}, {"recentre": False}, {"depth_range": [0, 1]}):
        with pytest.raises(UserError, match=r"data\.ndc"):
            LlffViews(tmp_path, ndc=True, **options)


@pytest.mark.parametrize(
    ("mode", "options"), [("L", {}), ("LA", {}), ("P", {}), ("P", {"transparency": 0}), ("1", {}), ("I;16", {})]
)
def test_pictures_of_every_depth(tmp_path, mode, options):
    folder = blender_folder(tmp_path)
    path = folder / "train" / "r_0.png"
    if mode == "I;16":
        Image.fromarray((np.arange(48, dtype=np.uint16) * 1300).reshape(SIZE)).save(path)
        expected = np.round(np.arange(48) * 1300 / 257).reshape(SIZE)
    else:
        picture = Image.fromarray(pixels(0)).convert(mode)
        picture.save(path, **options)
        with Image.open(path) as again:
            expected = np.asarray(again.convert("RGBA"))[..., 0]
    found = shown(NerfBlenderViews(folder).load().train, 0)
    np.testing.assert_array_equal(found[..., 0], expected)
    if "transparency" in options:
        assert found[..., 3].min() == 0


def test_options_of_the_box_and_the_depths(tmp_path):
    folder = blender_folder(tmp_path)
    scene = NerfBlenderViews(folder, box=[[-1, -2, -3], [1, 2, 3]], depth_range=[2, 6]).load()
    assert scene.box.tolist() == [[-1, -2, -3], [1, 2, 3]]
    assert scene.depth_range == (2.0, 6.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"box": [[0, 0, 0], [1, 1, 0]]}, r"data\.box"),
        ({"box": [1, 2, 3]}, r"data\.box"),
        ({"box": [["a", 0, 0], [1, 1, 1]]}, r"data\.box"),
        ({"depth_range": [3, 2]}, r"data\.depth_range"),
        ({"depth_range": 3}, r"data\.depth_range"),
        ({"depth_range": [0, float("inf")]}, r"data\.depth_range"),
        ({"shrink": 0}, r"data\.shrink"),
        ({"shrink": 1.5}, r"data\.shrink"),
        ({"hold_out": 1}, r"data\.hold_out"),
        ({"test_skip": 0}, r"data\.test_skip"),
        ({"background": "green"}, r"data\.background"),
    ],
)
def test_options_that_cannot_be(tmp_path, options, message):
    with pytest.raises(UserError, match=message):
        NerfBlenderViews(tmp_path, **options)


@pytest.mark.parametrize(
    ("name", "make"),
    [
        ("nerf_blender", blender_folder),
        ("transforms", transforms_folder),
        ("colmap", lambda folder: colmap_folder(folder, binary=True)),
        ("llff", llff_folder),
    ],
)
def test_configurations_say_every_option_and_build(compose, tmp_path, name, make):
    folder = make(tmp_path / "scene")
    cfg = compose(tmp_path / "nerf" / "run", "task=nerf", f"data={name}", f"data.path={folder}")
    options = OmegaConf.to_container(cfg.data, resolve=True)
    reader = {"nerf_blender": NerfBlenderViews, "transforms": TransformsViews}
    reader |= {"colmap": ColmapViews, "llff": LlffViews}
    target = options.pop("_target_")
    assert target == f"{reader[name].__module__}.{reader[name].__name__}"
    data = reader[name](**options)
    data.setup("fit")
    batch = next(iter(data.train_dataloader()))
    assert batch.rgb.shape == (4096, 3)
    assert (batch.farthest > batch.nearest).any()
