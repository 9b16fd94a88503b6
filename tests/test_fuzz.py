"""Malformed input of every kind through every command: one line `error: ...`, nothing written, no traceback, no hang.

`make test` takes a share of the cases, always the same one; `make test-robustness` takes all of them.
"""

import io
import json
import os
import pickle
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.fixtures import ROOT
from support.pages import a_run
from support.refusals import one_line
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.formats.motion import END_SITES
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import ADULT
from flame_mdm.safe_io import read_yaml

pytestmark = pytest.mark.slow

TEXT = "text=a person walks"
CASES: dict[str, Any] = read_yaml(ROOT / "tests" / "support" / "refused.yaml")
BVH_FRAMES = 3


def body(frames: int) -> np.ndarray:
    """(F, 22, 3), somebody who stands and sways."""
    joints = np.zeros((frames, 22, 3))
    for joint, parent in enumerate(SMPL22.parents):
        joints[:, joint] = np.array(ADULT)[joint] + (joints[:, parent] if parent >= 0 else 0)
    joints[..., 1] -= joints[..., 1].min()
    return (joints + 0.01 * np.sin(np.arange(frames) / 5)[:, None, None]).astype(np.float32)


@pytest.fixture
def fill(bad, trained, tmp_path) -> Callable[[str], str]:
    """Fills the names of files into a word of a case, and makes the files."""
    np.savez(tmp_path / "walk.npz", joints=body(30), fps=20.0)
    run, other = a_run(bad / "run"), a_run(bad / "other", name="two")
    os.mkfifo(bad / "pipe.npz")
    for name in ("folder.npz", "folder.yaml", "folder.txt", "empty"):
        (bad / name).mkdir()
    texts = {"list.yaml": "- 1\n", "broken.yaml": "a: [\n", "bare.yaml": "name: x\n", "empty.txt": "\n \n"}
    texts |= {"foreign.yaml": "_target_: os.system\ncommand: ls\n", "file.zip": "x"}
    texts |= {"part.yaml": "version: 1\ncondition: text\n"}
    for name, text in texts.items():
        (bad / name).write_text(text)
    for name in ("latin.yaml", "latin.txt"):
        (bad / name).write_bytes(b"seed: \xe9\xff\n")
    words = {"trained": trained, "bad": bad, "walk": tmp_path / "walk.npz", "long": "x" * 5000}
    words |= {"run": run, "both": f"runs={run} {other}"}

    def fill(word: str) -> str:
        for name, value in words.items():
            word = word.replace(f"{{{name}}}", str(value))
        return word

    return fill


# Words of command lines -----------------------------------------------------------------------------------------------

MISSPELT = ("=", "=1", "==", "no", "-x", "--nope", "é=1", "a..b=1", ".=1", "a.=1", "~", "~nothing", "+=1", "\x1b[31m=1")
MISSPELT += ("\u202e=1", "seed", "seed=1=", "seed=${seed}", "data=", "data=../base", "data=[a]", "seed=[${seed}]")
MISSPELT += ("@a=1", "seed=[", "seed={a", "seed='", "seed=${nothing}", "seed=${oc.env:NOT_SET_ANYWHERE}", "seed=a}b")
KEYS = {"train": "seed", "sample": "seconds", "edit": "region", "evaluate": "protocol", "prepare": "source"}
KEYS |= {"browse": "split", "convert": "unit", "tables": "table", "benchmark": "device", "compare": "texts"}


@pytest.mark.parametrize("command", KEYS)
def test_misspelled_words(refused, command):
    refused.every = 2
    first = ["quickstart"] if command == "train" else []
    for word in (*MISSPELT, f"{KEYS[command]}q=1", f"{KEYS[command]}.deeper=1", f"~{KEYS[command]}"):
        refused(command, *first, word)


@pytest.mark.parametrize("command", CASES["words"])
def test_words(refused, fill, command):
    refused.every = 4
    more = {"browse": ["data.source.clips=60"], "tables": ["evaluate=false"]}.get(command, [])
    for words in CASES["words"][command]:
        refused(command, *map(fill, words), *more)


def test_settings_of_training(refused, tmp_path, data_root):
    refused.every = 9
    refused.watched = [data_root]  # a run that has begun to log leaves its folder
    tiny = [*TINY, f"data_root={data_root}", "callbacks.best=null", "trainer.max_steps=1", "logger=csv"]
    for key, values in CASES["values"]["train quickstart"].items():
        for value in values:
            words = [word for word in tiny if not word.startswith(f"{key}=")]
            folder = [f"run.dir=run{refused.count}"] if key not in ("run", "run.dir") else []
            refused("train", "quickstart", *words, *folder, f"{key}={value}")
    assert not list((tmp_path / "here").rglob("*.ckpt"))  # but nothing is trained


