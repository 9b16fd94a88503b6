"""Results of reading and writing files, of the records of runs, and of messages, as recorded."""

import contextlib
import errno
import fcntl
import io
import itertools
import json
import os
import re
import warnings
import zipfile
from pathlib import Path
from typing import Any, Literal
from unittest import mock

import numpy as np
import pytest
import yaml
from pydantic import Field
from support.outcomes import printed, without, workspace
from support.pages import a_run, result
from support.recorded import Case, cases_of, check, combinations, outcome, record

from flame_mdm import errors, runs, safe_io, schemas
from flame_mdm.records import AuditCard, Result, Value, percentiles
from flame_mdm.safe_io import paths
from flame_mdm.sampler_options import SamplerOptions

NAME = "training_files"

ODD = 'a\tb\x1b[0m \u202eright\u2066 \ud800 x\u2028y\rz | *b* _i_ `c` ~d~ # [l](u) \\ <i> & "q"'


# Errors and printed lines ------------------------------------------------------------------------


def first_lines() -> Any:
    texts = ["", "a\nb", "a:\nb", "a:\n\n  b\nc", "only:", "\n a: \n b:\nc", "a :x\nb", " \n "]
    return [errors.first_line(ValueError(text)) for text in texts] + [
        errors.first_line(KeyError()),
        errors.first_line(errors.UserError()),
    ]


def suggestions() -> Any:
    names = ["walk", "walks", "walked", "walking", "jump", "latent_dim", "latent_dims"]
    words = ("walk", "wlk", "wakl", "jmp", "latent", "xyz", "ju", "WALK", "")
    return {
        word: [errors.did_you_mean(word, names), errors.did_you_mean(word, [])] for word in words
    }


def shortened_texts() -> Any:
    rows: list[Any] = []
    for most, size in itertools.product((5, 40), (3, 4, 5, 6, 39, 40, 41, 60)):
        rows.append(errors.shortened(("abcdefghij" * 6)[:size], most))
    rows += [errors.shortened(ODD.replace("\ud800", "?"), most) for most in (8, 12, 16, 300)]
    rows += [len(errors.shortened("y" * size)) for size in (1999, 2000, 2001, 5000)]
    return rows


def printable_texts() -> Any:
    every = "".join(map(chr, [*range(0x00, 0xA8), 0x61C, 0x200E, 0x2028, 0x2029, 0xFEFF, 0xD801]))
    texts = (ODD, every, "plain\n\n\ntext", "")
    return [
        [shown(text) for shown in (errors.printable, errors.one_line, errors.markdown_text)]
        for text in texts
    ]


def said_lines() -> Any:
    def say_all() -> None:
        errors.show_as("/tmp/secret.npz", "walk.npz")
        errors.say("reads /tmp/secret.npz twice: /tmp/secret.npz", 17, ODD.replace("\ud800", ""))
        errors.say()
        for size in (1999, 2000, 2001, 4001):
            errors.say("".join(chr(97 + k % 26) for k in range(size)), error=True)
            errors.say("".join(chr(97 + k % 23) for k in range(size)))

    with mock.patch.dict(errors.__dict__["_shown"], clear=True):
        _, out, err = printed(say_all)
        after = list(errors.__dict__["_shown"].items())
    return [out[:300], [len(line) for line in out.split("\n")], err.split("\n"), after]


def lines_to_a_closed_pipe() -> Any:
    with workspace():
        with Path("out").open("w") as file:

            class Closed(io.StringIO):
                def write(self, text: str) -> int:
                    raise BrokenPipeError

                def fileno(self) -> int:
                    return file.fileno()

            with contextlib.redirect_stdout(Closed()):
                errors.say("first", "second")
            os.write(file.fileno(), b"dropped")
        return Path("out").read_text()


def renamed_names_of_modules() -> Any:
    get = errors.renamed_names("flame_mdm.errors", {"OldError": "UserError"}, since="0.3")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        named = get("OldError").__name__
        with pytest.raises(AttributeError) as unknown:
            get("Other")
    return named, str(unknown.value), [(str(w.message), w.category.__name__) for w in caught]


# Sampler options ---------------------------------------------------------------------------------


def sampler_options_and_refusals() -> Any:
    choices: dict[str, list[Any]] = {
        "guidance_scale": [None, 0, 1, 2.5, -1.0, float("nan"), float("inf"), "2", True],
        "sampler": [None, "ddim", 3],
        "num_inference_steps": [
            None,
            1,
            0,
            100_000,
            100_001,
            [0, 2, 5],
            (0, 100_000),
            [0, 100_001],
            [-1, 2],
            [],
            True,
            2.0,
            [1, 2.5],
        ],
        "eta": [None, 0, 0.25, 1, 1.01, -0.01, float("inf")],
        "spacing": [None, "linspace", "stride", "cosine"],
    }
    rows = []
    for name, values in choices.items():
        rows += [
            (name, str(v), outcome(lambda k, v: SamplerOptions(**{k: v}).chosen(), name, v))
            for v in values
        ]  # type: ignore[misc]
    return rows


