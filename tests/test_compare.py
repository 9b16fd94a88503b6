"""Runs side by side, and how people judge their motions."""

import json
import re
from html import unescape
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.stats import binomtest, ttest_rel
from support.pages import PROMPTS, a_run, data_of, motions, players, put, result
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.commands.compare import _sampled
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.records import Result, Value
from flame_mdm.reporting.compare import (
    ComparedRun,
    _charts,
    _difference,
    _differences,
    _evaluations,
    _facts,
    _player,
    differences,
    find,
    grouped,
    in_all,
    in_common,
    paired_difference,
    read_motions,
)
from flame_mdm.reporting.study import tally, wilson
from flame_mdm.runs import read_run
from flame_mdm.sampling.motion_request import SamplingRequest
from flame_mdm.schemas import check_shape


@pytest.fixture
def three(tmp_path) -> list[Path]:
    """Three runs, the last with other prompts."""
    first = a_run(tmp_path / "a", name="one", optimizer={"lr": 0.1, "same": 1})
    second = a_run(tmp_path / "b", name="two", optimizer={"lr": 0.2, "same": 1}, extra="<em>")
    third = a_run(tmp_path / "c", name="three", optimizer={"lr": 0.2, "same": 1})
    for at, (folder, prompts) in enumerate(
        [(first, PROMPTS), (second, PROMPTS[::-1]), (third, PROMPTS[1:])], 1
    ):
        motions(folder / "samples" / "step_0000009", prompts, at)
    return [first, second, third]


def page(folders: list[Path], out: Path, *words: str) -> str:
    assert main(["compare", f"runs={' '.join(map(str, folders))}", f"out={out}", *words]) == 0
    return out.read_text()


def test_a_page_puts_runs_side_by_side(three, tmp_path, subtests):
    put(three[0])
    put(three[1], values={"fid": {"mean": 7.5, "ci": 0.5, "replications": 2, "n": 64}}, quick=True)
    put(three[1], "y", split="val")
    text = page(three, tmp_path / "out.html")
    table = text[
        text.index("Configuration differences") : text.index("Motions for the same prompts")
    ]
    assert "<td>optimizer.lr</td><td>0.1</td><td>0.2</td>" in table
    assert "<td>extra</td><td>–</td><td>&lt;em&gt;</td>" in table
    assert "same" not in table
    assert "run.dir" not in table
    (scene,) = players(text)
    labels = ["mine/one", "mine/two", "mine/three"]
    names = [(motion["caption"], motion["id"]) for motion in scene]
    assert names == [(prompt, label) for prompt in PROMPTS[1:] for label in labels], (
        "prompts that all have"
    )
    assert [round(motion["center"][0] - 0.5) for motion in scene] == [1, 2, 3] * 2, (
        "each under its own name"
    )
    assert text.count("<h3>p version 3") == 2, "splits are not compared"
    for words in (
        "7.5 ± 0.5",
        "replications x motions: 2 x 64",
        "Quick run — not for publication",
        "mine/one 0.001953",
    ):
        with subtests.test(words=words):
            assert words in text, words
    assert page(three, tmp_path / "again.html") == text


def of(mean: float, values: list[float], n: int = 64) -> dict[str, Any]:
    return {"mean": mean, "ci": 0.1, "replications": len(values), "n": n, "per_replication": values}


def test_paired_differences_are_those_of_student():
    first, second = np.random.default_rng(0).normal(size=(2, 9))
    mean, low, high = paired_difference(first, second)
    assert mean == pytest.approx((second - first).mean())
    assert (low, high) == pytest.approx(tuple(ttest_rel(second, first).confidence_interval(0.95)))


