"""The spine in one run: a simulated sequence -> canonical space (Eq. 9) -> another body (Eq. 7).

`python -m assets_gen simulations --motion FILE` ends with it; `workbench demo` (tryon_demo.py) shows the learned model.
"""

import json
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from workbench.body.model import Body
from workbench.collisions.body_sdf import GridSDF
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.penetration import Penetration, penetration
from workbench.collisions.projection import ProjectionConfig, Projector
from workbench.collisions.sequences import SimulatedSequence, shipped_sequence
from workbench.formats.gltf import GltfMesh, write_glb
from workbench.formats.mesh_sequence import MeshSequence
from workbench.garments import Garment
from workbench.geometry.strain import rest_triangles
from workbench.store import atomic_write

log = logging.getLogger(__name__)

SKIN = (0.72, 0.50, 0.38)
CLOTH = (0.10, 0.26, 0.52)
SHOWN = "tshirt_demo"


@dataclass(frozen=True)
class DemoConfig:
    """Take simulated cloth to canonical space and put it back on a body shape that no simulation saw."""

    out: Path = Path("out/demo")
    # A simulated sequence: a file (.npz), or the name of one that ships.
    sequence: str = SHOWN
    # The shape to dress, up to 10 numbers in standard deviations; shorter lists are filled with zeros.
    betas: tuple[float, ...] = (0.8, -1.0, -1.2, 0.6)
    projection: ProjectionConfig = ProjectionConfig()


@dataclass(frozen=True)
class DressedBody:
    """A body and its garment over time, and which garment vertices are inside it."""

    body: Float[Tensor, "B V 3"]  # one frame for the constant body, else T
    garment: Float[Tensor, "T N 3"]
    collisions: Penetration


@dataclass(frozen=True)
class DemoResult:
    """The three places where the garment was: simulated, canonical (on the constant body), on the new shape."""

    simulated: DressedBody
    canonical: DressedBody
    reposed: DressedBody
    valid: Bool[Tensor, "T"]
    body_faces: Tensor
    garment_faces: Tensor
    fps: float
    report: dict[str, Any]


Picture = Callable[[DemoResult, Path], Path]


def run(config: DemoConfig, picture: Picture | None = None) -> DemoResult:
    """Compute, then write tryon.glb and report.json (and, with `picture`, tryon.png) into `config.out`."""
    body = Body.default()
    sequence = _sequence(config.sequence)
    result = repose(body, sequence, shape_of(config.betas, body), config.projection)
    config.out.mkdir(parents=True, exist_ok=True)
    write_glb(config.out / "tryon.glb", gltf_meshes(result))
    if picture is not None:
        picture(result, config.out / "tryon.png")
    with atomic_write(config.out / "report.json") as part:
        part.write_text(json.dumps(result.report, indent=1), encoding="utf-8")
    return result


def repose(body: Body, sequence: SimulatedSequence, betas: Float[Tensor, "K"], config: ProjectionConfig) -> DemoResult:
    """Project the sequence (Eq. 9), pose it on the shape `betas` (Eq. 7), count collisions in all three places."""
    garment = Garment.load(sequence.garment_name)
    model = GarmentModel(body, GridFields.default())
    rest = rest_triangles(garment.rest_vertices, garment.faces)
    projector = Projector(model, GridSDF.default(), rest, garment.vertices, config)
    state = model.state(sequence.rotations, sequence.betas, sequence.translation)
    start = time.perf_counter()
    projection = projector.project(sequence.garment, state)
    seconds = time.perf_counter() - start
    lift = _stand_on_floor(body, sequence, betas)
    new_state = model.state(sequence.rotations, betas, sequence.translation + lift)
    with torch.no_grad():
        reposed = torch.stack([model.posed(X, new_state[frame]) for frame, X in enumerate(projection.canonical)])
    simulated = _dressed(body, _posed_body(body, sequence, sequence.betas), sequence.garment)
    canonical = _dressed(body, body.template[None], projection.canonical)
    dressed = _dressed(body, _posed_body(body, sequence, betas, lift), reposed)
    report = {
        "garment": sequence.garment_name,
        "motion": sequence.motion_name,
        "frames": len(sequence),
        "frames_kept_by_the_simulation_check": int(sequence.valid.sum()),
        "simulated_betas": [round(float(b), 4) for b in sequence.betas],
        "dressed_betas": [round(float(b), 4) for b in betas],
        "reposing_error_mm": {
            "mean": float(1e3 * projection.error.mean()),
            "p99": float(1e3 * np.quantile(projection.error.numpy(), 0.99)),
            "max": float(1e3 * projection.error.max()),
        },
        "projection_frames_per_second": len(sequence) / seconds,
        "collisions_percent": {
            "simulated": _percent(simulated), "canonical": _percent(canonical), "reposed": _percent(dressed)
        },
    }  # fmt: skip
    return DemoResult(simulated, canonical, dressed, sequence.valid, body.faces, garment.faces, sequence.fps, report)


def shape_of(betas: tuple[float, ...], body: Body) -> Float[Tensor, "K"]:
    """A full shape vector from the first few components.

    Errors: ValueError for too many components or values that are not finite.
    """
    if len(betas) > body.shape_count:
        raise ValueError(f"{len(betas)} betas given, but the body has {body.shape_count} shape components")
    full = torch.zeros(body.shape_count)
    full[: len(betas)] = torch.tensor(betas, dtype=torch.float32)
    if not bool(torch.isfinite(full).all()):
        raise ValueError(f"betas {betas} hold NaN or infinity; give standard deviations such as 0.5 -1 2")
    return full


def gltf_meshes(result: DemoResult) -> list[GltfMesh]:
    """The dressed new shape, ready for a glTF file."""

    def moving(name: str, vertices: Tensor, faces: Tensor) -> MeshSequence:
        return MeshSequence(vertices=vertices.numpy(), faces=faces.numpy(), fps=result.fps, name=name)

    return [
        GltfMesh(moving("body", result.reposed.body, result.body_faces), colour=SKIN),
        GltfMesh(moving("garment", result.reposed.garment, result.garment_faces), colour=CLOTH, double_sided=True),
    ]


def _sequence(name: str) -> SimulatedSequence:
    path = Path(name)
    return SimulatedSequence.load(path) if path.suffix == ".npz" else shipped_sequence(name)


def _posed_body(
    body: Body, sequence: SimulatedSequence, betas: Tensor, lift: Tensor | float = 0.0
) -> Float[Tensor, "T V 3"]:
    frames = zip(sequence.rotations, sequence.translation + lift, strict=True)
    return torch.stack([body.vertices(rotations, betas, translation) for rotations, translation in frames])


def _stand_on_floor(body: Body, sequence: SimulatedSequence, betas: Tensor) -> Float[Tensor, "3"]:
    """Shorter legs bend as much as longer ones: move the new shape so that its lowest point of all is the old one's."""

    def lowest(shape: Tensor) -> Tensor:
        return _posed_body(body, sequence, shape)[..., 2].amin(dim=-1).median()

    return torch.stack([torch.tensor(0.0), torch.tensor(0.0), lowest(sequence.betas) - lowest(betas)])


def _dressed(body: Body, vertices: Float[Tensor, "B V 3"], garment: Float[Tensor, "T N 3"]) -> DressedBody:
    return DressedBody(vertices, garment, penetration(vertices, body.faces, garment))


def _percent(dressed: DressedBody) -> dict[str, float]:
    return {
        "inside": 100 * dressed.collisions.share,
        "of_it_where_the_body_overlaps_itself": 100 * dressed.collisions.overlap_share,
    }
