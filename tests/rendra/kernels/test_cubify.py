"""The fast surface of voxels against its specification: equal, face by face."""

import pytest
import torch
from assertions import assert_close

from rendra.kernels.cubify import cubify, reference


def planes(*sizes: int, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    """Different spacings along x, y and z, so that mixed up axes show."""
    depth, height, width = sizes
    return [torch.arange(n + 1, dtype=dtype) * step for n, step in ((width, 1.0), (height, 0.1), (depth, 0.01))]


def surfaces(voxels: torch.Tensor, thresh: float = 0.5) -> tuple[tuple, tuple]:
    axes = planes(*voxels.shape[1:], dtype=voxels.dtype)
    return cubify(voxels, thresh, *axes), reference.cubify(voxels, thresh, *axes)


SHAPES = [
    (1, 1, 1, 1), (3, 4, 5, 6), (2, 1, 7, 2), (2, 59, 3, 2), (2, 60, 2, 3), (1, 61, 3, 3), (1, 130, 2, 9),
    (0, 3, 3, 3), (2, 0, 3, 3), (2, 3, 0, 3), (2, 3, 3, 0),
]  # fmt: skip


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("share", [0.0, 0.1, 0.6, 1.0])
def test_equals_the_reference(shape: tuple[int, ...], share: float) -> None:
    fast, slow = surfaces((torch.rand(shape) < share).float())
    for mine, specified in zip(fast, slow, strict=True):
        assert mine.dtype == specified.dtype
        assert torch.equal(mine, specified)


def test_a_value_at_the_threshold_is_kept_and_nan_is_not() -> None:
    voxels = torch.tensor([0.3, float("nan"), 0.29999, float("inf"), -float("inf")]).view(5, 1, 1, 1)
    for result in surfaces(voxels, thresh=0.3):
        assert result[4].tolist() == [12, 0, 0, 12, 0]


def test_every_quad_belongs_to_its_voxel() -> None:
    voxels = (torch.rand(2, 4, 3, 5) < 0.4).float()
    (verts, faces, owner, num_verts, num_faces), _ = surfaces(voxels)
    first = torch.arange(2).repeat_interleave(num_faces)
    shift = (num_verts.cumsum(0) - num_verts)[first]
    centre = verts[(faces + shift[:, None])[::2]].mean(1) + verts[(faces + shift[:, None])[1::2]].mean(1)
    grid, z, y, x = torch.unravel_index(owner, voxels.shape)
    assert_close(grid, first[::2])
    assert (voxels.flatten()[owner] == 1).all()
    offset = (centre / 2 / torch.tensor([1.0, 0.1, 0.01]) - torch.stack([x, y, z], 1) - 0.5).abs()
    assert_close(offset.sort(dim=1).values[:, 1:], torch.tensor([0.0, 0.5]).expand(len(owner), 2), atol=1e-3)


def test_results_do_not_depend_on_threads() -> None:
    threads, results, voxels = torch.get_num_threads(), [], (torch.rand(3, 20, 9, 13) < 0.5).float()
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(cubify(voxels, 0.5, *planes(20, 9, 13)))
    torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_memory_of_the_reference_is_bounded_by_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    voxels = (torch.rand(2, 5, 7, 6) < 0.5).float()
    whole = reference.cubify(voxels, 0.5, *planes(5, 7, 6))
    monkeypatch.setattr(reference, "_VOXELS_AT_ONCE", 60)
    assert all(torch.equal(a, b) for a, b in zip(whole, reference.cubify(voxels, 0.5, *planes(5, 7, 6)), strict=True))


def test_other_layouts_and_types() -> None:
    voxels = (torch.rand(4, 5, 3, 2) < 0.5).float().permute(3, 0, 2, 1)
    expected = cubify(voxels.contiguous(), 0.5, *planes(4, 3, 5))
    assert all(torch.equal(a, b) for a, b in zip(cubify(voxels, 0.5, *planes(4, 3, 5)), expected, strict=True))
    double = cubify(voxels.double(), 0.5, *planes(4, 3, 5, dtype=torch.float64))
    assert double[0].dtype == torch.float64
    assert torch.equal(double[1], expected[1])


def test_the_operator_is_well_registered() -> None:
    arguments = (torch.rand(2, 3, 4, 5), 0.5, *planes(3, 4, 5))
    torch.library.opcheck(torch.ops.rendra.cubify.default, arguments)


def test_bad_input_is_named() -> None:
    axes = planes(3, 4, 5)
    with pytest.raises(ValueError, match=r"voxels must be floats of shape \(N, D, H, W\), got torch.int64 of \(1,\)"):
        cubify(torch.ones(1, dtype=torch.int64), 0.5, *axes)
    with pytest.raises(
        ValueError, match=r"z must be torch.float32 of shape \(4,\) on cpu, got torch.float32 of \(6,\)"
    ):
        cubify(torch.ones(1, 3, 4, 5), 0.5, *axes[::-1])


@pytest.mark.gpu
def test_cuda_takes_the_reference() -> None:
    voxels = (torch.rand(2, 4, 5, 6) < 0.5).float()
    there = cubify(voxels.cuda(), 0.5, *(axis.cuda() for axis in planes(4, 5, 6)))
    for mine, expected in zip(there, cubify(voxels, 0.5, *planes(4, 5, 6)), strict=True):
        assert torch.equal(mine.cpu(), expected)
