"""What benchmarks are written against: a library, a scene, and how a function is timed with its gradients."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from itertools import count
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from rendra.renderer import TexturesUV, TexturesVertex
from rendra.structures import Meshes
from rendra_lab.benchmarking import Run

ROOT = Path(__file__).parents[3]
_VIEW = (2.7, 0.0, 180.0)  # distance, elevation and azimuth in degrees: the front of a cow


class Library:
    """The modules of rendra, or of PyTorch3D under the same names.

    Args:
        name: rendra or pytorch3d.

    Raises:
        ImportError: the library is not installed, or does not load.
    """

    renderer: ModuleType
    structures: ModuleType
    io: ModuleType
    ops: ModuleType
    loss: ModuleType
    utils: ModuleType

    def __init__(self, name: str) -> None:
        self.name = name
        for part in ("renderer", "structures", "io", "ops", "loss", "utils"):
            setattr(self, part, import_module(f"{name}.{part}"))


@dataclass(frozen=True)
class Scene:
    """What is rendered, and where.

    Attributes:
        mesh: a batch of one with a texture, of rendra.
        path: its file; None for the project's own cow.
        device: cpu or cuda.
        folder: for temporary files.
    """

    mesh: Meshes
    path: Path | None
    device: torch.device
    folder: Path

    def mesh_of(self, library: Library) -> Any:
        """The mesh in the words of a library."""
        own, renderer = self.mesh.textures, library.renderer
        if isinstance(own, TexturesUV):
            textures = renderer.TexturesUV(own.maps_padded(), own.faces_uvs_list(), own.verts_uvs_list())
        elif isinstance(own, TexturesVertex):
            textures = renderer.TexturesVertex(own.verts_features_list())
        else:
            textures = renderer.TexturesVertex([torch.ones_like(self.mesh.verts_packed())])
        return library.structures.Meshes(self.mesh.verts_list(), self.mesh.faces_list(), textures)

    def cameras_of(self, library: Library) -> Any:
        """The usual camera in the words of a library."""
        R, T = library.renderer.look_at_view_transform(*_VIEW)
        return library.renderer.FoVPerspectiveCameras(R=R, T=T, device=self.device)

    def rasterizer_of(self, library: Library, **settings: Any) -> Any:
        """A rasterizer with the usual camera."""
        settings = library.renderer.RasterizationSettings(**settings)
        return library.renderer.MeshRasterizer(self.cameras_of(library), settings)

    @cached_property
    def name(self) -> str:
        """The mesh for people."""
        origin = "procedural cow" if self.path is None else self.path.name
        return f"{origin}, {len(self.mesh.faces_packed()):,} faces"


def timed(forward: Callable[[], Any], leaf: Tensor, backward: bool) -> Run:
    """`forward` without gradients, or with those of fixed upstream gradients with respect to `leaf`."""
    if not backward:
        return torch.no_grad()(forward)
    leaf.requires_grad_()
    upstream = [torch.rand_like(output) for output in forward()]

    def run() -> None:
        torch.autograd.grad(forward(), leaf, upstream)

    return run


def command(*arguments: str, key: str = "mesh.path") -> Callable[[Library, Scene], Run]:
    """`python train.py ...` with the scene's mesh at `key`, from start to end."""

    def prepare(library: Library, scene: Scene) -> Run:
        trainer = "gpu" if scene.device.type == "cuda" else "cpu"
        fixed = [sys.executable, str(ROOT / "train.py"), f"trainer={trainer}", *arguments]
        if scene.path is not None:
            fixed.append(f"{key}={scene.path.resolve()}")
        numbers = count()

        def run() -> None:
            command = [*fixed, f"hydra.run.dir={scene.folder / f'run-{next(numbers)}'}"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise RuntimeError(f"{' '.join(command)} ended with code {done.returncode}:\n{done.stderr[-2000:]}")

        return run

    return prepare
