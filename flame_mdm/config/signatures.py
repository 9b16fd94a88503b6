"""Checks recipes against the signatures of the classes and functions that they name.

Signatures are read from source files, so that misspelled keys are reported immediately and a class
in a recipe is checked without running its code.
"""

import ast
import difflib
import functools
import math
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec, resolve_name
from pathlib import Path
from typing import Any

from flame_mdm.errors import UserError

Config = dict[str, Any]


def check(config: Config) -> None:
    """Raises `UserError` if a `_target_` does not exist or does not accept one of its arguments.

    The message suggests the most similar permitted keys.
    """
    for path, node in walk(config):
        if "_target_" not in node:
            continue
        if not isinstance(node["_target_"], str):
            key = ".".join([*path, "_target_"])
            raise UserError(f"{key}={node['_target_']}: must be the name of a class or a function")
        legal = _signature(node["_target_"])
        for name, value in node.items():
            if not str(name).startswith("_") and name not in legal and "**" not in legal:
                raise UserError(unknown_key(config, [*path, str(name)], len(path), node))
            check_kind(".".join([*path, str(name)]), value, legal.get(name, ""))


KINDS: dict[str, tuple[type | tuple[type, ...], str]] = {
    "bool": (bool, "true or false"),
    "int": (int, "a whole number"),
    "float": ((int, float), "a finite number"),
    "str": (str, "a string"),
    "None": (type(None), "null"),
}
"""Permitted types of a value and their description in error messages, by annotation."""
SEQUENCES, TUPLES = ("list", "List", "Sequence"), ("tuple", "Tuple")


TOP_LEVEL = {
    "experiment": "str | None",
    "seed": "int",
    "data_root": "str",
    "run": "dict[str, Any]",
    "run.name": "str | int | float",
    "run.dir": "str",
    "run.speed": "str",
    "callbacks": "dict[str, Any]",
    "losses": "dict[str, Any] | None",
    "initial_weights": "str | None",
    "lr_warmup": "int | None",
    "lr_decay": "float | None",
    "ema": "dict[str, Any] | None",
    "logger": "dict[str, Any] | None",
}
"""Annotations of the recipe's keys that are not arguments of a `_target_`."""

ARGUMENTS = {
    "losses": "flame_mdm.losses.MotionLosses",
    "ema": "flame_mdm.training.averaging.MovingAverage",
}
"""Classes whose arguments the mappings in a recipe contain, by key of the mapping."""

DERIVED = ("to_joints", "feet", "edges")  # arguments of these classes that recipes cannot set


def check_top_level(config: Config) -> None:
    """Checks the keys that are not in a mapping with a `_target_`.

    Raises `UserError` if one of these keys is unknown or has an invalid value.
    """
    for key, annotation in TOP_LEVEL.items():
        group, _, name = key.rpartition(".")
        node = config.get(group) if group else config
        if isinstance(node, Mapping) and name in node:
            check_kind(key, node[name], annotation)
    task = (config.get("task") or {}).get("_target_")
    if config.get("losses", {}) is None and task is not None and "losses" in parameters(task):
        raise UserError("losses=None: must be a mapping of keys to values")
    for key, target in ARGUMENTS.items():
        legal = {name: kind for name, kind in _signature(target).items() if name not in DERIVED}
        for name, value in (config.get(key) or {}).items():
            if name not in legal:
                raise UserError(f"unknown config key '{key}.{name}'. Available: {', '.join(legal)}")
            check_kind(f"{key}.{name}", value, legal[name])
    # A recipe may define additional keys that other keys refer to.
    for key in config.keys() - TOP_LEVEL.keys():
        if near := difflib.get_close_matches(str(key), TOP_LEVEL, 1, 0.75):
            raise UserError(f"unknown config key '{key}'. Did you mean {near[0]}?")


def check_kind(key: str, value: Any, annotation: str) -> None:
    """Raises `UserError` if a value does not match the annotation of its parameter.

    Any value is accepted if this check does not support the annotation.
    """
    required = []
    kinds = _alternatives(ast.parse(annotation or "Any", mode="eval").body)
    # A configuration cannot contain tensors, so only the other types in a union are checked.
    for kind in [kind for kind in kinds if _name(kind) != "Tensor"]:
        description = _mismatch(value, kind)
        if not description:
            return
        required.append(description)
    if required:
        raise UserError(f"{key}={value}: must be {' or '.join(dict.fromkeys(required))}")


def _alternatives(annotation: ast.expr) -> list[ast.expr]:
    if isinstance(annotation, ast.BinOp):
        return [*_alternatives(annotation.left), *_alternatives(annotation.right)]
    # A string is a forward reference that contains the annotation.
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        return _alternatives(ast.parse(annotation.value, mode="eval").body)
    if isinstance(annotation, ast.Subscript):
        name, members = _name(annotation.value), annotation.slice
        if name == "Optional":
            return [*_alternatives(members), ast.Constant(None)]
        if name == "Union" and isinstance(members, ast.Tuple):
            return [kind for member in members.elts for kind in _alternatives(member)]
    return [annotation]


