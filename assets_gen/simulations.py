"""Sec. 6: simulated ground truth.  motion, shape, garment -> M_G (T,N,3) with its theta and beta, one file a sequence.

A task clears the motion, brings the body from the canonical rest to the motion's first frame and shape while the draped
garment follows, lets it settle, then records and judges every frame. Finished tasks are kept by the hash of what made
them, so that a run that was killed goes on where it stopped.
"""

import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from assets_gen.cloth_solver import ClothConfig, ClothSolver
from assets_gen.motions import generate
from workbench.body.model import Body
from workbench.cli import plugged_in
from workbench.collisions.sequences import SimulatedSequence
from workbench.demo import DemoConfig
from workbench.demo import run as dress_another_shape
from workbench.extras import require
from workbench.formats import load_motion
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_quaternion, quaternion_to_matrix, slerp
from workbench.geometry.strain import RestTriangles, deformation_gradient, principal_stretches, rest_triangles
from workbench.geometry.winding import InsideTest
from workbench.motion import Motion
from workbench.store import Store, add_to_manifest, code_version, describe

log = logging.getLogger(__name__)

ASSETS = Path("workbench/assets")
MADE_BY = ("assets_gen.simulations", "assets_gen.cloth_solver", "workbench.motion_clearing")  # a change makes anew
BATCH = 16  # body frames posed at once: five times cheaper than one by one
REPORT = 5  # frames between two progress reports of a worker


@dataclass(frozen=True)
class RecordConfig:
    """How one sequence is simulated and judged. Seconds."""

    approach: float = 1.0  # ours: from the canonical rest to the first frame
    settle: float = 0.6  # facts.md 4: 15-30 frames are to be discarded
    usual_stretch: float = 1.5  # bound for 99 % of the fabric's area; ours: 1.2 standing, 1.45 landing from a jump
    rare_stretch: float = 2.0  # and for 99.9 %
    # Share of the garment's vertices that may be inside the body.  Armpits of hanging arms overlap themselves: cloth
    # that reaches into them has vertices that are nowhere outside, and a whole motion is lost by one of them.
    most_inside: float = 0.0
    cloth: ClothConfig = ClothConfig()


@dataclass(frozen=True)
class SimulationsConfig:
    """Simulate garments over motions; without --motion the default set."""

    motion: str | None = None
    """a motion file (BVH, AMASS npz, DeepMimic txt, our npz), or the name of a generated motion such as walk_00"""
    garment: str = "tshirt"
    """a shipped garment's name, or an OBJ, PLY or npz file (with --motion)"""
    betas: tuple[float, ...] = ()
    """body shape (with --motion); components that are left out are 0"""
    frames: int | None = None
    """frames to record at 30 fps, from the motion's beginning (with --motion)"""
    start: int = 0
    """frame of the motion, at 30 fps, to begin with"""
    out: Path = Path("out/simulations")
    workers: int | None = None
    """processes of the local cluster; by default one a core"""
    scheduler: str | None = None
    """address of a running Dask cluster, such as tcp://host:8786"""
    ship: bool = False
    """copy the sequences of the default set that ship into workbench/assets/sequences"""
    clear: bool = True
    """rotate limbs clear of the body first"""
    project: bool = True
    """with --motion: also project the sequence, put it on another shape, count collisions and draw it"""
    record: RecordConfig = RecordConfig()


@dataclass(frozen=True, eq=False)
class Task:
    """One sequence to make."""

    name: str
    motion: Motion  # at 30 fps, not cleared
    betas: Float[Tensor, "K"]
    garment: Garment
    clear: bool
    record: RecordConfig

    def made_from(self) -> dict[str, Any]:
        """All that decides the result, for the hash in its file name."""
        return {
            "rotations": self.motion.rotations,
            "translation": self.motion.translation,
            "betas": self.betas,
            "template": self.garment.vertices,
            "rest": self.garment.rest_vertices,
            "clear": self.clear,
            "record": self.record,
        }


