"""`workbench evaluate fields`: Eq. 4-6 and the SDF of Eq. 12, three implementations each.  body -> rows of figures."""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from workbench.body.model import Body
from workbench.body_evaluation import body_rows
from workbench.collisions.body_sdf import BodySDF, ExactSDF, GridSDF, LearnedSDF
from workbench.collisions.diffused_body import (
    BOX_MARGIN,
    DiffusedFields,
    FieldValues,
    GridFields,
    LearnedFields,
    MonteCarloFields,
    Rigging,
)
from workbench.collisions.field_training import random_pose_features
from workbench.evaluation_table import Row, at_least, at_most, told
from workbench.garments import Garment
from workbench.geometry.sampling import sample_box, sample_surface

MILLI = 1e3
PERCENT = 100.0
# facts.md 1: the networks published with the paper
PUBLISHED_WEIGHTS = 0.044  # L1 at the T-shirt
PUBLISHED_SDF = {"tshirt": 0.25, "dress": 0.32}  # mm


@dataclass(frozen=True)
class FieldEvaluation:
    """Accuracy of the diffused body and the body SDF against their definitions, and the time of a lookup."""

    networks: Path | None = None  # folder of trained networks (`workbench train fields`); default: those that ship
    samples: int = 4096  # of the reference, quasi-random, from another seed than any table or network
    garment_points: int = 2400  # of each template: every second or third vertex (the reference takes 10 ms a point)
    points: int = 1000  # a region
    surface_points: int = 40_000  # for the SDF
    repeats: int = 41  # timings: the median is told
    seed: int = 1


@dataclass(frozen=True)
class FieldErrors:
    """Distance to the reference, a number a point: W~ in L1; B~s, B~p root mean square over beta and poses, metres."""

    weights: Float[Tensor, "N"]
    shape: Float[Tensor, "N"]
    pose: Float[Tensor, "N"]


