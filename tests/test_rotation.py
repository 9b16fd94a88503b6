import itertools

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from support.analytic import euler_to_matrix
from support.fixtures import golden, golden_case, tensors
from torch import Tensor
from torch.nn import functional

from flame_mdm.representations import rotation

ORDERS = ("XYZ", "YXZ", "ZXY", "ZYX", "XZY", "YZX")
finite = st.floats(-4, 4, width=32)
vectors = st.tuples(finite, finite, finite).map(lambda v: torch.tensor(v, dtype=torch.float64))


def same(actual: Tensor, expected: Tensor, atol: float) -> None:
    torch.testing.assert_close(actual, expected, atol=atol, rtol=0)


def same_rotation(actual: Tensor, expected: Tensor, atol: float) -> None:
    same(actual * (actual * expected).sum(-1, keepdim=True).sign(), expected, atol)


@golden_case("smpl147")
def test_conversions_are_the_authors(stem: str, subtests):
    file = tensors(golden(stem))
    for dtype in (torch.float32, torch.float64):
        with subtests.test(dtype=dtype):
            axis_angle = file["conv/axis_angle"].to(dtype)
            quaternion = rotation.axis_angle_to_quaternion(axis_angle)
            matrix = rotation.axis_angle_to_matrix(axis_angle)
            assert matrix.dtype == dtype
            same(quaternion.float(), file["conv/quat_p3d"], 2e-6)
            same(matrix.float(), file["conv/matrix"], 2e-6)
            same(rotation.matrix_to_rot6d(matrix, "rows").float(), file["conv/rot6d_rows"], 2e-6)
            same(rotation.matrix_to_rot6d(matrix, "columns").float(), file["conv/rot6d_cols"], 2e-6)
            actual = rotation.quaternion_to_matrix(rotation.matrix_to_quaternion(matrix))
            # The variant with copysign loses digits near a half turn.
            for key, atol in (
                ("p3d072", 2e-6),
                ("p3dhead", 2e-6),
                ("copysign", 2e-3),
            ):
                expected = rotation.quaternion_to_matrix(file[f"conv/quat_from_matrix_{key}"]).to(
                    dtype
                )
                same(actual, expected, atol)
            back = rotation.matrix_to_axis_angle(matrix)
            assert back.norm(dim=-1).max() <= torch.pi + 1e-6
            same(rotation.axis_angle_to_matrix(back), matrix, 2e-6)
    # 6D vectors that are not orthonormal
    noisy = file["conv/noisy6"]
    same(rotation.rot6d_to_matrix(noisy, "rows"), file["conv/noisy6_to_matrix_rows"], 1e-5)
    same(rotation.rot6d_to_matrix(noisy, "columns"), file["conv/noisy6_to_matrix_cols"], 1e-5)
    quaternion = rotation.matrix_to_quaternion(rotation.rot6d_to_matrix(noisy.double(), "columns"))
    same_rotation(quaternion.float(), file["conv/cont6d_to_quat"], 1e-5)


@golden_case("smpl147")
def test_quaternion_algebra_and_euler_angles_are_the_authors(stem: str):
    file = tensors(golden(stem))
    a, b, v, w = (file[f"hmlq/{name}"] for name in ("qa", "qb", "v", "w"))
    same(rotation.multiply(a, b), file["hmlq/qmul"], 2e-6)
    same(rotation.inverse(a), file["hmlq/qinv"], 0)
    same(rotation.rotate(a, v), file["hmlq/qrot"], 4e-6)
    same(rotation.between(v, w), file["hmlq/qbetween"], 2e-6)
    same(rotation.quaternion_to_matrix(a), file["hmlq/to_matrix"], 2e-6)
    same(
        rotation.matrix_to_rot6d(rotation.quaternion_to_matrix(a), "columns"),
        file["hmlq/cont6d"],
        2e-6,
    )
    same(rotation.continuous(file["hmlq/qfix_in"], 0), file["hmlq/qfix_out"], 0)
    # Euler angles
    angles = file["hmlq/euler_xyz_rad"].double()
    for order in ("xyz", "yxz"):
        matrix = euler_to_matrix(angles[:, ["xyz".index(axis) for axis in order]], order.upper())
        same_rotation(
            rotation.matrix_to_quaternion(matrix).float(),
            file[f"hmlq/quat_from_euler_{order}"],
            2e-6,
        )
    for order in ("XYZ", "YXZ", "ZXY", "ZYX"):
        matrix = euler_to_matrix(file["euler/angles"], order)
        same(matrix, file[f"euler/{order}_matrix"], 2e-6)
        same(rotation.matrix_to_euler(matrix, order), file[f"euler/{order}_back"], 1e-4)


