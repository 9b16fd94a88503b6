"""Released weights give the authors' outputs through import, file and load; model files are whole or refused."""

import argparse
import copy
import json
import re
import subprocess
import sys
import tempfile
from dataclasses import MISSING, fields
from functools import cache
from inspect import Parameter, signature
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import huggingface_hub
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from support.fixtures import GOLDEN, Arrays, golden, meta, weights
from support.refusals import error_of, one_line_error
from support.runs import inputs_of

from flame_mdm.__main__ import main
from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.checkpoints import hub, model_files
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.locating import SHIPPED, find
from flame_mdm.checkpoints.onnx_export import export_onnx
from flame_mdm.checkpoints.released import (
    Released,
    _flame_recipe,
    _mdm_recipe,
    import_flame,
    import_mdm,
    import_released,
)
from flame_mdm.checkpoints.released_options import Options, check_hyperparameters, read_options
from flame_mdm.checkpoints.released_weights import released_state
from flame_mdm.commands.adapt import AdaptSettings
from flame_mdm.commands.edit import EditSettings
from flame_mdm.commands.export import ExportSettings
from flame_mdm.commands.import_released import ImportSettings
from flame_mdm.commands.sample import SampleSettings
from flame_mdm.data.humanact12 import HumanAct12
from flame_mdm.denoisers.flame import FLAME
from flame_mdm.denoisers.mdm import MDMEncoder
from flame_mdm.errors import UserError
from flame_mdm.generator import MotionGenerator
from flame_mdm.safe_io import sha256
from flame_mdm.sampling.generation import generate
from flame_mdm.sampling.motion_request import EditRequest, SamplingRequest
from flame_mdm.training.adaptation import adapt

MDM = ["mdm_trans_enc", "mdm_trans_dec", "mdm_trans_dec_emb", "mdm_trans_dec_bert", "mdm_gru"]
MDM += ["mdm_action_rot6d", "mdm_uncond_rot6d", "mfm"]
DTYPES = [torch.float32, torch.float64]
NORMALIZED = ("humanml", "kit")
WIDTHS = {263: "humanml", 251: "kit", 150: "humanact12"}


def statistics_folder(folder: Path, features: int) -> Path:
    generator = np.random.default_rng(0)
    np.save(folder / "Mean.npy", generator.normal(size=features))
    np.save(folder / "Std.npy", generator.uniform(0.5, 2, features))
    return folder


def released_file(folder: Path, state: dict, args: dict | str) -> list[str]:
    """Words of an import command for a released file of these contents."""
    torch.save(state, folder / "model.pt")
    (folder / "args.json").write_text(args if isinstance(args, str) else json.dumps(args, indent=4))
    return [
        str(folder / "model.pt"),
        str(folder / "args.json"),
        f"out={folder / 'ours.safetensors'}",
    ]


@cache
def imported(stem: str, mask_frames: bool, time_token: bool) -> MotionGenerator:
    """The fixture's network as a released file, imported by the command, and loaded."""
    arrays = golden(stem)
    config, width = meta(arrays)["config"], weights(arrays)["output_process.poseFinal.bias"].numel()
    keys = ("arch", "emb_trans_dec", "text_encoder_type", "cond_mask_prob")
    args = {key: config[key] for key in keys if key in config} | {
        "dataset": WIDTHS[width],
        "mask_frames": mask_frames,
    }
    with tempfile.TemporaryDirectory() as name:
        words = [
            "mfm" if stem == "mfm" else "mdm",
            *released_file(Path(name), weights(arrays), args),
        ]
        words += [f"num_heads={config.get('num_heads', config.get('heads'))}"]
        words += ["time_token=true"] if time_token else []
        if args["dataset"] in NORMALIZED:
            words.append(f"stats={statistics_folder(Path(name), width)}")
        assert main(["import", *words]) == 0
        return load(name)


@cache
def imported_flame() -> MotionGenerator:
    arrays = golden("flame_text2motion")
    state, generator = weights(arrays), torch.Generator().manual_seed(0)
    width = state["text_pooler_proj.weight"].shape[1]
    state["lm.pooler.dense.weight"] = torch.randn(width, width, generator=generator)
    state["lm.pooler.dense.bias"] = torch.randn(width, generator=generator)
    state["lm.embeddings.position_ids"] = torch.arange(5)
    raw = {f"net.{key}": torch.zeros_like(value) for key, value in state.items()}
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / "released.ckpt"
        averaged = {f"ema_model.model.{key}": value for key, value in state.items()}
        torch.save({"epoch": 3, "global_step": 9, "state_dict": raw | averaged}, file)
        heads = meta(arrays)["config"]["heads"]
        assert main(["import", "flame", str(file), f"out={name}", f"num_heads={heads}"]) == 0
        model = load(name)
    assert torch.equal(model.condition.get_buffer("pooler_weight"), state["lm.pooler.dense.weight"])
    assert torch.equal(model.condition.get_buffer("pooler_bias"), state["lm.pooler.dense.bias"])
    assert model.config["process"]["clip_x0"], (
        "released FLAME was sampled with the clamp of its code"
    )
    return model


def condition(arrays: Arrays, model: MotionGenerator, dtype: torch.dtype) -> Condition:
    """The fixture's condition, its null included: zeros in place of the embedding."""
    batch = len(arrays["in/x_t"])
    pooled, tokens, token_mask = (
        torch.zeros(batch, model.condition.features),
        torch.zeros(batch, 0, 0),
        None,
    )
    if "in/action" in arrays:
        labels = torch.from_numpy(arrays["in/action"])[:, 0]
        clips = MotionBatch(
            torch.zeros(batch, 1, 1), torch.ones(batch, 1, dtype=torch.bool), [], action=labels
        )
        pooled = model.condition(clips).pooled
    elif "in/text_mask" in arrays:
        tokens = torch.from_numpy(arrays["in/text_embed"]).transpose(0, 1)
        token_mask = ~torch.from_numpy(arrays["in/text_mask"])
        pooled = tokens[:, 0]
    elif "in/text_embed" in arrays:
        pooled = torch.from_numpy(arrays["in/text_embed"]).reshape(batch, -1)
    pooled, tokens = pooled.to(dtype), tokens.to(dtype)
    null = Condition(torch.zeros_like(pooled[:1]), torch.zeros_like(tokens[:1]), None)
    return Condition(pooled, tokens, token_mask, null)


