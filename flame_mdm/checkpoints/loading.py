# pyright: standard
"""Model loading: builds the parts of a model and loads their weights."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from hydra.utils import get_class
from torch.overrides import TorchFunctionMode

from flame_mdm.checkpoints.adapters import Paths, read_merged
from flame_mdm.checkpoints.locating import Which, find
from flame_mdm.config import Config, instantiate, trust
from flame_mdm.config.signatures import walk
from flame_mdm.errors import UserError
from flame_mdm.generator import DistilledGenerator, MotionGenerator
from flame_mdm.safe_io import regular_file, sha256

if TYPE_CHECKING:
    from flame_mdm.task import Task

# Parts of a recipe from which a model is built
PARTS = (
    "task",
    "representation",
    "process",
    "condition",
    "denoiser",
)
GENERATORS = {
    "flame_mdm.task.GeneratorTask": MotionGenerator,
    "flame_mdm.training.adaptation.AdaptationTask": MotionGenerator,
    "flame_mdm.training.distillation.DistillationTask": DistilledGenerator,
}
"""Task classes in recipes, and the generators that they train. Generators are loaded without Lightning."""
Trained = TypeVar("Trained", bound="Task | MotionGenerator")
NO_GPU = (
    "PyTorch finds no GPU"
    if torch.version.cuda or torch.version.hip
    else "this PyTorch was built without CUDA"
)
"""Explains, on machines without a usable GPU, why PyTorch cannot use one."""


def load(
    source: str | Path,
    device: str | torch.device = "cpu",
    *,
    which: Which = "last",
    adapter: Paths = (),
    strength: float | Sequence[float] = 1.0,
) -> MotionGenerator:
    """Loads a trained model for sampling.

    The model is in evaluation mode, with averaged weights if its recipe averages weights. Neither
    a data set nor training code is needed.

    Args:
        source: a run directory; a .ckpt or .safetensors file; a folder with one .safetensors file; the name of a model
            in this package, such as "quickstart"; or "user/name[@revision]" on the Hugging Face hub. An existing path
            takes precedence.
        device: device of the weights, such as "cuda".
        which: the checkpoint in a run directory, "last" or "best". For files, this argument has no
            effect.
        adapter: one or several files that `flame_mdm.adapt` wrote for this model. Default: no
            adapter.
        strength: strength of all adapters, or one number per adapter. 0 = the model without the
            adapter; 1 = the adapted model.

    Returns:
        The model, to be passed to `flame_mdm.generate`, `edit` or `stream`.

    Raises:
        FileNotFoundError: If there is no such file or checkpoint.
        UserError: If the file is damaged or contains no motion generator, if its weights do not
            match its recipe, if the model cannot be downloaded, if an adapter belongs to a
            different model, or if the device does not exist.

    Example:
        >>> import flame_mdm
        >>> model = flame_mdm.load("quickstart")
        >>> model.describe(), model.conditioned_on
        ('MDMEncoder', 'text')
    """
    return load_task(
        find(source, which), MotionGenerator, device, adapter=adapter, strength=strength
    )


def load_task(
    path: Path, kind: type[Trained], device: str | torch.device = "cpu", **adapted: Any
) -> Trained:
    """Loads the task from a .ckpt or .safetensors file and puts it in evaluation mode.

    The model has averaged weights if its recipe averages weights.

    Args:
        path: the file.
        kind: the expected class of the task.
        device: device of the weights.
        adapted: the keyword arguments `adapter` and `strength` of `load`.

    Raises:
        UserError: If the file is damaged or contains a different kind of task, if its weights do
            not match its recipe, or if the device does not exist.
    """
    check_device(device)
    regular_file(path)
    digest = sha256(path)
    checkpoint = read_merged(path, **adapted)
    try:
        model = _build(checkpoint, kind).eval().to(device)
    except Exception as error:  # an invalid recipe may fail anywhere
        # The missing file belongs to a text encoder.
        if isinstance(error, FileNotFoundError):
            raise
        kind_of_error = (
            ""
            if isinstance(error, UserError)
            else f"cannot build the model: {type(error).__name__}: "
        )
        raise UserError(f"{path}: {kind_of_error}{error}") from error
    model.sha256 = digest
    return model


def check_device(device: str | torch.device) -> None:
    """Raises `UserError` if this machine does not have the device."""
    try:
        if torch.device(device).type == "meta":
            raise RuntimeError("the device meta computes nothing")
        torch.empty(0, device=device)
    # torch raises either error for a missing device
    except (RuntimeError, AssertionError) as error:
        gpus = [f"cuda:{number}" for number in range(torch.cuda.device_count())]
        names = ", ".join(["cpu", *gpus]) + f" ({NO_GPU})" * (not gpus)
        raise UserError(
            f"device={device}: this machine only has {names}. Omit device=, or choose one of "
            f"these devices"
        ) from error


def _build(checkpoint: dict[str, Any], kind: type[Trained]) -> Trained:
    """Builds the model of a checkpoint and loads its weights.

    This project's networks are built on the meta device, so that a recipe cannot allocate more
    memory than the weights in the file need. Other classes, which the user must trust, are built as
    in training.
    """
    config, state = checkpoint["config"], checkpoint["state_dict"]
    parts: Config = {name: config[name] for name in PARTS if name in config}
    trust(parts)
    classes: dict[str, Any] = dict(GENERATORS) if kind is MotionGenerator else {}
    targets = [str(node["_target_"]) for _, node in walk(parts) if "_target_" in node]
    # Modules are imported first, because tensors that they create must not be on the meta device.
    classes |= {target: get_class(target) for target in targets if target not in classes}
    model_class = classes[config["task"]["_target_"]]
    if kind is MotionGenerator:  # the user's own class
        model_class = getattr(model_class, "kind", model_class)
    if not issubclass(model_class, kind):
        noun = getattr(model_class, "noun", model_class.__name__)
        raise UserError(f"contains {noun}, not {kind.noun}. Use another checkpoint")
    is_builtin = all(target.startswith(("flame_mdm.", "evaluators.")) for target in targets)
    with ExitStack() as stack:
        if is_builtin:
            stack.enter_context(torch.device("meta"))
            stack.enter_context(_CallLimit(20_000 + 50 * len(state)))
        representation = instantiate(config["representation"])
        facts = checkpoint["facts"]
        model = model_class.build(config, representation, actions=facts["actions"], facts=facts)
    kinds = {name: value.dtype for name, value in model.state_dict().items()}
    state = {name: value.to(kinds.get(name, value.dtype)) for name, value in state.items()}
    try:
        model.load_state_dict(state, strict=True, assign=is_builtin)
    except RuntimeError as error:
        reason = str(error).splitlines()[1].strip()
        raise UserError(f"the weights do not match the recipe saved with them: {reason}") from error
    model.steps = checkpoint.get("global_step", (checkpoint.get("origin") or {}).get("steps"))
    return model


class _CallLimit(TorchFunctionMode):
    """Limits the number of torch calls, so that a recipe with a million layers fails early."""

    def __init__(self, limit: int):
        super().__init__()
        self.left = limit

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.left -= 1
        if self.left < 0:
            raise UserError("the recipe saved with these weights describes a larger model")
        # On the meta device, random draws would import torch's compiler, which takes longer than
        # building the model.
        if func is torch.nn.init.normal_:
            return kwargs["tensor"] if kwargs else args[0]
        func = torch.empty if func is torch.randn else func
        return func(*args, **(kwargs or {}))
