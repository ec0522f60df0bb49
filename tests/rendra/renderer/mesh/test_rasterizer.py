"""From world to fragments: the published anchor, settings that follow the camera, and errors."""

import pytest
import torch
from assertions import assert_close

from rendra.renderer.cameras import (
    FoVOrthographicCameras,
    FoVPerspectiveCameras,
    OrthographicCameras,
    PerspectiveCameras,
    look_at_view_transform,
)
from rendra.renderer.mesh.rasterize_meshes import rasterize_meshes, rasterize_silhouette
from rendra.renderer.mesh.rasterizer import Fragments, MeshRasterizer, RasterizationSettings
from rendra.structures.meshes import Meshes
from rendra.utils.ico_sphere import ico_sphere


def one_face(*corners: tuple[float, float, float]) -> Meshes:
    return Meshes([torch.tensor(corners)], [torch.tensor([[0, 1, 2]])])


def test_anchor_of_rasterisation() -> None:
    meshes = one_face((0.9, 0.9, 1.0), (0.5, 0.9, 2.0), (0.9, 0.5, 3.0))
    pix_to_face, zbuf, bary, dists = rasterize_meshes(meshes, (4, 8), faces_per_pixel=1, perspective_correct=True)
    assert (pix_to_face >= 0).nonzero().tolist() == [[0, 0, 2, 0]]
    assert_close(bary[0, 0, 2, 0], [0.4444, 0.3333, 0.2222], atol=1e-4)
    assert_close(zbuf[0, 0, 2, 0], 1.7778, atol=1e-4)
    assert_close(dists[0, 0, 2, 0], -0.0050, atol=1e-4)


