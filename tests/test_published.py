"""Published numbers and the tables that they stand in: whole, well formed, and about what the evaluations measure."""

import json
import re
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.fixtures import recipe

from evaluators.evaluator import Evaluator, Motions
from evaluators.protocol import load_protocol, protocol_config
from flame_mdm.commands.tables import sizes
from flame_mdm.config import EXPERIMENTS, Config, instantiate, recipes
from flame_mdm.errors import UserError
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.reporting.settings import values as recipe_values
from flame_mdm.reporting.tables import build as builder
from flame_mdm.reporting.tables.format import ABOUT
from flame_mdm.reporting.tables.specs import PUBLISHED as PUBLISHED_FILE
from flame_mdm.reporting.tables.specs import load_spec, spec_names

PUBLISHED: dict[str, dict[str, Any]] = yaml.safe_load(PUBLISHED_FILE.read_text())
del PUBLISHED["hyperparameters"]  # which tests/test_recipes.py checks
PAPERS = [name for name in spec_names() if name.startswith(("flame_", "mdm_", "mfm_"))]
SPECS = {name: load_spec(name) for name in spec_names()}
PARTS = {f"{name}: {label}": part for name, spec in SPECS.items() for label, part in spec["parts"].items()}
MEASURED = {name: part for name, part in PARTS.items() if "columns" in part}
SETTINGS = {name: part for name, part in PARTS.items() if "recipes" in part}
REPORTED = {f"{name}: {label}": part for name, parts in PUBLISHED.items() for label, part in parts.items()}
NUMBER = re.compile(r"(\d{1,3}(,\d{3})*|\d+)(\.\d+)?(M|%)?( ±\d*\.\d+)?")


@cache
def settings(name: str) -> dict[str, Any]:
    """Hyperparameters of a recipe."""
    return recipe_values(name, sizes)


def models(part: Config) -> list[Config]:
    """The rows of a part that are checkpoints."""
    return [row for row in part["rows"] if "ckpt" in row]


def trained(row: Config) -> str:
    """The recipe of the checkpoint of a row."""
    found = re.fullmatch(r"runs/(.+)/[^/]+/checkpoints/(best|last)\.ckpt", row["ckpt"])
    assert found, row
    return found[1]


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


def reported(table: str, part: str) -> dict[str, dict[str, str]]:
    """Published values by label."""
    return {row["label"]: row["values"] for row in PUBLISHED[table][part]["rows"]}


def test_there_is_a_table_for_each_of_the_papers():
    wanted = (
        {f"flame_{n}" for n in range(1, 11)} | {f"mdm_{n}" for n in range(1, 9)} | {f"mfm_{n}" for n in range(1, 6)}
    )
    figures = {"flame_figure_4", "flame_figure_7", "mdm_figure_4"} | {f"mfm_figure_{n}" for n in (1, 4, 5, 7)}
    assert set(PAPERS) == wanted | figures


@pytest.mark.parametrize("name", PAPERS)
def test_a_table_is_made_of_its_spec_and_the_published_numbers(name, tmp_path):
    table = builder.build(name, SPECS[name], tmp_path, sizes)
    assert [part.name for part in table.parts] == list(SPECS[name]["parts"])


@pytest.mark.parametrize("name", REPORTED)
def test_published_rows_are_whole(name):
    part = REPORTED[name]
    assert part.keys() <= {"evaluator", "source", "notes", "rows"}
    assert part["evaluator"]
    assert re.search(r"arXiv:(2209.00349|2209.14916|2312.08895), (table|figure|section)", part["source"])
    for row in part["rows"]:
        assert row.keys() <= {"label", "values", "real", "source"}
        assert row["values"]
        for value in row["values"].values():
            assert isinstance(value, str), f"{row['label']}: put {value} in quotes, or digits are lost"
    repeated = Counter(str(sorted(row["values"].items())) + row["label"] for row in part["rows"])
    assert max(repeated.values()) == 1


