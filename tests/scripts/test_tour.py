"""The pages of scripts/tour: what they print is true, with their own examples and with a user's file."""

import ast
import importlib.util
import re
from pathlib import Path

import pytest
import torch

from rendra.io import save_obj
from rendra.utils import ico_sphere

TOUR = Path(__file__).parents[2] / "scripts" / "tour"
PAGES = sorted(path.stem for path in TOUR.glob("*.py"))


@pytest.fixture
def page(capsys):
    """Runs a page; answers what it printed, line by line under what stands before the first colon."""

    def run(name: str, *files: Path) -> dict[str, str]:
        spec = importlib.util.spec_from_file_location(f"tour_{name}", TOUR / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.main(*[str(file) for file in files])
        lines = capsys.readouterr().out.splitlines()
        return {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}

    return run


@pytest.fixture
def sphere(tmp_path) -> Path:
    mesh = ico_sphere(1)
    save_obj(tmp_path / "sphere.obj", mesh.verts_packed(), mesh.faces_packed())
    return tmp_path / "sphere.obj"


def numbers(text: str) -> list[float]:
    return [float(each) for each in re.findall(r"[-+]?\d+\.\d+", text)]


def test_every_page_is_short_listed_and_tested() -> None:
    listed = re.findall(r"scripts/tour/(\w+)\.py", (TOUR / "README.md").read_text())
    assert sorted(listed) == PAGES
    tested = Path(__file__).read_text()
    for name in PAGES:
        text = (TOUR / f"{name}.py").read_text()
        assert len(text.splitlines()) < 80
        assert f"python scripts/tour/{name}.py" in ast.get_docstring(ast.parse(text)).splitlines()[0]
        assert f'page("{name}"' in tested


def test_files(page, sphere) -> None:
    printed = page("files")
    assert printed["house.obj"] == "5 vertices, 3 triangles (a polygon becomes a fan)"
    # the square becomes two triangles; -2, -3, -1 of five vertices are the fourth, the third and the last
    assert printed["faces.verts_idx (3, 3)"] == "[[0, 1, 2], [0, 2, 3], [3, 2, 4]]"
    assert printed["faces.textures_idx (3, 3)"].endswith("[-1, -1, -1]]")
    assert printed["faces.materials_idx (3,)"] == "[0, 0, 1]"
    assert printed["material wall"] == "{'diffuse_color': [0.9, 0.8, 0.6]}"
    assert "'shininess': [20.0]" in printed["material roof"]
    assert printed["written as OBJ and read again"] == "same=True"
    assert printed["written as PLY and read again"] == "same=True, 3 triangles"
    own = page("files", sphere)
    assert own["sphere.obj"].startswith("42 vertices, 80 triangles")
    assert own["properties.verts_uvs"] == "none"


def test_cameras(page, sphere) -> None:
    printed = page("cameras")
    assert printed["row vectors"] == "x_view = x_world R + T: True"
    assert printed["straight ahead is the middle of the picture"] == "True"
    centre, view = printed["camera 4"].split("view")  # the camera that is neither turned nor moved
    assert numbers(centre) == [0, 0, 0]
    assert numbers(view) == [-0.5, -0.5, 9.5]
    for name, depth in (("perspective", 9.5), ("orthographic", 1.0)):
        x, y, _ = numbers(printed[f"{name} 4"].split("screen")[1])
        assert (x, y) == pytest.approx((512 + 1200 * 0.5 / depth, 256 + 300 * 0.5 / depth), abs=1e-3)
        ndc_x, ndc_y, _ = numbers(printed[f"{name} 4"].split("ndc")[1].split("screen")[0])
        assert (x, y) == pytest.approx((512 - 256 * ndc_x, 256 - 256 * ndc_y), abs=0.2)
    assert numbers(printed["its NDC"]) == [0, 0, 0.2]
    assert numbers(printed["and with the book's size"]) == [-1, 1, 0.2]
    assert numbers(page("cameras", sphere)["row vectors"]) == []


def test_batches(page, sphere) -> None:
    printed = page("batches")
    assert printed["a batch of 3, equally large"] == "False"
    assert printed["list"] == "[(3, 3), (12, 3), (42, 3)]"
    assert printed["padded"] == "(3, 42, 3) filled up with 0.0"
    assert printed["padded faces"] == "(3, 80, 3) filled up with -1"
    assert printed["packed"] == "(57, 3)"
    assert printed["first packed row of each"] == "[0, 3, 15]"
    assert printed["samples"] == "(3, 500, 3) normals: (3, 500, 3)"
    assert printed["chamfer distance of each from itself, moved by 0.01"] == "[0.0002, 0.0002, 0.0002]"
    assert page("batches", sphere, sphere)["packed"] == "(84, 3)"


def test_rotations(page) -> None:
    printed = page("rotations")
    claims = [value for value in printed.values() if value in ("True", "False")]
    assert claims == ["True"] * 7
    assert printed["shifted by 1, then doubled"] == "[[2.0, 0.0, 0.0]]"
    assert printed["doubled, then shifted by 1"] == "[[1.0, 0.0, 0.0]]"
    angles, lengths = printed["angles"].split("= lengths:")
    assert angles.strip() == lengths.strip()
    assert any("has the last row [0.4692, 2.1625, 3.0, 1.0]" in line for line in printed)
    found, true = printed["found by gradient descent"].split("true:")
    assert numbers(found) == pytest.approx([0, 0, *numbers(true)], abs=1e-3)


def test_camera_conventions(page) -> None:
    printed = page("camera_conventions")
    places = {name: printed[name].split("->") for name in ("here", "OpenCV", "OpenGL")}
    assert len({pixel for _, pixel in places.values()}) == 1
    here, opencv, opengl = (torch.tensor(numbers(view)) for view, _ in places.values())
    assert torch.equal(opencv, here * torch.tensor([-1.0, -1.0, 1.0]))
    assert torch.equal(opengl, here * torch.tensor([-1.0, 1.0, -1.0]))
    assert [printed[f"back from {name}"] for name in ("OpenCV", "OpenGL", "COLMAP")] == ["the same pixel: True"] * 3
    assert numbers(printed["middle of the picture as OpenCV's calibration has it"]) == [159.5, 119.5]


def test_gradients(page, sphere) -> None:
    printed = page("gradients")
    assert numbers(printed["gradient"]) == pytest.approx(numbers(printed["finite differences"]), abs=2e-3)
    losses = [numbers(value)[0] for key, value in printed.items() if key.startswith("step")]
    assert losses[-1] < losses[0] / 100
    (found,) = (key for key in printed if key.startswith("found"))
    assert numbers(found)[:2] == pytest.approx([0.3, -0.2], abs=0.02)
    own = page("gradients", sphere)
    assert numbers(own["gradient"]) == pytest.approx(numbers(own["finite differences"]), abs=2e-3)
