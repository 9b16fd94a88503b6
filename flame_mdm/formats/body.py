"""Size and feet of a body, to detect motion files with wrong units or maps."""

import math

import numpy as np

from flame_mdm.errors import UserError
from flame_mdm.representations.skeleton import SMPL22

LEG = (0.6, 1.2)  # shortest and longest leg of an adult, in meters: hip to knee to ankle
CHILD = 0.25  # shortest leg of a child in meters, at about one year
USUAL_LEG = 0.83
FOOT = 0.02  # shortest foot in meters, ankle to toes
UNITS = {
    **{"meters": 1.0, "centimeters": 0.01, "millimeters": 0.001, "inches": 0.0254, "feet": 0.3048},
    **{"the unit of CMU's recordings": 0.0564444},
}
"""Units of motion files, in meters."""


def leg_length(joints: np.ndarray) -> float:
    """Returns the mean length in meters of the left leg, hip to knee to ankle, of joints (F, 22, 3) of SMPL."""
    return _bone(joints, "left_hip", "left_knee") + _bone(joints, "left_knee", "left_ankle")


def head_height(joints: np.ndarray) -> float:
    """Returns the median height in meters of the head joint above the lowest joint of a frame."""
    return float(np.median(joints[:, SMPL22.joints.index("head"), 1] - joints[..., 1].min(1)))


def check_size(leg: float, unit: float, children: bool = False) -> None:
    """Raises `UserError` if a leg, in meters, is too short or too long; the message says which unit would fit.

    `unit` is that of the file, in meters; `children` accepts their legs, too.
    """
    shortest = CHILD if children else LEG[0]
    if shortest <= leg <= LEG[1]:
        return
    fitting = {name: u for name, u in UNITS.items() if LEG[0] <= leg / unit * u <= LEG[1]}
    name = min(fitting, key=lambda name: abs(math.log(leg / unit * fitting[name] / USUAL_LEG)), default=None)
    right = f"{fitting[name]:.6g}" if name else f"{unit * USUAL_LEG / leg:.2g}" if leg else "..."
    small = " If these are children, set `children: true`." * (not children and CHILD <= leg < LEG[0])
    raise UserError(
        f"the legs are {leg:.3g} m long (unit {unit:.6g}), but people's are {shortest:g} to {LEG[1]:g} m.{small} "
        f"{f'The unit may be {right} ({name})' if name else 'The unit is wrong'}: set `unit: {right}` in skeleton.yaml"
        f" (unit={right} in convert and edit)"
    )


def check_feet(joints: np.ndarray) -> None:
    """Raises `UserError` if a foot of SMPL's joints (F, 22, 3) has no length, or the toes point backwards."""
    at = {name: joints[:, number] for number, name in enumerate(SMPL22.joints)}
    for side in ("left", "right"):
        if _bone(joints, f"{side}_ankle", f"{side}_foot") < FOOT:
            raise UserError(
                f"the {side} foot has no length: {side}_foot and {side}_ankle are the same point. Map {side}_foot in "
                "skeleton.yaml to the toes, or to the end site of the ankle, such as LeftAnkle.end"
            )
    across, trunk = at["left_hip"] - at["right_hip"], at["neck"] - at["pelvis"]
    toes = at["left_foot"] + at["right_foot"] - at["left_ankle"] - at["right_ankle"]
    if np.median((np.cross(across, trunk) * toes).sum(1)) < 0:
        raise UserError(
            "the toes point backwards: left and right are swapped, or the axes are mirrored (mirrored: true in "
            "skeleton.yaml)"
        )


def _bone(joints: np.ndarray, start: str, end: str) -> float:
    first, last = (joints[:, SMPL22.joints.index(name)] for name in (start, end))
    return float(np.linalg.norm(first - last, axis=1).mean())