@pytest.mark.parametrize("name", sorted(REPORTED.keys() - SETTINGS.keys()))
def test_published_values_are_numbers(name):
    for row in REPORTED[name]["rows"]:
        bad = {column: value for column, value in row["values"].items() if not NUMBER.fullmatch(value)}
        assert not bad, row["label"]


@pytest.mark.parametrize("name", sorted(REPORTED.keys() & SETTINGS.keys()))
def test_published_settings_are_those_of_the_recipes(name):
    part, rows = SETTINGS[name], REPORTED[name]["rows"]
    assert [row["label"] for row in rows] == list(part["keys"])
    for row in rows:
        for column, printed in row["values"].items():
            ours = settings(part["recipes"][column])[part["keys"][row["label"]]]
            for one, text in zip(ours if isinstance(ours, list | tuple) else [ours], printed.split(", "), strict=True):
                if isinstance(one, str):
                    assert one == text
                elif column != "U-net":  # of which no code is public
                    digits = len(text.partition(".")[2])
                    assert round(one, digits) == float(text.removesuffix(" words").replace(",", "")), (row, column)


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_exist_in_the_recipes(name):
    for label, key in SETTINGS[name]["keys"].items():
        for column in SETTINGS[name]["recipes"].values():
            assert key in settings(column), f"{label}: {column} has no {key}"


@pytest.mark.parametrize("name", MEASURED)
def test_columns_are_what_the_protocol_measures(name):
    part = MEASURED[name]
    wanted = {column["value"] for column in part["columns"].values()}
    for row in models(part):
        _, found = measures(part["protocol"], trained(row))
        assert wanted <= found | ABOUT.keys(), f"{part['protocol']} measures {sorted(found)}"


@pytest.mark.parametrize("name", MEASURED)
def test_rows_are_sampled_in_ways_that_their_processes_have(name):
    for row in models(MEASURED[name]):
        config = recipe(trained(row))
        diffusion = config["process"]["_target_"].endswith("GaussianDiffusion")
        samplers = (GaussianDiffusion if diffusion else FlowMatching).samplers
        assert row.get("sampler", config["task"]["sampler"]) in samplers
        if diffusion:
            steps = row.get("num_inference_steps", 1)  # a number, several numbers, or lists of the steps themselves
            assert np.max(steps) <= config["process"]["num_train_timesteps"]
        assert "until" not in row or not diffusion


def extracted(path: str) -> tuple[str, str]:
    """Kind and data set of an extractor, by its path."""
    if path.startswith("runs/"):
        return "MotionCLIPExtractor", recipe(trained({"ckpt": path}))["data"]["name"]
    if path.startswith("assets/t2m/"):
        return "T2MExtractor", Path(path).name
    if path == "assets/humanact12":
        return "UnconstrainedExtractor", "humanact12"
    return ("ClassifierExtractor", Path(path).parent.name) if path else ("", "")


def wanted_extractor(protocol: Any, config: Config) -> tuple[str, str]:
    """Kind and data set of the extractor that a protocol needs for a recipe."""
    if protocol.extractor is None:
        return "", ""
    data = config["data"]["name"].removesuffix("-all")  # stores of published splits
    return protocol.extractor["_target_"].rpartition(".")[2], data


@pytest.mark.parametrize("name", [name for name in MEASURED if name.partition(":")[0] in PAPERS])
def test_rows_are_checkpoints_of_recipes_that_fit(name):
    part = MEASURED[name]
    for row in part["rows"]:
        config = recipe(trained(row))
        chosen = Path(row["ckpt"]).stem == "best"
        assert chosen == bool(config["callbacks"]["best"]), f"{row['label']}: best.ckpt only where clips are validated"
        protocol, _ = measures(part["protocol"], trained(row))
        labels = config["condition"].get("_target_", "").endswith("ActionLabels")
        assert protocol.condition in ("none", "action" if labels else "text")
        assert extracted(part.get("extractor", "")) == wanted_extractor(protocol, config)


