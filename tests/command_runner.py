"""Runs many commands quickly, each in a fork of one process that has imported everything: `run_commands`."""

from __future__ import annotations

import json
import os
import runpy
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
LONGEST_S = 60


@dataclass(frozen=True)
class Command:
    """A program of the repository, its arguments, and what its environment has besides."""

    script: str
    arguments: list[str]
    environment: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Answer:
    """What a command ended with; -14 is the code of one that took too long."""

    code: int
    out: str
    err: str
    seconds: float


def run_commands(commands: list[Command], folder: Path) -> list[Answer]:
    """Runs commands one after another in `folder`, none of which sees what another one left in memory."""
    folder.mkdir(parents=True, exist_ok=True)
    request = json.dumps([asdict(command) for command in commands])
    environment = {key: value for key, value in os.environ.items() if key != "HYDRA_FULL_ERROR"}
    environment["PYTHONPATH"] = str(REPOSITORY / "tests")
    done = subprocess.run(
        [sys.executable, __file__],
        input=request,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=LONGEST_S * (1 + len(commands)),
    )
    assert done.returncode == 0, done.stderr
    return [Answer(**answer) for answer in json.loads(done.stdout)]


def serve() -> None:
    """Answers the commands on stdin as JSON on stdout."""
    commands = [Command(**item) for item in json.load(sys.stdin)]
    import rendra_lab.experiment
    import rendra_lab.tasks.mesh_fit.task
    import rendra_lab.tasks.nerf.task
    import rendra_lab.tasks.pose.task  # noqa: F401

    json.dump([asdict(_in_fork(command)) for command in commands], sys.stdout)


def _in_fork(command: Command) -> Answer:
    began = time.perf_counter()
    child = os.fork()
    if child == 0:
        _become(command)
    _, status = os.waitpid(child, 0)
    said = [Path(name).read_text(errors="replace") for name in ("said.out", "said.err")]
    return Answer(os.waitstatus_to_exitcode(status), *said, time.perf_counter() - began)


def _become(command: Command) -> None:
    import signal
    import traceback

    signal.alarm(LONGEST_S)
    for stream, name in ((1, "said.out"), (2, "said.err")):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
    os.environ.update(command.environment)
    path = REPOSITORY / command.script
    sys.argv = [str(path), *command.arguments]
    code: object = 0
    try:
        runpy.run_path(str(path), run_name="__main__")
    except SystemExit as end:
        code = end.code
    except BaseException:  # as the interpreter does
        traceback.print_exc()
        code = 1
    if isinstance(code, str):
        sys.stderr.write(f"{code}\n")
        code = 1
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(int(code or 0))  # type: ignore[call-overload]


if __name__ == "__main__":
    serve()
