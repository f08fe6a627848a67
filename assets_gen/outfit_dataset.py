"""Sec. 4's data: outfits simulated over motions and shapes, then scanned.  ensembles -> one file of scans a sequence.

The plan goes in rounds, so that a run that was stopped has every outfit: a training motion each, a test motion each,
then the further training motions. Garments start as they were cut and fall while the body approaches its first pose.
The T-shirt and the dress alone are not simulated again: `--sequences` names a folder of `assets_gen dataset`.
"""

import json
import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from assets_gen.body import canonical_helpers
from assets_gen.cloth_solver import ClothConfig
from assets_gen.dataset import TEST_SHAPES, TRAINING_SHAPES, test_shapes, training_shapes
from assets_gen.garments import DRAPED, OUTFITS, cut_garment, helper_quads
from assets_gen.motions import FAMILIES
from assets_gen.outfits import ENSEMBLES, Ensemble, put_on, task_of
from assets_gen.scans import ScansConfig, scan_sequence
from assets_gen.simulations import RecordConfig, SimulationsConfig, Task, make_all, report_line
from workbench.body.model import Body
from workbench.collisions.sequences import SimulatedSequence
from workbench.garments import Garment, shipped_garments
from workbench.points.scans import ScanSequence
from workbench.store import Store, add_to_manifest, code_version, describe

log = logging.getLogger(__name__)

ASSETS = Path("workbench/assets")
CUT_BY = ("assets_gen.garments",)  # a change cuts anew
MOST_INSIDE = 20  # vertices (0.3 %) inside the body that a scanned frame may have: pinched in folds, points hide them
# which of the dataset's motions are scanned: a family each, on as many shapes as there are
TESTS_ALONE = ("test_lunge_00", "test_wave_00", "test_jack_00")
SCANNED_ALONE = {
    "tshirt": (
        *("walk_00", "dance_01", "squat_02", "twist_03", "kick_04"),
        *("punch_05", "reach_06", "turn_07", "jump_08", "excursion_09"),
        *TESTS_ALONE,
    ),
    "dress": (
        *("walk_00", "dance_01", "excursion_01", "squat_02", "kick_02", "reach_03", "turn_04", "twist_00"),
        *TESTS_ALONE,
    ),
}
TEST_ROUND = 1  # the second round holds the test motions
FIRST_TEST = 4  # index of the first outfit's test family; with 10 outfits none gets `bow`, which crushes cloth
HELD_OUT = {ensemble.name for ensemble in ENSEMBLES if ensemble.held_out}
SHIPPED_TRAIN, SHIPPED_TEST = 1, 3  # scans of a sequence that ship
SHIPPED_UNSEEN = 2  # sequences of a held-out outfit that ship: one to fit, one to animate
SHIPPED_POINTS = 10_000  # of 40,000 ...
SHIPPED_UNSEEN_POINTS = 20_000  # ... but for held-out outfits, one of whose scans is fitted


@dataclass(frozen=True)
class OutfitsConfig:
    """Simulate and scan the outfits (an hour or two of CPU; what is finished is kept)."""

    out: Path = Path("out/outfits")
    sequences: Path | None = None
    """folder of simulated sequences of the T-shirt and the dress (out/dataset) to be scanned as well"""
    rounds: int = 5
    """motions of each outfit, the second one from the test families: the default gives each outfit 300 frames"""
    frames: int = 60
    """frames of each motion, 2 s"""
    stride: int = 3
    """every stride-th frame is scanned"""
    only: tuple[str, ...] = ()
    """names of outfits; empty: all"""
    workers: int | None = None
    scheduler: str | None = None
    """address of a running Dask cluster, such as tcp://host:8786"""
    ship: bool = False
    """write the compact scans into workbench/assets/scans"""
    # waistbands are elastic: their material is up to 30 % shorter than the waist (1.43), more on a heavy shape;
    # with friction 0.3 trousers creep down by 8 mm a second, hence 0.8
    record: RecordConfig = RecordConfig(
        approach=0.5,
        settle=0.2,
        usual_stretch=1.9,
        rare_stretch=2.4,
        cloth=ClothConfig(substeps=4, friction=0.8),
    )


