"""Retargeting: laws that hold for every naming convention, unit and axis; nothing here is measured capture."""

import logging
import math

import numpy as np
import pytest
import torch

from workbench.body.model import body_from_arrays
from workbench.body.skeleton import Skeleton
from workbench.body.skinning import forward_kinematics
from workbench.formats import load_motion
from workbench.formats.amass import smpl_t_pose
from workbench.formats.bvh import read_bvh, write_bvh
from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rotation_angle
from workbench.motion import Motion
from workbench.retargeting import RetargetConfig, grounded, reframed, reframed_skeleton, retarget
from workbench.rig_names import CONVENTIONS, REQUIRED_ROLES, roles_of

LIMB_BONES = [
    (side + start, side + end)
    for side in ("Left", "Right")
    for start, end in (("Arm", "ForeArm"), ("ForeArm", "Hand"), ("UpLeg", "Leg"), ("Leg", "Foot"))
]

# A T-pose of our own, z up, facing -y: role -> (parent, place).  Not the default body's: other lengths, other slopes.
_MIDDLE = {
    "Hips": (None, (0.0, 0.0, 0.95)),
    "LowerBack": ("Hips", (0.0, 0.0, 1.02)),
    "Spine": ("LowerBack", (0.0, 0.01, 1.15)),
    "Spine1": ("Spine", (0.0, 0.02, 1.28)),
    "Neck": ("Spine1", (0.0, 0.02, 1.46)),
    "Neck1": ("Neck", (0.0, 0.01, 1.51)),
    "Head": ("Neck1", (0.0, 0.0, 1.56)),
}
_LEFT = {
    "LHipJoint": ("Hips", (0.0, 0.0, 0.95)),
    "LeftUpLeg": ("LHipJoint", (0.1, 0.0, 0.9)),
    "LeftLeg": ("LeftUpLeg", (0.12, -0.01, 0.49)),
    "LeftFoot": ("LeftLeg", (0.12, 0.02, 0.08)),
    "LeftToeBase": ("LeftFoot", (0.14, -0.12, 0.06)),
    "LeftShoulder": ("Spine1", (0.03, 0.0, 1.4)),
    "LeftArm": ("LeftShoulder", (0.18, 0.0, 1.42)),
    "LeftForeArm": ("LeftArm", (0.47, 0.01, 1.42)),
    "LeftHand": ("LeftForeArm", (0.72, -0.02, 1.42)),
    "LThumb": ("LeftHand", (0.75, -0.05, 1.41)),
    "LeftFingerBase": ("LeftHand", (0.8, -0.02, 1.42)),
    "LeftHandFinger1": ("LeftFingerBase", (0.85, -0.02, 1.42)),
}


def _other(name):
    return "Right" + name[4:] if name.startswith("Left") else "R" + name[1:] if name[:2] in ("LH", "LT") else name


T_POSE = _MIDDLE | _LEFT | {_other(n): (_other(p), (-x, y, z)) for n, (p, (x, y, z)) in _LEFT.items()}


def rig(convention="CMU / MotionBuilder", prefix="", without=()):
    """The T-pose under the joint names of a convention; roles that it lacks are left out."""
    table = {role: names[0] for role, names in CONVENTIONS[convention].items() if role not in without}
    kept = [role for role in T_POSE if role in table]

    def parent(role):
        above = T_POSE[role][0]
        return -1 if above is None else kept.index(above) if above in kept else parent(above)

    parents = [parent(role) for role in kept]
    return Skeleton(
        tuple(prefix + table[role] for role in kept), tuple(parents), torch.tensor([T_POSE[role][1] for role in kept])
    )


