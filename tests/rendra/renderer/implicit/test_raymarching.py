"""Compositing along rays, against closed forms and the plain sum."""

import pytest
import torch
from assertions import assert_close, assert_finite
from far_device import Far, far  # noqa: F401

from rendra.renderer import AbsorptionOnlyRaymarcher, EmissionAbsorptionRaymarcher, opacity_from_density


def literal(densities, features, thickness):
    """The sum as it is written, one ray (S,), (S, C)."""
    total = torch.zeros_like(features[0])
    for j in range(len(densities)):
        seen = torch.ones((), dtype=densities.dtype)
        for k in range(j - thickness + 1):
            seen = seen * (1 - densities[k])
        total = total + densities[j] * seen * features[j]
    return total


@pytest.mark.parametrize("density", [0.0, 0.1, 0.7, 1.0])
def test_a_uniform_fog(density) -> None:
    densities, colour = torch.full((2, 4, 9, 1), density), torch.tensor([0.2, 0.5, 1.0])
    image = EmissionAbsorptionRaymarcher()(densities, colour.expand(2, 4, 9, 3))
    opacity = 1 - (1 - density) ** 9
    assert_close(image, torch.cat((opacity * colour, torch.tensor([opacity]))).expand(2, 4, 4))
    assert_close(AbsorptionOnlyRaymarcher()(densities), torch.full((2, 4, 1), opacity))


def test_weights_and_what_passes_sum_to_one() -> None:
    torch.manual_seed(0)
    densities = torch.rand(6, 7, 20, 1, dtype=torch.float64)
    image = EmissionAbsorptionRaymarcher()(densities, torch.ones(6, 7, 20, 1, dtype=torch.float64))
    assert_close(image[..., 0] + (1 - densities[..., 0]).prod(-1), torch.ones(6, 7), atol=1e-8)
    assert_close(image[..., 0], image[..., 1], atol=1e-8)


@pytest.mark.parametrize("thickness", [1, 2, 5, 6, 9])
def test_the_sum_as_written(thickness) -> None:
    torch.manual_seed(0)
    densities, features = torch.rand(4, 6, 1, dtype=torch.float64), torch.randn(4, 6, 3, dtype=torch.float64)
    image = EmissionAbsorptionRaymarcher(surface_thickness=thickness)(densities, features)
    expected = [literal(d[:, 0], f, thickness) for d, f in zip(densities, features, strict=True)]
    assert_close(image[:, :3], torch.stack(expected), atol=1e-8)


def test_an_opaque_sample_hides_what_is_behind_it() -> None:
    densities = torch.tensor([0.0, 1.0, 1.0, 0.5])[:, None]
    features = torch.eye(4)
    assert_close(EmissionAbsorptionRaymarcher()(densities, features), [0.0, 1.0, 0.0, 0.0, 1.0])
    assert_close(EmissionAbsorptionRaymarcher(2)(densities, features), [0.0, 1.0, 1.0, 0.0, 1.0])


def test_rays_may_have_no_samples_and_there_may_be_no_rays() -> None:
    march = EmissionAbsorptionRaymarcher()
    assert_close(march(torch.zeros(2, 0, 1), torch.zeros(2, 0, 3)), torch.zeros(2, 4))
    assert march(torch.zeros(0, 5, 1), torch.zeros(0, 5, 3)).shape == (0, 4)
    assert march(torch.zeros(2, 5, 1), torch.zeros(2, 5, 0)).shape == (2, 1)
    assert AbsorptionOnlyRaymarcher()(torch.zeros(0, 5, 1)).shape == (0, 1)