@dataclass(frozen=True, eq=False)
class PlannedOutfit:
    """An outfit, the motion and the shape that performs it."""

    ensemble: Ensemble
    motion: str
    betas: Float[Tensor, " K"]


def plan(config: OutfitsConfig, body: Body) -> list[list[PlannedOutfit]]:
    """Round by round, what is simulated.  ValueError for an unknown outfit."""
    train, test = training_shapes(body), test_shapes(body)
    seen = [name for name, family in FAMILIES.items() if family.split == "train"]
    unseen = [name for name, family in FAMILIES.items() if family.split == "test"]
    ensembles = [ensemble for ensemble in ENSEMBLES if ensemble.name not in DRAPED]
    unknown = sorted(set(config.only) - {ensemble.name for ensemble in ensembles})
    if unknown:
        raise ValueError(
            f"no outfit is called {', '.join(unknown)}; there are {', '.join(e.name for e in ensembles)}"
            f" ({' and '.join(DRAPED)} are made by python -m assets_gen dataset)"
        )
    rounds = []
    for round_ in range(config.rounds):
        planned = []
        for k, ensemble in enumerate(ensembles):
            if round_ == TEST_ROUND:
                motion, betas = f"{unseen[(k + FIRST_TEST) % len(unseen)]}_00", test[k % TEST_SHAPES]
            else:
                motion = f"{seen[(k + 3 * round_) % len(seen)]}_{k:02d}"
                betas = train[(k + 5 * round_) % TRAINING_SHAPES]
            planned.append(PlannedOutfit(ensemble, motion, betas))
        rounds.append([one for one in planned if not config.only or one.ensemble.name in config.only])
    return rounds


def layers(names: Sequence[str], body: Body, folder: Path) -> dict[str, Garment]:
    """The garments by name: shipped ones as they rest, others as cut (kept in the folder once made)."""
    store, code, made = Store(folder), code_version(*CUT_BY), {}
    for name in names:
        if name in shipped_garments():
            made[name] = Garment.load(name)
            continue

        def write(path: Path, name: str = name) -> None:
            cut = cut_garment(OUTFITS[name], body, canonical_helpers().vertices, helper_quads())
            placed, material = torch.from_numpy(cut.put_on).float(), torch.from_numpy(cut.vertices).float()
            Garment(name, placed, material, torch.from_numpy(cut.faces)).save(path)

        made[name] = Garment.load(store.make(name, OUTFITS[name], write, code).path, body)
    return made


def run(config: OutfitsConfig) -> tuple[Path, ...]:
    """Cut, simulate and scan what is missing, round by round; returns the files of scans."""
    body = Body.default()
    rounds = plan(config, body)
    used = {layer for round_ in rounds for one in round_ for layer in one.ensemble.layers}
    garments = layers(sorted(used), body, config.out / "garments")
    scans = _scan_single(config, body)
    for planned in rounds:
        tasks = [_task(config, body, garments, one) for one in planned]
        request = SimulationsConfig(
            out=config.out / "sequences", workers=config.workers, scheduler=config.scheduler, record=config.record
        )
        paths, failures = make_all(tasks, body, request)
        for failure in failures:
            log.warning("left out: %s", failure)
        for path in paths:
            if path is not None:
                print(report_line(path), flush=True)
                scans += _scanned(config, body, path)
    if config.ship:
        _ship(config, [ScanSequence.load(path) for path in scans])
    return tuple(scans)


def split_of(sequence: SimulatedSequence | ScanSequence) -> str:
    """train or test: of test families, and all of the held-out outfits."""
    outfit = sequence.outfit if isinstance(sequence, ScanSequence) else sequence.garment_name
    motion = sequence.motion if isinstance(sequence, ScanSequence) else sequence.motion_name
    return "test" if outfit in HELD_OUT or motion.startswith("test_") else "train"


