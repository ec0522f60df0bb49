"""Camera paths: where the cameras stand, where they look, and what a malformed file is told."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from assertions import assert_close
from torch import Tensor

from rendra.renderer.cameras import look_at_rotation
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import RayCaster, Scene
from rendra_lab.errors import UserError
from rendra_lab.trajectories import (
    from_file,
    is_forward_facing,
    orbit,
    point_of_interest,
    rate_of,
    spiral,
    trajectory,
    upward,
)

CENTRE = torch.tensor([0.5, -1.0, 2.0])
BOX = torch.stack([CENTRE - 1, CENTRE + 1])


def views(positions: Tensor, target: Tensor, up: Tensor, size: tuple[int, int] = (12, 16)) -> PosedImages:
    R = look_at_rotation(positions, at=target.reshape(-1, 3), up=up[None])
    return PosedImages.gather(
        [f"view {index}" for index in range(len(positions))],
        [torch.zeros(*size, 3, dtype=torch.uint8)] * len(positions),
        torch.tensor([[20.0, 20.0, 8.0, 6.0]]).repeat(len(positions), 1),
        R,
        -(positions[:, None] @ R)[:, 0],
    )


def ring_scene(elevation_deg: float = 25.0, up: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> Scene:
    """Cameras on a ring of radius 3 about CENTRE, with z up."""
    angle, high = torch.arange(7) * 0.9, math.radians(elevation_deg)
    ring = torch.stack([angle.cos() * math.cos(high), angle.sin() * math.cos(high), angle * 0 + math.sin(high)], 1)
    train = views(CENTRE + 3 * ring, CENTRE, torch.tensor(up))
    return Scene(train, train.select([0]), train.select([1]), BOX)


def forward_scene(depth_range: tuple[float, float] | None = (2.0, 10.0)) -> Scene:
    """A grid of cameras that look along +x."""
    y, z = torch.meshgrid(torch.linspace(-1, 1, 5), torch.linspace(-0.5, 0.5, 5), indexing="ij")
    positions = torch.stack([0 * y, y, z], -1).reshape(-1, 3)
    ahead = torch.tensor([5.0, 0.0, 0.0])
    train = views(positions, positions + ahead, torch.tensor([0.0, 0.0, 1.0]))
    box = torch.tensor([[2.0, -3.0, -3.0], [10.0, 3.0, 3.0]])
    return Scene(train, train, train, box, depth_range)


def optical_axes(cameras: PosedImages) -> Tensor:
    return cameras.R[:, :, 2]


def test_an_orbit_goes_round_what_the_cameras_look_at() -> None:
    scene = ring_scene()
    assert_close(point_of_interest(scene), CENTRE.double(), atol=1e-4)
    assert_close(upward(scene), [0.0, 0.0, 1.0], atol=1e-5)
    path = orbit(scene, 8)
    offsets = path.positions - CENTRE
    assert_close(offsets.norm(dim=1), torch.full((8,), 3.0), atol=1e-4)
    assert_close(offsets[:, 2], torch.full((8,), 3 * math.sin(math.radians(25))), atol=1e-3)
    assert_close(optical_axes(path), -offsets / 3, atol=1e-4)
    azimuth = torch.atan2(offsets[:, 1], offsets[:, 0])
    assert_close(azimuth, torch.atan2(torch.sin(a := torch.arange(8) * math.pi / 4), a.cos()), atol=1e-3)
    assert_close(torch.linalg.det(path.R), torch.ones(8))
    assert (path.R[:, 2, 1] > 0).all()  # up is up


def test_the_orbit_of_the_synthetic_scenes_of_nerf() -> None:
    path = orbit(ring_scene(), 40, elevation_deg=30, radius=4)
    offsets = path.positions - CENTRE
    assert len(path) == 40
    assert_close(offsets[:, 2], torch.full((40,), 2.0), atol=1e-3)
    assert_close(offsets.norm(dim=1), torch.full((40,), 4.0), atol=1e-4)


def test_the_scene_knows_best_what_is_up() -> None:
    scene = replace(ring_scene(), up=(0.0, 2.0, 0.0))
    assert_close(upward(scene), [0.0, 1.0, 0.0])
    assert_close((orbit(scene, 5, elevation_deg=0).positions - CENTRE)[:, 1], torch.zeros(5), atol=1e-4)


def test_cameras_above_the_centre_still_give_an_orbit() -> None:
    scene = ring_scene(elevation_deg=90.0, up=(0.0, 1.0, 0.0))
    path = orbit(replace(scene, up=(0.0, 0.0, 1.0)), 4)
    assert bool(path.R.isfinite().all())
    assert_close(torch.linalg.det(path.R), torch.ones(4))


def test_cameras_on_one_side_know_what_is_up() -> None:
    scene = ring_scene()
    assert_close(upward(replace(scene, train=scene.train.select([0, 1, 2]))), [0.0, 0.0, 1.0], atol=1e-5)
    assert_close(upward(forward_scene()), [0.0, 0.0, 1.0], atol=1e-5)


def test_parallel_cameras_look_at_the_middle_of_the_box() -> None:
    scene = forward_scene()
    assert_close(point_of_interest(scene), scene.box.double().mean(0))


def test_a_spiral_stays_before_the_scene_and_comes_back() -> None:
    scene = forward_scene()
    path = spiral(scene, 240)
    assert_close(path.positions[:, 1].abs().max(), torch.tensor(1.0), atol=1e-3)
    assert_close(path.positions[:, 2].abs().max(), torch.tensor(0.5), atol=1e-3)
    focus = 1 / (0.25 / 2 + 0.75 / 10)
    hits = path.positions + optical_axes(path) * (focus / optical_axes(path)[:, :1])
    assert_close(hits, torch.tensor([focus, 0.0, 0.0]).expand(240, 3), atol=1e-3)
    steps = path.positions.roll(-1, 0) - path.positions
    assert steps.norm(dim=1).max() < 1.5 * steps.norm(dim=1).median() + 0.02
    boxed = spiral(forward_scene(None), 16)
    assert_close(boxed.positions, spiral(scene, 16).positions, atol=1e-4)
    assert_close(boxed.R, spiral(scene, 16).R, atol=1e-4)


def test_the_scene_chooses_its_way() -> None:
    assert is_forward_facing(forward_scene())
    assert not is_forward_facing(ring_scene())
    assert_close(trajectory("auto", forward_scene(), 6).T, spiral(forward_scene(), 6).T)
    assert_close(trajectory("auto", ring_scene(), 6).T, orbit(ring_scene(), 6).T)
    assert len(trajectory("orbit", ring_scene())) == 60


def test_the_lens_follows_the_size() -> None:
    scene = ring_scene()
    same = orbit(scene, 3)
    assert same.sizes.tolist() == [[12, 16]] * 3
    assert_close(same.intrinsics, [[20, 20, 8, 6]] * 3)
    assert orbit(scene, 1, 24).sizes.tolist() == [[24, 32]]
    assert_close(orbit(scene, 1, 24).intrinsics, [[40, 40, 16, 12]])
    assert_close(orbit(scene, 1, (24, 24)).intrinsics, [[40, 40, 12, 12]])


def test_rays_need_no_pixels() -> None:
    scene = ring_scene()
    caster = RayCaster(scene.box, None, "white", side=2)
    blank = caster.blank_view(orbit(scene, 3), 1)
    assert blank.rgb.shape == (1, 12, 16, 3)
    assert blank.nearest.shape == (1, 12, 16, 4)
    assert (blank.rgb == 1).all()
    assert (blank.mask == 0).all()
    full = caster.view(scene.train, 2)
    again = caster.blank_view(scene.train, 2)
    assert_close(again.origins, full.origins)
    assert_close(again.directions, full.directions)
    assert_close(again.farthest, full.farthest)


def opengl(R: Tensor, position: Tensor) -> list[list[float]]:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = R.double() * torch.tensor([-1.0, 1.0, -1.0])
    matrix[:3, 3] = position
    return matrix.tolist()


def write(folder: Path, content: Any) -> Path:
    path = folder / "path.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_both_kinds_of_keyframes_mean_the_same(tmp_path: Path) -> None:
    scene = ring_scene()
    train = scene.train
    ours = [{"R": train.R[i].tolist(), "T": train.T[i].tolist()} for i in range(4)]
    theirs = [{"camera_to_world": opengl(train.R[i], train.positions[i])} for i in range(4)]
    first = from_file(write(tmp_path, {"keyframes": ours}), scene, 4)
    second = from_file(write(tmp_path, {"keyframes": theirs}), scene, 4)
    for path in (first, second):
        assert_close(path.R, train.R[:4], atol=1e-5)
        assert_close(path.positions, train.positions[:4], atol=1e-5)
        assert_close(path.intrinsics, train.intrinsics[:4])


def test_the_way_between_keyframes_is_smooth_and_even(tmp_path: Path) -> None:
    """Keyframes of an even turn on a straight line: every camera between stands and turns in proportion."""
    turned = [axis_turn(angle) for angle in (0.0, 0.4, 0.8, 1.2)]
    keyframes = [
        {"camera_to_world": opengl(R, torch.tensor([float(i), 0.0, 0.0])), "seconds": 2.0, "fov": 30 + 10 * i}
        for i, R in enumerate(turned)
    ]
    path = from_file(write(tmp_path, {"keyframes": keyframes, "fps": 5}), ring_scene())
    assert rate_of(str(write(tmp_path, {"keyframes": keyframes, "fps": 5}))) == 5
    assert rate_of("orbit") == 20
    assert len(path) == 31
    share = torch.linspace(0, 1, 31)
    assert_close(path.positions[:, 0], 3 * share, atol=1e-5)
    assert_close(path.R, torch.stack([axis_turn(1.2 * float(s)) for s in share]).float(), atol=1e-5)
    fov = torch.deg2rad(30 + 30 * share)
    assert_close(path.intrinsics[:, 1], 6 / torch.tan(fov / 2), rtol=1e-4)


def axis_turn(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)


def test_a_closed_way_has_no_jump_and_no_corner(tmp_path: Path) -> None:
    scene = ring_scene()
    square = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    keyframes = [{"camera_to_world": opengl(torch.eye(3), torch.tensor(place))} for place in square]
    path = from_file(write(tmp_path, {"keyframes": keyframes, "closed": True}), scene, 80)
    steps = path.positions.roll(-1, 0) - path.positions
    assert_close(path.positions[20], square[1], atol=1e-5)
    assert steps.norm(dim=1).max() < 1.8 * steps.norm(dim=1).min()
    turns = torch.nn.functional.cosine_similarity(steps, steps.roll(-1, 0), dim=1)
    assert turns.min() > math.cos(0.2)


def test_paths_of_nerfstudio_are_understood(tmp_path: Path) -> None:
    scene = ring_scene()
    entries = [
        {
            "camera_to_world": torch.tensor(opengl(scene.train.R[i], scene.train.positions[i])).flatten().tolist(),
            "fov": 60,
            "aspect": 1.5,
        }
        for i in range(3)
    ]
    content = {"camera_type": "perspective", "render_height": 20, "render_width": 30, "camera_path": entries}
    path = from_file(write(tmp_path, content), scene)
    assert len(path) == 3
    assert path.sizes.tolist() == [[20, 30]] * 3
    assert_close(path.R, scene.train.R[:3], atol=1e-5)
    assert_close(path.intrinsics[0, 1], torch.tensor(10 / math.tan(math.radians(30))))
    assert from_file(tmp_path / "path.json", scene, 7, 10).sizes.tolist() == [[10, 13]] * 7


POSE = {"R": torch.eye(3).tolist(), "T": [0, 0, 0]}


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("{", "cannot read"),
        ([], "needs 'keyframes'"),
        ({"keyframes": []}, "needs 'keyframes'"),
        ({"keyframes": [1]}, r"keyframes\[0\] is not an object"),
        ({"keyframes": [{}]}, r"keyframes\[0\] needs camera_to_world"),
        ({"keyframes": [POSE, {**POSE, "T": [0, 0]}]}, r"keyframes\[1\].T must be 3 finite numbers"),
        ({"keyframes": [{**POSE, "T": [0, 0, math.nan]}]}, "must be 3 finite numbers"),
        ({"keyframes": [{**POSE, "R": (2 * torch.eye(3)).tolist()}]}, "is no rotation"),
        ({"keyframes": [{**POSE, "R": (-torch.eye(3)).tolist()}]}, "is no rotation"),
        ({"keyframes": [{**POSE, "fov": 190}]}, "fov must be a number from 0.01 to 179"),
        ({"keyframes": [POSE, {**POSE, "seconds": 0}]}, "seconds must be a number"),
        ({"keyframes": [POSE, {**POSE, "seconds": 9e4}]}, "asks for 1800001 cameras"),
        ({"camera_path": [{"camera_to_world": [0] * 15}]}, "must be 4 x 4 finite numbers"),
        ({"camera_path": [POSE], "camera_type": "equirectangular"}, "only perspective"),
        ({"keyframes": [POSE], "width": 1e6, "height": 5}, "width must be a number from 1 to 8192"),
    ],
)
def test_malformed_files_are_named(content: Any, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=complaint) as caught:
        from_file(write(tmp_path, content), ring_scene())
    assert "path.json" in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("loop",), "trajectory must be auto, orbit, spiral or a .json file, got 'loop'"),
        (("nowhere.json",), "cannot read nowhere.json"),
        (("orbit", 0), "frames must be a number from 1"),
        (("orbit", 5, (0, 5)), "whole pixels"),
        (("orbit", 5, None, 90.0), "elevation_deg must lie between"),
    ],
)
def test_impossible_ways_are_refused(arguments: tuple[Any, ...], complaint: str) -> None:
    name, *rest = arguments
    with pytest.raises(UserError, match=complaint):
        trajectory(name, ring_scene(), *rest)