def assert_output(arrays: Arrays, case: str, y: torch.Tensor) -> None:
    """Within ten times the difference between the authors' float32 and float64, by default of the condition."""
    differences = meta(arrays)["max_abs_diff_f32_vs_f64"]
    difference = np.ravel(differences.get(f"out/{case}") or differences["out/cond"])[0]
    # A float64 time a hair off one of MFM's table rows makes its own float64 differ: that says nothing on float32.
    expected = torch.from_numpy(arrays[f"out/{case}"]).to(y.dtype)
    torch.testing.assert_close(y, expected, rtol=0, atol=10 * min(float(difference), 1e-5))


def mdm_cases() -> list:
    names = (
        "cond",
        "uncond",
        "cfg",
        "train_cond_drop",
        "cond_last_sample_alone",
        "legacy_cond",
        "legacy_uncond",
    )
    names += ("cond_maskframes", "uncond_maskframes", "cfg_maskframes", "cond_scalar_t")
    stems = [stem for stem in MDM if (GOLDEN / f"{stem}.npz").is_file()]
    cases = [(stem, name) for stem in stems for name in names if f"out/{name}" in golden(stem)]
    return [pytest.param(*case, id="-".join(case)) for case in cases]


@pytest.mark.golden
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(("stem", "case"), mdm_cases())
@torch.no_grad()
def test_mdm_outputs(stem: str, case: str, dtype: torch.dtype) -> None:
    arrays = golden(stem)
    model = imported(stem, case.endswith("_maskframes"), "legacy" not in case)
    denoiser = copy.deepcopy(model.denoiser).to(dtype)
    cond = condition(arrays, model, dtype)
    x_t = torch.from_numpy(arrays["in/x_t"]).flatten(1, 2).transpose(1, 2).to(dtype)
    t = torch.from_numpy(arrays["in/t"])
    # MFM's network takes a row number cut from its time in [0, 1].
    t = (t * 1000).floor() if t.is_floating_point() else t.float()
    mask, all_of_them = (
        torch.from_numpy(arrays["in/mask"])[:, 0, 0],
        torch.ones(len(x_t), dtype=torch.bool),
    )
    if case == "cond_scalar_t":
        t = t[:1].expand(len(t))
    if case == "cond_last_sample_alone":
        cond = Condition(cond.pooled[-1:], cond.tokens[-1:], None)
        x_t, t, mask = x_t[-1:], t[-1:], mask[-1:]
    if "uncond" in case:
        cond = cond.drop(all_of_them)
    if case == "train_cond_drop":
        cond = cond.drop(torch.from_numpy(arrays["in/cond_drop"]).bool())
    y = denoiser(x_t, t, mask, cond)
    if "cfg" in case:
        # The two halves run apart: in a batch of 2B the recurrence over the batch axis would join them.
        null = denoiser(x_t, t, mask, cond.drop(all_of_them))
        y = null + torch.from_numpy(arrays["in/scale"]).to(dtype)[:, None, None] * (y - null)
    # the authors' (B, joints, features, F)
    assert_output(arrays, case, y.transpose(1, 2).unflatten(1, arrays["in/x_t"].shape[1:3]))


@pytest.mark.golden
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize(
    "case", ["model", "model_null_text", "cfg_model_fn"], ids=lambda c: f"flame_text2motion-{c}"
)
@torch.no_grad()
def test_flame_outputs(case: str, dtype: torch.dtype) -> None:
    arrays = golden("flame_text2motion")
    denoiser = copy.deepcopy(imported_flame().denoiser).to(dtype)
    pooled = torch.from_numpy(arrays["lm/pooler_output"]).to(dtype)
    tokens = torch.from_numpy(arrays["lm/last_hidden_state"]).to(dtype)
    # The authors attend to the padding of the text
    everywhere = torch.ones(tokens.shape[:2], dtype=torch.bool)
    null = Condition(pooled[-1:], tokens[-1:], everywhere[-1:])
    cond = Condition(pooled[:-1], tokens[:-1], everywhere[:-1], null)
    batch = len(cond.pooled)
    if case == "cfg_model_fn":
        x_t = torch.from_numpy(arrays["cfg/x_t"])[:batch].transpose(1, 2).to(dtype)
        t, mask = (
            torch.from_numpy(arrays["cfg/t"])[:batch],
            torch.ones(x_t.shape[:2], dtype=torch.bool),
        )
        y, without = denoiser(
            x_t.repeat(2, 1, 1), t.repeat(2), mask.repeat(2, 1), cond.with_null()
        ).chunk(2)
        mean, scale = slice(0, x_t.shape[-1]), meta(arrays)["config"]["scale"]
        y[..., mean] = without[..., mean] + scale * (y[..., mean] - without[..., mean])
    else:
        x_t = torch.from_numpy(arrays["in/motion"]).transpose(1, 2).to(dtype)
        t, mask = torch.from_numpy(arrays["in/t"]), torch.from_numpy(arrays["in/mask"])
        if case == "model_null_text":
            cond = cond.drop(torch.ones(batch, dtype=torch.bool))
        y = denoiser(x_t, t, mask, cond)
    assert_output(arrays, case, y.transpose(1, 2))


@pytest.mark.golden
def test_every_weight_of_the_released_sizes_has_its_target_and_text_encoders_are_left(
    subtests,
) -> None:
    path = GOLDEN / "state_dict_manifest.json"
    manifest = json.loads(path.read_text()) if path.is_file() else {}
    for name in (name for name in manifest if name.startswith(("mdm_", "mfm_", "flame_hml"))):
        with subtests.test(name=name):
            state = {
                key: torch.empty(shape, device="meta")
                for key, shape in manifest[name]["keys"].items()
            }
            if name.startswith("flame"):
                released = import_flame(
                    state | {"lm.embeddings.word_embeddings.weight": torch.empty(3)}
                )
            else:
                args: dict[str, Any] = {
                    "arch": next((a for a in ("trans_dec", "gru") if a in name), "trans_enc")
                }
                args |= {
                    "emb_trans_dec": name.endswith("_emb"),
                    "text_encoder_type": "bert" if "bert" in name else "clip",
                }
                released = import_mdm(
                    state | {"clip_model.positional_embedding": torch.empty(3)}, Options(**args)
                )
            action = 0 if released.action_embedding is None else released.action_embedding.numel()
            assert (
                sum(x.numel() for x in released.state.values()) + action
                == manifest[name]["n_params"]
            ), name


