"""Writes checkpoints atomically, and resumes from them.

A run directory may come from an untrusted source. Therefore, reading a checkpoint never runs code,
and takes no more memory than the size of the file. Only files in the checkpoint folder are removed,
even if the state of a callback names other files.
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO
from packaging.version import Version
from torch import Tensor

from flame_mdm.checkpoints.model_files import FORMAT, FORMAT_KEY, check_weights, read_checkpoint
from flame_mdm.errors import UserError, first_line, say
from flame_mdm.safe_io import write_failure
from flame_mdm.safe_io.paths import check_within, temporary_beside

LAST, PREVIOUS = "last.ckpt", "previous.ckpt"
# Checkpoints from older versions of Lightning are rejected, because Lightning migrates them with
# code that trusts their content.
OLDEST_LIGHTNING = Version("2.6")

# Numbers in the state of a learning-rate schedule
SCHEDULE = {
    "base_lrs",
    "_last_lr",
    "last_epoch",
    "_step_count",
}


class Resumed(NamedTuple):
    """The checkpoint from which a run resumes."""

    path: Path
    step: int
    content: dict[str, Any]


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes each checkpoint to a temporary file, which is then synced and renamed.

    The checkpoint before the last one is kept as `previous.ckpt`.
    """

    def __init__(self, folder: Path, resumed: Resumed | None = None):
        super().__init__()
        self.folder, self.resumed = folder, resumed

    def load_checkpoint(self, path: Any, *args: Any, **options: Any) -> dict[str, Any]:
        """Returns the checkpoint from which the run resumes; `newest` has already checked it."""
        assert self.resumed is not None
        content = self.resumed.content
        # The checkpoint is released, because it takes as much memory as the model and its
        # optimizer.
        self.resumed = None
        return content

    def remove_checkpoint(self, path: Any) -> None:
        """Removes a checkpoint, but only from the folder of this run."""
        path = Path(path)
        # Paths are compared after resolving links and `..`.
        if path.is_file() and path.parent.resolve() == self.folder.resolve():
            path.unlink()

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None
    ) -> None:
        """Writes a checkpoint. Raises `UserError` if it cannot be written.

        Earlier checkpoints are kept.
        """
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
        except (OSError, RuntimeError) as error:  # torch raises either error for a failed write
            reason = write_failure(
                error if isinstance(error, OSError) else error.__context__ or error, path
            )
            raise UserError(
                f"{path}: the checkpoint of step {checkpoint['global_step']} cannot be written ({reason}). Earlier "
                "checkpoints are intact. Free some space, and run the same command again to resume"
            ) from error


def newest(folder: Path) -> Resumed | None:
    """Returns the checkpoint from which to resume.

    This is the last checkpoint or, if it is damaged, the previous one.
    """
    paths = [folder / name for name in (LAST, PREVIOUS) if (folder / name).exists()]
    for path in paths:
        try:
            content = read_checkpoint(path)
            step = content.get("global_step")
            if type(step) is not int or step < 0:
                raise UserError(
                    f"{path} is damaged: its global_step is {str(step)[:40]}, not a number of steps"
                )
            check_weights(dict(_tensors(content, "")), path)
            _check_version(content.get("pytorch-lightning_version"), path)
        except UserError as error:
            if path == paths[-1]:
                raise UserError(
                    f"{error}. There is no other checkpoint. Delete {folder} to start over"
                ) from error
            say(f"{error}; resuming from the previous checkpoint")
        else:
            if path.name != LAST:
                say(f"{path}: resuming from step {step}")
            return Resumed(path, step, content)
    return None


def check_optimizers(resumed: Resumed, optimizer: torch.optim.Optimizer) -> None:
    """Raises `UserError` if the saved state of the optimizer and its schedule does not match the recipe.

    PyTorch accepts any values and would fail only in the first training step.
    """
    try:
        misfits = list(_misfits(resumed.content, optimizer))
    except (AttributeError, IndexError, KeyError, TypeError) as error:
        misfits = [f"the optimizer's state does not match the recipe: {first_line(error)}"]
    if misfits:
        reason = f"damaged: {misfits[0]}. Delete this file to resume from another checkpoint"
        raise UserError(f"{resumed.path}: {reason}")


def _misfits(content: dict[str, Any], optimizer: torch.optim.Optimizer) -> Iterator[str]:
    """Yields a message for each error in the saved state of the optimizer and its schedule."""
    usual = optimizer.param_groups[0]
    weights = [weight for group in optimizer.param_groups for weight in group["params"]]
    for state in content.get("optimizer_states") or []:
        for group in state["param_groups"]:
            for key, value in group.items():
                if key != "params" and not _is_alike(value, usual.get(key, 0.0)):
                    yield f"the optimizer's {key} is {str(value)[:40]}"
        for row, entry in state["state"].items():
            for key, value in entry.items():
                if not _is_state(value, weights[row]):
                    yield f"the optimizer's {key} of weight {row} is {str(value)[:40]}"
    for schedule in content.get("lr_schedulers") or []:
        for key in SCHEDULE & schedule.keys():
            if not all(isinstance(item, int | float) for item in _leaves(schedule[key])):
                yield f"the {key} of the learning-rate schedule is {str(schedule[key])[:40]}"


def _is_alike(value: Any, usual: Any) -> bool:
    """Returns whether a saved optimizer option has the same type as the option's usual value."""
    if isinstance(usual, bool) or usual is None:
        return value is None or isinstance(value, bool)
    if isinstance(usual, int | float):
        return (
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        )
    if isinstance(usual, tuple | list):
        is_same_length = isinstance(value, tuple | list) and len(value) == len(usual)
        return is_same_length and all(map(_is_alike, value, usual))
    return isinstance(value, type(usual))


def _is_state(value: Any, weight: Tensor) -> bool:
    """Returns whether a saved value can belong to the optimizer state of a weight.

    Such a value is a number, or a tensor that is no larger than the weight.
    """
    if isinstance(value, Tensor):
        return value.numel() <= max(1, weight.numel()) and not value.dtype.is_complex
    return isinstance(value, int | float)


def _leaves(value: Any) -> Iterator[Any]:
    """Yields the values in nested mappings and lists."""
    if isinstance(value, dict | list | tuple):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _leaves(item)
    else:
        yield value


def _check_version(version: Any, path: Path) -> None:
    try:
        supported = Version(str(version)) >= OLDEST_LIGHTNING
    except ValueError:
        supported = False
    if not supported:
        raise UserError(
            f"{path}: written by Lightning {str(version)[:40]}. Use a checkpoint from {OLDEST_LIGHTNING} or later"
        )


def _tensors(content: Any, name: str) -> Iterator[tuple[str, Tensor]]:
    """Yields all tensors in nested mappings and lists, each with the keys that lead to it."""
    if isinstance(content, Tensor):
        yield name, content
    elif isinstance(content, dict | list | tuple):
        for key, value in content.items() if isinstance(content, dict) else enumerate(content):
            yield from _tensors(value, f"{name}.{key}")
