"""Runs side by side, and people's judgement of their motions."""

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_rel
from support.motions import Page
from test_report import a_run, result, run

from flame_mdm.__main__ import main
from flame_mdm.commands.compare import read_texts
from flame_mdm.errors import UserError
from flame_mdm.reporting.compare import find
from flame_mdm.reporting.intervals import paired_difference, percentiles
from flame_mdm.reporting.study import tally

PROMPTS = ("a person walks", "a person jumps", "a person <waves> & bows")


def motions(folder: Path, prompts: tuple[str, ...] = PROMPTS, at: float = 0.0) -> Path:
    """A folder of motion files, as `make sample` writes them; all stand at x = `at`."""
    folder.mkdir(parents=True, exist_ok=True)
    joints = np.random.default_rng(0).random((8, 22, 3)).astype(np.float32)
    joints[..., 0] += at
    for number, text in enumerate(prompts):
        np.savez(folder / f"motion_{number:03d}.npz", joints=joints, fps=20.0, text=text)
    (folder / "player.html").write_text("")
    return folder


@pytest.fixture
def three(tmp_path) -> list[Path]:
    """Three runs, the last with other prompts."""
    first = a_run(tmp_path / "a", name="one", optimizer={"lr": 0.1, "same": 1})
    second = a_run(tmp_path / "b", name="two", optimizer={"lr": 0.2, "same": 1}, extra="<em>")
    motions(first / "samples" / "step_0000009", at=1)
    motions(second / "samples" / "step_0000009", PROMPTS[::-1], at=2)
    third = a_run(tmp_path / "c", name="three", optimizer={"lr": 0.2, "same": 1})
    motions(third / "samples" / "step_0000009", PROMPTS[1:], at=3)
    return [first, second, third]


def put(folder: Path, name: str, **changes: Any) -> None:
    path = folder / "evaluation" / "p-3" / name / "result.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(result(**changes)))


def page(folders: list[Path], out: Path, *words: str) -> str:
    assert main(["compare", f"runs={' '.join(map(str, folders))}", f"out={out}", *words]) == 0
    return out.read_text()


def players(text: str) -> list[list[dict[str, Any]]]:
    """The motions in each player of a page."""
    frames = [unescape(source) for source in re.findall(r'srcdoc="([^"]*)"', text)]
    return [packed(source) for source in frames]


def packed(player: str) -> list[dict[str, Any]]:
    return json.loads(re.findall(r'id="data">(.*?)</script>', player, re.DOTALL)[0])


def test_a_page_puts_runs_side_by_side(three, tmp_path):
    put(three[0], "x")
    put(three[1], "x", values={"fid": {"mean": 7.5, "ci": 0.5, "replications": 2, "n": 64}}, quick=True)
    put(three[1], "y", split="val")
    text = page(three, tmp_path / "out.html")
    table = text[text.index("Configuration differences") : text.index("Motions for the same prompts")]
    assert "<td>optimizer.lr</td><td>0.1</td><td>0.2</td>" in table
    assert "<td>extra</td><td>–</td><td>&lt;em&gt;</td>" in table
    assert "same" not in table
    assert "run.dir" not in table
    (scene,) = players(text)
    names = [(motion["caption"], motion["id"]) for motion in scene]
    labels = ["mine/one", "mine/two", "mine/three"]
    assert names == [(prompt, label) for prompt in PROMPTS[1:] for label in labels], "prompts that all have"
    assert [round(motion["center"][0] - 0.5) for motion in scene] == [1, 2, 3] * 2, "each under its own name"
    assert text.count("<h3>p version 3") == 2, "splits are not compared"
    assert "7.5 ± 0.5" in text
    assert "Quick run — not for publication" in text
    assert "mine/one 0.001953" in text, "curves are overlaid"
    assert page(three, tmp_path / "again.html") == text


def of(mean: float, each: list[float], resampled: list[float], n: int = 64) -> dict[str, Any]:
    return {"mean": mean, "ci": 0.1, "replications": len(each), "n": n, "per_replication": each, "resampled": resampled}


def test_paired_differences_are_those_of_student_and_of_the_draws():
    first, second = np.random.default_rng(0).normal(size=(2, 9))
    mean, low, high = paired_difference(first, second)
    expected = ttest_rel(second, first)
    assert mean == pytest.approx((second - first).mean())
    assert (low, high) == pytest.approx(tuple(expected.confidence_interval(0.95)))
    shifted = percentiles(np.arange(1001.0), 3.0)
    assert shifted == pytest.approx((3 - 475, 3 + 475))


