"""Conversions between rotations: axis-angle, quaternions, matrices, the two 6D conventions and Euler angles.

Every function accepts any leading batch shape, preserves the dtype and is differentiable.
Quaternions are (w, x, y, z) of unit length; matrices act on column vectors; angles are in
radians.
"""

from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.errors import UserError

SixD = Literal["rows", "columns"]
"""Which vectors of the matrix are kept: the first two rows (pytorch3d, FLAME, ACTOR, TEMOS, MDM's
action data) or the first two columns (HumanML3D). rows(R) = columns(R^T): decoding one as the
other gives the inverse rotation."""


def axis_angle_to_quaternion(axis_angle: Tensor) -> Tensor:
    """(..., 3) axis times angle, of any length -> (..., 4)."""
    angle = torch.linalg.vector_norm(axis_angle, dim=-1, keepdim=True)
    # sinc keeps the value and the gradient exact at angle 0
    return torch.cat(
        [torch.cos(angle / 2), torch.sinc(angle / (2 * torch.pi)) / 2 * axis_angle], -1
    )


def quaternion_to_axis_angle(quaternion: Tensor) -> Tensor:
    """(..., 4) -> (..., 3) axis times angle, the angle in [0, pi]."""
    quaternion = standardize(quaternion)
    w, xyz = quaternion[..., :1], quaternion[..., 1:]
    sine = torch.linalg.vector_norm(xyz, dim=-1, keepdim=True)
    small = sine < torch.finfo(quaternion.dtype).eps ** 0.5
    safe = torch.where(small, 1.0, sine)
    return torch.where(small, 2.0, 2 * torch.atan2(safe, w) / safe) * xyz


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """(..., 4) -> (..., 3, 3). Quaternions of other lengths are normalized."""
    q = quaternion * (2**0.5 / torch.linalg.vector_norm(quaternion, dim=-1, keepdim=True))
    w, x, y, z = q.unbind(-1)
    elements = [
        *(1 - (y * y + z * z), x * y - w * z, x * z + w * y),
        *(x * y + w * z, 1 - (x * x + z * z), y * z - w * x),
        *(x * z - w * y, y * z + w * x, 1 - (x * x + y * y)),
    ]
    return torch.stack(elements, -1).unflatten(-1, (3, 3))


def matrix_to_quaternion(matrix: Tensor) -> Tensor:
    """(..., 3, 3) -> (..., 4) with w >= 0."""
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrix.unbind(-2))
    # Rows of 4 q q^T; the row of the largest component is well-conditioned for every rotation.
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
    """(..., 3) -> (..., 3, 3)."""
    return quaternion_to_matrix(axis_angle_to_quaternion(axis_angle))


def matrix_to_axis_angle(matrix: Tensor) -> Tensor:
    """(..., 3, 3) -> (..., 3), the angle in [0, pi]."""
    return quaternion_to_axis_angle(matrix_to_quaternion(matrix))


def matrix_to_rot6d(matrix: Tensor, convention: SixD) -> Tensor:
    """(..., 3, 3) -> (..., 6), the first two rows or the first two columns, one after the other."""
    vectors = matrix if convention == "rows" else matrix.mT
    return vectors[..., :2, :].flatten(-2)


def rot6d_to_matrix(rot6d: Tensor, convention: SixD) -> Tensor:
    """(..., 6), orthonormal or not -> (..., 3, 3) by Gram-Schmidt (Zhou et al. 2019, eq. 15).

    Every finite pair of vectors gives a rotation. If one has no direction, it is replaced by the
    basis vector that is least along the other one; so is the second vector if both are parallel.
    Two zeros give the identity.
    """
    degenerate = _degenerate(rot6d, *_orthogonal(rot6d))
    # not a branch: neither exported graphs nor torch.func.vmap, which guidance uses, can have one
    first, across = _orthogonal(torch.where(degenerate, _completed(rot6d), rot6d))
    second = F.normalize(across, dim=-1)
    rows = torch.stack([first, second, torch.linalg.cross(first, second)], -2)
    return rows if convention == "rows" else rows.mT


def is_degenerate(rot6d: Tensor) -> Tensor:
    """Returns (...,) bool: whether pairs of vectors (..., 6) define no rotation, so that `rot6d_to_matrix` adds one.

    A vector of such a pair is 0, or both vectors are parallel.
    """
    return _degenerate(rot6d, *_orthogonal(rot6d)).squeeze(-1)


