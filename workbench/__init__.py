"""Garment workbench: arrays flow from left to right, each stage is one file named as in its paper.

Paper 1: Santesteban, Thuerey, Otaduy, Casas, "Self-Supervised Collision Handling via Generative 3D Garment Models for
Virtual Try-On", CVPR 2021.

The map
| stage               | section | eq.  | module                           | in -> out                            |
|---------------------|---------|------|----------------------------------|--------------------------------------|
| body                | 3       | 2-3  | workbench.body.model             | theta, beta -> M_B (V,3)             |
| motion              |         |      | workbench.motion                 | BVH, AMASS, .. -> theta (T,J,3,3)    |
| garment             |         |      | workbench.garments               | file -> template (N,3), faces (F,3)  |
| simulated sequences | 6       |      | workbench.collisions.sequences   | theta, beta -> M_G (T,N,3)           |
| diffused body       | 4.1     | 4-6  | workbench.collisions.diffused_body | p (N,3) -> W~, B~s, B~p            |
| body SDF            | 4.3     | 12   | workbench.collisions.body_sdf    | p (N,3) -> distance (N,)             |
| garment model       | 4.2     | 7-8  | workbench.collisions.garment_model | X, beta, theta -> M_G              |
| projection          | 4.3     | 9-12 | workbench.collisions.projection  | M_G, beta, theta -> X                |
| training set        | 4.4     |      | workbench.collisions.canonical_set | X (T,N,3) of many sequences <-> file |
| in a mirror         |         |      | workbench.collisions.mirroring   | training set -> twice as large       |
| subspace            | 4.4     | 13-16 | workbench.collisions.subspace   | X -> x_bar (25) -> X                 |
| motion descriptor   | 5       | 17   | workbench.collisions.motion_descriptor | theta, H, K -> gamma (42)      |
| posed distance      |         |      | workbench.collisions.posed_distance | X, beta, theta -> signed distance |
| contact planes      |         |      | workbench.collisions.contact_planes | poses, C -> distances, linear in C |
| regressor           | 5       | 1, 18 | workbench.collisions.regressor  | beta, gamma -> x_bar (T,25)          |
| limb sight          |         |      | workbench.collisions.limb_sight  | theta, beta -> what patches see      |
| posed corrective    |         |      | workbench.collisions.posed_corrective | theta, beta, x_bar -> offset of X |
| try-on              | 5-6     |      | workbench.collisions.tryon       | beta, motion -> posed garment        |
| one frame, fast     | 4.2     | 7-8  | workbench.collisions.frame_posing | X, theta, H -> M_G                  |
| networks, fast      | 6.3     | 1    | workbench.collisions.tryon_kernels | gamma, beta -> x_bar -> X          |
| push-out (baseline) | 6       |      | workbench.collisions.push_out    | M_G, body -> pushed M_G, bulge       |
| penetration         | 4.3, 6  |      | workbench.collisions.penetration | mesh, body -> vertices inside, depth |
| demo                |         |      | workbench.tryon_demo             | try-on -> page, GLB, picture, report |

Paper 2: Ma, Yang, Tang, Black, "The Power of Points for Modeling Humans in Clothing" (POP), ICCV 2021.
| stage               | section | eq.  | module                             | in -> out                          |
|---------------------|---------|------|------------------------------------|------------------------------------|
| scans               | 4       |      | workbench.points.scans             | file -> points, normals (T,N,3)    |
| UV position map     | 3.1-3.2 | 2    | workbench.points.uv_position_map   | theta, beta -> I, u_i, p_i, T_i    |
| pose encoder        | 3.2     |      | workbench.points.pose_encoder      | I (B,3,H,W) -> P (B,64,H,W)        |
| geometry features   | 3.2     |      | workbench.points.geometry_features | outfit -> G (64,H,W)               |
| shape decoder       | 3.1     | 1    | workbench.points.shape_decoder     | u_i, z_P, z_G -> r_i, n_i          |
| clothed points      | 3.1     | 2    | workbench.points.clothed_points    | T_i, r_i, p_i -> x_i, n(x_i)       |
| losses, training    | 3.3     | 3-6  | workbench.points.losses, training  | scans -> networks, G               |
| scan fitting        | 3.3     | 7    | workbench.points.scan_fitting      | scan -> G                          |
| dressing            | 3.3     |      | workbench.points.dressing          | G, motion -> points (T,N,3)        |
| meshing             | 3.3     |      | workbench.points.meshing           | points, normals -> mesh            |
| patches (baseline)  | 3.1, 4  |      | workbench.points.patches           | I -> points (N k,3)                |

Notation (declared once, here)
| symbol        | shape       | meaning                                                            |
|---------------|-------------|--------------------------------------------------------------------|
| X             | (N,3)       | canonical garment: unposed, unshaped                               |
| M_G, M_B      | (N,3) (V,3) | posed garment, posed body                                          |
| beta          | (10)        | body shape                                                         |
| theta         | (J,3,3)     | pose: one local rotation matrix a joint                            |
| W, B_s, B_p   | (V,J) ...   | the body's skinning weights, shape and pose offsets                |
| W~, B~s, B~p  | (N,J) ...   | the same, diffused to any point of space                           |
| gamma         | (42)        | motion descriptor                                                  |
| x_bar         | (25)        | latent garment;  E, D  its encoder and decoder                     |
| I             | (3,H,W)     | position map of the posed neutral body;  u_i  a point on the UV square |
| P, G          | (64,H,W)    | pose features, geometry features;  z_P, z_G  read at a point       |
| p_i, T_i      | (3) (3,3)   | point of the posed body, local transform;  r_i  displacement, n_i  normal |
Axes: B batch, T frames, V body vertices, N garment vertices or points, F faces, J joints, K shape components.
Metres, radians, seconds; z up, the body faces -y, its left is +x; float32 unless said.
Canonical body: beta = 0, theta = 0, straight-arm A45 rest, soles at z = 0.

Public names are loaded when first used, so `import workbench` costs nothing.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

_HOME_OF = {
    "Body": "workbench.body.model",
    "Skeleton": "workbench.body.skeleton",
    "Motion": "workbench.motion",
    "load_motion": "workbench.formats",
    "Garment": "workbench.garments",
    "SimulatedSequence": "workbench.collisions.sequences",
    "MonteCarloFields": "workbench.collisions.diffused_body",
    "LearnedFields": "workbench.collisions.diffused_body",
    "GridFields": "workbench.collisions.diffused_body",
    "CanonicalSet": "workbench.collisions.canonical_set",
    "Subspace": "workbench.collisions.subspace",
    "Regressor": "workbench.collisions.regressor",
    "TryOn": "workbench.collisions.tryon",
    "Store": "workbench.store",
    "atomic_write": "workbench.store",
    "MeshSequence": "workbench.formats.mesh_sequence",
    "read_mesh_sequence": "workbench.formats.mesh_sequence",
}

__all__ = ["__version__", *_HOME_OF]  # pyright: ignore[reportUnsupportedDunderAll]  (the table is the list)


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"workbench has no {name!r}; it has {', '.join(sorted(_HOME_OF))}")
    return getattr(importlib.import_module(_HOME_OF[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
