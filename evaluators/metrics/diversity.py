# pyright: standard
"""Diversity and multimodality: how much generated motions differ from one another."""

import numpy as np
import torch
from torch import Tensor

from evaluators.metrics.samples import Rows, SampleMetric


def pair_distance(a: Tensor, b: Tensor) -> float:
    """Returns the mean Euclidean distance between features a (..., E) and b (..., E)."""
    return torch.linalg.vector_norm(a - b, dim=-1).mean().item()


def distances(a: Tensor, b: Tensor) -> Tensor:
    """Returns the Euclidean distances (N, M) between features a (N, E) and b (M, E).

    Each distance is computed from the difference of the features, not from a matrix product.
    """
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def _random_pairs(count: int, pairs: int, replace: bool, seed: int) -> tuple[Tensor, Tensor]:
    """Draws random pairs from `count` motions. Returns the indices of both sides, each (pairs,).

    Each side is drawn with or without replacement.
    """
    draw = np.random.default_rng(seed).choice
    return torch.from_numpy(draw(count, pairs, replace)), torch.from_numpy(
        draw(count, pairs, replace)
    )


class Diversity(SampleMetric):
    """Diversity: mean distance between random pairs of motions (Guo et al. 2020; MDM, eq. 6).

    The best value is the diversity of real motions. Published values for text-to-motion are
    computed from 300 pairs, drawn as two sets without replacement. Published values for
    action-to-motion and unconstrained synthesis are computed from 200 pairs, drawn with
    replacement. In both cases, a motion may be paired with itself. `update` takes `generated`
    (B, E) and `keys` (B,).

    Args:
        pairs: number of pairs.
        replace: whether to draw both sides of the pairs with replacement.
        seed: seed of the draws.

    Example:
        >>> metric = Diversity(pairs=2, replace=False)
        >>> metric.update(generated=torch.ones(4, 2), keys=torch.arange(4))
        >>> metric.compute()  # all motions are the same
        0.0
    """

    higher_is_better = None
    states = ("generated",)

    def __init__(self, pairs: int, replace: bool, seed: int = 0):
        super().__init__()
        self.pairs, self.replace, self.seed = pairs, replace, seed

    def value(self, features: Tensor) -> float:
        """Computes diversity from features (N, E).

        Raises `UserError` if there are too few motions for the pairs.
        """
        self.need(
            len(features), 2 if self.replace else self.pairs, f"motions for {self.pairs} pairs"
        )
        first, second = _random_pairs(len(features), self.pairs, self.replace, self.seed)
        return pair_distance(features[first], features[second])

    def weighted(self, rows: Rows, weights: np.ndarray) -> dict[str, np.ndarray]:
        """Computes the mean distance over all possible pairs."""
        features = rows["generated"]
        times = weights[:, : len(features)]
        between = distances(features, features).numpy()
        return {"": ((times @ between) * times).sum(1) / times.sum(1) ** 2}


class TextMultimodality(SampleMetric):
    """Multimodality as in Guo et al. 2022: mean distance between random pairs of motions for each text.

    Sources: MDM, B.2; MFM, eq. 12. By default, 10 pairs are drawn from 30 motions for each text. As
    in the authors' code, two sets of 10 motions are drawn without replacement, with the same
    indices for all texts. A motion that is in both sets may be paired with itself. Published values
    are for 100 texts, although the code of MDM and MFM uses whole batches, that is, 128 texts.
    `update` takes `generated` (B, E), `groups` (B,) and `keys` (B,).

    Args:
        samples: number of motions per text.
        pairs: number of pairs per text, at most `samples`.
        seed: seed of the draws.

    Example:
        >>> metric = TextMultimodality(samples=2, pairs=2)
        >>> groups = torch.tensor([0, 0, 1, 1])
        >>> metric.update(generated=torch.ones(4, 2), groups=groups, keys=torch.arange(4))
        >>> metric.compute()  # all motions are the same
        0.0
    """

    higher_is_better = None
    states = ("generated", "groups")

    def __init__(self, samples: int = 30, pairs: int = 10, seed: int = 0):
        super().__init__()
        self.samples, self.pairs, self.seed = samples, pairs, seed

    def value(self, features: Tensor, groups: Tensor) -> float:
        """Computes multimodality from features (N, E).

        `groups` (N,) contains the keys of the texts. Raises `UserError` unless each text has
        `samples` motions.
        """
        features = features[self.by_group(groups, self.samples)]
        first, second = _random_pairs(self.samples, self.pairs, False, self.seed)
        return pair_distance(features[:, first], features[:, second])


