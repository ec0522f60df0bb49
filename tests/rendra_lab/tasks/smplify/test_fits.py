"""Bodies fitted to people: clean joints are met, both sides are tried, fits are shown and kept."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hydra.errors import InstantiationException
from PIL import Image

from rendra.body import SMPL
from rendra.io import load_obj
from rendra_lab.body_pictures import read_numbers
from rendra_lab.experiment import Experiment, build, run
from rendra_lab.tasks.smplify.portraits import Frame, Portraits
from rendra_lab.tasks.smplify.records import PeopleBatch
from rendra_lab.tasks.smplify.report import numbers_of, shown_people
from rendra_lab.tasks.smplify.solvers import BatchedLevenbergMarquardt
from rendra_lab.tasks.smplify.task import SMPLify

CLEAN = ("data.count=3", "data.image_size=64", "data.cache=null")
CLEAN += ("data.noise_px=0.0", "data.missing=0.0", "data.swapped=0.0")


@pytest.fixture
def experiment(compose: Callable[..., Any], tmp_path: Path) -> Callable[..., Experiment]:
    def built(*overrides: str) -> Experiment:
        cfg = compose(tmp_path / "smplify" / "run", "task=smplify", *CLEAN, *overrides)
        return build(cfg, observers=False)

    return built


def placed(experiment: Experiment, steps: int = 0) -> tuple[SMPLify, PeopleBatch]:
    """A task and its people, some steps after the beginning of the fit."""
    task, data = experiment.task, experiment.data
    assert isinstance(task, SMPLify)
    data.setup("fit")
    batch = data.people  # type: ignore[attr-defined]
    task.place(batch)
    optimizer = BatchedLevenbergMarquardt([task.x])
    for step in range(steps):
        optimizer.problem = task.problem(batch, step)
        optimizer.step()
    return task, batch


def test_a_run_leaves_bodies_that_meet_their_joints(compose: Callable[..., Any], tmp_path: Path) -> None:
    folder = tmp_path / "smplify" / "run"
    settings = ("callbacks.people.pictures=2", "callbacks.people.meshes=1", "callbacks.people.size=48")
    settings += ("callbacks.animation.every_n_steps=12", "callbacks.images.every_n_steps=0")
    run(compose(folder, "task=smplify", *CLEAN, "data.image_size=256", "module.shown=1", *settings))
    record = json.loads((folder / "metrics.json").read_text())
    assert record["metrics"]["test/joints_px"] < 3
    assert record["metrics"]["test/limbs_outside"] == 1
    energies = {name for name in record["metrics"] if name.startswith("test/energy_")}
    priors = ("natural_pose", "natural_bends", "joint_limits", "usual_shape", "interpenetration")
    assert energies == {f"test/energy_{name}" for name in ("joints", *priors)}
    exports = folder / "exports"
    assert {path.name for path in exports.iterdir()} >= {"people.npz", "people.json", "person_0000.obj", "fit.gif"}
    assert len(list((exports / "people").glob("person_*.png"))) == 2
    with Image.open(folder / "images" / "people.png") as sheet:
        assert sheet.size[0] > 4 * 48
    check_files(exports)


def check_files(exports: Path) -> None:
    body = SMPL.free(low=True)
    with np.load(exports / "people.npz", allow_pickle=False) as arrays:
        kept = {name: arrays[name] for name in arrays.files}
    text = json.loads((exports / "people.json").read_text())
    assert text["pictures"] == kept["pictures"].tolist() == ["person_0000", "person_0001", "person_0002"]
    for name in ("pose", "betas", "translation", "joints", "joints_px", "error_px", "energy_joints"):
        assert np.allclose(text[name], kept[name], atol=1e-5), name
    posed = body(*(torch.from_numpy(kept[name]) for name in ("betas", "pose", "translation")))
    torch.testing.assert_close(posed.joints, torch.from_numpy(kept["joints"]), atol=1e-4, rtol=0)
    verts = load_obj(exports / "person_0000.obj")[0]
    torch.testing.assert_close(verts, posed.verts[0] * torch.tensor([1.0, -1.0, -1.0]), atol=1e-4, rtol=0)
    for name in ("people.npz", "people.json"):
        read = read_numbers(body, exports / name, index=2)
        upright = body(read.betas, read.pose).verts  # the fit's camera looks along +z with y down
        upright -= body(read.betas, read.pose).joints[:, :1]
        seen = posed.verts[2] - posed.joints[2, :1]
        torch.testing.assert_close(upright[0], seen * torch.tensor([1.0, -1.0, -1.0]), atol=1e-4, rtol=0)
        torch.testing.assert_close(read.betas[0], torch.from_numpy(kept["betas"][2]), atol=1e-5, rtol=0)


def test_derivatives_of_the_whole_objective_are_its_gradient(experiment: Callable[..., Experiment]) -> None:
    task, batch = placed(experiment(), steps=2)
    problem = task.problem(batch, 2)
    x = task.x.detach().clone().requires_grad_()
    problem.rows(x).square().sum().backward()
    rows, slopes = problem.linearized(x.detach())
    written = 2 * (slopes.transpose(1, 2) @ rows[..., None])[..., 0]
    assert x.grad is not None
    betas = slice(72, 82)  # which interpenetration does not pull at
    torch.testing.assert_close(written[:, :72], x.grad[:, :72], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(written[:, 82:], x.grad[:, 82:], rtol=1e-6, atol=1e-6)
    assert bool((written[:, betas] - x.grad[:, betas]).isfinite().all())
    torch.testing.assert_close(problem.rows(x.detach()), rows)


def test_everybody_is_fitted_as_if_alone(experiment: Callable[..., Experiment]) -> None:
    task, batch = placed(experiment(), steps=4)
    alone = build(experiment().cfg, observers=False)
    alone.data.setup("fit")
    alone.data.people = batch.select(torch.tensor([1]))  # type: ignore[attr-defined]
    one, _ = placed(alone, steps=4)
    torch.testing.assert_close(task.x[task.person == 1], one.x, atol=1e-6, rtol=0)


def from_the_side(batch: PeopleBatch) -> PeopleBatch:
    """Their shoulders lie in one place."""
    joints_px = batch.joints_px.clone()
    joints_px[:, 8] = joints_px[:, 9]
    return replace(batch, joints_px=joints_px)


@pytest.mark.parametrize("flip", [True, False])
def test_both_sides_are_tried_where_shoulders_do_not_tell(flip: bool, experiment: Callable[..., Experiment]) -> None:
    built = experiment(f"module.flip={flip}", "module.poses=null")
    built.data.setup("fit")
    built.data.people = from_the_side(built.data.people)  # type: ignore[attr-defined]
    task, batch = placed(built)
    assert task.person.tolist() == [0, 1, 2] * (1 + flip)
    assert task.is_flipped.tolist() == [False] * 3 + [True] * 3 * flip
    if flip:
        assert task.observe(batch).person.tolist() == [0, 1, 2]
        task.x.data[[3, 1, 5], -1] += 50.0  # far away: person 1 looks the other way
        assert task.observe(batch).is_flipped.tolist() == [False, True, False]


def test_the_best_fits_are_gone_on_with(experiment: Callable[..., Experiment]) -> None:
    task, batch = placed(experiment("module.flip=false"), steps=1)
    before = task.observe(batch)
    task.give_up(batch, 2)
    assert task.person[task.rows_at_work].bincount().tolist() == [2, 2, 2]
    torch.testing.assert_close(task.observe(batch).pose, before.pose)
    task.give_up(batch, 1)
    torch.testing.assert_close(task.observe(batch).pose, before.pose)


def test_impossible_settings_are_refused(experiment: Callable[..., Experiment]) -> None:
    with pytest.raises(InstantiationException, match=r"module.choose must be objective or picture, got 'best'"):
        experiment("module.choose=best")
    with pytest.raises(InstantiationException, match=r"module.narrow keeps at least one fit of everyone"):
        experiment("module.narrow=[[3,0]]")


def test_terms_come_to_their_weighted_sum(experiment: Callable[..., Experiment]) -> None:
    task, batch = placed(experiment(), steps=2)
    prediction = task.observe(batch)
    energies = task.energies(prediction, batch)
    assert {name: weight for name, (_, weight) in energies.items()} == {
        name: term.weight_at(10**9)
        for name, term in task.losses.items()  # type: ignore[operator]
    }
    value, _ = energies["usual_shape"]
    torch.testing.assert_close(value, prediction.betas.square().sum(1))
    numbers = numbers_of(prediction, batch)
    expected = (prediction.joints_px - batch.joints_px).norm(dim=-1).mean(1)
    assert numbers["error_px"] == pytest.approx(expected.numpy(), rel=1e-5)


def test_the_first_and_the_worst_are_shown() -> None:
    error = torch.tensor([0.0, 1.0, 9.0, 2.0, 8.0, torch.nan])
    assert shown_people(error, 4) == [0, 1, 2, 4]
    assert shown_people(error, 1) == [0]
    assert shown_people(error, 0) == []
    assert shown_people(error, 99) == [0, 1, 2, 3, 4, 5]


def test_bodies_are_drawn_where_their_joints_are(experiment: Callable[..., Experiment]) -> None:
    task, batch = placed(experiment("data.image_size=128"), steps=12)
    prediction = task.observe(batch)
    portraits, frame = Portraits(task.body.faces, 96), Frame.about(batch, 0)
    body = portraits.overlay(prediction, batch, 0, np.full((96, 96, 3), 255, np.uint8))
    inside = (body < 250).any(-1)
    for x, y in frame.places(prediction.joints_px[0, :12], 96).tolist():  # but neck and head
        assert inside[int(y) - 2 : int(y) + 3, int(x) - 2 : int(x) + 3].any()
    assert 0.02 < inside.mean() < 0.5
    for azimuth in (90.0, 180.0):
        turned = (portraits.turned(prediction, 0, azimuth) < 250).any(-1)
        assert not turned[[0, -1]].any()
        assert not turned[:, [0, -1]].any()
        assert 0.02 < turned.mean() < 0.5


def test_given_joints_are_green_and_projected_ones_red(experiment: Callable[..., Experiment]) -> None:
    task, batch = placed(experiment())
    prediction = task.observe(batch)
    confidence = batch.confidence.clone()
    confidence[0, 1:] = 0
    batch = replace(batch, confidence=confidence, picture_of=None)
    prediction = replace(prediction, joints_px=prediction.joints_px + 1000.0)
    shown = Portraits(task.body.faces, 64).draw(prediction, batch, 0)
    middle = shown["given green, fitted red"][28:36, 28:36].mean((0, 1))  # the only joint that was found
    assert middle[1] > middle[0] + 30
    assert middle[1] > middle[2] + 30
    assert set(shown) == {"given green, fitted red", "fit", "90 degrees", "180 degrees"}


def test_pictures_are_cut_about_people_and_continue_in_white() -> None:
    picture = np.zeros((20, 30, 3), np.uint8)
    cut = Frame(-10, 5, 20).cut(picture, 20)
    assert (cut[:, :10] == 255).all()
    assert (cut[15:] == 255).all()
    assert (cut[:14, 11:] == 0).all()
    assert (Frame(0, 0, 16).cut(None, 8) == 255).all()
    assert Frame(10, 20, 40).places(torch.tensor([30.0, 40.0]), 80).tolist() == [40.0, 40.0]
