"""Malformed input of every kind through every command: one line `error: ...`, nothing written, no traceback, no hang.

The slow groups take a share of their cases, always the same one; FLAME_MDM_FUZZ=all takes all of them.
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
from support.refusals import one_line
from support.runs import TINY
from test_report import a_run

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.formats.motion import END_SITES
from flame_mdm.representations.skeleton import SMPL22

pytestmark = pytest.mark.slow

TEXT = "text=a person walks"


def mangled(data: bytes, count: int, seed: int) -> Iterator[bytes]:
    """The data cut at, with bytes changed at, or with garbage at random places."""
    draw = np.random.default_rng(seed)
    yield from (b"", b"\0" * 100, data[:1], data[:-1], data[: len(data) // 2], b"PK\3\4" + data)
    for number in range(count - 6):
        at = int(draw.integers(len(data)))
        if number % 3 == 0:
            yield data[:at]
        elif number % 3 == 1:
            changed = bytearray(data)
            changed[at] ^= int(draw.integers(1, 256))
            yield bytes(changed)
        else:
            yield data[:at] + draw.bytes(int(draw.integers(1, 50))) + data[at + 20 :]


KEYS = {
    "train": ("seed", "data.batch_size", "trainer.max_steps", "denoiser.latent_dim", "optimizer.lr", "run.dir"),
    "sample": ("ckpt", "seconds", "samples", "seed", "guidance_scale", "sampler"),
    "edit": ("ckpt", "motion", "region", "joints", "cut", "until"),
    "evaluate": ("ckpt", "protocol", "extractor", "split", "samples", "batch_size"),
    "prepare": ("source", "check", "verify", "force", "data_root"),
    "browse": ("split", "search", "clips", "out", "data_root"),
    "convert": ("input", "out", "fps", "unit"),
    "tables": ("table", "evaluate", "out", "results"),
    "benchmark": ("evaluate", "out", "device", "batch_size"),
    "compare": ("runs", "texts", "ratings", "rate"),
    "report": ("runs",),
}
BROKEN = (
    "[",
    "{a",
    "'",
    '"x',
    "${nothing}",
    "${oc.env:NOT_SET_ANYWHERE}",
    "[1,",
    "${",
    "}",
    "a}b",
    "(",
    "x{",
    "${a.b}",
)
WORDS = ("=", "=1", "==", "no", "-x", "--nope", "é=1", "a..b=1", ".=1", "a.=1", "~", "~nothing", "+=1", "\x1b[31m=1")
WORDS += ("\u202e=1", "seed", "seed=1=", "seed=${seed}", "data=", "data=../base", "data=[a]", "seed=[${seed}]", "@a=1")


def words(command: str, seed: int, count: int) -> Iterator[list[str]]:
    """Misspelt keys, broken values, words that are no overrides."""
    draw = np.random.default_rng(seed)
    keys = KEYS[command]
    yield from ([word] for word in WORDS)
    for number in range(count):
        key = str(draw.choice(keys))
        if number % 3 == 0:
            at = int(draw.integers(1, len(key)))
            yield [f"{key[:at]}{draw.choice(list('qxzéß'))}{key[at:]}=1"]
        elif number % 3 == 1:
            yield [f"seed={draw.choice(BROKEN)}"]
        else:
            yield [f"~{key}"] if number % 2 else [f"{key}.deeper=1"]


@pytest.mark.parametrize("command", KEYS)
def test_words(refused, command):
    first = ["quickstart"] if command == "train" else []
    for number, bad_words in enumerate(words(command, 1, 21)):
        refused(command, *first, *bad_words)
        if number % 7 == 0 and first:
            refused(command, *bad_words)


def test_recipes(refused, bad):
    whole = "# @package _global_\ndefaults:\n  - /quickstart\n  - _self_\ntrainer: {max_steps: 5}\n"
    broken = [
        "",
        "[",
        "{",
        "a: b: c",
        "\t- x",
        "- a\n- b",
        "text",
        "3",
        "null",
        "a: &x [*x]",
        "a: *nothing",
        "? [",
        "!!python/object:os.system {}",
    ]
    broken += [
        "defaults: 3",
        "defaults: [3]",
        "defaults: [/none_such]",
        "defaults: [/data: none_such]",
        "defaults: [[a]]",
    ]
    broken += [
        "seed: ${seed}",
        "a: ${b}\nb: ${a}",
        "a: ${oc.env:NOT_SET_ANYWHERE}",
        "a: ${no_resolver:1}",
        "run: null",
        "trainer: 3",
    ]
    broken += [
        f"{whole}{line}\n" for line in ("trainer: {max_steps: 7}\n  x", "trainer: [1]", "denoiser: null", "data: 3")
    ]
    broken += [
        f"{whole}{line}\n"
        for line in ("denoiser: {_target_: os.system}", "denoiser: {_target_: 3}", "denoiser: {_target_: null}")
    ]
    broken += [
        f"{whole}{line}\n"
        for line in (
            "process: {_target_: flame_mdm.none.Such}",
            "callbacks: {x: {_target_: torch.nn.Linear}}",
            "callbacks: 3",
            "data: {source: null}",
            "condition: {_target_: }",
            "representation: text",
            "a: '\x00'",
        )
    ]
    for number, text in enumerate(broken):
        path = bad / f"recipe{number}.yaml"
        path.write_bytes(text.encode())
        refused("train", str(path))
    (bad / "latin.yaml").write_bytes(b"seed: \xe9\xff\n")
    (bad / "folder.yaml").mkdir()
    for path in ("latin.yaml", "folder.yaml", "none.yaml"):
        refused("train", str(bad / path))
    for name in (
        "none_such",
        "",
        "quick start",
        "../base",
        "base",
        "data/synthetic",
        "\0",
        "é",
        "/",
        ".",
        "quickstart.yaml",
        "x" * 5000,
    ):
        refused("train", name)


def test_settings_of_training(refused, tmp_path, data_root):
    refused.every = 5
    refused.watched = [data_root]  # a run that has begun to log leaves its folder
    values = {
        "data.batch_size": ("0", "-3", "many", "null", "1.5", "[1]", "{a:1}"),
        "trainer.max_steps": ("soon", "null", "1.5", "[1]"),
        "seed": ("zero", "null", "-1", "1.5", "[1]", "1e400"),
        "denoiser.num_heads": ("3", "0", "-1", "two", "null"),
        "denoiser.latent_dim": ("-1", "0", "1.5", "null"),
        "denoiser.num_layers": ("-1", "x", "null"),
        "denoiser.dropout": ("2", "-1", "x"),
        "process.num_train_timesteps": ("0", "-1", "x", "null", "1.5"),
        "process.schedule": ("none_such", "3", "null"),
        "process.prediction": ("none_such", "null"),
        "optimizer.lr": ("-1", "fast", "null"),
        "optimizer": ("null", "3"),
        "trainer.accelerator": ("abacus", "3"),
        "trainer.precision": ("7", "x"),
        "trainer.devices": ("0", "-2", "x", "null"),
        "trainer.val_check_interval": ("-1", "x"),
        "trainer.log_every_n_steps": ("x",),
        "task.num_inference_steps": ("99", "0", "-1", "x"),
        "task.sampler": ("none_such", "3"),
        "task.cond_drop_prob": ("2", "-1", "x"),
        "task.guidance_scale": ("x", "null", "nan"),
        "data.num_workers": ("-1", "x"),
        "data.resident": ("maybe", "3", "null"),
        "data.pad_multiple": ("0", "-1", "x", "null"),
        "data.source.clips": ("0", "-1", "x", "null"),
        "data.crop": ("null", "3"),
        "data.name": ("null", "''"),
        "data_root": ("null", "/dev/null/x"),
        "run.dir": ("null", "/dev/null/x", "/proc/none", "''"),
        "run": ("null", "3"),
        "callbacks": ("3", "[]"),
        "callbacks.samples.prompts": ("3", "[1]", "['']"),
        "callbacks.samples.seconds": ("-1", "x"),
        "callbacks.checkpoints.every_n_steps": ("0", "-1", "x"),
        "ema": ("3", "{decay: 2}", "{x: 1}"),
        "losses": ("null", "{joints: x}", "{none: 1}"),
        "denoiser": ("none_such", "null", "3"),
        "data": ("none_such", "null"),
        "logger": ("none_such", "3"),
        "condition": ("none_such",),
        "representation": ("none_such",),
    }
    tiny = [
        *TINY,
        f"data_root={data_root}",
        "callbacks.best=null",
        "trainer.max_steps=1",
        "logger=csv",
    ]
    for key, broken in values.items():
        for value in broken:
            words = [word for word in tiny if not word.startswith(f"{key}=")]
            folder = [f"run.dir=run{refused.count}"] if key not in ("run", "run.dir") else []
            refused("train", "quickstart", *words, *folder, f"{key}={value}")
    assert not list((tmp_path / "here").rglob("*.ckpt"))  # but nothing is trained


def test_requests(refused, trained):
    values = {
        "seconds": ("-1", "0", "1e9", "nan", "inf", "long", "[1,2]", "null2", "0.01"),
        "samples": ("0", "-1", "two", "1.5", "null", "1000000000000"),
        "seed": ("x", "null", "1.5", "[1]"),
        "sampler": ("none_such", "3", "[a]"),
        "num_inference_steps": ("-1", "0", "x", "1.5", "99", "1000000000"),
        "guidance_scale": ("big", "nan", "inf", "[1]"),
        "device": ("abacus", "3", "cuda:99"),
        "action": ("walk",),
        "unconditioned": ("true", "maybe"),
        "ckpt": ("/none/such.ckpt", "", ".", "/", "null", "/dev/null", "\0", "x" * 5000),
        "out": ("/dev/null/x", "/proc/none"),
        "text": ("", " ", "\t", "\n", "null"),
    }
    for key, broken in values.items():
        for value in broken:
            refused("sample", f"ckpt={trained}", TEXT, f"{key}={value}")
    for word in ("action=walk", "action=3", "text=null", "unconditioned=false"):
        refused("sample", f"ckpt={trained}", word)


@pytest.fixture
def walk(tmp_path) -> Path:
    """A motion to edit."""
    path = tmp_path / "walk.npz"
    np.savez(path, joints=body(30), fps=20.0)
    return path


def body(frames: int) -> np.ndarray:
    """(F, 22, 3), somebody who stands and sways."""
    from flame_mdm.representations.smpl import ADULT

    offsets = np.array(ADULT)
    joints = np.zeros((frames, 22, 3))
    for joint, parent in enumerate(SMPL22.parents):
        joints[:, joint] = offsets[joint] + (joints[:, parent] if parent >= 0 else 0)
    joints[..., 1] -= joints[..., 1].min()
    return (joints + 0.01 * np.sin(np.arange(frames) / 5)[:, None, None]).astype(np.float32)


def test_edits(refused, trained, walk):
    refused.every = 2
    values = {
        "region": (
            "none_such",
            "[1]",
            "[5,2]",
            "[-3,2]",
            "[0,9999]",
            "[a,b]",
            "3",
            "[]",
            "[[1,2],3]",
            "[0,0]",
            "{a:1}",
            "[nan,2]",
            "true",
        ),
        "region_seconds": ("[1]", "[5,2]", "[a,b]", "3", "[0,inf]", "x"),
        "joints": ("none_such", "[none_such]", "3", "[]", "[1]", "[[a]]", "{a:1}"),
        "cut": ("[1]", "[2,1]", "[0,99]", "x", "3", "[nan,1]", "[0,inf]"),
        "method": ("none_such", "3", "mfm"),
        "until": ("2", "x", "0.1"),
        "resample": ("0", "-1", "x", "2"),
        "samples": ("0", "x"),
        "motion": (
            "none.npz",
            "",
            "/",
            "x",
            "synthetic:none",
            ":",
            "a:b:c",
            "../x:y",
            ".npz",
            "none.bvh",
            "x.fbx",
            "\0.npz",
            "/dev/null",
        ),
        "data_root": ("null",),
    }
    for key, broken in values.items():
        for value in broken:
            extra = [] if key in ("region", "region_seconds", "joints") else ["region=in_between"]
            extra += ["motion=synthetic:000000"] if key == "data_root" else []
            refused("edit", f"ckpt={trained}", f"motion={walk}", TEXT, *extra, f"{key}={value}")


def test_evaluations(refused, trained, bad):
    refused.every = 2
    (bad / "empty").mkdir()
    (bad / "list.yaml").write_text("- 1\n")
    (bad / "broken.yaml").write_text("a: [\n")
    (bad / "bare.yaml").write_text("name: x\n")
    (bad / "foreign.yaml").write_text("_target_: os.system\ncommand: ls\n")
    (bad / "part.yaml").write_text("_target_: evaluators.protocol.Protocol\nname: x\n")
    (bad / "folder.yaml").mkdir()
    values = {
        "ckpt": ("", "none.ckpt", "/", "null", str(bad / "empty")),
        "protocol": (
            "none_such",
            "../base",
            str(bad / "none.yaml"),
            *(str(bad / f"{name}.yaml") for name in ("list", "broken", "bare", "foreign", "part", "folder")),
            "action_to_motion",
        ),
        "extractor": ("none.ckpt", str(trained), str(bad / "list.yaml"), str(bad / "empty"), "/dev/null"),
        "split": ("none_such", "null", "3", "[test]"),
        "seed": ("x", "null"),
        "replications": ("0", "-1", "x", "1.5"),
        "samples": ("0", "-1", "x"),
        "quick": ("maybe", "3", "null"),
        "sampler": ("none_such",),
        "num_inference_steps": ("0", "99", "x"),
        "guidance_scale": ("x", "nan"),
        "batch_size": ("0", "-1", "x"),
        "device": ("abacus",),
        "data_root": ("/none/such", "/dev/null"),
        "data": ("none_such", "bandai", "null"),
        "out": ("/dev/null/x.json", "/"),
        "from_samples": (str(bad / "empty"), "none"),
    }
    for key, broken in values.items():
        for value in broken:
            extra = [] if key == "extractor" else ["extractor=none"]
            extra += (
                ["ckpt=null", "data=synthetic", "data.source.clips=60", "protocol=synthetic"]
                if key == "from_samples"
                else []
            )
            refused("evaluate", f"ckpt={trained}", "quick=true", *extra, f"{key}={value}")


class Bomb:
    """What a pickle of strangers may hold: unpickled, it makes a file in the current folder."""

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
    refused.every = 3
    path = bad / "bad.ckpt"
    for number, value in enumerate(foreign(read_checkpoint(trained))):
        torch.save(value, path)
        refused("sample", f"ckpt={path}", TEXT)
        if number % 10 == 0:
            refused("evaluate", f"ckpt={path}", "extractor=none", "quick=true")
            refused("import", "mdm", str(path), str(trained), "out=out.safetensors")
    path.write_bytes(pickle.dumps(Bomb()))
    refused("sample", f"ckpt={path}", TEXT)
    refused("export", str(path), "out=x")
    refused("import", "flame", str(path), "out=x")
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("readme.txt", "hello")
    refused("sample", f"ckpt={path}", TEXT)


def test_damaged_checkpoints(refused, trained, bad, walk):
    whole = trained.read_bytes()
    path = bad / "bad.ckpt"
    for number, content in enumerate(mangled(whole, 60, 2)):
        path.write_bytes(content)
        refused("export", str(path), "out=out.safetensors")
        if number % 6 == 0:
            refused("sample", f"ckpt={path}", TEXT)
            refused("edit", f"ckpt={path}", f"motion={walk}", "region=in_between", TEXT)
            refused("evaluate", f"ckpt={path}", "extractor=none", "quick=true")
            refused("push", str(path), "a/b", "dry_run=true")


def test_damaged_model_files(refused, trained, bad):
    from flame_mdm.checkpoints.hub import export

    file = export(trained, bad / "whole.safetensors")
    whole = file.read_bytes()
    file.unlink()
    path = bad / "bad.safetensors"
    for number, content in enumerate(mangled(whole, 50, 3)):
        path.write_bytes(content)
        refused("export", str(path), "out=out.safetensors")
        if number % 10 == 0:
            refused("sample", f"ckpt={path}", TEXT)
    size = int.from_bytes(whole[:8], "little")
    head = json.loads(whole[8 : 8 + size])
    recipe = json.loads(head["__metadata__"]["flame_mdm"])
    for change in ({}, {"format": 2}, {"config": None}, {"config": {}}, {"facts": 3}, {"sha256": ""}, {"origin": None}):
        text = json.dumps(recipe | change) if change else "{"
        changed = json.dumps(head | {"__metadata__": {"flame_mdm": text}}).encode()
        path.write_bytes(len(changed).to_bytes(8, "little") + changed + whole[8 + size :])
        if change not in ({"origin": None},):  # not looked at to sample
            refused("sample", f"ckpt={path}", TEXT)


def test_words_of_checkpoints(refused, trained, bad):
    for arguments in (
        *(
            ["export"],
            ["export", "a"],
            ["export", "none.ckpt", "out=x"],
            ["import", "x", "y", "out=z"],
        ),
        *(["import", "mdm", "none.pt", "out=x"], ["import", "mdm", "none.pt", "args.json", "out=x"]),
        *(["import", "flame", str(trained), "out=x"], ["import", "mdm", str(trained), str(trained), "out=x"]),
        *(["push", str(trained), "noslash", "dry_run=true"], ["push", "none.ckpt", "a/b", "dry_run=true"]),
        *(["export", str(bad), "out=x"], ["export", str(trained), "out=/dev/null/x.safetensors"]),
        *(
            ["export", "\0", "out=x"],
            ["export", "", "out=x"],
            ["import", "mdm", str(trained), "num_heads=x", "out=y"],
        ),
    ):
        refused(*arguments)


def bvh(frames: int = 3) -> str:
    """A whole BVH file of SMPL's joints, in centimetres."""
    lines: list[str] = []

    def joint(index: int) -> None:
        from flame_mdm.representations.smpl import ADULT

        offset = " ".join(f"{100 * x:.3f}" for x in ADULT[index])
        kind = "Xposition Yposition Zposition " if index == 0 else ""
        lines.extend([f"{'JOINT' if index else 'ROOT'} {SMPL22.joints[index]}", "{", f"OFFSET {offset}"])
        lines.append(f"CHANNELS {6 if index == 0 else 3} {kind}Zrotation Xrotation Yrotation")
        for child, parent in enumerate(SMPL22.parents):
            if parent == index:
                joint(child)
        if SMPL22.joints[index] in END_SITES:
            lines.extend(["End Site", "{", "OFFSET 0 1 0", "}"])
        lines.append("}")

    joint(0)
    row = " ".join(["0 90 0", *["0"] * 66])
    return "\n".join(["HIERARCHY", *lines, "MOTION", f"Frames: {frames}", "Frame Time: 0.05", *[row] * frames]) + "\n"


