"""Imports the checkpoints released by the authors of MDM, MFM and FLAME.

The import fails unless each learned weight is used exactly once. Frozen text encoders and sinusoids
are skipped.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from hydra.utils import get_class
from torch import Tensor

from flame_mdm.checkpoints import released_weights as theirs
from flame_mdm.checkpoints.model_files import check_weights, without_own_paths, write_model_file
from flame_mdm.checkpoints.released_options import Options, check_hyperparameters, read_options
from flame_mdm.config import EXPERIMENTS, Config, compose, instantiate, plain
from flame_mdm.data.humanact12 import HumanAct12
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.flame import FLAME
from flame_mdm.denoisers.gru import MDMGRU
from flame_mdm.denoisers.mdm import MDMDecoder, MDMEncoder
from flame_mdm.errors import UserError, first_line
from flame_mdm.generator import MotionGenerator
from flame_mdm.safe_io import read_npy, read_package_yaml, sha256
from flame_mdm.task import Task

NETWORKS = {
    "trans_enc": (MDMEncoder, "seqTransEncoder", theirs.ENCODER_LAYER),
    "trans_dec": (MDMDecoder, "seqTransDecoder", theirs.DECODER_LAYER),
    "gru": (MDMGRU, "", {}),
}
"""Architectures of MDM, by the authors' names.

Each entry contains the project's network, the authors' name for the transformer, and the names of
the layers.
"""
NORMALIZED = ("humanml3d", "kit")
PADDED_FRAMES, ACTION_FRAMES = 196, 60
# Guidance scale for models that continue a prefix, as in the authors' evaluation
PREFIX_GUIDANCE = 7.5
ENCODERS = {"clip": "clip", "bert": "distilbert"}
POOLER, ACTIONS = "lm.pooler.dense.", "embed_action.action_embedding"


class Released(NamedTuple):
    """A released network, with its weights renamed to this project's names."""

    network: type[Denoiser]
    features: tuple[int, int, int]  # in_features, out_features, cond_features
    options: dict[str, Any]
    state: dict[str, Tensor]
    # (actions, C), action vectors of the condition encoder
    action_embedding: Tensor | None = None

    def checked(self) -> Self:
        """Returns this object. Raises `UserError` unless the network has exactly these weights."""
        with torch.device("meta"):
            network = self.network(*self.features, **self.options)
        theirs.load_strictly(network, self.state, "released weights", assign=True)
        return self


def import_mdm(state: Mapping[str, Tensor], args: Options, *, time_token: bool = False) -> Released:
    """Converts a model of MDM or MFM.

    The network may be an encoder, a decoder, a decoder with an input token, or a GRU. The condition
    may be text, actions or nothing.

    Args:
        state: weights from `released_state`, whose shapes determine the sizes of the network.
        args: options of the authors' code.
        time_token: whether the decoder's input token contains only the time, as in the authors'
            code since February 2025. The released model with an input token is older than this
            change.
    """
    network, stack, layer = NETWORKS[args.arch]
    dropped = ("sequence_pos_encoder.pe", "embed_timestep.sequence_pos_encoder.pe", "clip_model.")
    learned = {key: value for key, value in state.items() if not key.startswith(dropped)}
    cond_features = theirs.shape_of(learned, ACTIONS)[1] if ACTIONS in learned else 0
    embedding = learned.pop(ACTIONS, None)
    names, num_layers = theirs.layer_names(learned, stack, layer)
    ours = theirs.renamed(learned, theirs.NAMES["mdm"] | names)

    out_features, latent_dim = theirs.shape_of(ours, "output.weight")
    in_features = theirs.shape_of(ours, "input.weight")[1]
    options: dict[str, Any] = {"latent_dim": latent_dim, "num_layers": num_layers, "dropout": 0.1}
    if embedding is not None:
        options["project_condition"] = False
    if "condition.projection.weight" in ours:
        cond_features = theirs.shape_of(ours, "condition.projection.weight")[1]
    if args.arch == "gru":
        in_features -= latent_dim
        num_layers = sum(key.startswith("gru.weight_ih_l") for key in ours)
        options |= {"num_layers": num_layers, "recur_over_batch": True}
    else:
        ff_size = theirs.shape_of(ours, "transformer.layers.0.feed_forward.0.weight")[0]
        options |= {
            "ff_size": ff_size,
            "num_heads": args.num_heads,
            "mask_padding": args.mask_frames,
        }
    if args.arch == "trans_dec":
        distilbert = args.text_encoder_type == "bert"
        options["token_memory"] = distilbert
        options |= {
            "memory": args.emb_policy,
            "context_frames": args.context_len,
            **_target_options(ours),
        }
        # In the code that introduced DistilBERT, the token contains only the time.
        if args.emb_trans_dec:
            options["input_token"] = "time" if time_token or distilbert else "condition"
    if (args.lambda_target_loc or args.multi_target_cond) and "target_encoder" not in options:
        raise ValueError(
            "released weights: embed_target_cond is missing, but the options name a target encoder"
        )
    return Released(
        network, (in_features, out_features, cond_features), options, ours, embedding
    ).checked()


