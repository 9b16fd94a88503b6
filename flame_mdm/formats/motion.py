"""The class `Motion`, which does not depend on any model, and the writers of motion files.

`docs/formats.md` describes the files. The 6D rotations in the 263 features of HumanML3D are never
exported, because they are not SMPL's rotations: they are based on different chains and do not
define the twist of a bone. Exported rotations are either computed from joint positions
(`flame_mdm.formats.poses`) or taken from features and files that contain SMPL's rotations.
"""

import json
import math
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
from flame_mdm.formats import (
    RIGGED,
    USD,
    WRITTEN,
    bvh,
    characters,
    fbx_writer,
    glb_writer,
    usd,
    vrma,
)
from flame_mdm.formats.body import PosedFigure
from flame_mdm.formats.character_meshes import character_clip
from flame_mdm.formats.characters import BvhCharacter, Character
from flame_mdm.formats.poses import BoneRotations, Poses
from flame_mdm.formats.resampling import frame_pairs, frame_rate, resample
from flame_mdm.formats.retarget import continuous_euler, preset, retarget
from flame_mdm.formats.rig import CENTIMETER
from flame_mdm.formats.rigged import rigged
from flame_mdm.representations import rotation
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import ADULT
from flame_mdm.safe_io import atomic_write, write_text
from flame_mdm.visualize.body import Mesh

AMASS_AXES = torch.tensor([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]], dtype=torch.float64)
"""Converts AMASS's coordinates (z up) to y up as in HumanML3D: (-x, z, y).

It is its own inverse.
"""
END_SITES = {
    "head": (0.0, 0.18, 0.0),
    "left_foot": (0.0, 0.0, 0.06),
    "right_foot": (0.0, 0.0, 0.06),
    "left_wrist": ADULT[22],
    "right_wrist": ADULT[23],
}
"""Positions of the tips of head, toes and hands relative to the last joints, in meters.

Programs draw a bone only if it has a tip.
"""