def broken_bvh() -> Iterator[str]:
    whole = bvh()
    yield from ("", "HIERARCHY", "HIERARCHY\nMOTION\nFrames: 0\nFrame Time: 0.05\n", "x", "\0", whole.replace("}", ""))
    changes = [
        ("ROOT pelvis", "JOINT pelvis"),
        ("ROOT pelvis", "ROOT"),
        ("CHANNELS 6", "CHANNELS 5"),
        ("CHANNELS 3", "CHANNELS 99999999999"),
    ]
    changes += [
        ("CHANNELS 6", "CHANNELS -1"),
        ("CHANNELS 6", "CHANNELS x"),
        ("CHANNELS 3", "CHANNELS 2.5"),
        ("CHANNELS 6", "CHANNELS 1e300"),
        ("OFFSET", "OFFSET nan"),
        ("OFFSET 0", "OFFSET x"),
    ]
    changes += [("Zrotation", "Zturn"), ("Zrotation", "Xrotation")]
    changes += [
        ("Frames: 3", f"Frames: {value}") for value in ("4", "2", "0", "-3", "x", "3.5", "9" * 30, "9" * 5000, "")
    ]
    changes += [
        ("Frame Time: 0.05", f"Frame Time: {value}") for value in ("0", "-1", "nan", "inf", "x", "1e-300", "1e300", "")
    ]
    changes += [("0 90 0", f"{value} 90 0") for value in ("nan", "inf", "1e400", "x", "0 0", "", "1e38", "1_0 0")]
    changes += [
        ("JOINT left_hip", "JOINT other"),
        ("JOINT left_hip", "JOINT right_hip"),
        ("JOINT neck", "JOINT head"),
        ("MOTION", "motion x"),
        ("End Site", "End"),
        ("HIERARCHY", "HIERARCHY HIERARCHY"),
    ]
    changes += [("ROOT pelvis\n{", "ROOT pelvis\n{\nROOT again\n{"), ("OFFSET 0", "OFFSET 0 0"), ("JOINT", "joint \0")]
    for old, new in changes:
        changed = whole.replace(old, new, 1)
        if changed != whole:
            yield changed
    draw = np.random.default_rng(4)
    for _ in range(12):
        yield whole[: draw.integers(len(whole) - 140)]
    for _ in range(8):
        at = int(draw.integers(len(whole.partition("MOTION")[0])))
        yield whole[:at] + str(draw.choice(["{", "}", " x{ ", "\x1b"])) + whole[at:]
    yield "HIERARCHY\n" + "".join(f"{'JOINT' if n else 'ROOT'} j{n}\n{{\nOFFSET 0 0 0\n" for n in range(5000))


