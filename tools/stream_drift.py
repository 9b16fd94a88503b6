"""Measures long streams, and writes docs/benchmarks/streams.json and the page and figure that show the results.

    python tools/stream_drift.py [MODEL]

MODEL generates several streams of five minutes, in which the text changes every ten seconds. The
texts are captions for single synthetic actions that rules can recognize. The last minute repeats the
texts of the first minute, so that both can be compared. Without MODEL, only the page and the figure
are regenerated.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from markupsafe import Markup

import flame_mdm
from evaluators.extractors import MotionCLIPExtractor
from evaluators.metrics.attributes import UNDECIDED, read_all, right_attributes
from evaluators.metrics.distribution import frechet_distance
from evaluators.metrics.physics import FootSkating, Jitter
from flame_mdm.data.synthetic import draw_captions
from flame_mdm.data.synthetic_actions import ACTIONS
from flame_mdm.data.synthetic_motions.body import Attributes
from flame_mdm.data.synthetic_sequences import ENDS, STARTS, SyntheticSequences
from flame_mdm.generator import MotionGenerator
from flame_mdm.progress import ProgressBar
from flame_mdm.reporting.plots import Panel, Series, svg, svg_file
from flame_mdm.representations.humanml import HumanML
from flame_mdm.safe_io import read_json, write_json, write_text
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.streams import OnlineCleanup, Streams, starting_point
from flame_mdm.seeds import key

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "benchmarks"
STREAMS = 32
MINUTES = 5
SECONDS_PER_TEXT = 10
TEXTS_PER_MINUTE = 60 // SECONDS_PER_TEXT
PERIODS = {"0–10 s": (0, 10), "50–60 s": (50, 60), "290–300 s": (290, 300)}
WINDOW = 2.0  # length in seconds of the windows that FID compares
SHOWN = (2.0, 3.0, 4.0)  # lengths in seconds of the windows that are searched for an action
LATEST = 4.0  # seconds from a text change to the latest end of these windows
IN_TIME = 2.0  # seconds after a text change within which an action is recognized "in time"
DEEP = 0.03  # toes that are more than this many meters below the floor are counted
TOES = [10, 11]
HEAD = 15


INTRODUCTION = """# Long streams, measured

[Streams](../streams.md) explains how a stream works. `python tools/stream_drift.py {model}` computes the figures on
this page.

The measurements use {streams} streams of {minutes} minutes each. The text changes every ten seconds, so each stream has
{texts} texts. The texts are captions for single synthetic actions. The last minute repeats the texts of the first
minute, so that the two minutes can be compared. Unless stated otherwise, the motions are not cleaned up.

## Drift

![Skating, head height and jitter for each ten seconds](streams-figure.svg)

{periods}

FID compares two-second windows of the streams with two-second windows of synthetic motions that the model has not
seen. It is computed with the package's motion-CLIP. For comparison, a second set of unseen synthetic motions has an FID
of {real_fid}.
The jitter is {first} m/s³ in the first minute and {last} m/s³ in the last minute ({ratio} times as high).

In 99.9 % of the frames, no toe is more than {low} cm below the floor. At most, a toe sinks {lowest} cm below
the floor. In the same streams with `cleanup=true`, a toe sinks at most {cleaned_lowest} cm below the floor, and in
{cleaned_deep} of {cleaned_frames} frames, a toe is more than 3 cm below the floor.

## Seams

This table shows the largest step of a joint from one frame to the next, and the largest change of such a step, in
meters:

{seams}

## Texts

