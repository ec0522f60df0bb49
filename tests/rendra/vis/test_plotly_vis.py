"""Interactive figures: what lands in which subplot, where, in which colours, and seen from where."""

import builtins
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from far_device import far  # noqa: F401

from rendra.renderer import (
    FoVPerspectiveCameras,
    TexturesAtlas,
    TexturesUV,
    TexturesVertex,
    look_at_view_transform,
)
from rendra.structures import Meshes, Pointclouds, join_meshes_as_batch
from rendra.utils import ico_sphere
from rendra.vis.plotly_vis import AxisArgs, Lighting, get_camera_wireframe, plot_batch_individually, plot_scene

pytest.importorskip("plotly", reason="an extra")


def triangle(textures: Any = None, shift: float = 0.0) -> Meshes:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]) + shift
    return Meshes([verts], [torch.tensor([[0, 1, 2]])], textures)


def points(struct: Any) -> np.ndarray:
    return np.stack([np.asarray(struct[axis], dtype=float) for axis in "xyz"], 1)


def test_a_mesh_keeps_its_places_and_faces() -> None:
    sphere = ico_sphere(1)
    figure = plot_scene({"a": {"sphere": sphere}})
    (trace,) = figure.data
    assert trace.type == "mesh3d"
    assert trace.name == "sphere"
    np.testing.assert_allclose(points(trace), sphere.verts_packed().numpy())
    np.testing.assert_array_equal(np.stack([trace.i, trace.j, trace.k], 1), sphere.faces_packed().numpy())
    assert figure.layout.annotations[0].text == "a"
    figure.to_json()


def test_a_batch_in_one_trace_holds_all_its_meshes() -> None:
    batch = join_meshes_as_batch([triangle(), ico_sphere(0)])
    (trace,) = plot_scene({"a": {"both": batch}}).data
    assert len(trace.x) == 15
    assert max(trace.k) == 14


def test_colours_of_every_texture() -> None:
    vertex = TexturesVertex([torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 2]])])
    assert plot_scene({"a": {"m": triangle(vertex)}}).data[0].vertexcolor[2] == "rgb(0,0,255)"
    atlas = TexturesAtlas([torch.tensor([0.2, 0.4, 0.6]).expand(1, 2, 2, 3)])
    assert plot_scene({"a": {"m": triangle(atlas)}}).data[0].facecolor == ("rgb(51,102,153)",)
    uvs = torch.tensor([[0.0, 0], [1, 0], [0, 1]])
    uv = TexturesUV(torch.full((1, 4, 4, 3), 0.2), torch.tensor([[[0, 1, 2]]]), uvs[None])
    assert plot_scene({"a": {"m": triangle(uv)}}).data[0].facecolor == ("rgb(51,51,51)",)
    features = TexturesVertex([torch.rand(3, 7)])
    assert plot_scene({"a": {"m": triangle(features)}}).data[0].vertexcolor is None


def test_clouds_are_thinned_evenly_and_coloured() -> None:
    where = torch.arange(100.0)[:, None].expand(-1, 3)
    cloud = Pointclouds([where], features=[torch.tensor([[0.0, 1, 0, 0.5]]).expand(100, 4)])
    figure = plot_scene({"a": {"c": cloud}}, pointcloud_max_points=10, pointcloud_marker_size=3)
    (trace,) = figure.data
    np.testing.assert_array_equal(trace.x, np.arange(0, 100, 10))
    assert trace.marker.size == 3
    assert trace.marker.color[0] == "rgba(0,255,0,0.5)"
    assert len(plot_scene({"a": {"c": Pointclouds([where])}}).data[0].x) == 100


def test_cameras_are_drawn_where_they_stand() -> None:
    R, T = look_at_view_transform(3.0, 20.0, [10.0, 100.0])
    cameras = FoVPerspectiveCameras(R=R, T=T)
    (trace,) = plot_scene({"a": {"cams": cameras}}, camera_scale=0.1).data
    wireframe = get_camera_wireframe(0.1)
    lines = points(trace).reshape(2, len(wireframe) + 1, 3)
    assert np.isnan(lines[:, -1]).all()
    tip = int(wireframe.norm(dim=1).argmin())
    np.testing.assert_allclose(lines[:, tip], cameras.get_camera_center().numpy(), atol=1e-5)
    # the first point lies ahead, between the camera and the origin that it looks at
    np.testing.assert_allclose(np.linalg.norm(lines[:, 0], axis=1), 3.0 - 0.15, atol=1e-5)


