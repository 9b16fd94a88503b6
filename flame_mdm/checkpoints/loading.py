"""Loading of models: finds the file, builds the parts, loads the weights."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args

import torch
from hydra.utils import get_class
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from flame_mdm.checkpoints.model_files import FILE, read_checkpoint
from flame_mdm.config import Config, flatten, instantiate, trust
from flame_mdm.errors import UserError, did_you_mean, first_line
from flame_mdm.safe_io import regular_file
from flame_mdm.sampler_options import MAX_STEPS
from flame_mdm.task import MotionGeneration, Task

Which = Literal["last", "best"]

SHIPPED = {path.stem: path for path in sorted((Path(__file__).parents[1] / "models").glob("*.safetensors"))}
"""Models in this package, by name; `docs/checkpoints.md` says how they were trained."""

NO_GPU = "PyTorch finds no GPU" if torch.version.cuda or torch.version.hip else "this PyTorch was built without CUDA"
"""Why no GPU can be used, if PyTorch has none."""


def find(source: str | Path, which: Which = "last") -> Path:
    """Returns the file of a model.

    Args:
        source: a file; a run directory; a folder with one .safetensors file; the name of a model in this package, such
            as "quickstart"; or "user/name[@revision]" on the Hugging Face hub. An existing path comes first.
        which: for a run directory, the last checkpoint or the one with the best validation result.

    Raises:
        FileNotFoundError: If the file does not exist, or the run has no such checkpoint.
        UserError: If the folder does not hold exactly one model file, or the model cannot be downloaded from the hub.
    """
    if which not in get_args(Which):
        raise UserError(f"which={which}: write last or best")
    path = Path(source)
    if path.exists() and not path.is_dir():
        regular_file(path)
        return path
    weights = [file for file in sorted(path.glob("*.safetensors")) if not file.name.startswith(".")]  # not half-written
    is_run = (path / "config.yaml").is_file() and not weights
    if is_run or (path / "checkpoints").is_dir():
        file = path / "checkpoints" / f"{which}.ckpt"
        if not file.exists():
            there = ", ".join(sorted(found.name for found in file.parent.glob("*.ckpt"))) or "none yet"
            raise FileNotFoundError(f"{file}: no such checkpoint. The run has {there}")
        return file
    if path.is_dir():
        if len(weights) != 1:
            there = ", ".join(file.name for file in weights) or "no .safetensors file"
            runs = ", ".join(str(found.parent) for found in sorted(path.glob("*/checkpoints"))[:3])
            raise UserError(
                f"{path}: this folder holds {there}. Name {f'a run: {runs}' if runs else 'the file of the model'}"
            )
        regular_file(weights[0])
        return weights[0]
    if str(source) in SHIPPED:
        return SHIPPED[str(source)]
    match = re.fullmatch(r"([\w.-]+/[\w.-]+)(?:@([\w./-]+))?", str(source))
    if match is None or path.suffix in (".ckpt", ".safetensors", ".pt") or path.parent.is_dir():
        there = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
        near = did_you_mean(path.name, [*there, *SHIPPED])
        advice = near or " Give a run, or a .ckpt or .safetensors file"
        raise FileNotFoundError(f"{path}: no such checkpoint.{advice}")
    from huggingface_hub import hf_hub_download, logging

    logging.set_verbosity_error()  # otherwise it reports every attempt to reach the hub
    try:
        return Path(hf_hub_download(match[1], FILE, revision=match[2]))
    except Exception as error:  # the client raises many kinds: no network, no such repository, no permission ...
        raise UserError(
            f"{source}: no such file or folder, and {FILE} of a model with this name cannot be downloaded from the "
            f"hub: {first_line(error)}"
        ) from error


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
