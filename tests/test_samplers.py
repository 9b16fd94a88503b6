"""Every sampler of both processes: against the authors' loops, diffusers and torchdiffeq, and against an oracle."""

import json
import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from diffusers.schedulers.scheduling_ddpm import DDPMScheduler
from diffusers.schedulers.scheduling_dpmsolver_multistep import DPMSolverMultistepScheduler
from hydra.utils import instantiate
from support.analytic import NO_CONDITION, assert_golden, flow_field, linear_denoiser, motions, spaced
from support.fixtures import Arrays, golden, groups, meta
from torch import Tensor
from torchdiffeq import odeint

from flame_mdm.batch import Condition, Denoise, Edit, Noise, length_mask
from flame_mdm.checkpoints.released import Released, import_flame, import_mdm
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import STEPS, FlowMatching
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.samplers import CountedDenoise, ancestral_step, ddim_step

GAUSSIAN, MFM = golden("gaussian"), golden("mfm")
OPTIONS = meta(GAUSSIAN)["options"]
PRECISIONS = [pytest.param(torch.float32, id="f32"), pytest.param(torch.float64, id="f64")]
DIFFUSION = ["ancestral", "ddim", "dpm_solver_pp_2m"]
CALLS = {"euler": 1, "midpoint": 2, "heun": 2, "rk4": 4}


def replay(first: Tensor, rest: Sequence[Tensor] | Tensor) -> Noise:
    """Noise from recorded draws; asking for more of them is an error."""
    return lambda draw: first if draw == 0 else rest[draw - 1]


