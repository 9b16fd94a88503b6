# pyright: standard
"""Share of true claims: a referee judges which claims in captions are true of the motions."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from evaluators.metrics.samples import MotionMean, Rows, Timed
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampling.referee.claims import Claim
from flame_mdm.sampling.referee.judging import SHORTEST, Verdict, verdicts
from flame_mdm.sampling.referee.kinds import GROUPS
from flame_mdm.sampling.referee.sentences import read_claims

# An audit keeps this many seconds of each motion, so that all sets of motions have the same size.
KEPT_SECONDS = 10.0
STEP = 0.0005  # meters per unit of the kept positions


@lru_cache(maxsize=20_000)
def claims_of(caption: str) -> tuple[Claim, ...]:
    """Returns the claims in a caption. The result is cached, because many motions may have the same caption."""
    return tuple(read_claims(caption))


class ClaimAccuracy(Timed, MotionMean):
    """Fraction of decided claims that are true.

    This metric was introduced in this project. The referee (`flame_mdm.sampling.referee`) reads the
    claims in the caption of each motion, and checks each claim by measuring the joints of the
    motion. The values are fractions in [0, 1] for each group of claims, such as "side" and "count",
    and for "all" claims; higher is better. "decided" is the fraction of claims that the referee can
    decide, and "captions" is the fraction of captions with at least one decided claim. Motions that
    are shorter than 0.5 seconds, or that have a skeleton other than SMPL's 22 joints, are not
    judged.

    Args:
        fps: frames per second of the motions.

    Example:
        >>> metric, joints = ClaimAccuracy(fps=20), torch.zeros(1, 40, 22, 3)
        >>> joints[:, :, [1, 4, 7], 1] = torch.tensor([0.9, 0.5, 0.1])  # a leg
        >>> mask, captions = torch.ones(1, 40, dtype=torch.bool), ["a person walks forward"]
        >>> metric.update(joints, mask, captions, keys=torch.tensor([0]))
        >>> metric.compute()["all"]  # it does not move
        0.0
    """

    higher_is_better = True
    summary = "all"
    names = (*GROUPS, "all", "decided", "captions")
    directions = {"decided": None, "captions": None}  # noqa: RUF012

    def update(self, joints: Tensor, mask: Tensor, captions: Sequence[str], keys: Tensor) -> None:
        """Adds B motions.

        Args:
            joints: (B, F, J, 3) positions in meters, with y up.
            mask: (B, F) bool, True for real frames.
            captions: B captions.
            keys: (B,) int64, unique keys of the motions.

        Raises:
            UserError: If a real frame contains NaN or infinity.
        """
        motions = self.real_frames(joints, mask)
        rows = [
            self._shares(self.judged(motion.cpu().numpy(), caption))
            for motion, caption in zip(motions, captions, strict=True)
        ]
        self.add(keys, rows)

    def judged(self, joints: np.ndarray, caption: str) -> list[Verdict]:
        """Returns the verdicts on the claims that a caption makes about a motion (F, J, 3)."""
        if joints.shape[1] != len(SMPL22) or len(joints) < (SHORTEST + 0.1) * self.fps:
            return []
        return verdicts(joints, self.fps, claims_of(caption))

    @staticmethod
    def _shares(judged: Sequence[Verdict]) -> dict[str, Tensor]:
        """Maps each value's name to 1 or 0 for every claim that counts toward the value."""
        decided = [verdict for verdict in judged if verdict.answer != "cannot tell"]
        true = {
            name: [verdict.answer == "yes" for verdict in decided if name in (verdict.group, "all")]
            for name in (*GROUPS, "all")
        }
        flags = true | {
            "decided": [verdict.answer != "cannot tell" for verdict in judged],
            "captions": [bool(decided)],
        }
        return {name: torch.tensor(values, dtype=torch.float64) for name, values in flags.items()}

    def readings(self, motions: Rows) -> dict[str, np.ndarray]:
        """Returns the joints themselves, because what is measured depends on the captions.

        "positions" (N, F, 3 J) are int16, in units of `STEP`, relative to the starting point on the
        floor. "frames" (N,) are the lengths of the motions.
        """
        longest = round(KEPT_SECONDS * self.fps)
        motions_of = motions["joints"]
        frames = np.array([min(len(joints), longest) for joints in motions_of])
        width = motions_of[0].shape[1] * 3
        positions = np.zeros((len(frames), longest, width), np.int16)
        for row, joints in enumerate(motions_of):
            kept = joints[:longest].double().numpy()
            kept = kept - kept[0, 0] * np.array([1.0, 0.0, 1.0])
            units = np.clip(np.rint(kept / STEP), -32_767, 32_767)
            positions[row, : len(kept)] = units.reshape(len(kept), width)
        return {"positions": positions, "frames": frames}

    def per_sample(self, rows: Rows) -> dict[str, Tensor]:
        """Returns the numbers (N, 2) of true and decided claims per motion, keyed by value name."""
        pairs: dict[str, list[list[float]]] = {name: [] for name in self.names}
        for packed, frames, caption in zip(
            rows["positions"], rows["frames"], rows["captions"], strict=True
        ):
            joints = packed[:frames].reshape(frames, -1, 3) * STEP
            shares = self._shares(self.judged(joints, caption))
            for name, flags in shares.items():
                pairs[name].append([float(flags.sum()), len(flags)])
        tensors = {name: torch.tensor(pair, dtype=torch.float64) for name, pair in pairs.items()}
        return {name: pair for name, pair in tensors.items() if pair[:, 1].any()}
