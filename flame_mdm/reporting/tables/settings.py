"""Hyperparameters of recipes, and tables that show them next to reported values."""

import inspect
from functools import cache
from typing import Any

from hydra.utils import get_class

from flame_mdm.config import Config, compose, instantiate, parameters, trust
from flame_mdm.errors import UserError, did_you_mean
from flame_mdm.reporting.tables.format import Cell, Line, Part
from flame_mdm.reporting.tables.specs import LABELS

HYPERPARAMETERS = LABELS["hyperparameters"]


@cache
def hyperparameters(name: str) -> dict[str, Any]:
    """Returns the `HYPERPARAMETERS` of a recipe, keyed by name.

    Unset keys have the default values of their classes.

    Raises:
        UserError: If the recipe does not exist, or if it names a class that
            `flame_mdm.config.trust` does not permit.
    """
    config = compose(name)
    # The classes of these parts are imported or instantiated below
    read = {"representation", *(key.partition(".")[0] for key in HYPERPARAMETERS if "." in key)}
    trust({part: config[part] for part in config if part in read}, f"recipe {name}")
    settings = {key: value(config, key) for key in HYPERPARAMETERS if "." in key} | _sizes(config)
    return {key: setting for key, setting in settings.items() if setting is not None}


def value(config: Config, key: str) -> Any:
    """Returns the value of a dotted key in a recipe.

    For an unset key, this is the default of the class, or None.
    """
    *path, name = key.split(".")
    node: Any = config
    for part in path:
        node = node.get(part) or {}
    if name in node:
        return node[name].rpartition(".")[2] if name == "_target_" else node[name]
    if "_target_" in node and name in parameters(node["_target_"]):
        return inspect.signature(get_class(node["_target_"])).parameters[name].default
    return None


def _sizes(config: Config) -> dict[str, float]:
    """Returns the number of features, and the denoiser's number of parameters in millions.

    The parameters of the language model are not counted.
    """
    import torch

    features = instantiate(config["representation"]).features
    if "denoiser" not in config:
        return {"features": features}
    out_features = instantiate(config["process"]).out_features(features)
    sizes = {"in_features": features, "out_features": out_features}
    with torch.device("meta"):
        denoiser = instantiate(
            config["denoiser"], **sizes, cond_features=config["condition"].get("features", 0)
        )
    return {"features": features, "parameters": sum(p.numel() for p in denoiser.parameters()) / 1e6}


def setting_text(value: Any) -> str:
    """Returns the value of a setting as the text of a table cell."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(setting_text, value))
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def settings_table(name: str, part: Config, reported: Config | None) -> Part:
    """Builds a table of hyperparameters.

    If there are more keys than recipes, the rows are keys; otherwise, they are recipes.
    """
    for key in part["keys"].values():
        if key not in HYPERPARAMETERS:
            raise UserError(
                f"part {name}: unknown setting '{key}'.{did_you_mean(key, HYPERPARAMETERS)}"
            )
    recipes = {label: hyperparameters(recipe) for label, recipe in part["recipes"].items()}
    printed = {row["label"]: row["values"] for row in reported["rows"]} if reported else {}
    ours: dict[tuple[str, str], Cell | None] = {}
    theirs: dict[tuple[str, str], Cell | None] = {}
    for label, key in part["keys"].items():
        for recipe, settings in recipes.items():
            position = (label, recipe) if len(part["keys"]) >= len(recipes) else (recipe, label)
            ours[position] = Cell(setting_text(settings[key])) if key in settings else None
            text = printed.get(label, {}).get(recipe)
            theirs[position] = None if text is None else Cell(text)
    rows, columns = (list(dict.fromkeys(names)) for names in zip(*ours, strict=True))
    lines = [Line(row, "measured", []) for row in rows]
    heads: list[str] = []
    for column in columns:
        for head, cells in ((column, ours), (f"{column}, reported", theirs)):
            if any(cells[row, column] for row in rows):
                heads.append(head)
                for line in lines:
                    line.cells.append(cells[line.label, column])
    notes = [("", f"{label}: recipe {recipe}") for label, recipe in part["recipes"].items()]
    if reported:
        notes += [
            ("", f"reported: {reported['source']}"),
            *(("", note) for note in reported.get("notes", [])),
        ]
    return Part(name, dict.fromkeys(heads, "none"), lines, notes)