@dataclass(frozen=True)
class Planned:
    """One sequence of the default set."""

    name: str
    garment: str
    motion: str
    frames: int
    shape: str
    ships: bool = False


SHAPES = {"mean": (), "slim": (1.0, -0.5, 0.8), "heavy": (-0.8, 0.5, -1.0)}
DEFAULT_SET = (
    Planned("tshirt_demo", "tshirt", "dance_00", 90, "mean", ships=True),
    Planned("dress_turn", "dress", "turn_00", 75, "mean", ships=True),
    Planned("tshirt_reach", "tshirt", "reach_00", 75, "slim"),
    Planned("tshirt_squat", "tshirt", "squat_00", 75, "heavy", ships=True),
    Planned("dress_dance", "dress", "dance_02", 75, "slim", ships=True),
    Planned("tshirt_punch", "tshirt", "punch_00", 75, "heavy"),
    Planned("tshirt_walk", "tshirt", "walk_00", 75, "slim", ships=True),
    Planned("dress_kick", "dress", "kick_00", 75, "heavy"),
    Planned("tshirt_jump", "tshirt", "jump_00", 75, "mean"),
    Planned("tshirt_twist", "tshirt", "twist_00", 75, "heavy", ships=True),
    Planned("dress_twist", "dress", "twist_01", 75, "mean"),
    Planned("tshirt_excursion", "tshirt", "excursion_00", 75, "slim", ships=True),
)


def run(config: SimulationsConfig) -> tuple[Path, ...]:
    """Make what is missing, report every sequence, return their files.

    Raises:
        ValueError: unusable motion, garment or shape; simulations that diverged (after all others have been made).
    """
    body = Body.default()
    tasks = _default_tasks(body, config) if config.motion is None else [_asked_task(body, config)]
    paths, failures = make_all(tasks, body, config)
    for task, path in zip(tasks, paths, strict=True):
        if path is not None:
            print(report_line(path))
            if config.ship and any(p.ships and p.name == task.name for p in DEFAULT_SET):
                _ship(path, task)
    if failures:
        raise ValueError(f"{len(failures)} of {len(tasks)} simulations failed: {'; '.join(failures)}")
    if config.motion is not None and config.project:
        for path in paths:
            if path is not None:
                _project(path)
    return tuple(path for path in paths if path is not None)


def _project(path: Path) -> None:
    """The rest of the spine for one sequence: canonical space, another shape, counted and pictured, beside the file."""
    folder = path.with_suffix("")
    result = dress_another_shape(DemoConfig(out=folder, sequence=str(path)), plugged_in("workbench.pictures", "demo"))
    print(json.dumps(result.report, indent=1))
    print(f"written: {', '.join(str(file) for file in sorted(folder.glob('*')))}")


def _asked_task(body: Body, config: SimulationsConfig) -> Task:
    assert config.motion is not None
    motion = _motion(config.motion, body, config.record.cloth.fps)
    stop = len(motion) if config.frames is None else config.start + config.frames
    if not 0 <= config.start < stop <= len(motion):
        raise ValueError(
            f"{config.motion} has {len(motion)} frames at {config.record.cloth.fps:g} fps; got frames {config.start} "
            f"to {stop}: lower --frames or --start"
        )
    garment = Garment.load(config.garment, body)
    return Task(
        name=f"{garment.name}-{Path(config.motion).stem}",
        motion=motion.clip(config.start, stop),
        betas=_betas(config.betas, body),
        garment=garment,
        clear=config.clear,
        record=config.record,
    )


def _motion(source: str, body: Body, fps: float) -> Motion:
    if Path(source).suffix:
        return load_motion(source, body).resampled(fps)
    return generate(source, body.skeleton).resampled(fps)


def _betas(given: Sequence[float], body: Body) -> Float[Tensor, "K"]:
    if len(given) > body.shape_count or not np.isfinite(given).all():
        raise ValueError(f"betas must be at most {body.shape_count} finite numbers, got {list(given)}")
    betas = body.mean_shape()
    betas[: len(given)] = torch.tensor(given)
    return betas


