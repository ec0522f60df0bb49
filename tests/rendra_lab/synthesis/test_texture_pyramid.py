"""Pictures at all resolutions: texels where they are, means where much is covered, seamless at the edges."""

import pytest
import torch

from rendra_lab.synthesis.texture_pyramid import TexturePyramid


@pytest.fixture(scope="module")
def pictures() -> torch.Tensor:
    return torch.rand(3, 8, 8, 3, generator=torch.Generator().manual_seed(0))


def test_the_middle_of_a_texel_is_the_texel(pictures: torch.Tensor) -> None:
    which = torch.tensor([0, 1, 2])
    places = torch.tensor([[0.5 / 8, 7.5 / 8], [3.5 / 8, 0.5 / 8], [7.5 / 8, 2.5 / 8]])
    seen = TexturePyramid(pictures).look_up(which, places, torch.full((3,), 1e-3))
    torch.testing.assert_close(seen, torch.stack([pictures[0, 0, 0], pictures[1, 7, 3], pictures[2, 5, 7]]))


def test_a_large_extent_is_the_mean_of_the_picture(pictures: torch.Tensor) -> None:
    places = torch.rand(3, 2, generator=torch.Generator().manual_seed(1))
    seen = TexturePyramid(pictures).look_up(torch.arange(3), places, torch.full((3,), 50.0))
    torch.testing.assert_close(seen, pictures.mean((1, 2)), atol=2e-3, rtol=0)


def test_pictures_repeat_and_extents_between_two_levels_lie_between_them(pictures: torch.Tensor) -> None:
    pyramid = TexturePyramid(pictures)
    which, places = torch.tensor([1, 1]), torch.tensor([[0.3, 0.7], [-0.7, 2.7]])
    for extent in (0.1, 0.18, 0.3):
        one, other = pyramid.look_up(which, places, torch.full((2,), extent))
        torch.testing.assert_close(one, other, atol=1e-5, rtol=0)
    fine, middle, coarse = (pyramid.look_up(which, places, torch.full((2,), x / 8))[0] for x in (1.0, 2**0.5, 2.0))
    torch.testing.assert_close(middle, (fine + coarse) / 2, atol=1e-5, rtol=0)


def test_nothing_is_looked_up_and_other_shapes_are_refused(pictures: torch.Tensor) -> None:
    assert TexturePyramid(pictures).look_up(torch.zeros(0).long(), torch.zeros(0, 2), torch.zeros(0)).shape == (0, 3)
    with pytest.raises(ValueError, match="S a power of two, got"):
        TexturePyramid(torch.zeros(2, 6, 6, 3))
