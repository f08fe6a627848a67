"""Training and test motions: name, seed -> choreography -> theta (T,J,3,3), translation (T,3), 30 fps.

Ours from the first number to the last: no motion capture.  A family writes a `Choreography`, curves of what a
choreographer would say: where the pelvis and the feet are, how spine and arms bend.  `pose` turns it into joint
rotations: planted feet by two-bone inverse kinematics, so that they neither slide nor sink; everything else directly.
Test families share no name, no pattern and no parameter range with training families.
"""

import fnmatch
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d, minimum_filter1d
from torch import Tensor

from workbench.body.skeleton import Skeleton
from workbench.body.skinning import forward_kinematics
from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, smallest_rotation
from workbench.motion import Motion

FPS = 30.0
GRAVITY = 9.81
LEFT, RIGHT = 0, 1
SHORTEST, LONGEST = 60, 150  # frames
TRAIN_COUNT, TEST_COUNT = 5, 3  # motions a family
REFERENCE_HIP_HEIGHT = 0.883  # metres: choreographies are written for this leg and scaled to any other
TOE_CLEARANCE = 0.08  # metres above the floor at which toes hang as they like
SHOULDER_BALANCE = 0.2  # share of an arm's elevation above the shoulder that the clavicle takes


@dataclass(frozen=True)
class MotionsConfig:
    """List the generated motions, or save them as npz."""

    out: Path | None = None
    """folder to save to, one npz a motion; without it they are only listed"""
    only: str = "*"
    """shell pattern of names, such as 'test_*' or 'walk_0?'"""
    split: str = "all"
    """train, test or all"""
    seed: int = 0
    clear: bool = False
    """rotate arms and legs clear of the default body before saving"""


@dataclass(frozen=True)
class Limit:
    """Anatomical range of a joint, degrees: about its flexion axis, its abduction axis, and twist about its bone."""

    flexion: tuple[float, float]
    abduction: tuple[float, float]
    twist: tuple[float, float]


# Ours, after the clinical ranges of motion in Kapandji, "The Physiology of the Joints"; the shoulder's are measured
# from the A45 rest, the spine's and neck's are one joint's share.
LIMITS = {
    "UpLeg": Limit((-35, 130), (-35, 65), (-55, 55)),
    "Leg": Limit((-6, 155), (-3, 3), (-3, 3)),
    "Foot": Limit((-60, 45), (-35, 35), (-40, 40)),
    "ToeBase": Limit((-15, 65), (-3, 3), (-3, 3)),
    "LowerBack": Limit((-18, 40), (-20, 20), (-20, 20)),
    "Spine": Limit((-18, 40), (-20, 20), (-20, 20)),
    "Spine1": Limit((-18, 40), (-20, 20), (-20, 20)),
    "Neck": Limit((-25, 25), (-20, 20), (-30, 30)),
    "Neck1": Limit((-25, 25), (-20, 20), (-30, 30)),
    "Head": Limit((-30, 30), (-20, 20), (-40, 40)),
    "Shoulder": Limit((-25, 25), (-15, 40), (-3, 3)),
    "Arm": Limit((-75, 150), (-80, 140), (-85, 85)),
    "ForeArm": Limit((-5, 150), (-3, 3), (-90, 90)),
    "Hand": Limit((-80, 75), (-35, 35), (-90, 90)),
    "FingerBase": Limit((-20, 95), (-5, 5), (-5, 5)),
    "HandFinger1": Limit((-5, 100), (-5, 5), (-5, 5)),
}


@dataclass(frozen=True)
class Choreography:
    """What the body does, T frames; degrees, and metres for a hip height of 0.883 m; [:, 0] is the left side.

    Positive means: forward lean and bend, bend and turn to the left, flexion forward, abduction outward, outward turn
    of legs, heels up.  A foot is where its ball stands, relative to (0, 0) on the floor; it is planted (inverse
    kinematics) where `free` is 0 and follows `free_leg` where `free` is 1.
    """

    pelvis: Float[np.ndarray, "T 3"]  # horizontal position; height above standing
    heading: Float[np.ndarray, "T"]
    tilt: Float[np.ndarray, "T 3"]  # pelvis: forward lean, bend, turn
    spine: Float[np.ndarray, "T 3"]  # forward bend, side bend, turn: shared by three joints
    neck: Float[np.ndarray, "T 3"]
    foot: Float[np.ndarray, "T 2 3"]
    foot_yaw: Float[np.ndarray, "T 2"]  # of the world, like heading
    heel: Float[np.ndarray, "T 2"]  # heel up (about the ball) or toes up (negative, about the heel)
    free: Float[np.ndarray, "T 2"]
    free_leg: Float[np.ndarray, "T 2 5"]  # hip flexion, abduction, outward turn, knee flexion, toes up
    arm: Float[np.ndarray, "T 2 3"]  # flexion from hanging, angle out of the sagittal plane, inward turn
    elbow: Float[np.ndarray, "T 2"]
    forearm: Float[np.ndarray, "T 2"]  # palm down
    wrist: Float[np.ndarray, "T 2 2"]  # towards the palm, towards the thumb
    fingers: Float[np.ndarray, "T 2"]  # curl
    clavicle: Float[np.ndarray, "T 2 2"]  # forward, up

    def __len__(self) -> int:
        return len(self.heading)


@dataclass(frozen=True)
class Family:
    """One kind of motion: how a random generator and frame times become a choreography."""

    split: str
    choreograph: Callable[[np.random.Generator, Float[np.ndarray, "T"]], Choreography]


# ---- curves


def ease(s: np.ndarray) -> np.ndarray:
    """Minimum jerk from 0 at s <= 0 to 1 at s >= 1 (Flash and Hogan 1985)."""
    s = np.clip(s, 0, 1)
    return s**3 * (10 - 15 * s + 6 * s**2)


def keys(t: np.ndarray, *points: tuple[float, float]) -> np.ndarray:
    """A curve that rests at every (time, value) and moves with minimum jerk in between."""
    value = np.full_like(t, points[0][1])
    for (t0, v0), (t1, v1) in zip(points, points[1:]):
        value += (v1 - v0) * ease((t - t0) / max(t1 - t0, 1e-6))
    return value


def wander(rng: np.random.Generator, t: np.ndarray, low: float, high: float, rate: float = 0.5) -> np.ndarray:
    """Smooth chance inside (low, high): three sines up to `rate` Hz, folded into the range."""
    f, phase = rng.uniform(0.2, 1.0, 3) * rate, rng.uniform(0, 2 * np.pi, 3)
    weight = np.array([1.0, 0.7, 0.4]) * np.sort(rng.uniform(0.5, 1, 3))[::-1]
    wave = (weight * np.sin(2 * np.pi * np.outer(t, f) + phase)).sum(-1)
    return (low + high) / 2 + (high - low) / 2 * np.tanh(wave)


def sway(t: np.ndarray, rate: float, amplitude: float, phase: float = 0.0) -> np.ndarray:
    """amplitude * sin(2 pi (rate t + phase)); the phase is in cycles."""
    return amplitude * np.sin(2 * np.pi * (rate * t + phase))


def sided(left: np.ndarray | float, right: np.ndarray | float, t: np.ndarray) -> Float[np.ndarray, "T 2"]:
    return np.stack([left + 0 * t, right + 0 * t], -1)


def stacked(*columns: np.ndarray | float, t: np.ndarray) -> np.ndarray:
    return np.stack([column + 0 * t for column in columns], -1)


def swapped(c: Choreography) -> Choreography:
    """The mirror image: left for right."""
    flip = {name: getattr(c, name)[:, ::-1] for name in ("heel", "free", "free_leg", "arm", "elbow", "forearm")}
    flip |= {name: getattr(c, name)[:, ::-1] for name in ("wrist", "fingers", "clavicle")}
    turned = {name: getattr(c, name) * np.array([1.0, -1, -1]) for name in ("tilt", "spine", "neck")}
    mirror = np.array([-1.0, 1, 1])
    return replace(
        c,
        pelvis=c.pelvis * mirror,
        heading=-c.heading,
        foot=c.foot[:, ::-1] * mirror,
        foot_yaw=-c.foot_yaw[:, ::-1],
        **flip,
        **turned,
    )


