# pyright: standard
"""A motion-CLIP that is calibrated with near-miss captions and noisy copies of motions."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from evaluators.encoding import encode
from evaluators.extractors.motion_clip import MotionCLIPTask, info_nce
from evaluators.near_misses import near_misses
from flame_mdm.batch import MotionBatch
from flame_mdm.config import Config
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.seeds import key

# Near-miss captions per motion and step. If possible, each one is wrong in a different attribute.
NEAR_MISSES = 2
# Standard deviation, in meters, of noise on the joints at strength 1
JITTER = 0.02
# Standard deviation, in normalized features, of noise in the features at strength 1. This noise
# moves joints by about 20 mm.
FEATURE_NOISE = 0.3
# Weight of `calibration_error` relative to `info_nce`
WEIGHT = 5.0
# Length of all features. Noise of strength s moves all motions in the same direction, so its FID is
# about (10 s)^2.
LENGTH = 10.0


class CalibratedMotionCLIPTask(MotionCLIPTask):
    """Trains a motion-CLIP on texts that differ in details, and gives its distances a known scale.

    - Texts: if two clips have the same captions or attributes, the motion of one clip is not a
      negative for the captions of the other. Near-miss captions (see `near_misses`) are additional
      negatives.
    - Motions: half of the motions are paired with a noisy copy. The strength of the noise is drawn
      from [0, 1], with small values more likely. The distance between the features of a motion and
      its copy, both scaled to norm 1, is trained to equal this strength. In half of the copies,
      white noise is added to the joints, which are then encoded again, like motions from files. In
      the other half, noise is added to the normalized features, like the noise in generated
      motions.

    All features are scaled to the same norm. Otherwise, differences between the norms would distort
    Euclidean distances, although they do not affect cosines.
    """

    representation: HumanML
    meanings: dict[str, list[int]]
    near_misses: dict[str, list[list[str]]]

    @classmethod
    def parts(
        cls, config: Config, representation: Representation, actions: Sequence[str]
    ) -> dict[str, Any]:
        """Returns the parts of a recipe. Raises `UserError` if the representation does not encode joints."""
        if not isinstance(representation, HumanML):
            raise UserError(
                f"representation={representation.name}: {cls.__name__} adds noise to joints and encodes them again. "
                "Use a representation such as humanml_clean, or train another recipe of motion_clip/..."
            )
        return super().parts(config, representation, actions)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """Encodes motions as features (B, E), scaled to the norm `LENGTH`.

        The motions (B, F, D) with mask (B, F) are in the data's units.
        """
        return LENGTH * F.normalize(super().forward(x, mask), dim=-1)

    def text(self, captions: Sequence[str]) -> Tensor:
        """Encodes captions as features (B, E), scaled to the norm `LENGTH`."""
        return LENGTH * F.normalize(super().text(captions), dim=-1)

    def on_fit_start(self) -> None:
        """Collects the meanings and the near misses of the training captions."""
        super().on_fit_start()
        clips = self.trainer.datamodule.train.clips  # type: ignore[attr-defined]
        self.meanings, self.near_misses = {}, {}
        for clip, texts in zip(clips, near_misses(clips), strict=True):
            attributes = json.dumps(clip.attributes if "action" in clip.attributes else clip.id)
            self.meanings[clip.id] = [
                key("captions", *sorted(clip.captions)),
                key("attributes", attributes),
            ]
            self.near_misses[clip.id] = list(texts.values())

    def training_step(self, batch: MotionBatch, batch_idx: int) -> Tensor:
        """Returns the loss of a batch with its captions and their near misses."""
        self.seed_step(batch_idx)
        assert batch.text is not None
        wrong = [
            self.near_miss(name, number, batch_idx)
            for name in batch.ids
            for number in range(NEAR_MISSES)
        ]
        texts = self.text_features(replace(batch, text=batch.text + wrong))
        text, wrong_text = texts.tensor_split([len(batch)])
        pairs = zip(batch.ids, batch.text, strict=True)
        meaning = [[*self.meanings[name], key("caption", caption)] for name, caption in pairs]

        chosen = torch.randperm(len(batch))[: (len(batch) + 1) // 2].to(self.device)
        strength = torch.rand(len(chosen)) ** 2
        copies = noisy_copies(self.representation, batch.x[chosen], batch.lengths[chosen], strength)
        motion = self.network(
            torch.cat([batch.x, copies]), torch.cat([batch.mask, batch.mask[chosen]])
        )
        motion, copy = motion.tensor_split([len(batch)])
        alike, wrong_text = (
            torch.tensor(meaning, device=self.device),
            wrong_text.unflatten(0, (-1, NEAR_MISSES)),
        )
        contrast = info_nce(motion, text, self.network.logit_scale, alike, wrong_text)
        error = calibration_error(motion[chosen], copy, strength.to(self.device))
        loss, temperature = contrast + WEIGHT * error, (-self.network.logit_scale).exp()
        values = {
            "loss": loss,
            "contrast": contrast,
            "calibration_error": error,
            "temperature": temperature,
        }
        self.report({f"train/{name}": value for name, value in values.items()})
        return loss

    def near_miss(self, name: str, number: int, step: int) -> str:
        """Returns a near miss for a clip, or "" if it has none.

        The choice is a function of (seed, step, clip, number).
        """
        attributes = self.near_misses[name] or [[""]]
        draw = key("near miss", self.seed, step, name)
        texts = attributes[(draw + number) % len(attributes)]
        return texts[key("text", draw, number) % len(texts)]


def calibration_error(motion: Tensor, copy: Tensor, strength: Tensor) -> Tensor:
    """Returns the mean absolute difference between feature distances and `strength` (B,).

    The distance between a motion's features (B, E) and its copy's features (B, E) is computed after
    both are scaled to norm 1.
    """
    distance = torch.linalg.vector_norm(
        F.normalize(motion, dim=-1) - F.normalize(copy, dim=-1), dim=-1
    )
    return (distance - strength).abs().mean()


def noisy_copies(representation: HumanML, x: Tensor, lengths: Tensor, strength: Tensor) -> Tensor:
    """Returns noisy copies (B, F, D) of normalized motions.

    In the first half of the batch, noise is added to the joints; in the second half, to the
    features. `strength` (B,) is the strength of the noise. The noise is drawn from torch's CPU
    generator.
    """
    half, frames = (len(x) + 1) // 2, lengths.tolist()
    joints = representation.to_joints(x[:half]).cpu()
    noisy = [
        (motion[:length] + JITTER * amount * torch.randn(length, *motion.shape[1:])).numpy()
        for motion, length, amount in zip(joints, frames, strength, strict=False)
    ]
    encoded = (
        torch.from_numpy(features).to(x.device) for features in encode(representation, noisy)
    )
    copies = [representation.normalize(features) for features in encoded]
    for motion, length, amount in zip(x[half:], frames[half:], strength[half:], strict=True):
        noise = FEATURE_NOISE * amount * torch.randn(length, x.shape[2])
        copies.append(motion[:length] + noise.to(x.device))
    return F.pad(pad_sequence(copies, batch_first=True), (0, 0, 0, x.shape[1] - max(frames)))
