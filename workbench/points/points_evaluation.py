"""`workbench evaluate points`: Tab. 2, an unseen outfit against skinning, times.  models, test scans -> rows.

Test scans of outfits that the model was trained on are Tab. 2's (their motions are unseen); those of other outfits are
fitted (Eq. 7) from one scan and animated on the rest.
"""

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from workbench.body.model import Body
from workbench.evaluation_table import Row, at_least, at_most, told
from workbench.points.clothed_points import ClothedPoints, PointModel, PointModelConfig
from workbench.points.dressing import Dresser
from workbench.points.equal_time import after_equal_time
from workbench.points.evaluation import (
    CloudError,
    cloud_error,
    errors_on,
    forward_times,
    least_cpu_seconds,
    statistics,
)
from workbench.points.fit_command import model_file
from workbench.points.meshing import poisson_mesh
from workbench.points.scan_fitting import ScanFitConfig, features_of, fit_scan, lbs_of_scan
from workbench.points.scans import ScanSequence, load_scans
from workbench.points.trained_points import TrainedPatches, TrainedPoints
from workbench.points.training import (
    Batch,
    PointTrainingConfig,
    Precision,
    ScanSet,
    papers_training,
    quick_precision,
    step_loss,
)
from workbench.points.training_run import shipped_scans, training_folder
from workbench.points.uv_position_map import atlas_of, posed_queries

log = logging.getLogger(__name__)

TABLE_2 = ("Tab. 2: Chamfer, 1e-4 m^2", "Tab. 2: normals, 1e-1", "Tab. 2: point to plane, 1e-4 m^2")
FRACTIONS, QUARTER = (2, 4, 8), 4  # of the data: every n-th frame
DENSE_SIDE = 8  # points along a side of a patch when it is judged: 40,000 points in all, as POP gives


@dataclass(frozen=True)
class PointsEvaluation:
    """The figures of the points model that ships (or another), on test scans."""

    # A model (`workbench train points`); the one that ships when absent. The patches lie beside it.
    model: Path | None = None
    # A folder with test/ in it, or of test scans itself; those that ship when absent.
    data: Path | None = None
    # Of each test sequence, evenly spread; 0 is all.
    frames: int = 4
    # Also fit 10 times longer, and compare the loss (half an hour more).
    long_fit: bool = False
    # A step of the paper's training takes a minute.
    paper_step: bool = True
    # Train the published way and ours from chance for so many seconds each, and compare the loss; 0 leaves it out.
    equal_seconds: float = 0.0
    repeats: int = 3
    # Steps of a fit (Eq. 7); the default is that of `workbench fit`.
    fit_steps: int = ScanFitConfig().fit.steps
    # In which its decoder is computed; the default is that of `workbench fit`, whatever is quicker here.
    fit_precision: Precision = field(default_factory=quick_precision)
    seed: int = 0


def rows(config: PointsEvaluation) -> list[Row]:
    """One row a figure.  Raises ValueError where there are no test scans."""
    body = Body.default()
    path = model_file(config.model)
    trained = TrainedPoints.load(path, body)
    scans = [spread(scan, config.frames) for scan in load_scans(test_folder(config.data))]
    seen = [scan for scan in scans if scan.outfit in trained.outfits]
    unseen = [scan for scan in scans if scan.outfit not in trained.outfits]
    return [
        told("outfits trained on", len(trained.outfits), ""),
        told("outfits never seen", _count(unseen), ""),
        *(table_rows(trained, models_beside(path, trained, body), seen, body) if seen else _left_out("Tab. 2")),
        *(unseen_rows(trained, unseen, body, config) if unseen else _left_out("the unseen outfit")),
        *speed_rows(trained, scans, body, config),
        *meshing_rows(trained, scans, body),
        at_most("shipped", shipped_megabytes(), "MB", 40),
    ]


def test_folder(data: Path | None) -> Path:
    """DATA/test where there is one."""
    data = shipped_scans() if data is None else data
    return data / "test" if (data / "test").is_dir() else data


