"""Side-by-side comparison of runs on one web page."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flame_mdm.config import flatten
from flame_mdm.errors import UserError
from flame_mdm.formats import ENDINGS
from flame_mdm.records import Result, Value
from flame_mdm.reporting.page import filled, number, page, render
from flame_mdm.reporting.plots import Curve, chart
from flame_mdm.reporting.report import (
    charted,
    evaluation_title,
    labeled,
    last,
    marks,
    printed,
    sampling,
)
from flame_mdm.runs import CONFIG, Run, read_run

if TYPE_CHECKING:
    from markupsafe import Markup
    from numpy.typing import ArrayLike

    from flame_mdm.formats.motion import Motion
    from flame_mdm.visualize.body import Mesh

# The requested caption or action, and the index of a motion among the motions with the same request
Prompt = tuple[str, int]
# First frame, last frame (exclusive), kind and description of a span on a timeline
Mark = tuple[int, int, str, str]


@dataclass(frozen=True)
class ComparedRun:
    """A run, or a folder of motion files, with its label on the page.

    `run` is None for a folder of motion files.
    """

    label: str
    folder: Path
    run: Run | None


def find(folders: Sequence[Path]) -> list[ComparedRun]:
    """Returns the runs and the folders of motion files to compare. At least two are required.

    The label of a run consists of the recipe and the run name. The label of a folder is its name.
    Identical labels are replaced by paths.
    """
    if len(set(folders)) < 2:
        raise UserError(
            f'runs={" ".join(map(str, folders))}: a comparison needs two or more runs. Set runs="A B"'
        )

    compared = []
    for folder in folders:
        if not (folder / CONFIG).exists() and folder.is_dir() and _direct_motions(folder):
            compared.append(ComparedRun(folder.name, folder, None))
        else:
            run = read_run(folder)
            compared.append(ComparedRun(run.label, folder, run))

    labels = Counter(entry.label for entry in compared)
    return [
        entry if labels[entry.label] == 1 else replace(entry, label=str(entry.folder))
        for entry in compared
    ]


def _direct_motions(folder: Path) -> list[Path]:
    """Returns the motion files directly inside a folder, sorted and without hidden files."""
    files = (
        path for path in folder.iterdir() if path.suffix.lower() in ENDINGS and path.name[0] != "."
    )
    return sorted(file for file in files if file.is_file())


def read_motions(folder: Path) -> dict[Prompt, Motion]:
    """Reads the motion files in a folder and returns the motions, keyed by prompt."""
    from flame_mdm.formats.readers import read

    numbered: dict[Prompt, Motion] = {}
    counts: Counter[str] = Counter()
    for motion in map(read, _direct_motions(folder)):
        numbered[motion.text, counts[motion.text]] = motion
        counts[motion.text] += 1
    return numbered


def in_all(shown: Sequence[Mapping[Prompt, Motion]]) -> list[Prompt]:
    """Returns the prompts for which all runs have motions, in the order of the first run."""
    return [prompt for prompt in shown[0] if all(prompt in motions for motions in shown)]


def only_runs(compared: Sequence[ComparedRun]) -> dict[str, Run]:
    """Returns the runs, keyed by label, without the folders of motions."""
    return {entry.label: entry.run for entry in compared if entry.run is not None}


def comparison(
    compared: Sequence[ComparedRun],
    shown: Sequence[Mapping[Prompt, Motion]],
    mesh: Mesh | None = None,
    evidence: Callable[[Motion], Sequence[Mark]] = lambda motion: (),
) -> str:
    """Returns a page that compares runs side by side. The same runs always yield the same bytes.

    Args:
        compared: runs and folders of motions.
        shown: the motions of each run and folder, keyed by prompt. The page plays the motions for
            the prompts that all runs and folders share.
        mesh: the body to draw.
        evidence: function that returns the marks for the timeline of a motion.
    """
    runs = only_runs(compared)
    labels = [entry.label for entry in compared]
    body = render(
        "compare.html",
        title=" · ".join(labels),
        labels=list(runs),
        facts=_facts(runs) if runs else None,
        differences=_differences(runs),
        player=_player(labels, shown, mesh, evidence),
        evaluations=_evaluations(runs),
        unpaired=in_common(runs),
        columns=HEAD,
        explained=EXPLAINED,
        groups=_charts(runs),
    )
    return page("Comparison", body)


def _facts(runs: Mapping[str, Run]) -> tuple[list[str], list[list[str]]]:
    head = (
        "run",
        "steps",
        "passes",
        "parameters",
        "s/step",
        "samples per second",
        "device",
        "data",
        "folder",
    )
    rows = []
    for label, run in runs.items():
        facts = run.provenance
        row = [label, f"{run.steps:,}", number(last(run.curves.get("train/epochs", {})))]
        row += [f"{facts.parameters / 1e6:.2f} M" if facts and facts.parameters else "–"]
        curves = [
            run.curves.get(f"train/{name}") for name in ("seconds_per_step", "samples_per_second")
        ]
        row += [number(statistics.median(curve.values()) if curve else None) for curve in curves]
        row += [facts.device, facts.data.fingerprint] if facts else ["–", "–"]
        rows.append([*row, str(run.folder)])
    return filled(head, rows)


def _differences(runs: Mapping[str, Run]) -> list[list[str]]:
    configs = [flatten(run.config) for run in runs.values()]
    keys = sorted(
        {
            key
            for config in configs
            for key in config
            if key != "experiment" and not key.startswith("run.")
        }
    )
    rows = [
        [key, *(str(config[key]) if key in config else "–" for config in configs)] for key in keys
    ]
    return [row for row in rows if len(set(row[1:])) > 1]


def _player(
    labels: Sequence[str],
    shown: Sequence[Mapping[Prompt, Motion]],
    body: Mesh | None,
    evidence: Callable[[Motion], Sequence[Mark]],
) -> str:
    """Returns a player with the motions for the prompts that all runs share, in the first run's order."""
    from flame_mdm.visualize import player_page

    scene = [
        replace(motions[prompt], id=label, text=prompt[0] or "unconditioned")
        for prompt in in_all(shown)
        for label, motions in zip(labels, shown, strict=True)
    ]
    spans = [evidence(motion) for motion in scene]
    return player_page(scene, "", columns=len(labels), marks=spans, body=body) if scene else ""


