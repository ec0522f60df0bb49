import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.ops.vert_align import vert_align
from rendra.structures import Meshes, Pointclouds
from rendra.utils import ico_sphere


def _ramp(height: int, width: int, align_corners: bool = True) -> torch.Tensor:
    """A map whose two channels are x and y. (1, 2, H, W)"""
    ends = [(1.0, 1.0) if align_corners else (1 - 1 / size, 1 - 1 / size) for size in (height, width)]
    y, x = (torch.linspace(-end, end, size) for (end, _), size in zip(ends, (height, width), strict=True))
    return torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1])[None]


@pytest.mark.parametrize("align_corners", [True, False])
@pytest.mark.parametrize("width", [2, 3])
def test_a_ramp_gives_positions_back(align_corners: bool, width: int) -> None:
    verts = 1.6 * torch.rand(1, 50, width) - 0.8
    read = vert_align(_ramp(7, 10, align_corners), verts, align_corners=align_corners)
    assert_close(read, verts[..., :2], atol=1e-6)


def test_outside_is_padding() -> None:
    verts = torch.tensor([[[3.0, 0, 0], [-1, -1, 0]]])
    assert_close(vert_align(_ramp(5, 5), verts), [[[0.0, 0], [-1, -1]]])
    assert_close(vert_align(_ramp(5, 5), verts, padding_mode="border"), [[[1.0, 0], [-1, -1]]])
    nearest = vert_align(_ramp(3, 3), torch.tensor([[[0.3, -0.8, 0]]]), interp_mode="nearest")
    assert_close(nearest, [[[0.0, -1]]])


def test_several_maps_side_by_side() -> None:
    maps = [torch.rand(2, 3, 4, 5), torch.rand(2, 1, 9, 2)]
    verts = 2 * torch.rand(2, 6, 3) - 1
    both = vert_align(maps, verts)
    assert both.shape == (2, 6, 4)
    assert_close(both, torch.cat([vert_align(each, verts) for each in maps], 2))
    assert_close(vert_align(tuple(maps), verts), both)


def test_a_batch_of_different_shapes() -> None:
    verts = [2 * torch.rand(n, 3) - 1 for n in (4, 0, 7)]
    maps = torch.rand(3, 2, 6, 6)
    shapes = [Meshes(verts, [torch.zeros(0, 3)] * 3), Pointclouds(verts)]
    expected = torch.cat([vert_align(maps[i : i + 1], v[None])[0] for i, v in enumerate(verts)])
    for each in shapes:
        assert vert_align(maps, each).shape == (3, 7, 2)
        assert_close(vert_align(maps, each, return_packed=True), expected)
    assert vert_align(maps, torch.rand(3, 5, 3), return_packed=True).shape == (15, 2)


def test_gradients_reach_maps_and_vertices() -> None:
    verts = (1.8 * torch.rand(2, 3, 3, dtype=torch.float64) - 0.9).requires_grad_()
    maps = [torch.rand(2, 2, 4, 3, dtype=torch.float64, requires_grad=True), torch.rand(2, 1, 2, 2).double()]
    assert torch.autograd.gradcheck(lambda v, m: vert_align([m, maps[1]], v), (verts, maps[0]))


def test_nothing_to_read() -> None:
    assert vert_align(torch.rand(2, 3, 4, 4), torch.zeros(2, 0, 3)).shape == (2, 0, 3)
    assert vert_align(torch.rand(0, 3, 4, 4), torch.zeros(0, 5, 3)).shape == (0, 5, 3)
    assert vert_align(torch.rand(0, 3, 4, 4), Meshes([], []), return_packed=True).shape == (0, 3)


def test_wrong_input_is_named() -> None:
    maps, verts = torch.rand(2, 3, 4, 4), torch.rand(2, 5, 3)
    with pytest.raises(ValueError, match=r"should be 3 dimensional, \(N, V, 3\) or \(N, V, 2\); got \(5, 3\)"):
        vert_align(maps, verts[0])
    with pytest.raises(ValueError, match="verts must be a tensor, Meshes or Pointclouds; got <class 'list'>"):
        vert_align(maps, [verts])
    with pytest.raises(ValueError, match=r"feats must be 4 dimensional tensors, \(N, C, H, W\); got \(3, 4, 4\)"):
        vert_align(maps[0], verts)
    with pytest.raises(ValueError, match="inconsistent batch dimension: verts have 2, feats 1"):
        vert_align([maps, maps[:1]], verts)
    with pytest.raises(ValueError, match="at least one map"):
        vert_align([], verts)


def test_the_device_is_kept(far) -> None:  # noqa: F811
    assert isinstance(vert_align(torch.rand(2, 3, 4, 4, device=far), ico_sphere(0, far).extend(2)), Far)
