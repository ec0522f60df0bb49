"""Commands with one mistake each: one line that names it, exit code 2, no traceback."""

import copy
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from command_runner import Answer, Command, run_commands
from omegaconf import OmegaConf

from rendra_lab.errors import UserError
from rendra_lab.settings import check_run, hints_of
from rendra_lab.targets import check_targets

CONF = Path(__file__).parents[2] / "conf"
CHOICES = [
    f"{group}={path.stem}" for group in ("task", "experiment") for path in sorted((CONF / group).glob("*.yaml"))
]

# What is wrong, and what the line says of it. The command is train.py unless its first word ends in .py.
FAST = {
    # words
    "los=[chamfer]": "there is no setting 'los'; did you mean loss?",
    "tasks=pose": "there is no setting 'tasks'; did you mean task?",
    "task=poze": "there is no task 'poze'; did you mean pose?",
    "task=localize optimizer=sdg": "there is no optimizer 'sdg'; did you mean sgd?",
    "task=localize scheduler=cosin": "there is no scheduler 'cosin'; did you mean cosine?",
    "task=localize loss=[chamfr]": "there is no loss 'chamfr'; did you mean chamfer?",
    "task=localize metric=[displacment]": "there is no metric 'displacment'; did you mean displacement?",
    "task=localize logger=abc": "there is no logger 'abc'; there are: csv, default, tensorboard",
    "experiment=pose_bok_texture": "there is no experiment 'pose_bok_texture'; did you mean pose_book_texture?",
    "debug=fastt": "there is no debug 'fastt'; did you mean fast?",
    "task=pose hydra/launcher=abc": "there is no hydra/launcher 'abc'; there are: basic",
    "task=localize callbacks.images.every_n_step=1": "did you mean callbacks.images.every_n_steps?",
    "task=localize +optimizer.lr=1": "there is a setting optimizer.lr already: optimizer.lr=... without the +",
    "task=localize ~optimizer.lrr": "there is no setting 'optimizer.lrr'; did you mean optimizer.lr?",
    "task=localize callbacks=null": "callbacks must be one of its choices, got null",
    # the command line itself
    "task=localize data.paths=[a": "cannot read 'data.paths=[a': brackets and quotes come in pairs",
    'task=localize optimizer.lr="1': "cannot read 'optimizer.lr=\"1'",
    "optimizer.lr": "cannot read 'optimizer.lr': settings are key=value",
    "task nerf": "cannot read 'task': settings are key=value",
    "optimizer.lr=1,2": "Ambiguous value for argument 'optimizer.lr=1,2'",
    "task=localize optimizer.lr=${nothing}": "optimizer.lr: Interpolation key 'nothing' not found",
    "task=localize seed=${threads} threads=${seed}": "Recursive interpolation detected",
    "-m task=localize optimizer=sgd,adamm,adam": "there is no optimizer 'adamm'; did you mean adam?",
    "-m task=localize optimizer.lr=range(1": "cannot read 'optimizer.lr=range(1'",
    "task=localize -m seed=1,2": "-m stands before all settings",
    "--foo": "unrecognized arguments: --foo; settings are key=value; see --help",
    "--config-dir /nowhere": "Additional config directory '/nowhere' not found",
    "--config-name nonsense": "Cannot find primary config 'nonsense'",
    "--config-dir broken experiment=no_yaml": "broken/experiment/no_yaml.yaml",
    "--config-dir broken experiment=typo": "there is no setting 'taks'; did you mean task?",
    # values
    "task=localize threads=two": "threads must be a whole number or null, got 'two'",
    "task=localize seed=[1]": "seed must be a whole number, got [1]",
    "task=localize optimizer.momentum=-1": "optimizer.momentum: Invalid momentum value: -1",
    "task=localize optimizer.lr=nan": "optimizer.lr must be a number, got nan",
    "task=localize trainer.max_time=abc": "trainer: `Timer(duration='abc')` is not a valid duration",
    "task=localize trainer.devices=0": "trainer: `Trainer(devices=0)` value is not a valid input",
    "task=localize loss.chamfer=5": "loss.chamfer must be null or have a _target_, got 5",
    "task=localize data.paths=[/nowhere.obj]": "data.paths: there is no mesh file /nowhere.obj",
    "task=localize data.paths=[folder]": "data.paths: there is no mesh file folder (it is a folder)",
    # scripts
    "scripts/export.py rnu=x": "export.py: ",
    "scripts/export.py run=/nowhere": "/nowhere is not the folder of a run",
    "scripts/render.py camera.elv=3": "there is no setting 'camera.elv'; did you mean camera.elev?",
    "scripts/generate_data.py": "output needs a value: output=...",
}
_SMALL = "data.image_size=16 data.counts=[4,1,1] data.antialias=1"
SLOW = {
    "task=nerf sampler.cels=1": "there is no setting 'sampler.cels'; did you mean sampler.cells?",
    "task=pose scene.image_siz=3": "there is no setting 'scene.image_siz'; did you mean scene.image_size?",
    "task=localize trainer.max_stps=3": "did you mean trainer.max_steps?",
    "task=localize loss.chamfer.wieght=1": "did you mean loss.chamfer.weight?",
    "task=localize optimizer.nesterov=true": "what optimizer names takes it: +optimizer.nesterov=...",
    "task=localize threads=0": "threads must be a whole number from 1 to 4096 or null, got 0",
    "task=localize optimizer.lr=[1]": "optimizer.lr must be a number, got [1]",
    "task=localize optimizer.lr=true": "optimizer.lr must be a number, got true",
    "task=localize loss=[]": "a task needs at least one loss",
    "task=localize test=nonsense": "test must be last or best or null, got 'nonsense'",
    "task=localize ckpt_path=/nowhere": "ckpt_path: there is neither a checkpoint nor a run folder at /nowhere",
    "task=localize output_root=a_file/x": "a_file",
    "scripts/evaluate.py /nowhere": "/nowhere is not the folder of a run",
    "scripts/render.py run=folder": "folder is not the folder of a run",
    "scripts/convert.py /nowhere.obj a.ply": "there is no file /nowhere.obj",
    "scripts/inspect.py folder": "there is no file folder (it is a folder)",
    "scripts/benchmark.py nonsense": "nonsense",
    f"task=nerf {_SMALL} data.image_size=0": "data.image_size must be one side or [height,width]",
    f"task=nerf {_SMALL} data.counts=[0,0,0]": "data.counts are whole numbers of training (at least 1)",
    f"task=nerf {_SMALL} data.distance=-1": "data.distance must be positive, got -1",
    f"task=nerf {_SMALL} data.views=circle": "data.views must be one of sphere, ring, forward",
    f"task=nerf {_SMALL} sampler.cells=-3": "sampler",
    f"task=nerf {_SMALL} field.directions.bands=9": "field.directions.bands must be a whole number from 1 to 5",
    f"task=nerf {_SMALL} field.encoding.finest=2": "expected 1 <= coarsest <= finest",
    f"task=nerf {_SMALL} mesh.path=/nowhere.obj": "data.mesh: there is no mesh file /nowhere.obj",
    f"task=nerf {_SMALL} mesh.path=folder": "there is no mesh file folder (it is a folder)",
    f"task=nerf {_SMALL} mesh.breed=abc": "unknown breed 'abc'; there are holstein",
    f"task=nerf {_SMALL} optimizer.eps=-1": "optimizer.eps: Invalid epsilon value: -1",
    f"task=nerf {_SMALL} scheduler.final_factor=0": "scheduler: final_factor must be above 0, got 0",
    f"task=nerf {_SMALL} callbacks.turntable.trajectory=abc": "callbacks.turntable.trajectory must be auto, orbit",
    "task=nerf data=nerf_blender": "data.path needs a value: data.path=...",
    "task=nerf data=nerf_blender data.path=/nowhere": "/nowhere",
    "task=nerf data=colmap data.path=a_file": "a_file",
    "task=nerf data=llff data.path=folder": "folder",
    "task=nerf data=transforms data.path=5": "data.path must be text",
    "task=nerf sampler=stratified sampler.samples=-1": "sampler.samples must be a whole number of at least 2, got -1",
    "task=nerf sampler=stratified field=mlp_original field.skip=99": "field.skip must be null or the index of",
    f"task=volume {_SMALL} volume.voxels=[0]": "volume.voxels are numbers of voxels, at least 2",
    f"task=volume {_SMALL} volume.steps_per_voxel=0": "volume.steps_per_voxel must be a number above 0, got 0",
    f"task=volume {_SMALL} module.refine_at=[5,2]": "module.refine_at: ",
    "task=mesh_fit module.samples=0": "module.samples must be at least 1, or null, got 0",
    "task=mesh_fit module.views.up=[0,0]": "views.up must be a direction such as [0,0,1]",
    "task=mesh_fit surface.levels=[9]": "surface.levels must be at most 7, got [9]",
    "task=mesh_fit surface.start=cube": "surface.start must be sphere or ellipsoid, got 'cube'",
    "task=mesh_fit data.path=/nowhere.ply": "data.path: there is no file",
    "task=mesh_fit data.path=empty.ply": "empty.ply",
    "task=mesh_fit +optimizer.betas=[2,2]": "optimizer: betas must lie in [0, 1), got [2, 2]",
    "task=mesh_fit scheduler.knots=[[5,1],[1,1]]": "scheduler: the steps of a schedule must not decrease",
    "task=pose mesh.path=/nowhere.obj": "there is no mesh file /nowhere.obj",
    "task=pose data=photo_view": "data.image needs a value: data.image=...",
    "task=pose data=photo_view data.image=/nowhere.png": "/nowhere.png",
    "task=pose init.position=[1,2]": "a start position has three coordinates",
    "task=pose solver=levenberg_marquardt optimizer.difference=[0,1]": "optimizer: difference goes from a wide",
    "task=pose scene.fov_deg=190": "fov_deg must lie between 0 and 180 degrees, got 190",
    "task=pose loss.silhouette.prediction=nothing": "LossTerm 'silhouette': the prediction",
    "task=pose loss.silhouette.target=nothing": "LossTerm 'silhouette': the batch",
    "task=pose_track optimizer.difference=[1]": "optimizer",
    "scripts/render.py size=0": "size, width and height must be whole pixels from 1 to 8192, got 0 x 0",
    "scripts/render.py antialias=0": "antialias must be a whole number from 1 to 8, got 0",
    "scripts/render.py background=purplish": "background must be",
    "scripts/render.py turntable=gif fps=0": "fps must lie above 0, at most 1000, got 0",
    "scripts/render.py turntable=gif fps=fast": "fps must lie above 0, at most 1000, got 'fast'",
    "scripts/render.py turntable=avi": "turntable must be null, gif or mp4, got 'avi'",
    "scripts/render.py size=16 output=a.xyz": "output must end in .png",
    "scripts/generate_data.py output=o format=abc": "format must be one of",
    "scripts/generate_data.py output=o data.counts=[0,0,0]": "data.counts are whole numbers",
}


