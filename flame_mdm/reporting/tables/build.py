"""Builds tables from existing results, published numbers, recipes, motion lengths and ratings."""

import functools
import math
import re
import string
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.config import Config
from flame_mdm.errors import UserError
from flame_mdm.records import Result, Value, read_result
from flame_mdm.reporting.audit_cards import card_of
from flame_mdm.reporting.plots import Histogram
from flame_mdm.reporting.study import Ratings
from flame_mdm.reporting.tables.format import Cell, Line, Part, Table, ranks
from flame_mdm.reporting.tables.settings import settings_table
from flame_mdm.reporting.tables.specs import (
    ABOUT,
    PUBLISHED,
    SWEPT,
    Figure,
    Lengths,
    evaluations,
    load_mapping,
)
from flame_mdm.runs import made_by
from flame_mdm.schemas import read_json

NOT_VALID = "NOT VALID"  # state of a row that is shown but not ranked
PUBLISHED_SPLIT = (
    "Published split: test clips are also used for training, or there are no validation clips."
)
FORCED = "Forced: real motions do not have the values that the protocol expects."


def build(name: str, spec: Config, results: Path) -> Table:
    """Builds the table that a spec describes, from existing results and published numbers.

    Raises `UserError` if the results, the published numbers and the spec do not match.
    """
    published = (
        _published(PUBLISHED, PUBLISHED.stat().st_mtime_ns).get(name, {})
        if PUBLISHED.exists()
        else {}
    )
    unknown = published.keys() - spec["parts"].keys()
    if unknown:
        raise UserError(
            f"{PUBLISHED}: {name} has parts that are not in its spec: {', '.join(sorted(unknown))}"
        )
    table = Table(name, spec["title"], [], spec.get("notes", []))
    for part_name, part in spec["parts"].items():
        if "recipes" in part:
            built = settings_table(part_name, part, published.get(part_name))
        elif "lengths" in part:
            built = _lengths(part_name, part, results)
        elif "ratings" in part:
            built = _ratings(part_name, Path(part["ratings"]), published.get(part_name))
        else:
            built = _measured(part_name, part, published.get(part_name), results)
        built.figures = [
            Figure(**figure) for figure in spec.get("figures", []) if figure["part"] == part_name
        ]
        table.parts.append(built)
    return table


@functools.cache
def _published(path: Path, changed: int) -> Config:
    """Returns the published numbers. They are cached until the file changes."""
    return load_mapping(path)


def _measured(name: str, part: Config, reported: Config | None, results: Path) -> Part:
    columns = {label: column.get("better", "none") for label, column in part["columns"].items()}
    values = [column["value"] for column in part["columns"].values()]
    # Distinct conditions of the rows, each of which has a footnote
    conditions: list[dict[str, str]] = []
    lines: list[Line] = []
    truths: dict[str, Line] = {}
    missing: list[tuple[str, str]] = []
    # Columns to which each footnote applies, for rows with several footnotes
    measured_under: dict[str, dict[str, None]] = {}
    shows_multimodality = any(value.startswith("multimodality") for value in values)
    for row, needed in evaluations(part):
        paths = [evaluation.path(results) for evaluation in needed]
        read = [read_result(path) if path.exists() else None for path in paths]
        line = _line(row, read, values, [path.name for path in paths])
        lines.append(line)
        if not any(read):
            line.state = next(iter(needed[0].absent), "not evaluated")
        for evaluation, result in zip(needed, read, strict=True):
            if result is None:
                commands = [made_by(path) for path in evaluation.absent.values()] or [
                    "make tables evaluates this row"
                ]
                missing += [(line.label, command) for command in commands]
        timed = {
            path for path, value in zip(paths, values, strict=True) if value == "seconds_per_sample"
        }
        letters: dict[str, str] = {}  # letters of footnotes by column
        for label, path, result in zip(columns, paths, read, strict=True):
            if result is not None:
                letters[label] = _letter(
                    _conditions(result, path in timed, shows_multimodality), conditions
                )
        line.marks = ",".join(dict.fromkeys(letters.values()))
        if len(set(letters.values())) > 1:
            for label, letter in letters.items():
                measured_under.setdefault(letter, {})[label] = None
        if line.marks and line.marks not in truths:
            pairs = zip(read, values, strict=True)
            cells = [_entry(r.ground_truth, v) if r and v not in ABOUT else None for r, v in pairs]
            truths[line.marks] = Line("Real motions", "real", cells, line.marks)
    lines = [line for line in truths.values() if any(line.cells)] + lines
    notes = [
        *_condition_notes(conditions, measured_under),
        *_by_text(missing),
        *_warnings(lines, values, list(columns)),
    ]
    if reported is not None:
        more, sources = _reported(reported, columns, values, name)
        lines, notes = lines + more, notes + sources
    _print_cells(lines, len(columns))
    _rank(lines, columns)
    return Part(name, columns, lines, notes)


