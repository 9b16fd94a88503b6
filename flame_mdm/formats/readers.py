"""Reads motion files. The writers are in `flame_mdm.formats.motion`.

`docs/formats.md` describes the file formats. The commands, data sets and the Python API all use
this reader, so that a file always has the same skeleton and frame rate and passes the same checks.
"""

import math
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from flame_mdm.errors import UserError
from flame_mdm.formats import ENDINGS, SCENES, TREES, checks, scenes, unread
from flame_mdm.formats.arrays import check_numbers, is_real, read_arrays, smpl_motion
from flame_mdm.formats.bones import bone_poses
from flame_mdm.formats.bvh import Bvh, forward_kinematics
from flame_mdm.formats.layouts import (
    UP,
    Layout,
    array_layout,
    check_order,
    find_layout,
    find_skeleton,
    layout_name,
    read_tree,
    skeleton_file,
    tree_layout,
)
from flame_mdm.formats.motion import AMASS_AXES, Motion, motion_of_poses
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.recordings import known_rate
from flame_mdm.formats.resampling import frame_rate, resample
from flame_mdm.representations import rotation
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.skeleton import SKELETONS, SMPL22, Skeleton
from flame_mdm.representations.smpl import ADULT
from flame_mdm.safe_io import naming, regular_file

# Rotation from the camera axes of the action data sets (y down) to y up
CAMERA_AXES = torch.diag(torch.tensor([1.0, -1, -1], dtype=torch.float64))
# Number of features of the representations that contain SMPL's rotations
ROTATED = {
    "smpl147": 147,
    "rot6d-25": 150,
    "motion272": 272,
}
BODY_AXES = {"z": AMASS_AXES, "y": torch.eye(3, dtype=torch.float64), "-y": CAMERA_AXES}
"""For each possible up axis in a file with SMPL's rotations, the rotation to y up.

As in AMASS, the default is z.
"""
PELVIS = (0.0, -0.223, 0.028)
"""Pelvis position in SMPL's template, in meters and in the axes of the file.

A body with translation 0 is at this position, for any rotation.
"""

Standard = Callable[[Bvh], tuple[Bvh, Mapping[str, Any]]]
"""A function that changes the joint tree of a published data set.

It returns the new tree and fields of `Layout`. If there are no fields, the layout is determined
from the file.
"""


@dataclass(frozen=True)
class Doubts:
    """Properties of a motion that look wrong but may be intended.

    Attributes:
        upright: mean vertical component of the trunk direction, from -1 to 1. NaN (not measured)
            for files from this project and for KIT-ML's skeleton.
        lying: a message if the body is lying, otherwise "".
        jump: a message if the body jumps or a leg flips, otherwise "".
    """

    upright: float = math.nan
    lying: str = ""
    jump: str = ""

    @property
    def lines(self) -> list[str]:
        """The messages, one line each."""
        return [line for line in (self.lying, self.jump) if line]


@dataclass(frozen=True, eq=False)
class Recording:
    """A motion that was read from a file, and additional information from the reader.

    Attributes:
        motion: the motion. Its notes are messages for the user.
        layout: skeleton, unit and frame rate of the file, as listed by `prepare`.
        doubts: properties that look wrong. The motion's notes also list them.
        smpl: SMPL's translation (F, 3) and quaternions (F, 24, 4) in AMASS's axes, or None if the
            file does not contain them.
        tree: the joint tree, without rest-pose frames and at the frame rate of the file, or None if
            the file contains no tree.
    """

    motion: Motion
    layout: str
    doubts: Doubts = field(default_factory=Doubts)
    smpl: tuple[Tensor, Tensor] | None = None
    tree: Bvh | None = None


