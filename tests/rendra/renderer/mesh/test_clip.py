"""Clipping: areas, windings, barycentrics and images before and after the cut."""

from itertools import pairwise

import pytest
import torch
from assertions import assert_close

from rendra.renderer.mesh.clip import (
    ClipFrustum,
    clip_faces,
    convert_clipped_rasterization_to_original_faces,
)
from rendra.renderer.mesh.rasterize_meshes import rasterize_meshes
from rendra.structures.meshes import Meshes

HALF_WIDTH = 1.07  # of the ground plane; passes through no pixel centre
ONE = torch.tensor([0]), torch.tensor([1])


def view_space(face_verts: torch.Tensor, perspective: bool) -> torch.Tensor:
    """Undo the division by depth."""
    scale = face_verts[..., 2:] if perspective else 1.0
    return torch.cat((face_verts[..., :2] * scale, face_verts[..., 2:]), -1)


def project(points: torch.Tensor, perspective: bool) -> torch.Tensor:
    scale = points[..., 2:] if perspective else 1.0
    return torch.cat((points[..., :2] / scale, points[..., 2:]), -1)


def cross(faces: torch.Tensor) -> torch.Tensor:
    return torch.linalg.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0])


def area_beyond(face: torch.Tensor, z: float) -> float:
    """Area of the part of a triangle with depth above z, by clipping the polygon in plain Python."""
    kept: list[torch.Tensor] = []
    for a, b in zip(face, face.roll(-1, 0), strict=True):
        if a[2] >= z:
            kept.append(a)
        if (a[2] >= z) != (b[2] >= z):
            kept.append(a + (a[2] - z) / (a[2] - b[2]) * (b - a))
    area = torch.zeros(3, dtype=face.dtype)
    for b, c in pairwise(kept[1:]):
        area = area + torch.linalg.cross(b - kept[0], c - kept[0]) / 2
    return float(area.norm())


