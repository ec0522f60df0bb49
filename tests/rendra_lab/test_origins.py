"""A configuration file from elsewhere describes a run; it commands nothing."""

from collections.abc import Callable
from pathlib import Path

import pytest

Program = Callable[..., tuple[int, str, str]]

_HYDRA = "# @package _global_\ndefaults:\n  - override /task: localize\nhydra:\n  "
PLANTED = {
    "a part": ("# @package _global_\ndata:\n  _target_: os.system\n  command: touch marker\n", "data"),
    "callbacks": (
        _HYDRA + "callbacks: {x: {_target_: os.system, command: touch marker}}\n",
        "hydra.callbacks.x._target_",
    ),
    "logging": (
        _HYDRA + "job_logging: {handlers: {x: {(): os.system, command: touch marker}}}\n",
        "hydra.job_logging.handlers.x.()",
    ),
    "hydra logging": (
        _HYDRA + "hydra_logging: {handlers: {x: {class: logging.FileHandler, filename: marker}}}\n",
        "hydra.hydra_logging.handlers.x.class",
    ),
    "launcher": (_HYDRA + "launcher: {_target_: os.system, command: touch marker}\n", "hydra.launcher._target_"),
    "sweeper": (_HYDRA + "sweeper: {_target_: os.system, command: touch marker}\n", "hydra.sweeper._target_"),
    "setup of a cluster": (_HYDRA + "launcher: {setup: [touch marker]}\n", "hydra.launcher.setup"),
    "environment": (_HYDRA + "job: {env_set: {PYTHONPATH: marker}}\n", "hydra.job.env_set.PYTHONPATH"),
    "run folder": (_HYDRA + "run: {dir: marker}\n", "hydra.run.dir"),
    "sweep folder": (_HYDRA + "sweep: {dir: marker}\n", "hydra.sweep.dir"),
    "output root": ("# @package _global_\noutput_root: marker\n", "output_root"),
    "a package": (
        "# @package hydra.callbacks\nx: {_target_: os.system, command: touch marker}\n",
        "hydra.callbacks.x",
    ),
}


def planted(folder: Path, text: str, group: str = "experiment") -> Path:
    file = folder / "elsewhere" / group / "planted.yaml"
    file.parent.mkdir(parents=True)
    file.write_text(text)
    return folder / "elsewhere"


@pytest.mark.parametrize("place", PLANTED)
def test_a_file_from_elsewhere_commands_nothing(place: str, program: Program, tmp_path: Path) -> None:
    text, key = PLANTED[place]
    code, _, err = program("train.py", "--config-dir", str(planted(tmp_path, text)), "experiment=planted")
    assert (code, err.count("\n")) == (2, 1), err
    assert key in err
    assert not list(tmp_path.rglob("marker"))


def test_a_launcher_from_elsewhere_is_not_started(program: Program, tmp_path: Path) -> None:
    folder = planted(tmp_path, "_target_: os.system\ncommand: touch marker\n", "hydra/launcher")
    search = f"hydra.searchpath=[file://{folder}]"
    code, _, err = program("train.py", "-m", search, "task=localize", "hydra/launcher=planted", "seed=1,2")
    assert (code, err.count("\n")) == (2, 1), err
    assert "hydra.launcher._target_ may be set on the command line or in conf/" in err
    assert not list(tmp_path.rglob("marker"))


def test_a_primary_configuration_from_elsewhere_is_a_file_like_any_other(program: Program, tmp_path: Path) -> None:
    (tmp_path / "train.yaml").write_text("hydra:\n  callbacks: {x: {_target_: os.system, command: touch marker}}\n")
    code, _, err = program("train.py", "--config-path", str(tmp_path))
    assert (code, err.count("\n")) == (2, 1), err
    assert "hydra.callbacks.x._target_" in err
    assert not list(tmp_path.rglob("marker"))


def test_a_pickled_rerun_is_not_read(program: Program, tmp_path: Path) -> None:
    (tmp_path / "job.pickle").write_bytes(b"cos\nsystem\n(S'touch marker'\ntR.")
    for flag in ("--experimental-rerun", "--experimental"):
        code, _, err = program("train.py", flag, str(tmp_path / "job.pickle"))
        assert (code, err.count("\n")) == (2, 1), err
        assert "reads a pickle" in err
    assert not (tmp_path / "marker").exists()


def test_the_command_line_and_trusted_folders_are_the_users_will(
    train: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert train("debug=fast", "callbacks=[timer]", "hydra.run.dir=mine")[0] == 0
    assert (tmp_path / "mine" / "metrics.json").is_file()
    text = "# @package _global_\nhydra:\n  run: {dir: theirs}\n"
    folder = planted(tmp_path, text)
    monkeypatch.setenv("RENDRA_LAB_CONFIGS", str(folder))
    arguments = ("--config-dir", str(folder), "experiment=planted", "debug=fast", "callbacks=[timer]")
    code, _, err = train(*arguments)
    assert code == 0, err
    assert (tmp_path / "theirs" / "metrics.json").is_file()


@pytest.mark.parametrize("script", ["render.py mesh", "render.py camera", "generate_data.py data"])
def test_scripts_call_nothing_else_either(script: str, program: Program, tmp_path: Path) -> None:
    name, part = script.split()
    settings = [f"{part}._target_=os.system", f"+{part}.command=touch marker"]
    settings += ["output=scene"] if name == "generate_data.py" else ["size=16"]
    code, _, err = program(f"scripts/{name}", *settings)
    assert (code, err.count("\n")) == (2, 1), err
    assert f"{part}: a configuration may not call 'os.system'" in err
    assert not list(tmp_path.rglob("marker"))
