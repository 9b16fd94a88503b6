"""95 % intervals of values and of paired differences."""

import numpy as np
from numpy.typing import ArrayLike


def percentiles(drawn: ArrayLike, value: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Returns the interval of a bootstrap, whose draws (R,) or (R, K) are shifted so that their mean is the value.

    Efron and Tibshirani 1993, section 13.3. The shift is for values such as Fréchet distances, which are larger for
    sets with repetitions (section 10.6): the interval is that of the value for the same number of motions.
    """
    drawn = np.asarray(drawn, np.float64)
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0) - drawn.mean(0) + value
    return low, high


def paired_difference(first: ArrayLike, second: ArrayLike) -> tuple[float, float, float]:
    """Returns the mean of second - first over R pairs, and its interval by Student's t, which is NaN if R is 1."""
    from scipy.stats import t

    difference = np.subtract(second, first)
    count, mean = len(difference), float(difference.mean())
    half = float(t.ppf(0.975, count - 1) * difference.std(ddof=1) / count**0.5) if count > 1 else float("nan")
    return mean, mean - half, mean + half
