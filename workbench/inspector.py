"""`workbench inspect BODY GARMENT --out DIR`: any moving body and garment -> report.json, report.html."""

import json
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from workbench.body.model import Body
from workbench.collisions.blame import Blame, StageArrays, blame, blame_report
from workbench.collisions.body_regions import BodyRegions, regions_of
from workbench.collisions.conventions import (
    Convention,
    Unit,
    Up,
    check_size,
    check_together,
    closed_outwards,
    converted,
    doubtful_up,
)
from workbench.collisions.inspection import Inspection, inspect_collisions
from workbench.collisions.inspection_report import inspection_report
from workbench.export import read_any
from workbench.formats.mesh_sequence import DressedSequence, MeshSequence, read_mesh, read_mesh_sequence
from workbench.npz import read_npz
from workbench.store import atomic_write

log = logging.getLogger(__name__)

# Arrays of a dressed sequence that hold the garment after a stage; the posed garment is `garment_vertices`.
STAGE_KEYS = {"simulated": "simulated", "projected": "projected", "decoded": "decoded", "canonical": "regressed"}
BYTES_A_VERTEX = 32  # of a frame: distance, layers, region, the masks of edges and faces, positions
SLOW = 200_000  # vertices of a frame from which on it is said how long it will take
SECONDS_A_VERTEX = 5e-6  # measured: 4.7k + 13k vertices take 20-30 ms


@dataclass(frozen=True)
class InspectConfig:
    """Find, measure and locate the collisions of a garment with a body, in any mesh sequences.

    BODY and GARMENT are each an .npz, a folder of .obj or .ply files, a .pc2 with its .obj beside it, or one .obj or
    .ply.  One .npz with both (what tryon and export write, or a simulated sequence) is enough alone.
    """

    # The body, or a file that holds body and garment.
    body: tyro.conf.Positional[Path]
    # The garment; absent when BODY holds both.
    garment: tyro.conf.Positional[Path | None] = None
    # Folder for report.json and report.html.
    out: Path = field(kw_only=True)
    # Unit of the body's file; metres are assumed and doubted where the size looks wrong.
    body_unit: Unit | None = None
    # The body's axis that points up; z is assumed.
    body_up: Up | None = None
    # Unit of the garment's file.
    garment_unit: Unit | None = None
    # The garment's axis that points up.
    garment_up: Up | None = None
    # Close an open body's holes, each with a fan.
    fill_holes: bool = False
    # Turn over the body's parts whose normals point inwards.
    flip_body: bool = False
    # Use the frames that both have, from the first on, where their numbers differ.
    cut: bool = False
    # First frame, the one after the last, and every n-th between.
    start: int = 0
    stop: int | None = None
    every: int = 1
    # A body model (own .npz, SMPL-format .npz or .pkl) whose skinning weights name the regions; the default body's mesh
    # is recognised without it.
    body_model: Path | None = None
    # Frames per second, for formats that hold none.
    fps: float | None = None
    # Leave the 3-D view out of report.html.
    flat: bool = False


@dataclass(frozen=True, eq=False)
class InspectionResult:
    """What was inspected and what was found; the page is drawn from it."""

    body: MeshSequence  # one frame where it stands still
    garment: MeshSequence
    found: Inspection
    blame: Blame | None
    report: dict[str, Any]
    flat: bool = False


PageWriter = Callable[[InspectionResult, Path], Path]


def run(config: InspectConfig, page: PageWriter | None = None) -> InspectionResult:
    """Inspect, then write report.json and (with `page`) report.html into `config.out`.

    Errors: FileNotFoundError; ValueError with one line for files that cannot be read or do not fit together.
    """
    dressed, stages = read_pair(config)
    notes: list[str] = []
    body, garment = _together(dressed, config, notes)
    stages = {name: _chosen(array, config) for name, array in stages.items()}
    _tell_size(body, garment)
    model = None if config.body_model is None else Body.load(config.body_model)
    regions = _regions(body, model, notes)
    started = time.perf_counter()
    found = inspect_collisions(
        torch.from_numpy(body.vertices),
        torch.from_numpy(body.faces),
        torch.from_numpy(garment.vertices),
        torch.from_numpy(garment.faces),
        regions,
        Progress(len(garment)),
    )
    seconds = time.perf_counter() - started
    blamed = _blamed(stages, body, garment, model, notes)
    report = {
        "body": {"file": str(config.body), "vertices": body.vertices.shape[1], "faces": len(body.faces)},
        "garment": {
            "file": str(config.garment or config.body),
            "vertices": garment.vertices.shape[1],
            "faces": len(garment.faces),
        },
        "first_frame": config.start,
        "every": config.every,
        "seconds": round(seconds, 2),
        "notes": notes,
        **inspection_report(found, garment.fps),
        "blame": None if blamed is None else blame_report(blamed),
    }
    result = InspectionResult(body, garment, found, blamed, report, config.flat)
    config.out.mkdir(parents=True, exist_ok=True)
    with atomic_write(config.out / "report.json") as part:
        part.write_text(json.dumps(report, indent=1), encoding="utf-8")
    if page is not None:
        page(result, config.out / "report.html")
    for note in notes:
        log.info("note: %s", note)
    log.info("%s", summary(report))
    return result


