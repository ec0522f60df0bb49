"""The displacement of a depth camera, composed and run as a user runs it, small."""

import json
from functools import partial

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.io import IO
from rendra_lab import losses, metrics, visualization
from rendra_lab.errors import UserError
from rendra_lab.experiment import run
from rendra_lab.tasks.localize.data import Looks, SeenSolids
from rendra_lab.tasks.localize.solids import SOLIDS, subdivided
from rendra_lab.tasks.localize.task import Localize
from rendra_lab.tasks.localize.views import picture
from rendra_lab.terms import LossTerm, MetricTerm

SMALL = (
    "task=localize",
    "data.samples=400",
    "callbacks.animation=null",
    "callbacks.images.every_n_steps=0",
    "callbacks.meshes=null",
)


def metrics_of(folder):
    return json.loads((folder / "metrics.json").read_text())["metrics"]


def seen(**settings):
    data = SeenSolids(**settings)
    data.setup("fit")
    return data


@pytest.mark.parametrize(("name", "counts"), [("cube", (8, 12)), ("octahedron", (6, 8)), ("dodecahedron", (20, 36))])
def test_solids_are_closed_convex_and_the_right_way_out(name, counts):
    mesh = SOLIDS[name]()
    verts, faces = mesh.verts_packed(), mesh.faces_packed()
    assert (len(verts), len(faces)) == counts
    assert len(verts) - len(mesh.edges_packed()) + len(faces) == 2  # Euler
    assert_close(verts.norm(dim=1), torch.full((len(verts),), 3**0.5))
    assert_close(verts.mean(0), torch.zeros(3), atol=1e-6)
    normals, corners = mesh.faces_normals_packed(), verts[faces[:, 0]]
    heights = (normals * corners).sum(1)
    assert (heights > 0).all()
    assert_close(heights, heights[:1].expand_as(heights))  # regular: every side is as far from the middle
    assert (verts @ normals.T <= heights + 1e-5).all()


def test_subdivision_keeps_the_surface():
    mesh = SOLIDS["dodecahedron"]()
    finer = subdivided(mesh, 200)
    assert len(finer.faces_packed()) == 16 * len(mesh.faces_packed())
    assert_close(finer.faces_areas_packed().sum(), mesh.faces_areas_packed().sum())


def test_a_look_is_displaced_and_disturbed_as_told():
    data = seen(displacement=(1.0, -2.0, 3.0), noise_variance=0.25, measurements=2000)
    assert data.seen.num_verts_per_mesh().unique().numel() == 3  # meshes of different sizes in one batch
    offset = data.seen.verts_packed() - data.known.verts_packed()
    assert_close(offset.mean(0), torch.tensor([1.0, -2.0, 3.0]), atol=0.03, rtol=0)
    assert_close(offset.var(0), torch.full((3,), 0.25), atol=0.03, rtol=0)


def test_looks_differ_and_come_again():
    data, same, other = seen(samples=50), seen(samples=50), seen(samples=50, seed=1)
    assert torch.equal(data.look(3).points, same.look(3).points)
    assert not torch.equal(data.look(3).points, data.look(4).points)
    assert not torch.equal(data.seen.verts_packed(), other.seen.verts_packed())
    resumed = Looks(data.look, count=5)
    resumed.load_state_dict({"given": 3})
    assert [torch.equal(look.points, data.look(3 + i).points) for i, look in enumerate(resumed)] == [True] * 5


def test_without_noise_the_displacement_is_recovered(compose, tmp_path):
    folder = tmp_path / "localize" / "run"
    error = run(
        compose(folder, *SMALL, "data.noise_variance=0.0", "data.displacement=[-20.0,0.5,7.0]", "data.samples=1000")
    )
    assert error < 0.05
    metrics = metrics_of(folder)
    assert metrics["test/true_x"] == -20
    assert metrics["test/x"] == pytest.approx(-20, abs=0.05)
    fact = json.loads((folder / "exports" / "displacement.json").read_text())
    assert fact["truth"] == [-20, 0.5, 7]
    assert fact["error"] == pytest.approx(error, abs=1e-6)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_noise_of_the_book_is_borne(compose, tmp_path, seed):
    assert run(compose(tmp_path / "localize" / "run", *SMALL, f"seed={seed}", "data.samples=1500")) < 0.1