UNREAD = "humanml3d/mdm_motion272"
"""Recipe of features that no evaluator reads."""


@pytest.mark.parametrize("name", [n for n in recipes() if n.startswith(("humanml3d/", "kit/", "babel/"))])
def test_papers_checkpoints_are_chosen_by_fid(name):
    if name == UNREAD:
        assert "evaluate" not in recipe(name)["callbacks"]
        return
    callbacks = recipe(name)["callbacks"]
    evaluate = callbacks["evaluate"]
    protocol, _ = measures(evaluate["protocol"], name)
    assert callbacks["best"]["monitor"] == f"val/{evaluate['protocol']}/fid"
    assert protocol.metrics["fid"]["_target_"].endswith("FrechetMotionDistance")
    assert extracted(evaluate["extractor"]) == wanted_extractor(protocol, recipe(name))
    assert 512 <= evaluate["samples"] <= 1000
    assert recipe(name)["trainer"]["max_steps"] % evaluate["every_n_steps"] == 0, "the last step is evaluated"


@pytest.mark.parametrize("name", [name for name in MEASURED if name.partition(":")[0] in PAPERS])
def test_seconds_are_those_of_one_motion_as_the_papers_have_them(name):
    part = MEASURED[name]
    for column in part["columns"].values():
        if column["value"] == "seconds_per_sample":
            assert column.get("protocol", part["protocol"]) == "latency"


@pytest.mark.parametrize("name", ["prediction", "in_between", "interpolation", "upper_body"])
def test_edits_are_measured_alike_by_both_extractors(name):
    clip, t2m = (protocol_config(f"editing_{name}{end}") for end in ("", "_t2m"))
    assert t2m.pop("extractor")["_target_"].endswith(".T2MExtractor")
    assert clip.pop("extractor")["_target_"].endswith(".MotionCLIPExtractor")
    expected = yaml.safe_load((EXPERIMENTS / "evaluation" / "text_to_motion_t2m.yaml").read_text())["expected"]
    assert t2m.pop("expected") == {data: {"fid": values["fid"]} for data, values in expected.items()}
    assert t2m == clip | {"name": f"editing_{name}_t2m"}


def test_small_models_say_what_they_predict():
    page = (Path(__file__).parent.parent / "docs" / "benchmarks" / "synthetic.md").read_text()
    for name in ("synthetic", "bandai"):
        part = next(iter(SPECS[name]["parts"].values()))
        assert part["columns"]["Predicts"] == {"value": "prediction"}
        for row in models(part):
            process = recipe(trained(row))["process"]
            assert name != "synthetic" or f"| {row['label']} <sup>a</sup> | {process['prediction']} |" in page


@pytest.mark.parametrize("name", sorted(path.stem for path in (EXPERIMENTS / "evaluation").glob("*.yaml")))
def test_protocols_cite_tables_of_their_task(name):
    text = (EXPERIMENTS / "evaluation" / f"{name}.yaml").read_text()
    head = re.sub(r"\n# ", " ", text.partition("\nversion:")[0])
    for paper, numbers in re.findall(r"(FLAME|MDM|MFM)(?:,|'s) tables? (\d(?:(?:,| and| to) \d)*)", head):
        for number in re.findall(r"\d", numbers):
            parts = SPECS[f"{paper.lower()}_{number}"]["parts"].values()
            tasks = {protocol_config(part["protocol"])["condition"] for part in parts if "protocol" in part}
            assert tasks == {yaml.safe_load(text)["condition"]}, f"{paper}, table {number}"


def test_arrows_are_those_of_the_paper():
    assert SPECS["mdm_5"]["parts"]["HumanAct12"]["columns"]["Diversity"]["better"] == "higher"


def test_motion_lengths_are_those_of_data_sets():
    for part in (part for part in PARTS.values() if "lengths" in part):
        assert all((EXPERIMENTS / "data" / f"{name}.yaml").is_file() for name in part["lengths"])


