"""NaN and infinities in losses and gradients: noticed before they reach the weights, kept, and stopped or left out.

The guard looks once before every update of an optimizer, at numbers that the step has made anyway: all losses and the
norm of all gradients are judged together, and one boolean is read from the device. A task whose objectives have
optimizers of their own makes all gradients before the first update (`AdversarialTask`): a step is left out whole.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from torch import Tensor
from torch.nn.utils import get_total_norm
from torch.optim import Optimizer

from rendra_lab import nan_evidence, report
from rendra_lab.base_task import BaseTask
from rendra_lab.errors import UserError
from rendra_lab.random_state import Streams, owned_generators
from rendra_lab.settings import Amount, Count, Positive

log = logging.getLogger(__name__)

POLICIES = ("stop", "skip")
_NAMED = 3  # of the things that are not finite, how many a message names


class NotFiniteError(ValueError):
    """A loss, a gradient or a weight became NaN or infinite."""


class NanGuard(Callback):
    """Watches over every update of the weights.

    What is not finite ends the fit, or the update is left out: weights and moments stay as they were, the learning
    rate's schedule and the count of steps go on. Either way the step is kept for inspection, see `nan_evidence`.
    Weights that are not finite are never saved.

    With a gradient scaler (16-bit training) only losses are judged: infinite gradients are how it finds its scale.
    An optimizer that follows something else than gradients, such as LevenbergMarquardt, must itself refuse them.

    Args:
        policy: stop or skip.
        folder: where the first steps of this kind are kept; None keeps none.
        patience: updates left out in a row that end the fit all the same.
        max_folders: how many steps are kept.
        max_batch_mb: largest batch that is kept, in MB of 10^6 bytes.

    Raises:
        UserError: a policy that there is not.
        NotFiniteError: during the fit.
    """

    def __init__(
        self,
        policy: str = "stop",
        folder: str | None = None,
        patience: Positive = 20,
        max_folders: Count = 3,
        max_batch_mb: Amount = 512.0,
    ) -> None:
        if policy not in POLICIES:
            raise UserError(f"on_nan must be {' or '.join(POLICIES)}, got {policy!r}")
        self.policy = policy
        self.folder = None if folder is None else Path(folder)
        self.patience = patience
        self.max_folders = max_folders
        self.max_batch_mb = max_batch_mb
        self.config = ""  # of the run as YAML, kept with a step
        self.skipped = 0
        self._in_a_row = 0
        self._batch: Any = None
        self._generators: dict[str, Any] = {}
        self._streams = Streams.now()
        self._collecting = False

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Finds what the fit draws random numbers from."""
        self._generators = owned_generators(trainer)

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Remembers what a step starts from; a reference to its batch, no copy."""
        self._batch = batch
        self._streams = Streams.now(self._generators)

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        """Judges losses and gradients; leaves the update out, or raises NotFiniteError."""
        losses = pl_module.step_losses if isinstance(pl_module, BaseTask) else {}
        gradients = {} if _scales(trainer) else dict(_gradients(pl_module))
        if _everywhere(trainer, _seem_finite(losses.values(), gradients.values())):
            self._in_a_row = 0
            return
        bad = [name for name, loss in losses.items() if not bool(loss.isfinite().all())]
        guilty = _first_rank(trainer, bool(bad))
        bad += [f"the gradient of {name}" for name, each in gradients.items() if not bool(each.isfinite().all())]
        if _everywhere(trainer, not bad):  # numbers so large that their sum is not: the optimizer's own business
            return
        self._react(trainer, bad, guilty)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Lets go of the batch, and counts what was left out."""
        self._batch = None
        if self.policy == "skip":
            pl_module.log("train/skipped_steps", float(self.skipped), rank_zero_only=True)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Refuses to save weights that are not finite: an update itself may have made them."""
        weights = {name: each.detach() for name, each in pl_module.named_parameters() if each.requires_grad}
        if self._collecting or _seem_finite((), weights.values()).item():
            return
        bad = [f"the weight {name}" for name, each in weights.items() if not bool(each.isfinite().all())]
        if bad:
            raise NotFiniteError(
                f"{_listed(bad)} not finite after step {trainer.global_step}, and not saved: the update before, of "
                "finite gradients, was too large; try a lower optimizer.lr"
            )

    def state_dict(self) -> dict[str, Any]:
        """For the checkpoint."""
        return {"skipped": self.skipped, "in_a_row": self._in_a_row}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """From a checkpoint."""
        self.skipped, self._in_a_row = state_dict["skipped"], state_dict["in_a_row"]

    def _react(self, trainer: Trainer, bad: list[str], guilty: int) -> None:
        step = trainer.global_step
        place = self._keep(trainer, step, bad, guilty)
        words = f"{_listed(bad) if bad else 'a loss of another process is'} not finite at step {step}"
        where = f"; kept in {report.short_path(place)}, whose README.txt says how to look at it" if place else ""
        if self.policy == "stop":
            raise NotFiniteError(f"{words}{where}; on_nan=skip leaves such steps out")
        self.skipped += 1
        self._in_a_row += 1
        if self._in_a_row >= self.patience:
            raise NotFiniteError(f"{words}, the last of {self._in_a_row} in a row{where}")
        if trainer.is_global_zero:
            log.warning("%s: left out%s", words, where)
        for optimizer in trainer.optimizers:
            for group in optimizer.param_groups:
                for parameter in group["params"]:
                    parameter.grad = None

    def _keep(self, trainer: Trainer, step: int, bad: list[str], guilty: int) -> Path | None:
        """The folder of this step; None where enough are kept."""
        if self.folder is None:
            return None
        place = self.folder / f"step_{step:06d}"
        full = place.exists() or len(list(self.folder.glob("step_*"))) >= self.max_folders
        if not _everywhere(trainer, not full):
            return None
        with self._evidence():
            trainer.save_checkpoint(place / nan_evidence.STATE)
        if trainer.global_rank == guilty:
            limit = int(1e6 * self.max_batch_mb)
            nan_evidence.write(place, step, bad, self._batch, self._streams, self.config, limit)
        return place

    @contextmanager
    def _evidence(self) -> Iterator[None]:
        """What is saved meanwhile is for inspection, not to go on from."""
        self._collecting = True
        try:
            yield
        finally:
            self._collecting = False


def _gradients(module: LightningModule) -> Iterator[tuple[str, Tensor]]:
    """What optimizers are about to use, by the names of the parameters."""
    groups = [group for optimizer in module.trainer.optimizers for group in optimizer.param_groups]
    own = {id(parameter) for group in groups for parameter in group["params"]}
    for name, parameter in module.named_parameters():
        if id(parameter) in own and parameter.grad is not None:
            gradient = parameter.grad
            yield name, gradient.coalesce().values() if gradient.is_sparse else gradient


def _seem_finite(scalars: Iterable[Tensor], tensors: Iterable[Tensor]) -> Tensor:
    """Whether all of them are finite, on their device; False also where a sum of squares is too large a number."""
    values = [each.detach().float().mean() for each in scalars]
    if chosen := [each for each in tensors if each.numel() > 0]:
        values.append(get_total_norm(chosen).float())
    device = values[-1].device if values else None
    return torch.stack([each.to(device) for each in values]).isfinite().all() if values else torch.tensor(True)


def _everywhere(trainer: Trainer, holds: Tensor | bool) -> bool:
    """Whether something holds in all processes of a run."""
    if trainer.world_size == 1:
        return bool(holds)
    vote = torch.as_tensor(holds, device=trainer.strategy.root_device).int()
    torch.distributed.all_reduce(vote, op=torch.distributed.ReduceOp.MIN)
    return bool(vote)


def _first_rank(trainer: Trainer, is_mine: bool) -> int:
    """The first process to which something applies; 0 where it applies to none."""
    if trainer.world_size == 1:
        return 0
    vote = torch.tensor(trainer.global_rank if is_mine else trainer.world_size, device=trainer.strategy.root_device)
    torch.distributed.all_reduce(vote, op=torch.distributed.ReduceOp.MIN)
    return int(vote) % trainer.world_size


def _scales(trainer: Trainer) -> bool:
    return getattr(trainer.precision_plugin, "scaler", None) is not None


def _listed(names: list[str]) -> str:
    more = len(names) - _NAMED
    shown = ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")
    return f"{shown} {'is' if len(names) == 1 else 'are'}"
