"""Crafted .glb characters: one clear line or a valid file, within 10 seconds and 1 GiB."""

import copy
import json
import random
import re
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.glb import Glb, changed, odd_character, packed, write_names
from support.motions import synthetic
from support.refusals import bounded

from flame_mdm.errors import UserError
from flame_mdm.formats import glb
from flame_mdm.formats.motion import Motion

Change = Callable[[dict[str, Any]], object]
HUGE = 10**400


@pytest.fixture(scope="module")
def heroes(tmp_path_factory) -> list[Path]:
    """Valid characters: of Mixamo with a body, of Unreal below other nodes with names in a file, and of LAFAN1."""
    folder, kick = tmp_path_factory.mktemp("heroes"), synthetic("kick")
    paths = [folder / f"{name}.glb" for name in ("mixamo", "odd", "lafan1")]
    kick.save(paths[0], rig="mixamo")
    odd_character(paths[1], kick)
    write_names(paths[1].with_suffix(".yaml"))
    kick.save(paths[2], rig="lafan1")
    return paths


def outcome(path: Path, out: Path) -> str:
    """Moves a character for a few frames: "" and a valid file, or the error's one line and no file."""
    message = ""
    try:
        with bounded():
            Motion(synthetic("kick").joints[:5], 20).save(out, character=path)
            glb.read(out)
    except UserError as error:
        message = str(error)
    assert out.exists() == (not message)
    if message:
        assert re.fullmatch(f".*{re.escape(str(path))}.*", message)  # one line
    else:
        assert all(np.isfinite(values).all() for values in Glb(out).curves().values())
        out.unlink()
    return message


def item(part: str, **values: Any) -> Change:
    return lambda document: document[part][0].update(values)


node = partial(item, "nodes")


def bind(**values: Any) -> Change:
    return lambda document: document["accessors"][
        document["skins"][0]["inverseBindMatrices"]
    ].update(values)


def unbuffered(document: dict[str, Any]) -> None:
    for accessor in document["accessors"]:
        accessor.pop("bufferView")
    document["skins"][0].pop("inverseBindMatrices")
    del document["bufferViews"], document["buffers"]


def deep(document: dict[str, Any]) -> None:
    first = len(document["nodes"])
    document["nodes"] += [
        {"children": [number + 1]} for number in range(first, glb.MAX_NODES - 1)
    ] + [{}]


def many(document: dict[str, Any]) -> None:
    document["nodes"] += [
        {"name": f"bone {k}"} for k in range(len(document["nodes"]), glb.MAX_NODES)
    ]
    document["skins"][0] = {"joints": list(range(glb.MAX_NODES))}


def drawn(document: dict[str, Any]) -> None:
    document["meshes"][0]["primitives"] *= 65_000
    document["nodes"] += [{"mesh": 0, "skin": 0}] * 1000


FAULTS: dict[str, tuple[Change, str]] = {
    "child that does not exist": (node(children=[999]), "child: index 999 does not exist"),
    "two parents": (
        lambda d: d["nodes"][0]["children"].append(d["nodes"][1]["children"][0]),
        "two parents",
    ),
    "own ancestor": (lambda document: document["nodes"][21].update(children=[0]), "damaged"),
    "many nodes": (lambda document: document["nodes"].extend([{}] * 100_000), "at most 4096"),
    "chain of all nodes": (deep, ""),
    "all nodes are joints": (many, ""),
    "many primitives": (drawn, "parts of skinned meshes"),
    "nothing stored": (unbuffered, ""),
    "bool as a number": (item("bufferViews", byteOffset=True), "valid integer"),
    "large integer": (item("accessors", count=HUGE), "accessors.0.count"),
    "matrices past the end": (bind(byteOffset=10**9), "buffer"),
    "negative offset": (item("accessors", byteOffset=-4), "greater than or equal to 0"),
    "wrong matrices": (bind(componentType=5125), "inverse bind matrices"),
    "nan": (lambda document: document["nodes"][0].update(translation=[float("nan"), 0, 0]), "NaN"),
    "overflow of products": (
        lambda d: [n.update(scale=[1e8] * 3) for n in d["nodes"]],
        "not finite, or too large",
    ),
    "vanishing": (lambda d: [n.update(scale=[1e-8] * 3) for n in d["nodes"]], ""),
    "flat": (node(scale=[0, 0, 0]), ""),
    "rotation of length 0": (node(rotation=[0, 0, 0, 0]), "zero norm"),
    "matrix of 15 numbers": (node(matrix=[1] * 15), "at least 16 items"),
    "no bounds": (
        lambda document: [a.pop("min", None) for a in document["accessors"]],
        "has no bounds",
    ),
    "no document": (lambda document: document.clear(), "asset: Field required"),
}


