"""Motions whose joints go their own ways.  motion, chance -> theta within anatomical limits; never simulated.

A choreography shares a bend among the joints of the spine, lets the clavicle follow the arm and keeps feet planted.
People, and the skeletons that motion capture is put on, share otherwise: here every joint that moves a garment wanders
by itself about what the motion asks of it; in half of the motions the joints of the spine wander as one, and the lowest
has the bend of all, as on skeletons that have no other.  Loosened motions of the families hardly bend a hip by 110
degrees, and those that do push the thigh into the belly; lifted ones do little else, and are for clearing.
"""

from dataclasses import replace

import numpy as np
import torch

from assets_gen.motions import joint_angles, joint_frames, limit_of, wander
from workbench.motion import Motion

# Degrees of (flexion, abduction, twist) to either side, ours.  Hips bend to a deep crouch, which no family reaches.
AMPLITUDES = {
    "LowerBack": (24, 20, 16),
    "Spine": (20, 20, 14),
    "Spine1": (20, 20, 14),
    "Neck": (16, 12, 15),
    "Neck1": (14, 10, 12),
    "Head": (12, 10, 12),
    "Shoulder": (14, 14, 2),
    "Arm": (30, 30, 40),
    "ForeArm": (35, 2, 40),
    "UpLeg": (70, 20, 25),
    "Leg": (45, 0, 0),
}
LIFTED = {"UpLeg": (70, 145), "Leg": (50, 150)}  # degrees of flexion that a lifted leg wanders between
SPINE = ("LowerBack", "Spine", "Spine1")
RATE = 0.6  # Hz: the fastest a joint wanders


def loosened(motion: Motion, rng: np.random.Generator) -> Motion:
    """The motion with every joint of AMPLITUDES wandering about its way, inside LIMITS; in half of all the spine
    wanders as one, and its bend is gathered in its lowest joint.

    Feet slide and may sink: for networks that see theta alone.
    """
    frames, angles = joint_frames(motion.skeleton), joint_angles(motion)
    times = np.arange(len(motion)) / motion.fps
    rotations = motion.rotations.clone()
    gather = rng.random() < 0.5
    of_spine = np.stack([wander(rng, times, -a, a, RATE) for a in AMPLITUDES[SPINE[0]]], axis=-1)
    for joint, usual in angles.items():
        amplitudes = AMPLITUDES.get(joint.removeprefix("Left").removeprefix("Right"))
        if amplitudes is None:
            continue
        added = np.stack([wander(rng, times, -a, a, RATE) for a in amplitudes], axis=-1)
        if gather and joint in SPINE:
            added = of_spine
        limit = limit_of(joint)
        allowed = torch.tensor([limit.flexion, limit.abduction, limit.twist], dtype=torch.float64)
        meant = torch.clamp(usual + torch.from_numpy(added), allowed[:, 0], allowed[:, 1])
        rotations[:, motion.skeleton.index(joint)] = frames[joint].rotation(meant).float()
    loose = replace(motion, rotations=rotations, name=f"{motion.name}_loose")
    return gathered(loose) if gather else loose


def lifted(motion: Motion, rng: np.random.Generator) -> Motion:
    """The loosened motion with one knee, or both, drawn up: deep kicks and crouches.

    Thighs are in the belly where trunk and hip bend together, until the motion is cleared.
    """
    frames, times = joint_frames(motion.skeleton), np.arange(len(motion)) / motion.fps
    loose = loosened(motion, rng)
    rotations, angles = loose.rotations.clone(), joint_angles(loose)
    for side in (("Left",), ("Right",), ("Left", "Right"))[rng.integers(3)]:
        for joint, (low, high) in LIFTED.items():
            meant = angles[side + joint].clone()
            meant[:, 0] = torch.from_numpy(wander(rng, times, low, high, RATE))
            rotations[:, motion.skeleton.index(side + joint)] = frames[side + joint].rotation(meant).float()
    return replace(loose, rotations=rotations, name=f"{motion.name}_lifted")


def gathered(motion: Motion) -> Motion:
    """The same with the whole bend of the spine in its lowest joint."""
    rotations = motion.rotations.clone()
    lowest, *others = (motion.skeleton.index(joint) for joint in SPINE)
    for other in others:  # from the hips up, as they are chained
        rotations[:, lowest] = rotations[:, lowest] @ rotations[:, other]
        rotations[:, other] = torch.eye(3)
    return replace(motion, rotations=rotations)
