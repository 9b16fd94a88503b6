"""Adapters: small changes to a model's weights, learned from a few clips.

In an attention or feed-forward layer, a weight W of shape (out, in) becomes
W + strength * (up @ down), where `up` has shape (out, rank) and `down` has shape (rank, in)
(Hu et al. 2021, arXiv:2106.09685). In a learned text encoder, a vector is added to the row of each
new word. During training, `torch.nn.utils.parametrize` computes the changed weights. The changes
therefore also affect code that reads a weight without calling its layer, such as cross-attention.

All layers are trained, but an adapter for a style keeps only the changes in the second half of the
layers. Changes in the first half would bias the model toward the few actions in the clips, and the
model would no longer follow the requested action.

An adapter file (.safetensors) stores the change to the weight NAME as NAME.up and NAME.down, or as
NAME.vectors. Its metadata contains `About` as JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import register_parametrization
from typing_extensions import TypedDict

from flame_mdm.checkpoints.locating import find
from flame_mdm.checkpoints.model_files import (
    ADAPTER,
    check_weights,
    read_checkpoint,
    read_safetensors,
    state_sha256,
)
from flame_mdm.conditions.tokens import START, LearnedTokens
from flame_mdm.conditions.vocabulary import hashed
from flame_mdm.denoisers.layers import TransformerLayer
from flame_mdm.errors import UserError, first_line
from flame_mdm.safe_io import atomic_write, parse_json, regular_file
from flame_mdm.schemas import check_shape

if TYPE_CHECKING:
    from flame_mdm.generator import MotionGenerator

ORIGINAL, CHANGE = ".parametrizations.weight.original", ".parametrizations.weight.0."
# Learned word vectors are multiplied by this factor. Rows of the word table are drawn from
# N(0, 1), so vectors must change more than weights.
FARTHER = 10.0
Paths = str | Path | Sequence[str | Path]  # one file or several files


class About(TypedDict):
    """Description of an adapter.

    `rows` lists the rows of the word table that the adapter changes, one per word. `base` is the
    hash of the base model's weights.
    """

    name: str
    action: bool
    rank: int
    words: list[str]
    rows: list[int]
    captions: list[str]
    base: str


class Change(nn.Module):
    """A change to a weight during training; see `changed`.

    Adapter files contain the change only if `is_kept` is True.
    """

    def __init__(self, rows: Sequence[int] = (), *, is_kept: bool = True, **parts: Tensor):
        super().__init__()
        self.rows, self.kept = rows, nn.ParameterDict(parts if is_kept else {})
        self.dropped = nn.ParameterDict({} if is_kept else parts)

    def forward(self, weight: Tensor) -> Tensor:
        """Returns `weight` with the change added."""
        return changed(weight, dict((*self.kept.items(), *self.dropped.items())), self.rows)


def changed(
    weight: Tensor, parts: Mapping[str, Tensor], rows: Sequence[int], strength: float = 1.0
) -> Tensor:
    """Returns the weight after applying a low-rank update or adding vectors to some of its rows."""
    if "vectors" in parts:
        return weight.index_add(
            0, torch.tensor(rows, device=weight.device), strength * FARTHER * parts["vectors"]
        )
    return weight + strength * (parts["up"] @ parts["down"])


def word_rows(encoder: LearnedTokens, words: Iterable[str], vocabulary: Iterable[str]) -> list[int]:
    """Returns one of each word's two table rows, preferably one that no vocabulary word uses."""
    used = {row for word in (START, *vocabulary) for row in hashed(word, encoder.buckets)}
    pairs = (hashed(word, encoder.buckets) for word in words)
    return [second if first in used and second not in used else first for first, second in pairs]


def attach(model: MotionGenerator, about: About) -> None:
    """Freezes a model and attaches zero-initialized, trainable updates to its weights.

    Raises `UserError` if the model's denoiser contains no transformer layers.
    """
    model.requires_grad_(False)
    layers = [layer for layer in model.denoiser.modules() if isinstance(layer, TransformerLayer)]
    if not layers:
        raise UserError(
            f"{model.describe()} has no attention layers for an adapter to change. Train all weights with full=true"
        )
    for number, layer in enumerate(layers):
        is_kept = about["action"] or number >= len(layers) // 2
        for module in [module for module in layer.modules() if isinstance(module, nn.Linear)]:
            up, size = torch.zeros(module.out_features, about["rank"]), module.in_features
            down = torch.randn(about["rank"], size) * size**-0.5
            register_parametrization(module, "weight", Change(up=up, down=down, is_kept=is_kept))
    if isinstance(model.condition, LearnedTokens) and (rows := about["rows"]):
        change = Change(rows, vectors=torch.zeros(len(rows), model.condition.features))
        register_parametrization(model.condition.words, "weight", change)


