"""The two kinds of files that hold models: checkpoints (.ckpt) of training, and model files (.safetensors).

A model file holds the (averaged) weights, statistics of the features included, and as metadata under the key
`flame_mdm` the recipe, the facts of the data and where the weights come from, as JSON. No part of it is code.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NotRequired

from typing_extensions import TypedDict

from flame_mdm.config import current_names, plain
from flame_mdm.errors import UserError
from flame_mdm.files import atomic_write, parse_json, read_torch
from flame_mdm.runs import Number, check_shape

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = 1
KEY = "flame_mdm"
FILE = "model.safetensors"
MOST_FRAMES = 100_000
"""Longest motion that a model may claim to sample: more than an hour at 20 frames per second."""


def read_model_file(path: Path) -> dict[str, Any]:
    """A model file as `config`, `facts`, `origin` and `state_dict`.

    Raises:
        UserError: it is damaged, foreign, or of a newer format.
    """
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get(KEY)
            state = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (it is no mapping)
    except (SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{path}: damaged, or not a .safetensors file") from error
    if text is None:
        raise UserError(
            f"{path}: weights without a recipe; those of MDM, MFM and FLAME are imported by `flame-mdm import`"
        )
    try:
        content = parse_json(text)
        found, digest = content["format"], content["sha256"]
        model = {name: content[name] for name in ("config", "facts", "origin")}
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path}: damaged: its recipe cannot be read") from error
    if found != FORMAT:
        raise UserError(f"{path}: of format {found}, but this version reads {FORMAT}: update flame_mdm")
    model = checked(path, model | {"state_dict": state})
    if _sha256(state) != digest:
        raise UserError(f"{path}: damaged: its weights are not those that were written; fetch or export it again")
    return model


class _Folder(TypedDict, total=False):
    dir: str


class _Part(TypedDict):
    _target_: str


class _Recipe(TypedDict):
    experiment: str | None
    data_root: NotRequired[str | None]
    run: NotRequired[_Folder]
    seed: NotRequired[int]
    data: NotRequired[dict[str, Any]]
    callbacks: NotRequired[dict[str, dict[str, Any] | None] | None]
    task: NotRequired[_Part]
    representation: NotRequired[_Part]
    process: NotRequired[_Part]
    condition: NotRequired[_Part]
    denoiser: NotRequired[_Part]


class _Facts(TypedDict):
    actions: list[str]
    max_frames: int
    dataset: NotRequired[str]  # of released extractors, nobody told
    fingerprint: NotRequired[str | None]
    training: NotRequired[dict[str, Number]]


class _Model(TypedDict):
    config: _Recipe
    facts: _Facts
    origin: dict[str, str | bool | int | float | None]


class _Checkpoint(TypedDict):
    config: _Recipe
    facts: _Facts
    global_step: NotRequired[int]


def checked(path: Path, content: Any) -> dict[str, Any]:
    """Returns what a checkpoint or model file holds, if it is a recipe of plain values, facts of the data and weights.

    Raises:
        UserError: it is something else; or its weights claim to be larger than the file.
    """
    if not isinstance(content, dict) or not {"config", "facts", "state_dict"} <= content.keys():
        raise UserError(
            f"{path}: not a checkpoint of this framework: it holds no recipe; those that authors released are imported "
            "by `flame-mdm import`"
        )
    names = ("config", "facts", "origin", "global_step")
    told = {name: content[name] for name in names if content.get(name) is not None}
    for name, value in told.items():
        plain(value, f"{path}: {name}")
    facts: Any = told.get("facts")
    if isinstance(facts, dict) and isinstance(facts.get("actions"), tuple):
        told["facts"] = facts | {"actions": list(facts["actions"])}
    try:
        check_shape(told, _Model if "origin" in told or path.suffix == ".safetensors" else _Checkpoint)
    except ValueError as error:
        raise UserError(f"{path}: damaged: {error}") from error
    if not 1 <= facts["max_frames"] <= MOST_FRAMES:
        raise UserError(f"{path}: damaged: facts.max_frames is {facts['max_frames']}: give 1 to {MOST_FRAMES:,} frames")
    if not isinstance(content["state_dict"], dict):
        raise UserError(f"{path}: damaged: its weights are no tensors")
    try:
        check_weights(content["state_dict"], path)
    except ValueError as error:
        raise UserError(f"{path}: damaged: {error}") from error
    return content | {"config": current_names(content["config"])}


def check_weights(weights: Mapping[Any, Any], path: Path) -> None:
    """Checks weights out of the file at `path`.

    Raises:
        ValueError: a name is no text, or a value no dense tensor of real numbers; or all claim to be larger than the
            file.
    """
    import torch

    kinds = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
    kinds += (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool)
    for name, value in weights.items():
        if not (isinstance(name, str) and isinstance(value, torch.Tensor)):
            raise ValueError(f"its weights are no tensors by name: {str(name)[:80]} is a {type(value).__name__}")
        if value.layout != torch.strided or value.device.type != "cpu" or value.dtype not in kinds or value.is_neg():
            shown = f"{value.dtype}, {value.layout}, on {value.device.type}"
            raise ValueError(f"its weights are no dense tensors of real numbers: {name[:80]} is {shown}")
    if sum(value.numel() * value.element_size() for value in weights.values()) > 2 * path.stat().st_size:  # 2: shared
        raise ValueError("its weights claim to be larger than the file")


def write_model_file(
    path: Path, state: Mapping[str, Tensor], *, config: Mapping[str, Any], facts: Mapping[str, Any], origin: Any
) -> None:
    """Writes a model file, under a temporary name until it is whole.

    Args:
        path: the .safetensors file to write.
        state: the state dict of a task.
        config: its recipe.
        facts: what sampling and evaluation have to know of its data.
        origin: where the weights come from; plain values.
    """
    from safetensors.torch import save

    tensors = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    content = {"format": FORMAT, "sha256": _sha256(tensors), "config": config, "facts": facts, "origin": origin}
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(tensors, {"format": "pt", KEY: json.dumps(content)}))


def _sha256(state: Mapping[str, Tensor]) -> str:
    import torch

    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(f"{name} {state[name].dtype} {tuple(state[name].shape)}".encode())
        digest.update(state[name].detach().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint or model file, unpickled with plain values and tensors only.

    Args:
        path: a .ckpt or .safetensors file; `flame_mdm.checkpoints.loading.find` finds it.

    Raises:
        FileNotFoundError: no such file.
        UserError: not a checkpoint of this framework, or damaged.
    """
    if path.suffix == ".safetensors":
        return read_model_file(path)
    try:
        checkpoint = read_torch(path)
    except ValueError as error:
        raise UserError(f"{path}: damaged, or not a checkpoint of this framework") from error
    return checked(path, checkpoint)


def without_own_paths(config: Mapping[str, Any]) -> dict[str, Any]:
    """The recipe with the folders of data and of the run where they are by default, not where this machine has them."""
    default = {
        config.get("data_root"): "data",
        config.get("run", {}).get("dir"): f"runs/{config['experiment']}/default",
    }
    own = {folder: other for folder, other in default.items() if folder and Path(folder).is_absolute()}

    def moved(node: Any) -> Any:
        if isinstance(node, dict):
            return {name: moved(value) for name, value in node.items()}
        folder = next((f for f in own if isinstance(node, str) and (node == f or node.startswith(f"{f}/"))), None)
        return node if folder is None else own[folder] + node.removeprefix(folder)

    return moved(dict(config))
