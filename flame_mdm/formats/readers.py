"""Readers of motion files; writers are in `flame_mdm.formats.motion`. `docs/formats.md` describes the files."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.formats import ENDINGS, TREES
from flame_mdm.formats.layouts import array_layout, check_size, map_bvh, read_tree
from flame_mdm.formats.motion import AMASS_AXES, Motion, motion_of_poses
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.resampling import check_frames, frame_pairs, frame_rate, resample
from flame_mdm.representations import rotation
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.skeleton import SKELETONS, SMPL22, Skeleton
from flame_mdm.representations.smpl import ADULT, read_pose
from flame_mdm.safe_io import MEBIBYTE, naming, read_json, read_npy, read_npz, regular_file

CAMERA_AXES = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))  # of the action data sets: y down to y up
ROTATED = {"smpl147": 147, "rot6d-25": 150, "motion272": 272}  # with SMPL's rotations -> number of features
JSON_LIMIT = 128 * MEBIBYTE  # maximum size of a `.json` motion; parsed, it takes many times its size


def read(
    path: str | Path,
    fps: float | None = None,
    unit: float | None = None,
    resample_to: float | None = None,
    fields: Mapping[str, Any] = {},
) -> Motion:
    """Reads a motion: `.npz` of this project, of AMASS or with joints and fps, `.bvh`, `.amc`, `.json`, or `.npy`.

    Args:
        path: the file.
        fps: frames per second, overrides the rate in the file; .npy and .amc files have none.
        unit: meters per unit of length in .bvh, .amc (default: that of the skeleton) and .npy (default 1) files.
        resample_to: target frame rate, None = that of the file; rotations of .bvh and AMASS files are interpolated on
            the sphere, joints with cubic splines.
        fields: fields of `Layout` that override those of a known skeleton, as from `find_skeleton`; `fps` and `unit`
            override them in turn. Not for files written by this project, nor for AMASS.

    Raises `FileNotFoundError`, or `UserError` if the file is damaged, of another kind, in a wrong unit or without rate.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in ENDINGS:
        raise UserError(f"{path}: unknown kind of motion file. Use one of {', '.join(ENDINGS)}")
    regular_file(path)
    if unit is not None and suffix in (".npz", ".json"):
        raise UserError(f"{path}: lengths in {suffix} files are in meters; unit is only for .bvh, .amc and .npy")
    fields = fields if unit is None else {**fields, "unit": unit}
    with naming(path):
        rate = None if fps is None else frame_rate(fps)
        if suffix not in TREES:
            return _of_arrays(path, rate, resample_to, fields)
        file = read_tree(path, fields.get("fps") if suffix == ".amc" and rate is None else rate)
        joints, layout = map_bvh(file, resample_to, fields)
        check_size(joints, layout.unit, layout.children)
        return Motion(joints, resample_to or file.fps, id=path.stem)


def _of_arrays(path: Path, rate: float | None, resample_to: float | None, fields: Mapping[str, Any]) -> Motion:
    """Returns the motion in an .npz, .json or .npy file; the arguments are those of `read`."""
    data = read_arrays(path)
    if "text" in data:  # written by this project
        fields = {}
    rate = data.get("fps", fields.get("fps")) if rate is None else rate
    if rate is None:
        raise UserError("no frame rate in the file: set it, for example with fps=20")
    data["fps"] = frame_rate(rate)
    text = str(data.get("text", ""))
    if "joints" not in data:
        translation, turns = smpl_motion(data, resample_to)
        poses = _smpl_poses(translation, rotation.quaternion_to_matrix(turns), AMASS_AXES)
        return motion_of_poses(poses, resample_to or data["fps"], text, path.stem)
    if {"joints", "map", "up", "mirrored"} & set(fields) or data["joints"].shape[1:2] in ((52,), (77,)):
        layout, names = array_layout(data["joints"], fields)
        data = {"fps": data["fps"], "joints": layout.apply(data["joints"].astype(float), names)}
        fields = {"unit": layout.unit, "children": layout.children}
    elif "unit" in fields:
        data["joints"] = data["joints"] * fields["unit"]
    if fields and data["joints"].shape[1:] == (len(SMPL22), 3):
        check_size(data["joints"], fields.get("unit", 1.0), fields.get("children", False))
    joints, fps = data["joints"], data["fps"]
    skeleton = _skeleton(joints)
    if resample_to is not None and not math.isclose(fps, resample_to):
        joints = resample(joints.astype(float), fps, resample_to, cubic=True)
        return Motion(joints, resample_to, skeleton, text, path.stem)
    motion = Motion(joints, fps, skeleton, text, path.stem, _poses(data))
    if "features" in data:
        motion.features = data["features"].astype(np.float32)
        motion.representation = str(data.get("representation", ""))
    return motion


def from_array(joints: Any, fps: float | None) -> Motion:
    """Returns a motion of joints (F, J, 3) in meters, y up, of the built-in skeleton with this number of joints."""
    values = joints.detach().cpu().numpy() if isinstance(joints, Tensor) else np.asarray(joints)
    if not _is_real(values):
        name = type(joints).__name__
        raise UserError(f"{name}: not a motion. Give a path, a Motion, or an array of joints (frames, joints, 3)")
    _check_numbers("joints", values)
    skeleton = _skeleton(values)
    if fps is None:
        raise UserError("an array has no frame rate: set it, for example with fps=20")
    return Motion(values, frame_rate(fps), skeleton)


