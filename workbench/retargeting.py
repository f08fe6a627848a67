"""Retargeting: a motion of any known rig -> the same motion on another skeleton, in metres, z up.

For a joint of the target that has a counterpart in the source, with global rotations G relative to the two rests,
    G_target(t) = C_world G_source(t) C_rest^-1 A,
C takes the source's axes to ours (z up, facing -y) and A takes the target's rest pose to the source's: the smallest
rotation between the rest directions of a limb's bone, turned about it so that elbows and knees fold about one axis.
The spine, neck and clavicles are not aligned (A = I): their bones run differently in every rig, their flesh does not.
A joint without counterpart keeps its rest rotation relative to its parent.  But where one joint of the source bends its
whole spine, all of the target's share that bend: in one joint it folds the belly into itself.
"""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skeleton import Skeleton
from workbench.body.skinning import forward_kinematics
from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rotation_angle, smallest_rotation
from workbench.motion import Motion
from workbench.rig_names import SIDES, SPINE, roles_of

log = logging.getLogger(__name__)

Axis = Literal["x", "y", "z", "-x", "-y", "-z"]

Y_UP_FROM_Z_UP = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
"""Takes z up, facing -y to y up, facing +z."""

_FORWARD = (0.0, -1.0, 0.0)

_SAME_REST = math.radians(1.0)
"""Bones of two rest poses that agree this well are in one and the same rest: there motion carries over unchanged."""


@dataclass(frozen=True)
class RetargetConfig:
    """How a motion is carried over.

    world_up: the vertical axis of the source's world; None: that of its rest pose, as nearly every file has it.
    drop_t_pose: leave out the calibration frames at the source's T-pose with which many clips start.
    t_pose_arms, t_pose_legs: how near to the rest pose a frame counts as T-pose, in degrees; ours: the CMU conversions
    start with arms 5 and legs 17 degrees off.  t_pose_jump: the arms' speed in rad/s above which the frames after a
    T-pose still belong to the jump out of it; ours: people stay below 20.
    largest_twist: an elbow or knee axis further from the usual one than this is taken for noise, in degrees; ours.
    planted_speed: a foot slower than this stands, in leg lengths a second; ours: half a centimetre a frame at 30 fps.
    largest_slope: standing feet whose soles slope more than this are meant so (toe stand), in degrees; ours: feet of
    the four real clips slope by 2 to 7 and toes by up to 11, an error of their rest poses.
    """

    world_up: Axis | None = None
    drop_t_pose: bool = True
    t_pose_arms: float = 10.0
    t_pose_legs: float = 25.0
    t_pose_jump: float = 20.0
    largest_twist: float = 60.0
    planted_speed: float = 0.2
    largest_slope: float = 15.0


def reframed(motion: Motion, turn: Float[Tensor, "3 3"], scale: float = 1.0) -> Motion:
    """The same motion in axes turned by `turn` and in units of 1/scale: rest and world alike."""
    turn = turn.double()
    skeleton = reframed_skeleton(motion.skeleton, turn, scale)
    rotations = turn @ motion.rotations.double() @ turn.mT
    translation = scale * motion.translation.double() @ turn.mT
    return replace(motion, rotations=rotations.float(), translation=translation.float(), skeleton=skeleton)


def reframed_skeleton(skeleton: Skeleton, turn: Float[Tensor, "3 3"], scale: float = 1.0) -> Skeleton:
    """The same rest pose in axes turned by `turn` and in units of 1/scale."""
    return replace(skeleton, rest_joints=(scale * skeleton.rest_joints.double() @ turn.double().mT).float())