def test_the_wireframe_scales_looks_ahead_and_knows_up() -> None:
    wireframe = get_camera_wireframe()
    torch.testing.assert_close(get_camera_wireframe(0.6), 2 * wireframe)
    assert wireframe.shape[1] == 3
    assert (wireframe[:, 2] >= 0).all()
    torch.testing.assert_close(wireframe[:, 0].amax(), -wireframe[:, 0].amin())
    assert wireframe[:, 1].amax() > -wireframe[:, 1].amin()


def test_rays_run_through_their_points() -> None:
    directions, lengths = torch.eye(3)[None, [0, 1, 2, 0]], torch.arange(5.0).expand(1, 4, 5)
    rays = SimpleNamespace(origins=torch.zeros(1, 4, 3), directions=directions, lengths=lengths)
    (trace,) = plot_scene({"a": {"r": rays}}, raybundle_max_rays=2, raybundle_max_points_per_ray=3).data
    lines = points(trace).reshape(2, 4, 3)
    np.testing.assert_allclose(lines[0, :3, 0], [0, 1, 3])
    np.testing.assert_allclose(lines[1, :3, 2], [0, 1, 3])
    assert trace.mode == "lines+markers"


def test_axes_are_equally_long_and_hold_everything() -> None:
    figure = plot_scene({"a": {"near": triangle(), "far": Pointclouds([torch.tensor([[4.0, 0, 0]])])}})
    scene = figure.layout.scene
    assert scene.aspectmode == "cube"
    spans = [axis.range[1] - axis.range[0] for axis in (scene.xaxis, scene.yaxis, scene.zaxis)]
    assert spans == pytest.approx([spans[0]] * 3)
    assert scene.xaxis.range[0] < 0
    assert scene.xaxis.range[1] > 4


def test_settings_of_axes_and_light() -> None:
    figure = plot_scene(
        {"a": {"m": triangle()}},
        axis_args=AxisArgs(showgrid=True),
        xaxis={"backgroundcolor": "rgb(200, 200, 230)", "title": "width"},
        lighting=Lighting(ambient=0.1),
    )
    scene = figure.layout.scene
    assert scene.yaxis.showgrid
    assert scene.yaxis.backgroundcolor == "#fff"
    assert scene.xaxis.backgroundcolor == "rgb(200, 200, 230)"
    assert scene.xaxis.title.text == "width"
    assert figure.data[0].lighting.ambient == 0.1
    with pytest.warns(UserWarning, match="ignored: lightning; known are"):
        plot_scene({"a": {"m": triangle()}}, lightning=Lighting())


def test_a_viewpoint_is_counted_in_lengths_of_the_axes() -> None:
    sphere = ico_sphere(2).scale_verts(5.0)
    R, T = look_at_view_transform(20.0, 30.0, 40.0)
    camera = plot_scene({"a": {"m": sphere}}, viewpoint_cameras=FoVPerspectiveCameras(R=R, T=T)).layout.scene.camera
    length = 2 * float(sphere.verts_packed().abs().amax()) * 1.05
    expected = FoVPerspectiveCameras(R=R, T=T).get_camera_center()[0] / length
    np.testing.assert_allclose([camera.eye.x, camera.eye.y, camera.eye.z], expected.numpy(), rtol=1e-4)
    np.testing.assert_allclose([camera.center.x, camera.center.y, camera.center.z], np.zeros(3), atol=1e-5)
    assert camera.up.y > 0.8


def test_one_viewpoint_for_all_or_one_for_each() -> None:
    plots = {"a": {"m": triangle()}, "b": {"m": triangle()}}
    R, T = look_at_view_transform(3.0, 0.0, [0.0, 90.0, 180.0])
    one = plot_scene(plots, viewpoint_cameras=FoVPerspectiveCameras(R=R[:1], T=T[:1])).layout
    assert one.scene.camera.eye == one.scene2.camera.eye
    two = plot_scene(plots, viewpoint_cameras=FoVPerspectiveCameras(R=R[:2], T=T[:2])).layout
    assert two.scene.camera.eye != two.scene2.camera.eye
    with pytest.warns(UserWarning, match="3 cameras for 2 subplots"):
        plot_scene(plots, viewpoint_cameras=FoVPerspectiveCameras(R=R, T=T))


