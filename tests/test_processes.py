"""Schedules, the two processes, their losses, the steps they train on, and classifier-free guidance."""

import math
from functools import partial
from inspect import signature
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from support.analytic import (
    NO_CONDITION,
    CountedDenoise,
    assert_golden,
    flow_field,
    linear_denoiser,
    motions,
    real,
    spaced,
)
from support.fixtures import ROOT, golden, golden_case, golden_cases, meta
from torch import Tensor

from flame_mdm.batch import Condition, Edit, length_mask
from flame_mdm.config import check
from flame_mdm.errors import UserError
from flame_mdm.losses import MotionLosses, masked_mean, masked_mse
from flame_mdm.processes import Process
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.guidance import (
    Positions,
    classifier_free_guidance,
    steer,
)
from flame_mdm.processes.schedules import build_schedule, timesteps
from flame_mdm.safe_io import read_package_yaml, read_yaml

GAUSSIAN, MFM = golden("gaussian"), golden("mfm")
T: int = meta(GAUSSIAN)["options"]["T"]
# Tables that the authors' code names otherwise.
TABLES: dict[str, str] = {
    "posterior_log_variance_clipped": "posterior_log_variance",
    "posterior_mean_coef1": "posterior_x0",
    "posterior_mean_coef2": "posterior_x_t",
    "sqrt_alphas_cumprod": "signal",
    "sqrt_one_minus_alphas_cumprod": "noise",
}
DTYPES = [torch.float32, torch.float64]
LEARNED: dict[str, Any] = {"prediction": "epsilon", "variance": "learned_range"}
POINTWISE: dict[str, dict[str, Any]] = {
    **{"startx_fixedsmall_clip0": {}, "startx_fixedsmall_clip1": {"clip_x0": True}},
    **{"startx_fixedlarge": {"variance": "fixed_large"}},
    **{"eps_learnedrange_clip0": LEARNED, "eps_learnedrange_clip1": LEARNED | {"clip_x0": True}},
}
"""Options of the point-wise cases, by what the fixture calls them."""


@golden_case("gaussian")
def test_schedules_sampling_steps_and_their_betas(stem, subtests):
    for key in (key for key in GAUSSIAN if key.startswith("sched/")):
        with subtests.test(key=key):
            _, case, table = key.split("/")
            name, total = case.split("_T")
            tables = build_schedule(name, int(total)).tables
            tables["sqrt_recip_alphas_cumprod"] = 1 / tables["signal"]
            tables["sqrt_recipm1_alphas_cumprod"] = tables["noise"] / tables["signal"]
            value = tables[TABLES.get(table, table)]
            np.testing.assert_allclose(value.numpy(), GAUSSIAN[key], rtol=1e-9, err_msg=key)
    for key in (key for key in GAUSSIAN if key.startswith("respace/")):
        with subtests.test(key=key):
            total, spec = key.removeprefix("respace/T").split("/")
            steps = spaced(int(total), spec)
            assert steps == GAUSSIAN[key].tolist(), key
            betas = build_schedule("cosine", int(total)).respace(steps).tables["betas"]
            expected = GAUSSIAN[key.replace("respace/", "respace_betas/")]
            np.testing.assert_allclose(betas.numpy(), expected, rtol=1e-9, err_msg=key)


def test_the_linear_schedule_has_the_ends_of_ho_et_al(subtests):
    for total, first, last in ((1000, 1e-4, 0.02), (500, 2e-4, 0.04), (10, 0.01, 0.999)):
        with subtests.test(total=total, first=first, last=last):
            betas = build_schedule("linear", total).numbers["betas"]
            assert (betas[0], betas[-1]) == pytest.approx((first, last))


@pytest.mark.parametrize("total", [10, 50, 1000])
def test_more_noise_scales_the_ratio_of_noise_to_signal_at_each_step(total: int):
    """The last step of the cosine schedule is clipped, so that it is left out."""
    plain, noisy = build_schedule("cosine", total), build_schedule("cosine", total, 4.0)
    ratios = [schedule.tables["noise"] / schedule.tables["signal"] for schedule in (plain, noisy)]
    np.testing.assert_allclose(ratios[1][:-1], 4 * ratios[0][:-1], rtol=1e-9)
    assert len(noisy) == total
    assert noisy.tables["betas"].max() <= 0.999


