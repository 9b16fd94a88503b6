"""Reader of AMASS (SMPL+H G release): downloaded archives or unpacked folders, and joints from the body parameters.

Mahmood et al., "AMASS: Archive of Motion Capture as Surface Shapes", ICCV 2019; license at amass.is.tue.mpg.de.
"""

from __future__ import annotations

import io
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path, PurePosixPath
from typing import NamedTuple, TypeVar

import numpy as np
import torch

from flame_mdm.data import archives, required
from flame_mdm.data.parallel import cores, in_order
from flame_mdm.errors import UserError
from flame_mdm.formats.resampling import check_frames, frame_rate
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22, forward_kinematics
from flame_mdm.safe_io import naming, read_npz

SUBSETS = {
    "ACCAD": ("ACCD",),
    "BioMotionLab_NTroje": ("BMLrub",),
    "BMLhandball": (),
    "BMLmovi": (),
    "CMU": (),
    "DFaust_67": ("DFaust",),
    "EKUT": (),
    "Eyes_Japan_Dataset": ("Eyes_Janpan_Dataset",),
    "HumanEva": (),
    "KIT": (),
    "MPI_HDM05": ("HDM05",),
    "MPI_Limits": ("PosePrior",),
    "MPI_mosh": ("MoSh",),
    "SFU": (),
    "SSM_synced": ("SSM",),
    "TCD_handMocap": ("TCDHands",),
    "TotalCapture": (),
    "Transitions_mocap": ("Transitions",),
    "CNRS": (),
    "DanceDB": (),
    "GRAB": (),
    "SOMA": (),
    "WEIZMANN": (),
}
"""Folder of each subset in the archives that HumanML3D was made from -> its other names (web page, later releases)."""

Argument = TypeVar("Argument")
Result = TypeVar("Result")
ARCHIVE_ENDINGS = (".tar.bz2", ".tar.xz", ".tar.gz", ".tar")
CHUNK = 32
_Files = Path | dict[str, Path]  # an archive, or a mapping from key to file
GET_IT = "register at https://amass.is.tue.mpg.de, download the SMPL+H G archives and put them there"


def _plain(name: str) -> str:
    return re.sub("[^a-z0-9]", "", name.lower())


_BY_NAME = {_plain(alias): name for name, aliases in SUBSETS.items() for alias in (name, *aliases)}


class Recording(NamedTuple):
    """One AMASS file: poses (F, 156), axis-angle of SMPL+H's 52 joints, and translation (F, 3) in meters, z up."""

    poses: np.ndarray
    translation: np.ndarray
    betas: np.ndarray
    gender: str
    fps: float

    def every(self, fps: float) -> Recording:
        """Returns every int(self.fps / fps)-th frame without interpolation, as HumanML3D, FLAME and users of BABEL do.

        At 59.94 or 250 Hz, the resulting rate is only approximately `fps`.
        """
        step = int(self.fps / fps)
        if step < 1:
            raise UserError(f"recorded at {self.fps:g} frames per second, fewer than the requested {fps:g}")
        return self._replace(poses=self.poses[::step], translation=self.translation[::step])


def key_of(path: str) -> str | None:
    """Returns the key of a recording, such as `BioMotionLab_NTroje/rub001/0000_x_poses`, or None outside a subset.

    All names of a subset give the same key, in index files, archives and unpacked folders, nested or not. Case is
    ignored, and spaces are underscores, as in later releases.
    """
    *folders, file = PurePosixPath(path).parts
    for depth in range(len(folders) - 1, -1, -1):
        subset = _BY_NAME.get(_plain(folders[depth]))
        if subset:
            rest = "/".join([*folders[depth + 1 :], PurePosixPath(file).stem])
            return f"{subset}/{rest.replace(' ', '_').lower()}"
    return None


def subset_of(key: str) -> str:
    """Returns the folder name of the subset, as in `SUBSETS`, that a key of `key_of` belongs to."""
    return key.split("/", 1)[0]


