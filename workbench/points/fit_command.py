"""`workbench fit SCAN --out DIR`: Eq. 7 from a file to a folder that `workbench animate` reads."""

import json
import logging
import time
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Annotated

import torch
import tyro

from workbench.body.model import Body
from workbench.formats.scans import write_scan
from workbench.points.dressing import Dresser
from workbench.points.evaluation import cloud_error
from workbench.points.scan_fitting import FittedOutfit, ScanFitConfig, features_of, fit_scan
from workbench.points.scans import ScanFrame
from workbench.points.trained_points import TrainedPoints
from workbench.points.worn_scan import ScanSource, WornScan, read_worn_scan, world_scan
from workbench.store import atomic_write

log = logging.getLogger(__name__)

FITTED, CLOUD, REPORT = "fitted.npz", "fitted.ply", "report.json"


@dataclass(frozen=True)
class FitScanConfig:
    """Fit POP to one scan of an outfit it was not trained on: what is found can be animated."""

    source: Annotated[ScanSource, tyro.conf.arg(name="")]
    out: Path
    # A trained model (`workbench train points`); the one that ships when absent.
    model: Path | None = None
    fitting: ScanFitConfig = ScanFitConfig()


def run(config: FitScanConfig) -> FittedOutfit:
    """Write fitted.npz (G), fitted.ply (the cloud where the scan was) and report.json.

    Raises FileNotFoundError, or ValueError for a scan, a body or a model that cannot be used.
    """
    body = Body.default()
    worn = read_worn_scan(config.source, body)
    for remark in worn.remarks:
        log.info("note: %s", remark)
    trained = TrainedPoints.load(model_file(config.model), body)
    began, spent = time.perf_counter(), time.process_time()
    fitted, _ = fit_scan(trained.model, body, worn.scan, worn.bodies, config.fitting, betas=worn.betas, name=worn.name)
    seconds = {"wall": time.perf_counter() - began, "CPU": time.process_time() - spent}
    cloud = fitted_cloud(trained, body, fitted, worn)
    config.out.mkdir(parents=True, exist_ok=True)
    fitted.save(config.out / FITTED)
    write_scan(config.out / CLOUD, world_scan(worn, cloud))
    report = _report(fitted, cloud, worn, trained, seconds)
    with atomic_write(config.out / REPORT) as part:
        part.write_text(json.dumps(report, indent=1, ensure_ascii=False), encoding="utf-8")
    log.info(
        "%s: loss %.3f -> %.3f in %.0f s; the cloud lies %.1f mm off the scan (root of half the Chamfer distance)",
        worn.name,
        fitted.loss_before,
        fitted.loss_after,
        seconds["wall"],
        report["off_the_scan_mm"],
    )
    return fitted


def model_file(given: Path | None) -> Path:
    """The model that ships unless another is given."""
    return Path(str(resources.files("workbench") / "assets" / "points" / "pop.safetensors")) if given is None else given


def fitted_cloud(trained: TrainedPoints, body: Body, fitted: FittedOutfit, worn: WornScan) -> ScanFrame:
    """What the fitted outfit looks like in the scan's own pose."""
    cloud = Dresser(trained.model, features_of(trained.model, fitted), body)(worn.bodies)
    return ScanFrame(cloud.points[0], cloud.normals[0])


def _report(
    fitted: FittedOutfit, cloud: ScanFrame, worn: WornScan, trained: TrainedPoints, seconds: dict[str, float]
) -> dict[str, object]:
    error = cloud_error(cloud.points, cloud.normals, worn.scan, worn.name)
    return {
        "scan": worn.name,
        "points": len(worn.scan.points),
        "betas": [round(float(b), 4) for b in torch.as_tensor(worn.betas)],
        "notes": list(worn.remarks),
        "trained_on": list(trained.outfits),
        "networks": fitted.networks,
        "loss": {"before": fitted.loss_before, "after": fitted.loss_after},
        "chamfer_m2": error.chamfer,
        "normal": error.normal,
        "off_the_scan_mm": 1e3 * (error.chamfer / 2) ** 0.5,
        "seconds": {name: round(value, 1) for name, value in seconds.items()},
    }
