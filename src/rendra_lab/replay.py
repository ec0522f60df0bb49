"""Makes a step again that a `NanGuard` has kept."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lightning.pytorch import Trainer
from omegaconf import DictConfig, OmegaConf

from rendra_lab import nan_evidence
from rendra_lab.checkpoints import checkpoints_are_data
from rendra_lab.errors import UserError
from rendra_lab.experiment import build
from rendra_lab.nan_guard import NanGuard, NotFiniteError


def replay(folder: Path) -> str | None:
    """Builds the run of a kept step anew and makes that step; nothing is written.

    Args:
        folder: of the step, see `nan_evidence`.

    Returns:
        What is not finite, and None if everything is.

    Raises:
        UserError: the folder holds no such step.
    """
    if not (folder / nan_evidence.STATE).is_file() or not (folder / nan_evidence.CONFIG).is_file():
        raise UserError(f"{folder} holds no kept step: it needs {nan_evidence.STATE} and {nan_evidence.CONFIG}")
    cfg = OmegaConf.load(folder / nan_evidence.CONFIG)
    if not isinstance(cfg, DictConfig) or "trainer" not in cfg:
        raise UserError(f"{folder / nan_evidence.CONFIG} is not the configuration of a run")
    cfg.trainer = {"_target_": "lightning.pytorch.Trainer", "accelerator": cfg.trainer.accelerator, "devices": 1}
    experiment = build(cfg, observers=False)
    batch: Any = nan_evidence.read_batch(folder)
    if batch is not None:
        experiment.data.train_dataloader = lambda: nan_evidence.OneBatch(batch)  # type: ignore[method-assign]
    trainer = Trainer(
        accelerator=cfg.trainer.accelerator,
        devices=1,
        callbacks=[nan_evidence.SameStart(folder), NanGuard("stop")],
        max_epochs=-1,
        logger=False,
        limit_val_batches=0,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    try:
        with checkpoints_are_data():
            trainer.fit(experiment.task, datamodule=experiment.data, ckpt_path=str(folder / nan_evidence.STATE))
    except NotFiniteError as error:
        return str(error)
    return None
