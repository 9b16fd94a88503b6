"""Composes recipes with Hydra and resolves them to plain dicts."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from flame_mdm.config.building import EXPERIMENTS, RUN_DIR, plain, renamed
from flame_mdm.config.signatures import (
    Config,
    check,
    check_same_kinds,
    check_top_level,
    parameters,
    source_file,
    unknown_key,
)
from flame_mdm.errors import UserError, did_you_mean, first_line
from flame_mdm.safe_io import read_yaml

LAUNCH = "launch"  # folder in `experiments/` of the launchers, which start jobs on a cluster


def groups() -> list[str]:
    """Returns the names of the parts that can be replaced in a recipe.

    These are the names of the folders in `experiments/` that contain options for a part instead of
    recipes.
    """
    folders = {name.partition("/")[0] for name in recipes()}
    return sorted(p.name for p in EXPERIMENTS.iterdir() if p.is_dir() and p.name not in folders)


def recipes() -> list[str]:
    """Returns the names of all experiments, as used in `EXP=`."""
    files = (p for p in EXPERIMENTS.rglob("*.yaml") if "@package _global_" in p.read_text()[:200])
    return sorted(p.relative_to(EXPERIMENTS).with_suffix("").as_posix() for p in files)


def compose(name: str, overrides: Sequence[str] = ()) -> Config:
    """Composes a recipe and checks every key against the signature of its class.

    Args:
        name: a name in `experiments/`, or the path of a .yaml file.
        overrides: words such as `denoiser=mdm_unet` or `optimizer.lr=1e-4`.

    Raises:
        UserError: If a recipe, group or key is unknown, or if a value has the wrong type.
    """
    source = find_recipe(name)
    return resolve(source, *prepare_overrides(source, overrides))


def compose_data(name: str, overrides: Sequence[str] = (), *, data_root: str = "data") -> Config:
    """Composes the configuration of a data set in experiments/data, including its representation.

    The result has the keys `data` and `representation`. Raises the same errors as `compose`.
    """
    source = ConfigSource(EXPERIMENTS, None)
    first = [quoted(f"+data_root={data_root}")]
    config = resolve(source, *prepare_overrides(source, [f"+data={name}", *overrides], first))
    return {key: config[key] for key in ("data", "representation")}


class ConfigSource(NamedTuple):
    """Location and kind of a configuration."""

    folder: Path
    # Name of the file in `folder`, without suffix, or None for an empty configuration
    stem: str | None
    # Whether the configuration is already resolved, so that its parts cannot be replaced
    saved: bool = False


def prepare_overrides(
    recipe: ConfigSource, overrides: Sequence[str], first: Sequence[str] = ()
) -> tuple[list[str], Config]:
    """Checks the overrides (except those in `first`) and prepares them for Hydra.

    Keys that are missing from the recipe but accepted by a `_target_` get the prefix `++`. Returns
    the prepared overrides and the composed recipe. In this recipe, groups have been replaced, but
    individual keys have not been overridden yet. The recipe is {} if there are no overrides.
    """
    parsed = parse(overrides)
    _check_groups(parsed, recipe)
    if recipe.saved:  # the parts are fixed, so only a launcher can be added
        parsed = parse(
            [f"+{word}" if word.startswith(f"{LAUNCH}=") else word for word in overrides]
        )
    first = [
        *first,
        *([f"hydra.searchpath=[file://{EXPERIMENTS}]"] if recipe.folder != EXPERIMENTS else []),
    ]
    if recipe.stem and not recipe.saved:
        first.append(f"experiment={recipe.stem}")
    if not parsed:
        return first, {}  # there is nothing to compare with the recipe
    parts = [o for o in parsed if _is_group(o)]
    composed = resolve(recipe, [*first, *map(first_choice, parts)])
    keys = [_legal(composed, o) for o in parsed if not _is_group(o)]
    return [*first, *(str(o.input_line) for o in parts), *keys], composed


def first_choice(override: Override) -> str:
    """Returns the override as text, with only the first value if it sweeps over several values."""
    if override.is_sweep_override():
        return f"{override.get_key_element()}={choices(override)[0]}"
    return str(override.input_line)


def choices(override: Override) -> list[str]:
    """Returns the values of an override as text: a single value, or all values of a sweep."""
    value = override.value()
    if isinstance(value, Glob):
        return value.filter(_options(override.key_or_group)) or [str(value)]
    return list(override.sweep_string_iterator()) if override.is_sweep_override() else [str(value)]


def _options(group: str) -> list[str]:
    return sorted(p.stem for p in (EXPERIMENTS / group).glob("*.yaml"))


def find_recipe(name: str) -> ConfigSource:
    """Returns the location of an experiment's recipe.

    `name` is the path of a .yaml file, or a name in `experiments/`, such as `humanml3d/mdm`. Raises
    `UserError` if no such file or experiment exists.
    """
    if name.endswith((".yaml", ".yml")):
        path = Path(name).resolve()
        if not path.is_file():
            raise UserError(
                f"{name}: no such file. Use the name of an experiment, or the path of a config.yaml"
            )
        content = read_yaml(path)
        if not isinstance(content, dict):
            raise UserError(
                f"{name} is not a recipe, because it has no keys. Start it with a "
                "`defaults:` list that names another recipe"
            )
        saved = "defaults" not in content
        if saved:
            plain(content, name, but=RUN_DIR)
        return ConfigSource(path.parent, path.stem, saved)
    if name not in recipes():
        raise UserError(
            f"unknown experiment '{name}'.{did_you_mean(name, recipes())} `flame-mdm train --help` lists them all"
        )
    return ConfigSource(EXPERIMENTS, name)


def quoted(word: str) -> str:
    """Quotes a word `key=value` so that Hydra takes its value literally."""
    key, _, value = word.partition("=")
    # Hydra takes a backslash literally, except right before a quote, where it must be doubled.
    escaped = re.sub(r"(\\*)('|$)", lambda m: m[1] * 2 + ("\\'" if m[2] else ""), value).replace(
        "${", "\\${"
    )
    return f"{key}='{escaped}'"


def parse(overrides: Sequence[str]) -> list[Override]:
    """Parses overrides in Hydra's grammar.

    Raises a `UserError` with advice if an override cannot be parsed.
    """
    try:
        return OverridesParser.create().parse_overrides(list(overrides))
    except HydraException as error:
        hint = "Write key=value, and quote text: 'a b'"
        raise UserError(f"cannot read an override: {first_line(error)}. {hint}") from error


def _is_group(override: Override) -> bool:
    return (EXPERIMENTS / override.key_or_group).is_dir()


def _check_groups(overrides: Sequence[Override], recipe: ConfigSource) -> None:
    for override in overrides:
        group = override.key_or_group
        if _is_group(override) and recipe.saved and group != LAUNCH:
            raise UserError(
                f"{override.input_line} replaces a part of a recipe, but {recipe.stem}.yaml is a saved "
                "configuration, whose parts are fixed. Start from the experiment, or override individual keys"
            )
        if not _is_group(override) or override.is_delete():
            continue
        options = _options(group)
        for option in choices(override):
            if option not in options:
                raise UserError(
                    f"unknown {group} '{option}'.{did_you_mean(option, options)} Available: {', '.join(options)}"
                )
        if group == LAUNCH and source_file("submitit") is None:
            raise UserError(
                f'{override.input_line} requires hydra-submitit-launcher. Run pip install "flame-mdm[slurm]"'
            )


def resolve(source: ConfigSource, overrides: list[str], base: Config | None = None) -> Config:
    """Composes a configuration with prepared overrides.

    If `base` is given, the values must have the same types as in `base`.
    """
    config = compose_unchecked(source, overrides)
    if base is not None:
        check_same_kinds(base, config)
        check_top_level(config)
        check(config)
    return config


def compose_unchecked(source: ConfigSource, overrides: list[str]) -> Config:
    """Composes a configuration with prepared overrides; re-raises Hydra's errors as `UserError`."""
    GlobalHydra.instance().clear()
    try:
        with initialize_config_dir(version_base="1.3", config_dir=str(source.folder)):
            composed = hydra_compose(source.stem, overrides)
            resolved = OmegaConf.to_container(composed, resolve=True, throw_on_missing=True)
    except (HydraException, OmegaConfBaseException, ValueError, TypeError, RecursionError) as error:
        raise UserError(f"{source.stem or 'data'}: {first_line(error)}") from error
    return renamed({str(key): value for key, value in resolved.items()})  # type: ignore[union-attr]


def _legal(config: Config, override: Override) -> str:
    """Checks the key of an override and returns the override as text for Hydra.

    Raises `UserError` if the key exists neither in the recipe nor in the signature of a `_target_`.
    """
    line = str(override.input_line)
    if (
        override.is_delete()
        or override.is_force_add()
        or override.is_add()
        or line.startswith("hydra.")
    ):
        return line
    node: Any = config
    parts = override.key_or_group.split(".")
    for depth, part in enumerate(parts):
        if isinstance(node, Mapping) and part in node:
            node = node[part]
        elif (
            isinstance(node, Mapping)
            and "_target_" in node
            and part in parameters(node["_target_"])
        ):
            return "++" + line
        elif isinstance(node, list) and part.isdigit() and int(part) < len(node):
            node = node[int(part)]
        else:
            raise UserError(unknown_key(config, parts, depth, node))
    return line
