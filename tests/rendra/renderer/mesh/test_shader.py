"""Shaders and renderers: a sphere has closed forms; batches, limits, overrides and errors have laws."""

from typing import Any

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.renderer.blending import BlendParams, hard_rgb_blend, softmax_rgb_blend
from rendra.renderer.cameras import FoVOrthographicCameras, FoVPerspectiveCameras, look_at_view_transform
from rendra.renderer.lighting import AmbientLights, DirectionalLights, PointLights
from rendra.renderer.materials import Materials
from rendra.renderer.mesh.rasterizer import Fragments, MeshRasterizer, RasterizationSettings
from rendra.renderer.mesh.renderer import MeshRenderer, MeshRendererWithFragments
from rendra.renderer.mesh.shader import (
    HardDepthShader,
    HardFlatShader,
    HardGouraudShader,
    HardPhongShader,
    ShaderBase,
    SoftDepthShader,
    SoftGouraudShader,
    SoftPhongShader,
    SoftSilhouetteShader,
    SplatterPhongShader,
)
from rendra.renderer.mesh.shading import flat_shading, gouraud_shading, phong_shading
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesVertex
from rendra.structures.meshes import Meshes
from rendra.utils.ico_sphere import ico_sphere
from rendra.utils.torus import torus

HARD = [HardPhongShader, HardGouraudShader, HardFlatShader]
SOFT = [SoftPhongShader, SoftGouraudShader]
RGBA = [*HARD, *SOFT, SplatterPhongShader]


def painted(meshes: Meshes, color: tuple[float, ...] | None = None) -> Meshes:
    """Vertices of one colour, or each of its own."""
    painted = meshes.clone()
    features = [
        torch.rand_like(verts) if color is None else verts.new_tensor(color).expand(len(verts), -1)
        for verts in meshes.verts_list()
    ]
    painted.textures = TexturesVertex(features)
    return painted


def view(*azimuths: float, distance: float = 3.0) -> FoVPerspectiveCameras:
    R, T = look_at_view_transform(distance, 20.0, torch.tensor(azimuths or (10.0,)))
    return FoVPerspectiveCameras(R=R, T=T)


def renderer_of(shader: type, cameras: Any = None, size: Any = 24, **settings: Any) -> MeshRenderer:
    parts = {} if shader is SoftSilhouetteShader else {"cameras": cameras}
    rasterizer = MeshRasterizer(cameras, RasterizationSettings(size, **settings))
    return MeshRenderer(rasterizer, shader(**parts))