MDM_ARGUMENTS = {
    **{
        "arch": "trans_enc",
        "batch_size": 64,
        "cond_mask_prob": 0.1,
        "cuda": True,
        "data_dir": "",
        "device": 0,
    },
    **{
        "dataset": "humanml",
        "diffusion_steps": 1000,
        "emb_trans_dec": False,
        "eval_batch_size": 32,
        "seed": 10,
    },
    **{
        "eval_during_training": False,
        "eval_num_samples": 1000,
        "eval_rep_times": 3,
        "eval_split": "test",
    },
    **{
        "lambda_fc": 0.0,
        "lambda_rcxyz": 0.0,
        "lambda_vel": 0.0,
        "latent_dim": 512,
        "layers": 8,
        "lr": 0.0001,
    },
    **{
        "log_interval": 1000,
        "lr_anneal_steps": 0,
        "noise_schedule": "cosine",
        "num_frames": 0,
        "use_ema": True,
    },
    **{
        "num_steps": 600000,
        "overwrite": False,
        "resume_checkpoint": "",
        "save_dir": "save/x",
        "weight_decay": 0.0,
    },
    **{
        "save_interval": 50000,
        "sigma_small": True,
        "train_platform_type": "NoPlatform",
        "unconstrained": False,
    },
    **{
        "text_encoder_type": "clip",
        "mask_frames": True,
        "pos_embed_max_len": 5000,
        "context_len": 0,
        "pred_len": 0,
    },
    **{
        "lambda_target_loc": 0.0,
        "multi_target_cond": False,
        "multi_encoder_type": "single",
        "target_enc_layers": 1,
    },
    **{
        "emb_policy": "add",
        "avg_model_beta": 0.9999,
        "adam_beta2": 0.999,
        "gen_during_training": False,
    },
    **{
        "gen_num_samples": 3,
        "gen_num_repetitions": 2,
        "gen_guidance_param": 2.5,
        "autoregressive": False,
    },
    **{
        "autoregressive_include_prefix": False,
        "autoregressive_init": "data",
        "target_joint_names": "DIMP_FINAL",
    },
    **{"external_mode": False},
}
"""Names and defaults of the options of MDM's training, without the prefix and the targets of DiP."""
MFM_OPTIONS = """
model: {arch: trans_enc, emb_trans_dec: false, layers: 8, latent_dim: 512, ff_size: 1024, num_heads: 4,
  cond_mask_prob: 0.1, lambda_rcxyz: 0.0, lambda_vel: 0.0, lambda_fc: 0.0, unconstrained: false, text_emebed: clip}
training: {save_dir: x, overwrite: true, train_platform_type: x, resume_checkpoint: "", num_steps: 600000,
  num_frames: 60, lr: 1e-4, weight_decay: 0.0, lr_anneal_steps: 0, log_interval: 1000, save_interval: 10000,
  eval_batch_size: 32, eval_split: test, eval_during_training: true, eval_rep_times: 3, eval_num_samples: 1000}
num_frames: null
jointstype: null
num_seeds: 2
dataset: humanact12
num_workers: 4
dynamic: flow
noise_schedule: cosine
diffusion_steps_sample: 1000
use_ddim: false
sigma_small: true
ode_kwargs: {method: euler, atol: 1e-5, rtol: 1e-5, step_size: 0.01, edit_till: 1.0, return_x_est: false,
  return_x_est_num: null}
motion_length: 6.0
wandb: {project: motionfm}
"""
"""Names and defaults of the options of MFM's configuration."""
FLAME_HYPERPARAMETERS = {
    **{
        "diffusion_steps": 1000,
        "beta_schedule": "squaredcos_cap_v2",
        "schedule_sampler": "uniform",
        "lr": 0.0001,
    },
    **{
        "text_replace_prob": 0.25,
        "weight_decay": 0.0,
        "ema_start": 100,
        "ema_update": 10,
        "ema_decay": 0.99,
    },
    **{
        "sampling_strategy": "ddpm",
        "epoch_sample_every": 50,
        "sample_fps": 20,
        "sampling_length": 200,
    },
    **{"sampling_texts": ["walking"], "guidance_scale": 8.0},
}
"""Names and defaults of the hyperparameters of FLAME's Lightning module."""


def small_state(features: int = 3) -> dict[str, torch.Tensor]:
    """A state dict with the authors' names."""
    state = {"input_process.poseEmbedding.weight": torch.ones(8, features)}
    state |= {
        "input_process.poseEmbedding.bias": torch.ones(8),
        "output_process.poseFinal.bias": torch.ones(features),
    }
    state |= {"output_process.poseFinal.weight": torch.ones(features, 8)}
    for i in (0, 2):
        state[f"embed_timestep.time_embed.{i}.weight"] = torch.ones(8, 8)
        state[f"embed_timestep.time_embed.{i}.bias"] = torch.ones(8)
    layer = torch.nn.TransformerEncoderLayer(8, 4, 16)
    return state | {
        f"seqTransEncoder.layers.0.{key}": value for key, value in layer.state_dict().items()
    }


def test_every_weight_is_used_or_the_import_fails(subtests) -> None:
    state = small_state()
    lacking = {
        key: value for key, value in state.items() if key != "seqTransEncoder.layers.0.linear2.bias"
    }
    short = state | {"seqTransEncoder.layers.0.linear1.bias": torch.ones(2)}
    for weights_, options, message in (
        (
            state | {"embed_style.weight": torch.ones(1)},
            Options(),
            r"unknown keys embed_style\.weight",
        ),
        (
            state,
            Options(arch="trans_dec"),
            r"unknown keys seqTransEncoder\.layers\.0\.linear1\.bias.* and 7 more",
        ),
        (lacking, Options(), r"Missing key.*transformer\.layers\.0\.feed_forward\.3\.bias"),
        ({}, Options(), r"output\.weight is missing"),
        (short, Options(), r"size mismatch for .*feed_forward\.0\.bias: .*\[2\].*\[16\]"),
    ):
        with (
            subtests.test(weights_=weights_, message=message),
            pytest.raises(ValueError, match=message),
        ):
            import_mdm(weights_, options)


