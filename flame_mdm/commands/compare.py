"""`flame-mdm compare RUN RUN ...`: compares runs on one page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import BodySettings
from flame_mdm.commands.sample import read_prompts
from flame_mdm.errors import say
from flame_mdm.reporting.compare import HEAD, MOTIONS, ComparedRun, Prompt, comparison, find, grouped, in_common, tested
from flame_mdm.safe_io import write_text
from flame_mdm.sampler_options import option, required

if TYPE_CHECKING:
    from flame_mdm.formats.motion import Motion
    from flame_mdm.runs import Run


@dataclass(frozen=True, kw_only=True)
class CompareSettings(BodySettings):
    """usage: flame-mdm compare A B C [prompts=FILE.txt] [seconds=3]

    Compares runs side by side on one page: configuration differences, curves, evaluations and motions for the same
    prompts. If the runs have results of the same protocol, data and extractor, prints the difference of each metric
    with its 95 % interval, and whether it is shown.
    A run may also be a folder of motion files, for example those of another program.
    """

    OBJECTS: ClassVar = ("runs",)
    runs: list[str] = required("run directories, or folders of motion files, separated by spaces")
    prompts: str | None = option(
        None, "a file with one prompt per line, sampled by each last.ckpt; default: the newest samples of each run"
    )
    seconds: float | None = option(None, "length of the sampled motions; default 3")
    seed: int = option(0, "seed of sampling")
    out: str = option("runs/compare.html", "the page")


def main(settings: CompareSettings) -> None:
    compared = find([Path(folder) for folder in settings.runs])
    from flame_mdm.visualize.bodies import load_body

    content = comparison(compared, motions(compared, settings), load_body(settings.body))
    say(*_tested({c.label: c.run for c in compared if c.run is not None}))
    write_text(settings.out, content)
    say(settings.out)


def _tested(runs: Mapping[str, Run]) -> list[str]:
    lines = in_common(runs)
    for title, columns in grouped(runs).items():
        for heading, rows in tested(columns):
            cells = [[*HEAD], *rows] if rows else []
            lines += [title, heading, *("{:34}{:>12}{:>26}  {}".format(*row) for row in cells), ""]
    return lines


def motions(compared: Sequence[ComparedRun], settings: CompareSettings) -> list[dict[Prompt, Motion]]:
    """Returns the motions of each compared run, by prompt: sampled for `prompts`, or else its newest samples."""
    texts = None if settings.prompts is None else list(dict.fromkeys(read_prompts(settings.prompts)))
    shown = []
    for entry in compared:
        folder = entry.run.samples if entry.run else entry.folder
        if texts and entry.run:
            shown.append(_sampled(entry.folder, texts, settings))
        else:
            shown.append(_read(folder) if folder else {})
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


def _sampled(run: Path, texts: list[str], settings: CompareSettings) -> dict[Prompt, Motion]:
    """Samples the last checkpoint of a run for texts or action labels."""
    import torch

    from flame_mdm.checkpoints.loading import load
    from flame_mdm.sampling.generation import sample_request
    from flame_mdm.sampling.request import SamplingRequest

    model = load(run, "cuda" if torch.cuda.is_available() else "cpu")
    labels = texts[0] in model.facts["actions"]
    request = SamplingRequest(
        texts=None if labels else texts,
        actions=texts if labels else None,
        seconds=settings.seconds,
        seed=settings.seed,
    )
    return {(text, 0): motion for text, motion in zip(texts, sample_request(model, request), strict=True)}