def pointwise_output(x_t: Tensor, learned: bool) -> Tensor:
    A, b = (GAUSSIAN[f"lin4/{name}2" if learned else f"lin4/{name}"] for name in "Ab")
    t = torch.tensor(GAUSSIAN["pw/t"]).float()
    return linear_denoiser(A, b, float(GAUSSIAN["lin4/g"]))(x_t, t, real(x_t), NO_CONDITION)


@pytest.mark.parametrize("dtype", DTYPES, ids=["f32", "f64"])
@golden_cases("gaussian", POINTWISE)
def test_reverse_step(case, dtype):
    process, t = GaussianDiffusion(T, **POINTWISE[case]), torch.tensor(GAUSSIAN["pw/t"])
    x_t = motions(GAUSSIAN["f64/pw/x_t" if dtype == torch.float64 else "pw/x_t"], dtype)
    output = pointwise_output(x_t, "learned" in case)
    x0_hat = process.to_x0(output, x_t, t)
    if process.clip_x0:
        x0_hat = x0_hat.clamp(-1, 1)
    log_variance = torch.as_tensor(
        process.log_variance(output, x_t, t, process.schedule)
    ).expand_as(x_t)
    assert_golden(GAUSSIAN, f"pw/{case}/pred_xstart", x0_hat)
    assert_golden(GAUSSIAN, f"pw/{case}/log_variance", log_variance)
    if process.variance == "fixed_small":  # not clipped at step 0, unlike its logarithm
        variance = process.schedule.at("posterior_variance", t, x_t).expand_as(x_t)
    else:
        variance = log_variance.exp()
    assert_golden(GAUSSIAN, f"pw/{case}/variance", variance)
    assert_golden(GAUSSIAN, f"pw/{case}/mean", process.schedule.posterior_mean(x0_hat, x_t, t))


@pytest.mark.parametrize("dtype", DTYPES, ids=["f32", "f64"])
@golden_cases("gaussian", ["guided_bits", "flame_nats"])
def test_corruption_posterior_and_variational_bound(case, dtype):
    process = GaussianDiffusion(T, **LEARNED)
    x, noise = motions(GAUSSIAN["pw/x0"], dtype), motions(GAUSSIAN["pw/noise"], dtype)
    mask, t = real(x), torch.tensor(GAUSSIAN["pw/t"]).float()
    x_t = process.corrupt(x, noise, t)
    assert_golden(GAUSSIAN, "pw/x_t", x_t)
    assert_golden(GAUSSIAN, "pw/q_posterior_mean", process.schedule.posterior_mean(x, x_t, t))
    key, arrays = f"pw/vb_{case}", GAUSSIAN
    # guided-diffusion computes bits and, at step 0, the likelihood of a pixel. Neither is for
    # motion.
    if "guided" in case:
        output, later = pointwise_output(x_t, learned=True), t > 0
        bound = masked_mean(process.vlb(output, x, x_t, t), mask)[later] / math.log(2)
        arrays = GAUSSIAN | {name: GAUSSIAN[name][later.numpy()] for name in (key, f"f64/{key}")}
    else:  # FLAME's code has one channel per joint: the bias of channel 0 for all.
        A, b = (
            GAUSSIAN["lin4/A2"],
            np.repeat(GAUSSIAN["lin4/b2"][:, :1], GAUSSIAN["lin4/b2"].shape[1], 1),
        )
        output = linear_denoiser(A, b, float(GAUSSIAN["lin4/g"]))(x_t, t, mask, NO_CONDITION)
        bound = masked_mean(process.vlb(output, x, x_t, t), mask)
    assert_golden(arrays, key, bound)


