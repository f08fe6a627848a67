"""The points models that ship: training scans -> POP of all outfits, patches of two, manifest; and Tab. 2's others."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from workbench.body.model import Body
from workbench.points.points_evaluation import FRACTIONS
from workbench.points.scans import load_scans
from workbench.points.trained_points import TrainedPatches, TrainedPoints
from workbench.points.training import PointTrainingConfig
from workbench.points.training_run import TrainPointsConfig, training_folder
from workbench.points.training_run import run as train
from workbench.store import add_to_manifest, code_version

CODE = (
    "workbench.points.training",
    "workbench.points.training_run",
    "workbench.points.clothed_points",
    "workbench.points.pose_encoder",
    "workbench.points.geometry_features",
    "workbench.points.shape_decoder",
    "workbench.points.patches",
    "workbench.points.losses",
    "workbench.learning.fit",
)
STEPS = PointTrainingConfig().fit
COMMAND = "python -m assets_gen points"


@dataclass(frozen=True)
class PointModelsConfig:
    """Train what dresses bodies in points, POP and the patches it is compared with."""

    # Scans in train/ and test/ (`python -m assets_gen outfits`).
    data: Path = Path("out/scans")
    out: Path = Path("workbench/assets/points")
    # Where training keeps its state.
    work: Path = Path("out/points")
    pop: TrainPointsConfig = TrainPointsConfig()
    # As many steps as take each outfit about as long as POP takes an outfit: about 310 CPU-s.
    patches: TrainPointsConfig = TrainPointsConfig(
        method="patches", outfits="tshirt,dress", training=PointTrainingConfig(fit=replace(STEPS, steps=2760))
    )
    # Also train what Tab. 2 compares and does not ship: POP on a half, a quarter and an eighth of the scans, and POP
    # of each of the outfits that have patches.
    compared: bool = False


def run(config: PointModelsConfig) -> None:
    """Write pop.safetensors, patches-OUTFIT.safetensors, the list of what they learned from, and the manifest."""
    body = Body.default()
    for training in (config.pop, config.patches):
        for path in train(replace(training, data=config.data, out=config.work)):
            kind = TrainedPatches if training.method == "patches" else TrainedPoints
            _ship(path, config.out / path.name, dict(kind.load(path, body).story))
    _record_training_set(config)
    if config.compared:
        alone = replace(config.pop, outfits=config.patches.outfits, per_outfit=True)
        for training in (*(replace(config.pop, every=every) for every in FRACTIONS), alone):
            train(replace(training, data=config.data, out=config.work))


def _record_training_set(config: PointModelsConfig) -> None:
    """Which scans the models learned from, by outfit and motion: they are not shipped."""
    scans = load_scans(training_folder(config.data))
    listed = [{"outfit": scan.outfit, "motion": scan.motion, "frames": len(scan)} for scan in scans]
    target = config.out / "training_scans.json"
    target.write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")
    _record(target, {"scans": len(listed)}, {})


def _ship(source: Path, target: Path, story: dict[str, Any]) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    last = story["curves"][-1] if story["curves"] else {}
    made_by = {key: value for key, value in story.items() if key != "curves"}
    _record(target, made_by, {name: round(float(value), 5) for name, value in last.items()})


def _record(target: Path, made_by: dict[str, Any], scores: dict[str, float]) -> None:
    add_to_manifest(
        target.parents[1] / "manifest.json",
        target,
        command=COMMAND,
        config=made_by,
        seed=made_by.get("training", {}).get("seed"),
        code=code_version(*CODE),
        scores=scores,
        licence="Apache-2.0",
    )
