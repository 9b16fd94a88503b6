"""Values of denoisers, generators and training tasks, as recorded."""

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from support.recorded import Case, cases_of, check, combinations, outcome, record
from test_recorded_core import CPU, numbers, refusal
from test_recorded_core_more import (
    BATCH,
    FEATURES,
    MASK,
    every_process,
    motion,
)
from torch import Tensor, nn

from flame_mdm import task as task_module
from flame_mdm.batch import Condition, Edit, MotionBatch, length_mask
from flame_mdm.conditions import ConditionEncoder, Unconditional
from flame_mdm.conditions.action import ActionLabels
from flame_mdm.denoisers import layers
from flame_mdm.denoisers.flame import FLAME, cosine_first_sinusoid
from flame_mdm.denoisers.gru import MDMGRU
from flame_mdm.denoisers.mdm import MDMDecoder, MDMEncoder, condition_tokens
from flame_mdm.denoisers.recomputation import recompute_activations, stacked_layers
from flame_mdm.denoisers.target_encoders import TARGET_ENCODERS, perceptron
from flame_mdm.denoisers.unet import MaskedGroupNorm, MDMUNet, ResidualBlock
from flame_mdm.generator import (
    Blocks,
    DistilledGenerator,
    MotionGenerator,
    Parts,
    joined,
    sampling_defaults,
    sizes_of_denoiser,
)
from flame_mdm.processes import windows
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.representations import Representation
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.task import GeneratorTask, Task

NAME = "core_models"


# Denoisers


def with_weights(module: nn.Module, seed: int = 0, scale: float = 0.4) -> Any:
    """A module in float64 with random weights, for sampling."""
    module = module.double().eval()
    for number, parameter in enumerate(module.parameters()):
        parameter.data = scale * numbers(900 + seed + number, *parameter.shape)
    return module


def seen_by_denoisers(width: int, tokens: int = 4) -> tuple[Tensor, Tensor, Tensor, Condition]:
    token_mask = length_mask(torch.tensor([2, 4, 3]).clamp(max=tokens), tokens)
    cond = Condition(
        numbers(50, BATCH, width), numbers(51, BATCH, tokens, width), token_mask,
        prefix=numbers(52, BATCH, 2, FEATURES), target=numbers(53, BATCH, 8, 4),
        target_mask=torch.tensor([True, False, True]),
    )  # fmt: skip
    return motion(54), torch.tensor([0.0, 7.5, 999.0]).double(), MASK, cond


BASE = dict[str, Any](latent_dim=8, ff_size=10, num_layers=2, num_heads=2, dropout=0.1)


def small(**changes: Any) -> dict[str, Any]:
    """The sizes of a small denoiser, with other arguments."""
    return BASE | changes


def outputs_of(kind: type[Any], width: int, options: Mapping[str, Any]) -> Any:
    """The output and the facts of a denoiser, with padding of other content and length."""
    denoiser = with_weights(kind(FEATURES, 5, width, **options))
    x_t, t, mask, cond = seen_by_denoisers(width)
    output = denoiser(x_t, t, mask, cond)
    other = denoiser(torch.where(mask[..., None], x_t, 9.0), t, mask, cond)
    return [
        [row[:4] for row in output], output[:, -1], other, denoiser.mask_padding,
        denoiser.context_frames, denoiser(x_t[1:2], t[:1], mask[1:2],
        cond.select(torch.tensor([1]))),
        {name: list(weight.shape) for name,
        weight in denoiser.named_parameters() if "layers" not in name},
    ]  # fmt: skip


def attempts(kind: type[Any], chosen: list[dict[str, Any]]) -> Any:
    results = []
    for row in chosen:
        options = dict(row)
        width = options.pop("width")
        results.append((row, outcome(lambda: outputs_of(kind, width, options))))  # noqa: B023
    return results


def outputs_of_encoders() -> Any:
    choices = combinations(
        4, 24, width=(0, 3, 8), project_condition=(True, True, False), max_tokens=(0, 4, 7, 3),
        mask_padding=(True, False), condition_frames=(False, True),
    )  # fmt: skip
    able = [choice for choice in choices if choice["width"] or choice["max_tokens"] < 4]
    return attempts(MDMEncoder, [BASE | {"width": 3}, *(BASE | choice for choice in able)])


