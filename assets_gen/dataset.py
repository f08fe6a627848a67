"""Sec. 6: the training set.  garment -> sequences simulated over motions and shapes, projected, in a compact form.

The plan: every training family of motions gives PER_FAMILY motions (random excursions twice as many), motion i on
training shape i, so that each shape meets each family; with fewer motions than shapes, the shapes are dealt out in
turn and the last one is kept for validation. Test sequences pair test families with test shapes.
"""

import logging
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import norm, qmc
from torch import Tensor
from tqdm import tqdm

from assets_gen.cloth_solver import ClothConfig
from assets_gen.motions import FAMILIES, generate
from assets_gen.simulations import ASSETS, RecordConfig, SimulationsConfig, Task, make_all, report_line
from workbench.body.model import Body
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.canonical_set import CanonicalSequence, CanonicalSet, Projected, compact
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.projection import Projector
from workbench.collisions.sequences import SimulatedSequence
from workbench.garments import Garment, shipped_garments
from workbench.geometry.strain import rest_triangles
from workbench.store import Store, add_to_manifest, code_version, describe

log = logging.getLogger(__name__)

TRAINING_SHAPES, TEST_SHAPES = 12, 20
FARTHEST_SHAPE = 2.5  # standard deviations: random shapes are cut there (facts.md 9)
FAITHFUL = 0.02  # metres: a frame with a worse vertex after projection teaches nothing
PROJECTED_BY = (
    "workbench.collisions.projection",
    "workbench.collisions.garment_model",
    "workbench.collisions.diffused_body",
)
SPLITS = ("train", "validation")
# families whose test sequence ships exactly; fewer of a larger garment, to keep the package small
SHIPPED_TESTS = {"tshirt": ("bow", "jack", "lunge", "march", "throw", "wave"), "dress": ("jack", "lunge", "wave")}
LIVELY = "excursion"  # the family that covers pose space most widely: twice as many motions


@dataclass(frozen=True)
class DatasetConfig:
    """Simulate and project the training and test sequences of a garment (hours; what is finished is kept)."""

    garment: str = "tshirt"
    """the name of one that ships, or a file (OBJ, PLY, npz) of your own, fitted to the canonical body"""
    per_family: int = 12
    """training motions of each family"""
    test_motions: int = 11
    """test sequences"""
    only: tuple[str, ...] = ()
    """names of motions: simulate these alone and make no set of them, as for scans; empty: the whole plan"""
    out: Path = Path("out/dataset")
    workers: int | None = None
    scheduler: str | None = None
    """address of a running Dask cluster, such as tcp://host:8786"""
    rank: int = 1000
    """principal components of the compact form"""
    ship: bool = False
    """write the compact form and the exact test sequences into workbench/assets"""
    # ours: 4 substeps keep as many frames as 6 (dance, kick, excursion: all), at three quarters of the time
    record: RecordConfig = RecordConfig(approach=0.7, settle=0.4, cloth=ClothConfig(substeps=4))


@dataclass(frozen=True, eq=False)
class PlannedSequence:
    """A motion's name and the shape that performs it."""

    motion: str
    betas: Float[Tensor, "K"]
    split: str  # train, validation or test


def training_shapes(body: Body) -> Float[Tensor, "S K"]:
    """The mean shape, and quasi-random ones spread over N(0, I)."""
    # seed=7 and rng=7 give different points; what ships was simulated with these
    points = qmc.Sobol(body.shape_count, seed=7).random(16)  # pyright: ignore[reportCallIssue]
    spread = points[: TRAINING_SHAPES - 1]
    betas = norm.ppf(spread).clip(-FARTHEST_SHAPE, FARTHEST_SHAPE)
    return torch.cat([body.mean_shape()[None], torch.from_numpy(betas).float()])


def test_shapes(body: Body) -> Float[Tensor, "S K"]:
    """Shapes that no training sees: random draws from N(0, I), cut at FARTHEST_SHAPE."""
    drawn = np.random.default_rng(2021).standard_normal((TEST_SHAPES, body.shape_count))
    return torch.from_numpy(drawn.clip(-FARTHEST_SHAPE, FARTHEST_SHAPE)).float()


