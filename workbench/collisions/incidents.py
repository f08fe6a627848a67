"""Collisions that belong together: inside (T,N), garment edges (E,2) -> incidents: frames, vertices, depth, region."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from workbench.collisions.inspection import Inspection


@dataclass(frozen=True)
class Incident:
    """One patch of the garment inside the body over one stretch of frames."""

    first_frame: int
    last_frame: int
    vertices: int  # different ones
    worst_frame: int
    worst_vertex: int
    depth: float  # metres, of the worst vertex in the worst frame
    region: str  # where that is


def incidents(found: Inspection) -> tuple[Incident, ...]:
    """Deepest first.  Two colliding vertices of a frame belong together where an edge joins them, and a vertex belongs
    to itself in the next frame."""
    frame, vertex = found.inside.nonzero(as_tuple=True)
    if not len(frame):
        return ()
    depth = found.depth[frame, vertex].numpy()
    which = _joined(found, frame.numpy(), vertex.numpy())
    made = []
    for members in np.split(np.argsort(which, kind="stable"), np.cumsum(np.bincount(which))[:-1]):
        worst = members[depth[members].argmax()]
        frames = frame[members]
        made.append(
            Incident(
                first_frame=int(frames.min()),
                last_frame=int(frames.max()),
                vertices=len(torch.unique(vertex[members])),
                worst_frame=int(frame[worst]),
                worst_vertex=int(vertex[worst]),
                depth=float(depth[worst]),
                region=found.regions.names[int(found.region[frame[worst], vertex[worst]])],
            )
        )
    return tuple(sorted(made, key=lambda incident: -incident.depth))


def _joined(found: Inspection, frame: Int[np.ndarray, "K"], vertex: Int[np.ndarray, "K"]) -> Int[np.ndarray, "K"]:
    """The incident of each colliding (frame, vertex)."""
    frames, count = found.inside.shape
    number = np.full((frames, count), -1)
    number[frame, vertex] = np.arange(len(frame))
    ends = number[:, found.surfaces.edges.numpy()].reshape(-1, 2)  # (T E, 2)
    over_time = np.stack([number[:-1], number[1:]], -1).reshape(-1, 2)
    links = np.concatenate([pairs[(pairs >= 0).all(1)] for pairs in (ends, over_time)])
    graph = coo_matrix((np.ones(len(links), bool), links.T), shape=(len(frame),) * 2)
    return connected_components(graph, directed=False)[1]