def drawn(shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> Noise:
    """Noise that depends on the number of the draw alone."""
    return lambda draw: torch.randn(shape, generator=torch.Generator().manual_seed(draw), dtype=dtype)


def steps_of(section: str | list[int], total: int) -> list[int]:
    return spaced(total, section if isinstance(section, str) else ",".join(map(str, section)))


def ones(x: Tensor) -> Tensor:
    return torch.ones(x.shape[:2], dtype=torch.bool)


def skipped(case: str, options: dict[str, Any]) -> int:
    """How many of the noisiest steps a loop leaves out: MDM's `skip_timesteps`."""
    named = re.search(r"skip(\d+)", case)
    return int(options.get("skip_timesteps") or options.get("skip") or (named[1] if named else 0))


def replay_mdm_loop(arrays: Arrays, case: str, dtype: torch.dtype = torch.float32) -> None:
    """Samples as one of the authors' loops of `meta.options.mdm_loops`, and compares."""
    total, section, kind, options = meta(arrays)["options"]["mdm_loops"][case]
    unknown = options.keys() - {
        "eta",
        "inpaint",
        "skip_timesteps",
        "skip",
        "init_image",
        "init",
        "const_noise",
        "const",
    }
    assert not unknown, f"{case}: options that the product does not have"
    process = GaussianDiffusion(num_train_timesteps=total)
    x_T, steps = motions(arrays["loop/x_T"], dtype), steps_of(section, total)
    draws = [motions(noise, dtype) for noise in arrays[f"loop/{case}/noise"]]
    if options.get("const_noise") or options.get("const") or "const_noise" in case:  # of the steps, not of the start
        draws = [noise[:1].expand_as(noise) for noise in draws]
    edit = None
    skip = skipped(case, options)
    if skip or options.get("inpaint"):
        start = next((key for key in (f"loop/{case}/init_image", "loop/init_image") if key in arrays), "")
        edit = Edit(
            motions(arrays["loop/inpainted_motion" if options.get("inpaint") or not start else start], dtype),
            torch.zeros_like(x_T, dtype=torch.bool),
            mode="x0",
            strength=(len(steps) - skip) / len(steps) if skip else None,
        )
    if edit is not None and options.get("inpaint"):
        edit.keep = motions(arrays["loop/inpainting_mask"]) > 0
    x = process.sample(
        linear_denoiser(arrays["loop/lin4/A"], arrays["loop/lin4/b"], float(arrays["lin4/g"])),
        replay(x_T, draws),
        ones(x_T),
        NO_CONDITION,
        sampler={"ddpm": "ancestral", "ddim": "ddim"}[kind],
        num_inference_steps=steps,
        edit=edit,
        eta=options.get("eta", 0.0),
    )
    assert_golden(arrays, f"loop/{case}/out", x)
    if edit is not None:
        torch.testing.assert_close(x[edit.keep], edit.known[edit.keep], rtol=0, atol=1e-12)


@pytest.mark.golden
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("case", [pytest.param(name, id=f"gaussian-{name}") for name in OPTIONS["mdm_loops"]])
def test_mdm_loop(case, dtype):
    replay_mdm_loop(GAUSSIAN, case, dtype)


def numpy_loop(
    arrays: Arrays, total: int, steps: list[int], draws: np.ndarray, start: np.ndarray, eta: float
) -> np.ndarray:
    """The way from `start`, as noisy as the last of `steps`, in numpy; DDPM where eta is 1 (Song et al. 2021, eq. 12).

    `arrays` holds the linear denoiser that returns the clean motion, of `total` steps; a draw is used after each step.
    """
    ends = np.cos((np.arange(total + 1) / total + 0.008) / 1.008 * np.pi / 2) ** 2
    signal = np.cumprod(np.maximum(ends[1:] / ends[:-1], 0.001))[steps]
    before = np.append(1.0, signal[:-1])
    x = start
    for i, noise in zip(reversed(range(len(steps))), draws, strict=False):
        mixed = np.einsum("jk,bkfl->bjfl", arrays["loop/lin4/A"], x) + arrays["loop/lin4/b"][:, :, None]
        x0 = mixed + arrays["lin4/g"] * steps[i] / 1000
        epsilon = (x - signal[i] ** 0.5 * x0) / (1 - signal[i]) ** 0.5
        variance = eta**2 * (1 - before[i]) / (1 - signal[i]) * (1 - signal[i] / before[i])
        x = before[i] ** 0.5 * x0 + (1 - before[i] - variance) ** 0.5 * epsilon + variance**0.5 * noise
    return x


def stand_in(case: str, section: str | list[int], **options: Any) -> Arrays:
    """A fixture in the layout of gaussian.npz with one loop of T = 30, or of 1000 for a section by name."""
    rng, shape, total = np.random.default_rng(7), (3, 4, 2, 5), 1000 if isinstance(section, str) else section[0]
    kind = "ddim" if "eta" in options else "ddpm"
    arrays: Arrays = {
        "loop/lin4/A": rng.normal(size=(4, 4)) / 4,
        "loop/lin4/b": rng.normal(size=(4, 2)) / 4,
        "lin4/g": np.array(0.3),
        "loop/x_T": rng.normal(size=shape),
        "loop/inpainted_motion": rng.normal(size=shape),
        f"loop/{case}/noise": rng.normal(size=(30, *shape)),
        "meta": np.array(
            json.dumps(
                {
                    "options": {"mdm_loops": {case: [total, section, kind, options]}},
                    "max_abs_diff_f32_vs_f64": {},
                }
            )
        ),
    }
    steps, draws, x = steps_of(section, total), arrays[f"loop/{case}/noise"], arrays["loop/x_T"]
    if skip := skipped(case, options):
        steps = steps[:-skip]
        level = np.cos((np.arange(total + 1) / total + 0.008) / 1.008 * np.pi / 2) ** 2
        level = level[steps[-1] + 1] / level[0]
        x = level**0.5 * arrays["loop/inpainted_motion"] + (1 - level) ** 0.5 * x
    if "const_noise" in case:
        draws = np.repeat(draws[:, :1], shape[0], 1)
    arrays[f"loop/{case}/out"] = numpy_loop(arrays, total, steps, draws, x, options.get("eta", 1.0))
    return arrays


@pytest.mark.parametrize(
    ("case", "section", "options"),
    [
        ("ddpm_T30_skip12_init", [30], {"skip_timesteps": 12, "init_image": True}),
        ("ddpm_T30_skip12_init", [30], {}),
        ("ddpm_T30_const_noise", [30], {"const_noise": True}),
        ("ddpm_T30_skip12_const_noise", [30], {}),
        ("ddim_T1000_fast27", "fast27", {"eta": 0.0}),
        ("ddim_T1000_10", "10", {"eta": 0.5}),
    ],
)
def test_loops_are_replayed_as_their_options_say(case, section, options):
    replay_mdm_loop(stand_in(case, section, **options), case)


def test_section_names():
    assert spaced(1000, "1") == [0]
    steps = spaced(1000, "fast27")
    assert (len(steps), steps[-1]) == (27, 997)
    assert steps[:-1] == spaced(1000, "10,10,3,2,2")[:-1]


@pytest.mark.golden
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("case", [pytest.param(name, id=f"gaussian-{name}") for name in OPTIONS["flame_loops"]])
def test_flame_loop(case, dtype):
    options = OPTIONS["flame_loops"][case]
    process = GaussianDiffusion(options["T"], prediction="epsilon", variance="learned_range", clip_x0=True)
    x_T = motions(GAUSSIAN["floop/x_T"], dtype)
    edit = None
    if "edit" in options:
        joints, keep_translation = options["edit"]
        keep = torch.ones_like(x_T, dtype=torch.bool)
        keep[..., :3] = keep_translation
        keep[..., 3:].unflatten(-1, (-1, 6))[..., joints, :] = False
        known = motions(GAUSSIAN["floop/ref_motion"], dtype).expand_as(x_T)
        edit = Edit(known, keep, mode="x_t", blend="before")
    x = process.sample(
        linear_denoiser(GAUSSIAN["floop/A"], GAUSSIAN["floop/b"][:, None], float(GAUSSIAN["lin4/g"])),
        replay(x_T, [motions(noise, dtype) for noise in GAUSSIAN[f"floop/{case}/noise"]]),
        ones(x_T),
        NO_CONDITION,
        sampler={"ddpm": "ancestral", "ddim": "ddim"}[options["kind"]],
        num_inference_steps=steps_of(options["sec"], options["T"]),
        edit=edit,
    )
    assert_golden(GAUSSIAN, f"floop/{case}/out", x)


DDIM_STEPS = sorted(key.removeprefix("step/") for key in GAUSSIAN if key.startswith("step/ddim_eta"))


@pytest.mark.golden
@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("case", ["p_sample", *DDIM_STEPS], ids=lambda case: f"gaussian-{case}")
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
ANALYTIC_RUNS = [name for name, run in meta(MFM)["config"]["runs"].items() if run["on"] == "field"]


@pytest.mark.golden
@pytest.mark.parametrize("case", [pytest.param(name, id=f"mfm-{name}") for name in ANALYTIC_RUNS])
def test_flow_run(case):
    run = meta(MFM)["config"]["runs"][case]
    method: str = run.get("method", "euler")
    process = FlowMatching(sigma_min=meta(MFM)["sigma_min"], odeint_grid=method not in EULER)
    seen = []

    def field(x_t, t, mask, cond):
        seen.append(t[0].item() / 1000)
        return flow_field(MFM)(x_t, t, mask, cond)

    start = motions(MFM["sample/x_init"])
    edit = None
    if "edit" in method:
        keep = motions(MFM["edit/inpainting_mask"]) > 0
        known = motions(MFM["edit/inpainted_motion"])
        edit = Edit(known, keep, mode="trajectory", until=run.get("edit_till", 1.0))
    x = process.sample(
        field,
        replay(start, []),
        ones(start),
        NO_CONDITION,
        sampler=EULER.get(method, method),
        num_inference_steps=round(1 / run.get("step_size", 0.1)),
        edit=edit,
    )
    assert_golden(MFM, f"run/{case}", x)
    # Adaptive steps follow from errors near the rounding of float32.
    np.testing.assert_allclose(seen, MFM[f"times/{case}"], rtol=0, atol=2e-4 if method == "dopri5" else 1e-6)


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


def weights(arrays: Arrays) -> dict[str, Tensor]:
    return {key.removeprefix("state/"): torch.from_numpy(v) for key, v in arrays.items() if key.startswith("state/")}


def built(released: Released) -> Denoise:
    network = instantiate(released.config, *released.features)
    network.load_state_dict(released.state)
    return network.eval().requires_grad_(False)


NETWORK_RUNS = [name for name, run in meta(MFM)["config"]["runs"].items() if run["on"] != "field"]


@pytest.mark.golden
@pytest.mark.parametrize("case", [pytest.param(name, id=f"mfm-{name}") for name in NETWORK_RUNS])
def test_flow_run_of_the_network(case):
    replay_flow_run(MFM, case)


def replay_flow_run(arrays: Arrays, case: str) -> None:
    """Samples with the fixture's network as one of the authors' runs, and compares."""
    run = meta(arrays)["config"]["runs"][case]
    method: str = run.get("method", "euler")
    process = FlowMatching(meta(arrays)["sigma_min"], quantize_time=True, odeint_grid=method not in EULER)
    denoise, cond = released_flow(arrays)
    start, features = (
        motions(arrays["sample/x_init"]),
        arrays["sample/x_init"].shape[1] * arrays["sample/x_init"].shape[2],
    )
    if run["on"] == "cfg":
        denoise = classifier_free_guidance(denoise, torch.from_numpy(arrays["in/scale"]), features)
    edit = None
    if "edit" in method:
        keep, known = motions(arrays["edit/inpainting_mask"]) > 0, motions(arrays["edit/inpainted_motion"])
        edit = Edit(known, keep, mode="trajectory", until=run.get("edit_till", 1.0))
    count = round(1 / run.get("step_size", 0.1))
    x = process.sample(
        denoise, replay(start, []), ones(start), cond,
        sampler=EULER.get(method, method), num_inference_steps=count, edit=edit,
    )  # fmt: skip
    assert_golden(arrays, f"run/{case}", x)


ACTIONS = golden("mdm_action_rot6d")


def test_flow_runs_of_action_models_are_replayed():
    """A fixture of MFM with actions and 25 x 6 rotations, made of MDM's network for actions by steps in numpy."""
    count, scale, x = 4, 2.5, ACTIONS["in/x_t"]
    run = {"on": "cfg", "step_size": 1 / count, "method": "euler_raw"}
    config = {"heads": meta(ACTIONS)["config"]["num_heads"], "runs": {"raw_cfg": run}}
    arrays = ACTIONS | {
        "sample/x_init": x,
        "in/scale": np.full(len(x), scale, np.float32),
        "meta": np.array(json.dumps({"config": config, "sigma_min": 1e-4, "max_abs_diff_f32_vs_f64": {}})),
    }
    released = import_mdm(weights(ACTIONS), {"arch": "trans_enc"}, num_heads=config["heads"])
    assert released.action_embedding is not None
    network, label = built(released), released.action_embedding[torch.from_numpy(ACTIONS["in/action"])[:, 0]]
    tokens = torch.zeros(len(x), 0, label.shape[1])
    for i in range(count):
        inputs = motions(x)
        time = torch.full((len(x),), float(1000 * i // count))
        conditional, null = (
            network(inputs, time, ones(inputs), Condition(pooled, tokens, None))
            .transpose(1, 2)
            .reshape(x.shape)
            .numpy()
            for pooled in (label, torch.zeros_like(label))
        )
        x = x + (null + scale * (conditional - null)) / count
    replay_flow_run(arrays | {"run/raw_cfg": x}, "raw_cfg")


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
@pytest.mark.parametrize(
    "case", [pytest.param(name, id=f"flame_text2motion-{name}") for name in [*FLAME_LOOPS, "edit"]]
)
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
        keep = torch.ones_like(start, dtype=torch.bool)
        keep[..., :3] = config["keep_trans"]
        keep[..., 3:].unflatten(-1, (-1, 6))[..., config["edit_joints"], :] = False
        edit = Edit(motions(FLAME["edit/ref_motion"][None]), keep, mode="x_t", blend="before")
    x = GaussianDiffusion(total, clip_x0=True, **FLAME_OPTIONS).sample(
        classifier_free_guidance(denoise, config["scale"], start.shape[-1]), replay(start, draws), ones(start), cond,
        sampler={"ddpm": "ancestral", "ddim": "ddim"}[kind], num_inference_steps=steps_of(section, total), edit=edit,
    )  # fmt: skip
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


# What an oracle returns has to be the data, whatever the sampler and the number of steps.


def oracle(process: GaussianDiffusion | FlowMatching, x: Tensor, learned: bool = False) -> Denoise:
    """The denoiser that knows the data, from which the noise in x_t follows."""

    def denoise(x_t, t, mask, cond):
        if isinstance(process, FlowMatching):
            time = t / 1000
            noise = (x_t - time[:, None, None] * x) / (1 - (1 - process.sigma_min) * time[:, None, None])
            return process.target(x, noise, time)
        noise = (x_t - process.schedule.at("signal", t, x_t) * x) / process.schedule.at("noise", t, x_t)
        output = process.target(x, noise, t)
        return torch.cat([output, torch.zeros_like(output)], -1) if learned else output

    return denoise


@pytest.mark.parametrize("count", [2, 5, 50])
@pytest.mark.parametrize("sampler", DIFFUSION)
@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
@pytest.mark.parametrize("variance", ["fixed_small", "fixed_large", "learned_range"])
def test_oracle_diffusion_returns_the_data(variance, prediction, sampler, count):
    torch.manual_seed(0)
    process = GaussianDiffusion(50, prediction=prediction, variance=variance)
    mask = length_mask(torch.tensor([6, 3]))
    data = torch.randn(2, 6, 4, dtype=torch.float64) * mask[..., None]
    denoise = CountedDenoise(oracle(process, data, learned=variance == "learned_range"))
    estimates: list[Tensor] = []
    x = process.sample(
        denoise, drawn((2, 6, 4), torch.float64), mask, NO_CONDITION,
        sampler=sampler, num_inference_steps=count, trajectory=estimates,
    )  # fmt: skip
    torch.testing.assert_close(x, data, rtol=0, atol=1e-6)
    assert (x[~mask] == 0).all()
    assert denoise.calls == count == len(estimates)
    # At the noisiest steps float64 leaves 1e-9 of a signal of 1e-5 in doubt.
    torch.testing.assert_close(estimates[-1], data, rtol=0, atol=1e-6)


@pytest.mark.parametrize("prediction", ["velocity", "x0"])
@pytest.mark.parametrize("count", [1, 10])
@pytest.mark.parametrize("sampler", [*STEPS, "dopri5"])
def test_oracle_flow_returns_the_data(sampler, count, prediction):
    torch.manual_seed(0)
    process = FlowMatching(sigma_min=1e-3, prediction=prediction)
    mask = length_mask(torch.tensor([6, 3]))
    data, noise = torch.randn(2, 2, 6, 4, dtype=torch.float64)
    data = data * mask[..., None]
    velocity = process.target(data, noise, torch.zeros(2))
    denoise = CountedDenoise(lambda x_t, t, mask, cond: velocity)
    estimates: list[Tensor] = []
    x = process.sample(
        denoise, replay(noise, []), mask, NO_CONDITION,
        sampler=sampler, num_inference_steps=count, trajectory=estimates,
    )  # fmt: skip
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


@pytest.mark.parametrize("count", [250, 1000])
@pytest.mark.parametrize("sampler", DIFFUSION)
def test_samples_have_the_distribution_of_the_data(sampler, count):
    process = GaussianDiffusion(1000)
    x = process.sample(
        gaussian_data(process, 0.3), drawn((1, 1, 4000), torch.float64), torch.ones(1, 1, dtype=torch.bool),
        NO_CONDITION, sampler=sampler, num_inference_steps=count,
    )  # fmt: skip
    assert x.mean() == pytest.approx(0.5, abs=0.02)
    assert x.std() == pytest.approx(0.3, rel=0.05)


def test_order_of_diffusion_solvers():
    """Against the exact flow of normal data, which scales the start: DDIM is of order 1, DPM-Solver++ (2M) of 2."""
    process, noise = GaussianDiffusion(1000), drawn((1, 1, 100), torch.float64)
    signal, sigma = (process.schedule.tables[name][-1] for name in ("signal", "noise"))
    exact = 0.5 + 0.3 * (noise(0) - 0.5 * signal) / (signal**2 * 0.3**2 + sigma**2).sqrt()

    def error(sampler: str, count: int) -> float:
        x = process.sample(
            gaussian_data(process, 0.3), noise, torch.ones(1, 1, dtype=torch.bool), NO_CONDITION,
            sampler=sampler, num_inference_steps=count,
        )  # fmt: skip
        return (x - exact).abs().mean().item()

    assert error("ddim", 100) / error("ddim", 200) == pytest.approx(2, abs=0.3)
    assert error("dpm_solver_pp_2m", 100) / error("dpm_solver_pp_2m", 200) > 3
    assert error("dpm_solver_pp_2m", 100) < error("ddim", 100) / 2


# Other people's code. Its step formulas are sound where we compare; its choice of steps is not used.


def scheduler_options(process: GaussianDiffusion, prediction: str) -> dict:
    return {
        "num_train_timesteps": len(process.schedule),
        "trained_betas": process.schedule.tables["betas"].numpy(),
        "prediction_type": {"x0": "sample", "epsilon": "epsilon", "velocity": "v_prediction"}[prediction],
    }


@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
@pytest.mark.parametrize("variance", ["fixed_small", "fixed_large"])
def test_ancestral_agrees_with_diffusers(variance, prediction, monkeypatch):
    process = GaussianDiffusion(1000, prediction=prediction, variance=variance)
    scheduler = DDPMScheduler(**scheduler_options(process, prediction), variance_type=variance, clip_sample=False)
    steps = [0, 90, 400, 401, 777, 950]
    scheduler.set_timesteps(timesteps=steps[::-1])
    noise, used = drawn((1, 3, 2), torch.float64), iter(range(1, 100))
    monkeypatch.setattr("diffusers.schedulers.scheduling_ddpm.randn_tensor", lambda *_, **__: noise(next(used)))
    denoise = linear_denoiser(np.array([[0.3, -0.2], [0.1, 0.4]]), np.array([[0.2], [-0.1]]), 0.3)
    mask = torch.ones(1, 3, dtype=torch.bool)
    x = noise(0)
    for t in scheduler.timesteps:
        output = denoise(x, torch.tensor([float(t)]), mask, NO_CONDITION)
        x = scheduler.step(output, int(t), x, return_dict=False)[0]
    ours = process.sample(denoise, noise, mask, NO_CONDITION, sampler="ancestral", num_inference_steps=steps)
    # Theirs computes alpha products in float32.
    torch.testing.assert_close(ours, x, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
@pytest.mark.parametrize("eta", [0.0, 0.7])
def test_ddim_agrees_with_diffusers(eta, prediction):
    process = GaussianDiffusion(1000, prediction=prediction)
    scheduler = DDIMScheduler(
        **scheduler_options(process, prediction), clip_sample=False, set_alpha_to_one=True, timestep_spacing="leading"
    )
    scheduler.set_timesteps(20)
    steps = sorted(scheduler.timesteps.tolist())
    noise, used = drawn((1, 3, 2), torch.float64), iter(range(1, 100))
    denoise = linear_denoiser(np.array([[0.3, -0.2], [0.1, 0.4]]), np.array([[0.2], [-0.1]]), 0.3)
    mask = torch.ones(1, 3, dtype=torch.bool)
    x = noise(0)
    for t in scheduler.timesteps:
        output = denoise(x, torch.tensor([float(t)]), mask, NO_CONDITION)
        variance_noise = noise(next(used)) if eta and t > 0 else torch.zeros_like(x)
        x = scheduler.step(output, int(t), x, eta=eta, variance_noise=variance_noise, return_dict=False)[0]
    ours = process.sample(
        denoise, noise, mask, NO_CONDITION, sampler="ddim", num_inference_steps=20, spacing="stride", eta=eta
    )
    assert steps == process._steps(20, "stride")
    torch.testing.assert_close(ours, x, rtol=1e-4, atol=1e-4)


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # theirs, under numpy 2
@pytest.mark.parametrize("prediction", ["x0", "epsilon", "velocity"])
def test_dpm_solver_agrees_with_diffusers(prediction):
    process = GaussianDiffusion(1000, prediction=prediction)
    scheduler = DPMSolverMultistepScheduler(**scheduler_options(process, prediction), final_sigmas_type="zero")
    steps = [0, 30, 90, 250, 400, 600, 777, 950]
    scheduler.set_timesteps(timesteps=steps[::-1])
    denoise = linear_denoiser(np.array([[0.3, -0.2], [0.1, 0.4]]), np.array([[0.2], [-0.1]]), 0.3)
    mask, noise = torch.ones(1, 3, dtype=torch.bool), drawn((1, 3, 2), torch.float64)
    x = noise(0)
    for t in scheduler.timesteps:
        output = denoise(x, torch.tensor([float(t)]), mask, NO_CONDITION)
        x = scheduler.step(output, t, x, return_dict=False)[0]
    ours = process.sample(denoise, noise, mask, NO_CONDITION, sampler="dpm_solver_pp_2m", num_inference_steps=steps)
    torch.testing.assert_close(ours, x, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("sampler", STEPS)
def test_fixed_steps_agree_with_torchdiffeq(sampler):
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    field = linear_denoiser(rng.normal(size=(4, 4)), np.ones((4, 1)), 2.0)
    start, mask = torch.randn(2, 5, 4, dtype=torch.float64), torch.ones(2, 5, dtype=torch.bool)
    ours = FlowMatching().sample(field, replay(start, []), mask, NO_CONDITION, sampler=sampler, num_inference_steps=7)
    theirs = odeint(
        lambda t, x: field(x, 1000 * t.expand(2), mask, NO_CONDITION),
        start,
        torch.linspace(0, 1, 8, dtype=torch.float64),
        method={"heun": "heun2"}.get(sampler, sampler),
    )
    torch.testing.assert_close(ours, theirs[-1], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("sampler", "order"), [("euler", 1), ("midpoint", 2), ("heun", 2), ("rk4", 4)])
def test_order_of_convergence(sampler, order):
    def rotate(x, t, mask, cond):
        return (1 + t[:, None, None] / 1000) * torch.stack([-x[..., 1], x[..., 0]], -1)

    start, mask = torch.tensor([[[1.0, 0.0]]], dtype=torch.float64), torch.ones(1, 1, dtype=torch.bool)
    exact = torch.tensor([[[math.cos(1.5), math.sin(1.5)]]], dtype=torch.float64)

    def error(count: int) -> float:
        flow = FlowMatching()
        x = flow.sample(rotate, replay(start, []), mask, NO_CONDITION, sampler=sampler, num_inference_steps=count)
        return (x - exact).norm().item()

    assert math.log2(error(20) / error(40)) == pytest.approx(order, abs=0.3)


# Editing.


def half_kept(x: Tensor) -> Tensor:
    keep = torch.zeros_like(x, dtype=torch.bool)
    keep[:, ::2] = True
    return keep


def pulled(x: Tensor) -> Denoise:
    """A denoiser that wants all motion at 3 and sees the mean of each sample."""
    return lambda x_t, t, mask, cond: 3 + 0.1 * x_t + 0.1 * x_t.mean((1, 2), keepdim=True)


def sampled(process: GaussianDiffusion | FlowMatching, sampler: str, edit: Edit | None, count: int = 10) -> Tensor:
    shape = (2, 6, 3)
    return process.sample(
        pulled(torch.zeros(shape)), drawn(shape), torch.ones(shape[:2], dtype=torch.bool), NO_CONDITION,
        sampler=sampler, num_inference_steps=count, edit=edit,
    )  # fmt: skip


EXACT: list[tuple[Callable[[], GaussianDiffusion | FlowMatching], str, str]] = [
    *((GaussianDiffusion, sampler, mode) for sampler in DIFFUSION for mode in ("x0", "x_t")),
    *((FlowMatching, sampler, "x0") for sampler in STEPS),
]


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
    keep = half_kept(data)
    denoise = CountedDenoise(oracle(process, data))
    edit = Edit(data, keep, "x_t", resample=3)
    x = process.sample(
        denoise, drawn((2, 6, 3)), torch.ones(2, 6, dtype=torch.bool), NO_CONDITION,
        sampler=sampler, num_inference_steps=count, edit=edit,
    )  # fmt: skip
    assert denoise.calls == 3 * (count - 1) + 1
    torch.testing.assert_close(x, data, rtol=0, atol=1e-4)


@pytest.mark.parametrize("blend", ["after", "before"])
def test_blended_parts_are_as_noisy_as_the_rest(blend):
    """What the denoiser sees of a kept part is the known motion, corrupted to exactly the step it is told."""
    process, known = GaussianDiffusion(100), torch.full((1, 1, 4000), 2.0)
    seen = {}

    def denoise(x_t, t, mask, cond):
        seen[int(t[0])] = (x_t.mean().item(), x_t.std().item())
        return torch.zeros_like(x_t)

    process.sample(
        denoise, drawn((1, 1, 4000)), torch.ones(1, 1, dtype=torch.bool), NO_CONDITION, sampler="ancestral",
        num_inference_steps=[0, 5, 15, 30, 40], edit=Edit(known, known > 0, "x_t", blend=blend),
    )  # fmt: skip
    assert len(seen) == 5
    for step, (mean, deviation) in seen.items():
        signal, noise = (process.schedule.tables[name][step].item() for name in ("signal", "noise"))
        assert mean == pytest.approx(2 * signal, abs=0.06)
        assert deviation == pytest.approx(noise, rel=0.05)


def test_resampling_goes_back_to_the_noise_of_the_step():
    """What is not kept, of data all 2 and known to the denoiser, is as noisy at the second visit of a step."""
    process, data = GaussianDiffusion(100), torch.full((1, 1, 4000), 2.0)
    seen = []

    def denoise(x_t, t, mask, cond):
        seen.append((int(t[0]), x_t.mean().item(), x_t.std().item()))
        return data

    process.sample(
        denoise, drawn((1, 1, 4000)), torch.ones(1, 1, dtype=torch.bool), NO_CONDITION, sampler="ancestral",
        num_inference_steps=10, edit=Edit(data, torch.zeros_like(data, dtype=torch.bool), "x_t", resample=2),
    )  # fmt: skip
    assert len(seen) == 19
    for step, mean, deviation in seen:
        signal, noise = (process.schedule.tables[name][step].item() for name in ("signal", "noise"))
        assert mean == pytest.approx(2 * signal, abs=0.08)
        assert deviation == pytest.approx(noise, rel=0.06)


@pytest.mark.parametrize("sampler", STEPS)
def test_rewriting_ends_at_its_threshold(sampler):
    start, known = torch.randn(1, 6, 3, generator=torch.Generator().manual_seed(0)), torch.full((1, 6, 3), -2.0)
    keep, count = half_kept(known), 25
    seen = []

    def still(x_t, t, mask, cond):
        seen.append((t[0].item() / 1000, x_t))
        return torch.zeros_like(x_t)

    process = FlowMatching()
    process.sample(
        still, replay(start, []), torch.ones(1, 6, dtype=torch.bool), NO_CONDITION,
        sampler=sampler, num_inference_steps=count, edit=Edit(known, keep, "trajectory", until=0.2),
    )  # fmt: skip
    calls = seen[:: CALLS[sampler]]
    assert len(calls) == count
    for i, (time, x) in enumerate(calls):
        share = min(i, 5) / count
        assert time == pytest.approx(i / count)
        torch.testing.assert_close(x[keep], ((1 - share) * start + share * known)[keep])
        torch.testing.assert_close(x[~keep], start[~keep])


@pytest.mark.parametrize(
    ("build", "options", "message"),
    [
        (GaussianDiffusion, {"sampler": "euler"}, "has ancestral, ddim, dpm_solver_pp_2m"),
        (GaussianDiffusion, {"num_inference_steps": 1}, "2 to 1000"),
        (GaussianDiffusion, {"num_inference_steps": 1001}, "1000"),
        (GaussianDiffusion, {"num_inference_steps": [5, 3]}, "increasing"),
        (GaussianDiffusion, {"num_inference_steps": [5, 1000]}, "999"),
        (GaussianDiffusion, {"eta": 1.0}, "ddim"),
        (GaussianDiffusion, {"sampler": "ddim", "eta": 1.5}, "0 to 1"),
        (GaussianDiffusion, {"edit": "trajectory"}, "x0, x_t"),
        (FlowMatching, {"sampler": "ddim"}, "has euler, midpoint, heun, rk4, dopri5"),
        (FlowMatching, {"sampler": "euler", "num_inference_steps": 0}, "at least 1"),
        (FlowMatching, {"sampler": "euler", "edit": "x_t"}, "trajectory, x0"),
        (FlowMatching, {"sampler": "euler", "eta": 0.5}, "eta=0.5: a flow takes equal steps without noise"),
        (FlowMatching, {"sampler": "euler", "spacing": "stride"}, "spacing=stride"),
        (FlowMatching, {"sampler": "euler", "num_inference_steps": [0, 2]}, "a number of equal steps"),
        (FlowMatching, {"sampler": "dopri5", "edit": "x0"}, "cannot edit"),
    ],
)
def test_the_impossible_is_refused_in_one_line(build, options, message):
    known = torch.zeros(1, 4, 2)
    options = {"sampler": "ancestral", "num_inference_steps": 5} | options
    if "edit" in options:
        options["edit"] = Edit(known, half_kept(known), mode=options["edit"])
    with pytest.raises(ValueError, match=message) as error:
        build().sample(pulled(known), drawn((1, 4, 2)), torch.ones(1, 4, dtype=torch.bool), NO_CONDITION, **options)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("change", [{"known": torch.zeros(1, 5, 2)}, {"blend": "never"}, {"resample": 0}])
def test_edits_that_do_not_fit_are_refused(change):
    known = torch.zeros(1, 4, 2)
    edit = Edit(**({"known": known, "keep": half_kept(known), "mode": "x_t"} | change))
    with pytest.raises(ValueError, match=r"^edit "):
        GaussianDiffusion().sample(
            pulled(known), drawn((1, 4, 2)), torch.ones(1, 4, dtype=torch.bool), NO_CONDITION,
            sampler="ancestral", num_inference_steps=5, edit=edit,
        )  # fmt: skip


@pytest.mark.parametrize(
    ("build", "sampler"), [(GaussianDiffusion, name) for name in DIFFUSION] + [(FlowMatching, "rk4")]
)
def test_padding_changes_no_real_frame(build, sampler):
    """With noise drawn for each sample at its own length and a denoiser that respects the mask."""

    def denoise(x_t, t, mask, cond):
        mean = (x_t * mask[..., None]).sum(1, keepdim=True) / mask.sum(1)[:, None, None]
        return torch.where(mask[..., None], 0.5 * x_t + mean, 1e4)

    def noise(frames: int) -> Noise:
        def draw(number: int) -> Tensor:
            real = drawn((1, 4, 3))(number)
            return torch.cat([real, torch.full((1, frames - 4, 3), 7.0)], 1)

        return draw

    def run(frames: int) -> Tensor:
        mask = length_mask(torch.tensor([4]), frames)
        return build().sample(denoise, noise(frames), mask, NO_CONDITION, sampler=sampler, num_inference_steps=6)

    assert (run(9)[:, 4:] == 0).all()
    torch.testing.assert_close(run(9)[:, :4], run(4))


RUNS_WITHOUT_DATA = [
    *((GaussianDiffusion, sampler, mode) for sampler in DIFFUSION for mode in (None, "x0", "x_t")),
    *((FlowMatching, sampler, mode) for sampler in STEPS for mode in (None, "x0", "trajectory")),
]


@pytest.mark.parametrize(("build", "sampler", "mode"), RUNS_WITHOUT_DATA)
def test_no_loop_waits_for_the_device(build, sampler, mode):
    """Tensors on the meta device have no values: a loop that read one would fail."""
    x = torch.zeros(2, 6, 3, device="meta")
    mask = torch.ones(2, 6, dtype=torch.bool, device="meta")
    edit = None if mode is None else Edit(x, x > 0, mode)
    sample = build().sample(
        pulled(x), lambda draw: torch.zeros_like(x), mask, NO_CONDITION,
        sampler=sampler, num_inference_steps=5, edit=edit, trajectory=[],
    )  # fmt: skip
    assert sample.shape == x.shape


@pytest.mark.parametrize("sampler", DIFFUSION)
def test_half_precision_denoisers_are_sampled_in_float32(sampler):
    def sample(denoise: Denoise) -> Tensor:
        mask = torch.ones(1, 4, dtype=torch.bool)
        return GaussianDiffusion().sample(
            denoise, drawn((1, 4, 2)), mask, NO_CONDITION, sampler=sampler, num_inference_steps=5
        )

    half = sample(lambda x_t, t, mask, cond: x_t.bfloat16())
    assert torch.equal(half, sample(lambda x_t, t, mask, cond: x_t.bfloat16().float()))
    assert half.dtype == torch.float32


def test_fixture_loops_are_all_replayed():
    assert groups(GAUSSIAN, "noise") != []
    replayed = {f"loop/{name}" for name in OPTIONS["mdm_loops"]} | {f"floop/{name}" for name in OPTIONS["flame_loops"]}
    assert {name for name in groups(GAUSSIAN, "out") if "loop/" in name and not name.startswith("f64/")} == replayed
