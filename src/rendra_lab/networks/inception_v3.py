"""InceptionV3 as the Fréchet inception distance is defined by it: the 2,048 numbers behind its last pool.

Szegedy et al., "Rethinking the Inception Architecture for Computer Vision", CVPR 2016, Sec. 6 and Figures 5 to 7, as
the TensorFlow graph of 2015-12-05 has it, whose weights pytorch-fid keeps. Beside the better known classifier of
torchvision it differs in pools: averages do not count padding, and the last block takes a maximum. Parts bear the
published names of the weights.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab import report
from rendra_lab.errors import UserError
from rendra_lab.networks.foreign_weights import ForeignWeights

_WANTED = "pytorch-fid's pt_inception-2015-12-05-6726825d.pth"
_CLASSES = 1008  # of the graph of 2015; torchvision's weights have 1,000
_BN_EPS = 1e-3
_LEAST_PX = 75

Step = tuple[str, int, int | tuple[int, int], int]  # name, channels, kernel size, stride
_STEM: tuple[Step | None, ...] = (
    ("Conv2d_1a_3x3", 32, 3, 2), ("Conv2d_2a_3x3", 32, 3, 1), ("Conv2d_2b_3x3", 64, 3, 1), None,
    ("Conv2d_3b_1x1", 80, 1, 1), ("Conv2d_4a_3x3", 192, 3, 1), None,
)  # fmt: skip
_PADDED_IN_STEM = "Conv2d_2b_3x3"  # the others take windows inside the picture alone


class InceptionV3(nn.Module):
    """The network without its classifier. A new one has random weights; `of_file` gives the published one."""

    width = 2048

    def __init__(self) -> None:
        super().__init__()
        width = 3
        for step in _STEM:
            if step is not None:
                name, channels, size, stride = step
                self.add_module(name, _Convolution(width, channels, size, stride, name == _PADDED_IN_STEM))
                width = channels
        blocks = _blocks()
        for name, block in blocks.items():
            self.add_module(name, block)
        self._names = tuple(blocks)

    @staticmethod
    def of_file(path: Path) -> InceptionV3:
        """The network of a file, in evaluation mode, without gradients of its weights.

        Args:
            path: of the weights by their published names, as of torch.save or .safetensors; what the file says of a
                classifier is not looked at, but that one of 1,000 classes is another network's.

        Raises:
            UserError: there is no such file, or it holds something else.
        """
        weights = ForeignWeights(path, "InceptionV3", _WANTED)
        classes = weights.state.get("fc.weight")
        if isinstance(classes, Tensor) and len(classes) != _CLASSES:
            raise UserError(
                f"{report.short_path(path)} has {len(classes):,} classes, the network of FID {_CLASSES:,}: it would "
                f"give numbers that are not FID; {_WANTED} is wanted"
            )
        network = InceptionV3()
        state = network.state_dict()
        counters = {name for name in state if name.endswith("num_batches_tracked")}  # older files have none
        taken = {name: weights.taken(name, tuple(each.shape)) for name, each in state.items() if name not in counters}
        network.load_state_dict(taken, strict=False)
        return network.eval().requires_grad_(False)

    def forward(self, pictures: Tensor) -> Tensor:
        """What it sees (B, 2048) in pictures (B, 3, H, W), sRGB in [0, 1]; published numbers take 299 x 299.

        Raises:
            ValueError: a side below 75 pixels, of which nothing is left at the last block.
        """
        if min(pictures.shape[2:]) < _LEAST_PX:
            raise ValueError(f"InceptionV3 needs at least 75 x 75 pixels, got {tuple(pictures.shape[2:])}")
        x = 2 * pictures - 1
        for step in _STEM:
            x = F.max_pool2d(x, 3, 2) if step is None else self.get_submodule(step[0])(x)
        for name in self._names:
            x = self.get_submodule(name)(x)
        return x.mean((2, 3))


class _Convolution(nn.Module):
    """A convolution without bias, normalised, and cut at 0."""

    def __init__(
        self, channels_in: int, channels_out: int, size: int | tuple[int, int], stride: int, is_padded: bool
    ) -> None:
        super().__init__()
        sides = (size, size) if isinstance(size, int) else size
        padding = (sides[0] // 2, sides[1] // 2) if is_padded else (0, 0)
        self.conv = nn.Conv2d(channels_in, channels_out, sides, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(channels_out, _BN_EPS)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)))


class _Block(nn.Module):
    """Branches side by side, their channels one behind the other.

    Args:
        width: channels that come in.
        branches: steps of each; those of the last may begin with a pool: "average" and "maximum" keep the size,
            "halve" is a branch of its own. Two steps of one branch that end in `a` and `b` see the same.
    """

    def __init__(self, width: int, branches: tuple[tuple[Step | str, ...], ...]) -> None:
        super().__init__()
        self.branches = branches
        for branch in branches:
            channels = width
            for step in branch:
                if isinstance(step, str):
                    continue
                name, wider, size, stride = step
                self.add_module(name, _Convolution(channels, wider, size, stride, stride == 1))
                channels = channels if name.endswith("a") else wider

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([seen for branch in self.branches for seen in self._seen(branch, x)], 1)

    def _seen(self, branch: tuple[Step | str, ...], x: Tensor) -> list[Tensor]:
        ends: list[Tensor] = []
        for step in branch:
            if isinstance(step, str):
                x = _POOLS[step](x)
            elif step[0].endswith(("a", "b")):
                ends.append(self.get_submodule(step[0])(x))
            else:
                x = self.get_submodule(step[0])(x)
        return ends or [x]


_POOLS = {
    "average": lambda x: F.avg_pool2d(x, 3, 1, 1, count_include_pad=False),
    "maximum": lambda x: F.max_pool2d(x, 3, 1, 1),
    "halve": lambda x: F.max_pool2d(x, 3, 2),
}


def _blocks() -> dict[str, _Block]:
    """From 35 x 35 places to 8 x 8, by their published names."""
    return {
        "Mixed_5b": _Block(192, _small_windows(32)),
        "Mixed_5c": _Block(256, _small_windows(64)),
        "Mixed_5d": _Block(288, _small_windows(64)),
        "Mixed_6a": _Block(288, _FIRST_HALVING),
        "Mixed_6b": _Block(768, _rows_and_columns(128)),
        "Mixed_6c": _Block(768, _rows_and_columns(160)),
        "Mixed_6d": _Block(768, _rows_and_columns(160)),
        "Mixed_6e": _Block(768, _rows_and_columns(192)),
        "Mixed_7a": _Block(768, _SECOND_HALVING),
        "Mixed_7b": _Block(1280, _side_by_side("average")),
        "Mixed_7c": _Block(2048, _side_by_side("maximum")),
    }


_FIRST_HALVING: tuple[tuple[Step | str, ...], ...] = (
    (("branch3x3", 384, 3, 2),),
    (("branch3x3dbl_1", 64, 1, 1), ("branch3x3dbl_2", 96, 3, 1), ("branch3x3dbl_3", 96, 3, 2)),
    ("halve",),
)
_SECOND_HALVING: tuple[tuple[Step | str, ...], ...] = (
    (("branch3x3_1", 192, 1, 1), ("branch3x3_2", 320, 3, 2)),
    (
        ("branch7x7x3_1", 192, 1, 1), ("branch7x7x3_2", 192, (1, 7), 1), ("branch7x7x3_3", 192, (7, 1), 1),
        ("branch7x7x3_4", 192, 3, 2),
    ),
    ("halve",),
)  # fmt: skip


def _small_windows(pooled: int) -> tuple[tuple[Step | str, ...], ...]:
    return (
        (("branch1x1", 64, 1, 1),),
        (("branch5x5_1", 48, 1, 1), ("branch5x5_2", 64, 5, 1)),
        (("branch3x3dbl_1", 64, 1, 1), ("branch3x3dbl_2", 96, 3, 1), ("branch3x3dbl_3", 96, 3, 1)),
        ("average", ("branch_pool", pooled, 1, 1)),
    )


def _rows_and_columns(inner: int) -> tuple[tuple[Step | str, ...], ...]:
    row, column = (1, 7), (7, 1)
    return (
        (("branch1x1", 192, 1, 1),),
        (("branch7x7_1", inner, 1, 1), ("branch7x7_2", inner, row, 1), ("branch7x7_3", 192, column, 1)),
        (
            ("branch7x7dbl_1", inner, 1, 1), ("branch7x7dbl_2", inner, column, 1), ("branch7x7dbl_3", inner, row, 1),
            ("branch7x7dbl_4", inner, column, 1), ("branch7x7dbl_5", 192, row, 1),
        ),
        ("average", ("branch_pool", 192, 1, 1)),
    )  # fmt: skip


def _side_by_side(pool: str) -> tuple[tuple[Step | str, ...], ...]:
    row, column = (1, 3), (3, 1)
    return (
        (("branch1x1", 320, 1, 1),),
        (("branch3x3_1", 384, 1, 1), ("branch3x3_2a", 384, row, 1), ("branch3x3_2b", 384, column, 1)),
        (
            ("branch3x3dbl_1", 448, 1, 1), ("branch3x3dbl_2", 384, 3, 1), ("branch3x3dbl_3a", 384, row, 1),
            ("branch3x3dbl_3b", 384, column, 1),
        ),
        (pool, ("branch_pool", 192, 1, 1)),
    )  # fmt: skip
