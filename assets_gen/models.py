"""The networks of the try-on that ship: training set -> subspace, regressor and its variant of Tab. 1, manifest."""

import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from workbench.collisions.regressor import RegressorWeights, TrainRegressorConfig
from workbench.collisions.regressor import run as train_regressor
from workbench.collisions.subspace import TrainSubspaceConfig
from workbench.collisions.subspace import run as train_subspace
from workbench.learning.fit import FitConfig
from workbench.store import add_to_manifest, code_version

CODE = (
    "workbench.collisions.subspace",
    "workbench.collisions.regressor",
    "workbench.collisions.motion_descriptor",
    "workbench.collisions.posed_collision",
    "workbench.learning.fit",
)
PAPER = ".paper"  # Tab. 1, "our method": without the term in posed space


@dataclass(frozen=True)
class ModelsConfig:
    """Train what dresses a garment from its shipped training set (half an hour on two cores; resumable)."""

    garment: str = "tshirt"
    out: Path = Path("workbench/assets/models")
    work: Path = Path("out/models")  # where training keeps its state
    subspace: TrainSubspaceConfig = TrainSubspaceConfig()
    regressor: TrainRegressorConfig = TrainRegressorConfig()
    # the full model starts from the paper's and learns the posed-space term
    refine: FitConfig = FitConfig(steps=1000, learning_rate=3e-4)


def run(config: ModelsConfig) -> None:
    """Write GARMENT-subspace, GARMENT-regressor and GARMENT.paper-regressor.safetensors, and their manifest entries."""
    subspace = train_subspace(replace(config.subspace, garment=config.garment, out=config.work))
    _record(config, f"{config.garment}-subspace.safetensors", subspace.story)
    paper = replace(config.regressor, garment=config.garment, out=config.work, suffix=PAPER, weights=RegressorWeights())
    full = replace(
        paper,
        suffix="",
        start=config.work / f"{config.garment}{PAPER}-regressor.safetensors",
        weights=config.regressor.weights,
        fit=config.refine,
    )
    for variant in (paper, full):
        regressor = train_regressor(variant)
        _record(config, f"{config.garment}{variant.suffix}-regressor.safetensors", regressor.story)


def _record(config: ModelsConfig, file: str, story: dict[str, Any]) -> None:
    config.out.mkdir(parents=True, exist_ok=True)
    target = config.out / file
    shutil.copyfile(config.work / file, target)
    last = story["curves"][-1] if story["curves"] else {}
    add_to_manifest(
        config.out.parent / "manifest.json",
        target,
        command=f"python -m assets_gen models --garment {config.garment}",
        config=json.loads(json.dumps(story["config"], default=str)),
        seed=story["config"]["seed"],
        code=code_version(*CODE),
        scores={name: round(float(value), 5) for name, value in last.items()},
        licence="Apache-2.0",
    )
