"""`workbench evaluate collisions`: Sec. 6, Tab. 1 and Fig. 5-8 in figures.  unseen motions x unseen shapes -> rows.

A collision is a garment vertex inside the posed body by exact winding number.  Motions are cleared of self-contact for
each shape (facts.md 9); the raw motions stand beside.
"""

import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from workbench.body.model import Body
from workbench.collisions.diffused_body import DiffusedFields, GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import penetration, surface_penetration
from workbench.collisions.posed_corrective import PosedCorrective
from workbench.collisions.projection_baselines import constant_fields
from workbench.collisions.push_out import bulge, push_out
from workbench.collisions.regressor import Regressor
from workbench.collisions.sequences import SimulatedSequence, tests_of
from workbench.collisions.subspace import SHIPPED, Subspace
from workbench.collisions.subspace_evaluation import trained_garments, wrinkles
from workbench.collisions.tryon import TryOn
from workbench.collisions.worn_poses import SHAPE_CUT, cleared_for
from workbench.evaluation_table import Row, at_least, at_most, told, within
from workbench.formats import load_motion, motion_files
from workbench.garments import Garment
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.laplacian import umbrella_laplacian
from workbench.motion import Motion
from workbench.store import Store

log = logging.getLogger(__name__)
R = TypeVar("R")

MILLI, PERCENT = 1e3, 100.0
ALLOWED = {"tshirt": 0.05, "dress": 0.10}  # percent
ALLOWED_ON_MOCAP = 0.09  # percent: the paper's full model on AMASS
FAR_SHAPES = (1.0, 2.0, 3.0, 4.0, 5.0)  # Fig. 6: largest component, standard deviations; training is cut at 2.5


@dataclass(frozen=True)
class CollisionEvaluation:
    """Collisions of generated garments on unseen motions and shapes, and that they are not won by cheating."""

    garments: tuple[str, ...] = ()  # by default all that ship
    networks: Path | None = None  # a folder of networks; those that ship when absent
    motions: Path | None = None  # a folder of motion files; the test motions that ship when absent
    sequences: Path | None = None  # a folder of simulated test sequences (`python -m assets_gen dataset`); what ships
    shapes: int = 20
    shapes_a_motion: int = 20  # each motion is worn by so many of them, in turn
    every: int = 5  # frames: one in so many is counted
    raw: bool = True  # also the motions as they came
    figures: bool = True  # Fig. 6 (far shapes) and Fig. 7 (the post-process), and edges and faces that cross
    seed: int = 11


def rows(config: CollisionEvaluation) -> list[Row]:
    """Everything, in one run."""
    body, table = Body.default(), []
    motions = [load_motion(file, body) for file in motion_files(config.motions)]
    worn = list(pairs(motions, body, config))
    cleared = _cleared(worn, body)
    for name in config.garments or trained_garments(config.networks or SHIPPED):
        variants = load_variants(name, config.networks or SHIPPED)
        bound = ALLOWED_ON_MOCAP if config.motions else ALLOWED.get(name, ALLOWED["dress"])
        for variant, tryon in variants.items():
            table += collision_rows(f"{name}, {variant}", tryon, cleared, config, bound)
            if config.raw:
                table += collision_rows(f"{name}, {variant}, raw motion", tryon, worn, config, None)
            if config.motions is None:
                table += fidelity_rows(f"{name}, {variant}", tryon, config.sequences)
        if config.figures and variants:
            label, tryon = next(iter(variants.items()))
            table += surface_rows(f"{name}, {label}", tryon, cleared, config)
            table += push_rows(f"{name}, {label}", tryon, worn, config)
            if config.motions is None:
                table += far_shape_rows(f"{name}, {label}", tryon, motions, config)
    return table


def pairs(motions: Sequence[Motion], body: Body, config: CollisionEvaluation) -> Iterator[tuple[Motion, Tensor]]:
    """Each motion with the shapes that wear it."""
    generator = torch.Generator().manual_seed(config.seed)
    shapes = torch.randn(config.shapes, body.shape_count, generator=generator).clamp(-SHAPE_CUT, SHAPE_CUT)
    for index, motion in enumerate(motions):
        motion = motion if abs(motion.fps - 30) < 1e-3 else motion.resampled(30.0)
        for k in range(min(config.shapes_a_motion, config.shapes)):
            yield motion, shapes[(index * config.shapes_a_motion + k) % config.shapes]