def read(file: Path | bytes, name: str) -> Recording:
    """Reads a recording, whose numbers must be finite; `name` is used in error messages."""
    with naming(name, ValueError):
        data = read_npz(io.BytesIO(file) if isinstance(file, bytes) else file, skip=("dmpls", "marker_data"))
        width = data["poses"].shape[-1] if "poses" in data and data["poses"].ndim else 0
        if width == 165 or "surface_model_type" in data:
            raise UserError("this is AMASS's SMPL-X release; download the SMPL+H G release")
        if missing := [key for key in ("poses", "trans", "betas", "gender", "mocap_framerate") if key not in data]:
            raise UserError(f"not a motion of AMASS's SMPL+H G release: {', '.join(missing)} missing")
        poses, translation, betas, gender = (data[key] for key in ("poses", "trans", "betas", "gender"))
        if poses.ndim != 2 or width != 156 or translation.shape != (len(poses), 3):
            raise UserError(f"poses {poses.shape} and trans {translation.shape}, not (F, 156) and (F, 3)")
        numbers = (poses, translation, betas)
        if {array.dtype.kind for array in numbers} - set("fiu") or betas.ndim != 1 or gender.size != 1:
            raise UserError("poses, trans and betas must be arrays of real numbers, and gender a single word")
        if not all(np.isfinite(array).all() for array in numbers):
            raise UserError("contains non-finite numbers")
        check_frames(len(poses))
        fps = frame_rate(data["mocap_framerate"], "mocap_framerate")
        word = gender.item()
        return Recording(poses, translation, betas, word.decode() if isinstance(word, bytes) else str(word), fps)


class Amass:
    """A folder with AMASS: downloaded archives, unpacked subsets, or both."""

    def __init__(self, root: Path):
        self.root = Path(root)

    @cached_property
    def files(self) -> dict[str, Path]:
        """Key of each unpacked recording -> its file."""
        files = {}
        for folder, _, names in os.walk(required(self.root, GET_IT)):
            inside = Path(folder).relative_to(self.root).as_posix()
            for name in names:
                if name.endswith(".npz") and (key := key_of(f"{inside}/{name}")):
                    files[key] = Path(folder, name)
        return files

    @cached_property
    def archives(self) -> dict[str, Path]:
        """Subset -> its archive, recognized by file name."""
        archives = {}
        for ending in ARCHIVE_ENDINGS:
            for path in sorted(self.root.rglob(f"*{ending}")):
                subset = _BY_NAME.get(_plain(path.name.removesuffix(ending)))
                if subset:
                    archives[subset] = path
        return archives

    def missing(self, keys: Collection[str]) -> list[str]:
        """Returns one line per subset with missing recordings; archives are not opened, so not checked."""
        lines = []
        stems = {subset_of(key): key.endswith("_stageii") for key in self.files}
        for subset, members in sorted(_by_subset(keys).items()):
            absent = [key for key in members if key not in self.files]
            if not absent or subset in self.archives:
                continue
            names = " or ".join((subset, *SUBSETS[subset]))
            if len(absent) < len(members):
                lines.append(f"{subset}: {len(absent)} of {len(members)} recordings are missing, such as {min(absent)}")
            elif stems.get(subset):
                lines.append(f"{subset}: this is the SMPL-X release (files end in _stageii); download SMPL+H G")
            else:
                lines.append(f"{subset}: missing ({len(members)} recordings); the archive is called {names}")
        return lines

    def map(
        self, arguments: Mapping[str, Argument], function: Callable[[Argument, Recording], Result], workers: int = 0
    ) -> Iterator[tuple[str, Result]]:
        """Yields (key, `function(arguments[key], recording)`) for the keys of `key_of`, sorted, from worker processes.

        Function and arguments are picklable; the file name is prepended to its `UserError`s.
        """
        if absent := self.missing(arguments):
            raise FileNotFoundError(f"{self.root}: {'; '.join(absent)}")
        tasks: list[tuple[_Files, dict[str, Argument]]] = []
        for subset, keys in sorted(_by_subset(arguments).items()):
            if all(key in self.files for key in keys):
                chunks = [sorted(keys)[begin : begin + CHUNK] for begin in range(0, len(keys), CHUNK)]
                tasks += [({k: self.files[k] for k in chunk}, {k: arguments[k] for k in chunk}) for chunk in chunks]
            else:
                tasks.append((self.archives[subset], {key: arguments[key] for key in sorted(keys)}))
        # An archive takes minutes: this process must not begin with one alone.
        for results in in_order(partial(_run, function), tasks, min(workers or cores(), len(tasks))):
            yield from results


def _by_subset(keys: Collection[str]) -> dict[str, list[str]]:
    groups = defaultdict(list)
    for key in keys:
        groups[subset_of(key)].append(key)
    return groups


