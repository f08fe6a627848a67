"""Sec. 4's data: what a scanner would see of simulated clothes.  sequences -> scans (T,40k,3) with normals.

A scan is the outer surface of body and clothes together: points uniform by area, kept where one of many rays gets away
without meeting anything.  Rays that fall steeply do not count for themselves (there is a floor, and a rig of cameras
sees no thigh from under a skirt), unless most of the half space is open, as under a lifted sole.
"""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from tqdm import tqdm

from workbench.body.model import Body
from workbench.collisions.sequences import SimulatedSequence
from workbench.formats.scans import SCAN_POINTS
from workbench.geometry.sampling import sample_surface
from workbench.geometry.warp_kernels import closest_points  # noqa: F401  starts Warp quietly
from workbench.points.scans import ScanFrame, ScanSequence
from workbench.points.uv_position_map import PelvisFrame, pelvis_frame

log = logging.getLogger(__name__)

RAYS = 96  # directions over the whole sphere; half of them leave a point outwards
STEEP = -0.5  # sine of the elevation below which a ray does not count for itself (30 degrees)
OPEN = 0.5  # share of the outward rays, by cosine, that makes a point visible whatever their elevation
LIFT = 5e-4  # metres off the surface where rays start; cloth keeps 3 to 5 mm to whatever is beneath it


@dataclass(frozen=True)
class ScansConfig:
    """Scan simulated sequences."""

    sequences: Path = Path("workbench/assets/sequences")
    """folder of simulated sequences (npz)"""
    out: Path = Path("out/scans")
    points: int = SCAN_POINTS
    stride: int = 1
    """every stride-th frame"""
    only: tuple[str, ...] = ()
    """names of sequences; all if none is given"""
    seed: int = 0


def run(config: ScansConfig) -> tuple[Path, ...]:
    """Scan every kept frame of every sequence; returns the files.  ValueError where there is nothing to scan."""
    sources = sorted(config.sequences.glob("*.npz"))
    chosen = [path for path in sources if not config.only or path.stem in config.only]
    missing = sorted(set(config.only) - {path.stem for path in sources})
    if missing or not chosen:
        raise ValueError(f"no simulated sequence {', '.join(missing) or '*.npz'} in {config.sequences}")
    body, written = Body.default(), []
    for path in chosen:
        scans = scan_sequence(SimulatedSequence.load(path), body, config)
        target = config.out / path.name
        scans.save(target)
        written.append(target)
        print(f"{target}: {len(scans)} scans of {scans.outfit}, {target.stat().st_size / 1e6:.1f} MB")
    return tuple(written)


def scan_sequence(sequence: SimulatedSequence, body: Body, config: ScansConfig) -> ScanSequence:
    """Scans of the frames that passed the simulation's judge, in the pelvis frame.  ValueError where none did."""
    kept = torch.nonzero(sequence.valid)[:: config.stride, 0]
    if not len(kept):
        raise ValueError(f"no frame of {sequence.garment_name} on {sequence.motion_name} was kept: nothing to scan")
    rotations = sequence.rotations[kept]
    generator = np.random.default_rng(config.seed)
    faces = [body.faces.numpy(), sequence.faces.numpy()]
    frames = []
    for t in tqdm(kept.tolist(), desc=f"{sequence.garment_name} {sequence.motion_name}", unit="scan"):
        surface = body.vertices(sequence.rotations[t], sequence.betas, sequence.translation[t]).numpy()
        seen = scan_surfaces([surface, sequence.garment[t].numpy()], faces, config.points, generator)
        frame = pelvis_frame(body, sequence.rotations[t], sequence.betas, sequence.translation[t])
        frames.append(_local(seen, frame))
    return ScanSequence.of(
        frames,
        outfit=sequence.garment_name,
        motion=sequence.motion_name,
        rotations=rotations,
        betas=sequence.betas,
        fps=sequence.fps / config.stride,
    )


