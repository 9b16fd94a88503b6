"""`speed=fast`: bfloat16, compilation, and cheaper dropout, attention and GRUs.

See docs/benchmarks/speed.md.
"""

import math
from typing import ClassVar

import torch
from torch import Tensor, nn

from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.config import Config
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.denoisers.layers import Attention
from flame_mdm.errors import say
from flame_mdm.task import GeneratorTask, Task
from flame_mdm.training.attention import attention
from flame_mdm.training.recurrence import FastGRU

COMPILED_FROM = 5000
"""Minimum number of training steps in runs that compile the network.

In shorter runs, compilation would take more time than it saves.
"""
PAD_MULTIPLE = 32
"""Batches for a compiled network are padded to multiples of this number of frames.

The network is compiled once per padded length.
"""
# Maximum number of lengths and modes for which the network is compiled. Torch's default is 8.
MOST_SHAPES = 64


def accelerate(task: Task, data: MotionDataModule, config: Config) -> str:
    """Prepares the task and the data for `speed=fast` before training. Returns the trainer's precision.

    On CUDA, training uses bfloat16 if the device supports it. In runs of at least `COMPILED_FROM`
    steps, it also uses a compiled denoiser.

    On a CPU, training uses `CheapDropout`, `attention` (which does not drop attention weights),
    `FastGRU` and, if the CPU has instructions for bfloat16 products, bfloat16. Networks with an
    `nn.GRU` that `FastGRU` does not replace are trained in float32, because `nn.GRU` takes longer
    in bfloat16 on a CPU. The denoiser is not compiled: on a CPU, compilation takes minutes and
    does not make the steps faster.

    If the recipe sets a precision other than 32-true, this precision is kept.
    """
    trainer, supported = config["trainer"], False
    device = trainer["accelerator"]
    if device in ("auto", "gpu"):
        device = (
            "cuda"
            if torch.cuda.is_available()
            else "mps"
            if torch.backends.mps.is_available()
            else "cpu"
        )
    if device == "cuda":
        supported = torch.cuda.is_bf16_supported(including_emulation=False)
        if isinstance(task, GeneratorTask) and trainer["max_steps"] >= COMPILED_FROM:
            say(
                "compiling the network: the first steps take longer. In later runs, compilation "
                "takes less time"
            )
            denoiser = task.generator.denoiser
            # Networks that do not mask padding would learn from it.
            if denoiser.mask_padding:
                data.pad_multiple = max(data.pad_multiple, PAD_MULTIPLE)
            torch._dynamo.config.recompile_limit = MOST_SHAPES
            denoiser.compile(dynamic=False)
    elif device == "cpu":
        has = torch.cpu.get_capabilities()
        _simplify(task)
        recurs = any(isinstance(module, nn.GRU) for module in task.modules())
        supported = (has.get("avx512_bf16") or has.get("amx_bf16")) and not recurs
    return "bf16-mixed" if supported and trainer["precision"] == "32-true" else trainer["precision"]


def _simplify(network: nn.Module) -> None:
    """Replaces dropout with `CheapDropout`, attention with `attention` and GRUs with `FastGRU`."""
    for module in list(network.modules()):
        if isinstance(module, Attention | LearnedTokens):
            module.attend = attention
        for name, child in module.named_children():
            if isinstance(child, nn.Dropout):
                setattr(module, name, CheapDropout(child.p).train(child.training))
            elif isinstance(child, nn.GRU) and FastGRU.replaces(child):
                setattr(module, name, FastGRU(child).train(child.training))


class CheapDropout(nn.Module):
    """Dropout that draws one 64-bit random number for every 32 elements.

    The probability is rounded to a multiple of 2^-15. On a CPU, torch's dropout draws one random
    number per element in a single thread, which takes a fifth of the time of a training step.

    A random number is split into four 16-bit integers x. Each of them becomes eight integers
    a x + b (modulo 2^16). The eight odd numbers a and the eight numbers b are drawn once per call.
    Any two of the integers are independent, because x and b are uniformly distributed (universal
    hashing, Carter and Wegman 1979).
    """

    # Number of 16-bit integers that are computed from each drawn one
    COPIES = 8
    # Size of a floating-point number in bytes -> the integer of the same size
    INTEGERS: ClassVar = {2: torch.int16, 4: torch.int32, 8: torch.int64}

    def __init__(self, p: float):
        super().__init__()
        self.p = p
        self.threshold = round((1 - p) * 2**15) - 2**14

    def forward(self, x: Tensor) -> Tensor:
        """Drops some elements of `x` and scales the others. Returns `x` in evaluation mode."""
        if not self.training or self.p == 0:
            return x
        numbers = self._random_integers(x.numel()).view(x.shape)

        # Torch compares 16-bit integers and converts booleans without vector instructions. Integer
        # arithmetic is faster: the sign of the difference becomes all bits of a kept element, and
        # these bits select the bits of the factor.
        numbers.bitwise_right_shift_(1)
        kept = numbers.sub_(self.threshold).bitwise_right_shift_(15)
        integer = self.INTEGERS[x.element_size()]
        factor = torch.tensor(1 / (1 - self.p), dtype=x.dtype).view(integer)
        return x * kept.to(integer).bitwise_and_(factor).view(x.dtype)

    def _random_integers(self, count: int) -> Tensor:
        """Returns random 16-bit integers (count,)."""
        words = torch.empty(math.ceil(count / (4 * self.COPIES)), dtype=torch.int64)
        words.random_(-(2**63), None)
        shape = (2, self.COPIES, 1)
        factors, offsets = torch.randint(-(2**15), 2**15, shape, dtype=torch.int16)
        numbers = words.view(torch.int16) * (2 * factors + 1) + offsets
        return numbers.flatten()[:count]
