"""SynSin's networks: published sizes, shapes, pictures in and out, and the two configurations."""

from pathlib import Path
from typing import Any

import pytest
import torch
from assertions import assert_close
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate
from torch import nn

from rendra_lab.errors import UserError
from rendra_lab.tasks.synsin.discriminator import MultiScaleDiscriminator
from rendra_lab.tasks.synsin.pictures_and_features import FeatureEncoder, RefinementDecoder

CONF = Path(__file__).parents[4] / "conf"


def sizes(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())


def networks(size: str) -> dict[str, Any]:
    with initialize_config_dir(str(CONF / "network" / f"{size}_of"), version_base="1.3"):
        return {name: instantiate(part, _convert_="all") for name, part in compose("synsin").items()}


def test_the_published_sizes() -> None:
    parts = networks("paper")
    assert {name: sizes(part) for name, part in parts.items()} == {
        "encoder": 431_064, "depth": 9_795_137, "decoder": 3_578_066, "discriminator": 5_527_682
    }  # fmt: skip
    assert sum(sizes(parts[name]) for name in ("encoder", "depth", "decoder")) == 13_804_267
    assert sizes(FeatureEncoder()) == 431_064
    assert sizes(RefinementDecoder()) == 3_578_066
    assert sizes(MultiScaleDiscriminator()) == 5_527_682


def test_the_small_ones_have_every_part_and_fit_together() -> None:
    parts = networks("small")
    assert sum(sizes(parts[name]) for name in ("encoder", "depth", "decoder")) == 1_596_751
    assert sizes(parts["discriminator"]) == 85_538
    pictures = torch.rand(2, 3, 64, 64)
    features, depth = parts["encoder"](pictures), parts["depth"](pictures)
    assert features.shape == (2, parts["encoder"].channels, 64, 64)
    assert depth.shape == (2, 1, 64, 64)
    new = parts["decoder"](features)
    assert new.shape == pictures.shape
    assert 0 <= float(new.detach().min()) < float(new.detach().max()) <= 1
    scores = [outputs[-1].mean() for outputs in parts["discriminator"](new).scales]
    (sum(scores) + depth.mean()).backward()
    parameters = [parameter for part in parts.values() for parameter in part.parameters()]
    assert all(one.grad is not None and bool(one.grad.isfinite().all()) for one in parameters)


def test_the_published_networks_take_any_side_of_multiples_of_four() -> None:
    encoder, decoder = FeatureEncoder().eval(), RefinementDecoder().eval()
    with torch.no_grad():
        features = encoder(torch.rand(1, 3, 12, 16))
        assert features.shape == (1, 64, 12, 16)
        assert decoder(features).shape == (1, 3, 12, 16)
        with pytest.raises(ValueError, match="multiples of 4 pixels, got 10 x 16"):
            decoder(torch.zeros(1, 64, 10, 16))


def test_kept_colours_go_first_and_come_out_again() -> None:
    pictures = torch.rand(2, 3, 8, 8)
    encoder = FeatureEncoder([8, 8], fold=2, keep_color=True)
    features = encoder(pictures)
    assert features.shape == (2, 6, 8, 8) == (2, encoder.channels, 8, 8)
    assert_close(features[:, :3], 2 * pictures - 1)
    assert bool((features[:, 3] == 1).all())
    decoder = RefinementDecoder(6, [8], None, fold=2, keep_color=True)
    decoder.chain.forward = lambda seen: torch.zeros_like(seen[:, :3])  # change nothing
    assert_close(decoder(features), pictures, atol=1e-6)
    holes = features.clone()
    holes[..., 3:5] = 0
    assert_close(decoder(holes)[..., :3], pictures[..., :3], atol=1e-6)
    assert 0.1 < float((decoder(holes)[..., 3:5] / pictures[..., 3:5].mean()).detach().mean()) < 2
    around = decoder(holes)[..., 3:5]
    decoder.chain.forward = lambda seen: torch.full_like(seen[:, :3], 50.0)  # as far to white as it may
    assert_close(decoder(holes)[..., 3:5], around + 0.5 * (1 - around), atol=1e-6)
    assert_close(decoder(features), pictures + 0.02 * (1 - pictures), atol=1e-6)
    decoder.chain.forward = lambda seen: torch.full_like(seen[:, :3], -50.0)  # to black
    assert_close(decoder(features), 0.98 * pictures, atol=1e-6)
    loud = torch.full_like(features, 40.0)
    assert float(decoder(loud).detach().max()) <= 1


