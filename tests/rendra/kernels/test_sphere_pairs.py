"""The broad phase of balls against its specification: the same pairs, to the last."""

import itertools

import pytest
import torch
from torch import Tensor

from rendra.kernels.sphere_pairs import reference, sphere_pairs


def random(seed: int, *shape: int) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def scene(bodies: int, balls: int, groups: int, radius: float, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    middles, radii = random(seed, bodies, balls, 3), radius * random(seed + 1, bodies, balls)
    return middles, radii, (random(seed + 2, balls) * groups).long()


def flawed() -> tuple[Tensor, Tensor, Tensor]:
    middles, radii, groups = scene(4, 40, 3, 0.5)
    middles[0, 3, 1], middles[1, 5], radii[2, 7], radii[3, 8] = torch.nan, torch.inf, torch.nan, torch.inf
    middles[1, 6, 0], middles[1, 6, 1] = torch.inf, -torch.inf
    return middles, radii, groups


def lattice() -> tuple[Tensor, Tensor, Tensor]:
    """Neighbours touch exactly, and many begin at one place."""
    middles = torch.cartesian_prod(*[torch.arange(4.0)] * 3)[None]
    return middles, torch.full((1, 64), 0.5), torch.arange(64) % 3


SCENES = {
    "a few": scene(3, 20, 4, 0.3),
    "many bodies": scene(70, 57, 20, 0.2),
    "many balls": scene(2, 1500, 5, 0.05),
    "large and small": (*scene(2, 400, 2, 1.0)[:1], torch.where(random(9, 2, 400) < 0.05, 0.5, 1e-3),
                        torch.arange(400) % 2),
    "coinciding": (torch.ones(2, 30, 3), torch.rand(2, 30), torch.arange(30) % 4),
    "points": (random(3, 1, 50, 3).round(), torch.zeros(1, 50), torch.zeros(50, dtype=torch.int64)),
    "touching": lattice(),
    "not finite": flawed(),
    "far away": (1e6 + 8 * random(5, 1, 300, 3), random(6, 1, 300), torch.arange(300) % 2),
    "huge": (3e38 * (random(7, 1, 20, 3) - 0.5), 1e38 * random(8, 1, 20), torch.zeros(20, dtype=torch.int64)),
    "one ball": scene(3, 1, 1, 1.0),
    "no ball": scene(3, 0, 1, 1.0),
    "no body": scene(0, 5, 2, 1.0),
}  # fmt: skip
PAIRS = {
    "one": [[0, 1]],
    "all, some twice": [[0, 0], [1, 0], [0, 1], [1, 1], [2, 1], [0, 2], [2, 2], [2, 2]],
    "of a group that no ball is in": [[0, 10**12], [1, 1]],
    "none": [],
}


@pytest.mark.parametrize("pairs", PAIRS)
@pytest.mark.parametrize("name", SCENES)
def test_equals_the_reference(name: str, pairs: str) -> None:
    arguments = (*SCENES[name], torch.tensor(PAIRS[pairs], dtype=torch.int64).reshape(-1, 2))
    fast, slow = sphere_pairs(*arguments), reference.sphere_pairs(*arguments)
    for mine, theirs in zip(fast, slow, strict=True):
        assert mine.dtype == torch.int64
        assert torch.equal(mine, theirs)


def test_the_reference_is_the_formula() -> None:
    middles, radii, groups = SCENES["a few"]
    first, pairs = reference.sphere_pairs(middles, radii, groups, torch.tensor([[1, 2], [3, 3]]))
    expected = [
        [
            [i, j]
            for i in range(20)
            for j in range(i + 1, 20)
            if sorted((int(groups[i]), int(groups[j]))) in ([1, 2], [3, 3])
            and (middles[body, i] - middles[body, j]).norm() < radii[body, i] + radii[body, j]
        ]
        for body in range(3)
    ]
    assert [pairs[a:b].tolist() for a, b in itertools.pairwise(first.tolist())] == expected
    assert len(pairs) > 5


def test_the_references_chunks_join(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = {}
    for size in (1, 90, 4000, 2**21):
        monkeypatch.setattr(reference, "_PAIRS_AT_ONCE", size)
        whole[size] = reference.sphere_pairs(*SCENES["a few"], torch.tensor([[0, 1], [2, 3]]))
    assert all(torch.equal(a, b) for got in whole.values() for a, b in zip(got, whole[1], strict=True))


def test_balls_that_touch_do_not_meet() -> None:
    middles, radii, groups = lattice()
    every = torch.cartesian_prod(torch.arange(3), torch.arange(3))
    assert len(sphere_pairs(middles, radii, groups, every)[1]) == 0
    assert len(sphere_pairs(middles, 1.0001 * radii, groups, every)[1]) == 3 * 4 * 4 * 3  # the edges of the lattice


def test_results_do_not_depend_on_threads() -> None:
    threads, results = torch.get_num_threads(), []
    for number in (1, 2, 3):
        torch.set_num_threads(number)
        results.append(sphere_pairs(*SCENES["many bodies"], torch.tensor([[0, 1], [2, 3], [4, 4], [5, 9]])))
    torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for got in results for a, b in zip(got, results[0], strict=True))


def test_what_is_on_another_layout_or_type() -> None:
    middles, radii, groups = SCENES["many balls"]
    pairs = torch.tensor([[0, 1]])
    turned = middles.permute(2, 1, 0).contiguous().permute(2, 1, 0)
    assert torch.equal(sphere_pairs(turned, radii, groups, pairs)[1], sphere_pairs(middles, radii, groups, pairs)[1])
    wide = sphere_pairs(middles.double(), radii.double(), groups, pairs)
    assert torch.equal(wide[1], sphere_pairs(middles, radii, groups, pairs)[1])


def test_the_operator_is_well_registered() -> None:
    arguments = (*SCENES["a few"], torch.tensor([[0, 1]]))
    torch.library.opcheck(torch.ops.rendra.sphere_pairs.default, arguments)


def test_bad_input_is_named() -> None:
    middles, radii, groups = SCENES["a few"]
    pairs = torch.tensor([[0, 1]])
    with pytest.raises(
        ValueError, match=r"centers must be floats of shape \(N, S, 3\), got torch.float32 of \(3, 20"
    ):
        sphere_pairs(middles[..., :2], radii, groups, pairs)
    with pytest.raises(ValueError, match=r"radii must be floats of shape \(3, 20\), got torch.float32 of \(3, 19\)"):
        sphere_pairs(middles, radii[:, 1:], groups, pairs)
    with pytest.raises(ValueError, match=r"groups must be int64 of shape \(20,\), got torch.int32"):
        sphere_pairs(middles, radii, groups.int(), pairs)
    with pytest.raises(ValueError, match=r"group_pairs must be int64 of shape \(K, 2\), got torch.int64 of \(2,\)"):
        sphere_pairs(middles, radii, groups, pairs[0])
    with pytest.raises(ValueError, match="radii must be at least 0, got -1"):
        sphere_pairs(middles, radii - 1 - radii, groups, pairs)
    with pytest.raises(ValueError, match="group_pairs must be at least 0, got -1"):
        sphere_pairs(middles, radii, groups, pairs - 1)


@pytest.mark.gpu
def test_cuda_takes_the_reference() -> None:
    arguments = (*SCENES["many bodies"], torch.tensor([[0, 1], [2, 2]]))
    there = sphere_pairs(*(tensor.cuda() for tensor in arguments))
    for mine, theirs in zip(there, sphere_pairs(*arguments), strict=True):
        assert torch.equal(mine.cpu(), theirs)
