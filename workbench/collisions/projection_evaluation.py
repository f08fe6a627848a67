"""`workbench evaluate projection`: Fig. 3 in figures.  simulated sequences, motions -> rows."""

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.body_sdf import BodySDF, GridSDF
from workbench.collisions.diffused_body import GridFields, MonteCarloFields
from workbench.collisions.garment_model import BodyState, GarmentModel
from workbench.collisions.penetration import penetration
from workbench.collisions.projection import Projection, ProjectionConfig, ProjectionJob, Projector, project_all
from workbench.collisions.projection_baselines import constant_weights, nearest_weights
from workbench.collisions.sequences import SimulatedSequence, shipped_sequences
from workbench.collisions.unprojection_floor import REGIONS, Floor, static_template_floor, with_arms_spread
from workbench.evaluation_table import Row, at_least, at_most, told
from workbench.formats import load_motion, motion_files
from workbench.garments import Garment
from workbench.geometry.strain import rest_triangles
from workbench.geometry.winding import InsideTest
from workbench.motion import Motion

CORES = 2  # what the bound on speed is for
MILLI = 1e3
PERCENT = 100.0
FLOOR_SAMPLES = 256
SURELY_OUTSIDE = 0.01  # metres: the tabulated distance errs by 6 mm at most (`workbench evaluate fields`)
SPREAD = 15.0  # degrees: what the published preprocessing does to every motion


@dataclass(frozen=True)
class ProjectionEvaluation:
    """Projection of simulated sequences, its two baselines, what each term buys, and the floor of unprojection."""

    sequences: Path | None = None  # folder of simulated sequences (.npz); default: those that ship
    motions: Path | None = None  # folder of motion files for the floor; default: those that ship
    ablation_frames: int = 30  # of each sequence, from its beginning
    floor_motions: int = 6  # about so many of the motions, spread evenly
    floor_shapes: int = 2  # random shapes, each with every motion
    floor_frames: int = 60  # of each motion, from its beginning
    floor_every: int = 4  # frames: one in so many is posed and counted
    seed: int = 0
    projection: ProjectionConfig = ProjectionConfig()


@dataclass(frozen=True)
class Canonical:
    """One way of unposing, over all kept frames of all sequences."""

    inside: float  # share of vertices inside the canonical body where the simulation is clean
    jitter: float  # mean |X[t+1] - 2 X[t] + X[t-1]|, metres
    error: Float[Tensor, "R"]  # re-posing error of every vertex, metres


def rows(config: ProjectionEvaluation) -> list[Row]:
    """Everything, in one run."""
    body, fields, sdf = Body.default(), GridFields.default(), GridSDF.default()
    model = GarmentModel(body, fields)
    sequences = list(_sequences(config))
    table: list[Row] = []
    table += projection_rows(model, sdf, sequences, config)
    table += floor_rows(model, config)
    return table


def projection_rows(
    model: GarmentModel, sdf: GridSDF, sequences: list[SimulatedSequence], config: ProjectionEvaluation
) -> list[Row]:
    """Ours against both baselines of Fig. 3, speed, and what each step and term buys."""
    runs = [_Run.of(model, sdf, sequence, config.projection) for sequence in sequences]
    frames = sum(len(run.garment) for run in runs)
    start, busy = time.perf_counter(), time.process_time()
    ours = project_all([ProjectionJob(run.projector, run.garment, run.state) for run in runs], CORES)
    elapsed, busy = time.perf_counter() - start, time.process_time() - busy
    full = _measure(runs, [p.canonical for p in ours])
    constant = _measure(runs, [constant_weights(model.body, r.template, r.garment, r.state) for r in runs])
    nearest = _measure(runs, [nearest_weights(model.body, r.garment, r.state, r.bodies) for r in runs])
    table = [
        told("simulated frames projected", frames, "frames"),
        at_most("re-posing error, mean", MILLI * float(full.error.mean()), "mm", 0.1),
        at_most("re-posing error, p99", MILLI * float(full.error.quantile(0.99)), "mm", 1.0),
        told("re-posing error, max", MILLI * float(full.error.max()), "mm"),
        at_most("canonical vertices inside, clean simulation", PERCENT * full.inside, "%", 0.0),
        told("baseline: constant weights, inside", PERCENT * constant.inside, "%"),
        told("baseline: nearest weights, inside", PERCENT * nearest.inside, "%"),
        _fewer(
            "fewer inside than both baselines (best baseline - ours)", PERCENT, full.inside, constant, nearest, "inside"
        ),
        told("jitter (mean second difference), ours", MILLI * full.jitter, "mm"),
        told("baseline: constant weights, jitter", MILLI * constant.jitter, "mm"),
        told("baseline: nearest weights, jitter", MILLI * nearest.jitter, "mm"),
        _fewer(
            "less jitter than both baselines (best baseline - ours)", MILLI, full.jitter, constant, nearest, "jitter"
        ),
        told("baseline: constant weights, re-posing error mean", MILLI * float(constant.error.mean()), "mm"),
        told("baseline: nearest weights, re-posing error mean", MILLI * float(nearest.error.mean()), "mm"),
        at_least(f"speed on {CORES} cores, by the clock (idle machine needed)", frames / elapsed, "frames/s", 30.0),
        told("speed, by the time of one core", frames / busy, "frames/s"),
    ]
    moved = torch.cat([p.mended.flatten() for p in ours]).float().mean()
    table.append(told("vertices that Eq. 9's optimisation moved", PERCENT * float(moved), "%"))
    return table + ablation_rows([run.beginning(config.ablation_frames) for run in runs], config.projection)


