"""The fields that ship (Eq. 4-6, 12): default body -> grids and networks in workbench/assets/fields, manifest."""

import logging
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from tqdm import tqdm

from workbench.body.model import Body
from workbench.collisions.body_sdf import GridSDF, GridSDFConfig
from workbench.collisions.diffused_body import GridFields, GridFieldsConfig
from workbench.collisions.field_training import TrainFieldsConfig
from workbench.collisions.field_training import run as train
from workbench.store import add_to_manifest, code_version

log = logging.getLogger(__name__)

CODE = (
    "workbench.collisions.diffused_body",
    "workbench.collisions.body_sdf",
    "workbench.collisions.field_training",
    "workbench.geometry.field_grid",
    "workbench.geometry.sampling",
    "workbench.learning.mlp",
    "workbench.learning.fit",
)
LICENCE = "CC0-1.0"  # derived from the default body, whose data are CC0


@dataclass(frozen=True)
class CheckpointsConfig:
    """Tabulate the fields and the SDF of the default body and train the paper's four networks (about 90 minutes on two
    cores; a run that is killed continues its training).  `--no-grids --training.networks sdf` makes the SDF's network
    alone.  Those of W~, B~s and B~p that ship learned on from what this makes (`workbench train fields --start`,
    manifest.json)."""

    out: Path = Path("workbench/assets/fields")
    work: Path = Path("out/checkpoints")  # where training keeps its state
    grids: bool = True
    fields: GridFieldsConfig = GridFieldsConfig()
    sdf: GridSDFConfig = GridSDFConfig()
    training: TrainFieldsConfig = TrainFieldsConfig()


def run(config: CheckpointsConfig) -> None:
    """Write fields.npz, sdf.npz and weights, shape, pose, sdf.safetensors, and their manifest entries."""
    body = Body.default()
    if config.grids:
        with tqdm(desc="SDF grid", unit="level") as bar:
            GridSDF.tabulate(body, config.sdf, progress=_shown(bar)).save(config.out / "sdf.npz")
        _record(config, "sdf.npz", asdict(config.sdf), 0)
        with tqdm(desc="field grid", unit="level") as bar:
            GridFields.tabulate(body, config.fields, progress=_shown(bar)).save(config.out / "fields.npz")
        _record(config, "fields.npz", asdict(config.fields), config.fields.seed)
    trained = train(replace(config.training, out=config.work))
    trained.save(config.out)
    for name, fitted in trained.fits.items():
        _record(
            config,
            f"{name}.safetensors",
            asdict(getattr(config.training, name)) | _seen_by(name, config.training),
            config.training.seed,
            {"training loss": round(fitted.loss, 5)},
        )


def _seen_by(name: str, training: TrainFieldsConfig) -> dict:
    """What the network was shown: points a step, and the pool they came from."""
    if name == "sdf":
        return {"batch": training.sdf_batch, "points": training.sdf_points}
    return {"batch": training.batch, "pool": asdict(training.pool)}


def _shown(bar: tqdm):
    def progress(level: int, cells: int, nodes: int) -> None:
        bar.set_postfix(level=level, cells=cells, nodes=nodes)
        bar.update()

    return progress


def _record(
    config: CheckpointsConfig, file: str, made_by: dict, seed: int, scores: dict[str, float] | None = None
) -> None:
    path = config.out / file
    log.info("%s: %.2f MB", path, os.path.getsize(path) / 1e6)
    add_to_manifest(
        config.out.parent / "manifest.json",
        path,
        command="python -m assets_gen checkpoints",
        config=made_by,
        seed=seed,
        code=code_version(*CODE),
        scores=scores or {},
        licence=LICENCE,
    )
