"""Malformed input of every kind through every command: one line `error: ...`, nothing written, no traceback, no hang.

`make test` takes a share of the cases, always the same one; `make test-robustness` takes all of them.
"""

import io
import json
import os
import pickle
import shutil
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.fixtures import ROOT
from support.motions import adult, bvh_text
from support.pages import a_run
from support.refusals import one_line
from support.runs import TINY, finish, spawn

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.hub import export
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.errors import UserError
from flame_mdm.reporting.tables.specs import evaluations, load_spec
from flame_mdm.safe_io import read_yaml
from flame_mdm.training.loggers import WandbRun

pytestmark = pytest.mark.slow

TEXT = "text=a person walks"
CASES: dict[str, Any] = read_yaml(ROOT / "tests" / "support" / "refused.yaml")
FOUR = adult(4)


@pytest.fixture
def fill(bad, trained, tmp_path) -> Callable[[str], str]:
    """Fills the names of files into a word of a case, and makes the files."""
    np.savez(tmp_path / "walk.npz", joints=adult(30), fps=20.0)
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


def test_words(refused, fill):
    refused.every = 4
    for command, key in CASES["keys"].items():
        for word in (*CASES["misspelled"], f"{key}q=1", f"{key}.deeper=1", f"~{key}"):
            refused(*command.split(), word)
    more = {"browse": ["data.source.clips=60"], "tables": ["evaluate=false"]}
    for command, cases in CASES["words"].items():
        for words in cases:
            refused(command, *map(fill, words), *more.get(command, []))


def test_values(refused, fill):
    refused.every = 6
    for command, wrong in CASES["values"].items():
        for key, values in wrong.items():
            for value in values:
                refused(*map(fill, [*command.split("|"), f"{key}={value}"]))


def test_values_of_training(refused, tmp_path, data_root):
    refused.every = 9
    refused.watched = [data_root]  # a run that has begun to log leaves its folder
    tiny = [*TINY, f"data_root={data_root}", "callbacks.best=null", "trainer.max_steps=1", "logger=csv"]
    for key, values in CASES["training"].items():
        for value in values:
            words = [word for word in tiny if not word.startswith(f"{key}=")]
            folder = [f"run.dir=run{refused.count}"] if key not in ("run", "run.dir") else []
            refused("train", "quickstart", *words, *folder, f"{key}={value}")
    assert not list((tmp_path / "here").rglob("*.ckpt"))  # but nothing is trained


def test_recipes(refused, bad):
    refused.every = 3
    whole = "# @package _global_\ndefaults:\n  - /quickstart\n  - _self_\ntrainer: {max_steps: 5}\n"
    for text in (*CASES["recipes"], *(f"{whole}{line}\n" for line in CASES["recipe_lines"])):
        path = bad / f"recipe{refused.count}.yaml"
        path.write_bytes(text.encode())
        refused("train", str(path))


def test_real_processes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    lines = ["train none_such", "sample ckpt=none.ckpt text=a", "convert a.bvh unt=2"]
    with ThreadPoolExecutor(2) as pool:
        ended = pool.map(lambda line: finish(spawn(["flame_mdm", *line.split()], PYTHONPATH=str(ROOT))), lines)
    for line, (code, _, err) in zip(lines, ended, strict=True):
        assert code in (1, 2), (line, err)
        assert one_line(err), (line, err)
    assert not list(tmp_path.iterdir())


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
        yield from (content | {key: value} for value in ([], 3, "text", None, {}, {"a": "b"}, {1: 2}))
    for part in ("task", "denoiser", "process", "condition", "representation"):
        for value in (None, 3, {}, {"_target_": "os.system"}, {"_target_": "torch.nn.Linear"}, {"_target_": 3}):
            yield content | {"config": content["config"] | {part: value}}
    state, facts = content["state_dict"], content["facts"]
    name = next(iter(state))
    for value in (torch.zeros(3), "x", None, torch.zeros(0)):
        yield content | {"state_dict": state | {name: value}}
    yield content | {"state_dict": {f"x{key}": value for key, value in state.items()}}
    for fact in ({"actions": None}, {"actions": 3}, {"max_frames": None}, {"max_frames": "x"}, {"max_frames": -1}):
        yield content | {"facts": facts | fact}


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
    for words in (["sample", f"ckpt={path}", TEXT], ["export", str(path), "out=x"]):
        refused(*words)
    refused("import", "flame", str(path), "out=x")
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("readme.txt", "hello")
    refused("sample", f"ckpt={path}", TEXT)


