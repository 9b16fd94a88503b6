"""Runs side by side on one web page, and a page for people to judge them: `python -m flame_mdm.compare runs="A B"`"""

from __future__ import annotations

import hashlib
import json
import random
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flame_mdm.config import Config, UserError, flatten, run
from flame_mdm.evaluate import write_json
from flame_mdm.report import (
    Run,
    charted,
    evaluation_title,
    interval,
    last,
    marks,
    paths,
    read_run,
    sampling,
    steps,
)
from flame_mdm.results import read_json, read_text
from flame_mdm.tables import wilson
from flame_mdm.visualize.page import chart, frame, number, page, table
from flame_mdm.visualize.scene import written_whole

if TYPE_CHECKING:
    from flame_mdm.visualize import Motion

USAGE = """
usage: python -m flame_mdm.compare runs="A B C" [texts="a person walks; a person jumps"]
       python -m flame_mdm.compare runs="A B FOLDER" rate=true [texts=prompts.txt]
       python -m flame_mdm.compare ratings="ann.json bob.json" out=ratings.json

Puts runs side by side on one page: what their recipes differ in, curves, evaluations and motions for the same prompts.
rate=true writes a page that asks which of two motions fits a text better, without saying whose they are; ratings=
counts the answers. FOLDER holds motion files, such as real ones: without texts=, the runs sample for its captions at
its lengths. Keys: experiments/compare.yaml
"""

QUESTION = "Which animation better fits the following description?"
"""As in Tevet et al. 2023 (MDM), appendix D."""

Prompt = tuple[str, int]
"""What a motion was asked to be, and its number among those asked the same."""


@dataclass
class Contestant:
    """A run, or a folder of motions, under the name that pages give it."""

    label: str
    folder: Path
    run: Run | None


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    text, like = ("runs", "texts", "ratings", "out"), ("flame_mdm.generation.generate",)
    return run(compare, words, usage=USAGE, name="compare", text=text, like=like)


def compare(config: Config) -> None:
    """Writes the page that the configuration asks for, or counts ratings.

    Raises:
        UserError: not one of both asked for, too few runs, folders without a run, or malformed ratings.
    """
    if (config["runs"] is None) == (config["ratings"] is None):
        raise UserError('give one of runs="A B" to compare and ratings="x.json y.json" to count')
    if config["ratings"] is not None:
        out, pairs = Path(config["out"] or "runs/ratings.json"), tally(paths("ratings", str(config["ratings"])))
        write_json(out, {"format": 1, "question": QUESTION, "pairs": pairs})
        for pair in pairs:
            low, high = pair["interval_a"]
            print(
                f"{pair['a']} over {pair['b']}: {pair['wins_a']} of {pair['wins_a'] + pair['wins_b']} answers, "
                f"{pair['share_a']:.1%} ({low:.1%} to {high:.1%}), {pair['raters']} raters"
            )
        print(f"written: {out}")
        return
    contestants = find(paths("runs", str(config["runs"])))
    shown = motions(contestants, config)
    if config["rate"]:
        out, content = Path(config["out"] or "runs/rate.html"), rating_page(contestants, shown, config["seed"])
    else:
        out, content = Path(config["out"] or "runs/compare.html"), comparison(contestants, shown)
    with written_whole(out) as temporary:
        temporary.write_text(content, encoding="utf-8")
    print(out)


def find(folders: Sequence[Path]) -> list[Contestant]:
    """The runs in some folders, by recipe and name, or by folder where two have the same.

    Raises:
        UserError: fewer than two; a folder that holds neither a run nor motions.
    """
    if len(set(folders)) < 2:
        raise UserError(f'comparing takes two runs or more: runs="A B", not {" ".join(map(str, folders))}')
    found = []
    for folder in folders:
        if (folder / "config.yaml").is_file():
            content = read_run(folder)
            found.append(Contestant(content.label, folder, content))
        elif any(folder.glob("*.npz")):
            found.append(Contestant(folder.name, folder, None))
        else:
            raise UserError(f"{folder}: neither a run (no config.yaml) nor a folder of motions (no .npz files)")
    labels = [contestant.label for contestant in found]
    return [replace(c, label=str(c.folder)) if labels.count(c.label) > 1 else c for c in found]


