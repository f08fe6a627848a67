"""Sec. 3.3: training on scans.  scans (T,N,3) of C outfits -> encoder, decoder and G of every outfit; Eq. 3-6.

A step sees a few frames, a random subset of the pixels that show the body, and a random subset of each scan.  Ours,
where the published training decodes every pixel of the map: the loss is a mean over points, so a subset is an unbiased
look at all of its terms but the distances between cloud and scan, which are overestimated the less the more is looked
at.  The last quarter of a run looks at more.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from workbench.body.model import Body
from workbench.geometry.chamfer import match
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.learning.fit import FitConfig, FitResult, fit
from workbench.points.clothed_points import ClothedPoints
from workbench.points.losses import (
    LOOSE,
    LossTerms,
    LossWeights,
    displacement_loss,
    distance_loss,
    geometry_loss,
    normal_loss,
)
from workbench.points.scans import ScanFrame, ScanSequence, outfits_of
from workbench.points.uv_position_map import (
    INPUT_SIZE,
    QUERY_SIZE,
    Atlas,
    PosedBodies,
    PosedQueries,
    SurfaceQueries,
    atlas_of,
    builds,
    neutral_bodies,
    posed_bodies,
    posed_queries,
)

Precision = Literal["float32", "bfloat16"]


@runtime_checkable
class ClothesModel(Protocol):
    """What can be trained on scans: POP, and the patches it is compared with."""

    def __call__(
        self, position_map: Float[Tensor, "B i H W"], outfit: Int[Tensor, " B"], posed: PosedQueries
    ) -> ClothedPoints: ...

    def parameters(self) -> Iterator[nn.Parameter]: ...

    def modules(self) -> Iterator[nn.Module]: ...

    def penalised(self) -> Float[Tensor, "C c H W"]:
        """G of Eq. 6."""
        ...


@dataclass(frozen=True)
class PointTrainingConfig:
    """Ours for two cores by default; `papers_training()` is the paper's."""

    fit: FitConfig = FitConfig(
        steps=18_000, learning_rate=2e-3, last_rate=2e-5, warmup=100, clip_norm=100.0, checkpoint_every=200
    )
    weights: LossWeights = LOOSE
    batch: int = 2  # frames a step; ours, not compared with others (published: 4)
    # Pixels a frame, at most all that show the body, and points of its scan.  A sparse cloud is far from every scan
    # point, which blurs what is learned: 1,500 steps on T-shirt and dress ended, on motions kept apart, at Chamfer 2.74
    # with 5,120 and 10,240 instead of 3.16 with 2,048 and 6,144 (and 3.81 with 512 and 1,536), for 1.6 times the time
    queries: int = 4096
    scan_points: int = 8192
    dense_from: float = 0.75  # of the run, when ...
    dense: float = 2.5  # ... so many times as many are looked at
    normals_from: float = 0.3  # of the run, when the normal term joins; ours (published: 250 of 401 epochs)
    normals_before: float = 1e-6  # its weight until then, in units of lambda_n; facts.md 2
    precision: Precision = "bfloat16"  # of the networks; the losses are taken in float32
    # Radians, of each rotation vector but the root's, in the pose that the encoder sees; ours.  Some hundred frames are
    # learned by heart: 1,500 steps on T-shirt and dress with 0.08 instead of none ended, on motions kept apart, at
    # normals of 0.411 instead of 0.424, Chamfer 3.20 for 3.16, point to plane 1.33 for 1.09, and on the training's own
    # frames at Chamfer 1.85 for 1.63: less is learned by heart, and a longer training is to use that (not compared)
    pose_jitter: float = 0.05
    shape_jitter: float = 0.3  # of each component of beta, in the build that the encoder sees; ours, not compared
    query_size: int = QUERY_SIZE
    calibration: int = 16  # batches over which the means and variances of BatchNorm are taken at the end
    seed: int = 0


def papers_training(frames: int) -> PointTrainingConfig:
    """401 epochs of all pixels in float32 (facts.md 2); `frames` of the training set set the number of steps."""
    steps = 401 * max(1, math.ceil(frames / 4))
    rate = FitConfig(steps=steps, learning_rate=3e-4, last_rate=3e-4, warmup=1, clip_norm=1e9, checkpoint_every=500)
    return PointTrainingConfig(
        fit=rate,
        weights=LossWeights(),
        batch=4,
        queries=QUERY_SIZE**2,
        scan_points=40_000,
        dense=1.0,
        normals_from=250 / 401,
        precision="float32",
        pose_jitter=0.0,
        shape_jitter=0.0,
    )


