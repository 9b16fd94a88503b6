"""Malformed input of every kind through every command: one line `error: ...`, nothing written, no traceback, no hang.

`make test` takes a share of the cases, always the same one; `make test-robustness` takes all of them.
"""

import io
import json
import os
import zipfile
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fixtures import ROOT
from support.motions import adult, bvh_text
from support.pages import a_run
from support.refusals import npz
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.hub import export
from flame_mdm.errors import UserError
from flame_mdm.formats.readers import read
from flame_mdm.records import read_result
from flame_mdm.reporting.report import write_report
from flame_mdm.reporting.study import tally
from flame_mdm.reporting.tables.build import build
from flame_mdm.reporting.tables.specs import load_spec
from flame_mdm.runs import read_history
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.training.loggers import WandbRun

pytestmark = pytest.mark.slow

TEXT = "text=a person walks"
CASES: dict[str, Any] = read_package_yaml(ROOT / "tests" / "support" / "refused.yaml")
FOUR = adult(4)


@pytest.fixture
def fill(bad, trained, tmp_path) -> Callable[[str], str]:
    """Fills the names of files into a word of a case, and makes the files."""
    np.savez(tmp_path / "walk.npz", joints=adult(30), fps=20.0)
    run, other = a_run(bad / "run"), a_run(bad / "other", name="two")
    os.mkfifo(bad / "pipe.npz")
    for name in ("folder.npz", "folder.yaml", "folder.txt", "empty"):
        (bad / name).mkdir()
    texts = {
        "list.yaml": b"- 1\n",
        "broken.yaml": b"a: [\n",
        "bare.yaml": b"name: x\n",
        "empty.txt": b"\n \n",
    }
    texts |= {"foreign.yaml": b"_target_: os.system\ncommand: ls\n", "file.zip": b"x"}
    texts |= {
        "part.yaml": b"version: 1\ncondition: text\n",
        **dict.fromkeys(("latin.yaml", "latin.txt"), b"a: \xe9\n"),
    }
    for name, text in texts.items():
        (bad / name).write_bytes(text)
    words = {"trained": trained, "bad": bad, "walk": tmp_path / "walk.npz", "long": "x" * 5000}
    words |= {"run": run, "both": f"runs={run} {other}"}
    return lambda word: reduce(
        lambda text, name: text.replace(f"{{{name}}}", str(words[name])), words, word
    )


def test_words(refused, fill):
    refused.every = 8
    for command, key in CASES["keys"].items():
        for word in (*CASES["misspelled"], f"{key}q=1", f"{key}.deeper=1", f"~{key}"):
            refused(*command.split(), word)
    more = {"browse": ["data.source.clips=60"], "tables": ["evaluate=false"]}
    for command, cases in CASES["words"].items():
        for words in cases:
            refused(command, *map(fill, words), *more.get(command, []))


def test_values(refused, fill):
    refused.every = 12
    for command, wrong in CASES["values"].items():
        for key, values in wrong.items():
            for value in values:
                refused(*map(fill, [*command.split("|"), f"{key}={value}"]))


def test_values_of_training(refused, tmp_path, data_root):
    refused.every = 18
    refused.watched = [data_root]  # a run that has begun to log leaves its folder
    tiny = [
        *TINY,
        f"data_root={data_root}",
        "callbacks.best=null",
        "trainer.max_steps=1",
        "logger=csv",
    ]
    for key, values in CASES["training"].items():
        for value in values:
            words = [word for word in tiny if not word.startswith(f"{key}=")]
            folder = [f"run.dir=run{refused.count}"] if key not in ("run", "run.dir") else []
            refused("train", "quickstart", *words, *folder, f"{key}={value}")
    assert not list((tmp_path / "here").rglob("*.ckpt"))  # but nothing is trained


def test_recipes(refused, bad):
    refused.every = 6
    whole = "# @package _global_\ndefaults:\n  - /quickstart\n  - _self_\ntrainer: {max_steps: 5}\n"
    for text in (*CASES["recipes"], *(f"{whole}{line}\n" for line in CASES["recipe_lines"])):
        path = bad / f"recipe{refused.count}.yaml"
        path.write_bytes(text.encode())
        refused("train", str(path))


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


def members(archive: bytes) -> dict[str, bytes]:
    """The content of the members of a zip archive; empty if it is damaged."""
    try:
        with zipfile.ZipFile(io.BytesIO(archive)) as file:
            return {name: file.read(name) for name in file.namelist()}
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError):
        return {}


def test_damaged_checkpoints(refused, trained, bad):
    refused.every = 12
    model = Path(export(trained, bad / "whole.safetensors")).read_bytes()
    for suffix, data in (("ckpt", trained.read_bytes()), ("safetensors", model)):
        path = bad / f"bad.{suffix}"
        for number, content in enumerate(mangled(data, 60, 2)):
            if len(content) == len(data) and suffix == "ckpt" and members(content) == members(data):
                continue  # only padding between the members changed
            path.write_bytes(content)
            refused("export", str(path), "out=out.safetensors")
            if number % 6 == 0:
                refused("sample", f"ckpt={path}", TEXT)
                refused("evaluate", f"ckpt={path}", "extractor=none", "quick=true")
                refused("push", str(path), "a/b", "dry_run=true")


