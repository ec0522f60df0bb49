"""Eight point-triangle distances at once, as explicit vectors: the compiler does not find them in the scalar formula.

Nothing is contracted or reordered, so that each lane rounds like `reference.py`, whose rules are numbered there.
"""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

LANES = 8

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_TINY = 1e-37  # least square of a length or an area that is divided by


class _Lanes:
    """Eight float32 numbers, with the signs of arithmetic."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    def __add__(self, other: "_Lanes") -> "_Lanes":
        return _Lanes(self.builder, self.builder.fadd(self.value, other.value))

    def __sub__(self, other: "_Lanes") -> "_Lanes":
        return _Lanes(self.builder, self.builder.fsub(self.value, other.value))

    def __mul__(self, other: "_Lanes") -> "_Lanes":
        return _Lanes(self.builder, self.builder.fmul(self.value, other.value))

    def inverse(self) -> "_Lanes":
        """1 / x, finite where x vanishes."""
        return _Lanes(self.builder, self.builder.fdiv(self.number(1.0).value, self.most(self.number(_TINY)).value))

    def least(self, other: "_Lanes") -> "_Lanes":
        return self.where("<", other, self, other)

    def most(self, other: "_Lanes") -> "_Lanes":
        return self.where(">", other, self, other)

    def where(self, relation: str, other: "_Lanes", then: "_Lanes", otherwise: "_Lanes") -> "_Lanes":
        """`then` in the lanes where the relation to `other` holds."""
        holds = self.builder.fcmp_ordered(relation, self.value, other.value)
        return _Lanes(self.builder, self.builder.select(holds, then.value, otherwise.value))

    def number(self, value: float) -> "_Lanes":
        return _Lanes(self.builder, ir.Constant(_FLOATS, [ir.Constant(ir.FloatType(), value)] * LANES))


_Vector = tuple[_Lanes, _Lanes, _Lanes]


def _minus(x: _Vector, y: _Vector) -> _Vector:
    return x[0] - y[0], x[1] - y[1], x[2] - y[2]


def _times(s: _Lanes, x: _Vector) -> _Vector:
    return s * x[0], s * x[1], s * x[2]


def _dot(x: _Vector, y: _Vector) -> _Lanes:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


def _cross(x: _Vector, y: _Vector) -> _Vector:
    return x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]


def _edge(pa: _Vector, pb: _Vector, along: _Vector, at_a: _Lanes, at_b: _Lanes) -> _Lanes:
    """Rule 1."""
    one, minus_one = at_a.number(1.0), at_a.number(-1.0)
    middle = pa[0] + pb[0], pa[1] + pb[1], pa[2] + pb[2]
    s = (_dot(middle, along) * _dot(along, along).inverse()).most(minus_one).least(one)
    arm = _minus(middle, _times(s, along))
    inside = _dot(arm, arm) * at_a.number(0.25)
    return s.where(">=", one, at_b, s.where("<=", minus_one, at_a, inside))


def _plane(pa: _Vector, ab: _Vector, ac: _Vector, least_square: _Lanes) -> _Lanes:
    """Rule 2."""
    normal = _cross(ab, ac)
    square = _dot(normal, normal)
    inverse = square.inverse()
    v = _dot(normal, _cross(pa, ac)) * inverse
    w = _dot(normal, _cross(ab, pa)) * inverse
    arm = _minus(_minus(pa, _times(v, ab)), _times(w, ac))
    squared, far = _dot(arm, arm), square.number(float("inf"))
    squared = square.where(">=", least_square, squared, far)
    squared = (v + w).where("<=", v.number(1.0), squared, far)
    return v.least(w).where(">=", v.number(0.0), squared, far)


def _squared_distance(p: _Vector, a: _Vector, b: _Vector, c: _Vector, least_square: _Lanes) -> _Lanes:
    pa, pb, pc = _minus(p, a), _minus(p, b), _minus(p, c)
    at_a, at_b, at_c = _dot(pa, pa), _dot(pb, pb), _dot(pc, pc)
    ab = _edge(pa, pb, _minus(b, a), at_a, at_b)
    bc = _edge(pb, pc, _minus(c, b), at_b, at_c)
    ca = _edge(pc, pa, _minus(a, c), at_c, at_a)
    return _plane(pa, _minus(b, a), _minus(c, a), least_square).least(ab).least(bc).least(ca)


def _eight_distances(is_point_query: bool) -> Callable[..., Any]:
    """The kernel for a point and eight triangles, or for a triangle and eight points."""

    @intrinsic
    def measure(typingctx, leaf, query, least_square, out):  # type: ignore[no-untyped-def]
        def codegen(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
            def data(place: int) -> Any:
                return context.make_array(signature.args[place])(context, builder, value=arguments[place]).data

            def block(number: int) -> _Lanes:
                start = builder.gep(data(0), [ir.Constant(ir.IntType(64), number * LANES)])
                return _Lanes(builder, builder.load(builder.bitcast(start, _FLOATS.as_pointer()), align=4))

            def repeated(number: Any) -> _Lanes:
                none, first = ir.Constant(_FLOATS, ir.Undefined), ir.Constant(ir.IntType(32), 0)
                places = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
                lone = builder.insert_element(none, number, first)
                return _Lanes(builder, builder.shuffle_vector(lone, none, places))

            def coordinate(number: int) -> _Lanes:
                return repeated(builder.load(builder.gep(data(1), [ir.Constant(ir.IntType(64), number)])))

            of_point, of_tri = (coordinate, block) if is_point_query else (block, coordinate)
            p = (of_point(0), of_point(1), of_point(2))
            a, b, c = ((of_tri(i), of_tri(i + 1), of_tri(i + 2)) for i in (0, 3, 6))
            squared = _squared_distance(p, a, b, c, repeated(arguments[2]))
            builder.store(squared.value, builder.bitcast(data(3), _FLOATS.as_pointer()), align=4)
            return context.get_dummy_value()

        return types.void(leaf, query, least_square, out), codegen

    return measure  # type: ignore[no-any-return]


point_to_eight_faces = _eight_distances(True)
"""measure(leaf (72,), point (1, 3), least_square, out (8,)): the twice-area square from which planes count."""
face_to_eight_points = _eight_distances(False)
"""measure(leaf (24,), triangle (3, 3), least_square, out (8,))."""
