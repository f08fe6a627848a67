"""Limb sets on trees and weights whose answer is known, and on the garments that ship."""

import torch

from workbench.body.model import Body
from workbench.collisions.diffused_body import GridFields
from workbench.collisions.limb_sets import MOVES, limb_sets
from workbench.garments import Garment

#          0 root; 1-2 spine, where arms (3-4, 5-6) branch; legs 7-8 and 9-10 hang on the root
PARENTS = [-1, 0, 1, 2, 3, 2, 5, 0, 7, 0, 9]


def weights(*moved: tuple[int, ...]) -> torch.Tensor:
    """A vertex for each set of joints, moved by them alike."""
    rows = torch.zeros(len(moved), len(PARENTS))
    for row, joints in zip(rows, moved, strict=True):
        row[list(joints)] = 1.0 / len(joints)
    return rows


def test_limbs_that_share_no_vertex_are_apart_and_see_the_trunk():
    sets = limb_sets(weights((1, 2), (3, 4), (5, 6), (7,), (9,)), PARENTS)
    assert sorted(sets) == [(1, 2, 3, 4), (1, 2, 5, 6), (1, 2, 7, 8), (1, 2, 9, 10)]


def test_limbs_that_move_the_same_vertex_are_together():
    sets = limb_sets(weights((1, 2), (3,), (5,), (7, 9)), PARENTS)
    assert sorted(sets) == [(1, 2, 3, 4), (1, 2, 5, 6), (1, 2, 7, 8, 9, 10)]


def test_joints_that_neither_move_nor_hang_on_one_that_does_are_not_seen():
    assert limb_sets(weights((1,), (3,)), PARENTS) == ((1, 2, 3, 4),)  # one child of the spine: no trunk without arms
    assert limb_sets(weights((7,)), PARENTS) == ((7, 8),)
    assert limb_sets(weights((0,)), PARENTS[:1]) == ((),)


def test_on_the_garments_that_ship_every_joint_that_moves_them_is_seen_and_left_mirrors_right():
    body, fields = Body.default(), GridFields.default()
    for name in ("tshirt", "dress"):
        moved = fields.weights(Garment.load(name).vertices)
        sets = limb_sets(moved, body.parents)
        seen = set().union(*sets)
        assert {joint for joint in range(1, len(body.parents)) if float(moved[:, joint].max()) > MOVES} <= seen
        named = {frozenset(body.joint_names[joint] for joint in some) for some in sets}
        mirror = str.maketrans({"L": "R", "R": "L"})
        swapped = {
            frozenset(
                joint.replace("Left", "#").replace("Right", "Left").replace("#", "Right")
                if "Left" in joint or "Right" in joint
                else joint.translate(mirror) if joint in ("LHipJoint", "RHipJoint") else joint
                for joint in some
            )
            for some in named
        }
        assert swapped == named
        assert len(sets) == 3
