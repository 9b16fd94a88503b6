"""Exported models of other people: the runner and the web page check model.json and the graphs before they use them."""

import copy
import hashlib
import json
import math
import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fixtures import ROOT

from flame_mdm.checkpoints import runner

onnx = pytest.importorskip("onnx", reason="the extra onnx is not installed")
pytest.importorskip("onnxruntime", reason="the extra onnx is not installed")

JOINTS, FEATURES = 22, 66
FLOAT, INT64 = onnx.TensorProto.FLOAT, onnx.TensorProto.INT64
MISSING = object()
NAN, INFINITY = math.nan, math.inf


def tensor(name: str, *shape: int | str, kind: int = FLOAT) -> Any:
    return onnx.helper.make_tensor_value_info(name, kind, shape)


def graph(inputs: list[Any], outputs: list[Any], *nodes: tuple[Any, ...], **constants: Any) -> Any:
    """A model of nodes (operator, inputs, outputs, attributes)."""
    made = [
        onnx.helper.make_node(kind, read, written, **options)
        for kind, read, written, options in nodes
    ]
    initializers = [
        onnx.numpy_helper.from_array(np.array(value), name) for name, value in constants.items()
    ]
    content = onnx.helper.make_graph(made, "graph", inputs, outputs, initializers)
    return onnx.helper.make_model(
        content, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8
    )


def graphs() -> dict[str, bytes]:
    """Graphs with the inputs and outputs of exported ones, without weights."""
    words = [tensor("condition", 1, "words", 2, kind=INT64), tensor("counts", 1, kind=INT64)]
    noisy = [tensor("x_t", 1, "frames", FEATURES), tensor("t", 1), tensor("lengths", 1, kind=INT64)]
    denoiser = graph(
        [*noisy, *words],
        [tensor("output", 1, "frames", FEATURES)],
        ("Mul", ["x_t", "half"], ["output"], {}),
        half=np.float32(0.5),
    )
    joints = graph(
        [tensor("x", 1, "frames", FEATURES)],
        [tensor("joints", 1, "frames", JOINTS, 3)],
        ("Reshape", ["x", "shape"], ["joints"], {}),
        shape=[1, -1, JOINTS, 3],
    )
    poses = graph(
        [tensor("joints", "frames", JOINTS, 3)],
        [tensor("offsets", JOINTS, 3), tensor("quaternions", "frames", JOINTS, 4)],
        ("Gather", ["joints", "first"], ["offsets"], {"axis": 0}),
        ("Gather", ["joints", "four"], ["quaternions"], {"axis": 2}),
        first=0,
        four=[0, 1, 2, 0],
    )
    models = {"denoiser.onnx": denoiser, "joints.onnx": joints, "poses.onnx": poses}
    return {name: model.SerializeToString() for name, model in models.items()}


GRAPHS = graphs()
CONTENT: dict[str, Any] = {
    "format": 1,
    "experiment": "quickstart",
    "reads": "text",
    "buckets": 50,
    "max_words": 8,
    "actions": ["walk"],
    "vocabulary": ["walks"],
    "captions": ["a person walks"],
    "function_words": ["a", "person"],
    "features": FEATURES,
    "fps": 20,
    "max_frames": 60,
    "padded_frames": 0,
    "skeleton": {
        "joints": ["pelvis"] * JOINTS,
        "parents": [-1, *[0] * 21],
        "feet": [[1, 2], [3, 4]],
    },
    "clip_x0": False,
    "steps": [[9.0, 0.0, 1.0, 0.5, 0.5, 0.0, 0.1], [0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]],
    "sha256": {name: hashlib.sha256(content).hexdigest() for name, content in GRAPHS.items()},
}

COUNT = [MISSING, None, "1", [], {}, True, 1.5, -1, 10**12, 10**400, NAN, INFINITY]
TEXT_LIST = [MISSING, None, "a", {}, 5, [1], [None], [["a"]]]
HASH = [MISSING, None, 5, "", "x" * 64, "a" * 63, "A" * 64]
INVALID: dict[str, list[Any]] = {
    "reads": [MISSING, None, "", "texts", "text\n", 1, ["text"]],
    "experiment": [None, "", 1, "\x1b[31m", "a\nb"],
    "buckets": [*COUNT, 0],
    "max_words": [*COUNT, 0],
    "actions": [*TEXT_LIST, ["\x1b[31mwalk"], [""]],
    "vocabulary": TEXT_LIST,
    "captions": TEXT_LIST,
    "function_words": TEXT_LIST,
    "features": [*COUNT, 0],
    "fps": [MISSING, None, "20", [], True, 0, -20, 0.001, 1e9, NAN, INFINITY],
    "max_frames": [*COUNT, 1],
    "padded_frames": [*COUNT, 59],
    "start": [None, {}, [], [[]], [[1.0] * (FEATURES - 1)], [["1"] * FEATURES], [[NAN] * FEATURES]],
    "skeleton": [MISSING, None, [], "smpl22"],
    "skeleton.joints": [*TEXT_LIST, []],
    "skeleton.parents": [MISSING, None, [], ["a"], [NAN], [-2], [10**9], [0.5]],
    "skeleton.feet": [MISSING, None, 5, {}],
    "clip_x0": [MISSING, None, 0, 1, "false", []],
    "steps": [
        MISSING,
        None,
        {},
        [],
        [[]],
        [[1] * 6],
        [[1] * 8],
        [["1"] * 7],
        [[True] * 7],
        [[NAN] * 7],
        [[1e300] * 7],
    ],
    "sha256": [MISSING, None, [], "denoiser.onnx"],
    "sha256.denoiser.onnx": HASH,
    "sha256.joints.onnx": HASH,
    "sha256.poses.onnx": HASH[1:],
}
CASES = [(name, value) for name, values in INVALID.items() for value in values]


