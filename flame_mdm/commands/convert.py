"""`flame-mdm convert MOTION OUT`: converts a motion file."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm convert MOTION OUT [fps=20] [unit=0.01] [up=z] [figure=bones] [rest_pose=true] [rig=mixamo]

Converts a motion file. The nearest skeleton.yaml in its folder or above applies (docs/own-data.md).
Inputs: .npz written by `make sample`, .npz of AMASS, .bvh, .json, and .npy with joint positions.
Outputs: .bvh and .glb for Blender and game engines, .npz in the layout of AMASS, and .json and .npy with joint
positions; .mp4 and .gif to look at. Units, axes and joint names: docs/formats.md
"""


def convert(config: Config) -> None:
    """Converts one file.

    Raises:
        UserError: If the input or the output is not named.
        FileNotFoundError, ValueError: As raised by `formats.files.read` and `Motion.save`.
    """
    if config["motion"] is None or config["out"] is None:
        raise UserError("name an input and an output file: flame-mdm convert motion.npz walk.bvh")
    from flame_mdm.formats.body import LEG, head_height, leg_length
    from flame_mdm.formats.files import read
    from flame_mdm.formats.layouts import find_skeleton
    from flame_mdm.representations.skeleton import SMPL22
    from flame_mdm.visualize.bodies import choose_body

    choose_body(config["body"])
    path, out = Path(str(config["motion"])), Path(str(config["out"]))
    given = find_skeleton(path, config["up"])
    # a BVH file keeps proportions in any unit; the other files are in meters
    copied = path.suffix.lower() == out.suffix.lower() == ".bvh"
    motion = read(path, config["fps"], config["unit"], given=given, any_size=copied)
    if out.suffix.lower() == ".npz":
        motion.poses = motion.posed()  # other programs expect AMASS's keys
    say(motion.save(out, config["figure"], config["rest_pose"], config["rig"]))
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
    text=("motion", "out", "up", "figure", "rig", "body"),
    kinds={"fps": "float", "unit": "float"},
)
