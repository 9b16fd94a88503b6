"""Masked reconstruction error and geometric losses."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from support.analytic import NO_CONDITION, assert_golden, flow_field, motions
from support.fixtures import golden, golden_case, golden_cases, groups, meta
from torch import Tensor

from flame_mdm.batch import length_mask
from flame_mdm.losses import MotionLosses, masked_mean, masked_mse
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching

FIXTURE, FLOW = golden("mdm_losses"), golden("mfm")
# Which losses of MDM's code are which of ours, and their weights. It computes the joints' velocity but never adds it.
OURS = {"rot_mse": "mse", "vel_mse": "velocity", "rcxyz_mse": "joints", "fc": "foot_contact"}
WEIGHTS = {"vel_mse": "lambda_vel", "rcxyz_mse": "lambda_rcxyz", "fc": "lambda_fc"}
SMPL_FEET = [7, 10, 8, 11]
ALL: dict[str, Any] = {"joints": 1.0, "velocity": 1.0, "foot_contact": 1.0, "bone_length": 1.0}
BONES = [(0, 1), (1, 2)]


def joints_as_features(x: Tensor) -> Tensor:
    return x.unflatten(-1, (-1, 3))


@golden_cases("mdm_losses", groups(FIXTURE, "x_t"))
def test_mdm_losses(case):
    data, name = case.split("/")
    lambdas = meta(FIXTURE)["config"]["lambdas"][data][name]
    x, noise = motions(FIXTURE[f"{data}/x_start"]), motions(FIXTURE[f"{data}/noise"])
    mask = torch.from_numpy(FIXTURE[f"{data}/mask"]).flatten(1)
    last_row = FIXTURE[f"{data}/x_start"].shape[2]
    # Some data sets leave terms out
    used = [term for term in WEIGHTS if f"{case}/{term}" in FIXTURE]
    weights: dict[str, Any] = {OURS[term]: lambdas.get(WEIGHTS[term], 0.0) for term in used}
    # A stand-in: joints are linear in the features
    kinematics = torch.from_numpy(FIXTURE[f"{data}/fk"]).to(x)
    to_joints: Callable[[Tensor], Tensor] = lambda x: joints_as_features(x @ kinematics.T)  # noqa: E731
    losses = MotionLosses(to_joints, SMPL_FEET, **weights, velocity_features=x.shape[-1] - last_row)
    process, t = (
        GaussianDiffusion(meta(FIXTURE)["config"]["T"]),
        torch.from_numpy(FIXTURE[f"{data}/t"]).float(),
    )
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append(x_t)
        return motions(FIXTURE[f"{data}/model_output"])

    terms = process.loss(denoise, x, mask, NO_CONDITION, t=t, noise=noise, auxiliary=losses)
    assert_golden(FIXTURE, f"{case}/x_t", seen[0])
    assert_golden(FIXTURE, f"{case}/loss", terms["loss"])
    computed = set(terms) - {"loss"}
    for term, ours in OURS.items():
        # The authors' code computes terms under other conditions. Terms of weight 0 are not computed here.
        weight = 1.0 if term == "rot_mse" else lambdas.get(WEIGHTS[term], 0.0)
        if f"{case}/{term}" in FIXTURE and weight:
            assert_golden(FIXTURE, f"{case}/{term}", terms[ours] / weight)
            computed.remove(ours)
    assert computed == set()


@golden_case("mfm")
def test_velocity_loss_of_mfm(stem):
    """Its code compares velocities of the flow as if they were motions; the formula is MDM's."""
    process, t = FlowMatching(meta(FLOW)["sigma_min"]), torch.from_numpy(FLOW["loss/t"])
    x, noise = motions(FLOW["loss/x_start"]), motions(FLOW["loss/noise"])
    mask = torch.from_numpy(FLOW["in/mask"]).flatten(1)
    output = flow_field(FLOW)(process.corrupt(x, noise, t), 1000 * t, mask, NO_CONDITION)
    size = x.shape[-1] - FLOW["loss/x_start"].shape[2]
    losses = MotionLosses(joints_as_features, [], velocity=1.0, velocity_features=size)
    velocity = losses(output, process.target(x, noise, t), mask)["velocity"]
    assert_golden(FLOW, "loss/field_vel/vel_mse", velocity)


