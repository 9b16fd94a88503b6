"""Cost of sampling: `python benchmarks/sampling.py`.

Three tables: milliseconds per network call that the sampling loop itself takes, with a denoiser that returns a stored
tensor; the samplers with MDM's encoder, which take turns within a run, so that a busy machine slows all of them; and
latency at batch 1 and throughput at batch 64 of that encoder for 1, 2 and 4 steps of a distilled model, which has no
guidance, and for 10, 50 and 1000 steps. Gives medians, and ratios to the first row.
"""

import argparse
import sys
from collections.abc import Callable
from functools import partial
from itertools import product

import torch
from sections import Row, Section, section, show, take_turns
from torch import Tensor

from flame_mdm.batch import Condition, Denoise, Edit
from flame_mdm.denoisers.mdm import MDMEncoder
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.samplers import CountedDenoise
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.seeds import seeded_noise

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


BATCH, FEATURES, GUIDANCE = 4, 263, 2.5


def inputs(batch: int, args: argparse.Namespace) -> tuple[Tensor, Tensor, Condition]:
    """Returns noise (B, F, D), mask (B, F) and a condition with a null."""
    null = Condition(torch.zeros(1, 512, device=args.device), torch.zeros(1, 0, 512, device=args.device), None)
    noise = torch.randn(batch, args.frames, FEATURES, device=args.device)
    pooled = torch.randn(batch, 512, device=args.device)
    cond = Condition(pooled, torch.zeros(batch, 0, 512, device=args.device), None, null)
    return noise, torch.ones(noise.shape[:2], dtype=torch.bool, device=args.device), cond


def seconds(run: Callable[[], Tensor], repeats: int, device: str) -> float:
    return take_turns({"run": run}, repeats, device)["run"]


def options(sampler: str, steps: int) -> SamplerOptions:
    return SamplerOptions(sampler=sampler, num_inference_steps=steps)