def _run(
    function: Callable[[Argument, Recording], Result], task: tuple[_Files, dict[str, Argument]]
) -> list[tuple[str, Result]]:
    files, arguments = task
    results = {}
    for key, name, file in _contents(files, arguments):
        with naming(name):
            results[key] = function(arguments[key], read(file, name))
    return [(key, results[key]) for key in arguments]


def _contents(files: _Files, keys: Collection[str]) -> Iterator[tuple[str, str, Path | bytes]]:
    """Yields key, name and content of the recordings in an archive or a set of files."""
    if isinstance(files, dict):
        yield from ((key, str(path), path) for key, path in files.items())
        return
    left, is_smplx = set(keys), False
    for name, content in archives.members(files, lambda name: name.endswith(".npz") and key_of(name) in left):
        is_smplx |= name.endswith("_stageii.npz")
        if content and (key := key_of(name)):
            left.remove(key)
            yield key, f"{files}/{name}", content
        if not left:
            return
    if is_smplx:
        raise UserError(f"{files}: this is AMASS's SMPL-X release (_stageii.npz); download the SMPL+H G release")
    raise UserError(f"{files}: {len(left)} recordings are missing in the archive, such as {min(left)}")


class Body(NamedTuple):
    """Rest joints of SMPL+H (the first 22), meters: `rest` (22, 3) of the mean shape, `shape` (22, 3, 10) per beta."""

    rest: torch.Tensor
    shape: torch.Tensor

    def joints(self, recording: Recording) -> np.ndarray:
        """Returns joints (F, 22, 3) float64 in meters, y up as in HumanML3D: AMASS's (-x, z, y).

        These joints do not depend on the other 30, which are finger joints; soft tissue and pose correctives move
        only the surface.
        """
        betas = torch.from_numpy(recording.betas[:10].astype(np.float64))
        rest = self.rest + self.shape[..., : len(betas)] @ betas
        poses = torch.from_numpy(recording.poses[:, :66].astype(np.float64)).unflatten(1, (22, 3))
        root = torch.from_numpy(recording.translation.astype(np.float64)) + rest[0]
        turned = rotation.axis_angle_to_matrix(poses)
        joints = forward_kinematics(SMPL22, turned, SMPL22.bones(rest), root)
        return (joints[..., [0, 2, 1]] * joints.new_tensor([-1.0, 1.0, 1.0])).numpy()


def load_bodies(folder: Path) -> dict[str, Body]:
    """Loads the bodies `male` and `female` of the extended SMPL+H model: only template, shape and joint regressor.

    The folder contains `male/model.npz` and `female/model.npz` (from the model's archive), or `SMPLH_MALE.npz` and
    `SMPLH_FEMALE.npz`, directly or in a subfolder `smplh`.
    """
    return {gender: _load_body(Path(folder), gender) for gender in ("male", "female")}


_MODEL = ("J_regressor", "v_template", "shapedirs")


def _load_body(folder: Path, gender: str) -> Body:
    names = (f"{gender}/model.npz", f"SMPLH_{gender.upper()}.npz")
    candidates = [folder / inner / name for inner in ("", "smplh") for name in names]
    path = next((path for path in candidates if path.is_file()), None)
    if path is None:
        raise FileNotFoundError(
            f"{folder}: contains neither {' nor '.join(names)}; download the extended SMPL+H model from "
            "https://mano.is.tue.mpg.de"
        )
    with naming(path, ValueError, KeyError, IndexError, what="not an SMPL+H model: "):
        arrays = read_npz(path, only=(*_MODEL, "kintree_table"))
        regressor, template, directions = (arrays[key] for key in _MODEL)
        parents, vertices = arrays["kintree_table"][0, 1:22], regressor.shape[1:]
        if {array.dtype.kind for array in arrays.values()} - set("fiu"):
            raise ValueError("its arrays do not all contain real numbers")
        if (template.shape, directions.shape[:2], directions.ndim) != ((*vertices, 3), (*vertices, 3), 3):
            raise ValueError(f"its arrays have shapes {regressor.shape}, {template.shape} and {directions.shape}")
        if regressor.shape[0] != 52 or tuple(parents) != SMPL22.parents[1:]:
            raise UserError(f"a model with {regressor.shape[0]} joints, not SMPL+H with 52")
    regressor = regressor[:22].astype(np.float64)
    shape = np.einsum("jv,vck->jck", regressor, directions[..., :10].astype(np.float64))
    return Body(torch.from_numpy(regressor @ template.astype(np.float64)), torch.from_numpy(shape))
