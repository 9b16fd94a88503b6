"""`Motion`, one motion outside the models, and writers of motion files. `docs/formats.md` describes the files.

The 6D rotations among the 263 features of HumanML3D are not SMPL's: they follow different chains and do not define the
twist of a bone. They are never exported as rotations, which come from joint positions (`flame_mdm.formats.poses`) or
from features and files that contain SMPL's rotations.
"""

import json
import sys
import tempfile
from dataclasses import dataclass, field
from html import escape
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from flame_mdm.errors import UserError, shortened
from flame_mdm.formats import WRITTEN, bvh, characters, skinned
from flame_mdm.formats.characters import Character
from flame_mdm.formats.poses import Poses, solve
from flame_mdm.formats.retarget import continuous_euler, preset, retarget, smpl
from flame_mdm.formats.rig import CENTIMETER, Rig
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22, Skeleton
from flame_mdm.representations.smpl import ADULT
from flame_mdm.safe_io import atomic_write, write_text
from flame_mdm.visualize.body import Mesh, try_fit

AMASS_AXES = torch.tensor([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=torch.float64)
"""Converts AMASS's coordinates, z up, to y up as in HumanML3D: (-x, z, y). It is its own inverse."""
END_SITES = {
    **{"head": (0.0, 0.18, 0.0), "left_foot": (0.0, 0.0, 0.06), "right_foot": (0.0, 0.0, 0.06)},
    **{"left_wrist": ADULT[22], "right_wrist": ADULT[23]},
}
"""Tips of head, toes and hands beyond the last joints, in meters; without them programs do not draw these bones."""


@dataclass(eq=False, repr=False)
class Motion:
    """One motion outside the models: generated, real or read from a file.

    Attributes:
        joints: (F, J, 3) float32 joint positions in meters, y up, floor at y = 0.
        fps: frames per second.
        skeleton: names and parents of the J joints; the prefixes `left_` and `right_` mark the sides.
        text: the caption, or the name of the action; "" if there is none.
        id: name of the motion: a clip, a file, or text and sample number, which determine the noise.
        poses: rotations of SMPL's joints, if they are known.
        features: (F, D) float32 features in the units of the data; empty if they are not known.
        representation: name of the representation of the features.
        contacts: (F, N) bool, True if a joint of `skeleton.feet` is on the floor; None = unknown.
        cleanup: whether `flame_mdm.formats.cleanup` changed the joints.
        parts: text, first and last frame (exclusive) of each part of a sequence; () = one part.

    Raises:
        UserError: If a shape is wrong, a joint is not finite, or the frame rate is not a positive number.
    """

    joints: np.ndarray
    fps: float
    skeleton: Skeleton = SMPL22
    text: str = ""
    id: str = ""
    poses: Poses | None = None
    features: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    representation: str = ""
    contacts: np.ndarray | None = None
    cleanup: bool = False
    parts: tuple[tuple[str, int, int], ...] = ()

    def __post_init__(self) -> None:
        name, skeleton = f"motion {self.id!r}", self.skeleton
        self.joints = np.asarray(self.joints, dtype=np.float32)
        shape = self.joints.shape
        if len(shape) != 3 or shape[2] != 3 or not shape[0]:
            raise UserError(f"{name}: joints have shape {shape}, expected (frames, joints, 3)")
        if shape[1] != len(skeleton.joints):
            raise UserError(f"{name}: {shape[1]} joints, but skeleton {skeleton.name} has {len(skeleton.joints)}")
        if not np.isfinite(self.joints).all():
            frame, joint, _ = np.argwhere(~np.isfinite(self.joints))[0]
            raise UserError(f"{name}: joint {joint} in frame {frame} is not finite; did the model diverge?")
        self.fps = float(self.fps)
        if not 0 < self.fps < float("inf"):
            raise UserError(f"{name}: fps is {self.fps}, expected a number above 0")
        if self.contacts is not None:
            self.contacts = np.asarray(self.contacts, dtype=bool)
            actual, expected = self.contacts.shape, (shape[0], len(skeleton.feet))
            if actual != expected:
                raise UserError(f"{name}: contacts have shape {actual}, expected (frames, feet) = {expected}")

    def __repr__(self) -> str:
        name = shortened(self.text or self.id, 60)
        return f"{type(self).__name__}({name!r}, {len(self.joints)} frames, {self.fps:g} fps, {self.skeleton.name})"

    def posed(self) -> Poses:
        """Returns the rotations; if they are not known, computes them from joint positions of SMPL's skeleton."""
        if self.poses is not None:
            return self.poses
        joints = torch.from_numpy(self.joints)
        if self.skeleton.name == "smpl24":
            joints = joints[:, : len(SMPL22)]  # the last two are the hands
        return solve(joints, self.fps)

    def save(
        self,
        path: str | Path,
        rest_pose: bool = False,
        rig: str | None = None,
        character: str | Path | Character | None = None,
        body: Mesh | None = None,
        **facts: Any,
    ) -> str:
        """Writes a motion file and returns a line that describes it.

        `.npz` contains joints, frame rate, text and features, and AMASS's keys if rotations are known. `.bvh` and
        `.glb` contain rotations, `.json` and `.npy` joints. `.gif` and `.mp4` are animations.

        Args:
            path: the file; its extension selects the format.
            rest_pose: begin a `.bvh` file with a frame of the rest pose, arms out, which some programs expect.
            rig: the skeleton of a `.bvh` or `.glb` file, one of `flame_mdm.formats.retarget.presets`; default: SMPL's.
            character: a `.bvh` or `.glb` file, or what `flame_mdm.formats.characters.read` returned; the same kind of
                file with this motion is written. The other options do not apply.
            body: the body in `.glb`, `.gif` and `.mp4` files, from `flame_mdm.visualize.bodies.load_body`; default: the
                mannequin.
            facts: additional entries of an `.npz` file, such as the seed.

        Raises:
            UserError: If the extension, an option or the rig is unknown or does not apply, `.bvh` or `.glb` is
                requested for another skeleton than SMPL's, the file cannot be written, `.mp4` is requested and the
                package av is not installed, or the character cannot be used.
        """
        path = Path(path)
        ending = path.suffix.lower()
        if ending not in WRITTEN:
            raise UserError(f"{path}: unknown kind of motion file. Use one of {', '.join(WRITTEN)}")
        if rest_pose and ending != ".bvh":
            raise UserError(f"{path}: rest_pose is only for .bvh files")
        if rig is not None and ending not in (".bvh", ".glb"):
            raise UserError(f"{path}: rig is only for .bvh and .glb files, which contain a skeleton")
        if character is not None:
            if rest_pose or rig is not None:
                raise UserError(f"{path}: rest_pose and rig do not apply to a character's own file")
            character = character if isinstance(character, Character) else characters.read(character)
            what = characters.write(path, character, self, self.text or self.id or "motion")
        elif ending == ".bvh":
            what = _write_bvh(self, path, rest_pose, rig)
        elif ending == ".glb":
            what = _write_glb(self, path, rig, body)
        elif ending == ".npz":
            what = _write_npz(self, path, facts)
        elif ending == ".json":
            what = _write_json(self, path)
        elif ending == ".npy":
            with atomic_write(path) as temporary:
                np.save(temporary, self.joints)
            what = f"joints {self.joints.shape} in meters, y up; the file does not contain the frame rate"
        else:
            what = _write_video(self, path, body)
        return f"{path}: {len(self.joints)} frames at {self.fps:g} per second, {what}"

    def show(self) -> Any:
        """Returns a player: a display in a Jupyter notebook, otherwise the path of a page to open in any browser."""
        from flame_mdm.visualize import player_page

        page = player_page([self], self.text or self.id or "Motion")
        ipython = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        if hasattr(ipython, "kernel"):  # a notebook, not a terminal
            style = "width:100%;height:560px;border:0"
            frame = f'<iframe sandbox="allow-scripts allow-downloads" style="{style}" srcdoc="{escape(page)}"></iframe>'
            return import_module("IPython.display").HTML(f"<div>{frame}</div>")  # it warns of a bare iframe
        path = Path(tempfile.mkdtemp(prefix="flame_mdm_")) / "motion.html"
        write_text(path, page)
        return path


def amass_parameters(poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Returns axis-angle vectors (F, 66) of 22 joints and translation (F, 3) in AMASS's coordinates: meters, z up."""
    world = poses.rotations.clone()
    world[:, 0] = AMASS_AXES @ world[:, 0]
    turns = rotation.matrix_to_axis_angle(world).flatten(1).numpy()
    return turns, (poses.root @ AMASS_AXES.T).numpy() - np.array(ADULT[0])


def motion_of_poses(poses: Poses, fps: float, text: str = "", id: str = "") -> Motion:
    """Returns the motion of a body whose rotations are known."""
    return Motion(poses.joints().float().numpy(), fps, SMPL22, text, id, poses)


# Writing --------------------------------------------------------------------------------------------------------------


def _write_npz(motion: Motion, path: Path, facts: dict[str, Any]) -> str:
    content: dict[str, Any] = {"joints": motion.joints, "features": motion.features, "fps": motion.fps}
    content |= {"text": motion.text, "representation": motion.representation, "cleanup": motion.cleanup}
    if not motion.features.size:
        del content["features"], content["representation"]
    what = f"{len(motion.skeleton)} joints in meters, y up"
    if motion.poses is not None:
        turns, translation = amass_parameters(motion.poses)
        content |= {
            "poses": np.pad(turns, ((0, 0), (0, 90))),  # hands at rest
            "trans": translation,
            "betas": np.zeros(16),
            "gender": "neutral",
            "mocap_framerate": motion.fps,
            # names of AMASS's SMPL-X files, which GMR reads
            **{"root_orient": turns[:, :3], "pose_body": turns[:, 3:], "mocap_frame_rate": motion.fps},
        }
        what += "; also in AMASS's format: SMPL+H poses in axis-angle, meters, z up, bone lengths of SMPL's body"
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **content, **facts)
    return what


def _rig(poses: Poses, rig: str | None) -> Rig:
    return smpl(poses) if rig is None else preset(rig, poses)


def _write_bvh(motion: Motion, path: Path, rest_pose: bool, rig: str | None) -> str:
    poses = motion.posed()
    skeleton = _rig(poses, rig)
    turns, root = retarget(poses, skeleton)
    offsets = np.round(skeleton.offsets() / skeleton.unit, 5)
    if rest_pose:
        turns = np.concatenate([skeleton.rest()[None], turns])
        root = np.concatenate([skeleton.positions[None, skeleton.hips], root])
    angles = np.round(np.degrees(continuous_euler(torch.from_numpy(turns), skeleton.orders).numpy()), 6)
    positions = np.tile(offsets, (len(angles), 1, 1))
    positions[:, skeleton.hips] = np.round(root / skeleton.unit, 5)
    moving = [skeleton.moving or joint <= skeleton.hips for joint in range(len(offsets))]
    offsets[skeleton.hips] = 0  # programs disagree on whether the channels replace the offset or add to it
    ends = {skeleton.sources.index(SMPL22.joints.index(name)): site for name, site in END_SITES.items()}
    moves = [("Xposition", "Yposition", "Zposition") * free for free in moving]
    turning = [tuple(f"{axis}rotation" for axis in order) for order in skeleton.orders]
    columns = [part for j, free in enumerate(moving) for part in ([positions[:, j]] * free + [angles[:, j]])]
    bvh.write(
        bvh.Bvh(
            joints=skeleton.joints,
            parents=skeleton.parents,
            offsets=offsets,
            channels=tuple(first + then for first, then in zip(moves, turning, strict=True)),
            end_parents=tuple(ends),
            end_offsets=np.stack([site @ skeleton.neutral[joint] for joint, site in ends.items()]) / skeleton.unit,
            frames=np.concatenate(columns, axis=1),
            fps=motion.fps,
        ),
        path,
    )
    unit = "centimeters" if skeleton.unit == CENTIMETER else f"unit {skeleton.unit:.4g} m"
    return f"{unit}, y up; {_error(motion, poses)}" + "; the first frame is the rest pose" * rest_pose


def _write_glb(motion: Motion, path: Path, rig: str | None, body: Mesh | None) -> str:
    poses = motion.posed()
    fitted, reason = try_fit(motion, body)
    skinned.write(path, poses, _rig(poses, rig), motion.fps, motion.text, motion.id, fitted)
    return f"meters, y up; {_error(motion, poses)}" + (reason and f"; without a body: {reason}")


def _write_json(motion: Motion, path: Path) -> str:
    content: dict[str, Any] = {
        **{"id": motion.id, "caption": motion.text, "fps": motion.fps, "unit": "metre", "up": "y"},
        **{"names": motion.skeleton.joints, "parents": motion.skeleton.parents},
        "joints": np.round(motion.joints.astype(float), 5).tolist(),
    }
    write_text(path, json.dumps(content, separators=(",", ":"), ensure_ascii=False))
    return f"{len(motion.skeleton)} joints in meters, y up"


def _write_video(motion: Motion, path: Path, body: Mesh | None) -> str:
    from flame_mdm.visualize import write_gif, write_mp4

    _, reason = try_fit(motion, body)
    without = reason and f"; without a body: {reason}"
    if path.suffix.lower() == ".mp4":
        write_mp4(path, [motion], body=body)
        return f"H.264 video{without}"
    write_gif(path, [motion], body=body)
    return f"animated GIF of at most 50 frames per second{without}"


def _error(motion: Motion, poses: Poses) -> str:
    """Describes the distance between joints with constant bone lengths and those of the motion."""
    off = np.linalg.norm(poses.joints().numpy() - motion.joints[:, : len(SMPL22)], axis=-1)
    mean, most = 1000 * off.mean(), 1000 * off.max()
    return f"constant bone lengths; mean joint error {mean:.2g} mm, max {most:.2g} mm"