def test_damaged_bvh(refused, bad, trained):
    refused.every = 3
    path = bad / "bad.bvh"
    for number, text in enumerate(broken_bvh()):
        path.write_text(text)
        refused("convert", str(path), "out=out.json")
        if number % 10 == 0:
            refused("edit", f"ckpt={trained}", f"motion={path}", "region=in_between", TEXT)
    path.write_bytes(b"HIERARCHY\n\xff\xfe")
    refused("convert", str(path), "out=out.json")


def arrays(**changes: Any) -> dict[str, Any]:
    content = {"joints": body(4), "fps": np.float32(20)} | changes
    return {name: value for name, value in content.items() if value is not None}


def broken_arrays() -> Iterator[dict[str, Any]]:
    shapes = ((), (0,), (4,), (4, 22), (4, 20, 3), (4, 22, 2), (0, 22, 3), (4, 0, 3), (2, 4, 22, 3))
    yield from (arrays(joints=np.ones(shape)) for shape in shapes)
    yield from (arrays(joints=np.full((4, 22, 3), value)) for value in (np.nan, np.inf, -np.inf, "x", 1e300))
    yield arrays(joints=np.full((4, 22, 3), 1j))
    yield arrays(joints=np.array({"a": 1}, dtype=object))
    yield arrays(joints=np.array("text"))
    yield arrays(joints=np.zeros((4, 22, 3), "datetime64[s]"))
    yield from (arrays(fps=np.array(value)) for value in (0, -1, np.nan, np.inf, "x", [20, 20], [], 1j))
    yield arrays(joints=None)
    yield arrays(fps=None)
    yield {}
    poses, trans = np.zeros((4, 156)), np.zeros((4, 3))
    amass = {"joints": None, "fps": None, "poses": poses, "trans": trans, "mocap_framerate": 60.0}
    yield from (arrays(**amass | {"poses": np.ones(shape)}) for shape in ((), (4,), (4, 5), (3, 156), (4, 2)))
    yield from (arrays(**amass | {"trans": np.ones(shape)}) for shape in ((), (3,), (4, 2)))
    yield from (arrays(**amass | {"mocap_framerate": np.array(rate)}) for rate in (0, -1, np.nan, "x", [1, 2]))
    yield arrays(**amass | {"poses": np.full((4, 156), np.nan)})
    yield arrays(**amass | {"poses": np.full((4, 156), "x")})
    yield arrays(**amass | {"poses": np.zeros((0, 156)), "trans": np.zeros((0, 3))})


