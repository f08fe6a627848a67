"""5, Eq. 17: the motion descriptor gamma.  theta (T,J,3,3), H (T,3), fps -> gamma (T,42).

gamma = theta_bar, its velocity and acceleration (3 x 10), velocity and acceleration of the global translation H and of
the global rotation K as Euler angles (4 x 3).

Deviations from the paper: H's derivatives are taken along the body's heading and K's angles are unwrapped, so that
gamma does not depend on where the body stands and faces; theta_bar also sees the direction of gravity in the root's
frame, which the paper's gamma lacks although a leaning body's garment hangs differently.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from workbench.geometry.rotations import axis_angle_to_matrix, matrix_to_euler

POSE_SIZE = 10  # theta_bar, the paper
DESCRIPTOR_SIZE = 42
HIDDEN = 500  # facts.md 1
EULER_ORDER = "zxy"  # facts.md 1


@dataclass(frozen=True)
class GlobalMotion:
    """How the root moves, seen from the body: velocities and accelerations a second."""

    translation_velocity: Float[Tensor, "*B T 3"]
    translation_acceleration: Float[Tensor, "*B T 3"]
    rotation_velocity: Float[Tensor, "*B T 3"]
    rotation_acceleration: Float[Tensor, "*B T 3"]

    def stacked(self) -> Float[Tensor, "*B T 12"]:
        return torch.cat(
            [
                self.translation_velocity,
                self.translation_acceleration,
                self.rotation_velocity,
                self.rotation_acceleration,
            ],
            dim=-1,
        )


def backward_difference(values: Float[Tensor, "*B T C"], fps: float) -> Float[Tensor, "*B T C"]:
    """(x[t] - x[t-1]) fps; 0 in the first frame (facts.md 1)."""
    return torch.cat([torch.zeros_like(values[..., :1, :]), values.diff(dim=-2) * fps], dim=-2)


def settled_acceleration(velocity: Float[Tensor, "*B T C"], fps: float) -> Float[Tensor, "*B T C"]:
    """Backward difference of a backward difference: 0 in the first two frames, for the first velocity is unknown."""
    acceleration = backward_difference(velocity, fps)
    acceleration[..., :2, :] = 0
    return acceleration


def unwrapped(angles: Float[Tensor, "*B T C"]) -> Float[Tensor, "*B T C"]:
    """Angles without jumps of 2 pi from frame to frame."""
    steps = angles.diff(dim=-2)
    turns = torch.round(steps / (2 * torch.pi))
    jumps = torch.cat([torch.zeros_like(angles[..., :1, :]), turns.cumsum(dim=-2)], dim=-2)
    return angles - 2 * torch.pi * jumps


def global_motion(root: Float[Tensor, "*B T 3 3"], translation: Float[Tensor, "*B T 3"], fps: float) -> GlobalMotion:
    """Derivatives of K and H by backward differences."""
    angles = unwrapped(matrix_to_euler(root, EULER_ORDER))
    zero = torch.zeros_like(angles[..., 0])
    facing = axis_angle_to_matrix(torch.stack([zero, zero, angles[..., 0]], dim=-1))  # z first: the heading
    velocity = backward_difference(translation, fps)
    acceleration = settled_acceleration(velocity, fps)
    turning = backward_difference(angles, fps)
    return GlobalMotion(
        (facing.mT @ velocity[..., None])[..., 0],
        (facing.mT @ acceleration[..., None])[..., 0],
        turning,
        settled_acceleration(turning, fps),
    )


def pose_input(rotations: Float[Tensor, "*B J 3 3"]) -> Float[Tensor, "*B I"]:
    """R - I of every joint but the root, and where down is in the root's frame: what theta_bar is made of."""
    identity = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
    local = (rotations[..., 1:, :, :] - identity).flatten(-3)
    down = -rotations[..., 0, 2, :]
    return torch.cat([local, down], dim=-1)


