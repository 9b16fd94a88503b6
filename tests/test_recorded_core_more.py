"""Values of processes, samplers, guidance and windows, as recorded."""

from collections.abc import Mapping
from itertools import count
from typing import Any

import pytest
import torch
from support.recorded import Case, cases_of, check, combinations, outcome, record
from test_recorded_core import CPU, Shift, condition, numbers, refusal
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit, length_mask
from flame_mdm.processes import Process, guidance, samplers, schedules, windows
from flame_mdm.processes.consistency import consistency_terms
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.sampler_options import SamplerOptions

NAME = "core_more"
BATCH, FRAMES, FEATURES = 3, 6, 4
MASK = length_mask(torch.tensor([4, 6, 1]))
STEPS = 12


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
        [defaults.clip_x0, defaults.skip, defaults.min_snr, defaults.schedule.number("signal",
        500)],
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
                {key: schedule.respace([0, middle, last]).numbers[key] for key in ("betas",
                "noise")},
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
        outcome(lambda a=total, b=number, c=spacing: schedules.timesteps(a, b, *c))
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
        {"sampler": "ancestral", "num_inference_steps": 5}, {"sampler": "ancestral",
        "num_inference_steps": 12},
        {"sampler": "ancestral", "num_inference_steps": 4, "spacing": "stride"},
        {"sampler": "ddim", "num_inference_steps": 5}, {"sampler": "ddim",
        "num_inference_steps": [0, 3, 7, 10]},
        {"sampler": "ddim", "num_inference_steps": 6, "spacing": "stride", "eta": 0.7},
        {"sampler": "ddim", "num_inference_steps": 4, "eta": 1.0},
        {"sampler": "dpm_solver_pp_2m", "num_inference_steps": 6},
        {"sampler": "dpm_solver_pp_2m", "num_inference_steps": [1, 2, 6, 11]},
        {"sampler": "consistency", "num_inference_steps": 1}, {"sampler": "consistency",
        "num_inference_steps": 5},
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
        blend=("after", "before"), resample=(1, 1, 3), strength=(None, 0.5, 0.1), guide=(False,
        True),
    ):  # fmt: skip
        chosen = dict(options)
        process, sampler = processes[chosen.pop("process")], chosen.pop("sampler")
        edit = edit_of(chosen | {"guide": Shift() if chosen["guide"] else None})
        settings = SamplerOptions(sampler=sampler, num_inference_steps=4)
        results.append((options, outcome(lambda: sampled(process, settings, edit))))  # noqa: B023
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
        results.append((options, outcome(lambda: sampled(process, settings, edit))))  # noqa: B023
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
            {name: [s.options, s.unsupported, s.adaptive, s.step.__name__] for name,
            s in table.items()}
            for table in (samplers.DIFFUSION_SAMPLERS, samplers.FLOW_SAMPLERS)
        ],
        "tolerance": samplers.TOLERANCE * 1e5,
    }  # fmt: skip


def refused_samples() -> Any:
    diffusion, flow = GaussianDiffusion(STEPS), FlowMatching()
    requests: list[dict[str, Any]] = [
        {}, {"sampler": "euler"}, {"sampler": "ddim"}, {"sampler": "heun", "eta": 0.5},
        {"sampler": "ancestral", "eta": 0.5}, {"sampler": "euler", "spacing": "stride"},
        {"sampler": "consistency", "spacing": "linspace"}, {"sampler": "ddim",
        "num_inference_steps": 1},
        {"sampler": "ddim", "num_inference_steps": 13}, {"sampler": "ddim",
        "num_inference_steps": [3]},
        {"sampler": "ddim", "num_inference_steps": [3, 2]}, {"sampler": "ddim",
        "num_inference_steps": [3, 3]},
        {"sampler": "ddim", "num_inference_steps": [3, 12]}, {"sampler": "ddim",
        "num_inference_steps": [0, 11]},
        {"sampler": "euler", "num_inference_steps": [0, 1]}, {"sampler": "rk4",
        "num_inference_steps": 1},
        {"sampler": "consistency", "num_inference_steps": 13}, {"sampler": "consistency",
        "num_inference_steps": 12},
        {"sampler": "ddim", "num_inference_steps": 5, "spacing": "stride"},
        {"sampler": "ddim", "num_inference_steps": 12, "guidance_scale": 3.0},
    ]  # fmt: skip
    edits = [
        Edit(motion(), motion() > 0, mode="trajectory"), Edit(motion(), motion() > 0, mode="x_t"),
        Edit(motion()[:2], motion() > 0), Edit(motion()[:, :5], motion()[:, :5] > 0),
        Edit(motion(), motion() > 0, resample=2), Edit(motion(), motion() > 0, mode="x_t",
        resample=2),
        Edit(motion()[..., :2], motion()[..., :2] > 0),
    ]  # fmt: skip
    chosen = [("ddim", diffusion), ("dpm_solver_pp_2m", diffusion), ("consistency", diffusion)]
    chosen += [("euler", flow), ("dopri5", flow), ("consistency", flow)]
    return {
        "options": [
            str(outcome(lambda p=process, r=request: sampled(p, SamplerOptions(**r))[2]))
            for process in (diffusion, flow) for request in requests
        ],
        "edits": [
            outcome(lambda p=process, e=edit, s=name: p.check_edit(e, MASK,
            SamplerOptions(sampler=s)))
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
    for number, process in enumerate(
        (GaussianDiffusion(STEPS, variance="learned_range"), FlowMatching())
    ):
        denoise = network(process)
        for scale in (1, 1.0, 0.0, 2.5, -1.0, torch.tensor([0.5, 1.0, 4.0]), torch.ones(3)):
            guided = guidance.classifier_free_guidance(denoise, scale, FEATURES)
            t = torch.tensor([3.0, 0.0, 11.0])
            results.append(
                [
                    guided(motion(37), t, MASK, conditions()),
                    guided(motion(38), t, ~MASK, conditions()),
                    guided(motion(38), t, ~MASK, conditions(40 + number)),
                    guided(motion(37), t, MASK, conditions()),
                    guided is denoise,
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

    def clean(x: Tensor) -> Tensor:
        return (x * 0.6).tanh() + 0.1 * x.roll(1, 1)

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
        # With some features fixed, the steps differ between kinds of processors
        for chosen, may, smoothness in ((bones, free | True, 0.7), (none, free, 2.5))
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
            numbers(48, 3, 20, 2), torch.tensor([1.0, 2.0, 3.0]).double(),
            length_mask(torch.tensor(totals)),
            condition(6, 0, 49),
        )  # fmt: skip
        results.append(
            [
                cover.rows, cover.frames, cover.weights, *cover.weights, cover.batch.mask,
                cover.batch.ids, list(cover.batch.x.shape), list(blended), str(blended.dtype),
            ]
        )  # fmt: skip
    return spans, results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
