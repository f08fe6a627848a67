"""Laws of what patches see of limbs."""

import pytest
import torch

from workbench.collisions.diffused_body import GridFields
from workbench.collisions.limb_sight import FAR, PER_BONE, LimbSight
from workbench.geometry.rotations import axis_angle_to_matrix

FOREARM = ("RightForeArm", "RightHand")


@pytest.fixture(scope="module")
def anchors(body) -> torch.Tensor:
    """Before the belly, at the chest, at the left forearm."""
    elbow, hand = (body.joint_template[body.joint_names.index(name)] for name in ("LeftForeArm", "LeftHand"))
    return torch.stack([torch.tensor([0.02, -0.15, 1.0]), torch.tensor([0.1, -0.12, 1.25]), (elbow + hand) / 2 + 0.04])


@pytest.fixture(scope="module")
def sight(body, anchors) -> LimbSight:
    return LimbSight.of(body, GridFields.default(), anchors)


def bone(sight, body, name: str) -> int:
    """Which bone ends at a joint."""
    return sight.ends.long().tolist().index(body.joint_names.index(name))


def of_bones(features: torch.Tensor) -> torch.Tensor:
    return features.unflatten(-1, (-1, PER_BONE))


def chance_pose(body, count: int, size: float = 0.4) -> torch.Tensor:
    turns = torch.randn(count, len(body.parents), 3, generator=torch.Generator().manual_seed(1))
    return axis_angle_to_matrix(size * turns)


def test_at_rest_no_bone_is_turned_and_each_is_as_near_as_it_is(sight, body, anchors):
    seen = of_bones(sight(body.rest_rotations(), body.mean_shape()))
    torch.testing.assert_close(seen[..., 4:], torch.zeros_like(seen[..., 4:]), atol=1e-5, rtol=0)
    starts, ends = (body.joint_template[index] for index in sight.bones())
    along = torch.linspace(0, 1, 2001)[:, None, None]
    dense = starts + along * (ends - starts)
    apart = (dense[None] - anchors[:, None, None]).norm(dim=-1).amin(dim=1)
    torch.testing.assert_close(seen[..., 0], torch.exp(-0.5 * (apart / FAR) ** 2), atol=1e-5, rtol=1e-4)


def test_how_the_body_is_turned_as_a_whole_does_not_matter(sight, body):
    pose, betas = chance_pose(body, 4), torch.randn(4, body.shape_count)
    turned = pose.clone()
    turned[:, 0] = chance_pose(body, 4, 2.0)[:, 0]
    torch.testing.assert_close(sight(turned, betas), sight(pose, betas))


def test_where_a_bone_went_is_seen_from_the_posed_anchor(sight, body, anchors):
    """Against the posed skeleton and the fields, a bone and an anchor at a time."""
    pose, betas = chance_pose(body, 3), torch.randn(3, body.shape_count)
    pose[:, 0] = torch.eye(3)
    seen = of_bones(sight(pose, betas))
    fields, skeleton = GridFields.default(), body.pose(pose, betas)
    weights = fields.weights(anchors)
    A = torch.einsum("aj,bjik->baik", weights, skeleton.transforms.rotation)
    t = torch.einsum("aj,bji->bai", weights, skeleton.transforms.translation)
    offset = fields.shape_offsets(anchors.expand(3, -1, -1), betas)
    places = torch.einsum("baik,bak->bai", A, anchors + offset) + t
    start, end = (skeleton.joints[:, body.joint_names.index(name)] for name in FOREARM)
    points = start[:, None] + torch.linspace(0, 1, 4001)[:, None] * (end - start)[:, None]
    apart = points[:, None] - places[:, :, None]
    nearest = apart.norm(dim=-1).argmin(dim=-1)
    way = apart.gather(2, nearest[..., None, None].expand(-1, -1, 1, 3))[:, :, 0]
    near = torch.exp(-0.5 * way.square().sum(-1, keepdim=True) / FAR**2)
    found = seen[:, :, bone(sight, body, FOREARM[1])]
    torch.testing.assert_close(found[..., :1], near, atol=1e-4, rtol=1e-3)
    own = torch.einsum("baki,bak->bai", A, way) / FAR
    torch.testing.assert_close(found[..., 1:4], near * own, atol=2e-3, rtol=1e-2)
    elbow = skeleton.transforms.rotation[:, body.joint_names.index(FOREARM[0])]
    turn = torch.einsum("baki,bkj->baij", A, elbow) - torch.eye(3)
    torch.testing.assert_close(found[..., 4:], near * turn.flatten(-2), atol=2e-3, rtol=1e-2)


def test_what_is_far_is_hardly_seen(sight, body):
    """A foot that turns, from the chest; the elbow beside it, from the forearm."""
    rest, betas = body.rest_rotations(), body.mean_shape()
    changes = []
    for joint in ("LeftFoot", "LeftForeArm"):
        pose = rest.clone()
        pose[body.joint_names.index(joint)] = axis_angle_to_matrix(torch.tensor([0.8, 0.0, 0.3]))
        changes.append((sight(pose, betas) - sight(rest, betas)).norm(dim=-1))
    assert float(changes[0].max()) < 1e-3
    assert float(changes[1][2]) > 0.1


def test_fingers_are_no_limbs(sight, body):
    names = {body.joint_names[joint] for joint in sight.ends.long().tolist()}
    assert {"LeftForeArm", "RightHand", "LeftLeg", "RightFoot", "Spine", "Neck"} <= names
    assert not names & {"LThumb", "LeftFingerBase", "Head", "LHipJoint"}


def test_it_comes_back_from_its_buffers(sight, body):
    empty = LimbSight(body.parents, 3, body.shape_count, sight.ends.numel())
    empty.load_state_dict(sight.state_dict())
    pose, betas = chance_pose(body, 2), torch.randn(2, body.shape_count)
    torch.testing.assert_close(empty(pose, betas), sight(pose, betas))
