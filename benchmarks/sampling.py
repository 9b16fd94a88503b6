"""Times sampling: `python benchmarks/sampling.py`.

The first table shows the latency (batch size 1) and the throughput (batch size 64) of MDM's encoder,
for 1, 2 and 4 steps of a distilled model without guidance, and for 10, 50 and 1000 guided steps. The
second table compares samplers that use this encoder, in alternating runs. The third table shows the
time that the sampling loop itself takes per network call. It is measured with a denoiser that
returns a stored tensor.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import torch
from sections import Row, Section, Settings, section, show, take_turns
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit
from flame_mdm.denoisers.mdm import MDMEncoder
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.seeds import seeded_noise

FEATURES, GUIDANCE, BATCH = 263, 2.5, 4
RUNS = [
    (GaussianDiffusion(), "ancestral", 50),
    (GaussianDiffusion(), "ddim", 50),
    (GaussianDiffusion(), "dpm_solver_pp_2m", 50),
    (GaussianDiffusion(), "ddim", 10),
    (GaussianDiffusion(), "dpm_solver_pp_2m", 10),
    (GaussianDiffusion(), "consistency", 4),
    (FlowMatching(), "euler", 50),
    (FlowMatching(), "euler", 10),
    (FlowMatching(), "midpoint", 10),
    (FlowMatching(), "heun", 10),
    (FlowMatching(), "rk4", 10),
    (FlowMatching(), "dopri5", 1),
]
"""Process, sampler and number of steps of each run. dopri5 ignores the number and chooses its own steps."""


class Counted:
    """A denoiser that counts its calls."""

    def __init__(self, denoise: Denoise):
        self.denoise, self.calls = denoise, 0

    def __call__(self, *inputs: Any) -> Tensor:
        self.calls += 1
        return self.denoise(*inputs)


@dataclass(frozen=True)
class Size:
    """Size of the motions and of the network, and the effort spent on timing them."""

    device: str
    frames: int = 60
    latent_dim: int = 128
    num_layers: int = 4
    rounds: int = 3
    # If a run would take more seconds than this, its time is estimated from a run of 10 steps
    longest: float = 20.0


def inputs(batch: int, size: Size) -> tuple[Tensor, Tensor, Condition]:
    """Returns the inputs of a sampler: noise (B, F, D), a mask (B, F) and a random condition with a null condition."""
    device = size.device
    null = Condition(
        torch.zeros(1, 512, device=device), torch.zeros(1, 0, 512, device=device), None
    )
    noise = torch.randn(batch, size.frames, FEATURES, device=device)
    pooled = torch.randn(batch, 512, device=device)
    cond = Condition(pooled, torch.zeros(batch, 0, 512, device=device), None, null)
    return noise, torch.ones(noise.shape[:2], dtype=torch.bool, device=device), cond


def options(sampler: str, steps: int) -> SamplerOptions:
    """Returns the options of a sampler with a given number of steps."""
    return SamplerOptions(sampler=sampler, num_inference_steps=steps)


def latency(denoise: Denoise, size: Size) -> list[Row]:
    """Times the samplers `consistency` and `ancestral` for two batch sizes and several numbers of steps.

    Returns one row per batch size and number of steps, with seconds per run and motions per second.
    """
    guided = classifier_free_guidance(denoise, GUIDANCE, FEATURES)
    rows: list[Row] = []
    first: float | None = None
    for batch in (1, 64):
        fixed, mask, cond = inputs(batch, size)
        ids = [str(number) for number in range(batch)]
        noise = seeded_noise(ids, *fixed.shape[1:], seed=0, replication=0, like=fixed)
        sample = partial(GaussianDiffusion().sample, noise=noise, mask=mask, cond=cond)

        runs: dict[str, Callable[[], object]] = {}
        for steps in (1, 2, 4):
            runs[f"{steps}, distilled"] = partial(
                sample, denoise, options=options("consistency", steps)
            )
        runs["10"] = partial(sample, guided, options=options("ancestral", 10))
        times = take_turns(runs, size.rounds, size.device)

        for steps in (50, 1000):
            estimate = times["10"] * steps / 10
            run = {"": partial(sample, guided, options=options("ancestral", steps))}
            if estimate > size.longest:
                times[f"{steps:,}, estimated from 10"] = estimate
            else:
                times[f"{steps:,}"] = take_turns(
                    run, 1 if estimate > 1 else size.rounds, size.device
                )[""]

        for name, taken in times.items():
            first = first or taken
            row: Row = {"batch": str(batch), "steps": name, "seconds": taken}
            rows.append(row | {"motions per second": batch / taken, "ratio": taken / first})
    return rows


def samplers(denoise: Denoise, size: Size) -> list[Row]:
    """Times the samplers in `RUNS` and returns one row per sampler."""
    fixed, mask, cond = inputs(BATCH, size)
    counted = {}
    turns = {}
    for process, sampler, steps in RUNS:
        name = f"{sampler} {steps}"
        counted[name] = Counted(classifier_free_guidance(denoise, GUIDANCE, FEATURES))
        turns[name] = partial(
            process.sample, counted[name], lambda draw: fixed, mask, cond, options(sampler, steps)
        )
    times = take_turns(turns, size.rounds, size.device)

    rows: list[Row] = []
    for _, sampler, steps in RUNS:
        name = f"{sampler} {steps}"
        calls = counted[name].calls // (size.rounds + 1)
        row: Row = {
            "sampler": sampler,
            "steps": "" if sampler == "dopri5" else str(steps),
            "network calls": calls,
        }
        row |= {"ms": 1000 * times[name], "ms per call": 1000 * times[name] / calls}
        rows.append(row | {"ratio": times[name] / next(iter(times.values()))})
    return rows


def loops(size: Size) -> list[Row]:
    """Times the loop of each sampler, per network call at batch size 1, and the drawing of noise."""
    fixed, mask, cond = inputs(1, size)
    keep = torch.zeros_like(fixed, dtype=torch.bool)
    keep[:, : size.frames // 4] = True
    stored = {rows: torch.randn(rows, *fixed.shape[1:], device=size.device) for rows in (1, 2)}

    def constant(x_t: Tensor, *_: object) -> Tensor:
        return stored[len(x_t)]

    guided = classifier_free_guidance(constant, GUIDANCE, FEATURES)
    columns = ("alone", "guided", "edited", "guided and edited")
    rows: list[Row] = []
    for process, sampler in {
        (type(process), sampler): (process, sampler) for process, sampler, _ in RUNS
    }.values():
        row: Row = {"sampler": sampler}
        for column, (edit, denoise) in zip(
            columns, product((None, Edit(fixed, keep, "x0")), (constant, guided)), strict=True
        ):
            if edit is not None and sampler == "dopri5":  # cannot edit
                row[column] = None
                continue
            counted = Counted(denoise)
            run = partial(
                process.sample,
                counted,
                lambda draw: fixed,
                mask,
                cond,
                options(sampler, 50),
                edit=edit,
            )
            rounds = 2 * size.rounds
            taken = take_turns({"": run}, rounds, size.device)[""]
            row[column] = 1000 * taken * (rounds + 1) / counted.calls
        rows.append(row)

    for batch in (1, 64):
        ids = [str(number) for number in range(batch)]
        noise = seeded_noise(ids, *fixed.shape[1:], seed=0, replication=0, like=fixed)
        taken = take_turns({"": partial(noise, 1)}, 2 * size.rounds, size.device)[""]
        row = {"sampler": f"noise, batch {batch}", "alone": 1000 * taken}
        rows.append(row | dict.fromkeys(columns[1:]))
    return rows


@torch.no_grad()
def measure(settings: Settings) -> Section:
    """Times sampling and returns the page section."""
    torch.manual_seed(0)
    size = Size(settings.device)
    if settings.quick:
        size = Size(settings.device, frames=4, latent_dim=16, num_layers=1, rounds=1, longest=0.0)
    network = MDMEncoder(
        FEATURES,
        FEATURES,
        512,
        latent_dim=size.latent_dim,
        ff_size=2 * size.latent_dim,
        num_layers=size.num_layers,
        num_heads=4,
        dropout=0.1,
    )
    encoder = network.eval().to(size.device)

    steps = latency(encoder, size)
    ten = {row["batch"]: float(row["seconds"] or 0) for row in steps if row["steps"] == "10"}
    return section(
        "Sampling",
        f"""MDM's encoder has {sum(p.numel() for p in encoder.parameters()):,} parameters. Motions have {size.frames}
        frames of {FEATURES} features and are sampled on the device "{size.device}" with a guidance scale of
        {GUIDANCE}, so a network call processes two rows per motion. Latency and throughput are measured with the
        ancestral sampler and include the time for drawing noise. "Distilled" refers to the sampler for distilled
        models, without guidance. The samplers are compared with {BATCH} motions per batch. The loops are timed without
        a network, for a single motion. Values are medians over {size.rounds} rounds.""",
        f"With 10 steps, sampling one motion takes {1000 * ten['1']:.0f} ms, and batches of 64 yield "
        f"{64 / ten['64']:.0f} motions per second.",
        {
            "latency at batch 1 and throughput at batch 64": steps,
            "samplers": samplers(encoder, size),
            "milliseconds per network call that the loop itself takes": loops(size),
        },
    )


if __name__ == "__main__":
    show(measure(Settings()))