@pytest.mark.parametrize(
    ("kind", "options", "message"),
    [
        (
            "mdm",
            {"context_len": 20, "pred_len": 40},
            "context_len=20: this value is supported only for trans_dec with bert, not for trans_enc",
        ),
        ("mdm", {"pred_len": 40}, "context_len=0, pred_len=40: both must be positive"),
        (
            "mdm",
            {"emb_policy": "concat"},
            "emb_policy=concat: this value is supported only for trans_dec with bert",
        ),
        (
            "mdm",
            {"emb_before_mask": True},
            "emb_before_mask=True: changes the model in a way that cannot be imported",
        ),
        (
            "mdm",
            {"rope_base": 100},
            "rope_base=100: an unknown option, which may change the network",
        ),
        ("mfm", {"model": {"skip_connections": True}}, "skip_connections=True: an unknown option"),
        ("mfm", {"ode_kwargs": {"order": 3}}, "ode_kwargs.order=3: an unknown option"),
        ("mfm", {"ode_kwargs": {"atol": "1e-3"}}, "ode_kwargs.atol=1e-3: changes the model"),
    ],
)
def test_options_that_change_a_released_model_are_refused(
    refused, tmp_path, kind, options, message
):
    words = released_file(tmp_path, small_state(150), {"dataset": "uestc", **options})
    refused("import", kind, *words, says=f"args.json: {message}")


DIP_FILES = {
    "no target": ({"emb_policy": "ADD"}, "", {"memory": "add"}),
    "target": (
        {
            "emb_policy": "CONCAT",
            "lambda_target_loc": 1.0,
            "multi_target_cond": True,
            "multi_encoder_type": "single",
        },
        "state_single/",
        {"memory": "concat", "target_encoder": "single", "target_layers": 1},
    ),
}
"""Options in args.json of the two released models of DiP, weights besides the network's, and our options."""


@pytest.mark.golden
@pytest.mark.parametrize("kind", [pytest.param(name, id=f"dip-{name}") for name in DIP_FILES])
@pytest.mark.parametrize("averaged", [True, False])
def test_released_models_that_continue_frames(tmp_path, kind, averaged):
    arrays = golden("dip")
    config, (options, encoder, expected) = meta(arrays)["config"], DIP_FILES[kind]
    state = weights(arrays) | (weights(arrays, encoder) if encoder else {})
    raw = {name: value + 1 for name, value in state.items()}
    names = ("arch", "text_encoder_type", "context_len", "pred_len", "mask_frames", "emb_trans_dec")
    args = (
        MDM_ARGUMENTS
        | {name: config[name] for name in names}
        | options
        | {"diffusion_steps": config["steps"]}
    )
    words = released_file(tmp_path, {"model": raw, "model_avg": state}, args)
    words += [f"stats={statistics_folder(tmp_path, 263)}", f"num_heads={config['num_heads']}"]
    assert main(["import", "mdm", *words, *([] if averaged else ["averaged=false"])]) == 0

    model = load(tmp_path)
    denoiser = model.config["denoiser"]
    assert {name: denoiser[name] for name in expected} == expected
    assert model.denoiser.context_frames == config["context_len"]
    assert model.block_frames == config["pred_len"]
    assert (model.sampler_options.guidance_scale, model.sampler_options.num_inference_steps) == (
        7.5,
        config["steps"],
    )
    bias = (state if averaged else raw)["input_process.poseEmbedding.bias"]
    assert torch.equal(model.denoiser.input.bias, bias)  # type: ignore[union-attr]


def test_a_released_model_whose_options_name_a_missing_encoder_is_refused(refused, tmp_path):
    words = released_file(
        tmp_path, small_state(150), {"dataset": "uestc", "lambda_target_loc": 1.0}
    )
    refused(
        "import", "mdm", *words, says="model.pt: released weights: embed_target_cond is missing"
    )


@pytest.mark.parametrize("kind", ["flame", "mclip"])
@pytest.mark.parametrize("name", ["predict_length", "diffusion_steps"])
def test_hyperparameters_that_change_a_released_model_are_refused(refused, tmp_path, kind, name):
    state = {"state_dict": {"net.x": torch.zeros(1)}, "hyper_parameters": {"lr": 1e-4, name: 50}}
    words = released_file(tmp_path, state, {})
    refused("import", kind, words[0], words[2], says=f"model.pt: hyper_parameters.{name}=50: ")


def test_options_of_the_authors_codes_are_known(tmp_path):
    path = tmp_path / "args.json"
    path.write_text(json.dumps(MDM_ARGUMENTS))
    assert read_options(path, {}) == Options(mask_frames=True)
    path.write_text(MFM_OPTIONS)
    assert read_options(path, {}) == Options(dataset="humanact12", num_frames=60)
    check_hyperparameters({"hyper_parameters": FLAME_HYPERPARAMETERS}, "flame")


def test_options_of_mdm(tmp_path):
    state = small_state(150) | {"embed_action.action_embedding": torch.randn(12, 8)}
    args = {
        "dataset": "humanact12",
        "cond_mask_prob": 0,
        "lambda_vel": 1.0,
        "diffusion_steps": 50,
        "num_frames": 40,
    }
    args |= {"noise_schedule": "linear", "sigma_small": False}
    assert main(["import", "mdm", *released_file(tmp_path, state, args)]) == 0
    model = load(tmp_path)
    options, process = model.sampler_options, model.config["process"]
    assert (model.facts["actions"][9], model.facts["max_frames"]) == ("phone", 40)
    assert (
        options.guidance_scale,
        options.num_inference_steps,
        model.config["losses"]["velocity"],
    ) == (1, 50, 1)
    assert (process["num_train_timesteps"], process["schedule"], process["variance"]) == (
        50,
        "linear",
        "fixed_large",
    )
    assert generate(model, actions=["phone"], frames=24, num_inference_steps=3)[0].joints.shape == (
        24,
        24,
        3,
    )