def moving(skeleton, frames=20, size=0.5, seed=0, fps=30.0):
    """Smooth random rotations of every joint, and a random path."""
    generator = torch.Generator().manual_seed(seed)
    wave = torch.sin(
        torch.linspace(0, 2, frames)[:, None, None] * (1 + torch.rand(1, len(skeleton), 3, generator=generator))
        + 6 * torch.rand(1, len(skeleton), 3, generator=generator)
    )
    path = torch.cumsum(0.1 * torch.rand(frames, 3, generator=generator), 0)
    return Motion(axis_angle_to_matrix(size * wave), path, fps, skeleton, name="moving")


def joints(motion):
    pose = forward_kinematics(motion.rotations.double(), motion.skeleton.rest_joints.double(), motion.skeleton.parents)
    return pose.joints + motion.translation.double()[:, None], pose.transforms.rotation


def bone_directions(motion, bones=LIMB_BONES):
    places, _ = joints(motion)
    roles = roles_of(motion.skeleton)
    return torch.stack(
        [torch.nn.functional.normalize(places[:, roles[b]] - places[:, roles[a]], dim=-1) for a, b in bones]
    )


def assert_same(one, other, atol=1e-5):
    torch.testing.assert_close(one.rotations, other.rotations, rtol=0, atol=atol)
    torch.testing.assert_close(one.translation, other.translation, rtol=0, atol=atol)


RIGS = {
    "CMU": {"convention": "CMU / MotionBuilder"},
    "DAZ": {"convention": "DAZ / Poser", "without": ("LeftToeBase", "RightToeBase", "Spine1", "Neck1")},
    "Mixamo": {"convention": "Mixamo"},
    "Mixamo with prefix": {"convention": "Mixamo", "prefix": "mixamorig:"},
    "SMPL": {"convention": "SMPL"},
    "Biovision": {"convention": "Biovision"},
    "Unity": {"convention": "Unity / VRM"},
    "Bandai Namco": {"convention": "Bandai Namco"},
    "Xsens": {"convention": "Xsens MVN"},
    "Unreal": {"convention": "Unreal"},
    "Rigify": {"convention": "Blender Rigify"},
    "Biped": {"convention": "3ds Max Biped", "prefix": "Bip01_"},
    "Acclaim": {"convention": "Acclaim"},
}


def test_every_convention_is_tried_here():
    assert {one["convention"] for one in RIGS.values()} == set(CONVENTIONS)


@pytest.mark.parametrize("side", ["left", "right"])
def test_no_convention_gives_a_joint_two_roles_or_a_side_the_names_of_the_other(side):
    other = {"left": "Right", "right": "Left"}[side]
    for convention, table in CONVENTIONS.items():
        first = [names[0].lower() for names in table.values()]
        if convention != "DAZ / Poser":  # its generations split the spine differently
            assert len(set(first)) == len(first), convention
        mine = {name for role, names in table.items() if role.startswith(side.title()) for name in names}
        assert not mine & {name for role, names in table.items() if role.startswith(other) for name in names}


@pytest.fixture(params=RIGS)
def source(request):
    return rig(**RIGS[request.param])


def test_every_convention_is_recognised_by_its_names(source):
    roles = roles_of(source)
    for role, j in roles.items():
        torch.testing.assert_close(source.rest_joints[j], torch.tensor(T_POSE[role][1]))
    assert set(REQUIRED_ROLES) <= roles.keys()


def test_a_motion_on_its_own_skeleton_stays_as_it_is(body):
    motion = moving(body.skeleton)
    assert_same(retarget(motion, body.skeleton), motion)


def test_limbs_point_where_the_source_points_them(source, body, tmp_path):
    motion = moving(source)
    write_bvh(tmp_path / "m.bvh", motion)
    retargeted = retarget(read_bvh(tmp_path / "m.bvh"), body.skeleton)
    assert len(retargeted) == len(motion)
    torch.testing.assert_close(bone_directions(retargeted), bone_directions(motion), rtol=0, atol=1e-4)


