"""Lights and materials: closed forms of Phong's model, symmetries, batches and errors."""

import math

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.renderer.lighting import AmbientLights, DirectionalLights, PointLights, diffuse, specular
from rendra.renderer.materials import Materials

UP = torch.tensor([0.0, 1.0, 0.0])
WHITE = torch.ones(1, 3)


@pytest.mark.parametrize("angle", [0.0, 30.0, 60.0, 89.0, 91.0, 180.0])
def test_diffuse_is_the_cosine(angle: float) -> None:
    radians = math.radians(angle)
    direction = torch.tensor([[math.sin(radians), math.cos(radians), 0.0]]) * 7  # length plays no part
    color = torch.tensor([[0.2, 0.5, 1.0]])
    result = diffuse(3 * UP.expand(1, 4, 3), color, direction)
    assert_close(result, (color * max(math.cos(radians), 0.0)).expand(1, 4, 3), atol=1e-6)


@pytest.mark.parametrize("shininess", [1.0, 10.0, 64.0])
@pytest.mark.parametrize("angle", [0.0, 20.0, 80.0, 120.0])
def test_specular_is_a_power_of_the_cosine_to_the_mirrored_ray(angle: float, shininess: float) -> None:
    """Light from 45 degrees; the camera turned by `angle` out of the mirrored direction."""
    view = math.radians(45 + angle)
    camera = torch.tensor([[-math.sin(view), math.cos(view), 0.0]]) * 5
    points = torch.zeros(1, 1, 3)
    exponent = torch.tensor([shininess])
    result = specular(points, UP.expand(1, 1, 3), torch.tensor([[2.0, 2.0, 0.0]]), WHITE, camera, exponent)
    expected = max(math.cos(math.radians(angle)), 0.0) ** shininess
    assert_close(result, torch.full((1, 1, 3), expected), atol=1e-5)


def test_no_highlight_where_the_light_is_behind() -> None:
    points = torch.zeros(1, 1, 3)
    behind = torch.tensor([[0.0, -1.0, 0.0]])
    for shininess in (0.0, 1.0, 64.0):
        result = specular(points, UP.expand(1, 1, 3), behind, WHITE, behind, torch.tensor([shininess]))
        assert_close(result, torch.zeros(1, 1, 3))


def test_shininess_zero_spreads_the_highlight_over_the_lit_side() -> None:
    points = torch.zeros(1, 1, 3)
    camera = torch.tensor([[9.0, 0.1, 0.0]])
    result = specular(points, UP.expand(1, 1, 3), torch.tensor([[1.0, 0.1, 0.0]]), WHITE, camera, torch.zeros(1))
    assert_close(result, torch.ones(1, 1, 3))


@pytest.mark.parametrize("shininess", [0.0, 0.5, 1.0, 64.0])
def test_gradients_are_finite_beside_the_highlight(shininess: float) -> None:
    normals = UP.expand(1, 2, 3).clone().requires_grad_()
    points = torch.zeros(1, 2, 3, requires_grad=True)
    camera = torch.tensor([[5.0, 0.1, 0.0]])  # on the light's side: v . r < 0
    exponent = torch.tensor([shininess], requires_grad=True)
    specular(points, normals, torch.tensor([[1.0, 0.1, 0.0]]), WHITE, camera, exponent).sum().backward()
    for leaf in (normals, points, exponent):
        assert_finite(leaf.grad)


def test_gradients_by_finite_differences() -> None:
    def shade(points: torch.Tensor, normals: torch.Tensor, place: torch.Tensor) -> torch.Tensor:
        color, camera = WHITE.double(), torch.tensor([[0.0, 1.0, 4.0]], dtype=torch.float64)
        shininess = torch.tensor([3.0], dtype=torch.float64)
        direction = place[:, None] - points
        return diffuse(normals, color, direction) + specular(points, normals, direction, color, camera, shininess)

    points = torch.randn(2, 5, 3, dtype=torch.float64) * 0.2
    normals = torch.randn(2, 5, 3, dtype=torch.float64) * 0.3 + torch.tensor([0.0, 0.5, 1.0])
    place = torch.tensor([[0.0, 2.0, 3.0], [1.0, 1.0, 5.0]], dtype=torch.float64)
    assert torch.autograd.gradcheck(shade, tuple(t.requires_grad_() for t in (points, normals, place)))


