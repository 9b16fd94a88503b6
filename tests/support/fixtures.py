"""Where the numbers computed with the authors' code are found.

`FLAME_MDM_GOLDEN` replaces the folder of portable fixtures by another set of the same layout. Fixtures that hold data
or weights of third parties are read from `FLAME_MDM_SHARED` (default: a folder `shared` beside the repository); tests
that need them skip where that folder is absent.
"""

import hashlib
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from copy import deepcopy
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import hydra
import numpy as np
import pytest
import torch
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import IConfigRepository
from hydra._internal.core_plugins import file_config_source, importlib_resources_config_source
from hydra._internal.defaults_list import DefaultsList
from hydra.core.default_element import ResultDefault
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf

from flame_mdm.config import Config, compose, recipes
from flame_mdm.config.composition import EXPERIMENTS, ConfigSource
from flame_mdm.safe_io import read_package_yaml, write_json

ROOT = Path(__file__).parent.parent.parent
GOLDEN = Path(os.environ.get("FLAME_MDM_GOLDEN", ROOT / "tests" / "golden"))
SHARED = Path(os.environ.get("FLAME_MDM_SHARED", ROOT.parent / "shared"))

Arrays = dict[str, np.ndarray]

GENERATION = [
    name for name in recipes() if name.partition("/")[0] not in ("classifier", "motion_clip", "t2m")
]
"""Names of the recipes of models that generate motions."""


@cache
def python_with(package: str, variable: str) -> str:
    """A Python that has a package: the one that an environment variable names, or this one; tests skip without it."""
    python = os.environ.get(variable, sys.executable)
    if subprocess.run(
        [python, "-c", f"import {package}"], capture_output=True, check=False
    ).returncode:
        pytest.skip(f"no package {package}: set {variable} to a Python that has it")
    return python


def blender() -> str:
    """A Python that has the package bpy."""
    return python_with("bpy", "FLAME_MDM_BLENDER")


def script(path: str) -> Any:
    """The module in a file of the repository that is in no package, such as tools/web.py."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def recipe(name: str) -> dict[str, Any]:
    """The composed recipe."""
    return compose(name)


def compositions_once(compose_unchecked: Callable[..., Config]) -> Callable[..., Config]:
    """Makes `composition.compose_unchecked` compose a recipe once for all test processes, and a command once for each.

    Nearly every command composes the recipe that its overrides are compared with. A composition
    takes a quarter of a second.
    """

    @lru_cache(200)
    def composed(source: ConfigSource, overrides: tuple[str, ...], data_root: str | None) -> Config:
        if data_root is not None or overrides != (f"experiment={source.stem}",):
            return compose_unchecked(source, list(overrides))
        name = f"{str(source.stem).replace('/', '.')}.json"
        file = ROOT / ".pytest_cache" / f"recipes-{_digest()}" / name
        if not file.exists():
            write_json(file, compose_unchecked(source, list(overrides)))
        return json.loads(file.read_text())

    def once(source: ConfigSource, overrides: list[str]) -> Config:
        if source.folder != EXPERIMENTS:
            return compose_unchecked(source, overrides)
        # The only variable of the environment that a recipe reads
        data_root = os.environ.get("FLAME_MDM_DATA")
        return deepcopy(composed(source, tuple(overrides), data_root))

    return once


FIXED = (EXPERIMENTS, Path(hydra.__file__).parent)
"""Folders of the YAML files of recipes and of Hydra's own configuration."""
_parsed = cache(read_package_yaml)


class ParsedOnce(OmegaConf):
    """OmegaConf for Hydra, which otherwise parses the files of a recipe again for every composition."""

    @staticmethod
    def load(file_: Any) -> Any:
        path = Path(file_.name)
        if not any(path.is_relative_to(folder) for folder in FIXED):
            return OmegaConf.load(file_)
        return OmegaConf.create(_parsed(path) or {})