def _cleared(worn: Sequence[tuple[Motion, Tensor]], body: Body) -> list[tuple[Motion, Tensor]]:
    """Each motion cleared for its shape, half a minute a pair; kept in the cache folder for the next evaluation."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(2) as pool:
            work = pool.map(lambda pair: cleared_for(pair[0], pair[1], body, Store()), worn)
            done = list(tqdm(work, total=len(worn), desc="clear", mininterval=5.0))
    finally:
        torch.set_num_threads(threads)
    return [(motion, betas) for motion, (_, betas) in zip(done, worn, strict=True)]


@dataclass(frozen=True)
class Variant:
    """A row of Tab. 1: which files of a garment it is made of, by what stands between the name and the stage."""

    label: str
    subspace: str = ""
    regressor: str = ""
    corrective: bool = False
    fields: Callable[[Body, Garment], DiffusedFields] = lambda body, garment: GridFields.default()


VARIANTS = (
    Variant("full with the posed-space corrective", corrective=True),
    Variant("the paper's full model"),
    Variant("without self-supervision", ".unsupervised", ".unsupervised"),
    Variant("without collision loss", ".plain", ".plain"),
    Variant("2019-style", ".2019", ".2019", fields=constant_fields),
)


def load_variants(garment: str, folder: Path) -> dict[str, TryOn]:
    """The models of Tab. 1 that a folder has, best first."""
    found: dict[str, TryOn] = {}
    body = Body.default()
    for variant in VARIANTS:
        subspace = folder / f"{garment}{variant.subspace}-subspace.safetensors"
        regressor = folder / f"{garment}{variant.regressor}-regressor.safetensors"
        corrective = PosedCorrective.beside(folder, garment) if variant.corrective else None
        if subspace.is_file() and regressor.is_file() and (corrective is not None or not variant.corrective):
            networks = Subspace.load(subspace), Regressor.load(regressor)
            model = GarmentModel(body, variant.fields(body, networks[0].garment))
            found[variant.label] = TryOn.of(*networks, model, corrective)
    missing = [variant.label for variant in VARIANTS if variant.label not in found]
    if missing:
        log.warning("%s: no networks in %s for: %s", garment, folder, ", ".join(missing))
    return found


@dataclass(frozen=True)
class Counted:
    """Collisions of one model over many sequences: shares 0..1, and the frame with most."""

    inside: float
    overlap: float
    worst_frame: float
    free_frames: float
    frames: int


def collision_rows(
    label: str, tryon: TryOn, worn: Sequence[tuple[Motion, Tensor]], config: CollisionEvaluation, bound: float | None
) -> list[Row]:
    """Vertices inside the posed body, and the part of them where the body overlaps itself."""
    counted = count(tryon, worn, config.every)
    metric = f"{label}: vertices inside, {len(worn)} sequences"
    share = PERCENT * counted.inside
    return [
        told(metric, share, "%") if bound is None else at_most(metric, share, "%", bound),
        told(f"{label}: of it where the body overlaps itself", PERCENT * counted.overlap, "%"),
        told(f"{label}: the worst frame", PERCENT * counted.worst_frame, "%"),
        told(f"{label}: frames without any collision", PERCENT * counted.free_frames, "%"),
    ]


def count(tryon: TryOn, worn: Sequence[tuple[Motion, Tensor]], every: int) -> Counted:
    """Dress every motion on its shape; count one frame in `every`."""

    def one(dressed: DressedFrames) -> tuple[np.ndarray, np.ndarray]:
        found = penetration(dressed.bodies, tryon.model.body.faces, dressed.garment)
        return found.inside.float().mean(1).numpy(), found.overlap.float().mean(1).numpy()

    inside, overlap = (np.concatenate(column) for column in zip(*dressed_each(tryon, worn, every, one), strict=True))
    return Counted(
        float(inside.mean()), float(overlap.mean()), float(inside.max()), float((inside == 0).mean()), len(inside)
    )


@dataclass(frozen=True, eq=False)
class DressedFrames:
    """Some frames of a dressed motion."""

    garment: Float[Tensor, "T N 3"]
    bodies: Float[Tensor, "T V 3"]


def dressed(tryon: TryOn, motion: Motion, betas: Float[Tensor, "K"], every: int = 1) -> DressedFrames:
    """One frame in `every` of a motion; the regressor sees all of them."""
    with torch.no_grad():
        index = torch.arange(0, len(motion), every)
        rotations, translation = motion.rotations[index], motion.translation[index]
        X = tryon.canonical(motion, betas, every)
        garment = tryon.model.posed(X, tryon.model.state(rotations, betas, translation))
        return DressedFrames(garment, tryon.model.body.vertices(rotations, betas, translation))


def dressed_each(
    tryon: TryOn, worn: Sequence[tuple[Motion, Tensor]], every: int, measure: Callable[[DressedFrames], R]
) -> list[R]:
    """`measure` of every dressed motion, a thread a sequence."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(2) as pool:
            work = pool.map(lambda pair: measure(dressed(tryon, pair[0], pair[1], every)), worn)
            return list(tqdm(work, total=len(worn), desc="dress", mininterval=5.0))
    finally:
        torch.set_num_threads(threads)


