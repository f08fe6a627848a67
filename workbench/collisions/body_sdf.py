"""4.3, Eq. 12: signed distance to the constant canonical body.  p (N,3) -> SDF (N,), positive outside, differentiable in p.

Three implementations of one interface: exact (BVH and winding number), learned (SIREN), tabulated (adaptive grid).
"""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import BOX_MARGIN, FIELDS_FOLDER, body_fingerprint
from workbench.geometry.signed_distance import SignedDistance
from workbench.learning.mlp import Siren, load_network, save_network


class BodySDF(ABC):
    """SDF(p) of Eq. 12: metres, positive outside the canonical body."""

    @abstractmethod
    def __call__(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N"]: ...


class ExactSDF(BodySDF):
    """Distance to the closest surface point, sign by winding number; its gradient is the direction to that point."""

    def __init__(self, body: Body):
        self.distance = SignedDistance(body.template.numpy(), body.faces.numpy())

    def __call__(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N"]:
        return _ExactDistance.apply(points.reshape(-1, 3), self.distance).reshape(points.shape[:-1])


class _ExactDistance(torch.autograd.Function):
    """|p - phi(p)| with sign; d/dp = sign (p - phi(p)) / |p - phi(p)|, and 0 on the surface itself."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, distance: SignedDistance) -> Tensor:
        signed, nearest = distance.with_surface_point(points.detach().cpu().numpy())
        value = torch.from_numpy(signed).to(points)
        offset = points.detach() - torch.from_numpy(nearest.point).to(points)
        ctx.save_for_backward(torch.nn.functional.normalize(offset, dim=-1, eps=1e-7) * value.sign()[:, None])
        return value

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (direction,) = ctx.saved_tensors
        return grad_outputs[0][:, None] * direction, None


class LearnedSDF(BodySDF):
    """The paper's network: 5 sine layers of 256, omega_0 = 30 in all, linear out (facts.md 1).  Metres in, metres out."""

    def __init__(self, body: Body, *, width: int = 256, depth: int = 5, generator: torch.Generator | None = None):
        self.low = body.template.amin(0) - BOX_MARGIN
        self.high = body.template.amax(0) + BOX_MARGIN
        self.fingerprint = body_fingerprint(body)
        generator = generator or torch.Generator().manual_seed(0)
        self.network = Siren(3, 1, width=width, depth=depth, omega=30.0, generator=generator)

    def __call__(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N"]:
        centred = (points - (self.low + self.high) / 2) / ((self.high - self.low).max() / 2)
        return self.network(centred)[..., 0]

    def save(self, folder: str | Path) -> None:
        """Write sdf.safetensors (float16) into the folder."""
        save_network(self.network, Path(folder) / "sdf.safetensors", kind="sdf", fingerprint=self.fingerprint)

    @staticmethod
    def load(folder: str | Path, body: Body) -> "LearnedSDF":
        """Read what `save` wrote.  ValueError where the file is missing, damaged or made for another body."""
        sdf = LearnedSDF(body)
        load_network(sdf.network, Path(folder) / "sdf.safetensors", kind="sdf", fingerprint=sdf.fingerprint)
        return sdf

    @staticmethod
    def default(body: Body | None = None) -> "LearnedSDF":
        """The network that ships, for the default body."""
        return LearnedSDF.load(FIELDS_FOLDER, body or Body.default())