HEAD = ["", "difference", "95 % over replications", ""]  # column titles of differences
EXPLAINED = (
    "Differences between motions for the same texts and noise. The intervals cover "
    "the variation between replications, which differ in captions, crops and noise, but not the "
    "variation between training runs. A difference is shown if its interval does not contain 0. "
    "Of 20 metrics that do not differ, one is shown by chance on average."
)


def differences(first: Result, second: Result) -> list[list[str]] | str:
    """Returns rows for `HEAD` with the differences in all metrics, or the reason why there are none.

    Both results must come from the same evaluation: the same protocol, data and extractor.
    """
    if invalid := [*first.invalid_because, *second.invalid_because]:
        return f"not compared: not valid: {invalid[0]}"
    paired = [(r.seed, r.data.frames, r.skeleton) for r in (first, second)]
    if paired[0] != paired[1]:
        return (
            "not compared: the seeds, length limits or skeletons differ, so the motions "
            "are not paired"
        )
    one, two = first.values or {}, second.values or {}
    rows = [_difference(name, one[name], two[name]) for name in sorted(one.keys() & two.keys())]
    return [row for row in rows if row] or (
        "not compared: no metric has values per replication for the same number of motions. "
        "Results from earlier versions have no such values. Evaluate both again; the motions are "
        "not generated again"
    )


