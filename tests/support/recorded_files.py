"""Temporary files and short motions, for tests with recorded results."""

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.formats.motion import Motion
from support.outcomes import without
from support.recorded import some_bodies


def without_paths(folder: Path, value: Any) -> Any:
    """A value whose texts have short names for a folder and for skeleton files."""
    if isinstance(value, dict):
        return {key: without_paths(folder, entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [without_paths(folder, entry) for entry in value]
    if not isinstance(value, str):
        return value
    text = re.sub(r"[./]*FOLDER", "FOLDER", without(folder, value))
    # Labels name a skeleton file by its path from the working folder.
    return re.sub(r"\([^()]*/skeleton\.yaml\)", "(skeleton.yaml)", text)


@cache
def motions(count: int = 6, fps: float = 20.0, frames: int = 24) -> list[Motion]:
    """Bodies whose bones change their lengths a little."""
    rng = np.random.default_rng(2)
    stretch = 1 + 0.04 * np.sin(np.arange(frames) / 3)[:, None, None]
    return [
        Motion(
            joints[:frames] * stretch * rng.uniform(0.85, 1.15),
            fps,
            text=f"a {name} body",
            id=name,
            contacts=rng.uniform(size=(frames, 4)) > 0.5,
        )
        for name, joints in some_bodies(count, fps, 7).items()
    ]
