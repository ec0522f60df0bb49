"""Sixteen boxes, points or queries at once: explicit vectors, where the compiler's own would be slower.

LLVM cuts the vectors to what the machine has. Nothing is contracted or reordered: the distance to a box is rounded
like that to a point, operation by operation, so that it never exceeds the distance to a point inside, not even in
the last bit.

Memory is named by its address here: an array counts its references, atomically, wherever it is passed on or unpacked,
which in a search of 0.2 us costs more than the search. Whoever passes an address keeps the array alive.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES = 16

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)


@intrinsic
def float_bits(typingctx, number):  # type: ignore[no-untyped-def]
    """The IEEE 754 representation of a float32; for numbers that are not negative it orders as they do."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], ir.IntType(32))

    return types.int32(types.float32), codegen


@intrinsic
def float_of_bits(typingctx, bits):  # type: ignore[no-untyped-def]
    """The float32 whose IEEE 754 representation is the int32 given."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.bitcast(arguments[0], ir.FloatType())

    return types.float32(types.int32), codegen


@intrinsic
def first_bit(typingctx, mask):  # type: ignore[no-untyped-def]
    """Place of the lowest set bit of an int64 that is not zero."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), codegen


def _reader(kind: Any, element: Any) -> Callable[..., Any]:
    """`read(address, i)`: the i-th element."""

    @intrinsic
    def read(typingctx, address, i):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            return builder.load(_element(builder, *arguments, element))

        return kind(types.int64, types.int64), codegen

    return read


def _writer(kind: Any, element: Any) -> Callable[..., Any]:
    """`write(address, i, value)`: set the i-th element."""

    @intrinsic
    def write(typingctx, address, i, value):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            builder.store(arguments[2], _element(builder, *arguments[:2], element))
            return context.get_dummy_value()

        return types.none(types.int64, types.int64, kind), codegen

    return write


def _element(builder: Any, address: Any, i: Any, element: Any) -> Any:
    return builder.gep(builder.inttoptr(address, element.as_pointer()), [i])


read_float, write_float = _reader(types.float32, ir.FloatType()), _writer(types.float32, ir.FloatType())
read_int32, write_int32 = _reader(types.int32, ir.IntType(32)), _writer(types.int32, ir.IntType(32))
read_int64, write_int64 = _reader(types.int64, ir.IntType(64)), _writer(types.int64, ir.IntType(64))


def _load(builder: Any, address: Any, offset: Any, element: Any, vector: Any) -> Any:
    place = _element(builder, address, offset, element)
    return builder.load(builder.bitcast(place, vector.as_pointer()), align=4)


def _repeat(builder: Any, number: Any, vector: Any) -> Any:
    lone = builder.insert_element(ir.Constant(vector, ir.Undefined), number, ir.Constant(ir.IntType(32), 0))
    places = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(lone, ir.Constant(vector, ir.Undefined), places)


def _larger(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered(">", a, b), a, b)


def _smaller(builder: Any, a: Any, b: Any) -> Any:
    return builder.select(builder.fcmp_ordered("<", a, b), a, b)


def _bits(builder: Any, lanes: Any) -> Any:
    """Sixteen truths as an int64."""
    return builder.zext(builder.bitcast(lanes, ir.IntType(LANES)), ir.IntType(64))


def _distance(builder: Any, low: list[Any], high: list[Any], q_low: list[Any], q_high: list[Any], norm: int) -> Any:
    """Between boxes, vectors of x, y and z each: a difference, its square or absolute value, two additions.

    A point is a box whose corners are the same object.
    """
    total = None
    for axis in range(3):
        below = builder.fsub(low[axis], q_high[axis])
        is_point = low[axis] is high[axis] and q_low[axis] is q_high[axis]
        if is_point and norm == 2:
            apart = below
        else:
            above = builder.fneg(below) if is_point else builder.fsub(q_low[axis], high[axis])
            apart = _larger(builder, below, above)
        if not is_point:
            apart = _larger(builder, apart, ir.Constant(_FLOATS, [0.0] * LANES))
        apart = apart if norm == 1 else builder.fmul(apart, apart)
        total = apart if total is None else builder.fadd(total, apart)
    return total


def _better(builder: Any, total: Any, index: Any, cut: Any, cut_index: Any) -> Any:
    """Which pairs of distance and index come first."""
    nearer = builder.fcmp_ordered("<", total, cut)
    tie = builder.fcmp_ordered("==", total, cut)
    return builder.or_(nearer, builder.and_(tie, builder.icmp_signed("<", index, cut_index)))