def summary(report: dict[str, Any]) -> str:
    """What was found, in one line."""
    totals = report["totals"]
    if not totals["inside"] and not totals["crossing_faces"]:
        return f"no collision in {report['frames']} frames of {report['garment_vertices']:,} vertices"
    line = (
        f"{totals['inside_percent']:.2f} % of the garment's vertices are inside the body, at most "
        f"{totals['depth_mm']['max']:.1f} mm deep, in {totals['frames_with_collisions']} of {report['frames']} frames; "
        f"{totals['crossing_edges_with_both_ends_outside']:,} more edges cross with both ends outside"
    )
    if report["incidents"]:
        worst = report["incidents"][0]
        line += f"; worst: {worst['region']}, frame {worst['worst_frame']}, vertex {worst['worst_vertex']}"
    return line


# --- reading


def read_pair(config: InspectConfig) -> tuple[DressedSequence, dict[str, np.ndarray]]:
    """Body and garment as their files hold them, and the garment after further stages where the file has it.

    Errors: FileNotFoundError, ValueError: unreadable, or a file that holds only one of both.
    """
    if config.garment is None or config.garment == config.body:
        return _read_both(config.body, config.garment is None)
    body = _read_side(config.body, "body", config.fps)
    return DressedSequence(body, _read_side(config.garment, "garment", config.fps)), {}


def _read_both(path: Path, alone: bool) -> tuple[DressedSequence, dict[str, np.ndarray]]:
    if path.suffix.lower() != ".npz" or not path.is_file():
        if not path.exists():
            raise FileNotFoundError(f"no mesh sequence at {path}")
        missing = "the GARMENT is missing" if alone else "BODY and GARMENT are the same file"
        raise ValueError(f"{missing}: only an .npz holds both, and {path} is none; give two files or folders")
    arrays = read_npz(path, "a dressed or simulated sequence")
    if "body_vertices" not in arrays and "residual" not in arrays:
        raise ValueError(
            f"{path} does not hold a body and a garment (it holds {', '.join(sorted(arrays))}); give BODY and GARMENT"
        )
    stages = {name: arrays[key].astype(np.float32) for key, name in STAGE_KEYS.items() if key in arrays}
    stages |= {key: arrays[key].astype(np.float32) for key in ("simulated_body", "canonical_body") if key in arrays}
    return read_any(path), stages


def _read_side(path: Path, side: str, fps: float | None) -> MeshSequence:
    """One moving mesh, or one side of a file that holds both, or a mesh that stands still."""
    if path.suffix.lower() in (".obj", ".ply") and path.is_file():
        mesh = read_mesh(path)
        return MeshSequence(mesh.vertices[None], mesh.faces, 30.0 if fps is None else fps, path.stem)
    if path.suffix.lower() == ".npz" and path.is_file():
        arrays = read_npz(path, "a mesh sequence")
        if f"{side}_vertices" in arrays or "residual" in arrays:
            dressed = read_any(path)
            return dressed.body if side == "body" else dressed.garment
    return read_mesh_sequence(path, fps)


# --- putting together


def _together(dressed: DressedSequence, config: InspectConfig, notes: list[str]) -> tuple[MeshSequence, MeshSequence]:
    """Both in metres, z up, over the same frames, the body closed; or ValueError."""
    body, garment = dressed.body, dressed.garment
    body, garment = _same_frames(body, garment, config, notes)
    body = replace(body, vertices=_chosen(body.vertices, config))
    garment = replace(garment, vertices=_chosen(garment.vertices, config), fps=garment.fps / config.every)
    told_body = Convention(config.body_unit, config.body_up)
    told_garment = Convention(config.garment_unit, config.garment_up)
    body = converted(body, told_body)
    check_size(body, told_body)
    garment = converted(garment, told_garment)
    check_together(body, garment, told_garment)
    looks = doubtful_up(body)
    if looks is not None and config.body_up is None:
        notes.append(
            f"the body looks {looks} up; it is taken as it is, which changes no figure; to turn the view, add "
            f"--body-up {looks} --garment-up {looks}"
        )
    for side, told in (("body", told_body), ("garment", told_garment)):
        if told.told:
            notes.append(f"the {side} was read as {told.unit or 'm'}, {told.up or 'z'} up")
    before = body.vertices.shape[1]
    body = closed_outwards(body, fill_holes=config.fill_holes, flip=config.flip_body)
    if body.vertices.shape[1] > before:
        notes.append(f"{body.vertices.shape[1] - before} holes of the body were closed")
    return body, garment


