"""Functions of angles that stay finite, with their gradients, where the textbook formula divides by zero.

The ratios take the SQUARED angle x = theta², in which they are smooth: near zero they follow their power
series, elsewhere the closed form, and neither branch ever sees the other's arguments (the safe-where trick),
so gradients of any order are finite at the identity.
"""

import math
from collections.abc import Callable

import torch
from torch import Tensor

DEFAULT_ACOS_BOUND: float = 1.0 - 1e-4


def acos_linear_extrapolation(
    x: Tensor, bounds: tuple[float, float] = (-DEFAULT_ACOS_BOUND, DEFAULT_ACOS_BOUND)
) -> Tensor:
    """Arc cosine inside `bounds`, its tangent line outside: finite gradients for every real x.

    Args:
        x: any shape.
        bounds: (lower, upper), -1 < lower <= upper < 1, in radians' cosine.

    Raises:
        ValueError: if the bounds are out of order or not inside (-1, 1).
    """
    lower, upper = bounds
    if lower > upper:
        raise ValueError(f"lower bound has to be smaller or equal to upper bound; got {bounds}")
    if lower <= -1.0 or upper >= 1.0:
        raise ValueError(f"Both lower bound and upper bound have to be within (-1, 1); got {bounds}")
    inside = x.clamp(lower, upper)
    below = _acos_tangent(x, lower)
    above = _acos_tangent(x, upper)
    return torch.where(x <= lower, below, torch.where(x >= upper, above, torch.acos(inside)))


def _acos_tangent(x: Tensor, at: float) -> Tensor:
    """The first-order Taylor polynomial of acos around `at`."""
    return math.acos(at) - (x - at) / math.sqrt(1.0 - at * at)


def sine_ratio(angle_squared: Tensor) -> Tensor:
    """sin(theta) / theta, from theta²; 1 at zero."""
    return _smooth(angle_squared, lambda t: t.sin() / t, (1.0, -1 / 6, 1 / 120), bound=1e-4)


def versine_ratio(angle_squared: Tensor) -> Tensor:
    """(1 - cos(theta)) / theta², from theta²; 1/2 at zero. By the half angle, hence free of cancellation."""
    return 0.5 * sine_ratio(0.25 * angle_squared).square()


def sine_defect_ratio(angle_squared: Tensor) -> Tensor:
    """(theta - sin(theta)) / theta³, from theta²; 1/6 at zero."""
    series = tuple((-1) ** k / math.factorial(2 * k + 3) for k in range(7))
    return _smooth(angle_squared, lambda t: (t - t.sin()) / t**3, series, bound=0.25)


def cotangent_defect_ratio(angle_squared: Tensor) -> Tensor:
    """(1 - (theta/2) cot(theta/2)) / theta², from theta²; 1/12 at zero. Finite for theta < 2 pi."""
    series = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000, 1 / 74724249600)
    return _smooth(angle_squared, lambda t: (1 - 0.5 * t / torch.tan(0.5 * t)) / t.square(), series, bound=0.25)


def _smooth(x: Tensor, closed_form: Callable[[Tensor], Tensor], series: tuple[float, ...], bound: float) -> Tensor:
    """`closed_form(sqrt(x))` where x >= bound, the polynomial `series` in x below; x >= 0."""
    near = x < bound
    far = closed_form(torch.where(near, 1.0, x).sqrt())
    polynomial = series[-2] + series[-1] * x
    for coefficient in reversed(series[:-2]):
        polynomial = coefficient + x * polynomial
    return torch.where(near, polynomial, far)
