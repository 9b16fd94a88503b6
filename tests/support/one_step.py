"""One training step of a recipe at its own widths, with few layers, without data and language models."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition, MotionBatch, length_mask
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import instantiate
from flame_mdm.task import MotionGeneration
from support.fixtures import recipe

FRAMES, ACTIONS = 24, 40


class Drawn(ConditionEncoder):
    """What a frozen language model would return: vectors, and tokens where the recipe reads them, of its widths."""

    def __init__(self, features: int, tokens: int):
        super().__init__()
        self.features, self.tokens = features, tokens

    def forward(self, batch: MotionBatch) -> Condition:
        return self._drawn(len(batch), self._drawn(1))

    def _drawn(self, size: int, null: Condition | None = None) -> Condition:
        tokens = torch.randn(size, self.tokens, self.features)
        return Condition(torch.randn(size, self.features), tokens, torch.ones(tokens.shape[:2], dtype=torch.bool), null)


def shortened(name: str) -> dict[str, Any]:
    """A recipe with one layer, or the two that U-Nets and GRUs have at least; the language model is not trained."""
    config = dict(recipe(name))
    if "num_layers" in config["denoiser"]:
        config["denoiser"] = config["denoiser"] | {"num_layers": 1}
    if config["condition"]["_target_"].endswith("PretrainedText"):
        config["condition"] = config["condition"] | {"freeze": True}
    return config


def built(name: str) -> MotionGeneration:
    torch.manual_seed(0)
    config = shortened(name)
    actions = [f"action {label}" for label in range(ACTIONS)]
    task = MotionGeneration.build(config, instantiate(config["representation"]), actions=actions)
    condition = config["condition"]
    if condition["_target_"].endswith("PretrainedText"):
        task.condition = Drawn(condition["features"], condition["max_tokens"] if condition.get("tokens") else 0)
    task.log_dict = task.log = lambda *_, **__: None  # type: ignore[method-assign]
    return task


def clips(task: MotionGeneration) -> MotionBatch:
    mask = length_mask(torch.tensor([FRAMES, FRAMES - 8]))
    x = torch.randn(*mask.shape, task.representation.features) * mask[..., None]
    return MotionBatch(x, mask, ["a", "b"], ["a person walks", "a person jumps"], torch.tensor([0, 1]))


class Step(nn.Module):
    """A training step as the forward pass that DDP wraps."""

    def __init__(self, task: MotionGeneration):
        super().__init__()
        self.task = task

    def forward(self, batch: MotionBatch, number: int) -> Tensor:
        return self.task.training_step(batch, number)


def two_steps(name: str) -> tuple[list[float], float]:
    """Losses of two steps of one of several processes, and the sum of its parameters after them.

    DDP raises at the second step if a parameter of the first had no gradient.
    """
    task = built(name)
    task._ddp_params_and_buffers_to_ignore = [key for key, _ in task.named_buffers()]  # type: ignore[assignment]
    step, optimizer = nn.parallel.DistributedDataParallel(Step(task)), task.make_optimizer()
    torch.manual_seed(torch.distributed.get_rank())
    batch, losses = clips(task), []
    for number in range(2):
        optimizer.zero_grad()
        loss = step(batch, number)
        loss.backward()
        optimizer.step()
        losses.append(float(loss))
    return losses, float(sum(parameter.detach().double().sum() for parameter in task.parameters()))
