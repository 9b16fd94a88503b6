"""World rotations of a body.

The Blender extension also contains this file. Therefore, the file requires only numpy.
"""

import numpy as np

from flame_mdm.representations.skeleton import JOINT, SMPL22

# Cosine of the maximum tilt of the chest at which the head is assumed to be level on average
UPRIGHT = np.cos(np.radians(30))
STANDING = 0.02  # maximum height in meters of a flat foot above its lowest position
TOES = (0.02, 0.09, np.radians(60))
"""Limits of the toe bend.

Toes stay flat while the toe joint is below the first height, and follow the foot above the second
height (both in meters). The third number is the maximum bend in radians.
"""


def complete(
    joints: np.ndarray, offsets: np.ndarray, world: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Completes rotations that were computed from joint positions.

    Joint positions determine neither the pitch of the head nor the bend of the toes.

    Args:
        joints: (F, 22, 3), joint positions in meters.
        offsets: (22, 3), positions of the joints relative to their parents in the rest pose.
        world: (F, 22, 3, 3), world rotations of the joints.

    Returns:
        The rotations of the body parts in the rest pose (22, 3, 3), their world rotations in each
        frame (F, 22, 3, 3), and the joint offsets (22, 3) of the body with flat feet.
    """
    # A person standing upright is assumed to look straight ahead. Therefore, the median direction
    # from neck to head, relative to an upright chest, is the direction of a level head. The toes
    # stay flat on the floor while the heel rises.
    neutral, offsets = np.tile(np.eye(3), (len(SMPL22), 1, 1)), offsets.copy()
    for side in ("left", "right"):
        ankle, toe = JOINT[f"{side}_ankle"], JOINT[f"{side}_foot"]
        flat = _flat_foot(joints[:, ankle], joints[:, toe], offsets[toe])
        neutral[ankle] = neutral[toe] = shortest_turns(flat, offsets[toe])
        offsets[toe] = flat
    neck, head = JOINT["neck"], JOINT["head"]
    x, y, z = (joints[:, head] - joints[:, neck]).T
    chest = world[:, JOINT["spine3"]]
    upright = chest[:, 1, 1] > UPRIGHT if chest[:, 1, 1].max() > UPRIGHT else slice(None)
    sine, cosine = chest[:, [0, 2], 2].T / np.linalg.norm(chest[:, [0, 2], 2], axis=1)
    usual = np.median(np.stack([x * cosine - z * sine, y, x * sine + z * cosine], 1)[upright], 0)
    neutral[head] = shortest_turns(offsets[head], usual).T
    world = world @ neutral
    for toe in (JOINT["left_foot"], JOINT["right_foot"]):
        world[:, toe] = world[:, toe] @ _toes(world[:, toe], joints[:, toe, 1])
    return neutral, world, offsets


def world_rotations(rotations: np.ndarray) -> np.ndarray:
    """Converts rotations relative to the parents (..., 22, 3, 3) to world rotations."""
    world = rotations.copy()
    for parent, joint in SMPL22.edges:
        world[..., joint, :, :] = world[..., parent, :, :] @ rotations[..., joint, :, :]
    return world


def orthonormal(direction: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Returns three orthonormal axes as the rows of a matrix (3, 3).

    The rows are the normalized direction, the normalized part of `u` that is orthogonal to this
    direction, and the cross product of the two.
    """
    along = direction / np.linalg.norm(direction)
    across = u - (u @ along) * along
    across /= np.linalg.norm(across)
    return np.stack([along, across, np.cross(along, across)])


def shortest_turns(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the smallest rotations (..., 3, 3) that turn `start` (..., 3) onto `end` (..., 3)."""
    a, b = (vector / np.linalg.norm(vector, axis=-1, keepdims=True) for vector in (start, end))
    axis = np.cross(a, b)
    sine = np.linalg.norm(axis, axis=-1)
    return rotations_about(
        axis / np.maximum(sine, 1e-9)[..., None], np.arctan2(sine, (a * b).sum(-1))
    )


def rotations_about(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Returns rotations (..., 3, 3) about unit vectors (..., 3) by angles (...)."""
    # Rodrigues' formula, with the matrix of the cross product
    x, y, z = np.moveaxis(axis, -1, 0)
    cross = np.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x], -1).reshape(*axis.shape, 3)
    sine, cosine = np.sin(angle)[..., None, None], np.cos(angle)[..., None, None]
    return np.eye(3) + sine * cross + (1 - cosine) * (cross @ cross)


def _flat_foot(ankle: np.ndarray, toe: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Returns the rest position of the toes of a flat foot, relative to the ankle."""
    # The foot is flat in the frames in which ankle and toes are lowest together
    height = ankle[:, 1] + toe[:, 1]
    flat = height <= height.min() + STANDING
    length = np.linalg.norm(offset)
    drop = np.clip(np.median((ankle - toe)[flat, 1]), 0.1 * length, 0.8 * length)
    ahead = offset * [1, 0, 1] / np.linalg.norm(offset[[0, 2]])
    return np.sqrt(length**2 - drop**2) * ahead - [0, drop, 0]


def _toes(foot: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Returns the rotations of the toes relative to a foot, with shape (F, 3, 3).

    `foot` (F, 3, 3) contains the world rotations of the foot.
    """
    low, high, most = TOES
    down = np.clip(np.arcsin(np.clip(-foot[:, 1, 2], -1, 1)), 0, most)
    near = np.clip((high - height) / (high - low), 0, 1)
    return rotations_about(np.tile([1.0, 0, 0], (len(foot), 1)), -down * near)
