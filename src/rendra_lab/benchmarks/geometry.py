"""Clouds, distances, voxels, files, and a sphere fitted to a cloud."""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import torch
from torch import Tensor

from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene, command, timed


def _chamfer(num_points: int) -> Callable[[Library, Scene], Run]:
    """Two random clouds in a cube, gradients for the first."""

    def prepare(library: Library, scene: Scene) -> Run:
        first, second = torch.rand(2, 1, num_points, 3, device=scene.device).unbind(0)
        first = first.clone()
        return timed(lambda: [library.loss.chamfer_distance(first, second)[0]], first, backward=True)

    return prepare


def _point_mesh(library: Library, scene: Scene) -> Run:
    """A sphere of 20 x 4^4 = 5,120 faces, doubled, and points round it: gradients for the vertices."""
    mesh = library.utils.ico_sphere(4, scene.device)
    verts, faces = mesh.verts_packed(), mesh.faces_packed()
    both = library.structures.Meshes(
        [torch.cat([verts, 0.7 * verts])], [torch.cat([faces, faces + len(verts)])[:10_000]]
    )
    cloud = library.structures.Pointclouds([1.5 * torch.randn(10_000, 3, device=scene.device)])
    offsets = torch.zeros_like(both.verts_packed())
    return timed(
        lambda: [library.loss.point_mesh_face_distance(both.offset_verts(offsets), cloud)], offsets, backward=True
    )


def _knn(library: Library, scene: Scene) -> Run:
    points = torch.rand(1, 100_000, 3, device=scene.device)
    return lambda: library.ops.knn_points(points, points, K=8)


def _farthest(library: Library, scene: Scene) -> Run:
    points = torch.rand(1, 100_000, 3, device=scene.device)
    return lambda: library.ops.sample_farthest_points(points, K=1000)


def _voxels(device: torch.device) -> Tensor:
    """Sixteen balls of different sizes in grids of 48^3, with noise at their surfaces."""
    ticks = torch.linspace(-1, 1, 48, device=device)
    z, y, x = torch.meshgrid(ticks, ticks, ticks, indexing="ij")
    radius = torch.linspace(0.4, 0.95, 16, device=device)[:, None, None, None]
    noise = torch.rand(16, 48, 48, 48, generator=torch.Generator().manual_seed(0)).to(device)
    return radius - (x * x + y * y + z * z).sqrt() + 0.1 * noise


def _cubify(library: Library, scene: Scene) -> Run:
    voxels = _voxels(scene.device)
    return lambda: library.ops.cubify(voxels, 0.0)


def _cubify_kernel(module: str) -> Callable[[Library, Scene], Run]:
    """The kernel, or its specification, alone."""

    def prepare(library: Library, scene: Scene) -> Run:
        voxels, planes = _voxels(scene.device), torch.arange(49.0, device=scene.device)
        cubify = import_module(module).cubify
        return lambda: cubify(voxels, 0.0, planes, planes, planes)

    return prepare


def _sphere_pairs(module: str, bodies: int, size: int, radius: float) -> Callable[[Library, Scene], Run]:
    """Eight large balls, the trunk, and small ones all about it, of many bodies; on a fit's body, or all its skin."""

    def prepare(library: Library, scene: Scene) -> Run:
        generator = torch.Generator().manual_seed(0)
        size_m = torch.tensor([1.2, 1.7, 0.3])
        centers = (size_m * torch.rand(bodies, size, 3, generator=generator)).to(scene.device)
        radii = torch.full((bodies, size), radius, device=scene.device)
        radii[:, :8] = 0.11
        groups = (torch.arange(size, device=scene.device) >= 8).long()
        pairs = torch.tensor([[0, 1]], device=scene.device)
        find = import_module(module).sphere_pairs
        return lambda: find(centers, radii, groups, pairs)

    return prepare


def _mesh_loss(name: str) -> Callable[[Library, Scene], Run]:
    def prepare(library: Library, scene: Scene) -> Run:
        mesh = library.utils.ico_sphere(4, scene.device)
        offsets = torch.zeros_like(mesh.verts_packed())
        return timed(lambda: [getattr(library.loss, name)(mesh.offset_verts(offsets))], offsets, backward=True)

    return prepare


def _mesh_fit_step(library: Library, scene: Scene) -> Run:
    """The book's: ico_sphere(4), as many samples as the pedestrian has points, four losses, SGD."""
    mesh = library.utils.ico_sphere(4, scene.device)
    target = 0.3 * torch.randn(1, 239, 3, device=scene.device)
    offsets = torch.zeros_like(mesh.verts_packed(), requires_grad=True)
    optimizer = torch.optim.SGD([offsets], lr=1e-6, momentum=0.9)  # every run starts from nearly the same surface

    def step() -> None:
        moved = mesh.offset_verts(offsets)
        samples = library.ops.sample_points_from_meshes(moved, target.shape[1])
        loss = library.loss.chamfer_distance(target, samples)[0] + library.loss.mesh_edge_loss(moved)
        loss = loss + 0.01 * library.loss.mesh_normal_consistency(moved)
        loss = loss + 0.1 * library.loss.mesh_laplacian_smoothing(moved, method="uniform")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    return step


