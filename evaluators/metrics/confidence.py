"""The mean of repeated evaluations, and how sure it is."""

from collections.abc import Sequence

import numpy as np


def mean_ci(values: Sequence[float]) -> tuple[float, float]:
    """Mean of R replications, and half the width of its 95 % confidence interval.

    1.96 std / sqrt(R) with R in the denominator of the variance, as in the code of Guo et al. 2022, MDM and MFM. It
    tells how the evaluation varies, not how training does. ACTOR's tables show 1.96 times the variance instead.

    Raises:
        ValueError: no values.
    """
    if not len(values):
        raise ValueError("mean_ci: no values")
    return float(np.mean(values)), float(1.96 * np.std(values) / len(values) ** 0.5)