def test_differences_are_shown_or_not(three, tmp_path, capsys):
    draws = np.random.default_rng(0).normal(size=(2, 200))
    same = {"fid": of(4.5, [4.4, 4.5, 4.6], [4.5 + x for x in draws[0]])}
    values = {
        # The noise of both is the same, so that a difference far below it is seen.
        "fid": of(4.2, [4.1, 4.2, 4.31], [4.2 + x for x in draws[0]]),
        "jitter": of(2.0, [2.0, 2.1, 1.9], []),
        "few": of(2.0, [2.0], []),
        "static": of(0.0, [0.0, 0.0, 0.0], [0.0] * 200),
    }
    other = {"jitter": of(1.9, [2.2, 1.5, 2.0], []), "few": of(1.0, [1.0], []), "static": values["static"]}
    put(three[0], "x", values=same | other)
    put(three[1], "x", values=values)
    text = page(three[:2], tmp_path / "out.html")
    lines = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line}
    assert lines["fid"][1] == "-0.2967"
    assert lines["fid"][-1] == "lower"
    low, high = (float(x.strip("[],")) for x in lines["fid"][2:4])
    assert low < -0.2967 < high < 0
    assert lines["fid"][4:6] == ["[-0.2967,", "-0.2967]"]
    assert lines["jitter"][-3:] == lines["static"][-3:] == ["no", "difference", "shown"]
    assert lines["few"] == ["few", "1", "–", "–", "not", "tested:", "one", "replication"]
    for words in (
        "[2] mine/two − [1] mine/one",
        "-0.2967",
        "no difference shown",
        "Neither covers another training run",
    ):
        assert words in text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": 1}, "not compared: other seed"),
        ({"invalid_because": ["real motions are off"]}, "not compared: not valid: real motions are off"),
        ({"values": {"fid": of(4.2, [4.1, 4.3], [], n=65)}}, "not compared: no metric has values per replication"),
        ({"values": result()["values"]}, "evaluate both again; motions are not generated again"),
        ({"protocol": {"name": "q", "version": 3}}, "mine/two: q version 3, synthetic test, data abc"),
        ({"extractor": {"sha256": "0" * 64}}, "No evaluation in common"),
        (None, "mine/two: no evaluation. To evaluate: make evaluate CKPT="),
    ],
)
def test_what_is_not_paired_has_no_difference(three, tmp_path, capsys, changes, message):
    values = {"fid": of(4.5, [4.4, 4.6], [])}
    put(three[0], "x", values=values)
    if changes is not None:
        put(three[1], "x", **{"values": values, **changes})
    text = page(three[:2], tmp_path / "out.html")
    printed = capsys.readouterr().out
    assert message in printed
    assert message in unescape(text)
    assert "95 %" not in printed


@pytest.mark.tools
@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_columns_stay_readable_on_a_phone(three, tmp_path):
    put(three[0], "x")
    text = page(three, tmp_path / "out.html")
    measure = """<script>document.getElementById("page").onload = (event) => {
      const { body } = event.target.contentDocument, cells = [...body.querySelectorAll("th, td")];
      const widths = cells.filter((cell) => cell.textContent).map((cell) => [cell.clientWidth, cell.textContent]);
      document.title = JSON.stringify({ page: body.scrollWidth, widths });
    }</script>"""
    frame = f'<title></title><iframe id="page" width="390" srcdoc="{escape(text)}"></iframe>{measure}'
    (tmp_path / "frame.html").write_text(frame, encoding="utf-8")
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-dev-shm-usage"]
    command += ["--disable-background-networking", f"--user-data-dir={tmp_path / 'profile'}"]
    command += ["--virtual-time-budget=1500", "--dump-dom", (tmp_path / "frame.html").as_uri()]
    dump = subprocess.run(command, capture_output=True, check=True, timeout=60).stdout.decode()
    (tmp_path / "dump.html").write_text(dump, encoding="utf-8")
    seen = json.loads(Page(tmp_path / "dump.html").texts["title"])
    assert seen["page"] <= 390, "tables scroll, not the page"
    assert len(seen["widths"]) > 30
    assert min(seen["widths"])[0] >= 50


def test_runs_of_the_same_name_go_by_their_folders(tmp_path):
    folders = [a_run(tmp_path / name) for name in ("a", "b")]
    assert [compared.label for compared in find(folders)] == [str(f) for f in folders]


