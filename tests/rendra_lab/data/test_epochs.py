"""Shuffled epochs: everything once, in an order of seed and epoch, the same however many load it."""

import random
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch

from rendra_lab.data import epochs
from rendra_lab.data.epochs import ShuffledEpochs
from rendra_lab.errors import UserError


class Noisy:
    """Numbers with noise from every global stream."""

    def __init__(self, count: int = 10) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> torch.Tensor:
        return torch.tensor([float(index), float(torch.rand(())), random.random(), np.random.rand()])  # noqa: NPY002


def passes(loader: ShuffledEpochs[Any], count: int) -> list[torch.Tensor]:
    return [batch for _ in range(count) for batch in loader]


def assert_alike(first: list[torch.Tensor], second: list[torch.Tensor]) -> None:
    assert len(first) == len(second)
    assert all(torch.equal(*pair) for pair in zip(first, second, strict=True))


def test_every_epoch_has_every_sample_once_in_an_order_of_its_own() -> None:
    loader = ShuffledEpochs(Noisy(), 4)
    orders = [[int(x) for batch in loader for x in batch[:, 0]] for _ in range(3)]
    assert all(sorted(order) == list(range(10)) for order in orders)
    assert orders[0] != orders[1] != orders[2] != orders[0]
    assert orders == [loader.order(epoch) for epoch in range(3)]


def test_noise_is_new_in_every_epoch_and_for_every_sample() -> None:
    noise = torch.cat(passes(ShuffledEpochs(Noisy(), 4), 2))[:, 1:]
    assert len(noise.flatten().unique()) == 60


def test_the_streams_of_the_fit_stay_as_they_are() -> None:
    def draws() -> tuple[float, float, float]:
        return random.random(), np.random.rand(), float(torch.rand(()))  # noqa: NPY002

    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(3)
    undisturbed = draws()
    for seed in (random.seed, np.random.seed, torch.manual_seed):
        seed(3)
    passes(ShuffledEpochs(Noisy(), 4), 2)
    assert draws() == undisturbed


@pytest.mark.parametrize(
    ("num_samples", "drop_last", "sizes"), [(10, False, [4, 4, 2]), (10, True, [4, 4]), (3, False, [3])]
)
def test_the_last_batch_is_smaller_or_left_out(num_samples: int, drop_last: bool, sizes: list[int]) -> None:
    loader = ShuffledEpochs(Noisy(num_samples), 4, drop_last=drop_last)
    assert [len(batch) for batch in loader] == sizes
    assert len(loader) == len(sizes)


def test_without_shuffling_the_order_is_that_of_the_samples() -> None:
    batches = passes(ShuffledEpochs(Noisy(), 4, shuffle=False), 1)
    assert torch.cat(batches)[:, 0].tolist() == list(range(10))


@pytest.mark.parametrize("drop_last", [False, True])
@pytest.mark.parametrize("given", range(8))
def test_a_loader_goes_on_with_the_next_batch(given: int, drop_last: bool) -> None:
    whole = passes(ShuffledEpochs(Noisy(), 4, drop_last=drop_last), 6)
    first, seen = ShuffledEpochs(Noisy(), 4, drop_last=drop_last), 0
    while seen < given:
        for _ in first:
            seen += 1
            if seen == given:
                break
    second = ShuffledEpochs(Noisy(), 4, drop_last=drop_last)
    second.load_state_dict(first.state_dict())
    rest = passes(second, 2)
    assert_alike(rest, whole[given : given + len(rest)])


def test_a_batch_size_may_change_on_the_way() -> None:
    first = ShuffledEpochs(Noisy(), 4)
    next(taken := iter(first))
    next(taken, None)
    second = ShuffledEpochs(Noisy(), 1)
    second.load_state_dict({"epoch": 0, "position": 4})
    assert [int(batch[0, 0]) for batch in second] == second.order(0)[4:]


@pytest.mark.parametrize("num_samples", [10, 12, 1])
@pytest.mark.parametrize("processes", [2, 4])
def test_processes_share_every_batch(num_samples: int, processes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    alone = [batch[:, :2].tolist() for batch in passes(ShuffledEpochs(Noisy(num_samples), 4), 2)]
    shares = []
    for rank in range(processes):
        monkeypatch.setattr(epochs, "_place", lambda rank=rank: (rank, processes))
        shares.append([batch[:, :2].tolist() for batch in passes(ShuffledEpochs(Noisy(num_samples), 4), 2)])
    for step, together in enumerate(alone):
        parts = [share[step] for share in shares]
        assert len({len(part) for part in parts}) == 1
        drawn = Counter(map(tuple, (row for part in parts for row in part)))
        assert set(map(tuple, together)) <= set(drawn)
        assert drawn.total() - len(together) < processes


def test_processes_that_cannot_share_evenly_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(epochs, "_place", lambda: (0, 3))
    with pytest.raises(UserError, match="batch_size=4 cannot be shared evenly by 3 processes"):
        next(iter(ShuffledEpochs(Noisy(), 4)))


@pytest.mark.parametrize(
    "wrong", [{"batch_size": 0}, {"num_workers": -1}, {"seed": -1}, {"batch_size": 11, "drop_last": True}]
)
def test_what_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=r"must be at least|make no batch"):
        ShuffledEpochs(Noisy(), **({"batch_size": 4} | wrong))


@pytest.mark.slow
@pytest.mark.parametrize("context", ["spawn", "forkserver"])
def test_workers_change_nothing(context: str) -> None:
    expected = passes(ShuffledEpochs(Noisy(), 4), 3)
    loader = ShuffledEpochs(Noisy(), 4, num_workers=2)
    loader._loader.multiprocessing_context = context
    first = passes(loader, 1)
    second = iter(loader)
    first += [next(second)]
    assert loader.state_dict() == {"epoch": 1, "position": 4}  # not what the workers have loaded ahead
    resumed = ShuffledEpochs(Noisy(), 4, num_workers=2)
    resumed.load_state_dict(loader.state_dict())
    assert_alike([*first, *passes(resumed, 2)], expected)
