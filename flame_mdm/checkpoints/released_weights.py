"""Reads, renames and loads weights released by the authors of papers."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor, nn

from flame_mdm.checkpoints.torch_files import check_keys, check_torch
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_package_yaml

Network = TypeVar("Network", bound=nn.Module)

NAMES: dict[str, Any] = read_package_yaml(Path(__file__).with_name("released.yaml"))
"""Mappings from the authors' names to the project's names."""
ENCODER_LAYER, DECODER_LAYER = NAMES["encoder_layer"], NAMES["decoder_layer"]


def read_released(
    path: Path, *, run_code: bool = False, advice: str = "Save only its state dict"
) -> Mapping[str, Any]:
    """Reads a released file.

    With `run_code`, the file may also contain pickled objects of classes other than torch's.
    Reading such objects runs any code in them. Raises `UserError` if the file is damaged or,
    without `run_code`, if it contains such objects. The error message about these objects ends with
    `advice`.
    """
    try:
        check_torch(path)
        if not run_code:
            check_keys(path)
        content = torch.load(path, map_location="cpu", weights_only=not run_code)
    except (FileNotFoundError, UserError):
        raise
    except ImportError as error:
        raise UserError(
            f"{path}: {error}. The file contains objects from this package, so install it first"
        ) from error
    except Exception as error:  # torch raises many kinds of errors for damaged files
        unsafe = re.search(r"Unsupported global: GLOBAL (\S+)", str(error))
        if unsafe is None:
            raise UserError(
                f"{path} is damaged, or is not a PyTorch file. Download it again"
            ) from error
        raise UserError(
            f"{path}: contains Python objects ({unsafe[1]}) in addition to the weights, and "
            f"reading them can run any code. {advice}"
        ) from error
    if not isinstance(content, Mapping):
        raise UserError(
            f"{path}: contains a {type(content).__name__}, not the weights of a released model"
        )
    return content


def read_weights(path: Path, key: str | None = None) -> dict[str, Tensor]:
    """Returns the state dict that a released file contains, at the top level or under `key`.

    Raises `UserError` if there is no state dict.
    """
    content = read_released(path)
    state = content if key is None else content.get(key)
    if not isinstance(state, Mapping) or not all(
        isinstance(value, Tensor) for value in state.values()
    ):
        raise UserError(
            f"{path}: contains no weights{f' under {key!r}' if key else ''}, only {_listed(content)}"
        )
    return dict(state)


def released_state(checkpoint: Mapping[str, Any], *, ema: bool = True) -> dict[str, Tensor]:
    """Extracts the network's state dict from the contents of a released file.

    The content is a flat state dict (MDM, MFM), {"model", "model_avg"} (MDM trained with
    `--use_ema`) or FLAME's Lightning checkpoint with "state_dict". If `ema` is True and the file
    contains averaged weights, these are extracted, as in the authors' evaluation.
    """
    prefixes = ("ema_model.model.", "net.") if ema else ("net.",)
    if "model_avg" in checkpoint:
        state, prefixes = checkpoint.get("model_avg" if ema else "model"), ()
    else:
        state = checkpoint.get("state_dict", checkpoint)
    if not isinstance(state, Mapping) or not all(isinstance(key, str) for key in state):
        state = {}
    inner = [{k.removeprefix(p): v for k, v in state.items() if k.startswith(p)} for p in prefixes]
    state = next(filter(None, inner), state)
    if not state or not all(isinstance(value, Tensor) for value in state.values()):
        expected = "expected a state dict, 'model' and 'model_avg', or 'state_dict'"
        raise ValueError(
            f"not a released checkpoint: {expected}, but it has {_listed(checkpoint) or 'nothing'}"
        )
    return dict(state)


def layer_names(
    state: Mapping[str, Tensor], stack: str, layer: Mapping[str, str]
) -> tuple[dict[str, str], int]:
    """Returns a mapping from torch's to this project's layer prefixes, and the number of layers."""
    count = sum(
        key.startswith(f"{stack}.layers.") and key.endswith(".norm1.weight") for key in state
    )
    prefixes = ((f"{stack}.layers.{i}.", f"transformer.layers.{i}.") for i in range(count))
    return {theirs + a: ours + b for theirs, ours in prefixes for a, b in layer.items()}, count


def renamed(state: Mapping[str, Tensor], prefixes: Mapping[str, str]) -> dict[str, Tensor]:
    """Replaces the prefix of every name. Raises `ValueError` if a name has no known prefix."""
    result, unknown = {}, []
    for key, value in state.items():
        theirs = next((prefix for prefix in prefixes if key.startswith(prefix)), None)
        if theirs is None:
            unknown.append(key)
        else:
            result[prefixes[theirs] + key.removeprefix(theirs)] = value
    if unknown:
        raise ValueError(
            "released weights: not a network of this kind, because it has unknown keys "
            f"{_listed(unknown)}"
        )
    return result


def shape_of(state: Mapping[str, Tensor], key: str, ndim: int = 2) -> torch.Size:
    """Returns the shape of a weight.

    Raises `ValueError` if the weight is missing, or if its number of dimensions is not `ndim`.
    """
    if key not in state:
        raise ValueError(
            f"released weights: {key} is missing, so the network is of another kind or the file is "
            "damaged"
        )
    if state[key].ndim != ndim:
        raise ValueError(
            f"released weights: {key} has shape {tuple(state[key].shape)}; expected {ndim} "
            "dimensions"
        )
    return state[key].shape


def load_strictly(
    network: Network, state: Mapping[str, Tensor], source: str | Path, *, assign: bool = False
) -> Network:
    """Loads all weights into a network and returns it in evaluation mode.

    Raises `UserError` if weights are missing, unexpected or of a different shape. The error message
    begins with `source`.
    """
    try:
        network.load_state_dict(state, strict=True, assign=assign)
    except RuntimeError as error:
        reason = str(error).splitlines()[1].strip()
        raise UserError(
            f"{source}: not the weights of {type(network).__name__}: {reason}"
        ) from error
    return network.eval()


def _listed(keys: Iterable[Any]) -> str:
    names = sorted(map(str, keys))
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
