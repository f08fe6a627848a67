"""Clearing: arms come off the body by what they owe, by little, smoothly; what is clear stays as it is."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from workbench import motion_clearing as C
from workbench.body.skeleton import Skeleton
from workbench.geometry.closest_point import ClosestPoint
from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_axis_angle, rotation_angle
from workbench.geometry.signed_distance import SignedDistance
from workbench.geometry.winding import check_closed
from workbench.motion import Motion

FRAMES = 24


def posed(body, turns, frames=FRAMES, name="made"):
    """A motion that holds the rest pose but for joint -> rotation vector (3) or (T,3)."""
    rotations = body.rest_rotations().repeat(frames, 1, 1, 1)
    for joint, vector in turns.items():
        rotations[:, body.skeleton.index(joint)] = axis_angle_to_matrix(torch.as_tensor(vector, dtype=torch.float32))
    return Motion(rotations, torch.zeros(frames, 3), 30.0, body.skeleton, name)


def hanging(body, angle=0.75, frames=FRAMES):
    """Arms that hang down against the hips (45 degrees below the A pose)."""
    return posed(body, {"LeftArm": [0.0, angle, 0.0], "RightArm": [0.0, -angle, 0.0]}, frames)


def swinging(body):
    """One arm comes down into the hip and leaves again."""
    t = torch.linspace(0, 1, 50)
    down = torch.zeros(50, 3)
    down[:, 1] = 0.85 * torch.sin(torch.pi * t) ** 4
    return posed(body, {"LeftArm": down}, 50)


@pytest.fixture(scope="module")
def cleared_swing(body):
    motion = swinging(body)
    return motion, C.clear_and_report(motion, body)


def test_a_clear_motion_comes_back_unchanged(body):
    rest = posed(body, {}, 6)
    report = C.clear_and_report(rest, body)
    assert torch.equal(report.motion.rotations, rest.rotations)
    assert report.added.max() == 0
    assert report.shortfall_before.max() == 0
    assert not report.unresolved.any()
    assert report.distance_before.min() > 0.03


def test_every_arm_vertex_gets_its_clearance_on_the_real_mesh(body):
    """Not only the samples: all vertices of the arms, by the exact winding number."""
    config = C.ClearingConfig()
    report = C.clear_and_report(hanging(body, frames=5), body, config=config)
    legs, arms, _, core = C._limbs(body, body.mean_shape(), replace(config, all_samples=10**6))
    theta = report.motion.rotations[2:3]
    pose, coefficients = body.pose(theta, body.mean_shape()), body.pose_coefficients(theta)
    distance = SignedDistance(core.surface.points.posed(pose, coefficients)[0].numpy(), core.part.faces)
    assert report.shortfall_before.max() > 0.01
    for arm in arms:
        off = distance(arm.samples.posed(pose, coefficients)[0].numpy())
        assert (off - arm.owed_to_trunk).min() > -config.tolerance
        assert (arm.owed_to_trunk == config.clearance).mean() > 0.6  # all but the upper arm owes 30 mm
    assert legs[0].owed_to_other.max() <= config.contact


def test_the_rotation_is_small_and_only_where_it_is_needed(cleared_swing):
    motion, report = cleared_swing
    assert report.shortfall_after.max() <= C.ClearingConfig().tolerance
    assert 3 < report.added[:, 0].max() < 30  # degrees
    assert report.added[:, 1:].max() < 0.05  # the right arm and the legs were clear
    assert report.added[[0, 1, -2, -1], 0].max() < 0.5  # and so was the left arm at the ends
    turned = torch.rad2deg(rotation_angle(motion.rotations.mT @ report.motion.rotations))
    moved = (turned.amax(0) > 0.05).nonzero()[:, 0].tolist()
    assert moved == [motion.skeleton.index("LeftArm")]  # a straight elbow has no axis to bend about
    assert torch.equal(motion.translation, report.motion.translation)


def test_less_rotation_would_not_be_enough(body, cleared_swing):
    """Half of what was added leaves the arm short: the rotation is no more than needed."""
    motion, report = cleared_swing
    worst = int(report.added[:, 0].argmax())
    arm = motion.skeleton.index("LeftArm")
    whole = report.motion.rotations[worst, arm] @ motion.rotations[worst, arm].mT
    rotations = motion.rotations[worst : worst + 1].clone()
    rotations[0, arm] = axis_angle_to_matrix(0.5 * matrix_to_axis_angle(whole)) @ rotations[0, arm]
    half = replace(motion, rotations=rotations, translation=motion.translation[:1])
    assert C.clear_and_report(half, body).shortfall_before[0] > 0.005


def test_clearing_twice_is_clearing_once(body, cleared_swing):
    _, report = cleared_swing
    again = C.clear_and_report(report.motion, body)
    assert torch.equal(again.motion.rotations, report.motion.rotations)


def test_clearing_is_smooth(cleared_swing):
    motion, report = cleared_swing

    def roughness(m):
        return float((m.rotations[2:] - 2 * m.rotations[1:-1] + m.rotations[:-2]).flatten(2).norm(dim=-1).max())

    assert roughness(report.motion) < 2 * roughness(motion) + 0.01


def test_a_hand_in_the_belly_comes_out(body):
    down = axis_angle_to_matrix(torch.tensor([0.0, 0.6, 0.0]))
    inwards = axis_angle_to_matrix(1.2 * torch.tensor([0.7071, 0.0, -0.7071]))
    arm = matrix_to_axis_angle(down @ inwards).tolist()
    motion = posed(body, {"LeftArm": arm, "LeftForeArm": [-1.1, 0.0, -1.1]}, 8)
    before = C.clear_and_report(motion, body)
    assert before.distance_before.min() < 0  # it is inside
    assert before.distance_after.min() > 0.028
    assert not before.unresolved.any()


def test_legs_come_out_of_each_other(body):
    motion = posed(body, {"LeftUpLeg": [0.0, 0.2, 0.0], "RightUpLeg": [0.0, -0.2, 0.0]}, 6)
    report = C.clear_and_report(motion, body)
    assert report.shortfall_before.max() > 0.02
    assert report.shortfall_after.max() <= 0.001
    assert report.added[:, 2:].min() > 1  # each gives way
    assert report.added.max() < 12


def test_a_knee_comes_out_of_the_belly(body):
    """By all vertices of the thigh that owe, on the real mesh; a kick that touches nothing stays as it is."""
    config = C.ClearingConfig()
    kick = posed(body, {"LeftUpLeg": [-1.4, 0.0, 0.0], "LeftLeg": [2.0, 0.0, 0.0]}, 4)
    assert torch.equal(C.clear_and_report(kick, body).motion.rotations, kick.rotations)
    motion = posed(body, {"LeftUpLeg": [-2.4, 0.0, 0.0], "LeftLeg": [2.4, 0.0, 0.0], "LowerBack": [0.6, 0.0, 0.0]}, 4)
    report = C.clear_and_report(motion, body)
    assert report.shortfall_before.max() > 0.03
    assert report.shortfall_after.max() <= config.tolerance
    assert report.added[:, 2].min() > 5  # degrees
    assert report.added[:, [1, 3]].max() < 1  # the other side has nothing to do with it
    (left, _), _, torso, _ = C._limbs(body, body.mean_shape(), replace(config, all_samples=10**6))
    theta = report.motion.rotations[1:2]
    pose, coefficients = body.pose(theta, body.mean_shape()), body.pose_coefficients(theta)
    skin = torso.surface.points.posed(pose, coefficients)[0].numpy()
    thigh = left.samples.posed(pose, coefficients)[0].numpy()
    met = ClosestPoint(skin, torso.part.faces).query(thigh)
    owed = C.owed_to_skin(left.samples.rest.numpy(), torso, torso.part.faces[met.face], met.barycentric, config)
    missing = owed - SignedDistance(skin, torso.part.faces)(thigh)
    assert missing[owed > 0].max() < 0.003  # the samples lack 1 mm at most, vertices between them more


@pytest.mark.parametrize("component", [None, 0])
def test_no_thigh_lies_in_the_belly(body, component):
    """Seen from the other side: skin of the torso is not in a leg, where the leg's skin that it meets is far from it at
    rest.  That is so of much of the uppermost thigh, though it is near the torso's nearest point."""
    config, betas = C.ClearingConfig(), body.mean_shape()
    if component is not None:
        betas[component] = 1.5
    legs = {"LeftUpLeg": [-2.0, 0.0, 0.0], "RightUpLeg": [-2.0, 0.0, 0.0]}
    motion = posed(body, {**legs, "LowerBack": [0.7, 0.0, 0.0], "Spine": [0.5, 0.0, 0.0]}, 3)
    left, right = C._limbs(body, betas, replace(config, all_samples=10**6))[0]
    torso = C._limbs(body, betas, config)[2]
    own = torso.part.vertices
    rest = (body.template + body.shape_offsets(betas)).numpy()

    def deepest(rotations: torch.Tensor) -> float:
        skin = body.vertices(rotations[1:2], betas)[0].numpy()
        found = []
        for leg in (left, right):
            posed_leg, rest_leg = leg.part.with_centres(skin), leg.part.with_centres(rest)
            met = ClosestPoint(posed_leg, leg.part.faces).query(skin[own])
            met_at_rest = (rest_leg[leg.part.faces[met.face]] * met.barycentric[..., None]).sum(1)
            far = np.linalg.norm(rest[own] - met_at_rest, axis=1) > config.groin_far
            found.append(SignedDistance(posed_leg, leg.part.faces)(skin[own[far]]).min())
        return float(min(found))

    assert deepest(motion.rotations) < -0.02
    report = C.clear_and_report(motion, body, betas)
    assert not report.unresolved.any()
    assert deepest(report.motion.rotations) > -0.003  # as above


