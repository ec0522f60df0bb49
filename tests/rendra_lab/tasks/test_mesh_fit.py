"""Deforming a sphere to a cloud: the parts by their laws, and the fit by what it reaches."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from assertions import assert_close
from torch import Tensor

from rendra.io import IO
from rendra.ops import self_intersections
from rendra.structures import Meshes, Pointclouds
from rendra.transforms import random_rotation
from rendra.utils import ico_sphere
from rendra_lab.errors import UserError
from rendra_lab.experiment import run
from rendra_lab.mesh_quality import signed_volume
from rendra_lab.tasks.mesh_fit.data import CloudBatch, ScannedCloud
from rendra_lab.tasks.mesh_fit.surface import Diffusion, SpherePyramid
from rendra_lab.tasks.mesh_fit.views import CloudViews, balls, upright


def laplacian(mesh: Meshes) -> Tensor:
    """D - A, dense."""
    size = len(mesh.verts_packed())
    adjacency = torch.zeros(size, size)
    low, high = mesh.edges_packed().unbind(1)
    adjacency[low, high] = adjacency[high, low] = 1
    return adjacency.sum(1).diag() - adjacency


class TestDiffusion:
    def test_solves_its_equation(self) -> None:
        mesh, u = ico_sphere(1), torch.randn(42, 3)
        x = Diffusion(mesh.edges_packed(), 42, smoothness=7.0).solve(u)
        assert_close(x + 7.0 * laplacian(mesh) @ x, u, atol=1e-4)

    def test_keeps_what_is_constant_and_the_mean(self) -> None:
        mesh, u = ico_sphere(2), torch.randn(162, 3)
        diffusion = Diffusion(mesh.edges_packed(), 162, smoothness=30.0)
        assert_close(diffusion.solve(torch.ones(162, 3)), torch.ones(162, 3), atol=1e-5)
        assert_close(diffusion.solve(u).mean(0), u.mean(0), atol=1e-5)


class TestSpherePyramid:
    def test_the_gradient_is_diffused_like_the_values(self) -> None:
        surface, upstream = SpherePyramid([1], smoothness=5.0, start="sphere"), torch.randn(42, 3)
        (surface().verts_packed() * upstream).sum().backward()
        expected = torch.linalg.solve(torch.eye(42) + 5.0 * laplacian(ico_sphere(1)), upstream)
        assert_close(surface.offsets[0].grad, expected, atol=1e-4)

    def test_without_smoothness_every_vertex_moves_by_itself(self) -> None:
        surface = SpherePyramid([1], smoothness=0.0, start="sphere")
        surface.offsets[0].data[3] = torch.tensor([1.0, 2.0, 3.0])
        moved = surface().verts_packed() - ico_sphere(1).verts_packed()
        assert moved.abs().amax(1).nonzero()[:, 0].tolist() == [3]

    def test_a_finer_level_begins_as_the_same_surface(self) -> None:
        surface = SpherePyramid([1, 2, 3], smoothness=2.0, start="sphere")
        surface.offsets[0].data.normal_()
        before = surface()
        surface.refine_to(1)
        after = surface()
        assert len(after.verts_packed()) == 162
        assert_close(after.verts_packed()[:42], before.verts_packed())
        assert_close(after.faces_areas_packed().sum(), before.faces_areas_packed().sum(), rtol=1e-4)
        surface.refine_to(1)
        assert int(surface.level) == 1

    def test_a_checkpoint_holds_all_of_it(self) -> None:
        surface = SpherePyramid([1, 2], start="sphere")
        surface.offsets[0].data.normal_()
        surface.refine_to(1)
        surface.offsets[1].data.normal_()
        other = SpherePyramid([1, 2], start="sphere")
        other.load_state_dict(surface.state_dict())
        assert_close(other().verts_packed(), surface().verts_packed())

    def test_begins_as_an_ellipsoid_round_the_cloud(self) -> None:
        axes, half = random_rotation(), torch.tensor([3.0, 1.0, 0.4])
        cloud = (torch.nn.functional.normalize(torch.randn(4000, 3), dim=1) * half) @ axes + 5
        surface = SpherePyramid([3])
        surface.place(cloud)
        mesh = surface()
        in_axes = ((mesh.verts_packed() - 5) @ axes.T).abs().amax(0)
        assert (in_axes / half - 1).abs().amax() < 0.5
        assert signed_volume(mesh) > 0

    def test_refuses_levels_and_smoothness_that_do_not_fit(self) -> None:
        with pytest.raises(ValueError, match="consecutive"):
            SpherePyramid([3, 5])
        with pytest.raises(ValueError, match="one a level"):
            SpherePyramid([3, 4], smoothness=[1.0])
        with pytest.raises(ValueError, match="one a level"):
            SpherePyramid([3], smoothness=float("inf"))
        with pytest.raises(ValueError, match="at most 7, got"):
            SpherePyramid([8, 9])
        with pytest.raises(ValueError, match="ellipsoid"):
            SpherePyramid([3], start="cube")


class TestScannedCloud:
    def test_what_is_restored_lies_where_the_cloud_was(self) -> None:
        scan = 3 * torch.randn(50, 3) + torch.tensor([100.0, -20.0, 7.0])
        batch = CloudBatch.of(scan, 1000, torch.Generator())
        assert_close(batch.scan[0].mean(0), torch.zeros(3), atol=1e-5)
        assert_close(batch.scan.abs().amax(), torch.tensor(1.0))
        back = batch.restored(Meshes([batch.scan[0]], [torch.tensor([[0, 1, 2]])]))
        assert_close(back.verts_packed(), scan, atol=1e-4)

    def test_a_large_cloud_is_thinned_for_the_fit_alone(self) -> None:
        batch = CloudBatch.of(torch.randn(500, 3), 100, torch.Generator().manual_seed(0))
        assert batch.points.shape == (1, 100, 3)
        assert batch.scan.shape == (1, 500, 3)

    def test_spacing_is_that_of_a_lattice(self) -> None:
        ticks = torch.arange(5.0)
        lattice = torch.cartesian_prod(ticks, ticks, ticks)
        batch = CloudBatch.of(lattice, 1000, torch.Generator())
        assert_close(batch.spacing * batch.scale, torch.ones(1), atol=1e-5)

    @pytest.mark.parametrize("ending", ["ply", "xyz", "obj"])
    def test_reads_clouds_and_meshes(self, ending: str, tmp_path: Path) -> None:
        path, sphere = tmp_path / f"a.{ending}", ico_sphere(2)
        if ending == "obj":
            IO().save_mesh(sphere, path)
        else:
            IO().save_pointcloud(Pointclouds([sphere.verts_packed()]), path)
        data = ScannedCloud(path, scan_points=77, noise=0.0)
        data.setup("fit")
        assert data.cloud.scan.shape == (1, 77 if ending == "obj" else 162, 3)

    def test_says_what_is_wrong_with_a_file(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match="there is no file"):
            ScannedCloud(tmp_path / "none.ply").setup("fit")
        IO().save_pointcloud(Pointclouds([torch.ones(9, 3)]), tmp_path / "one.ply")
        with pytest.raises(UserError, match="in one place"):
            ScannedCloud(tmp_path / "one.ply").setup("fit")
        IO().save_pointcloud(Pointclouds([1e30 * torch.randn(9, 3)]), tmp_path / "far.ply")
        with pytest.raises(UserError, match=r"far.ply: a coordinate of .*e\+30, expected at most 1e\+15"):
            ScannedCloud(tmp_path / "far.ply").setup("fit")

    @pytest.mark.parametrize("given", [{"noise": float("nan")}, {"scan_points": 2_000_000_000}, {"most": 0}])
    def test_refuses_what_cannot_be_scanned(self, given: dict[str, Any]) -> None:
        with pytest.raises(UserError, match=f"data.{next(iter(given))} must lie between"):
            ScannedCloud(**given)


class TestViews:
    @pytest.mark.parametrize("size", [(10,), (0, 0), (9, 10_000)])
    def test_refuses_sizes_that_are_no_picture(self, size: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match=r"views\.size must be height and width from 1 to 8192"):
            CloudViews(size=size)

    def test_something_long_stands_on_its_wider_end(self) -> None:
        height = torch.rand(500, 1)
        cone = torch.cat([height, 0.08 * (1 - height) * torch.randn(500, 2)], 1)  # its tip at +x
        standing = cone @ upright(cone)
        assert_close(standing[:, 1].aminmax().max, cone[:, 0].amax(), atol=1e-4)
        assert float(standing[:, 0].std()) >= float(standing[:, 2].std())

    @pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 2.0, 3.0), (0.0, 1.0, 0.0)])
    def test_a_given_direction_points_upwards(self, up: tuple[float, float, float]) -> None:
        turn = upright(torch.randn(20, 3), up)
        direction = torch.tensor(up)
        assert_close(direction / direction.norm() @ turn, torch.tensor([0.0, 1.0, 0.0]), atol=1e-5)
        assert_close(turn @ turn.T, torch.eye(3), atol=1e-5)
        assert torch.linalg.det(turn) > 0

    def test_balls_are_round_their_points_and_closed(self) -> None:
        points = torch.randn(7, 3)
        mesh = balls(points)
        assert_close(mesh.verts_packed().view(7, 6, 3).mean(1), points, atol=1e-5)
        assert signed_volume(mesh) > 0


def fitted(compose: Callable[..., Any], folder: Path, *overrides: str) -> dict[str, float]:
    run(compose(folder, "callbacks.animation=null", "callbacks.images=null", *overrides))
    return json.loads((folder / "metrics.json").read_text())["metrics"]


def test_a_torus_scan_is_met_and_restored(compose: Callable[..., Any], tmp_path: Path) -> None:
    scan = tmp_path / "scan.ply"
    points = 20 * torch.nn.functional.normalize(torch.randn(600, 3), dim=1) * torch.tensor([1.0, 0.5, 0.3]) + 50
    IO().save_pointcloud(Pointclouds([points]), scan)
    folder = tmp_path / "mesh_fit" / "run"
    short = ("surface.levels=[2,3]", "module.refine_at=[40]", "trainer.max_steps=80", f"data.path={scan}")
    metrics = fitted(compose, folder, "task=mesh_fit", *short)
    assert metrics["test/rms"] < 0.02
    assert metrics["test/self_intersections"] == 0
    for ending in ("obj", "ply", "glb"):
        mesh = IO().load_mesh(folder / "exports" / f"surface.{ending}")
        assert_close(mesh.verts_packed().mean(0), points.mean(0), atol=2.0)
        assert len(mesh.faces_packed()) == 1280


@pytest.mark.parametrize("steps", [9, 10, 11])
def test_what_is_written_has_been_checked(steps: int, compose: Callable[..., Any], tmp_path: Path) -> None:
    # wild steps, checked every 1,000: only the check after the last one can hold them back
    wild = (
        "optimizer.lr=3",
        "module.check_every=1000",
        "surface.levels=[3]",
        "module.refine_at=[]",
        "loss=[chamfer]",
    )
    folder = tmp_path / "mesh_fit" / "run"
    fitted(compose, folder, "task=mesh_fit", "data.name=torus", f"trainer.max_steps={steps}", *wild)
    assert len(self_intersections(IO().load_mesh(folder / "exports" / "surface.ply"))) == 0


@pytest.mark.slow
def test_the_pedestrian_becomes_a_clean_surface(
    compose: Callable[..., Any], tmp_path: Path, shared_data: Path
) -> None:
    folder = tmp_path / "mesh_fit" / "run"
    metrics = fitted(compose, folder, "task=mesh_fit", f"data.path={shared_data / 'pedestrian.ply'}")
    assert metrics["test/rms"] < 0.012
    assert metrics["test/roughness_deg"] < 15
    assert metrics["test/self_intersections"] == 0


@pytest.mark.slow
def test_the_experiments_of_the_book_differ_as_its_figures_do(
    compose: Callable[..., Any], tmp_path: Path, shared_data: Path
) -> None:
    names = ("all", "edge_only", "chamfer_only")
    path = f"data.path={shared_data / 'pedestrian.ply'}"
    results = [fitted(compose, tmp_path / name / "run", f"experiment=mesh_fit_{name}", path) for name in names]
    rms = [metrics["test/rms"] for metrics in results]
    roughness = [metrics["test/roughness_deg"] for metrics in results]
    # the book's own files measure 0.0188, 0.0160, 0.0048 and 13, 47, 107 degrees
    assert rms[0] > rms[1] > 2 * rms[2]
    assert roughness[0] < 20 < 35 < roughness[1] < 70 < 90 < roughness[2]