def on_a_random_side(rng: np.random.Generator, c: Choreography) -> Choreography:
    return swapped(c) if rng.random() < 0.5 else c


# ---- feet


def standing(rng: np.random.Generator, t: np.ndarray, width: float | None = None) -> Choreography:
    """Relaxed standing that breathes a little; families replace what they move."""
    T, zero = len(t), np.zeros_like(t)
    width = rng.uniform(0.09, 0.13) if width is None else width
    toe_out = rng.uniform(4, 12)
    breath, rate = rng.uniform(0.5, 1.2), rng.uniform(0.2, 0.3)
    foot = np.zeros((T, 2, 3))
    foot[:, LEFT, 0], foot[:, RIGHT, 0], foot[..., 1] = width, -width, -0.12
    arm = np.zeros((T, 2, 3))
    for side in (LEFT, RIGHT):
        arm[:, side, 0] = rng.uniform(-4, 8) + sway(t, rate, breath, 0.1 * side)
        arm[:, side, 1] = rng.uniform(8, 14)
    return Choreography(
        pelvis=stacked(wander(rng, t, -0.008, 0.008, 0.3), zero, zero, t=t),
        heading=zero,
        tilt=np.zeros((T, 3)),
        spine=stacked(2 + sway(t, rate, breath), zero, zero, t=t),
        neck=stacked(wander(rng, t, -5, 5, 0.3), 0, wander(rng, t, -10, 10, 0.3), t=t),
        foot=foot,
        foot_yaw=sided(toe_out, -toe_out, t),
        heel=np.zeros((T, 2)),
        free=np.zeros((T, 2)),
        free_leg=np.zeros((T, 2, 5)),
        arm=arm,
        elbow=sided(rng.uniform(8, 22), rng.uniform(8, 22), t),
        forearm=sided(rng.uniform(-10, 25), rng.uniform(-10, 25), t),
        wrist=np.zeros((T, 2, 2)),
        fingers=sided(rng.uniform(10, 25), rng.uniform(10, 25), t),
        clavicle=np.zeros((T, 2, 2)),
    )


@dataclass(frozen=True)
class Gait:
    """How feet follow a path: cycles a second, share of one on the floor, lift [m], half width [m], heel and toe."""

    rate: float
    duty: float = 0.62
    lift: float = 0.07
    width: float = 0.095
    push: float = 35.0  # degrees the heel has risen when the foot leaves
    strike: float = 14.0  # degrees the toes are up when it lands
    toe_out: float = 6.0
    phase: float = 0.0


Path2D = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def stepping(c: Choreography, t: np.ndarray, gait: Gait, path: Path2D) -> Choreography:
    """Feet of a gait along `path(t) -> xy (T,2), heading (T,)`: each stands still, then moves to its next place."""
    foot, yaw, heel = np.zeros((len(t), 2, 3)), np.zeros((len(t), 2)), np.zeros((len(t), 2))
    for side in (LEFT, RIGHT):
        cycle = gait.rate * t + gait.phase + 0.5 * side
        step, part = np.floor(cycle), cycle % 1.0
        swing = np.clip((part - gait.duty) / (1 - gait.duty), 0, 1)
        places = []
        for k in (step, step + 1):
            at = (k + gait.duty / 2 - gait.phase - 0.5 * side) / gait.rate  # the pelvis is above the foot then
            xy, heading = path(at)
            outward = gait.width if side == LEFT else -gait.width
            a = np.deg2rad(heading)
            ball = xy + outward * np.stack([np.cos(a), np.sin(a)], -1) + 0.12 * np.stack([np.sin(a), -np.cos(a)], -1)
            places.append((ball, heading + (gait.toe_out if side == LEFT else -gait.toe_out)))
        s = ease(swing)
        foot[:, side, :2] = places[0][0] + s[:, None] * (places[1][0] - places[0][0])
        foot[:, side, 2] = gait.lift * np.sin(np.pi * swing) ** 2
        yaw[:, side] = places[0][1] + s * (places[1][1] - places[0][1])
        rise = 0.6 * gait.duty
        heel[:, side] = (
            -gait.strike * (1 - ease(part / (0.2 * gait.duty)))
            + gait.push * ease((part - rise) / (gait.duty - rise))
            - gait.push * ease((part - gait.duty) / (0.7 * (1 - gait.duty)))
            - gait.strike * ease((part - gait.duty - 0.4 * (1 - gait.duty)) / (0.6 * (1 - gait.duty)))
        )
    xy, heading = path(t)
    beat = gait.rate * t + gait.phase - gait.duty / 2  # whole numbers: over the left foot
    side_sway = 0.3 * gait.width * np.cos(2 * np.pi * beat)
    a = np.deg2rad(heading)
    pelvis = stacked(
        xy[:, 0] + side_sway * np.cos(a),
        xy[:, 1] + side_sway * np.sin(a),
        0.012 * np.cos(4 * np.pi * beat) - 0.012,
        t=t,
    )
    return replace(c, pelvis=pelvis, heading=heading, foot=foot, foot_yaw=yaw, heel=heel)


