"""Poses that no body can take: told in words, and bridged.  motion on a body's skeleton -> a line; a motion.

Captures have errors: in one well-known clip the pelvis turns about for a fifth of a second while legs and chest stay
where they were.  A body is folded in two there, and no garment can be right.
"""

import logging
import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from workbench.geometry.rotations import rotation_angle
from workbench.motion import Motion
from workbench.rig_names import roles_of

log = logging.getLogger(__name__)

SPINE = ("LowerBack", "Spine", "Spine1")
MOST_TURN = 100.0  # degrees, in one joint: some whole spines do that
STILL_WRONG = 70.0  # degrees: frames beside such ones belong to the same error down to here; ours
LONGEST_BRIDGE = 1.0  # seconds: who can say what happened in more?
TOLD_RUNS = 3


def doubtful_spine(motion: Motion) -> str | None:
    """Where a joint of the spine is turned farther than MOST_TURN, with the frames."""
    found = []
    for role, turn in _spine_turns(motion).items():
        frames = torch.nonzero(turn > MOST_TURN)[:, 0].tolist()
        if frames:
            found.append(f"{role} is turned by up to {float(turn.max()):.0f} degrees in frames {_told(frames)}")
    return f"{'; '.join(found)} of {len(motion)}: an error of the capture?" if found else None


def mended(motion: Motion) -> Motion:
    """The motion with such frames, and those beside them down to STILL_WRONG, bridged from the poses around.

    All joints and the path are bridged; a run at an end takes the pose next to it.  Runs of more than LONGEST_BRIDGE
    stay as they are, with a warning in the log.  Raises ValueError where no frame is left to bridge from.
    """
    wrong = _wrong(motion)
    for run in _runs(torch.nonzero(wrong)[:, 0].tolist()):
        if len(run) > LONGEST_BRIDGE * motion.fps:
            log.warning("motion %r: frames %d-%d are too many to bridge", motion.name, run[0], run[-1])
            wrong[run] = False
    if wrong.all():
        raise ValueError(f"motion {motion.name!r}: every frame has a spine that no one has; nothing to bridge from")
    if not wrong.any():
        return motion
    kept = torch.nonzero(~wrong)[:, 0]
    whole = replace(motion, rotations=motion.rotations[kept], translation=motion.translation[kept])
    log.info("motion %r: %d of %d frames bridged", motion.name, int(wrong.sum()), len(motion))
    place = np.interp(np.arange(len(motion)), kept.numpy(), np.arange(len(kept)))
    return whole.between_frames(torch.from_numpy(place))


def _spine_turns(motion: Motion) -> dict[str, Float[Tensor, "T"]]:
    """Of each joint of the spine, degrees."""
    roles = roles_of(motion.skeleton)
    present = [role for role in SPINE if role in roles]
    return {role: rotation_angle(motion.rotations[:, roles[role]]) * 180 / math.pi for role in present}


def _wrong(motion: Motion) -> Bool[Tensor, "T"]:
    wrong = torch.zeros(len(motion), dtype=torch.bool)
    for turn in _spine_turns(motion).values():
        for run in _runs(torch.nonzero(turn > STILL_WRONG)[:, 0].tolist()):
            wrong[run] |= bool((turn[run] > MOST_TURN).any())
    return wrong


def _runs(frames: list[int]) -> list[list[int]]:
    """Frames that follow one another, together."""
    if not frames:
        return []
    starts = [k for k, frame in enumerate(frames) if k == 0 or frame != frames[k - 1] + 1]
    return [frames[a:b] for a, b in zip(starts, [*starts[1:], None], strict=True)]


def _told(frames: list[int]) -> str:
    """'3-5, 9', the first TOLD_RUNS runs of them."""
    runs = _runs(frames)
    told = [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:TOLD_RUNS]]
    return ", ".join([*told, *(["..."] if len(runs) > TOLD_RUNS else [])])
