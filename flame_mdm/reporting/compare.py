"""Side-by-side comparison of runs on one web page."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.config import flatten
from flame_mdm.errors import UserError
from flame_mdm.reporting.page import number, page, render
from flame_mdm.reporting.plots import Curve, charts
from flame_mdm.reporting.report import charted, evaluation_title, last, marks, printed, sampling
from flame_mdm.runs import CONFIG, Result, Run, read_run

if TYPE_CHECKING:
    from markupsafe import Markup

    from flame_mdm.formats.motion import Motion

MOTIONS = (".npz", ".bvh", ".json")
"""Suffixes of the motion files that are compared. Not .npy, which does not store its frame rate."""
Prompt = tuple[str, int]
"""Requested caption or action, and the index of the motion among those with the same request."""


@dataclass
class ComparedRun:
    """A run, or a folder of motions, with its name on pages."""

    label: str
    folder: Path
    run: Run | None


def find(folders: Sequence[Path]) -> list[ComparedRun]:
    """Returns the runs in some folders, labeled by recipe and run name, or by folder where these are ambiguous.

    Raises:
        UserError: If there are fewer than two folders, or a folder holds neither a run nor motions.
    """
    if len(set(folders)) < 2:
        raise UserError(f'a comparison needs two or more runs: runs="A B", not {" ".join(map(str, folders))}')
    found = []
    for folder in folders:
        if (folder / CONFIG).exists():
            content = read_run(folder)
            found.append(ComparedRun(content.label, folder, content))
        elif any(path.suffix.lower() in MOTIONS for path in folder.glob("*")):
            found.append(ComparedRun(folder.name, folder, None))
        else:
            raise UserError(
                f"{folder}: neither a run (no config.yaml) nor a folder of motions (no {', '.join(MOTIONS)} files)"
            )
    labels = [compared.label for compared in found]
    return [replace(c, label=str(c.folder)) if labels.count(c.label) > 1 else c for c in found]


def shared(shown: Sequence[Mapping[Prompt, Motion]]) -> list[Prompt]:
    """Returns the prompts for which every run has a motion, in the order of the first run."""
    return [prompt for prompt in shown[0] if all(prompt in those for those in shown[1:])]


# Side by side ---------------------------------------------------------------------------------------------------------


def comparison(compared: Sequence[ComparedRun], shown: Sequence[Mapping[Prompt, Motion]]) -> str:
    """Returns the page that compares runs side by side. The same runs give the same bytes."""
    runs = {c.label: c.run for c in compared if c.run is not None}
    body = render(
        "compare.html",
        title=" · ".join(c.label for c in compared),
        labels=list(runs),
        facts=_facts(runs),
        differences=_differences(runs),
        player=_player(compared, shown),
        evaluations=_evaluations(runs),
        groups=_charts(runs),
    )
    return page("Comparison", body)


def _facts(runs: Mapping[str, Run]) -> list[list[str]]:
    rows = []
    for label, found in runs.items():
        facts = found.provenance
        row = [label, f"{found.steps:,}", number(last(found.curves.get("train/epochs", {})))]
        row += [f"{facts.parameters / 1e6:.2f} M" if facts and facts.parameters else "–"]
        row += [number(_median(found, f"train/{name}")) for name in ("seconds_per_step", "samples_per_second")]
        row += [facts.device, facts.data.fingerprint] if facts else ["–", "–"]
        rows.append([*row, str(found.folder)])
    return rows


def _median(found: Run, name: str) -> float | None:
    curve = found.curves.get(name)
    return statistics.median(curve.values()) if curve else None


def _differences(runs: Mapping[str, Run]) -> list[list[str]]:
    configs = [flatten(found.config) for found in runs.values()]
    keys = sorted({key for config in configs for key in config if key != "experiment" and not key.startswith("run.")})
    rows = [[key, *(str(config[key]) if key in config else "–" for config in configs)] for key in keys]
    return [row for row in rows if len(set(row[1:])) > 1]


def _player(compared: Sequence[ComparedRun], shown: Sequence[Mapping[Prompt, Motion]]) -> str:
    from flame_mdm.visualize import player_page

    scene = [
        replace(those[prompt], id=c.label, text=prompt[0] or "unconditioned")
        for prompt in shared(shown)
        for c, those in zip(compared, shown, strict=True)
    ]
    return player_page(scene, "", columns=len(compared)) if scene else ""


def _evaluations(runs: Mapping[str, Run]) -> list[tuple[str, list[str], list[list[str]], list[Any]]]:
    """Returns title, column titles, rows and notes of each table. Only comparable results share a table."""
    groups: dict[str, list[tuple[str, Result]]] = {}
    for label, found in runs.items():
        for result in found.results.values():
            title = f"{evaluation_title(result)}, data {result.data.fingerprint}"
            groups.setdefault(title, []).append((label, result))
    tables = []
    for title, columns in sorted(groups.items()):
        results = [result for _, result in columns]
        real = results[0].ground_truth or {}
        rows = [
            [name, printed(real.get(name)), *(printed((result.values or {}).get(name)) for result in results)]
            for name in sorted({name for result in results for name in result.values or {}})
        ]
        heads = [f"{label} [{k}]" for k, (label, _) in enumerate(columns, 1)]
        notes = [(sampling(result), marks(result)) for result in results]
        tables.append((title, ["", "real motions", *heads], rows, notes))
    return tables


def _charts(runs: Mapping[str, Run]) -> dict[str, list[Markup]]:
    names = {name for found in runs.values() for name in found.curves}
    groups: dict[str, list[Markup]] = {}
    for heading, titles in charted({name: {0: 0.0} for name in names}).items():
        shown: dict[str, tuple[dict[str, Curve], dict[str, Curve]]] = {}
        for name in (f"{family}/{rest}" for rest, families in titles.items() for family in families):
            lines: dict[str, Curve] = {k: found.curves[name] for k, found in runs.items() if name in found.curves}
            if len({value for line in lines.values() for value in line.values()}) > 1:
                shown[name] = lines, {label: runs[label].curves.get(f"{name}/ci", {}) for label in lines}
        groups[heading] = charts(shown)
    return groups
