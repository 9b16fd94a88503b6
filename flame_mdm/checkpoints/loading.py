"""Loading of models: builds the parts, loads the weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import torch
from hydra.utils import get_class
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from flame_mdm.checkpoints.locating import Which, find
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import Config, flatten, instantiate, trust
from flame_mdm.errors import UserError
from flame_mdm.sampler_options import MAX_STEPS
from flame_mdm.task import MotionGeneration, Task

NO_GPU = "PyTorch finds no GPU" if torch.version.cuda or torch.version.hip else "this PyTorch was built without CUDA"
"""Why no GPU can be used, if PyTorch has none."""


def load(source: str | Path, device: str | torch.device = "cpu", *, which: Which = "last") -> MotionGeneration:
    """Loads a trained model for sampling; arguments as for `find`, errors as for `find` and `load_task`."""
    return load_task(find(source, which), MotionGeneration, device)


Trained = TypeVar("Trained", bound=Task)

PARTS = ("task", "representation", "process", "condition", "denoiser")
"""Parts of a recipe from which a model is built."""


def load_task(path: Path, kind: type[Trained], device: str | torch.device = "cpu") -> Trained:
    """Loads the task of a checkpoint in evaluation mode, with averaged weights if its recipe averages them.

    Args:
        path: a .ckpt or .safetensors file.
        kind: expected class of the task.
        device: device of the task.

    Raises:
        FileNotFoundError: If the file does not exist.
        UserError: If it is not a checkpoint of this framework, holds another kind of task, is damaged, or its weights
            do not match its recipe.
    """
    check_device(device)
    checkpoint = read_checkpoint(path)
    try:
        return _build(path, checkpoint, kind).eval().to(device)
    except (UserError, FileNotFoundError):
        raise
    except Exception as error:  # a nonsensical recipe may fail anywhere
        raise UserError(f"{path}: cannot build the model: {type(error).__name__}: {error}") from error


def check_device(device: str | torch.device) -> None:
    """Raises `UserError` if this machine has no such device."""
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError) as error:  # torch reports an absent device as either
        gpus = [f"cuda:{number}" for number in range(torch.cuda.device_count())]
        there = ", ".join(["cpu", *gpus]) + f" ({NO_GPU})" * (not gpus)
        raise UserError(f"device={device}: this machine has only {there}. Drop device=, or change it") from error


def _build(path: str | Path, checkpoint: dict[str, Any], kind: type[Trained]) -> Trained:
    config, facts = checkpoint["config"], checkpoint["facts"]
    parts = {name: config[name] for name in PARTS if name in config}
    trust(parts)
    for name in ("task", "representation", *parts):
        if "_target_" not in (config[name] if isinstance(config.get(name), dict) else {}):
            raise UserError(f"{path}: damaged: its recipe has no {name}")
    built = get_class(config["task"]["_target_"])
    if not issubclass(built, kind):
        found = built.noun if issubclass(built, Task) else built.__name__
        raise UserError(f"{path}: holds {found}, not {kind.noun}. Give another checkpoint")
    with _Sizes(path, checkpoint["state_dict"], parts):
        representation = instantiate(config["representation"])
        task = built.build(config, representation, actions=facts["actions"])
    task.facts = facts
    task.steps = checkpoint.get("global_step", (checkpoint.get("origin") or {}).get("steps"))
    try:
        task.load_state_dict(checkpoint["state_dict"], strict=True)
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise UserError(f"{path}: the weights do not match the recipe saved with them: {lines[1]}") from error
    return task


class _Sizes(TorchDispatchMode):
    """While a model is built, refuses tensors that are too large for the weights in its file, before allocating them.

    Args:
        path: the file, for messages.
        weights: the state dict in it.
        parts: the recipe of the model, whose integers are checked immediately.

    Raises:
        UserError: If an integer of the recipe exceeds all reasonable sizes.
    """

    def __init__(self, path: str | Path, weights: dict[str, Tensor], parts: Config):
        super().__init__()
        largest = max((size for value in weights.values() if value.numel() for size in value.shape), default=0)
        for name, value in flatten(parts).items():
            for number in value if isinstance(value, list | tuple) else [value]:
                if isinstance(number, int) and abs(number) > max(MAX_STEPS, largest):
                    raise UserError(f"{path}: {name}={number} in its recipe exceeds the size of any model")
        self.path, self.numbers = path, 4 * sum(value.numel() for value in weights.values()) + 10_000_000
        self.tensors = 4 * len(weights) + 2_000

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if not any(isinstance(value, Tensor) for value in tree_leaves((args, kwargs))):
            self.numbers -= sum(v.numel() for v in tree_leaves(func(*args, **kwargs | {"device": "meta"})))
            self.tensors -= 1
            if self.numbers < 0 or self.tensors < 0:
                raise UserError(f"{self.path}: its recipe describes a larger model than the weights saved with it")
        return func(*args, **kwargs)
