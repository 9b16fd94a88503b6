"""The recipes against the papers' tables, and the pages that are written from them."""

import importlib.util
import sys
from typing import Any

import pytest
import torch
from support.fixtures import ROOT, recipe

from flame_mdm.batch import Condition
from flame_mdm.config import instantiate, recipes
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.reporting.settings import value

SPEC = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
assert SPEC is not None
assert SPEC.loader is not None
generate: Any = importlib.util.module_from_spec(SPEC)
sys.modules["generate"] = generate
SPEC.loader.exec_module(generate)

CELLS = {
    (name, key): papers
    for table in generate.TABLES
    for name, column in table.columns.items()
    for key, papers in column.items()
    if papers is not None
}
GENERATION = [name for name in recipes() if "denoiser" in recipe(name)]
each_recipe = pytest.mark.parametrize("name", GENERATION)


@pytest.mark.parametrize("name", sorted({name for name, _ in CELLS}))
def test_a_recipe_has_the_values_of_its_paper(name):
    ours = generate.values(name)
    differing = {
        key: (ours.get(key), papers)
        for (row, key), papers in CELLS.items()
        if row == name and not generate.same(ours.get(key), papers)
    }
    assert differing.keys() == {key for row, key in generate.DEVIATIONS if row == name}, differing


def test_no_two_recipes_are_the_same():
    seen: dict[str, str] = {}
    for name in (name for name in GENERATION if name != "quickstart"):  # which is one of the others
        config = recipe(name) | {"experiment": "", "run": {}, "callbacks": {}, "logger": {}, "trainer": {}}
        same = seen.setdefault(repr(config), name)
        assert same == name, f"{name} is {same} again"


def test_values_come_from_the_class_where_the_recipe_is_silent():
    config = recipe("humanml3d/mdm")
    assert "betas" not in config["optimizer"]
    assert value(config, "optimizer.betas") == (0.9, 0.999)
    assert value(config, "denoiser.mask_padding") is True
    assert value(config, "denoiser.max_frames") is None


@pytest.mark.parametrize(
    ("ours", "papers", "same"),
    [
        (17.880327, 17.88, True),
        (17.880327, 17.9, True),
        (23.565959, 23.47, False),
        (1e-4, 1e-4, True),
        (1.04e-4, 1e-4, False),
        ((0.9, 0.999), (0.9, 0.999), True),
        ("cosine", "linear", False),
        (None, 0.1, False),
    ],
)
def test_values_agree_to_the_papers_digits(ours, papers, same):
    assert generate.same(ours, papers) == same


@pytest.mark.parametrize("page", generate.PAGES)
def test_the_pages_are_those_of_the_recipes(page):
    stale = f"docs/{page} is not what the recipes say now: python docs/generate.py writes it"
    assert (ROOT / "docs" / page).read_text() == generate.PAGES[page](), stale


def test_recipes_name_paper_and_deviations():
    for name in recipes():
        what, deviations = generate.head(name)
        if name.split("/")[0] in ("humanml3d", "kit", "babel", "humanact12", "uestc"):
            assert "arXiv:" in what
            assert "table" in what or "not a row of the" in what.lower()
            assert deviations


@pytest.mark.slow
@each_recipe
def test_the_parts_of_a_recipe_fit(name):
    """The real sizes, without their memory: one forward at the longest motion of the data with the longest text."""
    config = recipe(name)
    condition, task = config["condition"], config["task"]
    features = instantiate(config["representation"]).features
    frames = instantiate(config["data"]["crop"]).longest()
    process = instantiate(config["process"])
    width = condition.get("features", 0)
    tokens = condition.get("max_tokens", 20) if condition.get("tokens", True) else 0
    with torch.device("meta"):
        denoiser = instantiate(
            config["denoiser"], in_features=features, out_features=process.out_features(features), cond_features=width
        )
        token_mask = torch.ones(2, tokens, dtype=torch.bool)
        cond = Condition(torch.zeros(2, width), torch.zeros(2, tokens, width), token_mask)
        mask = torch.ones(2, frames, dtype=torch.bool)
        output = denoiser(torch.zeros(2, frames, features), torch.zeros(2), mask, cond)
    assert output.shape == (2, frames, process.out_features(features))
    assert config["denoiser"].get("max_frames", frames) >= frames

    if "num_train_timesteps" in config["process"]:
        assert task["sampler"] in GaussianDiffusion.samplers
        steps, total = task["num_inference_steps"], config["process"]["num_train_timesteps"]
        assert 2 <= (len(steps) if isinstance(steps, list) else steps) <= total
        assert not isinstance(steps, list) or (steps == sorted(set(steps)) and steps[0] >= 0 and steps[-1] < total)
    else:
        assert task["sampler"] in FlowMatching.samplers
    assert task["guidance_scale"] == 1 or task["cond_drop_prob"] > 0, "guided, but never trained without condition"


@each_recipe
def test_prompts_suit_the_condition(name):
    config = recipe(name)
    prompts, kind = config["callbacks"]["samples"]["prompts"], config["condition"]["_target_"].rpartition(".")[2]
    assert (prompts is None) == (kind == "Unconditional")
    if kind == "ActionLabels" and not name.startswith("uestc"):  # UESTC's names stand in its files
        assert set(prompts) <= set(instantiate(config["data"]["source"]).actions)
