"""Published numbers and the tables that they stand in: whole, well formed, and about what the evaluations measure."""

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fixtures import recipe

from evaluators.evaluator import Evaluator, Motions
from evaluators.protocol import load_protocol
from flame_mdm.config import EXPERIMENTS, Config, instantiate, recipes
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.reporting.tables import build as builder
from flame_mdm.reporting.tables.settings import hyperparameters as settings
from flame_mdm.reporting.tables.specs import ABOUT, load_spec, spec_names
from flame_mdm.reporting.tables.specs import PUBLISHED as PUBLISHED_FILE
from flame_mdm.representations.humanml import HumanML
from flame_mdm.safe_io import read_package_yaml

PUBLISHED: dict[str, dict[str, Any]] = read_package_yaml(PUBLISHED_FILE)
del PUBLISHED["hyperparameters"]  # which tests/test_recipes.py checks
PAPERS = [name for name in spec_names() if name.startswith(("flame_", "mdm_", "mfm_"))]
SPECS = {name: load_spec(name) for name in spec_names()}
PARTS = {
    f"{name}: {label}": part
    for name, spec in SPECS.items()
    for label, part in spec["parts"].items()
}
MEASURED = {name: part for name, part in PARTS.items() if "columns" in part}
SETTINGS = {name: part for name, part in PARTS.items() if "recipes" in part}
REPORTED = {
    f"{name}: {label}": part for name, parts in PUBLISHED.items() for label, part in parts.items()
}
NUMBER = re.compile(r"(\d{1,3}(,\d{3})*|\d+)(\.\d+)?(M|%)?( ±\d*\.\d+)?")
UNREAD = "humanml3d/mdm_motion272"
"""Recipe of features that no evaluator reads."""


pytestmark = pytest.mark.usefixtures("composed_once")


def trained(row: Config) -> str:
    """The recipe of the checkpoint of a row."""
    match = re.fullmatch(
        r"runs/(.+)/[^/]+/checkpoints/(?:best|last)\.ckpt|flame_mdm/models/(.+)\.\w+", row["ckpt"]
    )
    assert match, row
    return match[1] or match[2]


def measures(protocol: str, name: str) -> tuple[Any, set[str]]:
    """A protocol for motions of a recipe, and the names of the values it gives."""
    return _measures(protocol, json.dumps(recipe(name)["representation"]))


@cache
def _measures(protocol: str, representation: str) -> tuple[Any, set[str]]:
    motions = instantiate(json.loads(representation))
    loaded = load_protocol(protocol, motions)
    several = loaded.multimodality
    evaluator = Evaluator(None, loaded.metrics | (several.metrics if several else {}), motions)
    nothing = evaluator.extract(Motions([], []))
    return loaded, set(evaluator.score(nothing, nothing, nothing, 0)[0])


def test_there_is_a_table_for_each_of_the_papers(tmp_path, subtests):
    tables = {
        f"{paper}_{n}"
        for paper, last in (("flame", 10), ("mdm", 8), ("mfm", 5))
        for n in range(1, last + 1)
    }
    figures = {"flame_figure_4", "flame_figure_7", "mdm_figure_4"} | {
        f"mfm_figure_{n}" for n in (1, 4, 5, 7)
    }
    assert set(PAPERS) == tables | figures
    for name in PAPERS:
        with subtests.test(name=name):
            table = builder.build(name, SPECS[name], tmp_path)
            assert [part.name for part in table.parts] == list(SPECS[name]["parts"]), name


def test_published_rows_are_whole():
    wrong = []
    for name, part in REPORTED.items():
        cited = re.search(
            r"arXiv:(2209.00349|2209.14916|2312.08895|2410.03441), (table|figure|section)",
            part["source"],
        )
        if not (
            part.keys() <= {"evaluator", "source", "notes", "rows"} and part["evaluator"] and cited
        ):
            wrong.append(name)
        for row in part["rows"]:
            values = row["values"].values()  # a number without quotes loses digits
            printed = all(
                isinstance(v, str) and (name in SETTINGS or NUMBER.fullmatch(v)) for v in values
            )
            whole = (
                row.keys() <= {"label", "values", "real", "source", "evaluator"} and row["values"]
            )
            if not (printed and whole) or part["rows"].count(row) > 1:
                wrong.append(f"{name}: {row}")
    assert not wrong


