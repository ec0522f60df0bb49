import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.ops.laplacian_matrices import corner_cotangents, cot_laplacian, laplacian, norm_laplacian
from rendra.utils import ico_sphere, torus

RING = torch.tensor([[0, i, i % 5 + 1] for i in range(1, 6)])


def _ring(dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """A vertex inside an uneven pentagon, in the plane z = 0.3 x - 2 y."""
    xy = [[0.1, 0.2], [1, 0], [0.3, 0.9], [-0.8, 0.4], [-0.5, -1.1], [0.4, -0.7]]
    x, y = torch.tensor(xy, dtype=dtype).unbind(1)
    return torch.stack([x, y, 0.3 * x - 2 * y], 1)


def test_uniform() -> None:
    sphere = ico_sphere(1)
    L = laplacian(sphere.verts_packed().double(), sphere.edges_packed())
    assert L.dtype == torch.float64
    assert_close(L.to_dense(), sphere.laplacian_packed().to_dense())
    assert_close(L.to_dense().sum(1), torch.zeros(42), atol=1e-12)
    assert_close(L.to_dense().diagonal(), -torch.ones(42))


def test_cotangents_of_known_triangles() -> None:
    verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 3**0.5, 0]])
    cotangents, areas = corner_cotangents(verts, torch.tensor([[0, 1, 2], [0, 1, 3]]))
    assert_close(cotangents, [[0.0, 1, 1], [3**-0.5] * 3], atol=1e-6)
    assert_close(areas, [2.0, 3**0.5])


def test_cotangents_keep_their_digits_in_slivers() -> None:
    thin = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-4, 0]])
    cotangents = corner_cotangents(thin, torch.tensor([[0, 1, 2]]))[0]
    assert_close(cotangents, corner_cotangents(thin.double(), torch.tensor([[0, 1, 2]]))[0], rtol=1e-5)


def test_cotangent_weights_are_symmetric_and_add_up() -> None:
    ring = torus(0.3, 1.0, 6, 9)
    verts = ring.verts_packed().double()
    W, inverse_areas = cot_laplacian(verts, ring.faces_packed())
    dense = W.to_dense()
    assert_close(dense, dense.T, atol=0)
    assert_close(dense.diagonal(), torch.zeros(54), atol=0)
    # Dirichlet energy of the coordinates: half of sum w |v_i - v_j|^2 over edges is the double area, twice that
    energy = (dense * torch.cdist(verts, verts).square()).sum() / 4
    assert_close(energy, 2 * ring.faces_areas_packed().double().sum(), rtol=1e-5)
    assert_close(inverse_areas.reciprocal().sum(), 3 * ring.faces_areas_packed().double().sum(), rtol=1e-5)


def test_linear_functions_are_harmonic_within_a_plane() -> None:
    def pull(verts: torch.Tensor) -> torch.Tensor:
        weights = cot_laplacian(verts, RING)[0].to_dense()
        return (weights[0, :, None] * (verts - verts[0])).sum(0)

    assert_close(pull(_ring()), torch.zeros(3), atol=1e-12)
    raised = _ring()
    raised[0, 2] += 1
    assert pull(raised)[2] < -0.1


def test_inverse_lengths() -> None:
    verts = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 4, 0]])
    L = norm_laplacian(verts, torch.tensor([[0, 1], [0, 2]]))
    assert_close(L.to_dense(), [[0.0, 0.5, 0.25], [0.5, 0, 0], [0.25, 0, 0]])


def test_gradients() -> None:
    verts = _ring().requires_grad_()
    edges = torch.tensor([[0, 1], [1, 2], [2, 5]])
    assert torch.autograd.gradcheck(lambda v: cot_laplacian(v, RING)[0].to_dense(), verts)
    assert torch.autograd.gradcheck(lambda v: cot_laplacian(v, RING)[1], verts)
    assert torch.autograd.gradcheck(lambda v: norm_laplacian(v, edges).to_dense(), verts)


def test_degenerate_and_missing_faces_stay_finite() -> None:
    verts = torch.zeros(3, 3, requires_grad=True)
    faces, edges = torch.tensor([[0, 1, 2]]), torch.tensor([[0, 1]])
    W, inverse_areas = cot_laplacian(verts, faces)
    value = W.to_dense().sum() + inverse_areas.sum() + norm_laplacian(verts, edges).to_dense().sum()
    value.backward()
    assert_finite(value)
    assert_finite(verts.grad)
    W, inverse_areas = cot_laplacian(torch.rand(2, 3), torch.zeros(0, 3, dtype=torch.int64))
    assert_close(W.to_dense(), torch.zeros(2, 2))
    assert_close(inverse_areas, torch.zeros(2, 1))
    assert norm_laplacian(torch.zeros(0, 3), torch.zeros(0, 2, dtype=torch.int64)).shape == (0, 0)


def test_shapes_are_checked() -> None:
    verts, faces = torch.rand(3, 3), torch.tensor([[0, 1, 2]])
    with pytest.raises(ValueError, match=r"edges must have shape \(E, 2\), got \(1, 3\)"):
        laplacian(verts, faces)
    with pytest.raises(ValueError, match=r"edges must have shape \(E, 2\), got \(1, 3\)"):
        norm_laplacian(verts, faces)
    with pytest.raises(ValueError, match=r"faces must have shape \(F, 3\), got \(1, 2\)"):
        cot_laplacian(verts, faces[:, :2])
    with pytest.raises(ValueError, match=r"verts must have shape \(V, 3\), got \(1, 3, 3\)"):
        cot_laplacian(verts[None], faces)


def test_the_device_is_kept(far) -> None:  # noqa: F811
    assert isinstance(corner_cotangents(_ring().to(far), RING.to(far))[0], Far)
