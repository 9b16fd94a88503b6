"""Recipes: composed by Hydra, checked against the signatures of what they name, saved as plain dicts.

Nothing here imports torch or Lightning: signatures are read from source files, so that `--help` and a misspelt key
answer at once, and so that naming a class in a recipe runs none of its code.
"""

from __future__ import annotations

import ast
import difflib
import functools
import math
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, NoReturn

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra import main as hydra_main
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

Config = dict[str, Any]

_PACKAGED = Path(__file__).parent / "experiments"
EXPERIMENTS = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parent.parent / "experiments"
"""The recipes: inside the installed package, or beside it in a clone."""

TRUSTED = (
    "flame_mdm.task",
    "flame_mdm.denoisers",
    "flame_mdm.processes",
    "flame_mdm.conditions",
    "flame_mdm.representations",
    "flame_mdm.data",
    "evaluators",
)
"""Modules whose classes a configuration from a checkpoint may name."""

FLAGS = ("--help", "--multirun", "-m", "--cfg", "--resolve", "--package")
"""Hydra's own options that commands take."""

MOST_NODES = 100_000
"""Values and keys of a YAML file, its aliases written out."""

LAUNCH = "launch"
"""The group of `experiments/` whose options start jobs elsewhere."""


class UserError(Exception):
    """Something the user can mend; commands print its message, one line, and exit with 1."""


# Composition ----------------------------------------------------------------------------------------------------------


def groups() -> list[str]:
    """The swappable parts of a recipe: folders of `experiments/` whose files are options, not recipes."""
    return sorted(p.name for p in EXPERIMENTS.iterdir() if p.is_dir() and not _is_recipe_folder(p))


def _is_recipe_folder(folder: Path) -> bool:
    return any("@package _global_" in file.read_text()[:200] for file in folder.glob("*.yaml"))


def recipes() -> list[str]:
    """Names of all experiments, as `EXP=` takes them."""
    files = (p for p in EXPERIMENTS.rglob("*.yaml") if "@package _global_" in p.read_text()[:200])
    return sorted(p.relative_to(EXPERIMENTS).with_suffix("").as_posix() for p in files)


def compose(name: str, overrides: Sequence[str] = ()) -> Config:
    """The recipe `name` with overrides such as `trainer.max_steps=10` or `denoiser=mdm_encoder`, resolved and checked.

    Args:
        name: a file of `experiments/` without its suffix, or the path of a recipe or of a saved `config.yaml`.
        overrides: in Hydra's grammar.

    Raises:
        UserError: an unknown experiment, group, option or key, with the nearest names; or a malformed value.
    """
    config = _hydra(_plan(_find(name), overrides))
    check(config)
    return config


def settings(name: str, overrides: Sequence[str] = ()) -> Config:
    """The keys of a command that has a configuration of its own, such as evaluate, with overrides.

    Raises:
        UserError: as for `compose`.
    """
    config = _hydra(_plan(_Recipe(EXPERIMENTS, name), overrides))
    check(config)
    return config


class _Recipe(NamedTuple):
    """Where a configuration stands, and what it is."""

    folder: Path
    stem: str
    saved: bool = False
    """A resolved configuration, whose parts cannot be swapped."""
    experiment: str | None = None
    """Name that a recipe gets."""


class _Plan(NamedTuple):
    """What Hydra is asked to compose."""

    folder: Path
    stem: str
    overrides: list[str]
    base: Config | None = None
    """The recipe before single keys are overridden, whose values tell which kind of value a key takes."""


def _plan(recipe: _Recipe, overrides: Sequence[str]) -> _Plan:
    """Checks names and keys. A key that only the signature of its `_target_` knows is marked as new for Hydra."""
    parsed = _parse(overrides)
    if recipe.saved:
        _refuse_groups(parsed, recipe)
    _check_groups(parsed)
    first = [f"hydra.searchpath=[file://{EXPERIMENTS}]"] if recipe.folder != EXPERIMENTS else []
    if recipe.experiment:
        first.append(f"experiment={recipe.experiment}")
    parts = [o for o in parsed if _is_group(o)]
    composed = _hydra(_Plan(recipe.folder, recipe.stem, [*first, *map(_first_choice, parts)]))
    keys = [_legal(composed, o) for o in parsed if not _is_group(o)]
    return _Plan(recipe.folder, recipe.stem, [*first, *map(_line, parts), *keys], composed)


