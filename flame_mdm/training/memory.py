"""Computes how much memory a recipe needs for training, without allocating the network."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import Config, instantiate
from flame_mdm.data.crops import Crop
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.layers import Attention
from flame_mdm.denoisers.recomputation import stacked_layers
from flame_mdm.generator import sizes_of_denoiser
from flame_mdm.processes import Process
from flame_mdm.representations import Representation

TOKENS = 20
"""Number of tokens in a caption."""
FLOAT = 4
"""Number of bytes per weight, per gradient, and per value of each of Adam's two states."""


@dataclass(frozen=True)
class TrainingMemory:
    """Memory needed for training in float32, in bytes per process.

    The text encoder and the data are not included, because frozen encoders run before training, and
    data sets that are too large for memory stay on disk.

    Attributes:
        parameters: number of weights of the denoiser.
        state: weights, gradients, both states of Adam and, if the recipe averages weights, the
            average. Their size does not depend on the batch size.
        activations: tensors that the backward pass needs, for a batch of the longest motions.
            In bfloat16, they take about half as much memory.
        recomputed: the same as `activations`, but with `task.checkpoint_activations=true`.
    """

    parameters: int
    state: int
    activations: int
    recomputed: int


def training_memory(config: Config) -> TrainingMemory:
    """Returns how much memory a recipe needs for training.

    The network is built and run on torch's device "meta", whose tensors have no values.
    """
    representation: Representation = instantiate(config["representation"])
    process: Process = instantiate(config["process"])
    condition: ConditionEncoder = instantiate(config["condition"], {"num_actions": 1})
    crop: Crop = instantiate(config["data"]["crop"])
    sizes = sizes_of_denoiser(config, representation, process, condition)
    with torch.device("meta"):
        denoiser: Denoiser = instantiate(config["denoiser"], sizes)
    parameters = sum(p.numel() for p in denoiser.parameters())
    copies = 4 + bool(config["ema"])

    rows, features = config["data"]["batch_size"], representation.features
    frames = crop.longest() - denoiser.context_frames
    with torch.device("meta"):
        x_t = torch.zeros(rows, frames, features)
        cond = Condition(
            torch.zeros(rows, condition.features),
            torch.zeros(rows, TOKENS, condition.features),
            torch.ones(rows, TOKENS, dtype=torch.bool),
            prefix=torch.zeros(rows, denoiser.context_frames, features),
            target=torch.zeros(rows, 8, 4),
        )
        mask = torch.ones(rows, frames, dtype=torch.bool)
        whole, layers = _saved(denoiser, lambda: denoiser(x_t, torch.zeros(rows), mask, cond))
    inside = sum(saved for saved, _ in layers)
    inputs = sum(size for _, size in layers)
    largest = max((saved for saved, _ in layers), default=0)
    return TrainingMemory(
        parameters, copies * FLOAT * parameters, whole, whole - inside + inputs + largest
    )


def _saved(denoiser: nn.Module, forward: Callable[[], object]) -> tuple[int, list[tuple[int, int]]]:
    """Returns the number of bytes that a forward pass saves for the backward pass.

    Also returns, for each layer of `stacked_layers`, the number of bytes saved inside the layer and
    the size of its input.
    """
    weights = {p.untyped_storage()._cdata for p in denoiser.parameters()}
    kept: dict[int, Tensor] = {}  # by storage; kept alive, so that no address is used twice
    total, layers = 0, []

    def pack(x: Tensor) -> Tensor:
        nonlocal total
        storage = x.untyped_storage()
        if storage._cdata not in weights and storage._cdata not in kept:
            kept[storage._cdata] = x
            total += storage.nbytes()
        return x

    def begin(module: nn.Module, inputs: tuple[Any, ...]) -> None:
        layers.append((total, inputs[0].numel() * inputs[0].element_size()))

    def end(module: nn.Module, *_: Any) -> None:
        before, size = layers[-1]
        layers[-1] = (total - before, size)

    for layer in stacked_layers(denoiser):
        layer.register_forward_pre_hook(begin)
        layer.register_forward_hook(end)
    for module in denoiser.modules():
        if isinstance(module, Attention):
            module.attend = _fused_attention
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        forward()
    return total, layers


def _fused_attention(query: Tensor, key: Tensor, value: Tensor, **_: Any) -> Tensor:
    return _FusedAttention.apply(query, key, value)  # type: ignore[return-value]


class _FusedAttention(torch.autograd.Function):
    """Like a fused attention kernel, saves the inputs and the result, but no attention weights."""

    @staticmethod
    def forward(ctx: Any, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        result = torch.empty_like(query)
        ctx.save_for_backward(query, key, value, result)
        return result
