"""Readers for the tables of words. The extension contains them as JSON, because Blender has no YAML."""

import json
from pathlib import Path
from typing import Any

import numpy as np


def read_package_yaml(path: Path) -> Any:
    """Returns the contents of the JSON file that replaces a YAML file of the package."""
    return json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))


def read_npz(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays in a file of the package."""
    with np.load(path, allow_pickle=False) as arrays:
        return dict(arrays)
