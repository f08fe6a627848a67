"""`workbench train points`: a folder of scans -> one model of all outfits, or one an outfit; POP or SCALE's patches.

Scans lie in DATA/train and DATA/test (motions that are never learned from); a folder without these is all for training.
"""

import json
import logging
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal

import torch

from workbench.body.model import Body
from workbench.learning.device import device_named
from workbench.learning.scalar_log import ScalarLog, read_curves
from workbench.points.clothed_points import PointModel, PointModelConfig
from workbench.points.geometry_features import GeometryFeaturesConfig
from workbench.points.patches import PatchModel, PatchModelConfig
from workbench.points.pose_encoder import PoseEncoderConfig
from workbench.points.scans import ScanSequence, load_scans, outfits_of
from workbench.points.shape_decoder import ShapeDecoderConfig
from workbench.points.trained_points import TrainedPatches, TrainedPoints
from workbench.points.training import PointTrainingConfig, ScanSet, papers_training, train_points
from workbench.points.uv_position_map import atlas_of

log = logging.getLogger(__name__)

# Ours: half the paper's widths, so that a training fits two cores
TWO_CORES = PointModelConfig(
    encoder=PoseEncoderConfig(depth=6, width=16, features=32, channels=6),
    geometry=GeometryFeaturesConfig(size=64, features=32),
    decoder=ShapeDecoderConfig(width=128, features=64),
    input_size=64,
)
TWO_CORES_PATCHES = PatchModelConfig(
    encoder=PoseEncoderConfig(depth=5, width=16, features=32, channels=6),
    decoder=ShapeDecoderConfig(width=128, features=34),
)
Method = Literal["pop", "patches"]


@dataclass(frozen=True)
class TrainPointsConfig:
    """Train what dresses bodies in points, from scans; a run that was ended continues, to the same result."""

    # A folder of scan sequences (`python -m assets_gen scans`), in train/ and test/ or all for training; those that
    # ship when absent.
    data: Path | None = None
    out: Path = Path("out/points")
    # POP, or the patches it is compared with (SCALE), which need a model for each outfit.
    method: Method = "pop"
    # One model an outfit instead of one of all.
    per_outfit: bool = False
    # The published sizes, rates and 401 epochs: for a large machine or some days.
    paper: bool = False
    # Only these outfits, with commas.
    outfits: str = ""
    # All outfits but these, with commas.
    hold_out: str = ""
    # Begin with the networks of this model (POP): outfits that it knows keep their G, others begin at the mean.
    start: Path | None = None
    # Learn from every n-th frame: 2, 4 and 8 are the halves, quarters and eighths of Tab. 2.
    every: int = 1
    training: PointTrainingConfig = PointTrainingConfig()
    # cpu, cuda, cuda:1 or mps; scans are unpacked and thinned on the CPU, all else of a step is computed there.
    device: str = "cpu"


def run(config: TrainPointsConfig) -> tuple[Path, ...]:
    """Train (or continue); returns the model files: `out`/METHOD[-everyN][-OUTFIT].safetensors.

    Raises ValueError for a folder without scans, outfits that it lacks, a step count of a run that differs, or a device
    that is not there.
    """
    device = device_named(config.device)
    body = Body.default()
    scans = chosen(load_scans(training_folder(config.data)), config)
    name = config.method if config.every == 1 else f"{config.method}-every{config.every}"
    if not (config.per_outfit or config.method == "patches"):
        return (train_one(scans, config, body, device, name),)
    written = []
    for outfit in outfits_of(scans):
        own = [scan for scan in scans if scan.outfit == outfit]
        written.append(train_one(own, config, body, device, f"{name}-{outfit}"))
    return tuple(written)


def training_folder(data: Path | None) -> Path:
    """DATA/train where there is one."""
    data = shipped_scans() if data is None else data
    return data / "train" if (data / "train").is_dir() else data


def shipped_scans() -> Path:
    """The scans that ship: train/ and test/."""
    return Path(str(resources.files("workbench") / "assets" / "scans"))