def read(
    path: str | Path,
    fps: float | None = None,
    unit: float | None = None,
    up: str | None = None,
    resample_to: float | None = None,
    animation: str | None = None,
) -> Motion:
    """Reads a motion file.

    Supports `.npz` files that come from this project or AMASS or that contain joints and fps;
    `.bvh` files; animations in `.fbx`, `.glb`, `.vrm` and `.vrma` files; and `.amc`, `.json` and
    `.npy` files.

    Args:
        path: the file. Unless this project wrote the file, it is described by the nearest
            `skeleton.yaml` in its folder or a parent folder. `fps`, `unit` and `up` override this
            description.
        fps: frames per second; overrides the rate in the file. .npy and .amc files contain no frame
            rate.
        unit: meters per unit of length in the file. Does not apply to files with SMPL's rotations,
            such as AMASS files.
        up: the up axis of the file: y, z or -y.
        resample_to: target frame rate, or None for the frame rate of the file. Rotations are
            interpolated on the sphere. Joint positions and translations are interpolated with cubic
            splines.
        animation: name or 1-based number of an animation in an FBX or GLB file, or None for the
            first animation.

    Returns:
        The motion. Its `notes` state what was left out and what looks wrong.

    Raises:
        FileNotFoundError: If there is no such file.
        UserError: If the file is damaged or of an unsupported type, if it has no frame rate, if the
            body is not the size of a person, or if an argument has no effect on the file.

    Example:
        >>> walk = read("walk.bvh", resample_to=20)
        Traceback (most recent call last):
        ...
        FileNotFoundError: walk.bvh...
    """
    return read_recording(path, resample_to, fps=fps, unit=unit, up=up, animation=animation).motion


def read_recording(
    path: str | Path,
    resample_to: float | None = None,
    *,
    fps: float | None = None,
    unit: float | None = None,
    up: str | None = None,
    animation: str | None = None,
    as_smpl: bool = False,
    standard: Standard | None = None,
) -> Recording:
    """Reads and checks a motion; see `read` for arguments and errors.

    If `as_smpl` is set, all arrays are mapped to SMPL's 22 joints. Otherwise, arrays with KIT-ML's
    21 joints or with SMPL's hands keep their joints. `standard` is a function that changes the
    joint tree of a published data set. With such a function, the root is resampled linearly, as in
    the published version.
    """
    path = Path(path)
    if path.suffix.lower() not in ENDINGS:
        raise unread(path)
    regular_file(path)
    said = {key: value for key, value in (("unit", unit), ("up", up)) if value is not None}
    rate = None if fps is None else frame_rate(fps)
    fields = find_skeleton(path, up) | said
    if animation is not None and path.suffix.lower() not in SCENES:
        raise UserError(
            f"{path}: animation={animation} has no effect, because {path.suffix} files contain only one animation. "
            "Remove animation="
        )
    with naming(path, ValueError):
        if path.suffix.lower() in SCENES:
            return _of_scene(path, animation, rate, resample_to, fields)
        if path.suffix.lower() in TREES:
            return _of_tree(path, rate, resample_to, fields, standard)
        data = read_arrays(path)
        if data["ours"]:
            return _of_ours(path, data, rate, resample_to, fields, said, as_smpl)
        if "joints" in data:
            return _of_joints(path, data, rate, resample_to, fields, said, as_smpl)
        return _of_smpl(path, data, rate, resample_to, fields)


def from_array(joints: Any, fps: float | None) -> Motion:
    """Converts joints (F, J, 3) in meters, with y up, to a motion.

    The skeleton is the built-in skeleton with the same number of joints.
    """
    values = joints.detach().cpu().numpy() if isinstance(joints, Tensor) else np.asarray(joints)
    if not is_real(values):
        name = type(joints).__name__
        raise UserError(
            f"{name}: not a motion. Pass a path, a Motion, or an array of joints (frames, joints, 3)"
        )
    check_numbers("joints", values)
    skeleton = _skeleton(values)
    if fps is None:
        raise UserError("an array has no frame rate. Pass one, for example fps=20")
    return Motion(values, frame_rate(fps), skeleton)