def test_damaged_arrays(refused, bad, trained):
    refused.every = 3
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
            if number == 5 or (
                number > 5 and number % 3 != 0
            ):  # zip files may begin anywhere; headers have no checksum
                continue
            path.write_bytes(data)
            refused("convert", str(path), "out=out.json", *(["fps=20"] if suffix == "npy" else []))


def test_damaged_json(refused, bad):
    path = bad / "bad.json"
    texts = [
        "",
        "{",
        "[]",
        "3",
        "null",
        "[" * 100000,
        '{"joints": []}',
        '{"joints": [], "fps": 20}',
        '{"joints": "x", "fps": 20}',
        '{"joints": [[[1]]], "fps": 20}',
        '{"joints": [[1], [1, 2]], "fps": 20}',
        "\ufeff{}",
        "NaN",
    ]
    texts += [
        json.dumps({"joints": body(4).tolist(), "fps": fps}) for fps in (0, -1, "x", None, [], {}, float("nan"), True)
    ]
    texts += [
        json.dumps({"joints": np.full((4, 22, 3), x).tolist(), "fps": 20}) for x in (float("nan"), float("inf"), 1e300)
    ]
    for text in texts:
        path.write_text(text)
        refused("convert", str(path), "out=out.bvh")
    path.write_bytes(b"\xff\xfe{}")
    refused("convert", str(path), "out=out.bvh")


