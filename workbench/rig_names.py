"""What rigs call their joints.  skeleton -> which joint plays which role.

A role is a joint of the default rig (cmu_mb); a convention says what others call it, best name first.
"""

import re
from collections.abc import Mapping
from types import MappingProxyType

from workbench.body.skeleton import Skeleton

SIDES = ("Left", "Right")
SPINE = ("LowerBack", "Spine", "Spine1")  # from the pelvis to the chest
LIMBS = ("UpLeg", "Leg", "Foot", "Arm", "ForeArm", "Hand")
REQUIRED_ROLES = ("Hips", *(side + limb for side in SIDES for limb in LIMBS))


def _sided(
    left: Mapping[str, str],
    starts: Mapping[str, str] = MappingProxyType({}),
    ends: Mapping[str, str] = MappingProxyType({}),
) -> dict[str, tuple[str, ...]]:
    """A table with both sides, from that of the left side and what turns left names into right ones, by how they start
    or end."""

    def right(name: str) -> str:
        for old, new in starts.items():
            if name.startswith(old):
                return new + name[len(old) :]
        for old, new in ends.items():
            if name.endswith(old):
                return name[: -len(old)] + new
        return name

    both = {role: tuple(names.split()) for role, names in left.items()}
    for role, names in left.items():
        other = "Right" + role[4:] if role.startswith("Left") else "R" + role[1:] if role[:2] in ("LH", "LT") else role
        both.setdefault(other, tuple(right(name) for name in names.split()))
    return both


def _limbs(names: str) -> dict[str, str]:
    """UpLeg Leg Foot ToeBase Shoulder Arm ForeArm Hand of the left side, in this order; alternatives with '|'."""
    parts = ("UpLeg", "Leg", "Foot", "ToeBase", "Shoulder", "Arm", "ForeArm", "Hand")
    return {f"Left{part}": name.replace("|", " ") for part, name in zip(parts, names.split(), strict=True)}


CONVENTIONS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "CMU / MotionBuilder": _sided(
        {
            **{
                role: role
                for role in ("Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head", "LHipJoint", "LThumb")
            },
            **{f"Left{part}": f"Left{part}" for part in (*LIMBS, "ToeBase", "Shoulder", "FingerBase")},
            "LeftHandFinger1": "LeftHandFinger1 LFingers LeftHandIndex1",
        },
        {"Left": "Right", "L": "R"},
    ),
    "Mixamo": _sided(
        {
            "Hips": "Hips",
            "LowerBack": "Spine",
            "Spine": "Spine1",
            "Spine1": "Spine2",
            "Neck": "Neck",
            "Head": "Head",
            **{f"Left{part}": f"Left{part}" for part in (*LIMBS, "Shoulder")},
            "LeftToeBase": "LeftToeBase LeftToe",
            "LeftFingerBase": "LeftHandMiddle1",
            "LeftHandFinger1": "LeftHandMiddle2",
            "LThumb": "LeftHandThumb1",
        },
        {"Left": "Right"},
    ),
    "DAZ / Poser": _sided(
        {
            "Hips": "hip",
            "LowerBack": "abdomen abdomenLower",
            "Spine": "chest abdomenUpper",
            "Spine1": "chestUpper chestLower",
            "Neck": "neck neckLower",
            "Neck1": "neckUpper",
            "Head": "head",
            "LeftUpLeg": "lThigh lThighBend",
            "LeftLeg": "lShin",
            "LeftFoot": "lFoot",
            "LeftToeBase": "lToe lToes",
            "LeftShoulder": "lCollar",
            "LeftArm": "lShldr lShldrBend",
            "LeftForeArm": "lForeArm lForearmBend",
            "LeftHand": "lHand",
            "LeftFingerBase": "lMid1",
            "LeftHandFinger1": "lMid2",
            "LThumb": "lThumb1",
        },
        {"l": "r"},
    ),
    "SMPL": _sided(
        {
            "Hips": "pelvis",
            "LowerBack": "spine1",
            "Spine": "spine2",
            "Spine1": "spine3",
            "Neck": "neck",
            "Head": "head",
            "LeftUpLeg": "left_hip L_Hip",
            "LeftLeg": "left_knee L_Knee",
            "LeftFoot": "left_ankle L_Ankle",
            "LeftToeBase": "left_foot L_Foot",
            "LeftShoulder": "left_collar L_Collar",
            "LeftArm": "left_shoulder L_Shoulder",
            "LeftForeArm": "left_elbow L_Elbow",
            "LeftHand": "left_wrist L_Wrist",
            "LeftFingerBase": "left_hand left_middle1 L_Hand",
        },
        {"left": "right", "L_": "R_"},
    ),
    # BVH of Biovision's kind: 100STYLE, Xsens' and many older exports
    "Biovision": _sided(
        {
            "Hips": "Hips",
            "LowerBack": "Chest",
            "Spine": "Chest2",
            "Spine1": "Chest4 Chest3",
            "Neck": "Neck",
            "Head": "Head",
            **_limbs("LeftHip LeftKnee LeftAnkle LeftToe|LeftToes LeftCollar LeftShoulder LeftElbow LeftWrist"),
        },
        {"Left": "Right"},
    ),
    "Unity / VRM": _sided(
        {
            "Hips": "Hips",
            "LowerBack": "Spine",
            "Spine": "Chest",
            "Spine1": "UpperChest",
            "Neck": "Neck",
            "Head": "Head",
            **_limbs(
                "LeftUpperLeg LeftLowerLeg LeftFoot LeftToes LeftShoulder LeftUpperArm LeftLowerArm LeftHand",
            ),
            "LeftFingerBase": "LeftMiddleProximal",
            "LeftHandFinger1": "LeftMiddleIntermediate",
            "LThumb": "LeftThumbProximal",
        },
        {"Left": "Right"},
    ),
    # Unity's words with the side at the end
    "Bandai Namco": _sided(
        {
            "Hips": "Hips",
            "LowerBack": "Spine",
            "Spine": "Chest",
            "Neck": "Neck",
            "Head": "Head",
            **_limbs("UpperLeg_L LowerLeg_L Foot_L Toes_L Shoulder_L UpperArm_L LowerArm_L Hand_L"),
        },
        ends={"_L": "_R"},
    ),
    "Xsens MVN": _sided(
        {
            "Hips": "Pelvis",
            "LowerBack": "L5",
            "Spine": "T12 L3",
            "Spine1": "T8",
            "Neck": "Neck",
            "Head": "Head",
            **_limbs(
                "LeftUpperLeg LeftLowerLeg LeftFoot LeftToe LeftShoulder LeftUpperArm LeftForeArm|LeftForearm LeftHand"
            ),
        },
        {"Left": "Right"},
    ),
    "Unreal": _sided(
        {
            "Hips": "pelvis",
            "LowerBack": "spine_01",
            "Spine": "spine_02",
            "Spine1": "spine_05 spine_03",
            "Neck": "neck_01",
            "Neck1": "neck_02",
            "Head": "head",
            **_limbs("thigh_l calf_l foot_l ball_l clavicle_l upperarm_l lowerarm_l hand_l"),
            "LeftFingerBase": "middle_01_l",
            "LeftHandFinger1": "middle_02_l",
            "LThumb": "thumb_01_l",
        },
        ends={"_l": "_r"},
    ),
    "Blender Rigify": _sided(
        {
            "Hips": "spine",
            "LowerBack": "spine.001",
            "Spine": "spine.002",
            "Spine1": "spine.003",
            "Neck": "spine.004",
            "Neck1": "spine.005",
            "Head": "spine.006",
            **_limbs("thigh.L shin.L foot.L toe.L shoulder.L upper_arm.L forearm.L hand.L"),
            "LeftFingerBase": "f_middle.01.L",
            "LeftHandFinger1": "f_middle.02.L",
            "LThumb": "thumb.01.L",
        },
        ends={".L": ".R"},
    ),
    "3ds Max Biped": _sided(
        {
            "Hips": "Pelvis",
            "LowerBack": "Spine",
            "Spine": "Spine1",
            "Spine1": "Spine3 Spine2",
            "Neck": "Neck",
            "Head": "Head",
            **_limbs("L_Thigh L_Calf L_Foot L_Toe0 L_Clavicle L_UpperArm L_Forearm L_Hand"),
            "LeftFingerBase": "L_Finger2",
            "LeftHandFinger1": "L_Finger21",
            "LThumb": "L_Finger0",
        },
        {"L_": "R_"},
    ),
    # BVH made of ASF/AMC files, whose joints are named by the bones that begin there
    "Acclaim": _sided(
        {
            "Hips": "root hips",
            "LHipJoint": "lhipjoint",
            "LowerBack": "lowerback",
            "Spine": "upperback",
            "Spine1": "thorax",
            "Neck": "lowerneck",
            "Neck1": "upperneck",
            "Head": "head",
            **_limbs("lfemur ltibia lfoot ltoes lclavicle lhumerus lradius lwrist|lhand"),
            "LeftFingerBase": "lfingers",
            "LThumb": "lthumb",
        },
        {"l": "r"},
    ),
}


