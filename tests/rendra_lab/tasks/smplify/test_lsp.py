"""`data=lsp`: written sets in both orders, estimates, missing pictures, what is refused; and the real estimates."""

import io
import logging
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import torch
from assertions import assert_close
from file_mutations import damaged, edits
from hypothesis import HealthCheck, given, settings
from small_files import image_bytes

from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify.lsp import LSP, read_annotations, read_estimates
from rendra_lab.tasks.smplify.picture_people import box_size
from rendra_lab.tasks.smplify.records import LSP_JOINTS

COUNT = 5
PLACES = np.random.default_rng(3).uniform(10, 60, (COUNT, 14, 2))
SEEN = np.random.default_rng(4).uniform(size=(COUNT, 14)) < 0.7


def estimates(**changes: object) -> dict[str, object]:
    joints = np.concatenate([PLACES, 0.25 + 0.75 * SEEN[..., None]], 2).transpose(2, 1, 0)
    return {"est_joints": joints.astype(np.float32), "image_index": np.arange(1, 2 * COUNT, 2), **changes}


def write_estimates(folder: Path, **changes: object) -> Path:
    kept = {name: value for name, value in estimates(**changes).items() if value is not None}
    np.savez(folder / "est_joints.npz", **kept)
    return folder


def annotations(extended: bool = False, is_one_seen: bool = True) -> np.ndarray:
    """In MATLAB's pixels, half a pixel more than ours."""
    flags = SEEN if is_one_seen else ~SEEN
    joints = np.concatenate([PLACES + 0.5, flags[..., None]], 2)
    return joints.transpose(1, 2, 0) if extended else joints.transpose(2, 1, 0)


def write_annotations(folder: Path, compressed: bool = True, **variables: object) -> Path:
    scipy.io.savemat(folder / "joints.mat", variables, do_compression=compressed)
    return folder


def people(folder: Path, **settings: object):
    data = LSP(folder, **settings)
    data.setup("fit")
    return data


def test_estimates_are_taken_as_they_are(tmp_path: Path) -> None:
    batch = people(write_estimates(tmp_path)).people
    assert_close(batch.joints_px, torch.from_numpy(PLACES).float())
    assert_close(batch.confidence, torch.from_numpy(0.25 + 0.75 * SEEN).float())
    assert batch.pictures == ("im0001", "im0003", "im0005", "im0007", "im0009")
    assert batch.focal_px.tolist() == [2500.0] * COUNT


def test_more_rows_and_no_index_are_read_too(tmp_path: Path) -> None:
    wide = np.concatenate([estimates()["est_joints"], np.full((2, 14, COUNT), np.nan, np.float32)])
    batch = people(write_estimates(tmp_path, est_joints=wide, image_index=None)).people
    assert_close(batch.joints_px, torch.from_numpy(PLACES).float())
    assert batch.pictures[1] == "im0002"


@pytest.mark.parametrize("compressed", [True, False])
@pytest.mark.parametrize("extended", [True, False])
@pytest.mark.parametrize("is_one_seen", [True, False])
def test_annotations_lose_half_a_pixel_and_hidden_joints(
    tmp_path: Path, extended: bool, is_one_seen: bool, compressed: bool
) -> None:
    write_annotations(tmp_path, compressed, joints=annotations(extended, is_one_seen))
    flags = "auto" if is_one_seen or not extended else "hidden"
    batch = people(tmp_path, flags=flags).people
    found = torch.from_numpy(SEEN)
    assert torch.equal(batch.confidence, found.float())
    assert_close(batch.joints_px[found], torch.from_numpy(PLACES).float()[found])
    assert bool((batch.joints_px[~found] == 0).all())


def test_what_a_flag_means_is_logged_and_can_be_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_annotations(tmp_path, joints=annotations(is_one_seen=False))
    with caplog.at_level(logging.INFO):
        people(tmp_path)
    assert "a flag of 1 is taken to mean that a joint is hidden" in caplog.text
    assert torch.equal(people(tmp_path, flags="seen").people.confidence, torch.from_numpy(~SEEN).float())


def test_one_person_keeps_its_axes(tmp_path: Path) -> None:
    write_annotations(tmp_path, joints=annotations()[..., 0])
    assert people(tmp_path, flags="seen").people.joints_px.shape == (1, 14, 2)