def test_arguments_of_convert(refused, bad, walk):
    os.mkfifo(bad / "pipe.npz")
    (bad / "folder.npz").mkdir()
    for arguments in (
        *([], ["out=x.glb"], [str(walk)], ["none.bvh", "out=x.glb"], [str(walk), "out=x.fbx"], [str(walk), "out=x"]),
        *([str(walk), "out=x.bvh", f"fps={fps}"] for fps in ("-2", "0", "nan", "inf", "x", "[1]", "1e400")),
        *([str(walk), "out=x.bvh", f"unit={unit}"] for unit in ("-2", "0", "nan", "x", "1")),
        *([str(bad / name), "out=x.bvh"] for name in ("pipe.npz", "folder.npz", "", "none.npz")),
        *([str(walk), f"out={out}"] for out in ("/dev/null/x.bvh", "", ".bvh/", str(bad / "folder.npz"))),
        *(["x" * 5000 + ".npz", "out=x.bvh"], ["\0.npz", "out=x.bvh"], [str(walk), str(walk), "out=x.bvh"]),
    ):
        refused("convert", *arguments)


def own_data(folder: Path) -> None:
    """Three motions with captions, well formed."""
    folder.mkdir()
    for name in "abc":
        np.savez(folder / f"{name}.npz", joints=body(60), fps=20.0)
        (folder / f"{name}.txt").write_text("a person stands\n")


def test_damaged_own_data(refused, bad, tmp_path):
    refused.every = 3

    def case(change: Callable[[Path], Any], *more: str) -> None:
        folder = bad / f"data{refused.count}"
        own_data(folder)
        change(folder)
        root = tmp_path / f"prepared{refused.count}"
        refused.watched.append(root)
        refused("prepare", "data=folder", f"source={folder}", f"data_root={root}", *more)

    for name in "abc":
        case(lambda folder, name=name: (folder / f"{name}.txt").unlink())
    for content in ("", "\n\n", "# x\n", "   "):
        case(lambda folder, content=content: (folder / "b.txt").write_text(content))
    case(lambda folder: (folder / "b.txt").write_bytes(b"\xff\xfe\xff"))
    case(lambda folder: [path.unlink() for path in folder.glob("*.npz")])
    case(lambda folder: (folder / "b.npy").write_bytes(b"x"))
    tables = (
        "",
        "x\n",
        "id\n",
        "id,text\n",
        "id,text\nz,stands\n",
        "id,text\na,b,c\n",
        'id,text\na,"x\n',
        "id,split\na,none\n",
        "id,id\na,b\n",
        "id,text,bogus\na,b,c\n",
        "id,text\n\0,b\n",
    )
    for table in tables:
        if table not in ("id\n", "id,text\n"):
            case(lambda folder, table=table: (folder / "captions.csv").write_text(table))
    case(lambda folder: (folder / "captions.csv").write_bytes(b"id,text\na,\xff\n"))
    for text in (
        "",
        "{",
        "[]",
        "3",
        '{"z": {"text": "x"}}',
        '{"a": 3}',
        '{"a": {"bogus": 1}}',
        '{"a": {"text": 3}}',
        '{"a": {"split": 3}}',
        '{"a": {"text": {"b": 1}}}',
        '{"a": {"action": ["x"]}}',
    ):
        case(lambda folder, text=text: (folder / "captions.json").write_text(text))
    for text in (
        "[",
        "- a",
        "bogus: 1",
        "up: w",
        "unit: 0",
        "unit: x",
        "unit: .nan",
        "fps: -1",
        "map: {pelvis: x}",
        "map: 3",
        "joints: [a]",
        "mirrored: 3",
        "!!python/object:os.system {}",
        "fps: true",
        "up: [y]",
        "3",
    ):
        case(lambda folder, text=text: (folder / "skeleton.yaml").write_text(text))
    for content in list(broken_arrays())[::3]:
        case(lambda folder, content=content: np.savez(folder / "b.npz", **content))
    for text in list(broken_bvh())[::7]:
        case(lambda folder, text=text: ((folder / "b.npz").unlink(), (folder / "b.bvh").write_text(text)))
    for word in (
        "data.source.exclude=[none]",
        "data.source.motion=none",
        "data.source.mirror=maybe",
        "data.source.motion=smpl",
        "representation=none",
        "data.source.path=null",
        "data.name=null",
    ):
        case(lambda folder: None, word)