def _task(config: OutfitsConfig, body: Body, garments: dict[str, Garment], one: PlannedOutfit) -> Task:
    worn = put_on(one.ensemble, [garments[layer] for layer in one.ensemble.layers])
    return task_of(worn, one.motion, config.frames, one.betas, body, config.record)


def _scan_single(config: OutfitsConfig, body: Body) -> list[Path]:
    if config.sequences is None:
        return []
    wanted = [f"{garment}-{motion}-" for garment, motions in SCANNED_ALONE.items() for motion in motions]
    sources = sorted(path for path in config.sequences.glob("*.npz") if path.name.startswith(tuple(wanted)))
    if not sources:
        raise ValueError(
            f"no sequences of {' or '.join(DRAPED)} in {config.sequences}; make them with assets_gen dataset"
        )
    return [scan for path in sources for scan in _scanned(config, body, path)]


def _scanned(config: OutfitsConfig, body: Body, path: Path) -> list[Path]:
    """The file of a sequence's scans, made if it is not there; none if no frame of the sequence was kept."""
    sequence = scannable(SimulatedSequence.load(path), config.record)
    target = config.out / "scans" / split_of(sequence) / f"{sequence.garment_name}-{sequence.motion_name}.npz"
    if not sequence.valid.any():
        log.warning("no frame of %s was kept: not scanned", path.name)
        return []
    if not target.exists():
        scans = scan_sequence(sequence, body, ScansConfig(stride=config.stride))
        scans.save(target)
        print(f"{target}: {len(scans)} scans, {target.stat().st_size / 1e6:.1f} MB", flush=True)
    return [target]


def scannable(sequence: SimulatedSequence, record: RecordConfig) -> SimulatedSequence:
    """Judged anew for scanning: the few vertices pinched in armpits and behind knees are not seen from outside."""
    facts = json.loads(sequence.made_by)
    inside, usual, rare = (torch.tensor(facts[key]) for key in ("vertices_inside", "usual_stretch", "rare_stretch"))
    bearable = (usual <= record.usual_stretch) & (rare <= record.rare_stretch)
    return replace(sequence, valid=(inside <= MOST_INSIDE) & bearable)


def compact(scans: ScanSequence) -> ScanSequence:
    """The few scans of a sequence that ship, evenly spread, thinned."""
    few = SHIPPED_TRAIN if split_of(scans) == "train" else SHIPPED_TEST
    points = SHIPPED_UNSEEN_POINTS if scans.outfit in HELD_OUT else SHIPPED_POINTS
    return scans.every(max(1, len(scans) // few)).first(few).thinned(points)


def shipped(scans: Sequence[ScanSequence]) -> list[ScanSequence]:
    """All sequences, but of each held-out outfit only the first few."""
    seen = Counter[str]()
    kept = []
    for scan in scans:
        seen[scan.outfit] += 1
        if scan.outfit not in HELD_OUT or seen[scan.outfit] <= SHIPPED_UNSEEN:
            kept.append(scan)
    return kept


def _ship(config: OutfitsConfig, scans: Sequence[ScanSequence]) -> None:
    for sequence in shipped(scans):
        small, stride = compact(sequence), round(config.record.cloth.fps / sequence.fps)
        target = ASSETS / "scans" / split_of(sequence) / f"{sequence.outfit}-{sequence.motion}.npz"
        small.save(target)
        if sequence.outfit in DRAPED:
            source, made = "--sequences out/dataset", {}
        else:
            source, made = f"--rounds {config.rounds} --frames {config.frames}", {"record": describe(config.record)}
        add_to_manifest(
            ASSETS / "manifest.json",
            target,
            command=f"python -m assets_gen outfits {source} --stride {stride} --ship",
            config={"stride": stride, **made},
            licence="Apache-2.0",
            code=code_version("assets_gen.scans", "assets_gen.simulations", "assets_gen.cloth_solver"),
            scores={"scans": len(small), "points": small.ticks.shape[1]},
        )
