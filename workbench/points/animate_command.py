"""`workbench animate FIT --motion FILE --out DIR`: a fitted outfit through any motion, as points, surfels or meshes."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from workbench.body.model import Body
from workbench.formats import load_motion
from workbench.formats.gltf import GltfMesh, write_glb
from workbench.formats.mesh_sequence import MeshSequence, write_mesh
from workbench.formats.scans import Scan, write_scan
from workbench.motion import Motion
from workbench.points.dressing import Dresser
from workbench.points.fit_command import FITTED, model_file
from workbench.points.meshing import MeshingConfig, poisson_mesh
from workbench.points.scan_fitting import FittedOutfit, features_of
from workbench.points.scans import ScanFrame
from workbench.points.trained_points import TrainedPoints
from workbench.points.uv_position_map import SurfaceQueries, atlas_of, scattered_queries
from workbench.points.worn_scan import betas_from_words
from workbench.store import atomic_write

log = logging.getLogger(__name__)

FPS = 30.0
SURFELS = 8000  # of the .glb: three vertices each, for every frame


@dataclass(frozen=True)
class AnimateConfig:
    """Move a fitted outfit (or one of the model's own) through a motion: points and normals of every frame."""

    # The folder that `workbench fit` wrote, or the name of an outfit that the model was trained on.
    fit: tyro.conf.Positional[str]
    # BVH, AMASS npz, DeepMimic txt, or our own npz.
    motion: Path
    # The folder that is written: points and normals of every frame, and what else is asked for.
    out: Path
    # The body's shape, with commas; that of the scan when absent.
    betas: str | None = None
    # How many points; every pixel of the query map that shows the body (40,898) when absent.
    points: int | None = None
    # Only the first frames.
    frames: int | None = None
    # Rotate arms and legs clear of the body first.
    clear: bool = True
    # Write a .ply a frame, too.
    ply: bool = False
    # Write an animated .glb of surfels, too.
    glb: bool = False
    # Write a mesh a frame by Poisson reconstruction, too (extra `meshing`).
    mesh: bool = False
    # A trained model; the one that ships when absent.
    model: Path | None = None
    # How points become meshes.
    meshing: MeshingConfig = MeshingConfig()
    # Of the places of the skin that are asked, where `points` says how many.
    seed: int = 0


@dataclass(frozen=True, eq=False)
class AnimatedPoints:
    """Clothes in motion, in the world."""

    points: Float[Tensor, "T N 3"]
    normals: Float[Tensor, "T N 3"]
    betas: Float[Tensor, " K"]
    fps: float

    def save(self, path: Path) -> None:
        """npz: points, normals, betas, fps."""
        arrays = {
            "points": self.points.numpy(),
            "normals": self.normals.numpy().astype(np.float16),
            "betas": self.betas.numpy(),
            "fps": np.array(self.fps),
        }
        with atomic_write(path) as part:
            np.savez_compressed(part, **arrays)


def run(config: AnimateConfig) -> list[Path]:
    """Write points.npz and what else is asked for; returns the paths.

    Raises FileNotFoundError, or ValueError for a fit, a motion or a model that cannot be used.
    """
    body = Body.default()
    trained = TrainedPoints.load(model_file(config.model), body)
    geometry, betas = worn_outfit(config.fit, trained, body)
    if config.betas is not None:
        betas = betas_from_words(config.betas, body)
    motion = prepared(config, body, betas)
    dresser = Dresser(trained.model, geometry, body, queries=_queries(config, body))
    frames = list(tqdm(dresser.animate(motion, betas), total=len(motion), desc="animate", mininterval=2.0))
    animated = AnimatedPoints(
        torch.stack([frame.points for frame in frames]),
        torch.stack([frame.normals for frame in frames]),
        betas,
        motion.fps,
    )
    config.out.mkdir(parents=True, exist_ok=True)
    animated.save(config.out / "points.npz")
    written = [config.out / "points.npz"]
    if config.ply:
        written.append(write_clouds(config.out / "ply", frames))
    if config.glb:
        write_glb(config.out / "surfels.glb", [GltfMesh(surfels(animated, SURFELS), double_sided=True)])
        written.append(config.out / "surfels.glb")
    if config.mesh:
        written.append(write_meshes(config.out / "meshes", frames, config.meshing))
    return written


def worn_outfit(name: str, trained: TrainedPoints, body: Body) -> tuple[Float[Tensor, "1 c H W"], Float[Tensor, " K"]]:
    """Smoothed features and shape of a fitted outfit (a folder, its .npz), or of one that the model was trained on."""
    path = Path(name)
    path = path / FITTED if path.is_dir() else path
    if path.suffix == ".npz":
        fitted = FittedOutfit.load(path)
        return features_of(trained.model, fitted), fitted.betas
    if path.name == FITTED or path.parent != Path("."):
        raise FileNotFoundError(f"no fitted outfit at {path}; `workbench fit SCAN --out DIR` writes one")
    with torch.no_grad():
        return trained.model.geometry(torch.tensor([trained.number_of(name)])), body.mean_shape()


def prepared(config: AnimateConfig, body: Body, betas: Float[Tensor, " K"]) -> Motion:
    """The motion on this body, at 30 frames a second, cut and cleared as asked."""
    motion = load_motion(config.motion, body)
    if abs(motion.fps - FPS) > 1e-3:
        motion = motion.resampled(FPS)
    if config.frames is not None:
        if config.frames < 1:
            raise ValueError(f"--frames {config.frames} leaves no frame; give 1 or more")
        last = min(config.frames, len(motion))
        motion = Motion(motion.rotations[:last], motion.translation[:last], motion.fps, motion.skeleton, motion.name)
    return motion.cleared(body, betas=betas) if config.clear else motion


def _queries(config: AnimateConfig, body: Body) -> SurfaceQueries:
    if config.points is None:
        return atlas_of(body, 256).queries
    if config.points < 1:
        raise ValueError(f"--points {config.points} asks for no point; give 1 or more")
    return scattered_queries(body, config.points, np.random.default_rng(config.seed))


def write_clouds(folder: Path, frames: Sequence[ScanFrame]) -> Path:
    """One .ply of points with normals a frame."""
    folder.mkdir(parents=True, exist_ok=True)
    for t, frame in enumerate(frames):
        write_scan(folder / f"frame_{t:04d}.ply", Scan(frame.points.numpy(), frame.normals.numpy()))
    return folder


def write_meshes(folder: Path, frames: Sequence[ScanFrame], config: MeshingConfig) -> Path:
    """One mesh a frame; their triangles differ from frame to frame."""
    folder.mkdir(parents=True, exist_ok=True)
    for t, frame in enumerate(tqdm(frames, desc="mesh", mininterval=2.0)):
        write_mesh(folder / f"frame_{t:04d}.ply", poisson_mesh(frame.points.numpy(), frame.normals.numpy(), config))
    return folder


def surfels(animated: AnimatedPoints, count: int) -> MeshSequence:
    """Every k-th point as a triangle across its normal, large enough to touch its neighbours.

    A triangle of circumradius R has the area 1.3 R^2; an average person's 2 m^2 and their clothes are covered twice.
    """
    stride = max(1, animated.points.shape[1] // count)
    x, n = animated.points[:, ::stride], animated.normals[:, ::stride]
    radius = (2 * 2.0 / (1.3 * x.shape[1])) ** 0.5
    helper = torch.where(n[..., :1].abs() < 0.9, torch.tensor([1.0, 0, 0]), torch.tensor([0, 1.0, 0]))
    a = torch.nn.functional.normalize(torch.linalg.cross(n, helper), dim=-1)
    b = torch.linalg.cross(n, a)
    angle = torch.arange(3) * (2 * torch.pi / 3)
    corners = x[..., None, :] + radius * (
        angle.cos()[:, None] * a[..., None, :] + angle.sin()[:, None] * b[..., None, :]
    )
    vertices = corners.flatten(1, 2).numpy()
    return MeshSequence(vertices, np.arange(vertices.shape[1]).reshape(-1, 3), animated.fps, "surfels")