RECIPES = sorted((ROOT / "experiments" / "process").glob("*.yaml"))
PROCESSES: dict[str, Process] = {
    **{path.stem: instantiate(read_package_yaml(path)) for path in RECIPES},
    "x0": GaussianDiffusion(prediction="x0"),
    "epsilon": GaussianDiffusion(prediction="epsilon"),
    "skip": GaussianDiffusion(
        prediction="epsilon", variance="learned_range", skip=True, min_snr=5.0
    ),
    "velocity": GaussianDiffusion(prediction="velocity", schedule="linear"),
    "learned": GaussianDiffusion(
        num_train_timesteps=50, prediction="epsilon", variance="learned_range"
    ),
    "flow": FlowMatching(),
    "flow_sigma": FlowMatching(sigma_min=0.1),
    "flow_x0": FlowMatching(prediction="x0"),
}


@pytest.mark.parametrize("name", PROCESSES)
def test_oracle_has_no_loss_and_padding_has_no_say(name):
    torch.manual_seed(0)
    process, mask = PROCESSES[name], length_mask(torch.tensor([7, 4, 1]))
    x, noise = torch.randn(2, 3, 7, 5)
    x = x * mask[..., None]
    t, exact = process.training_times(torch.tensor([0.0, 0.31, 0.94])), (x.double(), noise.double())
    spare = process.out_features(5) - 5
    target, x_t = process.target(*exact, t.double()), process.corrupt(*exact, t)
    torch.testing.assert_close(process.to_x0(target, x_t, t.double()), exact[0], rtol=0, atol=1e-7)

    def oracle(x_t, time, mask, cond):
        target = process.target(x, noise, t)
        assert (time >= 0).all()
        assert (time < 1000).all()
        # Losses over the padded length see the padding, where such a process needs a denoiser that returns 0.
        garbage = torch.where(mask[..., None], target, 0.0 if process.average_padding else 1e3)
        return torch.cat([garbage, torch.zeros(*garbage.shape[:2], spare)], -1)

    def auxiliary(x0_hat, clean, mask):
        return {"extra": 0.25 + masked_mse(x0_hat, clean, mask)}

    quiet = torch.where(mask[..., None], noise, 0.0)
    terms, other = (
        process.loss(oracle, x, mask, NO_CONDITION, t=t, noise=n, auxiliary=auxiliary)
        for n in (noise, quiet)
    )
    assert set(terms) == {"mse", "extra", "loss"} | ({"vlb"} if spare else set())
    torch.testing.assert_close(terms["mse"], torch.zeros(3))
    torch.testing.assert_close(terms["extra"], torch.full((3,), 0.25), rtol=0, atol=1e-2)
    torch.testing.assert_close(
        terms["loss"], sum(value for key, value in terms.items() if key != "loss")
    )
    torch.testing.assert_close(other["loss"], terms["loss"])


@pytest.mark.parametrize("average_padding", [False, True])
def test_auxiliary_losses_are_averaged_over_real_frames_in_every_process(average_padding):
    process = GaussianDiffusion(50)
    process.average_padding = average_padding
    lengths = torch.tensor([7, 4, 1])
    received = []

    def auxiliary(x0_hat, clean, mask):
        received.append(mask)
        return {}

    x = torch.randn(3, 7, 5) * length_mask(lengths)[..., None]
    process.loss(
        lambda x_t, time, mask, cond: x_t,
        x,
        length_mask(lengths),
        NO_CONDITION,
        t=torch.tensor([3, 20, 40]),
        noise=torch.randn(3, 7, 5),
        auxiliary=auxiliary,
    )
    assert [mask.sum(1).tolist() for mask in received] == [[7, 4, 1]]


@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
def test_min_snr_weighs_an_error_of_the_clean_motion_alike_in_every_prediction(prediction):
    """Hang et al. 2023, arXiv:2303.09556: the weight of the squared error of the clean motion is min(SNR, 5)."""
    process = GaussianDiffusion(50, prediction=prediction, min_snr=5.0)
    t = torch.tensor([2, 10, 25, 40, 45])
    x, noise, mask = (
        torch.randn(5, 4, 3).double(),
        torch.randn(5, 4, 3).double(),
        torch.ones(5, 4, dtype=torch.bool),
    )
    x_t = process.corrupt(x, noise, t)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    signal, sigma = process.corrupt(one, zero, t), process.corrupt(zero, one, t)
    estimate = x + 0.1
    output = process.target(estimate, (x_t - signal * estimate) / sigma, t)
    expected = 0.01 * ((signal / sigma)[:, 0, 0] ** 2).clamp(max=5)
    torch.testing.assert_close(process.terms(output, x, noise, x_t, t, mask)["mse"], expected)


