"""Signed distance to a closed mesh, exact.  points (N,3) -> (N,), positive outside."""

import numpy as np
from jaxtyping import Float, Int

from .closest_point import ClosestPoint, SurfacePoint, checked_points
from .winding import InsideTest


class SignedDistance:
    """Distance by the closest point, sign by the exact winding number; `refit` moves the mesh.

    vertices (V,3) metres, faces (F,3) closed (ValueError otherwise).
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]):
        self.inside = InsideTest(vertices, faces)
        self.closest = ClosestPoint(vertices, faces)

    def refit(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        """Move the mesh: same vertex count, same faces."""
        self.closest.refit(vertices)
        self.inside.refit(vertices)

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N"]:
        return self.with_surface_point(points)[0]

    def with_surface_point(self, points: Float[np.ndarray, "N 3"]) -> tuple[Float[np.ndarray, "N"], SurfacePoint]:
        """The signed distance, and the surface point it is measured from."""
        points = checked_points(points)
        nearest = self.closest.query(points)
        sign = np.where(self.inside(points), np.float32(-1), np.float32(1))
        return sign * nearest.distance, nearest


def signed_distance(points: Float[np.ndarray, "N 3"], closest: ClosestPoint) -> Float[np.ndarray, "N"]:
    """Signed distance to the mesh that `closest` holds.  Build `SignedDistance` where the same mesh is asked again."""
    nearest = closest.query(points)
    hidden = InsideTest(closest.vertices, closest.faces)(points)
    return np.where(hidden, -nearest.distance, nearest.distance)