def _default_tasks(body: Body, config: SimulationsConfig) -> list[Task]:
    return [
        Task(
            name=planned.name,
            motion=generate(planned.motion, body.skeleton, frames=planned.frames),
            betas=_betas(SHAPES[planned.shape], body),
            garment=Garment.load(planned.garment),
            clear=config.clear,
            record=config.record,
        )
        for planned in DEFAULT_SET
    ]


def make_all(tasks: Sequence[Task], body: Body, config: SimulationsConfig) -> tuple[list[Path | None], list[str]]:
    """Every task's file, in order (None where it failed), and one line for each failure."""
    store = Store(config.out)
    code = code_version(*MADE_BY)
    results: list[Path | None] = [None] * len(tasks)
    missing, failures = [], []
    for i, task in enumerate(tasks):
        found = store.find(task.name, task.made_from(), code)
        results[i] = found.path if found else None
        if found is None:
            missing.append(i)
    log.info("%d of %d sequences are there already", len(tasks) - len(missing), len(tasks))
    with tqdm(total=sum(len(tasks[i].motion) for i in missing), unit="frame", disable=not missing) as bar:
        workers = _run_here if len(missing) <= 1 and config.scheduler is None else _run_on_dask
        for i, outcome in workers([(i, tasks[i]) for i in missing], body, config, code, bar):
            if isinstance(outcome, Path):
                results[i] = outcome
            else:
                failures.append(f"{tasks[i].name}: {outcome}")
                tqdm.write(failures[-1])
    return results, failures


def make(task: Task, body: Body, folder: Path, code: str, progress: Callable[[int], None]) -> Path:
    """The task's file in the folder; simulated unless it is there. `code`: version of what simulates."""

    def write(path: Path) -> None:
        simulate(task, body, progress).save(path)

    return Store(folder).make(task.name, task.made_from(), write, code).path


Outcome = tuple[int, Path | str]


def _run_here(
    tasks: Sequence[tuple[int, Task]], body: Body, config: SimulationsConfig, code: str, bar: Any
) -> Iterator[Outcome]:
    for i, task in tasks:
        try:
            yield i, make(task, body, config.out, code, bar.update)
        except ValueError as error:
            yield i, str(error)


def _run_on_dask(
    tasks: Sequence[tuple[int, Task]], body: Body, config: SimulationsConfig, code: str, bar: Any
) -> Iterator[Outcome]:
    """One single-threaded process a core (Warp's CPU backend uses one thread), or the cluster at `scheduler`."""
    distributed: Any = require("distributed", extra="assets")
    count = min(config.workers or os.cpu_count() or 1, len(tasks))
    with (
        distributed.Client(config.scheduler)
        if config.scheduler
        else distributed.Client(n_workers=count, threads_per_worker=1, processes=True, dashboard_address=":0")
    ) as client:
        client.subscribe_topic("frames", lambda event: bar.update(event[1]))
        shared = client.scatter(body, broadcast=True)
        folder = config.out.resolve()
        waiting = {
            client.submit(_on_worker, task, shared, folder, code, key=f"{task.name}-{i}", priority=-i): i
            for i, task in tasks
        }
        for future in distributed.as_completed(waiting):
            error = future.exception()
            if error is not None and not isinstance(error, ValueError):
                raise error
            yield waiting[future], future.result() if error is None else str(error)


def _on_worker(task: Task, body: Body, folder: Path, code: str) -> Path:
    distributed: Any = require("distributed", extra="assets")
    torch.set_num_threads(1)
    worker = distributed.get_worker()
    return make(task, body, folder, code, lambda frames: worker.log_event("frames", frames))


