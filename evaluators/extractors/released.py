"""Reading of released weights of evaluation networks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from torch import Tensor, nn

from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_torch

Network = TypeVar("Network", bound=nn.Module)


def read_weights(path: str | Path, key: str | None = None) -> dict[str, Tensor]:
    """Reads a state dict from a released file, without running code in it.

    Args:
        path: the file.
        key: key of the state dict in the file; None = the file is the state dict.

    Raises:
        FileNotFoundError: If the file does not exist.
        ValueError: If it is damaged, holds more than plain values and tensors, or lacks `key`.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file. Give the path of the weights released by the authors")
    try:
        content = read_torch(path)
    except UserError:
        raise
    except ValueError as error:
        raise ValueError(
            f"{path}: damaged, or it holds objects other than plain weights, which are not read. Download it again, or "
            "save only its state dict"
        ) from error
    state = content.get(key) if key is not None and isinstance(content, Mapping) else content
    if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
        found = ", ".join(sorted(map(str, content))[:8]) if isinstance(content, Mapping) else type(content).__name__
        raise ValueError(f"{path}: contains no weights{f' under {key!r}' if key else ''}, but {found}")
    return dict(state)


def load_strictly(network: Network, state: Mapping[str, Tensor], source: str | Path) -> Network:
    """Loads all weights into a network, and returns it in evaluation mode.

    Raises:
        ValueError: If a weight is missing, unknown or has another shape; the message begins with `source`.
    """
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise ValueError(f"{source}: not the weights of {type(network).__name__}: {lines[1]}") from error
    return network.eval()
