"""4.1, Eq. 4-6: smooth body fields at any point.  p (N,3) -> W~ (N,J), B~s (N,K,3) and B~p (N,P,3) by direction.

Three implementations of one interface: the Monte-Carlo definition (reference), the paper's networks, a table (the
canonical body is constant, so its fields are functions of the point alone).

Deviations from the paper, which leaves both open: the spread of N(p, d) is read as standard deviation d, the distance
from p to the surface; and the N normal directions are one scrambled Sobol set shared by all points, so that the fields
are smooth in p and repeatable (independent draws would make them noise).
"""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from workbench.body.model import Body
from workbench.geometry.closest_point import ClosestPoint, checked_points, morton_order, run_chunks
from workbench.geometry.field_grid import FieldGrid, GridConfig, Quantisation, tabulate
from workbench.geometry.sampling import gaussian_directions
from workbench.geometry.signed_distance import SignedDistance
from workbench.geometry.warp_kernels import gaussian_neighbours
from workbench.learning.mlp import MLP, load_network, save_network

LEAST_SIGMA = (
    1e-4  # metres: nearer to the surface than this, the neighbourhood keeps that width (0 / 0 in the gradient)
)
BOX_MARGIN = 0.5  # metres around the body that the fields are made for
OFFSET_UNIT = 0.05  # metres: what the networks of B~s and B~p call 1
FIELDS_FOLDER = Path(__file__).parent.parent / "assets" / "fields"
QUERIES_AT_ONCE = 1 << 20  # closest-point queries a chunk: 60 MB of intermediate arrays


@dataclass(frozen=True)
class Rigging:
    """What Eq. 7-8 need of the fields at points once beta and theta are known: W~, and B~s + B~p in metres."""

    weights: Float[Tensor, "*B N J"]
    offset: Float[Tensor, "*B N 3"]


@dataclass(frozen=True)
class FieldValues:
    """W~, and the directions that B~s and B~p are linear in, at points: B~s = beta . shape_directions, B~p = (pose
    feature @ pose_map) . pose_directions."""

    weights: Float[Tensor, "*B N J"]
    shape_directions: Float[Tensor, "*B N K 3"]
    pose_directions: Float[Tensor, "*B N P 3"]

    def rigging(self, betas: Float[Tensor, "*B K"], pose_coefficients: Float[Tensor, "*B P"]) -> Rigging:
        """With beta and the pose coefficients (pose feature @ pose_map) known."""
        shape = torch.einsum("...k,...nki->...ni", betas, self.shape_directions)
        pose = torch.einsum("...p,...npi->...ni", pose_coefficients, self.pose_directions)
        return Rigging(self.weights, shape + pose)


@dataclass(frozen=True)
class FieldLayout:
    """How W~ (J), B~s (K x 3) and B~p (P x 3) lie side by side in one row of channels."""

    joints: int
    shapes: int
    poses: int

    @staticmethod
    def of(body: Body) -> "FieldLayout":
        return FieldLayout(body.weights.shape[1], body.shape_directions.shape[0], body.pose_directions.shape[0])

    @property
    def channels(self) -> int:
        return self.joints + 3 * (self.shapes + self.poses)

    def split(self, rows: Float[Tensor, "*B N C"]) -> FieldValues:
        weights, shape, pose = rows.split([self.joints, 3 * self.shapes, 3 * self.poses], dim=-1)
        return FieldValues(weights, shape.unflatten(-1, (self.shapes, 3)), pose.unflatten(-1, (self.poses, 3)))


