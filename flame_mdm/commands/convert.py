"""`flame-mdm convert MOTION OUT`: converts a motion file."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm convert MOTION OUT [fps=20] [unit=0.01]

Converts a motion file.
Inputs: .npz written by `make sample`, .npz of AMASS, .bvh, .json, and .npy with joint positions.
Outputs: .bvh and .glb for Blender and game engines, .npz in the layout of AMASS, and .json and .npy with joint
positions. Units, axes and joint names: docs/formats.md
"""


def convert(config: Config) -> None:
    """Converts one file.

    Raises:
        UserError: If the input or the output is not named.
        FileNotFoundError, ValueError: As raised by `formats.files.read` and `Motion.save`.
    """
    if config["motion"] is None or config["out"] is None:
        raise UserError("name an input and an output file: flame-mdm convert motion.npz walk.bvh")
    from flame_mdm.formats.files import read

    motion = read(str(config["motion"]), config["fps"], config["unit"])
    out = Path(str(config["out"]))
    if out.suffix.lower() == ".npz":
        motion.poses = motion.posed()  # other programs expect AMASS's keys
    say(motion.save(out))


main = partial(
    run,
    convert,
    usage=USAGE,
    name="convert",
    objects=("motion", "out"),
    text=("motion", "out"),
    kinds={"fps": "float", "unit": "float"},
)
