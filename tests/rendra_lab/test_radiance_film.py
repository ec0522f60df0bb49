"""Films of a fitted scene: what they show, where they go, and what a run leaves."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from assertions import assert_close
from PIL import Image
from rendra_lab_toy import SphereTask, SphereViews, save_config
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from rendra_lab import visualization
from rendra_lab.errors import UserError
from rendra_lab.experiment import run
from rendra_lab.losses import SquaredError
from rendra_lab.networks.radiance import view_normals, view_panels
from rendra_lab.radiance_callbacks import Turntable
from rendra_lab.radiance_film import FilmOrder, film, path_caster, render_path, render_run
from rendra_lab.terms import LossTerm
from rendra_lab.trajectories import orbit


@pytest.fixture(scope="module")
def data() -> SphereViews:
    views = SphereViews()
    views.setup("test")
    return views


@pytest.fixture
def task() -> SphereTask:
    return SphereTask(losses={"rgb": LossTerm(SquaredError())}, optimizer=torch.optim.SGD)


def test_a_path_is_rendered_as_evaluation_sees_it(data: SphereViews, task: SphereTask) -> None:
    task.train()
    seen = list(render_path(task, path_caster(data), orbit(data.scene, 3)))
    assert len(seen) == 3
    for batch, prediction in seen:
        assert prediction.rgb.shape == (1, 24, 32, 3)
        assert not prediction.rgb.requires_grad
        assert_close(prediction.depth[0, 12, 16], batch.origins[0, 12, 16, 0].norm() - 0.6, atol=5e-3)
        assert_close(prediction.rgb[0, 0, 0], [1, 1, 1])
    assert task.training


@pytest.mark.parametrize(("given", "filmed"), [("black", "black"), ("random", "white")])
def test_random_backgrounds_become_white(given: str, filmed: str, data: SphereViews) -> None:
    views = SphereViews(background=given)
    views.scene = data.scene
    assert path_caster(views).background == filmed


def test_films_share_the_colours_of_depth(data: SphereViews, task: SphereTask) -> None:
    frames = film(task, path_caster(data), orbit(data.scene, 4))
    assert list(frames) == ["rgb", "depth", "normals"]
    middle = np.stack([picture[12, 16] for picture in frames["depth"]]).astype(int)
    assert np.abs(middle - [253, 231, 37]).max() < 12  # the nearest point is the same in all
    assert (frames["normals"][0][0, 0] == 255).all()
    assert len({picture.tobytes() for picture in frames["rgb"]}) == 4
    with pytest.raises(UserError, match="must be among rgb, depth, normals; got heat"):
        film(task, path_caster(data), orbit(data.scene, 4), ["heat"])
    with pytest.raises(UserError, match="at least one frame"):
        film(task, path_caster(data), data.scene.train.select([]))


def test_normals_of_the_ball_are_radial(data: SphereViews, task: SphereTask) -> None:
    ((batch, prediction),) = render_path(task, path_caster(data), orbit(data.scene, 1, size=96))
    found = view_normals(prediction, batch)
    hit = batch.origins[0, ..., 0, :] + prediction.depth[0, ..., None] * batch.directions[0, ..., 0, :]
    R = orbit(data.scene, 1).R[0]
    expected = hit / hit.norm(dim=-1, keepdim=True) @ R * torch.tensor([-1.0, 1.0, -1.0])
    facing = (prediction.opacity[0] > 0.99) & (expected[..., 2] > 0.5)
    assert facing.sum() > 200
    assert ((found * expected).sum(-1)[facing] > 0.999).float().mean() > 0.98


def test_panels_of_a_view_show_its_shape_and_those_of_pixels_nothing(data: SphereViews, task: SphereTask) -> None:
    whole = next(iter(data.test_dataloader()))
    panels = view_panels(task.observe(whole), whole)
    assert list(panels) == ["target", "rendering", "error x 4", "depth", "normals"]
    assert panels["error x 4"].max() < 0.02
    some = next(iter(data.train_dataloader()))
    assert view_panels(task.observe(some), some) == {}


def test_films_go_where_they_are_ordered(data: SphereViews, task: SphereTask, tmp_path: Path) -> None:
    note, path = render_run(task, data, FilmOrder(tmp_path / "new" / "a.gif", frames=3, what="all", size=12))
    assert note.startswith("3 frames of 16x12 rendered in ")
    with Image.open(path) as image:
        assert image.n_frames == 3
        assert image.width == 3 * 16 + 2 * 6
    _, folder = render_run(task, data, FilmOrder(tmp_path / "pngs", frames=2))
    assert sorted(file.name for file in folder.iterdir()) == ["frame_0000.png", "frame_0001.png"]
    _, named = render_run(task, data, FilmOrder(tmp_path, frames=2, what="depth", size=(9, 9)))
    assert named.stem == "depth"
    assert named.exists()


def test_impossible_orders_are_refused(
    task: SphereTask, data: SphereViews, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(visualization, "find_spec", lambda name: None)
    for order, complaint in (
        ({"what": "heat"}, "what must be rgb, depth, normals or all"),
        ({"output": tmp_path / "a.avi"}, r"must end in .gif or .mp4"),
        ({"output": tmp_path / "a.mp4"}, r"rendra\[view\]"),
        ({"fps": 0.0}, "fps must be positive"),
    ):
        with pytest.raises(UserError, match=complaint):
            FilmOrder(**{"output": tmp_path, **order})  # type: ignore[arg-type]
    assert FilmOrder(tmp_path).file().name == "rgb.gif"
    with pytest.raises(UserError, match="SphereTask fits no scene that can be filmed"):
        render_run(task, object(), FilmOrder(tmp_path))
    with pytest.raises(UserError, match="trajectory must be"):
        Turntable(str(tmp_path), trajectory="loop")
    with pytest.raises(UserError, match="shown must be some of"):
        Turntable(str(tmp_path), shown=["heat"])


def test_a_run_ends_with_films_and_views(
    compose: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    finished = tmp_path / "toy_scene" / "run"
    run(compose(finished, "task=toy_scene"))
    for name in ("turntable", "depth", "normals"):
        assert (finished / "exports" / f"{name}.gif").exists()
    with Image.open(finished / "exports" / "turntable.gif") as image:
        assert image.n_frames == 6
    said = capsys.readouterr().out
    assert "6 frames of 32x24 rendered in " in said
    if not visualization.can_write_mp4():
        assert "no .mp4 without the extra [view]" in said
    rows = list(csv.DictReader((finished / "exports" / "views.csv").read_text().splitlines()))
    assert [row["view"] for row in rows] == ["view_7.png", "view_8.png"]
    score = json.loads((finished / "metrics.json").read_text())["metrics"]["test/psnr"]
    assert sum(float(row["psnr"]) for row in rows) / 2 == pytest.approx(score, rel=1e-5)
    assert (finished / "images" / "test_001.png").exists()
    (events,) = finished.glob("events.out.tfevents.*")
    shown = EventAccumulator(str(events))
    shown.Reload()
    assert {"film/turntable", "film/depth", "film/normals", "test/000/target", "test/001/target"} <= set(
        shown.Tags()["images"]
    )
    assert "film/frames_per_s" in shown.Tags()["scalars"]
    assert shown.Images("film/turntable")[0].encoded_image_string.startswith(b"GIF8")


def test_the_program_films_a_finished_run(
    compose: Callable[..., Any], program: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    folder = tmp_path / "toy_scene" / "run"
    cfg = compose(folder, "task=toy_scene", "callbacks.turntable=null", "trainer.max_steps=2")
    save_config(cfg)
    run(cfg)
    output = tmp_path / "film.gif"
    code, said, err = program("scripts/render.py", f"run={folder}", "frames=4", "what=rgb", f"output={output}")
    assert (code, err) == (0, "")
    assert said.splitlines()[-1] == str(output)
    with Image.open(output) as image:
        assert image.n_frames == 4
        assert image.size == (32, 24)
    code, _, err = program("scripts/render.py", f"run={tmp_path}")
    assert code == 2
    assert "is not the folder of a run" in err
    code, _, err = program("scripts/render.py", "trajectory=orbit")
    assert code == 2
    assert "name its run with run=outputs/..." in err
    code, _, err = program("scripts/render.py", f"run={folder}", "turntable=gif")
    assert code == 2
    assert "are for meshes" in err


def test_runs_of_other_tasks_are_refused(
    compose: Callable[..., Any], program: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    folder = tmp_path / "toy" / "run"
    cfg = compose(folder, "task=toy", "debug=fast")
    save_config(cfg)
    run(cfg)
    code, _, err = program("scripts/render.py", f"run={folder}")
    assert code == 2
    assert "ToyTask fits no scene that can be filmed; take a run of nerf or volume" in err


def test_a_run_out_of_time_still_ends_with_test_and_films(
    compose: Callable[..., Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "toy_scene" / "run"
    run(compose(folder, "task=toy_scene", "trainer.max_steps=1000000", "trainer.max_time=00:00:00:01"))
    record = json.loads((folder / "metrics.json").read_text())
    assert record["status"] == "ok"
    assert 1 < record["steps"] < 1_000_000
    assert record["seconds"]["fit"] < 5
    assert record["metrics"]["test/psnr"] > 0
    assert (folder / "exports" / "turntable.gif").exists()
    assert (folder / "checkpoints" / "last.ckpt").exists()
    assert f"trainer.max_time ended the fit after step {record['steps']} of 1000000" in capsys.readouterr().out
