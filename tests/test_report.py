"""Messages of a run while it trains, and the page that shows them."""

import contextlib
import io
import json
import math
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import torch
from support.pages import a_run, motions, put, result
from support.runs import TINY
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from wandb import Run

from flame_mdm import runs
from flame_mdm.__main__ import main
from flame_mdm.records import AuditedMetric, Measured, Result, Value
from flame_mdm.reporting.page import filled, interval, number, page, short
from flame_mdm.reporting.plots import (
    Histogram,
    Panel,
    Series,
    _drawn,
    _linear_axis,
    _log_axis,
    _tick,
    chart,
    svg,
)
from flame_mdm.reporting.report import (
    _chart,
    _evaluation,
    _facts,
    _provenance,
    charted,
    marks,
    sampling,
    write_report,
)
from flame_mdm.runs import Provenance, RunConfig, made_by, read_history, read_run
from flame_mdm.schemas import check_shape
from flame_mdm.training import callbacks

pytestmark = pytest.mark.slow

RUN = [
    *TINY,
    "trainer.log_every_n_steps=2",
    "trainer.val_check_interval=4",
    "callbacks.checkpoints.every_n_steps=4",
]
EVALUATE = """# @package _global_
defaults:
  - /quickstart
  - _self_
callbacks:
  evaluate: {_target_: evaluators.callback.Evaluate, protocol: synthetic, extractor: none, every_n_steps: 4, samples: 4,
    replications: 2}
"""


def run(folder: Path, data_root: Path, *words: str, recipe: str = "quickstart") -> Path:
    assert main(["train", recipe, *RUN, f"data_root={data_root}", f"run.dir={folder}", *words]) == 0
    return folder


@pytest.fixture(scope="module")
def printed() -> io.StringIO:
    """Text that the run `evaluated` printed."""
    return io.StringIO()


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory, data_root, printed) -> Path:
    """A run of 8 steps that evaluates while it trains."""
    folder = tmp_path_factory.mktemp("evaluated")
    (folder / "mine.yaml").write_text(EVALUATE)
    with contextlib.redirect_stdout(printed):
        return run(
            folder / "run", data_root, "trainer.max_steps=8", recipe=str(folder / "mine.yaml")
        )


def test_the_history_holds_what_a_step_does_and_costs(evaluated, subtests):
    curves = read_history(evaluated)
    for name in (
        "loss",
        "mse",
        "grad_norm",
        "lr",
        "epochs",
        "samples_per_second",
        "seconds_per_step",
    ):
        with subtests.test(name=name):
            assert list(curves[f"train/{name}"]) == [1, 3, 5, 7], name
    assert list(curves["val/loss"]) == [3, 7]
    clips = 108  # of 120
    assert curves["train/epochs"][7] == pytest.approx(8 * 8 / clips, rel=0.1)
    for step, pace in curves["train/samples_per_second"].items():
        with subtests.test(step=step):
            assert pace * curves["train/seconds_per_step"][step] == pytest.approx(8, rel=1e-4)
    assert "train/gpu_memory_gib" not in curves
    name = "val/synthetic/foot_skating"
    assert curves[name].keys() == curves[f"{name}/ci"].keys() == {3, 7}
    assert all(width > 0 for width in curves[f"{name}/ci"].values())
    jitter = "val/synthetic/jitter (m/s^3)"
    assert curves[jitter].keys() == curves[f"{jitter}/real"].keys() == {3, 7}
    assert len({*curves[f"{jitter}/real"].values()}) == 1, "real motions do not change"
    assert 0 < curves[f"{jitter}/real"][3] < curves[jitter][3]
    assert "val/synthetic/jitter" not in curves, (
        "checkpoints alone are selected by the name without a unit"
    )


def test_tensorboard_shows_the_table_the_configuration_and_the_data(evaluated):
    events = EventAccumulator(str(evaluated / "tensorboard"))
    events.Reload()
    names = events.Tags()["tensors"]
    values = [events.Tensors(name)[-1].tensor_proto.string_val[0].decode() for name in names]
    text = {
        name.removesuffix("/text_summary"): value for name, value in zip(names, values, strict=True)
    }
    evaluation = (
        "| metric | mean | ci | replications | n | unit | real motions |",
        "| foot_skating |",
        "| m/s^3 |",
    )
    assert all(words in text["evaluation/synthetic"] for words in evaluation)
    assert "num_train_timesteps: 10" in text["config"]
    assert "fingerprint: " in text["provenance"]
    assert events.Tags()["images"] == ["samples"]
    assert {event.step for event in events.Images("samples")} <= {3, 7}, (
        "the steps of the validations"
    )