def per_frame(tryon: TryOn, motion: Motion, betas: Float[Tensor, "K"], every: int = 1) -> Float[np.ndarray, "T"]:
    """Fig. 5: the share of vertices inside the body, frame by frame, 0..1."""
    frames = dressed(tryon, motion, betas, every)
    return penetration(frames.bodies, tryon.model.body.faces, frames.garment).inside.float().mean(1).numpy()


def surface_rows(
    label: str, tryon: TryOn, worn: Sequence[tuple[Motion, Tensor]], config: CollisionEvaluation
) -> list[Row]:
    """Edges and faces of the garment that cross the body, and those that no vertex shows."""

    def one(frames: DressedFrames) -> np.ndarray:
        found = surface_penetration(frames.bodies, tryon.model.body.faces, frames.garment, tryon.garment.faces)
        masks = (found.crossing_edges, found.hidden_edges, found.crossing_faces, found.hidden_faces)
        return len(frames.garment) * np.array([1.0, *(float(mask.float().mean()) for mask in masks)])

    frames, *shares = np.sum(dressed_each(tryon, worn, 4 * config.every, one), axis=0)
    names = ("edges crossing", "of it with both ends outside", "faces crossing", "of it with all corners outside")
    return [
        told(f"{label}: {name}, {frames:g} frames", PERCENT * share / frames, "%")
        for name, share in zip(names, shares, strict=True)
    ]


def push_rows(
    label: str, tryon: TryOn, worn: Sequence[tuple[Motion, Tensor]], config: CollisionEvaluation
) -> list[Row]:
    """Fig. 7: the post-process of earlier work on the motions as they came, and the bulges it leaves."""
    faces, body_faces = tryon.garment.faces, tryon.model.body.faces

    def one(frames: DressedFrames) -> np.ndarray:
        harms, after = [], []
        for garment, body in zip(frames.garment, frames.bodies, strict=True):
            after.append(push_out(garment, body, body_faces))
            harm = bulge(garment, after[-1], faces)
            moved = float(harm.moved.float().mean())
            harms.append([1.0, moved, moved * harm.shift, moved * harm.detail_lost, moved * harm.stretched])
        left = penetration(frames.bodies, body_faces, torch.stack(after)).share
        return np.array([*np.sum(harms, axis=0), len(after) * left])

    frames, moved, *harm, left = np.sum(dressed_each(tryon, worn, 4 * config.every, one), axis=0)
    shift, lost, stretched = (amount / moved if moved else 0.0 for amount in harm)
    return [
        told(f"{label}: pushed out afterwards, raw motion: vertices it moves", PERCENT * moved / frames, "%"),
        told(f"{label}: the same: their way, mean", MILLI * shift, "mm"),
        told(f"{label}: the same: folds around them lost (Laplacian)", PERCENT * lost, "%"),
        told(f"{label}: the same: edges around them stretched by over a tenth", PERCENT * stretched, "%"),
        told(f"{label}: the same: vertices inside that remain", PERCENT * left / frames, "%"),
    ]


