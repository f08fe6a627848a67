"""AMASS: npz of SMPL, SMPL-H or SMPL-X poses  ->  Motion on a generic SMPL skeleton, metres, z up.

The body's shape is not in the pose, and SMPL's own rest joints need its licensed model: the rest pose here is a T-pose
of average proportions.  Retargeting uses its directions only, and its leg length as the scale of the path.
"""

import math
import zipfile
import zlib
from pathlib import Path

import numpy as np
import torch

from workbench.body.skeleton import Skeleton
from workbench.geometry.rotations import axis_angle_to_matrix
from workbench.motion import Motion
from workbench.retargeting import Y_UP_FROM_Z_UP, reframed_skeleton

_BODY = 22
POSE_WIDTHS = {66: "body only", 72: "SMPL", 156: "SMPL-H", 165: "SMPL-X"}
"""Numbers a frame of `poses`; the first 66 are the 22 body joints in all of them."""

_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate", "mocap_fps", "fps")

# Ours, not SMPL's: left side and middle of a T-pose, y up, facing +z, metres; legs straight down, arms straight out.
_T_POSE: dict[str, tuple[str | None, tuple[float, float, float]]] = {
    "pelvis": (None, (0.0, 0.0, 0.0)),
    "left_hip": ("pelvis", (0.09, -0.09, 0.0)),
    "right_hip": ("pelvis", (-0.09, -0.09, 0.0)),
    "spine1": ("pelvis", (0.0, 0.11, 0.0)),
    "left_knee": ("left_hip", (0.09, -0.49, 0.0)),
    "right_knee": ("right_hip", (-0.09, -0.49, 0.0)),
    "spine2": ("spine1", (0.0, 0.24, 0.0)),
    "left_ankle": ("left_knee", (0.09, -0.90, 0.0)),
    "right_ankle": ("right_knee", (-0.09, -0.90, 0.0)),
    "spine3": ("spine2", (0.0, 0.30, 0.0)),
    "left_foot": ("left_ankle", (0.10, -0.96, 0.13)),
    "right_foot": ("right_ankle", (-0.10, -0.96, 0.13)),
    "neck": ("spine3", (0.0, 0.50, 0.0)),
    "left_collar": ("spine3", (0.07, 0.42, 0.0)),
    "right_collar": ("spine3", (-0.07, 0.42, 0.0)),
    "head": ("neck", (0.0, 0.60, 0.03)),
    "left_shoulder": ("left_collar", (0.18, 0.44, 0.0)),
    "right_shoulder": ("right_collar", (-0.18, 0.44, 0.0)),
    "left_elbow": ("left_shoulder", (0.44, 0.44, 0.0)),
    "right_elbow": ("right_shoulder", (-0.44, 0.44, 0.0)),
    "left_wrist": ("left_elbow", (0.69, 0.44, 0.0)),
    "right_wrist": ("right_elbow", (-0.69, 0.44, 0.0)),
}


def smpl_t_pose() -> Skeleton:
    """The 22 body joints of SMPL, SMPL-H and SMPL-X in a generic T-pose: metres, y up, facing +z."""
    names = tuple(_T_POSE)
    parents = tuple(-1 if parent is None else names.index(parent) for parent, _ in _T_POSE.values())
    return Skeleton(names, parents, torch.tensor([place for _, place in _T_POSE.values()]))


def read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an npz motion file but those of Python objects (labels in some AMASS files): none is unpickled.

    Raises FileNotFoundError, or ValueError naming the file when it is truncated or no npz.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"no motion file at {path}")
    arrays: dict[str, np.ndarray] = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            if isinstance(archive, np.ndarray):
                raise ValueError("it holds one bare array")
            for key in archive.files:
                try:
                    arrays[key] = archive[key]
                except ValueError as error:
                    if "Object arrays" not in str(error):
                        raise
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise ValueError(
            f"{path} is not readable as an npz motion (truncated, or of another kind): {reason}"
        ) from error
    return arrays


def is_amass(arrays: dict[str, np.ndarray]) -> bool:
    """Do these arrays look like an AMASS motion?"""
    return "poses" in arrays or {"root_orient", "pose_body"} <= arrays.keys()


def read_amass(path: str | Path, *, fps: float | None = None) -> Motion:
    """The body motion of an AMASS npz: `poses` (T, 66 | 72 | 156 | 165) axis-angle, `trans` (T,3), its frame rate.

    The result is on the 22 joints of `smpl_t_pose`, turned to z up, facing -y, as AMASS has its world.  fps overrides
    the file's rate.  Hands, face, betas, gender and dmpls are left out.
    Raises FileNotFoundError, or ValueError naming the file and what is wrong with it.
    """
    return amass_motion(read_arrays(path), path, fps=fps)