def sampler_options_over_defaults() -> Any:
    choices: dict[str, Any] = {
        "guidance_scale": (None, 0.0, 2.5),
        "sampler": (None, "ddim"),
        "num_inference_steps": (None, 10, [0, 3, 7]),
        "eta": (None, 0.0, 0.5),
        "spacing": (None, "stride"),
    }
    first = combinations(1, 12, **choices)
    second = combinations(2, 12, **choices)
    return [
        (a, b, SamplerOptions(**a).over(SamplerOptions(**b)).chosen())
        for a, b in zip(first, second, strict=True)
    ]


# Schemas -----------------------------------------------------------------------------------------


class Small(schemas.Schema):
    """A schema of one value of each kind."""

    name: str
    count: schemas.Int = 3
    share: schemas.Number | None = None
    kind: Literal["a", "b"] = "a"
    rows: list[list[schemas.Int]] = Field([])
    by_name: dict[str, schemas.Plain] = Field({})
    on: bool = False


class Closed(schemas.ClosedSchema):
    """A schema that refuses unknown keys."""

    latent_dim: schemas.Int = 1
    inner: Small | None = None


SHAPES: list[Any] = [
    {"name": "n"},
    {"name": 3},
    {},
    [],
    "text",
    None,
    {"name": "n", "count": 2**63 - 1},
    {"name": "n", "count": 2**63},
    {"name": "n", "count": -(2**63)},
    {"name": "n", "count": -(2**63) + 1},
    {"name": "n", "rows": [[1, 2], [2**70]]},
    {"name": "n", "count": 1.0},
    {"name": "n", "count": True},
    {"name": "n", "share": "0.5"},
    {"name": "n", "share": 1e300},
    {"name": "n", "share": -1e300},
    {"name": "n", "share": 9.9e299},
    {"name": "n", "share": float("nan")},
    {"name": "n", "kind": "c"},
    {"name": "n", "rows": [[1, 2], [3, "x"]]},
    {"name": "n", "rows": {"a": 1}},
    {"name": "n", "by_name": {"a": None, "b": 1.5, "c": [1]}},
    {"name": "n", "by_name": {1: 2}},
    {"name": "n" * 50, "on": "n" * 60},
    {"name": "n", "on": "m" * 37},
    {"name": "n", "on": "m" * 38},
    {"name": "n", "on": 1, "extra": 5},
]


def contents_of_schemas() -> Any:
    rows = [outcome(lambda c: schemas.check_shape(c, Small).model_dump(), c) for c in SHAPES]
    closed = [
        {},
        {"latent_dims": 2},
        {"xyz": 2},
        {"data.crop": 1},
        {"latent_dim": "x"},
        {"inner": {"name": 3}},
        {"inner": {"name": "n", "rows": [1]}},
        {1: 2},
        {"inner": {}},
        3,
    ]
    rows += [outcome(lambda c: schemas.check_shape(c, Closed).model_dump(), c) for c in closed]
    for kind, content in itertools.product(
        (int, float, bool, list[str], dict[str, float | int], str | None),
        (1, 1.5, "1", True, None, ["a", 1], {"a": 1, "b": 2.5}, {"a": "b"}, 2**63),
    ):
        for strict in ((), (False,)):
            rows.append(outcome(schemas.check_shape, content, kind, *strict))
    return rows


def plain_contents_of_files() -> Any:
    deep: Any = 1
    for _ in range(60):
        deep = [deep]
    contents: list[dict[str, Any]] = [
        {"name": "n"},
        {"name": "${a}"},
        {"name": "n", "rows": deep},
        {"name": 1},
        {"name": "n", "x": {1.5: 2}},
        {"name": "n", "x": {3: (1, 2)}},
        {"name": "n", "x": {1, 2}},
    ]
    return [
        outcome(lambda c: schemas.check_plain(c, Small, Path("m.json")).model_dump(), content)
        for content in contents
    ]


def json_files_of_schemas() -> Any:
    with workspace():
        texts = [
            '{"name": "n"}',
            '{"name": 1}',
            "{",
            "[NaN]",
            '{"name": "\\ud800"}',
            "",
            "[" * 9999,
        ]
        rows = []
        for text, remedy in itertools.product(texts, ((), ("delete it",))):
            Path("a.json").write_text(text)
            rows.append(str(outcome(schemas.read_json, Path("a.json"), Small, *remedy))[:160])
        Path("big.json").write_text('{"name": "n"}' + " " * 4 * 2**20)
        rows += [
            outcome(schemas.read_json, Path(name), Small, "get it")
            for name in ("none.json", "big.json")
        ]
        return rows


# Records of evaluations --------------------------------------------------------------------------