def _of_tree(
    path: Path,
    rate: float | None,
    resample_to: float | None,
    fields: Mapping[str, Any],
    standard: Standard | None,
) -> Recording:
    _refuse(fields, ["joints"], "BVH and AMC files contain the names of their joints")
    tree = read_tree(
        path, fields.get("fps") if rate is None and path.suffix.lower() == ".amc" else rate
    )
    notes = []
    if (people := tree.parents.count(-1)) > 1:
        notes.append(f"the file contains {people} people (ROOT), but only the first one is read")

    if standard is not None:
        tree, standard_fields = standard(tree)
        fields = standard_fields or fields
    layout, names = tree_layout(tree, fields)
    if (
        standard is None
        and rate is None
        and (recorded := known_rate(path.stem, layout_name(layout), tree.fps))
    ):
        notes.append(
            f"CMU recorded this motion at {recorded:g} frames per second, not {tree.fps:g} as the file states. "
            "The recorded rate is used"
        )
        tree = replace(tree, fps=recorded)

    joints, in_front = layout.apply(tree.positions(), names), None
    if start := checks.rest_frames(joints, tree.fps):
        notes.append(_rest_note(start))
        in_front = replace(tree, frames=tree.frames[:1]).rotations()[0]
        tree, joints = replace(tree, frames=tree.frames[start:]), joints[start:]
    checks.check_body(joints, layout)
    doubts = _doubts(joints, tree.fps, layout.up, np.array(UP[layout.up], float))
    label = _label(path, layout, tree.fps)

    fps, local = tree.fps, (tree.rotations(), tree.translations())
    if resample_to is not None and not math.isclose(resample_to, fps):
        fps, local = resample_to, tree.resample(resample_to, cubic=standard is None)
    positions, worlds = forward_kinematics(tree.parents, *local)
    joints = layout.apply(positions, names)
    motion = Motion(joints, fps, id=path.stem, notes=(*notes, *doubts.lines))
    if standard is None:
        motion.bones = bone_poses(tree, layout, joints, worlds, in_front)
    return Recording(motion, label, doubts, tree=tree)


def _of_scene(
    path: Path,
    animation: str | None,
    rate: float | None,
    resample_to: float | None,
    fields: Mapping[str, Any],
) -> Recording:
    """Reads the recording in a file with animated nodes.

    The positions are in meters, with y up, unless `fields` specify otherwise.
    """
    _refuse(fields, ["joints"], "FBX and GLB files contain the names of their joints")
    scene = scenes.read(path, animation)
    rate = scene.fps if rate is None else rate
    names = scenes.joint_names(scene)
    layout = find_layout(names, fields)
    if "unit" not in fields:
        layout = layout.model_copy(update={"unit": scene.unit})
    joints = layout.apply(scene.positions / scene.unit, names)

    notes = []
    if start := checks.rest_frames(joints, rate):
        notes.append(_rest_note(start))
        joints = joints[start:]
    checks.check_body(joints, layout)
    doubts = _doubts(joints, rate, layout.up, np.array(UP[layout.up], float))
    motion = Motion(joints, rate, text="", id=path.stem, notes=(*notes, *doubts.lines))
    return Recording(_resampled(motion, resample_to), _label(path, layout, rate), doubts)


def _of_joints(
    path: Path,
    data: dict[str, Any],
    rate: float | None,
    resample_to: float | None,
    fields: dict[str, Any],
    said: dict[str, Any],
    as_smpl: bool,
) -> Recording:
    """Converts an array of joints to a recording.

    `said` contains the keys that were set in the command. They override the keys in the file.
    """
    rate, joints = _rate(data, rate, fields), data["joints"]
    stated = {key: data[key] for key in ("up", "unit") if key in data}
    fields = _checked(fields | stated | said)
    names = tuple(data.get("names", ()))
    # Without names, the number of joints determines the skeleton.
    is_counted = not names and not {"joints", "map"} & fields.keys()
    if (
        names
        and not {"joints", "map"} & fields.keys()
        and all(names != s.joints for s in SKELETONS.values())
    ):
        fields["joints"] = list(names)

    if (
        as_smpl
        or {"joints", "map"} & fields.keys()
        or joints.shape[1:2] not in [(len(s),) for s in SKELETONS.values()]
    ):
        layout, names = array_layout(joints, fields)
        joints, skeleton, assumed = (
            layout.apply(joints.astype(float), names),
            SMPL22,
            layout_name(layout),
        )
    else:
        layout, skeleton, assumed = Layout(**fields), _skeleton(joints), "SMPL"
        joints = layout.turn(joints.astype(float)).astype(np.float32)

    notes, doubts, start = [], Doubts(), 0
    if skeleton.joints[: len(SMPL22)] == SMPL22.joints:
        body = joints[:, : len(SMPL22)]
        if is_counted:
            check_order(body, data["joints"].shape[1], assumed)
        if start := checks.rest_frames(body, rate):
            notes.append(_rest_note(start))
        body = body[start:]
        checks.check_body(body, layout)
        doubts = _doubts(body, rate, layout.up, np.array(UP[layout.up], float))
    notes += doubts.lines
    motion = Motion(
        joints[start:], rate, skeleton, data.get("text", ""), path.stem, notes=tuple(notes)
    )
    return Recording(_resampled(motion, resample_to), _label(path, layout, rate), doubts)