def _line(override: Override) -> str:
    line = override.input_line or ""
    return f"+{line}" if override.key_or_group == LAUNCH and not override.is_add() else line


def _first_choice(override: Override) -> str:
    """The override; of a sweep, that to its first value."""
    return f"{override.get_key_element()}={_choices(override)[0]}" if override.is_sweep_override() else _line(override)


def _choices(override: Override) -> list[str]:
    """What an override gives its key, one value or those of a sweep."""
    value = override.value()
    if isinstance(value, Glob):
        return value.filter(_options(override.key_or_group)) or [str(value)]
    return list(override.sweep_string_iterator()) if override.is_sweep_override() else [str(value)]


def _options(group: str) -> list[str]:
    return sorted(p.stem for p in (EXPERIMENTS / group).glob("*.yaml"))


def _find(name: str) -> _Recipe:
    if name.endswith((".yaml", ".yml")):
        path = Path(name).resolve()
        if not path.is_file():
            raise UserError(f"{name}: no such file. EXP takes an experiment or the path of a config.yaml")
        saved = "defaults" not in load_yaml(path)
        return _Recipe(path.parent, path.stem, saved, None if saved else path.stem)
    if name not in recipes():
        raise UserError(f"unknown experiment '{name}'.{_nearest(name, recipes())} `make help` lists them all")
    return _Recipe(EXPERIMENTS, name, experiment=name)


def load_yaml(path: Path) -> Any:
    """A YAML file, as OmegaConf reads it.

    Raises:
        UserError: it cannot be read, or aliases make it endless.
    """
    try:
        with path.open(encoding="utf-8") as file:
            size = _size(yaml.compose(file, yaml.SafeLoader), {})
        if size > MOST_NODES:
            raise ValueError("its aliases, written out, are endless or nearly so")
        return OmegaConf.load(path)
    except Exception as error:  # YAML's many errors all mean the same here
        raise UserError(f"{path}: not a readable YAML file: {_first_line(error)}") from error


def _size(node: yaml.Node | None, known: dict[int, float]) -> float:
    """Nodes of a YAML file with its aliases written out; infinite where one contains itself."""
    if id(node) not in known:
        known[id(node)] = math.inf
        content = node.value if node is not None else ""
        if isinstance(content, str):
            content.encode()  # half a character cannot be written again
        parts = [part for pair in content for part in (pair if isinstance(pair, tuple) else [pair])]
        known[id(node)] = 1 + sum(_size(part, known) for part in parts if isinstance(part, yaml.Node))
    return known[id(node)]


def _parse(overrides: Sequence[str]) -> list[Override]:
    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        raise UserError(f"cannot read an override, write key=value, text as 'a b': {_first_line(error)}") from error


def _is_group(override: Override) -> bool:
    return (EXPERIMENTS / override.key_or_group).is_dir()


def _check_groups(overrides: Sequence[Override]) -> None:
    for override in overrides:
        if not _is_group(override) or override.is_delete():
            continue
        group = override.key_or_group
        options = _options(group)
        for option in _choices(override):
            if option not in options:
                raise UserError(
                    f"no {group} is called '{option}'.{_nearest(option, options)} There are: {', '.join(options)}"
                )
        if group == LAUNCH and _file("submitit") is None:
            raise UserError(
                f"{_line(override).lstrip('+')} needs hydra-submitit-launcher: pip install flame-mdm[slurm]"
            )


def _refuse_groups(overrides: Sequence[Override], recipe: _Recipe) -> None:
    for override in overrides:
        if _is_group(override) and override.key_or_group != LAUNCH:
            raise UserError(
                f"{_line(override)} swaps a part of a recipe, but {recipe.stem}.yaml is a saved configuration, "
                "whose parts are fixed; start from the experiment, or override single keys"
            )


