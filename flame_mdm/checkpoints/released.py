"""Import of the checkpoints released by the authors of MDM, MFM and FLAME.

Each learned weight of a released network is used exactly once, or the import fails. Frozen text encoders and tables of
sinusoids are skipped.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor
from typing_extensions import TypedDict

from flame_mdm.checkpoints.model_files import FILE, MOST_FRAMES, check_weights, without_own_paths, write_model_file
from flame_mdm.config import EXPERIMENTS, Config, instantiate, plain
from flame_mdm.data.humanact12 import HumanAct12
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.flame import FLAME
from flame_mdm.denoisers.gru import MDMGRU
from flame_mdm.denoisers.mdm import MDMDecoder, MDMEncoder
from flame_mdm.errors import UserError, first_line
from flame_mdm.safe_io import check_torch, read_npy, read_yaml, sha256
from flame_mdm.sampler_options import MAX_STEPS
from flame_mdm.schemas import Number, check_shape
from flame_mdm.task import MotionGeneration

# Prefixes of the authors' keys -> ours, inside and outside of layers.
_LAYER = {
    "self_attn.in_proj_": "self_attention.qkv.",
    "self_attn.out_proj.": "self_attention.out.",
    "multihead_attn.in_proj_": "cross_attention.qkv.",
    "multihead_attn.out_proj.": "cross_attention.out.",
    "linear1.": "feed_forward.0.",
    "linear2.": "feed_forward.3.",
    "norm1.": "self_norm.",
}
_ENCODER_LAYER = {**_LAYER, "norm2.": "feed_forward_norm."}
_DECODER_LAYER = {**_LAYER, "norm2.": "cross_norm.", "norm3.": "feed_forward_norm."}
_MDM = {
    "input_process.poseEmbedding.": "input.",
    "output_process.poseFinal.": "output.",
    "embed_timestep.time_embed.": "condition.time_embedding.",
    "embed_text.": "condition.projection.",
}
_FLAME = {
    "motion_length_emb.": "length_embedding.",
    "input_projection.": "input.",
    "last_projection.": "output.",
    "text_pooler_proj.": "pooled_projection.",
    "text_h_proj.": "token_projection.",
}


@dataclass
class Released:
    """A released network, converted to this framework.

    Attributes:
        config: its mapping as in `experiments/denoiser`: `_target_` and sizes.
        features: in_features, out_features and cond_features, the first arguments of the class.
        state: its state dict.
        action_embedding: (actions, C), MDM's learned embedding of action labels, which is part of the condition
            encoder; None for models without actions.
    """

    config: dict[str, Any]
    features: tuple[int, int, int]
    state: dict[str, Tensor]
    action_embedding: Tensor | None = None


def released_state(checkpoint: Mapping[str, Any], *, ema: bool = True) -> dict[str, Tensor]:
    """Finds the network's state dict in the content of a released file.

    Args:
        checkpoint: a flat state dict (MDM, MFM), {"model", "model_avg"} (MDM trained with `--use_ema`) or FLAME's
            Lightning checkpoint with "state_dict".
        ema: whether to use averaged weights if the file has them, as in the authors' evaluation.

    Raises:
        ValueError: If the file has none of these layouts.
    """
    if pair := "model_avg" in checkpoint:
        state = checkpoint.get("model_avg" if ema else "model")
    else:
        state = checkpoint.get("state_dict", checkpoint)
    if not isinstance(state, Mapping) or not all(isinstance(key, str) for key in state):
        state = {}
    for prefix in () if pair else ("ema_model.model.", "net.") if ema else ("net.",):
        inner = {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        if inner:
            state = inner
            break
    if not state or not all(isinstance(value, Tensor) for value in state.values()):
        raise ValueError(
            "not a released checkpoint: expected a state dict, 'model' and 'model_avg', or 'state_dict', but found "
            + (", ".join(sorted(map(str, checkpoint))[:8]) or "nothing")
        )
    return dict(state)


def import_mdm(
    state: Mapping[str, Tensor], args: Mapping[str, Any], *, num_heads: int = 4, time_token: bool = False
) -> Released:
    """Converts a network of MDM or MFM.

    It may be an encoder, a decoder, a decoder + token or a GRU, conditioned on text (CLIP or DistilBERT), on actions or
    on nothing.

    Args:
        state: see `released_state`.
        args: the args.json next to the checkpoint. Missing entries have the authors' defaults, so {} is enough for MFM.
            Sizes are read from the weights.
        num_heads: number of attention heads, 4 in all released models; it is neither in the weights nor in `args`.
        time_token: whether the decoder's input token is the time alone, as in the code since February 2025. The
            released model with an input token is older.

    Raises:
        ValueError: If a weight is missing, unknown, or does not match the network described by `args`.
    """
    arch, text_encoder = args.get("arch", "trans_enc"), args.get("text_encoder_type", "clip")
    if arch not in ("trans_enc", "trans_dec", "gru"):
        raise ValueError(f"args.json: arch must be trans_enc, trans_dec or gru, not {arch!r}")
    dropped = ("sequence_pos_encoder.pe", "embed_timestep.sequence_pos_encoder.pe", "clip_model.")
    learned = {key: value for key, value in state.items() if not key.startswith(dropped)}
    action_embedding = learned.pop("embed_action.action_embedding", None)
    if action_embedding is not None:
        _shape({"embed_action.action_embedding": action_embedding}, "embed_action.action_embedding")
    if arch == "gru":
        ours = _renamed(learned, {**_MDM, "gru.": "gru."})
        num_layers = sum(key.startswith("gru.weight_ih_l") for key in ours)
    else:
        stack, layer = {
            "trans_enc": ("seqTransEncoder", _ENCODER_LAYER),
            "trans_dec": ("seqTransDecoder", _DECODER_LAYER),
        }[arch]
        num_layers = _count_layers(learned, stack)
        ours = _renamed(learned, {**_MDM, **_layer_names(stack, layer, num_layers)})

    out_features, latent_dim = _shape(ours, "output.weight")
    in_features = _shape(ours, "input.weight")[1]
    cond_features = 0
    if "condition.projection.weight" in ours:
        cond_features = _shape(ours, "condition.projection.weight")[1]
    elif action_embedding is not None:
        cond_features = action_embedding.shape[1]
    options: dict[str, Any] = {"latent_dim": latent_dim, "num_layers": num_layers, "dropout": 0.1}
    if action_embedding is not None:
        options["project_condition"] = False
    if arch == "gru":
        in_features -= latent_dim
        options["recur_over_batch"] = True
    else:
        options["ff_size"] = _shape(ours, "transformer.layers.0.feed_forward.0.weight")[0]
        options["num_heads"] = num_heads
        options["mask_padding"] = bool(args.get("mask_frames", False))
    if arch == "trans_dec":
        options["token_memory"] = text_encoder == "bert"
        if args.get("emb_trans_dec", False):
            # The code that introduced DistilBERT has a token of the time alone.
            options["input_token"] = "time" if time_token or text_encoder == "bert" else "condition"
    network = {"trans_enc": MDMEncoder, "trans_dec": MDMDecoder, "gru": MDMGRU}[arch]
    return _checked(network, (in_features, out_features, cond_features), options, ours, action_embedding)


def import_flame(state: Mapping[str, Tensor], *, num_heads: int = 8) -> Released:
    """Converts FLAME's network, without its RoBERTa.

    Args:
        state: see `released_state`.
        num_heads: number of attention heads, 8 in the released models; it cannot be read from the weights.

    Raises:
        ValueError: If a weight is missing or unknown.
    """
    learned = {key: value for key, value in state.items() if not key.startswith("lm.")}
    num_layers = _count_layers(learned, "tf_decoder")
    ours = _renamed(learned, {**_FLAME, **_layer_names("tf_decoder", _DECODER_LAYER, num_layers)})
    latent_dim, in_features = _shape(ours, "input.weight")
    options = {
        "latent_dim": latent_dim,
        "ff_size": _shape(ours, "transformer.layers.0.feed_forward.0.weight")[0],
        "num_layers": num_layers,
        "num_heads": num_heads,
        "dropout": 0.1,
        "max_frames": _shape(ours, "length_embedding.weight")[0],
    }
    features = (in_features, _shape(ours, "output.weight")[0], _shape(ours, "pooled_projection.weight")[1])
    return _checked(FLAME, features, options, ours)


def _count_layers(state: Mapping[str, Tensor], stack: str) -> int:
    return sum(key.startswith(f"{stack}.layers.") and key.endswith(".norm1.weight") for key in state)


def _layer_names(stack: str, layer: Mapping[str, str], num_layers: int) -> dict[str, str]:
    return {
        f"{stack}.layers.{i}.{theirs}": f"transformer.layers.{i}.{ours}"
        for i in range(num_layers)
        for theirs, ours in layer.items()
    }


def _renamed(state: Mapping[str, Tensor], names: Mapping[str, str]) -> dict[str, Tensor]:
    """Renames every key by its prefix."""
    renamed, unknown = {}, []
    for key, value in state.items():
        theirs = next((name for name in names if key.startswith(name)), None)
        if theirs is None:
            unknown.append(key)
        else:
            renamed[names[theirs] + key.removeprefix(theirs)] = value
    if unknown:
        raise ValueError(f"released weights: unknown keys {_listed(unknown)}: not a network of this kind")
    return renamed


def _shape(state: Mapping[str, Tensor], key: str, ndim: int = 2) -> torch.Size:
    if key not in state:
        raise ValueError(f"released weights: {key} is missing: not a network of this kind, or a damaged file")
    if state[key].ndim != ndim:
        raise ValueError(f"released weights: {key} has shape {tuple(state[key].shape)}, not {ndim} dimensions")
    return state[key].shape


def _checked(
    network: type[Denoiser],
    features: tuple[int, int, int],
    options: dict[str, Any],
    state: dict[str, Tensor],
    action_embedding: Tensor | None = None,
) -> Released:
    """Checks names and shapes against a network with these options."""
    with torch.device("meta"):
        expected = network(*features, **options).state_dict()
    if missing := expected.keys() - state.keys():
        raise ValueError(f"released weights: missing {_listed(missing)}: not a network of this kind")
    if unknown := state.keys() - expected.keys():
        raise ValueError(f"released weights: unexpected {_listed(unknown)}: not a network of this kind")
    for key, value in expected.items():
        if state[key].shape != value.shape:
            raise ValueError(f"released weights: {key} is {tuple(state[key].shape)}, expected {tuple(value.shape)}")
    config = {"_target_": f"{network.__module__}.{network.__qualname__}", **options}
    return Released(config, features, state, action_embedding)


def _listed(keys: Any) -> str:
    keys = sorted(keys)
    return ", ".join(keys[:5]) + (f" and {len(keys) - 5} more" if len(keys) > 5 else "")


# Whole models ---------------------------------------------------------------------------------------------------------

Kind = Literal["mdm", "mfm", "flame"]

DATASETS = {
    "humanml": ("humanml3d", "humanml_legacy"),
    "kit": ("kit", "kit_legacy"),
    "humanact12": ("humanact12", "rot6d"),
    "uestc": ("uestc", "rot6d"),
}
"""Authors' name of each data set of MDM and MFM -> our name, and the representation."""

