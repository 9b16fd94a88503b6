"""UESTC: 25,600 videos of 40 exercises by 118 subjects, as the SMPL poses that ACTOR's authors estimated with VIBE.

Ji et al., "A Large-scale RGB-D Database for Arbitrary-view Human Action Recognition", ACM MM 2018; poses by Petrovich
et al., "Action-Conditioned 3D Human Motion Synthesis with Transformer VAE", ICCV 2021. Described in `docs/actions.md`.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.data import Clip, MotionSource, Split, restricted_pickle
from flame_mdm.data.humanact12 import check_fps, columns, find
from flame_mdm.safe_io import read_text

TRAIN_SUBJECTS = (
    *(1, 2, 6, 12, 13, 16, 21, 24, 28, 29, 30, 31, 33, 35, 39, 41, 42, 45, 47, 50, 52, 54, 55, 57, 59, 61, 63),
    *(64, 67, 69, 70, 71, 73, 77, 81, 84, 86, 87, 88, 90, 91, 93, 96, 99, 102, 103, 104, 107, 108, 112, 113),
)
"""Training subjects of the cross-subject protocol: 51 of 118; the other 67 are for testing."""

VAL_SUBJECTS = 5
"""Number of training subjects that our split uses for validation."""

ROOT = 8
"""Index of the middle of the hips among VIBE's 49 joints, which ACTOR uses as the root."""

FOCAL_LENGTH, IMAGE_SIZE = 500.0, 540.0
"""Camera in pixels that ACTOR assumes, since VIBE estimates only a scale."""

NAME = re.compile(r"a(\d+)_d(\d+)_p(\d+)_c(\d+)(_.*)?")


@dataclass(frozen=True)
class Video:
    """Fields of a video's file name; `index` is its position in the lists."""

    index: int
    id: str
    action: int
    view: int
    subject: int
    side: int


class UESTC(MotionSource):
    """The clips of `vibe_cache_refined.pkl`, rotated to the front view, as raw motions of the SMPL representations.

    As published, training clips of fewer than `min_frames` frames are left out and all test clips are kept.
    """

    name = "uestc"

    def __init__(self, path: str, published_split: bool = False, min_frames: int = 45):
        """Stores the arguments; reads no files.

        Args:
            path: the folder that contains `vibe_cache_refined.pkl` and `info`.
            published_split: train on all 51 training subjects; otherwise 5 of them are used for validation.
            min_frames: minimum length of a training clip; published: three quarters of 60.
        """
        self.path, self.published_split, self.min_frames = Path(path), published_split, min_frames
        self._videos: list[Video] | None = None
        self._actions: tuple[str, ...] = ()
        self._excluded: Counter[str] = Counter()

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the actions, read from the data set: models need their number before training."""
        self.videos()
        return self._actions

    def count(self) -> int:
        """Returns the number of videos, including the few left out when their poses are read."""
        return len(self.videos())

    def excluded(self) -> dict[str, int]:
        return dict(self._excluded)

    def counts(self) -> dict[str, int]:
        return {"videos": self._size, "subjects": len({video.subject for video in self.videos()})}

    def videos(self) -> list[Video]:
        """Returns the videos that are used: of side 2, only views 0 to 7. Also reads the names of the actions.

        Raises:
            FileNotFoundError, ValueError: a file of `info` is missing or damaged.
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
                f"vibe_cache_refined.pkl {len(poses)} clips; the numbers must be equal"
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
        """Returns the split of a subject's clips."""
        if subject not in TRAIN_SUBJECTS:
            return "test"
        ranked = sorted(TRAIN_SUBJECTS, key=lambda s: hashlib.sha1(f"uestc_p{s:03d}".encode()).hexdigest())
        return "val" if not self.published_split and subject in ranked[:VAL_SUBJECTS] else "train"


def front_view(pose: np.ndarray, root: np.ndarray, camera: np.ndarray, video: Video) -> np.ndarray:
    """Converts VIBE's estimates to a raw motion; videos of side 2 are rotated about the vertical by their view.

    VIBE's camera is weak-perspective: a scale s and a shift. ACTOR's code places the body at x, y = the shift and at
    the depth z at which a camera of focal length f shows it in that size: z = f / (s w / 2) in an image w pixels wide.

    Args:
        pose: (F, 72) axis-angle.
        root: (F, 3) position of the root joint relative to the body.
        camera: (F, 4) scales sx and sy, of which only the first is used, then the shift.
        video: gives side and view.

    Returns:
        (F, 75) float32: translation relative to the first frame and pose, in camera axes.
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
            f"{path}: no such file; it is part of the data set published by ACTOR; unpack the archive again"
        ) from None
