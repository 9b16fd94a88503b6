"""Compilation of training steps on a CPU."""

import math
import os
import shutil
import sysconfig
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional

from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import say
from flame_mdm.task import GeneratorTask

COMPILED_FROM = 5000
"""Minimum number of training steps in runs that compile the network.

In shorter runs, compilation would take more time than it saves.
"""
COMPILES = (
    "compiling the network: the first steps take longer. In later runs, compilation takes less time"
)


def compile_steps(task: GeneratorTask, data: MotionDataModule) -> None:
    """Lets a task compile its training steps, if torch can compile for this CPU.

    Torch needs a C++ compiler and Python's header files. Steps that recompute activations are not
    compiled, because the compiler would not repeat their random draws.
    """
    if task.checkpoints_activations or type(task).loss_terms is not GeneratorTask.loss_terms:
        return
    if missing := missing_tool():
        say(f"training without compilation, which takes longer: {missing} was not found")
        return

    say(COMPILES)
    # The compiler looks at the gradients of all inputs, such as encoded captions.
    warnings.filterwarnings("ignore", "The .grad attribute of a Tensor that is not a leaf")
    denoiser = task.generator.denoiser
    _replace_layers(denoiser)
    # Networks that do not mask padding would learn from it.
    if denoiser.mask_padding:
        data.pad_multiple = math.lcm(data.pad_multiple, denoiser.frame_multiple)
    task.compiles_steps = True


def missing_tool() -> str | None:
    """Returns what torch needs to compile for a CPU and this machine lacks, or None."""
    compiler = os.environ.get("CXX", "g++")
    if not shutil.which(compiler):
        return f"the C++ compiler {compiler}"
    header = Path(sysconfig.get_path("include"), "Python.h")
    return None if header.exists() else str(header)


def _replace_layers(network: nn.Module) -> None:
    """Replaces layers by others that compute the same, and are faster when they are compiled."""
    for module in list(network.modules()):
        for name, child in module.named_children():
            if isinstance(child, nn.Conv1d) and FastConvolution.replaces(child):
                setattr(module, name, FastConvolution(child))
            elif isinstance(child, nn.ReLU):
                setattr(module, name, FastReLU())


class FastConvolution(nn.Module):
    """Computes the same as `nn.Conv1d`, but keeps all channels of a frame together in memory.

    Otherwise, torch reorders the inputs and the results of each convolution on a CPU.

    The module shares the parameters of the convolution, and their names.

    Args:
        convolution: a convolution for which `replaces` is true.
    """

    def __init__(self, convolution: nn.Conv1d):
        super().__init__()
        self.weight, self.bias = convolution.weight, convolution.bias
        self.stride = (1, *convolution.stride)
        self.padding = (0, *map(int, convolution.padding))

    @staticmethod
    def replaces(convolution: nn.Conv1d) -> bool:
        """Whether the convolution pads with zeros, and has neither groups nor dilation."""
        simple = convolution.groups == 1 and convolution.dilation == (1,)
        padded = convolution.padding_mode == "zeros" and convolution.padding != "same"
        return simple and padded

    def forward(self, x: Tensor) -> Tensor:
        """Computes the convolution (B, D, G) of the frames x (B, C, F)."""
        x = x.unsqueeze(2).contiguous(memory_format=torch.channels_last)
        weight = self.weight.unsqueeze(2)
        return functional.conv2d(x, weight, self.bias, self.stride, self.padding).squeeze(2)


class FastReLU(nn.Module):
    """Computes the same as `nn.ReLU`.

    The compiler would store a boolean for each element, which takes longer than the other
    operations of the layer. This module stores its results instead.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Replaces negative elements with 0."""
        return _Rectified.apply(x)  # type: ignore[return-value]


class _Rectified(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = x.relu()
        ctx.save_for_backward(y)
        return y

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return gradient * y.sign()
