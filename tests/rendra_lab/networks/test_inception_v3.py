"""The network of FID: its parts by their published names, and the files that it takes."""

from pathlib import Path

import pytest
import torch
from assertions import assert_close
from safetensors.torch import save_file
from torch import Tensor
from torch.nn import functional as F

from rendra_lab.errors import UserError
from rendra_lab.networks.inception_v3 import InceptionV3

# channels and places of every block of a picture of 299 x 299
BLOCKS = {
    "Conv2d_1a_3x3": (32, 149), "Conv2d_2a_3x3": (32, 147), "Conv2d_2b_3x3": (64, 147), "Conv2d_3b_1x1": (80, 73),
    "Conv2d_4a_3x3": (192, 71), "Mixed_5b": (256, 35), "Mixed_5c": (288, 35), "Mixed_5d": (288, 35),
    "Mixed_6a": (768, 17), "Mixed_6b": (768, 17), "Mixed_6c": (768, 17), "Mixed_6d": (768, 17),
    "Mixed_6e": (768, 17), "Mixed_7a": (1280, 8), "Mixed_7b": (2048, 8), "Mixed_7c": (2048, 8),
}  # fmt: skip


@pytest.fixture(scope="module")
def network() -> InceptionV3:
    with torch.random.fork_rng([]):
        torch.manual_seed(3)
        made = InceptionV3().eval()
    generator = torch.Generator().manual_seed(0)
    for name, each in made.named_buffers():  # statistics that a wrong assignment would be seen by
        if name.endswith("running_mean"):
            each.copy_(0.1 * torch.randn(each.shape, generator=generator))
        elif name.endswith("running_var"):
            each.copy_(0.5 + torch.rand(each.shape, generator=generator))
    return made.requires_grad_(False)


def test_blocks_have_the_published_sizes(network: InceptionV3) -> None:
    with torch.device("meta"):
        outline, sizes = InceptionV3().eval(), {}
        for name, part in outline.named_children():
            part.register_forward_hook(lambda _, __, seen, name=name: sizes.update({name: tuple(seen.shape[1:])}))
        assert outline(torch.zeros(1, 3, 299, 299)).shape == (1, 2048)
    assert sizes == {name: (channels, side, side) for name, (channels, side) in BLOCKS.items()}
    assert sum(each.numel() for each in network.parameters()) == 23_834_568 - 2_049_000  # less 1,000 classes


def test_names_are_the_published_ones(network: InceptionV3) -> None:
    names = set(network.state_dict())
    assert len(names) == 94 * 6  # of each convolution a weight, and five of its normalisation
    shapes = {
        "Conv2d_1a_3x3.conv.weight": (32, 3, 3, 3), "Mixed_5b.branch5x5_2.conv.weight": (64, 48, 5, 5),
        "Mixed_5c.branch_pool.conv.weight": (64, 256, 1, 1), "Mixed_6a.branch3x3dbl_3.conv.weight": (96, 96, 3, 3),
        "Mixed_6b.branch7x7_2.conv.weight": (128, 128, 1, 7), "Mixed_6c.branch7x7dbl_2.conv.weight": (160, 160, 7, 1),
        "Mixed_6e.branch7x7dbl_5.conv.weight": (192, 192, 1, 7), "Mixed_7a.branch7x7x3_4.bn.running_var": (192,),
        "Mixed_7b.branch3x3_2b.conv.weight": (384, 384, 3, 1), "Mixed_7c.branch_pool.bn.bias": (192,),
        "Mixed_7c.branch3x3dbl_3a.conv.weight": (384, 384, 1, 3),
    }  # fmt: skip
    assert {name: tuple(network.state_dict()[name].shape) for name in shapes} == shapes


def seen(network: InceptionV3, name: str, x: Tensor) -> Tensor:
    """One convolution, from its tensors alone."""
    state = network.state_dict()
    weight = state[f"{name}.conv.weight"]
    x = F.conv2d(x, weight, padding=tuple(side // 2 for side in weight.shape[2:]))
    norm = [state[f"{name}.bn.{each}"] for each in ("running_mean", "running_var", "weight", "bias")]
    return F.relu(F.batch_norm(x, *norm, eps=1e-3))


def test_averages_do_not_count_padding_and_the_last_block_takes_a_maximum(network: InceptionV3) -> None:
    generator = torch.Generator().manual_seed(1)
    x = torch.randn(1, 2048, 4, 4, generator=generator)
    filled = F.pad(torch.ones(1, 1, 4, 4), [1] * 4)
    inside = F.avg_pool2d(F.pad(x, [1] * 4), 3, 1) / F.avg_pool2d(filled, 3, 1)
    largest = F.max_pool2d(F.pad(x, [1] * 4, value=-1e9), 3, 1)
    for name, width, pooled in (("Mixed_7b", 1280, inside), ("Mixed_7c", 2048, largest)):
        last = network.get_submodule(name)(x[:, :width])[:, -192:]
        assert_close(last, seen(network, f"{name}.branch_pool", pooled[:, :width]), atol=1e-5)


def test_branches_split_where_the_figure_splits_them(network: InceptionV3) -> None:
    x = torch.randn(1, 2048, 4, 4, generator=torch.Generator().manual_seed(2))
    name = "Mixed_7c"
    short = seen(network, f"{name}.branch3x3_1", x)
    long = seen(network, f"{name}.branch3x3dbl_2", seen(network, f"{name}.branch3x3dbl_1", x))
    parts = [
        seen(network, f"{name}.branch1x1", x),
        seen(network, f"{name}.branch3x3_2a", short),
        seen(network, f"{name}.branch3x3_2b", short),
        seen(network, f"{name}.branch3x3dbl_3a", long),
        seen(network, f"{name}.branch3x3dbl_3b", long),
    ]
    assert_close(network.get_submodule(name)(x)[:, :-192], torch.cat(parts, 1), atol=1e-5)


def test_a_file_gives_the_network_that_it_holds(network: InceptionV3, tmp_path: Path) -> None:
    pictures = torch.rand(2, 3, 80, 76)
    state = {name: each for name, each in network.state_dict().items() if not name.endswith("num_batches_tracked")}
    save_file({**state, "fc.weight": torch.zeros(1008, 2), "fc.bias": torch.zeros(1008)}, tmp_path / "a.safetensors")
    again = InceptionV3.of_file(tmp_path / "a.safetensors")
    assert torch.equal(again(pictures), network(pictures))
    assert not any(each.requires_grad for each in again.parameters())
    assert not again.training
    with pytest.raises(ValueError, match=r"at least 75 x 75 pixels, got \(74, 90\)"):
        network(torch.zeros(1, 3, 74, 90))


def test_files_of_other_networks_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    torch.save({"fc.weight": torch.zeros(1000, 2048)}, path)
    with pytest.raises(UserError, match=r"has 1,000 classes, the network of FID 1,008: .* pt_inception-2015-12-05"):
        InceptionV3.of_file(path)
    torch.save({"Conv2d_1a_3x3.conv.weight": torch.zeros(32, 3, 5, 5)}, path)
    with pytest.raises(
        UserError, match=r"is not InceptionV3: Conv2d_1a_3x3\.conv\.weight must be numbers \(32, 3, 3"
    ):
        InceptionV3.of_file(path)
    torch.save({"fc.weight": torch.zeros(1008, 2048)}, path)
    with pytest.raises(UserError, match=r"found nothing; pytorch-fid's"):
        InceptionV3.of_file(path)
