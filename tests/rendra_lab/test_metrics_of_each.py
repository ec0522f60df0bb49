"""What single images score, whole or within masks, their mean over batches, and depth against the truth."""

import math

import numpy as np
import pytest
import torch
from assertions import assert_close
from far_device import Far, far  # noqa: F401
from skimage.metrics import structural_similarity
from torch import Tensor

from rendra_lab import metrics
from rendra_lab.metrics import MeanOverImages, Scores


@pytest.fixture
def pair() -> tuple[Tensor, Tensor]:
    target = torch.rand(2, 24, 31, 3, dtype=torch.float64)
    return (target + 0.1 * torch.randn_like(target)).clamp(0, 1), target


def test_the_map_of_ssim_is_scikit_images(pair: tuple[Tensor, Tensor]) -> None:
    options = {"data_range": 1.0, "channel_axis": -1, "gaussian_weights": True, "use_sample_covariance": False}
    for found, first, second in zip(metrics.ssim_map(*pair), *pair, strict=True):
        mean, whole = structural_similarity(first.numpy(), second.numpy(), sigma=1.5, full=True, **options)
        assert_close(found, torch.from_numpy(whole[5:-5, 5:-5].mean(-1)), atol=1e-10)
        assert float(found.mean()) == pytest.approx(mean, abs=1e-10)


@pytest.mark.parametrize("name", ["psnr", "ssim"])
def test_a_mask_that_holds_everywhere_is_none(name: str, pair: tuple[Tensor, Tensor]) -> None:
    score, mean = getattr(metrics, f"{name}_of_each"), getattr(metrics, name)
    full = torch.ones(2, 24, 31, dtype=torch.bool)
    assert_close(score(*pair, full).value, score(*pair).value, atol=1e-12)
    assert_close(score(*pair).mean(), mean(*pair), atol=1e-12)
    assert not score(*pair, ~full).counted.any()


def test_psnr_within_a_mask_has_a_closed_form() -> None:
    target, mask = torch.zeros(2, 6, 6, 3), torch.zeros(2, 6, 6, dtype=torch.bool)
    prediction = target + 0.5
    prediction[:, :3] = 0.1
    mask[0, :3] = True
    found = metrics.psnr_of_each(prediction, target, mask)
    assert found.counted.tolist() == [True, False]
    assert float(found.value[0]) == pytest.approx(20.0, abs=1e-4)
    assert float(found.mean()) == float(found.value[0])
    with pytest.raises(ValueError, match=r"the shape of its images, \(2, 6, 6\), got \(2, 6, 5\)"):
        metrics.psnr_of_each(prediction, target, mask[..., :5])


def test_ssim_within_a_mask_is_the_mean_of_the_map_there(pair: tuple[Tensor, Tensor]) -> None:
    mask = torch.rand(2, 24, 31) > 0.6
    mask[1] = False
    mask[1, :5] = True  # the middle of no window
    found = metrics.ssim_of_each(*pair, mask)
    assert found.counted.tolist() == [True, False]
    assert_close(found.value[0], metrics.ssim_map(*pair)[0][mask[0, 5:-5, 5:-5]].mean(), atol=1e-12)


def test_the_mean_over_batches_weighs_images_and_not_batches() -> None:
    mean = MeanOverImages(lambda values, counted: Scores(values, counted))
    mean.update(torch.tensor([1.0, 2.0, 3.0]), torch.tensor([True, True, True]))
    mean.update(torch.tensor([10.0, math.nan]), torch.tensor([True, False]))
    mean.update(torch.tensor([math.nan]), torch.tensor([False]))
    assert float(mean.compute()) == 4.0
    mean.update(torch.tensor([math.nan]), torch.tensor([True]))  # a broken picture is no empty one
    assert math.isnan(mean.compute())
    mean.reset()
    mean.update(torch.zeros(0), torch.zeros(0, dtype=torch.bool))
    assert math.isnan(mean.compute())