@dataclass(eq=False, repr=False)
class Motion(PosedFigure):
    """A single motion that does not depend on any model: generated, real, or read from a file.

    Attributes:
        joints, fps, skeleton, text, id, contacts: see `flame_mdm.visualize.body.Figure`. Joints
            are float32.
        poses: rotations of SMPL's joints, if known.
        features: (F, D) float32 features in the units of the data, or empty if there are none.
        representation: name of the representation to which the features belong.
        cleanup: whether `flame_mdm.formats.cleanup` changed the joints.
        degenerate: number of frames in which the features leave the rotation of at least one joint
            undetermined.
        parts: text, first frame and end (exclusive) of each part of a sequence; () if there is only
            one part.
        notes: lines for the user about the file that was read, for example about frames that were
            left out.
        bones: rotations from the bones of the source file, which also show how a forearm turns
            about its own axis. These rotations are used to encode features that contain rotations.
            Files and pictures are created from `poses` or joint positions instead.

    Raises:
        UserError: If a shape is wrong, a joint position is NaN or infinite, or the frame rate is
            not a positive number.

    Example:
        >>> Motion(joints=np.zeros((40, 22, 3)), fps=20, text="a person stands")
        Motion('a person stands', 40 frames, 20 fps, smpl22)
    """

    features: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    representation: str = ""
    cleanup: bool = False
    degenerate: int = 0
    parts: tuple[tuple[str, int, int], ...] = ()
    notes: tuple[str, ...] = ()
    bones: BoneRotations = field(default_factory=BoneRotations)

    def __post_init__(self) -> None:
        name, skeleton = f"motion {self.id!r}", self.skeleton
        self.joints = np.asarray(self.joints, dtype=np.float32)
        shape, expected = self.joints.shape, (len(skeleton.joints), 3)
        if shape[1:] != expected or not shape[0]:
            raise UserError(
                f"{name}: joints have shape {shape}, but {skeleton.name} needs (frames, "
                f"{expected[0]}, 3)"
            )
        if not np.isfinite(self.joints).all():
            frame, joint, _ = np.argwhere(~np.isfinite(self.joints))[0]
            raise UserError(
                f"{name}: the position of joint {joint} in frame {frame} is NaN or infinite. Did the model diverge?"
            )
        self.fps = frame_rate(self.fps, f"{name}: fps")
        if self.contacts is not None:
            self.contacts = np.asarray(self.contacts, dtype=bool)
            expected = (shape[0], len(skeleton.feet))
            if self.contacts.shape != expected:
                raise UserError(
                    f"{name}: contacts have shape {self.contacts.shape}, expected {expected}"
                )

    def __repr__(self) -> str:
        name = shortened(self.text or self.id, 60)
        return f"{type(self).__name__}({name!r}, {len(self.joints)} frames, {self.fps:g} fps, {self.skeleton.name})"

    def save(
        self,
        path: str | Path,
        rest_pose: bool = False,
        rig: str | None = None,
        character: str | Path | Character | BvhCharacter | None = None,
        body: Mesh | None = None,
        root_motion: bool = False,
        **facts: Any,
    ) -> str:
        """Writes a motion file and returns a line that describes it.

        Args:
            path: the file. Its extension determines the format (docs/formats.md).
            rest_pose: whether a `.bvh` file begins with a frame in the rest pose, in which the arms
                point to the sides. Some programs require this frame.
            rig: the skeleton of a `.bvh`, `.glb`, `.fbx` or USD file: a name from
                `flame_mdm.formats.retarget.presets`. Default: SMPL's skeleton.
            character: your own character, as a file or as the result of `characters.read`. The
                motion of a `.glb` character with a skin can be saved as a `.glb`, `.fbx` or USD
                file, and the motion of a `.bvh` character as a `.bvh` file.
            body: the body in `.glb`, `.fbx`, USD, `.gif` and `.mp4` files, from
                `formats.people.load_body`. Default: the mannequin.
            root_motion: whether the root on the floor follows the hips in a `.glb`, `.fbx` or USD
                file. Otherwise, the root stays in place. Only `rig="unreal"` and `rig="soma"` have
                such a root.
            facts: additional entries for an `.npz` file, such as the seed.

        Raises:
            UserError: If an argument is unknown or does not apply to the file or the motion, or if
                `.mp4` is requested and the av package is not installed.
        """
        path = Path(path)
        ending = path.suffix.lower()
        if ending not in WRITTEN:
            raise UserError(f"{path}: unsupported motion format. Use one of {', '.join(WRITTEN)}")
        on_a_rig = character is None and ending in RIGGED
        if rig is not None and not on_a_rig:
            raise UserError(
                f"{path}: rig applies only to {', '.join(RIGGED)} files, and not to characters"
            )
        if rest_pose and (ending != ".bvh" or not on_a_rig):
            raise UserError(f"{path}: rest_pose applies only to .bvh files, and not to characters")
        if root_motion and (ending == ".bvh" or not on_a_rig or rig is None):
            raise UserError(
                f"{path}: root_motion applies only to .glb, .fbx and USD files with rig=unreal or rig=soma"
            )
        if character is not None:
            if not isinstance(character, Character | BvhCharacter):
                character = characters.read(character)
            summary = _write_character(self, path, character)
        elif ending == ".bvh":
            summary = _write_bvh(self, path, rest_pose, rig)
        elif ending == ".vrma":
            summary = _write_vrma(self, path)
        elif ending in RIGGED:
            summary = _write_rigged(self, path, rig, body, root_motion)
        elif ending == ".npz":
            summary = _write_npz(self, path, facts)
        elif ending == ".json":
            summary = _write_json(self, path)
        elif ending == ".npy":
            with atomic_write(path) as temporary, temporary.open("wb") as file:
                np.save(file, self.joints)
            summary = f"joints {self.joints.shape} in meters, y up; the file does not contain the frame rate"
        else:
            summary = _write_video(self, path, body)
        return f"{path}: {len(self.joints)} frames at {self.fps:g} per second, {summary}"

    def resampled(self, fps: float) -> "Motion":
        """Returns this motion at another frame rate, with the same duration.

        Known rotations are interpolated on the sphere, so that bones keep their lengths. If there
        are no rotations, joint positions are interpolated by cubic splines. Features are left out,
        because they are valid only at the original frame rate.
        """
        if math.isclose(self.fps, fps):
            return self
        before, after, share = frame_pairs(len(self.joints), self.fps, fps, len(self.skeleton))
        nearest = np.where(share < 0.5, before, after)
        contacts = None if self.contacts is None else self.contacts[nearest]
        ratio = fps / self.fps
        parts = tuple(
            (text, round(begin * ratio), round(end * ratio)) for text, begin, end in self.parts
        )
        joints, poses = resample(self.joints.astype(float), self.fps, fps, cubic=True), None
        if self.poses is not None:
            poses = self.poses.resampled(self.fps, fps)
            joints[:, : len(SMPL22)] = poses.joints().numpy()
        bones = self.bones
        if bones.poses is not None:
            bones = BoneRotations(bones.poses.resampled(self.fps, fps))
        return Motion(
            joints=joints,
            fps=fps,
            skeleton=self.skeleton,
            text=self.text,
            id=self.id,
            contacts=contacts,
            poses=poses,
            cleanup=self.cleanup,
            parts=parts,
            notes=self.notes,
            bones=bones,
        )

    def show(self) -> Any:
        """Returns a player.

        In a Jupyter notebook, the player is displayed. Elsewhere, the result is the path of an HTML
        page that can be opened in any browser.
        """
        from flame_mdm.visualize import player_page

        page = player_page([self], self.text or self.id or "Motion")
        ipython = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
        if hasattr(ipython, "kernel"):  # a notebook, not a terminal
            style = "width:100%;height:560px;border:0"
            frame = f'<iframe sandbox="allow-scripts allow-downloads" style="{style}" srcdoc="{escape(page)}"></iframe>'
            # IPython warns about a bare iframe, so it is wrapped in a division.
            return import_module("IPython.display").HTML(f"<div>{frame}</div>")
        path = Path(tempfile.mkdtemp(prefix="flame_mdm_")) / "motion.html"
        write_text(path, page)
        return path