def test_another_shape_is_cleared_for_itself(body):
    motion = hanging(body, frames=3)
    heavy = body.mean_shape()
    heavy[0] = 2.0
    added = {name: C.clear_and_report(motion, body, betas) for name, betas in (("mean", None), ("other", heavy))}
    assert all(not report.unresolved.any() for report in added.values())
    assert abs(added["mean"].added.mean() - added["other"].added.mean()) > 0.1
    cleared = motion.cleared(body, betas=heavy)
    assert torch.equal(cleared.rotations, added["other"].motion.rotations)


def test_what_cannot_be_cleared_is_named(body, caplog):
    """With almost no rotation allowed the frames stay in contact: they are listed and a warning is logged."""
    config = C.ClearingConfig(most_arm=0.5, rounds=2, exchanges=1)
    with caplog.at_level(logging.WARNING):
        report = C.clear_and_report(hanging(body, frames=3), body, config=config)
    assert report.unresolved.all()
    assert "3 of 3 frames stay up to" in caplog.text


@pytest.mark.parametrize(("limbs", "share"), [("arms", 0.05), ("legs", 0.1)])
def test_distances_follow_their_gradient(body, limbs, share):
    """The linearised distances are those of the turned limbs: finite differences agree, but for the skin of the groin,
    which belongs to the torso and moves with a leg."""
    config = C.ClearingConfig(all_samples=60)
    betas = body.mean_shape()
    legs, arms, torso, core = C._limbs(body, betas, config)
    pair, avoided = (arms, core) if limbs == "arms" else (legs, torso)
    arm = {"LeftArm": [0.0, 0.8, 0.0], "LeftForeArm": [0.0, 0.3, -1.2]}
    motion = posed(body, arm if limbs == "arms" else {"LeftUpLeg": [-2.3, 0.0, 0.0]}, 2)
    stage = C.Stage(body, betas, 30.0, pair, avoided, config)
    bend = [C._bend(motion.rotations, body, limb) for limb in pair]
    generator = np.random.default_rng(0)
    x = 0.2 * generator.normal(size=(2, 2 * stage.freedoms))
    step = 2e-3 * generator.normal(size=(2, 2 * stage.freedoms))
    none = np.zeros((2, 3))
    here = stage.rows(motion.rotations, x, bend, none)
    there = stage.rows(motion.rotations, x + step, bend, none)
    assert len(here.frame) == len(there.frame)
    # as before for arms; of legs what owes nothing is, for the most part, the thigh's first hand's breadth at that skin
    counts = here.owed > 0 if limbs == "legs" else np.ones(len(here.owed), bool)
    expected = (here.gradient * step[here.frame]).sum(1)[counts]
    found = (there.distance - here.distance)[counts]
    assert len(found) > 10
    assert np.abs(found - expected).mean() < share * np.abs(found).mean()


