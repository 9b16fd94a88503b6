"""Every sampler of both processes: against the authors' loops, diffusers and torchdiffeq, and against an oracle."""

import math
import re
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from support.analytic import (
    NO_CONDITION,
    CountedDenoise,
    assert_golden,
    drawn,
    flow_field,
    linear_denoiser,
    motions,
    oracle,
    real,
    recorded,
    sample,
    spaced,
)
from support.fixtures import golden, golden_case, golden_cases, meta, weights
from torch import Tensor
from torchdiffeq import odeint

from flame_mdm.batch import Condition, Denoise, Edit, Noise, length_mask
from flame_mdm.checkpoints.released import Options, Released, import_flame, import_mdm
from flame_mdm.errors import UserError
from flame_mdm.processes import Process
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.samplers import Descent
from flame_mdm.sampler_options import SamplerOptions

GAUSSIAN, MFM = golden("gaussian"), golden("mfm")
OPTIONS = meta(GAUSSIAN)["options"]
both_precisions = pytest.mark.parametrize(
    "dtype", [torch.float32, torch.float64], ids=["f32", "f64"]
)
DIFFUSION = list(GaussianDiffusion.samplers)
CALLS = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}
KINDS = {"ddpm": "ancestral", "ddim": "ddim"}


@both_precisions
@golden_cases("gaussian", OPTIONS["mdm_loops"])
def test_mdm_loop(case, dtype):
    total, section, kind, options = OPTIONS["mdm_loops"][case]
    supported = {
        "eta",
        "inpaint",
        "skip_timesteps",
        "skip",
        "init_image",
        "init",
        "const_noise",
        "const",
    }
    assert not options.keys() - supported, f"{case}: options that the product does not have"
    x_T, steps = motions(GAUSSIAN["loop/x_T"], dtype), spaced(total, section)
    draws = [motions(noise, dtype) for noise in GAUSSIAN[f"loop/{case}/noise"]]
    # This concerns the noise of the steps, not of the start.
    if options.get("const_noise") or options.get("const") or "const_noise" in case:
        draws = [noise[:1].expand_as(noise) for noise in draws]
    named = re.search(r"skip(\d+)", case)  # how many of the noisiest steps a loop leaves out
    edit, skip = (
        None,
        int(options.get("skip_timesteps") or options.get("skip") or (named[1] if named else 0)),
    )
    if skip or options.get("inpaint"):
        start = next(
            (key for key in (f"loop/{case}/init_image", "loop/init_image") if key in GAUSSIAN), ""
        )
        known = GAUSSIAN["loop/inpainted_motion" if options.get("inpaint") or not start else start]
        strength = (len(steps) - skip) / len(steps) if skip else None
        edit = Edit(
            motions(known, dtype), torch.zeros_like(x_T, dtype=torch.bool), strength=strength
        )
        if options.get("inpaint"):
            edit.keep = motions(GAUSSIAN["loop/inpainting_mask"]) > 0
    denoise = linear_denoiser(
        GAUSSIAN["loop/lin4/A"], GAUSSIAN["loop/lin4/b"], float(GAUSSIAN["lin4/g"])
    )
    how = {
        "sampler": KINDS[kind],
        "num_inference_steps": steps,
        "eta": options.get("eta") if kind == "ddim" else None,
    }
    x = sample(
        GaussianDiffusion(num_train_timesteps=total),
        denoise,
        recorded(x_T, draws),
        edit=edit,
        **how,
    )
    assert_golden(GAUSSIAN, f"loop/{case}/out", x)
    if edit is not None:
        torch.testing.assert_close(x[edit.keep], edit.known[edit.keep], rtol=0, atol=1e-12)


def flame_edit(known: Tensor, joints: list[int], keep_translation: bool) -> Edit:
    keep = torch.ones_like(known, dtype=torch.bool)
    keep[..., :3] = keep_translation
    keep[..., 3:].unflatten(-1, (-1, 6))[..., joints, :] = False
    return Edit(known, keep, mode="x_t", blend="before")