def ablation_rows(runs: list["_Run"], config: ProjectionConfig) -> list[Row]:
    """What unskinning leaves, and what the data, strain and collision terms of Eq. 9 then buy."""
    unskinned = [run.projector.unskin(run.garment, run.state) for run in runs]
    variants: dict[str, Callable[[ProjectionConfig], ProjectionConfig]] = {
        "Eq. 10 alone": lambda c: replace(c, strain_weight=0.0, collision_weight=0.0),
        "Eq. 10 + 11 (no collision term)": lambda c: replace(c, collision_weight=0.0),
        "Eq. 10 + 12 (no strain term)": lambda c: replace(c, strain_weight=0.0),
        "all of Eq. 9": lambda c: c,
    }
    table = _variant_rows("unskinning only", runs, unskinned)
    for name, change in variants.items():
        mended = [
            replace(run.projector, config=change(config)).mend(run.garment, run.state, start)
            for run, start in zip(runs, unskinned, strict=True)
        ]
        table += _variant_rows(name, runs, mended)
    return table


def _variant_rows(name: str, runs: list["_Run"], projections: list[Projection]) -> list[Row]:
    measured = _measure(runs, [p.canonical for p in projections])
    return [
        told(f"{name}: error p99.9", MILLI * float(measured.error.quantile(0.999)), "mm"),
        told(f"{name}: error max", MILLI * float(measured.error.max()), "mm"),
        told(f"{name}: inside", PERCENT * measured.inside, "%"),
        told(f"{name}: jitter", MILLI * measured.jitter, "mm"),
    ]


def _fewer(metric: str, scale: float, ours: float, constant: Canonical, nearest: Canonical, figure: str) -> Row:
    gap = scale * (min(getattr(constant, figure), getattr(nearest, figure)) - ours)
    return Row(metric, gap, "%" if scale == PERCENT else "mm", "> 0", gap > 0)


@dataclass(frozen=True)
class _Run:
    """A sequence made ready: kept frames, body states, posed bodies, the projector of its garment."""

    projector: Projector
    template: Float[Tensor, "N 3"]
    garment: Float[Tensor, "T N 3"]
    state: BodyState
    bodies: Float[Tensor, "T V 3"]
    clean: Bool[Tensor, "T N"]  # vertices that the simulation keeps outside the body

    @staticmethod
    def of(model: GarmentModel, sdf: GridSDF, sequence: SimulatedSequence, config: ProjectionConfig) -> "_Run":
        garment = Garment.load(sequence.garment_name)
        kept = sequence.valid
        positions = sequence.garment[kept]
        state = model.state(sequence.rotations[kept], sequence.betas, sequence.translation[kept])
        bodies = model.body.vertices(sequence.rotations[kept], sequence.betas, sequence.translation[kept])
        projector = Projector(
            model, sdf, rest_triangles(garment.rest_vertices, garment.faces), garment.vertices, config
        )
        clean = ~penetration(bodies, model.body.faces, positions).inside
        return _Run(projector, garment.vertices, positions, state, bodies, clean)

    def beginning(self, frames: int) -> "_Run":
        """The first frames alone."""
        part = slice(0, frames)
        return replace(
            self,
            garment=self.garment[part],
            state=self.state[part],
            bodies=self.bodies[part],
            clean=self.clean[part],
        )


