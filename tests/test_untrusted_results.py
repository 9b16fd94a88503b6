"""Results, table specs, texts, samples and pages from others: refused in one line, or shown as plain text."""

import csv
import errno
import io
import json
import multiprocessing
import os
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from markupsafe import Markup
from support.pages import a_run, motions
from support.refusals import bounded
from test_architecture import FILES
from test_faults import file_limit

import flame_mdm
from evaluators.sources import _write, read_samples
from flame_mdm.__main__ import main
from flame_mdm.checkpoints import hub, model_files
from flame_mdm.data import verify
from flame_mdm.data.crops import Whole
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import (
    UserError,
    did_you_mean,
    first_line,
    markdown_text,
    say,
    shortened,
)
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.records import Cost
from flame_mdm.reporting.plots import Panel, Series, svg
from flame_mdm.reporting.report import write_report
from flame_mdm.reporting.tables.format import (
    Cell,
    Line,
    Part,
    Table,
    comma_separated,
    draw,
    rendered,
    write,
)
from flame_mdm.reporting.tables.specs import Figure
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import atomic_folder, atomic_write, write_failure, write_json
from flame_mdm.sampling.output import write_motions
from flame_mdm.schemas import ClosedSchema, Int, check_shape, read_json
from flame_mdm.visualize import contact_sheet, player_page, write_gif

pytestmark = pytest.mark.slow

ROWS = """title: t
parts:
  P:
    protocol: synthetic
    columns: {{FID: {{value: fid}}}}
    rows: [{{label: a, baseline: real, {keys}}}]
"""
MANY = list(range(1, 41))
COST = Cost(nfe=1.0, seconds_per_sample=1.0, batch_size=1.0)
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
COLUMNS = ", ".join(f"c{k}: {{value: fid}}" for k in range(500))
OPTIONS = f"num_inference_steps: {MANY}, guidance_scale: {MANY}, until: {MANY}"
NUMBER = "spec.yaml: not a readable YAML file: a whole number of more"
SPECS = {
    ROWS.format(keys=OPTIONS): "64,000 exceed the limit",
    f"{BOMB}title: t\nparts: {{P: {{lengths: *i}}}}\n": "after its aliases are expanded",
    "title: " + "{a: " * 20_000: "nested too deeply",
    ROWS.format(keys="note: '${oc.env:HOME}'"): "contains the interpolation",
    ROWS.format(keys="data.source._target_: os.system"): "data.source._target_",
    ROWS.format(keys="hydra.searchpath: x"): "only data keys",
    f"title: t\nparts: {{P: {{protocol: x, rows: [], columns: {{{COLUMNS}}}}}}}\n": "not a shorter list",
    ROWS.format(keys="note: n")
    + f"figures: [{{part: P, x: nfe, y: {['FID'] * 300}}}]\n": "300 exceed the limit",
    "title: caf\udce9\n": "not a UTF-8 text file",
    "title: t\nparts: {P: {recipes: {a: quickstart}, keys: {}}}\n": "keys is {}, not a longer",
    f"title: t\nnotes: [0x{'f' * 20_000}]\n": NUMBER,
    "\n".join(f"{k * (2**61 - 1)}: 1" for k in range(8_000)): NUMBER,  # keys of one hash
    "title: x\nparts: {a: {rows: []}}": "parts.a: needs columns and rows, or recipes",
    "title: x\nparts: {a: {columns: {A: {value: fid}}, rows: [{ckpt: x}]}}": "parts.a.rows.0 has no label",
    "title: x\nparts: {a: {columns: {A: {value: fid}}, rows: [{label: x, ckpt: x}]}}": "needs a protocol",
}


def test_table_specs(attacked, bad):
    for content, says in SPECS.items():
        (bad / "spec.yaml").write_bytes(content.encode(errors="surrogateescape"))
        attacked("tables", f"table={bad / 'spec.yaml'}", "evaluate=false", says=says)
    attacked("tables", "table=mdm_9", says="unknown table 'mdm_9'. Did you mean mdm_")


