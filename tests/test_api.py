"""Examples of docstrings run and print what they say, one test per public class or function."""

import doctest
from collections.abc import Iterator
from functools import cache
from importlib import import_module
from typing import Any

import pytest
import torch
from support.runs import TINY_DIP, untrained

MODULES = [
    "evaluators.evaluation",
    "evaluators.evaluator",
    "evaluators.metrics.accuracy",
    "evaluators.metrics.alignment",
    "evaluators.metrics.attributes",
    "evaluators.metrics.distribution",
    "evaluators.metrics.diversity",
    "evaluators.metrics.memorization",
    "evaluators.metrics.physics",
    "evaluators.metrics.published_physics",
    "evaluators.metrics.reconstruction",
    "evaluators.metrics.retrieval",
    "evaluators.metrics.samples",
    "flame_mdm.batch",
    "flame_mdm.checkpoints.loading",
    "flame_mdm.conditions",
    "flame_mdm.conditions.action",
    "flame_mdm.conditions.language.spelling",
    "flame_mdm.conditions.target",
    "flame_mdm.conditions.text",
    "flame_mdm.conditions.tokens",
    "flame_mdm.denoisers",
    "flame_mdm.denoisers.flame",
    "flame_mdm.denoisers.gru",
    "flame_mdm.denoisers.mdm",
    "flame_mdm.denoisers.target_encoders",
    "flame_mdm.denoisers.unet",
    "flame_mdm.formats.cleanup",
    "flame_mdm.formats.motion",
    "flame_mdm.formats.readers",
    "flame_mdm.generator",
    "flame_mdm.losses",
    "flame_mdm.processes",
    "flame_mdm.processes.diffusion",
    "flame_mdm.processes.flow_matching",
    "flame_mdm.processes.guidance",
    "flame_mdm.processes.samplers",
    "flame_mdm.processes.schedules",
    "flame_mdm.processes.windows",
    "flame_mdm.records",
    "flame_mdm.representations",
    "flame_mdm.representations.essential",
    "flame_mdm.representations.humanml",
    "flame_mdm.representations.motion272",
    "flame_mdm.representations.rifke",
    "flame_mdm.representations.rot6d",
    "flame_mdm.representations.rotation",
    "flame_mdm.representations.smpl",
    "flame_mdm.sampler_options",
    "flame_mdm.sampling.editing",
    "flame_mdm.sampling.generation",
    "flame_mdm.sampling.motion_request",
    "flame_mdm.sampling.streams",
    "flame_mdm.seeds",
    "flame_mdm.training.adaptation",
]


def examples() -> Iterator[Any]:
    """Yields the examples of each docstring of the modules, as test cases."""
    finder = doctest.DocTestFinder(exclude_empty=True)
    for name in MODULES:
        for test in finder.find(import_module(name), name):
            if test.examples:
                yield pytest.param(test, id=test.name)


@cache
def dip() -> Any:
    """A tiny model that continues frames, with random weights."""
    return untrained(TINY_DIP, max_frames=60, name="synthetic/dip")


@pytest.mark.parametrize("test", examples())
def test_the_example_of_a_docstring_prints_what_it_says(test: doctest.DocTest):
    torch.manual_seed(0)
    if any("dip" in example.source for example in test.examples):
        test.globs["dip"] = dip()
    failures: list[str] = []
    runner = doctest.DocTestRunner(
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.FAIL_FAST
    )
    runner.run(test, out=failures.append)
    assert not failures, "".join(failures)
