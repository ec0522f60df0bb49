"""The viewer: what is packed comes out again, what is too large shrinks, and a browser shows it."""

import base64
import io
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from headless_chromium import seen
from PIL import Image

import rendra_lab.viewer.scene as scene_module
from rendra.io import IO, MeshFormatError
from rendra.renderer import FoVPerspectiveCameras, PerspectiveCameras, look_at_view_transform
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes, Pointclouds
from rendra.utils import ico_sphere
from rendra_lab.viewer import Limits, payload_json, scene_payload, viewer_assets, viewer_page
from rendra_lab.viewer.packing import packed_normals, packed_positions
from rendra_lab.viewer.thinning import merged_neighbours

TYPES = {"f32": "<f4", "u32": "<u4", "u16": "<u2", "u8": "u1"}


def unpacked(packed: dict[str, Any]) -> np.ndarray:
    array = np.frombuffer(base64.b64decode(packed["data"]), TYPES[packed["type"]]).reshape(packed["shape"])
    return array * np.array(packed["step"]) + np.array(packed["low"]) if "low" in packed else array


def only(shape: Any, **options: Any) -> dict[str, Any]:
    (item,) = scene_payload([("it", shape)], **options)["items"]
    return item


def ball(level: int = 2, textures: Any = None) -> Meshes:
    mesh = ico_sphere(level)
    return Meshes(mesh.verts_list(), mesh.faces_list(), textures)


def painted(level: int, color: tuple[float, float, float]) -> Meshes:
    mesh = ball(level)
    mesh.textures = TexturesVertex([torch.tensor(color).expand(len(mesh.verts_packed()), 3)])
    return mesh


def quad(image: torch.Tensor, **reading: Any) -> Meshes:
    """A square from -1 to 1 that shows a whole image."""
    verts = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return Meshes([verts], [faces], TexturesUV(image[None], [faces], [uvs], **reading))


def test_a_mesh_comes_out_as_it_went_in() -> None:
    mesh = painted(2, (1.0, 0.5, 0.0))
    item = only(mesh)
    np.testing.assert_array_equal(unpacked(item["positions"]), mesh.verts_packed().numpy())
    np.testing.assert_array_equal(unpacked(item["faces"]), mesh.faces_packed().numpy())
    assert item["faces"]["type"] == "u16"
    assert unpacked(item["colors"])[0].tolist() == [255, 128, 0]
    assert item["counts"] == {"verts": 162, "faces": 320}
    np.testing.assert_allclose(item["bounds"], [[-1, -1, -1], [1, 1, 1]], atol=0.1)
    assert not item["notes"]
    assert "normals" not in item  # those that were computed are computed again by the page


def test_a_cloud_comes_out_as_it_went_in() -> None:
    points, normals = torch.randn(100, 3), torch.randn(100, 3)
    item = only(Pointclouds([points], normals=[normals], features=[torch.rand(100, 1)]))
    np.testing.assert_array_equal(unpacked(item["positions"]), points.numpy())
    colors = unpacked(item["colors"])
    assert (colors == colors[:, :1]).all()
    assert unpacked(item["normals"]).shape == (100, 2)


def test_many_positions_take_16_bits_within_half_a_step() -> None:
    points = np.random.default_rng(0).normal(size=(60_000, 3)).astype(np.float32) * [1, 100, 0] + [1e4, 0, 5]
    packed = packed_positions(points.astype(np.float32))
    assert packed["type"] == "u16"
    error = np.abs(unpacked(packed) - points.astype(np.float32)).max(axis=0)
    assert (error <= 0.501 * np.array(packed["step"]) + 1e-9).all()


def test_texture_coordinates_split_vertices_and_mean_outer_edges() -> None:
    """The corner between two faces that lie apart in the image becomes two vertices."""
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs, faces_uvs = torch.rand(6, 2), torch.arange(6).reshape(2, 3)
    textures = TexturesUV(torch.rand(1, 4, 8, 3), [faces_uvs], [uvs])
    verts = torch.rand(4, 3)
    item = only(Meshes([verts], [faces], textures))
    corners = unpacked(item["faces"]).reshape(-1)
    np.testing.assert_array_equal(unpacked(item["positions"])[corners], verts[faces.reshape(-1)].numpy())
    expected = (uvs.numpy() * [7, 3] + 0.5) / [8, 4]
    np.testing.assert_allclose(unpacked(item["uvs"])[corners], expected, atol=1e-6)
    assert item["counts"]["verts"] == 4
    assert item["texture"]["repeat"] == "edge"


