"""Calibrates the referee on captioned motions: writes its thresholds, and prints how often its verdicts are right.

    python tools/referee.py data/bandai-humanml-clean-smpl22 data/cmu-humanml-clean-smpl22 ... [figures=FILE.json]

docs/benchmarks/referee_calibration.json holds the figures of this repository, and `tools/referee_page.py` shows them.

Takes prepared data sets on SMPL's 22 joints. Recordings are split in two halves by a hash of their names: thresholds
come from one half, figures from the other. Procedural motions set no thresholds, their figures are separate.

A claim of a caption is taken to be true of its motion, and a falsified claim (another side, direction or speed, one
repetition more or fewer, the reverse order) to be false. Captions are sometimes wrong, which the figures include.
"""

import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.data.store import Store
from flame_mdm.safe_io import read_yaml, write_json, write_text
from flame_mdm.sampling.referee import kinds
from flame_mdm.sampling.referee.body import Body
from flame_mdm.sampling.referee.claims import Claim, falsified
from flame_mdm.sampling.referee.judging import decide
from flame_mdm.sampling.referee.sentences import read_claims
from flame_mdm.seeds import key

RECORDING = re.compile(r"\d{2,3}_\d{2,3}")
FEWEST = 10  # claims from which thresholds are calibrated
MOST_REFUSED = 0.015  # share of true claims of the first half that may be judged false
LEAST_REFUSED = 0.95  # share of decided falsified claims of the first half to be judged false
SYNTHETIC = "synthetic"
MOST_SYNTHETIC = 600  # procedural motions, of the test split
HEAD = """# Thresholds of the referee by kind of claim, written by `tools/referee.py`: the score up to which a claim is
# false, the score from which it is true, and the numbers of true and falsified claims that they come from. The units
# are stated by the functions in `postures.py` and `movements.py`; a score is negative if less speaks for the claim.
"""


@dataclass(frozen=True)
class Example:
    """A motion, its captions, the set and the half that it belongs to, and its name."""

    dataset: str
    half: int
    name: str
    body: Body
    captions: list[str]


@dataclass(frozen=True)
class Case:
    """A claim about a motion, and what was changed in it: "" = nothing, so that it is true."""

    example: Example
    claim: Claim
    change: str


def main(folders: Sequence[Path], figures: Path | None) -> None:
    examples = [example for folder in folders for example in read(folder)]
    cases = [case for example in examples for case in cases_of(example)]
    calibrate([case for case in cases if case.example.half == 0])
    kinds.thresholds.cache_clear()

    held_out = [case for case in cases if case.example.half == 1]
    rows = tally(held_out)
    rows += [{"set": name, **coverage(group)} for name, group in by_set(examples).items()]
    if figures is not None:
        write_json(figures, {"format": 1, "rows": rows})
    for row in rows:
        print(row)


def read(folder: Path) -> Iterator[Example]:
    """Yields the motions of a prepared data set, without mirrored and repeated copies."""
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
    """Returns the claims of all captions of a motion, and their falsified versions, without repetitions."""
    claims = {str(claim): claim for text in example.captions for claim in read_claims(text)}
    cases = []
    for claim in claims.values():
        cases.append(Case(example, claim, ""))
        for change, wrong in falsified(claim):
            # "Turns left and turns right" makes both claims true
            if str(wrong) not in claims:
                cases.append(Case(example, wrong, change))
    return cases


def calibrate(cases: Sequence[Case]) -> None:
    """Writes the thresholds of all kinds for which there are enough claims."""
    kinds.FILE.unlink(missing_ok=True)
    kinds.thresholds.cache_clear()
    scores: defaultdict[str, tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for case in cases:
        if case.claim.parts or kinds.group_of(case.claim) == "count":
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


def chosen(true: np.ndarray, wrong: np.ndarray, no: float, yes: float) -> tuple[float, float]:
    """Returns the scores up to which claims are false and from which they are true.

    The first is the one set by hand, lowered until at most `MOST_REFUSED` of the true claims are judged false. The
    second is raised until `LEAST_REFUSED` of the falsified claims that are decided are judged false.
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
    """Returns how many true and falsified claims are decided, and how many rightly, by set and group."""
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
            *([("real", f"kind {case.claim.kind}")] if is_real else []),
        ]
        for name in named:
            counts[name][side] += 1
            counts[name][f"{side}_decided"] += verdict.answer != "cannot tell"
            counts[name][f"{side}_right"] += verdict.answer == right
    return [{"set": name, "group": group, **row} for (name, group), row in sorted(counts.items())]


def by_set(examples: Sequence[Example]) -> dict[str, list[Example]]:
    groups: defaultdict[str, list[Example]] = defaultdict(list)
    for example in examples:
        groups[example.dataset].append(example)
    return groups


def coverage(examples: Sequence[Example]) -> dict[str, Any]:
    """Returns the numbers of captions, of captions with a claim, and of captions with a decided claim."""
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
