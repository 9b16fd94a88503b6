"""Reading of the files in which authors released the weights of their evaluation networks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

from torch import Tensor, nn

from flame_mdm.files import read_torch

Network = TypeVar("Network", bound=nn.Module)


def read_weights(path: str | Path, key: str | None = None) -> dict[str, Tensor]:
    """A state dict out of a released file, of which no code is run.

    Args:
        path: the file.
        key: where in the file the state dict stands; None = the file is the state dict.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it is damaged, holds more than plain values and tensors, or lacks `key`.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file; give the path of the weights that the authors released")
    try:
        content = read_torch(path)
    except ValueError as error:
        raise ValueError(
            f"{path}: damaged, or it holds objects beside plain weights, which are not read: download it again, or "
            "save its state dict alone"
        ) from error
    state = content.get(key) if key is not None and isinstance(content, Mapping) else content
    if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
        found = ", ".join(sorted(map(str, content))[:8]) if isinstance(content, Mapping) else type(content).__name__
        raise ValueError(f"{path}: no weights {f'under {key!r} ' if key else ''}in it, but {found}")
    return dict(state)


def load_strictly(network: Network, state: Mapping[str, Tensor], source: str | Path) -> Network:
    """The network with these weights, all of them, in evaluation mode.

    Raises:
        ValueError: a weight is missing, unknown or of another shape; the message names `source`.
    """
    try:
        network.load_state_dict(state, strict=True)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise ValueError(f"{source}: not the weights of {type(network).__name__}: {lines[1]}") from error
    return network.eval()