def halves_and_counts_of_values() -> Any:
    rng = np.random.default_rng(3)
    drawn = rng.gamma(2.0, 3.0, 41).tolist()
    rows = []
    for row in combinations(
        5,
        60,
        mean=(None, 5.5, -2.0),
        ci=(None, 0.25),
        replications=(None, 0, 1, 2, 3),
        n=(None, 64),
        n_per_replication=([], [64], [64, 64], [64, 5, 64]),
        resampled=([], drawn, [*drawn, None], [None], drawn[:3]),
    ):
        value = Value(**row)
        rows.append([value.half, value.counts])
    return rows, [percentiles(drawn[:n], v) for n, v in ((41, 5.5), (7, -1.25), (1, 0.0))]


def _results() -> list[Result]:
    value: dict[str, Any] = {"mean": 1.5, "ci": 0.25, "replications": 2}
    changes: list[dict[str, Any]] = [
        {},
        {"values": None},
        {"values": {}},
        {"values": {"a": None, "b": {**value, "n": 0}, "c": {**value, "n": 7}}},
        {"values": {"b": {**value, "n": 0}}},
        {"values": {"b": {**value, "n": 5, "replications": None}}},
        {"values": {"a": {**value, "n": 3}, "b": {**value, "n": 7}, "c": {**value, "n": 7}}},
        {"values": {"a": {**value, "n": None, "n_per_replication": [4, 6]}}},
        {"checkpoint": None, "samples_sha256": "abc", "baseline": "def"},
        {"checkpoint": None, "baseline": "def"},
        {"checkpoint": None, "samples_sha256": "abc"},
        {"extractor": {"sha256": "e1"}},
        {"seed": 1},
        {"split": "val"},
        {"protocol": {"name": "p", "version": 3, "sha256": "f00"}},
        {"data": {"dataset": "synthetic", "fingerprint": "abd"}},
        {"skeleton": {"stand_in": True}},
        {"skeleton": {"stand_in": False, "smpl_sha256": "x"}},
    ]
    return [schemas.check_shape(result(**change), Result) for change in changes]


def results_of_evaluations() -> Any:
    return [[r.counts, r.origin, r.stand_in_skeleton] for r in _results()], _results()[
        0
    ].model_dump()


def refused_results() -> Any:
    wrong: list[dict[str, Any]] = [
        {"seed": 1.5},
        {"data": {"dataset": "x", "fingerprint": "y", "frames": [1]}},
        {"data": {"dataset": "x", "fingerprint": "y", "frames": [1, 2, 3]}},
        {"values": {"fid": {"mean": "x", "ci": 1, "replications": 1, "n": 1}}},
        {"checkpoint": {"path": "x"}},
        {"split": None},
        {"changed": {"a": [1]}},
    ]
    with workspace():
        rows = []
        for change in wrong:
            Path("r.json").write_text(json.dumps(result(**change)))
            rows.append(outcome(runs.read_result, Path("r.json")))
        return rows


def audit_cards() -> Any:
    card: dict[str, Any] = {
        "format": 1,
        "extractor": {"sha256": "e", "name": "n"},
        "protocol": {"name": "p", "version": 1},
        "data": {"dataset": "d", "fingerprint": "f"},
        "split": "test",
        "motions": 5,
        "seed": 0,
        "resamples": 10,
        "packages": {},
        "metrics": {"fid": False, "x": None},
        "real": {"fid": [1.0, None]},
        "not_computed": {},
        "truth": {},
        "perturbations": [
            {
                "name": "noise",
                "group": "g",
                "about": "a",
                "unit": "m",
                "grades": [{"grade": 1.0, "values": {"fid": [1.0, 2.0, 3.0, None]}}],
            }
        ],
    }
    changes: list[dict[str, Any]] = [
        {},
        {"facts": {"fid": {}}},
        {"facts": {"fid": {"exact": True, "unit": "m"}}},
        {"real": {"fid": [1.0]}},
        {"real": {"fid": [1.0, 2.0, 3.0]}},
        {"perturbations": []},
        {"extra": 1},
        {"extractor": None},
        {"perturbations": [card["perturbations"][0] | {"grades": []}]},
        {"perturbations": [card["perturbations"][0] | {"grade": 1}]},
        {"facts": {"fid": {"units": "m"}}},
    ]
    return [
        outcome(lambda c: schemas.check_shape(c, AuditCard).model_dump(), card | change)
        for change in changes
    ]


# Run directories ---------------------------------------------------------------------------------


def hints_for_missing_files() -> Any:
    names = (
        "runs/synthetic/mdm/default/checkpoints/last.ckpt",
        "runs/mdm/other/checkpoints/last.ckpt",
        "assets/t2m.pt",
        "x/assets/y.pt",
        "runs/a/default/checkpoints",
        "runs/default/checkpoints/x",
        Path("runs/q/default/checkpoints/deep/x.ckpt"),
    )
    return [runs.made_by(name) for name in names]


