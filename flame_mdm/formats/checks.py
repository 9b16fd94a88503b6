"""Checks for motions with SMPL's joints: body size, feet, up axis, flipped legs, and rest poses."""

import numpy as np

from flame_mdm.formats.layouts import UP, Layout, check_feet, check_size
from flame_mdm.representations.skeleton import SMPL22

# A body is lying if the mean vertical component of its trunk direction is smaller than this
LYING = 0.3
# A different up axis is suggested if the component along this axis is larger than this
STANDING = 0.7
# Maximum speed of the pelvis in m/s. Sprinters reach 12, so a file with a higher speed than this is
# damaged.
FASTEST = 15.0
# Seconds over which the speed of the pelvis is averaged
AVERAGED = 0.05
# Speed of an ankle relative to the pelvis, in m/s, above which a leg is assumed to have flipped
# between two frames. The fastest kicks reach 20.
KICK = 30.0
UNDER = 0.02  # maximum depth in meters below the floor; a deeper body is reported as too small

# Maximum time in seconds between a motion and the rest pose that precedes it. Some conversions
# blend from one to the other.
BLEND = 0.04
# Number of subsequent frames with which the first steps are compared
CALM = 8
# Minimum length in meters of the step from a rest pose to the motion, and minimum ratio of this
# step to the following steps
JUMP = (
    0.15,
    3.0,
)
# Cosine of the maximum bend of arms and legs in a rest pose
STRAIGHT = np.cos(np.radians(25))
# Cosine of the minimum angle between the arms and the downward direction of the trunk in a rest
# pose
HANGING = np.cos(np.radians(25))
SYMMETRIC = 0.2  # maximum difference between the cosines of the left and the right arm

_NUMBER = {joint: number for number, joint in enumerate(SMPL22.joints)}
_LIMBS = (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"))


def check_body(joints: np.ndarray, layout: Layout) -> None:
    """Checks that joints (F, 22, 3) form a human body.

    The file's `layout` specifies the unit, the up axis, and whether the person may be a child. If
    the size is wrong and the body is lying down, the message names both the unit and the axis, so
    that the user can correct both at once.

    Raises:
        UserError: If the size is wrong, if a foot has no length, or if the feet point backward.
    """
    doubt = lying(joints, layout.up, np.array(UP[layout.up], float))
    check_size(joints, layout.unit, layout.children, doubt)
    check_feet(joints)


def uprightness(joints: np.ndarray) -> float:
    """Returns the mean vertical component of the trunk direction, from -1 to 1.

    The y axis of `joints` (F, 22, 3) points up.
    """
    return float(_trunk(joints)[:, 1].mean())


def lying(joints: np.ndarray, up: str, axes: np.ndarray) -> str:
    """Returns a message if the body is lying down in most frames, or "" otherwise.

    If the body would stand upright with another up axis, the message suggests that axis. `up` is
    the file's up axis. `axes` (3, 3) is the matrix that converted `joints` (F, 22, 3) from the
    file's axes to y up.
    """
    if uprightness(joints) >= LYING:
        return ""
    backwards = _trunk(joints).mean(0) @ axes  # in the axes of the file
    heights = {
        axis: float(backwards @ np.array(rows, float)[1]) for axis, rows in UP.items() if axis != up
    }
    axis = max(heights, key=lambda axis: heights[axis])
    if heights[axis] < STANDING:
        return "the body is lying down"
    return f"the body is lying down. If it should stand, set up={axis}, or `up: {axis}` in skeleton.yaml"


def jump(joints: np.ndarray, fps: float) -> str:
    """Returns a message if the pelvis or a leg moves implausibly fast, or "" otherwise.

    `joints` (F, 22, 3) are in meters.
    """
    ankles = joints[:, [_NUMBER["left_ankle"], _NUMBER["right_ankle"]]] - joints[:, :1]
    # A body that shakes for one frame does not jump, but a leg can flip within a single frame.
    apart = max(1, round(fps * AVERAGED))
    for verb, points, frames, fastest in (
        ("the body jumps", joints[:, :1], apart, FASTEST),
        ("a leg flips", ankles, 1, KICK),
    ):
        speeds = (
            np.linalg.norm((points[frames:] - points[:-frames]).astype(float), axis=-1)
            * fps
            / frames
        )
        if speeds.max(initial=0.0) > fastest:
            frame = int(speeds.max(1).argmax())
            return f"{verb}: it moves at {speeds.max():.0f} m/s in frame {frame} ({fps:g} fps), so the file is damaged"
    return ""


def below_floor(joints: np.ndarray) -> str:
    """Returns a message if a body with an adult's bones sinks below the floor, or "" otherwise.

    The body sinks below the floor if the person in the file is smaller than an adult.
    """
    lowest = float(np.median(joints[..., 1].min(1)))
    if lowest > -UNDER:
        return ""
    depth = f"the feet are {-100 * lowest:.0f} cm below the floor"
    return f"{depth}: rotations are shown on an adult body, and the body in the file is smaller"


def rest_frames(joints: np.ndarray, fps: float) -> int:
    """Returns the number of initial frames that show a rest pose or lead from it to the motion.

    Several programs write a T-pose or A-pose as the first frame. From this pose, the body then
    jumps to the motion or moves to it within a few frames. If the person really stood in a rest
    pose at first, there is no such jump, and no frames are counted.
    """
    if len(joints) < 3 or not _is_rest_pose(joints[0].astype(float)):
        return 0
    blend = max(1, round(BLEND * fps))
    relative = (joints[: blend + CALM + 1] - joints[: blend + CALM + 1, :1]).astype(float)
    steps = np.linalg.norm(np.diff(relative, axis=0), axis=-1).max(1)
    calm = steps[blend:].max(initial=0.0)
    jumps = np.append(steps[:blend] > max(JUMP[1] * calm, JUMP[0] / (2 * blend)), False)
    first = int(jumps.argmin())
    return first if steps[:first].sum() > JUMP[0] else 0


def _is_rest_pose(pose: np.ndarray) -> bool:
    """Returns whether joints (22, 3) show a person standing with straight arms and legs.

    Both arms must be raised by the same angle.
    """
    trunk = _trunk(pose[None])[0]
    raised = []
    for side in ("left", "right"):
        for limb in _LIMBS:
            start, middle, end = (pose[_NUMBER[f"{side}_{name}"]] for name in limb)
            upper, lower = _unit(middle - start), _unit(end - middle)
            if upper @ lower < STRAIGHT:
                return False
            raised.append(-upper @ trunk)
    # Cosines of the angles to the downward direction of the trunk
    left_arm, left_leg, right_arm, right_leg = raised
    legs_hang = min(left_leg, right_leg) > STRAIGHT
    return bool(
        legs_hang and max(left_arm, right_arm) < HANGING and abs(left_arm - right_arm) < SYMMETRIC
    )


def _trunk(joints: np.ndarray) -> np.ndarray:
    """Returns the directions (F, 3) from the pelvis to the neck."""
    return _unit(joints[:, _NUMBER["neck"]].astype(float) - joints[:, 0])


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