def _load_obj(library: Library, scene: Scene) -> Run:
    path = scene.folder / "grid.obj"
    write_grid_obj(path, side=388)
    return lambda: library.io.load_obj(path, load_textures=False)


def _save_obj(library: Library, scene: Scene) -> Run:
    path = scene.folder / "grid.obj"
    write_grid_obj(path, side=388)
    verts, faces, _ = library.io.load_obj(path, load_textures=False)
    return lambda: library.io.save_obj(scene.folder / "written.obj", verts, faces.verts_idx)


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


_CHAMFER = ("tests/rendra/kernels/test_knn.py", "tests/rendra/loss/test_chamfer.py")
_CUBIFY = ("tests/rendra/kernels/test_cubify.py", "tests/rendra/ops/test_cubify.py")
_SPHERES = ("tests/rendra/kernels/test_sphere_pairs.py",)
_MESH_LOSSES = ("tests/rendra/loss/test_mesh_losses.py",)
_FIT = (*_CHAMFER, *_MESH_LOSSES, "tests/rendra/ops/test_sample_points_from_meshes.py")
_OBJ = ("tests/rendra/io/test_obj_io.py",)
_BACK = "forward + backward"

GEOMETRY: tuple[Benchmark, ...] = (
    Benchmark("chamfer_5k", f"chamfer_distance, 5,000 points, {_BACK}", _chamfer(5000), _CHAMFER, 10, 1),
    Benchmark("chamfer_100k", f"chamfer_distance, 100,000 points, {_BACK}", _chamfer(100_000), _CHAMFER, 300, 20),
    Benchmark("knn_100k", "knn_points, 100,000 points, K=8", _knn, _CHAMFER[:1]),
    Benchmark(
        "farthest_points",
        "sample_farthest_points, 1,000 of 100,000 points",
        _farthest,
        ("tests/rendra/kernels/test_sample_farthest_points.py",),
    ),
    Benchmark(
        "point_mesh_10k",
        f"point_mesh_face_distance, 10,000 points, 10,000 faces, {_BACK}",
        _point_mesh,
        ("tests/rendra/kernels/test_point_face_distance.py", "tests/rendra/loss/test_point_mesh_distance.py"),
        100,
        10,
    ),
    Benchmark("cubify", "cubify, 16 grids of 48^3", _cubify, _CUBIFY),
    *(
        Benchmark(f"cubify_{name}", f"{what}, 16 grids of 48^3", _cubify_kernel(module), _CUBIFY, is_public=False)
        for name, what, module in (
            ("kernel", "the kernel of cubify alone", "rendra.kernels.cubify"),
            ("reference", "its reference", "rendra.kernels.cubify.reference"),
        )
    ),
    *(
        Benchmark(
            f"sphere_pairs_{name}",
            what,
            _sphere_pairs(f"rendra.kernels.sphere_pairs{module}", bodies, size, radius),
            _SPHERES,
            is_public=False,
        )
        for name, what, module, bodies, size, radius in (
            ("fits", "overlapping balls, 50 of each of 256 bodies", "", 256, 50, 0.04),
            ("reference", "their reference, the same", ".reference", 256, 50, 0.04),
            ("skin", "overlapping balls, 13,718 vertices and a trunk of 8", "", 1, 13_718, 0.0),
        )
    ),
    *(
        Benchmark(name, f"{name}, 5,120 faces, {_BACK}", _mesh_loss(name), _MESH_LOSSES)
        for name in ("mesh_edge_loss", "mesh_laplacian_smoothing", "mesh_normal_consistency")
    ),
    Benchmark("mesh_fit_step", "one mesh_fit step at the book's sizes, four losses", _mesh_fit_step, _FIT, 12, 5),
    Benchmark("load_obj", "load_obj, 299,538 faces", _load_obj, _OBJ, 1000, 300),
    Benchmark("save_obj", "save_obj, 299,538 faces", _save_obj, _OBJ, 2000, 600),
    Benchmark(
        "command_mesh_fit",
        "train.py task=mesh_fit, the whole command",
        command("task=mesh_fit", key="data.path"),
        (*_FIT, "tests/rendra_lab/test_configurations.py"),
        must_ms=30_000,
        aim_ms=10_000,
        is_public=False,
        is_command=True,
    ),
)
