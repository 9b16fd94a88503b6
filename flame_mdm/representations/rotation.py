"""Conversions between rotations.

Rotations are represented by axis-angle vectors, quaternions, matrices, two kinds of 6D vectors, or
Euler angles. Every function accepts any leading batch shape, preserves the dtype and is
differentiable. Quaternions are in (w, x, y, z) order and have unit length. Matrices act on column
vectors. Angles are in radians.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.errors import UserError

SixD = Literal["rows", "columns"]
"""Which vectors of the matrix a 6D vector contains.

These are either its first two rows (pytorch3d, FLAME, ACTOR, TEMOS, MDM's action data) or its first
two columns (HumanML3D). rows(R) = columns(R^T), so decoding with the wrong convention results in
the inverse rotation.
"""


def axis_angle_to_quaternion(axis_angle: Tensor) -> Tensor:
    """Converts axis-angle vectors (..., 3) of any length to quaternions (..., 4)."""
    angle = torch.linalg.vector_norm(axis_angle, dim=-1, keepdim=True)
    # sinc keeps the value and the gradient exact at angle 0
    return torch.cat(
        [torch.cos(angle / 2), torch.sinc(angle / (2 * torch.pi)) / 2 * axis_angle], -1
    )


def quaternion_to_axis_angle(quaternion: Tensor) -> Tensor:
    """Converts quaternions (..., 4) to axis-angle vectors (..., 3) with an angle in [0, pi]."""
    quaternion = standardize(quaternion)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = torch.linalg.vector_norm(xyz, dim=-1, keepdim=True)
    small = sine < torch.finfo(quaternion.dtype).eps ** 0.5
    safe = torch.where(small, 1.0, sine)
    return torch.where(small, 2.0, 2 * torch.atan2(safe, w) / safe) * xyz


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Converts quaternions (..., 4) of any nonzero length to matrices (..., 3, 3)."""
    q = quaternion * (2**0.5 / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True))
    w, x, y, z = q.unbind(-1)
    elements = [
        *(1 - (y * y + z * z), x * y - w * z, x * z + w * y),
        *(x * y + w * z, 1 - (x * x + z * z), y * z - w * x),
        *(x * z - w * y, y * z + w * x, 1 - (x * x + y * y)),
    ]
    return torch.stack(elements, -1).unflatten(-1, (3, 3))


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """Converts matrices (..., 3, 3) to quaternions (..., 4) with w >= 0."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    # These are rows of 4 q q^T. The row of the largest component is well-conditioned.
    outer = [
        *(1 + a + e + i, h - f, c - g, d - b),
        *(h - f, 1 + a - e - i, b + d, c + g),
        *(c - g, b + d, 1 - a + e - i, f + h),
        *(d - b, c + g, f + h, 1 - a - e + i),
    ]
    rows = torch.stack(outer, -1).unflatten(-1, (4, 4))
    largest = rows.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = rows.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    return standardize(F.normalize(row, dim=-1))


def axis_angle_to_matrix(axis_angle: Tensor) -> Tensor:
    """Converts axis-angle vectors (..., 3) to matrices (..., 3, 3)."""
    return quaternion_to_matrix(axis_angle_to_quaternion(axis_angle))


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """Converts matrices (..., 3, 3) to axis-angle vectors (..., 3) with an angle in [0, pi]."""
    return quaternion_to_axis_angle(matrix_to_quaternion(matrix))


def matrix_to_rot6d(matrix: Tensor, convention: SixD) -> Tensor:
    """Converts matrices (..., 3, 3) to 6D vectors (..., 6): the first two rows or columns."""
    vectors = matrix if convention == "rows" else matrix.mT
    return vectors[..., :2, :].flatten(-2)


def rot6d_to_matrix(rot6d: Tensor, convention: SixD) -> Tensor:
    """Converts 6D vectors (..., 6), orthonormal or not, to matrices (..., 3, 3).

    The vectors are orthonormalized with Gram-Schmidt (Zhou et al. 2019, eq. 15). Every pair of
    finite vectors yields a rotation. A zero vector is replaced by the basis vector that is least
    parallel to the other vector. If the vectors are parallel, the second one is replaced in the
    same way. Two zero vectors yield the identity.
    """
    degenerate = _degenerate(rot6d, *_orthogonal(rot6d))
    # There are no branches here, because neither exported graphs nor torch.func.vmap, which
    # guidance uses, support them
    first, across = _orthogonal(torch.where(degenerate, _completed(rot6d), rot6d))
    second = F.normalize(across, dim=-1)
    rows = torch.stack([first, second, torch.linalg.cross(first, second)], -2)
    return rows if convention == "rows" else rows.mT


def is_degenerate(rot6d: Tensor) -> Tensor:
    """Returns a bool tensor (...,) that is True where a 6D vector (..., 6) defines no rotation.

    The rotation is undefined if one of the two 3D vectors is 0 or if both are parallel.
    `rot6d_to_matrix` replaces such vectors.
    """
    return _degenerate(rot6d, *_orthogonal(rot6d)).squeeze(-1)


def _orthogonal(rot6d: Tensor) -> tuple[Tensor, Tensor]:
    """Converts each 6D vector (..., 6) to two orthogonal vectors.

    The results are the normalized first vector and the component of the second vector that is
    perpendicular to the first.
    """
    first, second = F.normalize(rot6d[..., :3], dim=-1), rot6d[..., 3:]
    return first, second - (first * second).sum(-1, keepdim=True) * first


def _degenerate(rot6d: Tensor, first: Tensor, across: Tensor) -> Tensor:
    """Returns a bool tensor (..., 1) that is True where a 6D vector (..., 6) defines no rotation.

    `first` and `across` are the results of `_orthogonal`. If the two vectors are parallel, `across`
    contains only rounding errors. Vectors that contain NaN do not count as degenerate, so they stay
    NaN.
    """
    length = torch.linalg.vector_norm(rot6d[..., 3:], dim=-1, keepdim=True)
    parallel = (
        torch.linalg.vector_norm(across, dim=-1, keepdim=True)
        <= torch.finfo(rot6d.dtype).eps ** 0.5 * length
    )
    return parallel | _shorter(first) | _shorter(F.normalize(across, dim=-1))


def _shorter(normalized: Tensor) -> Tensor:
    """Returns a bool tensor (..., 1) that is True where a normalized vector has a norm below 1.

    In this case, the original vector was close to 0.
    """
    return (
        torch.linalg.vector_norm(normalized, dim=-1, keepdim=True)
        < 1 - torch.finfo(normalized.dtype).eps ** 0.5
    )


def _completed(rot6d: Tensor) -> Tensor:
    """Replaces one or both halves of each 6D vector (..., 6) with basis vectors."""
    first, second = F.normalize(rot6d[..., :3], dim=-1), F.normalize(rot6d[..., 3:], dim=-1)
    basis = torch.eye(3, dtype=rot6d.dtype, device=rot6d.device)
    replaced = _shorter(first)
    kept = replaced & ~_shorter(second)
    first = torch.where(replaced, basis[second.abs().argmin(-1)], first)
    second = torch.where(kept, second, basis[first.abs().argmin(-1)])
    return torch.cat([first, second], -1)


def matrix_to_euler(matrix: Tensor, order: str) -> Tensor:
    """Converts matrices (..., 3, 3) to Euler angles (..., 3) in radians.

    The middle angle is in [-pi/2, pi/2]. In gimbal lock, the third angle is 0.

    Raises:
        UserError: If `order` is not XYZ, XZY, YXZ, YZX, ZXY or ZYX.
    """
    if sorted(order) != ["X", "Y", "Z"]:
        raise UserError(
            f"Euler order {order!r} is not supported. Use the letters X, Y and Z once each, as in 'ZXY'"
        )
    i, j, k = ("XYZ".index(axis) for axis in order)
    sign = 1.0 if (j - i) % 3 == 1 else -1.0
    cosine = torch.hypot(matrix[..., i, i], matrix[..., i, j])
    locked = cosine < torch.finfo(matrix.dtype).eps ** 0.5
    first = torch.where(
        locked,
        torch.atan2(sign * matrix[..., k, j], matrix[..., j, j]),
        torch.atan2(-sign * matrix[..., j, k], matrix[..., k, k]),
    )
    third = torch.where(locked, 0.0, torch.atan2(-sign * matrix[..., i, j], matrix[..., i, i]))
    return torch.stack([first, torch.atan2(sign * matrix[..., i, k], cosine), third], -1)


def standardize(quaternion: Tensor) -> Tensor:
    """Returns q or -q (..., 4), whichever has w >= 0. Both represent the same rotation.

    Example:
        >>> standardize(torch.tensor([-1.0, 0.0, 0.0, 0.5])).tolist()
        [1.0, -0.0, -0.0, -0.5]
    """
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Returns the Hamilton product (..., 4) of a and b: the rotation by b, followed by a."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    product = [
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    ]
    return torch.stack(product, -1)


def inverse(quaternion: Tensor) -> Tensor:
    """Returns the inverse (..., 4) of unit quaternions (..., 4)."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], -1)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotates vectors (..., 3) by unit quaternions (..., 4). The leading shapes are broadcast."""
    xyz, vector = torch.broadcast_tensors(quaternion[..., 1:], vector)
    twice = 2 * torch.linalg.cross(xyz, vector)
    return vector + quaternion[..., :1] * twice + torch.linalg.cross(xyz, twice)


