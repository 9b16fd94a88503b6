"""Description of the figure to draw: the motion protocol, and side and thickness of limbs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from flame_mdm.errors import UserError

if TYPE_CHECKING:  # drawing needs numpy and Pillow, not torch
    from torch import Tensor

    from flame_mdm.representations.skeleton import Skeleton


class Posed(Protocol):
    """A body in motion, such as `flame_mdm.formats.poses.Poses`, which describes the attributes."""

    offsets: Tensor
    rotations: Tensor


class Shown(Protocol):
    """A motion to draw, such as `flame_mdm.formats.motion.Motion`, which describes the attributes."""

    @property
    def joints(self) -> np.ndarray: ...
    @property
    def fps(self) -> float: ...
    @property
    def skeleton(self) -> Skeleton: ...
    @property
    def text(self) -> str: ...
    @property
    def id(self) -> str: ...
    @property
    def contacts(self) -> np.ndarray | None: ...
    @property
    def poses(self) -> Posed | None: ...
    def posed(self) -> Posed: ...


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


def frame_at(motion: Shown, seconds: float) -> int:
    """Returns the frame shown at a time; past its end a motion stays at its last frame."""
    return min(int(seconds * motion.fps + 1e-6), len(motion.joints) - 1)


def check_any(motions: Sequence[Shown], path: Path) -> None:
    """Raises `UserError` if there are no motions to write to `path`."""
    if not motions:
        raise UserError(f"{path}: no motions to show")
