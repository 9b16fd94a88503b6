"""Tables: from results alone, the same bytes each time, and no comparison of what cannot be compared."""

import csv
import hashlib
import io
import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.fixtures import recipe
from support.pages import result

import evaluators.evaluation
import flame_mdm
from evaluators.evaluation_request import EvaluationRequest
from evaluators.sources import SampleFolder
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import FORMAT, FORMAT_KEY, weights_sha256
from flame_mdm.commands import tables as tables_command
from flame_mdm.commands.tables import (
    TablesSettings,
    count_lengths,
    outdated,
    shows_multimodality,
)
from flame_mdm.config import compose, compose_data
from flame_mdm.data.store import Store
from flame_mdm.errors import UserError
from flame_mdm.records import Result
from flame_mdm.reporting.tables import build as builder
from flame_mdm.reporting.tables import format as format_module
from flame_mdm.reporting.tables import settings
from flame_mdm.reporting.tables.build import build
from flame_mdm.reporting.tables.format import (
    Cell,
    Line,
    Part,
    Table,
    _series,
    comma_separated,
    draw,
    ranks,
    rendered,
    write,
)
from flame_mdm.reporting.tables.specs import (
    Evaluation,
    Figure,
    evaluations,
    load_spec,
    spec_names,
)
from flame_mdm.representations.humanml import HumanML
from flame_mdm.safe_io import write_json
from flame_mdm.schemas import check_shape
from flame_mdm.training.start import recipe_changes

SPEC = """
title: "A table, 50 % & more_of_it"
notes: ["A note."]
parts:
  Text-to-motion:
    protocol: synthetic
    extractor: {folder}/clip.ckpt
    columns: {{FID: {{value: fid, better: lower}}, "R precision (top 3)": {{value: texts_for_motion/top3,
      better: higher}}, Diversity: {{value: diversity, better: real}}, NFE: {{value: nfe, better: lower}}}}
    rows:
      - {{label: MDM, ckpt: {folder}/mdm.ckpt}}
      - {{label: MFM, ckpt: {folder}/mfm.ckpt}}
      - {{label: FLAME <b>, ckpt: {folder}/flame.ckpt}}
      - {{label: missing, ckpt: {folder}/missing.ckpt}}
  Steps:
    protocol: synthetic
    extractor: {folder}/clip.ckpt
    columns: {{Steps: {{value: num_inference_steps}}, FID: {{value: fid, better: lower}}}}
    rows:
      - {{label: MDM, ckpt: {folder}/mdm.ckpt, num_inference_steps: [5, 10], guidance_scale: [1.0, 2.5]}}
figures:
  - {{part: Steps, x: num_inference_steps, y: FID, log: true}}
  - {{part: Steps, x: guidance_scale, y: [FID]}}
"""


REAL = (0.002, 0.797, 9.503)


def entry(mean: float) -> dict[str, Any]:
    return {"mean": mean, "ci": 0.0123, "replications": 5, "n": 400}


def measured(fid: float, top3: float, diversity: float, **other: Any) -> dict[str, Any]:
    """A result with these values of generated motions."""
    names = ("fid", "texts_for_motion/top3", "diversity")
    values, real = (
        dict(zip(names, map(entry, means), strict=True)) for means in ((fid, top3, diversity), REAL)
    )
    checkpoint = {
        "path": "mdm.ckpt",
        "sha256": "c" * 64,
        "experiment": "synthetic/mdm",
        "selected_by": "none: last",
    }
    checkpoint |= {
        "averaged_weights": True,
        "guidance_scale": 2.5,
        "sampler": "ddpm",
        "num_inference_steps": 50,
    }
    checkpoint["parameters"] = 12_345_678
    data = {"dataset": "synthetic", "fingerprint": "f" * 16}
    shared = {
        "protocol": {"name": "synthetic", "version": 1},
        "extractor": {"sha256": "e" * 64},
        "data": data,
    }
    shared |= {
        "cost": {"nfe": 50.0, "seconds_per_sample": 0.11, "batch_size": 64.0},
        "checkpoint": checkpoint,
    }
    return result(values=values, ground_truth=real, **shared | other)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "spec.yaml").write_text(SPEC.format(folder=tmp_path))
    for name in ("clip", "mdm", "mfm", "flame"):
        (tmp_path / f"{name}.ckpt").write_bytes(b"")
    results = {"MDM": measured(0.544, 0.611, 9.559), "MFM": measured(0.410, 0.7, 9.4)}
    results["FLAME <b>"] = measured(0.6, 0.650, 9.5)
    parts = load_spec(str(tmp_path / "spec.yaml"))["parts"]
    for row, needed in evaluations(parts["Text-to-motion"]):
        if row["label"] in results:
            put(needed[0], tmp_path, results[row["label"]])
    for row, needed in evaluations(parts["Steps"]):
        fid = 1 / row["num_inference_steps"] + row["guidance_scale"] / 10
        checkpoint = results["MDM"]["checkpoint"] | {
            n: row[n] for n in ("num_inference_steps", "guidance_scale")
        }
        put(needed[0], tmp_path, measured(fid, 0.6, 9.0, checkpoint=checkpoint))
    return tmp_path


def put(request: Evaluation, folder: Path, content: dict) -> Path:
    path = request.path(folder / "results")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def request_of(folder: Path, label: str) -> Evaluation:
    part = load_spec(str(folder / "spec.yaml"))["parts"]["Text-to-motion"]
    return next(needed[0] for row, needed in evaluations(part) if row["label"] == label)


def change(folder: Path, label: str, **changes: Any) -> None:
    """Changes keys of a row's result; keys of a mapping are added to the mapping."""
    path = request_of(folder, label).path(folder / "results")
    content = json.loads(path.read_text())
    for key, value in changes.items():
        content[key] = content[key] | value if isinstance(value, dict) and key in content else value
    path.write_text(json.dumps(content))


def made(folder: Path) -> Table:
    return build("spec", load_spec(str(folder / "spec.yaml")), folder / "results")


def rows(folder: Path, part: int = 0) -> dict[str, Line]:
    return {f"{line.kind}: {line.label}": line for line in made(folder).parts[part].lines}


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def command(folder: Path, out: Path) -> int:
    words = [
        f"table={folder / 'spec.yaml'}",
        "evaluate=false",
        f"results={folder / 'results'}",
        f"out={out}",
    ]
    return main(["tables", *words])


def test_the_same_results_give_the_same_bytes(folder, capsys):
    assert command(folder, folder / "a") == command(folder, folder / "b") == 0
    assert files(folder / "a") == files(folder / "b")
    names = {
        "spec.md",
        "spec.tex",
        "spec.csv",
        "spec.html",
        "spec-steps-figure1.svg",
        "spec-steps-figure2.svg",
    }
    assert names == files(folder / "a").keys()
    assert "![Steps](spec-steps-figure1.svg)" in (folder / "a" / "spec.md").read_text()
    # The four rows of the sweep count, too.
    assert "spec: 7 of 8 rows measured" in capsys.readouterr().out


def test_cells_ranks_and_real_motions(folder):
    lines = rows(folder)
    real = [c.text if c else None for c in lines["real: Real motions"].cells]
    assert real == ["0.002 ±0.012", "0.797 ±0.012", "9.503 ±0.012", None]
    ranks_of = {name: [c.rank if c else None for c in line.cells] for name, line in lines.items()}
    # 9.559 differs by 0.056 from real motions, 9.5 only by 0.003.
    assert ranks_of["measured: MDM"] == [
        2,
        0,
        2,
        1,
    ]
    assert ranks_of["measured: MFM"] == [1, 1, 0, 1]
    assert ranks_of["measured: FLAME <b>"] == [0, 2, 1, 1]
    assert lines["measured: missing"].state == "no checkpoint"
    assert "missing: " in rendered(made(folder), "md")
    sources = lines["measured: MDM"].facts
    assert (sources["checkpoint sha256"], sources["guidance"], sources["steps"]) == (
        "c" * 16,
        "2.5",
        "50",
    )


def test_a_row_with_results_of_several_evaluations_names_those_that_exist(folder):
    path = put(request_of(folder, "MFM"), folder, measured(0.41, 0.7, 9.4, seed=3))
    read = builder.read_result(path)
    row = {"label": "MFM", "num_inference_steps": 7, "guidance_scale": "none"}
    values = ["fid", "diversity", "nfe", "num_inference_steps"]
    line = builder._line(row, [None, read, read, None], values, ["a", "b", "b", "c"])
    assert [cell and cell.value for cell in line.cells] == [None, 9.4, 50, 7]
    assert (line.facts["result"], line.facts["seed"], line.state) == ("b", "3", "")
    assert line.options["num_inference_steps"] == 7  # the row's, not the 50 of the checkpoint
    assert line.options["guidance_scale"] == 2.5
    assert line.options["nfe"] == 50
    nothing = builder._line(row, [None] * 4, values, ["a", "b", "b", "c"])
    assert [cell and cell.value for cell in nothing.cells] == [None, None, None, 7]
    assert (nothing.facts, nothing.options) == ({}, {"num_inference_steps": 7})


