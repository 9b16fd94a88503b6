"""Atomic checkpoints, and resuming from them after validation.

A run directory may come from somebody else, and Lightning restores the state of loops, callbacks and optimizers without
checking it. So `newest` and `check_training_state` check what a checkpoint says before Lightning reads it.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from lightning import Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from packaging.version import Version
from torch import Tensor

from flame_mdm.checkpoints.model_files import FORMAT, FORMAT_KEY, check_weights, read_checkpoint
from flame_mdm.config import instantiate
from flame_mdm.errors import UserError, say
from flame_mdm.safe_io import write_failure
from flame_mdm.task import Task
from flame_mdm.training.averaging import MovingAverage

LAST, PREVIOUS = "last.ckpt", "previous.ckpt"
OLDEST_LIGHTNING = Version("2.6")  # Lightning migrates checkpoints of older versions, by code that trusts them
LARGEST = 2**53  # numbers of steps and learning rates are smaller


class Resumed(NamedTuple):
    """The checkpoint from which a run resumes."""

    path: Path
    step: int
    content: dict[str, Any]


class AtomicCheckpoints(TorchCheckpointIO):
    """Writes checkpoints atomically: to a temporary file, synced and then renamed; removes files in `folder` alone.

    The former `last.ckpt` is kept as `previous.ckpt`. The checkpoint `resumed` is not read again.
    """

    def __init__(self, folder: Path, resumed: Resumed | None = None):
        super().__init__()
        self.folder, self.resumed = folder, resumed

    def load_checkpoint(self, path: Any, *args: Any, **options: Any) -> dict[str, Any]:
        """Returns the content of the checkpoint that the run resumes from, as `check_training_state` checked it."""
        resumed, self.resumed = self.resumed, None  # it needs as much memory as the model and its optimizer
        if resumed is None or resumed.path != Path(path):
            raise UserError(f"{path}: only {resumed.path if resumed else 'a checked checkpoint'} can be resumed")
        return resumed.content

    def remove_checkpoint(self, path: Any) -> None:
        if directly_in(self.folder, path) and Path(path).is_file():
            Path(path).unlink()

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Writes a checkpoint; raises `UserError` if that fails, as on a full disk. Earlier ones stay."""
        path = Path(path)
        partial = path.with_suffix(".partial")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                torch.save(checkpoint | {FORMAT_KEY: FORMAT}, file)
                file.flush()
                os.fsync(file.fileno())
            if path.name == LAST and path.exists():
                path.replace(path.with_name(PREVIOUS))
            partial.replace(path)
        except (OSError, RuntimeError) as error:  # torch reports a failed write as either
            partial.unlink(missing_ok=True)
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
        except UserError as error:
            if path == paths[-1]:
                raise UserError(f"{error}. There is no other checkpoint. Delete {folder} to start over") from error
            say(f"{error}; resuming from the previous checkpoint")
        else:
            if path.name != LAST:
                say(f"{path}: resuming from step {step}")
            return Resumed(path, step, content)
    return None


def check_training_state(resumed: Resumed, task: Task, trainer: Trainer) -> None:
    """Raises `UserError` unless a checkpoint holds the state of training `task` with `trainer`, before `Trainer.fit`.

    The state of a `ModelCheckpoint` is dropped if it is damaged or names a path that is not directly in the folder of
    the checkpoints: the run directory was moved, or the path is an attack on other files.
    """
    content, path = resumed.content, resumed.path
    if fault := next(_faults(content, path, task, trainer), None):
        raise UserError(
            f"{path}: damaged: {fault} is missing or does not fit the recipe. Delete this file to resume from another "
            "checkpoint"
        )
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        key = callback.state_key
        if isinstance(callback, ModelCheckpoint) and not _is_of_folder(content["callbacks"].get(key), path.parent):
            content["callbacks"].pop(key, None)


def _is_of_folder(state: Any, folder: Path) -> bool:
    """Returns whether the state of a `ModelCheckpoint` is complete and only names files directly in a folder."""
    names = ("best_model_path", "last_model_path", "kth_best_model_path")
    scores = ("best_model_score", "current_score", "kth_value")
    if not isinstance(state, dict) or not {*names, *scores} <= state.keys():
        return False
    models = state.get("best_k_models")
    if not isinstance(models, dict) or (models and state["kth_best_model_path"] not in models):
        return False
    paths = [*(state[name] for name in names if state[name] != ""), *models]
    values = [*(state[name] for name in scores if state[name] is not None), *models.values()]
    return all(isinstance(path, str) and directly_in(folder, path) for path in paths) and all(
        isinstance(value, Tensor) and value.ndim == 0 for value in values
    )


