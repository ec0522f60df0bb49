"""A feature network of which everything is known: the means of a picture's four quarters."""

import torch
from torch import Tensor, nn

from rendra_lab.generative.features import FeatureNetwork


class Quarters(FeatureNetwork):
    """Twelve numbers, which pictures of 2 x 2 pixels are."""

    name = "quarters"
    width = 12

    def __init__(self) -> None:
        super().__init__(2)
        self.asked = 0  # how many pictures it has seen

    def _network(self, device: torch.device) -> nn.Module:
        return nn.Flatten()

    def _vectors(self, network: nn.Module, pictures: Tensor) -> Tensor:
        self.asked += len(pictures)
        return network(pictures)

    def _weights(self) -> str:
        return str(id(self))


def tiny(count: int, seed: int, middle: float = 0.5, spread: float = 0.1) -> Tensor:
    """Pictures (count, 3, 2, 2), which a file of bytes would keep as they are."""
    generator = torch.Generator().manual_seed(seed)
    values = middle + spread * torch.randn(count, 3, 2, 2, generator=generator)
    return (values.clamp(0, 1) * 255).round() / 255