def _snapped(direction: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """The coordinate axis nearest to a direction, or the direction itself if none is within 12 degrees."""
    direction = direction / direction.norm()
    nearest = direction.abs().argmax()
    if direction[nearest].abs() < 0.978:
        return direction
    return torch.eye(3, dtype=direction.dtype)[nearest] * direction[nearest].sign()


def upright_turn(skeleton: Skeleton, roles: Mapping[str, int]) -> Float[Tensor, "3 3"]:
    """The rotation that takes the rest pose to z up, facing -y; from where its hips and shoulders are.

    Raises ValueError when hips and shoulders span no plane.
    """
    rest = skeleton.rest_joints.double()

    def at(role: str) -> Tensor:
        return rest[roles[role]]

    up = at("LeftArm") + at("RightArm") - at("LeftUpLeg") - at("RightUpLeg")
    left = at("LeftUpLeg") - at("RightUpLeg")
    size = (rest - rest[0]).norm(dim=-1).max()
    if torch.linalg.cross(up, left).norm() <= 1e-4 * size**2:
        raise ValueError(
            "hips and shoulders of the rest pose span no plane, so which way it faces is unknown; "
            "export the motion with a standing rest pose (T or A)"
        )
    z = _snapped(up)
    x = _snapped(left - (left @ z) * z)
    x = x - (x @ z) * z  # a diagonal facing stays diagonal, but upright
    x = x / x.norm()
    return torch.stack([x, torch.linalg.cross(z, x), z])


# What differs between two rest poses


def _bone_direction(skeleton: Skeleton, roles: Mapping[str, int], role: str, next_role: str) -> Tensor | None:
    """Rest vector from the joint of role to that of next_role, or to the first of its descendants apart from it."""
    rest, start = skeleton.rest_joints.double(), roles[role]
    reach = (rest - rest[0]).norm(dim=-1).max()
    first = roles.get(next_role)
    if first is None and skeleton.children(start):
        first = skeleton.children(start)[0]
    for joint in skeleton.descendants(first) if first is not None else ():
        vector = rest[joint] - rest[start]
        if vector.norm() > 1e-4 * reach:
            return vector
    return None


def _both_directions(
    target: Skeleton,
    source: Skeleton,
    target_roles: Mapping[str, int],
    source_roles: Mapping[str, int],
    role: str,
    next_role: str,
) -> tuple[Tensor | None, Tensor | None]:
    return _bone_direction(target, target_roles, role, next_role), _bone_direction(
        source, source_roles, role, next_role
    )


def _heading(direction: Tensor | None) -> Tensor | None:
    """The horizontal part of a direction; None for a vertical one, or none at all."""
    if direction is None:
        return None
    flat = direction * direction.new_tensor([1.0, 1.0, 0.0])
    return flat if flat.norm() > 0.2 * direction.norm() else None


def _hinge_twist(
    bend: Float[Tensor, "T 3 3"],
    source_bone: Float[Tensor, "3"],
    target_bone: Float[Tensor, "3"],
    fold: Float[Tensor, "3"],
    largest: float,
) -> float:
    """The angle about the bone that takes the target's folding axis onto the source's, in radians.

    bend (T,3,3): the source joint's rotation relative to the limb's first bone.  The source's axis is measured from the
    motion, the mean of d x bend d over time; the target folds towards `fold`.  0 when it never folds about one axis.
    """
    d = source_bone / source_bone.norm()
    folding = torch.linalg.cross(d.expand(len(bend), 3), bend @ d)
    mean = folding.mean(0)
    if mean.norm() < 0.05 or mean.norm() < 0.9 * folding.norm(dim=-1).mean():
        return 0.0
    axis = smallest_rotation(target_bone, source_bone) @ torch.linalg.cross(target_bone, fold)
    angle = torch.atan2(torch.linalg.cross(axis, mean) @ d, axis @ mean - (axis @ d) * (mean @ d))
    return float(angle) if angle.abs() <= torch.deg2rad(torch.tensor(largest)) else 0.0


def _planted(foot: Float[Tensor, "T 3"], ankle: Float[Tensor, "T 3"], speed: float) -> Bool[Tensor, "T"]:
    """Frames in which a foot stands: both its joints slower than `speed` (a frame) and as low as they usually get."""
    if len(foot) < 3:
        return torch.zeros(len(foot), dtype=torch.bool)
    moved = torch.stack([foot, ankle])
    step = (moved[:, 1:] - moved[:, :-1]).norm(dim=-1).amax(0)
    step = torch.maximum(torch.cat([step[:1], step]), torch.cat([step, step[-1:]]))
    return (step < speed) & (foot[:, 2] < foot[:, 2].quantile(0.5))


def _levelled(
    bone: Tensor | None, world: Float[Tensor, "T 3 3"], planted: Bool[Tensor, "T"], config: RetargetConfig
) -> Float[Tensor, "3 3"]:
    """The pitch that undoes how much steeper the foot's bone rises when it stands than in its rest pose (median).

    The identity when the foot hardly ever stands, has no one slope then, or one too large to be the rest pose's error.
    """
    level = torch.eye(3, dtype=torch.float64)
    heading = _heading(bone)
    if bone is None or heading is None or planted.sum() < 10:
        return level

    def rise(direction: Tensor) -> Tensor:
        return torch.atan2(direction[..., 2], direction[..., :2].norm(dim=-1))

    slope = rise(world[planted] @ bone) - rise(bone)
    low, middle, high = slope.quantile(slope.new_tensor([0.25, 0.5, 0.75])).tolist()
    largest = math.radians(config.largest_slope)
    if high - low > largest or abs(middle) > largest:
        return level
    upward = torch.linalg.cross(heading / heading.norm(), heading.new_tensor([0.0, 0.0, 1.0]))
    return axis_angle_to_matrix(-middle * upward)


def rest_alignment(
    source: Skeleton,
    target: Skeleton,
    source_roles: Mapping[str, int],
    target_roles: Mapping[str, int],
    source_world: Float[Tensor, "T J 3 3"],
    source_places: Float[Tensor, "T J 3"],
    fps: float,
    config: RetargetConfig,
) -> dict[str, Float[Tensor, "3 3"]]:
    """A of each limb's role: from the target's rest to the source's, both z up and facing -y.

    source_world (T,J,3,3), source_places (T,J,3): the source's global rotations and joints, in the same axes; how
    elbows and knees fold and how feet stand is measured from them.
    """
    backward, forward = -torch.tensor(_FORWARD, dtype=torch.float64), torch.tensor(_FORWARD, dtype=torch.float64)
    A: dict[str, Tensor] = {}
    for side in SIDES:
        for chain, fold in ((("Arm", "ForeArm", "Hand", "FingerBase"), forward), (("UpLeg", "Leg", "Foot"), backward)):
            first, second, third = (side + part for part in chain[:3])
            bones = []
            for role, next_role in ((first, second), (second, third)):
                pair = _both_directions(target, source, target_roles, source_roles, role, next_role)
                if pair[0] is None or pair[1] is None:
                    which = "source" if pair[1] is None else "target"
                    raise ValueError(f"in the {which}'s rest pose the bone from {role} to {next_role} has no length")
                bones.append(pair)
            swings = [smallest_rotation(t, s) for t, s in bones]
            twist = 0.0
            if max(float(rotation_angle(swing)) for swing in swings) > _SAME_REST:
                bend = source_world[:, source_roles[first]].mT @ source_world[:, source_roles[second]]
                twist = _hinge_twist(bend, bones[1][1], bones[1][0], fold, config.largest_twist)
            for role, (_, s), swing in zip((first, second), bones, swings):
                A[role] = axis_angle_to_matrix(twist * s / s.norm()) @ swing
            if len(chain) == 4:  # a hand continues its forearm
                t, s = _both_directions(target, source, target_roles, source_roles, third, side + chain[3])
                A[third] = A[second] if t is None or s is None else smallest_rotation(t, s)
        # Soles are flat on the floor in every rest pose, at whatever slope the ankle-to-toe bone runs: align only its
        # heading, then take off the slope with which the source's foot stands.
        foot, toe = side + "Foot", side + "ToeBase"
        target_foot, source_foot = _both_directions(target, source, target_roles, source_roles, foot, toe)
        heading, source_heading = _heading(target_foot), _heading(source_foot)
        yaw = torch.eye(3, dtype=torch.float64)
        if heading is not None and source_heading is not None:
            yaw = smallest_rotation(heading, source_heading)
        A[foot] = A[toe] = yaw
        if (
            target_foot is not None
            and source_foot is not None
            and _angle_between(target_foot, source_foot) < _SAME_REST
        ):
            continue
        ankle = source_roles[foot]
        ball = source_roles.get(toe, ankle)
        speed = config.planted_speed * _leg_length(source, source_roles) / fps
        planted = _planted(source_places[:, ball], source_places[:, ankle], speed)
        A[foot] = A[toe] = _levelled(source_foot, source_world[:, ankle], planted, config) @ yaw
        if toe in source_roles:
            source_toe = _bone_direction(source, source_roles, toe, "")
            if source_toe is not None:
                A[toe] = _levelled(source_toe, source_world[:, ball], planted, config) @ yaw
        for finger in ("FingerBase", "HandFinger1"):
            A[side + finger] = A[side + "Hand"]
        A[side[0] + "Thumb"] = A[side + "Hand"]
    return A


# Frames at the start that are no motion


def t_pose_frames(
    source: Skeleton, roles: Mapping[str, int], world: Float[Tensor, "T J 3 3"], fps: float, config: RetargetConfig
) -> int:
    """How many frames at the start stand in the source's T-pose or jump out of it; 0 if its rest is no T-pose."""
    pelvis = world[:, roles["Hips"]].mT
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    at_rest = torch.ones(len(world), dtype=torch.bool)
    arms = []
    for side, lateral in zip(SIDES, (1.0, -1.0)):
        for role, next_role in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot")):
            bone = _bone_direction(source, roles, side + role, side + next_role)
            if bone is None:
                return 0
            d = bone / bone.norm()
            if role == "Arm" and not (lateral * d[0] > 0.8 and d[2].abs() < 0.5):
                return 0
            posed = pelvis @ world[:, roles[side + role]] @ d
            limit = config.t_pose_arms if "Arm" in role else config.t_pose_legs
            at_rest &= _angle_between(posed, d) < torch.deg2rad(torch.tensor(limit))
            if "Arm" in role:
                arms.append(posed)
    at_rest &= (world[:, roles["Hips"]] @ up)[:, 2] > 0.5
    lead = _leading(at_rest)
    if lead in (0, len(world)):
        return 0
    moving = torch.stack(arms)
    speed = _angle_between(moving[:, 1:], moving[:, :-1]).amax(0) * fps
    longest = min(lead + round(0.25 * fps), len(world) - 1)
    while lead < longest and speed[lead] > config.t_pose_jump:
        lead += 1
    return lead


def _leading(flags: Bool[Tensor, "T"]) -> int:
    return len(flags) if flags.all() else int((~flags).nonzero()[0])


def _angle_between(a: Float[Tensor, "*#B 3"], b: Float[Tensor, "*#B 3"]) -> Float[Tensor, "..."]:
    a, b = torch.broadcast_tensors(a, b)
    return torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))


