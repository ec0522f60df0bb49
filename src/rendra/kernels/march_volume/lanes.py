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
    """The four rows of a cell with their places along y and z."""
    upper = builder.add(at, plane)
    return ((at, 0, 0), (builder.add(at, row), 1, 0), (upper, 0, 1), (builder.add(upper, row), 1, 1))


def _both(builder, fraction):
    """How far the near and the far end of an axis count."""
    return builder.fsub(ir.Constant(ir.FloatType(), 1.0), fraction), fraction


@intrinsic
def pointer(typingctx, array):
    """To the first element of a contiguous array."""

    def codegen(context, builder, signature, arguments):
        return context.make_array(signature.args[0])(context, builder, arguments[0]).data

    return types.CPointer(array.dtype)(array), codegen


@intrinsic
def gather(typingctx, flat, at, row, plane, fx, fy, fz, lanes):
    """The lanes at fractions f of a cell whose first voxel begins at flat[at]; rows and planes lie apart as said."""

    def codegen(context, builder, signature, arguments):
        data, at, row, plane, fx, fy, fz, _ = arguments
        count = len(lanes)
        along_y, along_z = _both(builder, fy), _both(builder, fz)
        total = ir.Constant(_vector(2 * count), [0.0] * (2 * count))
        for offset, y, z in _row_offsets(builder, at, row, plane):
            pair = builder.load(_place(builder, data, offset, 2 * count), align=4)
            weight = _splat(builder, builder.fmul(along_y[y], along_z[z]), 2 * count)
            total = _multiply_add(builder, pair, weight, total)
        near, far = (_slice(builder, total, first, count) for first in (0, count))
        blended = _multiply_add(builder, builder.fsub(far, near), _splat(builder, fx, count), near)
        return _lanes_of(context, builder, lanes, blended)

    return lanes(flat, types.intp, types.intp, types.intp, *[types.float32] * 3, lanes), codegen


@intrinsic
def scatter(typingctx, flat, at, row, plane, fx, fy, fz, lanes):
    """Add lanes to the voxels of a cell, each its share: the transpose of `gather`."""

    def codegen(context, builder, signature, arguments):
        data, at, row, plane, fx, fy, fz, values = arguments
        count = len(lanes)
        along_x, along_y, along_z = (_both(builder, fraction) for fraction in (fx, fy, fz))
        scalars = [builder.extract_value(values, i) for i in range(count)]
        spread = _packed(builder, scalars * 2)
        shares = _packed(builder, [along_x[0]] * count + [along_x[1]] * count)
        spread = builder.fmul(spread, shares)
        for offset, y, z in _row_offsets(builder, at, row, plane):
            place = _place(builder, data, offset, 2 * count)
            weight = _splat(builder, builder.fmul(along_y[y], along_z[z]), 2 * count)
            builder.store(_multiply_add(builder, spread, weight, builder.load(place, align=4)), place, align=4)
        return context.get_dummy_value()

    return types.void(flat, types.intp, types.intp, types.intp, *[types.float32] * 3, lanes), codegen


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