def _scaled(vectors: Tensor) -> Tensor:
    """Scales vectors so that their largest absolute entry is 1. Zero vectors remain 0.

    This prevents the squares of tiny vectors from underflowing.
    """
    largest = vectors.abs().amax(-1, keepdim=True)
    return vectors / torch.where(largest > 0, largest, 1.0)


def between(a: Tensor, b: Tensor) -> Tensor:
    """Returns the shortest rotation from the direction of `a` (..., 3) to the direction of `b`.

    The quaternions (..., 4) have w >= 0. For opposite directions, the result is a half turn about
    a perpendicular axis. If a vector is 0, the result is the identity.

    Example:
        >>> quarter = between(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 2.0, 0.0]))
        >>> [round(value, 4) for value in quarter.tolist()]  # 90 degrees about z
        [0.7071, 0.0, 0.0, 0.7071]
    """
    # (|a| |b| + a . b, a x b) is the quaternion of the rotation from a to b, up to its length.
    a, b = torch.broadcast_tensors(_scaled(a), _scaled(b))
    lengths = torch.linalg.vector_norm(a, dim=-1, keepdim=True) * torch.linalg.vector_norm(
        b, dim=-1, keepdim=True
    )
    quaternion = torch.cat([lengths + (a * b).sum(-1, keepdim=True), torch.linalg.cross(a, b)], -1)
    size = torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True)
    degenerate = size <= torch.finfo(a.dtype).eps ** 0.5 * lengths
    if torch.compiler.is_exporting() or degenerate.any():  # an exported graph has no branches
        basis = torch.eye(3, dtype=a.dtype, device=a.device)
        axis = F.normalize(torch.linalg.cross(a, basis[a.abs().argmin(-1)]), dim=-1)
        half_turn = F.pad(axis, (1, 0))
        identity = half_turn.new_tensor([1.0, 0.0, 0.0, 0.0])
        quaternion = torch.where(
            degenerate, torch.where(lengths > 0, half_turn, identity), quaternion
        )
        size = torch.where(degenerate, 1.0, size)
    return quaternion / size


