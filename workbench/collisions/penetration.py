"""Sec. 6: which garment vertices are inside the body.  body (T,V,3), garment (T,N,3) -> inside (T,N), overlap (T,N).

A vertex collides where the body's exact winding number exceeds 1/2.  Where it exceeds 3/2 the body overlaps itself, and
no garment could be free of it: such vertices are counted apart, never left out.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from workbench.geometry.winding import InsideTest, winding_number


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
    if len(body_vertices) not in (1, len(garment)):
        raise ValueError(f"{len(body_vertices)} body frames, but {len(garment)} garment frames; cut both to one length")
    if not bool(torch.isfinite(garment).all()):
        raise ValueError("the garment holds NaN or infinity; drop the frames where it diverged")
    faces = body_faces.numpy()
    test = InsideTest(body_vertices[0].numpy(), faces)
    inside = torch.zeros(garment.shape[:2], dtype=torch.bool)
    overlap = torch.zeros_like(inside)
    for frame, points in enumerate(garment.numpy()):
        moves = len(body_vertices) > 1
        surface = body_vertices[frame if moves else 0].numpy()
        if moves:
            test.refit(surface)
        hit = np.flatnonzero(test(points))
        inside[frame, hit] = True
        overlap[frame, hit] = torch.from_numpy(winding_number(points[hit], surface, faces) > 1.5)
        progress(1)
    return Penetration(inside, overlap)
