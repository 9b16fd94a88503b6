"""Values of processes, samplers, denoisers, generators and training tasks, as recorded."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from support.recorded import Case, check, combinations, record
from test_recorded_core import CPU, Shift, condition, numbers, refusal
from torch import Tensor, nn

from flame_mdm import task as task_module
from flame_mdm.batch import Condition, Denoise, Edit, MotionBatch, length_mask
from flame_mdm.conditions import ConditionEncoder, Unconditional
from flame_mdm.conditions.action import ActionLabels
from flame_mdm.denoisers import layers
from flame_mdm.denoisers.flame import FLAME, cosine_first_sinusoid
from flame_mdm.denoisers.gru import MDMGRU
from flame_mdm.denoisers.mdm import MDMDecoder, MDMEncoder, condition_tokens
from flame_mdm.denoisers.recomputation import recompute_activations, stacked_layers
from flame_mdm.denoisers.target_encoders import TARGET_ENCODERS, perceptron
from flame_mdm.denoisers.unet import MaskedGroupNorm, MDMUNet, ResidualBlock
from flame_mdm.generator import (
    Blocks,
    DistilledGenerator,
    MotionGenerator,
    Parts,
    joined,
    sampling_defaults,
    sizes_of_denoiser,
)
from flame_mdm.processes import Process, guidance, samplers, schedules, windows
from flame_mdm.processes.consistency import consistency_terms
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.representations import Representation
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.task import GeneratorTask, Task

NAME = "core_more"
BATCH, FRAMES, FEATURES = 3, 6, 4
MASK = length_mask(torch.tensor([4, 6, 1]))
STEPS = 12


def attempt(call: Callable[[], Any]) -> Any:
    """The result of a call, or the text of its error."""
    try:
        return call()
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def motion(seed: int = 0) -> Tensor:
    """Random features, with other numbers in the padding."""
    return numbers(seed, BATCH, FRAMES, FEATURES)


def conditions(seed: int = 1) -> Condition:
    return condition(BATCH, 4, seed, null=condition(1, 2, seed + 2))


def network(process: Process, calls: list[Any] | None = None) -> Denoise:
    """A bounded function of the noisy motion, the time and the condition."""
    weights = 0.7 * numbers(3, FEATURES, process.out_features(FEATURES))

    def denoise(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        if calls is not None:
            calls.append(t[0].item())
        past = torch.cat([x_t[:, :1], x_t[:, :-1]], 1) * mask[..., None]
        shift = cond.pooled.mean(1)[:, None, None] + 0.01 * t[:, None, None]
        return torch.tanh((x_t + 0.3 * past) @ weights + shift)

    return denoise


def every_process() -> dict[str, Process]:
    options: dict[str, dict[str, Any]] = {
        "x0": {"min_snr": 2.0}, "epsilon": {"prediction": "epsilon", "schedule": "linear"},
        "velocity": {"prediction": "velocity", "min_snr": 0.8, "noise_scale": 2.5},
        "skip": {"prediction": "epsilon", "skip": True, "clip_x0": True},
        "weighted": {"prediction": "epsilon", "min_snr": 5.0, "average_padding": True},
        "learned": {"variance": "learned_range", "vlb_weight": 0.3, "clip_x0": True},
        "learned noise": {"variance": "learned_range", "prediction": "epsilon"},
        "learned without bound": {"variance": "learned_range", "vlb_weight": 0.0},
        "large": {"variance": "fixed_large", "prediction": "velocity"},
    }  # fmt: skip
    flows: dict[str, dict[str, Any]] = {
        "flow": {}, "flow to x0": {"prediction": "x0", "sigma_min": 0.1},
        "flow in the middle": {"time_distribution": "logit_normal", "sigma_min": 0.3},
        "quantized flow": {"quantize_time": True, "odeint_grid": True, "sigma_min": 0.05},
    }  # fmt: skip
    return {
        **{name: GaussianDiffusion(STEPS, **chosen) for name, chosen in options.items()},
        **{name: FlowMatching(**chosen) for name, chosen in flows.items()},
    }


# Processes


def noisy_motions_and_targets() -> Any:
    x, noise, u = motion(10), motion(11), torch.tensor([0.001, 0.43, 0.9999]).double()
    results = {}
    for name, process in every_process().items():
        t = process.training_times(u)
        output = numbers(12, BATCH, FRAMES, process.out_features(FEATURES))
        x_t = process.corrupt(x, noise, t)
        results[name] = {
            "times": [t, process.table_time(t), process.training_times(torch.ones(1) - 1e-9)],
            "x_t": list(x_t), "target": list(process.target(x, noise, t)),
            "x0": list(process.to_x0(output, x_t, t)),
            "back": process.to_x0(process.target(x, noise, t), x_t, t),
            "grids": [process.grid(steps) for steps in (1, 5, 12, 13)],
            "clean": process.clean(network(process), x_t, t, MASK, conditions()),
            "facts": [
                process.prediction, process.edit_modes, list(process.samplers),
                process.average_padding, process.out_features(7), len(list(process.parameters())),
            ],
        }  # fmt: skip
    return results


def training_losses() -> Any:
    x, noise = motion(13), motion(14)

    def auxiliary(x0_hat: Tensor, x: Tensor, mask: Tensor) -> dict[str, Tensor]:
        return {"extra": (x0_hat * mask[..., None]).sum((1, 2)), "more": x.abs().amax((1, 2))}

    results = {}
    for name, process in every_process().items():
        denoise, cond = network(process), conditions()
        losses = []
        for u in ([0.01, 0.1, 0.2], [0.4, 0.6, 0.8], [0.9, 0.97, 0.999]):
            t = process.training_times(torch.tensor(u).double())
            losses.append(process.loss(denoise, x, MASK, cond, t=t, noise=noise))
        torch.manual_seed(3)
        losses.append(process.loss(denoise, x, MASK, cond, noise=noise, auxiliary=auxiliary))
        losses.append(process.loss(denoise, x, MASK, cond, auxiliary=auxiliary))
        results[name] = losses
    return results


def variances_and_bounds() -> Any:
    x, x_t = motion(15), motion(16)
    results = []
    for variance in ("fixed_small", "fixed_large", "learned_range"):
        process = GaussianDiffusion(STEPS, variance=variance)
        output = numbers(17, BATCH, FRAMES, process.out_features(FEATURES)).requires_grad_()
        respaced = process.schedule.respace([0, 4, 9])
        t = torch.tensor([0.0, 3.0, 11.0])
        bound = process.vlb(output, x, x_t, t)
        gradient = None
        if variance == "learned_range":
            (gradient,) = torch.autograd.grad(bound.sum(), output)
        results.append(
            [
                process.log_variance(output, x_t, t, process.schedule),
                [process.log_variance(output, x_t, i, respaced) for i in (0, 1, 2)],
                bound, gradient,
            ]
        )  # fmt: skip
    return results


def refused_processes() -> Any:
    options = [
        {"num_train_timesteps": 1}, {"num_train_timesteps": 2}, {"num_train_timesteps": 100_001},
        {"skip": True}, {"skip": True, "prediction": "velocity"}, {"min_snr": 0.0},
        {"min_snr": -1.0}, {"min_snr": float("inf")}, {"min_snr": 1e-3}, {"noise_scale": 0.0},
        {"noise_scale": float("inf")}, {"noise_scale": float("nan")}, {"noise_scale": 0.01},
    ]  # fmt: skip
    sigmas = (-1e-9, 0.0, 0.999, 1.0, 2.0)
    defaults = GaussianDiffusion()
    return [
        [refusal(lambda chosen=chosen: GaussianDiffusion(**chosen)) for chosen in options],
        [refusal(lambda sigma=sigma: FlowMatching(sigma)) for sigma in sigmas],
        [len(defaults.schedule), defaults.prediction, defaults.variance, defaults.vlb_weight],
        [defaults.clip_x0, defaults.skip, defaults.min_snr, defaults.schedule.number("signal", 500)],
        [vars(FlowMatching())[name] for name in ("sigma_min", "prediction", "time_distribution")],
        [FlowMatching().quantize_time, FlowMatching().odeint_grid],
    ]  # fmt: skip


def tables_of_schedules() -> Any:
    results = []
    for name, total, scale in (
        ("cosine", 12, 1.0), ("linear", 12, 1.0), ("linear", 500, 1.0), ("cosine", 50, 4.0),
        ("linear", 25, 0.5), ("cosine", 2, 1.0), ("cosine", 1000, 1.0), ("linear", 2, 3.0),
    ):  # fmt: skip
        schedule = schedules.build_schedule(name, total, scale)
        last, middle = total - 1, total // 2
        results.append(
            [
                {
                    key: [schedule.number(key, i) for i in (0, 1, middle, last)]
                    for key in schedule.tables
                },
                schedule.tables, [schedule.log_snr(i) for i in (0, middle, last)], len(schedule),
                {key: schedule.respace([0, middle, last]).numbers[key] for key in ("betas", "noise")},
            ]
        )  # fmt: skip
    return results


def coefficients_of_batches() -> Any:
    schedule, x, x0 = schedules.build_schedule("cosine", STEPS), motion(18), motion(19)
    t = torch.tensor([0.0, 5.9, 11.0])
    kinds = (torch.float64, torch.float32, torch.bfloat16, torch.float64)
    return {
        "at": [schedule.at(name, t, x.to(kind)) for kind in kinds for name in ("signal", "noise")],
        "precision": [str(schedule.at("signal", t, x.to(kind)).dtype) for kind in kinds],
        "factor": [schedule.factor("betas", i, x) for i in (3, t)],
        "corrupted": [schedule.corrupt(x, x0, i) for i in (7, t)],
        "means": [schedule.posterior_mean(x0, x, i) for i in (7, 0, t)],
    }


def selected_steps() -> Any:
    return [
        attempt(lambda a=total, b=number, c=spacing: schedules.timesteps(a, b, *c))
        for spacing in ((), ("linspace",), ("stride",))
        for total in (4, 12, 50, 1000)
        for number in (0, 1, 2, 3, 4, 5, 8, 11, 12, 25, 50)
    ]


def sampled(process: Process, options: SamplerOptions, edit: Edit | None = None) -> Any:
    """Samples, and everything that sampling passes to and asks of its arguments."""
    calls: list[Any] = []
    draws: list[int] = []

    def noise(draw: int) -> Tensor:
        draws.append(draw)
        return motion(500 + draw)

    trajectory: list[Tensor] = []
    arguments = (network(process, calls), noise, MASK, conditions(), options)
    x = process.sample(*arguments, edit=edit, trajectory=trajectory)
    without = process.sample(*arguments, edit=edit)
    return [list(x), without, calls[: len(calls) // 2], len(draws), draws[-1], trajectory[::2]]


def edit_of(options: Mapping[str, Any], seed: int = 20) -> Edit:
    known, keep = motion(seed), motion(seed + 1) > 0.3
    return Edit(known, keep, **options)


def diffusion_samples() -> Any:
    settings = [
        {"sampler": "ancestral", "num_inference_steps": 5}, {"sampler": "ancestral", "num_inference_steps": 12},
        {"sampler": "ancestral", "num_inference_steps": 4, "spacing": "stride"},
        {"sampler": "ddim", "num_inference_steps": 5}, {"sampler": "ddim", "num_inference_steps": [0, 3, 7, 10]},
        {"sampler": "ddim", "num_inference_steps": 6, "spacing": "stride", "eta": 0.7},
        {"sampler": "ddim", "num_inference_steps": 4, "eta": 1.0},
        {"sampler": "dpm_solver_pp_2m", "num_inference_steps": 6},
        {"sampler": "dpm_solver_pp_2m", "num_inference_steps": [1, 2, 6, 11]},
        {"sampler": "consistency", "num_inference_steps": 1}, {"sampler": "consistency", "num_inference_steps": 5},
    ]  # fmt: skip
    diffusion = {
        name: process
        for name, process in every_process().items()
        if isinstance(process, GaussianDiffusion)
    }
    return [
        (name, chosen, sampled(process, SamplerOptions(**chosen)))
        for number, (name, process) in enumerate(diffusion.items())
        for chosen in settings[number % 2 :: 2]
    ]


def edited_diffusion_samples() -> Any:
    processes = every_process()
    results = []
    for options in combinations(
        2, 34, process=("x0", "epsilon", "learned", "velocity"),
        sampler=("ancestral", "ddim", "dpm_solver_pp_2m", "consistency"), mode=("x0", "x_t"),
        blend=("after", "before"), resample=(1, 1, 3), strength=(None, 0.5, 0.1), guide=(False, True),
    ):  # fmt: skip
        chosen = dict(options)
        process, sampler = processes[chosen.pop("process")], chosen.pop("sampler")
        edit = edit_of(chosen | {"guide": Shift() if chosen["guide"] else None})
        settings = SamplerOptions(sampler=sampler, num_inference_steps=4)
        results.append((options, attempt(lambda: sampled(process, settings, edit))))  # noqa: B023
    return results


def flow_samples() -> Any:
    processes = every_process()
    results = []
    for options in combinations(
        3, 44, process=("flow", "flow to x0", "flow in the middle", "quantized flow"),
        sampler=("euler", "midpoint", "heun", "rk4", "consistency"), steps=(1, 3, 5, 6),
        mode=(None, "x0", "trajectory", "x0"), strength=(None, None, 0.5), guide=(False, True),
        until=(0.2, 0.5),
    ):  # fmt: skip
        chosen = dict(options)
        process, sampler = processes[chosen.pop("process")], chosen.pop("sampler")
        settings = SamplerOptions(sampler=sampler, num_inference_steps=chosen.pop("steps"))
        guide = Shift() if chosen.pop("guide") else None
        edit = None if chosen["mode"] is None else edit_of(chosen | {"guide": guide})
        results.append((options, attempt(lambda: sampled(process, settings, edit))))  # noqa: B023
    plain = edit_of({"mode": "trajectory"})
    settings = SamplerOptions(sampler="euler", num_inference_steps=5)
    results.append(sampled(processes["flow"], settings, plain))
    results.append(sampled(FlowMatching(sigma_min=0.0, odeint_grid=True), settings))
    return results


def adaptive_flow_samples() -> Any:
    options = SamplerOptions(sampler="dopri5", num_inference_steps=7)
    results = []
    for name in ("flow", "flow to x0"):
        process = every_process()[name]
        calls: list[Any] = []
        smooth = network(process, calls)
        x = process.sample(smooth, lambda draw: motion(30 + draw), MASK, conditions(), options)
        results.append([list(x), len(calls) > 6])
    return results


def steps_of_samplers() -> Any:
    schedule, x = schedules.build_schedule("cosine", 5), motion(31)

    def run(log_variance: Tensor | float, **options: Any) -> samplers.Descent:
        draws = (motion(32 + number) for number in count())
        chosen = SamplerOptions(**options)
        estimate: samplers.Estimate = lambda x, i: (x.tanh() + 0.1 * i, log_variance)  # noqa: E731
        return samplers.Descent(estimate, schedule, draws, chosen)

    solver = run(0.0)
    flow = samplers.Flow(lambda x, t: x.sin() + t, (motion(33) for _ in count()), 0.2)
    return {
        "ancestral": [
            samplers.ancestral(x, run(value), i) for value in (-1.5, motion(34)) for i in (4, 1, 0)
        ],
        "ddim": [
            samplers.ddim(x, run(0.0, **chosen), i)
            for chosen in ({}, {"eta": 0.0}, {"eta": 0.4}, {"eta": 1.0}) for i in (4, 1, 0)
        ],
        "solver": [samplers.dpm_solver_pp_2m(x, solver, i) for i in (4, 3, 2, 1, 0)],
        "consistency": [samplers.consistency(x, run(0.0), i) for i in (4, 1, 0)],
        "flow": [
            step(x, flow, begin, end)
            for step in (samplers.euler, samplers.midpoint, samplers.heun, samplers.rk4,
                samplers.dopri5, samplers.consistency_flow)
            for begin, end in ((0.0, 0.3), (0.6, 1.0))
        ],
        "tables": [
            {name: [s.options, s.unsupported, s.adaptive, s.step.__name__] for name, s in table.items()}
            for table in (samplers.DIFFUSION_SAMPLERS, samplers.FLOW_SAMPLERS)
        ],
        "tolerance": samplers.TOLERANCE * 1e5,
    }  # fmt: skip


def refused_samples() -> Any:
    diffusion, flow = GaussianDiffusion(STEPS), FlowMatching()
    requests: list[dict[str, Any]] = [
        {}, {"sampler": "euler"}, {"sampler": "ddim"}, {"sampler": "heun", "eta": 0.5},
        {"sampler": "ancestral", "eta": 0.5}, {"sampler": "euler", "spacing": "stride"},
        {"sampler": "consistency", "spacing": "linspace"}, {"sampler": "ddim", "num_inference_steps": 1},
        {"sampler": "ddim", "num_inference_steps": 13}, {"sampler": "ddim", "num_inference_steps": [3]},
        {"sampler": "ddim", "num_inference_steps": [3, 2]}, {"sampler": "ddim", "num_inference_steps": [3, 3]},
        {"sampler": "ddim", "num_inference_steps": [3, 12]}, {"sampler": "ddim", "num_inference_steps": [0, 11]},
        {"sampler": "euler", "num_inference_steps": [0, 1]}, {"sampler": "rk4", "num_inference_steps": 1},
        {"sampler": "consistency", "num_inference_steps": 13}, {"sampler": "consistency", "num_inference_steps": 12},
        {"sampler": "ddim", "num_inference_steps": 5, "spacing": "stride"},
        {"sampler": "ddim", "num_inference_steps": 12, "guidance_scale": 3.0},
    ]  # fmt: skip
    edits = [
        Edit(motion(), motion() > 0, mode="trajectory"), Edit(motion(), motion() > 0, mode="x_t"),
        Edit(motion()[:2], motion() > 0), Edit(motion()[:, :5], motion()[:, :5] > 0),
        Edit(motion(), motion() > 0, resample=2), Edit(motion(), motion() > 0, mode="x_t", resample=2),
        Edit(motion()[..., :2], motion()[..., :2] > 0),
    ]  # fmt: skip
    chosen = [("ddim", diffusion), ("dpm_solver_pp_2m", diffusion), ("consistency", diffusion)]
    chosen += [("euler", flow), ("dopri5", flow), ("consistency", flow)]
    return {
        "options": [
            str(attempt(lambda p=process, r=request: sampled(p, SamplerOptions(**r))[2]))
            for process in (diffusion, flow) for request in requests
        ],
        "edits": [
            attempt(lambda p=process, e=edit, s=name: p.check_edit(e, MASK, SamplerOptions(sampler=s)))
            for name, process in chosen for edit in edits
        ],
    }  # fmt: skip


def consistency_losses() -> Any:
    results = []
    for name in ("x0", "velocity", "flow", "flow to x0"):
        process = every_process()[name]
        times = torch.tensor(process.grid(4)).double()
        networks = [network(process) for _ in range(3)]

        def scaled(factor: float, base: Denoise = networks[0]) -> Denoise:
            return lambda x_t, t, mask, cond: factor * base(x_t, t, mask, cond)

        results += [
            consistency_terms(
                process, scaled(1.0), scaled(1.2), scaled(0.7), motion(35), MASK, conditions(),
                times=times, index=torch.tensor(index), noise=motion(36),
                auxiliary=lambda a, b, mask: {"extra": ((a - 2 * b) * mask[..., None]).sum((1, 2))},
            )
            for index in ([0, 1, 2], [3, 2, 0], [3, 3, 3])
        ]  # fmt: skip
    return results


# Guidance and windows


def guided_denoisers() -> Any:
    results = []
    for number, process in enumerate((GaussianDiffusion(STEPS, variance="learned_range"), FlowMatching())):
        denoise = network(process)
        for scale in (1, 1.0, 0.0, 2.5, -1.0, torch.tensor([0.5, 1.0, 4.0]), torch.ones(3)):
            guided = guidance.classifier_free_guidance(denoise, scale, FEATURES)
            t = torch.tensor([3.0, 0.0, 11.0])
            results.append(
                [
                    guided(motion(37), t, MASK, conditions()), guided(motion(38), t, ~MASK, conditions()),
                    guided(motion(38), t, ~MASK, conditions(40 + number)),
                    guided(motion(37), t, MASK, conditions()), guided is denoise,
                ]
            )
    same = guidance.classifier_free_guidance(network(FlowMatching()), 2.0, FEATURES)
    cond, other, t = conditions(), conditions(41), torch.zeros(3)
    order = [(MASK, cond), (MASK, other), (~MASK, other), (~MASK, cond), (MASK, cond), (MASK, cond)]
    return results, [same(motion(39), t, mask, chosen) for mask, chosen in order]


def to_joints(x: Tensor) -> Tensor:
    """Positions of three joints that depend nonlinearly on six features."""
    first = x[..., :3] * 0.5
    angle, lift = x[..., 3:4], x[..., 4:6]
    bone = torch.cat([angle.cos(), angle.sin(), 0.2 * lift[..., :1]], -1)
    tip = bone + torch.cat([lift, (lift[..., :1] * angle).sin()], -1) * 0.4
    return torch.stack([first, first + bone, first + bone + tip], -2)


def steered_motions() -> Any:
    x_t = numbers(42, 3, 8, 6)
    clean: Callable[[Tensor], Tensor] = lambda x: (x * 0.6).tanh() + 0.1 * x.roll(1, 1)  # noqa: E731
    results = []
    for scale in (0.05, 1.0, 30.0):
        positions = guidance.Positions(
            torch.tensor([0, 3, 7, 7]), torch.tensor([0, 2, 1, 2]), torch.tensor([1, 0, 2, 1]),
            scale * numbers(43, 4),
        )  # fmt: skip
        moved = guidance.steer(clean, x_t, to_joints, positions)
        results.append([list(moved), (moved - x_t) * 10, positions.of(to_joints(x_t))])
    steps = [guidance.STEERING_STEPS, guidance.STEERING_LIMIT, guidance.CLOSE, guidance.MOST_STEPS]
    return results, steps


def reached_positions() -> Any:
    x = 0.4 * numbers(44, 2, 9, 6).float()  # the kernel is float32
    free = numbers(45, 2, 9, 6) > -1.5
    bones = torch.tensor([[frame, *edge] for frame in (2, 3, 6) for edge in ((0, 1), (1, 2))]).T
    positions = guidance.Positions(
        torch.tensor([2, 3, 6]), torch.tensor([2, 0, 1]), torch.tensor([0, 2, 1]),
        to_joints(x)[0, [2, 3, 6], [2, 0, 1], [0, 2, 1]] + torch.tensor([0.2, -0.15, 0.1]),
    )  # fmt: skip
    none = torch.zeros(3, 0, dtype=torch.long)
    results = [
        guidance.reach(x, to_joints, positions, chosen, may, smoothness)
        for chosen, may, smoothness in (
            (bones, free, 1.5), (bones, free | True, 0.7), (none, free, 2.5), (bones[:, :2], free, 1.5)
        )
    ]
    lengths = numbers(46, 9, 2).float().abs() * 0.2 + 1.0
    edges = torch.tensor([[0, 1], [1, 2]])
    closer = guidance._with_bones(x[0], to_joints, edges, lengths, free[0])
    near = guidance._with_bones(x[0], to_joints, edges, lengths, free[0] & (numbers(47, 9, 6) > 0))
    return [[list(result), (result - x) * 10] for result in results], closer - x[0], near - x[0]


def windows_of_motions() -> Any:
    spans = [
        windows.spans(lengths, longest, overlap, **options)
        for lengths in ([10, 10], [7], [25, 3, 18], [40], [5, 60, 11])
        for longest, overlap in ((16, 4), (20, 6), (12, 0))
        for options in ({}, {"loop": True})
    ]
    parts = [(0, 0, 12), (0, 8, 12), (1, -2, 9), (1, 5, 10), (1, 12, 7), (2, 0, 5)]
    totals = [20, 17, 5]
    results = []
    for overlap, width in ((4, 12), (2, 14), (6, 12)):
        cover = windows.cover(parts, totals, overlap, width, CPU)

        def denoise(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
            shown = torch.where(mask[..., None], x_t, 100.0)
            return torch.cat([shown + t[:, None, None], shown * cond.pooled[:, None, :1]], -1)

        blend = windows.blended(denoise, cover)
        blended = blend(
            numbers(48, 3, 20, 2), torch.tensor([1.0, 2.0, 3.0]).double(), length_mask(torch.tensor(totals)),
            condition(6, 0, 49),
        )  # fmt: skip
        results.append(
            [
                cover.rows, cover.frames, cover.weights, *cover.weights, cover.batch.mask,
                cover.batch.ids, list(cover.batch.x.shape), list(blended), str(blended.dtype),
            ]
        )  # fmt: skip
    return spans, results


# Denoisers


def with_weights(module: nn.Module, seed: int = 0, scale: float = 0.4) -> Any:
    """A module in float64 with random weights, for sampling."""
    module = module.double().eval()
    for number, parameter in enumerate(module.parameters()):
        parameter.data = scale * numbers(900 + seed + number, *parameter.shape)
    return module


def seen_by_denoisers(width: int, tokens: int = 4) -> tuple[Tensor, Tensor, Tensor, Condition]:
    token_mask = length_mask(torch.tensor([2, 4, 3]).clamp(max=tokens), tokens)
    cond = Condition(
        numbers(50, BATCH, width), numbers(51, BATCH, tokens, width), token_mask,
        prefix=numbers(52, BATCH, 2, FEATURES), target=numbers(53, BATCH, 8, 4),
        target_mask=torch.tensor([True, False, True]),
    )  # fmt: skip
    return motion(54), torch.tensor([0.0, 7.5, 999.0]).double(), MASK, cond


BASE = {"latent_dim": 8, "ff_size": 10, "num_layers": 2, "num_heads": 2, "dropout": 0.1}


def outputs_of(kind: type[Any], width: int, options: Mapping[str, Any]) -> Any:
    """The output and the facts of a denoiser, with padding of other content and length."""
    denoiser = with_weights(kind(FEATURES, 5, width, **options))
    x_t, t, mask, cond = seen_by_denoisers(width)
    output = denoiser(x_t, t, mask, cond)
    other = denoiser(torch.where(mask[..., None], x_t, 9.0), t, mask, cond)
    return [
        [row[:4] for row in output], output[:, -1], other, denoiser.mask_padding,
        denoiser.context_frames, denoiser(x_t[1:2], t[:1], mask[1:2], cond.select(torch.tensor([1]))),
        {name: list(weight.shape) for name, weight in denoiser.named_parameters() if "layers" not in name},
    ]  # fmt: skip


def attempts(kind: type[Any], chosen: list[dict[str, Any]]) -> Any:
    results = []
    for row in chosen:
        options = dict(row)
        width = options.pop("width")
        results.append((row, attempt(lambda: outputs_of(kind, width, options))))  # noqa: B023
    return results


def outputs_of_encoders() -> Any:
    choices = combinations(
        4, 24, width=(0, 3, 8), project_condition=(True, True, False), max_tokens=(0, 4, 7, 3),
        mask_padding=(True, False), condition_frames=(False, True),
    )  # fmt: skip
    able = [choice for choice in choices if choice["width"] or choice["max_tokens"] < 4]
    return attempts(MDMEncoder, [BASE | {"width": 3}, *(BASE | choice for choice in able)])


def outputs_of_decoders() -> Any:
    choices = combinations(
        5, 34, width=(0, 3, 8), project_condition=(True, True, False), memory=("add", "concat"),
        input_token=("none", "condition", "time"), token_memory=(False, True),
        mask_padding=(True, False), context_frames=(0, 2), condition_frames=(False, True),
        target_encoder=("none", "single", "split", "multi"), target_layers=(1, 2),
    )  # fmt: skip
    return attempts(MDMDecoder, [BASE | {"width": 3}, *(BASE | choice for choice in choices)])


def outputs_of_flame() -> Any:
    choices = combinations(
        6, 22, width=(0, 3), max_frames=(6, 7, 20), length_token=(True, False),
        cross_attention=(True, False), condition_frames=(False, True), length_unit=(1, 2, 4),
    )  # fmt: skip
    plain = BASE | {"width": 3, "max_frames": 9}
    short = BASE | {"width": 3, "max_frames": 5}
    return attempts(FLAME, [plain, short, *(BASE | choice for choice in choices)])


def outputs_of_other_networks() -> Any:
    gru = {"latent_dim": 8, "num_layers": 2, "dropout": 0.1}
    choices = combinations(
        7, 8, width=(0, 3, 8), project_condition=(True, False), recur_over_batch=(False, True)
    )
    unet = {"latent_dim": 8, "dropout": 0.1}
    others = combinations(
        8, 8, width=(0, 3, 8), project_condition=(True, False), channels=([4], [4, 8], [6, 4, 8]),
        num_groups=(2, 4),
    )  # fmt: skip
    return [
        attempts(MDMGRU, [gru | {"width": 3}, *(gru | choice for choice in choices)]),
        attempts(MDMUNet, [unet | choice for choice in others]),
    ]


def refused_networks() -> Any:
    decoders = [
        {"memory": "concat"}, {"context_frames": -1}, {"context_frames": 1.0}, {"context_frames": True},
        {"target_encoder": "single", "target_layers": 0}, {"target_encoder": "split", "latent_dim": 12},
        {"num_heads": 3}, {"num_heads": 0}, {"project_condition": False}, {"num_heads": 8},
    ]  # fmt: skip
    units = [{"length_unit": unit} for unit in (0, -2, 1.5, True, 1)]
    x_t, t, mask, cond = seen_by_denoisers(3)
    context = MDMDecoder(FEATURES, 5, 3, **BASE, context_frames=3).double()
    reading = MDMEncoder(FEATURES, 5, 3, **BASE, max_tokens=4).double()
    return [
        [refusal(lambda o=options: MDMDecoder(FEATURES, 5, 3, **(BASE | o))) for options in decoders],
        [refusal(lambda o=unit: FLAME(FEATURES, 5, 3, **BASE, max_frames=9, **o)) for unit in units],
        [
            refusal(lambda p=prefix: context(x_t, t, mask, replace(cond, prefix=p)))
            for prefix in (None, cond.prefix, motion(55)[:, :3], motion(55)[:, :4])
        ],
        [
            refusal(lambda c=chosen: reading(x_t, t, mask, c))
            for chosen in (
                replace(cond, token_mask=None), replace(cond, tokens=cond.tokens[:, :0]),
                replace(cond, tokens=numbers(56, 3, 5, 3), token_mask=torch.ones(3, 5) > 0),
            )
        ],
        condition_tokens(cond),
    ]  # fmt: skip


def outputs_of_layers() -> Any:
    x, memory = numbers(57, 3, 6, 8), numbers(58, 3, 5, 8)
    mask, memory_mask = length_mask(torch.tensor([6, 2, 4])), length_mask(torch.tensor([5, 1, 3]))
    attention = with_weights(layers.Attention(8, 4, 0.5))
    results: list[Any] = [
        attention(x, seen, other)
        for seen, other in ((None, None), (mask, None), (None, memory), (memory_mask, memory))
    ]
    for activation in (nn.GELU, nn.ReLU):
        for crossing in (False, True):
            layer = with_weights(layers.TransformerLayer(8, 12, 2, 0.1, activation, crossing))
            results.append([layer(x, mask, memory, memory_mask), layer(x, None, memory, None)])
    results.append(with_weights(layers.Transformer(8, 12, 2, 2, 0.1))(x, mask))
    initial = layers.Attention(8, 2, 0.0)
    bound = (6 / (8 + 24)) ** 0.5
    results.append([initial.qkv.bias.sum(), initial.out.bias.sum(), bool(initial.qkv.weight.abs().max() < bound)])
    positions = torch.tensor([0.0, 1.0, 17.5, 999.0])
    results.append([kind(positions, 6) for kind in (layers.sinusoid, cosine_first_sinusoid)])
    results.append([list(layers.sinusoid(positions, 4)), layers.sinusoid(positions, 5)])
    results.append(layers.with_prefix(mask, 2))
    for width, projected in ((0, True), (3, True), (8, False)):
        embedding = with_weights(layers.TimeAndCondition(8, width, projected))
        pooled, tokens, t = numbers(59, 4, width), numbers(60, 4, 2, width), positions.double()
        results.append([embedding.time(t), embedding(t, pooled), embedding(t, tokens)])
    return results


def outputs_in_training() -> Any:
    x, mask = numbers(61, 3, 6, 8), length_mask(torch.tensor([6, 2, 4]))
    results = []
    for dropout in (0.0, 1.0):
        layer = with_weights(layers.Attention(8, 4, dropout)).train()
        results.append(layer(x, mask).nan_to_num(7.0))
    for kind in (MDMEncoder, MDMDecoder):
        torch.manual_seed(0)
        denoiser = with_weights(kind(FEATURES, 5, 3, **(BASE | {"dropout": 0.0}))).train()
        results.append(denoiser(*seen_by_denoisers(3)))
    return results


def outputs_of_target_encoders() -> Any:
    results = []
    for name, kind in TARGET_ENCODERS.items():
        for depth in (1, 3):
            encoder = with_weights(kind(16, depth))
            cond = seen_by_denoisers(3)[3]
            every = replace(cond, target_mask=None)
            free = replace(every, target=every.target * torch.tensor([1.0, 1.0, 1.0, 0.0]))
            results.append(
                [
                    name, *encoder(cond), *encoder(every), encoder(free),
                    encoder(replace(cond, target=None)), len(list(encoder.parameters())),
                ]
            )  # fmt: skip
    sizes = [[list(p.shape) for p in perceptron(3, 5, depth).parameters()] for depth in (1, 2)]
    return results, sizes, refusal(lambda: perceptron(3, 5, 0))


def outputs_of_the_parts_of_unets() -> Any:
    x, mask = numbers(62, 3, 4, 6), MASK[:, None].double()
    none = mask * torch.tensor([1.0, 1.0, 0.0])[:, None, None]
    norms = [with_weights(MaskedGroupNorm(4, groups)) for groups in (1, 2, 4)]
    blocks = [with_weights(ResidualBlock(4, size, 5, 2, 0.1)) for size in (4, 6)]
    return [
        [[list(norm(x, seen)) for seen in (mask, none)] for norm in norms],
        [block(x, numbers(63, 3, 5), mask) for block in blocks],
        refusal(lambda: MaskedGroupNorm(6, 4)), [p.sum() for p in MaskedGroupNorm(4, 2).parameters()],
    ]  # fmt: skip


def gradients_with_recomputation() -> Any:
    results = []
    for recomputed in (False, True):
        denoiser = with_weights(MDMDecoder(FEATURES, 5, 3, **BASE, context_frames=2))
        if recomputed:
            recompute_activations(denoiser)
        output = denoiser(*seen_by_denoisers(3))
        output.square().sum().backward()
        gradients = [p.grad for p in denoiser.parameters()]
        with torch.no_grad():
            results.append([output, gradients[::5], denoiser(*seen_by_denoisers(3))])
    unet = MDMUNet(FEATURES, 5, 3, latent_dim=8, channels=[4, 8], num_groups=2, dropout=0.0)
    return results, [type(layer).__name__ for layer in stacked_layers(unet)]


# Generators


class Points(Representation):
    """Joint positions with a factor as features; the last ones are no pose."""

    def __init__(self) -> None:
        super().__init__("points", 66, 20.0, SMPL22)
        self.mean, self.std = 0.1 * numbers(64, 66), numbers(65, 66).abs() + 0.5
        self.pose = slice(2, 50)

    def encode(self, motion: Tensor) -> Tensor:
        return motion.flatten(1)

    def decode(self, features: Tensor) -> Tensor:
        return features.unflatten(-1, (22, 3))

    def joint_features(self, joints: Any) -> Tensor:
        return self.joint_mask(joints).repeat_interleave(3)


class Words(ConditionEncoder):
    """Embeds the lengths of words."""

    features = 3

    def forward(self, batch: MotionBatch) -> Condition:
        texts = batch.text or []
        rows = [[len(word) + 0.1 * n for n, word in enumerate(text.split())] for text in texts]
        size = max(1, *map(len, rows))
        tokens = torch.tensor([row + [0.0] * (size - len(row)) for row in rows]).double()
        tokens = torch.stack([tokens.sin(), tokens.cos(), tokens / 5], -1)
        mask = length_mask(torch.tensor([len(row) for row in rows]), size)
        null = Condition(0.1 * numbers(66, 1, 3), 0.1 * numbers(67, 1, 2, 3), torch.ones(1, 2) > 0)
        return Condition(tokens.mean(1), tokens, mask, null)


def encoder_of(name: str) -> ConditionEncoder:
    if name == "action":
        return with_weights(ActionLabels(3, 4), 70)
    return Words() if name == "text" else Unconditional()


@cache
def denoiser_of(width: int, process: str, options: tuple[tuple[str, Any], ...]) -> Any:
    out = every_process()[process].out_features(66)
    return with_weights(MDMDecoder(66, out, width, **(BASE | dict(options) | {"num_layers": 1})), 71, 0.25)


def generator(
    name: str = "text", process: str = "x0", kind: type[MotionGenerator] = MotionGenerator, **options: Any
) -> MotionGenerator:
    """A small generator with random weights and a limit of nine frames."""
    encoder, chosen = encoder_of(name), every_process()[process]
    denoiser = denoiser_of(encoder.features, process, tuple(options.items()))
    sampler = "ddim" if isinstance(chosen, GaussianDiffusion) else "euler"
    defaults = SamplerOptions(guidance_scale=2.5, sampler=sampler, num_inference_steps=3)
    model = kind(Parts(denoiser, chosen, encoder, Points()), defaults)
    model.add_facts({"max_frames": 9})
    return model.eval()


def requests_of(lengths: tuple[int, ...] = (4, 6, 1)) -> MotionBatch:
    mask = length_mask(torch.tensor(lengths))
    texts = ["a person walks", "sits", "she runs away quickly", "jumps"][: len(lengths)]
    ids = ["first", "second", "third", "fourth"][: len(lengths)]
    x = numbers(72, len(lengths), mask.shape[1], 66) * mask[..., None]
    return MotionBatch(x, mask, ids, texts, torch.tensor([2, 0, 3, 1])[: len(lengths)])


def generated_motions() -> Any:
    results = []
    for options in combinations(
        9, 40, name=("text", "action", "none"), process=("x0", "learned", "flow"),
        mask_padding=(True, False), scale=(None, 1.0, 4.0), seed=(0, 5), replication=(0, 2),
        edit=(False, True), unconditioned=(False, False, True), shared_noise=(False, True),
        training=(False, True),
    ):  # fmt: skip
        chosen = dict(options)
        model = generator(chosen.pop("name"), chosen.pop("process"), mask_padding=chosen.pop("mask_padding"))
        batch, scale = requests_of(), chosen.pop("scale")
        requested = None if scale is None else SamplerOptions(guidance_scale=scale, num_inference_steps=2)
        edit = Edit(batch.x + 0.5, numbers(73, 3, 6, 66) > 0.5) if chosen.pop("edit") else None
        model.train(chosen.pop("training"))
        trajectory: list[Tensor] = []
        x = model.generate(batch, requested, edit=edit, trajectory=trajectory, **chosen)
        results.append((options, list(x), trajectory, model.training, model.conditioned_on))
    return results


def generated_by_default() -> Any:
    model = generator()
    tiny = MotionGenerator(
        Parts(model.denoiser, model.process, model.condition, model.representation),
        replace(model.sampler_options, guidance_scale=None),
    )
    long = requests_of((4, 11))
    wide = generator(mask_padding=False)
    edit = Edit(long.x, numbers(74, 2, 11, 66) > 0)
    short = requests_of((4, 3))
    keep = Edit(short.x, numbers(75, 2, 4, 66) > 0, mode="x_t")
    return [
        model.generate(requests_of()), tiny.generate(requests_of()), wide.generate(requests_of()),
        wide.generate(long, edit=edit), wide.generate(short, edit=keep), model.generate(long),
        model.describe(), model.noun, str(model.device), model.facts, model.config, model.steps, model.sha256,
    ]  # fmt: skip


def generated_windows() -> Any:
    results = []
    for mask_padding in (True, False):
        model = generator(mask_padding=mask_padding)
        parts = windows.spans([8, 9], 9, 4)
        cover = windows.cover([(0, *part[1:]) for part in parts], [17], 4, 9, CPU)
        texts = ["walks fast", "a person jumps", "runs", "sits down now", "turns"][: len(parts)]
        cover.batch = replace(cover.batch, x=cover.batch.x.double(), text=texts)
        cover.weights = cover.weights.double()
        x = torch.zeros(1, 17, 66).double()
        batch = MotionBatch(x, x[..., 0] == 0, ["long"], [""])
        results += [model.generate(batch, windows=cover, unconditioned=free) for free in (False, True)]
    return results


def generated_blocks() -> Any:
    model, batch = generator(context_frames=2), requests_of((4, 16, 9))
    prefix, options = 0.5 * numbers(76, 3, 2, 66), SamplerOptions(num_inference_steps=2)
    cond = model.encode(batch)
    chosen = options.over(model.sampler_options)
    results: list[Any] = [model.block_frames]
    for settings in combinations(10, 6, fade=(0, 4, 20), seed=(0, 3), edit=(False, True)):
        fade, seed = settings["fade"], settings["seed"]
        blocks = Blocks(model, batch.ids, prefix, chosen, seed=seed, fade=fade, replication=seed)
        edit = Edit(numbers(77, 3, 7, 66), numbers(78, 3, 7, 66) > 0.5) if settings["edit"] else None
        rows = [
            blocks.sample(cond), blocks.prefix, blocks.sample(cond, torch.tensor([3, 7, 1]), edit),
            blocks.prefix, blocks.sample(cond, edit=edit), blocks.prefix, blocks.number,
        ]  # fmt: skip
        results.append((settings, rows))
    free = Blocks(model, batch.ids, prefix, chosen, unconditioned=True)
    model.train()
    results += [free.sample(cond), model.generate(batch, options, prefix=prefix), model.training]
    results += [model.generate(batch, prefix=prefix, seed=4, replication=1, shared_noise=True)]
    results += [model.generate(batch, prefix=prefix, unconditioned=True)]
    split, rest = model.split_prefix(batch)
    results += [split, rest, model.split_prefix(rest)[1].mask, generator().split_prefix(batch)[0]]
    cover = windows.cover([(0, 0, 5)], [5], 2, 5, CPU)
    cover.batch.text = ["walks"]
    refused = [
        {"prefix": None}, {"prefix": prefix[:2]}, {"prefix": prefix[:, :1]}, {"prefix": prefix[..., 1:]},
        {"prefix": prefix, "trajectory": []}, {"prefix": prefix, "windows": cover},
        {"prefix": prefix, "edit": Edit(batch.x, batch.x > 0)},
    ]  # fmt: skip
    results += [refusal(lambda row=row: model.generate(batch, **row)) for row in refused]
    return results


def joined_blocks() -> Any:
    return [
        joined(numbers(79, 2, context, 3), numbers(80, 2, frames, 3), fade)
        for context in (1, 2, 4) for frames in (1, 2, 6) for fade in (1, 3, 6, 9)
    ]  # fmt: skip


def encoded_and_guided() -> Any:
    batch = requests_of()
    x_t, t = numbers(81, 3, 6, 66), torch.tensor([0.0, 3.0, 11.0]).double()
    results = []
    for name in ("text", "action", "none"):
        model = generator(name)
        for free in (False, True):
            cond = model.encode(batch, free)
            for scale in (None, 1.0, 3.0):
                denoise = model.guided(cond, SamplerOptions(guidance_scale=scale), free)
                output = denoise(x_t, t, batch.mask, cond)
                results.append([name, free, cond.pooled, output, denoise is model.denoiser])
        lacking = replace(cond, null=None)
        results.append(model.guided(lacking, SamplerOptions(guidance_scale=3.0), False) is model.denoiser)
    return results


def distilled_generators() -> Any:
    results = []
    for name, process in (("text", "flow"), ("none", "x0")):
        model = generator(name, process, DistilledGenerator)
        results.append([model.process.edit_modes, model.generate(requests_of())])
        results += [
            refusal(lambda m=model, s=scale, f=free: m.check_request(s, f))
            for free in (False, True)
            for scale in (None, *(SamplerOptions(guidance_scale=g) for g in (None, 0, 1, 1.0, 2.5)))
        ]
        results.append(refusal(lambda m=model: m.generate(requests_of(), unconditioned=True)))
    return results, generator("text", "flow").check_request(None, True), FlowMatching.edit_modes


def recipe(**changes: Any) -> dict[str, Any]:
    """A small recipe."""
    config: dict[str, Any] = {
        "denoiser": {"_target_": "flame_mdm.denoisers.flame.FLAME", "max_frames": 9} | BASE,
        "process": {"_target_": "flame_mdm.processes.diffusion.GaussianDiffusion", "num_train_timesteps": 12},
        "condition": {"_target_": "flame_mdm.conditions.action.ActionLabels", "features": 3},
        "optimizer": {"_target_": "torch.optim.AdamW", "lr": 0.01},
        "losses": {"joints": 0.5, "velocity": 2.0, "foot_contact": 3.0, "bone_length": 1.5},
        "task": {
            "_target_": "flame_mdm.task.GeneratorTask", "cond_drop_prob": 0.4, "guidance_scale": 2.5,
            "sampler": "ddim", "num_inference_steps": 3,
        },
        "data": {"crop": {"unit": 2}}, "seed": 7,
    }  # fmt: skip
    return config | changes


def built_generators() -> Any:
    facts = {"max_frames": 9, "vocabulary": ["walks", "sits"]}
    model = MotionGenerator.build(recipe(), Points(), actions=["a", "b"], facts=facts)
    plain = MotionGenerator.build(recipe(data={}), Points(), actions=["a"])
    decoder = recipe(denoiser={"_target_": "flame_mdm.denoisers.mdm.MDMDecoder"} | BASE)
    parts = Parts.build(decoder, Points(), 5)
    sizes = [
        sizes_of_denoiser(recipe(**changes), Points(), process, parts.condition)
        for changes in ({}, {"data": {}}, {"data": {"crop": {}}}, {"data": {"crop": 3}})
        for process in (GaussianDiffusion(variance="learned_range"), FlowMatching())
    ]
    values: list[dict[str, Any]] = [
        {"guidance_scale": 2.0, "sampler": "ddim", "num_inference_steps": steps}
        for steps in (None, 0, 5, [1, 2], 1.5)
    ]
    values += [{"guidance_scale": float("nan"), "sampler": "ddim", "num_inference_steps": 3}]
    values += [{"guidance_scale": 1, "sampler": 3, "num_inference_steps": 3}]
    assert isinstance(model.denoiser, FLAME)
    return [
        model.facts, model.condition.seen, model.sampler_options.chosen(), model.describe(),
        model.denoiser.length_unit, plain.facts, plain.condition.seen, list(model.state_dict()),
        {name: list(weight.shape) for name, weight in parts.denoiser.named_parameters()},
        sizes, [attempt(lambda v=row: sampling_defaults(**v).chosen()) for row in values],
        refusal(lambda: Parts(nn.Linear(2, 2), FlowMatching(), Words(), Points())),  # type: ignore[arg-type]
        model.config == recipe(), model.conditioned_on, generator("none").conditioned_on,
    ]  # fmt: skip


# Tasks


TARGETS = {"choices": [["head"], ["traj", "heading"], ["left_wrist", "pelvis"], []], "drop_prob": 0.5}


def task_of(name: str = "action", targets: bool = False, **changes: Any) -> GeneratorTask:
    """A small task in float64 with random weights."""
    options = {"target_encoder": "single", "context_frames": 2} if targets else {}
    decoder = {"_target_": "flame_mdm.denoisers.mdm.MDMDecoder"} | BASE | {"dropout": 0.0, "num_layers": 1}
    settings = recipe(denoiser=decoder | options)
    settings["task"] |= {"targets": TARGETS} if targets else {}
    settings["task"] |= changes.pop("task", {})
    if name == "none":
        settings["condition"] = {"_target_": "flame_mdm.conditions.Unconditional"}
    settings |= changes
    task = GeneratorTask.build(settings, Points(), actions=["a", "b", "c", "d"], facts={"max_frames": 9})
    with_weights(task.generator.denoiser, 82, 0.25)
    with_weights(task.generator.condition, 83)
    return task.double()


def losses_of_tasks() -> Any:
    results = []
    batch = requests_of((4, 7, 3))
    for name, targets in (("action", False), ("none", False), ("action", True)):
        for process in ("diffusion.GaussianDiffusion", "flow_matching.FlowMatching"):
            changes = {"process": {"_target_": f"flame_mdm.processes.{process}"}}
            sampler = {"sampler": "euler" if "flow" in process else "ddim"}
            task = task_of(name, targets, task=sampler, **changes)
            losses = task.losses_of(batch)
            steps = [task.training_step(batch, number) for number in (0, 1, 2)]
            reported = dict(task.reported)
            task.report({"a": torch.tensor(2.5).requires_grad_(), "b": 3.0})
            results.append([losses, steps, reported, task.reported["a"], task.describe()])
            torch.manual_seed(1)
            results.append(task.dropped(replace(batch, ids=list("abcdefgh"))))
    other = task_of(seed=8)
    never, always = (task_of(task={"cond_drop_prob": chance}) for chance in (0.0, 1.0))
    results += [[task.training_step(batch, 0) for task in (other, never, always)]]
    return results


def validation_means() -> Any:
    task, logged = task_of(), []
    task.log = lambda *values, **options: logged.append((values, options))  # type: ignore[method-assign]
    for lengths in ((4, 7, 3), (5, 2)):
        task.validation_step(requests_of(lengths), 0)
    task.on_validation_epoch_end()
    task.validation_step(requests_of((3,)), 0)
    task.on_validation_epoch_end()
    return logged


def states_of_tasks() -> Any:
    task, other = task_of(targets=True), task_of(targets=True)
    state = task.state_dict()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.zero_()
    other.load_state_dict(dict(state))
    same = all(torch.equal(a, b) for a, b in zip(task.parameters(), other.parameters(), strict=True))
    checkpoint: dict[str, Any] = {}
    task.on_save_checkpoint(checkpoint)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        renamed = task_module.MotionGeneration
    return [
        list(state), same, checkpoint, renamed is GeneratorTask, [str(w.message) for w in caught],
        list(nn.ModuleList([task]).state_dict())[:3], task.encoder() is task.generator.condition,
        task.noun, refusal(lambda: task_module.Missing), Task(optimizer={}, seed=1).describe(),
    ]  # fmt: skip


def refused_tasks() -> Any:
    changes: list[dict[str, Any]] = [
        {"cond_drop_prob": -0.01}, {"cond_drop_prob": 1.01}, {"cond_drop_prob": 1}, {"targets": TARGETS},
        {"num_inference_steps": 0}, {"num_inference_steps": None}, {"sampler": "none"},
    ]  # fmt: skip
    targeted = {"targets": None}
    base = Task(optimizer={}, seed=1)
    return [
        [refusal(lambda c=change: task_of(task=c)) for change in changes],
        refusal(lambda: task_of(targets=True, task=targeted)),
        refusal(base.encoder), refusal(lambda: Task.build({}, Points())),
        [refusal(lambda c=change: task_of(task=c).on_fit_start()) for change in changes[2:3] + changes[6:]],
        [
            refusal(lambda c=change: task_of(task=c).on_fit_start())
            for change in ({"num_inference_steps": 13}, {"sampler": "euler"}, {"sampler": "ancestral"})
        ],
    ]  # fmt: skip


def learning_rates() -> Any:
    results = []
    for warmup in (None, 0, 4, 1, -1):
        for decay in (None, 0.0, 0.3, 1.0, 1.2, -0.1):
            task = task_of(lr_warmup=warmup, lr_decay=decay)
            task._trainer = SimpleNamespace(max_steps=10)  # type: ignore[assignment]

            def rates(task: GeneratorTask = task) -> Any:
                chosen: Any = task.configure_optimizers()
                if not isinstance(chosen, dict):
                    return type(chosen).__name__, len(chosen.param_groups[0]["params"])
                schedule = chosen["lr_scheduler"]
                factor = schedule["scheduler"].lr_lambdas[0]
                return [factor(step) for step in range(12)], schedule["interval"]

            results.append((warmup, decay, attempt(rates)))
    frozen = task_of()
    frozen.generator.denoiser.requires_grad_(False)
    return results, len(frozen.make_optimizer().param_groups[0]["params"])


def reports_of_steps() -> Any:
    results = []
    for step in range(6):
        task = task_of() if step == 0 else results[0][0]
        task.reported = {}
        task._trainer = SimpleNamespace(global_step=step, log_every_n_steps=3)  # type: ignore[assignment]
        task.report({"x": torch.tensor(step + 0.5), "y": 2.0})
        results.append((task, task.is_reported, dict(task.reported)))
    return [row[1:] for row in results]


def clips() -> Any:
    return [
        SimpleNamespace(captions=["a man walks", "he walks"], license="open"),
        SimpleNamespace(captions=["she sits"], license="closed"),
    ]


def set_up(task: GeneratorTask, **changes: Any) -> Any:
    """Everything that `setup` asks of the encoder and adds to the facts."""
    shares = changes.pop("shares", ("open",))
    store = SimpleNamespace(
        info={"dataset": "toy", "actions": ["walk", "sit"]}, fingerprint="abc",
        licenses=lambda: changes.get("licenses", ["open"]),
    )  # fmt: skip
    shortest = changes.get("shortest", 4)
    data = SimpleNamespace(
        choose_device=lambda size: changes.get("device") and (changes["device"], size),
        store=store, captions=lambda: ["she sits", "a man walks", "he walks"],
        crop=SimpleNamespace(
            longest=lambda: 12, min_frames=5, draw=lambda length, draw: (draw(9), shortest + length)
        ),
        train=SimpleNamespace(clips=clips()), folder=Path("/data/toy"),
        source=SimpleNamespace(may_share_captions=lambda name: name in shares, verbs=changes.get("verbs")),
    )  # fmt: skip
    callbacks = [SimpleNamespace(texts=["he waves", "he walks"]), SimpleNamespace()]
    task._trainer = SimpleNamespace(  # type: ignore[assignment]
        datamodule=data, callbacks=callbacks, optimizers=[SimpleNamespace()], global_step=0,
        precision=changes.get("precision", "32-true"),
    )  # fmt: skip
    events: list[Any] = []
    encoder: Any = task.encoder()
    encoder.precompute = lambda texts, folder: events.append((texts, folder.as_posix()))
    encoder.load_cache = lambda texts, folder: events.append((texts, folder.as_posix())) or 77
    encoder.move_cache = lambda device: events.append(device)
    encoder.pretrain = lambda groups, seed: events.append((groups, seed))
    task.prepare_data()
    task.setup("fit")
    task.on_train_start()
    ignored: Any = task._ddp_params_and_buffers_to_ignore
    return [events, task.facts, ignored, vars(task._trainer.optimizers[0]), encoder.seen]  # type: ignore[union-attr]


def tasks_with_data() -> Any:
    results = [
        attempt(lambda c=changes: set_up(task_of(targets=True), **c))
        for changes in (
            {}, {"device": "gpu"}, {"licenses": []}, {"precision": "bf16-mixed"},
            {"shortest": -2}, {"shortest": -3}, {"shortest": -5},
        )
    ]  # fmt: skip
    for changes in ({}, {"verbs": ["walk"]}, {"shares": ()}, {"shares": ("open", "closed")}):
        for reads in ("text", "none"):
            task = task_of()
            task.generator.conditioned_on = reads
            results.append(set_up(task, **changes))
    started = task_of()
    results.append(set_up(started))
    recomputed = task_of(task={"checkpoint_activations": True, "compile": True})
    called: list[str] = []
    recomputed.generator.denoiser.compile = lambda: called.append("compiled")  # type: ignore[method-assign]
    set_up(recomputed)
    layer: Any = stacked_layers(recomputed.generator.denoiser)[0]
    return results, called, type(layer.forward).__name__, started.compiles


def essential_features_in_a_generator() -> Any:
    model = MotionGenerator.build(recipe(), Essential(), actions=["a", "b", "c", "d"])
    with_weights(model.denoiser, 84, 0.2)
    with_weights(model.condition, 85)
    batch = requests_of()
    return model.double().generate(replace(batch, x=batch.x[..., :0]), seed=3)


CASES: list[Case] = [
    noisy_motions_and_targets, training_losses, variances_and_bounds, refused_processes,
    tables_of_schedules, coefficients_of_batches, selected_steps, diffusion_samples,
    edited_diffusion_samples, flow_samples, adaptive_flow_samples, steps_of_samplers,
    refused_samples, consistency_losses, guided_denoisers, steered_motions, reached_positions,
    windows_of_motions, outputs_of_encoders, outputs_of_decoders, outputs_of_flame,
    outputs_of_other_networks, refused_networks, outputs_of_layers, outputs_in_training,
    outputs_of_target_encoders, outputs_of_the_parts_of_unets, gradients_with_recomputation,
    generated_motions, generated_by_default, generated_windows, generated_blocks, joined_blocks,
    encoded_and_guided, distilled_generators, built_generators, losses_of_tasks, validation_means,
    states_of_tasks, refused_tasks, learning_rates, reports_of_steps, tasks_with_data,
    essential_features_in_a_generator,
]  # fmt: skip


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
