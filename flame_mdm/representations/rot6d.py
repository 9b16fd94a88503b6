"""Features of the action data sets: SMPL rotations and root trajectory."""

from collections.abc import Iterable, Sequence
from copy import deepcopy

import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.representations import Features, Representation, rotation
from flame_mdm.representations.skeleton import SMPL24, forward_kinematics
from flame_mdm.representations.smpl import ADULT, read_pose


class Rot6D(Representation):
    """The 25 x 6 unnormalized features of Petrovich et al. 2021 (ACTOR).

    The features are 24 rotations as 6D vectors in the "rows" convention, followed by
    (x, y, z, 0, 0, 0). (x, y, z) is the root's translation relative to the first frame. The
    translation is in meters and in camera coordinates, where y points down and z points away
    from the camera. See `smpl.read_pose` for the layout of raw motions.

    Args:
        fps: frames per second.
        offsets: (24, 3), offsets of the joints from their parents in the rest pose, in meters; used
            for decoding. Default: `ADULT`.

    Example:
        >>> representation = Rot6D()
        >>> features = representation.encode(torch.zeros(10, 75))  # SMPL's rest pose
        >>> features.shape, representation.decode(features).shape
        (torch.Size([10, 150]), torch.Size([10, 24, 3]))
    """

    relative = False

    def __init__(self, fps: float = 20.0, offsets: Sequence[Sequence[float]] = ADULT):
        super().__init__("rot6d-25", 150, fps, SMPL24)
        self.offsets = offsets

    def encode(self, motion: Tensor) -> Tensor:
        """Encodes a raw motion (F, 3 + 3 K) as float32 features (F, 150); see `smpl.read_pose`."""
        translation, rotations = read_pose(motion)
        rows = rotation.matrix_to_rot6d(rotations, "rows").flatten(1)
        return torch.cat([rows, F.pad(translation - translation[:1], (0, 3))], 1).float()

    def rebase(self, features: Features) -> Features:
        """Makes root translations relative to the first frame of each cut clip (..., F, D)."""
        moved = deepcopy(features)
        translation = moved[..., 144:147]
        translation -= features[..., :1, 144:147]
        return moved

    def rotations6d(self, features: Tensor) -> Tensor:
        """Returns the rotations (..., F, 24, 6) of the joints."""
        return features[..., :144].unflatten(-1, (24, 6))

    def decode(self, features: Tensor) -> Tensor:
        """Decodes features (..., F, 150) to joint positions (..., F, 24, 3) in meters.

        The camera coordinates are rotated by 180 degrees about x, so that y is up.
        """
        rotations = rotation.rot6d_to_matrix(self.rotations6d(features), "rows")
        translation = features[..., 144:147]
        joints = forward_kinematics(
            self.skeleton, rotations, features.new_tensor(self.offsets), translation
        )
        return joints * joints.new_tensor([1.0, -1.0, -1.0])

    def joint_features(self, joints: Iterable[int]) -> Tensor:
        """Returns a bool mask (150,) that is True for the features of the given joints.

        The translation belongs to joint 0.
        """
        part = self.joint_mask(joints)
        return torch.cat([part, part[:1]]).repeat_interleave(6)
