"""Mean and confidence interval of repeated evaluations."""

from collections.abc import Sequence

import numpy as np


def mean_ci(values: Sequence[float]) -> tuple[float, float]:
    """Returns the mean of R replications, at least one, and the half width of its 95 % confidence interval.

    The half width is 1.96 std / sqrt(R), with R in the denominator of the variance, as in the code of Guo et al. 2022,
    MDM and MFM. It measures the variation of the evaluation, not of training. ACTOR's tables show 1.96 times the
    variance instead.
    """
    if not len(values):
        raise ValueError("mean_ci: no values")
    return float(np.mean(values)), float(1.96 * np.std(values) / len(values) ** 0.5)
