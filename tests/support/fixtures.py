"""Where the numbers computed with the authors' code are found.

`FLAME_MDM_GOLDEN` replaces the folder of portable fixtures by another set of the same layout. Fixtures that hold data
or weights of third parties are read from `FLAME_MDM_SHARED` (default: a folder `shared` beside the repository); tests
that need them skip where that folder is absent.
"""

import json
import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from flame_mdm.config import compose

ROOT = Path(__file__).parent.parent.parent
GOLDEN = Path(os.environ.get("FLAME_MDM_GOLDEN", ROOT / "tests" / "golden"))
SHARED = Path(os.environ.get("FLAME_MDM_SHARED", ROOT.parent / "shared"))

Arrays = dict[str, np.ndarray]

recipe = cache(compose)
"""Composed recipes by name, shared by the test modules of a process."""

needs_third_party = pytest.mark.skipif(
    not SHARED.is_dir(), reason=f"third-party fixtures are not redistributed and {SHARED} does not exist"
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


def meta(arrays: Arrays) -> dict:
    """The options a fixture was made with."""
    return json.loads(str(arrays["meta"]))


def groups(arrays: Arrays, suffix: str) -> list[str]:
    """The cases of a fixture: every prefix P with a key `P/suffix`."""
    return sorted(key.removesuffix(f"/{suffix}") for key in arrays if key.endswith(f"/{suffix}"))
