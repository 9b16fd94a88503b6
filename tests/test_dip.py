"""DiP, the decoder that continues clean frames: its numbers agree with the authors' code."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from support.analytic import assert_golden, motions, real, recorded
from support.fixtures import Arrays, golden, golden_cases, meta, weights
from torch import Tensor

from flame_mdm.batch import Condition, Noise
from flame_mdm.checkpoints import released_weights
from flame_mdm.checkpoints.released import import_mdm
from flame_mdm.checkpoints.released_options import Options
from flame_mdm.conditions import Unconditional
from flame_mdm.conditions.target import SLOTS, TargetConditions, requested
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.mdm import MDMDecoder
from flame_mdm.errors import UserError
from flame_mdm.generator import Blocks, MotionGenerator, Parts
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.guidance import classifier_free_guidance
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampler_options import SamplerOptions

STEM = "dip"
ENCODERS = ("single", "split", "multi")
TARGETED = [f"target_{name}" for name in ENCODERS]


@cache
def arrays() -> Arrays:
    return golden(STEM)


def config() -> dict[str, Any]:
    return meta(arrays())["config"]


def cases(*names: str) -> Callable:
    """Marks a test on the cases of the fixture that have these names."""
    return golden_cases(STEM, [name for name in names if name in arrays()])


def array(key: str, dtype: torch.dtype = torch.float32) -> Tensor:
    value = torch.from_numpy(arrays()[key])
    return value.to(dtype) if value.is_floating_point() else value


def prefix_of(key: str, dtype: torch.dtype) -> Tensor:
    return motions(arrays()[key], dtype)


@cache
def denoiser(encoder: str = "", dtype: torch.dtype = torch.float32, **changes: Any) -> Denoiser:
    """The network of the fixture, from released weights, with the options in `changes`."""
    state = weights(arrays())
    if encoder:
        state |= weights(arrays(), f"state_{encoder}/")
    options = {
        name: config()[name]
        for name in ("arch", "text_encoder_type", "context_len", "pred_len", "mask_frames")
    }
    released = import_mdm(
        state, Options(**options | {"num_heads": config()["num_heads"], **changes})
    )
    network = released.network(*released.features, **released.options | {"dropout": 0.0})
    network.load_state_dict(released.state)
    return network.to(dtype).eval()


def condition(
    dtype: torch.dtype, group: str = "in", rows: int | None = None, **parts: Tensor
) -> Condition:
    """The text of a group of the fixture, and the prefix of the inputs."""
    tokens = array(f"{group}/text_embed", dtype).transpose(0, 1)
    token_mask = ~torch.from_numpy(arrays()[f"{group}/text_mask"])
    null = Condition(torch.zeros_like(tokens[:1, 0]), torch.zeros_like(tokens[:1, :1]), None)
    cond = Condition(
        tokens[:, 0], tokens, token_mask, null, **{"prefix": prefix_of("in/prefix", dtype)} | parts
    )
    return cond if rows is None else cond.select(torch.arange(rows))


def target(dtype: torch.dtype) -> Tensor:
    return requested(array("target/cond", dtype), array("target/valid").bool())


def output(
    network: Denoiser, cond: Condition, case: str, mask: Tensor, dtype: torch.dtype
) -> Tensor:
    """The output of a case: with its condition, without it, or guided."""
    x_t, t = motions(arrays()["in/x_t"], dtype), array("in/t").float()
    if case.startswith("uncond"):
        cond = cond.drop(torch.ones(len(x_t), dtype=torch.bool))
    denoise = network
    if case.startswith("cfg"):
        denoise = classifier_free_guidance(network, array("in/scale", dtype), x_t.shape[-1])
    with torch.no_grad():
        return denoise(x_t, t, mask, cond)


PLAIN = [f"out/{case}{end}" for case in ("cond", "uncond", "cfg") for end in ("", "_short")]


@cases(*PLAIN)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_the_network_continues_a_prefix_as_the_authors_does(case, dtype):
    mask = array("in/mask_short" if case.endswith("_short") else "in/mask").bool()[:, 0, 0]
    y = output(denoiser(dtype=dtype), condition(dtype), case.split("/")[1], mask, dtype)
    assert_golden(arrays(), case, y)


@cases("out/cond", "out/uncond", "out/cfg")
def test_padding_counts_if_it_is_not_masked(case):
    """All frames of the fixture's mask are real, so that the option changes nothing."""
    mask = array("in/mask").bool()[:, 0, 0]
    network = denoiser(mask_frames=False)
    assert not network.mask_padding
    assert_golden(
        arrays(),
        case,
        output(network, condition(torch.float32), case.split("/")[1], mask, torch.float32),
    )


