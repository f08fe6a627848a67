"""Faults on purpose: a patch of the garment pushed into the body, to prove and to teach what the inspector finds."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.mesh import face_normals


@dataclass(frozen=True)
class Dent:
    """A garment with one patch inside the body."""

    garment: Float[Tensor, "N 3"]
    patch: Int[Tensor, "K"]  # the vertices that were moved


@dataclass(frozen=True)
class Plant:
    """A dent around one vertex, over some frames."""

    vertex: int
    first_frame: int
    last_frame: int
    depth: float = 0.008  # metres
    rings: int = 3  # edges from the vertex to the rim


def planted(
    garment: Float[Tensor, "T N 3"],
    edges: Int[Tensor, "E 2"],
    body: Float[Tensor, "T V 3"],
    body_faces: Int[Tensor, "F 3"],
    plants: Sequence[Plant],
) -> Float[Tensor, "T N 3"]:
    """The garment with all dents in their frames.

    Errors: ValueError for frames or vertices that are not there.
    """
    moved = garment.clone()
    for plant in plants:
        if not 0 <= plant.first_frame <= plant.last_frame < len(garment):
            raise ValueError(
                f"frames {plant.first_frame} to {plant.last_frame} are not all there: the garment has {len(garment)}"
            )
        for frame in range(plant.first_frame, plant.last_frame + 1):
            made = dent(moved[frame], edges, body[frame], body_faces, plant.vertex, plant.rings, plant.depth)
            moved[frame] = made.garment
    return moved


def dent(
    garment: Float[Tensor, "N 3"],
    edges: Int[Tensor, "E 2"],
    body: Float[Tensor, "V 3"],
    body_faces: Int[Tensor, "F 3"],
    centre: int,
    rings: int = 3,
    depth: float = 0.008,
) -> Dent:
    """The vertices within `rings` edges of vertex `centre` moved below the closest skin: `depth` metres at the centre,
    less towards the rim.

    Errors: ValueError for a centre that is no vertex, or a depth that is not positive.
    """
    if not 0 <= centre < len(garment):
        raise ValueError(f"there is no vertex {centre}: the garment has {len(garment)}")
    if not depth > 0:
        raise ValueError(f"depth is {depth}: give metres below the skin, more than 0")
    ends = edges.numpy()
    graph = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(garment),) * 2).tocsr()
    steps = dijkstra(graph, directed=False, indices=centre, limit=rings)
    patch = torch.from_numpy(np.flatnonzero(np.isfinite(steps)))
    nearest = ClosestPoint(body.numpy(), body_faces.numpy()).query(garment[patch].numpy())
    inwards = -face_normals(body, body_faces)[torch.from_numpy(nearest.face)]
    how_deep = depth * (1 - torch.from_numpy(steps[patch.numpy()]).float() / (rings + 1))
    moved = garment.clone()
    moved[patch] = torch.from_numpy(nearest.point) + how_deep[:, None] * inwards
    return Dent(moved, patch)
