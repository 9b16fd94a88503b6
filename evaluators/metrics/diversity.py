"""Diversity and multimodality: how much generated motions differ from one another."""

import numpy as np
import torch
from torch import Tensor

from evaluators.metrics.samples import SampleMetric, real_frames
from flame_mdm.errors import UserError


def pair_distance(a: Tensor, b: Tensor) -> float:
    """Returns the mean Euclidean distance of features a (..., E) and b (..., E)."""
    return torch.linalg.vector_norm(a - b, dim=-1).mean().item()


class Diversity(SampleMetric):
    """Mean distance of random pairs of motions (Guo et al. 2020; MDM, eq. 6). Best if equal to that of real motions.

    Published values use 300 pairs, drawn as two sets without replacement, for text-to-motion, and 200 pairs with
    replacement for action-to-motion and unconstrained synthesis. In both cases, a motion may be paired with itself,
    which counts as 0.

    Args:
        pairs: number of pairs.
        replace: whether a motion may be drawn twice for the same side.
    """

    higher_is_better = None
    states = ("generated",)

    def __init__(self, pairs: int, replace: bool, seed: int = 0):
        super().__init__()
        self.pairs, self.replace, self.seed = pairs, replace, seed

    def value(self, features: Tensor) -> float:
        self.need(len(features), 2 if self.replace else self.pairs, f"motions for {self.pairs} pairs")
        generator = np.random.default_rng(self.seed)
        first, second = (
            torch.from_numpy(generator.choice(len(features), self.pairs, replace=self.replace)).to(features.device)
            for _ in range(2)
        )
        return pair_distance(features[first], features[second])


class PromptMultimodality(SampleMetric):
    """Multimodality of several motions per prompt, the same number for each prompt."""

    higher_is_better = None
    states = ("generated", "groups")
    samples: int  # motions per prompt

    def value(self, features: Tensor, groups: Tensor) -> float:
        return self.distance(features[self.by_group(groups, self.samples)])

    def distance(self, features: Tensor) -> float:
        """Returns the mean distance within features (C, S, E) of S motions of each of C prompts."""
        raise NotImplementedError


class TextMultimodality(PromptMultimodality):
    """Multimodality of Guo et al. 2022 (MDM, B.2; MFM, eq. 12): 10 random pairs out of 30 motions per text.

    As in their code, two sets of 10 are drawn without replacement from the 30, with the same indices for all texts; a
    motion that is in both may be paired with itself. Published for 100 texts; the code of MDM and MFM uses whole
    batches, that is 128 texts.

    Args:
        samples: motions per text.
        pairs: pairs per text.
    """

    def __init__(self, samples: int = 30, pairs: int = 10, seed: int = 0):
        super().__init__()
        self.samples, self.pairs, self.seed = samples, pairs, seed

    def distance(self, features: Tensor) -> float:
        generator = np.random.default_rng(self.seed)
        first, second = (
            torch.from_numpy(generator.choice(self.samples, self.pairs, replace=False)).to(features.device)
            for _ in range(2)
        )
        return pair_distance(features[:, first], features[:, second])


class PairedMultimodality(PromptMultimodality):
    """Multimodality of FLAME (eq. 19): two sets of 10 motions per text, compared one by one.

    FLAME published no code for it. Its Table 3 has 10 motions per text, but eq. 19 uses two sets of 10. This is the
    latter, with 20 motions per text.

    Args:
        samples: motions in each of the two sets.
    """

    def __init__(self, samples: int = 10):
        super().__init__()
        self.samples = 2 * samples

    def distance(self, features: Tensor) -> float:
        first, second = features.chunk(2, dim=1)
        return pair_distance(first, second)


class ActionMultimodality(SampleMetric):
    """Multimodality of Guo et al. 2020 (MDM, eq. 7): 20 random pairs of the same class, for each class.

    As in the authors' code, a motion may be drawn repeatedly and be paired with itself. The authors divide the sum by
    the number of all classes, including those without motions; here, it is divided by the number of classes that have
    motions.

    Args:
        pairs: pairs per class.
    """

    higher_is_better = None
    states = ("generated", "labels")

    def __init__(self, pairs: int = 20, seed: int = 0):
        super().__init__()
        self.pairs, self.seed = pairs, seed

    def value(self, features: Tensor, labels: Tensor) -> float:
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
    """Variance of joint positions among the motions of a text, in square meters.

    FLAME (Table 3) averages "the variance of joints for the 10 generated motions" and says that eq. 18, a variance over
    the frames of one motion, is used; it published no code. Here, the variance over the motions of a text (n - 1 in the
    denominator) is computed for each frame and joint, summed over x, y and z, and averaged over joints, frames and
    texts. It is not comparable with FLAME's numbers. The motions of a text must have the same length.

    Args:
        samples: motions per text.
    """

    higher_is_better = None
    states = ("groups",)
    motions: list[Tensor]

    def __init__(self, samples: int = 10):
        super().__init__()
        self.samples = samples
        self.add_state("motions", [], dist_reduce_fx="cat")

    def update(self, joints: Tensor, mask: Tensor, groups: Tensor, keys: Tensor) -> None:
        self.motions += real_frames("JointVariance", joints, mask)
        self.keep(keys=keys, groups=groups)

    def value(self, groups: Tensor) -> float:
        motions = [self.motions[index] for index in self.order("keys").tolist()]
        values = []
        for members in self.by_group(groups, self.samples).tolist():
            lengths = {len(motions[index]) for index in members}
            if len(lengths) > 1:
                raise UserError(
                    f"JointVariance: motions of one text have {sorted(lengths)} frames. Generate them at one length"
                )
            joints = torch.stack([motions[index] for index in members]).double()
            values.append(joints.var(0).sum(-1).mean())
        return torch.stack(values).mean().item()