class PoseDescriptor(nn.Module):
    """theta_bar: pose input -> 500 ReLU -> 10 (facts.md 1)."""

    def __init__(self, joints: int, generator: torch.Generator):
        super().__init__()
        inputs = 9 * (joints - 1) + 3
        self.hidden, self.out = nn.Linear(inputs, HIDDEN), nn.Linear(HIDDEN, POSE_SIZE)
        nn.init.kaiming_uniform_(self.hidden.weight, nonlinearity="relu", generator=generator)
        nn.init.normal_(self.out.weight, std=HIDDEN**-0.5, generator=generator)
        nn.init.zeros_(self.hidden.bias)
        nn.init.zeros_(self.out.bias)

    def forward(self, rotations: Float[Tensor, "*B J 3 3"]) -> Float[Tensor, "*B P"]:
        return self.out(torch.relu(self.hidden(pose_input(rotations))))


def descriptor(pose: Float[Tensor, "*B T P"], moving: Float[Tensor, "*B T 12"], fps: float) -> Float[Tensor, "*B T D"]:
    """gamma from theta_bar and the root's motion      (Eq. 17)"""
    velocity = backward_difference(pose, fps)
    return torch.cat([pose, velocity, settled_acceleration(velocity, fps), moving], dim=-1)


class DescriptorStream:
    """gamma frame by frame: what `descriptor` and `global_motion` give for a whole motion, without its future.

    In numpy: of so few numbers, torch's calls would take longer than the work.
    """

    def __init__(self, describe: PoseDescriptor, fps: float):
        self.fps, self.frame = fps, 0
        parameters = (describe.hidden.weight, describe.hidden.bias, describe.out.weight, describe.out.bias)
        self.parameters = [parameter.detach().numpy() for parameter in parameters]
        self.identity = np.eye(3, dtype=np.float32)
        # theta_bar, H, K's angles of the last frame
        self.last = np.zeros(POSE_SIZE + 6, np.float32)
        self.last_velocity = np.zeros_like(self.last)

    def __call__(self, rotations: Float[Tensor, "J 3 3"], translation: Float[Tensor, "3"]) -> Float[Tensor, "D"]:
        """gamma of the next frame."""
        R = rotations.numpy()
        hidden, hidden_bias, out, out_bias = self.parameters
        seen = np.concatenate([(R[1:] - self.identity).ravel(), -R[0, 2]])
        pose = out @ np.maximum(hidden @ seen + hidden_bias, 0) + out_bias
        angles = np.array(heading_tilt_roll(R[0].tolist()), np.float32)
        if self.frame:
            angles -= 2 * np.pi * np.round((angles - self.last[-3:]) / (2 * np.pi))
        now = np.concatenate([pose, translation.numpy(), angles])
        velocity = (now - self.last) * self.fps if self.frame else np.zeros_like(now)
        acceleration = (velocity - self.last_velocity) * self.fps if self.frame > 1 else np.zeros_like(now)
        self.last, self.last_velocity, self.frame = now, velocity, self.frame + 1
        facing = np.array(turn_about_z(float(angles[0])), np.float32)
        gamma = [pose, velocity[:POSE_SIZE], acceleration[:POSE_SIZE]]
        gamma += [
            velocity[POSE_SIZE:-3] @ facing,
            acceleration[POSE_SIZE:-3] @ facing,
            velocity[-3:],
            acceleration[-3:],
        ]
        return torch.from_numpy(np.concatenate(gamma))


def heading_tilt_roll(R: list[list[float]]) -> tuple[float, float, float]:
    """`matrix_to_euler` of one matrix in EULER_ORDER."""
    level = math.hypot(R[2][2], R[2][0])
    tilt = math.atan2(R[2][1], level)
    if level < 1e-6:
        return math.atan2(R[1][0], R[0][0]), tilt, 0.0
    return math.atan2(-R[0][1], R[1][1]), tilt, math.atan2(-R[2][0], R[2][2])


def turn_about_z(angle: float) -> list[list[float]]:
    """The rotation matrix."""
    c, s = math.cos(angle), math.sin(angle)
    return [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