class DiffusedFields(ABC):
    """W~(p), B~s(p, beta), B~p(p, theta): the body's attributes carried into space (Eq. 4-6); differentiable in p."""

    pose_map: Float[Tensor, "Q P"]

    @abstractmethod
    def at(self, points: Float[Tensor, "*B N 3"]) -> FieldValues:
        """All three fields at the points (metres, canonical space), before beta and theta are known."""

    @abstractmethod
    def weights(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N J"]:
        """W~(p): skinning weights, a partition of unity      (Eq. 4)"""

    @abstractmethod
    def shape_offsets(self, points: Float[Tensor, "*B N 3"], betas: Float[Tensor, "*B K"]) -> Float[Tensor, "*B N 3"]:
        """B~s(p, beta): displacement for a body shape, metres      (Eq. 5)"""

    @abstractmethod
    def pose_offsets(
        self, points: Float[Tensor, "*B N 3"], pose_feature: Float[Tensor, "*B Q"]
    ) -> Float[Tensor, "*B N 3"]:
        """B~p(p, theta): corrective displacement for a pose, metres      (Eq. 6)"""

    @abstractmethod
    def rigging(
        self,
        points: Float[Tensor, "*B N 3"],
        betas: Float[Tensor, "*B K"],
        pose_coefficients: Float[Tensor, "*B P"],
    ) -> Rigging:
        """W~ and B~s + B~p together, the cheapest way; pose_coefficients = pose feature @ pose_map."""


class LinearFields(DiffusedFields, ABC):
    """Fields that are linear in beta and the pose feature, as the body is: everything follows from `at`."""

    def weights(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N J"]:
        return self.at(points).weights

    def shape_offsets(self, points: Float[Tensor, "*B N 3"], betas: Float[Tensor, "*B K"]) -> Float[Tensor, "*B N 3"]:
        return torch.einsum("...k,...nki->...ni", betas, self.at(points).shape_directions)

    def pose_offsets(
        self, points: Float[Tensor, "*B N 3"], pose_feature: Float[Tensor, "*B Q"]
    ) -> Float[Tensor, "*B N 3"]:
        coefficients = pose_feature @ self.pose_map
        return torch.einsum("...p,...npi->...ni", coefficients, self.at(points).pose_directions)

    def rigging(
        self,
        points: Float[Tensor, "*B N 3"],
        betas: Float[Tensor, "*B K"],
        pose_coefficients: Float[Tensor, "*B P"],
    ) -> Rigging:
        return self.at(points).rigging(betas, pose_coefficients)


# The Monte-Carlo definition


@dataclass(frozen=True)
class Neighbourhood:
    """phi(q_n) of the points' Gaussian neighbours: vertices and barycentric weights, three a neighbour; and phi(p)."""

    vertex: Int[Tensor, "N S3"]
    barycentric: Float[Tensor, "N S3"]
    own_vertex: Int[Tensor, "N 3"]
    own_barycentric: Float[Tensor, "N 3"]
    away: Float[Tensor, "N 3"]  # p - phi(p)


class MonteCarloFields(LinearFields):
    """The definition: attributes averaged over the closest surface points of N Gaussian neighbours (Eq. 4-6).

    The gradient in p is that of the expectation, by the score of the normal distribution, which sees the jumps of phi
    across the medial axis (the derivative of the samples does not); its noise falls like that of the values.
    Cost: about 1.5 microseconds a neighbour and thread.
    """

    def __init__(self, body: Body, *, samples: int = 512, seed: int = 0, quasi: bool = True):
        self.layout = FieldLayout.of(body)
        self.pose_map = body.pose_map
        self.faces = body.faces
        self.attributes = body_attributes(body)
        self.directions = gaussian_directions(samples, seed, quasi=quasi)
        self.closest = ClosestPoint(body.template.numpy(), body.faces.numpy())

    def at(self, points: Float[Tensor, "*B N 3"]) -> FieldValues:
        flat = points.reshape(-1, 3)
        rows = _Expectation.apply(flat, self)
        return self.layout.split(rows.reshape(*points.shape[:-1], -1))

    def expectation(self, points: Float[Tensor, "N 3"]) -> Float[Tensor, "N C"]:
        """1/N sum_n A(phi(q_n)) for all attributes A at once."""
        return torch.cat(
            [weighted_sum(self.attributes, near.vertex, near.barycentric) for near in self._chunks(points)]
            or [points.new_zeros(0, self.layout.channels)]
        )

    def expectation_and_jacobian(
        self, points: Float[Tensor, "N 3"]
    ) -> tuple[Float[Tensor, "N C"], Float[Tensor, "3 N C"]]:
        """The expectation and its derivative in p: 1/N sum_n (A(phi(q_n)) - A(phi(p))) d log N(q_n; p, sigma) / dp."""
        values, jacobians = [], []
        for near in self._chunks(points):
            values.append(weighted_sum(self.attributes, near.vertex, near.barycentric))
            scores = self._scores(near.away)
            own = weighted_sum(self.attributes, near.own_vertex, near.own_barycentric)
            jacobian = torch.stack(
                [
                    weighted_sum(
                        self.attributes,
                        near.vertex,
                        near.barycentric * scores[..., axis].repeat_interleave(3, dim=1),
                    )
                    - own * scores[..., axis].mean(1, keepdim=True)
                    for axis in range(3)
                ]
            )
            jacobians.append(jacobian)
        return torch.cat(values), torch.cat(jacobians, dim=1)

    def _scores(self, away: Float[Tensor, "N 3"]) -> Float[Tensor, "N S 3"]:
        """d log N(q; p, sigma(p)) / dp at q = p + sigma g:  (g + (|g|^2 - 3) grad sigma) / sigma."""
        distance = away.norm(dim=-1, keepdim=True)
        sigma = distance.clamp(min=LEAST_SIGMA)
        slope = torch.where(distance > LEAST_SIGMA, away / sigma, torch.zeros_like(away))
        g = self.directions
        return (g + ((g * g).sum(-1, keepdim=True) - 3) * slope[:, None]) / sigma[:, None]

    def _chunks(self, points: Float[Tensor, "N 3"]) -> Iterator[Neighbourhood]:
        array = checked_points(points.detach().cpu().numpy())
        for part in np.array_split(array, max(1, -(-len(array) * len(self.directions) // QUERIES_AT_ONCE))):
            if len(part):
                yield self._neighbourhood(part)

    def _neighbourhood(self, points: Float[np.ndarray, "N 3"]) -> Neighbourhood:
        count, samples = len(points), len(self.directions)
        face, barycentric = np.empty((count, samples), np.int32), np.empty((count, samples, 3), np.float32)
        own_face, own_barycentric = np.empty(count, np.int32), np.empty((count, 3), np.float32)
        away = np.empty((count, 3), np.float32)

        def shared(array: np.ndarray, dtype: Any, ndim: int = 1) -> wp.array:
            return wp.array(array, dtype=dtype, ndim=ndim, device="cpu", copy=False)

        arrays = [shared(points, wp.vec3), shared(morton_order(points), wp.int32)]
        arrays += [shared(self.directions.numpy(), wp.vec3), LEAST_SIGMA]
        arrays += [shared(face, wp.int32, 2), shared(barycentric, wp.vec3, 2)]
        arrays += [shared(own_face, wp.int32), shared(own_barycentric, wp.vec3), shared(away, wp.vec3)]

        def launch(start: int, stop: int) -> None:
            inputs = [self.closest.mesh.id, start, *arrays]
            wp.launch(gaussian_neighbours, dim=stop - start, inputs=inputs, device="cpu", record_tape=False)

        run_chunks(launch, count, chunk=max(1, 4096 // samples))
        return Neighbourhood(
            vertex=self.faces[torch.from_numpy(face).long()].flatten(1),
            barycentric=torch.from_numpy(barycentric).flatten(1) / samples,
            own_vertex=self.faces[torch.from_numpy(own_face).long()],
            own_barycentric=torch.from_numpy(own_barycentric),
            away=torch.from_numpy(away),
        )


class _Expectation(torch.autograd.Function):
    """The expectation with its own gradient in the point (see MonteCarloFields)."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, fields: MonteCarloFields) -> Tensor:
        if not ctx.needs_input_grad[0]:
            return fields.expectation(points)
        values, jacobian = fields.expectation_and_jacobian(points)
        ctx.save_for_backward(jacobian)
        return values

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (jacobian,) = ctx.saved_tensors
        return torch.einsum("nc,inc->ni", grad_outputs[0], jacobian), None


def weighted_sum(
    table: Float[Tensor, "M C"], rows: Int[Tensor, "N k"], weights: Float[Tensor, "N k"]
) -> Float[Tensor, "N C"]:
    """sum_k weights[n,k] table[rows[n,k]], in one pass."""
    return F.embedding_bag(rows, table, per_sample_weights=weights, mode="sum")


def body_attributes(body: Body) -> Float[Tensor, "V C"]:
    """W, shape and pose directions of every vertex as one row of channels (FieldLayout)."""
    shape = body.shape_directions.permute(1, 0, 2).flatten(1)
    pose = body.pose_directions.permute(1, 0, 2).flatten(1)
    return torch.cat([body.weights, shape, pose], dim=1).contiguous()


def body_fingerprint(body: Body) -> str:
    """What a table or a network was made for: a hash of everything of the body that the fields depend on."""
    digest = hashlib.sha256()
    for tensor in (body.template, body.faces, body_attributes(body), body.pose_map):
        digest.update(np.ascontiguousarray(tensor.detach().cpu().numpy()).tobytes())
    return digest.hexdigest()[:16]


# The paper's networks


class LearnedFields(DiffusedFields):
    """The paper's three networks: W~ p -> J with softmax, B~s p -> (K,3), B~p concat(p, pose feature) -> 3; each of 5
    hidden layers of 256 with ReLU (facts.md 1).

    Ours: B~s gives the K directions that beta mixes, because Eq. 5, an expectation, is linear in beta as B_s is; p is
    centred and scaled to the unit box; the pose feature is projected onto what B_p can see of it (feature @ pose_map @
    pinv(pose_map)), which changes no value of B_p and spares the network 246 idle directions; the networks of the
    offsets answer in units of OFFSET_UNIT.
    """

    def __init__(self, body: Body, *, width: int = 256, depth: int = 5, generator: torch.Generator | None = None):
        self.layout = FieldLayout.of(body)
        self.pose_map = body.pose_map
        self.lift = torch.linalg.pinv(body.pose_map)  # the least pose feature with given coefficients
        self.visible = body.pose_map @ self.lift
        self.low = body.template.amin(0) - BOX_MARGIN
        self.high = body.template.amax(0) + BOX_MARGIN
        self.fingerprint = body_fingerprint(body)
        generator = generator or torch.Generator().manual_seed(0)
        sizes = {"width": width, "depth": depth, "generator": generator}
        self.weight_net = MLP(3, self.layout.joints, **sizes)
        self.shape_net = MLP(3, 3 * self.layout.shapes, **sizes)
        self.pose_net = MLP(3 + len(body.pose_map), 3, **sizes)

    def normalised(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
        """The points with the box of the fields carried to about [-1, 1], one scale for all axes."""
        return (points - (self.low + self.high) / 2) / ((self.high - self.low).max() / 2)

    def weights(self, points: Float[Tensor, "*B N 3"]) -> Float[Tensor, "*B N J"]:
        return self.weight_net(self.normalised(points)).softmax(-1)

    def shape_directions(self, points: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B K 3"]:
        """What beta mixes to B~s, metres a standard deviation."""
        return OFFSET_UNIT * self.shape_net(self.normalised(points)).unflatten(-1, (-1, 3))

    def shape_offsets(self, points: Float[Tensor, "*B N 3"], betas: Float[Tensor, "*B K"]) -> Float[Tensor, "*B N 3"]:
        return torch.einsum("...k,...nki->...ni", betas, self.shape_directions(points))

    def pose_offsets(
        self, points: Float[Tensor, "*B N 3"], pose_feature: Float[Tensor, "*B Q"]
    ) -> Float[Tensor, "*B N 3"]:
        return OFFSET_UNIT * self.pose_net(_beside(self.normalised(points), pose_feature @ self.visible))

    def at(self, points: Float[Tensor, "*B N 3"]) -> FieldValues:
        """All three, with the network of B~p (which need not be linear) probed by secants about zero: P pairs of
        evaluations.  Slow; call `weights`, `shape_offsets` and `pose_offsets` where beta and theta are known."""
        lead, pose = points.shape[:-2], []
        for feature in self.lift:
            feature = feature.expand(*lead, -1)
            pose.append((self.pose_offsets(points, feature) - self.pose_offsets(points, -feature)) / 2)
        return FieldValues(self.weights(points), self.shape_directions(points), torch.stack(pose, -2))

    def rigging(
        self,
        points: Float[Tensor, "*B N 3"],
        betas: Float[Tensor, "*B K"],
        pose_coefficients: Float[Tensor, "*B P"],
    ) -> Rigging:
        feature = pose_coefficients @ self.lift
        return Rigging(self.weights(points), self.shape_offsets(points, betas) + self.pose_offsets(points, feature))

    def to(self, device: torch.device) -> "LearnedFields":
        """Move them to a device, in place."""
        for name in ("pose_map", "lift", "visible", "low", "high"):
            setattr(self, name, getattr(self, name).to(device))
        for network in self.networks().values():
            network.to(device)
        return self

    def networks(self) -> dict[str, MLP]:
        """The three networks by the name of their checkpoint file."""
        return {"weights": self.weight_net, "shape": self.shape_net, "pose": self.pose_net}

    def save(self, folder: str | Path, only: Collection[str] = ("weights", "shape", "pose")) -> None:
        """Write weights, shape and pose.safetensors (float16: measured harmless), or some, into the folder."""
        for name in self.networks().keys() & only:
            network = self.networks()[name]
            save_network(network, Path(folder) / f"{name}.safetensors", kind=name, fingerprint=self.fingerprint)

    @staticmethod
    def load(folder: str | Path, body: Body) -> "LearnedFields":
        """Read what `save` wrote.  ValueError where a file is missing, damaged or made for another body."""
        fields = LearnedFields(body)
        fields.read(folder)
        return fields

    def read(self, folder: str | Path, only: Collection[str] = ("weights", "shape", "pose")) -> None:
        """Fill these networks, or some of them, with what `save` wrote.  Errors: as `load`'s."""
        for name in self.networks().keys() & only:
            path = Path(folder) / f"{name}.safetensors"
            load_network(self.networks()[name], path, kind=name, fingerprint=self.fingerprint)

    @staticmethod
    def default(body: Body | None = None) -> "LearnedFields":
        """The networks that ship, for the default body."""
        return LearnedFields.load(FIELDS_FOLDER, body or Body.default())


def _beside(points: Float[Tensor, "*B N 3"], condition: Float[Tensor, "*B c"]) -> Float[Tensor, "*B N i"]:
    """concat(p, condition) for every point."""
    expanded = condition[..., None, :].expand(*points.shape[:-1], condition.shape[-1])
    return torch.cat([points, expanded], dim=-1)


# The table


@dataclass(frozen=True)
class GridFieldsConfig:
    """How Eq. 4-6 are tabulated.  Tolerances are the largest error a cell may have at its middle points at the surface;
    they grow linearly with the distance, doubling at `relax` metres, and faster inside the body, where no cloth is,
    doubling `relax_inside` metres below a skin of SKIN.  Ours, measured (`workbench evaluate fields`)."""

    samples: int = 256  # N of Eq. 4-6, quasi-random: error 0.002 in L1
    seed: int = 0
    weights: float = 0.014  # L1
    shape: float = 1e-3  # metres, root mean square over beta ~ N(0, I)
    pose: float = 1e-3  # metres, root mean square over coefficients of POSE_SPREAD
    relax: float = 0.08  # metres
    relax_inside: float = 0.005  # metres
    grid: GridConfig = GridConfig(root_size=0.128, depth=4)  # 8 mm at the finest
    weight_step: float = 1 / 1024
    offset_step: float = 1.5e-4  # metres


SKIN = 0.01  # metres inside the body that are tabulated as finely as the outside: a projection may pass there
POSE_SPREAD = 0.25  # typical coefficient of a pose direction over random poses


class GridFields(LinearFields):
    """Eq. 4-6 read off a table: eight rows a point, the exact gradient of the interpolant; outside of the box, the
    value at its border."""

    def __init__(self, grid: FieldGrid, body: Body):
        self.layout = FieldLayout.of(body)
        fingerprint = body_fingerprint(body)
        if grid.channels != self.layout.channels:
            raise ValueError(
                f"the grid has {grid.channels} channels, but body '{body.name}' needs {self.layout.channels} "
                f"({self.layout}); tabulate its fields with GridFields.tabulate(body)"
            )
        if grid.compact.made_for != fingerprint:
            raise ValueError(
                f"the grid was made for another body ({grid.compact.made_for}, '{body.name}' is {fingerprint}); "
                "make it again with `python -m assets_gen checkpoints` or GridFields.tabulate(body)"
            )
        self.grid = grid
        self.pose_map = body.pose_map

    def at(self, points: Float[Tensor, "*B N 3"]) -> FieldValues:
        return self.layout.split(self.grid.at(points))

    def save(self, path: str | Path) -> None:
        """Write the grid (npz)."""
        self.grid.save(path)

    @staticmethod
    def load(path: str | Path, body: Body) -> "GridFields":
        """Read what `save` wrote.  ValueError for a damaged file or one made for another body."""
        return GridFields(FieldGrid.load(path), body)

    @staticmethod
    def default(body: Body | None = None) -> "GridFields":
        """The grid that ships, for the default body (read once a process)."""
        if body is None or body is Body.default():
            return _default_grid()
        return GridFields.load(FIELDS_FOLDER / "fields.npz", body)

    @staticmethod
    def tabulate(
        body: Body,
        config: GridFieldsConfig | None = None,
        *,
        progress: Callable[[int, int, int], None] | None = None,
    ) -> "GridFields":
        """Tabulate the Monte-Carlo fields of a body in the box of BOX_MARGIN around it (minutes)."""
        config = config or GridFieldsConfig()
        exact = MonteCarloFields(body, samples=config.samples, seed=config.seed)
        layout, vertices = exact.layout, body.template.numpy()
        signed = SignedDistance(vertices, body.faces.numpy())

        def field(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n C"]:
            return exact.expectation(torch.from_numpy(points)).numpy().astype(np.float64)

        def error(surplus: Float[np.ndarray, "m C"], points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m"]:
            weights, shape, pose = np.split(surplus, [layout.joints, layout.joints + 3 * layout.shapes], axis=1)
            ratio = np.maximum(
                np.abs(weights).sum(1) / config.weights,
                np.maximum(
                    np.linalg.norm(shape, axis=1) / config.shape,
                    np.linalg.norm(pose, axis=1) * POSE_SPREAD / config.pose,
                ),
            )
            distance = signed(points)
            depth = np.maximum(-distance - SKIN, 0)
            return ratio / (1 + np.abs(distance) / config.relax + depth / config.relax_inside)

        step = np.full(layout.channels, config.offset_step)
        step[: layout.joints] = config.weight_step
        grid = tabulate(
            field,
            error,
            vertices.min(0) - BOX_MARGIN,
            vertices.max(0) + BOX_MARGIN,
            Quantisation(step, simplex=(0, layout.joints)),
            config.grid,
            made_for=body_fingerprint(body),
            progress=progress,
        )
        return GridFields(grid, body)


@cache
def _default_grid() -> GridFields:
    return GridFields.load(FIELDS_FOLDER / "fields.npz", Body.default())
