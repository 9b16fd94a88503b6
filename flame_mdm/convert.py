"""Converts motion files: `python -m flame_mdm.convert motion.npz out=walk.bvh`"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from flame_mdm.config import Config, UserError, run

USAGE = """
usage: python -m flame_mdm.convert FILE out=FILE [fps=20] [unit=0.01]

Reads a motion (.npz of `make sample` or of AMASS, .bvh, .json, or joints .npy) and writes it as .bvh or .glb for
Blender and game engines, .npz as AMASS, or .json or .npy with the joints. Units, axes and names: docs/formats.md
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    if words and not words[0].startswith("-") and "=" not in words[0]:
        words[0] = f"input={words[0]}"
    return run(convert, words, usage=USAGE, name="convert", text=("input", "out"), like=("flame_mdm.formats.read",))


def convert(config: Config) -> None:
    """Converts one file.

    Raises:
        UserError: no input or no output named. FileNotFoundError, ValueError: as `flame_mdm.formats.read` and `write`.
    """
    if config["input"] is None or config["out"] is None:
        raise UserError("which file, and where to? python -m flame_mdm.convert motion.npz out=walk.bvh")
    from flame_mdm.formats import read, write

    motion = read(str(config["input"]), config["fps"], config["unit"])
    print(write(motion, str(config["out"])))


if __name__ == "__main__":
    sys.exit(main())
