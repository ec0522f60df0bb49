"""Voxels to meshes: PyTorch3D's numbers, closed surfaces, volumes, colours, devices."""

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.ops import cubify
from rendra.renderer import TexturesAtlas

ANCHORS = {
    "topleft": [[1, 2], [0, 1], [-1, 0]],
    "corner": [[1 / 3, 1], [-1 / 3, 1 / 3], [-1, -1 / 3]],
    "center": [[0.5, 1.5], [-0.5, 0.5], [-1.5, -0.5]],
}


def _volume(verts: torch.Tensor, faces: torch.Tensor) -> float:
    return float(torch.linalg.det(verts[faces].double()).sum() / 6)


@pytest.mark.parametrize("align", ANCHORS)
def test_one_voxel_lies_where_pytorch3d_puts_it(align: str) -> None:
    voxels = torch.zeros(1, 3, 3, 3)
    voxels[0, 0, 1, 2] = 1
    mesh = cubify(voxels, 0.5, align=align)
    assert_close(mesh.get_bounding_boxes()[0], ANCHORS[align])
    assert (len(mesh.verts_packed()), len(mesh.faces_packed())) == (8, 12)


def test_vertices_are_sorted_by_y_x_z() -> None:
    voxels = torch.zeros(1, 2, 2, 2)
    voxels[0, 0, 0, 0] = 1
    corners = [[x, y, z] for y in (-1, 1) for x in (-1, 1) for z in (-1, 1)]
    assert_close(cubify(voxels, 0.5).verts_packed(), corners)


@pytest.mark.parametrize("align", ANCHORS)
def test_surfaces_are_closed_look_outwards_and_hold_the_voxels(align: str) -> None:
    voxels = torch.rand(3, 5, 6, 7)
    meshes = cubify(voxels, 0.6, align=align)
    spans = [2 / (n if align == "corner" else n - 1) for n in (5, 6, 7)]
    for grid, verts, faces in zip(voxels, meshes.verts_list(), meshes.faces_list(), strict=True):
        assert _volume(verts, faces) == pytest.approx(int((grid >= 0.6).sum()) * spans[0] * spans[1] * spans[2])
        edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        forth, back = (edges @ torch.tensor(v) for v in ([1000, 1], [1, 1000]))
        assert torch.equal(forth.sort().values, back.sort().values)
        assert faces.unique().numel() == len(verts) == verts.unique(dim=0).shape[0]


def test_inner_sides_go() -> None:
    mesh = cubify(torch.ones(1, 4, 3, 2), 0.5)
    assert len(mesh.faces_packed()) == 2 * 2 * (4 * 3 + 3 * 2 + 4 * 2)


def test_an_empty_grid_keeps_its_place() -> None:
    voxels = torch.zeros(3, 4, 4, 4)
    voxels[1] = 1
    meshes = cubify(voxels, 0.5)
    assert meshes.num_faces_per_mesh().tolist() == [0, 192, 0]
    assert meshes.valid.tolist() == [False, True, False]
    assert cubify(voxels[:1], 0.5).isempty()
    assert len(cubify(voxels[:0], 0.5)) == 0


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.float16, torch.float64])
def test_other_types(dtype: torch.dtype) -> None:
    voxels = torch.rand(2, 3, 4, 5) < 0.5
    mesh, expected = cubify(voxels.to(dtype), 0.5), cubify(voxels.float(), 0.5)
    assert mesh.verts_packed().dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
    assert_close(mesh.verts_packed(), expected.verts_packed().tolist())
    assert torch.equal(mesh.faces_packed(), expected.faces_packed())


def test_faces_show_the_feature_of_their_voxel() -> None:
    voxels = (torch.rand(3, 3, 4, 5) < 0.5).float()
    voxels[1] = 0
    places = torch.stack(torch.meshgrid(*[torch.arange(float(n)) for n in (3, 4, 5)], indexing="ij"))
    feats = places.repeat(3, 1, 1, 1, 1).requires_grad_()
    meshes = cubify(voxels, 0.5, feats=feats, align="center")
    assert isinstance(meshes.textures, TexturesAtlas)
    texels = meshes.textures.atlas_packed()
    assert texels.shape == (len(meshes.faces_packed()), 1, 1, 3)
    centres = meshes.verts_packed()[meshes.faces_packed()].view(-1, 2, 3, 3)
    middle = (centres.amin((1, 2)) + centres.amax((1, 2))) / 2
    voxel = (middle + 1) / 2 * torch.tensor([4.0, 3, 2])  # (x, y, z), half a voxel off along the normal
    off = (voxel.repeat_interleave(2, 0) - texels[:, 0, 0].flip(-1)).abs().sort(1).values
    assert_close(off, torch.tensor([0, 0, 0.5]).expand_as(off))
    texels.sum().backward()
    assert (feats.grad[1] == 0).all()
    assert torch.equal(feats.grad[0, 0] > 0, feats.grad[0, 2] > 0)


def test_meshes_are_made_where_they_are_wanted(far) -> None:  # noqa: F811
    voxels, feats = torch.rand(2, 3, 4, 5), torch.rand(2, 3, 3, 4, 5)
    expected = cubify(voxels, 0.5)
    there = cubify(voxels.to(far), 0.5)
    assert isinstance(there.verts_packed(), Far)
    assert torch.equal(there.verts_packed().cpu(), expected.verts_packed())
    assert torch.equal(there.faces_packed().cpu(), expected.faces_packed())
    moved = cubify(voxels, 0.5, feats=feats, device=far, align="center")
    assert isinstance(moved.textures.atlas_packed(), Far)


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match="align must be one of topleft, corner, center, got 'middle'"):
        cubify(torch.ones(1, 2, 2, 2), 0.5, align="middle")
    with pytest.raises(ValueError, match=r"voxels must have shape \(N, D, H, W\), got \(2, 2\)"):
        cubify(torch.ones(2, 2), 0.5)
    with pytest.raises(ValueError, match="feats can be given with align='center' only"):
        cubify(torch.ones(1, 2, 2, 2), 0.5, feats=torch.ones(1, 3, 2, 2, 2))
    with pytest.raises(ValueError, match=r"feats must have shape \(N, C, D, H, W\)"):
        cubify(torch.ones(1, 2, 2, 2), 0.5, feats=torch.ones(1, 2, 2, 2), align="center")