def _difference(name: str, first: Value | None, second: Value | None) -> list[str]:
    """Returns table cells for the difference second - first, or [] if there are no pairs of values."""
    if first is None or second is None or first.n != second.n:
        return []
    count = min(len(first.per_replication), len(second.per_replication))
    one, two = (np.array(value.per_replication[:count], float) for value in (first, second))
    if not count or np.isnan(one + two).any():
        return []
    mean, low, high = paired_difference(one, two)
    if count == 1:
        return [labeled(name, first), number(mean), "–", "not tested: only one replication"]
    shown = "higher" if low > 0 else "lower" if high < 0 else "no difference shown"
    return [labeled(name, first), number(mean), f"[{number(low)}, {number(high)}]", shown]


def paired_difference(first: ArrayLike, second: ArrayLike) -> tuple[float, float, float]:
    """Returns the mean of second - first over R pairs, and the bounds of its 95 % interval.

    The interval uses Student's t distribution. It is NaN if R is 1.
    """
    from scipy.stats import t

    difference = np.subtract(second, first)
    count, mean = len(difference), float(difference.mean())
    half = (
        float(t.ppf(0.975, count - 1) * difference.std(ddof=1) / count**0.5)
        if count > 1
        else float("nan")
    )
    return mean, mean - half, mean + half


def grouped(runs: Mapping[str, Run]) -> dict[str, list[tuple[str, Result]]]:
    """Groups results by protocol, data and extractor.

    Returns the run labels and results, keyed by title.
    """
    groups: dict[str, list[tuple[str, Result]]] = {}
    for label, run in runs.items():
        for result in run.results.values():
            title = f"{evaluation_title(result)}, data {result.data.fingerprint}"
            groups.setdefault(title, []).append((label, result))
    return dict(sorted(groups.items()))


def in_common(runs: Mapping[str, Run]) -> list[str]:
    """Explains why no evaluations can be compared. Returns [] if two runs share an evaluation."""
    groups = grouped(runs)
    if len(runs) < 2 or any(
        len({label for label, _ in columns}) > 1 for columns in groups.values()
    ):
        return []
    return [
        "No evaluation in common: differences need the same protocol, data and extractor.",
        *groups,
    ]


def tested(columns: Sequence[tuple[str, Result]]) -> list[tuple[str, list[list[str]]]]:
    """Returns tables (titles and rows, see `HEAD`) of the differences from the first result."""
    (first, base), *others = columns
    tables = []
    for index, (label, result) in enumerate(others, 2):
        rows = differences(base, result)
        title = f"[{index}] {label} − [1] {first}"
        tables.append((f"{title}: {rows}", []) if isinstance(rows, str) else (title, rows))
    return tables


def _evaluations(
    runs: Mapping[str, Run],
) -> list[tuple[str, list[str], list[list[str]], list[Any], list[Any]]]:
    tables = []
    for title, columns in grouped(runs).items():
        results = [result for _, result in columns]
        real = results[0].ground_truth or {}
        rows = []
        for name in sorted({name for result in results for name in result.values or {}}):
            values = [(result.values or {}).get(name) for result in results]
            label = labeled(name, next(filter(None, values), None))
            rows.append([label, printed(real.get(name)), *map(printed, values)])
        heads = [f"{label} [{k}]" for k, (label, _) in enumerate(columns, 1)]
        notes = [(sampling(result), marks(result)) for result in results]
        tables.append((title, *filled(["", "real motions", *heads], rows), notes, tested(columns)))
    return tables


def _charts(runs: Mapping[str, Run]) -> dict[str, list[Markup]]:
    groups: dict[str, list[Markup]] = {}
    for heading, titles in charted({name for run in runs.values() for name in run.curves}).items():
        groups[heading] = []
        for name in (
            f"{family}/{rest}" for rest, families in titles.items() for family in families
        ):
            lines: dict[str, Curve] = {
                label: run.curves.get(name, {}) for label, run in runs.items()
            }
            if len({value for line in lines.values() for value in line.values()}) > 1:
                bands = {label: run.curves.get(f"{name}/ci", {}) for label, run in runs.items()}
                groups[heading].append(chart(name, lines, bands))
    return groups