def sphere_points(cameras: FoVOrthographicCameras, size: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Points (H, W, 3) of the unit sphere that an orthographic camera sees, in the world, and which pixels."""
    axis = 1 - (2 * torch.arange(size) + 1) / size
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    inside = x**2 + y**2 < 0.9
    z = -(1 - x**2 - y**2).clamp(min=0).sqrt()
    seen = torch.stack((x, y, z), -1).view(1, -1, 3)
    center = cameras.get_world_to_view_transform().transform_points(torch.zeros(1, 1, 3))
    points = (
        cameras.get_world_to_view_transform().inverse().transform_points(seen + center * torch.tensor([0, 0, 1.0]))
    )
    return points.view(size, size, 3), inside


@pytest.mark.parametrize("shader", [HardPhongShader, HardGouraudShader, HardFlatShader])
@pytest.mark.parametrize("point", [True, False])
def test_a_lit_sphere_has_phongs_colours(shader: type, point: bool) -> None:
    """On the unit sphere the normal is the point itself: the whole image has a closed form."""
    R, T = look_at_view_transform(4.0, 25.0, 33.0)
    cameras = FoVOrthographicCameras(R=R, T=T)
    place = torch.tensor([[2.0, 3.0, 2.5]])
    lights = PointLights(location=place) if point else DirectionalLights(direction=place)
    materials = Materials(shininess=4.0, diffuse_color=((0.9, 0.5, 0.7),))
    color = (0.2, 0.9, 0.4)
    image = renderer_of(shader, cameras, 32)(painted(ico_sphere(4), color), lights=lights, materials=materials)
    points, inside = sphere_points(cameras, 32)
    normals = points
    to_light = torch.nn.functional.normalize(place - points if point else place.expand_as(points), dim=-1)
    to_camera = torch.nn.functional.normalize(cameras.get_camera_center() - points, dim=-1)
    cosine = (normals * to_light).sum(-1, keepdim=True)
    mirrored = 2 * cosine * normals - to_light
    highlight = (to_camera * mirrored).sum(-1, keepdim=True).clamp(min=0) ** 4 * (cosine > 0)
    diffuse = 0.3 * materials.diffuse_color * cosine.clamp(min=0)
    expected = (0.5 + diffuse) * torch.tensor(color) + 0.2 * highlight
    error = (image[0, ..., :3] - expected)[inside].abs()
    assert error.max() < (0.02 if shader is HardFlatShader else 0.008)
    assert (image[0, ..., 3][inside] == 1).all()


@pytest.mark.parametrize("shader", RGBA)
def test_ambient_light_shows_the_texture(shader: type) -> None:
    image = renderer_of(shader, view())(painted(ico_sphere(2), (0.2, 0.5, 0.7)), lights=AmbientLights())
    assert_close(image[0, 12, 12], [0.2, 0.5, 0.7, 1.0], atol=1e-4)
    assert_close(image[0, 0, 0], [1.0, 1.0, 1.0, 0.0])


def test_features_of_any_width_are_rendered_under_ambient_light() -> None:
    renderer = renderer_of(HardPhongShader, view())
    image = renderer(
        painted(ico_sphere(2), (0.1, 0.2, 0.3, 0.4, 0.5)),
        lights=AmbientLights(ambient_color=torch.ones(1, 5)),
        blend_params=BlendParams(background_color=(0.0,) * 5),
    )
    assert_close(image[0, 12, 12], [0.1, 0.2, 0.3, 0.4, 0.5, 1.0], atol=1e-6)


@pytest.mark.parametrize(
    ("soft", "hard"), [(SoftPhongShader, HardPhongShader), (SoftGouraudShader, HardGouraudShader)]
)
def test_hard_images_are_the_limit_of_soft_ones(soft: type, hard: type) -> None:
    meshes, cameras = painted(torus(0.4, 1.0, 12, 24)), view(40.0)
    params = BlendParams(sigma=1e-9, gamma=1e-7)
    near_limit = renderer_of(soft, cameras, faces_per_pixel=6)(meshes, blend_params=params)
    assert_close(near_limit, renderer_of(hard, cameras)(meshes), atol=1e-4)


def test_flat_faces_have_one_colour_each() -> None:
    meshes, cameras = painted(ico_sphere(1), (1.0, 1.0, 1.0)), view()
    rasterizer = MeshRasterizer(cameras, RasterizationSettings(32))
    image, fragments = MeshRendererWithFragments(rasterizer, HardFlatShader(cameras=cameras))(meshes)
    for face in fragments.pix_to_face.unique()[1:]:
        colors = image[fragments.pix_to_face[..., 0] == face]
        assert_close(colors, colors[:1].expand_as(colors), atol=1e-6)


@pytest.mark.parametrize("shading", [phong_shading, flat_shading, gouraud_shading])
def test_public_shading_is_dense_and_zero_where_empty(shading) -> None:
    meshes, cameras = painted(ico_sphere(1).extend(2)), view(10.0, 50.0)
    fragments = MeshRasterizer(cameras, RasterizationSettings((12, 17), 1e-2, 4))(meshes)
    texels = {} if shading is gouraud_shading else {"texels": meshes.sample_textures(fragments)}
    colors = shading(meshes, fragments, PointLights(), cameras, Materials(), **texels)
    assert colors.shape == (2, 12, 17, 4, 3)
    empty = fragments.pix_to_face < 0
    assert not colors[empty].any()
    assert (colors[~empty] > 0).all()


@pytest.mark.parametrize("soft", [True, False])
def test_shaders_agree_with_the_public_functions_on_dense_fragments(soft: bool) -> None:
    meshes, cameras = painted(ico_sphere(2).extend(2)), view(10.0, 50.0)
    fragments = MeshRasterizer(cameras, RasterizationSettings((20, 13), 3e-3, 9))(meshes)
    params = BlendParams(1e-3, 1e-2, (0.1, 0.2, 0.3))
    colors = phong_shading(meshes, fragments, PointLights(), cameras, Materials(), meshes.sample_textures(fragments))
    if soft:
        expected = softmax_rgb_blend(colors, fragments, params, cameras.znear, cameras.zfar)
        image = SoftPhongShader(cameras=cameras, blend_params=params)(fragments, meshes)
    else:
        expected = hard_rgb_blend(colors, fragments, params)
        image = HardPhongShader(cameras=cameras, blend_params=params)(fragments, meshes)
    assert_close(image, expected, atol=1e-6)


@pytest.mark.parametrize("shader", [*RGBA, HardDepthShader, SoftDepthShader, SoftSilhouetteShader])
@pytest.mark.parametrize("blur", [0.0, 1e-2])
def test_a_batch_is_each_mesh_by_itself(shader: type, blur: float) -> None:
    """Meshes of different sizes, one of them empty, each with its own camera, light and material."""
    sphere, ring = painted(ico_sphere(1)), painted(torus(0.3, 0.8, 6, 9))
    none, no_faces = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)
    parts = [
        (mesh.verts_packed(), mesh.faces_packed(), mesh.textures.verts_features_packed()) for mesh in (sphere, ring)
    ]
    parts.insert(1, (none, no_faces, none))
    verts, faces, features = (list(part) for part in zip(*parts, strict=True))
    batch = Meshes(verts, faces, TexturesVertex(features))
    cameras, shininess = view(10.0, 50.0, 120.0), torch.tensor([3.0, 9.0, 27.0])
    place = torch.tensor([[0.0, 2, 3], [3, 0, 2], [-2, 2, 2]])
    scene = {"lights": PointLights(location=place), "materials": Materials(shininess=shininess)}
    image = renderer_of(shader, None, (14, 19), blur_radius=blur, faces_per_pixel=5)(batch, cameras=cameras, **scene)
    for i in range(3):
        alone = renderer_of(shader, None, (14, 19), blur_radius=blur, faces_per_pixel=5)(
            Meshes(verts[i : i + 1], faces[i : i + 1], TexturesVertex(features[i : i + 1])),
            cameras=cameras[i],
            lights=PointLights(location=place[i : i + 1]),
            materials=Materials(shininess=shininess[i : i + 1]),
        )
        assert_close(image[i], alone[0], atol=2e-6)


@pytest.mark.parametrize("shader", [*RGBA, SoftDepthShader, SoftSilhouetteShader])
def test_gradients_reach_vertices_colours_and_lights(shader: type) -> None:
    verts, faces = ico_sphere(1).get_mesh_verts_faces(0)
    verts = verts.clone().requires_grad_()
    features = torch.rand_like(verts).requires_grad_()
    place = torch.tensor([[2.0, 3.0, 2.0]], requires_grad=True)
    meshes = Meshes([verts], [faces], TexturesVertex([features]))
    kwargs = {} if shader is SoftSilhouetteShader else {"lights": PointLights(location=place)}
    blur = 0.0 if shader is SplatterPhongShader else 1e-3
    image = renderer_of(shader, view(), blur_radius=blur, faces_per_pixel=6)(meshes, **kwargs)
    (image[..., -1:] if shader is SoftSilhouetteShader else image.square()).sum().backward()
    assert_finite(verts.grad)
    assert verts.grad.abs().sum() > 0
    if shader in RGBA:
        for leaf in (features, place):
            assert_finite(leaf.grad)
            assert leaf.grad.abs().sum() > 0


@pytest.mark.parametrize("shader", [HardPhongShader, SoftPhongShader, HardFlatShader])
def test_gradients_to_colours_and_light_by_finite_differences(shader: type) -> None:
    """With visibility fixed, colours depend smoothly on all but the silhouette."""
    verts, faces = (t.double() if t.is_floating_point() else t for t in ico_sphere(0).get_mesh_verts_faces(0))
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    cameras = FoVPerspectiveCameras(R=R.double(), T=T.double())
    fragments = MeshRasterizer(cameras, RasterizationSettings((4, 5), 1e-2, 3))(Meshes([verts], [faces])).detach()

    def render(points: torch.Tensor, features: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
        meshes = Meshes([points], [faces], TexturesVertex([features]))
        lights, materials = PointLights(location=place), Materials(shininess=3.0)
        params = BlendParams(1e-2, 1e-1)
        return shader(cameras=cameras, lights=lights, materials=materials, blend_params=params)(fragments, meshes)

    place = torch.tensor([[2.0, 3.0, 2.0]], dtype=torch.float64, requires_grad=True)
    inputs = (verts.clone().requires_grad_(), torch.rand_like(verts).requires_grad_(), place)
    assert torch.autograd.gradcheck(render, inputs, rtol=1e-3, atol=1e-5, fast_mode=True)


@pytest.mark.parametrize("shader", RGBA)
def test_nothing_to_see(shader: type) -> None:
    away = painted(ico_sphere(1)).offset_verts(torch.tensor([0.0, 0.0, 50.0]))
    image = renderer_of(shader, view(), (5, 7), faces_per_pixel=2)(away)
    assert_close(image, torch.tensor([1.0, 1.0, 1.0, 0.0]).expand(1, 5, 7, 4))


def test_calls_override_every_part() -> None:
    meshes, cameras = painted(ico_sphere(2), (1.0, 1.0, 1.0)), view()
    renderer = renderer_of(HardPhongShader, cameras)
    plain = renderer(meshes)
    dark = PointLights(ambient_color=((0.0,) * 3,), diffuse_color=((0.0,) * 3,), specular_color=((0.0,) * 3,))
    assert not renderer(meshes, lights=dark)[0, 12, 12, :3].any()
    black = Materials(ambient_color=((0.0,) * 3,), diffuse_color=((0.0,) * 3,), specular_color=((0.0,) * 3,))
    assert not renderer(meshes, materials=black)[0, 12, 12, :3].any()
    params = BlendParams(background_color=(0.1, 0.2, 0.3))
    assert_close(renderer(meshes, blend_params=params)[0, 0, 0], [0.1, 0.2, 0.3, 0.0])
    other = view(200.0)
    turned = renderer(meshes, cameras=other)
    assert not torch.equal(turned, plain)
    assert_close(renderer_of(HardPhongShader, FoVPerspectiveCameras())(meshes, R=other.R, T=other.T), turned)


def test_the_highlight_follows_a_pose_given_by_call() -> None:
    """Rasterizer and shader may hold different cameras; R and T of a call move both."""
    target = view(100.0)
    meshes = painted(ico_sphere(3), (0.0, 0.0, 0.0))
    lights = DirectionalLights(direction=target.get_camera_center())
    rasterizer = MeshRasterizer(FoVPerspectiveCameras(), RasterizationSettings(24))
    renderer = MeshRenderer(rasterizer, HardPhongShader(cameras=FoVPerspectiveCameras(), lights=lights))
    image = renderer(meshes, R=target.R, T=target.T, materials=Materials(shininess=1.0))
    assert_close(image[0, 12, 12, :3], [0.2] * 3, atol=0.01)


@pytest.mark.parametrize("shader", [*RGBA, HardDepthShader, SoftDepthShader])
def test_cameras_are_demanded(shader: type) -> None:
    meshes = painted(ico_sphere(0))
    fragments = MeshRasterizer(view(), RasterizationSettings(4))(meshes)
    with pytest.raises(ValueError, match=rf"Cameras must be specified .* {shader.__name__}"):
        shader()(fragments, meshes)


def test_textures_are_demanded() -> None:
    with pytest.raises(ValueError, match="textures"):
        renderer_of(HardPhongShader, view())(ico_sphere(0))
    meshes = ico_sphere(0)
    meshes.textures = TexturesAtlas(torch.rand(1, 20, 2, 2, 3))
    assert renderer_of(HardPhongShader, view())(meshes).shape == (1, 24, 24, 4)
    with pytest.raises(ValueError, match="TexturesVertex"):
        renderer_of(HardGouraudShader, view())(meshes)


def test_depth_of_a_sphere() -> None:
    R, T = look_at_view_transform(4.0, 25.0, 33.0)
    cameras = FoVOrthographicCameras(R=R, T=T, zfar=20.0)
    points, inside = sphere_points(cameras, 32)
    depth = cameras.get_world_to_view_transform().transform_points(points.view(1, -1, 3))[..., 2].view(32, 32)
    hard = renderer_of(HardDepthShader, cameras, 32)(ico_sphere(4))
    assert hard.shape == (1, 32, 32, 1)
    assert_close(hard[0, ..., 0][inside], depth[inside], atol=4e-3)
    assert_close(hard[0, 0, 0], [20.0])
    soft = renderer_of(SoftDepthShader, cameras, 32, faces_per_pixel=2)(ico_sphere(4))
    inner = inside & (hard[0, ..., 0] < 3.5)
    assert_close(soft[0, ..., 0][inner], depth[inner], atol=2e-2)
    assert_close(soft[0, 0, 0], [20.0])
    assert_close(renderer_of(HardDepthShader, cameras, 8)(ico_sphere(1), zfar=7.0)[0, 0, 0], [7.0])


@pytest.mark.parametrize("sigma", [1e-4, 1e-3])
@pytest.mark.parametrize("cameras", [view(10.0, 70.0), FoVOrthographicCameras(T=torch.tensor([[0.0, 0, 3]]))])
def test_fused_silhouette_is_that_of_all_fragments(sigma: float, cameras: Any) -> None:
    meshes = torus(0.4, 0.8, 8, 12).extend(2)
    blend_params = BlendParams(sigma=sigma)
    settings = RasterizationSettings((24, 31), 9.21 * sigma, 150)
    rasterizer, shader = MeshRasterizer(cameras, settings), SoftSilhouetteShader(blend_params)
    stored, fragments = MeshRendererWithFragments(rasterizer, shader)(meshes)
    assert (fragments.pix_to_face[..., -1] < 0).all()  # 150 layers hold every face
    fused = MeshRenderer(rasterizer, shader)(meshes)
    assert_close(fused, stored, atol=2e-5)
    assert (fused[..., :3] == 1).all()


def test_fused_silhouette_has_the_gradient_of_all_fragments() -> None:
    cameras, settings = view(30.0), RasterizationSettings(24, 9.21e-3, 150)
    verts, faces = torus(0.4, 0.8, 8, 12).get_mesh_verts_faces(0)
    rasterizer, shader = MeshRasterizer(cameras, settings), SoftSilhouetteShader(BlendParams(sigma=1e-3))
    target = torch.rand(1, 24, 24)
    grads = []
    for render in (MeshRenderer(rasterizer, shader), lambda m: MeshRendererWithFragments(rasterizer, shader)(m)[0]):
        moved = verts.clone().requires_grad_()
        (render(Meshes([moved], [faces]))[..., 3] - target).square().sum().backward()
        grads.append(moved.grad)
    assert_close(grads[0], grads[1], atol=1e-4 * float(grads[1].abs().max()), rtol=1e-3)


class _CountingRasterizer(MeshRasterizer):
    calls = 0

    def forward(self, meshes_world: Meshes, **kwargs: Any) -> Fragments:
        self.calls += 1
        return super().forward(meshes_world, **kwargs)


def test_fragments_are_stored_where_somebody_may_look() -> None:
    settings, shader = RasterizationSettings(8, 1e-3, 8), SoftSilhouetteShader()
    own = _CountingRasterizer(view(), settings)
    MeshRenderer(own, shader)(ico_sphere(0))
    assert own.calls == 1
    unclipped = RasterizationSettings(8, 1e-3, 8, clip_barycentric_coords=False)
    assert not MeshRasterizer(view(), unclipped).silhouette_matches_fragments()
    assert MeshRasterizer(view(), unclipped).silhouette_matches_fragments(raster_settings=settings)


def test_silhouette_takes_overrides() -> None:
    renderer = MeshRenderer(MeshRasterizer(view(), RasterizationSettings(16, 1e-3)), SoftSilhouetteShader())
    sharp, soft = renderer(ico_sphere(1)), renderer(ico_sphere(1), blend_params=BlendParams(sigma=1e-2))
    assert (sharp[..., 3] - soft[..., 3]).abs().max() > 0.1
    assert renderer(ico_sphere(1), raster_settings=RasterizationSettings(9)).shape == (1, 9, 9, 4)


def test_a_splatter_follows_its_input_to_another_device() -> None:
    renderer, sphere = renderer_of(SplatterPhongShader, view()), painted(ico_sphere(0))
    image = renderer(sphere)
    renderer.shader.splatter_blender = renderer.shader.splatter_blender.to("meta")  # as left by a call elsewhere
    assert_close(renderer(sphere), image)


def test_moving_moves_all_parts() -> None:
    renderer = renderer_of(SplatterPhongShader, view())
    renderer(painted(ico_sphere(0)))
    assert renderer.to("cpu") is renderer
    assert isinstance(ShaderBase().to("cpu"), ShaderBase)
    pair = MeshRendererWithFragments(renderer.rasterizer, renderer.shader)
    assert pair.to("cpu") is pair