class PairedMultimodality(SampleMetric):
    """Multimodality as in FLAME (eq. 19): two sets of `samples` motions per text, compared one by one.

    FLAME's authors published no code for this metric. According to FLAME's Table 3, there are 10
    motions per text, but eq. 19 uses two sets of 10. `update` takes `generated` (B, E), `groups`
    (B,) and `keys` (B,).

    Args:
        samples: number of motions per text in each of the two sets.

    Example:
        >>> metric = PairedMultimodality(samples=1)
        >>> generated, groups = torch.tensor([[0.0], [3.0]]), torch.tensor([0, 0])
        >>> metric.update(generated=generated, groups=groups, keys=torch.arange(2))
        >>> metric.compute()
        3.0
    """

    higher_is_better = None
    states = ("generated", "groups")

    def __init__(self, samples: int = 10):
        super().__init__()
        self.samples = samples

    def value(self, features: Tensor, groups: Tensor) -> float:
        """Computes multimodality from features (N, E).

        `groups` (N,) contains the keys of the texts. Raises `UserError` unless each text has 2 *
        `samples` motions.
        """
        first, second = features[self.by_group(groups, 2 * self.samples)].chunk(2, dim=1)
        return pair_distance(first, second)


class ActionMultimodality(SampleMetric):
    """Multimodality as in Guo et al. 2020 (MDM, eq. 7): mean distance between 20 random pairs per class.

    As in the authors' code, a motion may be drawn repeatedly and be paired with itself. The authors
    divide the sum by the total number of classes. This implementation divides it by the number of
    classes with motions. `update` takes `generated` (B, E), `labels` (B,) and `keys` (B,).

    Args:
        pairs: number of pairs per class.
        seed: seed of the draws.

    Example:
        >>> metric = ActionMultimodality(pairs=2)
        >>> labels = torch.tensor([0, 0, 1, 1])
        >>> metric.update(generated=torch.ones(4, 2), labels=labels, keys=torch.arange(4))
        >>> metric.compute()  # all motions are the same
        0.0
    """

    higher_is_better = None
    states = ("generated", "labels")

    def __init__(self, pairs: int = 20, seed: int = 0):
        super().__init__()
        self.pairs, self.seed = pairs, seed

    def value(self, features: Tensor, labels: Tensor) -> float:
        """Computes multimodality from features (N, E) and labels (N,).

        Raises `UserError` if a class has only one motion.
        """
        generator = np.random.default_rng(self.seed)
        pairs = []
        for label in labels.unique():
            members = (labels == label).nonzero()[:, 0]
            self.need(len(members), 2, f"motions of class {int(label)}")
            drawn = generator.integers(len(members), size=(2, self.pairs))
            pairs.append(members[torch.from_numpy(drawn).to(members.device)])
        first, second = torch.cat(pairs, 1)
        return pair_distance(features[first], features[second])


class JointVariance(SampleMetric):
    """Variance of joint positions across the motions for the same text, in square meters.

    For each text, the variance is computed over `samples` motions of equal length, with n - 1 in
    the denominator. It is summed over x, y and z, and averaged over joints, frames and texts. The
    value is not comparable with FLAME's numbers: Table 3 averages "the variance of joints for the
    10 generated motions", but eq. 18 defines a variance over the frames of one motion, and no code
    was published.

    Args:
        samples: number of motions per text.

    Example:
        >>> metric, joints = JointVariance(samples=2), torch.zeros(2, 5, 22, 3)
        >>> joints[1, ..., 0] = 2  # the second motion is 2 m beside the first
        >>> mask = torch.ones(2, 5, dtype=torch.bool)
        >>> metric.update(joints, mask, groups=torch.tensor([0, 0]), keys=torch.arange(2))
        >>> metric.compute()
        2.0
    """

    higher_is_better = None
    unit = "m^2"
    states = ("groups",)
    motions: list[Tensor]

    def __init__(self, samples: int = 10):
        super().__init__()
        self.samples = samples
        self.add_state("motions", [], dist_reduce_fx="cat")

    def update(self, joints: Tensor, mask: Tensor, groups: Tensor, keys: Tensor) -> None:
        """Adds B motions.

        Args:
            joints: (B, F, J, 3) positions in meters.
            mask: (B, F) bool, True for real frames.
            groups: (B,) int64, keys of the texts.
            keys: (B,) int64, unique keys of the motions.

        Raises:
            UserError: If a real frame contains NaN or infinity.
        """
        self.motions += self.real_frames(joints, mask)
        super().update(keys=keys, groups=groups)

    def value(self, groups: Tensor) -> float:
        """Returns the variance.

        Raises `UserError` unless each text has `samples` motions of the same length.
        """
        order, values = self.order("keys"), []
        for members in self.by_group(groups, self.samples):
            motions = [self.motions[index].double() for index in order[members].tolist()]
            lengths = {len(motion) for motion in motions}
            if len(lengths) > 1:
                raise self.error(
                    f"motions for one text have {sorted(lengths)} frames. Generate them with the same length"
                )
            values.append(torch.stack(motions).var(0).sum(-1).mean())
        return torch.stack(values).mean().item()
