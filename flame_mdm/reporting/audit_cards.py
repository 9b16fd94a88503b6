"""Cards for evaluator audits: one page per extractor and data set, or two cards side by side."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flame_mdm.errors import markdown_text
from flame_mdm.records import AuditCard, AuditedMetric, AuditedPerturbation, Data
from flame_mdm.reporting.page import interval, number, page, render
from flame_mdm.safe_io import write_text
from flame_mdm.schemas import ClosedSchema, Int, read_json

COMMITTED = "docs/benchmarks/audit"  # folder of the cards that audited.json lists
SETS = {"fewer": "{:g} real motions", "as stored": "the features as stored"}
"""Perturbations that show the bias of a metric, each with a phrase for its strongest grade."""
ROUNDING = 1e-6  # smaller relative differences count as rounding errors
WIDE, HIGH = 132, 48
LEGEND = (
    "Each cell shows the strength at and above which the metric differs significantly from its "
    "value for real motions in a paired comparison. a → b: the value itself leaves the 95 % "
    "interval of real motions only at strength b. –: there is no such strength. ~: the difference "
    "does not always grow with the strength."
)


@dataclass(frozen=True)
class Seen:
    """Response of a metric to a perturbation.

    `grade` and `outside` are None if no grade meets their conditions.
    """

    # Weakest grade such that, at this and all stronger grades, the paired difference from real
    # motions is not 0
    grade: float | None
    # Weakest grade such that, at this and all stronger grades, the value is outside the 95 %
    # interval of real motions
    outside: float | None
    # Whether the strongest grade is rated better than real motions
    rewarded: bool
    # Whether the difference never decreases from one grade to the next, within its interval
    monotone: bool


def seen(card: AuditCard, perturbation: AuditedPerturbation, metric: str) -> Seen | None:
    """Returns the response of a metric to a perturbation, or None if a grade was not computed."""
    real, width = card.real[metric]
    graded = [(grade.grade, *grade.values[metric]) for grade in perturbation.grades]
    if real is None or width is None:
        return None
    changes = [
        (grade, d, half) for grade, _, _, d, half in graded if d is not None and half is not None
    ]
    if len(changes) < len(graded):
        return None

    def since(least: float) -> float | None:
        noticed = [abs(d) > max(half, least, ROUNDING * abs(real)) for _, d, half in changes]
        first = max((i + 1 for i, flag in enumerate(noticed) if not flag), default=0)
        return changes[first][0] if first < len(changes) else None

    higher, strongest = card.metrics[metric], changes[-1][1]
    rewarded = since(0) is not None and higher is not None and (strongest > 0) == higher
    pairs = itertools.pairwise(changes)
    return Seen(
        since(0),
        since(width),
        rewarded,
        all(abs(b) + half >= abs(a) for (_, a, _), (_, b, half) in pairs),
    )


def card_name(card: AuditCard) -> str:
    """Returns the name of a card's files: data set, extractor, number of motions, and a hash.

    The hash depends on the motions and the crop, so that an audit with other motions or a different
    crop does not overwrite a stronger card.
    """
    extractor = card.extractor.sha256[:12] if card.extractor else "none"
    facts = card.model_dump(include={"protocol", "data", "split", "seed", "motions", "resamples"})
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    return f"{card.data.dataset}-{extractor}-{card.motions}-{digest[:8]}"


class ListedCard(ClosedSchema):
    """A card in this repository, as listed in audited.json."""

    name: str
    extractor: str | None  # first 12 characters of the extractor's sha256
    motions: Int
    split: str
    data: Data

    def cited(self, folder: Path) -> CitedCard:
        """Returns a reference to the card, with the path of its page in `folder`."""
        return CitedCard(folder / f"{self.name}.html", self.motions, self.split, self.data)


@dataclass(frozen=True)
class CitedCard:
    """A reference to a card: the path of its page, and the motions that were audited."""

    path: Path
    motions: int
    split: str
    data: Data

    def strength(self, data: Data) -> tuple[bool, bool, bool, int]:
        """Returns a sort key that is larger for cards that fit the evaluated data better.

        The criteria are, in this order: equal length limits, the test split, the same data, and the
        number of motions.
        """
        same_frames = self.data.frames == data.frames
        return (
            same_frames,
            self.split == "test",
            self.data.fingerprint == data.fingerprint,
            self.motions,
        )

    def __str__(self) -> str:
        return f"{self.path.as_posix()} ({self.motions} motions)"


def card_of(data: Data, sha256: str | None) -> CitedCard | None:
    """Returns the extractor's card that best fits the evaluated data, or None.

    Without an extractor, the card covers the metrics computed from joint positions. Cards are in
    the folder set by FLAME_MDM_AUDITS (default: runs/audit) and in the repository, where
    audited.json lists them.
    """
    extractor = sha256[:12] if sha256 else None
    listed = read_json(Path(__file__).with_name("audited.json"), list[ListedCard])
    fitting = [card.cited(Path(COMMITTED)) for card in listed if card.extractor == extractor]
    folder = Path(os.environ.get("FLAME_MDM_AUDITS", "runs/audit"))
    for path in sorted(folder.glob(f"{data.dataset}-{extractor or 'none'}*.json")):
        card = read_card(path)
        if (card.extractor.sha256[:12] if card.extractor else None) == extractor:
            fitting.append(
                CitedCard(path.with_suffix(".html"), card.motions, card.split, card.data)
            )
    fitting = [card for card in fitting if card.data.dataset == data.dataset]
    return max(fitting, key=lambda card: card.strength(data), default=None)


def read_card(path: Path) -> AuditCard:
    """Reads a card's JSON file. Raises `UserError` if it is damaged or from an older version."""
    return read_json(path, AuditCard, "run `flame-mdm audit` again")


