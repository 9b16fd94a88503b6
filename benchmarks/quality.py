"""Quality of models trained in both speeds: `python benchmarks/quality.py FOLDER`.

Trains nothing: reads the runs in a folder, each trained by `make train ... speed=...` and evaluated by `make evaluate`,
with two or more seeds per data set and speed. Gives the mean over the seeds and its 95 % interval by Student's t. The
difference is that of the runs with the same seed, which begin with the same weights and see the same batches.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Sequence
from pathlib import Path

from scipy.stats import t
from sections import Row, Section, section, show

from flame_mdm.schemas import CONFIG, Run, read_run

METRICS = {
    "attributes/all": "requested attributes, share right",
    "sides/all": "side, share right",
    "fid": "FID",
    "texts_for_motion/top3": "R precision, top 3",
    "foot_skating": "foot skating, share of frames",
    "jitter": "jitter, m/s³",
}
SPEEDS = ("reference", "fast")


def values(run: Run) -> dict[str, float]:
    """Returns the final validation loss of a run and the metrics of its newest result."""
    losses = run.curves.get("val/loss", {})
    result = list(run.results.values())[-1].values if run.results else None
    if not losses or not result:
        raise SystemExit(f"{run.folder}: not validated or not evaluated. Run `make evaluate CKPT={run.folder}`")
    found = {label: value.mean for name, label in METRICS.items() if (value := result.get(name)) is not None}
    return {"val/loss": losses[max(losses)]} | {label: mean for label, mean in found.items() if mean is not None}


def interval(sample: Sequence[float]) -> tuple[float, float]:
    """Returns the mean of two or more numbers, and the half width of its 95 % interval by Student's t."""
    size = len(sample)
    return statistics.mean(sample), float(t.ppf(0.975, size - 1)) * statistics.stdev(sample) / size**0.5


def shown(sample: Sequence[float], sign: str = "") -> str:
    """Returns mean and half width with as many decimals as the half width has in two significant digits."""
    mean, half = interval(sample)
    decimals = next((n for n in range(6) if half >= 10 ** (1 - n)), 6 if half else 2)
    return f"{mean:{sign},.{decimals}f} ± {half:,.{decimals}f}"


def measure(*words: str) -> Section:
    """Compares the runs in the folder in `words`."""
    found: dict[str, dict[str, dict[int, dict[str, float]]]] = {}
    for path in sorted(Path(words[0]).glob(f"*/{CONFIG}")):
        run = read_run(path.parent)
        config = run.config
        name = f"{config['data']['name']}, {config['trainer']['max_steps']:,} steps, ema.decay={config['ema']['decay']}"
        speeds = found.setdefault(name, {speed: {} for speed in SPEEDS})
        speeds[config["run"].get("speed", "reference")][config["seed"]] = values(run)
    tables: dict[str, list[Row]] = {}
    differing, total = [], 0
    for name, speeds in found.items():
        seeds = sorted(speeds["reference"])
        if len(seeds) < 2 or seeds != sorted(speeds["fast"]):
            raise SystemExit(f"{words[0]}: {name}: needs the same two or more seeds in both speeds")
        rows = tables.setdefault(f"{name}, {len(seeds)} seeds", [])
        for metric in speeds["reference"][seeds[0]]:
            slow, fast = ([speeds[speed][seed][metric] for seed in seeds] for speed in SPEEDS)
            difference = [b - a for a, b in zip(slow, fast, strict=True)]
            mean, half = interval(difference)
            differing += [f"{metric} ({name.split(',')[0]})"] * (abs(mean) > half)
            total += 1
            both = {"speed=reference": shown(slow), "speed=fast": shown(fast)}
            rows.append({"metric": metric, **both, "fast − reference": shown(difference, "+")})
    if not tables:
        raise SystemExit(f"{words[0]}: contains no runs. docs/speed.md has the commands that train and evaluate them")
    return section(
        "Quality in both speeds",
        "Each speed is trained with several seeds, and evaluated once on the test motions. Means over the seeds, with "
        "95 % intervals by Student's t. The differences are those of runs with the same seed, which begin with the "
        "same weights and see the same batches. [Commands](../speed.md#quality).",
        f"In {total - len(differing)} of {total} figures of quality, the interval of `fast` − `reference` contains 0"
        + (f"; the others: {', '.join(differing)}." if differing else "."),
        **tables,
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
