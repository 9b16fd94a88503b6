"""Instantiates configurations, checks untrusted ones, and reads and writes configuration files."""

import ast
import copy
import functools
import importlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from flame_mdm.config.signatures import Config, check, definition, parameters, walk
from flame_mdm.errors import UserError, first_line, shortened
from flame_mdm.safe_io import read_package_yaml, read_yaml, write_text

_PACKAGE = Path(__file__).parent.parent
EXPERIMENTS = (
    _PACKAGE / "experiments"
    if (_PACKAGE / "experiments").is_dir()
    else _PACKAGE.parent / "experiments"
)
"""Folder of the recipes, which is inside the installed package or, in a clone, next to it."""

MODULES = {
    "task": ("flame_mdm.task", "flame_mdm.training.adaptation", "flame_mdm.training.distillation"),
    "denoiser": ("flame_mdm.denoisers",),
    "process": ("flame_mdm.processes",),
    "condition": ("flame_mdm.conditions",),
    "representation": ("flame_mdm.representations",),
    "data": ("flame_mdm.data",),
    "optimizer": ("torch.optim",),
    "trainer": ("lightning.pytorch.trainer",),
}
"""Modules whose classes an untrusted configuration may name, by part of the configuration."""
RENAMED = {
    "flame_mdm.task.MotionGeneration": "flame_mdm.task.GeneratorTask",
    "flame_mdm.training.distillation.ConsistencyDistillation": "flame_mdm.training.distillation.DistillationTask",
}
"""Current names of classes, by their names in configurations of version 0.2."""
ADAPTED = {"flame_mdm.task.GeneratorTask": "flame_mdm.training.adaptation.AdaptationTask"}
"""Current name of the task for adapting models, by its name in version 0.2.

The configuration of this task has a key `base`.
"""
MOST_VALUES, MOST_LEVELS = 1_000_000, 50
"""Limits of a configuration file: number of values, and depth of nested mappings and lists."""
RUN_DIR = "${run.dir}"
"""Placeholder for the run directory in a saved `config.yaml`.

Thanks to the placeholder, `run.dir=...` changes all paths inside the run directory.
"""


def plain(config: Any, where: str | Path, *, but: str = "") -> None:
    """Checks that an untrusted configuration contains only plain values and no interpolations.

    Hydra and OmegaConf would resolve interpolations (`${...}`), which can run any code and read any
    environment variable. Only the interpolation given as `but` is allowed, and only at the start of
    a string. If the check fails, raises a `UserError` that names the file `where`. The check also
    fails if the content is too large, is nested too deeply or contains itself.
    """
    count = 0

    def check_value(value: Any, path: tuple[str, ...]) -> None:
        nonlocal count
        count += 1
        if count > MOST_VALUES or len(path) > MOST_LEVELS:
            raise UserError(
                f"{where}: not a configuration: it has too many values or is nested too deeply"
            )
        if isinstance(value, dict | list | tuple):
            for name, child in value.items() if isinstance(value, dict) else enumerate(value):
                if not isinstance(name, str | int):
                    raise UserError(f"{where}: {'.'.join(path)} has a key that is not a string")
                check_value(child, (*path, str(name)))
                check_value(name, path)
        elif isinstance(value, str) and "${" in value.removeprefix(but):
            raise UserError(
                f"{where}: {'.'.join(path) or 'a key'} contains the interpolation "
                f"{shortened(value, 60)}. Replace it with its value: this file may only contain plain "
                f"values"
            )
        elif not isinstance(value, str | int | float | None):
            raise UserError(
                f"{where}: {'.'.join(path)} is a {type(value).__name__}, not a plain value"
            )

    check_value(config, ())


def renamed(config: Config) -> Config:
    """Replaces class names from earlier versions in a configuration with the current ones."""
    task = config.get("task")
    if not isinstance(task, Mapping):
        return config
    target = task.get("_target_")
    name = RENAMED.get(str(target), target)
    if config.get("base"):
        name = ADAPTED.get(str(name), name)
    return config if name == target else config | {"task": {**task, "_target_": name}}


def read_saved(path: Path) -> Config:
    """Reads the saved configuration of a run, in which `RUN_DIR` stands for the run directory."""
    config = read_yaml(path)
    if not isinstance(config, dict) or not isinstance(config.get("run"), dict):
        raise UserError(f"{path}: not the configuration of a run, because it has no key `run`")
    plain(config, path, but=RUN_DIR)
    return renamed(config)


def movable(config: Config) -> Config:
    """Returns a configuration in which `RUN_DIR` stands for the run directory.

    Changing `run.dir` then also changes all paths inside the run directory.
    """
    folders = {str(config["run"]["dir"]): RUN_DIR}
    return {
        name: value if name == "run" else moved(value, folders) for name, value in config.items()
    }