def _same_frames(
    body: MeshSequence, garment: MeshSequence, config: InspectConfig, notes: list[str]
) -> tuple[MeshSequence, MeshSequence]:
    if len(body) == len(garment) or len(body) == 1:
        return body, garment
    if not config.cut:
        raise ValueError(
            f"the body has {len(body)} frames, the garment {len(garment)}: add --cut to use the first "
            f"{min(len(body), len(garment))} of both, if they start together"
        )
    frames = min(len(body), len(garment))
    notes.append(f"only the first {frames} frames are used: the body has {len(body)}, the garment {len(garment)}")
    return replace(body, vertices=body.vertices[:frames]), replace(garment, vertices=garment.vertices[:frames])


def _chosen(array: np.ndarray, config: InspectConfig) -> np.ndarray:
    """The frames asked for; what stands still stays."""
    if len(array) == 1 or array.ndim < 3:
        return array
    if config.every < 1:
        raise ValueError(f"--every {config.every} keeps no frame: give 1 or more")
    chosen = array[config.start : config.stop : config.every]
    if not len(chosen):
        raise ValueError(f"--start {config.start} --stop {config.stop} keep none of {len(array)} frames")
    return np.ascontiguousarray(chosen)


def _tell_size(body: MeshSequence, garment: MeshSequence) -> None:
    """ValueError where the memory cannot hold it; a line where it will take long."""
    vertices = body.vertices.shape[1] + garment.vertices.shape[1]
    needed, available = BYTES_A_VERTEX * vertices * len(garment), _memory()
    if needed > available:
        fewer = int(np.ceil(needed / available))
        raise ValueError(
            f"{len(garment)} frames of {vertices:,} vertices need {needed / 1e9:.1f} GB of memory, there are "
            f"{available / 1e9:.1f}: add --every {fewer}, or inspect a part with --start and --stop"
        )
    if vertices > SLOW:
        seconds = SECONDS_A_VERTEX * vertices * len(garment)
        log.info("%s vertices in each of %d frames: about %.0f s", f"{vertices:,}", len(garment), max(seconds, 1))


def _memory() -> float:
    """Bytes that are free, where the system tells."""
    try:
        return float(os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError, AttributeError):
        return float("inf")


def _regions(body: MeshSequence, model: Body | None, notes: list[str]) -> BodyRegions:
    regions = regions_of(torch.from_numpy(body.vertices[0]), torch.from_numpy(body.faces), model)
    if model is None and not regions.source.startswith("skinning"):
        notes.append(f"regions are {regions.source}; --body-model FILE names them by its joints")
    return regions


def _blamed(
    stages: dict[str, np.ndarray], body: MeshSequence, garment: MeshSequence, model: Body | None, notes: list[str]
) -> Blame | None:
    """Which stage made each collision, where the file carries the garment after the stages before the last, and the
    bodies that they go with."""
    arrays = {name: torch.from_numpy(array) for name, array in stages.items()}
    known = Body.default() if model is None else model
    if "canonical_body" not in arrays and len(known.template) == body.vertices.shape[1]:
        arrays["canonical_body"] = known.template
    for name in STAGE_KEYS.values():
        needed = "simulated_body" if name == "simulated" else "canonical_body"
        if name in arrays and needed not in arrays:
            notes.append(f"the garment's stage {name!r} cannot be blamed: the file lacks {needed}")
            del arrays[name]
    if not any(name in arrays for name in STAGE_KEYS.values()):
        return None
    return blame(
        StageArrays(
            torch.from_numpy(body.faces),
            posed=torch.from_numpy(garment.vertices),
            posed_body=torch.from_numpy(body.vertices),
            **arrays,
        )
    )


@dataclass
class Progress:
    """Says how far it is, every few seconds."""

    frames: int
    every: float = 5.0
    done: int = 0
    told: float = field(default_factory=time.monotonic)

    def __call__(self, frames: int) -> None:
        self.done += frames
        if time.monotonic() - self.told > self.every:
            self.told = time.monotonic()
            log.info("inspected %d of %d frames", self.done, self.frames)
