"""Linear pose correctives B_p (Eq. 3) towards dual-quaternion skinning.  body, synthetic poses -> body with B_p

minimise over P:  sum_poses || feature(theta) P - A(theta)^-1 (dual_quaternion - linear_blend) ||^2 + ridge ||P||^2
with A the blended rotation of each vertex, so that the correction acts in rest space; then truncated to a low rank.
"""

import logging
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skinning import blended_affine, dual_quaternion, linear_blend
from workbench.body_evaluation import CorrectivesError, sample_poses, skinning_error

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class CorrectivesConfig:
    """Fit B_p; the held-out error is logged."""

    training_poses: int = 1500  # ours: held-out error changes by < 1 % beyond that
    test_poses: int = 100
    ridge: float = 1.0  # ours: flat between 0.1 and 10
    rank: int = 24  # ours: see `held_out_error` against rank in the log
    largest_offset: float = 0.08  # metres; beyond it the blended rotation is near singular
    seed: int = 0


def fit_pose_correctives(body: Body, config: CorrectivesConfig) -> Body:
    """The body with pose_map and pose_directions fitted; logs the error on poses that the fit never saw."""
    generator = torch.Generator().manual_seed(config.seed)
    poses = sample_poses(body, config.training_poses, generator)
    features = body.pose_feature(poses)
    targets = torch.stack([corrective_targets(body, pose, config.largest_offset).flatten() for pose in poses])
    gram = features.mT @ features + config.ridge * torch.eye(features.shape[1])
    full = torch.linalg.solve(gram, features.mT @ targets)
    _, singular, right = torch.linalg.svd(_root(features) @ full, full_matrices=False)
    energy = (singular**2).cumsum(0) / (singular**2).sum()
    log.info("rank %d keeps %.4f of the correctives' energy", config.rank, energy[config.rank - 1])
    basis = right[: config.rank]
    coefficients = full @ basis.mT
    scale = coefficients.norm(dim=0).clamp_min(1e-8)
    corrected = replace(
        body,
        pose_map=coefficients / scale,
        pose_directions=(basis * scale[:, None]).unflatten(-1, (-1, 3)),
    )
    error = held_out_error(corrected, config)
    log.info(
        "B_p on %d unseen poses: %.2f mm -> %.2f mm to dual-quaternion skinning (%.0f %% less)",
        config.test_poses, 1e3 * error.linear, 1e3 * error.corrected, 100 * error.reduction,
    )  # fmt: skip
    return corrected


def _root(features: Float[Tensor, "A Q"]) -> Float[Tensor, "Q Q"]:
    """A triangular factor of the features' Gram matrix: the metric in which rank is cut is the error over poses."""
    return torch.linalg.qr(features, mode="r").R


def held_out_error(body: Body, config: CorrectivesConfig) -> CorrectivesError:
    """Distance of linear blending, without and with B_p, to dual-quaternion skinning on unseen poses."""
    generator = torch.Generator().manual_seed(config.seed + 1)
    poses = sample_poses(body, config.test_poses, generator)
    return skinning_error(body, poses)


def corrective_targets(body: Body, pose: Float[Tensor, "J 3 3"], largest: float) -> Float[Tensor, "V 3"]:
    """A(theta)^-1 (dual_quaternion - linear_blend): what B_p should be at each vertex, cut at `largest`."""
    transforms = body.pose(pose, body.mean_shape()).transforms
    rotation, _ = blended_affine(body.weights, transforms)
    gap = dual_quaternion(body.template, body.weights, transforms) - linear_blend(
        body.template, body.weights, transforms
    )
    identity = torch.eye(3, dtype=rotation.dtype)
    offset = torch.linalg.solve(rotation + 1e-5 * identity, gap[..., None])[..., 0]
    return offset.clamp(-largest, largest)
