"""Motion files as other programs write them: small copies of those in the wild, of a body that was made up."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.formats import bvh
from flame_mdm.formats.motion import AMASS_AXES, Motion, amass_parameters
from flame_mdm.formats.readers import PELVIS
from flame_mdm.representations.skeleton import SMPL22
from support.glb import changed
from support.motions import posed, synthetic

POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
TURNED = {
    "z": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "-y": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
    "y": np.eye(3),
}
"""Axis that points up -> rows of the rotation of joints with y up to these axes."""


def walk(frames: int = 40) -> Motion:
    """A body whose arms hang, which turns a little and swings its legs."""
    swing = np.sin(np.arange(frames) / 6)[:, None] * [20.0, 0, 0]
    legs: dict[str, Any] = {"left_hip": swing, "right_hip": -swing}
    arms: dict[str, Any] = {"left_shoulder": [0, 0, -70.0], "right_shoulder": [0, 0, 70.0]}
    return posed(frames, heading=np.sin(np.arange(frames) / 9), **legs, **arms)


def amass(motion: Motion, up: str = "z", numbers: int = 156) -> dict[str, Any]:
    """The motion as SMPL's rotations in axes of which `up` points up, with the pelvis of SMPL's template."""
    poses = motion.posed()
    turn = np.array(TURNED[up]) @ AMASS_AXES.numpy() if up != "z" else np.eye(3)
    vectors, pelvis = amass_parameters(poses)
    root = np.array(TURNED[up], float) @ poses.rotations[:, 0].numpy() if up != "z" else None
    if root is not None:
        vectors[:, :3], pelvis = Rotation.from_matrix(root).as_rotvec(), pelvis @ turn.T
    padded = np.pad(vectors, ((0, 0), (0, numbers - 66)))
    return {"poses": padded, "trans": pelvis - np.array(PELVIS), "mocap_framerate": motion.fps}


def write_bvh(path: Path, motion: Motion, turn: Any = None, first: Any = None) -> None:
    """A BVH file with position channels; `first` (22, 3) is a frame in front."""
    joints = motion.joints.astype(float)
    if first is not None:
        joints = np.concatenate([np.asarray(first, float)[None], joints])
    local = 100 * joints @ np.array(TURNED[turn or "y"], float).T
    local[:, 1:] -= local[:, :1]
    frames = np.concatenate([local, np.zeros_like(local)], 2).reshape(len(local), -1)
    channels = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
    tree = bvh.Bvh(
        SMPL22.joints, (-1, *[0] * 21), np.zeros((22, 3)), (channels,) * 22, frames, motion.fps
    )
    bvh.write(tree, path)


def swapped(motion: Motion) -> np.ndarray:
    """The joints (F, 22, 3) with left and right exchanged."""
    names = [
        name.replace("left", "x").replace("right", "left").replace("x", "right")
        for name in SMPL22.joints
    ]
    return motion.joints[:, [SMPL22.joints.index(name) for name in names]]


def _bvh(path: Path, **options: Any) -> None:
    write_bvh(path, walk(), **options)


def _swapped(path: Path) -> None:
    write_bvh(path, Motion(swapped(walk()), 20))


def _with_objects(path: Path) -> None:
    np.savez(path, **amass(walk()), markers_latent_vids=np.array({"a": 1}, dtype=object))


def _with_rate_of_one_element(path: Path) -> None:
    parts = amass(walk())
    parts["mocap_framerate"] = np.array([20.0])
    np.savez(path, **parts)


def _halves(path: Path) -> None:
    halves: dict[str, Any] = {
        name: np.asarray(values, np.float16) for name, values in amass(walk()).items()
    }
    np.savez(path, **halves)


def _of_a_smaller_body(path: Path) -> None:
    parts = amass(walk())
    parts["trans"] = parts["trans"] - [0, 0, 0.09]
    np.savez(path, **parts)


def _matrices(path: Path) -> None:
    parts = amass(walk())
    parts["poses"] = np.tile(np.eye(3).ravel(), (40, 24))
    np.savez(path, **parts)


def _thirty_joints(path: Path) -> None:
    np.savez(path, joints=np.random.default_rng(0).normal(0, 0.2, (40, 30, 3)), fps=20)


def _json_z_up(path: Path) -> None:
    joints = walk().joints @ np.array(TURNED["z"], float).T
    path.write_text(json.dumps({"joints": joints.tolist(), "fps": 20, "up": "z"}))


def _two_people(path: Path) -> None:
    write_bvh(path, walk())
    head, table = path.read_text().split("MOTION")
    second = head.replace("HIERARCHY\n", "").replace("ROOT pelvis", "ROOT other")
    rows = table.splitlines()
    doubled = [*rows[:3], *(f"{row} {row}" for row in rows[3:])]
    path.write_text(head + second + "MOTION" + "\n".join(doubled) + "\n")


def _more_frames_than_stated(path: Path) -> None:
    write_bvh(path, walk())
    path.write_text(path.read_text().replace("Frames: 40", "Frames: 39"))


def _names(path: Path, rename: Callable[[str], str], rig: str | None = None) -> None:
    """A BVH file with other names of the joints."""
    walk().save(path, rig=rig)
    lines = []
    for line in path.read_text().splitlines():
        kind, _, name = line.strip().partition(" ")
        is_joint = kind in ("ROOT", "JOINT")
        lines.append(line.replace(name, rename(name)) if is_joint else line)
    path.write_text("\n".join(lines) + "\n")


def _meshopt(path: Path) -> None:
    synthetic("kick").save(path, rig="mixamo")
    changed(path, lambda content: content.update(extensionsRequired=["EXT_meshopt_compression"]))


COLLECTED: dict[str, Callable[[Path], object]] = {
    "f01_stageii.npz": _with_objects,
    "f02_y_up.npz": lambda path: np.savez(path, **amass(walk(), "y")),
    "f03_z_up.bvh": lambda path: _bvh(path, turn="z"),
    "f03_swapped_sides.bvh": _swapped,
    "f04_rotmat_216.npz": _matrices,
    "f05_json_z_up.json": _json_z_up,
    "f06_tpose_first.bvh": lambda path: _bvh(path, first=posed(1).joints[0]),
    "f09_names_with_spaces.bvh": lambda path: _names(
        path, lambda name: f"Actor {name.split(':')[1]}", "mixamo"
    ),
    "f09_prefix_underscore.bvh": lambda path: _names(
        path, lambda name: f"Character1_{name.split(':')[1]}", "mixamo"
    ),
    "f09_smpl_capital.bvh": lambda path: _names(path, str.title),
    "f11_meshopt.glb": _meshopt,
    "f12_thirty_joints.npz": _thirty_joints,
    "f12_body_only_66.npz": lambda path: np.savez(path, **amass(walk(), numbers=66)),
    "f12_rate_of_one_element.npz": _with_rate_of_one_element,
    "f13_shorter_person.npz": _of_a_smaller_body,
    "f14_two_people.bvh": _two_people,
    "f15_half.npz": _halves,
    "f18_git_lfs_pointer.bvh": lambda path: path.write_text(POINTER),
    "f20_more_frames_than_stated.bvh": _more_frames_than_stated,
}
"""Name in the collection of files of others -> a function that writes a file with the same peculiarity."""