def rows(config: FieldEvaluation) -> list[Row]:
    """Everything, in one run, on one thread (the timings compare like with like)."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            return _rows(config)
    finally:
        torch.set_num_threads(threads)


def _rows(config: FieldEvaluation) -> list[Row]:
    body = Body.default()
    grid, grid_sdf = GridFields.default(), GridSDF.default()
    learned = LearnedFields.load(config.networks, body) if config.networks else LearnedFields.default(body)
    learned_sdf = LearnedSDF.load(config.networks, body) if config.networks else LearnedSDF.default(body)
    templates = {name: Garment.load(name).vertices for name in ("tshirt", "dress")}
    table = body_rows(body)
    for name, points in templates.items():
        table += template_rows(name, _spread(points, config.garment_points), body, learned, grid, config)
    for region, points in regions(body, config.points, np.random.default_rng(config.seed)).items():
        table += region_rows(region, points, body, learned, grid, config)
    table += timing_rows(templates["tshirt"], body, learned, grid, config)
    exact = ExactSDF(body)
    for name, points in templates.items():
        truth = exact(points)
        tabulated = MILLI * _mean_error(grid_sdf, points, truth)
        table.append(at_most(f"SDF at the {name}: tabulated, mean", tabulated, "mm", 0.20))
        error = MILLI * _mean_error(learned_sdf, points, truth)
        table.append(at_most(f"SDF at the {name}: learned, mean", error, "mm", PUBLISHED_SDF[name]))
    table += surface_rows(body, exact, grid_sdf, config)
    table += learned_surface_rows(body, exact, learned_sdf, config)
    table += sdf_timing_rows(templates["tshirt"], exact, learned_sdf, grid_sdf, config)
    return table


# The fields


def template_rows(
    name: str,
    points: Float[Tensor, "N 3"],
    body: Body,
    learned: LearnedFields,
    grid: GridFields,
    config: FieldEvaluation,
) -> list[Row]:
    """W~, B~s and B~p where a garment is, beside plain Monte Carlo as facts.md 1 gives it."""
    truth = reference(body, config).at(points)
    of_net, of_grid = field_errors([learned, grid], truth, points, body, config)
    table = [
        at_most(f"W~ at the {name}, L1: networks, mean", float(of_net.weights.mean()), "", 0.030),
        at_most(f"W~ at the {name}, L1: grid, mean", float(of_grid.weights.mean()), "", 0.010),
        told(f"W~ at the {name}, L1: networks, p99", _p99(of_net.weights), ""),
        at_most(f"W~ at the {name}, L1: grid, p99 (no worse)", _p99(of_grid.weights), "", _p99(of_net.weights)),
        told(f"W~ at the {name}, L1: networks, max", float(of_net.weights.max()), ""),
        at_most(
            f"W~ at the {name}, L1: grid, max (no worse)", float(of_grid.weights.max()), "", float(of_net.weights.max())
        ),
        told(f"W~ at the {name}, L1: published network", PUBLISHED_WEIGHTS, ""),
    ]
    for samples in (50, 200, 1000):
        plain = MonteCarloFields(body, samples=samples, seed=config.seed, quasi=False).weights(points)
        table.append(told(f"W~ at the {name}, L1: plain Monte Carlo, N = {samples}", _l1(plain, truth.weights), ""))
    table += _offset_rows(f"at the {name}", of_net, of_grid)
    return table


def region_rows(
    region: str,
    points: Float[Tensor, "N 3"],
    body: Body,
    learned: LearnedFields,
    grid: GridFields,
    config: FieldEvaluation,
) -> list[Row]:
    """How far the three agree in a region of space within 0.5 m of the body.  Bounds are ours: measured, rounded up."""
    truth = reference(body, config).at(points)
    of_net, of_grid = field_errors([learned, grid], truth, points, body, config)
    return [
        at_most(f"W~ {region}, L1: networks, mean", float(of_net.weights.mean()), "", 0.10),
        at_most(f"W~ {region}, L1: grid, mean", float(of_grid.weights.mean()), "", 0.05),
        told(f"W~ {region}, L1: networks, max", float(of_net.weights.max()), ""),
        at_most(f"W~ {region}, L1: grid, max", float(of_grid.weights.max()), "", 0.25),
        *_offset_rows(region, of_net, of_grid),
    ]


def _offset_rows(where: str, of_net: FieldErrors, of_grid: FieldErrors) -> list[Row]:
    return [
        told(f"B~s {where}, rms over beta: networks", MILLI * float(of_net.shape.mean()), "mm"),
        at_most(f"B~s {where}, rms over beta: grid", MILLI * float(of_grid.shape.mean()), "mm", 1.0),
        told(f"B~p {where}, rms over poses: networks", MILLI * float(of_net.pose.mean()), "mm"),
        at_most(f"B~p {where}, rms over poses: grid", MILLI * float(of_grid.pose.mean()), "mm", 1.0),
    ]


def reference(body: Body, config: FieldEvaluation) -> MonteCarloFields:
    """The definition with many samples, quasi-random: its own error is 0.0003 in L1."""
    return MonteCarloFields(body, samples=config.samples, seed=config.seed + 100)


def field_errors(
    judged: list[DiffusedFields],
    truth: FieldValues,
    points: Float[Tensor, "N 3"],
    body: Body,
    config: FieldEvaluation,
    *,
    probes: int = 16,
) -> list[FieldErrors]:
    """Point by point: W~ in L1; B~s and B~p root mean square over `probes` shapes beta ~ N(0, I) and as many poses."""
    generator = torch.Generator().manual_seed(config.seed)
    betas = torch.randn(probes, body.shape_count, generator=generator)
    coefficients = random_pose_features(body, probes, seed=config.seed) @ body.pose_map
    shape = torch.einsum("bk,nki->bni", betas, truth.shape_directions)
    pose = torch.einsum("bp,npi->bni", coefficients, truth.pose_directions)
    errors = []
    for fields in judged:
        shaped = torch.stack([fields.shape_offsets(points, beta) for beta in betas])
        posed = torch.stack([fields.pose_offsets(points, c @ _lift(body)) for c in coefficients])
        errors.append(
            FieldErrors(
                (fields.weights(points) - truth.weights).abs().sum(-1),
                _rms(shaped - shape),
                _rms(posed - pose),
            )
        )
    return errors


def _spread(points: Float[Tensor, "N 3"], most: int) -> Float[Tensor, "_ 3"]:
    """Every k-th of the points, at most so many."""
    return points[:: -(-len(points) // most)]


def _lift(body: Body) -> Float[Tensor, "P Q"]:
    """The least pose feature with given coefficients: features are only seen through pose_map."""
    return torch.linalg.pinv(body.pose_map)


def regions(body: Body, count: int, generator: np.random.Generator) -> dict[str, Float[Tensor, "N 3"]]:
    """Points outside of the body and within 0.5 m of it: in the armpits, at the crotch, between the legs, anywhere.

    The places are boxes set by the joints (metres): below each shoulder joint; below the hip joints; between the knees.
    """
    joint = {name: body.joint_template[body.joint_names.index(name)].numpy() for name in body.joint_names}
    exact = ExactSDF(body)

    def outside(draw: Callable[[int], np.ndarray]) -> Float[Tensor, "N 3"]:
        kept: list[Tensor] = []
        while sum(map(len, kept)) < count:
            points = torch.from_numpy(draw(2 * count))
            distance = exact(points)
            kept.append(points[(distance > 0) & (distance < BOX_MARGIN)])
        return torch.cat(kept)[:count]

    def box(low: list[float], high: list[float]) -> Callable[[int], np.ndarray]:
        return lambda n: sample_box(np.array(low), np.array(high), n, generator)

    def armpits(n: int) -> Float[np.ndarray, "N 3"]:
        x, y, z = joint["LeftArm"]
        points = sample_box(
            np.array([x - 0.08, y - 0.1, z - 0.22]), np.array([x + 0.1, y + 0.1, z - 0.02]), n, generator
        )
        points[::2, 0] *= -1  # the body is symmetric to a millimetre
        return points

    hip, knee, foot = joint["LeftUpLeg"], joint["LeftLeg"], joint["LeftFoot"]
    vertices = body.template.numpy()
    return {
        "in the armpits": outside(armpits),
        "at the crotch": outside(box([-0.1, hip[1] - 0.12, hip[2] - 0.2], [0.1, hip[1] + 0.12, hip[2] - 0.02])),
        "between the legs": outside(box([-knee[0], knee[1] - 0.08, foot[2]], [knee[0], knee[1] + 0.08, hip[2] - 0.2])),
        "within 0.5 m": outside(
            lambda n: sample_box(vertices.min(0) - BOX_MARGIN, vertices.max(0) + BOX_MARGIN, n, generator)
        ),
    }


def timing_rows(
    points: Float[Tensor, "N 3"], body: Body, learned: LearnedFields, grid: GridFields, config: FieldEvaluation
) -> list[Row]:
    """All three fields at a garment's vertices for one shape and pose, on one thread, the two taking turns."""
    betas, coefficients = torch.ones(body.shape_count), torch.full((len(body.pose_directions),), 0.1)

    def rig(fields: DiffusedFields) -> Callable[[], Rigging]:
        return lambda: fields.rigging(points, betas, coefficients)

    by_net, by_grid, lookup = median_times([rig(learned), rig(grid), lambda: grid.at(points)], config.repeats)
    definition = MonteCarloFields(body, samples=200, seed=config.seed)
    by_definition = median_times([rig(definition)], 3)[0]
    count = f"{len(points):,} points"
    return [
        told(f"W~, B~s, B~p at {count}, one thread: the paper's networks", MILLI * by_net, "ms"),
        told(f"W~, B~s, B~p at {count}, one thread: grid, all {grid.layout.channels} channels", MILLI * lookup, "ms"),
        told(f"W~, B~s, B~p at {count}, one thread: grid, for one beta and theta", MILLI * by_grid, "ms"),
        told(f"W~, B~s, B~p at {count}, one thread: Monte Carlo, N = 200", MILLI * by_definition, "ms"),
        at_least("grid faster than the networks", by_net / lookup, "x", 50),
    ]


