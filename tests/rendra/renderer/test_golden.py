"""Whole renderings against pictures that people have looked at: tests/golden/*.png."""

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from golden_images import check_image
from torch import Tensor

from rendra.io.mtl_io import make_material_atlas
from rendra.renderer import (
    AmbientLights,
    BlendParams,
    DirectionalLights,
    FoVOrthographicCameras,
    FoVPerspectiveCameras,
    HardDepthShader,
    HardFlatShader,
    HardGouraudShader,
    HardPhongShader,
    MeshRasterizer,
    MeshRenderer,
    PointLights,
    RasterizationSettings,
    SoftPhongShader,
    SoftSilhouetteShader,
    SplatterPhongShader,
    TexturesAtlas,
    TexturesVertex,
    look_at_view_transform,
)
from rendra.structures import Meshes, join_meshes_as_scene
from rendra.utils import ico_sphere, torus
from rendra_lab.data.meshes import make_cube
from rendra_lab.synthesis.cow import make_cow

SIDE = 128
BACKGROUND = (0.86, 0.9, 0.95)
EDGE = 1e-4  # sigma, squared NDC
REACH = math.log(1 / 1e-4 - 1) * EDGE  # where the sigmoid of an edge has fallen to 1e-4
LAMP = PointLights(location=((2.0, 3.0, -2.0),))


@cache
def cow() -> Meshes:
    return make_cow(texture_size=128, num_faces=2000)


def painted(mesh: Meshes) -> Meshes:
    """With colours at the vertices that follow the position."""
    verts = mesh.verts_packed()
    low, high = verts.amin(0), verts.amax(0)
    mesh.textures = TexturesVertex([0.15 + 0.8 * (verts - low) / (high - low)])
    return mesh


@cache
def sphere() -> Meshes:
    return painted(ico_sphere(3))


@cache
def ring() -> Meshes:
    return painted(torus(0.4, 1.0, 24, 48))


def tiled_cube() -> Meshes:
    """A cube with a disc on each side, painted onto 12 x 12 texels a triangle."""
    cube = make_cube()
    y, x = torch.meshgrid(torch.linspace(-1, 1, 64), torch.linspace(-1, 1, 64), indexing="ij")
    disc = (x**2 + y**2 < 0.6).float()
    image = torch.stack([(x + 1) / 2, disc, (1 - y) / 2], dim=-1)  # red grows with u, blue with v
    corners = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    faces_uvs = corners[cube.faces_packed() % 4]
    cube.textures = TexturesAtlas(atlas=[make_material_atlas(image, faces_uvs, 12)])
    return cube


def camera(dist: float, elev: float, azim: float, fov: float = 40.0, **kwargs: Any) -> FoVPerspectiveCameras:
    R, T = look_at_view_transform(dist, elev, azim)
    return FoVPerspectiveCameras(R=R, T=T, fov=fov, **kwargs)


def draw(mesh: Meshes, cameras: Any, shader: torch.nn.Module, **settings: Any) -> Tensor:
    settings = {"image_size": SIDE, **settings}
    renderer = MeshRenderer(MeshRasterizer(cameras, RasterizationSettings(**settings)), shader)
    return renderer(mesh, cameras=cameras)[0]


def blend(sigma: float = EDGE) -> BlendParams:
    return BlendParams(sigma=sigma, gamma=1e-4, background_color=BACKGROUND)


def hard(mesh: Meshes, cameras: Any, lights: Any = LAMP, shader: Any = HardPhongShader, **settings: Any) -> Tensor:
    return draw(mesh, cameras, shader(lights=lights, blend_params=blend()), **settings)[..., :3].clamp(0, 1)


THREE_QUARTER = camera(2.5, 18, 150)


def soft_cow() -> Tensor:
    shader = SoftPhongShader(lights=LAMP, blend_params=blend())
    return draw(cow(), THREE_QUARTER, shader, blur_radius=REACH, faces_per_pixel=50)[..., :3].clamp(0, 1)