def contents_of_runs() -> Any:
    with workspace() as folder:
        rows: list[Any] = []
        provenance: dict[str, Any] = {
            "command": ["x"],
            "commit": None,
            "python": "3",
            "machine": "m",
            "packages": {},
            "data": {"hours": 2.5, "fingerprint": "f"},
        }
        variants: list[tuple[dict[str, Any], dict[str, Any] | None]] = [
            ({}, None),
            ({"experiment": None}, provenance),
            ({"trainer": {}}, None),
            ({"run": {"name": 3}}, provenance | {"parameters": 5, "changed": "M a"}),
            ({"run": {}}, provenance | {"parameters": "5"}),
            ({"run": 3}, None),
            ({"trainer": {"max_steps": 2.5}}, None),
            ({"task": {"_target_": "flame_mdm.task.MotionGeneration"}}, None),
        ]
        for number, (changes, facts) in enumerate(variants):
            path = a_run(Path(f"r{number}"), "default" if number % 3 else "other", **changes)
            if facts:
                (path / "provenance.json").write_text(json.dumps(facts))
            for step in ("0000010", "0000009", "last", "11")[: number + 1]:
                (path / "samples" / f"step_{step}").mkdir(parents=True)
                (path / "samples" / f"step_{step}" / "motion_000.npz").write_text("")
            for name in (
                "evaluation/b/result_1.json",
                "evaluation/result.json",
                "evaluation/a/x.json",
            ):
                (path / name).parent.mkdir(parents=True, exist_ok=True)
                (path / name).write_text(json.dumps(result(seed=number)))
            run = outcome(runs.read_run, path)
            rows.append(run)
            if isinstance(run, runs.Run):
                rows[-1] = [
                    run.label,
                    run.samples,
                    run.steps,
                    run.provenance and run.provenance.model_dump(),
                    list(run.results),
                    [r.seed for r in run.results.values()],
                    run.curves,
                    run.config,
                ]
        Path("empty").mkdir()
        rows += [outcome(runs.read_run, Path("empty")), outcome(runs.check_run, Path("none"))]
        rows += [
            outcome(runs.check_run, Path("r0")),
            runs.Run(Path("empty"), {}, None, {}, {}).samples,
        ]
        for curves in (
            {},
            {"val/x": {5: 1.0}},
            {"train/a": {5: 1.0, 3: 2.0}, "samples/b": {7: 1.0}},
        ):
            rows.append(runs.Run(Path("empty"), {}, None, curves, {}).steps)
        return without(folder, rows)


def histories() -> Any:
    good = [
        {"step": 5, "a": 1.5, "epoch": 0},
        {"step": 3, "b": 2, "a": 2.0},
        {"step": 5, "a": 3.5},
        {"step": 0, "c/d": -1.0},
    ]
    bad = (
        '{"step": 1.0}',
        '{"step": -1}',
        '{"a": 1}',
        '{"step": true}',
        '{"step": 1, "a": "x"}',
        "[]",
        '{"step": 1, "\\ud800": 1}',
        '{"step": 2',
        "",
        '{"step": 1, "a": null}',
        '{"step": 0, "a": NaN}',
    )
    with workspace():
        rows: list[Any] = [runs.read_history(Path())]
        lines = "".join(json.dumps(line) + "\n" for line in good)
        for end in ("", '{"step": 9, "a', '{"step": 9, "a": 1}'):
            Path("metrics.jsonl").write_text(lines + end)
            rows += [runs.read_history(Path()), runs.records(Path("metrics.jsonl"))]
        for line in bad:
            Path("metrics.jsonl").write_text(lines + line + "\n" + lines)
            rows.append(
                str(outcome(runs.records, Path("metrics.jsonl"))).replace("\ud800", "?")[:120]
            )
        return rows


# Files -------------------------------------------------------------------------------------------


def _listing(folder: str | Path = ".") -> list[Any]:
    """Names, kinds and contents of all files below a folder."""
    rows = []
    for path in sorted(Path(folder).rglob("*")):
        kind = "link" if path.is_symlink() else "folder" if path.is_dir() else "file"
        rows.append([path.as_posix(), kind, path.read_bytes().hex()[:60] if path.is_file() else ""])
    return rows


def _fill(
    write: Any, path: str, text: str = "new", fault: Exception | None = None, **options: Any
) -> None:
    with write(path, **options) as temporary:
        files = [temporary / "a", temporary / "b"] if temporary.is_dir() else [temporary]
        for file in files:
            file.write_text(text)
        if fault:
            raise fault


