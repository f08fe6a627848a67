"""4.1, 4.3: the networks of the diffused body and of its signed distance.  body -> four trained networks.

`workbench train fields`; a run that is killed continues where it stopped.
"""

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.body_sdf import ExactSDF, LearnedSDF
from workbench.collisions.diffused_body import (
    BOX_MARGIN,
    OFFSET_UNIT,
    FieldLayout,
    LearnedFields,
    MonteCarloFields,
)
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.geometry.sampling import sample_box, sample_shell
from workbench.learning.fit import FitConfig, FitResult, fit

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PoolConfig:
    """Where the networks look: shares of the points by place; metres.

    Ours: garments live 0-60 mm off the body, so most points are there; the rest fills the box that Eq. 9 may search.
    """

    points: int = 300_000
    near: float = 0.25  # -10 .. 10 mm off the surface
    cloth: float = 0.45  # 0 .. 60 mm
    loose: float = 0.15  # 60 .. 250 mm: skirts, sleeves hanging
    samples: int = 256  # N of Eq. 4-6, quasi-random: error 0.002 in L1 (facts.md 1: plain N = 4000 has 0.003)


@dataclass(frozen=True)
class TrainFieldsConfig:
    """`workbench train fields`: the networks of Eq. 4-6 and the SDF of Eq. 12.

    Defaults are sized for two CPU cores (about an hour); `paper_size()` trains 10 times longer on a denser pool.  The
    paper names neither optimiser nor steps nor N: ours, measured.
    """

    out: Path = Path("out/fields")  # the networks, and their checkpoints under work/
    body: Path | None = None  # a body file; the default body when absent
    batch: int = 2048
    pool: PoolConfig = PoolConfig()
    weights: FitConfig = FitConfig(steps=9000, learning_rate=2e-3)
    shape: FitConfig = FitConfig(steps=6000, learning_rate=1e-3)
    pose: FitConfig = FitConfig(steps=6000, learning_rate=1e-3)
    # SIREN's own rate is 1e-4 (Sitzmann et al. 2020); 2e-4 is faster, at 3e-4 it diverged after 1,000 steps
    sdf: FitConfig = FitConfig(steps=8000, learning_rate=2e-4, last_rate=2e-7)
    sdf_points: int = 2_000_000
    seed: int = 0

    @staticmethod
    def paper_size() -> "TrainFieldsConfig":
        """Ten times the steps, four times the pool: for a machine with a GPU or a night."""
        small = TrainFieldsConfig()
        longer = {
            name: replace(getattr(small, name), steps=10 * getattr(small, name).steps)
            for name in ("weights", "shape", "pose", "sdf")
        }
        return replace(small, batch=8192, pool=PoolConfig(points=1_200_000, samples=1024), **longer)


@dataclass(frozen=True)
class TrainedFields:
    """The networks of a run and how each fit ended."""

    fields: LearnedFields
    sdf: LearnedSDF
    fits: dict[str, FitResult]


@dataclass(frozen=True)
class FieldPool:
    """Points and the Monte-Carlo values of all channels there: what the networks learn from."""

    points: Float[Tensor, "N 3"]
    rows: Float[Tensor, "N C"]
    layout: FieldLayout


@dataclass(frozen=True)
class DistancePool:
    """Points and their exact signed distance [m]."""

    points: Float[Tensor, "N 3"]
    distances: Float[Tensor, "N"]


def run(config: TrainFieldsConfig) -> TrainedFields:
    """Train all four networks and write them to `config.out`; continues an interrupted run."""
    body = Body.load(config.body) if config.body else Body.default()
    work = config.out / "work"
    fields = LearnedFields(body, generator=torch.Generator().manual_seed(config.seed))
    sdf = LearnedSDF(body, generator=torch.Generator().manual_seed(config.seed + 1))
    fits: dict[str, FitResult] = {}

    def train(name: str, network: torch.nn.Module, loss_of: Callable[[int, torch.Generator], Tensor]) -> None:
        generator = torch.Generator().manual_seed(config.seed + 10 + len(fits))
        fits[name] = fit(
            list(network.parameters()),
            loss_of,
            getattr(config, name),
            generator=generator,
            checkpoint=work / f"{name}.safetensors",
            label=name,
        )

    @cache  # made at the first step that asks: a run that only finishes the SDF needs none
    def pool() -> FieldPool:
        return make_pool(body, config.pool, seed=config.seed)

    @cache
    def distances() -> DistancePool:
        return make_distance_pool(body, config.sdf_points, seed=config.seed)

    poses = random_pose_features(body, 8192, seed=config.seed)
    train("weights", fields.weight_net, lambda _, generator: weights_loss(fields, pool(), config.batch, generator))
    train("pose", fields.pose_net, lambda _, generator: pose_loss(fields, pool(), poses, config.batch, generator))
    train("shape", fields.shape_net, lambda _, generator: shape_loss(fields, pool(), config.batch, generator))
    fields.save(config.out)
    train("sdf", sdf.network, lambda _, generator: sdf_loss(sdf, distances(), config.batch, generator))
    sdf.save(config.out)
    log.info("trained %s", {name: asdict(result) for name, result in fits.items()})
    return TrainedFields(fields, sdf, fits)


