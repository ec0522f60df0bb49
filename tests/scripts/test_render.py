"""scripts/render.py and its part of the configuration tree."""

import subprocess
import sys
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from omegaconf import OmegaConf
from PIL import Image

from rendra.renderer.mesh.shader import HardGouraudShader
from rendra_lab.data.meshes import load_mesh
from rendra_lab.pictures import Studio

ROOT = Path(__file__).parents[2]
GROUPS = ("mesh", "camera", "light", "material", "shader")
CHOICES = [(group, file.stem) for group in GROUPS for file in sorted((ROOT / "conf" / group).glob("*.yaml"))]


def compose_render(*overrides: str):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("render", overrides=list(overrides))


@pytest.mark.parametrize(("group", "choice"), CHOICES)
def test_every_choice_renders(group: str, choice: str) -> None:
    cfg = compose_render(f"{group}={choice}")
    parts = {name: instantiate(cfg[name], _convert_="all") for name in GROUPS if name != "mesh"}
    small = {"texture_size": 128, "num_faces": 2000} if choice == "cow" else {}
    mesh = instantiate(cfg.mesh, **small) if group == "mesh" else load_mesh("torus", sides=8, rings=12)
    studio = Studio(parts["camera"], parts["light"], parts["material"], parts["shader"], (32, 32), antialias=1)
    image = studio.render(mesh)
    assert image[..., :3].std() > 0 or choice == "ambient"
    assert studio.sees(mesh)


def test_help_names_every_choice() -> None:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        template = compose("render", return_hydra_config=True).hydra.help.template
    listed = {}
    for line in template.splitlines():
        group, _, names = line.partition(": ")
        listed[group.strip()] = set(names.split(", "))
    for group in GROUPS:
        assert listed[group] == {name for other, name in CHOICES if other == group}


def test_the_file_of_the_cow_names_its_whole_build() -> None:
    from dataclasses import asdict

    from rendra_lab.synthesis.cow import CowParameters

    assert OmegaConf.to_container(compose_render().mesh.build) == asdict(CowParameters())


def test_gouraud_is_for_vertex_colours() -> None:
    assert isinstance(instantiate(compose_render("shader=hard_gouraud").shader).shader, HardGouraudShader)


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, str(ROOT / "scripts" / "render.py"), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=120, check=False)


def test_the_program_writes_where_it_says(tmp_path: Path) -> None:
    done = run(tmp_path, "mesh=torus", "mesh.sides=8", "mesh.rings=12", "height=40", "width=60", "antialias=1")
    assert done.returncode == 0, done.stderr
    path = Path(done.stdout.splitlines()[-1])
    assert path.is_relative_to(tmp_path / "outputs" / "render")
    with Image.open(path) as image:
        assert image.size == (60, 40)


def test_the_program_answers_mistakes_in_one_line(tmp_path: Path) -> None:
    done = run(tmp_path, "mesh.path=nowhere.obj")
    assert done.returncode != 0
    assert done.stderr.strip() == "render.py: mesh: there is no mesh file nowhere.obj"
