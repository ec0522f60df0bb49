"""Photographs of cows: by the generator's camera, whole, turned as is said, apart from what is behind them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from rendra_lab.synthesis import cow_photos
from rendra_lab.synthesis.backdrops import draw_backdrop, sights
from rendra_lab.synthesis.cow_herd import COATS
from rendra_lab.synthesis.cow_photos import CowWorld
from rendra_lab.synthesis.object_pictures import ObjectPictures, ObjectWorld
from rendra_lab.tasks.giraffe.camera_sampler import CameraSampler
from rendra_lab.tasks.giraffe.generated_pictures import GeneratedPictures, masks_of

SIDE = 48
CONF = Path(__file__).parents[3] / "conf"


@pytest.fixture(scope="module", autouse=True)
def small_herd() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cow_photos, "BUILDS", 2)
        yield


@pytest.fixture(scope="module")
def photos() -> ObjectPictures:
    return CowWorld().pictures(range(60), SIDE)


def test_pictures_are_bytes_with_a_truth(photos: ObjectPictures) -> None:
    assert isinstance(CowWorld(), ObjectWorld)
    assert photos.rgb.shape == (60, 3, SIDE, SIDE)
    assert photos.rgb.float().std() > 30
    assert photos.heading.shape == photos.kind.shape == (60, 1)
    assert 0 <= float(photos.heading.min()) < 1 < 5 < float(photos.heading.max()) <= 2 * math.pi
    assert set(photos.kind.flatten().tolist()) == set(range(len(COATS)))
    assert photos.owners.unique().tolist() == [0, 1]


def test_every_cow_is_whole_and_of_its_size(photos: ObjectPictures) -> None:
    border = torch.ones(SIDE, SIDE, dtype=torch.bool)
    border[1:-1, 1:-1] = False
    assert int(photos.owners[:, border].sum()) == 0
    share = photos.owners.float().mean((1, 2))
    assert 0.02 < float(share.min()) < float(share.max()) < 0.15


def test_heads_are_where_headings_point(photos: ObjectPictures) -> None:
    """Horns are the highest, and +y is to the right in the picture."""
    columns = torch.arange(SIDE).float()
    checked = 0
    for owner, heading in zip(photos.owners.bool(), photos.heading.flatten().tolist(), strict=True):
        if abs(math.sin(heading)) > 0.7:
            top = owner[owner.any(1)][0].float()
            head, middle = ((columns * weight).sum() / weight.sum() for weight in (top, owner.float().sum(0)))
            assert (head > middle) == (math.sin(heading) > 0)
            checked += 1
    assert checked > 20


def test_a_seed_is_a_picture_whatever_others_are_asked_for(photos: ObjectPictures) -> None:
    some = CowWorld().pictures([41, 3], SIDE)
    for name in ObjectPictures.names():
        assert torch.equal(getattr(some, name), getattr(photos, name)[[41, 3]])
    none = CowWorld().pictures([], SIDE)
    assert [len(getattr(none, name)) for name in ObjectPictures.names()] == [0] * 4
    assert none.rgb.dtype == none.owners.dtype == torch.uint8


def test_pictures_do_not_depend_on_threads(photos: ObjectPictures) -> None:
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        assert torch.equal(CowWorld().pictures([5], SIDE).rgb, photos.rgb[[5]])
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(threads)


def test_cows_differ_from_what_is_around_them(photos: ObjectPictures) -> None:
    apart = []
    for rgb, owner in zip(photos.rgb.float() / 255, photos.owners.bool(), strict=True):
        near = torch.nn.functional.max_pool2d(owner[None].float(), 7, 1, 3)[0].bool() & ~owner
        apart.append((rgb[:, owner] - rgb[:, near].mean(1)[:, None]).norm(dim=0).mean())
    assert float(torch.stack(apart).min()) > 0.15
    assert float(torch.stack(apart).median()) > 0.35


def test_the_camera_is_that_of_the_generators_world() -> None:
    world = yaml.safe_load((CONF / "world" / "cow_photos.yaml").read_text())
    settings = {name: value for name, value in world["cameras"].items() if name != "_target_"}
    assert settings["fov_deg"] == cow_photos.FOV_DEG
    assert tuple(settings["polar"]) == cow_photos.POLAR
    assert settings["radius"] == [cow_photos.DISTANCE] * 2
    sampler = CameraSampler(**settings)
    camera = cow_photos._camera(np.random.default_rng(3))
    v = (1 - camera.eye[2] / cow_photos.DISTANCE) / 2
    theirs = sampler.at(torch.zeros(1), v[None], torch.full((1,), cow_photos.DISTANCE), torch.zeros(1))
    torch.testing.assert_close(theirs.camera_to_world[0, :3], torch.cat([camera.axes, camera.eye[:, None]], 1))
    torch.testing.assert_close(sampler.rays(theirs, 6).directions[0], camera.rays(6))


def test_boxes_of_the_generators_world_hold_cows() -> None:
    boxes = yaml.safe_load((CONF / "world" / "cow_photos.yaml").read_text())["boxes"]
    assert boxes["translation"] == [[-cow_photos.SPREAD] * 2 + [0.0], [cow_photos.SPREAD] * 2 + [0.0]]
    herd = torch.stack([cow_photos._cow(number, 3000).half_sides for number in range(2)])
    for length, box in zip(cow_photos.HALF_LENGTH, boxes["scale"], strict=True):
        padded = 1.1 * torch.tensor(box)  # fields reach a tenth further
        assert bool((length * herd < padded).all())
        assert box[0] == pytest.approx(1.1 * length)


def test_rasterised_and_traced_samples_are_the_same() -> None:
    """The middle of the world is the middle of the picture for both."""
    camera = cow_photos._camera(np.random.default_rng(1))
    ray = camera.rays(3)[4]
    torch.testing.assert_close(camera.eye + cow_photos.DISTANCE * ray, torch.zeros(3), atol=1e-6, rtol=0)
    point = torch.tensor([[0.1, 0.2, 0.05]])
    corner = torch.tensor([[[0.0, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]]])
    side = 256
    mesh = cow_photos.Meshes(point + corner, torch.tensor([[[0, 1, 2]]]))
    hit = (camera.rasterizer(side)(mesh).pix_to_face.flatten() >= 0).nonzero()[:, 0]
    way = torch.nn.functional.normalize(camera.rays(side)[hit], dim=1)
    aim = torch.nn.functional.normalize(mesh.verts_padded()[0].mean(0) - camera.eye, dim=0)
    assert float((way @ aim).min()) > math.cos(math.radians(0.5))


def test_a_cow_darkens_the_ground_under_it() -> None:
    rng = np.random.default_rng(2)
    place = draw_backdrop(rng)
    light = cow_photos._light(rng)
    camera = cow_photos._camera(rng)
    seen = sights(place, camera.eye, camera.rays(16), -0.15)
    nothing, all_of_it = torch.zeros(256), torch.ones(256)
    open_air = cow_photos._lit(seen, light, nothing, nothing)
    shaded = cow_photos._lit(seen, light, all_of_it, nothing)
    assert bool((shaded[seen.on_ground] < open_air[seen.on_ground]).all())
    assert torch.equal(shaded[~seen.on_ground], open_air[~seen.on_ground])


def test_they_are_data_for_training(photos: ObjectPictures) -> None:
    data = GeneratedPictures(CowWorld(), image_size=16, counts=[2, 1, 1], batch_size=2)
    data.setup("fit")
    (batch,) = list(data.train_dataloader())
    assert batch.rgb.shape == (2, 3, 16, 16)
    assert batch.truth is None
    (held_out,) = list(data.test_dataloader())
    assert held_out.truth is not None
    assert bool(masks_of(photos.owners, 1).any())
    assert bool(held_out.truth.masks.any())