def test_pelvis_spine_and_head_turn_as_the_source_turns_them(source, body):
    motion = moving(source)
    retargeted = retarget(motion, body.skeleton)
    ours, theirs = roles_of(body.skeleton), roles_of(source)
    for role in ("Hips", "LowerBack", "Spine", "Neck", "Head", "LeftShoulder", "RightShoulder"):
        torch.testing.assert_close(
            joints(retargeted)[1][:, ours[role]], joints(motion)[1][:, theirs[role]], rtol=0, atol=1e-5
        )


def test_the_chest_carries_the_arms_when_the_source_has_fewer_vertebrae(body):
    motion = moving(rig(**RIGS["DAZ"]))
    retargeted = retarget(motion, body.skeleton)
    chest = joints(motion)[1][:, motion.skeleton.index("chest")]
    torch.testing.assert_close(joints(retargeted)[1][:, body.skeleton.index("Spine1")], chest, rtol=0, atol=1e-5)


def test_a_spine_of_one_joint_is_shared_by_all_of_ours_and_the_chest_stays_where_it_was(body):
    motion = moving(rig(without=("Spine", "Spine1")))
    retargeted = retarget(motion, body.skeleton)
    bend = motion.rotations[:, motion.skeleton.index("LowerBack")]
    local = [retargeted.rotations[:, body.skeleton.index(role)] for role in ("LowerBack", "Spine", "Spine1")]
    for one in local[1:]:
        torch.testing.assert_close(one, local[0], rtol=0, atol=1e-5)
    torch.testing.assert_close(local[0] @ local[1] @ local[2], bend, rtol=0, atol=1e-5)
    for one, whole in zip(rotation_angle(local[0]), rotation_angle(bend), strict=True):
        assert float(one) == pytest.approx(float(whole) / 3, abs=1e-4)


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("units", [1.0, 100.0, 39.37 * 0.45])
def test_units_and_up_axis_of_the_file_do_not_matter(up, units, source, body, tmp_path):
    motion = moving(source)
    write_bvh(tmp_path / "m.bvh", motion, up=up, units_per_metre=units)
    assert_same(retarget(read_bvh(tmp_path / "m.bvh"), body.skeleton), retarget(motion, body.skeleton), atol=1e-4)


@pytest.mark.parametrize("turn", [(0.0, 0.0, math.pi / 2), (0.0, 0.0, 2.0), (math.pi / 2, 0.0, 0.0), (0.0, 0.0, 2.5)])
def test_the_axes_of_the_source_do_not_matter(turn, body):
    motion = moving(rig())
    R = axis_angle_to_matrix(torch.tensor(turn, dtype=torch.float64))
    assert_same(retarget(reframed(motion, R), body.skeleton), retarget(motion, body.skeleton), atol=1e-4)


def test_a_world_with_another_up_axis_is_named_by_the_user(body):
    """Rest pose y up, world z up: the root turns the body, and the file does not say so."""
    motion = moving(rig())
    quarter = axis_angle_to_matrix(torch.tensor([-math.pi / 2, 0, 0], dtype=torch.float64))
    y_up_rest = reframed(motion, quarter)
    rotations = motion.rotations.double() @ quarter.mT
    rotations[:, 1:] = y_up_rest.rotations[:, 1:].double()
    root = motion.skeleton.rest_joints[0] + motion.translation
    mixed = Motion(rotations.float(), root - y_up_rest.skeleton.rest_joints[0], 30.0, y_up_rest.skeleton)
    config = RetargetConfig(world_up="z")
    assert_same(retarget(mixed, body.skeleton, config=config), retarget(motion, body.skeleton), atol=1e-4)


def test_the_path_is_scaled_by_leg_length(body):
    motion = moving(rig())
    twice = Motion(
        motion.rotations, 2 * motion.translation, 30.0, reframed_skeleton(motion.skeleton, torch.eye(3), scale=2.0)
    )
    assert_same(retarget(twice, body.skeleton), retarget(motion, body.skeleton))