def simulate(task: Task, body: Body, progress: Callable[[int], None] = lambda frames: None) -> SimulatedSequence:
    """Approach, settle, record, judge. `progress` is told how many frames were recorded since it was last called.

    Raises:
        ValueError: another frame rate, the garment starts inside the body, the simulation diverged.
    """
    garment, record, fps = task.garment, task.record, task.record.cloth.fps
    if abs(task.motion.fps - fps) > 1e-3:
        raise ValueError(f"the motion has {task.motion.fps:g} fps; simulations run at {fps:g}: resample it first")
    motion = task.motion.cleared(body, betas=task.betas) if task.clear else task.motion
    start, approach = approach_of(motion, body, task.betas, record)
    body_faces = body.faces.numpy()
    solver = ClothSolver(
        body.vertices(*start.frame(0), start.translation[0]).numpy(),
        body_faces,
        garment.rest_vertices.numpy(),
        garment.faces.numpy(),
        carried(garment.vertices, body, start).numpy(),
        record.cloth,
    )
    for surface in posed(body, approach):
        solver.advance(surface)
    for _ in range(round(record.settle * fps)):
        solver.advance(surface)
    judge = Judge.of(garment, surface, body_faces, record)
    frames, verdicts = [solver.positions], [judge(solver.positions, surface)]
    mended, seconds = [solver.mended], []
    rest_of_motion = BodyMotion(motion.rotations[1:], task.betas.expand(len(motion) - 1, -1), motion.translation[1:])
    began, reported = time.process_time(), 0
    for surface in posed(body, rest_of_motion):
        frames.append(solver.advance(surface))
        verdicts.append(judge(frames[-1], surface))
        mended.append(solver.mended)
        seconds.append(time.process_time() - began)
        began = time.process_time()
        if len(frames) - reported >= REPORT:
            progress(len(frames) - reported)
            reported = len(frames)
    progress(len(frames) - reported)
    return SimulatedSequence(
        garment=torch.from_numpy(np.stack(frames)),
        rotations=motion.rotations,
        translation=motion.translation,
        betas=task.betas,
        faces=garment.faces,
        valid=torch.tensor([verdict.valid for verdict in verdicts]),
        fps=fps,
        garment_name=garment.name,
        motion_name=motion.name,
        made_by=json.dumps(
            {
                "record": describe(record),
                "cleared": task.clear,
                "cpu_seconds_per_frame": float(np.median(seconds)) if seconds else 0.0,
                "vertices_inside": [verdict.inside for verdict in verdicts],
                "vertices_mended": mended,
                "usual_stretch": [round(verdict.usual_stretch, 3) for verdict in verdicts],
                "rare_stretch": [round(verdict.rare_stretch, 3) for verdict in verdicts],
            }
        ),
    )


@dataclass(frozen=True, eq=False)
class BodyMotion:
    """A body that moves and changes its shape."""

    rotations: Float[Tensor, "T J 3 3"]
    betas: Float[Tensor, "T K"]
    translation: Float[Tensor, "T 3"]

    def frame(self, t: int) -> tuple[Float[Tensor, "J 3 3"], Float[Tensor, "K"]]:
        return self.rotations[t], self.betas[t]


def posed(body: Body, motion: BodyMotion) -> Iterator[Float[np.ndarray, "V 3"]]:
    """Body vertices, frame by frame."""
    for begin in range(0, len(motion.rotations), BATCH):
        part = slice(begin, begin + BATCH)
        yield from body.vertices(motion.rotations[part], motion.betas[part], motion.translation[part]).numpy()


def approach_of(
    motion: Motion, body: Body, betas: Float[Tensor, "K"], record: RecordConfig
) -> tuple[BodyMotion, BodyMotion]:
    """The canonical body where the motion begins, and its way (minimum jerk) from there to the first frame.

    The start faces where the motion begins, so that the way is no spin that would wind the garment up.
    """
    first = motion.rotations[0]
    rest = torch.eye(3).expand_as(first).clone()
    rest[0] = heading(first[0])
    steps = max(1, round(record.approach * record.cloth.fps))
    t = torch.arange(1, steps + 1) / steps
    s = t**3 * (10 - 15 * t + 6 * t**2)
    q0, q1 = matrix_to_quaternion(rest), matrix_to_quaternion(first)
    between = slerp(q0.expand(steps, -1, -1), q1.expand(steps, -1, -1), s[:, None].expand(steps, len(first)))
    here = motion.translation[:1]
    start = BodyMotion(rest[None], body.mean_shape()[None], here)
    way = BodyMotion(quaternion_to_matrix(between), s[:, None] * betas, here.expand(steps, -1))
    return start, way


