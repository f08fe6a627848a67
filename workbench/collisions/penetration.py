"""Sec. 6: where a garment is inside the body.  body (T,V,3), garment (T,N,3) -> inside (T,N), overlap (T,N); crossings.

A vertex collides where the body's exact winding number is 1 or more.  Where it is 2 or more the body overlaps itself,
and no garment could be free of it: such vertices are counted apart, never left out.  A garment whose vertices are all
outside can still cross the body between them: `surface_penetration` counts its edges and faces, and the body vertices
that poke through.
"""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.crossings import Crossings, SurfaceCrossing
from workbench.geometry.layer_count import LayerCount
from workbench.geometry.mesh import face_areas, face_normals, half_edges, unique_pairs

THREADS = 2  # ours: Warp's CPU launches are single-threaded, and beyond two threads the memory is the limit
ORIENTATION_SAMPLES = 4000  # ours: enough for a majority
FrameWork = Callable[[int], None]


@dataclass(frozen=True)
class Penetration:
    """Collisions of a sequence."""

    inside: Bool[Tensor, "T N"]
    overlap: Bool[Tensor, "T N"]  # inside, and the body overlaps itself there

    @property
    def share(self) -> float:
        """Colliding vertices among all vertices of all frames, 0..1."""
        return float(self.inside.float().mean())

    @property
    def overlap_share(self) -> float:
        """The part of `share` that lies where the body overlaps itself."""
        return float(self.overlap.float().mean())

    @property
    def per_frame(self) -> Int[Tensor, "T"]:
        """Colliding vertices of each frame."""
        return self.inside.sum(dim=1)


@dataclass(frozen=True)
class SurfacePenetration:
    """Collisions of surfaces, not only of vertices; `.sum(dim=1)` of any mask counts per frame."""

    edges: Int[Tensor, "E 2"]  # the garment's edges, smaller index first
    inside: Bool[Tensor, "T N"]  # garment vertices inside the body
    crossing_edges: Bool[Tensor, "T E"]  # garment edges that cross a body face
    crossing_faces: Bool[Tensor, "T G"]  # garment faces that a body face crosses in any way
    faces: Int[Tensor, "G 3"]
    poking: Bool[Tensor, "T V"]  # body vertices that stand out through a garment face beside them

    @property
    def hidden_edges(self) -> Bool[Tensor, "T E"]:
        """Crossing edges whose ends are both outside: no vertex shows them."""
        return self.crossing_edges & ~(self.inside[:, self.edges[:, 0]] | self.inside[:, self.edges[:, 1]])

    @property
    def hidden_faces(self) -> Bool[Tensor, "T G"]:
        """Crossing faces whose corners are all outside."""
        a, b, c = self.faces.T
        return self.crossing_faces & ~(self.inside[:, a] | self.inside[:, b] | self.inside[:, c])

    @property
    def edge_share(self) -> float:
        """Crossing edges among all edges of all frames, 0..1."""
        return float(self.crossing_edges.float().mean())

    @property
    def face_share(self) -> float:
        """Crossing faces among all faces of all frames, 0..1."""
        return float(self.crossing_faces.float().mean())


def penetration(
    body_vertices: Float[Tensor, "B V 3"],
    body_faces: Int[Tensor, "F 3"],
    garment: Float[Tensor, "T N 3"],
    progress: Callable[[int], None] = lambda frames: None,
) -> Penetration:
    """Exact inside test of every vertex in every frame.

    B is T, or 1 where one body serves all garment frames (the constant body of canonical space).
    Errors: ValueError when frame counts differ, positions are not finite, or the body is not closed.
    """
    check_frames(body_vertices, garment)
    faces = body_faces.numpy()
    layers = torch.zeros(garment.shape[:2], dtype=torch.int64)

    def worker() -> FrameWork:
        count = LayerCount(body_vertices[0].numpy(), faces)

        def work(frame: int) -> None:
            count.refit(body_of(body_vertices, frame).numpy())
            layers[frame] = torch.from_numpy(count(garment[frame].numpy()))
            progress(1)

        return work

    each_frame(len(garment), worker)
    return Penetration(layers >= 1, layers >= 2)