def test_the_norm_is_that_before_clipping_and_taken_for_the_log_alone(
    tmp_path, data_root, monkeypatch
):
    norms = []

    def counted(gradients: Any) -> torch.Tensor:
        norms.append(torch.nn.utils.get_total_norm(gradients))
        return norms[-1]

    monkeypatch.setattr(callbacks, "get_total_norm", counted)
    words = [
        "trainer.max_steps=6",
        "trainer.gradient_clip_val=1e-6",
        "trainer.accumulate_grad_batches=2",
    ]
    curves = read_history(run(tmp_path / "run", data_root, *words, "callbacks.samples=null"))
    assert list(curves["train/grad_norm"].values()) == pytest.approx(
        [float(norm) for norm in norms]
    )
    assert list(curves["train/grad_norm"]) == [1, 3, 5]
    assert min(curves["train/grad_norm"].values()) > 1e-3
    pace = curves["train/samples_per_second"][5] * curves["train/seconds_per_step"][5]
    assert pace == pytest.approx(16, rel=1e-4), "samples of a step, not of a batch"


def test_wandb_has_one_run_through_resume(tmp_path, data_root, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    for name in ("SILENT", "DISABLE_GIT", "DISABLE_CODE", "X_DISABLE_META", "X_DISABLE_STATS"):
        monkeypatch.setenv(f"WANDB_{name}", "true")
    rows: list[dict[str, Any]] = []
    log = Run.log

    def noted(self: Run, data: dict[str, Any], step: int | None = None, **options: Any) -> None:
        rows.append({"_step": self.step if step is None else step, **data})
        log(self, data, step, **options)

    monkeypatch.setattr(Run, "log", noted)
    words = ["logger=wandb", "logger.offline=true", "callbacks.samples.every_n_steps=4"]
    folder = run(tmp_path / "run", data_root, *words, "trainer.max_steps=4")
    first_id, first = json.loads((folder / "wandb.json").read_text())["id"], len(rows)
    run(folder, data_root, *words, "trainer.max_steps=8")
    assert json.loads((folder / "wandb.json").read_text())["id"] == first_id
    assert len(list(folder.glob(f"wandb/offline-run-*-{first_id}/*.wandb"))) == 2
    assert any("samples" in row for row in rows[first:])
    filled = [row for row in rows if len(row) > 1]
    assert [row["_step"] for row in filled] == list(range(len(filled))), (
        "else the second part replaces the first"
    )
    steps = [row["trainer/global_step"] for row in filled]
    assert steps == sorted(steps)
    losses = {
        row["trainer/global_step"]: row["train/loss"] for row in filled if "train/loss" in row
    }
    assert losses == pytest.approx(read_history(folder)["train/loss"])


def test_training_ends_with_a_report_that_needs_nothing_else(evaluated, subtests):
    text = (evaluated / "report.html").read_text()
    for words in (
        "Samples at step 8",
        "Losses",
        "Validation",
        "synthetic/foot_skating",
        "grad_norm",
        "fingerprint",
    ):
        with subtests.test(words=words):
            assert words in text, words
    assert not re.findall(
        r"""(?:src|href)=["'](?!data:)|url\(|@import|https?://(?!www\.w3\.org)""", text
    )
    assert "srcdoc=" in text
    assert main(["report", str(evaluated)]) == 0
    assert (evaluated / "report.html").read_text() == text


def test_a_report_shows_evaluations_and_why_training_stopped(tmp_path, subtests):
    folder = a_run(tmp_path / "run")
    put(folder, invalid_because=["real motions are off"], changed={"samples": 64})
    batches = [{"rank": 0, "batch": 7, "ids": ["<b>walk"], "loss": "nan"}]
    (folder / "bad_batch.json").write_text(
        json.dumps({"step": 8, "usual_loss": "0.5", "batches": batches})
    )
    text = write_report(folder).read_text()
    for words in (
        *(
            "4.5 ± 0.25",
            "0.125 ± 0.25",
            "not valid: real motions are off",
            "differs from the protocol: samples 64",
            "replications x motions: 2 x 64",
        ),
        *(
            "not computed: kid: too few &lt;samples&gt;",
            "ddim, 5 steps, guidance 2.5",
            "p version 3, synthetic test",
        ),
        *("Training stopped at step 8", "&lt;b&gt;walk"),
    ):
        with subtests.test(words=words):
            assert words in text, words
    assert "<b>" not in text


def test_a_single_replication_has_no_interval_in_a_report(tmp_path):
    folder = a_run(tmp_path / "run")
    put(folder, values={"fid": {"mean": 7.25, "ci": None, "replications": 1, "n": 64}})
    text = write_report(folder).read_text()
    assert "7.25" in text
    assert "7.25 ±" not in text
    assert "replications x motions: 1 x 64" in text


def test_names_are_text_not_html(tmp_path):
    folder = a_run(tmp_path / "run", name="<script>alert(1)</script>", note="</pre><script>")
    (folder / "metrics.jsonl").write_text(
        '{"step": 1, "train/<i>x": 2.0}\n{"step": 2, "train/<i>x": 3.0}\n'
    )
    text = write_report(folder).read_text()
    assert not re.search("<script|<i>x", text)
    text = page("a & b", chart("<i>", {"<b>": {1: 2.0}}) + "<u>")
    assert all(
        escaped in text for escaped in ("<title>a &amp; b</title>", "&lt;i&gt;", "&lt;u&gt;")
    )
    assert not re.search("<[ibu]>", text)


def test_missing_files_are_named(tmp_path, capsys, subtests):
    folder = a_run(tmp_path / "run")
    (folder / "metrics.jsonl").unlink()
    assert "there is no metrics.jsonl in the folder" in write_report(folder).read_text()
    assert read_run(folder).label == "mine"
    for words, message in (([str(tmp_path)], "contains no config.yaml"), ([], "runs is missing")):
        with subtests.test(words=words, message=message):
            assert main(["report", *words]) == 1
            assert message in capsys.readouterr().err


def test_training_ends_with_what_its_numbers_mean(evaluated, printed, tmp_path):
    out, curves = printed.getvalue(), read_history(evaluated)
    ours, real = re.findall(r"^  foot_skating: (\S+) \(real motions: (\S+)\)$", out, re.MULTILINE)[
        0
    ]
    assert ours == number(curves["samples/foot_skating"][7])
    assert 0 <= float(real) < 0.05
    assert (
        "foot_skating: Foot skating ratio: fraction of frame transitions in which a foot that touches"
        in out
    )
    assert re.search(r"^  attributes/action: \S+ \(real motions: 1\)$", out, re.MULTILINE)
    pattern = r"^loss after 8 steps: (\S+) on the last batch, (\S+) on the validation clips"
    ((batch, clips),) = re.findall(pattern, out, re.MULTILINE)
    assert clips == f"{curves['val/loss'][7]:.4g}"
    assert float(batch) > 0
    command = re.findall(r"^next: flame-mdm (sample .*)$", out, re.MULTILINE)[0]
    assert main([*shlex.split(command), f"out={tmp_path / 'samples'}", "samples=1"]) == 0
    assert f"flame-mdm evaluate {evaluated} extractor=motion_clip_synthetic quick=true" in out


def points(svg: str) -> list[tuple[float, float]]:
    line = re.findall(r'<polyline class="c0 line" points="([^"]*)"', svg)[0]
    return [(float(x), float(y)) for x, y in (pair.split(",") for pair in line.split())]


def test_a_chart_draws_what_it_is_given():
    straight = points(chart("x", {"a": {0: 1.0, 5: 2.0, 10: 3.0}}))
    assert straight[1] == pytest.approx(
        ((straight[0][0] + straight[2][0]) / 2, (straight[0][1] + straight[2][1]) / 2)
    )
    assert straight[0][1] > straight[2][1], "up is more"
    logarithmic = points(chart("x", {"a": {0: 1.0, 5: 10.0, 10: 100.0}}))
    assert logarithmic[1][1] == pytest.approx((logarithmic[0][1] + logarithmic[2][1]) / 2, abs=0.1)
    thin = points(
        chart("x", {"a": {step: math.sin(step / 500) for step in range(20_000)} | {7777: 9.0}})
    )
    assert len(thin) <= 600
    assert (
        min(y for _, y in thin)
        == points(chart("x", {"a": {0: 0.0, 7777: 9.0, 19_999: -1.0}}))[1][1]
    ), "extremes"


@pytest.mark.parametrize(("value", "text"), [
    (None, "–"), (0.0, "0"), (3, "3"), (0.00099, "9.90e-04"), (-0.00012345, "-1.23e-04"), (0.001, "0.001"),
    (1.23456, "1.235"), (9999.4, "9999"), (10_000.0, "10,000"), (-12_345.6, "-12,346"), (float("nan"), "nan"),
])  # fmt: skip
def test_numbers_of_pages_have_four_digits(value: float | None, text: str):
    assert number(value) == text


def test_intervals_have_two_digits_and_steps_are_short():
    assert [interval(*pair) for pair in ((1.5, 0.0456), (1.5, None), (None, 0.1))] == [
        "1.5 ± 0.046",
        "1.5",
        "–",
    ]
    steps = (0, 999, 1000, 1500, 999_999, 1_000_000, 2_500_000, -1500)
    assert [short(step) for step in steps] == [
        "0", "999", "1k", "1.5k", "1000k", "1M", "2.5M", "-1.5k",
    ]  # fmt: skip


def test_columns_and_rows_without_a_value_are_left_out():
    head = ("run", "steps", "device", "data")
    rows = [["a", "5", "–", "x"], ["b", "–", "", "–"], ["c", "–", "–", "y"]]
    assert filled(head, rows) == (["run", "steps", "data"], [["a", "5", "x"], ["c", "–", "y"]])


def test_curves_of_one_name_share_a_chart_below_losses_if_they_are_trained():
    names = ["train/loss", "val/loss", "val/fid", "val/fid/ci", "val/fid/real", "samples/skating"]
    names += ["train/lr", "val/lr", "train/epochs", "train/grad_norm"]
    assert charted(names) == {
        "Losses": {"loss": ["train", "val"]},
        "Validation": {"fid": ["val"], "lr": ["val"]},
        "Samples for the fixed prompts": {"skating": ["samples"]},
        "Training curves": {"grad_norm": ["train"], "lr": ["train"]},
    }


@pytest.mark.parametrize(("low", "high", "to_ticks", "ends", "ticks"), [
    (0.3, 9.7, True, (0, 10), [0, 5, 10]), (0.0, 4.0, True, (0, 4), [0, 1, 2, 3, 4]),
    (-1.2, 0.9, True, (-2, 1), [-2, -1, 0, 1]), (0, 2999, False, (0, 2999), [0, 1000, 2000, 3000]),
    (0, 2900, False, (0, 2900), [0, 1000, 2000]), (5.0, 5.0, True, (4.5, 5.5), [4.5, 5.0, 5.5]),
    (0.0, 0.0, True, (-0.1, 0.1), [-0.1, -0.05, 0.0, 0.05, 0.1]),
])  # fmt: skip
def test_ticks_of_an_axis_are_round_numbers(
    low: float, high: float, to_ticks: bool, ends: tuple[float, float], ticks: list[float]
):
    axis = _linear_axis(low, high, to_ticks)
    assert (axis.low, axis.high) == pytest.approx(ends)
    assert list(axis.ticks) == pytest.approx(ticks)
    assert axis.share(axis.low - 1) == 0
    assert axis.share((axis.low + axis.high) / 2) == pytest.approx(0.5)


def test_ticks_of_a_logarithmic_axis_are_powers_of_ten_and_their_double_and_fivefold():
    assert _log_axis(1.0, 60.0).ticks == [1, 2, 5, 10, 20, 50]
    assert _log_axis(1.0, 9e5).ticks == [1, 100, 10_000]
    assert _log_axis(1.0, 100.0).share(10.0) == pytest.approx(0.5)
    axis = _log_axis(2.0, 50.0)
    assert (axis.low, axis.high) == pytest.approx((2 / 1.15, 50 * 1.15))
    texts = [_tick(value) for value in (0.0, 1e-13, 0.0005, 0.001, 1500.0, 0.30000000000000004)]
    assert texts == ["0", "0", "5e-4", "0.001", "1.5k", "0.3"]


@pytest.mark.parametrize(("most", "logarithmic"), [(15.0, False), (15.1, True)])
def test_losses_that_span_a_factor_of_fifteen_have_a_logarithmic_axis(
    most: float, logarithmic: bool
):
    line = points(chart("x", {"a": {0: 1.0, 5: (1 + most) / 2, 10: most}}))
    middle = (line[0][1] + line[2][1]) / 2
    assert (abs(line[1][1] - middle) > 5) == logarithmic


@pytest.mark.parametrize(("level", "direction"), [(0.5, 1), (6.0, -1)])
def test_the_axis_reaches_levels_below_and_above_all_points(level: float, direction: int):
    panel = _drawn(Panel([Series("a", [(0, 2.0), (1, 3.0)])], levels=[level]))
    assert panel is not None
    of_points = [float(y) for *_, dots in panel["lines"] for _, y in dots]
    (of_level,) = (float(y) for y in panel["levels"])
    # y points down on the page
    assert min(direction * (of_level - y) for y in of_points) > 10


def test_bars_of_a_histogram_are_as_high_as_their_counts():
    plot = svg("lengths", [Panel(Histogram(5, [3, 0, 6]), "frames")])
    bars = [
        [float(x) for x in re.findall(r'(?:x|y|width|height)="([\d.-]+)"', bar)]
        for bar in re.findall(r"<rect[^>]*>", str(plot))
        if "bar" in bar or "c0" in bar
    ]
    titles = re.findall(r"\d+ to \d+ frames: \d+ motions", str(plot))
    assert titles == [f"{k} to {k + 5} frames: {n} motions" for k, n in ((0, 3), (5, 0), (10, 6))]
    heights = [bar[3] for bar in bars]
    assert heights[0] == pytest.approx(heights[2] / 2, abs=0.2)
    assert heights[1] == 0
    assert bars[1][0] - bars[0][0] == pytest.approx(bars[0][2] + 1, abs=0.2)


def test_a_spread_reaches_to_both_sides_of_its_points_and_beyond_the_curve():
    curve = {0: 1.0, 1: 2.0, 2: 3.0}
    plain, wide = (
        points(chart("x", {"a": curve}, bands)) for bands in (None, {"a": {0: 1.0, 2: -5.0}})
    )
    assert plain[2][1] < wide[2][1] < wide[0][1] < plain[0][1], "the axis has room for the band"


def test_the_newest_samples_and_the_number_of_steps_are_those_of_the_run(tmp_path):
    folder = a_run(tmp_path / "run", name="two")
    for step in (2, 10):
        motions = folder / "samples" / f"step_{step:07d}"
        motions.mkdir(parents=True)
        (motions / "motion_000.npz").write_bytes(b"")
    (folder / "samples" / "step_x").mkdir()
    run = read_run(folder)
    assert run.samples == folder / "samples" / "step_0000010"
    assert (run.steps, run.label) == (10, "mine/two")
    (folder / "metrics.jsonl").write_text(
        '{"step": 30, "val/fid": 1.0}\n{"step": 7, "train/x": 1}\n'
    )
    assert read_run(folder).steps == 8, "of steps that were trained"
    assert read_run(a_run(tmp_path / "other")).label == "mine"


ORIGINS: dict[str, dict[str, Any]] = {
    "the checkpoint": {"checkpoint": result()["checkpoint"] | {"sha256": "9" * 64}},
    "the motions of others": {"checkpoint": None, "samples_sha256": "9" * 64},
    "another baseline": {"checkpoint": None, "baseline": "noisy"},
    "the extractor": {"extractor": {"sha256": "e" * 64}},
    "the data": {"data": {"dataset": "synthetic", "fingerprint": "other"}},
    "the protocol": {"protocol": {"name": "p", "version": 3, "sha256": "5" * 64}},
    "the split": {"split": "val"},
    "the seed": {"seed": 1},
}


@pytest.mark.parametrize("name", ORIGINS)
def test_results_of_other_inputs_have_other_origins(name: str):
    assert (
        check_shape(result(**ORIGINS[name]), Result).origin != check_shape(result(), Result).origin
    )


EARLIER: list[tuple[Any, dict[str, Any], dict[str, Any]]] = [
    (
        AuditedMetric,
        {},
        {
            "unit": "",
            "sees_meaning": True,
            "sums_up": True,
            "exact": False,
            "depends_on_count": False,
        },
    ),
    (
        Measured,
        {"ground_truth": None, "values": None, "not_computed": {}, "invalid_because": []},
        {"forced": False, "warnings": [], "cost": None, "seeds": []},
    ),
    (
        Value,
        {"mean": 0.0, "ci": None, "replications": 1, "n": 4},
        {"per_replication": [], "n_real": None, "unit": "", "resampled": []},
    ),
    (
        Provenance,
        {"command": [], "commit": None, "python": "", "machine": "", "packages": {}, "data": {}},
        {"data": {"fingerprint": "–"}, "changed": None, "device": "–", "parameters": None},
    ),
    (
        RunConfig,
        {"experiment": "a/b", "trainer": {"max_steps": 0}, "run": {}},
        {"experiment": "a/b", "max_steps": 0, "name": "default"},
    ),
    (
        RunConfig,
        {"experiment": None, "trainer": {"max_steps": -1}, "run": {"name": 0}},
        {"experiment": None, "max_steps": -1, "name": 0},
    ),
]
"""Schemas, contents without the keys that were added later, and the values of these keys."""


@pytest.mark.parametrize(("schema", "content", "expected"), EARLIER)
def test_keys_that_a_file_lacks_have_the_values_of_the_version_that_wrote_it(
    schema, content, expected
):
    values = check_shape(content, schema).model_dump()
    assert {name: values[name] for name in expected} == expected


@pytest.mark.parametrize(
    ("name", "label"), [("default", "a/b"), ("long", "a/b/long"), (0, "a/b/0"), (None, "a/b")]
)
def test_a_run_is_called_by_its_recipe_and_its_name(name, label):
    config = {"experiment": "a/b", "run": {} if name is None else {"name": name}}
    assert runs.Run(Path("x"), config, None, {}, {}).label == label


@pytest.mark.parametrize(
    ("path", "hint"),
    [
        ("runs/a/b/default/checkpoints/best.ckpt", "make train EXP=a/b"),
        ("runs/a/long/checkpoints/last.ckpt", "runs/a/long/checkpoints/last.ckpt is missing"),
        ("assets/t2m/kit", 'assets/t2m/kit is missing; see "Extractors" in docs/evaluation.md'),
        ("a.safetensors", "a.safetensors is missing"),
    ],
)
def test_a_missing_file_has_a_hint_how_to_obtain_it(path, hint):
    assert made_by(path) == hint


def test_a_page_names_the_number_of_motions_of_most_values():
    values = {
        "none": {"mean": None, "ci": None, "replications": 2, "n": 0},
        "a": {"mean": 1.0, "ci": 0.1, "replications": 2, "n": 64},
        "b": {"mean": 1.0, "ci": 0.1, "replications": 2, "n": 64},
        "c": {"mean": 1.0, "ci": 0.1, "replications": 5, "n": 600},
    }
    assert check_shape(result(values=values), Result).counts == "2 x 64"
    uneven = {"mean": 1.0, "ci": 0.1, "replications": 2, "n": None, "n_per_replication": [64, 5]}
    assert check_shape(result(values={"a": uneven}), Result).counts == "64 + 5"
    assert check_shape(result(values={"none": values["none"]}), Result).counts == ""


@pytest.mark.parametrize(
    ("resampled", "half"), [([1.0, 2.0, 3.0], 0.95), ([1.0, None, 3.0], None), ([], None)]
)
def test_a_value_that_some_draws_lack_has_no_interval(resampled, half):
    value = Value(mean=2.0, ci=None, replications=1, n=3, resampled=resampled)
    assert value.half == pytest.approx(half)


def test_a_result_says_where_its_motions_come_from_and_how_long_they_took():
    of_model = check_shape(result(cost={"seconds_per_sample": 0.01234, "batch_size": 8.0}), Result)
    assert sampling(of_model) == (
        "last.ckpt (01234567), ddim, 5 steps, guidance 2.5, seed 0, replications x motions: 2 x 64, "
        "0.0123 seconds per motion on cpu, batches of 8"
    )
    others = {"checkpoint": None, "cost": None}
    assert sampling(check_shape(result(**others), Result)) == (
        "motions from other systems, replications x motions: 2 x 64"
    )
    baseline = check_shape(result(**others, baseline="noisy"), Result)
    assert sampling(baseline).startswith("baseline noisy, replications")


@pytest.mark.parametrize(("quick", "marked"), [
    (False, ["not valid: a", "not valid: b", "differs from the protocol: samples 64, replications 2"]),
    (True, ["Quick run — not for publication", "not valid: a", "not valid: b"]),
])  # fmt: skip
def test_a_result_is_marked_if_it_is_quick_not_valid_or_of_another_size(quick, marked):
    changed = {"samples": 64, "replications": 2}
    shown = check_shape(result(quick=quick, invalid_because=["a", "b"], changed=changed), Result)
    assert marks(shown) == marked
    assert marks(check_shape(result(), Result)) == []


def test_of_a_resumed_run_the_later_line_of_a_step_counts_and_an_incomplete_one_does_not(tmp_path):
    folder = a_run(tmp_path / "run")
    lines = ['{"step": 3, "train/loss": 3.0}', '{"step": 5, "train/loss": 9.0, "epoch": 1}']
    lines += ['{"step": 4, "train/loss": 4.0}', '{"step": 5, "train/loss": 5.0}']
    lines += ['{"step": 8, "samples/skating": 0.5}', '{"step": 9, "train/loss": 1.0}']
    (folder / "metrics.jsonl").write_text("\n".join(lines))
    curves = read_history(folder)
    assert list(curves["train/loss"].items()) == [(3, 3.0), (4, 4.0), (5, 5.0)]
    assert curves.keys() == {"samples/skating", "train/loss"}
    assert read_run(folder).steps == 9
    (folder / "metrics.jsonl").write_text("\n".join([*lines, ""]))
    assert read_run(folder).steps == 10


def test_facts_of_a_report_are_those_of_the_last_step(tmp_path):
    folder = a_run(tmp_path / "run")
    lines = [
        {"step": step, "train/epochs": passes, "train/seconds_per_step": seconds}
        for step, passes, seconds in ((1999, 2.0, 9.0), (999, 1.0, 0.5), (2999, 3.0, 0.123456))
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    provenance = {
        "command": ["train"], "commit": None, "python": "3", "machine": "m", "packages": {},
        "data": {"fingerprint": "f00d"}, "device": "a GPU", "parameters": 12_345_678,
    }  # fmt: skip
    (folder / "provenance.json").write_text(json.dumps(provenance))
    assert _facts(read_run(folder)) == [
        "step 3,000 of 20", "3 passes over the data", "12.35 M parameters", "0.123 s/step", "a GPU",
    ]  # fmt: skip


def drawn(*series: Series, **options: Any) -> dict[str, Any]:
    panel = _drawn(Panel(series, **options))
    assert panel is not None
    return panel


def test_errors_reach_as_far_up_as_down_and_a_logarithmic_axis_has_no_zero():
    points = [(0.0, 1.0), (1.0, 2.0), (10.0, 3.0), (100.0, 4.0)]
    panel = drawn(Series("a", points, {1.0: 0.5, 100.0: 0.25}, "dots"), log_x=True)
    ((_, kind, _, rim, errors, dots),) = panel["lines"]
    assert (kind, len(dots), len(errors), len(rim.split())) == ("dots", 3, 2, 4)
    across = [float(x) for x, _ in dots]
    assert across[1] - across[0] == pytest.approx(across[2] - across[1], abs=0.1)
    middle = {x: float(y) for x, y in dots}
    sizes = []
    for x, lower, upper in errors:
        assert float(lower) - middle[x] == pytest.approx(middle[x] - float(upper), abs=0.15)
        sizes.append(float(lower) - float(upper))
    assert sizes[0] == pytest.approx(2 * sizes[1], abs=0.3)


@pytest.mark.parametrize(
    ("count", "dots", "ends"), [(40, 40, 40), (41, 0, 41), (600, 0, 600), (601, 0, 401)]
)
def test_short_curves_have_dots_and_long_ones_the_extremes_of_their_parts(count, dots, ends):
    """601 points are 200 parts of 3, of which the lowest and the highest one are drawn, and one point."""
    curve = [(float(x), float(x % 7)) for x in range(count)]
    ((_, _, line, _, _, shown),) = drawn(Series("a", curve))["lines"]
    assert (len(shown), len(line.split())) == (dots, ends)


@pytest.mark.parametrize(("audit", "motions", "text"), [
    (None, None, "evaluator not audited"), ("a.html", None, "audit of the evaluator: a.html"),
    ("a.html", 40, "audit of the evaluator: a.html, of 40 motions"),
])  # fmt: skip
def test_an_evaluation_in_a_report_names_its_audit_and_units(audit, motions, text):
    changes: dict[str, Any] = {"audit": audit, "audit_motions": motions}
    value = {"mean": 2.0, "ci": 0.5, "replications": 2, "n": 64, "unit": "m"}
    values = {
        "values": {"drift": value},
        "ground_truth": {"drift": value | {"mean": 1.0}, "x": value},
    }
    extractor = {"extractor": {"sha256": "0123456789"}}
    shown = check_shape(result(**changes, **values, **extractor), Result)
    title, facts, _, _, rows = _evaluation(shown)
    assert title == "p version 3, synthetic test, extractor 01234567"
    assert str(facts).endswith(f"; {text}")
    assert rows == [["drift (m)", "1 ± 0.5", "2 ± 0.5"], ["x (m)", "2 ± 0.5", "–"]]


def test_samples_of_a_report_are_named_by_their_own_step_and_faulty_batches_by_their_process(
    tmp_path,
):
    folder = a_run(tmp_path / "run")
    motions(folder / "samples" / "step_0001200")
    batches = [{"rank": 3, "batch": 7, "ids": ["a", "b"], "loss": "inf"}]
    content = {"step": 8, "usual_loss": "0.5", "batches": batches}
    (folder / "bad_batch.json").write_text(json.dumps(content))
    text = write_report(folder).read_text()
    assert "<h2>Samples at step 1,200</h2>" in text
    row = ("process 3, batch 7", "inf", "a, b")
    assert "".join(f"<td>{cell}</td>" for cell in row) in text


def test_real_motions_are_drawn_beside_the_family_that_has_them(tmp_path):
    folder = a_run(tmp_path / "run")
    (folder / "metrics.jsonl").write_text(
        '{"step": 1, "a/fid": 1.0, "b/fid": 2.0, "b/fid/real": 0.25, "b/fid/ci": 0.5}\n'
        '{"step": 5, "a/fid": 1.5, "b/fid": 2.5, "b/fid/real": 0.25, "b/fid/ci": 0.5}\n'
    )
    drawing = str(_chart(read_run(folder), "fid", ["a", "b"]))
    words = re.sub("<[^>]*>", " ", drawing.partition('class="key"')[2]).split()
    assert " ".join(words[1:]) == "a 1.5 b 2.5 real motions 0.25"
    assert re.findall(r'<polygon class="(c\d)"', drawing) == ["c1"]  # the band of b


@pytest.mark.parametrize(("commit", "changed", "text"), [
    ("abc", None, "abc"), ("abc", "f00d", "abc with uncommitted changes"), (None, None, "not from a clone"),
])  # fmt: skip
def test_provenance_names_the_commit_and_whether_it_was_changed(commit, changed, text):
    content = {
        "command": ["train", "x=1"], "commit": commit, "changed": changed, "python": "3.12", "machine": "m",
        "packages": {"torch": "2", "numpy": "1"}, "device": "cpu", "parameters": None,
        "data": {"fingerprint": "f00d", "dataset": "kit", "actions": ["walk"]},
    }  # fmt: skip
    rows = dict(_provenance(check_shape(content, Provenance)))
    assert rows["commit"] == text
    assert (rows["command"], rows["machine"]) == ("train x=1", "m, Python 3.12")
    assert rows["packages"] == "torch 2, numpy 1"
    assert "fingerprint f00d" in rows["data"]
    assert "walk" not in rows["data"]


def test_a_chart_lists_the_last_finite_values_and_begins_at_step_0():
    nan = float("nan")
    curve = {30: float("-inf"), 20: 0.5, 10: 2.0, 25: nan, 40: -1e301}
    drawing = str(chart("x", {"a": curve, "b": {5: 1.0}, "none": {3: nan}}))
    words = re.sub("<[^>]*>", " ", drawing.partition('class="key"')[2]).split()
    assert " ".join(words[1:]) == "a 0.5 b 1 none –"
    (first, second), width = points(drawing), 460 - 58 - 10
    # Half of the axis, which ends at the last drawn step
    assert (first[0], second[0]) == pytest.approx((58 + width / 2, 58 + width), abs=0.1)
    assert first[1] < second[1]


def test_bands_of_all_curves_and_all_levels_are_within_the_axes():
    series = [
        Series("a", [(0.0, 1.0), (1.0, 2.0)]),
        Series("b", [(0.0, 1.0), (1.0, 2.0)], {1.0: 50.0}),
    ]
    panel = drawn(*series, levels=[30.0, 70.0], x="steps")
    (*_, rim, _, _) = panel["lines"][1]
    heights = [float(pair.split(",")[1]) for pair in rim.split()]
    spans = [float(y) for y in panel["levels"]]
    assert len(spans) == 2
    assert spans[0] > heights[0] > spans[1]  # 30 is lower than 52, and 70 is higher
    assert max(heights) - min(heights) == pytest.approx(100 * (spans[0] - spans[1]) / 40, abs=0.3)


@pytest.mark.parametrize(("x", "legend", "high", "first"), [
    ("steps", True, 278, 246), ("", True, 262, 230), ("steps", False, 246, None), ("", False, 230, None),
])  # fmt: skip
def test_a_drawing_has_room_for_its_labels(x: str, legend: bool, high: int, first: int | None):
    panel = drawn(Series("a", [(0.0, 1.0)]), Series("b", [(1.0, 1.0)]), x=x, legend=legend)
    assert panel["high"] == high
    rows = [y for _, y, _ in panel["legend"]]
    assert rows == ([] if first is None else [first, first + 16])


def test_axes_of_four_decades_have_powers_of_ten_alone():
    assert _log_axis(1.0, 100.0).ticks == [1, 2, 5, 10, 20, 50, 100]
    assert _log_axis(1.0, 1000.0).ticks == [1, 10, 100, 1000]
    assert _log_axis(0.0, 1.0).low > 0


def test_more_than_eight_curves_repeat_the_colors_and_two_panels_stand_side_by_side():
    many = [Series(str(number), [(0.0, float(number))]) for number in range(10)]
    assert [color for color, *_ in drawn(*many)["lines"]] == [*range(8), 0, 1]
    drawing = str(svg("t", [Panel(many[:1]), Panel(many[:1]), Panel([])]))
    assert 'width="1380"' in drawing
    assert re.findall(r'transform="(translate\([^"]*)"', drawing) == ["translate(460,0)"]
    assert svg("t", [Panel([])]) is None
