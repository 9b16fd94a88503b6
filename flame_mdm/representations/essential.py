"""MARDM's essential features: the part of HumanML3D's that positions are decoded from."""

from collections.abc import Iterable, Sequence
from typing import Literal

from torch import Tensor

from flame_mdm.representations.humanml import HumanML


class Essential(HumanML):
    """The first 67 of HumanML3D's 263 features (Meng et al. 2025, MARDM), 64 of KIT's 251, 3 J + 1 for J joints.

    They are turn, root velocity, root height and positions, from which `decode` gives the same joints.
    """

    def __init__(
        self,
        skeleton: str = "smpl22",
        variant: Literal["clean", "legacy"] = "clean",
        fps: float = 20.0,
        bone_lengths: Sequence[float] | None = None,
        units_per_metre: float = 1.0,
    ):
        super().__init__(skeleton, variant, fps, bone_lengths, units_per_metre)
        self.features = 3 * len(self.skeleton) + 1
        self.slices = {name: part for name, part in self.slices.items() if part.stop <= self.features}
        self.part_of, self.name = self.name, f"essential-{variant}-{skeleton}"
        self.mean, self.std = self.mean[: self.features], self.std[: self.features]

    def encode_many(self, motions: Sequence[Tensor]) -> list[Tensor]:
        return [features[:, : self.features].clone() for features in super().encode_many(motions)]

    def joint_features(self, joints: Iterable[int]) -> Tensor:
        return super().joint_features(joints)[: self.features]
