"""Sec. 6, Fig. 7: the post-process that this method makes needless.  garment (N,3), body (V,3) -> pushed garment, harm.

What earlier work does to a regressed garment: every vertex that is behind the nearest body vertex, or nearer to it than
epsilon along its normal, moves out along that normal.  It removes collisions and leaves bulges: measured here as what
it does to the folds around the vertices it moved.
"""

from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from workbench.geometry.laplacian import apply_laplacian, umbrella_laplacian
from workbench.geometry.mesh import half_edges, unique_pairs, vertex_normals

EPSILON = 2e-3  # metres: the published value (facts.md 1)


def push_out(
    garment: Float[Tensor, "N 3"], body: Float[Tensor, "V 3"], body_faces: Int[Tensor, "F 3"], epsilon: float = EPSILON
) -> Float[Tensor, "N 3"]:
    """The garment with every vertex at least epsilon in front of its nearest body vertex.  Metres."""
    _, nearest = KDTree(body.numpy()).query(garment.numpy())
    normal = vertex_normals(body, body_faces)[nearest]
    height = ((garment - body[nearest]) * normal).sum(-1, keepdim=True)
    return garment + (epsilon - height).clamp_min(0.0) * normal


@dataclass(frozen=True)
class Bulge:
    """What a post-process did to a garment's shape, over the moved vertices and those beside them."""

    moved: Bool[Tensor, "N"]
    shift: float  # mean way of the moved vertices, metres
    detail_lost: float  # |Delta X' - Delta X| / |Delta X|, means over the neighbourhood: 0 keeps every fold as it was
    stretched: float  # share of the neighbourhood's edges whose length changed by more than a tenth


def bulge(before: Float[Tensor, "N 3"], after: Float[Tensor, "N 3"], faces: Int[Tensor, "M 3"]) -> Bulge:
    """Compare a garment before and after it was pushed."""
    moved = (after - before).norm(dim=-1) > 0
    edges = unique_pairs(half_edges(faces).sort(1).values).pairs
    beside = moved.clone()
    touching = moved[edges].any(dim=1)
    beside[edges[touching].flatten()] = True
    if not bool(moved.any()):
        return Bulge(moved, 0.0, 0.0, 0.0)
    laplacian = umbrella_laplacian(faces, len(before))
    folds, pushed = apply_laplacian(laplacian, before)[beside], apply_laplacian(laplacian, after)[beside]
    length = (before[edges[touching, 0]] - before[edges[touching, 1]]).norm(dim=-1)
    now = (after[edges[touching, 0]] - after[edges[touching, 1]]).norm(dim=-1)
    return Bulge(
        moved=moved,
        shift=float((after - before)[moved].norm(dim=-1).mean()),
        detail_lost=float((pushed - folds).norm(dim=-1).mean() / folds.norm(dim=-1).mean()),
        stretched=float(((now / length - 1).abs() > 0.1).float().mean()),
    )
