"""UESTC: 25,600 videos of 40 exercises by 118 subjects, as SMPL poses.

Sources: Ji et al., ACM MM 2018; poses by Petrovich et al. (ACTOR), ICCV 2021, who estimated them
with VIBE. `docs/actions.md` describes the data set.
"""

import math
import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.data import Clip, MotionSource, Split, name_hash, required
from flame_mdm.data.humanact12 import FPS, NO_NUMBERS, find, read_lists
from flame_mdm.errors import UserError
from flame_mdm.safe_io import naming, read_text

# fmt: off
TRAIN_SUBJECTS = (
    1, 2, 6, 12, 13, 16, 21, 24, 28, 29, 30, 31, 33, 35, 39, 41, 42, 45, 47, 50, 52, 54, 55, 57,
    59, 61, 63, 64, 67, 69, 70, 71, 73, 77, 81, 84, 86, 87, 88, 90, 91, 93, 96, 99, 102, 103, 104,
    107, 108, 112, 113,
)
# fmt: on
"""Training subjects of the cross-subject protocol: 51 of 118. The other 67 are used for testing."""
# Number of training subjects that the project's own split uses for validation
VAL_SUBJECTS = 5
# Minimum number of frames in a training clip: three quarters of the 60 frames of a sample
MIN_FRAMES = 45
# Index of the mid-hip joint among VIBE's 49 joints; ACTOR uses it as the root
ROOT = 8
# Focal length and image size in pixels that ACTOR assumes, because VIBE estimates only a scale
FOCAL_LENGTH = 500.0
IMAGE_SIZE = 540.0
NAME = re.compile(r"(a(\d+)_d(\d+)_p(\d+)_c(\d+))(_.*)?")


class Video(NamedTuple):
    """The fields in the file name of a video.

    `index` is the position of the video in the published lists.
    """

    index: int
    id: str
    action: int
    view: int
    subject: int
    side: int


class UESTC(MotionSource):
    """The clips of `vibe_cache_refined.pkl` as raw SMPL motions, rotated to the front view.

    As in the published data set, training clips with fewer than 45 frames are left out, and all
    test clips are kept. In the published split, all 51 training subjects are used for training. The
    project's own split uses 5 of these training subjects for validation.
    """

    name = "uestc"

    def __init__(self, path: str, published_split: bool = False):
        self.path, self.published_split = Path(path), published_split
        self.options = {"published_split": published_split}

    @cached_property
    def actions(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Names of the actions.

        The names are read before any clip, because models require the number of actions.
        """
        return tuple(self._lines("action_classes.txt"))

    def count(self) -> int:
        """Returns the number of videos.

        The number includes the few videos that turn out to be too short when they are read.
        """
        return len(self.used)  # including the few that are left out when their poses are read

    def counts(self) -> dict[str, int]:
        """Returns the number of videos and the number of subjects."""
        return {"videos": len(self.videos), "subjects": len({video.subject for video in self.used})}

    @cached_property
    def poses(self) -> Path:
        """The file with the poses."""
        return find(self.path, "vibe_cache_refined.pkl")

    @cached_property
    def videos(self) -> list[Video]:
        """All videos, in the order of the pose file.

        Raises:
            UserError: If a name cannot be parsed.
        """
        videos = []
        for index, name in enumerate(self._lines("names.txt")):
            match = NAME.fullmatch(name)
            if match is None or int(match[2]) >= len(self.actions):
                row = f"{self.poses.parent}/info/names.txt, line {index + 1}"
                raise UserError(
                    f"{row}: {name!r} does not name a video of one of the {len(self.actions)} actions"
                )
            videos.append(Video(index, match[1], *(int(match[k]) for k in range(2, 6))))
        return videos

    @cached_property
    def used(self) -> list[Video]:
        """The videos that are used: all views of side 1, and views 0 to 7 of side 2."""
        return [video for video in self.videos if video.side == 1 or video.view < 8]

    def _lines(self, name: str) -> list[str]:
        path = self.poses.parent / "info" / name
        return read_text(
            required(path, "it is published with the poses; unpack the archive again")
        ).splitlines()

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the clips that are long enough, with the attributes subject, view and side."""
        self.check_fps(fps, FPS)
        path, count = self.poses, len(self.videos)
        columns = read_lists(path, "pose", "joints3d", "orig_cam")
        frames = self._lines("num_frames_min.txt")
        if not count == len(frames) == len(columns[0]):
            sizes = f"names.txt has {count}, num_frames_min.txt {len(frames)} and {path.name} {len(columns[0])} clips"
            raise UserError(f"{path.parent}: {sizes}")
        self.leave_out("videos of view 8, side 2", count - len(self.used))
        for video in self.used:
            with naming(
                f"{path}: {video.id}", *NO_NUMBERS, prefix="contains values that are not numbers: "
            ):
                pose, joint, camera = (
                    np.asarray(column[video.index], np.float64) for column in columns
                )
                limit = int(frames[video.index])
                if (
                    pose.shape[1:] != (72,)
                    or joint.shape != (len(pose), 49, 3)
                    or camera.shape != (len(pose), 4)
                ):
                    raise UserError(
                        f"unexpected shapes: pose {pose.shape}, joints3d {joint.shape}, "
                        f"orig_cam {camera.shape}"
                    )
            split, length = self.split(video.subject), min(len(pose), limit)
            if length < (1 if split == "test" else MIN_FRAMES):
                self.leave_out(
                    f"{'test' if split == 'test' else 'training'} clips that are too short"
                )
                continue
            motion = front_view(pose[:length], joint[:length, ROOT], camera[:length], video)
            attributes = {"subject": video.subject, "view": video.view, "side": video.side}
            yield Clip(
                video.id, motion, [], split, f"subject {video.subject}", video.action, attributes
            )

    def split(self, subject: int) -> Split:
        """Returns the split of a subject."""
        if subject not in TRAIN_SUBJECTS:
            return "test"
        ranked = sorted(TRAIN_SUBJECTS, key=lambda s: name_hash(f"uestc_p{s:03d}"))
        return "val" if not self.published_split and subject in ranked[:VAL_SUBJECTS] else "train"


def front_view(pose: np.ndarray, root: np.ndarray, camera: np.ndarray, video: Video) -> np.ndarray:
    """Converts VIBE's estimates to a raw float32 motion (F, 75).

    VIBE estimates a weak-perspective camera, which consists of a scale s and a shift. ACTOR's code
    uses the shift as the x and y coordinates of the body, and computes the depth z from the scale:
    z = f / (s w / 2) for a camera with focal length f and an image that is w pixels wide. For
    videos of side 2, the motion is rotated about the vertical axis by the angle of the view.

    Args:
        pose: (F, 72), axis-angle vectors.
        root: (F, 3), position of the root relative to the body.
        camera: (F, 4), the scales sx and sy, followed by the shift. The scale sy is not used.
        video: the fields in the video's file name.

    Returns:
        The translation relative to the first frame, followed by the pose, both in camera axes.
    """
    depth = FOCAL_LENGTH / (np.abs(camera[:, 0]) * IMAGE_SIZE / 2)
    shift = np.concatenate([camera[:, 2:], depth[:, None]], 1)
    shift -= shift[0]
    if video.side != 1:
        turn = Rotation.from_rotvec([0.0, -video.view * math.pi / 4, 0.0])
        pose = np.concatenate(
            [(turn * Rotation.from_rotvec(pose[:, :3])).as_rotvec(), pose[:, 3:]], 1
        )
        root, shift = turn.apply(root), turn.apply(shift)
    return np.concatenate([root + shift, pose], 1).astype(np.float32)
