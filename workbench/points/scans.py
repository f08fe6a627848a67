"""Scans of an outfit in motion, what POP learns from.  file <-> points (T,N,3), normals (T,N,3), theta, beta.

In the pelvis frame (uv_position_map.py).  Storage: points in steps of the sequence's box over 2^16 (0.02 mm), normals
in 127ths: 9 bytes a point.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int8, UInt16
from numpy import ndarray
from torch import Tensor

from workbench.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from workbench.npz import read_npz
from workbench.store import atomic_write

FORMAT = "scan-sequence-1"
STORED = ("format", "points", "normals", "low", "step", "rotations", "betas", "fps", "names")
TICKS = 2**16 - 1


@dataclass(frozen=True, eq=False)
class ScanFrame:
    """One scan: metres, unit normals, pelvis frame."""

    points: Float[Tensor, "N 3"]
    normals: Float[Tensor, "N 3"]

    def to(self, device: torch.device) -> "ScanFrame":
        """The same on a device."""
        return ScanFrame(self.points.to(device), self.normals.to(device))


@dataclass(frozen=True, eq=False)
class ScanSequence:
    """Scans of one outfit on one body shape through one motion; `frame(t)` gives one of them."""

    outfit: str
    motion: str
    ticks: UInt16[ndarray, "T N 3"]
    normal_ticks: Int8[ndarray, "_ N 3"]  # _ is T, whose agreement is checked below
    low: Float[ndarray, "3"]  # metres of tick 0 ...
    step: float  # ... and of one tick
    rotations: Float[Tensor, "_ J 3 3"]  # theta; the heading may be anything
    betas: Float[Tensor, " K"]
    fps: float

    def __post_init__(self) -> None:
        for name in ("normal_ticks", "rotations"):
            got = len(getattr(self, name))
            if got != len(self):
                raise ValueError(f"{name} has {got} frames, but the scans have {len(self)}")

    def __len__(self) -> int:
        return len(self.ticks)

    def frame(self, t: int) -> ScanFrame:
        """Frame t, counted from 0."""
        points = torch.from_numpy(
            self.ticks[t].astype(np.float32) * np.float32(self.step) + self.low.astype(np.float32)
        )
        normals = torch.from_numpy(self.normal_ticks[t].astype(np.float32))
        return ScanFrame(points, torch.nn.functional.normalize(normals, dim=-1))

    def every(self, stride: int) -> "ScanSequence":
        """Every stride-th frame: 1/2, 1/4, 1/8 of the data."""
        if stride < 1:
            raise ValueError(f"stride is {stride}; expected 1 or more")
        part = slice(None, None, stride)
        return ScanSequence(
            self.outfit,
            self.motion,
            self.ticks[part],
            self.normal_ticks[part],
            self.low,
            self.step,
            self.rotations[part],
            self.betas,
            self.fps / stride,
        )

    def first(self, frames: int) -> "ScanSequence":
        """The first so many frames, or all there are."""
        if frames < 1:
            raise ValueError(f"{frames} frames are asked for; expected 1 or more")
        return replace(
            self,
            ticks=self.ticks[:frames],
            normal_ticks=self.normal_ticks[:frames],
            rotations=self.rotations[:frames],
        )

    def thinned(self, points: int) -> "ScanSequence":
        """The first so many points of each scan, a random part of it, as scans come in no order."""
        there = self.ticks.shape[1]
        if not 1 <= points <= there:
            raise ValueError(f"{points} points are asked for of scans of {there}; expected 1 to {there}")
        return replace(self, ticks=self.ticks[:, :points], normal_ticks=self.normal_ticks[:, :points])

    @staticmethod
    def of(
        frames: Sequence[ScanFrame],
        *,
        outfit: str,
        motion: str,
        rotations: Float[Tensor, "T J 3 3"],
        betas: Float[Tensor, " K"],
        fps: float,
    ) -> "ScanSequence":
        """Pack frames that have the same number of points each."""
        points = torch.stack([frame.points for frame in frames]).numpy()
        normals = torch.stack([frame.normals for frame in frames]).numpy()
        low = points.min((0, 1)).astype(np.float64)
        step = float((points.max((0, 1)) - low).max()) / TICKS
        return ScanSequence(
            outfit=outfit,
            motion=motion,
            ticks=np.clip(np.rint((points - low) / step), 0, TICKS).astype(np.uint16),
            normal_ticks=np.rint(normals * 127).astype(np.int8),
            low=low,
            step=step,
            rotations=rotations,
            betas=betas,
            fps=fps,
        )

    def save(self, path: str | Path) -> None:
        """Own npz, written whole or not at all."""
        with atomic_write(path) as part:
            np.savez_compressed(
                part,
                format=np.array(FORMAT),
                points=self.ticks,
                normals=self.normal_ticks,
                low=self.low,
                step=np.array(self.step),
                rotations=matrix_to_quaternion(self.rotations).numpy().astype(np.float32),
                betas=self.betas.numpy(),
                fps=np.array(self.fps),
                names=np.array([self.outfit, self.motion]),
            )

    @staticmethod
    def load(path: str | Path) -> "ScanSequence":
        """Raises FileNotFoundError, or ValueError for a file of another kind or version."""
        arrays = read_npz(path, "a scan sequence", required=STORED)
        if str(arrays["format"]) != FORMAT:
            raise ValueError(f"{path} has format {str(arrays['format'])!r}; expected {FORMAT!r}")
        outfit, motion = (str(name) for name in arrays["names"])
        return ScanSequence(
            outfit=outfit,
            motion=motion,
            ticks=arrays["points"],
            normal_ticks=arrays["normals"],
            low=arrays["low"],
            step=float(arrays["step"]),
            rotations=quaternion_to_matrix(torch.from_numpy(arrays["rotations"])),
            betas=torch.from_numpy(arrays["betas"]).float(),
            fps=float(arrays["fps"]),
        )


def load_scans(folder: str | Path) -> list[ScanSequence]:
    """Every scan sequence of a folder, by file name.  ValueError where there is none."""
    paths = sorted(Path(folder).glob("*.npz"))
    if not paths:
        raise ValueError(f"no scan sequences (*.npz) in {folder}; make them with `python -m assets_gen scans`")
    return [ScanSequence.load(path) for path in paths]


def outfits_of(scans: Sequence[ScanSequence]) -> tuple[str, ...]:
    """The names of the outfits, sorted: their order is that of the geometry features."""
    return tuple(sorted({scan.outfit for scan in scans}))
