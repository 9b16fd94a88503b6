"""Motion files: what other programs read and write. `docs/formats.md` has units, axes and joints of each.

The 6D rotations among the 263 features of HumanML3D are not SMPL's: they follow chains of their own and leave open how
a bone is turned about itself. So no rotation is ever taken from them; rotations come from joint positions
(`flame_mdm.formats.poses`), or from features and files that hold SMPL's.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flame_mdm.data import bvh
from flame_mdm.data.folder import read_bvh
from flame_mdm.formats import glb
from flame_mdm.formats.poses import Poses, solve
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SKELETONS, SMPL22, Skeleton
from flame_mdm.representations.smpl import ADULT, read_pose
from flame_mdm.visualize import Motion
from flame_mdm.visualize.scene import written_whole

AMASS_AXES = torch.tensor([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=torch.float64)
"""Turns AMASS's world, z up, to y up as HumanML3D does: (-x, z, y). It is its own inverse."""
CAMERA_AXES = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
"""Turns the camera's world of the action data sets, y down, to y up."""
END_SITES = {
    **{"head": (0.0, 0.18, 0.0), "left_foot": (0.0, 0.0, 0.06), "right_foot": (0.0, 0.0, 0.06)},
    **{"left_wrist": ADULT[22], "right_wrist": ADULT[23]},
}
"""Tips of head, toes and hands beyond the last joints, metres, so that programs draw these bones at all."""
EULER = tuple("YXZ" if name.endswith("shoulder") else "YZX" for name in SMPL22.joints)
"""Order of each joint's angles, so that gimbal lock, the middle angle at 90 degrees, is far from what people do: not in
bent knees, elbows and hips, not in a hanging arm, and not in a body that turns or bows."""
CENTIMETRE = 0.01


@dataclass(eq=False)
class MotionFile(Motion):
    """What a motion file holds.

    Attributes:
        poses: joint rotations, where the file has those of SMPL; None = positions alone.
    """

    poses: Poses | None = None

    def posed(self) -> Poses:
        """The rotations of the file, or those that its joint positions are solved for.

        Raises:
            ValueError: the skeleton is not SMPL's.
        """
        if self.poses is not None:
            return self.poses
        joints = torch.from_numpy(self.joints)
        if self.skeleton.name == "smpl24":
            joints = joints[:, : len(SMPL22)]  # the last two are the hands
        return solve(joints, self.fps)


def read(path: str | Path, fps: float | None = None, unit: float | None = None) -> MotionFile:
    """Reads a motion: `.npz` as `make sample` writes it or as AMASS does, `.bvh`, `.json`, or joints `.npy`.

    Args:
        path: the file.
        fps: frames a second instead of those the file says; an .npy file does not say.
        unit: metres a unit of the file's lengths, for .bvh (default: what its skeleton comes in, mostly centimetres)
            and .npy (default 1).

    Raises:
        FileNotFoundError: there is no such file. ValueError: damaged, of another kind, or without a frame rate.
    """
    path = Path(path)
    reader = _choose(path, {".npz": _read_npz, ".bvh": _read_bvh, ".json": _read_json, ".npy": _read_npy})
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if unit is not None and path.suffix.lower() in (".npz", ".json"):
        raise ValueError(f"{path}: lengths in {path.suffix} files are metres; unit is for .bvh and .npy")
    try:
        return reader(path, fps, unit)
    except ValueError as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def write(motion: MotionFile, path: str | Path) -> str:
    """Writes `.bvh`, `.glb`, `.npz` (as AMASS), `.json` or `.npy` (joints), and says in a line what stands in the file.

    Raises:
        ValueError: another ending, or rotations are wanted for a skeleton that is not SMPL's.
    """
    path = Path(path)
    writer = _choose(
        path, {".bvh": _write_bvh, ".glb": _write_glb, ".npz": _write_amass, ".json": _write_json, ".npy": _write_npy}
    )
    return f"{path}: {len(motion.joints)} frames at {motion.fps:g} a second, {writer(motion, path)}"


def _choose(path: Path, by_ending: dict[str, Callable]) -> Callable:
    if path.suffix.lower() not in by_ending:
        raise ValueError(f"{path}: unknown kind of motion file; there are {', '.join(by_ending)}")
    return by_ending[path.suffix.lower()]


# Reading --------------------------------------------------------------------------------------------------------------


