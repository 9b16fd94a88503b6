"""Reader for AMASS (SMPL+H G release) in downloaded archives or unpacked folders.

Source: Mahmood et al., "AMASS: Archive of Motion Capture as Surface Shapes", ICCV 2019. The
license is at amass.is.tue.mpg.de.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeVar

import numpy as np

from flame_mdm.data import archives, required
from flame_mdm.data.parallel import cores, in_order
from flame_mdm.errors import UserError
from flame_mdm.formats.resampling import check_frames, frame_rate
from flame_mdm.safe_io import naming, read_npz, read_package_yaml

FACTS = read_package_yaml(Path(__file__).with_suffix(".yaml"))
SUBSETS: dict[str, list[str]] = FACTS["subsets"]
Argument = TypeVar("Argument")
Result = TypeVar("Result")
ARCHIVE = re.compile(r"(.+)\.tar(\.bz2|\.xz|\.gz)?")
RELEASE = "not a motion from AMASS's SMPL+H G release, which is the one to download"
GET_IT = "register at https://amass.is.tue.mpg.de, download the SMPL+H G archives and put them in this folder"


def _plain(name: str) -> str:
    return re.sub("[^a-z0-9]", "", name.lower())


_BY_NAME = {_plain(alias): name for name, aliases in SUBSETS.items() for alias in (name, *aliases)}


class Recording(NamedTuple):
    """One AMASS file.

    Args:
        poses: (F, 156), axis-angle vectors of SMPL+H's 52 joints.
        translation: (F, 3), positions in meters, with z up.
        betas: shape parameters of the body.
        gender: "male", "female" or "neutral".
        fps: frames per second.
    """

    poses: np.ndarray
    translation: np.ndarray
    betas: np.ndarray
    gender: str
    fps: float

    def every(self, fps: float) -> Recording:
        """Keeps every int(self.fps / fps)-th frame, as HumanML3D and FLAME do.

        Recordings at 59.94 or 250 Hz then have about `fps` frames per second.

        Raises:
            UserError: If the recording has fewer than `fps` frames per second.
        """
        step = int(self.fps / fps)
        if step < 1:
            raise UserError(
                f"recorded at {self.fps:g} frames per second, but at least {fps:g} are required"
            )
        return self.cut(slice(None, None, step))

    def cut(self, frames: slice) -> Recording:
        """Returns a copy of the recording that contains only a slice of the frames."""
        return self._replace(poses=self.poses[frames], translation=self.translation[frames])

    def parameters(self) -> np.ndarray:
        """Returns the parameters (F, 75) float32 that FLAME uses.

        Each frame contains the translation and the axis-angle vectors of 24 joints.
        """
        return np.concatenate([self.translation, self.poses[:, :72]], 1).astype(np.float32)


def key_of(path: str) -> str | None:
    """Returns the key of a recording, such as `BioMotionLab_NTroje/rub001/0000_x_poses`.

    Returns None if the path does not belong to a subset. A subset may have different names in index
    files, archives and folders; all of these names result in the same key. Case is ignored, and
    spaces are replaced by underscores, as in later releases. A file from the SMPL-X release has the
    same key as the corresponding SMPL+H file.
    """
    whole = PurePosixPath(path).with_suffix("")
    for folder in whole.parents:
        if subset := _BY_NAME.get(_plain(folder.name)):
            rest = str(whole.relative_to(folder))
            return f"{subset}/{rest.replace(' ', '_').lower()}".replace("_stageii", "_poses")
    return None


def read(file: Path | bytes, name: str) -> Recording:
    """Reads a recording.

    Args:
        file: path or contents of the .npz file.
        name: file name for error messages.

    Raises:
        UserError: If the file is not a motion from the SMPL+H G release, or if it contains NaN or
            infinite values.
    """
    names = ("poses", "trans", "betas", "gender", "mocap_framerate")
    with naming(name, ValueError), naming(name, KeyError, prefix=f"{RELEASE}: it lacks "):
        data = read_npz(io.BytesIO(file) if isinstance(file, bytes) else file, only=names)
        poses, translation, betas, gender, rate = (data[key] for key in names)
        if (
            poses.shape[1:] != (156,)
            or translation.shape != (len(poses), 3)
            or betas.ndim != 1
            or gender.size != 1
        ):
            raise UserError(
                f"{RELEASE}: expected poses of shape (F, 156) and trans of shape (F, 3), but found "
                f"shapes {poses.shape} and {translation.shape}"
            )
        if any(
            array.dtype.kind not in "fiu" or not np.isfinite(array).all()
            for array in (poses, translation, betas)
        ):
            raise UserError("contains non-finite numbers")
        check_frames(len(poses))
        word = gender.item()
        gender = word.decode() if isinstance(word, bytes) else str(word)
        return Recording(poses, translation, betas, gender, frame_rate(rate, "mocap_framerate"))


@dataclass
class Amass:
    """A folder that contains AMASS as downloaded archives, as unpacked subsets, or both."""

    root: Path

    @cached_property
    def files(self) -> dict[str, Path]:
        """Maps the key of each unpacked recording to its file."""
        paths = required(self.root, GET_IT).rglob("*.npz")
        return {key: path for path in paths if (key := key_of(str(path.relative_to(self.root))))}

    @cached_property
    def archives(self) -> dict[str, Path]:
        """Maps each subset to its archive, which is recognized by its file name."""
        paths = ((path, ARCHIVE.fullmatch(path.name)) for path in sorted(self.root.rglob("*.tar*")))
        return {
            subset: path
            for path, match in paths
            if match and (subset := _BY_NAME.get(_plain(match[1])))
        }

    def missing(self, keys: Collection[str]) -> list[str]:
        """Returns one line per subset with missing recordings.

        Archives are not opened, so their contents are not checked.
        """
        lines = []
        for subset, of_subset in groupby(sorted(keys), _subset_of):
            members = list(of_subset)
            absent = [key for key in members if key not in self.files]
            if absent and subset not in self.archives:
                names = " or ".join((subset, *SUBSETS[subset]))
                line = f"{subset}: {len(absent)} of {len(members)} recordings are missing, such as {absent[0]}"
                lines.append(f"{line}; the archive is called {names}")
        return lines

    def check(self, keys: Collection[str]) -> None:
        """Raises `FileNotFoundError` if recordings are missing; see `missing`."""
        if absent := self.missing(keys):
            raise FileNotFoundError(f"{self.root}: {'; '.join(absent)}")

    def map(
        self,
        arguments: Mapping[str, Argument],
        function: Callable[[Argument, Recording], Result],
        workers: int = 0,
    ) -> Iterator[tuple[str, Result]]:
        """Applies a function to recordings in worker processes.

        Yields pairs (key, result), sorted by key.

        Args:
            arguments: mapping from the key of each recording to the argument of the function. Keys
                and arguments must be picklable.
            function: called as `function(argument, recording)`. It must be picklable.
            workers: number of processes; 0 = one per core.
        """
        self.check(arguments)
        # Each task is a single recording. For a subset that is not unpacked, the task is the entire
        # archive, because an archive can only be read from the beginning.
        tasks: list[tuple[Path, dict[str, Argument]]] = []
        for subset, keys in groupby(sorted(arguments), _subset_of):
            of_subset = {key: arguments[key] for key in keys}
            if of_subset.keys() <= self.files.keys():
                tasks += [(self.files[key], {key: argument}) for key, argument in of_subset.items()]
            else:
                tasks.append((self.archives[subset], of_subset))
        # Reading an archive takes minutes. Therefore, the number of workers is always set, so that
        # they start immediately and not only after some work in this process.
        for results in in_order(
            partial(_run, function), tasks, min(workers or cores(), len(tasks))
        ):
            yield from results


def _subset_of(key: str) -> str:
    return key.partition("/")[0]


def _run(
    function: Callable[[Argument, Recording], Result], task: tuple[Path, dict[str, Argument]]
) -> list[tuple[str, Result]]:
    path, arguments = task
    results = {}
    is_archive = ARCHIVE.fullmatch(path.name)
    contents = (
        _members(path, arguments)
        if is_archive
        else zip(arguments, [str(path)], [path], strict=True)
    )
    for key, name, content in contents:
        with naming(name):
            results[key] = function(arguments[key], read(content, name))
    return [(key, results[key]) for key in arguments]


def _members(archive: Path, keys: Collection[str]) -> Iterator[tuple[str, str, bytes]]:
    """Yields the key, name and content of each recording in an archive."""
    left = set(keys)
    for name, content in archives.members(
        archive, lambda name: name.endswith(".npz") and key_of(name) in left
    ):
        key = str(key_of(name))
        left.remove(key)
        yield key, f"{archive}/{name}", content
        if not left:
            return
    raise UserError(
        f"{archive}: {len(left)} recordings are missing from the archive, such as {min(left)}"
    )
