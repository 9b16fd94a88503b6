"""Animated node hierarchies in FBX and GLB files: the positions of all nodes in each frame.

Only the node positions are used; the rotations of the motion are computed from them. The rest pose
therefore need not be a T-pose, and the local axes, which differ between programs, do not matter.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from flame_mdm.errors import UserError, did_you_mean

LARGEST = 1e9  # maximum absolute value of a coordinate, in the unit of the file

Item = TypeVar("Item")


@dataclass(frozen=True, eq=False)
class AnimatedNodes:
    """A file's node hierarchy, and how the nodes move in one animation.

    Attributes:
        names: names of the N nodes.
        parents: index of each node's parent, smaller than the node's own index, or -1 for a root.
        positions: (F, N, 3), world positions of the nodes in meters, with y up.
        fps: frames per second.
        animation: the name of the animation.
        humanoid: node index of each SMPL joint. Empty if the file does not declare which nodes form
            a human body.
        unit: meters per unit of length, as declared in the file.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    positions: np.ndarray
    fps: float
    animation: str
    humanoid: dict[str, int]
    unit: float = 1.0


def choose(animations: Sequence[tuple[str, Item]], requested: str | int | None) -> tuple[str, Item]:
    """Returns the name and content of the requested animation.

    Args:
        animations: name and content of each animation.
        requested: the name or 1-based number of an animation, or None for the first animation.

    Raises:
        UserError: If there is no such animation.
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
    """Returns the node indices, ordered so that parents precede their children.

    Args:
        parents: index of each node's parent, or -1 for a root.

    Raises:
        ValueError: If a node is its own ancestor.
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
    """Converts parent-relative matrices (F, N, 4, 4) to world matrices.

    Parents must precede their children.
    """
    worlds = local.copy()
    for node, parent in enumerate(parents):
        if parent >= 0:
            worlds[:, node] = worlds[:, parent] @ local[:, node]
    if not (np.abs(worlds) <= LARGEST).all():
        raise ValueError("numbers are not finite, or too large")
    return worlds
