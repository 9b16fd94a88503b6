"""User study: a page on which people rate motions, and the count of their answers."""

from __future__ import annotations

import hashlib
import json
import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from flame_mdm.errors import UserError
from flame_mdm.reporting.compare import ComparedRun, Prompt, shared
from flame_mdm.reporting.page import page, render
from flame_mdm.schemas import Int, Schema, read_json

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.visualize.body import Mesh

QUESTION = "Which animation better fits the following description?"
"""As in Tevet et al. 2023 (MDM), appendix D."""

Name = Annotated[str, Field(min_length=1)]


class Rating(Schema):
    """A choice between the motions of two runs for one prompt."""

    a: Name
    b: Name
    choice: Literal["a", "b"]


class Answers(Schema):
    """The file that the rating page saves."""

    study: Name
    rater: Name
    ratings: Annotated[list[Rating], Field(min_length=1)]


class Pair(Schema):
    """How often one run was preferred to another."""

    a: str
    b: str
    wins_a: Annotated[Int, Field(ge=0)]
    wins_b: Annotated[Int, Field(ge=0)]
    raters: Int


class Ratings(Schema):
    """The count that `flame-mdm compare ratings=...` writes."""

    pairs: list[Pair]


def rating_page(
    compared: Sequence[ComparedRun], shown: Sequence[Mapping[Prompt, Motion]], seed: int, body: Mesh | None = None
) -> str:
    """Returns a page that asks which of two motions fits a text better: the first run's or another run's.

    Order and sides are random, from `seed`. The page saves the answers to a file for `tally`. Raises `UserError` if two
    runs have no prompt in common, apart from the empty one.
    """
    from flame_mdm.visualize import player_page

    first, draw = compared[0], random.Random(seed)
    items = []
    for other, those in zip(compared[1:], shown[1:], strict=True):
        prompts = [prompt for prompt in shared([shown[0], those]) if prompt[0]]
        if not prompts:
            raise UserError(
                f"{first.label} and {other.label} have no prompt in common. Give texts=... to sample both for the "
                "same prompts"
            )
        for prompt in prompts:
            left, right = sides = [("a", shown[0][prompt]), ("b", those[prompt])]
            if draw.random() < 0.5:
                left, right = reversed(sides)
            scene = [replace(left[1], id="the left one", text=""), replace(right[1], id="the right one", text="")]
            player = player_page(scene, "", columns=2, body=body)
            item = {"prompt": prompt[0], "a": first.label, "b": other.label, "left": left[0], "player": player}
            items.append(item)
    draw.shuffle(items)
    digest = hashlib.sha256(json.dumps(items, sort_keys=True).encode()).hexdigest()[:12]
    data = {"study": digest, "items": items}
    return page("Which motion fits better?", render("study.html", question=QUESTION, data=data))


def tally(files: Sequence[Path]) -> list[dict[str, Any]]:
    """Counts the answers of several raters; raises `UserError` if a file is malformed or given twice.

    `share_a` is the share of answers for a, and `interval_a` its 95 % interval, which treats all answers as
    independent.
    """
    raters: dict[tuple[str, str], Path] = {}
    counts: dict[tuple[str, str], dict[str, Any]] = {}
    for path in files:
        answers: Answers = read_json(path, Answers, "give a file that the rating page saved")
        study, rater = answers.study, answers.rater
        if (study, rater) in raters:
            raise UserError(f"{path}: {rater} also answered this page in {raters[study, rater]}. Give only one of them")
        raters[study, rater] = path
        for number, rating in enumerate(answers.ratings, 1):
            a, b, choice = rating.a, rating.b, rating.choice
            if a == b:
                raise UserError(f"{path}: rating {number} compares {a} with itself; a and b must differ")
            if (b, a) in counts:
                a, b, choice = b, a, "a" if choice == "b" else "b"
            pair = counts.setdefault((a, b), {"a": 0, "b": 0, "raters": set()})
            pair[choice] += 1
            pair["raters"].add(rater)
    pairs = []
    for (a, b), pair in counts.items():
        share, low, high = wilson(pair["a"], pair["a"] + pair["b"])
        counted = {"a": a, "b": b, "wins_a": pair["a"], "wins_b": pair["b"], "raters": len(pair["raters"])}
        pairs.append(counted | {"share_a": share, "interval_a": [max(0.0, low), min(1.0, high)]})
    return pairs


def wilson(wins: int, votes: int) -> tuple[float, float, float]:
    """Returns the share of wins and its 95 % interval (Wilson 1927)."""
    if not votes:
        return 0.0, 0.0, 1.0
    z, share = 1.96, wins / votes
    center = (share + z * z / (2 * votes)) / (1 + z * z / votes)
    half = z * math.sqrt(share * (1 - share) / votes + z * z / (4 * votes * votes)) / (1 + z * z / votes)
    return share, center - half, center + half