@pytest.mark.slow
def test_faults_of_documents_are_named(heroes: list[Path], tmp_path: Path):
    """Each fault in one of the characters; whether a flat or vanishing one is written depends on the character."""
    surprises = [str(hero) for hero in heroes if outcome(hero, tmp_path / "out.glb")]
    shutil.copy(heroes[1].with_suffix(".yaml"), tmp_path / "odd.yaml")
    for number, (name, (change, message)) in enumerate(FAULTS.items()):
        hero = heroes[number % 3]
        path = Path(shutil.copy(hero, tmp_path))
        changed(path, change)
        result = outcome(path, tmp_path / "out.glb")
        if message not in result or (change in (deep, many, unbuffered) and result):
            surprises.append(f"{name}: {result}")
    assert not surprises


def test_faults_of_the_parts_of_a_file_are_named(heroes: list[Path], tmp_path: Path, subtests):
    path, whole = tmp_path / "a.glb", heroes[0].read_bytes()
    tiny = json.dumps({"asset": {"version": "2.0"}, "nodes": [{"children": [-1]}]}).encode()
    for content, message in (
        (b"", "not a .glb file"),
        (whole[:30], "ends too early"),
        (whole[:-9], "but the file is shorter"),
        (whole[:4] + b"\1\0\0\0" + whole[8:], "version 1"),
        (packed(tiny), "nodes.0.children.0"),
        (packed(b"[" * 10**6), "nested too deeply"),
        (packed(b"[1, 2]"), "valid dictionary"),
        (packed(b"{}" * 3), "Extra data"),
        (packed(b"\xff{}"), "decode"),
        (packed(b" " * (glb.DOCUMENT_LIMIT + 4)), "its first chunk"),
        (whole[:12] + b"\xff\xff\xff\xff" + whole[16:], "its first chunk"),
    ):
        with subtests.test(content=content, message=message):
            path.write_bytes(content)
            assert message in outcome(path, tmp_path / "out.glb"), content[:40]


VALUES = [
    None,
    True,
    -1,
    0,
    1,
    7,
    99,
    2**31,
    2**70,
    HUGE,
    0.5,
    -1e-300,
    1e30,
    1e308,
    "",
    "x",
    "0",
    [],
    [0],
    [-1],
    [[]],
]
VALUES += [{}, {"a": 1}, [1e9] * 3, [0] * 4, [0] * 16, [1] * 16, list(range(50)), [{}], [None]]


def mutated(value: Any, draw: random.Random) -> Any:
    """The value with one change at a random place."""
    steps: list[tuple[Any, Any]] = []
    while isinstance(value, dict | list) and value and (not steps or draw.random() < 0.85):
        key = draw.choice(list(value)) if isinstance(value, dict) else draw.randrange(len(value))
        steps.append((value, key))
        value = value[key]
    container, key = steps[-1]
    kind = draw.randrange(5)
    if kind == 0:
        del container[key]
    elif kind == 1 and isinstance(container, list):
        container.insert(key, copy.deepcopy(draw.choice([value, draw.choice(VALUES)])))
    elif kind == 2 and isinstance(value, int | float):
        container[key] = draw.choice(
            [-value, value * 10, value + 1, value - 1, value * 1e9, float(value)]
        )
    else:
        container[key] = copy.deepcopy(draw.choice(VALUES))
    return steps[0][0]


@pytest.mark.robustness
def test_mutated_characters_are_refused_or_written(heroes: list[Path], tmp_path: Path):
    draw, surprises, refused = random.Random(0), [], 0
    shutil.copy(heroes[1].with_suffix(".yaml"), tmp_path)
    for number in range(200):
        hero = heroes[number % 3]
        path = tmp_path / hero.name
        if number % 5 < 3:
            file = Glb(hero)
            for _ in range(draw.choice((1, 1, 1, 3))):
                file.document = mutated(file.document, draw)
            file.save(path)
        else:
            data = bytearray(hero.read_bytes())
            for _ in range(draw.choice((1, 4, 64))):
                data[draw.randrange(len(data) if number % 5 == 3 else 12_000)] = draw.randrange(256)
            path.write_bytes(bytes(data))
        try:
            refused += bool(outcome(path, tmp_path / "out.glb"))
        except Exception as error:
            surprises.append((number, hero.name, repr(error)[:300]))
    assert not surprises
    assert refused > 24
