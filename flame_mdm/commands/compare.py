"""`flame-mdm compare RUN RUN ...`: compares runs on one page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import BodySettings
from flame_mdm.commands.sample import read_prompts
from flame_mdm.errors import say
from flame_mdm.reporting.compare import HEAD, Prompt, comparison, find, grouped, in_common, tested
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
    """

    OBJECTS: ClassVar = ("runs",)
    runs: list[str] = required("run directories, separated by spaces")
    prompts: str | None = option(
        None, "a file with one prompt per line, sampled by each last.ckpt; default: the newest samples of each run"
    )
    seconds: float | None = option(None, "length of the sampled motions; default 3")
    seed: int = option(0, "seed of sampling")
    out: str = option("runs/compare.html", "the page")


def main(settings: CompareSettings) -> None:
    runs = find([Path(folder) for folder in settings.runs])
    from flame_mdm.visualize.body import load_body

    texts = None if settings.prompts is None else list(dict.fromkeys(read_prompts(settings.prompts)))
    shown = [_sampled(run.folder, texts, settings) if texts else _newest(run) for run in runs.values()]
    write_text(settings.out, comparison(runs, shown, load_body(settings.body)))
    say(*_tested(runs))
    say(settings.out)


def _tested(runs: Mapping[str, Run]) -> list[str]:
    lines = in_common(runs)
    for title, columns in grouped(runs).items():
        for heading, rows in tested(columns):
            cells = [[*HEAD], *rows] if rows else []
            lines += [title, heading, *("{:34}{:>12}{:>26}  {}".format(*row) for row in cells), ""]
    return lines


def _newest(run: Run) -> dict[Prompt, Motion]:
    from flame_mdm.formats.readers import read

    numbered: dict[Prompt, Motion] = {}
    counts: Counter[str] = Counter()
    for motion in map(read, sorted(run.samples.glob("motion_*.npz")) if run.samples else ()):
        numbered[motion.text, counts[motion.text]] = motion
        counts[motion.text] += 1
    return numbered


def _sampled(run: Path, texts: list[str], settings: CompareSettings) -> dict[Prompt, Motion]:
    """Samples the last checkpoint of a run for texts or action labels."""
    import torch

    from flame_mdm.checkpoints.loading import load
    from flame_mdm.sampling.generation import sample_request
    from flame_mdm.sampling.motion_request import SamplingRequest

    model = load(run, "cuda" if torch.cuda.is_available() else "cpu")
    labels = texts[0] in model.facts["actions"]
    prompts = (None, texts) if labels else (texts, None)
    request = SamplingRequest(texts=prompts[0], actions=prompts[1], seconds=settings.seconds, seed=settings.seed)
    return {(text, 0): motion for text, motion in zip(texts, sample_request(model, request), strict=True)}
