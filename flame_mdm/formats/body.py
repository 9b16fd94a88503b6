"""Moving bodies: joint rotations, and meshes fitted to bone lengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.formats.poses import Poses, solve
from flame_mdm.formats.posture import complete, world_rotations
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.visualize.body import ANCHORS, HELPERS, Figure, FittedBody, Mesh, mannequin

TRUNK = {"pelvis": 0.0, "spine1": 0.35, "spine2": 0.75, "spine3": 1.0}
"""Weight of the shoulder width in the width of the trunk at a joint, from 0 to 1.

The hip width has the remaining weight.
"""
# Limits on the scale of hips and shoulders, relative to the scale of the limbs. Joints at unusual
# positions must not make the trunk too thin or too wide.
WIDER = (0.8, 1.25)
# Limits on a limb's length, relative to the limb's length in the mesh
LONGER = (0.4, 2.5)
# Limits on the length scale of all other parts, relative to the scale of the limbs
TALLER = (0.6, 1.6)
ORTHONORMAL = 0.1  # maximum error in the dot products of a rotation matrix's rows
LIMBS = tuple(
    JOINT[f"{side}_{name}"]
    for side in ("left", "right")
    for name in ("knee", "ankle", "elbow", "wrist")
)


@dataclass(eq=False, repr=False)
class PosedFigure(Figure):
    """Moving joints with rotations that can drive bodies and characters.

    Attributes:
        poses: rotations of SMPL's joints, if known.
    """

    poses: Poses | None = None

    def posed(self) -> Poses:
        """Returns the rotations of SMPL's joints.

        If the rotations are unknown, they are computed from the joint positions.
        """
        if self.poses is not None:
            return self.poses
        joints = torch.from_numpy(self.joints)
        if self.skeleton.name == "smpl24":
            joints = joints[:, : len(SMPL22)]  # the last two joints are the hands
        return solve(joints, self.fps)

    def try_fit(self, body: Mesh | None = None) -> tuple[FittedBody | None, str]:
        """Returns the fitted body and "", or None and the reason why no body fits.

        If no body fits, the motion is drawn as a skeleton. See `fit_body`.
        """
        try:
            return fit_body(self, body), ""
        except UserError as error:
            return None, str(error)


def fit_body(motion: PosedFigure, body: Mesh | None = None) -> FittedBody:
    """Fits a body to a clip and computes the rotations of its bones.

    The body's joints coincide with the motion's joints, raised by the thickness of the sole.

    Args:
        motion: the clip. If the clip contains no rotations, they are computed from the joint
            positions.
        body: the mesh, or None for the mannequin.

    Raises:
        UserError: If the skeleton is not SMPL's, if a limb is much longer or shorter than a
            person's, or if a matrix is not a rotation.
    """
    poses, body = motion.posed(), body or mannequin()
    joints = motion.joints[:, : len(SMPL22)].astype(float)
    world = world_rotations(poses.rotations.numpy())
    offsets = poses.offsets.numpy().copy()
    fit, wide = proportions(body, offsets)
    neutral = np.tile(np.eye(3), (len(SMPL22), 1, 1))
    if motion.poses is None:
        neutral, world, offsets = complete(joints, offsets, world)
    _check_rotations(world)
    # Feet are stretched so that the sole is as far below the ankle as the floor is in the clip.
    lift = wide * body.sole
    for toe in (JOINT["left_foot"], JOINT["right_foot"]):
        _, high, long = body.rest[toe]
        tall = (lift - offsets[toe, 1]) / (body.sole - high)
        fit[SMPL22.parents[toe]] = np.diag([wide, tall, offsets[toe, 2] / long])
    # Each part of the mesh is stretched along its own axes to the clip's bone lengths. Vertices
    # between two parts use the weighted mean of both maps, as in linear blend skinning.
    turns, rest = body.turns, np.zeros((len(SMPL22), 3))
    for parent, joint in SMPL22.edges:
        rest[joint] = rest[parent] + turns[parent] @ offsets[joint]
    stretched = turns[: len(rest)] @ fit @ turns[: len(rest)].mT
    anchors = list(ANCHORS)
    moves = rest - (stretched @ body.joints[..., None])[..., 0]
    blended = body.weights @ np.concatenate([stretched.reshape(-1, 9), moves], 1)[anchors]
    points = (blended[:, :9].reshape(-1, 3, 3) @ body.points[..., None])[..., 0] + blended[:, 9:]
    bones, starts = _with_helpers(world, offsets) @ turns.mT, joints[:, anchors] + [0, lift, 0]
    return FittedBody(body, stretched, rest, points, neutral, bones, starts, lift)


def local_rotations(body: FittedBody) -> np.ndarray:
    """Returns the rotations of a body's joints relative to their parents, with shape (F, 22, 3, 3).

    The bend of the toes is included.
    """
    count = len(SMPL22)
    world = body.turns[:, :count] @ body.mesh.turns[:count] @ body.neutral.mT
    local = world.copy()
    for parent, joint in SMPL22.edges:
        local[:, joint] = world[:, parent].mT @ world[:, joint]
    return local


def proportions(body: Mesh, offsets: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns linear maps (22, 3, 3) for the body parts, and the scale of the body's width.

    In its rest pose, the mapped body has the same `offsets` (22, 3) as the clip.
    """
    # The limbs determine the size of the body. Hips and shoulders follow the clip's own widths.
    # The trunk blends both widths from bottom to top. Limbs are stretched only along their bones.
    lengths, usual = np.linalg.norm(offsets, axis=1), np.linalg.norm(body.rest, axis=1)
    ratio = np.divide(lengths, usual, out=np.ones_like(lengths), where=usual > 0)
    for joint in LIMBS:
        if not LONGER[0] <= ratio[joint] <= LONGER[1]:
            raise UserError(
                f"the bone that ends at {SMPL22.joints[joint]} is {lengths[joint]:.3g} m long, but in the body model, "
                f"this bone is {usual[joint]:.3g} m long. Is the unit right? Motions like this are drawn without a body"
            )
    wide = float(lengths[list(LIMBS)].sum() / usual[list(LIMBS)].sum())

    def width(*names: str) -> float:
        chosen = [JOINT[f"{side}_{name}"] for side in ("left", "right") for name in names]
        share = np.abs(offsets[chosen, 0]).sum() / np.abs(body.rest[chosen, 0]).sum()
        return float(np.clip(share, *np.multiply(WIDER, wide)))

    hips, shoulders = width("hip"), width("collar", "shoulder")
    fit = np.tile(wide * np.eye(3), (len(SMPL22), 1, 1))
    for joint, name in enumerate(SMPL22.joints):
        children = [child for child, parent in enumerate(SMPL22.parents) if parent == joint]
        if name in TRUNK:
            above = children[-1] if name == "pelvis" else children[0]
            tall = np.clip(ratio[above], *np.multiply(TALLER, wide))
            fit[joint] = np.diag([hips + TRUNK[name] * (shoulders - hips), tall, wide])
        elif children and not name.endswith("ankle"):
            along = body.rest[children[0]] / usual[children[0]]
            long = np.clip(ratio[children[0]], *np.multiply(TALLER, wide))
            fit[joint] += (long - wide) * np.outer(along, along)
    return fit, wide