def _letter(facts: dict[str, str], conditions: list[dict[str, str]]) -> str:
    """Returns the footnote letter for the conditions of a row.

    New conditions are added to `conditions`.
    """
    if facts not in conditions:
        conditions.append(facts)
    again, index = divmod(conditions.index(facts), 26)
    return string.ascii_lowercase[index] * (1 + again)


def _condition_notes(
    conditions: list[dict[str, str]], columns: Mapping[str, Mapping[str, None]]
) -> list[tuple[str, str]]:
    """Returns the footnotes about conditions.

    A footnote that differs from the first one in at most three items lists only these items.

    Args:
        conditions: the conditions, in the order of their letters.
        columns: for each letter, the columns that were measured under its conditions. A letter
            without an entry applies to all columns.
    """
    notes = []
    for facts in conditions:
        different = [
            text or f"No {name}." for name, text in facts.items() if text != conditions[0][name]
        ]
        text = (
            f"Same as footnote a, except for the following: {' '.join(different)}"
            if 0 < len(different) <= 3
            else " ".join(filter(None, facts.values()))
        )
        letter = _letter(facts, conditions)
        if letter in columns:
            text = f"{', '.join(columns[letter])}: {text}"
        notes.append((letter, text))
    return notes


def _warnings(
    lines: Sequence[Line], values: Sequence[str], columns: Sequence[str]
) -> list[tuple[str, str]]:
    """Returns the footnotes about invalid rows, the choice of checkpoints, and columns with distances of 0."""
    invalid = [(line.label, line.facts.get("not valid because")) for line in lines]
    texts = [(label, f"NOT VALID: {reason}") for label, reason in invalid if reason]
    for line in lines:
        kind, _, name = line.facts.get("chosen by", "").partition(" ")
        if kind in ("best", "none:"):
            chosen = (
                f"best checkpoint by {name}"
                if kind == "best"
                else f"{name} checkpoint, not chosen by validation"
            )
            texts.append((line.label, chosen))
    reals = [zip(columns, values, line.cells, strict=True) for line in lines if line.kind == "real"]
    zero = {
        label
        for cells in reals
        for label, value, cell in cells
        if value == "fid" and cell and cell.value == 0
    }
    why = "clips are used whole, so the two draws of real motions that are compared are identical"
    return _by_text(texts) + [
        ("", f"{label} of real motions is 0 by construction: {why}") for label in sorted(zero)
    ]