def test_parts_are_closed(body):
    legs, arms, torso, core = C._limbs(body, body.mean_shape(), C.ClearingConfig(all_samples=10))
    for part in (torso.part, core.part, *(limb.part for limb in legs + arms)):
        check_closed(part.faces)


def test_unusable_input_is_refused(body):
    motion = posed(body, {}, 2)
    two_joints = Skeleton(("a", "b"), (-1, 0), torch.zeros(2, 3))
    other = Motion(torch.eye(3).repeat(2, 2, 1, 1), torch.zeros(2, 3), 30.0, two_joints)
    with pytest.raises(ValueError, match="has 2 joints of another skeleton than the 31 of body"):
        C.clear(other, body)
    with pytest.raises(ValueError, match="betas must be one shape of 10 components"):
        C.clear(motion, body, torch.zeros(3))
    with pytest.raises(ValueError, match="betas must be finite"):
        C.clear(motion, body, torch.full((10,), torch.nan))
    with pytest.raises(ValueError, match="frame 1 holds NaN"):
        replace(motion, rotations=torch.where(torch.arange(2)[:, None, None, None] == 1, torch.nan, motion.rotations))
    nameless = replace(body, joint_names=tuple(f"j{k}" for k in range(31)))
    with pytest.raises(ValueError, match="clearing needs to know arms and legs"):
        C.clear(replace(motion, skeleton=nameless.skeleton), nameless)
