# pyright: standard
"""Feature extractors for evaluation: a common interface to trained and released networks."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Generic, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from evaluators.extractors.action_gru import ActionGRU
from evaluators.extractors.classifier import ClassifierTask
from evaluators.extractors.mardm import MARDMClip, clip_tokens
from evaluators.extractors.motion_clip import MotionCLIPTask
from evaluators.extractors.stgcn import UESTC, Unconstrained
from evaluators.extractors.t2m import T2MEvaluator, WordVectors, load_t2m, read_statistics
from evaluators.extractors.t2m_training import T2MTask
from evaluators.extractors.training import ExtractorTask, Network
from flame_mdm.checkpoints.loading import find, load_task
from flame_mdm.checkpoints.model_files import weights_sha256
from flame_mdm.checkpoints.released_weights import load_strictly, read_weights
from flame_mdm.conditions.vocabulary import words
from flame_mdm.data.humanact12 import read_unconstrained
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.representations import Representation
from flame_mdm.safe_io import sha256
from flame_mdm.seeds import key


class Extractor(ABC):
    """A network that computes features of motions and, if it reads text, features of captions."""

    # Hash of the weights or files. Values computed with extractors that have different hashes are
    # not comparable.
    sha256: str
    # Fingerprint of the training data, if known
    fingerprint: str | None = None

    @abstractmethod
    def check(self, representation: Representation, dataset: str) -> None:
        """Raises `UserError` if the network was trained for a different representation or data set."""

    @abstractmethod
    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Returns "features" (B, E) and, for classifiers, "logits" (B, A).

        Motions are passed both as `features` (B, F, D) in the data's units and as joint positions
        `joints` (B, F, J, 3) in meters, with y up, together with the mask (B, F).
        """

    def texts(
        self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]
    ) -> Tensor | None:
        """Encodes captions as features (B, E). Returns None if the extractor does not read text.

        `tokens` contains the "word/PART" tokens of each caption, or None if they are unknown.
        """
        return None

    def reference(self) -> Tensor | None:
        """Features (N, E) of the network's own real motions, with which sets are compared.

        If None, sets are compared with motions from the data set.
        """
        return None


TrainedTask = TypeVar("TrainedTask", bound=ExtractorTask)


class OwnExtractor(Extractor, Generic[TrainedTask]):
    """A network trained with `make train`, loaded from its checkpoint.

    Raises `UserError` if the checkpoint contains a different kind of model.
    """

    task: TrainedTask
    trained: type[TrainedTask]
    recipes: str  # folder of the recipes that train the network

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        self.path = find(path)
        self.task = load_task(self.path, self.trained, device)
        self.sha256 = weights_sha256(self.path)
        self.fingerprint = self.task.facts.get("fingerprint")

    def check(self, representation: Representation, dataset: str) -> None:
        """Raises `UserError` if the extractor was trained on a different representation, frame rate or data set."""
        trained, learned = self.task.representation, self.task.facts.get("dataset", dataset)
        if not self.reads(representation) or learned != dataset:
            raise UserError(
                f"extractor {self.path}: trained on {trained.name} features of {learned} at {trained.fps:g} frames "
                f"per second, but the motions are {representation.name} features of {dataset} at "
                f"{representation.fps:g}. Train a matching extractor with make train EXP={self.recipes}/..."
            )

    def reads(self, other: Representation) -> bool:
        """Returns whether the network accepts motions in this representation."""
        trained = self.task.representation
        return (trained.name, trained.fps, trained.features) == (
            other.name,
            other.fps,
            other.features,
        )

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes "features" (B, E) from motions (B, F, D) in the data's units, with mask (B, F)."""
        return {"features": self.task(features, mask)}