def test_damaged_checkpoints(refused, trained, bad):
    refused.every = 6
    model = Path(export(trained, bad / "whole.safetensors")).read_bytes()
    for suffix, data in (("ckpt", trained.read_bytes()), ("safetensors", model)):
        path = bad / f"bad.{suffix}"
        for number, content in enumerate(mangled(data, 60, 2)):
            path.write_bytes(content)
            refused("export", str(path), "out=out.safetensors")
            if number % 6 == 0:
                refused("sample", f"ckpt={path}", TEXT)
                refused("evaluate", f"ckpt={path}", "extractor=none", "quick=true")
                refused("push", str(path), "a/b", "dry_run=true")
    path, size = bad / "bad.safetensors", int.from_bytes(model[:8], "little")
    head = json.loads(model[8 : 8 + size])
    recipe = json.loads(head["__metadata__"]["flame_mdm"])
    for change in (None, {"format": 99}, {"config": None}, {"config": {}}, {"facts": 3}, {"sha256": ""}):
        text = "{" if change is None else json.dumps(recipe | change)
        changed = json.dumps(head | {"__metadata__": {"flame_mdm": text}}).encode()
        path.write_bytes(len(changed).to_bytes(8, "little") + changed + model[8 + size :])
        refused("sample", f"ckpt={path}", TEXT)


# Motion files and data ------------------------------------------------------------------------------------------------


def broken_bvh() -> Iterator[str]:
    whole = bvh_text()
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


