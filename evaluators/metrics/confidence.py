"""Confidence intervals of metrics: over repeated evaluations, and by bootstrap over motions."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from flame_mdm.reporting.intervals import percentiles


def mean_ci(values: Sequence[float]) -> tuple[float, float]:
    """Returns the mean of R replications, and the half width of its 95 % confidence interval.

    The half width is 1.96 std / sqrt(R), with R in the denominator of the variance, as in the code of Guo et al. 2022,
    MDM and MFM. It measures the variation of the evaluation, not of training. ACTOR's tables show 1.96 times the
    variance instead.

    Raises:
        ValueError: If there are no values.
    """
    if not len(values):
        raise ValueError("mean_ci: no values")
    return float(np.mean(values)), float(1.96 * np.std(values) / len(values) ** 0.5)


class Interval(NamedTuple):
    """Values of all motions and their 95 % intervals: numbers, or arrays (K,) if the statistic returns K numbers."""

    value: np.ndarray
    low: np.ndarray
    high: np.ndarray


def bootstrap(
    count: int,
    statistic: Callable[[np.ndarray], float | Sequence[float] | np.ndarray],
    *,
    resamples: int = 1000,
    seed: int = 0,
) -> Interval:
    """Returns a statistic of `count` motions, with its 95 % interval by bootstrap over the motions.

    Sets are drawn with replacement; the interval is that of `flame_mdm.reporting.intervals.percentiles`.

    For a difference of two models on the same texts and noise, the statistic subtracts both values of the same indices,
    `lambda i: fid(a[i]) - fid(b[i])`. The interval is then as narrow as the two are alike.

    Args:
        count: N, number of motions.
        statistic: function of indices (N,) of motions that returns one or K numbers; repeated indices are repeated
            motions. NaN gives an interval of NaN.
        resamples: number of sets.
        seed: of the random draws.

    Raises:
        ValueError: If there are no motions.
    """
    if count < 1:
        raise ValueError("bootstrap: no motions")
    generator = np.random.default_rng(seed)
    value = np.asarray(statistic(np.arange(count)), np.float64)
    drawn = np.stack([np.asarray(statistic(generator.integers(count, size=count))) for _ in range(resamples)])
    return Interval(value, *percentiles(drawn, value))
