"""Eq. 2-3 in figures: statures of the shape space, what B_p removes of linear blending's error.  body -> rows."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from workbench.body.model import Body
from workbench.body.skinning import linear_blend
from workbench.evaluation_table import Row, at_least, told, within
from workbench.geometry.rotations import axis_angle_to_matrix

UNSEEN_SEED = 1  # the correctives are fitted with seed 0
END_VERTICES = 400  # enough at crown and soles to hold the highest and lowest vertex of any shape

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


def body_rows(body: Body, *, shapes: int = 4000, poses: int = 100) -> list[Row]:
    """Stature over beta ~ N(0, I), and the error that B_p removes on poses that its fit never saw."""
    heights = statures(body, torch.randn(shapes, body.shape_count, generator=torch.Generator().manual_seed(0)))
    error = skinning_error(body, sample_poses(body, poses, torch.Generator().manual_seed(UNSEEN_SEED)))
    return [
        within("stature over beta ~ N(0, I), mean", float(heights.mean()), "m", 1.64, 1.76),
        within("stature over beta ~ N(0, I), standard deviation", float(heights.std()), "m", 0.07, 0.11),
        told("baseline: linear blending alone to dual quaternions, unseen poses, RMS", 1e3 * error.linear, "mm"),
        told("with B_p, the same", 1e3 * error.corrected, "mm"),
        at_least("B_p removes of it", 100 * error.reduction, "%", 60.0),
    ]


def statures(body: Body, betas: Float[Tensor, "A K"]) -> Float[Tensor, "A"]:
    """Height of the rest pose for each shape, metres."""
    z = body.template[:, 2]
    ends = torch.cat([z.topk(END_VERTICES).indices, (-z).topk(END_VERTICES).indices])
    heights = z[ends] + torch.einsum("ak,kv->av", betas, body.shape_directions[:, ends, 2])
    return heights.amax(dim=1) - heights.amin(dim=1)


@dataclass(frozen=True)
class CorrectivesError:
    """RMS vertex distance to dual-quaternion skinning over poses, metres."""

    linear: float
    corrected: float

    @property
    def reduction(self) -> float:
        """The share of linear blending's error that B_p removes."""
        return 1.0 - self.corrected / self.linear


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
