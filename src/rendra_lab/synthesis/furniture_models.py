"""A collection of furniture: a number of shapes of each name, of any materials."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rendra_lab.synthesis.furniture import NAMES, Finish, Furniture, draw, draw_finish

_COLLECTION, _MATERIALS = 7, 8  # streams of random numbers: a shape may not depend on what else is drawn


class FurnitureModels:
    """Shapes by name and number; the same seed, the same shapes.

    Args:
        per_name: how many there are of each name, at least 1.
        seed: of all shapes.
    """

    def __init__(self, per_name: int, seed: int = 0) -> None:
        if per_name < 1:
            raise ValueError(f"a collection has at least 1 model of each name, got {per_name}")
        self.per_name = per_name
        self.seed = seed

    def model(self, name: str, number: int, finish: Finish | None = None) -> Furniture:
        """One of them, of some materials; None: of any, which are always the same.

        Raises:
            ValueError: a name or a number that is not in the collection.
        """
        if name not in NAMES or not 0 <= number < self.per_name:
            raise ValueError(
                f"the collection has {self.per_name} models each of: {', '.join(NAMES)}; got {name!r} {number}"
            )
        key = [self.seed, NAMES.index(name), number]
        materials = draw_finish(np.random.default_rng([_MATERIALS, *key])) if finish is None else finish
        piece = draw(name, np.random.default_rng([_COLLECTION, *key]), materials)
        return replace(piece, model=model_id(name, number))

    def stock(self, numbers: range) -> ModelStock:
        """Some of the models of each name, for rooms."""
        return ModelStock(self, numbers)


class ModelStock:
    """A `Stock` for rooms: any model among some of the numbers of a collection."""

    def __init__(self, models: FurnitureModels, numbers: range) -> None:
        if not numbers:
            raise ValueError("a stock of furniture needs at least one model of each name")
        self.models = models
        self.numbers = numbers

    def __call__(self, name: str, rng: np.random.Generator, finish: Finish) -> Furniture:
        """Some model of a name, of the materials."""
        return self.models.model(name, int(rng.choice(self.numbers)), finish)


def model_id(name: str, number: int) -> str:
    """What a model is called in tables and files: `coffee_table_007`."""
    return f"{name.replace(' ', '_')}_{number:03d}"


def parsed_model_id(model: str) -> tuple[str, int]:
    """The inverse of `model_id`: name and number."""
    name, _, number = model.rpartition("_")
    return _BY_ID[name], int(number)


_BY_ID: Mapping[str, str] = {name.replace(" ", "_"): name for name in NAMES}
