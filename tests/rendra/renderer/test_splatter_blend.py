"""Splats: what they keep, what they spread, who hides whom, and gradients at occlusion boundaries."""

import pytest
import torch
from assertions import assert_close, assert_finite

from rendra.renderer.blending import BlendParams
from rendra.renderer.cameras import FoVPerspectiveCameras, PerspectiveCameras
from rendra.renderer.mesh.rasterizer import MeshRasterizer, RasterizationSettings
from rendra.renderer.mesh.renderer import MeshRenderer
from rendra.renderer.mesh.shader import SplatterPhongShader
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.renderer.splatter_blend import SplatterBlender
from rendra.structures.meshes import Meshes

CAMERAS = [FoVPerspectiveCameras(), PerspectiveCameras()]  # depth grows with distance in one, falls in the other
HALF = BlendParams(sigma=0.5)
# weights of a splat of standard deviation 0.5 at distance 0, 1 and sqrt(2) pixels
CENTRE, SIDE, CORNER = (torch.exp(torch.tensor([0.0, -2.0, -4.0])) / (1 + 4 * torch.e**-2 + 4 * torch.e**-4)).tolist()


def points_at(cameras, depth: torch.Tensor) -> torch.Tensor:
    """World points behind the pixel centres, (N, H, W, K, 3), at given depths (N, H, W, K)."""
    n, h, w, k = depth.shape
    short = min(h, w)
    y = (h - 2 * torch.arange(h, dtype=depth.dtype) - 1) / short
    x = (w - 2 * torch.arange(w, dtype=depth.dtype) - 1) / short
    xy = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)[None, :, :, None].expand(n, h, w, k, 2)
    focal = cameras.get_projection_transform().get_matrix()[0, 0, 0].to(depth.dtype)
    return torch.cat((xy * depth[..., None] / focal, depth[..., None]), -1)


def blend(cameras, colors: torch.Tensor, depth: torch.Tensor, empty: torch.Tensor) -> torch.Tensor:
    shape = tuple(depth.shape)
    return SplatterBlender(shape, "cpu")(colors, points_at(cameras, depth), cameras, empty, HALF)


@pytest.mark.parametrize("cameras", CAMERAS)
def test_a_wall_of_one_colour_keeps_it(cameras) -> None:
    colors = torch.tensor([0.2, 0.5, 0.9]).expand(1, 6, 7, 2, 3)
    depth = torch.full((1, 6, 7, 2), 3.0) + torch.tensor([0.0, 1.0])
    image = blend(cameras, colors, depth, torch.zeros(1, 6, 7, 2, dtype=torch.bool))
    assert_close(image, torch.tensor([0.2, 0.5, 0.9, 1.0]).expand(1, 6, 7, 4), atol=1e-5)


@pytest.mark.parametrize("cameras", CAMERAS)
def test_one_pixel_spreads_by_the_gaussian(cameras) -> None:
    empty = torch.ones(1, 5, 5, 2, dtype=torch.bool)
    empty[0, 2, 2, 0] = False
    image = blend(cameras, torch.ones(1, 5, 5, 2, 3), torch.full((1, 5, 5, 2), 3.0), empty)
    alpha = image[0, ..., 3]
    kernel = torch.tensor([[CORNER, SIDE, CORNER], [SIDE, CENTRE, SIDE], [CORNER, SIDE, CORNER]])
    assert_close(alpha[1:4, 1:4], kernel, atol=1e-5)
    assert_close(alpha.sum(), 1.0)
    assert_close(image[..., :3], torch.ones(1, 5, 5, 3))  # white over white