def test_a_baseline_is_shown_but_not_ranked(folder):
    change(folder, "MFM", baseline="noisy", checkpoint=None)
    lines = rows(folder)
    mdm, mfm = lines["measured: MDM"], lines["measured: MFM"]
    assert mfm.marks == mdm.marks
    assert not any(cell and cell.rank for cell in mfm.cells)
    assert mdm.cells[0] is not None
    assert mdm.cells[0].rank == 1, "the baseline has a lower FID"


def test_rows_of_another_evaluator_are_marked_and_not_compared(folder, subtests):
    for changes in (
        {"extractor": {"sha256": "d" * 64}},
        {"protocol": {"name": "synthetic", "version": 2}},
        {"changed": {"samples": 64}},
        {"split": "val"},
        {"data": {"dataset": "synthetic", "fingerprint": "0" * 16}},
        {"seed": 1},
        {"quick": True},
    ):
        with subtests.test(changes=changes):
            put(request_of(folder, "MFM"), folder, measured(0.410, 0.7, 9.4) | changes)
            part = made(folder).parts[0]
            lines = {line.label: line for line in part.lines if line.kind == "measured"}
            assert lines["MDM"].marks == lines["FLAME <b>"].marks == "a", changes
            assert lines["MFM"].marks == "b", changes
            assert all(cell is None or cell.rank == 0 for cell in lines["MFM"].cells), changes
            assert [cell.rank for cell in lines["MDM"].cells if cell] == [1, 2, 2, 1], changes
            assert [line.marks for line in part.lines if line.kind == "real"] == ["a", "b"], changes


def test_a_recipe_changed_in_place_is_not_ranked_beside_the_recipe(folder):
    checkpoint = measured(0, 0, 0)["checkpoint"] | {
        "recipe_changes": ["denoiser._target_=my_package.MyDenoiser"]
    }
    put(request_of(folder, "MFM"), folder, measured(0.410, 0.7, 9.4, checkpoint=checkpoint))
    part = made(folder).parts[0]
    lines = {line.label: line for line in part.lines if line.kind == "measured"}
    assert [lines[name].marks for name in ("MDM", "MFM", "FLAME <b>")] == ["a", "b", "a"]
    assert all(cell is None or cell.rank == 0 for cell in lines["MFM"].cells)
    changes = (
        "The model differs from the recipe synthetic/mdm: denoiser._target_=my_package.MyDenoiser."
    )
    assert ("b", f"Same as footnote a, except for the following: {changes}") in part.notes


def test_changes_of_a_recipe_are_found_in_the_configuration_of_a_model(subtests):
    for same in (
        [],
        ["seed=3", "run.name=mine", "data_root=/x", "trainer.max_steps=5", "selection=loss"],
    ):
        with subtests.test(same=same):
            assert recipe_changes(compose("quickstart", same)) == [], same
    config = compose("quickstart", ["denoiser=mdm_unet", "optimizer.lr=0.1", "+process.min_snr=5"])
    network = "denoiser._target_=flame_mdm.denoisers.unet.MDMUNet"
    assert recipe_changes(config) == [network, "optimizer.lr=0.1", "process.min_snr=5"]
    denoiser = compose("quickstart")["denoiser"] | {"_target_": "mine.Denoiser", "width": 7}
    config = compose("quickstart", ["+denoiser_width=3"]) | {"denoiser": denoiser}
    assert recipe_changes(config) == ["denoiser._target_=mine.Denoiser", "denoiser_width=3"]
    assert (
        recipe_changes({"experiment": "mine"}) == recipe_changes({"experiment": "quickstart"}) == []
    )


def test_footnotes_tell_what_was_left_out_the_skeleton_and_how_checkpoints_were_chosen(
    folder, subtests
):
    left_out = {"motions of HumanAct12, as data.source.humanact12 is not given": 1191}
    for label in ("MDM", "MFM", "FLAME <b>"):
        change(
            folder,
            label,
            ground_truth={"fid": {"mean": 0.0, "ci": 0.0, "replications": 5, "n": 400}},
        )
    change(folder, "MFM", checkpoint={"selected_by": "best val/text_to_motion_t2m/fid"})
    notes = [note for _, note in made(folder).parts[0].notes]
    assert "MFM: best checkpoint by val/text_to_motion_t2m/fid" in notes
    assert "MDM, FLAME <b>: last checkpoint, not chosen by validation" in notes
    assert "FID of real motions is 0 by construction: clips are used whole" in rendered(
        made(folder), "md"
    )
    sampled = {"sampler": "ddim", "eta": 0.5, "num_inference_steps": [0, 5, 9]}
    change(
        folder,
        "MDM",
        data={"excluded": left_out},
        changed={"samples": 4, "seed": 2},
        checkpoint=sampled,
    )
    text = rendered(made(folder), "md")
    assert "Options that differ from the protocol: samples = 4, seed = 2." in text
    assert "sampler = ddim, eta 0.5; steps = 0, 5, 9" in text
    words = "Excluded from the data set: 1,191 motions of HumanAct12, as data.source.humanact12 is not given."
    assert [words in note for _, note in made(folder).parts[0].notes].count(True) == 1
    lengths = {"fingerprint": "f" * 16, "fps": 20.0, "lengths": [50, 60], "excluded": left_out}
    (folder / "results" / "lengths").mkdir()
    (folder / "results" / "lengths" / "mine.json").write_text(json.dumps(lengths))
    table = build(
        "x", {"title": "Lengths", "parts": {"All": {"lengths": ["mine"]}}}, folder / "results"
    )
    assert table.parts[0].notes[1] == ("", f"mine: {words}")
    for skeleton, note in (
        (
            {"stand_in": True, "smpl_sha256": None},
            "Joints have the bones of a stand-in skeleton, not SMPL's bones.",
        ),
        (
            {"stand_in": False, "smpl_sha256": "5" * 64},
            "Joints have the bones of SMPL's model file, sha256 555555555555.",
        ),
        ({"stand_in": False, "smpl_sha256": None}, ""),
    ):
        with subtests.test(note=note):
            change(folder, "MDM", skeleton=skeleton)
            notes = [text for _, text in made(folder).parts[0].notes if "Joints have" in text]
            assert [note in text for text in notes] == [True] * bool(note)


def test_a_missing_extractor_is_noted_beside_a_missing_checkpoint(folder):
    text = (folder / "spec.yaml").read_text().replace(f"{folder}/clip.ckpt", "assets/t2m/kit")
    (folder / "spec.yaml").write_text(
        text.replace(f"{folder}/missing", "runs/synthetic/mdm/default/checkpoints/last")
    )
    part = made(folder).parts[0]
    notes = [note for mark, note in part.notes if not mark]
    assert next(line.state for line in part.lines if line.label == "missing") == "no checkpoint"
    assert "missing: make train EXP=synthetic/mdm" in notes
    note = 'MDM, MFM, FLAME <b>, missing: assets/t2m/kit is missing; see "Extractors" in docs/evaluation.md'
    assert note in notes, "one line for all rows"