def test_published_settings_are_those_of_the_recipes(subtests):
    for name in REPORTED.keys() & SETTINGS.keys():
        part, reported = SETTINGS[name], REPORTED[name]["rows"]
        with subtests.test(name=name):
            assert [row["label"] for row in reported] == list(part["keys"])
        for row in reported:
            for column, printed in row["values"].items():
                with subtests.test(name=name, row=row["label"], column=column):
                    ours = settings(part["recipes"][column])[part["keys"][row["label"]]]
                    ours = ours if isinstance(ours, list | tuple) else [ours]
                    for value, text in zip(ours, printed.split(", "), strict=True):
                        if isinstance(value, str):
                            assert value == text
                        # no code of the U-net is public
                        elif column != "U-net":
                            printed_value = float(text.removesuffix(" words").replace(",", ""))
                            assert round(value, len(text.partition(".")[2])) == printed_value
    for name, part in SETTINGS.items():
        for key in part["keys"].values():
            with subtests.test(name=name, key=key):
                assert all(key in settings(column) for column in part["recipes"].values())


@pytest.mark.parametrize("name", ["mdm_1", "mdm_2"])
def test_multimodality_has_the_arrow_that_the_paper_prints(name):
    for part in SPECS[name]["parts"].values():
        assert part["columns"]["Multimodality"]["better"] == "higher"


def test_columns_are_what_protocols_measure_and_rows_what_processes_sample():
    wrong = []
    for name, part in MEASURED.items():
        values = {column["value"] for column in part["columns"].values()}
        for row in (row for row in part["rows"] if "ckpt" in row):
            config = recipe(trained(row))
            missing = values - measures(part["protocol"], trained(row))[1] - ABOUT.keys()
            diffusion = config["process"]["_target_"].endswith("GaussianDiffusion")
            samplers = (GaussianDiffusion if diffusion else FlowMatching).samplers
            sampled = row.get("sampler", config["task"]["sampler"]) in samplers
            if diffusion:  # steps are a number, several numbers, or lists of the steps themselves
                most = config["process"]["num_train_timesteps"]
                sampled &= "until" not in row and np.max(row.get("num_inference_steps", 1)) <= most
            if missing or not sampled:
                wrong.append((name, row["label"], missing))
    assert not wrong


def extracted(path: str) -> tuple[str, str]:
    """Kind and data set of an extractor, by its path."""
    if path.startswith("runs/"):
        return "MotionCLIPExtractor", recipe(trained({"ckpt": path}))["data"]["name"]
    if path.startswith("assets/t2m/"):
        return "T2MExtractor", Path(path).name
    if path == "assets/humanact12":
        return "UnconstrainedExtractor", "humanact12"
    return ("ClassifierExtractor", Path(path).parent.name) if path else ("", "")


def needed_extractor(protocol: Any, config: Config) -> tuple[str, str]:
    """Kind and data set of the extractor that a protocol needs for a recipe."""
    if protocol.extractor is None:
        return "", ""
    data = config["data"]["name"].removesuffix("-all")  # stores of published splits
    return protocol.extractor["_target_"].rpartition(".")[2], data


def test_rows_are_checkpoints_of_recipes_that_fit(subtests):
    for name, part in MEASURED.items():
        with subtests.test(name=name, part=part):
            if name.partition(":")[0] not in PAPERS:
                continue
            for row in part["rows"]:
                config = recipe(trained(row))
                chosen = Path(row["ckpt"]).stem == "best"
                assert chosen == bool(config["callbacks"]["best"]), (
                    f"{name}: best.ckpt only where clips are validated"
                )
                protocol, _ = measures(part["protocol"], trained(row))
                labels = config["condition"].get("_target_", "").endswith("ActionLabels")
                assert protocol.condition in ("none", "action" if labels else "text"), name
                assert extracted(part.get("extractor", "")) == needed_extractor(protocol, config), (
                    name
                )
            for column in part["columns"].values():  # papers time one motion
                if column["value"] == "seconds_per_sample":
                    assert column.get("protocol", part["protocol"]) == "latency", name


def test_papers_checkpoints_are_chosen_by_fid(subtests):
    for name in (n for n in recipes() if n.startswith(("humanml3d/", "kit/", "babel/"))):
        with subtests.test(name=name):
            callbacks = recipe(name)["callbacks"]
            if name == UNREAD:
                assert "evaluate" not in callbacks
                continue
            evaluate = callbacks["evaluate"]
            protocol, _ = measures(evaluate["protocol"], name)
            assert callbacks["best"]["monitor"] == f"val/{evaluate['protocol']}/fid", name
            assert protocol.metrics["fid"]["_target_"].endswith("FrechetMotionDistance"), name
            assert extracted(evaluate["extractor"]) == needed_extractor(protocol, recipe(name)), (
                name
            )
            assert 512 <= evaluate["samples"] <= 1000, name
            assert recipe(name)["trainer"]["max_steps"] % evaluate["every_n_steps"] == 0, (
                f"{name}: not the last step"
            )