def test_values(refused, fill):
    refused.every = 6
    for key, values in CASES["values"]["sample"].items():
        for value in values:
            refused("sample", f"ckpt={fill('{trained}')}", TEXT, f"{key}={fill(value)}")
    for key, values in CASES["values"]["edit"].items():
        extra = [] if key in ("region", "region_seconds", "joints") else ["region=in_between"]
        extra += ["motion=synthetic:000000"] if key == "data_root" else []
        for value in values:
            refused("edit", fill("ckpt={trained}"), fill("motion={walk}"), TEXT, *extra, f"{key}={value}")
    for key, values in CASES["values"]["evaluate"].items():
        extra = [] if key == "extractor" else ["extractor=none"]
        if key == "from_samples":
            extra += ["ckpt=null", "data=synthetic", "data.source.clips=60", "protocol=synthetic"]
        for value in values:
            refused("evaluate", fill("ckpt={trained}"), "quick=true", *extra, f"{key}={fill(value)}")


def test_recipes(refused, bad):
    refused.every = 2
    whole = "# @package _global_\ndefaults:\n  - /quickstart\n  - _self_\ntrainer: {max_steps: 5}\n"
    for text in (*CASES["recipes"], *(f"{whole}{line}\n" for line in CASES["recipe_lines"])):
        path = bad / f"recipe{refused.count}.yaml"
        path.write_bytes(text.encode())
        refused("train", str(path))


# Checkpoints ----------------------------------------------------------------------------------------------------------