def _of_smpl(
    path: Path,
    data: dict[str, Any],
    rate: float | None,
    resample_to: float | None,
    fields: Mapping[str, Any],
) -> Recording:
    others = [key for key in Layout.model_fields if key not in ("up", "fps")]
    _refuse(fields, others, "the joints and bone lengths of SMPL's body are known")
    data["fps"] = rate = _rate(data, rate, fields)
    up = fields.get("up", "z")
    axes = BODY_AXES[up]

    poses = _smpl_poses(*_matrices(smpl_motion(data)), axes)
    joints, notes = poses.joints().float().numpy(), []
    if start := checks.rest_frames(joints, rate):
        notes.append(_rest_note(start))
        data |= {name: data[name][start:] for name in ("poses", "trans")}
        joints = joints[start:]
    doubts = _doubts(joints, rate, up, axes.numpy())
    notes += [line for line in (*doubts.lines, checks.below_floor(joints)) if line]

    fps = rate if resample_to is None else resample_to
    translation, turns = smpl_motion(data, fps)
    poses = _smpl_poses(*_matrices((translation, turns)), axes)
    motion = motion_of_poses(poses, fps, data.get("text", ""), path.stem)
    motion.notes = tuple(notes)
    label = f"AMASS, {rate:g} fps{_described(path)}"
    return Recording(motion, label, doubts, _in_amass_axes(translation, turns, axes))


def _of_ours(
    path: Path,
    data: dict[str, Any],
    rate: float | None,
    resample_to: float | None,
    fields: Mapping[str, Any],
    said: dict[str, Any],
    as_smpl: bool,
) -> Recording:
    """Returns the recording in a file that this project wrote.

    Such a file is in meters, with y up, and may contain rotations and features.
    """
    for key, value in said.items():
        raise UserError(
            f"{key}={value} has no effect: the file was written by this package, so it already "
            f"uses meters with y up. Remove {key}="
        )
    rate = _rate(data, rate, {})
    notes = (
        ("skeleton.yaml does not apply: the file was written by this package",) if fields else ()
    )
    joints, layout = data["joints"], Layout()
    if as_smpl:
        layout, names = array_layout(joints, {})
        joints = layout.apply(joints.astype(float), names)
    motion = Motion(
        joints,
        rate,
        _skeleton(joints),
        str(data.get("text", "")),
        path.stem,
        _poses(data),
        notes=notes,
    )
    if "features" in data:
        motion.features = data["features"].astype(np.float32)
        motion.representation = str(data.get("representation", ""))
    return Recording(_resampled(motion, resample_to), _label(path, layout, rate))


def _rate(data: Mapping[str, Any], rate: float | None, fields: Mapping[str, Any]) -> float:
    """Returns the frame rate of a file's arrays.

    The command takes precedence over the file, and the file takes precedence over skeleton.yaml.
    """
    rate = data.get("fps", fields.get("fps")) if rate is None else rate
    if rate is None:
        raise UserError(
            "the file contains no frame rate. Set fps=20, or add `fps: 20` to skeleton.yaml"
        )
    return frame_rate(rate)


def _checked(fields: dict[str, Any]) -> dict[str, Any]:
    """Checks and returns the fields of `Layout`, some of which may come from a JSON file."""
    try:
        Layout(**{key: value for key, value in fields.items() if key in ("up", "unit")})
    except ValueError as error:
        stated = ", ".join(f"{key}: {fields[key]}" for key in ("up", "unit") if key in fields)
        raise UserError(
            f"{stated[:80]}: up must be y, z or -y, and unit must be a number of meters, or m, cm or mm"
        ) from error
    return fields


def _refuse(fields: Mapping[str, Any], without_effect: Collection[str], reason: str) -> None:
    """Raises `UserError` if a key that has no effect on the file is set."""
    for key in without_effect:
        if key in fields:
            raise UserError(
                f"{key} has no effect, because {reason}. Remove this key from the command or from skeleton.yaml"
            )


def _rest_note(frames: int) -> str:
    if frames == 1:
        return "the first frame is a rest pose and is left out"
    return f"the first {frames} frames lead from a rest pose to the motion and are left out"


def _doubts(joints: np.ndarray, fps: float, up: str, axes: np.ndarray) -> Doubts:
    return Doubts(
        checks.uprightness(joints), checks.lying(joints, up, axes), checks.jump(joints, fps)
    )


