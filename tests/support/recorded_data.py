"""Help for recorded results of data sets: temporary folders, errors as results, summaries of clips."""

import shutil
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from flame_mdm.data import Clip
from support.recorded import REFUSALS


@cache
def temporary() -> "TemporaryDirectory[str]":
    """The folder of all files, which is removed at the end."""
    return TemporaryDirectory(prefix="recorded")


def folder(name: str) -> Path:
    """A new empty folder."""
    path = Path(temporary().name).resolve() / name
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    return path


def plain(text: object) -> str:
    """A text without the path of the temporary folder."""
    return str(text).replace(str(Path(temporary().name).resolve()), "TMP")


def outcome(call: Callable[[], Any]) -> Any:
    """The result of a call, or its error. Warnings are ignored."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return call()
    except REFUSALS as error:
        return f"{type(error).__name__}: {plain(error)}"


def outcomes(**calls: Callable[[], Any]) -> dict[str, Any]:
    """The results or errors of several calls."""
    return {name: outcome(call) for name, call in calls.items()}


def projected(values: Any, count: int = 4) -> Any:
    """The shape of an array and its products with random vectors, which notice small changes."""
    array = np.asarray(values)
    if not array.size:
        return list(array.shape)
    vectors = np.random.default_rng(0).normal(size=(count, array.size)) / np.sqrt(array.size)
    return [list(array.shape), str(array.dtype), *(vectors @ array.ravel().astype(float)).tolist()]


def described(clip: Clip) -> Any:
    """All fields of a clip."""
    reference = None if clip.reference is None else projected(clip.reference)
    return vars(clip) | {"motion": projected(clip.motion), "reference": reference}


def clips_of(source: Any, fps: float) -> Any:
    """Everything that a source tells about its clips."""
    clips = [described(clip) for clip in source.clips(fps)]
    return {
        "count": source.count(),
        "clips": clips,
        "counts": dict(source.counts()),
        "excluded": {plain(name): count for name, count in source.excluded.items()},
        "actions": list(source.actions),
        "options": source.options,
        "findings": [plain(text) for text in source.findings()],
        "failures": [plain(text) for text in source.failure_lines()],
        "licenses": source.licenses(),
        "published": source.published_split,
        "name": source.name,
        "version": source.version,
    }
