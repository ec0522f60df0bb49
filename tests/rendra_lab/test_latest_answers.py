"""Answers that are remembered: of the same objects, and of no others."""

from __future__ import annotations

import torch

from rendra_lab.latest_answers import remembered


class _Counter:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, value: object, word: str = "") -> int:
        self.calls += 1
        return self.calls


def test_the_same_object_is_asked_about_once() -> None:
    counter = _Counter()
    ask = remembered()(counter.__call__)
    one = torch.zeros(2)
    assert [ask(one), ask(one), ask(one, word="a"), ask(one, word="a"), ask(one, word="b")] == [1, 1, 2, 2, 3]


def test_equal_objects_are_not_the_same() -> None:
    ask = remembered()(_Counter().__call__)
    one, other = torch.zeros(2), torch.zeros(2)
    assert [ask(one), ask(other), ask(1), ask(1.0), ask(True)] == [1, 2, 3, 4, 5]


def test_older_answers_make_room() -> None:
    ask = remembered(most=2)(_Counter().__call__)
    assert [ask(1), ask(2), ask(3), ask(2), ask(1)] == [1, 2, 3, 2, 4]


def test_what_is_gone_is_not_remembered() -> None:
    ask = remembered()(_Counter().__call__)
    assert [ask(torch.zeros(2)) for _ in range(3)] == [1, 2, 3]