def _mismatch(value: Any, kind: ast.expr) -> str:
    """Describes what an annotation without unions requires; "" = the value satisfies it."""
    name = _name(kind)
    if name in KINDS:
        types, description = KINDS[name]
        legal = isinstance(value, types) and isinstance(value, bool) == (name == "bool")
        return (
            ""
            if legal and not (isinstance(value, float) and not math.isfinite(value))
            else description
        )
    if isinstance(kind, ast.Subscript):
        outer = _name(kind.value)
        if outer == "Literal":
            members = kind.slice.elts if isinstance(kind.slice, ast.Tuple) else [kind.slice]
            choices = [ast.literal_eval(member) for member in members]
            return "" if value in choices else f"one of {', '.join(map(str, choices))}"
        if outer in ("dict", "Dict", "Mapping"):
            return "" if isinstance(value, Mapping) else "a mapping of keys to values"
        if outer not in (*SEQUENCES, *TUPLES) or (
            isinstance(value, Mapping) and "_target_" in value
        ):
            return ""
        if not isinstance(value, list | tuple):
            return "a list"
        if outer in TUPLES and isinstance(kind.slice, ast.Tuple):
            return _mismatch_of_items(value, kind.slice.elts)
        required = [
            [_mismatch(item, member) for member in _alternatives(kind.slice)] for item in value
        ]
        wrong = [descriptions for descriptions in required if all(descriptions)]
        return f"a list, each item {' or '.join(dict.fromkeys(wrong[0]))}" if wrong else ""
    if (
        re.fullmatch(r"[A-Z]\w+", name)
        and name != "Any"
        and (value is None or isinstance(value, int | float))
    ):
        return "a part"  # a class
    return ""


def _mismatch_of_items(items: Sequence[Any], kinds: Sequence[ast.expr]) -> str:
    """Describes what a tuple annotation, such as `tuple[float, float]`, requires.

    Returns "" if the items satisfy the annotation.
    """
    if isinstance(kinds[-1], ast.Constant) and kinds[-1].value is ...:
        kinds = [kinds[0]] * len(items)
    if len(items) != len(kinds):
        return f"a list of {len(kinds)}"
    for item, kind in zip(items, kinds, strict=True):
        required = [
            _mismatch(item, member) for member in _alternatives(kind) if _name(member) != "Tensor"
        ]
        if required and all(required):
            return f"a list of {len(kinds)}, each item {' or '.join(dict.fromkeys(required))}"
    return ""


def _name(node: ast.expr) -> str:
    """Returns the last part of a dotted name."""
    return (
        ast.unparse(node).rpartition(".")[2]
        if isinstance(node, ast.Name | ast.Attribute | ast.Constant)
        else ""
    )


def check_same_kinds(base: Config, config: Config, path: str = "") -> None:
    """Checks the types of values that are not covered by a signature.

    Raises `UserError` if an override changes the type of a value in the recipe.
    """
    for name, value in base.items():
        key = f"{path}{name}"
        if name not in config:
            if "_target_" not in base and path != "callbacks.":
                raise UserError(f"{key} cannot be removed. Set it to another value")
        elif isinstance(value, Mapping):
            if isinstance(config[name], Mapping):
                check_same_kinds(
                    {k: v for k, v in value.items() if "_target_" not in value},
                    config[name],
                    f"{key}.",
                )
            elif config[name] is not None or key in ("run", "callbacks", "losses"):
                raise UserError(f"{key}={config[name]}: must be a mapping of keys to values")
        elif value is not None and not isinstance(value, list):
            kind = type(value).__name__
            check_kind(key, config[name], "str | int | float" if kind == "str" else kind)


def walk(
    node: Any, path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Mapping[str, Any]]]:
    """Yields the path and content of each mapping in a configuration, beginning with the root."""
    if isinstance(node, Mapping):
        yield path, node
        for name, child in node.items():
            yield from walk(child, (*path, str(name)))
    elif isinstance(node, list | tuple):
        for index, child in enumerate(node):
            yield from walk(child, (*path, str(index)))


