"""Every sampler of both processes: against the authors' loops, diffusers and torchdiffeq, and against an oracle."""

import math
import re
from itertools import product
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from hydra.utils import instantiate
from support.analytic import (
    NO_CONDITION,
    assert_golden,
    drawn,
    flow_field,
    linear_denoiser,
    motions,
    oracle,
    recorded,
    sample,
    spaced,
)
from support.fixtures import Arrays, golden, groups, meta, weights
from torch import Tensor
from torchdiffeq import odeint

from flame_mdm.batch import Condition, Denoise, Edit, Noise, length_mask
from flame_mdm.checkpoints.released import Released, import_flame, import_mdm
from flame_mdm.errors import UserError
from flame_mdm.processes import Process
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.samplers import CountedDenoise, ancestral_step, ddim_step
from flame_mdm.sampler_options import SamplerOptions

GAUSSIAN, MFM = golden("gaussian"), golden("mfm")
OPTIONS = meta(GAUSSIAN)["options"]
PRECISIONS = [pytest.param(torch.float32, id="f32"), pytest.param(torch.float64, id="f64")]
DIFFUSION = list(GaussianDiffusion.samplers)
CALLS = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}
KINDS = {"ddpm": "ancestral", "ddim": "ddim"}


def cases(stem: str, names: Any) -> list[Any]:
    return [pytest.param(name, id=f"{stem}-{name}") for name in names]


def steps_of(section: str | list[int], total: int) -> list[int]:
    return spaced(total, section if isinstance(section, str) else ",".join(map(str, section)))


def ones(x: Tensor) -> Tensor:
    return torch.ones(x.shape[:2], dtype=torch.bool)


# The authors' loops ---------------------------------------------------------------------------------------------------


def skipped(case: str, options: dict[str, Any]) -> int:
    """How many of the noisiest steps a loop leaves out: MDM's `skip_timesteps`."""
    named = re.search(r"skip(\d+)", case)
    return int(options.get("skip_timesteps") or options.get("skip") or (named[1] if named else 0))


def replay_mdm_loop(arrays: Arrays, case: str, dtype: torch.dtype = torch.float32) -> None:
    """Samples as one of the authors' loops of `meta.options.mdm_loops`, and compares."""
    total, section, kind, options = meta(arrays)["options"]["mdm_loops"][case]
    supported = {"eta", "inpaint", "skip_timesteps", "skip", "init_image", "init", "const_noise", "const"}
    assert not options.keys() - supported, f"{case}: options that the product does not have"
    process = GaussianDiffusion(num_train_timesteps=total)
    x_T, steps = motions(arrays["loop/x_T"], dtype), steps_of(section, total)
    draws = [motions(noise, dtype) for noise in arrays[f"loop/{case}/noise"]]
    if options.get("const_noise") or options.get("const") or "const_noise" in case:  # of the steps, not of the start
        draws = [noise[:1].expand_as(noise) for noise in draws]
    edit = None
    skip = skipped(case, options)
    if skip or options.get("inpaint"):
        start = next((key for key in (f"loop/{case}/init_image", "loop/init_image") if key in arrays), "")
        known = arrays["loop/inpainted_motion" if options.get("inpaint") or not start else start]
        strength = (len(steps) - skip) / len(steps) if skip else None
        edit = Edit(motions(known, dtype), torch.zeros_like(x_T, dtype=torch.bool), strength=strength)
        if options.get("inpaint"):
            edit.keep = motions(arrays["loop/inpainting_mask"]) > 0
    denoise = linear_denoiser(arrays["loop/lin4/A"], arrays["loop/lin4/b"], float(arrays["lin4/g"]))
    how = {"sampler": KINDS[kind], "num_inference_steps": steps, "eta": options.get("eta") if kind == "ddim" else None}
    x = sample(process, denoise, recorded(x_T, draws), edit=edit, **how)
    assert_golden(arrays, f"loop/{case}/out", x)
    if edit is not None:
        torch.testing.assert_close(x[edit.keep], edit.known[edit.keep], rtol=0, atol=1e-12)


@pytest.mark.golden
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("case", cases("gaussian", OPTIONS["mdm_loops"]))
def test_mdm_loop(case, dtype):
    replay_mdm_loop(GAUSSIAN, case, dtype)