def atomic_writes() -> Any:
    rows: list[Any] = []
    for write in (safe_io.atomic_write, safe_io.atomic_folder):
        with workspace() as folder:
            Path("out").mkdir()
            Path("out/c").write_text("kept")
            Path("out/a").write_text("old")
            Path("file").write_text("old")
            Path("link").symlink_to("file")
            Path("away").symlink_to("/usr")
            Path("inside").mkdir()
            Path("inside/up").symlink_to("../out")
            os.mkfifo("pipe")
            full = OSError(errno.ENOSPC, "No space left", None)
            named, other = (
                OSError(errno.EIO, "broken", "x/y"),
                OSError(errno.EACCES, "denied", "/etc/x"),
            )
            faults = (
                errors.UserError("bad"),
                ValueError("bad"),
                full,
                named,
                other,
                OSError("plain"),
            )
            for path in ("x", "deep/er/x", "file", "out", "link", "pipe", "file/x"):
                rows.append(outcome(_fill, write, path))
            for fault in faults:
                for path in ("x/y", "gone/z"):
                    text = str(outcome(_fill, write, path, "half", fault))
                    rows.append(re.sub(r"[\d.]+ [KMGT]iB", "SIZE", text))
            for path, within in (
                ("inside/q", "inside"),
                ("inside/up/q", "inside"),
                ("away/q", "."),
                ("out/q", "."),
            ):
                rows.append(outcome(_fill, write, path, within=within))
            Path("pipe").unlink()
            rows.append(_listing())
            rows = without(folder, rows)
    return rows


def written_texts() -> Any:
    with workspace() as folder:
        content = {"b": [1, 2.5, None], "a": "ü"}
        Path("w").mkdir()
        Path("w/up").symlink_to("..")
        rows: list[Any] = [outcome(safe_io.write_json, "nan.json", {"x": float("nan")})]
        for number, indent in enumerate((0, None, 4)):
            rows.append(outcome(safe_io.write_json, f"{number}.json", content, indent))
        safe_io.write_json("d.json", content)
        safe_io.write_text("ü.txt", "ü\n€")
        for within in (None, "w"):
            rows.append(outcome(safe_io.write_text, "w/up/x", "t", within=within))
            rows.append(outcome(safe_io.write_json, "w/up/y", 1, within=within))
        rows += [(p.name, p.read_text()) for p in sorted(Path().glob("*")) if p.is_file()]
        rows += [[safe_io.sha256("d.json"), safe_io.sha256(Path("ü.txt"))]]
        return without(folder, rows)


def reasons_of_failed_writes() -> Any:
    rows: list[Any] = []
    cases: list[BaseException] = [
        OSError(errno.EACCES, "denied"),
        ValueError("a\nb"),
        OSError(),
        OSError(errno.ENOSPC, "full"),
        OSError(errno.EDQUOT, "quota"),
        OSError(errno.EFBIG, "big"),
        OSError(errno.EIO, "io"),
        OSError(errno.EROFS, "ro"),
    ]
    with workspace() as folder, mock.patch("shutil.disk_usage") as usage:
        usage.return_value.free = 3_456_789
        rows += [safe_io.write_failure(error, Path("gone/x/y")) for error in cases]
        return without(folder, rows), list(safe_io.FULL)


def sizes_of_files() -> Any:
    sizes = (
        0,
        1,
        999,
        999.5,
        1000,
        1023,
        1024,
        10_300,
        1024 * 999.4,
        1024 * 999.5,
        2**20,
        5.55e8,
        2**30,
        3e12,
        2e15,
    )
    return [safe_io.__dict__["_size"](size) for size in sizes]


def names_in_errors() -> Any:
    def run(error: Exception | None, *kinds: type[Exception], **options: str) -> str:
        with safe_io.naming("f.x", *kinds, **options):
            if error:
                raise error
        return "none"

    rows = []
    for error in (
        None,
        errors.UserError("bad"),
        errors.UserError("f.x: bad"),
        ValueError("v\nw"),
        OSError("o"),
    ):
        for kinds in ((), (ValueError,), (KeyError, OSError)):
            rows += [outcome(run, error, *kinds), outcome(run, error, *kinds, prefix="p: ")]
    return rows


def created_folders() -> Any:
    with workspace():
        Path("here").mkdir()
        for path, keeps in (("here", False), ("a/b/c", False), ("d/e", True), ("here/x/y", False)):
            with safe_io.made_folder(Path(path)):
                if keeps:
                    Path(path, "f").write_text("")
        return _listing()


def locks() -> Any:
    rows: list[Any] = []

    def hold(path: str, note: str = "careful") -> None:
        def busy(owner: str) -> None:
            raise errors.UserError(f"busy: {owner}")

        with safe_io.locked(Path(path), busy, note) as dead:
            rows.append([dead, Path(path).read_text().split(" on ")[0].split()[0]])
            rows.append(Path(path).read_text().startswith(f"process {os.getpid()} on "))

    with workspace() as folder:
        Path("dead.lock").write_text("process 1 on x\n")
        Path("link.lock").symlink_to("dead.lock")
        for path in ("new/run.lock", "dead.lock", "link.lock"):
            rows.append(printed(hold, path))
        for code in (errno.EAGAIN, errno.EACCES, errno.ENOLCK):
            Path("held.lock").write_text("process 5 on y\n")
            with mock.patch.object(fcntl, "lockf", side_effect=OSError(code, "locked")):
                rows.append(printed(hold, "held.lock"))
        return without(folder, [rows, _listing()])