def motions(contestants: Sequence[Contestant], config: Config) -> list[dict[Prompt, Motion]]:
    """Motions by prompt of each contestant.

    Runs show what their last checkpoint makes of `texts`, or else of the captions of the first folder of motions, at
    the lengths of its motions; where there is neither, their newest samples.

    Raises:
        UserError: no texts in the file, or what `generate` refuses. ValueError: a damaged file.
    """
    given = {c.label: _read(c.folder) for c in contestants if c.run is None}
    wanted: dict[Prompt, float | None] = {}
    if config["texts"] is not None:
        wanted = {(text, 0): None for text in read_texts(str(config["texts"]))}
    elif given:
        first = next(iter(given.values()))
        wanted = {p: None if config["seconds"] else shown.seconds for p, shown in first.items() if p[0]}
    found = []
    for contestant in contestants:
        if contestant.run is None:
            found.append(given[contestant.label])
        elif wanted:
            found.append(_sampled(contestant, wanted, config))
        else:
            found.append(_read(contestant.run.samples) if contestant.run.samples else {})
    return found


def _read(folder: Path) -> dict[Prompt, Motion]:
    """Motions of a folder, whose equal captions are counted."""
    from flame_mdm.formats import read

    return _by_prompt([read(path) for path in sorted(folder.glob("*.npz"))])


def read_texts(given: str) -> list[str]:
    """Texts with semicolons between them, or the lines of a .txt file.

    Raises:
        UserError: there are none, or no such file.
    """
    if given.endswith(".txt") and not Path(given).is_file():
        raise UserError(f"texts={given}: no such file")
    parts = read_text(Path(given)).splitlines() if given.endswith(".txt") else given.split(";")
    texts = [part.strip() for part in parts if part.strip()]
    if not texts:
        raise UserError(f'texts={given}: no text in it; texts="a person walks; a person jumps", or a .txt file')
    return list(dict.fromkeys(texts))


def _sampled(contestant: Contestant, wanted: Mapping[Prompt, float | None], config: Config) -> dict[Prompt, Motion]:
    """Motions of a run's last checkpoint for texts or labels, each of so many seconds; None = as `generate` has it.

    Motions that would be longer than the run samples are made as long as it does. Those of a text that is wanted more
    than once have the seeds that follow the configuration's.
    """
    import torch

    from flame_mdm.generation import generate
    from flame_mdm.task import load
    from flame_mdm.visualize import Motion

    model = load(contestant.folder / "checkpoints" / "last.ckpt", "cuda" if torch.cuda.is_available() else "cpu")
    fps, longest = model.representation.fps, model.facts["max_frames"]
    lengths = {prompt: round(seconds * fps) for prompt, seconds in wanted.items() if seconds is not None}
    if over := sum(length > longest for length in lengths.values()):
        told = f"made {longest / fps:g} seconds long, the most that {contestant.label} samples"
        print(f"{over} of {len(lengths)} motions are {told}")
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
        for prompt, shown in zip(prompts, made, strict=True):
            found[prompt] = Motion(shown.joints, shown.fps, model.representation.skeleton, caption=shown.caption)
    return {prompt: found[prompt] for prompt in wanted}


def _by_prompt(found: Sequence[Motion]) -> dict[Prompt, Motion]:
    prompts: dict[Prompt, Motion] = {}
    for motion in found:
        count = sum(caption == motion.caption for caption, _ in prompts)
        prompts[motion.caption, count] = motion
    return prompts


def shared(shown: Sequence[Mapping[Prompt, Motion]]) -> list[Prompt]:
    """Prompts that all have a motion for, in the order of the first."""
    return [prompt for prompt in shown[0] if all(prompt in those for those in shown[1:])]


# Side by side ---------------------------------------------------------------------------------------------------------


def comparison(contestants: Sequence[Contestant], shown: Sequence[Mapping[Prompt, Motion]]) -> str:
    """The page that puts runs side by side. The same runs give the same bytes."""
    runs = {c.label: c.run for c in contestants if c.run is not None}
    parts = [
        f"<h1>{escape(' · '.join(c.label for c in contestants))}</h1>",
        _facts(runs),
        _differences(runs),
        _players(contestants, shown),
        _results(runs),
        _curves(runs),
    ]
    return page("Comparison", "\n".join(filter(None, parts)))


