"""Feature extractors for evaluation: a common interface to trained and released networks."""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from evaluators.extractors.action_gru import ActionGRU, load_action_gru
from evaluators.extractors.classifier import ClassifierTask
from evaluators.extractors.mardm import MARDMClip, clip_tokens, load_mardm_clip
from evaluators.extractors.motion_clip import MotionCLIPTask
from evaluators.extractors.stgcn import Unconstrained, load_uestc, load_unconstrained
from evaluators.extractors.t2m import WordVectors, load_t2m
from evaluators.extractors.t2m_training import T2MTask
from flame_mdm.checkpoints.loading import find, load_task
from flame_mdm.checkpoints.model_files import weights_sha256
from flame_mdm.conditions.vocabulary import words
from flame_mdm.data.humanact12 import read_unconstrained
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation
from flame_mdm.safe_io import sha256
from flame_mdm.seeds import key
from flame_mdm.task import Task


class Extractor(ABC):
    """A network that computes features of motions, and of texts if it supports them.

    Attributes:
        sha256: of its weights or files. Values of extractors with different hashes are not comparable.
        fingerprint: of the data it was trained on, if known.
    """

    sha256: str
    fingerprint: str | None = None

    @abstractmethod
    def check(self, representation: Representation, dataset: str) -> None:
        """Checks that the network was trained for these motions.

        Raises:
            UserError: If it was trained for another representation or data set.
        """

    @abstractmethod
    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes features of motions.

        Args:
            features: (B, F, D) in the data's units.
            joints: (B, F, J, 3) in meters, y up.
            mask: (B, F), True = real frame.

        Returns:
            "features" (B, E), and "logits" (B, A) of classifiers.
        """

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor | None:
        """Computes features (B, E) of captions; None if the network does not support text.

        Args:
            captions: the texts.
            tokens: their "word/PART" tokens, if known.
        """
        return None

    def reference(self) -> Tensor | None:
        """(N, E) features of real motions that belong to the network, to compare sets with; None = the data set's."""
        return None


class OwnExtractor(Extractor):
    """A network trained with `make train`, loaded from its checkpoint.

    Raises:
        FileNotFoundError, UserError: If the checkpoint does not exist, or holds another network.
    """

    task: Task
    trained: type[Task]
    recipes: str
    """Folder of the recipes that train it."""

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        self.path = find(path)
        self.task = load_task(self.path, self.trained, device)
        self.sha256 = weights_sha256(self.path)
        self.fingerprint = self.task.facts.get("fingerprint")

    def check(self, representation: Representation, dataset: str) -> None:
        """Checks that representation and data set are those of its training."""
        own, advice = self.task.representation, f"Train one with make train EXP={self.recipes}/..."
        if not self._reads(representation):
            raise UserError(
                f"extractor {self.path}: trained on {own.name} at {own.fps:g} frames per second, but the motions are "
                f"{representation.name} at {representation.fps:g}. {advice}"
            )
        if self.task.facts.get("dataset", dataset) != dataset:
            raise UserError(
                f"extractor {self.path}: trained on the data set {self.task.facts['dataset']}, but the motions are "
                f"from {dataset}. {advice}"
            )

    def _reads(self, representation: Representation) -> bool:
        own = self.task.representation
        return (own.name, own.fps, own.features) == (representation.name, representation.fps, representation.features)


class MotionCLIPExtractor(OwnExtractor):
    """A motion-CLIP trained with `make train EXP=motion_clip/...`."""

    trained, recipes = MotionCLIPTask, "motion_clip"
    task: MotionCLIPTask

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        super().__init__(path, device)
        self.known: dict[str, Tensor] = {}

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes features of motions."""
        return {"features": self.task(features, mask)}

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Computes features of captions; each caption is encoded once."""
        new = sorted(set(captions) - self.known.keys())
        if new:
            self.known |= dict(zip(new, self.task.text(new), strict=True))
        return torch.stack([self.known[caption] for caption in captions])


