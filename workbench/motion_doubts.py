"""Poses that no body can take, told in words.  motion on a body's skeleton -> a line, or None.

Captures have errors: in one well-known clip the pelvis turns about for a fifth of a second while legs and chest stay
where they were.  A body is folded in two there, and no garment can be right.
"""

import math

import torch

from workbench.geometry.rotations import rotation_angle
from workbench.motion import Motion
from workbench.rig_names import roles_of

SPINE = ("LowerBack", "Spine", "Spine1")
MOST_TURN = 100.0  # degrees, in one joint: some whole spines do that
TOLD_RUNS = 3


def doubtful_spine(motion: Motion) -> str | None:
    """Where a joint of the spine is turned farther than MOST_TURN, with the frames."""
    roles = roles_of(motion.skeleton)
    found = []
    for role in (role for role in SPINE if role in roles):
        turn = rotation_angle(motion.rotations[:, roles[role]]) * 180 / math.pi
        frames = torch.nonzero(turn > MOST_TURN)[:, 0].tolist()
        if frames:
            found.append(f"{role} is turned by up to {float(turn.max()):.0f} degrees in frames {_runs(frames)}")
    return f"{'; '.join(found)} of {len(motion)}: an error of the capture?" if found else None


def _runs(frames: list[int]) -> str:
    """'3-5, 9', the first TOLD_RUNS runs of them."""
    starts = [k for k, frame in enumerate(frames) if k == 0 or frame != frames[k - 1] + 1]
    runs = [frames[a:b] for a, b in zip(starts, [*starts[1:], None], strict=True)]
    told = [f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs[:TOLD_RUNS]]
    return ", ".join([*told, *(["..."] if len(runs) > TOLD_RUNS else [])])