def splatted_cow() -> Tensor:
    shader = SplatterPhongShader(lights=LAMP, blend_params=blend(0.5))
    return draw(cow(), THREE_QUARTER, shader, faces_per_pixel=2)[..., :3].clamp(0, 1)


def silhouette() -> Tensor:
    return draw(cow(), THREE_QUARTER, SoftSilhouetteShader(blend()), blur_radius=REACH)[..., 3]


def depth() -> Tensor:
    """Two units away in white, 5 and farther in black."""
    seen = draw(ring(), camera(3.6, 40, 30, fov=50.0), HardDepthShader())
    return ((5 - seen[..., 0]) / 3).clamp(0, 1)


def intersecting() -> Tensor:
    """A sphere through a ring: each hides a part of the other."""
    ball = ico_sphere(3).scale_verts(0.62).offset_verts(torch.tensor([0.75, 0.1, 0.0]))
    return hard(join_meshes_as_scene([painted(ring().clone()), painted(ball)]), camera(4.4, 45, 20))


def orthographic() -> Tensor:
    R, T = look_at_view_transform(3.0, 30, 40)
    return hard(tiled_cube(), FoVOrthographicCameras(R=R, T=T, max_x=1.8, min_x=-1.8, max_y=1.8, min_y=-1.8))


PICTURES: dict[str, Callable[[], Tensor]] = {
    "cow_hard_phong": lambda: hard(cow(), THREE_QUARTER),
    "cow_soft_phong": soft_cow,
    "cow_silhouette": silhouette,
    "cow_splatter": splatted_cow,
    "cow_wide": lambda: hard(cow(), camera(2.6, 10, 120), image_size=(96, 160)),
    "sphere_point_light": lambda: hard(sphere(), camera(3.3, 20, 30), PointLights(location=((2.0, 2.0, 2.0),))),
    "sphere_directional_light": lambda: hard(
        sphere(), camera(3.3, 20, 30), DirectionalLights(direction=((-1.0, 1.0, 0.6),))
    ),
    "sphere_ambient_light": lambda: hard(sphere(), camera(3.3, 20, 30), AmbientLights()),
    "sphere_flat": lambda: hard(painted(ico_sphere(1)), camera(3.3, 20, 30), shader=HardFlatShader),
    "sphere_gouraud": lambda: hard(painted(ico_sphere(1)), camera(3.3, 20, 30), shader=HardGouraudShader),
    "ring_depth": depth,
    # faces are cut at half of znear, and one looks into the tube
    "ring_close_up": lambda: hard(ring(), camera(1.7, 15, 60, fov=75.0, znear=1.4)),
    "ring_and_sphere": intersecting,
    "cube_orthographic": orthographic,
}


@pytest.mark.parametrize("name", PICTURES)
def test_golden(name: str, request: pytest.FixtureRequest) -> None:
    # the cow's own vertices may differ by a few roundings between machines, which moves its outline a little
    allowance = 20 if name.startswith("cow") else 6
    check_image(name, PICTURES[name](), allowance, update=request.config.getoption("--update-golden"))


def test_a_golden_image_notices_what_it_should(tmp_path: Path) -> None:
    image = torch.rand(8, 9, 3) * 0.5
    check_image("noise", image, 0, update=True, folder=tmp_path)
    check_image("noise", image + 1.9 / 255, 0, folder=tmp_path)
    changed = image.clone()
    changed[2, 3, 1] += 4 / 255
    check_image("noise", changed, 1, folder=tmp_path)
    with pytest.raises(AssertionError, match=r"1 pixels of noise deviate, 0 may; the first at .* \[2, 3\]"):
        check_image("noise", changed, 0, folder=tmp_path)
    with pytest.raises(AssertionError, match="the golden image"):
        check_image("noise", image[:4], 0, folder=tmp_path)
    with pytest.raises(AssertionError, match="make golden"):
        check_image("unknown", image, 0, folder=tmp_path)