def test_weights_of_the_error_and_the_skip_are_those_of_the_noise(subtests):
    """At T = 1000 and step 900, SNR < 1: the error of the noise counts 1, and min(SNR, 5) / SNR at step 10."""
    torch.manual_seed(0)
    (x, noise, wrong), t = torch.randn(3, 2, 4, 3), torch.tensor([10.0, 900.0])
    plain = GaussianDiffusion(prediction="epsilon", min_snr=5.0)
    signal, sigma = (plain.schedule.at(name, t, x) for name in ("signal", "noise"))
    terms = plain.loss(lambda *_: noise + wrong, x, real(x), NO_CONDITION, t=t, noise=noise)
    weight = torch.tensor([5 * (sigma[0] / signal[0]).square().item(), 1.0])
    torch.testing.assert_close(terms["mse"], weight * wrong.square().mean((1, 2)))
    skip = GaussianDiffusion(prediction="epsilon", min_snr=5.0, skip=True)
    output = (noise + wrong - sigma * skip.corrupt(x, noise, t)) / signal
    for name, term in skip.loss(
        lambda *_: output, x, real(x), NO_CONDITION, t=t, noise=noise
    ).items():
        with subtests.test(name=name):
            torch.testing.assert_close(term, terms[name], rtol=1e-4, atol=0)


def test_hybrid_loss_trains_the_variance_alone():
    torch.manual_seed(0)
    process = GaussianDiffusion(
        400, prediction="epsilon", variance="learned_range", vlb_weight=0.002
    )
    (x, noise), t, output = (
        torch.randn(2, 2, 6, 3),
        torch.tensor([0.0, 200.0]),
        torch.randn(2, 6, 6, requires_grad=True),
    )
    terms = process.loss(lambda *_: output, x, real(x), NO_CONDITION, t=t, noise=noise)
    bound = process.vlb(output, x, process.corrupt(x, noise, t), t)
    torch.testing.assert_close(terms["vlb"], 0.002 * 400 * bound.mean((1, 2)))
    terms["vlb"].sum().backward()
    assert output.grad is not None
    assert (output.grad[..., :3] == 0).all()
    assert (output.grad[..., 3:] != 0).all()


def test_unknown_options_and_impossible_steps_are_refused(subtests):
    cases: list[tuple[Any, str]] = [
        (lambda: GaussianDiffusion(num_train_timesteps=1), "1"),
        (lambda: GaussianDiffusion(skip=True), "epsilon"),
        (lambda: GaussianDiffusion(min_snr=-1.0), "min_snr=-1.0"),
        (lambda: GaussianDiffusion(noise_scale=0.0), "noise_scale=0.0"),
        (lambda: FlowMatching(sigma_min=1.0), "1.0"),
        (lambda: timesteps(1000, 0), "expected 1 to"),
        (lambda: timesteps(1000, 1001), "expected 1 to"),
        (lambda: timesteps(1000, 400, "stride"), "Choose another number"),
    ]
    for path, name in product(RECIPES, ("schedule", "prediction", "variance")):
        config = read_yaml(path)
        if name in config:
            wrong = {"process": config | {name: "other"}}
            cases.append((partial(check, wrong), rf"process\.{name}=other: must be one of "))
    for call, message in cases:
        with subtests.test(message=message), pytest.raises(UserError, match=message):
            call()


def test_tables_keep_their_precision_when_the_model_is_cast():
    process = GaussianDiffusion(prediction="epsilon").to(torch.bfloat16)
    x, t = torch.ones(1, 1, 1), torch.tensor([999.0])
    assert process.corrupt(x, 0 * x, t).item() == pytest.approx(
        process.schedule.tables["signal"][-1].item(), rel=1e-6
    )
    assert process.corrupt(x.bfloat16(), 0 * x.bfloat16(), t).dtype == torch.float32