def test_arguments_of_prepare_and_browse(refused, bad):
    refused.every = 3
    (bad / "file.zip").write_bytes(b"x")
    for arguments in (
        *([], ["data=none_such"], ["data=bandai"], ["data=synthetic", "source=x"], ["data=null"], ["data=bandai,kit"]),
        *(
            [f"data={data}", f"source={source}"]
            for data in ("bandai", "humanml3d", "kit", "babel", "humanact12", "uestc", "folder")
            for source in ("/none/such", bad, bad / "file.zip", "/dev/null", "\0")
        ),
        *(["data=synthetic", f"data.source.clips={n}", "force=true"] for n in ("0", "-1", "x", "null", "1.5")),
        *(
            ["data=synthetic", "data_root=/dev/null"],
            ["data=synthetic", "verify=true", "data_root=none"],
            ["data=synthetic", "check=maybe"],
        ),
    ):
        refused("prepare", *map(str, arguments))
    for arguments in (
        *(
            ["data=none_such"],
            ["data=folder"],
            ["data=synthetic", "split=none"],
            ["data=synthetic", "search=no such words"],
        ),
        *(["data=synthetic", f"clips={n}"] for n in ("0", "-1", "x", "null", "1.5")),
        *(["data=synthetic", f"out={out}"] for out in ("/dev/null/x.html", "/proc/none/x.html", "/")),
        *(["data=synthetic", "split=[a]"], ["data=synthetic", "split=3"]),
    ):
        refused("browse", *arguments, *(["data.source.clips=60"] if "data=synthetic" in arguments else []))


def test_damaged_stores(refused, bad, data_root, trained):
    refused.every = 3
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
    texts = [
        "walk " * 390,
        "a\x07b\x1b[31m c\x7f",
        "<script>alert(1)</script> & </style>",
        "走る ü \u202e x",
        "'; $(rm) `x` \\",
        "{a: [b",
    ]
    for number, text in enumerate(texts):
        assert (
            main(["sample", f"ckpt={trained}", f"text={text}", "samples=1", "seconds=0.5", f"out=out{number}"]) == 0
        ), text[:50]
        page = (tmp_path / f"out{number}" / "player.html").read_text(encoding="utf-8")
        assert "<script>alert(1)" not in page
        with np.load(tmp_path / f"out{number}" / "motion_000.npz") as file:
            assert str(file["text"]) == text
    capfd.readouterr()


Place = tuple[str | int, ...]
"""The keys that lead to a value in what a file holds."""


def places(content: Any, place: Place = ()) -> Iterator[tuple[Place, Any]]:
    """All values, those that hold others before these."""
    yield place, content
    for key, value in content.items() if isinstance(content, dict) else enumerate(content or ()):
        if isinstance(value, dict | list):
            yield from places(value, (*place, key))
        else:
            yield (*place, key), value


def replaced(content: Any, place: Place, value: Any) -> Any:
    """A copy with another value in a place."""
    if not place:
        return value
    copy: Any = dict(content) if isinstance(content, dict) else list(content)
    copy[place[0]] = replaced(content[place[0]], place[1:], value)
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
"""Values of other kinds than the one in a place."""


def misfits(content: Any, each: int, seed: int, without: Sequence[Place] = ()) -> Iterator[Any]:
    """Copies of what a file holds with a wrong value in a place, `each` of them a place."""
    draw = np.random.default_rng(seed)
    for place, value in places(content):
        if place not in without:
            choices = WRONG[type(value)]
            for index in draw.permutation(len(choices))[:each]:
                yield replaced(content, place, choices[index])


def lacking(content: Any, names: Sequence[Place]) -> Iterator[Any]:
    """Copies without a key."""
    for *place, name in names:
        found = content
        for key in place:
            found = found[key]
        yield replaced(content, tuple(place), {key: value for key, value in found.items() if key != name})


NO_JSON = (
    "",
    " ",
    "{",
    "[]",
    "3",
    "null",
    "NaN",
    '"x"',
    "[" * 100_000,
    "\ufeff{}",
    "{'a': 1}",
    '{"a": 1} {"b": 2}',
    "\0",
)
NO_JSON += ('{"x": "\\ud800"}', "{" + '"a":{' * 5000, "1" * 5000)


