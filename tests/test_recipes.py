"""The recipes against the papers' tables, and the pages that are written from them."""

import importlib.util
import sys
from functools import cache
from typing import Any

import pytest
from support.fixtures import GENERATION, ROOT, recipe

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
generate.values = cache(generate.values)  # the tables and the pages show the same ones
pytestmark = pytest.mark.usefixtures("composed_once")


def test_recipes_have_the_values_of_their_papers():
    for table in generate.TABLES:
        for name, column in table.columns.items():
            papers = {key: cell for key, cell in column.items() if cell is not None}
            ours = generate.values(name, generate.sizes) if papers else {}
            differing = {key for key, cell in papers.items() if not generate.same(ours.get(key), cell)}
            assert differing == {key for row, key in generate.DEVIATIONS if row == name and key in papers}, name


def test_no_two_recipes_are_the_same():
    seen: dict[str, str] = {}
    for name in set(GENERATION) - {"quickstart"}:  # which is one of the others
        config = recipe(name) | {"experiment": "", "run": {}, "callbacks": {}, "logger": {}, "trainer": {}}
        same = seen.setdefault(repr(config), name)
        assert same == name, f"{name} repeats {same}"


def test_values_come_from_the_class_where_the_recipe_is_silent():
    config = recipe("humanml3d/mdm")
    assert "betas" not in config["optimizer"]
    assert value(config, "optimizer.betas") == (0.9, 0.999)
    assert value(config, "denoiser.mask_padding") is True
    assert value(config, "denoiser.max_frames") is None


def test_values_agree_to_the_papers_digits():
    same = [(17.880327, 17.88), (17.880327, 17.9), ((0.9, 0.999), (0.9, 0.999))]
    other = [(23.565959, 23.47), (1.04e-4, 1e-4), ("cosine", "linear"), (None, 0.1)]
    assert [generate.same(*pair) for pair in (*same, *other)] == [True] * 3 + [False] * 4


def test_the_pages_are_those_of_the_recipes():
    stale = [page for page, write in generate.PAGES.items() if (ROOT / "docs" / page).read_text() != write()]
    assert stale == [], "python docs/generate.py writes them"


def test_recipes_name_paper_and_deviations():
    for name in recipes():
        what, deviations = generate.head(name)
        if name.split("/")[0] in ("humanml3d", "kit", "babel", "humanact12", "uestc"):
            assert "arXiv:" in what
            assert "table" in what or "not a row of the" in what.lower()
            assert deviations


def test_samplers_steps_and_prompts_suit_process_and_condition():
    for name in GENERATION:
        config = recipe(name)
        task, total = config["task"], config["process"].get("num_train_timesteps")
        steps = task["num_inference_steps"]
        if total is None:
            assert task["sampler"] in FlowMatching.samplers, name
        else:
            assert task["sampler"] in GaussianDiffusion.samplers, name
            assert 2 <= (len(steps) if isinstance(steps, list) else steps) <= total, name
            assert not isinstance(steps, list) or (steps == sorted(set(steps)) and 0 <= steps[0] <= steps[-1] < total)
        frames = instantiate(config["data"]["crop"]).longest()
        assert config["denoiser"].get("max_frames", frames) >= frames, name
        guided = task["guidance_scale"] != 1
        assert not guided or task["cond_drop_prob"] > 0, f"{name}: guided, but never trained without condition"
        prompts = config["callbacks"]["samples"]["prompts"]
        kind = config["condition"]["_target_"].rpartition(".")[2]
        assert (prompts is None) == (kind == "Unconditional"), name
        if kind == "ActionLabels" and not name.startswith("uestc"):  # UESTC's names are in its files
            assert set(prompts) <= set(instantiate(config["data"]["source"]).actions), name