def _hydra(plan: _Plan) -> Config:
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(version_base="1.3", config_dir=str(plan.folder)):
            config = hydra_compose(plan.stem, plan.overrides)
            resolved = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(f"{plan.stem}: {_first_line(error)}") from error
    plain: Config = {str(key): value for key, value in resolved.items()}  # type: ignore[union-attr]
    _check_same_kinds(plan.base or {}, plain)
    return plain


def _legal(config: Config, override: Override) -> str:
    """The override as Hydra takes it, if its key is written in the recipe or is a parameter of the `_target_`."""
    line = _line(override)
    if override.is_delete() or override.is_force_add() or override.is_add() or line.startswith("hydra."):
        return line
    node: Any = config
    parts = override.key_or_group.split(".")
    for depth, part in enumerate(parts):
        if isinstance(node, Mapping) and part in node:
            node = node[part]
        elif isinstance(node, Mapping) and "_target_" in node and part in parameters(node["_target_"], exact=False):
            return "++" + line
        elif isinstance(node, list) and part.isdigit() and int(part) < len(node):
            node = node[int(part)]
        else:
            raise UserError(_unknown_key(config, parts, depth, node))
    return line


# Checks against signatures --------------------------------------------------------------------------------------------


def check(config: Config) -> None:
    """Every mapping with a `_target_` names something that exists and gives it only arguments it takes.

    Raises:
        UserError: naming the key and the nearest legal ones.
    """
    for path, node in _walk(config):
        if "_target_" not in node:
            continue
        where = ".".join([*path, "_target_"])
        if not isinstance(node["_target_"], str):
            raise UserError(f"{where}={node['_target_']}: the name of a class or a function is needed")
        legal = _signature(node["_target_"], where)
        for name, value in node.items():
            if not str(name).startswith("_") and name not in legal and "**" not in legal:
                raise UserError(_unknown_key(config, [*path, str(name)], len(path), node))
            _check_kind(".".join([*path, str(name)]), value, legal.get(name, ""))


KINDS: dict[str, tuple[type | tuple[type, ...], str]] = {
    "bool": (bool, "true or false"),
    "int": (int, "a whole number"),
    "float": ((int, float), "a number"),
    "str": (str, "a text"),
    "None": (type(None), "null"),
}


def _check_kind(key: str, value: Any, annotation: str) -> None:
    """Refuses a value that the annotation of its parameter plainly rules out; what is not understood is let through."""
    needed = []
    for part in re.sub(r"^Optional\[(.*)\]$", r"\1 | None", annotation).split(" | "):
        if part in KINDS:
            kind, words = KINDS[part]
            if isinstance(value, kind) and (part == "bool" or not isinstance(value, bool)):
                return
        elif part.startswith("Literal[") and part.endswith("]"):
            choices = ast.literal_eval(f"({part[8:-1]},)")
            words = f"one of {', '.join(map(str, choices))}"
            if value in choices:
                return
        elif re.fullmatch(r"[A-Z]\w+", part) and part != "Any" and (value is None or isinstance(value, int | float)):
            words = "a part"  # a class
        else:
            return
        needed.append(words)
    raise UserError(f"{key}={value}: it has to be {' or '.join(dict.fromkeys(needed))}")


def _check_same_kinds(base: Config, config: Config, path: str = "") -> None:
    """Refuses values of another kind than those of the recipe, where no signature tells."""
    for name, value in base.items():
        key = f"{path}{name}"
        if name not in config:
            if "_target_" not in base and path != "callbacks.":
                raise UserError(f"{key} cannot be taken out; give it another value")
        elif isinstance(value, Mapping):
            if isinstance(config[name], Mapping):
                _check_same_kinds({k: v for k, v in value.items() if "_target_" not in value}, config[name], f"{key}.")
            elif config[name] is not None or key in ("run", "callbacks", "losses"):
                raise UserError(f"{key}={config[name]}: it has to be a mapping of keys")
        elif value is not None and not isinstance(value, list):
            kind = type(value).__name__
            _check_kind(key, config[name], "str | int | float" if kind == "str" else kind)


