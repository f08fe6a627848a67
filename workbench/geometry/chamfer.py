"""Distances between point clouds: x (M,3), y (N,3) -> who is nearest to whom, and what that distance is.

The search (KDTree over a Morton order, facts.md 5; of clouds on a GPU, all distances) is blind to gradients; distances
are taken afterwards, in torch, so that they flow into both clouds.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from .closest_point import checked_points, morton_order

LEAF = 24  # points a leaf of the tree; ours: 16 to 32 are equal within noise
DISTANCES_AT_ONCE = 1 << 26  # on a GPU: 256 MB


class NearestPoint:
    """Nearest points of one cloud.  ValueError for an empty cloud or one that is not finite."""

    def __init__(self, cloud: Float[np.ndarray, "N 3"]):
        cloud = checked_points(cloud, name="cloud")
        if not len(cloud):
            raise ValueError("the cloud has no points: there is no nearest one")
        self._order = morton_order(cloud)
        self._tree = KDTree(cloud[self._order], leafsize=LEAF, balanced_tree=False, compact_nodes=False)

    def __call__(self, points: Float[np.ndarray, "M 3"]) -> Int[np.ndarray, "M"]:
        """The index in the cloud of the point nearest to each of `points`."""
        points = checked_points(points)
        order = morton_order(points)
        nearest = np.empty(len(points), np.int64)
        nearest[order] = self._order[self._tree.query(points[order])[1]]
        return nearest


@dataclass(frozen=True)
class Matches:
    """Nearest neighbours both ways between clouds x and y."""

    of_x: Int[Tensor, "M"]  # argmin_j |x_i - y_j|
    of_y: Int[Tensor, "K"]  # argmin_i |x_i - y_j| of the rows j that were asked for
    rows: Int[Tensor, "K"] | None = None  # of y; all when absent


def match(
    x: Float[Tensor, "M 3"],
    y: Float[Tensor, "N 3"],
    *,
    nearest_in_y: NearestPoint | None = None,
    rows: Int[Tensor, "K"] | None = None,
) -> Matches:
    """Nearest neighbours both ways: of every x in all of y, and of `rows` of y (all by default) in x.

    `nearest_in_y` is the search in y where it is asked more than once.
    """
    asked = y if rows is None else y[rows]
    if x.device.type != "cpu" and nearest_in_y is None:
        return Matches(nearest_by_all_distances(x, y), nearest_by_all_distances(asked, x), rows)
    x_points = x.detach().cpu().numpy()
    in_y = NearestPoint(y.detach().cpu().numpy()) if nearest_in_y is None else nearest_in_y
    of_y = NearestPoint(x_points)(asked.detach().cpu().numpy())
    return Matches(torch.from_numpy(in_y(x_points)), torch.from_numpy(of_y), rows)


@torch.no_grad()
def nearest_by_all_distances(points: Float[Tensor, "M 3"], cloud: Float[Tensor, "N 3"]) -> Int[Tensor, "M"]:
    """The index in the cloud of the point nearest to each of `points`, in torch: where a tree cannot go, on a GPU."""
    parts = points.split(max(1, DISTANCES_AT_ONCE // len(cloud)))
    exact = "donot_use_mm_for_euclid_dist"  # by matrix products, a metre loses tenths of a millimetre
    return torch.cat([torch.cdist(part, cloud, compute_mode=exact).argmin(1) for part in parts])


def chamfer_distance(x: Float[Tensor, "M 3"], y: Float[Tensor, "N 3"], matches: Matches) -> Float[Tensor, ""]:
    """Mean squared distance to the nearest point, both ways, in m^2 (paper 2, Eq. 4 as written)."""
    to_y = (x - y[matches.of_x]).square().sum(-1).mean()
    asked = y if matches.rows is None else y[matches.rows]
    to_x = (asked - x[matches.of_y]).square().sum(-1).mean()
    return to_y + to_x


def plane_distance(
    x: Float[Tensor, "M 3"], y: Float[Tensor, "N 3"], y_normals: Float[Tensor, "N 3"], matches: Matches
) -> Float[Tensor, ""]:
    """Mean squared distance of x to the tangent plane of its nearest y, in m^2 (one way)."""
    return ((x - y[matches.of_x]) * y_normals[matches.of_x]).sum(-1).square().mean()
