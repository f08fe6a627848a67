"""`workbench evaluate runtime`: Tab. 2 on one CPU thread.  one motion -> milliseconds a frame, both paths in one run.

Reference: networks of the published sizes (facts.md 1) and the paper's field networks, in torch.  Fast: the networks
that ship, in onnxruntime where it is installed, and the tabulated fields.  Their difference is that of the fields and
runtimes alone: both pose the same canonical garments.
"""

import contextlib
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from workbench.collisions.diffused_body import LearnedFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.regressor import HIDDEN, LAYERS
from workbench.collisions.subspace import SHIPPED, NetworkConfig, Statistics, Subspace
from workbench.collisions.subspace_evaluation import trained_garments
from workbench.collisions.tryon import Networks, TorchNetworks, TryOn, load_tryon
from workbench.collisions.tryon_onnx import OnnxNetworks
from workbench.evaluation_table import Row, at_least, at_most, told
from workbench.extras import MissingExtra
from workbench.formats import load_motion, motion_files
from workbench.motion import Motion

MILLI = 1e3
ALLOWED = {"tshirt": 4.0, "dress": 8.0}  # milliseconds
PAPER = {"tshirt": 4.7, "dress": 8.1}  # on a GTX 1080 Ti (Tab. 2)


@dataclass(frozen=True)
class RuntimeEvaluation:
    """Milliseconds a frame on ONE thread: descriptor, regressor, decoder, garment model."""

    garments: tuple[str, ...] = ()  # by default all that ship
    networks: Path | None = None  # a folder of networks; those that ship when absent
    frames: int = 60
    reference_frames: int = 6  # of the slow path


def rows(config: RuntimeEvaluation) -> list[Row]:
    """Everything, in one run, on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            table: list[Row] = []
            for name in config.garments or trained_garments(config.networks or SHIPPED):
                table += garment_rows(name, config)
            return table
    finally:
        torch.set_num_threads(threads)


def garment_rows(name: str, config: RuntimeEvaluation) -> list[Row]:
    """Both paths, their parts, and how far apart they are."""
    tryon = load_tryon(name, config.networks)
    body = tryon.model.body
    motion = load_motion(motion_files(None)[0], body)
    runtimes: dict[str, Networks] = {"torch": tryon.networks}
    with contextlib.suppress(MissingExtra):  # the rows say which runtimes were there
        runtimes["onnxruntime"] = OnnxNetworks(tryon.regressor, tryon.subspace)
    table, medians = [], {}
    for runtime, networks in runtimes.items():
        medians[runtime] = _frame_time(replace(tryon, networks=networks), motion, config.frames)
        table.append(told(f"{name}: a frame, one thread, {runtime} and tabulated fields", medians[runtime], "ms"))
    best = min(medians, key=lambda runtime: medians[runtime])
    fast = replace(tryon, networks=runtimes[best])
    table.append(at_most(f"{name}: a frame, one thread, median ({best})", medians[best], "ms", ALLOWED.get(name, 8.0)))
    table += _part_rows(name, fast, motion, config)
    reference = _reference(tryon)
    slow = _frame_time(reference, motion, config.reference_frames)
    table.append(told(f"{name}: a frame, one thread, the paper's network sizes and field networks", slow, "ms"))
    table.append(told(f"{name}: the paper, on a GTX 1080 Ti", PAPER.get(name, float("nan")), "ms"))
    table.append(at_least(f"{name}: faster than the reference path", slow / medians[best], "x", 30.0))
    learned = GarmentModel(body, LearnedFields.default(body))
    apart = [
        float((fast.model.posed(X, state) - learned.posed(X, state)).norm(dim=-1).mean())
        for X, state in _canonical(tryon, motion, config.reference_frames)
    ]
    table.append(at_most(f"{name}: posed garment, table against field networks, mean", MILLI * max(apart), "mm", 0.5))
    return table


def _canonical(tryon: TryOn, motion: Motion, frames: int):
    """Canonical garments and body states, spread over the motion."""
    betas = tryon.model.body.mean_shape()
    latent = tryon.latents(motion, betas)
    for frame in torch.linspace(0, len(latent) - 1, frames).long().tolist():
        state = tryon.model.state(motion.rotations[frame], betas, motion.translation[frame])
        yield tryon.subspace.decode(latent[frame]), state


def _frame_time(tryon: TryOn, motion: Motion, frames: int) -> float:
    """Median milliseconds of a streamed frame."""
    stream = tryon.stream(tryon.model.body.mean_shape())
    stream(motion.rotations[0], motion.translation[0])  # warms up
    times = []
    for frame in range(frames):
        index = (frame + 1) % len(motion)
        start = time.perf_counter()
        stream(motion.rotations[index], motion.translation[index])
        times.append(time.perf_counter() - start)
    return MILLI * statistics.median(times)


def _part_rows(name: str, tryon: TryOn, motion: Motion, config: RuntimeEvaluation) -> list[Row]:
    """Where the time of a frame goes, as in Tab. 2."""
    X, _ = next(iter(_canonical(tryon, motion, 1)))
    betas, theta, shift = tryon.model.body.mean_shape(), motion.rotations[0], motion.translation[0]
    inputs, hidden = torch.zeros(len(tryon.regressor.centre)), torch.zeros(LAYERS, 1, HIDDEN)
    latent, _ = tryon.networks.regress(inputs, hidden)
    parts: dict[str, Callable[[], object]] = {
        "regressor": lambda: tryon.networks.regress(inputs, hidden),
        "decoder": lambda: tryon.networks.decode(latent),
        "garment model (Eq. 7-8)": lambda: tryon.model.posed(X, tryon.model.state(theta, betas, shift)),
    }
    return [told(f"{name}: {part}", _median(call, config.frames), "ms") for part, call in parts.items()]


def _median(call: Callable[[], object], repeats: int) -> float:
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return MILLI * statistics.median(times)


def _reference(tryon: TryOn) -> TryOn:
    """The published sizes; weights do not change how long a network takes, so they are left as initialised."""
    config = NetworkConfig(width=2000, rank=0)
    published = Subspace(tryon.garment.name, Statistics.blank(len(tryon.garment.vertices), config), config)
    model = GarmentModel(tryon.model.body, LearnedFields.default(tryon.model.body))
    return replace(tryon, model=model, subspace=published, networks=TorchNetworks(tryon.regressor, published))