def test_real_motions_have_what_protocols_expect(subtests):
    names = {"mm_dist": "MM-Dist", "diversity": "Diversity", "fid": "FID"}
    names["motions_for_text/top3"] = "R precision (top 3)"
    values = read_package_yaml(EXPERIMENTS / "evaluation" / "text_to_motion_t2m.yaml")["expected"]
    for table, part, data in (("mdm_1", "HumanML3D", "humanml3d"), ("mdm_2", "KIT-ML", "kit")):
        with subtests.test(table=table, part=part, data=data):
            real = next(
                row["values"] for row in PUBLISHED[table][part]["rows"] if row["label"] == "Real"
            )
            expected = values[data]
            assert {n: float(real[c].split()[0]) for n, c in names.items()} == {
                n: expected[n][0] for n in names
            }


@pytest.mark.parametrize(
    ("table", "part", "row", "data", "fid"),
    [
        ("mdm_3", "HumanAct12", "Real (ours)", "humanact12", "FID"),
        ("mdm_4", "UESTC", "Real", "uestc", "FID test"),
    ],
)
def test_real_motions_of_actions_have_what_protocols_expect(table, part, row, data, fid):
    protocol = {"humanact12": "action_to_motion", "uestc": "action_to_motion_uestc"}[data]
    rows = PUBLISHED[table][part]["rows"]
    (real,) = (published["values"] for published in rows if published["label"] == row)
    names = {"fid": fid, "accuracy": "Accuracy", "diversity": "Diversity"}
    names["multimodality"] = "Multimodality"
    expected = load_protocol(protocol, HumanML()).expected[data]
    assert {name: mean for name, (mean, _) in expected.items()} == {
        name: float(real[column].split()[0]) for name, column in names.items()
    }
    assert all(0 < tolerance < max(mean, 1) for mean, tolerance in expected.values())


def test_r_precision_of_real_motions_is_that_of_guo_and_edits_expect_the_same_fid(subtests):
    t2m = load_protocol("text_to_motion_t2m", HumanML()).expected
    tops = {
        data: [values[f"motions_for_text/top{k}"][0] for k in (1, 2, 3)]
        for data, values in t2m.items()
    }
    assert tops == {"humanml3d": [0.511, 0.703, 0.797], "kit": [0.424, 0.649, 0.779]}
    edits: dict[str, dict[str, str]] = {
        "in_between": {"region": "in_between"}, "prediction": {"region": "prediction"},
        "interpolation": {"region": "interpolate"}, "upper_body": {"joints": "upper_body"},
    }  # fmt: skip
    for name, edit in edits.items():
        with subtests.test(name=name):
            plain, measured = (
                load_protocol(f"editing_{name}{suffix}", HumanML()) for suffix in ("", "_t2m")
            )
            assert plain.edit == measured.edit == edit
            assert plain.expected == {}
            assert measured.expected == {data: {"fid": t2m[data]["fid"]} for data in t2m}
    assert load_protocol("editing_in_between_2026", HumanML()).edit == {"region": "in_between"}
    for name in ("own", "legacy"):
        assert load_protocol(f"text_to_motion_t2m_{name}", HumanML()).expected == {}
    assert load_protocol("text_to_motion_t2m_dip", HumanML()).expected == t2m
    assert load_protocol("action_to_motion_own", HumanML()).expected == {}


ROWS: dict[str, list[int]] = {
    **{
        "flame_1": [5, 5],
        "flame_2": [5],
        "flame_3": [2],
        "flame_4": [4],
        "flame_5": [8],
        "flame_9": [9, 9],
    },
    **{
        "flame_10": [6],
        "mdm_1": [14],
        "mdm_2": [5],
        "mdm_3": [7],
        "mdm_4": [5],
        "mdm_5": [3],
        "mdm_6": [5],
    },
    **{
        "dip_1": [3],
        "mdm_7": [7],
        "mdm_figure_4": [1],
        "mfm_1": [8],
        "mfm_2": [8],
        "mfm_3": [2, 2, 2],
        "mfm_figure_4": [2],
    },
}
"""Reported rows of the parts of each table; four rows of mdm_1 are the authors' corrections."""


def test_rows_are_those_of_the_papers(subtests):
    counts = {
        name: [len(part["rows"]) for part in parts.values()] for name, parts in PUBLISHED.items()
    }
    assert {
        name: n
        for name, n in counts.items()
        if not any(key.startswith(f"{name}: ") for key in SETTINGS)
    } == ROWS
    assert SPECS["mdm_5"]["parts"]["HumanAct12"]["columns"]["Diversity"]["better"] == "higher", (
        "the paper's arrow"
    )
    for name, part in (("mdm_1", "HumanML3D"), ("mdm_2", "KIT-ML")):
        with subtests.test(name=name, part=part):
            assert SPECS[name]["parts"][part]["columns"]["Multimodality"]["better"] == "higher", (
                "the paper's arrow"
            )