class T2MExtractor(Extractor):
    """The evaluator of Guo et al. 2022, or MARDM's first evaluator, as released, from a folder with five files.

    The files are finest.tar (from text_mot_match/model), mean.npy and std.npy (t2m_mean.npy and t2m_std.npy in MDM,
    kit_... for KIT, eval_mean.npy and eval_std.npy in MARDM), our_vab_data.npy and our_vab_idx.pkl (GloVe).

    Args:
        path: the folder.
        device: to compute on.
        full_length: legacy option, see `WordVectors`: captions are treated as filling all 22 slots.

    Raises:
        FileNotFoundError, ValueError: If a file is missing, or has other content.
    """

    FILES = ("finest.tar", "mean.npy", "std.npy", "our_vab_data.npy", "our_vab_idx.pkl")

    def __init__(self, path: str, device: str | torch.device = "cpu", *, full_length: bool = False):
        folder = Path(path)
        missing = [name for name in self.FILES if not (folder / name).is_file()]
        if missing:
            raise FileNotFoundError(f"{folder}: not a folder of the T2M evaluator: it lacks {', '.join(missing)}")
        hashes = "".join(sha256(folder / name) for name in self.FILES)
        self.path, self.sha256 = folder, hashlib.sha256(hashes.encode()).hexdigest()
        self.network = load_t2m(*(folder / name for name in self.FILES[:3])).to(device)
        self.words, self.full_length = WordVectors(folder), full_length

    def check(self, representation: Representation, dataset: str) -> None:
        """Checks that the motions have the published features of the data set with that number of features."""
        human, kit = ("humanml-legacy-smpl22", "humanml3d"), ("humanml-legacy-kit21", "kit")
        made_for = {263: human, 67: human, 251: kit, 64: kit}
        wanted = made_for.get(len(self.network.mean), ("unknown features", "an unknown data set"))
        parts = {representation.part_of} if self.network.used <= representation.features else set()
        if wanted[0] not in {representation.name, *parts} or dataset != wanted[1]:
            raise UserError(
                f"extractor {self.path}: made for {wanted[0]} of {wanted[1]}, but the motions are "
                f"{representation.name} of {dataset}"
            )

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes features of motions."""
        return {"features": self.network(features, mask)}

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Computes features of captions.

        Raises:
            UserError: If a caption has no tokens.
        """
        return self.network.text(self.words(_tagged(self.path, tokens), full_length=self.full_length))


class MARDMClipExtractor(Extractor):
    """The second evaluator of MARDM as released, for its CLIP-score: `MotionCLIPScore` of its features.

    Args:
        path: a folder of finest.tar (from text_mot_match_clip/model), mean.npy and std.npy (eval_mean, eval_std).
        device: to compute on.

    Raises:
        FileNotFoundError, ValueError: If a file is missing, or has other content.
    """

    FILES = ("finest.tar", "mean.npy", "std.npy")
    network: MARDMClip

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        folder = Path(path)
        self.path, self.network = folder, load_mardm_clip(*(folder / name for name in self.FILES)).to(device)
        self.sha256 = hashlib.sha256("".join(sha256(folder / name) for name in self.FILES).encode()).hexdigest()

    def check(self, representation: Representation, dataset: str) -> None:
        """Checks that the motions have the published features of HumanML3D, or the essential ones."""
        if "humanml-legacy-smpl22" not in (representation.name, representation.part_of) or dataset != "humanml3d":
            raise UserError(
                f"extractor {self.path}: made for humanml-legacy-smpl22 of humanml3d, but the motions are "
                f"{representation.name} of {dataset}"
            )

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes features of motions."""
        return {"features": self.network(features, mask)}

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Computes features of captions."""
        return self.network.text(clip_tokens(captions).to(self.network.mean.device))