def test_euler_angles_in_gimbal_lock_and_of_unknown_orders(subtests):
    for order, sign in itertools.product(ORDERS, (1, -1)):
        with subtests.test(order=order, sign=sign):
            matrix = euler_to_matrix(
                torch.tensor([0.4, sign * torch.pi / 2, -1.1], dtype=torch.float64), order
            )
            back = rotation.matrix_to_euler(matrix, order)
            assert back[2] == 0
            same(euler_to_matrix(back, order), matrix, 1e-7)
    with pytest.raises(ValueError, match="'XYX'"):
        rotation.matrix_to_euler(torch.eye(3), "XYX")


@pytest.mark.slow
@given(axis_angle=vectors)
@settings(max_examples=30)
def test_round_trips(axis_angle: Tensor):
    matrix = rotation.axis_angle_to_matrix(axis_angle)
    same(matrix @ matrix.mT, torch.eye(3, dtype=torch.float64), 1e-12)
    assert torch.linalg.det(matrix) == pytest.approx(1)
    same(rotation.quaternion_to_matrix(rotation.matrix_to_quaternion(matrix)), matrix, 1e-12)
    same(rotation.axis_angle_to_matrix(rotation.matrix_to_axis_angle(matrix)), matrix, 1e-7)
    for convention in ("rows", "columns"):
        same(
            rotation.rot6d_to_matrix(rotation.matrix_to_rot6d(matrix, convention), convention),
            matrix,
            1e-12,
        )
    same(
        rotation.matrix_to_rot6d(matrix, "rows"), rotation.matrix_to_rot6d(matrix.mT, "columns"), 0
    )
    if axis_angle.norm() < 3.1:
        same(
            rotation.quaternion_to_axis_angle(rotation.axis_angle_to_quaternion(axis_angle)),
            axis_angle,
            1e-12,
        )


