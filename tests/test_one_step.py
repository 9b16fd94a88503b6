"""Every recipe trains and validates one step at its own widths, with few layers; one per family in two processes."""

from __future__ import annotations

import pytest
import torch
from support.fixtures import GENERATION, recipe
from support.one_step import built, clips, shortened, two_steps

FAMILIES = ["humanml3d/flame", "humanml3d/mdm", "humanml3d/mdm_gru", "uestc/mdm", "humanml3d/mfm_t5"]


def decisive(name: str) -> str:
    """What decides how a training step is computed."""
    config = shortened(name)
    options = [config["task"]["cond_drop_prob"] > 0, config["losses"], config["optimizer"]]
    return repr([config[part] for part in ("denoiser", "process", "condition", "representation")] + options)


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


@pytest.mark.slow
def test_families_train_in_two_processes(pool):
    for name in FAMILIES:
        (ours, total), (theirs, other) = pool.run(two_steps, (name,), (name,))
        assert all(loss == loss for loss in (*ours, *theirs)), name
        assert ours != theirs, f"{name}: not of their own batches"
        assert total == other, f"{name}: not one set of weights"