def outputs_of_decoders() -> Any:
    choices = combinations(
        5, 34, width=(0, 3, 8), project_condition=(True, True, False), memory=("add", "concat"),
        input_token=("none", "condition", "time"), token_memory=(False, True),
        mask_padding=(True, False), context_frames=(0, 2), condition_frames=(False, True),
        target_encoder=("none", "single", "split", "multi"), target_layers=(1, 2),
    )  # fmt: skip
    return attempts(MDMDecoder, [BASE | {"width": 3}, *(BASE | choice for choice in choices)])


def outputs_of_flame() -> Any:
    choices = combinations(
        6, 22, width=(0, 3), max_frames=(6, 7, 20), length_token=(True, False),
        cross_attention=(True, False), condition_frames=(False, True), length_unit=(1, 2, 4),
    )  # fmt: skip
    plain = BASE | {"width": 3, "max_frames": 9}
    short = BASE | {"width": 3, "max_frames": 5}
    return attempts(FLAME, [plain, short, *(BASE | choice for choice in choices)])


def outputs_of_other_networks() -> Any:
    gru: dict[str, Any] = {"latent_dim": 8, "num_layers": 2, "dropout": 0.1}
    choices = combinations(
        7, 8, width=(0, 3, 8), project_condition=(True, False), recur_over_batch=(False, True)
    )
    unet: dict[str, Any] = {"latent_dim": 8, "dropout": 0.1}
    others = combinations(
        8, 8, width=(0, 3, 8), project_condition=(True, False), channels=([4], [4, 8], [6, 4, 8]),
        num_groups=(2, 4),
    )  # fmt: skip
    return [
        attempts(MDMGRU, [gru | {"width": 3}, *(gru | choice for choice in choices)]),
        attempts(MDMUNet, [unet | choice for choice in others]),
    ]


def refused_networks() -> Any:
    decoders = [
        {"memory": "concat"}, {"context_frames": -1}, {"context_frames": 1.0},
        {"context_frames": True},
        {"target_encoder": "single", "target_layers": 0}, {"target_encoder": "split",
        "latent_dim": 12},
        {"num_heads": 3}, {"num_heads": 0}, {"project_condition": False}, {"num_heads": 8},
    ]  # fmt: skip
    units: list[dict[str, Any]] = [{"length_unit": unit} for unit in (0, -2, 1.5, True, 1)]
    x_t, t, mask, cond = seen_by_denoisers(3)
    context = MDMDecoder(FEATURES, 5, 3, **BASE, context_frames=3).double()
    reading = MDMEncoder(FEATURES, 5, 3, **BASE, max_tokens=4).double()
    return [
        [refusal(lambda o=options: MDMDecoder(FEATURES, 5, 3,
        **(BASE | o))) for options in decoders],
        [refusal(lambda o=unit: FLAME(FEATURES, 5, 3, **BASE, max_frames=9,
        **o)) for unit in units],
        [
            refusal(lambda p=prefix: context(x_t, t, mask, replace(cond, prefix=p)))
            for prefix in (None, cond.prefix, motion(55)[:, :3], motion(55)[:, :4])
        ],
        [
            refusal(lambda c=chosen: reading(x_t, t, mask, c))
            for chosen in (
                replace(cond, token_mask=None), replace(cond, tokens=cond.tokens[:, :0]),
                replace(cond, tokens=numbers(56, 3, 5, 3), token_mask=torch.ones(3, 5) > 0),
            )
        ],
        condition_tokens(cond),
    ]  # fmt: skip


