"""Generated motions: deterministic, inside joint limits, feet on the floor, train and test apart."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from assets_gen import motions as M
from workbench.body.skeleton import Skeleton
from workbench.body.skinning import linear_blend
from workbench.motion import Motion

ONE_EACH = [f"{family}_00" for family in M.FAMILIES]


@pytest.fixture(scope="module")
def made(body):
    return {name: M.generate(name, body.skeleton) for name in ONE_EACH}


def test_there_are_enough_and_train_and_test_share_no_family():
    train, test = M.motion_names("train"), M.motion_names("test")
    assert len(train) >= 40
    assert len(test) >= 20
    assert set(train) | set(test) == set(M.motion_names())

    def families(names):
        return {name.rpartition("_")[0] for name in names}

    assert not families(train) & families(test)
    assert all(name.startswith("test_") for name in test)
    choreographers = [family.choreograph for family in M.FAMILIES.values()]
    assert len(set(choreographers)) == len(choreographers)  # no pattern serves both


def test_the_seed_decides_everything(body):
    again = [M.generate("reach_01", body.skeleton, seed=3) for _ in range(2)]
    assert torch.equal(again[0].rotations, again[1].rotations)
    assert torch.equal(again[0].translation, again[1].translation)
    other = M.generate("reach_01", body.skeleton, seed=4)
    assert len(other) != len(again[0]) or not torch.equal(other.rotations, again[0].rotations)
    sibling = M.generate("reach_02", body.skeleton, seed=3)
    assert len(sibling) != len(again[0]) or not torch.equal(sibling.rotations, again[0].rotations)


@pytest.mark.parametrize("name", ONE_EACH)
def test_a_motion_has_60_to_150_frames_at_30_fps_inside_joint_limits(made, name):
    motion = made[name]
    assert isinstance(motion, Motion)
    assert motion.name == name
    assert motion.fps == 30
    assert 60 <= len(motion) <= 150
    assert M.beyond_limits(motion).max() <= 0.1  # degrees


@pytest.mark.parametrize("name", ONE_EACH)
def test_soles_neither_sink_nor_float_away(made, body, name):
    motion = made[name]
    sole = (body.template[:, 2] < 0.02).nonzero()[:, 0]
    pose = body.pose(motion.rotations, body.mean_shape(), motion.translation)
    height = linear_blend(body.template[sole], body.weights[sole], pose.transforms)[..., 2].amin(1)
    assert height.min() > -0.02
    assert height.min() < 0.01  # it does stand
    in_the_air = float((height > 0.03).double().mean())
    assert in_the_air < (0.6 if name.startswith(("test_jack", "test_jog", "jump")) else 0.05)


@pytest.mark.parametrize("name", ["squat_00", "twist_00", "excursion_00", "test_bow_00", "test_wild_00"])
def test_planted_feet_do_not_slide(made, body, name):
    motion = made[name]
    joints = body.pose(motion.rotations, body.mean_shape(), motion.translation).joints
    for toe in ("LeftToeBase", "RightToeBase"):
        path = joints[:, body.skeleton.index(toe), :2]
        assert (path - path[0]).norm(dim=-1).max() < 0.015


def test_walks_walk(made, body):
    walk = made["walk_00"]
    travelled = (walk.translation[-1, :2] - walk.translation[0, :2]).norm() / walk.duration
    assert 0.5 < travelled < 1.7  # m/s
    assert walk.translation[-1, 1] < walk.translation[0, 1]  # it faces -y


@pytest.mark.parametrize("name", ONE_EACH)
def test_motions_are_smooth(made, name):
    step = made[name].rotations[1:] - made[name].rotations[:-1]
    assert step.flatten(2).norm(dim=-1).max() < np.sqrt(2) * np.deg2rad(40)  # a joint turns < 40 degrees a frame


def test_joint_angles_are_those_that_were_put_in(body):
    skeleton = body.skeleton
    generator = torch.Generator().manual_seed(1)
    for name, frame in M.joint_frames(skeleton).items():
        identity = torch.eye(3, dtype=torch.float64)
        assert torch.allclose(frame.axes @ frame.axes.T, identity, atol=1e-4), name
        angles = 80 * (torch.rand(20, 3, generator=generator, dtype=torch.float64) - 0.5)
        assert torch.allclose(frame.angles(frame.rotation(angles)), angles, atol=1e-2), name


def test_positive_angles_mean_the_same_on_both_sides(body):
    """Mirrored angles give the mirrored skeleton: forward, outward, and bending as people bend."""
    t = np.arange(4) / 30
    standing = M.standing(np.random.default_rng(0), t)
    arm = np.zeros((4, 2, 3)) + np.array([40.0, 30.0, 20.0])
    still = replace(
        standing,
        pelvis=0 * standing.pelvis,
        neck=0 * standing.neck,
        spine=0 * standing.spine,
        arm=arm,
        elbow=np.full((4, 2), 60.0),
        forearm=np.full((4, 2), 30.0),
        fingers=np.full((4, 2), 20.0),
        foot_yaw=np.tile([8.0, -8.0], (4, 1)),
    )
    motion = M.pose(still, body.skeleton)
    joints = body.pose(motion.rotations, body.mean_shape(), motion.translation).joints[0]
    for name in ("Arm", "ForeArm", "Hand", "Leg", "Foot", "ToeBase", "HandFinger1"):
        left, right = (joints[body.skeleton.index(side + name)] for side in ("Left", "Right"))
        assert torch.allclose(left * torch.tensor([-1.0, 1, 1]), right, atol=2e-3), name
    elbow, hand = joints[body.skeleton.index("LeftForeArm")], joints[body.skeleton.index("LeftHand")]
    shoulder = joints[body.skeleton.index("LeftArm")]
    assert elbow[1] < shoulder[1]  # flexed forward, to -y
    assert elbow[0] > shoulder[0]  # abducted
    assert hand[1] < elbow[1]  # elbows bend forward


def test_knees_bend_backwards_only(made, body):
    frames = M.joint_frames(body.skeleton)
    for motion in made.values():
        for knee in ("LeftLeg", "RightLeg"):
            angles = frames[knee].angles(motion.rotations[:, body.skeleton.index(knee)].double())
            assert angles[:, 0].min() > -0.5  # degrees: flexion, never the other way


def test_a_longer_skeleton_gets_the_same_dance(body):
    skeleton = body.skeleton
    tall = Skeleton(skeleton.names, skeleton.parents, 1.2 * skeleton.rest_joints)
    short, long = M.generate("squat_00", skeleton), M.generate("squat_00", tall)
    assert torch.allclose(1.2 * short.translation, long.translation, atol=2e-3)


def test_unusable_requests_are_refused(body):
    with pytest.raises(ValueError, match="no motion is called 'moonwalk_00'; expected FAMILY_NN"):
        M.generate("moonwalk_00", body.skeleton)
    with pytest.raises(ValueError, match="split is 'dev'; expected train, test or all"):
        M.motion_names("dev")
    with pytest.raises(ValueError, match="at least 2 frames, but 1"):
        M.generate("walk_00", body.skeleton, frames=1)
    smpl = Skeleton(("pelvis", "knee"), (-1, 0), torch.zeros(2, 3))
    with pytest.raises(ValueError, match="the skeleton lacks the joints .*Hips"):
        M.generate("walk_00", smpl)
    broken = M.standing(np.random.default_rng(0), np.arange(5) / 30)
    with pytest.raises(ValueError, match="choreography 'broken': heel holds NaN"):
        M.pose(replace(broken, heel=np.full((5, 2), np.nan)), body.skeleton, "broken")
    with pytest.raises(ValueError, match="no motion name matches 'x'"):
        M.run(M.MotionsConfig(only="x"))


def test_the_command_lists_and_saves(tmp_path, capsys):
    motions = M.run(M.MotionsConfig(out=tmp_path, only="test_hula_*"))
    assert len(motions) == M.TEST_COUNT
    assert re.search(r"test_hula_00 +test +\d+ frames", capsys.readouterr().out)
    saved = Motion.load(tmp_path / "test_hula_00.npz")
    assert torch.allclose(saved.rotations, motions[0].rotations, atol=1e-5)