def test_hips_stay_where_the_source_has_them(body):
    """The pelvis joint sits elsewhere in every rig; the middle of the hip joints does not."""
    motion = moving(rig())
    retargeted = retarget(motion, body.skeleton)
    middles = []
    for one in (motion, retargeted):
        roles = roles_of(one.skeleton)
        middles.append(joints(one)[0][:, [roles["LeftUpLeg"], roles["RightUpLeg"]]].mean(1))
    ratio = (middles[1] - middles[1][:1])[1:] / (middles[0] - middles[0][:1])[1:]
    torch.testing.assert_close(ratio, ratio.mean().expand_as(ratio), rtol=0, atol=1e-3)


# Elbows, knees, feet


def folding(skeleton, axis, role="LeftForeArm", frames=30):
    """Only one elbow (or knee) folds, about an axis of the source's rest frame."""
    rotations = torch.eye(3).repeat(frames, len(skeleton), 1, 1)
    angles = torch.linspace(0.2, 2.0, frames)[:, None] * torch.nn.functional.normalize(torch.tensor(axis), dim=0)
    rotations[:, roles_of(skeleton)[role]] = axis_angle_to_matrix(angles)
    return Motion(rotations, torch.zeros(frames, 3), 30.0, skeleton)


@pytest.mark.parametrize("tilt", [-40.0, 0.0, 30.0])
def test_elbows_fold_forward_in_the_body_wherever_the_source_has_their_axis(tilt, body):
    """The source's forearm folds about an axis turned about the arm; the body's own crease must do the folding."""
    skeleton = rig()
    arm = skeleton.rest_joints[skeleton.index("LeftHand")] - skeleton.rest_joints[skeleton.index("LeftForeArm")]
    arm = (arm / arm.norm()).double()
    axis = torch.linalg.cross(arm, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    about_arm = axis_angle_to_matrix(math.radians(tilt) * arm)
    motion = folding(skeleton, (about_arm @ axis).tolist())
    retargeted = retarget(motion, body.skeleton, config=RetargetConfig(drop_t_pose=False))
    local = retargeted.rotations[:, body.skeleton.index("LeftForeArm")]
    rest = body.skeleton.rest_joints
    bone = rest[body.skeleton.index("LeftHand")] - rest[body.skeleton.index("LeftForeArm")]
    crease = torch.nn.functional.normalize(torch.linalg.cross(bone, torch.tensor([0.0, -1.0, 0.0])), dim=0)
    turned = torch.nn.functional.normalize(matrix_to_axis_angle(local[-1].mT @ local[0]), dim=0)
    assert math.degrees(math.acos(min(1.0, abs(float(turned @ crease))))) < 2.0
    torch.testing.assert_close(bone_directions(retargeted), bone_directions(motion), rtol=0, atol=1e-4)


def test_an_axis_beyond_belief_is_taken_for_noise(body):
    straight, odd = folding(rig(), (0.0, 0.0, -1.0)), folding(rig(), (0.0, 0.0, 1.0))
    arm = body.skeleton.index("LeftArm")
    config = RetargetConfig(drop_t_pose=False)
    one, other = (retarget(m, body.skeleton, config=config).rotations[0, arm] for m in (straight, odd))
    assert float(rotation_angle(one.mT @ other)) < math.radians(5)


def test_soles_are_flat_where_both_rest_poses_stand(body):
    still = Motion(torch.eye(3).repeat(20, len(rig()), 1, 1), torch.zeros(20, 3), 30.0, rig())
    retargeted = retarget(still, body.skeleton, config=RetargetConfig(drop_t_pose=False))
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for name in ("LeftFoot", "RightFoot", "LeftToeBase", "RightToeBase"):
        torch.testing.assert_close(joints(retargeted)[1][0, body.skeleton.index(name)] @ up, up, rtol=0, atol=1e-6)


@pytest.mark.parametrize(("pitch", "left"), [(-7.0, 0.0), (6.0, 0.0), (-35.0, -35.0)])
def test_feet_that_always_stand_at_a_slope_are_levelled_but_toe_stands_are_kept(pitch, left, body):
    """A few degrees are an error of the rest pose; far more is meant."""
    skeleton = rig()
    rotations = torch.eye(3).repeat(40, len(skeleton), 1, 1)
    tip = axis_angle_to_matrix(torch.tensor([-math.radians(pitch), 0.0, 0.0]))
    for name in ("LeftFoot", "RightFoot"):
        rotations[:, skeleton.index(name)] = tip
    motion = Motion(rotations, torch.randn(40, 3, generator=torch.Generator().manual_seed(0)) * 1e-4, 30.0, skeleton)
    retargeted = retarget(motion, body.skeleton, config=RetargetConfig(drop_t_pose=False))
    foot = joints(retargeted)[1][0, body.skeleton.index("LeftFoot")]
    ahead = foot @ torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    assert math.degrees(math.asin(float(ahead[2]))) == pytest.approx(left, abs=0.5)


# Calibration frames


def with_t_pose(skeleton, lead, seed=0):
    motion = moving(skeleton, frames=40, seed=seed)
    low = motion.rotations.clone()
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        low[:, roles_of(skeleton)[side + "Arm"]] = axis_angle_to_matrix(torch.tensor([0.0, sign * 1.2, 0.0]))
    low[:lead] = torch.eye(3)
    return Motion(low, motion.translation, 30.0, skeleton, name="calibrated")


def test_t_pose_frames_are_dropped_and_reported(source, body, caplog):
    motion = with_t_pose(source, lead=3)
    with caplog.at_level(logging.INFO):
        retargeted = retarget(motion, body.skeleton)
    assert "calibrated: dropped 3 T-pose frames" in caplog.text
    assert_same(retargeted, retarget(motion.clip(3), body.skeleton))
    assert len(retarget(motion, body.skeleton, config=RetargetConfig(drop_t_pose=False))) == 40


def test_a_fast_way_out_of_the_t_pose_is_dropped_with_it(body):
    motion = with_t_pose(rig(), lead=3)
    ramp = motion.rotations.clone()
    for side in ("Left", "Right"):
        arm = motion.skeleton.index(side + "Arm")
        ramp[3, arm] = axis_angle_to_matrix(0.5 * matrix_to_axis_angle(ramp[4, arm]))
    quick = Motion(ramp, motion.translation, 120.0, motion.skeleton)
    assert len(retarget(quick, body.skeleton)) == 36
    slow = Motion(ramp, motion.translation, 5.0, motion.skeleton)
    assert len(retarget(slow, body.skeleton)) == 37


def test_a_clip_that_is_all_t_pose_or_starts_otherwise_is_kept(body):
    assert len(retarget(with_t_pose(rig(), lead=40), body.skeleton)) == 40
    assert len(retarget(with_t_pose(rig(), lead=0), body.skeleton)) == 40


def test_a_rest_that_is_no_t_pose_is_never_dropped(body):
    rest = torch.eye(3).repeat(10, len(body.skeleton), 1, 1)
    rest[5:, body.skeleton.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 1.0, 0.0]))
    assert len(retarget(Motion(rest, torch.zeros(10, 3), 30.0, body.skeleton), body.skeleton)) == 10