def test_masked_mse_is_the_mean_over_real_frames():
    torch.manual_seed(0)
    (a, b), lengths = torch.randn(2, 3, 5, 4), [5, 2, 0]
    mask = length_mask(torch.tensor(lengths), 5)
    expected = [
        ((a[i, :n] - b[i, :n]) ** 2).mean().item() if n else 0.0 for i, n in enumerate(lengths)
    ]
    torch.testing.assert_close(masked_mse(a, b, mask), torch.tensor(expected))
    torch.testing.assert_close(
        masked_mse(a.unflatten(2, (2, 2)), b.unflatten(2, (2, 2)), mask), torch.tensor(expected)
    )


def test_equal_motions_lose_nothing_but_sliding_feet(subtests):
    """One foot stands and slides in the estimate, the other moves in the data and is free to."""
    x, mask, time = torch.zeros(1, 4, 9), torch.ones(1, 4, dtype=torch.bool), torch.arange(4.0)
    x[..., 6] = time
    losses = MotionLosses(joints_as_features, [1, 2], BONES, **ALL)
    assert all(loss == 0 for loss in losses(x, x, mask).values())
    slid = x.clone()
    slid[..., 3] = 0.3 * time
    terms = losses(slid, x, mask)
    # Means over 3 frames x 2 feet x 3 coordinates, 3 x 3 joints x 3, and 4 x 3 x 3.
    assert terms["foot_contact"].item() == pytest.approx(0.3**2 / 6)
    assert terms["velocity"].item() == pytest.approx(0.3**2 / 9)
    assert terms["joints"].item() == pytest.approx(0.09 * (0 + 1 + 4 + 9) / (4 * 9))
    assert losses(2 * x, x, mask)["foot_contact"] == 0
    # 1 cm per frame in the data is standing, also along a diagonal, and 1.01 cm is not.
    pairs, foot = (
        torch.ones(1, 2, dtype=torch.bool),
        MotionLosses(joints_as_features, [2], foot_contact=1.0),
    )
    for step, stands in (
        ((0.01, 0.0, 0.0), True),
        ((0.0, 0.0, 0.0101), False),
        ((0.0057, 0.0057, 0.0057), True),
        ((0.0058, 0.0058, 0.0058), False),
    ):
        with subtests.test(step=step):
            moved = torch.zeros(1, 2, 9)
            moved[0, 1, 6:] = torch.tensor(step)
            assert (foot(moved, moved, pairs)["foot_contact"] > 0) == stands


def test_bones_lose_their_change_of_length_and_not_their_turns():
    """Bones of 1 m and 2 m are turned in the estimate; in one frame, the second is 0.3 m too long."""
    points = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 2, 0]])
    turned = points @ torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) + 5
    x, x0_hat = (joints.flatten().repeat(1, 4, 1) for joints in (points, turned))
    losses, mask = (
        MotionLosses(joints_as_features, [], BONES, bone_length=2.0),
        torch.ones(1, 4, dtype=torch.bool),
    )
    assert losses(x0_hat, x, mask)["bone_length"].item() == pytest.approx(0, abs=1e-10)
    x0_hat[0, 1, 7] += 0.3
    assert losses(x0_hat, x, mask)["bone_length"].item() == pytest.approx(
        2 * 0.3**2 / (4 * 2), rel=1e-5
    )


