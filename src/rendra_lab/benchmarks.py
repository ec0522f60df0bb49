"""The operations that `scripts/benchmark.py` times.

An operation of the public API is written once against a `Library`, which is rendra or PyTorch3D: the same calls on
the same input. Steps of tasks and whole commands are rendra's alone.
"""

from __future__ import annotations

import math
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
from rendra_lab.benchmarking import Benchmark, Run

ROOT = Path(__file__).parents[2]
SIGMA = 1e-4  # squared NDC, the usual width of an edge
REACH = math.log(1 / 1e-4 - 1) * SIGMA  # blur radius at which the sigmoid of an edge has fallen to 1e-4
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
    utils: ModuleType

    def __init__(self, name: str) -> None:
        self.name = name
        for part in ("renderer", "structures", "io", "utils"):
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


def _timed(forward: Callable[[], Any], leaf: Tensor, backward: bool) -> Run:
    """`forward` without gradients, or with those of fixed upstream gradients with respect to `leaf`."""
    if not backward:
        return torch.no_grad()(forward)
    leaf.requires_grad_()
    upstream = [torch.rand_like(output) for output in forward()]

    def run() -> None:
        torch.autograd.grad(forward(), leaf, upstream)

    return run


def _rasterization(layers: int, blur_radius: float, backward: bool) -> Callable[[Library, Scene], Run]:
    def prepare(library: Library, scene: Scene) -> Run:
        seen = scene.rasterizer_of(library).transform(scene.mesh_of(library))
        offsets = torch.zeros_like(seen.verts_packed())

        def forward() -> list[Tensor]:
            _, *fragments = library.renderer.rasterize_meshes(
                seen.offset_verts(offsets),
                image_size=256,
                blur_radius=blur_radius,
                faces_per_pixel=layers,
                perspective_correct=True,
                clip_barycentric_coords=blur_radius > 0,
            )
            return fragments

        return _timed(forward, offsets, backward)

    return prepare


def _rendering(
    shader: str, size: int, layers: int, blur_radius: float, backward: bool
) -> Callable[[Library, Scene], Run]:
    def prepare(library: Library, scene: Scene) -> Run:
        api, mesh = library.renderer, scene.mesh_of(library)
        blend = api.BlendParams(sigma=SIGMA, gamma=1e-4)
        parts: dict[str, Any] = {"blend_params": blend}
        if shader != "SoftSilhouetteShader":
            parts["cameras"] = scene.cameras_of(library)
            parts["lights"] = api.PointLights(location=((2.0, 2.0, -2.0),), device=scene.device)
            parts["device"] = scene.device
        renderer = api.MeshRenderer(
            scene.rasterizer_of(library, image_size=size, blur_radius=blur_radius, faces_per_pixel=layers),
            getattr(api, shader)(**parts),
        )
        offsets = torch.zeros_like(mesh.verts_packed())
        return _timed(lambda: [renderer(mesh.offset_verts(offsets))], offsets, backward)

    return prepare


def _transform_points(library: Library, scene: Scene) -> Run:
    cameras, points = scene.cameras_of(library), torch.rand(100_000, 3, device=scene.device)
    return lambda: cameras.transform_points(points)


def _sample_textures(library: Library, scene: Scene) -> Run:
    mesh = scene.mesh_of(library)
    settings = {"image_size": 256, "blur_radius": REACH, "faces_per_pixel": 50}
    with torch.no_grad():
        fragments = scene.rasterizer_of(library, **settings)(mesh)
    return torch.no_grad()(lambda: mesh.sample_textures(fragments))


def _ico_sphere(library: Library, scene: Scene) -> Run:
    return lambda: library.utils.ico_sphere(4, scene.device)


def _load_obj(library: Library, scene: Scene) -> Run:
    path = scene.folder / "grid.obj"
    write_grid_obj(path, side=388)
    return lambda: library.io.load_obj(path, load_textures=False)


def write_grid_obj(path: Path, side: int) -> None:
    """A wavy square of 2 (side - 1)^2 triangles with texture coordinates, as a text file."""
    ticks = [k / (side - 1) for k in range(side)]
    points = [(u, v) for v in ticks for u in ticks]
    lines = [f"v {u:.6f} {math.sin(9 * u) * math.cos(9 * v):.6f} {v:.6f}" for u, v in points]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in points]
    for row in range(side - 1):
        for a in range(row * side + 1, (row + 1) * side):
            b, c, d = a + 1, a + side, a + side + 1
            lines += [f"f {a}/{a} {b}/{b} {d}/{d}", f"f {a}/{a} {d}/{d} {c}/{c}"]
    path.write_text("\n".join(lines) + "\n", encoding="ascii")


def _pose_step(uses_texture: bool, layers: int) -> Callable[[Library, Scene], Run]:
    """One step of Adam on a camera's position: silhouette, or silhouette and colours, squared and summed."""

    def prepare(library: Library, scene: Scene) -> Run:
        from rendra_lab.networks.camera_pose import LookAtPose, look_at_origin
        from rendra_lab.networks.mesh_view import MeshView

        view, pose = MeshView(scene.mesh, layers=layers), LookAtPose().to(scene.device)
        pose.place(*look_at_origin(torch.tensor([[1.5, 2.6, 1.0]], device=scene.device)))
        with torch.no_grad():
            target = view(*look_at_origin(torch.tensor([[0.0, 2.3, 1.9]], device=scene.device)))
        optimizer = torch.optim.Adam(pose.parameters(), lr=1e-6)  # every run starts from nearly the same pose

        def step() -> None:
            silhouette, rgb = view(*pose())
            loss = (silhouette - target[0]).square().sum()
            if uses_texture:
                loss = loss + 0.1 * (rgb - target[1]).square().sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()

        return step

    return prepare