def broken_arrays() -> Iterator[dict[str, Any]]:
    joints: dict[str, Any] = {"joints": FOUR, "fps": np.float32(20)}
    shapes = ((), (0,), (4,), (4, 22), (4, 20, 3), (4, 22, 2), (0, 22, 3), (4, 0, 3), (2, 4, 22, 3))
    yield from (joints | {"joints": np.ones(shape)} for shape in shapes)
    yield from (joints | {"joints": np.full((4, 22, 3), value)} for value in (np.nan, np.inf, "x", 1e300, 1j))
    odd = (np.array({"a": 1}, object), np.array("text"), np.zeros((4, 22, 3), "datetime64[s]"))
    yield from (joints | {"joints": value} for value in odd)
    yield from (joints | {"fps": np.array(value)} for value in (0, -1, np.nan, np.inf, "x", [20, 20], [], 1j))
    yield from ({"fps": joints["fps"]}, {"joints": FOUR}, {})
    amass = {"poses": np.zeros((4, 156)), "trans": np.zeros((4, 3)), "mocap_framerate": 60.0}
    yield from (amass | {"poses": np.ones(shape)} for shape in ((), (4,), (4, 5), (3, 156), (4, 2)))
    yield from (amass | {"trans": np.ones(shape)} for shape in ((), (3,), (4, 2)))
    yield from (amass | {"mocap_framerate": np.array(rate)} for rate in (0, -1, np.nan, "x", [1, 2]))
    yield from (amass | {"poses": np.full((4, 156), value)} for value in (np.nan, "x"))
    yield amass | {"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))}


def test_damaged_motions(refused, bad, trained):
    refused.every = 6
    for text in broken_bvh():
        (bad / "bad.bvh").write_text(text)
        refused("convert", str(bad / "bad.bvh"), "out=out.json")
    (bad / "bad.bvh").write_bytes(b"HIERARCHY\n\xff\xfe")
    refused("convert", str(bad / "bad.bvh"), "out=out.json")
    run = a_run(bad / "run")
    (bad / "motions").mkdir()
    for path in (bad / "bad.npz", bad / "motions" / "motion.npz"):
        for content in broken_arrays():
            np.savez(path, **content)
            if path.name == "motion.npz":
                refused("compare", f"runs={run} {bad / 'motions'}")
                continue
            refused("convert", str(path), "out=out.bvh")
            if "poses" not in content:
                refused("edit", f"ckpt={trained}", f"motion={path}", "region=in_between", TEXT)
    for suffix in ("npz", "npy"):
        stream = io.BytesIO()
        np.savez(stream, joints=FOUR, fps=20.0) if suffix == "npz" else np.save(stream, FOUR)
        path = bad / f"bad.{suffix}"
        for number, data in enumerate(mangled(stream.getvalue(), 24, 5)):
            if number < 5 or number % 3 == 0:  # zip files may begin anywhere; headers have no checksum
                path.write_bytes(data)
                refused("convert", str(path), "out=out.json", *(["fps=20"] if suffix == "npy" else []))
    texts = [*NO_JSON, '{"joints": []}', '{"joints": [], "fps": 20}']
    texts += [f'{{"joints": {joints}, "fps": 20}}' for joints in ('"x"', "[[[1]]]", "[[1], [1, 2]]")]
    rates = (0, -1, "x", None, [], {}, float("nan"), True)
    texts += [json.dumps({"joints": FOUR.tolist(), "fps": fps}) for fps in rates]
    numbers = (float("nan"), float("inf"), 1e300)
    texts += [json.dumps({"joints": np.full((4, 22, 3), x).tolist(), "fps": 20}) for x in numbers]
    for data in (*(text.encode() for text in texts), b"\xff\xfe{}"):
        (bad / "bad.json").write_bytes(data)
        refused("convert", str(bad / "bad.json"), "out=out.bvh")


def test_damaged_own_data(refused, bad, tmp_path):
    refused.every = 9

    def own_data(name: str) -> Path:
        folder = bad / name
        folder.mkdir()
        for clip in "abc":
            np.savez(folder / f"{clip}.npz", joints=adult(60), fps=20.0)
            (folder / f"{clip}.txt").write_text("a person stands\n")
        return folder

    def case(name: str, data: str | bytes | None, *more: str) -> None:
        folder, root = own_data(f"data{refused.count}"), tmp_path / f"prepared{refused.count}"
        (folder / name).unlink(missing_ok=True)
        if data is not None:
            (folder / "b.npz").unlink() if name == "b.bvh" else None
            (folder / name).write_bytes(data.encode() if isinstance(data, str) else data)
        refused.watched.append(root)
        refused("prepare", "data=folder", f"source={folder}", f"data_root={root}", *more)

    assert main(["prepare", "data=folder", f"source={own_data('whole')}", f"data_root={bad / 'root'}"]) == 0
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
    refused.every = 6
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


def test_strange_texts_are_legal(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    texts = [
        "walk " * 390,
        "walk\x07b\x1b[31m c\x7f {a: [b",
        "走る ü \u202e '; $(rm) `x` \\<script>alert(1)</script> & </style>",
    ]
    for number, text in enumerate(texts):
        words = ["samples=1", "seconds=0.5", f"out=out{number}"]
        assert main(["sample", f"ckpt={trained}", f"text={text}", *words]) == 0, text[:50]
        assert "<script>alert(1)" not in (tmp_path / f"out{number}" / "player.html").read_text(encoding="utf-8")
        with np.load(tmp_path / f"out{number}" / "motion_000.npz") as file:
            assert str(file["text"]) == text


# Files of results and runs --------------------------------------------------------------------------------------------

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
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
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


def malformed(name: str, content: Any = None, count: int = 2) -> list[str]:
    """What a file may hold that is not what it should hold: `count` values of other kinds at each key, and the rest."""
    case, draw = CASES["files"][name], np.random.default_rng(9)
    content = case.get("content", content)
    texts = list(NO_JSON)
    for keys, value in values(content):
        wrong = WRONG[type(value)] if keys not in case.get("any", ()) else []
        texts += [replaced(content, keys, wrong[index]) for index in draw.permutation(len(wrong))[:count]]
    texts += [replaced(content, keys, ABSENT) for keys in case.get("required", ())]
    texts += [replaced(content, keys, value) for keys, wrong in case.get("wrong", {}).items() for value in wrong]
    text = json.dumps(content)
    return [*texts, *(text[: int(at)] for at in draw.integers(1, len(text) - 1, 8))]


def whole(name: str) -> str:
    return json.dumps(CASES["files"][name]["content"])


def test_specs_of_tables(refused, bad):
    refused.every = 8
    path = bad / "mine.yaml"
    words = [f"table={path}", "evaluate=false", "results=none"]
    path.write_text(whole("spec"))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 0, "but for what is changed below"
    for data in (*(text.encode() for text in (*malformed("spec"), *NO_YAML)), b"title: \xff\n"):
        path.write_bytes(data)
        refused("tables", *words)


def test_damaged_results(refused, bad):
    refused.every = 5
    spec, run = bad / "mine.yaml", a_run(bad / "run")
    content = CASES["files"]["spec"]["content"]
    spec.write_text(json.dumps({"title": "x", "parts": {"A": content["parts"]["A"]}}))
    ((_, (request, _)), _) = evaluations(load_spec(str(spec))["parts"]["A"])
    in_table, in_run = request.path(bad / "results"), run / "evaluation" / "p-1" / "x" / "result.json"
    words = [f"table={spec}", "evaluate=false", f"results={bad / 'results'}"]
    for path in (in_table, in_run):
        path.parent.mkdir(parents=True)
        path.write_text(whole("result"))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 3  # written, but the result is not valid
    assert main(["report", str(run)]) == 0
    (run / "report.html").unlink()
    refused.watched.append(run)
    numbers = [whole("result").replace("4.5", number) for number in ("1e999", "4.5.5", "1_0")]
    for number, text in enumerate([*malformed("result"), *numbers]):
        for path in (in_table, in_run):
            path.write_text(text)
        refused(*(["tables", *words] if number % 4 < 2 else ["report", str(run)]))


def test_damaged_runs(refused, bad):
    refused.every = 9
    run, other = a_run(bad / "run"), a_run(bad / "other")
    refused.watched.append(run)

    def case(name: str, text: str) -> None:
        before = (run / name).read_bytes() if (run / name).exists() else None
        (run / name).write_text(text, encoding="utf-8")
        refused("report", str(run))
        if refused.count % 6 == 0 and name != "bad_batch.json":  # which comparisons do not read
            refused("compare", f"runs={run} {other}")
        (run / name).unlink() if before is None else (run / name).write_bytes(before)

    for name in ("provenance", "bad_batch"):
        for text in malformed(name):
            case(f"{name}.json", text)
    for text in (*malformed("config", json.loads((run / "config.yaml").read_text()), 3), *NO_YAML):
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


def test_other_damaged_files(refused, bad, tmp_path):
    """Ratings and lengths of tables, times of benchmarks, notes for W&B."""
    refused.every = 8
    path, spec = bad / "ratings.json", bad / "mine.yaml"
    for text in malformed("ratings"):
        path.write_text(text)
        refused("compare", f"ratings={path}")
    spec.write_text(json.dumps({"title": "x", "parts": {"C": {"lengths": ["a"]}, "D": {"ratings": str(path)}}}))
    words = [f"table={spec}", "evaluate=false", f"results={bad}"]
    (bad / "lengths").mkdir()
    for file, name in ((path, "pairs"), (bad / "lengths" / "a.json", "lengths")):
        for text in malformed(name):
            file.write_text(text)
            refused("tables", *words)
        file.write_text(whole(name))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 0
    for text in (*NO_JSON, '{"a": "x"}', '{"a": null}', '{"a": [1]}', '{"a": true}'):
        (bad / "times.json").write_text(text)
        refused("benchmark", "synthetic", "evaluate=false", f"out={bad}")
    for text in malformed("wandb", count=3):
        (tmp_path / "wandb.json").write_text(text)
        with pytest.raises(UserError, match=r"wandb\.json"):
            WandbRun(str(tmp_path), offline=True)
