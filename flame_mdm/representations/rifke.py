"""TEMOS's features: root height, local joint positions, heading change and root velocity."""

from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.representations import Frames, Representation, check_finite, moments, rotation
from flame_mdm.representations.skeleton import KIT21

KNEES_AND_ELBOWS = [
    KIT21.joints.index(f"{side}_{part}") for part in ("knee", "elbow") for side in ("left", "right")
]
"""Joints that the published code uses as hips and shoulders.

The published code removes the root, but still uses the original indices of hips and shoulders.
"""


class Rifke(Representation):
    """The 64 features of Petrovich et al. 2022 (TEMOS) for KIT's 21 joints; FLAME also uses them.

    A motion of T frames is encoded as T rows.

    | columns | content |
    |---|---|
    | 0 | height of the root above the floor |
    | 1:61 | joint positions without the root, in body coordinates: root at x = z = 0, facing +z; y above the floor |
    | 61 | heading change since the previous frame in radians; 0 in the first frame |
    | 62:64 | x and z of the root's displacement since the previous frame, in body coordinates |

    Three peculiarities of the published code are kept. The height of the floor is a soft minimum,
    so it depends on the unit of length. Heading changes are not unwrapped. The heading is computed
    from knees and elbows instead of the intended hips and shoulders.

    Args:
        fps: frames per second.
        units_per_metre: how many of the features' length units make up one meter. KIT's unit is
            1/640 meter. Input and output joint positions are in meters.

    Example:
        >>> representation = Rifke()
        >>> features = representation.encode(torch.randn(10, 21, 3))
        >>> features.shape, representation.decode(features).shape
        (torch.Size([10, 64]), torch.Size([10, 21, 3]))
    """

    def __init__(self, fps: float = 12.5, units_per_metre: float = 640.0):
        super().__init__("rifke", 64, fps, KIT21)
        self.units_per_metre = units_per_metre

    def encode(self, motion: Tensor) -> Tensor:
        """Encodes finite joint positions (T, 21, 3) as float32 features (T, 64).

        The positions are in meters, with y up.
        """
        if motion.ndim != 3 or motion.shape[1:] != (21, 3) or not len(motion):
            raise UserError(
                f"motion: expected shape (frames, 21, 3) for {self.name}, but found "
                f"{tuple(motion.shape)}"
            )
        check_finite(motion)
        joints = motion.double() * self.units_per_metre
        joints[..., 1] -= self.floor(joints)
        root, others = joints[:, 0], joints[:, 1:]
        heading = self.heading(joints)
        ground = root * root.new_tensor([1.0, 0.0, 1.0])
        local = rotation.rotate_y(others - ground[:, None], -heading[:, None])
        turn = F.pad(heading.diff(), (1, 0))
        step = rotation.rotate_y(F.pad(root.diff(dim=0), (0, 0, 1, 0)), -heading)
        return torch.cat([root[:, 1:2], local.flatten(1), turn[:, None], step[:, ::2]], 1).float()

    def decode(self, features: Tensor) -> Tensor:
        """Decodes features (..., T, 64) to joint positions (..., T, 21, 3) in meters.

        In the first frame, the root is at x = z = 0 and faces +z. The decoding is differentiable.
        """
        turned, step = features[..., 61].cumsum(-1), features[..., 62:]
        heading = turned - turned[..., :1]
        step = torch.stack([step[..., 0], torch.zeros_like(heading), step[..., 1]], -1)
        moved = rotation.rotate_y(step, heading).cumsum(-2)
        ground = moved - moved[..., :1, :]
        root = ground + F.pad(features[..., :1], (1, 1))
        local = rotation.rotate_y(features[..., 1:61].unflatten(-1, (20, 3)), heading[..., None])
        return (
            torch.cat([root[..., None, :], local + ground[..., None, :]], -2) / self.units_per_metre
        )

    def floor(self, joints: Tensor) -> Tensor:
        """Estimates the height of the floor from joint positions (T, 21, 3).

        Positions and heights are in KIT's unit. The estimate is a soft minimum of the lowest foot's
        height over time.
        """
        lowest = joints[:, list(KIT21.feet), 1].amin(1)
        least, most = lowest.min(), lowest.max()
        return least - torch.log(0.5 + torch.exp(least - most))

    def heading(self, joints: Tensor) -> Tensor:
        """Returns the heading (T,) of a body with joint positions (T, 21, 3).

        Headings are in radians, from -pi to pi. A body with heading 0 faces +z. For positive
        headings, the body is turned toward +x.
        """
        left_knee, right_knee, left_elbow, right_elbow = joints[:, KNEES_AND_ELBOWS].unbind(1)
        across = right_knee - left_knee + right_elbow - left_elbow
        return torch.atan2(-across[:, 2], across[:, 0])

    def joint_features(self, joints: Iterable[int]) -> Tensor:
        """Returns a bool mask (64,) that is True for the features of the given joints.

        The root trajectory belongs to joint 0.
        """
        part = self.joint_mask(joints)
        return torch.cat([part[:1], part[1:].repeat_interleave(3), part[:1].expand(3)])

    def statistics(self, features: Tensor | Frames) -> tuple[Tensor, Tensor]:
        """Returns the mean and the unbiased std of each feature.

        The std of a constant feature is 1.
        """
        mean, squares = moments(features)
        std = (squares / (len(features) - 1)).sqrt()
        return mean.float(), torch.where(std > 0, std, 1.0).float()


def upsample(joints: Tensor, factor: int = 8) -> Tensor:
    """Increases the frame rate of a motion (T, ...) by a factor, using linear interpolation.

    The result has (T - 1) * factor + 1 frames. TEMOS is evaluated at 100 frames per second, 8 times
    the rate of the features.
    """
    steps = torch.arange((len(joints) - 1) * factor + 1)
    begin = (steps // factor).clamp(max=max(len(joints) - 2, 0))
    weight = ((steps - begin * factor) / factor).to(joints).reshape(-1, *[1] * (joints.ndim - 1))
    return torch.lerp(joints[begin], joints[(begin + 1).clamp(max=len(joints) - 1)], weight)