def _walk(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Mapping[str, Any]]]:
    if isinstance(node, Mapping):
        yield path, node
        for name, child in node.items():
            yield from _walk(child, (*path, str(name)))
    elif isinstance(node, list | tuple):
        for index, child in enumerate(node):
            yield from _walk(child, (*path, str(index)))


def _unknown_key(config: Config, parts: Sequence[str], depth: int, node: Any) -> str:
    """The message for a key that stops being legal at `parts[depth]`, whose parent is `node`."""
    key = ".".join(parts)
    known = {".".join([*path, str(name)]) for path, mapping in _walk(config) for name in mapping}
    if isinstance(node, Mapping) and "_target_" in node:
        known |= {".".join([*parts[:depth], name]) for name in parameters(node["_target_"]) if name != "**"}
    known -= {key}
    siblings = {name for name in known if name.rpartition(".")[0] == ".".join(parts[:depth])}
    near = difflib.get_close_matches(parts[depth], [s.rpartition(".")[2] for s in siblings], 3, 0.6)
    names = [".".join([*parts[:depth], n]) for n in near] or difflib.get_close_matches(key, known, 3, 0.6)
    names = names or [name for name in sorted(known) if name.endswith(f".{parts[-1]}")][:3]
    return f"unknown config key '{key}'." + (f" Did you mean {', '.join(names)}?" if names else "")


def _nearest(name: str, names: Sequence[str]) -> str:
    near = difflib.get_close_matches(name, names, 3, 0.5)
    return f" Did you mean {', '.join(near)}?" if near else ""


def parameters(target: str, *, where: str = "_target_", exact: bool = True) -> frozenset[str]:
    """Names of the arguments a class or function takes, read from its source; "**" stands for any.

    Raises:
        UserError: `target` is not found. With `exact=False`, "**" alone does not make every key legal.
    """
    names = frozenset(_signature(target, where))
    return names if exact else names - {"**"}


@functools.cache
def _signature(target: str, where: str) -> dict[str, str]:
    """The arguments that a class or function takes: name -> annotation, "" without one."""
    module, _, name = target.rpartition(".")
    found = _definition(module, name)
    if found is None:
        raise UserError(f"{where}={target}: no such class or function can be found")
    return _arguments(*found)


def _definition(module: str, name: str, seen: frozenset[str] = frozenset()) -> tuple[str, ast.AST] | None:
    """The module and syntax tree where `module.name` is defined, through re-exports."""
    tree = _tree(module)
    if tree is None or module in seen:
        return None
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return module, node
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if alias.name == "*" or (alias.asname or alias.name) == name:
                    source = _absolute(module, node)
                    found = _definition(source, name if alias.name == "*" else alias.name, seen | {module})
                    if found:
                        return found
    return None


def _absolute(module: str, node: ast.ImportFrom) -> str:
    if not node.level:
        return node.module or ""
    path = _file(module)
    parts = module.split(".")
    keep = len(parts) - node.level + (1 if path is not None and path.name == "__init__.py" else 0)
    return ".".join([*parts[:keep], *([node.module] if node.module else [])])


def _file(module: str) -> Path | None:
    relative = Path(*module.split("."))
    for entry in [str(Path(__file__).parent.parent), *sys.path]:
        for candidate in (Path(entry) / relative / "__init__.py", (Path(entry) / relative).with_suffix(".py")):
            if candidate.is_file():
                return candidate
    return None


@functools.cache
def _tree(module: str) -> ast.Module | None:
    path = _file(module)
    return ast.parse(path.read_text(encoding="utf-8")) if path else None


def _arguments(module: str, node: ast.AST) -> dict[str, str]:
    if isinstance(node, ast.FunctionDef):
        listed = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        names = {a.arg: ast.unparse(a.annotation) if a.annotation else "" for a in listed}
        names |= {"**": ""} if node.args.kwarg else {}
        return {name: kind for name, kind in names.items() if name not in ("self", "cls")}
    assert isinstance(node, ast.ClassDef)
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and item.name == "__init__":
            names = _arguments(module, item)
            return names if "**" not in names else _inherited(module, node) | names
    fields = {
        i.target.id: ast.unparse(i.annotation)
        for i in node.body
        if isinstance(i, ast.AnnAssign) and isinstance(i.target, ast.Name)
    }
    dataclass = any("dataclass" in ast.unparse(d) for d in node.decorator_list)
    return _inherited(module, node) | (fields if dataclass else {})