def spread(scan: ScanSequence, frames: int) -> ScanSequence:
    """So many frames of a sequence, evenly spread."""
    return scan.every(max(1, len(scan) // frames)) if frames else scan


@dataclass(frozen=True)
class Rivals:
    """What lies beside a model: patches and POP of each outfit alone, and POP on every 2nd, 4th, 8th frame."""

    patches: dict[str, TrainedPatches]
    fractions: dict[int, TrainedPoints]
    alone: dict[str, TrainedPoints]


def models_beside(path: Path, trained: TrainedPoints, body: Body) -> Rivals:
    """Those that were trained."""
    patches = {outfit: path.parent / f"patches-{outfit}.safetensors" for outfit in trained.outfits}
    fractions = {every: path.parent / f"pop-every{every}.safetensors" for every in FRACTIONS}
    alone = {outfit: path.parent / f"pop-{outfit}.safetensors" for outfit in trained.outfits}
    return Rivals(
        {outfit: TrainedPatches.load(file, body) for outfit, file in patches.items() if file.is_file()},
        {every: TrainedPoints.load(file, body) for every, file in fractions.items() if file.is_file()},
        {outfit: TrainedPoints.load(file, body) for outfit, file in alone.items() if file.is_file()},
    )


# Tab. 2


def table_rows(trained: TrainedPoints, rivals: Rivals, scans: Sequence[ScanSequence], body: Body) -> list[Row]:
    """All methods on the same scans of unseen motions; outfits without patches count for POP alone."""
    ours = pop_errors(trained, ScanSet.of(body, scans), body)
    found = _columns("POP", ours)
    common = [scan for scan in scans if scan.outfit in rivals.patches]
    if not common:
        return [*found, *_left_out("Tab. 2's comparison with patches")]
    theirs = patch_errors(rivals.patches, common, body)
    same = [error for error in ours if error.outfit in rivals.patches]
    found += [
        *_columns("patches", theirs),
        told("Tab. 2: training of POP", training_seconds(trained.story), "CPU-s"),
        told(
            "Tab. 2: training of the patches", sum(training_seconds(p.story) for p in rivals.patches.values()), "CPU-s"
        ),
        at_most("Tab. 2: Chamfer of POP / patches", _mean(same, 0) / _mean(theirs, 0), "", 0.85),
        at_most("Tab. 2: normals of POP / patches", _mean(same, 1) / _mean(theirs, 1), "", 1),
        told("Tab. 2: point to plane of POP / patches", _mean(same, 2) / _mean(theirs, 2), ""),
    ]
    found += alone_rows(trained, rivals.alone, scans, body)
    for every in FRACTIONS:
        if every not in rivals.fractions:
            _left_out(f"POP on 1/{every} of the data")
            continue
        fewer = pop_errors(rivals.fractions[every], ScanSet.of(body, common), body)
        ratio = _mean(fewer, 0) / _mean(theirs, 0)
        name = f"Tab. 2: Chamfer of POP on 1/{every} of the data / patches on all"
        found.append(at_most(name, ratio, "", 1) if every == QUARTER else told(name, ratio, ""))
    return found


def alone_rows(
    trained: TrainedPoints, alone: Mapping[str, TrainedPoints], scans: Sequence[ScanSequence], body: Body
) -> list[Row]:
    """POP of all outfits against one POP an outfit, where those were trained."""
    common = [scan for scan in scans if scan.outfit in alone]
    if not common:
        return _left_out("POP of one outfit each")
    ours = pop_errors(trained, ScanSet.of(body, common), body)
    theirs = [
        error
        for outfit, model in alone.items()
        for error in pop_errors(model, ScanSet.of(body, [scan for scan in common if scan.outfit == outfit]), body)
    ]
    seconds = sum(training_seconds(model.story) for model in alone.values())
    return [
        *_columns(f"POP of one outfit each ({', '.join(alone)})", theirs),
        told("Tab. 2: training of POP of one outfit each", seconds, "CPU-s"),
        told("Tab. 2: Chamfer of POP of all outfits / of one each", _mean(ours, 0) / _mean(theirs, 0), ""),
        told("Tab. 2: normals of POP of all outfits / of one each", _mean(ours, 1) / _mean(theirs, 1), ""),
    ]


def training_seconds(story: Mapping[str, Any]) -> float:
    """CPU seconds of a model's training, and of the model it began with."""
    before = story.get("start") or {}
    curves = story.get("curves") or [{"CPU seconds": 0.0}]
    return curves[-1]["CPU seconds"] + (training_seconds(before) if before else 0.0)


def pop_errors(trained: TrainedPoints, scans: ScanSet, body: Body) -> list[CloudError]:
    """POP at every pixel of the query map that shows the body."""
    with torch.no_grad():
        dressers = {
            outfit: Dresser(trained.model, trained.model.geometry(torch.tensor([trained.number_of(outfit)])), body)
            for outfit in scans.outfits
        }
    return errors_on(scans, lambda batch: dressers[scans.outfits[int(batch.outfit[0])]](batch.bodies))


def patch_errors(
    patches: dict[str, TrainedPatches], scans: Sequence[ScanSequence], body: Body, side: int = DENSE_SIDE
) -> list[CloudError]:
    """Patches at the same number of points."""
    found: list[CloudError] = []
    for outfit, of_outfit in patches.items():
        own = [scan for scan in scans if scan.outfit == outfit]
        if not own:
            continue
        model, size = of_outfit.model, of_outfit.model.config.size
        places = atlas_of(body, size).queries

        def dress(batch: Batch, model=model, places=places) -> ClothedPoints:
            return model.decode(model.encoder(batch.position_map), posed_queries(places, batch.bodies), side)

        found += errors_on(ScanSet.of(body, own, size), dress)
    return found


def _columns(method: str, errors: Sequence[CloudError]) -> list[Row]:
    found = []
    for name, value in zip(TABLE_2, _VALUES, strict=True):
        column = statistics(errors, value)
        found += [
            told(f"{name}, {method}, mean", column.mean, ""),
            told(f"{name}, {method}, outfit median", column.outfit_median, ""),
            told(f"{name}, {method}, outfit max", column.outfit_max, ""),
        ]
    return found


_VALUES = (
    lambda error: 1e4 * error.chamfer,
    lambda error: 10 * error.normal,
    lambda error: 1e4 * error.plane,
)


def _mean(errors: Sequence[CloudError], k: int) -> float:
    return statistics(errors, _VALUES[k]).mean


# The unseen outfit


def unseen_rows(
    trained: TrainedPoints, scans: Sequence[ScanSequence], body: Body, config: PointsEvaluation
) -> list[Row]:
    """Each outfit's first scan is fitted and animated through its other motions (its other frames, if it has one)."""
    fitted_errors: list[CloudError] = []
    skinned_errors: list[CloudError] = []
    made: list[Row] = []
    fitting = fit_config(config)
    for outfit in sorted({scan.outfit for scan in scans}):
        first, *others = [scan for scan in scans if scan.outfit == outfit]
        worn = ScanSet.of(body, [first]).batch([0])
        rest = ScanSet.of(body, others) if others else ScanSet.of(body, [first])
        began = time.perf_counter()
        fitted, _ = fit_scan(trained.model, body, worn.scans[0], worn.bodies, fitting, betas=first.betas)
        made.append(at_most(f"fit of {outfit}", time.perf_counter() - began, "s wall", 90))
        made.append(told(f"fit of {outfit}: loss before", fitted.loss_before, ""))
        made.append(told(f"fit of {outfit}: loss after", fitted.loss_after, ""))
        if config.long_fit:
            longer = fit_config(config, times=10)
            best, _ = fit_scan(trained.model, body, worn.scans[0], worn.bodies, longer, betas=first.betas)
            ratio = 100 * (fitted.loss_after / best.loss_after - 1)
            made.append(at_most(f"fit of {outfit}: loss above a 10 times longer fit", ratio, "%", 5))
        dresser = Dresser(trained.model, features_of(trained.model, fitted), body)
        for i in range(0 if others else 1, len(rest)):
            batch = rest.batch([i])
            cloud = dresser(batch.bodies)
            fitted_errors.append(cloud_error(cloud.points[0], cloud.normals[0], batch.scans[0], outfit))
            moved = lbs_of_scan(worn.scans[0], body, worn.bodies, batch.bodies)
            skinned_errors.append(cloud_error(moved.points, moved.normals, batch.scans[0], outfit))
    if not config.long_fit:
        log.info("left out: loss against a 10 times longer fit (--long-fit)")
    ratio = _mean(fitted_errors, 0) / _mean(skinned_errors, 0)
    return [
        *made,
        told("unseen outfit, animated: Chamfer, 1e-4 m^2", _mean(fitted_errors, 0), ""),
        told("the scan by linear blend skinning: Chamfer, 1e-4 m^2", _mean(skinned_errors, 0), ""),
        at_least("unseen outfit: Chamfer below skinning of the scan", 100 * (1 - ratio), "%", 20),
        told("unseen outfit: normals, 1e-1", _mean(fitted_errors, 1), ""),
        told("skinning: normals, 1e-1", _mean(skinned_errors, 1), ""),
    ]


def fit_config(config: PointsEvaluation, times: int = 1) -> ScanFitConfig:
    """Of `workbench fit`, with the steps that are asked for, or so many times as many."""
    usual = ScanFitConfig()
    return replace(usual, fit=replace(usual.fit, steps=times * config.fit_steps), precision=config.fit_precision)


# Times


def speed_rows(
    trained: TrainedPoints, scans: Sequence[ScanSequence], body: Body, config: PointsEvaluation
) -> list[Row]:
    """One thread, CPU seconds.  The paper-sized network has random weights, the same in both ways."""
    generator = torch.Generator().manual_seed(config.seed)
    paper = PointModel(1, PointModelConfig(), generator=generator)
    frames = ScanSet.of(body, scans)
    bodies = frames.batch([0]).bodies
    large = forward_times(paper, body, bodies, repeats=config.repeats)
    small = forward_times(trained.model, body, bodies, repeats=config.repeats)
    found = [
        told("forward, paper-sized, every pixel", large.every_pixel, "CPU-s"),
        told("forward, the same weights, fast", large.fast, "CPU-s"),
        at_least("forward: how much faster", large.ratio, "x", 8),
        at_most("forward: points apart", 1e3 * large.apart, "mm", 0.2),
        told("forward, the model itself, fast", small.fast, "CPU-s"),
        told("forward: the model itself against the paper-sized one", large.every_pixel / small.fast, "x"),
    ]
    if not config.paper_step:
        log.info("left out: a step of the paper's training (--paper-step)")
        return found
    own, papers = PointTrainingConfig(batch=4), papers_training(len(frames))
    ours = step_seconds(PointModel(_count(scans), trained.model.config, generator=generator), scans, body, own, 3)
    theirs = step_seconds(PointModel(_count(scans), PointModelConfig(), generator=generator), scans, body, papers, 1)
    return [
        *found,
        told("training step of 4 frames, paper-sized, all pixels, float32", theirs, "CPU-s"),
        told("training step of 4 frames, ours for two cores", ours, "CPU-s"),
        at_least("training step: how much faster", theirs / ours, "x", 8),
        *(equal_time_rows(body, config) if config.equal_seconds else _left_out("training for equal seconds")),
    ]


def equal_time_rows(body: Body, config: PointsEvaluation) -> list[Row]:
    """On the scans beside the test scans, or those that ship."""
    scans = load_scans(training_folder(config.data))
    theirs, ours = after_equal_time(scans, body, config.equal_seconds, config.seed)
    return [
        told("equal time: the published training", theirs.seconds, "s wall"),
        told("equal time: its steps", theirs.steps, ""),
        told("equal time: its loss (Eq. 3, published weights)", theirs.loss, ""),
        told("equal time: ours for two cores", ours.seconds, "s wall"),
        told("equal time: our steps", ours.steps, ""),
        told("equal time: our loss", ours.loss, ""),
        at_most("equal time: our loss / the published training's", ours.loss / theirs.loss, "", 1),
    ]


def step_seconds(
    model: PointModel, scans: Sequence[ScanSequence], body: Body, config: PointTrainingConfig, repeats: int
) -> float:
    """CPU seconds of a step of training, forward, backward and Adam."""
    frames = ScanSet.of(body, scans, model.config.input_size)
    places = atlas_of(body, config.query_size).queries
    optimizer = torch.optim.Adam(model.parameters(), lr=1e-4)
    generator = torch.Generator().manual_seed(config.seed)
    model.train()

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        step_loss(model, frames, places, config, config.fit.steps, generator).backward()
        optimizer.step()

    return least_cpu_seconds(step, repeats)


def meshing_rows(trained: TrainedPoints, scans: Sequence[ScanSequence], body: Body) -> list[Row]:
    """Poisson reconstruction of a predicted cloud, twice."""
    batch = ScanSet.of(body, scans[:1]).batch([0])
    with torch.no_grad():
        cloud = Dresser(trained.model, trained.model.geometry(torch.tensor([0])), body)(batch.bodies)
    points, normals = cloud.points[0].numpy(), cloud.normals[0].numpy()
    try:
        began = time.process_time()
        first = poisson_mesh(points, normals)
        seconds = time.process_time() - began
    except ImportError as error:
        log.info("left out: meshing (%s)", error)
        return []
    again = poisson_mesh(points, normals)
    same = first.vertices.shape == again.vertices.shape and np.array_equal(first.vertices, again.vertices)
    return [
        at_most(f"meshing {len(points):,} points", seconds, "CPU-s", 3),
        at_least("meshing: the same mesh again", float(same), "", 1),
    ]


def shipped_megabytes() -> float:
    """Of models and scans."""
    folders = (model_file(None).parent, shipped_scans())
    return sum(path.stat().st_size for folder in folders for path in folder.rglob("*") if path.is_file()) / 1e6


def _count(scans: Sequence[ScanSequence]) -> int:
    return len({scan.outfit for scan in scans})


def _left_out(what: str) -> list[Row]:
    log.info("left out: %s (there are no scans or models for it)", what)
    return []
