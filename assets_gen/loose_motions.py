"""Motions whose joints go their own ways.  motion, chance -> theta within anatomical limits; never simulated.

A choreography shares a bend among the joints of the spine, lets the clavicle follow the arm and keeps feet planted.
People, and the skeletons that motion capture is put on, share otherwise: here every joint that moves a garment wanders
by itself about what the motion asks of it; in half of the motions the joints of the spine wander as one, as
`retargeting` has it where one joint bends it all.  Loosened motions of the families hardly bend a hip by 110 degrees,
and those that do push the thigh into the belly; lifted and curled ones do little else.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from assets_gen.motions import joint_angles, joint_frames, limit_of, wander
from workbench.motion import Motion
from workbench.rig_names import SPINE

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
# Degrees of (flexion, abduction, twist) that a leg drawn up wanders between, and the flexion of its knee
THIGH, KNEE = ((30, 130), (-15, 60), (-30, 45)), (20, 150)
CURL = (0, 80)  # degrees that the joints of a curled spine bend forward together
RATE = 0.6  # Hz: the fastest a joint wanders


def loosened(motion: Motion, rng: np.random.Generator) -> Motion:
    """The motion with every joint of AMPLITUDES wandering about its way, inside LIMITS; in half of all the joints of
    the spine wander as one.

    Feet slide and may sink: for networks that see theta alone.
    """
    frames, angles = joint_frames(motion.skeleton), joint_angles(motion)
    times = np.arange(len(motion)) / motion.fps
    rotations = motion.rotations.clone()
    as_one = rng.random() < 0.5
    of_spine = np.stack([wander(rng, times, -a, a, RATE) for a in AMPLITUDES[SPINE[0]]], axis=-1)
    for joint, usual in angles.items():
        amplitudes = AMPLITUDES.get(joint.removeprefix("Left").removeprefix("Right"))
        if amplitudes is None:
            continue
        added = np.stack([wander(rng, times, -a, a, RATE) for a in amplitudes], axis=-1)
        if as_one and joint in SPINE:
            added = of_spine
        limit = limit_of(joint)
        allowed = torch.tensor([limit.flexion, limit.abduction, limit.twist], dtype=torch.float64)
        meant = torch.clamp(usual + torch.from_numpy(added), allowed[:, 0], allowed[:, 1])
        rotations[:, motion.skeleton.index(joint)] = frames[joint].rotation(meant).float()
    return replace(motion, rotations=rotations, name=f"{motion.name}_loose")


def lifted(motion: Motion, rng: np.random.Generator) -> Motion:
    """The loosened motion with one knee, or both, drawn up: kicks and crouches."""
    loose = loosened(motion, rng)
    sides = (("Left",), ("Right",), ("Left", "Right"))[rng.integers(3)]
    return replace(_drawn_up(loose, sides, rng), name=f"{motion.name}_lifted")


def curled(motion: Motion, rng: np.random.Generator) -> Motion:
    """The loosened motion with both knees drawn up to a bent trunk: who rolls, gets up from the floor, ties a shoe."""
    frames, times = joint_frames(motion.skeleton), np.arange(len(motion)) / motion.fps
    loose = _drawn_up(loosened(motion, rng), ("Left", "Right"), rng)
    rotations, angles = loose.rotations.clone(), joint_angles(loose)
    bend = torch.from_numpy(wander(rng, times, *CURL, RATE)) / len(SPINE)
    for joint in SPINE:
        meant = torch.stack([bend, *angles[joint].unbind(1)[1:]], dim=1)
        rotations[:, motion.skeleton.index(joint)] = frames[joint].rotation(meant).float()
    return replace(loose, rotations=rotations, name=f"{motion.name}_curled")


def _drawn_up(motion: Motion, sides: Sequence[str], rng: np.random.Generator) -> Motion:
    """The motion with the legs of these sides wandering in the ranges of THIGH and KNEE."""
    frames, times = joint_frames(motion.skeleton), np.arange(len(motion)) / motion.fps
    rotations, angles = motion.rotations.clone(), joint_angles(motion)
    for side in sides:
        thigh = np.stack([wander(rng, times, *ends, RATE) for ends in THIGH], axis=-1)
        shank = angles[side + "Leg"].clone()
        shank[:, 0] = torch.from_numpy(wander(rng, times, *KNEE, RATE))
        for joint, meant in ((side + "UpLeg", torch.from_numpy(thigh)), (side + "Leg", shank)):
            rotations[:, motion.skeleton.index(joint)] = frames[joint].rotation(meant).float()
    return replace(motion, rotations=rotations)