def amass_motion(
    arrays: dict[str, np.ndarray], path: str | Path, *, fps: float | None = None, rest: Skeleton | None = None
) -> Motion:
    """`read_amass` for arrays that are read already; path is for messages and the motion's name.

    rest: the 22 joints of the SMPL body in hand, in its own axes (y up, facing +z), instead of `smpl_t_pose`.
    """
    poses, trans, rate = _body_poses(arrays, path), _path(arrays, path), _rate(arrays, path, fps)
    if len(poses) != len(trans):
        raise ValueError(f"{path}: poses have {len(poses)} frames, but trans has {len(trans)}")
    if len(poses) == 0:
        raise ValueError(f"{path}: a motion needs at least one frame, but poses are {poses.shape}")
    for key, values in (("poses", poses), ("trans", trans)):
        broken = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(broken):
            raise ValueError(
                f"{path}: {key} must be finite, but frame {broken[0]} holds NaN or infinity; cut such frames out"
            )
    rest = rest or smpl_t_pose()
    turn = Y_UP_FROM_Z_UP.mT  # SMPL's rest is y up, AMASS' world z up
    local = axis_angle_to_matrix(torch.from_numpy(poses).unflatten(1, (_BODY, 3)))
    rotations = turn @ local @ turn.mT
    rotations[:, 0] = local[:, 0] @ turn.mT  # the root goes from the turned rest to the world as it is
    root = rest.rest_joints[0].double()  # at root + trans in the world, turned with the rest pose in the skeleton
    return Motion(
        rotations=rotations.float(),
        translation=(torch.from_numpy(trans) + root - turn @ root).float(),
        fps=rate,
        skeleton=reframed_skeleton(rest, turn),
        name=Path(path).stem,
    )


def _body_poses(arrays: dict[str, np.ndarray], path: str | Path) -> np.ndarray:
    """(T, 66) float64."""
    if "poses" in arrays:
        poses = _real(arrays, "poses", path)
    elif is_amass(arrays):
        poses = np.concatenate([_real(arrays, "root_orient", path), _real(arrays, "pose_body", path)], axis=-1)
    else:
        raise ValueError(
            f"{path} holds no motion: it has neither poses nor root_orient and pose_body, "
            f"but {', '.join(sorted(arrays)) or 'nothing'}"
        )
    if poses.ndim == 3 and poses.shape[-1] == 3:
        poses = poses.reshape(len(poses), -1)
    if poses.ndim != 2 or poses.shape[1] not in POSE_WIDTHS:
        known = ", ".join(f"{width} ({what})" for width, what in POSE_WIDTHS.items())
        raise ValueError(
            f"{path}: poses must be (T, W) axis-angle numbers with W one of {known}, but are {poses.shape}"
        )
    return poses[:, : 3 * _BODY]


def _path(arrays: dict[str, np.ndarray], path: str | Path) -> np.ndarray:
    if "trans" not in arrays:
        raise ValueError(f"{path} lacks trans (T, 3), the path of the body")
    trans = _real(arrays, "trans", path)
    if trans.ndim != 2 or trans.shape[1] != 3:
        raise ValueError(f"{path}: trans must be (T, 3), but is {trans.shape}")
    return trans


def _rate(arrays: dict[str, np.ndarray], path: str | Path, fps: float | None) -> float:
    key = next((key for key in _RATE_KEYS if key in arrays), None)
    if fps is None and key is None:
        raise ValueError(f"{path} says no frame rate ({', '.join(_RATE_KEYS)}); pass fps=...")
    rate = fps if fps is not None else _number(arrays, str(key), path)
    if not (math.isfinite(rate) and rate > 0):
        source = "fps" if fps is not None else key
        raise ValueError(f"{path}: {source} must be a number above 0, but is {rate}")
    return float(rate)


def _number(arrays: dict[str, np.ndarray], key: str, path: str | Path) -> float:
    values = _real(arrays, key, path)
    if values.size != 1:
        raise ValueError(f"{path}: {key} must be one number, but is {values.shape}")
    return float(values.reshape(()))


def _real(arrays: dict[str, np.ndarray], key: str, path: str | Path) -> np.ndarray:
    if not np.issubdtype(arrays[key].dtype, np.number) or np.iscomplexobj(arrays[key]):
        raise ValueError(f"{path}: {key} must hold numbers, but holds {arrays[key].dtype}")
    return arrays[key].astype(np.float64)