def flame_edit(known: Tensor, joints: list[int], keep_translation: bool) -> Edit:
    keep = torch.ones_like(known, dtype=torch.bool)
    keep[..., :3] = keep_translation
    keep[..., 3:].unflatten(-1, (-1, 6))[..., joints, :] = False
    return Edit(known, keep, mode="x_t", blend="before")


@pytest.mark.golden
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("case", cases("gaussian", OPTIONS["flame_loops"]))
def test_flame_loop(case, dtype):
    options = OPTIONS["flame_loops"][case]
    process = GaussianDiffusion(options["T"], prediction="epsilon", variance="learned_range", clip_x0=True)
    x_T = motions(GAUSSIAN["floop/x_T"], dtype)
    edit = None
    if "edit" in options:
        edit = flame_edit(motions(GAUSSIAN["floop/ref_motion"], dtype).expand_as(x_T), *options["edit"])
    denoise = linear_denoiser(GAUSSIAN["floop/A"], GAUSSIAN["floop/b"][:, None], float(GAUSSIAN["lin4/g"]))
    draws = [motions(noise, dtype) for noise in GAUSSIAN[f"floop/{case}/noise"]]
    how = {"sampler": KINDS[options["kind"]], "num_inference_steps": steps_of(options["sec"], options["T"])}
    assert_golden(GAUSSIAN, f"floop/{case}/out", sample(process, denoise, recorded(x_T, draws), edit=edit, **how))


DDIM_STEPS = sorted(key.removeprefix("step/") for key in GAUSSIAN if key.startswith("step/ddim_eta"))


@pytest.mark.golden
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("case", cases("gaussian", ["p_sample", *DDIM_STEPS]))
def test_one_step(case, dtype):
    process, t = GaussianDiffusion(OPTIONS["T"]), torch.tensor(GAUSSIAN["pw/t"])
    schedule = process.schedule
    x_t = motions(GAUSSIAN["f64/pw/x_t" if dtype == torch.float64 else "pw/x_t"], dtype)
    noise = motions(GAUSSIAN["step/noise"][["p_sample", *DDIM_STEPS].index(case)], dtype)
    denoise = linear_denoiser(GAUSSIAN["lin4/A"], GAUSSIAN["lin4/b"], float(GAUSSIAN["lin4/g"]))
    x0_hat = denoise(x_t, t.float(), ones(x_t), NO_CONDITION)
    stepped = []
    for x, x0, drawn_noise, i in zip(x_t, x0_hat, noise, t.tolist(), strict=True):
        draw = drawn_noise if i else None
        if case == "p_sample":
            stepped.append(ancestral_step(x, x0, process.log_variance(x0, x, i, schedule), schedule, i, draw))
        else:
            stepped.append(ddim_step(x, x0, schedule, i, draw, eta=float(case.removeprefix("ddim_eta"))))
    x = torch.stack(stepped)
    assert_golden(GAUSSIAN, f"step/{case}", x)
    # The authors lose up to 5e-4 in float32 by rounding alpha before 1 - alpha; the coefficients here do not.
    exact = motions(GAUSSIAN[f"f64/step/{case}"])
    torch.testing.assert_close(x.float(), exact, rtol=0, atol=2e-6 * float(exact.abs().max()))


# MFM's own loops, over equal steps; all other methods are torchdiffeq's.
EULER = {"euler_raw": "euler", "euler_replacement_edit_till": "euler"}
FLOW_RUNS: dict[str, dict] = meta(MFM)["config"]["runs"]