def chosen(scans: Sequence[ScanSequence], config: TrainPointsConfig) -> list[ScanSequence]:
    """The sequences of the outfits asked for, thinned.  Raises ValueError for outfits that are not there."""
    there = outfits_of(scans)
    only, out = (tuple(filter(None, words.split(","))) for words in (config.outfits, config.hold_out))
    missing = [name for name in (*only, *out) if name not in there]
    if missing:
        raise ValueError(f"there are no scans of {', '.join(missing)}; there are {', '.join(there)}")
    kept = [scan for scan in scans if scan.outfit in (only or there) and scan.outfit not in out]
    if not kept:
        raise ValueError(f"no outfit is left to learn from: of {', '.join(there)}, all are held out")
    return [scan.every(config.every) for scan in kept]


def train_one(
    scans: Sequence[ScanSequence], config: TrainPointsConfig, body: Body, device: torch.device, name: str
) -> Path:
    """One model, with its curves beside the checkpoint in `out`/work/NAME and in the model file."""
    patches = config.method == "patches"
    sizes = PointModelConfig() if config.paper else TWO_CORES
    size = TWO_CORES_PATCHES.size if patches else sizes.input_size
    frames = ScanSet.of(body, scans, size, device)
    training = papers_training(len(frames)) if config.paper else config.training
    generator = torch.Generator().manual_seed(training.seed)
    if patches:
        model = PatchModel(PatchModelConfig() if config.paper else TWO_CORES_PATCHES, generator=generator)
        places = atlas_of(body, size).queries
        training = replace(training, queries=max(1, training.queries // model.config.side**2))
    else:
        model = PointModel(len(frames.outfits), sizes, generator=generator)
        if config.start is not None:
            begin_with(TrainedPoints.load(config.start, body), model, frames.outfits)
        places = None
    model.to(device)
    work = config.out / "work" / name
    log.info("%s: %d scans of %s", name, len(frames), ", ".join(frames.outfits))
    curves = Curves(work, training.fit.checkpoint_every)
    train_points(
        model,
        frames,
        training,
        queries=places,
        checkpoint=work / "checkpoint.safetensors",
        watch=curves,
        label=name,
    )
    story = {
        "training": _plain(training),
        "every": config.every,
        "start": None if config.start is None else TrainedPoints.load(config.start, body).story,
        "frames": len(frames),
        "motions": sorted({scan.motion for scan in scans}),
        "curves": read_curves(work / "curves.jsonl"),
    }
    path = config.out / f"{name}.safetensors"
    if isinstance(model, PatchModel):
        TrainedPatches(model, frames.outfits, story).save(path, body)
    else:
        TrainedPoints(model, frames.outfits, story).save(path, body)
    log.info("written: %s (%.1f MB)", path, path.stat().st_size / 1e6)
    return path


@torch.no_grad()
def begin_with(trained: TrainedPoints, model: PointModel, outfits: Sequence[str]) -> None:
    """Copy the networks of a trained model, and its G where it knows the outfit.  ValueError for other sizes."""
    if trained.model.config != model.config:
        raise ValueError(f"the model to begin with has sizes {trained.model.config}, expected {model.config}")
    networks = {key: value for key, value in trained.model.state_dict().items() if key != "geometry.stored"}
    model.load_state_dict(networks, strict=False)
    known = trained.model.geometry.stored
    for k, outfit in enumerate(outfits):
        old = known[trained.number_of(outfit)] if outfit in trained.outfits else known.mean(0)
        model.geometry.stored[k] = old


class Curves:
    """Mean loss and seconds of CPU, one point of the curves every `every` steps: as often as the run can resume."""

    def __init__(self, work: Path, every: int):
        self.work, self.every = work, every
        self.log: ScalarLog | None = None
        self.sum, self.count = 0.0, 0
        self.spent = time.process_time()

    def __call__(self, step: int, loss: float) -> None:
        if self.log is None:
            self.log = ScalarLog(self.work, begin=step + 1)
            before = read_curves(self.work / "curves.jsonl")
            self.spent -= before[-1]["CPU seconds"] if before else 0.0
        self.sum, self.count = self.sum + loss, self.count + 1
        if (step + 1) % self.every == 0:
            seconds = round(time.process_time() - self.spent, 1)
            self.log.add(step + 1, {"loss": self.sum / self.count, "CPU seconds": seconds})
            self.sum, self.count = 0.0, 0


def _plain(config: Any) -> Any:
    return json.loads(json.dumps(asdict(config), default=str))
