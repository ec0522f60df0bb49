"""Train, fit or reconstruct: `python train.py task=pose`; `python train.py --help` lists what there is."""

if __name__ == "__main__":  # first of all: what follows takes a second to load
    from rendra_lab.signals import leave_at_once

    leave_at_once()

from typing import Any

import hydra

from rendra_lab.front_door import guarded


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
def main(cfg: Any) -> float | None:
    """Run one configuration; heavy imports wait until here, so that `--help` and typos answer at once."""
    from rendra_lab.experiment import run

    return run(cfg)


if __name__ == "__main__":
    guarded(main, __file__, config_path="conf", config_name="train")