def slerp(a: Tensor, b: Tensor, t: Tensor | float) -> Tensor:
    """Interpolates between the rotations `a` and `b` (..., 4) along the shorter arc.

    `t` in [0, 1] is a number or has the shape (..., 1). The result is `a` for t = 0 and `b` for t =
    1.
    """
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot = dot.abs()
    angle = torch.atan2(torch.linalg.vector_norm(b - dot * a, dim=-1, keepdim=True), dot)

    def weight(t: Tensor | float) -> Tensor:  # sin(t angle) / sin(angle), exact at angle 0
        return t * torch.sinc(t * angle / torch.pi) / torch.sinc(angle / torch.pi)

    return weight(1 - t) * a + weight(t) * b


def continuous(quaternion: Tensor, dim: int) -> Tensor:
    """Flips signs along the time axis `dim`, so that neighboring quaternions share a hemisphere.

    The first quaternion is unchanged.
    """
    q = quaternion.movedim(dim, 0)
    flips = torch.where((q[1:] * q[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(q.dtype)
    return torch.cat([q[:1], q[1:] * flips.cumprod(0)]).movedim(0, dim)


def rotate_y(vector: Tensor, angle: Tensor) -> Tensor:
    """Rotates vectors (..., 3) about the vertical axis by `angle` (...) in radians.

    Positive angles turn +z toward +x, which is a turn to the left.
    """
    x, y, z = vector.unbind(-1)
    cosine, sine = torch.cos(angle), torch.sin(angle)
    return torch.stack([cosine * x + sine * z, y.expand_as(cosine * x), cosine * z - sine * x], -1)