def test_options_of_mfm(tmp_path, subtests):
    text = "log_dir: ./outputs/${name}/${now:%d}\nname: x\nnum_frames: null\ndataset: humanact12\n"
    text += "guidance_param: null\nmodel: {num_heads: 2, cond_mask_prob: 0, lambda_rcxyz: 1}\n"
    for solver, sampler, steps, odeint_grid in (
        ({}, "euler", 100, True),
        ({"method": "euler", "step_size": "2e-2"}, "euler", 50, True),
        ({"method": "euler_raw", "step_size": 0.1}, "euler", 10, False),
        ({"method": "dopri5"}, "dopri5", 100, False),
    ):
        with subtests.test(solver=solver, sampler=sampler, steps=steps, odeint_grid=odeint_grid):
            options = f"{text}training: {{num_frames: 30}}\node_kwargs: {json.dumps(solver)}\n"
            assert main(["import", "mfm", *released_file(tmp_path, small_state(150), options)]) == 0
            model = load(tmp_path)
            process, losses = model.config["process"], model.config["losses"]
            assert (model.sampler_options.sampler, model.sampler_options.num_inference_steps) == (
                sampler,
                steps,
            )
            assert (process["odeint_grid"], process["quantize_time"]) == (odeint_grid, True)
            assert (model.config["denoiser"]["num_heads"], losses["joints"]) == (2, 1)


def recipe_of(kind: str, cond_features: int = 512, **options: Any) -> dict[str, Any]:
    """The recipe and the facts of a released model of text whose code had these options."""
    network = Released(MDMEncoder, (263, 263, cond_features), {"latent_dim": 8}, {})
    config, facts = _mdm_recipe(kind, network, Options(**options))
    task = {name: config["task"][name] for name in ("guidance_scale", "num_inference_steps")}
    task |= {"dropped": config["task"]["cond_drop_prob"], "longest": facts["max_frames"]}
    return task | {"losses": config["losses"], "condition": config["condition"]["_target_"]}


@pytest.mark.parametrize(("options", "expected"), [
    ({}, {"guidance_scale": 2.5, "dropped": 0.1, "longest": 196, "num_inference_steps": 1000}),
    ({"cond_mask_prob": 0.0}, {"guidance_scale": 1.0, "dropped": 0.0}),
    ({"dataset": "kit"}, {"longest": 196}),
    ({"dataset": "uestc"}, {"longest": 60}),
    ({"dataset": "uestc", "num_frames": 40}, {"longest": 40}),
    ({"dataset": "humanml", "num_frames": 40}, {"longest": 196}),
    ({"context_len": 20, "pred_len": 40}, {"guidance_scale": 7.5, "longest": 60}),
    ({"lambda_rcxyz": 1.0, "lambda_vel": 2.0, "lambda_fc": 3.0},
     {"losses": {"joints": 1.0, "velocity": 2.0, "foot_contact": 3.0}}),
])  # fmt: skip
def test_released_models_of_mdm_are_sampled_as_by_their_authors(
    options: dict[str, Any], expected: dict[str, Any]
):
    recipe = recipe_of("mdm", **options)
    assert {name: recipe[name] for name in expected} == expected


def test_the_released_model_of_flame_has_the_authors_guidance_and_length():
    network = Released(FLAME, (135, 270, 1024), {"max_frames": 421}, {})
    config, facts = _flame_recipe(network)
    task = config["task"]
    assert (task["guidance_scale"], task["cond_drop_prob"], facts["max_frames"]) == (8.0, 0.25, 420)
    assert (config["condition"]["features"], config["optimizer"]["weight_decay"]) == (1024, 0.0)


def test_averaged_weights_are_taken_and_models_that_attend_to_padding_are_sampled_at_their_length(
    tmp_path,
):
    averaged = small_state(150)
    last = {key: value + 1 for key, value in averaged.items()}
    words = released_file(tmp_path, {"model": last, "model_avg": averaged}, {"dataset": "uestc"})
    assert main(["import", "mdm", *words]) == 0
    model = load(tmp_path)
    assert main(["import", "mdm", *words, "averaged=false"]) == 0
    bias = model.denoiser.get_parameter("output.bias")
    assert torch.equal(load(tmp_path).denoiser.get_parameter("output.bias"), bias + 1)
    with inputs_of(model.denoiser) as seen:
        assert len(generate(model, frames=24, num_inference_steps=2)[0].features) == 24
    assert {x_t.shape[1] for x_t, *_ in seen} == {60}


def test_imports_that_cannot_be_are_one_line(refused, bad):
    statistics_folder(bad, 150)
    for kind, change, more, message in (
        (
            "mdm",
            {},
            [f"stats={bad}"],
            "model.pt: features of uestc are not normalized. Omit stats=FOLDER",
        ),
        (
            "mdm",
            {"dataset": "humanml"},
            [],
            "expected 263 features of humanml-legacy-smpl22",
        ),
        (
            "mdm",
            {"dataset": "amass"},
            [],
            "args.json: dataset is \"amass\", not 'humanml', 'kit', 'humanact12' or 'uestc'",
        ),
        ("mdm", {"arch": "trans_dec"}, [], "unknown keys seqTransEncoder"),
        ("mfm", {"dynamic": "diffusion"}, [], "dynamic is \"diffusion\", not 'flow'"),
        ("mfm", {"text_emebed": "t5-large"}, [], "text_emebed is \"t5-large\", not 'clip'"),
        ("flame", {}, [], "flame takes no options file"),
    ):
        words = released_file(bad, small_state(150), {"dataset": "uestc"} | change)
        refused("import", kind, *words, *more, says=message)
    state = {f"net.{key}": value for key, value in weights(golden("flame_text2motion")).items()}
    torch.save({"state_dict": state}, bad / "a.ckpt")
    refused(
        "import",
        "flame",
        str(bad / "a.ckpt"),
        f"out={bad}",
        says="lm.pooler.dense.weight is missing",
    )
    assert not (bad / "ours.safetensors").exists()