@pytest.mark.parametrize("name", ["images/im0003.jpg", "im0003.jpg", "images/im00003.jpg"])
def test_a_picture_says_its_size_and_is_loaded(tmp_path: Path, name: str) -> None:
    write_estimates(tmp_path)
    (tmp_path / "images").mkdir()
    (tmp_path / name).write_bytes(image_bytes("JPEG", (70, 90)))
    data = people(tmp_path)
    assert data.people.size_px[1].tolist() == [90, 70]
    assert data.people.center_px[1].tolist() == [35, 45]
    assert data.people.pictures[1] == str(tmp_path / name)
    assert data.picture(1).shape == (90, 70, 3)
    assert data.picture(str(tmp_path / name)).dtype == np.uint8
    assert data.picture(0) is None
    assert data.picture("im0001") is None


def test_the_box_of_the_joints_is_in_the_middle_of_a_missing_picture() -> None:
    joints = np.zeros((14, 3))
    joints[3], joints[5] = (10, 30, 1), (50, 130.5, 0.5)
    assert box_size(joints) == (161, 60)
    joints[3] = (-10, 30, 1)
    assert box_size(joints) == (161, 50)


def test_some_are_taken_in_order(tmp_path: Path) -> None:
    batch = people(write_estimates(tmp_path), first=1, count=2).people
    assert batch.pictures == ("im0003", "im0005")
    assert people(tmp_path, first=4, count=9).people.pictures == ("im0009",)


def test_every_step_gets_everyone_and_the_test_once(tmp_path: Path) -> None:
    data = people(write_estimates(tmp_path), steps=3)
    assert [batch is data.people for batch in data.train_dataloader()] == [True] * 3
    assert [batch is data.people for batch in data.test_dataloader()] == [True]


def _with(joint: int, row: int, value: float) -> Callable[[], dict[str, object]]:
    def changed() -> dict[str, object]:
        joints = estimates()["est_joints"].copy()
        joints[row, joint, 2] = value
        return {"est_joints": joints}

    return changed


def test_values_that_cannot_be_are_refused_by_name(tmp_path: Path) -> None:
    cases = {
        ("nan", _with(4, 0, np.nan)): r"person 5, left_knee: it is found with confidence .* at \(nan,",
        ("inf", _with(6, 1, np.inf)): r"person 5, right_wrist: .*inf\); expected finite numbers",
        ("negative", _with(0, 2, -0.5)): r"person 5, right_ankle: the confidence is -0.5; expected a number from 0",
        ("nan confidence", _with(13, 2, np.nan)): "person 5, head_top: the confidence is nan",
        ("none", lambda: {"est_joints": estimates()["est_joints"] * [[[1]], [[1]], [[0]]]}): "all joints are missing",
        ("shape", lambda: {"est_joints": np.zeros((3, 15, 5))}): r"shape \(3, 15, 5\); expected \(3, 14, N\)",
        ("complex", lambda: {"est_joints": np.zeros((3, 14, 5), complex)}): "holds complex128; expected real numbers",
        ("key", lambda: {"est_joints": None, "image_index": np.arange(5)}): "'est_joints' is missing",
        ("none at all", lambda: {"est_joints": np.zeros((3, 14, 0)), "image_index": None}): "holds no people",
        ("index", lambda: {"image_index": np.arange(1, 4)}): r"shape \(3,\); expected \(5,\)",
        ("index 0", lambda: {"image_index": np.arange(5)}): "must hold whole numbers from 1",
        ("twice", lambda: {"image_index": np.array([1, 2, 3, 3, 4])}): "holds 3 more than once",
        ("pickle", lambda: {"est_joints": np.array([print], object)}): "no .npz file that can be read",
    }
    for (name, change), message in cases.items():
        folder = tmp_path / name
        folder.mkdir()
        with pytest.raises(UserError, match=message) as refusal:
            people(write_estimates(folder, **change()))
        assert str(folder) in str(refusal.value)
        assert "\n" not in str(refusal.value)


def test_joints_far_outside_their_picture_are_refused(tmp_path: Path) -> None:
    (tmp_path / "im0005.jpg").write_bytes(image_bytes("JPEG", (70, 90)))
    write_estimates(tmp_path, **_with(12, 0, 140.5)())
    with pytest.raises(UserError, match=r"person 5, neck: it is at \(140.5, .* expected x from -70 to 140"):
        people(tmp_path)