def heading(rotation: Float[Tensor, "3 3"]) -> Float[Tensor, "3 3"]:
    """The part of a rotation that turns about the vertical (swing-twist)."""
    w, _, _, z = matrix_to_quaternion(rotation).unbind()
    return axis_angle_to_matrix(torch.stack([torch.zeros_like(w), torch.zeros_like(w), 2 * torch.atan2(z, w)]))


def carried(template: Float[Tensor, "N 3"], body: Body, start: BodyMotion) -> Float[Tensor, "N 3"]:
    """The template moved rigidly with the canonical body to the start."""
    root = body.joint_template[0]
    return (template - root) @ start.rotations[0, 0].mT + root + start.translation[0]


@dataclass(frozen=True)
class Verdict:
    inside: int  # garment vertices inside the body, by exact winding number
    usual_stretch: float  # 99 % of the area is stretched less
    rare_stretch: float  # 99.9 %
    valid: bool


@dataclass(frozen=True, eq=False)
class Judge:
    """Whether a frame is kept: nothing (or no more than is allowed) inside the body, no cloth stretched beyond what it
    bears."""

    inside: InsideTest
    rest: RestTriangles
    record: RecordConfig

    @staticmethod
    def of(garment: Garment, surface: np.ndarray, body_faces: np.ndarray, record: RecordConfig) -> "Judge":
        return Judge(InsideTest(surface, body_faces), rest_triangles(garment.rest_vertices, garment.faces), record)

    def __call__(self, positions: Float[np.ndarray, "N 3"], surface: Float[np.ndarray, "V 3"]) -> Verdict:
        self.inside.refit(surface)
        inside = int(self.inside(positions).sum())
        stretch = principal_stretches(deformation_gradient(torch.from_numpy(positions), self.rest))[:, 0]
        order = stretch.argsort()
        covered = self.rest.area[order].cumsum(0) / self.rest.area.sum()
        usual, rare = stretch[order][torch.searchsorted(covered, torch.tensor([0.99, 0.999]))].tolist()
        bearable = usual <= self.record.usual_stretch and rare <= self.record.rare_stretch
        return Verdict(inside, usual, rare, inside <= self.record.most_inside * len(positions) and bearable)


def report_line(path: Path) -> str:
    """What became of one sequence, from its file."""
    sequence = SimulatedSequence.load(path)
    facts = json.loads(sequence.made_by)
    inside, mended = np.array(facts["vertices_inside"]), np.mean(facts["vertices_mended"])
    usual, rare = max(facts["usual_stretch"]), max(facts["rare_stretch"])
    return (
        f"{path}: {len(sequence)} frames of {sequence.garment_name} ({sequence.garment.shape[1]} vertices) on "
        f"{sequence.motion_name}; {int(sequence.valid.sum())} kept, {int((inside > 0).sum())} with vertices inside the "
        f"body (at most {inside.max()}; {mended:.2f} a frame were put back outside), stretch of 99 % of the area up to "
        f"{usual:.2f}, of 99.9 % {rare:.2f}; {facts['cpu_seconds_per_frame']:.2f} CPU-s a frame, "
        f"{path.stat().st_size / 1e6:.2f} MB"
    )


def _ship(path: Path, task: Task) -> None:
    target = ASSETS / "sequences" / f"{task.name}.npz"
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)
    sequence = SimulatedSequence.load(target)
    facts = json.loads(sequence.made_by)
    add_to_manifest(
        ASSETS / "manifest.json",
        target,
        command="python -m assets_gen simulations --ship",
        config=asdict(next(planned for planned in DEFAULT_SET if planned.name == task.name)),
        licence="Apache-2.0",
        code=code_version(*MADE_BY),
        scores={
            "frames": len(sequence),
            "kept": int(sequence.valid.sum()),
            "cpu_seconds_per_frame": facts["cpu_seconds_per_frame"],
        },
    )
