"""Converts motion files: `flame-mdm convert motion.npz walk.bvh`"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError, say

USAGE = """
usage: flame-mdm convert MOTION OUT [fps=20] [unit=0.01]

Reads a motion (.npz of `make sample` or of AMASS, .bvh, .json, or joints .npy) and writes it as .bvh or .glb for
Blender and game engines, .npz as AMASS, or .json or .npy with the joints. Units, axes and names: docs/formats.md
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = sys.argv[1:] if argv is None else argv
    objects = ("motion", "out")
    return run(
        convert,
        words,
        usage=USAGE,
        name="convert",
        objects=objects,
        text=objects,
        kinds={"fps": "float", "unit": "float"},
    )


def convert(config: Config) -> None:
    """Converts one file.

    Raises:
        UserError: no input or no output named.
        FileNotFoundError, ValueError: as `formats.files.read` and `Motion.save`.
    """
    if config["motion"] is None or config["out"] is None:
        raise UserError("which file, and where to? flame-mdm convert motion.npz walk.bvh")
    from flame_mdm.formats.files import read

    motion = read(str(config["motion"]), config["fps"], config["unit"])
    out = Path(str(config["out"]))
    if out.suffix.lower() == ".npz":
        motion.poses = motion.posed()  # other programs read AMASS's keys
    say(motion.save(out))


if __name__ == "__main__":
    sys.exit(main())