# The floor


def grounded(motion: Motion, body: Body, quantile: float = 0.1, frames: int = 200) -> Motion:
    """The motion lifted or lowered as a whole, so that the body's lowest point is at z = 0.

    The lowest point is taken in every frame (or in that many, evenly chosen), and the quantile of those heights goes to
    the floor: jumps do not pull it down, single slips of the capture below the floor do not lift it.
    """
    chosen = torch.linspace(0, len(motion) - 1, min(len(motion), frames)).long()
    betas = body.template.new_zeros(body.shape_count)
    lowest = torch.cat(
        [
            body.vertices(motion.rotations[part], betas, motion.translation[part])[..., 2].amin(-1)
            for part in chosen.split(16)  # a few megabytes at a time
        ]
    )
    down = lowest.quantile(quantile) * lowest.new_tensor([0.0, 0.0, 1.0])
    return replace(motion, translation=motion.translation - down)


# The stage


def retarget(
    motion: Motion,
    skeleton: Skeleton,
    *,
    mapping: Mapping[str, str] | None = None,
    config: RetargetConfig | None = None,
) -> Motion:
    """Carry a motion over to another skeleton: the result is in metres, z up, at the motion's frame rate.

    motion: on its own skeleton, in any units and axes (as `formats.bvh` and `formats.amass` read it).  skeleton: the
    target, in metres; rest pose z up, facing -y (or as SMPL has it, y up).  mapping {role: joint of the motion} names
    joints that no convention knows; roles are the joint names of the default rig.  The path is scaled by leg length;
    the pelvis is carried over at the middle of the hip joints; `grounded` then puts it on the floor.
    Raises ValueError for unknown joint names, rest poses without direction, limbs without length.
    """
    config = config or RetargetConfig()
    source_roles, target_roles = roles_of(motion.skeleton, mapping), roles_of(skeleton)
    source_turn, target_turn = upright_turn(motion.skeleton, source_roles), upright_turn(skeleton, target_roles)
    source = reframed_skeleton(motion.skeleton, source_turn)
    target = reframed_skeleton(skeleton, target_turn)

    world_turn = source_turn if config.world_up is None else _turn_up(config.world_up)
    local = motion.rotations.double()
    posed = forward_kinematics(local, motion.skeleton.rest_joints.double(), motion.skeleton.parents)
    world = world_turn @ posed.transforms.rotation @ source_turn.mT
    places = (posed.joints + motion.translation.double()[:, None]) @ world_turn.mT

    start = t_pose_frames(source, source_roles, world, motion.fps, config) if config.drop_t_pose else 0
    if start:
        log.info("%s: dropped %d T-pose frames at its start", motion.name or "motion", start)
    world, places = world[start:], places[start:]

    A = rest_alignment(source, target, source_roles, target_roles, world, places, motion.fps, config)
    identity = torch.eye(3, dtype=torch.float64)
    role_of = {j: role for role, j in target_roles.items()}
    turned: list[Tensor] = []
    spine = _spread_spine(world, source_roles, target_roles)
    for j, parent in enumerate(target.parents):
        role = role_of.get(j)
        if role in spine:
            turned.append(spine[role])
        elif role in source_roles:
            turned.append(world[:, source_roles[role]] @ A.get(role, identity))
        else:
            turned.append(turned[parent] if parent >= 0 else identity.repeat(len(world), 1, 1))
    G = torch.stack(turned, dim=1)
    parents = list(target.parents)
    rotations = torch.cat([G[:, :1], G[:, parents[1:]].mT @ G[:, 1:]], dim=1)

    scale = _leg_length(target, target_roles) / _leg_length(source, source_roles)
    rest = target.rest_joints.double()
    hips = [target_roles[side + "UpLeg"] for side in SIDES]
    posed = forward_kinematics(rotations, rest, target.parents)
    source_middle = places[:, [source_roles[side + "UpLeg"] for side in SIDES]].mean(1)
    root = scale * source_middle - (posed.joints[:, hips].mean(1) - rest[0])

    # Back to the axes of the target's own rest; its root then stands the body up in the world.
    rotations = target_turn.mT @ rotations @ target_turn
    rotations[:, 0] = target_turn @ rotations[:, 0]
    return Motion(
        rotations=rotations.float(),
        translation=(root - skeleton.rest_joints[0].double()).float(),
        fps=motion.fps,
        skeleton=skeleton,
        name=motion.name,
    )