def _orthogonal(rot6d: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the first of two vectors (..., 6), normalized, and the part of the second one across it."""
    first, second = F.normalize(rot6d[..., :3], dim=-1), rot6d[..., 3:]
    return first, second - (first * second).sum(-1, keepdim=True) * first


def _degenerate(rot6d: Tensor, first: Tensor, across: Tensor) -> Tensor:
    """Returns (..., 1) bool: whether two vectors (..., 6), of which `_orthogonal` is known, define no rotation.

    Of parallel vectors, rounding alone determines `across`. NaN is not degenerate, so it stays
    NaN.
    """
    length = torch.linalg.vector_norm(rot6d[..., 3:], dim=-1, keepdim=True)
    parallel = (
        torch.linalg.vector_norm(across, dim=-1, keepdim=True)
        <= torch.finfo(rot6d.dtype).eps ** 0.5 * length
    )
    return parallel | _shorter(first) | _shorter(F.normalize(across, dim=-1))


def _shorter(normalized: Tensor) -> Tensor:
    """Returns (..., 1) bool: whether normalized vectors (..., 3) are shorter than 1, because they were about 0."""
    return (
        torch.linalg.vector_norm(normalized, dim=-1, keepdim=True)
        < 1 - torch.finfo(normalized.dtype).eps ** 0.5
    )


def _completed(rot6d: Tensor) -> Tensor:
    """Returns pairs of vectors (..., 6) in which one vector of each pair, or both, is replaced by a basis vector."""
    first, second = F.normalize(rot6d[..., :3], dim=-1), F.normalize(rot6d[..., 3:], dim=-1)
    basis = torch.eye(3, dtype=rot6d.dtype, device=rot6d.device)
    replaced = _shorter(first)
    kept = replaced & ~_shorter(second)
    first = torch.where(replaced, basis[second.abs().argmin(-1)], first)
    second = torch.where(kept, second, basis[first.abs().argmin(-1)])
    return torch.cat([first, second], -1)


def matrix_to_euler(matrix: Tensor, order: str) -> Tensor:
    """Returns Euler angles (..., 3) of matrices (..., 3, 3), the middle one in [-pi/2, pi/2].

    In gimbal lock, the third angle is 0. Raises `UserError` if `order` is not one of XYZ, XZY,
    YXZ, YZX, ZXY, ZYX.
    """
    if sorted(order) != ["X", "Y", "Z"]:
        raise UserError(
            f"Euler order {order!r} is not supported; use the letters X, Y and Z once each, as in 'ZXY'"
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
    """Returns q or -q (..., 4), which are the same rotation, with w >= 0.

    Example:
        >>> standardize(torch.tensor([-1.0, 0.0, 0.0, 0.5])).tolist()
        [1.0, -0.0, -0.0, -0.5]
    """
    return torch.where(quaternion[..., :1] < 0, -quaternion, quaternion)


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product (..., 4): first b, then a."""
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
    """(..., 4) of unit length -> (..., 4)."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], -1)


def rotate(quaternion: Tensor, vector: Tensor) -> Tensor:
    """Rotates vectors (..., 3) by unit quaternions (..., 4); the leading shapes broadcast."""
    xyz, vector = torch.broadcast_tensors(quaternion[..., 1:], vector)
    twice = 2 * torch.linalg.cross(xyz, vector)
    return vector + quaternion[..., :1] * twice + torch.linalg.cross(xyz, twice)


def _scaled(vectors: Tensor) -> Tensor:
    """Returns vectors scaled to largest entry 1, so that squares of tiny ones do not underflow; 0 stays 0."""
    largest = vectors.abs().amax(-1, keepdim=True)
    return vectors / torch.where(largest > 0, largest, 1.0)


def between(a: Tensor, b: Tensor) -> Tensor:
    """Returns the shortest rotation that turns vectors `a` (..., 3) to the directions of `b` (..., 3).

    The quaternions (..., 4) have w >= 0. For opposite directions, the result is a half turn about
    a perpendicular axis; if a vector is 0, the identity.

    Example:
        >>> quarter = between(torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 2.0, 0.0]))
        >>> [round(value, 4) for value in quarter.tolist()]  # 90 degrees about z
        [0.7071, 0.0, 0.0, 0.7071]
    """
    # (|a| |b| + a . b, a x b) is the quaternion of half the angle between a and b, up to its
    # length.
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
    """Returns the rotation at `t` in [0, 1] (number or shape (..., 1)) on the shorter arc from `a` to `b` (..., 4)."""
    dot = (a * b).sum(-1, keepdim=True)
    b = torch.where(dot < 0, -b, b)
    dot = dot.abs()
    angle = torch.atan2(torch.linalg.vector_norm(b - dot * a, dim=-1, keepdim=True), dot)

    def weight(t: Tensor | float) -> Tensor:  # sin(t angle) / sin(angle), exact at angle 0
        return t * torch.sinc(t * angle / torch.pi) / torch.sinc(angle / torch.pi)

    return weight(1 - t) * a + weight(t) * b


def continuous(quaternion: Tensor, dim: int) -> Tensor:
    """Flips signs along the time axis `dim`, so that neighbors are in one hemisphere; the first one is unchanged."""
    q = quaternion.movedim(dim, 0)
    flips = torch.where((q[1:] * q[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(q.dtype)
    return torch.cat([q[:1], q[1:] * flips.cumprod(0)]).movedim(0, dim)


def rotate_y(vector: Tensor, angle: Tensor) -> Tensor:
    """Rotates vectors (..., 3) about the vertical by `angle` (...); positive angles turn +z towards +x, to the left."""
    x, y, z = vector.unbind(-1)
    cosine, sine = torch.cos(angle), torch.sin(angle)
    return torch.stack([cosine * x + sine * z, y.expand_as(cosine * x), cosine * z - sine * x], -1)