@dataclass(frozen=True, eq=False)
class ScanSet:
    """The frames of many sequences, counted through, on one body model.

    Scans stay on the CPU, packed as they are stored; all else of a batch is made on `device`.
    """

    body: Body
    scans: tuple[ScanSequence, ...]
    outfits: tuple[str, ...]
    input_size: int = INPUT_SIZE
    device: torch.device = torch.device("cpu")

    @staticmethod
    def of(
        body: Body,
        scans: Sequence[ScanSequence],
        input_size: int = INPUT_SIZE,
        device: torch.device = torch.device("cpu"),
    ) -> "ScanSet":
        """Raises ValueError where there is nothing to learn from."""
        if not scans:
            raise ValueError("there are no scans to learn from; make some with `python -m assets_gen scans`")
        return ScanSet(body, tuple(scans), outfits_of(scans), input_size, device)

    @cached_property
    def places(self) -> tuple[tuple[int, int], ...]:
        """(sequence, frame) of every scan."""
        return tuple((k, t) for k, scan in enumerate(self.scans) for t in range(len(scan)))

    @cached_property
    def atlas(self) -> Atlas:
        return atlas_of(self.body, self.input_size).to(self.device)

    @cached_property
    def body_there(self) -> Body:
        return self.body.to(self.device)

    def __len__(self) -> int:
        return len(self.places)

    def batch(self, index: Sequence[int], jitter: "Jitter | None" = None) -> "Batch":
        """Frames by their number in the set; the pose encoder sees other poses and builds as `jitter` says."""
        chosen = [self.places[i] for i in index]
        sequences = [self.scans[k] for k, _ in chosen]
        rotations = torch.stack([scan.rotations[t] for scan, (_, t) in zip(sequences, chosen, strict=True)])
        betas = torch.stack([scan.betas for scan in sequences])
        bodies = posed_bodies(self.body_there, rotations.to(self.device), betas.to(self.device))
        seen = bodies
        if jitter is not None:
            turned, other = (rotations @ jitter.turns).to(self.device), (betas + jitter.betas).to(self.device)
            there = self.body_there
            seen = replace(bodies, neutral=neutral_bodies(there, turned), build=builds(there, other))
        return Batch(
            bodies=bodies,
            position_map=self.atlas.map_of(seen.seen),
            outfit=torch.tensor([self.outfits.index(scan.outfit) for scan in sequences], device=self.device),
            scans=[scan.frame(t) for scan, (_, t) in zip(sequences, chosen, strict=True)],
        )


@dataclass(frozen=True, eq=False)
class Jitter:
    """What a batch's poses and shapes, as the encoder sees them, are off."""

    turns: Float[Tensor, "B J 3 3"]
    betas: Float[Tensor, "B K"]


@dataclass(frozen=True, eq=False)
class Batch:
    """A few frames: what goes into a model and what should come out."""

    bodies: PosedBodies
    position_map: Float[Tensor, "B i H W"]
    outfit: Int[Tensor, " B"]
    scans: list[ScanFrame]


def cloud_terms(cloud: ClothedPoints, scans: Sequence[ScanFrame], G: Float[Tensor, "C c H W"]) -> LossTerms:
    """The terms of Eq. 3, a mean over the frames of a batch."""
    distance, normal = [], []
    for x, n_x, scan in zip(cloud.points, cloud.normals, scans, strict=True):
        matches = match(x, scan.points)
        distance.append(distance_loss(x, scan.points, matches))
        normal.append(normal_loss(n_x, scan.normals, matches))
    return LossTerms(
        distance=torch.stack(distance).mean(),
        normal=torch.stack(normal).mean(),
        displacement=displacement_loss(cloud.displacement),
        geometry=geometry_loss(G),
    )


def looked_at(step: int, config: PointTrainingConfig) -> PointTrainingConfig:
    """The same with as many pixels and scan points as that step looks at."""
    if step < config.dense_from * config.fit.steps:
        return config
    return replace(
        config,
        queries=round(config.dense * config.queries),
        scan_points=round(config.dense * config.scan_points),
    )


def weights_at(step: int, config: PointTrainingConfig) -> LossWeights:
    """Normals count only once the points are about where they belong (facts.md 2)."""
    w = config.weights
    early = step < config.normals_from * config.fit.steps
    return LossWeights(w.distance, w.normal * (config.normals_before if early else 1.0), w.displacement, w.geometry)