def outputs_of_layers() -> Any:
    x, memory = numbers(57, 3, 6, 8), numbers(58, 3, 5, 8)
    mask, memory_mask = length_mask(torch.tensor([6, 2, 4])), length_mask(torch.tensor([5, 1, 3]))
    attention = with_weights(layers.Attention(8, 4, 0.5))
    results: list[Any] = [
        attention(x, seen, other)
        for seen, other in ((None, None), (mask, None), (None, memory), (memory_mask, memory))
    ]
    for activation in (nn.GELU, nn.ReLU):
        for crossing in (False, True):
            layer = with_weights(layers.TransformerLayer(8, 12, 2, 0.1, activation, crossing))
            results.append([layer(x, mask, memory, memory_mask), layer(x, None, memory, None)])
    results.append(with_weights(layers.Transformer(8, 12, 2, 2, 0.1))(x, mask))
    initial = layers.Attention(8, 2, 0.0)
    bound = (6 / (8 + 24)) ** 0.5
    results.append(
        [
            initial.qkv.bias.sum(),
            initial.out.bias.sum(),
            bool(initial.qkv.weight.abs().max() < bound),
        ]
    )
    positions = torch.tensor([0.0, 1.0, 17.5, 999.0])
    results.append([kind(positions, 6) for kind in (layers.sinusoid, cosine_first_sinusoid)])
    results.append([list(layers.sinusoid(positions, 4)), layers.sinusoid(positions, 5)])
    results.append(layers.with_prefix(mask, 2))
    for width, projected in ((0, True), (3, True), (8, False)):
        embedding = with_weights(layers.TimeAndCondition(8, width, projected))
        pooled, tokens, t = numbers(59, 4, width), numbers(60, 4, 2, width), positions.double()
        results.append([embedding.time(t), embedding(t, pooled), embedding(t, tokens)])
    return results


def outputs_in_training() -> Any:
    x, mask = numbers(61, 3, 6, 8), length_mask(torch.tensor([6, 2, 4]))
    results = []
    for dropout in (0.0, 1.0):
        layer = with_weights(layers.Attention(8, 4, dropout)).train()
        results.append(layer(x, mask).nan_to_num(7.0))
    for kind in (MDMEncoder, MDMDecoder):
        torch.manual_seed(0)
        denoiser = with_weights(kind(FEATURES, 5, 3, **small(dropout=0.0))).train()
        results.append(denoiser(*seen_by_denoisers(3)))
    return results


def outputs_of_target_encoders() -> Any:
    results = []
    for name, kind in TARGET_ENCODERS.items():
        for depth in (1, 3):
            encoder = with_weights(kind(16, depth))
            cond = seen_by_denoisers(3)[3]
            every, seen_target = replace(cond, target_mask=None), cond.target
            assert seen_target is not None
            free = replace(every, target=seen_target * torch.tensor([1.0, 1.0, 1.0, 0.0]))
            results.append(
                [
                    name, *encoder(cond), *encoder(every), encoder(free),
                    encoder(replace(cond, target=None)), len(list(encoder.parameters())),
                ]
            )  # fmt: skip
    sizes = [[list(p.shape) for p in perceptron(3, 5, depth).parameters()] for depth in (1, 2)]
    return results, sizes, refusal(lambda: perceptron(3, 5, 0))


def outputs_of_the_parts_of_unets() -> Any:
    x, mask = numbers(62, 3, 4, 6), MASK[:, None].double()
    none = mask * torch.tensor([1.0, 1.0, 0.0])[:, None, None]
    norms = [with_weights(MaskedGroupNorm(4, groups)) for groups in (1, 2, 4)]
    blocks = [with_weights(ResidualBlock(4, size, 5, 2, 0.1)) for size in (4, 6)]
    return [
        [[list(norm(x, seen)) for seen in (mask, none)] for norm in norms],
        [block(x, numbers(63, 3, 5), mask) for block in blocks],
        refusal(lambda: MaskedGroupNorm(6, 4)), [p.sum() for p in MaskedGroupNorm(4,
        2).parameters()],
    ]  # fmt: skip


def gradients_with_recomputation() -> Any:
    results = []
    for recomputed in (False, True):
        denoiser = with_weights(MDMDecoder(FEATURES, 5, 3, **BASE, context_frames=2))
        if recomputed:
            recompute_activations(denoiser)
        output = denoiser(*seen_by_denoisers(3))
        output.square().sum().backward()
        gradients = [p.grad for p in denoiser.parameters()]
        with torch.no_grad():
            results.append([output, gradients[::5], denoiser(*seen_by_denoisers(3))])
    unet = MDMUNet(FEATURES, 5, 3, latent_dim=8, channels=[4, 8], num_groups=2, dropout=0.0)
    return results, [type(layer).__name__ for layer in stacked_layers(unet)]


# Generators


class Points(Representation):
    """Joint positions with a factor as features; the last ones are no pose."""

    def __init__(self) -> None:
        super().__init__("points", 66, 20.0, SMPL22)
        self.mean, self.std = 0.1 * numbers(64, 66), numbers(65, 66).abs() + 0.5
        self.pose = slice(2, 50)

    def encode(self, motion: Tensor) -> Tensor:
        return motion.flatten(1)

    def decode(self, features: Tensor) -> Tensor:
        return features.unflatten(-1, (22, 3))

    def joint_features(self, joints: Any) -> Tensor:
        return self.joint_mask(joints).repeat_interleave(3)