def regular_files() -> Any:
    with workspace() as folder:
        Path("f").write_bytes(b"12345")
        Path("sub").mkdir()
        os.mkfifo("pipe")
        Path("loop").symlink_to("loop")
        Path("link").symlink_to("f")
        pointer = safe_io.GIT_LFS + b"v1\n"
        Path("lfs").write_bytes(pointer)
        for size in (1023, 1024):
            Path(f"lfs{size}").write_bytes(pointer.ljust(size))
        Path("big").write_bytes(b"0" * 2000)
        rows = []
        for name in (
            "f",
            "sub",
            "pipe",
            "loop",
            "link",
            "lfs",
            "lfs1023",
            "lfs1024",
            "none",
            "f/x",
            "a\0b",
            "big",
        ):
            for limit in ((), (4,), (5,), (1999,)):
                rows.append(outcome(safe_io.regular_file, name, *limit))
        return without(folder, rows)


def texts_and_json_of_files() -> Any:
    texts: list[bytes] = [
        b'{"a": [1, 2.5]}',
        "ü€".encode(),
        b"\xff\xfe",
        b"[NaN]",
        b"[Infinity]",
        b"[-Infinity]",
        b"",
        rb'["\ud800"]',
        rb'["\ud83d\ude00"]',
        b"[" * 99999,
        b'{"a": 1',
        b'"\xc3\xbc"',
        b"12345",
        b"123456",
    ]
    with workspace():
        rows = []
        for text in texts:
            Path("t").write_bytes(text)
            for read in (safe_io.read_text, safe_io.read_json):
                rows += [str(outcome(read, "t"))[:200], str(outcome(read, "t", 5))[:200]]
            rows.append(str(outcome(safe_io.parse_json, text))[:120])
        rows += [outcome(safe_io.read_text, "none"), outcome(safe_io.read_json, "none")]
        return rows, [
            safe_io.TEXT_LIMIT,
            safe_io.YAML_LIMIT,
            safe_io.ARRAYS_LIMIT,
            safe_io.INFLATION,
        ]


def yaml_files() -> Any:
    texts = [
        "a: 1e-4\nb: [1, two, null, true]\nc: ${a}",
        "",
        "  \n",
        "- 1\n- {x: y}",
        "a: &x [1, 2]\nb: *x",
        f"a: {'1' * 20}",
        f"a: {'1' * 21}",
        f"{'1' * 21}: 2",
        f"a: x{'1' * 30}",
        "a: [1",
        "a: !!python/name:os.system x",
        "&x [*x]",
        "a: &a [" + "1," * 400 + "]\nb: &b [" + "*a," * 300 + "]",
        "a: 2020-01-01",
        "3",
        "# c\nx: {y: {z: '1'}}",
        "a: 'x\\ud800'",
        'a: "\\ud800"',
        "b: .nan",
        "a: 0x1F\nb: 1_000\nc: on",
    ]
    with workspace():
        rows = []
        for text in texts:
            Path("t.yaml").write_text(text)
            value = outcome(safe_io.read_yaml, "t.yaml")
            rows.append(value if len(str(value)) < 300 else str(value)[:160])
        Path("t.yaml").write_text("a: 1 #" + "x" * safe_io.YAML_LIMIT)
        rows.append(outcome(safe_io.read_yaml, "t.yaml"))
        Path("p.yaml").write_text("a: 1e-4\nb: 1.0e-4\nc: {x: ü, y: on}", encoding="utf-8")
        rows.append(safe_io.read_package_yaml(Path("p.yaml")))
        with mock.patch.object(safe_io, "YAML_NODES", 24):
            for count in (3, 4):
                Path("t.yaml").write_text("a: &a [1, 2, 3]\nb: [" + "*a," * count + "]")
                rows.append(outcome(safe_io.read_yaml, "t.yaml"))
        rows.append([safe_io.YAML_NODES, safe_io.YAML_DIGITS])
        nodes = safe_io.__dict__["_nodes"]
        for text in ("a: &x [1, {b: 2}]\nc: *x", "3", "", "[[], {}]"):
            rows.append(nodes(yaml.compose(text, yaml.SafeLoader), {}))
        return rows


def _arrays() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "x": rng.normal(size=(3, 2)),
        "n": np.arange(5, dtype=np.int32),
        "s": np.array("text"),
        "e": np.zeros((0, 4)),
        "f": np.asfortranarray(rng.normal(size=(2, 3))),
        "scalar": np.array(2.5),
    }


