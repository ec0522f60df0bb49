"""The name of a run's folder: the time, or what all processes agree on that a launcher has started.

Imported before anything else runs: stays light.
"""

from __future__ import annotations

import os

from omegaconf import OmegaConf


def run_name(time: str) -> str:
    """`time`, unless torchrun or srun started this process as one of several: then what the launcher calls them."""
    if "TORCHELASTIC_RUN_ID" in os.environ:
        word = os.environ["TORCHELASTIC_RUN_ID"]
        return (
            f"torchrun_{word}" if word != "none" else f"torchrun_{os.getppid()}_{os.environ.get('MASTER_PORT', '')}"
        )
    if int(os.environ.get("SLURM_STEP_NUM_TASKS", "1")) > 1 and "SLURM_PROCID" in os.environ:
        parts = (os.environ.get(f"SLURM_{name}", "0") for name in ("JOB_ID", "STEP_ID", "RESTART_COUNT"))
        return f"slurm_{'_'.join(parts)}"
    return time


OmegaConf.register_new_resolver("run_name", run_name, replace=True)