@pytest.mark.parametrize("part", ["denoiser", "process", "representation", "optimizer"])
def test_a_recipe_that_a_spec_names_runs_no_code(attacked, bad, part: str):
    recipe = f"defaults: [quickstart, _self_]\n{part}: {{_target_: logging.basicConfig}}\n"
    (bad / "recipe.yaml").write_text(recipe)
    settings = {"recipes": {"a": str(bad / "recipe.yaml")}, "keys": {"T": "parameters"}}
    spec = {"title": "t", "parts": {"P": settings}}
    (bad / "spec.yaml").write_text(json.dumps(spec))
    attacked(
        "tables",
        f"table={bad / 'spec.yaml'}",
        "evaluate=false",
        says=f"names logging.basicConfig at {part}. Code from this package is run only if you trust it",
    )


def huge(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(2**40)


UNREADABLE: dict[str, tuple[Callable[[Path], object], str]] = {
    "pipe": (os.mkfifo, "this is a pipe, a socket or a device, not a regular file"),
    "endless": (
        lambda path: path.symlink_to("/dev/zero"),
        "this is a pipe, a socket or a device, not a regular file",
    ),
    "folder": (Path.mkdir, "this is a folder, not a regular file"),
    "huge": (huge, "the file is 1 TiB, but at most"),
    "latin": (lambda path: path.write_bytes(b'{"a": "\xe9"}\n'), "not a UTF-8 text file"),
}


def test_unreadable_files(attacked, bad, trained):
    """Each kind in a file of a run, and a pipe in place of each other file."""
    for number, (make, says) in enumerate(UNREADABLE.values()):
        folder = a_run(bad / f"run{number}")
        path = folder / ("metrics.jsonl", "provenance.json", "evaluation/p/result.json")[number % 3]
        path.unlink(missing_ok=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        make(path)
        attacked("report", str(folder), says=f"{path}: {says}")
    ratings, lengths = bad / "ratings.json", bad / "results" / "lengths" / "kit.json"
    (bad / "study.yaml").write_text(f"title: t\nparts: {{P: {{ratings: {ratings}}}}}\n")
    (bad / "lengths.yaml").write_text("title: t\nparts: {P: {lengths: [kit]}}\n")
    lengths.parent.mkdir(parents=True)
    for path in (ratings, lengths, bad / "texts.txt"):
        os.mkfifo(path)
    for spec, path in (("study", ratings), ("lengths", lengths)):
        words = [f"table={bad / spec}.yaml", "evaluate=false", f"results={bad / 'results'}"]
        attacked("tables", *words, says=f"{path}: ")
    attacked("compare", f"ratings={ratings}", says=f"{ratings}: ")
    words = [f"runs={trained.parent.parent} {a_run(bad / 'other')}", f"prompts={bad / 'texts.txt'}"]
    attacked("compare", *words, says=f"{bad / 'texts.txt'}: ")


def test_numbers_at_the_ends_of_the_range_are_drawn(bad, subtests):
    folder = a_run(bad / "run")
    lines = [
        {"step": 0},
        {
            "step": 1,
            "foo": 1,
            "": 1,
            "a/": 1,
            "train/loss": 5e-324,
            "train/a": 1e-299,
            "a/b": 1e299,
        },
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert main(["report", str(folder)]) == 0
    for low, high in ((0, 5e-324), (5e-324, 5e-324), (1e299, 1e299), (-5e-324, 0), (5e-324, 1)):
        with subtests.test(low=low, high=high):
            points = [Series("a", [(low, low), (high, high)])]
            assert svg(
                "a", [Panel(points), Panel(points, from_zero=True), Panel(points, log_x=True)]
            )


def test_long_names_and_many_texts(attacked, bad, tmp_path, trained, capfd):
    (bad / "spec.yaml").write_text(f"title: t\nparts: {{P: {{lengths: [{'a' * 5_000}]}}}}\n")
    attacked("tables", f"table={bad / 'spec.yaml'}", "evaluate=false", says="aaa … ")
    say("b" * 5_000, error=True)
    assert len(capfd.readouterr().err) < 2_010
    attacked(
        "sample",
        f"ckpt={trained}",
        f"text={'a person walks ' * 66_667}",
        says=": the text has 1,000,005 characters",
    )
    with pytest.raises(
        UserError, match=r"samples=2 for each text: a request may contain at most 10,000 motions"
    ):
        flame_mdm.generate(
            flame_mdm.load(trained), [f"text {number}" for number in range(5001)], samples=2
        )
    caption = "x" * 1_000_000
    short, shown = (
        Motion(np.zeros((frames, 22, 3)), 20.0, SMPL22, text=caption, id=caption)
        for frames in (2, 20)
    )
    with bounded():
        write_gif(tmp_path / "a.gif", [shown])
        contact_sheet(tmp_path / "a.png", [shown])
        text = player_page([short], caption)
    assert "…" in text
    assert len(text) < 100_000


def test_a_text_given_twice_has_two_motions(trained):
    model = flame_mdm.load(trained)

    def sampled(texts: Any, **options: Any) -> np.ndarray:
        return np.stack(
            [made.features for made in flame_mdm.generate(model, texts, seconds=1, **options)]
        )

    pair, twice = sampled("walk", samples=2), sampled(["walk", "jump", "walk"])
    np.testing.assert_allclose(twice, np.stack([pair[0], sampled("jump")[0], pair[1]]), atol=1e-5)
    assert np.abs(twice[0] - twice[2]).max() > 1e-3
    ids = [
        made.id
        for made in flame_mdm.generate(model, ["walk", "jump", "walk"], seconds=1, samples=2)
    ]
    assert ids == ["walk#0", "walk#1", "jump#0", "jump#1", "walk#2", "walk#3"]


def _made(text: str = "a person walks") -> list[Motion]:
    return [
        Motion(
            np.zeros((4, 22, 3)),
            20.0,
            SMPL22,
            text,
            f"{text}#0",
            features=np.zeros((4, 263), np.float32),
        )
    ]


def _write_all(folder: Path, table: Table) -> None:
    row: Any = SimpleNamespace(id="000001", text="a person walks")
    for _ in range(30):
        write_json(
            folder / "results" / "lengths" / "kit.json", {"lengths": list(range(1000))}, indent=None
        )
        _write(folder / "rep_0.npz", [row], [np.zeros((40, 263), np.float32)], COST, "text")
    for _ in range(2):
        write(table, folder / "tables")
        write_motions(folder / "samples" / "mine", _made(), {"seed": 0})


def test_four_processes_write_the_same_files(tmp_path):
    table = Table(
        "t", "T", [Part("P", {"FID": "lower"}, [Line("a", "measured", [Cell("1", 1.0)])])]
    )
    table.parts[0].figures.append(Figure(part="P", x="nfe", y=["FID"]))
    table.parts[0].lines[0].options["nfe"] = 3.0
    fork = multiprocessing.get_context("fork")
    processes = [fork.Process(target=_write_all, args=(tmp_path, table)) for _ in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join(60)
    assert [process.exitcode for process in processes] == [0] * 4
    written = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert written == {
        *("t-figure.svg", "t.csv", "t.html", "t.md", "t.tex", "kit.json", "rep_0.npz"),
        *("motion_000.npz", "motions.gif", "motions.png", "player.html"),
    }, "no temporary files"
    assert read(tmp_path / "samples" / "mine" / "motion_000.npz").text == "a person walks"
    assert read_samples(tmp_path / "rep_0.npz")["ids"].tolist() == ["000001"]


def test_a_sample_folder_is_whole_or_absent(attacked, bad, trained, monkeypatch):
    words = ["sample", f"ckpt={trained}", "text=a person walks", "seconds=1"]
    for name in ("Motion.save", "write_player"):
        with monkeypatch.context() as patch:
            full = Mock(side_effect=OSError(28, "No space left on device"))
            patch.setattr(f"flame_mdm.sampling.output.{name}", full)
            attacked(*words, "out=new/folder", says="No space left on device")
    (bad / "file").write_text("mine")
    attacked(*words, f"out={bad / 'file'}", says="file: this is a file, not a folder")


def test_a_failed_write_keeps_what_was_there(tmp_path):
    write_motions(tmp_path / "a", _made(), {})
    (tmp_path / "a" / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    with (
        pytest.raises(UserError, match="a: cannot be written"),
        atomic_folder(tmp_path / "a") as made,
    ):
        (made / "no folder" / "player.html").write_text("half")
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before
    write_motions(tmp_path / "a", _made("another"), {})
    assert (tmp_path / "a" / "notes.txt").read_text() == "mine"
    assert read(tmp_path / "a" / "motion_000.npz").text == "another"
    with pytest.raises(ZeroDivisionError), atomic_write(tmp_path / "b" / "c" / "file.txt"):
        raise ZeroDivisionError
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize(
    ("free", "text"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (1000, "0.977 KiB"),
        (1536, "1.5 KiB"),
        (2**20, "1 MiB"),
        (1000 * 2**20, "0.977 GiB"),
        (3 * 2**29, "1.5 GiB"),
        (5 * 2**40, "5 TiB"),
    ],
)
def test_of_a_full_disk_the_free_space_is_named_in_binary_units(tmp_path, monkeypatch, free, text):
    disk = SimpleNamespace(total=2**60, used=2**50, free=free)
    folders: list[Path] = []
    usage = SimpleNamespace(disk_usage=lambda folder: folders.append(folder) or disk)
    monkeypatch.setattr("flame_mdm.safe_io.shutil", usage)
    path = tmp_path / "new" / "folder" / "a.npz"
    for number in (errno.ENOSPC, errno.EDQUOT):
        reason = write_failure(OSError(number, "full"), path)
        assert reason == f"full. {text} is free on the disk that contains {tmp_path}"
    assert folders == [tmp_path] * 2
    assert write_failure(OSError(errno.EACCES, "not allowed"), path) == "not allowed"
    assert write_failure(RuntimeError("one\ntwo"), path) == "one"


def _table(folder: Path) -> Path:
    part = Part("P", {"FID": "lower"}, [Line("a", "measured", [Cell("1", 1.0)])])
    write(Table("t", "T", [part]), folder)
    return folder / "t.html"


def _report(folder: Path) -> Path:
    return write_report(folder / "run" if (folder / "run").exists() else a_run(folder / "run"))


def _check_of_data(folder: Path) -> Path:
    options: dict[str, Any] = {
        "root": str(folder),
        "name": "s",
        "batch_size": 4,
        "crop": Whole(1, 45),
    }
    data = MotionDataModule(Synthetic(clips=12), HumanML(), **options)
    data.prepare_data()
    verify.report(data)
    return next(folder.rglob("verify.json"))


@pytest.mark.parametrize("writer", [_table, _report, _check_of_data])
def test_a_file_that_is_half_written_when_the_disk_is_full_leaves_the_old_one(
    tmp_path, capsys, writer
):
    """With `capsys`, because pytest otherwise captures what is printed in files, which are limited as well."""
    path = writer(tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with file_limit(100), pytest.raises(UserError, match="cannot be written: File too large"):
        writer(tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    assert path in before


HOSTILE = "x\n# Heading\n\n<b>|`[a](http://b)\r\x1b[31m\u202e\t~~_*"


def test_tables_hold_text_not_markup_and_no_formulas(subtests):
    facts = {
        "device": "=HYPERLINK(1)",
        "seed": "-5",
        "recipe": "@SUM(1)",
        "result": "\t=1+1",
        "baseline": "-2+3+cmd",
    }
    line = Line(HOSTILE, "measured", [Cell("-0.5 ±0.1", -0.5, 0.1), Cell("+cmd")], "a", facts=facts)
    line.options["nfe"] = 1.0
    part = Part(HOSTILE, {"=A": "none", HOSTILE: "none"}, [line], [("a", HOSTILE), ("", HOSTILE)])
    part.figures.append(Figure(part=HOSTILE, x="nfe", y=["=A"]))
    part.drawn = [("t](x) -x-heading-b-a-http-b-31m-figure", Markup("<svg/>"))]
    other = Part("=P", {"x": "none"}, [Line("$\\frac", "measured", [None])])
    table = Table("t](x) ", HOSTILE, [part, other], [HOSTILE])
    text, tex, html = (str(rendered(table, suffix)) for suffix in ("md", "tex", "html"))
    assert "<b>" not in html
    assert html.count("&lt;b&gt;") > 3
    assert tex.count("{") - tex.count("\\{") == tex.count("}") - tex.count("\\}")
    assert not [line for line in text.splitlines() if re.match(r"\s*(# Heading|<b>|\|`)", line)]
    assert all(escaped in text for escaped in ("\\[a\\]", "&lt;b&gt;", "\\`"))
    for form in (text, tex, comma_separated(table)):
        with subtests.test(form=form):
            assert not re.search("[\x00-\x09\x0b-\x1f\u202e]", form)
    assert not [line for line in tex.splitlines() if line.lstrip().startswith(("#", "<b>", "["))]
    cells = [cell for row in csv.reader(io.StringIO(comma_separated(table))) for cell in row]
    formulas = [
        cell
        for cell in cells
        if cell.lstrip().startswith(tuple("=+-@")) and not re.match(r"-[\d.]+", cell)
    ]
    assert not formulas
    assert {"-5", "-0.5 ±0.1", "'-2+3+cmd", "'=HYPERLINK(1)"} <= set(cells)
    line.label = r"$\frac{$"
    assert draw(part, part.figures[0])


def test_commands_print_no_control_characters(tmp_path, capsys):
    folder = a_run(tmp_path / "a\x1b[31m\u202e\nerror: b")
    assert main(["report", f"runs='{folder}'"]) == 0
    out = capsys.readouterr().out
    assert out.endswith("a\\x1b[31m\\u202e\\nerror: b/report.html\n")
    assert len(out.splitlines()) == 1
    say("one", "two\x1b")
    assert capsys.readouterr().out == "one\ntwo\\x1b\n"


class Named(ClosedSchema):
    format: Int
    name: str


def test_long_texts_are_cut_to_the_most_characters_that_are_allowed():
    assert [shortened("x" * count, 10) for count in (0, 9, 10)] == ["", "x" * 9, "x" * 10]
    assert [shortened("x" * count, 10) for count in (11, 99)] == ["x" * 9 + "…"] * 2
    assert shortened("a\u202eb", 10) == "a\\u202eb"


def test_of_a_long_error_the_beginning_and_the_end_are_printed(capsys):
    text = f"{'a' * 1000}{'b' * 5000}{'c' * 1000}"
    say(text, error=True)
    assert capsys.readouterr().err == f"{'a' * 1000} … {'c' * 1000}\n"
    for whole, is_error in ((text[:2000], True), (text, False)):
        say(whole, error=is_error)
        assert "".join(capsys.readouterr()) == f"{whole}\n"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("one\ntwo", "one"),
        ("\n  one:  \n\n two \nthree", "one: two"),
        ("one:", "one:"),
        ("", "ValueError"),
    ],
)
def test_the_first_line_of_an_error_includes_what_follows_a_colon(text, line):
    assert first_line(ValueError(text)) == line


def test_up_to_three_similar_names_are_suggested_the_nearest_first():
    names = ["walks", "walked", "walk", "walking", "jump"]
    assert did_you_mean("walk", names) == " Did you mean walk, walks, walked?"
    assert did_you_mean("jumps", iter(names)) == " Did you mean jump?"
    assert did_you_mean("zzz", names) == ""


def test_markdown_shows_a_text_as_it_is():
    assert markdown_text("a|b*_`~#[c]\\ <d>&\ne") == (r"a\|b\*\_\`\~\#\[c\]\\ &lt;d&gt;&amp; e")


@pytest.mark.parametrize("sign", [1, -1])
def test_whole_numbers_up_to_63_bits_are_read_at_any_depth(tmp_path, sign):
    path, most = tmp_path / "a.json", sign * (2**63 - 1)
    path.write_text(json.dumps({"a": [1, {"b": most}]}))
    assert read_json(path, dict[str, Any]) == {"a": [1, {"b": most}]}
    path.write_text(json.dumps({"a": [1, {"b": most + sign}]}))
    refused = rf"a\.json is damaged: {hex(most + sign)} \.\.\. is too large.*the maximum is {2**63 - 1:,}; rm"
    with pytest.raises(UserError, match=refused):
        read_json(path, dict[str, Any], "rm")


def test_a_file_of_results_may_be_as_large_as_the_limit(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    path.write_text("[1]" + " " * 97)
    for limit in (100, 99):
        monkeypatch.setattr("flame_mdm.schemas.LIMIT", limit)
        if limit == 100:
            assert read_json(path, list[int]) == [1]
        else:
            with pytest.raises(UserError, match="the file is 100 bytes, but at most 99 bytes is"):
                read_json(path, list[int])


def test_a_wrong_value_is_named_with_its_key_and_what_is_expected():
    for content, message in (
        ({"format": 1, "name": 3}, "name is 3, not a string"),
        ({"name": "a"}, "the file has no format"),
        ({"format": 1.5, "name": "a"}, "format is 1.5, not a whole number"),
        ({"format": 1, "name": "a", "nmae": 3}, "unknown key: nmae. Did you mean name?"),
        ({"format": 1, "name": ["x" * 50]}, f'name is ["{"x" * 34} ..., not a string'),
    ):
        with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
            check_shape(content, Named)
    overridden = {"format": 1, "name": "a", "data.crop.max_frames": 60}
    assert check_shape(overridden, Named).name == "a"


def test_all_that_is_printed_is_printable():
    pattern = r"(?<![\w.])print\(|sys\.std(?:out|err)\.write"
    alone = ("errors.py", "runner.py")  # the runner needs nothing of the package
    wrong = [
        path for path in FILES if path.name not in alone and re.search(pattern, path.read_text())
    ]
    assert wrong == [], "use errors.say"


def test_pages_use_no_network_and_play_the_motions_not_the_pages_of_others(tmp_path, subtests):
    assert "Content-Security-Policy" in player_page([Motion(np.zeros((2, 22, 3)), 20.0, SMPL22)])
    runs = [
        motions(a_run(tmp_path / name, name=name) / "samples" / "step_0000009").parent.parent
        for name in "ab"
    ]
    assert main(["compare", f"runs={runs[0]} {runs[1]}", f"out={tmp_path / 'out.html'}"]) == 0
    (runs[0] / "samples" / "step_0000009" / "player.html").write_text(
        "<script>fetch('https://example.com')</script>"
    )
    report = write_report(runs[0])
    assert (
        main(["compare", f"runs={runs[0]} {runs[1]}", f"out={tmp_path / 'rate.html'}", "rate=true"])
        == 0
    )
    for path in (tmp_path / "out.html", tmp_path / "rate.html", report, _table(tmp_path)):
        with subtests.test(path=path):
            assert (
                """<meta http-equiv="Content-Security-Policy" content="default-src 'none'; """
                in path.read_text()
            )
    assert "example.com" not in report.read_text()
    assert "a person jumps" in report.read_text()


def test_push_takes_names_not_paths_and_overwrites_only_its_own_files(attacked, bad, trained):
    for name in ("a/..", "./a", "a/.git", "a/-x", "/"):
        attacked(
            "push",
            str(trained),
            name,
            "dry_run=true",
            says="not a repository name. Use user/name",
        )
    (bad / "config.yaml").write_text("mine")
    attacked(
        "push", str(trained), "a/b", f"out={bad}", "dry_run=true", says="push did not write it"
    )
    assert [path.read_text() for path in bad.iterdir()] == ["mine"]
    for _ in range(2):
        assert main(["push", str(trained), "a/x.safetensors", "dry_run=true"]) == 0
    names = {path.name for path in Path("push/x.safetensors").iterdir()}
    assert names == {"README.md", "config.yaml", "model.safetensors"}


def test_a_card_is_a_table_of_text(trained, tmp_path):
    model = model_files.read_model_file(hub.export(trained, tmp_path))
    model["origin"]["file"] = HOSTILE
    assert not re.search("\n# Heading|\x1b", hub.card(model, "me/walker", ""))
