"""Estimated cost of training a recipe, without a GPU or data: `python benchmarks/cost.py humanml3d/mdm kit/mdm ...`

One training step of a full batch of motions of maximum length runs on PyTorch's `meta` device, where operations have
shapes but no values. The script counts floating-point operations, and the bytes of weights, gradients, optimizer state,
averaged weights and tensors saved for the backward pass. Text encoders are not counted: frozen ones are cached in
training, and trained ones are ignored.

A forward pass costs a third of a training step (forward and backward). A generated motion needs two forward passes per
sampling step, because guidance doubles the batch. Time is the number of operations divided by the sustained rate of the
GPU: 20 % of its float32 peak is about what MDM's paper reports (three days on a GeForce RTX 2080 Ti, whose peak is
13.4 TFLOP/s).
"""

import argparse
from typing import Any

import torch
from hydra.utils import get_class
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.config import compose, instantiate
from flame_mdm.task import MotionGeneration, Task

TOKENS = 30  # tokens of a caption: 20 in FLAME, 30 in MFM's T5, about that many at most in CLIP's 22
COPIES = 4  # float32 numbers per parameter: the weight, its gradient and the two moments of Adam


def training_step(task: Task, batch: MotionBatch) -> Tensor:
    """Returns the loss of a step, with a condition of the right shape instead of an encoded text."""
    features = task.condition.features
    rows = len(batch)
    real = torch.ones(rows, TOKENS, dtype=torch.bool)
    null = Condition(torch.zeros(1, features), torch.zeros(1, TOKENS, features), real[:1])
    cond = Condition(torch.zeros(rows, features), torch.zeros(rows, TOKENS, features), real, null)
    if isinstance(task, MotionGeneration):
        terms = task.process.loss(task.denoiser, batch.x, batch.mask, cond, auxiliary=task.losses)
        return terms["loss"].mean()
    return task.network(batch.x, batch.mask).square().mean()  # type: ignore[operator]


def cost(config: dict[str, Any], rows: int = 0, frames: int = 0) -> tuple[float, float, int]:
    """Returns the floating-point operations and bytes of a training step, and the trainable parameters.

    The batch has `rows` motions of `frames` frames; by default (0), those of the recipe, at their maximum length.
    """
    crop = instantiate(config["data"]["crop"])
    with torch.device("meta"):
        representation = instantiate(config["representation"])
        task = get_class(config["task"]["_target_"]).build(config, representation, actions=["walk", "run"])
        rows, frames = rows or config["data"]["batch_size"], frames or crop.longest()
        mask = torch.ones(rows, frames, dtype=torch.bool)
        batch = MotionBatch(torch.zeros(rows, frames, representation.features), mask, [str(i) for i in range(rows)])
        kept: dict[int, torch.UntypedStorage] = {}

        def keep(tensor: Tensor) -> Tensor:
            attention = tensor.ndim > 2 and tensor.shape[-1] == tensor.shape[-2]
            if not attention:  # fused attention on a GPU keeps no (N, N) weights
                storage = tensor.untyped_storage()
                kept[storage._cdata] = storage
            return tensor

        with FlopCounterMode(display=False) as counter, torch.autograd.graph.saved_tensors_hooks(keep, lambda x: x):
            loss = training_step(task.train(), batch)
            loss.backward()
    parameters = sum(p.numel() for p in task.parameters() if p.requires_grad)
    copies = COPIES + bool(config["ema"])
    return counter.get_total_flops(), 4 * copies * parameters + sum(s.nbytes() for s in kept.values()), parameters


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recipes", nargs="+")
    parser.add_argument("--tflops", type=float, default=2.7, help="sustained rate, 10^12 operations per second")
    options = parser.parse_args()
    print("| recipe | parameters, M | batch | steps | TFLOP per step | memory, GiB | hours | TFLOP per motion |")
    print("|---|---|---|---|---|---|---|---|")
    for name in options.recipes:
        config = compose(name)
        operations, size, parameters = cost(config)
        steps, rows = config["trainer"]["max_steps"], config["data"]["batch_size"]
        calls = config["task"].get("num_inference_steps", 0) * (1 + (config["task"].get("guidance_scale") != 1))
        hours = operations * steps / (1e12 * options.tflops) / 3600
        print(
            f"| `{name}` | {parameters / 1e6:.1f} | {rows} | {steps:,} | "
            f"{operations / 1e12:.2f} | {size / 2**30:.1f} | {hours:.0f} | {operations / 3e12 / rows * calls:.2f} |"
        )


if __name__ == "__main__":
    main()