def copy_weights(model: MotionGenerator, base: str | Path) -> None:
    """Copies the weights of a base model into a model, which may already have attached changes.

    `base` is a path or name, as in `find`.
    """
    state = model.state_dict()
    for name, value in read_merged(find(base))["state_dict"].items():
        state[name if name in state else name.removesuffix(".weight") + ORIGINAL] = value
    try:
        model.load_state_dict(state)
    except RuntimeError as error:
        raise UserError(
            f"base={base}: its weights do not match the recipe: {first_line(error)}"
        ) from error


def copy_matching_weights(model: MotionGenerator, source: str | Path) -> tuple[int, int]:
    """Copies trained weights from another model if their names and shapes match.

    The statistics of the features are not copied, since they belong to the data.

    Args:
        model: model that receives the weights. Weights without a match are left unchanged.
        source: a path or name, as in `find`.

    Returns:
        The number of tensors copied, and the number of trained tensors in the model.

    Raises:
        UserError: If no tensor matches.
    """
    weights = read_merged(find(source))["state_dict"]
    parameters = dict(model.named_parameters())
    fitting = [
        name
        for name, parameter in parameters.items()
        if name in weights and weights[name].shape == parameter.shape
    ]
    if not fitting:
        raise UserError(
            f"initial_weights={source}: none of its weights match this recipe in name and shape. Use a model "
            "with the same network and width"
        )
    with torch.no_grad():
        for name in fitting:
            parameters[name].copy_(weights[name])
    return len(fitting), len(parameters)


def write_adapter(path: Path, trained: Path) -> None:
    """Extracts the adapter from a training checkpoint and writes it atomically."""
    from safetensors.torch import save

    checkpoint = read_checkpoint(trained)
    metadata = {"format": "pt", ADAPTER: json.dumps(checkpoint["config"]["adapter"])}
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(_changes(checkpoint["state_dict"]), metadata))


def read_merged(
    path: Path, adapter: Paths = (), strength: float | Sequence[float] = 1.0
) -> dict[str, Any]:
    """Reads a checkpoint or model file and merges adapters into its weights; see `flame_mdm.load`."""
    paths = [adapter] if isinstance(adapter, str | Path) else list(adapter)
    strengths = [strength] * len(paths) if isinstance(strength, int | float) else list(strength)
    if len(strengths) != len(paths) or not all(math.isfinite(value) for value in strengths):
        raise UserError(
            f"adapter strength {strength}: expected one number, or one number for each of the "
            f"{len(paths)} adapters"
        )
    checkpoint = read_checkpoint(path)
    state = checkpoint["state_dict"]
    config = dict(checkpoint["config"])
    facts = dict(checkpoint["facts"])
    plain = {
        name.replace(ORIGINAL, ".weight"): value
        for name, value in state.items()
        if CHANGE not in name
    }
    if (trained := config.pop("adapter", None)) and (changes := _changes(state)):
        _merge(plain, changes, check_shape(trained, About)["rows"], 1.0, path)
    base = state_sha256(plain) if paths else ""
    for file, weight in zip(paths, strengths, strict=True):
        about, changes = _read(Path(file))
        if about["base"] != base:
            raise UserError(
                f"adapter={file}: trained for a model with other weights (hash {about['base'][:12]}, not "
                f"{base[:12]}). Use the model that the adapter was trained for"
            )
        _merge(plain, changes, about["rows"], weight, file)
        for key, more in (("vocabulary", about["words"]), ("captions", about["captions"])):
            if key in facts and weight:  # the base model ignores words that it does not know
                facts[key] = list(dict.fromkeys([*more, *facts[key]]))
    return checkpoint | {"state_dict": plain, "config": config, "facts": facts}


def _changes(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    kept = f"{CHANGE}kept."
    return {name.replace(kept, ".weight."): value for name, value in state.items() if kept in name}


def _merge(
    state: dict[str, Tensor],
    changes: Mapping[str, Tensor],
    rows: Sequence[int],
    strength: float,
    path: str | Path,
) -> None:
    try:
        for name in {name.rpartition(".")[0] for name in changes}:
            parts = {
                key.rpartition(".")[2]: part
                for key, part in changes.items()
                if key.rpartition(".")[0] == name
            }
            state[name] = changed(state[name].float(), parts, rows, strength)
    except (KeyError, RuntimeError, IndexError) as error:
        raise UserError(
            f"{path} is damaged: the adapter does not match the weights ({first_line(error)})"
        ) from error


def _read(path: Path) -> tuple[About, dict[str, Tensor]]:
    regular_file(path)
    metadata, changes = read_safetensors(path)
    if ADAPTER not in metadata:
        raise UserError(f"adapter={path}: not an adapter. Use a file that `flame-mdm adapt` wrote")
    check_weights(changes, path)
    try:
        return check_shape(parse_json(metadata[ADAPTER]), About), changes
    except ValueError as error:
        raise UserError(f"adapter={path} is damaged: {error}") from error
