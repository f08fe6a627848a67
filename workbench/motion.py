"""Motion: theta over time.  rotations (T,J,3,3), translation (T,3), fps  ->  resampled, clipped, cleared, on disk."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skeleton import Skeleton
from workbench.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix, slerp
from workbench.npz import read_npz
from workbench.store import atomic_write

_FORMAT = "workbench-motion-1"
_ARRAYS = ("format", "quaternions", "translation", "fps", "joint_names", "parents", "rest_joints", "name")


@dataclass(frozen=True, eq=False)
class Motion:
    """A moving skeleton: one local rotation a joint and frame, and the root joint's path.

    rotations (T,J,3,3): local, relative to the rest pose of `skeleton`.  translation (T,3): the root joint is at
    rest_joints[0] + translation.  fps: frames a second.  Metres, z up, facing -y (a motion that `formats` has read but
    not retargeted is still in the units and axes of its file).
    Raises ValueError for wrong shapes, NaN, matrices that are no rotations, no frame at all, fps <= 0.
    """

    rotations: Float[Tensor, "T J 3 3"]
    translation: Float[Tensor, "T 3"]
    fps: float
    skeleton: Skeleton
    name: str = ""

    def __post_init__(self) -> None:
        _check(self)

    def __len__(self) -> int:
        return self.rotations.shape[0]

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last."""
        return (len(self) - 1) / self.fps

    def resampled(self, fps: float = 30.0) -> "Motion":
        """The same motion at times 0, 1/fps, 2/fps, ...: slerp for rotations, linear for the path.

        Time is kept true and never extrapolated: a last frame that lies between two new ones is left out, one that
        lies on the grid (and any other frame that does) is copied exactly.
        """
        if not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"fps must be a number above 0, but got {fps}")
        frames = math.floor(self.duration * fps + 1e-6) + 1
        position = torch.arange(frames, dtype=torch.float64) * (self.fps / fps)
        # Rates such as 1 / 0.0083333 are printed short: a time this near a frame is that frame.
        nearest = position.round()
        position = torch.where((position - nearest).abs() < 1e-3, nearest, position).clamp(max=len(self) - 1)
        return replace(self.between_frames(position), fps=float(fps))

    def between_frames(self, position: Float[Tensor, "S"]) -> "Motion":
        """The motion at S places 0 <= position <= T - 1 between its frames, as frames of the same rate."""
        before = position.floor().long()
        after = (before + 1).clamp(max=len(self) - 1)
        fraction = position - before
        between = fraction > 0
        rotations, translation = self.rotations[before], self.translation[before]
        if between.any():
            before, after, fraction = before[between], after[between], fraction[between]
            q0 = matrix_to_quaternion(self.rotations[before].double())
            q1 = matrix_to_quaternion(self.rotations[after].double())
            turned = quaternion_to_matrix(slerp(q0, q1, fraction[:, None].expand(q0.shape[:-1])))
            rotations[between] = turned.to(rotations.dtype)
            moved = torch.lerp(self.translation[before].double(), self.translation[after].double(), fraction[:, None])
            translation[between] = moved.to(translation.dtype)
        return replace(self, rotations=rotations, translation=translation)

    def at_rate(self, fps: float) -> "Motion":
        """The same frames played at another rate, for files whose rate is wrong."""
        return replace(self, fps=float(fps))

    def clip(self, start: int = 0, stop: int | None = None) -> "Motion":
        """Frames start, start + 1, ..., stop - 1 (to the end without `stop`)."""
        stop = len(self) if stop is None else stop
        if not 0 <= start < stop <= len(self):
            raise ValueError(
                f"a clip needs 0 <= start < stop <= {len(self)} (the frames), but got start {start}, stop {stop}"
            )
        return replace(self, rotations=self.rotations[start:stop], translation=self.translation[start:stop])

    def cleared(self, body: Body, **options: Any) -> "Motion":
        """The nearest motion that keeps the arms off the body; see `workbench.motion_clearing.clear`."""
        from workbench.motion_clearing import clear  # it builds on Motion

        return clear(self, body, **options)

    def save(self, path: str | Path) -> None:
        """Write a compressed npz (quaternions and path in float32), whole or not at all."""
        with atomic_write(path) as part:
            np.savez_compressed(
                part,
                format=np.array(_FORMAT),
                quaternions=matrix_to_quaternion(self.rotations.double()).numpy().astype(np.float32),
                translation=self.translation.numpy().astype(np.float32),
                fps=np.array(self.fps, dtype=np.float64),
                joint_names=np.array(self.skeleton.names),
                parents=np.array(self.skeleton.parents, dtype=np.int32),
                rest_joints=self.skeleton.rest_joints.numpy().astype(np.float32),
                name=np.array(self.name),
            )

    @staticmethod
    def load(path: str | Path) -> "Motion":
        """Read what `save` wrote.  Raises ValueError naming the file and what is wrong with it."""
        arrays = read_npz(path, "a motion of this package (load_motion reads those of others)", required=_ARRAYS)
        if not is_own_motion(arrays):
            raise ValueError(f"{path} is a motion of format {arrays['format']}, but this version reads {_FORMAT}")
        try:
            skeleton = Skeleton(
                names=tuple(str(name) for name in arrays["joint_names"]),
                parents=tuple(int(parent) for parent in arrays["parents"]),
                rest_joints=torch.from_numpy(arrays["rest_joints"].astype(np.float32)),
            )
            quaternions = torch.from_numpy(arrays["quaternions"].astype(np.float64))
            translation = torch.from_numpy(arrays["translation"].astype(np.float32))
            if quaternions.ndim != 3 or quaternions.shape[2] != 4:
                raise ValueError(f"quaternions must be (T, J, 4), but are {tuple(quaternions.shape)}")
            if tuple(translation.shape) != (len(quaternions), 3):
                raise ValueError(f"translation must be ({len(quaternions)}, 3), but is {tuple(translation.shape)}")
            return Motion(
                rotations=quaternion_to_matrix(quaternions).float(),
                translation=translation,
                fps=float(arrays["fps"]),
                skeleton=skeleton,
                name=str(arrays["name"]),
            )
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} is damaged: {error}") from error


