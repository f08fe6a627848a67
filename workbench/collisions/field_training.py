"""4.1, 4.3: the networks of the diffused body and of its signed distance.  body -> four trained networks.

`workbench train fields`; a run that is killed continues where it stopped.
"""

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

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
from workbench.learning.batches import random_rows
from workbench.learning.device import device_named
from workbench.learning.fit import FitConfig, FitResult, fit

log = logging.getLogger(__name__)

Network = Literal["weights", "pose", "shape", "sdf"]
ORDER: tuple[Network, ...] = ("weights", "pose", "shape", "sdf")


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

    Defaults are sized for two CPU cores (about an hour); --paper trains 10 times longer on a denser pool.  The
    paper names neither optimiser nor steps nor N: ours, measured.
    """

    out: Path = Path("out/fields")  # the networks, and their checkpoints under work/
    networks: tuple[Network, ...] = ORDER  # which to train
    start: Path | None = None  # folder of networks to start from, instead of from chance
    body: Path | None = None  # a body file; the default body when absent
    batch: int = 2048
    pool: PoolConfig = PoolConfig()
    weights: FitConfig = FitConfig(steps=9000, learning_rate=2e-3)
    shape: FitConfig = FitConfig(steps=9000, learning_rate=2e-3)
    pose: FitConfig = FitConfig(steps=6000, learning_rate=1e-3)
    # SIREN's own rate (Sitzmann et al. 2020); distances in metres: in units of 0.1 m the far field ends twice as wrong
    sdf: FitConfig = FitConfig(steps=14_000, learning_rate=1e-4, last_rate=1e-7)
    sdf_batch: int = 1024  # 1,200 such steps end 0.54 mm off on the surface, 500 of 4,096 points 0.76 mm
    sdf_points: int = 2_000_000
    seed: int = 0
    device: str = "cpu"  # cpu, cuda, cuda:1, mps; what the networks learn from is made on the CPU first

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
    fits: dict[Network, FitResult]

    def save(self, folder: Path) -> None:
        """Write those that were trained, one file a network."""
        self.fields.save(folder, only=self.fits)
        if "sdf" in self.fits:
            self.sdf.save(folder)


@dataclass(frozen=True)
class FieldPool:
    """Points and the Monte-Carlo values of all channels there: what the networks learn from."""

    points: Float[Tensor, "N 3"]
    rows: Float[Tensor, "N C"]
    layout: FieldLayout

    def to(self, device: torch.device) -> "FieldPool":
        """The same on a device."""
        return FieldPool(self.points.to(device), self.rows.to(device), self.layout)


@dataclass(frozen=True)
class DistancePool:
    """Points and their exact signed distance [m]."""

    points: Float[Tensor, "N 3"]
    distances: Float[Tensor, "N"]

    def to(self, device: torch.device) -> "DistancePool":
        """The same on a device."""
        return DistancePool(self.points.to(device), self.distances.to(device))


def run(config: TrainFieldsConfig) -> TrainedFields:
    """Train the networks that are asked for and write each to `config.out`; continues an interrupted run.

    What it returns is on the CPU.  Raises ValueError for a device that is not there.
    """
    device = device_named(config.device)
    body = Body.load(config.body) if config.body else Body.default()
    work = config.out / "work"
    fields = LearnedFields(body, generator=torch.Generator().manual_seed(config.seed))
    sdf = LearnedSDF(body, generator=torch.Generator().manual_seed(config.seed + 1))
    if config.start is not None:
        fields.read(config.start, only=config.networks)
        sdf = LearnedSDF.load(config.start, body) if "sdf" in config.networks else sdf
    fields, sdf = fields.to(device), sdf.to(device)
    fits: dict[Network, FitResult] = {}

    def train(name: Network, network: torch.nn.Module, loss_of: Callable[[torch.Generator], Tensor]) -> None:
        if name not in config.networks:
            return
        fits[name] = fit(
            list(network.parameters()),
            lambda _, generator: loss_of(generator),
            getattr(config, name),
            generator=torch.Generator().manual_seed(config.seed + 10 + ORDER.index(name)),
            checkpoint=work / f"{name}.safetensors",
            label=name,
        )

    @cache  # made at the first step that asks: a run that only finishes the SDF needs none
    def pool() -> FieldPool:
        return make_pool(body, config.pool, seed=config.seed).to(device)

    @cache
    def distances() -> DistancePool:
        return make_distance_pool(body, config.sdf_points, seed=config.seed).to(device)

    poses = random_pose_features(body, 8192, seed=config.seed).to(device)
    train("weights", fields.weight_net, lambda generator: weights_loss(fields, pool(), config.batch, generator))
    train("pose", fields.pose_net, lambda generator: pose_loss(fields, pool(), poses, config.batch, generator))
    train("shape", fields.shape_net, lambda generator: shape_loss(fields, pool(), config.batch, generator))
    train("sdf", sdf.network, lambda generator: sdf_loss(sdf, distances(), config.sdf_batch, generator))
    home = torch.device("cpu")
    trained = TrainedFields(fields.to(home), sdf.to(home), fits)
    trained.save(config.out)
    log.info("trained %s", {name: asdict(result) for name, result in fits.items()})
    return trained


# What each step minimises


def weights_loss(fields: LearnedFields, pool: FieldPool, batch: int, generator: torch.Generator) -> Tensor:
    """Mean L1 distance of W~ to Eq. 4: the figure it is judged by."""
    index = random_rows(pool.points, batch, generator)
    target = pool.layout.split(pool.rows[index].float()).weights
    return (fields.weights(pool.points[index]) - target).abs().sum(-1).mean()


def shape_loss(fields: LearnedFields, pool: FieldPool, batch: int, generator: torch.Generator) -> Tensor:
    """Distance of B~s to Eq. 5, root mean square over beta ~ N(0, I), mean over points, in units of OFFSET_UNIT."""
    index = random_rows(pool.points, batch, generator)
    target = pool.layout.split(pool.rows[index].float()).shape_directions
    error = (fields.shape_directions(pool.points[index]) - target) / OFFSET_UNIT
    return _mean_norm(error.flatten(1))


def pose_loss(
    fields: LearnedFields, pool: FieldPool, poses: Float[Tensor, "M Q"], batch: int, generator: torch.Generator
) -> Tensor:
    """Mean distance of B~p to Eq. 6 at random poses, in units of OFFSET_UNIT."""
    index = random_rows(pool.points, batch, generator)
    feature = poses[random_rows(poses, batch, generator)]
    directions = pool.layout.split(pool.rows[index].float()).pose_directions
    target = torch.einsum("np,npi->ni", feature @ fields.pose_map, directions)
    predicted = fields.pose_offsets(pool.points[index, None], feature)[:, 0]
    return _mean_norm((predicted - target) / OFFSET_UNIT)


def sdf_loss(sdf: LearnedSDF, pool: DistancePool, batch: int, generator: torch.Generator) -> Float[Tensor, ""]:
    """Mean absolute error over (30 mm + distance): garments need tenths of a millimetre, the far field millimetres."""
    index = random_rows(pool.points, batch, generator)
    truth = pool.distances[index]
    return ((sdf(pool.points[index]) - truth).abs() / (0.03 + truth.abs())).mean()


def _mean_norm(error: Float[Tensor, "N D"]) -> Float[Tensor, ""]:
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
    """Points with their exact signed distance: 10 % within 2 mm of the surface, 30 % within 20 mm, 30 % where a T-shirt
    hangs (60 mm), a fifth where a skirt does (160 mm), the rest anywhere in the box."""
    generator = np.random.default_rng(seed)
    vertices, faces = body.template.numpy(), body.faces.numpy()
    parts = [
        sample_shell(vertices, faces, int(share * count), low, high, generator)
        for share, low, high in ((0.1, -0.002, 0.002), (0.3, -0.02, 0.02), (0.3, 0.0, 0.06), (0.2, 0.0, 0.16))
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
