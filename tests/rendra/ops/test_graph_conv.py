import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401

from rendra.ops.graph_conv import GraphConv, gather_scatter
from rendra.structures import join_meshes_as_batch
from rendra.utils import ico_sphere, torus

PATH = torch.tensor([[0, 1], [1, 2], [3, 1]])


@pytest.mark.parametrize("directed", [False, True])
def test_sums_over_neighbours(directed: bool) -> None:
    rows = torch.tensor([[1.0], [10], [100], [1000], [10000]])
    expected = [[10.0], [100], [0], [10], [0]] if directed else [[10.0], [1101], [10], [10], [0]]
    assert_close(gather_scatter(rows, PATH, directed), expected)


def test_sums_like_the_adjacency_matrix() -> None:
    ring = torus(0.3, 1.0, 5, 8)
    adjacency = (ring.laplacian_packed().to_dense() > 0).double()
    rows = torch.randn(40, 33, dtype=torch.float64)
    assert_close(gather_scatter(rows, ring.edges_packed()), adjacency @ rows, atol=1e-12)


@pytest.mark.parametrize("directed", [False, True])
def test_gradients(directed: bool) -> None:
    rows = torch.randn(5, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r: gather_scatter(r, PATH, directed), rows)
    assert torch.autograd.gradgradcheck(lambda r: gather_scatter(r, PATH, directed).pow(2), rows)


@pytest.mark.parametrize("directed", [False, True])
def test_the_formula_with_a_bias_for_each_neighbour(directed: bool) -> None:
    layer = GraphConv(3, 4, directed=directed)
    torch.nn.init.normal_(layer.w0.bias)
    torch.nn.init.normal_(layer.w1.bias)
    x = torch.randn(5, 3)
    neighbors = [[1], [2], [], [1], []] if directed else [[1], [0, 2, 3], [1], [1], []]
    expected = [
        layer.w0(x[i]) + sum((layer.w1(x[j]) for j in near), torch.zeros(4)) for i, near in enumerate(neighbors)
    ]
    assert_close(layer(x, PATH), torch.stack(expected))


def test_vertices_may_be_renumbered() -> None:
    sphere, layer, x = ico_sphere(1), GraphConv(6, 5), torch.randn(42, 6)
    order = torch.randperm(42)
    edges = torch.argsort(order)[sphere.edges_packed()]
    assert_close(layer(x[order], edges), layer(x, sphere.edges_packed())[order], atol=1e-6)


def test_initial_weights() -> None:
    normal = GraphConv(300, 200)
    for layer in (normal.w0, normal.w1):
        assert layer.weight.std().item() == pytest.approx(0.01, rel=0.02)
        assert (layer.bias == 0).all()
    zero = GraphConv(3, 4, init="zero")
    assert_close(zero(torch.rand(5, 3), PATH), torch.zeros(5, 4))
    with pytest.raises(ValueError, match='Invalid GraphConv initialization "ones"'):
        GraphConv(3, 4, init="ones")


def test_it_learns_and_stores_under_the_known_names() -> None:
    layer = GraphConv(3, 2)
    assert list(layer.state_dict()) == ["w0.weight", "w0.bias", "w1.weight", "w1.bias"]
    layer(torch.rand(5, 3), PATH).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in layer.parameters() if p.ndim == 2)
    assert repr(layer).startswith("GraphConv(\n  3 -> 2, directed=False")


def test_no_vertices_and_no_edges() -> None:
    layer, none = GraphConv(3, 2), torch.zeros(0, 2, dtype=torch.int64)
    x = torch.zeros(0, 3, requires_grad=True)
    result = layer(x, none)
    result.sum().backward()
    assert result.shape == (0, 2)
    alone = torch.rand(4, 3)
    assert_close(layer(alone, none), layer.w0(alone))


def test_threads_do_not_show() -> None:
    edges, before = ico_sphere(3).edges_packed(), torch.get_num_threads()
    rows = torch.randn(642, 64)
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            leaf = rows.clone().requires_grad_()
            sums = gather_scatter(leaf, edges)
            sums.pow(2).sum().backward()
            results.append((sums.detach(), leaf.grad))
    finally:
        torch.set_num_threads(before)
    for sums, gradient in results[1:]:
        assert torch.equal(sums, results[0][0])
        assert torch.equal(gradient, results[0][1])


def test_the_matrix_of_a_mesh_stands_for_its_edges() -> None:
    mesh = join_meshes_as_batch([ico_sphere(0), ico_sphere(1)])
    rows, conv = torch.rand(len(mesh.verts_packed()), 3), GraphConv(3, 2)
    expected = conv(rows, mesh.edges_packed())
    torch.testing.assert_close(conv.over(rows, mesh.topology.neighbours(torch.float32)), expected)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"2 dimensions, \(V, D\); got \(5,\)"):
        gather_scatter(torch.rand(5), PATH)
    with pytest.raises(ValueError, match=r"edges must be of shape \(num_edges, 2\), got \(3, 3\)"):
        gather_scatter(torch.rand(5, 2), torch.zeros(3, 3, dtype=torch.int64))


def test_devices(far) -> None:  # noqa: F811
    rows = torch.rand(5, 3, device=far, requires_grad=True)
    summed = gather_scatter(rows, PATH.to(far))
    summed.sum().backward()
    assert isinstance(summed, Far)
    assert isinstance(rows.grad, Far)
    with pytest.raises(ValueError, match="must be on the same device; got cpu and meta"):
        GraphConv(3, 2)(torch.rand(5, 3), PATH.to(far))