def arc(speed: float, turn: float, sideways: float = 0.0) -> Path2D:
    """Forward `speed` [m/s] while turning `turn` degrees a second."""

    def path(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rate = np.deg2rad(turn)
        if abs(rate) < 1e-4:
            xy = np.stack([sideways * t, -speed * t], -1)
        else:
            a = rate * t
            xy = speed / rate * np.stack([1 - np.cos(a), -np.sin(a)], -1)
        return xy, turn * t

    return path


def walking(
    rng: np.random.Generator, t: np.ndarray, gait: Gait, path: Path2D, *, swing: float, bend: float
) -> Choreography:
    """Gait with the counter-swing of trunk and arms."""
    c = stepping(standing(rng, t), t, gait, path)
    beat = gait.rate * t + gait.phase - gait.duty / 2
    stride = np.sin(2 * np.pi * beat)  # > 0: the left leg is behind
    turn, drop = rng.uniform(3, 7), rng.uniform(2, 4)
    arm = c.arm.copy()
    arm[:, LEFT, 0] = 4 + swing * stride
    arm[:, RIGHT, 0] = 4 - swing * stride
    elbow = sided(bend + 0.4 * swing * (1 + stride), bend + 0.4 * swing * (1 - stride), t)
    return replace(
        c,
        tilt=stacked(rng.uniform(1, 4), -drop * np.cos(2 * np.pi * beat), turn * stride, t=t),
        spine=stacked(rng.uniform(0, 4), 1.5 * drop * np.cos(2 * np.pi * beat), -2 * turn * stride, t=t),
        neck=stacked(wander(rng, t, -6, 6, 0.3), 0, turn * stride + wander(rng, t, -15, 15, 0.3), t=t),
        arm=arm,
        elbow=elbow,
    )


# ---- training families


def walk(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    speed = rng.uniform(0.7, 1.5)
    gait = Gait(rate=0.62 + 0.25 * speed, phase=rng.uniform(0, 1), push=22 + 14 * speed, strike=8 + 8 * speed)
    return walking(rng, t, gait, arc(speed, rng.uniform(-12, 12)), swing=rng.uniform(10, 24), bend=rng.uniform(8, 25))


def turn(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    speed = rng.uniform(0.0, 0.5)
    gait = Gait(rate=rng.uniform(0.7, 0.95), phase=rng.uniform(0, 1), lift=0.06, width=0.1, push=18, strike=4)
    spin = rng.uniform(45, 100) * rng.choice([-1, 1])
    c = walking(rng, t, gait, arc(speed, spin), swing=rng.uniform(5, 12), bend=rng.uniform(10, 30))
    return replace(c, neck=c.neck + np.array([0, 0, np.sign(spin) * 15]))  # the head leads


def squat(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t, width=rng.uniform(0.15, 0.24))
    period, depth = rng.uniform(2.0, 3.2), rng.uniform(0.18, 0.42)
    down = 0.5 - 0.5 * np.cos(2 * np.pi * t / period)
    down = down * (0.75 + 0.25 * keys(t, (0, rng.uniform(0, 1)), (period, rng.uniform(0, 1)), (2 * period, 1)))
    style = rng.integers(3)  # arms forward, folded up before the chest, hanging
    arm, elbow = c.arm.copy(), c.elbow
    if style == 0:
        arm[..., 0] += rng.uniform(70, 95) * down[:, None]
    if style == 1:
        arm[..., 0] += rng.uniform(30, 45)
        elbow = sided(1, 1, t) * rng.uniform(95, 110)
    toe_out = rng.uniform(15, 28)
    bend = depth / 0.42
    return replace(
        c,
        pelvis=c.pelvis + stacked(0, 0.22 * bend * down, -depth * down, t=t),
        tilt=stacked(26 * bend * down, 0, 0, t=t),
        spine=c.spine + stacked(14 * bend * down, 0, 0, t=t),
        neck=c.neck - stacked(20 * bend * down, 0, 0, t=t),
        foot_yaw=sided(toe_out, -toe_out, t),
        arm=arm,
        elbow=elbow,
    )


def reach(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t)
    hand_times = np.arange(rng.uniform(0.1, 0.4), t[-1] + 2.0, rng.uniform(1.3, 1.8))
    arm, elbow, spine, pelvis, clavicle = (
        c.arm.copy(),
        c.elbow.copy(),
        c.spine.copy(),
        c.pelvis.copy(),
        c.clavicle.copy(),
    )
    heel, neck = c.heel.copy(), c.neck.copy()
    for start in hand_times[::1]:
        bump = keys(t, (start, 0), (start + 0.55, 1), (start + 0.75, 1), (start + 1.3, 0))
        side = int(rng.integers(2))
        sign = 1 if side == LEFT else -1
        where = rng.integers(4)
        if where == 0:  # up
            flexion, abduction, lean, bend, low, up = rng.uniform(140, 165), rng.uniform(5, 25), -4, -8, 0.0, 12
        elif where == 1:  # forward
            flexion, abduction, lean, bend, low, up = rng.uniform(75, 105), rng.uniform(-10, 25), 12, 0, 0.02, 0
        elif where == 2:  # aside
            flexion, abduction, lean, bend, low, up = rng.uniform(0, 40), rng.uniform(75, 105), 0, 14, 0.01, 0
        else:  # towards the floor
            flexion, abduction, lean, bend, low, up = rng.uniform(60, 80), rng.uniform(0, 20), 45, 10, 0.2, 0
        arm[:, side] += bump[:, None] * (np.array([flexion, abduction, rng.uniform(-10, 10)]) - c.arm[:, side])
        elbow[:, side] += bump * (rng.uniform(5, 20) - c.elbow[:, side])
        spine += bump[:, None] * np.array([lean, sign * bend, -sign * rng.uniform(5, 18)])
        neck += bump[:, None] * np.array([-0.3 * lean, 0, sign * 10])
        pelvis += bump[:, None] * np.array([sign * 0.02, 0.3 * low, -low])
        clavicle[:, side, 1] += bump * up
        heel += bump[:, None] * (10 if where == 0 else 0)
    return replace(c, arm=arm, elbow=elbow, spine=spine, pelvis=pelvis, clavicle=clavicle, heel=heel, neck=neck)


def kick(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t, width=0.1)
    free, leg, pelvis, tilt, arm, spine = (
        c.free.copy(), c.free_leg.copy(), c.pelvis.copy(), c.tilt.copy(), c.arm.copy(), c.spine.copy()
    )  # fmt: skip
    leg[..., 3] = 6
    start = rng.uniform(0.15, 0.4)
    side = int(rng.integers(2))
    while start < t[-1]:
        sign = 1 if side == LEFT else -1
        sideways = rng.random() < 0.35
        height, abduction = rng.uniform(55, 95), rng.uniform(35, 55) if sideways else rng.uniform(0, 10)
        on, chamber, out, back, off = start, start + 0.45, start + 0.7, start + 1.05, start + 1.6
        weight = keys(t, (on, 0), (on + 0.12, 1), (off - 0.12, 1), (off, 0))
        bump = keys(t, (on - 0.15, 0), (chamber, 1), (back, 1), (off + 0.1, 0))
        free[:, side] = np.maximum(free[:, side], weight)
        leg[:, side, 0] += keys(t, (on, 0), (chamber, 0.85 * height), (out, height), (back, 0.8 * height), (off, 0))
        leg[:, side, 1] += abduction * keys(t, (on, 0), (chamber, 1), (back, 1), (off, 0))
        leg[:, side, 2] += (-10 if sideways else 5) * bump
        leg[:, side, 3] += keys(t, (on, 0), (on + 0.3, 80), (chamber, 95), (out, 12), (back, 95), (off, 0))
        toes_up = 5 if sideways else -30
        leg[:, side, 4] += keys(
            t, (on, 0), (on + 0.2, 12), (chamber, -25), (out, toes_up), (back, -20), (off - 0.25, 14), (off, 0)
        )
        pelvis += bump[:, None] * np.array([-sign * 0.085, 0.02, -0.015])
        tilt += bump[:, None] * np.array([-8, -sign * (14 if sideways else 4), 0])
        spine += bump[:, None] * np.array([6, -sign * (6 if sideways else 2), sign * 8])
        arm[:, :, 0] += bump[:, None] * np.array([rng.uniform(10, 40), rng.uniform(-20, 30)])
        arm[:, :, 1] += bump[:, None] * rng.uniform(15, 40, 2)
        start, side = off + rng.uniform(0.2, 0.5), 1 - side if rng.random() < 0.6 else side
    elbow = c.elbow + 40 * (free.sum(-1, keepdims=True).clip(0, 1))
    elbow = gaussian_filter1d(elbow, 3, axis=0, mode="nearest")
    return replace(c, free=free, free_leg=leg, pelvis=pelvis, tilt=tilt, arm=arm, spine=spine, elbow=elbow)


def fighting_stance(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    """Left foot forward, fists up before the chin, a small bounce."""
    c = standing(rng, t, width=0.13)
    bounce = rng.uniform(0.008, 0.02) * (np.cos(2 * np.pi * rng.uniform(1.2, 1.8) * t) - 1)
    foot = c.foot.copy()
    foot[:, LEFT, 1] -= 0.18
    foot[:, RIGHT, 1] += 0.2
    arm = stacked(rng.uniform(38, 52), rng.uniform(12, 22), 0, t=t)[:, None].repeat(2, 1)
    return replace(
        c,
        pelvis=c.pelvis + stacked(0, 0, -0.06 + bounce, t=t),
        tilt=stacked(4, 0, -18, t=t),
        spine=stacked(10, 0, -8, t=t),
        neck=stacked(4, 0, 26, t=t),
        foot=foot,
        foot_yaw=sided(-2, -42, t),
        heel=sided(0, 14, t),
        arm=arm,
        elbow=sided(rng.uniform(112, 128), rng.uniform(112, 128), t),
        forearm=sided(30, 30, t),
        fingers=sided(80, 80, t),
    )


def punch(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = fighting_stance(rng, t)
    arm, elbow, spine, tilt, forearm, clavicle, neck = (
        c.arm.copy(), c.elbow.copy(), c.spine.copy(), c.tilt.copy(), c.forearm.copy(), c.clavicle.copy(), c.neck.copy()
    )  # fmt: skip
    start = rng.uniform(0.2, 0.5)
    side = LEFT
    while start < t[-1]:
        sign = 1 if side == LEFT else -1
        hit, back = start + rng.uniform(0.2, 0.28), start + rng.uniform(0.55, 0.7)
        bump = keys(t, (start, 0), (hit, 1), (back, 0))
        target = np.array([rng.uniform(82, 98), rng.uniform(-6, 10), rng.uniform(0, 12)])
        arm[:, side] += bump[:, None] * (target - arm[:, side])
        elbow[:, side] += bump * (rng.uniform(6, 14) - elbow[:, side])
        forearm[:, side] += 35 * bump
        clavicle[:, side, 0] += 14 * bump
        spine[:, 2] += -sign * bump * rng.uniform(16, 28)
        tilt[:, 2] += -sign * bump * rng.uniform(8, 16)
        neck[:, 2] += sign * bump * 24
        start = back + rng.uniform(-0.1, 0.5)
        side = 1 - side if rng.random() < 0.75 else side
    c = replace(c, arm=arm, elbow=elbow, spine=spine, tilt=tilt, forearm=forearm, clavicle=clavicle, neck=neck)
    return on_a_random_side(rng, c)


def jumping(
    rng: np.random.Generator, t: np.ndarray, *, height: tuple[float, float], crouch: tuple[float, float], arms_up: float
) -> Choreography:
    """Vertical jumps: crouch, push off, a parabola, landing."""
    c = standing(rng, t, width=rng.uniform(0.1, 0.15))
    z, rise, heel, lean, arm_flexion = (np.zeros_like(t) for _ in range(5))
    start = rng.uniform(0.1, 0.4)
    while start < t[-1]:
        h, low = rng.uniform(*height), rng.uniform(*crouch)
        speed = np.sqrt(2 * GRAVITY * h)
        off = start + 0.75  # leaves the floor
        land = off + 2 * speed / GRAVITY
        end = land + 0.9
        flight = np.where((t > off) & (t < land), speed * (t - off) - GRAVITY / 2 * (t - off) ** 2, 0)
        before = keys(t, (start, 0), (start + 0.42, -low), (off + 0.12, 0.05))
        after = keys(t, (land - 0.12, 0.05), (land + 0.3, -0.8 * low), (end, 0))
        middle = (off + land) / 2
        z += np.where(t < off, before, np.where(t > land, after, 0.04)) * ((t >= start) & (t <= end)) + flight
        rise += flight
        bent = keys(t, (start, 0), (start + 0.42, 1), (off, 0), (middle, 0), (land + 0.25, 0.85), (end, 0))
        lean += 38 * low / 0.3 * bent
        heel += keys(t, (off - 0.22, 0), (off + 0.05, 42), (middle, 38), (land, 25), (land + 0.14, 0))
        arm_flexion += keys(t, (start, 0), (start + 0.4, -50), (off + 0.1, arms_up), (middle, arms_up), (end, 0))
        start = end + rng.uniform(0.1, 0.4)
    z = gaussian_filter1d(z, 0.8, mode="nearest")
    rise = gaussian_filter1d(rise, 0.8, mode="nearest")
    foot, arm = c.foot.copy(), c.arm.copy()
    foot[..., 2] += rise[:, None]
    arm[..., 0] += arm_flexion[:, None]
    lean = gaussian_filter1d(lean, 1.5, mode="nearest")
    return replace(
        c,
        pelvis=c.pelvis + stacked(0, 0.0035 * lean, z, t=t),
        tilt=stacked(0.8 * lean, 0, 0, t=t),
        spine=c.spine + stacked(0.5 * lean, 0, 0, t=t),
        neck=c.neck - stacked(0.7 * lean, 0, 0, t=t),
        foot=foot,
        heel=c.heel + heel[:, None],
        arm=arm,
        elbow=c.elbow + 15,
    )


def jump(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    return jumping(rng, t, height=(0.08, 0.3), crouch=(0.18, 0.3), arms_up=rng.uniform(60, 150))


def twist(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t, width=rng.uniform(0.12, 0.2))
    rate, amount = rng.uniform(0.35, 0.6), rng.uniform(25, 45)
    wave = np.sin(2 * np.pi * (rate * t + rng.uniform(0, 1))) * keys(t, (0, 0.5), (1.0, 1))
    late = np.roll(wave, 3)
    late[:3] = wave[:3]
    late = gaussian_filter1d(late, 2, mode="nearest")
    out, forward, bend = rng.uniform(35, 88), rng.uniform(0, 30), rng.uniform(8, 75)
    arm = stacked(forward, out, 0, t=t)[:, None].repeat(2, 1)
    arm[:, LEFT, 1] -= 12 * late
    arm[:, RIGHT, 1] += 12 * late
    return replace(
        c,
        tilt=stacked(0, 0, 0.3 * amount * wave, t=t),
        spine=c.spine + stacked(0, 0, amount * wave, t=t),
        neck=c.neck * 0.3 + stacked(0, 0, 0.4 * amount * late, t=t),
        arm=arm,
        elbow=sided(bend, bend, t),
        forearm=sided(20, 20, t),
    )


def dance(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    beat, travel, spin = rng.uniform(0.7, 1.0), rng.uniform(0.05, 0.2), rng.uniform(-25, 25)

    def path(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.stack([sway(at, beat / 4, travel), sway(at, beat / 8, travel / 2)], -1), sway(at, beat / 4, spin)

    gait = Gait(rate=beat, lift=0.05, width=0.11, push=22, strike=0, toe_out=10, phase=rng.uniform(0, 1))
    c = stepping(standing(rng, t), t, gait, path)
    arm, elbow = np.zeros_like(c.arm), np.zeros_like(c.elbow)
    together = rng.random() < 0.5
    base_f, amp_f = rng.uniform(30, 75), rng.uniform(15, 45)
    base_a, amp_a = rng.uniform(30, 55), rng.uniform(10, 25)
    base_e, amp_e = rng.uniform(45, 75), rng.uniform(15, 35)
    rate, ph = beat * rng.choice([0.5, 1.0]), rng.uniform(0, 1, 3)
    for side in (LEFT, RIGHT):
        shift = 0.0 if together or side == LEFT else 0.5
        arm[:, side, 0] = base_f + sway(t, rate, amp_f, ph[0] + shift)
        arm[:, side, 1] = base_a + sway(t, rate, amp_a, ph[1] + shift)
        arm[:, side, 2] = sway(t, rate / 2, 15, ph[2] + shift)
        elbow[:, side] = base_e + sway(t, rate, amp_e, ph[2] + shift)
    hips = rng.uniform(4, 9)
    return replace(
        c,
        pelvis=c.pelvis + stacked(sway(t, beat, 0.025, 0.1), 0, -0.03 + sway(t, 2 * beat, 0.012), t=t),
        tilt=stacked(sway(t, 2 * beat, 2) + 3, sway(t, beat, hips), sway(t, beat, 6, 0.25), t=t),
        spine=stacked(4, sway(t, beat, -1.3 * hips), sway(t, beat / 2, 12, ph[0]), t=t),
        neck=stacked(sway(t, 2 * beat, 5), sway(t, beat, 6), sway(t, beat / 2, 10), t=t),
        arm=arm,
        elbow=elbow,
        wrist=stacked(sway(t, rate, 15), sway(t, rate, 8), t=t)[:, None].repeat(2, 1),
    )


def excursion(
    rng: np.random.Generator, t: np.ndarray, *, rate: float = 0.45, reach: float = 1.0, crouch: float = 0.22
) -> Choreography:
    """Everything wanders smoothly at once, inside anatomical limits, over planted feet."""
    c = standing(rng, t, width=rng.uniform(0.1, 0.22))
    arm, elbow, wrist, forearm = c.arm.copy(), c.elbow.copy(), c.wrist.copy(), c.forearm.copy()
    for side in (LEFT, RIGHT):
        arm[:, side, 0] = wander(rng, t, -30 * reach, 150 * reach**0.1, rate)
        arm[:, side, 1] = wander(rng, t, 5, 85, rate)
        arm[:, side, 2] = wander(rng, t, -35, 35, rate)
        elbow[:, side] = wander(rng, t, 5, 120, rate)
        forearm[:, side] = wander(rng, t, -40, 60, rate)
        wrist[:, side, 0] = wander(rng, t, -30, 40, rate)
        wrist[:, side, 1] = wander(rng, t, -15, 15, rate)
    low = wander(rng, t, 0, crouch, rate)
    return replace(
        c,
        pelvis=c.pelvis
        + stacked(wander(rng, t, -0.07, 0.07, rate), 0.4 * low + wander(rng, t, -0.03, 0.03, rate), -low, t=t),
        tilt=stacked(wander(rng, t, -5, 22, rate), wander(rng, t, -8, 8, rate), wander(rng, t, -20, 20, rate), t=t),
        spine=stacked(
            wander(rng, t, -20, 45 * reach, rate), wander(rng, t, -25, 25, rate), wander(rng, t, -30, 30, rate), t=t
        ),
        neck=stacked(wander(rng, t, -25, 25, rate), wander(rng, t, -20, 20, rate), wander(rng, t, -45, 45, rate), t=t),
        arm=arm,
        elbow=elbow,
        forearm=forearm,
        wrist=wrist,
        fingers=sided(wander(rng, t, 5, 70, rate), wander(rng, t, 5, 70, rate), t),
    )


# ---- test families: neither these patterns nor these ranges are in training


def lunge(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t, width=0.11)
    start, deep, step = rng.uniform(0.1, 0.3), rng.uniform(0.16, 0.26), rng.uniform(0.6, 0.75)
    foot, heel, pelvis = c.foot.copy(), c.heel.copy(), c.pelvis.copy()
    tilt, arm = c.tilt.copy(), c.arm.copy()
    hands = rng.integers(2)  # swing, or on the hips
    while start < t[-1]:
        go, down, up, home = start, start + 0.9, start + 1.3, start + 2.3
        forward = keys(t, (go, 0), (go + 0.6, 1), (up + 0.3, 1), (home, 0))
        air = keys(t, (go, 0), (go + 0.3, 1), (go + 0.6, 0)) + keys(t, (up + 0.3, 0), (up + 0.65, 1), (home, 0))
        low = keys(t, (go + 0.1, 0), (down, 1), (up, 1), (home - 0.1, 0))
        foot[:, LEFT, 1] -= step * forward
        foot[:, LEFT, 2] += 0.07 * air
        pelvis += stacked(-0.02 * air, -0.5 * step * forward, -deep * low - 0.04 * forward, t=t)
        heel[:, RIGHT] += 48 * low
        tilt[:, 0] += 6 * low
        if not hands:
            arm[:, LEFT, 0] += -25 * low
            arm[:, RIGHT, 0] += 45 * low
        start = home + 0.3
    elbow = c.elbow + (25 if not hands else 0)
    if hands:
        arm = stacked(-22, 38, 30, t=t)[:, None].repeat(2, 1)
        elbow = sided(95, 95, t)
    return on_a_random_side(rng, replace(c, foot=foot, heel=heel, pelvis=pelvis, tilt=tilt, arm=arm, elbow=elbow))


def sidestep(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    speed = rng.uniform(0.35, 0.6)
    gait = Gait(
        rate=rng.uniform(0.9, 1.15), lift=0.06, width=0.17, push=14, strike=0, duty=0.6, phase=rng.uniform(0, 1)
    )
    c = stepping(standing(rng, t), t, gait, arc(0.0, 0.0, speed))
    out = rng.uniform(25, 45)
    arm = stacked(rng.uniform(15, 35), out, 0, t=t)[:, None].repeat(2, 1)
    c = replace(
        c,
        pelvis=c.pelvis + np.array([0, 0, -0.1]),
        tilt=stacked(12, 0, 0, t=t),
        spine=stacked(12, sway(t, gait.rate, 5), 0, t=t),
        neck=stacked(-10, 0, rng.uniform(10, 35), t=t),
        arm=arm + sway(t, 2 * gait.rate, 5)[:, None, None],
        elbow=sided(1, 1, t) * rng.uniform(50, 85),
    )
    return on_a_random_side(rng, c)


def jack(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t, width=0.09)
    rate = rng.uniform(0.65, 0.9)
    apart = 0.5 - 0.5 * np.cos(2 * np.pi * rate * t)
    apart = ease(apart) * 0.5 + apart * 0.5
    hop = np.abs(np.sin(2 * np.pi * rate * t)) ** 1.5  # in the air while the feet travel
    foot, arm = c.foot.copy(), c.arm.copy()
    spread, h = rng.uniform(0.14, 0.24), rng.uniform(0.04, 0.07)
    foot[:, LEFT, 0] += spread * apart
    foot[:, RIGHT, 0] -= spread * apart
    foot[..., 2] += (h * hop)[:, None]
    arm[..., 1] += (rng.uniform(118, 140) * apart)[:, None]
    pelvis = c.pelvis + stacked(0, 0, h * hop - 0.05 * (1 - hop) - 0.02, t=t)
    return replace(
        c,
        pelvis=pelvis,
        foot=foot,
        arm=arm,
        heel=c.heel + (8 + 28 * hop)[:, None],
        elbow=sided(1, 1, t) * rng.uniform(8, 25),
        foot_yaw=c.foot_yaw + sided(8 * apart, -8 * apart, t),
    )


def bow(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t, width=rng.uniform(0.07, 0.09))
    deep = rng.uniform(0.65, 1.0)
    down = keys(t, (0.3, 0), (1.4, deep), (1.9, deep), (3.0, 0), (3.6, 0), (4.6, 0.6 * deep))
    crossed = rng.integers(2)
    arm, elbow = c.arm.copy(), c.elbow.copy()
    arm[..., 0] += (35 * down)[:, None]  # arms stay hanging while the trunk leans
    if crossed:  # one hand over the belly
        arm[:, RIGHT] = stacked(10 + 15 * down, 12, 40, t=t)
        elbow[:, RIGHT] = 30 + 65 * down
    return replace(
        c,
        pelvis=c.pelvis + stacked(0, 0.11 * down, -0.015 * down, t=t),
        tilt=stacked(42 * down, 0, 0, t=t),
        spine=c.spine + stacked(40 * down, 0, 0, t=t),
        neck=c.neck + stacked(20 * down, 0, 0, t=t),
        arm=arm,
        elbow=elbow,
    )


def throw(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = fighting_stance(rng, t)
    arm, elbow, spine, tilt = c.arm.copy(), c.elbow.copy(), c.spine.copy(), c.tilt.copy()
    arm[:] = np.array([10.0, 15, 0])
    elbow[:] = 25
    start = rng.uniform(0.1, 0.3)
    pelvis = c.pelvis.copy()
    while start < t[-1]:
        wind, release, follow, end = start + 0.7, start + 1.0, start + 1.3, start + 2.2
        high, wide = rng.uniform(60, 80), rng.uniform(70, 85)
        arm[:, RIGHT, 0] += keys(t, (start, 0), (wind, -5), (release, high + 25), (follow, 35), (end, 0))
        arm[:, RIGHT, 1] += keys(t, (start, 0), (wind, wide), (release, 30), (follow, -20), (end, 0))
        arm[:, RIGHT, 2] += keys(t, (start, 0), (wind, -60), (release, -20), (follow, 10), (end, 0))
        elbow[:, RIGHT] += keys(t, (start, 0), (wind, 75), (release, 5), (follow, 0), (end, 0))
        arm[:, LEFT, 0] += keys(t, (start, 0), (wind, 70), (release, 10), (follow, -15), (end, 0))
        arm[:, LEFT, 1] += keys(t, (start, 0), (wind, 20), (release, 15), (end, 0))
        spine[:, 2] += keys(t, (start, 0), (wind, -26), (release, 24), (follow, 32), (end, 0))
        spine[:, 0] += keys(t, (start, 0), (wind, -10), (follow, 20), (end, 0))
        tilt[:, 2] += keys(t, (start, 0), (wind, -12), (follow, 22), (end, 0))
        pelvis[:, 1] += keys(t, (start, 0), (wind, 0.08), (follow, -0.1), (end, 0))
        start = end + 0.2
    c = replace(c, arm=arm, elbow=elbow, spine=spine, tilt=tilt, pelvis=pelvis, forearm=c.forearm * 0.5)
    return on_a_random_side(rng, replace(c, fingers=sided(35, 35, t)))


def wave(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t)
    arm, elbow, forearm = c.arm.copy(), c.elbow.copy(), c.forearm.copy()
    up = keys(t, (0.2, 0), (0.9, 1), (max(t[-1] - 0.9, 1.2), 1), (max(t[-1] - 0.2, 2.0), 0))
    rate = rng.uniform(1.2, 2.0)
    target = np.array([rng.uniform(5, 25), rng.uniform(85, 105), -65])
    arm[:, RIGHT] += up[:, None] * (target - arm[:, RIGHT])
    arm[:, RIGHT, 2] += up * sway(t, rate, 12)
    elbow[:, RIGHT] += up * (70 + sway(t, rate, 18) - elbow[:, RIGHT])
    spine = c.spine + stacked(0, 6 * up, -5 * up, t=t)
    neck = c.neck + stacked(0, 0, -12 * up, t=t)
    return on_a_random_side(rng, replace(c, arm=arm, elbow=elbow, forearm=forearm, spine=spine, neck=neck))


def hula(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    c = standing(rng, t, width=rng.uniform(0.14, 0.2))
    rate, size = rng.uniform(0.5, 0.9), rng.uniform(0.05, 0.08)
    x, y = sway(t, rate, size), sway(t, rate, 0.8 * size, 0.25)
    arm = stacked(rng.uniform(55, 75), rng.uniform(35, 50), 10, t=t)[:, None].repeat(2, 1)
    return replace(
        c,
        pelvis=c.pelvis + stacked(x, y, -0.045, t=t),
        tilt=stacked(-y / size * 9, -x / size * 8, 0, t=t),
        spine=stacked(y / size * 12 + 3, x / size * 11, 0, t=t),
        neck=c.neck * 0.5,
        arm=arm + sway(t, rate, 6)[:, None, None],
        elbow=sided(1, 1, t) * rng.uniform(70, 100),
    )


def backwalk(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    speed = rng.uniform(0.5, 0.8)
    gait = Gait(rate=0.55 + 0.3 * speed, phase=rng.uniform(0, 1), push=10, strike=0, lift=0.05)
    c = walking(rng, t, gait, arc(-speed, rng.uniform(-8, 8)), swing=-rng.uniform(6, 10), bend=rng.uniform(25, 40))
    return replace(c, neck=c.neck + np.array([0, 0, rng.choice([-1, 1]) * 35.0]))


def jog(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    speed = rng.uniform(1.8, 2.2)
    gait = Gait(rate=1.4, duty=0.36, lift=0.26, push=52, strike=4, phase=rng.uniform(0, 1), width=0.07)
    c = walking(rng, t, gait, arc(speed, rng.uniform(-6, 6)), swing=rng.uniform(28, 36), bend=rng.uniform(72, 88))
    beat = gait.rate * t + gait.phase - gait.duty / 2
    hop = -0.03 * np.cos(4 * np.pi * beat) - 0.03
    arm = c.arm + np.array([-6.0, 4, 0])
    pelvis = c.pelvis.copy()
    pelvis[:, 2] = hop
    return replace(
        c, pelvis=pelvis, tilt=c.tilt + np.array([5.0, 0, 0]), spine=c.spine + np.array([5.0, 0, 0]), arm=arm
    )


def march(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    speed = rng.uniform(0.0, 0.4)
    gait = Gait(
        rate=rng.uniform(0.75, 0.95),
        duty=0.55,
        lift=rng.uniform(0.26, 0.36),
        push=30,
        strike=0,
        phase=rng.uniform(0, 1),
    )
    return walking(rng, t, gait, arc(speed, 0.0), swing=rng.uniform(38, 50), bend=rng.uniform(20, 50))


def wild(rng: np.random.Generator, t: np.ndarray) -> Choreography:
    """Excursions faster and deeper than any in training."""
    return excursion(rng, t, rate=0.8, reach=1.2, crouch=0.34)


FAMILIES: dict[str, Family] = {
    **{f.__name__: Family("train", f) for f in (walk, turn, squat, reach, kick, punch, jump, twist, dance, excursion)},
    **{
        f"test_{f.__name__}": Family("test", f)
        for f in (lunge, sidestep, jack, bow, throw, wave, hula, backwalk, jog, march, wild)
    },
}  # fmt: skip


# ---- choreography -> rotations


@dataclass(frozen=True)
class JointFrame:
    """A joint's anatomical axes in the rest pose: rotations about them are flexion, abduction and twist."""

    axes: Float[Tensor, "3 3"]  # rows

    def rotation(self, angles: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
        """Degrees (flexion, abduction, twist) -> rotation: the twist first, then the swing as one rotation."""
        swing = angles[..., :2] @ self.axes[:2]
        turned = angles[..., 2:] * self.axes[2]
        return axis_angle_to_matrix(torch.deg2rad(swing)) @ axis_angle_to_matrix(torch.deg2rad(turned))

    def angles(self, rotation: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3"]:
        """The inverse of `rotation`, degrees."""
        bone = self.axes[2]
        swing = smallest_rotation(bone, rotation @ bone)
        twisted = matrix_to_axis_angle(swing.mT @ rotation) @ bone
        return torch.rad2deg(torch.cat([matrix_to_axis_angle(swing) @ self.axes[:2].T, twisted[..., None]], -1))


def joint_frames(skeleton: Skeleton) -> dict[str, JointFrame]:
    """Anatomical axes of every joint that has limits; the right side mirrors the left."""
    across, ahead = torch.tensor([1.0, 0, 0]), torch.tensor([0, -1.0, 0])
    up = torch.tensor([0, 0, 1.0])
    frames = {}
    for name in ("LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"):
        frames[name] = JointFrame(torch.stack([across, -ahead, up]).double())
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        outward = sign * torch.linalg.cross(-up, across)  # lifts a hanging limb to its own side
        for name in ("UpLeg", "Foot", "Leg", "ToeBase"):
            flexion = across if name in ("Leg",) else -across
            frames[side + name] = JointFrame(torch.stack([flexion, outward, sign * up]).double())
        arm, forearm = skeleton.index(f"{side}Arm"), skeleton.index(f"{side}ForeArm")
        bone = torch.nn.functional.normalize(skeleton.rest_joints[forearm] - skeleton.rest_joints[arm], dim=0).cpu()
        forward = torch.nn.functional.normalize(torch.linalg.cross(bone, ahead), dim=0)  # swings the arm forward
        lift = torch.linalg.cross(bone, forward) * -1.0
        lift = lift * torch.sign(torch.linalg.cross(lift, bone)[2])
        for name in ("Arm", "ForeArm"):
            frames[side + name] = JointFrame(torch.stack([forward, lift, bone]).double())
        for name in ("Hand", "FingerBase", "HandFinger1"):  # flexion closes the fist
            frames[side + name] = JointFrame(torch.stack([-lift, forward, bone]).double())
        level = torch.tensor([sign, 0, 0])
        frames[side + "Shoulder"] = JointFrame(
            torch.stack([torch.linalg.cross(level, ahead), torch.linalg.cross(level, up), level]).double()
        )
    return frames


def joint_angles(motion: Motion) -> dict[str, Float[Tensor, "T 3"]]:
    """(flexion, abduction, twist) in degrees of every joint that has limits."""
    rotations = motion.rotations.double()
    return {
        name: frame.angles(rotations[:, motion.skeleton.index(name)])
        for name, frame in joint_frames(motion.skeleton).items()
    }


def limit_of(joint: str) -> Limit:
    """The anatomical range of a joint by its name in the skeleton."""
    return LIMITS[joint.removeprefix("Left").removeprefix("Right")]


def beyond_limits(motion: Motion) -> Float[Tensor, "T"]:
    """How far the worst joint of each frame is beyond its range, degrees; 0 inside."""
    worst = torch.zeros(len(motion), dtype=torch.float64)
    for name, angles in joint_angles(motion).items():
        limit = limit_of(name)
        low, high = torch.tensor([limit.flexion, limit.abduction, limit.twist], dtype=torch.float64).T
        worst = torch.maximum(worst, (torch.maximum(low - angles, angles - high)).amax(-1))
    return worst


@dataclass(frozen=True)
class LegGeometry:
    """Rest vectors of one leg and where its foot touches the floor, metres."""

    hip: Float[Tensor, "3"]  # from the pelvis joint
    thigh: Float[Tensor, "3"]  # hip to knee
    shank: Float[Tensor, "3"]  # knee to ankle
    from_ball: Float[Tensor, "3"]  # ball of the foot (on the floor) to ankle
    from_heel: Float[Tensor, "3"]  # heel (on the floor) to ankle


def leg_geometry(skeleton: Skeleton, side: str) -> LegGeometry:
    joints = skeleton.rest_joints.double().cpu()
    pelvis, hip = joints[skeleton.index("Hips")], joints[skeleton.index(f"{side}UpLeg")]
    knee, ankle = joints[skeleton.index(f"{side}Leg")], joints[skeleton.index(f"{side}Foot")]
    ball = joints[skeleton.index(f"{side}ToeBase")]
    floor_ball = torch.stack([ball[0], ball[1], torch.zeros_like(ball[2])])
    heel = torch.stack([ankle[0], ankle[1] + 0.3 * (ankle[1] - ball[1]), torch.zeros_like(ankle[2])])
    return LegGeometry(hip - pelvis, knee - hip, ankle - knee, ankle - floor_ball, ankle - heel)


def turned(axis: int, degrees: Float[np.ndarray, "*B"]) -> Float[Tensor, "*B 3 3"]:
    """Rotation about a world axis."""
    vector = torch.zeros(*degrees.shape, 3, dtype=torch.float64)
    vector[..., axis] = torch.deg2rad(torch.from_numpy(np.ascontiguousarray(degrees)))
    return axis_angle_to_matrix(vector)


def knee_flexion(leg: LegGeometry, distance: Float[Tensor, "T"]) -> Float[Tensor, "T"]:
    """The flexion k >= 0 [rad] at which |thigh + R_x(k) shank| = distance, hip to ankle; clamped to a leg's reach."""
    u, v = leg.thigh, leg.shank
    # u . R_x(k) v = u_x v_x + A cos k + B sin k
    A, B = u[1] * v[1] + u[2] * v[2], u[2] * v[1] - u[1] * v[2]
    wanted = (distance**2 - u @ u - v @ v) / 2 - u[0] * v[0]
    k = torch.atan2(B, A) + torch.arccos((wanted / torch.hypot(A, B)).clamp(-1, 1))
    return k.clamp(0, np.deg2rad(LIMITS["Leg"].flexion[1]))


def reach_of(leg: LegGeometry) -> float:
    """Hip to ankle with the knee as straight as in rest."""
    return float((leg.thigh + leg.shank).norm())


def ankle_of(c: Choreography, leg: LegGeometry, side: int, scale: float) -> tuple[Tensor, Tensor]:
    """Where the planted foot wants its ankle (T,3), and the foot's world rotation (T,3,3)."""
    heel = c.heel[:, side]
    yaw = turned(2, c.foot_yaw[:, side])
    rotation = yaw @ turned(0, heel)
    ball = torch.from_numpy(c.foot[:, side]) * scale
    about_ball = ball + (rotation @ leg.from_ball)
    heel_point = ball + yaw @ (leg.from_ball - leg.from_heel)
    about_heel = heel_point + rotation @ leg.from_heel
    return torch.where(torch.from_numpy(heel >= 0)[:, None], about_ball, about_heel), rotation


def pelvis_height(
    wanted: Float[np.ndarray, "T"], hips: list[Tensor], ankles: list[Tensor], legs: list[LegGeometry], free: np.ndarray
) -> Float[np.ndarray, "T"]:
    """The wanted height where both feet can be reached, smoothly less where not.

    hips: hip joints (T,3) with the pelvis at the wanted height.
    """
    limit = np.full_like(wanted, np.inf)
    for side, (hip, ankle, leg) in enumerate(zip(hips, ankles, legs)):
        across = ((ankle - hip)[:, :2] ** 2).sum(-1)
        room = ankle[:, 2] + (reach_of(leg) ** 2 - across).clamp(min=0).sqrt() - hip[:, 2]
        limit = np.minimum(limit, np.where(free[:, side] > 0.5, np.inf, room.numpy()))
    lower = np.minimum(limit, 0)
    # the minimum over a window, blurred by less than the window, is never above the limit
    lower = gaussian_filter1d(minimum_filter1d(lower, 5, mode="nearest"), 1.2, radius=2, mode="nearest")
    return wanted + lower


def pose(c: Choreography, skeleton: Skeleton, name: str = "") -> Motion:
    """A choreography on a skeleton with the joint names of the default body (rig cmu_mb), at 30 fps.

    Raises ValueError where the choreography is not finite.
    """
    for field, value in vars(c).items():
        if not np.isfinite(value).all():
            raise ValueError(f"choreography {name!r}: {field} holds NaN or infinity; mend the family that wrote it")
    T, J = len(c), len(skeleton)
    frames = joint_frames(skeleton)
    local = torch.eye(3, dtype=torch.float64).repeat(T, J, 1, 1)

    def put(joint: str, rotation: Tensor) -> None:
        local[:, skeleton.index(joint)] = rotation

    legs = [leg_geometry(skeleton, side) for side in ("Left", "Right")]
    rest_pelvis = skeleton.rest_joints[skeleton.index("Hips")].double().cpu()
    scale = float(rest_pelvis[2] + legs[0].hip[2]) / REFERENCE_HIP_HEIGHT
    pelvis = (
        turned(2, c.heading + c.tilt[:, 2]) @ turned(0, c.tilt[:, 0]) @ turned(1, c.tilt[:, 1])
    )  # turn, then lean, then bend
    position = torch.from_numpy(c.pelvis) * scale + rest_pelvis
    hips = [position + pelvis @ leg.hip for leg in legs]
    planted = [ankle_of(c, leg, side, scale) for side, leg in enumerate(legs)]
    height = pelvis_height(position[:, 2].numpy(), hips, [ankle for ankle, _ in planted], legs, c.free)
    drop = torch.from_numpy(height) - position[:, 2]
    position = position + drop[:, None] * torch.tensor([0, 0, 1.0], dtype=torch.float64)
    put("Hips", pelvis)
    for side, (word, leg) in enumerate(zip(("Left", "Right"), legs)):
        hip = position + pelvis @ leg.hip
        thigh, knee, ankle = planted_leg(c, leg, side, pelvis, hip, *planted[side])
        put_leg(local, skeleton, c, side, word, frames, thigh, knee, ankle)
    put_trunk(put, c, frames)
    for side, word in enumerate(("Left", "Right")):
        put_arm(put, c, side, word, frames)
    position = position + lift_off_the_floor(local, position - rest_pelvis, skeleton)
    return Motion(
        rotations=local.float(), translation=(position - rest_pelvis).float(), fps=FPS, skeleton=skeleton, name=name
    )


def planted_leg(
    c: Choreography, leg: LegGeometry, side: int, pelvis: Tensor, hip: Tensor, ankle: Tensor, foot: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Two-bone inverse kinematics: local rotations of hip, knee and ankle.

    The leg swings the least way from rest to the ankle, then turns outward with most of the foot's yaw.
    """
    to_ankle = ankle - hip
    k = knee_flexion(leg, to_ankle.norm(dim=-1))
    zero = torch.zeros_like(k)
    knee = axis_angle_to_matrix(torch.stack([k, zero, zero], -1))
    rest = leg.thigh + knee @ leg.shank
    aim = (pelvis.mT @ to_ankle[..., None])[..., 0]
    swing = smallest_rotation(rest, aim)
    # the yaw of the foot as the pelvis sees it, about the line from hip to ankle
    forward = (pelvis.mT @ foot)[:, :, 1] * -1.0
    line = torch.nn.functional.normalize(aim, dim=-1)
    here = swing @ torch.tensor([0, -1.0, 0], dtype=torch.float64)
    flat = [x - (x * line).sum(-1, keepdim=True) * line for x in (here, forward)]
    angle = torch.atan2((torch.linalg.cross(flat[0], flat[1]) * line).sum(-1), (flat[0] * flat[1]).sum(-1))
    trust = flat[1].norm(dim=-1) ** 2  # a foot that points along the leg says nothing about its turn
    thigh = axis_angle_to_matrix((0.8 * trust * angle)[:, None] * line) @ swing
    return thigh, knee, (pelvis @ thigh @ knee).mT @ foot


def put_leg(
    local: Tensor,
    skeleton: Skeleton,
    c: Choreography,
    side: int,
    word: str,
    frames: dict[str, JointFrame],
    thigh: Tensor,
    knee: Tensor,
    ankle: Tensor,
) -> None:
    """Blend the planted leg with the free one, and keep toes flat under a raised heel."""
    wanted, free = torch.from_numpy(np.ascontiguousarray(c.free_leg[:, side])), torch.from_numpy(c.free[:, side].copy())
    zero = torch.zeros_like(free)
    loose = {
        "UpLeg": frames[word + "UpLeg"].rotation(wanted[:, [0, 1, 2]]),
        "Leg": frames[word + "Leg"].rotation(torch.stack([wanted[:, 3], zero, zero], -1)),
        "Foot": frames[word + "Foot"].rotation(torch.stack([wanted[:, 4], zero, zero], -1)),
    }
    for part, rotation in (("UpLeg", thigh), ("Leg", knee), ("Foot", ankle)):
        between = matrix_to_axis_angle(rotation.mT @ loose[part]) * free[:, None]
        local[:, skeleton.index(word + part)] = rotation @ axis_angle_to_matrix(between)
    toes = (
        np.clip(c.heel[:, side], 0, 60) * (1 - c.free[:, side]) * np.clip(1 - c.foot[:, side, 2] / TOE_CLEARANCE, 0, 1)
    )
    toes = gaussian_filter1d(toes, 1.0, mode="nearest")
    local[:, skeleton.index(f"{word}ToeBase")] = turned(0, -toes)


def put_trunk(put: Callable[[str, Tensor], None], c: Choreography, frames: dict[str, JointFrame]) -> None:
    """Share bends between the joints of spine and neck."""
    for joint, share in (("LowerBack", 0.35), ("Spine", 0.35), ("Spine1", 0.3)):
        put(joint, frames[joint].rotation(torch.from_numpy(c.spine) * share))
    for joint, share in (("Neck", 0.3), ("Neck1", 0.3), ("Head", 0.4)):
        put(joint, frames[joint].rotation(torch.from_numpy(c.neck) * share))


def arm_direction(flexion: Tensor, outward: Tensor, sign: float) -> Float[Tensor, "T 3"]:
    """Upper-arm direction: hanging, swung forward by `flexion`, out of the sagittal plane by `outward` (degrees)."""
    f, a = torch.deg2rad(flexion), torch.deg2rad(outward)
    return torch.stack([sign * torch.sin(a), -torch.cos(a) * torch.sin(f), -torch.cos(a) * torch.cos(f)], -1)


def put_arm(
    put: Callable[[str, Tensor], None], c: Choreography, side: int, word: str, frames: dict[str, JointFrame]
) -> None:
    """Clavicle, shoulder (the least swing from rest, then a turn of the upper arm), elbow, wrist and fingers."""
    sign = 1.0 if side == LEFT else -1.0
    arm = torch.from_numpy(np.ascontiguousarray(c.arm[:, side]))
    elbow, forearm = torch.from_numpy(c.elbow[:, side].copy()), torch.from_numpy(c.forearm[:, side].copy())
    wrist, fingers = torch.from_numpy(c.wrist[:, side].copy()), torch.from_numpy(c.fingers[:, side].copy())
    zero = torch.zeros_like(elbow)
    direction = arm_direction(arm[:, 0], arm[:, 1], sign)
    elevation = torch.rad2deg(torch.arccos(-direction[:, 2].clamp(-1, 1)))
    shrug = SHOULDER_BALANCE * (elevation - 70).clamp(min=0)
    girdle = torch.from_numpy(c.clavicle[:, side].copy()) + torch.stack([zero, shrug], -1)
    clavicle = frames[word + "Shoulder"].rotation(torch.cat([girdle, zero[:, None]], -1))
    put(word + "Shoulder", clavicle)
    frame = frames[word + "Arm"]
    # the direction is meant in the trunk's frame, so the clavicle's share is taken off
    swing = smallest_rotation(frame.axes[2], (clavicle.mT @ direction[..., None])[..., 0])
    put(word + "Arm", swing @ frame.rotation(torch.stack([zero, zero, sign * arm[:, 2]], -1)))
    half = 0.5 * sign * forearm  # half of the forearm's turn shows at the wrist
    put(word + "ForeArm", frames[word + "ForeArm"].rotation(torch.stack([elbow, zero, half], -1)))
    put(word + "Hand", frames[word + "Hand"].rotation(torch.stack([wrist[:, 0], wrist[:, 1], half], -1)))
    for joint, share in (("FingerBase", 0.7), ("HandFinger1", 1.0)):
        put(word + joint, frames[word + joint].rotation(torch.stack([share * fingers, zero, zero], -1)))


def lift_off_the_floor(local: Tensor, translation: Tensor, skeleton: Skeleton) -> Float[Tensor, "T 3"]:
    """How much to raise each frame so that no sole is under the floor (a free leg may have come too low)."""
    posed = forward_kinematics(local, skeleton.rest_joints.double().cpu(), skeleton.parents)
    lowest = torch.zeros(len(local), dtype=torch.float64)
    for word in ("Left", "Right"):
        leg, foot = leg_geometry(skeleton, word), skeleton.index(f"{word}Foot")
        for contact in (leg.from_ball, leg.from_heel):
            point = posed.joints[:, foot] - posed.transforms.rotation[:, foot] @ contact
            lowest = torch.minimum(lowest, point[:, 2] + translation[:, 2])
    raised = gaussian_filter1d(np.maximum(-lowest.numpy(), 0), 1.5, mode="nearest")
    return torch.from_numpy(np.stack([0 * raised, 0 * raised, raised], -1))


# ---- names


def motion_names(split: str = "all") -> tuple[str, ...]:
    """Every name that `generate` knows: walk_00 ... excursion_04, test_lunge_00 ... test_wild_02.

    split: train, test or all; ValueError for anything else.
    """
    if split not in ("train", "test", "all"):
        raise ValueError(f"split is {split!r}; expected train, test or all")
    return tuple(
        f"{family}_{k:02d}"
        for family, what in FAMILIES.items()
        if split in ("all", what.split)
        for k in range(TRAIN_COUNT if what.split == "train" else TEST_COUNT)
    )


def generate(name: str, skeleton: Skeleton, *, seed: int = 0, frames: int | None = None) -> Motion:
    """The motion called `name`: same name, seed and skeleton, same motion.  Indices beyond the listed ones work too.

    frames: length at 30 fps; by default chance picks 60-150.  ValueError for an unknown family or a foreign skeleton.
    """
    family, _, index = name.rpartition("_")
    if family not in FAMILIES or not index.isdigit():
        raise ValueError(f"no motion is called {name!r}; expected FAMILY_NN with FAMILY one of {', '.join(FAMILIES)}")
    needed = {"Hips", *(joint for joint in _jointed())}
    missing = sorted(needed - set(skeleton.names))
    if missing:
        raise ValueError(
            f"the skeleton lacks the joints {', '.join(missing)}; motions are written for the default body "
            "(workbench.body.model.Body.default().skeleton)"
        )
    if frames is not None and frames < 2:
        raise ValueError(f"a motion needs at least 2 frames, but {frames} were asked for")
    rng = np.random.default_rng([seed, zlib.crc32(family.encode()), int(index)])
    length = int(rng.integers(SHORTEST, LONGEST + 1))
    t = np.arange(frames or length) / FPS
    return pose(FAMILIES[family].choreograph(rng, t), skeleton, name)


def _jointed() -> Sequence[str]:
    paired = ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand", "FingerBase", "HandFinger1")
    single = [name for name in LIMITS if name not in paired]
    return [*single, *(side + name for side in ("Left", "Right") for name in paired)]


def run(config: MotionsConfig) -> tuple[Motion, ...]:
    """List the motions; save them where `out` says."""
    from workbench.body.model import Body

    body = Body.default()
    names = fnmatch.filter(motion_names(config.split), config.only)
    if not names:
        raise ValueError(f"no motion name matches {config.only!r}; families: {', '.join(FAMILIES)}")
    motions = []
    for name in names:
        motion = generate(name, body.skeleton, seed=config.seed)
        if config.clear:
            motion = motion.cleared(body)
        motions.append(motion)
        family = FAMILIES[name.rpartition("_")[0]]
        print(f"{name:20s} {family.split:5s} {len(motion):4d} frames")
        if config.out is not None:
            config.out.mkdir(parents=True, exist_ok=True)
            motion.save(config.out / f"{name}.npz")
    return tuple(motions)
