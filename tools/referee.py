"""Calibrates the referee on captioned motions, and prints how often its verdicts are right.

python tools/referee.py data/bandai-humanml-clean-smpl22 data/cmu-humanml-clean-smpl22 ... [figures=FILE.json]

The script writes the thresholds to the package and, with `figures=`, the figures to a file. The
figures in this repository are in docs/benchmarks/referee_calibration.json, and
`tools/referee_page.py` writes the page that shows them.

The other arguments are prepared data sets with SMPL's 22 joints. A hash of their names splits the
recordings into two halves. Thresholds are calibrated on one half, and the verdicts on the other half
are counted. In rows called "crossed", the counts of both halves are added; each half is judged with
thresholds from the other half. Procedural motions are not used for calibration and have separate
rows.

Each claim in a caption counts as true for its motion. Falsified claims count as false. They state
the other side, direction or speed, one repetition more or less, the reverse order, another
duration, or the other end of the motion. A wrong caption counts as an error by the referee.

Captions hardly ever state durations. If the captions of a recording only state that the body walks,
runs or stands still, clips of two, three and four seconds are therefore cut from the recording, so
that "for three seconds" is true for one of them. A walking body is assumed to be upright at the
start and at the end. Claims about durations, starts and ends are not used for calibration.
"""

import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.data.store import Store
from flame_mdm.safe_io import read_yaml, write_json, write_text
from flame_mdm.sampling.referee import kinds
from flame_mdm.sampling.referee.body import RATE, Body
from flame_mdm.sampling.referee.claims import Claim, falsified
from flame_mdm.sampling.referee.judging import decide
from flame_mdm.sampling.referee.sentences import read_claims
from flame_mdm.seeds import key

RECORDING = re.compile(r"\d{2,3}_\d{2,3}")
FEWEST = 10  # minimum number of claims to calibrate a threshold
MOST_REFUSED = 0.015  # maximum share of the first half's true claims that are judged false
# minimum share of the first half's decided falsified claims that are judged false
LEAST_REFUSED = 0.95
SYNTHETIC = "synthetic"
UNCALIBRATED = ("count", "duration", "start", "end")
LASTING = ("walk", "run", "stand still")
BESIDE = {"travel", "veer", "pace"}
"""Claims that are compatible with walking or running from the first to the last frame."""
MOST_SYNTHETIC = 600  # maximum number of procedural motions, from the test split
HEAD = """# Thresholds of the referee by kind of claim, written by `tools/referee.py`: the score up to which a claim is
# false, the score from which it is true, and the numbers of true and falsified claims used to calibrate them. The
# functions in `postures.py` and `movements.py` state the units. Scores are negated if lower values support the claim.
"""


@dataclass(frozen=True)
class Example:
    """A motion and its captions, with the data set and the half (0 or 1) to which its recording belongs."""

    dataset: str
    half: int
    name: str
    body: Body
    captions: list[str]


@dataclass(frozen=True)
class Case:
    """A claim about a motion.

    `change` describes how the claim was falsified, and is "" for a true claim. `is_built` is True if
    the claim comes from `built_cases` instead of a caption.
    """

    example: Example
    claim: Claim
    change: str
    is_built: bool = False


def main(folders: Sequence[Path], figures: Path | None) -> None:
    examples = [example for folder in folders for example in read(folder)]
    cases = [case for example in examples for case in cases_of(example)]
    cases += [case for example in examples for case in built_cases(example)]
    halves = [[case for case in cases if case.example.half == half] for half in (0, 1)]
    # The calibration on this half comes last, so that its thresholds remain
    calibrate(halves[1])
    other = tally(halves[0])
    calibrate(halves[0])
    rows = tally(halves[1])
    rows += crossed(rows, other)
    rows += [{"set": name, **coverage(group)} for name, group in by_set(examples).items()]
    if figures is not None:
        write_json(figures, {"format": 1, "rows": rows})
    for row in rows:
        print(row)