@cases("out/cond_time_token")
def test_a_token_of_the_time_comes_before_the_prefix(case):
    mask = array("in/mask").bool()[:, 0, 0]
    network = denoiser(emb_trans_dec=True)
    assert_golden(
        arrays(), case, output(network, condition(torch.float32), "cond", mask, torch.float32)
    )


@cases("concat/cond", "concat/uncond", "concat/cfg")
def test_the_time_as_a_token_of_the_memory(case):
    mask = array("in/mask").bool()[:, 0, 0]
    network = denoiser(emb_policy="concat")
    y = output(network, condition(torch.float32), case.split("/")[1], mask, torch.float32)
    assert_golden(arrays(), case, y)
    assert not torch.allclose(
        y, output(denoiser(), condition(torch.float32), case.split("/")[1], mask, torch.float32)
    )


@cases("full/cond")
def test_the_official_numbers_of_frames(case):
    x_t, prefix = motions(arrays()["full/x_t"]), motions(arrays()["full/prefix"])
    network = denoiser(context_len=prefix.shape[1], pred_len=x_t.shape[1])
    cond = replace(condition(torch.float32, rows=1), prefix=prefix)
    with torch.no_grad():
        assert_golden(arrays(), case, network(x_t, array("full/t").float(), real(x_t), cond))


@cases("out/train_cond_drop")
def test_dropping_the_text_keeps_the_prefix(case):
    cond = condition(torch.float32).drop(array("in/cond_drop").bool())
    mask = array("in/mask").bool()[:, 0, 0]
    assert_golden(arrays(), case, output(denoiser(), cond, "cond", mask, torch.float32))


@cases(*[f"{name}/embedding" for name in TARGETED])
def test_targets_are_embedded_as_by_the_authors(case):
    encoder = denoiser(case.split("/")[0].removeprefix("target_")).target
    with torch.no_grad():
        embedding = encoder(condition(torch.float32, target=target(torch.float32)))  # type: ignore[misc]
    assert_golden(arrays(), case, embedding)


@cases(
    *[f"{name}/cond" for name in TARGETED],
    "target_single/cfg",
    "target_single_concat/cond",
    "target_single_concat/cfg",
)
def test_the_network_with_targets(case):
    group, kind = case.split("/")
    encoder = group.split("_")[1]
    network = denoiser(encoder, **({"emb_policy": "concat"} if group.endswith("concat") else {}))
    mask = array("in/mask").bool()[:, 0, 0]
    y = output(
        network, condition(torch.float32, target=target(torch.float32)), kind, mask, torch.float32
    )
    assert_golden(arrays(), case, y)


@cases("out/cond")
@pytest.mark.parametrize("encoder", ENCODERS)
@pytest.mark.parametrize("left_out", ["no target", "dropped target"])
def test_without_a_target_the_encoder_adds_nothing(case, encoder, left_out):
    cond = condition(torch.float32)
    if left_out == "dropped target":
        dropped = torch.zeros(len(cond.pooled), dtype=torch.bool)
        cond = replace(cond, target=target(torch.float32), target_mask=dropped)
    mask = array("in/mask").bool()[:, 0, 0]
    assert_golden(arrays(), case, output(denoiser(encoder), cond, "cond", mask, torch.float32))


def representation(dtype: torch.dtype) -> HumanML:
    features = HumanML(variant="legacy")
    features.mean.copy_(array("target/mean"))
    features.std.copy_(array("target/std"))
    return features.to(dtype)


def targets(**options: Any) -> TargetConditions:
    return TargetConditions(
        SMPL22.joints, SMPL22.facing, choices=[[]], heading_modulo_pi=True, **options
    )


@cases("target/location_of_all", "target/cond")
def test_locations_of_targets(case):
    joints = representation(torch.float32).to_joints(motions(arrays()["loss/x_start"]))
    locations = targets().locations(joints)
    if case == "target/cond":
        locations = requested(locations, array("target/valid").bool())[..., :3]
    expected = array(case)
    tolerance = 10 * meta(arrays())["max_abs_diff_f32_vs_f64"][case][0]
    torch.testing.assert_close(locations, expected, rtol=0, atol=tolerance)
    assert list(SLOTS) == config()["goal_joint_names"]


