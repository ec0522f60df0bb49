"""Any posed pictures as pairs: the cameras that their readers find, near frames, and whole stretches held out."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scene_files import SIZE, blender_folder, colmap_folder, llff_folder, transforms_folder

from rendra.renderer.cameras import look_at_view_transform
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import Scene
from rendra_lab.data.scene_folders import write_scene
from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.image_pairs import ImagePairs


def made(folder: Any, **how: Any) -> ImagePairs:
    data = ImagePairs(folder, image_size=list(SIZE), **{"batch_size": 2, **how})
    data.setup("fit")
    return data


def pairs_of(data: ImagePairs, seeds: int = 30) -> set[tuple[str, str]]:
    choice = data.splits.train.choice
    drawn = [choice.draw(i, np.random.default_rng(seed)) for i in range(len(choice)) for seed in range(seeds)]
    return {(first.path.stem, second.path.stem) for first, second in drawn}


@pytest.mark.parametrize(
    "make", [blender_folder, transforms_folder, partial(colmap_folder, binary=True), llff_folder]
)
def test_every_format_is_told_by_its_files(tmp_path: Path, make: Any) -> None:
    data = made(make(tmp_path / "scene"), max_offset=2, hold_out=0.3)
    for split in (data.splits.train, data.splits.val, data.splits.test):
        pair = split[0]
        assert pair.input.shape == (1, 3, *SIZE)
        assert bool(pair.input_to_target.isfinite().all())


def scene_of(count: int, lens: tuple[float, ...] = ()) -> Scene:
    """Cameras that turn round the origin; pictures are noise."""
    R, T = look_at_view_transform(3.0, 10.0, torch.arange(count) * 9.0)
    generator = torch.Generator().manual_seed(0)
    images = [torch.randint(256, (*SIZE, 3), generator=generator, dtype=torch.uint8) for _ in range(count)]
    intrinsics = torch.tensor([9.0, 8.0, 4.2, 2.8]).expand(count, 4).contiguous()
    distortion = torch.zeros(count, 8)
    distortion[:, : len(lens)] = torch.tensor(lens)
    views = PosedImages.gather([str(i) for i in range(count)], images, intrinsics, R, T, distortion)
    none = views.select([])
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    return Scene(views, none, none, box, up=(0.0, 1.0, 0.0))


@pytest.mark.parametrize("form", ["colmap", "transforms"])
def test_points_land_where_the_cameras_say(tmp_path: Path, form: str) -> None:
    scene = scene_of(10)
    if form == "transforms":  # which has a division
        scene = Scene(scene.train.select(range(6)), scene.train.select([6, 7]), scene.train.select([8, 9]), scene.box)
    write_scene(scene, tmp_path / "scene", form)
    data = made(tmp_path / "scene", max_offset=1)
    views = scene.train
    first, second = data.splits.train.choice.draw(2, np.random.default_rng(0))
    i, j = (int(frame.path.stem.split("_")[1]) for frame in (first, second))
    torch.manual_seed(0)
    pair = data.splits.train.reader.pair(first, second)
    torch.testing.assert_close(pair.input[0], views.image(i)[..., :3].permute(2, 0, 1))
    torch.testing.assert_close(pair.target[0], views.image(j)[..., :3].permute(2, 0, 1))
    # along a ray of the input's pixel, seen by the target
    xy = torch.tensor([[2.5, 1.5], [7.0, 4.0]])
    origins, directions = views.rays(torch.full((2,), i), xy)
    world = origins + 2.5 * directions
    K = pair.intrinsics[0]
    depth = (world @ views.R[i] + views.T[i])[:, 2:]
    lifted = torch.cat([(xy - K[:2, 2]) / K[[0, 1], [0, 1]], torch.ones(2, 1)], 1) * depth
    seen = lifted @ pair.input_to_target[0, :3, :3].T + pair.input_to_target[0, :3, 3]
    expected = (world @ views.R[j] + views.T[j]) * torch.tensor([-1.0, -1.0, 1.0])
    torch.testing.assert_close(seen, expected, rtol=0, atol=1e-5)


def test_lenses_of_colmap_reach_the_frames(tmp_path: Path) -> None:
    write_scene(scene_of(8, (-0.1, 0.01, 0.002, 0.001)), tmp_path / "scene", "colmap")
    frame = made(tmp_path / "scene").splits.train.choice.films[0].frame(0)
    np.testing.assert_allclose(frame.distortion, [-0.1, 0.01, 0.002, 0.001, 0, 0, 0, 0], atol=1e-7)


def test_the_last_frames_are_held_out_where_the_format_does_not_say(tmp_path: Path) -> None:
    write_scene(scene_of(10), tmp_path / "scene", "colmap")
    data = made(tmp_path / "scene", hold_out=0.3, max_offset=2)
    seen = pairs_of(data)
    assert {name for pair in seen for name in pair} == {f"view_{i:04d}" for i in range(7)}
    assert {abs(int(a[-2:]) - int(b[-2:])) for a, b in seen} == {1, 2}
    assert {frame.path.stem for pair in data.splits.val.pairs for frame in pair} == {
        f"view_{i:04d}" for i in (7, 8, 9)
    }


def test_partners_by_their_cameras(tmp_path: Path) -> None:
    write_scene(scene_of(10), tmp_path / "scene", "colmap")
    turned = pairs_of(made(tmp_path / "scene", max_offset=None, max_turn_deg=10.0))
    assert {abs(int(a[-2:]) - int(b[-2:])) for a, b in turned} == {1}
    step = 2 * 3 * np.cos(np.radians(10)) * np.sin(np.radians(9))  # two frames on
    moved = pairs_of(made(tmp_path / "scene", max_offset=None, max_move=step * 1.01))
    assert {abs(int(a[-2:]) - int(b[-2:])) for a, b in moved} == {1, 2}
    both = pairs_of(made(tmp_path / "scene", max_offset=1, max_turn_deg=100.0, max_move=100.0))
    assert {abs(int(a[-2:]) - int(b[-2:])) for a, b in both} == {1}


def test_names_are_ordered_as_people_order_them_and_folders_do_not_mix(tmp_path: Path) -> None:
    folders = [blender_folder(tmp_path / name, {"train": 12, "val": 2, "test": 2}) for name in "ab"]
    data = made([str(folder) for folder in folders], max_offset=1)
    choice = data.splits.train.choice
    assert len(choice) == 24
    assert [frame.stem for frame in choice.films[0].paths] == [f"r_{i}" for i in range(12)]
    for index in range(24):
        first, second = choice.draw(index, np.random.default_rng(0))
        assert first.path.parent == second.path.parent


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"path": "nowhere"}, "data.path=nowhere is no folder"),
        ({"path": []}, "data.path is empty; expected a folder, or a list of them"),
        ({"format": "obj"}, "data.format must be one of auto, transforms, nerf_blender, llff, colmap, got 'obj'"),
        ({"format": "llff"}, "poses_bounds.npy"),
        (
            {"max_turn_deg": 0.001, "max_offset": None},
            "none of the 7 frames for train has a partner within data.max_turn",
        ),
        ({"hold_out": 0.1}, "has 9 photographs, and data.hold_out=0.1 keeps 1 of them from training; expected two"),
        ({"hold_out": 2.0}, "data.hold_out must be a number from 0 to 1, got 2.0"),
        ({"max_offset": 0}, "data.max_offset must be a whole number of at least 1 or null, got 0"),
        ({"max_move": -1.0}, "data.max_move must be a number of at least 0 or null, got -1.0"),
    ],
)
def test_settings_that_cannot_be(tmp_path: Path, how: dict[str, Any], message: str) -> None:
    folder = transforms_folder(tmp_path / "scene")
    with pytest.raises(UserError, match=message):
        ImagePairs(**{"path": folder, **how}).setup("fit")


def test_a_folder_without_cameras(tmp_path: Path) -> None:
    with pytest.raises(
        UserError, match=r"holds none of transforms\.json, transforms_train.json, .*: where are its cameras"
    ):
        made(tmp_path)
