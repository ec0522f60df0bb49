"""Voxel heads have the paper's weights, and whatever they say there is a mesh to refine."""

import pytest
import torch
from far_device import Far, far  # noqa: F401
from torch import nn

from rendra_lab.networks.voxel_head import VoxelHead, central_tetrahedra, cubified


def weights(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


@pytest.mark.parametrize(("channels", "side", "millions"), [(2048, 48, 6.764), (256, 24, 2.629)])
def test_published_heads_have_the_published_weights(channels: int, side: int, millions: float) -> None:
    assert round(weights(VoxelHead(channels, side)) / 1e6, 3) == millions


def test_an_untrained_head_is_undecided_and_knows_rows_columns_and_depth() -> None:
    head = VoxelHead(4, side=8, width=6, convs=1)
    logits = head(torch.randn(2, 4, 5, 3))
    assert logits.shape == (2, 8, 8, 8)
    assert float(logits.detach().abs().max()) < 0.1
    # what lies at the right of a map changes the right columns alone, at all depths
    maps = torch.zeros(1, 4, 4, 4)
    lit = maps.clone()
    lit[..., 3] = 1
    changed = ((head(lit) - head(maps)).abs() > 0)[0]
    assert not bool(changed[:, :, :4].any())
    assert bool(changed[:, :, 6:].all(1).all(1).all(0))


def test_several_maps_are_put_together_and_the_last_ones_are_read() -> None:
    head = VoxelHead([3, 5], side=8, width=4, convs=1)
    maps = [torch.randn(2, 2, 9, 9), torch.randn(2, 3, 5, 5), torch.randn(2, 5, 3, 3)]
    torch.testing.assert_close(head(maps), head(maps[1:]))
    with pytest.raises(ValueError, match=r"reads maps of \[3, 5\] channels, got \[3, 2\]"):
        head(maps[::-1])


def test_outermost_cells_keep_their_places_if_asked() -> None:
    head = VoxelHead(1, side=10, width=1, convs=0, align_corners=True)
    ramp = torch.linspace(0, 4, 3).expand(1, 1, 3, 3)
    torch.testing.assert_close(head._resized(ramp)[0, 0, 0], torch.linspace(0, 4, 5))


def test_no_object_has_no_voxels_but_gradients() -> None:
    head = VoxelHead(3, side=6, width=4)
    logits = head(torch.zeros(0, 3, 5, 5))
    assert logits.shape == (0, 6, 6, 6)
    logits.sum().backward()
    assert all(float(parameter.grad.abs().sum()) == 0 for parameter in head.parameters())
    meshes, is_found = cubified(logits)
    assert len(meshes) == len(is_found) == 0


def test_an_odd_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="must be even, got 7"):
        VoxelHead(3, side=7)


def test_voxels_become_their_surface_and_none_the_central_cube() -> None:
    logits = torch.full((2, 8, 8, 8), -9.0)
    logits[0, 1, 2, 3] = 2.0
    meshes, is_found = cubified(logits, 0.2)
    assert is_found.tolist() == [True, False]
    low, high = meshes.get_bounding_boxes().unbind(-1)
    torch.testing.assert_close(low[0], torch.tensor([3.0, 2.0, 1.0]) / 4 - 1)
    torch.testing.assert_close(high - low, torch.tensor([[0.25] * 3, [1.0] * 3]))
    torch.testing.assert_close(low[1], torch.full((3,), -0.5))


@pytest.mark.parametrize("side", [2, 4, 6, 24])
def test_no_grid_is_too_small_for_the_central_cube(side: int) -> None:
    meshes, _ = cubified(torch.full((1, side, side, side), -9.0))
    assert len(meshes.faces_packed()) >= 12


def test_tetrahedra_are_closed_and_look_outwards() -> None:
    meshes = central_tetrahedra(2, torch.zeros(1, dtype=torch.float64))
    triangles = meshes[1].verts_packed()[meshes[1].faces_packed()]
    volume = torch.linalg.det(triangles).sum() / 6
    torch.testing.assert_close(volume, torch.tensor(1 / 3, dtype=torch.float64))
    assert len(meshes.edges_packed()) == 2 * 6


def test_devices(far) -> None:  # noqa: F811
    meshes, is_found = cubified(torch.randn(2, 4, 4, 4, device=far))
    assert isinstance(is_found, Far)
    assert isinstance(meshes.verts_packed(), Far)
    assert isinstance(central_tetrahedra(2, meshes.verts_packed()).verts_packed(), Far)


def test_smoothing_evens_out_the_steps_and_keeps_the_size() -> None:
    logits = torch.full((1, 12, 12, 12), -9.0)
    places = torch.arange(12).float() - 5.5
    inside = places.square()[:, None, None] + places.square()[:, None] + places.square() < 16
    logits[0][inside] = 9.0
    rough, smooth = cubified(logits)[0], cubified(logits, smoothing=10)[0]
    assert torch.equal(rough.faces_packed(), smooth.faces_packed())
    radii = [each.verts_packed().norm(dim=1) for each in (rough, smooth)]
    assert float(radii[1].std()) < 0.6 * float(radii[0].std())
    assert float(radii[1].mean()) == pytest.approx(float(radii[0].mean()), rel=0.05)
