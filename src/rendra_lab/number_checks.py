"""Numbers of a configuration, checked by what builds with them: what was given, and what was expected."""

from __future__ import annotations

from rendra_lab.errors import UserError


def check_at_least(least: int, group: str, **numbers: int) -> None:
    """Counts.

    Raises:
        UserError: one of them is less, named as `group.name`.
    """
    for name, number in numbers.items():
        if number < least:
            raise UserError(f"{group}.{name} must be at least {least}, got {number}")


def check_above_zero(group: str, **numbers: float) -> None:
    """Lengths, densities and the like.

    Raises:
        UserError: one of them is not above zero, named as `group.name`.
    """
    for name, number in numbers.items():
        if not number > 0:
            raise UserError(f"{group}.{name} must be above 0, got {number}")


def check_shares(group: str, **numbers: float) -> None:
    """Opacities, transmittances and parts of something.

    Raises:
        UserError: one of them is not in [0, 1], named as `group.name`.
    """
    for name, number in numbers.items():
        if not 0 <= number <= 1:
            raise UserError(f"{group}.{name} is a share, in [0, 1], got {number}")