def _near(is_box: bool, norm: int) -> Callable[..., Any]:
    """A test of 16 boxes (x, y, z of the low corners, then of the high ones) or of 16 points (x, y, z)."""

    @intrinsic
    def near(typingctx, numbers, first, indices, first_index, qx, qy, qz, cut, cut_index, limit):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            numbers, first, indices, first_index, *query, cut, cut_index, limit = arguments
            corners = _vectors(builder, numbers, first, 6 if is_box else 3)
            q = [_repeat(builder, coordinate, _FLOATS) for coordinate in query]
            total = _distance(builder, corners[:3], corners[-3:], q, q, norm)
            index = _load(builder, indices, first_index, ir.IntType(32), _INTS)
            cuts = _repeat(builder, cut, _FLOATS), _repeat(builder, cut_index, _INTS)
            known = builder.icmp_signed("<", index, _repeat(builder, limit, _INTS))
            return _bits(builder, builder.and_(_better(builder, total, index, *cuts), known))

        scalars = (types.float32,) * 4 + (types.int32, types.int32)
        return types.int64(*(types.int64,) * 4, *scalars), codegen

    return near


def _vectors(builder: Any, numbers: Any, first: Any, count: int) -> list[Any]:
    places = [builder.add(first, ir.Constant(first.type, block * LANES)) for block in range(count)]
    return [_load(builder, numbers, place, ir.FloatType(), _FLOATS) for place in places]


near_boxes = _near(True, 2)
near_boxes_l1 = _near(True, 1)
near_points = _near(False, 2)
near_points_l1 = _near(False, 1)
"""`near_*(numbers, first, indices, first_index, qx, qy, qz, cut, cut_index, limit)`: lanes that may matter, as bits.

A lane matters whose distance is below `cut`, or equal to it with an index below `cut_index`, and whose index is below
`limit`. The float32 at the address `numbers` are read from `first` on, the int32 at `indices` from `first_index` on.
"""


def _fold(builder: Any, vector: Any, choose: Callable[..., Any]) -> Any:
    """One of the sixteen, the same as choosing between two at a time."""
    for step in (8, 4, 2, 1):
        places = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [(lane + step) % LANES for lane in range(LANES)])
        vector = choose(builder, vector, builder.shuffle_vector(vector, vector, places))
    return builder.extract_element(vector, ir.Constant(ir.IntType(32), 0))