@pytest.mark.parametrize("perspective", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_pieces_cover_what_lies_beyond_the_plane(perspective: bool, seed: int) -> None:
    torch.manual_seed(seed)
    world = torch.randn(40, 3, 3, dtype=torch.float64)
    z_clip = 0.3
    faces = project(world, perspective)
    counts = torch.tensor([15, 0, 25])
    clipped = clip_faces(
        faces,
        torch.tensor([0, 15, 15]),
        counts,
        ClipFrustum(perspective_correct=perspective, z_clip_value=z_clip, cull=False),
    )
    origin = clipped.faces_clipped_to_unclipped_idx
    assert origin is not None
    pieces = view_space(clipped.face_verts, perspective)
    assert pieces[..., 2].min() >= z_clip - 1e-9
    areas = torch.zeros(40, dtype=torch.float64).index_add(0, origin, cross(pieces).norm(dim=1) / 2)
    assert_close(areas, torch.tensor([area_beyond(face, z_clip) for face in world]), atol=1e-9)
    normals = torch.nn.functional.normalize(cross(world))[origin]
    assert (torch.linalg.vecdot(cross(pieces), normals) > 0).all()  # the winding is kept

    meshes = torch.repeat_interleave(torch.arange(3), counts)[origin]
    assert clipped.num_faces_per_mesh.tolist() == meshes.bincount(minlength=3).tolist()
    ends = clipped.num_faces_per_mesh.cumsum(0)
    assert clipped.mesh_to_face_first_idx.tolist() == (ends - clipped.num_faces_per_mesh).tolist()

    neighbor = clipped.clipped_faces_neighbor_idx
    assert neighbor is not None
    paired = (neighbor >= 0).nonzero()[:, 0]
    assert (neighbor[neighbor[paired]] == paired).all()
    assert (origin[neighbor[paired]] == origin[paired]).all()


def test_corners_are_barycentric_combinations() -> None:
    world = torch.randn(30, 3, 3, dtype=torch.float64)
    clipped = clip_faces(
        project(world, True),
        torch.tensor([0]),
        torch.tensor([30]),
        ClipFrustum(perspective_correct=True, z_clip_value=0.2),
    )
    rows = clipped.faces_clipped_to_conversion_idx
    conversion = clipped.barycentric_conversion
    assert rows is not None
    assert conversion is not None
    assert clipped.faces_clipped_to_unclipped_idx is not None
    assert_close(conversion.sum(-1), torch.ones(conversion.shape[:2]), atol=1e-12)
    assert (conversion > -1e-12).all()
    cut = rows >= 0
    rebuilt = conversion[rows[cut]] @ world[clipped.faces_clipped_to_unclipped_idx[cut]]
    assert_close(rebuilt, view_space(clipped.face_verts[cut], True), atol=1e-9)


def test_gradients_by_finite_differences() -> None:
    world = torch.tensor(
        [
            [[0, 0, 2], [1, 0, -1], [0, 1, 1.5]],
            [[0, 0, 0.1], [1, 0, -1], [0, 1, 1.5]],
            [[0, 0, 2], [1, 0, 1], [0, 1, 3]],
        ],
        dtype=torch.float64,
        requires_grad=True,
    )
    frustum = ClipFrustum(perspective_correct=True, z_clip_value=0.5)

    def cut(points: torch.Tensor) -> torch.Tensor:
        return clip_faces(project(points, True), torch.tensor([0]), torch.tensor([3]), frustum).face_verts

    assert cut(world).shape == (4, 3, 3)
    assert torch.autograd.gradcheck(cut, world)


def test_faces_that_are_not_cut_pass_unchanged() -> None:
    faces = torch.rand(5, 3, 3) + 1
    clipped = clip_faces(faces, torch.tensor([0]), torch.tensor([5]), ClipFrustum(z_clip_value=0.5))
    assert clipped.face_verts is faces
    assert clipped.faces_clipped_to_unclipped_idx is None
    pix_to_face, bary = torch.zeros(1, 1, 1, 1, dtype=torch.long), torch.rand(1, 1, 1, 1, 3)
    same = convert_clipped_rasterization_to_original_faces(pix_to_face, bary, clipped)
    assert same == (pix_to_face, bary)


def test_everything_behind_leaves_nothing() -> None:
    faces = torch.rand(5, 3, 3) - 2
    clipped = clip_faces(faces, torch.tensor([0, 2]), torch.tensor([2, 3]), ClipFrustum(z_clip_value=0.5))
    assert clipped.face_verts.shape == (0, 3, 3)
    assert clipped.num_faces_per_mesh.tolist() == [0, 0]
    pix_to_face = torch.full((2, 3, 3, 1), -1)
    bary = torch.full((2, 3, 3, 1, 3), -1.0)
    faces_of, bary_of = convert_clipped_rasterization_to_original_faces(pix_to_face, bary, clipped)
    assert (faces_of == -1).all()
    assert_close(bary_of, bary)


def test_no_faces() -> None:
    nothing = torch.zeros(0, 3, 3), torch.zeros(2, dtype=torch.long), torch.zeros(2, dtype=torch.long)
    assert clip_faces(*nothing, ClipFrustum(z_clip_value=1.0)).face_verts.shape == (0, 3, 3)


@pytest.mark.parametrize(
    ("shift", "bound"),
    [
        ((3, 0, 0), {"right": 1.0}),
        ((-3, 0, 0), {"left": -1.0}),
        ((0, 3, 0), {"bottom": 1.0}),
        ((0, -3, 0), {"top": -1.0}),
        ((0, 0, 9), {"zfar": 5.0}),
        ((0, 0, -0.8), {"znear": 1.0}),
    ],
)
def test_culling_by_each_bound(shift: tuple[float, ...], bound: dict[str, float]) -> None:
    inside = torch.tensor([[[0.0, 0, 1.5], [0.5, 0, 1.5], [0, 0.5, 1.5]]])
    faces = torch.cat((inside, inside + torch.tensor(shift)))
    clipped = clip_faces(faces, torch.tensor([0]), torch.tensor([2]), ClipFrustum(**bound))
    assert clipped.faces_clipped_to_unclipped_idx is not None
    assert clipped.faces_clipped_to_unclipped_idx.tolist() == [0]
    kept = clip_faces(faces, torch.tensor([0]), torch.tensor([2]), ClipFrustum(**bound, cull=False))
    assert len(kept.face_verts) == 2


def test_faces_that_reach_behind_the_camera_are_not_culled_by_turned_signs() -> None:
    # seen from the camera this face spans the left half of the view; its corner behind has x / z > 0
    face = project(torch.tensor([[[-1.0, -1, 2], [-1, 1, 2], [-1, 0, -2]]]), True) + 0.6
    frustum = ClipFrustum(left=-1.0, right=0.05, perspective_correct=True, z_clip_value=0.1)
    assert len(clip_faces(face, *ONE, frustum).face_verts) == 2


def _ground(near: float, far: float, dtype: torch.dtype = torch.float32) -> Meshes:
    """A ground plane one unit below the camera, from depth `near` to `far`, in NDC of focal length 1."""
    x = HALF_WIDTH
    corners = torch.tensor([[-x, -1, near], [x, -1, near], [x, -1, far], [-x, -1, far]], dtype=dtype)
    return Meshes([project(corners, True)], [torch.tensor([[0, 1, 2], [0, 2, 3]])])


@pytest.mark.parametrize("faces_per_pixel", [1, 3])
def test_a_plane_that_passes_under_the_camera(faces_per_pixel: int) -> None:
    """Depth at every pixel is known: the ray through (x, y) meets the ground at z = -1 / y."""
    size = (20, 32)
    pix_to_face, zbuf, bary, _ = rasterize_meshes(
        _ground(-3.0, 50.0), size, 0.0, faces_per_pixel, perspective_correct=True, z_clip_value=0.5
    )
    rows = 1 - (2 * torch.arange(20) + 1) / 20
    columns = (1 - (2 * torch.arange(32) + 1) / 32) * 1.6
    depth = (-1 / rows)[:, None].expand(20, 32)
    on_ground = (depth > 0.5) & (depth < 50) & ((columns * depth).abs() < HALF_WIDTH)
    filled = pix_to_face[0, ..., 0] >= 0
    assert (filled != on_ground).sum() == 0
    assert_close(zbuf[0, ..., 0][filled], depth[filled], atol=1e-3)
    assert_close(bary[0, ..., 0, :][filled].sum(-1), torch.ones(int(filled.sum())), atol=1e-5)
    x = HALF_WIDTH
    corners = torch.tensor([[-x, -1, -3], [x, -1, -3], [x, -1, 50], [-x, -1, 50]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    points = (bary[0, ..., 0, :, None] * corners[faces[pix_to_face[0, ..., 0].clamp(min=0)]]).sum(-2)[filled]
    assert_close(points[:, 2], depth[filled], rtol=1e-3, atol=1e-3)
    assert_close(points[:, 0] / points[:, 2], columns.expand(20, 32)[filled], atol=1e-3)


def test_clipping_changes_nothing_where_nothing_is_near() -> None:
    verts = torch.randn(50, 3) * 0.5 + torch.tensor([0.0, 0.0, 3.0])
    meshes = Meshes([verts], [torch.randint(0, 50, (60, 3))])
    plain = rasterize_meshes(meshes, (24, 17), 1e-3, 4, perspective_correct=True)
    clipped = rasterize_meshes(meshes, (24, 17), 1e-3, 4, perspective_correct=True, z_clip_value=0.1)
    for a, b in zip(plain, clipped, strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("size", [(16, 16), (12, 30), (30, 12)])
def test_culling_to_the_image_changes_no_pixel(size: tuple[int, int]) -> None:
    verts = torch.randn(80, 3) * 2 + torch.tensor([0.0, 0.0, 9.0])
    starts = torch.randint(0, 78, (90, 1))
    meshes = Meshes([verts], [starts + torch.arange(3)])
    blur = 0.04
    plain = rasterize_meshes(meshes, size, blur, 60)
    culled = rasterize_meshes(meshes, size, blur, 60, cull_to_frustum=True)
    for a, b in zip(plain, culled, strict=True):
        assert torch.equal(a, b)


def test_a_face_cut_in_two_is_seen_once() -> None:
    """Near the seam both halves are within reach; only the one that holds the pixel is kept."""
    face = project(torch.tensor([[-9.0, -9, 4], [9, -9, 4], [0, 9, -2]]), True)
    meshes = Meshes([face], [torch.tensor([[0, 1, 2]])])
    pix_to_face, zbuf, bary, dists = rasterize_meshes(
        meshes, 16, 0.01, 4, perspective_correct=True, clip_barycentric_coords=True, z_clip_value=1.0
    )
    # beyond z = 1 the face fills the lower half of the image: y < 0
    assert (pix_to_face[0, 8:, :, 0] == 0).all()
    assert (pix_to_face[..., 1:] == -1).all()
    assert (dists[0, 8:, :, 0] < 0).all()
    assert (dists[0, 7, :, 0] > 0).all()
    rows = 1 - (2 * torch.arange(8, 16) + 1) / 16
    # the face lies in 3 y + 9 z = 9, the ray in y = row * z
    assert_close(zbuf[0, 8:, :, 0], (9 / (9 + 3 * rows))[:, None].expand(8, 16), atol=1e-4)
    assert_close(bary[0, 8:, :, 0].sum(-1), torch.ones(8, 16), atol=1e-5)
