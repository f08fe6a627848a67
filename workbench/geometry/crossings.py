"""Where a sheet crosses a surface.  sheet (N,3) (G,3), mesh (V,3) (F,3) -> edges (G,3), faces (G,), vertices (V,)."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from jaxtyping import Bool, Float, Int

from .closest_point import checked_mesh, move_mesh, run_chunks, warp_mesh
from .warp_kernels import surface_crossings


@dataclass(frozen=True)
class Crossings:
    """What of a sheet and a mesh crosses the other."""

    edges: Bool[np.ndarray, "G 3"]  # the edges (0,1), (1,2), (2,0) of each sheet face that cross a face of the mesh
    pierced: Bool[np.ndarray, "G"]  # sheet faces that an edge of the mesh crosses
    poking: Bool[np.ndarray, "V"]  # vertices of the mesh, ends of such edges on the outer side of the sheet

    @property
    def faces(self) -> Bool[np.ndarray, "G"]:
        """Sheet faces that cross the mesh in any way."""
        return self.edges.any(1) | self.pierced


class SurfaceCrossing:
    """Crossings of sheets with one triangle mesh; `refit` moves the mesh.

    Every pair of faces that the BVH cannot part is tested by the signs of tetrahedron volumes in double precision.
    Faces that share an edge evaluate it alike, and where a volume is zero (a vertex on a face, edges that meet) the
    sheet counts as moved by (eps, eps^2, eps^3): nothing slips between faces, and an edge whose ends are in different
    layers (`LayerCount`) always crosses.
    """

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]):
        vertices, faces = checked_mesh(vertices, faces)
        self.mesh = warp_mesh(vertices, faces, winding=False)

    def refit(self, vertices: Float[np.ndarray, "V 3"]) -> None:
        """Move the mesh: same vertex count, same faces."""
        move_mesh(self.mesh, vertices)

    def __call__(
        self,
        sheet: Float[np.ndarray, "N 3"],
        sheet_faces: Int[np.ndarray, "G 3"],
        *,
        outwards: bool = True,
    ) -> Crossings:
        """outwards: the sheet's normals point away from what it covers."""
        sheet, sheet_faces = checked_mesh(sheet, sheet_faces)
        count = len(sheet_faces)
        edges, pierced = np.zeros((count, 3), np.uint8), np.zeros(count, np.uint8)
        poking = np.zeros(len(self.mesh.points), np.uint8)
        arrays = [
            wp.array(sheet, dtype=wp.vec3, device="cpu", copy=False),
            wp.array(sheet_faces.astype(np.int32), dtype=wp.int32, device="cpu", copy=False),
            self.mesh.points,
            self.mesh.indices,
            outwards,
            wp.array(edges, dtype=wp.uint8, device="cpu", copy=False),
            wp.array(pierced, dtype=wp.uint8, device="cpu", copy=False),
            wp.array(poking, dtype=wp.uint8, device="cpu", copy=False),
        ]

        def launch(start: int, stop: int) -> None:
            inputs = [self.mesh.id, start, *arrays]
            wp.launch(surface_crossings, dim=stop - start, inputs=inputs, device="cpu", record_tape=False)

        run_chunks(launch, count)
        return Crossings(edges.astype(bool), pierced.astype(bool), poking.astype(bool))