def test_footnotes_list_what_differs_and_group_rows(folder):
    for number, (_, needed) in enumerate(
        evaluations(load_spec(str(folder / "spec.yaml"))["parts"]["Steps"])
    ):
        path = needed[0].path(folder / "results")
        reasons = {"invalid_because": ["real motions have fid 3, expected 0.002 +- 0.02"]}
        path.write_text(json.dumps(json.loads(path.read_text()) | reasons | {"seed": number // 2}))
    table = made(folder)
    notes = table.parts[1].notes
    conditions = "Protocol synthetic, version 1. Data: test split of synthetic (fingerprint ffffffffffffffff). "
    conditions += (
        "5 replications with N = 400 motions. Seed 0. Extractor sha256 eeeeeeeeeeee. Not audited."
    )
    assert [note for note in notes if note[0]] == [
        ("a", conditions),
        ("b", "Same as footnote a, except for the following: Seed 1."),
    ]
    labels = "MDM (guidance scale 1.0), MDM (guidance scale 2.5)"
    assert ("", f"{labels}: NOT VALID: real motions have fid 3, expected 0.002 +- 0.02") in notes
    assert sum("NOT VALID" in note for _, note in notes) == 1
    (line,) = [line for line in rendered(table, "md").splitlines() if line.startswith("- Steps: ")]
    assert "steps = 5 / 5 / 10 / 10" in line
    assert line.count("recipe = synthetic/mdm") == 1


def test_a_row_that_is_not_valid_is_reported_by_the_exit_code(folder, capsys):
    assert command(folder, folder / "a") == 0
    assert "NOT VALID" not in capsys.readouterr().err
    reason = "training data of the extractor 1 and evaluated data 2 differ: splits may overlap"
    change(folder, "MFM", invalid_because=[reason])
    assert command(folder, folder / "a") == 3
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "NOT VALID" in line]
    assert line == f"NOT VALID: spec, Text-to-motion, MFM: {reason}"
    text = (folder / "a" / "spec.md").read_text().splitlines()
    (row,) = [line for line in text if line.startswith("| MFM")]
    assert "(NOT VALID)" in row
    assert "**" not in row, "not ranked"
    assert "**" in next(line for line in text if line.startswith("| MDM"))


TIMED = """
title: Time
parts:
  all:
    protocol: latency
    columns: {{Batch: {{value: batch_size}}, Seconds: {{value: seconds_per_sample, better: lower}},
      Predicts: {{value: prediction}}, Hours: {{value: training_hours}}, Memory: {{value: training_memory_gib}}}}
    rows:
      - {{label: MDM, ckpt: {folder}/mdm.ckpt, batch_size: [1, 64]}}
      - {{label: MFM, ckpt: {folder}/mfm.ckpt}}
figures:
  - {{part: all, x: batch_size, y: Seconds}}
"""


def test_times_are_compared_in_batches_of_the_same_size_alone(folder, subtests):
    (folder / "timed.yaml").write_text(TIMED.format(folder=folder))
    spec = load_spec(str(folder / "timed.yaml"))
    for row, needed in evaluations(spec["parts"]["all"]):
        with subtests.test(row=row["label"]):
            size = row.get("batch_size", 1)
            content = measured(
                0,
                0,
                0,
                cost={"nfe": 10.0, "seconds_per_sample": 1 / size, "batch_size": float(size)},
            )
            trained = {
                "prediction": "velocity",
                "training_hours": 12.25,
                "training_memory_gib": 7.5,
            }
            content["checkpoint"] |= trained if row["label"] == "MFM" else {}
            put(needed[0], folder, content)
            assert needed[0].keys.get("batch_size") == row.get("batch_size")
    (part,) = build("timed", spec, folder / "results").parts
    lines = [line for line in part.lines if line.kind == "measured"]
    texts = [[cell and cell.text for cell in line.cells] for line in lines]
    unknown = [None, None, None]  # of a checkpoint without these facts
    assert texts == [
        ["1", "1.000", *unknown],
        ["64", "0.016", *unknown],
        ["1", "1.000", "velocity", "12.2", "7.5"],
    ]
    assert [line.marks for line in lines] == ["a", "b", "a"]
    assert "Same as footnote a, except for the following: Timed in batches of 64 on cpu." in [
        note for _, note in part.notes
    ]
    assert [cell.rank for line in lines if (cell := line.cells[1])] == [1, 0, 1]
    assert "predicts = – / – / velocity" in rendered(Table("timed", "", [part]), "md")


def test_what_is_missing_or_changed_is_evaluated_once_and_timed_rows_have_their_own_batch_size(
    folder, monkeypatch
):
    (folder / "timed.yaml").write_text(TIMED.format(folder=folder))
    needed = []

    def evaluate(request: EvaluationRequest) -> None:
        needed.append(request)
        content = measured(0, 0, 0)
        content["checkpoint"]["sha256"] = hashlib.sha256(
            Path(str(request.ckpt)).read_bytes()
        ).hexdigest()
        write_json(str(request.out), content)

    monkeypatch.setattr(evaluators.evaluation, "evaluate", evaluate)
    words = [f"results={folder / 'none'}", f"out={folder / 'out'}", "batch_size=256"]
    for number in range(3):
        assert main(["tables", f"table={folder / 'timed.yaml'}", *words]) == 0
        assert len(needed) == (3, 3, 4)[number]
        if number == 1:
            (folder / "mfm.ckpt").write_bytes(b"trained again")
    assert [request.batch_size for request in needed] == [1, 64, None, None]
    assert needed[-1].ckpt == f"{folder}/mfm.ckpt"
    needed.clear()
    assert main(["tables", f"table={folder / 'spec.yaml'}", *words]) == 0
    assert {(request.batch_size, request.extractor) for request in needed} == {
        (256, f"{folder}/clip.ckpt")
    }
    assert [request.options.num_inference_steps for request in needed[3:]] == [5, 5, 10, 10]


MINE = """
title: mine
parts:
  all:
    protocol: synthetic
    extractor: none
    replications: 1
    samples: 4
    columns: {{Action: {{value: attributes/action, better: higher}}, FID: {{value: fid}}}}
    rows:
      - {{label: tiny, ckpt: {ckpt}, sampler: ddim, eta: 0.5, num_inference_steps: [2, [0, 5, 9]]}}
      - {{label: elsewhere, ckpt: runs/synthetic/mdm/default/checkpoints/last.ckpt}}
"""


@pytest.mark.slow
def test_rows_are_measured_from_their_checkpoint(trained, data_root, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.yaml").write_text(MINE.format(ckpt=trained))
    words = ["table=mine.yaml", "device=cpu", f"data_root={data_root}"]
    assert main(["tables", *words]) == 0
    shown = capsys.readouterr().out
    assert "evaluating 1 of 2: tiny" in shown
    assert "mine: 2 of 3 rows measured" in shown
    first = files(Path("runs/tables"))
    assert b"elsewhere: make train EXP=synthetic/mdm" in first["mine.md"]
    assert b"ddim, eta 0.5" in first["mine.html"]
    assert (
        b"Options that differ from the protocol: replications = 1, samples = 4." in first["mine.md"]
    )
    assert main(["tables", *words]) == 0
    assert "evaluating" not in capsys.readouterr().out
    assert files(Path("runs/tables")) == first


def test_published_numbers_are_marked_and_ranked_among_themselves(folder, monkeypatch, subtests):
    published = folder / "published.yaml"
    printed = [
        {
            "label": "Real",
            "real": True,
            "values": {"FID": "0.002 ±.000", "Diversity": "9.503 ±.065"},
        },
        {"label": "T2M", "values": {"FID": "1.067 ±.002", "NFE": "1,000"}},
        {"label": "MDM", "values": {"FID": "0.544 ±.044"}},
        {"label": "MDM, corrected", "source": "elsewhere", "values": {"FID": "0.489"}},
    ]
    part = {
        "evaluator": "an evaluator of theirs",
        "source": "Someone, table 1",
        "notes": ["They print percent."],
    }
    published.write_text(json.dumps({"spec": {"Text-to-motion": part | {"rows": printed}}}))
    monkeypatch.setattr(builder, "PUBLISHED", published)
    lines = rows(folder)
    real, best = lines["reported real: Real"].cells[0], lines["measured: MFM"].cells[0]
    assert real is not None
    assert best is not None
    assert (real.text, best.rank) == ("0.002 ±.000", 1)
    reported = [lines[f"reported: {name}"] for name in ("T2M", "MDM", "MDM, corrected")]
    assert [line.marks for line in reported] == ["†", "†", "††"]
    assert [line.cells[0].rank for line in reported if line.cells[0]] == [2, 1, 0]
    assert reported[0].options == {"nfe": 1000.0}
    text = rendered(made(folder), "md")
    assert "†: Reported in Someone, table 1. Measured with an evaluator of theirs." in text
    assert "They print percent." in text
    for wrong, message in (
        (
            "Text-to-motion: {evaluator: e, source: s, rows: [{label: x, values: {FDI: 1}}]}",
            "unknown column FDI",
        ),
        ("Txt: {evaluator: e, source: s, rows: []}", "parts that are not in its spec: Txt"),
    ):
        with subtests.test(wrong=wrong, message=message):
            published.write_text(f"spec: {{{wrong}}}")
            with pytest.raises(UserError, match=message):
                made(folder)


@pytest.mark.usefixtures("composed_once")
def test_an_index_lists_the_tables_with_their_measured_rows(tmp_path, capsys):
    needed = [
        "table=flame_9 flame_10",
        "evaluate=false",
        f"results={tmp_path / 'none'}",
        f"out={tmp_path}",
    ]
    assert main(["tables", *needed]) == 0
    assert f"all tables: {tmp_path / 'index.html'}" in capsys.readouterr().out
    text = (tmp_path / "index.html").read_text()
    title = "FLAME, table 10: guidance scale, on HumanML3D"
    row = f'<td><a href="flame_10.html">flame_10</a></td><td>{title}</td><td class="number">0 of 6</td>'
    assert text.index("FLAME, table 9: sampling steps of DDPM and DDIM") < text.index(row)
    names = spec_names()
    assert names.index("flame_9") + 1 == names.index("flame_10")


def ranks_of_diversity(
    folder: Path, monkeypatch: pytest.MonkeyPatch, printed: list[dict[str, Any]]
) -> dict[str, int]:
    """Returns the ranks of the reported rows in the column Diversity, with these published rows."""
    published = folder / "published.yaml"
    part = {"evaluator": "an evaluator", "source": "a paper", "rows": printed}
    published.write_text(json.dumps({"spec": {"Text-to-motion": part}}))
    monkeypatch.setattr(builder, "PUBLISHED", published)
    index = 2  # of the column Diversity
    ranked = {
        line.label: cell.rank
        for line in rows(folder).values()
        if line.kind == "reported" and (cell := line.cells[index])
    }
    return ranked


def test_a_corrected_table_is_ranked_by_its_own_real_row_and_names_its_own_evaluator(
    folder, monkeypatch
):
    theirs = {"source": "their repository", "evaluator": "a corrected evaluator"}
    printed = [
        {"label": "Real", "real": True, "values": {"Diversity": "9.5"}},
        {"label": "near", "values": {"Diversity": "9.4"}},
        {"label": "far", "values": {"Diversity": "8.1"}},
        {"label": "Real, corrected", "real": True, "values": {"Diversity": "8.0"}, **theirs},
        {"label": "near, corrected", "values": {"Diversity": "8.1"}, **theirs},
        {"label": "far, corrected", "values": {"Diversity": "9.4"}, **theirs},
    ]
    ranked = ranks_of_diversity(folder, monkeypatch, printed)
    assert ranked == {"near": 1, "far": 2, "near, corrected": 1, "far, corrected": 2}
    text = rendered(made(folder), "md")
    assert "†: Reported in a paper. Measured with an evaluator." in text
    assert "††: Reported in their repository. Measured with a corrected evaluator." in text


def test_rows_of_a_source_without_real_motions_are_ranked_by_the_real_row_of_another_source(
    folder, monkeypatch
):
    theirs = {"source": "their repository", "evaluator": "the same evaluator"}
    printed = [
        {"label": "Real", "real": True, "values": {"Diversity": "9.5"}},
        {"label": "near", "values": {"Diversity": "9.4"}, **theirs},
        {"label": "far", "values": {"Diversity": "12.1"}, **theirs},
    ]
    ranked = ranks_of_diversity(folder, monkeypatch, printed)
    assert ranked == {"near": 1, "far": 2}


def test_a_legend_names_the_rows_that_are_not_ranked(folder, subtests):
    legend = "of the rows with the same mark"
    table = made(folder)
    assert f"{legend}." in rendered(table, "html")
    table.parts[0].lines[1].facts["baseline"] = "real"
    for suffix in ("md", "html", "tex"):
        with subtests.test(suffix=suffix):
            assert f"{legend}, except sanity-check baselines." in rendered(table, suffix), suffix
    table.parts[0].lines[2].state = "QUICK"
    both = f"{legend}, except sanity-check baselines and rows that are quick or not valid."
    assert both in rendered(table, "md")


def test_notes_of_a_latex_table_are_in_its_threeparttable(folder):
    text = rendered(made(folder), "tex")
    lines = text.splitlines()
    assert [line for line in lines if line.startswith("%")] == [
        r"% \usepackage{booktabs,threeparttable}"
    ]
    notes = text.split(r"\begin{tablenotes}")[1].split(r"\end{tablenotes}")[0]
    assert r"\item[] A note." in notes
    assert r"\item[] $\uparrow$ higher is better" in notes
    assert text.count(r"\begin{threeparttable}") == text.count(r"\end{tablenotes}") == 2


def test_footnotes_of_rows_with_several_protocols_name_their_columns(tmp_path):
    spec = load_spec("mfm_figure_4")
    for _, needed in evaluations(spec["parts"]["HumanML3D"]):
        for evaluation in needed:
            protocol = evaluation.keys["protocol"]
            write_json(evaluation.path(tmp_path), result(protocol={"name": protocol, "version": 1}))
    (part,) = build("mfm_figure_4", spec, tmp_path).parts
    notes = dict(note for note in part.notes if note[0])
    assert notes["a"].startswith(
        "NFE, FID, Training hours, Peak memory of training, GiB: Protocol text_to_motion_t2m"
    )
    assert notes["b"].startswith("Seconds per motion: ")
    assert [" Timed in batches of " in notes[letter] for letter in "ab"] == [False, True]
    assert notes["†"].endswith("as run by Hu et al. on an unnamed device.")
    assert notes["††"].endswith("as run by Chen et al. on one V100."), (
        "the value that Hu et al. quote"
    )


def test_multimodality_is_measured_for_tables_that_show_it_alone(folder):
    path, keys = folder / "result.json", {"protocol": "synthetic", "ckpt": f"{folder}/mdm.ckpt"}
    evaluation = Evaluation("MDM", keys)
    assert shows_multimodality(evaluation, {"fid", "multimodality"})
    assert not shows_multimodality(evaluation, {"fid", "diversity"})
    write_json(path, measured(0.5, 0.7, 9.0, changed={"multimodality": False}, checkpoint=None))
    (folder / "mdm.ckpt").unlink()
    assert not outdated(path, evaluation, {"fid"})
    assert outdated(path, evaluation, {"fid", "multimodality"}), (
        "was not measured for a table without it"
    )
    assert not outdated(
        path, Evaluation("MDM", keys | {"multimodality": False}), {"multimodality"}
    ), "as the spec says"

    change(folder, "MFM", changed={"multimodality": False})
    assert "Options that differ from the protocol" not in rendered(made(folder), "md"), (
        "no column shows it"
    )
    change(folder, "MFM", changed={"samples": 5})
    assert "Options that differ from the protocol: samples = 5." in rendered(made(folder), "md")


def test_ranks(subtests):
    for values, better, real, expected in (
        ([3.0, 1.0, None, 2.0], "lower", None, [0, 1, 0, 2]),
        ([3.0, 1.0, 2.0], "higher", None, [1, 0, 2]),
        ([3.0, 1.0, 2.0], "real", 1.9, [0, 2, 1]),
        ([3.0, 1.0], "real", None, [0, 0]),
        ([0.0, 3.0], "real", 2.0, [2, 1]),
        ([3.0, 3.0, 1.0], "higher", None, [1, 1, 2]),
        ([3.0], "higher", None, [0]),
        ([3.0, 4.0], "none", None, [0, 0]),
    ):
        with subtests.test(values=values, better=better, real=real, expected=expected):
            assert ranks(values, better, real) == expected, (values, better)


def test_numbers_have_the_decimals_of_their_column_and_are_never_all_zeros():
    lines = [Line("", "measured", [Cell("", value, 0.0021)]) for value in (103.6, 0.016, 0.0)]
    builder._print_cells(lines, 1)
    assert [cell.text for line in lines if (cell := line.cells[0])] == [
        "103.6 ±0.0",
        "0.016 ±0.002",
        "0.0 ±0.0",
    ]


PARTS = {part: {"_target_": "any.Class"} for part in ("task", "representation")}


def clip_file(folder: Path, weight: float, steps: int) -> str:
    """Writes an extractor and returns the sha256 of its weights."""
    content = {
        "config": {"experiment": "motion_clip/synthetic"} | PARTS,
        "facts": {"actions": [], "max_frames": 60},
    }
    content |= {
        "global_step": steps,
        FORMAT_KEY: FORMAT,
        "state_dict": {"w": torch.tensor([weight])},
    }
    torch.save(content, folder / "clip.ckpt")
    return weights_sha256(folder / "clip.ckpt")


def test_a_result_is_outdated_when_checkpoint_or_extractor_are_others_now(folder, subtests):
    request = request_of(folder, "MDM")
    content = json.loads(request.path(folder / "results").read_text())
    content["checkpoint"]["sha256"] = hashlib.sha256((folder / "mdm.ckpt").read_bytes()).hexdigest()
    content["extractor"]["sha256"] = clip_file(folder, 1.0, 600)
    path = put(request, folder, content)
    assert not outdated(path, request)
    clip_file(folder, 1.0, 700)
    assert not outdated(path, request), "the weights are the same"
    clip_file(folder, 2.0, 600)
    assert outdated(path, request)
    clip_file(folder, 1.0, 600)
    for stand_in in (True, False):
        with subtests.test(stand_in=stand_in):
            put(
                request, folder, content | {"skeleton": {"stand_in": stand_in, "smpl_sha256": None}}
            )
            assert not outdated(path, request)
            with pytest.MonkeyPatch.context() as patch:
                patch.setenv("FLAME_MDM_SMPL", "SMPL_NEUTRAL.pkl")
                assert outdated(path, request) == stand_in
    (folder / "mdm.ckpt").write_bytes(b"trained again")
    assert outdated(path, request)


def test_a_result_is_outdated_when_the_motion_files_are_others_now(tmp_path):
    (tmp_path / "theirs").mkdir()
    for number in range(2):
        np.savez(tmp_path / "theirs" / f"{number}.npz", ids=["a"])
    request = Evaluation(
        "theirs", {"from_samples": str(tmp_path / "theirs"), "protocol": "synthetic"}
    )
    sha256 = SampleFolder(tmp_path / "theirs", HumanML()).sha256
    path = put(request, tmp_path, measured(0, 0, 0, checkpoint=None, samples_sha256=sha256))
    assert not outdated(path, request)
    np.savez(tmp_path / "theirs" / "1.npz", ids=["b"])
    assert outdated(path, request)


ORIGINS: dict[str, dict[str, Any]] = {
    "checkpoint": {"checkpoint": {"sha256": "d" * 64}},
    "extractor": {"extractor": {"sha256": "d" * 64}},
    "data": {"data": {"fingerprint": "0" * 16}},
    "protocol": {"protocol": {"sha256": "d" * 64}},
    "split": {"split": "val"},
    "seed": {"seed": 1},
}


@pytest.mark.parametrize("name", ORIGINS)
def test_the_hash_of_a_row_changes_with_each_input_of_its_numbers(folder, name):
    before = rows(folder)["measured: MDM"].facts["computed from"]
    assert before == rows(folder)["measured: MDM"].facts["computed from"]
    change(folder, "MDM", **ORIGINS[name])
    assert rows(folder)["measured: MDM"].facts["computed from"] != before


SEVERAL = """
title: several
parts:
  all:
    protocol: synthetic
    extractor: none
    columns: {{FID: {{value: fid}}{more}}}
    rows:
      - {{label: MDM, ckpt: {folder}/mdm.ckpt}}
"""


def test_multimodality_is_computed_if_a_column_shows_it(folder, monkeypatch, subtests):
    requests = []

    def evaluate(request: EvaluationRequest) -> None:
        requests.append(request.multimodality)
        content = measured(
            0, 0, 0, changed={} if request.multimodality else {"multimodality": False}
        )
        content["checkpoint"]["sha256"] = hashlib.sha256(
            Path(str(request.ckpt)).read_bytes()
        ).hexdigest()
        content["extractor"] = None
        content["values"] |= {"multimodality": entry(1.0)} if request.multimodality else {}
        write_json(str(request.out), content)

    monkeypatch.setattr(evaluators.evaluation, "evaluate", evaluate)
    spec, more = folder / "several.yaml", ", Multimodality: {value: multimodality}"
    words = ["tables", f"table={spec}", f"results={folder / 'several'}", f"out={folder / 'out'}"]
    for text, expected in (
        ("", [False]),
        (more, [False, True]),
        (more, [False, True]),
        ("", [False, True]),
    ):
        with subtests.test(text=text, expected=expected):
            spec.write_text(SEVERAL.format(folder=folder, more=text))
            assert main(words) == 0
            assert requests == expected
    page = (folder / "out" / "several.md").read_text()
    assert "Options that differ from the protocol" not in page


def test_a_footnote_states_the_numbers_of_generated_and_of_real_motions(folder):
    content = measured(0.1, 0.5, 9)
    content["values"]["fid"] |= {"n": 64, "n_per_replication": [64] * 5, "n_real": 378}
    content["ground_truth"]["fid"]["n"] = 378
    put(request_of(folder, "MDM"), folder, content)
    notes = dict(made(folder).parts[0].notes)
    assert any(
        "5 replications with N = 64 motions (real motions: N = 378), compared with sets of 378 real motions"
        in text
        for text in notes.values()
    )
    origins = {line.facts["computed from"] for line in rows(folder).values() if line.facts}
    assert {len(origin) for origin in origins} == {16}


def test_figure_4_of_mdm_shows_the_ratings_of_a_user_study_beside_the_reported_ones(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    spec = load_spec("mdm_figure_4")
    missing, _ = build("mdm_figure_4", spec, tmp_path / "results").parts
    assert [line.kind for line in missing.lines] == ["reported"]
    assert "runs/ratings/mdm_kit.json is missing" in missing.notes[0][1]

    pair = {"a": "kit/mdm", "b": "kit_real", "wins_a": 4, "wins_b": 2, "raters": 2}
    (tmp_path / "runs" / "ratings").mkdir(parents=True)
    (tmp_path / "runs" / "ratings" / "mdm_kit.json").write_text(
        json.dumps({"format": 1, "pairs": [pair]})
    )
    table = build("mdm_figure_4", spec, tmp_path / "results")
    measured, reported = table.parts[0].lines
    assert [cell.text for cell in measured.cells if cell] == ["66.7% [30.0%, 90.3%]", "6", "2"]
    assert measured.label == "kit/mdm over kit_real"
    assert (reported.label, reported.cells[0] and reported.cells[0].text) == (
        "MDM over Real",
        "42.3%",
    )
    assert '<td class="number">66.7% [30.0%, 90.3%]</td>' in rendered(table, "html")


def test_lengths_of_a_data_set_are_counted_in_frames_and_hours(tmp_path):
    lengths = {"fingerprint": "f", "fps": 20.0, "lengths": [90, 40, 200, 41, 60]}
    (tmp_path / "lengths").mkdir()
    (tmp_path / "lengths" / "mine.json").write_text(
        json.dumps(lengths | {"lengths": lengths["lengths"] * 1000})
    )
    spec = {"title": "Lengths", "parts": {"All": {"lengths": ["mine", "absent"]}}}
    (part,) = build("x", spec, tmp_path).parts
    mine, absent = part.lines
    texts = dict(zip(part.columns, [cell and cell.text for cell in mine.cells], strict=True))
    assert texts == {
        "motions": "5,000",
        "hours": "5.99",
        "shortest": "40",
        "median": "60",
        "mean": "86.2",
        "longest": "200",
    }
    assert (absent.state, absent.cells) == ("not prepared", [None] * 6)
    histogram = part.histograms["mine"]
    assert (histogram.step, len(histogram.counts), sum(histogram.counts)) == (5, 41, 5000)
    assert [histogram.counts[k] for k in (7, 8, 12, 18, 40)] == [0, 2000, 1000, 1000, 1000]


def test_lengths_of_a_prepared_data_set_are_written_as_results(tmp_path, monkeypatch, capsys):
    small = ["data.source.clips=12", f"data_root={tmp_path}"]
    monkeypatch.setattr(
        tables_command, "compose_data", lambda name, **keys: compose_data(name, small[:1], **keys)
    )
    settings = cast(TablesSettings, SimpleNamespace(data_root=str(tmp_path)))
    file = tmp_path / "results" / "lengths" / "synthetic.json"
    count_lengths("synthetic", tmp_path / "results", settings)
    assert "synthetic is not prepared, so its motion lengths are omitted" in capsys.readouterr().out
    assert not file.exists()
    assert main(["prepare", "synthetic", *small]) == 0
    count_lengths("synthetic", tmp_path / "results", settings)
    (folder,) = tmp_path.glob("synthetic-*/")
    store, written = Store(folder), json.loads(file.read_text())
    assert written["lengths"] == sorted(len(store.motion(clip)) for clip in store.clips)
    assert (written["fingerprint"], written["fps"]) == (store.fingerprint, 20.0)
    spec = {"title": "Lengths", "parts": {"All": {"lengths": ["synthetic"]}}}
    (line,) = build("x", spec, tmp_path / "results").parts[0].lines
    assert (line.state, line.cells[0] and line.cells[0].text) == ("", "12")


@pytest.mark.parametrize(("text", "number"), [
    ("0.544 ±.044", 0.544), ("1,000", 1000.0), ("-.5", -0.5), ("+2.5e-3 s", 0.0025), (" 7 ", 7.0), ("n/a", None),
    ("66.7% [30]", 66.7),
])  # fmt: skip
def test_a_printed_value_begins_with_its_number(text: str, number: float | None):
    assert builder._leading(text) == number


def test_csv_has_the_number_the_print_the_interval_and_the_place_of_each_cell():
    facts = {"seed": "3"}
    lines = [
        Line("a", "measured", [Cell("1.0", 1.04, 0.2, 1), None], "a", "QUICK", facts=facts),
        Line("=b", "reported", [None, Cell("-2", -2.0)]),
    ]
    table = Table("t", "T", [Part("P", {"X": "lower", "Y": "none"}, lines)])
    head, first, second = csv.reader(io.StringIO(comma_separated(table)))
    row = dict(zip(head, first, strict=True))
    assert row == {
        **{
            "part": "P",
            "row": "a",
            "kind": "measured",
            "state": "QUICK",
            "marks": "a",
            "seed": "3",
        },
        **{"X": "1.04", "X: printed": "1.0", "X: 95 % interval, half": "0.2", "X: place": "1"},
        **dict.fromkeys(("Y", "Y: printed", "Y: 95 % interval, half", "Y: place"), ""),
    }
    row = dict(zip(head, second, strict=True))
    assert (row["row"], row["Y"], row["Y: printed"], row["Y: place"]) == ("'=b", "-2.0", "-2", "")


def test_figures_draw_points_in_order_without_incomplete_rows():
    def line(label: str, x: float, y: float, kind: str = "measured", state: str = "") -> Line:
        return Line(label, kind, [Cell("", y, 0.1 if x == 5 else None)], "", state, {"eta": x})

    lines = [line("a", 5, 1), line("a", 2, 3), line("b", 1, 9, state="QUICK")]
    lines += [line("c", 4, 7, "reported"), line("Real", 0, 0.5, "real")]
    part = Part("P", {"FID": "real"}, lines)
    series, levels = _series(part, Figure(part="P", x="eta", y=["FID"]), "FID")
    assert [(s.name, list(s.points), dict(s.spread), s.kind) for s in series] == [
        ("a", [(2, 3), (5, 1)], {5: 0.1}, "line"),
        ("c, reported", [(4, 7)], {}, "dashed"),
    ]
    assert levels == [0.5]
    lower = Part("P", {"FID": "lower"}, lines)
    assert _series(lower, Figure(part="P", x="eta", y=["FID"]), "FID")[1] == []
    drawing = str(draw(part, Figure(part="P", x="eta", y=["FID"])))
    assert drawing.count('class="level"') == 1
    assert 'class="level"' not in str(draw(lower, Figure(part="P", x="eta", y=["FID"])))
    dots, _ = _series(part, Figure(part="P", x="eta", y=["FID"], points=True), "FID")
    assert [s.kind for s in dots] == ["dots", "dots"]


@pytest.mark.parametrize(("numbers", "texts"), [
    ([9.99, 0.5], ["9.990", "0.500"]), ([10.0, 3.25], ["10.0", "3.2"]), ([100.2, 3.26], ["100.2", "3.3"]),
    ([0.1, 0.05], ["0.100", "0.050"]), ([0.099, 0.05], ["0.0990", "0.0500"]), ([0.0012, 2e-9], ["0.00120", "2.0e-09"]),
])  # fmt: skip
def test_the_largest_number_of_a_column_has_three_digits(numbers: list[float], texts: list[str]):
    lines = [Line("", "measured", [Cell("", value, None)]) for value in numbers]
    builder._print_cells(lines, 1)
    printed = [cell.text for line in lines if (cell := line.cells[0])]
    assert printed[0] == texts[0]
    assert float(printed[1]) == pytest.approx(float(texts[1]))


def parsed(**changes: Any) -> Result:
    content = measured(0.5, 0.6, 9.5)
    for key, value in changes.items():
        is_added = isinstance(value, dict) and isinstance(content.get(key), dict)
        content[key] = content[key] | value if is_added else value
    return check_shape(content, Result)


CONDITIONS: dict[str, dict[str, Any]] = {
    "limits": {"data": {"frames": [40, 60]}},
    "exclusions": {"data": {"excluded": {"short": 3}}},
    "time": {"device": "NVIDIA H200"},
    "published split": {"published_split": True},
    "force": {"forced": True},
    "warnings": {"warnings": ["a warning"]},
    "extractor": {"extractor": None},
    "skeleton": {"skeleton": {"stand_in": True, "smpl_sha256": None}},
    "changes of the recipe": {"checkpoint": {"recipe_changes": ["seed=3"]}},
}


@pytest.mark.parametrize("name", CONDITIONS)
def test_each_difference_between_measurements_is_a_condition_with_its_own_sentence(name: str):
    changed, usual = (
        builder._conditions(result, timed=True, shows_multimodality=False)
        for result in (parsed(**CONDITIONS[name]), parsed())
    )
    differences = {key for key in usual if usual[key] != changed[key]}
    assert name in differences
    assert differences <= {name, "audit"}  # cards belong to an extractor


def test_conditions_state_frames_devices_and_all_warnings():
    several = parsed(data={"frames": [40, 196]}, warnings=["one", "two"], device="a GPU")
    facts = builder._conditions(several, timed=True, shows_multimodality=False)
    assert facts["limits"] == "Motions have 40 to 196 frames."
    assert facts["warnings"] == "Warning: one. Warning: two."
    assert facts["time"] == "Timed in batches of 64 on a GPU."
    equal = parsed(data={"frames": [60, 60]}, extractor=None)
    facts = builder._conditions(equal, timed=False, shows_multimodality=False)
    assert facts["limits"] == "Motions have 60 frames."
    assert (facts["time"], facts["extractor"]) == ("", "No extractor.")


@pytest.mark.parametrize(("count", "is_short"), [(1, True), (3, True), (4, False)])
def test_a_footnote_with_up_to_three_differences_lists_only_these(count: int, is_short: bool):
    first = {f"fact {number}": f"Fact {number}." for number in range(6)}
    second = {
        name: f"Other {number}." if number < count else text
        for number, (name, text) in enumerate(first.items())
    }
    second["fact 0"] = ""
    notes = dict(builder._condition_notes([first, second], {"b": {"FID": None, "NFE": None}}))
    assert notes["a"] == " ".join(first.values())
    shown = ["No fact 0.", *(f"Other {number}." for number in range(1, count))]
    same = f"Same as footnote a, except for the following: {' '.join(shown)}"
    assert (
        notes["b"] == f"FID, NFE: {same if is_short else ' '.join(filter(None, second.values()))}"
    )


def test_footnotes_after_the_twenty_sixth_have_two_letters():
    conditions: list[dict[str, str]] = []
    letters = [builder._letter({"seed": str(number)}, conditions) for number in range(53)]
    assert [letters[k] for k in (0, 25, 26, 51, 52)] == ["a", "z", "aa", "zz", "aaa"]
    assert builder._letter({"seed": "26"}, conditions) == "aa"
    assert len(conditions) == 53


def test_only_a_distance_of_zero_between_real_motions_is_explained():
    cells: list[Cell | None] = [Cell("", 0.0), Cell("", 0.0), Cell("", 0.5)]
    line = Line("Real motions", "real", cells)
    notes = builder._warnings([line], ["fid", "foot_skating", "fid"], ["FID", "Skating", "FID 2"])
    assert [text.partition(" of real")[0] for _, text in notes] == ["FID"]


def test_labels_that_contain_commas_are_joined_by_semicolons():
    assert builder._listed(["MDM", "MFM"]) == "MDM, MFM"
    assert builder._listed(["MDM, 50 steps", "MFM"]) == "MDM, 50 steps; MFM"


@pytest.mark.parametrize(("value", "real", "text"), [
    ({"replications": 1}, 400, "1 replication with N = 400 motions."),
    ({"n": None, "n_per_replication": [64, 5], "replications": 2}, 64,
     "2 replications with N = 64 + 5 motions (real motions: N = 64)."),
    ({"n_real": 378}, 400, "5 replications with N = 400 motions, compared with sets of 378 real motions."),
    ({"n_real": 400}, 378, "5 replications with N = 400 motions (real motions: N = 378)."),
])  # fmt: skip
def test_a_footnote_states_motions_per_replication_and_sizes_that_differ(value, real, text):
    result = parsed(
        values={"fid": entry(0.5) | value}, ground_truth={"fid": entry(0) | {"n": real}}
    )
    assert builder._numbers(result) == text


def test_a_row_is_not_valid_if_any_of_its_results_is_not_even_if_it_is_quick():
    valid = parsed(quick=True)
    wrong = parsed(invalid_because=["a", "b"], checkpoint={"averaged_weights": False})
    row, values = {"label": "MDM", "eta": 0, "guidance_scale": 0.0}, ["fid", "diversity"]
    first = builder._line(row, [valid, wrong], values, ["x", "y"])
    assert (first.state, first.facts["not valid because"]) == ("NOT VALID", "a; b")
    assert (first.facts["weights"], first.facts["result"]) == ("averaged", "x y")
    assert builder._line(row, [valid, valid], values, ["x", "y"]).state == "QUICK"
    assert builder._line(row, [wrong, None], values, ["x", "y"]).facts["weights"] == "raw"
    # An option of 0 is a position on the x-axis
    assert (first.options["eta"], first.options["guidance_scale"]) == (0, 0)


def test_options_of_an_edit_are_shown_and_parameters_are_in_millions():
    edited = parsed(checkpoint={"edit": {"until": 0.2, "method": "mfm"}})
    assert builder._about(edited, "until") == 0.2
    assert builder._about(edited, "parameters") == pytest.approx(12.345678)
    assert builder._about(edited, "seconds_per_sample") == 0.11
    assert builder._cell(None, "until", {"until": 0}) == Cell("0", 0.0)


def test_a_row_lists_the_most_common_count_and_the_exceptions():
    few = entry(1.0) | {"n": 30, "replications": 2}
    result = parsed(values={"a": few, "b": entry(1.0), "c": entry(1.0)})
    counts = builder._counts([result, result, result, None], ["a", "b", "c", "b"])
    assert counts == "5 x 400; a 2 x 30"
    assert builder._counts([None], ["a"]) == ""


def test_settings_of_a_column_keep_their_digits_unless_one_has_an_interval_or_two_decimals():
    def texts(*cells: Cell) -> list[str]:
        lines = [Line("", "measured", [cell]) for cell in cells]
        builder._print_cells([*lines, Line("", "reported", [Cell("as printed", 1e6)])], 1)
        return [cell.text for cell in cells]

    assert texts(Cell("2.5", 2.5), Cell("1", 1.0)) == ["2.5", "1"]
    assert texts(Cell("2.55", 2.55), Cell("1", 1.0)) == ["2.550", "1.000"]
    assert texts(Cell("1", 1.0), Cell("", 2.55, 0.1)) == ["1", "2.550 ±0.100"]
    assert texts(Cell("", -2e-5), Cell("", -1.5)) == ["-0.000020", "-1.500"]


def test_measured_rows_are_ranked_only_beside_one_real_row_of_their_own_footnote():
    def ranked(*lines: Line) -> list[int]:
        builder._rank(lines, {"Diversity": "real"})
        return [
            cell.rank
            for line in lines
            if line.kind in ("measured", "reported")
            for cell in line.cells
            if cell
        ]

    def line(value: float, marks: str = "a", kind: str = "measured") -> Line:
        return Line("", kind, [Cell("", value)], marks)

    pair = (line(9.0), line(8.0))
    assert ranked(*pair, line(8.1, kind="real")) == [2, 1]
    assert ranked(*pair, line(8.1, "b", "real")) == [0, 0]
    assert ranked(*pair, line(8.1, kind="real"), line(9.1, kind="real")) == [0, 0]
    printed = (line(9.0, "†", "reported"), line(8.0, "†", "reported"))
    assert ranked(*printed, line(8.1, "††", "reported real")) == [2, 1]
    assert ranked(*printed, line(8.1, "a", "real")) == [0, 0]


def test_a_reported_zero_is_a_value(folder, monkeypatch):
    printed = [
        {"label": "none", "values": {"Diversity": 0}},
        {"label": "some", "values": {"Diversity": 0.5}},
    ]
    real = {"label": "Real", "real": True, "values": {"Diversity": 0.1}}
    assert ranks_of_diversity(folder, monkeypatch, [real, *printed]) == {"none": 1, "some": 2}


@pytest.mark.parametrize(
    ("longest", "step"), [(39, 1), (40, 1), (41, 2), (196, 5), (200, 5), (201, 6)]
)
def test_a_histogram_of_lengths_has_at_most_forty_one_bars(tmp_path, longest: int, step: int):
    lengths = {"fingerprint": "f", "fps": 30.0, "lengths": [longest, 10, 20, 30]}
    write_json(tmp_path / "lengths" / "mine.json", lengths)
    spec = {"title": "Lengths", "parts": {"All": {"lengths": ["mine"]}}}
    (part,) = build("x", spec, tmp_path).parts
    histogram = part.histograms["mine"]
    assert (histogram.step, sum(histogram.counts)) == (step, 4)
    assert histogram.counts[longest // step] == 1
    median = part.lines[0].cells[list(part.columns).index("median")]
    assert median is not None
    assert median.value == 30  # of an even number of lengths, the upper one


def test_a_value_of_zero_and_an_option_of_zero_are_points_of_a_figure():
    lines = [
        Line("MDM", "measured", [Cell("", value)], options={"eta": eta})
        for eta, value in ((0.0, 1.0), (1.0, 0.0))
    ]
    part = Part("P", {"FID": "lower"}, lines)
    ((series,), _) = _series(part, Figure(part="P", x="eta", y=["FID"]), "FID")
    assert list(series.points) == [(0.0, 1.0), (1.0, 0.0)]


def test_a_figure_has_a_panel_per_column_and_a_logarithmic_axis_if_requested():
    lines = [
        Line("MDM", "measured", [Cell("", 1.0), Cell("", 2.0)], options={"num_inference_steps": x})
        for x in (1.0, 10.0, 100.0)
    ]
    part = Part("P", {"FID": "lower", "Diversity": "none"}, lines)

    def middle(**options: Any) -> list[float]:
        drawing = str(draw(part, Figure(part="P", x="num_inference_steps", **options)))
        dots = [float(x) for x in re.findall(r'<circle class="c0" cx="([\d.]+)"', drawing)]
        assert len(dots) == 3 * len(options["y"])
        assert drawing.count(">sampling steps<") == len(options["y"])
        return [
            (second - first) / (last - first)
            for first, second, last in zip(*[iter(dots)] * 3, strict=True)
        ]

    assert middle(y=["FID", "Diversity"]) == pytest.approx([9 / 99] * 2, abs=0.01)
    assert middle(y=["FID"], log=True) == pytest.approx([0.5], abs=0.01)


@pytest.mark.parametrize(("figures", "parts", "names"), [
    (1, 1, ["t-figure.svg"]), (2, 1, ["t-figure1.svg", "t-figure2.svg"]),
    (1, 2, ["t-in-meters-figure.svg", "t-p-figure.svg"]),
])  # fmt: skip
def test_figures_are_numbered_if_there_are_several(tmp_path, figures, parts, names):
    lines = [Line("MDM", "measured", [Cell("", x)], options={"eta": x}) for x in (0.0, 1.0)]
    drawn = [Figure(part="P", x="eta", y=["FID"])] * figures
    table = Table("t", "T", [
        Part(name, {"FID": "lower"}, lines, figures=drawn) for name in ("P", "In (meters)")[:parts]
    ])  # fmt: skip
    write(table, tmp_path)
    assert sorted(path.name for path in tmp_path.glob("*.svg")) == names
    text = (tmp_path / "t.md").read_text()
    assert all(f"]({name})" in text for name in names)


def test_the_legend_and_the_sources_are_those_of_all_parts():
    facts = {"checkpoint sha256": "c", "recipe": "r", "sampler": "ddim", "seed": "0"}
    first = Part("P", {"FID": "lower"}, [Line("MDM", "measured", [None], facts=facts)])
    other = Line("real", "measured", [None], state="QUICK", facts=facts | {"baseline": "real"})
    second = Part("Q", {"FID": "lower"}, [other])
    both = "of the rows with the same mark, except sanity-check baselines and rows that are quick"
    assert both in rendered(Table("t", "T", [first, second]), "md")
    assert "of the rows with the same mark." in rendered(Table("t", "T", [first]), "md")
    assert format_module._sources(Table("t", "T", [first])) == [
        "MDM: checkpoint sha256 = c; recipe = r; sampler = ddim; seed = 0"
    ]
    assert [line[:7] for line in format_module._sources(Table("t", "T", [first, second]))] == [
        "P: MDM:", "Q: real",
    ]  # fmt: skip


def test_rows_of_one_checkpoint_with_other_samplers_have_sources_of_their_own():
    shared = {"checkpoint sha256": "c", "recipe": "r"}
    options = (("ddim", "5"), ("ddim", ""), ("ancestral", "5"))
    lines = [
        Line(f"row {steps}", "measured", [None], facts=shared | {"sampler": name, "steps": steps})
        for name, steps in options
    ]
    sources = format_module._sources(Table("t", "T", [Part("P", {"FID": "none"}, lines)]))
    assert sources == [
        "row 5 / row : checkpoint sha256 = c; recipe = r; sampler = ddim; steps = 5 / –",
        "row 5: checkpoint sha256 = c; recipe = r; sampler = ancestral; steps = 5",
    ]


def test_a_footnote_links_an_audit_card_that_exists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cards").mkdir()
    (tmp_path / "cards" / "a.html").write_text("")
    table = Table("t", "T", [], folder=Path("runs/tables"))
    texts = [f"audit cards/{name}.html (40 motions)." for name in "ab"]
    assert format_module._linked(table, texts[0]) == [
        ("audit ", ""), ("cards/a.html", "../../cards/a.html"), (" (40 motions).", ""),
    ]  # fmt: skip
    assert {link for _, link in format_module._linked(table, texts[1])} == {""}


@pytest.mark.parametrize(("values", "better", "expected"), [
    ([None, 3.0], "lower", [0, 0]), ([None, 3.0, 0.0], "lower", [0, 2, 1]),
    ([2.0, 1.0, 1.0, 3.0], "lower", [2, 1, 1, 0]), ([0.0, 0.5], "real", [1, 2]),
])  # fmt: skip
def test_a_missing_value_has_no_rank_and_a_zero_has_one(values, better, expected):
    assert ranks(values, better, 0.0) == expected


def test_a_column_overrides_the_options_of_its_row_and_a_row_those_of_its_part():
    part = {
        "protocol": "text_to_motion", "extractor": "part", "seed": 1, "samples": 5, "data": "kit",
        "columns": {"A": {"value": "fid"}, "B": {"value": "fid", "protocol": "latency", "seed": 3}},
        "rows": [{"label": "a", "note": "n", "ckpt": "x.ckpt", "seed": 2, "eta": [0.5]}],
    }  # fmt: skip
    ((row, (first, second)),) = evaluations(part)
    assert row["label"] == "a"  # a list with one value is not a sweep
    shared = {"ckpt": "x.ckpt", "eta": 0.5, "extractor": "part", "samples": 5}
    assert first.keys == shared | {"protocol": "text_to_motion", "seed": 2}
    assert second.keys == shared | {"protocol": "latency", "seed": 3}
    part["rows"] = [{"label": "b", "baseline": "real"}]
    ((_, (first, _)),) = evaluations(part)
    assert first.keys["data"] == "kit"  # a baseline has no recipe that states its data set


def test_labels_of_rows_name_the_options_that_vary_and_have_no_column():
    part = {
        "columns": {"Steps": {"value": "num_inference_steps"}},
        "rows": [
            {"label": "MDM", "ckpt": "x.ckpt", "num_inference_steps": [5, 10], "eta": [0, 1],
             "strength": [0.5, 1], "spacing": "stride"},
        ],
    }  # fmt: skip
    labels = [row["label"] for row, _ in evaluations(part)]
    assert len(labels) == 8
    assert labels[:2] == [f"MDM (eta 0, strength of the variation {x})" for x in (0.5, 1)]
    assert labels[:4] == labels[4:]


def test_the_path_of_a_result_depends_on_the_keys_but_not_on_their_order():
    keys = {"protocol": "a/synthetic.yaml", "ckpt": "runs/kit/mdm/default/checkpoints/last.ckpt"}
    path = Evaluation("one", keys | {"seed": 0}).path(Path("results"))
    assert path == Evaluation("other", {"seed": 0} | keys).path(Path("results"))
    assert re.fullmatch(r"results/synthetic/kit-mdm-last-[0-9a-f]{10}\.json", path.as_posix())
    others = [keys, keys | {"seed": 1}, keys | {"seed": 0, "eta": 0}]
    assert path not in [Evaluation("", other).path(Path("results")) for other in others]


@pytest.mark.parametrize(
    ("key", "reason"),
    [("ckpt", "no checkpoint"), ("from_samples", "no samples"), ("extractor", "no extractor")],
)
def test_missing_files_of_a_row_are_named_by_their_kind(tmp_path, key: str, reason: str):
    assert Evaluation("", {key: str(tmp_path / "x")}).absent == {reason: str(tmp_path / "x")}
    assert Evaluation("", {key: str(tmp_path)}).absent == {}
    assert Evaluation("", {key: "none"}).absent == Evaluation("", {}).absent == {}


def test_settings_of_a_recipe_are_its_own_even_if_they_are_zero_and_else_those_of_the_class():
    config = {
        "denoiser": {"_target_": "flame_mdm.denoisers.mdm.MDMEncoder", "dropout": 0.0},
        "optimizer": {"_target_": "torch.optim.AdamW", "weight_decay": 0, "betas": [0.9, 0.99]},
        "condition": {"freeze": False},
        "ema": None,
    }
    assert settings.value(config, "denoiser.dropout") == 0
    assert (
        settings.value({"optimizer": {"_target_": "torch.optim.AdamW"}}, "optimizer.weight_decay")
        == 0.01
    )
    assert settings.value(config, "optimizer.weight_decay") == 0
    assert settings.value(config, "optimizer._target_") == "AdamW"
    assert settings.value(config, "condition.freeze") is False
    assert settings.value(config, "ema.decay") is None


@pytest.mark.parametrize(("value", "text"), [
    (True, "yes"), (False, "no"), (0, "0"), (1000, "1,000"), (0.0001, "0.0001"), (0.9, "0.9"), (12.3456, "12.35"),
    ([0.9, 0.999], "0.9, 0.999"), ("cosine", "cosine"), ([1000, False], "1,000, no"),
])  # fmt: skip
def test_settings_are_printed_with_four_digits(value, text: str):
    assert settings.setting_text(value) == text


def test_the_longer_side_of_a_table_of_settings_has_the_rows(monkeypatch):
    recipes = {"a": {"features": 263, "task.cond_drop_prob": 0.0}, "b": {"features": 251}}
    monkeypatch.setattr(settings, "hyperparameters", recipes.__getitem__)
    keys = {"Width": "features", "Drop": "task.cond_drop_prob"}
    part = {"keys": keys, "recipes": {"A": "a", "B": "b"}}
    printed = {"source": "a paper", "rows": [{"label": "Width", "values": {"B": "251"}}]}
    table = settings.settings_table("P", part, printed)
    assert list(table.columns) == ["A", "B", "B, reported"]  # as many keys as recipes
    texts = {line.label: [cell and cell.text for cell in line.cells] for line in table.lines}
    assert texts == {"Width": ["263", "251", "251"], "Drop": ["0", None, None]}
    assert table.notes == [("", "A: recipe a"), ("", "B: recipe b"), ("", "reported: a paper")]
    fewer = settings.settings_table("P", part | {"keys": {"Width": "features"}}, printed)
    assert list(fewer.columns) == ["Width", "Width, reported"]
    assert [line.label for line in fewer.lines] == ["A", "B"]
    assert [cell and cell.text for cell in fewer.lines[1].cells] == ["251", "251"]


def test_the_command_counts_rows_that_are_complete_and_passes_its_keys_on(
    folder, monkeypatch, capsys
):
    change(folder, "MFM", quick=True)
    change(folder, "MDM", invalid_because=["x"])
    assert command(folder, folder / "a") == 3
    assert "spec: 5 of 8 rows measured" in capsys.readouterr().out
    requests = []
    monkeypatch.setattr(evaluators.evaluation, "evaluate", requests.append)
    text = SEVERAL.format(folder=folder, more=", Multimodality: {value: multimodality}")
    (folder / "several.yaml").write_text(text.replace("extractor: none", "multimodality: false"))
    words = [
        f"results={folder / 'none'}",
        f"out={folder / 'out'}",
        "force=true",
        "device=cpu",
        "data_root=/d",
    ]
    assert main(["tables", f"table={folder / 'several.yaml'}", *words]) == 0
    (request,) = requests
    assert (request.force, request.device, request.data_root) == (True, "cpu", "/d")
    assert (request.batch_size, request.multimodality) == (64, False)


def test_a_failed_evaluation_is_an_error_and_the_others_are_still_evaluated(
    folder, monkeypatch, capsys
):
    def evaluate(request: EvaluationRequest) -> None:
        if str(request.ckpt).endswith("mdm.ckpt"):
            raise UserError("the first line\nmore")
        write_json(str(request.out), measured(0, 0, 0, invalid_because=["off"]))

    monkeypatch.setattr(evaluators.evaluation, "evaluate", evaluate)
    words = [f"results={folder / 'none'}", f"out={folder / 'out'}"]
    assert main(["tables", f"table={folder / 'spec.yaml'}", *words]) == 1
    shown = capsys.readouterr()
    assert "error: 5 evaluations failed: MDM: the first line; " in shown.err
    assert "evaluating 7 of 7" in shown.out
    assert "spec: 0 of 8 rows measured" in shown.out
    assert "NOT VALID: spec, Text-to-motion, MFM: off" in shown.err


def test_parameters_of_a_recipe_are_counted_in_millions_without_the_text_encoder():
    sizes = settings._sizes(recipe("quickstart"))
    model = flame_mdm.load("quickstart")
    count = sum(weights.numel() for weights in model.denoiser.parameters())
    assert sizes == {"features": model.representation.features, "parameters": count / 1e6}
    assert settings._sizes({"representation": recipe("quickstart")["representation"]}) == {
        "features": model.representation.features
    }


@pytest.mark.parametrize(
    ("file", "hashed"), [("a.safetensors", "weights"), ("a.ckpt", "weights"), ("a.tar", "bytes")]
)
def test_an_extractor_is_another_one_if_its_weights_differ_and_a_checkpoint_if_its_bytes_do(
    tmp_path, monkeypatch, file: str, hashed: str
):
    monkeypatch.setattr("flame_mdm.checkpoints.model_files.weights_sha256", lambda _: "weights")
    monkeypatch.setattr(tables_command, "sha256", lambda _: "bytes")
    (tmp_path / file).touch()
    (tmp_path / "mdm.safetensors").touch()
    keys = {
        "protocol": "p",
        "ckpt": f"{tmp_path}/mdm.safetensors",
        "extractor": str(tmp_path / file),
    }
    for extractor, checkpoint in ((hashed, "bytes"), ("other", "bytes"), (hashed, "weights")):
        content = measured(0, 0, 0, extractor={"sha256": extractor})
        content["checkpoint"]["sha256"] = checkpoint
        path = put(Evaluation("MDM", keys), tmp_path, content)
        is_same = (extractor, checkpoint) == (hashed, "bytes")
        assert outdated(path, Evaluation("MDM", keys)) == (not is_same)


@pytest.mark.parametrize(("stated", "root"), [("here", "here"), ("", "elsewhere")])
def test_lengths_are_counted_in_the_chosen_folder_with_what_was_excluded(
    tmp_path, monkeypatch, stated: str, root: str
):
    monkeypatch.setenv("FLAME_MDM_DATA", "elsewhere")
    (tmp_path / "store.json").touch()
    info = {"fingerprint": "f00d", "fps": 12.5, "excluded": {"short": 3}, "clips": {}}
    clips = [SimpleNamespace(length=length) for length in (90, 40, 60)]
    store = SimpleNamespace(info=info, clips=clips)
    data = SimpleNamespace(folder=tmp_path, open=lambda: store)
    roots: list[str] = []

    def compose_node(name: str, *, data_root: str) -> dict[str, str]:
        roots.append(data_root)
        return {"data": name, "representation": name}

    monkeypatch.setattr(tables_command, "compose_data", compose_node)
    monkeypatch.setattr(tables_command, "instantiate", lambda node, **keywords: data)
    count_lengths("kit", tmp_path / "results", TablesSettings(data_root=stated))
    written = json.loads((tmp_path / "results" / "lengths" / "kit.json").read_text())
    assert written["lengths"] == [40, 60, 90]
    assert {name: written[name] for name in ("fingerprint", "fps", "excluded")} == {
        "fingerprint": "f00d", "fps": 12.5, "excluded": {"short": 3},
    }  # fmt: skip
    assert roots == [root]


def test_the_best_value_is_bold_and_the_second_best_is_underlined_in_each_format():
    ranked = [Cell("1.5", 1.5, None, 1), Cell("2.5", 2.5, None, 2), Cell("9.5", 9.5), None]
    lines = [
        Line("Real", "real", [Cell("0.5", 0.5), None, None, None], "a"),
        Line("MDM_1", "measured", ranked, "a", "QUICK"),
    ]
    columns = {"FID": "lower", "Top 3": "higher", "Diversity": "real", "NFE": "none"}
    table = Table("t", "T", [Part("P", columns, lines, [("a", "Seed 0."), ("", "More.")])])
    md = str(rendered(table, "md")).splitlines()
    assert "| | FID\u00a0↓ | Top 3\u00a0↑ | Diversity\u00a0→ | NFE |" in md
    assert "| MDM\\_1 (QUICK) <sup>a</sup> | **1.5** | <u>2.5</u> | 9.5 | – |" in md
    assert md.index("| *Real motions, measured* | | | | |") < md.index("| *Measured* | | | | |")
    assert "a: Seed 0.  " in md
    tex = str(rendered(table, "tex")).splitlines()
    head = r" & FID $\downarrow$ & Top 3 $\uparrow$ & Diversity $\rightarrow$ & NFE \\"
    assert head in tex
    assert r"MDM\_1 (QUICK)\tnote{a} & \textbf{1.5} & \underline{2.5} & 9.5 & -- \\" in tex
    assert r"\begin{tabular}{lrrrr}" in tex
    assert r"\multicolumn{5}{l}{\emph{Measured}} \\" in tex
    assert r"\item[a] Seed 0." in tex
    html = rendered(table, "html")
    cells = ("<b>1.5</b>", "<u>2.5</u>", "9.5", "–")
    row = "".join(f'<td class="number">{cell}</td>' for cell in cells)
    assert f'<tr class="bad"><td>MDM_1 (QUICK)<sup>a</sup></td>{row}</tr>' in html