def _local(scan: ScanFrame, frame: PelvisFrame) -> ScanFrame:
    return ScanFrame(frame.to_local(scan.points), scan.normals @ frame.rotation)


def scan_surfaces(
    vertices: Sequence[Float[np.ndarray, "_ 3"]],
    faces: Sequence[Int[np.ndarray, "_ 3"]],
    count: int,
    generator: np.random.Generator,
) -> ScanFrame:
    """`count` points of the outer surface of meshes together (body first, normals outwards), uniform by its area.

    Raises ValueError where nearly nothing is visible (meshes that are inside out).
    """
    first = np.cumsum([0, *[len(part) for part in vertices[:-1]]])
    everything = np.concatenate(vertices).astype(np.float32)
    triangles = np.concatenate([part + start for part, start in zip(faces, first, strict=True)])
    visible = Visibility(everything, triangles)
    points, normals, found, tried = [], [], 0, 0
    while found < count:
        samples = sample_surface(everything, triangles, int(1.3 * (count - found)) + 1000, generator)
        seen = visible(samples.point, samples.normal)
        points.append(samples.point[seen])
        normals.append(samples.normal[seen])
        found, tried = found + int(seen.sum()), tried + len(seen)
        if tried > 20 * count + 20_000:
            raise ValueError(
                f"only {found} of {tried} surface points are visible from outside; are the meshes inside out?"
            )
    return ScanFrame(
        torch.from_numpy(np.concatenate(points)[:count]), torch.from_numpy(np.concatenate(normals)[:count])
    )


class Visibility:
    """Which points of a set of triangles can be seen from outside."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rays: int = RAYS):
        self.mesh = wp.Mesh(
            points=wp.array(vertices, dtype=wp.vec3, device="cpu"),
            indices=wp.array(faces.astype(np.int32).ravel(), dtype=wp.int32, device="cpu"),
        )
        self.directions = sphere_directions(rays)

    def __call__(self, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, "N"]:
        """points on the surface, with its unit normals: only what lies on the normal's side is looked at."""
        seen = np.zeros(len(points), np.int32)
        start = (points + LIFT * normals).astype(np.float32)
        inputs = [
            self.mesh.id,
            wp.array(start, dtype=wp.vec3, device="cpu", copy=False),
            wp.array(normals.astype(np.float32), dtype=wp.vec3, device="cpu", copy=False),
            wp.array(self.directions, dtype=wp.vec3, device="cpu", copy=False),
            STEEP,
            OPEN,
            wp.array(seen, dtype=wp.int32, device="cpu", copy=False),
        ]
        wp.launch(_look_around, dim=len(points), inputs=inputs, device="cpu", record_tape=False)
        return seen.astype(bool)


def sphere_directions(count: int) -> Float[np.ndarray, "R 3"]:
    """Evenly spread unit vectors (a Fibonacci spiral), in an order that tries far-apart ones first."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    flat = np.sqrt(1 - z * z)
    directions = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], 1)
    return directions[np.argsort(k * 0.6180339887498949 % 1)].astype(np.float32)


@wp.kernel
def _look_around(
    mesh: wp.uint64,
    start: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    steep: float,
    enough: float,
    seen: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    open_share = float(0.0)  # noqa: UP018  a variable for Warp, not a constant
    total = float(0.0)  # noqa: UP018
    visible = int(0)  # noqa: UP018
    for k in range(directions.shape[0]):
        d = directions[k]
        cosine = wp.dot(d, normals[i])
        if cosine > 0.05 and visible == 0:
            total += cosine
            hit = wp.mesh_query_ray(mesh, start[i], d, 10.0)
            if not hit.result:  # pyright: ignore[reportAttributeAccessIssue]  (a Warp struct)
                open_share += cosine
                if d[2] > steep:
                    visible = 1
    if visible == 0 and open_share > enough * total:
        visible = 1
    seen[i] = visible