@pytest.mark.golden
@pytest.mark.parametrize("dtype", DTYPES, ids=["mfm-f32", "mfm-f64"])
def test_flow_path_target_and_loss(dtype):
    process = FlowMatching(sigma_min=meta(MFM)["sigma_min"])
    x, noise = motions(MFM["loss/x_start"], dtype), motions(MFM["loss/noise"], dtype)
    t, mask = torch.from_numpy(MFM["loss/t"]).to(dtype), torch.from_numpy(MFM["in/mask"]).flatten(1)
    assert_golden(MFM, "loss/x_t", process.corrupt(x, noise, t))
    assert_golden(MFM, "loss/target", process.target(x, noise, t))
    terms = process.loss(flow_field(MFM), x, mask, NO_CONDITION, t=t, noise=noise)
    assert_golden(MFM, "loss/field/rot_mse", terms["mse"])
    assert_golden(MFM, "loss/field/loss", terms["loss"])


GRIDS = sorted(
    key.removesuffix("_row") for key in MFM if key.startswith("times/") and key.endswith("_row")
)


@golden_cases("mfm", GRIDS)
def test_flow_times_and_rows(case):
    name, count = case.removeprefix("times/").split("_N")
    process = FlowMatching(quantize_time=True, odeint_grid=name == "odeint")
    times = torch.tensor(process.times(int(count)), dtype=torch.float64)
    assert times[-1] == 1
    assert np.array_equal(times[:-1].to(torch.float32).numpy(), MFM[f"{case}_t"])
    assert process.table_time(times[:-1]).long().tolist() == MFM[f"{case}_row"].tolist()


@pytest.mark.parametrize(
    ("distribution", "in_the_middle"), [("uniform", 0.5), ("logit_normal", 0.728)]
)
def test_flow_times_are_drawn_as_named(distribution, in_the_middle):
    """The probability of |logit| < ln 3 of a normal variable is 0.728."""
    torch.manual_seed(0)
    process, x = (
        FlowMatching(time_distribution=distribution, prediction="x0"),
        torch.zeros(4000, 1, 1),
    )
    # Of motions that are 0, the error of a denoiser that returns the square root of the time is the time.
    times = process.loss(
        lambda _, t, *__: (t / 1000).sqrt()[:, None, None], x, real(x), NO_CONDITION
    )["mse"]
    assert times.mean() == pytest.approx(0.5, abs=0.03)
    assert ((times > 0.25) & (times < 0.75)).float().mean() == pytest.approx(
        in_the_middle, abs=0.03
    )


MASK = length_mask(torch.tensor([4, 2]))
NULL = Condition(torch.tensor([[10.0]]), torch.zeros(1, 0, 1), None)
COND = Condition(torch.tensor([[1.0], [2.0]]), torch.zeros(2, 0, 1), None, NULL)


def sees_condition(x_t, t, mask, cond):
    """Two channels x + condition + t, and as many of a variance: the condition itself."""
    assert len(x_t) == len(t) == len(mask) == len(cond.pooled)
    mean = (x_t + cond.pooled[:, None] + t[:, None, None]) * mask[..., None]
    return torch.cat([mean, cond.pooled[:, None].expand_as(x_t)], -1)


@pytest.mark.parametrize("scale", [0.0, 2.5, torch.tensor([2.5, 0.0]), torch.tensor([1.0, 8.0])])
def test_guidance_is_two_passes_in_one_except_for_a_learned_variance_and_scale_one(scale, subtests):
    x_t, t = torch.randn(2, 4, 2), torch.tensor([3.0, 5.0])
    with_cond = sees_condition(x_t, t, MASK, COND)
    null = sees_condition(x_t, t, MASK, COND.drop(torch.tensor([True, True])))
    strength = scale[:, None, None] if isinstance(scale, torch.Tensor) else scale
    expected = torch.cat([(null + strength * (with_cond - null))[..., :2], with_cond[..., 2:]], -1)
    for channels in (4, 2):
        with subtests.test(channels=channels):
            denoise = CountedDenoise(
                lambda *args, channels=channels: sees_condition(*args)[..., :channels]
            )
            guided = classifier_free_guidance(denoise, scale, features=2)(x_t, t, MASK, COND)
            torch.testing.assert_close(guided, expected[..., :channels])
            assert denoise.calls == 1
    assert classifier_free_guidance(sees_condition, 1, 2) is sees_condition


