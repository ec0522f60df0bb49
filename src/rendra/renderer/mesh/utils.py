"""Rectangles packed into one: the layout of texture maps that share an image."""

from collections.abc import Sequence
from math import isqrt
from typing import NamedTuple


class Rectangle(NamedTuple):
    """A rectangle to pack; rectangles of one identifier are the same thing and lie in one place."""

    xsize: int
    ysize: int
    identifier: int


class PackedRectangle(NamedTuple):
    """Where a rectangle lies.

    x, y: its first column and row.
    flipped: whether x and y are exchanged; they never are here.
    is_first: whether it is the first of its identifier.
    """

    x: int
    y: int
    flipped: bool
    is_first: bool


class PackedRectangles(NamedTuple):
    """Size (x, y) of the whole, and the place of every rectangle in the order of the input."""

    total_size: tuple[int, int]
    locations: list[PackedRectangle]


def pack_rectangles(sizes: Sequence[tuple[int, int]]) -> PackedRectangles:
    """Place rectangles of sizes (x, y) on shelves, tallest first, in an area that is about square.

    Raises:
        ValueError: there are none.
    """
    if not sizes:
        raise ValueError("There is no rectangle to pack")
    limit = max(max(x for x, _ in sizes), isqrt(sum(x * y for x, y in sizes)))
    locations = [PackedRectangle(0, 0, False, True)] * len(sizes)
    row = column = shelf = used = 0
    for i in sorted(range(len(sizes)), key=lambda i: -sizes[i][1]):
        width, height = sizes[i]
        if column and column + width > limit:
            row, column, shelf = row + shelf, 0, 0
        locations[i] = PackedRectangle(column, row, False, True)
        column, shelf = column + width, max(shelf, height)
        used = max(used, column)
    return PackedRectangles((used, row + shelf), locations)


def pack_unique_rectangles(rectangles: Sequence[Rectangle]) -> PackedRectangles:
    """Place rectangles, those of one identifier in the same place.

    Raises:
        ValueError: there are none, or two of one identifier differ in size.
    """
    unique: dict[int, tuple[int, int]] = {}
    for rectangle in rectangles:
        size = rectangle.xsize, rectangle.ysize
        if unique.setdefault(rectangle.identifier, size) != size:
            raise ValueError(
                f"Rectangles of identifier {rectangle.identifier} differ in size: "
                f"{unique[rectangle.identifier]} and {size}"
            )
    packed = pack_rectangles(list(unique.values()))
    places = dict(zip(unique, packed.locations, strict=True))
    seen: set[int] = set()
    locations = []
    for rectangle in rectangles:
        is_first = rectangle.identifier not in seen
        seen.add(rectangle.identifier)
        locations.append(places[rectangle.identifier]._replace(is_first=is_first))
    return PackedRectangles(packed.total_size, locations)
