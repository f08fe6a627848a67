"""Sec. 3.3: a surface through a cloud.  points (N,3), normals (N,3) -> mesh, by Poisson reconstruction.

Source: Kazhdan et al. 2006, as open3d has it (`pip install` the extra `meshing`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from workbench.extras import require
from workbench.formats.mesh_sequence import Mesh
from workbench.geometry.closest_point import checked_points


@dataclass(frozen=True)
class MeshingConfig:
    """Depth 8 is an octree of 256 cells a side: 8 mm on a person (facts.md 5: 1.7 s, 0.26 mm)."""

    depth: int = 8
    trim: float = 0.01  # of the surface, where points support it least, is cut off; ours


def poisson_mesh(
    points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "_ 3"], config: MeshingConfig = MeshingConfig()
) -> Mesh:
    """A mesh through oriented points, metres.  One thread: more would make it differ from run to run (facts.md 5).

    Raises:
        MissingExtra: open3d is not installed; names the command that installs it.
        ValueError: points or normals that are not finite, of different counts, or too few.
    """
    open3d: Any = require("open3d", extra="meshing")
    points, normals = checked_points(points), checked_points(normals, name="normals")
    if len(points) != len(normals):
        raise ValueError(f"there are {len(points)} points, but {len(normals)} normals")
    if len(points) < 100:
        raise ValueError(f"a surface cannot be reconstructed from {len(points)} points; expected thousands")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    cloud.normals = open3d.utility.Vector3dVector(normals.astype(np.float64))
    mesh, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=config.depth, linear_fit=False, n_threads=1
    )
    density = np.asarray(density)
    mesh.remove_vertices_by_mask(density < np.quantile(density, config.trim))
    return Mesh(np.asarray(mesh.vertices).astype(np.float32), np.asarray(mesh.triangles).astype(np.int64))