def unknown_key(config: Config, parts: Sequence[str], depth: int, node: Any) -> str:
    """Returns the error message for a key whose part `parts[depth]` does not exist in `node`."""
    key = ".".join(parts)
    if parts[0] == "data" and not depth:
        return (
            f"{key} is an option of a data set, but no data set was specified. Add data=NAME, "
            "such as data=folder"
        )
    siblings = {str(name) for name in node} if isinstance(node, Mapping) else set()
    siblings |= parameters(node["_target_"]) if "_target_" in siblings else set()
    near = difflib.get_close_matches(parts[depth], siblings - {parts[depth]}, 3, 0.6)
    names = [".".join([*parts[:depth], name]) for name in near]
    if not names:
        legal = {
            ".".join([*path, str(name)]) for path, mapping in walk(config) for name in mapping
        } - {key}
        names = difflib.get_close_matches(key, legal, 3, 0.6)
        names = names or [name for name in sorted(legal) if name.endswith(f".{parts[-1]}")][:3]
    return f"unknown config key '{key}'." + (f" Did you mean {', '.join(names)}?" if names else "")


def parameters(target: str) -> frozenset[str]:
    """Returns the argument names of a class or function from its source; "**" = any argument."""
    return frozenset(_signature(target))


@functools.cache
def _signature(target: str) -> dict[str, str]:
    """Returns the annotation of each argument of a class or function; "" = no annotation."""
    module, _, name = target.rpartition(".")
    node = definition(module, name)
    if node is None:
        package = module.partition(".")[0]
        missing = package and find_spec(package) is None
        hint = (
            f". Python cannot find {package}: set PYTHONPATH to the folder that contains it"
            if missing
            else ""
        )
        raise UserError(f"_target_={target}: no such class or function{hint}")
    return _arguments(*node)


def definition(
    module: str, name: str, seen: frozenset[str] = frozenset()
) -> tuple[str, ast.AST] | None:
    """Returns the module and syntax tree that define `module.name`, following re-exports."""
    tree = _tree(module)
    if tree is None or module in seen:
        return None
    for node in _top_level(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == name:
            return module, node
    for node in _top_level(tree):
        if isinstance(node, ast.ImportFrom):
            for alias in node.names:
                if alias.name == "*" or (alias.asname or alias.name) == name:
                    path = source_file(module)
                    package = (
                        module if path and path.name == "__init__.py" else module.rpartition(".")[0]
                    )
                    source = resolve_name(f"{'.' * node.level}{node.module or ''}", package)
                    original = definition(
                        source, name if alias.name == "*" else alias.name, seen | {module}
                    )
                    if original:
                        return original
    return None


def _top_level(node: ast.AST) -> Iterator[ast.AST]:
    """Yields the statements of a module, including those in `if` and `try` blocks.

    Statements in classes and functions are omitted.
    """
    for child in ast.iter_child_nodes(node):
        yield child
        if isinstance(child, ast.If | ast.Try | ast.ExceptHandler | ast.With):
            yield from _top_level(child)


def source_file(module: str) -> Path | None:
    """Returns the source file of a module; None if there is no file or the name is invalid."""
    # A name that contains a slash could refer to any file
    if not all(part.isidentifier() for part in module.split(".")):
        return None
    relative = Path(*module.split("."))
    for entry in [str(Path(__file__).parent.parent.parent), *sys.path]:
        for candidate in (
            Path(entry) / relative / "__init__.py",
            (Path(entry) / relative).with_suffix(".py"),
        ):
            if candidate.is_file():
                return candidate
    return None


@functools.cache
def _tree(module: str) -> ast.Module | None:
    path = source_file(module)
    try:
        return ast.parse(path.read_text(encoding="utf-8")) if path else None
    except (SyntaxError, ValueError) as error:
        raise UserError(f"{path}: not readable Python: {error}") from error


def _arguments(module: str, node: ast.AST) -> dict[str, str]:
    if isinstance(node, ast.FunctionDef):
        listed = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        names = {
            a.arg: ast.unparse(a.annotation) if a.annotation else ""
            for a in listed
            if a.arg != "self"
        }
        return names | ({"**": ""} if node.args.kwarg else {})
    assert isinstance(node, ast.ClassDef)
    for item in node.body:
        if isinstance(item, ast.FunctionDef) and item.name == "__init__":
            names = _arguments(module, item)
            return names if "**" not in names else _inherited(module, node) | names
    names = _inherited(module, node)
    if any("dataclass" in ast.unparse(decorator) for decorator in node.decorator_list):
        items = [item for item in node.body if isinstance(item, ast.AnnAssign)]
        names |= {ast.unparse(item.target): ast.unparse(item.annotation) for item in items}
    return names


def _inherited(module: str, node: ast.ClassDef) -> dict[str, str]:
    # A parametrized generic class `Base[Kind]` has the arguments of `Base`.
    bases = [base.value if isinstance(base, ast.Subscript) else base for base in node.bases]
    parents = [definition(module, _name(base)) for base in bases]
    names: dict[str, str] = {}
    for parent in parents:
        names |= _arguments(*parent) if parent and parent[1] is not node else {}
    return names
