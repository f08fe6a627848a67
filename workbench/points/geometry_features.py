"""Sec. 3.2: the shape of clothes without any pose, one tensor an outfit.  outfit -> G (64,H,W).

G is learned, not computed (an auto-decoder): the same tensor serves every frame of its outfit.  Each pixel alone sees
few points, so G is read through three 5x5 convolutions that all outfits share; they start as a blur (ours) and learn.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

SMOOTHINGS, KERNEL = 3, 5  # facts.md 2
START = 0.01  # standard deviation of G at the start; facts.md 2


@dataclass(frozen=True)
class GeometryFeaturesConfig:
    """Size of G; the paper's by default."""

    size: int = 128  # pixels a side
    features: int = 64  # section 3.2
    pace: float = 5 / 3  # how much faster G learns than the networks: 5e-4 against 3e-4 (facts.md 2)


class GeometryFeatures(nn.Module):
    """G of C outfits, and what smooths them.

    Adam's steps do not depend on the scale of a loss, so a tensor stored at 1/pace of its value learns `pace` times
    faster under one common learning rate.
    """

    def __init__(
        self, outfits: int, config: GeometryFeaturesConfig = GeometryFeaturesConfig(), *, generator: torch.Generator
    ):
        super().__init__()
        if outfits < 1:
            raise ValueError(f"geometry features need at least one outfit, got {outfits}")
        self.config = config
        shape = (outfits, config.features, config.size, config.size)
        self.stored = nn.Parameter(torch.randn(shape, generator=generator) * (START / config.pace))
        self.smoothing = nn.ModuleList(
            nn.Conv2d(config.features, config.features, KERNEL, padding=KERNEL // 2) for _ in range(SMOOTHINGS)
        )
        for layer in self.smoothing:
            assert isinstance(layer, nn.Conv2d)
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
            with torch.no_grad():
                layer.weight.copy_(_blur(KERNEL) * torch.eye(config.features)[..., None, None])

    @property
    def tensors(self) -> Float[Tensor, "C c H W"]:
        """G of every outfit, as Eq. 6 penalises them."""
        return self.config.pace * self.stored

    def mean(self) -> Float[Tensor, "c H W"]:
        """The mean of the trained tensors: where the fit to an unseen scan begins (facts.md 2)."""
        return self.tensors.detach().mean(0)

    def smooth(self, tensors: Float[Tensor, "B c H W"]) -> Float[Tensor, "B c H W"]:
        """What the decoder reads: G through three convolutions, linear, so that noise between pixels averages out."""
        for layer in self.smoothing:
            tensors = layer(tensors)
        return tensors

    def forward(self, outfit: Int[Tensor, " B"]) -> Float[Tensor, "B c H W"]:
        """Smoothed features of the outfits named; each is smoothed once, however often it is named."""
        distinct, which = torch.unique(outfit, return_inverse=True)
        return self.smooth(self.tensors[distinct])[which]


def _blur(size: int) -> Float[Tensor, "k k"]:
    """A Gaussian of one pixel, its weights summing to 1."""
    offset = torch.arange(size) - (size - 1) / 2
    bell = torch.exp(-0.5 * offset**2)
    kernel = bell[:, None] * bell
    return kernel / kernel.sum()
