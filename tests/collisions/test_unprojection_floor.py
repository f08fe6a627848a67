"""Laws of the floor: nothing collides in canonical space, regions are anatomy, spreading the arms spreads them."""

import pytest
import torch

from workbench.collisions.garment_model import GarmentModel
from workbench.collisions.unprojection_floor import REGIONS, regions_of, static_template_floor, with_arms_spread
from workbench.garments import Garment
from workbench.geometry.rotations import axis_angle_to_matrix, rotation_angle
from workbench.motion import Motion


@pytest.fixture(scope="module")
def model(body, analytic_fields):
    return GarmentModel(body, analytic_fields(body))


@pytest.fixture(scope="module")
def template():
    """Every third vertex of the draped T-shirt: outside the body."""
    return Garment.load("tshirt").vertices[::3]


def still(body, frames: int = 2) -> Motion:
    rotations = body.rest_rotations().expand(frames, -1, -1, -1).clone()
    return Motion(rotations, torch.zeros(frames, 3), 30.0, body.skeleton, "still")


@pytest.mark.parametrize("skinning", ["linear", "dual_quaternion"])
def test_in_the_rest_pose_of_the_mean_shape_nothing_collides(model, template, body, skinning):
    floor = static_template_floor(model, template, [(still(body), body.mean_shape())], skinning=skinning)
    assert floor.share == 0
    assert floor.frames == 2


def test_a_template_inside_the_body_is_all_floor(model, body):
    spine = body.joint_template[body.skeleton.index("Spine")]
    floor = static_template_floor(model, spine.expand(5, -1), [(still(body), body.mean_shape())])
    assert floor.share == 1
    assert floor.region_share == {"torso": 1.0}


def test_regions_are_anatomy(model, body):
    joints = ["Spine", "LeftForeArm", "RightLeg", "Head"]
    points = torch.stack([body.joint_template[body.skeleton.index(name)] for name in joints])
    assert [REGIONS[i] for i in regions_of(body, model.fields.at(points))] == ["torso", "arms", "legs", "head"]


def test_spread_arms_go_sideways_by_the_angle_and_nothing_else_moves(body):
    motion = still(body)
    spread = with_arms_spread(motion, torch.pi / 12)
    turned = rotation_angle(spread.rotations @ motion.rotations.mT)[0]
    arms = [body.skeleton.index("LeftArm"), body.skeleton.index("RightArm")]
    assert torch.allclose(turned[arms], torch.full((2,), torch.pi / 12), atol=1e-4)
    assert turned.sum() == pytest.approx(torch.pi / 6, abs=1e-3)
    hands = [body.skeleton.index("LeftHand"), body.skeleton.index("RightHand")]
    before = body.pose(motion.rotations[0], body.mean_shape()).joints[hands]
    after = body.pose(spread.rotations[0], body.mean_shape()).joints[hands]
    assert (after[:, 2] > before[:, 2]).all()
    assert (after[:, 0].abs() > before[:, 0].abs()).all()


def test_arms_driven_into_the_trunk_are_told_as_overlap(model, body, template):
    motion = still(body, 1)
    rotations = motion.rotations.clone()
    rotations[:, body.skeleton.index("LeftArm")] = axis_angle_to_matrix(torch.tensor([0.0, 1.6, 0.0]))
    crossed = Motion(rotations, motion.translation, 30.0, body.skeleton, "crossed")
    floor = static_template_floor(model, template, [(crossed, body.mean_shape())])
    assert floor.share > static_template_floor(model, template, [(motion, body.mean_shape())]).share
    assert floor.overlap_share <= floor.share
