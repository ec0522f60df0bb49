"""Rasterising, shading, sampling textures, and the camera of a picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from rendra_lab.benchmarking import Benchmark, Run
from rendra_lab.benchmarks.scene import Library, Scene, command, timed

SIGMA = 1e-4  # squared NDC, the usual width of an edge
REACH = math.log(1 / 1e-4 - 1) * SIGMA  # blur radius at which the sigmoid of an edge has fallen to 1e-4


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

        return timed(forward, offsets, backward)

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
        return timed(lambda: [renderer(mesh.offset_verts(offsets))], offsets, backward)

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


RENDERING: tuple[Benchmark, ...] = (
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
    *_pose_benchmarks(),
    Benchmark(
        "command_pose_silhouette",
        "train.py experiment=pose_book_silhouette, 200 steps",
        command("experiment=pose_book_silhouette", "callbacks.stop=null"),
        _COMMAND,
        must_ms=30_000,
        aim_ms=12_000,
        is_public=False,
        is_command=True,
    ),
    Benchmark(
        "command_pose_from_nothing",
        "train.py experiment=pose_from_nothing",
        command("experiment=pose_from_nothing"),
        _COMMAND,
        must_ms=60_000,
        aim_ms=15_000,
        is_public=False,
        is_command=True,
    ),
)