def answers_to(mistakes: dict[str, str], folder: Path) -> dict[str, Answer]:
    (folder / "folder").mkdir()
    (folder / "a_file").touch()
    (folder / "empty.ply").touch()
    broken = folder / "broken" / "experiment"
    broken.mkdir(parents=True)
    (broken / "no_yaml.yaml").write_text("# @package _global_\nseed: [1\n")
    (broken / "typo.yaml").write_text("# @package _global_\ndefaults:\n  - override /taks: pose\n")
    words = [text.split(" ") for text in mistakes]
    split = [(line[0], line[1:]) if line[0].endswith(".py") else ("train.py", line) for line in words]
    commands = [*(Command(*each) for each in split), Command("train.py", ["los=[a]"], {"HYDRA_FULL_ERROR": "1"})]
    return dict(zip([*mistakes, "verbose"], run_commands(commands, folder), strict=True))


@pytest.fixture(scope="module")
def fast_answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Answer]:
    return answers_to(FAST, tmp_path_factory.mktemp("fast"))


@pytest.fixture(scope="module")
def slow_answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Answer]:
    return answers_to(SLOW, tmp_path_factory.mktemp("slow"))


def assert_one_line(answer: Answer, words: str) -> None:
    lines = answer.err.splitlines()
    assert words in answer.err, answer.err[-1000:]
    assert "Traceback" not in answer.err
    assert answer.code == 2
    assert len(lines) == 1 or lines[0].startswith("usage: "), answer.err


