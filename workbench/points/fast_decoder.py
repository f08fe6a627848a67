"""Eq. 1 at run time: the trained decoder with all that does not change folded in.  z_P (N,64) -> r_i, n_i (N,3).

Against the plain decoder of the same weights: only pixels that show the body are decoded (62 % of the map on the
default body); BatchNorm, at run time a linear map, is folded into the layer before it; the share of u_i and z_i^G in
the first and the fifth layer is computed once an outfit; rows go through all layers in blocks that stay in the cache.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from workbench.points.shape_decoder import SKIP_LAYER, CanonicalClothes, DecoderLayer, ShapeDecoder

BLOCK = 4096  # rows at a time, 2 MB an activation; ours: 512 to 4,096 are equal, 40,000 half as fast
COORDINATES = 2  # u_i comes first among the decoder's inputs


@dataclass(frozen=True, eq=False)
class OutfitShare:
    """What u_i and z_i^G of one outfit add to the first and the fifth layer, for each query."""

    first: Float[Tensor, "N w"]
    skip: Float[Tensor, "N w"]

    def __len__(self) -> int:
        return len(self.first)

    def at(self, index: Int[Tensor, " M"]) -> "OutfitShare":
        """Some of the queries."""
        return OutfitShare(self.first[index], self.skip[index])


@dataclass(frozen=True, eq=False)
class Affine:
    """x -> x weight^T + bias."""

    weight: Float[Tensor, "o i"]
    bias: Float[Tensor, " o"]

    def __call__(self, x: Float[Tensor, "N i"]) -> Float[Tensor, "N o"]:
        return nn.functional.linear(x, self.weight, self.bias)

    def to(self, dtype: torch.dtype) -> "Affine":
        return Affine(self.weight.to(dtype), self.bias.to(dtype))


def folded(layer: DecoderLayer) -> Affine:
    """A layer's linear map with its BatchNorm, in evaluation mode, inside: up to the Softplus."""
    norm = layer.norm
    assert norm.running_var is not None
    assert norm.running_mean is not None
    scale = norm.weight / (norm.running_var + norm.eps).sqrt()
    bias = (layer.linear.bias - norm.running_mean) * scale + norm.bias
    return Affine((layer.linear.weight * scale[:, None]).detach(), bias.detach())


class FastDecoder:
    """A trained decoder for inference only; it agrees with `ShapeDecoder` in evaluation mode up to rounding."""

    def __init__(self, decoder: ShapeDecoder, pose_features: int, precision: torch.dtype = torch.float32):
        """pose_features: how many of the decoder's inputs are z_P; the others never change for an outfit."""
        self.precision = precision
        moving = slice(COORDINATES, COORDINATES + pose_features)
        layers = [folded(layer) for layer in decoder.shared_layers]
        first, skip = layers[0], layers[SKIP_LAYER]
        inputs = first.weight.shape[1]
        fixed = [k for k in range(inputs) if not moving.start <= k < moving.stop]
        self._fixed_first = Affine(first.weight[:, fixed], first.bias)
        self._fixed_skip = Affine(skip.weight[:, fixed], skip.bias)
        self._pose_first = first.weight[:, moving].mT.contiguous().to(precision)
        # pose features and activations stand side by side at the fifth layer: one product
        self._skip = skip.weight[:, [*range(moving.start, moving.stop), *range(inputs, skip.weight.shape[1])]].mT
        self._skip = self._skip.contiguous().to(precision)
        self._inner = [layer.to(precision) for layer in layers[1:SKIP_LAYER]]
        self._r = [folded(layer).to(precision) for layer in decoder.displacement_layers]
        self._n = [folded(layer).to(precision) for layer in decoder.normal_layers]
        to_r, scale = decoder.to_displacement, decoder.config.displacement_scale
        self._to_r = Affine(scale * to_r.weight.detach(), scale * to_r.bias.detach())
        self._to_n = Affine(decoder.to_normal.weight.detach(), decoder.to_normal.bias.detach())

    @torch.no_grad()
    def share(self, u: Float[Tensor, "N 2"], geometry: Float[Tensor, "N d"]) -> OutfitShare:
        """The constant part of an outfit at the queries: once an outfit."""
        fixed = torch.cat([u, geometry], 1)
        return OutfitShare(self._fixed_first(fixed).to(self.precision), self._fixed_skip(fixed).to(self.precision))

    @torch.no_grad()
    def __call__(self, pose: Float[Tensor, "N c"], share: OutfitShare) -> CanonicalClothes:
        """The clothes at every query of the share.  Raises ValueError where the counts disagree."""
        if len(pose) != len(share):
            raise ValueError(
                f"there are pose features of {len(pose)} queries, but the outfit's share is of {len(share)}"
            )
        displacement, normal = pose.new_empty(len(pose), 3), pose.new_empty(len(pose), 3)
        for start in range(0, len(pose), BLOCK):
            rows = slice(start, start + BLOCK)
            z_P = pose[rows].to(self.precision)
            x = _softplus(torch.addmm(share.first[rows], z_P, self._pose_first))
            for layer in self._inner:
                x = _softplus(layer(x))
            x = _softplus(torch.addmm(share.skip[rows], torch.cat([z_P, x], 1), self._skip))
            displacement[rows] = self._to_r(_through(self._r, x).to(pose.dtype))
            normal[rows] = self._to_n(_through(self._n, x).to(pose.dtype))
        return CanonicalClothes(displacement, normal)


def _through(layers: list[Affine], x: Float[Tensor, "N w"]) -> Float[Tensor, "N w"]:
    for layer in layers:
        x = _softplus(layer(x))
    return x


def _softplus(x: Float[Tensor, "N w"]) -> Float[Tensor, "N w"]:
    return nn.functional.softplus(x)
