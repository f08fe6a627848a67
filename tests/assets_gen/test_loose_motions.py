"""Laws of the motions whose joints go their own ways."""

import numpy as np
import torch

from assets_gen.loose_motions import AMPLITUDES, CURL, KNEE, SPINE, THIGH, curled, gathered, lifted, loosened
from assets_gen.motions import beyond_limits, generate, joint_angles, limit_of
from workbench.motion import Motion


def test_joints_wander_within_their_limits_and_others_stay(body):
    motion = generate("dance_03", body.skeleton, frames=40)
    loose = loosened(motion, np.random.default_rng(9))  # a chance that leaves the spine in its joints
    assert float(beyond_limits(loose).max()) < 0.1
    before, after = joint_angles(motion), joint_angles(loose)
    for joint, usual in before.items():
        name = joint.removeprefix("Left").removeprefix("Right")
        moved = (after[joint] - usual).abs().amax(dim=0)
        if name not in AMPLITUDES:
            assert float(moved.max()) < 0.1, joint
        elif min(np.diff(limit_of(joint).flexion)) > 0:
            assert float(moved.max()) > 1, joint
    assert loose.name == "dance_03_loose"


def test_a_gathered_spine_bends_as_it_did_in_one_joint(body):
    motion = generate("dance_03", body.skeleton, frames=10)
    lowest, middle, highest = (motion.skeleton.index(joint) for joint in SPINE)
    whole = motion.rotations[:, lowest] @ motion.rotations[:, middle] @ motion.rotations[:, highest]
    found = gathered(motion)
    torch.testing.assert_close(found.rotations[:, lowest], whole)
    for other in (middle, highest):
        torch.testing.assert_close(found.rotations[:, other], torch.eye(3).expand(10, 3, 3))
    limbs = [index for index in range(len(motion.skeleton.names)) if index not in (lowest, middle, highest)]
    torch.testing.assert_close(found.rotations[:, limbs], motion.rotations[:, limbs])


def test_some_spines_are_gathered_and_some_are_not(body):
    motion = generate("walk_02", body.skeleton, frames=2)
    middle = motion.skeleton.index(SPINE[1])
    still = [
        torch.equal(loosened(motion, np.random.default_rng(seed)).rotations[:, middle], torch.eye(3).expand(2, 3, 3))
        for seed in range(12)
    ]
    assert any(still) and not all(still)


def test_the_same_chance_gives_the_same_motion_and_it_stays_smooth(body):
    motion = generate("walk_02", body.skeleton, frames=60)
    once, again = (loosened(motion, np.random.default_rng(7)) for _ in range(2))
    torch.testing.assert_close(once.rotations, again.rotations)
    assert fastest(once) < fastest(motion) + 0.2  # radians a frame


def fastest(motion: Motion) -> float:
    """The largest turn of a joint from one frame to the next."""
    step = motion.rotations[:-1].mT @ motion.rotations[1:]
    return float(torch.arccos(((step.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2).clamp(-1, 1)).max())


def drawn_up(motion: Motion, side: str) -> bool:
    """All frames have this side's thigh and shank in the ranges of a leg drawn up."""
    angles = joint_angles(motion)
    of_axes = zip((*THIGH, KNEE), (*angles[side + "UpLeg"].T, angles[side + "Leg"][:, 0]), strict=True)
    return all(low - 0.1 <= float(x.min()) and float(x.max()) <= high + 0.1 for (low, high), x in of_axes)


def test_lifted_knees_are_drawn_up_and_all_else_is_as_loosened(body):
    motion = generate("walk_02", body.skeleton, frames=20)
    for seed in range(6):
        high = lifted(motion, np.random.default_rng(seed))
        raised = [side for side in ("Left", "Right") if drawn_up(high, side)]
        assert raised
        loose = loosened(motion, np.random.default_rng(seed))
        changed = (high.rotations != loose.rotations).flatten(2).any(2).any(0)
        assert {motion.skeleton.names[k] for k in torch.nonzero(changed)[:, 0].tolist()} == {
            side + joint for side in raised for joint in ("UpLeg", "Leg")
        }
    assert high.name == "walk_02_lifted"


def test_who_is_curled_bends_both_hips_and_a_spine_that_is_whole_or_gathered(body):
    motion = generate("walk_02", body.skeleton, frames=20)
    others = [motion.skeleton.index(joint) for joint in SPINE[1:]]
    kinds = set()
    for seed in range(8):
        found = curled(motion, np.random.default_rng(seed))
        assert all(drawn_up(found, side) for side in ("Left", "Right"))
        gathered_one = all(torch.equal(found.rotations[:, k], torch.eye(3).expand(20, 3, 3)) for k in others)
        kinds.add(gathered_one)
        if not gathered_one:
            bend = sum(joint_angles(found)[joint][:, 0] for joint in SPINE)
            assert CURL[0] - 0.1 <= float(bend.min()) and float(bend.max()) <= CURL[1] + 0.1  # pyright: ignore
    assert kinds == {True, False}
    assert found.name == "walk_02_curled"
