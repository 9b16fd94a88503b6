# pyright: standard
"""Alignment of generated motions with their texts: R-precision, distances and MID."""

import numpy as np
import torch
import torch.nn.functional as F
from scipy.stats import hypergeom
from torch import Tensor

from evaluators.metrics.diversity import distances
from evaluators.metrics.samples import Rows, SampleMetric
from flame_mdm.errors import UserError

# Values of k for R-precision
TOP = (1, 2, 3)


def equally_weighted(values: Tensor) -> Tensor:
    """Stacks values (N,) and weights of 1 as two columns (N, 2)."""
    return torch.stack([values, torch.ones(len(values), dtype=values.dtype)], 1)


def retrieval_ranks(queries: Tensor, candidates: Tensor, pools: Tensor, correct: Tensor) -> Tensor:
    """Returns the rank (N,) of each query's correct candidate; 0 = first.

    The rank is the number of candidates that are closer than the correct candidate, or equally
    close but earlier in the pool. `pools` (N, P) contains, for each query (N, E), the indices of
    its candidates among the rows of `candidates` (M, E). `correct` (N,) is the position of the
    correct candidate in each pool.
    """
    pools, correct = pools.to(queries.device), correct.to(queries.device)
    ranks = []
    for query, pool, right in zip(
        queries.split(16), pools.split(16), correct.split(16), strict=True
    ):
        distance = torch.linalg.vector_norm(query[:, None] - candidates[pool], dim=-1)
        at = distance.gather(1, right[:, None])
        earlier = torch.arange(pool.shape[1], device=pool.device) < right[:, None]
        ranks.append(((distance < at) | ((distance == at) & earlier)).sum(1))
    return torch.cat(ranks)


class RPrecision(SampleMetric):
    """Base class for R-precision.

    R-precision is the fraction of queries whose correct candidate is among the k nearest candidates
    of a pool. `update` takes `generated` (B, E), `text` (B, E), `text_keys` (B,) and `keys` (B,).
    The values `top1`, `top2` and `top3` are in [0, 1]; higher is better.

    Args:
        pool: number of candidates per query, including the correct candidate.
        seed: seed of the random draws.
    """

    higher_is_better = True
    summary = "top3"
    audited = ("top1", "top3")
    states = ("generated", "text", "text_keys")
    names = tuple(f"top{k}" for k in TOP)

    def __init__(self, pool: int = 32, seed: int = 0):
        super().__init__()
        self.pool, self.seed = pool, seed

    def value(self, generated: Tensor, text: Tensor, text_keys: Tensor) -> dict[str, float | None]:
        """Computes `top1`, `top2` and `top3` from features (N, E) and caption keys (N,)."""
        ranks = self.ranks(generated, text, text_keys)
        return {f"top{k}": int((ranks < k).sum()) / len(ranks) for k in TOP}

    def ranks(self, generated: Tensor, text: Tensor, text_keys: Tensor) -> Tensor:
        """Returns the rank (N,) of each query's correct candidate; 0 = first."""
        raise NotImplementedError

    def in_random_pools(self, distance: Tensor, correct: Tensor) -> dict[str, Tensor]:
        """Returns each query's probability of a hit in a random pool, keyed by the rank k.

        A hit means that the correct candidate of the query is among the k nearest candidates.

        Args:
            distance: (N, M) distances from queries to candidates.
            correct: (N,) index of the correct candidate of each query.
        """
        # A random pool contains pool - 1 of the other candidates. The number of closer candidates
        # in a pool has a hypergeometric distribution, so the exact probability is known without
        # drawing pools. Half of the candidates at an equal distance count as closer.
        others = distance.shape[1] - 1
        if others + 1 < self.pool:
            raise UserError(f"a pool needs {self.pool} candidates, but there are only {others + 1}")
        at = distance.gather(1, correct[:, None])
        closer = (distance < at).sum(1) + ((distance == at).sum(1) - 1) // 2
        probable = {
            f"top{k}": hypergeom.cdf(k - 1, others, closer.numpy(), self.pool - 1) for k in TOP
        }
        return {
            name: equally_weighted(torch.from_numpy(values)) for name, values in probable.items()
        }