class Words(ConditionEncoder):
    """Embeds the lengths of words."""

    features = 3

    def forward(self, batch: MotionBatch) -> Condition:
        texts = batch.text or []
        rows = [[len(word) + 0.1 * n for n, word in enumerate(text.split())] for text in texts]
        size = max(1, *map(len, rows))
        tokens = torch.tensor([row + [0.0] * (size - len(row)) for row in rows]).double()
        tokens = torch.stack([tokens.sin(), tokens.cos(), tokens / 5], -1)
        mask = length_mask(torch.tensor([len(row) for row in rows]), size)
        null = Condition(0.1 * numbers(66, 1, 3), 0.1 * numbers(67, 1, 2, 3), torch.ones(1, 2) > 0)
        return Condition(tokens.mean(1), tokens, mask, null)


def encoder_of(name: str) -> ConditionEncoder:
    if name == "action":
        return with_weights(ActionLabels(3, 4), 70)
    return Words() if name == "text" else Unconditional()


@cache
def denoiser_of(width: int, process: str, options: tuple[tuple[str, Any], ...]) -> Any:
    out = every_process()[process].out_features(66)
    return with_weights(
        MDMDecoder(66, out, width, **small(**dict(options), num_layers=1)), 71, 0.25
    )


def generator(
    name: str = "text",
    process: str = "x0",
    kind: type[MotionGenerator] = MotionGenerator,
    **options: Any,
) -> MotionGenerator:
    """A small generator with random weights and a limit of nine frames."""
    encoder, chosen = encoder_of(name), every_process()[process]
    denoiser = denoiser_of(encoder.features, process, tuple(options.items()))
    sampler = "ddim" if isinstance(chosen, GaussianDiffusion) else "euler"
    defaults = SamplerOptions(guidance_scale=2.5, sampler=sampler, num_inference_steps=3)
    model = kind(Parts(denoiser, chosen, encoder, Points()), defaults)
    model.add_facts({"max_frames": 9})
    return model.eval()


def requests_of(lengths: tuple[int, ...] = (4, 6, 1)) -> MotionBatch:
    mask = length_mask(torch.tensor(lengths))
    texts = ["a person walks", "sits", "she runs away quickly", "jumps"][: len(lengths)]
    ids = ["first", "second", "third", "fourth"][: len(lengths)]
    x = numbers(72, len(lengths), mask.shape[1], 66) * mask[..., None]
    return MotionBatch(x, mask, ids, texts, torch.tensor([2, 0, 3, 1])[: len(lengths)])


def generated_motions() -> Any:
    results = []
    for options in combinations(
        9, 40, name=("text", "action", "none"), process=("x0", "learned", "flow"),
        mask_padding=(True, False), scale=(None, 1.0, 4.0), seed=(0, 5), replication=(0, 2),
        edit=(False, True), unconditioned=(False, False, True), shared_noise=(False, True),
        training=(False, True),
    ):  # fmt: skip
        chosen = dict(options)
        model = generator(
            chosen.pop("name"), chosen.pop("process"), mask_padding=chosen.pop("mask_padding")
        )
        batch, scale = requests_of(), chosen.pop("scale")
        requested = (
            None if scale is None else SamplerOptions(guidance_scale=scale, num_inference_steps=2)
        )
        edit = Edit(batch.x + 0.5, numbers(73, 3, 6, 66) > 0.5) if chosen.pop("edit") else None
        model.train(chosen.pop("training"))
        trajectory: list[Tensor] = []
        x = model.generate(batch, requested, edit=edit, trajectory=trajectory, **chosen)
        results.append((options, list(x), trajectory, model.training, model.conditioned_on))
    return results


