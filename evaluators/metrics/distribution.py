# pyright: standard
"""Distances between the feature distributions of generated and real motions: FID, KID, precision and recall."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from evaluators.metrics.samples import Rows, TwoSets

NEIGHBORS = 3  # of a sample of `PrecisionRecall`, as in MoDi and MDM


def frechet_distance(a: Tensor, b: Tensor) -> Tensor:
    """Computes the Fréchet distance of normal distributions fitted to the rows of a (N, E) and b (M, E), float64.

    |m_a - m_b|^2 + tr S_a + tr S_b - 2 tr (S_a S_b)^(1/2) (Dowson and Landau 1982). With centered rows A / sqrt(N - 1)
    = Q_a R_a, and likewise for b, the last trace is the sum of the singular values of R_a R_b^T, also if covariances
    are rank-deficient.
    """
    r_a, r_b = (torch.linalg.qr((x - x.mean(0)) / (len(x) - 1) ** 0.5, mode="r").R for x in (a, b))
    shared = torch.linalg.svdvals(r_a @ r_b.T).sum()
    return ((a.mean(0) - b.mean(0)) ** 2).sum() + (r_a**2).sum() + (r_b**2).sum() - 2 * shared


class FrechetMotionDistance(TwoSets):
    """Fréchet distance of motion features, "FID" (Heusel et al. 2017) or "FD" (FLAME): `frechet_distance`.

    Covariances have N - 1 in the denominator, as in the authors' code. That code computes means in float32 and scipy's
    `sqrtm` of the product, and adds 1e-6 to the diagonals if that fails; the relative difference is 1e-8. The value is
    biased upwards, and more so with fewer samples: compare only values for equal N.
    """

    higher_is_better = False

    def value(self, generated: Tensor, real: Tensor) -> float:
        self.need(len(generated), 2, "generated motions")
        self.need(len(real), 2, "real motions")
        # Rounding may give a value slightly below 0
        return max(frechet_distance(generated, real).item(), 0.0)

    def weighted(self, rows: Rows, weights: np.ndarray) -> dict[str, np.ndarray]:
        """Computes the distance of sets in which each motion is repeated as often as it was drawn."""
        generated, real = rows["generated"], rows["real"]
        values = []
        for times in map(torch.from_numpy, weights):
            drawn = generated.repeat_interleave(times[: len(generated)], 0)
            values.append(frechet_distance(drawn, real.repeat_interleave(times, 0)).item())
        return {"": np.array(values)}


def polynomial_mmd2(a: Tensor, b: Tensor) -> Tensor:
    """Computes the unbiased squared MMD of a (n, E) and b (n, E) with the kernel (x . y / E + 1)^3.

    Bińkowski et al. 2018, eq. 4, including the pairs (i, i) across the sets, as in the authors' code.
    """
    n, width = a.shape
    inner_a, inner_b, cross = ((x @ y.T / width + 1) ** 3 for x, y in ((a, a), (b, b), (a, b)))
    within = inner_a.sum() - inner_a.trace() + inner_b.sum() - inner_b.trace()
    return within / (n * (n - 1)) - 2 * cross.mean()


class KernelMotionDistance(TwoSets):
    """Kernel distance of motion features, "KID" (Bińkowski et al. 2018): mean `polynomial_mmd2` of random subsets.

    Each of the `subsets` has `subset_size` samples of either set. `replace` draws them with replacement, as the code of
    MoDi and MDM does if there are more real motions than that; samples that are drawn twice increase the value.
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
    """Returns the fraction of points (M, E) that are no farther from a sample (N, E) than its third-nearest neighbor.

    Kynkäänniemi et al. 2019, eq. 1 and 2. A sample is not a neighbor of itself.
    """
    reach = _squared_distances(samples, samples).kthvalue(NEIGHBORS + 1, dim=1).values
    return (_squared_distances(points, samples) <= reach).any(1).double().mean()


def _squared_distances(a: Tensor, b: Tensor) -> Tensor:
    return (a**2).sum(1)[:, None] + (b**2).sum(1) - 2 * a @ b.T


class PrecisionRecall(TwoSets):
    """Precision and recall of generated motions (Kynkäänniemi et al. 2019), in [0, 1].

    Precision is the `manifold_coverage` of generated motions by the real ones, recall that of the real motions by the
    generated ones. Since neighbor distances shrink with the number of samples, both sets are cut to the size of the
    smaller one, in the order of the keys; the authors' code cuts in the order of the files.
    """

    higher_is_better = True
    summary = None
    names = ("precision", "recall")

    def value(self, generated: Tensor, real: Tensor) -> dict[str, float | None]:
        size = min(len(generated), len(real))
        self.need(size, NEIGHBORS + 1, "motions in the smaller set")
        generated, real = generated[:size], real[:size]
        precision, recall = manifold_coverage(generated, real), manifold_coverage(real, generated)
        return {"precision": precision.item(), "recall": recall.item()}