# What each step minimises


def weights_loss(fields: LearnedFields, pool: FieldPool, batch: int, generator: torch.Generator) -> Tensor:
    """Mean L1 distance of W~ to Eq. 4: the figure it is judged by."""
    index = torch.randint(len(pool.points), (batch,), generator=generator)
    target = pool.layout.split(pool.rows[index].float()).weights
    return (fields.weights(pool.points[index]) - target).abs().sum(-1).mean()


def shape_loss(fields: LearnedFields, pool: FieldPool, batch: int, generator: torch.Generator) -> Tensor:
    """Mean distance of B~s to Eq. 5 at shapes beta ~ N(0, I), in units of OFFSET_UNIT."""
    index = torch.randint(len(pool.points), (batch,), generator=generator)
    betas = torch.randn(batch, pool.layout.shapes, generator=generator)
    target = torch.einsum("nk,nki->ni", betas, pool.layout.split(pool.rows[index].float()).shape_directions)
    predicted = fields.shape_offsets(pool.points[index, None], betas)[:, 0]
    return _mean_norm((predicted - target) / OFFSET_UNIT)


def pose_loss(
    fields: LearnedFields, pool: FieldPool, poses: Float[Tensor, "M Q"], batch: int, generator: torch.Generator
) -> Tensor:
    """Mean distance of B~p to Eq. 6 at random poses, in units of OFFSET_UNIT."""
    index = torch.randint(len(pool.points), (batch,), generator=generator)
    feature = poses[torch.randint(len(poses), (batch,), generator=generator)]
    directions = pool.layout.split(pool.rows[index].float()).pose_directions
    target = torch.einsum("np,npi->ni", feature @ fields.pose_map, directions)
    predicted = fields.pose_offsets(pool.points[index, None], feature)[:, 0]
    return _mean_norm((predicted - target) / OFFSET_UNIT)


def sdf_loss(sdf: LearnedSDF, pool: DistancePool, batch: int, generator: torch.Generator) -> Float[Tensor, ""]:
    """Mean absolute error over (10 mm + distance): garments need tenths of a millimetre, the far field millimetres."""
    index = torch.randint(len(pool.points), (batch,), generator=generator)
    truth = pool.distances[index]
    return ((sdf(pool.points[index]) - truth).abs() / (0.01 + truth.abs())).mean()


def _mean_norm(error: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    """Mean Euclidean norm, smooth at zero."""
    return ((error * error).sum(-1) + 1e-12).sqrt().mean()


# What they learn from


def make_pool(body: Body, config: PoolConfig, *, seed: int) -> FieldPool:
    """Points as `config` spreads them, with quasi-Monte-Carlo values of every channel (float16: error below 0.0003)."""
    generator = np.random.default_rng(seed)
    vertices, faces = body.template.numpy(), body.faces.numpy()
    counts = [int(share * config.points) for share in (config.near, config.cloth, config.loose)]
    ranges = [(-0.01, 0.01), (0.0, 0.06), (0.06, 0.25)]
    parts = [
        sample_shell(vertices, faces, count, low, high, generator)
        for count, (low, high) in zip(counts, ranges, strict=True)
    ]
    low, high = vertices.min(0) - BOX_MARGIN, vertices.max(0) + BOX_MARGIN
    parts.append(sample_box(low, high, config.points - sum(counts), generator))
    points = torch.from_numpy(np.concatenate(parts))
    fields = MonteCarloFields(body, samples=config.samples, seed=seed)
    rows = torch.cat([fields.expectation(part).half() for part in points.split(8192)])
    return FieldPool(points, rows, fields.layout)


def make_distance_pool(body: Body, count: int, *, seed: int) -> DistancePool:
    """Points with their exact signed distance: 30 % within 2 mm, 40 % within 20 mm, a quarter within 80 mm, and 5 %
    anywhere in the box: a network of this size cannot be sharp at the body and right far away."""
    generator = np.random.default_rng(seed)
    vertices, faces = body.template.numpy(), body.faces.numpy()
    parts = [
        sample_shell(vertices, faces, int(share * count), -reach, reach, generator)
        for share, reach in ((0.3, 0.002), (0.4, 0.02), (0.25, 0.08))
    ]
    low, high = vertices.min(0) - BOX_MARGIN, vertices.max(0) + BOX_MARGIN
    parts.append(sample_box(low, high, count - sum(map(len, parts)), generator))
    points = torch.from_numpy(np.concatenate(parts))
    return DistancePool(points, ExactSDF(body)(points))


def random_pose_features(body: Body, count: int, *, seed: int) -> Float[Tensor, "M Q"]:
    """Pose features of random poses: every joint turned by a normal rotation vector, of 0.1 to 0.8 rad for a pose."""
    generator = torch.Generator().manual_seed(seed)
    joints = len(body.parents)
    spread = 0.1 + 0.7 * torch.rand(count, 1, 1, generator=generator)
    vectors = spread * torch.randn(count, joints, 3, generator=generator)
    return body.pose_feature(axis_angle_to_matrix(vectors))
