"""The only home of metrics. Each takes the prediction, then the target, and returns a scalar.

Shapes: images are (B, H, W, C) or (H, W, C) with values in [0, 1]; masks and silhouettes (B, H, W) or (H, W); clouds
(1, P, 3), and a surface is a batch of one mesh.
An average over a batch is the mean over images, as published tables have it. Functions that end in `_of_each` say
what each image scores, and whether there was anything to score: `MeanOverImages` averages them over batches.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional
from torchmetrics import Metric

from rendra.ops import distance_to_surface, knn_points, sample_points_from_meshes, self_intersections
from rendra.structures import Meshes
from rendra.transforms import so3_log_map
from rendra_lab import losses
from rendra_lab.settings import Size

_PSNR_CEILING_DB = 100.0  # of two equal images
_SURFACE_SAMPLES = 10_000  # that stand for a surface
_TRUTH_SAMPLES = 100_000  # that stand for a surface which is compared with the true one


class Scores(NamedTuple):
    """What each of B images scores."""

    value: Tensor  # (B,)
    counted: Tensor  # (B,) bool; False where nothing was there to score, and the value means nothing

    def mean(self) -> Tensor:
        """Over the images that count; NaN where none does."""
        return self.value[self.counted].mean()


class MeanOverImages(Metric):
    """The mean over all images of all batches and processes; those with nothing to score are left out.

    Args:
        score: what each image of a batch scores, from the predicted and the target field and the context.
    """

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self, score: Callable[..., Scores]) -> None:
        super().__init__()
        self.score = score
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.int64), dist_reduce_fx="sum")

    def update(self, *fields: Any, **context: Any) -> None:
        """Adds the images of a batch."""
        self.add(self.score(*fields, **context))

    def add(self, scores: Scores) -> None:
        """Adds images that are scored already."""
        self.total = self.total + torch.where(scores.counted, scores.value, 0.0).double().sum()
        self.count = self.count + scores.counted.sum()

    def compute(self) -> Tensor:
        """The mean, a scalar; NaN where no image counts."""
        return (self.total / self.count).float()


def mean_squared_error(prediction: Tensor, target: Tensor) -> Tensor:
    """The mean of (prediction - target)^2."""
    return (prediction - target).square().mean()


def mean_absolute_error(prediction: Tensor, target: Tensor) -> Tensor:
    """The mean of |prediction - target|."""
    return (prediction - target).abs().mean()


def psnr(prediction: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB for a peak of 1, the mean over images; equal images get 100 dB."""
    return psnr_of_each(*_batched(prediction, target)).value.mean()


def psnr_foreground(prediction: Tensor, target: Tensor, mask: Tensor) -> Tensor:
    """`psnr` over the pixels whose mask (B, H, W) is above 0.5 alone: the squared error's mean is over those.

    The mean over images; one without such pixels is left out, and NaN comes back where all are.
    """
    prediction, target = _batched(prediction, target)
    return psnr_of_each(prediction, target, mask.reshape(prediction.shape[:3])).mean()


