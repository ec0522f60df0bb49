"""Sums over the rows of a table of features, many channels at once: what the compiler does not find by itself.

A table is flat: row i begins at element i * channels. `rows` and `numbers` are the list of one pixel: row of the
table and a number for each point, `count` of them from element `at` on. Channels are taken 64 at a time while there
are so many, then 16, then one. Nothing here looks at bounds: `numba_cpu` does.

Memory is passed as pointers: an array that is handed from function to function has its references counted, atomically
and by all threads. Whoever takes a pointer keeps the array alive.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

_WIDTHS = 64, 16, 1
_INT = ir.IntType(64)


@intrinsic
def pointer(typingctx, array):
    """To the first element of a contiguous array."""

    def codegen(context, builder, signature, arguments):
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), codegen


def _kind(width):
    return ir.FloatType() if width == 1 else ir.VectorType(ir.FloatType(), width)


def _zero(width):
    return ir.Constant(_kind(width), 0.0 if width == 1 else [0.0] * width)


def _splat(builder, value, width):
    """The same number in every lane."""
    if width == 1:
        return value
    single = builder.insert_element(ir.Constant(_kind(width), ir.Undefined), value, ir.IntType(32)(0))
    mask = ir.Constant(ir.VectorType(ir.IntType(32), width), [0] * width)
    return builder.shuffle_vector(single, ir.Constant(_kind(width), ir.Undefined), mask)


def _multiply_add(builder, a, b, c):
    """The sum a b + c, fused where the processor can."""
    suffix = f"v{a.type.count}f32" if isinstance(a.type, ir.VectorType) else "f32"
    fused = cgutils.get_or_insert_function(
        builder.module, ir.FunctionType(a.type, [a.type] * 3), f"llvm.fmuladd.{suffix}"
    )
    return builder.call(fused, [a, b, c])


def _total(builder, vector):
    """The sum of lanes, halves upon halves."""
    width = vector.type.count if isinstance(vector.type, ir.VectorType) else 1
    while width > 1:
        width //= 2
        masks = [
            ir.Constant(ir.VectorType(ir.IntType(32), width), list(range(first, first + width)))
            for first in (0, width)
        ]
        low, high = (builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), mask) for mask in masks)
        vector = builder.fadd(low, high)
    return vector if vector.type == ir.FloatType() else builder.extract_element(vector, ir.IntType(32)(0))


def _place(builder, data, offsets, width):
    """Where `width` numbers begin: at the sum of the offsets."""
    at = offsets[0]
    for offset in offsets[1:]:
        at = builder.add(at, offset)
    return builder.bitcast(builder.gep(data, [at]), _kind(width).as_pointer())


def _load(builder, data, offsets, width):
    return builder.load(_place(builder, data, offsets, width), align=4)


def _item(builder, data, at, index):
    return builder.load(builder.gep(data, [builder.add(at, index)]))


def _row(builder, rows, at, index, channels):
    """Where the row of an entry of the list begins."""
    return builder.mul(builder.sext(_item(builder, rows, at, index), _INT), channels)


def _blocks(builder, channels, body):
    """Calls body(first channel, width) for all blocks of channels."""
    done = _INT(0)
    for width in _WIDTHS:
        number = builder.sdiv(builder.sub(channels, done), _INT(width))
        with cgutils.for_range(builder, number) as loop:
            body(builder.add(done, builder.mul(loop.index, _INT(width))), width)
        done = builder.add(done, builder.mul(number, _INT(width)))


_LIST = types.CPointer(types.int32), types.CPointer(types.float32), types.intp, types.intp
_TABLE = types.CPointer(types.float32)


@intrinsic
def sum_rows(typingctx, table, channels, rows, numbers, at, count, out, place):
    """Write sum_k numbers_k table[rows_k] to `channels` elements of `out` from `place` on."""

    def codegen(context, builder, signature, arguments):
        table, channels, rows, numbers, at, count, out, place = arguments

        def block(first, width):
            running = cgutils.alloca_once_value(builder, _zero(width))
            builder.store(_zero(width), running)
            with cgutils.for_range(builder, count) as loop:
                begin = _row(builder, rows, at, loop.index, channels)
                factor = _splat(builder, _item(builder, numbers, at, loop.index), width)
                values = _load(builder, table, (begin, first), width)
                builder.store(_multiply_add(builder, values, factor, builder.load(running)), running)
            builder.store(builder.load(running), _place(builder, out, (place, first), width), align=4)

        _blocks(builder, channels, block)
        return context.get_dummy_value()

    return types.void(_TABLE, types.intp, *_LIST, _TABLE, types.intp), codegen


@intrinsic
def dot_rows(typingctx, table, channels, rows, numbers, at, count, other, place):
    """Write the products of table[rows_k] and `channels` elements of `other` from `place` on, as numbers."""

    def codegen(context, builder, signature, arguments):
        table, channels, rows, numbers, at, count, other, place = arguments
        with cgutils.for_range(builder, count) as loop:
            begin = _row(builder, rows, at, loop.index, channels)
            running = {width: cgutils.alloca_once_value(builder, _zero(width)) for width in _WIDTHS}
            for width in _WIDTHS:
                builder.store(_zero(width), running[width])

            def block(first, width, begin=begin, running=running):
                pair = _load(builder, table, (begin, first), width), _load(builder, other, (place, first), width)
                builder.store(_multiply_add(builder, *pair, builder.load(running[width])), running[width])

            _blocks(builder, channels, block)
            total = ir.Constant(ir.FloatType(), 0.0)
            for width in _WIDTHS:
                total = builder.fadd(total, _total(builder, builder.load(running[width])))
            builder.store(total, builder.gep(numbers, [builder.add(at, loop.index)]))
        return context.get_dummy_value()

    return types.void(_TABLE, types.intp, *_LIST, _TABLE, types.intp), codegen


@intrinsic
def spread_rows(typingctx, table, channels, rows, numbers, at, count, other, place):
    """Add numbers_k times `channels` elements of `other`, from `place` on, to table[rows_k]."""

    def codegen(context, builder, signature, arguments):
        table, channels, rows, numbers, at, count, other, place = arguments

        def block(first, width):
            values = _load(builder, other, (place, first), width)
            with cgutils.for_range(builder, count) as loop:
                begin = _row(builder, rows, at, loop.index, channels)
                factor = _splat(builder, _item(builder, numbers, at, loop.index), width)
                target = _place(builder, table, (begin, first), width)
                builder.store(_multiply_add(builder, values, factor, builder.load(target, align=4)), target, align=4)

        _blocks(builder, channels, block)
        return context.get_dummy_value()

    return types.void(_TABLE, types.intp, *_LIST, _TABLE, types.intp), codegen
