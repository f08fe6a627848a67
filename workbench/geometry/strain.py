"""Eq. 11: Green-Lagrange strain of a triangle mesh.  rest triangles, vertices (N,3) -> F (M,3,2) -> strain (M,2,2)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class RestTriangles:
    """The material of a mesh: the inverse of each triangle's flat rest edges, and its rest area (square metres)."""

    faces: Int[Tensor, "M 3"]
    inverse_edges: Float[Tensor, "M 2 2"]
    area: Float[Tensor, "M"]


def rest_triangles(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "M 3"]) -> RestTriangles:
    """Flatten each triangle of the rest shape.

    Errors: ValueError when a triangle has no area, naming it.
    """
    first, second = _edges(vertices, faces).unbind(dim=-1)
    length = first.norm(dim=-1)
    along = (first * second).sum(dim=-1) / length.clamp_min(torch.finfo(vertices.dtype).tiny)
    height = torch.linalg.cross(first, second).norm(dim=-1) / length.clamp_min(torch.finfo(vertices.dtype).tiny)
    area = 0.5 * length * height
    if not bool((area > 0).all()):
        raise ValueError(f"rest triangle {int(area.argmin())} has no area; remove degenerate faces from the garment")
    zero = torch.zeros_like(length)
    edges = torch.stack([torch.stack([length, along], dim=-1), torch.stack([zero, height], dim=-1)], dim=-2)
    return RestTriangles(faces, torch.linalg.inv(edges), area)


def deformation_gradient(vertices: Float[Tensor, "*B N 3"], rest: RestTriangles) -> Float[Tensor, "*B M 3 2"]:
    """F of each triangle: how its flat rest edges became its edges in space."""
    return _edges(vertices, rest.faces) @ rest.inverse_edges


def green_strain(F: Float[Tensor, "*B M 3 2"]) -> Float[Tensor, "*B M 2 2"]:
    """1/2 (F^T F - I): zero for any rigid motion      (Eq. 11)"""
    return 0.5 * (F.mT @ F - torch.eye(2, dtype=F.dtype, device=F.device))


def principal_stretches(F: Float[Tensor, "*B M 3 2"]) -> Float[Tensor, "*B M 2"]:
    """The largest and smallest stretch of each triangle; 1 is unstretched."""
    gram = F.mT @ F
    mean = 0.5 * (gram[..., 0, 0] + gram[..., 1, 1])
    half = 0.5 * (gram[..., 0, 0] - gram[..., 1, 1])
    radius = torch.sqrt(half.square() + gram[..., 0, 1].square())
    return torch.stack([mean + radius, (mean - radius).clamp_min(0.0)], dim=-1).sqrt()


def _edges(vertices: Float[Tensor, "*B N 3"], faces: Int[Tensor, "M 3"]) -> Float[Tensor, "*B M 3 2"]:
    corner = vertices[..., faces[:, 0], :]
    return torch.stack([vertices[..., faces[:, 1], :] - corner, vertices[..., faces[:, 2], :] - corner], dim=-1)
