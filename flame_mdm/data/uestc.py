"""UESTC: 25,600 videos of 40 exercises by 118 subjects, as the SMPL poses that ACTOR's authors estimated with VIBE.

Ji et al., "A Large-scale RGB-D Database for Arbitrary-view Human Action Recognition", ACM MM 2018; poses by Petrovich
et al., "Action-Conditioned 3D Human Motion Synthesis with Transformer VAE", ICCV 2021. `docs/actions.md` describes it.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.data import Clip, MotionSource, Split, restricted_pickle
from flame_mdm.data.humanact12 import check_fps, columns, find
from flame_mdm.files import read_text

TRAIN_SUBJECTS = (
    *(1, 2, 6, 12, 13, 16, 21, 24, 28, 29, 30, 31, 33, 35, 39, 41, 42, 45, 47, 50, 52, 54, 55, 57, 59, 61, 63),
    *(64, 67, 69, 70, 71, 73, 77, 81, 84, 86, 87, 88, 90, 91, 93, 96, 99, 102, 103, 104, 107, 108, 112, 113),
)
"""51 of the 118 subjects, the cross-subject protocol; the other 67 are for testing."""

HELD_OUT = 5
"""Training subjects that our split validates on."""

ROOT = 8
"""The middle of the hips among VIBE's 49 joints, which ACTOR takes as the root."""

FOCAL_LENGTH, IMAGE_SIZE = 500.0, 540.0
"""In pixels: the camera that ACTOR assumes where VIBE estimates a scale only."""

NAME = re.compile(r"a(\d+)_d(\d+)_p(\d+)_c(\d+)(_.*)?")


@dataclass(frozen=True)
class Video:
    """What the name of a video says; `index` is its place in the lists."""

    index: int
    id: str
    action: int
    view: int
    subject: int
    side: int


