"""Temporary files and short motions, for tests with recorded results."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from flame_mdm.formats.motion import Motion
from support.recorded import some_bodies


@contextmanager
def folder_of_files() -> Iterator[Path]:
    with TemporaryDirectory(prefix="recorded") as folder:
        yield Path(folder).resolve()


def without(folder: Path, value: Any) -> Any:
    """The value with a short name for a folder in all its texts."""
    if isinstance(value, str):
        named = re.sub(r"[./]*FOLDER", "FOLDER", value.replace(str(folder), "FOLDER"))
        # Labels name a skeleton file by its path from the working folder.
        return re.sub(r"\([^()]*/skeleton\.yaml\)", "(skeleton.yaml)", named)
    if isinstance(value, dict):
        return {key: without(folder, entry) for key, entry in value.items()}
    return [without(folder, entry) for entry in value] if isinstance(value, list | tuple) else value


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
