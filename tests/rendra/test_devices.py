"""Meshes, cameras, lights and shaders stay on the device of their input, images and gradients too."""

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.renderer import (
    AmbientLights,
    BlendParams,
    DirectionalLights,
    FoVOrthographicCameras,
    FoVPerspectiveCameras,
    HardFlatShader,
    HardPhongShader,
    MeshRasterizer,
    MeshRenderer,
    OrthographicCameras,
    PerspectiveCameras,
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
    look_at_view_transform,
    opencv_from_cameras,
    opengl_from_cameras,
)
from rendra.structures import join_meshes_as_batch, join_meshes_as_scene
from rendra.utils.ico_sphere import ico_sphere


def painted(device, texture="vertex"):
    sphere = ico_sphere(0, device)
    if texture == "vertex":
        sphere.textures = TexturesVertex(sphere.verts_padded().abs())
    elif texture == "atlas":
        sphere.textures = TexturesAtlas(torch.linspace(0, 1, 20 * 12, device=device).view(1, 20, 2, 2, 3))
    else:
        corners = torch.linspace(0, 1, 24, device=device).view(1, 12, 2)
        maps = torch.linspace(0, 1, 48, device=device).view(1, 4, 4, 3)
        sphere.textures = TexturesUV(maps, sphere.faces_padded(), corners)
    return sphere


def picture(
    device, shader, cameras=FoVPerspectiveCameras, lights=PointLights, texture="vertex", blur=0.0, **settings
):
    """An image, and its gradient with respect to a shift of the mesh."""
    R, T = look_at_view_transform(2.7, 10, 20, device=device)
    view = cameras(R=R, T=T, device=device)
    rasterizer = MeshRasterizer(view, RasterizationSettings(8, blur, 3, **settings))
    parts = (
        {} if shader is SoftSilhouetteShader else {"cameras": view, "device": device, "lights": lights(device=device)}
    )
    sigma = 0.5 if shader is SplatterPhongShader else 1e-3
    shift = torch.zeros(3, device=device, requires_grad=True)
    image = MeshRenderer(rasterizer, shader(blend_params=BlendParams(sigma=sigma), **parts))(
        painted(device, texture).offset_verts(shift).extend(2)
    )
    image.square().sum().backward()
    return image.detach(), shift.grad


CASES = [
    {"shader": HardPhongShader},
    {"shader": SoftPhongShader, "blur": 1e-2},
    {"shader": SoftGouraudShader, "blur": 1e-2, "cameras": PerspectiveCameras},
    {"shader": HardFlatShader, "cameras": OrthographicCameras},
    {"shader": SoftDepthShader, "cameras": FoVOrthographicCameras},
    {"shader": SplatterPhongShader},
    {"shader": SoftSilhouetteShader, "blur": 1e-2},
    {"shader": HardPhongShader, "texture": "atlas", "lights": DirectionalLights},
    {"shader": HardPhongShader, "texture": "uv", "lights": AmbientLights},
    {"shader": HardPhongShader, "z_clip_value": 2.5, "cull_to_frustum": True},
]


@pytest.mark.parametrize("case", CASES)
def test_a_picture_is_made_where_the_mesh_lies(far, case) -> None:  # noqa: F811
    image, gradient = picture(far, **case)
    assert isinstance(image, Far)
    expected, slope = picture("cpu", **case)
    assert_close(image.cpu(), expected, atol=1e-4)
    assert_close(gradient.cpu(), slope, atol=1e-2, rtol=1e-3)


@pytest.mark.parametrize("texture", ["vertex", "atlas", "uv"])
def test_meshes_stay_where_they_are(far, texture) -> None:  # noqa: F811
    sphere = painted(far, texture)
    derived = [
        sphere.verts_normals_packed(), sphere.edges_packed(), sphere.num_edges_per_mesh(),
        sphere.get_bounding_boxes(),
        sphere.extend(3)[[0, 2]].verts_padded(), join_meshes_as_batch([sphere, sphere]).faces_packed(),
        join_meshes_as_scene([sphere, sphere]).verts_packed(),
        sphere.submeshes([[torch.tensor([0, 1], device=far)]]).faces_packed(),
    ]  # fmt: skip
    assert all(isinstance(tensor, Far) for tensor in derived)
    assert_close(sphere.cpu().to(far).verts_packed().cpu(), ico_sphere(0).verts_packed())


def test_cameras_stay_where_they_are(far) -> None:  # noqa: F811
    cameras = FoVPerspectiveCameras(device=far)
    points = torch.ones(5, 3, device=far)
    assert isinstance(cameras.transform_points_screen(points, image_size=(10, 20)), Far)
    assert isinstance(cameras.unproject_points(points), Far)
    size = torch.tensor([[10, 20]])  # sizes are numbers: they may come from anywhere
    assert isinstance(opencv_from_cameras(cameras, size).camera_matrix, Far)
    assert isinstance(opengl_from_cameras(cameras, size).camera_to_world, Far)


def test_a_forgotten_device_is_found(far) -> None:  # noqa: F811
    there = torch.ones(3, device=far)
    with pytest.raises(RuntimeError, match="mixes devices"):
        there + torch.ones(3)
    with pytest.raises(TypeError, match="numpy"):
        there.numpy()