NORMALIZED = ("humanml3d", "kit")
PADDED_FRAMES = 196
ACTION_FRAMES = 60
ENCODERS = {"clip": "clip", "bert": "distilbert"}
POOLER = "lm.pooler.dense."


def import_model(
    kind: Kind,
    checkpoint: Mapping[str, Any],
    args: Mapping[str, Any],
    *,
    statistics: tuple[Tensor, Tensor] | None = None,
    averaged: bool = True,
    num_heads: int | None = None,
    time_token: bool = False,
) -> MotionGeneration:
    """Builds a model from a released checkpoint, with the sampling of the authors' code.

    Args:
        kind: authors of the file.
        checkpoint: its content, see `released_state`.
        args: MDM's args.json, or MFM's Hydra configuration; {} for FLAME. Missing entries have the authors' defaults.
        statistics: mean and std (D,) with which the features are normalized, for HumanML3D and KIT-ML.
        averaged: whether to use averaged weights if the file has them.
        num_heads: number of attention heads, if it differs from the released models.
        time_token: see `import_mdm`.

    Raises:
        ValueError: If the file is not such a model, `args` has unsupported options, or the statistics do not match.
    """
    state = released_state(checkpoint, ema=averaged)
    if args.get("dynamic", "flow") != "flow":
        raise ValueError(f"dynamic={args['dynamic']}: only the flow models of MFM can be imported")
    if kind == "flame":
        released = import_flame(state, num_heads=num_heads or 8)
        config, facts = _flame_recipe(released)
    else:
        if kind == "mfm" and args.get("text_emebed", "clip") != "clip":  # spelled like this by the authors
            raise ValueError(f"text_emebed={args['text_emebed']}: only models of MFM with CLIP can be imported")
        heads = num_heads or args.get("num_heads") or 4
        released = import_mdm(state, args, num_heads=heads, time_token=time_token)
        config, facts = _mdm_recipe(kind, released, args)
    plain(config, "the options of the released model")
    representation = instantiate(config["representation"])
    if representation.features != released.features[0]:
        raise ValueError(
            f"released weights: have {released.features[0]} features, but {representation.name}, the representation of "
            f"data set {facts['dataset']}, has {representation.features}"
        )
    if (statistics is not None) != (facts["dataset"] in NORMALIZED):
        normalized = f"features of {facts['dataset']} are {'' if statistics is None else 'not '}normalized"
        raise ValueError(
            f"{normalized}. {'Give' if statistics is None else 'Leave out'} stats=FOLDER with Mean.npy and Std.npy"
        )
    model = MotionGeneration.build(config, representation, actions=facts["actions"])
    model.facts = facts
    model.denoiser.load_state_dict(released.state)
    extra: dict[str, Tensor] = {}
    if released.action_embedding is not None:
        extra["condition.table"] = released.action_embedding
    if kind == "flame":
        for name in ("weight", "bias"):
            if POOLER + name not in state:
                raise ValueError(f"released weights: {POOLER}{name} is missing: FLAME uses RoBERTa's pooler")
            extra[f"condition.pooler_{name}"] = state[POOLER + name]
    if statistics is not None:
        extra["representation.mean"], extra["representation.std"] = _checked_statistics(*statistics, released)
    model.load_state_dict(extra, strict=False)
    return model.eval()


