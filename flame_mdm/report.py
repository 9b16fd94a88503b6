"""A run on one web page: `python -m flame_mdm.report runs/synthetic/mdm/default`"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, TypedDict

from flame_mdm.config import Config, UserError, load_yaml, run
from flame_mdm.results import check_shape, read_json, read_result, read_text
from flame_mdm.visualize.page import Curve, chart, frame, number, page, table
from flame_mdm.visualize.scene import written_whole

USAGE = """
usage: python -m flame_mdm.report RUN

Writes report.html into the folder of a run: its curves, newest samples, evaluations, and what it was made of, in one
page that needs no server and no network. Training writes it at its end, too. runs="A B" does several.
"""

HISTORY = "metrics.jsonl"
"""Where `flame_mdm.dashboards.History` keeps the curves of a run, in its folder."""
COST = ("lr", "grad_norm", "samples_per_second", "seconds_per_step", "gpu_memory_gib")
"""Curves of training that tell how it runs, not what it learns."""


@dataclass
class Run:
    """What the folder of a run holds.

    Attributes:
        folder: of the run.
        config: the recipe, as the run saved it.
        provenance: command, code, machine, versions, device, parameters and data; {} before training began.
        curves: values by step, by name.
        results: evaluations by the name of their file within the folder.
    """

    folder: Path
    config: Config
    provenance: dict[str, Any]
    curves: dict[str, dict[int, float]]
    results: dict[str, dict[str, Any]]

    @property
    def label(self) -> str:
        """Recipe and name of the run; the recipe alone for a run without a name of its own."""
        name = self.config["run"].get("name", "default")
        return str(self.config["experiment"]) + (f"/{name}" if name != "default" else "")

    @property
    def samples(self) -> Path | None:
        """The folder of the newest samples."""
        found = (path.parent for path in self.folder.glob("samples/step_*/player.html"))
        return max((folder for folder in found if folder.name.removeprefix("step_").isdecimal()), default=None)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and not words[0].startswith("-") and "=" not in words[0]:
        words[0] = f"runs={shlex.quote(words[0])}"
    return run(report, words, usage=USAGE, name="report", text=("runs",))


def report(config: Config) -> None:
    """Writes the report of each run.

    Raises:
        UserError: no run named, or a folder that holds none.
    """
    if config["runs"] is None:
        raise UserError("which run? python -m flame_mdm.report runs/synthetic/mdm/default")
    for folder in paths("runs", str(config["runs"])):
        print(write_report(folder))


def paths(key: str, given: str) -> list[Path]:
    """The files or folders that a key names, with spaces between them, and quotes around names with spaces.

    Raises:
        UserError: none, or a quote without its end.
    """
    try:
        names = shlex.split(given)
    except ValueError as error:
        raise UserError(f"{key}={given}: {error}; put names with spaces in quotes") from error
    if not all(names) or not names:
        raise UserError(f"{key}={given}: name at least one, with spaces between several")
    return [Path(name) for name in names]


def write_report(folder: Path) -> Path:
    """Writes `report.html` into the folder of a run, and returns its path. The same folder gives the same bytes.

    Raises:
        UserError: the folder holds no run, or a damaged file.
    """
    found = read_run(folder)
    parts = [_head(found), _fault(folder), _samples(found), _evaluations(found), _curves(found), _provenance(found)]
    path = folder / "report.html"
    with written_whole(path) as temporary:
        temporary.write_text(page(found.label, "\n".join(filter(None, parts))), encoding="utf-8")
    return path


# Reading --------------------------------------------------------------------------------------------------------------


class _Name(TypedDict, total=False):
    name: str | int | float


class _Steps(TypedDict):
    max_steps: int


class Recipe(TypedDict):
    """The configuration of a run, as far as pages read it."""

    experiment: str | None
    run: _Name
    trainer: _Steps


class _Trained(TypedDict, total=False):
    fingerprint: str


class _Provenance(TypedDict):
    command: list[str]
    commit: str | None
    python: str
    machine: str
    packages: dict[str, str]
    data: _Trained


class Provenance(_Provenance, total=False):
    """What a run was made of, as `flame_mdm.provenance` writes it."""

    changed: str | None
    device: str
    parameters: int


class _Part(TypedDict):
    rank: int
    batch: int
    loss: str
    ids: list[str]


class Fault(TypedDict):
    """The batch that stopped a run, as `flame_mdm.guards.BadLoss` writes it."""

    step: int
    usual_loss: str
    batches: list[_Part]


def read_run(folder: Path) -> Run:
    """What the folder of a run holds.

    Raises:
        UserError: no run, or a damaged file.
    """
    from omegaconf import OmegaConf

    path = folder / "config.yaml"
    if not path.is_file():
        raise UserError(f"{folder}: no config.yaml there; name the folder of a run, such as runs/synthetic/mdm/default")
    config: Any = OmegaConf.to_container(load_yaml(path))
    try:
        check_shape(config, Recipe)
    except ValueError as error:
        raise UserError(f"{path}: not the configuration of a run: {error}") from error
    made_of = folder / "provenance.json"
    remedy = "delete it, and the page leaves out what it told"
    results = {
        path.relative_to(folder).as_posix(): read_result(path)
        for path in sorted(folder.glob("evaluation/**/result*.json"))
    }
    provenance = read_json(made_of, Provenance, remedy) if made_of.exists() else {}
    return Run(folder, config, provenance, read_history(folder), results)


def read_history(folder: Path) -> dict[str, dict[int, float]]:
    """Curves of a run: values by step, in their order, by name.

    Args:
        folder: of the run; one without a history has no curves.

    Raises:
        UserError: the file is damaged.
    """
    curves: dict[str, dict[int, float]] = {}
    for record in records(folder / HISTORY):
        for name, value in record.items():
            if name not in ("step", "epoch"):
                curves.setdefault(name, {})[record["step"]] = value
    return {name: dict(sorted(curve.items())) for name, curve in sorted(curves.items())}


def records(path: Path) -> list[dict[str, Any]]:
    """The lines of a history. A last one that a kill has cut does not count.

    Raises:
        UserError: another line is damaged.
    """
    if not path.exists():
        return []
    *lines, _ = read_text(path).split("\n")
    found = []
    for place, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            check_shape(record, _Record)
            wrong = [name for name, value in record.items() if type(value) not in (int, float)]
            if wrong or record["step"] < 0:
                raise ValueError(f"{', '.join(wrong) or 'step'} should be a number")
            json.dumps(record, ensure_ascii=False).encode()  # half a character cannot be written again
        except (ValueError, RecursionError) as error:
            raise UserError(f"{path}: line {place} is damaged; delete that line ({error})") from error
        found.append(record)
    return found


class _Record(TypedDict):
    step: int


# Parts of the page ----------------------------------------------------------------------------------------------------


def last(curve: Curve) -> float | None:
    """The newest value of a curve."""
    return curve[max(curve)] if curve else None


def steps(found: Run) -> int:
    """Steps of which the run has curves."""
    return max((max(curve) + 1 for name, curve in found.curves.items() if name.startswith("train/")), default=0)


def _head(found: Run) -> str:
    facts = [f"step {steps(found):,} of {found.config['trainer']['max_steps']:,}"]
    if (epochs := last(found.curves.get("train/epochs", {}))) is not None:
        facts.append(f"{number(epochs)} passes over the data")
    if "parameters" in found.provenance:
        facts.append(f"{found.provenance['parameters'] / 1e6:.2f} M parameters")
    if (seconds := last(found.curves.get("train/seconds_per_step", {}))) is not None:
        facts.append(f"{seconds:.3g} s a step")
    if "device" in found.provenance:
        facts.append(found.provenance["device"])
    return f"<h1>{escape(found.label)}</h1><p class='faint'>{escape(' · '.join(facts))}</p>"


def _fault(folder: Path) -> str:
    path = folder / "bad_batch.json"
    if not path.exists():
        return ""
    fault = read_json(path, Fault, "delete it, and the page leaves it out")
    rows = [[f"process {b['rank']}, batch {b['batch']}", b["loss"], ", ".join(b["ids"])] for b in fault["batches"]]
    told = f"Training stopped at step {fault['step']}: a bad loss, where {fault['usual_loss']} was usual"
    return f"<div class='fault'>{escape(told)}</div>" + table(["", "loss", "clips"], rows)


def _samples(found: Run) -> str:
    if found.samples is None:
        return ""
    player = read_text(found.samples / "player.html")
    step = int(found.samples.name.removeprefix("step_"))
    return f"<h2>Samples at step {step:,}</h2>{frame(player, 640)}"


def _curves(found: Run) -> str:
    if not found.curves:
        return f"<h2>Curves</h2><p class='faint'>None: there is no {HISTORY} in the folder.</p>"
    parts = []
    for title, charts in charted(found.curves).items():
        drawn = []
        for name, both in charts.items():
            lines = {family: found.curves[f"{family}/{name}"] for family in both}
            widths = {family: found.curves.get(f"{family}/{name}/ci", {}) for family in both}
            drawn.append(chart(name, lines, widths))
        parts.append(f"<h2>{title}</h2><div class='charts'>{''.join(drawn)}</div>")
    if constant := constants(found.curves):
        told = ", ".join(f"{name} {number(value)}" for name, value in constant.items())
        parts.append(f"<p class='faint'>Constant: {escape(told)}</p>")
    return "".join(parts)


def charted(curves: Mapping[str, Curve]) -> dict[str, dict[str, list[str]]]:
    """Which curves stand in one chart: those of training and validation with the same name.

    Returns:
        The first parts of their names (`train`, `val`) by the rest of it (`loss`), by heading.
    """
    groups: dict[str, dict[str, list[str]]] = {
        "Losses": {},
        "Validation": {},
        "Samples of the prompts": {},
        "Course": {},
    }
    for name in curves.keys() - constants(curves).keys():
        family, _, rest = name.partition("/")
        if rest.endswith("/ci") or rest == "epochs":
            continue
        heading = {"samples": "Samples of the prompts", "val": "Validation"}.get(family, "Course")
        if f"train/{rest}" in curves and rest not in COST:
            heading = "Losses"
        groups[heading].setdefault(rest, []).append(family)
    return {title: {n: sorted(g[n]) for n in sorted(g)} for title, g in groups.items() if g}


def constants(curves: Mapping[str, Curve]) -> dict[str, float]:
    """Values of curves that have one all along."""
    values = {
        name: set(curve.values()) for name, curve in curves.items() if len(curve) > 1 and not name.endswith("/ci")
    }
    return {name: next(iter(found)) for name, found in values.items() if len(found) == 1}


def _evaluations(found: Run) -> str:
    if not found.results:
        return ""
    return f"<h2>Evaluations</h2><div class='results'>{''.join(map(_evaluation, found.results.values()))}</div>"


def _evaluation(result: Mapping[str, Any]) -> str:
    rows = [
        [name, interval((result["ground_truth"] or {}).get(name)), interval((result["values"] or {}).get(name))]
        for name in sorted({**(result["values"] or {}), **(result["ground_truth"] or {})})
    ]
    notes = "".join(f"<p class='bad'>{escape(mark)}</p>" for mark in marks(result))
    notes += "".join(
        f"<p class='faint'>{escape(f'not computed: {name}: {why}')}</p>" for name, why in result["not_computed"].items()
    )
    return (
        f"<div><h3>{escape(evaluation_title(result))}</h3><p class='faint'>{escape(sampling(result))}</p>{notes}"
        f"{table(['', 'real motions', 'generated'], rows, numbers=True)}</div>"
    )


def evaluation_title(result: Mapping[str, Any]) -> str:
    """What was evaluated, and by what."""
    protocol, extractor = result["protocol"], result["extractor"]
    measured = f", extractor {extractor['sha256'][:8]}" if extractor else ""
    return f"{protocol['name']} version {protocol['version']}, {result['data']['dataset']} {result['split']}{measured}"


def sampling(result: Mapping[str, Any]) -> str:
    """How the evaluated motions were sampled."""
    checkpoint, cost = result["checkpoint"], result.get("cost") or {}
    if checkpoint is None:
        return "motions of others"
    words = [
        f"{Path(checkpoint['path']).name} ({checkpoint['sha256'][:8]})",
        f"{checkpoint['sampler']}, {checkpoint['num_inference_steps']} steps",
        f"guidance {checkpoint['guidance_scale']:g}",
        f"seed {result['seed']}",
    ]
    if cost.get("seconds_per_sample") is not None:
        words.append(f"{cost['seconds_per_sample']:.3g} s a motion on {result['device']}")
    return ", ".join(words)


def marks(result: Mapping[str, Any]) -> list[str]:
    """Why a result is less than a result."""
    found = ["quick: not a result"] if result["quick"] else []
    found += [f"not valid: {reason}" for reason in result["invalid_because"]]
    changed = ", ".join(f"{name} {value}" for name, value in (result.get("changed") or {}).items())
    return found + ([f"not as the protocol has it: {changed}"] if changed and not result["quick"] else [])


def interval(value: Mapping[str, Any] | None) -> str:
    """Mean and half of its interval."""
    if value is None or value["mean"] is None:
        return "–"
    return number(value["mean"]) + (f" ± {value['ci']:.2g}" if value["ci"] is not None else "")


def _provenance(found: Run) -> str:
    from omegaconf import OmegaConf

    facts = found.provenance
    rows = []
    if facts:
        changed = " with changes that were not committed" if facts.get("changed") else ""
        rows = [
            ["command", " ".join(facts["command"])],
            ["commit", (facts["commit"] or "not from a clone") + changed],
            ["data", ", ".join(f"{k} {v}" for k, v in facts["data"].items() if k != "actions")],
            ["device", facts.get("device", "–")],
            ["machine", f"{facts['machine']}, Python {facts['python']}"],
            ["packages", ", ".join(f"{name} {version}" for name, version in facts["packages"].items())],
        ]
    recipe = escape(OmegaConf.to_yaml(OmegaConf.create(found.config)))
    known = table(["", ""], rows) if rows else ""
    return f"<h2>Made of</h2>{known}<details><summary>configuration</summary><pre>{recipe}</pre></details>"


if __name__ == "__main__":
    sys.exit(main())