def test_a_small_image_is_kept_to_the_bit_and_a_large_one_shrinks() -> None:
    levels = torch.arange(8 * 8 * 3).reshape(8, 8, 3) / 255
    head, _, data = only(quad(levels))["texture"]["image"].partition(",")
    assert head == "data:image/png;base64"
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        np.testing.assert_array_equal(np.asarray(image), (levels * 255).round().byte().numpy())
    head, _, data = only(quad(torch.zeros(8, 5000, 3)))["texture"]["image"].partition(",")
    with Image.open(io.BytesIO(base64.b64decode(data))) as image:
        assert image.width == 4096


def test_colours_of_faces_are_texels_that_do_not_mix() -> None:
    colors = torch.rand(320, 1, 1, 3)
    item = only(ball(2, TexturesAtlas([colors])))
    assert item["texture"]["nearest"]
    assert not item["notes"]
    assert only(ball(2, TexturesAtlas([colors.expand(-1, 4, 4, 3)])))["notes"] == [
        "every face is drawn in its mean colour"
    ]


def test_several_images_become_colours_of_vertices_and_it_is_said() -> None:
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    maps = torch.stack([torch.zeros(4, 4, 3), torch.ones(4, 4, 3)])[None]
    textures = TexturesUV(maps, [faces], [torch.rand(6, 2)], maps_ids=[torch.tensor([0, 1])])
    item = only(Meshes([torch.rand(6, 3)], [faces], textures))
    assert unpacked(item["colors"])[:, 0].tolist() == [0, 0, 0, 255, 255, 255]
    assert item["notes"] == ["the texture is drawn as colours of vertices"]


@pytest.mark.parametrize(("channels", "kept"), [(0, False), (1, True), (2, False), (3, True), (16, True)])
def test_features_that_are_no_colours_are_named(channels: int, kept: bool) -> None:
    item = only(ball(1, TexturesVertex([torch.rand(42, channels)])))
    assert ("colors" in item) == kept
    assert bool(item["notes"]) != kept


def test_corners_of_sharp_edges_keep_their_normals(tmp_path: Path) -> None:
    path = tmp_path / "roof.obj"
    path.write_text(
        "v 0 0 0\nv 0 0 1\nv 1 -1 0\nv -1 -1 0\nvn 1 1 0\nvn -1 1 0\nf 1//1 2//1 3//1\nf 2//2 1//2 4//2\n"
    )
    item = only(path)
    assert item["counts"] == {"verts": 4, "faces": 2}
    assert unpacked(item["positions"]).shape == (6, 3)
    assert not item["notes"]


def test_a_mesh_beyond_the_limit_is_drawn_coarser_and_says_so() -> None:
    item = only(painted(5, (0.0, 1.0, 0.0)), limits=Limits(faces=2000))
    faces, verts = unpacked(item["faces"]), unpacked(item["positions"])
    assert 1000 < len(faces) <= 2000
    assert faces.max() < len(verts)
    np.testing.assert_allclose(np.linalg.norm(verts, axis=1), 1.0, atol=0.05)
    assert (unpacked(item["colors"]) == [0, 255, 0]).all()
    assert item["counts"]["faces"] == 20480
    assert item["notes"] == [f"drawn with {len(faces):,} of 20,480 faces: neighbouring vertices are merged"]


def test_a_coarser_mesh_keeps_what_was_painted_with_an_image() -> None:
    mesh = quad(torch.full((4, 4, 3), 0.2))
    item = only(mesh, limits=Limits(faces=1))
    assert "texture" not in item
    assert "the texture is drawn as colours of vertices" in item["notes"]


def test_merging_ends_where_all_points_coincide() -> None:
    faces = np.array([[0, 1, 2], [1, 2, 3]])
    verts, kept, _ = merged_neighbours(np.ones((4, 3), np.float32), faces, {}, 1)
    assert len(kept) == 0
    np.testing.assert_array_equal(verts, np.ones((1, 3)))


def test_a_cloud_beyond_the_limit_is_drawn_in_part_and_says_so() -> None:
    points = torch.randn(5000, 3)
    item = only(Pointclouds([points], features=[torch.rand(5000, 3)]), limits=Limits(points=700))
    assert unpacked(item["positions"]).shape == unpacked(item["colors"]).shape == (700, 3)
    assert item["notes"] == ["drawn with 700 of 5,000 points, chosen at random"]
    assert only(Pointclouds([points]), limits=Limits(points=700))["positions"] == item["positions"]


