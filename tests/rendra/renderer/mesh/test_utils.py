"""Packing of rectangles: no overlap, tight bounds, one place for one thing."""

import pytest
import torch

from rendra.renderer.mesh.utils import Rectangle, pack_rectangles, pack_unique_rectangles


@pytest.mark.parametrize("seed", range(5))
def test_rectangles_neither_overlap_nor_leave_the_area(seed: int) -> None:
    torch.manual_seed(seed)
    sizes = [(int(x), int(y)) for x, y in torch.randint(1, 30, (25, 2))]
    (width, height), places = pack_rectangles(sizes)
    taken = torch.zeros(height, width, dtype=torch.int64)
    for (x_size, y_size), place in zip(sizes, places, strict=True):
        taken[place.y : place.y + y_size, place.x : place.x + x_size] += 1
    assert taken.max() == 1
    assert taken.sum() == sum(x * y for x, y in sizes)
    assert width * height < 2 * taken.sum()


def test_the_same_thing_lies_in_one_place() -> None:
    packed = pack_unique_rectangles([Rectangle(4, 5, 7), Rectangle(3, 2, 1), Rectangle(4, 5, 7)])
    first, other, again = packed.locations
    assert (first.x, first.y) == (again.x, again.y)
    assert [place.is_first for place in packed.locations] == [True, True, False]
    assert (first.x, first.y) != (other.x, other.y)


def test_errors() -> None:
    with pytest.raises(ValueError, match="no rectangle"):
        pack_rectangles([])
    with pytest.raises(ValueError, match="identifier 7 differ in size"):
        pack_unique_rectangles([Rectangle(4, 5, 7), Rectangle(4, 4, 7)])