@torch.no_grad()
def _measure(runs: list[_Run], canonical: list[Float[Tensor, "T N 3"]]) -> Canonical:
    body = runs[0].projector.model.body
    test = InsideTest(body.template.numpy(), body.faces.numpy())
    inside, clean, jitter, error = 0, 0, [], []
    for run, X in zip(runs, canonical, strict=True):
        model = run.projector.model
        inside += int((inside_canonical(X, test, run.projector.sdf) & run.clean).sum())
        clean += int(run.clean.sum())
        jitter.append((X[2:] - 2 * X[1:-1] + X[:-2]).norm(dim=-1).flatten())
        error += [
            (model.posed(X[frame], run.state[frame]) - target).norm(dim=-1) for frame, target in enumerate(run.garment)
        ]
    return Canonical(inside / clean, float(torch.cat(jitter).mean()), _sample(torch.cat(error)))


def inside_canonical(X: Float[Tensor, "T N 3"], test: InsideTest, sdf: BodySDF) -> Bool[Tensor, "T N"]:
    """Exact inside test of canonical vertices; the table of distances settles those farther off than it can err."""
    inside = torch.zeros(X.shape[:-1], dtype=torch.bool)
    frame, vertex = (sdf(X) < SURELY_OUTSIDE).nonzero(as_tuple=True)
    inside[frame, vertex] = torch.from_numpy(test(X[frame, vertex].numpy()))
    return inside


def _sample(values: Float[Tensor, "R"], most: int = 10_000_000) -> Float[Tensor, "R"]:
    """torch.quantile takes at most 16 million values: every k-th of a longer list."""
    return values[:: 1 + len(values) // most]


def floor_rows(model: GarmentModel, config: ProjectionEvaluation) -> list[Row]:
    """facts.md 9: the static T-shirt through motions, raw, spread and cleared; by region; by skinning."""
    generator = torch.Generator().manual_seed(config.seed)
    betas = torch.randn(config.floor_shapes, model.body.shape_count, generator=generator).clamp(-2.5, 2.5)
    motions = [_beginning(motion.resampled(30.0), config.floor_frames) for motion in _motions(config, model.body)]
    template = Garment.load("tshirt").vertices
    raw = [(motion, shape) for motion in motions for shape in betas]
    spread = [(with_arms_spread(motion, torch.pi / 180 * SPREAD), shape) for motion, shape in raw]
    cleared = [(motion.cleared(model.body, betas=shape), shape) for motion, shape in raw]
    cases = {"raw": raw, f"arms spread {SPREAD:.0f} degrees": spread, "cleared": cleared}
    thin = {name: [(_thinned(m, config.floor_every), shape) for m, shape in case] for name, case in cases.items()}
    table = [told("floor: frames posed", sum(len(motion) for motion, _ in thin["raw"]), "frames")]
    for name, case in thin.items():
        table += _floor_table(name, static_template_floor(model, template, case))
    dual = static_template_floor(model, template, thin["cleared"], skinning="dual_quaternion")
    reference = GarmentModel(model.body, MonteCarloFields(model.body, samples=FLOOR_SAMPLES))
    exact = static_template_floor(reference, template, thin["cleared"])
    return [
        *table,
        *_floor_table("cleared, dual quaternions", dual),
        *_floor_table(f"cleared, Monte-Carlo fields (N = {FLOOR_SAMPLES})", exact),
    ]


def _beginning(motion: Motion, frames: int) -> Motion:
    return motion.clip(0, min(len(motion), frames))


def _thinned(motion: Motion, every: int) -> Motion:
    return replace(motion, rotations=motion.rotations[::every], translation=motion.translation[::every])


def _floor_table(name: str, floor: Floor) -> list[Row]:
    table = [
        told(f"floor, {name}: static template inside", PERCENT * floor.share, "%"),
        told(f"floor, {name}: of it where the body overlaps itself", PERCENT * floor.overlap_share, "%"),
    ]
    return table + [
        told(f"floor, {name}: of the {region}' vertices", PERCENT * floor.region_share[region], "%")
        for region in REGIONS
        if region in floor.region_share
    ]


def _sequences(config: ProjectionEvaluation) -> Iterator[SimulatedSequence]:
    if config.sequences is None:
        yield from shipped_sequences()
        return
    files = sorted(config.sequences.glob("*.npz"))
    if not files:
        raise ValueError(
            f"no simulated sequences (*.npz) in {config.sequences}; make some: python -m assets_gen simulations"
        )
    yield from (SimulatedSequence.load(file) for file in files)


def _motions(config: ProjectionEvaluation, body: Body) -> Iterable[Motion]:
    files = motion_files(config.motions)
    return [load_motion(file, body) for file in files[:: max(1, len(files) // config.floor_motions)]]