@pytest.mark.parametrize("thickness", [1, 3])
def test_gradients(thickness) -> None:
    torch.manual_seed(0)
    densities = (0.05 + 0.9 * torch.rand(3, 5, 1, dtype=torch.float64)).requires_grad_()
    features = torch.randn(3, 5, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(EmissionAbsorptionRaymarcher(thickness), (densities, features))
    assert torch.autograd.gradcheck(AbsorptionOnlyRaymarcher(), (densities,))


@pytest.mark.parametrize("march", [EmissionAbsorptionRaymarcher(), EmissionAbsorptionRaymarcher(3)])
@pytest.mark.parametrize("values", [[1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0], [0.5, 1.0, 0.0, 1.0]])
def test_gradients_are_finite_behind_opaque_samples(march, values) -> None:
    densities = torch.tensor(values)[None, :, None].requires_grad_()
    features = torch.ones(1, 4, 3, requires_grad=True)
    march(densities, features).sum().backward()
    assert_finite(densities.grad)
    assert_finite(features.grad)
    opacities = torch.tensor(values)[None, :, None].requires_grad_()
    AbsorptionOnlyRaymarcher()(opacities).sum().backward()
    assert_close(opacities.grad[0, 0, 0], (1 - torch.tensor(values[1:])).prod())


def test_marching_stays_where_the_rays_are(far) -> None:  # noqa: F811
    densities = torch.full((2, 5, 1), 0.5, device=far)
    assert isinstance(EmissionAbsorptionRaymarcher()(densities, torch.ones(2, 5, 3, device=far)), Far)
    assert isinstance(AbsorptionOnlyRaymarcher()(densities), Far)


def test_densities_outside_of_their_range_are_warned_of() -> None:
    with pytest.warns(UserWarning, match=r"\[0, 1\].*from -0.5 to 2"):
        AbsorptionOnlyRaymarcher()(torch.tensor([[-0.5], [2.0]]))


@pytest.mark.parametrize(
    ("densities", "features", "message"),
    [
        ([1.0], torch.ones(1, 3), "rays_densities has to be a tensor, got list"),
        (torch.ones(4, 3), torch.ones(4, 3), r"\(\.\.\., S, 1\), got \(4, 3\)"),
        (torch.ones(4, 1), None, "rays_features has to be a tensor, got NoneType"),
        (torch.ones(4, 1), torch.ones(5, 3), r"\(4, 1\) and \(5, 3\)"),
        (torch.ones(2, 4, 1), torch.ones(4, 3), r"\(2, 4, 1\) and \(4, 3\)"),
    ],
)
def test_impossible_input_is_refused(densities, features, message) -> None:
    with pytest.raises(ValueError, match=message):
        EmissionAbsorptionRaymarcher()(densities, features)


def test_a_surface_has_a_thickness() -> None:
    with pytest.raises(ValueError, match="at least 1, got 0"):
        EmissionAbsorptionRaymarcher(surface_thickness=0)


def test_rounding_is_not_warned_of() -> None:
    AbsorptionOnlyRaymarcher()(torch.tensor([[1.000001], [-1e-6]]))


def test_densities_absorb_alike_however_many_samples_there_are() -> None:
    """1 - exp(-sigma d) over the distance d, in the world or in units of the lengths."""
    for count in (5, 50):
        lengths = torch.arange(count) * (2.0 / count)
        opacity = opacity_from_density(torch.full((count, 1), 0.7), lengths, torch.tensor([0.0, 3.0, 4.0]))
        assert_close(AbsorptionOnlyRaymarcher()(opacity), 1 - torch.tensor([-0.7 * 10]).exp())
        opacity = opacity_from_density(torch.full((count, 1), 0.7), lengths)
        assert_close(AbsorptionOnlyRaymarcher()(opacity), 1 - torch.tensor([-0.7 * 2]).exp())


def test_the_step_behind_the_last_sample() -> None:
    densities = torch.tensor([0.0, 0.5, 0.5])[:, None]
    lengths = torch.tensor([0.0, 1.0, 3.0])
    assert_close(opacity_from_density(densities, lengths)[:, 0], 1 - torch.tensor([0.0, -1.0, -1.0]).exp())
    assert_close(opacity_from_density(densities, lengths, last_step=1e10)[-1], [1.0])
    assert_close(opacity_from_density(densities[:1] + 1, lengths[:1]), [[0.0]])
    assert opacity_from_density(densities[:0], lengths[:0]).shape == (0, 1)


@pytest.mark.parametrize(
    ("densities", "lengths", "directions", "message"),
    [
        (torch.ones(4, 3), torch.ones(4), None, r"got \(4, 3\) and \(4,\)"),
        (torch.ones(2, 4, 1), torch.ones(4), None, r"got \(2, 4, 1\) and \(4,\)"),
        (torch.ones(2, 4, 1), torch.ones(2, 4), torch.ones(3), r"\(2, 3\), got \(3,\)"),
    ],
)
def test_densities_that_do_not_fit(densities, lengths, directions, message) -> None:
    with pytest.raises(ValueError, match=message):
        opacity_from_density(densities, lengths, directions)