@both_precisions
@golden_cases("gaussian", OPTIONS["flame_loops"])
def test_flame_loop(case, dtype):
    options = OPTIONS["flame_loops"][case]
    process = GaussianDiffusion(
        options["T"], prediction="epsilon", variance="learned_range", clip_x0=True
    )
    x_T = motions(GAUSSIAN["floop/x_T"], dtype)
    edit = None
    if "edit" in options:
        edit = flame_edit(
            motions(GAUSSIAN["floop/ref_motion"], dtype).expand_as(x_T), *options["edit"]
        )
    denoise = linear_denoiser(
        GAUSSIAN["floop/A"], GAUSSIAN["floop/b"][:, None], float(GAUSSIAN["lin4/g"])
    )
    draws = [motions(noise, dtype) for noise in GAUSSIAN[f"floop/{case}/noise"]]
    how = {
        "sampler": KINDS[options["kind"]],
        "num_inference_steps": spaced(options["T"], options["sec"]),
    }
    assert_golden(
        GAUSSIAN,
        f"floop/{case}/out",
        sample(process, denoise, recorded(x_T, draws), edit=edit, **how),
    )


DDIM_STEPS = sorted(
    key.removeprefix("step/") for key in GAUSSIAN if key.startswith("step/ddim_eta")
)


@both_precisions
@golden_cases("gaussian", ["p_sample", *DDIM_STEPS])
def test_one_step(case, dtype):
    process, t = GaussianDiffusion(OPTIONS["T"]), torch.tensor(GAUSSIAN["pw/t"])
    x_t = motions(GAUSSIAN["f64/pw/x_t" if dtype == torch.float64 else "pw/x_t"], dtype)
    noise = motions(GAUSSIAN["step/noise"][["p_sample", *DDIM_STEPS].index(case)], dtype)
    denoise = linear_denoiser(GAUSSIAN["lin4/A"], GAUSSIAN["lin4/b"], float(GAUSSIAN["lin4/g"]))
    x0_hat = denoise(x_t, t.float(), real(x_t), NO_CONDITION)
    name, eta = (
        ("ancestral", None)
        if case == "p_sample"
        else ("ddim", float(case.removeprefix("ddim_eta")))
    )
    stepped = []
    for x, x0, draw, step in zip(x_t, x0_hat, noise, t.tolist(), strict=True):
        estimate = x0, process.log_variance(x0, x, step, process.schedule)
        run = Descent(
            lambda *_, same=estimate: same, process.schedule, iter([draw]), SamplerOptions(eta=eta)
        )
        stepped.append(process.samplers[name].step(x, run, step))
    x = torch.stack(stepped)
    assert_golden(GAUSSIAN, f"step/{case}", x)
    # The authors lose up to 5e-4 in float32 by rounding alpha before 1 - alpha; the coefficients here do not.
    exact = motions(GAUSSIAN[f"f64/step/{case}"])
    torch.testing.assert_close(x.float(), exact, rtol=0, atol=2e-6 * float(exact.abs().max()))


# MFM's own loops, over equal steps; all other methods are torchdiffeq's.
EULER = {"euler_raw": "euler", "euler_replacement_edit_till": "euler"}
FLOW_RUNS: dict[str, dict] = meta(MFM)["config"]["runs"]


def replay_flow_run(case: str, denoise: Denoise, cond: Condition, **options: Any) -> None:
    """Samples as one of the authors' runs, and compares."""
    run = FLOW_RUNS[case]
    method: str = run.get("method", "euler")
    process = FlowMatching(meta(MFM)["sigma_min"], odeint_grid=method not in EULER, **options)
    start = motions(MFM["sample/x_init"])
    if run["on"] == "cfg":
        denoise = classifier_free_guidance(
            denoise, torch.from_numpy(MFM["in/scale"]), start.shape[-1]
        )
    edit = None
    if "edit" in method:
        keep, known = (
            motions(MFM["edit/inpainting_mask"]) > 0,
            motions(MFM["edit/inpainted_motion"]),
        )
        edit = Edit(known, keep, mode="trajectory", until=run.get("edit_till", 1.0))
    how = {
        "sampler": EULER.get(method, method),
        "num_inference_steps": round(1 / run.get("step_size", 0.1)),
    }
    assert_golden(
        MFM, f"run/{case}", sample(process, denoise, recorded(start), cond=cond, edit=edit, **how)
    )


def stages(times: np.ndarray) -> np.ndarray:
    """Where the 6 evaluations of each step of dopri5 lie between its begin and end; two times come before the steps."""
    rows = times[2:].reshape(-1, 6)
    begins = np.concatenate([[0.0], rows[:-1, -1]])[:, None]
    return (rows - begins) / (rows[:, -1:] - begins)


