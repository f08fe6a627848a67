"""Eq. 1 on a whole map: the decoder at every second pixel, the rest between them.  pixels (N) -> r_i, n_i (N,3).

Features are bilinear between the pixels of smaller maps, so the decoder's answer bends little from pixel to pixel.
Where its second differences say that a straight line would be off by more than a tolerance, the pixel is decoded.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from workbench.points.shape_decoder import CanonicalClothes
from workbench.points.uv_position_map import Atlas

STRIDE = 2
MISSING = -1


@dataclass(frozen=True, eq=False)
class Lattice:
    """The pixels of a map as blends of four corners each."""

    u: Float[Tensor, "C 2"]  # of the corners, in [0, 1] but for those just beyond the edge
    corners: Int[Tensor, "N 4"]
    weights: Float[Tensor, "N 4"]
    slack: Float[Tensor, "N 2"]  # f (1 - f) / 2 along rows and columns: the error of a line through a parabola
    across: Int[Tensor, "C 2"]  # a corner's neighbours in its row, or MISSING
    down: Int[Tensor, "C 2"]  # ... and in its column

    @staticmethod
    def of(atlas: Atlas) -> "Lattice":
        """Corners are the pixels of even row and column that a pixel of the body touches."""
        row, column = atlas.pixel // atlas.size, atlas.pixel % atlas.size
        width = atlas.size // STRIDE + 2
        r, c = row // STRIDE, column // STRIDE
        f = torch.stack([column % STRIDE, row % STRIDE], 1).float() / STRIDE
        cell = torch.stack([r * width + c, r * width + c + 1, (r + 1) * width + c, (r + 1) * width + c + 1], 1)
        x, y = f.unbind(1)
        weights = torch.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], 1)
        cell = torch.where(weights > 0, cell, cell[:, :1])  # a pixel that is a corner needs no other
        distinct, corners = torch.unique(cell, return_inverse=True)
        number = torch.full((width * (width + 1),), MISSING)
        number[distinct] = torch.arange(len(distinct))

        def neighbours(step: int) -> Int[Tensor, "C 2"]:
            return torch.stack([number[(distinct - step).clamp(min=0)], number[distinct + step]], 1)

        place = torch.stack([distinct % width, distinct // width], 1) * STRIDE
        return Lattice(
            u=(place + 0.5) / atlas.size,
            corners=corners,
            weights=weights,
            slack=f * (1 - f) / 2,
            across=neighbours(1),
            down=neighbours(width),
        )

    def between(self, values: Float[Tensor, "C k"]) -> Float[Tensor, "N k"]:
        """Bilinear at the pixels."""
        return (values[self.corners] * self.weights[..., None]).sum(1)

    def clothes(self, at_corners: CanonicalClothes) -> CanonicalClothes:
        """The clothes of every pixel from those of the corners."""
        blended = self.between(torch.cat([at_corners.displacement, at_corners.normal], 1))
        return CanonicalClothes(blended[:, :3].contiguous(), blended[:, 3:].contiguous())

    def doubtful(self, values: Float[Tensor, "C 3"], tolerance: float) -> Bool[Tensor, " N"]:
        """Pixels where `between` may be off by more than the tolerance."""
        bends = torch.stack([_bend(values, self.across), _bend(values, self.down)], 1)
        worst = bends[self.corners].amax(1)
        return (worst * self.slack).sum(1) > tolerance


def _bend(values: Float[Tensor, "C 3"], neighbours: Int[Tensor, "C 2"]) -> Float[Tensor, " C"]:
    """The length of the second difference; at the end of a row that of its neighbour, without bound in a row of two."""
    before, after = neighbours.unbind(1)
    bend = (values[before] + values[after] - 2 * values).norm(dim=1)
    missing = neighbours == MISSING
    bend = torch.where(missing.any(1), torch.inf, bend)
    return torch.where(missing.any(1), bend[neighbours.amax(1)], bend)