def generated_by_default() -> Any:
    model = generator()
    tiny = MotionGenerator(
        Parts(model.denoiser, model.process, model.condition, model.representation),
        replace(model.sampler_options, guidance_scale=None),
    ).eval()
    long = requests_of((4, 11))
    wide = generator(mask_padding=False)
    edit = Edit(long.x, numbers(74, 2, 11, 66) > 0)
    short = requests_of((4, 3))
    keep = Edit(short.x, numbers(75, 2, 4, 66) > 0, mode="x_t")
    return [
        model.generate(requests_of()), tiny.generate(requests_of()), wide.generate(requests_of()),
        wide.generate(long, edit=edit), wide.generate(short, edit=keep), model.generate(long),
        model.describe(), model.noun, str(model.device), model.facts, model.config, model.steps,
        model.sha256,
    ]  # fmt: skip


def generated_windows() -> Any:
    results = []
    for mask_padding in (True, False):
        model = generator(mask_padding=mask_padding)
        parts = windows.spans([8, 9], 9, 4)
        cover = windows.cover([(0, *part[1:]) for part in parts], [17], 4, 9, CPU)
        texts = ["walks fast", "a person jumps", "runs", "sits down now", "turns"][: len(parts)]
        cover.batch = replace(cover.batch, x=cover.batch.x.double(), text=texts)
        cover.weights = cover.weights.double()
        x = torch.zeros(1, 17, 66).double()
        batch = MotionBatch(x, x[..., 0] == 0, ["long"], [""])
        results += [
            model.generate(batch, windows=cover, unconditioned=free) for free in (False, True)
        ]
    return results


def generated_blocks() -> Any:
    model, batch = generator(context_frames=2), requests_of((4, 16, 9))
    prefix, options = 0.5 * numbers(76, 3, 2, 66), SamplerOptions(num_inference_steps=2)
    cond = model.encode(batch)
    chosen = options.over(model.sampler_options)
    results: list[Any] = [model.block_frames]
    for settings in combinations(10, 6, fade=(0, 4, 20), seed=(0, 3), edit=(False, True)):
        fade, seed = settings["fade"], settings["seed"]
        blocks = Blocks(model, batch.ids, prefix, chosen, seed=seed, fade=fade, replication=seed)
        edit = (
            Edit(numbers(77, 3, 7, 66), numbers(78, 3, 7, 66) > 0.5) if settings["edit"] else None
        )
        rows = [
            blocks.sample(cond), blocks.prefix, blocks.sample(cond, torch.tensor([3, 7, 1]), edit),
            blocks.prefix, blocks.sample(cond, edit=edit), blocks.prefix, blocks.number,
        ]  # fmt: skip
        results.append((settings, rows))
    free = Blocks(model, batch.ids, prefix, chosen, unconditioned=True)
    model.train()
    results += [free.sample(cond), model.generate(batch, options, prefix=prefix), model.training]
    results += [model.generate(batch, prefix=prefix, seed=4, replication=1, shared_noise=True)]
    results += [model.generate(batch, prefix=prefix, unconditioned=True)]
    split, rest = model.split_prefix(batch)
    results += [split, rest, model.split_prefix(rest)[1].mask, generator().split_prefix(batch)[0]]
    cover = windows.cover([(0, 0, 5)], [5], 2, 5, CPU)
    cover.batch.text = ["walks"]
    refused = [
        {"prefix": None}, {"prefix": prefix[:2]}, {"prefix": prefix[:, :1]}, {"prefix": prefix[...,
        1:]},
        {"prefix": prefix, "trajectory": []}, {"prefix": prefix, "windows": cover},
        {"prefix": prefix, "edit": Edit(batch.x, batch.x > 0)},
    ]  # fmt: skip
    results += [refusal(lambda row=row: model.generate(batch, **row)) for row in refused]
    return results


def joined_blocks() -> Any:
    return [
        joined(numbers(79, 2, context, 3), numbers(80, 2, frames, 3), fade)
        for context in (1, 2, 4) for frames in (1, 2, 6) for fade in (1, 3, 6, 9)
    ]  # fmt: skip


def encoded_and_guided() -> Any:
    batch = requests_of()
    x_t, t = numbers(81, 3, 6, 66), torch.tensor([0.0, 3.0, 11.0]).double()
    results = []
    for name in ("text", "action", "none"):
        model = generator(name)
        for free in (False, True):
            cond = model.encode(batch, free)
            for scale in (None, 1.0, 3.0):
                denoise = model.guided(cond, SamplerOptions(guidance_scale=scale), free)
                output = denoise(x_t, t, batch.mask, cond)
                results.append([name, free, cond.pooled, output, denoise is model.denoiser])
        lacking = replace(cond, null=None)
        results.append(
            model.guided(lacking, SamplerOptions(guidance_scale=3.0), False) is model.denoiser
        )
    return results


