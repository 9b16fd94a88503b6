"""Motions for tests: synthetic clips, a figure that sways, bodies in given poses; and pages that show motions."""

import base64
import json
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats.motion import Motion, motion_of_poses
from flame_mdm.formats.poses import Poses
from flame_mdm.representations.skeleton import SMPL22, Skeleton
from flame_mdm.representations.smpl import ADULT
from flame_mdm.seeds import key
from flame_mdm.visualize import render

HOSTILE = "</script><img src=x onerror=alert(1)><!-- __TITLE__ \u2028 \"'&amp; &"
"""A caption that tries to leave the element of a page that it is in."""


@cache
def _clip(action: str, fps: float, size: int, seed: int) -> np.ndarray:
    clips = (
        clip
        for clip in Synthetic(clips=size, seed=seed).clips(fps)
        if clip.attributes["action"] == action
    )
    return np.asarray(next(clips).motion)


def synthetic(action: str = "walk", fps: float = 20.0, size: int = 60, seed: int = 0) -> Motion:
    """The first clip of an action in the synthetic set, joints (F, 22, 3): walk, kick, wave, jump, punch, raise, ..."""
    return Motion(_clip(action, fps, size, seed).copy(), fps, text=f"a person {action}s", id=action)


def sway(
    frames: int = 30,
    fps: float = 20,
    skeleton: Skeleton = SMPL22,
    contacts: bool = False,
    **names: Any,
) -> Motion:
    """A figure of any skeleton that stands in its rest pose, sways and moves forward."""
    bones = 0.2 * np.array(skeleton.raw_offsets, dtype=float)
    pose = np.zeros((len(bones), 3))
    for joint, parent in enumerate(skeleton.parents[1:], 1):
        pose[joint] = pose[parent] + bones[joint]
    pose[:, 1] -= pose[:, 1].min()
    time = np.arange(frames)[:, None, None] / fps
    joints = (
        pose
        + np.random.default_rng(0).normal(0, 0.05, pose.shape) * np.sin(6 * time)
        + time * [0, 0, 1.2]
    )
    touch = np.arange(frames * len(skeleton.feet)).reshape(frames, -1) % 3 == 0
    return Motion(joints, fps, skeleton, contacts=touch if contacts else None, **names)


def posed(
    frames: int = 1,
    scale: float = 1.0,
    heading: ArrayLike = 0.0,
    root: ArrayLike | None = None,
    **turns: ArrayLike,
) -> Motion:
    """SMPL's body, whose rotations are known, at 20 frames per second.

    Args:
        frames: length.
        scale: of all bones.
        heading: rotation about the vertical in radians, one number or (F,).
        root: (F, 3), position of the pelvis; default: the lowest joint of the rest pose is on the floor.
        turns: joint -> degrees about x, y, z, (3,) or (F, 3).
    """
    rotations = np.tile(np.eye(3), (frames, 22, 1, 1))
    for name, angles in turns.items():
        vectors = np.broadcast_to(angles, (frames, 3))
        rotations[:, SMPL22.joints.index(name)] = Rotation.from_euler(
            "xyz", vectors, degrees=True
        ).as_matrix()
    headings = np.broadcast_to(heading, frames)[:, None] * [0.0, 1.0, 0.0]
    rotations[:, 0] = Rotation.from_rotvec(headings).as_matrix() @ rotations[:, 0]
    pelvis = np.broadcast_to([0.0, 0.955 * scale, 0.0] if root is None else root, (frames, 3))
    offsets = torch.tensor(scale * np.array(ADULT[:22]))
    return motion_of_poses(
        Poses(offsets, torch.tensor(rotations), torch.tensor(np.array(pelvis))), 20
    )


def degrees(rotations: ArrayLike) -> np.ndarray:
    """The angles (...) of rotations (..., 3, 3)."""
    matrices = np.asarray(rotations)
    return np.degrees(Rotation.from_matrix(matrices.reshape(-1, 3, 3)).magnitude()).reshape(
        matrices.shape[:-2]
    )


def largest_step(rotations: ArrayLike) -> float:
    """Degrees that any joint turns from one frame to the next, at most, of rotations (F, J, 3, 3)."""
    turns = np.asarray(rotations)
    return float(degrees(turns[1:].mT @ turns[:-1]).max())


def adult(frames: int) -> np.ndarray:
    """Joints (F, 22, 3) float32 of SMPL's body, which turns left and right."""
    return posed(frames, heading=np.sin(np.arange(frames) / 5)).joints.astype(np.float32)


@cache
def bvh_text() -> str:
    """A BVH file of SMPL's body in its rest pose, in centimeters: 3 frames at 20 per second."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "pose.bvh"
        posed(3, root=[[0, 0.9, 0]] * 3).save(path)
        return path.read_text()


class Page(HTMLParser):
    """Tags of a player page, and the text of its elements by id or tag."""

    def __init__(self, path: Path):
        super().__init__()
        self.tags: list[str] = []
        self.texts: dict[str, str] = {}
        self.inside = ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.inside = dict(attrs).get("id") or tag

    def handle_endtag(self, tag: str) -> None:
        self.inside = ""

    def handle_data(self, data: str) -> None:
        self.texts[self.inside] = self.texts.get(self.inside, "") + data

    @property
    def motions(self) -> list[dict[str, Any]]:
        return json.loads(self.texts["data"])


def unpacked(packed: dict[str, Any]) -> np.ndarray:
    """Joints (F, J, 3) of a motion in a page."""
    quanta = np.frombuffer(base64.b64decode(packed["joints"]), "<i2").reshape(
        packed["frames"], -1, 3
    )
    return packed["center"] + quanta * packed["step"]


def keys(count: int, *name: str | int) -> torch.Tensor:
    """Keys (N,) of the samples of a metric."""
    return torch.tensor([key(*name, i) for i in range(count)], dtype=torch.long)


def wander(joints: int, frames: int, seed: int) -> torch.Tensor:
    """(F, J, 3): smooth motion of random joints, in meters."""
    generator = torch.Generator().manual_seed(seed)
    pose = torch.rand(joints, 3, generator=generator)
    return pose + torch.randn(frames, joints, 3, generator=generator).cumsum(0) * 0.02


def frames_array(motion: Motion, size: int = 256) -> np.ndarray:
    """Each frame of a motion as an image, (F, size, size, 3) uint8."""
    fitted, _ = motion.try_fit()
    return np.stack(
        [
            np.asarray(render._figure(motion, fitted, frame, size))
            for frame in range(len(motion.joints))
        ]
    )