def test_processes_add_up_their_images() -> None:
    parts = [MeanOverImages(lambda batch: Scores(batch, torch.ones_like(batch, dtype=torch.bool))) for _ in range(2)]
    values = torch.rand(7)
    for part, share in zip(parts, values.split(5), strict=True):
        part.update(share)
    states = {name: torch.stack([getattr(part, name) for part in parts]) for name in ("total", "count")}
    total, count = (parts[0]._reductions[name](state) for name, state in states.items())
    assert_close((total / count).float(), values.mean())


def depths() -> tuple[Tensor, Tensor]:
    truth = torch.rand(3, 1, 9, 11, dtype=torch.float64) * 20 + 1
    return truth * (0.2 * torch.randn_like(truth)).exp(), truth


def test_depth_is_judged_without_its_scale_where_truth_is_finite() -> None:
    depth, truth = depths()
    truth[:, :, :2] = torch.inf
    for score in (
        metrics.depth_abs_rel_of_each, metrics.depth_log_rmse_of_each, metrics.depth_rank_correlation_of_each
    ):  # fmt: skip
        found = score(depth, truth)
        assert found.counted.all()
        assert_close(score(7 * depth, truth).value, found.value, atol=1e-12)
        changed = depth.clone()
        changed[:, :, :2] = torch.nan
        assert_close(score(changed, truth).value, found.value, atol=0)
    d, t = (values[0, 0, 2:].reshape(-1).numpy() for values in (depth, truth))
    d = d * np.median(t) / np.median(d)
    abs_rel, log_rmse = np.mean(np.abs(d - t) / t), np.sqrt(np.mean(np.log(d / t) ** 2))
    assert float(metrics.depth_abs_rel_of_each(depth, truth).value[0]) == pytest.approx(abs_rel, rel=1e-9)
    assert float(metrics.depth_log_rmse_of_each(depth, truth).value[0]) == pytest.approx(log_rmse, rel=1e-9)


def test_the_rank_correlation_is_that_of_scipy_with_ties() -> None:
    from scipy.stats import spearmanr

    depth, truth = depths()
    depth, truth = (depth * 0.5).round(), truth.round()
    found = metrics.depth_rank_correlation_of_each(depth, truth)
    for value, d, t in zip(found.value, depth, truth, strict=True):
        assert float(value) == pytest.approx(spearmanr(d.flatten(), t.flatten()).statistic, abs=1e-12)


def test_the_rank_correlation_knows_order_alone() -> None:
    depth, truth = depths()
    assert_close(metrics.depth_rank_correlation_of_each(truth.exp().log1p(), truth).value, torch.ones(3))
    assert_close(metrics.depth_rank_correlation_of_each(1 / truth, truth).value, -torch.ones(3))
    assert_close(metrics.depth_rank_correlation_of_each(torch.ones_like(truth), truth).value, torch.zeros(3))
    assert metrics.depth_rank_correlation_of_each(depth.fill_(torch.nan), truth).value.isnan().all()


def test_depth_without_truth_is_not_counted() -> None:
    depth, truth = depths()
    truth[0], truth[1] = torch.inf, 5.0
    assert metrics.depth_abs_rel_of_each(depth, truth).counted.tolist() == [False, True, True]
    assert metrics.depth_rank_correlation_of_each(depth, truth).counted.tolist() == [False, False, True]
    assert metrics.depth_abs_rel_of_each(depth[:0], truth[:0]).value.shape == (0,)
    with pytest.raises(ValueError, match="differ in shape"):
        metrics.depth_abs_rel_of_each(depth, truth[:, 0])


def test_scores_stay_where_their_images_lie(far: torch.device) -> None:  # noqa: F811
    first, second = (torch.rand(2, 14, 14, 3).to(far) for _ in range(2))
    mask = (torch.rand(2, 14, 14) > 0.5).to(far)
    depth, truth = torch.rand(2, 1, 5, 5).to(far), (torch.rand(2, 1, 5, 5) + 1).to(far)
    found = [
        metrics.psnr_of_each(first, second, mask),
        metrics.ssim_of_each(first, second, mask),
        metrics.depth_abs_rel_of_each(depth, truth),
        metrics.depth_rank_correlation_of_each(depth, truth),
    ]
    assert all(isinstance(part, Far) for scores in found for part in scores)
