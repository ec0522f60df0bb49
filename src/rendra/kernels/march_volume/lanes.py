"""The channels of a voxel as one vector: what the compiler does not find in scalar code by itself.

Lanes are a tuple of K float32, K a constant of the type, so that every loop over channels is a vector instruction.
A cell is the 8 voxels around a point; two neighbours along x lie side by side in memory, so that a cell is 4 vectors
of 2 K numbers. Nothing here looks at bounds: `numba_cpu` does.

Memory is passed as pointers: an array that is handed from function to function has its references counted, atomically
and by all threads, sample by sample. Whoever takes a pointer keeps the array alive.
"""

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

BLOCK = 64  # samples that are looked at together


def _vector(count):
    return ir.VectorType(ir.FloatType(), count)


def _packed(builder, values):
    """Scalars as a vector."""
    vector = ir.Constant(_vector(len(values)), ir.Undefined)
    for i, value in enumerate(values):
        vector = builder.insert_element(vector, value, ir.IntType(32)(i))
    return vector


def _lanes_of(context, builder, kind, vector):
    """A vector as a tuple of the type `kind`."""
    return context.make_tuple(
        builder, kind, [builder.extract_element(vector, ir.IntType(32)(i)) for i in range(len(kind))]
    )


def _vector_of(builder, kind, lanes):
    return _packed(builder, [builder.extract_value(lanes, i) for i in range(len(kind))])


def _splat(builder, value, count):
    return _packed(builder, [value] * count)


def _multiply_add(builder, a, b, c):
    """The vector a b + c, fused where the processor can."""
    suffix = f"v{a.type.count}f32" if isinstance(a.type, ir.VectorType) else "f32"
    signature = ir.FunctionType(a.type, [a.type] * 3)
    fused = cgutils.get_or_insert_function(builder.module, signature, f"llvm.fmuladd.{suffix}")
    return builder.call(fused, [a, b, c])


def _slice(builder, vector, first, count):
    mask = ir.Constant(ir.VectorType(ir.IntType(32), count), [first + i for i in range(count)])
    return builder.shuffle_vector(vector, ir.Constant(vector.type, ir.Undefined), mask)


def _place(builder, data, at, count):
    """Where `count` numbers begin."""
    return builder.bitcast(builder.gep(data, [at]), _vector(count).as_pointer())


def _row_offsets(builder, at, row, plane):
    """The four rows of a cell, x along each: y and then z are far in the later ones."""
    upper = builder.add(at, plane)
    return at, builder.add(at, row), upper, builder.add(upper, row)


def _numbers(builder, weights, near):
    """The five numbers of a sample in a block."""
    return [builder.load(builder.gep(weights, [builder.add(near, ir.IntType(64)(BLOCK * i))])) for i in range(5)]


@intrinsic
def pointer(typingctx, array):
    """To the first element of a contiguous array."""

    def codegen(context, builder, signature, arguments):
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def gather(typingctx, flat, at, row, plane, weights, near, lanes):
    """The lanes between the voxels of a cell, whose first begins at flat[at]; rows and planes lie apart as said.

    What counts is at weights[near + BLOCK i]: i = 0 is the fraction along x, 1 to 4 are the weights of the rows.
    """

    def codegen(context, builder, signature, arguments):
        data, at, row, plane, weights, near, _ = arguments
        count = len(lanes)
        fraction, *shares = _numbers(builder, weights, near)
        total = ir.Constant(_vector(2 * count), [0.0] * (2 * count))
        for offset, share in zip(_row_offsets(builder, at, row, plane), shares, strict=True):
            pair = builder.load(_place(builder, data, offset, 2 * count), align=4)
            total = _multiply_add(builder, pair, _splat(builder, share, 2 * count), total)
        near, far = (_slice(builder, total, first, count) for first in (0, count))
        blended = _multiply_add(builder, builder.fsub(far, near), _splat(builder, fraction, count), near)
        return _lanes_of(context, builder, lanes, blended)

    return lanes(flat, types.intp, types.intp, types.intp, weights, types.intp, lanes), codegen


