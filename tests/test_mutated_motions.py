"""Mutated motion files: each gives one clear line or a motion, in 10 seconds and 1 GB at most.

The files are small copies of other programs' files and files of this project. `test_scenes.py` mutates FBX, GLB, VRMA.
"""

import io
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from support.asf import write_amc, write_asf
from support.motions import synthetic
from support.others import COLLECTED
from support.refusals import bounded

from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read

MUTATIONS = 14  # of each of 23 files: 322 in all
WORDS = (
    "nan",
    "inf",
    "-1",
    "0",
    "1e999",
    "1e18",
    "999999999",
    "",
    "x",
    "{",
    "}",
    "[",
    "]",
    ":",
    '"',
    "-1e-300",
    "null",
)
"""Replacements of numbers and names in text files."""


def _kick() -> Motion:
    motion = synthetic("kick")
    return Motion(motion.joints[:12], motion.fps, text=motion.text)


def _amc(path: Path) -> None:
    write_asf(path.with_suffix(".asf"))
    write_amc(path, 12, 0)


OWN: dict[str, Callable[[Path], object]] = {
    "ours.npz": lambda path: _kick().save(path),
    "ours.json": lambda path: _kick().save(path),
    "ours.npy": lambda path: _kick().save(path),
    "lafan1.bvh": lambda path: _kick().save(path, rig="lafan1"),
    "02_01.amc": _amc,
}
BUILDERS = {name: build for name, build in COLLECTED.items() if not name.endswith(".glb")} | OWN
FEW = [
    ("f01_stageii.npz", 0),
    ("f05_json_z_up.json", 1),
    ("f06_tpose_first.bvh", 2),
    ("ours.npy", 3),
    ("02_01.amc", 4),
]


@cache
def contents(name: str) -> dict[str, bytes]:
    """The files of a motion, by ending."""
    with TemporaryDirectory() as folder:
        BUILDERS[name](Path(folder) / name)
        return {path.suffix: path.read_bytes() for path in sorted(Path(folder).iterdir())}


def of_text(content: bytes, draw: np.random.Generator) -> bytes:
    """Text in which some words or lines are replaced, removed, repeated or exchanged."""
    lines = content.decode().split("\n")
    for _ in range(int(draw.integers(1, 4))):
        row = int(draw.integers(len(lines)))
        words = re.split(r"([ ,]+)", lines[row])
        kind = int(draw.integers(5))
        if kind <= 1:
            words[int(draw.integers(len(words)))] = WORDS[int(draw.integers(len(WORDS)))]
            lines[row] = "".join(words)
        elif kind == 2:
            del lines[row : row + int(draw.integers(1, 8))]
        elif kind == 3:
            lines[row:row] = lines[row : row + int(draw.integers(1, 8))]
        else:
            other = int(draw.integers(len(lines)))
            lines[row], lines[other] = lines[other], lines[row]
        lines = lines or [""]
    return "\n".join(lines).encode()


def of_bytes(content: bytes, draw: np.random.Generator) -> bytes:
    """Content with some bytes changed, or cut off."""
    changed = bytearray(content)
    for _ in range(int(draw.integers(1, 6))):
        begin = int(draw.integers(len(changed)))
        changed[begin : begin + 8] = draw.bytes(int(draw.integers(12)))
    return bytes(
        changed[: int(draw.integers(1, len(changed) + 1))] if draw.integers(4) == 0 else changed
    )


def of_arrays(content: bytes, draw: np.random.Generator) -> bytes:
    """An .npz file in which one array has another type, shape or value, or is missing."""
    with np.load(io.BytesIO(content), allow_pickle=True) as file:
        arrays: dict[str, Any] = dict(file)
    name = sorted(arrays)[int(draw.integers(len(arrays)))]
    arrays[name] = _changed(np.asarray(arrays[name]), draw)
    if draw.integers(8) == 0:
        del arrays[name]
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _changed(values: np.ndarray, draw: np.random.Generator) -> np.ndarray:
    kind = int(draw.integers(10))
    if kind == 0:
        return values.astype(str)
    if kind == 1:
        return values.astype(object)
    if kind == 2:
        return values[..., None]
    if kind == 3:
        return values.ravel()[: int(draw.integers(5))]
    if kind == 4:
        return values[:0] if values.ndim else values.reshape(1, 1)
    if kind == 5:
        return np.array(draw.choice([-1.0, 0.0, np.nan, np.inf, 1e30]))
    if values.dtype.kind not in "fiu" or not values.size:
        return np.arange(3)
    if kind == 6:
        return values.astype(complex)
    if kind == 7:
        return np.swapaxes(values, 0, -1) if values.ndim else values
    changed = values.astype(float).ravel()
    changed[int(draw.integers(len(changed)))] = draw.choice([np.nan, np.inf, 1e30, 1e6, -1e300])
    return (changed if kind == 8 else draw.permutation(changed)).reshape(values.shape)


def mutated(name: str, number: int) -> dict[str, bytes]:
    """The files of a motion, one of them changed as decided by a number."""
    draw = np.random.default_rng([number, *name.encode()])
    files = dict(contents(name))
    ending = sorted(files)[int(draw.integers(len(files)))]
    mutate = of_bytes
    if ending in (".bvh", ".json", ".amc", ".asf") and draw.integers(4):
        mutate = of_text
    elif ending == ".npz" and draw.integers(4):
        mutate = of_arrays
    return files | {ending: mutate(files[ending], draw)}


def check(name: str, number: int, folder: Path) -> None:
    for ending, content in mutated(name, number).items():
        (folder / name).with_suffix(ending).write_bytes(content)
    path, needs_rate = folder / name, name.endswith((".npy", ".amc"))
    message, joints = "", np.zeros(0)
    with bounded():
        try:
            joints = read(path, fps=20 if needs_rate else None).joints
        except UserError as error:
            message = str(error)
    assert np.isfinite(joints).all()
    assert bool(message) != bool(joints.size)
    assert "\n" not in message
    assert not message or path.stem in message
    assert len(message) < 3000


@pytest.mark.parametrize(("name", "number"), FEW)
def test_a_mutated_file_gives_one_line_or_a_motion(name: str, number: int, tmp_path: Path):
    check(name, number, tmp_path)


@pytest.mark.robustness
@pytest.mark.parametrize("name", BUILDERS)
def test_many_mutations_give_one_line_or_a_motion(name: str, tmp_path: Path):
    faults = []
    for number in range(MUTATIONS):
        try:
            check(name, number, tmp_path)
        except Exception as error:
            faults.append(f"{number}: {type(error).__name__}: {error}")
    assert not faults