def read_arrays(path: Path) -> dict[str, Any]:
    """Reads the arrays of an .npz, .json or .npy motion: joints, or poses and trans as in AMASS; and fps if present."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        data: dict[str, Any] = read_npz(path, skip=("dmpls",))
    elif suffix == ".npy":
        data = {"joints": read_npy(path)}
    else:
        data = _read_json(path)
    if "posed_joints" in data:  # of NVIDIA's Kimodo, whose files do not contain their rate
        data = {"fps": 30.0, **data, "joints": data["posed_joints"]}
    if not {"joints", "poses"} & set(data):
        names = ", ".join(data) or "nothing"
        raise UserError(f"contains {names}; a motion has joints and fps, or poses, trans and mocap_framerate")
    for name in {"joints", "poses", "trans"} & set(data):
        _check_numbers(name, data[name])
    if "features" in data and (not _is_real(data["features"]) or data["features"].ndim != 2):
        raise UserError("features are not an array (frames, features) of real numbers")
    if "poses" in data and data.get("trans", np.zeros(0)).shape != (len(data["poses"]), 3):
        raise UserError("AMASS files have poses (F, 3 K), trans (F, 3) and mocap_framerate")
    for key in ("fps", "mocap_framerate", "mocap_frame_rate"):
        if key in data:
            data["fps"] = frame_rate(data[key], key)
    return data


def _is_real(values: np.ndarray) -> bool:
    return values.dtype.kind in "fiu" and values.dtype.itemsize <= 8


def _check_numbers(name: str, values: np.ndarray) -> None:
    if not _is_real(values):
        raise UserError(f"{name} are not an array of real numbers")
    if not values.ndim or not len(values):
        raise UserError(f"{name} of shape {values.shape} have no frames")
    check_frames(len(values))
    if (beyond := ~(np.abs(values) < 1e6)).any():
        raise UserError(f"numbers of {name} in frame {np.argwhere(beyond)[0][0]} are not finite, or exceed a million")


def _read_json(path: Path) -> dict[str, Any]:
    data = read_json(path, JSON_LIMIT)
    try:
        return {"joints": np.array(data["joints"], float), "fps": data["fps"], "text": str(data.get("caption", ""))}
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise UserError(f"not a motion in JSON, which is an object with joints and fps: {error}") from error


def smpl_motion(data: dict[str, Any], fps: float | None = None) -> tuple[Tensor, Tensor]:
    """Returns translation (F, 3) and quaternions (F, 24, 4), float64, of AMASS arrays, resampled to `fps` if given."""
    poses = data["poses"].reshape(len(data["poses"]), -1)
    frames = None if fps is None else frame_pairs(len(poses), data["fps"], fps, poses.shape[1] // 3)
    translation, rotations = read_pose(torch.from_numpy(np.concatenate([data["trans"], poses], 1)))
    turns = rotation.matrix_to_quaternion(rotations)
    if fps is None or frames is None:
        return translation, turns
    before, after, share = frames
    turns = rotation.slerp(turns[before], turns[after], torch.from_numpy(share)[:, None, None])
    return torch.from_numpy(resample(translation.numpy(), data["fps"], fps)), turns


def _smpl_poses(translation: Tensor, rotations: Tensor, axes: Tensor) -> Poses:
    """Returns poses of SMPL's mean body, rotated to y up by `axes` (3, 3)."""
    offsets = torch.tensor(ADULT, dtype=torch.float64)
    rotations = rotations[:, : len(SMPL22)].clone()
    rotations[:, 0] = axes @ rotations[:, 0]
    return Poses(offsets[: len(SMPL22)], rotations, (translation + offsets[0]) @ axes.T)


def _poses(data: dict[str, Any]) -> Poses | None:
    """Returns the rotations stored with joints, from AMASS arrays or SMPL features; HumanML3D features contain none."""
    if "poses" in data:
        if len(data["poses"]) != len(data["joints"]):
            raise UserError(f"{len(data['poses'])} frames of poses, but {len(data['joints'])} of joints")
        translation, turns = smpl_motion(data)
        return _smpl_poses(translation, rotation.quaternion_to_matrix(turns), AMASS_AXES)
    representation = str(data.get("representation", ""))
    if "features" not in data or representation not in ROTATED:
        return None
    expected = (len(data["joints"]), ROTATED[representation])
    if data["features"].shape != expected:
        raise UserError(f"features of shape {data['features'].shape}, but {representation} has {expected}")
    x = torch.from_numpy(data["features"]).double()
    if representation == "motion272":
        pelvis, turns = Motion272().poses(x)
        return Poses(torch.tensor(ADULT[: len(SMPL22)], dtype=torch.float64), turns, pelvis)
    if representation == "smpl147":
        translation, rows, axes = x[:, :3], x[:, 3:], AMASS_AXES
    else:
        translation, rows, axes = x[:, 144:147], x[:, :144], CAMERA_AXES
    return _smpl_poses(translation, rotation.rot6d_to_matrix(rows.unflatten(1, (24, 6)), "rows"), axes)


def _skeleton(joints: np.ndarray) -> Skeleton:
    """Returns the skeleton of joints (F, J, 3), identified by the number of joints."""
    for skeleton in SKELETONS.values():
        if joints.ndim == 3 and joints.shape[1:] == (len(skeleton), 3):
            return skeleton
    sizes = " or ".join(f"{len(skeleton)} ({skeleton.name})" for skeleton in SKELETONS.values())
    raise UserError(f"joints of shape {joints.shape}, not (frames, joints, 3) with {sizes} joints")