@pytest.mark.parametrize("cameras", CAMERAS)
def test_the_nearer_of_two_surfaces_lies_over_the_farther(cameras) -> None:
    """Red at depth 2 covers the left half, a green wall at depth 5 stands behind all of it."""
    n, size = 1, 6
    red, green = torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0])
    colors, depth = torch.zeros(n, size, size, 2, 3), torch.full((n, size, size, 2), 5.0)
    empty = torch.zeros(n, size, size, 2, dtype=torch.bool)
    colors[:, :, :3, 0], colors[:, :, :3, 1], depth[:, :, :3, 0] = red, green, 2.0
    colors[:, :, 3:, 0] = green
    empty[:, :, 3:, 1] = True
    image = blend(cameras, colors, depth, empty)[0, 3]
    spill = SIDE + 2 * CORNER  # weight of one column in the next
    assert_close(image[1], [1.0, 0.0, 0.0, 1.0], atol=1e-5)
    assert_close(image[2], [1 - spill, spill, 0.0, 1.0], atol=1e-5)  # some of its splats go to the neighbour
    assert_close(image[3], [spill, 1 - spill, 0.0, 1.0], atol=1e-5)  # the red edge covers a part
    assert_close(image[4], [0.0, 1.0, 0.0, 1.0], atol=1e-5)


def test_gradients_by_finite_differences() -> None:
    cameras = PerspectiveCameras(
        focal_length=torch.ones(1, 2, dtype=torch.float64),
        R=torch.eye(3, dtype=torch.float64)[None],
        T=torch.zeros(1, 3, dtype=torch.float64),
    )
    depth = torch.rand(1, 3, 4, 2, dtype=torch.float64).sort(-1).values + 2
    empty = torch.rand(1, 3, 4, 2) < 0.3
    points = points_at(cameras, depth).requires_grad_()
    colors = torch.rand(1, 3, 4, 2, 3, dtype=torch.float64, requires_grad=True)
    blender = SplatterBlender((1, 3, 4, 2), "cpu")
    assert torch.autograd.gradcheck(lambda c, p: blender(c, p, cameras, empty, HALF), (colors, points))


def _square(x: torch.Tensor) -> Meshes:
    """A dark square at depth 2 whose position along x is differentiable."""
    corners = torch.tensor([[-0.31, -0.31, 2.0], [0.31, -0.31, 2.0], [0.31, 0.31, 2.0], [-0.31, 0.31, 2.0]])
    verts = corners + torch.stack((x, x * 0, x * 0))
    return Meshes([verts], [torch.tensor([[0, 2, 1], [0, 3, 2]])], TexturesVertex([torch.zeros(4, 3)]))


def test_a_square_feels_where_it_should_move() -> None:
    """Without blur, only the splats tell the image's edges which way the mesh moves."""
    cameras = PerspectiveCameras()
    rasterizer = MeshRasterizer(cameras, RasterizationSettings(40, faces_per_pixel=2))
    renderer = MeshRenderer(rasterizer, SplatterPhongShader(cameras=cameras))
    target = renderer(_square(torch.tensor(0.1)))
    for start, sign in ((0.02, -1), (0.18, 1)):
        x = torch.tensor(start, requires_grad=True)
        (renderer(_square(x)) - target).square().sum().backward()
        assert_finite(x.grad)
        assert x.grad * sign > 0


def test_a_sigma_not_in_pixels_is_warned_of() -> None:
    assert SplatterPhongShader().blend_params.sigma == 0.5
    with pytest.warns(UserWarning, match="sigma=0.0001"):
        SplatterPhongShader.check_blend_params(BlendParams())


def test_shapes_are_checked_and_empty_batches_pass() -> None:
    blender = SplatterBlender((0, 4, 4, 2), "cpu")
    nothing = torch.zeros(0, 4, 4, 2, 3)
    assert blender(nothing, nothing, CAMERAS[0], torch.zeros(0, 4, 4, 2).bool(), HALF).shape == (0, 4, 4, 4)
    with pytest.raises(ValueError, match="colors must be"):
        blender(torch.zeros(1, 4, 4, 2, 3), nothing, CAMERAS[0], torch.zeros(0, 4, 4, 2).bool(), HALF)
