"""Real or made? Radford et al., "DCGAN", ICLR 2016, as in Niemeyer and Geiger, "GIRAFFE", CVPR 2021, Sec. 3.5."""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, nn

from rendra_lab.errors import UserError
from rendra_lab.networks.initialization import he_init
from rendra_lab.settings import Positive

_SLOPE = 0.2  # of leaky ReLUs
_LAST_SIDE = 4  # pixels of the last features


class Discriminator(nn.Module):
    """4x4 convolutions that halve the resolution down to 4x4 pixels, without normalisation, and one more.

    Args:
        picture_side: S, a power of two of at least 8.
        widest: channels of the last features; each layer before has half of what follows.
        biases: of the convolutions. Published: none; then the logit of a black picture is 0 whatever is learned, and
            a generator that is told off too fast flees there, from where no gradient leads back.
        centred: colours are judged about 0, in [-1, 1]; published: in [0, 1].
        torch_init: weights begin as PyTorch's do, as published: then the first thousand steps teach little.

    Raises:
        UserError: another side, or fewer channels than layers can halve.
    """

    def __init__(
        self,
        picture_side: Positive = 64,
        widest: Positive = 512,
        biases: bool = True,
        centred: bool = True,
        torch_init: bool = False,
    ) -> None:
        super().__init__()
        layers = picture_side.bit_length() - 3
        if layers < 1 or picture_side != _LAST_SIDE << layers:
            raise UserError(f"discriminator.picture_side must be 8, 16, 32, 64 .., got {picture_side}")
        if widest >> (layers - 1) < 1:
            raise UserError(
                f"discriminator.widest must be at least {1 << (layers - 1)} for pictures of {picture_side} pixels, "
                f"got {widest}"
            )
        self.picture_side, self.centred = picture_side, centred
        widths = [3, *(widest >> (layers - number) for number in range(1, layers + 1))]
        convs = [nn.Conv2d(before, after, 4, 2, 1, bias=biases) for before, after in pairwise(widths)]
        last = nn.Conv2d(widest, 1, _LAST_SIDE, bias=biases)
        if not torch_init:
            for conv in convs:
                he_init(conv, _SLOPE)
            he_init(last, slope=1.0)
        self.layers = nn.Sequential(*(step for conv in convs for step in (conv, nn.LeakyReLU(_SLOPE))), last)

    def forward(self, pictures: Tensor) -> Tensor:
        """Logits (B, 1), high for what looks real, of pictures (B, 3, S, S), sRGB in [0, 1].

        Raises:
            ValueError: pictures of another size.
        """
        if pictures.ndim != 4 or pictures.shape[1:] != (3, self.picture_side, self.picture_side):
            raise ValueError(
                f"this discriminator judges pictures (B, 3, {self.picture_side}, {self.picture_side}), got "
                f"{tuple(pictures.shape)}"
            )
        return self.layers(2 * pictures - 1 if self.centred else pictures).flatten(1)