def psnr_of_each(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Scores:
    """`psnr` of images (B, H, W, C): of each whole, or over the pixels whose mask (B, H, W) is above 0.5 alone."""
    squares = (prediction - target).square()
    if mask is None:
        error, counted = squares.flatten(1).mean(1), squares.new_ones(len(squares), dtype=torch.bool)
    else:
        error, counted = _mean_inside(squares.mean(-1), mask)
    return Scores(-10 * error.clamp_min(10 ** (-_PSNR_CEILING_DB / 10)).log10(), counted)


def ssim(prediction: Tensor, target: Tensor) -> Tensor:
    """Structural similarity in [-1, 1], the mean over images, channels and pixels: see `ssim_map`."""
    return ssim_map(*_batched(prediction, target)).mean()


def ssim_of_each(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Scores:
    """`ssim` of images (B, H, W, C): of each whole, or of windows about pixels whose mask (B, H, W) is above 0.5.

    A mask that holds everywhere is the whole: windows lie inside the image, and the five outermost pixels are the
    middle of none.
    """
    similarity = ssim_map(prediction, target)
    inside = torch.ones_like(similarity) if mask is None else mask[:, 5:-5, 5:-5]
    return Scores(*_mean_inside(similarity, inside))


def ssim_map(prediction: Tensor, target: Tensor) -> Tensor:
    """Structural similarity of images (B, H, W, C) about each pixel but the five outermost: (B, H - 10, W - 10).

    Gaussian window of 11 x 11 and sigma 1.5, K1 = 0.01, K2 = 0.03, population moments, the mean over channels, only
    windows that lie inside the image. Source: Wang et al., "Image quality assessment", IEEE TIP 2004, Eq. 13.
    Raises ValueError for an image smaller than the window.
    """
    prediction, target = (image.movedim(-1, 1) for image in (prediction, target))
    if min(prediction.shape[-2:]) < 11:
        raise ValueError(f"ssim needs at least 11 x 11 pixels, got {tuple(prediction.shape[-2:])}")
    mean_p, mean_t = _blur(prediction), _blur(target)
    variance_p = _blur(prediction.square()) - mean_p.square()
    variance_t = _blur(target.square()) - mean_t.square()
    covariance = _blur(prediction * target) - mean_p * mean_t
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * mean_p * mean_t + c1) / (mean_p.square() + mean_t.square() + c1)
    structure = (2 * covariance + c2) / (variance_p + variance_t + c2)
    return (luminance * structure).mean(1)


def depth_abs_rel_of_each(depth: Tensor, truth: Tensor) -> Scores:
    """Mean of |s d - t| / t over the pixels of each image whose true depth t is finite: free of scale.

    s = median t / median d makes up for a scale that pictures alone do not tell. Source: Zhou et al., "Unsupervised
    Learning of Depth and Ego-Motion from Video", CVPR 2017, Sec. 4.1.
    Depths are (B, ...), above 0; images without a finite true depth have no score.
    """
    return _of_each_depth(lambda d, t: ((_same_median(d, t) - t).abs() / t).mean(), depth, truth)


def depth_log_rmse_of_each(depth: Tensor, truth: Tensor) -> Scores:
    """Root of the mean squared ln(s d / t), pixels and s as of `depth_abs_rel_of_each`."""
    return _of_each_depth(lambda d, t: (_same_median(d, t) / t).log().square().mean().sqrt(), depth, truth)


def depth_rank_correlation_of_each(depth: Tensor, truth: Tensor) -> Scores:
    """Spearman's rank correlation, in [-1, 1], over the pixels of each image whose true depth is finite.

    Equal depths share their mean rank. A prediction that is the same everywhere scores 0; images whose truth is, or
    with fewer than two finite true depths, have no score.
    """
    return _of_each_depth(_rank_correlation, depth, truth, two=True)


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


def _mean_inside(values: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """The mean of values (B, H, W) where a mask is above 0.5, and whether it is anywhere: (B,) and (B,)."""
    if values.shape != mask.shape:
        raise ValueError(f"a mask must have the shape of its images, {tuple(values.shape)}, got {tuple(mask.shape)}")
    inside = (mask > 0.5).flatten(1)
    counts = inside.sum(1)
    return torch.where(inside, values.flatten(1), 0.0).sum(1) / counts.clamp_min(1), counts > 0


def _of_each_depth(
    score: Callable[[Tensor, Tensor], Tensor], depth: Tensor, truth: Tensor, two: bool = False
) -> Scores:
    """A score of the predicted and the true depth (M,) of the known pixels of each image.

    Images without such pixels, or, if `two` is set, without two different true depths, are not counted.
    """
    if depth.shape != truth.shape:
        raise ValueError(f"depth and truth differ in shape: {tuple(depth.shape)} and {tuple(truth.shape)}")
    values, counted = [], []
    for guess, true in zip(depth.flatten(1), truth.flatten(1), strict=True):
        known = true.isfinite() & (true > 0)
        guess, true = guess[known], true[known]
        counts = len(true) > 0 and not (two and bool(true.min() == true.max()))
        values.append(score(guess, true) if counts else depth.new_zeros(()))
        counted.append(counts)
    return Scores(
        torch.stack(values) if values else depth.new_zeros(0),
        torch.tensor(counted, dtype=torch.bool, device=depth.device),
    )


def _same_median(depth: Tensor, truth: Tensor) -> Tensor:
    return depth * (truth.median() / depth.median())


def _rank_correlation(first: Tensor, second: Tensor) -> Tensor:
    """Pearson's correlation of the ranks of two sets of numbers (M,); 0 where all of the first are equal."""
    a, b = (rank - rank.mean() for rank in (_ranks(first), _ranks(second)))
    correlation = (a @ b) / (a.square().sum() * b.square().sum()).sqrt().clamp_min(1e-300)
    return torch.where(first.isnan().any(), torch.nan, correlation).to(first.dtype)


def _ranks(values: Tensor) -> Tensor:
    """The places (M,) of numbers in their order, from 1 on, float64; equal ones share the mean of theirs."""
    _, group, counts = values.unique(return_inverse=True, return_counts=True)
    middle = counts.cumsum(0).double() - (counts - 1).double() / 2
    return middle.index_select(0, group)


def _blur(image: Tensor) -> Tensor:
    """Convolves (B, C, H, W) with the Gaussian window, one axis at a time, without padding."""
    channels = image.shape[1]
    offset = torch.arange(-5, 6, device=image.device, dtype=image.dtype)
    window = torch.softmax(-offset.square() / (2 * 1.5**2), 0).expand(channels, 1, 1, 11)
    across = functional.conv2d(image, window, groups=channels)
    return functional.conv2d(across, window.transpose(-1, -2), groups=channels)