def losses(group: str, dtype: torch.dtype) -> tuple[dict[str, Tensor], Denoiser]:
    """The losses of a group of the fixture, and the network with the gradients of their mean."""
    encoder = group.removeprefix("target_") if group.startswith("target_") else ""
    network = denoiser(encoder, dtype)
    network.zero_grad()
    features, aims = representation(dtype), targets()
    cond = condition(dtype, prefix=prefix_of("loss/prefix", dtype)).drop(
        array("in/cond_drop").bool()
    )
    if encoder:
        cond = replace(cond, target=target(dtype), target_mask=~array("in/target_drop").bool())

    def auxiliary(x0_hat: Tensor, x: Tensor, mask: Tensor) -> dict[str, Tensor]:
        return {"target": aims.error(features.to_joints(x0_hat), target(dtype))} if encoder else {}

    x = motions(arrays()["loss/x_start"], dtype)
    terms = diffusion(dtype).loss(
        network,
        x,
        real(x),
        cond,
        t=array("loss/t").float(),
        noise=motions(arrays()["loss/noise"], dtype),
        auxiliary=auxiliary,
    )
    terms["loss"].mean().backward()
    return terms, network


def diffusion(dtype: torch.dtype) -> GaussianDiffusion:
    steps, schedule = config()["steps"], config()["noise_schedule"]
    return GaussianDiffusion(steps, schedule, variance="fixed_small").to(dtype)


def our_names(theirs: list[str]) -> list[str]:
    """Our names of the authors' weights."""
    state = dict.fromkeys(weights(arrays()) | dict.fromkeys(theirs), torch.zeros(0))
    names, _ = released_weights.layer_names(
        state, "seqTransDecoder", released_weights.DECODER_LAYER
    )
    prefixes = released_weights.NAMES["mdm"] | names
    return list(released_weights.renamed(dict.fromkeys(theirs, torch.zeros(0)), prefixes))


LOSSES = [f"{name}/loss" for name in TARGETED]


@cases("loss/loss", *[f"{name}/loss" for name in LOSSES])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_losses_and_gradients(case, dtype):
    prefix = case.removesuffix("/loss")
    group = prefix.removesuffix("/loss")
    terms, network = losses(group, dtype)
    for ours, theirs in (("mse", "rot_mse"), ("target", "target_loc"), ("loss", "loss")):
        if ours in terms:
            assert_golden(arrays(), f"{prefix}/{theirs}", terms[ours].detach())

    names = meta(arrays())["grad_names"][group]
    gradients = {
        name: parameter.grad
        for name, ours in zip(names, our_names(names), strict=True)
        if (parameter := network.get_parameter(ours)).grad is not None
    }
    norms = torch.stack([gradients[name].norm() for name in names])
    assert_golden(arrays(), f"{prefix}/grad_norm", norms)
    for key in arrays():
        if key.startswith(f"{prefix}/grad/"):
            name = key.removeprefix(f"{prefix}/grad/")
            torch.testing.assert_close(gradients[name].float(), array(key), rtol=1e-4, atol=1e-6)


SAMPLES = ("cond", "cfg", "cfg_concat", "target_single_cfg", "target_multi_cfg")


@cases(*[f"sample/{name}" for name in SAMPLES])
def test_ten_steps_of_sampling(case):
    name = case.split("/")[1]
    encoder = name.split("_")[1] if name.startswith("target_") else ""
    network = denoiser(encoder, **({"emb_policy": "concat"} if name.endswith("concat") else {}))
    cond = replace(condition(torch.float32), target=target(torch.float32) if encoder else None)
    start = motions(arrays()["sample/x_T"])
    draws = [motions(noise) for noise in arrays()["sample/noise"]]
    denoise = network
    if name != "cond":
        denoise = classifier_free_guidance(network, config()["sample_scale"], start.shape[-1])
    options = SamplerOptions(sampler="ancestral", num_inference_steps=config()["steps"])
    with torch.no_grad():
        x = diffusion(torch.float32).sample(
            denoise, recorded(start, draws), real(start), cond, options
        )
    assert_golden(arrays(), case, x)


STREAMS = (
    "out",
    "out_one_text",
    "out_include_prefix",
    "out_concat",
    "out_target_single",
    "out_target_single_concat",
)