@pytest.mark.parametrize("mistake", FAST)
def test_a_mistake_is_told_in_one_line(mistake: str, fast_answers: dict[str, Answer]) -> None:
    assert_one_line(fast_answers[mistake], FAST[mistake])


@pytest.mark.slow
@pytest.mark.parametrize("mistake", SLOW)
def test_a_mistake_in_a_task_is_told_in_one_line(mistake: str, slow_answers: dict[str, Answer]) -> None:
    assert_one_line(slow_answers[mistake], SLOW[mistake])


def test_a_traceback_can_be_asked_for(fast_answers: dict[str, Answer]) -> None:
    assert fast_answers["verbose"].code == 1
    assert "Traceback" in fast_answers["verbose"].err


def knobs(node: Any, key: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """The place and the target of every number that a part takes, switches among them."""
    for name, value in node.items() if isinstance(node, dict) else ():
        if isinstance(value, int | float) and "_target_" in node and not name.startswith("_"):
            yield (*key, name), node["_target_"]
        yield from knobs(value, (*key, name))


# Where Lightning takes words, and what passes its arguments on to whatever is named.
_TAKES_WORDS = {"devices", "val_check_interval"}
_PASSES_ON = {"rendra_lab.data.meshes.load_mesh"}


@pytest.mark.parametrize("choice", CHOICES)
def test_every_knob_refuses_what_is_no_number(choice: str, compose: Callable[..., Any], tmp_path: Path) -> None:
    tree = OmegaConf.to_container(compose(tmp_path / "task" / "run", choice), resolve=True)
    assert isinstance(tree, dict)
    check_run(tree)
    check_targets(tree)
    found = list(knobs(tree))
    assert len(found) > 10
    for key, target in found:
        if target in _PASSES_ON or key[-1] in _TAKES_WORDS:
            continue
        node = tree
        for name in key[:-1]:
            node = node[name]
        for wrong in ("abc", math.nan, math.inf, {"a": 1}):
            mutated = {**copy.copy(node), key[-1]: wrong}
            with pytest.raises(UserError, match=rf"{'.'.join(key)} must be "):
                check_targets(mutated, ".".join(key[:-1]))


def test_ranges_stand_in_annotations() -> None:
    from rendra_lab.callbacks import ImageLogger

    assert str(hints_of(ImageLogger)["every_n_steps"].__metadata__[0]) == "of at least 0"
    check_targets({"_target_": "rendra_lab.callbacks.ImageLogger", "folder": "x", "every_n_steps": 0}, "images")
    with pytest.raises(UserError, match=r"images\.every_n_steps must be a whole number of at least 0, got -1"):
        check_targets({"_target_": "rendra_lab.callbacks.ImageLogger", "folder": "x", "every_n_steps": -1}, "images")