def test_runs_without_a_common_prompt_are_compared_and_not_judged(three, tmp_path, capsys):
    other = a_run(tmp_path / "other", name="other")
    motions(other / "samples" / "step_0000009", ("a person swims",))
    assert "no prompt in common" in page([three[0], other], tmp_path / "out.html")
    assert main(["compare", f"runs={three[0]} {other}", "rate=true", f"out={tmp_path / 'rate.html'}"]) == 1
    assert "have no prompt in common" in capsys.readouterr().err
    assert not (tmp_path / "rate.html").exists()


@pytest.mark.slow
def test_texts_are_sampled_by_the_last_checkpoints(tmp_path, data_root):
    first = run(tmp_path / "a", data_root, "trainer.max_steps=2", "callbacks.samples=null")
    second = run(tmp_path / "b", data_root, "trainer.max_steps=4", "callbacks.samples=null", "run.name=longer")
    (tmp_path / "prompts.txt").write_text("a person hops\n\na person walks\na person hops\n")
    folders = [first, second, motions(tmp_path / "real", ("a person walks",))]
    (scene,) = players(page(folders, tmp_path / "out.html", f"texts={tmp_path / 'prompts.txt'}", "seconds=1.5"))
    assert [motion["id"] for motion in scene] == ["quickstart", "quickstart/longer", "real"]
    assert {motion["caption"] for motion in scene} == {"a person walks"}
    assert scene[0]["frames"] == 30
    assert scene[0]["joints"] != scene[1]["joints"]
    assert read_texts("a person walks; a person (jumps), 100%;") == ["a person walks", "a person (jumps), 100%"]


