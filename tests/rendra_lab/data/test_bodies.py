"""Bodies that configurations name."""

from pathlib import Path

import pytest
import torch

from rendra.body import SMPL, read_free_parts, write_parts
from rendra_lab.data.bodies import body_file, free_body
from rendra_lab.errors import UserError


def test_the_free_bodies() -> None:
    assert len(free_body(low=True).v_template) < len(free_body().v_template)


def test_a_file_of_your_own(tmp_path: Path) -> None:
    write_parts(tmp_path / "body.npz", read_free_parts(low=True))
    body = body_file(tmp_path / "body.npz", num_betas=4)
    assert body.num_betas == 4
    torch.testing.assert_close(body.v_template, SMPL.free(low=True).v_template)


def test_what_is_no_body_is_told_by_its_key(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"body\.path: there is no body model .*none\.npz"):
        body_file(tmp_path / "none.npz")
    (tmp_path / "text.pkl").write_text("no pickle")
    with pytest.raises(UserError, match=r"body\.path: .*text\.pkl"):
        body_file(tmp_path / "text.pkl")
