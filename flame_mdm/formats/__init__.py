"""Motion files for exchange with other programs.

`docs/formats.md` lists the units, axes and joints of each format.
"""

import re
from pathlib import Path

from flame_mdm.errors import UserError

# Extensions of files that contain a scene of nodes and its animations
SCENES = (".fbx", ".glb", ".vrm", ".vrma")
# Extensions of motion files that can be read
ENDINGS = (".npz", ".bvh", *SCENES, ".amc", ".json", ".npy")
# Extensions of files that contain a hierarchy of joints and their rotations
TREES = (".bvh", ".amc")
# Universal Scene Description
USD = (".usda", ".usdc", ".usdz")
# Extensions of files that can be written with another program's skeleton
RIGGED = (".bvh", ".glb", ".fbx", *USD)
# Extensions of the files that `Motion.save` writes
WRITTEN = (
    *RIGGED,
    ".vrma",
    ".npz",
    ".json",
    ".npy",
    ".gif",
    ".mp4",
)

ADVICE = {
    ".gltf": "Save it as .glb, which is a single file, for example with Blender (File > Export > glTF 2.0)",
    ".blend": "Open it in Blender and export BVH (File > Export > Motion Capture)",
    ".c3d": "It contains markers, not joints. Fit a skeleton to them in your motion capture program and export BVH",
    ".trc": "It contains markers, not joints. Fit a skeleton to them in your motion capture program and export BVH",
    ".pkl": "Pickle files can run code and are never opened. Save the arrays with numpy.savez as poses, trans and fps",
    ".pt": "Save the arrays with numpy.savez as joints and fps, or as poses, trans and mocap_framerate",
    ".csv": "Save the joint positions (frames, joints, 3) with numpy.savez as joints, together with fps",
}
"""Advice by extension, for motion files that cannot be read."""

NO_MOTIONS = ("shape.npz", "_stagei.npz")
"""Suffixes of AMASS files that contain a body shape but no motion."""
# Beginning of the joint array, which occurs only in JSON files that contain a motion
JOINTS_IN_JSON = re.compile(rb'"(joints|posed_joints)"\s*:\s*\[\s*\[')


def unread(path: Path) -> UserError:
    """Returns the error for a file that has an unsupported extension."""
    advice = ADVICE.get(path.suffix.lower(), f"Use one of {', '.join(ENDINGS)}")
    return UserError(
        f"{path}: {path.suffix or 'a file without an extension'} cannot be read as a motion. "
        f"{advice}"
    )


def motions_in(folder: Path) -> list[Path]:
    """Returns the motion files in a folder and its subfolders, sorted.

    Hidden files (such as those created by macOS and editors), folders, and AMASS files that contain
    no motion are skipped. A JSON file counts as a motion only if it contains an array of joints.
    """
    return sorted(file for file in folder.rglob("*") if _is_motion(file, folder))


def motion_files(folder: Path) -> list[Path]:
    """Returns the files that `motions_in` finds, and raises `UserError` if there are none."""
    files = motions_in(folder)
    if not files:
        raise UserError(f"{folder}: contains no motion files ({', '.join(ENDINGS)})")
    return files


def _is_motion(file: Path, folder: Path) -> bool:
    parts, suffix = file.relative_to(folder).parts, file.suffix.lower()
    if (
        suffix not in ENDINGS
        or file.is_dir()
        or "__MACOSX" in parts
        or any(part.startswith(".") for part in parts)
    ):
        return False
    if file.name.lower().endswith(NO_MOTIONS):
        return False
    return suffix != ".json" or not file.is_file() or _has_joints(file)


def _has_joints(file: Path) -> bool:
    """Returns whether a JSON file contains an array of joints.

    Also returns True for a file that cannot be read, so that its reader reports the error.
    """
    tail = b""
    try:
        with file.open("rb") as content:
            while block := content.read(2**20):
                if JOINTS_IN_JSON.search(tail + block):
                    return True
                tail = block[-100:]
    except OSError:
        return True
    return False
