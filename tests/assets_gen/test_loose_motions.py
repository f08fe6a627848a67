"""Laws of the motions whose joints go their own ways."""

import numpy as np
import torch

from assets_gen.loose_motions import AMPLITUDES, CURL, KNEE, SPINE, THIGH, curled, lifted, loosened
from assets_gen.motions import beyond_limits, generate, joint_angles, limit_of
from workbench.motion import Motion


def test_joints_wander_within_their_limits_and_others_stay(body):
    motion = generate("dance_03", body.skeleton, frames=40)
    loose = loosened(motion, np.random.default_rng(9))
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


def test_some_spines_wander_as_one_and_some_do_not(body):
    motion = generate("walk_02", body.skeleton, frames=8)
    usual = joint_angles(motion)

    def apart(seed: int) -> float:
        found = joint_angles(loosened(motion, np.random.default_rng(seed)))
        added = [found[joint] - usual[joint] for joint in SPINE]
        return float((added[1] - added[2]).abs().max())

    found = [apart(seed) for seed in range(12)]
    assert min(found) < 0.01 and max(found) > 2


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


def test_who_is_curled_bends_both_hips_and_shares_the_bend_of_the_spine(body):
    motion = generate("walk_02", body.skeleton, frames=20)
    for seed in range(8):
        found = curled(motion, np.random.default_rng(seed))
        assert all(drawn_up(found, side) for side in ("Left", "Right"))
        angles = joint_angles(found)
        bends = torch.stack([angles[joint][:, 0] for joint in SPINE])
        torch.testing.assert_close(bends, bends[:1].expand_as(bends), atol=0.01, rtol=0)
        assert CURL[0] - 0.1 <= float(bends.sum(0).min()) and float(bends.sum(0).max()) <= CURL[1] + 0.1
    assert found.name == "walk_02_curled"