def cut(text: str, count: int, seed: int) -> Iterator[str]:
    """A text that ends too soon, at random places."""
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
    refused.every = 4
    found: Any
    path = bad / "mine.yaml"
    words = [f"table={path}", "evaluate=false", "results=none"]
    path.write_text(json.dumps(SPEC))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 0, "but for what is changed below"
    sweep = ("parts", "A", "rows", 0, "num_inference_steps")
    one_or_more = [sweep, ("figures", 0, "y"), ("notes",), ("parts", "A", "rows")]
    cases = [json.dumps(content) for content in misfits(SPEC, 2, 7, one_or_more)]
    for place in one_or_more:
        cases += [json.dumps(replaced(SPEC, place, value)) for value in ({"a": 1}, True)]
    part, row = ("parts", "A"), ("parts", "A", "rows", 0)
    required: list[Place] = [("title",), ("parts",), (*part, "protocol"), (*part, "columns"), (*part, "rows")]
    required += [(*part, "columns", "FID", "value"), (*row, "label"), (*row, "ckpt")]
    required += [("figures", 0, name) for name in ("part", "x", "y")]
    cases += [json.dumps(content) for content in lacking(SPEC, required)]
    for place, key in (((), "tittle"), (part, "protcol"), (row, "guidence_scale"), (("figures", 0), "z")):
        found = SPEC
        for name in place:
            found = found[name]
        cases.append(json.dumps(replaced(SPEC, place, {**found, key: 1})))
    for place, value in (
        ((*part, "columns", "FID", "better"), "up"),
        ((*row, "baseline"), "static"),
        (("figures", 0, "part"), "none"),
        (("figures", 0, "part"), "D"),
        (("figures", 0, "x"), "none"),
        (("figures", 0, "y"), ["none"]),
        (("parts", "B", "recipes", "MDM"), "../base"),
        (("parts", "B", "keys", "batch"), "none_such"),
    ):
        *inside, name = place
        found = SPEC
        for key in inside:
            found = found[key]
        cases.append(json.dumps(replaced(SPEC, tuple(inside), {**found, name: value})))
    for text in (*cases, *SPECS, *cut(json.dumps(SPEC), 10, 8)):
        path.write_text(text)
        refused("tables", *words)
    path.write_bytes(b"title: \xff\n")
    refused("tables", *words)
    for name in ("none_such", "published", "", " ", "synthetic none", "\0", "é", "../base", "/", "x" * 5000, str(bad)):
        refused("tables", f"table={name}", "evaluate=false")


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
    required: list[Place] = [(name,) for name in ("quick", "protocol", "split", "data", "seed", "extractor", "values")]
    required += [("protocol", "name"), ("data", "fingerprint"), ("checkpoint", "sha256"), ("values", "fid", "mean")]
    text = json.dumps(RESULT)
    yield from map(json.dumps, misfits(RESULT, 2, 9))
    yield from map(json.dumps, lacking(RESULT, required))
    yield from (text.replace("4.5", number) for number in ("NaN", "Infinity", "-Infinity", "1e999", "4.5.5", "1_0"))
    yield from NO_JSON
    yield from cut(text, 10, 10)


def test_damaged_results(refused, bad):
    from flame_mdm.reporting.tables import load_spec, requests

    refused.every = 3
    spec, run = bad / "mine.yaml", a_run(bad / "run")
    spec.write_text(json.dumps({**SPEC, "parts": {"A": SPEC["parts"]["A"]}}))
    ((_, (request, _)), _) = requests(load_spec(str(spec))["parts"]["A"])
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
    in_run.write_bytes(b"\xff")
    refused("report", str(run))


PROVENANCE: dict[str, Any] = {
    "command": ["train"],
    "commit": None,
    "changed": "",
    "python": "3.11",
    "machine": "x",
    "packages": {"torch": "2"},
    "data": {"fingerprint": "f", "max_frames": 60},
    "device": "cpu",
    "parameters": 5,
}
FAULT: dict[str, Any] = {
    "step": 5,
    "usual_loss": "0.5",
    "batches": [{"rank": 0, "batch": 5, "ids": ["a"], "loss": "nan"}],
}


def test_damaged_runs(refused, bad):
    refused.every = 4
    run, other = a_run(bad / "run"), a_run(bad / "other")
    refused.watched.append(run)

    def case(name: str, text: str) -> None:
        whole = (run / name).read_bytes() if (run / name).exists() else None
        (run / name).write_text(text, encoding="utf-8")
        refused("report", str(run))
        if refused.count % 6 == 0 and name != "bad_batch.json":  # which comparisons do not read
            refused("compare", f"runs={run} {other}")
        (run / name).unlink() if whole is None else (run / name).write_bytes(whole)

    free = [("data", "max_frames")]
    for name, content, without in (("provenance.json", PROVENANCE, free), ("bad_batch.json", FAULT, [])):
        for broken in misfits(content, 2, 11, without):
            case(name, json.dumps(broken))
        for text in (*NO_JSON, *cut(json.dumps(content), 5, 12)):
            case(name, text)
    config = json.loads((run / "config.yaml").read_text())
    for broken in misfits(config, 3, 13, [("run", "name"), ("run", "dir")]):
        case("config.yaml", json.dumps(broken))
    for broken in lacking(config, [("experiment",), ("run",), ("trainer",), ("trainer", "max_steps")]):
        case("config.yaml", json.dumps(broken))
    for text in (*SPECS, *cut(json.dumps(config), 5, 14)):
        case("config.yaml", text)
    line = '{"step": 3, "train/loss": 1.5}\n'
    values = ('"x"', "null", "[]", "{}", "true", "1_0", "'1'")
    broken_lines = [line.replace("1.5", value) for value in values]
    broken_lines += [line.replace("3", step) for step in (*values, "-1", "1.5", "NaN", "1e999", "9" * 400)]
    broken_lines += ["\n", *(f"{text}\n" for text in NO_JSON if text != "null"), line.replace("step", "stop")]
    for number, text in enumerate((*broken_lines, line[:-9] + "\n")):
        case("metrics.jsonl", [text, line + text, text + line][number % 3])
    for name in ("provenance.json", "metrics.jsonl", "config.yaml"):
        folder = a_run(bad / f"bytes-{name}")
        (folder / name).write_bytes(b"\xff\xfe{}\n")
        refused("report", str(folder))
    for runs in (
        "",
        " ",
        "'",
        '"a b',
        "none",
        "/",
        "\0",
        "x" * 5000,
        str(bad),
        f"{run} none",
        "''",
        str(run / "config.yaml"),
    ):
        refused("report", f"runs={runs}")


