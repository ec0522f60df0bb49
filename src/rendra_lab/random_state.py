"""Random numbers of a run: kept in its checkpoints, so that a resumed run draws what the uninterrupted one drew.

What the fit draws from are Python's, NumPy's (legacy) and torch's global streams, those of every CUDA device, and
generators that the task, its parts and the data module own as attributes. They are noted at the end of each step;
whatever saves a checkpoint until the next one, in the middle of a validation or of a broken step, saves that note.
Whoever draws numbers in order to show or to measure does so within `untouched`.
"""

from __future__ import annotations

import contextlib
import logging
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.trainer.states import TrainerFn
from torch import Tensor

log = logging.getLogger(__name__)

_KEY = "random_state"


@dataclass(frozen=True)
class Streams:
    """The state of all random streams at one moment.

    CUDA's are there if CUDA was in use; `owned` holds the state of other generators by their names.
    """

    python: Any
    numpy: Any
    torch: Tensor
    cuda: tuple[Tensor, ...] = ()
    owned: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def now(cls, generators: Mapping[str, Any] | None = None) -> Streams:
        """The present state; draws nothing."""
        cuda = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
        owned = {name: _state_of(generator) for name, generator in (generators or {}).items()}
        return cls(random.getstate(), np.random.get_state(), torch.get_rng_state(), tuple(cuda), owned)

    def restore(self, generators: Mapping[str, Any] | None = None) -> None:
        """Makes it the present state, as far as there are such devices and generators."""
        random.setstate(self.python)
        np.random.set_state(self.numpy)
        torch.set_rng_state(self.torch)
        if self.cuda and torch.cuda.is_available():
            for device, state in enumerate(self.cuda[: torch.cuda.device_count()]):
                torch.cuda.set_rng_state(state, device)
        for name, generator in (generators or {}).items():
            if name in self.owned:
                _set_state(generator, self.owned[name])

    def to_plain(self) -> dict[str, Any]:
        """Tensors, numbers, words, and containers of them, which `torch.load(weights_only=True)` reads."""
        version, words, gauss = self.python
        return {
            "python": (version, torch.tensor(words), gauss),
            "numpy": _plain(self.numpy),
            "torch": self.torch,
            "cuda": list(self.cuda),
            "owned": _plain(dict(self.owned)),
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> Streams:
        """What `to_plain` made."""
        version, words, gauss = plain["python"]
        owned = {name: _unplain(state) for name, state in plain["owned"].items()}
        python, cuda = (version, tuple(words.tolist()), gauss), tuple(state.cpu() for state in plain["cuda"])
        return cls(python, _unplain(plain["numpy"]), plain["torch"].cpu(), cuda, owned)


@contextlib.contextmanager
def untouched() -> Iterator[None]:
    """Whatever is drawn from the global streams meanwhile is drawn again afterwards."""
    before = Streams.now()
    try:
        yield
    finally:
        before.restore()


@contextlib.contextmanager
def seeded(*key: int) -> Iterator[None]:
    """The global streams of the CPU follow from whole numbers of at least 0 alone meanwhile, and go on as before."""
    states = random.getstate(), np.random.get_state(), torch.get_rng_state()
    first, second, third = np.random.SeedSequence(key).generate_state(3).tolist()
    random.seed(first)
    np.random.seed(second)
    torch.default_generator.manual_seed(third)  # torch.manual_seed would seed every GPU too
    try:
        yield
    finally:
        random.setstate(states[0])
        np.random.set_state(states[1])
        torch.set_rng_state(states[2])


def stream(*key: int, device: torch.device | str = "cpu") -> torch.Generator:
    """A stream of its own on a device, which follows from whole numbers of at least 0 alone."""
    (first,) = np.random.SeedSequence(key).generate_state(1, np.uint64).tolist()
    return torch.Generator(device).manual_seed(first >> 1)


class RandomState(Callback):
    """Keeps the random state in checkpoints, and the data position where the last finished step left it.

    Every run that writes checkpoints has it, as the first of its callbacks: what fails in another one at the end of
    a step fails after the note was made. In a run of several processes each has its own streams again, if there are
    as many as before.
    """

    def __init__(self) -> None:
        self._generators: dict[str, Any] = {}
        self._kept: Streams | None = None
        self._position: list[dict[str, Any]] = []
        self._resumes_with: list[dict[str, Any]] | None = None

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Takes the state out of a checkpoint from which a fit goes on; it is due when the fit begins."""
        if trainer.state.fn == TrainerFn.FITTING:
            self._resumes_with = checkpoint.get(_KEY)
            if self._resumes_with is None:
                log.warning("the checkpoint holds no random state: the run goes on with other random numbers")

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Goes on from the state of the checkpoint: loaders are made by now, and the next draw is a step's."""
        self._generators = owned_generators(trainer)
        if self._resumes_with:
            states, self._resumes_with = self._resumes_with, None
            Streams.from_plain(states[trainer.global_rank % len(states)]).restore(self._generators)
            # once, before it fetches the first batch, Lightning makes the iterators of a validation that is done
            validation: Any = trainer.fit_loop.epoch_loop.val_loop
            validation.increment_progress_to_evaluation_end = untouched()(
                validation.increment_progress_to_evaluation_end
            )
        self._keep(trainer)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        """Notes the state after a step."""
        self._keep(trainer)

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """A validation, whose loaders draw numbers even if nothing else does, leaves the fit as it was."""
        if self._kept is not None and trainer.state.fn == TrainerFn.FITTING and not trainer.sanity_checking:
            self._kept.restore(self._generators)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Adds the state after the last finished step, that of every process."""
        mine = (self._kept or Streams.now()).to_plain()
        states = [mine]
        if trainer.world_size > 1:
            states = [{} for _ in range(trainer.world_size)]
            torch.distributed.all_gather_object(states, mine)
        checkpoint[_KEY] = states
        if self._kept is not None:
            self._forget_the_broken_step(checkpoint["loops"]["fit_loop"])

    def _keep(self, trainer: Trainer) -> None:
        self._kept = Streams.now(self._generators)
        loader = trainer.fit_loop._combined_loader
        self._position = [] if loader is None else [dict(state) for state in loader._state_dicts()]

    def _forget_the_broken_step(self, loop: dict[str, Any]) -> None:
        """Lets a fit that was saved within a step begin with that step's batch; Lightning would go on behind it."""
        total, current = (loop["epoch_loop.batch_progress"][span] for span in ("total", "current"))
        if total["ready"] == total["processed"]:
            return
        if self._position:
            loop["state_dict"]["combined_loader"] = self._position
        if current["completed"]:  # as if saved at the end of the step before
            for progress in (total, current):
                done = progress["completed"]
                progress.update(ready=done, started=done, processed=done, completed=done - 1)
            loop["epoch_loop.state_dict"]["_batches_that_stepped"] -= 1


def owned_generators(trainer: Trainer) -> dict[str, Any]:
    """The generators that the task, its modules and the data module hold as attributes, by name."""
    owners = {f"task.{name}": module for name, module in trainer.lightning_module.named_modules()}
    owners["data"] = getattr(trainer, "datamodule", None)
    kinds = (torch.Generator, np.random.Generator)
    return {
        f"{owner}.{name}": value
        for owner, part in owners.items()
        if part is not None
        for name, value in vars(part).items()
        if isinstance(value, kinds)
    }


def _state_of(generator: torch.Generator | np.random.Generator) -> Any:
    if isinstance(generator, torch.Generator):
        return generator.get_state()
    return generator.bit_generator.state


def _set_state(generator: torch.Generator | np.random.Generator, state: Any) -> None:
    if isinstance(generator, torch.Generator):
        generator.set_state(state)
    else:
        generator.bit_generator.state = state


def _plain(state: Any) -> Any:
    """NumPy's arrays, as which words of 32 and 64 bits come, as a pair of their type's name and a tensor."""
    if isinstance(state, np.ndarray):
        return {"array": state.dtype.name, "words": torch.from_numpy(state.astype(np.uint64).view(np.int64))}
    if isinstance(state, Mapping):
        return {name: _plain(value) for name, value in state.items()}
    return tuple(map(_plain, state)) if isinstance(state, tuple) else state


def _unplain(state: Any) -> Any:
    if isinstance(state, Mapping):
        if "array" in state:
            return state["words"].numpy().view(np.uint64).astype(state["array"])
        return {name: _unplain(value) for name, value in state.items()}
    return tuple(map(_unplain, state)) if isinstance(state, tuple) else state