def test_differences_are_shown_or_not(three, tmp_path, capsys):
    static = of(0.0, [0.0, 0.0, 0.0])
    # The noise of both is the same, so that a difference far below it is seen.
    first = {"fid": of(4.5, [4.4, 4.5, 4.6]), "jitter": of(1.9, [2.2, 1.5, 2.0])}
    second = {"fid": of(4.2, [4.1, 4.2, 4.31]), "jitter": of(2.0, [2.0, 2.1, 1.9])}
    put(three[0], values=first | {"static": static, "few": of(1.0, [1.0])})
    put(three[1], values=second | {"static": static, "few": of(2.0, [2.0])})
    text = page(three[:2], tmp_path / "out.html")
    lines = {line.split()[0]: line.split() for line in capsys.readouterr().out.splitlines() if line}
    assert (lines["fid"][1], lines["fid"][-1]) == ("-0.2967", "lower")
    low, high = (float(x.strip("[],")) for x in lines["fid"][2:4])
    assert low < -0.2967 < high < 0
    assert lines["jitter"][-3:] == lines["static"][-3:] == ["no", "difference", "shown"]
    assert lines["few"] == ["few", "1", "–", "not", "tested:", "only", "one", "replication"]
    marks = (
        "[2] mine/two − [1] mine/one",
        "-0.2967",
        "no difference shown",
        "but not the variation between training runs",
    )
    assert all(words in text for words in marks)


def test_differences_and_values_have_their_units(three, tmp_path, capsys):
    put(three[0], values={"jitter": of(1.9, [2.2, 1.5, 2.0]) | {"unit": "m/s^3"}})
    put(three[1], values={"jitter": of(2.0, [2.0, 2.1, 1.9]) | {"unit": "m/s^3"}})
    text = page(three[:2], tmp_path / "out.html")
    assert text.count("<td>jitter (m/s^3)</td>") == 2, "of the values, and of the differences"
    assert any(line.startswith("jitter (m/s^3) ") for line in capsys.readouterr().out.splitlines())


def test_what_is_not_paired_has_no_difference(three, tmp_path, capsys, subtests):
    values = {"fid": of(4.5, [4.4, 4.6])}
    put(three[0], values=values)
    for changes, message in (
        (None, "No evaluation in common"),
        ({"seed": 1}, "not compared: the seeds"),
        (
            {"data": result()["data"] | {"frames": [24, 40]}},
            "not compared: the seeds, length limits or skeletons differ",
        ),
        (
            {"invalid_because": ["real motions are off"]},
            "not compared: not valid: real motions are off",
        ),
        (
            {"values": {"fid": of(4.2, [4.1, 4.3], n=65)}},
            "not compared: no metric has values per replication",
        ),
        (
            {"values": result()["values"]},
            "Evaluate both again; the motions are not generated again",
        ),
        ({"protocol": {"name": "q", "version": 3}}, "q version 3, synthetic test, data abc"),
        ({"extractor": {"sha256": "0" * 64}}, "No evaluation in common"),
    ):
        with subtests.test(changes=changes, message=message):
            if changes is not None:
                put(three[1], **{"values": values, **changes})
            text = page(three[:2], tmp_path / "out.html")
            printed = capsys.readouterr().out
            assert message in printed
            assert message in unescape(text)
            assert "95 %" not in printed