def distilled_generators() -> Any:
    results = []
    for name, process in (("text", "flow"), ("none", "x0")):
        model = generator(name, process, DistilledGenerator)
        results.append([model.process.edit_modes, model.generate(requests_of())])
        results += [
            refusal(lambda m=model, s=scale, f=free: m.check_request(s, f))
            for free in (False, True)
            for scale in (None, *(SamplerOptions(guidance_scale=g) for g in (None, 0, 1, 1.0, 2.5)))
        ]
        results.append(refusal(lambda m=model: m.generate(requests_of(), unconditioned=True)))
    return results, generator("text", "flow").check_request(None, True), FlowMatching.edit_modes


def recipe(**changes: Any) -> dict[str, Any]:
    """A small recipe."""
    config: dict[str, Any] = {
        "denoiser": {"_target_": "flame_mdm.denoisers.flame.FLAME", "max_frames": 9} | BASE,
        "process": {"_target_": "flame_mdm.processes.diffusion.GaussianDiffusion",
        "num_train_timesteps": 12},
        "condition": {"_target_": "flame_mdm.conditions.action.ActionLabels", "features": 3},
        "optimizer": {"_target_": "torch.optim.AdamW", "lr": 0.01},
        "losses": {"joints": 0.5, "velocity": 2.0, "foot_contact": 3.0, "bone_length": 1.5},
        "task": {
            "_target_": "flame_mdm.task.GeneratorTask", "cond_drop_prob": 0.4,
            "guidance_scale": 2.5,
            "sampler": "ddim", "num_inference_steps": 3,
        },
        "data": {"crop": {"unit": 2}}, "seed": 7,
    }  # fmt: skip
    return config | changes


def built_generators() -> Any:
    facts = {"max_frames": 9, "vocabulary": ["walks", "sits"]}
    model = MotionGenerator.build(recipe(), Points(), actions=["a", "b"], facts=facts)
    plain = MotionGenerator.build(recipe(data={}), Points(), actions=["a"])
    decoder = recipe(denoiser={"_target_": "flame_mdm.denoisers.mdm.MDMDecoder"} | BASE)
    parts = Parts.build(decoder, Points(), 5)
    sizes = [
        sizes_of_denoiser(recipe(**changes), Points(), process, parts.condition)
        for changes in ({}, {"data": {}}, {"data": {"crop": {}}}, {"data": {"crop": 3}})
        for process in (GaussianDiffusion(variance="learned_range"), FlowMatching())
    ]
    values: list[dict[str, Any]] = [
        {"guidance_scale": 2.0, "sampler": "ddim", "num_inference_steps": steps}
        for steps in (None, 0, 5, [1, 2], 1.5)
    ]
    values += [{"guidance_scale": float("nan"), "sampler": "ddim", "num_inference_steps": 3}]
    values += [{"guidance_scale": 1, "sampler": 3, "num_inference_steps": 3}]
    assert isinstance(model.denoiser, FLAME)
    linear: Any = nn.Linear(2, 2)
    return [
        model.facts, model.condition.seen, model.sampler_options.chosen(), model.describe(),
        model.denoiser.length_unit, plain.facts, plain.condition.seen, list(model.state_dict()),
        {name: list(weight.shape) for name, weight in parts.denoiser.named_parameters()},
        sizes, [outcome(lambda v=row: sampling_defaults(**v).chosen()) for row in values],
        refusal(lambda: Parts(linear, FlowMatching(), Words(), Points())),
        model.config == recipe(), model.conditioned_on, generator("none").conditioned_on,
    ]  # fmt: skip


# Tasks


TARGETS: dict[str, Any] = {
    "choices": [["head"], ["traj", "heading"], ["left_wrist", "pelvis"], []],
    "drop_prob": 0.5,
}