def measure_loops(args: argparse.Namespace) -> list[Row]:
    """Returns the host cost of each sampler per network call, at batch 1, and that of drawing noise."""
    fixed, mask, cond = inputs(1, args)
    keep = torch.zeros_like(fixed, dtype=torch.bool)
    keep[:, : args.frames // 4] = True
    stored = {rows: torch.randn(rows, *fixed.shape[1:], device=args.device) for rows in (1, 2)}
    guided = classifier_free_guidance(lambda x_t, *_: stored[len(x_t)], GUIDANCE, FEATURES)
    rows: list[Row] = []
    for process, sampler in {(type(process), sampler): (process, sampler) for process, sampler, _ in RUNS}.values():
        cells: list[float | None] = []
        for edit, denoise in product((None, Edit(fixed, keep, "x0")), (lambda x_t, *_: stored[len(x_t)], guided)):
            if edit is not None and sampler == "dopri5":
                cells.append(None)
                continue
            counted = CountedDenoise(denoise)
            run = partial(process.sample, counted, lambda draw: fixed, mask, cond, options(sampler, 50), edit=edit)
            taken = seconds(run, 2 * args.repeats, args.device)
            cells.append(1e3 * taken * (2 * args.repeats + 1) / counted.calls)
        names = ("alone", "guided", "edited", "guided and edited")
        rows.append({"sampler": sampler, **dict(zip(names, cells, strict=True))})
    for batch in (1, 64):
        ids = [str(number) for number in range(batch)]
        noise = seeded_noise(ids, *fixed.shape[1:], seed=0, replication=0, like=fixed)
        taken = seconds(partial(noise, 1), 2 * args.repeats, args.device)
        rows.append({"sampler": f"noise, batch {batch}", "alone": 1e3 * taken, **dict.fromkeys(names[1:])})
    return rows


def measure_steps(denoise: Denoise, args: argparse.Namespace) -> list[Row]:
    """Returns seconds per run and motions per second by batch size and number of steps, distilled and ancestral."""
    rows: list[Row] = []
    guided = classifier_free_guidance(denoise, GUIDANCE, FEATURES)
    first = 0.0
    for batch in (1, 64):
        fixed, mask, cond = inputs(batch, args)
        noise = seeded_noise([str(i) for i in range(batch)], *fixed.shape[1:], seed=0, replication=0, like=fixed)
        sample = partial(GaussianDiffusion().sample, noise=noise, mask=mask, cond=cond)
        runs = {f"{n}, distilled": partial(sample, denoise, options=options("consistency", n)) for n in (1, 2, 4)}
        runs |= {f"{n:,}": partial(sample, guided, options=options("ancestral", n)) for n in (10, 50, 1000)}
        short = 0.0
        for name, run in runs.items():
            estimate = short * int(name.replace(",", "")) / 10 if short else 0.0
            taken = estimate if estimate > args.longest else seconds(run, 1 if short else 3, args.device)
            short = short or taken * (name == "10")
            first = first or taken
            how = ", estimated from 10" if estimate > args.longest else ""
            row: Row = {"batch": str(batch), "steps": f"{name}{how}", "seconds": taken}
            rows.append(row | {"motions per second": batch / taken, "ratio": taken / first})
    return rows


def measure_samplers(denoise: Denoise, args: argparse.Namespace) -> list[Row]:
    fixed, mask, cond = inputs(BATCH, args)
    guided = classifier_free_guidance(denoise, GUIDANCE, FEATURES)
    counted = [CountedDenoise(guided) for _ in RUNS]
    runs = {
        f"{sampler} {count}": partial(process.sample, own, lambda draw: fixed, mask, cond, options(sampler, count))
        for own, (process, sampler, count) in zip(counted, RUNS, strict=True)
    }
    times = take_turns(runs, args.repeats, args.device)
    rows: list[Row] = []
    for own, (_, sampler, count) in zip(counted, RUNS, strict=True):
        taken, calls = times[f"{sampler} {count}"], own.calls // (args.repeats + 1)
        row: Row = {"sampler": sampler, "steps": "" if sampler == "dopri5" else str(count), "network calls": calls}
        row |= {"ms": 1e3 * taken, "ms per call": 1e3 * taken / calls, "ratio": taken / next(iter(times.values()))}
        rows.append(row)
    return rows


@torch.no_grad()
def measure(*words: str) -> Section:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--latent-dim", type=int, default=128)
    parser.add_argument("--num-layers", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--longest", type=float, default=20, help="seconds above which more steps are estimated")
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args(words)
    torch.manual_seed(0)
    size = {"latent_dim": args.latent_dim, "ff_size": 2 * args.latent_dim, "num_layers": args.num_layers}
    encoder = MDMEncoder(FEATURES, FEATURES, 512, num_heads=4, dropout=0.1, **size).eval().to(args.device)
    loops, samplers, steps = measure_loops(args), measure_samplers(encoder, args), measure_steps(encoder, args)
    seconds = {(row["batch"], str(row["steps"])[:2]): row for row in steps}
    latency, throughput = seconds["1", "10"]["seconds"], seconds["64", "10"]["motions per second"]
    return section(
        "Sampling",
        f"MDM's encoder with {sum(p.numel() for p in encoder.parameters()):,} parameters, motions of {args.frames} "
        f"frames of {FEATURES} features, on {args.device}, guidance {GUIDANCE} (two rows per motion in "
        "one call). Latency and throughput are those of the ancestral sampler, with noise; the samplers have "
        f"{BATCH} motions per batch; the loops alone run without a network, at batch 1.",
        f"With 10 steps, one motion takes {1000 * float(latency or 0):.0f} ms, and batches of 64 give "
        f"{float(throughput or 0):.0f} motions per second.",
        latency_at_batch_1_and_throughput_at_batch_64=steps,
        samplers=samplers,
        milliseconds_per_network_call_that_the_loop_itself_takes=loops,
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
