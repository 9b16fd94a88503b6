"""`speed=fast`: bfloat16, compilation, and cheaper dropout, attention and GRUs.

See docs/benchmarks/speed.md.
"""

import math

import torch
from torch import Tensor, nn

from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.config import Config
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.denoisers.layers import Attention
from flame_mdm.errors import say
from flame_mdm.task import GeneratorTask, Task
from flame_mdm.training.attention import attention
from flame_mdm.training.compilation import COMPILED_FROM, COMPILES, compile_steps
from flame_mdm.training.recurrence import FastGRU

PAD_MULTIPLE = 32
"""Batches for a compiled network are padded to multiples of this number of frames.

The network is compiled once per padded length.
"""
# Maximum number of lengths and modes for which the network is compiled. Torch's default is 8.
MOST_SHAPES = 64

# Number of 16-bit integers that `CheapDropout` computes from each drawn one
COPIES = 8
# Size of a floating-point number in bytes -> the integer of the same size
INTEGERS = {2: torch.int16, 4: torch.int32, 8: torch.int64}


def accelerate(task: Task, data: MotionDataModule, config: Config) -> str:
    """Prepares the task and the data for `speed=fast` before training. Returns the trainer's precision.

    On CUDA, training uses bfloat16 if the device supports it. In runs of at least `COMPILED_FROM`
    steps, it also uses a compiled denoiser.

    On a CPU, training uses `CheapDropout`, `attention` (which does not drop attention weights),
    `FastGRU` and, if the CPU has instructions for bfloat16 products, bfloat16. Networks with an
    `nn.GRU` that `FastGRU` does not replace are trained in float32, because `nn.GRU` takes longer
    in bfloat16 on a CPU. If there is a C++ compiler, runs of at least `COMPILED_FROM` steps in
    bfloat16 compile the denoiser and its losses, once for all lengths of motions.

    If the recipe sets a precision other than 32-true, this precision is kept.
    """
    trainer, supported = config["trainer"], False
    is_long = trainer["max_steps"] >= COMPILED_FROM
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
        if isinstance(task, GeneratorTask) and is_long:
            say(COMPILES)
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
        if isinstance(task, GeneratorTask) and is_long and supported:
            compile_steps(task, data)
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

    def __init__(self, p: float):
        super().__init__()
        self.p = p

    def forward(self, x: Tensor) -> Tensor:
        """Drops some elements of `x` and scales the others. Returns `x` in evaluation mode."""
        if not self.training or self.p == 0:
            return x
        return x * dropout_factors(x.detach(), self.p)


@torch.library.custom_op(
    "flame_mdm::dropout_factors",
    mutates_args=(),
    tags=(torch.Tag.nondeterministic_seeded,),
)
def dropout_factors(x: Tensor, p: float) -> Tensor:
    """Draws a factor for each element of `x`: 0 with probability `p`, otherwise 1 / (1 - p).

    The compiler does not trace this function. Compiled networks therefore draw the same numbers.
    """
    numbers = _random_integers(x.numel()).view(x.shape)
    # Torch compares 16-bit integers and converts booleans without vector instructions. Integer
    # arithmetic is faster: the sign of the difference becomes all bits of a kept element, and
    # these bits select the bits of the factor.
    numbers.bitwise_right_shift_(1)
    kept = numbers.sub_(_threshold(p)).bitwise_right_shift_(15)
    integer = INTEGERS[x.element_size()]
    factor = torch.tensor(1 / (1 - p), dtype=x.dtype).view(integer)
    return kept.to(integer).bitwise_and_(factor).view(x.dtype)


@dropout_factors.register_fake
def _(x: Tensor, p: float) -> Tensor:
    return torch.empty(x.shape, dtype=x.dtype)


def _threshold(p: float) -> int:
    """Returns the number below which random 15-bit integers, from -2^14 on, keep an element."""
    return round((1 - p) * 2**15) - 2**14


def _random_integers(count: int) -> Tensor:
    """Returns random 16-bit integers (count,)."""
    words = torch.empty(math.ceil(count / (4 * COPIES)), dtype=torch.int64)
    words.random_(-(2**63), None)
    shape = (2, COPIES, 1)
    factors, offsets = torch.randint(-(2**15), 2**15, shape, dtype=torch.int16)
    numbers = words.view(torch.int16) * (2 * factors + 1) + offsets
    return numbers.flatten()[:count]
