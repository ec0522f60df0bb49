"""The only home of metrics. Each takes the prediction, then the target, and returns a scalar.

Shapes: images are (B, H, W, C) or (H, W, C) with values in [0, 1]; masks and silhouettes (B, H, W) or (H, W); clouds
(1, P, 3), and a surface is a batch of one mesh.
An average over a batch is the mean over images, as published tables have it.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from rendra.ops import distance_to_surface, knn_points, sample_points_from_meshes, self_intersections
from rendra.structures import Meshes
from rendra.transforms import so3_log_map
from rendra_lab import losses
from rendra_lab.settings import Size

_PSNR_CEILING_DB = 100.0  # of two equal images
_SURFACE_SAMPLES = 10_000  # that stand for a surface
_TRUTH_SAMPLES = 100_000  # that stand for a surface which is compared with the true one


def mean_squared_error(prediction: Tensor, target: Tensor) -> Tensor:
    """The mean of (prediction - target)^2."""
    return (prediction - target).square().mean()


def mean_absolute_error(prediction: Tensor, target: Tensor) -> Tensor:
    """The mean of |prediction - target|."""
    return (prediction - target).abs().mean()


def psnr(prediction: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB for a peak of 1, the mean over images; equal images get 100 dB."""
    prediction, target = _batched(prediction, target)
    error = (prediction - target).square().flatten(1).mean(1)
    return (-10 * error.clamp_min(10 ** (-_PSNR_CEILING_DB / 10)).log10()).mean()