def replay_flow_run(arrays: Arrays, case: str, denoise: Denoise, cond: Condition, **options: Any) -> None:
    """Samples as one of the authors' runs, and compares."""
    run = meta(arrays)["config"]["runs"][case]
    method: str = run.get("method", "euler")
    process = FlowMatching(meta(arrays)["sigma_min"], odeint_grid=method not in EULER, **options)
    start = motions(arrays["sample/x_init"])
    if run["on"] == "cfg":
        denoise = classifier_free_guidance(denoise, torch.from_numpy(arrays["in/scale"]), start.shape[-1])
    edit = None
    if "edit" in method:
        keep, known = motions(arrays["edit/inpainting_mask"]) > 0, motions(arrays["edit/inpainted_motion"])
        edit = Edit(known, keep, mode="trajectory", until=run.get("edit_till", 1.0))
    how = {"sampler": EULER.get(method, method), "num_inference_steps": round(1 / run.get("step_size", 0.1))}
    x = sample(process, denoise, recorded(start), cond=cond, edit=edit, **how)
    assert_golden(arrays, f"run/{case}", x)


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("mfm", [name for name, run in FLOW_RUNS.items() if run["on"] == "field"]))
def test_flow_run(case):
    seen = []

    def field(x_t, t, mask, cond):
        seen.append(t[0].item() / 1000)
        return flow_field(MFM)(x_t, t, mask, cond)

    replay_flow_run(MFM, case, field, NO_CONDITION)
    # Adaptive steps follow from errors near the rounding of float32, which differs between processors.
    tolerance = 0.03 if FLOW_RUNS[case].get("method") == "dopri5" else 1e-6
    np.testing.assert_allclose(seen, MFM[f"times/{case}"], rtol=0, atol=tolerance)


# Loops of the authors' networks ---------------------------------------------------------------------------------------


def built(released: Released) -> Denoise:
    network = instantiate(released.config, *released.features)
    network.load_state_dict(released.state)
    return network.eval().requires_grad_(False)


def released_flow(arrays: Arrays = MFM) -> tuple[Denoise, Condition]:
    """The fixture's network with its random weights, and its conditions, texts or actions, with their null."""
    released = import_mdm(weights(arrays), {"arch": "trans_enc"}, num_heads=meta(arrays)["config"]["heads"])
    if "in/action" in arrays:
        assert released.action_embedding is not None
        pooled = released.action_embedding[torch.from_numpy(arrays["in/action"]).flatten()]
    else:
        pooled = torch.from_numpy(arrays["in/text_embed"]).flatten(0, -2)
    tokens = torch.zeros(len(pooled), 0, pooled.shape[1])
    null = Condition(torch.zeros_like(pooled[:1]), tokens[:1], None)
    return built(released), Condition(pooled, tokens, None, null)


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("mfm", [name for name, run in FLOW_RUNS.items() if run["on"] != "field"]))
def test_flow_run_of_the_network(case):
    replay_flow_run(MFM, case, *released_flow(), quantize_time=True)


@pytest.mark.golden
@pytest.mark.parametrize("case", ["mfm-model"])
def test_flow_loss_of_the_network(case):
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
    pooled, tokens = torch.from_numpy(FLAME["lm/pooler_output"]), torch.from_numpy(FLAME["lm/last_hidden_state"])
    seen = torch.ones(tokens.shape[:2], dtype=torch.bool)  # the authors attend to the padding of the text
    null = Condition(pooled[-1:], tokens[-1:], seen[-1:])
    denoise = built(import_flame(weights(FLAME), num_heads=meta(FLAME)["config"]["heads"]))
    return denoise, Condition(pooled[:-1], tokens[:-1], seen[:-1], null)


@pytest.mark.golden
@pytest.mark.parametrize("case", cases("flame_text2motion", [*FLAME_LOOPS, "edit"]))
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
        edit = flame_edit(motions(FLAME["edit/ref_motion"][None]), config["edit_joints"], config["keep_trans"])
    process = GaussianDiffusion(total, clip_x0=True, **FLAME_OPTIONS)
    guided = classifier_free_guidance(denoise, config["scale"], start.shape[-1])
    how = {"sampler": KINDS[kind], "num_inference_steps": steps_of(section, total)}
    x = sample(process, guided, recorded(start, draws), cond=cond, edit=edit, **how)
    assert_golden(FLAME, f"out/{case}", x.transpose(1, 2))


@pytest.mark.golden
@pytest.mark.parametrize("case", ["flame_text2motion-loss"])
def test_flame_loss_of_the_network(case):
    denoise, cond = released_flame()
    x, noise = motions(FLAME["loss/x_start"]), motions(FLAME["loss/noise"])
    mask, t = length_mask(torch.from_numpy(FLAME["in/motion_length"]), x.shape[1]), torch.from_numpy(FLAME["loss/t"])
    process = GaussianDiffusion(meta(FLAME)["config"]["T_loss"], average_padding=True, **FLAME_OPTIONS)
    terms = process.loss(denoise, x * mask[..., None], mask, cond, t=t.float(), noise=noise)
    for name in ("mse", "vlb", "loss"):
        assert_golden(FLAME, f"out/loss_{name.replace('vlb', 'vb')}", terms[name])


