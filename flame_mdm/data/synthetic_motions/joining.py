"""Joins two motions.

The second motion begins in the position and pose in which the first motion ends.
"""

import copy

import numpy as np

from flame_mdm.data.synthetic_motions.body import Body, ease, rotation

# Curves of a body that are blended into the values of the second motion, and the axis of their
# frames
ANGLES = {"pelvis": -1, "spine": -1, "head": -1, "arms": -1, "shoulders": -1, "foot_pitch": -1}
# Curves of the second motion that are moved to the position in the world at which the first motion
# ends
PLACES = {"position": 0, "heading": -1, "ankles": 1, "foot_yaw": -1}
FRAMES = ANGLES | PLACES
PLANTED = 0.05  # distance in meters; a foot that has to move farther takes a step
STEP_SECONDS, STEP_HEIGHT = 0.35, 0.07


def join(first: Body, second: Body, overlap: float = 0.0, blend: float = 0.4) -> Body:
    """Returns a body that moves like `first` until `first` ends, and then like `second`.

    The changes during the second motion are added to the values at the end of the first motion. The
    body at the end of the first motion may differ from the body at the beginning of the second
    motion. This difference is faded out, except for the position in the world. A foot that has a
    different position at the beginning of the second motion takes a step to this position.

    Args:
        first: a body at evenly spaced times.
        second: a body at times with the same spacing.
        overlap: seconds by which the second motion begins before the end of the first motion.
        blend: duration of the fade-out in seconds, measured from the end of the first motion.
    """
    spacing = second.t[1] - second.t[0]
    start = len(first.t) - min(round(overlap / spacing), len(first.t) - 1) - 1
    frames = start + len(second.t)
    joined = copy.copy(first)
    # Between a plank and a standing body, a leg may be too short for the path of its foot.
    joined.keeps_legs = True
    joined.t = np.arange(frames) * spacing
    end = (len(first.t) - 1) * spacing
    fade = ease(joined.t, start * spacing, end + blend)

    before = {name: _padded(getattr(first, name), axis, 0, frames) for name, axis in FRAMES.items()}
    after = {
        name: _padded(getattr(second, name), axis, start, frames) for name, axis in FRAMES.items()
    }
    for name in ANGLES:
        offset = before[name] - after[name][..., :1]
        setattr(joined, name, after[name] + (1 - fade) * offset)

    turn = rotation(1, first.heading[-1] - second.heading[0])
    joined.heading = before["heading"] + after["heading"] - second.heading[0]
    joined.foot_yaw = before["foot_yaw"] + after["foot_yaw"] - after["foot_yaw"][:, :1]
    joined.position = before["position"] + (after["position"] - second.position[0]) @ turn.T
    joined.ankles = before["ankles"] + (after["ankles"] - second.ankles[:, :1]) @ turn.T
    # Heights are above the same floor in both motions.
    for name in ("position", "ankles"):
        height = (1 - fade) * (before[name] - after[name][..., :1, :])[..., 1]
        getattr(joined, name)[..., 1] = after[name][..., 1] + height

    def world(points: np.ndarray) -> np.ndarray:
        """Converts points of the second motion to their positions in the joined motion."""
        return first.position[-1] * ground + (points - second.position[0] * ground) @ turn.T

    ground = np.array([1.0, 0.0, 1.0])
    for side in (0, 1):
        step = (world(second.ankles[side, 0]) - first.ankles[side, -1]) * ground
        if np.linalg.norm(step) > PLANTED:
            begin = end + side * 0.8 * STEP_SECONDS
            share = np.clip((joined.t - begin) / STEP_SECONDS, 0, 1)
            joined.ankles[side] += ease(share, 0, 1)[:, None] * step
            joined.ankles[side, :, 1] += STEP_HEIGHT * np.sin(np.pi * share) ** 2

    joined.reaches = []
    for side, weight, target, frame in first.reaches:
        target = np.broadcast_to(target, (len(first.t), 3))
        held = _padded(weight, 0, 0, frames) * (1 - fade)[:, None]
        joined.reaches.append((side, held, _padded(target, 0, 0, frames), frame))
    for side, weight, target, frame in second.reaches:
        target = np.broadcast_to(target, (len(second.t), 3))
        target = world(target) if frame == "world" else target
        held = (
            _padded(weight, 0, start, frames)
            * (fade if weight[0] > 0.01 else 1.0 + 0 * fade)[:, None]
        )
        joined.reaches.append((side, held, _padded(target, 0, start, frames), frame))
    return joined


def frames_of(body: Body, frames: np.ndarray) -> Body:
    """Returns a body that consists of selected frames (N,) of another body."""
    part = copy.copy(body)
    part.t = np.arange(len(frames)) * (body.t[1] - body.t[0])
    for name, axis in FRAMES.items():
        setattr(part, name, np.take(getattr(body, name), frames, axis))
    part.reaches = [
        (side, weight[frames], target if target.ndim == 1 else target[frames], frame)
        for side, weight, target, frame in body.reaches
    ]
    return part


def _padded(values: np.ndarray, axis: int, start: int, frames: int) -> np.ndarray:
    """Pads values to `frames` frames along `axis`, so that they begin at frame `start`.

    The first value is repeated before `start`, and the last value is repeated at the end.
    """
    length = values.shape[axis]
    return np.take(values, np.clip(np.arange(frames) - start, 0, length - 1), axis)