def test_a_far_point_light_is_a_directional_light() -> None:
    normals, points = torch.randn(2, 6, 3), torch.randn(2, 6, 3)
    camera, shininess = torch.tensor([[0.0, 0.0, 5.0]]), torch.tensor([4.0])
    direction = torch.tensor([[1.0, 2.0, 3.0], [0.0, -1.0, 0.5]])
    near = PointLights(location=direction * 1e5)
    far = DirectionalLights(direction=direction)
    assert_close(near.diffuse(normals, points), far.diffuse(normals, points), atol=1e-4)
    assert_close(
        near.specular(normals, points, camera, shininess),
        far.specular(normals, points, camera, shininess),
        atol=1e-4,
    )


@pytest.mark.parametrize("shape", [(3, 4), (3, 2, 5), (3, 2, 2, 4)])
def test_a_batch_of_lights_is_each_light_by_itself(shape: tuple[int, ...]) -> None:
    normals, points = torch.randn(*shape, 3), torch.randn(*shape, 3)
    location, shininess = torch.randn(3, 3), torch.tensor([1.0, 8.0, 64.0])
    color, camera = torch.rand(3, 3), torch.randn(3, 3)
    batch = PointLights(location=location, diffuse_color=color, specular_color=color)
    for i in range(3):
        alone = PointLights(location=location[i][None], diffuse_color=color[i][None], specular_color=color[i][None])
        own = slice(i, i + 1)
        assert_close(batch.diffuse(normals, points)[own], alone.diffuse(normals[own], points[own]))
        assert_close(
            batch.specular(normals, points, camera, shininess)[own],
            alone.specular(normals[own], points[own], camera[own], shininess[own]),
        )


def test_defaults() -> None:
    for lights in (PointLights(), DirectionalLights()):
        assert_close(lights.ambient_color, [[0.5] * 3])
        assert_close(lights.diffuse_color, [[0.3] * 3])
        assert_close(lights.specular_color, [[0.2] * 3])
    assert_close(PointLights().location, [[0.0, 1.0, 0.0]])
    assert_close(DirectionalLights().direction, [[0.0, 1.0, 0.0]])
    materials = Materials()
    assert_close(materials.ambient_color, [[1.0] * 3])
    assert_close(materials.shininess, [64.0])


def test_ambient_lights_have_neither_direction_nor_fixed_channels() -> None:
    lights = AmbientLights(ambient_color=torch.rand(1, 5))
    points = torch.randn(2, 4, 3)
    assert lights.diffuse(points, points).shape == (2, 4, 5)
    assert not lights.specular(points, points, points, torch.ones(2)).any()
    assert_close(AmbientLights().ambient_color, [[1.0, 1.0, 1.0]])


def test_clones_are_apart() -> None:
    lights = PointLights(location=((1.0, 2.0, 3.0),))
    copy = lights.clone()
    lights.location += 1
    assert_close(copy.location, [[1.0, 2.0, 3.0]])
    materials = Materials(shininess=torch.tensor([3.0, 5.0]))
    assert_close(materials.clone().shininess, [3.0, 5.0])
    assert type(DirectionalLights().clone()) is DirectionalLights
    assert type(AmbientLights().clone()) is AmbientLights


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match=r"location to have shape \(N, 3\); got \(1, 4\)"):
        PointLights(location=torch.randn(1, 4))
    with pytest.raises(ValueError, match=r"direction to have shape \(N, 3\); got \(1, 2\)"):
        DirectionalLights(direction=torch.randn(1, 2))
    with pytest.raises(ValueError, match="specular_color"):
        Materials(specular_color=torch.rand(2, 4))
    with pytest.raises(ValueError, match="shininess"):
        Materials(shininess=torch.rand(2, 1))