def _by_text(lines: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    labels: dict[str, dict[str, None]] = {}
    for label, text in lines:
        labels.setdefault(text, {})[label] = None
    return [("", f"{_listed(rows)}: {text}") for text, rows in labels.items()]


def _listed(labels: Iterable[str]) -> str:
    """Joins labels with a separator that none of them contains."""
    texts = list(labels)
    return ("; " if any("," in text for text in texts) else ", ").join(texts)


def _conditions(result: Result, timed: bool, shows_multimodality: bool) -> dict[str, str]:
    """Describes how a result was measured. Only rows with equal conditions are compared.

    Args:
        result: the result.
        timed: whether the table shows the seconds per motion.
        shows_multimodality: whether the table shows multimodality. Otherwise, it does not matter
            whether multimodality was measured.
    """
    protocol, data, extractor, cost = result.protocol, result.data, result.extractor, result.cost
    checkpoint = result.checkpoint
    recipe = ""
    if checkpoint and checkpoint.recipe_changes:
        recipe = f"The model differs from the recipe {checkpoint.experiment}: {', '.join(checkpoint.recipe_changes)}."
    card = card_of(data, extractor.sha256 if extractor else None)
    shown = {k: v for k, v in result.changed.items() if k != "multimodality" or shows_multimodality}
    changed = ", ".join(f"{k} = {v}" for k, v in shown.items())
    smpl = result.skeleton and result.skeleton.smpl_sha256
    skeleton = f"Joints have the bones of SMPL's model file, sha256 {smpl[:12]}." if smpl else ""
    if result.stand_in_skeleton:
        skeleton = "Joints have the bones of a stand-in skeleton, not SMPL's bones."
    return {
        "protocol": f"Protocol {protocol.name}, version {protocol.version}.",
        "data": f"Data: {result.split} split of {data.dataset} (fingerprint {data.fingerprint}).",
        "limits": _frame_counts(data.frames) if data.frames else "",
        "metrics": _numbers(result),
        "time": f"Timed in batches of {cost.batch_size or 0:g} on {result.device}."
        if timed and cost
        else "",
        "seed": f"Seed {result.seed}.",
        "extractor": f"Extractor sha256 {extractor.sha256[:12]}." if extractor else "No extractor.",
        "audit": f"Audit: {card}." if card else "Not audited.",
        "exclusions": _left_out(data.excluded),
        "skeleton": skeleton,
        "changes": f"Options that differ from the protocol: {changed}." if changed else "",
        "changes of the recipe": recipe,
        "published split": PUBLISHED_SPLIT if result.published_split else "",
        "force": FORCED if result.forced else "",
        "warnings": " ".join(f"Warning: {warning}." for warning in result.warnings),
        "quick run": "QUICK RUN, NOT FOR PUBLICATION." if result.quick else "",
    }


def _numbers(result: Result) -> str:
    """Returns a sentence that states on how many motions and replications most values are based.

    The number of real motions is added if it differs.
    """
    values = [value for value in (result.values or {}).values() if value and value.replications]
    if not values:
        return ""
    first = values[0]  # later values may have fewer motions
    count = first.n if first.n is not None else " + ".join(map(str, first.n_per_replication))
    replications = f"{first.replications} replication{'' if first.replications == 1 else 's'}"
    text = f"{replications} with N = {count} motions"
    real = next(
        (value.n for value in (result.ground_truth or {}).values() if value and value.n), None
    )
    if real is not None and real != first.n:
        text += f" (real motions: N = {real})"
    sets = next((value.n_real for value in values if value.n_real is not None), None)
    if sets is not None and sets != first.n:
        text += f", compared with sets of {sets} real motions"
    return f"{text}."


def _frame_counts(frames: Sequence[int]) -> str:
    shortest, longest = frames
    return f"Motions have {'' if shortest == longest else f'{shortest} to '}{longest} frames."


def _left_out(excluded: Mapping[str, int]) -> str:
    listed = ", ".join(f"{count:,} {reason}" for reason, count in excluded.items())
    return f"Excluded from the data set: {listed}." if listed else ""


def _line(
    row: Mapping[str, Any],
    results: Sequence[Result | None],
    values: Sequence[str],
    files: Sequence[str],
) -> Line:
    cells = [_cell(result, value, row) for result, value in zip(results, values, strict=True)]
    line = Line(row["label"], "measured", cells)
    line.options = {
        name: float(row[name]) for name in SWEPT if isinstance(row.get(name), int | float)
    }
    first = next((result for result in results if result is not None), None)
    if first is None:
        return line
    for name, result in (*zip(values, results, strict=True), *((name, first) for name in ABOUT)):
        value = _about(result, name) if result is not None and name in ABOUT else None
        if isinstance(value, int | float):
            line.options.setdefault(name, float(value))
    reasons = list(
        dict.fromkeys(reason for r in results if r is not None for reason in r.invalid_because)
    )
    line.state = NOT_VALID if reasons else "QUICK" if first.quick else ""
    checkpoint = first.checkpoint

    def fact(name: str) -> str:
        return _text(getattr(checkpoint, name, None))

    sampler = [
        fact("sampler"),
        *(f"{name} {fact(name)}" for name in ("eta", "spacing") if fact(name)),
    ]
    weights = {True: "averaged", False: "raw", None: ""}
    line.facts = {
        "checkpoint sha256": (checkpoint.sha256 if checkpoint else first.samples_sha256 or "")[:16],
        "recipe": fact("experiment"),
        "baseline": first.baseline or "",
        "chosen by": fact("selected_by"),
        "weights": weights[checkpoint.averaged_weights if checkpoint else None],
        "guidance": fact("guidance_scale"),
        "predicts": fact("prediction"),
        "sampler": ", ".join(sampler),
        "steps": fact("num_inference_steps"),
        "replications x motions": _counts(results, values),
        "seed": str(first.seed),
        "device": first.device,
        "speed of training": fact("training_speed"),
        "precision of training": fact("training_precision"),
        "training steps": fact("training_steps"),
        "training hours": fact("training_hours"),
        "device of training": fact("training_device"),
        "peak memory of training, GiB": fact("training_memory_gib"),
        "computed from": first.origin[:16],
        "result": " ".join(
            dict.fromkeys(file for r, file in zip(results, files, strict=True) if r is not None)
        ),
        "not valid because": "; ".join(reasons),
    }
    return line


def _counts(results: Sequence[Result | None], values: Sequence[str]) -> str:
    """Describes how many replications and motions most metrics have, followed by the exceptions."""
    counts = {}
    for result, name in zip(results, values, strict=True):
        entry = (result.values or {}).get(name) if result else None
        if entry and entry.replications:
            counts[name] = entry.counts
    most = Counter(counts.values()).most_common(1)[0][0] if counts else ""
    return most + "".join(f"; {name} {count}" for name, count in counts.items() if count != most)


def _text(value: Any) -> str:
    if isinstance(value, list):  # chosen steps
        return ", ".join(map(str, value))
    return "" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _about(result: Result, name: str) -> Any:
    checkpoint, cost = result.checkpoint, result.cost
    facts: dict[str, Any] = (
        dict(checkpoint or ()) | (checkpoint.edit if checkpoint else {}) | dict(cost or ())
    )
    value = facts.get(name)
    return value / 1e6 if name == "parameters" and value is not None else value


def _cell(result: Result | None, value: str, row: Mapping[str, Any]) -> Cell | None:
    if value not in ABOUT:
        return _entry(result.values, value) if result else None
    fact = row.get(value) if result is None else _about(result, value)
    if fact is None:
        return None
    return (
        Cell(f"{float(fact):,g}", float(fact))
        if isinstance(fact, int | float)
        else Cell(_text(fact))
    )


def _entry(values: Mapping[str, Value | None] | None, name: str) -> Cell | None:
    entry = (values or {}).get(name)
    if entry is None or entry.mean is None:
        return None
    return Cell("", entry.mean, entry.half)


def _print_cells(lines: Sequence[Line], columns: int) -> None:
    """Formats all numbers in a column with the same number of decimals.

    The largest number is shown with about three digits. Settings with at most one decimal are shown
    unchanged, and numbers that would be rounded to zero are shown with two significant digits.
    """
    for index in range(columns):
        cells = [
            c
            for line in lines
            if not line.kind.startswith("reported") and (c := line.cells[index]) is not None
        ]
        numbers = [abs(cell.value) for cell in cells if cell.value is not None]
        largest = max(numbers, default=0.0) or 1.0
        decimals = 3 if 0.1 <= largest < 10 else min(max(2 - math.floor(math.log10(largest)), 1), 6)
        short = all(
            cell.value == round(cell.value, 1)
            for cell in cells
            if cell.value is not None and cell.ci is None
        )
        for cell in cells:
            if cell.value is not None and not (cell.ci is None and cell.text and short):
                small = 0 < abs(cell.value) < 10**-decimals
                digits = 1 - math.floor(math.log10(abs(cell.value))) if small else decimals
                cell.text = f"{cell.value:.{digits}f}" + (
                    f" ±{cell.ci:.{digits}f}" if cell.ci is not None else ""
                )


def _rank(lines: Sequence[Line], columns: Mapping[str, str]) -> None:
    """Marks the best and second-best values among rows that have the same kind and footnotes."""
    for kind, real in (("measured", "real"), ("reported", "reported real")):
        for marks in {line.marks for line in lines}:
            same = [x for x in lines if x.marks == marks]
            rows = [
                x for x in same if x.kind == kind and not x.state and not x.facts.get("baseline")
            ]
            truths = [x for x in same if x.kind == real]
            if kind == "reported" and not truths:  # the source does not report real motions
                truths = [x for x in lines if x.kind == real]
            for index, better in enumerate(columns.values()):
                numbers = [cell.value if (cell := row.cells[index]) else None for row in rows]
                reals = [c.value for x in truths if (c := x.cells[index]) is not None]
                ranked = ranks(numbers, better, reals[0] if len(reals) == 1 else None)
                for row, rank in zip(rows, ranked, strict=True):
                    if (cell := row.cells[index]) is not None:
                        cell.rank = rank


def _reported(
    reported: Config, columns: Mapping[str, str], values: Sequence[str], part: str
) -> tuple[list[Line], list[tuple[str, str]]]:
    notes: dict[str, str] = {}
    lines = []
    for row in reported["rows"]:
        unknown = row["values"].keys() - columns.keys()
        if unknown:
            raise UserError(
                f"{PUBLISHED}: {part}, {row['label']}: unknown column {', '.join(sorted(unknown))}"
            )
        source, evaluator = (row.get(key) or reported[key] for key in ("source", "evaluator"))
        text = f"Reported in {source}. Measured with {evaluator}."
        mark = notes.setdefault(text, "†" * (len(notes) + 1))
        cells = [
            Cell(str(v), _leading(str(v))) if (v := row["values"].get(c)) is not None else None
            for c in columns
        ]
        line = Line(row["label"], "reported real" if row.get("real") else "reported", cells, mark)
        for value, cell in zip(values, cells, strict=True):
            if value in ABOUT and cell is not None and cell.value is not None:
                line.options[value] = cell.value
        lines.append(line)
    extra = [("", note) for note in reported.get("notes", [])]
    return lines, [(mark, text) for text, mark in notes.items()] + extra


def _leading(text: str) -> float | None:
    """Returns the number at the beginning of a printed value. "1,000" is read as one thousand."""
    number = re.match(r"[-+]?[\d,]*\.?\d+(?:[eE][-+]?\d+)?", text.strip())
    return float(number[0].replace(",", "")) if number else None


def _lengths(name: str, part: Config, results: Path) -> Part:
    formats = {
        "motions": ",",
        "hours": ".2f",
        "shortest": "d",
        "median": "d",
        "mean": ".1f",
        "longest": "d",
    }
    lines, histograms = [], {}
    notes = [("", "lengths are in frames, at each data set's frame rate")]
    for dataset in part["lengths"]:
        path = results / "lengths" / f"{dataset}.json"
        if not path.exists():
            lines.append(Line(dataset, "measured", [None] * len(formats), state="not prepared"))
            continue
        counted: Lengths = read_json(
            path, Lengths, "delete it; `flame-mdm tables` then counts again"
        )
        lengths, count, total = sorted(counted.lengths), len(counted.lengths), sum(counted.lengths)
        numbers = [
            count,
            total / counted.fps / 3600,
            lengths[0],
            lengths[count // 2],
            total / count,
            lengths[-1],
        ]
        cells = [
            Cell(format(x, style), float(x))
            for x, style in zip(numbers, formats.values(), strict=True)
        ]
        facts = {"fingerprint": counted.fingerprint, "frames per second": _text(float(counted.fps))}
        lines.append(Line(dataset, "measured", [*cells], facts=facts))
        if counted.excluded:
            notes.append(("", f"{dataset}: {_left_out(counted.excluded)}"))
        step = max(1, math.ceil(lengths[-1] / 40))
        histograms[dataset] = Histogram(
            step, np.bincount([length // step for length in lengths]).tolist()
        )
    return Part(name, dict.fromkeys(formats, "none"), lines, notes, histograms=histograms)


def _ratings(name: str, path: Path, reported: Config | None) -> Part:
    """Builds the table of a user study, with the raters' preferences between models."""
    columns = {"Preferred": "none", "votes": "none", "raters": "none"}
    lines: list[Line] = []
    notes = [
        (
            "",
            f'{path} is missing. make compare RUNS="a b" RATE=true writes a page for rating motions',
        )
    ]

    if path.exists():
        notes = [("", "share of votes, with 95 % interval (Wilson 1927)")]
        ratings: Ratings = read_json(
            path, Ratings, "run `flame-mdm compare ratings=...` to count again"
        )
        for pair in ratings.pairs:
            share, low, high = pair.share
            preferred = Cell(f"{share:.1%} [{low:.1%}, {high:.1%}]", share)
            votes, raters = Cell(str(pair.votes), pair.votes), Cell(str(pair.raters), pair.raters)
            lines.append(Line(f"{pair.a} over {pair.b}", "measured", [preferred, votes, raters]))

    if reported is not None:
        values = [""] * len(columns)
        reported_lines, sources = _reported(reported, columns, values, name)
        lines += reported_lines
        notes += sources
    return Part(name, columns, lines, notes)
