# pyright: standard
"""Retrieval metrics that account for equal and similar captions, and the protocols of TMR."""

import functools
import json
import re
from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from evaluators.metrics.alignment import TOP, own_pools
from evaluators.metrics.samples import SampleMetric
from flame_mdm.batch import MotionBatch
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import Config, instantiate
from flame_mdm.errors import UserError
from flame_mdm.safe_io import MEBIBYTE, read_text
from flame_mdm.seeds import key

# Captions whose cosine is larger count as the same. TMR's threshold of 0.95 applies to
# (cosine + 1) / 2.
SAME = 0.9
# Values of k for recall
TMR_TOP = (1, 2, 3, 5, 10)
# TMR's batch size, and the maximum number of dissimilar motions
BATCH, DISSIMILAR = 32, 100


@functools.cache
def _encoder(config: str) -> ConditionEncoder:
    return instantiate(json.loads(config)).eval()


@functools.cache
def embedding(config: str, caption: str) -> Tensor:
    """Encodes a caption as a vector (C,) of norm 1.

    `config` is the encoder's configuration in JSON. The caption is encoded alone, not in a batch.
    """
    empty = torch.zeros(1, 1, 1)
    with torch.no_grad():
        vector = _encoder(config)(
            MotionBatch(empty, empty[..., 0].bool(), [""], text=[caption])
        ).pooled[0]
    return F.normalize(vector, dim=0)


def plain_caption(caption: str) -> str:
    """Returns a caption in lower case, without punctuation or extra spaces."""
    return " ".join(re.sub(r"[^\w\s]", "", caption.lower()).split())


def whole_set_retrieval(similarity: Tensor, correct: Tensor | None = None) -> dict[str, float]:
    """Computes TMR's recall and median rank from the similarities between texts and motions.

    Args:
        similarity: (N, N) similarities between texts (rows) and motions (columns).
        correct: (N, N) bool, symmetric, True for correct pairs. If there are several correct
            candidates, the best one counts. If None, only the diagonal is correct.

    Returns:
        For retrieval of motions by text: the recall at several ranks (`t2m_top1` etc., in [0, 1])
        and the median rank (`t2m_median`, 1 = best). For the reverse direction, the names begin
        with `m2t_`.

    Example:
        >>> values = whole_set_retrieval(torch.eye(4))
        >>> values["t2m_top1"], values["m2t_median"]
        (1.0, 1.0)
    """
    values: dict[str, float] = {}
    for direction, table in (("t2m", similarity), ("m2t", similarity.T)):
        rank = best_ranks(
            table, torch.eye(len(table), dtype=torch.bool) if correct is None else correct
        )
        values |= {f"{direction}_top{k}": (rank < k).double().mean().item() for k in TMR_TOP}
        values[f"{direction}_median"] = rank.double().quantile(0.5).item() + 1
    return values


def best_ranks(similarity: Tensor, correct: Tensor) -> Tensor:
    """Returns the rank (N,) of each query's best correct candidate; 0 = first.

    Candidates with the same value in `similarity` (N, M) share their mean rank.
    """
    best = similarity.where(correct, -torch.inf).amax(1, keepdim=True)
    return (similarity > best).sum(1) + ((similarity == best).sum(1) - 1) / 2


class CaptionMetric(SampleMetric):
    """Base class for metrics that allow several motions with the same caption.

    Captions count as the same if they differ only in case, punctuation and spaces or, with an
    `encoder`, if the cosine of their embeddings exceeds `SAME`.

    Args:
        encoder: mapping with the `_target_` of a text encoder. If None, captions are compared as
            text.
        seed: seed of the random draws.
    """

    higher_is_better = True
    states = ("generated", "text", "caption_keys", "meaning")

    def __init__(self, encoder: Config | None = None, seed: int = 0):
        super().__init__()
        self.encoder, self.seed = (
            None if encoder is None else json.dumps(encoder, sort_keys=True),
            seed,
        )

    def update(
        self, generated: Tensor, text: Tensor, captions: Sequence[str], keys: Tensor
    ) -> None:
        """Stores B motions.

        Args:
            generated: (B, E) features of the motions.
            text: (B, E) features of the captions.
            captions: B captions.
            keys: (B,) int64, unique keys of the motions.

        Raises:
            ValueError: If the arguments have different numbers of rows.
        """
        if not len(captions):
            return
        caption_keys = torch.tensor([key(plain_caption(caption)) for caption in captions])
        meaning = torch.zeros(len(captions), 0)
        if self.encoder is not None:
            meaning = torch.stack([embedding(self.encoder, caption) for caption in captions])
        super().update(
            keys=keys, generated=generated, text=text, caption_keys=caption_keys, meaning=meaning
        )


