"""`flame-mdm compare RUN RUN ...`: compares runs on one page, or conducts a user study."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import BodySettings, check_words
from flame_mdm.commands.sample import read_prompts
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.compare import HEAD, MOTIONS, ComparedRun, Prompt, comparison, find, grouped, in_common, tested
from flame_mdm.reporting.study import QUESTION, rating_page, tally
from flame_mdm.safe_io import write_json, write_text
from flame_mdm.sampler_options import option

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.runs import Run


@dataclass(frozen=True, kw_only=True)
class CompareSettings(BodySettings):
    """usage: flame-mdm compare A B C [texts="a person walks; a person jumps"]
           flame-mdm compare A B FOLDER rate=true [texts=prompts.txt]
           flame-mdm compare ratings="ann.json bob.json" out=ratings.json

    Compares runs side by side on one page: configuration differences, curves, evaluations and motions for the same
    prompts. If the runs have results of the same protocol, data and extractor, prints the difference of each metric
    with its 95 % intervals, and whether it is shown.
    rate=true writes a blind user study instead: a page that asks which of two motions fits a text better. ratings=
    counts the answers. FOLDER holds motion files, for example real motions: unless texts= is given, the runs are then
    sampled for the captions of these motions, at their lengths.
    """

    OBJECTS: ClassVar = ("runs",)
    runs: list[str] | None = option(None, "run directories, or folders of motion files, separated by spaces")
    texts: str | None = option(
        None,
        '"a person walks; a person jumps", or a .txt file with one text per line, sampled by each last.ckpt; default: '
        "the captions of the first folder of motions; without such a folder, the newest samples of each run",
    )
    seconds: float | None = option(None, "length of the sampled motions; default 3, or those in that folder")
    seed: int = option(0, "seed of sampling, and of the order in which motions are rated")
    rate: bool = option(False, "write a rating page: motions of the first run against those of each other run")
    ratings: list[str] | None = option(None, "files saved by the rating page, to be counted")
    out: str | None = option(None, "default runs/compare.html, runs/rate.html or runs/ratings.json")


def main(settings: CompareSettings) -> None:
    if (settings.runs is None) == (settings.ratings is None):
        raise UserError('give either runs="A B" to compare runs, or ratings="x.json y.json" to count ratings')
    check_words(settings)
    if settings.ratings is not None:
        out, pairs = Path(settings.out or "runs/ratings.json"), tally([Path(file) for file in settings.ratings])
        write_json(out, {"format": 1, "question": QUESTION, "pairs": pairs})
        for pair in pairs:
            low, high = pair["interval_a"]
            answers = f"{pair['wins_a']} of {pair['wins_a'] + pair['wins_b']} answers"
            share = f"{pair['share_a']:.1%} ({low:.1%} to {high:.1%})"
            say(f"{pair['a']} over {pair['b']}: {answers}, {share}, {pair['raters']} raters")
        say(f"written: {out}")
        return
    assert settings.runs is not None
    compared = find([Path(folder) for folder in settings.runs])
    from flame_mdm.visualize.bodies import load_body

    body = load_body(settings.body)
    shown = motions(compared, settings)
    if settings.rate:
        out = Path(settings.out or "runs/rate.html")
        content = rating_page(compared, shown, settings.seed, body)
    else:
        out, content = Path(settings.out or "runs/compare.html"), comparison(compared, shown, body)
        say(*_tested({c.label: c.run for c in compared if c.run is not None}))
    write_text(out, content)
    say(out)


def _tested(runs: Mapping[str, Run]) -> list[str]:
    lines = in_common(runs)
    for title, columns in grouped(runs).items():
        for heading, rows in tested(columns):
            cells = [[*HEAD], *rows] if rows else []
            lines += [title, heading, *("{:34}{:>12}{:>26}{:>26}  {}".format(*row) for row in cells), ""]
    return lines


def motions(compared: Sequence[ComparedRun], settings: CompareSettings) -> list[dict[Prompt, Motion]]:
    """Returns the motions of each compared run, by prompt.

    The last checkpoint of each run is sampled for `texts`. Without `texts`, it is sampled for the captions of the first
    folder of motions, at the lengths of these motions. Without either, the newest samples of each run are used.
    """
    real = {c.label: _read(c.folder) for c in compared if c.run is None}
    prompts: dict[Prompt, float | None] = {}
    if settings.texts is not None:
        prompts = {(text, 0): None for text in read_texts(settings.texts)}
    elif real:
        first = next(iter(real.values()))
        lengths = {prompt: len(motion.joints) / motion.fps for prompt, motion in first.items() if prompt[0]}
        prompts = {prompt: None if settings.seconds else length for prompt, length in lengths.items()}
    shown = []
    for compared_run in compared:
        if compared_run.run is None:
            shown.append(real[compared_run.label])
        elif prompts:
            shown.append(_sampled(compared_run, prompts, settings))
        else:
            shown.append(_read(compared_run.run.samples) if compared_run.run.samples else {})
    return shown


def _read(folder: Path) -> dict[Prompt, Motion]:
    from flame_mdm.formats.readers import read

    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in MOTIONS and path.name[0] != "."]
    numbered: dict[Prompt, Motion] = {}
    counts: Counter[str] = Counter()
    for motion in map(read, files):
        numbered[motion.text, counts[motion.text]] = motion
        counts[motion.text] += 1
    return numbered


def read_texts(texts: str) -> list[str]:
    """Returns texts that are separated by semicolons, or the lines of a .txt file, without duplicates."""
    if texts.endswith(".txt"):
        return list(dict.fromkeys(read_prompts(texts, "texts")))
    parts = [part.strip() for part in texts.split(";") if part.strip()]
    if not parts:
        raise UserError(f'texts={texts}: contains no text. Give texts="a person walks; a person jumps" or a .txt file')
    return list(dict.fromkeys(parts))


def _sampled(
    compared_run: ComparedRun, prompts: Mapping[Prompt, float | None], settings: CompareSettings
) -> dict[Prompt, Motion]:
    """Samples a run's last checkpoint for texts or action labels, each with its seconds or, if None, the default.

    Motions longer than the model supports are shortened to its maximum. If a prompt is requested several times, its
    repetitions use the seeds after the configured one.
    """
    import torch

    from flame_mdm.checkpoints.loading import load
    from flame_mdm.sampling.generation import sample_request
    from flame_mdm.sampling.request import SamplingRequest

    model = load(compared_run.folder, "cuda" if torch.cuda.is_available() else "cpu")
    fps, longest = model.representation.fps, model.facts["max_frames"]
    lengths = {prompt: round(seconds * fps) for prompt, seconds in prompts.items() if seconds is not None}
    if over := sum(length > longest for length in lengths.values()):
        limit = f"shortened to {longest / fps:g} seconds, the maximum length for {compared_run.label}"
        say(f"{over} of {len(lengths)} motions are {limit}")
    sampled: dict[Prompt, Motion] = {}
    for count in sorted({count for _, count in prompts}):
        numbered = [prompt for prompt in prompts if prompt[1] == count]
        texts = [text for text, _ in numbered]
        labels = texts[0] in model.facts["actions"]
        request = SamplingRequest(
            texts=None if labels else texts,
            actions=texts if labels else None,
            seconds=settings.seconds,
            frames=[min(lengths[prompt], longest) for prompt in numbered if prompt in lengths] or None,
            seed=settings.seed + count,
        )
        sampled |= zip(numbered, sample_request(model, request), strict=True)
    return {prompt: sampled[prompt] for prompt in prompts}