def read(folder: Path) -> Iterator[Example]:
    """Yields the captioned motions in a prepared data set, except for mirrored and repeated copies.

    Of the procedural motions, only a part of the test split is used.
    """
    store = Store(folder)
    files = sorted((EXPERIMENTS / "representation").glob("*.yaml"))
    nodes = {file.stem: read_yaml(file) for file in files}
    name = store.info["representation"]
    node = nodes.get(name) or nodes["humanml_clean"]
    representation = instantiate(node)
    count = 0
    for clip in store.clips:
        is_synthetic = clip.id.startswith(SYNTHETIC)
        if re.match(r"M[a-z0-9]", clip.id) or "~" in clip.id or not clip.captions:
            continue
        if is_synthetic:
            count += 1
            if clip.split != "test" or count > MOST_SYNTHETIC * 12:
                continue
        joints = representation.decode(torch.from_numpy(store.motion(clip).copy())).numpy()
        if len(joints) < representation.fps:
            continue
        source = str(clip.attributes.get("recording", clip.source))
        match = RECORDING.search(source)
        recording = match[0] if match else source
        dataset = SYNTHETIC if is_synthetic else folder.name.partition("-")[0]
        half = 1 if is_synthetic else key("referee", recording) % 2
        yield Example(dataset, half, clip.id, Body(joints, representation.fps), clip.captions)


def cases_of(example: Example) -> list[Case]:
    """Returns the claims in all captions for a motion, and their falsified versions, without duplicates."""
    claims = {str(claim): claim for text in example.captions for claim in read_claims(text)}
    cases = []
    for claim in claims.values():
        cases.append(Case(example, claim, ""))
        for change, wrong in falsified(claim):
            # "Turns left and turns right" makes both claims true
            if str(wrong) not in claims:
                cases.append(Case(example, wrong, change))
    return cases


def built_cases(example: Example) -> list[Case]:
    """Returns constructed claims about the duration, the start and the end of a motion.

    Some claims are assumed to be true, and the others are their falsified versions.
    """
    if example.dataset == SYNTHETIC:
        return []
    sets = [{claim.kind for claim in read_claims(text)} for text in example.captions]
    stated = set[str]().union(*sets)
    built: list[tuple[Example, Claim]] = []
    base = next((kind for kind in LASTING if kind in stated and stated <= {kind, *BESIDE}), None)
    for seconds in (2, 3, 4):
        if base is not None and example.body.seconds >= seconds + 0.5:
            built.append((cut(example, seconds), Claim(base, seconds=seconds)))
    if "walk" in stated and stated <= {"walk", "turn", "turn angle", *BESIDE}:
        built += [(example, Claim("upright", when=when)) for when in ("start", "end")]
    return [
        Case(body, claim, change, is_built=True)
        for body, true in built
        for change, claim in [("", true), *falsified(true)]
    ]


def cut(example: Example, seconds: int) -> Example:
    """Returns the middle part of a motion, with the given duration."""
    body = example.body
    frames = round(seconds * RATE)
    first = (len(body) - frames) // 2
    joints = body.joints[first : first + frames] / body.scale
    return replace(example, body=Body(joints, RATE))


def calibrate(cases: Sequence[Case]) -> None:
    """Calibrates and writes the thresholds for all kinds of claims with at least `FEWEST` true claims."""
    kinds.FILE.unlink(missing_ok=True)
    kinds.thresholds.cache_clear()
    scores: defaultdict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for case in cases:
        if case.claim.parts or kinds.group_of(case.claim) in UNCALIBRATED:
            continue
        verdict = decide(case.example.body, case.claim)
        if case.change or not verdict.reading.unclear:
            is_wrong = bool(case.change)
            is_undecided = np.isnan(verdict.reading.score) or verdict.reading.unclear
            if not (is_undecided and verdict.answer != "no"):
                scores[kinds.threshold_key(case.claim)][is_wrong].append(verdict.reading.score)

    thresholds = {}
    for name, (true, wrong) in sorted(scores.items()):
        kind = kinds.KINDS[re.sub(r"^(?:slow|fast) | of a side$| in a direction$", "", name)]
        if len(true) >= FEWEST:
            no, yes = chosen(np.array(true), np.array(wrong), kind.no, kind.yes)
            thresholds[name] = {"no": no, "yes": yes, "true": len(true), "falsified": len(wrong)}
    text = yaml.safe_dump({"thresholds": thresholds}, sort_keys=True, default_flow_style=None)
    write_text(kinds.FILE, HEAD + text)
    kinds.thresholds.cache_clear()


