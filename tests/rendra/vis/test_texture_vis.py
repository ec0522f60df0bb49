"""Pictures of maps, UV islands and atlases: every mark on the pixel where it belongs."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from rendra.renderer import TexturesAtlas, TexturesUV
from rendra.vis import (
    texture_atlas_image,
    texturesuv_image_matplotlib,
    texturesuv_image_PIL,
    texturesuv_islands_image,
)

RED = (255, 0, 0)


def textures(
    uvs: list[list[float]], faces: list[list[int]], size: tuple[int, int] = (9, 17), **options
) -> TexturesUV:
    """A second mesh of a batch; the first is blank."""
    height, width = size
    maps = [torch.ones(4, 4, 3), torch.linspace(0, 1, height)[:, None, None].expand(height, width, 3)]
    return TexturesUV(
        maps, [torch.zeros(0, 3).long(), torch.tensor(faces)], [torch.zeros(0, 2), torch.tensor(uvs)], **options
    )


def red(image) -> set[tuple[int, int]]:
    """x, y of the red pixels."""
    ys, xs = (np.asarray(image) == RED).all(-1).nonzero()
    return set(zip(xs.tolist(), ys.tolist(), strict=True))


def test_coordinates_lie_where_the_texture_reads_them() -> None:
    texture = textures([[0.0, 0], [1, 1], [0.5, 0.5], [1, 0]], [[0, 1, 2]])  # the last one is not used
    image = texturesuv_image_PIL(texture, texture_index=1, radius=0)
    assert image.size == (17, 9)
    assert red(image) == {(0, 8), (16, 0), (8, 4), (16, 8)}
    grey = np.asarray(image)[:, 3, 0]
    np.testing.assert_array_equal(grey, np.linspace(0, 255, 9).round().astype(int))


def test_pixel_edges_instead_of_centres() -> None:
    texture = textures([[0.25, 0.25]], [[0, 0, 0]], (8, 8), align_corners=False)
    assert red(texturesuv_image_PIL(texture, texture_index=1, radius=0.5)) <= {(1, 5), (2, 5), (1, 6), (2, 6)}


def test_a_subsample_is_even_and_as_large_as_asked() -> None:
    uvs = [[i / 100, 0.5] for i in range(101)]
    texture = textures(uvs, [[0, 1, 2]], (3, 101))
    assert red(texturesuv_image_PIL(texture, texture_index=1, radius=0, subsample=11)) == {
        (10 * i, 1) for i in range(11)
    }
    assert len(red(texturesuv_image_PIL(texture, texture_index=1, radius=0, subsample=None))) == 101


def test_islands_have_borders_and_inner_edges() -> None:
    square = textures([[0.0, 0], [1, 0], [1, 1], [0, 1]], [[0, 1, 2], [0, 2, 3]], (9, 9))
    image = texturesuv_islands_image(square, texture_index=1, inner_color="#00ff00")
    border = {(x, y) for x in range(9) for y in range(9) if {x, y} & {0, 8}}
    assert red(image) == border
    pixels = np.asarray(image)
    assert all(tuple(pixels[8 - i, i]) == (0, 255, 0) for i in range(1, 8))
    bare = np.asarray(texturesuv_islands_image(square, texture_index=1, inner_color=None))
    assert not (bare == (0, 255, 0)).all(-1).any()
    large = texturesuv_islands_image(square, texture_index=1, size=90)
    assert large.size == (90, 90)
    assert (45, 4) in red(large) or (45, 5) in red(large)


def test_islands_without_faces_or_numbers() -> None:
    texture = textures([[0.0, 0], [float("nan"), 0], [1, 1]], [[-1, -1, -1], [0, 1, 2]])
    assert len(red(texturesuv_islands_image(texture, texture_index=1))) > 0
    assert not red(texturesuv_islands_image(texture, texture_index=0))


def test_an_atlas_face_by_face() -> None:
    atlas = torch.zeros(5, 2, 2, 3)
    atlas[:, :, :, 0] = torch.arange(5)[:, None, None] / 5
    atlas[3, 1, 0, 1] = 1.0
    image = texture_atlas_image(TexturesAtlas([atlas]), columns=3, texel_px=2)
    pixels = np.asarray(image)
    assert pixels.shape == (8, 12, 3)
    assert (pixels[4:, 8:] == 255).all()  # no sixth face
    assert tuple(pixels[6, 1]) == (153, 255, 0)
    assert (pixels[:4, 4:8, 0] == 51).all()
    assert texture_atlas_image(TexturesAtlas([torch.zeros(0, 2, 2, 3)])).size[0] >= 2


@pytest.mark.parametrize("channels", [1, 4])
def test_grey_and_transparent_maps(channels: int) -> None:
    texture = TexturesUV(torch.full((1, 3, 3, channels), 0.4), torch.zeros(1, 1, 3).long(), torch.zeros(1, 1, 2))
    assert (np.asarray(texturesuv_image_PIL(texture, radius=0))[0, 0] == 102).all()


def test_what_cannot_be_shown() -> None:
    texture = textures([[0.0, 0]], [[0, 0, 0]])
    with pytest.raises(ValueError, match=r"texture_index must lie in \[0, 2\), got 2"):
        texturesuv_image_PIL(texture, texture_index=2)
    with pytest.raises(ValueError, match="must be a TexturesUV, got TexturesAtlas"):
        texturesuv_islands_image(TexturesAtlas([torch.zeros(1, 2, 2, 3)]))
    with pytest.raises(ValueError, match="must be a TexturesAtlas, got TexturesUV"):
        texture_atlas_image(texture)
    many = TexturesUV(
        torch.ones(1, 2, 3, 3, 3),
        torch.zeros(1, 1, 3).long(),
        torch.zeros(1, 1, 2),
        maps_ids=torch.zeros(1, 1).long(),
    )
    with pytest.raises(ValueError, match="several maps"):
        texturesuv_image_PIL(many)
    five = TexturesUV(torch.ones(1, 3, 3, 5), torch.zeros(1, 1, 3).long(), torch.zeros(1, 1, 2))
    with pytest.raises(ValueError, match="1, 3 or 4 channels can be shown, got 5"):
        texturesuv_image_PIL(five)


def test_matplotlib_is_asked_for_an_image_and_circles(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list = []
    axes = SimpleNamespace(
        imshow=lambda image, origin: calls.append((np.asarray(image).shape, origin)),
        add_patch=calls.append,
    )
    pyplot, patches = ModuleType("matplotlib.pyplot"), ModuleType("matplotlib.patches")
    pyplot.gca = lambda: axes
    patches.Circle = lambda xy, radius, color: (xy, radius, color)
    package = ModuleType("matplotlib")
    package.pyplot, package.patches = pyplot, patches
    for name, module in (("matplotlib", package), ("matplotlib.pyplot", pyplot), ("matplotlib.patches", patches)):
        monkeypatch.setitem(sys.modules, name, module)
    texture = textures([[0.0, 0], [1, 1]], [[0, 1, 0]])
    assert texturesuv_image_matplotlib(texture, texture_index=1, radius=2, origin="lower") is None
    assert calls == [((9, 17, 3), "lower"), ((0.0, 8.0), 2, (1.0, 0.0, 0.0)), ((16.0, 0.0), 2, (1.0, 0.0, 0.0))]


def test_without_matplotlib_the_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match="pip install matplotlib"):
        texturesuv_image_matplotlib(textures([[0.0, 0]], [[0, 0, 0]]), texture_index=1)