def test_statistics_have_to_fit(refused, bad):
    words = ["mdm", *released_file(bad, small_state(263), {"dataset": "humanml"}), f"stats={bad}"]
    refused(
        "import",
        *words[:-1],
        says="features of humanml3d are normalized. Set stats=FOLDER with Mean.npy",
    )
    refused("import", *words, says="Mean.npy: no such file")
    for name, value, says in (
        (
            "Mean.npy",
            np.zeros(251),
            "Mean.npy: has shape (251,); expected (263,) and finite numbers",
        ),
        (
            "Mean.npy",
            np.zeros(263, "c8"),
            "Mean.npy: has shape (263,); expected (263,) and finite numbers",
        ),
        (
            "Std.npy",
            np.zeros(263),
            "expected (263,) and finite numbers, which are positive in Std.npy",
        ),
    ):
        statistics_folder(bad, 263)
        np.save(bad / name, value)
        refused("import", *words, says=says)
    statistics_folder(bad, 263)
    assert main(["import", *words]) == 0
    assert np.array_equal(
        load(bad).representation.mean, np.load(bad / "Mean.npy").astype(np.float32)
    )


def test_pickles_of_objects_are_read_on_demand_only(refused, bad):
    state = {"state_dict": small_state(150), "hyper": argparse.Namespace(a=1)}
    words = ["mdm", *released_file(bad, state, {"dataset": "uestc"})]
    refused("import", *words, says="contains Python objects (argparse.Namespace)")
    refused("import", *words, says="run_code=true")
    assert main(["import", *words, "run_code=true"]) == 0
    for content in (b"not a checkpoint", (bad / "model.pt").read_bytes()[:-500]):
        (bad / "model.pt").write_bytes(content)
        refused("import", *words, says="model.pt: damaged, or not a ")


def test_a_model_file_is_the_checkpoint(trained, data_root, tmp_path, capsys, subtests):
    file, half = tmp_path / "model" / "mine.safetensors", tmp_path / "half.safetensors"
    assert main(["export", str(trained), f"out={file}"]) == 0
    assert str(file) in capsys.readouterr().out
    unfinished = file.with_name(".mine.1-2.safetensors")
    unfinished.touch()
    before, after = load(trained), load(file.parent)
    unfinished.unlink()
    assert list(file.parent.iterdir()) == [file]
    assert before.state_dict().keys() == load_file(file).keys()
    torch.testing.assert_close(after.state_dict(), before.state_dict(), rtol=0, atol=0)
    assert after.facts == before.facts
    assert before.steps == after.steps == 2
    content = model_files.read_model_file(file)
    assert (
        model_files.read_model_file(hub.export(file, tmp_path / "again"))["origin"]
        == content["origin"]
    )
    assert (content["origin"]["steps"], content["config"]["data"]["root"]) == (2, "data")
    for path in (trained.parent.parent, data_root, tmp_path):
        with subtests.test(path=path):
            assert str(path).encode() not in file.read_bytes(), "it tells where it was made"
    assert main(["export", str(trained), str(half), "half=true"]) == 0
    assert half.stat().st_size < 0.6 * file.stat().st_size
    assert {value.dtype for value in load_file(half).values() if value.ndim > 1} == {torch.float16}
    vectors = {n: v for n, v in load_file(half).items() if v.ndim == 1 and v.is_floating_point()}
    assert {value.dtype for value in vectors.values()} == {torch.float32}, "statistics are exact"
    torch.testing.assert_close(load(half).state_dict(), before.state_dict(), atol=1e-3, rtol=1e-3)
    assert model_files.read_model_file(half)["origin"]["half_precision"]


@pytest.mark.parametrize(
    ("words", "folder", "upload", "private"),
    [
        ([], Path("push/walker"), True, False),
        (["private=true"], Path("push/walker"), True, True),
        (["mine", "dry_run=true"], "mine", False, False),
    ],
)
def test_the_command_pushes_to_a_folder_of_the_same_name(
    monkeypatch, capsys, words, folder, upload, private
):
    pushed = list[tuple[Any, ...]]()

    def push(source: Path, name: str, out: str | Path, **keys: Any) -> str | Path:
        pushed.append((source, name, out, keys))
        return out

    monkeypatch.setattr(hub, "push", push)
    assert main(["push", "quickstart", "me/walker", *words]) == 0
    keys = {"upload": upload, "private": private}
    assert pushed == [(find("quickstart"), "me/walker", folder, keys)]
    result = "uploaded to me/walker" if upload else "not uploaded"
    assert f"{result}: {folder}" in capsys.readouterr().out


def test_commands_load_the_chosen_checkpoint_of_a_run_with_its_adapters(tmp_path, monkeypatch):
    files = {which: tmp_path / "checkpoints" / f"{which}.ckpt" for which in ("last", "best")}
    files["last"].parent.mkdir()
    for path in (*files.values(), tmp_path / "config.yaml"):
        path.touch()
    loaded = list[tuple[Any, ...]]()
    monkeypatch.setattr(
        "flame_mdm.checkpoints.loading.load", lambda *words, **keys: loaded.append((words, keys))
    )
    for which, file in files.items():
        assert find(tmp_path, which) == file  # type: ignore[arg-type]
        options: dict[str, Any] = {"ckpt": str(tmp_path), "which": which, "text": "walks"}
        options |= {"device": "cpu", "adapter": ["a", "b"], "adapter_strength": [0.5, 2.0]}
        SampleSettings(**options).load()
        EditSettings(**options, motion="walk.npz", joints="arms").load()
        expected = (file, "cpu"), {"adapter": ["a", "b"], "strength": [0.5, 2.0]}
        assert loaded == [expected] * 2
        loaded.clear()
    files["best"].unlink()
    with pytest.raises(FileNotFoundError, match=r"no such checkpoint\. The run has last\.ckpt"):
        find(tmp_path, "best")


