"""Node hierarchies in motion, as FBX and GLB files contain them: the positions of all nodes in each frame.

Only positions are used. Rotations of the motion are solved for afterward, so that a rest pose
that is not a T-pose, and local axes that differ between programs, do not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from flame_mdm.errors import UserError, did_you_mean

LARGEST = 1e9  # largest coordinate, in the unit of the file, that is read

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class AnimatedNodes:
    """The nodes of a file in one of its animations.

    Attributes:
        names: names of the N nodes.
        parents: index of the parent of each node, smaller than the index of the node; -1 for a
            root.
        positions: (F, N, 3) in the world, in meters, y up.
        fps: frames per second.
        animation: the name of the animation.
        humanoid: joint of SMPL -> index of a node, if the file says which nodes are a human body;
            else empty.
        unit: meters per unit of length, as the file declares it.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    positions: np.ndarray
    fps: float
    animation: str
    humanoid: dict[str, int]
    unit: float = 1.0


def choose(animations: Sequence[tuple[str, Item]], requested: str | int | None) -> tuple[str, Item]:
    """Returns the name and the content of an animation.

    Args:
        animations: names and contents.
        requested: the name of an animation, or its number, counted from 1; None = the first one.

    Raises `UserError` if there is no such animation.
    """
    if not animations:
        raise UserError("contains no animation. Export the file with its animation")
    if requested is None:
        return animations[0]
    for name, item in animations:
        if name == str(requested):
            return name, item
    number = int(requested) if str(requested).isdecimal() and len(str(requested)) < 10 else 0
    if 1 <= number <= len(animations):
        return animations[number - 1]
    names = [name for name, _ in animations]
    listed = ", ".join(f"{number} {name}" for number, name in enumerate(names[:20], 1))
    more = f" and {len(names) - 20} more" if len(names) > 20 else ""
    similar = did_you_mean(str(requested), names)
    raise UserError(
        f"animation={requested}: no such animation.{similar} The file contains {listed}{more}"
    )


def parents_first(parents: Sequence[int]) -> list[int]:
    """Returns an order of nodes in which parents precede their children.

    Raises `ValueError` if a node is its own ancestor. `parents` holds the index of each node's
    parent, -1 for a root.
    """
    children: list[list[int]] = [[] for _ in parents]
    order = []
    for node, parent in enumerate(parents):
        if parent < 0:
            order.append(node)
        else:
            children[parent].append(node)
    for node in order:
        order += children[node]
    if len(order) != len(parents):
        raise ValueError("a node is its own ancestor")
    return order


def world_matrices(parents: Sequence[int], local: np.ndarray) -> np.ndarray:
    """Returns matrices (F, N, 4, 4) to the world from matrices to the parent; parents precede their children."""
    worlds = local.copy()
    for node, parent in enumerate(parents):
        if parent >= 0:
            worlds[:, node] = worlds[:, parent] @ local[:, node]
    if not (np.abs(worlds) <= LARGEST).all():
        raise ValueError("numbers are not finite, or too large")
    return worlds
