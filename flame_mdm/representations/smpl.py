"""FLAME's features: translation and joint rotations of SMPL."""

from collections.abc import Iterable, Sequence

import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.representations import Representation, check_finite, rotation
from flame_mdm.representations.skeleton import SMPL24, forward_kinematics

ADULT = (
    *((0.0, 0.0, 0.0), (0.06, -0.085, 0.0), (-0.06, -0.085, 0.0), (0.0, 0.125, -0.035)),
    *((0.035, -0.39, 0.0), (-0.035, -0.39, 0.0), (0.0, 0.14, 0.0)),
    *((-0.015, -0.425, -0.04), (0.015, -0.425, -0.04), (0.0, 0.055, 0.025)),
    *((0.02, -0.055, 0.13), (-0.02, -0.055, 0.13), (0.0, 0.215, -0.045)),
    *((0.075, 0.115, -0.03), (-0.075, 0.115, -0.03), (0.0, 0.085, 0.055)),
    *((0.12, 0.045, -0.02), (-0.12, 0.045, -0.02), (0.26, -0.015, -0.025), (-0.26, -0.015, -0.025)),
    *((0.267, 0.01, 0.0), (-0.267, 0.01, 0.0), (0.085, -0.01, -0.015), (-0.085, -0.01, -0.015)),
)
"""Position of each of SMPL's 24 joints relative to its parent in the rest pose, in meters.

In the rest pose, the arms are stretched out to the sides, the body faces +z, and y points up. These
positions replace the licensed model files. They have the bone lengths of HumanML3D's reference
clip, rounded and made symmetric.
"""


AXIS_ANGLES = {66: 22, 72: 24, 156: 52, 165: 55}
"""Number of joints for each possible number of axis-angle values per frame.

The entries are for the body alone, SMPL, SMPL+H and SMPL-X.
"""


def read_pose(motion: Tensor) -> tuple[Tensor, Tensor]:
    """Splits a raw SMPL motion (F, 3 + 3 K) into a translation and rotation matrices.

    The motion consists of a translation in meters, followed by the axis-angle vectors of K = 24, 52
    or 55 joints. The results have the shapes (F, 3) and (F, 24, 3, 3), and are float64. As in
    FLAME's code, the first 24 of SMPL+H's 52 joints are used, so SMPL+H's left_index1 and
    left_index2 serve as the hands.

    Raises:
        UserError: If the shape of the motion is wrong (for example because it contains rotation
            matrices), or if it contains NaN or infinite values.
    """
    widths = [3 + numbers for numbers, joints in AXIS_ANGLES.items() if joints >= 24]
    if motion.ndim != 2 or not len(motion) or motion.shape[1] not in widths:
        raise UserError(
            "motion: expected shape (frames, 3 + 3 x joints) with 24, 52 or 55 joints, but found "
            f"{tuple(motion.shape)}"
        )
    check_finite(motion)
    motion = motion.double()
    return motion[:, :3], rotation.axis_angle_to_matrix(motion[:, 3:75].unflatten(1, (24, 3)))


class SMPL(Representation):
    """The 147 unnormalized features of Kim et al. 2023 (FLAME).

    The features are the translation (3) and 24 rotations as 6D vectors in the "rows" convention. As
    in AMASS, the coordinates are world coordinates in meters, with z up. The motion is neither
    centered nor rotated. See `read_pose` for the layout of raw motions.

    Args:
        fps: frames per second.
        offsets: (24, 3), offsets of the joints from their parents in the rest pose, in meters; used
            for decoding. The first offset is the position of the pelvis relative to the
            translation. Default: `ADULT`.

    Example:
        >>> representation = SMPL()
        >>> features = representation.encode(torch.zeros(10, 75))  # SMPL's rest pose
        >>> features.shape, representation.decode(features).shape
        (torch.Size([10, 147]), torch.Size([10, 24, 3]))
    """

    relative = False

    def __init__(self, fps: float = 20.0, offsets: Sequence[Sequence[float]] = ADULT):
        super().__init__("smpl147", 147, fps, SMPL24)
        self.offsets = offsets

    def encode(self, motion: Tensor) -> Tensor:
        """Encodes a raw motion (F, 3 + 3 K) as float32 features (F, 147); see `read_pose`."""
        translation, rotations = read_pose(motion)
        return torch.cat(
            [translation, rotation.matrix_to_rot6d(rotations, "rows").flatten(1)], 1
        ).float()

    def rotations6d(self, features: Tensor) -> Tensor:
        """Returns the rotations (..., F, 24, 6) of the joints."""
        return features[..., 3:].unflatten(-1, (24, 6))

    def decode(self, features: Tensor) -> Tensor:
        """Decodes features (..., F, 147) to joint positions (..., F, 24, 3) in meters.

        As in HumanML3D, y is up: the coordinates (x, y, z) become (-x, z, y).
        """
        rotations = rotation.rot6d_to_matrix(self.rotations6d(features), "rows")
        offsets = features.new_tensor(self.offsets)
        joints = forward_kinematics(
            self.skeleton, rotations, offsets, features[..., :3] + offsets[0]
        )
        return joints[..., [0, 2, 1]] * joints.new_tensor([-1.0, 1.0, 1.0])

    def joint_features(self, joints: Iterable[int]) -> Tensor:
        """Returns a bool mask (147,) that is True for the features of the given joints.

        The translation belongs to joint 0.
        """
        part = self.joint_mask(joints)
        return torch.cat([part[:1].expand(3), part.repeat_interleave(6)])
