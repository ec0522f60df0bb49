"""Poses from files and chance, and the sheets of scripts/render_body.py."""

import json
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rendra.body import SMPL
from rendra.renderer.materials import Materials
from rendra.renderer.mesh.shader import HardPhongShader
from rendra.transforms import axis_angle_to_matrix
from rendra_lab import body_pictures
from rendra_lab.errors import UserError
from rendra_lab.pictures import Headlight, OrbitCamera, Shading, Studio

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def body() -> SMPL:
    return SMPL.free(low=True)


@pytest.fixture
def studio() -> Studio:
    return Studio(OrbitCamera(), Headlight(), Materials(), Shading(HardPhongShader()), antialias=1)


def test_random_bodies_are_those_of_the_chapters_script(body: SMPL) -> None:
    stream = np.random.RandomState(3)
    pose, betas = stream.rand(72) * 0.2, stream.rand(10) * 0.03
    numbers = body_pictures.random_numbers(body, 3)
    torch.testing.assert_close(numbers.pose.reshape(-1)[1:], torch.from_numpy(pose[1:]).float())
    torch.testing.assert_close(numbers.betas[0], torch.from_numpy(betas).float())
    assert numbers.pose[0, 0, 0] == 0


def test_what_was_saved_is_read(body: SMPL, tmp_path: Path) -> None:
    numbers = body_pictures.random_numbers(body, 0)
    again = body_pictures.read_numbers(body, numbers.save(tmp_path / "new" / "body.json"))
    torch.testing.assert_close(again.pose, numbers.pose)
    torch.testing.assert_close(again.betas, numbers.betas)


def test_layouts_of_poses(body: SMPL, tmp_path: Path) -> None:
    rows = np.arange(144.0).reshape(2, 72) / 100
    np.savez(tmp_path / "fits.npz", pose=rows, betas=np.ones((2, 10)), translation=np.zeros((2, 3)))
    (tmp_path / "fit.pkl").write_bytes(pickle.dumps({"pose": rows[1], "betas": np.ones(10)}, 2))
    np.savez(tmp_path / "one.npz", pose=rows[1].reshape(24, 3))
    for name, index in (("fits.npz", 1), ("fit.pkl", 0), ("one.npz", 0)):
        numbers = body_pictures.read_numbers(body, tmp_path / name, index)
        torch.testing.assert_close(numbers.pose.reshape(-1), torch.from_numpy(rows[1]).float())
        assert numbers.betas.sum() == (0 if name == "one.npz" else 10)
    (tmp_path / "bent.json").write_text(json.dumps({"pose": {"left_elbow": [0, -1.5, 0]}, "betas": [2]}))
    numbers = body_pictures.read_numbers(body, tmp_path / "bent.json")
    assert numbers.pose[0, body.joint_index("left_elbow")].tolist() == [0, -1.5, 0]
    assert numbers.pose.count_nonzero() == 1
    assert numbers.betas[0, 0] == 2


def test_a_body_in_a_cameras_axes_is_set_upright(body: SMPL, tmp_path: Path) -> None:
    pose = np.zeros(72)
    pose[:3] = np.pi, 0, 0
    np.savez(tmp_path / "fit.npz", pose=pose)
    upright = body_pictures.read_numbers(body, tmp_path / "fit.npz", camera_axes=True)
    torch.testing.assert_close(axis_angle_to_matrix(upright.pose[0, 0]), torch.eye(3), rtol=0, atol=1e-5)


def test_a_file_of_fits_is_known_to_be_in_a_cameras_axes(body: SMPL, tmp_path: Path) -> None:
    rows = {"pose": [[np.pi, *[0.0] * 71]] * 2, "center_px": [[64.0, 64.0]] * 2}
    (tmp_path / "people.json").write_text(json.dumps(rows))
    turn = {axes: body_pictures.read_numbers(body, tmp_path / "people.json", 1, axes) for axes in (None, False)}
    torch.testing.assert_close(axis_angle_to_matrix(turn[None].pose[0, 0]), torch.eye(3), rtol=0, atol=1e-5)
    assert turn[False].pose[0, 0, 0] == pytest.approx(np.pi)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("none.json", None, "there is no file"),
        ("a.json", b"{", "cannot be read"),
        ("a.json", b"[1]", "holds a list"),
        ("a.json", b'{"betas": [1]}', "has no pose; it has: betas"),
        ("a.json", b'{"pose": [1, 2]}', "has 72 numbers, got 2"),
        ("a.json", b'{"pose": {"tail": [0, 0, 0]}}', "no joint 'tail'"),
        ("a.json", b'{"pose": {"neck": [0, 0]}}', "a.json: "),
        ("a.json", b'{"pose": {"neck": [0, 0, NaN]}}', "not finite"),
        ("a.json", b'{"pose": {}, "betas": [0,0,0,0,0,0,0,0,0,0,0]}', "11 betas, and the body 10"),
        ("a.json", b"[" * 100_000, "cannot be read"),
        ("a.pkl", b"cos\nsystem\n.", "names os.system"),
        ("a.npz", b"PK", "cannot be read"),
        ("a.txt", b"1", "no .json, .npz or .pkl"),
    ],
)
def test_files_that_hold_no_pose(body: SMPL, tmp_path: Path, name: str, content: Any, words: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=words):
        body_pictures.read_numbers(body, tmp_path / name)


def test_settings_that_cannot_be(body: SMPL) -> None:
    with pytest.raises(UserError, match="at most 10 finite numbers"):
        body_pictures.with_betas(body, [0.0] * 11)
    with pytest.raises(UserError, match="sheet must be null, all, betas or joints, got 'hands'"):
        list(body_pictures.sheets_of("hands"))
    assert list(body_pictures.sheets_of("all")) == ["betas", "joints"]


def test_sheets(body: SMPL, studio: Studio) -> None:
    betas = body_pictures.beta_sheet(body, studio, 40, 60)
    assert betas.shape[1] == 5 * 40 + 4 * 6
    assert (betas < 250).any(-1).mean() > 0.05
    joints = body_pictures.joint_sheet(body, studio, 40)
    assert joints.shape[1] == 12 * 40 + 11 * 6
    red, _, blue = joints.astype(int).transpose(2, 0, 1)
    assert (red > blue + 80).any()  # what a joint holds is orange


@pytest.mark.slow
def test_the_program(tmp_path: Path) -> None:
    script = [sys.executable, str(ROOT / "scripts" / "render_body.py"), "body=free_low", f"hydra.run.dir={tmp_path}"]
    done = subprocess.run(
        [*script, "size=64", "turntable=gif", "frames=3"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert {"body.png", "body.json", "body.obj", "body.glb", "turntable.gif"} <= {
        path.name for path in tmp_path.iterdir()
    }
    done = subprocess.run([*script, "posture=nowhere.json"], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert (
        done.stderr.strip()
        == "render_body.py: there is no file nowhere.json; posture is random, rest, or a .json, .npz or .pkl file"
    )