@cases(*[f"ar/{name}" for name in STREAMS])
def test_a_loop_over_windows(case, monkeypatch):
    name = case.removeprefix("ar/")
    rows, windows = config()["ar_bs"], config()["ar_windows"]
    encoder = "single" if "target_single" in name else ""
    model = loop_model(
        denoiser(encoder, **({"emb_policy": "concat"} if name.endswith("concat") else {}))
    )
    prefix = motions(arrays()["ar/prefix"])
    options = SamplerOptions(guidance_scale=config()["sample_scale"]).over(model.sampler_options)
    blocks = Blocks(model, ["a"] * rows, prefix, options)

    def stored(ids: list[str], *_: Any, **__: Any) -> Noise:
        window = blocks.number
        draws = [motions(noise) for noise in arrays()["ar/noise"][window]]
        return recorded(motions(arrays()["ar/x_T"][window]), draws)

    monkeypatch.setattr("flame_mdm.generator.seeded_noise", stored)
    parts = [prefix] if name == "out_include_prefix" else []
    for window in range(windows):
        tokens = torch.from_numpy(
            arrays()["ar/text_embed"][0 if name == "out_one_text" else window]
        ).transpose(0, 1)
        token_mask = ~torch.from_numpy(
            arrays()["ar/text_mask"][0 if name == "out_one_text" else window]
        )
        null = Condition(torch.zeros_like(tokens[:1, 0]), torch.zeros_like(tokens[:1, :1]), None)
        cond = Condition(tokens[:, 0], tokens, token_mask, null)
        parts.append(
            blocks.sample(replace(cond, target=target(torch.float32)[:rows] if encoder else None))
        )
    assert_golden(arrays(), case, torch.cat(parts, 1)[:, : config()["ar_required"]])


def loop_model(network: Denoiser) -> MotionGenerator:
    """A model with the fixture's network, whose condition comes from the test."""
    encoder = Unconditional()
    encoder.features = arrays()["in/text_embed"].shape[-1]
    defaults = SamplerOptions(sampler="ancestral", num_inference_steps=config()["steps"])
    parts = Parts(network, diffusion(torch.float32), encoder, HumanML(variant="legacy"))
    model = MotionGenerator(parts, defaults)
    model.facts = {"max_frames": config()["context_len"] + config()["pred_len"]}
    return model.eval()


@cases("sched/alphas_cumprod")
def test_the_schedule(case):
    schedule = diffusion(torch.float64).schedule
    steps = torch.arange(config()["steps"])
    signal = schedule.at("signal", steps, torch.zeros(1, 1, 1, dtype=torch.float64)).flatten()
    np.testing.assert_allclose(signal.square().numpy(), arrays()[case], rtol=1e-6)


def turned(angle: float) -> Tensor:
    """One frame (1, 1, 22, 3) of a person whose hips and shoulders face a direction."""
    joints = torch.zeros(1, 1, 22, 3)
    right_hip, left_hip, right_shoulder, left_shoulder = SMPL22.facing
    left = torch.tensor([math.cos(angle), 0.0, -math.sin(angle)])
    for joint, side in ((right_hip, -1), (left_hip, 1), (right_shoulder, -1), (left_shoulder, 1)):
        joints[0, 0, joint] = side * left
    return joints


@pytest.mark.parametrize(("modulo_pi", "cost"), [(False, math.pi**2), (True, 0.0)])
def test_facing_backwards_costs_nothing_in_the_authors_loss_alone(modulo_pi, cost, subtests):
    aims = TargetConditions(
        SMPL22.joints, SMPL22.facing, choices=[["heading"]], heading_modulo_pi=modulo_pi
    )
    forward = aims.draw(turned(0.0), torch.zeros(1))
    assert forward[0, :, 3].tolist() == [0.0] * 7 + [1.0]
    torch.testing.assert_close(
        aims.error(turned(math.pi), forward), torch.tensor([cost]), rtol=0, atol=1e-5
    )
    # The error of a small turn is its square, also across 180 degrees, and positive angles turn to the left, to +x.
    for target, angle in ((0.3, 0.1), (math.pi - 0.1, -math.pi + 0.1)):
        with subtests.test(target=target, angle=angle):
            requested_turn = aims.draw(turned(target), torch.zeros(1))
            torch.testing.assert_close(
                requested_turn[0, 7, 0], torch.tensor(target), rtol=0, atol=1e-5
            )
            torch.testing.assert_close(
                aims.error(turned(angle), requested_turn), torch.tensor([0.04]), rtol=0, atol=1e-5
            )


