"""Selection of the best of several generated motions by how well they fit their texts."""

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F

from evaluators.extractors import MotionCLIPExtractor
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator


def text_fit(
    path: str, model: MotionGenerator, device: str | torch.device = "cpu"
) -> Callable[[Sequence[Motion]], list[float]]:
    """Returns a score for `flame_mdm.generate`: the cosine similarity of a motion and its text, mean over its parts.

    Selection by a motion-CLIP biases its own score: evaluate with a different one.

    Raises:
        FileNotFoundError, UserError: If the checkpoint does not exist, or was trained for other motions.
    """
    extractor = MotionCLIPExtractor(path, device)
    extractor.check(model.representation, model.facts.get("dataset", ""))

    @torch.no_grad()
    def score(motions: Sequence[Motion]) -> list[float]:
        scores = []
        for motion in motions:
            parts = motion.parts or ((motion.text, 0, len(motion.features)),)
            texts = extractor.texts([text for text, _, _ in parts], [None] * len(parts))
            features = []
            for _, begin, end in parts:
                x, joints = (torch.from_numpy(y[None, begin:end]).to(device) for y in (motion.features, motion.joints))
                features.append(extractor.motions(x, joints, torch.ones_like(x[..., 0], dtype=torch.bool))["features"])
            scores.append(float(F.cosine_similarity(torch.cat(features), texts).mean()))
        return scores

    return score
