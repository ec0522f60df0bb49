"""Photographs of furnished rooms: what is said of objects is what a camera sees of their models."""

import numpy as np
import pytest
import torch

from rendra.structures import Meshes
from rendra_lab.synthesis.furnished_rooms import NOBODY, RoomPhoto, room_photos
from rendra_lab.synthesis.furniture import CLASSES, NAMES, draw_finish
from rendra_lab.synthesis.furniture_models import FurnitureModels, model_id, parsed_model_id
from rendra_lab.synthesis.rooms_shell import Placed
from rendra_lab.synthesis.rooms_staging import hanging, leaning, lying, stage
from rendra_lab.synthesis.solids import weld
from rendra_lab.synthesis.surface_pictures import faces_seen

SIZE = (64, 80)
MODELS = FurnitureModels(per_name=4, seed=1)
WANTED = ("tool", "bed", "chair")


@pytest.fixture(scope="module")
def photos() -> list[RoomPhoto]:
    return room_photos(1, WANTED, MODELS.stock(range(4)), SIZE)


def test_each_photograph_shows_what_is_wanted_and_few_others(photos: list[RoomPhoto]) -> None:
    assert len(photos) == 3
    for photo, kind in zip(photos, WANTED, strict=True):
        assert CLASSES.index(kind) in photo.labels
        assert 1 <= len(photo.labels) <= 4
        assert sorted(set(photo.owner.unique().tolist()) - {NOBODY}) == list(range(len(photo.labels)))
        assert photo.rgb.float().std() > 5


def test_masks_lie_in_the_silhouettes_of_models_placed_by_their_poses(photos: list[RoomPhoto]) -> None:
    for photo in photos:
        for number, (name, model) in enumerate(photo.models.tolist()):
            verts, faces, _ = weld(MODELS.model(NAMES[name], model).solids)
            mesh = Meshes([torch.from_numpy(verts)], [torch.from_numpy(faces)])
            face, _ = faces_seen(mesh, photo.intrinsics, photo.model_to_camera[number], SIZE)
            mask, outline = photo.owner == number, face >= 0
            strays = int((mask & ~outline).sum())
            assert strays <= 0.01 * int(mask.sum()), "only rounding may put a pixel of an edge outside"
            share = float((mask & outline).sum() / outline.sum())
            assert share == pytest.approx(float(photo.free[number]), abs=0.02)


def test_poses_are_rigid_and_objects_stand_before_the_camera(photos: list[RoomPhoto]) -> None:
    for photo in photos:
        turn = photo.model_to_camera[:, :3, :3]
        eye = torch.eye(3).expand_as(turn)
        torch.testing.assert_close(turn @ turn.mT, eye, atol=1e-5, rtol=0)
        torch.testing.assert_close(torch.linalg.det(turn), torch.ones(len(turn)), atol=1e-5, rtol=0)


def test_a_seed_is_a_photograph(photos: list[RoomPhoto]) -> None:
    again = room_photos(1, WANTED, MODELS.stock(range(4)), SIZE)
    for one, other in zip(photos, again, strict=True):
        for name in RoomPhoto.names():
            assert torch.equal(getattr(one, name), getattr(other, name)), name


def test_wanted_classes_stand_in_rooms_as_their_models_stand_in_their_places() -> None:
    extent = (5.0, 2.6, 5.0)
    found = 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stock = MODELS.stock(range(2))
        placed = stage(extent, (), rng, wanted=CLASSES, stock=stock).placed
        pieces = [one for one in placed if one.piece is not None]
        found += len({one.piece.kind for one in pieces if one.piece is not None})
        for one in pieces:
            assert one.piece is not None
            assert parsed_model_id(one.piece.model)[1] < 2
            own = np.concatenate([solid.points for solid in one.piece.solids])
            there = np.concatenate([solid.points for solid in one.in_room()])
            matrix = one.to_room()
            np.testing.assert_allclose(own @ matrix[:3, :3].T + matrix[:3, 3], there, atol=2e-5)
            assert there.min() > -0.02
            assert (there < np.array(extent) + 0.02).all()
    assert found >= 3 * len(CLASSES) - 3, "all nine, but where there was no place left"


@pytest.mark.parametrize("tilted", [lying, leaning, hanging])
@pytest.mark.parametrize("name", ["hammer", "screwdriver", "broom"])
def test_tilted_pieces_touch_the_floor_over_the_origin(tilted, name: str) -> None:
    piece = MODELS.model(name, 0)
    low, high = Placed.of(piece, (0.0, 0.0, 0.0), tilt=tilted(piece)).bounds()
    np.testing.assert_allclose([low[1], low[0] + high[0], low[2] + high[2]], 0, atol=1e-5)
    tall = piece.bounds()[1, 1]
    assert (high[1] < 0.5 * tall) == (tilted is lying)


@pytest.mark.parametrize("name", NAMES)
def test_a_model_is_a_shape_whatever_it_is_made_of(name: str) -> None:
    finish = draw_finish(np.random.default_rng(8))
    one, other = MODELS.model(name, 1, finish), MODELS.model(name, 1)
    assert one.model == other.model == model_id(name, 1)
    assert parsed_model_id(one.model) == (name, 1)
    for first, second in zip(weld(one.solids)[:2], weld(other.solids)[:2], strict=True):
        np.testing.assert_array_equal(first, second)
    differs = weld(one.solids)[0].shape != weld(MODELS.model(name, 2).solids)[0].shape
    assert differs or not np.allclose(weld(one.solids)[0], weld(MODELS.model(name, 2).solids)[0])


def test_what_is_not_in_the_collection_is_refused() -> None:
    with pytest.raises(ValueError, match="4 models each of: table"):
        MODELS.model("table", 4)
    with pytest.raises(ValueError, match="'throne'"):
        MODELS.model("throne", 0)
    with pytest.raises(ValueError, match="at least one model"):
        MODELS.stock(range(0))
    with pytest.raises(ValueError, match="at least 1 model"):
        FurnitureModels(0)