def chosen(true: np.ndarray, wrong: np.ndarray, no: float, yes: float) -> tuple[float, float]:
    """Returns two thresholds: claims are false up to the first score, and true from the second score on.

    The first threshold is lowered until at most `MOST_REFUSED` of the true claims are judged false.
    The second threshold is raised until `LEAST_REFUSED` of the decided falsified claims are judged
    false.

    Args:
        true: scores of true claims.
        wrong: scores of falsified claims.
        no: first threshold before calibration, set by hand.
        yes: second threshold before calibration, set by hand.
    """
    refused = int(MOST_REFUSED * len(true))
    lowest = float(np.sort(true)[refused])
    span = yes - no
    no = min(no, lowest - 0.05 * span)
    right = int((wrong <= no).sum())
    most = max(1, int(right * (1 / LEAST_REFUSED - 1)))
    above = np.sort(wrong[wrong >= yes])
    if len(above) > most:
        yes = float(above[len(above) - most - 1]) + 0.02 * span
    return round(no, 4), round(yes, 4)


def tally(cases: Sequence[Case]) -> list[dict[str, Any]]:
    """Counts true and falsified claims by set and group, and how many of them are decided and judged correctly."""
    counts: defaultdict[tuple[str, str], dict[str, int]] = defaultdict(
        lambda: dict.fromkeys(
            ("true", "true_decided", "true_right", "false", "false_decided", "false_right"), 0
        )
    )
    for case in cases:
        verdict = decide(case.example.body, case.claim)
        side = "false" if case.change else "true"
        right = "no" if case.change else "yes"
        is_real = case.example.dataset != SYNTHETIC
        named = [
            (case.example.dataset, verdict.group),
            (case.example.dataset, "all"),
            *([("real", verdict.group), ("real", "all")] if is_real else []),
            *([("real", f"kind {name_of(case.claim)}")] if is_real else []),
        ]
        if case.is_built:
            named = [("built", f"{case.claim.kind}, {verdict.group}"), ("built", "all")]
        for name in named:
            counts[name][side] += 1
            counts[name][f"{side}_decided"] += verdict.answer != "cannot tell"
            counts[name][f"{side}_right"] += verdict.answer == right
    return [{"set": name, "group": group, **row} for (name, group), row in sorted(counts.items())]


def name_of(claim: Claim) -> str:
    """Returns the name of a claim's kind, which also states whether it is about a duration, the start or the end."""
    if claim.seconds is not None:
        return f"{claim.kind}, duration"
    return f"{claim.kind}, {claim.when}" if claim.when else claim.kind


def crossed(
    rows: Sequence[dict[str, Any]], other: Sequence[dict[str, Any]]
) -> list[dict[str, Any]]:
    """Returns the sums of `tally` over both halves, each judged with thresholds from the other half."""
    sums: defaultdict[tuple[str, str], dict[str, int]] = defaultdict(lambda: defaultdict(int))
    for row in (*rows, *other):
        for name, value in row.items():
            if isinstance(value, int):
                sums[row["set"], row["group"]][name] += value
    return [
        {"set": f"{name}, crossed", "group": group, **row}
        for (name, group), row in sorted(sums.items())
        if group == "all"
    ]


def by_set(examples: Sequence[Example]) -> dict[str, list[Example]]:
    groups: defaultdict[str, list[Example]] = defaultdict(list)
    for example in examples:
        groups[example.dataset].append(example)
    return groups


def coverage(examples: Sequence[Example]) -> dict[str, Any]:
    """Returns the number of captions, of captions with a claim, and of captions with a decided claim."""
    captions = with_claim = with_decided = 0
    for example in examples:
        for text in example.captions:
            claims = read_claims(text)
            verdicts = [decide(example.body, claim) for claim in claims]
            captions += 1
            with_claim += bool(claims)
            with_decided += any(verdict.answer != "cannot tell" for verdict in verdicts)
    return {"captions": captions, "with_claim": with_claim, "with_decided": with_decided}


if __name__ == "__main__":
    named = [word for word in sys.argv[1:] if not word.startswith("figures=")]
    target = [word.partition("=")[2] for word in sys.argv[1:] if word.startswith("figures=")]
    main([Path(word) for word in named], Path(target[0]) if target else None)
