"""Motions to draw, and bodies: their mesh, fitted to the bone lengths of a clip and skinned to a motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.errors import UserError
from flame_mdm.representations.skeleton import SMPL22, Skeleton
from flame_mdm.safe_io import naming, read_npz
from flame_mdm.visualize.posture import JOINT, complete, world_rotations

if TYPE_CHECKING:  # drawing needs numpy and Pillow, not torch
    from torch import Tensor

TWISTED = {"hip": 0.4, "shoulder": 0.4, "elbow": 0.55}
"""Joints whose limb has a helper bone, and its share of the twist about the limb: the joint's own, or the wrist's."""
HELPERS = tuple((JOINT[f"{side}_{name}"], share) for side in ("left", "right") for name, share in TWISTED.items())
"""Joint and share of the twist of each bone after the 22 joints."""
ANCHORS = (*range(len(SMPL22)), *(joint for joint, _ in HELPERS))  # the joint at which each bone begins
MANNEQUIN = Path(__file__).with_name("mannequin.npz")
TRUNK = {"pelvis": 0.0, "spine1": 0.35, "spine2": 0.75, "spine3": 1.0}
"""Joints of the trunk -> how much their width follows the shoulders rather than the hips."""
WIDER = (0.8, 1.25)  # limits of the width of hips and shoulders relative to that of the limbs
LONGER = (0.4, 2.5)  # limits of the length of a limb relative to the mesh's
TALLER = (0.6, 1.6)  # limits of the length of other parts relative to that of the limbs
LIMBS = tuple(JOINT[f"{side}_{name}"] for side in ("left", "right") for name in ("knee", "ankle", "elbow", "wrist"))
SKIN, HAIR, SHIRT, TROUSERS, SHOES = MATERIALS = (
    *((222, 186, 160), (96, 80, 70), (132, 164, 196)),
    *((98, 106, 124), (64, 62, 66)),
)


class Posed(Protocol):
    """A body in motion: `flame_mdm.formats.poses.Poses`."""

    offsets: Tensor
    rotations: Tensor


class Shown(Protocol):
    """A motion to draw: `flame_mdm.formats.motion.Motion`."""

    joints: np.ndarray
    fps: float
    skeleton: Skeleton
    text: str
    id: str
    contacts: np.ndarray | None

    @property
    def poses(self) -> Posed | None: ...
    def posed(self) -> Posed: ...


def target(path: str | Path, motions: Sequence[Shown]) -> Path:
    """Returns the path of a file; raises `UserError` if there are no motions to write to it."""
    if not motions:
        raise UserError(f"{path}: no motions to show")
    return Path(path)


def sides(skeleton: Skeleton) -> list[int]:
    """Returns for each joint 1 = left, -1 = right, 0 = middle."""
    return [name.startswith("left_") - name.startswith("right_") for name in skeleton.joints]


def head(skeleton: Skeleton) -> int | None:
    return skeleton.joints.index("head") if "head" in skeleton.joints else None


def radii(skeleton: Skeleton) -> list[float]:
    """Returns the radius of the body around each joint in meters, which grows with the number of its descendants."""
    below = [0] * len(skeleton.parents)
    for joint in reversed(range(1, len(below))):
        below[skeleton.parents[joint]] += below[joint] + 1
    return [round(0.024 + 0.011 * count**0.5, 4) for count in below]


class Mesh:
    """A closed mesh in its stored pose, an A-pose with the pelvis at 0; tools/mannequin.py and tools/human.py write it.

    Attributes:
        points: (V, 3) in meters; `normals` (V, 3), `colors` (V, 3) from 0 to 255.
        weights: (V, 28), of the 22 joints of SMPL and `HELPERS`; at most four are not 0.
        triangles: (T, 3), counterclockwise seen from outside.
        turns: (28, 3, 3), rotation of each bone in the world from the rest pose of SMPL to the stored pose.
        rest: (22, 3), position of each joint relative to its parent in the rest pose of SMPL.
        sole: height of the toe joints above the soles.
    """

    def __init__(self, path: Path) -> None:
        self.stored = read_npz(path)
        self.points, self.colors = self.stored["points"] / 20000, self.stored["colors"].astype(float)
        self.normals = self.stored["normals"] / np.linalg.norm(self.stored["normals"], axis=1, keepdims=True)
        self.triangles, self.joints = self.stored["triangles"].astype(int), self.stored["joints"]
        self.weights = np.zeros((len(self.points), len(ANCHORS)))
        for bone, weight in zip(self.stored["bones"].T, self.stored["weights"].T / 255, strict=True):
            self.weights[np.arange(len(self.points)), bone] += weight
        self.turns = self.stored["turns"][list(ANCHORS)]
        above = [max(parent, 0) for parent in SMPL22.parents]
        self.rest = (self.turns[above].mT @ (self.joints - self.joints[above])[..., None])[..., 0]
        self.sole = float(self.joints[JOINT["left_foot"], 1] - self.points[:, 1].min())


def largest_weights(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the four bones (V, 4) with the largest of weights (V, B), and integers (V, 4) that add up to 255."""
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    most = np.take_along_axis(weights, bones, 1)
    most = np.floor(255 * most / most.sum(1, keepdims=True) + 0.5).astype(int)
    most[:, 0] += 255 - most.sum(1)
    return np.where(most > 0, bones, 0).astype("u1"), most.astype("u1")