class MultiPositiveRPrecision(CaptionMetric):
    """R-precision, motions for a text, in which all motions with the text's caption count as correct.

    This metric was introduced in this project.

    - `topK`: the fraction of texts with a correct motion among the K nearest motions. Tied motions
      share their mean rank.
    - `proper`: R-precision as in information retrieval. A text with R correct motions contributes
      the fraction of them that are among its R nearest motions.
    - `single_topK`: like `topK`, but only the text's own motion counts as correct. Except for ties,
      the values equal the values of `MotionsForText`.
    - `chance_topK`: the expected values for a random order. They show how much all values rise
      because of similar captions.
    - `positives`: the mean number R of correct motions.

    Args:
        encoder: mapping with the `_target_` of a text encoder. If None, captions are compared as
            text.
        pool: number of motions in a pool, as in `MotionsForText`.
        seed: seed of the pools.
        normalize: whether to first scale features to norm 1, so that motions are ranked by cosine.

    Example:
        >>> metric, features = MultiPositiveRPrecision(pool=3), torch.eye(3)
        >>> captions = ["a person walks", "A person walks.", "a person waves"]
        >>> metric.update(features, features, captions, keys=torch.arange(3))
        >>> values = metric.compute()
        >>> values["top1"], values["proper"] < 1, round(values["positives"], 2)
        (1.0, True, 1.67)
    """

    names = (
        *(f"{kind}top{k}" for kind in ("", "single_", "chance_") for k in TOP),
        "proper",
        "positives",
    )
    summary = "top3"
    directions: Mapping[str, bool | None] = {"positives": None} | {
        f"chance_top{k}": None for k in TOP
    }

    def __init__(
        self, encoder: Config | None = None, pool: int = 32, seed: int = 0, normalize: bool = False
    ):
        super().__init__(encoder, seed)
        self.pool, self.normalize = pool, normalize

    def value(
        self, motion: Tensor, text: Tensor, caption_keys: Tensor, meaning: Tensor
    ) -> dict[str, float | None]:
        """Returns the values, keyed by name.

        Args:
            motion: (N, E) features of the motions.
            text: (N, E) features of the captions.
            caption_keys: (N,) int64, keys of the plain captions.
            meaning: (N, C) embeddings of the captions.
        """
        self.need(len(motion), self.pool, "motions")
        if self.normalize:
            motion, text = F.normalize(motion, dim=-1), F.normalize(text, dim=-1)
        order, pools, position = own_pools(len(motion), self.pool, self.seed)
        similarity, correct = [], []
        for query, pool in zip(order.split(16), pools.split(16), strict=True):
            similarity.append(-torch.linalg.vector_norm(text[query, None] - motion[pool], dim=-1))
            similar = (meaning[query, None] * meaning[pool]).sum(-1) > SAME
            correct.append(
                (caption_keys[query, None] == caption_keys[pool])
                | similar
                | (query[:, None] == pool)
            )
        single = best_ranks(torch.cat(similarity), F.one_hot(position, self.pool).bool())
        singles = {f"single_top{k}": (single < k).double().mean().item() for k in TOP}
        return multi_positive(torch.cat(similarity), torch.cat(correct)) | singles


def multi_positive(similarity: Tensor, correct: Tensor) -> dict[str, float | None]:
    """Computes hit rates, R-precision and chance levels.

    `similarity` (N, M) contains similarities, and `correct` (N, M) bool marks the correct pairs.
    """
    rank, count, size = best_ranks(similarity, correct), correct.sum(1), similarity.shape[1]
    values: dict[str, float | None] = {f"top{k}": (rank < k).double().mean().item() for k in TOP}
    # In a random order, the first k candidates are k draws without replacement. The probability
    # that none of them is correct is a product over the draws.
    missed = torch.ones(len(count), dtype=torch.float64)
    for k in TOP:
        missed = missed * ((size - count - k + 1).clamp(min=0) / (size - k + 1))
        values[f"chance_top{k}"] = (1 - missed).mean().item()
    last = similarity.sort(1, descending=True).values.gather(1, count[:, None] - 1)
    above, tied = similarity > last, similarity == last
    share = (count - above.sum(1)) / tied.sum(1).double()
    hits = (above & correct).sum(1) + (tied & correct).sum(1) * share
    return values | {
        "proper": (hits / count).mean().item(),
        "positives": count.double().mean().item(),
    }