def moved(node: Any, folders: Mapping[str, str]) -> Any:
    """Moves the paths in a configuration to other folders; `folders` maps old to new folders."""
    if isinstance(node, dict):
        return {name: moved(value, folders) for name, value in node.items()}
    folder = next(
        (f for f in folders if isinstance(node, str) and (node == f or node.startswith(f"{f}/"))),
        None,
    )
    return node if folder is None else folders[folder] + node.removeprefix(folder)


def instantiate(node: Config, offered: Mapping[str, Any] | None = None, /, **derived: Any) -> Any:
    """Instantiates the object that a mapping with a `_target_` describes, and all nested objects.

    Supports Hydra's keys `_target_` and `_recursive_`. Interpolations are treated as plain text.
    Mappings and lists are passed as plain copies, as with Hydra's `_convert_: all`.

    Args:
        node: the mapping.
        offered: additional arguments, which are passed only if the class or function accepts them.
        derived: additional arguments that are always passed.
    """
    name = node.get("_target_") if isinstance(node, Mapping) else None
    if not isinstance(name, str):
        raise UserError(f"_target_ (the name of a class) is missing from {str(node)[:80]}")
    if offered:
        legal = parameters(name)
        derived |= {key: value for key, value in offered.items() if key in legal or "**" in legal}
    build = _instances if node.get("_recursive_", True) else copy.deepcopy
    skipped = ("_target_", "_recursive_", *derived)
    arguments: dict[str, Any] = {
        key: build(value) for key, value in node.items() if key not in skipped
    }
    try:
        module, _, attribute = name.rpartition(".")
        return getattr(importlib.import_module(module), attribute)(**arguments, **derived)
    except (UserError, FileNotFoundError):
        raise
    except Exception as error:
        raise UserError(f"{name}: {first_line(error)}") from error


def _instances(node: Any) -> Any:
    if isinstance(node, Mapping) and "_target_" in node:
        return instantiate(dict(node))
    if isinstance(node, Mapping):
        return {name: _instances(value) for name, value in node.items()}
    return [_instances(value) for value in node] if isinstance(node, list | tuple) else node


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Flattens nested mappings into one mapping with dotted keys. Lists are not flattened."""
    if not isinstance(config, Mapping) or not config:
        return {prefix: config}
    flat: dict[str, Any] = {}
    for name, child in config.items():
        flat |= flatten(child, f"{prefix}.{name}" if prefix else name)
    return flat


def save(config: Config, path: Path, head: str = "") -> None:
    """Writes a configuration atomically as YAML, with the comment `head` on the first line."""
    content = OmegaConf.to_yaml(OmegaConf.create(config))
    write_text(path, f"# {head}\n{content}" if head else content)


def trust(config: Config, owner: str = "the checkpoint's configuration") -> None:
    """Checks that a configuration from someone else names only permitted classes and arguments.

    A class is permitted for a part if `MODULES` lists its module for this part, or if a file in the
    part's folder in `experiments/` names the class. The environment variable FLAME_MDM_TRUST lists
    additional permitted packages, separated by commas. The check does not import the classes.

    Args:
        config: the parts of the configuration, by name.
        owner: the configuration, as it is called in the error message.
    """
    names = [name.strip() for name in os.environ.get("FLAME_MDM_TRUST", "").split(",")]
    added = [name for name in names if name]
    for path, node in walk(config):
        target = node.get("_target_", "")
        if "_target_" not in node or (
            isinstance(target, str) and _is_of_kind(target, path[0] if path else "")
        ):
            continue
        package = str(target).partition(".")[0]
        if package not in added:
            raise UserError(
                f"{owner} names {target} at {'.'.join(path)}. Code from this package is run only if you "
                f"trust it. To trust it, set FLAME_MDM_TRUST={package}"
            )
    check(config)


def _is_of_kind(target: str, kind: str) -> bool:
    modules = MODULES.get(kind, ())

    def is_listed(name: str) -> bool:
        return any(f"{name}.".startswith(f"{module}.") for module in modules)

    module, _, name = target.rpartition(".")
    defined = definition(module, name) if is_listed(module) else None
    if defined is not None and isinstance(defined[1], ast.ClassDef) and is_listed(defined[0]):
        return True
    return bool(modules) and target in _shipped(kind)


@functools.cache
def _shipped(kind: str) -> frozenset[str]:
    nodes = [
        node
        for file in (EXPERIMENTS / kind).glob("*.yaml")
        for _, node in walk(read_package_yaml(file))
    ]
    return frozenset(node["_target_"] for node in nodes if "_target_" in node)