def task_of(name: str = "action", targets: bool = False, **changes: Any) -> GeneratorTask:
    """A small task in float64 with random weights."""
    options = {"target_encoder": "single", "context_frames": 2} if targets else {}
    decoder = (
        {"_target_": "flame_mdm.denoisers.mdm.MDMDecoder"}
        | BASE
        | {"dropout": 0.0, "num_layers": 1}
    )
    settings = recipe(denoiser=decoder | options)
    settings["task"] |= {"targets": TARGETS} if targets else {}
    settings["task"] |= changes.pop("task", {})
    if name == "none":
        settings["condition"] = {"_target_": "flame_mdm.conditions.Unconditional"}
    settings |= changes
    task = GeneratorTask.build(
        settings, Points(), actions=["a", "b", "c", "d"], facts={"max_frames": 9}
    )
    with_weights(task.generator.denoiser, 82, 0.25)
    with_weights(task.generator.condition, 83)
    return task.double()


def losses_of_tasks() -> Any:
    results = []
    batch = requests_of((4, 7, 3))
    for name, targets in (("action", False), ("none", False), ("action", True)):
        for process in ("diffusion.GaussianDiffusion", "flow_matching.FlowMatching"):
            changes = {"process": {"_target_": f"flame_mdm.processes.{process}"}}
            sampler = {"sampler": "euler" if "flow" in process else "ddim"}
            task = task_of(name, targets, task=sampler, **changes)
            losses = task.losses_of(batch)
            steps = [task.training_step(batch, number) for number in (0, 1, 2)]
            reported = dict(task.reported)
            task.report({"a": torch.tensor(2.5).requires_grad_(), "b": 3.0})
            results.append([losses, steps, reported, task.reported["a"], task.describe()])
            torch.manual_seed(1)
            results.append(task.dropped(replace(batch, ids=list("abcdefgh"))))
    other = task_of(seed=8)
    never, always = (task_of(task={"cond_drop_prob": chance}) for chance in (0.0, 1.0))
    results += [[task.training_step(batch, 0) for task in (other, never, always)]]
    return results


def validation_means() -> Any:
    logged: list[Any] = []
    task: Any = task_of()
    task.log = lambda *values, **options: logged.append((values, options))
    for lengths in ((4, 7, 3), (5, 2)):
        task.validation_step(requests_of(lengths), 0)
    task.on_validation_epoch_end()
    task.validation_step(requests_of((3,)), 0)
    task.on_validation_epoch_end()
    return logged


def states_of_tasks() -> Any:
    task, other = task_of(targets=True), task_of(targets=True)
    state = task.state_dict()
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.zero_()
    other.load_state_dict(dict(state))
    same = all(
        torch.equal(a, b) for a, b in zip(task.parameters(), other.parameters(), strict=True)
    )
    checkpoint: dict[str, Any] = {}
    task.on_save_checkpoint(checkpoint)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        renamed = task_module.MotionGeneration
    return [
        list(state), same, checkpoint, renamed is GeneratorTask, [str(w.message) for w in caught],
        list(nn.ModuleList([task]).state_dict())[:3], task.encoder() is task.generator.condition,
        task.noun, Task(optimizer={}, seed=1).describe(),
    ]  # fmt: skip


def refused_tasks() -> Any:
    changes: list[dict[str, Any]] = [
        {"cond_drop_prob": -0.01}, {"cond_drop_prob": 1.01}, {"cond_drop_prob": 1},
        {"targets": TARGETS},
        {"num_inference_steps": 0}, {"num_inference_steps": None}, {"sampler": "none"},
    ]  # fmt: skip
    targeted = {"targets": None}
    return [
        [refusal(lambda c=change: task_of(task=c)) for change in changes],
        refusal(lambda: task_of(targets=True, task=targeted)),
        [
            refusal(lambda c=change: task_of(task=c).on_fit_start())
            for change in changes[2:3] + changes[6:]
        ],
        [
            refusal(lambda c=change: task_of(task=c).on_fit_start())
            for change in ({"num_inference_steps": 13}, {"sampler": "euler"},
            {"sampler": "ancestral"})
        ],
    ]  # fmt: skip


def learning_rates() -> Any:
    results = []
    for warmup in (None, 0, 4, 1, -1):
        for decay in (None, 0.0, 0.3, 1.0, 1.2, -0.1):
            task = task_of(lr_warmup=warmup, lr_decay=decay)
            vars(task)["_trainer"] = SimpleNamespace(max_steps=10)

            def rates(task: GeneratorTask = task) -> Any:
                chosen: Any = task.configure_optimizers()
                if not isinstance(chosen, dict):
                    return type(chosen).__name__, len(chosen.param_groups[0]["params"])
                schedule = chosen["lr_scheduler"]
                factor = schedule["scheduler"].lr_lambdas[0]
                return [factor(step) for step in range(12)], schedule["interval"]

            results.append((warmup, decay, outcome(rates)))
    frozen = task_of()
    frozen.generator.denoiser.requires_grad_(False)
    return results, len(frozen.make_optimizer().param_groups[0]["params"])


