"""Surfaces of constant value: closed forms, frames, orientation, no holes, empty volumes."""

import math

import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.ops import marching_cubes
from rendra.ops.marching_cubes import marching_cubes_naive


def _grid(depth: int, height: int, width: int) -> tuple[torch.Tensor, ...]:
    """x, y, z of every voxel in local coordinates, each (D, H, W)."""
    axes = [torch.linspace(-1, 1, n, dtype=torch.float64) for n in (depth, height, width)]
    z, y, x = torch.meshgrid(*axes, indexing="ij")
    return x, y, z


def _ellipsoid(shape: tuple[int, int, int] = (31, 27, 35)) -> torch.Tensor:
    x, y, z = _grid(*shape)
    return ((x / 0.9) ** 2 + (y / 0.6) ** 2 + (z / 0.5) ** 2).sqrt() - 1


def _volume(verts: torch.Tensor, faces: torch.Tensor) -> float:
    return float(torch.linalg.det(verts[faces].double()).sum() / 6)


def _is_closed(faces: torch.Tensor) -> bool:
    """Every edge lies in two faces that run along it in opposite directions."""
    edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    size = int(faces.max()) + 1
    forth, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    return torch.equal(forth.sort().values, back.sort().values) and forth.unique().numel() == len(forth)


def test_an_ellipsoid_has_its_volume_axes_and_outside() -> None:
    (verts,), (faces,) = marching_cubes(_ellipsoid()[None].float(), 0.0)
    assert (verts.dtype, faces.dtype) == (torch.float32, torch.int64)
    assert _volume(verts, faces) == pytest.approx(4 / 3 * math.pi * 0.9 * 0.6 * 0.5, rel=0.01)
    assert_close(verts.amax(0), [0.9, 0.6, 0.5], atol=2e-3)
    assert_close(verts.amin(0), [-0.9, -0.6, -0.5], atol=2e-3)
    assert _is_closed(faces)
    corners = verts[faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((normals * corners.mean(1)).sum(1) > 0).all()


def test_a_density_is_turned_by_its_sign() -> None:
    volume = _ellipsoid()[None]
    inward = _volume(*(part[0] for part in marching_cubes(-volume, -0.1)))
    assert inward == pytest.approx(-_volume(*(part[0] for part in marching_cubes(volume, 0.1))))


def test_linear_fields_give_planes_in_both_frames() -> None:
    x, y, z = _grid(5, 6, 7)
    for axis, (field, size) in enumerate(((x, 7), (y, 6), (z, 5))):
        (local,), _ = marching_cubes(field[None], 0.3)
        assert_close(local[:, axis], torch.full((len(local),), 0.3))
        (voxels,), _ = marching_cubes(field[None], 0.3, return_local_coords=False)
        assert_close(voxels[:, axis], torch.full((len(local),), 0.65 * (size - 1)))
        assert_close(voxels / torch.tensor([3.0, 2.5, 2]) - 1, local)


def test_the_default_level_is_the_middle_of_each_volume() -> None:
    volume = torch.stack([_ellipsoid(), 3 * _ellipsoid() + 100])
    verts, faces = marching_cubes(volume)
    middle = float(volume[0].min() + volume[0].max()) / 2
    (expected,), (same_faces,) = marching_cubes(volume[:1], middle)
    assert_close(verts[0], expected)
    assert_close(verts[1], expected, atol=1e-4)
    assert torch.equal(faces[0], same_faces)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_no_holes_whatever_meets_the_level(scale: float) -> None:
    """Many voxels exactly on the level, ambiguous cubes everywhere, values of any size."""
    field = torch.nn.functional.pad(torch.randint(0, 3, (9, 10, 11)).double(), (1,) * 6, value=2)
    (verts,), (faces,) = marching_cubes(scale * field[None], scale)
    assert _is_closed(faces)
    assert _volume(verts, faces) > 0
    (verts,), (faces,) = marching_cubes(scale * torch.nn.functional.pad(torch.rand(8, 8, 8), (1,) * 6, value=1)[None])
    assert _is_closed(faces)


@pytest.mark.parametrize("shape", [(0, 4, 4, 4), (1, 1, 4, 4), (2, 4, 4, 1), (1, 0, 3, 3), (2, 3, 3, 3)])
@pytest.mark.parametrize("level", [None, 0.0, 7.0, -7.0])
def test_no_surface_gives_no_rows(shape: tuple[int, ...], level: float | None) -> None:
    verts, faces = marching_cubes(torch.zeros(shape), level)
    assert [tuple(v.shape) for v in verts] == [(0, 3)] * shape[0]
    assert [tuple(f.shape) for f in faces] == [(0, 3)] * shape[0]


def test_a_batch_is_its_members() -> None:
    volumes = torch.stack([_ellipsoid(), torch.ones(31, 27, 35), -_ellipsoid()])
    verts, faces = marching_cubes_naive(volumes, 0.0)
    assert [len(v) > 0 for v in verts] == [True, False, True]
    (alone,), (faces_alone,) = marching_cubes(volumes[2:], 0.0)
    assert torch.equal(verts[2], alone)
    assert torch.equal(faces[2], faces_alone)


def test_results_lie_where_the_volume_lies(far) -> None:  # noqa: F811
    verts, faces = marching_cubes(_ellipsoid((8, 8, 8))[None].to(far), 0.0)
    assert isinstance(verts[0], Far)
    assert isinstance(faces[0], Far)
    assert verts[0].dtype == torch.float64


def test_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"vol_batch must have shape \(N, D, H, W\), got \(3, 3, 3\)"):
        marching_cubes(torch.zeros(3, 3, 3))
    volume = torch.rand(2, 3, 3, 3)
    volume[1, 0, 0, :2] = float("nan")
    with pytest.raises(ValueError, match=r"vol_batch\[1\] has 2 values that are not finite"):
        marching_cubes(volume)