def test_what_is_not_finite_is_left_out() -> None:
    mesh = ball(1)
    verts = mesh.verts_packed().clone()
    verts[0, 1] = torch.nan
    item = only(Meshes([verts], mesh.faces_list()))
    assert len(unpacked(item["faces"])) == 75
    assert np.isfinite(unpacked(item["positions"])).all()
    assert "5 faces are left out" in item["notes"][0]
    cloud = only(Pointclouds([torch.tensor([[0.0, 0, 0], [torch.inf, 0, 0]])]))
    assert cloud["bounds"] == [[0, 0, 0], [0, 0, 0]]
    assert "1 points are left out" in cloud["notes"][0]


@pytest.mark.parametrize(
    "nothing",
    [Meshes([torch.zeros(0, 3)], [torch.zeros(0, 3, dtype=torch.long)]), Pointclouds([torch.zeros(0, 3)])],
    ids=["mesh", "cloud"],
)
def test_nothing_is_an_item_without_bounds(nothing: Meshes | Pointclouds) -> None:
    item = only(nothing)
    assert item["bounds"] is None
    json.loads(payload_json({"items": [item]}))


def test_every_mesh_of_a_batch_is_an_item() -> None:
    batch = Meshes([ball(0).verts_packed(), ball(1).verts_packed()], [ball(0).faces_packed(), ball(1).faces_packed()])
    items = scene_payload([("both", batch), ("none", batch[[]])])["items"]
    assert [(item["name"], item["counts"]["verts"]) for item in items] == [("both 0", 12), ("both 1", 42)]


def test_cameras_are_pyramids_from_their_centres_through_the_corners_of_their_images() -> None:
    R, T = look_at_view_transform(3.0, 20.0, torch.tensor([0.0, 90.0, 200.0]))
    size = torch.tensor([[100, 200]]).expand(3, 2)
    for cameras in (
        FoVPerspectiveCameras(R=R, T=T),
        PerspectiveCameras(
            focal_length=150.0, principal_point=((100.0, 50.0),), R=R, T=T, in_ndc=False, image_size=size
        ),
    ):
        item = scene_payload([("cameras", cameras), ("ball", ball(1))])["items"][1]
        points = torch.from_numpy(unpacked(item["positions"]).copy()).reshape(3, 6, 3)
        torch.testing.assert_close(points[:, 0], cameras.get_camera_center(), atol=1e-5, rtol=0)
        image = cameras.transform_points_ndc(points[:, 1:5])[..., :2]
        wide = 2.0 if cameras.get_image_size() is not None else 1.0
        torch.testing.assert_close(image.abs(), torch.tensor([wide, 1.0]).expand(3, 4, 2), atol=1e-4, rtol=0)
        assert item["counts"] == {"cameras": 3}