def test_opposite_directions_and_small_angles_have_finite_and_right_gradients(subtests):
    directions = ([1.0, 0, 0], [0, -1.0, 0], [0, 0, 1.0], [0.6, 0.0, -0.8])
    for direction, tilt in itertools.product(directions, (0.0, 1e-12, 1e-9, 1e-7, 1e-4)):
        with subtests.test(direction=direction, tilt=tilt):
            start = torch.tensor(direction, dtype=torch.float64, requires_grad=True)
            end = -start.detach() + tilt * torch.tensor([0.3, 0.4, 0.5], dtype=torch.float64)
            quaternion = rotation.between(start, end)
            same(rotation.rotate(quaternion, start).detach(), end / end.norm(), 1e-7)
            quaternion.sum().backward()
            assert start.grad is not None
            assert start.grad.isfinite().all()

    def through_everything(axis_angle: Tensor) -> Tensor:
        return rotation.matrix_to_rot6d(rotation.axis_angle_to_matrix(axis_angle), "columns")

    for angle in (0.0, 1e-9, 1e-5, 1.0, np.pi):
        with subtests.test(angle=angle):
            axis_angle = torch.tensor([[angle, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
            assert torch.autograd.gradcheck(through_everything, axis_angle)
            back = rotation.matrix_to_axis_angle(rotation.axis_angle_to_matrix(axis_angle))
            (gradient,) = torch.autograd.grad(back.sum(), axis_angle)
            assert gradient.isfinite().all()
            if angle < 3:
                assert gradient[0, 0].item() == pytest.approx(1)


def gram_schmidt(rot6d: Tensor) -> Tensor:
    first, second = functional.normalize(rot6d[..., :3], dim=-1), rot6d[..., 3:]
    second = functional.normalize(second - (first * second).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], -2)


def degenerate_pairs() -> Tensor:
    """Pairs of vectors (N, 6) that define no rotation: parallel, opposite, 0, tiny, or all but parallel."""
    generator = torch.Generator().manual_seed(0)
    vector, other = torch.randn(2, 50, 3, generator=generator)
    signs = vector.sign()
    pairs = [(vector, factor * vector) for factor in (1, -1, 3.3, -0.01)]
    pairs += [
        (signs, signs),
        (signs, -signs),
        (0 * vector, vector),
        (vector, 0 * vector),
        (0 * vector, 0 * vector),
    ]
    pairs += [(1e-13 * vector, other), (vector, 1e-13 * other), (1e-30 * vector, 1e-30 * other)]
    pairs += [(vector, vector + tilt * other) for tilt in (1e-7, 1e-6, 1e-5)]
    return torch.cat([torch.cat(pair, -1) for pair in pairs])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("convention", ["rows", "columns"])
def test_vectors_that_define_no_rotation_are_completed(
    convention: rotation.SixD, dtype: torch.dtype
):
    rot6d = degenerate_pairs().to(dtype).requires_grad_()
    matrix = rotation.rot6d_to_matrix(rot6d, convention)
    atol = 3 * torch.finfo(dtype).eps ** 0.5
    same(matrix @ matrix.mT, torch.eye(3, dtype=dtype).expand_as(matrix), atol)
    same(torch.linalg.det(matrix), torch.ones(len(matrix), dtype=dtype), atol)
    same(matrix, rotation.rot6d_to_matrix(rot6d, convention), 0)
    (gradient,) = torch.autograd.grad(matrix.square().sum() + matrix.sum(), rot6d)
    assert gradient.isfinite().all()
    # vectors that have a direction keep it
    first = matrix[:, 0] if convention == "rows" else matrix[..., 0]
    has_direction = rot6d[:, :3].norm(dim=-1) > 1e-6
    same(first[has_direction], functional.normalize(rot6d[has_direction, :3], dim=-1), atol)
    same(
        rotation.rot6d_to_matrix(torch.zeros(6, dtype=dtype), convention),
        torch.eye(3, dtype=dtype),
        0,
    )
    assert (
        rotation.rot6d_to_matrix(torch.full((6,), torch.nan, dtype=dtype), convention).isnan().all()
    )


def test_vectors_beside_degenerate_ones_keep_every_bit_of_value_and_gradient(subtests):
    generator = torch.Generator().manual_seed(1)
    ordinary = torch.randn(len(degenerate_pairs()), 6, generator=generator)
    weights = torch.randn(len(ordinary), 3, 3, generator=generator)
    for others in (ordinary, degenerate_pairs()):
        with subtests.test(others=others):
            rot6d = torch.stack([ordinary, others], 1).requires_grad_()
            matrix = rotation.rot6d_to_matrix(rot6d, "rows")[:, 0]
            alone = ordinary.clone().requires_grad_()
            expected = gram_schmidt(alone)
            assert torch.equal(matrix, expected)
            (gradient,) = torch.autograd.grad((weights * matrix).sum(), rot6d)
            (expected_gradient,) = torch.autograd.grad((weights * expected).sum(), alone)
            assert torch.equal(gradient[:, 0], expected_gradient)


def test_exported_graphs_and_vmap_complete_vectors_too():
    class Decoder(torch.nn.Module):
        def forward(self, rot6d: Tensor) -> Tensor:
            return rotation.rot6d_to_matrix(rot6d, "rows")

    pairs = degenerate_pairs()
    ordinary = torch.randn(pairs.shape, generator=torch.Generator().manual_seed(2))
    graph = torch.export.export(Decoder(), (ordinary,)).module()
    for rot6d in (ordinary, pairs):
        expected = rotation.rot6d_to_matrix(rot6d, "rows")
        same(graph(rot6d), expected, 0)
        same(torch.func.vmap(Decoder())(rot6d), expected, 0)


def test_slerp_takes_the_shorter_way():
    q = torch.randn(2, 50, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    a, b = torch.nn.functional.normalize(q, dim=-1)
    same(rotation.slerp(a, b, 0.0), a, 1e-12)
    same_rotation(rotation.slerp(a, b, 1.0), b, 1e-12)
    same(rotation.slerp(a, a, 0.3), a, 1e-12)
    half = rotation.slerp(a, b, 0.5)
    same_rotation(rotation.slerp(a, half, 0.5), rotation.slerp(a, b, 0.25), 1e-12)
    assert ((a * half).sum(-1) >= 0.5**0.5 - 1e-9).all(), "the longer way round"
    steps = torch.linspace(0, 1, 5, dtype=a.dtype)[:, None, None]
    same(rotation.slerp(a, b, steps)[2], half, 1e-12)


@pytest.mark.parametrize("dim", [0, 1, -2])
def test_neighboring_quaternions_of_any_time_axis_share_a_hemisphere(dim: int):
    generator = torch.Generator().manual_seed(0)
    angles = torch.linspace(0, 20, 40, dtype=torch.float64)[:, None] + torch.arange(3)
    turns = functional.pad(angles[..., None], (1, 1))
    signs = torch.randn(40, 3, 1, generator=generator, dtype=torch.float64).sign()
    q = (signs * rotation.axis_angle_to_quaternion(turns)).movedim(0, dim)
    smooth = rotation.continuous(q, dim)
    same_rotation(smooth, q, 0)
    in_time, before = smooth.movedim(dim, 0), q.movedim(dim, 0)
    same(in_time[0], before[0], 0)
    assert ((in_time[1:] * in_time[:-1]).sum(-1) > 0).all()
