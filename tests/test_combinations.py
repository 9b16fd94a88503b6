"""Every denoiser with every process and with every condition: trains, samples, and keeps what the contracts promise."""

from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
import torch
from torch import Tensor

from flame_mdm.batch import MotionBatch, length_mask
from flame_mdm.config import EXPERIMENTS, compose, instantiate, parameters
from flame_mdm.processes import samplers as sampler_functions
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.task import GeneratorTask

TINY = {
    "latent_dim": 16,
    "ff_size": 16,
    "num_layers": 1,
    "num_heads": 2,
    "channels": [8, 8],
    "num_groups": 4,
}
CONTEXT = 3
TINY |= {"context_frames": CONTEXT}
FLOW = "flow_matching"
PROCESSES = {
    **{
        prediction: {"process": "diffusion", "prediction": prediction}
        for prediction in ("x0", "epsilon", "velocity")
    },
    **{"learned_range": {"process": "flame"}, FLOW: {"process": FLOW}},
}
CALLS_A_STEP = {"midpoint": 2, "heun": 2, "rk4": 4}
LENGTHS = [11, 8, 5]
TEXTS = ["a person walks", "a person jumps twice and turns to the left", ""]
ACTIONS = ["walk", "jump", "sit"]


@cache
def recipe(*overrides: str) -> dict[str, Any]:
    return compose("synthetic/mdm", overrides)


def part(group: str, option: str) -> dict[str, Any]:
    return recipe(f"{group}={option}")[group]


def denoisers() -> Iterator[tuple[str, dict[str, Any]]]:
    """The options of `experiments/denoiser` that differ in more than their sizes."""
    seen = []
    for path in sorted((EXPERIMENTS / "denoiser").glob("*.yaml")):
        config: Any = read_package_yaml(path)
        config |= {"dropout": 0.0}
        config |= {key: value for key, value in TINY.items() if key in config}
        config |= {"max_frames": 20} if "max_frames" in config else {}
        if config not in seen:
            seen.append(config)
            yield path.stem, config


DENOISERS = dict(denoisers())


def build(denoiser: str, process: str, condition: str = "learned") -> GeneratorTask:
    """A tiny task in float64, so that only real differences show."""
    config = recipe() | {"denoiser": DENOISERS[denoiser]}
    options = dict(PROCESSES[process])
    config["process"] = part("process", options.pop("process")) | options
    if "num_train_timesteps" in config["process"]:
        config["process"]["num_train_timesteps"] = 10
    config["condition"] = part("condition", condition) | (
        {} if condition == "none" else {"features": 16}
    )
    if condition == "action" and "project_condition" in parameters(config["denoiser"]["_target_"]):
        config["denoiser"] = config["denoiser"] | {"project_condition": False}
    config["task"] = config["task"] | {
        "cond_drop_prob": 0.5,
        "guidance_scale": 2.5,
        "num_inference_steps": 4,
    }
    config["task"]["sampler"] = samplers(process)[0]
    if "target_encoder" in config["denoiser"]:
        config["task"]["targets"] = recipe("task=generation_targets")["task"]["targets"]
    torch.manual_seed(0)
    representation = instantiate(config["representation"])
    representation.mean.normal_()
    representation.std.uniform_(0.5, 1.5)
    task = GeneratorTask.build(config, representation, actions=ACTIONS).double()
    task.add_facts({"max_frames": max(LENGTHS)})
    return task


