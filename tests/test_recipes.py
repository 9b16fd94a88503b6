"""The recipes against the papers' tables, the pages that are written from them, and a training step of each."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from support.fixtures import GENERATION, ROOT, recipe, script

from flame_mdm.batch import Condition, MotionBatch, length_mask
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import instantiate, recipes
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.reporting.tables.settings import value
from flame_mdm.task import GeneratorTask

generate = script("docs/generate.py")
pytestmark = pytest.mark.usefixtures("composed_once")


def test_recipes_have_the_values_of_their_papers(subtests):
    for columns in generate.TABLES.values():
        for name, column in columns.items():
            with subtests.test(name=name):
                papers = {key: cell for key, cell in column.items() if cell is not None}
                ours = generate.hyperparameters(name) if papers else {}
                differing = {
                    key for key, cell in papers.items() if not generate.same(ours.get(key), cell)
                }
                assert differing == {
                    key for row, key in generate.DEVIATIONS if row == name and key in papers
                }, name


def test_values_come_from_the_class_where_the_recipe_is_silent_and_agree_to_the_papers_digits():
    config = recipe("humanml3d/mdm")
    keys = ("optimizer.betas", "denoiser.mask_padding", "denoiser.max_frames")
    assert [value(config, key) for key in keys] == [(0.9, 0.999), True, None]
    same = [(17.880327, 17.88), (17.880327, 17.9), ((0.9, 0.999), (0.9, 0.999))]
    other = [(23.565959, 23.47), (1.04e-4, 1e-4), ("cosine", "linear"), (None, 0.1)]
    assert [generate.same(*pair) for pair in (*same, *other)] == [True] * 3 + [False] * 4


def test_the_pages_are_those_of_the_recipes():
    stale = [
        page
        for page, write in generate.PAGES.items()
        if (ROOT / "docs" / page).read_text() != write()
    ]
    assert stale == [], "python docs/generate.py writes them"


def test_recipes_of_the_papers_sets_name_paper_and_deviations(subtests):
    for name in recipes():
        with subtests.test(name=name):
            what, deviations = generate.head(name)
            if name.split("/")[0] in ("humanml3d", "kit", "babel", "humanact12", "uestc"):
                whole = (
                    "arXiv:" in what
                    and ("table" in what or "not a row of the" in what.lower())
                    and deviations
                )
                assert whole, name


def test_samplers_steps_and_prompts_suit_process_and_condition(subtests):
    for name in GENERATION:
        with subtests.test(name=name):
            config = recipe(name)
            task, total = config["task"], config["process"].get("num_train_timesteps")
            steps = task["num_inference_steps"]
            if total is None:
                assert task["sampler"] in FlowMatching.samplers, name
            else:
                assert task["sampler"] in GaussianDiffusion.samplers, name
                assert 2 <= (len(steps) if isinstance(steps, list) else steps) <= total, name
                assert not isinstance(steps, list) or (
                    steps == sorted(set(steps)) and 0 <= steps[0] <= steps[-1] < total
                )
            frames = instantiate(config["data"]["crop"]).longest()
            assert config["denoiser"].get("max_frames", frames) >= frames, name
            guided = task["guidance_scale"] != 1
            assert not guided or task["cond_drop_prob"] > 0, (
                f"{name}: guided, but never trained without condition"
            )
            prompts = config["callbacks"]["samples"]["prompts"]
            kind = config["condition"]["_target_"].rpartition(".")[2]
            assert (prompts is None) == (kind == "Unconditional"), name
            # UESTC's names are in its files
            if kind == "ActionLabels" and not name.startswith("uestc"):
                assert set(prompts) <= set(instantiate(config["data"]["source"]).actions), name


class Drawn(ConditionEncoder):
    """Stands in for a frozen language model: pooled vectors, and tokens if the recipe reads them, in its widths."""

    def __init__(self, features: int, tokens: int):
        super().__init__()
        self.features, self.tokens = features, tokens

    def forward(self, batch: MotionBatch) -> Condition:
        return self._drawn(len(batch), self._drawn(1))

    def _drawn(self, size: int, null: Condition | None = None) -> Condition:
        tokens = torch.randn(size, self.tokens, self.features)
        return Condition(
            torch.randn(size, self.features),
            tokens,
            torch.ones(tokens.shape[:2], dtype=torch.bool),
            null,
        )


def shortened(name: str) -> dict[str, Any]:
    """A recipe with one layer, or the two that U-Nets and GRUs have at least; the language model is not trained."""
    config = deepcopy(recipe(name))
    if "num_layers" in config["denoiser"]:
        config["denoiser"]["num_layers"] = 1
    if config["condition"]["_target_"].endswith("PretrainedText"):
        config["condition"]["freeze"] = True
    return config


def decisive(name: str) -> str:
    """Options of a recipe that change how a training step is computed."""
    config = shortened(name)
    options = [config["task"]["cond_drop_prob"] > 0, config["losses"], config["optimizer"]]
    return repr(
        [config[part] for part in ("denoiser", "process", "condition", "representation")] + options
    )


def built(name: str) -> GeneratorTask:
    torch.manual_seed(0)
    config = shortened(name)
    actions = [f"action {label}" for label in range(40)]
    task = GeneratorTask.build(config, instantiate(config["representation"]), actions=actions)
    condition = config["condition"]
    if condition["_target_"].endswith("PretrainedText"):
        max_tokens = condition["max_tokens"] if condition.get("tokens") else 0
        task.generator.condition = Drawn(condition["features"], max_tokens)
    task.log = lambda *_, **__: None  # type: ignore[method-assign]
    return task


def step(name: str) -> None:
    task = built(name)
    mask = length_mask(torch.tensor([24, 16]))
    x = torch.randn(*mask.shape, task.generator.representation.features) * mask[..., None]
    batch = MotionBatch(
        x, mask, ["a", "b"], ["a person walks", "a person jumps"], torch.tensor([0, 1])
    )
    optimizer = task.make_optimizer()
    before = [parameter.detach().clone() for parameter in task.parameters()]
    loss = task.training_step(batch, 0)
    loss.backward()
    assert loss.isfinite()
    lacking = [
        key for key, value in task.named_parameters() if value.requires_grad and value.grad is None
    ]
    assert not lacking, "parameters without a gradient, on which DDP would stop"
    optimizer.step()
    moved = [not torch.equal(old, new) for old, new in zip(before, task.parameters(), strict=True)]
    # Zero gradients, as of labels that are not in the batch, move nothing
    assert sum(moved) > 0.9 * len(moved)
    task.eval()
    with torch.no_grad():
        task.validation_step(batch, 0)
    values = [float(metric.compute()) for metric in task.val_losses.values()]  # type: ignore[operator]
    assert values
    assert np.isfinite(values).all()
    task.on_validation_epoch_end()


@pytest.mark.slow
def test_every_recipe_trains_and_validates_a_step():
    failures = {}
    for name in {decisive(name): name for name in reversed(GENERATION)}.values():
        try:
            step(name)
        except Exception as error:
            failures[name] = repr(error)
    assert failures == {}