def write_card(cards: Sequence[AuditCard], out: Path, name: str = "") -> list[Path]:
    """Writes one card, or two cards side by side, as a web page and as Markdown. Returns the paths.

    `name` is the file name without the suffix. By default, it consists of the names of the cards.
    """
    metrics = list(dict.fromkeys(metric for card in cards for metric in card.metrics))
    metrics.sort(key=lambda metric: any(_facts_of(card, metric).exact for card in cards))
    values = {
        "title": " and ".join(
            f"Audit of {_evaluator(card)} on {card.data.dataset}" for card in cards
        ),
        "cards": [_section(card) for card in cards],
        "metrics": metrics,
        "rows": _rows(cards, metrics),
        "legend": LEGEND,
    }
    name = name or "-and-".join(map(card_name, cards))
    paths = [out / f"{name}{suffix}" for suffix in (".html", ".md")]
    write_text(
        paths[0], page(str(values["title"]), render("audit.html", **values, wide=WIDE, high=HIGH))
    )
    write_text(paths[1], str(render("audit.md", **values, metric_text=_metric_text)))
    return paths


def _evaluator(card: AuditCard) -> str:
    return (
        f"{card.extractor.name} ({card.extractor.sha256[:12]})"
        if card.extractor
        else "metrics of joints"
    )


def _section(card: AuditCard) -> dict[str, object]:
    """Returns the content of a page for a single card."""
    return {
        "name": _evaluator(card),
        "facts": _facts(card),
        "findings": findings(card),
        "truth": [
            (name, number(x["auc"]), number(x["correlation"])) for name, x in card.truth.items()
        ],
        "real": [(name, interval(*pair)) for name, pair in card.real.items()],
    }


def _rows(cards: Sequence[AuditCard], metrics: Sequence[str]) -> list[dict[str, object]]:
    """Returns one row per perturbation, with curves and one cell per metric and card."""
    by_name = [
        {perturbation.name: perturbation for perturbation in card.perturbations} for card in cards
    ]
    rows = []
    for name in dict.fromkeys(name for names in by_name for name in names):
        pairs = [
            (card, perturbations.get(name))
            for card, perturbations in zip(cards, by_name, strict=True)
        ]
        curves = []
        for metric in metrics:
            drawn = [_curve(card, perturbation, metric) for card, perturbation in pairs]
            if any(drawn):
                curves.append((metric, drawn))
        rows.append(
            {
                "about": next(perturbation for _, perturbation in pairs if perturbation),
                "cells": [
                    [_cell(card, perturbation, metric) for card, perturbation in pairs]
                    for metric in metrics
                ],
                "curves": curves,
            }
        )
    return rows


def _facts(card: AuditCard) -> list[list[str]]:
    data, protocol = card.data, card.protocol
    return [
        [
            "extractor",
            f"{card.extractor.name}, sha256 {card.extractor.sha256}" if card.extractor else "none",
        ],
        [
            "data",
            f"{card.split} split of {data.dataset}, fingerprint {data.fingerprint}, {data.representation}",
        ],
        [
            "motions",
            f"{card.motions}" + (" of {} to {} frames".format(*data.frames) if data.frames else ""),
        ],
        ["protocol", f"{protocol.name} version {protocol.version}, seed {card.seed}"],
        ["intervals", f"95 %, from {card.resamples} bootstrap resamples of the motions"],
        ["versions", ", ".join(f"{name} {version}" for name, version in card.packages.items())],
        *([f"not computed: {name}", reason] for name, reason in card.not_computed.items()),
    ]


