"""File formats of models: training checkpoints (.ckpt) and model files (.safetensors).

A model file contains the (averaged) weights, including the statistics of the features, but no code.
Its metadata contains two keys. `flame_mdm` contains the recipe, the metadata of the data set and
the origin of the weights as JSON. `sha256` is the hash of this JSON text and the weights.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired, Required

from pydantic import Field
from typing_extensions import TypedDict

from flame_mdm.checkpoints.torch_files import read_torch
from flame_mdm.config import moved, renamed
from flame_mdm.errors import UserError
from flame_mdm.safe_io import atomic_write, parse_json
from flame_mdm.schemas import Number, check_plain

if TYPE_CHECKING:
    from torch import Tensor

# Format of checkpoints and model files. Version 0.2.0 introduced format 2.
FORMAT = 2
# Key of the format in a checkpoint
FORMAT_KEY = "flame_mdm_format"
# Keys in the metadata of model files and adapters
KEY = "flame_mdm"
ADAPTER = "flame_mdm_adapter"
FILE = "model.safetensors"
# Maximum motion length, in frames, that a model file may declare: more than an hour at 20 frames
# per second
MOST_FRAMES = 100_000


def read_model_file(path: Path) -> dict[str, Any]:
    """Reads `config`, `facts`, `origin` and `state_dict` from a model file.

    Raises `UserError` if the file is damaged.
    """
    metadata, state = read_safetensors(path)
    text = metadata.get(KEY)
    if ADAPTER in metadata:
        raise UserError(
            f"{path} is an adapter, not a model. Give the model first, then the adapter: MODEL adapter={path}"
        )
    if text is None:
        raise UserError(
            f"{path} contains weights without a recipe. Import released weights with `flame-mdm "
            "import`"
        )
    try:
        content = parse_json(text)
        number = content["format"]
        model = {name: content[name] for name in ("config", "facts", "origin")}
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(f"{path} is damaged: its recipe cannot be read") from error
    check_format(path, number)
    if metadata.get("sha256") != content_sha256(text, state):
        raise UserError(
            f"{path} is damaged: it has changed since it was written. Download or export it again"
        )
    return checked(path, model | {"state_dict": state})


def read_safetensors(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Returns the metadata and the tensors of a .safetensors file. Raises `UserError` if it is damaged."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
            return file.metadata() or {}, tensors
    except (SafetensorError, OSError, ValueError) as error:
        raise UserError(f"{path} is damaged, or is not a .safetensors file") from error


def check_format(path: Path, number: Any) -> None:
    """Raises `UserError` for a format other than `FORMAT`.

    Version 0.1 wrote format 1 or, in checkpoints, None.
    """
    if number in (1, None):
        raise UserError(
            f"{path}: written by flame_mdm 0.1, whose files this version cannot read. Train or import "
            "the model again, or use flame_mdm 0.1"
        )
    if number != FORMAT:
        raise UserError(
            f"{path} has format {str(number)[:40]}, but this version reads format {FORMAT}. Update flame_mdm"
        )


class _Run(TypedDict, total=False):
    dir: str


class _Part(TypedDict):
    _target_: str


class _Recipe(TypedDict, total=False):
    experiment: Required[str | None]
    data_root: str | None
    run: _Run
    seed: int
    data: dict[str, Any]
    callbacks: dict[str, dict[str, Any] | None] | None
    task: Required[_Part]
    representation: Required[_Part]
    process: _Part
    condition: _Part
    denoiser: _Part


class _Training(TypedDict, total=False):
    hours: Number
    memory_gib: Number
    processes: int
    speed: str
    precision: str


class _Licensed(TypedDict):
    """Number, duration and actions of the clips under one license."""

    license: str
    clips: int
    minutes: Number
    actions: list[str]


class _Facts(TypedDict, total=False):
    actions: Required[list[str]]
    max_frames: Required[Annotated[int, Field(ge=1, le=MOST_FRAMES)]]
    dataset: str  # unknown for released extractors
    fingerprint: str | None
    training: _Training
    vocabulary: list[str]
    verbs: list[str]
    captions: list[str]
    licenses: list[_Licensed]


class _Metadata(TypedDict):
    config: _Recipe
    facts: _Facts
    origin: NotRequired[dict[str, str | bool | int | float | None]]
    global_step: NotRequired[int]


def checked(path: Path, content: Any) -> dict[str, Any]:
    """Returns the contents of a checkpoint or model file after checking it.

    The content must include metadata, weights, and a recipe that consists of plain values.
    """
    if not isinstance(content, dict) or not {"config", "facts", "state_dict"} <= content.keys():
        raise UserError(
            f"{path}: not a checkpoint of this framework, because it contains no recipe. Import released "
            "checkpoints with `flame-mdm import`"
        )
    metadata = {
        name: content[name]
        for name in ("config", "facts", "origin", "global_step")
        if name in content
    }
    check_plain(metadata, _Metadata, path)
    if not isinstance(content["state_dict"], dict):
        raise UserError(f"{path} is damaged: its weights are not a mapping of names to tensors")
    check_weights(content["state_dict"], path)
    return content | {"config": renamed(content["config"])}


def check_weights(weights: Mapping[Any, Any], path: Path) -> None:
    """Raises `UserError` unless `weights` maps names to dense tensors of real numbers.

    The total size of the tensors must not exceed the size of the file at `path`.
    """
    import torch

    kinds = (torch.float64, torch.float32, torch.float16, torch.bfloat16)
    kinds += (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8, torch.bool)
    for name, value in weights.items():
        is_dense = (
            isinstance(name, str)
            and isinstance(value, torch.Tensor)
            and value.layout == torch.strided
        )
        if not is_dense or value.device.type != "cpu" or value.dtype not in kinds or value.is_neg():
            shown = f"{str(name)[:80]} is {getattr(value, 'dtype', type(value).__name__)}"
            raise UserError(
                f"{path} is damaged: its weights must map names to dense tensors of real numbers, "
                f"but {shown}"
            )
    # The factor 2 allows for tensors that have two names but are stored only once.
    size = sum(value.numel() * value.element_size() for value in weights.values())
    if size > 2 * path.stat().st_size:
        raise UserError(f"{path} is damaged: its weights are declared to be larger than the file")


def write_model_file(
    out: str | Path,
    state: Mapping[str, Tensor],
    *,
    config: Mapping[str, Any],
    facts: Mapping[str, Any],
    origin: Any,
) -> Path:
    """Writes a model file atomically and returns its path.

    `out` is the .safetensors file, or a folder in which `FILE` is created.
    """
    from safetensors.torch import save

    path = Path(out) if Path(out).suffix == ".safetensors" else Path(out) / FILE
    tensors = {name: value.detach().cpu().clone().contiguous() for name, value in state.items()}
    text = json.dumps({"format": FORMAT, "config": config, "facts": facts, "origin": origin})
    metadata = {"format": "pt", KEY: text, "sha256": content_sha256(text, tensors)}
    with atomic_write(path) as temporary:
        temporary.write_bytes(save(tensors, metadata))
    return path


def content_sha256(text: str, state: Mapping[str, Tensor]) -> str:
    """Returns a hash of the metadata `text` and the weights of a model file."""
    return hashlib.sha256(f"{text}\n{state_sha256(state)}".encode()).hexdigest()


def state_sha256(state: Mapping[str, Tensor]) -> str:
    """Returns a hash of the names, types, shapes and values of tensors, sorted by name."""
    import torch

    digest = hashlib.sha256()
    for name in sorted(state):
        digest.update(f"{name} {state[name].dtype} {tuple(state[name].shape)}".encode())
        digest.update(state[name].detach().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Reads a checkpoint or model file without running code. Raises `UserError` if it is damaged."""
    if path.suffix == ".safetensors":
        return read_model_file(path)
    checkpoint = checked(path, read_torch(path))
    check_format(path, checkpoint.get(FORMAT_KEY))
    return checkpoint


def weights_sha256(path: Path) -> str:
    """Returns the SHA-256 of a file's weights, which is the same for a checkpoint and its model file."""
    return state_sha256(read_checkpoint(path)["state_dict"])


def without_own_paths(config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a recipe in which default paths replace this machine's data and run paths."""
    defaults = {
        config.get("data_root"): "data",
        config.get("run", {}).get("dir"): f"runs/{config['experiment']}/default",
    }
    moves = {
        folder: other for folder, other in defaults.items() if folder and Path(folder).is_absolute()
    }
    return moved(dict(config), moves)