def generated(
    task: GeneratorTask, motions: MotionBatch, options: SamplerOptions | None = None
) -> Tensor:
    """Samples motions; a denoiser with a context continues the same random frames."""
    x = torch.randn(CONTEXT, 263, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    prefix = x.expand(len(motions), -1, -1) if task.generator.denoiser.context_frames else None
    return task.generator.generate(motions, options, prefix=prefix)


def samplers(process: str) -> list[str]:
    return list((FlowMatching if process == FLOW else GaussianDiffusion).samplers)


def batch(rows: slice = slice(None), frames: int | None = None) -> MotionBatch:
    """Motions of mixed lengths; `rows` chooses some, `frames` pads further."""
    mask = length_mask(torch.tensor(LENGTHS)[rows], frames)
    x = torch.randn(
        len(LENGTHS),
        max(LENGTHS),
        263,
        generator=torch.Generator().manual_seed(1),
        dtype=torch.float64,
    )
    x = torch.nn.functional.pad(x, (0, 0, 0, 20))[rows, : mask.shape[1]] * mask[..., None]
    ids = [f"motion {i}" for i in range(len(LENGTHS))][rows]
    return MotionBatch(x, mask, ids, TEXTS[rows], torch.arange(len(LENGTHS))[rows])


each_denoiser = pytest.mark.parametrize("denoiser", DENOISERS)
# What reads the condition is the denoiser: other conditions are combined with one process.
PAIRS = [(process, "learned") for process in PROCESSES] + [("x0", "action"), ("x0", "none")]


@pytest.fixture(autouse=True)
def few_steps_of_adaptive_samplers(monkeypatch):
    """Other tests compare the motions of adaptive samplers; here, shapes and masks count."""
    monkeypatch.setattr(sampler_functions, "TOLERANCE", 0.01)


@pytest.mark.parametrize(("process", "condition"), PAIRS)
@each_denoiser
def test_trains_and_samples(denoiser, process, condition, subtests):
    task, motions = build(denoiser, process, condition), batch()
    # Such a denoiser reads tokens instead of the pooled vector.
    if condition == "none" and DENOISERS[denoiser].get("max_tokens"):
        with pytest.raises(
            ValueError, match="needs condition tokens, but the condition encoder returns none"
        ):
            generated(task, motions)
        return
    optimizer = task.make_optimizer()
    reached: set[str] = set()
    task.train()
    for step in range(3):
        optimizer.zero_grad()
        loss = task.training_step(motions, step)
        assert loss.isfinite()
        loss.backward()
        reached |= {
            name
            for name, p in task.named_parameters()
            if p.grad is not None and p.grad.abs().sum() > 0
        }
        optimizer.step()
    assert reached == {name for name, _ in task.named_parameters()}, "parameters without a gradient"
    assert {"train/loss", "train/mse"} <= task.reported.keys()
    assert ("train/vlb" in task.reported) == (process == "learned_range")
    for sampler in samplers(process):
        with subtests.test(sampler=sampler):
            x = generated(task, motions, SamplerOptions(sampler=sampler))
            assert x.shape == motions.x.shape
            assert x.isfinite().all()
            assert (x[~motions.mask] == 0).all()
            assert x[motions.mask].std() > 0.01
    assert task.training


@pytest.mark.parametrize("process", ["x0", "learned_range", FLOW])
@each_denoiser
def test_a_motion_does_not_depend_on_padding_or_neighbors(denoiser, process, subtests):
    task = build(denoiser, process)
    together, longer = generated(task, batch()), generated(task, batch(frames=17))
    for row, length in enumerate(LENGTHS):
        alone = generated(task, batch(slice(row, row + 1)))
        for other in (longer[row, :length], alone[0, :length]):
            with subtests.test(row=row):
                torch.testing.assert_close(other, together[row, :length], rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("process", "sampler"), [(p, s) for p in ("x0", FLOW) for s in samplers(p)]
)
def test_one_encoding_a_run_and_one_forward_a_call(process, sampler, subtests):
    for guidance_scale, copies in ((2.5, 2), (1.0, 1)):
        with subtests.test(guidance_scale=guidance_scale):
            task, encodings, forwards = build("mdm_decoder_text", process), [], []
            model = task.generator
            model.condition.register_forward_hook(lambda *_, calls=encodings: calls.append(1))
            model.denoiser.register_forward_hook(
                lambda _, x, __, calls=forwards: calls.append(len(x[0]))
            )
            options = SamplerOptions(
                sampler=sampler, num_inference_steps=5, guidance_scale=guidance_scale
            )
            model.generate(batch(), options)
            assert len(encodings) == 1
            assert set(forwards) == {copies * len(LENGTHS)}
            assert sampler == "dopri5" or len(forwards) == 5 * CALLS_A_STEP.get(sampler, 1)