def train_points(
    model: ClothesModel,
    scans: ScanSet,
    config: PointTrainingConfig,
    *,
    queries: SurfaceQueries | None = None,
    checkpoint: Path | None = None,
    watch: Callable[[int, float], None] | None = None,
    label: str = "points",
) -> FitResult:
    """Minimise Eq. 3 over all parameters of the model, in place, then settle BatchNorm; resumes from `checkpoint`.

    The model is on the scan set's device.  `queries`: the points to draw from (default: the pixels of the query map).
    All chance comes from the config's seed.
    """
    places = (atlas_of(scans.body, config.query_size).queries if queries is None else queries).to(scans.device)

    def loss_of(step: int, generator: torch.Generator) -> Tensor:
        return step_loss(model, scans, places, config, step, generator)

    _train_mode(model, training=True)
    generator = torch.Generator().manual_seed(config.seed)
    result = fit(
        list(model.parameters()),
        loss_of,
        config.fit,
        generator=generator,
        checkpoint=checkpoint,
        label=label,
        watch=watch,
    )
    settle(model, scans, places, config)
    return result


def step_loss(
    model: ClothesModel,
    scans: ScanSet,
    places: SurfaceQueries,
    config: PointTrainingConfig,
    step: int,
    generator: torch.Generator,
) -> Float[Tensor, ""]:
    """Eq. 3 on frames, pixels and scan points drawn from `generator`."""
    batch, posed = _drawn(scans, places, looked_at(step, config), generator)
    with autocast(config.precision, scans.device):
        cloud = model(batch.position_map, batch.outfit, posed)
    return cloud_terms(cloud, batch.scans, model.penalised()).total(weights_at(step, config))


def settle(model: ClothesModel, scans: ScanSet, places: SurfaceQueries, config: PointTrainingConfig) -> None:
    """Means and variances of BatchNorm over some batches, then evaluation mode.

    Ours: training itself never reads running statistics, so taking them once at the end makes a resumed run the same
    as an uninterrupted one, and they belong to the final weights.
    """
    for module in model.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.reset_running_stats()
    generator = torch.Generator().manual_seed(config.seed + 1)
    _train_mode(model, training=True)
    with torch.no_grad():
        for _ in range(config.calibration):
            batch, posed = _drawn(scans, places, looked_at(config.fit.steps, config), generator)
            model(batch.position_map, batch.outfit, posed)
    _train_mode(model, training=False)


def autocast(precision: Precision, device: torch.device) -> torch.autocast:
    """Networks in half precision where asked for."""
    return torch.autocast(device.type, dtype=torch.bfloat16, enabled=precision == "bfloat16")


def quick_precision() -> Precision:
    """bfloat16 where the processor computes in it; elsewhere it is emulated, and float32 is quicker."""
    known = getattr(torch.cpu, "_is_avx512_bf16_supported", None)  # torch has no public call that tells
    return "bfloat16" if known is not None and known() else "float32"


def _drawn(
    scans: ScanSet, places: SurfaceQueries, config: PointTrainingConfig, generator: torch.Generator
) -> tuple[Batch, PosedQueries]:
    index = torch.randint(len(scans), (config.batch,), generator=generator).tolist()
    batch = scans.batch(index, _jitter(scans, config, generator))
    asked = places
    if config.queries < len(places):
        index = torch.randperm(len(places), generator=generator)[: config.queries]
        asked = places.subset(index.to(scans.device))
    thinned = [thin(scan, config.scan_points, generator).to(scans.device) for scan in batch.scans]
    return Batch(batch.bodies, batch.position_map, batch.outfit, thinned), posed_queries(asked, batch.bodies)


def _jitter(scans: ScanSet, config: PointTrainingConfig, generator: torch.Generator) -> Jitter | None:
    if not (config.pose_jitter or config.shape_jitter):
        return None
    vectors = config.pose_jitter * torch.randn(config.batch, len(scans.body.parents), 3, generator=generator)
    vectors[:, 0] = 0.0
    betas = config.shape_jitter * torch.randn(config.batch, scans.body.shape_count, generator=generator)
    return Jitter(axis_angle_to_matrix(vectors), betas)


def thin(scan: ScanFrame, count: int, generator: torch.Generator) -> ScanFrame:
    """A random subset of a scan (all of it where it has no more points)."""
    if count >= len(scan.points):
        return scan
    index = torch.randperm(len(scan.points), generator=generator)[:count]
    return ScanFrame(scan.points[index], scan.normals[index])


def _train_mode(model: ClothesModel, *, training: bool) -> None:
    for module in model.modules():
        module.training = training