def amass_parameters(poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Returns the 22 joints' axis-angle vectors (F, 66), and the translation (F, 3).

    The rotations and the translation are in AMASS's coordinates: meters, z up.
    """
    world = poses.rotations.clone()
    world[:, 0] = AMASS_AXES @ world[:, 0]
    turns = rotation.matrix_to_axis_angle(world).flatten(1).numpy()
    return turns, (poses.root @ AMASS_AXES.T).numpy() - np.array(ADULT[0])


def motion_of_poses(poses: Poses, fps: float, text: str = "", id: str = "") -> Motion:
    """Converts poses to a motion with known rotations."""
    return Motion(poses.joints().float().numpy(), fps, SMPL22, text, id, poses)


def _write_npz(motion: Motion, path: Path, facts: dict[str, Any]) -> str:
    content: dict[str, Any] = {
        "joints": motion.joints,
        "features": motion.features,
        "fps": motion.fps,
    }
    content |= {
        "text": motion.text,
        "representation": motion.representation,
        "cleanup": motion.cleanup,
    }
    if not motion.features.size:
        del content["features"], content["representation"]
    summary = f"{len(motion.skeleton)} joints in meters, y up"
    if motion.poses is not None:
        turns, translation = amass_parameters(motion.poses)
        # AMASS has 52 joints. The 30 joints of the hands are in the rest pose.
        content |= {
            "poses": np.pad(turns, ((0, 0), (0, 90))),
            "trans": translation,
        }
        content |= {"betas": np.zeros(16), "gender": "neutral", "mocap_framerate": motion.fps}
        # names in AMASS's SMPL-X files, which GMR reads
        content |= {
            "root_orient": turns[:, :3],
            "pose_body": turns[:, 3:],
            "mocap_frame_rate": motion.fps,
        }
        summary += "; also in AMASS's format: SMPL+H poses in axis-angle, meters, z up, bone lengths of SMPL's body"
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **content, **facts)
    return summary


def _write_bvh(motion: Motion, path: Path, rest_pose: bool, rig: str | None) -> str:
    poses = motion.posed()
    skeleton = preset(rig, poses)
    turns, root = retarget(poses, skeleton)
    offsets = np.round(skeleton.offsets() / skeleton.unit, 5)
    if rest_pose:
        turns = np.concatenate([skeleton.rest()[None], turns])
        root = np.concatenate([skeleton.positions[None, skeleton.hips], root])
    angles = np.round(
        np.degrees(continuous_euler(torch.from_numpy(turns), skeleton.orders).numpy()), 6
    )
    channels, columns = [], []
    for joint, order in enumerate(skeleton.orders):
        channels.append(tuple(f"{axis}rotation" for axis in order))
        if joint <= skeleton.hips:  # the hips, and a root above them
            channels[joint] = (*bvh.CHANNELS[:3], *channels[joint])
            at_rest = np.tile(offsets[joint], (len(angles), 1))
            columns.append(np.round(root / skeleton.unit, 5) if joint == skeleton.hips else at_rest)
        columns.append(angles[:, joint])
    # Programs disagree on whether the channels replace the offset or are added to it, so it is 0.
    offsets[skeleton.hips] = 0
    ends = {
        skeleton.sources.index(SMPL22.joints.index(name)): site for name, site in END_SITES.items()
    }
    end_offsets = (
        np.stack([site @ skeleton.neutral[joint] for joint, site in ends.items()]) / skeleton.unit
    )
    file = bvh.Bvh(
        joints=(*skeleton.joints, *(f"{skeleton.joints[joint]}.end" for joint in ends)),
        parents=(*skeleton.parents, *ends),
        offsets=np.concatenate([offsets, end_offsets]),
        channels=(*channels, *[()] * len(ends)),
        frames=np.concatenate(columns, axis=1),
        fps=motion.fps,
    )
    bvh.write(file, path)
    unit = "centimeters" if skeleton.unit == CENTIMETER else f"unit {skeleton.unit:.4g} m"
    line = f"{unit}, y up; {_error(motion, poses)}"
    return f"{line}; the first frame is the rest pose" if rest_pose else line


def _write_rigged(
    motion: Motion, path: Path, rig: str | None, body: Mesh | None, root_motion: bool
) -> str:
    """Writes the skeleton and, if a body fits, the skin of the body to a .glb, .fbx or USD file."""
    poses = motion.posed()
    fitted, reason = motion.try_fit(body)
    name = motion.text or motion.id or "motion"
    clip = rigged(poses, name, motion.fps, preset(rig, poses), fitted, root_motion)
    ending = path.suffix.lower()
    if ending == ".fbx":
        fbx_writer.write(path, clip)
    elif ending == ".glb":
        glb_writer.write(path, clip, motion.text)
    else:
        usd.write(path, clip)
    unit = "centimeters" if ending == ".fbx" else "meters"
    line = f"{unit}, y up; {_error(motion, poses)}"
    return f"{line}; without a body: {reason}" if reason else line


def _write_character(motion: Motion, path: Path, character: Character | BvhCharacter) -> str:
    """Writes the motion of a character.

    A .glb or .bvh file keeps the skeleton of the character's file. The motion of a .glb character
    can also be written as an .fbx or USD file.
    """
    name = motion.text or motion.id or "motion"
    ending = path.suffix.lower()
    if isinstance(character, BvhCharacter):
        return characters.write_bvh(path, character, motion)
    if ending not in (".fbx", *USD):
        return characters.write(path, character, motion, name)
    clip = character_clip(character, motion, name)
    (fbx_writer if ending == ".fbx" else usd).write(path, clip)
    return f"{len(clip.joints)} joints, {len(clip.skins)} meshes"


def _write_vrma(motion: Motion, path: Path) -> str:
    """Writes a .vrma file, which contains a motion for VRM avatars, but no body."""
    poses = motion.posed()
    fitted, _ = motion.try_fit()
    name = motion.text or motion.id or "motion"
    vrma.write(path, rigged(poses, name, motion.fps, vrma.rest_rig(poses), fitted))
    return f"meters, y up; for VRM avatars; {_error(motion, poses)}"


def _write_json(motion: Motion, path: Path) -> str:
    content: dict[str, Any] = {
        "id": motion.id,
        "caption": motion.text,
        "fps": motion.fps,
        "unit": "metre",
        "up": "y",
    }
    content |= {"names": motion.skeleton.joints, "parents": motion.skeleton.parents}
    content["joints"] = np.round(motion.joints.astype(float), 5).tolist()
    write_text(path, json.dumps(content, separators=(",", ":"), ensure_ascii=False))
    return f"{len(motion.skeleton)} joints in meters, y up"


def _write_video(motion: Motion, path: Path, body: Mesh | None) -> str:
    from flame_mdm.visualize import write_gif, write_mp4

    _, reason = motion.try_fit(body)
    if path.suffix.lower() == ".mp4":
        write_mp4(path, [motion], body=body)
        summary = "H.264 video"
    else:
        write_gif(path, [motion], body=body)
        summary = "animated GIF with at most 50 frames per second"
    return summary + (reason and f"; without a body: {reason}")


# Error in millimeters above which the message about a written file names the joint with the largest
# error
LARGE_ERROR = 10


def _error(motion: Motion, poses: Poses) -> str:
    """Describes how far the motion's joints move when all bone lengths are made constant."""
    off = np.linalg.norm(poses.joints().numpy() - motion.joints[:, : len(SMPL22)], axis=-1)
    mean, most = 1000 * off.mean(), 1000 * off.max()
    line = f"constant bone lengths; mean joint error {mean:.2g} mm, max {most:.2g} mm"
    if most < LARGE_ERROR:
        return line
    frame, joint = np.unravel_index(off.argmax(), off.shape)
    return f"{line}: {SMPL22.joints[joint]} in frame {frame}, where a bone changes its length"
