"""Where cameras stand about an object."""

import pytest
import torch

from rendra.renderer import look_at_view_transform
from rendra_lab.data.camera_rigs import look_at_origin, rig
from rendra_lab.errors import UserError

VIEWS = ("sphere", "ring", "forward")


@pytest.mark.parametrize("views", VIEWS)
@pytest.mark.parametrize("counts", [(40, 4, 10), (1, 1, 1), (2, 0, 3), (7, 30, 50)])
def test_held_out_views_lie_between_training_views(views: str, counts: tuple[int, int, int]) -> None:
    train, val, test = rig(views, counts, 2.7, seed=3)
    assert (len(train), len(val), len(test)) == counts
    held_out = torch.cat([val, test])
    assert torch.cdist(held_out, train).min() > 0.02
    assert len(held_out) < 2 or torch.pdist(held_out).min() > 1e-3


@pytest.mark.parametrize("views", ["sphere", "ring"])
def test_all_stand_at_the_distance(views: str) -> None:
    for positions in rig(views, (40, 4, 10), 2.7):
        torch.testing.assert_close(positions.norm(dim=1), torch.full((len(positions),), 2.7))


def test_a_sphere_is_covered_evenly() -> None:
    train, val, test = rig("sphere", (40, 4, 10), 1.0)
    nearest = torch.cdist(train, train).fill_diagonal_(9).amin(1)
    spacing = (4 * torch.pi / 40) ** 0.5
    assert 0.7 * spacing < nearest.min()
    assert nearest.max() < 1.3 * spacing
    assert torch.cdist(torch.cat([val, test]), train).amin(1).min() > 0.5 * spacing
    assert train[:, 1].abs().max() > 0.97  # nearly from the poles too


def test_the_ring_is_the_books() -> None:
    train, val, test = rig("ring", (40, 4, 10), 2.7)
    R, T = look_at_view_transform(2.7, torch.zeros(40), torch.linspace(-180, 180, 40) + 180)
    ours = look_at_origin(train)
    torch.testing.assert_close(ours[0], R, atol=1e-5, rtol=0)
    torch.testing.assert_close(ours[1], T, atol=1e-5, rtol=0)
    torch.testing.assert_close(train[0], train[-1], atol=1e-5, rtol=0)
    assert torch.cat([val, test])[:, 1].abs().max() == 0


def test_forward_cameras_face_one_way() -> None:
    R, _ = look_at_origin(torch.cat(rig("forward", (12, 2, 3), 2.7)))
    assert R[:, 2, 2].min() > 0.85  # the view axis in the world is nearly +Z


def test_the_seed_turns_a_sphere() -> None:
    first, again, other = (rig("sphere", (8, 2, 2), 2.7, seed) for seed in (1, 1, 2))
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.allclose(first[0], other[0])
    torch.testing.assert_close(first[0][:, 1], other[0][:, 1])


@pytest.mark.parametrize(
    ("views", "counts", "distance", "words"),
    [
        ("circle", (4, 1, 1), 1.0, "data.views must be one of sphere, ring, forward"),
        ("ring", (0, 1, 1), 1.0, "at least 1"),
        ("ring", (3, -1, 1), 1.0, "data.counts"),
        ("ring", (3, 1, 1), 0.0, "data.distance"),
    ],
)
def test_what_cannot_be_is_said(views: str, counts: tuple[int, int, int], distance: float, words: str) -> None:
    with pytest.raises(UserError, match=words):
        rig(views, counts, distance)