def _checked_statistics(mean: Tensor, std: Tensor, released: Released) -> tuple[Tensor, Tensor]:
    for name, value in (("Mean.npy", mean), ("Std.npy", std)):
        if value.shape != (released.features[0],) or not value.isfinite().all():
            raise ValueError(f"{name}: shape {tuple(value.shape)}, expected ({released.features[0]},) finite numbers")
    if (std <= 0).any():
        raise ValueError(f"Std.npy: {int((std <= 0).sum())} entries are not positive")
    return mean.float(), std.float()


def _recipe(name: str, released: Released, representation: str, condition: Config, process: Config) -> Config:
    return {
        "experiment": name,
        "seed": 0,
        "denoiser": released.config,
        "condition": condition,
        "process": process,
        "representation": option("representation", representation),
        "task": option("task", "generation"),
        "losses": {},
        "optimizer": {"_target_": "torch.optim.AdamW", "lr": 1e-4},
    }


def option(group: str, name: str) -> Config:
    """Reads a mapping from `experiments/`, without resolving interpolations."""
    return read_yaml(EXPERIMENTS / group / f"{name}.yaml")


def _flame_recipe(released: Released) -> tuple[Config, dict[str, Any]]:
    condition = option("condition", "roberta") | {"features": released.features[2]}
    config = _recipe("released/flame", released, "smpl", condition, option("process", "flame_code"))
    config["task"] |= {"cond_drop_prob": 0.25, "guidance_scale": 8.0}
    config["optimizer"] |= {"weight_decay": 0.0}
    # The authors' table has one row more than the number of lengths.
    longest = released.config["max_frames"] - 1
    return config, {"actions": [], "dataset": "humanml3d-smpl", "fingerprint": None, "max_frames": longest}


