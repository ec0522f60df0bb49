"""Sixteen boxes or points at once against one query: explicit vectors, where the compiler's own would be slower.

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
read_int32 = _reader(types.int32, ir.IntType(32))
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


def _near(is_box: bool, norm: int) -> Callable[..., Any]:
    """A test of 16 boxes (x, y, z of the low corners, then of the high ones) or of 16 points (x, y, z)."""

    @intrinsic
    def near(typingctx, numbers, first, indices, first_index, qx, qy, qz, cut, cut_index, limit):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            numbers, first, indices, first_index, *query, cut, cut_index, limit = arguments
            total = None
            for axis, coordinate in enumerate(query):
                q = _repeat(builder, coordinate, _FLOATS)

                def corner(block: int, axis: int = axis) -> Any:
                    place = builder.add(first, ir.Constant(first.type, (block * 3 + axis) * LANES))
                    return _load(builder, numbers, place, ir.FloatType(), _FLOATS)

                below = builder.fsub(corner(0), q)
                above = builder.fsub(q, corner(1)) if is_box else builder.fneg(below)
                apart = _larger(builder, below, above)
                if is_box:
                    apart = _larger(builder, apart, ir.Constant(_FLOATS, [0.0] * LANES))
                apart = apart if norm == 1 else builder.fmul(apart, apart)
                total = apart if total is None else builder.fadd(total, apart)
            index = _load(builder, indices, first_index, ir.IntType(32), _INTS)
            cuts = _repeat(builder, cut, _FLOATS)
            nearer = builder.fcmp_ordered("<", total, cuts)
            earlier = builder.icmp_signed("<", index, _repeat(builder, cut_index, _INTS))
            tie = builder.and_(builder.fcmp_ordered("==", total, cuts), earlier)
            known = builder.icmp_signed("<", index, _repeat(builder, limit, _INTS))
            lanes = builder.and_(builder.or_(nearer, tie), known)
            return builder.zext(builder.bitcast(lanes, ir.IntType(LANES)), ir.IntType(64))

        scalars = (types.float32,) * 4 + (types.int32, types.int32)
        return types.int64(*(types.int64,) * 4, *scalars), codegen

    return near


near_boxes = _near(True, 2)
near_boxes_l1 = _near(True, 1)
near_points = _near(False, 2)
near_points_l1 = _near(False, 1)
"""`near_*(numbers, first, indices, first_index, qx, qy, qz, cut, cut_index, limit)`: lanes that may matter, as bits.

A lane matters whose distance is below `cut`, or equal to it with an index below `cut_index`, and whose index is below
`limit`. The float32 at the address `numbers` are read from `first` on, the int32 at `indices` from `first_index` on.
"""
