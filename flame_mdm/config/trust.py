"""Checks of the classes that a configuration from a checkpoint names."""

import ast
import functools
import os

from flame_mdm.config.composition import EXPERIMENTS
from flame_mdm.config.signatures import Config, check, definition, walk
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_yaml

MODULES = {
    "task": ("flame_mdm.task", "flame_mdm.training.distillation"),
    "denoiser": ("flame_mdm.denoisers",),
    "process": ("flame_mdm.processes",),
    "condition": ("flame_mdm.conditions",),
    "representation": ("flame_mdm.representations",),
    "data": ("flame_mdm.data",),
}
"""Modules whose classes a configuration from a checkpoint may name, by part of the configuration."""


def trust(config: Config) -> None:
    """Checks that parts of a configuration from a checkpoint only name classes of their kind, with legal arguments.

    A class is of the kind of a part if it is defined in a module that `MODULES` lists for this part, or named by a file
    in the folder of `experiments/` for this part. The environment variable FLAME_MDM_TRUST adds packages, separated by
    commas, of which any part may name anything. Nothing that the configuration names is imported here.
    """
    added = [name for name in os.environ.get("FLAME_MDM_TRUST", "").split(",") if name]
    for where, target in foreign(config).items():
        package = target.partition(".")[0]
        if package not in added:
            raise UserError(
                f"the checkpoint's configuration names {target} at {where}. Its code is only run if "
                f"you trust it: set FLAME_MDM_TRUST={package}"
            )
    check(config)


def foreign(config: Config) -> dict[str, str]:
    """Returns what parts of a configuration name besides the classes of their kind in this framework: place -> name."""
    named = [(path, node["_target_"]) for path, node in walk(config) if "_target_" in node]
    return {
        ".".join(path): str(target)
        for path, target in named
        if not (isinstance(target, str) and _is_of_kind(target, path[0] if path else ""))
    }


def _is_of_kind(target: str, kind: str) -> bool:
    modules = MODULES.get(kind, ())
    if modules and target in _shipped(kind):
        return True

    def is_listed(name: str) -> bool:
        return any(f"{name}.".startswith(f"{module}.") for module in modules)

    module, _, name = target.rpartition(".")
    defined = definition(module, name) if is_listed(module) else None
    return defined is not None and isinstance(defined[1], ast.ClassDef) and is_listed(defined[0])


@functools.cache
def _shipped(kind: str) -> frozenset[str]:
    nodes = [node for file in (EXPERIMENTS / kind).glob("*.yaml") for _, node in walk(read_yaml(file))]
    return frozenset(node["_target_"] for node in nodes if "_target_" in node)
