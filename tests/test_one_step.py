"""Every recipe trains and validates one step at its own widths, with few layers."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from support.fixtures import GENERATION, recipe

from flame_mdm.batch import Condition, MotionBatch, length_mask
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import instantiate
from flame_mdm.task import MotionGeneration

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


def decisive(name: str) -> str:
    """What decides how a training step is computed."""
    config = shortened(name)
    options = [config["task"]["cond_drop_prob"] > 0, config["losses"], config["optimizer"]]
    return repr([config[part] for part in ("denoiser", "process", "condition", "representation")] + options)


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


def step(name: str) -> None:
    task = built(name)
    batch, optimizer = clips(task), task.make_optimizer()
    before = [parameter.detach().clone() for parameter in task.parameters()]
    loss = task.training_step(batch, 0)
    loss.backward()
    assert loss.isfinite()
    lacking = [key for key, value in task.named_parameters() if value.requires_grad and value.grad is None]
    assert not lacking, "parameters without a gradient, on which DDP would stop"
    optimizer.step()
    moved = [not torch.equal(old, new) for old, new in zip(before, task.parameters(), strict=True)]
    assert sum(moved) > 0.9 * len(moved)  # zero gradients, as of labels that are not in the batch, move nothing
    task.eval()
    with torch.no_grad():
        task.validation_step(batch, 0)
    values = {key: float(metric.compute()) for key, metric in task.val_losses.items()}  # type: ignore[operator]
    assert values
    assert all(value == value for value in values.values())
    task.on_validation_epoch_end()


@pytest.mark.slow
def test_every_recipe_trains_and_validates_a_step():
    assert {name for name in GENERATION if "process" in recipe(name)} == set(GENERATION)
    failures = {}
    for name in {decisive(name): name for name in reversed(GENERATION)}.values():
        try:
            step(name)
        except Exception as error:
            failures[name] = repr(error)
    assert failures == {}
