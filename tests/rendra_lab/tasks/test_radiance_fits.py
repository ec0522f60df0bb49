"""Both radiance tasks on a ball in its normals' colours: they learn it, again alike, and go on where they were."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from far_device import Far, far  # noqa: F401
from lightning.pytorch import Trainer
from torch import nn

from rendra.renderer import AmbientLights, TexturesVertex
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab import losses, metrics
from rendra_lab.base_task import Task
from rendra_lab.data.ray_views import RayCaster, Scene, SceneViews
from rendra_lab.data.rendered_scenes import RenderedScene
from rendra_lab.networks.encodings import HashGrid, SphericalHarmonics
from rendra_lab.networks.radiance import RadianceScene
from rendra_lab.random_state import RandomState
from rendra_lab.tasks.nerf.grid_fields import GridField
from rendra_lab.tasks.nerf.occupancy import OccupancyRenderer
from rendra_lab.tasks.nerf.task import NeRF
from rendra_lab.tasks.volume.grid import VolumeGrid
from rendra_lab.tasks.volume.task import Volume
from rendra_lab.terms import LossTerm, MetricTerm

RADIUS = 0.7
TASKS = ["nerf", "volume"]


class Views(SceneViews):
    """A scene that is there already."""

    def __init__(self, given: Scene, **settings: Any) -> None:
        super().__init__(**settings)
        self.given = given

    def load(self) -> Scene:
        return self.given


@pytest.fixture(scope="module")
def scene() -> Scene:
    sphere = ico_sphere(3)
    verts = sphere.verts_packed()
    mesh = Meshes([verts * RADIUS], [sphere.faces_packed()], TexturesVertex([verts / 2 + 0.5]))
    return RenderedScene(mesh, AmbientLights(), image_size=24, counts=(14, 1, 2), antialias=3).load()


def views(scene: Scene) -> Views:
    return Views(scene, rays_per_step=512, background="random", focus=0.75, steps=1000)


def parts(rate: float) -> dict[str, Any]:
    squares = losses.SquaredError()
    return {
        "losses": {
            "rgb": LossTerm(squares),
            "opacity": LossTerm(squares, 0.1, "opacity", "mask", {"mask": "cut_out"}),
        },
        "metrics": {"psnr": MetricTerm(metrics.psnr, in_training=True)},
        "optimizer": partial(torch.optim.Adam, lr=rate, eps=1e-15),
    }


def nerf() -> NeRF:
    encoding = HashGrid(levels=4, features=2, log2_table_size=12, coarsest=4, finest=24)
    field = GridField(encoding, SphericalHarmonics(2), width=16)
    return NeRF(OccupancyRenderer(field, cells=24, steps_across=48, refresh_every=8, empty_from=40), **parts(0.02))


def volume() -> Volume:
    grid = VolumeGrid((12, 24), empty_below=0.01)
    made = parts(0.3)
    made["losses"]["roughness"] = LossTerm(torch.nn.Identity(), 1e-4, "roughness", None)
    return Volume(grid, refine_at=[30], look_every=10, look_from=40, **made)


def task(name: str) -> Task:
    """The task as a run with seed 0 begins it."""
    torch.manual_seed(0)
    return {"nerf": nerf, "volume": volume}[name]()


def placed(name: str, scene: Scene) -> Task:
    """The task before its first step."""
    untrained = task(name)
    (untrained.renderer if isinstance(untrained, NeRF) else untrained.volume).place(scene)
    return untrained


def fit(toy: Task, scene: Scene, steps: int, **settings: Any) -> Trainer:
    silent = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)
    checkpoint = settings.pop("ckpt_path", None)
    trainer = Trainer(max_steps=steps, max_epochs=-1, accelerator="cpu", limit_val_batches=0, **(silent | settings))
    trainer.fit(toy, datamodule=views(scene), ckpt_path=checkpoint)
    return trainer


def held_out(toy: Task, scene: Scene) -> float:
    """Mean PSNR of the test views in dB."""
    data = views(scene)
    data.setup("test")
    scores = [metrics.psnr(toy.observe(view).rgb, view.rgb) for view in data.test_dataloader()]
    return float(torch.stack(scores).mean())


def assert_equal(first: Task, second: Task) -> None:
    states = first.state_dict(), second.state_dict()
    assert states[0].keys() == states[1].keys()
    different = [name for name, tensor in states[0].items() if not torch.equal(tensor, states[1][name])]
    assert not different


@pytest.fixture(scope="module")
def fitted(scene: Scene) -> Callable[[str], Task]:
    """Each task after 80 steps, fitted once."""
    made: dict[str, Task] = {}

    def after(name: str) -> Task:
        if name not in made:
            made[name] = task(name)
            fit(made[name], scene, 80)
        return made[name]

    return after


@pytest.mark.parametrize("name", TASKS)
def test_a_ball_is_learned_from_its_views(name: str, scene: Scene, fitted: Callable[[str], Task]) -> None:
    before, after = held_out(placed(name, scene), scene), held_out(fitted(name), scene)
    least = {"nerf": 26, "volume": 31}[name]  # 28.8 and 33.6 dB; before, a grey ball: 16.5 and 17.1
    assert after > least > before + 9


@pytest.mark.parametrize("name", TASKS)
def test_what_is_learned_is_the_ball(name: str, scene: Scene, fitted: Callable[[str], Task]) -> None:
    """Opaque within, nothing without, and in the colours of its normals where it is seen."""
    ball = fitted(name).eval()
    assert isinstance(ball, RadianceScene)
    torch.testing.assert_close(ball.box, scene.box)
    outward = torch.nn.functional.normalize(torch.randn(300, 3), dim=1)
    with torch.no_grad():
        beyond = ball.opacity_at(1.35 * RADIUS * outward, 0.05)
        through = sum(ball.opacity_at(share * RADIUS * outward, 0.1) for share in (0.75, 0.85, 0.95))
        color = ball.color_at(0.97 * RADIUS * outward, -outward)
    assert float(beyond.mean()) < 0.02
    assert float(through.median()) > 0.5
    assert float((color - (outward / 2 + 0.5)).abs().median()) < 0.1


def test_space_is_found_within_the_hull(scene: Scene, fitted: Callable[[str], Task]) -> None:
    """The hull has cells to spare about the ball."""
    occupied, hull = (ball.renderer.occupied for ball in (fitted("nerf"), placed("nerf", scene)))
    assert not (occupied & ~hull).any()
    assert 0.1 < float(occupied.sum() / hull.sum()) < 0.98


def test_a_volume_looks_for_space_when_it_was_told(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    toy, looks = task("volume"), []
    monkeypatch.setattr(toy.volume, "look_for_space", lambda: looks.append(toy.global_step))
    fit(toy, scene, 65)
    assert looks == [40, 50, 60]


def test_voxels_become_finer_on_the_way(fitted: Callable[[str], Task]) -> None:
    ball = fitted("volume")
    assert int(ball.volume.level) == 1
    assert max(ball.volume.grid.shape) == 24


@pytest.mark.parametrize("name", TASKS)
def test_the_same_seed_gives_the_same_weights(name: str, scene: Scene) -> None:
    first = task(name)
    fit(first, scene, 12)
    second = task(name)
    fit(second, scene, 12)
    assert_equal(first, second)


@pytest.mark.parametrize("name", TASKS)
def test_a_resumed_fit_ends_as_an_uninterrupted_one(name: str, scene: Scene, tmp_path: Path) -> None:
    """45 of 60 steps are past a finer level and a look for space."""
    whole = task(name)
    fit(whole, scene, 60)
    trainer = fit(task(name), scene, 45, callbacks=[RandomState()])
    trainer.save_checkpoint(tmp_path / "broken.ckpt")
    resumed = task(name)
    again = fit(resumed, scene, 60, ckpt_path=tmp_path / "broken.ckpt", callbacks=[RandomState()])
    assert again.global_step == 60
    assert_equal(whole, resumed)


@pytest.mark.parametrize("name", TASKS)
def test_a_time_limit_ends_the_fit(name: str, scene: Scene) -> None:
    trainer = fit(task(name), scene, 1_000_000, max_time={"seconds": 1})
    assert 0 < trainer.global_step < 5_000


@pytest.mark.parametrize("name", TASKS)
def test_the_score_is_watched_in_training(name: str, scene: Scene) -> None:
    trainer = fit(task(name), scene, 2)
    assert {"train/loss", "train/psnr", "train/loss_opacity"} <= set(trainer.callback_metrics)


@pytest.mark.parametrize("name", TASKS)
def test_a_step_stays_where_its_batch_lies(far, name: str, scene: Scene) -> None:  # noqa: F811
    toy, data = placed(name, scene), views(scene)
    data.setup("fit")
    batch, view = next(iter(data.train_dataloader())).to(far), data.caster.view(scene.test, 0).to(far)
    for module in toy.modules():
        for key, buffer in module._buffers.items():
            module._buffers[key] = buffer.to(far)
        for key, parameter in module._parameters.items():
            module._parameters[key] = None if parameter is None else nn.Parameter(parameter.detach().to(far))
    prediction = toy.predict(batch)
    toy.objective(prediction, batch)[0].backward()
    reached = toy.parameters() if isinstance(toy, NeRF) else [toy.volume.grid]
    assert all(isinstance(parameter.grad, Far) for parameter in reached)
    assert all(isinstance(panel, Far) for panel in toy.show(view).values())
    points = torch.zeros(3, 3).to(far)
    assert isinstance(toy.opacity_at(points, 0.1), Far)
    assert isinstance(toy.color_at(points, points + 0.5), Far)


def test_roughness_is_measured_now_and_then_and_counts_for_the_steps_between(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    toy = Volume(VolumeGrid((8,)), smooth_every=3, **parts(0.1))
    toy.volume.place(scene)
    monkeypatch.setattr(toy.volume, "roughness", lambda: torch.tensor(0.5))
    batch = RayCaster(scene.box, None).pixels(scene.train, torch.arange(5))
    found = []
    for step in range(7):
        monkeypatch.setattr(Volume, "global_step", step)
        found.append(float(toy.train().predict(batch).roughness))
        assert float(toy.eval().predict(batch).roughness) == 0
    assert found == [1.5, 0, 0, 1.5, 0, 0, 1.5]


@pytest.mark.parametrize("wrong", [[], [10, 20], [20, 10, 30]])
def test_levels_begin_at_steps_of_their_own(wrong: list[int]) -> None:
    with pytest.raises(ValueError, match=r"module\.refine_at: 2 levels begin at 1 rising steps"):
        Volume(VolumeGrid((8, 12)), refine_at=wrong, **parts(0.1))


@pytest.mark.parametrize("wrong", ["look_every", "smooth_every"])
def test_intervals_are_at_least_one(wrong: str) -> None:
    with pytest.raises(ValueError, match=rf"module\.{wrong}.* must be at least 1"):
        Volume(VolumeGrid((8,)), **{wrong: 0}, **parts(0.1))