def _read_npz(path: Path, fps: float | None, unit: float | None) -> MotionFile:
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            data = {key: file[key] for key in file.files if key != "dmpls"}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"damaged, or no .npz file of plain arrays: {error}") from error
    if "joints" in data and "fps" in data:
        joints, text = data["joints"], str(data.get("text", ""))
        poses = _poses_of_features(str(data.get("representation", "")), data.get("features"))
        return MotionFile(joints, _rate(fps, data["fps"]), _skeleton(joints), caption=text, id=path.stem, poses=poses)
    given = next((data[key] for key in ("mocap_framerate", "mocap_frame_rate") if key in data), None)
    if "poses" in data and "trans" in data and (fps is not None or given is not None):
        if {data["poses"].dtype.kind, data["trans"].dtype.kind} - set("fiu"):
            raise ValueError("poses and trans are no arrays of real numbers")
        if data["poses"].ndim != 2 or data["trans"].shape != (len(data["poses"]), 3):
            raise ValueError(f"poses {data['poses'].shape} and trans {data['trans'].shape}, not (F, 3 K) and (F, 3)")
        motion = torch.from_numpy(np.concatenate([data["trans"], data["poses"]], 1, dtype=np.float64))
        poses = _smpl_poses(*read_pose(motion), AMASS_AXES)
        return _of_poses(poses, _rate(fps, given), str(data.get("text", "")), path.stem)
    raise ValueError(
        f"it holds {', '.join(data) or 'nothing'}; a motion is joints and fps, or poses, trans and mocap_framerate"
    )


def _smpl_poses(translation: Tensor, rotations: Tensor, axes: Tensor) -> Poses:
    """Poses of SMPL's mean body, turned to y up by `axes` (3, 3)."""
    offsets = torch.tensor(ADULT, dtype=torch.float64)
    rotations = rotations[:, : len(SMPL22)].clone()
    rotations[:, 0] = axes @ rotations[:, 0]
    return Poses(offsets[: len(SMPL22)], rotations, (translation + offsets[0]) @ axes.T)


def _poses_of_features(representation: str, features: np.ndarray | None) -> Poses | None:
    """The rotations in features that are SMPL's; those among HumanML3D's features are not."""
    if features is None or representation not in ("smpl147", "rot6d-25"):
        return None
    x = torch.from_numpy(features).double()
    if representation == "smpl147":
        translation, rows, axes = x[:, :3], x[:, 3:], AMASS_AXES
    else:
        translation, rows, axes = x[:, 144:147], x[:, :144], CAMERA_AXES
    return _smpl_poses(translation, rotation.rot6d_to_matrix(rows.unflatten(1, (24, 6)), "rows"), axes)


def _of_poses(poses: Poses, fps: float, caption: str, name: str) -> MotionFile:
    return MotionFile(poses.joints().float().numpy(), fps, SMPL22, caption=caption, id=name, poses=poses)


def _read_bvh(path: Path, fps: float | None, unit: float | None) -> MotionFile:
    joints, rate = read_bvh(path, given={} if unit is None else {"unit": unit})
    _skeleton(joints)
    tall = float(np.ptp(joints[..., 1], axis=1).max())
    if not 0.3 < tall < 3.5:
        raise ValueError(
            f"the body is {tall:.3g} m tall; say how many metres a unit of the file is: unit=1, 0.01 or 0.0254 (inches)"
        )
    return MotionFile(joints, _rate(fps, rate), SMPL22, id=path.stem)


def _read_json(path: Path, fps: float | None, unit: float | None) -> MotionFile:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        joints, rate, text = np.array(data["joints"], float), _rate(fps, data["fps"]), str(data.get("caption", ""))
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise ValueError(f"no motion in JSON, an object with joints and fps: {error}") from error
    return MotionFile(joints, rate, _skeleton(joints), caption=text, id=path.stem)