def test_fixture_loops_are_all_replayed():
    assert groups(GAUSSIAN, "noise") != []
    replayed = {f"loop/{name}" for name in OPTIONS["mdm_loops"]} | {f"floop/{name}" for name in OPTIONS["flame_loops"]}
    assert {name for name in groups(GAUSSIAN, "out") if "loop/" in name and not name.startswith("f64/")} == replayed


# Oracles: what they return is the data, whatever the sampler and the number of steps ----------------------------------


@pytest.mark.parametrize("count", [2, 50])
@pytest.mark.parametrize("sampler", DIFFUSION)
@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
@pytest.mark.parametrize("variance", ["fixed_small", "fixed_large", "learned_range"])
def test_oracle_diffusion_returns_the_data(variance, prediction, sampler, count):
    torch.manual_seed(0)
    process = GaussianDiffusion(50, prediction=prediction, variance=variance)
    mask = length_mask(torch.tensor([6, 3]))
    data = torch.randn(2, 6, 4, dtype=torch.float64) * mask[..., None]
    denoise, estimates = CountedDenoise(oracle(process, data)), list[Tensor]()
    noise, how = drawn((2, 6, 4), torch.float64), {"sampler": sampler, "num_inference_steps": count}
    x = sample(process, denoise, noise, mask, trajectory=estimates, **how)
    torch.testing.assert_close(x, data, rtol=0, atol=1e-6)
    assert (x[~mask] == 0).all()
    assert denoise.calls == count == len(estimates)
    # At the noisiest steps float64 leaves 1e-9 of a signal of 1e-5 in doubt.
    torch.testing.assert_close(estimates[-1], data, rtol=0, atol=1e-6)


@pytest.mark.parametrize("prediction", ["velocity", "x0"])
@pytest.mark.parametrize("count", [1, 10])
@pytest.mark.parametrize("sampler", FlowMatching.samplers)
def test_oracle_flow_returns_the_data(sampler, count, prediction):
    torch.manual_seed(0)
    process = FlowMatching(sigma_min=1e-3, prediction=prediction)
    mask = length_mask(torch.tensor([6, 3]))
    data, noise = torch.randn(2, 2, 6, 4, dtype=torch.float64)
    data = data * mask[..., None]
    velocity = process.target(data, noise, torch.zeros(2))
    denoise, estimates = CountedDenoise(lambda x_t, t, mask, cond: velocity), list[Tensor]()
    how = {"sampler": sampler, "num_inference_steps": count}
    x = sample(process, denoise, recorded(noise), mask, trajectory=estimates, **how)
    # The path ends where its last noise has deviation sigma_min; every estimate on it is the data itself.
    torch.testing.assert_close(x, (data + 1e-3 * noise) * mask[..., None], rtol=0, atol=1e-5)
    for estimate in estimates:
        torch.testing.assert_close(estimate, data, rtol=0, atol=1e-5)
    assert len(estimates) == denoise.calls
    if sampler != "dopri5":
        assert denoise.calls == count * CALLS[sampler]


def gaussian_data(process: GaussianDiffusion, deviation: float) -> Denoise:
    """The exact clean estimate of data that is normal with mean 0.5 and this deviation."""

    def denoise(x_t, t, mask, cond):
        signal, noise = process.schedule.at("signal", t, x_t), process.schedule.at("noise", t, x_t)
        gain = signal * deviation**2 / (signal**2 * deviation**2 + noise**2)
        return 0.5 + gain * (x_t - 0.5 * signal)

    return denoise


@pytest.mark.parametrize("sampler", DIFFUSION)
def test_samples_have_the_distribution_of_the_data(sampler):
    process = GaussianDiffusion(1000)
    noise = drawn((1, 1, 4000), torch.float64)
    x = sample(process, gaussian_data(process, 0.3), noise, sampler=sampler, num_inference_steps=250)
    assert x.mean() == pytest.approx(0.5, abs=0.02)
    assert x.std() == pytest.approx(0.3, rel=0.05)


