"""5, Eq. 17: the motion descriptor gamma.  theta (T,J,3,3), H (T,3), fps -> gamma (T,42).

gamma = theta_bar, its velocity and acceleration (3 x 10), velocity and acceleration of the global translation H and of
the global rotation K as Euler angles (4 x 3).

Deviations from the paper: H's derivatives are taken along the body's heading and K's angles are unwrapped, so that
gamma does not depend on where the body stands and faces; theta_bar also sees the direction of gravity in the root's
frame, which the paper's gamma lacks although a leaning body's garment hangs differently.
"""

from dataclasses import dataclass

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
    """gamma frame by frame: what `descriptor` and `global_motion` give for a whole motion, without its future."""

    def __init__(self, describe: PoseDescriptor, fps: float):
        self.describe, self.fps, self.frame = describe, fps, 0
        zero = torch.zeros(3)
        self.last = {"pose": torch.zeros(POSE_SIZE), "translation": zero, "angles": zero}
        self.last_velocity = {name: torch.zeros_like(value) for name, value in self.last.items()}

    def __call__(self, rotations: Float[Tensor, "J 3 3"], translation: Float[Tensor, "3"]) -> Float[Tensor, "D"]:
        """gamma of the next frame."""
        pose = self.describe(rotations)
        angles = matrix_to_euler(rotations[0], EULER_ORDER)
        if self.frame:
            angles = angles - 2 * torch.pi * torch.round((angles - self.last["angles"]) / (2 * torch.pi))
        rates = [
            self._rates(name, value)
            for name, value in (("pose", pose), ("translation", translation), ("angles", angles))
        ]
        (pose_rates, (velocity, acceleration), turning) = rates
        facing = axis_angle_to_matrix(torch.stack([angles.new_zeros(()), angles.new_zeros(()), angles[0]]))
        self.frame += 1
        return torch.cat([pose, *pose_rates, velocity @ facing, acceleration @ facing, *turning])

    def _rates(self, name: str, value: Tensor) -> tuple[Tensor, Tensor]:
        velocity = (value - self.last[name]) * self.fps if self.frame else torch.zeros_like(value)
        acceleration = (velocity - self.last_velocity[name]) * self.fps
        if self.frame < 2:
            acceleration = torch.zeros_like(value)
        self.last[name], self.last_velocity[name] = value, velocity
        return velocity, acceleration