def _spread_spine(
    world: Float[Tensor, "T J 3 3"], source_roles: Mapping[str, int], target_roles: Mapping[str, int]
) -> dict[str, Float[Tensor, "T 3 3"]]:
    """Role -> global rotations, of the target's spine where one joint of the source bends all of its own; else nothing.

    The bend from the pelvis to the chest is shared evenly, about one axis.
    """
    own = [source_roles[role] for role in SPINE if role in source_roles]
    wanted = [role for role in SPINE if role in target_roles]
    if len(own) != 1:
        return {}
    pelvis, chest = world[:, source_roles["Hips"]], world[:, own[0]]
    bend = matrix_to_axis_angle(pelvis.mT @ chest)
    return {role: pelvis @ axis_angle_to_matrix(k / len(wanted) * bend) for k, role in enumerate(wanted, start=1)}


def _turn_up(axis: Axis) -> Float[Tensor, "3 3"]:
    up = torch.eye(3, dtype=torch.float64)["xyz".index(axis[-1])] * (-1.0 if axis[0] == "-" else 1.0)
    return smallest_rotation(up, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))


def _leg_length(skeleton: Skeleton, roles: Mapping[str, int]) -> float:
    """Thigh and shin, mean of both sides."""
    rest, total = skeleton.rest_joints.double(), 0.0
    for side in SIDES:
        hip, knee, ankle = (rest[roles[side + part]] for part in ("UpLeg", "Leg", "Foot"))
        total += float((knee - hip).norm() + (ankle - knee).norm())
    return total / len(SIDES)