@golden_cases("mfm", FLOW_RUNS)
def test_flow_run(case):
    """On the fixture's velocity field, whose times are compared too, or with its network."""
    if FLOW_RUNS[case]["on"] != "field":
        replay_flow_run(case, *released_flow(), quantize_time=True)
        return
    calls = []

    def field(x_t, t, mask, cond):
        calls.append(t[0].item() / 1000)
        return flow_field(MFM)(x_t, t, mask, cond)

    replay_flow_run(case, field, NO_CONDITION)
    times, expected = np.array(calls), MFM[f"times/{case}"]
    if FLOW_RUNS[case].get("method") == "dopri5":
        # Later step sizes follow from an error of the first step near the rounding of float32, which differs between
        # processors. The first step, the number of steps and the stages within each do not.
        np.testing.assert_allclose(times[:8], expected[:8], rtol=0, atol=1e-6)
        times, expected = stages(times), stages(expected)
    np.testing.assert_allclose(times, expected, rtol=0, atol=1e-6)


def built(released: Released) -> Denoise:
    network = released.network(*released.features, **released.options)
    network.load_state_dict(released.state)
    return network.eval().requires_grad_(False)


def released_flow() -> tuple[Denoise, Condition]:
    """The fixture's network with its random weights, and its conditions, texts or actions, with their null."""
    released = import_mdm(weights(MFM), Options(num_heads=meta(MFM)["config"]["heads"]))
    if released.action_embedding is not None and "in/action" in MFM:
        pooled = released.action_embedding[torch.from_numpy(MFM["in/action"]).flatten()]
    else:
        pooled = torch.from_numpy(MFM["in/text_embed"]).flatten(0, -2)
    tokens = torch.zeros(len(pooled), 0, pooled.shape[1])
    return built(released), Condition(
        pooled, tokens, None, Condition(torch.zeros_like(pooled[:1]), tokens[:1], None)
    )


@golden_case("mfm")
def test_flow_loss_of_the_network(stem):
    denoise, cond = released_flow()
    x, noise = motions(MFM["loss/x_start"]), motions(MFM["loss/noise"])
    mask, t = torch.from_numpy(MFM["in/mask"]).flatten(1), torch.from_numpy(MFM["loss/t"])
    process = FlowMatching(meta(MFM)["sigma_min"], quantize_time=True)
    terms = process.loss(denoise, x, mask, cond, t=t, noise=noise)
    assert_golden(MFM, "loss/model/rot_mse", terms["mse"])
    assert_golden(MFM, "loss/model/loss", terms["loss"])


FLAME = golden("flame_text2motion")
FLAME_LOOPS: dict[str, list] = meta(FLAME)["config"]["loops"]
FLAME_OPTIONS: dict[str, Any] = {"prediction": "epsilon", "variance": "learned_range"}


def released_flame() -> tuple[Denoise, Condition]:
    """The fixture's network and the conditions of its texts; the last text, "", is their null."""
    pooled, tokens = (
        torch.from_numpy(FLAME["lm/pooler_output"]),
        torch.from_numpy(FLAME["lm/last_hidden_state"]),
    )
    # The authors attend to the padding of the text
    seen = torch.ones(tokens.shape[:2], dtype=torch.bool)
    null = Condition(pooled[-1:], tokens[-1:], seen[-1:])
    denoise = built(import_flame(weights(FLAME), num_heads=meta(FLAME)["config"]["heads"]))
    return denoise, Condition(pooled[:-1], tokens[:-1], seen[:-1], null)


@golden_cases("flame_text2motion", [*FLAME_LOOPS, "edit"])
def test_flame_loop_of_the_network(case):
    config = meta(FLAME)["config"]
    total, section, kind = [*config["edit_T"], "ddpm"] if case == "edit" else FLAME_LOOPS[case]
    denoise, cond = released_flame()
    # One motion of the first text; of the authors' two rows the second repeats the first for guidance.
    assert cond.token_mask is not None
    cond = Condition(cond.pooled[:1], cond.tokens[:1], cond.token_mask[:1], cond.null)
    start = motions(FLAME[f"noise/{case}_init"][:1])
    draws = [motions(noise[:1]) for noise in FLAME[f"noise/{case}_steps"]]
    edit = None
    if case == "edit":
        edit = flame_edit(
            motions(FLAME["edit/ref_motion"][None]), config["edit_joints"], config["keep_trans"]
        )
    process = GaussianDiffusion(total, clip_x0=True, **FLAME_OPTIONS)
    guided = classifier_free_guidance(denoise, config["scale"], start.shape[-1])
    how = {"sampler": KINDS[kind], "num_inference_steps": spaced(total, section)}
    x = sample(process, guided, recorded(start, draws), cond=cond, edit=edit, **how)
    assert_golden(FLAME, f"out/{case}", x.transpose(1, 2))


