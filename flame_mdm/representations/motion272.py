"""MotionStreamer's features: root trajectory, joint positions, velocities and SMPL rotations."""

from collections.abc import Iterable, Sequence
from copy import deepcopy

import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.representations import Features, Representation, rotation
from flame_mdm.representations.skeleton import SMPL22, forward_kinematics
from flame_mdm.representations.smpl import ADULT, read_pose


class Motion272(Representation):
    """The 272 features of Xiao et al. 2025 (MotionStreamer), with one row per frame.

    Columns by name, in `slices`:

    | name | width | content |
    |---|---|---|
    | root_velocity | 2 | x and z of the root's displacement from the previous frame, in that frame's body coordinates |
    | turn | 6 | rotation about y from the previous frame's body coordinates to this frame's, 6D rows |
    | positions | 66 | joint positions in body coordinates: root at x = z = 0, lowest joint of the motion at y = 0 |
    | velocities | 66 | differences of `positions` from the previous frame, without the root's displacement and turn |
    | rotations | 132 | SMPL's rotations as 6D rows; the root's rotation is in body coordinates |

    In the first row, `turn` is the identity and all velocities are 0. The heading is computed from
    the root's rotation, so it jumps when a body lies down. Motions begin at x = z = 0, facing +z.
    In raw motions (see `smpl.read_pose`), z is up. Bone lengths are determined by `offsets`,
    whereas the authors keep each subject's bone lengths.

    Args:
        fps: frames per second.
        offsets: (24, 3), offsets of the joints from their parents in the rest pose, in meters. The
            first offset is the position of the pelvis relative to the translation. Default:
            `ADULT`.

    Example:
        >>> representation = Motion272()
        >>> features = representation.encode(torch.zeros(10, 75))  # SMPL's rest pose
        >>> features.shape, representation.decode(features).shape
        (torch.Size([10, 272]), torch.Size([10, 22, 3]))
    """

    def __init__(self, fps: float = 30.0, offsets: Sequence[Sequence[float]] = ADULT):
        super().__init__("motion272", 272, fps, SMPL22)
        self.slices = {"root_velocity": slice(0, 2), "turn": slice(2, 8), "positions": slice(8, 74)}
        self.slices |= {"velocities": slice(74, 140), "rotations": slice(140, 272)}
        self.offsets = offsets

    def encode(self, motion: Tensor) -> Tensor:
        """Encodes a raw motion (F >= 2, 3 + 3 K) as float32 features (F, 272); see `read_pose`."""
        translation, rotations = read_pose(motion)
        if len(motion) < 2:
            raise UserError(
                "the motion has only 1 frame, but encoding requires at least 2. Exclude the motion"
            )
        # Z up -> y up
        axes = torch.tensor(
            [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64
        )
        rotations = torch.cat([(axes @ rotations[:, :1]), rotations[:, 1:22]], 1)
        translation, rotations = face_forward(translation @ axes.T, rotations)
        offsets = torch.tensor(self.offsets, dtype=torch.float64)[:22]
        joints = forward_kinematics(self.skeleton, rotations, offsets, translation + offsets[0])
        return self.features_of(joints, rotations)

    def features_of(self, joints: Tensor, rotations: Tensor) -> Tensor:
        """Returns float32 features (F, 272) from joint positions and rotations (F, 22, 3, 3).

        The joint positions have the shape (F, 22, 3). In both arguments, y is up, and the body
        faces +z in the first frame.
        """
        joints = joints.double() - torch.stack(
            [joints[0, 0, 0], joints[..., 1].min(), joints[0, 0, 2]]
        )
        inverse = _to_body(rotations)
        velocity = torch.zeros(len(joints), 3, dtype=torch.float64)
        velocity[1:] = (inverse[:-1] @ joints[:, 0].diff(dim=0)[..., None])[..., 0]
        turn = torch.eye(3, dtype=torch.float64).repeat(len(joints), 1, 1)
        turn[1:] = inverse[1:] @ inverse[:-1].mT
        local = joints - joints[:, :1] * joints.new_tensor([1.0, 0.0, 1.0])
        local = local @ inverse.mT
        moved = torch.zeros_like(local)
        moved[1:] = local.diff(dim=0)
        turned = torch.cat([(inverse @ rotations[:, 0])[:, None], rotations[:, 1:]], 1)
        rows = [
            velocity[:, [0, 2]],
            rotation.matrix_to_rot6d(turn, "rows"),
            local.flatten(1),
            moved.flatten(1),
        ]
        return torch.cat([*rows, rotation.matrix_to_rot6d(turned, "rows").flatten(1)], 1).float()

    def rotations6d(self, features: Tensor) -> Tensor:
        """Returns 6D rotations (..., F, 23, 6): the root's turn, then the joint rotations."""
        turn = features[..., None, self.slices["turn"]]
        return torch.cat([turn, features[..., self.slices["rotations"]].unflatten(-1, (22, 6))], -2)

    def decode(self, features: Tensor) -> Tensor:
        """Decodes the velocity, turn and position columns of features (..., F, 272).

        Returns the joint positions (..., F, 22, 3) in meters. The decoding is differentiable.
        """
        inverse, ground = self._root(features)
        local = features[..., self.slices["positions"]].unflatten(-1, (22, 3))
        return local @ inverse + ground[..., None, :]

    def poses(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Decodes features (..., F, 272) to SMPL poses, with y up.

        The poses consist of the pelvis position (..., F, 3) and SMPL's rotations (..., F, 22, 3,
        3).
        """
        inverse, ground = self._root(features)
        turned = rotation.rot6d_to_matrix(self.rotations6d(features)[..., 1:, :], "rows")
        height = features[..., self.slices["positions"]][..., 1:2] * features.new_tensor(
            [0.0, 1.0, 0.0]
        )
        root = inverse.mT[..., None, :, :] @ turned[..., :1, :, :]
        return ground + height, torch.cat([root, turned[..., 1:, :, :]], -3)

    def _root(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Returns the rotations from world to body coordinates, and the ground positions.

        The shapes are (..., F, 3, 3) and (..., F, 3). The ground position is the position of the
        root with y = 0.
        """
        inverse = rotation.rot6d_to_matrix(self.rotations6d(features)[..., 0, :], "rows")
        step = 1
        # Computes the cumulative products of the turns in log2(F) steps.
        while step < features.shape[-2]:
            inverse = torch.cat(
                [inverse[..., :step, :, :], inverse[..., step:, :, :] @ inverse[..., :-step, :, :]],
                -3,
            )
            step *= 2
        x, z = features[..., self.slices["root_velocity"]].unbind(-1)
        velocity = torch.stack([x, torch.zeros_like(x), z], -1)
        world = (velocity[..., 1:, None, :] @ inverse[..., :-1, :, :])[..., 0, :]
        # generated turns are not always about the y axis
        level = world * world.new_tensor([1.0, 0.0, 1.0])
        return inverse, torch.cat([velocity[..., :1, :], level], -2).cumsum(-2)

    def rebase(self, features: Features) -> Features:
        """Resets the velocities and the turn in the first frame of cut clips (..., F, D).

        The velocities are set to zero and the turn is set to the identity, as in the first frame of
        every motion.
        """
        cut = deepcopy(features)
        for name in ("root_velocity", "turn", "velocities"):
            cut[..., 0, self.slices[name]] = 0.0
        cut[..., 0, [2, 6]] = 1.0
        return cut

    def joint_features(self, joints: Iterable[int]) -> Tensor:
        """Returns a bool mask (272,) that is True for the features of the given joints.

        The root trajectory belongs to joint 0.
        """
        part = self.joint_mask(joints)
        return torch.cat([part[:1].expand(8), *(part.repeat_interleave(n) for n in (3, 3, 6))])


def face_forward(translation: Tensor, rotations: Tensor) -> tuple[Tensor, Tensor]:
    """Turns a motion about y so that the root faces +z in the first frame.

    The motion consists of the translation (F, 3) and rotations (F, J, 3, 3).
    """
    turn = _to_body(rotations[:1])
    return translation @ turn[0].T, torch.cat(
        [(turn @ rotations[:, 0])[:, None], rotations[:, 1:]], 1
    )


def _to_body(rotations: Tensor) -> Tensor:
    """Returns rotations (F, 3, 3) about y that turn the root's z axis to +z.

    The root is joint 0 of the rotations (F, J, 3, 3).
    """
    heading = torch.atan2(rotations[:, 0, 0, 2], rotations[:, 0, 2, 2])
    return rotation.axis_angle_to_matrix(-heading[:, None] * heading.new_tensor([0.0, 1.0, 0.0]))