def findings(card: AuditCard) -> list[str]:
    """Returns sentences about perturbations that metrics do not detect, or that improve metrics."""
    table = {
        (perturbation.name, metric): seen(card, perturbation, metric)
        for perturbation in card.perturbations
        for metric in card.metrics
    }
    group = {perturbation.name: perturbation.group for perturbation in card.perturbations}

    # A metric detects a perturbation if it responds to one of its grades. Metrics are expected to
    # detect perturbations that make motions or their meaning wrong. A name with a colon is a
    # variant of a perturbation.
    seen_by: dict[str, list[str]] = {name: [] for name in group}
    for (name, metric), response in table.items():
        if response and response.grade is not None:
            seen_by[name].append(metric)
    wrong = [name for name in group if group[name] in ("joints", "meaning") and ":" not in name]
    blind = [name for name in group if name in (*wrong, "memorized") and not seen_by[name]]
    lines = [f"No metric detects these perturbations: {', '.join(blind)}."] if blind else []

    for metric in card.metrics:
        alone = [name for name in wrong if seen_by[name] == [metric]]
        if alone:
            lines.append(f"Only {metric} detects these perturbations: {', '.join(alone)}.")
    for metric in card.metrics:
        facts = _facts_of(card, metric)
        unseen = [name for name in wrong if metric not in seen_by[name] and name not in blind]
        if not facts.sees_meaning:
            unseen = [name for name in unseen if group[name] == "joints"]
        if unseen and facts.sums_up:
            lines.append(f"{metric} does not detect these perturbations: {', '.join(unseen)}.")
    for metric in card.metrics:
        liked = [name for name in wrong if (response := table[name, metric]) and response.rewarded]
        if liked:
            lines.append(
                f"{metric} is better for these perturbations than for real motions: {', '.join(liked)}."
            )
    biased = [metric for metric in card.metrics if _facts_of(card, metric).depends_on_count]
    for perturbation in card.perturbations:
        of_motions = SETS.get(perturbation.name)
        if of_motions is not None:
            grade = perturbation.grades[-1]
            lines += [
                f"With {of_motions.format(grade.grade)}, {metric} is {number(grade.values[metric][0])}. With all "
                f"motions, decoded and encoded again, it is {number(card.real[metric][0])}."
                for metric in biased
            ]
    return lines


def _facts_of(card: AuditCard, metric: str) -> AuditedMetric:
    return card.facts.get(metric, AuditedMetric())


def _cell(
    card: AuditCard, perturbation: AuditedPerturbation | None, metric: str
) -> tuple[str, str]:
    """Returns the text and the CSS class of a cell in the summary."""
    response = seen(card, perturbation, metric) if perturbation and metric in card.metrics else None
    if perturbation is None or metric not in card.metrics:
        return "not computed", "faint"
    if response is None:
        return _not_computed(card, perturbation, metric), "faint"
    if response.grade is None:
        return "–", "faint"
    graded = len(perturbation.grades) > 1
    first, then = (
        ("–" if g is None else f"{g:g}" if graded else "yes")
        for g in (response.grade, response.outside)
    )
    text = first if first == then else f"{first} → {then}"
    if not response.monotone:
        text += " ~"
    return text, "bad" if response.rewarded else "seen" if first == then else "weak"


def _not_computed(card: AuditCard, perturbation: AuditedPerturbation, metric: str) -> str:
    """Returns a phrase that lists the grades for which a metric was not computed."""
    grades = [grade.grade for grade in perturbation.grades if None in grade.values[metric][2:]]
    if None in card.real[metric] or len(grades) == len(perturbation.grades):
        return "not computed"
    return f"not computed at {', '.join(f'{grade:g}' for grade in grades)}"


def _curve(
    card: AuditCard, perturbation: AuditedPerturbation | None, metric: str
) -> dict[str, str] | None:
    """Returns the response curve over real motions and all grades, or None if it is constant."""
    if perturbation is None or metric not in card.metrics:
        return None
    pairs = [card.real[metric], *(grade.values[metric][:2] for grade in perturbation.grades)]
    points = [
        (i, value, half)
        for i, (value, half) in enumerate(pairs)
        if value is not None and half is not None
    ]
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
    """Returns the name of a metric as Markdown.

    The names of this project's metrics do not need escaping.
    """
    return name if re.fullmatch(r"[\w/.-]+", name) else markdown_text(name)
