# pyright: standard
"""Motion-CLIP: a contrastively trained joint embedding of motions and texts.

Source: Kim et al. 2023, "FLAME", table 8.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Self

import torch
import torch.distributed
import torch.nn.functional as F
from torch import Tensor, nn
from torch.distributed.nn.functional import all_gather
from torchmetrics import Metric

from evaluators.collectives import world_size
from evaluators.extractors.training import ExtractorTask
from evaluators.metrics.alignment import MotionsForText, TextsForMotion
from evaluators.metrics.samples import SampleMetric
from flame_mdm.batch import MotionBatch
from flame_mdm.checkpoints.released_weights import (
    ENCODER_LAYER,
    layer_names,
    load_strictly,
    renamed,
    shape_of,
)
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import Config, instantiate
from flame_mdm.denoisers.flame import cosine_first_sinusoid
from flame_mdm.denoisers.layers import Transformer, with_prefix
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation

POOL = 32  # number of pairs in a pool, as in R-precision


class MotionCLIP(nn.Module):
    """A transformer over [CLS, length, frame 1, ...] and a linear layer for the pooled text.

    The features are not scaled to norm 1, because Fréchet distance and MID use unscaled features.
    The temperature is learned, with an initial value of 0.07.

    Args:
        in_features: D, the number of features per frame of the motions.
        text_features: C, the number of features of the pooled condition.
        embedding_dim: E, the number of features in the joint space.
        blind_features: number of features that are set to 0 at the beginning of each frame. FLAME's
            code sets the first 3 features (the translation of the root) to 0, so that scores do not
            depend on position and height.
        roughness: whether the absolute second differences over time are additional inputs, so that
            noise is easier to detect.
    """

    def __init__(
        self,
        in_features: int,
        text_features: int,
        *,
        latent_dim: int,
        ff_size: int,
        num_layers: int,
        num_heads: int,
        dropout: float,
        max_frames: int,
        embedding_dim: int,
        blind_features: int = 0,
        roughness: bool = False,
    ):
        super().__init__()
        self.max_frames, self.blind_features, self.roughness = max_frames, blind_features, roughness
        self.cls = nn.Parameter(torch.randn(latent_dim))
        # Row 0, which the authors' code does not use, embeds the length of the longest motion; see
        # the FLAME denoiser.
        self.length_embedding = nn.Embedding(max_frames, latent_dim)
        self.input = nn.Linear((1 + roughness) * in_features, latent_dim)
        self.transformer = Transformer(latent_dim, ff_size, num_layers, num_heads, dropout, nn.ReLU)
        self.output = nn.Linear(latent_dim, embedding_dim)
        self.text_projection = nn.Linear(text_features, embedding_dim)
        self.logit_scale = nn.Parameter(torch.tensor(math.log(1 / 0.07)))

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, E) from normalized motions (B, F, D) and their mask (B, F).

        F must not exceed `max_frames`.
        """
        lengths = mask.sum(1)
        if x.shape[1] > self.max_frames and lengths.max() > self.max_frames:
            longest = int(lengths.max())
            raise UserError(
                f"a motion has {longest} frames, but this motion-CLIP accepts at most {self.max_frames}"
            )
        x = F.pad(x[..., self.blind_features :], (self.blind_features, 0))
        if self.roughness:
            x = torch.cat([x, F.pad(x.diff(n=2, dim=1).abs(), (0, 0, 2, 0))[:, : x.shape[1]]], -1)
        x = self.input(x)
        length = self.length_embedding(lengths % self.max_frames)
        x = torch.cat([self.cls.expand(len(x), 1, -1), length[:, None], x], 1)
        x = x + cosine_first_sinusoid(torch.arange(x.shape[1], device=x.device), x.shape[-1]).to(
            x.dtype
        )
        return self.output(self.transformer(x, with_prefix(mask, 2))[:, 0])

    def text(self, pooled: Tensor) -> Tensor:
        """Converts the text encoder's pooled outputs (B, C) to features (B, E)."""
        return self.text_projection(pooled)


def info_nce(
    motion: Tensor,
    text: Tensor,
    logit_scale: Tensor,
    meaning: Tensor | None = None,
    wrong_text: Tensor | None = None,
) -> Tensor:
    """Contrastive loss over the pairs of all ranks: the mean cross-entropy in both directions.

    See Oord et al. 2018, eq. 4. The loss is symmetric, as in Radford et al. 2021. Each rank
    compares its own pairs (B, E) with the motions and texts of all ranks, and DDP averages
    gradients over ranks. If all ranks have the same number of pairs, the averaged loss and gradient
    equal the loss and gradient on a single rank with all pairs.

    Args:
        motion: (B, E) features of the motions on this rank.
        text: (B, E) features of their texts.
        logit_scale: scalar tensor, logarithm of the inverse temperature.
        meaning: (B, M) int64. Two pairs with the same value in a column are not negatives of each
            other.
        wrong_text: (B, K, E) features of K wrong texts for each motion. Each of these texts is a
            negative for this one motion only.
    """
    motion, text = F.normalize(motion, dim=-1), F.normalize(text, dim=-1)
    motions, texts = _of_all_processes(motion), _of_all_processes(text)
    matching = torch.arange(len(motion), device=motion.device)
    if len(motions) > len(motion):
        matching = matching + torch.distributed.get_rank() * len(motion)
    scale = logit_scale.exp()
    of_motion, of_text = scale * motion @ texts.T, scale * text @ motions.T
    if meaning is not None:
        same = (meaning[:, None] == _of_all_processes(meaning)).any(-1)
        same[torch.arange(len(matching)), matching] = False
        of_motion, of_text = (
            of_motion.masked_fill(same, -torch.inf),
            of_text.masked_fill(same, -torch.inf),
        )
    if wrong_text is not None:
        of_motion = torch.cat(
            [of_motion, scale * (F.normalize(wrong_text, dim=-1) @ motion[..., None])[..., 0]], 1
        )
    return (F.cross_entropy(of_motion, matching) + F.cross_entropy(of_text, matching)) / 2