@pytest.mark.slow
def test_runs_are_sampled_for_prompts_or_for_the_captions_of_a_folder_of_motions(
    tmp_path, trained, data_root, capsys
):
    model, other = trained.parent.parent, tmp_path / "b"
    words = [
        *TINY,
        f"data_root={data_root}",
        f"run.dir={other}",
        "run.name=longer",
        "trainer.max_steps=4",
    ]
    assert (
        main(["train", "quickstart", *words, "callbacks.samples=null", "callbacks.best=null"]) == 0
    )
    (tmp_path / "prompts.txt").write_text("a person hops\n\na person walks\na person hops\n")
    (scene,) = players(
        page(
            [model, other],
            tmp_path / "out.html",
            f"prompts={tmp_path / 'prompts.txt'}",
            "seconds=1.5",
        )
    )
    assert [motion["id"] for motion in scene] == ["quickstart", "quickstart/longer"] * 2
    assert [motion["caption"] for motion in scene[::2]] == ["a person hops", "a person walks"]
    assert scene[0]["frames"] == 30
    assert scene[0]["joints"] != scene[1]["joints"]

    real = tmp_path / "real"
    real.mkdir()
    files = [
        ("a person walks", 20),
        ("a person jumps", 25),
        ("a person walks", 20),
        ("", 20),
        ("a person turns", 90),
    ]
    joints = np.random.default_rng(0).random((90, 22, 3)).astype(np.float32)
    for number, (text, frames) in enumerate(files):
        np.savez(real / f"motion_{number:03d}.npz", joints=joints[:frames], fps=10.0, text=text)
    texts = [text for text, _ in files if text]

    (scene,) = players(page([model, real], tmp_path / "out.html"))
    names = [(motion["caption"], motion["id"]) for motion in scene]
    assert names == [(text, label) for text in texts for label in ("quickstart", "real")]
    generated = scene[::2]
    assert [motion["frames"] for motion in scene[1::2]] == [20, 25, 20, 90]
    assert [motion["frames"] for motion in generated] == [40, 50, 40, 60], (
        "as long, at 20 frames per second"
    )
    assert generated[0]["joints"] != generated[2]["joints"], (
        "two motions for a prompt that is there twice"
    )
    assert (
        "1 of 4 motions are shortened to 3 seconds, the maximum length for quickstart"
        in capsys.readouterr().out
    )

    items = data_of(page([model, real], tmp_path / "rate.html", "rate=true"))["items"]
    assert sorted(item["prompt"] for item in items) == sorted(texts)

    (again,) = players(page([model, real], tmp_path / "seed.html", "seed=1", "seconds=1"))
    assert [motion["frames"] for motion in again[::2]] == [20] * 4
    assert again[0]["joints"] != generated[0]["joints"]


def test_folders_of_motions_are_compared_without_a_run(tmp_path):
    folders = [motions(tmp_path / name / "walks", PROMPTS, at) for at, name in enumerate("ab")]
    (scene,) = players(page(folders, tmp_path / "out.html"))
    assert {motion["id"] for motion in scene} == {str(folder) for folder in folders}, (
        "by path: both are called walks"
    )
    text = (tmp_path / "out.html").read_text()
    assert "Configuration differences" not in text
    assert "No evaluation in common" not in text


def test_a_rating_page_hides_whose_motions_it_shows(three, tmp_path, subtests):
    text = page(three, tmp_path / "rate.html", "rate=true")
    assert "Which animation better fits the following description?" in text
    items = data_of(text)["items"]
    pairs = [("mine/two", prompt) for prompt in PROMPTS] + [
        ("mine/three", prompt) for prompt in PROMPTS[1:]
    ]
    assert sorted((item["b"], item["prompt"]) for item in items) == sorted(pairs)
    for item in items:
        with subtests.test(prompt=item["prompt"]):
            scene = data_of(item["player"])
            assert [motion["id"] for motion in scene] == ["the left one", "the right one"]
            assert not any(motion["caption"] for motion in scene)
            assert not any(
                label in item["player"] for label in ("mine/one", "mine/two", "mine/three")
            )
            left, right = (motion["center"][0] for motion in scene)
            assert (left < right) == (item["left"] == "a"), (
                "a is the first run, which stands at the smallest x"
            )
    assert page(three, tmp_path / "again.html", "rate=true") == text


def test_sides_and_order_are_drawn(tmp_path, subtests):
    prompts = tuple(f"prompt {number}" for number in range(24))
    folders = [motions(tmp_path / name, prompts, at) for name, at in (("a", 0), ("b", 1))]
    out = tmp_path / "rate.html"
    first, other = (
        data_of(page(folders, out, "rate=true", f"seed={seed}"))["items"] for seed in (0, 1)
    )
    for seed, items in enumerate((first, other)):
        with subtests.test(seed=seed):
            assert 5 < sum(item["left"] == "a" for item in items) < 19
            assert [item["prompt"] for item in items] != list(prompts)
    assert [item["prompt"] for item in first] != [item["prompt"] for item in other]
    assert {item["prompt"]: item["left"] for item in first} != {
        item["prompt"]: item["left"] for item in other
    }


