"""Figures and bodies for players and images; a body is a mesh that is skinned to a motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.representations.skeleton import JOINT, SMPL22, Skeleton
from flame_mdm.safe_io import naming, read_npz

TWISTED = {"hip": 0.4, "shoulder": 0.4, "elbow": 0.55}
"""Share of a limb's twist that its helper bone takes, by the first joint of the limb.

The twist is measured at the hip or shoulder or, for the forearm, at the wrist.
"""
HELPERS = tuple(
    (JOINT[f"{side}_{name}"], share)
    for side in ("left", "right")
    for name, share in TWISTED.items()
)
"""Joint of each helper bone, and its share of the twist. These bones follow the 22 joints."""
# Joint at which each bone begins
ANCHORS = (
    *range(len(SMPL22)),
    *(joint for joint, _ in HELPERS),
)
MANNEQUIN = Path(__file__).with_name("mannequin.npz")
SKIN, HAIR, SHIRT, TROUSERS, SHOES = MATERIALS = (
    (222, 186, 160),
    (96, 80, 70),
    (132, 164, 196),
    (98, 106, 124),
    (64, 62, 66),
)


@dataclass(eq=False, repr=False)
class Figure:
    """A moving skeleton to show in players and images, such as a `flame_mdm.formats.motion.Motion`.

    Attributes:
        joints: (F, J, 3), joint positions in meters, with y up and the floor at y = 0.
        fps: frames per second.
        skeleton: names and parents of the J joints; the prefixes `left_` and `right_` mark the
            sides.
        text: the caption or the name of the action, or "" if there is neither.
        id: the name of the clip or file. For a generated motion, the text and the sample number,
            which together determine the noise.
        contacts: (F, N) bool, whether each joint in `skeleton.feet` is on the floor, or None if
            this is unknown.
    """

    joints: np.ndarray
    fps: float
    skeleton: Skeleton = SMPL22
    text: str = ""
    id: str = ""
    contacts: np.ndarray | None = field(default=None, kw_only=True)

    def try_fit(self, body: Mesh | None = None) -> tuple[FittedBody | None, str]:
        """Returns the fitted body and "", or None and the reason why no body fits.

        `body` is the mesh to fit, or None for the mannequin. Fitting requires the joint rotations.
        If no body fits, a skeleton is drawn instead.
        """
        return None, "its joint rotations are unknown"


def target(path: str | Path, motions: Sequence[Figure]) -> Path:
    """Converts the path to a `Path`, and raises `UserError` if there are no motions to write."""
    if not motions:
        raise UserError(f"{path}: no motions to show")
    return Path(path)


def sides(skeleton: Skeleton) -> list[int]:
    """Returns the side of each joint: 1 = left, -1 = right, 0 = middle."""
    return [name.startswith("left_") - name.startswith("right_") for name in skeleton.joints]


def head(skeleton: Skeleton) -> int | None:
    """Returns the index of the head joint, or None if the skeleton has no head."""
    return skeleton.joints.index("head") if "head" in skeleton.joints else None


def radii(skeleton: Skeleton) -> list[float]:
    """Returns the radius of the body around each joint, in meters.

    The radius increases with the number of the joint's descendants.
    """
    below = [0] * len(skeleton.parents)
    for joint in reversed(range(1, len(below))):
        below[skeleton.parents[joint]] += below[joint] + 1
    return [round(0.024 + 0.011 * count**0.5, 4) for count in below]


class Mesh:
    """A closed mesh in its stored pose, which is an A-pose with the pelvis at the origin.

    `tools/mannequin.py` writes the mannequin's mesh.

    Attributes:
        points: (V, 3), vertices in meters.
        normals: (V, 3), unit normals of the vertices.
        colors: (V, 3), vertex colors from 0 to 255.
        weights: (V, 28), skinning weights for SMPL's 22 joints and the `HELPERS`. At most four
            weights per vertex are nonzero.
        triangles: (T, 3), counterclockwise as seen from outside.
        turns: (28, 3, 3), world rotation of each bone, from SMPL's rest pose to the stored pose.
        rest: (22, 3), position of each joint relative to its parent in SMPL's rest pose.
        sole: height of the toe joints above the soles, in meters.
    """

    def __init__(self, path: Path) -> None:
        self.stored = read_npz(path)
        self.points = self.stored["points"] / 20000
        self.colors = self.stored["colors"].astype(float)
        self.normals = self.stored["normals"] / np.linalg.norm(
            self.stored["normals"], axis=1, keepdims=True
        )
        self.triangles, self.joints = self.stored["triangles"].astype(int), self.stored["joints"]
        self.weights = np.zeros((len(self.points), len(ANCHORS)))
        for bone, weight in zip(
            self.stored["bones"].T, self.stored["weights"].T / 255, strict=True
        ):
            self.weights[np.arange(len(self.points)), bone] += weight
        self.turns = self.stored["turns"][list(ANCHORS)]
        above = [max(parent, 0) for parent in SMPL22.parents]
        self.rest = (self.turns[above].mT @ (self.joints - self.joints[above])[..., None])[..., 0]
        self.sole = float(self.joints[JOINT["left_foot"], 1] - self.points[:, 1].min())


def largest_weights(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the four bones (V, 4) with the largest weights, and their integer weights (V, 4).

    `weights` has the shape (V, B). The integer weights of each vertex add up to 255.
    """
    bones = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    most = np.take_along_axis(weights, bones, 1)
    most = np.floor(255 * most / most.sum(1, keepdims=True) + 0.5).astype(int)
    most[:, 0] += 255 - most.sum(1)
    return np.where(most > 0, bones, 0).astype("u1"), most.astype("u1")


@cache
def mannequin() -> Mesh:
    """Returns the mannequin, which is the body that comes with the package."""
    return Mesh(MANNEQUIN)


def read_body(name: str) -> Mesh:
    """Returns the mannequin, or the body in a file. Raises `UserError` if the file is damaged."""
    with naming(name, KeyError, ValueError, IndexError, prefix="not a body: "):
        return mannequin() if name == "mannequin" else Mesh(Path(name))


@dataclass(frozen=True, eq=False)
class FittedBody:
    """A moving body with B = 28 bones and F frames, fitted to the bone lengths of a clip."""

    mesh: Mesh
    # (22, 3, 3), linear map from each joint's part of the stored mesh to the proportions of the
    # clip
    fit: np.ndarray
    # (22, 3), joint positions of the stored pose with the bone lengths of the clip and the pelvis
    # at the origin
    joints: np.ndarray
    # (V, 3), points of the mesh in this pose
    points: np.ndarray
    # (22, 3, 3), rotation of each part of the mesh at rest, with flat soles and an upright head
    neutral: np.ndarray
    # (F, B, 3, 3), rotation of each bone from the stored pose to each frame
    turns: np.ndarray
    # (F, B, 3), starting point of each bone: the joint positions of the motion, raised by `lift`
    starts: np.ndarray
    # Height in meters of the body's joints above the motion's joints: the thickness of the sole
    lift: float

    def skinned(self, frame: int) -> tuple[np.ndarray, np.ndarray]:
        """Returns a frame's vertices and normals (V, 3), computed by linear blend skinning."""
        turns = self.turns[frame]
        moves = self.starts[frame] - (turns @ self.joints[list(ANCHORS), :, None])[..., 0]
        blended = self.mesh.weights @ np.concatenate([turns.reshape(-1, 9), moves], 1)
        turned = blended[:, :9].reshape(-1, 3, 3)
        points = (turned @ self.points[..., None])[..., 0] + blended[:, 9:]
        normals = (turned @ self.mesh.normals[..., None])[..., 0]
        return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