@golden_case("flame_text2motion")
def test_flame_loss_of_the_network(stem):
    denoise, cond = released_flame()
    x, noise = motions(FLAME["loss/x_start"]), motions(FLAME["loss/noise"])
    mask, t = (
        length_mask(torch.from_numpy(FLAME["in/motion_length"]), x.shape[1]),
        torch.from_numpy(FLAME["loss/t"]),
    )
    process = GaussianDiffusion(
        meta(FLAME)["config"]["T_loss"], average_padding=True, **FLAME_OPTIONS
    )
    terms = process.loss(denoise, x * mask[..., None], mask, cond, t=t.float(), noise=noise)
    for name in ("mse", "vlb", "loss"):
        assert_golden(FLAME, f"out/loss_{name.replace('vlb', 'vb')}", terms[name])


@pytest.mark.parametrize("count", [2, 50])
@pytest.mark.parametrize("sampler", DIFFUSION)
@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
@pytest.mark.parametrize("variance", ["fixed_small", "fixed_large", "learned_range"])
def test_oracle_diffusion_returns_the_data(variance, prediction, sampler, count):
    torch.manual_seed(0)
    process, mask = (
        GaussianDiffusion(50, prediction=prediction, variance=variance),
        length_mask(torch.tensor([6, 3])),
    )
    data = torch.randn(2, 6, 4, dtype=torch.float64) * mask[..., None]
    denoise, estimates = CountedDenoise(oracle(process, data)), list[Tensor]()
    noise, how = drawn((2, 6, 4), torch.float64), {"sampler": sampler, "num_inference_steps": count}
    x = sample(process, denoise, noise, mask, trajectory=estimates, **how)
    torch.testing.assert_close(x, data, rtol=0, atol=1e-6)
    assert (x[~mask] == 0).all()
    assert denoise.calls == count == len(estimates)
    torch.testing.assert_close(estimates[-1], data, rtol=0, atol=1e-6)


@pytest.mark.parametrize("prediction", ["velocity", "x0"])
@pytest.mark.parametrize("count", [1, 10])
@pytest.mark.parametrize("sampler", [*CALLS, "dopri5"])
def test_oracle_flow_returns_the_data(sampler, count, prediction):
    torch.manual_seed(0)
    process, mask = (
        FlowMatching(sigma_min=1e-3, prediction=prediction),
        length_mask(torch.tensor([6, 3])),
    )
    data, noise = torch.randn(2, 2, 6, 4, dtype=torch.float64)
    data = data * mask[..., None]
    output = process.target(data, noise, torch.zeros(2))
    estimates, how = list[Tensor](), {"sampler": sampler, "num_inference_steps": count}
    denoise = CountedDenoise(lambda *_: output)
    x = sample(process, denoise, recorded(noise), mask, trajectory=estimates, **how)
    # The path ends where its last noise has deviation sigma_min; every estimate on it is the data itself.
    torch.testing.assert_close(x, (data + 1e-3 * noise) * mask[..., None], rtol=0, atol=1e-5)
    for estimate in estimates:
        torch.testing.assert_close(estimate, data, rtol=0, atol=1e-5)
    assert len(estimates) == denoise.calls
    if sampler != "dopri5":
        assert denoise.calls == count * CALLS[sampler]


