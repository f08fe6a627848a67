"""Sec. 3.3's training against ours for two cores, both from chance for the same seconds.  scans -> Eq. 3 of each.

Judged alike, the published way: all pixels, all points of the scans, the published weights.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from workbench.body.model import Body
from workbench.points.clothed_points import PointModel, PointModelConfig
from workbench.points.losses import LossWeights
from workbench.points.scans import ScanSequence
from workbench.points.training import (
    Batch,
    PointTrainingConfig,
    ScanSet,
    cloud_terms,
    papers_training,
    step_loss,
    train_points,
)
from workbench.points.training_run import TWO_CORES
from workbench.points.uv_position_map import QUERY_SIZE, atlas_of, posed_queries

JUDGED = 6  # scans, evenly spread over those of the training
TRIED = 3  # steps from which the seconds of one are told
CALIBRATION = 2  # batches for BatchNorm; a paper-sized one takes half a minute


@dataclass(frozen=True)
class Trained:
    """What a way of training came to."""

    steps: int
    seconds: float  # wall, of the steps and BatchNorm's pass after them
    loss: float  # Eq. 3 on training scans


def after_equal_time(scans: Sequence[ScanSequence], body: Body, seconds: float, seed: int) -> tuple[Trained, Trained]:
    """(the published sizes and settings, ours) after as many steps as fit into `seconds`, one at least."""
    frames = sum(len(scan) for scan in scans)
    published = replace(papers_training(frames), calibration=CALIBRATION, seed=seed)
    ours = replace(PointTrainingConfig(), calibration=CALIBRATION, seed=seed)
    return (
        trained_for(seconds, scans, body, PointModelConfig(), published),
        trained_for(seconds, scans, body, TWO_CORES, ours),
    )


def trained_for(
    seconds: float, scans: Sequence[ScanSequence], body: Body, sizes: PointModelConfig, config: PointTrainingConfig
) -> Trained:
    """Train from chance: a schedule of as many steps as the seconds hold."""
    frames = ScanSet.of(body, scans, sizes.input_size)
    steps = max(1, round(seconds / _seconds_a_step(frames, body, sizes, config)))
    model = PointModel(len(frames.outfits), sizes, generator=torch.Generator().manual_seed(config.seed))
    began = time.perf_counter()
    train_points(model, frames, replace(config, fit=replace(config.fit, steps=steps)), label=f"{steps} steps")
    return Trained(steps, time.perf_counter() - began, judged(model, frames, body))


@torch.no_grad()
def judged(model: PointModel, frames: ScanSet, body: Body) -> float:
    """Eq. 3 of a model in evaluation mode, on every pixel and every scan point of some frames."""
    places, found = atlas_of(body, QUERY_SIZE).queries, []
    for i in torch.linspace(0, len(frames) - 1, min(JUDGED, len(frames))).round().int().tolist():
        batch: Batch = frames.batch([i])
        cloud = model(batch.position_map, batch.outfit, posed_queries(places, batch.bodies))
        found.append(cloud_terms(cloud, batch.scans, model.penalised()).total(LossWeights()).item())
    return sum(found) / len(found)


def _seconds_a_step(frames: ScanSet, body: Body, sizes: PointModelConfig, config: PointTrainingConfig) -> float:
    """Forward and backward of a model that is thrown away; the fastest of some."""
    model = PointModel(len(frames.outfits), sizes, generator=torch.Generator().manual_seed(config.seed)).train()
    places, generator = atlas_of(body, config.query_size).queries, torch.Generator().manual_seed(config.seed)
    times = []
    for _ in range(TRIED):
        began = time.perf_counter()
        step_loss(model, frames, places, config, config.fit.steps, generator).backward()
        times.append(time.perf_counter() - began)
    return min(times)
