"""A program for sweeps without torch: each job keeps a diary, naps, fails or is told to."""

import contextlib
import os
import time
from pathlib import Path
from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="sweep_conf", config_name="light")
def main(cfg: Any) -> float:
    diary = Path(cfg.output_root) / "diary.txt"
    write(diary, f"start {cfg.optimizer.lr} {os.getpid()} {cfg.threads}")
    time.sleep(cfg.nap)
    with contextlib.suppress(FileNotFoundError):
        (Path(cfg.output_root) / f"doom {cfg.optimizer.lr}").unlink()
        raise RuntimeError("broke as told")
    write(Path(cfg.run_dir) / "mark", str(cfg.optimizer.lr))
    write(diary, f"end {cfg.optimizer.lr} {os.getpid()} {cfg.threads}")
    return (cfg.optimizer.lr - 0.3) ** 2


def write(path: Path, line: str) -> None:
    with path.open("a") as file:
        file.write(f"{line}\n")


if __name__ == "__main__":
    guarded(main, __file__, config_path="sweep_conf", config_name="light")
