"""Points to ask fields at: on a surface, in a shell around it, in a box; normal directions.  generator -> (N,3)."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.quasirandom import SobolEngine


@dataclass(frozen=True)
class SurfaceSamples:
    """Points on a mesh with the face they lie on and its unit normal."""

    point: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    face: Int[np.ndarray, "N"]


def sample_surface(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    count: int,
    generator: np.random.Generator,
    *,
    face_weight: Float[np.ndarray, "F"] | None = None,
) -> SurfaceSamples:
    """Points uniform by area (times `face_weight`, if given).  Metres."""
    corners = vertices[faces].astype(np.float64)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    twice_area = np.linalg.norm(cross, axis=1)
    share = twice_area if face_weight is None else twice_area * face_weight
    if not share.sum() > 0:
        raise ValueError("cannot sample the surface: no face has both an area and a weight above zero")
    face = generator.choice(len(faces), size=count, p=share / share.sum())
    r, s = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
    a, b, c = corners[face].transpose(1, 0, 2)
    point = (1 - r) * a + r * (1 - s) * b + r * s * c
    normal = cross[face] / np.maximum(twice_area[face], 1e-20)[:, None]
    return SurfaceSamples(point.astype(np.float32), normal.astype(np.float32), face)


def sample_shell(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    count: int,
    low: float,
    high: float,
    generator: np.random.Generator,
    *,
    face_weight: Float[np.ndarray, "F"] | None = None,
) -> Float[np.ndarray, "N 3"]:
    """Surface points moved along their normals by a uniform offset in [low, high] metres (in a crease they may end up
    nearer to the other side)."""
    samples = sample_surface(vertices, faces, count, generator, face_weight=face_weight)
    offset = generator.uniform(low, high, (count, 1)).astype(np.float32)
    return samples.point + offset * samples.normal


def sample_box(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], count: int, generator: np.random.Generator
) -> Float[np.ndarray, "N 3"]:
    """Points uniform in a box."""
    return generator.uniform(low, high, (count, 3)).astype(np.float32)


def gaussian_directions(count: int, seed: int, *, quasi: bool = True) -> Float[Tensor, "S 3"]:
    """Standard normal directions in 3-D, the same for every caller: a scrambled Sobol sequence through the inverse
    normal distribution, or (quasi=False) independent draws.  The error of a mean falls like 1/S and 1/sqrt(S)."""
    if count < 1:
        raise ValueError(f"the number of samples must be at least 1, got {count}")
    if quasi:
        uniform = SobolEngine(3, scramble=True, seed=seed).draw(count, dtype=torch.float64)
        uniform = uniform.clamp(1e-9, 1 - 1e-9)
        return torch.special.ndtri(uniform).float()
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(count, 3, generator=generator)