@pytest.mark.slow
def test_runs_sample_what_a_folder_of_motions_shows(tmp_path, data_root, capsys):
    model = run(tmp_path / "a", data_root, "trainer.max_steps=2", "callbacks.samples=null")
    real = tmp_path / "real"
    real.mkdir()
    wanted = [("a person walks", 20), ("a person jumps", 25), ("a person walks", 20), ("", 20), ("a person turns", 90)]
    joints = np.random.default_rng(0).random((90, 22, 3)).astype(np.float32)
    for number, (text, frames) in enumerate(wanted):
        np.savez(real / f"motion_{number:03d}.npz", joints=joints[:frames], fps=10.0, text=text)
    (scene,) = players(page([model, real], tmp_path / "out.html"))
    assert [(motion["caption"], motion["id"]) for motion in scene] == [
        (text, label)
        for text in ("a person walks", "a person jumps", "a person walks", "a person turns")
        for label in ("quickstart", "real")
    ]
    made, shown = scene[::2], scene[1::2]
    assert [motion["frames"] for motion in shown] == [20, 25, 20, 90]
    assert [motion["frames"] for motion in made] == [40, 50, 40, 60], (
        "as long at 20 frames a second, to what is sampled"
    )
    assert made[0]["joints"] != made[2]["joints"], "two motions for a prompt that is there twice"
    assert "1 of 4 motions are shortened to 3 seconds, the maximum length for quickstart" in capsys.readouterr().out
    items = questions(page([model, real], tmp_path / "rate.html", "rate=true"))
    assert sorted(item["prompt"] for item in items) == sorted(text for text, _ in wanted if text)
    again = players(page([model, real], tmp_path / "seed.html", "seed=1", "seconds=1"))[0]
    assert [motion["frames"] for motion in again[::2]] == [20] * 4
    assert again[0]["joints"] != made[0]["joints"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give either runs="),
        (["runs=a b", "ratings=c"], "give either runs="),
        (["runs=a"], "two or more runs"),
        (["runs=a a"], "two or more runs"),
        (["runs=/nowhere /nothing"], "/nowhere: neither a run"),
        (["runs={0} {1}", "texts= ; "], "contains no text"),
        (["runs={0} {1}", "texts=absent.txt"], "texts=absent.txt: no such file"),
        (["runs={0} {1}", "texts=a person walks"], "no such checkpoint"),
        (["runs={0} {0}/samples/step_0000009"], "no such checkpoint"),
        (["runs={0} {1}", "rates=true"], "unknown config key 'rates'. Did you mean rate"),
    ],
)
def test_bad_requests_are_one_line(three, words, message, capsys):
    assert main(["compare", *(word.format(*three) for word in words)]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


# Judgement ------------------------------------------------------------------------------------------------------------


def questions(text: str) -> list[dict[str, Any]]:
    """What a rating page asks."""
    data = json.loads(re.findall(r'id="data">(.*?)</script>', text, re.DOTALL)[0])
    return data["items"]


def test_a_rating_page_hides_whose_motions_it_shows(three, tmp_path):
    text = page(three, tmp_path / "rate.html", "rate=true")
    assert "Which animation better fits the following description?" in text
    items = questions(text)
    assert sorted((item["b"], item["prompt"]) for item in items) == sorted(
        [("mine/two", prompt) for prompt in PROMPTS] + [("mine/three", prompt) for prompt in PROMPTS[1:]]
    )
    where = {"mine/one": 1, "mine/two": 2, "mine/three": 3}
    for item in items:
        scene = packed(item["player"])
        assert [motion["id"] for motion in scene] == ["the left one", "the right one"]
        assert not any(motion["caption"] for motion in scene)
        assert not any(label in item["player"] for label in where)
        left, right = (motion["center"][0] for motion in scene)
        assert (left < right) == (item["left"] == "a"), "a is the first run, which stands at the least x"
    assert page(three, tmp_path / "again.html", "rate=true") == text


def test_sides_and_order_are_drawn(tmp_path):
    prompts = tuple(f"prompt {number}" for number in range(24))
    folders = [motions(tmp_path / name, prompts, at) for name, at in (("a", 0), ("b", 1))]
    first, other = (questions(page(folders, tmp_path / "rate.html", "rate=true", f"seed={seed}")) for seed in (0, 1))
    for items in (first, other):
        assert 5 < sum(item["left"] == "a" for item in items) < 19
        assert [item["prompt"] for item in items] != list(prompts)
    assert [item["prompt"] for item in first] != [item["prompt"] for item in other]
    assert {item["prompt"]: item["left"] for item in first} != {item["prompt"]: item["left"] for item in other}


def ratings(path: Path, choices: str, rater: str = "ann", a: str = "ours", b: str = "real", **changes: Any) -> Path:
    answers = [{"prompt": f"p{k}", "a": a, "b": b, "choice": choice} for k, choice in enumerate(choices)]
    path.write_text(json.dumps({"format": 1, "study": "s", "rater": rater, "ratings": answers, **changes}))
    return path


def test_ratings_of_several_people_are_counted(tmp_path, capsys):
    files = [
        ratings(tmp_path / "x.json", "aab"),
        ratings(tmp_path / "y.json", "abb", rater="bob", a="real", b="ours"),
        ratings(tmp_path / "z.json", "a", rater="bob", b="other", study="t"),
    ]
    out = tmp_path / "ratings.json"
    assert main(["compare", f"ratings={' '.join(map(str, files))}", f"out={out}"]) == 0
    first, second = json.loads(out.read_text())["pairs"]
    assert {k: first[k] for k in ("a", "b", "wins_a", "wins_b", "raters")} == {
        **{"a": "ours", "b": "real"},
        **{"wins_a": 4, "wins_b": 2, "raters": 2},
    }
    assert first["share_a"] == pytest.approx(2 / 3)
    assert (second["b"], second["wins_a"], second["wins_b"], second["raters"]) == ("other", 1, 0, 1)
    assert second["interval_a"] == [pytest.approx(0.2065, abs=1e-4), 1.0]
    assert "ours over real: 4 of 6 answers, 66.7% (30.0% to 90.3%), 2 raters" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("hello", "not a JSON file"),
        ("[]", "the file is [], not a mapping"),
        ('{"rater": "x"}', "the file has no study"),
        ('{"study": "s", "rater": "", "ratings": []}', 'rater is "", not a non-empty text'),
        ('{"study": "s", "rater": "x", "ratings": []}', "ratings is [], not a longer list"),
        ('{"study": "s", "rater": "x", "ratings": [3]}', "ratings.0 is 3, not a mapping"),
        (
            '{"study": "s", "rater": "x", "ratings": [{"a": "u", "b": "v", "choice": "c"}]}',
            'ratings.0.choice is "c", not',
        ),
        (
            '{"study": "s", "rater": "x", "ratings": [{"a": "u", "b": "u", "choice": "a"}]}',
            "rating 1 compares u with itself",
        ),
    ],
)
def test_malformed_ratings_are_one_line(tmp_path, content, message, capsys):
    path = tmp_path / "ratings.json"
    path.write_text(content)
    assert main(["compare", f"ratings={path}", f"out={tmp_path / 'out.json'}"]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert str(path) in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.json").exists()


def test_nobody_counts_twice(tmp_path):
    files = [ratings(tmp_path / name, "ab") for name in ("x.json", "copy.json")]
    with pytest.raises(UserError, match=r"copy\.json: ann also answered this page in .*x\.json"):
        tally(files)
