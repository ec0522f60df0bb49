"""Closed forms of what generator and discriminator want, and how terms read them."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch
from assertions import assert_close
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor

from rendra_lab.records import TensorRecord
from rendra_lab.targets import check_targets
from rendra_lab.tasks.synsin.adversarial_losses import feature_matching, hinge_discriminator, hinge_generator
from rendra_lab.tasks.synsin.discriminator import MultiScaleDiscriminator
from rendra_lab.tasks.synsin.records import Verdict

CONF = Path(__file__).parents[4] / "conf"


@dataclass(frozen=True)
class Opinions(TensorRecord):
    fake: Verdict
    real: Verdict


def scores(*values: float) -> Verdict:
    """Scales of different sizes, of one score each."""
    return Verdict(tuple((torch.zeros(1, 1, 2, 2), torch.full((2, 1, i + 1, 3), v)) for i, v in enumerate(values)))


def test_the_generator_wants_high_scores_of_every_scale_alike() -> None:
    assert_close(hinge_generator(scores(2.0, -5.0)), 1.5)


def test_the_discriminator_is_content_beyond_its_margins() -> None:
    assert_close(hinge_discriminator(scores(-1.0, -3.0), scores(1.0, 9.0)), 0.0)
    assert_close(hinge_discriminator(scores(0.0), scores(0.0)), 2.0)
    assert_close(hinge_discriminator(scores(1.0, -2.0), scores(-1.0, 0.5)), (2 + 2 + 0 + 0.5) / 2)


def test_features_are_matched_but_scores_are_not() -> None:
    fake = Verdict(((torch.full((1, 2, 2, 2), 3.0), torch.ones(1, 5), torch.tensor(100.0)),) * 2)
    real = Verdict(((torch.ones(1, 2, 2, 2), torch.full((1, 5), 0.5), torch.tensor(0.0)),) * 2)
    assert_close(feature_matching(fake, real), 2.5)
    assert_close(feature_matching(fake, fake), 0.0)


def test_verdicts_of_different_discriminators_are_not_compared() -> None:
    with pytest.raises(ValueError, match="zip"):
        hinge_discriminator(scores(1.0), scores(1.0, 2.0))


def test_a_discriminator_learns_by_its_loss_and_the_generator_by_its_own() -> None:
    network, real = MultiScaleDiscriminator(2, 2, 4), torch.rand(4, 3, 16, 16)
    made = torch.full((4, 3, 16, 16), 0.5, requires_grad=True)
    optimizer = torch.optim.Adam(network.parameters(), 0.01, (0.0, 0.9))
    losses = []
    for _ in range(8):
        optimizer.zero_grad()
        loss = hinge_discriminator(network(made.detach()), network(real))
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[0] == pytest.approx(2, abs=0.05)
    assert losses[-1] < 0.7 * losses[0]
    network.zero_grad()
    fake, true = network(made), network(real.requires_grad_())
    (hinge_generator(fake) + 10 * feature_matching(fake, true)).backward()
    assert isinstance(made.grad, Tensor)
    assert bool(made.grad.isfinite().all())
    assert float(made.grad.abs().sum()) > 0
    assert real.grad is None


@pytest.mark.parametrize(
    ("name", "weight"), [("hinge_generator", 1.0), ("hinge_discriminator", 1.0), ("feature_matching", 10.0)]
)
def test_the_terms_of_the_configuration_read_a_record_of_opinions(name: str, weight: float) -> None:
    tree = OmegaConf.load(CONF / "loss" / f"{name}.yaml")
    check_targets(OmegaConf.to_container(tree), "loss")
    term = instantiate(tree, _convert_="all")[name]
    opinions = Opinions(scores(0.5, 0.5), scores(0.5, 0.5))
    assert term.weight_at(0) == weight
    assert_close(
        term(opinions, opinions), {"hinge_generator": -0.5, "hinge_discriminator": 2.0, "feature_matching": 0.0}[name]
    )


@pytest.mark.parametrize(("name", "weight"), [("l1", 1.0), ("content", 10.0)])
def test_the_terms_of_pictures_compare_the_new_view_with_the_target(name: str, weight: float) -> None:
    tree = OmegaConf.load(CONF / "loss" / f"{name}.yaml")
    check_targets(OmegaConf.to_container(tree), "loss")
    term = instantiate(tree, _convert_="all")[name]
    pictures = torch.rand(1, 3, 32, 32)
    assert term.weight_at(0) == weight
    assert float(term({"rgb": pictures}, {"target": pictures})) == 0
    assert float(term({"rgb": pictures}, {"target": 1 - pictures})) > 0.1