def archives_of_arrays() -> Any:
    with workspace():
        np.savez("a.npz", **_arrays())  # type: ignore[arg-type]
        np.savez_compressed("c.npz", **_arrays(), zeros=np.zeros(5000))  # type: ignore[arg-type]
        rows: list[Any] = []
        for name in ("a.npz", "c.npz"):
            for options in (
                {},
                {"skip": ["x", "q"]},
                {"only": ["n", "x"]},
                {"only": ["n", "x"], "skip": ["n"]},
                {"only": []},
            ):
                rows.append(safe_io.read_npz(Path(name), **options))
        with Path("a.npz").open("rb") as file:
            file.seek(7)
            rows.append(list(safe_io.read_npz(file)))
        np.savez("o.npz", o=np.array([{}, 1], dtype=object), x=np.ones(3))
        Path("cut.npz").write_bytes(Path("a.npz").read_bytes()[:-40])
        Path("bad.npz").write_bytes(Path("a.npz").read_bytes().replace(b"(3, 2)", b"(3, 3)"))
        with zipfile.ZipFile("bz.npz", "w", zipfile.ZIP_BZIP2) as archive:
            archive.writestr("x.npy", b"1" * 100)
        with zipfile.ZipFile("text.npz", "w") as archive:
            archive.writestr("x.npy", "text")
        for name in ("o.npz", "cut.npz", "bad.npz", "bz.npz", "text.npz", "none.npz"):
            rows.append(str(outcome(safe_io.read_npz, Path(name)))[:120])
        rows.append(outcome(safe_io.read_npz, Path("o.npz"), only=["x"]))
        with Path("bad.npz").open("rb") as file:
            rows.append(str(outcome(safe_io.read_npz, file))[:100])
        return rows


def arrays_of_files() -> Any:
    with workspace():
        rows: list[Any] = []
        for name, array in _arrays().items():
            np.save(f"{name}.npy", array)
            for mmap in ((), (True,)):
                options = {"mmap": True} if mmap else {}
                read = safe_io.read_npy(Path(f"{name}.npy"), **options)
                rows.append([name, read, type(read).__name__, read.dtype.str, read.flags.writeable])
            with Path(f"{name}.npy").open("rb") as file:
                rows.append(safe_io.read_npy(file))
        good = Path("x.npy").read_bytes()
        for number, content in enumerate(
            (
                good + b"0",
                good[:-1],
                good[:5],
                b"",
                good.replace(b"(3, 2)", b"(3,-2)"),
                b"\x93NUMPY\x03\x00" + good[8:],
                good.replace(b"'<f8'", b"'|V0'"),
            )
        ):
            Path("w.npy").write_bytes(content)
            rows.append([number, str(outcome(safe_io.read_npy, Path("w.npy")))[:110]])
        np.save("o.npy", np.array([{}], dtype=object))
        rows.append(outcome(safe_io.read_npy, Path("o.npy")))
        return rows


def limits_of_archives() -> Any:
    rows: list[Any] = [outcome(safe_io.check_members, n) for n in (0, 200_000, 200_001)]
    limit = 128 * 2**20
    pairs = ((limit, 0), (limit + 1, 0), (20 * 2**24, 2**24), (20 * 2**24 + 1, 2**24), (5, 1))
    rows += [outcome(safe_io.check_expansion, *pair) for pair in pairs]
    for flags, method in itertools.product((0, 1, 2, 3), (0, 8, 12, 14, 93)):
        member = zipfile.ZipInfo("m")
        member.flag_bits, member.compress_type = flags, method
        rows.append(outcome(safe_io.check_member, member))
    reader = safe_io.__dict__["_DirectoryReader"]
    for limit, size in ((None, 7), (5, 5), (5, 6), (5, -1), (5, 300_000), (200_001, 200_002)):
        directory = reader(io.BytesIO(b"0123456789"))
        rows.append(directory.limit)
        directory.limit = limit
        rows.append(str(outcome(directory.read, size)))
    return rows


def checked_paths() -> Any:
    with workspace() as folder:
        for name in ("run/wandb/offline-1/logs", "run/sub", "other"):
            Path(name).mkdir(parents=True)
        Path("other/f").write_text("")
        rows: list[Any] = [
            outcome(paths.check_tree, Path("run")),
            outcome(paths.check_tree, Path("none")),
        ]
        links = {
            "run/wandb/latest-run": "../../other",
            "run/wandb/debug.log": "../../other/f",
            "run/wandb/debug-internal.log": "../../other/f",
            "run/wandb/offline-1/logs/debug-core.log": "/etc/passwd",
            "run/wandb/offline-1/logs/x.log": "/etc/passwd",
            "run/sub/in": "..",
            "run/sub/out": "../../other",
            "run/wandb/offline-1/debug.log": "/etc/passwd",
            "run/latest-run": "/etc",
        }
        for name, target in links.items():
            Path(name).symlink_to(target)
            rows.append([name, outcome(paths.check_tree, Path("run"))])
            if isinstance(rows[-1][1], str):
                Path(name).unlink()
        os.link("other/f", "run/sub/hard")
        rows += [outcome(paths.check_tree, Path("run")), outcome(paths.check_tree, Path("other"))]
        Path("run/sub/hard").unlink()
        os.mkfifo("run/pipe")
        rows += [outcome(paths.check_tree, Path("run"))]
        for path, root in (
            ("run/x/y", "run"),
            ("run/sub/in", "run"),
            ("run/../other", "run"),
            ("run", "run"),
            ("runs", "run"),
        ):
            rows.append(outcome(paths.check_within, path, root))
        return without(folder, rows)


