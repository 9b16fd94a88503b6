"""Values of an earlier version, so that a change of any result is noticed.

A test module lists cases, functions without arguments that return the results of one part of the product on many
varied inputs. `tests/golden/recorded/NAME.json` contains the summaries of their results. If a change is intended, run
the module with `PYTHONPATH=tests python tests/test_recorded_NAME.py`, look at the difference and commit the file.
"""

import inspect
import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning import seed_everything
from scipy.spatial.transform import Rotation

from flame_mdm.data.synthetic import example
from flame_mdm.data.synthetic_actions import ACTIONS
from flame_mdm.errors import UserError
from support.fixtures import GOLDEN

FOLDER = GOLDEN / "recorded"
DIGITS = 6  # of the numbers in the files
RTOL, ATOL = 1e-4, 1e-6

# The joint on the other side of each joint
MIRRORED = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20]

# Errors with which the product refuses its input. All other errors are bugs, and end the test.
REFUSALS = (UserError, ValueError, OSError, SystemExit)

Case = Callable[[], Any]


def outcome(call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Returns the result of a call, or the kind and the text of its refusal."""
    try:
        return call(*arguments, **options)
    except REFUSALS as error:
        return f"{type(error).__name__}: {error}"


def summary(value: Any) -> Any:
    """Returns a result as JSON. Of an array of more than four numbers, it holds the shape and three sums.

    The last sum has unequal weights, so that elements that change places are noticed.
    """
    if isinstance(value, torch.Tensor):
        value = (
            value.detach().to(torch.float64 if value.is_floating_point() else value.dtype).numpy()
        )
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf" and value.size > 4:
        numbers = value.astype(np.float64).ravel()
        weights = 1 + np.cos(np.arange(len(numbers)) * 1.7)
        sums = [numbers.mean(), np.abs(numbers).mean(), (numbers * weights).mean()]
        return {"shape": list(value.shape), "sums": [summary(number) for number in sums]}
    if isinstance(value, np.ndarray):
        return summary(value.tolist())
    if isinstance(value, np.generic):
        return summary(value.item())
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if np.isfinite(value) else str(value)
    if value is None or isinstance(value, bool | int | str):
        return value
    if is_dataclass(value) and not isinstance(value, type):
        return {field.name: summary(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): summary(entry) for key, entry in value.items()}
    if isinstance(value, set | frozenset):
        return sorted(map(str, value))
    if isinstance(value, Sequence):
        return [summary(entry) for entry in value]
    if isinstance(value, Iterator):
        return [summary(entry) for entry in value]
    return str(value)


def differences(value: Any, recorded: Any, path: str = "") -> list[str]:
    """Returns one line per difference between a summary and a recorded one."""
    if isinstance(value, dict) and isinstance(recorded, dict):
        return [
            line
            for key in sorted(value.keys() | recorded.keys())
            for line in differences(value.get(key), recorded.get(key), f"{path}/{key}")
        ]
    if isinstance(value, list) and isinstance(recorded, list) and len(value) == len(recorded):
        return [
            line
            for number, pair in enumerate(zip(value, recorded, strict=True))
            for line in differences(*pair, f"{path}/{number}")
        ]
    if isinstance(value, float) and isinstance(recorded, float):
        near = abs(value - recorded) <= ATOL + RTOL * abs(recorded)
        return [] if near else [f"{path}: {value}, recorded: {recorded}"]
    return [] if value == recorded else [f"{path}: {value}, recorded: {recorded}"]


def cases_of(namespace: Mapping[str, Any]) -> list[Case]:
    """Returns the cases of a test module: its public functions without parameters that return Any."""
    cases: list[Case] = []
    for name, value in namespace.items():
        function = inspect.unwrap(value) if callable(value) else None
        if not inspect.isfunction(function) or name.startswith("_"):
            continue
        signature = inspect.signature(function)
        is_defined_here = function.__module__ == namespace["__name__"]
        if is_defined_here and not signature.parameters and signature.return_annotation is Any:
            cases.append(value)
    return cases


def summary_of(case: Case) -> Any:
    """Runs a case and returns the summary of its results.

    Global random generators are seeded first, so that the results do not depend on earlier tests.
    """
    seed_everything(0, verbose=False)
    return summary(case())


def check(name: str, case: Case) -> None:
    """Compares the results of a case with the recorded ones."""
    recorded = read(name).get(case.__name__)
    assert recorded is not None, (
        f"not recorded: PYTHONPATH=tests python tests/test_recorded_{name}.py"
    )
    result = json.loads(json.dumps(summary_of(case)))
    lines = differences(result, recorded)
    assert not lines, "\n".join(lines[:20])


@cache
def read(name: str) -> dict[str, Any]:
    """The recorded summaries of a test module."""
    return json.loads(path_of(name).read_text(encoding="utf-8"))


def path_of(name: str) -> Path:
    """Where the summaries of a test module are."""
    return FOLDER / f"{name}.json"


def record(name: str, cases: Sequence[Case]) -> None:
    """Writes the summaries of all cases of a test module."""
    summaries = {case.__name__: summary_of(case) for case in cases}
    FOLDER.mkdir(exist_ok=True)
    text = json.dumps(summaries, ensure_ascii=False, separators=(",", ":"))
    path_of(name).write_text(text.replace('},"', '},\n"') + "\n", encoding="utf-8")


def combinations(seed: int, count: int, /, **choices: Sequence[Any]) -> list[dict[str, Any]]:
    """Returns different random combinations of choices; all of them if there are at most `count`."""
    every = [dict(zip(choices, row, strict=True)) for row in itertools.product(*choices.values())]
    order = np.random.default_rng(seed).permutation(len(every))
    return [every[number] for number in order[:count]]


@cache
def bodies(fps: float = 20.0) -> dict[str, np.ndarray]:
    """Joint positions (F, 22, 3) in meters of many motions, by name, for one frame rate.

    There is one motion per synthetic action. For each of them, there are also variants of three kinds, chosen in turn:
    turned about the vertical so that its heading passes 180 degrees, with the legs of another action, with one arm that
    rests, mirrored, with jitter, or away from the origin and slower.
    """
    rng = np.random.default_rng(7)
    plain = {name: example({"action": name}, fps).astype(np.float64) for name in ACTIONS}
    motions = dict(plain)
    legs, left_arm = [1, 2, 4, 5, 7, 8, 10, 11], [16, 18, 20]
    names = list(plain)
    for number, (name, motion) in enumerate(plain.items()):
        angles = np.linspace(2.6, 3.9, len(motion))
        turned = np.einsum(
            "fij,fkj->fki", Rotation.from_euler("y", angles[:, None]).as_matrix(), motion
        )
        other = plain[names[(number * 7 + 3) % len(names)]]
        mixed = motion.copy()
        mixed[:, legs] = other[:, legs] - other[:, :1] + motion[:, :1]
        resting = motion.copy()
        resting[:, left_arm] = motion[:1, left_arm] - motion[:1, :1] + motion[:, :1]
        noisy = motion + rng.normal(0, 0.01, motion.shape)
        slow = np.repeat(motion, 2, axis=0)[: len(motion)] + np.array([3.0, 0.0, -2.0])
        kinds = [
            ("turned", turned), ("mixed", mixed), ("resting", resting),
            ("mirrored", (motion * [-1.0, 1.0, 1.0])[:, MIRRORED]), ("noisy", noisy), ("slow", slow),
        ]  # fmt: skip
        for offset in range(3):
            kind, variant = kinds[(number + 2 * offset) % len(kinds)]
            motions[f"{name}, {kind}"] = variant
    return motions


def some_bodies(count: int, fps: float = 20.0, seed: int = 0) -> dict[str, np.ndarray]:
    """A random choice of `bodies`."""
    motions = bodies(fps)
    names = sorted(motions)
    chosen = np.random.default_rng(seed).permutation(len(names))[:count]
    return {names[number]: motions[names[number]] for number in chosen}