def test_only_runs_with_a_common_prompt_are_rated(tmp_path, capsys):
    folders = [motions(tmp_path / name, (name,)) for name in ("a", "b")]
    words = [f"runs={folders[0]} {folders[1]}", f"out={tmp_path / 'rate.html'}", "rate=true"]
    assert main(["compare", *words]) == 1
    assert "a and b have no prompt in common. Add prompts=FILE" in capsys.readouterr().err
    assert not (tmp_path / "rate.html").exists()


def ratings(
    path: Path, choices: str, rater: str = "ann", a: str = "ours", b: str = "real", study: str = "s"
) -> Path:
    answers = [
        {"prompt": f"p{k}", "a": a, "b": b, "choice": choice} for k, choice in enumerate(choices)
    ]
    path.write_text(json.dumps({"format": 1, "study": study, "rater": rater, "ratings": answers}))
    return path


def test_ratings_of_several_people_are_counted_once(tmp_path, capsys):
    files = [
        ratings(tmp_path / "x.json", "aab"),
        ratings(tmp_path / "y.json", "abb", rater="bob", a="real", b="ours"),
        ratings(tmp_path / "z.json", "a", rater="bob", b="other", study="t"),
    ]
    out = tmp_path / "ratings.json"
    assert main(["compare", f"ratings={' '.join(map(str, files))}", f"out={out}"]) == 0
    first, second = json.loads(out.read_text())["pairs"]
    assert first == {"a": "ours", "b": "real", "wins_a": 4, "wins_b": 2, "raters": 2}
    assert second == {"a": "ours", "b": "other", "wins_a": 1, "wins_b": 0, "raters": 1}
    printed = capsys.readouterr().out
    assert "ours over real: 4 of 6 answers, 66.7% (30.0% to 90.3%), 2 raters" in printed
    assert "ours over other: 1 of 1 answers, 100.0% (20.7% to 100.0%), 1 raters" in printed

    with pytest.raises(UserError, match=r"copy\.json: ann also answered this page in .*x\.json"):
        tally([files[0], ratings(tmp_path / "copy.json", "ab")])
    with pytest.raises(UserError, match=r"self\.json: rating 1 compares ours with itself"):
        tally([ratings(tmp_path / "self.json", "a", b="ours")])


