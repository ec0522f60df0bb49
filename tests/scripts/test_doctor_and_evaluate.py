"""The two small front doors: what the machine has, and scoring a run again."""

import runpy
import sys
from pathlib import Path
from typing import Any

import pytest

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture
def doctor() -> dict[str, Any]:
    return runpy.run_path(str(REPOSITORY / "scripts" / "doctor.py"))


def test_the_doctor_reports_every_section(doctor: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    doctor["main"]()
    said = capsys.readouterr().out
    for word in ("machine", "torch", "numba threading layer", "kernel cache", "[gpu]", "[view]", "torchvision"):
        assert word in said


def test_a_failing_probe_is_a_row(doctor: dict[str, Any]) -> None:
    def probe() -> list:
        raise RuntimeError("no such thing\nand more")

    ((what, found, hint),) = doctor["attempt"](probe)
    assert (what, found, bool(hint)) == ("probe", "RuntimeError: no such thing", True)


def test_a_missing_package_comes_with_its_line(doctor: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    scope = doctor["packages"].__globals__
    monkeypatch.setitem(scope, "REQUIRED", ("no-such-package",))
    assert ("no-such-package", "missing", "pip install no-such-package") in doctor["packages"]()


def test_a_broken_torchvision_is_found_out(
    doctor: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    scope = doctor["torchvision"].__globals__
    monkeypatch.setitem(scope, "version_of", lambda name: "0.28.0")
    (tmp_path / "torchvision.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "torchvision", raising=False)
    ((_, found, hint),) = doctor["torchvision"]()
    assert "broken (operator torchvision::nms does not exist)" in found
    assert "pip uninstall torchvision" in hint


def test_evaluate_refuses_a_folder_without_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["evaluate.py", str(tmp_path)])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(REPOSITORY / "scripts" / "evaluate.py"), run_name="__main__")
    assert end.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith("evaluate.py: ")
    assert "not the folder of a run" in said