def _inherited(module: str, node: ast.ClassDef) -> dict[str, str]:
    names: dict[str, str] = {}
    for base in node.bases:
        found = _definition(module, ast.unparse(base).rpartition(".")[2])
        if found and found[1] is not node:
            names |= _arguments(*found)
    return names


# Instances and files --------------------------------------------------------------------------------------------------


def trust(config: Config) -> None:
    """Checks a configuration out of a checkpoint: it may name classes that `TRUSTED` modules define, and no functions.

    The environment variable FLAME_MDM_TRUST adds packages, with commas between them, of which it may name anything.
    Nothing that it names is imported here.

    Raises:
        UserError: it names others.
    """
    added = [name for name in os.environ.get("FLAME_MDM_TRUST", "").split(",") if name]
    for path, mapping in _walk(config):
        if "_target_" not in mapping:
            continue
        target = mapping["_target_"]
        package = str(target).partition(".")[0]
        if not (isinstance(target, str) and (package in added or _is_trusted_class(target))):
            raise UserError(
                f"the checkpoint's configuration names {target} at {'.'.join(path)}; such code runs only if you "
                f"trust it: set FLAME_MDM_TRUST={package}"
            )


def _is_trusted_class(target: str) -> bool:
    """Whether the class is defined where it is named to be, or brought there from another trusted module."""
    module, _, name = target.rpartition(".")
    found = _definition(module, name) if _is_trusted_module(module) else None
    return found is not None and isinstance(found[1], ast.ClassDef) and _is_trusted_module(found[0])


def _is_trusted_module(name: str) -> bool:
    return any(name == trusted or name.startswith(f"{trusted}.") for trusted in TRUSTED)


def instantiate(node: Config, **derived: Any) -> Any:
    """Builds what a mapping with a `_target_` describes, nested ones included.

    Args:
        node: the mapping.
        derived: arguments that follow from other parts of the recipe.

    Raises:
        UserError: arguments of the wrong kind.
    """
    from hydra.utils import instantiate as hydra_instantiate

    try:
        return hydra_instantiate(node, **derived, _convert_="all")
    except HydraException as error:
        cause = error.__cause__
        if isinstance(cause, UserError | ValueError | FileNotFoundError):
            raise cause from None
        raise UserError(f"{node['_target_']}: {_first_line(cause or error)}") from error


def flatten(config: Any, prefix: str = "") -> dict[str, Any]:
    """Nested mappings as dotted keys; lists are leaves."""
    if not isinstance(config, Mapping) or not config:
        return {prefix: config}
    return {k: v for name, c in config.items() for k, v in flatten(c, f"{prefix}.{name}" if prefix else name).items()}