def _check_rotations(world: np.ndarray) -> None:
    """Raises `UserError` if a matrix in `world` (F, 22, 3, 3) is not close to a rotation."""
    products = world @ world.mT
    near = (np.abs(products - np.eye(3)) < ORTHONORMAL).all((2, 3))
    mirrored = (np.cross(world[..., 0, :], world[..., 1, :]) * world[..., 2, :]).sum(-1) < 0
    unsound = np.argwhere(~near | mirrored)
    if len(unsound):
        frame, joint = unsound[0]
        raise UserError(
            f"the matrix of {SMPL22.joints[joint]} in frame {frame} is not a rotation, so a body cannot be drawn"
        )


def _with_helpers(world: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Appends the rotations of the helper bones to the joint rotations (F, 22, 3, 3)."""
    # Skin that follows a twisting bone collapses at the joint. A helper bone takes part of the
    # twist about the limb, so that the twist is distributed along the limb, as under real skin.
    helpers = []
    for joint, share in HELPERS:
        child = SMPL22.parents.index(joint)
        axis = offsets[child] / np.linalg.norm(offsets[child])
        of_wrist = SMPL22.joints[joint].endswith("elbow")
        above, below = (joint, child) if of_wrist else (SMPL22.parents[joint], joint)
        turn = Rotation.from_matrix(world[:, above].mT @ world[:, below]).as_quat()
        twist = 2 * np.arctan2(turn[:, :3] @ axis, turn[:, 3])
        twist = (twist + np.pi) % (2 * np.pi) - np.pi
        back = Rotation.from_rotvec(
            np.outer((share if of_wrist else share - 1) * twist, axis)
        ).as_matrix()
        helpers.append(world[:, joint] @ back)
    return np.concatenate([world, np.stack(helpers, 1)], 1)