def _of_all_processes(x: Tensor) -> Tensor:
    return torch.cat(all_gather(x)) if world_size() > 1 else x


class PooledLoss(SampleMetric):
    """InfoNCE in pools of 32 pairs, after all pairs have been sorted by key.

    If the last pool is incomplete, its pairs are compared with the last 32 pairs.
    """

    higher_is_better = False
    states = ("generated", "text")

    def update(self, generated: Tensor, text: Tensor, keys: Tensor, scale: Tensor) -> None:
        """Adds features of norm 1, and the inverse temperature `scale` as a scalar tensor."""
        super().update(keys=keys, generated=scale * generated, text=text)

    def value(self, motion: Tensor, text: Tensor) -> float:
        """Returns the mean loss over pools of `POOL` motions and texts, given their features (N, E)."""
        losses = []
        for begin in range(0, len(motion), POOL):
            pool = slice(max(0, min(begin, len(motion) - POOL)), begin + POOL)
            logits = motion[pool] @ text[pool].T
            pair = -(logits.log_softmax(0).diagonal() + logits.log_softmax(1).diagonal()) / 2
            losses.append(pair[begin - pool.start :])
        return torch.cat(losses).mean().item()


class MotionCLIPTask(ExtractorTask[MotionCLIP]):
    """Trains a motion-CLIP (`make train EXP=motion_clip/...`). FLAME's text encoder is frozen."""

    noun = "a motion-CLIP"

    @classmethod
    def parts(
        cls, config: Config, representation: Representation, actions: Sequence[str]
    ) -> dict[str, Any]:
        """Returns the text encoder and the network of a recipe."""
        condition: ConditionEncoder = instantiate(config["condition"])
        widths = {"in_features": representation.features, "text_features": condition.features}
        return {"condition": condition, "network": instantiate(config["task"]["network"], **widths)}

    def metrics(self) -> dict[str, Metric]:
        """Returns the validation metrics: loss and R-precision in both directions."""
        return {
            "loss": PooledLoss(),
            "texts_for_motion": TextsForMotion(),
            "motions_for_text": MotionsForText(),
        }

    @classmethod
    def import_released(cls, state: Mapping[str, Tensor], config: Config) -> Self:
        """Imports the weights of FLAME's released motion-CLIP into a task with the same sizes.

        The weights are named as in the authors' code. They include the pooler of the text
        encoder, because it was initialized at random in the authors' training. Raises `ValueError`
        if weights or sizes do not match.
        """
        representation: Representation = instantiate(config["representation"])
        task = cls.build(config, representation)
        theirs = "text_model.pooler.dense."
        pooler = {
            f"pooler_{name.removeprefix(theirs)}": state[name]
            for name in state
            if name.startswith(theirs)
        }
        load_strictly(task.condition, pooler, "released motion-CLIP")
        load_strictly(task.network, our_names(state), "released motion-CLIP")
        task.facts |= {"fingerprint": None, "max_frames": task.network.max_frames}
        return task.eval()

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Computes features (B, E) from motions (B, F, D) in the data's units, with mask (B, F)."""
        return self.network(self.representation.normalize(x), mask)

    def text(self, captions: Sequence[str]) -> Tensor:
        """Encodes captions as features (B, E)."""
        x = torch.zeros(len(captions), 1, self.representation.features, device=self.device)
        mask = torch.ones(len(captions), 1, dtype=torch.bool, device=self.device)
        return self.text_features(MotionBatch(x, mask, ids=list(captions), text=list(captions)))

    def text_features(self, batch: MotionBatch) -> Tensor:
        """Encodes the captions of a batch as features (B, E)."""
        cond = self.condition(batch)
        # A learned null condition is not used here, but DDP requires a gradient for it.
        if cond.null is not None:
            cond = cond.drop(torch.zeros(len(cond.pooled), dtype=torch.bool, device=self.device))
        return self.network.text(cond.pooled)

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor:
        """Returns the contrastive loss of a batch."""
        self.seed_step(batch_idx)
        text, motion = self.text_features(batch), self.network(batch.x, batch.mask)
        loss = info_nce(motion, text, self.network.logit_scale)
        self.report({"train/loss": loss, "train/temperature": (-self.network.logit_scale).exp()})
        return loss

    def validation_step(self, batch: MotionBatch, batch_idx: int) -> None:
        """Adds a batch to the validation metrics."""
        motion = F.normalize(self.network(batch.x, batch.mask), dim=-1)
        text = F.normalize(self.text_features(batch), dim=-1)
        self.update_samples(
            batch, generated=motion, text=text, scale=self.network.logit_scale.exp()
        )


_MCLIP = {
    "motion_encoder.motion_length_emb.": "length_embedding.",
    "motion_encoder.input_projection.": "input.",
    "motion_encoder.last_projection.": "output.",
    "motion_encoder.CLS_TOKEN": "cls",
    "lm_projection.": "text_projection.",
    "logit_scale": "logit_scale",
}


def our_names(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Renames the weights of FLAME's released network to this project's names, leaving out RoBERTa.

    Raises `ValueError` for unexpected weights.
    """
    learned = {name: value for name, value in state.items() if not name.startswith("text_model.")}
    layers, _ = layer_names(learned, "motion_encoder.motion_encoder", ENCODER_LAYER)
    ours = renamed(learned, {**layers, **_MCLIP})
    shape_of(ours, "cls", ndim=3)
    return ours | {"cls": ours["cls"].flatten()}
