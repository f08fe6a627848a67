"""Files of others, one format a module, and load_motion: any motion file -> Motion on a body's skeleton."""

import logging
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import torch

from workbench.body.model import Body
from workbench.body.skeleton import Skeleton
from workbench.formats.amass import amass_motion, is_amass, read_arrays, smpl_t_pose
from workbench.formats.bvh import read_bvh
from workbench.formats.deepmimic import is_deepmimic, read_deepmimic
from workbench.formats.motion_notes import notes_beside
from workbench.motion import Motion, is_own_motion
from workbench.motion_doubts import doubtful_spine
from workbench.retargeting import RetargetConfig, grounded, retarget

__all__ = ["load_motion", "motion_files"]

log = logging.getLogger(__name__)
SUFFIXES = (".bvh", ".npz", ".txt")


def motion_files(folder: Path | None = None) -> list[Path]:
    """The motion files in a folder, sorted; without one, those that ship (generated, not yet cleared).

    Raises ValueError where the folder has none.
    """
    folder = Path(str(resources.files("workbench") / "assets" / "motions")) if folder is None else folder
    files = sorted(path for path in folder.glob("*") if path.suffix.lower() in SUFFIXES and path.is_file())
    files = [path for path in files if path.suffix.lower() != ".txt" or is_deepmimic(path)]
    if not files:
        raise ValueError(f"no motion files ({', '.join(SUFFIXES)}) in {folder}")
    return files


def load_motion(
    path: str | Path,
    body: Body,
    *,
    fps: float | None = None,
    mapping: Mapping[str, str] | None = None,
    config: RetargetConfig | None = None,
) -> Motion:
    """Read a motion file (BVH, AMASS npz, DeepMimic txt, our own npz), carry it over to the body, put it on the floor
    at z = 0.

    Our own files for this very body come as they were saved.

    The frame rate is that of the file; fps says what it really is where the file is wrong (it does not resample:
    `Motion.resampled` does).  mapping {role: joint} names joints that no known convention has (see `rig_names`).
    What is not said here is taken from a note beside the file, where there is one (see `motion_notes`).
    Raises FileNotFoundError, or ValueError naming the file and what is wrong with it.
    """
    path = Path(path)
    kind = path.suffix.lower()
    notes = notes_beside(path)
    fps, mapping = notes.fps if fps is None else fps, notes.joints if mapping is None else mapping
    if kind == ".bvh":
        motion = read_bvh(path, fps=fps)
    elif kind == ".txt" and (not path.is_file() or is_deepmimic(path)):
        motion = read_deepmimic(path, fps=fps)
    elif kind == ".npz":
        arrays = read_arrays(path)
        if is_own_motion(arrays):
            motion = Motion.load(path) if fps is None else Motion.load(path).at_rate(fps)
            if _is_made_for(motion, body):
                return Motion(motion.rotations, motion.translation, motion.fps, body.skeleton, motion.name)
        elif is_amass(arrays):
            motion = amass_motion(arrays, path, fps=fps, rest=_smpl_rest(body.skeleton))
        else:
            raise ValueError(
                f"{path} holds no motion: it is neither ours (no entry 'format') nor AMASS (no 'poses'), "
                f"but has {', '.join(sorted(arrays)) or 'nothing'}"
            )
    else:
        raise ValueError(
            f"{path}: motions are read from .bvh (any known rig), .npz (AMASS, ours) and .txt (DeepMimic) files, "
            f"not {kind!r}"
        )
    try:
        carried = grounded(retarget(motion, body.skeleton, mapping=mapping, config=config), body)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    doubt = doubtful_spine(carried)
    if doubt is not None:
        log.warning("%s: %s (`workbench tryon --mend` bridges such frames)", path, doubt)
    return carried


def _is_made_for(motion: Motion, body: Body) -> bool:
    """Same tree and rest joints to a millimetre: nothing to retarget."""
    skeleton = body.skeleton
    return motion.skeleton.same_tree(skeleton) and torch.allclose(
        motion.skeleton.rest_joints, skeleton.rest_joints, rtol=0, atol=1e-3
    )


def _smpl_rest(skeleton: Skeleton) -> Skeleton | None:
    """The body's own rest pose if it is an SMPL body: then AMASS poses are about it and carry over unchanged."""
    generic = smpl_t_pose()
    count = len(generic)
    if skeleton.names[:count] != generic.names or skeleton.parents[:count] != generic.parents:
        return None
    return Skeleton(generic.names, generic.parents, skeleton.rest_joints[:count])