def files_opened_in_place() -> Any:
    def append(name: str) -> str:
        with paths.open_in_place(Path(name)) as file:
            file.write("ü more")
            file.seek(0)
            return file.read()

    with workspace() as folder:
        Path("old").write_text("old ")
        Path("hard").write_text("h")
        os.link("hard", "second")
        Path("link").symlink_to("old")
        os.mkfifo("pipe")
        names = ("new", "old", "old", "hard", "link", "pipe", "gone/x")
        rows = [outcome(append, name) for name in names]
        Path("pipe").unlink()
        return without(folder, [rows, _listing()])


def abandoned_files() -> Any:
    machine, other, dead, token = paths.__dict__["_machine"](), "0" * 8, 2**22 + 77, "a" * 16
    tokens: set[str] = paths.__dict__["_tokens"]
    names = {
        "dead": f".out.{machine}-{dead}-{token}.npz",
        "self": f".out.{machine}-{os.getpid()}-{token}.npz",
        "writing": f".out.{machine}-{os.getpid()}-{'b' * 16}.npz",
        "init": f".out.{machine}-1-{token}.npz",
        "elsewhere": f".out.{other}-{dead}-{token}.npz",
        "plain": "out.npz",
        "short": f".out.{machine}-{dead}-aa.npz",
        "other": f".else.{machine}-{dead}-{token}.npz",
        "suffix": f".out.{machine}-{dead}-{token}.txt",
        "bare": f".out.{machine}-{dead}-{token}",
        "huge": f".out.{machine}-9999999999-{token}.npz",
        "two": f".a.b.{machine}-{dead}-{token}.x.y",
        "upper": f".out.{machine}-{dead}-{'A' * 16}.npz",
        "parent": f".out.{machine}-{os.getppid()}-{token}.npz",
        "long": f".{'l' * 80}.{machine}-{dead}-{token}.npz",
    }
    rows: list[Any] = []
    for path, is_locked in itertools.product(
        (None, "out.npz", "out", "l" * 99 + ".npz", "a.b.y"), (None, False, True)
    ):
        with workspace():
            for kind, name in names.items():
                Path(name).write_text(kind)
            Path(f".dir.{machine}-{dead}-{token}").mkdir()
            Path(f".dir.{machine}-{dead}-{token}/f").write_text("")
            Path("target").mkdir()
            Path(f".link.{machine}-{dead}-{token}").symlink_to("target")
            tokens.add("b" * 16)
            options = {} if is_locked is None else {"is_locked": is_locked}
            paths.remove_abandoned(Path(), None if path is None else Path(path), **options)
            tokens.discard("b" * 16)
            left = [kind for kind, name in names.items() if Path(name).exists()]
            rows.append(
                [path, is_locked, left, sorted(p.name[:4] for p in Path().glob("*") if p.is_dir())]
            )
    paths.remove_abandoned(Path("/none"))
    return rows


def names_of_temporary_files() -> Any:
    rows: list[Any] = []
    with workspace():
        for path in ("a.npz", "deep/x.tar.gz", "l" * 100 + ".npz", "none"):
            Path(path).parent.mkdir(exist_ok=True)
            with paths.temporary_beside(Path(path)) as temporary:
                shown = temporary.as_posix().replace(paths.__dict__["_machine"](), "MACHINE")
                rows.append(re.sub(r"-\d+-[0-9a-f]{16}", "-PROCESS-TOKEN", shown))
                token = re.findall(r"-([0-9a-f]{16})", temporary.name)[0]
                rows.append(token in paths.__dict__["_tokens"])
                temporary.write_text("")
            rows.append([token in paths.__dict__["_tokens"], temporary.exists()])
        with paths.temporary_beside(Path("f")) as temporary:
            temporary.mkdir()
            (temporary / "x").write_text("")
        rows.append(_listing())
        safe_io.write_text("first/x", "")
        stale = Path(f"first/.x.{paths.__dict__['_machine']()}-{2**22 + 77}-{'c' * 16}")
        stale.write_text("")
        safe_io.write_text("first/y", "")
        rows.append(stale.exists())
        lives = paths.__dict__["_lives"]
        rows.append(
            [lives(os.getpid()), lives(1), lives(os.getppid()), lives(2**22 + 77), lives(10**20)]
        )
        with mock.patch("os.kill", side_effect=PermissionError):
            rows.append([lives(5), lives(os.getpid())])
        return rows


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