def mutated(name: str, value: Any) -> dict[str, Any]:
    content = copy.deepcopy(CONTENT)
    outer, _, inner = name.partition(".")
    part, key = (content[outer], inner) if inner else (content, outer)
    if value is MISSING:
        del part[key]
    else:
        part[key] = value
    return content


def write(folder: Path, content: dict[str, Any]) -> None:
    (folder / "model.json").write_text(json.dumps(content | {"digest": runner.digest(content)}))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "model"
    folder.mkdir()
    write(folder, CONTENT)
    for name, content in GRAPHS.items():
        (folder / name).write_bytes(content)
    return folder


def replaced(folder: Path, name: str, content: bytes) -> None:
    """Replaces a graph by one that model.json agrees with."""
    (folder / name).write_bytes(content)
    write(folder, mutated(f"sha256.{name}", hashlib.sha256(content).hexdigest()))


def test_a_folder_within_the_limits_is_sampled_from(folder: Path) -> None:
    sampler = runner.Sampler(folder)
    joints = sampler.decode(sampler.generate("a person walks"))
    offsets, quaternions = sampler.rotations(joints)
    assert (joints.shape, offsets.shape, quaternions.shape) == ((60, 22, 3), (22, 3), (60, 22, 4))


@pytest.mark.parametrize(
    ("name", "value"), CASES, ids=[f"{name}={str(value)[:12]!r}" for name, value in CASES]
)
def test_an_invalid_value_of_model_json_is_named(folder: Path, name: str, value: Any) -> None:
    write(folder, mutated(name, value))
    with pytest.raises(ValueError, match="not an exported model") as error:
        runner.Sampler(folder)
    assert f"model.json is damaged: {name}" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "content", ["[]", "7", "null", "{", "[" * 100_000, "\ud800", '{"format": 1}', '{"format": [1]}']
)
def test_a_model_json_that_is_no_description_is_refused(folder: Path, content: str) -> None:
    (folder / "model.json").write_bytes(content.encode("utf-8", "surrogatepass"))
    with pytest.raises(ValueError, match=r"not an exported model \(model\.json "):
        runner.Sampler(folder)


@pytest.mark.parametrize("kind", ["pipe", "folder", "device", "large", "missing"])
@pytest.mark.parametrize("name", ["model.json", "denoiser.onnx", "poses.onnx"])
def test_only_regular_files_of_limited_size_are_read(
    folder: Path, monkeypatch: pytest.MonkeyPatch, name: str, kind: str
) -> None:
    path = folder / name
    path.unlink()
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "large":
        monkeypatch.setattr(runner, "MAX_DESCRIPTION", 5000)
        monkeypatch.setattr(runner, "MAX_GRAPH", 5000)
        path.write_bytes(bytes(5001))
    with pytest.raises(ValueError, match=f"not an exported model .*{name}"):
        runner.Sampler(folder)


def with_external_data(key: bytes) -> bytes:
    """The denoiser with its weight in another file; `key` is the length and name of the entry with the file's name."""
    model = onnx.load_from_string(GRAPHS["denoiser.onnx"])
    weight = model.graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = onnx.TensorProto.EXTERNAL
    entry = weight.external_data.add()
    entry.key, entry.value = "location", "weights.bin"
    content = model.SerializeToString()
    assert content.count(b"\x08location") == 1
    return content.replace(b"\x08location", key) if len(key) == 9 else content


def test_a_graph_that_reads_other_files_is_refused(
    folder: Path, monkeypatch: pytest.MonkeyPatch, subtests
) -> None:
    monkeypatch.chdir(folder)
    (folder / "weights.bin").write_bytes(np.float32(0.5).tobytes())
    replaced(folder, "denoiser.onnx", with_external_data(b"\x08location"))
    with pytest.raises(ValueError, match=r"denoiser\.onnx reads data from other files"):
        runner.Sampler(folder)
    for length in (b"\x08", b"\x88\x00", b"\x88\x80\x80\x00"):
        with subtests.test(length=length):
            assert runner.EXTERNAL_DATA.search(b"k" + length + b"locationv")
    assert runner.EXTERNAL_DATA.search(b"allocation of locations") is None