def test_arguments_of_compare(refused, bad):
    first, second = a_run(bad / "a"), a_run(bad / "b", name="two")
    both = f"runs={first} {second}"
    (bad / "empty").mkdir()
    (bad / "motions").mkdir()
    (bad / "latin.txt").write_bytes(b"a person \xe9\n")
    (bad / "empty.txt").write_text("\n \n")
    (bad / "folder.txt").mkdir()
    for runs in (
        "",
        " ",
        "'",
        "a",
        f"{first}",
        f"{first} {first}",
        f"{first} none",
        f"{first} {bad / 'empty'}",
        "\0 a",
    ):
        refused("compare", f"runs={runs}")
    for texts in (
        "",
        ";",
        " ; ",
        "a person walks",
        *(str(bad / f"{n}.txt") for n in ("none", "latin", "empty", "folder")),
    ):
        if texts:
            refused("compare", both, f"texts={texts}")
    for word in ("seed=x", "rate=maybe", "rate=3", "seconds=x", "ratings=a", "out=/dev/null/x.html", "rate=true"):
        refused("compare", both, word)
    for content in list(broken_arrays())[1::4]:
        np.savez(bad / "motions" / "motion.npz", **content)
        refused("compare", f"runs={first} {bad / 'motions'}")
    (bad / "motions" / "motion.npz").write_bytes(b"PK\3\4x")
    refused("compare", f"runs={first} {bad / 'motions'}")


def test_damaged_ratings_and_lengths(refused, bad):
    refused.every = 4
    path = bad / "ratings.json"
    answers = {"study": "s", "rater": "ann", "ratings": [{"prompt": "p", "a": "x", "b": "y", "choice": "a"}]}
    texts = [json.dumps(content) for content in misfits(answers, 2, 15, [("ratings", 0, "prompt")])]
    texts += [json.dumps(replaced(answers, place, "")) for place in (("study",), ("rater",), ("ratings", 0, "a"))]
    texts += [json.dumps(replaced(answers, ("ratings", 0, "choice"), choice)) for choice in ("c", "A", "ab")]
    for text in (*texts, *NO_JSON, *cut(json.dumps(answers), 5, 16)):
        path.write_text(text)
        refused("compare", f"ratings={path}")
    path.write_text(json.dumps(answers))
    for files in (f"{path} {path}", "none.json", "'", "", "/", str(bad), f"{path} none.json"):
        refused("compare", f"ratings={files}")
    spec = bad / "mine.yaml"
    spec.write_text(json.dumps({"title": "x", "parts": {"C": {"lengths": ["a"]}, "D": {"ratings": str(path)}}}))
    words = [f"table={spec}", "evaluate=false", f"results={bad}"]
    counted = {"pairs": [{"a": "x", "b": "y", "wins_a": 1, "wins_b": 2, "raters": 1}]}
    lengths = {"fingerprint": "f", "fps": 20.0, "lengths": [10, 30]}
    (bad / "lengths").mkdir()
    for file, whole in ((path, counted), (bad / "lengths" / "a.json", lengths)):
        texts = [json.dumps(content) for content in misfits(whole, 2, 17)]
        for place, value in ((("pairs", 0, "wins_a"), -1), (("fps",), 0), (("lengths",), []), (("lengths",), [-5, 3])):
            if place[0] in whole:
                texts.append(json.dumps(replaced(whole, place, value)))
        for text in (*texts, *NO_JSON[::2]):
            file.write_text(text)
            refused("tables", *words)
        file.write_text(json.dumps(whole))
    assert main(["tables", *words, f"out={bad / 'out'}"]) == 0


def test_arguments_of_benchmark(refused, bad):
    refused.every = 3
    for name in ("none_such", "", "synthetic.yaml", "../base", "bandai synthetic", "\0", "é", "null", "x" * 5000):
        refused("benchmark", f"exp={name}", "evaluate=false")
    for word in ("evaluate=maybe", "batch_size=x", "batch_size=null", "out=/dev/null/x", "steps=3", "Out=x"):
        refused("benchmark", "synthetic", "evaluate=false", word)
    for text in (*NO_JSON, '{"a": "x"}', '{"a": null}', '{"a": [1]}', '{"a": true}'):
        (bad / "times.json").write_text(text)
        refused("benchmark", "synthetic", "evaluate=false", f"out={bad}")


def test_damaged_notes_for_wandb(tmp_path):
    from flame_mdm.errors import UserError
    from flame_mdm.training.loggers import WandbRun

    content = {"id": "abc", "step": 3, "rows": 5}
    for text in (*map(json.dumps, misfits(content, 3, 18)), *NO_JSON, *cut(json.dumps(content), 4, 19)):
        (tmp_path / "wandb.json").write_text(text)
        with pytest.raises(UserError, match=r"wandb\.json"):
            WandbRun(str(tmp_path), offline=True)


PROCESSES = [
    *[("train", *words) for words in (["none_such"], ["quickstart", "seeed=1"], ["quickstart", "seed=["], ["a.yaml"])],
    *[("sample", *words) for words in ([], ["ckpt=none.ckpt", "text=a"], ["text="], ["sead=1"], ["ckpt=x", "seed='"])],
    *[("edit", *words) for words in ([], ["frmes=x"], ["~seed"])],
    *[("evaluate", *words) for words in ([], ["split=none"])],
    *[("prepare", *words) for words in ([], ["data=bandai", "sorce=x"])],
    *[("convert", *words) for words in (["out=x.bvh"], ["a.bvh", "unt=2"])],
    *[("tables", "table=none"), ("report", "none"), ("compare", "runs=a"), ("benchmark", "none")],
    *[("browse", "data=none_such"), ("export", "none.ckpt", "out=x")],
]


def test_real_processes(tmp_path):
    assert len(PROCESSES) == 24

    def run(words: Sequence[str]) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "flame_mdm", *words]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        return subprocess.run(
            command, capture_output=True, text=True, env=environment, cwd=tmp_path, check=False, timeout=120
        )

    with ThreadPoolExecutor(2) as pool:
        for words, done in zip(PROCESSES, pool.map(run, PROCESSES), strict=True):
            assert done.returncode in (1, 2), (words, done)
            assert one_line(done.stderr, words[0]), (words, done.stderr)
    assert not list(tmp_path.iterdir())