class MotionCLIPExtractor(OwnExtractor[MotionCLIPTask]):
    """A motion-CLIP trained with `make train EXP=motion_clip/...`."""

    trained, recipes = MotionCLIPTask, "motion_clip"

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        super().__init__(path, device)
        self.encoded: dict[str, Tensor] = {}

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Encodes captions as features (B, E). Each distinct caption is encoded only once."""
        new = sorted(set(captions) - self.encoded.keys())
        if new:
            self.encoded |= dict(zip(new, self.task.text(new), strict=True))
        return torch.stack([self.encoded[caption] for caption in captions])

    @torch.no_grad()
    def fit(self, motions: Sequence[Motion]) -> list[float]:
        """Returns how well motions fit their texts: the mean cosine over the parts of each motion.

        Because a motion-CLIP overrates motions that it has selected, evaluate such motions with
        another motion-CLIP.
        """
        scores = []
        for motion in motions:
            parts = motion.parts or ((motion.text, 0, len(motion.features)),)
            texts = self.texts([text for text, _, _ in parts], [None] * len(parts))
            features = []
            for _, begin, end in parts:
                x = torch.from_numpy(motion.features[None, begin:end]).to(texts.device)
                features.append(self.task(x, torch.ones_like(x[..., 0], dtype=torch.bool)))
            scores.append(float(F.cosine_similarity(torch.cat(features), texts).mean()))
        return scores


class OwnT2MExtractor(OwnExtractor[T2MTask]):
    """An evaluator of Guo et al. 2022 trained with `make train EXP=t2m/...`."""

    trained, recipes = T2MTask, "t2m"

    def reads(self, other: Representation) -> bool:
        """Returns whether the network accepts motions in a representation.

        A part of the network's own representation is accepted if it contains all features that the
        network uses.
        """
        trained = self.task.representation
        is_part = (other.part_of, other.fps) == (trained.name, trained.fps)
        reads_part = is_part and self.task.network.used <= other.features
        return reads_part or super().reads(other)

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Encodes captions as features (B, E).

        The features are computed from the words or, if the extractor reads tags, from the tagged
        words.
        """
        return self.task.text(
            list(map(words, captions)) if self.task.learns_words else _tagged(self.path, tokens)
        )


class OwnClassifierExtractor(OwnExtractor[ClassifierTask]):
    """An action classifier trained with `make train EXP=classifier/...`."""

    trained, recipes = ClassifierTask, "classifier"

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes "features" (B, E) and "logits" (B, actions) from joints (B, F, J, 3) and their mask (B, F)."""
        return {
            "features": self.task(joints, mask),
            "logits": self.task.network.logits(joints, mask),
        }


def _tagged(path: Path, tokens: Sequence[Sequence[str] | None]) -> list[Sequence[str]]:
    tagged = [words for words in tokens if words is not None]
    if len(tagged) < len(tokens):
        raise UserError(
            f"extractor {path}: needs tagged words, but the data set has captions without them"
        )
    return tagged


class ReleasedExtractor(Extractor, Generic[Network]):
    """A network with the weights that its authors released.

    The weights are loaded from a file or from a folder with `FILES`.
    """

    FILES: tuple[str, ...] = ()
    network: Network
    # Names of the representation and the data set on which the network was trained
    made_for: tuple[str, str]
    # Number of features that the network reads, starting with the first one
    used = 0

    def __init__(self, path: str):
        self.path = Path(path)
        files = [self.path / name for name in self.FILES] or [self.path]
        missing = [str(file) for file in files if not file.is_file()]
        if missing:
            raise FileNotFoundError(
                f"{', '.join(missing)}: no such file. Use the path of the authors' release"
            )
        hashes = [sha256(file) for file in files]
        self.sha256 = (
            hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()
        )

    def check(self, representation: Representation, dataset: str) -> None:
        """Raises `UserError` if the extractor was released for a different representation or data set."""
        names = {representation.name} | (
            {representation.part_of} if self.used <= representation.features else set()
        )
        if self.made_for[0] not in names or dataset != self.made_for[1]:
            raise UserError(
                f"extractor {self.path}: made for {' of '.join(self.made_for)}, but the motions are "
                f"{representation.name} of {dataset}"
            )

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes "features" (B, E) from motions (B, F, D) in the data's units, with mask (B, F)."""
        return {"features": self.network(features, mask)}


