"""The whole renderer under inputs that are empty, tiny, far, inverted, mixed or poisoned."""

import math
from typing import Any

import pytest
import torch
from assertions import assert_close, assert_finite
from torch import Tensor

from rendra.renderer import (
    AmbientLights,
    DirectionalLights,
    FoVPerspectiveCameras,
    HardDepthShader,
    HardFlatShader,
    HardGouraudShader,
    HardPhongShader,
    Materials,
    MeshRasterizer,
    MeshRenderer,
    PointLights,
    RasterizationSettings,
    SoftDepthShader,
    SoftGouraudShader,
    SoftPhongShader,
    SoftSilhouetteShader,
    SplatterPhongShader,
    TexturesAtlas,
    TexturesUV,
    TexturesVertex,
    look_at_rotation,
    look_at_view_transform,
)
from rendra.structures import Meshes, join_meshes_as_batch
from rendra.utils import ico_sphere

SHADERS: dict[str, Any] = {
    "hard_phong": HardPhongShader,
    "soft_phong": SoftPhongShader,
    "hard_gouraud": HardGouraudShader,
    "soft_gouraud": SoftGouraudShader,
    "hard_flat": HardFlatShader,
    "splatter_phong": SplatterPhongShader,
    "hard_depth": HardDepthShader,
    "soft_depth": SoftDepthShader,
    "soft_silhouette": SoftSilhouetteShader,
}
LIT = [name for name in SHADERS if "phong" in name or "gouraud" in name or "flat" in name]
every_shader = pytest.mark.parametrize("shader", SHADERS)


def sphere(level: int = 1, dtype: torch.dtype = torch.float32) -> Meshes:
    base = ico_sphere(level)
    colors = torch.rand(1, len(base.verts_packed()), 3, dtype=torch.float64).to(dtype)
    return Meshes(base.verts_padded().to(dtype), base.faces_padded(), TexturesVertex(colors))


def nothing(num_verts: int = 0) -> Meshes:
    verts, faces = torch.rand(num_verts, 3), torch.zeros(0, 3, dtype=torch.int64)
    return Meshes([verts], [faces], TexturesVertex([torch.rand(num_verts, 3)]))


def orbit(n: int = 1, distance: float = 3.0, dtype: torch.dtype = torch.float32) -> FoVPerspectiveCameras:
    R, T = look_at_view_transform(distance, 20.0, torch.arange(n) * 50.0 + 30.0)
    return FoVPerspectiveCameras(R=R.to(dtype), T=T.to(dtype))


def render(shader: str, meshes: Meshes, cameras: Any, size: Any = 24, K: int | None = None, **parts: Any) -> Tensor:
    soft = shader.startswith("soft")
    layers = (1 if shader.startswith("hard") else 6) if K is None else K
    blur = math.log(1 / 1e-4 - 1) * 1e-4 if soft else 0.0
    settings = RasterizationSettings(size, blur, layers)
    made = SoftSilhouetteShader() if shader == "soft_silhouette" else SHADERS[shader](cameras=cameras, **parts)
    return MeshRenderer(MeshRasterizer(cameras, settings), made)(meshes)


@every_shader
@pytest.mark.parametrize("num_verts", [0, 4])
def test_meshes_without_faces_show_the_background(shader: str, num_verts: int) -> None:
    image = render(shader, nothing(num_verts), orbit())
    if "depth" in shader:
        assert (image == 100.0).all()
    else:
        assert (image == torch.tensor([1.0, 1.0, 1.0, 0.0])).all()


@every_shader
@pytest.mark.parametrize("num_cameras", [1, 3])
def test_an_image_does_not_depend_on_its_batch(shader: str, num_cameras: int) -> None:
    meshes = [sphere(2), nothing(), sphere(0)]
    cameras = orbit(num_cameras)
    locations = 3 * torch.rand(3, 3)
    parts: dict[str, Any] = {}
    if shader in LIT:
        parts = {
            "lights": PointLights(location=locations),
            "materials": Materials(shininess=torch.tensor([1.0, 9.0, 0.0])),
        }
    batch = render(shader, join_meshes_as_batch(meshes), cameras, (17, 29), **parts)
    for i, mesh in enumerate(meshes):
        if shader in LIT:
            shininess = parts["materials"].shininess[i : i + 1]
            own = {"lights": PointLights(location=locations[i : i + 1]), "materials": Materials(shininess=shininess)}
        else:
            own = {}
        alone = render(shader, mesh, cameras[i] if num_cameras > 1 else cameras, (17, 29), **own)
        assert_close(alone[0], batch[i])


@every_shader
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1)])
def test_images_of_one_row_column_or_pixel(shader: str, size: tuple[int, int]) -> None:
    image = render(shader, sphere(), orbit(), size)
    assert image.shape[1:3] == size
    assert_finite(image)


@every_shader
def test_double_precision_passes_through(shader: str) -> None:
    torch.manual_seed(1)
    single = render(shader, sphere(2), orbit())
    torch.manual_seed(1)
    double = render(shader, sphere(2, torch.float64), orbit(dtype=torch.float64))
    assert double.dtype == torch.float64
    assert_close(single, double, atol=1e-4)
    mixed = render(shader, sphere(2, torch.float64), orbit())
    assert mixed.dtype == torch.float64


@pytest.mark.parametrize("shader", [name for name in SHADERS if not name.startswith("hard")])
def test_layers_beyond_what_lies_there_change_nothing(shader: str) -> None:
    mesh = sphere(2)
    assert_close(render(shader, mesh, orbit(), K=40), render(shader, mesh, orbit(), K=200))


