"""Benchmarks: their statistics, what is refused, and that every operation of the list runs."""

from io import StringIO
from pathlib import Path

import pytest
import torch
from rich.console import Console

from rendra.utils import ico_sphere
from rendra_lab.benchmarking import (
    Benchmark,
    Proofs,
    Result,
    Timing,
    first_calls,
    measure,
    run_benchmark,
    select,
    table_of,
)
from rendra_lab.benchmarks import BENCHMARKS
from rendra_lab.benchmarks.geometry import write_grid_obj
from rendra_lab.benchmarks.scene import ROOT, Library, Scene
from rendra_lab.data.meshes import load_mesh
from rendra_lab.errors import UserError

PASSES, FAILS = "tests/test_passes.py", "tests/test_fails.py"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    """A project with a test that passes and notes each of its runs, and one that fails."""
    (tmp_path / "src").mkdir()
    (tmp_path / "tests").mkdir()
    (tmp_path / "src" / "code.py").write_text("x = 1\n")
    note = f"open({str(tmp_path / 'runs')!r}, 'a').write('x')"
    (tmp_path / PASSES).write_text(f"def test_it():\n    {note}\n")
    (tmp_path / FAILS).write_text("def test_sum():\n    assert 1 + 1 == 3\n")
    return tmp_path


def benchmark(*proofs: str, **options) -> Benchmark:
    return Benchmark("sleep", "nothing at all", lambda library, scene: lambda: None, proofs, **options)


def text_of(*results: Result) -> str:
    page = StringIO()
    Console(width=200, file=page).print(table_of(results))
    return page.getvalue()


def test_statistics_of_known_times() -> None:
    timing = Timing.of([0.004, 0.001, 0.003, 0.002, 0.005], first_call=0.1)
    assert timing == Timing(3.0, 1.0, 2.0, 4.0, 5.0, 5, 100.0)
    assert Timing.of([0.25], 0.5) == Timing(250.0, 250.0, 250.0, 250.0, 250.0, 1, 500.0)
    with pytest.raises(ValueError, match="no run was timed"):
        Timing.of([], 0.1)


def test_the_first_call_and_unfinished_work_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    costs = iter([5.0] + [0.25] * 100)
    monkeypatch.setattr("rendra_lab.benchmarking.time.perf_counter", lambda: clock[0])

    def run() -> None:
        clock[0] += next(costs)

    def finish() -> None:
        clock[0] += 0.125

    timing = measure(run, finish)
    assert timing.first_call_ms == pytest.approx(5125)
    assert timing.median_ms == pytest.approx(375)
    assert timing.runs == 8  # 3 s of them


@pytest.mark.parametrize(("cost", "runs"), [(0.001, 30), (2.0, 3), (25.0, 1)])
def test_the_number_of_runs_follows_their_length(monkeypatch: pytest.MonkeyPatch, cost: float, runs: int) -> None:
    clock = [0.0]
    monkeypatch.setattr("rendra_lab.benchmarking.time.perf_counter", lambda: clock[0])

    def run() -> None:
        clock[0] += cost

    assert measure(run).runs == runs


def test_an_operation_whose_tests_fail_is_not_reported(project: Path) -> None:
    prepared = []
    refused = Benchmark("broken", "a sum", lambda *parts: prepared.append(parts), (PASSES, FAILS))
    result = run_benchmark(refused, None, None, None, Proofs(project))
    assert result.timing is None
    assert not prepared  # not even timed
    assert "test_fails.py::test_sum" in result.refusal
    assert "refused: tests/test_fails.py" in text_of(result)
    assert result.as_dict()["rendra"] is None


def test_tests_run_once_until_something_changes(project: Path) -> None:
    proofs, runs = Proofs(project), project / "runs"
    for _ in range(2):
        assert proofs.objection([PASSES]) is None
    assert runs.read_text() == "x"
    (project / "src" / "code.py").write_text("x = 2\n")
    assert proofs.objection([PASSES]) is None
    assert runs.read_text() == "xx"
    assert proofs.objection(["tests/test_gone.py"]) == "tests/test_gone.py is missing"


def test_skipped_tests_are_said_beside_the_number() -> None:
    result = run_benchmark(benchmark(FAILS), None, None, None, None)
    assert result.timing is not None
    assert not result.as_dict()["tested"]
    assert "untested" in text_of(result)
    assert first_calls([result]).startswith("first calls, not counted: sleep ")


def test_a_rival_is_timed_where_it_has_the_operation() -> None:
    slow = Timing.of([0.5], 0.5)
    result = Result(benchmark(), Timing.of([0.1], 0.1), rival=slow)
    assert result.ratio == pytest.approx(5.0)
    assert "PyTorch3D" in text_of(result)
    seen: list[object] = []
    shared = Benchmark("a", "a", lambda library, scene: lambda: seen.append(library), ())
    assert run_benchmark(shared, None, "ours", "theirs", None).rival is not None
    assert set(seen) == {"ours", "theirs"}
    assert run_benchmark(benchmark(is_public=False), None, "ours", "theirs", None).rival is None


def test_names_and_globs_choose() -> None:
    chosen = [b.name for b in select(BENCHMARKS, ["silhouette_*_backward", "raster_hard"])]
    assert chosen == ["raster_hard", "silhouette_256_backward", "silhouette_512_backward"]
    assert not any(b.is_command for b in select(BENCHMARKS, []))
    assert all(b.is_command for b in select(BENCHMARKS, ["command_*"]))
    with pytest.raises(UserError, match=r"no benchmark is called 'rasta'; there are: raster_hard, "):
        select(BENCHMARKS, ["raster_*", "rasta"])


def test_names_are_unique_and_proofs_exist() -> None:
    names = [b.name for b in BENCHMARKS]
    assert len(set(names)) == len(names)
    for b in BENCHMARKS:
        assert b.proofs
        assert all((ROOT / file).is_file() for file in b.proofs), b.name


@pytest.mark.parametrize("timed", [b for b in BENCHMARKS if not b.is_command], ids=lambda b: b.name)
def test_every_operation_runs(timed: Benchmark, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "rendra_lab.benchmarks.geometry.write_grid_obj", lambda path, side: write_grid_obj(path, min(side, 5))
    )
    scene = Scene(load_mesh("ico_sphere", level=1), None, torch.device("cpu"), tmp_path)
    timed.prepare(Library("rendra"), scene)()


def test_both_libraries_get_the_same_mesh() -> None:
    mesh = load_mesh("cow", texture_size=128, num_faces=2000)
    copied = Scene(mesh, None, torch.device("cpu"), Path()).mesh_of(Library("rendra"))
    assert torch.equal(copied.verts_packed(), mesh.verts_packed())
    assert torch.equal(copied.textures.maps_padded(), mesh.textures.maps_padded())
    bare = Scene(ico_sphere(0), None, torch.device("cpu"), Path()).mesh_of(Library("rendra"))
    assert torch.equal(bare.textures.verts_features_packed(), torch.ones(12, 3))


def test_an_absent_library_is_an_import_error() -> None:
    with pytest.raises(ImportError):
        Library("a_library_that_nobody_has")


def test_the_grid_is_an_obj_of_the_size_that_is_promised(tmp_path: Path) -> None:
    from rendra.io import load_obj

    path = tmp_path / "grid.obj"
    write_grid_obj(path, 4)
    verts, faces, properties = load_obj(path)
    assert verts.shape == (16, 3)
    assert faces.verts_idx.shape == (18, 3)
    assert properties.verts_uvs.shape == (16, 2)
    assert 2 * (388 - 1) ** 2 == 299_538