class TextsForMotion(RPrecision):
    """R-precision, texts for a motion: is the motion's text among the k nearest of 32 texts?

    This is the definition in the papers (FLAME, "Evaluation Metrics"; MDM, B.2; MFM, 9.1) and in
    FLAME's code. For each motion, 32 texts are ranked by Euclidean distance: its own text, and 31
    texts drawn without replacement from other captions. In FLAME's code, a pool is a batch, so the
    last pool may be smaller. The motion's own text is at a random position, so that an extractor
    that cannot tell texts apart scores k / 32.

    Args:
        pool: number of texts in a pool, including the motion's own text.
        seed: seed of the pools.

    Example:
        >>> metric, features, keys = TextsForMotion(pool=3), torch.eye(3), torch.arange(3)
        >>> metric.update(generated=features, text=features, text_keys=keys, keys=keys)
        >>> metric.compute()
        {'top1': 1.0, 'top2': 1.0, 'top3': 1.0}
    """

    def ranks(self, generated: Tensor, text: Tensor, text_keys: Tensor) -> Tensor:
        """Ranks each motion's own text in its pool and returns the ranks (N,), 0 = first."""
        # The other texts of a motion are drawn from all captions except its own: drawn indices at
        # or above its own caption are increased by one. Then its own caption, which is last, is
        # swapped with a random text.
        generator = np.random.default_rng(self.seed)
        _, first, correct = np.unique(
            text_keys.cpu().numpy(), return_index=True, return_inverse=True
        )
        self.need(len(first), self.pool, "different captions")
        others = self.pool - 1
        drawn = np.stack([generator.choice(len(first) - 1, others, replace=False) for _ in correct])
        pools = np.concatenate([drawn + (drawn >= correct[:, None]), correct[:, None]], 1)
        position = generator.integers(self.pool, size=len(correct))
        rows = np.arange(len(correct))
        pools[rows, others], pools[rows, position] = pools[rows, position], correct
        return retrieval_ranks(
            generated, text[first], torch.from_numpy(pools), torch.from_numpy(position)
        )

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns, for each k, the probability that a motion's text is among the k nearest in a random pool."""
        keys = rows["text_keys"].numpy()
        _, first, correct = np.unique(keys, return_index=True, return_inverse=True)
        return self.in_random_pools(
            distances(rows["generated"], rows["text"][first]), torch.from_numpy(correct)
        )


class MotionsForText(RPrecision):
    """R-precision, motions for a text: is the text's motion among the k nearest of 32 motions?

    This is the definition in the code of Guo et al. 2022, which was used for the tables of MDM and
    MFM. Test pairs are shuffled and split into pools of 32, which may contain equal captions. In
    each pool, the motions are ranked by their Euclidean distance from each text.

    The authors' code drops an incomplete last pool. In this implementation, the last 32 motions are
    ranked for the texts of an incomplete last pool, so that every text counts once. The authors'
    code also computes distances in float32, where rounding may lead to the square root of a
    negative number. Therefore, a motion with the same features as its text may rank last.

    Args:
        pool: number of motions in a pool, including the text's own motion.
        seed: seed of the pools.
        normalize: whether to first scale features to norm 1, so that motions are ranked by cosine.
            An extractor that was trained with cosines, such as motion-CLIP, does not constrain the
            norms of features. Without normalization, the motions whose features have the smallest
            norms would therefore be nearest to every text.

    Example:
        >>> metric, features, keys = MotionsForText(pool=3), torch.eye(3), torch.arange(3)
        >>> metric.update(generated=features, text=features, text_keys=keys, keys=keys)
        >>> metric.compute()
        {'top1': 1.0, 'top2': 1.0, 'top3': 1.0}
    """

    def __init__(self, pool: int = 32, seed: int = 0, normalize: bool = False):
        super().__init__(pool, seed)
        self.normalize = normalize

    def ranks(self, generated: Tensor, text: Tensor, text_keys: Tensor) -> Tensor:
        """Ranks each text's own motion in its pool and returns the ranks (N,), 0 = first.

        The texts are in random order.
        """
        self.need(len(generated), self.pool, "motions")
        if self.normalize:
            generated, text = F.normalize(generated, dim=-1), F.normalize(text, dim=-1)
        order, pools, position = own_pools(len(generated), self.pool, self.seed)
        return retrieval_ranks(text[order], generated, pools, position)

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns, for each k, the probability that a text's motion is among the k nearest in a random pool."""
        generated, text = rows["generated"], rows["text"]
        if self.normalize:
            generated, text = F.normalize(generated, dim=-1), F.normalize(text, dim=-1)
        return self.in_random_pools(distances(text, generated), torch.arange(len(generated)))


