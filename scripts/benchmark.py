"""Time named operations, whole steps and whole commands: `python scripts/benchmark.py --help`.

Without names every operation and step is timed; commands take seconds each and are timed where they are named.
An operation is reported only after the tests that prove it have passed.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    options = parse()
    from rendra_lab.benchmarking import first_calls, machine, run_benchmark, select, table_of
    from rendra_lab.benchmarks import BENCHMARKS
    from rendra_lab.errors import UserError
    from rendra_lab.report import write_json

    if options.list:
        for benchmark in BENCHMARKS:
            print(f"{benchmark.name:28}{benchmark.what}")
        return 0
    import torch

    try:
        chosen = select(BENCHMARKS, options.names)
        scene_of = prepare(options)
    except (UserError, ValueError, OSError) as error:
        sys.stderr.write(f"{Path(__file__).name}: {error}\n")
        return 2
    ours, rival, proofs = tools(options.skip_tests)
    finish = partial(torch.cuda.synchronize, options.device) if options.device == "cuda" else lambda: None
    results = []
    with tempfile.TemporaryDirectory() as folder:
        scene = scene_of(folder=Path(folder))
        settings = {"mesh": scene.name, **machine(options.device)}
        for benchmark in chosen:
            sys.stderr.write(f"{benchmark.name}\n")
            results.append(run_benchmark(benchmark, scene, ours, rival, proofs, finish))
    print_report(table_of(results), first_calls(results), settings, rival)
    if options.json:
        write_json(options.json, {"settings": settings, "benchmarks": [result.as_dict() for result in results]})
    return 1 if any(result.refusal for result in results) else 0


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="names or globs of benchmarks, such as 'silhouette_*'")
    parser.add_argument("--list", action="store_true", help="list the benchmarks and stop")
    parser.add_argument("--mesh", type=Path, help="a mesh file; without one, the project's own cow")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--threads", type=int, help="threads of torch and of the kernels; default: as torch has it")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results there too")
    parser.add_argument("--skip-tests", action="store_true", help="do not run the tests; marks each number untested")
    return parser.parse_args()


def prepare(options: argparse.Namespace) -> Any:
    """The scene, but for its folder."""
    import torch

    from rendra_lab.benchmarks.scene import Scene
    from rendra_lab.data.meshes import load_mesh

    if options.threads is not None:
        if options.threads < 1:
            raise ValueError(f"--threads must be at least 1, got {options.threads}")
        torch.set_num_threads(options.threads)
    if options.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("there is no CUDA device here: leave --device out")
    mesh = load_mesh(path=options.mesh, device=options.device)
    return partial(Scene, mesh, options.mesh, torch.device(options.device))


def tools(skip_tests: bool) -> tuple[Any, Any, Any]:
    """Our library, PyTorch3D or None, and what runs the tests or None."""
    from rendra_lab.benchmarking import Proofs
    from rendra_lab.benchmarks.scene import Library

    try:
        rival = Library("pytorch3d")
    except ImportError:
        rival = None
    return Library("rendra"), rival, None if skip_tests else Proofs(ROOT)


def print_report(table: Any, first: str, settings: dict[str, Any], rival: Any) -> None:
    from rich.console import Console

    console = Console()
    if not console.is_terminal:
        console = Console(width=180)
    console.print(table)
    console.print(first, highlight=False)
    console.print(", ".join(f"{name} {value}" for name, value in settings.items() if value), highlight=False)
    load = settings["load_average"]
    if load and load[0] > 0.5:
        console.print(f"this machine was busy with other work (load {load[0]}): the numbers are too high")
    console.print("must and aim: for two cores and a cow of 5,856 faces", highlight=False)
    if rival is None:
        console.print("PyTorch3D is not installed here, so nothing is compared with it", highlight=False)


if __name__ == "__main__":
    sys.exit(main())
