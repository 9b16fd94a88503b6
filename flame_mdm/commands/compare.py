"""`flame-mdm compare RUN RUN ...`: compares runs on one page, or conducts a user study."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flame_mdm.commands.sample import read_prompts
from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say
from flame_mdm.reporting.compare import HEAD, MOTIONS, ComparedRun, Prompt, comparison, find, grouped, in_common, tested
from flame_mdm.reporting.report import paths
from flame_mdm.reporting.study import QUESTION, rating_page, tally
from flame_mdm.safe_io import write_json, write_text

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.runs import Run

USAGE = """
usage: flame-mdm compare runs="A B C" [texts="a person walks; a person jumps"]
       flame-mdm compare runs="A B FOLDER" rate=true [texts=prompts.txt]
       flame-mdm compare ratings="ann.json bob.json" out=ratings.json

Compares runs side by side on one page: configuration differences, curves, evaluations and motions for the same prompts.
If the runs have results of the same protocol, data and extractor, prints the difference of each metric with its 95 %
intervals, and whether it is shown.
rate=true writes a blind user study instead: a page that asks which of two motions fits a text better. ratings= counts
the answers. FOLDER holds motion files, for example real motions: unless texts= is given, the runs are then sampled for
the captions of these motions, at their lengths. Keys, with their defaults: experiments/compare.yaml
"""


def compare(config: Config) -> None:
    """Writes the requested page, or counts ratings.

    Raises:
        UserError: If not exactly one of `runs` and `ratings` is given, there are fewer than two runs, a folder holds no
            run, or a file of ratings is malformed.
    """
    if (config["runs"] is None) == (config["ratings"] is None):
        raise UserError('give either runs="A B" to compare runs, or ratings="x.json y.json" to count ratings')
    if config["ratings"] is not None:
        out, pairs = Path(config["out"] or "runs/ratings.json"), tally(paths("ratings", str(config["ratings"])))
        write_json(out, {"format": 1, "question": QUESTION, "pairs": pairs})
        for pair in pairs:
            low, high = pair["interval_a"]
            say(
                f"{pair['a']} over {pair['b']}: {pair['wins_a']} of {pair['wins_a'] + pair['wins_b']} answers, "
                f"{pair['share_a']:.1%} ({low:.1%} to {high:.1%}), {pair['raters']} raters"
            )
        say(f"written: {out}")
        return
    from flame_mdm.visualize.bodies import load_body

    body = load_body(config["body"])
    compared = find(paths("runs", str(config["runs"])))
    shown = motions(compared, config)
    if config["rate"]:
        out = Path(config["out"] or "runs/rate.html")
        content = rating_page(compared, shown, config["seed"], body)
    else:
        out, content = Path(config["out"] or "runs/compare.html"), comparison(compared, shown, body)
        say(*_tested({c.label: c.run for c in compared if c.run is not None}))
    write_text(out, content)
    say(out)


main = partial(
    run,
    compare,
    usage=USAGE,
    name="compare",
    objects=("runs*",),
    text=("runs", "texts", "ratings", "out", "body"),
    kinds={"seconds": "float", "seed": "int"},
)


def _tested(runs: Mapping[str, Run]) -> list[str]:
    """Returns lines about the differences of evaluations that two runs have in common."""
    lines = in_common(runs)
    for title, columns in grouped(runs).items():
        for heading, rows in tested(columns):
            cells = [[*HEAD], *rows] if rows else []
            lines += [title, heading, *("{:34}{:>12}{:>26}{:>26}  {}".format(*row) for row in cells), ""]
    return lines


def motions(compared: Sequence[ComparedRun], config: Config) -> list[dict[Prompt, Motion]]:
    """Returns the motions of each compared run, by prompt.

    The last checkpoint of each run is sampled for `texts`. Without `texts`, it is sampled for the captions of the first
    folder of motions, at the lengths of these motions. Without either, the newest samples of each run are used.

    Raises:
        UserError: If a file of texts is empty, or `generate` refuses the request.
        ValueError: If a file is damaged.
    """
    given = {c.label: _read(c.folder) for c in compared if c.run is None}
    wanted: dict[Prompt, float | None] = {}
    if config["texts"] is not None:
        wanted = {(text, 0): None for text in read_texts(str(config["texts"]))}
    elif given:
        first = next(iter(given.values()))
        wanted = {p: None if config["seconds"] else len(shown.joints) / shown.fps for p, shown in first.items() if p[0]}
    found = []
    for compared_run in compared:
        if compared_run.run is None:
            found.append(given[compared_run.label])
        elif wanted:
            found.append(_sampled(compared_run, wanted, config))
        else:
            found.append(_read(compared_run.run.samples) if compared_run.run.samples else {})
    return found


def _read(folder: Path) -> dict[Prompt, Motion]:
    """Returns the motions of a folder; equal captions are numbered."""
    from flame_mdm.formats.readers import read

    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in MOTIONS and path.name[0] != "."]
    return _by_prompt([read(path) for path in files])


def read_texts(given: str) -> list[str]:
    """Returns texts that are separated by semicolons, or the lines of a .txt file, without duplicates.

    Raises:
        UserError: If there is no text, or the file does not exist or is not a text file.
    """
    if given.endswith(".txt"):
        return list(dict.fromkeys(read_prompts(given, "texts")))
    texts = [part.strip() for part in given.split(";") if part.strip()]
    if not texts:
        raise UserError(f'texts={given}: contains no text. Give texts="a person walks; a person jumps" or a .txt file')
    return list(dict.fromkeys(texts))


def _sampled(compared_run: ComparedRun, wanted: Mapping[Prompt, float | None], config: Config) -> dict[Prompt, Motion]:
    """Samples a run's last checkpoint for texts or action labels.

    Motions longer than the model supports are shortened to its maximum. If a prompt is requested several times, its
    repetitions use the seeds after the configured one.

    Args:
        compared_run: the run.
        wanted: length in seconds of each motion; None = the default length of `generate`.
        config: the configuration of the command.
    """
    import torch

    from flame_mdm.checkpoints.loading import load
    from flame_mdm.sampling.generation import generate

    model = load(compared_run.folder, "cuda" if torch.cuda.is_available() else "cpu")
    fps, longest = model.representation.fps, model.facts["max_frames"]
    lengths = {prompt: round(seconds * fps) for prompt, seconds in wanted.items() if seconds is not None}
    if over := sum(length > longest for length in lengths.values()):
        limit = f"shortened to {longest / fps:g} seconds, the maximum length for {compared_run.label}"
        say(f"{over} of {len(lengths)} motions are {limit}")
    found: dict[Prompt, Motion] = {}
    for count in sorted({count for _, count in wanted}):
        prompts = [prompt for prompt in wanted if prompt[1] == count]
        texts = [text for text, _ in prompts]
        labels = texts[0] in model.facts["actions"]
        made = generate(
            model,
            None if labels else texts,
            actions=texts if labels else None,
            seconds=config["seconds"],
            frames=[min(lengths[prompt], longest) for prompt in prompts if prompt in lengths] or None,
            seed=config["seed"] + count,
        )
        found |= zip(prompts, made, strict=True)
    return {prompt: found[prompt] for prompt in wanted}


def _by_prompt(found: Sequence[Motion]) -> dict[Prompt, Motion]:
    counts: Counter[str] = Counter()
    prompts: dict[Prompt, Motion] = {}
    for motion in found:
        prompts[motion.text, counts[motion.text]] = motion
        counts[motion.text] += 1
    return prompts
