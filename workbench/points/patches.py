"""The baseline of Sec. 3.1 and 4: clothes as patches.  I (B,3,h,w), patch i, its own plane (2) -> points (N k,3).

What the paper says of SCALE, and no more, in our code: each pixel of a coarse map carries one feature and is decoded
into several points around it, so features are constant within a patch and jump between patches (Fig. 3a); there is no
geometry feature, so each outfit has a model of its own.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from workbench.points.clothed_points import ClothedPoints, clothed
from workbench.points.pose_encoder import PoseEncoder, PoseEncoderConfig
from workbench.points.shape_decoder import ShapeDecoder, ShapeDecoderConfig
from workbench.points.uv_position_map import PosedQueries

PLANE = 2  # coordinates of a point within its patch


@dataclass(frozen=True)
class PatchModelConfig:
    """facts.md 2: a map of 32 x 32, 16 points a patch."""

    encoder: PoseEncoderConfig = PoseEncoderConfig(depth=5)
    decoder: ShapeDecoderConfig = ShapeDecoderConfig(features=64 + PLANE)
    size: int = 32  # pixels of the map, input and patches
    side: int = 4  # points along a side of a patch, in training

    def __post_init__(self) -> None:
        if self.decoder.features != self.encoder.features + PLANE:
            raise ValueError(
                f"the decoder reads {self.decoder.features} features, but a patch gives {self.encoder.features} "
                f"and its {PLANE} coordinates; set decoder.features to {self.encoder.features + PLANE}"
            )


def patch_grid(side: int) -> Float[Tensor, "k 2"]:
    """side x side points in [-1, 1]^2, spread so that neighbouring patches would continue each other."""
    line = (torch.arange(side) + 0.5) * (2 / side) - 1
    return torch.cartesian_prod(line, line)


class PatchModel(nn.Module):
    """One outfit: a UNet over the position map and a decoder of (u_i, place in the patch, feature of the patch)."""

    def __init__(self, config: PatchModelConfig = PatchModelConfig(), *, generator: torch.Generator):
        super().__init__()
        self.config = config
        self.encoder = PoseEncoder(config.encoder, generator=generator)
        self.decoder = ShapeDecoder(config.decoder, generator=generator)

    def penalised(self) -> Float[Tensor, "1 1 1 1"]:
        """There is no G: the term of Eq. 6 is zero."""
        return next(self.parameters()).new_zeros(1, 1, 1, 1)

    def forward(
        self, position_map: Float[Tensor, "B i H W"], outfit: Int[Tensor, " B"], posed: PosedQueries
    ) -> ClothedPoints:
        """Patches at the pixels that `posed` holds; points patch by patch.

        Raises ValueError for frames of two outfits: each needs its own model.
        """
        if len(outfit.unique()) > 1:
            raise ValueError(f"patches are of one outfit, got {len(outfit.unique())} in a batch; train one model each")
        return self.decode(self.encoder(position_map), posed, self.config.side)

    def decode(self, features: Float[Tensor, "B c H W"], posed: PosedQueries, side: int) -> ClothedPoints:
        """`side` x `side` points a patch."""
        grid = patch_grid(side).to(posed.u.device)
        pixel = pixel_of(posed.u, features.shape[-1])
        z = features.flatten(-2)[..., pixel].mT.float()  # of the nearest pixel: constant within the patch
        B, N, k = len(z), z.shape[1], len(grid)
        inputs = torch.cat(
            [
                posed.u[None, :, None].expand(B, N, k, -1),
                grid.expand(B, N, k, -1),
                z[:, :, None].expand(B, N, k, -1),
            ],
            -1,
        )
        canonical = self.decoder(inputs.flatten(1, 2))
        around = PosedQueries(
            u=posed.u.repeat_interleave(k, 0),
            points=posed.points.repeat_interleave(k, 1),
            transforms=posed.transforms.repeat_interleave(k, 1),
        )
        return clothed(around, type(canonical)(canonical.displacement.float(), canonical.normal.float()))


def pixel_of(u: Float[Tensor, "N 2"], size: int) -> Int[Tensor, " N"]:
    """row * size + column of the pixel that a point lies in."""
    column, row = (u * size).long().clamp(0, size - 1).unbind(1)
    return row * size + column