def plan(config: DatasetConfig, body: Body) -> list[PlannedSequence]:
    """Which motion is simulated on which shape: the test sequences, then round after round of all training families."""
    train, test = training_shapes(body), test_shapes(body)
    families = [name for name, family in FAMILIES.items() if family.split == "train"]
    planned = []
    unseen = [name for name, family in FAMILIES.items() if family.split == "test"]
    for index in range(config.test_motions):
        name = f"{unseen[index % len(unseen)]}_{index // len(unseen):02d}"
        planned.append(PlannedSequence(name, test[index % TEST_SHAPES], "test"))
    for round_ in range(config.per_family):
        split = "validation" if round_ == config.per_family - 1 else "train"
        again = config.per_family + round_
        names = [f"{family}_{round_:02d}" for family in families] + [f"{LIVELY}_{again:02d}"]
        shapes = _dealt(config.per_family, round_, len(names))
        planned += [PlannedSequence(name, train[shape], split) for name, shape in zip(names, shapes, strict=True)]
    return planned


def _dealt(rounds: int, round_: int, count: int) -> list[int]:
    """Indices of the training shapes of a round's motions, the last of them the lively one."""
    if rounds >= TRAINING_SHAPES:
        return [round_ % TRAINING_SHAPES] * (count - 1) + [(rounds + round_ + 5) % TRAINING_SHAPES]
    if round_ == rounds - 1:
        return [TRAINING_SHAPES - 1] * count
    return [(round_ * count + k) % (TRAINING_SHAPES - 1) for k in range(count)]


def chosen(planned: list[PlannedSequence], only: Sequence[str]) -> list[PlannedSequence]:
    """Those of these motions, or all.  ValueError for a motion that is not planned."""
    unknown = sorted(set(only) - {one.motion for one in planned})
    if unknown:
        raise ValueError(f"the plan has no {', '.join(unknown)}; it has {', '.join(one.motion for one in planned)}")
    return [one for one in planned if not only or one.motion in only]


def simulated(config: DatasetConfig, body: Body, garment: Garment) -> tuple[list[PlannedSequence], list[Path | None]]:
    """The files of the plan, made where they are missing (None where a simulation failed)."""
    planned = chosen(plan(config, body), config.only)
    tasks = [_task(config, body, garment, one) for one in planned]
    request = SimulationsConfig(
        out=config.out, workers=config.workers, scheduler=config.scheduler, record=config.record
    )
    paths, failures = make_all(tasks, body, request)
    for failure in failures:
        log.warning("left out: %s", failure)
    return planned, paths


def asked_garment(config: DatasetConfig, body: Body) -> Garment:
    """The garment of the config.  Raises ValueError for a file whose name would pass for a garment that ships."""
    garment = Garment.load(config.garment, body)
    if not garment.ships and garment.name in shipped_garments():
        raise ValueError(f"{config.garment}: a garment {garment.name!r} ships; give your own another name")
    if config.ship and not garment.ships:
        raise ValueError(
            f"{config.garment} is your own: --ship is for those of the package, what is made lies in --out"
        )
    return garment


def _task(config: DatasetConfig, body: Body, garment: Garment, one: PlannedSequence) -> Task:
    return Task(
        name=f"{garment.name}-{one.motion}",
        motion=generate(one.motion, body.skeleton),
        betas=one.betas,
        garment=garment,
        clear=True,
        record=config.record,
    )


def run(config: DatasetConfig) -> None:
    """Simulate and project what is missing, report every sequence, write the compact set (not of a chosen few)."""
    body = Body.default()
    garment = asked_garment(config, body)
    planned, paths = simulated(config, body, garment)
    made = [(one, path) for one, path in zip(planned, paths, strict=True) if path is not None]
    for _, path in made:
        print(report_line(path))
    if config.only:
        return
    gathered = gather(config, body, garment, [(one, path) for one, path in made if one.split != "test"])
    target = config.out / f"{garment.name}.npz"
    gathered.save(target)
    print(describe_set(gathered, target))
    if config.ship:
        _ship(config, gathered)
        _ship_tests(config, [(one, path) for one, path in made if one.split == "test"])


