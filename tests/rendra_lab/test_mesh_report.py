"""Reports and sheets about files whose contents and faults are known by construction."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from rendra.io import IO
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures import Meshes, Pointclouds, join_meshes_as_scene
from rendra.utils import ico_sphere
from rendra_lab.data.meshes import make_cube
from rendra_lab.mesh_asset import Asset, read_asset
from rendra_lab.mesh_report import CloudReport, MeshReport, as_json, as_text, report_on
from rendra_lab.mesh_sheet import NothingToSeeError, cloud_as_mesh, draw_sheet

TEXTURED = """mtllib a.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 9 9 9
vt 0 0
vt 1 0
vt 1 1.5
vt 0 1
vt 7 7
vn 0 0 1
vn 0 0 -1
usemtl brick
f 1/1/1 2/2/1 3/3/1
usemtl plain
f 1/1/2 3/3/2 4/4/2
"""


def report_of(mesh: Meshes | Pointclouds, path: Path):
    if isinstance(mesh, Meshes):
        IO().save_mesh(mesh, path)
    else:
        IO().save_pointcloud(mesh, path)
    asset = read_asset(path)
    return asset, *report_on(asset)


def broken() -> Meshes:
    """A sphere with a hole and two flipped faces, a fin on it, a face twice, and a small sphere inside out."""
    sphere = ico_sphere(2)
    faces = sphere.faces_packed().clone()
    faces[[5, 90]] = faces[[5, 90]].flip(1)
    faces = torch.cat([faces[:-1], faces[:1].roll(1, 1), torch.tensor([[*faces[40, :2].tolist(), 162]])])
    fin = sphere.verts_packed()[faces[40, :2]].mean(0, keepdim=True) * 2
    main = Meshes([torch.cat([sphere.verts_packed(), fin])], [faces])
    inward = Meshes([ico_sphere(0).verts_packed() * 0.2 + 3], [ico_sphere(0).faces_packed().flip(1)])
    return join_meshes_as_scene([main, inward])


def test_a_closed_mesh_is_in_order(tmp_path: Path) -> None:
    _, report, findings = report_of(ico_sphere(2).scale_verts(3.0), tmp_path / "ball.ply")
    assert isinstance(report, MeshReport)
    assert report.verdict == "closed, oriented, manifold"
    assert (report.verts, report.faces, report.topology.edges) == (162, 320, 480)
    assert report.volume == pytest.approx(4 / 3 * math.pi * 27, rel=0.05)
    assert report.area == pytest.approx(4 * math.pi * 9, rel=0.05)
    assert report.topology.genus == 0
    assert report.merged is None
    assert report.topology.self_intersections == 0
    assert not any(len(edges) for edges in findings.edges.values())
    assert not any(chosen.any() for chosen in findings.faces.values())


def test_every_fault_is_counted_and_named(tmp_path: Path) -> None:
    _, report, findings = report_of(broken(), tmp_path / "broken.ply")
    assert report.topology.components == 2
    assert report.topology.component_faces == (321, 20)
    assert report.topology.flipped_faces == 2
    assert report.topology.inward_faces == 20
    assert report.topology.non_manifold_edges == 4  # three of the doubled face, one of the fin
    assert report.topology.hole_edges == (3, 2)  # and the fin's free sides
    assert report.duplicate_faces == 1
    assert report.volume is None
    assert int(findings.faces["flipped faces"].sum()) == 2
    for words in ("open (2 holes)", "4 non-manifold edges", "2 flipped faces", "20 inside-out", "1 duplicate face"):
        assert words in report.verdict


def test_self_intersections_are_found(tmp_path: Path) -> None:
    ball = ico_sphere(1)
    twice = join_meshes_as_scene([ball, ball.offset_verts(torch.full((42, 3), 0.5))])
    _, report, findings = report_of(twice, tmp_path / "two.ply")
    assert report.topology.self_intersections > 0
    assert 0 < int(findings.faces["self-intersections"].sum()) < 160
    assert "self-intersections" in report.verdict


def test_seams_are_merged_before_the_verdict(tmp_path: Path) -> None:
    _, report, findings = report_of(make_cube(), tmp_path / "cube.ply")
    assert report.topology.components == 6
    assert report.topology.holes == 6
    assert report.merged.watertight
    assert report.volume == pytest.approx(8)
    assert report.mean_dihedral_deg == pytest.approx(60)
    assert report.verdict == "closed, oriented, manifold once 16 vertices at shared places are merged"
    assert not len(findings.edges["holes"])


def test_materials_coordinates_and_corner_normals_of_an_obj(tmp_path: Path) -> None:
    from PIL import Image

    Image.new("RGB", (6, 4), (255, 0, 0)).save(tmp_path / "brick.png")
    (tmp_path / "a.mtl").write_text("newmtl brick\nmap_Kd brick.png\nnewmtl plain\nKd 0.1 0.2 0.3\n")
    (tmp_path / "a.obj").write_text(TEXTURED)
    asset = read_asset(tmp_path / "a.obj")
    report, findings = report_on(asset)
    brick, plain = report.materials
    assert (brick["name"], brick["image_size_px"], brick["faces"]) == ("brick", (6, 4), 1)
    assert plain["diffuse_color"] == pytest.approx((0.1, 0.2, 0.3))
    assert report.colors == "image"
    assert report.uvs == 5
    assert report.uv_range == ((0.0, 1.0), (0.0, 1.5))
    assert report.uvs_outside == 1
    assert report.normals == "corners"
    assert report.wrong_normals == 3
    assert report.unreferenced_verts == 1
    assert report.bounds.extent == pytest.approx((1, 1, 0))
    assert report.verdict == "open (1 hole), oriented, manifold; faults: 1 unused vertex, 3 wrong normals"
    assert draw_sheet(asset, findings, 48).shape[0] > 3 * 48  # six views, the map, the hole


def test_vertices_that_are_not_finite_spoil_nothing_else(tmp_path: Path) -> None:
    verts = torch.cat([ico_sphere(1).verts_packed(), torch.tensor([[math.nan, 7, math.inf]])])
    faces = torch.cat([ico_sphere(1).faces_packed(), torch.tensor([[0, 1, 42]])])
    asset = Asset(tmp_path / "nan.ply", Meshes([verts], [faces]))  # readers of files refuse it
    report, findings = report_on(asset)
    assert report.not_finite_verts == 1
    assert report.faces == 81
    assert report.topology.watertight
    assert report.verdict == "closed, oriented, manifold; faults: 1 vertex that is not finite"
    assert np.isfinite(draw_sheet(asset, findings, 32)).all()


def test_json_holds_every_number_and_no_nan(tmp_path: Path) -> None:
    lonely = Meshes([torch.zeros(3, 3)], [torch.tensor([[0, 1, 2]])])
    asset, report, findings = report_of(lonely, tmp_path / "point.ply")
    numbers = json.loads(as_json(report))
    assert numbers["mean_dihedral_deg"] is None
    assert numbers["topology"]["components"] == 1
    assert "1 degenerate face" in numbers["verdict"]
    for words in ("a single point", "3 vertices, 1 face, ", "no two faces share an edge", "not a closed manifold"):
        assert words in as_text(report)
    with pytest.raises(NothingToSeeError, match="no extent"):
        draw_sheet(asset, findings)


def test_a_cloud_is_measured_by_its_neighbours(tmp_path: Path) -> None:
    grid = torch.stack(torch.meshgrid(*[torch.arange(4.0)] * 3, indexing="ij"), -1).view(-1, 3)
    points = torch.cat([grid, grid[:2], torch.tensor([[7.0, 0, 0]])])
    asset, report, findings = report_of(Pointclouds([points], features=[torch.rand(67, 3)]), tmp_path / "c.ply")
    assert isinstance(report, CloudReport)
    assert findings is None
    assert report.points == 67
    assert (report.spacing_min, report.spacing_median, report.spacing_max) == (1, 1, 4)
    assert report.duplicate_points == 2
    assert report.features == 3
    assert report.verdict == "67 points; faults: 2 duplicate points"
    assert "67 points" in as_text(report)
    assert draw_sheet(asset, None, 32).std() > 0


def test_an_xyz_file_is_a_cloud(tmp_path: Path) -> None:
    (tmp_path / "p.xyz").write_text("0 0 0\n0 0 2\n")
    report, _ = report_on(read_asset(tmp_path / "p.xyz"))
    assert report.points == 2
    assert report.spacing_max == 2
    assert report.verdict == "2 points, in order"


def test_points_are_drawn_in_their_colours_or_by_height() -> None:
    points, colors = torch.rand(50, 3), torch.rand(50, 3)
    mesh = cloud_as_mesh(Pointclouds([points], features=[colors]), most=10)
    assert len(mesh.faces_packed()) == 80
    torch.testing.assert_close(mesh.verts_packed().view(10, 6, 3).mean(1), points[::5])
    torch.testing.assert_close(mesh.textures.verts_features_packed()[::6], colors[::5])
    assert isinstance(cloud_as_mesh(Pointclouds([points])).textures, TexturesVertex)
    assert cloud_as_mesh(Pointclouds([torch.zeros(0, 3)])).isempty()


def test_faults_are_red_in_the_sheet(tmp_path: Path) -> None:
    def red(picture: np.ndarray) -> int:
        return int(((picture[..., 0] > 200) & (picture[..., 1:] < 60).all(-1)).sum())

    asset, _, findings = report_of(broken(), tmp_path / "b.ply")
    sheet = draw_sheet(asset, findings, 64)
    views = 2 * (sheet.shape[0] // 4)
    assert red(sheet[:views]) == 0
    assert red(sheet[views:]) > 100
    whole, _, nothing = report_of(ico_sphere(1), tmp_path / "w.ply")
    assert red(draw_sheet(whole, nothing, 64)) == 0


def test_files_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="there is no file"):
        read_asset(tmp_path / "no.obj")
    with pytest.raises(FileNotFoundError, match="it is a folder"):
        read_asset(tmp_path)
