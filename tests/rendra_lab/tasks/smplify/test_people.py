"""data=people: what a detector would see of bodies that are known, pictures made when looked at, and folders."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from rendra.body import SMPL
from rendra_lab.errors import UserError
from rendra_lab.tasks.smplify.joints_json import JointsJSON
from rendra_lab.tasks.smplify.lsp import LSP
from rendra_lab.tasks.smplify.people import GeneratedPeople, detected
from rendra_lab.tasks.smplify.records import LSP_JOINTS


@pytest.fixture(scope="module")
def body() -> SMPL:
    return SMPL.free(low=True)


def people(body: SMPL, **settings: Any) -> GeneratedPeople:
    made = GeneratedPeople(body, **{"count": 12, "image_size": [48, 40], **settings})
    made.setup("fit")
    return made


def test_clean_joints_are_those_of_the_bodies(body: SMPL) -> None:
    batch = people(body, noise_px=0.0, missing=0.0, swapped=0.0).people
    assert batch.truth is not None
    torch.testing.assert_close(batch.joints_px, batch.truth.clean_px)
    assert torch.equal(batch.confidence, torch.ones(12, 14))
    posed = body(batch.truth.betas, batch.truth.pose, batch.truth.translation)
    points = torch.cat([posed.joints[:, [8, 5, 2, 1, 4, 7, 21, 19, 17, 16, 18, 20, 12]],
                        posed.verts[:, [body.head_top]]], dim=1)  # fmt: skip
    pixels = batch.focal_px[:, None, None] * points[..., :2] / points[..., 2:] + batch.center_px[:, None]
    torch.testing.assert_close(
        batch.truth.clean_px, pixels, atol=0.5, rtol=0
    )  # the top of the head rides on one bone
    torch.testing.assert_close(batch.truth.clean_px[:, :13], pixels[:, :13], atol=1e-2, rtol=0)
    torch.testing.assert_close(batch.truth.verts, posed.verts, atol=2e-4, rtol=0)
    assert batch.size_px[0].tolist() == [48, 40]


def clean(count: int = 4000) -> torch.Tensor:
    return 200 * torch.rand(count, 14, 2, generator=torch.Generator().manual_seed(0))


def test_noise_is_as_strong_as_asked_and_lowers_confidence() -> None:
    joints, confidence = detected(clean(), 3.0, 0.0, 0.0, torch.Generator().manual_seed(1))
    error = joints - clean()
    assert float(error.std()) == pytest.approx(3.0, rel=0.05)
    sure, unsure = confidence > 0.85, confidence < 0.5
    assert float(error[sure].std()) < 0.6 * float(error[unsure].std())
    assert 0 < float(confidence.min()) < float(confidence.max()) <= 1


def test_some_joints_are_missing() -> None:
    joints, confidence = detected(clean(), 0.0, 0.1, 0.0, torch.Generator().manual_seed(1))
    lost = confidence == 0
    assert float(lost.float().mean()) == pytest.approx(0.1, abs=0.01)
    assert bool((joints[lost] == 0).all())
    assert torch.equal(joints[~lost], clean()[~lost])


def test_some_lower_limbs_change_sides_and_nothing_else_does() -> None:
    joints, confidence = detected(clean(), 0.0, 0.0, 0.2, torch.Generator().manual_seed(1))
    wrong = (joints != clean()).any(-1)
    elbow, wrist = (LSP_JOINTS.index(f"left_{part}") for part in ("elbow", "wrist"))
    assert float(wrong[:, elbow].float().mean()) == pytest.approx(0.2, abs=0.02)
    assert torch.equal(wrong[:, elbow], wrong[:, wrist])
    other = LSP_JOINTS.index("right_elbow")
    assert torch.equal(joints[:, elbow][wrong[:, elbow]], clean()[:, other][wrong[:, elbow]])
    for name in ("left_hip", "right_shoulder", "neck", "head_top"):
        assert not bool(wrong[:, LSP_JOINTS.index(name)].any())
    assert bool((confidence[wrong] < 1).all())
    assert bool((confidence[~wrong] == 1).all())


def test_train_repeats_and_test_gives_everyone_once(body: SMPL) -> None:
    made = people(body, steps=3)
    assert len(list(made.train_dataloader())) == 3
    (batch,) = made.test_dataloader()
    assert len(batch.pictures) == 12 == len(set(batch.pictures))


def test_pictures_are_painted_when_looked_at_and_kept(body: SMPL, tmp_path: Path) -> None:
    made = people(body, cache=tmp_path)
    assert not list(tmp_path.iterdir())
    picture = made.picture(3)
    assert picture is not None
    assert picture.shape == (48, 40, 3)
    assert len(list(tmp_path.iterdir())) == 1
    again = people(body, cache=tmp_path).picture("person_0003")
    assert np.array_equal(picture, again)
    assert len(list(tmp_path.iterdir())) == 1
    people(body, cache=tmp_path, seed=1).picture(3)
    assert len(list(tmp_path.iterdir())) == 2


def test_noise_does_not_change_who_is_seen(body: SMPL) -> None:
    one, other = people(body, noise_px=0.0).people, people(body, noise_px=5.0).people
    assert one.truth is not None
    assert other.truth is not None
    assert torch.equal(one.truth.verts, other.truth.verts)
    assert not torch.equal(one.joints_px, other.joints_px)


def test_a_folder_of_people_is_read_by_the_readers_of_others(body: SMPL, tmp_path: Path) -> None:
    made = people(body, count=3)
    folder = made.write(tmp_path / "people")
    content = json.loads((folder / "people.json").read_text())
    assert len(content["pictures"]) == 3
    assert made.people.truth is not None
    torch.testing.assert_close(torch.tensor(content["pictures"][1]["truth"]["pose"]), made.people.truth.pose[1])
    found = made.people.confidence > 0
    for reader in (LSP(folder), JointsJSON(folder / "people.json", least_confidence=0.0)):
        reader.setup("fit")
        torch.testing.assert_close(reader.people.joints_px[found], made.people.joints_px[found])
        torch.testing.assert_close(reader.people.confidence, made.people.confidence)
        assert np.array_equal(reader.picture(2), made.picture(2))  # type: ignore[arg-type]


def test_generate_data_writes_people(program: Callable[..., tuple[int, str, str]], tmp_path: Path) -> None:
    settings = ("data=people", "body=free_low", "data.count=2", "data.image_size=32", "data.cache=null")
    code, out, error = program("scripts/generate_data.py", *settings, f"output={tmp_path / 'made'}")
    assert (code, error) == (0, "")
    assert out.endswith(f"{tmp_path / 'made'}\n")
    assert sorted(path.name for path in (tmp_path / "made").iterdir()) == ["est_joints.npz", "images", "people.json"]


def test_only_such_folders_are_overwritten(body: SMPL, tmp_path: Path) -> None:
    made = people(body, count=1)
    made.write(tmp_path / "out")
    with pytest.raises(UserError, match="not empty"):
        made.write(tmp_path / "out")
    made.write(tmp_path / "out", overwrite=True)
    (tmp_path / "out" / "thesis.txt").write_text("years of work")
    with pytest.raises(UserError, match=r"thesis\.txt"):
        made.write(tmp_path / "out", overwrite=True)
    with pytest.raises(UserError, match="is a file"):
        made.write(tmp_path / "out" / "thesis.txt")


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"count": 0}, "data.count must be a whole number of at least 1, got 0"),
        ({"noise_px": -1.0}, "data.noise_px must be at least 0"),
        ({"missing": 1.5}, "data.missing must be a number from 0 to 1"),
        ({"swapped": -0.1}, "data.swapped must be a number from 0 to 1"),
        ({"image_size": 3}, r"data.image_size must be one side or \[height,width\]"),
        ({"image_size": [64, 64, 64]}, "data.image_size"),
    ],
)
def test_impossible_settings_are_refused(body: SMPL, settings: dict[str, Any], complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        GeneratedPeople(body, **settings)