def gather(
    config: DatasetConfig, body: Body, garment: Garment, made: Sequence[tuple[PlannedSequence, Path]]
) -> CanonicalSet:
    """The compact set of simulated sequences: each projected (Eq. 9; kept once made), then all of them condensed."""
    store, code = Store(config.out / "projected"), code_version(*PROJECTED_BY)
    projector = Projector(
        GarmentModel(body, GridFields.default()),
        GridSDF.default(),
        rest_triangles(garment.rest_vertices, garment.faces),
        garment.vertices,
    )

    def projected(pair: tuple[PlannedSequence, Path]) -> Projected:
        one, path = pair
        sequence = SimulatedSequence.load(path)

        def write(part: Path) -> None:
            state = projector.model.state(sequence.rotations, sequence.betas, sequence.translation)
            done = projector.project(sequence.garment, state)
            np.savez(part, canonical=done.canonical.numpy(), error=done.error.numpy())

        made_from = {"simulation": path.name, "projection": projector.config}
        with np.load(store.make(f"canonical-{path.stem}", made_from, write, code).path) as file:
            canonical, error = torch.from_numpy(file["canonical"]), torch.from_numpy(file["error"])
        faithful = error.amax(dim=1) < FAITHFUL
        return Projected(
            canonical,
            CanonicalSequence(
                coefficients=torch.zeros(len(sequence), 0),
                rotations=sequence.rotations,
                translation=sequence.translation,
                betas=sequence.betas,
                valid=sequence.valid & faithful,
                motion_name=one.motion,
                split=one.split,
            ),
        )

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # a thread a sequence beats threads inside small operations
    try:
        with ThreadPoolExecutor(config.workers or 2) as pool:
            done = list(tqdm(pool.map(projected, made), total=len(made), desc="project", unit="sequence"))
    finally:
        torch.set_num_threads(threads)
    generator = torch.Generator().manual_seed(0)
    return compact(done, garment, config.record.cloth.fps, rank=config.rank, generator=generator)


def describe_set(gathered: CanonicalSet, path: Path) -> str:
    """One line: frames by split, shapes, loss of the compact form, size."""
    counts = {
        split: f"{sum(int(s.valid.sum()) for s in gathered.of_split(split))} of "
        f"{sum(map(len, gathered.of_split(split)))} frames of {len(gathered.of_split(split))} sequences"
        for split in SPLITS
    }
    told = ", ".join(f"{split}: {count} kept" for split, count in counts.items())
    return (
        f"{path}: {gathered.garment_name}, {told}; rank {gathered.rank} loses {1e3 * gathered.error:.3f} mm RMS; "
        f"{path.stat().st_size / 1e6:.1f} MB"
    )


def _command(config: DatasetConfig) -> str:
    return (
        f"python -m assets_gen dataset --garment {config.garment} --per-family {config.per_family} "
        f"--test-motions {config.test_motions} --rank {config.rank} --ship"
    )


def _ship(config: DatasetConfig, gathered: CanonicalSet) -> None:
    target = ASSETS / "training" / f"{config.garment}.npz"
    gathered.save(target)
    kept = {split: int(sum(s.valid.sum() for s in gathered.of_split(split))) for split in SPLITS}
    add_to_manifest(
        ASSETS / "manifest.json",
        target,
        command=_command(config),
        config=asdict(config) | {"out": str(config.out), "record": describe(config.record)},
        licence="Apache-2.0",
        code=code_version(*PROJECTED_BY, "assets_gen.simulations", "assets_gen.cloth_solver", "assets_gen.motions"),
        scores={f"{split} frames kept": count for split, count in kept.items()}
        | {"rms loss, mm": round(1e3 * gathered.error, 4)},
    )


def _ship_tests(config: DatasetConfig, made: Sequence[tuple[PlannedSequence, Path]]) -> None:
    """Test sequences ship exactly, as they were simulated."""
    for one, path in made:
        family = one.motion.removeprefix("test_").rpartition("_")[0]
        if family not in SHIPPED_TESTS.get(config.garment, SHIPPED_TESTS["dress"]):
            continue
        target = ASSETS / "test_sequences" / f"{config.garment}_{one.motion}.npz"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, target)
        sequence = SimulatedSequence.load(target)
        add_to_manifest(
            ASSETS / "manifest.json",
            target,
            command=_command(config),
            config={"motion": one.motion, "record": describe(config.record)},
            licence="Apache-2.0",
            code=code_version("assets_gen.simulations", "assets_gen.cloth_solver", "assets_gen.motions"),
            scores={"frames": len(sequence), "kept": int(sequence.valid.sum())},
        )