def _target_options(ours: Mapping[str, Tensor]) -> dict[str, Any]:
    """Infers the options of the target encoder from its renamed weights."""
    layers = sum(key.startswith("target.network.") and key.endswith(".weight") for key in ours) - 1
    if layers >= 0:
        return {"target_encoder": "single", "target_layers": layers}
    if "target.weights" in ours:
        return {"target_encoder": "multi"}
    layers = (
        sum(key.startswith("target.networks.0.") and key.endswith(".weight") for key in ours) - 1
    )
    return {"target_encoder": "split", "target_layers": layers} if layers >= 0 else {}


def import_flame(state: Mapping[str, Tensor], *, num_heads: int = 8) -> Released:
    """Converts FLAME's network, except for RoBERTa.

    The number of attention heads, which is 8 in FLAME, cannot be inferred from the weights.
    """
    learned = {key: value for key, value in state.items() if not key.startswith("lm.")}
    names, num_layers = theirs.layer_names(learned, "tf_decoder", theirs.DECODER_LAYER)
    ours = theirs.renamed(learned, theirs.NAMES["flame"] | names)
    latent_dim, in_features = theirs.shape_of(ours, "input.weight")
    output, pooled = (
        theirs.shape_of(ours, name) for name in ("output.weight", "pooled_projection.weight")
    )
    ff_size, _ = theirs.shape_of(ours, "transformer.layers.0.feed_forward.0.weight")
    options = {
        "latent_dim": latent_dim,
        "ff_size": ff_size,
        "num_layers": num_layers,
        "num_heads": num_heads,
    }
    options |= {"dropout": 0.1, "max_frames": theirs.shape_of(ours, "length_embedding.weight")[0]}
    return Released(FLAME, (in_features, output[0], pooled[1]), options, ours).checked()


def _recipe(
    name: str, released: Released, representation: str, condition: Config, process: Config
) -> Config:
    return {
        "experiment": name,
        "seed": 0,
        "denoiser": {
            "_target_": f"{released.network.__module__}.{released.network.__name__}",
            **released.options,
        },
        "condition": condition,
        "process": process,
        "representation": _option("representation", representation),
        "task": _option("task", "generation"),
        "losses": {},
        "optimizer": {"_target_": "torch.optim.AdamW", "lr": 1e-4},
    }


def _option(group: str, name: str) -> Config:
    """Reads a mapping from `experiments/`, without resolving interpolations."""
    return read_package_yaml(EXPERIMENTS / group / f"{name}.yaml")


def _flame_recipe(released: Released) -> tuple[Config, dict[str, Any]]:
    condition = _option("condition", "roberta") | {"features": released.features[2]}
    config = _recipe(
        "released/flame", released, "smpl", condition, _option("process", "flame_code")
    )
    config["task"] |= {"cond_drop_prob": 0.25, "guidance_scale": 8.0}
    config["optimizer"] |= {"weight_decay": 0.0}
    # The authors' table of positions has one row for the time token, which comes first, and one
    # row per frame of the longest motion.
    longest = released.options["max_frames"] - 1
    return config, {
        "actions": [],
        "dataset": "humanml3d-smpl",
        "fingerprint": None,
        "max_frames": longest,
    }