def median_times(calls: list[Callable[[], object]], repeats: int) -> list[float]:
    """Median seconds of each call, all taking turns so that a busy machine slows all alike."""
    times: list[list[float]] = [[] for _ in calls]
    for repeat in range(repeats + 1):
        for call, record in zip(calls, times, strict=True):
            start = time.perf_counter()
            call()
            if repeat:  # the first one warms up
                record.append(time.perf_counter() - start)
    return [statistics.median(record) for record in times]


# The signed distance


@dataclass(frozen=True)
class SurfaceProbe:
    """Points on the surface, moved off it along the normal, and in the box; with their exact distances."""

    surface: Float[Tensor, "N 3"]
    slender: Bool[Tensor, "N"]  # on hands and feet
    moved: dict[float, tuple[Float[Tensor, "_ 3"], Float[Tensor, "_"]]]  # by millimetres off the surface
    box: tuple[Float[Tensor, "M 3"], Float[Tensor, "M"]]


def surface_probe(body: Body, exact: ExactSDF, config: FieldEvaluation) -> SurfaceProbe:
    """Where the SDFs are judged; the same points for each of them."""
    generator = np.random.default_rng(config.seed)
    vertices, faces = body.template.numpy(), body.faces.numpy()
    samples = sample_surface(vertices, faces, config.surface_points, generator)
    surface = torch.from_numpy(samples.point)
    slender = hands_and_feet(body)[body.faces[torch.from_numpy(samples.face)]].any(1)
    moved = {}
    for offset in (1.0, -1.0, 5.0, -5.0):
        points = surface + torch.from_numpy(samples.normal) * (offset / MILLI)
        truth = exact(points)
        # where the surface folds, a point moved off one side is nearer to another: those are not at this distance
        there = (truth * MILLI / offset > 0.9).nonzero()[:, 0]
        moved[offset] = (points[there], truth[there])
    box = torch.from_numpy(
        sample_box(vertices.min(0) - BOX_MARGIN, vertices.max(0) + BOX_MARGIN, config.surface_points, generator)
    )
    return SurfaceProbe(surface, slender, moved, (box, exact(box)))


