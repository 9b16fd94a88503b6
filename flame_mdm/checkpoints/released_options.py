# pyright: standard
"""Reads the options of released models.

Each option is either read, ignored because it has no effect on the model, or rejected.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from flame_mdm.checkpoints.model_files import MOST_FRAMES
from flame_mdm.checkpoints.released_weights import NAMES
from flame_mdm.config import Config
from flame_mdm.errors import UserError, shortened
from flame_mdm.safe_io import read_yaml
from flame_mdm.sampler_options import MAX_STEPS
from flame_mdm.schemas import Number, Schema, check_shape

# JSON is read as YAML 1.1, in which 2e-2 is text.
YamlNumber = Annotated[float, BeforeValidator(lambda x: float(x) if isinstance(x, str) else x)]

# The value of an option may be the name of an enum member, in upper or lower case.
LowerCase = BeforeValidator(lambda x: x.lower() if isinstance(x, str) else x)


class Solver(Schema):
    """Options of MFM's solver, called `ode_kwargs` in its code."""

    method: str = "euler"
    step_size: Annotated[YamlNumber, Field(ge=1 / MAX_STEPS, le=1)] = 0.01


class Options(Schema):
    """The options that the import of a released model reads, with the authors' defaults."""

    arch: Literal["trans_enc", "trans_dec", "gru"] = "trans_enc"
    dataset: Literal["humanml", "kit", "humanact12", "uestc"] = "humanml"
    dynamic: Literal["flow"] = "flow"
    text_emebed: Literal["clip"] = "clip"  # spelled like this by the authors
    text_encoder_type: Literal["clip", "bert"] = "clip"
    emb_trans_dec: bool = False
    mask_frames: bool = False
    context_len: Annotated[int, Field(ge=0, le=MOST_FRAMES)] = 0
    pred_len: Annotated[int, Field(ge=0, le=MOST_FRAMES)] = 0
    emb_policy: Annotated[Literal["add", "concat"], LowerCase] = "add"
    lambda_target_loc: Number = 0.0
    multi_target_cond: bool = False
    sigma_small: bool = True
    noise_schedule: str = "cosine"
    cond_mask_prob: Annotated[float, Field(ge=0, le=1)] = 0.1
    diffusion_steps: Annotated[int, Field(ge=1, le=MAX_STEPS)] = 1000
    lambda_fc: Number = 0.0
    lambda_rcxyz: Number = 0.0
    lambda_vel: Number = 0.0
    num_frames: Annotated[int, Field(ge=0, le=MOST_FRAMES)] = 0
    num_heads: Annotated[int, Field(ge=1, le=MAX_STEPS)] = 4
    ode_kwargs: Solver = Solver()


def read_options(path: str | Path | None, changes: dict[str, Any]) -> Options:
    """Returns the options in a file of MDM or MFM, updated with `changes`.

    Raises `UserError` for the first invalid option.
    """
    options = {} if path is None else read_yaml(path)  # JSON is YAML
    if not isinstance(options, dict):
        raise UserError(f"{path}: not a mapping of options")
    # In MFM's composed configuration, the options of the network and of training are one level
    # down.
    groups = [name for name in ("model", "training") if isinstance(options.get(name), dict)]
    top = {name: value for name, value in options.items() if name not in groups}
    flat = {
        k: v
        for part in (*(options[name] for name in groups), top)
        for k, v in part.items()
        if v is not None
    }
    solver = flat.get("ode_kwargs")
    try:
        _check_known(flat, Options.model_fields, NAMES["options"]["mdm"])
        if isinstance(solver, dict):
            _check_known(solver, Solver.model_fields, NAMES["options"]["solver"], "ode_kwargs.")
        checked = check_shape(flat | changes, Options)
        _check_prefix(checked)
        return checked
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error


def _check_prefix(options: Options) -> None:
    """Raises `ValueError` if the options for continuing frames (DiP) contradict other options."""
    decoder = options.arch == "trans_dec" and options.text_encoder_type == "bert"
    for name, value in (("context_len", options.context_len), ("emb_policy", options.emb_policy)):
        if value not in (0, "add") and not decoder:
            kind = f"{options.arch} with {options.text_encoder_type}"
            raise ValueError(
                f"{name}={value}: this value is supported only for trans_dec with bert, not for "
                f"{kind}. Import a model without this option"
            )
    if bool(options.context_len) != bool(options.pred_len):
        lengths = f"context_len={options.context_len}, pred_len={options.pred_len}"
        raise ValueError(
            f"{lengths}: both must be positive (a model that continues frames) or both 0. "
            f"Correct the file"
        )


def check_hyperparameters(checkpoint: Mapping[str, Any], kind: str) -> None:
    """Raises `ValueError` if a checkpoint of FLAME's code contains an unknown hyperparameter."""
    options = checkpoint.get("hyper_parameters")
    if isinstance(options, Mapping):
        _check_known(options, (), NAMES["options"][kind], "hyper_parameters.")


def _check_known(options: Mapping[Any, Any], read: Any, table: Config, prefix: str = "") -> None:
    """Raises `ValueError` for an option that is unknown or whose effect cannot be imported."""
    for name, value in options.items():
        shown = f"{prefix}{shortened(str(name), 40)}={shortened(str(value), 40)}"
        if name in table["neutral"]:
            neutral = table["neutral"][name]
            if value is not None and not _equal(value, neutral):
                raise ValueError(
                    f"{shown}: changes the model in a way that cannot be imported; the "
                    f"supported value is {neutral}. Import a model without this option"
                )
        elif value is not None and name not in read and name not in table["unused"]:
            raise ValueError(
                f"{shown}: an unknown option, which may change the network. Import a model "
                f"without this option"
            )


def _equal(value: Any, neutral: Any) -> bool:
    """Returns whether two values are equal. A number may be a string, such as 1e-5 in YAML 1.1."""
    try:
        return value == neutral or (isinstance(neutral, float) and float(value) == neutral)
    except (TypeError, ValueError):
        return False