@pytest.mark.parametrize("shader", LIT)
@pytest.mark.parametrize("lights", [PointLights, DirectionalLights, AmbientLights])
def test_one_camera_sees_many_meshes_in_many_lights(shader: str, lights: Any) -> None:
    meshes = join_meshes_as_batch([sphere(1), sphere(0), sphere(2)])
    ambient = torch.tensor([[0.1] * 3, [0.2] * 3, [0.3] * 3])
    image = render(shader, meshes, orbit(), lights=lights(ambient_color=ambient))
    assert image.shape == (3, 24, 24, 4)
    assert_finite(image)
    with pytest.raises(ValueError, match="Got 2 lights, 1 materials, 1 cameras for 3 meshes"):
        render(shader, meshes, orbit(), lights=lights(ambient_color=ambient[:2]))


@every_shader
def test_a_vertex_that_is_not_a_number_spoils_its_surroundings_only(shader: str) -> None:
    mesh = sphere(3)
    verts, faces = mesh.verts_packed().clone(), mesh.faces_packed()
    verts[3], verts[9, 1] = math.nan, math.inf
    broken = mesh.update_padded(verts[None])
    gone = ((faces == 3) | (faces == 9)).any(1)
    beside = torch.isin(faces, faces[gone]).any(1)  # their normals are means of faces that are gone
    settings = RasterizationSettings(48, 1e-3, 30)
    fragments = MeshRasterizer(orbit(), settings)(broken)
    assert_finite(fragments.zbuf)
    assert_finite(fragments.bary_coords)
    assert not torch.isin(fragments.pix_to_face, gone.nonzero()).any()
    seen = MeshRasterizer(orbit(), settings)(mesh).pix_to_face
    near = torch.isin(seen, beside.nonzero()).any(-1).float()
    near = torch.nn.functional.max_pool2d(near, 3, 1, 1) > 0  # a splat reaches the next pixel
    assert 0.5 < (~near).float().mean() < 1.0
    assert_close(render(shader, broken, orbit(), 48)[~near], render(shader, mesh, orbit(), 48)[~near])


POSITIONS = {
    "in front": ([3.0, 1.0, 2.0], (0.0, 0.0, 0.0)),
    "inside": ([0.1, 0.1, 0.1], (0.0, 0.0, 0.0)),
    "on the surface": ([1.0, 0.3, 0.2], (0.0, 0.0, 0.0)),
    "looking away": ([0.0, 0.0, 3.0], (0.0, 0.0, 6.0)),
    "far": ([1e5, 0.0, 0.0], (0.0, 0.0, 0.0)),
}


def textured(kind: str) -> tuple[Meshes, dict[str, Tensor]]:
    """Two spheres whose vertices and texture require grad."""
    base = ico_sphere(1)
    verts = torch.cat((base.verts_padded(), 0.7 * base.verts_padded())).requires_grad_()
    faces = base.faces_padded().expand(2, -1, -1)
    num_verts, num_faces = verts.shape[1], faces.shape[1]
    if kind == "vertex":
        leaf = torch.rand(2, num_verts, 3).requires_grad_()
        textures: Any = TexturesVertex(leaf)
    elif kind == "uv":
        leaf = torch.rand(2, 8, 8, 3).requires_grad_()
        textures = TexturesUV(leaf, torch.randint(0, num_verts, (2, num_faces, 3)), torch.rand(2, num_verts, 2))
    else:
        leaf = torch.rand(2, num_faces, 3, 3, 3).requires_grad_()
        textures = TexturesAtlas(leaf)
    return Meshes(verts, faces, textures), {"verts": verts, "texture": leaf}


TEXTURED = [(name, kind) for name in SHADERS for kind in ("vertex", "uv", "atlas")]


@pytest.mark.parametrize(("shader", "kind"), [(s, k) for s, k in TEXTURED if k == "vertex" or "gouraud" not in s])
@pytest.mark.parametrize("where", POSITIONS)
def test_gradients_reach_every_part_and_are_finite(shader: str, where: str, kind: str) -> None:
    mesh, leaves = textured(kind)
    eye, at = POSITIONS[where]
    position = torch.tensor([eye, eye]).requires_grad_()
    fov = torch.tensor([60.0, 50.0]).requires_grad_()
    R = look_at_rotation(position, at=(at,))
    cameras = FoVPerspectiveCameras(R=R, T=-(position[:, None] @ R)[:, 0], fov=fov)
    leaves |= {"position": position, "fov": fov}
    parts: dict[str, Any] = {}
    if shader in LIT:
        light = {
            name: torch.rand(2, 3).requires_grad_() for name in ("ambient_color", "diffuse_color", "specular_color")
        }
        light["location"] = torch.tensor([[2.0, 3.0, 2.5], [3.0, 2.0, 2.0]]).requires_grad_()
        surface = {f"{name}_color": torch.rand(2, 3).requires_grad_() for name in ("ambient", "diffuse", "specular")}
        surface["shininess"] = torch.tensor([5.0, 2.0]).requires_grad_()
        parts = {"lights": PointLights(**light), "materials": Materials(**surface)}
        leaves |= light | {f"material_{name}": tensor for name, tensor in surface.items()}
    image = render(shader, mesh, cameras, (12, 16), **parts)
    assert_finite(image)
    if not image.requires_grad:
        assert where == "looking away"
        return
    (image * torch.rand_like(image)).sum().backward()
    for name, leaf in leaves.items():
        if leaf.grad is not None:
            assert torch.isfinite(leaf.grad).all(), name
    if where == "in front":
        unused = {"texture"} if "depth" in shader or "silhouette" in shader else set()
        if (shader, kind) == ("hard_flat", "atlas"):
            unused = {"fov"}  # texels and faces of one colour each: where the pixel lies on them is all the same
        missing = {name for name, leaf in leaves.items() if leaf.grad is None or not leaf.grad.any()}
        assert missing == unused