def test_doubled_conditions_and_masks_are_made_once_per_run_and_follow_a_change():
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append((mask, cond))
        return x_t

    guided = classifier_free_guidance(denoise, 2.0, 2)
    other = Condition(COND.pooled + 1, COND.tokens, None, NULL)
    for mask, cond in ((MASK, COND), (MASK, COND), (MASK, other), (~MASK, COND), (MASK, COND)):
        guided(torch.zeros(2, 4, 2), torch.zeros(2), mask, cond)
    masks, conditions = zip(*seen, strict=True)
    assert masks[0] is masks[1]
    assert conditions[0] is conditions[1]
    pooled = [1, 2, 10, 10]
    assert [cond.pooled.flatten().tolist() for cond in conditions] == [
        pooled,
        pooled,
        [2, 3, 10, 10],
        pooled,
        pooled,
    ]
    assert [torch.equal(mask, torch.cat([MASK, MASK])) for mask in masks] == [
        True,
        True,
        True,
        False,
        True,
    ]


def test_a_step_toward_a_distant_position_is_limited_over_all_features_of_a_motion():
    x, place = torch.zeros(2, 7, 6), torch.tensor([3])
    far = Positions(
        frames=place, joints=torch.tensor([1]), axes=torch.tensor([2]), values=100.0 * place
    )
    steered = steer(lambda noisy: noisy, x, lambda motion: motion.unflatten(-1, (2, 3)), far)
    rms = (steered - x).square().mean((1, 2)).sqrt()
    # Two steps of 0.02 each
    torch.testing.assert_close(rms, torch.full((2,), 0.04))


def test_steps_of_training_are_equally_likely():
    """Each of the T steps has the same share of (0, 1), also the first one and the last one."""
    process = GaussianDiffusion(4)
    u = torch.tensor([0.0, 0.24, 0.25, 0.49, 0.51, 0.74, 0.76, 1.0])
    assert process.training_times(u).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]


def test_times_of_distillation_are_evenly_spaced_and_end_one_interval_before_the_data():
    assert GaussianDiffusion(50).grid(4) == [49, 37, 24, 11]
    assert GaussianDiffusion(1000).grid(3) == [999, 666, 332]
    assert GaussianDiffusion(10).grid(20) == list(range(9, -1, -1))
    assert FlowMatching().grid(4) == [0, 0.25, 0.5, 0.75]


def test_the_large_variance_of_fewer_steps_is_that_of_the_longer_steps():
    process = GaussianDiffusion(50, variance="fixed_large")
    steps = [4, 14, 24, 34, 44]
    x = torch.zeros(1, 3, 2, dtype=torch.float64)
    variance = process.log_variance(x, x, 3, process.schedule.respace(steps))
    kept = process.schedule.tables["alphas_cumprod"]
    expected = math.log(1 - float(kept[34] / kept[24]))
    assert float(torch.as_tensor(variance).reshape(-1)[0]) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("count", "null_count"), [(3, 5), (4, 2), (3, 3)])
def test_a_dropped_condition_has_the_tokens_of_the_null_and_others_keep_theirs(count, null_count):
    """Tokens are padded to the longer of both; the last token of the null is padding, too."""
    generator = torch.Generator().manual_seed(0)
    tokens, lengths = torch.randn(3, count, 2, generator=generator), [count, 1, count]
    nothing = torch.randn(1, null_count, 2, generator=generator)
    null_mask = length_mask(torch.tensor([null_count - 1]), null_count)
    null = Condition(nothing[:, 0], nothing, null_mask)
    cond = Condition(tokens[:, 0], tokens, length_mask(torch.tensor(lengths), count), null)
    dropped = cond.drop(torch.tensor([False, False, True]))
    assert dropped.token_mask is not None
    assert dropped.tokens.shape[1] == dropped.token_mask.shape[1] == max(count, null_count)
    expected = [tokens[0], tokens[1, :1], nothing[0, :-1]]
    for row, rows_of_text in enumerate(expected):
        assert torch.equal(dropped.tokens[row, dropped.token_mask[row]], rows_of_text)
    assert torch.equal(dropped.pooled, torch.stack([tokens[0, 0], tokens[1, 0], nothing[0, 0]]))


