"""`flame-mdm convert MOTION OUT`: converts a motion file."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say
from flame_mdm.progress import ProgressBar

if TYPE_CHECKING:
    from flame_mdm.formats.characters import Character

USAGE = """
usage: flame-mdm convert MOTION OUT [fps=20] [unit=0.01] [up=z] [figure=bones] [rest_pose=true]
       flame-mdm convert MOTION OUT rig=mixamo
       flame-mdm convert MOTION OUT character=hero.glb
       flame-mdm convert FOLDER OUT format=glb ...

Converts a motion file, or all motion files in a folder and the folders below it. The nearest skeleton.yaml in its
folder or above applies (docs/own-data.md).
Inputs: .npz written by `make sample`, .npz of AMASS, .bvh, .json, and .npy with joint positions.
Outputs: .bvh and .glb for Blender and game engines, .npz in the layout of AMASS, and .json and .npy with joint
positions; .mp4 and .gif to look at. Units, axes and joint names: docs/formats.md
rig is the skeleton of .bvh and .glb: mixamo, unreal, unity, lafan1, soma, cmu, geno or 100style. character is your
own .glb or .bvh file, which is written with the motion: docs/characters.md
"""


def convert(config: Config) -> None:
    """Converts one file or a folder.

    Raises:
        UserError: If the input or the output is not named, the folder has no motions, or as raised by `Motion.save`.
        FileNotFoundError, ValueError: As raised by `formats.files.read` and `Motion.save`.
    """
    if config["motion"] is None or config["out"] is None:
        raise UserError("name an input and an output file: flame-mdm convert motion.npz walk.bvh")
    from flame_mdm.formats import characters, joint_names
    from flame_mdm.formats.readers import ENDINGS

    path, out, hero = Path(str(config["motion"])), Path(str(config["out"])), config["character"]
    try:
        character = None if hero is None else characters.read(hero)
    except joint_names.UnknownJoints as error:
        say(*error.template)
        raise
    if not path.is_dir():
        if config["format"] is not None:
            raise UserError("format=... is for folders; the ending of OUT is the format of one file")
        _convert(config, path, out, character)
        return
    ending = config["format"] or (Path(hero).suffix[1:].lower() if hero else None)
    if ending is None:
        raise UserError(f"{path} is a folder: name the format of the files too, such as format=glb")
    found = sorted(file for file in path.rglob("*") if file.suffix.lower() in ENDINGS and file.is_file())
    if not found:
        raise UserError(f"{path}: no motion files ({', '.join(ENDINGS)})")
    outputs = {out / file.relative_to(path).with_suffix(f".{ending}"): file for file in found}
    if double := [file for file in found if file not in outputs.values()]:
        raise UserError(f"{double[0]}: another motion has the same name, so both would become one file. Rename one")
    for target, file in ProgressBar(outputs.items(), desc="convert", unit="file"):
        _convert(config, file, target, character)


def _convert(config: Config, path: Path, out: Path, character: Character | None) -> None:
    from flame_mdm.formats.body import LEG, head_height, leg_length
    from flame_mdm.formats.layouts import find_skeleton
    from flame_mdm.formats.readers import read
    from flame_mdm.representations.skeleton import SMPL22
    from flame_mdm.visualize.bodies import load_body

    body = load_body(config["body"])
    given = find_skeleton(path, config["up"])
    # a BVH file keeps proportions in any unit; the other files are in meters
    copied = path.suffix.lower() == out.suffix.lower() == ".bvh"
    motion = read(path, config["fps"], config["unit"], given=given, any_size=copied)
    if out.exists() and out.samefile(path):
        raise UserError(f"{out}: the same file as the input, which stays as it is. Choose another name for the output")
    if out.suffix.lower() == ".npz":
        motion.poses = motion.posed()  # other programs expect AMASS's keys
    say(motion.save(out, config["figure"], config["rest_pose"], config["rig"], character, body))
    if motion.skeleton.joints[: len(SMPL22)] == SMPL22.joints:
        leg, head = leg_length(motion.joints), head_height(motion.joints)
        say(f"legs {leg:.2f} m, head joint at {head:.2f} m")
        if not LEG[0] <= leg <= LEG[1]:
            say(f"adults have legs of {LEG[0]:g} to {LEG[1]:g} m: if the unit of {path} is wrong, set unit=...")


main = partial(
    run,
    convert,
    usage=USAGE,
    name="convert",
    objects=("motion", "out"),
    text=("motion", "out", "up", "figure", "rig", "body", "character", "format"),
    kinds={"fps": "float", "unit": "float"},
)