# Files


def save_amass(path, motion):
    """A motion on smpl_t_pose's tree, y up rest in a z-up world, as an AMASS file has it."""
    pose = matrix_to_axis_angle(motion.rotations.double()).flatten(1)
    trans = motion.translation.double()
    np.savez(path, poses=pose.numpy(), trans=trans.numpy(), mocap_framerate=np.array(motion.fps))


def test_amass_and_bvh_of_one_motion_agree(body, tmp_path):
    """Default rig -> SMPL's joints -> AMASS npz -> default rig: limbs point the same way all along."""
    motion = moving(body.skeleton, size=0.4)
    on_smpl = retarget(motion, smpl_t_pose())
    save_amass(tmp_path / "m.npz", on_smpl)
    back = load_motion(tmp_path / "m.npz", body)
    torch.testing.assert_close(bone_directions(back), bone_directions(motion), rtol=0, atol=1e-4)
    moved, expected = back.translation - back.translation[:1], motion.translation - motion.translation[:1]
    torch.testing.assert_close(moved, expected, rtol=0, atol=0.05)


def test_loading_puts_the_body_on_the_floor_in_one_piece(body, tmp_path):
    motion = moving(rig(), size=0.2)
    for name, lift in (("low", 0.0), ("high", 1.7)):
        lifted = motion.translation + torch.tensor([0.0, 0.0, lift])
        write_bvh(tmp_path / f"{name}.bvh", Motion(motion.rotations, lifted, 30.0, motion.skeleton))
    low, high = load_motion(tmp_path / "low.bvh", body), load_motion(tmp_path / "high.bvh", body)
    assert_same(low, high, atol=1e-4)
    vertices = body.vertices(low.rotations, torch.zeros(body.shape_count), low.translation)
    lowest = vertices[..., 2].amin(1)
    assert float(lowest.quantile(0.1)) == pytest.approx(0.0, abs=1e-4)


