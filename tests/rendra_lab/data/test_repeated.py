"""The loader of fits: as long as it says, and resumable."""

import pytest

from rendra_lab.data.repeated import Repeated


def test_it_yields_the_same_batch_as_often_as_it_says() -> None:
    batch = object()
    loader = Repeated(batch, 3)
    for _ in range(2):
        given = list(loader)
        assert len(given) == len(loader) == 3
        assert all(one is batch for one in given)
    with pytest.raises(ValueError, match="times=0"):
        Repeated(batch, 0)


def test_an_interrupted_epoch_is_finished_and_the_next_one_is_whole() -> None:
    first = Repeated("batch", 5)
    steps = iter(first)
    next(steps), next(steps)
    second = Repeated("batch", 5)
    second.load_state_dict(first.state_dict())
    assert len(list(second)) == 3
    assert len(list(second)) == 5


def test_a_finished_epoch_leaves_nothing_to_finish() -> None:
    first = Repeated("batch", 2)
    list(first)
    second = Repeated("batch", 2)
    second.load_state_dict(first.state_dict())
    assert len(list(second)) == 2