def mangled(data: bytes, count: int, seed: int) -> Iterator[bytes]:
    """The data cut at, with bytes changed at, or with garbage at random positions."""
    draw = np.random.default_rng(seed)
    yield from (b"", b"\0" * 100, data[:1], data[:-1], data[: len(data) // 2], b"PK\3\4" + data)
    for number in range(count - 6):
        at = int(draw.integers(len(data)))
        if number % 3 == 0:
            yield data[:at]
        elif number % 3 == 1:
            yield data[:at] + bytes([data[at] ^ int(draw.integers(1, 256))]) + data[at + 1 :]
        else:
            yield data[:at] + draw.bytes(int(draw.integers(1, 50))) + data[at + 20 :]


class Bomb:
    """What an untrusted pickle may hold: unpickled, it makes a file in the current folder."""

    def __reduce__(self):
        return os.system, ("touch owned",)


def foreign(content: dict[str, Any]) -> Iterator[Any]:
    """Checkpoints that PyTorch can write and that are none of this framework, or hold nonsense."""
    yield from ([], 3, "text", None, {}, {"state_dict": {}}, torch.zeros(3), Bomb())
    yield {"config": Bomb(), "facts": {}, "state_dict": {}}
    for key in ("config", "facts", "state_dict"):
        for value in ([], 3, "text", None, {}, {"a": "b"}, {1: 2}):
            yield content | {key: value}
    for part in ("task", "denoiser", "process", "condition", "representation"):
        for value in (None, 3, {}, {"_target_": "os.system"}, {"_target_": "torch.nn.Linear"}, {"_target_": 3}):
            yield content | {"config": content["config"] | {part: value}}
    name = next(iter(content["state_dict"]))
    for value in (torch.zeros(3), "x", None, torch.zeros(0)):
        yield content | {"state_dict": content["state_dict"] | {name: value}}
    yield content | {"state_dict": {f"x{key}": value for key, value in content["state_dict"].items()}}
    for key, value in (
        ("actions", None),
        ("actions", 3),
        ("max_frames", None),
        ("max_frames", "x"),
        ("max_frames", -1),
    ):
        yield content | {"facts": content["facts"] | {key: value}}


def test_foreign_checkpoints(refused, trained, bad):
    refused.every = 5
    path = bad / "bad.ckpt"
    for number, value in enumerate(foreign(read_checkpoint(trained))):
        torch.save(value, path)
        refused("sample", f"ckpt={path}", TEXT)
        if number % 10 == 0:
            refused("evaluate", f"ckpt={path}", "extractor=none", "quick=true")
            refused("import", "mdm", str(path), str(trained), "out=out.safetensors")
    refused.every = 1
    path.write_bytes(pickle.dumps(Bomb()))
    for words in (
        ["sample", f"ckpt={path}", TEXT],
        ["export", str(path), "out=x"],
        ["import", "flame", str(path), "out=x"],
    ):
        refused(*words)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("readme.txt", "hello")
    refused("sample", f"ckpt={path}", TEXT)


def test_damaged_checkpoints(refused, trained, bad):
    refused.every = 6
    for suffix, data in (("ckpt", trained.read_bytes()), ("safetensors", exported(trained, bad))):
        path = bad / f"bad.{suffix}"
        for number, content in enumerate(mangled(data, 60, 2)):
            path.write_bytes(content)
            refused("export", str(path), "out=out.safetensors")
            if number % 6 == 0:
                refused("sample", f"ckpt={path}", TEXT)
                refused("evaluate", f"ckpt={path}", "extractor=none", "quick=true")
                refused("push", str(path), "a/b", "dry_run=true")


def exported(trained: Path, folder: Path) -> bytes:
    """A model file of the checkpoint."""
    from flame_mdm.checkpoints.hub import export

    file = export(trained, folder / "whole.safetensors")
    data = file.read_bytes()
    file.unlink()
    return data


def test_damaged_metadata_of_model_files(refused, trained, bad):
    data, path = exported(trained, bad), bad / "bad.safetensors"
    size = int.from_bytes(data[:8], "little")
    head = json.loads(data[8 : 8 + size])
    recipe = json.loads(head["__metadata__"]["flame_mdm"])
    for change in (None, {"format": 99}, {"config": None}, {"config": {}}, {"facts": 3}, {"sha256": ""}):
        text = "{" if change is None else json.dumps(recipe | change)
        changed = json.dumps(head | {"__metadata__": {"flame_mdm": text}}).encode()
        path.write_bytes(len(changed).to_bytes(8, "little") + changed + data[8 + size :])
        refused("sample", f"ckpt={path}", TEXT)


# Motion files ---------------------------------------------------------------------------------------------------------


def bvh() -> str:
    """A whole BVH file of SMPL's joints, in centimeters."""

    def joint(index: int) -> list[str]:
        offset = " ".join(f"{100 * x:.3f}" for x in ADULT[index])
        channels = "3" if index else "6 Xposition Yposition Zposition"
        lines = [f"{'JOINT' if index else 'ROOT'} {SMPL22.joints[index]}", "{", f"OFFSET {offset}"]
        lines.append(f"CHANNELS {channels} Zrotation Xrotation Yrotation")
        for child, parent in enumerate(SMPL22.parents):
            lines += joint(child) if parent == index else []
        if SMPL22.joints[index] in END_SITES:
            lines += ["End Site", "{", "OFFSET 0 1 0", "}"]
        return [*lines, "}"]

    rows = [" ".join(["0 90 0", *["0"] * 66])] * BVH_FRAMES
    return "\n".join(["HIERARCHY", *joint(0), "MOTION", f"Frames: {BVH_FRAMES}", "Frame Time: 0.05", *rows]) + "\n"


def broken_bvh() -> Iterator[str]:
    whole = bvh()
    yield from ("", "HIERARCHY", "HIERARCHY\nMOTION\nFrames: 0\nFrame Time: 0.05\n", "x", "\0", whole.replace("}", ""))
    for old, *changes in CASES["bvh"]:
        assert old in whole
        yield from (whole.replace(old, new.replace("{long}", "9" * 5000), 1) for new in changes)
    draw = np.random.default_rng(4)
    yield from (whole[: draw.integers(len(whole) - 140)] for _ in range(12))
    for _ in range(8):
        at = int(draw.integers(len(whole.partition("MOTION")[0])))
        yield whole[:at] + str(draw.choice(["{", "}", " x{ ", "\x1b"])) + whole[at:]
    yield "HIERARCHY\n" + "".join(f"{'JOINT' if n else 'ROOT'} j{n}\n{{\nOFFSET 0 0 0\n" for n in range(5000))


def test_damaged_bvh(refused, bad):
    refused.every = 6
    path = bad / "bad.bvh"
    for data in (*(text.encode() for text in broken_bvh()), b"HIERARCHY\n\xff\xfe"):
        path.write_bytes(data)
        refused("convert", str(path), "out=out.json")


def arrays(**changes: Any) -> dict[str, Any]:
    content = {"joints": body(4), "fps": np.float32(20)} | changes
    return {name: value for name, value in content.items() if value is not None}


def broken_arrays() -> Iterator[dict[str, Any]]:
    shapes = ((), (0,), (4,), (4, 22), (4, 20, 3), (4, 22, 2), (0, 22, 3), (4, 0, 3), (2, 4, 22, 3))
    yield from (arrays(joints=np.ones(shape)) for shape in shapes)
    yield from (arrays(joints=np.full((4, 22, 3), value)) for value in (np.nan, np.inf, "x", 1e300, 1j))
    yield from (arrays(joints=np.array(value, dtype)) for value, dtype in (({"a": 1}, object), ("text", None)))
    yield arrays(joints=np.zeros((4, 22, 3), "datetime64[s]"))
    yield from (arrays(fps=np.array(value)) for value in (0, -1, np.nan, np.inf, "x", [20, 20], [], 1j))
    yield from (arrays(joints=None), arrays(fps=None), {})
    amass = {"joints": None, "fps": None, "poses": np.zeros((4, 156)), "trans": np.zeros((4, 3))}
    amass |= {"mocap_framerate": 60.0}
    yield from (arrays(**amass | {"poses": np.ones(shape)}) for shape in ((), (4,), (4, 5), (3, 156), (4, 2)))
    yield from (arrays(**amass | {"trans": np.ones(shape)}) for shape in ((), (3,), (4, 2)))
    yield from (arrays(**amass | {"mocap_framerate": np.array(rate)}) for rate in (0, -1, np.nan, "x", [1, 2]))
    yield from (arrays(**amass | {"poses": np.full((4, 156), value)}) for value in (np.nan, "x"))
    yield arrays(**amass | {"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))})


def test_damaged_arrays(refused, bad, trained):
    refused.every = 6
    path = bad / "bad.npz"
    for content in broken_arrays():
        np.savez(path, **content)
        refused("convert", str(path), "out=out.bvh")
        if "poses" not in content:
            refused("edit", f"ckpt={trained}", f"motion={path}", "region=in_between", TEXT)
    for suffix in ("npz", "npy"):
        stream = io.BytesIO()
        np.savez(stream, **arrays()) if suffix == "npz" else np.save(stream, body(4))
        path = bad / f"bad.{suffix}"
        for number, data in enumerate(mangled(stream.getvalue(), 24, 5)):
            if number < 5 or number % 3 == 0:  # zip files may begin anywhere; headers have no checksum
                path.write_bytes(data)
                refused("convert", str(path), "out=out.json", *(["fps=20"] if suffix == "npy" else []))


def test_damaged_json(refused, bad):
    refused.every = 4
    path = bad / "bad.json"
    texts = ["", "{", "[]", "3", "null", "[" * 100000, '{"joints": []}', '{"joints": [], "fps": 20}', "\ufeff{}", "NaN"]
    texts += [f'{{"joints": {joints}, "fps": 20}}' for joints in ('"x"', "[[[1]]]", "[[1], [1, 2]]")]
    rates = (0, -1, "x", None, [], {}, float("nan"), True)
    texts += [json.dumps({"joints": body(4).tolist(), "fps": fps}) for fps in rates]
    numbers = (float("nan"), float("inf"), 1e300)
    texts += [json.dumps({"joints": np.full((4, 22, 3), x).tolist(), "fps": 20}) for x in numbers]
    for data in (*(text.encode() for text in texts), b"\xff\xfe{}"):
        path.write_bytes(data)
        refused("convert", str(path), "out=out.bvh")


# Data -----------------------------------------------------------------------------------------------------------------


def own_data(folder: Path) -> None:
    """Three motions with captions, well formed."""
    folder.mkdir()
    for name in "abc":
        np.savez(folder / f"{name}.npz", joints=body(60), fps=20.0)
        (folder / f"{name}.txt").write_text("a person stands\n")


def test_damaged_own_data(refused, bad, tmp_path):
    refused.every = 6

    def case(name: str, data: str | bytes | None, *more: str) -> None:
        folder = bad / f"data{refused.count}"
        own_data(folder)
        (folder / name).unlink(missing_ok=True)
        if data is not None:
            (folder / "b.npz").unlink() if name == "b.bvh" else None
            (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)
        root = tmp_path / f"prepared{refused.count}"
        refused.watched.append(root)
        refused("prepare", "data=folder", f"source={folder}", f"data_root={root}", *more)

    for data in (None, "", "\n\n", "# x\n", b"\xff\xfe\xff"):
        case("b.txt", data)
    case("b.npy", "x")
    for name, key in (("captions.csv", "captions"), ("captions.json", "captions_json"), ("skeleton.yaml", "skeletons")):
        for text in CASES[key]:
            case(name, text)
    case("captions.csv", b"id,text\na,\xff\n")
    for content in list(broken_arrays())[::3]:
        stream = io.BytesIO()
        np.savez(stream, **content)
        case("b.npz", stream.getvalue())
    for text in list(broken_bvh())[::7]:
        case("b.bvh", text)
    source = [f"data.source.{word}" for word in ("exclude=[none]", "motion=none", "mirror=maybe", "path=null")]
    for word in (*source, "representation=none", "data.name=null"):
        case("b.none", None, word)


def test_damaged_stores(refused, bad, data_root, trained):
    refused.every = 5
    whole = data_root / "synthetic-humanml-clean-smpl22"
    for name in ("store.json", "clips.jsonl", "statistics.npz", "features.npy"):
        content = (whole / name).read_bytes()
        for number, data in enumerate([*mangled(content, 9, 6), None]):
            if data is not None and ((name == "features.npy" and number > 4) or (name == "store.json" and number != 4)):
                continue  # store.json holds the checksums of the others, not its own
            root = bad / f"{name}{number}"
            shutil.copytree(whole, root / whole.name)
            file = root / whole.name / name
            file.unlink() if data is None else file.write_bytes(data)
            refused("evaluate", f"ckpt={trained}", "extractor=none", "quick=true", f"data_root={root}")
            if name != "store.json" or data is not None:
                refused("browse", "data=synthetic", "data.source.clips=60", f"data_root={root}")


def test_strange_texts_are_legal(trained, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    texts = ["walk " * 390, "a\x07b\x1b[31m c\x7f", "<script>alert(1)</script> & </style>", "走る ü \u202e x"]
    for number, text in enumerate([*texts, "'; $(rm) `x` \\", "{a: [b"]):
        words = ["samples=1", "seconds=0.5", f"out=out{number}"]
        assert main(["sample", f"ckpt={trained}", f"text={text}", *words]) == 0, text[:50]
        page = (tmp_path / f"out{number}" / "player.html").read_text(encoding="utf-8")
        assert "<script>alert(1)" not in page
        with np.load(tmp_path / f"out{number}" / "motion_000.npz") as file:
            assert str(file["text"]) == text
    capfd.readouterr()


# Files of results and runs --------------------------------------------------------------------------------------------

Keys = tuple[str | int, ...]
"""The keys that lead to a value in what a file holds."""


def values(content: Any, keys: Keys = ()) -> Iterator[tuple[Keys, Any]]:
    """All values, those that hold others before these."""
    yield keys, content
    for key, value in content.items() if isinstance(content, dict) else enumerate(content or ()):
        if isinstance(value, dict | list):
            yield from values(value, (*keys, key))
        else:
            yield (*keys, key), value


def at(content: Any, keys: Sequence[str | int]) -> Any:
    for key in keys:
        content = content[key]
    return content


def replaced(content: Any, keys: Sequence[str | int], value: Any) -> Any:
    """A copy with another value."""
    if not keys:
        return value
    copy: Any = dict(content) if isinstance(content, dict) else list(content)
    copy[keys[0]] = replaced(content[keys[0]] if len(keys) > 1 else None, keys[1:], value)
    return copy


WRONG: dict[type, list[Any]] = {
    dict: [3, "x", [1], True],
    list: [3, "x", {"a": 1}],
    str: [3, [], {}, False],
    bool: ["x", 3, []],
    int: ["x", [], {}, 10**400, 0.5, True],
    float: ["x", [1], {}, 10**400, True],
    type(None): [3.5, [], {"a": 3}],
}
"""Values of other kinds than the one in a file."""


def misfits(content: Any, count: int, seed: int, without: Sequence[Keys] = ()) -> Iterator[str]:
    """JSON of what a file holds with a wrong value, `count` for each value."""
    draw = np.random.default_rng(seed)
    for keys, value in values(content):
        if keys not in without:
            choices = WRONG[type(value)]
            for index in draw.permutation(len(choices))[:count]:
                yield json.dumps(replaced(content, keys, choices[index]))


def lacking(content: Any, names: Sequence[Keys]) -> Iterator[str]:
    """JSON without a key."""
    for *keys, name in names:
        yield json.dumps(replaced(content, keys, {k: v for k, v in at(content, keys).items() if k != name}))


NO_JSON = ("", " ", "{", "[]", "3", "null", "NaN", '"x"', "[" * 100_000, "\ufeff{}", "{'a': 1}", '{"a": 1} {"b": 2}')
NO_JSON += ("\0", '{"x": "\\ud800"}', "{" + '"a":{' * 5000, "1" * 5000)


def cut(text: str, count: int, seed: int) -> Iterator[str]:
    """A text that ends too soon, at random positions."""
    whole = len(text.rstrip()) - 1
    yield from (text[: int(at)] for at in np.random.default_rng(seed).integers(1, whole, count))


SPEC: dict[str, Any] = {
    "title": "x",
    "notes": ["a note"],
    "parts": {
        "A": {
            "protocol": "synthetic",
            "seed": 0,
            "columns": {"FID": {"value": "fid", "better": "lower"}, "Steps": {"value": "num_inference_steps"}},
            "rows": [{"label": "MDM", "ckpt": "mdm.ckpt", "num_inference_steps": [5, 10]}],
        },
        "B": {"recipes": {"MDM": "humanml3d/mdm"}, "keys": {"batch": "data.batch_size"}},
        "C": {"lengths": ["synthetic"]},
        "D": {"ratings": "ratings.json"},
    },
    "figures": [{"part": "A", "x": "num_inference_steps", "y": ["FID"], "log": True}],
}
"""A table of each kind of part."""

SPECS = (
    *("", "[", "- a", "3", "text", "null", "a: b: c", "title: x", "parts: {}", "\t- x", "a: &x [*x]", "a: *nothing"),
    *("title: &x {a: *x}", "title: x\nparts: &x {A: *x}", "!!python/object:os.system {}", "title: x\ntitle: y", "? ["),
    *("title: ${nothing}", "title: ${oc.env:NOT_SET_ANYWHERE}", "title: '\0'", 'title: "\\ud800"', "title: ${title}"),
    *("title: x\nparts: {1: {lengths: [a]}}", "title: x\nparts: {A: {lengths: [a], ratings: b}}", "title: ???"),
    *("title: x\nparts: {A: {recipes: {a: none_such}, keys: {b: data.batch_size}}}", "é: ü", "title: x\npart: {}"),
    "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(f"a{n + 1}: &a{n + 1} [{f'*a{n or str()},' * 9}]\n" for n in range(9)),
    "[" * 3000,
)
"""YAML that is none, is not the spec of a table, or never ends."""


def test_specs_of_tables(refused, bad):
    refused.every = 10
    path = bad / "mine.yaml"
    words = [f"table={path}", "evaluate=false", "results=none"]
    path.write_text(json.dumps(SPEC))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 0, "but for what is changed below"
    part, row = ("parts", "A"), ("parts", "A", "rows", 0)
    one_or_more: list[Keys] = [(*row, "num_inference_steps"), ("figures", 0, "y"), ("notes",), (*part, "rows")]
    cases = list(misfits(SPEC, 2, 7, [*one_or_more, (*row, "num_inference_steps", 1)]))
    cases += [json.dumps(replaced(SPEC, keys, value)) for keys in one_or_more for value in ({"a": 1}, True)]
    required: list[Keys] = [("title",), ("parts",), (*part, "protocol"), (*part, "columns"), (*part, "rows")]
    required += [(*part, "columns", "FID", "value"), (*row, "label"), (*row, "ckpt")]
    cases += lacking(SPEC, [*required, *(("figures", 0, name) for name in ("part", "x", "y"))])
    wrong: dict[Keys, Any] = {
        ("tittle",): 1,
        (*part, "protcol"): 1,
        (*row, "guidance_scale"): 1,
        ("figures", 0, "z"): 1,
    }
    wrong |= {(*part, "columns", "FID", "better"): "up", (*row, "baseline"): "static", ("figures", 0, "part"): "none"}
    wrong |= {("figures", 0, "x"): "none", ("figures", 0, "y"): ["none"]}
    wrong |= {("parts", "B", "recipes", "MDM"): "../base", ("parts", "B", "keys", "batch"): "none_such"}
    cases += [json.dumps(replaced(SPEC, keys, value)) for keys, value in wrong.items()]
    for data in (*(text.encode() for text in (*cases, *SPECS, *cut(json.dumps(SPEC), 10, 8))), b"title: \xff\n"):
        path.write_bytes(data)
        refused("tables", *words)


RESULT: dict[str, Any] = {
    "quick": False,
    "protocol": {"name": "synthetic", "version": 1},
    "split": "test",
    "published_split": False,
    "data": {"dataset": "synthetic", "fingerprint": "f", "frames": [24, 60]},
    "seed": 0,
    "extractor": {"sha256": "e" * 64},
    "samples_sha256": None,
    "baseline": None,
    "checkpoint": {
        **{"path": "mdm.ckpt", "sha256": "c" * 64, "sampler": "ddim", "num_inference_steps": 5, "guidance_scale": 2.5},
        **{"experiment": "synthetic/mdm", "selected_by": "none: last", "averaged_weights": True, "parameters": 123},
    },
    "device": "cpu",
    "changed": {},
    "values": {"fid": {"mean": 4.5, "ci": 0.25, "replications": 2, "n": 64}},
    "ground_truth": {"fid": {"mean": 0.5, "ci": 0.25, "replications": 2, "n": 64}},
    "not_computed": {"kid": "too few"},
    "invalid_because": ["real motions are off"],
    "warnings": ["of something"],
    "cost": {"nfe": 5.0, "seconds_per_sample": 0.5},
}
"""A result, as far as it is read."""


def broken_results() -> Iterator[str]:
    required: list[Keys] = [(name,) for name in ("quick", "protocol", "split", "data", "seed", "extractor", "values")]
    required += [("protocol", "name"), ("data", "fingerprint"), ("checkpoint", "sha256"), ("values", "fid", "mean")]
    text = json.dumps(RESULT)
    yield from (*misfits(RESULT, 2, 9), *lacking(RESULT, required), *NO_JSON, *cut(text, 10, 10))
    yield from (text.replace("4.5", number) for number in ("NaN", "Infinity", "-Infinity", "1e999", "4.5.5", "1_0"))


def test_damaged_results(refused, bad):
    from flame_mdm.reporting.tables.specs import evaluations, load_spec

    refused.every = 6
    spec, run = bad / "mine.yaml", a_run(bad / "run")
    spec.write_text(json.dumps({**SPEC, "parts": {"A": SPEC["parts"]["A"]}}))
    ((_, (request, _)), _) = evaluations(load_spec(str(spec))["parts"]["A"])
    in_table, in_run = request.path(bad / "results"), run / "evaluation" / "p-1" / "x" / "result.json"
    words = [f"table={spec}", "evaluate=false", f"results={bad / 'results'}"]
    for path in (in_table, in_run):
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(RESULT))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 3  # written, but the result is not valid
    assert main(["report", str(run)]) == 0
    (run / "report.html").unlink()
    refused.watched.append(run)
    for number, text in enumerate(broken_results()):
        for path in (in_table, in_run):
            path.write_text(text)
        if number % 4 < 2:
            refused("tables", *words)
        else:
            refused("report", str(run))


PROVENANCE: dict[str, Any] = {
    **{
        "command": ["train"],
        "commit": None,
        "changed": "",
        "python": "3.11",
        "machine": "x",
        "packages": {"torch": "2"},
    },
    **{"data": {"fingerprint": "f", "max_frames": 60}, "device": "cpu", "parameters": 5},
}
FAULT: dict[str, Any] = {
    **{"step": 5, "usual_loss": "0.5", "batches": [{"rank": 0, "batch": 5, "ids": ["a"], "loss": "nan"}]}
}


def test_damaged_runs(refused, bad):
    refused.every = 9
    run, other = a_run(bad / "run"), a_run(bad / "other")
    refused.watched.append(run)

    def case(name: str, text: str) -> None:
        whole = (run / name).read_bytes() if (run / name).exists() else None
        (run / name).write_text(text, encoding="utf-8")
        refused("report", str(run))
        if refused.count % 6 == 0 and name != "bad_batch.json":  # which comparisons do not read
            refused("compare", f"runs={run} {other}")
        (run / name).unlink() if whole is None else (run / name).write_bytes(whole)

    for name, content in (("provenance.json", PROVENANCE), ("bad_batch.json", FAULT)):
        for text in (*misfits(content, 2, 11, [("data", "max_frames")]), *NO_JSON, *cut(json.dumps(content), 5, 12)):
            case(name, text)
    config = json.loads((run / "config.yaml").read_text())
    for text in (
        *misfits(config, 3, 13, [("run", "name"), ("run", "dir")]),
        *lacking(config, [("experiment",), ("run",), ("trainer",), ("trainer", "max_steps")]),
        *(*SPECS, *cut(json.dumps(config), 5, 14)),
    ):
        case("config.yaml", text)
    line = '{"step": 3, "train/loss": 1.5}\n'
    wrong = ('"x"', "null", "[]", "{}", "true", "1_0", "'1'")
    broken_lines = [line.replace("1.5", value) for value in wrong]
    broken_lines += [line.replace("3", step) for step in (*wrong, "-1", "1.5", "NaN", "1e999", "9" * 400)]
    broken_lines += ["\n", *(f"{text}\n" for text in NO_JSON if text != "null"), line.replace("step", "stop")]
    for number, text in enumerate((*broken_lines, line[:-9] + "\n")):
        case("metrics.jsonl", [text, line + text, text + line][number % 3])
    for name in ("provenance.json", "metrics.jsonl", "config.yaml"):
        folder = a_run(bad / f"bytes-{name}")
        (folder / name).write_bytes(b"\xff\xfe{}\n")
        refused("report", str(folder))


def test_damaged_motions_in_comparisons(refused, bad, fill):
    refused.every = 4
    (bad / "motions").mkdir()
    path = bad / "motions" / "motion.npz"
    for content in [*list(broken_arrays())[1::4], None]:
        path.write_bytes(b"PK\3\4x") if content is None else np.savez(path, **content)
        refused("compare", f"runs={fill('{run}')} {bad / 'motions'}")


def test_damaged_ratings_and_lengths(refused, bad):
    refused.every = 8
    path = bad / "ratings.json"
    answers = {"study": "s", "rater": "ann", "ratings": [{"prompt": "p", "a": "x", "b": "y", "choice": "a"}]}
    texts = [*misfits(answers, 2, 15, [("ratings", 0, "prompt")]), *NO_JSON, *cut(json.dumps(answers), 5, 16)]
    texts += [json.dumps(replaced(answers, keys, "")) for keys in (("study",), ("rater",), ("ratings", 0, "a"))]
    texts += [json.dumps(replaced(answers, ("ratings", 0, "choice"), choice)) for choice in ("c", "A", "ab")]
    for text in texts:
        path.write_text(text)
        refused("compare", f"ratings={path}")
    spec = bad / "mine.yaml"
    spec.write_text(json.dumps({"title": "x", "parts": {"C": {"lengths": ["a"]}, "D": {"ratings": str(path)}}}))
    words = [f"table={spec}", "evaluate=false", f"results={bad}"]
    counted = {"pairs": [{"a": "x", "b": "y", "wins_a": 1, "wins_b": 2, "raters": 1}]}
    lengths = {"fingerprint": "f", "fps": 20.0, "lengths": [10, 30]}
    (bad / "lengths").mkdir()
    for file, whole in ((path, counted), (bad / "lengths" / "a.json", lengths)):
        wrong: list[tuple[Keys, Any]] = [(("pairs", 0, "wins_a"), -1), (("fps",), 0), (("lengths",), [-5, 3])]
        texts = [json.dumps(replaced(whole, keys, value)) for keys, value in wrong if keys[0] in whole]
        for text in (*misfits(whole, 2, 17), *texts, *NO_JSON[::2]):
            file.write_text(text)
            refused("tables", *words)
        file.write_text(json.dumps(whole))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 0


def test_damaged_times_of_benchmarks(refused, bad):
    for text in (*NO_JSON, '{"a": "x"}', '{"a": null}', '{"a": [1]}', '{"a": true}'):
        (bad / "times.json").write_text(text)
        refused("benchmark", "synthetic", "evaluate=false", f"out={bad}")


def test_damaged_notes_for_wandb(tmp_path):
    from flame_mdm.errors import UserError
    from flame_mdm.training.loggers import WandbRun

    content = {"id": "abc", "step": 3, "rows": 5}
    for text in (*misfits(content, 3, 18), *NO_JSON, *cut(json.dumps(content), 4, 19)):
        (tmp_path / "wandb.json").write_text(text)
        with pytest.raises(UserError, match=r"wandb\.json"):
            WandbRun(str(tmp_path), offline=True)


PROCESSES = [
    *[["train", "none_such"], ["sample", "ckpt=none.ckpt", "text=a"], ["edit", "frmes=x"], ["evaluate", "split=none"]],
    *[
        ["prepare", "data=bandai", "sorce=x"],
        ["convert", "a.bvh", "unt=2"],
        ["tables", "table=none"],
        ["report", "none"],
    ],
]


def test_real_processes(tmp_path):
    def run(words: Sequence[str]) -> subprocess.CompletedProcess[str]:
        command, environment = [sys.executable, "-m", "flame_mdm", *words], {**os.environ, "OMP_NUM_THREADS": "1"}
        return subprocess.run(
            command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False, timeout=120
        )

    with ThreadPoolExecutor(2) as pool:
        for words, done in zip(PROCESSES, pool.map(run, PROCESSES), strict=True):
            assert done.returncode in (1, 2), (words, done)
            assert one_line(done.stderr, words[0]), (words, done.stderr)
    assert not list(tmp_path.iterdir())
