"""Real or made? Radford et al., "DCGAN", ICLR 2016, as in Niemeyer and Geiger, "GIRAFFE", CVPR 2021, Sec. 3.5."""

from __future__ import annotations

from itertools import pairwise

from torch import Tensor, nn

from rendra_lab.errors import UserError
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

    Raises:
        UserError: another side, or fewer channels than layers can halve.
    """

    def __init__(self, picture_side: Positive = 64, widest: Positive = 512, biases: bool = False) -> None:
        super().__init__()
        layers = picture_side.bit_length() - 3
        if layers < 1 or picture_side != _LAST_SIDE << layers:
            raise UserError(f"discriminator.picture_side must be 8, 16, 32, 64 .., got {picture_side}")
        if widest >> (layers - 1) < 1:
            raise UserError(
                f"discriminator.widest must be at least {1 << (layers - 1)} for pictures of {picture_side} pixels, "
                f"got {widest}"
            )
        self.picture_side = picture_side
        widths = [3, *(widest >> (layers - number) for number in range(1, layers + 1))]
        steps: list[nn.Module] = []
        for before, after in pairwise(widths):
            steps += [nn.Conv2d(before, after, 4, 2, 1, bias=biases), nn.LeakyReLU(_SLOPE)]
        self.layers = nn.Sequential(*steps, nn.Conv2d(widest, 1, _LAST_SIDE, bias=biases))

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
        return self.layers(pictures).flatten(1)
