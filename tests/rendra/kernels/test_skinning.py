"""The skinning kernel against its reference, and the reference against a loop over vertices and joints."""

from functools import partial

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from rendra.kernels.skinning import SkinWeights, reference, skin, skin_weights


def _scene(
    bodies: int, verts: int, joints: int, held: int, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor, SkinWeights]:
    """Vertices, transforms and weights of at most `held` joints a vertex."""
    generator = torch.Generator().manual_seed(bodies + 10 * verts + joints)
    draw = partial(torch.randn, generator=generator, dtype=dtype)
    scores = torch.rand(verts, joints, generator=generator, dtype=dtype)
    kept = scores.topk(held, dim=1).indices
    dense = torch.zeros_like(scores).scatter(1, kept, scores.gather(1, kept))
    dense = dense * (torch.rand(verts, joints, generator=generator) > 0.3)  # rows of different lengths, some empty
    return draw(bodies, verts, 3), draw(bodies, joints, 3, 4), skin_weights(dense)


def test_reference_is_the_formula() -> None:
    verts, moves, weights = _scene(2, 7, 5, 3, torch.float64)
    expected = torch.zeros_like(verts)
    for b in range(2):
        for v in range(7):
            for joint, weight in zip(weights.joints[v].tolist(), weights.weights[v], strict=True):
                move = moves[b, joint]
                expected[b, v] += weight * (move[:, :3] @ verts[b, v] + move[:, 3])
    torch.testing.assert_close(reference.skin(verts, moves, *weights), expected)


def test_reference_gradients() -> None:
    verts, moves, weights = _scene(2, 4, 3, 2, torch.float64)
    leaves = verts.requires_grad_(), moves.requires_grad_()
    assert gradcheck(lambda x, m: skin(x, m, weights), leaves)
    assert gradgradcheck(lambda x, m: skin(x, m, weights), leaves)
    dense = torch.rand(4, 3, dtype=torch.float64, requires_grad=True)
    assert gradcheck(reference.skin_dense, (*leaves, dense))


def test_reference_in_blocks_of_bodies(monkeypatch: pytest.MonkeyPatch) -> None:
    verts, moves, weights = _scene(5, 40, 6, 3, torch.float64)
    verts.requires_grad_(), moves.requires_grad_()
    whole = reference.skin(verts, moves, *weights)
    grads = torch.autograd.grad(whole.square().sum(), (verts, moves))
    monkeypatch.setattr(reference, "_NUMBERS_AT_ONCE", 12 * 40 * 2)
    parts = reference.skin(verts, moves, *weights)
    torch.testing.assert_close(parts, whole)
    torch.testing.assert_close(torch.autograd.grad(parts.square().sum(), (verts, moves)), grads)


@pytest.mark.parametrize(
    ("bodies", "verts", "joints", "held"),
    [(1, 1, 1, 1), (3, 17, 24, 4), (2, 1024, 5, 5), (2, 1025, 24, 4), (1, 2500, 55, 8), (0, 9, 4, 2), (4, 0, 3, 1)],
)
def test_kernel_equals_reference(bodies: int, verts: int, joints: int, held: int) -> None:
    x, moves, weights = _scene(bodies, verts, joints, held)
    upstream = torch.randn(x.shape)
    results = []
    for run in (skin, lambda x, m, w: reference.skin(x, m, *w)):
        leaves = x.clone().requires_grad_(), moves.clone().requires_grad_()
        out = run(*leaves, weights)
        results.append((out, *torch.autograd.grad(out, leaves, upstream)))
    for ours, expected in zip(*results, strict=True):
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)


def test_any_number_of_threads_gives_the_same_bits() -> None:
    x, moves, weights = _scene(3, 3000, 24, 4)
    upstream, threads, results = torch.randn(x.shape), torch.get_num_threads(), []
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            leaves = x.clone().requires_grad_(), moves.clone().requires_grad_()
            out = skin(*leaves, weights)
            results.append((out, *torch.autograd.grad(out, leaves, upstream)))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True))


def test_strided_input() -> None:
    x, moves, weights = _scene(3, 50, 6, 3)
    backwards = x.flip(0).flip(0).transpose(0, 1).contiguous().transpose(0, 1)
    spread = moves[:1].expand(3, -1, -1, -1)
    torch.testing.assert_close(skin(backwards, spread, weights), skin(x, spread.contiguous(), weights))


def test_every_output_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    x, moves, weights = _scene(2, 1100, 4, 2)
    monkeypatch.setattr(torch, "empty_like", lambda t, **_: torch.full(t.shape, torch.nan))
    leaves = x.requires_grad_(), moves.requires_grad_()
    out = skin(*leaves, weights)
    assert out.isfinite().all()
    assert all(grad.isfinite().all() for grad in torch.autograd.grad(out.sum(), leaves))


def test_registered_as_torch_expects() -> None:
    x, moves, weights = _scene(2, 30, 4, 2)
    arguments = (x.requires_grad_(), moves.flatten(2).requires_grad_(), *weights)
    torch.library.opcheck(torch.ops.rendra.skin.default, arguments)


def test_weights_without_zeros() -> None:
    dense = torch.tensor([[0.0, 0.25, 0.0, 0.75], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    joints, weights = skin_weights(dense)
    assert joints.tolist() == [[3, 1], [0, 0], [0, 0]]
    assert weights.tolist() == [[0.75, 0.25], [1.0, 0.0], [0.0, 0.0]]
    assert skin_weights(torch.zeros(0, 4)).joints.shape == (0, 1)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda x, m, w: (x[0], m, w), r"verts must be floats of shape \(B, V, 3\), got \(5, 3\)"),
        (lambda x, m, w: (x, m[:1], w), r"moves must have shape \(2, J, 3, 4\).*got \(1, 4, 3, 4\)"),
        (lambda x, m, w: (x, m[..., :3], w), r"moves must have shape"),
        (lambda x, m, w: (x[:, 1:], m, w), r"must both have shape \(4, K\)"),
        (lambda x, m, w: (x, m.double(), w), r"moves must be torch.float32, like verts, got torch.float64"),
        (lambda x, m, w: (x, m, SkinWeights(w.joints.long(), w.weights)), r"joints must be int32"),
        (lambda x, m, w: (x, m, SkinWeights(w.joints + 4, w.weights)), r"joints must name joints 0 to 3, got 4 to"),
    ],
)
def test_refusals(change: object, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        skin(*change(*_scene(2, 5, 4, 2)))  # type: ignore[operator]
    with pytest.raises(ValueError, match="weights must be floats of shape"):
        skin_weights(torch.ones(3, 4, dtype=torch.long))