def _mdm_recipe(kind: Kind, released: Released, args: Mapping[str, Any]) -> tuple[Config, dict[str, Any]]:
    theirs = args.get("dataset", "humanml")
    if theirs not in DATASETS:
        raise ValueError(f"dataset={theirs} of the released model is not supported, only {', '.join(DATASETS)}")
    dataset, representation = DATASETS[theirs]
    actions: list[str] = []
    condition: Config = option("condition", "none")
    if released.action_embedding is not None:
        count, width = released.action_embedding.shape
        names = HumanAct12.actions if dataset == "humanact12" else ()
        actions = [*names] if len(names) == count else [f"action {number}" for number in range(count)]
        condition = option("condition", "action") | {"features": width}
    elif released.features[2]:
        encoder = args.get("text_encoder_type", "clip")
        if encoder not in ENCODERS:
            raise ValueError(
                f"text_encoder_type={encoder} of the released model is not supported, only {', '.join(ENCODERS)}"
            )
        condition = option("condition", ENCODERS[encoder]) | {"features": released.features[2]}
    drop = float(args.get("cond_mask_prob", 0.1))
    process = option("process", "flow_matching" if kind == "mfm" else "diffusion")
    config = _recipe(f"released/{kind}", released, representation, condition, process)
    config["task"] |= {"cond_drop_prob": drop, "guidance_scale": 2.5 if drop else 1.0}
    if kind == "mfm":
        solver = args.get("ode_kwargs") or {}
        method = solver.get("method", "euler")
        # All methods other than dopri5 are Euler; "euler" uses torchdiffeq's float32 times, the others i / N.
        process["odeint_grid"] = method == "euler"
        config["task"]["sampler"] = "dopri5" if method == "dopri5" else "euler"
        config["task"]["num_inference_steps"] = int(1 / float(solver.get("step_size", 0.01)))
    else:
        process["num_train_timesteps"] = int(args.get("diffusion_steps", 1000))
        process["schedule"] = args.get("noise_schedule", "cosine")
        process["variance"] = "fixed_small" if args.get("sigma_small", True) else "fixed_large"
        config["task"]["num_inference_steps"] = process["num_train_timesteps"]
    weights = {"joints": "lambda_rcxyz", "velocity": "lambda_vel", "foot_contact": "lambda_fc"}
    config["losses"] = {ours: float(args.get(theirs) or 0.0) for ours, theirs in weights.items()}
    longest = PADDED_FRAMES if dataset in NORMALIZED else int(args.get("num_frames") or ACTION_FRAMES)
    return config, {"actions": actions, "dataset": dataset, "fingerprint": None, "max_frames": longest}