def test_order_of_diffusion_solvers():
    """Against the exact flow of normal data, which scales the start: DDIM is of order 1, DPM-Solver++ (2M) of 2."""
    process, start = GaussianDiffusion(1000), drawn((1, 1, 100), torch.float64)
    signal, sigma = (process.schedule.tables[name][-1] for name in ("signal", "noise"))
    exact = 0.5 + 0.3 * (start(0) - 0.5 * signal) / (signal**2 * 0.3**2 + sigma**2).sqrt()

    def denoise(x_t: Tensor, t: Tensor, *_: object) -> Tensor:
        signal, noise = process.schedule.at("signal", t, x_t), process.schedule.at("noise", t, x_t)
        return 0.5 + signal * 0.3**2 / (signal**2 * 0.3**2 + noise**2) * (x_t - 0.5 * signal)

    def error(sampler: str, count: int) -> float:
        x = sample(process, denoise, start, sampler=sampler, num_inference_steps=count)
        return (x - exact).abs().mean().item()

    assert error("ddim", 100) / error("ddim", 200) == pytest.approx(2, abs=0.3)
    assert error("dpm_solver_pp_2m", 100) / error("dpm_solver_pp_2m", 200) > 3
    assert error("dpm_solver_pp_2m", 100) < error("ddim", 100) / 2


MIXING = linear_denoiser(np.array([[0.3, -0.2], [0.1, 0.4]]), np.array([[0.2], [-0.1]]), 0.3)


# The authors' code warns under numpy 2.
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")
@pytest.mark.parametrize(
    ("ours", "name"), [("x0", "sample"), ("epsilon", "epsilon"), ("velocity", "v_prediction")]
)
def test_dpm_solver_agrees_with_diffusers(ours, name):
    process, steps = GaussianDiffusion(1000, prediction=ours), [0, 30, 90, 250, 400, 777, 950]
    options: Any = {
        "prediction_type": name,
        "trained_betas": process.schedule.tables["betas"].numpy(),
        "final_sigmas_type": "zero",
    }
    scheduler: Any = DPMSolverMultistepScheduler(1000, **options)
    scheduler.set_timesteps(timesteps=steps[::-1])
    noise = drawn((1, 3, 2), torch.float64)
    theirs = noise(0)
    for t in scheduler.timesteps:
        output = MIXING(theirs, torch.tensor([float(t)]), real(theirs), NO_CONDITION)
        theirs = scheduler.step(output, t, theirs, return_dict=False)[0]
    ours = sample(process, MIXING, noise, sampler="dpm_solver_pp_2m", num_inference_steps=steps)
    # The authors' code computes products of alphas in float32.
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_fixed_steps_agree_with_torchdiffeq(subtests):
    field = linear_denoiser(np.random.default_rng(0).normal(size=(4, 4)), np.ones((4, 1)), 2.0)
    start, times = drawn((2, 5, 4), torch.float64)(0), torch.linspace(0, 1, 8, dtype=torch.float64)
    for sampler in CALLS:
        with subtests.test(sampler=sampler):
            ours = sample(
                FlowMatching(), field, recorded(start), sampler=sampler, num_inference_steps=7
            )
            method = "heun2" if sampler == "heun" else sampler
            theirs = odeint(
                lambda t, x: field(x, 1000 * t.expand(2), real(x), NO_CONDITION),
                start,
                times,
                method=method,
            )
            torch.testing.assert_close(ours, theirs[-1], rtol=1e-9, atol=1e-9, msg=sampler)


def half_kept(x: Tensor) -> Tensor:
    keep = torch.zeros_like(x, dtype=torch.bool)
    keep[:, ::2] = True
    return keep


