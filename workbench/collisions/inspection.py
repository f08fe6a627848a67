"""Sec. 6: all that can be told of a sequence's collisions.  body (T,V,3), garment (T,N,3) -> depth, region (T,N) ...

Depth is the distance to the posed body's surface where the exact winding number says inside; the region is that of the
closest body point, so that a place keeps its name while the garment slides.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8, Int16
from torch import Tensor

from workbench.collisions.body_regions import BodyRegions, regions_of
from workbench.collisions.penetration import (
    FrameWork,
    SurfacePenetration,
    SurfaceRecord,
    body_of,
    check_frames,
    each_frame,
    normals_show_outwards,
)
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.crossings import SurfaceCrossing
from workbench.geometry.layer_count import LayerCount


@dataclass(frozen=True, eq=False)
class Inspection:
    """Every garment vertex in every frame, and what crosses between the vertices."""

    signed_distance: Float[Tensor, "T N"]  # metres, negative inside the body
    layers: Int8[Tensor, "T N"]  # how many layers of the body it lies in
    region: Int16[Tensor, "T N"]  # of the closest body point
    surfaces: SurfacePenetration
    regions: BodyRegions

    @property
    def inside(self) -> Bool[Tensor, "T N"]:
        """In at least one layer of the body."""
        return self.layers >= 1

    @property
    def overlap(self) -> Bool[Tensor, "T N"]:
        """Inside where the body overlaps itself: no garment could be free of it."""
        return self.layers >= 2

    @property
    def depth(self) -> Float[Tensor, "T N"]:
        """Metres below the surface; 0 outside."""
        return torch.where(self.inside, -self.signed_distance, 0.0)

    @property
    def heat_map(self) -> Int[Tensor, "T R"]:
        """Colliding vertices of each frame, by the region of the body they are inside."""
        frames, regions = len(self.layers), len(self.regions.names)
        cell = torch.arange(frames)[:, None] * regions + self.region
        return torch.bincount(cell[self.inside], minlength=frames * regions).reshape(frames, regions)

    @property
    def depth_map(self) -> Float[Tensor, "T R"]:
        """The deepest vertex of each frame and region, metres."""
        frames, regions = len(self.layers), len(self.regions.names)
        deepest = torch.zeros(frames, regions)
        return deepest.scatter_reduce(1, self.region.long(), self.depth, "amax")

    @property
    def region_of_vertex(self) -> Int[Tensor, "N"]:
        """The region that each garment vertex is closest to in most frames."""
        return self.region.long().mode(dim=0).values


def inspect_collisions(
    body_vertices: Float[Tensor, "B V 3"],
    body_faces: Int[Tensor, "F 3"],
    garment: Float[Tensor, "T N 3"],
    garment_faces: Int[Tensor, "G 3"],
    regions: BodyRegions | None = None,
    progress: Callable[[int], None] = lambda frames: None,
) -> Inspection:
    """Inspect every frame; B is T, or 1 where one body serves all of them.

    Errors: ValueError when frame counts differ, positions are not finite, or the body is not closed.
    """
    check_frames(body_vertices, garment)
    if regions is None:
        regions = regions_of(body_vertices[0], body_faces)
    frames, count = garment.shape[:2]
    faces, sheet_faces = body_faces.numpy(), garment_faces.numpy()
    of_face = regions.of_vertex.numpy().astype(np.int16)[faces]
    outwards = normals_show_outwards(garment[0], garment_faces, body_vertices[0], body_faces)
    distance = torch.empty(frames, count)
    layers = torch.empty(frames, count, dtype=torch.int8)
    region = torch.empty(frames, count, dtype=torch.int16)
    record = SurfaceRecord(frames, count, garment_faces, body_vertices.shape[1])

    def worker() -> FrameWork:
        start = body_vertices[0].numpy()
        layer_count, closest, crossing = (
            LayerCount(start, faces),
            ClosestPoint(start, faces),
            SurfaceCrossing(start, faces),
        )

        def work(frame: int) -> None:
            surface, points = body_of(body_vertices, frame).numpy(), garment[frame].numpy()
            for query in (layer_count, closest, crossing):
                query.refit(surface)
            around, nearest = layer_count(points), closest.query(points)
            inside = around >= 1
            distance[frame] = torch.from_numpy(np.where(inside, -nearest.distance, nearest.distance))
            layers[frame] = torch.from_numpy(np.clip(around, -128, 127).astype(np.int8))
            nearest_corner = nearest.barycentric.argmax(1)
            region[frame] = torch.from_numpy(of_face[nearest.face, nearest_corner])
            record.write(frame, inside, crossing(points, sheet_faces, outwards=outwards))
            progress(1)

        return work

    each_frame(frames, worker)
    return Inspection(distance, layers, region, record.result(), regions)
