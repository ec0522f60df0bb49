"""What our writers write, our readers read: the same rays, the same pixels."""

import dataclasses

import pytest
import torch

from rendra.renderer import TexturesVertex
from rendra.renderer.cameras import look_at_view_transform
from rendra.utils import ico_sphere
from rendra_lab.data.colmap import ColmapViews
from rendra_lab.data.llff import LlffViews
from rendra_lab.data.nerf_blender import NerfBlenderViews
from rendra_lab.data.posed_images import PosedImages
from rendra_lab.data.ray_views import Scene
from rendra_lab.data.scene_folders import write_scene
from rendra_lab.data.transforms import TransformsViews

_Z_UP = torch.tensor([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])  # row vectors: +Y becomes +Z


def photographs(count, first, lens=(), fisheye=False, centred=True):
    """Random pictures of cameras around the origin."""
    number = torch.arange(first, first + count)
    R, T = look_at_view_transform(3.0, 10.0 + 7 * number, 40.0 * number)
    height, width = 12, 16
    generator = torch.Generator().manual_seed(first)
    images = [torch.randint(256, (height, width, 4), generator=generator, dtype=torch.uint8) for _ in number]
    centre = (8.0, 6.0) if centred else (7.3, 6.4)
    focal = (20.0, 20.0) if centred else (20.0, 21.0)
    distortion = torch.zeros(count, 8)
    distortion[:, : len(lens)] = torch.tensor(lens)
    return PosedImages.gather(
        [f"{i:03d}" for i in number.tolist()],
        images,
        torch.tensor([*focal, *centre]).expand(count, 4).contiguous(),
        R,
        T,
        distortion,
        torch.full((count,), fisheye),
    )


def scene_of(**how):
    sphere = ico_sphere(1)
    sphere.textures = TexturesVertex([torch.rand_like(sphere.verts_packed())])
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    train, val, test = (photographs(count, first, **how) for count, first in ((5, 0), (2, 5), (2, 7)))
    return Scene(train, val, test, box, truth=sphere, up=(0.0, 1.0, 0.0))


def assert_same(found, expected, turn=None):
    """The same pixels, and the same rays through random points, in a world that `turn` (3, 3) takes rows to."""
    assert len(found) == len(expected)
    torch.testing.assert_close(found.sizes, expected.sizes)
    torch.testing.assert_close(found.pixels, expected.pixels)
    view = torch.arange(len(found)).repeat_interleave(20)
    xy = torch.rand(len(view), 2) * torch.tensor([16.0, 12.0])
    turn = torch.eye(3) if turn is None else turn
    for ours, theirs in zip(found.rays(view, xy), expected.rays(view, xy), strict=True):
        torch.testing.assert_close(ours, theirs @ turn, rtol=0, atol=1e-5)


def joined(scene):
    """All images of a scene, in the order in which folders without a division have them."""
    parts = (scene.train, scene.val, scene.test)
    fields = {
        field.name: torch.cat([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(PosedImages)
        if isinstance(getattr(parts[0], field.name), torch.Tensor)
    }
    return PosedImages(labels=("",) * sum(map(len, parts)), has_alpha=True, **fields)


def test_nerf_blender(tmp_path):
    scene = scene_of()
    read = NerfBlenderViews(write_scene(scene, tmp_path / "scene", "nerf_blender")).load()
    for found, expected in ((read.train, scene.train), (read.val, scene.val), (read.test, scene.test)):
        assert_same(found, expected, _Z_UP)


LENSES = [
    {},
    {"centred": False},
    {"centred": False, "lens": (-0.2, 0.05, 0.01, -0.01, 0.002)},
    {"lens": (0.05, 0.01, 0.002, 0.001), "fisheye": True},
]


@pytest.mark.parametrize("how", LENSES)
def test_transforms(tmp_path, how):
    scene = scene_of(**how)
    read = TransformsViews(write_scene(scene, tmp_path / "scene", "transforms")).load()
    for found, expected in ((read.train, scene.train), (read.val, scene.val), (read.test, scene.test)):
        assert_same(found, expected, _Z_UP)


@pytest.mark.parametrize("how", [*LENSES, {"lens": (-0.1, 0.05, 0.01, -0.01, 0.002, 0.01, 0.02, 0.03)}])
@pytest.mark.parametrize("suffix", ["bin", "txt"])
def test_colmap(tmp_path, how, suffix):
    scene = scene_of(**how)
    folder = write_scene(scene, tmp_path / "scene", "colmap")
    for path in (folder / "sparse" / "0").iterdir():
        if path.suffix != f".{suffix}":
            path.unlink()
    read = ColmapViews(folder).load()
    every = joined(scene)
    assert_same(read.train, every.select(range(1, 8)))
    assert_same(read.test, every.select([0, 8]))
    assert (read.box[0] < -0.8).all()
    assert (read.box[1] > 0.8).all()


def test_llff(tmp_path):
    scene = scene_of()
    read = LlffViews(write_scene(scene, tmp_path / "scene", "llff"), recentre=False, bound_factor=None).load()
    every = joined(scene)
    alpha = every.pixels[:, 3:] / 255
    every.pixels[:, :3] = (every.pixels[:, :3] * alpha + 255 * (1 - alpha)).round().to(torch.uint8)
    every.pixels[:, 3] = 255
    assert_same(read.train, every.select(range(1, 8)))
    assert_same(read.test, every.select([0, 8]))
