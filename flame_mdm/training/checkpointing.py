"""Atomic checkpoints, and resuming from them.

A run directory may come from somebody else. Reading a checkpoint runs no code and takes no more memory than the file,
and only files in the folder of the checkpoints are removed, even if the state of a callback names others.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from packaging.version import Version
from torch import Tensor

from flame_mdm.checkpoints.model_files import FORMAT, FORMAT_KEY, check_weights, read_checkpoint
from flame_mdm.errors import UserError, say
from flame_mdm.safe_io import write_failure
from flame_mdm.safe_io.paths import check_within, temporary_beside

LAST, PREVIOUS = "last.ckpt", "previous.ckpt"
OLDEST_LIGHTNING = Version("2.6")  # Lightning migrates checkpoints of older versions, by code that trusts them


class Resumed(NamedTuple):
    """The checkpoint from which a run resumes."""

    path: Path
    step: int
    content: dict[str, Any]


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes checkpoints to a temporary file, synced and then renamed; keeps the former last one as `previous.ckpt`."""

    def __init__(self, folder: Path, resumed: Resumed | None = None):
        super().__init__()
        self.folder, self.resumed = folder, resumed

    def load_checkpoint(self, path: Any, *args: Any, **options: Any) -> dict[str, Any]:
        """Returns the content of the checkpoint that the run resumes from, as `newest` checked it."""
        resumed, self.resumed = self.resumed, None  # it needs as much memory as the model and its optimizer
        assert resumed is not None
        return resumed.content

    def remove_checkpoint(self, path: Any) -> None:
        path = Path(path)
        if path.is_file() and path.parent.resolve() == self.folder.resolve():  # after links and `..` are resolved
            path.unlink()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Writes a checkpoint; raises `UserError` if that fails, as on a full disk. Earlier ones stay."""
        path = Path(path)
        check_within(path.parent, self.folder.parent)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with temporary_beside(path) as temporary:
                with temporary.open("xb") as file:
                    torch.save(checkpoint | {FORMAT_KEY: FORMAT}, file)
                    file.flush()
                    os.fsync(file.fileno())
                if path.name == LAST and path.exists():
                    path.replace(path.with_name(PREVIOUS))
                temporary.replace(path)
        except (OSError, RuntimeError) as error:  # torch reports a failed write as either
            reason = write_failure(error if isinstance(error, OSError) else error.__context__ or error, path)
            raise UserError(
                f"{path}: the checkpoint of step {checkpoint['global_step']} cannot be written ({reason}). Earlier "
                "checkpoints are intact: free some space, and run the same command to resume"
            ) from error


def newest(folder: Path) -> Resumed | None:
    """Returns the checkpoint to resume from: the last one, or the previous one if the last is damaged."""
    paths = [folder / name for name in (LAST, PREVIOUS) if (folder / name).exists()]
    for path in paths:
        try:
            content = read_checkpoint(path)
            step = content.get("global_step")
            if type(step) is not int or step < 0:
                raise UserError(f"{path}: damaged: its global_step is {str(step)[:40]}, not a number of steps")
            check_weights(dict(_tensors(content, "")), path)
            _check_version(content.get("pytorch-lightning_version"), path)
        except UserError as error:
            if path == paths[-1]:
                raise UserError(f"{error}. There is no other checkpoint. Delete {folder} to start over") from error
            say(f"{error}; resuming from the previous checkpoint")
        else:
            if path.name != LAST:
                say(f"{path}: resuming from step {step}")
            return Resumed(path, step, content)
    return None


def _check_version(version: Any, path: Path) -> None:
    try:
        supported = Version(str(version)) >= OLDEST_LIGHTNING
    except ValueError:
        supported = False
    if not supported:
        raise UserError(f"{path}: written by version {str(version)[:40]} of Lightning, not {OLDEST_LIGHTNING} or later")


def _tensors(content: Any, name: str) -> Iterator[tuple[str, Tensor]]:
    """Yields all tensors in nested mappings and lists, by the keys that lead to them."""
    if isinstance(content, Tensor):
        yield name, content
    elif isinstance(content, dict | list | tuple):
        for key, value in content.items() if isinstance(content, dict) else enumerate(content):
            yield from _tensors(value, f"{name}.{key}")