def other_graph(kind: str) -> bytes:
    inputs = list(onnx.load_from_string(GRAPHS["denoiser.onnx"]).graph.input)
    if kind == "shape":
        node = ("Transpose", ["x_t"], ["output"], {"perm": [0, 2, 1]})
        return graph(inputs, [tensor("output", 1, FEATURES, "frames")], node).SerializeToString()
    if kind == "inputs":
        node = ("Identity", ["x_t"], ["output"], {})
        return graph(
            inputs[:1], [tensor("output", 1, "frames", FEATURES)], node
        ).SerializeToString()
    node = ("Log", ["x_t"], ["output"], {})
    return graph(inputs, [tensor("output", 1, "frames", FEATURES)], node).SerializeToString()


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("shape", "denoiser.onnx does not match model.json"),
        ("inputs", "denoiser.onnx cannot run: "),
        ("logarithm", "the model returned non-finite numbers"),
    ],
)
def test_a_graph_that_does_something_else_gets_one_line(
    folder: Path, tmp_path: Path, capfd: Any, kind: str, says: str
) -> None:
    replaced(folder, "denoiser.onnx", other_graph(kind))
    assert runner.main([str(folder), "walks", str(tmp_path / "out.npz")]) == 1
    error = capfd.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.npz").exists()


def test_a_graph_of_another_format_is_not_guessed(folder: Path) -> None:
    replaced(folder, "joints.onnx", b"\x10\x00\x00\x00ORTM" + bytes(100))
    with pytest.raises(ValueError, match=r"joints\.onnx is damaged: .*[Pp]rotobuf"):
        runner.Sampler(folder)


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("seconds=inf", "seconds=inf: give 0.1 to 3 seconds"),
        ("seconds=nan", "seconds=nan: give 0.1 to 3 seconds"),
        ("seconds=-1", "seconds=-1.0: give 0.1 to 3 seconds"),
        ("seconds=1e308", "seconds=1e+308: give 0.1 to 3 seconds"),
        ("seconds=abc", "seconds=abc: give a number"),
        ("seed=1.5", "seed=1.5: give a whole number"),
    ],
)
def test_options_of_the_runner_that_are_no_length_and_no_seed_get_one_line(
    folder: Path, tmp_path: Path, capfd: Any, word: str, says: str
) -> None:
    assert runner.main([str(folder), "walks", str(tmp_path / "out.npz"), word]) == 1
    assert capfd.readouterr().err == f"error: {says}\n"


@pytest.fixture
def javascript(tmp_path: Path) -> Callable[[str, Any], Any]:
    """A function that returns the value of an expression over `data`, with the names of tools/web/check.js."""
    if shutil.which("node") is None:
        pytest.skip("needs Node.js")
    shutil.copy(ROOT / "tools" / "web" / "check.js", tmp_path)
    (tmp_path / "schema.js").write_text(f"export const SCHEMA = {json.dumps(runner.SCHEMA)};")
    (tmp_path / "package.json").write_text('{"type": "module"}')

    def run(expression: str, data: Any) -> Any:
        (tmp_path / "data.json").write_text(json.dumps(data))
        lines = [
            'import { readFileSync } from "node:fs";',
            'import { check, faults, frameCount } from "./check.js";',
            'import { SCHEMA } from "./schema.js";',
            "const message = (test) => { try { return test() ?? null; } catch (error) { return error.message; } };",
            'const data = JSON.parse(readFileSync("data.json", "utf8"));',
            f"console.log(JSON.stringify({expression}));",
        ]
        (tmp_path / "run.js").write_text("\n".join(lines))
        done = subprocess.run(
            ["node", "run.js"], cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return json.loads(done.stdout)

    return run


def test_the_web_page_refuses_what_the_runner_refuses(
    javascript: Callable[[str, Any], Any],
) -> None:
    contents = [
        mutated(name, value)
        for name, value in CASES
        if "NaN" not in json.dumps(mutated(name, value))
    ]
    contents = [content for content in contents if "Infinity" not in json.dumps(content)]
    assert len(contents) > 120
    complete = [content | {"digest": "0" * 64} for content in (CONTENT, *contents)]
    expected = [runner.faults(content, runner.SCHEMA) for content in complete]
    assert javascript("data.map((content) => faults(content, SCHEMA))", complete) == expected
    messages = javascript("data.map((content) => message(() => check(content)))", complete)
    assert messages[0] is None
    assert all(message.startswith("model.json is damaged: ") for message in messages[1:])


def test_the_web_page_checks_the_seconds_of_a_link(javascript: Callable[[str, Any], Any]) -> None:
    counts = (
        "data.map((text) => message(() => frameCount(Number(text), { fps: 20, max_frames: 60 })))"
    )
    answers = javascript(counts, ["3", "0.1", "3.1", "0", "-2", "1e9", "1e400", "abc"])
    assert answers[:2] == [60, 2]
    assert all(answer.endswith(": give 0.1 to 3 seconds") for answer in answers[2:])
