"""What there is to draw: a motion on its skeleton, the thickness and side of its limbs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # seeing motion needs numpy and Pillow, not torch
    from flame_mdm.representations.skeleton import Skeleton


@dataclass(eq=False)
class Motion:
    """One motion to look at.

    Attributes:
        joints: (F, J, 3) joint positions in metres, y up, floor at y = 0.
        fps: frames a second.
        skeleton: names and parents of the J joints; `left_` and `right_` tell the sides.
        caption: what the motion is asked to be; shown below it.
        id: name of the motion; shown below it.
        contacts: (F, N) bool, True = this one of the N joints `skeleton.feet` stands on the floor; None = not known.
        group: what the player can be narrowed down to, such as a split; "" = nothing.
        beside: id of the motion before this one that it belongs beside, as a mirrored copy to its original.

    Raises:
        ValueError: wrong shapes, joints that are not finite, or a frame rate that is no positive number.
    """

    joints: np.ndarray
    fps: float
    skeleton: Skeleton
    caption: str = ""
    id: str = ""
    contacts: np.ndarray | None = None
    group: str = ""
    beside: str = ""

    def __post_init__(self) -> None:
        name, skeleton = f"motion {self.id!r}", self.skeleton
        self.joints = np.asarray(self.joints, dtype=np.float32)
        shape = self.joints.shape
        if len(shape) != 3 or shape[2] != 3 or not shape[0]:
            raise ValueError(f"{name}: joints have shape {shape}, expected (frames, joints, 3)")
        if shape[1] != len(skeleton.joints):
            raise ValueError(f"{name}: {shape[1]} joints, but skeleton {skeleton.name} has {len(skeleton.joints)}")
        if not np.isfinite(self.joints).all():
            frame, joint, _ = np.argwhere(~np.isfinite(self.joints))[0]
            raise ValueError(f"{name}: joint {joint} in frame {frame} is not finite; did the model diverge?")
        self.fps = float(self.fps)
        if not 0 < self.fps < float("inf"):
            raise ValueError(f"{name}: fps is {self.fps}, expected a number above 0")
        if self.contacts is not None:
            self.contacts = np.asarray(self.contacts, dtype=bool)
            given, expected = self.contacts.shape, (shape[0], len(skeleton.feet))
            if given != expected:
                raise ValueError(f"{name}: contacts have shape {given}, expected (frames, feet) = {expected}")

    @property
    def seconds(self) -> float:
        return len(self.joints) / self.fps

    @property
    def sides(self) -> list[int]:
        """Of each joint: 1 left, -1 right, 0 middle."""
        return [name.startswith("left_") - name.startswith("right_") for name in self.skeleton.joints]

    @property
    def head(self) -> int | None:
        """The joint that carries a head, where the skeleton names one."""
        return self.skeleton.joints.index("head") if "head" in self.skeleton.joints else None

    @property
    def radii(self) -> list[float]:
        """Thickness of the body around each joint in metres: the more joints hang on one, the thicker it is."""
        below = [0] * len(self.skeleton.parents)
        for joint in reversed(range(1, len(below))):
            below[self.skeleton.parents[joint]] += below[joint] + 1
        return [round(0.024 + 0.011 * count**0.5, 4) for count in below]

    def frame_at(self, seconds: float) -> int:
        """The frame shown at a time; past its end a motion stays at its last frame."""
        return min(int(seconds * self.fps + 1e-6), len(self.joints) - 1)


def check_any(motions: Sequence[Motion], path: Path) -> None:
    if not motions:
        raise ValueError(f"{path}: no motions to show")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Gives a temporary name beside `path`, renamed to it at the end; a failure leaves nothing half-written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}{path.suffix}")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
