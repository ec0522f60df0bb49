"""Samples lie on their surface, spread evenly over its area, and carry its normals and colours."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.ops.sample_points_from_meshes import sample_points_from_meshes
from rendra.renderer import TexturesAtlas, TexturesUV, TexturesVertex
from rendra.structures import Meshes
from rendra.utils import ico_sphere, torus

NO_FACES = torch.zeros(0, 3, dtype=torch.int64)
SQUARES = torch.tensor([[0, 1, 2], [1, 3, 2], [4, 5, 6], [5, 7, 6]])


def _two_squares(small: float = 1.0, large: float = 3.0, dtype: torch.dtype = torch.float32) -> Meshes:
    """One in the plane z = 0, one in x = 10."""
    unit = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]], dtype=dtype)
    zero = torch.zeros(4, 1, dtype=dtype)
    flat = torch.cat([small * unit, zero], 1)
    return Meshes([torch.cat([flat, torch.cat([zero + 10, large * unit], 1)])], [SQUARES])


def test_faces_are_drawn_by_area() -> None:
    points = sample_points_from_meshes(_two_squares(), 40000)[0]
    on_large = (points[:, 0] > 5).double().mean().item()
    assert on_large == pytest.approx(0.9, abs=5 * (0.09 / 40000) ** 0.5)


def test_points_fill_a_triangle_evenly() -> None:
    """Over 16 congruent parts, chi squared with 15 degrees of freedom; 44.3 is exceeded once in 10,000 times."""
    mesh = Meshes([torch.tensor([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])], [torch.tensor([[0, 1, 2]])])
    x, y, z = sample_points_from_meshes(mesh, 16000)[0].unbind(1)
    upper = (x.frac() + y.frac() > 1).long()
    part = torch.unique(x.long() * 100 + y.long() * 10 + upper, return_counts=True)[1]
    assert len(part) == 16
    assert ((part - 1000).square().sum() / 1000).item() < 44.3
    assert (z == 0).all()


def test_moments_of_a_sphere() -> None:
    points, normals = sample_points_from_meshes(ico_sphere(4), 20000, return_normals=True)
    assert_close(points.norm(dim=2), torch.ones(1, 20000), atol=2e-3)
    assert_close(points.mean(1), torch.zeros(1, 3), atol=0.02)
    assert_close(points[0].T @ points[0] / 20000, torch.eye(3) / 3, atol=0.015)
    assert_close(normals, points / points.norm(dim=2, keepdim=True), atol=0.05)


def test_every_mesh_of_a_batch_gets_its_own() -> None:
    verts = [ico_sphere(2).verts_packed() * 1e-6, torch.zeros(0, 3), 1e6 + 1e6 * torus(0.3, 1, 8, 16).verts_packed()]
    verts += [torch.rand(3, 3), ico_sphere(0).verts_packed(), torch.rand(1, 3)]
    faces = [ico_sphere(2).faces_packed(), NO_FACES, torus(0.3, 1, 8, 16).faces_packed(), NO_FACES]
    faces += [ico_sphere(0).faces_packed(), NO_FACES]
    points, normals = sample_points_from_meshes(Meshes(verts, faces), 500, return_normals=True)
    assert points.shape == normals.shape == (6, 500, 3)
    for empty in (1, 3, 5):
        assert (points[empty] == 0).all()
        assert (normals[empty] == 0).all()
    for filled in (0, 2, 4):
        assert_close(normals[filled].norm(dim=1), torch.ones(500))
        assert (points[filled] >= verts[filled].amin(0) * (1 - 1e-6)).all()
        assert (points[filled] <= verts[filled].amax(0) * (1 + 1e-6)).all()
        assert len(torch.unique(normals[filled].round(decimals=3), dim=0)) > 15
    radii = points[0].norm(dim=1)
    assert radii.min() > 0.9e-6
    assert radii.max() <= 1.001e-6


def test_faces_without_area_are_never_drawn() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]])
    faces = torch.tensor([[3, 3, 3], [3, 0, 3], [0, 1, 2], [3, 3, 3]])
    points, normals = sample_points_from_meshes(Meshes([verts], [faces]), 1000, return_normals=True)
    assert points.max() <= 1
    assert_close(normals, torch.tensor([0.0, 0, 1]).expand(1, 1000, 3))


def test_a_mesh_without_area_gives_points_on_it() -> None:
    verts = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], requires_grad=True)
    points, normals = sample_points_from_meshes(Meshes([verts], [torch.tensor([[0, 1, 2]])]), 100, True)
    assert (points[..., 0] > 0).any()
    assert (points[..., 1:] == 0).all()
    assert (normals == 0).all()
    (points.sum() + normals.sum()).backward()
    assert_finite(verts.grad)


def test_a_random_number_at_the_end_of_its_range_stays_within_its_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    def largest(*shape: int, dtype: torch.dtype, **_: object) -> torch.Tensor:
        return torch.ones(shape, dtype=dtype)  # beyond [0, 1), where rounding may lead

    meshes = Meshes([ico_sphere(0).verts_packed() + 10 * i for i in range(3)], [ico_sphere(0).faces_packed()] * 3)
    monkeypatch.setattr(torch, "rand", largest)
    points = sample_points_from_meshes(meshes, 2)
    assert_close(points.mean((1, 2)).round(decimals=-1), [0.0, 10, 20])


def test_a_million_small_faces_weigh_as_much_as_one_large() -> None:
    many = 1_000_000
    verts = torch.tensor([[0.0, 0, 0], [1e3, 0, 0], [0, 1e3, 0], [0, 0, -1], [1, 0, -1], [0, 1, -1]])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]]).repeat_interleave(torch.tensor([1, many]), 0)
    below = (sample_points_from_meshes(Meshes([verts], [faces]), 20000)[..., 2] < 0).double().mean().item()
    assert below == pytest.approx(0.5, abs=0.02)


def test_the_seed_decides() -> None:
    sphere = ico_sphere(1)
    torch.manual_seed(5)
    first = sample_points_from_meshes(sphere, 50)
    torch.manual_seed(5)
    assert torch.equal(sample_points_from_meshes(sphere, 50), first)
    generator = torch.Generator().manual_seed(5)
    state = torch.get_rng_state()
    assert torch.equal(sample_points_from_meshes(sphere, 50, generator=generator), first)
    assert torch.equal(torch.get_rng_state(), state)


def test_gradients_reach_the_vertices() -> None:
    mesh = _two_squares(dtype=torch.float64)
    verts = (mesh.verts_packed() + 0.1 * torch.randn(8, 3, dtype=torch.float64)).requires_grad_()

    def sampled(moved: torch.Tensor) -> tuple[torch.Tensor, ...]:
        # moving vertices moves the bounds between faces, which a fixed seed meets with probability zero
        generator = torch.Generator().manual_seed(0)
        return sample_points_from_meshes(Meshes([moved], [SQUARES]), 20, True, generator=generator)

    assert torch.autograd.gradcheck(sampled, verts)
    assert torch.autograd.gradgradcheck(lambda v: sampled(v)[0].pow(2), verts)


def test_moving_a_mesh_moves_its_samples() -> None:
    sphere, shift = ico_sphere(2), torch.zeros(3, requires_grad=True)
    sample_points_from_meshes(sphere.offset_verts(shift), 700).sum().backward()
    assert_close(shift.grad, [700.0, 700, 700], rtol=1e-4)


def _colored(kind: str) -> Meshes:
    """A batch in which the colour of a point is (x, y)."""
    quad = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    meshes = Meshes([quad, quad[:3], quad[:3]], [faces, faces[:1], NO_FACES])
    if kind == "vertex":
        meshes.textures = TexturesVertex([quad[:, :2], quad[:3, :2], quad[:3, :2]])
    else:
        steps = (torch.arange(64) + 0.5) / 64
        image = torch.stack(torch.meshgrid(1 - steps, steps, indexing="ij")[::-1], -1)
        maps = image.expand(3, -1, -1, -1)
        uvs = [quad[:, :2], quad[:3, :2], quad[:3, :2]]
        meshes.textures = TexturesUV(maps, meshes.faces_list(), uvs, align_corners=False)
    return meshes


@pytest.mark.parametrize("kind", ["vertex", "uv"])
def test_textures_are_read_at_the_points(kind: str) -> None:
    points, normals, texels = sample_points_from_meshes(_colored(kind), 300, True, True)
    assert_close(texels, points[..., :2], atol=1 / 128 + 1e-5)  # a map is constant beyond its outermost centres
    assert_close(normals[:2], torch.tensor([0.0, 0, 1]).expand(2, 300, 3))
    assert (texels[2] == 0).all()
    assert len(sample_points_from_meshes(_colored(kind), 5, return_textures=True)) == 2


def test_an_atlas_is_read_on_the_right_face() -> None:
    mesh = _two_squares()
    colors = torch.tensor([1.0, 1, 2, 2]).view(1, 4, 1, 1, 1).expand(1, 4, 2, 2, 1)
    mesh.textures = TexturesAtlas(colors)
    points, texels = sample_points_from_meshes(mesh, 100, return_textures=True)
    assert_close(texels[..., 0], 1 + (points[..., 0] > 5).float())


def test_gradients_reach_the_textures() -> None:
    colors = torch.rand(1, 12, 2, requires_grad=True)
    sphere = ico_sphere(0)
    sphere.textures = TexturesVertex(colors)
    sample_points_from_meshes(sphere, 1000, return_textures=True)[1].sum().backward()
    assert_close(colors.grad.sum(), 2000.0)
    assert (colors.grad > 0).all()


def test_no_samples_wanted() -> None:
    points, normals = sample_points_from_meshes(ico_sphere(0).extend(2), 0, return_normals=True)
    assert points.shape == normals.shape == (2, 0, 3)


def test_what_cannot_be_sampled_is_named() -> None:
    sphere = ico_sphere(0)
    for empty in (Meshes([], []), Meshes([torch.rand(2, 3)], [NO_FACES])):
        with pytest.raises(ValueError, match=r"Meshes are empty\."):
            sample_points_from_meshes(empty)
    for bad in (float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"Meshes contain nan or inf\."):
            sample_points_from_meshes(sphere.offset_verts(torch.tensor([bad, 0, 0])))
    with pytest.raises(ValueError, match=r"Meshes do not contain textures\."):
        sample_points_from_meshes(sphere, return_textures=True)
    with pytest.raises(ValueError, match="num_samples must not be negative, got -1"):
        sample_points_from_meshes(sphere, -1)


def test_the_device_is_kept(far) -> None:  # noqa: F811
    sphere = ico_sphere(0, far)
    shift = torch.zeros(3, device=far, requires_grad=True)
    sphere.textures = TexturesVertex(sphere.verts_padded().abs())
    points, normals, texels = sample_points_from_meshes(sphere.offset_verts(shift).extend(2), 9, True, True)
    (points.sum() + normals.sum()).backward()
    assert all(isinstance(result, Far) for result in (points, normals, texels, shift.grad))