def surface_penetration(
    body_vertices: Float[Tensor, "B V 3"],
    body_faces: Int[Tensor, "F 3"],
    garment: Float[Tensor, "T N 3"],
    garment_faces: Int[Tensor, "G 3"],
    progress: Callable[[int], None] = lambda frames: None,
) -> SurfacePenetration:
    """Exact test of every garment edge and face against every body face, in every frame.

    B is T or 1, as in `penetration`.  Poking needs to know the garment's outer side: that of its normals, or the other
    where most of them face the body in the first frame.
    Errors: as `penetration`'s.
    """
    check_frames(body_vertices, garment)
    faces, sheet_faces = body_faces.numpy(), garment_faces.numpy()
    outwards = normals_show_outwards(garment[0], garment_faces, body_vertices[0], body_faces)
    found = SurfaceRecord(len(garment), garment.shape[1], garment_faces, body_vertices.shape[1])

    def worker() -> FrameWork:
        count = LayerCount(body_vertices[0].numpy(), faces)
        crossing = SurfaceCrossing(body_vertices[0].numpy(), faces)

        def work(frame: int) -> None:
            surface, points = body_of(body_vertices, frame).numpy(), garment[frame].numpy()
            count.refit(surface)
            crossing.refit(surface)
            found.write(frame, count(points) >= 1, crossing(points, sheet_faces, outwards=outwards))
            progress(1)

        return work

    each_frame(len(garment), worker)
    return found.result()


class SurfaceRecord:
    """Collects the frames of a `SurfacePenetration`; frames may come in any order, from several threads."""

    def __init__(self, frames: int, vertices: int, garment_faces: Int[Tensor, "G 3"], body_vertices: int):
        unique = unique_pairs(half_edges(garment_faces).sort(1).values)
        self.garment_faces, self.edges, self.edge_of_half = garment_faces, unique.pairs, unique.which
        self.inside = torch.zeros(frames, vertices, dtype=torch.bool)
        self.crossing_edges = torch.zeros(frames, len(self.edges), dtype=torch.bool)
        self.crossing_faces = torch.zeros(frames, len(garment_faces), dtype=torch.bool)
        self.poking = torch.zeros(frames, body_vertices, dtype=torch.bool)

    def write(self, frame: int, inside: Bool[np.ndarray, "N"], crossings: Crossings) -> None:
        of_halves = torch.from_numpy(crossings.edges.T.copy()).reshape(-1)  # all (0,1), then (1,2), then (2,0)
        self.inside[frame] = torch.from_numpy(inside)
        self.crossing_edges[frame, self.edge_of_half[of_halves]] = True
        self.crossing_faces[frame] = torch.from_numpy(crossings.faces)
        self.poking[frame] = torch.from_numpy(crossings.poking)

    def result(self) -> SurfacePenetration:
        return SurfacePenetration(
            edges=self.edges,
            inside=self.inside,
            crossing_edges=self.crossing_edges,
            crossing_faces=self.crossing_faces,
            faces=self.garment_faces,
            poking=self.poking,
        )


def normals_show_outwards(
    garment: Float[Tensor, "N 3"], garment_faces: Int[Tensor, "G 3"], body: Float[Tensor, "V 3"], body_faces: Tensor
) -> bool:
    """Whether most of the garment's area, at a few thousand faces, has its normals away from the body."""
    some = garment_faces[:: max(1, len(garment_faces) // ORIENTATION_SAMPLES)]
    centres = garment[some].mean(1)
    nearest = ClosestPoint(body.numpy(), body_faces.numpy()).query(centres.numpy())
    inside = torch.from_numpy(LayerCount(body.numpy(), body_faces.numpy())(centres.numpy()) >= 1)
    away = (centres - torch.from_numpy(nearest.point)) * torch.where(inside, -1.0, 1.0)[:, None]
    agrees = (face_normals(garment, some) * away).sum(1).sign()
    return bool((face_areas(garment, some) * agrees).sum() >= 0)


def check_frames(body_vertices: Float[Tensor, "B V 3"], garment: Float[Tensor, "T N 3"]) -> None:
    """ValueError unless every garment frame has its body and all of it is finite."""
    if len(body_vertices) not in (1, len(garment)):
        raise ValueError(f"{len(body_vertices)} body frames, but {len(garment)} garment frames; cut both to one length")
    for name, vertices in (("body", body_vertices), ("garment", garment)):
        if not bool(torch.isfinite(vertices).all()):
            raise ValueError(f"the {name} holds NaN or infinity; drop the frames where it diverged")


def body_of(body_vertices: Float[Tensor, "B V 3"], frame: int) -> Float[Tensor, "V 3"]:
    """The body of a garment frame: its own, or the one that serves all."""
    return body_vertices[frame if len(body_vertices) > 1 else 0]


def each_frame(frames: int, worker: Callable[[], FrameWork]) -> None:
    """Every frame once, on as many threads as torch may use, at most two; `worker()` makes what a thread owns."""
    if frames == 0:
        return
    first = worker()
    first(0)  # compiles the kernels, once, on this thread
    threads = min(THREADS, torch.get_num_threads(), frames)

    def share(which: int) -> None:
        work = first if which == 0 else worker()
        for frame in range(1 + which, frames, threads):
            work(frame)

    if threads == 1:
        share(0)
        return
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(share, which) for which in range(threads)]:
            done.result()