def reports_of_steps() -> Any:
    results = []
    for step in range(6):
        task = task_of() if step == 0 else results[0][0]
        task.reported = {}
        vars(task)["_trainer"] = SimpleNamespace(global_step=step, log_every_n_steps=3)
        task.report({"x": torch.tensor(step + 0.5), "y": 2.0})
        results.append((task, task.is_reported, dict(task.reported)))
    return [row[1:] for row in results]


def clips() -> list[SimpleNamespace]:
    return [
        SimpleNamespace(captions=["a man walks", "he walks"], license="open"),
        SimpleNamespace(captions=["she sits"], license="closed"),
    ]


def set_up(task: GeneratorTask, **changes: Any) -> Any:
    """Everything that `setup` asks of the encoder and adds to the facts."""
    shares = changes.pop("shares", ("open",))
    store = SimpleNamespace(
        info={"dataset": "toy", "actions": ["walk", "sit"]}, fingerprint="abc",
        licenses=lambda: changes.get("licenses", ["open"]),
    )  # fmt: skip
    shortest = changes.get("shortest", 4)
    data = SimpleNamespace(
        choose_device=lambda size: changes.get("device") and (changes["device"], size),
        store=store, captions=lambda: ["she sits", "a man walks", "he walks"],
        crop=SimpleNamespace(
            longest=lambda: 12, min_frames=5, draw=lambda length, draw: (draw(9), shortest + length)
        ),
        train=SimpleNamespace(clips=clips()), folder=Path("/data/toy"),
        source=SimpleNamespace(may_share_captions=lambda name: name in shares,
        verbs=changes.get("verbs")),
    )  # fmt: skip
    callbacks = [SimpleNamespace(texts=["he waves", "he walks"]), SimpleNamespace()]
    vars(task)['_trainer'] = SimpleNamespace(
        datamodule=data, callbacks=callbacks, optimizers=[SimpleNamespace()], global_step=0,
        precision=changes.get("precision", "32-true"),
    )  # fmt: skip
    events: list[Any] = []
    encoder: Any = task.encoder()
    encoder.precompute = lambda texts, folder: events.append((texts, folder.as_posix()))
    encoder.load_cache = lambda texts, folder: events.append((texts, folder.as_posix())) or 77
    encoder.move_cache = lambda device: events.append(device)
    encoder.pretrain = lambda groups, seed: events.append((groups, seed))
    task.prepare_data()
    task.setup("fit")
    task.on_train_start()
    ignored: Any = task._ddp_params_and_buffers_to_ignore
    return [events, task.facts, ignored, vars(vars(task)["_trainer"].optimizers[0]), encoder.seen]


def tasks_with_data() -> Any:
    results = [
        outcome(lambda c=changes: set_up(task_of(targets=True), **c))
        for changes in (
            {}, {"device": "gpu"}, {"licenses": []}, {"precision": "bf16-mixed"},
            {"shortest": -2}, {"shortest": -3}, {"shortest": -5},
        )
    ]  # fmt: skip
    for changes in ({}, {"verbs": ["walk"]}, {"shares": ()}, {"shares": ("open", "closed")}):
        for reads in ("text", "none"):
            task = task_of()
            task.generator.conditioned_on = reads
            results.append(set_up(task, **changes))
    started = task_of()
    results.append(set_up(started))
    recomputed: Any = task_of(task={"checkpoint_activations": True, "compile": True})
    called: list[str] = []
    recomputed.generator.denoiser.compile = lambda: called.append("compiled")
    set_up(recomputed)
    layer: Any = stacked_layers(recomputed.generator.denoiser)[0]
    return results, called, type(layer.forward).__name__, started.compiles


def essential_features_in_a_generator() -> Any:
    model = MotionGenerator.build(recipe(), Essential(), actions=["a", "b", "c", "d"])
    with_weights(model.denoiser, 84, 0.2)
    with_weights(model.condition, 85)
    batch = requests_of()
    return model.double().generate(replace(batch, x=batch.x[..., :0]), seed=3)


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