def test_order_of_diffusion_solvers():
    """Against the exact flow of normal data, which scales the start: DDIM is of order 1, DPM-Solver++ (2M) of 2."""
    process, noise = GaussianDiffusion(1000), drawn((1, 1, 100), torch.float64)
    signal, sigma = (process.schedule.tables[name][-1] for name in ("signal", "noise"))
    exact = 0.5 + 0.3 * (noise(0) - 0.5 * signal) / (signal**2 * 0.3**2 + sigma**2).sqrt()

    def error(sampler: str, count: int) -> float:
        x = sample(process, gaussian_data(process, 0.3), noise, sampler=sampler, num_inference_steps=count)
        return (x - exact).abs().mean().item()

    assert error("ddim", 100) / error("ddim", 200) == pytest.approx(2, abs=0.3)
    assert error("dpm_solver_pp_2m", 100) / error("dpm_solver_pp_2m", 200) > 3
    assert error("dpm_solver_pp_2m", 100) < error("ddim", 100) / 2


@pytest.mark.parametrize(("sampler", "order"), [("euler", 1), ("midpoint", 2), ("heun", 2), ("rk4", 4)])
def test_order_of_flow_solvers(sampler, order):
    def rotate(x, t, mask, cond):
        return (1 + t[:, None, None] / 1000) * torch.stack([-x[..., 1], x[..., 0]], -1)

    start = torch.tensor([[[1.0, 0.0]]], dtype=torch.float64)
    exact = torch.tensor([[[math.cos(1.5), math.sin(1.5)]]], dtype=torch.float64)

    def error(count: int) -> float:
        x = sample(FlowMatching(), rotate, recorded(start), sampler=sampler, num_inference_steps=count)
        return (x - exact).norm().item()

    assert math.log2(error(20) / error(40)) == pytest.approx(order, abs=0.3)


# Diffusers and torchdiffeq: their formulas of steps, not their choice of steps ----------------------------------------

MIXING = linear_denoiser(np.array([[0.3, -0.2], [0.1, 0.4]]), np.array([[0.2], [-0.1]]), 0.3)


def scheduler_options(process: GaussianDiffusion, prediction: str) -> dict:
    return {
        "num_train_timesteps": len(process.schedule),
        "trained_betas": process.schedule.tables["betas"].numpy(),
        "prediction_type": {"x0": "sample", "epsilon": "epsilon", "velocity": "v_prediction"}[prediction],
    }


def diffusers_loop(scheduler: Any, noise: Noise, **options: Any) -> Tensor:
    used, x = iter(range(1, 100)), noise(0)
    for t in scheduler.timesteps:
        output = MIXING(x, torch.tensor([float(t)]), ones(x), NO_CONDITION)
        if options.get("eta"):
            options["variance_noise"] = noise(next(used)) if t > 0 else torch.zeros_like(x)
        x = scheduler.step(output, t, x, return_dict=False, **options)[0]
    return x


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # theirs, under numpy 2
@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
@pytest.mark.parametrize("case", ["fixed_small", "fixed_large", "ddim 0.0", "ddim 0.7", "dpm"])
def test_samplers_agree_with_diffusers(case, prediction, monkeypatch):
    variance = case if case.startswith("fixed") else "fixed_small"
    process = GaussianDiffusion(1000, prediction=prediction, variance=variance)
    options, noise = scheduler_options(process, prediction), drawn((1, 3, 2), torch.float64)
    used = iter(range(1, 100))
    monkeypatch.setattr("diffusers.schedulers.scheduling_ddpm.randn_tensor", lambda *_, **__: noise(next(used)))
    steps: Any = [0, 30, 90, 250, 400, 401, 777, 950]
    if case.startswith("fixed"):
        scheduler: Any = DDPMScheduler(**options, variance_type=variance, clip_sample=False)
        how: dict[str, Any] = {"sampler": "ancestral"}
    elif case == "dpm":
        steps.remove(401)
        scheduler, how = (
            DPMSolverMultistepScheduler(**options, final_sigmas_type="zero"),
            {"sampler": "dpm_solver_pp_2m"},
        )
    else:
        more: dict[str, Any] = {"clip_sample": False, "set_alpha_to_one": True, "timestep_spacing": "leading"}
        scheduler, steps = DDIMScheduler(**options, **more), 20
        how = {"sampler": "ddim", "spacing": "stride", "eta": float(case.split(" ")[1])}
    scheduler.set_timesteps(steps) if steps == 20 else scheduler.set_timesteps(timesteps=steps[::-1])
    ours = sample(process, MIXING, noise, num_inference_steps=steps, **how)
    theirs = diffusers_loop(scheduler, noise, **({"eta": how["eta"]} if "eta" in how else {}))
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)  # theirs computes alpha products in float32


