"""Runs side by side."""

from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_rel
from support.pages import PROMPTS, a_run, motions, players, put, result
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.reporting.compare import paired_difference


@pytest.fixture
def three(tmp_path) -> list[Path]:
    """Three runs, the last with other prompts."""
    first = a_run(tmp_path / "a", name="one", optimizer={"lr": 0.1, "same": 1})
    second = a_run(tmp_path / "b", name="two", optimizer={"lr": 0.2, "same": 1}, extra="<em>")
    third = a_run(tmp_path / "c", name="three", optimizer={"lr": 0.2, "same": 1})
    for at, (folder, prompts) in enumerate([(first, PROMPTS), (second, PROMPTS[::-1]), (third, PROMPTS[1:])], 1):
        motions(folder / "samples" / "step_0000009", prompts, at)
    return [first, second, third]


def page(folders: list[Path], out: Path, *words: str) -> str:
    assert main(["compare", f"runs={' '.join(map(str, folders))}", f"out={out}", *words]) == 0
    return out.read_text()


def test_a_page_puts_runs_side_by_side(three, tmp_path):
    put(three[0])
    put(three[1], values={"fid": {"mean": 7.5, "ci": 0.5, "replications": 2, "n": 64}}, quick=True)
    put(three[1], "y", split="val")
    text = page(three, tmp_path / "out.html")
    table = text[text.index("Configuration differences") : text.index("Motions for the same prompts")]
    assert "<td>optimizer.lr</td><td>0.1</td><td>0.2</td>" in table
    assert "<td>extra</td><td>–</td><td>&lt;em&gt;</td>" in table
    assert "same" not in table
    assert "run.dir" not in table
    (scene,) = players(text)
    labels = ["mine/one", "mine/two", "mine/three"]
    names = [(motion["caption"], motion["id"]) for motion in scene]
    assert names == [(prompt, label) for prompt in PROMPTS[1:] for label in labels], "prompts that all have"
    assert [round(motion["center"][0] - 0.5) for motion in scene] == [1, 2, 3] * 2, "each under its own name"
    assert text.count("<h3>p version 3") == 2, "splits are not compared"
    for words in ("7.5 ± 0.5", "Quick run — not for publication", "mine/one 0.001953"):
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
    assert lines["few"] == ["few", "1", "–", "not", "tested:", "one", "replication"]
    marks = "[2] mine/two − [1] mine/one", "-0.2967", "no difference shown", "do not cover another training run"
    assert all(words in text for words in marks)


def test_what_is_not_paired_has_no_difference(three, tmp_path, capsys):
    values = {"fid": of(4.5, [4.4, 4.6])}
    put(three[0], values=values)
    for changes, message in (
        (None, "No evaluation in common"),
        ({"seed": 1}, "not compared: other seed"),
        ({"invalid_because": ["real motions are off"]}, "not compared: not valid: real motions are off"),
        ({"values": {"fid": of(4.2, [4.1, 4.3], n=65)}}, "not compared: no metric has values per replication"),
        ({"values": result()["values"]}, "evaluate both again; motions are not generated again"),
        ({"protocol": {"name": "q", "version": 3}}, "q version 3, synthetic test, data abc"),
        ({"extractor": {"sha256": "0" * 64}}, "No evaluation in common"),
    ):
        if changes is not None:
            put(three[1], **{"values": values, **changes})
        text = page(three[:2], tmp_path / "out.html")
        printed = capsys.readouterr().out
        assert message in printed
        assert message in unescape(text)
        assert "95 %" not in printed


@pytest.mark.slow
def test_runs_are_sampled_for_prompts(tmp_path, trained, data_root):
    model, other = trained.parent.parent, tmp_path / "b"
    words = [*TINY, f"data_root={data_root}", f"run.dir={other}", "run.name=longer", "trainer.max_steps=4"]
    assert main(["train", "quickstart", *words, "callbacks.samples=null", "callbacks.best=null"]) == 0
    (tmp_path / "prompts.txt").write_text("a person hops\n\na person walks\na person hops\n")
    (scene,) = players(
        page([model, other], tmp_path / "out.html", f"prompts={tmp_path / 'prompts.txt'}", "seconds=1.5")
    )
    assert [motion["id"] for motion in scene] == ["quickstart", "quickstart/longer"] * 2
    assert [motion["caption"] for motion in scene[::2]] == ["a person hops", "a person walks"]
    assert scene[0]["frames"] == 30
    assert scene[0]["joints"] != scene[1]["joints"]