def test_two_networks_of_one_seed_have_different_noise_and_evaluation_repeats() -> None:
    encoder, decoder = FeatureEncoder([8, 8]).eval(), RefinementDecoder(8, [8], None).eval()
    noises = [[block.branch[0].still for block in part.chain.blocks] for part in (encoder, decoder)]
    assert not any(torch.equal(one, other) for one in noises[0] for other in noises[1])
    pictures = torch.rand(2, 3, 8, 8)
    first = decoder(encoder(pictures))
    torch.randn(5)
    assert torch.equal(decoder(encoder(pictures)), first)


def test_settings_that_do_not_fit_are_refused() -> None:
    with pytest.raises(UserError, match=r"multiple of fold\^2 = 4"):
        FeatureEncoder([8, 9], fold=2)
    with pytest.raises(UserError, match="channels of at least 4, got 2"):
        RefinementDecoder(2, [8], None, keep_color=True)
    with pytest.raises(ValueError, match=r"decoder of 8 features got \(1, 7, 4, 4\)"):
        RefinementDecoder(8, [8], None)(torch.zeros(1, 7, 4, 4))


@pytest.mark.parametrize(("side", "layers", "scales"), [(64, 4, 2), (16, 3, 3), (5, 2, 1)])
def test_a_verdict_has_every_layer_of_every_scale(side: int, layers: int, scales: int) -> None:
    network = MultiScaleDiscriminator(scales, layers, 4)
    verdict = network(torch.rand(2, 3, side, side))
    assert [len(outputs) for outputs in verdict.scales] == [layers + 1] * scales
    assert all(outputs[-1].shape[1] == 1 for outputs in verdict.scales)
    assert all(bool(output.isfinite().all()) for outputs in verdict.scales for output in outputs)
    sides = [outputs[0].shape[-1] for outputs in verdict.scales]
    assert sides == [-(-side // 2**scale) // 2 + 1 for scale in range(scales)]


def test_the_second_scale_sees_the_picture_at_half_its_size() -> None:
    network = MultiScaleDiscriminator(2, 2, 4).eval()
    network.scales[1].load_state_dict(network.scales[0].state_dict())
    plain = torch.rand(1, 3, 1, 1).expand(1, 3, 32, 32)
    half = network(plain[..., :16, :16]).scales[0]
    for output, expected in zip(network(plain).scales[1], half, strict=True):
        assert_close(output, expected, atol=1e-6)  # a plain picture stays plain, its edges too


def test_only_what_lies_between_is_normalised_and_starts_small() -> None:
    network = MultiScaleDiscriminator(1, 4, 8).scales[0]
    first, middle, last = network.steps[0][0], network.steps[1][0], network.steps[-1]
    assert first.bias is not None
    assert middle.bias is None
    assert float(torch.linalg.svdvals(middle.weight.detach().flatten(1))[0]) == pytest.approx(1, abs=0.05)
    for conv in (first, last):
        fans = conv.weight[0].numel() + conv.weight.shape[0] * 16
        assert float(conv.weight.detach().std()) == pytest.approx(0.02 * (2 / fans) ** 0.5, rel=0.2)


def test_the_discriminator_comes_back_to_the_bit() -> None:
    pictures, network = torch.rand(1, 3, 16, 16), MultiScaleDiscriminator(2, 3, 4)
    network(pictures)
    again = MultiScaleDiscriminator(2, 3, 4)
    again.load_state_dict(network.state_dict())
    for one, other in zip(network(pictures).scales, again(pictures).scales, strict=True):
        assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("size", ["paper", "small"])
def test_network_takes_the_word_of_the_task(size: str, tmp_path: Path) -> None:
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "synsin.yaml").write_text("# @package _global_\ndefaults:\n  - /network: small\n")
    with initialize_config_dir(str(CONF), version_base="1.3"):
        search = f"hydra.searchpath=[file://{tmp_path}]"
        cfg = compose("train", overrides=[search, "task=synsin", f"network={size}"])
    assert sorted(cfg.network) == ["decoder", "depth", "discriminator", "encoder"]
    assert cfg.network.depth.base == {"paper": 32, "small": 16}[size]