def test_facts_of_runs_are_medians_of_speeds_and_the_last_number_of_passes(tmp_path, three):
    lines = [
        {"step": step, "train/epochs": step / 4, "train/seconds_per_step": seconds}
        | {"train/samples_per_second": 8 / seconds, "train/loss": 1.0}
        for step, seconds in ((1, 9.0), (3, 0.5), (5, 0.25))
    ]
    (three[0] / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    provenance = {
        "command": ["train"], "commit": None, "python": "3", "machine": "m", "packages": {},
        "data": {"fingerprint": "f00d"}, "device": "a GPU", "parameters": 12_345_678,
    }  # fmt: skip
    (three[0] / "provenance.json").write_text(json.dumps(provenance))
    runs = {folder.name: read_run(folder) for folder in three[:2]}
    head, rows = _facts(runs)
    first, second = (dict(zip(head, row, strict=True)) for row in rows)
    assert first == {
        "run": "a", "steps": "6", "passes": "1.25", "parameters": "12.35 M", "s/step": "0.5",
        "samples per second": "16", "device": "a GPU", "data": "f00d", "folder": str(three[0]),
    }  # fmt: skip
    assert (second["run"], second["steps"], second["parameters"]) == ("b", "10", "–")


def test_differences_are_those_of_the_replications_that_both_have():
    first = Value(mean=0, ci=None, replications=3, n=64, per_replication=[1.0, 2.0, 90.0], unit="m")
    second = Value(mean=0, ci=None, replications=2, n=64, per_replication=[2.0, 5.0])
    mean, low, high = paired_difference([1.0, 2.0], [2.0, 5.0])
    assert (mean, low < 0 < high) == (2, True)
    name, difference, interval, shown = _difference("x", first, second)
    assert (name, difference, shown) == ("x (m)", "2", "no difference shown")
    assert interval == f"[{low:.4g}, {high:.4g}]"
    assert _difference("x", first, second.model_copy(update={"n": 65})) == []
    missing = second.model_copy(update={"per_replication": [2.0, None]})
    assert _difference("x", first, missing) == []
    ordered = [[1.0, 2.0, 3.0], [3.0, 4.1, 5.0]]
    one, two = (first.model_copy(update={"per_replication": values}) for values in ordered)
    assert [_difference("x", *pair)[3] for pair in ((one, two), (two, one))] == ["higher", "lower"]


@pytest.mark.parametrize(
    ("change", "paired"),
    [
        ({}, True), ({"seed": 1}, False), ({"skeleton": {"stand_in": True}}, False),
        ({"skeleton": {"stand_in": False, "smpl_sha256": "5" * 64}}, False),
        ({"split": "val"}, True), ({"device": "cuda"}, True),
    ],
)  # fmt: skip
def test_motions_are_paired_if_seed_lengths_and_skeleton_agree(change: dict, paired: bool):
    values = {"values": {"fid": of(4.5, [4.4, 4.6])}}
    pair = [check_shape(result(**values, **changes), Result) for changes in ({}, change)]
    assert isinstance(differences(*pair), list) == paired


def test_differences_of_configurations_and_charts_leave_out_what_is_equal(tmp_path):
    runs = {
        name: read_run(a_run(tmp_path / name, name=name, **changes))
        for name, changes in (("a", {"x": 0, "experiment": "one"}), ("b", {"x": 0, "y": {"z": 1}}))
    }
    assert _differences(runs) == [["y.z", "–", "1"]]
    (tmp_path / "a" / "metrics.jsonl").write_text(
        '{"step": 1, "train/loss": 2.0, "val/fid": 0.5, "val/fid/ci": 0.25, "train/lr": 0.1}\n'
    )
    (tmp_path / "b" / "metrics.jsonl").write_text(
        '{"step": 5, "train/loss": 3.0, "val/fid": 0.75, "train/lr": 0.1}\n'
    )
    groups = _charts({name: read_run(run.folder) for name, run in runs.items()})
    titles = {
        heading: re.findall(r"<h3>(.*?)</h3>", "".join(charts))
        for heading, charts in groups.items()
    }
    assert titles == {
        "Validation": ["val/fid"],
        "Training curves": ["train/loss"],  # the rate is the same in both
    } or titles == {"Losses": ["train/loss"], "Validation": ["val/fid"], "Training curves": []}
    (chart,) = groups["Validation"]
    assert "polygon" in chart  # the interval of the first run
    assert "a 0.5" in re.sub("<[^>]*>", "", chart)
    assert "b 0.75" in re.sub("<[^>]*>", "", chart)


def test_a_table_of_results_has_the_real_motions_and_each_label_with_its_unit(tmp_path):
    names = ("first", "second", "third")
    folders = [a_run(tmp_path / name, name=name) for name in names]
    put(folders[0], values={"fid": of(4.5, [4.4, 4.6])})
    put(folders[1], values={"drift": of(1.0, [1.0, 1.5]) | {"unit": "m"}, "fid": of(3.5, [3.4, 3.6])},
        ground_truth={"fid": of(9.0, [9.0, 9.0])})  # fmt: skip
    put(folders[2], values={"fid": of(5.5, [5.0, 5.0])}, invalid_because=["off"],
        ground_truth={"fid": of(8.0, [8.0, 8.0])})  # fmt: skip
    runs = {name: read_run(folder) for name, folder in zip(names, folders, strict=True)}
    ((_, head, rows, notes, tables),) = _evaluations(runs)
    assert head == ["", "real motions", "first [1]", "second [2]", "third [3]"]
    assert rows == [
        ["drift (m)", "–", "–", "1 ± 0.1", "–"],
        ["fid", "0.125 ± 0.25", "4.5 ± 0.1", "3.5 ± 0.1", "5.5 ± 0.1"],
    ]
    assert [shown for _, shown in notes] == [[], [], ["not valid: off"]]
    (title, differences_of), (other, empty) = tables
    assert title == "[2] second − [1] first"
    assert [row[:2] for row in differences_of] == [["fid", "-1"]]
    assert (other, empty) == ("[3] third − [1] first: not compared: not valid: off", [])


def test_runs_of_equal_names_have_their_folders_as_labels(tmp_path):
    folders = [a_run(tmp_path / name, name="same") for name in "ab"]
    folders += [a_run(tmp_path / "c", name="other"), motions(tmp_path / "real")]
    labels = [entry.label for entry in find(folders)]
    assert labels == [str(folders[0]), str(folders[1]), "mine/other", "real"]
    assert [entry.run is None for entry in find(folders)] == [False, False, False, True]
    with pytest.raises(UserError, match="needs two or more runs"):
        find([folders[0], folders[0]])


def test_motions_of_one_text_are_numbered_and_hidden_files_are_not_read(tmp_path):
    folder = motions(tmp_path, ("walks", "jumps", "walks"))
    (folder / ".hidden.npz").write_bytes(b"")
    (folder / "below").mkdir()
    (folder / "below" / "x.npz").write_bytes(b"")
    assert list(read_motions(folder)) == [("walks", 0), ("jumps", 0), ("walks", 1)]
    first = {("a", 0): 1, ("b", 0): 2, ("a", 1): 3}
    second = {("a", 1): 1, ("a", 0): 2}
    assert in_all(cast(Any, [first, second])) == [("a", 0), ("a", 1)]


@pytest.mark.parametrize(("prompts", "seconds", "shown", "message"), [
    ({("walk", 0): None, ("run", 0): None}, None, ("actions", ["walk", "run"]), ""),
    ({("a person walks", 0): 3.0, ("a person walks", 1): 1.5}, [3.0, 1.5], ("texts", ["a person walks"] * 2), ""),
    ({("a person walks", 0): 3.01, ("a person runs", 0): 9.0, ("a person sits", 0): 2.0}, [3.0, 3.0, 2.0],
     ("texts", ["a person walks", "a person runs", "a person sits"]),
     "2 of 3 motions are shortened to 3 seconds, the maximum length for one"),
])  # fmt: skip
def test_runs_are_sampled_for_texts_or_actions_of_their_lengths(
    prompts, seconds, shown, message, monkeypatch, capsys
):
    requests: list[SamplingRequest] = []
    model = SimpleNamespace(
        facts={"max_frames": 90, "actions": ["walk", "run"]},
        representation=SimpleNamespace(fps=30.0),
    )

    def resolve(request: SamplingRequest, _: Any, check_words: bool) -> SamplingRequest:
        assert not check_words
        requests.append(request)
        return request

    monkeypatch.setattr("flame_mdm.checkpoints.loading.load", lambda *_: model)
    monkeypatch.setattr("flame_mdm.sampling.resolution.resolve", resolve)
    monkeypatch.setattr(
        "flame_mdm.sampling.generation.sample", lambda _, request: list(request.prompts)
    )
    entry = ComparedRun("one", Path("run"), None)
    sampled = _sampled(entry, prompts, seed=7)
    assert list(sampled) == list(prompts)
    (request,) = requests
    name, texts = shown
    assert list(getattr(request, name) or ()) == texts
    assert request.seconds == (seconds and tuple(seconds))
    assert (request.seed, request.split, request.samples) == (7, False, 1)
    assert capsys.readouterr().out.strip() == message


@pytest.mark.parametrize(("wins", "votes"), [(0, 5), (5, 5), (3, 10), (40, 90), (1, 1)])
def test_bounds_of_a_share_are_those_of_wilson(wins: int, votes: int):
    share, low, high = wilson(wins, votes)
    interval = binomtest(wins, votes).proportion_ci(0.95, method="wilson")
    assert share == wins / votes
    assert (low, high) == pytest.approx((interval.low, interval.high), abs=1e-5)
    assert 0 <= low <= share <= high <= 1
    assert wilson(0, 0) == (0, 0, 1)


def test_a_rater_of_two_pages_counts_once_and_sides_of_later_files_are_turned(tmp_path):
    files = [
        ratings(tmp_path / "a.json", "ab", a="ours", b="theirs"),
        ratings(tmp_path / "b.json", "aaa", a="theirs", b="ours", study="t"),
        ratings(tmp_path / "c.json", "b", rater="bob", a="theirs", b="ours"),
    ]
    (pair,) = tally(files)
    assert (pair.a, pair.b, pair.wins_a, pair.wins_b, pair.raters) == ("ours", "theirs", 2, 4, 2)
    assert (pair.votes, pair.share[0]) == (6, pytest.approx(1 / 3))


def test_the_player_has_a_column_per_run_and_names_motions_without_a_condition(monkeypatch):
    pages: list[tuple[Any, ...]] = []
    monkeypatch.setattr(
        "flame_mdm.visualize.player_page",
        lambda *values, **keywords: pages.append((*values, keywords)),
    )
    motion = Motion(np.zeros((5, 22, 3)), 20.0, text="x", id="y")
    shown = [{("walks", 0): motion, ("", 0): motion}, {("", 0): motion, ("walks", 0): motion}] * 2
    _player(["a", "b", "c"], shown[:3], None, lambda motion: [(0, 1, motion.id, motion.text)])
    ((scene, title, keywords),) = pages
    names = [(motion.text, motion.id) for motion in scene]
    assert names == [(text, label) for text in ("walks", "unconditioned") for label in "abc"]
    assert (title, keywords["columns"]) == ("", 3)
    assert keywords["marks"] == [[(0, 1, label, text)] for text, label in names]
    assert (
        _player(["a", "b"], [{("walks", 0): motion}, {("sits", 0): motion}], None, lambda _: [])
        == ""
    )


def test_two_results_of_one_run_are_no_evaluation_in_common(tmp_path):
    folders = [a_run(tmp_path / name, name=name) for name in "ab"]
    put(folders[0], "x")
    put(folders[0], "y", seed=1)
    runs = {folder.name: read_run(folder) for folder in folders}
    title = "p version 3, synthetic test, data abc"
    assert in_common(runs) == [
        "No evaluation in common: differences need the same protocol, data and extractor.",
        title,
    ]
    assert [label for label, _ in grouped(runs)[title]] == ["a", "a"]
    assert in_common({"a": runs["a"]}) == []
    put(folders[1], "z")
    assert in_common({folder.name: read_run(folder) for folder in folders}) == []


def test_pages_and_counts_have_different_files_by_default(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    folders = [motions(tmp_path / name, ("walks",), at) for at, name in enumerate("ab")]
    answers = ratings(tmp_path / "x.json", "ab")
    runs = f"runs={' '.join(map(str, folders))}"
    for words, name in (
        ([runs], "compare.html"),
        ([runs, "rate=true"], "rate.html"),
        ([f"ratings={answers}"], "ratings.json"),
    ):
        assert main(["compare", *words]) == 0
        assert f"runs/{name}" in capsys.readouterr().out
    assert "Which animation better" in (tmp_path / "runs" / "rate.html").read_text()
    assert "Which animation better" not in (tmp_path / "runs" / "compare.html").read_text()
    assert json.loads((tmp_path / "runs" / "ratings.json").read_text())["pairs"][0]["wins_a"] == 1
    assert main(["compare", runs, f"ratings={answers}"]) == main(["compare"]) == 1
