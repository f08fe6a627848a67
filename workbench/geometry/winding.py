"""Winding numbers and the inside test of closed, possibly self-overlapping bodies.  points (N,3), mesh -> (N,)."""

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Int

from .closest_point import checked_mesh, checked_points, morton_order, move_mesh, run_chunks, warp_mesh
from .warp_kernels import sum_solid_angles, winding_verdict

# Ours, measured (tests/geometry/test_winding.py): the fast winding number strays less than 0.1 from the exact one at
# accuracy 2, so a point whose fast value is outside (0.25, 0.75) is decided.
CERTAINLY_OUTSIDE, CERTAINLY_INSIDE, ACCURACY = 0.25, 0.75, 2.0


def winding_number(
    points: Float[np.ndarray, "N 3"], vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "N"]:
    """Generalised winding number: sum of the signed solid angles of all faces over 4 pi, in double precision.

    1 inside a single closed layer, 0 outside, 2 where the body overlaps itself; a fraction near an open mesh.
    Cost N x F (about 0.4 ms a point at 27k faces).  Source: Van Oosterom and Strackee 1983, Jacobson et al. 2013.
    """
    points = checked_points(points)
    vertices, faces = checked_mesh(vertices, faces)
    result = np.zeros(len(points), np.float64)
    if len(points):
        out = wp.array(result, dtype=wp.float64, device="cpu", copy=False)
        p = wp.array(points, dtype=wp.vec3, device="cpu", copy=False)
        corners = wp.array(np.ascontiguousarray(vertices[faces]), dtype=wp.vec3, device="cpu", ndim=2)

        def launch(start: int, stop: int) -> None:
            inputs = [start, p, corners, out]
            wp.launch(sum_solid_angles, dim=stop - start, inputs=inputs, device="cpu", record_tape=False)

        run_chunks(launch, len(points), chunk=32)
    return result.astype(np.float32)


class InsideTest:
    """Which points are inside a closed mesh: winding number > 1/2, so the overlap of a posed body counts as inside.

    A fast (dipole) winding number decides the clear cases, the exact sum the doubtful ones; `refit` moves the mesh.
    Raises ValueError where the mesh is not closed and consistently oriented, for then "inside" has no meaning.
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]):
        vertices, faces = checked_mesh(vertices, faces)
        check_closed(faces)
        self.faces = faces
        self.mesh = warp_mesh(vertices, faces, winding=True)

    def refit(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        """Move the mesh: same vertex count, same faces."""
        move_mesh(self.mesh, vertices)

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, "N"]:
        points = checked_points(points)
        verdict = np.zeros(len(points), np.int32)
        vertices = self.mesh.points.numpy()
        near = np.flatnonzero(((points >= vertices.min(0)) & (points <= vertices.max(0))).all(1))
        if not len(near):
            return verdict.astype(bool)
        near = near[morton_order(points[near])]
        p = wp.array(points, dtype=wp.vec3, device="cpu", copy=False)
        out = wp.array(verdict, dtype=wp.int32, device="cpu", copy=False)
        index = wp.array(near.astype(np.int32), dtype=wp.int32, device="cpu", copy=False)

        def launch(start: int, stop: int) -> None:
            inputs = [self.mesh.id, start, p, index, CERTAINLY_OUTSIDE, CERTAINLY_INSIDE, ACCURACY, out]
            wp.launch(winding_verdict, dim=stop - start, inputs=inputs, device="cpu", record_tape=False)

        run_chunks(launch, len(near))
        doubtful = np.flatnonzero(verdict == 2)
        if len(doubtful):
            verdict[doubtful] = winding_number(points[doubtful], vertices, self.faces) > 0.5
        return verdict.astype(bool)


def inside(
    points: Float[np.ndarray, "N 3"], vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Bool[np.ndarray, "N"]:
    """One-off `InsideTest`; build the class where the same mesh is asked again."""
    return InsideTest(vertices, faces)(points)


def check_closed(faces: Int[np.ndarray, "F 3"]) -> None:
    """ValueError unless every directed edge has its opposite exactly once: closed and consistently oriented."""
    count = np.int64(faces.max()) + 1
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    forward = np.sort(edges[:, 0] * count + edges[:, 1])
    backward = np.sort(edges[:, 1] * count + edges[:, 0])
    if len(forward) != len(backward) or not np.array_equal(forward, backward):
        open_edges = len(np.setdiff1d(forward, backward))
        raise ValueError(
            f"the mesh is not closed and consistently oriented: {open_edges} of {len(forward)} directed edges have no "
            "opposite; close its holes and orient its faces before asking for its inside"
        )