def test_each_step_toward_a_near_position_halves_the_distance_of_each_motion():
    """Polyak's step, loss / slope, is half of the distance for its square. There are two steps."""
    x, place = torch.zeros(2, 7, 6), torch.tensor([3])
    x[1, 3, 5] = 0.06
    near = Positions(
        frames=place, joints=torch.tensor([1]), axes=torch.tensor([2]), values=torch.tensor([0.1])
    )
    steered = steer(lambda noisy: noisy, x, lambda motion: motion.unflatten(-1, (2, 3)), near)
    expected = torch.zeros(2, 7, 6)
    expected[:, 3, 5] = torch.tensor([0.1 - 0.1 / 4, 0.1 - 0.04 / 4])
    torch.testing.assert_close(steered, expected)


@pytest.mark.parametrize("null_count", [1, 3])
def test_a_null_condition_without_a_mask_replaces_tokens_but_not_the_mask_of_a_sample(null_count):
    tokens, nothing = torch.rand(2, 3, 2) + 1, torch.zeros(1, null_count, 2)
    mask = torch.tensor([[True, True, False], [True, False, False]])
    cond = Condition(tokens[:, 0], tokens, mask, Condition(nothing[:, 0], nothing, None))
    dropped = cond.drop(torch.tensor([True, False]))
    assert torch.equal(dropped.tokens, torch.stack([torch.zeros(3, 2), tokens[1]]))
    assert dropped.token_mask is not None
    assert torch.equal(dropped.token_mask, mask)
    assert torch.equal(dropped.pooled, torch.stack([torch.zeros(2), tokens[1, 0]]))


@pytest.mark.parametrize(
    ("strength", "total", "steps"),
    [(None, 7, 7), (1.0, 7, 7), (0.01, 10, 1), (1e-9, 1000, 1), (0.58, 50, 29), (0.35, 20, 7)],
)
def test_a_variation_takes_its_share_of_the_steps_but_at_least_one(strength, total, steps):
    known = torch.zeros(1, 4, 2)
    assert Edit(known, known > 0, strength=strength).steps(total) == steps


def test_kept_features_are_imposed_after_the_guide_has_changed_the_estimate():
    known, keep = torch.full((1, 4, 2), 5.0), torch.zeros(1, 4, 2, dtype=torch.bool)
    keep[:, 1, 0] = True
    guide: Any = SimpleNamespace(reach=lambda x0_hat: x0_hat + 1)
    imposed = Edit(known, keep, guide=guide).impose(torch.zeros(1, 4, 2))
    assert torch.equal(imposed, torch.where(keep, 5.0, 1.0))


@pytest.mark.parametrize(
    ("kind", "defaults"),
    [
        (
            GaussianDiffusion,
            {
                **{"num_train_timesteps": 1000, "schedule": "cosine", "prediction": "x0"},
                **{"variance": "fixed_small", "vlb_weight": 0.001, "average_padding": False},
                **{"clip_x0": False, "timestep_sampling": "uniform", "skip": False},
                **{"min_snr": None, "noise_scale": 1.0},
            },
        ),
        (
            FlowMatching,
            {
                **{"sigma_min": 1e-4, "prediction": "velocity", "time_distribution": "uniform"},
                **{"quantize_time": False, "odeint_grid": False},
            },
        ),
        (
            Edit,
            {
                **{"mode": "x0", "until": 0.2, "blend": "after", "resample": 1, "strength": None},
                "guide": None,
            },
        ),
        (
            MotionLosses,
            {
                **{"edges": (), "joints": 0.0, "velocity": 0.0, "foot_contact": 0.0},
                **{"bone_length": 0.0, "root_relative": False, "velocity_features": None},
            },
        ),
    ],
)
def test_defaults_of_processes_edits_and_losses_do_not_change(kind, defaults):
    parameters = signature(kind).parameters.values()
    assert {p.name: p.default for p in parameters if p.default is not p.empty} == defaults