def test_the_weight_of_targets_applies_to_coordinates_and_heading():
    """A slot at rest that is 0.3 m away has 3 equal coordinates; the body faces 0.2 rad away from the target."""
    moved = turned(0.2)
    moved[0, 0, SMPL22.joints.index("left_wrist")] += 0.3
    for slots, expected in (
        (["left_wrist"], 0.09),
        (["heading"], 0.04),
        (["left_wrist", "heading"], 0.13),
    ):
        for weight in (1.0, 2.5):
            aims = TargetConditions(SMPL22.joints, SMPL22.facing, choices=[slots], weight=weight)
            target = aims.draw(turned(0.0), torch.zeros(1))
            torch.testing.assert_close(
                aims.error(moved, target), torch.tensor([weight * expected]), rtol=1e-4, atol=0
            )


def test_each_choice_of_targets_is_drawn_equally_often():
    choices = [["pelvis", "heading"], ["traj", "heading"], []]
    aims = TargetConditions(SMPL22.joints, SMPL22.facing, choices=choices)
    u = (torch.arange(300) + 0.5) / 300
    drawn = aims.draw(torch.randn(300, 5, 22, 3, generator=torch.Generator().manual_seed(0)), u)[
        ..., 3
    ]
    names = [
        [slot for slot, flag in zip(SLOTS, row, strict=True) if flag]
        for row in drawn.bool().tolist()
    ]
    assert [names.count(choice) for choice in choices] == [100, 100, 100]
    with pytest.raises(UserError, match="Did you mean pelvis"):
        TargetConditions(SMPL22.joints, SMPL22.facing, choices=[["pelvsi"]])
    with pytest.raises(UserError, match="the skeleton has no head"):
        TargetConditions(
            [name for name in SMPL22.joints if name != "head"], SMPL22.facing, choices=[[]]
        )


def test_time_and_condition_can_be_added_to_the_noisy_frames():
    """Clean frames get neither. The input layer is the identity, so that adding to the input is the same."""
    torch.manual_seed(0)
    sizes = {"latent_dim": 8, "ff_size": 8, "num_layers": 1, "num_heads": 2, "dropout": 0.0}
    plain = MDMDecoder(8, 8, 4, context_frames=3, **sizes)
    torch.nn.init.eye_(plain.input.weight)
    torch.nn.init.zeros_(plain.input.bias)
    adding = MDMDecoder(8, 8, 4, context_frames=3, condition_frames=True, **sizes)
    adding.load_state_dict(plain.state_dict())
    x_t, t, mask = torch.randn(2, 5, 8), torch.tensor([1.0, 7.0]), torch.ones(2, 5) > 0
    cond = Condition(torch.randn(2, 4), torch.ones(2, 0, 4), None, prefix=torch.randn(2, 3, 8))
    added = plain.condition(t, cond.pooled)[:, None]
    torch.testing.assert_close(adding(x_t, t, mask, cond), plain(x_t + added, t, mask, cond))
    assert not torch.allclose(adding(x_t, t, mask, cond), plain(x_t, t, mask, cond))


@pytest.mark.parametrize("modulo_pi", [False, True])
def test_targets_are_at_the_last_real_frame_of_motions_of_any_length(modulo_pi: bool):
    choices = [["left_wrist", "traj", "heading"], ["pelvis"], []]
    aims = TargetConditions(
        SMPL22.joints, SMPL22.facing, choices=choices, weight=0.7, heading_modulo_pi=modulo_pi
    )
    generator = torch.Generator().manual_seed(0)
    real_motions, moved = torch.randn(2, 4, 9, 22, 3, generator=generator)
    u, lengths = torch.tensor([0.0, 0.3, 0.5, 0.99]), torch.tensor([9, 4, 1, 6])
    target = aims.draw(real_motions, u, lengths)
    error = aims.error(moved, target, lengths)
    for row, length in enumerate(lengths.tolist()):
        alone = aims.draw(real_motions[row : row + 1, :length], u[row : row + 1])
        torch.testing.assert_close(target[row : row + 1], alone)
        torch.testing.assert_close(
            error[row : row + 1], aims.error(moved[row : row + 1, :length], alone)
        )
    assert target[..., 3].sum(1).tolist() == [3, 3, 1, 0]
    assert error[3] == 0
    difference = (moved - real_motions)[2, 0, SMPL22.joints.index("pelvis")]
    torch.testing.assert_close(error[2], 0.7 * difference.square().mean())
    assert not target[0, SLOTS.index("traj"), 1]