def parts_once() -> None:
    """Makes Hydra parse each file once, and find and merge the parts of a recipe once for each choice of parts.

    This takes two thirds of a composition. Words that set single keys are then applied to a copy.
    """
    find: Callable[..., DefaultsList] = config_loader_impl.__dict__["create_defaults_list"]
    merge = ConfigLoaderImpl._compose_config_from_defaults_list
    lists: dict[tuple[object, ...], DefaultsList] = {}
    merged: dict[tuple[str, ...], DictConfig] = {}

    def is_fixed(repo: IConfigRepository) -> bool:
        """Whether all parts come from the package; somebody's own recipe may change."""
        folders = {source.path for source in repo.get_sources() if source.scheme() == "file"}
        return folders == {str(EXPERIMENTS)}

    def find_once(
        repo: IConfigRepository,
        config_name: str | None,
        overrides_list: list[Override],
        **options: bool,
    ) -> DefaultsList:
        if not is_fixed(repo) or any(word.is_sweep_override() for word in overrides_list):
            return find(repo, config_name, overrides_list, **options)
        keys = [
            word
            for word in overrides_list
            if isinstance(word.value(), dict) or not repo.group_exists(word.key_or_group)
        ]
        parts = [word for word in overrides_list if word not in keys]
        key = (config_name, *options.values(), *(word.input_line for word in parts))
        if key not in lists:
            lists[key] = find(repo, config_name, parts, **options)
        return replace(lists[key], config_overrides=keys)

    def merge_once(
        self: ConfigLoaderImpl, defaults: list[ResultDefault], repo: IConfigRepository
    ) -> DictConfig:
        if not is_fixed(repo):
            return merge(self, defaults, repo)
        key = tuple(map(repr, defaults))
        if key not in merged:
            merged[key] = merge(self, defaults, repo)
        return deepcopy(merged[key])

    Plugins.instance()  # loads the modules of the sources, so they are changed afterwards
    for source in (file_config_source, importlib_resources_config_source):
        source.__dict__["OmegaConf"] = ParsedOnce
    config_loader_impl.__dict__["create_defaults_list"] = find_once
    ConfigLoaderImpl._compose_config_from_defaults_list = merge_once


@cache
def _digest() -> str:
    """Hash of all files that decide how a recipe is composed."""
    files = [*(ROOT / "experiments").rglob("*.yaml"), *(ROOT / "flame_mdm" / "config").glob("*.py")]
    content = b"".join(
        str(path.relative_to(ROOT)).encode() + path.read_bytes() for path in sorted(files)
    )
    return hashlib.sha256(content).hexdigest()[:16]


needs_third_party = pytest.mark.skipif(
    not SHARED.is_dir(),
    reason=f"third-party fixtures are not redistributed and {SHARED} does not exist",
)


@cache
def golden(stem: str) -> Arrays:
    """Arrays of a portable fixture by key."""
    return load(GOLDEN / f"{stem}.npz")


@cache
def third_party(stem: str) -> Arrays:
    """Arrays of a third-party fixture by key; empty where the shared folder is absent, so that collection works."""
    return load(SHARED / "golden" / "third_party" / f"{stem}.npz") if SHARED.is_dir() else {}


def load(path: Path) -> Arrays:
    with np.load(path, allow_pickle=False) as file:
        return {key: file[key] for key in file.files}


def tensors(arrays: Arrays) -> dict[str, torch.Tensor]:
    """The numbers of a fixture."""
    return {
        key: torch.from_numpy(value) for key, value in arrays.items() if value.dtype.kind in "fi"
    }


def meta(arrays: Arrays) -> dict:
    """The options a fixture was made with."""
    return json.loads(str(arrays["meta"]))


def groups(arrays: Arrays, suffix: str) -> list[str]:
    """The cases of a fixture: every prefix P with a key `P/suffix`."""
    return sorted(key.removesuffix(f"/{suffix}") for key in arrays if key.endswith(f"/{suffix}"))


def weights(arrays: Arrays, prefix: str = "state/") -> dict[str, torch.Tensor]:
    """The state dict of a fixture."""
    return {
        name.removeprefix(prefix): torch.from_numpy(x)
        for name, x in arrays.items()
        if name.startswith(prefix)
    }


def assert_within(ours: torch.Tensor, arrays: Arrays, name: str, like: str | None = None) -> None:
    """Within ten times of what the authors' float32 differs from their float64."""
    tolerance = 10 * meta(arrays)["max_abs_diff_f32_vs_f64"][like or name][0]
    torch.testing.assert_close(ours, torch.from_numpy(arrays[name]), atol=tolerance, rtol=0)


def golden_cases(
    stem: str, cases: Iterable[str]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Marks a test on each `case` of a fixture, with the fixture's name in its id."""
    parameters = pytest.mark.parametrize(
        "case", [pytest.param(case, id=f"{stem}-{case}") for case in cases]
    )
    return lambda test: pytest.mark.golden(parameters(test))


def golden_case(stem: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Marks a test on a single case, and gives it an id with the fixture's name."""
    return lambda test: pytest.mark.golden(pytest.mark.parametrize("stem", [stem])(test))
