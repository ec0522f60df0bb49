"""Scores of sets of pictures as metrics of a run: streamed, merged, with and without a reference."""

import logging
import math
from pathlib import Path

import pytest
import torch
import yaml
from few_numbers import Quarters, tiny

from rendra_lab.generative import feature_statistics, features
from rendra_lab.generative.feature_statistics import FeatureStatistics, reference_statistics
from rendra_lab.generative.frechet import FrechetDistance, distance_of_statistics
from rendra_lab.generative.kernel_distance import KernelDistance, kernel_distance
from rendra_lab.generative.picture_sets import CountedPictures
from rendra_lab.generative.terms import generative_term
from rendra_lab.targets import check_targets

CONF = Path(__file__).parents[3] / "conf" / "metric"

KINDS = pytest.mark.parametrize("kind", [FrechetDistance, KernelDistance])
Kind = type[FrechetDistance] | type[KernelDistance]


@KINDS
def test_batches_and_processes_add_up_to_the_distance_of_all(kind: Kind) -> None:
    made, real = tiny(50, 1, 0.4), tiny(40, 2)
    network = Quarters()
    metric, other = kind(network), kind(network)
    for few, some in zip(made[:30].split(7), real[:20].split(4), strict=True):
        metric.update(few, some)
    other.update(made[30:], real[20:])
    metric.merge_state(other)
    a, b = made.flatten(1), real.flatten(1)
    if kind is FrechetDistance:
        expected = distance_of_statistics(FeatureStatistics.of_vectors(a), FeatureStatistics.of_vectors(b))
    else:
        expected = kernel_distance(a, b)
    assert float(metric.compute()) == pytest.approx(expected, rel=1e-5)
    assert metric.counts() == (50, 40)


@KINDS
def test_a_reference_stands_for_the_real_pictures_of_all_evaluations(kind: Kind) -> None:
    made, real = tiny(30, 1, 0.4), tiny(25, 2)
    streamed, metric = kind(Quarters()), kind(Quarters())
    streamed.update(made, real)
    metric.reference([real[:10], {"rgb": real[10:]}])
    for _ in range(2):
        metric.reset()
        metric.update(made, tiny(5, 3, 0.9))
        assert metric.counts() == (30, 25)
        assert float(metric.compute()) == pytest.approx(float(streamed.compute()), rel=1e-5)
    metric.reference([made])
    assert float(metric.compute()) < float(streamed.compute()) / 10
    assert metric.has_reference
    assert not streamed.has_reference


@KINDS
def test_a_value_says_its_name_and_its_counts(kind: Kind, caplog: pytest.LogCaptureFixture) -> None:
    metric = kind(Quarters())
    metric.update(tiny(20, 1), tiny(15, 2))
    with caplog.at_level(logging.INFO):
        metric.compute()
    name = "fd_quarters" if kind is FrechetDistance else "kid_quarters"
    assert metric.last.startswith(name)
    assert metric.last.endswith(": 20 made pictures, 15 real ones, 12 features")
    assert [record.getMessage() for record in caplog.records] == [metric.last]


def test_too_few_pictures_for_a_covariance_are_said_once(caplog: pytest.LogCaptureFixture) -> None:
    metric = FrechetDistance(Quarters())
    for _ in range(2):
        metric.reset()
        metric.update(tiny(40, 1), tiny(12, 2))
        assert math.isfinite(float(metric.compute()))
    warned = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert warned == [
        "fd_quarters of 12 pictures means little: its 12 features need at least 13, better ten times as many"
    ]


@KINDS
def test_of_fewer_than_two_pictures_there_is_no_distance(kind: Kind) -> None:
    metric = kind(Quarters())
    metric.update(tiny(1, 1), tiny(9, 2))
    assert math.isnan(float(metric.compute()))
    metric = kind(Quarters())
    metric.update(tiny(9, 1)[:0], tiny(9, 2)[:0])
    assert math.isnan(float(metric.compute()))
    metric = kind(Quarters())
    metric.update(tiny(9, 1))
    assert math.isnan(float(metric.compute()))


@KINDS
def test_it_is_in_no_checkpoint(kind: Kind) -> None:
    metric = kind(Quarters())
    metric.reference([tiny(9, 1)])
    metric.update(tiny(9, 2))
    assert metric.state_dict() == {}


@KINDS
def test_real_pictures_are_found_by_their_content(
    kind: Kind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(features, "_KNOWN_BYTES", 0)  # nothing stays in memory, as in another run
    made, real, network = tiny(20, 2), tiny(30, 1), Quarters()

    def value(network: Quarters) -> float:
        metric = kind(network, tmp_path)
        metric.update(made, real)
        return float(metric.compute())

    first = value(network)
    assert network.asked == 20 + 30
    assert value(network) == first
    assert network.asked == 20 + 30 + 20
    metric = kind(network, tmp_path)
    metric.reference([real])
    assert network.asked == 20 + 30 + 20
    files = list(tmp_path.rglob("*.safetensors"))
    assert [path.parent.name.startswith("features_quarters_") for path in files] == [True]
    value(Quarters())  # another network: other weights
    assert len(list(tmp_path.rglob("*.safetensors"))) == 2
    files[0].write_bytes(b"noise")
    assert value(network) == first
    assert "made anew" in caplog.text


def test_a_reference_keeps_the_first_vectors_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(feature_statistics, "MOST_KEPT", 10)
    real = tiny(25, 1)
    known = reference_statistics(Quarters(), real.split(6))
    assert known.count == 25
    assert torch.allclose(known.sample, real[:10].flatten(1))


def test_references_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="there is no real picture"):
        reference_statistics(Quarters(), [])
    with pytest.raises(
        ValueError, match=r"pictures \(B, 3, H, W\) of numbers in \[0, 1\], got float32 \(3, 2, 2, 3\)"
    ):
        reference_statistics(Quarters(), [tiny(3, 1).movedim(1, -1)])


def test_terms_are_left_out_without_a_network() -> None:
    assert generative_term("frechet", None) is None
    term = generative_term("kernel", Quarters(), target=None)
    assert term is not None
    assert isinstance(term.fn, KernelDistance)
    term({"rgb": tiny(4, 1)}, {})
    assert term.fn.counts() == (4, 0)


@pytest.mark.parametrize("name", ["generative", "fid"])
def test_what_is_configured_may_be_called(name: str) -> None:
    terms = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    check_targets(terms)
    for key in set(terms) - {"scored_pictures"}:
        assert terms[key]["distance"] == ("kernel" if key.startswith("kid") else "frechet")


def test_pictures_are_counted_beside_their_scores() -> None:
    metric, other = CountedPictures(), CountedPictures()
    metric.update(tiny(9, 1), tiny(4, 1))
    other.update(tiny(5, 1), tiny(4, 1))
    metric.merge_state(other)
    assert float(metric.compute()) == 8
