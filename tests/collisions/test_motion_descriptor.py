"""Laws of gamma (Eq. 17)."""

import math

import pytest
import torch

from workbench.collisions.motion_descriptor import (
    DESCRIPTOR_SIZE,
    EULER_ORDER,
    DescriptorStream,
    PoseDescriptor,
    backward_difference,
    descriptor,
    global_motion,
    heading_tilt_roll,
    pose_input,
    settled_acceleration,
    turn_about_z,
    unwrapped,
)
from workbench.geometry.rotations import axis_angle_to_matrix, euler_to_matrix, matrix_to_euler

FPS = 30.0
T, JOINTS = 20, 6


def motion(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    steps = 0.1 * torch.randn(T, JOINTS, 3, generator=generator).cumsum(0)
    return axis_angle_to_matrix(steps), torch.randn(T, 3, generator=generator).cumsum(0) * 0.02


def gamma(rotations: torch.Tensor, translation: torch.Tensor) -> torch.Tensor:
    describe = PoseDescriptor(JOINTS, torch.Generator().manual_seed(1))
    return descriptor(describe(rotations), global_motion(rotations[:, 0], translation, FPS).stacked(), FPS)


def about_z(angle: float) -> torch.Tensor:
    return axis_angle_to_matrix(torch.tensor([0.0, 0.0, angle]))


def test_gamma_has_the_papers_size():
    assert gamma(*motion()).shape == (T, DESCRIPTOR_SIZE) == (T, 42)


@pytest.mark.parametrize("angle", [0.5, 2.0, -3.0])
def test_gamma_is_blind_to_where_the_body_stands_and_faces(angle):
    rotations, translation = motion()
    turned = rotations.clone()
    turned[:, 0] = about_z(angle) @ rotations[:, 0]
    moved = translation @ about_z(angle).T + torch.tensor([3.0, -2.0, 0.5])
    torch.testing.assert_close(gamma(turned, moved), gamma(rotations, translation), atol=2e-3, rtol=1e-3)


def test_gamma_sees_a_body_that_leans():
    rotations, _ = motion()
    leaning = rotations.clone()
    leaning[:, 0] = axis_angle_to_matrix(torch.tensor([0.6, 0.0, 0.0])) @ rotations[:, 0]
    assert (pose_input(leaning) - pose_input(rotations)).abs().max() > 0.1


def test_steady_motion_has_constant_velocity_and_no_acceleration():
    translation = torch.arange(T)[:, None] * torch.tensor([[0.0, -0.05, 0.0]])
    root = torch.eye(3).expand(T, 3, 3)
    found = global_motion(root, translation, FPS)
    torch.testing.assert_close(found.translation_velocity[1:], torch.tensor([0.0, -1.5, 0.0]).expand(T - 1, 3))
    assert found.translation_acceleration.abs().max() < 1e-3
    assert found.translation_velocity[0].abs().max() == 0


def test_turning_on_and_on_has_no_jumps():
    angles = torch.linspace(0, 6 * math.pi, T * 6)
    root = axis_angle_to_matrix(torch.stack([0 * angles, 0 * angles, angles], -1))
    found = global_motion(root, torch.zeros(T * 6, 3), FPS)
    step = float(angles[1]) * FPS
    torch.testing.assert_close(found.rotation_velocity[1:, 0], torch.full((T * 6 - 1,), step), atol=1e-2, rtol=1e-3)


def test_unwrapping_is_exact_for_angles_that_were_wrapped():
    true = torch.linspace(-4, 15, 60)[:, None]
    wrapped = torch.remainder(true + math.pi, 2 * math.pi) - math.pi
    back = unwrapped(wrapped)
    torch.testing.assert_close(back - back[0], true - true[0], atol=1e-5, rtol=0)


def test_differences_start_at_rest():
    values = torch.randn(T, 4)
    velocity = backward_difference(values, FPS)
    assert velocity[0].abs().max() == 0
    assert settled_acceleration(velocity, FPS)[:2].abs().max() == 0


def test_the_stream_gives_what_the_whole_motion_gives():
    rotations, translation = motion(4)
    describe = PoseDescriptor(JOINTS, torch.Generator().manual_seed(1))
    with torch.no_grad():
        whole = descriptor(describe(rotations), global_motion(rotations[:, 0], translation, FPS).stacked(), FPS)
        stream = DescriptorStream(describe, FPS)
        each = torch.stack([stream(r, h) for r, h in zip(rotations, translation, strict=True)])
    torch.testing.assert_close(each, whole, atol=2e-3, rtol=1e-4)


@pytest.mark.parametrize("tilt", [0.3, math.pi / 2, -math.pi / 2])  # the last two lock the gimbal
def test_two_ways_to_the_angles_agree(tilt):
    angles = torch.tensor([2.5, tilt, 0.0 if abs(tilt) > 1.5 else -1.2], dtype=torch.float64)
    R = euler_to_matrix(angles, EULER_ORDER)
    found = torch.tensor(heading_tilt_roll(R.tolist()), dtype=torch.float64)
    torch.testing.assert_close(found, matrix_to_euler(R, EULER_ORDER))
    torch.testing.assert_close(euler_to_matrix(found, EULER_ORDER), R, atol=1e-6, rtol=0)
    turned = torch.tensor(turn_about_z(2.5), dtype=torch.float64)
    torch.testing.assert_close(turned, euler_to_matrix(torch.tensor([2.5, 0, 0], dtype=torch.float64), EULER_ORDER))
