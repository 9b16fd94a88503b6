"""`flame-mdm compare RUN RUN ...`: compares runs on one page, or conducts a user study."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import BodySettings
from flame_mdm.config.options import option
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.compare import (
    HEAD,
    ComparedRun,
    Prompt,
    comparison,
    find,
    grouped,
    in_common,
    only_runs,
    read_motions,
    tested,
)
from flame_mdm.reporting.study import Ratings, rating_page, tally
from flame_mdm.safe_io import write_json, write_text
from flame_mdm.sampling.prompt_file import PromptFile

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.runs import Run


@dataclass(frozen=True, kw_only=True)
class CompareSettings(BodySettings):
    """usage: flame-mdm compare A B C [prompts=FILE.txt] [seconds=3]
           flame-mdm compare A B FOLDER rate=true [prompts=FILE.txt]
           flame-mdm compare ratings="ann.json bob.json" out=ratings.json

    Compares runs side by side on one page: configuration differences, curves, evaluations and
    motions for the same prompts. If the runs have results for the same protocol, data and
    extractor, prints the difference in each metric with its 95 % interval, and whether the interval
    contains 0. Instead of a run, you can name a FOLDER of motion files, such as real motions
    (`browse motions=FOLDER`) or motions from another program. Motions with the same captions and
    lengths are then sampled from the runs. rate=true writes a blind user study instead: a page that
    asks which of two motions fits a text better. ratings= counts the answers.
    """

    OBJECTS: ClassVar = ("runs",)
    runs: list[str] | None = option(
        None, "run directories or folders of motion files, separated by spaces"
    )
    prompts: str | None = option(
        None,
        "file with one prompt per line, to sample from the last.ckpt of each run. Default: the "
        "captions of the first folder of motion files or, without such a folder, the newest samples "
        "of each run",
    )
    seconds: float | None = option(
        None,
        "length of the sampled motions in seconds; default: 3, or the lengths of the motions in "
        "the folder",
    )
    seed: int = option(0, "seed for sampling, and for the order in which motions are rated")
    rate: bool = option(
        False,
        "write a rating page that compares motions of the first run with motions of every other run",
    )
    ratings: list[str] | None = option(
        None, "files of ratings to count, as saved by the rating page"
    )
    out: str | None = option(
        None, "file to write; default: runs/compare.html, runs/rate.html or runs/ratings.json"
    )


def main(settings: CompareSettings) -> None:
    """Compares runs on a page, or counts the ratings in a user study."""
    if (settings.runs is None) == (settings.ratings is None):
        raise UserError(
            'use either runs="A B" to compare runs, or ratings="x.json y.json" to count ratings'
        )
    if settings.ratings is not None:
        _count([Path(file) for file in settings.ratings], settings.out or "runs/ratings.json")
    else:
        _compare([Path(folder) for folder in settings.runs or ()], settings)


def _count(files: Sequence[Path], out: str) -> None:
    pairs = tally(files)
    write_json(out, {"format": 1, **Ratings(pairs=pairs).model_dump()})

    for pair in pairs:
        share, low, high = pair.share
        interval = f"{share:.1%} ({low:.1%} to {high:.1%})"
        say(
            f"{pair.a} over {pair.b}: {pair.wins_a} of {pair.votes} answers, {interval}, {pair.raters} raters"
        )
    say(f"written: {out}")


def _compare(folders: Sequence[Path], settings: CompareSettings) -> None:
    compared = find(folders)
    from flame_mdm.sampling.referee.judging import evidence_marks

    body = settings.read_body()
    shown = _motions(compared, settings)
    if settings.rate:
        out = settings.out or "runs/rate.html"
        content = rating_page(compared, shown, settings.seed, body)
    else:
        out = settings.out or "runs/compare.html"
        content = comparison(compared, shown, body, evidence_marks)
        say(*_tested(only_runs(compared)))

    write_text(out, content)
    say(out)


def _tested(runs: Mapping[str, Run]) -> list[str]:
    lines = in_common(runs)
    for title, columns in grouped(runs).items():
        for heading, rows in tested(columns):
            cells = [[*HEAD], *rows] if rows else []
            lines += [title, heading, *("{:40}{:>12}{:>26}  {}".format(*row) for row in cells), ""]
    return lines


def _motions(
    compared: Sequence[ComparedRun], settings: CompareSettings
) -> list[dict[Prompt, Motion]]:
    """Returns the motions of each run and folder, keyed by prompt.

    Motions are sampled from each run's last checkpoint, for the requested prompts or, if there are
    none, for the captions and lengths of the motions in the first folder. Without prompts or
    folders, the newest samples of each run are returned.
    """
    from_files = {
        entry.label: read_motions(entry.folder) for entry in compared if entry.run is None
    }

    prompts: dict[Prompt, float | None] = {}
    if settings.prompts is not None:
        prompts = {
            (text, 0): settings.seconds for text in _texts(PromptFile.read(settings.prompts))
        }
    elif from_files:
        reference = next(iter(from_files.values()))
        for prompt, motion in reference.items():
            if prompt[0]:
                prompts[prompt] = settings.seconds or len(motion.joints) / motion.fps

    shown = []
    for entry in compared:
        if entry.run is None:
            shown.append(from_files[entry.label])
        elif prompts:
            shown.append(_sampled(entry, prompts, settings.seed))
        else:
            shown.append(read_motions(entry.run.samples) if entry.run.samples else {})
    return shown


def _texts(prompts: PromptFile) -> list[str]:
    """Returns the prompts in a file.

    If any prompts are refused, raises the error for the first of them.
    """
    for number in sorted(prompts.refused):
        raise prompts.refused[number]
    return list(prompts.lines.values())


def _sampled(
    entry: ComparedRun, prompts: Mapping[Prompt, float | None], seed: int
) -> dict[Prompt, Motion]:
    """Samples motions for texts or action labels from a run's last checkpoint.

    Args:
        entry: the run.
        prompts: the prompts, each with the length of its motion in seconds. Either all lengths are
            numbers, or all of them are None (the default length). Lengths above the model's maximum
            are reduced to it.
        seed: seed of the noise. If a prompt is listed twice, its motions are sampled from different
            noise.
    """
    import torch

    from flame_mdm.checkpoints.loading import load
    from flame_mdm.sampling.generation import sample
    from flame_mdm.sampling.motion_request import SamplingRequest
    from flame_mdm.sampling.resolution import resolve

    model = load(entry.folder, "cuda" if torch.cuda.is_available() else "cpu")
    lengths = [seconds for seconds in prompts.values() if seconds is not None]
    longest = model.facts["max_frames"] / model.representation.fps
    too_long = sum(seconds > longest for seconds in lengths)
    if too_long:
        limit = f"shortened to {longest:g} seconds, the maximum length for {entry.label}"
        say(f"{too_long} of {len(lengths)} motions are {limit}")

    texts = [text for text, _ in prompts]
    is_action = texts[0] in model.facts["actions"]
    request = SamplingRequest(
        texts=None if is_action else texts,
        actions=texts if is_action else None,
        seconds=[min(seconds, longest) for seconds in lengths] or None,
        seed=seed,
        split=False,
    )
    # Runs may know different words, but all of them are compared on all prompts.
    motions = sample(model, resolve(request, model, check_words=False))
    return dict(zip(prompts, motions, strict=True))