def test_a_card_states_the_facts_of_the_model_and_how_it_is_sampled():
    model: dict[str, Any] = {
        "config": {
            "experiment": "humanact12/mdm",
            "condition": {"_target_": "flame_mdm.conditions.action.ActionLabels"},
        },
        "facts": {"actions": ["walk", "sit"], "max_frames": 60, "dataset": "humanact12"},
        "state_dict": {"a": torch.zeros(1000, 20), "b": torch.zeros(7)},
        "origin": {"steps": 500, "averaged": True},
    }
    card = hub.card(model, "me/walker", "f00d")
    rows = dict(re.findall(r"^\| ([^|]+) \| (.*) \|$", card, re.MULTILINE))
    expected = {"parameters": "20,007", "longest motion": "60 frames", "actions": "walk, sit"}
    expected |= {"condition": "ActionLabels", "data": "humanact12", "weights: steps": "500"}
    expected |= {"fingerprint of the data": "unknown", "sha256 of model.safetensors": "f00d"}
    assert {name: rows[name] for name in expected} == expected
    assert "flame_mdm.generate(model, actions=['walk'], seconds=3, seed=0)" in card


@pytest.mark.parametrize(
    ("condition", "words"),
    [
        ("tokens.LearnedTokens", '"a person walks forward", '),
        ("text.PretrainedText", '"a person walks forward", '),
        ("Unconditional", ""),
    ],
)
def test_a_card_requests_what_the_model_is_conditioned_on_and_lists_the_parts_of_a_mixture(
    condition, words
):
    parts = [
        {"license": "CC0", "clips": 3, "minutes": 1.5, "actions": ["run"]},
        {"license": "of my own", "clips": 20, "minutes": 0.0, "actions": []},
    ]
    model: dict[str, Any] = {
        "config": {
            "experiment": "mine",
            "condition": {"_target_": f"flame_mdm.conditions.{condition}"},
        },
        "facts": {"actions": [], "max_frames": 60, "dataset": "bandai", "licenses": parts},
        "state_dict": {},
        "origin": {"averaged": False},
    }
    card = hub.card(model, "me/walker", "f00d")
    assert f"flame_mdm.generate(model, {words}seconds=3, seed=0)" in card
    assert "| actions | none |" in card
    assert "| weights: averaged | False |" in card
    assert "| CC0 | 3 | 1.5 | run | CC0: no conditions. |" in card
    assert "| of my own | 20 | 0.0 |" in card
    assert "license: cc-by-nc-4.0" not in card, "each part has its own license"


@pytest.mark.parametrize("is_moved", [True, False])
def test_a_shared_recipe_names_the_default_folders_instead_of_absolute_ones(is_moved: bool):
    here = "/home/me" if is_moved else "mine"
    config = {
        "experiment": "bandai/mdm",
        "data_root": f"{here}/sets",
        "run": {"dir": f"{here}/runs/7"},
        "data": {"root": f"{here}/sets"},
        "seed": 3,
    }
    shared = model_files.without_own_paths(config)
    folders = (shared["data_root"], shared["data"]["root"], shared["run"]["dir"])
    default = ("data", "data", "runs/bandai/mdm/default")
    assert folders == (default if is_moved else ("mine/sets", "mine/sets", "mine/runs/7"))
    assert (shared["seed"], config["data_root"]) == (3, f"{here}/sets")