@pytest.mark.parametrize("sampler", CALLS)
def test_fixed_steps_agree_with_torchdiffeq(sampler):
    torch.manual_seed(0)
    field = linear_denoiser(np.random.default_rng(0).normal(size=(4, 4)), np.ones((4, 1)), 2.0)
    start = torch.randn(2, 5, 4, dtype=torch.float64)
    ours = sample(FlowMatching(), field, recorded(start), sampler=sampler, num_inference_steps=7)
    theirs = odeint(
        lambda t, x: field(x, 1000 * t.expand(2), ones(start), NO_CONDITION),
        start,
        torch.linspace(0, 1, 8, dtype=torch.float64),
        method={"heun": "heun2"}.get(sampler, sampler),
    )
    torch.testing.assert_close(ours, theirs[-1], rtol=1e-9, atol=1e-9)


# Editing --------------------------------------------------------------------------------------------------------------


def half_kept(x: Tensor) -> Tensor:
    keep = torch.zeros_like(x, dtype=torch.bool)
    keep[:, ::2] = True
    return keep


def pulled(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
    """A denoiser that wants all motion at 3 and sees the mean of each sample."""
    return 3 + 0.1 * x_t + 0.1 * x_t.mean((1, 2), keepdim=True)


def sampled(process: Process, sampler: str, edit: Edit | None) -> Tensor:
    return sample(process, pulled, drawn((2, 6, 3)), sampler=sampler, num_inference_steps=10, edit=edit)


EXACT = [*product([GaussianDiffusion], DIFFUSION, ["x0", "x_t"]), *product([FlowMatching], CALLS, ["x0"])]


@pytest.mark.parametrize(("build", "sampler", "mode"), EXACT)
def test_kept_parts_are_met_exactly_and_seen_by_the_rest(build, sampler, mode):
    known = torch.full((2, 6, 3), -2.0)
    keep = half_kept(known)
    free, edited = sampled(build(), sampler, None), sampled(build(), sampler, Edit(known, keep, mode))
    assert torch.equal(edited[keep], known[keep])
    assert edited.isfinite().all()
    # The denoiser sees the kept part, so the rest follows it downwards.
    assert edited[~keep].mean() < free[~keep].mean() - 0.05
    nothing = sampled(build(), sampler, Edit(known, torch.zeros_like(keep), mode, blend="before"))
    if mode == "x0" or sampler != "ancestral":  # blending uses up draws of the ancestral sampler
        torch.testing.assert_close(nothing, free)


def test_clipping_does_not_move_kept_parts():
    known = torch.full((2, 6, 3), -2.0)
    keep = half_kept(known)
    edited = sampled(GaussianDiffusion(clip_x0=True), "ancestral", Edit(known, keep, "x0"))
    assert torch.equal(edited[keep], known[keep])
    assert (edited[~keep] <= 1).all()


@pytest.mark.parametrize("sampler", ["ancestral", "ddim"])
def test_resampling_takes_every_noisy_step_again(sampler):
    process, count = GaussianDiffusion(), 6
    data = torch.randn(2, 6, 3, generator=torch.Generator().manual_seed(0))
    denoise = CountedDenoise(oracle(process, data))
    edit = Edit(data, half_kept(data), "x_t", resample=3)
    x = sample(process, denoise, drawn((2, 6, 3)), sampler=sampler, num_inference_steps=count, edit=edit)
    assert denoise.calls == 3 * (count - 1) + 1
    torch.testing.assert_close(x, data, rtol=0, atol=1e-4)


@pytest.mark.parametrize(("blend", "resample"), [("after", 1), ("before", 1), ("after", 2), ("before", 2)])
def test_blended_parts_are_as_noisy_as_the_rest(blend, resample):
    """What the denoiser sees of a kept part is the known motion, corrupted to exactly the step it is told.

    So is what it sees of the rest at the second visit of a step, if it knows the motion.
    """
    process, known = GaussianDiffusion(100), torch.full((1, 1, 4000), 2.0)
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append((int(t[0]), x_t))
        return known

    edit = Edit(known, torch.arange(4000).expand(1, 1, -1) < 2000, "x_t", blend=blend, resample=resample)
    how = {"sampler": "ancestral", "num_inference_steps": [0, 5, 15, 30, 60, 99]}
    sample(process, denoise, drawn((1, 1, 4000)), edit=edit, **how)
    assert len(seen) == 5 * resample + 1
    for number, (step, x_t) in enumerate(seen):
        signal, noise = (process.schedule.tables[name][step].item() for name in ("signal", "noise"))
        for part in (x_t[edit.keep], x_t[~edit.keep])[: 2 if number % resample else 1]:
            assert part.mean().item() == pytest.approx(2 * signal, abs=0.08)
            assert part.std().item() == pytest.approx(noise, rel=0.06)


@pytest.mark.parametrize("sampler", CALLS)
def test_rewriting_ends_at_its_threshold(sampler):
    start, known = torch.randn(1, 6, 3, generator=torch.Generator().manual_seed(0)), torch.full((1, 6, 3), -2.0)
    keep, count = half_kept(known), 25
    seen = []

    def still(x_t, t, mask, cond):
        seen.append((t[0].item() / 1000, x_t))
        return torch.zeros_like(x_t)

    edit = Edit(known, keep, "trajectory", until=0.2)
    sample(FlowMatching(), still, recorded(start), sampler=sampler, num_inference_steps=count, edit=edit)
    calls = seen[:: CALLS[sampler]]
    assert len(calls) == count
    for i, (time, x) in enumerate(calls):
        share = min(i, 5) / count
        assert time == pytest.approx(i / count)
        torch.testing.assert_close(x[keep], ((1 - share) * start + share * known)[keep])
        torch.testing.assert_close(x[~keep], start[~keep])


# Refusals and invariance ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("build", "options", "message"),
    [
        (GaussianDiffusion, {"sampler": "euler"}, "has ancestral, ddim, dpm_solver_pp_2m"),
        (GaussianDiffusion, {"num_inference_steps": 1}, "2 to 1000"),
        (GaussianDiffusion, {"num_inference_steps": 1001}, "1000"),
        (GaussianDiffusion, {"num_inference_steps": [5, 3]}, "increasing"),
        (GaussianDiffusion, {"num_inference_steps": [5, 1000]}, "999"),
        (GaussianDiffusion, {"eta": 1.0}, "eta=1.0: the sampler ancestral has no such option; it has guidance_scale"),
        (GaussianDiffusion, {"sampler": "ddim", "eta": 1.5}, "0 to 1"),
        (GaussianDiffusion, {"edit": {"mode": "trajectory"}}, "x0, x_t"),
        (GaussianDiffusion, {"edit": {"mode": "x_t", "known": torch.zeros(1, 5, 2)}}, "^edit does not match the shape"),
        (GaussianDiffusion, {"edit": {"mode": "x_t", "blend": "never"}}, "^edit has blend=never"),
        (GaussianDiffusion, {"edit": {"mode": "x_t", "resample": 0}}, "^edit has .*resample=0"),
        (GaussianDiffusion, {"sampler": "dpm_solver_pp_2m", "edit": {"mode": "x_t", "resample": 2}}, "without history"),
        (FlowMatching, {"sampler": "ddim"}, "has euler, midpoint, heun, rk4, dopri5"),
        (FlowMatching, {"sampler": "euler", "num_inference_steps": 0}, "from 1 to"),
        (FlowMatching, {"sampler": "euler", "edit": {"mode": "x_t"}}, "trajectory, x0"),
        (FlowMatching, {"sampler": "euler", "eta": 0.5}, "eta=0.5: the sampler euler has no such option"),
        (FlowMatching, {"sampler": "euler", "spacing": "stride"}, "spacing=stride: the sampler euler has no such"),
        (FlowMatching, {"sampler": "euler", "num_inference_steps": [0, 2]}, "a number of equal steps"),
        (FlowMatching, {"sampler": "dopri5", "edit": {"mode": "x0"}}, "cannot edit: choose from euler, midpoint"),
        (FlowMatching, {"sampler": "euler", "guidance_scale": math.nan}, "guidance_scale=nan is not a finite number"),
        (FlowMatching, {"spacing": "even"}, "spacing=even is unknown: choose from linspace, stride"),
        (FlowMatching, {"num_inference_steps": [0, 1.5]}, "give a number of steps, or a list"),
        (FlowMatching, {"sampler": 3}, "sampler=3: give the name"),
    ],
)
def test_the_impossible_is_refused_in_one_line(build, options, message):
    known = torch.zeros(1, 4, 2)
    options = {"sampler": "ancestral", "num_inference_steps": 5} | options
    if "edit" in options:
        options["edit"] = Edit(**({"known": known, "keep": half_kept(known)} | options["edit"]))
    with pytest.raises(UserError, match=message) as error:
        sample(build(), pulled, drawn((1, 4, 2)), **options)
    assert "\n" not in str(error.value)


