"""A surface as overlapping patches.  points (N,3) -> P patches of n points, whose windows sum to 1 at every point.

What is computed patch by patch is put together without seams: a window is smooth and vanishes at its patch's border.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree
from torch import Tensor

UNCOVERED = 1e-3  # a point whose windows are all below this is not covered


@dataclass(frozen=True, eq=False)
class Patches:
    """vertices (P,n): the points of each patch.  windows (P,n): what its value there counts."""

    vertices: Int[Tensor, "P n"]
    windows: Float[Tensor, "P n"]

    @staticmethod
    def of(points: Float[Tensor, "N 3"], count: int, overlap: float = 3.0) -> "Patches":
        """`count` patches of equally many points, each the nearest to a centre; a point is in `overlap` on average, or
        in more where that leaves one uncovered.  Centres are as far from each other as they can be."""
        places = points.detach().double().numpy()
        count = min(count, len(places))
        centres = places[_spread(places, count)]
        size = min(len(places), math.ceil(overlap * len(places) / count))
        while True:
            distance, index = KDTree(places).query(centres, k=size)
            distance, index = distance.reshape(count, size), index.reshape(count, size)
            radius = np.maximum(distance[:, -1:], 1e-9) * (1.1 if size == len(places) else 1.0)
            window = (1 - (distance / radius) ** 2) ** 2
            total = np.bincount(index.ravel(), window.ravel(), minlength=len(places))
            if total.min() > UNCOVERED or size == len(places):
                break
            size = min(len(places), math.ceil(1.1 * size))
        window = window / np.maximum(total, UNCOVERED)[index]
        return Patches(torch.from_numpy(index), torch.from_numpy(window).float())

    def centres(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "P 3"]:
        """The middle of each patch, as its windows count."""
        weights = self.windows / self.windows.sum(1, keepdim=True)
        return (weights[..., None] * points[self.vertices]).sum(1)

    def checked(self, entries: int) -> "Patches":
        """These, if they can be patches with so many entries in all; else ValueError."""
        if self.vertices.dim() != 2 or self.vertices.shape != self.windows.shape or self.vertices.numel() != entries:
            sizes = f"{tuple(self.vertices.shape)} points, {tuple(self.windows.shape)} windows"
            raise ValueError(f"patches with {sizes} for {entries} entries")
        found = torch.unique(self.vertices)
        if not torch.equal(found, torch.arange(len(found))) or not bool(torch.isfinite(self.windows).all()):
            raise ValueError("patches that leave points out, or windows that are no numbers")
        return self

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def point_count(self) -> int:
        return int(self.vertices.max()) + 1

    def spread(self, values: Float[Tensor, "*B P n C"]) -> Float[Tensor, "*B N C"]:
        """Values on the patches -> on the surface."""
        weighed = (values * self.windows[..., None]).flatten(-3, -2)
        out = weighed.new_zeros(*weighed.shape[:-2], self.point_count, weighed.shape[-1])
        return out.index_add(-2, self.vertices.flatten(), weighed)

    @cached_property
    def matrix(self) -> csr_matrix:
        """`spread` of one frame: (N, P n)."""
        columns = np.arange(self.vertices.numel())
        entries = (self.windows.flatten().numpy(), (self.vertices.flatten().numpy(), columns))
        return csr_matrix(entries, shape=(self.point_count, len(columns)))


def _spread(places: Float[np.ndarray, "N 3"], count: int) -> list[int]:
    """Farthest points, from the one that is farthest from the middle."""
    chosen = [int(((places - places.mean(0)) ** 2).sum(1).argmax())]
    nearest = ((places - places[chosen[0]]) ** 2).sum(1)
    while len(chosen) < count:
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, ((places - places[chosen[-1]]) ** 2).sum(1))
    return chosen