@pytest.mark.parametrize("ncols", [1, 2, 3])
def test_subplots_stand_in_rows(ncols: int) -> None:
    figure = plot_scene({name: {"m": triangle()} for name in "abc"}, ncols=ncols)
    tops = {figure.layout[scene].domain.y[1] for scene in ("scene", "scene2", "scene3")}
    assert len(tops) == -(-3 // ncols)


def test_a_batch_in_subplots_of_its_own() -> None:
    batch = join_meshes_as_batch([triangle(), triangle(shift=1.0), triangle(shift=2.0)])
    cloud = Pointclouds([torch.zeros(4, 3)])
    figure = plot_batch_individually([batch, cloud], ncols=2)
    assert [note.text for note in figure.layout.annotations] == ["scene 1", "scene 2", "scene 3"]
    assert [trace.name for trace in figure.data] == ["trace1", "trace2"] * 3
    assert [min(trace.x) for trace in figure.data[::2]] == [0, 1, 2]
    once = plot_batch_individually(
        {"mesh": batch, "cloud": cloud}, extend_struct=False, subplot_titles=["x", "y", "z"]
    )
    assert [trace.name for trace in once.data] == ["mesh", "cloud", "mesh", "mesh"]
    assert [note.text for note in once.layout.annotations] == ["x", "y", "z"]


def test_one_struct_needs_no_list() -> None:
    assert len(plot_batch_individually(triangle()).data) == 1
    R, T = look_at_view_transform(3.0, 0.0, [0.0, 90.0])
    assert len(plot_batch_individually(FoVPerspectiveCameras(R=R, T=T)).data) == 2
    rays = SimpleNamespace(origins=torch.zeros(2, 4, 3), directions=torch.ones(2, 4, 3), lengths=torch.ones(2, 4, 5))
    assert len(plot_batch_individually(rays).data) == 2


def test_nothing_to_plot() -> None:
    with pytest.warns(UserWarning, match="No structs"):
        assert plot_batch_individually([]) is None
    empty = Meshes([torch.zeros(0, 3)], [torch.zeros(0, 3, dtype=torch.long)])
    figure = plot_scene({"a": {"m": empty, "c": Pointclouds([torch.zeros(0, 3)])}})
    assert len(figure.data[0].x) == 0
    assert len(plot_scene({"a": {}}).data) == 0


def test_points_that_are_not_numbers_do_not_spoil_the_axes() -> None:
    cloud = Pointclouds([torch.tensor([[0.0, 0, 0], [torch.nan, 0, 0], [torch.inf, 1, 1], [1, 1, 1]])])
    bounds = plot_scene({"a": {"c": cloud}}).layout.scene.xaxis.range
    assert bounds == pytest.approx((-0.025, 1.025))


def test_figures_of_what_lies_on_another_device(far) -> None:  # noqa: F811
    R, T = look_at_view_transform(3.0, 0.0, [0.0])
    cameras = FoVPerspectiveCameras(R=R, T=T).to(far)
    mesh = triangle(TexturesVertex([torch.ones(3, 3)])).to(far)
    cloud = Pointclouds([torch.rand(30, 3)], features=[torch.rand(30, 3)]).to(far)
    figure = plot_scene(
        {"a": {"m": mesh, "c": cloud, "k": cameras}}, viewpoint_cameras=cameras, pointcloud_max_points=7
    )
    assert len(figure.data) == 3


def test_errors_say_what_was_given() -> None:
    with pytest.raises(ValueError, match=r"struct 'x' is not a Cameras, Meshes.*but dict"):
        plot_scene({"a": {"x": {}}})
    with pytest.raises(ValueError, match="at least one subplot"):
        plot_scene({})
    with pytest.raises(ValueError, match="name of a trace"):
        plot_scene({"a": triangle()})
    with pytest.raises(ValueError, match="ncols"):
        plot_scene({"a": {"m": triangle()}}, ncols=0)
    two, three = (join_meshes_as_batch([triangle()] * n) for n in (2, 3))
    with pytest.raises(ValueError, match=r"'trace1': 2, 'trace2': 3"):
        plot_batch_individually([two, three])
    with pytest.raises(ValueError, match="expected 2 subplot_titles"):
        plot_batch_individually(two, subplot_titles=["a"])
    with pytest.raises(ValueError, match="got int"):
        plot_batch_individually([3])


def test_without_plotly_one_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.partition(".")[0] == "plotly":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(ImportError, match=r"pip install 'rendra\[view\]'"):
        plot_scene({"a": {"m": triangle()}})