class TMRRetrieval(CaptionMetric):
    """Retrieval by cosine with the protocols of Petrovich et al. 2023 (TMR, 6d74688), in both directions.

    - `all`: retrieval among all motions, where only the text's own motion counts as correct.
    - `threshold`: retrieval among all motions, where motions with the same caption also count as
      correct.
    - `dissimilar`: retrieval among 100 motions (at most half of all motions) with different
      captions. Without an encoder, these values are not computed.
    - `batches`: retrieval in batches of 32. An incomplete last batch is left out, and the medians
      of the batches are averaged.

    For each protocol, the values of text-to-motion retrieval are the recall (`t2m_top1` etc., in
    [0, 1]) and the median rank (`t2m_median`, 1 = best). For the reverse direction, the names begin
    with `m2t_`.

    TMR's caption encoder is all-mpnet-base-v2. TMR lists its dissimilar motions and batches for
    HumanML3D and KIT. In this implementation, batches are drawn at random. Without `ids`, the
    dissimilar subset starts with the first motion by key. Then, the motion whose caption is least
    similar to the captions chosen so far is added, and this is repeated until the subset is
    complete.

    Args:
        encoder: mapping with the `_target_` of a text encoder. If None, captions are compared as
            text.
        seed: seed of the batches.
        ids: file with the ids of the dissimilar motions, one per line, such as TMR's
            `nsim_test.txt`. Ids that were not evaluated are ignored.

    Raises:
        UserError: If the file of ids is empty.

    Example:
        >>> metric, features = TMRRetrieval(), torch.eye(3)
        >>> captions = ["a person walks", "a person sits", "a person waves"]
        >>> metric.update(features, features, captions, keys=torch.arange(3))
        >>> values = metric.compute()
        >>> values["all_t2m_top1"], values["all_m2t_median"], values["batches_t2m_top1"]
        (1.0, 1.0, None)
    """

    names = tuple(
        f"{protocol}_{direction}_{value}"
        for protocol in ("all", "threshold", "dissimilar", "batches")
        for direction in ("t2m", "m2t")
        for value in (*(f"top{k}" for k in TMR_TOP), "median")
    )
    summary = None
    directions: Mapping[str, bool | None] = {
        name: False for name in names if name.endswith("median")
    }

    def __init__(self, encoder: Config | None = None, seed: int = 0, ids: str | None = None):
        super().__init__(encoder, seed)
        listed = [] if ids is None else read_text(ids, MEBIBYTE).split()
        if ids is not None and not listed:
            raise UserError(f"{ids}: contains no ids. Write one id per line")
        self.ids = torch.tensor([key(name) for name in listed], dtype=torch.long)

    def value(
        self, motion: Tensor, text: Tensor, caption_keys: Tensor, meaning: Tensor
    ) -> dict[str, float | None]:
        """Returns the values, keyed by name.

        Args:
            motion: (N, E) features of the motions.
            text: (N, E) features of the captions.
            caption_keys: (N,) int64, keys of the plain captions.
            meaning: (N, C) embeddings of the captions.
        """
        similarity = F.normalize(text, dim=-1) @ F.normalize(motion, dim=-1).T
        same = (caption_keys[None] == caption_keys[:, None]) | (meaning @ meaning.T > SAME)
        values = {
            "all": whole_set_retrieval(similarity),
            "threshold": whole_set_retrieval(similarity, same),
        }
        if len(self.ids):
            (keys,) = self.rows("keys", "keys")
            chosen = torch.isin(keys, self.ids.to(keys.device)).nonzero()[:, 0].tolist()
        else:
            chosen = dissimilar(meaning) if meaning.shape[1] else []
        if chosen:
            values["dissimilar"] = whole_set_retrieval(similarity[chosen][:, chosen])
        order = np.random.default_rng(self.seed).permutation(len(motion))
        batches = torch.from_numpy(order[: len(order) // BATCH * BATCH]).view(-1, BATCH)
        if len(batches):
            values["batches"] = batched_retrieval(similarity, batches)
        computed = {
            f"{protocol}_{name}": x
            for protocol, result in values.items()
            for name, x in result.items()
        }
        return dict.fromkeys(self.names) | computed


def dissimilar(meaning: Tensor) -> list[int]:
    """Returns the indices of the `dissimilar` motions of `TMRRetrieval`, from caption vectors (N, C)."""
    # Greedy farthest-point selection. `nearest` is the similarity of each caption to its most
    # similar chosen caption.
    chosen = [0]
    nearest = meaning @ meaning[0]
    while len(chosen) < min(DISSIMILAR, len(meaning) // 2):
        chosen.append(int(nearest.argmin()))
        nearest = nearest.maximum(meaning @ meaning[chosen[-1]])
    return chosen


def batched_retrieval(similarity: Tensor, batches: Tensor) -> dict[str, float]:
    """Returns the mean values of `whole_set_retrieval` over batches of indices (N, B)."""
    results = [whole_set_retrieval(similarity[batch][:, batch]) for batch in batches]
    return {name: float(np.mean([result[name] for result in results])) for name in results[0]}
