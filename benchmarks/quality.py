"""Compares the quality of models trained at both speeds: `make bench ONLY=quality RUNS=FOLDER`.

This script does not train models. It reads the runs in a folder, which must have been trained with
`make train ... speed=...` and evaluated with `make evaluate`, with at least two seeds per data set
and speed. Values are means over the seeds, with 95 % intervals (Student's t). Differences are
computed between runs with the same seed, which begin with the same weights and use the same batches.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path

from scipy.stats import t
from sections import Row, Section, Settings, section

from flame_mdm.reporting.compare import paired_difference
from flame_mdm.runs import CONFIG, Run, read_run

METRICS = {
    "attributes/all": "requested attributes, share correct",
    "sides/all": "side, share correct",
    "fid": "FID",
    "texts_for_motion/top3": "R precision, top 3",
    "foot_skating": "foot skating, share of frames",
    "jitter": "jitter, m/s³",
}
SPEEDS = ("reference", "fast")
BySeed = dict[int, dict[str, float]]  # seed -> metric -> value


def values(run: Run) -> dict[str, float]:
    """Returns the final validation loss of a run, and the metrics of its latest evaluation, by label."""
    losses = run.curves.get("val/loss", {})
    result = list(run.results.values())[-1].values if run.results else None
    if not losses or not result:
        raise SystemExit(
            f"{run.folder}: not validated or not evaluated. Run `make evaluate CKPT={run.folder}`"
        )

    numbers = {"val/loss": losses[max(losses)]}
    for name, label in METRICS.items():
        value = result.get(name)
        if value is not None and value.mean is not None:
            numbers[label] = value.mean
    return numbers


def read_runs(folder: Path) -> dict[str, dict[str, BySeed]]:
    """Returns the values of all runs in a folder, by training setup (data set, steps, decay), speed and seed."""
    runs: dict[str, dict[str, BySeed]] = {}
    for path in sorted(folder.glob(f"*/{CONFIG}")):
        run = read_run(path.parent)
        config = run.config
        steps, decay = config["trainer"]["max_steps"], config["ema"]["decay"]
        name = f"{config['data']['name']}, {steps:,} steps, ema.decay={decay}"
        speeds = runs.setdefault(name, {speed: {} for speed in SPEEDS})
        speeds[config["run"].get("speed", "reference")][config["seed"]] = values(run)
    if not runs:
        raise SystemExit(
            f"{folder}: contains no runs. Train runs with `make train ... speed=...`, and evaluate them"
        )
    return runs


def shown(mean: float, half: float, sign: str = "") -> str:
    """Returns a mean and the half width of its interval as text.

    Both are rounded to two significant digits of the half width.

    Args:
        mean: the mean.
        half: half the width of its interval.
        sign: "+" also shows the sign of positive means.
    """
    decimals = next((count for count in range(6) if half >= 10 ** (1 - count)), 6 if half else 2)
    return f"{mean:{sign},.{decimals}f} ± {half:,.{decimals}f}"


def interval(sample: Sequence[float]) -> tuple[float, float]:
    """Returns the mean of at least two numbers, and half the width of its 95 % interval by Student's t."""
    count = len(sample)
    quantile = float(t.ppf(0.975, count - 1))
    return statistics.mean(sample), quantile * statistics.stdev(sample) / count**0.5


def measure(settings: Settings) -> Section:
    """Compares the metrics of runs that differ only in their speed, and returns the page section."""
    folder = Path(settings.runs or ".")
    tables: dict[str, list[Row]] = {}
    differing: list[str] = []
    for name, speeds in read_runs(folder).items():
        seeds = sorted(speeds["reference"])
        if len(seeds) < 2 or seeds != sorted(speeds["fast"]):
            raise SystemExit(
                f"{folder}: {name}: requires at least two seeds, the same at both speeds"
            )

        rows = tables.setdefault(f"{name}, {len(seeds)} seeds", [])
        for metric in speeds["reference"][seeds[0]]:
            slow, fast = ([speeds[speed][seed][metric] for seed in seeds] for speed in SPEEDS)
            mean, low, high = paired_difference(slow, fast)
            row: Row = {
                "metric": metric,
                "speed=reference": shown(*interval(slow)),
                "speed=fast": shown(*interval(fast)),
            }
            rows.append(row | {"fast − reference": shown(mean, (high - low) / 2, "+")})
            if not low <= 0 <= high:
                differing.append(f"{metric} ({name.split(',')[0]})")

    total = sum(map(len, tables.values()))
    equal = total - len(differing)
    others = f"; the others: {', '.join(differing)}" if differing else ""
    return section(
        "Quality at both speeds",
        """At each speed, models are trained with several seeds and evaluated once on the test motions. Values are means
        over the seeds, with 95 % intervals (Student's t). Differences are computed between runs with the same seed,
        which begin with the same weights and use the same batches.""",
        f"For {equal} of {total} quality figures, the 95 % interval of `fast` − `reference` contains 0{others}.",
        tables,
    )