def _facts(runs: Mapping[str, Run]) -> str:
    rows = [
        [
            label,
            f"{steps(found):,}",
            number(last(found.curves.get("train/epochs", {}))),
            f"{count / 1e6:.2f} M" if (count := found.provenance.get("parameters")) else "–",
            number(_median(found, "train/seconds_per_step")),
            number(_median(found, "train/samples_per_second")),
            found.provenance.get("device", "–"),
            found.provenance.get("data", {}).get("fingerprint", "–"),
            str(found.folder),
        ]
        for label, found in runs.items()
    ]
    head = ["run", "steps", "passes", "parameters", "s a step", "samples a second", "device", "data", "folder"]
    return table(head, rows) if rows else ""


def _median(found: Run, name: str) -> float | None:
    curve = found.curves.get(name)
    return statistics.median(curve.values()) if curve else None


def _differences(runs: Mapping[str, Run]) -> str:
    """What the recipes differ in."""
    configs = [flatten(found.config) for found in runs.values()]
    keys = sorted({key for config in configs for key in config if key != "experiment" and not key.startswith("run.")})
    rows = [[key, *(str(config[key]) if key in config else "–" for config in configs)] for key in keys]
    rows = [row for row in rows if len(set(row[1:])) > 1]
    if len(runs) < 2:
        return ""
    told = table(["", *runs], rows) if rows else "<p class='faint'>None.</p>"
    return f"<h2>What the recipes differ in</h2>{told}"


def _players(contestants: Sequence[Contestant], shown: Sequence[Mapping[Prompt, Motion]]) -> str:
    from flame_mdm.visualize import player_page

    prompts = shared(shown)
    head = "<h2>Motions for the same prompts</h2>"
    if not prompts:
        return f"{head}<p class='faint'>The runs have no prompt in common; texts=... samples each for the same.</p>"
    scene = [
        replace(those[prompt], id=c.label, caption=prompt[0] or "unconditioned")
        for prompt in prompts
        for c, those in zip(contestants, shown, strict=True)
    ]
    return head + frame(player_page(scene, "", columns=len(contestants)), 760)


def _results(runs: Mapping[str, Run]) -> str:
    """Evaluations, those in one table that may be compared."""
    groups: dict[str, list[tuple[str, dict[str, Any]]]] = {}
    for label, found in runs.items():
        for result in found.results.values():
            groups.setdefault(f"{evaluation_title(result)}, data {result['data']['fingerprint']}", []).append(
                (label, result)
            )
    parts = []
    for title, columns in sorted(groups.items()):
        names = sorted({name for _, result in columns for name in result["values"] or {}})
        real = columns[0][1]["ground_truth"] or {}
        heads = [f"{label} [{k}]" for k, (label, _) in enumerate(columns, 1)]
        rows = [
            [name, interval(real.get(name)), *(interval((result["values"] or {}).get(name)) for _, result in columns)]
            for name in names
        ]
        notes = "".join(
            f"<p class='faint'>[{k}] {escape(sampling(result))}"
            + "".join(f" <span class='bad'>{escape(mark)}</span>" for mark in marks(result))
            + "</p>"
            for k, (_, result) in enumerate(columns, 1)
        )
        parts.append(f"<h3>{escape(title)}</h3>{table(['', 'real motions', *heads], rows, numbers=True)}{notes}")
    return f"<h2>Evaluations</h2>{''.join(parts)}" if parts else ""


def _curves(runs: Mapping[str, Run]) -> str:
    everything = {f"{label}/{name}": curve for label, found in runs.items() for name, curve in found.curves.items()}
    if not everything:
        return ""
    names = sorted({name for found in runs.values() for name in found.curves})
    parts = []
    groups = charted({name: {0: 0.0} for name in names})
    for title, charts in groups.items():
        drawn = []
        for rest, families in charts.items():
            for family in families:
                name = f"{family}/{rest}"
                lines = {label: found.curves[name] for label, found in runs.items() if name in found.curves}
                widths = {label: runs[label].curves.get(f"{name}/ci", {}) for label in lines}
                if len({value for line in lines.values() for value in line.values()}) > 1:
                    drawn.append(chart(name, lines, widths))
        parts.append(f"<h2>{title}</h2><div class='charts'>{''.join(drawn)}</div>" if drawn else "")
    return "".join(parts)