def test_padding_has_no_loss_and_no_gradient_and_single_frames_have_no_velocity(subtests):
    torch.manual_seed(0)
    losses = MotionLosses(joints_as_features, [0], BONES, **ALL)
    a, b = torch.randn(2, 3, 6, 9).unbind()
    mask = length_mask(torch.tensor([6, 3, 1]))
    spoiled = torch.where(mask[..., None], a, 1e6), torch.where(mask[..., None], b, -1e6)
    for name, loss in losses(a, b, mask).items():
        with subtests.test(name=name):
            torch.testing.assert_close(losses(*spoiled, mask)[name], loss)
            assert loss.isfinite().all()
            alone = losses(a[1:2, :3], b[1:2, :3], mask[1:2, :3])[name]
            torch.testing.assert_close(loss[1:2], alone)
    assert losses(a, b, mask)["velocity"][2] == 0
    a.requires_grad_()
    still = 0.001 * b  # so that all feet are in contact
    torch.stack(list(losses(a, still, mask).values())).sum().backward()
    assert a.grad is not None
    assert torch.equal((a.grad != 0).all(-1), mask)
    assert torch.equal((a.grad != 0).any(-1), mask)


def test_only_what_weighs_is_computed():
    def unused(x: Tensor) -> Tensor:
        raise AssertionError("forward kinematics of a loss without weight")

    x, mask = torch.randn(1, 4, 9), torch.ones(1, 4, dtype=torch.bool)
    assert MotionLosses(unused, [0])(x, x, mask) == {}
    assert set(MotionLosses(unused, [0], velocity=2.0)(x, x, mask)) == {"velocity"}
    assert MotionLosses(joints_as_features, [0], joints=2.0)(x + 1, x, mask)[
        "joints"
    ].item() == pytest.approx(2)
    moved = x + torch.randn(1, 4, 3).repeat(1, 1, 3)
    assert (
        MotionLosses(joints_as_features, [1], joints=1.0, root_relative=True)(moved, x, mask)[
            "joints"
        ]
        < 1e-10
    )


def test_all_losses_of_joints_are_relative_to_the_root_if_requested():
    """The foot moves with the root in the data, so that it counts as in contact."""
    x, mask, time = torch.zeros(1, 4, 9), torch.ones(1, 4, dtype=torch.bool), torch.arange(4.0)
    x[0, :, [0, 3]] = 0.5 * time[:, None]
    x0_hat = x.clone()
    x0_hat[0, :, 3] += 0.3 * time
    relative, absolute = (
        MotionLosses(joints_as_features, [1], joints=1.0, foot_contact=1.0, root_relative=flag)(
            x0_hat, x, mask
        )
        for flag in (True, False)
    )
    assert relative["foot_contact"].item() == pytest.approx(0.3**2 / 3)
    assert absolute["foot_contact"] == 0
    torch.testing.assert_close(relative["joints"], absolute["joints"])


def test_losses_can_be_computed_in_a_validation_before_the_training():
    losses = MotionLosses(
        lambda x: x.unflatten(-1, (-1, 3)), [1], [(0, 1)], foot_contact=1.0, bone_length=1.0
    )
    x, mask = torch.randn(2, 5, 6), torch.ones(2, 5, dtype=torch.bool)
    with torch.inference_mode():
        expected = losses(x + 1, x, mask)
    x0_hat = (x + 1).requires_grad_()
    terms = losses(x0_hat, x, mask)
    torch.testing.assert_close(terms, expected)
    torch.stack(list(terms.values())).sum().backward()
    assert x0_hat.grad is not None


@pytest.mark.parametrize("shape", [(3, 7, 5), (3, 7, 4, 3)])
def test_the_squared_error_and_its_gradients_are_those_of_its_definition_bit_for_bit(shape):
    a, b = torch.randn(2, *shape).unbind(0)
    mask, factor = torch.arange(7) < torch.tensor([[7], [4], [0]]), torch.randn(3)
    inputs = [a.requires_grad_(), b.requires_grad_()]
    results = [masked_mse(a, b, mask), masked_mean((a - b).square(), mask)]
    assert torch.equal(*results)
    gradients = [torch.autograd.grad((result * factor).sum(), inputs) for result in results]
    assert all(torch.equal(*pair) for pair in zip(*gradients, strict=True))
