"""Eq. 15's Laplacian: a vertex against its neighbours.  faces (F,3) -> sparse L (V,V), (L x)_i = x_i - mean_j x_j."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from workbench.geometry.mesh import half_edges, unique_edges


def umbrella_laplacian(
    faces: Int[Tensor, "F 3"], vertex_count: int, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "V V"]:
    """Sparse I - D^-1 A: every neighbour counts the same, whatever the geometry (Taubin 1995, cited for Eq. 15)."""
    edges = unique_edges(faces)
    i, j = torch.cat([edges, edges.flip(1)]).T
    degree = torch.bincount(i, minlength=vertex_count).clamp(min=1).to(dtype)
    diagonal = torch.arange(vertex_count)
    rows, columns = torch.cat([diagonal, i]), torch.cat([diagonal, j])
    values = torch.cat([torch.ones(vertex_count, dtype=dtype), -1 / degree[i]])
    return torch.sparse_coo_tensor(torch.stack([rows, columns]), values, (vertex_count, vertex_count)).coalesce()


def cotangent_laplacian(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V V"]:
    """Sparse symmetric stiffness L_ij = -(cot a_ij + cot b_ij) / 2 of the given rest shape (Pinkall & Polthier 1993).

    Dimensionless; divide row i by the vertex area for the Laplace-Beltrami operator in 1/m^2.
    """
    tail, head = half_edges(faces).T  # grouped (0,1), (1,2), (2,0): the corner opposite to each is 2, 0, 1
    opposite = torch.cat([faces[:, 2], faces[:, 0], faces[:, 1]])
    u, v = vertices[tail] - vertices[opposite], vertices[head] - vertices[opposite]
    cotangent = (u * v).sum(1) / torch.linalg.cross(u, v).norm(dim=1).clamp(min=1e-20)
    half = 0.5 * cotangent
    rows, columns = torch.cat([tail, head, tail, head]), torch.cat([head, tail, tail, head])
    values = torch.cat([-half, -half, half, half])
    return torch.sparse_coo_tensor(torch.stack([rows, columns]), values, (len(vertices),) * 2).coalesce()


def apply_laplacian(laplacian: Float[Tensor, "V V"], points: Float[Tensor, "*B V 3"]) -> Float[Tensor, "*B V 3"]:
    """L x for any batch; differentiable in the points."""
    batch, count = points.shape[:-2], points.shape[-2]
    flat = points.reshape(-1, count, 3).transpose(0, 1).reshape(count, -1)
    return torch.sparse.mm(laplacian, flat).reshape(count, -1, 3).transpose(0, 1).reshape(*batch, count, 3)