def test_meshes_of_files(compose, tmp_path):
    paths = [tmp_path / "a.obj", tmp_path / "b.ply", tmp_path / "c.stl"]
    for path, solid in zip(paths, SOLIDS.values(), strict=True):
        IO().save_mesh(solid(), path)
    folder = tmp_path / "localize" / "run"
    files = f"data.paths=[{','.join(str(path) for path in paths)}]"
    exports = "callbacks.meshes.formats=[ply]"
    small = [each for each in SMALL if each != "callbacks.meshes=null"]
    error = run(compose(folder, *small, files, exports, "data.measurements=50", "data.noise_variance=1e-4"))
    assert error < 0.1
    moved = IO().load_mesh(folder / "exports" / "b.ply").verts_packed()
    assert_close(moved.mean(0), torch.tensor([3.0, 4.0, 5.0]), atol=0.1, rtol=0)
    assert (folder / "images" / "final.png").is_file()


def test_files_of_one_name_stay_apart(tmp_path):
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        IO().save_mesh(SOLIDS["cube"](), tmp_path / folder / "scan.ply")
    data = seen(paths=[tmp_path / "first" / "scan.ply", tmp_path / "second" / "scan.ply"], samples=10, measurements=0)
    assert data.look(0).titles == ["scan_0", "scan_1"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"displacement": (1.0, 2.0)},
            r"data.displacement must be three numbers such as \[3,4,5\], got \[1.0, 2.0\]",
        ),
        ({"displacement": (1.0, 2.0, float("nan"))}, "data.displacement must be three numbers"),
        ({"noise_variance": -1.0}, r"data.noise_variance must lie between 0 and 1e\+12, got -1.0"),
        ({"measurements": -1}, r"data.measurements must lie between 0 and 1e\+06, got -1"),
        ({"samples": 0}, "data.samples must lie between 1"),
        ({"paths": "cow.obj"}, "data.paths must be a list of files"),
        ({"paths": []}, "data.paths must be a list of files"),
    ],
)
def test_impossible_settings_are_refused(settings, message):
    with pytest.raises(UserError, match=message):
        SeenSolids(**settings)


def test_a_missing_file_is_named():
    with pytest.raises(UserError, match=r"data\.paths: there is no mesh file nowhere\.obj"):
        seen(paths=["nowhere.obj"])


def test_the_camera_of_a_picture_stands_still():
    data = seen(samples=300)
    first, second = (data.look(number) for number in range(2))
    images = [picture(look.points[0], look.seen[0], look.known[0], torch.zeros(3)) for look in (first, second)]
    solids = [(image[..., 0] > image[..., 2] + 0.1).nonzero().float().mean(0) for image in images]
    assert_close(solids[0], solids[1], atol=0.1, rtol=0)  # pixels


def test_a_picture_shows_what_is_seen_and_the_estimate_apart_then_together():
    look = seen(samples=300, noise_variance=0.0).look(0)
    apart = picture(look.points[0], look.seen[0], look.known[0], torch.zeros(3))
    together = picture(look.points[0], look.seen[0], look.known[0], look.displacement[0])
    for image in (apart, together):
        blue = image[..., 2] > image[..., 0] + 0.1
        orange = image[..., 0] > image[..., 2] + 0.1
        assert blue.any()
        assert orange.any()
    columns = [(image[..., 0] > image[..., 2] + 0.1).any(0).nonzero().float().mean() for image in (apart, together)]
    assert (columns[0] - columns[1]).abs() > 50  # pixels


def test_a_fit_stays_where_its_batch_lies(far):  # noqa: F811
    batch = seen(samples=20, measurements=0).look(0).to(far)
    task = Localize(
        losses={"chamfer": LossTerm(losses.chamfer, 1.0, "samples", "points")},
        metrics={"error": MetricTerm(metrics.displacement_error, "displacement", "displacement")},
        optimizer=partial(torch.optim.SGD, lr=0.25),
    )
    task.displacement = torch.nn.Parameter(task.displacement.detach().to(far))
    prediction = task.predict(batch)
    task.objective(prediction, batch)[0].backward()
    assert isinstance(task.displacement.grad, Far)
    assert isinstance(task.score(prediction, batch)["error"], Far)
    with torch.no_grad():
        assert [visualization.to_picture(image).shape for image in task.panels(prediction, batch).values()] == [
            (300, 300, 3)
        ] * 3
        assert list(task.meshes(prediction, batch)) == list(SOLIDS)
        assert task.facts(prediction, batch)["displacement"]["truth"] == [3.0, 4.0, 5.0]
