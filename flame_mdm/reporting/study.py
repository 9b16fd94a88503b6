"""User study: a page on which people compare motions, and counts of their answers."""

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
from flame_mdm.reporting.compare import ComparedRun, Prompt, in_all
from flame_mdm.reporting.page import page, render
from flame_mdm.schemas import Int, Schema, read_json

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.visualize.body import Mesh

QUESTION = "Which animation better fits the following description?"
"""The question in Tevet et al. 2023 (MDM), appendix D."""

# The 97.5 % quantile of the standard normal distribution, for 95 % intervals
NORMAL_QUANTILE = 1.96

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
    """How often raters preferred each of two runs."""

    a: str
    b: str
    wins_a: Annotated[Int, Field(ge=0)]
    wins_b: Annotated[Int, Field(ge=0)]
    raters: Int

    @property
    def votes(self) -> int:
        """Number of ratings that prefer one of the two runs."""
        return self.wins_a + self.wins_b

    @property
    def share(self) -> tuple[float, float, float]:
        """Run `a`'s share of the votes, with the bounds of its 95 % interval."""
        return wilson(self.wins_a, self.votes)


class Ratings(Schema):
    """The file of counts that `flame-mdm compare ratings=...` writes."""

    question: str = QUESTION
    pairs: list[Pair]


def rating_page(
    compared: Sequence[ComparedRun],
    shown: Sequence[Mapping[Prompt, Motion]],
    seed: int,
    body: Mesh | None = None,
) -> str:
    """Returns a page that asks which of two motions fits a text better.

    One motion is from the first run, and the other is from another run. The page hides the names of
    the runs, and saves the answers to a file for `tally`.

    Args:
        compared: two or more runs or folders of motions.
        shown: the motions of each run, keyed by prompt.
        seed: seed for the order of the pairs, and for the side on which each motion is shown.
        body: the body to draw.

    Raises:
        UserError: If two runs have no prompt in common, except the empty prompt.
    """
    draw = random.Random(seed)
    items: list[dict[str, Any]] = []

    for other, motions in zip(compared[1:], shown[1:], strict=True):
        items += _pairs((compared[0], shown[0]), (other, motions), draw, body)
    draw.shuffle(items)

    digest = hashlib.sha256(json.dumps(items, sort_keys=True).encode()).hexdigest()[:12]
    data = {"study": digest, "items": items}
    return page("Which motion fits better?", render("study.html", question=QUESTION, data=data))


def _pairs(
    first: tuple[ComparedRun, Mapping[Prompt, Motion]],
    other: tuple[ComparedRun, Mapping[Prompt, Motion]],
    draw: random.Random,
    body: Mesh | None,
) -> list[dict[str, Any]]:
    """Returns the questions about two runs: a pair of motions for every prompt that they share."""
    from flame_mdm.visualize import player_page

    (run_a, motions_a), (run_b, motions_b) = first, other
    prompts = [prompt for prompt in in_all([motions_a, motions_b]) if prompt[0]]
    if not prompts:
        raise UserError(
            f"{run_a.label} and {run_b.label} have no prompt in common. "
            "Add prompts=FILE to sample both for the same prompts"
        )

    items = []
    for prompt in prompts:
        on_left = "a" if draw.random() < 0.5 else "b"
        left, right = motions_a[prompt], motions_b[prompt]
        if on_left == "b":
            left, right = right, left
        scene = [
            replace(left, id="the left one", text=""),
            replace(right, id="the right one", text=""),
        ]
        player = player_page(scene, "", columns=2, body=body)
        items.append(
            {
                "prompt": prompt[0],
                "a": run_a.label,
                "b": run_b.label,
                "left": on_left,
                "player": player,
            }
        )
    return items


def tally(files: Sequence[Path]) -> list[Pair]:
    """Counts the answers of several raters for each pair of runs.

    Raises:
        UserError: If a file is malformed, if two files contain the same rater's answers to the same
            page, or if a rating compares a run with itself.
    """
    answered: dict[tuple[str, str], Path] = {}
    pairs: dict[tuple[str, str], Pair] = {}
    raters: dict[tuple[str, str], set[str]] = {}

    for path in files:
        answers: Answers = read_json(path, Answers, "use a file that the rating page saved")
        study, rater = answers.study, answers.rater
        if (study, rater) in answered:
            earlier = answered[study, rater]
            raise UserError(
                f"{path}: {rater} also answered this page in {earlier}. Use only one of these files"
            )
        answered[study, rater] = path

        for number, rating in enumerate(answers.ratings, 1):
            if rating.a == rating.b:
                raise UserError(
                    f"{path}: rating {number} compares {rating.a} with itself; the runs a and b must differ"
                )
            preferred = rating.a if rating.choice == "a" else rating.b
            names = (rating.b, rating.a) if (rating.b, rating.a) in pairs else (rating.a, rating.b)
            pair = pairs.setdefault(
                names, Pair(a=names[0], b=names[1], wins_a=0, wins_b=0, raters=0)
            )
            pair.wins_a += preferred == pair.a
            pair.wins_b += preferred == pair.b
            raters.setdefault(names, set()).add(rater)
            pair.raters = len(raters[names])
    return list(pairs.values())


def wilson(wins: int, votes: int) -> tuple[float, float, float]:
    """Returns the fraction of wins and the bounds of its 95 % interval (Wilson 1927).

    The votes are assumed to be independent.
    """
    if not votes:
        return 0.0, 0.0, 1.0
    z, share = NORMAL_QUANTILE, wins / votes
    scale = 1 + z**2 / votes
    center = (share + z**2 / (2 * votes)) / scale
    half = z * math.sqrt(share * (1 - share) / votes + z**2 / (4 * votes**2)) / scale
    return share, max(0.0, center - half), min(1.0, center + half)