def test_grounding_keeps_jumps_in_the_air(body):
    still = Motion(torch.eye(3).repeat(20, len(body.skeleton), 1, 1), torch.zeros(20, 3), 30.0, body.skeleton)
    jump = still.translation.clone()
    jump[8:14, 2] = 0.4
    landed = grounded(Motion(still.rotations, jump + 0.3, 30.0, body.skeleton), body)
    torch.testing.assert_close(landed.translation[:, 2], jump[:, 2], rtol=0, atol=0.003)
    torch.testing.assert_close(landed.translation[:, :2], jump[:, :2] + 0.3)


def test_our_own_files_come_as_they_were_saved(body, tmp_path):
    motion = moving(body.skeleton)
    motion.save(tmp_path / "m.npz")
    assert_same(load_motion(tmp_path / "m.npz", body), motion, atol=1e-6)
    assert load_motion(tmp_path / "m.npz", body, fps=60.0).fps == 60.0


def test_our_own_files_of_another_skeleton_are_retargeted(body, tmp_path):
    motion = moving(rig())
    motion.save(tmp_path / "m.npz")
    loaded = load_motion(tmp_path / "m.npz", body)
    assert loaded.skeleton.same_tree(body.skeleton)
    torch.testing.assert_close(bone_directions(loaded), bone_directions(motion), rtol=0, atol=1e-4)


# Names that no convention knows


def renamed(skeleton, changes):
    return Skeleton(tuple(changes.get(n, n) for n in skeleton.names), skeleton.parents, skeleton.rest_joints)


def test_unknown_names_are_refused_with_what_is_missing_and_mended_by_a_mapping(body, tmp_path):
    motion = moving(rig())
    odd = Motion(
        motion.rotations, motion.translation, 30.0, renamed(motion.skeleton, {"LeftLeg": "KneeL", "Hips": "Basin"})
    )
    write_bvh(tmp_path / "odd.bvh", odd)
    with pytest.raises(
        ValueError,
        match=r"odd\.bvh.*no joint was found for Hips, LeftLeg; the joints are .*KneeL.*motions\.notes\.json",
    ):
        load_motion(tmp_path / "odd.bvh", body)
    mapping = {"LeftLeg": "KneeL", "Hips": "Basin"}
    assert_same(retarget(odd, body.skeleton, mapping=mapping), retarget(motion, body.skeleton))


def test_wrong_mappings_are_refused(body):
    motion = moving(rig())
    with pytest.raises(ValueError, match="mapping names the role 'LeftKnee'; roles are Hips"):
        retarget(motion, body.skeleton, mapping={"LeftKnee": "LeftLeg"})
    with pytest.raises(ValueError, match="mapping takes LeftLeg from the joint 'Knee', but the motion has Hips"):
        retarget(motion, body.skeleton, mapping={"LeftLeg": "Knee"})