def test_options_at_the_top_of_a_file_override_those_of_training_and_of_the_network(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(
        "model: {num_heads: 2, num_frames: 20, lambda_vel: 1}\n"
        "training: {num_heads: 3, num_frames: 30}\n"
        "num_frames: 40\ncond_mask_prob: null\n"
    )
    expected = {"num_heads": 3, "num_frames": 40, "lambda_vel": 1.0, "cond_mask_prob": 0.1}
    options = read_options(path, {}).model_dump()
    assert {name: options[name] for name in expected} == expected
    assert read_options(path, {"num_heads": 8}).num_heads == 8


@pytest.mark.parametrize("count", [12, 13])
@pytest.mark.parametrize("dataset", ["humanact12", "uestc"])
def test_actions_of_released_models_have_names_if_they_are_those_of_their_data_set(count, dataset):
    network = Released(MDMEncoder, (150, 150, 8), {}, {}, torch.zeros(count, 8))
    config, facts = _mdm_recipe("mdm", network, Options(dataset=dataset))
    numbered = [f"action {number}" for number in range(count)]
    is_named = (count, dataset) == (12, "humanact12")
    assert facts["actions"] == (list(HumanAct12.actions) if is_named else numbered)
    assert config["condition"]["features"] == 8


def test_a_loaded_model_has_the_hash_of_its_file_and_a_built_one_the_facts_about_its_data():
    model = load("quickstart")
    assert model.sha256 == sha256(find("quickstart"))

    built = MotionGenerator.build(
        model.config, model.representation, actions=["walk"], facts={"vocabulary": ["walks"]}
    )
    assert built.facts == {"actions": ["walk"], "vocabulary": ["walks"]}
    assert built.condition.seen == {"walks"}
    assert built.sha256 == ""


def test_damaged_foreign_and_absent_files_are_one_line(trained, tmp_path, subtests):
    file = hub.export(trained, tmp_path / "whole")
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[-100] ^= 1
    for content, message in (
        (whole[:-10], "damaged, or is not a .safetensors file"),
        (bytes(flipped), "it has changed since it was written"),
        (
            whole.replace(b'\\"steps\\": 2', b'\\"steps\\": 9'),
            "it has changed since it was written",
        ),
        (
            whole.replace(b'\\"format\\": 2', b'\\"format\\": 3'),
            "has format 3, but this version reads format 2",
        ),
        (
            whole.replace(b'\\"format\\": 2', b'\\"format\\": 1'),
            "written by flame_mdm 0.1",
        ),
        (whole.replace(b'\\"origin\\"', b'\\"oregon\\"'), "its recipe cannot be read"),
    ):
        with subtests.test(content=content, message=message):
            assert content != whole
            file.write_bytes(content)
            with one_line_error(f"{re.escape(str(file))}.*{message}"):
                load(file)
    for name in ("a", "b"):
        save_file({"w": torch.zeros(1)}, tmp_path / f"{name}.safetensors")
    (tmp_path / "empty").mkdir()
    for name, message in (
        (tmp_path / "a.safetensors", r"weights without a recipe\. Import released weights"),
        (tmp_path / "empty", r"this folder contains no \.safetensors file"),
        (tmp_path, r"contains a\.safetensors, b\.safetensors\. Use the path"),
        ("nobody/model.ckpt", "no such checkpoint"),
        (
            "nobody/model@v1",
            r"^nobody/model@v1: no such file or folder, and no model .* can be downloaded.*$",
        ),
    ):
        with subtests.test(message=message), one_line_error(message):
            load(name)


def test_push_writes_a_card_and_uploads_these_files_alone(
    trained, tmp_path, capsys, monkeypatch, subtests
):
    folder, api = tmp_path / "mine", MagicMock()
    words = ["push", str(trained), "me/walker", f"out={folder}"]
    assert main([*words, "dry_run=true"]) == 0
    card, fingerprint = (folder / "README.md").read_text(), load(trained).facts["fingerprint"]
    assert card.startswith("---\nlicense: mit\n")
    assert all(
        fact in card
        for fact in ('flame_mdm.load("me/walker")', "| data | synthetic |", fingerprint)
    )
    assert {path.name for path in folder.iterdir()} == {
        "README.md",
        "config.yaml",
        "model.safetensors",
    }
    model = model_files.read_model_file(folder / "model.safetensors")
    for dataset, terms in (("bandai", "license: cc-by-nc-4.0"), ("humanml3d", "license: other")):
        with subtests.test(dataset=dataset):
            model["facts"]["dataset"] = dataset
            assert terms in hub.card(model, "me/walker", "")
    assert "non-commercial" in hub.card(model, "me/walker", "")
    licenses = [{"license": "CC0", "clips": 3, "minutes": 1.5, "actions": ["run", "walk"]}]
    model["facts"] |= {"dataset": "package", "licenses": licenses}
    assert "| CC0 | 3 | 1.5 | run, walk | CC0: no conditions. |" in hub.card(model, "me/walker", "")

    monkeypatch.setattr(huggingface_hub, "HfApi", lambda: api)
    (folder / "notes.txt").write_text("private")
    assert main([*words, "private=true"]) == 0
    api.create_repo.assert_called_once_with("me/walker", private=True, exist_ok=True)
    assert "notes.txt" not in api.upload_folder.call_args.kwargs["allow_patterns"]
    capsys.readouterr()
    api.create_repo.side_effect = RuntimeError("no token\nlog in")
    assert (
        error_of(capsys, *words)
        == f"error: me/walker: upload failed: no token. The files are in {folder}"
    )


@pytest.mark.slow
def test_a_model_is_sampled_without_importing_lightning_and_the_compiler():
    program = "import sys, flame_mdm; flame_mdm.generate(flame_mdm.load('quickstart'), 'a person walks', seconds=1)"
    slow = "{'lightning', 'torchmetrics', 'transformers', 'torch._dynamo', 'scipy.stats'}"
    subprocess.run(
        [sys.executable, "-c", f"{program}; assert not {slow} & {{*sys.modules}}"], check=True
    )


@pytest.mark.parametrize(
    ("settings", "function"),
    [
        (AdaptSettings, adapt),
        (ImportSettings, import_released),
        (ExportSettings, hub.export),
        (ExportSettings, export_onnx),
        (SampleSettings, SamplingRequest),
        (EditSettings, EditRequest),
    ],
)
def test_options_have_the_same_defaults_on_the_command_line_and_in_python(
    monkeypatch, settings, function
):
    monkeypatch.delenv("FLAME_MDM_DATA", raising=False)
    parameters = signature(function).parameters
    defaults = {
        entry.name: (
            (entry.default, parameters[entry.name].default)
            if entry.default_factory is MISSING
            else (entry.default_factory(), parameters[entry.name].default)
        )
        for entry in fields(settings)
        if entry.name in parameters
    }
    chosen = {name: pair for name, pair in defaults.items() if MISSING not in pair}
    differing = {
        name for name, (typed, ours) in chosen.items() if ours not in (typed, Parameter.empty)
    }
    # On the command line, the number of samples depends on the command.
    assert differing - {"samples"} == set()
    assert chosen


def test_weights_are_taken_from_every_form_of_a_released_file():
    def value(number: float) -> torch.Tensor:
        return torch.full((1,), number)

    flame = {"net.a": value(1), "ema_model.model.a": value(2), "lm.b": value(3)}
    both = {"model": {"a": value(4)}, "model_avg": {"a": value(5)}}
    for checkpoint, averaged, last in (
        ({"state_dict": flame}, 2, 1),
        (flame, 2, 1),
        ({"state_dict": {"net.a": value(1)}}, 1, 1),
        (both, 5, 4),
        ({"a": value(6)}, 6, 6),
    ):
        for is_averaged, expected in ((True, averaged), (False, last)):
            state = released_state(checkpoint, ema=is_averaged)
            assert {name: float(x) for name, x in state.items()} == {"a": expected}
    content = {f"key{number}": number for number in range(8)}
    with pytest.raises(ValueError, match=r"it has key0, key1, key2, key3, key4 and 3 more$"):
        released_state(content)


def test_an_existing_path_takes_precedence_over_the_models_of_the_package_and_of_the_hub(
    tmp_path, monkeypatch
):
    downloads: list[tuple[Any, ...]] = []

    def hf_hub_download(name: str, file: str, revision: str | None) -> str:
        downloads.append((name, file, revision))
        return "downloaded"

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", hf_hub_download)
    monkeypatch.chdir(tmp_path)
    assert find("quickstart") == SHIPPED["quickstart"]
    assert find("me/walker@v1.2/b") == find("me/walker") == Path("downloaded")
    file = "model.safetensors"
    assert downloads == [("me/walker", file, "v1.2/b"), ("me/walker", file, None)]
    for name in ("quickstart", "me/walker"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "mine.safetensors").touch()
        assert find(name) == Path(name, "mine.safetensors")
    with pytest.raises(
        FileNotFoundError, match=r"me/walkr: no such checkpoint\. Did you mean walker"
    ):
        find("me/walkr")


def test_a_folder_of_runs_names_the_runs_below_it(tmp_path):
    (tmp_path / "x" / "default" / "checkpoints").mkdir(parents=True)
    with pytest.raises(
        UserError,
        match=r"x: not a run directory, but it contains run directories\. Use one of them: .*x/default$",
    ):
        find(tmp_path / "x")