def is_own_motion(arrays: Mapping[str, np.ndarray]) -> bool:
    """Are these the arrays of a file that `Motion.save` wrote?"""
    return str(arrays.get("format")) == _FORMAT


def _check(motion: Motion) -> None:
    rotations, translation, J = motion.rotations, motion.translation, len(motion.skeleton)
    if rotations.ndim != 4 or tuple(rotations.shape[1:]) != (J, 3, 3):
        raise ValueError(f"rotations must be (T, {J}, 3, 3) for this skeleton, but are {tuple(rotations.shape)}")
    if len(rotations) == 0:
        raise ValueError("a motion needs at least one frame, but got none")
    if tuple(translation.shape) != (len(rotations), 3):
        raise ValueError(f"translation must be ({len(rotations)}, 3), but is {tuple(translation.shape)}")
    if not (math.isfinite(motion.fps) and motion.fps > 0):
        raise ValueError(f"fps must be a number above 0, but got {motion.fps}")
    for what, values in (("rotations", rotations), ("translation", translation)):
        finite = torch.isfinite(values).flatten(1).all(1)
        if not finite.all():
            raise ValueError(
                f"{what} must be finite, but frame {int((~finite).nonzero()[0])} holds NaN or infinity; "
                f"cut such frames out"
            )
    identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    departure = (rotations.mT @ rotations - identity).abs().amax((-2, -1))
    wrong = (departure > 1e-3) | (torch.linalg.det(rotations) < 0)
    if wrong.any():
        frame, joint = (int(i) for i in wrong.nonzero()[0])
        raise ValueError(
            f"rotations must be rotation matrices, but that of joint {motion.skeleton.names[joint]} in frame {frame} "
            f"is not (R^T R differs from I by {float(departure[frame, joint]):.3g}); "
            f"geometry.rotations.project_to_rotation mends drift"
        )
