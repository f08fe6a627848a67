"""DeepMimic's motions (.txt): JSON of time, root and joint rotations  ->  Motion on its humanoid, metres, y up.

A frame has 44 numbers: its duration (frames of unequal ones are brought onto even times); the root's place and
rotation; chest, neck, then right hip, knee, ankle, shoulder and elbow, then those of the left.  Knees and elbows are
angles about z, all else quaternions (w first; some files have them as short as 0.58).  At rest the humanoid stands
facing +x with hanging arms.  One joint bends its whole spine.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from workbench.body.skeleton import Skeleton
from workbench.geometry.rotations import axis_angle_to_matrix, quaternion_to_matrix
from workbench.motion import Motion

WIDTH = 44
UNEVEN = 0.01  # share by which frames may last longer or shorter than others and still count as even
LONGEST = 20.0  # times what is usual that a frame may last
SHORTEST = 0.1  # length of a quaternion that still says a rotation
# The right side and the middle, about as its humanoid is built; roles of `rig_names`.  Hands and feet end somewhere.
_REST: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "Hips": (None, (0.0, 0.0, 0.0)),
    "LowerBack": ("Hips", (0.0, 0.236, 0.0)),
    "Neck": ("LowerBack", (0.0, 0.224, 0.0)),
    "Head": ("Neck", (0.0, 0.1, 0.0)),
    "RightUpLeg": ("Hips", (0.0, 0.0, 0.085)),
    "RightLeg": ("RightUpLeg", (0.0, -0.422, 0.0)),
    "RightFoot": ("RightLeg", (0.0, -0.410, 0.0)),
    "RightToeBase": ("RightFoot", (0.12, -0.05, 0.0)),
    "RightArm": ("LowerBack", (-0.024, 0.2435, 0.183)),
    "RightForeArm": ("RightArm", (0.0, -0.275, 0.0)),
    "RightHand": ("RightForeArm", (0.0, -0.259, 0.0)),
}
_QUATERNIONS = {"Hips": 4, "LowerBack": 8, "Neck": 12, "RightUpLeg": 16, "RightFoot": 21, "RightArm": 25}
_QUATERNIONS |= {"LeftUpLeg": 30, "LeftFoot": 35, "LeftArm": 39}
_ANGLES = {"RightLeg": 20, "RightForeArm": 29, "LeftLeg": 34, "LeftForeArm": 43}  # about z


def humanoid() -> Skeleton:
    """Its rest pose: metres, y up, facing +x."""
    rest = dict(_REST)
    for name, (parent, (x, y, z)) in _REST.items():
        if name.startswith("Right"):
            rest[name.replace("Right", "Left")] = (parent and parent.replace("Right", "Left"), (x, y, -z))
    names, places = tuple(rest), {}
    for name, (parent, offset) in rest.items():
        places[name] = np.add(places[parent], offset) if parent else np.array(offset)
    parents = tuple(names.index(parent) if parent else -1 for parent, _ in rest.values())
    return Skeleton(names, parents, torch.from_numpy(np.stack(list(places.values()))).float())


def is_deepmimic(path: Path) -> bool:
    """Does this text file look like one of its motions?  Others (a readme) are no motions at all."""
    with open(path, "rb") as file:
        start = file.read(4096)
    return start.lstrip().startswith(b"{") and b'"Frames"' in start


def read_deepmimic(path: str | Path, *, fps: float | None = None) -> Motion:
    """The motion of a file, in its axes; fps overrides the duration of its frames.

    Raises FileNotFoundError, or ValueError naming the file and what is wrong with it.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no motion file at {path}")
    frames = _frames(path)
    skeleton = humanoid()
    rotations = torch.eye(3, dtype=torch.float64).repeat(len(frames), len(skeleton), 1, 1)
    for joint, first in _QUATERNIONS.items():
        quaternions = torch.from_numpy(frames[:, first : first + 4])
        short = torch.nonzero(quaternions.norm(dim=1) < SHORTEST)[:, 0]
        if len(short):
            raise ValueError(f"{path}: the rotation of {joint} in frame {int(short[0])} is no quaternion")
        rotations[:, skeleton.index(joint)] = quaternion_to_matrix(quaternions)
    for joint, column in _ANGLES.items():
        turns = torch.zeros(len(frames), 3, dtype=torch.float64)
        turns[:, 2] = torch.from_numpy(frames[:, column])
        rotations[:, skeleton.index(joint)] = axis_angle_to_matrix(turns)
    translation = torch.from_numpy(frames[:, 1:4]).float()
    if fps is not None:
        return Motion(rotations.float(), translation, fps, skeleton, path.stem)
    starts, usual = _times(frames[:, 0], path)
    motion = Motion(rotations.float(), translation, 1 / usual, skeleton, path.stem)
    if np.allclose(starts, usual * np.arange(len(starts)), rtol=UNEVEN, atol=0):
        return motion
    even = np.arange(0, starts[-1] + 1e-6 * usual, usual)
    return motion.between_frames(torch.from_numpy(np.interp(even, starts, np.arange(len(starts)))))


def _frames(path: Path) -> Float[np.ndarray, f"T {WIDTH}"]:
    try:
        found: Any = json.loads(path.read_text(encoding="utf-8"))
        frames = np.array(found["Frames"], dtype=np.float64)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            f"{path} is not readable as a motion of DeepMimic (truncated, or of another kind): {reason}"
        ) from error
    if frames.ndim != 2 or frames.shape[1] != WIDTH or not len(frames):
        raise ValueError(f"{path}: a humanoid of DeepMimic has frames of {WIDTH} numbers, but these are {frames.shape}")
    broken = np.flatnonzero(~np.isfinite(frames).all(axis=1))
    if len(broken):
        raise ValueError(f"{path}: frame {broken[0]} holds NaN or infinity; cut such frames out")
    return frames


def _times(durations: Float[np.ndarray, "T"], path: Path) -> tuple[Float[np.ndarray, "T"], float]:
    """When each frame begins, and how long one usually lasts, seconds.  The last one's duration leads nowhere."""
    lasting = durations[:-1] if len(durations) > 1 else durations
    usual = float(np.median(lasting))
    if not (usual > 0 and lasting.min() > 0 and lasting.max() < LONGEST * usual):
        raise ValueError(
            f"{path}: its frames last {lasting.min():g} to {lasting.max():g} s; say how many there are a second (fps)"
        )
    return np.concatenate([[0.0], np.cumsum(durations[:-1])]), usual