def far_shape_rows(label: str, tryon: TryOn, motions: Sequence[Motion], config: CollisionEvaluation) -> list[Row]:
    """Fig. 6: shapes far beyond training; every component random, the largest one `far`, four motions."""
    table, body = [], tryon.model.body
    for far in FAR_SHAPES:
        generator = torch.Generator().manual_seed(config.seed + 1)
        drawn = torch.rand(4, body.shape_count, generator=generator) * 2 - 1
        shapes = far * drawn / drawn.abs().amax(dim=1, keepdim=True)
        chosen = [motion if abs(motion.fps - 30) < 1e-3 else motion.resampled(30.0) for motion in motions[::6]]
        worn = _cleared(list(zip(chosen, shapes, strict=False)), body)
        share = PERCENT * count(tryon, worn, 2 * config.every).inside
        table.append(told(f"{label}: vertices inside, largest shape component {far:g} sd", share, "%"))
    return table


@torch.no_grad()
def fidelity_rows(label: str, tryon: TryOn, folder: Path | None = None) -> list[Row]:
    """Against simulation on the unseen test sequences (those that ship, or of a folder): error, gap and wrinkles
    (collisions must not be won by inflating or ironing the garment).  None where there is no simulation."""
    laplacian = umbrella_laplacian(tryon.garment.faces, len(tryon.garment.vertices))
    sums = np.zeros(7)
    for s in tests_of(tryon.garment.name, folder):
        index = torch.arange(0, len(s), 6)
        index = index[s.valid[index]]
        if len(index):
            sums += len(index) * _compared(tryon, s, index, laplacian)
    frames = sums[0]
    if not frames:
        log.warning(
            "%s: no simulated test sequence in %s, so nothing is compared with simulation; make some with `python -m "
            "assets_gen dataset` and pass its folder with --sequences",
            label,
            folder or "what ships",
        )
        return []
    error, skinned, gap, wanted_gap, folds, wanted_folds = sums[1:] / frames
    return [
        told(f"{label}: frames compared with simulation", frames, "frames"),
        told(f"{label}: vertex error on unseen sequences, mean", MILLI * error, "mm"),
        told(f"{label}: the same of the skinned template", MILLI * skinned, "mm"),
        at_least(f"{label}: error below skinning the template", PERCENT * (1 - error / skinned), "%", 30.0),
        within(f"{label}: mean gap to the body / simulation's", gap / wanted_gap, "", 0.8, 1.2),
        within(f"{label}: Laplacian energy / simulation's", folds / wanted_folds, "", 0.7, 1.2),
    ]


def _compared(tryon: TryOn, s: SimulatedSequence, index: Tensor, laplacian: Float[Tensor, "N N"]) -> np.ndarray:
    """Means over frames: 1, error, error of the template, gap, simulation's gap, folds, simulation's folds."""
    model = tryon.model
    X = tryon.canonical(Motion(s.rotations, s.translation, s.fps, model.body.skeleton, s.motion_name), s.betas)[index]
    state = model.state(s.rotations[index], s.betas, s.translation[index])
    bodies = model.body.vertices(s.rotations[index], s.betas, s.translation[index])
    found = model.posed(X, state)
    wanted = s.garment[index]
    template = model.posed(tryon.garment.vertices.expand(len(index), -1, -1).contiguous(), state)
    return np.array(
        [
            1.0,
            float((found - wanted).norm(dim=-1).mean()),
            float((template - wanted).norm(dim=-1).mean()),
            _gap(found, bodies, model.body),
            _gap(wanted, bodies, model.body),
            float(wrinkles(laplacian, found)),
            float(wrinkles(laplacian, wanted)),
        ]
    )


def _gap(garment: Float[Tensor, "T N 3"], bodies: Float[Tensor, "T V 3"], body: Body) -> float:
    """Mean distance of garment vertices to the body's surface, metres."""
    closest = ClosestPoint(bodies[0].numpy(), body.faces.numpy())
    distances = []
    for points, surface in zip(garment.numpy(), bodies.numpy(), strict=True):
        closest.refit(surface)
        distances.append(closest.query(points).distance.mean())
    return float(np.mean(distances))
