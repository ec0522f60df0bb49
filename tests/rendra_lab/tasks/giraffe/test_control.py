"""What a program leaves in its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from far_device import far  # noqa: F401
from PIL import Image
from scenes_of_discs import Discs

from rendra_lab.errors import UserError
from rendra_lab.tasks.giraffe.control import play, programs_named
from rendra_lab.tasks.giraffe.programs import PROGRAMS, Order

ORDER = Order(samples=2, steps=4, anchors=2, add_up_to=3)


@pytest.mark.parametrize("program", list(PROGRAMS))
def test_films_sheets_and_strips(program: str, tmp_path: Path) -> None:
    written = play(Discs(objects=2), program, ORDER, tmp_path)
    assert [path.name for path in written] == [f"{program}.png", f"{program}.gif", f"{program}_sm.gif"]
    strips = [f"{scene:04d}_{program}{end}.png" for scene in range(2) for end in ("", "_masks")]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([*strips, *(path.name for path in written)])
    with Image.open(tmp_path / strips[0]) as strip, Image.open(tmp_path / strips[1]) as masks:
        assert strip.size == (6 * 64 + 5 * 6, 64)
        assert masks.width == strip.width
        assert masks.height > 5 * 64


def test_open_paths_go_back_and_closed_ones_round(tmp_path: Path) -> None:
    for program, count in (("translation_object_depth", 6), ("rotation_object", 8)):
        play(Discs(), program, ORDER, tmp_path)
        with Image.open(tmp_path / f"{program}.gif") as film:
            assert film.n_frames == count  # type: ignore[attr-defined]


def test_programs_have_names() -> None:
    assert programs_named("all") == list(PROGRAMS)
    assert programs_named("add_objects") == ["add_objects"]
    with pytest.raises(UserError, match=r"program must be all or one of rotation_object, .*; got dance"):
        programs_named("dance")


@pytest.mark.parametrize("program", list(PROGRAMS))
def test_programs_stay_on_the_device_of_the_scenes(program: str, far: Any, tmp_path: Path) -> None:  # noqa: F811
    play(Discs(objects=2, device=far), program, ORDER, tmp_path / "there")
    play(Discs(objects=2), program, ORDER, tmp_path / "here")
    there, here = (Image.open(tmp_path / place / f"{program}.png") for place in ("there", "here"))
    assert there.tobytes() == here.tobytes()
