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
from workbench.geometry.rotations import axis_angle_to_matrix

log = logging.getLogger(__name__)

# Mean and standard deviation of each joint's rotation vector (x: flexion, y: about the front-back axis, z: about the
# vertical), radians: everyday excursions, half of the anatomical range (ours).
JOINT_SPREAD = {
    "LeftUpLeg": ((-0.4, 0.0, 0.0), (0.50, 0.25, 0.25)),
    "RightUpLeg": ((-0.4, 0.0, 0.0), (0.50, 0.25, 0.25)),
    "LeftLeg": ((0.7, 0.0, 0.0), (0.50, 0.05, 0.10)),
    "RightLeg": ((0.7, 0.0, 0.0), (0.50, 0.05, 0.10)),
    "LeftFoot": ((0.0, 0.0, 0.0), (0.30, 0.10, 0.10)),
    "RightFoot": ((0.0, 0.0, 0.0), (0.30, 0.10, 0.10)),
    "LowerBack": ((0.0, 0.0, 0.0), (0.15, 0.10, 0.15)),
    "Spine": ((0.0, 0.0, 0.0), (0.15, 0.10, 0.15)),
    "Spine1": ((0.0, 0.0, 0.0), (0.15, 0.10, 0.15)),
    "Neck": ((0.0, 0.0, 0.0), (0.15, 0.10, 0.20)),
    "Neck1": ((0.0, 0.0, 0.0), (0.15, 0.10, 0.20)),
    "Head": ((0.0, 0.0, 0.0), (0.15, 0.10, 0.20)),
    "LeftShoulder": ((0.0, 0.0, 0.0), (0.08, 0.12, 0.12)),
    "RightShoulder": ((0.0, 0.0, 0.0), (0.08, 0.12, 0.12)),
    "LeftArm": ((0.0, 0.0, 0.0), (0.55, 0.55, 0.55)),
    "RightArm": ((0.0, 0.0, 0.0), (0.55, 0.55, 0.55)),
    "LeftHand": ((0.0, 0.0, 0.0), (0.25, 0.25, 0.25)),
    "RightHand": ((0.0, 0.0, 0.0), (0.25, 0.25, 0.25)),
}


@dataclass(frozen=True)
class CorrectivesConfig:
    """Fit B_p; the held-out error is logged."""

    training_poses: int = 1500  # ours: held-out error changes by < 1 % beyond that
    test_poses: int = 100
    ridge: float = 1.0  # ours: flat between 0.1 and 10
    rank: int = 24  # ours: see `held_out_error` against rank in the log
    largest_offset: float = 0.08  # metres; beyond it the blended rotation is near singular
    seed: int = 0


@dataclass(frozen=True)
class CorrectivesError:
    """RMS vertex distance to dual-quaternion skinning over poses, metres."""

    linear: float
    corrected: float

    @property
    def reduction(self) -> float:
        """The share of linear blending's error that B_p removes."""
        return 1.0 - self.corrected / self.linear


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


def skinning_error(body: Body, poses: Float[Tensor, "A J 3 3"]) -> CorrectivesError:
    """RMS over all vertices of each pose, averaged over poses."""
    betas = body.mean_shape()
    linear, corrected = [], []
    for pose in poses:
        target = body.vertices(pose, betas, skinning="dual_quaternion")
        transforms = body.pose(pose, betas).transforms
        linear.append(_rms(linear_blend(body.template, body.weights, transforms) - target))
        corrected.append(_rms(body.vertices(pose, betas) - target))
    return CorrectivesError(float(torch.stack(linear).mean()), float(torch.stack(corrected).mean()))


def _rms(offset: Float[Tensor, "V 3"]) -> Float[Tensor, ""]:
    return offset.square().sum(dim=-1).mean().sqrt()


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


def sample_poses(body: Body, count: int, generator: torch.Generator) -> Float[Tensor, "A J 3 3"]:
    """Synthetic poses: independent Gaussian rotation vectors of everyday spread; knees and elbows bend one way only."""
    vectors = torch.zeros(count, len(body.parents), 3)
    for name, (mean, spread) in JOINT_SPREAD.items():
        noise = torch.randn(count, 3, generator=generator)
        vectors[:, body.joint_names.index(name)] = torch.tensor(mean) + torch.tensor(spread) * noise
    for knee in ("LeftLeg", "RightLeg"):
        index = body.joint_names.index(knee)
        vectors[:, index, 0] = vectors[:, index, 0].clamp(0.0, 2.3)
    _bend_elbows(vectors, body, generator)
    return axis_angle_to_matrix(vectors)


def _bend_elbows(vectors: Float[Tensor, "A J 3"], body: Body, generator: torch.Generator) -> None:
    """Flexion turns the forearm forwards (-y), about the axis (arm x forward); pronation turns it about the arm."""
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        arm = torch.tensor([sign, 0.0, -1.0]) / 2**0.5
        flexion_axis = torch.linalg.cross(arm, torch.tensor([0.0, -1.0, 0.0]))
        draw = torch.rand(len(vectors), 2, generator=generator)
        flexion, twist = 2.2 * draw[:, :1] ** 1.5, 0.8 * (2 * draw[:, 1:] - 1)
        vectors[:, body.joint_names.index(side + "ForeArm")] = flexion * flexion_axis + twist * arm
