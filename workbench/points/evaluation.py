"""Sec. 4, Tab. 2: how far predicted clouds are from scans.  clouds, scans -> Chamfer, normals; over frames and outfits.

The Chamfer distance is Eq. 4 as written, point to point both ways; the published figures are point to plane from model
to scan (facts.md 2), so that figure stands beside it.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.geometry.chamfer import chamfer_distance, match, plane_distance
from workbench.points.clothed_points import ClothedPoints, PointModel, clothed
from workbench.points.dressing import Dresser
from workbench.points.losses import normal_loss
from workbench.points.scans import ScanFrame
from workbench.points.shape_decoder import CanonicalClothes
from workbench.points.training import Batch, ScanSet
from workbench.points.uv_position_map import (
    QUERY_SIZE,
    PosedBodies,
    SurfaceQueries,
    atlas_of,
    pixel_grid,
    posed_queries,
)


@dataclass(frozen=True)
class CloudError:
    """One cloud against one scan."""

    outfit: str
    chamfer: float  # m^2, Eq. 4
    normal: float  # Eq. 5
    plane: float  # m^2, model to scan, point to plane


@dataclass(frozen=True)
class OutfitStatistics:
    """The three columns of Tab. 2: over all frames, and the median and worst of the outfits' means."""

    mean: float
    outfit_median: float
    outfit_max: float


def cloud_error(x: Float[Tensor, "M 3"], n_x: Float[Tensor, "M 3"], scan: ScanFrame, outfit: str) -> CloudError:
    """Eq. 4 and 5 of one frame, with the distance to the scan's planes beside them."""
    matches = match(x, scan.points)
    return CloudError(
        outfit=outfit,
        chamfer=chamfer_distance(x, scan.points, matches).item(),
        normal=normal_loss(n_x, scan.normals, matches).item(),
        plane=plane_distance(x, scan.points, scan.normals, matches).item(),
    )


def statistics(errors: Sequence[CloudError], value: Callable[[CloudError], float]) -> OutfitStatistics:
    """Of one figure over many clouds.  ValueError where there is none."""
    if not errors:
        raise ValueError("there are no clouds to take statistics of")
    of_outfit: dict[str, list[float]] = {}
    for error in errors:
        of_outfit.setdefault(error.outfit, []).append(value(error))
    means = [float(np.mean(values)) for values in of_outfit.values()]
    return OutfitStatistics(
        mean=float(np.mean([value(error) for error in errors])),
        outfit_median=float(np.median(means)),
        outfit_max=max(means),
    )


@torch.no_grad()
def errors_on(scans: ScanSet, dress: Callable[[Batch], ClothedPoints]) -> list[CloudError]:
    """The error of every frame of a set; `dress` makes the clouds, whatever the method (one frame a batch)."""
    errors = []
    for i in range(len(scans)):
        batch = scans.batch([i])
        cloud = dress(batch)
        outfit = scans.outfits[int(batch.outfit[0])]
        errors.append(cloud_error(cloud.points[0], cloud.normals[0], batch.scans[0], outfit))
    return errors


# Speed: the same weights, the published way and ours


@torch.no_grad()
def dress_every_pixel(
    model: PointModel,
    geometry: Float[Tensor, "1 d h w"],
    image: Float[Tensor, "1 i H W"],
    queries: SurfaceQueries,
    bodies: PosedBodies,
    query_size: int,
) -> ClothedPoints:
    """The published way: the whole map is decoded in single precision, then what shows no body is thrown away."""
    pose = model.encoder(image)
    everywhere = model.decode(pixel_grid(query_size), pose, geometry)
    column, row = (queries.u * query_size).long().unbind(1)
    shown = row * query_size + column
    canonical = CanonicalClothes(everywhere.displacement[:, shown], everywhere.normal[:, shown])
    return clothed(posed_queries(queries, bodies), canonical)


@dataclass(frozen=True)
class ForwardTimes:
    """CPU seconds a frame (the least of some repeats), and how far apart the points are."""

    every_pixel: float
    fast: float
    apart: float  # metres, the worst point

    @property
    def ratio(self) -> float:
        return self.every_pixel / self.fast


def forward_times(
    model: PointModel, body: Body, bodies: PosedBodies, *, repeats: int = 3, query_size: int = QUERY_SIZE
) -> ForwardTimes:
    """Both ways on one frame.  What depends on the outfit alone (smoothed G) is ready beforehand in both."""
    model.eval()
    with torch.no_grad():
        geometry = model.geometry(torch.tensor([0]))
    image = atlas_of(body, model.config.input_size).map_of(bodies.seen)
    queries = atlas_of(body, query_size).queries
    dresser = Dresser(model, geometry, body, query_size=query_size)
    plain = dress_every_pixel(model, geometry, image, queries, bodies, query_size)
    fast = dresser(bodies)
    apart = (plain.points - fast.points).norm(dim=-1).max().item()
    return ForwardTimes(
        every_pixel=least_cpu_seconds(
            lambda: dress_every_pixel(model, geometry, image, queries, bodies, query_size), repeats
        ),
        fast=least_cpu_seconds(lambda: dresser(bodies), repeats),
        apart=apart,
    )


def least_cpu_seconds(work: Callable[[], object], repeats: int) -> float:
    """Of some repeats."""
    times = []
    for _ in range(repeats):
        began = time.process_time()  # other programs on the machine do not change it
        work()
        times.append(time.process_time() - began)
    return min(times)