def test_files_bring_the_remarks_of_their_reader(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("mtllib gone.mtl\nusemtl gold\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert any("gone.mtl" in note for note in only(path)["notes"])
    path.write_text("v 0 0 zero\nf 1 1 1\n")
    with pytest.raises(MeshFormatError, match="line 1"):
        only(path)


def test_what_cannot_be_viewed_is_named() -> None:
    with pytest.raises(ValueError, match=r"list: a shape to view is a file, .* not list"):
        scene_payload([("list", [1, 2])])  # type: ignore[list-item]
    with pytest.raises(ValueError, match="up is 'x'; expected 'y' or 'z'"):
        scene_payload([], up="x")


def test_no_name_ends_the_script_it_stands_in() -> None:
    name = "</script><!--\u2028<b>&"
    text = payload_json(scene_payload([(name, ball(0))]))
    assert "<" not in text
    assert "\u2028" not in text
    assert json.loads(text)["items"][0]["name"] == name
    page = viewer_page(name, scene_payload([(name, ball(0))]))
    assert page.count("</script>") == 2
    assert "<title>&lt;/script&gt;" in page
    assert all("</" not in text for text in viewer_assets())


def test_a_page_asks_nobody_for_anything() -> None:
    page = viewer_page("ball", scene_payload([("ball", ball(0))]))
    for word in ("http:", "https:", "src=", "@import", "url(", "fetch(", "XMLHttpRequest"):
        assert word not in page


def run_node(code: str, *inputs: Any) -> Any:
    """The program's own functions are in reach of `code`; `given` is what is passed, `say` answers."""
    if shutil.which("node") is None:
        pytest.skip("no node on this machine")
    assets = Path(scene_module.__file__).parent / "assets"
    parts = [(assets / name).read_text() for name in ("algebra.js", "geometry.js", "view.js")]
    head = (
        "const given = JSON.parse(require('fs').readFileSync(0)); const say = (x) => console.log(JSON.stringify(x));"
    )
    done = subprocess.run(
        ["node", "-e", "\n".join([head, *parts, code])], input=json.dumps(inputs), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_program_is_javascript(tmp_path: Path) -> None:
    if shutil.which("node") is None:
        pytest.skip("no node on this machine")
    (tmp_path / "viewer.js").write_text(viewer_assets()[1])
    subprocess.run(["node", "--check", str(tmp_path / "viewer.js")], check=True)


def test_the_page_reads_what_was_packed() -> None:
    normals = np.random.default_rng(0).normal(size=(500, 3))
    normals[:7] = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 0], [np.nan, 0, 0]]
    points = np.random.default_rng(1).normal(size=(60_000, 3)).astype(np.float32) + 1000.0
    packed = packed_positions(points)
    code = "say([[...decodedNormals(given[0])], [...decodedPositions(given[1], [1000, 1000, 1000]).slice(0, 3000)]]);"
    read_normals, read_points = (
        np.array(each).reshape(-1, 3) for each in run_node(code, packed_normals(normals), packed)
    )
    units = normals[:5] / np.linalg.norm(normals[:5], axis=1, keepdims=True)
    np.testing.assert_allclose(read_normals[:5], units, atol=1e-4)
    assert (read_normals[5:7] == 0).all()
    units = normals[7:] / np.linalg.norm(normals[7:], axis=1, keepdims=True)
    np.testing.assert_allclose(read_normals[7:], units, atol=1e-4)
    np.testing.assert_allclose(read_points, unpacked(packed)[:1000] - 1000.0, atol=1e-6)


def test_normals_go_over_seams_and_point_outwards() -> None:
    """A ball whose faces share no vertex is as smooth as one whose faces do; a cube is not."""
    mesh = ball(3)
    verts = mesh.verts_packed()[mesh.faces_packed().reshape(-1)].numpy()
    code = """
    const found = smoothNormals(Float32Array.from(given[0]), Uint32Array.from(given[1]));
    say([[...found.normals], found.bend]);"""
    normals, bend = run_node(code, verts.reshape(-1).tolist(), list(range(len(verts))))
    cosines = (np.array(normals).reshape(-1, 3) * verts).sum(axis=1)
    assert cosines.min() > 0.999
    assert bend > 0.99
    cube = torch.tensor([[x, y, z] for x in (0.0, 1) for y in (0.0, 1) for z in (0.0, 1)])
    sides = [
        0,
        1,
        3,
        0,
        3,
        2,
        4,
        6,
        7,
        4,
        7,
        5,
        0,
        4,
        5,
        0,
        5,
        1,
        2,
        3,
        7,
        2,
        7,
        6,
        0,
        2,
        6,
        0,
        6,
        4,
        1,
        5,
        7,
        1,
        7,
        3,
    ]
    _, bend = run_node(code, cube.reshape(-1).tolist(), sides)
    assert bend < 0.88


def test_a_place_in_the_window_is_found_again() -> None:
    """`placeAt` undoes the projection, for both axes that may point up."""
    code = """
    const errors = [];
    for (const up of ["y", "z"]) {
      const view = new View(up, { yaw: 50, pitch: -35 });
      view.aspect = 1.7;
      view.reset([0.3, -0.2, 0.1], 2);
      const m = view.matrix(3), p = [0.5, 0.4, -0.6];
      const clip = [0, 1, 3, 2].map((row) => m[row] * p[0] + m[4 + row] * p[1] + m[8 + row] * p[2] + m[12 + row]);
      const found = view.placeAt(clip[0] / clip[2], clip[1] / clip[2], 0.5 + 0.5 * clip[3] / clip[2]);
      errors.push(size(subtract(found, p)));
      errors.push(Math.abs(dot(cross(view.axes().right, view.axes().up), view.axes().back) - 1));
    }
    say(errors);"""
    assert max(run_node(code)) < 1e-4


BOX = 200  # pixels on a side of one viewer in a page of many
WHITE = [255, 255, 255]


def page_of(scenes: list[tuple[dict[str, Any], dict[str, Any]]], script: str = "") -> str:
    """Viewers side by side on white, without controls unless their options say otherwise."""
    style, program = viewer_assets()
    plain = {"controls": False, "background": "white", "yaw": 0, "pitch": 0}
    payloads = payload_json({"scenes": [[payload, {**plain, **options}] for payload, options in scenes]})
    boxes = "".join(f'<div class="box" id="v{i}"></div>' for i in range(len(scenes)))
    return f"""<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,"><style>{style}
    body {{ margin: 0; }} .box {{ float: left; width: {BOX}px; height: {BOX}px; min-height: 0 !important; }}</style>
    {boxes}<script>const before = new Set(Object.getOwnPropertyNames(window));</script>
    <script>{program}</script><script>
    const leaked = Object.getOwnPropertyNames(window).filter((name) => !before.has(name));
    let drawn = 0;
    for (const name of ["drawElements", "drawArrays"]) {{
      const draw = WebGL2RenderingContext.prototype[name];
      WebGL2RenderingContext.prototype[name] = function (...given) {{ drawn++; return draw.apply(this, given); }};
    }}
    const handles = {payloads}.scenes.map(([payload, options], i) =>
      RendraViewer.mount(document.getElementById("v" + i), payload, options));
    const canvas = (i) => document.querySelector("#v" + i + " canvas");
    for (const each of document.querySelectorAll("canvas")) each.setPointerCapture = () => {{}};
    const press = (i, ...keys) => keys.forEach((key) => handles[i].press(key));
    const mouse = (i, kind, x, y, more) => {{
      const box = canvas(i).getBoundingClientRect();
      const place = {{ clientX: box.left + x, clientY: box.top + y }};
      const given = {{ ...place, bubbles: true, cancelable: true, pointerId: 1, buttons: 1 }};
      const Kind = kind === "wheel" ? WheelEvent : kind === "dblclick" ? MouseEvent : PointerEvent;
      canvas(i).dispatchEvent(new Kind(kind, {{ ...given, ...more }}));
    }};
    const frames = async (count) => {{
      for (let i = 0; i < count; i++) await new Promise((next) => requestAnimationFrame(next));
    }};
    window.finished = (async () => {{
      while (drawn < 4 * handles.length) await frames(1);  // of shape, grid and axes
      {script}
    }})();
    </script>"""


def boxes(picture: np.ndarray, count: int) -> list[np.ndarray]:
    across = picture.shape[1] // BOX
    corners = [((i // across) * BOX, (i % across) * BOX) for i in range(count)]
    return [picture[top : top + BOX, left : left + BOX] for top, left in corners]


def test_a_browser_shows_images_upright_both_sides_and_no_seams(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = torch.zeros(4, 4, 3)
    image[:2, :, 0] = image[2:, :, 2] = 1.0  # red above blue
    mesh = painted(3, (0.2, 0.8, 0.3))
    inside_out = Meshes(mesh.verts_list(), [mesh.faces_packed().flip(1)], mesh.textures)
    faces = mesh.faces_packed().reshape(-1)
    apart = Meshes(
        [mesh.verts_packed()[faces]],
        [torch.arange(len(faces)).reshape(-1, 3)],
        TexturesVertex([mesh.textures.verts_features_packed()[faces]]),
    )
    spots = torch.stack(torch.meshgrid(torch.linspace(-1, 1, 150), torch.linspace(-1, 1, 150), indexing="ij"), dim=-1)
    spots = torch.nn.functional.pad(spots.reshape(-1, 2), (0, 1))
    cloud = Pointclouds([spots], features=[torch.tensor([0.0, 0.0, 1.0]).expand(len(spots), 3)])
    far_away = Meshes([mesh.verts_packed() + torch.tensor([5e3, 0, 0])], mesh.faces_list(), mesh.textures)
    shapes = [quad(image, sampling_mode="nearest"), mesh, inside_out, apart, cloud, far_away]
    script = "handles.forEach((handle, i) => { press(i, 'g', 'a'); if (i === 0 || i === 4) press(i, 'l'); });"
    payloads = [scene_payload([("it", shape)]) for shape in shapes]
    monkeypatch.setattr("rendra_lab.viewer.packing._QUANTISED_BEYOND", 10)
    payloads.append(scene_payload([("it", mesh)]))
    picture, said = seen(page_of([(each, {}) for each in payloads], script), tmp_path)
    assert said == []
    flat, smooth, *others = boxes(picture, len(payloads))
    assert flat[60:90, 100].tolist() == [[255, 0, 0]] * 30
    assert flat[110:140, 100].tolist() == [[0, 0, 255]] * 30
    assert flat[3, 3].tolist() == WHITE
    center = smooth[100, 100]
    assert center[1] > 180 > 120 > center[0]
    for other, allowed in ((others[0], 0.1), (others[1], 0.1), (others[3], 1.0), (others[4], 1.0)):
        assert np.abs(other - smooth).mean() < allowed
    assert others[2][100, 100].tolist() == [0, 0, 255]


def test_a_browser_follows_the_mouse_the_keys_and_the_loss_of_a_context(tmp_path: Path) -> None:
    mesh = ball(2)
    axis = mesh.verts_packed()
    mesh.textures = TexturesVertex([(axis > 0).float()])
    payload = scene_payload([("</script><b>it", mesh)])
    script = """
    handles.forEach((handle, i) => press(i, "g", "a"));
    mouse(0, "pointerdown", 100, 100);
    mouse(0, "pointermove", 150, 100);
    mouse(0, "pointerup", 150, 100);
    mouse(2, "wheel", 100, 100, { deltaY: -20, ctrlKey: true });
    mouse(3, "pointerdown", 100, 100, { buttons: 2 });
    mouse(3, "pointermove", 130, 100, { buttons: 2 });
    mouse(4, "dblclick", 130, 100);
    press(5, "e", "f");
    press(6, "n");
    const loser = canvas(7).getContext("webgl2").getExtension("WEBGL_lose_context");
    loser.loseContext();
    await frames(10);
    loser.restoreContext();
    await frames(30);
    const settled = drawn;
    await frames(30);
    console.log(JSON.stringify({
      leaked: leaked, idle: drawn - settled,
      name: document.querySelector("#v0 .rendra-viewer-items span").textContent,
      bold: document.querySelectorAll("b").length - document.querySelectorAll(".rendra-viewer-help b").length,
      counts: document.querySelector("#v0 .rendra-viewer-counts").textContent,
    }));"""
    options = [{}, {"yaw": -45}, *[{}] * 6]
    picture, said = seen(page_of([(payload, each) for each in options], script), tmp_path)
    assert len(said) == 1, said
    told = json.loads(said[0])
    assert told["leaked"] == ["RendraViewer"]
    assert told["idle"] == 0
    assert (told["name"], told["bold"]) == ("</script><b>it", 0)
    assert told["counts"].startswith("162 vertices, 320 faces · ")
    dragged, turned, zoomed, shifted, refocused, wires, normals, restored = boxes(picture, 8)
    assert np.abs(dragged - turned).mean() < 0.1
    columns = [np.nonzero((box != 255).any(axis=(0, 2)))[0] for box in (zoomed, shifted, refocused, restored)]
    lefts, rights = [each[0] for each in columns], [each[-1] for each in columns]
    assert lefts[0] < lefts[3] - 2
    assert rights[0] > rights[3] + 2
    assert 25 < lefts[1] - lefts[3] < 35
    assert 18 < rights[3] - rights[2] < 28  # the place is nearer to the eye than the middle
    assert np.abs(restored[:, :100] - shifted[:, 30:130]).mean() < 12
    assert 0.01 < (wires != 255).any(axis=2).mean() < 0.6
    assert np.abs(normals[100, 100] - [128, 128, 255]).max() < 40


def test_without_webgl_there_is_a_sentence(tmp_path: Path) -> None:
    tell = "await frames(5); console.log(document.querySelector('.rendra-viewer-message').textContent); return;"
    page = page_of([(scene_payload([("ball", ball(1))]), {})]).replace("while (drawn", tell + " while (drawn")
    _, said = seen(page, tmp_path, webgl=False)
    assert said[-1] == ("This browser offers no WebGL 2, which the 3-D view needs. ball: 42 vertices, 80 faces")


def test_files_of_every_kind_are_read(tmp_path: Path) -> None:
    for suffix in (".obj", ".ply", ".off", ".stl", ".glb"):
        path = tmp_path / f"ball{suffix}"
        IO().save_mesh(ball(1), path)
        assert only(path)["counts"]["faces"] == 80
    IO().save_pointcloud(Pointclouds([torch.rand(9, 3)]), tmp_path / "cloud.xyz")
    assert only(str(tmp_path / "cloud.xyz"))["counts"] == {"points": 9}
