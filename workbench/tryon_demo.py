"""`workbench demo`: the shipped model on a body and a motion that no training saw -> page, GLB, picture, report."""

import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.penetration import Penetration, penetration
from workbench.collisions.tryon import TryOn, TryOnResult, shape_from_words
from workbench.formats import load_motion, motion_files
from workbench.formats.gltf import dressed_meshes, write_glb
from workbench.formats.mesh_sequence import MeshSequence
from workbench.store import atomic_write

log = logging.getLogger(__name__)

SHOWN = "test_hula_01"


@dataclass(frozen=True)
class TryOnDemoConfig:
    """Dress a body shape and a motion that no training saw."""

    out: Path = Path("out/demo")
    garment: str = "tshirt"
    # A motion file (BVH, AMASS npz, DeepMimic txt, own npz), or the name of a test motion that ships.
    motion: str = SHOWN
    # The shape to dress, up to 10 numbers in standard deviations, with commas.
    betas: str = "0.8,-1.0,-1.2,0.6"
    # Rotate arms and legs clear of the body first: cloth cannot be where the body overlaps itself.
    clear: bool = True


@dataclass(frozen=True)
class TryOnDemo:
    """The dressed motion, its collisions in both spaces, and the report."""

    result: TryOnResult
    posed: Penetration
    canonical: Penetration
    constant_body: Float[Tensor, "V 3"]
    report: dict[str, Any]


Output = Callable[[TryOnDemo, Path], Path]


def run(config: TryOnDemoConfig, picture: Output | None = None, page: Output | None = None) -> TryOnDemo:
    """Compute, then write tryon.glb and report.json (and tryon.png, tryon.html where they can be drawn)."""
    demo = dress(config)
    config.out.mkdir(parents=True, exist_ok=True)
    write_glb(config.out / "tryon.glb", dressed_meshes(*sequences(demo.result)))
    if picture is not None:
        picture(demo, config.out / "tryon.png")
    if page is not None:
        page(demo, config.out / "tryon.html")
    with atomic_write(config.out / "report.json") as part:
        part.write_text(json.dumps(demo.report, indent=1), encoding="utf-8")
    return demo


def dress(config: TryOnDemoConfig) -> TryOnDemo:
    """Clear the motion, dress it, count collisions by exact winding number."""
    tryon = TryOn.shipped(config.garment)
    body = tryon.model.body
    betas = shape_from_words(config.betas, body)
    motion = load_motion(_motion_file(config.motion), body)
    if abs(motion.fps - tryon.regressor.fps) > 1e-3:
        motion = motion.resampled(tryon.regressor.fps)
    if config.clear:
        motion = motion.cleared(body, betas=betas)
    start = time.perf_counter()
    result = tryon.run(motion, betas)
    seconds = time.perf_counter() - start
    posed = penetration(result.body, body.faces, result.garment)
    canonical = penetration(body.template[None], body.faces, result.canonical)
    report = {
        "garment": config.garment,
        "motion": motion.name or config.motion,
        "frames": len(motion),
        "betas": [round(float(b), 4) for b in betas],
        "seconds_to_dress": seconds,
        "collisions_percent": {"posed": _percent(posed), "canonical": _percent(canonical)},
    }
    return TryOnDemo(result, posed, canonical, Body.default().template, report)


def sequences(result: TryOnResult) -> tuple[MeshSequence, MeshSequence]:
    """Body and garment as moving meshes."""
    fps = result.motion.fps
    return (
        MeshSequence(result.body.numpy(), result.body_faces.numpy(), fps, "body"),
        MeshSequence(result.garment.numpy(), result.garment_faces.numpy(), fps, "garment"),
    )


def _motion_file(name: str) -> Path:
    """A file as it is, or the shipped motion of that name.  Raises ValueError naming those there are."""
    if Path(name).suffix:
        return Path(name)
    shipped = {path.stem: path for path in motion_files(None)}
    if name not in shipped:
        raise ValueError(f"no motion {name!r} ships; there are: {', '.join(shipped)}; or give a file")
    return shipped[name]


def _percent(found: Penetration) -> dict[str, float]:
    return {
        "inside": 100 * found.share,
        "of_it_where_the_body_overlaps_itself": 100 * found.overlap_share,
        "worst_frame": 100 * float(found.inside.float().mean(dim=1).max()),
    }