def test_bin_sizes_change_nothing() -> None:
    meshes = ico_sphere(2).offset_verts(torch.tensor([0.0, 0.0, 3.0]))
    plain = rasterize_meshes(meshes, 32)
    for a, b in zip(plain, rasterize_meshes(meshes, 32, bin_size=8, max_faces_per_bin=1), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("image_size", [(0, 4), -3, (4, 4, 4), (4.0, 4)])
def test_image_sizes_are_checked(image_size) -> None:
    meshes = one_face((0, 0, 1), (1, 0, 1), (0, 1, 1))
    with pytest.raises(ValueError, match=r"[Ii]mage size"):
        rasterize_meshes(meshes, image_size)
    with pytest.raises(ValueError, match=r"[Ii]mage size"):
        rasterize_silhouette(meshes, image_size)


CAMERAS = [FoVPerspectiveCameras, FoVOrthographicCameras, PerspectiveCameras, OrthographicCameras]


@pytest.mark.parametrize("camera_class", CAMERAS)
def test_transform_gives_ndc_and_view_depth(camera_class) -> None:
    R, T = look_at_view_transform(3.0, 20.0, torch.tensor([10.0, 50.0]))
    cameras = camera_class(R=R, T=T)
    meshes = ico_sphere(1).extend(2)
    ndc = MeshRasterizer(cameras).transform(meshes)
    assert_close(ndc.verts_padded()[..., :2], cameras.transform_points_ndc(meshes.verts_padded())[..., :2])
    view = cameras.get_world_to_view_transform().transform_points(meshes.verts_padded())
    assert_close(ndc.verts_padded()[..., 2], view[..., 2])


def test_screen_cameras_become_ndc() -> None:
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    screen = PerspectiveCameras(
        focal_length=300.0,
        principal_point=((100.0, 60.0),),
        in_ndc=False,
        image_size=((128, 256),),
        R=R,
        T=T,
    )
    meshes = ico_sphere(1)
    ndc = MeshRasterizer(screen).transform(meshes).verts_padded()
    assert_close(ndc[..., :2], screen.transform_points_ndc(meshes.verts_padded())[..., :2])


def test_the_nearest_surface_of_a_sphere_is_seen() -> None:
    """Camera at distance 3 looks at its middle: depth in the middle is 2, and NDC radius s / sqrt(d^2 - 1)."""
    R, T = look_at_view_transform(3.0, 11.0, 17.0)  # no vertex or edge in the middle pixel
    rasterizer = MeshRasterizer(FoVPerspectiveCameras(R=R, T=T), RasterizationSettings(image_size=101))
    fragments = rasterizer(ico_sphere(4))
    assert_close(fragments.zbuf[0, 50, 50, 0], 2.0, atol=2e-3)
    covered = (fragments.pix_to_face[..., 0] >= 0).float().mean() * 4
    radius = 3**0.5 / 8**0.5
    assert_close(covered, torch.pi * radius**2, rtol=0.01, atol=0)


def test_open_settings_follow_the_camera() -> None:
    seen = MeshRasterizer(FoVPerspectiveCameras(znear=torch.tensor([2.0, 0.4])))
    arguments = seen._shared_arguments(seen.raster_settings, {})
    assert arguments["verts_divided_by_depth"] is True
    assert arguments["z_clip_value"] == pytest.approx(0.2)
    flat = MeshRasterizer(FoVOrthographicCameras())
    arguments = flat._shared_arguments(flat.raster_settings, {})
    assert arguments["verts_divided_by_depth"] is False
    assert arguments["z_clip_value"] is None
    plain = MeshRasterizer(PerspectiveCameras())
    assert plain._shared_arguments(plain.raster_settings, {})["z_clip_value"] is None
    settings = RasterizationSettings(z_clip_value=0.7)
    assert seen._shared_arguments(settings, {})["z_clip_value"] == 0.7


def test_faces_are_cut_in_space_whatever_the_interpolation() -> None:
    """A floor that runs under the camera ends at the horizon, also where depth is interpolated on the image."""
    corners = [(-20.0, -1.0, -20.0), (20.0, -1.0, -20.0), (20.0, -1.0, 20.0), (-20.0, -1.0, 20.0)]
    floor = Meshes([torch.tensor(corners)], [torch.tensor([[0, 1, 2], [0, 2, 3]])])
    for perspective_correct in (True, False):
        settings = RasterizationSettings(16, perspective_correct=perspective_correct)
        seen = MeshRasterizer(FoVPerspectiveCameras(), settings)(floor).pix_to_face[0, ..., 0] >= 0
        assert not seen[:8].any()
        assert seen[9:].all()


@pytest.mark.parametrize(("blur", "clip", "outside"), [(0.05, None, False), (0.05, False, True), (0.0, True, False)])
def test_barycentrics_are_clipped_where_blur_asks(blur: float, clip: bool | None, outside: bool) -> None:
    settings = RasterizationSettings(32, blur, 2, clip_barycentric_coords=clip)
    cameras = FoVOrthographicCameras(T=torch.tensor([[0.0, 0.0, 2.0]]))
    fragments = MeshRasterizer(cameras, settings)(one_face((-0.5, -0.5, 0), (0.5, -0.5, 0), (0, 0.5, 0)))
    filled = fragments.pix_to_face >= 0
    assert bool((fragments.bary_coords[filled] < -1e-6).any()) is outside


def test_calls_may_replace_cameras_settings_and_pose() -> None:
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    meshes, settings = ico_sphere(1), RasterizationSettings(16)
    expected = MeshRasterizer(FoVPerspectiveCameras(R=R, T=T), settings)(meshes)
    by_call = MeshRasterizer()(meshes, cameras=FoVPerspectiveCameras(R=R, T=T), raster_settings=settings)
    by_pose = MeshRasterizer(FoVPerspectiveCameras(), settings)(meshes, R=R, T=T)
    for other in (by_call, by_pose):
        assert torch.equal(other.pix_to_face, expected.pix_to_face)
        assert_close(other.zbuf, expected.zbuf)


def test_cameras_are_demanded_and_counted() -> None:
    with pytest.raises(ValueError, match=r"Cameras must be specified .* MeshRasterizer"):
        MeshRasterizer()(ico_sphere(0))
    R, T = look_at_view_transform(3.0, 20.0, torch.tensor([10.0, 20.0, 30.0]))
    with pytest.raises(ValueError, match=r"Wrong number \(3\) of cameras for 2 meshes"):
        MeshRasterizer(FoVPerspectiveCameras(R=R, T=T))(ico_sphere(0).extend(2))


def test_one_camera_serves_a_batch_of_unequal_meshes() -> None:
    R, T = look_at_view_transform(3.0, 20.0, 10.0)
    rasterizer = MeshRasterizer(FoVPerspectiveCameras(R=R, T=T), RasterizationSettings((12, 20)))
    verts, faces = ico_sphere(1).get_mesh_verts_faces(0)
    small_verts, small_faces = ico_sphere(0).get_mesh_verts_faces(0)
    nothing = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)
    batch = rasterizer(Meshes([verts, nothing[0], small_verts], [faces, nothing[1], small_faces]))
    alone = rasterizer(ico_sphere(0))
    assert batch.pix_to_face.shape == (3, 12, 20, 1)
    assert (batch.pix_to_face[1] == -1).all()
    assert_close(batch.zbuf[2], alone.zbuf[0])
    filled = alone.pix_to_face[0] >= 0
    assert torch.equal(batch.pix_to_face[2][filled] - len(faces), alone.pix_to_face[0][filled])


def test_detached_fragments_have_no_history() -> None:
    z = torch.rand(1, 2, 2, 1, requires_grad=True)
    fragments = Fragments(torch.zeros(1, 2, 2, 1, dtype=torch.long), z * 2, torch.stack([z] * 3, -1), z + 1)
    for tensor in (fragments.detach().zbuf, fragments.detach().bary_coords, fragments.detach().dists):
        assert not tensor.requires_grad


def test_moving_moves_the_cameras() -> None:
    rasterizer = MeshRasterizer(FoVPerspectiveCameras())
    assert rasterizer.to("cpu") is rasterizer
    assert rasterizer.cameras.device == torch.device("cpu")
    assert MeshRasterizer().to("cpu").cameras is None