@intrinsic
def scatter(typingctx, flat, at, row, plane, weights, near, lanes):
    """Add lanes to the voxels of a cell, each its share: the transpose of `gather`.

    Voxel by voxel: the next sample's cell often begins one voxel further, and what is loaded from half of a longer
    store has to wait until that is in the cache.
    """

    def codegen(context, builder, signature, arguments):
        data, at, row, plane, weights, near, values = arguments
        count = len(lanes)
        fraction, *shares = _numbers(builder, weights, near)
        whole = _vector_of(builder, lanes, values)
        far = builder.fmul(whole, _splat(builder, fraction, count))
        ends = builder.fsub(whole, far), far
        for offset, share in zip(_row_offsets(builder, at, row, plane), shares, strict=True):
            weight = _splat(builder, share, count)
            for i, end in enumerate(ends):
                place = _place(builder, data, builder.add(offset, ir.IntType(64)(i * count)), count)
                old = builder.load(place, align=4)
                builder.store(_multiply_add(builder, end, weight, old), place, align=4)
        return context.get_dummy_value()

    return types.void(flat, types.intp, types.intp, types.intp, weights, types.intp, lanes), codegen


@intrinsic
def load(typingctx, flat, at, lanes):
    """The lanes that begin at flat[at]."""

    def codegen(context, builder, signature, arguments):
        place = _place(builder, arguments[0], arguments[1], len(lanes))
        return _lanes_of(context, builder, lanes, builder.load(place, align=4))

    return lanes(flat, types.intp, lanes), codegen


@intrinsic
def store(typingctx, flat, at, lanes):
    """Write lanes to flat[at] and after."""

    def codegen(context, builder, signature, arguments):
        place = _place(builder, arguments[0], arguments[1], len(lanes))
        builder.store(_vector_of(builder, lanes, arguments[2]), place, align=4)
        return context.get_dummy_value()

    return types.void(flat, types.intp, lanes), codegen


@intrinsic
def add_scaled(typingctx, total, factor, lanes):
    """The sum total + factor lanes."""

    def codegen(context, builder, signature, arguments):
        total, factor, values = arguments
        vector = _multiply_add(
            builder,
            _vector_of(builder, lanes, values),
            _splat(builder, factor, len(lanes)),
            _vector_of(builder, lanes, total),
        )
        return _lanes_of(context, builder, lanes, vector)

    return lanes(lanes, types.float32, lanes), codegen


@intrinsic
def multiplied(typingctx, lanes, others):
    """Lane by lane."""

    def codegen(context, builder, signature, arguments):
        a, b = (_vector_of(builder, lanes, values) for values in arguments)
        return _lanes_of(context, builder, lanes, builder.fmul(a, b))

    return lanes(lanes, lanes), codegen


@intrinsic
def dot(typingctx, lanes, others):
    """The sum of products, in order."""

    def codegen(context, builder, signature, arguments):
        total = ir.Constant(ir.FloatType(), 0.0)
        for i in range(len(lanes)):
            a, b = (builder.extract_value(values, i) for values in arguments)
            total = _multiply_add(builder, a, b, total)
        return total

    return types.float32(lanes, lanes), codegen


@intrinsic
def weighted_sum(typingctx, total, flat, weights, values, number):
    """The lanes total + sum_j w_j v_j: `number` weights begin at flat[weights], as many lanes at flat[values]."""

    def codegen(context, builder, signature, arguments):
        total, data, weights, values, number = arguments
        kind = signature.args[0]
        width = ir.IntType(64)(len(kind))
        running = cgutils.alloca_once_value(builder, _vector_of(builder, kind, total))
        with cgutils.for_range(builder, number) as loop:
            weight = builder.load(builder.gep(data, [builder.add(weights, loop.index)]))
            place = _place(builder, data, builder.add(values, builder.mul(loop.index, width)), len(kind))
            term = builder.load(place, align=4), _splat(builder, weight, len(kind))
            builder.store(_multiply_add(builder, *term, builder.load(running)), running)
        return _lanes_of(context, builder, kind, builder.load(running))

    return total(total, flat, types.intp, types.intp, types.intp), codegen