def _mdm_recipe(kind: str, released: Released, args: Options) -> tuple[Config, dict[str, Any]]:
    dataset, representation = theirs.NAMES["datasets"][args.dataset]
    actions: list[str] = []
    condition: Config = _option("condition", "none")
    if released.action_embedding is not None:
        count, width = released.action_embedding.shape
        names = HumanAct12.actions if dataset == "humanact12" else ()
        actions = (
            [*names] if len(names) == count else [f"action {number}" for number in range(count)]
        )
        condition = _option("condition", "action") | {"features": width}
    elif released.features[2]:
        condition = _option("condition", ENCODERS[args.text_encoder_type]) | {
            "features": released.features[2]
        }
    process = _option("process", "flow_matching" if kind == "mfm" else "diffusion")
    config = _recipe(f"released/{kind}", released, representation, condition, process)
    config["task"] |= {
        "cond_drop_prob": args.cond_mask_prob,
        "guidance_scale": 2.5 if args.cond_mask_prob else 1.0,
    }
    if kind == "mfm":
        solver = args.ode_kwargs
        # All methods except dopri5 are Euler's method: "euler" with torchdiffeq's float32 times,
        # and the others with the times i / N.
        process["odeint_grid"] = solver.method == "euler"
        config["task"]["sampler"] = "dopri5" if solver.method == "dopri5" else "euler"
        config["task"]["num_inference_steps"] = int(1 / solver.step_size)
    else:
        process["num_train_timesteps"] = config["task"]["num_inference_steps"] = (
            args.diffusion_steps
        )
        process["schedule"] = args.noise_schedule
        process["variance"] = "fixed_small" if args.sigma_small else "fixed_large"
    config["losses"] = {
        "joints": args.lambda_rcxyz,
        "velocity": args.lambda_vel,
        "foot_contact": args.lambda_fc,
    }
    longest = PADDED_FRAMES if dataset in NORMALIZED else args.num_frames or ACTION_FRAMES
    if args.context_len:
        longest = args.context_len + args.pred_len
        config["task"]["guidance_scale"] = PREFIX_GUIDANCE
    if released.options.get("target_encoder"):
        config["task"]["targets"] = _option("task", "generation_targets")["targets"]
    return config, {
        "actions": actions,
        "dataset": dataset,
        "fingerprint": None,
        "max_frames": longest,
    }


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
    """Converts a released checkpoint to a model file and returns its path.

    The arguments correspond to the keys of `flame-mdm import`.
    """
    file = Path(file)
    if (args is None) != (kind in ("flame", "mclip")):
        needs = (
            "takes no options file. Omit it"
            if args
            else "needs an options file, such as MDM's args.json or MFM's .hydra/config.yaml"
        )
        raise UserError(f"{kind} {needs}")
    options = read_options(args, {} if num_heads is None else {"num_heads": num_heads})
    advice = "Add run_code=true if you trust the authors of the file"
    checkpoint = theirs.read_released(file, run_code=run_code, advice=advice)
    try:
        state = theirs.released_state(checkpoint, ema=averaged and kind != "mclip")
        check_weights(state, file)
        if args is None:
            check_hyperparameters(checkpoint, kind)
        if kind == "mclip":
            sizes = [] if num_heads is None else [f"task.network.num_heads={num_heads}"]
            config = compose("motion_clip/humanml3d_smpl", sizes)
            model: Task | MotionGenerator = get_class(config["task"]["_target_"]).import_released(
                state, without_own_paths(config)
            )
        elif kind == "flame":
            released = import_flame(state, num_heads=num_heads or 8)
            pooler = {
                f"condition.pooler_{name}": state.get(POOLER + name) for name in ("weight", "bias")
            }
            if None in pooler.values():
                raise ValueError(
                    f"released weights: {POOLER}weight is missing: FLAME uses RoBERTa's pooler"
                )
            model = _model(released, *_flame_recipe(released), stats, pooler)
        else:
            released = import_mdm(state, options, time_token=time_token)
            table = (
                {}
                if released.action_embedding is None
                else {"condition.table": released.action_embedding}
            )
            model = _model(released, *_mdm_recipe(kind, released, options), stats, table)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # invalid weights and options may fail anywhere
        kind_of_error = (
            ""
            if isinstance(error, ValueError)
            else f"cannot build the model: {type(error).__name__}: "
        )
        raise UserError(f"{file}: {kind_of_error}{first_line(error)}") from error
    author = f"released by the authors of {kind.upper()}"
    origin = {"made": author, "file": file.name, "sha256": sha256(file), "averaged": averaged}
    return write_model_file(
        out, model.state_dict(), config=model.config, facts=model.facts, origin=origin
    )


def _model(
    released: Released,
    config: Config,
    facts: dict[str, Any],
    stats: str | Path | None,
    extra: dict[str, Any],
) -> MotionGenerator:
    """Builds a model from a recipe, its weights, and the statistics in the folder `stats`.

    `extra` contains the weights of all parts except the network.
    """
    plain(config, "the options of the released model")
    representation = instantiate(config["representation"])
    width = released.features[0]
    dataset = facts["dataset"]
    if representation.features != width:
        expected = (
            f"{representation.features} features of {representation.name}, "
            f"the representation of {dataset}"
        )
        raise ValueError(f"released weights: expected {expected}, but they have {width}")
    if (stats is not None) != (dataset in NORMALIZED):
        state, advice = ("normalized", "Set") if stats is None else ("not normalized", "Omit")
        raise ValueError(
            f"features of {dataset} are {state}. {advice} stats=FOLDER with Mean.npy and Std.npy"
        )
    for name in ("mean", "std") if stats is not None else ():
        file = f"{name.capitalize()}.npy"
        value = read_npy(Path(stats or "") / file)
        numbers = (
            value.dtype.kind in "fiu"
            and value.shape == (width,)
            and bool((abs(value) < float("inf")).all())
        )
        if not numbers or (name == "std" and (value <= 0).any()):
            raise ValueError(
                f"{file}: has shape {tuple(value.shape)}; expected ({width},) and finite numbers, which "
                "are positive in Std.npy"
            )
        extra[f"representation.{name}"] = torch.from_numpy(value).float()
    model = MotionGenerator.build(config, representation, actions=facts["actions"], facts=facts)
    model.denoiser.load_state_dict(released.state)
    model.load_state_dict(extra, strict=False)
    return model.eval()