def _plain(name: str) -> str:
    """A joint name without namespace ('mixamorig:', 'mixamorig1_', 'm_avg_', 'Bip01 '), in small letters, its words
    joined by '_'."""
    own = re.sub(r"^(?:.*:|mixamorig\d*_|[mf]_avg_|bip\d+[ _])", "", name, flags=re.IGNORECASE)
    return own.lower().replace(" ", "_")


def roles_of(skeleton: Skeleton, mapping: Mapping[str, str] | None = None) -> dict[str, int]:
    """Which joint plays which role (joint name of the default rig -> index), by the best fitting convention.

    mapping {role: joint name} adds to it and overrides it.  Raises ValueError listing the required roles that no joint
    plays, or the entries of mapping that name nothing.
    """
    joints = {_plain(name): j for j, name in reversed(list(enumerate(skeleton.names)))}

    def recognised(table: Mapping[str, tuple[str, ...]]) -> dict[str, int]:
        found = {
            role: next((joints[n.lower()] for n in names if n.lower() in joints), -1) for role, names in table.items()
        }
        return {role: j for role, j in found.items() if j >= 0}

    best_name, best = max(
        ((name, recognised(table)) for name, table in CONVENTIONS.items()),
        key=lambda entry: (sum(role in entry[1] for role in REQUIRED_ROLES), len(entry[1])),
    )
    roles = dict(best)
    for role, name in (mapping or {}).items():
        if role not in CONVENTIONS["CMU / MotionBuilder"]:
            raise ValueError(
                f"mapping names the role {role!r}; roles are {', '.join(CONVENTIONS['CMU / MotionBuilder'])}"
            )
        if name not in skeleton.names:
            raise ValueError(
                f"mapping takes {role} from the joint {name!r}, but the motion has {', '.join(skeleton.names)}"
            )
        roles[role] = skeleton.index(name)
    missing = [role for role in REQUIRED_ROLES if role not in roles]
    if missing:
        raise ValueError(
            f"these joint names follow none of the known conventions ({', '.join(CONVENTIONS)}; nearest: {best_name}): "
            f"no joint was found for {', '.join(missing)}; the joints are {', '.join(skeleton.names)}; "
            'write {"joints": {role: joint name}} for what is missing into motions.notes.json beside the file'
        )
    return roles


# Frames of reference