def surface_rows(body: Body, exact: ExactSDF, grid: GridSDF, config: FieldEvaluation) -> list[Row]:
    """The table on the surface, a little off it, and in the whole box."""
    probe = surface_probe(body, exact, config)
    found = grid(probe.surface).abs()
    table = [
        told("SDF on the surface: tabulated, mean", MILLI * float(found.mean()), "mm"),
        at_most("SDF on the surface: tabulated, max", MILLI * float(found[~probe.slender].max()), "mm", 3.0),
        at_most("SDF on hands and feet: tabulated, max", MILLI * float(found[probe.slender].max()), "mm", 6.0),
    ]
    for offset, bound in ((1.0, 1.0), (-1.0, 1.0), (5.0, 0.0), (-5.0, 0.0)):
        wrong = _share_wrong(grid, *probe.moved[offset])
        table.append(at_most(f"sign wrong {_side(offset)}: tabulated", wrong, "%", bound))
    far = MILLI * _mean_error(grid, *probe.box)
    return [*table, at_most("SDF in the box of 0.5 m around: tabulated, mean", far, "mm", 2.0)]


def learned_surface_rows(body: Body, exact: ExactSDF, learned: LearnedSDF, config: FieldEvaluation) -> list[Row]:
    """The network in the same places; its bounds are the published network's (facts.md 1)."""
    probe = surface_probe(body, exact, config)
    found = learned(probe.surface).abs()
    table = [
        at_most("SDF on the surface: learned, mean", MILLI * float(found.mean()), "mm", 1.0),
        at_most("SDF on the surface: learned, p95", MILLI * float(found.quantile(0.95)), "mm", 3.5),
        at_most("SDF on the surface: learned, max", MILLI * float(found.max()), "mm", 7.5),
    ]
    for offset, bound in ((1.0, 8.4), (-5.0, 11.8)):
        wrong = _share_wrong(learned, *probe.moved[offset])
        table.append(at_most(f"sign wrong {_side(offset)}: learned", wrong, "%", bound))
    far = MILLI * _mean_error(learned, *probe.box)
    return [*table, at_most("SDF in the box of 0.5 m around: learned, mean", far, "mm", 179.0)]


def _side(offset: float) -> str:
    return f"{abs(offset):g} mm {'outside' if offset > 0 else 'inside'}"


def sdf_timing_rows(
    points: Float[Tensor, "N 3"], exact: ExactSDF, learned: LearnedSDF, grid: GridSDF, config: FieldEvaluation
) -> list[Row]:
    """One evaluation at a garment's vertices, one thread."""
    sdfs: dict[str, BodySDF] = {"exact": exact, "tabulated": grid, "learned": learned}
    calls: list[Callable[[], object]] = [partial(sdf, points) for sdf in sdfs.values()]
    return [
        told(f"SDF at {len(points):,} points, one thread: {name}", MILLI * seconds, "ms")
        for name, seconds in zip(sdfs, median_times(calls, max(3, config.repeats // 4)), strict=True)
    ]


def hands_and_feet(body: Body) -> Bool[Tensor, "V"]:
    """Vertices whose strongest joint is of a hand or a foot."""
    words = ("Hand", "Finger", "Thumb", "Foot", "Toe", "hand", "foot", "ankle")
    slender = torch.tensor([any(word in name for word in words) for name in body.joint_names])
    return slender[body.weights.argmax(1)]


def _mean_error(sdf: BodySDF, points: Float[Tensor, "N 3"], truth: Float[Tensor, "N"]) -> float:
    return float((sdf(points) - truth).abs().mean())


def _share_wrong(sdf: BodySDF, points: Float[Tensor, "N 3"], truth: Float[Tensor, "N"]) -> float:
    return PERCENT * float(((sdf(points) > 0) != (truth > 0)).float().mean())


def _l1(a: Float[Tensor, "N J"], b: Float[Tensor, "N J"]) -> float:
    return float((a - b).abs().sum(-1).mean())


def _p99(values: Float[Tensor, "N"]) -> float:
    return float(values.quantile(0.99))


def _rms(offsets: Float[Tensor, "B N 3"]) -> Float[Tensor, "N"]:
    """Root mean square over the leading axis of the vectors' lengths."""
    return offsets.square().sum(-1).mean(0).sqrt()