@intrinsic
def lowest_of(typingctx, numbers, first, indices, first_index, nothing):  # type: ignore[no-untyped-def]
    """The lowest of 16 float32, but for those whose int32 index is `nothing`; infinity if all are."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        numbers, first, indices, first_index, nothing = arguments
        index = _load(builder, indices, first_index, ir.IntType(32), _INTS)
        counts = builder.icmp_signed("!=", index, _repeat(builder, nothing, _INTS))
        vector = _load(builder, numbers, first, ir.FloatType(), _FLOATS)
        vector = builder.select(counts, vector, ir.Constant(_FLOATS, [float("inf")] * LANES))
        return _fold(builder, vector, _smaller)

    return types.float32(*(types.int64,) * 4, types.int32), codegen


@intrinsic
def highest_of(typingctx, numbers, first):  # type: ignore[no-untyped-def]
    """The highest of 16 float32."""

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return _fold(builder, _load(builder, *arguments, ir.FloatType(), _FLOATS), _larger)

    return types.float32(types.int64, types.int64), codegen


@intrinsic
def lowest_index_of(typingctx, indices, first):  # type: ignore[no-untyped-def]
    """The lowest of 16 int32."""

    def smaller(builder, a, b):  # type: ignore[no-untyped-def]
        return builder.select(builder.icmp_signed("<", a, b), a, b)

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return _fold(builder, _load(builder, *arguments, ir.IntType(32), _INTS), smaller)

    return types.int32(types.int64, types.int64), codegen


# What follows compares 16 queries, whose coordinates lie at the address `queries` as in a leaf, and the best they
# have found, which lies at the address `best`: 16 distances, 16 indices, 16 slots. A distance of -1 stays.


def _best(builder: Any, best: Any) -> list[Any]:
    places = [ir.Constant(ir.IntType(64), block * LANES) for block in range(3)]
    kinds = (ir.FloatType(), _FLOATS), (ir.IntType(32), _INTS), (ir.IntType(32), _INTS)
    return [_load(builder, best, place, *kind) for place, kind in zip(places, kinds, strict=True)]


def _box_for_queries(norm: int) -> Callable[..., Any]:
    """`test(queries, best, boxes, place, lowest)`: lanes of the queries to which one box may matter, as bits."""

    @intrinsic
    def test(typingctx, queries, best, boxes, place, lowest):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            queries, best, boxes, place, lowest = arguments
            q = _vectors(builder, queries, ir.Constant(ir.IntType(64), 0), 3)
            places = [builder.add(place, ir.Constant(place.type, block * LANES)) for block in range(6)]
            numbers = [builder.load(_element(builder, boxes, place, ir.FloatType())) for place in places]
            corners = [_repeat(builder, number, _FLOATS) for number in numbers]
            total = _distance(builder, corners[:3], corners[3:], q, q, norm)
            dists, indices, _ = _best(builder, best)
            return _bits(builder, _better(builder, total, _repeat(builder, lowest, _INTS), dists, indices))

        return types.int64(*(types.int64,) * 4, types.int32), codegen

    return test


def _leaf_for_queries(norm: int) -> Callable[..., Any]:
    """`improve(queries, best, leaves, indices, leaf)`: keep the best of a leaf; lanes that it improved, as bits."""

    @intrinsic
    def improve(typingctx, queries, best, leaves, indices, leaf):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            queries, best, leaves, indices, leaf = arguments
            int64, q = leaf.type, _vectors(builder, queries, ir.Constant(ir.IntType(64), 0), 3)
            dists, known, slots = _best(builder, best)
            improved = ir.Constant(ir.VectorType(ir.IntType(1), LANES), [0] * LANES)
            first_slot, first = (builder.mul(leaf, ir.Constant(int64, size)) for size in (LANES, 3 * LANES))
            for lane in range(LANES):
                slot = builder.add(first_slot, ir.Constant(int64, lane))
                places = [builder.add(first, ir.Constant(int64, axis * LANES + lane)) for axis in range(3)]
                numbers = [builder.load(_element(builder, leaves, place, ir.FloatType())) for place in places]
                point = [_repeat(builder, number, _FLOATS) for number in numbers]
                index = _repeat(builder, builder.load(_element(builder, indices, slot, ir.IntType(32))), _INTS)
                total = _distance(builder, point, point, q, q, norm)
                better = _better(builder, total, index, dists, known)
                dists, known = builder.select(better, total, dists), builder.select(better, index, known)
                slot = _repeat(builder, builder.trunc(slot, ir.IntType(32)), _INTS)
                slots, improved = builder.select(better, slot, slots), builder.or_(improved, better)
            for block, vector in enumerate((dists, known, slots)):
                target = _element(builder, best, ir.Constant(int64, block * LANES), ir.IntType(32))
                builder.store(vector, builder.bitcast(target, vector.type.as_pointer()), align=4)
            return _bits(builder, improved)

        return types.int64(*(types.int64,) * 5), codegen

    return improve


def _boxes_for_box(norm: int) -> Callable[..., Any]:
    """`test(boxes, first, indices, first_index, box, cut, cut_index)`: lanes of 16 boxes that may matter, as bits.

    `box` is the address of the low corner and of the high one of the box about the queries.
    """

    @intrinsic
    def test(typingctx, boxes, first, indices, first_index, box, cut, cut_index):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            boxes, first, indices, first_index, box, cut, cut_index = arguments
            corners = _vectors(builder, boxes, first, 6)
            places = [ir.Constant(first.type, place) for place in range(6)]
            numbers = [builder.load(_element(builder, box, place, ir.FloatType())) for place in places]
            q = [_repeat(builder, number, _FLOATS) for number in numbers]
            total = _distance(builder, corners[:3], corners[3:], q[:3], q[3:], norm)
            index = _load(builder, indices, first_index, ir.IntType(32), _INTS)
            cuts = _repeat(builder, cut, _FLOATS), _repeat(builder, cut_index, _INTS)
            return _bits(builder, _better(builder, total, index, *cuts))

        return types.int64(*(types.int64,) * 5, types.float32, types.int32), codegen

    return test


@intrinsic
def worst_of(typingctx, best):  # type: ignore[no-untyped-def]
    """The bits of the largest distance among the best, and the highest index at that distance; int32 both."""

    def larger(builder, a, b):  # type: ignore[no-untyped-def]
        return builder.select(builder.icmp_signed(">", a, b), a, b)

    def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        dists, indices, _ = _best(builder, arguments[0])
        bits = builder.bitcast(dists, _INTS)  # order as the distances do; those of -1 are negative
        worst = _fold(builder, bits, larger)
        there = builder.icmp_signed("==", bits, _repeat(builder, worst, _INTS))
        index = _fold(builder, builder.select(there, indices, ir.Constant(_INTS, [-1] * LANES)), larger)
        return context.make_tuple(builder, signature.return_type, (worst, index))

    return types.UniTuple(types.int32, 2)(types.int64), codegen


box_for_queries, box_for_queries_l1 = _box_for_queries(2), _box_for_queries(1)
leaf_for_queries, leaf_for_queries_l1 = _leaf_for_queries(2), _leaf_for_queries(1)
boxes_for_box, boxes_for_box_l1 = _boxes_for_box(2), _boxes_for_box(1)
