"""Beyond the paper: contact as planes.  worn poses, C -> distances of every vertex to skin, to first order in C.

To look where a posed garment touches takes 20 ms; its share of a network's step over what was seen takes 0.6 ms.  So
many garments are looked at, each vertex keeps the plane of the skin nearest to it, and many steps are taken before they
are looked at anew.  That the fields at X are held fixed makes the posed vertex linear in C already (`posed_distance`).
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.collisions.body_sdf import BodySDF
from workbench.collisions.posed_distance import PosedDistance
from workbench.collisions.worn_poses import WornPoses

MILLI = 1e3
AT_ONCE = 16  # garments looked at together

Planes = Float[Tensor, "M N 4"]  # distance in millimetres where C is zero, and how it grows with C; float16


@dataclass(frozen=True, eq=False)
class ContactPlanes:
    """Of M worn poses, the nearest skin of every vertex: of the posed body, and of the canonical one (Eq. 16)."""

    worn: WornPoses
    posed: Planes
    canonical: Planes

    def __len__(self) -> int:
        return len(self.worn)

    def __getitem__(self, index: Tensor) -> "ContactPlanes":
        return ContactPlanes(self.worn[index], self.posed[index], self.canonical[index])

    def distances(self, offset: Float[Tensor, "M N 3"]) -> tuple[Float[Tensor, "M N"], Float[Tensor, "M N"]]:
        """Signed distances in posed and in canonical space, millimetres.  offset: C, millimetres."""
        return _distance(self.posed, offset), _distance(self.canonical, offset)

    @staticmethod
    def of(
        worn: WornPoses,
        decode: Callable[[Tensor], Tensor],
        corrective: Callable[[Tensor, Tensor, Tensor], Tensor],
        distance: PosedDistance,
        sdf: BodySDF,
    ) -> "ContactPlanes":
        """Look at garments as they are corrected now."""
        parts: list[tuple[Tensor, Tensor]] = []
        for some in torch.arange(len(worn)).split(AT_ONCE):
            w = worn[some]
            with torch.no_grad():
                offset = corrective(w.rotations, w.betas, w.latents)
                corrected = decode(w.latents) + offset
            of_body = _plane(lambda X, w=w: distance.of(X, w.rotations, w.betas), corrected, offset)
            parts.append((of_body, _plane(sdf, corrected, offset)))
        both = [torch.cat(of_one) for of_one in zip(*parts, strict=True)]
        return ContactPlanes(worn, *both)


def _plane(
    distance_of: Callable[[Tensor], Tensor], corrected: Float[Tensor, "M N 3"], offset: Float[Tensor, "M N 3"]
) -> Planes:
    X = corrected.detach().requires_grad_(True)
    distance = distance_of(X)
    (growth,) = torch.autograd.grad(distance.sum(), X)
    at_zero = distance.detach() - (growth * offset).sum(-1)
    return torch.cat([MILLI * at_zero[..., None], growth], dim=-1).half()


def _distance(planes: Planes, offset: Float[Tensor, "M N 3"]) -> Float[Tensor, "M N"]:
    at_zero, growth = planes.float().split([1, 3], dim=-1)
    return at_zero[..., 0] + (growth * offset).sum(-1)
