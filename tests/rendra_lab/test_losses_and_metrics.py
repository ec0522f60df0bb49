"""Losses and metrics against closed forms and published implementations."""

import math

import numpy as np
import pytest
import torch
from assertions import assert_close, assert_finite
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from rendra.structures import Meshes
from rendra.utils import ico_sphere
from rendra_lab import losses, metrics


@pytest.fixture
def pair() -> tuple[torch.Tensor, torch.Tensor]:
    target = torch.rand(2, 24, 31, 3, dtype=torch.float64)
    return (target + 0.1 * torch.randn_like(target)).clamp(0, 1), target


def test_the_books_huber_is_its_formula(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    squared = (pair[0] - pair[1]) ** 2
    expected = ((((1 + squared / 0.01).clamp(1e-4)).sqrt() - 1) * 0.1).mean()
    assert_close(losses.pseudo_huber(*pair), expected, atol=1e-12)
    far, zero = torch.full((1,), 1e4), torch.zeros(1)
    assert_close(losses.pseudo_huber(far, zero), far[0] - 0.1, atol=1e-2)
    assert_close(losses.pseudo_huber(zero + 1e-4, zero), 5e-8, atol=1e-12)


def test_psnr_is_scikit_images(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    values = [peak_signal_noise_ratio(t.numpy(), p.numpy(), data_range=1.0) for p, t in zip(*pair, strict=True)]
    assert float(metrics.psnr(*pair)) == pytest.approx(float(np.mean(values)), abs=1e-9)


def test_psnr_has_closed_forms() -> None:
    zero = torch.zeros(1, 4, 4, 3)
    assert_close(metrics.psnr(zero, zero + 0.1), 20.0, atol=1e-4)
    assert_close(metrics.psnr(zero, zero), 100.0)


def test_ssim_is_scikit_images(pair: tuple[torch.Tensor, torch.Tensor]) -> None:
    values = [
        structural_similarity(
            t.numpy(),
            p.numpy(),
            data_range=1.0,
            channel_axis=-1,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
        for p, t in zip(*pair, strict=True)
    ]
    assert float(metrics.ssim(*pair)) == pytest.approx(float(np.mean(values)), abs=1e-9)
    assert float(metrics.ssim(pair[1], pair[1])) == pytest.approx(1.0)


def test_ssim_needs_a_window() -> None:
    with pytest.raises(ValueError, match="11 x 11"):
        metrics.ssim(torch.zeros(10, 20, 3), torch.zeros(10, 20, 3))


def test_metrics_refuse_images_that_differ_in_shape() -> None:
    with pytest.raises(ValueError, match="differ in shape"):
        metrics.psnr(torch.zeros(1, 4, 4, 3), torch.zeros(1, 4, 4, 1))


def test_iou_counts_pixels() -> None:
    first, second = torch.zeros(2, 4, 4), torch.zeros(2, 4, 4)
    first[0, :2] = second[0, 1:3] = 1
    assert_close(metrics.iou(first, second), (4 / 12 + 1) / 2)  # the second pair is empty: it agrees
    assert_close(metrics.iou(first[0], second[0]), 4 / 12)


def test_soft_iou_agrees_with_iou_on_sharp_masks_and_survives_empty_ones() -> None:
    first, second = torch.zeros(1, 4, 4), torch.zeros(1, 4, 4)
    assert_close(losses.silhouette_iou(first, second), 0.0)
    first[0, :2] = second[0, 1:3] = 1
    assert_close(losses.silhouette_iou(first, second), 1 - metrics.iou(first, second))
    empty = torch.zeros(1, 4, 4, requires_grad=True)
    losses.silhouette_iou(empty, second).backward()
    assert_finite(empty.grad)


def test_masks_weigh_pixels_of_every_channel() -> None:
    prediction, target = torch.zeros(1, 2, 2, 3), torch.ones(1, 2, 2, 3)
    prediction[0, 0] = 1.0
    mask = torch.tensor([[[0.0, 1.0], [1.0, 1.0]]])
    for loss in (losses.SquaredError(), losses.absolute_error):
        assert_close(loss(prediction, target, mask), 2 / 3)
        assert_close(loss(prediction, target, torch.zeros_like(mask)), 0.0)


def test_huber_is_a_parabola_that_becomes_a_line() -> None:
    zero = torch.zeros(1)
    assert_close(losses.huber(zero + 0.05, zero, delta=0.1), 0.5 * 0.05**2)
    assert_close(losses.huber(zero + 1.0, zero, delta=0.1), 0.1 * (1 - 0.05))


def test_cross_entropy_is_finite_at_certainty() -> None:
    certain = torch.tensor([0.0, 1.0], requires_grad=True)
    losses.binary_cross_entropy(certain, torch.tensor([1.0, 0.0])).backward()
    assert_finite(certain.grad)
    half = torch.tensor([0.5])
    assert_close(losses.binary_cross_entropy(half, torch.tensor([1.0])), math.log(2))


def test_the_books_silhouette_loss_is_a_sum() -> None:
    loss = losses.SummedSquaredError()
    assert_close(loss(torch.ones(2, 3, 3), torch.zeros(2, 3, 3)), 18.0)
    assert loss.residuals(torch.ones(2, 3, 3), torch.zeros(2, 3, 3)).shape == (18,)


def plate(height: float, flip: bool = False, side: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    """A square of side 1 at z = height, which faces up, or down."""
    ticks = torch.linspace(0, 1, side)
    x, y = torch.meshgrid(ticks, ticks, indexing="xy")
    verts = torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3)
    corner = (torch.arange(side - 1)[:, None] * side + torch.arange(side - 1)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([[0, 1, side + 1]]), corner + torch.tensor([[0, side + 1, side]])])
    return verts, faces.flip(1) if flip else faces


def slab(thickness: float) -> Meshes:
    """Two squares back to back."""
    top, up = plate(thickness)
    bottom, down = plate(0.0, flip=True)
    return Meshes([torch.cat([top, bottom])], [torch.cat([up, down + len(top)])])


def test_displacements_are_measured_and_shown_by_coordinate() -> None:
    estimate, truth = torch.tensor([[3.0, 4.0, 5.0]]), torch.tensor([[0.0, 4.0, 1.0]])
    assert metrics.displacement_error(estimate, truth) == 5
    assert [metrics.estimated_coordinate(estimate, axis) for axis in range(3)] == [3, 4, 5]
    assert [metrics.true_coordinate(estimate, truth, axis) for axis in range(3)] == [0, 4, 1]


def test_distances_from_a_surface_are_squared_and_averaged() -> None:
    verts, faces = plate(0.0)
    points = torch.tensor([[[0.31, 0.47, 2.0], [0.5, 0.5, -1.0], [2.0, 0.5, 0.0]]])
    mesh = Meshes([verts], [faces])
    assert_close(losses.cloud_to_surface(mesh, points), (4 + 1 + 1) / 3)
    assert_close(metrics.cloud_to_surface_rms(mesh, points), 2**0.5)


def test_a_surface_is_free_within_the_gaps_of_a_cloud() -> None:
    cloud, spacing = torch.zeros(1, 1, 3), torch.tensor([0.5])
    samples = torch.tensor([[[0.4, 0, 0], [0, 0.5, 0], [0, 0, 1.5]]])
    assert_close(losses.surface_to_cloud(samples, cloud, spacing), 1 / 3)
    assert_close(losses.surface_to_cloud(samples, cloud, spacing, slack=0.0), (0.16 + 0.25 + 2.25) / 3)


def test_sheets_push_each_other_away_within_their_distance() -> None:
    term = losses.SheetSeparation(distance=0.1, most=None)
    assert_close(term(slab(0.04)), 0.06**2, atol=1e-6)
    assert_close(term(slab(0.2)), 0.0)
    mesh = slab(0.04)
    verts = mesh.verts_packed().requires_grad_()
    term(mesh.update_padded(verts[None])).backward()
    top, bottom = verts.grad[:36, 2], verts.grad[36:, 2]
    assert bool((top < 0).all())  # a step against the gradient opens the gap
    assert bool((bottom > 0).all())


def test_f_score_and_chamfer_know_a_surface_from_its_shifted_cloud() -> None:
    verts, faces = plate(0.0)
    mesh = Meshes([verts], [faces])
    cloud = torch.cat([torch.rand(1, 4000, 2), torch.full((1, 4000, 1), 0.05)], -1)
    assert_close(metrics.surface_f_score(mesh, cloud, threshold=0.1), 1.0)
    assert_close(metrics.surface_f_score(mesh, cloud, threshold=0.04), 0.0)
    assert float(metrics.surface_chamfer(mesh, cloud)) == pytest.approx(2 * 0.05**2, rel=0.1)


def test_crossing_sheets_are_counted() -> None:
    assert_close(metrics.num_self_intersections(slab(0.1)), 0.0)
    assert float(metrics.num_self_intersections(slab_with_a_spike())) > 0


def slab_with_a_spike() -> Meshes:
    mesh = slab(0.1)
    verts = mesh.verts_packed().clone()
    verts[14, 2] = -0.5  # a vertex of the upper plate, pulled through the lower one
    return mesh.update_padded(verts[None])


def test_a_surfaces_metrics_leave_the_random_state_alone() -> None:
    cloud = torch.rand(1, 50, 3)
    before = torch.get_rng_state()
    metrics.surface_chamfer(slab(0.5), cloud)
    assert torch.equal(before, torch.get_rng_state())


def test_gradients_of_distances_are_the_same_every_time() -> None:
    mesh, points = ico_sphere(5), 1.1 * torch.randn(1, 3000, 3)  # large enough for torch to use all threads
    gradients = []
    for _ in range(4):
        verts = mesh.verts_packed().clone().requires_grad_()
        losses.cloud_to_surface(mesh.update_padded(verts[None]), points).backward()
        gradients.append(verts.grad)
    assert all(torch.equal(gradients[0], other) for other in gradients[1:])