def _read_npy(path: Path, fps: float | None, unit: float | None) -> MotionFile:
    try:
        with path.open("rb") as raw:
            joints = np.lib.format.read_array(raw, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ValueError(f"damaged, or no .npy file of numbers: {error}") from error
    if joints.ndim == 2 and joints.shape[1] in (263, 251):
        raise ValueError(
            f"{joints.shape[1]} features of HumanML3D, not joints; the rotations among them are not SMPL's and are "
            "never exported: decode joint positions from them (flame_mdm.representations.humanml) and convert those"
        )
    skeleton = _skeleton(joints)
    if fps is None:
        raise ValueError("an .npy file does not say its frame rate: fps=20")
    return MotionFile(joints * (1.0 if unit is None else unit), fps, skeleton, id=path.stem)


def _rate(asked: float | None, given: Any) -> float:
    """Frames a second: those asked for, or those that the file gives."""
    value = np.asarray(given if asked is None else asked)
    if value.shape or value.dtype.kind not in "fiu" or not 0 < float(value) < float("inf"):
        raise ValueError(f"{value} frames a second, but it has to be one number above 0")
    return float(value)


def _skeleton(joints: np.ndarray) -> Skeleton:
    """The skeleton of joints (F, J, 3), told by their number."""
    if joints.dtype.kind not in "fiu" or not (np.abs(joints) < 1e6).all():
        raise ValueError("joints are no array of real numbers below 1e6")
    for skeleton in SKELETONS.values():
        if joints.ndim == 3 and joints.shape[1:] == (len(skeleton), 3):
            return skeleton
    sizes = " or ".join(f"{len(skeleton)} ({skeleton.name})" for skeleton in SKELETONS.values())
    raise ValueError(f"an array of shape {joints.shape}; joints are (frames, joints, 3) with {sizes} joints")


# Writing --------------------------------------------------------------------------------------------------------------


def _write_bvh(motion: MotionFile, path: Path) -> str:
    poses = motion.posed()
    angles = np.round(np.degrees(continuous_euler(poses.rotations).numpy()), 6)
    rotations = [tuple(f"{axis}rotation" for axis in order) for order in EULER]
    root = np.round(poses.root.numpy() / CENTIMETRE, 5)
    offsets = np.round(poses.offsets.numpy() / CENTIMETRE, 5)
    offsets[0] = 0  # programs disagree on whether the root's channels replace its offset or add to it
    bvh.write(
        bvh.Bvh(
            joints=SMPL22.joints,
            parents=SMPL22.parents,
            offsets=offsets,
            channels=(("Xposition", "Yposition", "Zposition", *rotations[0]), *rotations[1:]),
            end_parents=tuple(SMPL22.joints.index(name) for name in END_SITES),
            end_offsets=np.array(list(END_SITES.values())) / CENTIMETRE,
            frames=np.concatenate([root, angles.reshape(len(angles), -1)], 1),
            fps=motion.fps,
        ),
        path,
    )
    return f"centimetres, y up; {_error(motion, poses)}"


def continuous_euler(matrices: Tensor) -> Tensor:
    """Rotations (F, J, 3, 3) -> Euler angles (F, J, 3) in the orders of `EULER`, radians, free of jumps.

    Of the two triples that stand for a rotation, and of the turns that may be added to each angle, the ones nearest to
    the frame before are taken, so that programs may interpolate; two turns of the body end at 720 degrees.
    """
    turn = 2 * torch.pi
    first = torch.stack([rotation.matrix_to_euler(matrices[:, j], order) for j, order in enumerate(EULER)], 1)
    second = torch.stack([first[..., 0] + torch.pi, torch.pi - first[..., 1], first[..., 2] + torch.pi], -1)
    chosen = [first[0]]
    for pair in torch.stack([first, second], -2)[1:]:
        before = chosen[-1][:, None]
        near = pair - turn * ((pair - before) / turn).round()
        best = (near - before).square().sum(-1).argmin(-1)
        chosen.append(near[torch.arange(len(near)), best])
    return torch.stack(chosen)


def _write_glb(motion: MotionFile, path: Path) -> str:
    poses = motion.posed()
    glb.write(path, poses, _of_poses(poses, motion.fps, motion.caption, motion.id))
    return f"metres, y up; {_error(motion, poses)}"


def _write_amass(motion: MotionFile, path: Path) -> str:
    poses = motion.posed()
    world = poses.rotations.clone()
    world[:, 0] = AMASS_AXES @ world[:, 0]
    turns = rotation.matrix_to_axis_angle(world).flatten(1).numpy()
    with written_whole(path) as temporary:
        np.savez_compressed(
            temporary,
            poses=np.pad(turns, ((0, 0), (0, 90))),  # hands at rest
            trans=(poses.root @ AMASS_AXES.T).numpy() - np.array(ADULT[0]),
            betas=np.zeros(16),
            gender="neutral",
            mocap_framerate=motion.fps,
            text=motion.caption,
        )
    return "SMPL+H poses in axis-angle, metres, z up; bones get the lengths of SMPL's body"


def _write_json(motion: MotionFile, path: Path) -> str:
    content: dict[str, Any] = {
        **{"id": motion.id, "caption": motion.caption, "fps": motion.fps, "unit": "metre", "up": "y"},
        **{"names": motion.skeleton.joints, "parents": motion.skeleton.parents},
        "joints": np.round(motion.joints.astype(float), 5).tolist(),
    }
    with written_whole(path) as temporary:
        temporary.write_text(json.dumps(content, separators=(",", ":"), ensure_ascii=False), encoding="utf-8")
    return f"{len(motion.skeleton)} joints in metres, y up"


def _write_npy(motion: MotionFile, path: Path) -> str:
    with written_whole(path) as temporary:
        np.save(temporary, motion.joints)
    return f"joints {motion.joints.shape} in metres, y up; the file itself does not say its frame rate"


def _error(motion: MotionFile, poses: Poses) -> str:
    """How far joints of constant bones are from those of the motion."""
    off = np.linalg.norm(poses.joints().numpy() - motion.joints[:, : len(SMPL22)], axis=-1)
    mean, most = 1000 * off.mean(), 1000 * off.max()
    return f"bones of constant length, joints {mean:.2g} mm off on average and {most:.2g} mm at most"
