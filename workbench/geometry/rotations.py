"""Rotations: matrices (3,3), unit quaternions (w,x,y,z), axis-angle vectors, Euler angles.  (*B, ...) -> (*B, ...)

Pure, batched, differentiable; radians; matrices act on column vectors. Conversions follow Diebel 2006, "Representing
attitude"; every function works in the dtype it is given.
"""

import torch
from jaxtyping import Float
from torch import Tensor


def cross_matrix(v: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """[v]x, with [v]x w = v x w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))


def axis_angle_to_matrix(axis_angle: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3 3"]:
    """Rodrigues: R = I + sin(t)/t [v]x + (1 - cos t)/t^2 [v]x^2 with t = |v|.  Smooth at v = 0."""
    squared = (axis_angle * axis_angle).sum(-1)[..., None, None]
    small = squared < 1e-4
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    first = torch.where(small, 1 - squared / 6 + squared**2 / 120, torch.sin(angle) / angle)
    half = torch.sin(angle / 2) / (angle / 2)  # 1 - cos t = 2 sin^2(t/2): no cancellation
    second = torch.where(small, 0.5 - squared / 24 + squared**2 / 720, 0.5 * half**2)
    K = cross_matrix(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + first * K + second * (K @ K)


def matrix_to_axis_angle(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3"]:
    """Axis times angle, angle in [0, pi]."""
    return quaternion_to_axis_angle(matrix_to_quaternion(R))


def quaternion_to_axis_angle(q: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3"]:
    """Axis times angle, angle in [0, pi].  q is a unit quaternion of either sign."""
    q = torch.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    squared = (v * v).sum(-1, keepdim=True)
    small = squared < 1e-12
    length = torch.where(small, torch.ones_like(squared), squared).sqrt()
    return v * torch.where(small, 2 / w.clamp(min=0.5), 2 * torch.atan2(length, w) / length)


def axis_angle_to_quaternion(axis_angle: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 4"]:
    """(cos t/2, sin(t/2)/t v)."""
    squared = (axis_angle * axis_angle).sum(-1, keepdim=True)
    small = squared < 1e-4
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    scale = torch.where(small, 0.5 - squared / 48 + squared**2 / 3840, torch.sin(angle / 2) / angle)
    cosine = torch.where(small, 1 - squared / 8 + squared**2 / 384, torch.cos(angle / 2))
    return torch.cat([cosine, scale * axis_angle], dim=-1)


def quaternion_to_matrix(q: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """Rotation of q / |q|."""
    w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quaternion(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4"]:
    """Unit quaternion with w >= 0.

    The matrix 4 q q^T is linear in R; its row with the largest diagonal is q up to scale, and never short.
    """
    xx, yy, zz = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    wx, wy, wz = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    xy, xz, yz = R[..., 1, 0] + R[..., 0, 1], R[..., 0, 2] + R[..., 2, 0], R[..., 2, 1] + R[..., 1, 2]
    outer = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, wx, wy, wz], -1),
            torch.stack([wx, 1 + xx - yy - zz, xy, xz], -1),
            torch.stack([wy, xy, 1 - xx + yy - zz, yz], -1),
            torch.stack([wz, xz, yz, 1 - xx - yy + zz], -1),
        ],
        dim=-2,
    )
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    row = torch.take_along_dim(outer, largest, dim=-2).squeeze(-2)
    q = row / row.norm(dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def quaternion_multiply(p: Float[Tensor, "*#B 4"], q: Float[Tensor, "*#B 4"]) -> Float[Tensor, "... 4"]:
    """Hamilton product: the rotation q first, then p."""
    a, b, c, d = p.unbind(-1)
    w, x, y, z = q.unbind(-1)
    return torch.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        dim=-1,
    )


def slerp(
    q0: Float[Tensor, "*#B 4"], q1: Float[Tensor, "*#B 4"], t: Float[Tensor, "*#B"] | float
) -> Float[Tensor, "... 4"]:
    """Constant-speed rotation from unit quaternion q0 (t = 0) to q1 (t = 1) the shorter way (Shoemake 1985)."""
    fraction = torch.as_tensor(t, dtype=q0.dtype, device=q0.device)[..., None]
    q1 = torch.where((q0 * q1).sum(-1, keepdim=True) < 0, -q1, q1)
    squared = ((q1 - q0) ** 2).sum(-1, keepdim=True)
    small = squared < 1e-8
    chord = torch.where(small, torch.ones_like(squared), squared).sqrt()
    angle = 2 * torch.atan2(chord, (q1 + q0).norm(dim=-1, keepdim=True))
    before = torch.where(small, 1 - fraction, torch.sin((1 - fraction) * angle) / torch.sin(angle))
    after = torch.where(small, fraction, torch.sin(fraction * angle) / torch.sin(angle))
    q = before * q0 + after * q1
    return q / q.norm(dim=-1, keepdim=True)


def _axis_rotation(angle: Float[Tensor, "*B"], axis: int) -> Float[Tensor, "*B 3 3"]:
    unit = torch.eye(3, dtype=angle.dtype, device=angle.device)[axis]
    return axis_angle_to_matrix(angle[..., None] * unit)


def _axes(order: str) -> list[int]:
    letters = order.lower()
    if sorted(letters) != ["x", "y", "z"]:
        raise ValueError(f"the order of Euler angles must name x, y and z once each (such as 'zxy'), but got {order!r}")
    return ["xyz".index(letter) for letter in letters]


def euler_to_matrix(angles: Float[Tensor, "*B 3"], order: str) -> Float[Tensor, "*B 3 3"]:
    """R = R_order[0](angles[0]) R_order[1](angles[1]) R_order[2](angles[2]): axes that turn with the joint (BVH)."""
    i, j, k = _axes(order)
    first, second, third = angles.unbind(-1)
    return _axis_rotation(first, i) @ _axis_rotation(second, j) @ _axis_rotation(third, k)


def matrix_to_euler(R: Float[Tensor, "*B 3 3"], order: str) -> Float[Tensor, "*B 3"]:
    """Angles with euler_to_matrix(angles, order) = R; the middle one in [-pi/2, pi/2], the last 0 in gimbal lock."""
    i, j, k = _axes(order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0  # even or odd permutation of x y z
    second = torch.atan2(sign * R[..., i, k], torch.hypot(R[..., i, i], R[..., i, j]))
    locked = torch.hypot(R[..., i, i], R[..., i, j]) < 1e-6
    first = torch.where(
        locked,
        torch.atan2(sign * R[..., k, j], R[..., j, j]),
        torch.atan2(-sign * R[..., j, k], R[..., k, k]),
    )
    third = torch.where(locked, torch.zeros_like(first), torch.atan2(-sign * R[..., i, j], R[..., i, i]))
    return torch.stack([first, second, third], dim=-1)


def smallest_rotation(a: Float[Tensor, "*#B 3"], b: Float[Tensor, "*#B 3"]) -> Float[Tensor, "... 3 3"]:
    """The rotation by the least angle that takes direction a onto direction b (any one of them when b = -a).

    a, b need no unit length; ValueError if one of them is zero.
    """
    a, b = torch.broadcast_tensors(a, b)
    length_a, length_b = a.norm(dim=-1, keepdim=True), b.norm(dim=-1, keepdim=True)
    if not ((length_a > 0).all() and (length_b > 0).all()):
        raise ValueError("a direction needs a length above zero, but got a zero (or NaN) vector; leave such bones out")
    a, b = a / length_a, b / length_b
    w = 1 + (a * b).sum(-1, keepdim=True)  # quaternion (1 + cos t, a x b), up to scale
    v = torch.linalg.cross(a, b)
    axis = torch.nn.functional.one_hot(a.abs().argmin(-1), 3).to(a)
    perpendicular = torch.nn.functional.normalize(torch.linalg.cross(a, axis), dim=-1)
    opposite = w < 1e-6
    q = torch.where(opposite, torch.cat([w * 0, perpendicular], -1), torch.cat([w, v], -1))
    return quaternion_to_matrix(q)


def project_to_rotation(M: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 3 3"]:
    """The rotation nearest to M in the Frobenius norm: U diag(1, 1, det(U V^T)) V^T of M = U S V^T (Kabsch)."""
    U, _, Vh = torch.linalg.svd(M)
    sign = torch.linalg.det(U @ Vh)[..., None]
    return torch.cat([U[..., :2], U[..., 2:] * sign[..., None]], dim=-1) @ Vh


def rotation_angle(R: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B"]:
    """How far R turns, in [0, pi]; accurate for small angles too."""
    q = matrix_to_quaternion(R)
    return 2 * torch.atan2(q[..., 1:].norm(dim=-1), q[..., 0])
