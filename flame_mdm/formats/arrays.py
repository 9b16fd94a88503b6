"""Motion files with arrays of joint positions or SMPL rotations: `.npz`, `.npy`, `.json`."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.formats.resampling import check_frames, frame_pairs, frame_rate, resample
from flame_mdm.representations import rotation
from flame_mdm.representations.smpl import AXIS_ANGLES, read_pose
from flame_mdm.safe_io import MEBIBYTE, read_json, read_npy, read_npz

# Maximum size in bytes of a `.json` motion, which takes several times as much memory once it is
# parsed
JSON_LIMIT = 128 * MEBIBYTE
RATES = (
    "fps",
    "mocap_framerate",
    "mocap_frame_rate",
)  # names under which files store the frame rate
# Names under which AMASS's SMPL-X files store the parts of `poses`
BODY = ("root_orient", "pose_body")
NEEDED = {
    "joints",
    "posed_joints",
    "poses",
    "trans",
    *BODY,
    *RATES,
    "text",
    "features",
    "representation",
}
"""Arrays that are read from an .npz file.

Other arrays are never loaded, because they may contain pickled objects.
"""
LENGTHS = {
    "m": 1.0,
    "meter": 1.0,
    "metre": 1.0,
    "cm": 0.01,
    "centimeter": 0.01,
    "centimetre": 0.01,
    "mm": 0.001,
}
"""Length in meters of each unit that a `.json` file may name."""
NUMBERS = ", ".join(map(str, AXIS_ANGLES))


def read_arrays(path: Path) -> dict[str, Any]:
    """Reads the arrays in an .npz, .json or .npy motion file.

    The result contains either `joints` or, as in AMASS, `poses` (F, 72) and `trans` (F, 3). The
    following entries are added if the file contains them: `fps`, `text`, `features`,
    `representation` and, for `.json` files, `up`, `unit` and `names`. `ours` is True if this
    project wrote the file.
    """
    suffix = path.suffix.lower()
    if suffix == ".npz":
        data: dict[str, Any] = read_npz(path, only=NEEDED)
        data["ours"] = "joints" in data and bool({"text", "features"} & data.keys())
    elif suffix == ".npy":
        data = {"joints": read_npy(path), "ours": False}
    else:
        data = _read_json(path)

    if "posed_joints" in data:  # a file from NVIDIA's Kimodo, which contains no frame rate
        data = {"fps": 30.0, **data, "joints": data["posed_joints"]}
    if "poses" not in data and set(BODY) <= data.keys():
        data["poses"] = _joined([data[name] for name in BODY])
    if not {"joints", "poses"} & data.keys():
        raise UserError(
            "contains neither joints nor poses. A motion needs either joints and fps, or poses, trans and a frame rate"
        )
    for name in {"joints", "poses", "trans"} & data.keys():
        check_numbers(name, data[name])
    if "features" in data and (not is_real(data["features"]) or data["features"].ndim != 2):
        raise UserError("features must be an array of real numbers with shape (frames, features)")
    if "poses" in data:
        data["poses"] = _axis_angles(data["poses"])
        if data.get("trans", np.zeros(0)).shape != (len(data["poses"]), 3):
            raise UserError(
                "poses require trans, an array of shape (frames, 3) with the same number of frames, as in AMASS"
            )
    for key in RATES:
        if key in data:
            data["fps"] = frame_rate(data[key], key)
    return data


def is_real(values: np.ndarray) -> bool:
    """Returns whether an array contains integers or floats that PyTorch can convert."""
    return values.dtype.kind in "fiu" and values.dtype.itemsize <= 8


def smpl_motion(data: dict[str, Any], fps: float | None = None) -> tuple[Tensor, Tensor]:
    """Converts AMASS arrays to a translation (F, 3) and quaternions (F, 24, 4).

    Both are float64. If `fps` is given, the motion is resampled.
    """
    poses = data["poses"]
    frames = None if fps is None else frame_pairs(len(poses), data["fps"], fps, poses.shape[1] // 3)
    translation, rotations = read_pose(torch.from_numpy(np.concatenate([data["trans"], poses], 1)))
    turns = rotation.matrix_to_quaternion(rotations)
    if fps is None or frames is None:
        return translation, turns
    before, after, share = frames
    turns = rotation.slerp(turns[before], turns[after], torch.from_numpy(share)[:, None, None])
    return torch.from_numpy(resample(translation.numpy(), data["fps"], fps, cubic=True)), turns


def _joined(parts: list[np.ndarray]) -> np.ndarray:
    try:
        return np.concatenate([part.reshape(len(part), -1) for part in parts], 1)
    except (TypeError, ValueError) as error:
        raise UserError(
            f"{' and '.join(BODY)} must be arrays with the same number of frames"
        ) from error


def _axis_angles(poses: np.ndarray) -> np.ndarray:
    """Returns the axis-angle vectors (F, 72) of SMPL's joints.

    If the file does not contain the hands' rotations, the vectors of the hands are 0.
    """
    count = int(np.prod(poses.shape[1:]))
    if poses.ndim > 3 or (poses.ndim == 3 and poses.shape[2] != 3) or count not in AXIS_ANGLES:
        advice = ""
        if count in (9 * joints for joints in AXIS_ANGLES.values()):
            advice = ". They seem to be rotation matrices. Convert them to axis-angle vectors"
        elif count in (6 * joints for joints in AXIS_ANGLES.values()):
            advice = ". They seem to be 6D rotations. Convert them to axis-angle vectors"
        raise UserError(
            f"poses have shape {poses.shape}; expected {NUMBERS} axis-angle numbers per frame{advice}"
        )
    vectors = poses.reshape(len(poses), count)[:, :72].astype(float)
    return np.pad(vectors, ((0, 0), (0, 72 - vectors.shape[1])))


def check_numbers(name: str, values: np.ndarray) -> None:
    """Checks the numbers in an array with one entry per frame.

    Raises:
        UserError: If the array has no frames or too many frames, or if a number is not real, is not
            finite, or has an absolute value of a million or more.
    """
    if not is_real(values):
        raise UserError(f"{name} must be an array of real numbers")
    if not values.ndim or not len(values):
        raise UserError(f"{name} have no frames (shape {values.shape})")
    check_frames(len(values))
    if (beyond := ~(np.abs(values.astype(float)) < 1e6)).any():
        raise UserError(
            f"{name} in frame {np.argwhere(beyond)[0][0]} contain NaN, infinity or numbers "
            "that are too large (a million or more)"
        )


def _read_json(path: Path) -> dict[str, Any]:
    content = read_json(path, JSON_LIMIT)
    try:
        data: dict[str, Any] = {
            "joints": np.array(content["joints"], float),
            "text": str(content.get("caption", "")),
        }
        data |= {key: content[key] for key in ("fps", "up", "names") if key in content}
        if "unit" in content:
            data["unit"] = LENGTHS.get(str(content["unit"]).lower(), content["unit"])
    except (AttributeError, ValueError, TypeError, KeyError, OverflowError) as error:
        raise UserError(
            f"not a JSON motion: expected an object with joints and fps ({error})"
        ) from error
    data["ours"] = "caption" in content and (data.get("up"), data.get("unit")) == ("y", 1.0)
    return data