def broken_bvh() -> Iterator[str]:
    whole = bvh_text()
    yield from (
        "",
        "HIERARCHY",
        "HIERARCHY\nMOTION\nFrames: 0\nFrame Time: 0.05\n",
        "x",
        "\0",
        whole.replace("}", ""),
    )
    for old, *changes in CASES["bvh"]:
        assert old in whole
        yield from (whole.replace(old, new.replace("{long}", "9" * 5000), 1) for new in changes)
    draw = np.random.default_rng(4)
    yield from (whole[: draw.integers(len(whole) - 140)] for _ in range(12))
    for _ in range(8):
        at = int(draw.integers(len(whole.partition("MOTION")[0])))
        yield whole[:at] + str(draw.choice(["{", "}", " x{ ", "\x1b"])) + whole[at:]
    yield "HIERARCHY\n" + "".join(
        f"{'JOINT' if n else 'ROOT'} j{n}\n{{\nOFFSET 0 0 0\n" for n in range(5000)
    )


def broken_arrays() -> Iterator[dict[str, Any]]:
    joints: dict[str, Any] = {"joints": FOUR, "fps": np.float32(20)}
    shapes = ((), (0,), (4,), (4, 22), (4, 20, 3), (4, 22, 2), (0, 22, 3), (4, 0, 3), (2, 4, 22, 3))
    yield from (joints | {"joints": np.ones(shape)} for shape in shapes)
    yield from (
        joints | {"joints": np.full((4, 22, 3), value)}
        for value in (np.nan, np.inf, "x", 1e300, 1j)
    )
    odd = (np.array({"a": 1}, object), np.array("text"), np.zeros((4, 22, 3), "datetime64[s]"))
    yield from (joints | {"joints": value} for value in odd)
    yield from (
        joints | {"fps": np.array(value)}
        for value in (0, -1, np.nan, np.inf, "x", [20, 20], [], 1j)
    )
    yield from ({"fps": joints["fps"]}, {"joints": FOUR}, {})
    amass = {"poses": np.zeros((4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": 60.0}
    yield from (amass | {"poses": np.ones(shape)} for shape in ((), (4,), (4, 5), (3, 156), (4, 2)))
    yield from (amass | {"trans": np.ones(shape)} for shape in ((), (3,), (4, 2)))
    yield from (
        amass | {"mocap_framerate": np.array(rate)} for rate in (0, -1, np.nan, "x", [1, 2])
    )
    yield from (amass | {"poses": np.full((4, 156), value)} for value in (np.nan, "x"))
    yield amass | {"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}


def written(content: dict[str, Any] | np.ndarray) -> bytes:
    """The bytes of an array or of named arrays in a file."""
    if isinstance(content, dict):
        return npz(**content)
    stream = io.BytesIO()
    np.save(stream, content)
    return stream.getvalue()


def test_damaged_motions(refused, bad):
    refused.every = 12
    cases = [("bvh", text.encode()) for text in broken_bvh()] + [("bvh", b"HIERARCHY\n\xff\xfe")]
    cases += [("npz", written(content)) for content in broken_arrays()] + [
        ("json", text.encode()) for text in NO_JSON
    ]
    for suffix, whole in (("npz", {"joints": FOUR, "fps": 20.0}), ("npy", FOUR)):
        damaged = list(mangled(written(whole), 24, 5))
        # One case is left out: zip files may begin anywhere.
        cases += [(suffix, data) for data in (*damaged[:5], *damaged[6::3])]
    for suffix, data in cases:
        (bad / f"bad.{suffix}").write_bytes(data)
        if suffix == "bvh" and is_unharmed(bad / "bad.bvh"):
            continue
        out = "out=out.bvh" if suffix == "json" else "out=out.json"
        refused(
            "convert", str(bad / f"bad.{suffix}"), out, *(["fps=20"] if suffix == "npy" else [])
        )


def is_unharmed(path: Path) -> bool:
    """Whether a changed file still has the motion of the whole one: a joint's name may have any characters."""
    whole = path.with_name("whole.bvh")
    whole.write_text(bvh_text())
    try:
        joints = read(path).joints
    except UserError:
        return False
    return np.array_equal(joints, read(whole).joints)


def test_strange_texts_are_legal(trained, tmp_path, monkeypatch, subtests):
    monkeypatch.chdir(tmp_path)
    strange = (
        "walk\x07b\x1b[31m c\x7f {a: [b \u202e '; $(rm) `x` \\<script>alert(1)</script> & </style>"
    )
    for text in ("walk " * 390, strange):
        with subtests.test(text=text):
            out = tmp_path / str(len(text))
            assert (
                main(
                    [
                        "sample",
                        f"ckpt={trained}",
                        f"text={text}",
                        "samples=1",
                        "seconds=0.5",
                        f"out={out}",
                    ]
                )
                == 0
            )
            assert "<script>alert(1)" not in (out / "player.html").read_text(encoding="utf-8")
            with np.load(out / "motion_000.npz") as file:
                assert str(file["text"]) == text


def test_a_text_in_another_script_is_refused_in_one_line(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["sample", f"ckpt={trained}", "text=走る \x1b[31mü", "samples=1", "out=out"]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "only English prompts" in message
    assert "\x1b" not in message
    assert not (tmp_path / "out").exists()


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
NO_JSON = [*CASES["json"], "[" * 100_000, "{" + '"a":{' * 5000, "1" * 5000]
NO_YAML = [*CASES["yaml"], "[" * 3000, "a: &a [x,x,x,x,x,x,x,x,x]\n"]
NO_YAML[-1] += "".join(f"a{n + 1}: &a{n + 1} [{f'*a{n or str()},' * 9}]\n" for n in range(9))
ABSENT = object()


def values(content: Any, keys: str = "") -> Iterator[tuple[str, Any]]:
    """All values with their dotted keys, those that hold others before these."""
    yield keys, content
    items = (
        content.items()
        if isinstance(content, dict)
        else enumerate(content)
        if isinstance(content, list)
        else ()
    )
    for key, value in items:
        yield from values(value, f"{keys}.{key}" if keys else str(key))


def replaced(content: Any, keys: str, value: Any) -> str:
    """JSON with another value at dotted keys, or without these."""
    if not keys:
        return json.dumps(value)
    *path, last = [int(key) if key.isdigit() else key for key in keys.split(".")]
    copy = deepcopy(content)
    holder = reduce(lambda inner, key: inner[key], path, copy)
    holder[last] = value
    if value is ABSENT:
        del holder[last]
    return json.dumps(copy)


def malformed(name: str, content: Any) -> list[str]:
    """Malformed contents of a JSON file: at each key two values of other types, and the further cases of the table."""
    case, draw, texts = CASES["files"][name], np.random.default_rng(9), list(NO_JSON)
    for keys, value in values(content):
        wrong = WRONG[type(value)] if keys not in case.get("any", ()) else []
        texts += [
            replaced(content, keys, wrong[index]) for index in draw.permutation(len(wrong))[:2]
        ]
    texts += [replaced(content, keys, ABSENT) for keys in case.get("required", ())]
    texts += [
        replaced(content, keys, value)
        for keys, wrong in case.get("wrong", {}).items()
        for value in wrong
    ]
    text = json.dumps(content)
    return [*texts, *(text[: int(at)] for at in draw.integers(1, len(text) - 1, 8))]


def reader(name: str, folder: Path) -> tuple[Path, Callable[[], object]]:
    """The path of a file of results or runs, and what reads it."""
    run, path = (
        a_run(folder / "run"),
        folder / f"{name}{'.yaml' if name in ('spec', 'config') else '.json'}",
    )
    if name in ("provenance", "bad_batch", "config"):
        return run / path.name, lambda: write_report(run)
    if name in ("pairs", "lengths"):
        part = {"ratings": str(path)} if name == "pairs" else {"lengths": ["lengths"]}
        (folder / "lengths").mkdir()
        path = path if name == "pairs" else folder / "lengths" / path.name
        return path, lambda: build("x", {"title": "x", "parts": {"A": part}}, folder)
    reads: dict[str, Callable[[], object]] = {
        "spec": lambda: build("x", load_spec(str(path)), folder),
        "result": lambda: read_result(path),
        "ratings": lambda: tally([path]),
        "wandb": lambda: WandbRun(str(folder), offline=True),
    }
    return path, reads[name]


@pytest.mark.parametrize("name", CASES["files"])
def test_files_of_results_and_runs(name, tmp_path, subtests):
    path, read = reader(name, tmp_path)
    content = CASES["files"][name].get("content") or json.loads(path.read_text())
    path.write_text(json.dumps(content))
    if name != "wandb":  # which would start a run
        read()
    for text in (*malformed(name, content), *(NO_YAML if path.suffix == ".yaml" else [])):
        with subtests.test(text=text):
            path.write_text(text, encoding="utf-8")
            with pytest.raises(UserError) as error:
                print(text[:200], read())
            assert "\n" not in str(error.value), text[:200]


def test_histories(tmp_path, subtests):
    run, line = a_run(tmp_path / "run"), '{"step": 3, "train/loss": 1.5}\n'
    wrong = ('"x"', "null", "[]", "{}", "true", "1_0", "'1'")
    broken = [line.replace("1.5", value) for value in wrong] + ["\n", line.replace("step", "stop")]
    broken += [line.replace("3", step) for step in (*wrong, "-1", "1.5", "NaN", "1e999", "9" * 400)]
    for text in (*broken, *(f"{text}\n" for text in NO_JSON if text != "null")):
        with subtests.test(text=text):
            for content in (text, line + text, text + line):
                (run / "metrics.jsonl").write_text(content, encoding="utf-8")
                with pytest.raises(UserError, match=r"metrics\.jsonl"):
                    read_history(run)