class UESTC(MotionSource):
    """The clips of `vibe_cache_refined.pkl`, turned to the front view, as raw motions of the SMPL representations.

    Training subjects' clips of fewer than `min_frames` frames are left out, as published; test clips are all kept.
    """

    name = "uestc"
    published: ClassVar[dict[str, int]] = {
        "videos": 25600,
        "actions": 40,
        "subjects": 118,
        "fewest training clips an action": 225,
        "most training clips an action": 345,
    }

    def __init__(self, path: str, published_split: bool = False, min_frames: int = 45):
        """Reads nothing yet.

        Args:
            path: the folder that holds `vibe_cache_refined.pkl` and `info`.
            published_split: train on all 51 training subjects; otherwise 5 of them are for validation.
            min_frames: of a training clip; published: three quarters of 60.
        """
        self.path, self.published_split, self.min_frames = Path(path), published_split, min_frames
        self._videos: list[Video] | None = None
        self._actions: tuple[str, ...] = ()
        self._excluded: Counter[str] = Counter()

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the actions, which stand in the files alone: models have to know their number before training."""
        self.videos()
        return self._actions

    def count(self) -> int:
        """Videos; the few that are left out are known when their poses are read."""
        return len(self.videos())

    def excluded(self) -> dict[str, int]:
        return dict(self._excluded)

    def counts(self) -> dict[str, int]:
        return {"videos": self._size, "subjects": len({video.subject for video in self.videos()})}

    def videos(self) -> list[Video]:
        """The videos that are used: of side 2, those of views 0 to 7. Reads the names of the actions, too.

        Raises:
            FileNotFoundError, ValueError: a file of `info` is absent or damaged.
        """
        if self._videos is None:
            self._folder = find(self.path, "vibe_cache_refined.pkl").parent
            self._actions = tuple(_lines(self._folder / "info" / "action_classes.txt"))
            videos = []
            for index, name in enumerate(_lines(self._folder / "info" / "names.txt")):
                match = NAME.fullmatch(name)
                if match is None or int(match[1]) >= len(self._actions):
                    raise ValueError(
                        f"{self._folder}/info/names.txt, line {index + 1}: {name!r} is not the name of a video such as "
                        f"a0_d0_p001_c1_color.avi with one of the {len(self._actions)} actions"
                    )
                action, view, subject, side = (int(match[k]) for k in range(1, 5))
                videos.append(Video(index, name.removesuffix(match[5] or ""), action, view, subject, side))
            self._size = len(videos)
            self._videos = [video for video in videos if video.side == 1 or video.view < 8]
        return self._videos

    def clips(self, fps: float) -> Iterator[Clip]:
        check_fps(self.name, fps)
        videos = self.videos()
        path = self._folder / "vibe_cache_refined.pkl"
        poses, joints, cameras = columns(path, restricted_pickle.read(path), "pose", "joints3d", "orig_cam")
        frames = _lines(self._folder / "info" / "num_frames_min.txt")
        if not self._size == len(frames) == len(poses):
            raise ValueError(
                f"{self._folder}: names.txt has {self._size} lines, num_frames_min.txt {len(frames)} and "
                f"vibe_cache_refined.pkl {len(poses)} clips; they have to be as many"
            )
        self._excluded = Counter()
        if self._size > len(videos):
            self._excluded["videos of view 8, side 2"] = self._size - len(videos)
        for video in videos:
            try:
                pose, joint, camera = (np.asarray(part[video.index], np.float64) for part in (poses, joints, cameras))
                limit = int(frames[video.index])
            except (TypeError, ValueError, OverflowError) as error:
                raise ValueError(f"{path}: {video.id} does not consist of numbers: {error}") from error
            if pose.shape[1:] != (72,) or joint.shape != (len(pose), 49, 3) or camera.shape != (len(pose), 4):
                raise ValueError(
                    f"{path}: {video.id} has pose {pose.shape}, joints3d {joint.shape}, orig_cam {camera.shape}, not "
                    "(F, 72), (F, 49, 3), (F, 4)"
                )
            split, length = self.split(video.subject), min(len(pose), limit)
            if length < (1 if split == "test" else self.min_frames):
                self._excluded[f"{'test' if split == 'test' else 'training'} clips that are too short"] += 1
                continue
            yield Clip(
                video.id,
                front_view(pose[:length], joint[:length, ROOT], camera[:length], video),
                [],
                split,
                f"subject {video.subject}",
                video.action,
                {"subject": video.subject, "view": video.view, "side": video.side},
            )

    def split(self, subject: int) -> Split:
        """The split of a subject's clips."""
        if subject not in TRAIN_SUBJECTS:
            return "test"
        ranked = sorted(TRAIN_SUBJECTS, key=lambda s: hashlib.sha1(f"uestc_p{s:03d}".encode()).hexdigest())
        return "val" if not self.published_split and subject in ranked[:HELD_OUT] else "train"


def front_view(pose: np.ndarray, root: np.ndarray, camera: np.ndarray, video: Video) -> np.ndarray:
    """A raw motion out of VIBE's estimates; what side 2 sees is turned about the vertical by its view.

    VIBE's camera is weak: a scale s and a shift. ACTOR's code puts the body at the depth z at which a camera of focal
    length f shows it in that size, z = f / (s w / 2) in an image w pixels wide, and at x, y = the shift.

    Args:
        pose: (F, 72) axis-angle.
        root: (F, 3) the root joint relative to the body's place.
        camera: (F, 4) scales sx and sy, of which the first counts, then the shift.
        video: which view it is.

    Returns:
        (F, 75) float32: translation since the first frame and pose, in the camera's axes.
    """
    depth = FOCAL_LENGTH / (np.abs(camera[:, 0]) * IMAGE_SIZE / 2)
    place = np.concatenate([camera[:, 2:], depth[:, None]], 1)
    place -= place[0]
    if video.side != 1:
        turn = Rotation.from_rotvec([0.0, -video.view * math.pi / 4, 0.0])
        pose = np.concatenate([(turn * Rotation.from_rotvec(pose[:, :3])).as_rotvec(), pose[:, 3:]], 1)
        root, place = turn.apply(root), turn.apply(place)
    return np.concatenate([root + place, pose], 1).astype(np.float32)


def _lines(path: Path) -> list[str]:
    try:
        return read_text(path).splitlines()
    except FileNotFoundError:
        raise FileNotFoundError(
            f"{path}: it belongs to the set as ACTOR publishes it; unpack the archive again"
        ) from None