def psnr_foreground(prediction: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """`psnr` over the pixels whose mask (B, H, W) is above 0.5 alone: the squared error's mean is over those.

    The mean over images; one without such pixels is left out, and NaN comes back where all are.
    """
    prediction, target = _batched(prediction, target)
    inside = (mask > 0.5).reshape(len(prediction), -1).to(prediction.dtype)
    squares = (prediction - target).square().mean(-1).flatten(1)
    counts = inside.sum(1)
    error = (squares * inside).sum(1)[counts > 0] / counts[counts > 0]
    return (-10 * error.clamp_min(10 ** (-_PSNR_CEILING_DB / 10)).log10()).mean()


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Structural similarity in [-1, 1], the mean over images, channels and pixels.

    Gaussian window of 11 x 11 and sigma 1.5, K1 = 0.01, K2 = 0.03, population moments, only windows that lie
    inside the image. Source: Wang et al., "Image quality assessment", IEEE TIP 2004, Eq. 13.
    Raises ValueError for an image smaller than the window.
    """
    prediction, target = (image.movedim(-1, 1) for image in _batched(prediction, target))
    if min(prediction.shape[-2:]) < 11:
        raise ValueError(f"ssim needs at least 11 x 11 pixels, got {tuple(prediction.shape[-2:])}")
    mean_p, mean_t = _blur(prediction), _blur(target)
    variance_p = _blur(prediction.square()) - mean_p.square()
    variance_t = _blur(target.square()) - mean_t.square()
    covariance = _blur(prediction * target) - mean_p * mean_t
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_p * mean_t + c1) / (mean_p.square() + mean_t.square() + c1)
    structure = (2 * covariance + c2) / (variance_p + variance_t + c2)
    return (luminance * structure).mean()


def iou(prediction: Tensor, target: Tensor, threshold: float = 0.5) -> Tensor:
    """Intersection over union of two masks, cut at the threshold, the mean over images; empty masks agree."""
    prediction, target = _batched(prediction, target, dims=3)
    predicted, wanted = prediction > threshold, target > threshold
    both = (predicted & wanted).flatten(1).sum(1)
    either = (predicted | wanted).flatten(1).sum(1)
    return torch.where(either > 0, both / either.clamp_min(1), torch.ones_like(both, dtype=torch.float)).mean()


def rotation_error_deg(R: Tensor, truth: Tensor) -> Tensor:
    """The angle of R truth^T in degrees, the mean over matrices (B, 3, 3); accurate for small angles."""
    return torch.rad2deg(so3_log_map(R.double() @ truth.double().transpose(1, 2)).norm(dim=1)).mean()


def length_error_percent(vector: Tensor, truth: Tensor) -> Tensor:
    """How much the length of vectors (B, 3) differs, in percent of the true length, the mean over the batch.

    Of camera positions in a world whose origin is looked at: the error of the distance.
    """
    return (100 * (vector.norm(dim=1) / truth.norm(dim=1) - 1).abs()).mean()


def position_error_percent(position: Tensor, truth: Tensor) -> Tensor:
    """How far positions (B, 3) are off, in percent of the true distance from the origin, the mean over the batch."""
    return (100 * (position - truth).norm(dim=1) / truth.norm(dim=1)).mean()


def cloud_to_surface_rms(mesh: Meshes, points: Tensor) -> Tensor:
    """The root of the mean squared distance of points (1, P, 3) from a surface."""
    return losses.cloud_to_surface(mesh, points).sqrt()


def surface_chamfer(mesh: Meshes, points: Tensor) -> Tensor:
    """Mean squared distances between 10,000 points of a surface and a cloud (1, P, 3), both ways, summed."""
    return losses.chamfer(_samples(mesh), points)


def surface_chamfer_l1(mesh: Meshes, truth: Meshes) -> Tensor:
    """Mean distance between two surfaces, not squared, in diagonals of the true one's bounding box.

    The mean of two means: of the exact distances from 100,000 points spread evenly over `mesh` to the surface
    `truth`, and from as many of `truth` to `mesh`. The points are the same at every call. Both meshes are batches of
    one, with faces, in the same frame.
    """
    low, high = truth.verts_packed().amin(0), truth.verts_packed().amax(0)
    there = distance_to_surface(_samples(mesh, _TRUTH_SAMPLES)[0], truth).distance.mean()
    back = distance_to_surface(_samples(truth, _TRUTH_SAMPLES)[0], mesh).distance.mean()
    return (there + back) / 2 / (high - low).norm()


def surface_f_score(mesh: Meshes, points: Tensor, threshold: Size) -> Tensor:
    """The harmonic mean of precision and recall, in [0, 1].

    Precision is the share of 10,000 points of the surface that are nearer than `threshold` to the cloud (1, P, 3),
    recall the share of the cloud that is nearer than that to the points of the surface.
    Source: Knapitsch et al., "Tanks and Temples", 2017, Sec. 3.
    """
    samples = _samples(mesh)
    near = [knn_points(a, b).dists < threshold**2 for a, b in ((samples, points), (points, samples))]
    precision, recall = (hits.float().mean() for hits in near)
    return 2 * precision * recall / (precision + recall).clamp_min(1e-12)


def displacement_error(displacement: Tensor, truth: Tensor) -> Tensor:
    """The Euclidean distance of estimated displacements (B, 3) from the true ones, the mean over the batch."""
    return (displacement - truth).norm(dim=1).mean()


def estimated_coordinate(vector: Tensor, axis: int) -> Tensor:
    """One coordinate of estimated vectors (B, 3), the mean over the batch: axis 0, 1 or 2."""
    return vector[:, axis].mean()


def true_coordinate(vector: Tensor, truth: Tensor, axis: int) -> Tensor:
    """One coordinate of true vectors (B, 3), to stand beside the estimate's."""
    return truth[:, axis].mean()


def num_self_intersections(mesh: Meshes) -> Tensor:
    """How many pairs of a surface's faces cross each other."""
    return torch.tensor(float(len(self_intersections(mesh))), device=mesh.device)


def _samples(mesh: Meshes, count: int = _SURFACE_SAMPLES) -> Tensor:
    """Points on a surface (1, count, 3), the same at every call."""
    generator = torch.Generator(mesh.device).manual_seed(0)
    return sample_points_from_meshes(mesh, count, generator=generator)


def _batched(prediction: Tensor, target: Tensor, dims: int = 4) -> tuple[Tensor, Tensor]:
    if prediction.shape != target.shape:
        raise ValueError(
            f"prediction and target differ in shape: {tuple(prediction.shape)} and {tuple(target.shape)}"
        )
    return (prediction, target) if prediction.ndim == dims else (prediction[None], target[None])


def _blur(image: Tensor) -> Tensor:
    """Convolves (B, C, H, W) with the Gaussian window, one axis at a time, without padding."""
    channels = image.shape[1]
    offset = torch.arange(-5, 6, device=image.device, dtype=image.dtype)
    window = torch.softmax(-offset.square() / (2 * 1.5**2), 0).expand(channels, 1, 1, 11)
    across = functional.conv2d(image, window, groups=channels)
    return functional.conv2d(across, window.transpose(-1, -2), groups=channels)
