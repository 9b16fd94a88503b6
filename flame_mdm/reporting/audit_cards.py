"""Cards of evaluator audits: one page per extractor and data set."""

import itertools
import os
import re
from dataclasses import dataclass
from pathlib import Path

from flame_mdm.errors import markdown_text
from flame_mdm.records import AuditCard, AuditedPerturbation
from flame_mdm.reporting.page import interval, number, page, render
from flame_mdm.safe_io import write_text
from flame_mdm.schemas import read_json

COMMITTED = "docs/benchmarks/audit"  # folder of the cards that audited.json lists
PHYSICS = ("foot_skating", "penetration", "floating", "jitter", "static_share")  # do not see the meaning of a motion
ROUNDING = 1e-6  # relative differences below this are not seen
WIDE, HIGH = 132, 48
LEGEND = (
    "Smallest strength from which on the metric differs from real motions in a paired comparison; a → b: only from b "
    "on does its value also leave the 95 % interval of real motions; –: never; ~: not monotone."
)


@dataclass(frozen=True)
class Seen:
    """How a metric responds to a perturbation; None = at no grade."""

    grade: float | None  # from which on the paired difference from real motions is not 0
    outside: float | None  # from which on values are outside the 95 % interval of real motions
    rewarded: bool  # whether the strongest grade is rated better than real motions
    monotone: bool  # whether every stronger grade differs at least as much, within its interval


def seen(card: AuditCard, perturbation: AuditedPerturbation, metric: str) -> Seen | None:
    """Returns how a metric responds to a perturbation; None if it was not computed at all grades."""
    real, width = card.real[metric]
    graded = [(grade.grade, *grade.values[metric]) for grade in perturbation.grades]
    if real is None or width is None:
        return None
    changes = [(grade, d, half) for grade, _, _, d, half in graded if d is not None and half is not None]
    if len(changes) < len(graded):
        return None

    def since(least: float) -> float | None:
        noticed = [abs(d) > max(half, least, ROUNDING * abs(real)) for _, d, half in changes]
        first = max((i + 1 for i, flag in enumerate(noticed) if not flag), default=0)
        return changes[first][0] if first < len(changes) else None

    higher, strongest = card.metrics[metric], changes[-1][1]
    rewarded = since(0) is not None and higher is not None and (strongest > 0) == higher
    pairs = itertools.pairwise(changes)
    return Seen(since(0), since(width), rewarded, all(abs(b) + half >= abs(a) for (_, a, _), (_, b, half) in pairs))


def card_name(card: AuditCard) -> str:
    return _name(card.data.dataset, card.extractor.sha256 if card.extractor else None)


def _name(dataset: str, sha256: str | None) -> str:
    return f"{dataset}-{sha256[:12] if sha256 else 'none'}"


def card_of(dataset: str, sha256: str | None) -> Path | None:
    """Returns the card of an extractor on a data set, or of metrics of joints; None if it was not audited.

    It is in the folder that FLAME_MDM_AUDITS names, by default runs/audit, or one of those named in audited.json.
    """
    name = _name(dataset, sha256)
    path = Path(os.environ.get("FLAME_MDM_AUDITS", "runs/audit")) / f"{name}.html"
    if path.exists():
        return path
    committed: list[str] = read_json(Path(__file__).with_name("audited.json"), list[str])
    return Path(COMMITTED) / f"{name}.html" if name in committed else None


def read_card(path: Path) -> AuditCard:
    return read_json(path, AuditCard, "run `flame-mdm audit` again")


def write_card(card: AuditCard, out: Path) -> list[Path]:
    """Writes a card as a web page and as Markdown; returns the paths."""
    metrics = sorted(card.metrics, key=lambda name: name.startswith("attributes"))
    evaluator = f"{card.extractor.name} ({card.extractor.sha256[:12]})" if card.extractor else "metrics of joints"
    rows = []
    for perturbation in card.perturbations:
        cells = [_cell(card, perturbation, metric) for metric in metrics]
        curves = [(metric, curve) for metric in metrics if (curve := _curve(card, perturbation, metric))]
        rows.append({"about": perturbation, "cells": cells, "curves": curves})
    values = {
        "title": f"Audit of {evaluator} on {card.data.dataset}",
        "facts": _facts(card),
        "findings": findings(card),
        "truth": [(name, number(x["auc"]), number(x["correlation"])) for name, x in card.truth.items()],
        "real": [(name, interval(*pair)) for name, pair in card.real.items()],
        "metrics": metrics,
        "rows": rows,
        "legend": LEGEND,
    }
    paths = [out / f"{card_name(card)}{suffix}" for suffix in (".html", ".md")]
    write_text(paths[0], page(values["title"], render("audit.html", **values, wide=WIDE, high=HIGH)))
    write_text(paths[1], str(render("audit.md", **values, metric_text=_metric_text)))
    return paths