# Ratings --------------------------------------------------------------------------------------------------------------


def rating_page(contestants: Sequence[Contestant], shown: Sequence[Mapping[Prompt, Motion]], seed: int) -> str:
    """The page that asks which of two motions fits a text better: the first contestant's or that of each other one.

    Order and sides are drawn from `seed`. The answers come as a file to download, for `tally`.

    Raises:
        UserError: two have no prompt in common, or motions without a prompt.
    """
    from flame_mdm.visualize import player_page

    first, draw = contestants[0], random.Random(seed)
    items = []
    for other, those in zip(contestants[1:], shown[1:], strict=True):
        prompts = [prompt for prompt in shared([shown[0], those]) if prompt[0]]
        if not prompts:
            raise UserError(
                f"{first.label} and {other.label} have no prompt in common to be judged by; sample both for the same "
                "with texts=..."
            )
        for prompt in prompts:
            left, right = sides = [("a", shown[0][prompt]), ("b", those[prompt])]
            if draw.random() < 0.5:
                left, right = reversed(sides)
            scene = [replace(left[1], id="the left one", caption=""), replace(right[1], id="the right one", caption="")]
            player = player_page(scene, "", columns=2)
            item = {"prompt": prompt[0], "a": first.label, "b": other.label, "left": left[0], "player": player}
            items.append(item)
    draw.shuffle(items)
    digest = hashlib.sha256(json.dumps(items, sort_keys=True).encode()).hexdigest()[:12]
    data = json.dumps({"study": digest, "items": items}).replace("<", "\\u003c")  # no text can close the element
    template = Path(__file__).with_name("rate.html").read_text(encoding="utf-8")
    body = template.replace("__QUESTION__", escape(QUESTION)).replace("__DATA__", data)
    return page("Which motion fits better?", body)


def tally(files: Sequence[Path]) -> list[dict[str, Any]]:
    """Counts the answers of several raters.

    Returns:
        For each pair of labels: `a`, `b`, `wins_a`, `wins_b`, `raters`, `share_a`, the share of answers for a, and
        `interval_a`, its 95 % interval as if all answers were independent (Wilson 1927).

    Raises:
        UserError: a file that is malformed, or a rater's answers to the same page given twice.
    """
    raters: dict[tuple[str, str], Path] = {}
    counts: dict[tuple[str, str], dict[str, Any]] = {}
    for path in files:
        content = read_json(path)
        study, rater = _known(path, content, "study"), _known(path, content, "rater")
        if (study, rater) in raters:
            raise UserError(f"{path}: {rater} has answered the same page in {raters[study, rater]}; give one of both")
        raters[study, rater] = path
        ratings = content.get("ratings")
        if not isinstance(ratings, list) or not ratings:
            raise UserError(f"{path}: holds no ratings; it should be what the rating page lets download")
        for place, rating in enumerate(ratings, 1):
            where = f"rating {place}"
            a, b, choice = (_known(path, rating, key, where) for key in ("a", "b", "choice"))
            if choice not in ("a", "b") or a == b:
                raise UserError(f"{path}: {where} chooses '{choice}' of {a} and {b}; it must be a or b of two")
            if (b, a) in counts:
                a, b, choice = b, a, "a" if choice == "b" else "b"
            pair = counts.setdefault((a, b), {"a": 0, "b": 0, "raters": set()})
            pair[choice] += 1
            pair["raters"].add(rater)
    return [_pair(a, b, pair["a"], pair["b"], len(pair["raters"])) for (a, b), pair in counts.items()]


def _known(path: Path, content: Any, key: str, where: str = "the file") -> str:
    value = content.get(key) if isinstance(content, dict) else None
    if not isinstance(value, str) or not value:
        raise UserError(f"{path}: {where} has no '{key}'; it should be what the rating page lets download")
    return value


def _pair(a: str, b: str, wins_a: int, wins_b: int, raters: int) -> dict[str, Any]:
    share, low, high = wilson(wins_a, wins_a + wins_b)
    return {
        **{"a": a, "b": b, "wins_a": wins_a, "wins_b": wins_b, "raters": raters},
        **{"share_a": share, "interval_a": [max(0.0, low), min(1.0, high)]},
    }


if __name__ == "__main__":
    sys.exit(main())