# Files ----------------------------------------------------------------------------------------------------------------


def import_released(
    kind: str,
    file: str | Path,
    args: str | Path | None,
    out: str | Path,
    *,
    stats: str | Path | None = None,
    averaged: bool = True,
    num_heads: int | None = None,
    time_token: bool = False,
    run_code: bool = False,
) -> Path:
    """Converts a released checkpoint of MDM, MFM, FLAME or FLAME's motion-CLIP into a model file, and returns its path.

    Args:
        kind: "mdm", "mfm", "flame" or "mclip".
        file: the released file.
        args: args.json next to it (MDM), or the Hydra configuration of its run (MFM); not for FLAME.
        out: as for `export`.
        stats: folder with Mean.npy and Std.npy of the training data, if it is normalized.
        averaged, num_heads, time_token: see `import_model`.
        run_code: whether to load pickles that hold more than weights, which runs any code in them.

    Raises:
        FileNotFoundError: If a file does not exist.
        UserError, ValueError: If it is damaged, or not a released model of this kind.
    """
    file, out = Path(file), Path(out)
    if (args is None) != (kind in ("flame", "mclip")):
        needs = {"mdm": "the args.json next to the checkpoint", "mfm": "the run's .hydra/config.yaml"}
        raise UserError(f"{kind} needs {needs[kind]}" if kind in needs else f"{kind} takes no file of options")
    if num_heads is not None and not (type(num_heads) is int and num_heads >= 1):
        raise UserError(f"num_heads={num_heads}: must be a positive whole number")
    checkpoint = _unpickle(file, run_code)
    try:
        check_weights(released_state(checkpoint, ema=averaged and kind != "mclip"), file)
        if kind == "mclip":
            model = _motion_clip(checkpoint, num_heads)
        else:
            model = import_model(
                kind,  # type: ignore[arg-type]
                checkpoint,
                {} if args is None else _options(Path(args)),
                statistics=None if stats is None else _statistics(Path(stats)),
                averaged=averaged,
                num_heads=num_heads,
                time_token=time_token,
            )
    except (UserError, OSError, MemoryError):
        raise
    except ValueError as error:
        raise UserError(f"{file}: {error}") from error
    except Exception as error:  # nonsensical weights and options may fail anywhere
        what = f"{type(error).__name__}: {first_line(error)}"
        raise UserError(f"{file}: cannot build a model from it and its options: {what}") from error
    out = out if out.suffix == ".safetensors" else out / FILE
    origin = {"made": f"released by the authors of {kind.upper()}", "file": file.name, "sha256": sha256(file)}
    write_model_file(
        out, model.state_dict(), config=model.config, facts=model.facts, origin=origin | {"averaged": averaged}
    )
    return out