def _facts(card: AuditCard) -> list[list[str]]:
    data, protocol = card.data, card.protocol
    return [
        ["extractor", f"{card.extractor.name}, sha256 {card.extractor.sha256}" if card.extractor else "none"],
        ["data", f"{card.split} split of {data.dataset}, fingerprint {data.fingerprint}, {data.representation}"],
        ["motions", f"{card.motions}" + (" of {} to {} frames".format(*data.frames) if data.frames else "")],
        ["protocol", f"{protocol.name} version {protocol.version}, seed {card.seed}"],
        ["intervals", f"95 %, from {card.resamples} bootstrap resamples of the motions"],
        ["versions", ", ".join(f"{name} {version}" for name, version in card.packages.items())],
        *([f"not computed: {name}", reason] for name, reason in card.not_computed.items()),
    ]


def findings(card: AuditCard) -> list[str]:
    """Returns what metrics do not see, or rate better than real motions, in plain sentences."""
    table = {(p.name, m): seen(card, p, m) for p in card.perturbations for m in card.metrics}
    noticed = {pair for pair, response in table.items() if response and response.grade is not None}
    group = {p.name: p.group for p in card.perturbations}
    wrong = [name for name in group if group[name] in ("joints", "meaning") and ":" not in name]
    expected = [name for name in group if name in wrong or name == "memorized"]
    blind = [name for name in expected if not any((name, metric) in noticed for metric in card.metrics)]
    lines = [f"No metric sees: {', '.join(blind)}."] if blind else []
    single = {m: [n for n in wrong if [x for x in card.metrics if (n, x) in noticed] == [m]] for m in card.metrics}
    lines += [f"Only {metric} sees: {', '.join(names)}." for metric, names in single.items() if names]
    for metric in card.metrics:
        unseen = [n for n in wrong if (n, metric) not in noticed and n not in blind]
        unseen = [n for n in unseen if group[n] == "joints" or metric not in PHYSICS]
        if unseen and metric.partition("/")[2] in ("", "all", "top3"):
            lines.append(f"{metric} does not see: {', '.join(unseen)}.")
    for metric in card.metrics:
        liked = [n for n in wrong if (response := table[n, metric]) and response.rewarded]
        if liked:
            lines.append(f"{metric} rates better than real motions: {', '.join(liked)}.")
    for perturbation in card.perturbations:
        if perturbation.name in ("fewer", "as stored") and "fid" in card.real:
            grade, (real, _) = perturbation.grades[-1], card.real["fid"]
            what = f"of {grade.grade:g} real motions" if perturbation.name == "fewer" else "of features as stored"
            lines.append(
                f"fid {what} is {number(grade.values['fid'][0])}; of all of them, decoded and encoded, {number(real)}."
            )
    return lines


def _cell(card: AuditCard, perturbation: AuditedPerturbation, metric: str) -> tuple[str, str]:
    response = seen(card, perturbation, metric)
    if response is None:
        return _not_computed(card, perturbation, metric), "faint"
    if response.grade is None:
        return "–", "faint"
    graded = len(perturbation.grades) > 1
    first, then = (("–" if g is None else f"{g:g}" if graded else "yes") for g in (response.grade, response.outside))
    text = first if first == then else f"{first} → {then}"
    if not response.monotone:
        text += " ~"
    return text, "bad" if response.rewarded else "seen" if first == then else "weak"


def _not_computed(card: AuditCard, perturbation: AuditedPerturbation, metric: str) -> str:
    """Returns at which grades a metric lacks a value, if it has one at others."""
    grades = [grade.grade for grade in perturbation.grades if None in grade.values[metric][2:]]
    if None in card.real[metric] or len(grades) == len(perturbation.grades):
        return "not computed"
    return f"not computed at {', '.join(f'{grade:g}' for grade in grades)}"


def _curve(card: AuditCard, perturbation: AuditedPerturbation, metric: str) -> dict[str, str] | None:
    """Returns a response curve over real motions and all grades; None if the metric never changes."""
    pairs = [card.real[metric], *(grade.values[metric][:2] for grade in perturbation.grades)]
    points = [(i, value, half) for i, (value, half) in enumerate(pairs) if value is not None and half is not None]
    real = card.real[metric][0]
    if real is None or all(abs(value - real) <= ROUNDING * abs(real) for _, value, _ in points):
        return None
    low, high = min(v - h for _, v, h in points), max(v + h for _, v, h in points)

    def at(step: int, value: float) -> str:
        x = 3 + (WIDE - 6) * step / (len(pairs) - 1)
        return f"{x:.0f},{3 + (HIGH - 6) * (high - value) / (high - low):.1f}"

    rim = [at(i, v + h) for i, v, h in points] + [at(i, v - h) for i, v, h in reversed(points)]
    return {
        "line": " ".join(at(i, v) for i, v, _ in points),
        "band": " ".join(rim),
        "level": at(0, real).partition(",")[2],
        "text": f"{number(real)} to {number(points[-1][1])}",
    }


def _metric_text(name: str) -> str:
    """Returns the name of a metric as Markdown; the names that this project gives need no escapes."""
    return name if re.fullmatch(r"[\w/.-]+", name) else markdown_text(name)
