"""Scenes of solids: none touches another, each is seen, and a seed is a picture."""

import itertools
import math

import pytest
import torch

from rendra_lab.errors import UserError
from rendra_lab.synthesis.clevr_like import COLORS, MATERIALS, SHAPES, SIZES, ClevrLike, name_of
from rendra_lab.synthesis.object_pictures import ObjectWorld

SEEDS = list(range(12))


@pytest.fixture(scope="module")
def world() -> ClevrLike:
    return ClevrLike(samples=1)


def test_solids_keep_their_distance_and_stay_within_reach(world: ClevrLike) -> None:
    counts = set()
    for seed in range(40):
        things, _ = world.scene(seed)
        counts.add(len(things))
        assert max(abs(part) for thing in things for part in thing.place) <= world.reach
        for one, other in itertools.combinations(things, 2):
            room = world.sizes[one.size] + world.sizes[other.size] + world.gap
            assert math.dist(one.place, other.place) >= room
    assert counts == {2, 3, 4, 5}


def test_every_solid_is_seen_and_none_leaves_the_picture(world: ClevrLike) -> None:
    made = world.pictures(SEEDS, 64)
    for owners, kinds in zip(made.owners, made.kind, strict=True):
        count = int((kinds >= 0).sum())
        areas = owners.flatten().long().bincount(minlength=6)[1:]
        assert (areas[:count] >= 0.8 * world.least_shown * 64**2).all()
        assert not areas[count:].any()
        assert not owners[0].any()
        assert not owners[-1].any()


def test_a_seed_is_a_picture_whatever_else_is_asked_for(world: ClevrLike) -> None:
    assert isinstance(world, ObjectWorld)
    many = world.pictures(SEEDS, 16)
    alone = world.pictures([SEEDS[3]], 16)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        again = world.pictures(SEEDS, 16)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(many.rgb, again.rgb)
    assert torch.equal(many.rgb[3], alone.rgb[0])
    assert torch.equal(many.owners[3], alone.owners[0])
    assert not torch.equal(many.rgb[3], many.rgb[4])
    assert many.heading.isnan().all()
    assert world.pictures([], 16).rgb.shape == (0, 3, 16, 16)


def test_settings_tell_worlds_apart() -> None:
    worlds = [ClevrLike(), ClevrLike(gap=0.05), ClevrLike(objects=(2, 4)), ClevrLike(camera_v=(0.3, 0.3))]
    worlds += [ClevrLike(samples=2), ClevrLike(least_shown=0.0), ClevrLike(fov_deg=30.0), ClevrLike(reach=0.5)]
    worlds += [ClevrLike(sizes=(0.1, 0.15))]
    assert len({repr(world.settings()) for world in worlds}) == len(worlds)
    assert repr(ClevrLike().settings()) == repr(ClevrLike(objects=[2, 5]).settings())


def test_kinds_have_names_of_their_own(world: ClevrLike) -> None:
    names = [name_of(kind) for kind in range(96)]
    assert len(set(names)) == len(SHAPES) * len(COLORS) * len(MATERIALS) * len(SIZES) == 96
    things, _ = world.scene(5)
    first = things[0]
    words = [SIZES[first.size], list(COLORS)[first.color], MATERIALS[first.material], SHAPES[first.shape]]
    assert name_of(first.kind).split() == words
    with pytest.raises(ValueError, match="96 kinds"):
        name_of(96)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"objects": (5, 2)}, r"data.world.objects must be two whole numbers from 1 to 8.*\[5, 2\]"),
        ({"objects": (1.5, 2)}, "data.world.objects must be two whole numbers"),
        ({"sizes": (0.1,)}, "data.world.sizes must be two numbers"),
        ({"camera_v": (0.3, 0.9)}, "data.world.camera_v must be two numbers from 0.01 to 0.5"),
        ({"fov_deg": 0.5}, "data.world.fov_deg must be a number from 1 to 150"),
        ({"least_shown": 2.0}, "data.world.least_shown"),
    ],
)
def test_what_cannot_be_is_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(UserError, match=message):
        ClevrLike(**settings)  # type: ignore[arg-type]


def test_a_world_too_crowded_says_which_settings_would_help() -> None:
    crowded = ClevrLike(objects=(8, 8), sizes=(0.3, 0.3))
    with pytest.raises(UserError, match=r"8 solids find no room.*data.world.reach=0.42 must be more"):
        crowded.scene(0)