@cache
def mannequin() -> Mesh:
    return Mesh(MANNEQUIN)


def load_body(name: str) -> Mesh:
    """Returns the mannequin, or the body in a file; raises `UserError` if the file is damaged."""
    with naming(name, KeyError, ValueError, IndexError, what="not a body: "):
        return mannequin() if name == "mannequin" else Mesh(Path(name))


@dataclass(frozen=True, eq=False)
class FittedBody:
    """A body with the bone lengths of a clip, and its motion. F frames, B = 28 bones."""

    mesh: Mesh
    fit: np.ndarray  # (22, 3, 3), linear map of each joint's part of the stored mesh to the clip's proportions
    joints: np.ndarray  # (22, 3) of the stored pose with the clip's bone lengths, pelvis at 0
    points: np.ndarray  # (V, 3) of the mesh in this pose
    neutral: np.ndarray  # (22, 3, 3), rotation of each part of the mesh at rest: soles are flat, the head is upright
    turns: np.ndarray  # (F, B, 3, 3), rotation of each bone from the stored pose to each frame
    starts: np.ndarray  # (F, B, 3), where each bone begins: at the motion's joints, lifted
    lift: float  # height of a joint of the body above that of the motion: the thickness of the sole

    def skinned(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns vertices and normals (V, 3) of a frame, by linear blend skinning."""
        turns = self.turns[frame]
        moves = self.starts[frame] - (turns @ self.joints[list(ANCHORS), :, None])[..., 0]
        blended = self.mesh.weights @ np.concatenate([turns.reshape(-1, 9), moves], 1)
        turned = blended[:, :9].reshape(-1, 3, 3)
        points = (turned @ self.points[..., None])[..., 0] + blended[:, 9:]
        normals = (turned @ self.mesh.normals[..., None])[..., 0]
        return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)

    def local(self) -> np.ndarray:
        """Returns the rotations (F, 22, 3, 3) of the joints relative to their parents, with the bend of toes."""
        count = len(SMPL22)
        world = self.turns[:, :count] @ self.mesh.turns[:count] @ self.neutral.mT
        local = world.copy()
        for parent, joint in SMPL22.edges:
            local[:, joint] = world[:, parent].mT @ world[:, joint]
        return local


def fit_body(motion: Shown, body: Mesh | None = None) -> FittedBody:
    """Fits a body (None = the mannequin) to a clip and computes the rotations of its bones.

    The body's joints are the motion's, but higher by the thickness of the sole. Rotations that are solved for are
    completed. Raises `UserError` if the skeleton is not SMPL's, or a limb is much longer or shorter than people's.
    """
    poses, body = motion.posed(), body or mannequin()
    joints = motion.joints[:, : len(SMPL22)].astype(float)
    world = world_rotations(np.asarray(poses.rotations))
    offsets = np.array(poses.offsets)
    fit, wide = proportions(body, offsets)
    neutral = np.tile(np.eye(3), (len(SMPL22), 1, 1))
    if motion.poses is None:
        neutral, world, offsets = complete(joints, offsets, world)
    lift = wide * body.sole
    for toe in (JOINT["left_foot"], JOINT["right_foot"]):
        _, high, long = body.rest[toe]
        tall = (lift - offsets[toe, 1]) / (body.sole - high)
        fit[SMPL22.parents[toe]] = np.diag([wide, tall, offsets[toe, 2] / long])
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


def try_fit(motion: Shown, body: Mesh | None = None) -> tuple[FittedBody | None, str]:
    """Returns the body of `fit_body` and "", or None and the reason why this motion is drawn as a skeleton."""
    try:
        return fit_body(motion, body), ""
    except UserError as error:
        return None, str(error)


def proportions(body: Mesh, offsets: np.ndarray) -> tuple[np.ndarray, float]:
    """Returns the map (22, 3, 3) of each part of a body to a clip's `offsets` (22, 3) at rest, and that of widths."""
    lengths, usual = np.linalg.norm(offsets, axis=1), np.linalg.norm(body.rest, axis=1)
    ratio = np.divide(lengths, usual, out=np.ones_like(lengths), where=usual > 0)
    for joint in LIMBS:
        if not LONGER[0] <= ratio[joint] <= LONGER[1]:
            raise UserError(
                f"the bone that ends in {SMPL22.joints[joint]} is {lengths[joint]:.3g} m long, the body's is "
                f"{usual[joint]:.3g} m. Is the unit right? Such a motion is drawn without a body"
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


def _with_helpers(world: np.ndarray, offsets: np.ndarray) -> np.ndarray:
    """Appends the rotations of the helper bones to those of the joints (F, 22, 3, 3)."""
    helpers = []
    for joint, share in HELPERS:
        child = SMPL22.parents.index(joint)
        axis = offsets[child] / np.linalg.norm(offsets[child])
        of_wrist = SMPL22.joints[joint].endswith("elbow")
        above, below = (joint, child) if of_wrist else (SMPL22.parents[joint], joint)
        turn = Rotation.from_matrix(world[:, above].mT @ world[:, below]).as_quat()
        twist = 2 * np.arctan2(turn[:, :3] @ axis, turn[:, 3])
        twist = (twist + np.pi) % (2 * np.pi) - np.pi
        back = Rotation.from_rotvec(np.outer((share if of_wrist else share - 1) * twist, axis)).as_matrix()
        helpers.append(world[:, joint] @ back)
    return np.concatenate([world, np.stack(helpers, 1)], 1)
