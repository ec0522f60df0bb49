"""Saves checkpoints in a tight loop until it is killed: started once, forks a saver for every line on its stdin.

A line is a folder and the step to begin after. A saver does what a run with ModelCheckpoint(save_last=True) does:
`step_<n>.ckpt`, the previous one removed, `last.ckpt`; then it notes the step in `acknowledged`.
"""

import itertools
import os
import sys
from pathlib import Path
from typing import Any

import torch

from rendra_lab.checkpoint_archive import write_checkpoint
from rendra_lab.durable import sweep_leftovers


def state_of(step: int) -> dict[str, Any]:
    """A state whose every tensor says its step."""
    weights = {name: torch.full((size,), float(step)) for name, size in (("small", 7), ("large", 100_000))}
    return {"global_step": step, "state_dict": weights, "optimizer_states": [{"moment": torch.full((50_000,), step)}]}


def save_for_ever(folder: Path, begun_after: int) -> None:
    """One run, which only a signal ends."""
    sweep_leftovers(folder)
    noted = os.open(folder.parent / "acknowledged", os.O_WRONLY | os.O_CREAT)
    previous = None
    for step in itertools.count(begun_after + 1):
        state = state_of(step)
        path = folder / f"step_{step:06d}.ckpt"
        write_checkpoint(path, state)
        if previous is not None:
            previous.unlink()
        previous = path
        write_checkpoint(folder / "last.ckpt", state)
        os.pwrite(noted, b"%010d" % step, 0)


def main() -> None:
    torch.set_num_threads(1)
    for line in sys.stdin:
        folder, _, step = line.strip().rpartition(" ")
        child = os.fork()
        if child == 0:
            save_for_ever(Path(folder), int(step))
        print(child, flush=True)
        os.waitpid(child, 0)
        print("gone", flush=True)


if __name__ == "__main__":
    main()
