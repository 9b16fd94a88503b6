# pyright: standard
"""Distances between the feature distributions of generated and real motions: FID, KID, precision and recall."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from evaluators.metrics.samples import Rows, TwoSets

# Number of neighbors that define the manifold of `PrecisionRecall`, as in MoDi and MDM
NEIGHBORS = 3


def frechet_distance(a: Tensor, b: Tensor) -> Tensor:
    """Computes the Fréchet distance between normal distributions fitted to the rows of a (N, E) and b (M, E).

    It is computed in float64 as |m_a - m_b|^2 + tr S_a + tr S_b - 2 tr (S_a S_b)^(1/2) (Dowson and
    Landau 1982).

    Example:
        >>> a = torch.randn(50, 2, dtype=torch.float64)
        >>> round(frechet_distance(a, a + 1).item(), 9)  # only the means differ, by 1 in each feature
        2.0
    """
    # No matrix square root is needed. With the QR decomposition A / sqrt(N - 1) = Q_a R_a of the
    # centered rows, and likewise for b, the last trace is the sum of the singular values of R_a
    # R_b^T. This also holds for rank-deficient covariances, for which an iterative square root
    # fails.
    r_a, r_b = (torch.linalg.qr((x - x.mean(0)) / (len(x) - 1) ** 0.5, mode="r").R for x in (a, b))
    shared = torch.linalg.svdvals(r_a @ r_b.T).sum()
    return ((a.mean(0) - b.mean(0)) ** 2).sum() + (r_a**2).sum() + (r_b**2).sum() - 2 * shared


class FrechetMotionDistance(TwoSets):
    """Fréchet distance of motion features: "FID" (Heusel et al. 2017) or "FD" (FLAME); see `frechet_distance`.

    Covariances have N - 1 in the denominator, as in the authors' code. The authors' code computes
    means in float32 and uses scipy's `sqrtm` for the product; if `sqrtm` fails, 1e-6 is added to
    the diagonals. The values agree with the authors' code up to a relative error of 1e-8.

    Lower is better. The value is biased upward, especially for few samples, so compare only values
    for the same number of samples. `update` takes `generated` (B, E) with `keys` (B,), and `real`
    (R, E) with `real_keys` (R,).

    Example:
        >>> metric, real = FrechetMotionDistance(), torch.randn(50, 2)
        >>> metric.update(generated=real + 1, keys=torch.arange(50), real=real, real_keys=torch.arange(50))
        >>> round(metric.compute(), 4)
        2.0
    """

    higher_is_better = False

    def value(self, generated: Tensor, real: Tensor) -> float:
        """Computes the distance between features (N, E) and (M, E). Raises `UserError` if N or M is below 2."""
        self.need(len(generated), 2, "generated motions")
        self.need(len(real), 2, "real motions")
        # Rounding errors may make the value slightly negative.
        return max(frechet_distance(generated, real).item(), 0.0)

    def weighted(self, rows: Rows, weights: np.ndarray) -> dict[str, np.ndarray]:
        """Computes the distance between sets in which each motion is repeated as often as it was drawn."""
        generated, real = rows["generated"], rows["real"]
        values = []
        for times in map(torch.from_numpy, weights):
            drawn = generated.repeat_interleave(times[: len(generated)], 0)
            values.append(frechet_distance(drawn, real.repeat_interleave(times, 0)).item())
        return {"": np.array(values)}


def polynomial_mmd2(a: Tensor, b: Tensor) -> Tensor:
    """Computes the unbiased squared MMD of a (n, E) and b (n, E) with the kernel (x . y / E + 1)^3.

    Source: Bińkowski et al. 2018, eq. 4. As in the authors' code, the pairs (i, i) across the sets
    are included.

    Example:
        >>> polynomial_mmd2(torch.ones(4, 1), torch.ones(4, 1)).item()
        0.0
    """
    n, width = a.shape
    inner_a, inner_b, cross = ((x @ y.T / width + 1) ** 3 for x, y in ((a, a), (b, b), (a, b)))
    within = inner_a.sum() - inner_a.trace() + inner_b.sum() - inner_b.trace()
    return within / (n * (n - 1)) - 2 * cross.mean()


class KernelMotionDistance(TwoSets):
    """Kernel distance between sets of motion features, "KID" (Bińkowski et al. 2018).

    `mean` is the mean of `polynomial_mmd2` over random subsets; lower is better. `std` is the
    standard deviation over the subsets. `update` takes `generated` (B, E) with `keys` (B,), and
    `real` (R, E) with `real_keys` (R,).

    Args:
        subsets: number of random subsets.
        subset_size: number of samples drawn from each set for each subset. Each set must contain at
            least this number of samples.
        replace: whether to draw with replacement, as the code of MoDi and MDM does if there are
            more real motions than `subset_size`. Samples that are drawn twice increase the value.
        seed: seed of the draws.

    Example:
        >>> metric, keys = KernelMotionDistance(subsets=2, subset_size=4), torch.arange(8)
        >>> metric.update(generated=torch.ones(8, 1), keys=keys, real=torch.ones(8, 1), real_keys=keys)
        >>> metric.compute()
        {'mean': 0.0, 'std': 0.0}
    """

    higher_is_better = False
    directions: Mapping[str, bool | None] = {"std": None}
    summary = "mean"
    names = ("mean", "std")

    def __init__(
        self, subsets: int = 100, subset_size: int = 1000, replace: bool = False, seed: int = 0
    ):
        super().__init__()
        self.subsets, self.subset_size, self.replace, self.seed = (
            subsets,
            subset_size,
            replace,
            seed,
        )

    def value(self, generated: Tensor, real: Tensor) -> dict[str, float | None]:
        """Computes `mean` and `std` from two sets of features, (N, E) and (M, E).

        Raises `UserError` if a set has fewer than `subset_size` samples.
        """
        for name, features in (("generated", generated), ("real", real)):
            self.need(
                len(features), self.subset_size, f"{name} motions for subsets of {self.subset_size}"
            )
        draw, values = np.random.default_rng(self.seed).choice, []
        for _ in range(self.subsets):
            subsets = (
                x[draw(len(x), self.subset_size, replace=self.replace)] for x in (generated, real)
            )
            values.append(polynomial_mmd2(*subsets))
        mmd2 = torch.stack(values)
        return {"mean": mmd2.mean().item(), "std": mmd2.std(unbiased=False).item()}


def manifold_coverage(points: Tensor, samples: Tensor) -> Tensor:
    """Returns the fraction of `points` (M, E) that lie in the manifold of `samples` (N, E).

    A point is in the manifold if its distance from some sample is at most the distance between that
    sample and its third-nearest neighbor (Kynkäänniemi et al. 2019, eq. 1 and 2). A sample is not a
    neighbor of itself.

    Example:
        >>> samples = torch.tensor([[0.0], [1.0], [2.0], [3.0]])
        >>> manifold_coverage(torch.tensor([[1.5], [9.0]]), samples).item()
        0.5
    """
    reach = _squared_distances(samples, samples).kthvalue(NEIGHBORS + 1, dim=1).values
    return (_squared_distances(points, samples) <= reach).any(1).double().mean()


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    return (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T


class PrecisionRecall(TwoSets):
    """Precision and recall of generated motions (Kynkäänniemi et al. 2019), in [0, 1].

    `precision` is the fraction of generated motions in the manifold of the real motions. `recall`
    is the fraction of real motions in the manifold of the generated motions; see
    `manifold_coverage`. Higher is better. Distances between neighbors shrink as the number of
    samples grows, so both sets are truncated to the size of the smaller set, in the order of the
    keys. The authors' code truncates the sets in the order of the files.

    `update` takes `generated` (B, E) with `keys` (B,), and `real` (R, E) with `real_keys` (R,).

    Example:
        >>> metric, real, keys = PrecisionRecall(), torch.randn(8, 2), torch.arange(8)
        >>> metric.update(generated=real, keys=keys, real=real, real_keys=keys)
        >>> metric.compute()
        {'precision': 1.0, 'recall': 1.0}
    """

    higher_is_better = True
    summary = None
    names = ("precision", "recall")

    def value(self, generated: Tensor, real: Tensor) -> dict[str, float | None]:
        """Computes `precision` and `recall` from two sets of features, (N, E) and (M, E).

        Raises `UserError` if a set has fewer than four motions.
        """
        size = min(len(generated), len(real))
        self.need(size, NEIGHBORS + 1, "motions in the smaller set")
        generated, real = generated[:size], real[:size]
        precision, recall = manifold_coverage(generated, real), manifold_coverage(real, generated)
        return {"precision": precision.item(), "recall": recall.item()}