def test_a_truncated_picture_is_refused_when_it_is_read(tmp_path: Path) -> None:
    write_estimates(tmp_path)
    data = image_bytes("JPEG", (70, 90))
    (tmp_path / "im0001.jpg").write_bytes(data[: len(data) - 300])
    with pytest.raises(UserError, match=r"im0001\.jpg is not a picture that can be read"):
        people(tmp_path).picture(0)
    (tmp_path / "im0001.jpg").write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"person 1: .*im0001\.jpg is not a picture"):
        people(tmp_path)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"joints": np.zeros((14, 4, 3))}, r"shape \(14, 4, 3\); expected \(3, 14, N\) or \(14, 3, N\)"),
        ({"other": np.zeros(3)}, "'joints' is missing; it holds 'other'"),
        ({"joints": "text"}, "'joints' is a char"),
        ({"joints": {"a": 1.0}}, "'joints' is a struct"),
        ({"joints": np.full((3, 14, 2), 0.5)}, "person 1, right_ankle: the flag is 0.5; expected 0 or 1"),
    ],
)
def test_other_matlab_files_are_refused(tmp_path: Path, variables: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        people(write_annotations(tmp_path, **variables))


def test_files_that_would_swell_are_refused(tmp_path: Path) -> None:
    header = write_annotations(tmp_path, joints=annotations()) / "joints.mat"
    bomb = zlib.compress(bytes(80 << 20), 9)
    size = len(bomb).to_bytes(4, "little")
    header.write_bytes(header.read_bytes()[:128] + (15).to_bytes(4, "little") + size + bomb)
    with pytest.raises(UserError, match="takes more than 67,108,864 bytes"):
        read_annotations(header)
    packed = tmp_path / "est_joints.npz"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("est_joints.npy", bytes(65 << 20))
    with pytest.raises(UserError, match="at most 67,108,864 are read"):
        read_estimates(packed)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"joints": "joints.txt"}, "data.joints is one of"),
        ({"flags": "maybe"}, "data.flags is one of auto seen hidden"),
        ({"focal_px": 0.0}, "data.focal_px must be a number of pixels above zero, got 0.0"),
        ({"first": -1}, "data.first counts people from 0"),
        ({"first": 5}, "data.first=5, but .* holds 5 people"),
        ({"count": 0}, "data.count must be at least 1"),
        ({"joints": "joints.mat"}, "there is no joints.mat in"),
    ],
)
def test_settings_that_cannot_be_are_refused(tmp_path: Path, settings: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        people(write_estimates(tmp_path), **settings)


def test_a_missing_folder_and_unknown_people_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="there is no folder"):
        people(tmp_path / "away")
    with pytest.raises(UserError, match=r"there is no est_joints.npz or joints.mat in"):
        people(tmp_path)
    data = people(write_estimates(tmp_path))
    with pytest.raises(UserError, match="there is no person 5; there are 5"):
        data.picture(5)
    with pytest.raises(UserError, match="there is no picture 'im0002'"):
        data.picture("im0002")


def _compressed_annotations() -> bytes:
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, {"joints": annotations()}, do_compression=False)
    return buffer.getvalue()


MATLAB_FILE = _compressed_annotations()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(edits)
def test_damaged_matlab_files_are_read_or_refused(tmp_path: Path, steps) -> None:
    path = tmp_path / "joints.mat"
    path.write_bytes(damaged(MATLAB_FILE, steps))
    try:
        joints, numbers = read_annotations(path)
    except UserError as error:
        said = str(error)
    else:
        said = str(path)
        assert joints.shape == (len(numbers), 14, 3)
    assert "joints.mat" in said
    assert "\n" not in said


def test_the_real_estimates_lie_upon_their_picture(shared_data: Path) -> None:
    data = people(shared_data / "lsp")
    batch = data.people
    assert batch.joints_px.shape == (1000, 14, 2)
    assert data.picture(0).shape == (160, 70, 3)
    assert batch.size_px[0].tolist() == [160, 70]
    found = batch.confidence > 0
    assert bool(found.all())
    assert bool((batch.joints_px <= batch.size_px.flip(1)[:, None]).all())
    guessed = box_size(torch.cat([batch.joints_px[0], batch.confidence[0, :, None]], 1).double().numpy())
    assert np.abs(np.subtract(guessed, (160, 70))).max() <= 3  # the person is in the middle
    head, ankle = LSP_JOINTS.index("head_top"), LSP_JOINTS.index("right_ankle")
    upright = batch.joints_px[:, head, 1] < batch.joints_px[:, ankle, 1]
    assert float(upright.float().mean()) > 0.9
