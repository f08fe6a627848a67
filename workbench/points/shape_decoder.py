"""Eq. 1: clothes at a point of the body.  u_i (2), z_P (64), z_G (64) -> displacement r_i (3), normal n_i (3).

Features are read between pixels (bilinearly), so they vary continuously over the body (Fig. 3b) and any point may be
asked for.  Both r and n are in the canonical frame; T_i carries them to the pose (Eq. 2).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

SHARED_LAYERS, SKIP_LAYER, BRANCH_LAYERS = 5, 4, 2  # facts.md 2: eight layers, the input again at the fifth


@dataclass(frozen=True)
class ShapeDecoderConfig:
    """The per-point network; the paper's by default (0.60 M parameters; facts.md 2)."""

    width: int = 256
    features: int = 128  # z_P and z_G together
    displacement_scale: float = 0.02  # metres at an output of 1; facts.md 2


@dataclass(frozen=True)
class CanonicalClothes:
    """What the decoder says of each query, in the canonical frame."""

    displacement: Float[Tensor, "*B 3"]  # r, metres
    normal: Float[Tensor, "*B 3"]  # not yet of unit length


class ShapeDecoder(nn.Module):
    """Five shared layers of width 256 with BatchNorm and Softplus, then two more and a linear one for each of r and n.

    The inputs are joined again before the fifth layer.
    """

    def __init__(self, config: ShapeDecoderConfig = ShapeDecoderConfig(), *, generator: torch.Generator):
        super().__init__()
        self.config = config
        inputs, width = config.features + 2, config.width
        sizes = [inputs if k == 0 else width + inputs if k == SKIP_LAYER else width for k in range(SHARED_LAYERS)]
        # plain lists beside the registered ones keep their type
        self.shared_layers = [DecoderLayer(size, width) for size in sizes]
        self.displacement_layers = [DecoderLayer(width, width) for _ in range(BRANCH_LAYERS)]
        self.normal_layers = [DecoderLayer(width, width) for _ in range(BRANCH_LAYERS)]
        self.shared = nn.ModuleList(self.shared_layers)
        self.displacement = nn.ModuleList(self.displacement_layers)
        self.normal = nn.ModuleList(self.normal_layers)
        self.to_displacement, self.to_normal = nn.Linear(width, 3), nn.Linear(width, 3)
        for part in self.modules():
            if isinstance(part, nn.Linear):
                nn.init.kaiming_uniform_(part.weight, nonlinearity="relu", generator=generator)
                nn.init.zeros_(part.bias)

    def forward(self, inputs: Float[Tensor, "*B i"]) -> CanonicalClothes:
        """inputs: u_i, z_P, z_G side by side."""
        rows = inputs.flatten(0, -2)
        x = rows
        for k, layer in enumerate(self.shared_layers):
            x = layer(torch.cat([rows, x], -1) if k == SKIP_LAYER else x)
        r, n = x, x
        for layer in self.displacement_layers:
            r = layer(r)
        for layer in self.normal_layers:
            n = layer(n)
        return CanonicalClothes(
            displacement=self.config.displacement_scale * self.to_displacement(r).view(*inputs.shape[:-1], 3),
            normal=self.to_normal(n).view(*inputs.shape[:-1], 3),
        )


class DecoderLayer(nn.Module):
    """Linear, BatchNorm over all points, Softplus."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.linear = nn.Linear(inputs, outputs)
        # momentum=None: running statistics are plain means over a pass of calibration (training.py), not a moving
        # average whose state a resumed run would have to carry
        self.norm = nn.BatchNorm1d(outputs, momentum=None)

    def forward(self, x: Float[Tensor, "N i"]) -> Float[Tensor, "N o"]:
        return nn.functional.softplus(self.norm(self.linear(x)))


def read_features(features: Float[Tensor, "B c H W"], u: Float[Tensor, "N 2"]) -> Float[Tensor, "B N c"]:
    """Bilinear features at any u of the square; a pixel's centre reads that pixel (Fig. 3b)."""
    at = (2 * u - 1).expand(len(features), 1, -1, 2)
    read = nn.functional.grid_sample(features, at, mode="bilinear", padding_mode="border", align_corners=False)
    return read[:, :, 0].mT


def decoder_inputs(
    u: Float[Tensor, "N 2"], pose: Float[Tensor, "B c H W"], geometry: Float[Tensor, "B d h w"]
) -> Float[Tensor, "B N i"]:
    """[u_i, z_i^P, z_i^G] of every query."""
    z_P, z_G = read_features(pose, u), read_features(geometry, u)
    return torch.cat([u.expand(len(z_P), -1, -1), z_P, z_G], -1)