def test_options_over_defaults():
    recipe = SamplerOptions(guidance_scale=2.5, sampler="ddim", num_inference_steps=[0, 2, 5])
    options = SamplerOptions(sampler="ancestral", eta=0.0).over(recipe)
    expected = {"guidance_scale": 2.5, "sampler": "ancestral", "num_inference_steps": [0, 2, 5], "eta": 0.0}
    assert options.chosen() == expected


@pytest.mark.parametrize(("build", "sampler"), [*product([GaussianDiffusion], DIFFUSION), (FlowMatching, "rk4")])
def test_padding_changes_no_real_frame(build, sampler):
    """With noise drawn for each sample at its own length and a denoiser that respects the mask."""

    def denoise(x_t, t, mask, cond):
        mean = (x_t * mask[..., None]).sum(1, keepdim=True) / mask.sum(1)[:, None, None]
        return torch.where(mask[..., None], 0.5 * x_t + mean, 1e4)

    def run(frames: int) -> Tensor:
        padding, real = torch.full((1, frames - 4, 3), 7.0), drawn((1, 4, 3))
        mask = length_mask(torch.tensor([4]), frames)
        noise: Noise = lambda draw: torch.cat([real(draw), padding], 1)  # noqa: E731
        return sample(build(), denoise, noise, mask, sampler=sampler, num_inference_steps=6)

    assert (run(9)[:, 4:] == 0).all()
    torch.testing.assert_close(run(9)[:, :4], run(4))