def _motion_clip(checkpoint: Mapping[str, Any], num_heads: int | None) -> Any:
    """Imports FLAME's motion-CLIP, with the class named by its recipe."""
    from hydra.utils import get_class

    from flame_mdm.config import compose

    sizes = [] if num_heads is None else [f"task.network.num_heads={num_heads}"]
    config = compose("motion_clip/humanml3d_smpl", sizes)
    return get_class(config["task"]["_target_"]).import_released(checkpoint, without_own_paths(config))


def _unpickle(path: Path, run_code: bool) -> Any:
    try:
        check_torch(path)
        checkpoint = torch.load(path, map_location="cpu", weights_only=not run_code)
    except (FileNotFoundError, UserError):
        raise
    except ImportError as error:
        raise UserError(f"{path}: {error}. The objects in this file need this package: install it") from error
    except Exception as error:  # torch raises many kinds for damaged files
        unsafe = re.search(r"Unsupported global: GLOBAL (\S+)", str(error))
        if unsafe is None:
            raise UserError(f"{path}: damaged, or not a PyTorch file") from error
        raise UserError(
            f"{path}: holds Python objects ({unsafe[1]}) besides the weights, as old Lightning files do. Reading them "
            "can run any code. Add run_code=true if you trust the authors of the file"
        ) from error
    if not isinstance(checkpoint, Mapping):
        raise UserError(f"{path}: holds a {type(checkpoint).__name__}, not the weights of a released model")
    return checkpoint


class _Solver(TypedDict, total=False):
    method: str
    step_size: Annotated[float, Field(ge=1 / MAX_STEPS, le=1)]


class _Options(TypedDict, total=False):
    """Types and limits of the options that are read."""

    arch: str
    dataset: str
    dynamic: str
    noise_schedule: str
    text_emebed: str
    text_encoder_type: str
    cond_mask_prob: Annotated[float, Field(ge=0, le=1)]
    diffusion_steps: Annotated[int, Field(ge=1, le=MAX_STEPS)]
    lambda_fc: Number | None
    lambda_rcxyz: Number | None
    lambda_vel: Number | None
    num_frames: Annotated[int, Field(ge=0, le=MOST_FRAMES)] | None
    num_heads: Annotated[int, Field(ge=1, le=MAX_STEPS)] | None
    ode_kwargs: _Solver | None


def _options(path: Path) -> Mapping[str, Any]:
    options = read_yaml(path)  # JSON is YAML
    if not isinstance(options, dict):
        raise UserError(f"{path}: not a mapping of options")
    # In a composed configuration of MFM, options of network and training are one level down.
    groups = [value for name, value in options.items() if name in ("model", "training") and isinstance(value, dict)]
    found = {name: value for part in (*groups, options) for name, value in part.items() if isinstance(name, str)}
    try:
        solver = found.get("ode_kwargs")
        if isinstance(solver, dict) and isinstance(solver.get("step_size"), str):  # JSON is read as YAML 1.1: 2e-2
            found["ode_kwargs"] = solver | {"step_size": float(solver["step_size"])}
        check_shape(found, _Options)
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
    return found


def _statistics(folder: Path) -> tuple[Any, Any]:
    found = []
    for name in ("Mean.npy", "Std.npy"):
        try:
            found.append(torch.from_numpy(read_npy(folder / name)))
            if found[-1].is_complex():
                raise TypeError("complex numbers")
        except UserError:
            raise
        except (ValueError, EOFError, TypeError) as error:
            raise UserError(f"{folder / name}: damaged, or not an array of numbers") from error
    return found[0], found[1]