def _command(*arguments: str) -> Callable[[Library, Scene], Run]:
    """`python train.py ...` with the scene's mesh, from start to end."""

    def prepare(library: Library, scene: Scene) -> Run:
        trainer = "gpu" if scene.device.type == "cuda" else "cpu"
        fixed = [sys.executable, str(ROOT / "train.py"), f"trainer={trainer}", *arguments]
        if scene.path is not None:
            fixed.append(f"mesh.path={scene.path.resolve()}")
        numbers = count()

        def run() -> None:
            command = [*fixed, f"hydra.run.dir={scene.folder / f'run-{next(numbers)}'}"]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                raise RuntimeError(f"{' '.join(command)} ended with code {done.returncode}:\n{done.stderr[-2000:]}")

        return run

    return prepare


_RASTER = (
    "tests/rendra/kernels/test_rasterize_meshes.py",
    "tests/rendra/renderer/mesh/test_rasterizer.py",
)
_SHADING = (*_RASTER, "tests/rendra/renderer/mesh/test_shader.py", "tests/rendra/renderer/test_golden.py")
_SILHOUETTE = ("tests/rendra/kernels/test_soft_silhouette.py", "tests/rendra/renderer/mesh/test_shader.py")
_POSE = (*_SHADING, *_SILHOUETTE[:1], "tests/rendra_lab/test_losses_and_metrics.py")
_COMMAND = (*_POSE, "tests/rendra_lab/test_configurations.py")


def _raster_benchmarks() -> list[Benchmark]:
    soft = "rasterize_meshes 256x256, K=50, blur radius 9.2e-4"
    return [
        Benchmark(
            "raster_hard", "rasterize_meshes 256x256, K=1, forward", _rasterization(1, 0.0, False), _RASTER, 5, 1
        ),
        Benchmark("raster_soft", f"{soft}, forward", _rasterization(50, REACH, False), _RASTER, 60, 25),
        Benchmark(
            "raster_soft_backward", f"{soft}, forward + backward", _rasterization(50, REACH, True), _RASTER, 150, 60
        ),
    ]


def _silhouette_benchmarks() -> list[Benchmark]:
    # PyTorch3D keeps the 100 nearest faces, as its tutorials do; rendra takes all of them
    targets: dict[tuple[int, bool], tuple[float, float]] = {(256, True): (30, 8), (512, True): (110, 25)}
    return [
        Benchmark(
            f"silhouette_{size}" + ("_backward" if backward else ""),
            f"soft silhouette {size}x{size}, all faces, forward" + (" + backward" if backward else ""),
            _rendering("SoftSilhouetteShader", size, 100, REACH, backward),
            _SILHOUETTE,
            *targets.get((size, backward), (None, None)),
        )
        for size in (256, 512)
        for backward in (False, True)
    ]


def _phong_benchmarks() -> list[Benchmark]:
    return [
        Benchmark(
            f"phong_{kind.lower()}" + ("_backward" if backward else ""),
            f"{kind}PhongShader 256x256, K={layers}, forward" + (" + backward" if backward else ""),
            _rendering(f"{kind}PhongShader", 256, layers, blur_radius, backward),
            _SHADING,
        )
        for kind, layers, blur_radius in (("Hard", 1, 0.0), ("Soft", 50, REACH))
        for backward in (False, True)
    ]


def _pose_benchmarks() -> list[Benchmark]:
    steps = (("silhouette", False, 1), ("texture", True, 1), ("texture_soft", True, 50))
    return [
        Benchmark(
            f"pose_step_{name}",
            "one pose step 256x256, " + (f"silhouette + texture, K={layers}" if textured else "silhouette"),
            _pose_step(textured, layers),
            _POSE,
            is_public=False,
        )
        for name, textured, layers in steps
    ]


BENCHMARKS: tuple[Benchmark, ...] = (
    *_raster_benchmarks(),
    *_silhouette_benchmarks(),
    *_phong_benchmarks(),
    Benchmark(
        "camera_transform",
        "FoVPerspectiveCameras.transform_points, 100,000 points",
        _transform_points,
        ("tests/rendra/renderer/test_cameras.py", "tests/rendra/transforms/test_transform3d.py"),
    ),
    Benchmark(
        "texture_sampling",
        "TexturesUV.sample_textures 256x256, K=50, forward",
        _sample_textures,
        ("tests/rendra/renderer/mesh/test_textures.py",),
    ),
    Benchmark("ico_sphere", "ico_sphere(4)", _ico_sphere, ("tests/rendra/utils/test_shapes.py",)),
    Benchmark("load_obj", "load_obj, 299,538 faces", _load_obj, ("tests/rendra/io/test_obj_io.py",), must_ms=1000),
    *_pose_benchmarks(),
    Benchmark(
        "command_pose_silhouette",
        "train.py experiment=pose_book_silhouette, 200 steps",
        _command("experiment=pose_book_silhouette", "callbacks.stop=null"),
        _COMMAND,
        must_ms=30_000,
        aim_ms=12_000,
        is_public=False,
        is_command=True,
    ),
    Benchmark(
        "command_pose_from_nothing",
        "train.py experiment=pose_from_nothing",
        _command("experiment=pose_from_nothing"),
        _COMMAND,
        must_ms=60_000,
        aim_ms=15_000,
        is_public=False,
        is_command=True,
    ),
)
