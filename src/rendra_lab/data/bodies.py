"""Body models that configurations name: `body=free`, `body=free_low`, `body=smpl body.path=FILE`."""

from __future__ import annotations

from pathlib import Path

from rendra.body import SMPL, BodyFormatError
from rendra_lab.errors import UserError


def free_body(low: bool = False) -> SMPL:
    """The built-in body; see `rendra.body.SMPL.free`."""
    return SMPL.free(low)


def body_file(path: str | Path, num_betas: int | None = None) -> SMPL:
    """A registered model; see `rendra.body.SMPL.load`.

    Raises:
        UserError: no such file, or one that holds no body; says which, and why.
    """
    try:
        return SMPL.load(path, num_betas)
    except (FileNotFoundError, BodyFormatError) as error:
        raise UserError(f"body.path: {error}") from error