def test_a_published_column_without_a_counterpart_is_refused(tmp_path):
    spec = SPECS["mdm_2"]
    columns = {label: column for label, column in spec["parts"]["KIT-ML"]["columns"].items() if label != "FID"}
    narrow = spec | {"parts": {"KIT-ML": spec["parts"]["KIT-ML"] | {"columns": columns}}}
    with pytest.raises(UserError, match="no column is called FID"):
        builder.build("mdm_2", narrow, tmp_path, sizes)


# What the papers say of themselves, twice or in other places ----------------------------------------------------------


def test_no_row_is_missing():
    counts = {name: len(part["rows"]) for name, part in REPORTED.items() if name not in SETTINGS}
    assert counts == {
        "flame_1: HumanML3D": 5,
        "flame_1: BABEL": 5,
        "flame_2: KIT-ML": 5,
        "flame_3: HumanML3D": 2,
        "flame_4: HumanML3D": 4,
        "flame_5: HumanML3D": 8,
        "flame_9: DDPM": 9,
        "flame_9: DDIM": 9,
        "flame_10: HumanML3D": 6,
        "mdm_1: HumanML3D": 13,  # three of them the authors' corrections
        "mdm_2: KIT-ML": 5,
        "mdm_3: HumanAct12": 7,
        "mdm_4: UESTC": 5,
        "mdm_5: HumanAct12": 3,
        "mdm_6: HumanML3D": 5,
        "mdm_7: HumanAct12": 7,
        "mdm_figure_4: User study": 1,
        "mfm_1: KIT-ML": 8,
        "mfm_2: HumanML3D": 8,
        "mfm_3: Prediction": 2,
        "mfm_3: Upper body": 2,
        "mfm_3: In-between": 2,
        "mfm_figure_4: HumanML3D": 2,
    }


def test_cells_that_are_empty_are_empty_in_the_papers():
    holes = {}
    for name, part in REPORTED.items():
        columns = {column for row in part["rows"] for column in row["values"]}
        holes[name] = sum(len(columns - row["values"].keys()) for row in part["rows"] if "source" not in row)
    assert {name: count for name, count in holes.items() if count} == {
        "mdm_1: HumanML3D": 3 + 2 * 10,  # multimodality of real motions, JL2P, Text2Gesture; top 1 and 2 of all
        "mdm_2: KIT-ML": 3,
        "mfm_1: KIT-ML": 3,  # NFE of what generates frame by frame
        "mfm_2: HumanML3D": 4,
    }


def test_flame_repeats_its_main_row():
    main = reported("flame_1", "HumanML3D")["FLAME (Ours)"]
    assert main == reported("flame_4", "HumanML3D")["+ frozen language model"]
    assert {"Sampling steps": "1,000"} | main == PUBLISHED["flame_9"]["DDPM"]["rows"][0]["values"]


def test_mdm_repeats_its_main_rows():
    text, steps = reported("mdm_1", "HumanML3D"), reported("mdm_6", "HumanML3D")
    assert steps["Real"] == text["Real"]
    assert steps["T = 1000"].items() <= text["MDM (ours)"].items()
    actions, losses = reported("mdm_3", "HumanAct12"), reported("mdm_7", "HumanAct12")
    assert losses["Real"] == actions["Real (ours)"]
    for label in ("MDM (ours)", "w/o foot contact"):
        assert losses[label] == actions[label]


def test_real_motions_have_what_protocols_expect():
    expected = yaml.safe_load((EXPERIMENTS / "evaluation" / "text_to_motion_t2m.yaml").read_text())["expected"]
    names = {
        "motions_for_text/top3": "R precision (top 3)",
        "mm_dist": "MM-Dist",
        "diversity": "Diversity",
        "fid": "FID",
    }
    for table, part, data in (("mdm_1", "HumanML3D", "humanml3d"), ("mdm_2", "KIT-ML", "kit")):
        real = reported(table, part)["Real"]
        assert {n: float(real[c].split()[0]) for n, c in names.items()} == {n: expected[data][n][0] for n in names}


