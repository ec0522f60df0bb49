"""data=cow_views: its scene, its splits and its cache."""

import logging
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from rendra.renderer import AmbientLights, PointLights, TexturesVertex
from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab.data.mesh_photographs import MeshPhotographer
from rendra_lab.data.rendered_scenes import RenderedScene
from rendra_lab.errors import UserError
from rendra_lab.pictures import Headlight


def ball(radius: float = 1.0, grey: float = 1.0) -> Meshes:
    sphere = ico_sphere(2)
    verts = sphere.verts_packed() * radius
    return Meshes([verts], [sphere.faces_packed()], TexturesVertex([torch.full_like(verts, grey)]))


def scene(cache: Path | None = None, mesh: Meshes | None = None, **settings: Any) -> RenderedScene:
    usual: dict[str, Any] = {"image_size": 16, "counts": (5, 1, 2), "lights": PointLights(location=[[0, 0, -3.0]])}
    return RenderedScene(ball() if mesh is None else mesh, cache=cache, **(usual | settings))


def cached(folder: Path) -> list[Path]:
    return sorted(folder.iterdir())


def test_views_are_divided_and_the_truth_is_known() -> None:
    made = scene(image_size=[12, 20])
    found = made.load()
    assert [len(part) for part in (found.train, found.val, found.test)] == [5, 1, 2]
    assert found.train.labels[0] == "train/000"
    assert found.test.labels == ("test/000", "test/001")
    assert found.train.sizes.tolist() == [[12, 20]] * 5
    assert torch.cdist(found.train.positions, torch.cat([found.val.positions, found.test.positions])).min() > 0.1
    assert found.truth is made.mesh
    assert found.up == (0, 1, 0)
    assert found.train.has_alpha


def test_the_box_holds_the_mesh_and_little_else() -> None:
    box = scene(image_size=32, counts=(40, 0, 0)).load().box
    assert bool((box[0] < -0.99).all())
    assert bool((box[1] > 0.99).all())
    assert bool(((box[1] - box[0]) < 2.8).all())


def test_there_may_be_no_held_out_views() -> None:
    found = scene(counts=(3, 0, 0)).load()
    assert (len(found.train), len(found.val), len(found.test)) == (3, 0, 0)


def test_rays_come_out_as_batches() -> None:
    made = scene(rays_per_step=50, background="white")
    made.setup("fit")
    batch = next(iter(made.train_dataloader()))
    assert batch.rgb.shape == (50, 3)
    whole = next(iter(made.test_dataloader()))
    assert whole.mask.shape == (1, 16, 16)
    assert float(whole.rgb[whole.mask == 0].min()) == 1


def test_same_settings_same_pixels() -> None:
    first, again, other = (scene(views_seed=seed).load().train for seed in (1, 1, 2))
    assert torch.equal(first.pixels, again.pixels)
    assert not torch.equal(first.pixels, other.pixels)


def test_the_cache_gives_the_same_pixels_without_rendering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = scene(tmp_path / "cache").load()
    assert len(cached(tmp_path / "cache")) == 1
    monkeypatch.setattr(MeshPhotographer, "take", None)
    again = scene(tmp_path / "cache").load()
    assert torch.equal(first.train.pixels, again.train.pixels)
    assert torch.equal(first.test.pixels, again.test.pixels)


@pytest.mark.parametrize("damage", ["cut", "flipped", "garbage", "empty"])
def test_a_broken_cache_is_made_anew(tmp_path: Path, damage: str, caplog: pytest.LogCaptureFixture) -> None:
    first = scene(tmp_path).load()
    path = cached(tmp_path)[0]
    whole = path.read_bytes()
    damaged = {
        "cut": whole[:-100],
        "flipped": whole[:-50] + bytes([whole[-50] ^ 255]) + whole[-49:],
        "garbage": b"not a file of ours" * 10,
        "empty": b"",
    }
    path.write_bytes(damaged[damage])
    with caplog.at_level(logging.WARNING):
        again = scene(tmp_path).load()
    assert "are made anew" in caplog.text
    assert torch.equal(first.train.pixels, again.train.pixels)
    assert cached(tmp_path) == [path]
    assert path.read_bytes() == whole


def test_everything_that_makes_the_pixels_is_in_the_key(tmp_path: Path) -> None:
    variants: list[dict[str, Any]] = [
        {},
        {"mesh": ball(0.9)},
        {"mesh": ball(grey=0.5)},
        {"lights": AmbientLights()},
        {"lights": PointLights(location=[[0, 0, -2.0]])},
        {"image_size": 17},
        {"views": "ring"},
        {"counts": (5, 1, 1)},
        {"distance": 2.6},
        {"fov_deg": 61.0},
        {"distortion": [0.01]},
        {"antialias": 2},
        {"views_seed": 1},
    ]
    for variant in variants:
        scene(tmp_path, **variant)._cached_or_taken()
    assert len(cached(tmp_path)) == len(variants)
    scene(tmp_path, rays_per_step=7, background="black", seed=5)._cached_or_taken()  # does not
    assert len(cached(tmp_path)) == len(variants)


def test_a_cache_that_cannot_be_written_is_no_obstacle(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("in the way")
    with caplog.at_level(logging.WARNING):
        assert len(scene(tmp_path / "file" / "cache").load().train) == 5
    assert "cannot be cached" in caplog.text


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"lights": Headlight()}, "Headlight moves with the camera"),
        ({"image_size": 0}, r"data\.image_size must be one side or \[height,width\]"),
        ({"image_size": [4, 5, 6]}, r"data\.image_size"),
        ({"counts": [4, 5]}, r"data\.counts are three"),
        ({"distortion": [0.1, math.nan]}, r"data\.distortion holds finite numbers, got \[0\.1, nan\]"),
        ({"rays_per_pixel_side": [[0]]}, r"data\.rays_per_pixel_side is a whole number.*got \[\[0\]\]"),
        ({"background": "green"}, r"data\.background must be one of white, black, random"),
    ],
)
def test_what_cannot_be_is_said(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        scene(**settings)


def test_views_that_show_nothing_are_refused() -> None:
    far_away = Meshes([ball().verts_packed() + 50], [ball().faces_packed()], ball().textures)
    with pytest.raises(UserError, match=r"nothing of the mesh is seen in view train/.*mesh\.normalize=max_abs"):
        scene(mesh=far_away).load()