def pulled(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
    """A denoiser that wants all motion at 3 and sees the mean of each sample."""
    return 3 + 0.1 * x_t + 0.1 * x_t.mean((1, 2), keepdim=True)


EVERY = [*product([GaussianDiffusion], DIFFUSION), *product([FlowMatching], CALLS)]


@pytest.mark.parametrize(("build", "sampler"), EVERY)
def test_kept_parts_are_met_exactly_and_seen_by_the_rest(build, sampler, subtests):
    how, known = {"sampler": sampler, "num_inference_steps": 10}, torch.full((2, 6, 3), -2.0)
    sampled = partial(sample, denoise=pulled, noise=drawn((2, 6, 3)), **how)
    keep, free = half_kept(known), sampled(build())
    for mode in [mode for mode in build.edit_modes if mode != "trajectory"]:
        with subtests.test(mode=mode):
            edited = sampled(build(), edit=Edit(known, keep, mode))
            assert torch.equal(edited[keep], known[keep])
            assert edited.isfinite().all()
            # The denoiser sees the kept part, so the rest follows it downwards.
            assert edited[~keep].mean() < free[~keep].mean() - 0.05
            nothing = sampled(
                build(), edit=Edit(known, torch.zeros_like(keep), mode, blend="before")
            )
            # Blending uses up the draws of these samplers.
            if mode == "x0" or sampler not in (
                "ancestral",
                "consistency",
            ):
                torch.testing.assert_close(nothing, free)
    if build is GaussianDiffusion:  # clipping does not move kept parts
        clipped = sampled(GaussianDiffusion(clip_x0=True), edit=Edit(known, keep))
        assert torch.equal(clipped[keep], known[keep])
        assert (clipped[~keep] <= 1).all()


@pytest.mark.parametrize(("build", "sampler"), EVERY)
def test_estimates_of_a_run_contain_the_kept_part_and_no_padding(build, sampler):
    known, estimates = torch.full((2, 6, 3), -2.0), []
    keep, mask = half_kept(known), length_mask(torch.tensor([6, 3]))
    denoise = CountedDenoise(pulled)
    how = {"sampler": sampler, "num_inference_steps": 4, "trajectory": estimates}
    x = sample(build(), denoise, drawn((2, 6, 3)), mask, edit=Edit(known, keep), **how)
    assert len(estimates) == denoise.calls
    for estimate in [*estimates, x]:
        assert (estimate[~mask] == 0).all()
        assert torch.equal(estimate[mask & keep[..., 0]], known[mask & keep[..., 0]])
        assert (estimate[mask & ~keep[..., 0]] > -2).all()


class Shifting:
    """A guide that moves noisy motions by 1 after it has looked at their estimates."""

    def steer(self, clean, x_t):
        clean(x_t)
        return x_t + 1

    def reach(self, x0_hat):
        return x0_hat


@pytest.mark.parametrize(
    ("process", "sampler"),
    [
        (GaussianDiffusion(50, prediction="velocity"), "ddim"),
        (GaussianDiffusion(50, prediction="x0"), "ancestral"),
        (FlowMatching(prediction="velocity"), "euler"),
        (FlowMatching(prediction="velocity"), "heun"),
        (FlowMatching(prediction="x0"), "euler"),
    ],
    ids=lambda value: getattr(value, "prediction", value),
)
def test_a_guide_sees_estimates_at_the_time_of_the_step_and_steers_no_further_than_they(
    process, sampler
):
    """The denoiser knows the motion, whatever it sees, so that the run ends in it."""
    motion, times = torch.randn(2, 6, 3, dtype=torch.float64), []

    def denoise(x_t, table_time, mask, cond):
        times.append(table_time[0].item())
        t = table_time / 1000 if isinstance(process, FlowMatching) else table_time
        zero, one = torch.zeros_like(motion), torch.ones_like(motion)
        signal, sigma = process.corrupt(one, zero, t), process.corrupt(zero, one, t)
        return process.target(motion, (x_t - signal * motion) / sigma, t)

    edit = Edit(motion, torch.zeros_like(motion, dtype=torch.bool), guide=Shifting())
    noise = drawn((2, 6, 3), torch.float64)
    x = sample(process, denoise, noise, edit=edit, sampler=sampler, num_inference_steps=5)
    torch.testing.assert_close(x, motion, rtol=0, atol=1e-3)
    assert times[::2] == times[1::2]
    assert len({round(time, 3) for time in times}) == (6 if sampler == "heun" else 5)


@pytest.mark.parametrize("sampler", ["ancestral", "ddim"])
@pytest.mark.parametrize(
    ("blend", "resample"), [("after", 1), ("before", 1), ("after", 2), ("before", 2)]
)
def test_blended_parts_are_as_noisy_as_the_rest_and_each_noisy_step_is_resampled(
    blend, resample, sampler, subtests
):
    """A denoiser sees a kept part as the known motion, corrupted to exactly the given step.

    At the second visit of a step, the rest is as noisy, if the denoiser knows the motion.
    """
    process, known = GaussianDiffusion(100), torch.full((1, 1, 4000), 2.0)
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append((int(t[0]), x_t))
        return known

    edit = Edit(
        known, torch.arange(4000).expand(1, 1, -1) < 2000, "x_t", blend=blend, resample=resample
    )
    steps = [0, 5, 15, 30, 60, 99]
    x = sample(
        process, denoise, drawn((1, 1, 4000)), edit=edit, sampler=sampler, num_inference_steps=steps
    )
    torch.testing.assert_close(x, known, rtol=0, atol=1e-4)
    assert len(seen) == 5 * resample + 1
    for number, (step, x_t) in enumerate(seen):
        with subtests.test(number=number, step=step):
            signal, noise = (
                process.schedule.tables[name][step].item() for name in ("signal", "noise")
            )
            for part in (x_t[edit.keep], x_t[~edit.keep])[: 2 if number % resample else 1]:
                assert part.mean().item() == pytest.approx(2 * signal, abs=0.08)
                assert part.std().item() == pytest.approx(noise, rel=0.06)


@pytest.mark.parametrize("sampler", CALLS)
def test_rewriting_ends_at_its_threshold(sampler, subtests):
    start, known, seen = drawn((1, 6, 3))(0), torch.full((1, 6, 3), -2.0), []
    edit = Edit(known, half_kept(known), "trajectory", until=0.2)

    def still(x_t, t, mask, cond):
        seen.append((t[0].item() / 1000, x_t))
        return torch.zeros_like(x_t)

    sample(
        FlowMatching(), still, recorded(start), sampler=sampler, num_inference_steps=25, edit=edit
    )
    calls = seen[:: CALLS[sampler]]
    assert len(calls) == 25
    for i, (time, x) in enumerate(calls):
        with subtests.test(step=i):
            share = min(i, 5) / 25
            assert time == pytest.approx(i / 25)
            torch.testing.assert_close(
                x, torch.where(edit.keep, (1 - share) * start + share * known, start)
            )


REFUSED: dict[type[Process], list[tuple[dict[str, Any], str]]] = {
    GaussianDiffusion: [
        ({"sampler": "euler"}, "GaussianDiffusion: ancestral, ddim, dpm_solver_pp_2m"),
        ({"num_inference_steps": 1}, "2 to 1000"),
        ({"num_inference_steps": 1001}, "1000"),
        ({"num_inference_steps": [5, 3]}, "increasing"),
        ({"num_inference_steps": [5, 1000]}, "999"),
        ({"num_inference_steps": [0, 1.5]}, "expected a number of steps, or a list"),
        (
            {"eta": 1.0},
            "eta=1.0: the sampler ancestral does not support this option. It supports guidance_scale",
        ),
        ({"sampler": "ddim", "eta": 1.5}, "0 to 1"),
        ({"sampler": 3}, "sampler=3: expected the name"),
        ({"spacing": "even"}, "spacing=even is unknown. Choose from linspace, stride"),
        ({"guidance_scale": math.nan}, "guidance_scale=nan is not a finite number"),
        ({"edit": {"mode": "trajectory"}}, "x0, x_t"),
        (
            {"edit": {"mode": "x_t", "known": torch.zeros(1, 5, 2)}},
            "^the shape of the edit does not match",
        ),
        (
            {"sampler": "dpm_solver_pp_2m", "edit": {"mode": "x_t", "resample": 2}},
            r"with resample and x_t\. Use",
        ),
    ],
    FlowMatching: [
        ({"sampler": "ddim"}, "FlowMatching: euler, midpoint, heun, rk4, dopri5"),
        (
            {"sampler": "euler", "num_inference_steps": [0, 2]},
            "flow matching uses steps of equal size",
        ),
        (
            {"sampler": "euler", "spacing": "stride"},
            "spacing=stride: the sampler euler does not support this option",
        ),
        ({"sampler": "euler", "edit": {"mode": "x_t"}}, "trajectory, x0"),
        (
            {"sampler": "dopri5", "edit": {"mode": "x0"}},
            r"dopri5 does not support edits with x0\. Use one of these samplers: euler",
        ),
    ],
}


@pytest.mark.parametrize("build", REFUSED)
def test_the_impossible_is_refused_in_one_line(build, subtests):
    known = torch.zeros(1, 4, 2)
    for changed, message in REFUSED[build]:
        with subtests.test(changed=changed, message=message):
            options = {"sampler": "ancestral", "num_inference_steps": 5} | changed
            if "edit" in options:
                options["edit"] = Edit(
                    **({"known": known, "keep": half_kept(known)} | changed["edit"])
                )
            with pytest.raises(UserError, match=message) as error:
                sample(build(), pulled, drawn((1, 4, 2)), **options)
            assert "\n" not in str(error.value)


@pytest.mark.parametrize(("build", "sampler"), EVERY)
def test_padding_changes_no_real_frame(build, sampler):
    """With noise drawn for each sample at its own length and a denoiser that respects the mask."""

    def denoise(x_t, t, mask, cond):
        mean = (x_t * mask[..., None]).sum(1, keepdim=True) / mask.sum(1)[:, None, None]
        return torch.where(mask[..., None], 0.5 * x_t + mean, 1e4)

    def run(frames: int) -> Tensor:
        padding, start = torch.full((1, frames - 4, 3), 7.0), drawn((1, 4, 3))
        mask = length_mask(torch.tensor([4]), frames)
        noise: Noise = lambda draw: torch.cat([start(draw), padding], 1)  # noqa: E731
        return sample(build(), denoise, noise, mask, sampler=sampler, num_inference_steps=6)

    assert (run(9)[:, 4:] == 0).all()
    torch.testing.assert_close(run(9)[:, :4], run(4))


@pytest.mark.parametrize(("build", "sampler"), EVERY)
def test_no_loop_waits_for_the_device(build, sampler, subtests):
    """Tensors on the meta device have no values: a loop that read one would fail."""
    known = torch.zeros(2, 6, 3, device="meta")
    for edit in (None, *(Edit(known, known > 0, mode) for mode in build.edit_modes)):
        with subtests.test(edit=edit):
            how = {"sampler": sampler, "num_inference_steps": 5, "edit": edit, "trajectory": []}
            assert sample(build(), pulled, lambda draw: torch.zeros_like(known), **how).shape == (
                2,
                6,
                3,
            )


def test_half_precision_denoisers_are_sampled_in_float32(subtests):
    denoisers: list[Denoise] = [
        lambda x_t, *_: x_t.bfloat16(),
        lambda x_t, *_: x_t.bfloat16().float(),
    ]
    for sampler in DIFFUSION:
        with subtests.test(sampler=sampler):
            how = {"sampler": sampler, "num_inference_steps": 5}
            half, single = (
                sample(GaussianDiffusion(), denoise, drawn((1, 4, 2)), **how)
                for denoise in denoisers
            )
            torch.testing.assert_close(half, single, rtol=0, atol=0)


@pytest.mark.parametrize("sigma_min", [0.0, 0.2])
@pytest.mark.parametrize("prediction", ["velocity", "x0"])
def test_a_consistency_step_of_a_flow_ends_on_the_path_from_new_noise_to_the_estimate(
    prediction, sigma_min
):
    process = FlowMatching(sigma_min=sigma_min, prediction=prediction)
    data, noise = drawn((2, 5, 3), torch.float64)(9), drawn((2, 5, 3), torch.float64)
    knows, seen = oracle(process, data), []

    def denoise(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        seen.append((t[0].item() / 1000, x_t))
        return knows(x_t, t, mask, cond)

    x = sample(process, denoise, noise, sampler="consistency", num_inference_steps=4)
    torch.testing.assert_close(x, data)
    for number, (time, x_t) in enumerate(seen):
        assert time == pytest.approx(number / 4)
        t = torch.full((2,), number / 4, dtype=torch.float64)
        torch.testing.assert_close(x_t, process.corrupt(data, noise(number), t))


@pytest.mark.parametrize("build", [GaussianDiffusion, FlowMatching])
@pytest.mark.parametrize("shape", [(1, 4, 2), (2, 1, 2), (2, 5, 2)])
def test_an_edit_has_the_motions_and_frames_of_the_mask(build, shape):
    """Shapes that torch would broadcast are refused, too."""
    known = torch.zeros(shape)
    options = {"sampler": "consistency", "num_inference_steps": 2}
    with pytest.raises(UserError, match="the shape of the edit does not match the motions"):
        sample(build(), pulled, drawn((2, 4, 2)), edit=Edit(known, half_kept(known)), **options)


@pytest.mark.parametrize("build", [GaussianDiffusion, FlowMatching])
@pytest.mark.parametrize("shape", [(1, 4, 2), (2, 1, 2), (2, 4, 1), (2, 5, 2)])
def test_the_kept_part_of_an_edit_has_the_shape_of_its_motion(build, shape):
    edit = Edit(torch.zeros(2, 4, 2), torch.zeros(shape, dtype=torch.bool))
    options = {"sampler": "consistency", "num_inference_steps": 2}
    with pytest.raises(UserError, match="the shape of the edit does not match the motions"):
        sample(build(), pulled, drawn((2, 4, 2)), edit=edit, **options)
