"""`flame-mdm convert MOTION OUT`: converts a motion file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from flame_mdm.commands import BodySettings, FileSettings, WritingSettings, finish, motion_file
from flame_mdm.config.options import option, required
from flame_mdm.errors import UserError, first_line, say
from flame_mdm.formats import motion_files
from flame_mdm.progress import ProgressBar

if TYPE_CHECKING:
    from flame_mdm.formats.characters import BvhCharacter, Character


@dataclass(frozen=True, kw_only=True)
class ConvertSettings(BodySettings, WritingSettings, FileSettings):
    """usage: flame-mdm convert MOTION OUT [fps=20] [unit=0.01] [up=z] [rest_pose=true]
           flame-mdm convert MOTION OUT rig=mixamo
           flame-mdm convert MOTION OUT character=hero.glb
           flame-mdm convert FOLDER OUT format=glb ...

    Converts a motion file, or all motion files in a folder and its subfolders. Uses the nearest
    skeleton.yaml, either in the file's folder or in one of its parent folders; see
    docs/own-data.md.

    Inputs: .bvh; .amc with its .asf; animations in .fbx, .glb, .vrm and .vrma; .npz from
    `make sample` or AMASS; .json; and .npy with joint positions.

    Outputs: .fbx, .glb, .bvh, .usda, .usdc and .usdz for Blender and game engines; .vrma for VRM
    avatars; .npz in the layout of AMASS; .json and .npy with joint positions; and .mp4 and .gif
    for viewing.

    docs/engines.md lists the files that each program can read. docs/formats.md explains units,
    axes and joint names.
    """

    OBJECTS: ClassVar = ("motion", "out")
    motion: str = required(
        "a motion file, or a folder of motion files; an .npy file contains joint positions "
        "(frames, joints, 3)"
    )
    out: str = required(
        ".fbx, .glb, .bvh, .usdz, .vrma, .npz (AMASS), .json or .npy; or .mp4 or .gif for viewing"
    )
    format: str | None = option(
        None, "format of the files in the folder OUT, such as glb, if MOTION is a folder"
    )
    rest_pose: bool = option(
        False, "true = the first frame of a .bvh file is its rest pose, with outstretched arms"
    )


def main(settings: ConvertSettings) -> None:
    """Converts a motion file or a folder of motion files."""
    path, out = Path(settings.motion), Path(settings.out)
    if path.is_dir():
        targets = _targets(settings, path, out)
    elif settings.format is not None:
        raise UserError(
            "format=... applies only to folders. For a single file, the extension of OUT "
            "determines the format. Remove format="
        )
    else:
        motion_file("motion", settings.motion)
        targets = {out: path}
    character = settings.read_character()
    if not path.is_dir():
        _convert(settings, path, out, character)
        return
    failures = []
    for target, file in ProgressBar(targets.items(), desc="convert", unit="file"):
        try:
            _convert(settings, file, target, character)
        except (UserError, OSError) as error:
            failures.append(first_line(error))
    finish(failures, len(targets), "converted")


def _targets(settings: ConvertSettings, folder: Path, out: Path) -> dict[Path, Path]:
    ending = settings.format or (
        Path(settings.character).suffix[1:].lower() if settings.character else None
    )
    if ending is None:
        raise UserError(
            f"{folder} is a folder. Also set the format of the files, for example format=glb"
        )
    files = motion_files(folder)
    targets = {out / file.relative_to(folder).with_suffix(f".{ending}"): file for file in files}
    if double := [file for file in files if file not in targets.values()]:
        raise UserError(
            f"{double[0]}: another motion has the same name, so both would be written to "
            f"the same file. Rename one of them"
        )
    return targets


def _convert(
    settings: ConvertSettings, path: Path, out: Path, character: Character | BvhCharacter | None
) -> None:
    from flame_mdm.formats.layouts import head_height, leg_length
    from flame_mdm.formats.readers import read
    from flame_mdm.representations.skeleton import SMPL22

    body = settings.read_body()
    motion = read(path, settings.fps, settings.unit, settings.up, animation=settings.animation)
    if out.exists() and out.samefile(path):
        raise UserError(
            f"{out}: this would overwrite the input. Choose another name for the output"
        )
    motion = settings.at_rate(motion)
    if out.suffix.lower() == ".npz":
        motion.poses = motion.posed()  # other programs expect the keys of AMASS
    try:
        say(
            motion.save(
                out, settings.rest_pose, settings.rig, character, body, settings.root_motion
            )
        )
    except UserError as error:  # an error that does not name the output concerns the input
        if str(out) in str(error):
            raise
        raise UserError(f"{path}: {error}") from error
    say(*(f"{path}: {note}" for note in motion.notes))
    if motion.skeleton.joints[: len(SMPL22)] == SMPL22.joints:
        say(
            f"legs {leg_length(motion.joints):.2f} m, head joint at {head_height(motion.joints):.2f} m"
        )