RUNS_WITHOUT_DATA = [
    *product([GaussianDiffusion], DIFFUSION, [None, "x0", "x_t"]),
    *product([FlowMatching], CALLS, [None, "x0", "trajectory"]),
]


@pytest.mark.parametrize(("build", "sampler", "mode"), RUNS_WITHOUT_DATA)
def test_no_loop_waits_for_the_device(build, sampler, mode):
    """Tensors on the meta device have no values: a loop that read one would fail."""
    x = torch.zeros(2, 6, 3, device="meta")
    edit = None if mode is None else Edit(x, x > 0, mode)
    how = {"sampler": sampler, "num_inference_steps": 5}
    x = sample(build(), pulled, lambda draw: torch.zeros_like(x), edit=edit, trajectory=[], **how)
    assert x.shape == (2, 6, 3)


@pytest.mark.parametrize("sampler", DIFFUSION)
def test_half_precision_denoisers_are_sampled_in_float32(sampler):
    def run(denoise: Denoise) -> Tensor:
        return sample(GaussianDiffusion(), denoise, drawn((1, 4, 2)), sampler=sampler, num_inference_steps=5)

    half = run(lambda x_t, t, mask, cond: x_t.bfloat16())
    assert torch.equal(half, run(lambda x_t, t, mask, cond: x_t.bfloat16().float()))
    assert half.dtype == torch.float32