def directly_in(folder: Path, path: str | Path) -> bool:
    """Returns whether a path names an entry of a folder itself, after links and `..` are resolved."""
    if "\0" in str(path) or Path(path).name in ("", ".."):
        return False
    return Path(path).parent.resolve() == folder.resolve()


def _faults(content: dict[str, Any], path: Path, task: Task, trainer: Trainer) -> Iterator[str]:
    """Yields the parts of a checkpoint that Lightning cannot restore; later checks rely on earlier ones."""
    try:
        supported = Version(content["pytorch-lightning_version"]) >= OLDEST_LIGHTNING
    except (KeyError, TypeError, ValueError):
        supported = False
    if not supported:
        yield "pytorch-lightning_version"
    task.trainer = trainer
    made: Any = task.configure_optimizers()
    optimizer = made["optimizer"] if isinstance(made, dict) else made
    groups = optimizer.state_dict()["param_groups"]
    precision, states = trainer.precision_plugin, content.get("callbacks")
    loops = ("fit_loop", "validate_loop", "test_loop", "predict_loop")
    expected = {
        "state_dict": task.state_dict(),
        "loops": {name: getattr(trainer, name).state_dict() for name in loops},
        "callbacks": states if isinstance(states, dict) else {},
        "optimizer_states": [{"state": _optimizer_state(content, task), "param_groups": groups}],
        "lr_schedulers": [made["lr_scheduler"]["scheduler"].state_dict()] if isinstance(made, dict) else [],
    }
    if task.config.get("ema"):
        expected |= {"current_model_state": expected["state_dict"], "averaging_state": {"n_averaged": torch.tensor(0)}}
    if scaler := precision.state_dict():
        expected[type(precision).__qualname__] = scaler
    yield from _differences(expected, {name: content.get(name) for name in expected}, "")
    for name in expected.keys() & {"state_dict", "current_model_state"}:
        try:
            check_weights(content[name], path)
        except UserError:
            yield name
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, MovingAverage) and callback.state_key in content["callbacks"]:
            yield from _differences(callback.state_dict(), content["callbacks"][callback.state_key], "callbacks.ema")
    rates = {"lr": 0.0, "initial_lr": 0.0}
    if [g | rates for g in content["optimizer_states"][0]["param_groups"]] != [g | rates for g in groups]:
        yield "optimizer_states.param_groups"


def _optimizer_state(content: dict[str, Any], task: Task) -> dict[int, Any]:
    """Returns the state of the recipe's optimizer after a step, of the parameters of which `content` holds one."""
    try:
        saved = content["optimizer_states"][0]["state"].keys()
    except (KeyError, TypeError, IndexError, AttributeError):
        return {}
    weight = torch.zeros(2, requires_grad=True)
    trial = instantiate(task.optimizer, params=[weight])
    weight.sum().backward()
    trial.step()
    template = trial.state_dict()["state"].get(0, {})
    return {
        number: {name: parameter if getattr(value, "ndim", 0) else value for name, value in template.items()}
        for number, parameter in enumerate(p for p in task.parameters() if p.requires_grad)
        if number in saved
    }


def _differences(expected: Any, actual: Any, where: str) -> Iterator[str]:
    """Yields the keys whose values have other types or shapes than those in `expected`, which is trusted."""
    if isinstance(expected, dict) and isinstance(actual, dict) and actual.keys() == expected.keys():
        for name, value in expected.items():
            if not str(name).endswith("_extra_state"):  # of any shape
                yield from _differences(value, actual[name], f"{where}.{name}".strip("."))
    elif isinstance(expected, list | tuple) and isinstance(actual, list | tuple) and len(actual) == len(expected):
        for number, value in enumerate(expected):
            yield from _differences(value, actual[number], f"{where}.{number}")
    elif isinstance(expected, Tensor) and isinstance(actual, Tensor):
        if (actual.shape, actual.is_floating_point()) != (expected.shape, expected.is_floating_point()):
            yield where
    elif type(expected) in (int, float) and type(actual) in (int, float):
        assert isinstance(actual, int | float)
        if not abs(actual) < LARGEST or (isinstance(expected, int) and (type(actual) is float or actual < 0)):
            yield where
    elif type(actual) is not type(expected) or isinstance(expected, dict | list | tuple):
        yield where
