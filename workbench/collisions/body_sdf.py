"""4.3, Eq. 12: signed distance to the constant canonical body.  p (N,3) -> SDF (N,), positive outside.

Three implementations of one interface, all differentiable in p: exact (BVH and winding number), learned (SIREN),
tabulated (adaptive grid).
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.diffused_body import BOX_MARGIN, FIELDS_FOLDER, body_fingerprint
from workbench.geometry.field_grid import FieldGrid, GridConfig, Quantisation, tabulate
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
    """The paper's network: 5 sine layers of 256, omega_0 = 30 in all, linear out (facts.md 1).  Metres in and out."""

    def __init__(self, body: Body, *, width: int = 256, depth: int = 5, generator: torch.Generator | None = None):
        self.low = body.template.amin(0) - BOX_MARGIN
        self.high = body.template.amax(0) + BOX_MARGIN
        self.fingerprint = body_fingerprint(body)
        generator = generator or torch.Generator().manual_seed(0)
        self.network = Siren(3, 1, width=width, depth=depth, omega=30.0, generator=generator)

    def __call__(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N"]:
        centred = (points - (self.low + self.high) / 2) / ((self.high - self.low).max() / 2)
        return self.network(centred)[..., 0]

    def to(self, device: torch.device) -> "LearnedSDF":
        """Move it to a device, in place."""
        self.low, self.high = self.low.to(device), self.high.to(device)
        self.network.to(device)
        return self

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


@dataclass(frozen=True)
class GridSDFConfig:
    """How the distance is tabulated: the largest error a cell may have at its middle points is `tolerance`, growing by
    `relax` a metre of distance (kinks of the medial axis deep inside and far away are not worth their cells)."""

    tolerance: float = 2e-4  # metres
    relax: float = 0.02
    grid: GridConfig = GridConfig(root_size=0.128, depth=5)  # 4 mm at the finest
    step: float = 2e-5  # metres


class GridSDF(BodySDF):
    """The distance read off a table; beyond its box, the distance to the box is added."""

    def __init__(self, grid: FieldGrid, body: Body):
        fingerprint = body_fingerprint(body)
        if grid.channels != 1:
            raise ValueError(f"the grid has {grid.channels} channels, a signed distance has 1")
        if grid.compact.made_for != fingerprint:
            raise ValueError(
                f"the grid was made for another body ({grid.compact.made_for}, '{body.name}' is {fingerprint}); "
                "make it again with `python -m assets_gen checkpoints` or GridSDF.tabulate(body)"
            )
        self.grid = grid

    def __call__(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N"]:
        low, high = self.grid.low.to(points), self.grid.high.to(points)
        beyond = torch.relu(low - points) + torch.relu(points - high)
        within = self.grid.at(points)[..., 0]
        if not bool((beyond > 0).any()):
            return within
        return within + torch.linalg.vector_norm(beyond, dim=-1)

    def to(self, device: torch.device) -> "GridSDF":
        """The same table on another device."""
        moved = copy.copy(self)
        moved.grid = self.grid.to(device)
        return moved

    def save(self, path: str | Path) -> None:
        """Write the grid (npz)."""
        self.grid.save(path)

    @staticmethod
    def load(path: str | Path, body: Body) -> "GridSDF":
        """Read what `save` wrote.  ValueError for a damaged file or one made for another body."""
        return GridSDF(FieldGrid.load(path), body)

    @staticmethod
    def default(body: Body | None = None) -> "GridSDF":
        """The grid that ships, for the default body (read once a process)."""
        if body is None or body is Body.default():
            return _default_grid()
        return GridSDF.load(FIELDS_FOLDER / "sdf.npz", body)

    @staticmethod
    def tabulate(
        body: Body,
        config: GridSDFConfig | None = None,
        *,
        progress: Callable[[int, int, int], None] | None = None,
    ) -> "GridSDF":
        """Tabulate the exact distance in the box of BOX_MARGIN around the body (a minute)."""
        config = config or GridSDFConfig()
        vertices = body.template.numpy()
        exact = SignedDistance(vertices, body.faces.numpy())

        def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 1"]:
            return exact(points)[:, None].astype(np.float64)

        def error(surplus: Float[np.ndarray, "m 1"], points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m"]:
            return np.abs(surplus[:, 0]) / (config.tolerance + config.relax * exact.closest.query(points).distance)

        grid = tabulate(
            field,
            error,
            vertices.min(0) - BOX_MARGIN,
            vertices.max(0) + BOX_MARGIN,
            Quantisation(np.array([config.step])),
            config.grid,
            made_for=body_fingerprint(body),
            progress=progress,
        )
        return GridSDF(grid, body)


@cache
def _default_grid() -> GridSDF:
    return GridSDF.load(FIELDS_FOLDER / "sdf.npz", Body.default())
