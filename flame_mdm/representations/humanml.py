"""HumanML3D's features: root trajectory, joint positions, rotations, velocities and contacts."""

from collections.abc import Iterable, Sequence
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.representations import Representation, check_finite, rotation
from flame_mdm.representations.skeleton import SKELETONS

LEGACY_SMOOTHING_FRAMES, SMOOTHING_SECONDS = 20, 1.0
"""Standard deviation of the Gaussian that removes arm swing from the heading.

The published value is 20 frames at 20 fps.
"""


class HumanML(Representation):
    """The features of Guo et al. 2022 (HumanML3D).

    There are 263 features for 22 joints, 251 for KIT's 21 joints, and 12 J - 1 for J joints. A
    motion of T frames is encoded as T - 1 rows. Columns by name, in `slices`:

    | name | width | content |
    |---|---|---|
    | turn | 1 | heading change to the next frame in radians |
    | root_velocity | 2 | x and z of the root's displacement to the next frame, in body coordinates |
    | root_height | 1 | y of the root |
    | positions | 3 (J - 1) | joint positions without the root, in body coordinates: root at x = z = 0, facing +z |
    | rotations | 6 (J - 1) | 6D (columns) relative to the previous bone: shortest arcs, not SMPL's rotations |
    | velocities | 3 J | each joint's displacement to the next frame, in body coordinates |
    | contacts | 4 | 1 if a foot joint (`skeleton.feet`) hardly moves until the next frame |

    The heading is 0 when the body faces +z, and increases as the body turns left, toward +x.
    Motions are first made canonical: the lowest joint is at y = 0, and in the first frame, the
    root is at x = z = 0 and the body faces +z.

    The variant "legacy" reproduces the published data with all its peculiarities. The direction
    across the body is the direction across the shoulders minus the direction across the hips,
    instead of their sum. In the first frame, the heading is set to 0, although the smoothed heading
    is not 0. `turn` is half the turn to the right, and changes sign where the heading crosses 180
    degrees. The root velocity is in the body coordinates of the next frame. Rotations are world
    rotations of the bones relative to the inverse heading, including the bones at the shoulders.
    `decode` also follows the published code. If a bone points exactly opposite to its rest
    direction, the published code returns NaN. This implementation returns a half turn instead.

    The variant "clean" has none of these peculiarities. Before headings are smoothed, they are
    unwrapped and padded point-symmetrically at both ends, so that steady turns and the first and
    last heading are preserved. Rotations are computed after the body is turned to face +z, and are
    relative to the parent in the skeleton.

    Input and output joint positions are in meters. Features are in units of 1 / `units_per_metre`
    meters (KIT: 1/640).

    Args:
        skeleton: key in `SKELETONS`.
        variant: "clean" for the intended features, "legacy" for the published features.
        fps: frames per second.
        bone_lengths: for each of the J joints, the length of the bone that ends there, in the
            features' unit. All motions are retargeted to these lengths. If None, each motion keeps
            its own bone lengths.
        units_per_metre: how many of the features' length units make up one meter.
        contact_threshold: squared displacement of a foot per frame, in the features' unit, below
            which the foot is considered to be in contact with the floor. HumanML3D uses 0.002, and
            KIT uses 0.05.

    Raises:
        UserError: If the skeleton is unknown, or if `bone_lengths` does not match the skeleton.

    Example:
        >>> representation = HumanML()
        >>> motion = torch.randn(10, 22, 3)
        >>> features = representation.encode(motion)
        >>> features.shape, representation.decode(features).shape
        (torch.Size([9, 263]), torch.Size([9, 22, 3]))
    """

    essential: bool = False  # whether the last three columns of the table are left out

    def __init__(
        self,
        skeleton: str = "smpl22",
        variant: Literal["clean", "legacy"] = "clean",
        fps: float = 20.0,
        bone_lengths: Sequence[float] | None = None,
        units_per_metre: float = 1.0,
        contact_threshold: float = 0.002,
    ):
        if skeleton not in SKELETONS:
            raise UserError(f"skeleton={skeleton!r}: unknown. Use one of {', '.join(SKELETONS)}")
        joints = len(SKELETONS[skeleton])
        if bone_lengths is not None and len(bone_lengths) != joints:
            raise UserError(
                f"bone_lengths: got {len(bone_lengths)} numbers, but {skeleton} has {joints} joints"
            )
        widths = {"turn": 1, "root_velocity": 2, "root_height": 1, "positions": 3 * (joints - 1)}
        name = f"humanml-{variant}-{skeleton}"
        if self.essential:
            self.part_of, name = name, f"essential-{variant}-{skeleton}"
        else:
            widths |= {"rotations": 6 * (joints - 1), "velocities": 3 * joints, "contacts": 4}
        super().__init__(name, sum(widths.values()), fps, SKELETONS[skeleton])
        ends = np.cumsum(list(widths.values())).tolist()
        self.slices = {
            name: slice(end - widths[name], end) for name, end in zip(widths, ends, strict=True)
        }
        last = "positions" if self.essential else "rotations"
        self.pose = slice(self.slices["root_height"].start, self.slices[last].stop)
        self.legacy, self.bone_lengths = variant == "legacy", bone_lengths
        self.units_per_metre, self.contact_threshold = units_per_metre, contact_threshold

    def encode(self, motion: Tensor) -> Tensor:
        """Encodes finite joint positions (T >= 3, J, 3) as float32 features (T - 1, D).

        The positions are in meters, with y up.
        """
        return self.encode_many([motion])[0]

    def encode_many(self, motions: Sequence[Tensor]) -> list[Tensor]:
        """Encodes several motions at once, which is faster than encoding each one separately."""
        joints, lengths = self._canonical(motions)
        heading = torch.cat([self._heading(clip) for clip in joints.split(lengths)])
        last = torch.tensor(lengths).cumsum(0) - 1
        now = torch.ones(len(joints), dtype=torch.bool).index_fill(0, last, False).nonzero()[:, 0]
        step = joints[now + 1] - joints[now]
        joints, heading, next_heading = joints[now], heading[now], heading[now + 1]

        turn = next_heading - heading
        root_velocity = rotation.rotate_y(step[:, 0], -(next_heading if self.legacy else heading))[
            :, ::2
        ]
        if self.legacy:
            turn = torch.arcsin(torch.sin(-turn / 2))
        local = joints.clone()
        local[..., ::2] -= joints[:, :1, ::2]
        local = rotation.rotate_y(local, -heading[:, None])
        rotations = self._rotations(joints if self.legacy else local, heading)
        velocities = rotation.rotate_y(step, -heading[:, None])
        contacts = step[:, list(self.skeleton.feet)].square().sum(-1) < self.contact_threshold
        features = [turn[:, None], root_velocity, joints[:, 0, 1:2]]
        features += [local[:, 1:].flatten(1), rotations.flatten(1), velocities.flatten(1), contacts]
        rows = torch.cat([part.float() for part in features], 1)[:, : self.features].contiguous()
        return list(rows.split([length - 1 for length in lengths]))

    def decode(self, features: Tensor) -> Tensor:
        """Decodes the turn, root and position columns of features (..., F, D).

        Returns the joint positions (..., F, J, 3) in meters. The decoding is differentiable.
        """
        heading, root = self._root(features)
        local = features[..., self.slices["positions"]].unflatten(-1, (-1, 3))
        turned = rotation.rotate_y(local, heading[..., None])
        ground = root * root.new_tensor([1.0, 0.0, 1.0])
        return (
            torch.cat([root[..., None, :], turned + ground[..., None, :]], -2)
            / self.units_per_metre
        )

    @property
    def turn_unit(self) -> float:
        """Heading change to the left, in radians, per unit of the column `turn`."""
        return -2.0 if self.legacy else 1.0

    def root_steps(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Returns how the root turns (..., F) and moves (..., F, 2) from each frame to the next.

        Turns are in radians, positive to the left. The movement consists of the distance to the
        left of the body and the distance forward, in meters.

        Args:
            features: (..., F, D) in the data's units.
        """
        turn = features[..., self.slices["turn"].start] * self.turn_unit
        return turn, features[..., self.slices["root_velocity"]] / self.units_per_metre

    def joint_features(self, joints: Iterable[int]) -> Tensor:
        """Returns a bool mask (D,) that is True for the features of the given joints.

        For the root and the joints of the lower body, the mask equals MDM's `HML_LOWER_BODY_MASK`.
        """
        part = self.joint_mask(joints)
        feet = part[list(self.skeleton.feet)]
        others = [part[1:].repeat_interleave(size) for size in (3, 6)]
        return torch.cat([part[:1].expand(4), *others, part.repeat_interleave(3), feet])[
            : self.features
        ]

    def _canonical(self, motions: Sequence[Tensor]) -> tuple[Tensor, list[int]]:
        """Makes motions canonical, and returns all their frames (N, J, 3) and their lengths.

        Frames are float64 in the features' unit.
        """
        size = len(self.skeleton)
        for number, motion in enumerate(motions):
            name = f"motion {number}" if len(motions) > 1 else "motion"
            if motion.ndim != 3 or motion.shape[1:] != (size, 3):
                raise UserError(
                    f"{name}: expected shape (frames, {size}, 3) for {self.name}, but found "
                    f"{tuple(motion.shape)}"
                )
            if len(motion) < 3:
                raise UserError(
                    f"{name}: {len(motion)} frames are too few (encoding requires at least 3). Exclude the motion"
                )
            check_finite(motion, name)
        lengths = [len(motion) for motion in motions]
        clip = torch.arange(len(motions)).repeat_interleave(torch.tensor(lengths))
        first = torch.tensor([0, *lengths[:-1]]).cumsum(0)
        joints = torch.cat(list(motions)).double() * self.units_per_metre
        if self.bone_lengths is not None:
            joints = self._retarget(joints, first, clip)
        start = joints[first]
        floor = torch.stack([part[..., 1].min() for part in joints.split(lengths)])
        shift = torch.stack([start[:, 0, 0], floor, start[:, 0, 2]], -1)
        facing = self._facing(start)
        return rotation.rotate_y(
            joints - shift[clip, None], -torch.atan2(*facing.unbind(-1))[clip, None]
        ), lengths

    def _retarget(self, joints: Tensor, first: Tensor, clip: Tensor) -> Tensor:
        """Changes the bone lengths and scales the root trajectory.

        The scale is the ratio of the new leg length to the old leg length in the first frame.
        """
        target = torch.tensor(self.bone_lengths, dtype=joints.dtype)
        bones = self.skeleton.bones(joints)
        leg = list(self.skeleton.leg)
        scale = target[leg].sum() / bones[first][:, leg].norm(dim=-1).sum(-1)
        return self.skeleton.assemble(
            F.normalize(bones, dim=-1) * target[:, None], joints[:, 0] * scale[clip, None]
        )

    def _facing(self, joints: Tensor, hips: float = 1.0) -> Tensor:
        """Returns the x and z components (N, 2) of the direction that the hips and shoulders face.

        The direction is the cross product of the vertical and the direction to the right. If the
        body lies on its side, the returned vector is shorter than 1. `hips` is the weight of the
        hips.
        """
        right_hip, left_hip, right_shoulder, left_shoulder = joints[
            :, list(self.skeleton.facing)
        ].unbind(1)
        right = F.normalize(
            hips * (right_hip - left_hip) + (right_shoulder - left_shoulder), dim=-1
        )
        return torch.stack([right[:, 2], -right[:, 0]], -1)

    def _heading(self, joints: Tensor) -> Tensor:
        """Returns the smoothed heading (T,) of one canonical motion (T, J, 3)."""
        if self.legacy:
            forward = self._facing(joints, hips=-1.0).numpy()
            x, z = gaussian_filter1d(forward, LEGACY_SMOOTHING_FRAMES, axis=0, mode="nearest").T
            heading = np.arctan2(x, z)
            heading[0] = 0
            return torch.from_numpy(heading)
        heading = np.unwrap(np.arctan2(*self._facing(joints).numpy().T))
        sigma = SMOOTHING_SECONDS * self.fps
        margin = int(4 * sigma + 0.5)
        padded = np.pad(heading, margin, mode="reflect", reflect_type="odd")
        smooth = gaussian_filter1d(padded, sigma)[margin:-margin]
        return torch.from_numpy(smooth - smooth[0])

    def _rotations(self, joints: Tensor, heading: Tensor) -> Tensor:
        """Returns the shortest arcs from the rest directions to the directions of the bones.

        The arcs (N, J - 1, 6) are in the 6D representation (columns). Each arc is relative to the
        parent's arc.
        """
        rest = joints.new_tensor(self.skeleton.raw_offsets)
        arcs = rotation.between(rest, self.skeleton.bones(joints))
        if self.legacy:
            arcs[:, 0, 0], arcs[:, 0, 2] = torch.cos(heading / 2), -torch.sin(heading / 2)
        parents = list((self.skeleton.chain_parents if self.legacy else self.skeleton.parents)[1:])
        relative = rotation.multiply(rotation.inverse(arcs[:, parents]), arcs[:, 1:])
        return rotation.matrix_to_rot6d(rotation.quaternion_to_matrix(relative), "columns")

    def _root(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the heading (..., F) and the position (..., F, 3) of the root.

        The position is in the features' unit.
        """
        turn = F.pad(features[..., :-1, 0].cumsum(-1), (1, 0))
        heading = self.turn_unit * turn
        x, z = features[..., :-1, self.slices["root_velocity"]].unbind(-1)
        step = torch.stack([x, torch.zeros_like(x), z], -1)
        step = rotation.rotate_y(step, heading[..., 1:] if self.legacy else heading[..., :-1])
        ground = F.pad(step.cumsum(-2), (0, 0, 1, 0))
        return heading, torch.stack([ground[..., 0], features[..., 3], ground[..., 2]], -1)
