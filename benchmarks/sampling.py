"""Sampling time by sampler and number of steps: `python benchmarks/sampling.py`.

Uses two denoisers: a stub that costs almost nothing, to measure the sampling loop itself, and MDM's encoder. Samplers
take turns within a run, so that a busy machine slows all of them. Prints medians over the runs and their ratio to the
first row.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from flame_mdm.denoisers.mdm import MDMEncoder
from flame_mdm.motion import Condition, Denoise
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.processes.samplers import CountedDenoise

RUNS = [
    (GaussianDiffusion(), "ancestral", 50),
    (GaussianDiffusion(), "ddim", 50),
    (GaussianDiffusion(), "dpm_solver_pp_2m", 50),
    (GaussianDiffusion(), "ddim", 10),
    (GaussianDiffusion(), "dpm_solver_pp_2m", 10),
    (FlowMatching(), "euler", 50),
    (FlowMatching(), "euler", 10),
    (FlowMatching(), "midpoint", 10),
    (FlowMatching(), "heun", 10),
    (FlowMatching(), "rk4", 10),
    (FlowMatching(), "dopri5", 1),
]


def stub(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
    """A denoiser with a single operation."""
    return 0.5 * x_t


@torch.no_grad()
def measure(denoise: Denoise, args: argparse.Namespace) -> None:
    """Prints one row per sampler."""
    mask = torch.ones(args.batch, args.frames, dtype=torch.bool, device=args.device)
    null = Condition(torch.zeros(1, 512), torch.zeros(1, 0, 512), None)
    cond = Condition(torch.randn(args.batch, 512), torch.zeros(args.batch, 0, 512), None, null)
    for part in (cond, null):
        part.pooled, part.tokens = part.pooled.to(args.device), part.tokens.to(args.device)
    guided = classifier_free_guidance(denoise, args.guidance_scale, args.features)
    fixed = torch.randn(args.batch, args.frames, args.features, device=args.device)
    samples: list[Callable[[Denoise], Tensor]] = [
        lambda counted, process=process, sampler=sampler, count=count: process.sample(
            counted, lambda draw: fixed, mask, cond, sampler=sampler, num_inference_steps=count
        )
        for process, sampler, count in RUNS
    ]
    seconds: list[list[float]] = [[] for _ in RUNS]
    calls = [0] * len(RUNS)
    for repeat in range(args.repeats + 1):
        for index, sample in enumerate(samples):
            counted = CountedDenoise(guided)
            start = time.perf_counter()
            sample(counted).sum().item()  # waits for the device
            if repeat:  # the first round warms up
                seconds[index].append(time.perf_counter() - start)
            calls[index] = counted.calls
    medians = [statistics.median(times) for times in seconds]
    print(f"{'sampler':<18}{'steps':>6}{'NFE':>6}{'ms':>10}{'ms/NFE':>9}{'ratio':>8}")
    for (_, sampler, count), nfe, median in zip(RUNS, calls, medians, strict=True):
        steps = "-" if sampler == "dopri5" else count
        print(
            f"{sampler:<18}{steps:>6}{nfe:>6}{1e3 * median:>10.1f}{1e3 * median / nfe:>9.2f}{median / medians[0]:>8.2f}"
        )


def main() -> None:
    """Measures both denoisers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--features", type=int, default=263)
    parser.add_argument("--latent-dim", type=int, default=64)
    parser.add_argument("--num-layers", type=int, default=2)
    parser.add_argument("--guidance-scale", type=float, default=2.5)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    torch.manual_seed(0)
    print(f"{args.batch} motions of {args.frames} x {args.features} on {args.device}, scale {args.guidance_scale}")
    print("\nstub")
    measure(stub, args)
    size = {"latent_dim": args.latent_dim, "ff_size": 2 * args.latent_dim, "num_layers": args.num_layers}
    encoder = MDMEncoder(args.features, args.features, 512, num_heads=4, dropout=0.1, **size)
    print(f"\nMDMEncoder, {sum(p.numel() for p in encoder.parameters()):,} parameters")
    measure(encoder.eval().to(args.device), args)


if __name__ == "__main__":
    main()