class OwnT2MExtractor(OwnExtractor):
    """An evaluator of Guo et al. 2022 trained with `make train EXP=t2m/...`."""

    trained, recipes = T2MTask, "t2m"
    task: T2MTask

    def _reads(self, representation: Representation) -> bool:
        own, used = self.task.representation, self.task.network.used  # it may see only features that both have
        part = (representation.part_of, representation.fps) == (own.name, own.fps) and used <= representation.features
        return part or super()._reads(representation)

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes features of motions."""
        return {"features": self.task(features, mask)}

    def texts(self, captions: Sequence[str], tokens: Sequence[Sequence[str] | None]) -> Tensor:
        """Computes features of captions.

        Raises:
            UserError: If a caption has no tokens, and the evaluator needs them.
        """
        given = [words(caption) for caption in captions] if self.task.learns_words else tokens
        return self.task.text(_tagged(self.path, given))


def _tagged(path: Path, tokens: Sequence[Sequence[str] | None]) -> list[Sequence[str]]:
    """Returns the tokens of captions.

    Raises:
        UserError: If a caption has no tokens.
    """
    known = [words for words in tokens if words is not None]
    if len(known) < len(tokens):
        raise UserError(f"extractor {path}: needs tagged words, but the data set has captions without them")
    return known


CLASSIFIERS = {
    "humanact12": (load_action_gru, "humanact12", "joints"),
    "humanact12_unconstrained": (load_unconstrained, "humanact12", "joints"),
    "uestc": (load_uestc, "uestc", "features"),
}
"""Name -> loader of the released weights, data set that they belong to, and input that they read."""


class ClassifierExtractor(Extractor):
    """A released action classifier, one of `CLASSIFIERS`.

    Args:
        kind: which one.
        path: the file.
        device: to compute on.
        random_start: legacy option of Guo et al. 2020 and all later work: the initial state of the humanact12 GRU is
            drawn from a normal distribution, separately for features and scores. Here, the draw is a function of the
            motion, so it is the same in any batch.

    Raises:
        FileNotFoundError, UserError, ValueError: If the file does not exist or holds other weights, or `random_start`
            is given for a network that is not recurrent.
    """

    def __init__(self, kind: str, path: str, device: str | torch.device = "cpu", *, random_start: bool = False):
        read, self.dataset, self.reads = CLASSIFIERS[kind]
        try:
            self.network = read(path).to(device)
        except UserError:
            raise
        except ValueError as error:
            raise UserError(
                f"{error}. For classifiers of make train EXP=classifier/..., use protocol=action_to_motion_own"
            ) from error
        self.path, self.sha256, self.random_start = path, sha256(path), random_start
        if random_start and not isinstance(self.network, ActionGRU):
            raise ValueError(f"random_start: the classifier {kind} is not recurrent")

    def check(self, representation: Representation, dataset: str) -> None:
        """Checks that the motions are rotations of 24 SMPL joints, from the data set of its training."""
        if representation.name != "rot6d-25" or dataset != self.dataset:
            raise UserError(
                f"extractor {self.path}: made for {self.dataset} as rot6d-25, but the motions are "
                f"{representation.name} of {dataset}"
            )

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes features and class scores of motions."""
        x = joints if self.reads == "joints" else features
        if not self.random_start:
            return {"features": self.network(x, mask), "logits": self.network.logits(x, mask)}
        assert isinstance(self.network, ActionGRU)
        names = [
            hashlib.sha256(motion[real].cpu().numpy().tobytes()).hexdigest()
            for motion, real in zip(x, mask, strict=True)
        ]
        start = {use: torch.cat([self._start(use, name) for name in names], 1) for use in ("features", "logits")}
        return {
            "features": self.network(x, mask, start["features"]),
            "logits": self.network.logits(x, mask, start["logits"]),
        }

    def _start(self, use: str, name: str) -> Tensor:
        assert isinstance(self.network, ActionGRU)
        return self.network.random_state(1, torch.Generator().manual_seed(key(use, name)))


class UnconstrainedExtractor(ClassifierExtractor):
    """The classifier of unconstrained HumanAct12 with its reference motions, from a folder of the two files in `FILES`.

    Args:
        path: the folder.
        device: to compute on.

    Raises:
        FileNotFoundError, UserError, ValueError: a file is missing, or is another one.
    """

    FILES = ("humanact12_gru_modi_struct.pth.tar", "humanact12_unconstrained_modi_struct.npy")

    def __init__(self, path: str, device: str | torch.device = "cpu"):
        weights, motions = (Path(path) / name for name in self.FILES)
        missing = [file.name for file in (weights, motions) if not file.is_file()]
        if missing:
            raise FileNotFoundError(
                f"{path}: not a folder of the unconstrained reference, it lacks {', '.join(missing)}"
            )
        super().__init__("humanact12_unconstrained", str(weights), device)
        self.real = torch.from_numpy(read_unconstrained(motions)).to(device)
        self.sha256 = hashlib.sha256((self.sha256 + sha256(motions)).encode()).hexdigest()

    def reference(self) -> Tensor:
        """(N, 256) features of the reference motions."""
        assert isinstance(self.network, Unconstrained)
        batches = self.real.split(64)
        masks = [torch.ones(batch.shape[:2], dtype=torch.bool, device=batch.device) for batch in batches]
        found = [self.network.published(batch, mask) for batch, mask in zip(batches, masks, strict=True)]
        return torch.cat(found).float().cpu()


class OwnClassifierExtractor(OwnExtractor):
    """An action classifier trained with `make train EXP=classifier/...`."""

    trained, recipes = ClassifierTask, "classifier"
    task: ClassifierTask

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Computes features and class scores of motions."""
        return {"features": self.task(joints, mask), "logits": self.task.logits(joints, mask)}
