# pyright: standard
"""Trains Guo et al.'s evaluator (see `t2m`) on data that its released weights do not support."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric, Metric

from evaluators.extractors.t2m import UNIT, LearnedWords, T2MEvaluator, WordVectors
from evaluators.extractors.training import ExtractorTask
from evaluators.metrics.alignment import MotionsForText, MultimodalDistance
from evaluators.metrics.samples import SampleMetric
from flame_mdm.batch import MotionBatch
from flame_mdm.conditions import ConditionEncoder, Unconditional
from flame_mdm.conditions.vocabulary import words as words_of
from flame_mdm.config import Config, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation


class _MovementDecoder(nn.Module):
    """Inverse of the movement encoder: transposed convolutions decode each vector into 4 frames."""

    def __init__(self, latent: int, hidden: int, out_features: int):
        super().__init__()
        self.in_net = nn.Linear(latent, latent)
        self.main = nn.Sequential(
            *(nn.ConvTranspose1d(latent, hidden, 4, 2, 1), nn.LeakyReLU(0.2)),
            *(nn.ConvTranspose1d(hidden, out_features, 4, 2, 1), nn.LeakyReLU(0.2)),
        )
        self.out_net = nn.Linear(out_features, out_features)

    def forward(self, latents: Tensor) -> Tensor:
        """Decodes vectors (B, N, latent) into frames (B, 4 N, out_features)."""
        return self.out_net(self.main(self.in_net(latents).transpose(1, 2)).transpose(1, 2))


def reconstruction_terms(
    network: T2MEvaluator, decoder: nn.Module, batch: MotionBatch
) -> dict[str, Tensor]:
    """Returns the movement autoencoder's loss terms, each (B,), over the real frames of each motion."""
    frames = batch.x.shape[1] // UNIT * UNIT
    x, mask = batch.x[:, :frames, : network.used], batch.mask[:, :frames]
    latents, units = network.movement_encoder(x), mask[:, UNIT - 1 :: UNIT]

    def mean(values: Tensor, real: Tensor) -> Tensor:
        return (values.mean(-1) * real).sum(1) / real.sum(1).clamp(min=1)

    return {
        "reconstruction": mean((decoder(latents) - x).abs(), mask),
        "sparsity": mean(latents.abs(), units),
        "smoothness": mean(latents.diff(dim=1).abs(), units[:, 1:]),
    }


def matching_loss(
    motion: Tensor, text: Tensor, margin: float, fits: Tensor | None = None
) -> Tensor:
    """Computes the contrastive loss of Guo et al. 2022 over B pairs. Returns a scalar.

    The formula is eq. 4 of Hadsell et al. 2006, without its factor 1/2. Each text is compared with
    its own motion and with a wrong motion. To find a wrong motion, the rows before the text's row
    are searched backward, wrapping around to the last row, for the first motion that the text does
    not describe. The wrong motion adds no loss if its distance from the text is larger than
    `margin`. The authors shift the motions by a random number of rows instead, which also pushes
    matching pairs apart.

    Args:
        motion: (B, E) features of the motions.
        text: (B, E) features of the texts.
        margin: distance beyond which a wrong motion adds no loss.
        fits: (B, B) bool, True if the text of the row describes the motion of the column. If None,
            each text describes only its own motion.
    """
    count = len(motion)
    rows = torch.arange(count, device=motion.device)
    previous = (rows[:, None] - 1 - rows[: count - 1]) % count
    wrong = (
        torch.ones_like(previous, dtype=torch.bool) if fits is None else ~fits.gather(1, previous)
    )
    other = previous.gather(1, wrong.int().argmax(1, keepdim=True))[:, 0]
    near = torch.linalg.vector_norm(motion - text, dim=-1)
    far = torch.linalg.vector_norm(motion[other] - text, dim=-1)
    return (near.square() + (margin - far).clamp(min=0).square() * wrong.any(1)).mean()


