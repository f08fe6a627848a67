"""Laws of rotations: round trips, agreement with scipy, smoothness at the usual traps."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from workbench.geometry.rotations import (
    axis_angle_to_matrix,
    axis_angle_to_quaternion,
    euler_to_matrix,
    matrix_to_axis_angle,
    matrix_to_euler,
    matrix_to_quaternion,
    project_to_rotation,
    quaternion_multiply,
    quaternion_to_axis_angle,
    quaternion_to_matrix,
    rotation_angle,
    slerp,
    smallest_rotation,
)

ORDERS = ("xyz", "xzy", "yxz", "yzx", "zxy", "zyx")

number = st.floats(-3.1, 3.1, allow_nan=False, width=64)
vector = st.tuples(number, number, number).map(lambda v: torch.tensor(v, dtype=torch.float64))


def random_rotations(count=200, seed=0):
    return torch.from_numpy(Rotation.random(count, rng=np.random.default_rng(seed)).as_matrix())


def test_axis_angle_agrees_with_scipy(rng):
    vectors = rng.normal(size=(50, 4, 3)) * np.geomspace(1e-9, 3, 50)[:, None, None]
    ours = axis_angle_to_matrix(torch.from_numpy(vectors))
    theirs = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix().reshape(50, 4, 3, 3)
    torch.testing.assert_close(ours, torch.from_numpy(theirs), rtol=0, atol=1e-14)


@settings(max_examples=60, deadline=None)
@given(vector)
def test_axis_angle_makes_rotations(v):
    R = axis_angle_to_matrix(v)
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=R.dtype), rtol=0, atol=1e-13)
    assert float(torch.linalg.det(R)) == pytest.approx(1)


@settings(max_examples=60, deadline=None)
@given(vector)
def test_axis_angle_and_quaternion_agree(v):
    torch.testing.assert_close(quaternion_to_matrix(axis_angle_to_quaternion(v)), axis_angle_to_matrix(v))
    torch.testing.assert_close(
        axis_angle_to_matrix(quaternion_to_axis_angle(axis_angle_to_quaternion(v))), axis_angle_to_matrix(v)
    )


def test_matrices_survive_every_round_trip():
    R = torch.cat([random_rotations(), axis_angle_to_matrix(math.pi * torch.eye(3, dtype=torch.float64))])
    torch.testing.assert_close(quaternion_to_matrix(matrix_to_quaternion(R)), R, rtol=0, atol=1e-12)
    torch.testing.assert_close(axis_angle_to_matrix(matrix_to_axis_angle(R)), R, rtol=0, atol=1e-12)
    for order in ORDERS:
        torch.testing.assert_close(euler_to_matrix(matrix_to_euler(R, order), order), R, rtol=0, atol=1e-10)


def test_single_precision_keeps_single_precision():
    R = random_rotations().float()
    assert matrix_to_quaternion(R).dtype == torch.float32
    torch.testing.assert_close(quaternion_to_matrix(matrix_to_quaternion(R)), R, rtol=0, atol=1e-6)


@pytest.mark.parametrize("order", ORDERS)
def test_euler_angles_agree_with_scipy(order, rng):
    angles = rng.uniform(-3, 3, size=(100, 3))
    theirs = Rotation.from_euler(order.upper(), angles).as_matrix()
    torch.testing.assert_close(
        euler_to_matrix(torch.from_numpy(angles), order), torch.from_numpy(theirs), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("middle", [math.pi / 2, -math.pi / 2])
def test_gimbal_lock_still_gives_the_rotation(order, middle):
    R = euler_to_matrix(torch.tensor([0.3, middle, -1.1], dtype=torch.float64), order)
    torch.testing.assert_close(euler_to_matrix(matrix_to_euler(R, order), order), R, rtol=0, atol=1e-9)


def test_unknown_euler_order_is_named():
    with pytest.raises(ValueError, match=r"x, y and z once each.*'zxx'"):
        euler_to_matrix(torch.zeros(3), "zxx")


def test_quaternion_product_is_the_product_of_matrices():
    P, Q = random_rotations(seed=1), random_rotations(seed=2)
    product = quaternion_multiply(matrix_to_quaternion(P), matrix_to_quaternion(Q))
    torch.testing.assert_close(quaternion_to_matrix(product), P @ Q, rtol=0, atol=1e-12)


def test_quaternions_have_one_sign():
    assert bool((matrix_to_quaternion(random_rotations())[:, 0] >= 0).all())


@settings(max_examples=60, deadline=None)
@given(vector, vector, st.floats(0, 1))
def test_slerp_turns_at_constant_speed_the_short_way(a, b, t):
    q0, q1 = axis_angle_to_quaternion(a), -axis_angle_to_quaternion(b)
    R0, R1, Rt = (quaternion_to_matrix(q) for q in (q0, q1, slerp(q0, q1, t)))
    whole, part = rotation_angle(R0.mT @ R1), rotation_angle(R0.mT @ Rt)
    assert float(part) == pytest.approx(t * float(whole), abs=1e-6)


def test_slerp_ends_exactly_where_it_should():
    q0, q1 = matrix_to_quaternion(random_rotations(seed=1)), matrix_to_quaternion(random_rotations(seed=2))
    torch.testing.assert_close(slerp(q0, q1, 0.0), q0)
    torch.testing.assert_close(quaternion_to_matrix(slerp(q0, q1, 1.0)), quaternion_to_matrix(q1))


@settings(max_examples=60, deadline=None)
@given(vector.filter(lambda v: v.norm() > 1e-3), vector.filter(lambda v: v.norm() > 1e-3))
def test_smallest_rotation_takes_a_onto_b_by_the_angle_between(a, b):
    R = smallest_rotation(a, b)
    torch.testing.assert_close(R @ a / a.norm(), b / b.norm(), rtol=0, atol=1e-6)
    between = torch.atan2(torch.linalg.cross(a, b).norm(), a @ b)
    assert float(rotation_angle(R)) == pytest.approx(float(between), abs=1e-6)


def test_smallest_rotation_of_opposite_directions():
    a = torch.tensor([[1.0, 0, 0], [0, -2.0, 0], [0.3, 0.1, -0.9]])
    R = smallest_rotation(a, -a)
    torch.testing.assert_close((R @ a[..., None])[..., 0], -a, rtol=0, atol=1e-6)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(3))


def test_smallest_rotation_refuses_a_zero_direction():
    with pytest.raises(ValueError, match="length above zero"):
        smallest_rotation(torch.zeros(3), torch.tensor([1.0, 0, 0]))


def test_projection_finds_the_nearest_rotation(rng):
    R = random_rotations(50)
    noisy = R + 0.1 * torch.from_numpy(rng.normal(size=R.shape))
    projected = project_to_rotation(noisy)
    torch.testing.assert_close(projected.mT @ projected, torch.eye(3, dtype=R.dtype).expand_as(R))
    torch.testing.assert_close(torch.linalg.det(projected), torch.ones(50, dtype=R.dtype))
    for angle in (1e-3, -1e-3):
        nudged = projected @ axis_angle_to_matrix(torch.tensor([angle, angle, 0.0], dtype=R.dtype))
        assert bool(((noisy - projected).norm(dim=(1, 2)) < (noisy - nudged).norm(dim=(1, 2))).all())
    torch.testing.assert_close(project_to_rotation(R), R)


@pytest.mark.parametrize("length", [0.0, 1e-9, 0.009, 0.5, 3.0])
def test_gradients_are_right_and_finite(length):
    v = torch.tensor([[0.6, -0.64, 0.48]], dtype=torch.float64) * length
    v.requires_grad_(True)
    assert torch.autograd.gradcheck(axis_angle_to_matrix, v)
    assert torch.autograd.gradcheck(axis_angle_to_quaternion, v)
    if length < 3:
        assert torch.autograd.gradcheck(lambda w: matrix_to_axis_angle(axis_angle_to_matrix(w)), v)
        q = axis_angle_to_quaternion(torch.tensor([[0.1, 0.4, -0.2]], dtype=torch.float64))
        assert torch.autograd.gradcheck(lambda w: slerp(q, axis_angle_to_quaternion(w), 0.3), v)