def _described(path: Path) -> str:
    skeleton = skeleton_file(path)
    return f" ({os.path.relpath(skeleton)})" if skeleton else ""


def _label(path: Path, layout: Layout, rate: float) -> str:
    return f"{layout_name(layout)}, unit {layout.unit:.4g}, {rate:g} fps{_described(path)}"


def _resampled(motion: Motion, fps: float | None) -> Motion:
    """Returns a motion, resampled to another frame rate, without its features and rotations.

    A motion that already has this frame rate is returned unchanged.
    """
    if fps is None or math.isclose(motion.fps, fps):
        return motion
    joints = resample(motion.joints.astype(float), motion.fps, fps, cubic=True)
    return Motion(joints, fps, motion.skeleton, motion.text, motion.id, notes=motion.notes)


def _matrices(smpl: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Returns the pelvis positions (F, 3) and rotation matrices (F, 24, 3, 3).

    `smpl` consists of the translation and the quaternions.
    """
    translation, turns = smpl
    return translation + torch.tensor(PELVIS, dtype=torch.float64), rotation.quaternion_to_matrix(
        turns
    )


def _in_amass_axes(translation: Tensor, turns: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
    """Returns a translation (F, 3) and quaternions (F, 24, 4) in AMASS's axes.

    `axes` (3, 3) rotates the axes of the file so that y is up.
    """
    if torch.equal(axes, AMASS_AXES):
        return translation, turns
    turn, pelvis = AMASS_AXES @ axes, torch.tensor(PELVIS, dtype=torch.float64)
    root = rotation.matrix_to_quaternion(turn @ rotation.quaternion_to_matrix(turns[:, 0]))
    return (translation + pelvis) @ turn.T - pelvis, torch.cat([root[:, None], turns[:, 1:]], 1)


def _smpl_poses(pelvis: Tensor, rotations: Tensor, axes: Tensor) -> Poses:
    """Returns poses of SMPL's mean body. `axes` (3, 3) rotates them so that y is up."""
    rotations = rotations[:, : len(SMPL22)].clone()
    rotations[:, 0] = axes @ rotations[:, 0]
    return Poses(
        torch.tensor(ADULT[: len(SMPL22)], dtype=torch.float64), rotations, pelvis @ axes.T
    )


def _poses(data: dict[str, Any]) -> Poses | None:
    """Returns rotations from the AMASS arrays or SMPL features in a file that also has joints.

    HumanML3D features contain no such rotations.
    """
    if "poses" in data:
        if len(data["poses"]) != len(data["joints"]):
            raise UserError(
                f"found {len(data['poses'])} frames of poses, but {len(data['joints'])} frames of joints"
            )
        # This translation does not include the pelvis position in SMPL's template
        translation, turns = smpl_motion(data)
        return _smpl_poses(translation, rotation.quaternion_to_matrix(turns), AMASS_AXES)
    representation = str(data.get("representation", ""))
    if "features" not in data or representation not in ROTATED:
        return None
    expected = (len(data["joints"]), ROTATED[representation])
    if data["features"].shape != expected:
        raise UserError(
            f"features have shape {data['features'].shape}, but {representation} needs {expected}"
        )
    x = torch.from_numpy(data["features"]).double()
    if representation == "motion272":
        pelvis, turns = Motion272().poses(x)
        return Poses(torch.tensor(ADULT[: len(SMPL22)], dtype=torch.float64), turns, pelvis)
    if representation == "smpl147":
        translation, rows, axes = x[:, :3], x[:, 3:], AMASS_AXES
    else:
        translation, rows, axes = x[:, 144:147], x[:, :144], CAMERA_AXES
    return _smpl_poses(
        translation, rotation.rot6d_to_matrix(rows.unflatten(1, (24, 6)), "rows"), axes
    )


def _skeleton(joints: np.ndarray) -> Skeleton:
    """Returns the skeleton of joints (F, J, 3), identified by the number of joints."""
    for skeleton in SKELETONS.values():
        if joints.ndim == 3 and joints.shape[1:] == (len(skeleton), 3):
            return skeleton
    sizes = " or ".join(f"{len(skeleton)} ({skeleton.name})" for skeleton in SKELETONS.values())
    raise UserError(
        f"joints have shape {joints.shape}, not (frames, joints, 3) with {sizes} joints"
    )