class T2MExtractor(ReleasedExtractor[T2MEvaluator]):
    """The released evaluator of Guo et al. 2022, or MARDM's first evaluator.

    It is loaded from a folder with five files: finest.tar (from text_mot_match/model), mean.npy and
    std.npy (t2m_... in MDM, kit_... for KIT, eval_... in MARDM), our_vab_data.npy and
    our_vab_idx.pkl (GloVe). `full_length` is a legacy option; see `WordVectors`.
    """

    FILES = ("finest.tar", "mean.npy", "std.npy", "our_vab_data.npy", "our_vab_idx.pkl")

    def __init__(self, path: str, device: str | torch.device = "cpu", *, full_length: bool = False):
        super().__init__(path)
        self.network = load_t2m(self.path).to(device)
        self.words, self.full_length, self.used = (
            WordVectors.read(self.path),
            full_length,
            self.network.used,
        )
        human, kit = ("humanml-legacy-smpl22", "humanml3d"), ("humanml-legacy-kit21", "kit")
        made_for = {263: human, 67: human, 251: kit, 64: kit}
        self.made_for = made_for.get(
            len(self.network.mean), ("unknown features", "an unknown data set")
        )

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Encodes the tagged words of captions as features (B, E)."""
        return self.network.text(
            self.words(_tagged(self.path, tokens), full_length=self.full_length)
        )


class MARDMClipExtractor(ReleasedExtractor[MARDMClip]):
    """The second evaluator that MARDM released.

    MARDM's CLIP-score is the `MotionCLIPScore` computed from this evaluator's features. The files
    are finest.tar (from text_mot_match_clip/model), mean.npy and std.npy (eval_mean and eval_std).
    """

    FILES = ("finest.tar", "mean.npy", "std.npy")
    made_for = ("humanml-legacy-smpl22", "humanml3d")

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        super().__init__(path)
        network, weights = MARDMClip(*read_statistics(self.path)), self.path / self.FILES[0]
        self.network = load_strictly(network, read_weights(weights, "contrast_model"), weights).to(
            device
        )

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Encodes captions as features (B, E)."""
        return self.network.text(clip_tokens(captions).to(self.network.mean.device))


CLASSIFIERS: dict[str, tuple[type[ActionGRU | UESTC | Unconstrained], str | None, str]] = {
    "humanact12": (ActionGRU, "model", "humanact12"),
    "humanact12_unconstrained": (Unconstrained, None, "humanact12"),
    "uestc": (UESTC, None, "uestc"),
}
"""Released action classifiers: the network, the key of the weights in the file, and the data set.

The authors' files are action_recognition_model_humanact12.tar (humanact12_gru.tar in MDM),
humanact12_gru_modi_struct.pth.tar (not a GRU despite its name) and uestc_rot6d_stgcn.tar.
"""


class ClassifierExtractor(ReleasedExtractor[ActionGRU | UESTC | Unconstrained]):
    """A released action classifier (one of `CLASSIFIERS`) that reads 24 SMPL joints or their rotations.

    `random_start` is a legacy option that follows Guo et al. 2020 and all later work: the initial
    state of the humanact12 GRU is drawn from a normal distribution, separately for features and
    scores. In this implementation, the draw depends only on the motion.
    """

    def __init__(
        self,
        kind: str,
        path: str,
        device: str | torch.device = "cpu",
        *,
        random_start: bool = False,
    ):
        super().__init__(path)
        network, weights_key, dataset = CLASSIFIERS[kind]
        weights = self.path / self.FILES[0] if self.FILES else self.path
        self.network = load_strictly(network(), read_weights(weights, weights_key), weights).to(
            device
        )
        self.made_for, self.random_start = ("rot6d-25", dataset), random_start
        if random_start and network is not ActionGRU:
            raise UserError(
                f"random_start: the classifier {kind} is not recurrent and has no initial state"
            )

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes "features" (B, E) and "logits" (B, actions) from motions and their mask (B, F)."""
        network = self.network
        x = features if isinstance(network, UESTC) else joints
        if not (self.random_start and isinstance(network, ActionGRU)):
            return {"features": network(x, mask), "logits": network.logits(x, mask)}
        pairs = zip(x, mask, strict=True)
        names = [
            hashlib.sha256(motion[real].cpu().numpy().tobytes()).hexdigest()
            for motion, real in pairs
        ]
        start = {
            use: network.random_state([key(use, name) for name in names])
            for use in ("features", "logits")
        }
        return {
            "features": network(x, mask, start["features"]),
            "logits": network.logits(x, mask, start["logits"]),
        }


class UnconstrainedExtractor(ClassifierExtractor):
    """Classifier and reference motions for unconstrained HumanAct12 synthesis.

    Both are loaded from a folder with the two `FILES`.
    """

    FILES = ("humanact12_gru_modi_struct.pth.tar", "humanact12_unconstrained_modi_struct.npy")

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        super().__init__("humanact12_unconstrained", path, device)
        self.real = torch.from_numpy(read_unconstrained(self.path / self.FILES[1])).to(device)

    def reference(self) -> Tensor:
        """Features (N, 256) of the reference motions."""
        assert isinstance(self.network, Unconstrained)
        mask = torch.ones(self.real.shape[:2], dtype=torch.bool, device=self.real.device)
        pairs = zip(self.real.split(64), mask.split(64), strict=True)
        return torch.cat([self.network.published(*pair) for pair in pairs]).float().cpu()
