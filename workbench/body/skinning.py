"""Eq. 2: the skinning function W, linear or by dual quaternions.  points, weights, joint rotations -> posed points."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.geometry.rotations import matrix_to_quaternion, quaternion_multiply, quaternion_to_matrix


@dataclass(frozen=True)
class RigidTransforms:
    """One rigid motion a joint: posed = rotation @ rest + translation, in metres."""

    rotation: Float[Tensor, "*B J 3 3"]
    translation: Float[Tensor, "*B J 3"]


@dataclass(frozen=True)
class Pose:
    """The skeleton in a pose: what each joint does to rest points, and where the joints end."""

    transforms: RigidTransforms
    joints: Float[Tensor, "*B J 3"]


def forward_kinematics(
    rotations: Float[Tensor, "*B J 3 3"], joints: Float[Tensor, "*#B J 3"], parents: Sequence[int]
) -> Pose:
    """Local rotations and rest joints -> world transforms.  The root joint stays where it rests."""
    joints = joints.expand(*rotations.shape[:-2], 3)
    world: list[Tensor] = []
    posed: list[Tensor] = []
    for joint, parent in enumerate(parents):
        if parent < 0:
            world.append(rotations[..., joint, :, :])
            posed.append(joints[..., joint, :])
        else:
            bone = joints[..., joint, :] - joints[..., parent, :]
            world.append(world[parent] @ rotations[..., joint, :, :])
            posed.append(posed[parent] + (world[parent] @ bone[..., None])[..., 0])
    rotation = torch.stack(world, dim=-3)
    ends = torch.stack(posed, dim=-2)
    return Pose(RigidTransforms(rotation, ends - (rotation @ joints[..., None])[..., 0]), ends)


def blended_affine(
    weights: Float[Tensor, "*W N J"], transforms: RigidTransforms
) -> tuple[Float[Tensor, "*B N 3 3"], Float[Tensor, "*B N 3"]]:
    """Sum_j w_j (R_j, t_j) for each point: the affine map that linear blend skinning applies to it."""
    stacked = torch.cat([transforms.rotation, transforms.translation[..., None]], dim=-1)
    blended = weights @ stacked.flatten(-2)
    affine = blended.unflatten(-1, (3, 4))
    return affine[..., :3], affine[..., 3]


def linear_blend(
    points: Float[Tensor, "*P N 3"], weights: Float[Tensor, "*W N J"], transforms: RigidTransforms
) -> Float[Tensor, "*B N 3"]:
    """Linear blend skinning: (sum_j w_j R_j) p + sum_j w_j t_j.  Leading axes broadcast."""
    rotation, translation = blended_affine(weights, transforms)
    return (rotation @ points[..., None])[..., 0] + translation


def dual_quaternion(
    points: Float[Tensor, "*P N 3"], weights: Float[Tensor, "*W N J"], transforms: RigidTransforms
) -> Float[Tensor, "*B N 3"]:
    """Dual-quaternion skinning (Kavan et al. 2007): always a rigid motion a point, so twists keep their volume.

    Each joint's quaternion is taken on the side of the point's heaviest joint, so that blending goes the short way.
    """
    real = matrix_to_quaternion(transforms.rotation)
    translation = torch.cat([torch.zeros_like(real[..., :1]), transforms.translation], dim=-1)
    dual = 0.5 * quaternion_multiply(translation, real)
    side = _signed_weights(weights, real)
    blended_real, blended_dual = side @ real, side @ dual
    norm = blended_real.norm(dim=-1, keepdim=True)
    blended_real, blended_dual = blended_real / norm, blended_dual / norm
    conjugate = blended_real * blended_real.new_tensor([1.0, -1.0, -1.0, -1.0])
    moved = 2.0 * quaternion_multiply(blended_dual, conjugate)[..., 1:]
    return (quaternion_to_matrix(blended_real) @ points[..., None])[..., 0] + moved


def _signed_weights(weights: Float[Tensor, "*W N J"], quaternions: Float[Tensor, "*B J 4"]) -> Float[Tensor, "*B N J"]:
    pivot = weights.argmax(dim=-1)
    alignment = quaternions @ quaternions.mT
    if weights.dim() == 2:
        dots = alignment[..., pivot, :]
    else:
        index = pivot[..., None].expand(*pivot.shape, weights.shape[-1])
        dots = alignment.expand(*pivot.shape[:-1], *alignment.shape[-2:]).gather(-2, index)
    return torch.where(dots < 0, -weights, weights)