def save(config: Config, path: Path, head: str = "") -> None:
    """Writes the configuration as YAML, atomically, after the comment lines of `head`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_suffix(".partial")
    comment = "".join(f"# {line}\n" for line in head.splitlines())
    partial.write_text(comment + OmegaConf.to_yaml(OmegaConf.create(config)))
    partial.replace(path)


# Commands -------------------------------------------------------------------------------------------------------------


def run(
    command: Callable[[Config], None],
    argv: Sequence[str],
    *,
    usage: str,
    name: str | None = None,
    text: Sequence[str] = (),
    like: Sequence[str] = (),
) -> int:
    """Serves a command line `[NAME] key=value ...` through Hydra and returns the exit code.

    Args:
        command: does the work, given the resolved configuration.
        argv: the words after the command. Hydra's own flags (`--multirun`, `--cfg job`) pass through. `launch=...`
            hands each job of a sweep, or the only one, to that launcher, and waits for them.
        usage: printed for `--help`.
        name: the configuration, for commands that have one of their own; otherwise the first word names a recipe.
        text: keys whose values are taken as they stand, not read in Hydra's grammar.
        like: functions, by module and name, whose annotations tell which kind of value their arguments' keys take.
    """
    words = [_quoted(word, text) for word in (_make_variables() if "--from-make" in argv else argv)]
    if name is not None and words and not words[0].startswith("-") and "=" not in words[0]:
        words[0] = f"exp={words[0]}"  # EXP of make, or the first word, where it names no recipe
    if (not words and name is None) or any(word in ("-h", "--help") for word in words):
        print(usage.strip())
        if name is None:
            print("\nexperiments: " + ", ".join(recipes()))
            print("parts: " + ", ".join(f"{group}=..." for group in groups()))
        return 0 if words else 2
    codes = [0]
    with _stoppable() if name is not None else nullcontext():  # training stops at the end of a step, by itself
        return guarded(lambda: _serve(command, words, name, codes, like)) or max(codes)


@contextmanager
def _stoppable() -> Iterator[None]:
    """SIGTERM ends the work as an exception would, so that nothing half done stays behind; the exit code is 143."""

    def stop(number: int, frame: FrameType | None) -> NoReturn:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _serve(
    command: Callable[[Config], None], words: list[str], name: str | None, codes: list[int], like: Sequence[str]
) -> None:
    if name is None:
        if words[0].startswith("-") or "=" in words[0]:
            raise UserError(f"the first word must name an experiment, such as quickstart, not '{words[0]}'")
        first, words = words[0], words[1:]
        recipe = _find(first)
    else:
        first, recipe = name, _Recipe(EXPERIMENTS, name)
    flags = [w for i, w in enumerate(words) if w.startswith("-") or (i and words[i - 1] in ("--cfg", "--package"))]
    unknown = [w for w in flags if w.startswith("-") and w.partition("=")[0] not in FLAGS]
    if unknown:
        raise UserError(f"unknown option {unknown[0]}; there are {', '.join(FLAGS)}, and keys as key=value")
    overrides = [w for w in words if w not in flags]
    plan = _plan(recipe, overrides)
    parsed = _parse(plan.overrides)
    launch = [str(o.value()) for o in parsed if o.key_or_group == LAUNCH]
    sweep = bool(launch) or any(flag in ("-m", "--multirun") for flag in flags)
    composed = _hydra(plan._replace(overrides=[_first_choice(o) for o in parsed] if sweep else plan.overrides))
    check(composed)
    if name is None:
        _check_whole(composed, first)
    for function in like:
        for key, annotation in _signature(function, "like").items():
            if composed.get(key) is not None:
                _check_kind(key, composed[key], annotation)
    if "local" in launch and composed.get("trainer", {}).get("devices", 1) != 1:
        raise UserError("launch=local runs each job in one process: leave out launch, or trainer.devices")

    def start(plain: Config, task: Sequence[str]) -> int:
        if name is None:  # what Lightning starts further processes with
            sys.argv = [sys.argv[0], first, *task, _quoted(f"run.dir={plain['run']['dir']}", ("run.dir",))]
        code = guarded(lambda: command(plain))
        codes.append(code)
        return code

    if not flags and not sweep:
        start(composed, [word for word in plan.overrides if not word.startswith("hydra.")])
        return

    def job(config: Any) -> None:
        hydra = HydraConfig.get()
        if sweep and name is None:
            config = OmegaConf.merge(config, {"run": {"dir": hydra.runtime.output_dir}})
        plain: Config = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)  # type: ignore[assignment]
        check(plain)
        HydraConfig.instance().cfg = None  # else Lightning adds words for Hydra's own command line
        code = start(plain, [str(word) for word in hydra.overrides.task if not str(word).startswith(f"+{LAUNCH}=")])
        if code > 128 or (launch and code):  # else a signal ends one job of a sweep, or a launched one counts as done
            raise SystemExit(code)

    quiet = ["hydra/job_logging=disabled", "hydra/hydra_logging=disabled", "hydra.output_subdir=null"]
    fixed = [repr(o.key_or_group) for o in parsed if not o.is_sweep_override()]
    output = [
        "hydra.run.dir=${run.dir}",
        "hydra.sweep.dir=${run.dir}" if name is None else f"hydra.sweep.dir=runs/sweeps/{name}",
        "hydra.sweep.subdir=${hydra.job.override_dirname}",
        f"hydra.job.config.override_dirname.exclude_keys=[{','.join(fixed)}]",
    ]
    if launch:
        logs = f"{composed['run']['dir'] if name is None else f'runs/sweeps/{name}'}/.submitit"
        print(f"waiting for the jobs; what they print stands in {logs}", flush=True)
    if sweep and not {"-m", "--multirun"} & set(flags):
        flags.append("--multirun")
    sys.argv = [sys.argv[0], *flags, *quiet, *output, *plan.overrides]
    GlobalHydra.instance().clear()
    hydra_main(version_base="1.3", config_path=str(plan.folder), config_name=plan.stem)(job)()


def _check_whole(config: Config, name: str) -> None:
    """Refuses a recipe that lacks what every run needs."""
    for key in ("run", "trainer", "data", "representation", "task", "optimizer", "callbacks"):
        node = config.get(key)
        if not isinstance(node, Mapping) or (key not in ("run", "callbacks") and "_target_" not in node):
            raise UserError(f"{name}: it has no {key}; begin a recipe with the defaults of another, or with /base")
    if not config["run"].get("dir"):
        raise UserError(f"{name}: run.dir is empty; a run needs a folder")
    if "max_steps" not in config["trainer"]:
        raise UserError(f"{name}: trainer.max_steps is missing; -1 trains without end")
    for key in ("denoiser", "process", "condition"):
        if key in config and not (isinstance(config[key], Mapping) and "_target_" in config[key]):
            raise UserError(f"{name}: {key} has no _target_; {key}=... swaps it for one of experiments/{key}")
    for key, value in config.get("denoiser", {}).items():
        if isinstance(value, int) and value < 0:
            raise UserError(f"denoiser.{key}={value}: a size is not negative")
    for key in ("experiment", "seed", "ema", "logger"):
        if key not in config:
            raise UserError(f"{name}: it has no {key}; begin a recipe with the defaults of another, or with /base")


def _make_variables() -> list[str]:
    """The variables given to make, as words: `EXP` names the recipe, other upper-case names are keys.

    Make hands them down in MAKEFLAGS after ` -- `, latest first, with escaped spaces and doubled dollar signs; read
    from there, no shell has touched them.
    """
    variables = (" " + os.environ.get("MAKEFLAGS", "")).partition(" -- ")[2]
    words = [re.sub(r"\\(.)", r"\1", w).replace("$$", "$") for w in re.findall(r"(?:\\.|[^\\ ])+", variables)]
    pairs = [word.partition("=") for word in reversed(words)]
    names = [value for key, _, value in pairs if key == "EXP"]
    keys = [(key.lower() if key.isupper() else key, value) for key, _, value in pairs]
    return names + [f"{key}={value}" for key, value in keys if key not in ("exp", "python", "venv")]


def _quoted(word: str, keys: Sequence[str]) -> str:
    key, separator, value = word.partition("=")
    if not separator or key not in keys or value in ("", "null"):
        return word
    # Hydra takes a backslash as it stands, except right before a quote, where it has to be doubled.
    escaped = re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + ("\\'" if m[2] else ""), value).replace("${", "\\${")
    return f"{key}='{escaped}'"


def guarded(action: Callable[[], None]) -> int:
    """Runs `action`; what a user can mend becomes one line and exit code 1, a traceback with FLAME_MDM_TRACEBACK=1."""
    try:
        action()
    except (UserError, ValueError, OSError) as error:
        if os.environ.get("FLAME_MDM_TRACEBACK") == "1":
            traceback.print_exc()
        print(f"error: {_first_line(error)}", file=sys.stderr)
        return 1
    except SystemExit as stop:
        return int(stop.code or 0)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return 0


def _first_line(error: BaseException) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if len(lines) > 1 and lines[0].endswith(":"):
        return f"{lines[0]} {lines[1]}"
    return lines[0] if lines else type(error).__name__