def own_pools(count: int, pool: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Returns the pools of `MotionsForText`.

    The three tensors are the samples (N,) in random order, the pools (N, P), and the position
    (N,) of each sample in its pool.
    """
    order = torch.from_numpy(np.random.default_rng(seed).permutation(count))
    start = (torch.arange(count) // pool * pool).clamp(max=count - pool)
    return order, order[start[:, None] + torch.arange(pool)], torch.arange(count) - start


class MultimodalDistance(SampleMetric):
    """MM-Dist (MFM, eq. 10), the mean Euclidean distance between motions and their texts.

    Guo et al. 2022 call it "matching score". Their code computes in float32 and drops an incomplete
    last batch. In this implementation, every motion counts. Lower is better. `update` takes
    `generated` (B, E), `text` (B, E) and `keys` (B,).

    Args:
        normalize: whether to first scale features to norm 1, for extractors that were trained with
            cosines. The value is then in [0, 2].

    Example:
        >>> metric = MultimodalDistance()
        >>> metric.update(generated=torch.zeros(2, 4), text=torch.ones(2, 4), keys=torch.arange(2))
        >>> metric.compute()
        2.0
    """

    higher_is_better = False
    states = ("generated", "text")

    def __init__(self, normalize: bool = False):
        super().__init__()
        self.normalize = normalize

    def value(self, generated: Tensor, text: Tensor) -> float:
        """Returns the mean distance between motion features (N, E) and text features (N, E)."""
        return self._distances(generated, text).mean().item()

    def _distances(self, generated: Tensor, text: Tensor) -> Tensor:
        if self.normalize:
            generated, text = F.normalize(generated, dim=-1), F.normalize(text, dim=-1)
        return torch.linalg.vector_norm(generated - text, dim=-1)

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns the distance between each motion and its text."""
        return {"": equally_weighted(self._distances(rows["generated"], rows["text"]))}


class MotionCLIPScore(SampleMetric):
    """mCLIP score of FLAME ("Evaluation Metrics"): mean cosine between motion features and text features.

    The value is in [-1, 1]; higher is better. `update` takes `generated` (B, E), `text` (B, E)
    and `keys` (B,).

    Example:
        >>> metric = MotionCLIPScore()
        >>> metric.update(generated=torch.eye(2), text=torch.eye(2), keys=torch.arange(2))
        >>> metric.compute()
        1.0
    """

    higher_is_better = True
    states = ("generated", "text")

    def value(self, generated: Tensor, text: Tensor) -> float:
        """Returns the mean cosine between motion features (N, E) and text features (N, E)."""
        return F.cosine_similarity(generated, text).mean().item()

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns the cosine between each motion and its text."""
        cosines = F.normalize(rows["generated"], dim=-1) * F.normalize(rows["text"], dim=-1)
        return {"": equally_weighted(cosines.sum(1))}


def pointwise_mutual_information(
    real: Tensor, text: Tensor, generated: Tensor, requested: Tensor, eps: float
) -> Tensor:
    """Computes the terms (M,) whose mean is MID, for motions (M, E) generated for texts (M, T).

    Source: Kim et al. 2022, "Mutual Information Divergence". MID is the mean pointwise mutual
    information of generated motions and their texts, under a normal distribution fitted to real
    motions (N, E) and their texts (N, T). It is computed in float64:

        (log det S_x + log det S_y - log det S_z) / 2 + (tr S_x^-1 S_x' + tr S_y^-1 S_y - tr
        S_z^-1 S_z') / 2

    where x is the motion, y is the text, and z is both. The covariances of generated motions
    (marked by ') are computed around the means of the real motions. S + eps I is inverted instead
    of S. The denominators are N - 1 and M - 1.
    """
    both, fake = torch.cat([real, text], 1), torch.cat([generated, requested], 1)
    value = real.new_zeros(len(generated))
    for sign, true, seen in ((1, real, generated), (1, text, text), (-1, both, fake)):
        a, b = true - true.mean(0), seen - true.mean(0)
        covariance = a.T @ a / (len(a) - 1)
        inverse = torch.linalg.inv(covariance + eps * torch.eye(len(covariance)).to(covariance))
        value += sign / 2 * torch.linalg.svdvals(covariance).log().sum()
        distance = (b @ inverse * b).sum(1) * len(b) / (len(b) - 1)
        value += sign / 2 * (distance.mean() if seen is text else distance)
    return value


class MutualInformationDivergence(SampleMetric):
    """MID in nats: the mean of `pointwise_mutual_information` over generated motions.

    Source: Kim et al. 2022. Higher is better. The number of samples must exceed the total number of
    motion and text features, because otherwise the joint covariance is singular. The authors' code
    requires only half as many samples. `update` takes `generated` (B, E), `text` (B, E),
    `real` (B, E) and `keys` (B,), where row i of `real` is the real motion for text i.

    Args:
        eps: value added to the diagonals of the covariance matrices before inversion: 5e-4 in FLAME
            and 0 in the authors' release.

    Example:
        >>> metric, text = MutualInformationDivergence(), torch.randn(64, 2)
        >>> generated, real = text + 0.1 * torch.randn(64, 2), text + 0.1 * torch.randn(64, 2)
        >>> metric.update(generated=generated, text=text, real=real, keys=torch.arange(64))
        >>> metric.compute() > 2  # a motion says a lot about its text
        True
    """

    higher_is_better = True
    unit = "nats"
    states = ("generated", "text", "real")

    def __init__(self, eps: float = 5e-4):
        super().__init__()
        self.eps = eps

    def value(self, generated: Tensor, text: Tensor, real: Tensor) -> float:
        """Computes MID from features (N, E). Raises `UserError` if there are too few samples."""
        self.need(
            len(text),
            real.shape[1] + text.shape[1] + 1,
            "samples for the features of motion and text",
        )
        return pointwise_mutual_information(real, text, generated, text, self.eps).mean().item()

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns the pointwise mutual information of each motion.

        Raises `UserError` if there are too few motions.
        """
        real, real_text = rows["paired"], rows["paired_text"]
        if len(real) <= real.shape[1] + real_text.shape[1]:
            raise UserError(f"{len(real)} motions are too few to estimate the covariances")
        terms = pointwise_mutual_information(
            real, real_text, rows["generated"], rows["text"], self.eps
        )
        return {"": equally_weighted(terms)}