def test_rests_without_shape_are_refused(body):
    skeleton = rig()
    flat = Skeleton(skeleton.names, skeleton.parents, skeleton.rest_joints * torch.tensor([0.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="span no plane"):
        retarget(moving(flat), body.skeleton)
    joints_ = skeleton.rest_joints.clone()
    for name in ("LeftHand", "LeftFingerBase", "LeftHandFinger1", "LThumb"):
        joints_[skeleton.index(name)] = joints_[skeleton.index("LeftForeArm")]
    with pytest.raises(ValueError, match="source's rest pose the bone from LeftForeArm to LeftHand has no length"):
        retarget(moving(Skeleton(skeleton.names, skeleton.parents, joints_)), body.skeleton)


@pytest.mark.parametrize("name", ["clip.fbx", "clip", "clip.bvh.txt"])
def test_other_file_types_are_named(name, body, tmp_path):
    (tmp_path / name).write_text("?")
    with pytest.raises(ValueError, match=r"clip.*motions are read from \.bvh"):
        load_motion(tmp_path / name, body)


def test_an_npz_without_motion_is_named(body, tmp_path):
    np.savez(tmp_path / "mesh.npz", vertices=np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"mesh\.npz holds no motion.*but has vertices"):
        load_motion(tmp_path / "mesh.npz", body)


def smpl_body():
    """A body with SMPL's 24 joints and y-up rest, but nobody's shape: four vertices around each joint."""
    generic = smpl_t_pose()
    uneven = generic.rest_joints + 0.02 * torch.randn(22, 3, generator=torch.Generator().manual_seed(5))
    places = torch.cat([uneven, uneven[20:] + torch.tensor([[0.08, 0.0, 0.0], [-0.08, 0.0, 0.0]])])
    corners = 0.02 * torch.tensor([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [-1.0, -1.0, -1.0]])
    tetrahedron = np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    return body_from_arrays(
        {
            "name": np.array("smpl"),
            "template": (places[:, None] + corners).reshape(-1, 3).numpy(),
            "shape_directions": np.zeros((1, 96, 3), np.float32),
            "pose_directions": np.zeros((1, 96, 3), np.float32),
            "pose_map": np.zeros((9 * 23, 1), np.float32),
            "weights": np.eye(24, dtype=np.float32).repeat(4, axis=0),
            "joint_template": places.numpy(),
            "joint_directions": np.zeros((1, 24, 3), np.float32),
            "faces": np.concatenate([tetrahedron + 4 * j for j in range(24)]),
            "parents": np.array([*generic.parents, 20, 21]),
            "joint_names": np.array([*generic.names, "left_hand", "right_hand"]),
        }
    )


def test_amass_poses_are_an_smpl_body_s_own(tmp_path):
    """On a body with SMPL's joints the file's rotations are used as they are; only the height changes."""
    body = smpl_body()
    rng = np.random.default_rng(2)
    poses = 0.4 * rng.normal(size=(12, 72))
    trans = rng.normal(size=(12, 3))
    np.savez(tmp_path / "m.npz", poses=poses, trans=trans, mocap_framerate=np.array(60.0))
    motion = load_motion(tmp_path / "m.npz", body, config=RetargetConfig(drop_t_pose=False))
    expected = axis_angle_to_matrix(torch.from_numpy(poses).unflatten(1, (24, 3))).float()
    torch.testing.assert_close(motion.rotations[:, :22], expected[:, :22], rtol=0, atol=1e-5)
    shift = motion.translation - torch.from_numpy(trans).float()
    torch.testing.assert_close(shift[:, :2], torch.zeros(12, 2), rtol=0, atol=1e-5)
    torch.testing.assert_close(shift[:, 2], shift[:1, 2].expand(12), rtol=0, atol=1e-5)