def test_mfm_counts_parameters_and_calls_alike_in_its_tables():
    kit, humanml3d = PUBLISHED["mfm_1"]["KIT-ML"]["rows"], PUBLISHED["mfm_2"]["HumanML3D"]["rows"]
    assert [row for row in humanml3d if row["label"] != "MotionGPT"] == kit[:-1]
    assert kit[-1] == {"label": "Our MFM", "values": {"NFE": "50", "Parameters, M": "17.9M"}}
    assert round(settings("humanml3d/mfm")["parameters"], 1) == 17.9


def test_fewer_steps_take_less_time_and_give_a_larger_distance():
    seconds = [float(row["values"]["Seconds per motion"]) for row in PUBLISHED["flame_5"]["HumanML3D"]["rows"]]
    assert seconds == sorted(seconds)
    for part in ("DDPM", "DDIM"):
        distances = [float(row["values"]["FD"]) for row in PUBLISHED["flame_9"][part]["rows"]]
        assert distances == sorted(distances)


def test_r_precision_grows_with_k():
    for name, part in REPORTED.items():
        for row in part["rows"]:
            tops = [row["values"].get(f"R precision (top {k})") for k in (1, 2, 3)]
            if None not in tops:
                shares = [float(top) for top in tops]
                assert shares == sorted(shares), f"{name}, {row['label']}"
                assert shares[2] <= 1, "a share, in all tables"


# How settings stand beside reported ones ------------------------------------------------------------------------------


def test_each_setting_stands_beside_the_reported_one(tmp_path):
    (part,) = builder.build("flame_6", SPECS["flame_6"], tmp_path, sizes).parts
    assert list(part.columns) == ["HumanML3D", "HumanML3D, reported", "BABEL", "BABEL, reported"]
    lines = {line.label: [cell and cell.text for cell in line.cells] for line in part.lines}
    assert lines["Maximum text length"] == ["20", "20 words", "20", "20 words"]
    assert list(lines) == list(SPECS["flame_6"]["parts"]["HumanML3D and BABEL"]["keys"])


def test_recipes_stand_in_rows_where_there_are_more_of_them(tmp_path):
    (part,) = builder.build("mdm_8", SPECS["mdm_8"], tmp_path, sizes).parts
    assert list(part.columns) == ["Parameters, M", "Parameters, M, reported"]
    lines = {line.label: [cell and cell.text for cell in line.cells] for line in part.lines}
    assert lines["U-net"] == ["23.57", "23.47"]
    assert "Action-to-motion has 512 more parameters per class." in [text for _, text in part.notes]


def test_settings_that_no_paper_reports_stand_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(builder, "PUBLISHED", tmp_path / "absent.yaml")
    (part,) = builder.build("flame_6", SPECS["flame_6"], tmp_path, sizes).parts
    assert list(part.columns) == ["HumanML3D", "BABEL"]


def test_the_docs_tell_what_each_table_needs():
    page = (Path(__file__).parent.parent / "docs" / "tables.md").read_text()
    lines = [line for line in page.partition("## All tables")[2].splitlines() if line.startswith("| `")]
    for name, spec in SPECS.items():
        (line,) = [line for line in lines if f"`{name}`" in line.split("|")[1]]
        for part in spec["parts"].values():
            wanted = {trained(row) for row in part.get("rows", []) if "ckpt" in row}
            if kind := extracted(part.get("extractor", ""))[0]:
                extractor = part["extractor"]
                wanted.add(trained({"ckpt": extractor}) if kind == "MotionCLIPExtractor" else extractor)
            wanted |= {*part.get("lengths", []), *filter(None, [part.get("ratings")])}
            assert all(f"`{needed}`" in line for needed in wanted), f"{name}: {sorted(wanted)}"