class MatchingLoss(SampleMetric):
    """The `matching_loss` over all pairs, sorted by key."""

    higher_is_better = False
    states = ("generated", "text")

    def __init__(self, margin: float):
        super().__init__()
        self.margin = margin

    def value(self, motion: Tensor, text: Tensor) -> float | None:
        """Computes the loss from motion and text features, both (N, E), or returns None for a single pair."""
        return matching_loss(motion, text, self.margin).item() if len(motion) > 1 else None


class T2MTask(ExtractorTask[T2MEvaluator]):
    """Trains the evaluator (`make train EXP=t2m/...`).

    Until step `movement_steps`, the movement encoder is trained with a decoder to reconstruct
    motions. Then the movement encoder is frozen, and the text and motion encoders are trained so
    that the embeddings of matching pairs are close. A motion counts as wrong for a text only if the
    text is not one of the motion's captions. Checkpoints contain the word vectors.

    Args:
        words: folder with our_vab_data.npy and our_vab_idx.pkl (see `WordVectors`), which is needed
            only for training. "learned" = the vectors are learned, for data sets whose words are
            not tagged; see `LearnedWords`.
        movement_steps: number of training steps for the movement encoder.
        sparsity: weight of the mean magnitude of movement vectors in the loss.
        smoothness: weight of the mean magnitude of the differences between successive movement
            vectors.
        margin: distance beyond which a wrong motion adds no loss.
    """

    noun = "a trained evaluator of Guo et al."

    def __init__(
        self,
        network: T2MEvaluator,
        condition: ConditionEncoder,
        representation: Representation,
        *,
        words: str,
        movement_steps: int,
        sparsity: float,
        smoothness: float,
        margin: float,
        optimizer: Config,
        seed: int = 0,
    ):
        super().__init__(network, condition, representation, optimizer=optimizer, seed=seed)
        first, linear = network.movement_encoder.main[0], network.movement_encoder.out_net
        assert isinstance(first, nn.Conv1d)
        self.decoder = _MovementDecoder(linear.out_features, first.out_channels, first.in_channels)
        self.word_folder, self.movement_steps = words, movement_steps
        self.sparsity, self.smoothness, self.margin = sparsity, smoothness, margin
        self.words: WordVectors | LearnedWords | None = (
            LearnedWords() if words == "learned" else None
        )
        self.tokens: dict[str, dict[str, list[str]]] = {}  # tokens of the captions of each clip

    @classmethod
    def parts(
        cls, config: Config, representation: Representation, actions: Sequence[str]
    ) -> dict[str, Any]:
        """Returns the network, the decoder and the word vectors of a recipe."""
        statistics = {"mean": representation.mean.clone(), "std": representation.std.clone()}
        return {
            "network": instantiate(config["task"]["network"], **statistics),
            "condition": Unconditional(),
        }

    def metrics(self) -> dict[str, Metric]:
        """Returns the validation metrics: losses, distance and R-precision."""
        of_pairs = {"mm_dist": MultimodalDistance(), "motions_for_text": MotionsForText()}
        return {"loss": MatchingLoss(self.margin), **of_pairs, "reconstruction": MeanMetric()}

    def setup(self, stage: str) -> None:
        """Sets up the task, reads the word vectors, and collects the tagged words of all captions."""
        super().setup(stage)
        data: MotionDataModule = self.trainer.datamodule  # type: ignore[attr-defined]
        if data.batch_size < 2:
            raise UserError(
                f"data.batch_size={data.batch_size}: matching needs at least two motions per batch"
            )
        if not self.learns_words:
            self.words = WordVectors.read(Path(self.word_folder))
            self.facts["words"] = {str(word): int(row) for word, row in self.words.rows.items()}
        self.network.mean.copy_(self.representation.mean)
        self.network.std.copy_(self.representation.std)
        for clip in (*data.train.clips, *data.val.clips):
            tagged = (
                map(words_of, clip.captions)
                if self.learns_words
                else clip.attributes.get("tokens", ())
            )
            # If a clip has equal captions, only the first one counts.
            self.tokens[clip.id] = dict(reversed(list(zip(clip.captions, tagged, strict=False))))
        bare = [name for name, tokens in self.tokens.items() if not tokens]
        if bare:
            kind = "captions" if self.learns_words else "captions with tagged words"
            raise UserError(
                f"{data.folder}: {len(bare)} clips have no {kind}, such as {bare[0]}. Choose a "
                f"data set with captions, or set task.words=learned if only the tagged words "
                f"are missing"
            )

    @property
    def learns_words(self) -> bool:
        """Whether the word vectors are learned instead of read from a file."""
        return isinstance(self.words, LearnedWords)

    def get_extra_state(self) -> Tensor:
        """Returns the word vectors (words, 300) that were read from a file.

        `facts` maps words to rows.
        """
        return self.words.vectors if isinstance(self.words, WordVectors) else torch.zeros(0)

    def set_extra_state(self, state: Tensor) -> None:
        """Restores the word vectors from a checkpoint.

        Raises `UserError` if a resumed run reads different vectors.
        """
        if self.learns_words:
            return
        if isinstance(self.words, WordVectors) and not torch.equal(self.words.vectors, state.cpu()):
            raise UserError(
                f"task.words={self.word_folder}: these are not the word vectors that this run began with"
            )
        self.words = WordVectors(self.facts["words"], state.cpu())

    def text(self, tokens: Sequence[Sequence[str]]) -> Tensor:
        """Encodes captions as features (B, E).

        A caption is a list of "word/PART" tokens or, if the vectors are learned, of words.
        """
        assert self.words is not None
        return self.network.text(self.words(tokens))

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor:
        """Returns the loss of a batch: first the reconstruction loss, then the matching loss."""
        self.seed_step(batch_idx)
        self.network.movement_encoder.train(self._learns_movement)
        if self._learns_movement:
            values = reconstruction_terms(self.network, self.decoder, batch)
            terms = {name: value.mean() for name, value in values.items()}
            loss = (
                terms["reconstruction"]
                + self.sparsity * terms["sparsity"]
                + self.smoothness * terms["smoothness"]
            )
        else:
            fits = [[text in self.tokens[name] for name in batch.ids] for text in batch.text or ()]
            loss = matching_loss(
                *self._embed(batch), self.margin, torch.tensor(fits, device=self.device)
            )
        self.report({"train/loss": loss})
        # The second term gives all parameters a gradient, as DDP requires.
        return loss + 0 * sum(parameter.sum() for parameter in self._idle())

    def on_before_optimizer_step(self, optimizer: torch.optim.Optimizer) -> None:
        """Removes the gradients of parameters that are not being trained.

        Even with a gradient of 0, momentum would change these parameters.
        """
        for parameter in self._idle():
            parameter.grad = None

    @property
    def _learns_movement(self) -> bool:
        return self.trainer.global_step < self.movement_steps

    def _idle(self) -> list[nn.Parameter]:
        movement = [*self.network.movement_encoder.parameters(), *self.decoder.parameters()]
        matching = [
            *self.network.text_encoder.parameters(),
            *self.network.motion_encoder.parameters(),
        ]
        matching += self.words.parameters() if isinstance(self.words, LearnedWords) else []
        return matching if self._learns_movement else movement

    def _embed(self, batch: MotionBatch) -> tuple[Tensor, Tensor]:
        assert batch.text is not None
        tokens = [self.tokens[name][text] for name, text in zip(batch.ids, batch.text, strict=True)]
        return self(self.representation.denormalize(batch.x), batch.mask), self.text(tokens)

    def validation_step(self, batch: MotionBatch, batch_idx: int) -> None:
        """Adds a batch to the validation metrics."""
        motion, text = self._embed(batch)
        self.update_samples(batch, generated=motion, text=text)
        errors = reconstruction_terms(self.network, self.decoder, batch)["reconstruction"]
        self.val_metrics["reconstruction"].update(errors)  # type: ignore[operator]