Of {changes} actions, {in_time} ({in_time_share} %) are recognized in the first two seconds after the text changes. In
the first four seconds after the change, {right} ({share} %) are recognized in at least one window of two, three or four
seconds. The following actions were not recognized every time: {actions}.
"""


def main(model: str | None) -> None:
    if model is not None:
        write_json(FOLDER / "streams.json", measured(flame_mdm.load(model), model))
    results = read_json(FOLDER / "streams.json")
    write_text(FOLDER / "streams.md", page(results))
    drawing = figure(results)
    assert drawing is not None
    write_text(FOLDER / "streams-figure.svg", svg_file(drawing))


def measured(model: MotionGenerator, name: str) -> dict[str, Any]:
    """Returns the contents of streams.json for a model.

    Args:
        model: a model that continues frames.
        name: name of the model, which is shown on the page.
    """
    fps = model.representation.fps
    requests = [texts(number) for number in range(STREAMS)]
    joints, seams, cleaned = streamed(model, requests)
    lows, cleaned_lows = (positions[..., TOES, 1].min(-1) for positions in (joints, cleaned))
    extractor = MotionCLIPExtractor("motion_clip_synthetic", "cpu")
    windows = round(WINDOW * fps)
    per_period = round((PERIODS["0–10 s"][1] - PERIODS["0–10 s"][0]) * fps) // windows * STREAMS
    real = encoded(extractor, real_windows(per_period, windows, fps, seed=1))
    other = encoded(extractor, real_windows(per_period, windows, fps, seed=2))
    periods = {
        title: in_period(joints[:, round(begin * fps) : round(end * fps)], fps, extractor, real)
        for title, (begin, end) in PERIODS.items()
    }
    minute = round(60 * fps)
    jitter = [value(Jitter(fps), part) for part in (joints[:, :minute], joints[:, -minute:])]
    return {
        "format": 1,
        "model": name,
        "streams": STREAMS,
        "minutes": MINUTES,
        "finite": bool(np.isfinite(joints).all()),
        "lowest_toe": {
            "minimum": float(lows.min()),
            "percentile_0.1": float(np.quantile(lows, 0.001)),
            "percentile_1": float(np.quantile(lows, 0.01)),
        },
        "cleaned_toes": {
            "minimum": float(cleaned_lows.min()),
            "frames": cleaned_lows.size,
            "deep": int((cleaned_lows < -DEEP).sum()),
        },
        "jitter_first_minute": jitter[0],
        "jitter_last_minute": jitter[1],
        "real_fid": float(frechet_distance(other, real)),
        "periods": periods,
        "over_time": over_time(joints, fps),
        "seams": seams,
        "recognized": recognized(joints, requests, fps),
    }


def over_time(joints: np.ndarray, fps: float) -> dict[str, list[float]]:
    """Returns skating, head height and jitter for every ten seconds of the streams (B, F, 22, 3)."""
    length = round(SECONDS_PER_TEXT * fps)
    parts = [joints[:, begin : begin + length] for begin in range(0, joints.shape[1], length)]
    return {
        "skating": [value(FootSkating(fps), part) for part in parts],
        "height of the head, m": [float(np.median(part[..., HEAD, 1])) for part in parts],
        "jitter, m/s³": [value(Jitter(fps), part) for part in parts],
    }


def figure(results: dict[str, Any]) -> Markup | None:
    """Returns an SVG figure of skating, head height and jitter over time."""
    panels = [
        Panel(
            [Series(name, [(SECONDS_PER_TEXT * number, y) for number, y in enumerate(values)])],
            "seconds",
            name,
            legend=False,
        )
        for name, values in results["over_time"].items()
    ]
    return svg("Streams over time", panels)


def texts(stream: int) -> list[tuple[str, Attributes]]:
    """Returns a text and its attributes for each ten seconds of a stream.

    The last minute repeats the texts of the first minute.
    """
    names = [
        name for name, action in ACTIONS.items() if name not in UNDECIDED and not action.reverse
    ]
    rng = np.random.default_rng(key("streams", str(stream)))
    posture = "standing"
    requests = []
    for _ in range((MINUTES - 1) * TEXTS_PER_MINUTE):
        # A standing person cannot stand up, and a person lying on the floor cannot type.
        fitting = [name for name in names if STARTS.get(name, "standing") in ("standing", posture)]
        name = str(rng.choice(fitting))
        attributes = ACTIONS[name].draw(rng, name)
        posture = ENDS.get(name, "standing")
        requests.append((draw_captions(rng, attributes, 1)[0][0], attributes))
    return requests + requests[:TEXTS_PER_MINUTE]


def streamed(
    model: MotionGenerator, requests: Sequence[Sequence[tuple[str, Attributes]]]
) -> tuple[np.ndarray, dict[str, float], np.ndarray]:
    """Runs one stream per list of requests.

    Returns:
        The joint positions (B, F, 22, 3), the movement at seams and inside blocks (see `seams_of`),
        and the joint positions after cleanup, which lack the last block.
    """
    prefix, _ = starting_point(model, None)
    first = [request[0][0] for request in requests]
    streams = Streams(
        model,
        [f"stream {number}" for number in range(len(requests))],
        first,
        prefix.repeat(len(requests), 1, 1),
        None,
        SamplerOptions(),
    )
    fps = model.representation.fps
    for schedule, request in zip(streams.schedules, requests, strict=True):
        for number, (text, _) in enumerate(request[1:], 1):
            schedule.add(round(number * SECONDS_PER_TEXT * fps), text)
    frames = round(MINUTES * 60 * fps)
    blocks, begins = [], [0]
    cleanups = [OnlineCleanup(model.representation) for _ in requests]
    clean_blocks = []
    for _ in ProgressBar(range(-(-frames // streams.block)), desc="streaming"):
        motions = next(streams)
        block = np.stack([motion.joints for motion in motions])
        pairs = zip(cleanups, motions, strict=True)
        clean = [cleaned.joints for online, motion in pairs if (cleaned := online.add(motion))]
        clean_blocks += [np.stack(clean)] if clean else []
        blocks.append(block)
        begins.append(begins[-1] + block.shape[1])
    joints = np.concatenate(blocks, 1)[:, :frames]
    return joints, seams_of(joints, np.array(begins[1:-1])), np.concatenate(clean_blocks, 1)


def seams_of(joints: np.ndarray, seams: np.ndarray) -> dict[str, float]:
    """Returns the medians and 99th percentiles of the largest step of any joint and of its largest change, in meters.

    Frames at seams and inside blocks are measured separately.
    """
    figures = {}
    for name, order in (("step", 1), ("change of step", 2)):
        size = np.linalg.norm(np.diff(joints, order, axis=1), axis=-1).max(-1)
        at_seam = np.zeros(size.shape[1], bool)
        for offset in range(order):
            at_seam[seams - 1 - offset] = True
        for place, chosen in (("seam", size[:, at_seam]), ("inside", size[:, ~at_seam])):
            figures[f"{name}, {place}, median"] = float(np.median(chosen))
            figures[f"{name}, {place}, percentile 99"] = float(np.quantile(chosen, 0.99))
    return figures


def in_period(
    joints: np.ndarray, fps: float, extractor: MotionCLIPExtractor, real: torch.Tensor
) -> dict[str, float]:
    """Returns the metrics of all streams in one period.

    Args:
        joints: joint positions (B, F, 22, 3) in the period.
        fps: frames per second.
        extractor: the extractor for FID.
        real: features (N, E) of real motions.
    """
    length = round(WINDOW * fps)
    windows = joints.reshape(-1, length, *joints.shape[2:])
    return {
        "fid": float(frechet_distance(encoded(extractor, windows), real)),
        "skating": value(FootSkating(fps), joints),
        "head": float(np.median(joints[..., HEAD, 1])),
        "lowest_toe": float(joints[..., TOES, 1].min(-1).mean()),
        "jitter": value(Jitter(fps), joints),
    }


def encoded(extractor: MotionCLIPExtractor, windows: np.ndarray) -> torch.Tensor:
    """Returns the features (N, E) of windows (N, F, 22, 3), which do not depend on world position or heading."""
    representation = HumanML(variant="clean")
    features = torch.stack([representation.encode(torch.from_numpy(w).float()) for w in windows])
    mask = torch.ones(features.shape[:2], dtype=torch.bool)
    with torch.no_grad():
        return extractor.motions(features, torch.from_numpy(windows), mask)["features"].double()


def real_windows(count: int, length: int, fps: float, seed: int) -> np.ndarray:
    """Returns windows (N, F, 22, 3) from synthetic motions that are similar to the training data but not part of it."""
    source = SyntheticSequences(clips=10 * count, seed=seed)
    rng = np.random.default_rng(seed)
    windows: list[np.ndarray] = []
    for clip in source.clips(fps):
        motion = np.asarray(clip.motion)
        if len(motion) > length:
            begin = int(rng.integers(len(motion) - length))
            windows.append(motion[begin : begin + length])
        if len(windows) == count:
            break
    return np.stack(windows)


def value(metric: FootSkating | Jitter, joints: np.ndarray) -> float:
    """Returns a metric computed over motions (B, F, 22, 3)."""
    mask = torch.ones(joints.shape[:2], dtype=torch.bool)
    metric.update(torch.from_numpy(joints), mask, keys=torch.arange(len(joints)))
    return metric.compute()


def recognized(
    joints: np.ndarray, requests: Sequence[Sequence[tuple[str, Attributes]]], fps: float
) -> dict[str, Any]:
    """Counts the requested actions that are recognized.

    `in_time` counts actions in the first two seconds after a text change. `right` counts actions in any
    window that ends at most `LATEST` seconds after the change.
    """
    in_time = 0
    right: dict[str, list[int]] = {}
    for motion, request in zip(joints, requests, strict=True):
        for number, (_, attributes) in enumerate(request):
            begin = number * SECONDS_PER_TEXT
            shown = any(
                is_shown(
                    motion[round((begin + late) * fps) : round((begin + late + length) * fps)],
                    attributes,
                    fps,
                )
                for length in SHOWN
                for late in np.arange(0, LATEST - length + 0.01, 0.25)
            )
            first = motion[round(begin * fps) : round((begin + IN_TIME) * fps)]
            in_time += is_shown(first, attributes, fps)
            counts = right.setdefault(str(attributes["action"]), [0, 0])
            counts[0] += shown
            counts[1] += 1
    total = sum(count for count, _ in right.values()), sum(count for _, count in right.values())
    return {
        "in_time": in_time,
        "right": total[0],
        "changes": total[1],
        "actions": dict(sorted(right.items())),
    }


def is_shown(motion: np.ndarray, attributes: Attributes, fps: float) -> bool:
    """Returns whether the rules recognize the requested action in a motion (F, 22, 3)."""
    action = {"action": attributes["action"]}
    return bool(right_attributes(read_all(motion, fps), action).get("action"))


def page(results: dict[str, Any]) -> str:
    """Returns the contents of streams.md."""
    low, seams, shown = results["lowest_toe"], results["seams"], results["recognized"]
    cleaned = results["cleaned_toes"]
    ratio = results["jitter_last_minute"] / results["jitter_first_minute"]
    rows = [
        "| period | FID | skating | height of the head, m | lowest toe, m | jitter, m/s³ |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    for title, row in results["periods"].items():
        rows.append(
            f"| {title} | {row['fid']:.3f} | {row['skating']:.4f} | {row['head']:.3f} | {row['lowest_toe']:.3f} | "
            f"{row['jitter']:.1f} |"
        )
    moves = ["| | at seams | inside blocks |", "|---|---:|---:|"]
    for name in ("step", "change of step"):
        for figure in ("median", "percentile 99"):
            values = [seams[f"{name}, {place}, {figure}"] for place in ("seam", "inside")]
            moves.append(f"| {name}, {figure} | {values[0]:.4f} | {values[1]:.4f} |")
    actions = [
        f"{name} {right} of {total}"
        for name, (right, total) in shown["actions"].items()
        if right < total
    ]
    return INTRODUCTION.format(
        model=results["model"],
        streams=results["streams"],
        minutes=results["minutes"],
        texts=results["minutes"] * TEXTS_PER_MINUTE,
        periods="\n".join(rows),
        real_fid=f"{results['real_fid']:.3f}",
        first=f"{results['jitter_first_minute']:.1f}",
        last=f"{results['jitter_last_minute']:.1f}",
        ratio=f"{ratio:.2f}",
        low=f"{100 * -low['percentile_0.1']:.1f}",
        lowest=f"{100 * -low['minimum']:.1f}",
        cleaned_lowest=f"{100 * -cleaned['minimum']:.1f}",
        cleaned_deep=cleaned["deep"],
        cleaned_frames=f"{cleaned['frames']:,}",
        in_time=shown["in_time"],
        in_time_share=f"{100 * shown['in_time'] / shown['changes']:.1f}",
        seams="\n".join(moves),
        right=shown["right"],
        changes=shown["changes"],
        share=f"{100 * shown['right'] / shown['changes']:.1f}",
        actions=", ".join(actions),
    )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else None)
