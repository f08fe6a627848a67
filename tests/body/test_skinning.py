"""Laws of Eq. 2: rigid motion, partition of unity, two skinnings that agree where they must, gradients."""

import pytest
import torch

from workbench.body.skinning import blended_affine, dual_quaternion, forward_kinematics, linear_blend
from workbench.geometry.rotations import axis_angle_to_matrix

PARENTS = (-1, 0, 1, 1)


@pytest.fixture
def chain():
    generator = torch.Generator().manual_seed(1)
    joints = torch.rand(4, 3, generator=generator, dtype=torch.float64)
    rotations = axis_angle_to_matrix(torch.randn(4, 3, generator=generator, dtype=torch.float64))
    points = torch.rand(50, 3, generator=generator, dtype=torch.float64)
    weights = torch.rand(50, 4, generator=generator, dtype=torch.float64).softmax(dim=-1)
    return joints, rotations, points, weights


def test_identity_pose_moves_nothing(chain):
    joints, _, points, weights = chain
    pose = forward_kinematics(torch.eye(3, dtype=torch.float64).repeat(4, 1, 1), joints, PARENTS)
    for skinned in (linear_blend, dual_quaternion):
        assert torch.allclose(skinned(points, weights, pose.transforms), points)


def test_a_bone_with_full_weight_is_rigid_under_both_skinnings(chain):
    joints, rotations, points, _ = chain
    pose = forward_kinematics(rotations, joints, PARENTS)
    weights = torch.zeros(50, 4, dtype=torch.float64)
    weights[:, 2] = 1.0
    expected = points @ pose.transforms.rotation[2].mT + pose.transforms.translation[2]
    assert torch.allclose(linear_blend(points, weights, pose.transforms), expected)
    assert torch.allclose(dual_quaternion(points, weights, pose.transforms), expected)


def test_a_rotated_root_rotates_everything(chain):
    joints, rotations, points, weights = chain
    turn = axis_angle_to_matrix(torch.tensor([0.2, 0.4, -1.0], dtype=torch.float64))
    turned = rotations.clone()
    turned[0] = turn @ rotations[0]
    for skinned in (linear_blend, dual_quaternion):
        before = skinned(points, weights, forward_kinematics(rotations, joints, PARENTS).transforms)
        after = skinned(points, weights, forward_kinematics(turned, joints, PARENTS).transforms)
        assert torch.allclose(after - joints[0], (before - joints[0]) @ turn.mT, atol=1e-9)


def test_joints_move_with_their_parents_bone(chain):
    joints, rotations, _, _ = chain
    pose = forward_kinematics(rotations, joints, PARENTS)
    carried = (pose.transforms.rotation[1] @ joints[3]) + pose.transforms.translation[1]
    assert torch.allclose(pose.joints[3], carried)
    lengths = (pose.joints[1:] - pose.joints[[0, 1, 1]]).norm(dim=-1)
    assert torch.allclose(lengths, (joints[1:] - joints[[0, 1, 1]]).norm(dim=-1))


def test_a_batch_is_its_frames(chain):
    joints, rotations, points, weights = chain
    many = torch.stack([rotations, rotations.mT, rotations @ rotations])
    batched = forward_kinematics(many, joints, PARENTS)
    for skinned in (linear_blend, dual_quaternion):
        whole = skinned(points, weights, batched.transforms)
        for frame in range(3):
            one = forward_kinematics(many[frame], joints, PARENTS)
            assert torch.allclose(whole[frame], skinned(points, weights, one.transforms), atol=1e-12)


def test_weights_a_frame_and_shared_weights_agree(chain):
    joints, rotations, points, weights = chain
    many = torch.stack([rotations, rotations.mT])
    transforms = forward_kinematics(many, joints, PARENTS).transforms
    for skinned in (linear_blend, dual_quaternion):
        shared = skinned(points, weights, transforms)
        own = skinned(points.expand(2, -1, -1), weights.expand(2, -1, -1), transforms)
        assert torch.allclose(shared, own)


def test_dual_quaternions_keep_a_twisted_tube_round():
    ring = torch.linspace(0, 6.28, 20, dtype=torch.float64)
    tube = torch.stack([0.1 * ring.cos(), 0.1 * ring.sin(), torch.zeros_like(ring)], dim=-1)
    twist = axis_angle_to_matrix(torch.tensor([[0.0, 0, 0], [0, 0, 2.6]], dtype=torch.float64))
    transforms = forward_kinematics(twist, torch.zeros(2, 3, dtype=torch.float64), (-1, 0)).transforms
    half = torch.full((20, 2), 0.5, dtype=torch.float64)
    assert torch.allclose(dual_quaternion(tube, half, transforms).norm(dim=-1), torch.full((20,), 0.1).double())
    assert linear_blend(tube, half, transforms).norm(dim=-1).max() < 0.05  # the candy wrapper


def test_linear_blending_is_the_blended_affine_map(chain):
    joints, rotations, points, weights = chain
    transforms = forward_kinematics(rotations, joints, PARENTS).transforms
    rotation, translation = blended_affine(weights, transforms)
    by_joint = [points @ transforms.rotation[j].mT + transforms.translation[j] for j in range(4)]
    by_hand = (weights.mT[..., None] * torch.stack(by_joint)).sum(dim=0)
    assert torch.allclose((rotation @ points[..., None])[..., 0] + translation, by_hand)


@pytest.mark.parametrize("skinned", [linear_blend, dual_quaternion])
def test_skinning_has_correct_gradients(chain, skinned):
    joints, _, points, weights = chain

    def posed(vectors, p, w):
        transforms = forward_kinematics(axis_angle_to_matrix(vectors), joints, PARENTS).transforms
        return skinned(p, w, transforms)

    generator = torch.Generator().manual_seed(3)
    vectors = torch.randn(4, 3, generator=generator, dtype=torch.float64).requires_grad_()
    inputs = (vectors, points[:3].clone().requires_grad_(), weights[:3].clone().requires_grad_())
    assert torch.autograd.gradcheck(posed, inputs)
