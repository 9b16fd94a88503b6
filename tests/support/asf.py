"""Small recordings in the layout of CMU's ASF and AMC files."""

import math
import re
from pathlib import Path

import numpy as np

SIDE = """lhipjoint root .7 -.7 .2 .14 -|lfemur lhipjoint 0 -1 0 .4 rx ry rz|ltibia lfemur 0 -1 0 .42 rx|
lfoot ltibia 0 -.3 .95 .13 rx rz|ltoes lfoot 0 0 1 .06 -|lclavicle thorax .95 .3 0 .2 -|
lhumerus lclavicle 1 0 0 .28 rx ry rz|lradius lhumerus 1 0 0 .19 rx|
lwrist lradius 1 0 0 .095 -|lhand lwrist 1 0 0 .05 -"""
TRUNK = """lowerback root 0 1 0 .12 rx ry rz|upperback lowerback 0 1 0 .12 rx ry rz|thorax upperback 0 1 0 .12 rx ry rz|
lowerneck thorax 0 1 0 .09 rx ry rz|upperneck lowerneck 0 1 0 .09 -|head upperneck 0 1 0 .09 -"""
BONES = [
    row.split() for text in (TRUNK, SIDE, re.sub(r"\bl", "r", SIDE)) for row in text.split("|")
]
"""Name, parent, direction, length in meters, degrees of freedom."""
UNIT = 0.0254 / 0.45


def write_asf(path: Path) -> None:
    lines = [
        ":units",
        "length 0.45",
        "angle deg",
        ":root",
        "order TX TY TZ RX RY RZ",
        "axis XYZ",
        ":bonedata",
    ]
    for name, _, x, y, z, length, *freedoms in BONES:
        sign = "-" if name.startswith("r") else ""
        size = float(length) / UNIT * np.linalg.norm([float(x), float(y), float(z)])
        lines += [
            "begin",
            f"name {name}",
            f"direction {sign}{x} {y} {z}",
            f"length {size}",
            "axis 0 0 20 XYZ",
        ]
        lines += [f"dof {' '.join(freedoms)}" * (freedoms != ["-"]), "end"]
    lines += [":hierarchy", "begin", *(f"{parent} {name}" for name, parent, *_ in BONES), "end"]
    path.write_text("\n".join(lines) + "\n")


def write_amc(path: Path, frames: int, seed: int = 0) -> None:
    """A body that walks along z and swings its limbs; different for each seed."""
    lines = [":DEGREES"]
    for frame in range(frames):
        phase = math.sin(frame / 20 + seed)
        lines += [
            str(frame + 1),
            f"root 0 {0.95 / UNIT} {frame * 0.01 / UNIT} {2 * phase} {5 * phase} 1",
        ]
        for number, (name, *_, last) in enumerate(BONES):
            count = (
                BONES[number].count("rx") + BONES[number].count("ry") + BONES[number].count("rz")
            )
            angles = (str(12 * phase * (-1) ** (number + k)) for k in range(count))
            lines += [f"{name} {' '.join(angles)}"] * (last != "-")
    path.write_text("\n".join(lines) + "\n")
