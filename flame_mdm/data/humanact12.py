"""HumanAct12: 1,191 clips of 12 actions, as SMPL poses published by ACTOR's authors.

Sources: Guo et al. (Action2Motion), ACM MM 2020; poses by Petrovich et al. (ACTOR), ICCV 2021.
See `docs/actions.md`.
"""

from collections import Counter
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from flame_mdm.data import Clip, MotionSource, restricted_pickle, split_blocks
from flame_mdm.errors import UserError
from flame_mdm.safe_io import naming, read_npy

# Frames per second at which the authors' code plays the action data sets. The frames are not
# resampled.
FPS = 20.0
# Errors raised by NumPy for values that are not numbers
NO_NUMBERS = (
    TypeError,
    ValueError,
    OverflowError,
)
# Number of consecutive clips that are put into the same split, because they may be cut from the
# same recording
BLOCK = 10


class HumanAct12(MotionSource):
    """The clips in `humanact12poses.pkl`, given as raw motions for the SMPL representations.

    The file does not identify subjects or recordings. The project's own split (70 % train, 10 % val
    and 20 % test for each action) keeps neighboring clips together. The published split uses all
    clips for both training and testing, as in the papers.
    """

    name = "humanact12"
    actions = (
        "warm_up",
        "walk",
        "run",
        "jump",
        "drink",
        "lift_dumbbell",
        "sit",
        "eat",
        "turn steering wheel",
        "phone",
        "boxing",
        "throw",
    )

    def __init__(self, path: str, published_split: bool = False):
        self.path, self.published_split = Path(path), published_split
        self.options = {"published_split": published_split}

    def count(self) -> int:
        """Returns the number of clips in the file."""
        return len(self._motions)

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields the clips in the order of the file. The clips have actions, but no captions."""
        self.check_fps(fps, FPS)
        clips, seen = Counter(action for _, action in self._motions), Counter[int]()
        blocks = {
            a: split_blocks(f"humanact12_{a}", clips[a], BLOCK, val=0.1, test=0.2) for a in clips
        }
        for number, (motion, action) in enumerate(self._motions):
            name, block = f"humanact12_{number:04d}", seen[action] // BLOCK
            seen[action] += 1
            split, source = blocks[action][block], f"{self.actions[action]} {block}"
            if self.published_split:
                split, source = "train", name
            yield Clip(name, motion, [], split, source, action)

    @cached_property
    def _motions(self) -> list[tuple[np.ndarray, int]]:
        """The motion (F, 75) float32 and the action of each clip, in the order of the file.

        A motion consists of the position of the root joint (meters, camera axes), followed by 24
        axis-angle vectors.
        """
        path, motions = find(self.path, "humanact12poses.pkl"), []
        for number, (poses, joints, action) in enumerate(
            zip(*read_lists(path, "poses", "joints3D", "y"), strict=True)
        ):
            with naming(
                f"{path}: clip {number}",
                *NO_NUMBERS,
                prefix="contains values that are not numbers: ",
            ):
                pose = np.asarray(poses, np.float32)
                joint = np.asarray(joints, np.float32)
                label = int(action)
                if pose.shape[1:] != (72,) or joint.shape != (len(pose), 24, 3) or not len(pose):
                    raise UserError(
                        f"expected poses of shape (F, 72) and joints of shape (F, 24, 3), but found shapes "
                        f"{pose.shape} and {joint.shape}"
                    )
                if not 0 <= label < len(self.actions):
                    raise UserError(
                        f"label {label} is not in the range 0 to {len(self.actions) - 1}"
                    )
            motions.append((np.concatenate([joint[:, 0], pose], 1), label))
        return motions


def read_unconstrained(path: Path) -> np.ndarray:
    """Reads the reference motions for unconstrained generation.

    Sources: Tevet et al. 2023, section 4.3; Raab et al. 2022. The array in
    `humanact12_unconstrained_modi_struct.npy` has the shape (N, 15 or more, 3, F). The result (N,
    F, 15, 3) float32 contains the positions of SMPL's joints 15, 12, 16, 18, 20, 17, 19, 21, 0, 1,
    4, 7, 2, 5, 8.
    """
    data = read_npy(path)
    if data.dtype.kind not in "fiu" or data.ndim != 4 or data.shape[1] < 15 or data.shape[2] != 3:
        raise UserError(
            f"{path}: expected shape (motions, 15 or more joints, 3, frames), but found "
            f"{data.shape}"
        )
    return np.ascontiguousarray(data[:, :15].transpose(0, 3, 1, 2), np.float32)


def find(path: Path, name: str) -> Path:
    """Returns `path` or, if it is a folder, the file `name` in it or in a subfolder.

    The error for a missing file states where the data set is published.
    """
    for file in (path, path / name, *sorted(path.glob(f"*/{name}"))):
        if file.is_file():
            return file
    raise FileNotFoundError(
        f"{path}: no {name}; the data set is published with ACTOR (https://github.com/Mathux/ACTOR, prepare/"
        "download_datasets.sh): unpack the archive, then run `make prepare` with SOURCE=/path/to/the/folder"
    )


def read_lists(path: Path, *names: str) -> list[Any]:
    """Returns the lists with the given names from a pickled dictionary.

    All lists must have the same length.
    """
    data = restricted_pickle.read(path)
    if not isinstance(data, dict) or not set(names) <= set(data):
        kind = (
            f"keys {', '.join(map(str, data))}" if isinstance(data, dict) else type(data).__name__
        )
        raise UserError(
            f"{path}: must contain a dictionary with {', '.join(names)}, but contains {kind}"
        )
    lists = [data[name] for name in names]
    are_lists = all(isinstance(values, list | tuple) or np.ndim(values) for values in lists)
    if not are_lists or len(set(map(len, lists))) > 1:
        raise UserError(f"{path}: {', '.join(names)} are not lists of equal length")
    return lists
